"""A zero that follows the sensor's drift while the tip is in free air and stands still in contact.

A learned bias belongs to one tare: the next has another rounding error, and the sensor has warmed up meanwhile. The free air before
each press tells what it is now. In contact nothing is learned, or the contact would be learned away.
"""

import math
from collections import deque

FREE_N = 0.3
"""A corrected force below this over `FREE_S` is free air; above it the zero stands still."""
FREE_S = 0.02
KNOWN_FREE_S = 0.5
"""A recording begins at rest after a tare, which is refused in contact: so long the tip is known to be free."""
ROLLBACK_S = 0.3
"""When contact is seen the zero goes back to what it was so long ago, before the first newtons that were not seen."""
ZERO_S = 1.0
"""Time over which the zero averages: 0.065 N of noise and rounding leaves 2 mN of 500 samples a second."""
HOLD_OFF_S = 0.2
"""After contact the tissue may still pull: so long nothing is learned."""


class FreeAir:
    """Whether the tip is free, judged by the corrected force over the last 20 ms."""

    def __init__(self) -> None:
        self.start()

    def start(self) -> None:
        """A recording begins, in free air."""
        self._recent: deque[tuple[float, float]] = deque()
        self._sum_N = 0.0
        self._begun_s = math.nan
        self._touched_s = -math.inf
        self.touched = False

    def __call__(self, t_s: float, corrected_N: float) -> bool:
        """True in free air; `touched` is true in the sample in which contact is first seen."""
        if math.isnan(self._begun_s):
            self._begun_s = t_s
        self._recent.append((t_s, corrected_N))
        self._sum_N += corrected_N
        while self._recent[0][0] <= t_s - FREE_S:
            self._sum_N -= self._recent.popleft()[1]
        free_before = t_s - self._touched_s > HOLD_OFF_S
        if t_s - self._begun_s < KNOWN_FREE_S:
            self.touched = False
            return True
        touching = abs(self._sum_N) > FREE_N * len(self._recent)
        self.touched = touching and free_before
        if touching:
            self._touched_s = t_s
        return not touching and free_before


class RunningZero:
    """Bias of the free air just before. `learned_N` is what to begin with; times are those of the samples."""

    def __init__(self, learned_N: float = 0.0) -> None:
        self.learned_N = learned_N
        self._free = FreeAir()
        self.start()

    def start(self) -> None:
        """The zero of the last recording is not that of this one."""
        self._free.start()
        self.zero_N, self._weight_s, self._last_s = self.learned_N, 0.0, math.nan
        self._past: deque[tuple[float, float]] = deque()

    def step(self, t_s: float, rest_N: float) -> float:
        """The zero at this sample, whose tared fz less inertia is `rest_N`: a mean over all free samples, later over the last second."""
        step_s = 0.0 if math.isnan(self._last_s) else t_s - self._last_s
        self._last_s = t_s
        if self._free(t_s, rest_N - self.zero_N):
            self._weight_s = min(self._weight_s + step_s, ZERO_S)
            if self._weight_s > 0.0:
                self.zero_N += (rest_N - self.zero_N) * step_s / self._weight_s
            self._past.append((t_s, self.zero_N))
            while self._past[0][0] < t_s - ROLLBACK_S:
                self._past.popleft()
        elif self._free.touched and self._past:
            self.zero_N = self._past[0][1]
            self._past.clear()
        return self.zero_N
