"""An ATI Net F/T at the far end of a network: its page over HTTP, its records over UDP (RDT). It shares no code with the driver.

Written from what public drivers and the maker's page names say; "assumed" marks behaviour without a public source.
"""

import contextlib
import selectors
import socket
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from hw.emulators.pose import Floats

RDT_PORT = 49152
COUNTS_PER_N = 1_000_000
COUNTS_PER_NM = 1_000_000
INTERNAL_HZ = 7000
UNLOADED = (1_250_000, -830_000, 14_700_000, 41_000, -12_000, 5_000)
"""Counts of the unloaded transducer: nothing has biased it (assumed size)."""
SERIAL_NUMBER = "FT12345"
CUTOFFS_HZ = {0: None, 1: 838, 2: 326, 3: 152, 4: 73, 5: 35, 6: 18, 7: 8, 8: 5}
RANGES = (145.0, 145.0, 290.0, 5.0, 5.0, 5.0)
"""Calibrated ranges in N and Nm, of a Mini45 SI-145-5; beyond them the transducer counts as saturated (assumed: exactly there)."""
SATURATION = 0x80020000
"""Status of a saturated transducer, with the bit that any error sets."""
MOST_REQUEST_BYTES = 4096


@dataclass
class BoxFaults:
    """Faults of this box. Durations end at a host time, counts fall with each record; by default everything works."""

    silent_until_s: float = 0.0
    status_until_s: float = 0.0
    status: int = 0
    lost: int = 0
    swapped: int = 0
    cut: int = 0


@dataclass
class NetBox:
    """The box: it samples at 7 kHz and streams at `rate_Hz`, a divisor of 1000 here, to the client that asked last."""

    host: str
    http_port: int
    network: selectors.BaseSelector
    rate_Hz: int = 1000
    filter_code: int = 3
    faults: BoxFaults = field(default_factory=BoxFaults)
    samples: int = 0  # of its own, at 7 kHz
    records: int = 0  # of the present stream
    left: int | None = 0  # records that the client still wants, None for no end
    client: tuple[str, int] | None = None
    bias: Floats = field(default_factory=lambda: np.zeros(6))
    counts: Floats = field(default_factory=lambda: np.array(UNLOADED, dtype=float))
    _ticks: int = 0
    _held: bytes = b""

    def __post_init__(self) -> None:
        """Listen on both ports. Raises OSError where one is taken."""
        self._udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._http = socket.socket()
        try:
            self._udp.bind((self.host, RDT_PORT))
            self._http.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._http.bind((self.host, self.http_port))
            self._http.listen(8)
        except OSError:
            self.close()
            raise
        for listener, heard in ((self._udp, self._requests), (self._http, self._visitor)):
            listener.setblocking(False)
            self.network.register(listener, selectors.EVENT_READ, heard)

    @property
    def address(self) -> str:
        """Where a client finds the page."""
        return f"{self.host}:{self.http_port}"

    @property
    def cutoff_Hz(self) -> float | None:
        """Cutoff of the box's low-pass, None for none."""
        return CUTOFFS_HZ[self.filter_code]

    def close(self) -> None:
        """Close both ports."""
        self._udp.close()
        self._http.close()

    # Records ---------------------------------------------------------------------------------------------------------------------

    def _requests(self, _now_s: float) -> None:
        with contextlib.suppress(OSError):
            while True:
                request, client = self._udp.recvfrom(64)
                self.obey(request, client)

    def obey(self, request: bytes, client: tuple[str, int]) -> None:
        """Carry out a request; what is none is ignored.

        Args:
            client: address and port that it came from.
        """
        if len(request) != 8 or request[:2] != b"\x12\x34":
            return
        command, number = int.from_bytes(request[2:4], "big"), int.from_bytes(request[4:], "big")
        if command == 0:
            self.client = None
        elif command in (1, 2):  # a single record, or a stream; 3 would fill datagrams with several records
            self.client, self.records, self._held = client, 0, b""
            self.left = (number or None) if command == 2 else 1
        elif command == 0x42:
            self.bias = self.counts.copy()

    def sample(self, wrench: Floats, now_s: float) -> None:
        """Advance by one millisecond, and send the record that is due.

        Args:
            wrench: wrench (6,) in N and Nm in the transducer's axes.
            now_s: host time.
        """
        self.skip(1)
        self._ticks += 1
        self.counts = wrench * _PER_UNIT + UNLOADED
        if self._ticks % (1000 // self.rate_Hz):
            return
        for datagram in self.datagrams(now_s):
            with contextlib.suppress(OSError):
                if self.client is not None:
                    self._udp.sendto(datagram, self.client)

    def skip(self, milliseconds: int) -> None:
        """Let the box's own samples pass."""
        self.samples = (self.samples + milliseconds * INTERNAL_HZ // 1000) % 2**32

    def datagrams(self, now_s: float) -> list[bytes]:
        """The datagrams that the present record makes, with their faults."""
        if self.client is None or self.left == 0:
            return []
        self.records = (self.records + 1) % 2**32
        self.left = None if self.left is None else self.left - 1
        faults, record = self.faults, self._record(now_s)
        if now_s < faults.silent_until_s:
            return []
        if faults.lost:
            faults.lost -= 1
            return []
        if faults.cut:
            faults.cut -= 1
            return [record[:-1]]
        if self._held:
            held, self._held = self._held, b""
            return [record, held]
        if faults.swapped:
            faults.swapped -= 1
            self._held = record
            return []
        return [record]

    def _record(self, now_s: float) -> bytes:
        saturated = (np.abs(self.counts - UNLOADED) >= np.array(RANGES) * _PER_UNIT).any()
        status = (SATURATION if saturated else 0) | (self.faults.status if now_s < self.faults.status_until_s else 0)
        head = [self.records, self.samples, status]
        axes = [max(-(2**31), min(2**31 - 1, round(count))) for count in (self.counts - self.bias).tolist()]
        return b"".join(number.to_bytes(4, "big") for number in head) + b"".join(count.to_bytes(4, "big", signed=True) for count in axes)

    # The page --------------------------------------------------------------------------------------------------------------------

    def _visitor(self, _now_s: float) -> None:
        with contextlib.suppress(OSError):
            connection, _ = self._http.accept()
            connection.setblocking(False)
            self.network.register(connection, selectors.EVENT_READ, partial(self._hear, connection, bytearray()))

    def _hear(self, connection: socket.socket, request: bytearray, _now_s: float) -> None:
        with contextlib.suppress(OSError):
            more = connection.recv(MOST_REQUEST_BYTES)
            request += more
            if more and b"\r\n\r\n" not in request and len(request) < MOST_REQUEST_BYTES:
                return
            connection.sendall(self.answer(bytes(request)))
        self.network.unregister(connection)
        connection.close()

    def answer(self, request: bytes) -> bytes:
        """Answer a request for a page."""
        asked = request.split(b" ")[1:2]
        if asked != [b"/netftapi2.xml"]:
            return b"HTTP/1.0 404 Not Found\r\nContent-Length: 0\r\n\r\n"
        page = self.page()
        return b"HTTP/1.0 200 OK\r\nContent-Type: text/xml\r\nContent-Length: %d\r\n\r\n%b" % (len(page), page)

    def page(self) -> bytes:
        """The box's page of settings, with the names that its own has."""
        values = {
            "runstat": f"0x{self.faults.status:08x}",
            "runrate": INTERNAL_HZ,
            "setuserfilter": self.filter_code,
            "setbias": "0;0;0;0;0;0",
            "cfgcalsn": SERIAL_NUMBER,
            "cfgfu": 2,
            "scfgfu": "N",
            "cfgtu": 3,
            "scfgtu": "Nm",
            "cfgcpf": COUNTS_PER_N,
            "cfgcpt": COUNTS_PER_NM,
            "cfgmr": ";".join(f"{each:g}" for each in RANGES),
            "comrdte": "Enabled",
            "comrdtrate": self.rate_Hz,
            "comrdtbsiz": 1,
        }
        inner = "\n".join(f"<{name}>{value}</{name}>" for name, value in values.items())
        return f'<?xml version="1.0" encoding="utf-8"?>\n<netft>\n<prodname>Net F/T</prodname>\n{inner}\n</netft>\n'.encode()


_PER_UNIT = np.array([COUNTS_PER_N] * 3 + [COUNTS_PER_NM] * 3, dtype=float)
