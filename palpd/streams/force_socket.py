"""The compensated force of each tick for other programs: a fixed binary record over a Unix socket. A slow reader loses records.

The socket is of type SEQPACKET: a reader connects and receives whole records, and the file's permissions say who may. Each reader has a
send buffer of its own, the smallest that Linux gives, for some five records. While it is full, its newer records are left out and nobody
waits. So a reader that was away finds at most these old records, and then the present. docs/streams.md has the record and a client.
"""

import contextlib
import os
import socket
import struct
import time
from pathlib import Path
from typing import NamedTuple

from palpd.errors import Refused
from palpd.files import clear_socket
from palpd.recording.ring import Rows
from palpd.recording.tick_rows import filled_slots
from palpd.recording.topics import compensated

RECORD = struct.Struct("<4sBBHQ3d6d")
"""Magic, phase, action, version, sequence; sensor_s, tick_s, sent_s; force (3,) in N and torque (3,) in Nm: 88 bytes."""
MAGIC, VERSION = b"PFRC", 1
MOST_READERS = 16
"""Largest number of readers: a record costs some 10 µs for each."""


class ForceRecord(NamedTuple):
    """A record, unpacked; docs/streams.md says what its fields mean."""

    magic: bytes
    phase: int
    action: int
    version: int
    sequence: int
    sensor_s: float
    tick_s: float
    sent_s: float
    fx_N: float
    fy_N: float
    fz_N: float
    mx_Nm: float
    my_Nm: float
    mz_Nm: float


class ForceSocket:
    """Listens at `path` (mode 660), and sends the newest record to every reader without waiting for any. Raises Refused."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._readers: list[socket.socket] = []
        self._sensor_s = float("nan")
        self._wrench: list[float] = [float("nan")] * 6
        clear_socket(path)
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        mask = os.umask(0o117)  # never open wider, not even for the moment between bind and chmod
        try:
            self._listener.bind(str(path))
        except OSError as error:
            self._listener.close()
            raise Refused(f"{path} cannot be made ({error.strerror or error}); name a socket in a folder that exists") from error
        finally:
            os.umask(mask)
        self._listener.listen(MOST_READERS)
        self._listener.setblocking(False)

    def fileno(self) -> int:
        """The listening socket, for whoever waits until a reader comes."""
        return self._listener.fileno()

    @property
    def read(self) -> bool:
        """Whether anybody reads."""
        return bool(self._readers)

    def accept(self) -> None:
        """Let the readers in that wait; those beyond `MOST_READERS` are closed."""
        for reader in list(self._readers):
            if _is_gone(reader):
                self._drop(reader)
        while True:
            try:
                reader, _ = self._listener.accept()
            except OSError:  # nobody waits any more, or no file descriptors are left
                return
            if len(self._readers) >= MOST_READERS:
                reader.close()
                continue
            reader.setblocking(False)
            reader.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1)  # the kernel makes it the least that it allows
            self._readers.append(reader)

    def send(self, rows: Rows, next_number: int) -> None:
        """Send a record of the newest row to each reader that has room.

        Args:
            rows: New rows (n,), at least one.
            next_number: Number of the row after them.
        """
        filled = filled_slots(rows)
        if filled.any():  # a tick without frames repeats the last force, and its time says how old that is
            self._sensor_s = float(rows["frame_t_s"][filled][-1])
            self._wrench = compensated(rows, filled)[-1].tolist()
        if not self._readers:
            return
        row = rows[-1]
        head = (MAGIC, int(row["phase"]), int(row["action"]), VERSION, next_number - 1, self._sensor_s, float(row["now_s"]))
        for reader in list(self._readers):
            try:
                reader.send(RECORD.pack(*head, time.monotonic(), *self._wrench))
            except BlockingIOError:  # it is slow: it loses this record
                continue
            except OSError:
                self._drop(reader)

    def close(self) -> None:
        """Stop listening and remove the socket's file."""
        for reader in self._readers:
            reader.close()
        self._listener.close()
        with contextlib.suppress(OSError):
            self.path.unlink(missing_ok=True)

    def _drop(self, reader: socket.socket) -> None:
        self._readers.remove(reader)
        reader.close()


def _is_gone(reader: socket.socket) -> bool:
    try:
        return reader.recv(1) == b""
    except BlockingIOError:
        return False
    except OSError:
        return True
