"""The grid of ticks: absolute deadlines, missed ticks counted and never made up."""

import time

from palpd.tick import Timing


class RealClock:
    """Ticks on CLOCK_MONOTONIC at `first_s` + n / rate. A late tick runs at once; the ticks that passed meanwhile are skipped.

    The grid is absolute. With a period that restarts from "now", every late wake-up would add up (459 Hz instead of 500 Hz).
    """

    def __init__(self, rate_Hz: float, first_s: float) -> None:
        self._period_ns = round(1e9 / rate_Hz)
        self._first_ns = round(first_s * 1e9)
        self._index = -1
        self._began_ns = 0

    def begin_soon(self) -> None:
        """Start on the next line of the grid: the time until now is not counted as missed."""
        self._first_ns += ((time.monotonic_ns() - self._first_ns) // self._period_ns + 1) * self._period_ns

    def wait(self) -> Timing:
        """Sleep until the next tick of the grid; a tick that is late runs at once."""
        now_ns = time.monotonic_ns()
        due = self._index + 1
        current = (now_ns - self._first_ns) // self._period_ns
        missed = max(0, current - due)
        self._index = due + missed
        planned_ns = self._first_ns + self._index * self._period_ns
        # time.sleep is clock_nanosleep to an absolute CLOCK_MONOTONIC deadline since CPython 3.11
        if planned_ns > now_ns:
            time.sleep((planned_ns - now_ns) * 1e-9)
        self._began_ns = time.monotonic_ns()
        return Timing(self._index, planned_ns * 1e-9, self._began_ns * 1e-9, missed)

    def elapsed_us(self) -> float:
        """Time since the last tick began."""
        return (time.monotonic_ns() - self._began_ns) * 1e-3


class SimClock:
    """Ticks as fast as they are asked for, on a grid of simulated time."""

    def __init__(self, rate_Hz: float) -> None:
        self._rate_Hz = rate_Hz
        self._index = -1

    def wait(self) -> Timing:
        """The next tick, without waiting."""
        self._index += 1
        now_s = self._index / self._rate_Hz
        return Timing(self._index, now_s, now_s)

    def elapsed_us(self) -> float:
        """Nothing: simulated time stands still within a tick."""
        return 0.0
