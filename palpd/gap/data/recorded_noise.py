"""Noise and resolution of a sensor as its recordings show them, for what the cell file does not state."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpd.cell.cell_file import CellFile
from palpd.cell.lattice import finest_step, lattice_step
from palpd.gap.assumptions import ASSUMED
from palpd.gap.data.noise import FX, FY, FZ, TX, TY, TZ
from palpd.gap.data.phases import FREE_STILL, HOLDING, find_phases
from palpd.gap.data.rounding import noise_before_rounding
from palpd.recording.oddities import dead, measured_rms
from palpd.recording.samples import Samples
from palpd.tick import Floats

NOISE = {"noise_rms_N": (FX, FY, FZ), "noise_rms_Nm": (TX, TY, TZ)}
RESOLUTION = {"resolution_fxy_N": (FX, FY), "resolution_fz_N": (FZ,), "resolution_Nm": (TX, TY, TZ)}
"""Channels whose noise or step a key of the cell file's sensor block states."""


def with_recorded_noise(recordings: Sequence[Samples], cell: CellFile) -> tuple[CellFile, list[str], list[str]]:
    """Take noise and resolution that a cell file does not state from the recordings.

    Returns:
        The cell with every value stated; a sentence for each value that is stated and far from the recorded one; a sentence with the
        recorded values, if there are any.
    """
    shown, stated = _shown(recordings, cell), cell.sensor.model_fields_set
    measured: dict[str, float] = {key: step for key, step in shown.steps.items() if key not in stated}
    far = []
    for key, (low, high) in shown.noise.items():
        rms, before = (low * high) ** 0.5, float(getattr(cell.sensor, key))
        if key not in stated:
            measured[key] = rms
        elif shown.resting and not low / ASSUMED.noise.far_from_stated <= before <= high * ASSUMED.noise.far_from_stated and before > 0.0:
            far.append(f"sensor.{key} is {before:.3g} and the recording shows {rms:.3g}, expected within a factor of 5; correct it.")
    if not measured:
        return cell, far, []
    values = ", ".join(f"{key} {value:.3g}" for key, value in measured.items())
    note = f"the cell file does not state all noise and resolution, so the recording's own count: {values}."
    return cell.model_copy(update={"sensor": cell.sensor.model_copy(update=measured)}), far, [note]


def with_healthy_sensor(recordings: Sequence[Samples], cell: CellFile) -> CellFile:
    """A healthy cell whose sensor is as noisy and as coarse as its recordings show.

    What its file states counts where it is larger, and where the cell never rests: noise of readings in motion is only estimated.
    """
    shown, stated = _shown(recordings, cell), cell.sensor.model_fields_set
    sensor = dict(shown.steps)
    sensor["resolution_fz_N"] = max(sensor["resolution_fz_N"], *(finest_step(samples.wrench[:, FZ - 1]) for samples in recordings))
    sensor |= {key: (low * high) ** 0.5 for key, (low, high) in shown.noise.items() if shown.resting or key not in stated}
    sensor = {key: max(value, getattr(cell.sensor, key) if key in stated else 0.0) for key, value in sensor.items()}
    return cell.model_copy(update={"sensor": cell.sensor.model_copy(update=sensor)})


class _Shown(NamedTuple):
    """Steps, least and largest noise of a reading by key of the sensor block, in its unit; and whether every recording rests somewhere."""

    steps: dict[str, float]
    noise: dict[str, tuple[float, float]]
    resting: bool


def _shown(recordings: Sequence[Samples], cell: CellFile) -> _Shown:
    """What recordings show of a sensor; noise is absent without a live axis."""
    rests = [_rests(find_phases(samples, cell).phase) for samples in recordings]
    ranges = ((key, _noise_range(recordings, rests, channels)) for key, channels in NOISE.items())
    noise = {key: pair for key, pair in ranges if pair is not None}
    steps = {key: _step(recordings, channels) for key, channels in RESOLUTION.items()}
    return _Shown(steps, noise, all(rest is not None for rest in rests))


def noise_of_fz_N(recordings: Sequence[Samples], cell: CellFile) -> float:
    """Noise of a sample of fz before its rounding, in N.

    The stated noise, brought into the range that the lateral axes show, whose steps are finer; as stated where these are noisier or quieter
    than healthy axes.
    """
    stated_N = cell.sensor.noise_rms_N
    rests = [_rests(find_phases(samples, cell).phase) for samples in recordings]
    low_N, high_N = _noise_range(recordings, rests, (FX, FY)) or (stated_N, stated_N)
    healthy = low_N / ASSUMED.noise.healthy_lateral_ratio <= stated_N <= high_N * ASSUMED.noise.healthy_lateral_ratio
    return min(max(stated_N, low_N), high_N) if healthy else stated_N


def _rests(phase: NDArray[np.int_]) -> NDArray[np.bool_] | None:
    """Samples at rest (n,) by their phases; None where there are too few to measure noise."""
    still = np.isin(phase, (FREE_STILL, HOLDING))
    return still if still.sum() >= ASSUMED.noise.fewest_at_rest else None


def _noise_range(
    recordings: Sequence[Samples], rests: Sequence[NDArray[np.bool_] | None], channels: tuple[int, ...]
) -> tuple[float, float] | None:
    """Least and largest noise of one sample before rounding, the medians over live axes and recordings; None without a live axis."""
    ranges = []
    for samples, rest in zip(recordings, rests, strict=True):
        for channel in channels:
            signal = samples.wrench[:, channel - 1]
            if not dead(signal) and len(np.unique(signal)) > 2:  # two levels show neither a step nor noise
                step, least = lattice_step(signal), 1e-9 * float(np.ptp(signal))
                low, high = (0.0, 0.0) if rest is None else noise_before_rounding(signal, rest, step)
                if high == 0.0:
                    square = (_quiet_rms(signal) if rest is None else measured_rms(signal, rest)) ** 2
                    low = high = max(square - step**2 / 12.0, 0.01 * square) ** 0.5
                ranges.append((max(low, least), max(high, least)))
    if not ranges:
        return None
    low, high = np.median(ranges, axis=0).tolist()
    return low, high


def _quiet_rms(values: Floats) -> float:
    """Rms of the white part of a signal that never rests, from the lower quartile of its second differences."""
    quartile = float(np.quantile(np.abs(np.diff(values, 2)), 0.25)) if len(values) > 2 else 0.0
    return quartile / (0.3186 * 6.0**0.5) or measured_rms(values)  # |x| < 0.3186 σ in a quarter of normal cases


def _step(recordings: Sequence[Samples], channels: tuple[int, ...]) -> float:
    """Finest step of the readings, in their unit; 0 if they are not rounded."""
    steps = [lattice_step(samples.wrench[:, channel - 1]) for samples in recordings for channel in channels]
    return min((step for step in steps if step > 0.0), default=0.0)
