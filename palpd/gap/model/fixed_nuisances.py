"""Columns of A that do not depend on the state of the cell: zeros, errors of the controller, rounding. They are computed once a problem."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np

from palpd.cell.cell_file import CROSSTALK_ARM_M, CellFile
from palpd.gap.assumptions import ASSUMED
from palpd.gap.data.noise import FX, FZ, TX, Z
from palpd.gap.data.prepare import PreparedRecording
from palpd.gap.data.rounding import Rounding
from palpd.gap.gaussian.nuisances import ColumnByChannel, Columns
from palpd.gap.gaussian.whitening import Whitening
from palpd.gap.model.rounding_error import rounding_error
from palpd.gap.model.servo_error import ServoErrors
from palpd.tick import Floats

FELT_SHARE = 0.02
"""Force over the largest of the presses above which tissue below the stated surface pushes the probe."""


class Column(NamedTuple):
    """What a column of A stands for: a deviation of the cell, of a recording or of a press, or an error of the computation.

    Attributes:
        name: The key of its tolerance, such as `bias_N`, or what is uncertain, such as `hidden delay`.
        channel: The only channel that it changes; -1 where it may change several.
    """

    scope: Literal["cell", "recording", "press", "computation"]
    name: str
    channel: int = -1


@dataclass(frozen=True)
class FixedNuisances:
    """Whitened columns of A (m, 7, b), and what each stands for."""

    labels: tuple[Column, ...]
    columns: Columns


def fixed_nuisances(
    cell: CellFile,
    recordings: Sequence[PreparedRecording],
    rounding: Rounding | None,
    errors: Sequence[ServoErrors],
    noise: Whitening,
    force_N: Floats,
) -> FixedNuisances:
    """The nuisances of all recordings that no state of the cell changes.

    Args:
        cell: The nominal cell.
        recordings: Its recordings, b bins in all.
        rounding: Of fz; None where noise dithers it.
        errors: What the controller of each recording may change within specification.
        noise: Noise of the bins.
        force_N: Predicted fz (b,) of the nominal cell.
    """
    labels, columns = [], []
    for number, (recording, bins) in enumerate(zip(recordings, bins_of(recordings), strict=True)):
        for label, values in _of_recording(cell, recording, rounding, errors[number], force_N[bins], noise.sigma[FZ, bins]):
            labels.append(label)
            columns.append(whitened_column(noise, label.channel, bins, values))
    return FixedNuisances(tuple(labels), Columns.of(columns, noise.sigma.shape))


def bins_of(recordings: Sequence[PreparedRecording]) -> list[slice]:
    """The bins of each recording among those of all recordings."""
    ends = np.cumsum([0, *(len(recording.bins) for recording in recordings)]).tolist()
    return [slice(begin, end) for begin, end in pairwise(ends)]


def whitened_column(noise: Whitening, channel: int, bins: slice, values: Floats) -> ColumnByChannel:
    """A column (b,) of A that changes one channel in some bins.

    Args:
        values: The change in these bins (m,), in the unit of the channel.
    """
    column = np.zeros(noise.sigma.shape[1])
    column[bins] = values
    return {channel: noise.whiten_channel(channel, column)}


def _of_recording(
    cell: CellFile, recording: PreparedRecording, rounding: Rounding | None, errors: ServoErrors, force_N: Floats, sigma_N: Floats
) -> Iterator[tuple[Column, Floats]]:
    for channel in range(FX, 7):
        if recording.judged[channel]:
            yield from _zero_columns(cell, recording, channel)
    for name, change_m in errors.heights_m.items():
        yield Column("computation", name, Z), change_m
    for name, change_N in errors.inertial_N.items() if recording.judged[FZ] else ():
        yield Column("computation", name, FZ), change_N
    if rounding is not None and recording.judged[FZ]:
        for values in rounding_error(recording, rounding, force_N, sigma_N):
            yield Column("recording", "rounding", FZ), values
    if recording.judged[FZ] and recording.phases.press[0] >= 0:
        for values in _relaxation_before(recording):
            yield Column("computation", "relaxation before the start", FZ), values


def _relaxation_before(recording: PreparedRecording) -> Iterator[Floats]:
    """Forces (b,) that still relax from before the first row, one for each time constant, where the probe touches the tissue.

    Laws with memory start settled. A recording that starts in contact does not say for how long the tissue was pressed before; what its
    Maxwell arms carried then decays by itself. It shows whenever the probe touches, as long as there is a force: tissue that is left
    behind cannot pull.
    """
    fz_N = recording.measured[FZ]
    largest_N = float(fz_N[recording.bin_press >= 0].max(initial=0.0))
    touching = recording.bins.mean((recording.phases.depth_m > 0.0).astype(float)) * (fz_N > FELT_SHARE * largest_N)
    for tau_s in ASSUMED.noise.relaxing_s:
        yield ASSUMED.noise.relaxing_share * largest_N * touching * np.exp(-recording.t_s / tau_s)


def torque_arm_m(cell: CellFile) -> float:
    """Tolerated torque over tolerated force: 0.05 m, and in proportion more on a probe that is longer than 0.08 m."""
    return max(CROSSTALK_ARM_M, CROSSTALK_ARM_M / 0.08 * cell.probe.tip_length_m)


def _zero_columns(cell: CellFile, recording: PreparedRecording, channel: int) -> Iterator[tuple[Column, Floats]]:
    """Bias and drift of an axis."""
    arm = 1.0 if channel < TX else torque_arm_m(cell)
    yield Column("recording", "bias_N", channel), arm * cell.tolerances.bias_N * np.ones(len(recording.bins))
    yield Column("recording", "drift_N_per_min", channel), arm * cell.tolerances.drift_N_per_min / 60.0 * recording.t_s
