"""Readings of fz that are rounded more coarsely than the cell file states."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import ndtr

from palpd.cell.cell_file import CellFile
from palpd.recording.samples import Samples
from palpd.tick import Floats

Way = Literal["nearest", "down", "to zero"]
WAYS: tuple[Way, ...] = ("nearest", "down", "to zero")
"""How readings come to their levels: converters round to the nearest one or down, and integers in software cut towards zero."""

LEVELS = 3
"""Number of levels on either side of a force that its mean reading takes into account."""

LEAST_DITHER = 0.25
"""Least noise, in steps, with which a reading is predicted: neither the levels nor the force between them are known better."""


@dataclass(frozen=True)
class Rounding:
    """Readings of fz are `level_N` plus a multiple of `step_N`; `noise_rms_N` is the noise before the rounding, and `way` its kind."""

    step_N: float
    level_N: float
    noise_rms_N: float
    way: Way = "nearest"

    def mean(self, force_N: Floats) -> Floats:
        """Mean reading of a force with normal noise.

        Args:
            force_N: Forces without noise (n,).

        Returns:
            Mean readings (n,) in N.
        """
        if self.way == "nearest":
            return self._mean_of_nearest(force_N)
        down_N = self._mean_of_nearest(force_N - 0.5 * self.step_N)
        # Towards zero, a negative force comes to the next level above.
        return down_N if self.way == "down" else down_N + self.step_N * ndtr(-force_N / self._sigma_N)

    @property
    def _sigma_N(self) -> float:
        """Noise with which a reading is predicted."""
        return max(self.noise_rms_N, LEAST_DITHER * self.step_N)

    def _mean_of_nearest(self, force_N: Floats) -> Floats:
        sigma = self._sigma_N
        nearest = np.rint((force_N - self.level_N) / self.step_N)
        out = np.zeros_like(force_N)
        for k in range(-LEVELS, LEVELS + 1):
            level = (nearest + k) * self.step_N + self.level_N
            above = np.full_like(force_N, np.inf) if k == LEVELS else (level + 0.5 * self.step_N - force_N) / sigma
            below = np.full_like(force_N, -np.inf) if k == -LEVELS else (level - 0.5 * self.step_N - force_N) / sigma
            out += level * (ndtr(above) - ndtr(below))
        return out

    def slope(self, force_N: Floats) -> Floats:
        """Change of the mean reading per change of the force.

        Args:
            force_N: Forces without noise (n,).

        Returns:
            Slopes (n,), 1 where noise dithers the rounding.
        """
        h = 0.1 * self.step_N
        return (self.mean(force_N + h) - self.mean(force_N - h)) / (2.0 * h)


def undithered_rms(step: float, noise_rms: float) -> float:
    """Rms of the rounding error that averaging does not remove.

    Args:
        step: Rounding step, in the unit of the channel.
        noise_rms: Noise of a sample, rounding included, in the same unit.

    Returns:
        Rms in the same unit; 0 without rounding.
    """
    if step <= 0.0:
        return 0.0
    pure = np.sqrt(max(noise_rms**2 - step**2 / 12.0, 0.0))
    return float(step / np.sqrt(12.0) * np.exp(-2.0 * (np.pi * pure / step) ** 2))


def coarse_step_N(samples: Samples, cell: CellFile) -> float:
    """The usual distance between neighbouring values of fz.

    Args:
        samples: One recording.
        cell: Its cell file, with the stated step and noise.

    Returns:
        The step in N; 0 unless it is much coarser than stated.
    """
    values = np.unique(samples.wrench[:, 2])
    if len(values) < 3 or len(values) > 0.2 * len(samples):
        return 0.0
    gaps = np.diff(values)
    gaps = gaps[gaps > 1e-6 * np.ptp(values)]  # one level may have two values that differ in the last bits
    gap = float(np.median(gaps))
    gap = float(np.mean(gaps[gaps < 1.75 * gap]))  # readings that are also rounded to the stated step have gaps of two sizes
    stated = cell.sensor.resolution_fz_N
    if gap <= 1.4 * stated or gap <= 0.5 * cell.sensor.noise_rms_N:
        return 0.0
    # Over many levels a small error of the step shifts the last level by a whole step: take the step at which all values agree best.
    steps, values = gap * np.linspace(0.95, 1.05, 2001), values[:: 1 + len(values) // 500]
    return float(steps[np.argmax(np.abs(np.exp(2j * np.pi * values / steps[:, None]).sum(axis=1)))])


def rounding_of(recordings: Sequence[Samples], steps_N: Sequence[float], cell: CellFile) -> Rounding | None:
    """How fz is rounded; its levels follow from the mean of all values on the circle of one step.

    Args:
        recordings: The recordings as they were read.
        steps_N: Coarse step of each, 0 for none.
        cell: Their cell file.

    Returns:
        The rounding with the coarsest of the steps, or None without one.
    """
    step_N = max(steps_N)
    if step_N <= 0.0:
        return None
    turns = np.exp(2j * np.pi * np.concatenate([s.wrench[:, 2] for s in recordings]) / step_N)
    level_N = float(np.angle(turns.mean()) / (2.0 * np.pi) * step_N)
    return Rounding(step_N, level_N, cell.sensor.noise_rms_N)
