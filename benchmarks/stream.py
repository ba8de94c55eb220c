"""How soon the force of a tick reaches another program by `palpd stream`, and what the stream costs the loop.

`python -m benchmarks.stream [--records 10000] [--rates 125,500]` prints a markdown table. The loop is the daemon's own, in real time, with
stand-ins for robot and sensor; it notes when each row stood in the ring. The client is a process of its own, as a user's would be. The
latency is the time from there to the client. Rows: nothing served, the force alone, and all outputs with a viewer of every topic and a
scrape each second.
"""

import argparse
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from palpd.daemon.control_socket import ControlSocket, Watching
from palpd.recording.ring import Ring
from palpd.streams.force_socket import RECORD, ForceRecord
from palpd.testing.processes import free_port, over_and_over, processor_s, until
from palpd.tick import Floats, TickRecord

OUTPUTS = {"nothing": (), "force": ("force",), "all, viewed and scraped": ("force", "foxglove", "metrics")}
SETTLE_S = 2.0
"""Time before the loop begins, in which viewer and client connect."""
MODELS = {125: "ur5", 500: "ur5e"}
TARGET_LOST = 0.01
"""Largest share of ticks that a client may miss on a machine that is not crowded."""


# --- the loop, in a process of its own ------------------------------------------------------------------------------------------


class Noted:
    """Writes rows into the ring, and notes of each tick: planned, began, row stood in the ring (all in s), ticks missed before it."""

    def __init__(self, writer: Any) -> None:
        self._writer = writer
        self.ticks: list[tuple[float, float, float, int]] = []

    def __call__(self, record: TickRecord) -> None:
        """Write and note."""
        self._writer(record)
        timing = record.observation.timing
        self.ticks.append((timing.planned_s, timing.now_s, time.monotonic(), timing.missed))

    def rehearse(self, record: TickRecord) -> None:
        """Write only."""
        self._writer.rehearse(record)


def run_loop(rate_Hz: float, seconds: float, file: Path) -> None:
    """Run the loop for that long after a line on the standard input; keep the times of all ticks in a file."""
    from benchmarks.rate import idle_loop
    from palpd.daemon.clock import RealClock
    from palpd.daemon.motion_process import RingWriter
    from palpd.daemon.realtime import realtime

    with closing(Ring.create(rate_Hz)) as ring:
        print(ring.name, flush=True)
        sys.stdin.readline()
        record, clock = Noted(RingWriter(ring)), RealClock(rate_Hz, time.monotonic() + 0.3)
        loop = idle_loop(seconds, clock, record)
        with realtime():
            loop.rehearse(200)
            clock.begin_soon()
            outcome = loop.run()
        np.save(file, np.array(record.ticks))
        print(outcome.reason or "done", flush=True)


# --- who reads, each in a process of its own --------------------------------------------------------------------------------------


def read_force(path: Path, file: Path) -> None:
    """Take every record until the stream ends, and keep its times and when it came."""
    taken = []
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as force:
        until(lambda: force.connect_ex(str(path)) == 0, "the stream listens", every_s=0.1)
        print("reads", flush=True)
        while data := force.recv(RECORD.size):
            came_s = time.monotonic()
            record = ForceRecord(*RECORD.unpack(data))
            taken.append((record.tick_s, record.sent_s, came_s))
    np.save(file, np.array(taken).reshape(-1, 3))


def view(foxglove_port: int, metrics_port: int) -> None:
    """Subscribe to every topic and scrape once a second, until the stream ends."""
    import json

    from websockets.sync.client import connect

    def scrape() -> None:
        with suppress(OSError):
            while True:
                urllib.request.urlopen(f"http://127.0.0.1:{metrics_port}/metrics", timeout=10.0).read()
                time.sleep(1.0)

    with connect(f"ws://127.0.0.1:{foxglove_port}", subprotocols=["foxglove.sdk.v1"]) as client:  # type: ignore[list-item]
        client.recv()
        channels = json.loads(client.recv())["channels"]
        subscriptions = [{"id": channel["id"], "channelId": channel["id"]} for channel in channels]
        client.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))
        threading.Thread(target=scrape, daemon=True).start()
        print("views", flush=True)
        for _ in client:
            pass


# --- the measurement ----------------------------------------------------------------------------------------------------------------


@contextmanager
def service_for(path: Path, ring_name: str) -> Iterator[None]:
    """A control socket that tells watchers of a ring, within the context."""
    status: Any = {"ok": True, "event": "status", "state": "running", "latched": None, "pid": os.getpid(), "ring": ring_name}
    with closing(ControlSocket(path, lambda _: Watching(status))) as control, over_and_over(lambda: control.poll(0.1)):
        yield


def measure(rate_Hz: int, records: int, served: str, folder: Path) -> dict[str, Any]:
    """Run the loop once with these outputs served. Returns latencies, lateness and counts."""
    folder.mkdir()
    config = folder / "config.yaml"
    config.write_text(yaml.safe_dump({"robot": {"model": MODELS[rate_Hz]}}))
    ports = [free_port(), free_port()]
    options = {
        "force": ["--force", str(folder / "force")],
        "foxglove": ["--foxglove", str(ports[0])],
        "metrics": ["--metrics", str(ports[1])],
    }
    chosen = [word for output in OUTPUTS[served] for word in options[output]]
    with ExitStack() as stack:
        loop = _started(stack, ["-m", "benchmarks.stream", "--loop", str(rate_Hz), str(records / rate_Hz), str(folder / "loop.npy")])
        ring_name = _line(loop)
        stack.enter_context(service_for(folder / "palpd.sock", ring_name))
        stream = reader = None
        if chosen:
            stream = _started(stack, ["-m", "palpd", "stream", "--config", str(config), "--socket", str(folder / "palpd.sock"), *chosen])
            for _ in OUTPUTS[served]:
                _line(stream)
            reader = _started(stack, ["-m", "benchmarks.stream", "--read", str(folder / "force"), str(folder / "taken.npy")])
            _line(reader)
        if "foxglove" in OUTPUTS[served]:
            _line(_started(stack, ["-m", "benchmarks.stream", "--view", *map(str, ports)]))
        time.sleep(SETTLE_S)
        before_s = processor_s(stream.pid) if stream is not None else 0.0
        assert loop.stdin is not None
        loop.stdin.write("go\n")
        loop.stdin.flush()
        assert (ended := _line(loop)) == "done", ended
        spent_s = processor_s(stream.pid) - before_s if stream is not None else 0.0
        if stream is not None and reader is not None:
            stream.send_signal(signal.SIGTERM)
            assert stream.wait(30.0) == 0, "the stream failed"
            assert reader.wait(30.0) == 0, "the reader failed"
    ticks = np.load(folder / "loop.npy")
    figures = {"ticks": len(ticks), "missed": int(ticks[:, 3].sum()), "late_us": (ticks[:, 1] - ticks[:, 0]) * 1e6}
    if not chosen:
        return figures
    taken = np.load(folder / "taken.npy")
    written_s = dict(ticks[:, 1:3].tolist())
    taken = taken[[tick_s in written_s for tick_s in taken[:, 0].tolist()]]
    from_ring_us = (taken[:, 2] - [written_s[tick_s] for tick_s in taken[:, 0].tolist()]) * 1e6
    sent_us = (taken[:, 2] - taken[:, 1]) * 1e6
    return figures | {"from_ring_us": from_ring_us, "sent_us": sent_us, "share": spent_s / (records / rate_Hz)}


def _started(stack: ExitStack, words: Sequence[str]) -> subprocess.Popen[str]:
    process = subprocess.Popen([sys.executable, *words], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    stack.enter_context(process)
    stack.callback(process.kill)
    return process


def _line(process: subprocess.Popen[str]) -> str:
    """Its next line; a process that ends before it has failed."""
    assert process.stdout is not None
    line = process.stdout.readline().strip()
    assert line, f"{process.args} ended too early"
    return line


def line_of(rate_Hz: int, served: str, figures: dict[str, Any]) -> str:
    """One line of the table."""

    def spread(values: Floats) -> str:
        p50, p99 = np.percentile(values, [50, 99])
        return f"{p50:.0f}, {p99:.0f}"

    cells = [f"{rate_Hz} Hz", served, str(figures["ticks"])]
    if "from_ring_us" in figures:
        taken = len(figures["from_ring_us"])
        cells += [f"{taken}", spread(figures["from_ring_us"]), spread(figures["sent_us"]), f"{figures['share']:.1%}"]
    else:
        cells += ["", "", "", ""]
    cells += [spread(figures["late_us"]), str(figures["missed"])]
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Measure and print; ends with 1 where a client missed too many ticks."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--records", type=int, default=10_000, help="ticks of each line")
    parser.add_argument("--rates", default="125,500")
    parser.add_argument("--loop", nargs=3, help=argparse.SUPPRESS)
    parser.add_argument("--read", nargs=2, type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--view", nargs=2, type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.loop:
        run_loop(float(options.loop[0]), float(options.loop[1]), Path(options.loop[2]))
    elif options.read:
        read_force(*options.read)
    elif options.view:
        view(*options.view)
    else:
        sys.exit(0 if _table(options.records, [int(rate) for rate in options.rates.split(",")]) else 1)


def _table(records: int, rates_Hz: Sequence[int]) -> bool:
    """Measure and print all lines; whether the clients got nearly all ticks."""
    heads = ("loop", "served", "ticks", "records", "ring to client p50, p99, µs", "of it from the sending, µs", "stream's CPU")
    print(f"| {' | '.join((*heads, 'wake-up p50, p99, µs', 'missed'))} |")
    print("|---|---|---|---|---|---|---|---|---|")
    complete = True
    with tempfile.TemporaryDirectory() as name:
        for number, (rate_Hz, served) in enumerate((rate_Hz, served) for rate_Hz in rates_Hz for served in OUTPUTS):
            figures = measure(rate_Hz, records, served, Path(name) / str(number))
            print(line_of(rate_Hz, served, figures), flush=True)
            lost = figures["ticks"] - len(figures.get("from_ring_us", figures["late_us"]))
            complete = complete and lost <= TARGET_LOST * figures["ticks"]
    return complete


if __name__ == "__main__":
    main()
