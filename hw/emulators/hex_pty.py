"""An OptoForce HEX-70 behind its DAQ, at the far end of a pseudo-terminal.

`Daq` turns wrenches into counts and bytes, and configuration packets into answers; `TerminalLine` is the terminal device. The unit's
numbers were read from a real 200 N sensor; "assumed" marks behaviour without a public source.
"""

import contextlib
import os
import select
import struct
import tempfile
import tty
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Literal

import numpy as np

from hw.emulators.pose import Floats
from palpd.files import check_link

PartsAt = Literal["reading", "load"]
"""Where the slopes of Fz part: where the sensor reads zero before zeroing, or where it carries nothing."""

CAPACITY = (200, 200, 200, 10000, 10000, 6500, 200)  # N, N, N, mNm, mNm, mNm, N: register 350
COUNTS_AT_CAPACITY = (8264, 8222, 1528, 11259, 10820, 9316, 1656)  # register 450
UNZEROED = (-251, 37, -430, 95, -925, 6)
"""Counts of the unloaded sensor before anything is zeroed."""
SERIAL_NUMBER = b"PRE00042"
IDENTITY = b"OptoForce HEX-70"
FILTERS_HZ: dict[int, float | None] = {0: None, 1: 500.0, 2: 150.0, 3: 50.0, 4: 15.0, 5: 5.0, 6: 1.5}
REFUSED = 1
"""Answer code to a configuration that makes no sense (assumed: only 0, "no error", is known)."""

_UNITS = np.array([1.0, 1.0, 1.0, 1e-3, 1e-3, 1e-3, 1.0]) * CAPACITY
_PER_UNIT = np.array(COUNTS_AT_CAPACITY) / _UNITS
_PRESSED, _PULLED = _PER_UNIT[:6], np.where(np.arange(6) == 2, _PER_UNIT[6], _PER_UNIT[:6])
_FRAME = struct.Struct(">BHBHH6h")
_OVERLOAD = tuple(1 << bit for bit in (9, 8, 7, 6, 5, 4))  # Fx Fy Fz Tx Ty Tz


def summed(packet: bytes) -> bytes:
    """Append the 16-bit sum of its bytes to a packet."""
    total = 0
    for byte in packet:
        total = (total + byte) % 65536
    return packet + bytes((total // 256, total % 256))


@dataclass
class Faults:
    """Faults of this sensor. Durations end at a host time, counts fall with each frame sent; by default everything works."""

    silent_until_s: float = 0.0
    slow_until_s: float = 0.0
    slow_every: int = 1
    stuck_until_s: float = 0.0
    status_until_s: float = 0.0
    status: int = 0
    flips: int = 0
    swaps: int = 0
    false_headers: int = 0
    lose_bytes: int = 0
    garbage: bytes = b""
    drift_N_per_s: float = 0.0
    drift_N: float = 0.0
    keeps_filter: bool = False
    register_scale: float = 1.0


@dataclass
class Daq:
    """The device: powered up it streams at 100 Hz through its 15 Hz filter, not zeroed.

    The slopes of Fz, pressed and pulled (3rd and 7th register; assumed), part where the sensor reads zero before zeroing, or where it
    carries nothing (`fz_parts_at`). Which of the two a real HEX-70 does is not known.
    """

    speed: int = 10
    filter_code: int = 4
    counter: int = 0
    zero: Floats = field(default_factory=lambda: np.zeros(6))
    zeroed: bool = False
    fz_parts_at: PartsAt = "reading"
    faults: Faults = field(default_factory=Faults)
    random: Random = field(default_factory=lambda: Random(70))
    answers: bytes = b""  # queued to go out before the next data
    latest: Floats = field(default_factory=lambda: np.array(UNZEROED, dtype=float))
    _inbox: bytes = b""
    _sent: tuple[int, ...] = (0,) * 6
    _index: int = 0

    @property
    def cutoff_Hz(self) -> float | None:
        """Cutoff of the present filter, None for none."""
        return FILTERS_HZ[self.filter_code]

    def take(self, data: bytes) -> None:
        """Obey the packets of the host; other bytes are ignored."""
        self._inbox += data
        while self._inbox:
            head = self._inbox[0]
            if head not in (0xAA, 0xAB):
                self._inbox = self._inbox[1:]
                continue
            if len(self._inbox) < 4:
                return
            size = 6 + (self._inbox[3] if head == 0xAA else 0)
            if len(self._inbox) < size:
                return
            packet = self._inbox[:size]
            if summed(packet[:-2]) != packet:
                self._inbox = self._inbox[1:]
                continue
            self._inbox = self._inbox[size:]
            address = packet[1] * 256 + packet[2]
            if head == 0xAB:
                self._tell(address, packet[3])
            elif address == 50 and packet[3] == 3:
                self._configure(*packet[4:7])

    def _configure(self, speed: int, code: int, zero: int) -> None:
        if code not in FILTERS_HZ or zero not in (0, 255):
            self.answers += summed(bytes((0xAA, 0, 80, 1, REFUSED)))
            return
        self.speed, self.filter_code = speed, self.filter_code if self.faults.keeps_filter else code
        if zero == 0:
            self.zero, self.zeroed = np.zeros(6), False
        elif not self.zeroed:  # a second 255 without a 0 between is ignored (assumed: the maker says to send 0 first)
            self.zero, self.zeroed = self.latest.copy(), True
        self.answers += summed(bytes((0xAA, 0, 80, 1, 0)))

    def _tell(self, address: int, length: int) -> None:
        match address, length:
            case 18, 8:
                body = SERIAL_NUMBER
            case 10, 16:
                body = IDENTITY
            case 50, 6:
                body = bytes((self.speed, self.filter_code, 255 if self.zeroed else 0, 0, 0, 0))
            case 350, 14:
                body = struct.pack(">7H", *CAPACITY)
            case 450, 14:
                body = struct.pack(">7H", *(round(self.faults.register_scale * counts) for counts in COUNTS_AT_CAPACITY))
            case _:
                return
        self.answers += summed(struct.pack(">BHB", 0xAA, address, length) + body)

    def measure(self, wrench: Floats) -> Floats:
        """Convert wrenches to counts, with the slopes of Fz where they belong.

        Args:
            wrench: wrenches (n, 6) in N and Nm in the sensor's axes.

        Returns:
            Counts (n, 6), not rounded and not zeroed.
        """
        unzeroed = np.array(UNZEROED) / _PRESSED
        parted = wrench if self.fz_parts_at == "load" else wrench + unzeroed
        return parted * np.where(parted > 0.0, _PULLED, _PRESSED) + (wrench + unzeroed - parted) * _PRESSED

    def sample(self, counts: Floats, now_s: float) -> bytes:
        """Advance by one millisecond.

        Args:
            counts: counts (6,) of this sample.
            now_s: host time.

        Returns:
            The bytes of the frame with its faults, empty if none is due.
        """
        self.counter = (self.counter + 1) % 65536
        self.latest = counts
        self._index += 1
        faults = self.faults
        if faults.drift_N_per_s:
            faults.drift_N -= faults.drift_N_per_s * 0.001  # towards "pressed"
        if self.speed == 0 or self._index % self.speed:
            return b""
        if now_s < faults.silent_until_s:
            return b""
        if now_s < faults.slow_until_s and (self._index // self.speed) % faults.slow_every:
            return b""
        return self._spoilt(self._frame(counts, now_s))

    def _frame(self, counts: Floats, now_s: float) -> bytes:
        status = self.faults.status if now_s < self.faults.status_until_s else 0
        if now_s >= self.faults.stuck_until_s:
            shown = counts - self.zero
            if self.faults.drift_N:
                shown[2] += self.faults.drift_N * _PRESSED[2]
            words = [int(word) for word in np.rint(shown)]
            self._sent = tuple(max(-32768, min(32767, word)) for word in words)
            beyond = np.abs(counts - UNZEROED) >= COUNTS_AT_CAPACITY[:6]  # assumed: at capacity, not at the 200 % that it bears
            if beyond.any():
                status |= sum(bit for bit, over in zip(_OVERLOAD, beyond, strict=True) if over)
        return summed(_FRAME.pack(0xAA, 0x0708, 16, self.counter, status, *self._sent))

    def _spoilt(self, frame: bytes) -> bytes:
        faults = self.faults
        if faults.flips:
            faults.flips -= 1
            bit = self.random.randrange(8 * len(frame))
            changed = bytearray(frame)
            changed[bit // 8] ^= 1 << bit % 8
            frame = bytes(changed)
        if faults.swaps:
            pairs = [i for i in range(8, 19) if frame[i] != frame[i + 1]]
            if pairs:
                faults.swaps -= 1
                at = self.random.choice(pairs)
                frame = frame[:at] + frame[at + 1 : at + 2] + frame[at : at + 1] + frame[at + 2 :]
        if faults.lose_bytes:
            frame, faults.lose_bytes = frame[min(faults.lose_bytes, len(frame)) :], max(0, faults.lose_bytes - len(frame))
        if faults.false_headers:
            faults.false_headers -= 1
            frame = frame[:4] + self.random.randbytes(5) + frame
        if faults.garbage:
            frame, faults.garbage = faults.garbage + frame, b""
        return frame


class TerminalLine:
    """The terminal device: a pseudo-terminal. Behind a link it is a new one each time the host closes it or it is plugged in again.

    It sends nothing while no host has it open. A host that does not read later finds the oldest 64 KiB or so: newer packets that do not
    fit are lost whole (assumed; a real DAQ's behaviour is not known).
    """

    def __init__(self, link: Path | None) -> None:
        self._link = link
        self._master: int | None = None
        self._listened = False
        self._left = b""
        self.device = ""
        self.plug_in()

    @property
    def path(self) -> str:
        """Path of the device for a host."""
        return str(self._link) if self._link is not None else self.device

    def plug_in(self) -> None:
        """Make the device appear."""
        self.unplug()
        self._master, slave = os.openpty()
        tty.setraw(slave)
        self.device = os.ttyname(slave)
        os.close(slave)
        os.set_blocking(self._master, False)
        self._poll = select.poll()
        self._poll.register(self._master, select.POLLIN)
        if self._link is not None:
            check_link(self._link)
            self._link.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=self._link.parent) as folder:
                fresh = Path(folder) / "link"
                fresh.symlink_to(self.device)
                fresh.replace(self._link)

    def unplug(self) -> None:
        """Make the device go away."""
        if self._master is not None:
            os.close(self._master)
            self._master, self._listened, self._left = None, False, b""
            if self._link is not None and self._link.is_symlink():
                with contextlib.suppress(OSError):
                    self._link.unlink()

    def receive(self) -> bytes:
        """Return the bytes that the host sent since the last call."""
        if self._master is None:
            return b""
        events = self._poll.poll(0)
        if events and events[0][1] & select.POLLHUP:
            if self._listened and self._link is not None:
                self.plug_in()  # a pseudo-terminal keeps its exclusive lock after the host's last close, a USB device does not
            self._listened = False
            return b""
        self._listened = True
        if not events:
            return b""
        try:
            return os.read(self._master, 4096)
        except OSError:
            return b""

    def send(self, packet: bytes) -> None:
        """Send a packet whole or not at all, after the rest of a packet that was cut."""
        if not packet or self._master is None or not self._listened:
            return
        try:
            if self._left:
                self._left = self._left[os.write(self._master, self._left) :]
            if not self._left:
                self._left = packet[os.write(self._master, packet) :]
        except OSError:
            return
