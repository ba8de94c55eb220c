"""Shared memory between the real-time loop and everybody slow: a ring of ROWs and a few words of control.

One process writes rows, any number read them; nobody waits for anybody and no call below `create` and `attach` enters the
kernel. A reader that is too slow loses the oldest rows and is told how many. The proof that a copied row is whole rests on
stores becoming visible in program order, as they do on x86-64.
"""

import contextlib
import mmap
import os
from enum import IntEnum
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from palpd.errors import PalpdError
from palpd.tick import ROW, Request

Rows = NDArray[np.void]

RING_S = 4.0
"""How long the recorder may be kept from running before rows are lost: 4 MB at 125 Hz, 33 MB at 1000 Hz."""

_MAGIC = 0x676E697270 | ROW.itemsize << 40
_CONTROL_BYTES = 4096
_SHARED = Path("/dev/shm")
_PREFIX = "palpd-"


class LoopState(IntEnum):
    """What the motion process is doing, as the supervisor and the operator's page see it."""

    ABSENT = 0
    STARTING = 1
    DISARMED = 2
    ARMED = 3
    RUNNING = 4
    PAUSED = 5
    ENDED = 6
    STOPPED = 7


class RecorderState(IntEnum):
    """What became of the recording; FAILED leaves the reason in `recorder_errno`."""

    ABSENT = 0
    WRITING = 1
    CLOSED = 2
    FAILED = 3


class _Word:
    """One 64-bit word of the control block: a single aligned load or store, so never torn."""

    def __init__(self, index: int) -> None:
        self.index = index

    def __get__(self, ring: "Ring", _: type) -> int:
        return ring._words[self.index]

    def __set__(self, ring: "Ring", value: int) -> None:
        ring._words[self.index] = value


class Ring:
    """A ring of rows (dtype ROW) in shared memory, with one producer and any number of readers.

    Each word of the control block has one writer, named beside it. A reader keeps its own cursor: the number of the next row it
    wants, counted from 0 when the ring was made.
    """

    _magic = _Word(0)
    _capacity = _Word(1)
    _begun = _Word(2)
    published = _Word(3)  # loop: rows written since the ring was made

    ticks = _Word(8)  # loop: turns of any kind, recorded or not; what the watchdog looks at
    missed_ticks = _Word(9)  # loop
    state = _Word(10)  # loop: LoopState; supervisor: ABSENT when the process is gone
    aborts_taken = _Word(11)  # loop
    turns_taken = _Word(12)  # loop

    aborts = _Word(16)  # supervisor: how many have been asked for
    turns = _Word(17)  # supervisor: (number << 8 | Request) of the newest PAUSE or RESUME
    supervisor_beats = _Word(18)  # supervisor: moves while it lives

    recorder_state = _Word(24)  # recorder: RecorderState
    recorder_cursor = _Word(25)  # recorder: rows on their way to the file
    recorder_lost = _Word(26)  # recorder: rows that were overwritten before it read them
    recorder_errno = _Word(27)  # recorder: errno of what ended it (28: disk full)

    def __init__(self, name: str, memory: SharedMemory | mmap.mmap, buffer: memoryview, capacity: int) -> None:
        self.name = name
        self._memory = memory
        self._words = buffer[:_CONTROL_BYTES].cast("Q")
        self._rows: Rows = np.ndarray(capacity, ROW, buffer, _CONTROL_BYTES)
        self.capacity = capacity

    @classmethod
    def create(cls, rate_Hz: float, seconds: float = RING_S) -> Self:
        """Make a ring for `seconds` of ticks at `rate_Hz`, every page of it touched; whoever creates it also calls `unlink`."""
        _sweep()
        capacity = max(2, round(rate_Hz * seconds))
        name = f"{_PREFIX}{os.getpid()}-{os.urandom(4).hex()}"
        memory = SharedMemory(name, create=True, size=_CONTROL_BYTES + capacity * ROW.itemsize)
        buffer = memory.buf
        assert buffer is not None  # only after close
        np.frombuffer(buffer, np.uint8)[:] = 0
        ring = cls(memory.name, memory, buffer, capacity)
        ring._capacity = capacity
        ring._magic = _MAGIC
        return ring

    @classmethod
    def attach(cls, name: str) -> Self:
        """Open a ring that another process made. Raises PalpdError.

        Not through SharedMemory: Python before 3.13 has every process that attaches unlink the memory when it exits.
        """
        path = _SHARED / name
        try:
            file = os.open(path, os.O_RDWR)
        except OSError as error:
            raise PalpdError(f"the shared memory {name} is not there ({error.strerror}); start palpd again") from error
        try:
            memory = mmap.mmap(file, 0)
        finally:
            os.close(file)
        buffer = memoryview(memory)
        ring = cls(name, memory, buffer, (len(buffer) - _CONTROL_BYTES) // ROW.itemsize)
        if ring._magic != _MAGIC or ring._capacity > ring.capacity:
            raise PalpdError(f"the shared memory {name} was made by another version of palpd; stop all of palpd and start it again")
        ring.capacity = ring._capacity  # the kernel rounds the size up to whole pages
        return ring

    @property
    def rows(self) -> Rows:
        """All of the ring's memory (capacity,), for its producer."""
        return self._rows

    def begin(self) -> int:
        """Which of `rows` to fill next, in place. It holds an old one: every field that is read later must be set."""
        number = self.published
        self._begun = number + 1
        return number % self.capacity

    def publish(self) -> None:
        """Let readers have the row of the last `begin()`."""
        self.published += 1

    def write(self, row: np.void | Rows) -> None:
        """Copy one row (a ROW, or an array of one) into the ring."""
        number = self.published
        self._begun = number + 1
        self._rows[number % self.capacity] = row
        self.published = number + 1

    def read(self, cursor: int) -> tuple[Rows, int, int]:
        """Copy every row from number `cursor` on: (rows, next cursor, how many rows were overwritten before they could be copied)."""
        end = self.published
        begin = max(cursor, end - self.capacity)
        rows = self._rows[np.arange(begin, end) % self.capacity]
        overwritten = max(0, min(self._begun - self.capacity, end) - begin)
        return rows[overwritten:], end, begin - cursor + overwritten

    @property
    def recorder_lag(self) -> int:
        """How many published rows the recorder has not taken yet."""
        return self.published - self.recorder_cursor

    def ask(self, request: Request) -> None:
        """For the supervisor: pass on what the operator wants. An abort cannot be overtaken by anything asked later."""
        if request == Request.ABORT:
            self.aborts += 1
        elif request in (Request.PAUSE, Request.RESUME):
            self.turns = ((self.turns >> 8) + 1) << 8 | request

    def request(self) -> Request:
        """For the loop: what has been asked since the last call, each request once."""
        aborts, turns = self.aborts, self.turns
        if aborts != self.aborts_taken:
            self.aborts_taken = aborts
            return Request.ABORT
        if turns != self.turns_taken:
            self.turns_taken = turns
            return Request(turns & 0xFF)
        return Request.NONE

    def forget_requests(self) -> None:
        """For the loop, before a run: what was asked of an earlier one is void."""
        self.aborts_taken, self.turns_taken = self.aborts, self.turns

    def close(self) -> None:
        """Let go of the memory; `rows` must not be used any more."""
        del self._rows
        self._words.release()
        with contextlib.suppress(BufferError):  # somebody still holds a record: the mapping goes with the process
            self._memory.close()

    def unlink(self) -> None:
        """Remove the memory's name; processes that have it open keep it. For the process that created it."""
        if isinstance(self._memory, SharedMemory):
            self._memory.unlink()


def _sweep() -> None:
    """Remove what processes left behind that were killed together with everything that would have tidied up after them."""
    for path in _SHARED.glob(f"{_PREFIX}*-*"):
        pid = path.name.removeprefix(_PREFIX).partition("-")[0]
        if pid.isdigit() and not Path("/proc", pid).exists():
            with contextlib.suppress(OSError):  # another user's
                path.unlink()
