"""Hours of `palpd serve` pressing without a pause on emulated wires: memory, ticks, rate, open files, shared memory, minute by minute.

`python benchmarks/soak.py [--minutes 120] [--model ur5] [--json FILE]` prints a markdown table; TERM ends it early, with the table of what
was. A run that the guard ends is counted, its latch cleared, and the next one started. The guard tolerates silence for 0.2 s instead of
0.05 s, so that hours on a machine shared with others measure the daemon's endurance and not the machine's pauses.
"""

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from palpd.daemon.socket_client import ARM_PATIENCE_S, ask
from palpd.errors import PalpdError
from palpd.recording.ring import Ring
from palpd.testing.emulated_cell import PATIENT, PRESS, EmulatedCell, emulated_cell, ring_of
from palpd.testing.processes import command_of, family, resident_MB, take_signals, until

PLAN = PRESS | {"depths_m": [0.004, 0.006, 0.008], "repeats": 100}
"""Some quarter of an hour."""
EVERY_S = 60.0
NAMES = {"spawn_main": "motion", "palpd.recording.recorder": "recorder", "resource_tracker": "resource tracker", "palpd serve": "main"}


@dataclass
class Minute:
    """What one look found. Rates are of the loop's own ticks against CLOCK_MONOTONIC, over the time since the run's first look."""

    minute: float
    run: int
    resident_MB: dict[str, float]
    open_files: dict[str, int]
    shared_memory: int
    tick: int
    rows: int
    drift_ppm: float | None
    wakeup_us_p50: float
    wakeup_us_p99: float
    load: float


@dataclass
class Soak:
    """One service under way and what was seen of it."""

    cell: EmulatedCell
    service: subprocess.Popen[bytes]
    minutes: list[Minute] = field(default_factory=list)
    ended: list[str] = field(default_factory=list)
    crashes: int = 0
    missed: int = 0
    ticks: int = 0
    presses: int = 0
    started_s: float = 0.0

    @property
    def socket(self) -> Path:
        """Of the service."""
        return self.cell.folder / "state" / "palpd.sock"

    def status(self) -> dict[str, Any]:
        """What it says of itself."""
        return ask(self.socket, {"do": "status"})

    def begin(self) -> None:
        """Arm and start, whatever ended the run before."""
        until(lambda: self.status()["cell"] is not None or self.status().get("last"), "the devices have been checked")
        ask(self.socket, {"do": "clear"})
        self.cell.wires.ask("replug")  # a trip leaves nothing behind in the sensor
        ask(self.socket, {"do": "arm"}, ARM_PATIENCE_S)
        self.started_s = time.monotonic()
        ask(self.socket, {"do": "start", "plan": PLAN})

    def newest(self, ring: Ring) -> Any:
        """The newest row, if the run under way writes rows: before its first tick and after its last there is none."""
        rows = ring.read(max(0, ring.published - 1))[0]
        since_s = max(self.started_s, time.monotonic() - 1.0)
        return rows[-1] if len(rows) and rows[-1]["now_s"] > since_s else None

    def look(self, minute: float, ring: Ring, began: tuple[float, int, int]) -> None:
        """Add a line. `began`: time, tick and published rows at the run's first look."""
        members = {pid: command_of(pid) for pid in family(self.service.pid)}
        named = {pid: next((name for part, name in NAMES.items() if part in command), "other") for pid, command in members.items()}
        rows, _, _ = ring.read(max(0, ring.published - ring.capacity // 2))
        row = rows[-1]
        late_us = (rows["now_s"] - rows["planned_s"]) * 1e6
        span_s, ticks = float(row["now_s"]) - began[0], int(row["index"]) - began[1]
        rate_Hz = 1.0 / self.period_s
        self.minutes.append(
            Minute(
                minute=minute,
                run=len(self.ended),
                resident_MB={name: resident_MB(pid) for pid, name in named.items()},
                open_files={name: len(list(Path(f"/proc/{pid}/fd").iterdir())) for pid, name in named.items()},
                shared_memory=len(list(Path("/dev/shm").iterdir())),
                tick=int(row["index"]),
                rows=ring.published - began[2],
                drift_ppm=(ticks / span_s / rate_Hz - 1.0) * 1e6 if span_s > EVERY_S / 2 else None,
                wakeup_us_p50=float(np.percentile(late_us, 50)),
                wakeup_us_p99=float(np.percentile(late_us, 99)),
                load=os.getloadavg()[0],
            )
        )
        print(json.dumps(asdict(self.minutes[-1])), file=sys.stderr, flush=True)

    @property
    def period_s(self) -> float:
        """One tick."""
        return 0.002 if self.cell.model == "ur5e" else 0.008

    def go(self, seconds: float, stopping: list[int]) -> None:
        """Run after run until the time is over."""
        end_s, begun_s = time.monotonic() + seconds, time.monotonic()
        while time.monotonic() < end_s and not stopping:
            self.begin()
            ring = ring_of(self.service.pid)
            first = until(lambda ring=ring: self.newest(ring), "the first tick")  # type: ignore[misc]
            began = (float(first["now_s"]), int(first["index"]), ring.published)
            _, first_index, first_rows = began
            looked_s, last_index, last_rows, repeat = time.monotonic(), first_index, first_rows, -1
            while (status := self.status())["state"] == "running":
                if time.monotonic() > end_s or stopping:
                    ask(self.socket, {"do": "abort"})
                newest = self.newest(ring)
                if newest is not None:
                    last_index, last_rows = int(newest["index"]), ring.published
                    self.presses += int(newest["repeat"]) not in (repeat, -1)
                    repeat = int(newest["repeat"]) if newest["repeat"] >= 0 else repeat
                    if time.monotonic() - looked_s >= EVERY_S:
                        looked_s += EVERY_S
                        with contextlib.suppress(OSError):  # a process that ends while it is looked at
                            self.look((time.monotonic() - begun_s) / 60, ring, began)
                time.sleep(0.5)
            ticks, rows = last_index - first_index, last_rows - first_rows
            self.ticks += ticks
            self.missed += max(0, ticks - rows)
            ring.close()
            last = status["last"]
            reason = last["reason"] or last["verdict"]
            self.crashes += "ended by signal" in reason or "failed (" in reason
            self.ended.append(reason)
            print(json.dumps({"ended": reason, "ticks": ticks, "missed": ticks - rows}), file=sys.stderr, flush=True)
            if last["recording"]:
                Path(last["recording"]).unlink(missing_ok=True)  # a quarter of a gigabyte each


def flatness(minutes: list[Minute]) -> list[str]:
    """Memory by process: at the beginning (after the first two looks, when caches are warm) and at the end, and what lies between."""
    lines = []
    for name in sorted({name for minute in minutes for name in minute.resident_MB}):
        sizes = np.array([minute.resident_MB[name] for minute in minutes if name in minute.resident_MB][2:])
        if len(sizes) > 1:
            third = max(1, len(sizes) // 3)
            change = float(sizes[-third:].mean() / sizes[:third].mean() - 1)
            lines.append(f"| – {name} | {sizes[:third].mean():.1f} → {sizes[-third:].mean():.1f} MB, {change:+.2%} | 2 % |")
    return lines


def table(soak: Soak, seconds: float) -> str:
    """Markdown."""
    minutes = soak.minutes
    total = np.array([sum(minute.resident_MB.values()) for minute in minutes][2:])
    third = max(1, len(total) // 3)
    longest = max(((m.tick, abs(m.drift_ppm)) for m in minutes if m.drift_ppm is not None), default=(0, np.nan))[1]
    drift = [abs(minute.drift_ppm) for minute in minutes if minute.drift_ppm is not None]
    load = float(np.mean([minute.load for minute in minutes]))
    files = [sum(minute.open_files.values()) for minute in minutes]
    ended = sorted({(soak.ended.count(reason), reason) for reason in soak.ended}, reverse=True)
    return "\n".join(
        [
            f"| `palpd serve`, {soak.cell.model}, {seconds / 60:.0f} minutes, load {load:.1f} | measured | target |",
            "|---|---|---|",
            f"| presses, at least | {soak.presses} | |",
            f"| crashes | {soak.crashes} | 0 |",
            f"| ticks; missed | {soak.ticks}; {soak.missed} ({soak.missed / max(1, soak.ticks):.4%}) | |",
            f"| memory of all processes, first and last third | {total[:third].mean():.1f} → {total[-third:].mean():.1f} MB, "
            f"{total[-third:].mean() / total[:third].mean() - 1:+.2%} | 2 % |",
            *flatness(minutes),
            f"| rate against CLOCK_MONOTONIC, at worst, over the longest run | {max(drift):.1f}, {longest:.2f} ppm | 0 within a tick |",
            f"| open files, all processes, least and most | {min(files)}, {max(files)} | |",
            f"| names in /dev/shm, least and most | {min(m.shared_memory for m in minutes)}, {max(m.shared_memory for m in minutes)} | |",
            f"| wake-up, median of p50 and of p99 | {np.median([m.wakeup_us_p50 for m in minutes]):.0f}, "
            f"{np.median([m.wakeup_us_p99 for m in minutes]):.0f} µs | |",
            *(f"| runs that ended: {reason} | {count} | |" for count, reason in ended),
        ]
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=120.0)
    parser.add_argument("--model", default="ur5", choices=("ur5", "ur5e"))
    parser.add_argument("--json", type=Path, help="every minute's figures")
    options = parser.parse_args()
    stopping: list[int] = []
    take_signals()
    signal.signal(signal.SIGTERM, lambda number, _: stopping.append(number))
    with tempfile.TemporaryDirectory() as name, emulated_cell(Path(name), options.model) as base:
        folder = Path(name)
        cell = base.anew(folder, 1000.0, **PATIENT)
        free, network = folder / "free.mcap", folder / "inertial.onnx"
        for step in (["calibrate"], ["free-motion", "--out", free], ["train", free, "--out", network]):
            done = cell.palpd(*step, "--config", cell.config)
            assert done.returncode == 0, done.stderr
        cell.blocks["model"] = {"path": str(network)}
        cell.wall(0.01, 1000.0)
        stderr_file = folder / "stderr.txt"
        command = [sys.executable, "-m", "palpd", "serve", "--config", str(cell.config)]
        with stderr_file.open("wb") as stderr:
            service = subprocess.Popen(command, stdout=stderr, stderr=stderr, start_new_session=True)
        soak, began_s = Soak(cell, service), time.monotonic()
        try:
            until(soak.socket.exists, "the service listens")
            soak.go(options.minutes * 60, stopping)
        except (PalpdError, AssertionError, OSError) as error:
            soak.crashes += service.poll() is not None
            soak.ended.append(f"{type(error).__name__}: {error}; the service said: {stderr_file.read_text()[-500:]}")
            raise
        finally:
            seconds = time.monotonic() - began_s
            service.terminate()
            service.wait(20.0)
            if options.json:
                figures = {"seconds": seconds, "ended": soak.ended, "minutes": [asdict(minute) for minute in soak.minutes]}
                options.json.write_text(json.dumps(figures, indent=1))
            if len(soak.minutes) > 3:
                print(table(soak, seconds), flush=True)
    sys.exit(1 if soak.crashes else 0)


if __name__ == "__main__":
    main()
