"""Is a residual noise, or does it hold structure that no listed effect explains?

The whitened remainder is written, rest by rest and stroke by stroke, in a few smooth shapes (mean, slope, curvature …; in log time at
rest). Were it noise, every coefficient would be N(0, 1). For every channel, phase and shape a common mean or a larger variance of the
coefficients is compared with that. Single outliers, a single frequency and short pulses are tested, too.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import log

import numpy as np
from scipy.ndimage import median_filter

from palpd.gap.assumptions import ASSUMED
from palpd.gap.data.noise import CHANNELS, FZ
from palpd.gap.data.phases import FREE_MOVING, LOADING, PHASES, UNLOADING, Ints
from palpd.gap.infer.evidence import Fit
from palpd.gap.model.problem import Problem, tolerance_key
from palpd.tick import Floats


@dataclass(frozen=True)
class ResidualStructure:
    """B, the log Bayes factor for structure in a residual, its energy in squared sigmas, and the channel and phase with most of it."""

    log_bayes_factor: float
    energy: float
    channel: str
    phase: str


@dataclass(frozen=True)
class Segment:
    """A rest or a stroke: its bins, their phase, and smooth shapes (bins, s) in them, orthonormal."""

    bins: slice
    phase: int
    shapes: Floats


def test_residual(problem: Problem, fit: Fit, segments: Sequence[Segment]) -> ResidualStructure:
    """Test the residual of a hypothesis for structure, and its deviations for sizes out of tolerance.

    Args:
        segments: The rests and strokes of the problem, from `segments_of`.
    """
    remainder = fit.remainder
    if problem.excess_noise:
        remainder = remainder / np.clip(remainder.std(axis=1, keepdims=True), 1.0, ASSUMED.noise.excess_ratio)
    coefficients, phase = _coefficients(segments, remainder)
    smooth, smooth_energy, channel, place = _smooth(coefficients, phase, remainder)
    tones = [(-np.inf, 0.0), *(_tone(problem, values) for values in remainder if values.any())]
    pulses = [(-np.inf, 0.0), *(_pulses(values) for values in remainder if values.any())]
    strain, strain_energy = _strain(problem, fit)
    # The same deviation may show as all four: they are alternatives, each with its own energy.
    alternatives = [
        (smooth + strain, smooth_energy),
        max(tones, key=lambda tone: tone[0]),
        _outlier(coefficients[np.isfinite(coefficients)]),
        max(pulses, key=lambda pulse: pulse[0]),
    ]
    each, energies = (np.array(values) for values in zip(*alternatives, strict=True))
    evidence = float(np.logaddexp.reduce(each) - log(len(each)))
    energy = float(_sigmoid(evidence)) * float(np.exp(each - np.logaddexp.reduce(each)) @ energies)
    return ResidualStructure(evidence, energy + strain_energy, channel, place)


def segments_of(problem: Problem) -> list[Segment]:
    """The rests and strokes of all recordings that are long enough to have a shape."""
    out = []
    start = 0
    for one in problem.recordings:
        segment = one.bin_phase * 1e6 + one.bin_cycle
        edges = np.concatenate([[0], np.flatnonzero(np.diff(segment)) + 1, [len(segment)]]).tolist()
        weight = np.sqrt(one.bins.count)
        for a, b in pairwise(edges):
            if b - a < 3:
                continue
            shapes = min(ASSUMED.residual.shapes, (b - a) // 2)
            p = int(one.bin_phase[a])
            t = one.t_s[a:b] - one.t_s[a]
            x = t if p in (FREE_MOVING, LOADING, UNLOADING) else np.log1p(t / max(float(t[-1]) / 50.0, 1e-12))
            x = 2.0 * x / max(float(x[-1]), 1e-300) - 1.0
            basis, _ = np.linalg.qr(weight[a:b, None] * np.polynomial.chebyshev.chebvander(x, shapes - 1))
            out.append(Segment(slice(start + a, start + b), p, basis * np.sign(basis.sum(axis=0)[0] or 1.0)))
        start += len(one.bins)
    return out


def _coefficients(segments: Sequence[Segment], remainder: Floats) -> tuple[Floats, Ints]:
    """Coefficients (7, segments, `residual.shapes`), NaN where a segment is too short; and the phase of every segment."""
    out = np.full((len(remainder), len(segments), ASSUMED.residual.shapes), np.nan)
    for k, segment in enumerate(segments):
        out[:, k, : segment.shapes.shape[1]] = remainder[:, segment.bins] @ segment.shapes
    return out, np.array([segment.phase for segment in segments])


def _smooth(coefficients: Floats, phase: Ints, remainder: Floats) -> tuple[float, float, str, str]:
    """Log Bayes factor and energy of smooth structure, and the channel and phase with most of it."""
    total, energy = 0.0, 0.0
    best = (-1.0, "fz_N", PHASES[0])
    for channel in range(7):
        if not remainder[channel].any():
            continue
        for p in range(len(PHASES)):
            here = 0.0
            for z in coefficients[channel][phase == p].T:
                z = z[np.isfinite(z)]
                if not len(z):
                    continue
                factor = _group(z)
                total += float(np.logaddexp(log(1.0 - ASSUMED.residual.p_structure), log(ASSUMED.residual.p_structure) + factor))
                here += float(_sigmoid(factor + log(ASSUMED.residual.p_structure))) * max(float((z**2).sum()) - len(z), 0.0)
            energy += here
            if here > best[0]:
                best = (here, CHANNELS[channel], PHASES[p])
    return total, energy, best[1], best[2]


def _sigmoid(log_odds: Floats | float) -> Floats:
    """Probability of log odds."""
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(log_odds, -50.0, 50.0))))


def _group(z: Floats) -> float:
    """Log Bayes factor of coefficients (n,) with a common mean or a larger variance against N(0, 1)."""
    n, mean, square = len(z), float(z.mean()), float((z**2).sum())
    factors = []
    for spread in ASSUMED.residual.group_sd:
        v = 1.0 + n * spread**2
        factors.append(-0.5 * log(v) + 0.5 * (n * mean) ** 2 * spread**2 / v)
        factors.append(-0.5 * n * log(1.0 + spread**2) + 0.5 * square * spread**2 / (1.0 + spread**2))
    return float(np.logaddexp.reduce(factors) - log(len(factors)))


def _wider(z: Floats, spread: float) -> Floats:
    """Log Bayes factor of N(0, 1 + spread²) against N(0, 1) for each number (n,)."""
    return -0.5 * log(1.0 + spread**2) + 0.5 * z**2 * spread**2 / (1.0 + spread**2)


def _outlier(z: Floats) -> tuple[float, float]:
    """Log Bayes factor for a single large coefficient among all (n,), and its energy."""
    if not len(z):
        return 0.0, 0.0
    return float(np.logaddexp.reduce(_wider(z, ASSUMED.residual.outlier_sd)) - log(len(z))), float((z**2).max())


def _pulses(values: Floats) -> tuple[float, float]:
    """Log Bayes factor and energy of a few pulses of the same length, each with an amount of its own."""
    live = values[values != 0.0]
    sums = np.concatenate([[0.0], np.cumsum(live)])
    factors, energies = [], []
    for length in ASSUMED.residual.pulse_bins:
        if len(live) < 8 * length:
            continue
        z = (sums[length::length] - sums[:-length:length]) / length**0.5
        each = _wider(z, ASSUMED.residual.pulse_sd)
        rare = log(ASSUMED.residual.pulses / len(z))
        factors.append(float(np.logaddexp(np.log1p(-np.exp(rare)), rare + each).sum()))
        energies.append(float((_sigmoid(each + rare) * np.maximum(z**2 - 1.0, 0.0)).sum()))
    if not factors:
        return -np.inf, 0.0
    return float(np.logaddexp.reduce(factors) - log(len(factors))), energies[int(np.argmax(factors))]


def _strain(problem: Problem, fit: Fit) -> tuple[float, float]:
    """Log Bayes factor of deviations beyond their tolerances for which no listed effect stands, and the energy that all of them hide.

    Were the cell healthy, each ĉ over its standard deviation would be N(0, 1); its variance is 1 less the posterior variance of c. If a
    listed effect stands for a deviation that is out of tolerance, this is no evidence of something outside the list.
    """
    around, space = fit.linearisation, fit.linearisation.space
    deviation = space.coefficients(fit.residual)
    inverse = np.linalg.inv(space.factor)
    spread = np.sqrt(np.maximum(1.0 - (inverse**2).sum(axis=0), 0.0))
    z = np.where(spread > ASSUMED.residual.least_spread, deviation / np.maximum(spread, ASSUMED.residual.least_spread), np.nan)
    if not problem.cell.tolerances.modulus_known:
        z[0] = np.nan
    z[[*around.numbers("computation")]] = np.nan
    groups = [around.numbers("press", name) for name in ("stiffness", "surface_z_m")]
    groups += [[k] for k, label in enumerate(around.labels) if label.scope != "press"]
    beyond = {effect.tolerance for effect in problem.library.values()}
    outside, every = [0.0], [0.0]
    for group in groups:
        mine = z[group]
        mine = mine[np.isfinite(mine)]
        if len(mine):
            factor = _group(mine)
            if len(mine) > 3:
                factor = float(np.logaddexp(factor, _outlier(mine)[0]) - log(2.0))
            every.append(log(ASSUMED.residual.p_structure) + factor)
            label = around.labels[group[0]]
            is_effect = tolerance_key(label.name) in beyond
            if not (is_effect and (label.scope == "cell" or (label.scope == "recording" and label.channel == FZ))):
                outside.append(every[-1])
    # Deviations stand in for each other, so together they say no more than the worst of them.
    excess = deviation - np.clip(deviation, -ASSUMED.noise.plausible_sd, ASSUMED.noise.plausible_sd)
    hidden = space.explained(np.where(np.isnan(z) & (spread > ASSUMED.residual.least_spread), 0.0, excess))
    certain = -float(np.expm1(-np.logaddexp.reduce(every)))
    return float(np.logaddexp.reduce(outside)), certain * float((hidden**2).sum())


def _tone(problem: Problem, values: Floats) -> tuple[float, float]:
    """Log Bayes factor and energy of a sinusoid that lasts through the whole of every recording, in a channel (b,)."""
    start, evidence, power = 0, 0.0, 0.0
    for one in problem.recordings:
        n = len(one.bins)
        part = values[start : start + n]
        start += n
        if n < 64:
            continue
        step_s = max(float(np.quantile(np.diff(one.t_s), 0.25)), 1e-12)
        grid_s = np.arange(0.0, float(one.t_s[-1]), step_s)[:40000]
        usual = float(np.quantile(one.bins.count, 0.25))
        even = np.interp(grid_s, one.t_s, part * np.sqrt(usual / one.bins.count))
        # Where coarse bins are joined the spectrum falls; it never says more than unit noise would allow.
        spectrum = np.abs(np.fft.rfft(even - even.mean())) ** 2
        if len(spectrum) < 64:
            continue
        local = median_filter(spectrum, size=101, mode="reflect")
        ratio = spectrum[8:-8] / np.maximum(local[8:-8] / 0.693, len(grid_s))
        peak = float(ratio.max())
        evidence += peak - log(len(ratio)) - 0.5 * log(max(peak, 1.0)) - ASSUMED.residual.tone_nats
        power += peak
    return evidence, 2.0 * power
