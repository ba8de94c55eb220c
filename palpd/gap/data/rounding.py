"""Readings of fz that noise does not dither: their steps are coarser than the cell file states, or large against their noise."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from palpd.cell.cell_file import CellFile
from palpd.cell.lattice import gaps_between
from palpd.gap.assumptions import ASSUMED
from palpd.gap.data.noise import pure_rms, resolutions
from palpd.recording.oddities import measured_rms
from palpd.recording.samples import Samples
from palpd.tick import Floats

FARTHEST = 7.0
"""Standard deviations of the noise beyond which no reading comes to a level."""

NOISES = np.geomspace(0.02, 0.7, 42)
"""Candidates for the noise of rounded readings before the rounding, in steps."""

STRETCH = 100
"""Number of readings of a rest that share a mean: over a longer time a force that creeps changes it."""


def rounded_moments(force: Floats, noise_rms: float) -> tuple[Floats, Floats]:
    """Mean and variance of a force with normal noise after it was rounded to whole numbers.

    A reading is level `k` or a higher one where force and noise reach the edge of that level, so both moments are short sums over the
    edges near the force.

    Args:
        force: Forces without noise (n,), in steps from a level.
        noise_rms: Noise before the rounding, in steps.

    Returns:
        Means (n,) in steps, and variances (n,) in squared steps.
    """
    nearest, sigma = np.rint(force), max(noise_rms, 1e-9)
    mean, square = np.zeros_like(nearest), np.zeros_like(nearest)
    for k in range(1, int(FARTHEST * sigma + 1.5) + 1):
        above = ndtr((force - (nearest + k - 0.5)) / sigma)
        below = ndtr(((nearest + 0.5 - k) - force) / sigma)
        mean += above - below
        square += (2 * k - 1) * (above + below)
    return nearest + mean, square - mean**2


def sawtooth(step: float, noise_rms: float) -> Floats:
    """Amplitudes (h,) of the harmonics of the mean error of rounding over the force, q/(πk) e^(-2(πkσ/q)²) for k from 1.

    Args:
        step: Rounding step q, in the unit of the channel.
        noise_rms: Noise σ before the rounding, in the same unit.
    """
    k = np.arange(1, ASSUMED.rounding.most_harmonics + 1)
    return np.asarray(step / (np.pi * k) * np.exp(-2.0 * (np.pi * k * noise_rms / step) ** 2))


@dataclass(frozen=True)
class Rounding:
    """How fz is rounded.

    Attributes:
        step_N: Distance of the levels.
        noise_rms_N: Noise before the rounding.
        coarse: The step is much coarser than the cell file states, so nobody knows how readings come to their levels either.
    """

    step_N: float
    noise_rms_N: float
    coarse: bool

    @property
    def undithered_rms_N(self) -> float:
        """Rms of the rounding error that averaging does not remove, over all forces."""
        return undithered_rms(self.step_N, self.noise_rms_N)

    @property
    def harmonics_N(self) -> Floats:
        """Standard deviations (h,) of the sine and the cosine of each harmonic of the error, over all forces; small ones are left out."""
        sizes_N = sawtooth(self.step_N, self.noise_rms_N) / 2.0**0.5
        return np.asarray(sizes_N[sizes_N > ASSUMED.rounding.least_harmonic * sizes_N[0]])


def noise_before_rounding(values: Floats, at_rest: NDArray[np.bool_], step: float) -> tuple[float, float]:
    """Find the range of noise before the rounding that readings at rest allow.

    A reading that rests in the middle of a level varies less than its noise, and one that rests between two levels varies more. So the
    variance is compared with that of a rounded normal number at the mean reading of each short stretch of rest. Where only two levels
    occur, any smaller noise gives the same readings: the range is then wide.

    Args:
        values: The readings of one axis (n,).
        at_rest: Which of them rest (n,).
        step: Step to which they are rounded; 0 for none.

    Returns:
        Least and largest noise (rms) in the unit of the readings; both 0 where too few rest.
    """
    rms = measured_rms(values, at_rest)
    if rms >= ASSUMED.rounding.even_rms_steps * step:
        pure = max(rms**2 - step**2 / 12.0, 0.0) ** 0.5
        return pure, pure
    inner = np.flatnonzero(at_rest[2:] & at_rest[1:-1] & at_rest[:-2]) + 1
    if len(inner) < STRETCH:
        return 0.0, 0.0
    readings = values / step
    squares = (
        np.clip(
            readings[inner + 1] - 2.0 * readings[inner] + readings[inner - 1],
            -ASSUMED.rounding.largest_jump_steps,
            ASSUMED.rounding.largest_jump_steps,
        )
        ** 2
        / 6.0
    )
    # Neighbours share two of three readings; noise may reach a level twice that was never seen; the mean of a stretch is noisy.
    square = float(squares.mean())
    error = float(np.linalg.norm([2.0 * squares.std() * (3.0 / len(inner)) ** 0.5, 2.0 / len(inner), square / STRETCH]))
    begin = np.flatnonzero(np.diff(inner, prepend=-2) > 1)
    begin = np.concatenate([np.arange(a, b, STRETCH) for a, b in pairwise([*begin.tolist(), len(inner)])])
    count = np.diff(begin, append=len(inner))
    mean = np.add.reduceat(readings[inner], begin) / count - np.angle(np.exp(2j * np.pi * readings[inner]).mean()) / (2.0 * np.pi)
    apart = np.abs(mean - np.rint(mean))
    force = np.linspace(0.0, 0.5, 101)
    expected = []
    for noise in NOISES:
        mean_there, variance = rounded_moments(force, noise)
        # as of any sample, the variance at the mean of a stretch is too small by one part in its number of readings
        expected.append(float(count @ np.interp(apart, mean_there, variance) / max(float((count - 1).sum()), 1.0)))
    expected_there = np.maximum.accumulate(expected) + 1e-9 * np.arange(len(NOISES))
    low, high = np.interp([square - error, square + error], expected_there, NOISES).tolist()
    return low * step, high * step


def undithered(cell: CellFile) -> NDArray[np.bool_]:
    """Channels (7,) whose stated noise does not dither their stated step."""
    return np.asarray(pure_rms(cell) < ASSUMED.rounding.dithered_steps * resolutions(cell))


def undithered_rms(step: float, noise_rms: float) -> float:
    """Rms of the rounding error that averaging does not remove.

    Args:
        step: Rounding step, in the unit of the channel.
        noise_rms: Noise before the rounding, in the same unit.

    Returns:
        Rms in the same unit; 0 without rounding.
    """
    return float(step / np.sqrt(12.0) * np.exp(-2.0 * (np.pi * noise_rms / step) ** 2)) if step > 0.0 else 0.0


def undithered_rms_of(cell: CellFile) -> Floats:
    """The same of every channel (7,) by its stated step and noise, in the units of the channels; heights are not rounded."""
    return np.array([undithered_rms(step, rms) for step, rms in zip(resolutions(cell), pure_rms(cell), strict=True)])


def coarse_step_N(samples: Samples, cell: CellFile) -> float:
    """The usual distance in N between neighbouring values of fz; 0 unless it is much coarser than step and noise that the cell states."""
    values, rows = np.unique(samples.wrench[:, 2], return_counts=True)
    if len(values) < 3 or len(values) > 0.2 * rows[1:-1].sum():  # a sensor at its limit repeats that, however fine its steps are
        return 0.0
    gaps = gaps_between(values)
    gap = float(np.median(gaps))
    gap = float(np.mean(gaps[gaps < 1.75 * gap]))  # readings that are also rounded to the stated step have gaps of two sizes
    stated = cell.sensor.resolution_fz_N
    if gap <= ASSUMED.scatter.coarse_step_ratio * stated or gap <= ASSUMED.scatter.coarse_noise_ratio * cell.sensor.noise_rms_N:
        return 0.0
    # Over many levels a small error of the step shifts the last level by a whole step: take the step at which all values agree best.
    steps, values = gap * np.linspace(0.95, 1.05, 2001), values[:: 1 + len(values) // 500]
    return float(steps[np.argmax(np.abs(np.exp(2j * np.pi * values / steps[:, None]).sum(axis=1)))])


def rounding_of(coarse_N: float, cell: CellFile, noise_rms_N: float) -> Rounding | None:
    """How fz is rounded; None where noise dithers it.

    Args:
        coarse_N: Step that is much coarser than stated, of all recordings; 0 for none.
        noise_rms_N: Noise of a sample before rounding.
    """
    step_N = coarse_N or cell.sensor.resolution_fz_N
    dithered = noise_rms_N >= ASSUMED.rounding.dithered_steps * step_N
    return None if dithered else Rounding(step_N, noise_rms_N, coarse=coarse_N > 0.0)
