"""For how long a loop has sent no tick, or has ended, as its supervisor sees it."""

import math

from palpd.recording.ring import LoopState

LOOK_S = 0.25
"""Longest time between two looks at the loop; a longer one shows that this process, and perhaps the whole computer, stood still."""


class TickWatch:
    """Time for which ticks did not advance while this process itself ran: a computer that stood still is no loop that hangs."""

    def __init__(self, ticks: int, now_s: float) -> None:
        self._ticks = ticks
        self._going_s = math.inf
        self.begin(now_s)

    def begin(self, now_s: float) -> None:
        """Count from now on."""
        self._since_s = self._looked_s = now_s

    def still_s(self, ticks: int, now_s: float) -> float:
        """The time without a new tick, in s, given the ticks that were counted until now."""
        stood_still_s = max(0.0, now_s - self._looked_s - LOOK_S)
        self._looked_s = now_s
        if ticks != self._ticks:
            self._ticks, self._since_s = ticks, now_s
        else:
            self._since_s += stood_still_s
        return now_s - self._since_s

    def ended_s(self, state: int, now_s: float) -> float:
        """The time since the loop was last seen in a state other than ENDED, in s; negative where it never was."""
        if state != LoopState.ENDED:
            self._going_s = now_s
        return now_s - self._going_s
