"""The motions of a controller's target, one controller cycle at a time: speed ramp, trapezoidal move, servo."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hw.emulators.pose import Floats, displacement


class Step(NamedTuple):
    """One cycle of a motion: speed (6,) at its end, displacement (6,), and whether the motion is over.

    `settled` is the share of the cycle in which the speed changes linearly in time.
    """

    speed: Floats
    shift: Floats
    over: bool
    settled: float = 1.0


@dataclass
class Ramp:
    """Approaches a speed with limited acceleration and then keeps it (URScript's speedl; with a goal of zero, stopl)."""

    goal: Floats
    acceleration: float

    def advance(self, speed: Floats, _place: Floats, cycle_s: float) -> Step:
        """Advance by one cycle. A stop is over when the tip is at rest.

        Args:
            speed: speed (6,) at the cycle's begin, in m/s and rad/s.
            _place: pose (6,) at the cycle's begin, in m and rad; not used.
            cycle_s: length of the cycle.
        """
        after, shift, settled = speed.copy(), speed * cycle_s, 0.0
        for part in (slice(0, 3), slice(3, 6)):
            change = self.goal[part] - speed[part]
            needed = float(np.linalg.norm(change)) / (self.acceleration * cycle_s)
            if needed > 1.0:
                change /= needed
            after[part] += change
            shift[part] += change * cycle_s * (1.0 - 0.5 * min(needed, 1.0))
            settled = max(settled, min(needed, 1.0))
        return Step(after, shift, not self.goal.any() and not after.any(), settled)


@dataclass
class TrapezoidalMove:
    """Moves straight to a pose with a trapezoidal speed profile (movel; movej with the leading joint's profile).

    `speed` and `acceleration` refer to `length`: by default the larger of distance (m) and rotation (rad). A moving tip comes to rest
    first.
    """

    goal: Floats
    speed: float
    acceleration: float
    length: float | None = None
    _way: Floats | None = None
    _elapsed_s: float = 0.0
    _share: float = 0.0

    def _profile(self, length: float, t_s: float) -> tuple[float, float]:
        """Return distance and speed after t_s."""
        top = min(self.speed, float(np.sqrt(length * self.acceleration)))
        rise_s = top / self.acceleration
        left_s = length / top + rise_s - t_s
        if left_s <= 0.0:
            return length, 0.0
        if t_s < rise_s:
            return 0.5 * self.acceleration * t_s * t_s, self.acceleration * t_s
        if left_s < rise_s:
            return length - 0.5 * self.acceleration * left_s * left_s, self.acceleration * left_s
        return top * (t_s - 0.5 * rise_s), top

    def advance(self, speed: Floats, place: Floats, cycle_s: float) -> Step:
        """Advance by one cycle. The move is over at its goal.

        Args:
            speed: speed (6,) at the cycle's begin, in m/s and rad/s.
            place: pose (6,) at the cycle's begin, in m and rad.
            cycle_s: length of the cycle.
        """
        if self._way is None:
            if speed.any():
                return Ramp(np.zeros(6), self.acceleration).advance(speed, place, cycle_s)._replace(over=False)
            self._way = displacement(place, self.goal)
        length = self.length or max(float(np.linalg.norm(self._way[:3])), float(np.linalg.norm(self._way[3:])))
        if length < 1e-9:
            return Step(np.zeros(6), self._way, True)
        self._elapsed_s += cycle_s
        gone, now = self._profile(length, self._elapsed_s)
        step = gone / length - self._share
        self._share += step
        return Step(self._way * (now / length), self._way * step, gone >= length)


@dataclass
class Servo:
    """Follows a pose with a delay (servol, servoj); the speed is limited as by a controller."""

    goal: Floats
    lookahead_s: float

    def advance(self, speed: Floats, place: Floats, cycle_s: float) -> Step:
        """Advance by one cycle. It never ends by itself.

        Args:
            speed: speed (6,) at the cycle's begin, in m/s and rad/s.
            place: pose (6,) at the cycle's begin, in m and rad.
            cycle_s: length of the cycle.
        """
        after = displacement(place, self.goal) / max(self.lookahead_s, 2.0 * cycle_s)
        fastest = float(np.linalg.norm(after[:3]))
        if fastest > 1.0:
            after *= 1.0 / fastest
        return Step(after, 0.5 * (speed + after) * cycle_s, False)


TargetMotion = Ramp | TrapezoidalMove | Servo
