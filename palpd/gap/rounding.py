"""Readings of fz that noise does not dither: rounded more coarsely than the cell file states, or than their noise is large."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.special import ndtr

from palpd.cell.cell_file import CellFile
from palpd.recording.samples import Samples
from palpd.tick import Floats

Way = Literal["nearest", "down", "to zero"]
WAYS: tuple[Way, ...] = ("nearest", "down", "to zero")
"""How readings come to their levels: converters round to the nearest one or down, and integers in software cut towards zero."""

DITHERED = 0.36
"""Noise, in steps, from which on the mean reading follows the force within a sixth, and by less than 3 % of a step."""

REACH = 1.5
"""Steps up to which the force is that of the probe alone, in the air."""

LEAST_DITHER = 0.25
"""Least noise, in steps, with which a reading is predicted: neither the levels nor the force between them are known better."""


@dataclass(frozen=True)
class Rounding:
    """Readings of fz are `level_N` plus a multiple of `step_N`; `noise_rms_N` is the noise before the rounding, and `way` its kind."""

    step_N: float
    level_N: float
    noise_rms_N: float
    way: Way = "nearest"
    reach_N: float = np.inf
    """Largest force that is predicted to a fraction of a step. Beyond, tolerances decide on which side of a level it lies."""

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

    def force_N(self, reading_N: float) -> float:
        """The force whose mean reading this is.

        Args:
            reading_N: A mean of readings.

        Returns:
            The force in N.
        """
        forces_N = reading_N + self.step_N * np.linspace(-1.0, 1.0, 2001)
        return float(forces_N[np.argmin(np.abs(self.mean(forces_N) - reading_N))])

    @property
    def _sigma_N(self) -> float:
        """Noise with which a reading is predicted."""
        return max(self.noise_rms_N, LEAST_DITHER * self.step_N)

    def _mean_of_nearest(self, force_N: Floats) -> Floats:
        turn = 2.0 * np.pi / self.step_N * (force_N - self.level_N)
        damping = float(np.exp(-2.0 * (np.pi * self._sigma_N / self.step_N) ** 2))
        # Fourier series of a dithered quantiser's mean (Widrow and Kollár 2008, ch. 19): sin(k turn) (-1)^k / k; two terms are enough.
        moved = self.step_N / np.pi * damping * np.sin(turn) * (damping**3 * np.cos(turn) - 1.0)
        return np.asarray(force_N + np.where(np.abs(force_N) <= self.reach_N, moved, 0.0))

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


def rounding_of(
    recordings: Sequence[Samples], steps_N: Sequence[float], cell: CellFile, noise_rms_N: float, free_N: float
) -> Rounding | None:
    """How fz is rounded; its levels follow from the mean of all values on the circle of one step.

    Args:
        recordings: The recordings as they were read.
        steps_N: Coarse step of each, 0 for none.
        cell: Their cell file.
        noise_rms_N: Noise of a sample before rounding.
        free_N: Mean reading of fz at rest in the air, where the cell predicts no force.

    Returns:
        The rounding with the coarsest of the steps, its levels as forces above those at rest; None where noise dithers the stated step.
    """
    coarse_N = max(steps_N)
    step_N = coarse_N or cell.sensor.resolution_fz_N
    if noise_rms_N >= DITHERED * step_N:
        return None
    turns = np.exp(2j * np.pi * np.concatenate([s.wrench[:, 2] for s in recordings]) / step_N)
    level_N = float(np.angle(turns.mean()) / (2.0 * np.pi) * step_N)
    rounding = Rounding(step_N, level_N, noise_rms_N)
    reach_N = np.inf if coarse_N else REACH * step_N
    return replace(rounding, level_N=level_N - rounding.force_N(free_N), reach_N=reach_N)
