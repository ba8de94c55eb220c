"""OptoForce HEX-70 behind its USB DAQ: bytes on a serial port to wrenches in N and Nm, and nothing else.

`hex_frames` finds the frames in the bytes, `SampleClock` maps their counter to the host's time, and `HexSensor` owns the port: exclusive,
configured with its answer awaited, calibrated.
"""

import contextlib
import errno
import fcntl
import math
import os
import select
import termios
import time
from array import array
from collections import deque
from collections.abc import Sequence
from itertools import pairwise
from typing import Literal

import numpy as np
import serial

from hw.conversion import CountingSensor
from hw.hex_frames import (
    ANSWER,
    CAPACITY,
    CONFIGURATION,
    COUNTS_AT_CAPACITY,
    NO_RAW_FRAMES,
    SAMPLE_S,
    SERIAL_NUMBER,
    THREE_AXIS,
    FrameParser,
    RawFrames,
)
from hw.host_time import MinimumDelayClock
from palpd.errors import SensorError
from palpd.tick import NO_FRAMES, Floats, SensorFrames, SensorSettings, Words

READ_BYTES = 4096
"""Largest read: more than a terminal returns at a time."""
FILTER_CODES: dict[float | None, int] = {None: 0, 500.0: 1, 150.0: 2, 50.0: 3, 15.0: 4, 5.0: 5, 1.5: 6}
"""Codes of the DAQ's low-pass, by its cutoff."""
ANSWER_TIMEOUT_S = 0.5
"""How long one attempt waits for an answer of the DAQ, which streams frames meanwhile."""
_EARLIEST_S, _LATEST_S = -0.05, 0.5
"""Limits of (arrival - sample time) of a newest sample; outside them the counter was started anew."""


class SampleClock:
    """Maps the 1 kHz counter to the host's monotonic clock by the smallest delay seen.

    The offset rises by 1 ms a second at most, so the clock follows a DAQ that is slower than the host by less than 0.1 %; 0.08 % was
    measured on one. So a time is late by the shortest way from DAQ to host, plus at most one sample period where reads and samples keep
    step, plus 1 µs for each ms since a frame came promptly.
    """

    def __init__(self) -> None:
        self._clock = MinimumDelayClock(leak=1e-3)
        self._count = 0  # counter without wraps
        self._last_s = -math.inf

    def stamp(self, counter: Words, arrival_s: float) -> Floats:
        """Give samples that arrived together their times. A counter that contradicts the time gone by was started anew.

        Args:
            counter: counters (n,) of the samples, oldest first.
            arrival_s: host time at which they arrived.

        Returns:
            Times (n,) in s, never earlier than one given before, never later than the arrival.
        """
        if not len(counter):
            return np.empty(0)
        counts = self._unwrap(counter, arrival_s)
        offset_s = self._clock.see(counts[-1] * SAMPLE_S, arrival_s)
        # where the offset falls, at least a tenth of the samples' distance stays, so their order stays
        times, latest_s = [], self._last_s
        for count in counts:  # plain floats: for two to eight samples numpy's calls cost ten times as much
            apart_s = 0.1 * SAMPLE_S * (count - self._count)
            latest_s = max(latest_s, count * SAMPLE_S + offset_s - apart_s)
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
        offset_s = self._clock.offset_s
        if math.isinf(offset_s):
            return counts
        wraps = max(0, round((arrival_s - offset_s - counts[-1] * SAMPLE_S) / (0x10000 * SAMPLE_S)))
        if wraps:
            counts = [count + 0x10000 * wraps for count in counts]
        behind_s = arrival_s - offset_s - counts[-1] * SAMPLE_S
        if not _EARLIEST_S < behind_s < _LATEST_S:
            self._clock.restart()
        return counts


class HexSensor(CountingSensor):
    """A HEX-70 at its port, exclusively; `read` gives N and Nm in the sensor's own axes, calibrated and not tared.

    The constructor asks for the serial number and the calibration registers 350 (capacity) and 450 (counts at capacity). It sets rate and
    filter, awaits the answer, and checks that frames come at that rate. It removes the DAQ's own zero: every configuration carries a
    zero byte, and 0 removes it. So readings mean the same after every start, as a stored reference tare requires.

    Calibration: the registers where the DAQ answers them, else `counts_per_N` and `counts_per_Nm` (3 each). The sensor is refused if
    both exist and differ by more than 1 %, or if neither exists.

    Fz has two sensitivities, pressed and pulled (3rd and 7th register; no document confirms this order). `fz_slopes` chooses one of
    them for all readings; with "both" it is the one for pressing. The reading before the tare is tens of newtons off zero, so its sign
    does not tell the load's direction: whoever knows the load corrects the readings by `pulled_over_pressed` after the tare.

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
        fz_slopes: Literal["pressed", "pulled", "both"] = "pressed",
        fz_pulled_counts_per_N: float | None = None,
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
        self.calibration_source: Literal["registers", "config"] = "registers"
        self._speed = round(1000 / rate_Hz)
        self.rate_Hz = 1000 / self._speed
        self._configured = None if counts_per_N is None or counts_per_Nm is None else np.array([*counts_per_N, *counts_per_Nm], float)
        sheets = [numbers for numbers in (counts_per_N, counts_per_Nm) if numbers is not None]
        if any(len(numbers) != 3 or not all(number > 0 for number in numbers) for numbers in sheets):
            raise SensorError("counts_per_N and counts_per_Nm must hold three positive numbers each, as on the calibration sheet.")
        self.pulled_over_pressed: float | None = None
        self._fz_slopes = fz_slopes
        self._configured_pulled = fz_pulled_counts_per_N
        self._serial: serial.Serial | None = None
        self._open()

    @property
    def counter_step(self) -> int:
        """The counter counts milliseconds, so it grows by this from frame to frame."""
        return self._speed

    def read(self) -> SensorFrames:
        """Return every frame since the last call, without waiting. SensorError when the device is gone."""
        data = self._read_bytes()
        arrival_s = time.monotonic()  # after the bytes: a pause between the two may make a frame late, never early
        raw = self._parser.feed(data)
        rejected = self._parser.rejected - self._rejected
        self._rejected += rejected
        if not len(raw.counter) and not rejected:
            return NO_FRAMES
        return SensorFrames(self._clock.stamp(raw.counter, arrival_s), raw.counter, raw.status, raw.counts / self.counts_per_unit, rejected)

    def close(self) -> None:
        """Release the port."""
        if self._serial is not None:
            with contextlib.suppress(Exception):
                self._serial.close()
            self._serial = None

    # the port

    def _open(self) -> None:
        try:
            self._serial = _open_exclusively(self.port)
            self._parser = FrameParser()
            self._identify()
            self.counts_per_unit, limit = self._calibrate()
            self._configure()
            self._refuse_other_setting()
            self._parser = FrameParser(self._speed, self.filter_cutoff_Hz, limit)
            self._clock = SampleClock()
            self._rejected = 0
            self._settle()
        except BaseException:
            self.close()
            raise

    def _read_bytes(self) -> bytes:
        """Return all bytes that are ready."""
        if self._serial is None:
            raise SensorError(f"sensor port {self.port} is closed; open the sensor again.")
        port, data, gone = self._serial.fileno(), b"", False
        try:
            waiting = READ_BYTES
            while waiting > READ_BYTES // 2 and (waiting := _waiting(port)):  # a terminal that is not half full holds nothing back
                chunk = os.read(port, READ_BYTES)
                data = data + chunk if data else chunk
                if gone := not chunk:
                    break
        except BlockingIOError:
            pass  # another reader of the port was faster
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
        """Return the frames of the next bytes that come before `until_s`."""
        assert self._serial is not None
        ready, _, _ = select.select([self._serial.fileno()], [], [], max(0.0, until_s - time.monotonic()))
        return self._parser.feed(self._read_bytes()) if ready else NO_RAW_FRAMES

    def _ask(self, command: bytes, answer: bytes, tries: int = 3) -> bytes | None:
        """Return the payload of the packet that answers `command`, or None."""
        for _ in range(tries):
            self._parser.packets.clear()
            self._write(command + sum(command).to_bytes(2, "big"))
            until_s = time.monotonic() + ANSWER_TIMEOUT_S
            while time.monotonic() < until_s:
                self._wait(until_s)
                for packet in self._parser.packets:
                    if packet.header == answer:
                        return packet.payload
        return None

    def _identify(self) -> None:
        payload = self._ask(b"\xab" + SERIAL_NUMBER[1:], SERIAL_NUMBER, tries=2)
        self.serial_number = payload.decode("ascii", "replace").strip("\0 ") if payload else ""

    def _calibrate(self) -> tuple[Floats, Floats]:
        """Return counts per N and Nm (6,), and the counts (6,) beyond which no input is possible: three times the capacity.

        A HEX-70 is specified for an overload of twice its capacity; the third part is room for the reading without a zero.
        """
        capacity = self._ask(b"\xab" + CAPACITY[1:], CAPACITY, tries=2)
        counts = self._ask(b"\xab" + COUNTS_AT_CAPACITY[1:], COUNTS_AT_CAPACITY, tries=2)
        if capacity is None or counts is None:
            if self._configured is not None:
                self.calibration_source = "config"
                return self._from_sheet(self._configured), np.full(6, 32768.0)
            raise SensorError(
                f"sensor {self.serial_number} at {self.port} does not answer its calibration registers and none is configured; "
                "set counts_per_N and counts_per_Nm from its calibration sheet."
            )
        at_capacity = np.frombuffer(counts, ">u2").astype(float)
        units = np.frombuffer(capacity, ">u2") * np.array([1, 1, 1, 1e-3, 1e-3, 1e-3, 1])  # N, mNm, N
        if not (at_capacity > 0).all() or not (units > 0).all():
            raise SensorError(f"sensor {self.serial_number} has zeros in its calibration registers; it needs the maker's service.")
        sensitivities = at_capacity / units
        self.pulled_over_pressed = float(sensitivities[6] / sensitivities[2])
        order = [0, 1, 6 if self._fz_slopes == "pulled" else 2, 3, 4, 5]
        per_unit: Floats = sensitivities[order]
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

    def _from_sheet(self, per_unit: Floats) -> Floats:
        """Counts per N and Nm (6,) of the configured sheet, with the slope of Fz that was asked for."""
        if self._configured_pulled is None:
            if self._fz_slopes != "pressed":
                raise SensorError(
                    f"fz_slopes is {self._fz_slopes!r}, but sensor {self.serial_number} answers no registers and its sheet has one slope; "
                    "set fz_pulled_counts_per_N from its calibration sheet."
                )
            return per_unit
        self.pulled_over_pressed = self._configured_pulled / float(per_unit[2])
        return np.where(np.arange(6) == 2, self._configured_pulled, per_unit) if self._fz_slopes == "pulled" else per_unit

    def _configure(self) -> None:
        payload = self._ask(bytes((0xAA, 0x00, 0x32, 0x03, self._speed, FILTER_CODES[self.filter_cutoff_Hz], 0)), ANSWER)
        if payload is None:
            raise SensorError(self._silence())
        if payload[0]:
            raise SensorError(
                f"sensor {self.serial_number} at {self.port} refuses {self.rate_Hz:g} Hz with its filter at {self.filter_cutoff_Hz} Hz "
                f"(code {payload[0]}); choose another rate."
            )

    def _refuse_other_setting(self) -> None:
        """Refuse a DAQ that has acknowledged its configuration and says otherwise. One that does not answer is believed."""
        payload = self._ask(b"\xab" + CONFIGURATION[1:], CONFIGURATION, tries=1)
        if payload is not None and payload[1] != FILTER_CODES[self.filter_cutoff_Hz]:
            is_Hz = next((cutoff_Hz for cutoff_Hz, code in FILTER_CODES.items() if code == payload[1]), None)
            raise SensorError(
                f"sensor {self.serial_number} at {self.port} was set to a filter of {self.filter_cutoff_Hz} Hz, but its register says "
                f"{is_Hz} Hz; unplug it and plug it in."
            )

    def _silence(self) -> str:
        """Say why the device does not answer, as far as its bytes show."""
        headers = {packet.header for packet in self._parser.packets}
        if THREE_AXIS in headers:
            return f"device at {self.port} is a three-axis sensor; a six-axis HEX is needed."
        if self._parser.frames:
            return (
                f"sensor at {self.port} sends data but has not answered its configuration within {ANSWER_TIMEOUT_S:g} s, "
                "asked three times; unplug it and plug it in."
            )
        if self._parser.rejected:
            return f"device at {self.port} sends bytes that are no HEX-70's; check which device the port is."
        return f"sensor at {self.port} sends nothing; check its power and cable, and which device the port is."

    def _settle(self) -> None:
        """Read for 0.25 s until old frames are gone, the rate is seen, and the clock has its offset."""
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


def open_hex_70(settings: SensorSettings) -> HexSensor:
    """Open the HEX-70 of a configuration (entry point `hex-70`). Raises SensorError."""
    if settings.options:
        raise SensorError(f"sensor.options holds {', '.join(settings.options)}, but the HEX-70 has no options; remove them.")
    return HexSensor(
        settings.port,
        rate_Hz=settings.rate_Hz,
        filter_cutoff_Hz=settings.filter_cutoff_Hz,
        counts_per_N=settings.counts_per_N,
        counts_per_Nm=settings.counts_per_Nm,
        fz_slopes=settings.fz_slopes,
        fz_pulled_counts_per_N=settings.fz_pulled_counts_per_N,
    )


def _waiting(descriptor: int) -> int:
    """Return the number of bytes that are ready.

    Even a non-blocking read without bytes waits for the kernel's worker that brings them. This worker is an ordinary thread: on a busy
    machine it held the loop for 47 ms.
    """
    number = array("i", (0,))
    fcntl.ioctl(descriptor, termios.FIONREAD, number)
    return number[0]


def _open_exclusively(port: str) -> serial.Serial:
    """Open the port in raw mode at 1 Mbaud, non-blocking and exclusive: a lock, and TIOCEXCL against programs that check no lock."""
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
