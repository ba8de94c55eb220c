"""Effects that change only the scatter of the readings: more noise, a coarse step, held samples.

They do not take part in the search of hypotheses: their change has no mean to fit. They are tested on the readings themselves, before
these are cleaned of held samples and tails for the search.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import median_filter

from palpd.cell.cell_file import CellFile
from palpd.cell.effects import Effect
from palpd.gap.data.noise import FZ, declared_rms, held_runs, pure_rms, repeats, resolutions
from palpd.gap.data.phases import FREE_STILL, HOLDING
from palpd.gap.data.prepare import PreparedRecording
from palpd.gap.data.rounding import coarse_step_N, noise_before_rounding
from palpd.recording.oddities import dead, measured_rms
from palpd.recording.samples import Samples
from palpd.tick import Floats

HEALTHY_RATIO = 1.2
"""Noise up to this many times the stated noise is within specification."""

TAIL_SD, TAIL_WINDOW = 2.0, 5
"""A reading farther than this many sigmas from the median of this many neighbours lies in the tails."""

UNEVEN = 0.02
"""Share by which healthy noise varies within a recording."""

P_SEEN = 0.99
"""Probability of a coarse step or of held samples once they have been seen: chance alone makes neither."""

LEAST_NOISE_RATIO = 0.01
"""Least ratio of shown and stated noise: a smaller ratio counts as this, since its logarithm is used."""

LONE_RATIO = 1.45
"""Noise of one axis over that of the others above which something unknown acts on that axis."""


@dataclass(frozen=True)
class Readings:
    """One recording cleaned for the search of effects, and what the cleaning removed.

    Attributes:
        bridged: The recording with held samples interpolated.
        cleaned: `bridged` with heavy tails clipped where the noise is not healthy; else the same object.
        held_stretches: Number of stretches of held samples.
        held_s: Mean length of these.
        coarse_step_N: Step of fz, 0 unless it is much coarser than stated.
    """

    bridged: Samples
    cleaned: Samples
    held_stretches: int
    held_s: float
    coarse_step_N: float

    @property
    def excess_noise(self) -> bool:
        """Whether the noise was not healthy."""
        return self.cleaned is not self.bridged

    @staticmethod
    def of(samples: Samples, cell: CellFile) -> "Readings":
        """Clean a recording."""
        bridged, stretches, held_s = without_held(samples)
        return Readings(bridged, without_tails(bridged, cell), stretches, held_s, coarse_step_N(samples, cell))


@dataclass(frozen=True)
class ScatterEffect:
    """An effect of the scatter: how probable it is, and its parameters as (value, low, high)."""

    id: str
    probability: float
    parameters: dict[str, tuple[float, float, float]]


@dataclass(frozen=True)
class Scatter:
    """The effects of the scatter that were seen, and the probability that one axis alone is noisy, which no listed effect makes."""

    effects: list[ScatterEffect]
    p_lone_axis: float


def without_held(samples: Samples) -> tuple[Samples, int, float]:
    """Bridge rows that only repeat the row before, unless chance makes as many.

    Returns:
        The bridged recording, the number of stretches, and their mean length in s.
    """
    runs, length, chance = held_runs(samples)
    step_s = 1.0 / samples.rate_Hz
    if runs < 3 or runs * length < 4.0 * chance + 10.0:
        return samples, 0, 0.0
    same = np.concatenate([[False], repeats(samples.wrench).all(axis=1)])
    keep = ~same
    wrench = np.column_stack([np.interp(samples.t_s, samples.t_s[keep], samples.wrench[keep, k]) for k in range(6)])
    return replace(samples, wrench=wrench, held=same), runs, length * step_s


def without_tails(samples: Samples, cell: CellFile) -> Samples:
    """Clip readings that stand far out of their neighbours, where all axes are noisier than is healthy.

    Noise that is too large is seldom normal: its rare large values are the same noise and no pulses of something unknown. Where the
    noise is healthy, pulses are pulses.

    Returns:
        The clipped recording; the same object where the noise is healthy.
    """
    rms = np.array([0.0 if dead(axis) else measured_rms(axis) for axis in samples.wrench.T])
    stated = declared_rms(cell)[1:]
    live = (rms > 0.0) & (stated > 0.0)
    if live.sum() < 2 or np.median(rms[live] / stated[live]) < HEALTHY_RATIO:
        return samples
    usual = median_filter(samples.wrench, size=(TAIL_WINDOW, 1), mode="nearest")
    return replace(samples, wrench=usual + np.clip(samples.wrench - usual, -TAIL_SD * rms, TAIL_SD * rms))


def scatter_effects(
    recordings: Sequence[PreparedRecording], readings: Sequence[Readings], cell: CellFile, library: Mapping[str, Effect]
) -> Scatter:
    """Test the recordings for the library's effects of the scatter.

    Args:
        readings: The same recordings, as `Readings.of` cleaned them.
        library: The effects that may be present, by id.
    """
    noise, p_lone_axis = _noise(recordings, readings, cell)
    seen = {"coarse step": _coarse_step(readings), "held samples": _held_samples(readings), "noise": noise}
    ids = {effect.scatter: effect.id for effect in library.values()}
    effects = [ScatterEffect(ids[kind], *evidence) for kind, evidence in seen.items() if evidence is not None and kind in ids]
    return Scatter(effects, p_lone_axis)


Seen = tuple[float, dict[str, tuple[float, float, float]]]


def _coarse_step(readings: Sequence[Readings]) -> Seen | None:
    coarse = [one.coarse_step_N for one in readings if one.coarse_step_N > 0]
    if not coarse:
        return None
    step = float(np.median(coarse))
    return P_SEEN, {"step_N": (step, 0.98 * step, 1.02 * step)}


def _held_samples(readings: Sequence[Readings]) -> Seen | None:
    stretches = sum(one.held_stretches for one in readings)
    if not stretches:
        return None
    duration_s = sum(one.bridged.duration_s for one in readings)
    length_s = sum(one.held_stretches * one.held_s for one in readings) / stretches
    step_s = float(np.median([1.0 / one.bridged.rate_Hz for one in readings]))
    rate_Hz = stretches / duration_s
    spread = 1.96 / np.sqrt(stretches)
    return P_SEEN, {
        "rate_Hz": (rate_Hz, rate_Hz * (1.0 - spread), rate_Hz * (1.0 + spread)),
        "length_s": (length_s, max(length_s * (1.0 - spread), 0.0), length_s * (1.0 + spread) + step_s),
    }


def _noise(recordings: Sequence[PreparedRecording], readings: Sequence[Readings], cell: CellFile) -> tuple[Seen | None, float]:
    """More noise on all axes (None where it is not larger), and the probability that one axis alone is noisy."""
    coarse = any(one.coarse_step_N > 0 for one in readings)
    steps = resolutions(cell)
    stated = pure_rms(cell)
    samples = sum(int(np.isin(one.phases.phase, (FREE_STILL, HOLDING)).sum()) for one in recordings)
    ranges = []
    for channel in range(1, 7):
        if channel == FZ and coarse:
            continue
        noises = [
            noise_before_rounding(reading.bridged.wrench[:, channel - 1], one.rest, float(steps[channel]))
            for one, reading in zip(recordings, readings, strict=True)
            if one.judged[channel] and one.noise_measured
        ]
        if noises and stated[channel] > 0:
            ranges.append(np.maximum(np.sqrt(np.mean(np.square(noises), axis=0)) / stated[channel], LEAST_NOISE_RATIO))
    if len(ranges) < 2:
        return None, 0.0
    low, high = np.array(ranges).T
    axis_error = 1.3 / np.sqrt(max(samples, 30))
    weight = 1.0 / (np.log(high / low) + axis_error)  # an axis whose rounding hides its noise says little of that of the others
    ratio = _weighted_median(np.sqrt(low * high), weight)
    error = axis_error / np.sqrt(weight.sum() / weight.max())
    width = np.hypot(error, 0.02)
    probability = _sigmoid((np.log(ratio) - np.log(HEALTHY_RATIO + 0.06)) / width)
    # Rounding may hide how noisy an axis is: it differs from the others by no less than its readings say.
    spread = float(np.max(np.abs(np.log(np.clip(ratio, low, high) / ratio))))
    p_lone_axis = _sigmoid((spread - np.log(LONE_RATIO)) / float(np.hypot(axis_error, 0.04)))
    if probability < 1e-3:
        return None, p_lone_axis
    # The cell's own noise, without the effect, may be anything within specification.
    off = HEALTHY_RATIO * (1.0 + 2.5 * float(np.hypot(error, UNEVEN)))
    return (probability, {"ratio": (ratio, ratio / off, ratio * off)}), p_lone_axis


def _weighted_median(values: Floats, weight: Floats) -> float:
    order = np.argsort(values)
    share = np.cumsum(weight[order]) - 0.5 * weight[order]
    return float(np.interp(0.5 * weight.sum(), share, values[order]))


def _sigmoid(x: float) -> float:
    return float(1.0 / (1.0 + np.exp(-np.clip(x, -60.0, 60.0))))
