"""A zero that follows the sensor's drift in free air, and stands still wherever the tip might touch.

A learned bias belongs to one tare: the next tare has another rounding error, and the sensor has warmed up meanwhile. The free air before
each press shows the present bias. A zero that learns during contact removes the contact, so three conditions prevent it: the script
guarantees the height, the force agrees (`FreeAir`), and the zero moves slowly and within a limit. docs/safety.md has the argument.
"""

import math
from collections import deque

FREE_N = 0.3
"""A corrected force below this over `FREE_S` is free air; above it the zero stands still."""
FREE_S = 0.02
"""Window of that mean: 20 samples at 1 kHz, 0.1 mm at 5 mm/s."""
ROLLBACK_S = 0.3
"""At contact the zero returns to its value this long ago, before the first newtons that were not recognised."""
HOLD_OFF_S = 0.2
"""Pause of the learning after contact: the tissue may still pull."""
ZERO_S = 1.0
"""Time over which the zero averages: 0.065 N of noise and rounding leaves 2 mN of 500 samples a second."""
LEAST_S = 0.1
"""First averaging time, so that the zero finds the tare's remainder at once. Later it moves by `FREE_N` a second at most.

That is sixty times a warm-up of 0.3 N in a minute; a touch that grows faster is recognised."""
LONGEST_STEP_S = 0.02
"""Longest time that one sample stands for: a gap is not made up."""


class FreeAir:
    """Whether the tip is free, judged by the corrected force over the last 20 ms."""

    def __init__(self) -> None:
        self._recent: deque[tuple[float, float]] = deque()
        self._sum_N = 0.0
        self._touched_s = -math.inf
        self.touched = False

    def __call__(self, t_s: float, corrected_N: float) -> bool:
        """Return true in free air; `touched` is true in the first sample of a contact."""
        recent = self._recent
        recent.append((t_s, corrected_N))
        self._sum_N += corrected_N
        while recent[0][0] <= t_s - FREE_S:
            self._sum_N -= recent.popleft()[1]
        touching = abs(self._sum_N) > FREE_N * len(recent)
        free_before = t_s - self._touched_s > HOLD_OFF_S
        self.touched = touching and free_before
        if touching:
            self._touched_s = t_s
        return not touching and free_before


class RunningZero:
    """Bias of the latest free air, within ± `limit_N`. It begins at `learned_N`; times are those of the samples."""

    def __init__(self, learned_N: float = 0.0, limit_N: float = math.inf) -> None:
        self.zero_N, self._limit_N = learned_N, limit_N
        self._free = FreeAir()
        self._weight_s, self._last_s = LEAST_S, math.inf
        self._past: deque[tuple[float, float]] = deque()

    def step(self, t_s: float, rest_N: float) -> float:
        """Take in a sample: the zero is a mean over all free samples, later over the last second.

        Call it only where the script guarantees free air. A number that is not finite changes nothing.

        Args:
            t_s: time of the sample.
            rest_N: tared fz of the sample less the model's prediction.

        Returns:
            The zero in N.
        """
        if not (math.isfinite(t_s) and math.isfinite(rest_N)):
            return self.zero_N
        step_s = min(max(t_s - self._last_s, 0.0), LONGEST_STEP_S)
        self._last_s = t_s
        if self._free(t_s, rest_N - self.zero_N):
            away_N = min(max(rest_N - self.zero_N, -FREE_N), FREE_N)
            moved_N = self.zero_N + away_N * step_s / self._weight_s
            self.zero_N = min(max(moved_N, -self._limit_N), self._limit_N)
            self._weight_s = min(self._weight_s + step_s, ZERO_S)
            past = self._past
            past.append((t_s, self.zero_N))
            while past[0][0] < t_s - ROLLBACK_S:
                past.popleft()
        elif self._free.touched and self._past:
            self.zero_N = self._past[0][1]
            self._past.clear()
        return self.zero_N
