"""The recorder: a process of its own that empties the ring into a file, and the supervisor's handle of it.

It starts as `python -m palpd.recording.recorder`, not through multiprocessing, so that it imports nothing but this. The supervisor holds
the pipe between the two. When the pipe closes, the recorder writes the rest of the ring, keeps FILE.part and ends.
"""

import contextlib
import errno
import signal
import subprocess
import sys
import time
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from typing import Self

from palpd.errors import RecordingError
from palpd.recording.header import RecordingFooter, RecordingHeader
from palpd.recording.mcap_file import RecordingWriter, part_of
from palpd.recording.ring import RecorderState, Ring
from palpd.recording.second_channel import SealedAnswer, SecondChannel

CHUNK_S = 0.15
"""How often new rows are compressed and passed to the kernel: a kill -9 of the recorder costs at most this."""


class Recorder:
    """One recording in progress, seen from the supervisor. Raises RecordingError with the recorder's own sentence."""

    def __init__(self, process: subprocess.Popen[bytes], pipe: Connection, path: Path) -> None:
        self._process, self._pipe, self.path = process, pipe, path
        self._part_is_ours = False

    @classmethod
    def begin(
        cls, ring: Ring, path: Path, header: RecordingHeader, model_bytes: bytes | None = None, planted: SealedAnswer | None = None
    ) -> Self:
        """Start a recorder without waiting for it: `answered` says when `confirm` no longer waits.

        Args:
            ring: where the loop writes.
            path: FILE.mcap to write.
            header: what the recording holds besides its ticks.
            model_bytes: the inertial model in use, if any.
            planted: what the second channel holds; None: there is none.

        Returns:
            The recorder, which may still fail to open the file.
        """
        cursor, part_was_there = ring.published, part_of(path).exists()
        ours, theirs = Pipe()
        with theirs:
            command = [sys.executable, "-m", "palpd.recording.recorder", ring.name, str(theirs.fileno())]
            process = subprocess.Popen(command, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL)
        recorder = cls(process, ours, path)
        recorder._part_is_ours = not part_was_there
        recorder._send((path, header, model_bytes, planted, cursor))
        return recorder

    @property
    def pid(self) -> int:
        """Process id of the recorder."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether the recorder still runs."""
        return self._process.poll() is None

    @property
    def answered(self) -> bool:
        """Whether the recorder has answered to the header or the footer, or has died."""
        try:
            return self._pipe.poll()
        except OSError:
            return True

    def confirm(self, timeout_s: float = 0.0) -> None:
        """Take the recorder's answer to the header.

        Args:
            timeout_s: how long the answer may take.

        Raises:
            RecordingError: it could not write, has died, or has not answered in time; no file is left.
        """
        try:
            self._await_answer(timeout_s)
        except RecordingError:
            self.discard()
            raise

    def finish(self, footer: RecordingFooter) -> None:
        """Ask the recorder for the rest of the ring and the footer, without waiting: `answered` says when `close` no longer waits."""
        self._send(footer)

    def close(self, footer: RecordingFooter | None = None, timeout_s: float = 60.0) -> Path:
        """Write the rest of the ring and the footer, and rename the file.

        Args:
            footer: how the run ended; None after `finish`.
            timeout_s: how long the recorder may take.

        Returns:
            The closed recording.

        Raises:
            RecordingError: it could not write, has died, or has not answered in time.
        """
        if footer is not None:
            self.finish(footer)
        try:
            self._await_answer(timeout_s)
        except RecordingError as error:
            part = part_of(self.path)
            raise RecordingError(f"{error}; palpd recover {part} restores what was written" if part.exists() else str(error)) from error
        self._let_go()
        return self.path

    def discard(self) -> None:
        """End a recording that holds no tick, and leave no file of it."""
        self._process.kill()
        self._let_go()
        if self._part_is_ours:
            part_of(self.path).unlink(missing_ok=True)

    def _send(self, order: object) -> None:
        with contextlib.suppress(OSError):  # it is gone; `_await_answer` reads its last message, if any
            self._pipe.send(order)

    def _await_answer(self, timeout_s: float) -> None:
        try:
            sentence = self._pipe.recv() if self._pipe.poll(timeout_s) else "the recorder has not answered in time"
        except (EOFError, OSError):
            sentence = "the recorder has died"
        if sentence is None:
            return
        self._let_go()
        raise RecordingError(sentence)

    def _let_go(self) -> None:
        self._pipe.close()
        try:
            self._process.wait(10.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def record(ring: Ring, pipe: Connection) -> None:
    """Empty the ring into a file until the footer or the end of the pipe comes.

    Args:
        ring: where the loop writes.
        pipe: brings path, header, model, planted effect and cursor first, then the footer; takes None, or why recording failed.
    """
    path, header, model_bytes, planted, cursor = pipe.recv()
    try:
        second = SecondChannel(planted) if planted is not None else None
        writer = RecordingWriter(path, header, model_bytes, second=second)
    except (RecordingError, OSError) as error:
        ring.recorder_errno = getattr(error, "errno", None) or errno.EEXIST
        ring.recorder_state = RecorderState.FAILED
        pipe.send(f"{part_of(path)} cannot be written ({error.strerror}); make room there" if isinstance(error, OSError) else str(error))
        return
    ring.recorder_cursor, ring.recorder_lost, ring.recorder_errno = cursor, 0, 0
    ring.recorder_state = RecorderState.WRITING
    try:
        pipe.send(None)
    except OSError:  # the supervisor waits no longer: its run was refused
        writer.abandon()
        ring.recorder_state = RecorderState.ABSENT
        return
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
    with contextlib.suppress(OSError):  # the supervisor may have ended meanwhile
        pipe.send(sentence)


def _empty_into(writer: RecordingWriter, ring: Ring, cursor: int, pipe: Connection) -> RecordingFooter | None:
    """Copy rows until the footer comes. Without a supervisor, copy until the loop writes no more, and return None."""
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
    """Run the recorder as `Recorder.begin` starts it: `python -m palpd.recording.recorder RING DESCRIPTOR`."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):  # these reach all of palpd; the supervisor closes the recording
        signal.signal(number, signal.SIG_IGN)
    ring = Ring.attach(sys.argv[1])
    with Connection(int(sys.argv[2])) as pipe:
        record(ring, pipe)
    ring.close()


if __name__ == "__main__":
    main()
