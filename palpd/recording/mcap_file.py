"""A recording on disk: MCAP with ROS 2 messages that any MCAP or ROS 2 tool opens. Its topic /tick returns every row bit for bit.

In a compressed chunk the numbers that the other topics repeat cost almost nothing, and reading back needs one topic. An unfinished
recording is called FILE.part.
"""

import contextlib
import fcntl
import io
import json
import mmap
import os
import re
import struct
import time
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Chunk, DataEnd, Header, Metadata, Schema
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from mcap.writer import CompressionType, Writer
from zstandard import ZstdError

from palpd.errors import RecordingError
from palpd.file_versions import NEWEST_RECORDING, newer
from palpd.files import read_by_others
from palpd.recording import cdr
from palpd.recording.header import RecordingFooter, RecordingHeader
from palpd.recording.second_channel import SecondChannel
from palpd.recording.topics import SCHEMAS, SECOND_TOPIC, SECOND_TYPE, TICK_TOPIC, TOPICS, Rows, TopicMessages

HEADER, FOOTER, MODEL = "palpd.header", "palpd.footer", "model.onnx"
HEADER_LOST = "its header is lost: configuration, plan and names of sites"
_UNREADABLE = (McapError, ZstdError, struct.error, ValueError, KeyError, RuntimeError, MemoryError, OverflowError)
"""What the MCAP reader raises on truncated or altered bytes."""
LATEST_S = 9e9
"""Unix time beyond which no recording was made: the year 2255. Nanoseconds since 1970 fit into 64 bits until 2262."""


_MAGIC = b"\x89MCAP0\r\n"
_RECORD_HEAD = struct.Struct("<BQ")
"""Opcode and length of a record's content, by the MCAP specification."""
_INDEX, _END_BYTES = struct.Struct("<HI"), 4
"""Channel and length of an index of messages, and the size of the checksum that ends the data."""

_BEGIN = re.compile(
    rb"\x06.{36}\x04\0{3}zstd"  # a chunk: head, times, size and checksum stand before the name of its compression
    rb"|\x0c.{8}\x0c\0{3}palpd\.(?:header|footer)"
    rb"|\x09.{24}\x0a\0{3}model\.onnx"  # an attachment: head and two times stand before its name
    rb"|\x0f\x04\0{7}",  # the end of the data
    re.DOTALL,
)
"""How a record begins that recovery looks for behind a damaged one."""
_CHUNK_BYTES = struct.calcsize("<QQQIIQ")
"""Size of a chunk without the name of its compression and its content."""


def part_of(path: Path) -> Path:
    """Return the name of FILE.mcap while it is unfinished."""
    return path.with_suffix(".part")


def ended_ns(path: Path) -> int | None:
    """Unix time of the last tick, by the summary at the end of a recording; None where that cannot be read."""
    try:
        with path.open("rb") as stream:
            summary = make_reader(stream).get_summary()
    except (OSError, *_UNREADABLE):
        return None
    return summary.statistics.message_end_time if summary is not None and summary.statistics is not None else None


class RecordingWriter:
    """Writes one recording; flushed data survives the death of this process.

    The constructor measures `epoch_offset_s` where the header does not give it.
    Raises RecordingError where `path` or its .part exists, OSError where the disk fails.
    """

    def __init__(
        self,
        path: Path,
        header: RecordingHeader,
        model_bytes: bytes | None = None,
        part: Path | None = None,
        second: SecondChannel | None = None,
    ) -> None:
        self.path, self.part = path, part or part_of(path)
        for taken in (self.path, self.part):
            if taken.exists():
                raise RecordingError(f"{taken} exists and is not overwritten; choose another name or move it away")
        header = {"epoch_offset_s": time.time() - time.monotonic(), **header, "format_version": NEWEST_RECORDING}
        self._messages = TopicMessages(header["epoch_offset_s"], second)
        try:
            self._stream = self.part.open("xb")
        except OSError as error:
            raise RecordingError(f"{self.part} cannot be written ({error.strerror}); choose a directory that can") from error
        fcntl.flock(self._stream, fcntl.LOCK_EX)
        self._writer = Writer(self._stream, chunk_size=1 << 30, compression=CompressionType.ZSTD, enable_data_crcs=True)
        self._writer.start(profile="ros2", library="palpd")
        self._header = _checked(json.dumps(header))
        self._writer.add_metadata(HEADER, self._header)
        if model_bytes is not None:
            self._writer.add_attachment(0, 0, MODEL, "application/octet-stream", model_bytes)
        schema = {name: self._writer.register_schema(name, "ros2msg", text.encode()) for name, text in SCHEMAS.items()}
        topics = TOPICS | ({SECOND_TOPIC: SECOND_TYPE} if second is not None else {})
        self._channel = {topic: self._writer.register_channel(topic, "cdr", schema[name]) for topic, name in topics.items()}
        self._sequence = dict.fromkeys(topics, 0)
        self._writer.flush()

    def write(self, rows: Rows) -> None:
        """Add rows; they reach the disk with `flush`.

        Args:
            rows: ticks (n,) with the fields of ROW, in their order.
        """
        for topic, stamp_ns, messages in self._messages.of(rows):
            self._add(topic, stamp_ns, messages)

    def flush(self) -> None:
        """Close the present chunk and pass it to the kernel."""
        self._writer.flush()

    def close(self, footer: RecordingFooter) -> Path:
        """Finish the file, sync it to the disk and rename it. Raises RecordingError where that name exists by now."""
        self._writer.flush()
        again = {f"{HEADER}.{key}": text for key, text in self._header.items()}  # where the first is damaged, the second restores it
        self._writer.add_metadata(FOOTER, _checked(json.dumps(footer)) | again)
        self._writer.finish()
        self._stream.flush()
        os.fsync(self._stream.fileno())
        if self.path.exists():
            raise RecordingError(f"{self.path} was created during the run; {self.part} holds the whole recording: rename it")
        self.part.rename(self.path)
        self._stream.close()
        directory = os.open(self.path.parent, os.O_RDONLY)
        try:
            os.fsync(directory)
        finally:
            os.close(directory)
        return self.path

    def abandon(self) -> None:
        """Close the file and leave it unfinished."""
        with contextlib.suppress(OSError):  # the full disk was reported before
            self._stream.close()

    def _add(self, topic: str, stamp_ns: cdr.Nanoseconds, messages: list[bytes]) -> None:
        channel, sequence = self._channel[topic], self._sequence[topic]
        for number, (time_ns, data) in enumerate(zip(stamp_ns.tolist(), messages, strict=True), sequence):
            self._writer.add_message(channel, time_ns, data, time_ns, number & 0xFFFFFFFF)
        self._sequence[topic] += len(messages)


def _checked(text: str) -> dict[str, str]:
    """A text with its checksum, which the format gives metadata none."""
    return {"json": text, "crc32": str(zlib.crc32(text.encode()))}


class _Header(dict[str, Any]):
    """The header of a recording; a key that it lacks is refused in a sentence."""

    def __missing__(self, key: str) -> Any:
        raise RecordingError(f"the recording does not say its {key}: it was restored without its header; use what needs the ticks alone")


class _Records(StreamReader):  # type: ignore[misc] # the library has no types
    """The records of a file, without taking its indices apart: nobody here asks for them, and they took half of the time of a load.

    Their bytes are read all the same, and stand in the checksum of the file.
    """

    def _read_record(self, opcode: int, length: int) -> Any:
        if opcode in (Opcode.MESSAGE_INDEX, Opcode.CHUNK_INDEX):
            self._stream.read(length)
            return None
        return super()._read_record(opcode, length)


@dataclass
class Contents:
    """What a file holds, as far as it is readable. `torn` says where and why reading stopped; it is empty for a whole file."""

    header: RecordingHeader | None = None
    footer: RecordingFooter | None = None
    model_bytes: bytes | None = None
    schema: str | None = None
    torn: str = ""
    header_lost: bool = False
    second: list[bytes] = field(default_factory=list, repr=False)
    _foreign: bool = field(default=False, repr=False)
    _ticks: int | None = field(default=None, repr=False)
    _second: int | None = field(default=None, repr=False)
    _absent: tuple[str, ...] = field(default=(), repr=False)

    def batches(self, path: Path, *, skip_damaged: bool = False) -> Iterator[list[bytes]]:
        """Yield the Tick messages chunk by chunk and fill the other attributes meanwhile.

        Args:
            skip_damaged: go on with the next whole chunk after a damaged one; otherwise reading stops there.

        Yields:
            The messages of one chunk, as bytes.

        Raises:
            RecordingError: the file cannot be read, or is no MCAP file.
        """
        read_by_others(path)
        try:
            stream = path.open("rb")
        except OSError as error:
            raise RecordingError(f"{path} cannot be read ({error.strerror}); give a recording that exists") from error
        with stream:
            start = stream.read(len(_MAGIC))
            if start != _MAGIC and not (skip_damaged and start and _holds_record(stream)):
                raise RecordingError(f"{path} is not an MCAP file: it begins with {start!r}; give a recording of palpd run")
            stream.seek(0)
            self.torn = "" if start == _MAGIC else "at byte 0 (its name of a format)"
            yield from self._salvage(stream) if skip_damaged else self._read(stream)

    def _salvage(self, stream: IO[bytes]) -> Iterator[list[bytes]]:
        """Yield from every chunk whose checksum is right, wherever the file is damaged besides."""
        self._ticks = list(TOPICS).index(TICK_TOPIC) + 1  # as the writer numbers them: the record that says so may be damaged
        with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
            position, ended = len(_MAGIC), False
            while 0 <= position < len(data) and not ended:
                end, ended = _end_of_record(data, position), data[position] == Opcode.DATA_END
                try:
                    if end is None:
                        raise ValueError("no record begins here")
                    if (batch := self._salvaged(data[position], data[position + _RECORD_HEAD.size : end])) is not None:
                        yield batch
                    if ended:
                        self._check_data(data, position)
                    position = end
                except _UNREADABLE as error:
                    outside = "outside of its chunks: header or footer may be altered, " if data[position] == Opcode.METADATA else ""
                    self.torn = self.torn or f"{outside}at byte {position} of {len(data)} ({type(error).__name__})"
                    ended, position = False, _next_record(data, position + 1)
            if not ended and not self.torn:
                self.torn = "(it has no end of data)"

    def _check_data(self, data: mmap.mmap, end: int) -> None:
        """Compare the checksum of all records before `end`, which covers the header and the footer too; zero stands for none."""
        stated = int.from_bytes(data[end + _RECORD_HEAD.size : end + _RECORD_HEAD.size + _END_BYTES], "little")
        with memoryview(data) as whole, whole[:end] as before:
            if not self.torn and stated not in (0, zlib.crc32(before)):
                self.torn = "outside of its chunks: header or footer may be altered"

    def _salvaged(self, opcode: int, content: bytes) -> list[bytes] | None:
        """The Tick messages of a chunk; of other records the content is kept, and the answer is None.

        Raises ValueError where the record is none of ours, or its length is not that of its content.
        """
        stream = io.BytesIO(content)
        if opcode == Opcode.CHUNK:
            chunk = Chunk.read(ReadDataStream(stream))
            if len(content) != _CHUNK_BYTES + len(chunk.compression) + len(chunk.data):
                raise ValueError("the chunk has another length than its content")
            return self._ticks_of(chunk)
        if opcode in (Opcode.HEADER, Opcode.METADATA):
            record = (Header if opcode == Opcode.HEADER else Metadata).read(ReadDataStream(stream))
            if stream.tell() != len(content):
                raise ValueError("the record has another length than its content")
            if isinstance(record, Metadata):
                self._keep(record)
        elif opcode == Opcode.MESSAGE_INDEX:
            if len(content) < _INDEX.size or _INDEX.unpack_from(content)[1] != len(content) - _INDEX.size:
                raise ValueError("the index has another length than its content")
        elif opcode != Opcode.ATTACHMENT:
            if opcode != Opcode.DATA_END or len(content) != _END_BYTES:
                raise ValueError("no record that palpd writes")
        else:
            if zlib.crc32(content[:-4]) != int.from_bytes(content[-4:], "little"):
                raise ValueError("the checksum of the attachment is wrong")
            attachment = Attachment.read(ReadDataStream(io.BytesIO(content)))
            self.model_bytes = attachment.data if attachment.name == MODEL else self.model_bytes
        return None

    def _read(self, stream: IO[bytes]) -> Iterator[list[bytes]]:
        ended = False
        try:
            for record in _Records(stream, emit_chunks=True, validate_crcs=True).records:
                if isinstance(record, Chunk):
                    yield self._ticks_of(record)
                elif isinstance(record, Metadata):
                    self._keep(record)
                elif isinstance(record, Attachment) and record.name == MODEL:
                    self.model_bytes = record.data
                ended = ended or isinstance(record, DataEnd)
            self.torn = "" if ended else "(it has no end of data)"
        except _UNREADABLE as error:
            where = "behind the data" if ended else f"at byte {stream.tell()} of {os.fstat(stream.fileno()).st_size}"
            self.torn = f"{where} ({type(error).__name__})"

    def _keep(self, metadata: Metadata) -> None:
        """Keep the recording's header or footer. Raises ValueError where it is damaged, or holds what no recording does."""
        if metadata.name == HEADER:
            self.header = cast(RecordingHeader, _Header(self._content_of(metadata.metadata)))
        elif metadata.name == FOOTER:
            again = {key.removeprefix(f"{HEADER}."): text for key, text in metadata.metadata.items() if key.startswith(HEADER)}
            if self.header is None and again:
                self.header = cast(RecordingHeader, _Header(self._content_of(again)))
            self.footer = cast(RecordingFooter, self._content_of(metadata.metadata))

    def _content_of(self, texts: Mapping[str, str]) -> dict[str, Any]:
        checked = "crc32" in texts  # recordings from before have no checksum
        if checked and texts["crc32"] != str(zlib.crc32(texts["json"].encode())):
            raise ValueError("the checksum is wrong")
        content = json.loads(texts["json"])
        if not isinstance(content, dict):
            content = {"epoch_offset_s": None}  # refused below
        offset_s, version = content.get("epoch_offset_s", 0.0), content.get("format_version", 1)
        if not isinstance(offset_s, int | float) or not abs(offset_s) < LATEST_S or not isinstance(version, int) or version < 1:
            self._foreign = checked
            raise ValueError(f"epoch_offset_s is {offset_s!r} and format_version {version!r}")
        return content

    def _ticks_of(self, chunk: Chunk) -> list[bytes]:
        content, size = get_chunk_data_stream(chunk, validate_crc=True)
        if size != chunk.uncompressed_size:  # its checksum is that of the content alone
            raise ValueError(f"the chunk has {size} bytes and states {chunk.uncompressed_size}")
        data = content.read(size)
        head = struct.Struct("<BQH")
        messages, position = [], 0
        while position < len(data):
            opcode, length, number = head.unpack_from(data, position)
            position += 9
            if opcode == Opcode.MESSAGE:
                if number == self._ticks:
                    messages.append(data[position + 22 : position + length])
                elif number == self._second:
                    self.second.append(data[position + 22 : position + length])
                else:
                    position += (_alike(data, position - 9, 9 + length, head.size) - 1) * (9 + length)
            elif opcode == Opcode.SCHEMA:
                schema = Schema.read(ReadDataStream(io.BytesIO(data[position : position + length])))
                if schema.name == TOPICS[TICK_TOPIC]:
                    self.schema = schema.data.decode()
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(ReadDataStream(io.BytesIO(data[position : position + length])))
                if channel.topic == TICK_TOPIC:
                    self._ticks = channel.id
                elif channel.topic == SECOND_TOPIC:
                    self._second = channel.id
            position += length
        return messages

    @property
    def absent(self) -> tuple[str, ...]:
        """Fields that ticks got after this recording was made."""
        return (cdr.absent_fields(self.schema) if self.schema is not None else self._absent) or ()

    def restore(self, part: Path, tick: bytes) -> None:
        """Put what a tick and the rest of the file say in place of a header or a schema that is damaged.

        Args:
            tick: A Tick message of it.
        """
        absent = cdr.absent_in(tick)
        if absent is None or self._foreign:
            return
        self._absent = absent
        if self.header is None:
            again = Contents()
            for _ in again.batches(part, skip_damaged=True):
                pass  # a copy of the header stands behind the ticks
            offset_s = cdr.epoch_offset_s(tick, absent)
            lost = _Header(epoch_offset_s=offset_s if abs(offset_s) < LATEST_S else 0.0)  # its times may be damaged, too
            self.header = again.header or cast(RecordingHeader, lost)
            self.header_lost = again.header is None

    def refuse_foreign(self, path: Path) -> None:
        """Refuse a file that is no recording of palpd, or whose ticks have other fields. Raises RecordingError."""
        if self.header is None:
            raise RecordingError(f"{path} is an MCAP file but no recording of palpd: it has no {HEADER}; give a recording of palpd run")
        version = self.header.get("format_version", 1)
        if sentence := newer(version, NEWEST_RECORDING, str(path)):
            raise RecordingError(sentence)
        if self.schema is not None and cdr.absent_fields(self.schema) is None:
            raise RecordingError(f"{path} was written by a version of palpd whose ticks have other fields; read it with that version")


def _alike(data: bytes, position: int, size: int, head: int) -> int:
    """Number of successive records with the same head, at least 1: the messages of a topic stand together, and most are of no interest."""
    most = (len(data) - position - head) // size + 1
    if most < 2:
        return 1
    heads = np.ndarray((most, head), np.uint8, data, position, (size, 1))
    same = (heads == heads[0]).all(axis=1)
    return most if same.all() else int(np.argmin(same))


def _end_of_record(data: mmap.mmap, position: int) -> int | None:
    """Where the record at a position ends; None where no record can begin there."""
    if position + _RECORD_HEAD.size > len(data):
        return None
    opcode, length = _RECORD_HEAD.unpack_from(data, position)
    end = position + _RECORD_HEAD.size + int(length)
    return end if Opcode.HEADER <= opcode <= Opcode.DATA_END and end <= len(data) else None


def _next_record(data: mmap.mmap, position: int) -> int:
    """Where the next record begins that holds something; -1 without one."""
    match = _BEGIN.search(data, position)
    return match.start() if match is not None else -1


def _holds_record(stream: IO[bytes]) -> bool:
    with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        return _next_record(data, 0) >= 0
