"""The recorder: a process of its own that empties the ring into a file, and the handle by which the supervisor holds it.

It starts as `python -m palpd.recorder`, not through multiprocessing, so that it imports nothing but this. The pipe between the two
is also the leash: when the supervisor is gone, the recorder writes what is left in the ring and ends, leaving FILE.part.
"""

import contextlib
import errno
import signal
import subprocess
import sys
import time
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from typing import Any, Self

from palpd.errors import RecordingError
from palpd.mcap_file import RecordingWriter, part_of
from palpd.ring import RecorderState, Ring

CHUNK_S = 0.15
"""How often what has come is compressed and given to the kernel: what a kill -9 of the recorder can cost, and not more."""


class Recorder:
    """One recording in progress, seen from the supervisor. Raises RecordingError with the recorder's own sentence."""

    def __init__(self, process: subprocess.Popen[bytes], pipe: Connection, path: Path) -> None:
        self._process, self._pipe, self.path = process, pipe, path

    @classmethod
    def start(cls, ring: Ring, path: Path, header: dict[str, Any], model_bytes: bytes | None = None, timeout_s: float = 20.0) -> Self:
        """Start recording every row published from now on; returns when the file is open and the header is in it."""
        cursor = ring.published
        ours, theirs = Pipe()
        with theirs:
            command = [sys.executable, "-m", "palpd.recorder", ring.name, str(theirs.fileno())]
            process = subprocess.Popen(command, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL)
        recorder = cls(process, ours, path)
        recorder._tell((path, header, model_bytes, cursor))
        recorder._answer(timeout_s)
        return recorder

    @property
    def pid(self) -> int:
        """The recorder's process."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether the recorder still runs."""
        return self._process.poll() is None

    def close(self, footer: dict[str, Any], timeout_s: float = 60.0) -> Path:
        """Write what is left in the ring and the footer, and give the file its name."""
        self._tell(footer)
        self._answer(timeout_s)
        self._let_go()
        return self.path

    def _tell(self, order: object) -> None:
        with contextlib.suppress(OSError):  # it is gone; `_answer` finds its last words, or none
            self._pipe.send(order)

    def _answer(self, timeout_s: float) -> None:
        try:
            sentence = self._pipe.recv() if self._pipe.poll(timeout_s) else f"the recorder has not answered for {timeout_s:g} s"
        except (EOFError, OSError):
            sentence = "the recorder has died"
        if sentence is None:
            return
        self._let_go()
        kept = f"; palpd recover {part_of(self.path)} restores what was written" if part_of(self.path).exists() else ""
        raise RecordingError(sentence + kept)

    def _let_go(self) -> None:
        self._pipe.close()
        try:
            self._process.wait(10.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def record(ring: Ring, pipe: Connection) -> None:
    """Empty the ring into the file that the first message names, until the second message (the footer) or the end of the pipe."""
    path, header, model_bytes, cursor = pipe.recv()
    try:
        writer = RecordingWriter(path, header, model_bytes)
    except (RecordingError, OSError) as error:
        ring.recorder_errno = getattr(error, "errno", None) or errno.EEXIST
        ring.recorder_state = RecorderState.FAILED
        pipe.send(str(error))
        return
    ring.recorder_cursor, ring.recorder_lost, ring.recorder_errno = cursor, 0, 0
    ring.recorder_state = RecorderState.WRITING
    pipe.send(None)
    sentence = None
    try:
        footer = _empty_into(writer, ring, cursor, pipe)
        if footer is None:
            writer.abandon()
            ring.recorder_state = RecorderState.ABSENT
            return
        writer.close({**footer, "lost_rows": ring.recorder_lost})
        ring.recorder_state = RecorderState.CLOSED
    except (RecordingError, OSError) as error:
        writer.abandon()
        ring.recorder_errno = getattr(error, "errno", None) or errno.EIO
        ring.recorder_state = RecorderState.FAILED
        reason = error.strerror if isinstance(error, OSError) else error
        sentence = f"the recording {path} stopped after {ring.recorder_cursor - cursor} ticks ({reason})"
    with contextlib.suppress(OSError):  # the supervisor may have gone meanwhile
        pipe.send(sentence)


def _empty_into(writer: RecordingWriter, ring: Ring, cursor: int, pipe: Connection) -> dict[str, Any] | None:
    """Copy rows until the footer comes. Without a supervisor none will: then until the loop, which stops too, writes no more; None."""
    orphaned = False
    while True:
        footer = None
        if orphaned:
            time.sleep(CHUNK_S)
        elif pipe.poll(CHUNK_S):
            try:
                footer = pipe.recv()
            except (EOFError, OSError):
                orphaned = True
        rows, cursor, lost = ring.read(cursor)
        ring.recorder_lost += lost
        ring.recorder_cursor = cursor
        writer.write(rows)
        writer.flush()
        if footer is not None or (orphaned and not len(rows)):
            return footer


def main() -> None:
    """`python -m palpd.recorder RING DESCRIPTOR`: what `Recorder.start` starts."""
    for number in (signal.SIGINT, signal.SIGTERM):  # sent to all of palpd at once; the supervisor ends the recording in order
        signal.signal(number, signal.SIG_IGN)
    ring = Ring.attach(sys.argv[1])
    with Connection(int(sys.argv[2])) as pipe:
        record(ring, pipe)
    ring.close()


if __name__ == "__main__":
    main()
