"""ATI Net F/T and other boxes that speak RDT: records over UDP to wrenches in N and Nm, and nothing else.

RDT is ATI's Raw Data Transfer: a request of 8 bytes starts a stream of datagrams of 36 bytes, big-endian. The box's web page says in
`netftapi2.xml` how many counts are a newton. Nothing is set on the box: rate, filter, units and bias stay as its pages have them, and
what differs from the configuration is refused. The tare is palpd's own.
"""

import contextlib
import http.client
import math
import select
import socket
import struct
import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from hw.conversion import CountingSensor
from hw.host_time import MinimumDelayClock
from palpd.errors import SensorError
from palpd.tick import NO_FRAMES, Floats, SensorFrames, SensorSettings

RDT_PORT = 49152
HTTP_PORT = 80
PAGE = "/netftapi2.xml"
MOST_PAGE_BYTES = 100_000
"""Largest page that is read; a Net Box's has some 5 kB."""
TIMEOUT_S = 2.0
"""Longest wait for the page, and for the first record."""
SETTLING_S = 0.25
"""How long the stream is watched before it counts: long enough to see its rate, and one of the shortest ways from box to host."""
MOST_BYTES = 2048
"""Largest datagram that is read whole: a longer one is no record either."""

REQUEST = struct.Struct(">HHI")
"""Header 0x1234, command, number of records (0: without end)."""
REQUEST_HEADER = 0x1234
STOP, START_REALTIME = 0, 2
RECORD = struct.Struct(">III6i")
"""rdt_sequence (counts records), ft_sequence (counts the box's own samples), status, counts of Fx Fy Fz Tx Ty Tz."""

FILTERS_HZ: tuple[float | None, ...] = (None, 838.0, 326.0, 152.0, 73.0, 35.0, 18.0, 8.0, 5.0, 1500.0, 2000.0, 2500.0, 3000.0)
"""Cutoffs of the box's low-pass, by its code `setuserfilter`."""
SATURATED, MONITOR, GAGES, DIGITAL, SETTINGS, NETWORK, LINK, OTHER = (1 << bit for bit in (0, 1, 2, 3, 4, 5, 6, 15))
"""Bits of the status word that palpd records and its guard stops at; the box's word has 32."""
STATUS_BITS: tuple[tuple[int, int, str], ...] = (
    (1 << 17, SATURATED, "transducer saturated, or A/D error"),
    (1 << 16, MONITOR, "a monitor condition of the box is latched"),
    (1 << 28 | 0x7EC, GAGES, "strain gages or analog board"),
    (1 << 30 | 1 << 29 | 1 << 26 | 0x7800, DIGITAL, "digital board, processor or memory"),
    (1 << 25 | 1 << 24 | 1 << 23, SETTINGS, "settings or calibration"),
    (0x7C0002, NETWORK, "a network protocol of the box"),
    (1 << 27 | 1 << 4, LINK, "no data from the transducer"),
)
"""The box's bits, what they become, and what they mean. Bit 31 is the sum of the others."""


def status_word(status: int) -> int:
    """Fold the box's 32 status bits into the word of a frame; 0 is healthy in both."""
    if not status:
        return 0
    return sum(word for mask, word, _ in STATUS_BITS if status & mask) or OTHER


def request(command: int) -> bytes:
    """A request to the box; a stream that it starts has no end."""
    return REQUEST.pack(REQUEST_HEADER, command, 0)


class RdtRecord(NamedTuple):
    """One record of a stream."""

    sequence: int
    ft_sequence: int
    status: int
    counts: tuple[int, ...]


class RecordParser:
    """Judges the datagrams of one stream by their length and their two sequence numbers.

    A record that is older than one before it, or repeats it, is left out: time only goes forward. `rejected` counts what is missing or
    wrong: datagrams that are no record, and records that were overtaken or never came.
    """

    def __init__(self) -> None:
        self.rejected = 0
        self._last: RdtRecord | None = None

    def feed(self, datagram: bytes) -> RdtRecord | None:
        """Return the record of a datagram, None where it is none or came too late."""
        if len(datagram) != RECORD.size:
            self.rejected += 1
            return None
        sequence, ft_sequence, status, *counts = RECORD.unpack(datagram)
        record = RdtRecord(sequence, ft_sequence, status, tuple(counts))
        if self._last is not None:
            step, ft_step = (sequence - self._last.sequence) & 0xFFFFFFFF, (ft_sequence - self._last.ft_sequence) & 0xFFFFFFFF
            if not 0 < step < 1 << 31:
                return None  # it counted as missing when the one after it came
            self.rejected += step - 1
            if not 0 < ft_step < 1 << 31:
                self.rejected += 1
                return None
        self._last = record
        return record


class BoxPage(NamedTuple):
    """What `netftapi2.xml` says."""

    serial_number: str
    counts_per_N: float
    counts_per_Nm: float
    rate_Hz: float
    internal_rate_Hz: float
    filter_cutoff_Hz: float | None
    status: int


class NetFtSensor(CountingSensor):
    """A Net F/T at its address; `read` gives N and Nm in the transducer's own axes, calibrated and not tared.

    The constructor reads the box's page, refuses what differs from the arguments, starts the stream and checks its rate. Of two clients
    the box serves the later one: another program that asks for a stream ends this one, and the frames grow old.

    Args of the constructor: `address` (HOST, or HOST:PORT with the port of the page), `rate_Hz`, `filter_cutoff_Hz` as set on the box,
    `counts_per_N` and `counts_per_Nm` (3 each) to check against the page.

    Raises SensorError, in one sentence, when the box is absent or silent, or is not what was configured.
    """

    calibration_source = "netftapi2.xml"
    pulled_over_pressed: float | None = None
    counter_step = 1

    def __init__(
        self,
        address: str,
        *,
        rate_Hz: float,
        filter_cutoff_Hz: float | None,
        counts_per_N: Sequence[float] | None = None,
        counts_per_Nm: Sequence[float] | None = None,
    ) -> None:
        self.address = address
        host, _, port = address.partition(":")
        page = read_page(_fetch(host, port, address), address)
        _refuse_other(page, address, rate_Hz, filter_cutoff_Hz)
        for name, configured, counts in (("N", counts_per_N, page.counts_per_N), ("Nm", counts_per_Nm, page.counts_per_Nm)):
            if configured is not None and any(abs(each / counts - 1) > 0.01 for each in configured):
                raise SensorError(
                    f"configured {configured[0]:.6g} counts per {name} are off the {counts:.6g} that the box at {address} has on its page; "
                    "correct them or leave them out."
                )
        self.serial_number = page.serial_number
        self.filter_cutoff_Hz = filter_cutoff_Hz
        self.counts_per_unit = np.repeat([page.counts_per_N, page.counts_per_Nm], 3)
        self._sample_s = 1.0 / page.internal_rate_Hz
        self._period_s = 1.0 / page.rate_Hz
        self._parser = RecordParser()
        self._rejected = 0
        self._clock = MinimumDelayClock(leak=1e-3, longest_jump_s=0.5)
        self._samples = 0  # ft_sequence without wraps
        self._last_s = -math.inf
        self._socket: socket.socket | None = None
        try:
            self._open(host)
        except BaseException:
            self.close()
            raise

    def read(self) -> SensorFrames:
        """Return every frame since the last call, without waiting. SensorError when the box is gone."""
        records = self._records()
        arrival_s = time.monotonic()  # after the records: a pause between the two may make a frame late, never early
        rejected = self._parser.rejected - self._rejected
        self._rejected += rejected
        if not records:
            return replace(NO_FRAMES, rejected=rejected) if rejected else NO_FRAMES
        return SensorFrames(
            self._stamp([record.ft_sequence for record in records], arrival_s),
            np.array([record.sequence & 0xFFFF for record in records], np.uint16),
            np.array([status_word(record.status) for record in records], np.uint16),
            np.array([record.counts for record in records], float) / self.counts_per_unit,
            rejected,
        )

    def close(self) -> None:
        """End the stream and release the socket."""
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.send(request(STOP))
            self._socket.close()
            self._socket = None

    def _open(self, host: str) -> None:
        try:
            self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._socket.connect((host, RDT_PORT))  # so datagrams of others are not heard
            self._socket.setblocking(False)
            self._socket.send(request(STOP))
            self._socket.send(request(START_REALTIME))
        except OSError as error:
            raise SensorError(f"box at {self.address} takes no request ({error.strerror}); check the network.") from None
        self._settle()

    def _settle(self) -> None:
        """Read until the rate is seen and the clock has its offset."""
        assert self._socket is not None
        begin_s = time.monotonic()
        sequences: list[int] = []
        while (now_s := time.monotonic()) < begin_s + TIMEOUT_S:
            if len(sequences) > 3 and now_s > begin_s + SETTLING_S + 5 * self._period_s:
                break
            select.select([self._socket], [], [], 0.1)
            records = self._records()
            if records:
                sequences += [record.ft_sequence for record in records]
                self._stamp(sequences[-len(records) :], time.monotonic())
        if not sequences:
            raise SensorError(
                f"box at {self.address} shows its page but sends no record within {TIMEOUT_S:g} s; enable RDT on its page, let UDP port "
                f"{RDT_PORT} through the firewall, and end other programs that read it."
            )
        step = float(np.median([(later - earlier) & 0xFFFFFFFF for earlier, later in pairwise(sequences)]))
        if abs(step * self._sample_s / self._period_s - 1) > 0.02:
            raise SensorError(
                f"box at {self.address} sends a record for every {step:g} of its samples, expected "
                f"{self._period_s / self._sample_s:g}; set its rate again on its page."
            )
        self._rejected = self._parser.rejected

    def _records(self) -> list[RdtRecord]:
        """Return all records that are there."""
        if self._socket is None:
            raise SensorError(f"box at {self.address} is closed; open the sensor again.")
        records = []
        try:
            while True:
                if (record := self._parser.feed(self._socket.recv(MOST_BYTES))) is not None:
                    records.append(record)
        except BlockingIOError:
            return records
        except OSError as error:
            raise SensorError(f"box at {self.address} is gone ({error.strerror}); check its power and cable.") from None

    def _stamp(self, ft_sequences: Sequence[int], arrival_s: float) -> Floats:
        """Give samples that arrived together their times: never earlier than one given before, never later than the arrival."""
        samples, count, previous = [], self._samples, self._samples & 0xFFFFFFFF
        for number in ft_sequences:
            count, previous = count + ((number - previous) & 0xFFFFFFFF), number
            samples.append(count)
        offset_s = self._clock.see(samples[-1] * self._sample_s, arrival_s)
        times = []
        for count in samples:
            # where the offset falls, at least a tenth of the samples' distance stays, so their order stays
            earliest_s = self._last_s + 0.1 * self._sample_s * (count - self._samples)
            self._last_s = min(max(earliest_s, count * self._sample_s + offset_s), arrival_s)
            self._samples = count
            times.append(self._last_s)
        return np.array(times)


def open_ati_net_ft(settings: SensorSettings) -> NetFtSensor:
    """Open the Net F/T of a configuration (entry point `ati-net-ft`); `sensor.port` is its address. Raises SensorError."""
    if settings.options:
        raise SensorError(f"sensor.options holds {', '.join(settings.options)}, but a Net F/T has no options; remove them.")
    return NetFtSensor(
        settings.port,
        rate_Hz=settings.rate_Hz,
        filter_cutoff_Hz=settings.filter_cutoff_Hz,
        counts_per_N=settings.counts_per_N,
        counts_per_Nm=settings.counts_per_Nm,
    )


def read_page(page: bytes, address: str) -> BoxPage:
    """Read `netftapi2.xml`.

    Args:
        address: Address of the box, for errors.

    Returns:
        What matters of it.

    Raises:
        SensorError: It is no such page, or the box has other units, no RDT or no calibration.
    """
    try:
        texts = {each.tag: (each.text or "").strip() for each in ElementTree.fromstring(page).iter()}
        if (texts["scfgfu"], texts["scfgtu"].replace("-", "")) != ("N", "Nm"):  # "Nm" or "N-m", by the age of the box
            raise SensorError(
                f"box at {address} is set to {texts['scfgfu']} and {texts['scfgtu']}, expected N and Nm; set them on its page."
            )
        if texts["comrdte"].lower() not in ("enabled", "1"):
            raise SensorError(f"box at {address} has RDT {texts['comrdte']}; enable it on its page.")
        read = BoxPage(
            texts.get("cfgcalsn", ""),
            float(texts["cfgcpf"]),
            float(texts["cfgcpt"]),
            float(texts["comrdtrate"]),
            float(texts.get("runrate", "7000")),
            FILTERS_HZ[int(texts["setuserfilter"])],
            int(texts["runstat"], 16),
        )
    except (ElementTree.ParseError, KeyError, ValueError, IndexError) as error:
        what = f"it has no {error}" if isinstance(error, KeyError) else str(error)
        raise SensorError(f"box at {address} has no page {PAGE} of a Net F/T ({what}); check the address.") from None
    if not all(math.isfinite(number) and number > 0 for number in read[1:5]):
        raise SensorError(f"box at {address} has {read.counts_per_N:g} counts per N; its calibration is missing.")
    return read


def _refuse_other(page: BoxPage, address: str, rate_Hz: float, filter_cutoff_Hz: float | None) -> None:
    if page.status:
        words = "; ".join(words for mask, _, words in STATUS_BITS if page.status & mask) or "an error that it does not name"
        raise SensorError(f"box at {address} reports status {page.status:#010x} ({words}), expected 0; clear it on its page.")
    if abs(page.rate_Hz / rate_Hz - 1) > 0.01:
        raise SensorError(
            f"box at {address} sends {page.rate_Hz:g} records/s, but sensor.rate_Hz is {rate_Hz:g}; set the same on its page."
        )
    if page.filter_cutoff_Hz != filter_cutoff_Hz:
        raise SensorError(
            f"box at {address} filters at {_hertz(page.filter_cutoff_Hz)}, but sensor.filter_cutoff_Hz is "
            f"{_hertz(filter_cutoff_Hz)}; set the same on its page."
        )


def _hertz(cutoff_Hz: float | None) -> str:
    return "null" if cutoff_Hz is None else f"{cutoff_Hz:g} Hz"


def _fetch(host: str, port: str, address: str) -> bytes:
    """The box's page. Proxies of the environment do not count: the box stands on the cell's own cable."""
    if not host or not (port or "80").isdigit() or not 0 < int(port or HTTP_PORT) < 1 << 16:
        raise SensorError(f"sensor.port is {address!r}, expected the address of the box, such as 192.168.1.1 or 192.168.1.1:8080.")
    connection = http.client.HTTPConnection(host, int(port or HTTP_PORT), timeout=TIMEOUT_S)
    try:
        connection.request("GET", PAGE)
        response = connection.getresponse()
        page = response.read(MOST_PAGE_BYTES)
    except (OSError, http.client.HTTPException, UnicodeError) as error:
        raise SensorError(f"box at {address} does not show its page ({error}); check its power, cable and address.") from None
    finally:
        connection.close()
    if response.status != http.client.OK:
        raise SensorError(f"box at {address} answers {response.status} for {PAGE}; check the address.")
    return page
