"""Commanded heights over time: straight moves with a trapezoid of speed, each followed by a rest."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np

from palpd.cell.dynamics import Floats


@dataclass(frozen=True, slots=True)
class Move:
    """Go to a height, then rest there.

    Attributes:
        speed_m_per_s: Largest speed on the way; a short way ends before it is reached.
        rest_s: Time at that height afterwards.
        acceleration_m_per_s2: Acceleration and deceleration.
    """

    z_m: float
    speed_m_per_s: float
    rest_s: float = 0.0
    acceleration_m_per_s2: float = 0.5


class Trapezoid:
    """Distance over time of a move from rest to rest with a trapezoid of speed.

    Attributes:
        duration_s: Time from start to end.
    """

    def __init__(self, distance_m: float, speed_m_per_s: float, acceleration_m_per_s2: float) -> None:
        self._distance_m, self._acceleration = distance_m, acceleration_m_per_s2
        self._top_speed = min(speed_m_per_s, sqrt(distance_m * acceleration_m_per_s2))
        self._ramp_s = self._top_speed / acceleration_m_per_s2
        self._cruise_s = distance_m / max(self._top_speed, 1e-12) - self._ramp_s
        self.duration_s = 2 * self._ramp_s + self._cruise_s

    def travelled_m(self, t_s: Floats) -> Floats:
        """Distance from the start.

        Args:
            t_s: Times (n,) since the start, in s; beyond the end the whole distance is travelled.

        Returns:
            Distances (n,) in m.
        """
        ramp_s, speed, acceleration = self._ramp_s, self._top_speed, self._acceleration
        travelled_m = np.where(
            t_s < ramp_s,
            0.5 * acceleration * t_s**2,
            np.minimum(speed * (t_s - ramp_s / 2), self._distance_m - 0.5 * speed * ramp_s),
        )
        braking = t_s > ramp_s + self._cruise_s
        left_s = np.clip(self.duration_s - t_s[braking], 0.0, ramp_s)
        travelled_m[braking] = self._distance_m - 0.5 * acceleration * left_s**2
        return np.asarray(travelled_m)


def commanded_heights(start_z_m: float, moves: Sequence[Move], step_s: float) -> tuple[Floats, list[tuple[int, int]]]:
    """Commanded heights of moves one after the other.

    Args:
        start_z_m: Height at which the first move starts, in m.
        moves: The moves in their order.
        step_s: Time between samples, in s.

    Returns:
        Heights (n,) in m, and for each move the samples [first, end) of the move and its rest.
    """
    pieces: list[Floats] = []
    spans: list[tuple[int, int]] = []
    at_m, count = start_z_m, 0
    for move in moves:
        way_m = move.z_m - at_m
        profile = Trapezoid(abs(way_m), move.speed_m_per_s, move.acceleration_m_per_s2)
        t_s = np.arange(1, round((profile.duration_s + move.rest_s) / step_s) + 1, dtype=np.float64) * step_s
        pieces.append(at_m + np.sign(way_m) * profile.travelled_m(t_s))
        spans.append((count, count + len(t_s)))
        at_m, count = move.z_m, count + len(t_s)
    return np.concatenate(pieces), spans
