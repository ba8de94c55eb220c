"""Readings of fz that noise does not dither: their steps are coarser than the cell file states, or large against their noise."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import ndtr

from palpd.cell.cell_file import CellFile
from palpd.gap.assumptions import ASSUMED
from palpd.gap.data.noise import pure_rms, resolutions
from palpd.gap.data.phases import Ints
from palpd.recording.oddities import measured_rms
from palpd.recording.samples import Samples
from palpd.tick import Floats

Way = Literal["nearest", "down", "to zero"]
WAYS: tuple[Way, ...] = ("nearest", "down", "to zero")
"""How readings come to their levels: converters round to the nearest one or down, and integers in software cut towards zero."""


FARTHEST = 7.0
"""Standard deviations of the noise beyond which no reading comes to a level."""

POINTS_PER_STEP = 100
"""Points of the table of mean readings: straight lines between them are exact to a thousandth of a step."""


NOISES = np.geomspace(0.02, 0.7, 42)
"""Candidates for the noise of rounded readings before the rounding, in steps."""

STRETCH = 100
"""Number of readings of a rest that share a mean: over a longer time a force that creeps changes it."""


def rounded_moments(force: Floats, noise_rms: float, way: Way = "nearest", first: float = 0.0) -> tuple[Floats, Floats]:
    """Mean and variance of a force with normal noise after it was rounded to whole numbers.

    A reading is level `k` or a higher one where force and noise reach the edge of that level, so both moments are short sums over the
    edges near the force.

    Args:
        force: Forces without noise (n,), in steps from a level.
        noise_rms: Noise before the rounding, in steps.
        way: `to zero` cuts towards the zero of `force`.
        first: Finer step, in steps, to which the reading was rounded before; 0 for none.

    Returns:
        Means (n,) in steps, and variances (n,) in squared steps.
    """
    nearest, sigma = np.rint(force), max(noise_rms, 1e-9)
    mean, square = np.zeros_like(nearest), np.zeros_like(nearest)
    for k in range(1, int(FARTHEST * sigma + 1.5) + 1):
        above = ndtr((force - _edge(nearest + k, way, first)) / sigma)
        below = ndtr((_edge(nearest + (1 - k), way, first) - force) / sigma)
        mean += above - below
        square += (2 * k - 1) * (above + below)
    return nearest + mean, square - mean**2


def _edge(level: Floats, way: Way, first: float) -> Floats:
    """Least force that is rounded to these levels or to higher levels, in steps."""
    # Where software cuts towards zero, a reading of -1 itself stays -1.
    below: dict[Way, Floats | float] = {"nearest": 0.5, "down": 0.0, "to zero": np.where(level > 0.0, 0.0, 1.0 - 1e-6)}
    edge = level - below[way]
    return edge if first == 0.0 else first * (np.ceil(edge / first - 1e-9) - 0.5)


@dataclass(frozen=True)
class Rounding:
    """How fz is rounded in one recording, and where the cell's forces lie between its levels.

    The tare leaves the levels anywhere, and nobody knows the force behind a reading that rests between two of them. The readings at rest
    say it: their mean fixes how far the force at rest lies from its level. So what a cell predicts is laid between the levels by *its own*
    forces at rest, and its mean readings are given in the frame of its forces. A zero that has moved (bias, whether an effect or within
    tolerance) then moves all forces and all predicted readings alike. Drift acts only by what it changes between the rests and the presses.

    Attributes:
        step_N: Distance of the levels.
        level_N: One of the levels, on the scale of the readings.
        rest_N: Mean reading at rest in the air, on that scale.
        noise_rms_N: Noise before the rounding.
        first_N: Finer step to which readings were rounded before, as software does that cuts what the sensor rounded; 0 for none.
        reach_N: Largest distance from the force at rest that is predicted to a fraction of a step. Beyond, tolerances decide on which side
            of a level a force lies.
    """

    step_N: float
    level_N: float
    rest_N: float
    noise_rms_N: float
    way: Way
    reach_N: float
    first_N: float = 0.0

    def readings(self, force_N: Floats, at_rest: Ints) -> Floats:
        """Mean readings of a cell's forces with normal noise, in the frame of these forces.

        Args:
            force_N: Forces without noise (n,), from any zero.
            at_rest: Numbers (m,) of forces at rest in the air.

        Returns:
            Mean readings (n,) in N, from the same zero.
        """
        rest_N = force_N[at_rest]
        zero_N = self._zero(rest_N)
        near = np.abs(force_N - rest_N.mean()) <= self.reach_N
        return np.where(near, force_N + self._moved(force_N + zero_N), force_N)

    def by(self, way: Way, first_N: float) -> "Rounding":
        """The same levels, reached in another way; `way` and `first_N` as the attributes."""
        return replace(self, way=way, first_N=first_N)

    @property
    def undithered_rms_N(self) -> float:
        """Rms of the rounding error that averaging does not remove, over all forces."""
        return undithered_rms(self.step_N, self.noise_rms_N)

    def _zero(self, rest_N: Floats) -> float:
        """What a cell's forces at rest (m,) lack on the scale of the readings, for their mean reading to be the measured one."""

        def excess_N(zero_N: float) -> float:
            return float((rest_N + zero_N + self._moved(rest_N + zero_N)).mean()) - self.rest_N

        start_N = self.rest_N - float(rest_N.mean())
        return float(brentq(excess_N, start_N - 1.01 * self.step_N, start_N + 1.01 * self.step_N, xtol=1e-9 * self.step_N))

    def _moved(self, force_N: Floats) -> Floats:
        """What the rounding adds on average to forces (n,) on the scale of the readings."""
        return np.interp(force_N, *self._table)

    @cached_property
    def _table(self) -> tuple[Floats, Floats]:
        """Forces on the scale of the readings, as far as the reach, and what the rounding adds to them."""
        steps = int(self.reach_N / self.step_N) + 4
        force_N = self.rest_N + self.step_N * np.linspace(-steps, steps, 2 * steps * POINTS_PER_STEP + 1)
        force = (force_N - self.level_N) / self.step_N
        mean, _ = rounded_moments(
            force, max(self.noise_rms_N / self.step_N, ASSUMED.rounding.least_dither_steps), self.way, self.first_N / self.step_N
        )
        return force_N, self.step_N * (mean - force)


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
        expected.append(float(np.average(np.interp(apart, mean_there, variance), weights=count)))
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
    values = np.unique(samples.wrench[:, 2])
    if len(values) < 3 or len(values) > 0.2 * len(samples):
        return 0.0
    gaps = np.diff(values)
    gaps = gaps[gaps > 1e-6 * np.ptp(values)]  # one level may have two values that differ in the last bits
    gap = float(np.median(gaps))
    gap = float(np.mean(gaps[gaps < 1.75 * gap]))  # readings that are also rounded to the stated step have gaps of two sizes
    stated = cell.sensor.resolution_fz_N
    if gap <= ASSUMED.scatter.coarse_step_ratio * stated or gap <= ASSUMED.scatter.coarse_noise_ratio * cell.sensor.noise_rms_N:
        return 0.0
    # Over many levels a small error of the step shifts the last level by a whole step: take the step at which all values agree best.
    steps, values = gap * np.linspace(0.95, 1.05, 2001), values[:: 1 + len(values) // 500]
    return float(steps[np.argmax(np.abs(np.exp(2j * np.pi * values / steps[:, None]).sum(axis=1)))])


def roundings_of(
    recordings: Sequence[Samples], steps_N: Sequence[float], cell: CellFile, noise_rms_N: float, rests_N: Sequence[float]
) -> list[Rounding]:
    """How fz is rounded; its levels follow from the mean of all values on a circle whose turn is a step.

    Args:
        recordings: As they were read. Each was tared by itself, so each has levels of its own.
        steps_N: Coarse step of each recording, 0 for none.
        noise_rms_N: Noise of a sample before rounding.
        rests_N: Mean reading of fz at rest in the air, of each recording.

    Returns:
        The rounding of each recording: to the coarsest of the steps, or to the stated step where all are 0. Empty where noise dithers it.
    """
    coarse_N = max(steps_N)
    step_N = coarse_N or cell.sensor.resolution_fz_N
    if noise_rms_N >= ASSUMED.rounding.dithered_steps * step_N:
        return []
    roundings = []
    for samples, rest_N in zip(recordings, rests_N, strict=True):
        readings_N = samples.wrench[:, 2]
        turn = np.exp(2j * np.pi * readings_N / step_N).mean()
        reach_N = float(np.abs(readings_N - rest_N).max()) + step_N if coarse_N else ASSUMED.rounding.air_reach_steps * step_N
        roundings.append(Rounding(step_N, float(np.angle(turn) / (2.0 * np.pi) * step_N), rest_N, noise_rms_N, "nearest", reach_N))
    return roundings
