"""Effects that change only the scatter of the readings: more noise, a coarse step, held samples.

They do not take part in the search of hypotheses: their change has no mean to fit. They are tested on the readings themselves.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from palpd.cell.cell_file import CellFile
from palpd.cell.effects import Effect
from palpd.gap.assumptions import ASSUMED
from palpd.gap.data.cleaning import CleanedRecording
from palpd.gap.data.noise import FZ, pure_rms, resolutions
from palpd.gap.data.phases import FREE_STILL, HOLDING
from palpd.gap.data.prepare import PreparedRecording
from palpd.gap.data.rounding import noise_before_rounding
from palpd.tick import Floats

LEAST_NOISE_RATIO = 0.01
"""Least ratio of shown and stated noise: a smaller ratio counts as this, since its logarithm is used."""


@dataclass(frozen=True)
class ScatterEffect:
    """An effect of the scatter: how probable it is, and its parameters as (value, low, high)."""

    id: str
    probability: float
    parameters: dict[str, tuple[float, float, float]]


@dataclass(frozen=True)
class LoneAxis:
    """An axis that is noisier than the others and than its cell file says, which no listed effect makes.

    Attributes:
        channel: Its number, from 1 on.
        noise: Least noise of one of its readings before rounding, and the same as the cell file and the other axes say; in its unit.
    """

    channel: int
    probability: float
    noise: tuple[float, float]


@dataclass(frozen=True)
class Scatter:
    """The effects of the scatter that were seen, and the axis that is noisier than the others; None without two axes to compare."""

    effects: list[ScatterEffect]
    lone_axis: LoneAxis | None

    @property
    def p_lone_axis(self) -> float:
        """Probability that one axis alone is noisy."""
        return 0.0 if self.lone_axis is None else self.lone_axis.probability


def scatter_effects(
    recordings: Sequence[PreparedRecording], cleaned: Sequence[CleanedRecording], cell: CellFile, library: Mapping[str, Effect]
) -> Scatter:
    """Test the recordings for the library's effects of the scatter.

    Args:
        cleaned: The same recordings, and what cleaning removed from them.
        library: The effects that may be present, by id.
    """
    noise, lone_axis = _noise(recordings, cleaned, cell)
    seen = {"coarse step": _coarse_step(cleaned), "held samples": _held_samples(cleaned), "noise": noise}
    ids = {effect.scatter: effect.id for effect in library.values() if effect.id not in cell.effects}  # a known one is no gap
    effects = [ScatterEffect(ids[kind], *evidence) for kind, evidence in seen.items() if evidence is not None and kind in ids]
    return Scatter(effects, lone_axis)


Seen = tuple[float, dict[str, tuple[float, float, float]]]


def _coarse_step(cleaned: Sequence[CleanedRecording]) -> Seen | None:
    coarse_N = [its.coarse_step_N for its in cleaned if its.coarse_step_N > 0]
    if not coarse_N:
        return None
    step_N = float(np.median(coarse_N))
    return ASSUMED.scatter.p_seen, {"step_N": (step_N, 0.98 * step_N, 1.02 * step_N)}


def _held_samples(cleaned: Sequence[CleanedRecording]) -> Seen | None:
    stretches = sum(its.held_stretches for its in cleaned)
    if not stretches:
        return None
    length_s = sum(its.held_stretches * its.held_s for its in cleaned) / stretches
    step_s = float(np.median([1.0 / its.samples.rate_Hz for its in cleaned]))
    rate_Hz = stretches / sum(its.samples.duration_s for its in cleaned)
    spread = 1.96 / np.sqrt(stretches)
    return ASSUMED.scatter.p_seen, {
        "rate_Hz": (rate_Hz, rate_Hz * (1.0 - spread), rate_Hz * (1.0 + spread)),
        "length_s": (length_s, max(length_s * (1.0 - spread), 0.0), length_s * (1.0 + spread) + step_s),
    }


def _noise(
    recordings: Sequence[PreparedRecording], cleaned: Sequence[CleanedRecording], cell: CellFile
) -> tuple[Seen | None, LoneAxis | None]:
    """More noise on all axes (None where it is not larger), and the axis that is noisier than the others."""
    coarse = any(its.coarse_step_N > 0 for its in cleaned)
    steps, stated = resolutions(cell), pure_rms(cell)
    samples = sum(int(np.isin(recording.phases.phase, (FREE_STILL, HOLDING)).sum()) for recording in recordings)
    ranges, channels = [], []
    for channel in range(1, 7):
        if channel == FZ and coarse:
            continue
        noises = [
            noise_before_rounding(its.unclipped.wrench[:, channel - 1], recording.rest, float(steps[channel]))
            for recording, its in zip(recordings, cleaned, strict=True)
            if recording.judged[channel] and recording.noise_measured
        ]
        if noises and stated[channel] > 0:
            ranges.append(np.maximum(np.sqrt(np.mean(np.square(noises), axis=0)) / stated[channel], LEAST_NOISE_RATIO))
            channels.append(channel)
    if len(ranges) < 2:
        return None, None
    low, high = np.array(ranges).T
    axis_error = ASSUMED.scatter.axis_error / np.sqrt(max(samples, 30))
    weight = 1.0 / (np.log(high / low) + axis_error)  # an axis whose rounding hides its noise says little of that of the others
    ratio = _weighted_median(np.sqrt(low * high), weight)
    error = axis_error / np.sqrt(weight.sum() / weight.max())
    width = np.hypot(error, ASSUMED.scatter.ratio_error)
    probability = _sigmoid((np.log(ratio) - np.log(ASSUMED.scatter.healthy_ratio + ASSUMED.scatter.healthy_margin)) / width)
    # Rounding may hide how noisy an axis is: it is noisier than the others by no less than its readings say. A quiet axis is no gap.
    noisiest, expected = int(np.argmax(low)), max(ratio, 1.0)
    apart = float(np.log(low[noisiest] / expected))
    p_lone_axis = _sigmoid((apart - np.log(ASSUMED.scatter.lone_ratio)) / float(np.hypot(axis_error, ASSUMED.scatter.lone_error)))
    its_stated = float(stated[channels[noisiest]])
    lone_axis = LoneAxis(channels[noisiest], p_lone_axis, (float(low[noisiest]) * its_stated, expected * its_stated))
    if probability < 1e-3:
        return None, lone_axis
    # The cell's own noise, without the effect, may be anything within specification.
    off = ASSUMED.scatter.healthy_ratio * (1.0 + 2.5 * float(np.hypot(error, ASSUMED.scatter.uneven)))
    return (probability, {"ratio": (ratio, ratio / off, ratio * off)}), lone_axis


def _weighted_median(values: Floats, weight: Floats) -> float:
    order = np.argsort(values)
    share = np.cumsum(weight[order]) - 0.5 * weight[order]
    return float(np.interp(0.5 * weight.sum(), share, values[order]))


def _sigmoid(x: float) -> float:
    return float(1.0 / (1.0 + np.exp(-np.clip(x, -60.0, 60.0))))
