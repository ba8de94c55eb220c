"""Where measurement and simulation part: by channel and phase, by frequency, and over cycles and time, before any cause is named."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from palpd.gap.noise import CHANNELS, declared_rms
from palpd.gap.phases import PHASES
from palpd.gap.problem import Linearisation, Problem
from palpd.tick import Floats


@dataclass(frozen=True)
class Gap:
    """One channel in one phase: rms of measured minus predicted, what a healthy cell would leave, and the excess over that."""

    channel: str
    phase: str
    rms: float
    noise_floor: float
    excess: float
    samples: int


def tolerance_rms(problem: Problem, around: Linearisation) -> Floats:
    """What tolerances and press scatter leave in a healthy cell, rms per channel and phase (7, 5)."""
    out = np.zeros((7, len(PHASES)))
    phase = np.concatenate([run.bin_phase for run in problem.runs]).astype(int)
    count = np.concatenate([run.bins.count for run in problem.runs])
    # a modulus that is not known at all has been fitted
    columns = problem.noise.natural(around.columns if problem.cell.tolerances.modulus_known else around.columns[1:])
    for p in range(len(PHASES)):
        mine = phase == p
        if mine.any():
            squares = (columns[:, :, mine] ** 2).sum(axis=0)
            out[:, p] = np.sqrt((squares * count[mine]).sum(axis=1) / count[mine].sum())
    return out


def residuals(problem: Problem, around: Linearisation) -> list[Floats]:
    """Measured minus predicted (n, 7) of every recording, by the cell of that state."""
    cell = problem.cell_at(around.effects, around.eta)
    out = []
    for run in problem.runs:
        measured = np.column_stack([run.samples.z_m, run.samples.wrench])
        left = measured - problem.raw_prediction(run, cell)
        left[:, ~np.array(run.judged)] = 0.0
        out.append(left)
    return out


def gap_table(problem: Problem, around: Linearisation, left: list[Floats]) -> list[Gap]:
    """The gap of every channel that is judged, in every phase that occurs."""
    noise = declared_rms(problem.cell)
    tolerated = tolerance_rms(problem, around)
    rows = []
    for channel, name in enumerate(CHANNELS):
        judged = [k for k, run in enumerate(problem.runs) if run.judged[channel]]
        for p, phase in enumerate(PHASES):
            squares = [left[k][problem.runs[k].phases.phase == p, channel] ** 2 for k in judged]
            n = sum(len(s) for s in squares)
            if n == 0:
                continue
            square = sum(float(s.sum()) for s in squares) / n
            floor_square = float(noise[channel] ** 2 + tolerated[channel, p] ** 2)
            excess = float(np.sqrt(max(0.0, square - floor_square) / max(floor_square, 1e-300)))
            rows.append(Gap(name, phase, float(np.sqrt(square)), float(np.sqrt(floor_square)), excess, n))
    return rows


def change_sizes(problem: Problem, change: Floats, table: list[Gap]) -> list[float]:
    """The size of a whitened change (7, b) at every place of the table: its rms there over the floor."""
    phase = np.concatenate([run.bin_phase for run in problem.runs]).astype(int)
    count = np.concatenate([run.bins.count for run in problem.runs])
    squares = problem.noise.natural(change) ** 2
    sizes = []
    for gap in table:
        mine = phase == PHASES.index(gap.phase)
        total = float((squares[CHANNELS.index(gap.channel), mine] * count[mine]).sum())
        sizes.append((total / max(float(count[mine].sum()), 1.0)) ** 0.5 / max(gap.noise_floor, 1e-300))
    return sizes


def most_excess(table: list[Gap], sizes: list[float]) -> Gap:
    """The place of the largest excess, among those where the named effects show with at least half their largest size: in-tolerance
    deviations, too, exceed their floor here or there."""
    enough = 0.5 * max(sizes)
    return max((gap for gap, size in zip(table, sizes, strict=True) if size >= enough), key=lambda gap: gap.excess)


def bands(problem: Problem, left: list[Floats]) -> list[dict[str, float | str]]:
    """Rms of the gap in octaves of frequency, and what white noise of the stated rms would leave there."""
    out: list[dict[str, float | str]] = []
    run, values = problem.runs[0], left[0]
    n = len(values)
    rate_Hz = run.samples.rate_Hz
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
        if not run.judged[channel]:
            continue
        power = np.abs(np.fft.rfft(values[:, channel])) ** 2 * 2.0 / n**2
        power[0] /= 2.0
        for low, high in pairwise(edges):
            mine = (frequency >= low) & ((frequency < high) | (high == edges[-1]))
            if mine.any():
                expected = noise[channel] * np.sqrt(mine.sum() / len(frequency))
                row: dict[str, float | str] = {"channel": name, "low_Hz": low, "high_Hz": high}
                out.append(row | {"rms": float(np.sqrt(power[mine].sum())), "noise_floor": float(expected)})
    return out


def trend(problem: Problem, left: list[Floats]) -> list[dict[str, float | int | str]]:
    """Mean and rms of the gap, cycle by cycle, in the channels that are judged."""
    out: list[dict[str, float | int | str]] = []
    for number, (run, values) in enumerate(zip(problem.runs, left, strict=True)):
        for cycle in range(run.phases.cycles):
            mine = run.phases.cycle == cycle
            if not mine.any():
                continue
            begin_s = float(run.samples.t_s[mine][0] - run.samples.t_s[0])
            for channel in range(7):
                if run.judged[channel]:
                    part = values[mine, channel]
                    out.append(
                        {
                            "recording": number,
                            "cycle": cycle,
                            "begin_s": begin_s,
                            "channel": CHANNELS[channel],
                            "mean": float(part.mean()),
                            "rms": float(np.sqrt((part**2).mean())),
                        }
                    )
    return out
