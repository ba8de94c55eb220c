"""Recordings of the arena as columns: height and force of an axis, or angle and torque of a joint."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpd import api

Floats = NDArray[np.float64]
Columns = Mapping[str, Floats]


JOINT = {"angle_cmd_rad": "z_cmd_m", "angle_rad": "z_m", "speed_rad_per_s": "vz_m_per_s", "torque_Nm": "fz_N"}
"""Columns of a joint by those of an axis that tools other than palpd are given in their place."""


def load(path: Path) -> dict[str, Floats]:
    """The columns (n,) of a recording by their names; an angle stands as z_m, a torque as fz_N. Raises RecordingError."""
    columns = api.import_file(path, accept_implausible=True).columns
    return {JOINT.get(name, name): values for name, values in columns.items()}


@dataclass(frozen=True)
class Healthy:
    """What a healthy rig does: its mean force by height and direction, and how far the force usually is from it.

    Attributes:
        heights: Centres of the bins (k,), in m or rad.
        force: Mean force (2, k) while it moves down or rests, and while it moves up, in N or Nm; NaN where nothing was recorded.
        rms_N: Rms of the residual; in Nm for a joint.
    """

    heights: Floats
    force: Floats
    rms_N: float

    @staticmethod
    def of(recordings: Sequence[Columns], bins: int = 60) -> "Healthy":
        """Learn from healthy recordings."""
        z, up, fz = (np.concatenate([part(each) for each in recordings]) for part in (lambda r: r["z_m"], upwards, lambda r: r["fz_N"]))
        edges = np.linspace(z.min(), z.max(), bins + 1)
        at = np.clip(np.digitize(z, edges) - 1, 0, bins - 1) + bins * up
        count, total = np.bincount(at, minlength=2 * bins), np.bincount(at, fz, minlength=2 * bins)
        force = np.where(count > 0, total / np.maximum(count, 1), np.nan)
        learned = Healthy(0.5 * (edges[1:] + edges[:-1]), force.reshape(2, bins), 1.0)
        left = np.concatenate([learned.residual(each) for each in recordings])
        return Healthy(learned.heights, learned.force, float(np.sqrt(np.nanmean(left**2))))

    def residual(self, recording: Columns) -> Floats:
        """Force less that of the healthy rig (n,); NaN beyond what it did."""
        step = self.heights[1] - self.heights[0]
        at = np.round((recording["z_m"] - self.heights[0]) / step).astype(int)
        inside = (at >= 0) & (at < len(self.heights))
        mean = self.force[upwards(recording).astype(int), np.clip(at, 0, len(self.heights) - 1)]
        return np.where(inside, recording["fz_N"] - mean, np.nan)


def upwards(recording: Columns) -> NDArray[np.int64]:
    """1 where the height grows, 0 elsewhere (n,)."""
    return (recording["vz_m_per_s"] > 0.0).astype(np.int64)
