"""A witness of this computer: a process of its own that notes when a processor stood still.

A device is called silent by the age of its newest data. That age grows just as much while this computer stands still and reads nothing.
The witness has nothing to do but to wake: one thread a processor, at the priority of the driver's threads. So it tells the two apart, and
the loop pays nothing for it. This file runs by itself and imports nothing of palpd: a light process has 12 MB.
"""

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterable
from typing import NamedTuple

WAKE_S = 0.01
"""Pause between two wake-ups: a stall is seen from its first 10 ms on, and each processor is busy with it for 0.5 % of the time."""
LATE_S = 0.02
"""Wake-up after its time that counts as a stall: above what a scheduler does, below the 50 ms that a device may be silent."""


class Stall(NamedTuple):
    """A processor ran nothing of the witness's priority from `begin_s` to `end_s`, on the clock of the ticks."""

    begin_s: float
    end_s: float
    processor: int


class Witness:
    """The witness as the supervisor sees it; nothing here waits. It ends with the supervisor.

    Attributes:
        stalls: The stalls that it has reported so far.
        urgent: Whether it has real-time priority. Without, other work of this computer looks like a stall.
        processors: Number of the processors that it watches; 0 before it has started.
    """

    def __init__(self, priority: int) -> None:
        self.stalls: list[Stall] = []
        self.urgent, self.processors = False, 0
        self._rest = b""
        self._process: subprocess.Popen[bytes] | None = None
        with contextlib.suppress(OSError):  # a run without a witness is a run
            self._process = subprocess.Popen(
                [sys.executable, "-IS", __file__, str(priority)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
            )
            assert self._process.stdout is not None
            os.set_blocking(self._process.stdout.fileno(), False)

    def hear(self) -> list[Stall]:
        """Take what it has reported; returns all of its stalls."""
        if self._process is not None and self._process.stdout is not None and not self._process.stdout.closed:
            with contextlib.suppress(OSError):
                self._rest += os.read(self._process.stdout.fileno(), 1 << 16)
        *lines, self._rest = self._rest.split(b"\n")
        for line in lines:
            kind, *words = line.split()
            if kind == b"watching":
                self.urgent, self.processors = words[0] == b"1", self.processors + 1
            else:
                self.stalls.append(Stall(float(words[0]), float(words[1]), int(words[2])))
        return self.stalls

    def end(self) -> None:
        """Let it go, after a last look at its reports."""
        if self._process is None:
            return
        self.hear()
        self._process.kill()
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                stream.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(0.2)
        self._process = None


def stood_still(stalls: Iterable[Stall], since_s: float, until_s: float) -> tuple[float, list[int]]:
    """How long a processor, at the least, stood still in a span of time.

    Args:
        stalls: What the witness reported.
        since_s: Begin of the span.
        until_s: End of the span.

    Returns:
        The time in s in which one processor or more stood still, and which processors.
    """
    inside = sorted(
        (max(stall.begin_s, since_s), min(stall.end_s, until_s), stall.processor)
        for stall in stalls
        if stall.begin_s < until_s and stall.end_s > since_s
    )
    together_s, reached_s = 0.0, since_s
    for begin_s, end_s, _ in inside:
        together_s += max(0.0, end_s - max(begin_s, reached_s))
        reached_s = max(reached_s, end_s)
    return together_s, sorted({processor for _, _, processor in inside})


def _watch(processor: int, urgent: bool) -> None:
    """Wake again and again on one processor, and report each wake-up that came too late."""
    with contextlib.suppress(OSError):
        os.sched_setaffinity(0, {processor})
    _report(f"watching {urgent:d}")
    due_s = time.monotonic()
    while True:
        due_s += WAKE_S
        time.sleep(max(0.0, due_s - time.monotonic()))
        woke_s = time.monotonic()
        if woke_s - due_s > LATE_S:
            _report(f"stall {due_s:.6f} {woke_s:.6f} {processor}")
            due_s = woke_s


def _report(line: str) -> None:
    with contextlib.suppress(OSError):  # nobody takes it, or the pipe is full: then there were a thousand before
        os.write(1, line.encode() + b"\n")


def main() -> None:
    """Watch every processor of this process until the supervisor's end of the pipe closes."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):  # these reach all of palpd; a run that ends by them has stalls too
        signal.signal(number, signal.SIG_IGN)
    os.set_blocking(1, False)
    urgent = True
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(int(sys.argv[1])))  # the threads inherit it
    except OSError:
        urgent = False
    for processor in os.sched_getaffinity(0):
        threading.Thread(target=_watch, args=(processor, urgent), daemon=True).start()
    os.read(0, 1)
    os._exit(0)


if __name__ == "__main__":
    main()
