"""Shared memory between the real-time loop and everybody slow: a ring of ROWs and a few words of control.

One process writes rows, any number of processes read them, and no process waits for another. Only `create`, `attach` and `watch` enter
the kernel. A process that only shows what goes on uses `watch`: its mapping is read-only, and the file's mode keeps other users of the
group from opening it for writing. A reader that is too slow loses the oldest rows and learns how many. The proof that a copied row is
whole needs stores that become visible in program order. x86-64 guarantees that order, so `create` refuses other machines.
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
"""How long the recorder may stand still before rows are lost: 4 MB at 125 Hz, 33 MB at 1000 Hz."""

_LAYOUT = 2
"""Number of the layout of the control block: raise it when a word or the meaning of its values changes."""
_MAGIC = 0x676E697270 | ROW.itemsize << 40 | _LAYOUT << 56
_STORE_ORDERED = ("x86_64",)
"""Machines whose stores become visible in program order, as `os.uname` calls them."""
_CONTROL_BYTES = 4096
_SHARED = Path("/dev/shm")
_PREFIX = "palpd-"
_MODE = 0o640
"""Permissions of the memory: the user of palpd writes, the group of the control socket may watch, others see nothing."""


class LoopState(IntEnum):
    """What the motion process is doing, as the supervisor sees it; a new ring holds 0 until the first job."""

    STARTING = 1
    RUNNING = 2
    ENDED = 3


class RecorderState(IntEnum):
    """State of the recording; FAILED leaves the reason in `recorder_errno`."""

    ABSENT = 0
    WRITING = 1
    CLOSED = 2
    FAILED = 3


class _Word:
    """One 64-bit word of the control block: a single aligned load or store, so never torn."""

    def __init__(self, index: int) -> None:
        self.index = index

    def __get__(self, ring: "Ring", _: type) -> int:
        return ring.words[self.index]

    def __set__(self, ring: "Ring", value: int) -> None:
        ring.words[self.index] = value


class Ring:
    """A ring of rows (dtype ROW) in shared memory, with one producer and any number of readers.

    Each word of the control block has one writer, named beside it. A reader keeps its own cursor: the number of the next row to read,
    counted from 0 at the ring's creation. `words` is the control block as 64-bit words.
    """

    _magic = _Word(0)
    _capacity = _Word(1)
    _begun = _Word(2)
    published = _Word(3)  # loop: rows written since the ring was created

    state = _Word(8)  # loop: LoopState; supervisor: STARTING
    aborts_taken = _Word(9)  # loop
    pauses_taken = _Word(10)  # loop

    aborts = _Word(16)  # supervisor: number of aborts requested so far
    pauses = _Word(17)  # supervisor: (number << 8 | Request) of the newest PAUSE or RESUME

    recorder_state = _Word(24)  # recorder: RecorderState
    recorder_cursor = _Word(25)  # recorder: rows on their way to the file
    recorder_lost = _Word(26)  # recorder: rows that were overwritten before it read them
    recorder_errno = _Word(27)  # recorder: errno of the error that ended it (28: disk full)

    def __init__(self, name: str, memory: SharedMemory | mmap.mmap, buffer: memoryview, capacity: int) -> None:
        self.name = name
        self._memory = memory
        self.words = buffer[:_CONTROL_BYTES].cast("Q")
        self._rows: Rows = np.ndarray(capacity, ROW, buffer, _CONTROL_BYTES)
        self.capacity = capacity

    @classmethod
    def create(cls, rate_Hz: float, seconds: float = RING_S) -> Self:
        """Create a ring and touch every page of it.

        Args:
            rate_Hz: ticks per second.
            seconds: how many seconds of ticks the ring holds.

        Returns:
            The empty ring.

        Raises:
            PalpdError: this machine may reorder stores.
        """
        machine = os.uname().machine
        if machine not in _STORE_ORDERED:
            raise PalpdError(
                f"this machine is {machine}, but palpd's shared memory needs the store order of {' or '.join(_STORE_ORDERED)}; "
                "run palpd on such a machine"
            )
        _sweep()
        capacity = max(2, round(rate_Hz * seconds))
        name = f"{_PREFIX}{os.getpid()}-{os.urandom(4).hex()}"
        memory = SharedMemory(name, create=True, size=_CONTROL_BYTES + capacity * ROW.itemsize)
        (_SHARED / name).chmod(_MODE)
        buffer = memory.buf
        assert buffer is not None  # only after close
        np.frombuffer(buffer, np.uint8)[:] = 0
        ring = cls(memory.name, memory, buffer, capacity)
        ring._capacity = capacity
        ring._magic = _MAGIC
        return ring

    @classmethod
    def attach(cls, name: str) -> Self:
        """Open a ring that another process created. Raises PalpdError.

        It avoids SharedMemory: before Python 3.13 every process that attaches unlinks the memory when it exits.
        """
        return cls._mapped(name, os.O_RDWR, mmap.PROT_READ | mmap.PROT_WRITE)

    @classmethod
    def watch(cls, name: str) -> Self:
        """Open a ring that another process created, for reading only: the kernel refuses each write. Raises PalpdError."""
        return cls._mapped(name, os.O_RDONLY, mmap.PROT_READ)

    @classmethod
    def _mapped(cls, name: str, mode: int, protection: int) -> Self:
        try:
            file = os.open(_SHARED / name, mode)
        except OSError as error:
            raise PalpdError(f"the shared memory {name} cannot be opened ({error.strerror}); start palpd again") from error
        try:
            memory = mmap.mmap(file, 0, prot=protection)
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
        """Return all of the ring's rows (capacity,), for its producer."""
        return self._rows

    def begin(self) -> int:
        """Return the number of the row to fill next, in place. The row still holds old values: set every field."""
        number = self.published
        self._begun = number + 1
        return number % self.capacity

    def publish(self) -> None:
        """Make the row of the last `begin()` visible to readers."""
        self.published += 1

    def write(self, row: np.void | Rows) -> None:
        """Copy one row into the ring.

        Args:
            row: a ROW, or an array of one.
        """
        number = self.published
        self._begun = number + 1
        self._rows[number % self.capacity] = row
        self.published = number + 1

    def read(self, cursor: int) -> tuple[Rows, int, int]:
        """Copy every row from number `cursor` on. Returns the rows, the next cursor and the number of rows overwritten before the copy."""
        end = self.published
        begin = max(cursor, end - self.capacity)
        rows = self._rows[np.arange(begin, end) % self.capacity]
        overwritten = max(0, min(self._begun - self.capacity, end) - begin)
        return rows[overwritten:], end, begin - cursor + overwritten

    @property
    def recorder_lag(self) -> int:
        """Number of published rows that the recorder has not taken yet."""
        return self.published - self.recorder_cursor

    def ask(self, request: Request) -> None:
        """For the supervisor: pass a request of the operator on. No later request overtakes an abort."""
        if request == Request.ABORT:
            self.aborts += 1
        elif request in (Request.PAUSE, Request.RESUME):
            self.pauses = ((self.pauses >> 8) + 1) << 8 | request

    def request(self) -> Request:
        """For the loop: return the request since the last call, each request once."""
        aborts, pauses = self.aborts, self.pauses
        if aborts != self.aborts_taken:
            self.aborts_taken = aborts
            return Request.ABORT
        if pauses != self.pauses_taken:
            self.pauses_taken = pauses
            return Request(pauses & 0xFF)
        return Request.NONE

    @property
    def abort_waits(self) -> bool:
        """Whether an abort was asked for that the loop has not taken yet."""
        return self.aborts != self.aborts_taken

    def forget_requests(self) -> None:
        """Before a run: drop the requests that an earlier run has not taken."""
        self.aborts_taken, self.pauses_taken = self.aborts, self.pauses

    def close(self) -> None:
        """Unmap the memory; do not use `rows` afterwards. Where this process created it, its name goes too: who has it open keeps it."""
        if isinstance(self._memory, SharedMemory):
            self._memory.unlink()
        del self._rows
        self.words.release()
        with contextlib.suppress(BufferError):  # a caller still holds a row: the mapping ends with the process
            self._memory.close()


def _sweep() -> None:
    """Remove the memory of processes that were killed together with their supervisor."""
    for path in _SHARED.glob(f"{_PREFIX}*-*"):
        pid = path.name.removeprefix(_PREFIX).partition("-")[0]
        if pid.isdigit() and not Path("/proc", pid).exists():
            with contextlib.suppress(OSError):  # another user's
                path.unlink()
