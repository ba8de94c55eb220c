"""Readings as the search of effects sees them: without rounding of heights at rest, held samples, and the tails of excess noise."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import median_filter

from palpd.cell.cell_file import CellFile
from palpd.gap.assumptions import ASSUMED
from palpd.gap.data.noise import declared_rms, held_runs
from palpd.gap.data.phases import ROUNDING
from palpd.gap.data.rounding import coarse_step_N
from palpd.recording.oddities import dead, measured_rms
from palpd.recording.samples import Samples


@dataclass(frozen=True)
class CleanedRecording:
    """A recording cleaned for the search of effects, and what the cleaning removed.

    Attributes:
        samples: Held samples are interpolated, and heavy tails are clipped where the noise is not healthy.
        unclipped: The same before tails were clipped; the same object where the noise is healthy.
        held_stretches: Number of stretches of held samples.
        held_s: Mean length of these.
        coarse_step_N: Step of fz, 0 unless it is much coarser than stated.
    """

    samples: Samples
    unclipped: Samples
    held_stretches: int
    held_s: float
    coarse_step_N: float


def clean(samples: Samples, cell: CellFile) -> CleanedRecording:
    """Clean a recording."""
    unclipped, stretches, held_s = without_held(samples)
    return CleanedRecording(without_tails(unclipped, cell), unclipped, stretches, held_s, coarse_step_N(samples, cell))


def without_rounding(samples: Samples) -> Samples:
    """Take rounding out of heights that stand still, so that it is not taken for motion.

    Returns:
        The recording, its heights and speeds constant where only rounding changes them.
    """
    least_m = ROUNDING * float(np.abs(samples.z_m).max())
    still_m, z_cmd_m = float(samples.z_m[0]), samples.z_cmd_m
    if float(np.ptp(samples.z_m)) > least_m:
        return samples
    if z_cmd_m is not None and float(np.ptp(z_cmd_m)) <= least_m:
        z_cmd_m = np.full_like(z_cmd_m, z_cmd_m[0])
    resting = float(np.abs(samples.vz_m_per_s).max()) <= least_m * samples.rate_Hz
    speeds = np.zeros_like(samples.vz_m_per_s) if resting else samples.vz_m_per_s
    return replace(samples, z_m=np.full_like(samples.z_m, still_m), z_cmd_m=z_cmd_m, vz_m_per_s=speeds)


def without_held(samples: Samples) -> tuple[Samples, int, float]:
    """Bridge rows that only repeat the row before, unless chance makes as many.

    Returns:
        The bridged recording, the number of stretches, and their mean length in s.
    """
    first, end, p_chance = held_runs(samples)
    a, rows, lengths = ASSUMED.scatter, len(samples) - 1, end - first
    if len(first) < a.fewest_held_runs or lengths.sum() < a.held_chance_ratio * p_chance * rows + a.fewest_held_rows:
        # Chance makes many short stretches where steps are coarse, and hardly a long one. One alone may be the end of a file, and one axis
        # alone may be at its limit.
        long = rows * min(a.held_chance_ratio * p_chance, 1.0) ** lengths < a.p_long_run
        first, end, lengths = first[long], end[long], lengths[long]
        one_axis = sum(not dead(axis) for axis in samples.wrench.T) < 2
        if len(first) < 2 or lengths.sum() < a.fewest_held_rows or one_axis:
            return samples, 0, 0.0
    same = np.zeros(len(samples), dtype=bool)
    for a_run, b_run in zip(first, end, strict=True):
        same[a_run + 1 : b_run + 1] = True
    keep = ~same
    wrench = np.column_stack([np.interp(samples.t_s, samples.t_s[keep], samples.wrench[keep, k]) for k in range(6)])
    return replace(samples, wrench=wrench, held=same), len(first), float(lengths.mean()) / samples.rate_Hz


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
    if live.sum() < 2 or np.median(rms[live] / stated[live]) < ASSUMED.scatter.healthy_ratio:
        return samples
    usual = median_filter(samples.wrench, size=(ASSUMED.scatter.tail_window, 1), mode="nearest")
    return replace(samples, wrench=usual + np.clip(samples.wrench - usual, -ASSUMED.scatter.tail_sd * rms, ASSUMED.scatter.tail_sd * rms))
