"""How soon `palpd abort` stops the arm, from the start of its process to a target speed of zero in the controller.

`python -m benchmarks.abort [--samples 50] [--minutes 30] [--json FILE]`. The service moves an emulated arm. Meanwhile other clients leave
it alone, hold 200 half-open connections, or ask for its status in 20 tight loops besides. Results are added to FILE; the table is made
of all of FILE. Ends with 1 where the 99th percentile is above the target.
"""

import argparse
import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.emulated_cell import PATIENT, PRESS, EmulatedCell, emulated_cell, until
from palpd.daemon.socket_client import ask
from palpd.errors import PalpdError

TARGET_S = 0.250
HALF_OPEN = 200
LOOPS = 20
CROWDS = {"nobody else": (0, 0), "200 half-open": (HALF_OPEN, 0), "200 half-open, 20 loops": (HALF_OPEN, LOOPS)}
"""Number of half-open connections, and of clients that ask in a tight loop."""
SETTLE_S = 1.0


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
    with subprocess.Popen(command, stdout=subprocess.PIPE) as crowd:
        assert crowd.stdout is not None
        crowd.stdout.readline()
        threading.Thread(target=crowd.stdout.read, daemon=True).start()
        try:
            yield
        finally:
            crowd.kill()


def aborted(cell: EmulatedCell, path: Path, crowd: str) -> dict[str, Any]:
    """Start a plan, let the crowd in, abort, and wait until the arm is at rest.

    Args:
        cell: The cell that the service moves.
        path: Control socket of the service.
        crowd: One of `CROWDS`.

    Returns:
        One entry of the results.
    """
    until(lambda: ask(path, {"do": "status"})["state"] == "disarmed", "the service is disarmed", every_s=0.1)
    cell.wires.ask("restart", s=0.1)
    time.sleep(0.3)
    ask(path, {"do": "arm"}, 60.0)
    ask(path, {"do": "start", "plan": PRESS | {"sites": [{"name": "A"}], "search": {"speed_m_per_s": 0.001, "max_travel_m": 0.03}}})
    until(lambda: ask(path, {"do": "status"}).get("phase") == "search", "the arm moves", every_s=0.1)
    with crowded(path, *CROWDS[crowd]):
        began_s = time.monotonic()
        assert cell.log(began_s - 0.05)[-1].speed_m_per_s > 0.0, "the run ended before the abort"
        done = subprocess.run(
            [sys.executable, "-m", "palpd", "abort", "--socket", str(path)], capture_output=True, text=True, timeout=30.0, check=False
        )
        answered_s = time.monotonic() - began_s
        rest_s = cell.rest_after_s(began_s, settle_s=max(SETTLE_S, answered_s + 0.6))
    return {
        "crowd": crowd,
        "rest_s": rest_s,
        "answered_s": answered_s,
        "code": done.returncode,
        "stderr": done.stderr[-200:],
        "load": os.getloadavg()[0],
    }


def measure(samples: int, end_s: float, kept: Path, folder: Path) -> None:
    """Abort until FILE holds that many samples of each crowd, in turn.

    Args:
        samples: Number of samples a crowd.
        end_s: Host time after which no sample is begun.
        kept: File that takes a line a sample.
        folder: Folder of the service.
    """
    with emulated_cell(folder) as base:
        cell = base.anew(folder, **PATIENT)
        calibrated = cell.palpd("calibrate", "--config", cell.config)
        assert calibrated.returncode == 0, calibrated.stderr
        path = folder / "state" / "palpd.sock"
        with (folder / "log.jsonl").open("wb") as log:
            service = subprocess.Popen([sys.executable, "-m", "palpd", "serve", "--config", str(cell.config)], stderr=log)
        try:
            until(path.exists, "the service listens", every_s=0.1)
            for number in range(samples):
                for crowd in CROWDS:
                    lines = kept.read_text().splitlines() if kept.exists() else []
                    if sum(json.loads(line)["crowd"] == crowd for line in lines) > number:
                        continue
                    if time.monotonic() > end_s:
                        return
                    try:
                        entry = aborted(cell, path, crowd)
                    except (PalpdError, AssertionError) as error:  # the machine stood still, and the guard ended the run before the abort
                        print(f"{crowd}: nothing was measured ({error})", file=sys.stderr, flush=True)
                        continue
                    with kept.open("a") as file:
                        file.write(json.dumps(entry) + "\n")
                    print(f"{crowd}: rest after {entry['rest_s'] * 1e3:.0f} ms, code {entry['code']} {entry['stderr']}", flush=True)
        finally:
            service.send_signal(signal.SIGTERM)
            service.wait(30.0)


def table(entries: Sequence[dict[str, Any]]) -> tuple[list[str], bool]:
    """A markdown table with a row a crowd, and whether the target was kept.

    Args:
        entries: All results.

    Returns:
        The lines, and the verdict.
    """
    lines, kept = ["| other clients | n | rest p50, ms | p99 | max | failed |", "|---|---|---|---|---|---|"], True
    for crowd in CROWDS:
        rests_ms = [entry["rest_s"] * 1e3 for entry in entries if entry["crowd"] == crowd]
        if not rests_ms:
            continue
        failed = sum(entry["code"] != 0 for entry in entries if entry["crowd"] == crowd)
        p50_ms, p99_ms = np.percentile(rests_ms, (50, 99))
        lines.append(f"| {crowd} | {len(rests_ms)} | {p50_ms:.0f} | {p99_ms:.0f} | {max(rests_ms):.0f} | {failed} |")
        kept = kept and not failed and p99_ms <= TARGET_S * 1e3
    loads = [entry["load"] for entry in entries]
    return [*lines, "", f"{os.cpu_count()} cores, load {min(loads):.1f} to {max(loads):.1f} (median {np.median(loads):.1f})."], kept


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=50, help="a crowd")
    parser.add_argument("--minutes", type=float, default=600.0, help="no sample is begun after that")
    parser.add_argument("--json", type=Path, help="results are added to this file")
    parser.add_argument("--crowd", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.crowd:
        _crowd_in(Path(options.crowd[0]), int(options.crowd[1]), int(options.crowd[2]))
    with tempfile.TemporaryDirectory() as name:
        kept = options.json or Path(name) / "abort.jsonl"
        measure(options.samples, time.monotonic() + options.minutes * 60.0, kept, Path(name))
        entries = [json.loads(line) for line in kept.read_text().splitlines()] if kept.exists() else []
    lines, good = table(entries) if entries else (["nothing was measured"], False)
    print("\n".join(lines))
    sys.exit(0 if good else 1)


if __name__ == "__main__":
    main()
