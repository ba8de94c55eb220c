"""A recording on disk: MCAP with ROS 2 messages that any MCAP or ROS 2 tool opens, and /tick, from which every row comes back bit for bit.

/tick alone holds the whole row; the other topics show parts of it in standard messages. In a compressed chunk the repeated numbers
cost almost nothing, and reading back needs one topic. While it is written a recording is called FILE.part.
"""

import contextlib
import fcntl
import io
import itertools
import json
import os
import struct
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, DataEnd, Metadata, Schema
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray
from zstandard import ZstdError

from palpd import cdr
from palpd.errors import RecordingError
from palpd.tick import Floats

Rows = NDArray[np.void]

TICK_TOPIC = "/tick"
HEADER, FOOTER, MODEL = "palpd.header", "palpd.footer", "model.onnx"
_SCHEMAS = {
    "geometry_msgs/msg/PoseStamped": cdr.POSE_STAMPED,
    "geometry_msgs/msg/TwistStamped": cdr.TWIST_STAMPED,
    "geometry_msgs/msg/WrenchStamped": cdr.WRENCH_STAMPED,
    "palpd_msgs/msg/Tick": cdr.TICK,
}
_TOPICS = {
    "/tcp_pose": "geometry_msgs/msg/PoseStamped",
    "/tcp_twist": "geometry_msgs/msg/TwistStamped",
    "/target_pose": "geometry_msgs/msg/PoseStamped",
    "/wrench_raw": "geometry_msgs/msg/WrenchStamped",
    "/wrench": "geometry_msgs/msg/WrenchStamped",
    TICK_TOPIC: "palpd_msgs/msg/Tick",
}
_NEAR_S = 10.0
"""A sample's own time is believed within this of its tick; a robot that has never answered has none."""

_LEAST_APART_S = 0.007
"""Of states of the robot closer than this the standard topics show only some: at 500 Hz that saves 2.5 of 17 MB a minute."""

_UNREADABLE = (McapError, ZstdError, struct.error, ValueError, KeyError, RuntimeError, MemoryError, OverflowError)
"""What the readers raise on bytes that were cut off or changed."""


def part_of(path: Path) -> Path:
    """What FILE.mcap is called until it is closed."""
    return path.with_suffix(".part")


class RecordingWriter:
    """Writes one recording; what has been flushed survives the death of this process.

    `header` must be JSON; `epoch_offset_s` (what to add to monotonic seconds to get Unix time) is taken now where it is absent.
    Raises RecordingError where `path` or its .part exists, OSError where the disk fails.
    """

    def __init__(self, path: Path, header: dict[str, Any], model_bytes: bytes | None = None, part: Path | None = None) -> None:
        self.path, self.part = path, part or part_of(path)
        for taken in (self.path, self.part):
            if taken.exists():
                raise RecordingError(f"{taken} exists and is not overwritten; choose another name or move it away")
        header = {"epoch_offset_s": time.time() - time.monotonic(), **header}
        self._offset_ns = round(header["epoch_offset_s"] * 1e9)
        about = {"json": json.dumps(header)}
        try:
            self._stream = self.part.open("xb")
        except OSError as error:
            raise RecordingError(f"{self.part} cannot be written ({error.strerror}); choose a directory that can") from error
        fcntl.flock(self._stream, fcntl.LOCK_EX)
        self._robot_t_s = float("nan")
        self._writer = Writer(self._stream, chunk_size=1 << 30, compression=CompressionType.ZSTD, enable_data_crcs=True)
        self._writer.start(profile="ros2", library="palpd")
        self._writer.add_metadata(HEADER, about)
        if model_bytes is not None:
            self._writer.add_attachment(0, 0, MODEL, "application/octet-stream", model_bytes)
        schema = {name: self._writer.register_schema(name, "ros2msg", text.encode()) for name, text in _SCHEMAS.items()}
        self._channel = {topic: self._writer.register_channel(topic, "cdr", schema[name]) for topic, name in _TOPICS.items()}
        self._sequence = dict.fromkeys(_TOPICS, 0)
        self._writer.flush()

    def write(self, rows: Rows) -> None:
        """Add rows, in the order of their ticks; they reach the disk with `flush`."""
        if not len(rows):
            return
        with np.errstate(all="ignore"):  # a sensor that sends nonsense is to be recorded, not complained about
            self._write_robot(rows)
            self._write_frames(rows)
            stamp_ns = self._epoch_ns(rows["now_s"], rows["now_s"])
        self._add(TICK_TOPIC, stamp_ns, cdr.pack_ticks(stamp_ns, rows))

    def flush(self) -> None:
        """Close the chunk in hand and give it to the kernel."""
        self._writer.flush()

    def close(self, footer: dict[str, Any]) -> Path:
        """Finish the file, see it onto the disk, and call it by its name."""
        self._writer.flush()
        self._writer.add_metadata(FOOTER, {"json": json.dumps(footer)})
        self._writer.finish()
        self._stream.flush()
        os.fsync(self._stream.fileno())
        if self.path.exists():
            raise RecordingError(f"{self.path} has come into being meanwhile; the recording stands whole in {self.part}")
        self.part.rename(self.path)
        self._stream.close()
        directory = os.open(self.path.parent, os.O_RDONLY)
        try:
            os.fsync(directory)
        finally:
            os.close(directory)
        return self.path

    def abandon(self) -> None:
        """Let go of the file and leave it unfinished."""
        with contextlib.suppress(OSError):  # a full disk has already been told
            self._stream.close()

    def _write_robot(self, rows: Rows) -> None:
        """Pose, twist and target of every new state, of a controller faster than 125 Hz at about that rate."""
        new = []
        for number, t_s in enumerate(rows["robot_t_s"].tolist()):
            if not abs(t_s - self._robot_t_s) < _LEAST_APART_S:
                new.append(number)
                self._robot_t_s = t_s
        rows = rows[new]
        stamp_ns = self._epoch_ns(rows["robot_t_s"], rows["now_s"])
        for topic, name in (("/tcp_pose", "tcp_pose"), ("/target_pose", "target_pose")):
            pose = np.hstack([rows[name][:, :3], cdr.quaternion(rows[name][:, 3:])])
            self._add(topic, stamp_ns, cdr.pack_stamped(stamp_ns, cdr.BASE_FRAME, pose))
        self._add("/tcp_twist", stamp_ns, cdr.pack_stamped(stamp_ns, cdr.BASE_FRAME, rows["tcp_speed"]))

    def _write_frames(self, rows: Rows) -> None:
        """The wrench of every sensor frame, as measured and as compensated."""
        filled = np.arange(rows["frame_t_s"].shape[1]) < rows["frames"][:, None]
        stamp_ns = self._epoch_ns(rows["frame_t_s"][filled], np.repeat(rows["now_s"], rows["frames"]))
        contact = rows["tared"][filled]
        contact[:, 2] -= rows["inertial_N"][filled]
        self._add("/wrench_raw", stamp_ns, cdr.pack_stamped(stamp_ns, cdr.SENSOR_FRAME, rows["wrench"][filled]))
        self._add("/wrench", stamp_ns, cdr.pack_stamped(stamp_ns, cdr.BASE_FRAME, contact))

    def _epoch_ns(self, t_s: Floats, tick_s: Floats) -> cdr.Nanoseconds:
        t_s = np.where(np.abs(t_s - tick_s) < _NEAR_S, t_s, tick_s)
        t_s = np.clip(np.nan_to_num(t_s), 0.0, 1e9)
        since_boot_ns: cdr.Nanoseconds = np.rint(t_s * 1e9).astype(np.int64)
        return np.maximum(since_boot_ns + self._offset_ns, 0)

    def _add(self, topic: str, stamp_ns: cdr.Nanoseconds, messages: list[bytes]) -> None:
        channel, sequence = self._channel[topic], self._sequence[topic]
        for number, (time_ns, data) in enumerate(zip(stamp_ns.tolist(), messages, strict=True), sequence):
            self._writer.add_message(channel, time_ns, data, time_ns, number & 0xFFFFFFFF)
        self._sequence[topic] += len(messages)


@dataclass
class Contents:
    """What a file holds as far as it can be read: `torn` is a phrase saying where and why reading stopped, empty for a whole file."""

    header: dict[str, Any] | None = None
    footer: dict[str, Any] | None = None
    model_bytes: bytes | None = None
    schema: str | None = None
    torn: str = ""
    _ticks: int | None = field(default=None, repr=False)

    def batches(self, path: Path) -> Iterator[list[bytes]]:
        """The Tick messages of one chunk after the other; the other attributes fill as the file is read. Raises RecordingError."""
        try:
            stream = path.open("rb")
        except OSError as error:
            raise RecordingError(f"{path} cannot be read ({error.strerror}); give a recording that exists") from error
        with stream:
            start = stream.read(8)
            if start != b"\x89MCAP0\r\n":
                raise RecordingError(f"{path} is not an MCAP file: it begins with {start!r}; give a recording of palpd run")
            stream.seek(0)
            yield from self._read(stream)

    def _read(self, stream: IO[bytes]) -> Iterator[list[bytes]]:
        ended = False
        try:
            for record in StreamReader(stream, emit_chunks=True, validate_crcs=True).records:
                if isinstance(record, Chunk):
                    yield self._ticks_of(record)
                elif isinstance(record, Metadata) and record.name == HEADER:
                    self.header = json.loads(record.metadata["json"])
                elif isinstance(record, Metadata) and record.name == FOOTER:
                    self.footer = json.loads(record.metadata["json"])
                elif isinstance(record, Attachment) and record.name == MODEL:
                    self.model_bytes = record.data
                ended = ended or isinstance(record, DataEnd)
            self.torn = "" if ended else "(it has no end of data)"
        except _UNREADABLE as error:
            where = "behind the data" if ended else f"at byte {stream.tell()} of {os.fstat(stream.fileno()).st_size}"
            self.torn = f"{where} ({type(error).__name__})"

    def _ticks_of(self, chunk: Chunk) -> list[bytes]:
        content, _ = get_chunk_data_stream(chunk, validate_crc=True)
        data = content.read(chunk.uncompressed_size)
        head = struct.Struct("<BQH")
        messages, position = [], 0
        while position < len(data):
            opcode, length, number = head.unpack_from(data, position)
            position += 9
            if opcode == Opcode.MESSAGE:
                if number == self._ticks:
                    messages.append(data[position + 22 : position + length])
            elif opcode == Opcode.SCHEMA:
                schema = Schema.read(ReadDataStream(io.BytesIO(data[position : position + length])))
                if schema.name == _TOPICS[TICK_TOPIC]:
                    self.schema = schema.data.decode()
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(ReadDataStream(io.BytesIO(data[position : position + length])))
                if channel.topic == TICK_TOPIC:
                    self._ticks = channel.id
            position += length
        return messages

    def refuse_foreign(self, path: Path) -> None:
        """Refuse what is no recording of palpd, or one whose ticks have other fields. Raises RecordingError."""
        if self.header is None:
            raise RecordingError(f"{path} is an MCAP file but no recording of palpd: it has no {HEADER}; give a recording of palpd run")
        if self.schema is not None and self.schema != cdr.TICK:
            raise RecordingError(f"{path} was written by a version of palpd whose ticks have other fields; read it with that version")


@dataclass(frozen=True, slots=True)
class Recovered:
    """What `recover` saved."""

    path: Path
    ticks: int
    duration_s: float


def recover(part: Path) -> Recovered:
    """Write FILE.mcap with all that is whole in FILE.part, which stays. Raises RecordingError, also where FILE.mcap exists."""
    path = part.with_suffix("") if part.name.endswith(".mcap.part") else part.with_suffix(".mcap")
    if path == part:
        raise RecordingError(f"{part} is not called .part; give the unfinished file, or rename a damaged one to .part")
    _refuse_growing(part)
    contents = Contents()
    batches = contents.batches(part)
    first = next((batch for batch in batches if batch), [])
    contents.refuse_foreign(part)
    assert contents.header is not None
    if not first:
        raise RecordingError(f"{part} holds no whole tick ({contents.torn or 'it ends after the header'}); there is nothing to recover")
    writer = RecordingWriter(path, contents.header, contents.model_bytes, part=part.with_suffix(".recovering"))
    begin_s, end_s, ticks = float("nan"), float("nan"), 0
    try:
        for batch in filter(None, itertools.chain([first], batches)):
            rows = cdr.unpack_ticks(batch)
            writer.write(rows)
            writer.flush()
            begin_s = float(rows["now_s"][0]) if ticks == 0 else begin_s
            end_s, ticks = float(rows["now_s"][-1]), ticks + len(rows)
        footer = contents.footer or {"verdict": "unfinished", "reason": "the recording was not closed; recovered from what was whole"}
        writer.close(footer)
    except BaseException:
        writer.abandon()
        writer.part.unlink(missing_ok=True)
        raise
    return Recovered(path, ticks, end_s - begin_s)


def _refuse_growing(part: Path) -> None:
    with contextlib.suppress(OSError), part.open("rb") as stream:  # a file that is not there is refused by whoever reads it
        try:
            fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RecordingError(f"{part} is still being written; wait for the run to end") from None
