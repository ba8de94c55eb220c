"""How soon `palpd abort` stops the arm, from the start of its process to a target speed of zero in the controller.

`python -m benchmarks.abort [--samples 50] [--minutes 30] [--json FILE]`. The service moves an emulated arm. Meanwhile other clients leave
it alone, hold 200 half-open connections, or ask for its status in 20 tight loops besides. Results are added to FILE; the column "measured"
of docs/faults.md is made of all of FILE. Ends with 1 where the 99th percentile is above the target. Some 9 s a sample on a quiet machine.

With `--half-open 1500` the abort is a request to the server of the page, which may open 1024 files, while that many other connections
send half of a header, and each is opened again as soon as it is closed. The service answers at once: no arm, no browser.

With `--page` the abort is a click on the button of the operator's page, in a headless Chromium, at a random moment of the motion. It prints
how long it took from the click to the stop on the robot's wire, to the page that shows the abort, and to a target speed of zero.
"""

import argparse
import contextlib
import json
import math
import os
import selectors
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import numpy as np

from benchmarks.measured_column import FAULTS, condition, fill, results_in, spread
from palpd.daemon.control_socket import ControlSocket
from palpd.daemon.socket_client import ask
from palpd.errors import PalpdError
from palpd.recording.reader import Recording
from palpd.testing import served_cell
from palpd.testing.emulated_cell import ABOVE_M, PATIENT, PRESS, EmulatedCell, emulated_cell
from palpd.testing.processes import over_and_over, take_signals, until

if TYPE_CHECKING:
    from playwright.sync_api import Page

TARGET_S = 0.250
HALF_OPEN = 200
LOOPS = 20
CROWDS = {"nobody else": (0, 0), "200 half-open": (HALF_OPEN, 0), "200 half-open, 20 loops": (HALF_OPEN, LOOPS)}
"""Number of half-open connections, and of clients that ask in a tight loop."""
SETTLE_S = 1.0
PAGE_TARGETS_S = {"wire": 0.100, "shown": 0.200}
"""From the click, at the 99th percentile: stop on the robot's wire, and the page shows that the abort was carried out."""
PAGE_HOPS = {
    "wire": "stop on the robot's wire",
    "shown": "the page shows the abort",
    "ended": "the page shows no run any more",
    "rest": "target speed zero",
}
CROWDED_PAGE_TARGET_S = 0.5
"""Target at the 99th percentile for an abort by a page whose server others crowd."""
DESCRIPTORS = 1024
"""Files that the server of a crowded page may open: the usual limit of a shell."""
SPREAD_S = 3.0
"""A click comes at a random moment of that long, while the arm moves."""
HOPS = ("python", "sent", "tick", "wire", "rest", "answered")
"""Moments of an abort: Python runs, the request is sent, a tick has seen it, its stop is on the wire, rest, the answer is there."""
STAMPED = """
import time
stamps = {"python": time.monotonic()}
from palpd.cli import first_abort, main
send = first_abort.send_first_abort
def stamped(arguments):
    stamps["first"] = send(arguments)
    stamps["sent"] = time.monotonic()
first_abort.send_first_abort = stamped
try:
    main()
finally:
    import json
    stamps["answered"] = time.monotonic()
    print(json.dumps(stamps))
"""
"""`palpd abort` that says when it was where."""


def _crowd_in(path: Path, half_open: int, loops: int) -> None:
    """Crowd the socket until this process is killed. A connection that the service closes is opened again."""
    for _ in range(loops):
        threading.Thread(target=_ask_in_a_loop, args=(path,), daemon=True).start()
    held: list[socket.socket] = []
    while True:
        while len(held) < half_open:
            client = socket.socket(socket.AF_UNIX)
            with contextlib.suppress(OSError):
                client.connect(str(path))
            client.setblocking(False)
            held.append(client)
        print("crowded", flush=True)
        time.sleep(0.05)
        held = [client for client in held if not _is_closed(client)]


def _is_closed(client: socket.socket) -> bool:
    try:
        return client.recv(1) == b""
    except BlockingIOError:
        return False
    except OSError:
        return True


def _ask_in_a_loop(path: Path) -> None:
    while True:
        with contextlib.suppress(OSError, PalpdError):
            ask(path, {"do": "status"})


@contextmanager
def crowded(path: Path, half_open: int, loops: int) -> Iterator[None]:
    """Crowd a control socket from another process within the context.

    Args:
        path: The socket.
        half_open: Number of connections that send nothing.
        loops: Number of clients that ask for the status in a tight loop.

    Yields:
        Nothing; the crowd is there.
    """
    if not half_open and not loops:
        yield
        return
    command = [sys.executable, "-m", "benchmarks.abort", "--crowd", str(path), str(half_open), str(loops)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True) as crowd:
        assert crowd.stdout is not None
        crowd.stdout.readline()
        threading.Thread(target=crowd.stdout.read, daemon=True).start()
        try:
            yield
        finally:
            crowd.kill()


def _half_open(host: str, port: int, number: int) -> None:
    """Hold that many connections with half of a header until this process is killed; a closed one is opened again at once."""
    selector = selectors.DefaultSelector()

    def connect() -> None:
        client = socket.socket()
        client.setblocking(False)
        client.connect_ex((host, port))
        selector.register(client, selectors.EVENT_READ | selectors.EVENT_WRITE)

    for _ in range(number):
        connect()
    begun_s = time.monotonic()
    while True:
        for key, events in selector.select(SETTLE_S):
            client = key.fileobj
            assert isinstance(client, socket.socket)
            try:
                if events & selectors.EVENT_WRITE:
                    client.send(b"GET / HTTP/1.1\r\nHost: ")
                    selector.modify(client, selectors.EVENT_READ)
                elif not client.recv(1):
                    raise ConnectionResetError
            except OSError:
                selector.unregister(client)
                client.close()
                connect()
        if begun_s and time.monotonic() > begun_s + SETTLE_S:
            print("crowded", flush=True)
            begun_s = 0.0


def measure_crowded_page(samples: int, half_open: int, folder: Path) -> bool:
    """Abort by a server of the page whose connections are crowded, print how long it took, and say whether the target was kept."""
    from benchmarks.operator_page import page_server
    from palpd.daemon.logs import configure

    configure()
    config = folder / "config.yaml"
    config.write_text("paths: {state: .}\n")
    service = ControlSocket(folder / "palpd.sock", lambda _: {"ok": True, "state": "disarmed"})
    taken_s, failed = [], 0
    with over_and_over(lambda: service.poll(0.05)), page_server(config, DESCRIPTORS) as server:
        address = urlsplit(server.url)
        origin = f"http://{address.netloc}"
        request = urllib.request.Request(f"{origin}/abort", method="POST", headers={"Origin": origin})
        command = [sys.executable, "-m", "benchmarks.abort", "--crowd-page", str(address.hostname), str(address.port), str(half_open)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True) as crowd:
            try:
                assert crowd.stdout is not None
                crowd.stdout.readline()
                while len(taken_s) + failed < samples:
                    began_s = time.monotonic()
                    try:
                        with urllib.request.urlopen(request, timeout=5.0) as answer:
                            assert json.load(answer)["ok"]
                        taken_s.append(time.monotonic() - began_s)
                    except OSError as error:
                        print(error, file=sys.stderr)
                        failed += 1
                    time.sleep(0.1)
            finally:
                crowd.kill()
    p50_ms, p99_ms = np.percentile(taken_s, [50, 99]) * 1e3 if taken_s else (math.nan, math.nan)
    print("| half-open connections | p50, ms | p99, ms | largest, ms | target p99, ms | n | failed |")
    print("|---|---|---|---|---|---|---|")
    largest_ms = max(taken_s, default=math.nan) * 1e3
    print(
        f"| {half_open} | {p50_ms:.0f} | {p99_ms:.0f} | {largest_ms:.0f} | {CROWDED_PAGE_TARGET_S * 1e3:.0f} | {len(taken_s)} | {failed} |"
    )
    return not failed and bool(p99_ms <= CROWDED_PAGE_TARGET_S * 1e3)


def aborted(cell: EmulatedCell, path: Path, crowd: str) -> dict[str, Any]:
    """Start a plan, let the crowd in, abort, and wait until the arm is at rest.

    Args:
        cell: The cell that the service moves.
        path: Control socket of the service.
        crowd: One of `CROWDS`.

    Returns:
        One entry of the results.
    """
    _begin_motion(cell, path)
    with crowded(path, *CROWDS[crowd]):
        began_s = time.monotonic()
        assert cell.log(began_s - 0.05)[-1].speed_m_per_s > 0.0, "the run ended before the abort"
        command = [sys.executable, "-c", STAMPED, "abort", "--config", str(cell.folder / "config.yaml")]
        # a session of its own, as a terminal has: with sched_autogroup it shares the processors with the crowd, not a share of them
        done = subprocess.run(command, capture_output=True, text=True, timeout=30.0, check=False, start_new_session=True)
        ended_s = time.monotonic() - began_s
        rest_s = cell.rest_after_s(began_s, settle_s=max(SETTLE_S, ended_s + 0.6))
        heard = cell.wires.ask("wire", since_s=began_s)["heard"]
    stamps = json.loads(done.stdout.splitlines()[-1]) | {"tick": _tick_s(path), "rest": began_s + rest_s}
    stamps["wire"] = _stop_on_wire_s(heard)
    return {
        "crowd": crowd,
        "rest_s": rest_s,
        "hops_s": {hop: stamps.get(hop, math.nan) - began_s for hop in HOPS},
        "first": stamps["first"],
        "code": done.returncode,
        "stderr": done.stderr[-200:],
        "load": os.getloadavg()[0],
    }


def aborted_by_page(cell: EmulatedCell, path: Path, page: "Page", after_s: float) -> dict[str, Any]:
    """Start a plan, click on the abort of the page, and wait until the arm is at rest.

    Args:
        cell: The cell that the service moves.
        path: Control socket of the service.
        page: The page, prepared with `WATCH_ABORT`.
        after_s: When to click, after the motion has begun.

    Returns:
        One entry of the results.
    """
    from benchmarks.operator_page import click_abort

    _begin_motion(cell, path)
    page.wait_for_function("document.body.dataset.state === 'running'")
    time.sleep(after_s)
    before_s = time.monotonic()
    assert cell.log(before_s - 0.05)[-1].speed_m_per_s > 0.0, "the run ended before the abort"
    times = click_abort(page)
    click_s = times["click"]
    rest_s = cell.rest_after_s(click_s, settle_s=max(SETTLE_S, time.monotonic() - click_s + 0.6))
    heard = cell.wires.ask("wire", since_s=before_s)["heard"]
    stamps = times | {"wire": _stop_on_wire_s(heard), "rest": click_s + rest_s}
    return {"crowd": "page", "hops_s": {hop: stamps[hop] - click_s for hop in PAGE_HOPS}, "load": os.getloadavg()[0]}


def _begin_motion(cell: EmulatedCell, path: Path) -> None:
    """Arm, start a slow search 8 mm above a wall, and wait until the arm moves."""
    until(lambda: ask(path, {"do": "status"})["state"] == "disarmed", "the service is disarmed", every_s=0.1)
    cell.wires.ask("restart", s=0.1)
    time.sleep(0.3)
    cell.wall(ABOVE_M, 1000.0)  # the last run has left the tip lower
    ask(path, {"do": "arm"}, 60.0)
    ask(path, {"do": "start", "plan": PRESS | {"sites": [{"name": "A"}], "search": {"speed_m_per_s": 0.001, "max_travel_m": 0.03}}})
    until(lambda: ask(path, {"do": "status"}).get("phase") == "search", "the arm moves", every_s=0.1)


def _stop_on_wire_s(heard: Sequence[tuple[float, float]]) -> float:
    """When the controller first heard a speed of zero."""
    return next((t_s for t_s, vz in heard if vz == 0.0), math.nan)


def _tick_s(path: Path) -> float:
    """Time of the tick that saw the abort, by the recording of the run, once that is closed."""
    until(lambda: ask(path, {"do": "status"})["state"] == "disarmed", "the service is disarmed", every_s=0.1)
    recording = ask(path, {"do": "status"})["last"]["recording"]
    return float(Recording.load(Path(str(recording))).rows["now_s"][-1]) if recording else math.nan


def measure(samples: int, end_s: float, kept: Path, folder: Path) -> None:
    """Abort until FILE holds that many samples of each crowd, in turn.

    Args:
        samples: Number of samples a crowd.
        end_s: Host time after which no sample is begun.
        kept: File that takes a line a sample.
        folder: Folder of the service.
    """
    with served(folder) as (cell, path):
        for number in range(samples):
            for crowd in CROWDS:
                if sum(result["crowd"] == crowd for result in results_in(kept)) > number:
                    continue
                if time.monotonic() > end_s:
                    return
                _keep(kept, crowd, lambda: aborted(cell, path, crowd))  # noqa: B023 - called at once


def measure_page(samples: int, end_s: float, kept: Path, folder: Path) -> None:
    """Abort by the page's button until FILE holds that many samples. Arguments as of `measure`."""
    from benchmarks.operator_page import WATCH_ABORT, opened_pages, page_server

    rng = np.random.default_rng()
    with served(folder) as (cell, path), page_server(cell.config) as server, opened_pages(server.url, 1) as (page,):
        page.evaluate(WATCH_ABORT)
        while sum(result["crowd"] == "page" for result in results_in(kept)) < samples and time.monotonic() < end_s:
            _keep(kept, "page", lambda: aborted_by_page(cell, path, page, rng.uniform(0.0, SPREAD_S)))


def _keep(kept: Path, crowd: str, attempt: Callable[[], dict[str, Any]]) -> None:
    """Add a sample to FILE, unless nothing was measured."""
    try:
        entry = attempt()
    except (PalpdError, AssertionError) as error:  # the machine stood still, and the guard ended the run before the abort
        print(f"{crowd}: nothing was measured ({error})", file=sys.stderr, flush=True)
        return
    with kept.open("a") as file:
        file.write(json.dumps(entry) + "\n")
    hops = ", ".join(f"{hop} {after_s * 1e3:.0f}" for hop, after_s in entry["hops_s"].items())
    print(f"{crowd}, ms after the abort: {hops} {entry.get('stderr', '')}", file=sys.stderr, flush=True)


@contextmanager
def served(folder: Path) -> Iterator[tuple[EmulatedCell, Path]]:
    """A calibrated service before an emulated cell within the context, with its control socket."""
    with emulated_cell(folder) as base, served_cell.served(base.anew(folder, **PATIENT)) as service:
        yield service.cell, service.socket


def write_table(entries: Sequence[dict[str, Any]]) -> bool:
    """Fill the column "measured" of docs/faults.md, print what each hop took, and say whether the target was kept.

    Args:
        entries: All results.

    Returns:
        The verdict.
    """
    cells, kept = {}, True
    for crowd in CROWDS:
        of_crowd = [entry for entry in entries if entry["crowd"] == crowd]
        if not of_crowd:
            continue
        rests_ms = [entry["rest_s"] * 1e3 for entry in of_crowd]
        failed = sum(entry["code"] != 0 for entry in of_crowd)
        late = float(np.percentile(rests_ms, 99)) > TARGET_S * 1e3
        hops_ms = {hop: [entry["hops_s"][hop] * 1e3 for entry in of_crowd] for hop in HOPS}
        on_the_way = ", ".join(f"{hop} {np.nanmedian(values):.0f} / {np.nanpercentile(values, 99):.0f}" for hop, values in hops_ms.items())
        print(f"{crowd}, ms after the keystroke, p50 / p99: {on_the_way}")
        notes = f"; **{failed} failed**" * bool(failed) + "; **p99 not kept**" * late
        sent = f"request sent p50 {np.nanmedian(hops_ms['sent']):.0f}, p99 {np.nanpercentile(hops_ms['sent'], 99):.0f}"
        cells[crowd] = f"{spread(rests_ms, 0)}, n {len(rests_ms)}; {sent}{notes}"
        kept = kept and not failed and not late
    fill(FAULTS, cells, "Aborts measured", condition([entry["load"] for entry in entries], f"{len(entries)} aborts"))
    return kept


def print_page_table(entries: Sequence[dict[str, Any]]) -> bool:
    """Print how long a click on the page's button took, and say whether the targets were kept."""
    print("| from the click on the page's abort to | p50, ms | p99, ms | largest, ms | target p99, ms | n |")
    print("|---|---|---|---|---|---|")
    kept = True
    for hop, what in PAGE_HOPS.items():
        after_ms = np.array([entry["hops_s"][hop] for entry in entries]) * 1e3
        p50, p99 = np.percentile(after_ms, [50, 99])
        target = f"{PAGE_TARGETS_S[hop] * 1e3:.0f}" if hop in PAGE_TARGETS_S else ""
        print(f"| {what} | {p50:.0f} | {p99:.0f} | {after_ms.max():.0f} | {target} | {len(entries)} |")
        kept = kept and bool(p99 <= PAGE_TARGETS_S.get(hop, math.inf) * 1e3)
    return kept


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=50, help="a crowd")
    parser.add_argument("--minutes", type=float, default=600.0, help="no sample is begun after that")
    parser.add_argument("--json", type=Path, help="results are added to this file")
    parser.add_argument("--page", action="store_true", help="abort by the button of the operator's page")
    parser.add_argument("--half-open", type=int, metavar="N", help="abort by the page while N connections send half of a header")
    parser.add_argument("--crowd", nargs=3, help=argparse.SUPPRESS)
    parser.add_argument("--crowd-page", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    take_signals()
    if options.crowd:
        _crowd_in(Path(options.crowd[0]), int(options.crowd[1]), int(options.crowd[2]))
    if options.crowd_page:
        host, port, number = options.crowd_page
        _half_open(host, int(port), int(number))
    with tempfile.TemporaryDirectory() as name:
        if options.half_open:
            sys.exit(0 if measure_crowded_page(options.samples, options.half_open, Path(name)) else 1)
        kept = options.json or Path(name) / "abort.jsonl"
        take_samples, show = (measure_page, print_page_table) if options.page else (measure, write_table)
        take_samples(options.samples, time.monotonic() + options.minutes * 60.0, kept, Path(name))
        entries = [entry for entry in results_in(kept) if (entry["crowd"] == "page") == options.page]
    sys.exit(0 if entries and show(entries) else 1)


if __name__ == "__main__":
    main()
