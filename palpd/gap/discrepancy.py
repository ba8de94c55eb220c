"""What a hypothesis leaves: is it noise, or something that no effect of the list explains?

The whitened remainder is written, rest by rest and stroke by stroke, in a few smooth shapes (mean, slope, bend …; in log time at
rest). Were it noise, every coefficient would be N(0, 1). For every channel, phase and shape the evidence that the coefficients have a
common mean, or a larger variance, is weighed against that; besides them, single outliers, a single frequency, and short pulses.
"""

from dataclasses import dataclass
from itertools import pairwise
from math import log

import numpy as np
from scipy.ndimage import median_filter

from palpd.gap.gaussian import PLAUSIBLE
from palpd.gap.noise import CHANNELS, FZ
from palpd.gap.phases import PHASES
from palpd.gap.problem import SHARED, Linearisation, Problem
from palpd.tick import Floats

BEYOND_TOLERANCE = {
    "youngs_modulus": "tissue.modulus",
    "surface_z_m": "tissue.surface",
    "gain": "sensor.gain",
    "latency_s": "sensor.latency",
    "filter_cutoff": "sensor.filter",
    "mass_kg": "probe.mass",
    "servo_natural_frequency": "robot.lag",
    "fx_per_fz": "sensor.crosstalk",
    "fy_per_fz": "sensor.crosstalk",
    "tx_per_fz": "sensor.crosstalk",
    "ty_per_fz": "sensor.crosstalk",
    "bias": "sensor.bias",
    "drift": "sensor.drift",
}
"""The effect that a deviation is when it is more than its tolerance."""

SHAPES = 5
PULSES = (1, 3, 9, 27)
"""Lengths of pulses that are looked for, in bins."""

PULSE = 8.0
"""How large a pulse is beforehand, in sigmas."""

UNSURE = 1.15
"""Up to so many times wider than measured is noise that is not the stated one."""

INCLUSION = 0.01
"""How probable it is beforehand that one channel, phase and shape is off."""


@dataclass(frozen=True)
class Left:
    """`log_bayes_factor` for something being left, its `energy` in squared sigmas, and where most of it is."""

    log_bayes_factor: float
    energy: float
    channel: str
    phase: str


def what_is_left(problem: Problem, remainder: Floats, around: Linearisation, residual: Floats) -> Left:
    """How much structure there is in a whitened remainder (7, b), and in the in-tolerance deviations that the residual asks for."""
    if problem.noisy:
        remainder = remainder / np.clip(remainder.std(axis=1, keepdims=True), 1.0, UNSURE)
    coefficients, phase = _coefficients(problem, remainder)
    total, energy, tone, tone_energy, pulse, pulse_energy = 0.0, 0.0, -np.inf, 0.0, -np.inf, 0.0
    best = (-1.0, "fz_N", PHASES[0])
    for channel in range(7):
        if not remainder[channel].any():
            continue
        for p in range(len(PHASES)):
            mine = coefficients[channel][phase == p]
            here = 0.0
            for d in range(mine.shape[1] if len(mine) else 0):
                z = mine[:, d]
                z = z[np.isfinite(z)]
                if not len(z):
                    continue
                factor = _group(z)
                gain = float(np.logaddexp(log(1.0 - INCLUSION), log(INCLUSION) + factor))
                total += gain
                certain = 1.0 / (1.0 + np.exp(-(np.clip(factor + log(INCLUSION), -50, 50))))
                here += certain * max(float((z**2).sum()) - len(z), 0.0)
            energy += here
            if here > best[0]:
                best = (here, CHANNELS[channel], PHASES[p])
        factor, power = _frequency(problem, remainder[channel])
        if factor > tone:
            tone, tone_energy = factor, power
        factor, power = _pulses(remainder[channel])
        if factor > pulse:
            pulse, pulse_energy = factor, power
    stretched, strain = _strain(problem, around, residual)
    total += stretched
    every = np.concatenate([c[np.isfinite(c)] for c in coefficients])
    outlier, most = _outlier(every)
    # The same deviation may show as all four: they are alternatives, each with its own energy.
    each = np.array([total, tone, outlier, pulse])
    evidence = float(np.logaddexp.reduce(each) - log(len(each)))
    there = 1.0 / (1.0 + np.exp(-np.clip(evidence, -50.0, 50.0)))
    energy = there * float(np.exp(each - np.logaddexp.reduce(each)) @ np.array([energy, tone_energy, most, pulse_energy]))
    return Left(evidence, energy + strain, best[1], best[2])


def _coefficients(problem: Problem, remainder: Floats) -> tuple[list[Floats], Floats]:
    """Per channel (segments, SHAPES), NaN where a segment is too short; and the phase of every segment."""
    rows: list[list[Floats]] = [[] for _ in range(7)]
    phase: list[int] = []
    start = 0
    for run in problem.runs:
        label = run.bin_phase * 1e6 + run.bin_cycle
        edges = np.concatenate([[0], np.flatnonzero(np.diff(label)) + 1, [len(label)]])
        weight = np.sqrt(run.bins.count)
        for a, b in pairwise(edges):
            if b - a < 3:
                continue
            shapes = min(SHAPES, (b - a) // 2)
            p = int(run.bin_phase[a])
            t = run.t_s[a:b] - run.t_s[a]
            x = t if p in (1, 2, 4) else np.log1p(t / max(float(t[-1]) / 50.0, 1e-12))
            x = 2.0 * x / max(float(x[-1]), 1e-300) - 1.0
            basis, _ = np.linalg.qr(weight[a:b, None] * np.polynomial.chebyshev.chebvander(x, shapes - 1))
            z = remainder[:, start + a : start + b] @ basis
            for channel in range(7):
                row = np.full(SHAPES, np.nan)
                row[:shapes] = z[channel] * np.sign(basis.sum(axis=0)[0] or 1.0)
                rows[channel].append(row)
            phase.append(p)
        start += len(run.bins)
    return [np.array(r).reshape(-1, SHAPES) for r in rows], np.array(phase)


def _group(z: Floats) -> float:
    """Log Bayes factor of coefficients with a common mean or a larger variance against N(0, 1)."""
    n, mean, square = len(z), float(z.mean()), float((z**2).sum())
    factors = []
    for spread in (2.0, 8.0, 30.0):
        v = 1.0 + n * spread**2
        factors.append(-0.5 * log(v) + 0.5 * (n * mean) ** 2 * spread**2 / v)
        factors.append(-0.5 * n * log(1.0 + spread**2) + 0.5 * square * spread**2 / (1.0 + spread**2))
    return float(np.logaddexp.reduce(factors) - log(len(factors)))


def _wider(z: Floats, spread: float) -> Floats:
    """Log Bayes factors of numbers that are N(0, 1) and something of that spread besides, against N(0, 1)."""
    return -0.5 * log(1.0 + spread**2) + 0.5 * z**2 * spread**2 / (1.0 + spread**2)


def _outlier(z: Floats) -> tuple[float, float]:
    """Log Bayes factor of one coefficient being large, and its energy."""
    spread = 10.0
    each = _wider(z, spread)
    return (float(np.logaddexp.reduce(each) - log(len(z))), float((z**2).max())) if len(z) else (0.0, 0.0)


def _pulses(values: Floats) -> tuple[float, float]:
    """Log Bayes factor, and energy, of a few stretches of neighbouring bins, all of one length, each off by an amount of its own."""
    live = values[values != 0.0]
    sums = np.concatenate([[0.0], np.cumsum(live)])
    factors, energies = [], []
    for length in PULSES:
        if len(live) < 8 * length:
            continue
        z = (sums[length::length] - sums[:-length:length]) / length**0.5
        each = _wider(z, PULSE)
        rare = log(3.0 / len(z))
        gain = np.logaddexp(np.log1p(-np.exp(rare)), rare + each)
        certain = 1.0 / (1.0 + np.exp(-np.clip(each + rare, -50.0, 50.0)))
        factors.append(float(gain.sum()))
        energies.append(float((certain * np.maximum(z**2 - 1.0, 0.0)).sum()))
    if not factors:
        return -np.inf, 0.0
    best = int(np.argmax(factors))
    return float(np.logaddexp.reduce(factors) - log(len(factors))), energies[best]


def _strain(problem: Problem, around: Linearisation, residual: Floats) -> tuple[float, float]:
    """Log Bayes factor of deviations beyond their tolerances, and the energy of what they then hide: what belongs to the cell, to
    each recording and to its presses. Were the cell healthy, each deviation over its spread would be N(0, 1). A deviation that is a
    listed effect once it is out of tolerance is no evidence of something outside the list."""
    space = around.space
    found = space.coefficients(residual)
    inverse = np.linalg.inv(space.factor)
    spread = np.sqrt(np.maximum(1.0 - (inverse**2).sum(axis=0), 0.0))
    z = np.where(spread > 0.5, found / np.maximum(spread, 0.5), np.nan)
    if not problem.cell.tolerances.modulus_known:
        z[0] = np.nan
    first = len(around.eta)
    z[[first + k for k in around.index.numerical]] = np.nan
    groups = [[first + k for k, name in around.index.press if name == kind] for kind in ("stiffness", "surface_z_m")]
    pressed = {k for group in groups for k in group}
    groups += [[k] for k in range(len(z)) if k not in pressed]
    listed = [k for k, name in enumerate(SHARED) if BEYOND_TOLERANCE[name] in problem.library]
    listed += [first + k for c, k, kind in around.index.own if c == FZ and BEYOND_TOLERANCE[kind] in problem.library]
    outside, every = [0.0], [0.0]
    for group in groups:
        mine = z[group]
        mine = mine[np.isfinite(mine)]
        if len(mine):
            factor = _group(mine)
            if len(mine) > 3:
                factor = float(np.logaddexp(factor, _outlier(mine)[0]) - log(2.0))
            every.append(log(INCLUSION) + factor)
            if group[0] not in listed:
                outside.append(every[-1])
    # Deviations stand in for each other, so that together they say no more than the worst of them.
    hidden = space.explained(np.where(np.isnan(z) & (spread > 0.5), 0.0, found - np.clip(found, -PLAUSIBLE, PLAUSIBLE)))
    certain = -float(np.expm1(-np.logaddexp.reduce(every)))
    return float(np.logaddexp.reduce(outside)), certain * float((hidden**2).sum())


def _frequency(problem: Problem, values: Floats) -> tuple[float, float]:
    """Log Bayes factor, and energy, of one sinusoid that goes through the whole recording."""
    start, best, power = 0, 0.0, 0.0
    for run in problem.runs:
        n = len(run.bins)
        part = values[start : start + n]
        start += n
        t = run.t_s
        if n < 64:
            continue
        step = max(float(np.quantile(np.diff(t), 0.25)), 1e-12)
        grid = np.arange(0.0, float(t[-1]), step)[:40000]
        usual = float(np.quantile(run.bins.count, 0.25))
        even = np.interp(grid, t, part * np.sqrt(usual / run.bins.count))
        # Where coarse bins are joined the spectrum falls; it never says more than unit noise would allow.
        spectrum = np.abs(np.fft.rfft(even - even.mean())) ** 2
        if len(spectrum) < 64:
            continue
        local = median_filter(spectrum, size=101, mode="reflect")
        ratio = spectrum[8:-8] / np.maximum(local[8:-8] / 0.693, len(grid))
        peak = float(ratio.max())
        best += peak - log(len(ratio)) - 0.5 * log(max(peak, 1.0)) - 5.0
        power += peak
    return best, 2.0 * power


