"""The ticks of the loop as they come, from the ring of the service under way."""

import time

from palpd.errors import PalpdError
from palpd.recording.ring import Ring, Rows

QUIET_S = 1.0
"""Time without a tick after which no run counts as under way."""
POLL_S = 0.0002
"""Pause between two looks for a tick that is due: a small part of the 1 ms in which the loop writes it."""
SLOW_S = 0.02
"""Pause between two looks where nobody waits for each tick, and where no run is under way."""


class RingTicks:
    """Follows one ring after the other, read-only, from the newest tick on.

    Attributes:
        number: Number of the next row, counted from the beginning of the service.
        lost: Rows that were overwritten before they were taken.
        reason: Why the ring cannot be read; empty where it can.
    """

    def __init__(self, rate_Hz: float) -> None:
        self.number, self.lost, self.reason = 0, 0, ""
        self._period_s = 1.0 / rate_Hz
        self._name: str | None = None
        self._ring: Ring | None = None
        self._due_s = float("-inf")

    @property
    def follows(self) -> bool:
        """Whether there is a ring to read."""
        return self._ring is not None

    def follow(self, name: str | None) -> None:
        """Read the ring of that name from now on; None reads none."""
        if name == self._name:
            return
        self.close()
        self._name = name
        if name is None:
            return
        try:
            self._ring = Ring.watch(name)
            self.number = self._ring.published
        except PalpdError as error:
            self.reason = str(error)

    def take(self) -> Rows | None:
        """Take the rows since the last call, or None where there are none; `number` then counts the row after them."""
        if self._ring is None or self._ring.published == self.number:
            return None
        rows, self.number, lost = self._ring.read(self.number)
        self.lost += lost
        if not len(rows):
            return None
        self._due_s = float(rows["planned_s"][-1]) + self._period_s
        return rows

    def pause_s(self, urgent: bool) -> float:
        """Say how long to wait before the next look.

        Args:
            urgent: Whether somebody waits for each tick.

        Returns:
            Until the next tick is due; the least pause where it is due, the longest where no run is under way.
        """
        now_s = time.monotonic()
        if not urgent or now_s > self._due_s + QUIET_S:
            return SLOW_S
        return min(SLOW_S, max(POLL_S, self._due_s - now_s))

    def close(self) -> None:
        """Read no ring any more."""
        if self._ring is not None:
            self._ring.close()
        self._ring, self._name, self.reason = None, None, ""
