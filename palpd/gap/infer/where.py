"""Where measurement and simulation disagree: by channel and phase, by frequency, and over cycles, before any cause is named."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TypedDict

import numpy as np

from palpd.gap.assumptions import ASSUMED
from palpd.gap.data.noise import CHANNELS, declared_rms
from palpd.gap.data.phases import PHASES
from palpd.gap.infer.evidence import Fit
from palpd.gap.infer.posterior import Hypothesis
from palpd.gap.model.linearise import Linearisation
from palpd.gap.model.problem import SHARED, Problem
from palpd.tick import Floats

FEWEST_SAMPLES = 4
"""Least number of samples of a phase in which a gap can lie; fewer are an accident of noise near a border between phases."""

FEWEST_BINS = 4
"""Least number of bins of a phase in which something unexplained can lie."""


class Place(TypedDict):
    """A channel and a phase."""

    channel: str
    phase: str


class Unexplained(Place):
    """The channel and phase with the largest residual, and its rms in the unit of the channel."""

    rms: float


class Band(TypedDict):
    """Rms of the gap of a channel between two frequencies, and of white noise of the stated rms there, in the unit of the channel."""

    channel: str
    low_Hz: float
    high_Hz: float
    rms: float
    noise_floor: float


class Trend(TypedDict):
    """Mean and rms of the gap of a channel in a cycle of a recording, in the unit of the channel; numbers count from 0."""

    recording: int
    cycle: int
    begin_s: float
    channel: str
    mean: float
    rms: float


@dataclass(frozen=True)
class PhaseGap:
    """The gap of a channel in a phase.

    Attributes:
        rms: Of measured minus predicted, in the unit of the channel.
        noise_floor: Rms that noise and tolerances leave in a healthy cell, in the same unit.
        excess: √((rms² - floor²) / floor²), 0 below the floor.
    """

    channel: str
    phase: str
    rms: float
    noise_floor: float
    excess: float
    samples: int


def residuals(problem: Problem, around: Linearisation) -> list[Floats]:
    """Measured minus predicted of every recording.

    Args:
        around: Its state (θ, η₀) predicts; its nuisances are not used.

    Returns:
        For each recording (n, 7), zero where a channel is not compared.
    """
    cell = problem.cell_at(around.effects, around.eta)
    out = []
    for one in problem.recordings:
        values = np.column_stack([one.samples.z_m, one.samples.wrench]) - problem.raw_prediction(one, cell)
        values[:, ~np.array(one.judged)] = 0.0
        out.append(values)
    return out


def gap_table(problem: Problem, around: Linearisation, residual: Sequence[Floats]) -> list[PhaseGap]:
    """The gap of every compared channel in every phase that occurs, channel by channel.

    Args:
        around: Its nuisances set the floor.
        residual: Measured minus predicted of every recording (n, 7).
    """
    noise = declared_rms(problem.cell)
    tolerated = _tolerance_rms(problem, around)
    rows = []
    for channel, name in enumerate(CHANNELS):
        judged = [k for k, one in enumerate(problem.recordings) if one.judged[channel]]
        for p, phase in enumerate(PHASES):
            squares = [residual[k][problem.recordings[k].phases.phase == p, channel] ** 2 for k in judged]
            n = sum(len(s) for s in squares)
            if n == 0:
                continue
            square = sum(float(s.sum()) for s in squares) / n
            floor_square = float(noise[channel] ** 2 + tolerated[channel, p] ** 2)
            excess = float(np.sqrt(max(0.0, square - floor_square) / max(floor_square, 1e-300)))
            rows.append(PhaseGap(name, phase, float(np.sqrt(square)), float(np.sqrt(floor_square)), excess, n))
    return rows


def _tolerance_rms(problem: Problem, around: Linearisation) -> Floats:
    """Rms (7, 5) by channel and phase that tolerances and press scatter leave in a healthy cell."""
    out = np.zeros((7, len(PHASES)))
    phase, count = problem.per_bin(lambda one: one.bin_phase), problem.per_bin(lambda one: one.bins.count)
    squares = np.zeros_like(problem.measured)
    for channel in range(len(squares)):
        numbers, rows = around.space.columns.of_channel(channel)
        if not problem.cell.tolerances.modulus_known:
            rows = rows[numbers != SHARED.index("youngs_modulus")]  # it has been fitted
        squares[channel] = (problem.noise.natural_channel(channel, rows) ** 2).sum(axis=0)
    for p in range(len(PHASES)):
        mine = phase == p
        if mine.any():
            out[:, p] = np.sqrt((squares[:, mine] * count[mine]).sum(axis=1) / count[mine].sum())
    return out


def largest_gap(problem: Problem, table: Sequence[PhaseGap], change: Floats) -> Place | None:
    """The place of the largest excess among those where the named effects show with at least half their largest size.

    In-tolerance deviations, too, exceed their floor in some places.

    Args:
        table: The gap by channel and phase.
        change: Change (7, b) of the whitened prediction by the named effects.

    Returns:
        The place, or None where nothing is compared.
    """
    long = [gap for gap in table if gap.samples >= FEWEST_SAMPLES] or table
    if not long:
        return None
    phase, count = problem.per_bin(lambda one: one.bin_phase), problem.per_bin(lambda one: one.bins.count)
    squares = problem.noise.natural(change) ** 2
    sizes = []
    for gap in long:
        mine = phase == PHASES.index(gap.phase)
        total = float((squares[CHANNELS.index(gap.channel), mine] * count[mine]).sum())
        sizes.append((total / max(float(count[mine].sum()), 1.0)) ** 0.5 / max(gap.noise_floor, 1e-300))
    shown = [gap for gap, size in zip(long, sizes, strict=True) if size >= 0.5 * max(sizes)]
    largest = max(shown, key=lambda gap: gap.excess)
    return {"channel": largest.channel, "phase": largest.phase}


def unexplained(problem: Problem, fit: Fit) -> Unexplained | None:
    """The channel and phase with the largest residual of a hypothesis.

    Returns:
        The place and its rms; None where the residual is noise.
    """
    phase, count = problem.per_bin(lambda one: one.bin_phase), problem.per_bin(lambda one: one.bins.count)
    rms = problem.noise.rms
    most, worst = 0.0, None
    for channel, name in enumerate(CHANNELS):
        for p, label in enumerate(PHASES):
            mine = (phase == p) & (rms[channel] > 0)
            n = int(mine.sum())
            if n < FEWEST_BINS:
                continue
            squares = fit.remainder[channel, mine] ** 2
            energy = float(squares.sum()) - n
            if energy < ASSUMED.naming.unexplained_sd * np.sqrt(2.0 * n):
                continue
            excess = ((squares - 1.0) * rms[channel, mine] ** 2 * count[mine]).sum() / count[mine].sum()
            if energy > most and excess > 0:
                most, worst = energy, Unexplained(channel=name, phase=label, rms=float(np.sqrt(excess)))
    return worst


def most_structure(problem: Problem, hypothesis: Hypothesis) -> Unexplained:
    """The channel and phase with most structure in the residual of a hypothesis, also where its size is that of noise."""
    residual, phase = hypothesis.residual, problem.per_bin(lambda one: one.bin_phase)
    channel, mine = CHANNELS.index(residual.channel), phase == PHASES.index(residual.phase)
    rms = float(np.sqrt(np.mean(problem.noise.natural(hypothesis.fit.remainder)[channel, mine] ** 2))) if mine.any() else 0.0
    return Unexplained(channel=residual.channel, phase=residual.phase, rms=rms)


def bands(problem: Problem, residual: Sequence[Floats]) -> list[Band]:
    """Gap of the first recording in octaves of frequency.

    Args:
        residual: Measured minus predicted of every recording (n, 7).

    Returns:
        The bands, channel by channel; empty for a recording of fewer than 64 samples.
    """
    out: list[Band] = []
    recording, values = problem.recordings[0], residual[0]
    n = len(values)
    rate_Hz = recording.samples.rate_Hz
    if n < 64:
        return out
    noise = declared_rms(problem.cell)
    frequency = np.fft.rfftfreq(n, 1.0 / rate_Hz)
    edges = [0.0]
    high = rate_Hz / 2.0
    while high > 4.0 * rate_Hz / n and len(edges) < 12:
        edges.append(high)
        high /= 2.0
    edges = sorted(edges)
    for channel, name in enumerate(CHANNELS):
        if not recording.judged[channel]:
            continue
        power = np.abs(np.fft.rfft(values[:, channel])) ** 2 * 2.0 / n**2
        power[0] /= 2.0
        for low, high in pairwise(edges):
            mine = (frequency >= low) & ((frequency < high) | (high == edges[-1]))
            if mine.any():
                floor = float(noise[channel] * np.sqrt(mine.sum() / len(frequency)))
                rms = float(np.sqrt(power[mine].sum()))
                out.append({"channel": name, "low_Hz": low, "high_Hz": high, "rms": rms, "noise_floor": floor})
    return out


def trend(problem: Problem, residual: Sequence[Floats]) -> list[Trend]:
    """Mean and rms of the gap, for each cycle and compared channel.

    Args:
        residual: Measured minus predicted of every recording (n, 7).
    """
    out: list[Trend] = []
    for number, (one, values) in enumerate(zip(problem.recordings, residual, strict=True)):
        for cycle in range(one.phases.cycles):
            first, end = np.searchsorted(one.phases.cycle, (cycle, cycle + 1)).tolist()  # cycles follow each other
            if first == end:
                continue
            begin_s = float(one.samples.t_s[first] - one.samples.t_s[0])
            for channel in range(7):
                if one.judged[channel]:
                    part = values[first:end, channel]
                    mean, rms = float(part.mean()), float(np.sqrt((part**2).mean()))
                    out.append(Trend(recording=number, cycle=cycle, begin_s=begin_s, channel=CHANNELS[channel], mean=mean, rms=rms))
    return out
