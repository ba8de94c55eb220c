"""A device's clock on the host's monotonic clock, by the smallest delay seen. Both drivers use it; it opens nothing."""

import math


class MinimumDelayClock:
    """Maps device times to host times: host = device + the smallest (arrival - device time) seen.

    Data may arrive late but never early, so the smallest difference is the best estimate of the offset. The estimate rises by `leak`
    seconds a second, so that it follows a device clock that is slower than the host's by less than that. A faster device clock lowers
    the offset by itself. The error is one-sided: host times are late by the shortest way from device to host.

    A device time that is off by more than `longest_jump_s` was started anew, and the estimate begins again.
    """

    def __init__(self, leak: float, longest_jump_s: float = math.inf) -> None:
        self.offset_s = math.inf
        self._leak, self._longest_jump_s = leak, longest_jump_s
        self._arrival_s = 0.0

    @property
    def synchronised(self) -> bool:
        """Whether the clock has an offset."""
        return math.isfinite(self.offset_s)

    def see(self, device_s: float, arrival_s: float) -> float:
        """Take in one arrival.

        Args:
            device_s: device time of the data, in s.
            arrival_s: host time at which the data was there, in s.

        Returns:
            The offset in s.
        """
        offset_s = arrival_s - device_s
        if abs(offset_s - self.offset_s) <= self._longest_jump_s:
            offset_s = min(self.offset_s + self._leak * max(0.0, arrival_s - self._arrival_s), offset_s)
        self.offset_s, self._arrival_s = offset_s, arrival_s
        return offset_s

    def restart(self) -> None:
        """Forget the offset: the device's clock was started anew."""
        self.offset_s = math.inf

    def host_s(self, device_s: float) -> float:
        """Return the host time of a device time."""
        return device_s + self.offset_s
