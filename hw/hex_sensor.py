"""OptoForce HEX-70 behind its USB DAQ: bytes on a serial port to wrenches in N and Nm, and nothing else.

The DAQ sends `AA 07 08 10 | counter | status | Fx Fy Fz Tx Ty Tz | sum`, 22 bytes, big-endian; the sum is the 16-bit sum of the bytes
before it. The counter counts samples at 1 kHz whatever the output rate. Three parts, the first two without any device:

    FrameParser    bytes -> counts      framing, checksum, counter order, plausibility
    SampleClock    counter -> seconds   on the host's monotonic clock
    HexSensor      the port: exclusive, configured with its answer awaited, calibrated
"""

import contextlib
import errno
import fcntl
import math
import os
import select
import struct
import termios
import time
import warnings
from array import array
from collections import deque
from collections.abc import Sequence
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
import serial
from numpy.typing import NDArray

from palpd.errors import SensorError
from palpd.tick import NO_FRAMES, Floats, SensorFrames, Words

SAMPLE_S = 0.001
"""One step of the counter."""

READ_BYTES = 4096  # more than a terminal gives at a time
FRAME_BYTES = 22
DATA = b"\xaa\x07\x08\x10"
ANSWER = b"\xaa\x00\x50\x01"
SERIAL_NUMBER = b"\xaa\x00\x12\x08"
CAPACITY = b"\xaa\x01\x5e\x0e"
COUNTS_AT_CAPACITY = b"\xaa\x01\xc2\x0e"
THREE_AXIS = b"\xaa\x07\x08\x0a"
LENGTHS = {header: header[3] + 6 for header in (DATA, ANSWER, SERIAL_NUMBER, CAPACITY, COUNTS_AT_CAPACITY, THREE_AXIS)}
"""Packets that are understood. None is longer than a data frame, so whatever looks like a header is settled, one way or the other,
by the time a frame that starts behind it is complete: a false header never delays a frame."""

FILTER_CODES: dict[float | None, int] = {None: 0, 500.0: 1, 150.0: 2, 50.0: 3, 15.0: 4, 5.0: 5, 1.5: 6}
OVERLOAD_BITS = 0x03F0

XE_200N_COUNTS_PER_N = (41.3, 41.1, 7.64)
XE_200N_COUNTS_PER_NM = (1126.0, 1082.0, 1433.0)
"""One unit's registers (200 N class). Another of the same model differs by up to 13 %, so these are used only when asked for."""

_PAYLOAD = np.dtype([("counter", ">u2"), ("status", ">u2"), ("counts", ">i2", (6,))])
_UNPACK = struct.Struct(">HH6h").unpack_from
_BULK_FRAMES = 16


class RawFrames(NamedTuple):
    """Frames as sent: `counter` (n,), `status` (n,), `counts` (n, 6) of Fx Fy Fz Tx Ty Tz."""

    counter: Words
    status: Words
    counts: NDArray[np.int16]


class Packet(NamedTuple):
    """A packet that is not a data frame: the answer to a command or a register."""

    header: bytes
    payload: bytes


class _Sample(NamedTuple):
    counter: int
    status: int
    counts: tuple[int, ...]
    raw: bytes
    start: int
    ambiguous: bool


class FrameParser:
    """Finds the frames in a stream of bytes that may start anywhere, lose bytes, gain bytes or have them changed.

    **Framing** keeps no state but the unread tail: *every* window that starts with a header and ends with the right sum is a
    candidate, even inside another one. So no frame that was sent whole can be lost to what stands before it or around it.

    **Judging** then asks what the sum cannot see (it passes two swapped bytes always). A candidate that continues the one before it
    (counter on by `counter_step`, change possible for the DAQ's low-pass) is handed over at once. Any other waits for the next
    one, 1 ms at 1 kHz, and is thrown away only on evidence:

    - counter: the next one continues the order of the last good one, and this one does not stand between them;
    - place: its window holds the beginning of the next one, as when it was cut short and its sum fits all the same;
    - size: the input that a one-pole low-pass at `filter_cutoff_Hz` would have needed for this change is beyond `input_limit`
      counts, the next one is possible after the last good one, and nearer to it than to this one.

    What this sees: any change of the counter except to a value that keeps the order, and high bytes misplaced so that the value leaps
    by more than the filter lets through (at 150 Hz and 1 kHz 61 % of the input limit). What it cannot see: two equal
    bytes swapped, low bytes swapped between axes, status bits, and a wrong frame with nothing before it or behind it to judge
    it by. Frames with an overload bit are not judged by size.

    `rejected` counts frames thrown away so far: implausible ones, and one per started 22 unexplained bytes in a row. `lost` those
    missing by the counter, `frames` those handed over. Results do not depend on how the bytes were cut into calls of `feed`.
    """

    def __init__(
        self,
        counter_step: int = 1,
        filter_cutoff_Hz: float | None = None,
        input_limit: Sequence[float] | Floats = (32768.0,) * 6,
        bulk_frames: int = _BULK_FRAMES,
    ) -> None:
        """`counter_step` is the speed byte; `input_limit` (6,) in counts; from `bulk_frames` on, whole arrays are parsed at once."""
        self.counter_step = counter_step
        self.filter_cutoff_Hz = filter_cutoff_Hz
        self.input_limit = np.asarray(input_limit, float)
        self.packets: deque[Packet] = deque(maxlen=16)
        self.frames = 0
        self.lost = 0
        self.implausible = 0
        self._limits = tuple(float(limit) for limit in self.input_limit)
        self._usual_response = self._response(counter_step)
        self._bulk_frames = self._attempt_frames = bulk_frames  # attempts double while they succeed
        self._tail = b""
        self._begin = 0  # where the tail begins, in bytes since the first
        self._explained = 0  # end of the last packet with a right sum
        self._unexplained_frames = 0  # in runs of unexplained bytes that are over
        self._last: _Sample | None = None
        self._suspect: _Sample | None = None
        self._thrown_since_last = 0
        self._accepted = bytearray()

    @property
    def rejected(self) -> int:
        """Frames thrown away so far."""
        return self.implausible + self._unexplained_frames + -(-max(0, self._begin - self._explained) // FRAME_BYTES)

    def feed(self, data: bytes) -> RawFrames:
        """Every frame that `data` completes, oldest first."""
        self._parse(self._tail + data if self._tail else data)
        return self._take()

    def flush(self) -> RawFrames:
        """The frame that still waits for its successor, if any: for the end of a stream."""
        if self._suspect is not None:
            self._accept(self._suspect)
        return self._take()

    def _take(self) -> RawFrames:
        if not self._accepted:
            return _NO_RAW
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
                ambiguous = data.find(DATA[:3], at + 1, at + length) >= 0
                self._explain(begin + at, begin + at + length, header, data[at + 4 : at + length - 2], ambiguous)
            at += 1
        if at < 0:
            at = end
        self._tail = data[at:]
        self._begin = begin + at

    def _explain(self, start: int, stop: int, header: bytes, payload: bytes, ambiguous: bool) -> None:
        if header == DATA:
            self._explained_to(start, stop)
            self._judge(_sample(payload, start, ambiguous))
        elif start >= self._explained:  # inside a frame it is the frame's own payload
            self._explained_to(start, stop)
            self.packets.append(Packet(header, payload))

    def _explained_to(self, start: int, stop: int) -> None:
        self._unexplained_frames += -(-max(0, start - self._explained) // FRAME_BYTES)
        self._explained = stop

    def _parse_bulk(self, data: bytes, at: int, frames: int) -> int:
        """Judge the first of `frames` frames in a row that are whole and plain, and say how many; the careful way must look at the next."""
        rows = np.frombuffer(data, np.uint8, frames * FRAME_BYTES, at).reshape(frames, FRAME_BYTES)
        sums = rows[:, :20].sum(axis=1, dtype=np.uint16)
        whole = (rows[:, :4] == _DATA_BYTES).all(axis=1) & (sums == rows[:, 20] * np.uint16(256) + rows[:, 21])
        done = frames if whole.all() else int(whole.argmin())
        size = done * FRAME_BYTES
        if not done or data.count(DATA[:3], at, at + size) != done:
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
                if at and self._suspect is None:  # the row before was accepted, so are all up to the break
                    self._accepted += rows[at:stop].tobytes()
                    self._last = _sample(rows[stop - 1].tobytes(), start + (stop - 1) * FRAME_BYTES)
                    at = stop
                else:
                    self._judge(_sample(rows[at].tobytes(), start + at * FRAME_BYTES))
                    at += 1
            if stop < len(rows):
                self._judge(_sample(rows[stop].tobytes(), start + stop * FRAME_BYTES))
                at = stop + 1

    def _judge(self, new: _Sample) -> None:
        if self._suspect is not None:
            if self._is_refuted(self._suspect, new):
                self._suspect = None
                self._thrown_since_last += 1
                self.implausible += 1
            else:
                self._accept(self._suspect)
        last = self._last
        if last is None or (
            not new.ambiguous
            and (new.counter - last.counter) & 0xFFFF == self.counter_step * (1 + self._thrown_since_last)
            and self._is_possible(last, new)
        ):
            self._accept(new)
        else:
            self._suspect = new

    def _accept(self, sample: _Sample) -> None:
        if self._last is not None:
            step = (sample.counter - self._last.counter) & 0xFFFF
            if step < 0x8000:
                self.lost += max(0, step // self.counter_step - 1 - self._thrown_since_last)
        self._accepted += sample.raw
        self._last = sample
        self._suspect = None
        self._thrown_since_last = 0

    def _is_refuted(self, suspect: _Sample, new: _Sample) -> bool:
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

    def _is_possible(self, last: _Sample, new: _Sample) -> bool:
        if (last.status | new.status) & OVERLOAD_BITS:
            return True
        steps = (new.counter - last.counter) & 0xFFFF
        response = self._usual_response if steps == self.counter_step else self._response(steps)
        for before, after, limit in zip(last.counts, new.counts, self._limits, strict=True):
            if not -limit <= before + (after - before) / response <= limit:
                return False
        return True

    def _distance(self, one: _Sample, other: _Sample) -> float:
        return max(abs(a - b) / limit for a, b, limit in zip(one.counts, other.counts, self._limits, strict=True))

    def _response(self, steps: int) -> float:
        """Share of a step of its input that a one-pole low-pass shows after `steps` counts: 1 - exp(-2π f_c t)."""
        if self.filter_cutoff_Hz is None or not steps:
            return 1.0
        return -math.expm1(-2 * math.pi * self.filter_cutoff_Hz * SAMPLE_S * steps)


_NO_RAW = RawFrames(np.empty(0, np.uint16), np.empty(0, np.uint16), np.empty((0, 6), np.int16))
_DATA_BYTES = np.frombuffer(DATA, np.uint8)


def _sample(raw: bytes, start: int, ambiguous: bool = False) -> _Sample:
    counter, status, *counts = _UNPACK(raw)
    return _Sample(counter, status, tuple(counts), raw, start, ambiguous)


class SampleClock:
    """Maps the counter to the host's monotonic clock: t = counter · 1 ms + the smallest delay seen, let up slowly.

    A frame can come late but never early, so the smallest (arrival - counter time) is the best guess of the offset. It is let up by
    `leak` seconds a second, so that a DAQ whose clock is slower than the host's by less is followed (0.08 % has been
    measured on one); a faster one pulls the offset down by itself. So t is late by the shortest way from DAQ to host, plus at most
    one sample period where reads and samples keep step, plus `leak` × the time since a frame came promptly (1 µs a ms).
    """

    def __init__(self, leak: float = 1e-3) -> None:
        self._leak = leak
        self._count = 0  # counter without wraps
        self._offset_s = math.inf
        self._arrival_s = 0.0
        self._last_s = -math.inf

    def stamp(self, counter: Words, arrival_s: float) -> Floats:
        """Times (n,) in s of samples that arrived together at `arrival_s`; never earlier than one given before, nor after the arrival.

        A counter that contradicts the time gone by, beyond what its wraps explain, has been started anew.
        """
        if not len(counter):
            return np.empty(0)
        counts = self._unwrap(counter, arrival_s)
        self._offset_s = min(self._offset_s + self._leak * max(0.0, arrival_s - self._arrival_s), arrival_s - counts[-1] * SAMPLE_S)
        self._arrival_s = arrival_s
        # where the offset falls, samples are squeezed rather than turned round: at least a tenth of their distance stays
        times, latest_s = [], self._last_s
        for count in counts:  # plain floats: a tick has two to eight samples, where numpy's calls would cost ten times the sums
            apart_s = 0.1 * SAMPLE_S * (count - self._count)
            latest_s = max(latest_s, count * SAMPLE_S + self._offset_s - apart_s)
            times.append(min(latest_s + apart_s, arrival_s))
        self._count = counts[-1]
        self._last_s = times[-1]
        return np.array(times)

    def _unwrap(self, counter: Words, arrival_s: float) -> list[int]:
        counts, count, previous = [], self._count, self._count & 0xFFFF
        for number in counter.tolist():
            count += (number - previous) & 0xFFFF
            previous = number
            counts.append(count)
        if math.isinf(self._offset_s):
            return counts
        wraps = max(0, round((arrival_s - self._offset_s - counts[-1] * SAMPLE_S) / (0x10000 * SAMPLE_S)))
        if wraps:
            counts = [count + 0x10000 * wraps for count in counts]
        behind_s = arrival_s - self._offset_s - counts[-1] * SAMPLE_S
        if not _EARLIEST_S < behind_s < _LATEST_S:
            self._offset_s = math.inf
        return counts


_EARLIEST_S, _LATEST_S = -0.05, 0.5  # a newest sample further from its arrival says that the counter was started anew


class HexSensor:
    """A HEX-70 at its port, exclusively; `read` gives N and Nm in the sensor's own axes, as calibrated, not tared.

    Opening it asks the serial number and the calibration registers 350 (capacity) and 450 (counts at capacity), sets rate and filter
    and awaits the answer, and sees that frames come at that rate. The DAQ's own zero is taken off (every configuration carries a zero
    byte, and 0 removes it): readings then mean the same after every start, which a reference tare kept from an earlier day needs.

    Calibration: registers where they are answered, else `counts_per_N`, `counts_per_Nm` (3 each). Both and more than 1 % apart: refused.
    Neither: refused, unless `allow_nominal`, then another unit's numbers are used with a warning (up to 13 % off).

    Fz has two sensitivities, pressed and pulled (3rd and 7th register; no document confirms this order). One of them,
    `fz_sensitivity`, is used for both directions: the reading before the tare is tens of newtons off zero and its sign says nothing
    about the load, so two slopes would make the tare wrong. With "pressed", a pull is over-read by their ratio (8 % on one unit).

    Raises SensorError, in one sentence, when the port is absent, busy or silent, or the device is not what was configured.
    """

    def __init__(
        self,
        port: str,
        *,
        rate_Hz: float = 1000.0,
        filter_cutoff_Hz: float | None = 150.0,
        counts_per_N: Sequence[float] | None = None,
        counts_per_Nm: Sequence[float] | None = None,
        fz_sensitivity: Literal["pressed", "pulled"] = "pressed",
        allow_nominal: bool = False,
        low_latency: bool = False,
        answer_timeout_s: float = 0.5,
    ) -> None:
        if filter_cutoff_Hz not in FILTER_CODES:
            known = ", ".join(f"{cutoff:g}" for cutoff in FILTER_CODES if cutoff)
            raise SensorError(f"sensor filter of {filter_cutoff_Hz:g} Hz does not exist; the DAQ has {known} Hz or null for none.")
        if not 1000 / 255 <= rate_Hz <= 1000 or abs(1000 / rate_Hz - round(1000 / rate_Hz)) > 0.01:
            raise SensorError(f"sensor rate of {rate_Hz:g} Hz does not exist; the DAQ sends 1000/n Hz, n a whole number from 1 to 255.")
        if (counts_per_N is None) != (counts_per_Nm is None):
            raise SensorError("only one of counts_per_N and counts_per_Nm is given; give both from the calibration sheet, or neither.")
        self.port = port
        self.filter_cutoff_Hz = filter_cutoff_Hz
        self.serial_number = ""
        self.calibration_source: Literal["registers", "config", "nominal"] = "registers"
        self._speed = round(1000 / rate_Hz)
        self.rate_Hz = 1000 / self._speed
        self._configured = None if counts_per_N is None or counts_per_Nm is None else np.array([*counts_per_N, *counts_per_Nm], float)
        given = [numbers for numbers in (counts_per_N, counts_per_Nm) if numbers is not None]
        if any(len(numbers) != 3 or not all(number > 0 for number in numbers) for numbers in given):
            raise SensorError("counts_per_N and counts_per_Nm must hold three positive numbers each, as on the calibration sheet.")
        self._fz_register = 2 if fz_sensitivity == "pressed" else 6
        self._allow_nominal = allow_nominal
        self._low_latency = low_latency
        self._answer_timeout_s = answer_timeout_s
        self._serial: serial.Serial | None = None
        self._open()

    @property
    def delay_s(self) -> float:
        """How much later than the force a reading shows it: 1 / (2π f_c) of a one-pole low-pass."""
        return 1 / (2 * math.pi * self.filter_cutoff_Hz) if self.filter_cutoff_Hz else 0.0

    @property
    def counts_per_N(self) -> Floats:
        """(3,) as in force."""
        return self.counts_per_unit[:3]

    @property
    def counts_per_Nm(self) -> Floats:
        """(3,) as in force."""
        return self.counts_per_unit[3:]

    @property
    def resolution(self) -> Floats:
        """(6,) N and Nm of one count."""
        return 1 / self.counts_per_unit

    @property
    def lost(self) -> int:
        """Frames missing by the counter since the port was opened."""
        return self._parser.lost

    def read(self) -> SensorFrames:
        """Every frame since the last call, `rejected` likewise; never waits. SensorError when the device is gone."""
        data = self._read_bytes()
        arrival_s = time.monotonic()  # after the bytes: a pause between the two may make a frame late, never early
        raw = self._parser.feed(data)
        rejected = self._parser.rejected - self._rejected
        self._rejected += rejected
        if not len(raw.counter) and not rejected:
            return NO_FRAMES
        return SensorFrames(self._clock.stamp(raw.counter, arrival_s), raw.counter, raw.status, raw.counts / self.counts_per_unit, rejected)

    def reopen(self) -> None:
        """Open the port again after an unplug. SensorError if it is still absent or another sensor stands there."""
        self.close()
        self._open()

    def close(self) -> None:
        """Let go of the port."""
        if self._serial is not None:
            with contextlib.suppress(Exception):
                self._serial.close()
            self._serial = None

    # the port

    def _open(self) -> None:
        try:
            self._serial = _open_exclusively(self.port)
            if self._low_latency:
                with contextlib.suppress(OSError, ValueError, NotImplementedError):  # most CDC drivers have no such mode
                    self._serial.set_low_latency_mode(True)
            self._parser = FrameParser()
            self._identify()
            self.counts_per_unit, limit = self._calibrate()
            self._configure()
            self._parser = FrameParser(self._speed, self.filter_cutoff_Hz, limit)
            self._clock = SampleClock()
            self._rejected = 0
            self._settle()
        except BaseException:
            self.close()
            raise

    def _read_bytes(self) -> bytes:
        """All that lies ready."""
        if self._serial is None:
            raise SensorError(f"sensor port {self.port} is closed; open it again.")
        port, data, gone = self._serial.fileno(), b"", False
        try:
            while not gone and _waiting(port):
                chunk = os.read(port, READ_BYTES)
                data, gone = data + chunk, not chunk
        except BlockingIOError:
            pass  # another reader of the port was quicker
        except OSError as error:
            if error.errno != errno.EIO:
                raise SensorError(f"sensor port {self.port} fails with '{error.strerror}'; check the USB cable.") from None
            gone = True
        if gone and not data:
            raise SensorError(f"sensor at {self.port} is gone (end of data from the port); plug it in and open it again.")
        return data

    def _write(self, data: bytes) -> None:
        assert self._serial is not None
        try:
            self._serial.write(data)
        except (serial.SerialException, OSError) as error:
            raise SensorError(f"sensor at {self.port} does not take a command ({error}); check the USB cable.") from None

    def _wait(self, until_s: float) -> RawFrames:
        """Frames of the next bytes that come before `until_s`."""
        assert self._serial is not None
        ready, _, _ = select.select([self._serial.fileno()], [], [], max(0.0, until_s - time.monotonic()))
        return self._parser.feed(self._read_bytes()) if ready else _NO_RAW

    def _ask(self, command: bytes, answer: bytes, tries: int = 3) -> bytes | None:
        """Payload of the packet that answers `command`, or None."""
        for _ in range(tries):
            self._parser.packets.clear()
            self._write(command + sum(command).to_bytes(2, "big"))
            until_s = time.monotonic() + self._answer_timeout_s
            while time.monotonic() < until_s:
                self._wait(until_s)
                for packet in self._parser.packets:
                    if packet.header == answer:
                        return packet.payload
        return None

    def _identify(self) -> None:
        payload = self._ask(b"\xab" + SERIAL_NUMBER[1:], SERIAL_NUMBER, tries=2)
        found = payload.decode("ascii", "replace").strip("\0 ") if payload else ""
        if self.serial_number and found != self.serial_number:
            raise SensorError(
                f"sensor at {self.port} is {found or 'nameless'}, it was {self.serial_number}; "
                "a calibration and a tare hold for one unit: start anew."
            )
        self.serial_number = found

    def _calibrate(self) -> tuple[Floats, Floats]:
        """Counts per N and Nm (6,), and the counts (6,) beyond which no input is possible: three times the capacity.

        Twice the capacity is the overload a HEX-70 is specified for, once more is left for a reading not yet zeroed.
        """
        capacity = self._ask(b"\xab" + CAPACITY[1:], CAPACITY, tries=2)
        counts = self._ask(b"\xab" + COUNTS_AT_CAPACITY[1:], COUNTS_AT_CAPACITY, tries=2)
        if capacity is None or counts is None:
            if self._configured is not None:
                self.calibration_source = "config"
                return self._configured, np.full(6, 32768.0)
            if not self._allow_nominal:
                raise SensorError(
                    f"sensor {self.serial_number} at {self.port} does not tell its calibration and none is configured; "
                    "set counts_per_N and counts_per_Nm from its calibration sheet."
                )
            warnings.warn(
                f"sensor {self.serial_number} at {self.port} is read with another unit's calibration: up to 13 % off.", stacklevel=4
            )
            self.calibration_source = "nominal"
            return np.array([*XE_200N_COUNTS_PER_N, *XE_200N_COUNTS_PER_NM]), np.full(6, 32768.0)
        at_capacity = np.frombuffer(counts, ">u2").astype(float)
        units = np.frombuffer(capacity, ">u2") * np.array([1, 1, 1, 1e-3, 1e-3, 1e-3, 1])  # N, mNm, N
        if not (at_capacity > 0).all() or not (units > 0).all():
            raise SensorError(f"sensor {self.serial_number} has zeros in its calibration registers; it needs the maker's service.")
        order = [0, 1, self._fz_register, 3, 4, 5]
        per_unit: Floats = (at_capacity / units)[order]
        if self._configured is not None:
            apart = np.abs(self._configured / per_unit - 1)
            axis = int(np.argmax(apart))
            if apart[axis] > 0.01:
                name, unit = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")[axis], "N" if axis < 3 else "Nm"
                raise SensorError(
                    f"configured {self._configured[axis]:.6g} counts per {unit} on {name} are {apart[axis]:.1%} off "
                    f"the {per_unit[axis]:.6g} in the registers of sensor {self.serial_number}; correct them or leave them out."
                )
        self.calibration_source = "registers"
        return per_unit, 3 * at_capacity[order]

    def _configure(self) -> None:
        payload = self._ask(bytes((0xAA, 0x00, 0x32, 0x03, self._speed, FILTER_CODES[self.filter_cutoff_Hz], 0)), ANSWER)
        if payload is None:
            raise SensorError(self._silence())
        if payload[0]:
            raise SensorError(
                f"sensor {self.serial_number} at {self.port} refuses {self.rate_Hz:g} Hz with its filter at {self.filter_cutoff_Hz} Hz "
                f"(code {payload[0]}); choose another rate."
            )

    def _silence(self) -> str:
        """Why a device that does not answer may not, as far as its bytes tell."""
        headers = {packet.header for packet in self._parser.packets}
        if THREE_AXIS in headers:
            return f"device at {self.port} is a three-axis sensor; a six-axis HEX is needed."
        if self._parser.frames:
            return (
                f"sensor at {self.port} sends data but has not answered its configuration within {self._answer_timeout_s:g} s, "
                "asked three times; unplug it and plug it in."
            )
        if self._parser.rejected:
            return f"device at {self.port} sends bytes that are no HEX-70's; check which device the port is."
        return f"sensor at {self.port} sends nothing; check its power and cable, and which device the port is."

    def _settle(self) -> None:
        """Read as bytes come for 0.25 s: frames sent before the change go by, the rate shows, the clock finds its offset."""
        period_s = self._speed * SAMPLE_S
        begin_s = time.monotonic()
        counters: deque[int] = deque(maxlen=4)
        steps: set[int] = set()
        while (now_s := time.monotonic()) < begin_s + 1.0 + 10 * period_s:
            if now_s > begin_s + 0.25 + 5 * period_s and steps == {self._speed}:
                self._rejected = self._parser.rejected
                return
            raw = self._wait(now_s + 0.1)
            self._clock.stamp(raw.counter, time.monotonic())
            counters.extend(raw.counter.tolist())
            steps = {(b - a) & 0xFFFF for a, b in pairwise(counters)}
        if not self._parser.frames:
            raise SensorError(self._silence())
        raise SensorError(
            f"sensor {self.serial_number} at {self.port} was set to {self.rate_Hz:g} Hz, but its counter goes in steps of {sorted(steps)}, "
            f"not {self._speed}; unplug it and plug it in."
        )


def _waiting(descriptor: int) -> int:
    """Bytes that lie ready. A read that finds none would wait, "non-blocking" or not, for the kernel's worker that brings them: an ordinary
    thread, which on a busy machine kept the loop for 47 ms."""
    number = array("i", (0,))
    fcntl.ioctl(descriptor, termios.FIONREAD, number)
    return number[0]


def _open_exclusively(port: str) -> serial.Serial:
    """The port in raw mode at 1 Mbaud, non-blocking, for nobody else (a lock, and TIOCEXCL against programs that look for none)."""
    try:
        opened = serial.Serial(port, 1_000_000, timeout=0, exclusive=True)
    except (OSError, ValueError) as error:  # SerialException is an OSError
        number = getattr(error, "errno", None)
        if number == errno.ENOENT:
            why = "does not exist; plug the sensor in, or correct sensor.port"
        elif number in (errno.EACCES, errno.EPERM):
            why = "may not be opened by this user; add the user to the group that owns it"
        elif number in (errno.EBUSY, errno.EAGAIN):
            why = "is in use by another program; end that one first (ModemManager is kept off by the udev rule)"
        else:
            why = f"cannot be opened as a serial port ({error})"
        raise SensorError(f"sensor port {port} {why}.") from None
    descriptor = opened.fileno()
    fcntl.ioctl(descriptor, termios.TIOCEXCL)
    os.set_blocking(descriptor, False)
    attributes = termios.tcgetattr(descriptor)
    attributes[6][termios.VMIN] = 1  # with 0, "nothing yet" and "unplugged" both read as end of file
    termios.tcsetattr(descriptor, termios.TCSANOW, attributes)
    termios.tcflush(descriptor, termios.TCIFLUSH)
    return opened
