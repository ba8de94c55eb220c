"""Effects that leave the mean of the readings alone and change their scatter: noise, a coarse step, held samples."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import median_filter

from palpd.cell_file import CellFile
from palpd.gap.noise import FZ, dead, declared_rms, held_runs, measured_rms, resolutions
from palpd.gap.problem import Rounding, Run
from palpd.samples import Samples

HEALTHY_RATIO = 1.2
"""Noise up to this much above the stated is within specification."""

TAIL, TAIL_WINDOW = 2.0, 5
"""Beyond so many sigmas from the median of so many neighbours a reading is out in the tails."""

UNEVEN = 0.02
"""Noise is not the same to better than this share throughout a recording."""


@dataclass(frozen=True)
class ScatterEffect:
    """An effect of the scatter: how probable it is, and its parameters as (value, low, high)."""

    id: str
    probability: float
    parameters: dict[str, tuple[float, float, float]]


def _sigmoid(x: float) -> float:
    return float(1.0 / (1.0 + np.exp(-np.clip(x, -60.0, 60.0))))


def coarse_step_N(samples: Samples, cell: CellFile) -> float:
    """The usual distance between neighbouring values of fz, 0 unless far coarser than what is stated."""
    values = np.unique(samples.wrench[:, 2])
    if len(values) < 3 or len(values) > 0.2 * len(samples):
        return 0.0
    gaps = np.diff(values)
    gap = float(np.median(gaps))
    gap = float(np.mean(gaps[gaps < 1.75 * gap]))  # what is also rounded to the stated step has gaps of two kinds
    stated = cell.sensor.resolution_fz_N
    if gap <= 1.4 * stated or gap <= 0.5 * cell.sensor.noise_rms_N:
        return 0.0
    # Over many levels a small error of the step would shift the last by a whole one: the step is where all values agree best.
    steps, values = gap * np.linspace(0.95, 1.05, 2001), values[:: 1 + len(values) // 500]
    return float(steps[np.argmax(np.abs(np.exp(2j * np.pi * values / steps[:, None]).sum(axis=1)))])


def rounding_of(recordings: Sequence[Samples], steps_N: Sequence[float], cell: CellFile) -> Rounding | None:
    """How fz is rounded, by the coarse step of each recording. Its levels: the mean of all values on the circle of one step."""
    step_N = max(steps_N)
    if step_N <= 0.0:
        return None
    turns = np.exp(2j * np.pi * np.concatenate([s.wrench[:, 2] for s in recordings]) / step_N)
    level_N = float(np.angle(turns.mean()) / (2.0 * np.pi) * step_N)
    return Rounding(step_N, level_N, cell.sensor.noise_rms_N)


def without_held(samples: Samples) -> tuple[Samples, int, float]:
    """The recording with rows that only repeat the last one bridged; how many such stretches, and their mean length in s.
    Unchanged where repeats are no more than chance."""
    runs, length, chance = held_runs(samples)
    step_s = 1.0 / samples.rate_Hz
    if runs < 3 or runs * length < 4.0 * chance + 10.0:
        return samples, 0, 0.0
    same = np.concatenate([[False], (samples.wrench[1:] == samples.wrench[:-1]).all(axis=1)])
    keep = ~same
    wrench = np.column_stack([np.interp(samples.t_s, samples.t_s[keep], samples.wrench[keep, k]) for k in range(6)])
    return replace(samples, wrench=wrench, held=same), runs, length * step_s


def without_tails(samples: Samples, cell: CellFile) -> Samples:
    """Where all axes are noisier than is healthy: the recording with readings that stand far out of their neighbours brought nearer.

    Noise that is too large is seldom normal. What is rare and large in it would be taken for pulses of something unknown, but is the
    same noise; where the noise is healthy, pulses are pulses.
    """
    rms = np.array([0.0 if dead(axis) else measured_rms(axis) for axis in samples.wrench.T])
    stated = declared_rms(cell)[1:]
    live = (rms > 0.0) & (stated > 0.0)
    if live.sum() < 2 or np.median(rms[live] / stated[live]) < HEALTHY_RATIO:
        return samples
    usual = median_filter(samples.wrench, size=(TAIL_WINDOW, 1), mode="nearest")
    return replace(samples, wrench=usual + np.clip(samples.wrench - usual, -TAIL * rms, TAIL * rms))


def scatter_effects(
    runs: Sequence[Run], bridged: Sequence[Samples], steps_N: Sequence[float], cell: CellFile, held: Sequence[tuple[int, float]]
) -> tuple[list[ScatterEffect], float]:
    """The scatter's effects, and the probability that the noise is wrong in a way that is none of them (one axis only)."""
    out = []
    coarse = [step for step in steps_N if step > 0]
    if coarse:
        step = float(np.median(coarse))
        out.append(ScatterEffect("sensor.quantization", 0.99, {"step_N": (step, 0.98 * step, 1.02 * step)}))
    stretches = sum(count for count, _ in held)
    if stretches:
        duration_s = sum(s.duration_s for s in bridged)
        length_s = sum(count * length for count, length in held) / stretches
        step_s = float(np.median([1.0 / s.rate_Hz for s in bridged]))
        rate_Hz = stretches / duration_s
        spread = 1.96 / np.sqrt(stretches)
        out.append(
            ScatterEffect(
                "sensor.dropout",
                0.99,
                {
                    "rate_Hz": (rate_Hz, rate_Hz * (1.0 - spread), rate_Hz * (1.0 + spread)),
                    "length_s": (length_s, max(length_s * (1.0 - spread), 0.0), length_s * (1.0 + spread) + step_s),
                },
            )
        )
    noise, other = _noise(runs, bridged, cell, bool(coarse))
    if noise is not None:
        out.append(noise)
    return out, other


def _noise(runs: Sequence[Run], bridged: Sequence[Samples], cell: CellFile, coarse: bool) -> tuple[ScatterEffect | None, float]:
    declared = declared_rms(cell)
    rounding = resolutions(cell) ** 2 / 12.0
    stated = np.sqrt(np.maximum(declared**2 - rounding, 0.0))
    ratios, errors = [], []
    for channel in range(1, 7):
        if channel == FZ and coarse:
            continue
        squares = [
            measured_rms(samples.wrench[:, channel - 1], run.rest) ** 2
            for run, samples in zip(runs, bridged, strict=True)
            if run.judged[channel] and run.noise_measured
        ]
        if not squares or stated[channel] <= 0:
            continue
        pure = np.sqrt(max(float(np.mean(squares)) - rounding[channel], 1e-4 * stated[channel] ** 2))
        samples = sum(int(np.isin(r.phases.phase, (0, 3)).sum()) for r in runs)
        ratios.append(float(pure / stated[channel]))
        errors.append(1.3 / np.sqrt(max(samples, 30)))
    if len(ratios) < 2:
        return None, 0.0
    ratio, error = float(np.median(ratios)), float(np.median(errors)) / np.sqrt(len(ratios))
    width = np.hypot(error, 0.02)
    probability = _sigmoid((np.log(ratio) - np.log(HEALTHY_RATIO + 0.06)) / width)
    spread = float(np.max(np.abs(np.log(np.array(ratios) / ratio))))
    lone = _sigmoid((spread - np.log(1.45)) / float(np.hypot(np.median(errors), 0.04)))
    if probability < 1e-3:
        return None, lone
    # The cell's own noise, without the effect, may be anything that is within specification.
    off = HEALTHY_RATIO * (1.0 + 2.5 * float(np.hypot(error, UNEVEN)))
    return ScatterEffect("sensor.noise", probability, {"ratio": (ratio, ratio / off, ratio * off)}), lone
