"""What the operator's page costs, and what the loop notices of it: also where its server is killed, stands still or is flooded.

`python -m benchmarks.web [--seconds 30] [--rounds 3] [--pages 4]` prints two markdown tables. The service holds a long press on an
emulated cell. Pages are tabs of a headless Chromium. A round is one run of each condition, in turn, so that a busy hour hits all of them.
Ends with 1 where a run failed, or a median wake-up p99 is above `MOST_RATIO` of that without a page. A flood of another server shows how
much of a flood is this computer's: both come from it, and take its processors.
"""

import argparse
import json
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import numpy as np

from benchmarks.abort import served
from benchmarks.operator_page import COUNT_FRAMES, PageServer, frame_counts, opened_pages, page_server
from palpd.daemon.socket_client import ask
from palpd.recording.reader import Recording
from palpd.testing.emulated_cell import ABOVE_M, PRESS, EmulatedCell
from palpd.testing.processes import free_port, processor_s, resident_MB, until
from palpd.tick import Phase

ALONE, OTHER, FLOODED = "no page", "another server flooded, no page", "server flooded"
CONDITIONS = (ALONE, "pages open", "server killed", "server hung", OTHER, FLOODED)
MOST_RATIO = 1.1
"""Largest median ratio of wake-up p99 with a condition to that without a page."""
LEAST_WAKEUP_US = 100.0
"""Wake-ups below that count as that: a ratio of 30 to 20 µs says nothing."""
HALF_OPEN = 100
FLOODERS = 8


class RunFigures(NamedTuple):
    """What a run's recording says of its loop."""

    ticks: int
    missed: int
    p50_us: float
    p99_us: float
    verdict: str


class PageFigures(NamedTuple):
    """What a server and its pages did in a run."""

    heard_per_s: float
    drawn_per_s: float
    processor_share: float
    resident_MB: float


# --- the flood, in a process of its own -------------------------------------------------------------------------------------------


def flood(url: str) -> None:
    """Hold half-open connections, and ask in tight loops, until this process is killed."""
    parts = urlsplit(url)
    assert parts.hostname is not None
    assert parts.port is not None
    held = []
    for _ in range(HALF_OPEN):
        with suppress(OSError):
            held.append(socket.create_connection((parts.hostname, parts.port), 5.0))
            held[-1].sendall(b"GET / HTTP/1.1\r\n")
    for _ in range(FLOODERS):
        threading.Thread(target=_ask_in_a_loop, args=(url,), daemon=True).start()
    print("floods", flush=True)
    threading.Event().wait()


def _ask_in_a_loop(url: str) -> None:
    while True:
        with suppress(OSError, urllib.error.URLError):
            urllib.request.urlopen(url, timeout=5.0).read()


@contextmanager
def flooded(url: str) -> Iterator[None]:
    """Flood a server within the context."""
    with subprocess.Popen(
        [sys.executable, "-m", "benchmarks.web", "--flood", url], stdout=subprocess.PIPE, start_new_session=True
    ) as crowd:
        try:
            assert crowd.stdout is not None
            crowd.stdout.readline()
            yield
        finally:
            crowd.kill()


# --- one run ----------------------------------------------------------------------------------------------------------------------


def begin_hold(cell: EmulatedCell, path: Path, seconds: float) -> None:
    """Arm, start one press that is held that long, and wait until it is held."""
    until(lambda: ask(path, {"do": "status"})["state"] == "disarmed", "the service is disarmed", every_s=0.1)
    cell.wires.ask("restart", s=0.1)
    time.sleep(0.3)
    cell.wall(ABOVE_M, 1000.0)
    ask(path, {"do": "arm"}, 60.0)
    ask(path, {"do": "start", "plan": PRESS | {"mode": "static", "depths_m": [0.003], "hold_s": seconds}})
    until(lambda: ask(path, {"do": "status"}).get("phase") == Phase.HOLD.name.lower(), "the press is held", every_s=0.1)


def finished_run(path: Path) -> RunFigures:
    """Wait for the end of the run, and read its recording: the ticks of the hold."""
    until(lambda: ask(path, {"do": "status"})["state"] == "disarmed", "the run is over", timeout_s=600.0, every_s=0.2)
    last = ask(path, {"do": "status"})["last"]
    rows = Recording.load(Path(str(last["recording"]))).rows
    rows = rows[rows["phase"] == Phase.HOLD]
    late_us = np.maximum((rows["now_s"] - rows["planned_s"]) * 1e6, 0.0)
    p50_us, p99_us = np.percentile(late_us, [50, 99])
    return RunFigures(len(rows), int(rows["missed"].sum()), float(p50_us), float(p99_us), f"{last['verdict']} {last['reason']}".strip())


def with_pages(cell: EmulatedCell, path: Path, number: int, seconds: float) -> tuple[RunFigures, PageFigures]:
    """A run with open pages, whose server is watched for most of the hold."""
    with page_server(cell.config) as server, opened_pages(server.url, number) as pages:
        for page in pages:
            page.evaluate(COUNT_FRAMES)
        begin_hold(cell, path, seconds)
        began_s, spent_s, before = time.monotonic(), processor_s(server.process.pid), frame_counts(pages)
        time.sleep(0.8 * seconds)
        watched_s = time.monotonic() - began_s
        after = frame_counts(pages)
        share = (processor_s(server.process.pid) - spent_s) / watched_s
        rates = {kind: min(b[kind] - a[kind] for a, b in zip(before, after, strict=True)) / watched_s for kind in ("heard", "drawn")}
        return finished_run(path), PageFigures(rates["heard"], rates["drawn"], share, resident_MB(server.process.pid))


def with_trouble(cell: EmulatedCell, path: Path, number: int, seconds: float, condition: str) -> RunFigures:
    """A run with open pages whose server is killed, stopped or flooded as soon as the press is held."""
    with page_server(cell.config) as server, opened_pages(server.url, number):
        begin_hold(cell, path, seconds)
        if condition == FLOODED:
            with flooded(_entrance(server)):
                return finished_run(path)
        server.process.send_signal(signal.SIGKILL if condition == "server killed" else signal.SIGSTOP)
        return finished_run(path)


def with_another_server_flooded(cell: EmulatedCell, path: Path, seconds: float) -> RunFigures:
    """A run without a page, beside a flood of Python's own file server in an empty folder."""
    with tempfile.TemporaryDirectory() as empty:
        port = free_port()
        command = [sys.executable, "-m", "http.server", "--bind", "127.0.0.1", "--directory", empty, str(port)]
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as server:
            try:
                begin_hold(cell, path, seconds)
                with flooded(f"http://127.0.0.1:{port}/"):
                    return finished_run(path)
            finally:
                server.kill()


def _entrance(server: PageServer) -> str:
    """The address of the page without its token."""
    parts = urlsplit(server.url)
    return f"http://{parts.netloc}/"


# --- the tables -------------------------------------------------------------------------------------------------------------------


def measure(rounds: int, seconds: float, pages: int, folder: Path) -> tuple[dict[str, list[RunFigures]], list[PageFigures]]:
    """Run each condition once a round. Returns the figures by condition, and those of the pages."""
    runs: dict[str, list[RunFigures]] = {condition: [] for condition in CONDITIONS}
    costs = []
    with served(folder) as (cell, path):
        for _ in range(rounds):
            for condition in CONDITIONS:
                if condition == ALONE:
                    begin_hold(cell, path, seconds)
                    figures = finished_run(path)
                elif condition == "pages open":
                    figures, cost = with_pages(cell, path, pages, seconds)
                    costs.append(cost)
                elif condition == OTHER:
                    figures = with_another_server_flooded(cell, path, seconds)
                else:
                    figures = with_trouble(cell, path, pages, seconds, condition)
                print(condition, json.dumps(figures._asdict()), file=sys.stderr, flush=True)
                runs[condition].append(figures)
    return runs, costs


def print_tables(runs: dict[str, list[RunFigures]], costs: Sequence[PageFigures], pages: int) -> bool:
    """Print both tables, and say whether the loop was left alone.

    Args:
        runs: Figures by condition.
        costs: Figures of the pages.
        pages: Number of pages.

    Returns:
        The verdict.
    """
    rows: list[tuple[str, Any, str]] = [
        ("frames that the slowest page hears, a second", [cost.heard_per_s for cost in costs], "{:.1f}"),
        ("frames that it draws, a second", [cost.drawn_per_s for cost in costs], "{:.1f}"),
        ("processor share of the server", [cost.processor_share * 100.0 for cost in costs], "{:.1f} %"),
        ("resident memory of the server", [cost.resident_MB for cost in costs], "{:.0f} MB"),
    ]
    print(f"| with {pages} pages open, median of {len(costs)} runs | measured |")
    print("|---|---|")
    for what, values, form in rows:
        print(f"| {what} | {form.format(np.median(values))} |")
    print("\n| the loop, meanwhile | runs | ticks | missed | wake-up p50, p99, µs | ratio of p99 to no page | runs that ended well |")
    print("|---|---|---|---|---|---|---|")
    alone_us = max(LEAST_WAKEUP_US, float(np.median([run.p99_us for run in runs[ALONE]])))
    kept = True
    for condition, of_condition in runs.items():
        p50_us, p99_us = (float(np.median([getattr(run, name) for run in of_condition])) for name in ("p50_us", "p99_us"))
        ratio = max(LEAST_WAKEUP_US, p99_us) / alone_us
        well = sum(run.verdict == "done" for run in of_condition)
        ticks, missed = sum(run.ticks for run in of_condition), sum(run.missed for run in of_condition)
        print(f"| {condition} | {len(of_condition)} | {ticks} | {missed} | {p50_us:.0f}, {p99_us:.0f} | {ratio:.2f} | {well} |")
        kept = kept and (ratio <= MOST_RATIO or condition == OTHER) and well == len(of_condition)
    return kept


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=30.0, help="of each hold")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--pages", type=int, default=4)
    parser.add_argument("--flood", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.flood:
        flood(options.flood)
    with tempfile.TemporaryDirectory() as name:
        runs, costs = measure(options.rounds, options.seconds, options.pages, Path(name))
    sys.exit(0 if print_tables(runs, costs, options.pages) else 1)


if __name__ == "__main__":
    main()
