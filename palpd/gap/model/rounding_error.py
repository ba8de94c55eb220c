"""The error of rounding that noise does not dither, as columns of A.

The mean reading of a force f that is rounded to steps s, with normal noise σ before, is off by the sawtooth

    e(f) = Σ_k ± s/(πk) exp(-2 (πkσ/s)²) sin(2πk (f - level)/s).

Nobody knows where a force lies between two levels, but how far it has moved since. So each harmonic has an unknown phase, and its cosine
and sine over f are two columns: one pair for all that is in the air, and one for every stretch of one motion in which the force moves by a
few steps. Over more, tolerances hide the phase, and so does an effect where the motion changes. The error stays while the force rests,
comes back where the force comes back, and averages out in a bin that crosses levels.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from palpd.gap.assumptions import ASSUMED
from palpd.gap.data.noise import FZ
from palpd.gap.data.phases import Ints
from palpd.gap.data.prepare import PreparedRecording
from palpd.gap.data.rounding import Rounding
from palpd.tick import Floats

LEAST_ENERGY = 0.1
"""Squared length of a whitened column below which it is left out: its coefficient would not be seen."""

MOST_COLUMNS = 800
"""Number of columns of stretches, those with the most energy: more would cost time and memory. 90 s have 700 at most."""

LARGEST_FACTOR = 10.0
"""Largest factor, either way, between the forces of a press that are measured and predicted; beyond, the prediction is taken."""


def rounding_error(recording: PreparedRecording, rounding: Rounding, force_N: Floats, sigma_N: Floats) -> Iterator[Floats]:
    """Columns of A, one standard deviation each, for the error of rounding of fz.

    Args:
        force_N: Predicted force (b,) without effects.
        sigma_N: Noise of the bins (b,).

    Yields:
        Columns (b,) in N.
    """
    turns = _as_measured(recording, force_N) / rounding.step_N
    if rounding.coarse:
        yield from _ways_of_rounding(turns - turns[0], rounding.step_N)
    # The zero of the sensor is the same wherever the probe is in the air, as far as it does not drift.
    in_air = recording.bin_press < 0
    of_harmonics = list(waves(turns, rounding.harmonics_N))
    for values in of_harmonics:
        yield np.where(in_air, values, 0.0)
    own = []
    for first, values in phase_columns(of_harmonics, turns, recording.bin_phase):
        mine = slice(first, first + len(values))
        sized = np.where(in_air[mine], ASSUMED.rounding.own_phase * values, values)
        own.append((float(np.sum((sized / sigma_N[mine]) ** 2)), mine, sized))
    least = max([LEAST_ENERGY, *sorted((energy for energy, _, _ in own), reverse=True)[MOST_COLUMNS : MOST_COLUMNS + 1]])
    for energy, mine, sized in own:
        if energy > least:
            column = np.zeros(len(force_N))
            column[mine] = sized
            yield column


def phase_columns(of_harmonics: Sequence[Floats], turns: Floats, motion: Ints) -> Iterator[tuple[int, Floats]]:
    """Cosine and sine of every harmonic over every stretch.

    Args:
        of_harmonics: Both (b,) of every harmonic, as `waves` gives them.
        turns: Force of the bins (b,), in steps.
        motion: Phase of the motion (b,).

    Yields:
        First bin of a stretch, and the mean values (m,) in its bins, in N.
    """
    for first, end in _stretches(turns, motion):
        yield from ((first, values[first:end]) for values in of_harmonics)


def waves(turns: Floats, harmonics_N: Floats) -> Iterator[Floats]:
    """Cosine and sine (b,) of every harmonic, averaged over the force that a bin sweeps, in N.

    Args:
        turns: Force of the bins (b,), in steps.
        harmonics_N: Standard deviations (h,) of the harmonics.
    """
    swept = np.abs(np.gradient(turns))
    for k, size_N in enumerate(harmonics_N, start=1):
        mean_N, angle = size_N * np.sinc(k * swept), 2.0 * np.pi * k * turns
        yield mean_N * np.cos(angle)
        yield mean_N * np.sin(angle)


def _ways_of_rounding(moved: Floats, step_N: float) -> Iterator[Floats]:
    """What other ways than to the nearest level add: converters round down, and integers in software cut towards zero.

    Args:
        moved: Force (b,) beyond that at rest, in steps.
    """
    yield np.full(len(moved), 0.5 * step_N)
    yield step_N * np.clip(moved, -0.5, 0.5)


def _as_measured(recording: PreparedRecording, force_N: Floats) -> Floats:
    """The predicted force (b,), in every press times the factor to the measured force: the phase needs the force, not the modulus."""
    measured_N, press, out = recording.measured[FZ], recording.bin_press, force_N.copy()
    free = press < 0
    if not free.any():
        return out
    moved_N, seen_N = force_N - force_N[free].mean(), measured_N - measured_N[free].mean()
    for number in range(recording.phases.presses):
        mine = press == number
        square = float(moved_N[mine] @ moved_N[mine])
        factor = float(moved_N[mine] @ seen_N[mine]) / square if square > 0.0 else 1.0
        if 1.0 / LARGEST_FACTOR < factor < LARGEST_FACTOR:
            out[mine] += (factor - 1.0) * moved_N[mine]
    return out


def _stretches(turns: Floats, motion: Ints) -> Iterator[tuple[int, int]]:
    """First bin and end of every stretch of one motion in which the force (b,) moves by at most `rounding.coherent_steps`."""
    first, low, high = 0, turns[0], turns[0]
    for k, value in enumerate(turns):
        low, high = min(low, value), max(high, value)
        if high - low > ASSUMED.rounding.coherent_steps or motion[k] != motion[first]:
            yield first, k
            first, low, high = k, value, value
    yield first, len(turns)
