"""The driver of a Net F/T before a scripted box: what it asks, what it refuses, and what its frames are."""

import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from itertools import count

import numpy as np
import pytest

from hw import ati_net_ft
from hw.ati_net_ft import NetFtSensor, open_ati_net_ft
from palpd.config import SensorConfig
from palpd.errors import SensorError

PAGE = {
    "runstat": "0x00000000", "runrate": "7000", "setuserfilter": "3", "cfgcalsn": "FT9", "scfgfu": "N", "scfgtu": "Nm",
    "cfgcpf": "1000000", "cfgcpt": "500000", "comrdte": "Enabled", "comrdtrate": "1000",
}  # fmt: skip
_hosts = count(2)


class ScriptedBox(threading.Thread):
    """A page, and a stream of records once a millisecond; `spoil` turns a record into the datagrams that are sent."""

    def __init__(self, page: dict[str, str], spoil: Callable[[int, bytes], list[bytes]], step: int) -> None:
        super().__init__(daemon=True)
        self.host, self.spoil, self.step = f"127.0.94.{next(_hosts)}", spoil, step
        self.commands: list[int] = []
        self.due_s: list[float] = []  # when each record was sampled; a busy machine may send it later
        self.over = False
        body = "<netft>" + "".join(f"<{name}>{text}</{name}>" for name, text in page.items()) + "</netft>"

        class Page(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.send_response(200 if self.path == "/netftapi2.xml" else 404)
                self.end_headers()
                self.wfile.write(body.encode())

            def log_message(self, *_: object) -> None: ...

        self.http = HTTPServer((self.host, 0), Page)
        self.udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.udp.bind((self.host, 49152))
        self.udp.settimeout(0.001)
        threading.Thread(target=self.http.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()

    @property
    def address(self) -> str:
        return f"{self.host}:{self.http.server_port}"

    def run(self) -> None:
        client, sequence, due_s = None, 0, time.monotonic()
        while not self.over:
            try:
                request, client = self.udp.recvfrom(100)
                header, command, number = struct.unpack(">HHI", request)
                assert (header, number) == (0x1234, 0)
                self.commands.append(command)
                client = client if command == 2 else None
                due_s = time.monotonic()
            except TimeoutError:
                pass
            while client is not None and time.monotonic() >= due_s:
                self.due_s.append(due_s)
                sequence, due_s = sequence + 1, due_s + 0.001
                record = struct.pack(
                    ">III6i", sequence, (2**32 - 700 + sequence * self.step) % 2**32, 0, 2_000_000, 0, -sequence, 500_000, 0, 0
                )
                for datagram in self.spoil(sequence, record):
                    self.udp.sendto(datagram, client)
        self.udp.close()


@contextmanager
def scripted(spoil: Callable[[int, bytes], list[bytes]] = lambda _, record: [record], step: int = 7, **page: str) -> Iterator[ScriptedBox]:
    box = ScriptedBox(PAGE | page, spoil, step)
    box.start()
    yield box
    box.over = True
    box.join(2.0)
    box.http.shutdown()
    box.http.server_close()


def opened(box: ScriptedBox, **changes: object) -> NetFtSensor:
    settings = {"kind": "ati-net-ft", "port": box.address, "rate_Hz": 1000.0, "filter_cutoff_Hz": 152.0} | changes
    sensor = open_ati_net_ft(SensorConfig.model_validate(settings))
    assert isinstance(sensor, NetFtSensor)
    return sensor


def read_until(sensor: NetFtSensor, frames: int) -> list[np.ndarray]:
    """Columns of that many frames: t_s, counter, status, wrench, and the sum of rejected ones."""
    parts, rejected, end_s = [], 0, time.monotonic() + 5.0
    while sum(map(len, parts)) < frames and time.monotonic() < end_s:
        got = sensor.read()
        rejected += got.rejected
        parts += [got] if len(got) else []
    joined = [np.concatenate([getattr(part, name) for part in parts]) for name in ("t_s", "counter", "status", "wrench")]
    return [*joined, np.array(rejected)]


def test_frames_are_calibrated_in_order_and_on_the_hosts_clock() -> None:
    """The sample counter of the box wraps meanwhile."""
    with scripted() as box:
        sensor = opened(box)
        t_s, counter, status, wrench, rejected = read_until(sensor, 300)
        sensor.close()
    assert np.allclose(wrench[:, [0, 1, 3, 4]], [2.0, 0.0, 1.0, 0.0])
    assert np.allclose(np.diff(wrench[:, 2]), -1e-6)
    assert (np.diff(counter.astype(int)) & 0xFFFF == 1).all()
    assert (np.diff(t_s) > 0.0).all()
    late_s = t_s[-1] - box.due_s[round(-1e6 * wrench[-1, 2]) - 1]
    assert 0.0 <= late_s < 0.1
    assert t_s[-1] - t_s[0] == pytest.approx(len(t_s) * 1e-3, rel=0.1)
    assert (int(status.max()), int(rejected)) == (0, 0)
    assert (sensor.serial_number, sensor.delay_s) == ("FT9", pytest.approx(1 / (2 * np.pi * 152)))


def test_it_stops_the_stream_before_and_after_and_never_biases() -> None:
    with scripted() as box:
        opened(box).close()
        end_s = time.monotonic() + 2.0
        while box.commands != [0, 2, 0] and time.monotonic() < end_s:
            box.join(0.001)
    assert box.commands == [0, 2, 0]


def test_records_that_are_lost_overtaken_or_cut_are_counted_and_the_rest_is_kept() -> None:
    held: list[bytes] = []

    def spoil(sequence: int, record: bytes) -> list[bytes]:
        match sequence % 100:
            case 10:
                return []
            case 20:
                held.append(record)
                return []
            case 21 if held:
                return [record, held.pop()]
            case 30:
                return [record[:-4]]
            case 40:
                return [record, record]
        return [record]

    with scripted(spoil) as box:
        sensor = opened(box)
        _, counter, _, _, rejected = read_until(sensor, 500)
        sensor.close()
    steps = np.diff(counter.astype(int)) & 0xFFFF
    assert steps.min() == 1
    places = int((steps > 1).sum())
    assert places >= 12
    assert int(rejected) == pytest.approx(places + places / 3, abs=2)  # a cut record counts as itself and as missing


def test_a_status_of_the_box_reaches_the_frames() -> None:
    def saturated(sequence: int, record: bytes) -> list[bytes]:
        return [record[:8] + bytes.fromhex("80020000") + record[12:] if sequence > 400 else record]

    with scripted(saturated) as box:
        sensor = opened(box)
        status = read_until(sensor, 500)[2]
        sensor.close()
    assert (int(status[0]), int(status[-1])) == (0, ati_net_ft.SATURATED)


@pytest.mark.parametrize(
    ("page", "changes", "sentence"),
    [
        ({"comrdtrate": "500"}, {}, r"sends 500 records/s, but sensor.rate_Hz is 1000; set the same"),
        ({"setuserfilter": "0"}, {}, r"filters at null, but sensor.filter_cutoff_Hz is 152 Hz"),
        ({"runstat": "0x80020000"}, {}, r"status 0x80020000 \(transducer saturated, or A/D error\), expected 0"),
        ({"scfgfu": "lbf"}, {}, "is set to lbf and Nm"),
        ({}, {"counts_per_N": (9e5, 9e5, 9e5), "counts_per_Nm": (5e5, 5e5, 5e5)}, "configured 900000 counts per N are off the 1e.06"),
        ({}, {"options": {"gain": 2}}, "sensor.options holds gain"),
        ({}, {"port": "127.0.94.1"}, "does not show its page"),
        ({}, {"port": "127.0.94.1:http"}, "expected the address of the box"),
        ({}, {"port": ":80"}, "expected the address of the box"),
    ],
)
def test_a_box_that_is_not_what_was_configured_is_refused(page: dict[str, str], changes: dict[str, object], sentence: str) -> None:
    with scripted(**page) as box, pytest.raises(SensorError, match=sentence):
        opened(box, **changes)


def test_a_box_that_sends_nothing_is_refused_with_what_to_check(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ati_net_ft, "TIMEOUT_S", 0.3)
    with scripted(lambda *_: []) as box, pytest.raises(SensorError, match=r"sends no record within 0\.3 s; enable RDT"):
        opened(box)


def test_a_rate_that_is_not_the_pages_is_refused() -> None:
    with scripted(step=14) as box, pytest.raises(SensorError, match="a record for every 14 of its samples, expected 7"):
        opened(box)


def test_a_closed_sensor_says_so() -> None:
    with scripted() as box:
        sensor = opened(box)
        sensor.close()
        sensor.close()
        with pytest.raises(SensorError, match="is closed; open the sensor again"):
            sensor.read()
