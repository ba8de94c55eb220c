"""What the server of the page costs: processor time and memory with four pages open while a loop of 125 or 500 Hz ticks.

    python -m benchmarks.page_server --seconds 60

The ticks come from a ring that this program fills; the pages are four WebSocket clients that read everything. Processor time is that of the
server's process alone, by the kernel. Frames count per page.
"""

import argparse
import contextlib
import json
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Origin

from palpd.recording.ring import Ring
from palpd.tick import ROW

PAGES = 4
PORT = 8797
TICK_S = os.sysconf("SC_CLK_TCK")


def serve_status(path: Path, ring: str) -> None:
    """Answer each request at that socket with the status of a run that goes on, and keep watchers."""
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(path))
    listener.listen(16)
    status = {
        "ok": True,
        "event": "status",
        "state": "running",
        "job": "palpation",
        "ring": ring,
        "active": None,
        "latched": None,
        "tick": 1,
    }
    kept = []
    while True:
        connection, _ = listener.accept()
        request = json.loads(connection.recv(65536))
        connection.sendall(json.dumps(status).encode() + b"\n")
        if request["do"] == "watch":
            kept.append(connection)
        else:
            connection.close()


def fill(ring: Ring, rate_Hz: float, over: threading.Event) -> None:
    """Write ticks at that rate, with as many sensor frames as 1 kHz gives."""
    row = np.zeros(1, ROW)
    row["frames"], row["mode"], row["surface_z_m"] = max(1, round(1000.0 / rate_Hz)), 3, 0.1
    began_s, number = time.monotonic(), 0
    while not over.is_set():
        while number < (time.monotonic() - began_s) * rate_Hz:
            now_s = began_s + number / rate_Hz
            row["index"], row["now_s"], row["robot_t_s"] = number, now_s, now_s - 0.004
            row["frame_t_s"], row["force_N"] = now_s - 0.001, 5.0 + np.sin(now_s)
            row["tcp_pose"][0, 2] = 0.1 - 0.003 * np.sin(now_s)
            ring.write(row)
            number += 1
        time.sleep(0.5 / rate_Hz)


def read_page(headers: dict[str, str], counts: list[int], at: int) -> None:
    """Read everything that a page receives."""
    origin = f"http://127.0.0.1:{PORT}"
    with (
        contextlib.suppress(ConnectionClosed),
        connect(f"ws://127.0.0.1:{PORT}/live", origin=Origin(origin), additional_headers=headers, compression=None) as page,
    ):
        for _ in page:
            counts[at] += 1


def memory_MB(pid: int) -> dict[str, float]:
    """Resident memory of a process: all of it, and what of it is shared with the loop."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    values = {line.split(":")[0]: float(line.split()[1]) / 1024.0 for line in lines if line.startswith(("VmRSS", "RssShmem"))}
    return {"resident": values["VmRSS"], "ring": values["RssShmem"]}


def cpu_s(pid: int) -> float:
    """Processor time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICK_S


def measure(rate_Hz: float, seconds: float) -> None:
    """Print one line for a loop of that rate."""
    with tempfile.TemporaryDirectory() as folder:
        ring = Ring.create(rate_Hz)
        over = threading.Event()
        path, token = Path(folder, "socket"), Path(folder, "token")
        threading.Thread(target=serve_status, args=(path, ring.name), daemon=True).start()
        filler = threading.Thread(target=fill, args=(ring, rate_Hz, over), daemon=True)
        filler.start()
        command = [
            sys.executable,
            "-m",
            "palpd.web",
            "--socket",
            str(path),
            "--runs",
            folder,
            "--token-file",
            str(token),
            "--port",
            str(PORT),
        ]
        environment = {**os.environ, "MALLOC_ARENA_MAX": "2", "OMP_NUM_THREADS": "1"}
        server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment)
        try:
            assert server.stdout is not None
            server.stdout.readline()
            headers, counts = {"Authorization": f"Bearer {token.read_text().strip()}"}, [0] * PAGES
            for at in range(PAGES):
                while True:
                    try:
                        socket.create_connection(("127.0.0.1", PORT), 5.0).close()
                        break
                    except OSError:
                        time.sleep(0.2)
                threading.Thread(target=read_page, args=(headers, counts, at), daemon=True).start()
            time.sleep(5.0)
            before, began, began_s = cpu_s(server.pid), list(counts), time.monotonic()
            time.sleep(seconds)
            took_s = time.monotonic() - began_s
            frames = [(now - then) / took_s for now, then in zip(counts, began, strict=True)]
            used = (cpu_s(server.pid) - before) / took_s
            memory = memory_MB(server.pid)
        finally:
            server.kill()
            server.wait()
            over.set()
            filler.join()
            ring.unlink()
    per_frame_ms = 1e3 * used / max(min(frames), 1e-9)
    print(
        f"{rate_Hz:g} Hz, {PAGES} pages: {min(frames):.1f} to {max(frames):.1f} frames/s a page, {100 * used:.1f} % of a core "
        f"({per_frame_ms:.2f} ms a frame for all pages), {memory['resident']:.0f} MB resident, {memory['ring']:.0f} MB of it the ring",
        flush=True,
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    for rate_Hz in (125.0, 500.0):
        measure(rate_Hz, parser.parse_args().seconds)
