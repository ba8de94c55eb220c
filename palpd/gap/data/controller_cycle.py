"""How long the controller of a robot holds a target, found in a recording.

A held target is a step of the acceleration in each cycle, and so a comb in the force of inertia: lines at the rate of the cycle and at
its multiples, while the probe moves. Averaged over anything but whole cycles, it looks like a slow force.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, median_filter

from palpd.gap.assumptions import ASSUMED
from palpd.gap.data.phases import Phases
from palpd.recording.samples import Samples, runs_of_true
from palpd.tick import Floats

LONGEST_S = 0.025
"""Longest cycle that is sought: the slowest interface of an industrial robot takes a target each 24 ms."""
FEWEST_TARGETS = 50
"""Number of commanded heights in motion below which nothing is said of how long each is held."""
WINDOW_S = (0.1, 0.4)
"""Shortest and longest stretches whose spectra are averaged: the shortest has four of the longest cycles."""


def held_command_s(samples: Samples) -> float | None:
    """For how long each commanded height stays the same while the command moves; None where it changes with each sample."""
    if samples.z_cmd_m is None:
        return None
    each = np.diff(np.flatnonzero(np.diff(samples.z_cmd_m)))
    each = each[each <= LONGEST_S * samples.rate_Hz]
    if len(each) < FEWEST_TARGETS or np.median(each) < 2:
        return None
    usual = each[np.abs(each - np.median(each)) <= 1]
    return float(usual.mean() / samples.rate_Hz) if 2 * len(usual) > len(each) else None


def comb_period_s(samples: Samples, phases: Phases) -> float | None:
    """Period of a comb in the force along z while the probe moves.

    Its first line stands out of its neighbours, and does not do so at rest. So does the second one in the force, or the first in the
    reported speed: a mount that rings has neither.

    Returns:
        The period in s; None without a comb.
    """
    begin, end = runs_of_true(phases.moving)
    shortest, longest = (round(window_s * samples.rate_Hz) for window_s in WINDOW_S)
    length = (end - begin)[end - begin >= shortest]
    if not len(length):
        return None
    n = min(int(np.median(length)), longest)
    fz_N = samples.wrench[:, 2]
    power, at_rest = (_mean_power(fz_N, where, n) for where in (phases.moving, ~phases.moving))
    in_speed = _mean_power(samples.vz_m_per_s, phases.moving, n)
    line, line_at_rest, line_in_speed = (_over_neighbours(each) for each in (power, at_rest, in_speed))
    second_line = np.append(maximum_filter1d(line, 3)[::2], np.zeros(n))[: len(line)]
    comb = (line > ASSUMED.noise.held_line_ratio * np.maximum(line_at_rest, 1.0)) & (
        np.maximum(second_line, line_in_speed) > ASSUMED.noise.second_line_ratio
    )
    comb[-1] = False
    comb[: int(np.ceil(n / (LONGEST_S * samples.rate_Hz)))] = False
    if not comb.any():
        return None
    k = int(np.argmax(np.where(comb, power, 0.0)))
    left, top, right = np.log(power[k - 1 : k + 2])
    return float(n / samples.rate_Hz / (k + 0.5 * (left - right) / (left - 2.0 * top + right)))


def _mean_power(values: Floats, where: NDArray[np.bool_], n: int) -> Floats:
    """Mean power (n // 2 + 1,) of values in stretches of n samples that lie where it is marked (samples,); ones without any."""
    begins = [first for begin, end in zip(*runs_of_true(where), strict=True) for first in range(begin, end - n + 1, n)]
    if not begins:
        return np.ones(n // 2 + 1)
    smooth = np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, n), 3)
    stretches = np.array([values[first : first + n] for first in begins]).T
    stretches = stretches - smooth @ np.linalg.lstsq(smooth, stretches, rcond=None)[0]
    return np.asarray((np.abs(np.fft.rfft(stretches * np.hanning(n)[:, None], axis=0)) ** 2).mean(axis=1))


def _over_neighbours(power: Floats) -> Floats:
    """Power (k,) at each frequency over the median of its neighbours."""
    return np.asarray(power / np.maximum(median_filter(power, 17, mode="nearest"), 1e-300))
