"""Frames of an OptoForce HEX-70: the bytes of its DAQ to counts.

The DAQ sends `AA 07 08 10 | counter | status | Fx Fy Fz Tx Ty Tz | sum`, 22 bytes, big-endian. The sum is the 16-bit sum of the bytes
before it. The counter counts samples at 1 kHz, whatever the output rate. This module needs no device.
"""

import math
import struct
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpd.tick import Floats, Words

SAMPLE_S = 0.001
"""One step of the counter."""

FRAME_BYTES = 22
DATA = b"\xaa\x07\x08\x10"
ANSWER = b"\xaa\x00\x50\x01"
SERIAL_NUMBER = b"\xaa\x00\x12\x08"
CAPACITY = b"\xaa\x01\x5e\x0e"
COUNTS_AT_CAPACITY = b"\xaa\x01\xc2\x0e"
CONFIGURATION = b"\xaa\x00\x32\x06"
THREE_AXIS = b"\xaa\x07\x08\x0a"
LENGTHS = {header: header[3] + 6 for header in (DATA, ANSWER, SERIAL_NUMBER, CAPACITY, COUNTS_AT_CAPACITY, CONFIGURATION, THREE_AXIS)}
"""Known packets and their lengths in bytes. None is longer than a data frame, so a false header never delays the frame behind it."""

OVERLOAD_BITS = 0x03F0
"""Status bits of the six axes beyond their capacity."""

_PAYLOAD = np.dtype([("counter", ">u2"), ("status", ">u2"), ("counts", ">i2", (6,))])
_UNPACK = struct.Struct(">HH6h").unpack_from
_BULK_FRAMES = 16


class RawFrames(NamedTuple):
    """Frames as the DAQ sends them: `counter` (n,), `status` (n,), `counts` (n, 6) of Fx Fy Fz Tx Ty Tz."""

    counter: Words
    status: Words
    counts: NDArray[np.int16]


class Packet(NamedTuple):
    """A packet that is not a data frame: the answer to a command or a register."""

    header: bytes
    payload: bytes


class _Frame(NamedTuple):
    counter: int
    status: int
    counts: tuple[int, ...]
    peak: int  # largest size of a count
    raw: bytes
    start: int
    ambiguous: bool


class FrameParser:
    """Finds the frames in a stream of bytes that may start anywhere, lose bytes, gain bytes or have them changed.

    **Framing** keeps no state but the unread tail. *Every* window that starts with a header and ends with the right sum is a candidate,
    even inside another window. So bytes before or around a frame cannot hide a frame that was sent whole.

    **Judging** checks what the sum cannot see: it never detects two swapped bytes. A candidate that continues the one before it
    (counter on by `counter_step`, change possible for the DAQ's low-pass) is accepted at once. Any other candidate waits for the next
    one, 1 ms at 1 kHz. It is rejected only on evidence:

    - counter: the next one continues the order of the last good one, and this one does not stand between them;
    - place: its window holds the beginning of the next one, as after a cut frame whose sum fits by chance;
    - size: for this change a one-pole low-pass at `filter_cutoff_Hz` needs an input beyond `input_limit` counts, the next one is
      possible after the last good one, and nearer to it than to this one.

    The parser sees any change of the counter except to a value that keeps the order. It also sees misplaced high bytes, if the value
    jumps by more than the filter lets through: at 150 Hz and 1 kHz 61 % of the input limit. It cannot see two equal bytes swapped, low
    bytes swapped between axes, changed status bits, or a wrong frame without a neighbour. Frames with an overload bit are not judged
    by size.

    `rejected` counts rejected frames: implausible ones, and one per started 22 unexplained bytes in a row. `lost` counts frames missing
    by the counter, `frames` the accepted ones. The results do not depend on how the bytes are split into calls of `feed`.
    """

    def __init__(
        self,
        counter_step: int = 1,
        filter_cutoff_Hz: float | None = None,
        input_limit: Sequence[float] | Floats = (32768.0,) * 6,
        bulk_frames: int = _BULK_FRAMES,
    ) -> None:
        """`counter_step` is the speed byte, `input_limit` (6,) is in counts; from `bulk_frames` on, whole arrays are parsed at once."""
        self.counter_step = counter_step
        self.filter_cutoff_Hz = filter_cutoff_Hz
        self.input_limit = np.asarray(input_limit, float)
        self.packets: deque[Packet] = deque(maxlen=16)
        self.frames = 0
        self.lost = 0
        self.implausible = 0
        self._limits = tuple(float(limit) for limit in self.input_limit)
        self._lowest_limit = min(self._limits)
        self._usual_response = self._response(counter_step)
        self._bulk_frames = self._attempt_frames = bulk_frames  # attempts double while they succeed
        self._tail = b""
        self._begin = 0  # where the tail begins, in bytes since the first
        self._explained = 0  # end of the last packet with a right sum
        self._unexplained_frames = 0  # in runs of unexplained bytes that are over
        self._last: _Frame | None = None
        self._suspect: _Frame | None = None
        self._rejected_since_last = 0
        self._accepted = bytearray()

    @property
    def rejected(self) -> int:
        """Number of frames rejected so far."""
        return self.implausible + self._unexplained_frames + -(-max(0, self._begin - self._explained) // FRAME_BYTES)

    def feed(self, data: bytes) -> RawFrames:
        """Return every frame that `data` completes, oldest first."""
        self._parse(self._tail + data if self._tail else data)
        return self._take()

    def flush(self) -> RawFrames:
        """At the end of a stream: return the frame that still waits for its successor, if any."""
        if self._suspect is not None:
            self._accept(self._suspect)
        return self._take()

    def _take(self) -> RawFrames:
        if not self._accepted:
            return NO_RAW_FRAMES
        words = np.frombuffer(bytes(self._accepted), ">u2").astype(np.uint16).reshape(-1, 8)
        self._accepted.clear()
        self.frames += len(words)
        return RawFrames(words[:, 0], words[:, 1], words[:, 2:].view(np.int16))

    # framing

    def _parse(self, data: bytes) -> None:
        begin, end, at = self._begin, len(data), 0
        while (at := data.find(0xAA, at)) >= 0:
            frames = min(self._attempt_frames, (end - at) // FRAME_BYTES)
            if frames >= self._bulk_frames and data.startswith(DATA, at):
                done = self._parse_bulk(data, at, frames)
                self._attempt_frames = min(2 * self._attempt_frames, 4096) if done == frames else self._bulk_frames
                if done:
                    at += done * FRAME_BYTES - len(DATA) + 1  # a header may straddle the end of the last frame
                    continue
            header = data[at : at + 4]
            length = LENGTHS.get(header)
            if length is None:
                if len(header) < 4 and any(known.startswith(header) for known in LENGTHS):
                    break
            elif end - at < length:
                break
            elif sum(data[at : at + length - 2]) == (data[at + length - 2] << 8 | data[at + length - 1]):
                ambiguous = data.find(_DATA_BEGIN, at + 1, at + length) >= 0
                self._explain(begin + at, begin + at + length, header, data[at + 4 : at + length - 2], ambiguous)
            at += 1
        if at < 0:
            at = end
        self._tail = data[at:]
        self._begin = begin + at

    def _explain(self, start: int, stop: int, header: bytes, payload: bytes, ambiguous: bool) -> None:
        if header == DATA:
            self._explained_to(start, stop)
            self._take_in(_frame(payload, start, ambiguous))
        elif start >= self._explained:  # inside a frame it is the frame's own payload
            self._explained_to(start, stop)
            self.packets.append(Packet(header, payload))

    def _explained_to(self, start: int, stop: int) -> None:
        if start > self._explained:
            self._unexplained_frames += -(-(start - self._explained) // FRAME_BYTES)
        self._explained = stop

    def _parse_bulk(self, data: bytes, at: int, frames: int) -> int:
        """Judge the leading frames that are whole and plain, and return their number; `_parse` looks at the next one itself."""
        rows = np.frombuffer(data, np.uint8, frames * FRAME_BYTES, at).reshape(frames, FRAME_BYTES)
        sums = rows[:, :20].sum(axis=1, dtype=np.uint16)
        whole = (rows[:, :4] == _DATA_BYTES).all(axis=1) & (sums == rows[:, 20] * np.uint16(256) + rows[:, 21])
        done = frames if whole.all() else int(whole.argmin())
        size = done * FRAME_BYTES
        if not done or data.count(_DATA_BEGIN, at, at + size) != done:
            return 0
        self._explained_to(self._begin + at, self._begin + at + size)
        self._judge_rows(np.ascontiguousarray(rows[:done, 4:20]), self._begin + at)
        return done

    # judging

    def _judge_rows(self, rows: NDArray[np.uint8], start: int) -> None:
        frames = rows.view(_PAYLOAD)[:, 0]
        counter = frames["counter"].astype(np.int64)
        steps = (counter[1:] - counter[:-1]) & 0xFFFF
        counts = frames["counts"].astype(float)
        needed = counts[:-1] + (counts[1:] - counts[:-1]) / self._usual_response
        overload = (frames["status"] & OVERLOAD_BITS) != 0
        possible = (np.abs(needed) <= self.input_limit).all(axis=1) | overload[1:] | overload[:-1]
        breaks = [*np.flatnonzero(~((steps == self.counter_step) & possible)) + 1, len(rows)]
        at = 0
        for stop in breaks:
            while at < stop:
                if at and self._suspect is None:  # the row before was accepted, and so are all up to the break
                    self._accepted += rows[at:stop].tobytes()
                    self._last = _frame(rows[stop - 1].tobytes(), start + (stop - 1) * FRAME_BYTES)
                    at = stop
                else:
                    self._take_in(_frame(rows[at].tobytes(), start + at * FRAME_BYTES))
                    at += 1
            if stop < len(rows):
                self._take_in(_frame(rows[stop].tobytes(), start + stop * FRAME_BYTES))
                at = stop + 1

    def _take_in(self, new: _Frame) -> None:
        if self._suspect is not None:
            if self._is_refuted(self._suspect, new):
                self._suspect = None
                self._rejected_since_last += 1
                self.implausible += 1
            else:
                self._accept(self._suspect)
        last = self._last
        if last is None or (
            not new.ambiguous
            and (new.counter - last.counter) & 0xFFFF == self.counter_step * (1 + self._rejected_since_last)
            and self._is_possible(last, new)
        ):
            self._accept(new)
        else:
            self._suspect = new

    def _accept(self, sample: _Frame) -> None:
        if self._last is not None:
            step = (sample.counter - self._last.counter) & 0xFFFF
            if step < 0x8000:
                self.lost += max(0, step // self.counter_step - 1 - self._rejected_since_last)
        self._accepted += sample.raw
        self._last = sample
        self._suspect = None
        self._rejected_since_last = 0

    def _is_refuted(self, suspect: _Frame, new: _Frame) -> bool:
        last = self._last
        assert last is not None  # the first sample is accepted as it comes
        to_suspect, to_new = (suspect.counter - last.counter) & 0xFFFF, (new.counter - last.counter) & 0xFFFF
        continues = (new.counter - suspect.counter) & 0xFFFF == self.counter_step
        if suspect.ambiguous and continues and new.start < suspect.start + FRAME_BYTES - 1:
            return True
        if not (continues and to_suspect) and 0 < to_new < 0x8000 and not 0 < to_suspect < to_new:
            return True
        return (
            not self._is_possible(last, suspect)
            and self._is_possible(last, new)
            and self._distance(last, new) < self._distance(suspect, new)
        )

    def _is_possible(self, last: _Frame, new: _Frame) -> bool:
        if (last.status | new.status) & OVERLOAD_BITS:
            return True
        steps = (new.counter - last.counter) & 0xFFFF
        response = self._usual_response if steps == self.counter_step else self._response(steps)
        if last.peak + (last.peak + new.peak) / response <= self._lowest_limit:
            return True  # so is every axis, because rounding keeps the order
        for before, after, limit in zip(last.counts, new.counts, self._limits, strict=True):
            if not -limit <= before + (after - before) / response <= limit:
                return False
        return True

    def _distance(self, one: _Frame, other: _Frame) -> float:
        return max(abs(a - b) / limit for a, b, limit in zip(one.counts, other.counts, self._limits, strict=True))

    def _response(self, steps: int) -> float:
        """Share of a step of its input that a one-pole low-pass shows after `steps` counts: 1 - exp(-2π f_c t)."""
        if self.filter_cutoff_Hz is None or not steps:
            return 1.0
        return -math.expm1(-2 * math.pi * self.filter_cutoff_Hz * SAMPLE_S * steps)


NO_RAW_FRAMES = RawFrames(np.empty(0, np.uint16), np.empty(0, np.uint16), np.empty((0, 6), np.int16))
_DATA_BYTES = np.frombuffer(DATA, np.uint8)
_DATA_BEGIN = DATA[:3]


def _frame(raw: bytes, start: int, ambiguous: bool = False) -> _Frame:
    words = _UNPACK(raw)
    counts = words[2:]
    return _Frame(words[0], words[1], counts, max(max(counts), -min(counts)), raw, start, ambiguous)
