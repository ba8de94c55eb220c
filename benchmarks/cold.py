"""Runs from cold: before each, the kernel's caches are dropped, as after boot or a fresh installation. None may be ended by its own start.

The emulated cell runs throughout, as a robot would. `python -m benchmarks.cold [--model ur5] [--runs 10]` prints a table; needs root.
Reads from the disk while the arm may move are counted as major page faults of the motion process, from its first tick to its last. Code
that other processes have mapped stays in memory. So end whatever else uses the same Python: else the runs are not as cold as after boot.
"""

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from palpd.errors import PalpdError
from palpd.recording.reader import Recording
from palpd.testing.emulated_cell import PRESS, Daemon, EmulatedCell, emulated_cell
from palpd.testing.processes import until

DROP = Path("/proc/sys/vm/drop_caches")
FIRST_S = 5.0
"""Length of the beginning of a run that the table looks at: tare, search and the first contact."""
MAJOR_FAULTS = 9
"""Place of the number of major faults in /proc/PID/stat, counted behind the name of the process."""


class ColdRun(NamedTuple):
    """How one run from cold went. Faults are those of the motion process between its first and its last tick."""

    code: int
    reason: str
    first_tick_s: float
    major_faults: int
    late_ms_max: float
    work_ms_max: float
    missed: int


def major_faults(pid: int) -> int:
    """Number of reads from the disk that a process has waited for; 0 where it is gone."""
    try:
        return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[MAJOR_FAULTS])
    except OSError:
        return 0


def cold_run(cell: EmulatedCell, drop: bool) -> ColdRun:
    """One palpation with the default limits, begun with empty caches.

    Args:
        cell: The emulated cell, with a folder of its own.
        drop: Whether the caches are dropped.

    Returns:
        How it went.
    """
    if drop:
        os.sync()
        DROP.write_text("3")
    began_s = time.monotonic()
    daemon = cell.run(PRESS)
    until(lambda: daemon.process.poll() is not None or _ticks(daemon) > 0, "a first tick, or an end")
    first_tick_s, before, after = time.monotonic() - began_s, 0, 0
    if daemon.process.poll() is None:
        before = after = major_faults(daemon.motion_pid)
        while daemon.process.poll() is None:
            after = max(after, major_faults(daemon.motion_pid))
            time.sleep(0.02)
    code, report = daemon.wait(), daemon.report
    late_ms = work_ms = np.zeros(1)
    missed = 0
    if report.get("recording"):
        rows = Recording.load(Path(report["recording"])).rows
        rows = rows[rows["now_s"] < rows["now_s"][0] + FIRST_S]
        late_ms, work_ms, missed = (rows["now_s"] - rows["planned_s"]) * 1e3, rows["work_us"] * 1e-3, int(rows["missed"].sum())
    return ColdRun(code, report.get("reason", ""), first_tick_s, after - before, float(late_ms.max()), float(work_ms.max()), missed)


def _ticks(daemon: Daemon) -> int:
    try:
        return daemon.ring.published
    except (AssertionError, OSError, PalpdError):  # it has no ring yet, or only a part of one
        return 0


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", default="ur5", choices=("ur5", "ur5e"))
    parser.add_argument("--runs", type=int, default=10)
    options = parser.parse_args()
    drop = os.access(DROP, os.W_OK)
    if not drop:
        print("The caches may not be dropped here (needs root): the runs are warm.\n")
    print("| run | end | first tick after | reads from the disk while it ran | latest tick | longest tick | missed |")
    print("|---|---|---|---|---|---|---|")
    done = 0
    with tempfile.TemporaryDirectory() as name, emulated_cell(Path(name), options.model) as base:
        for number in range(options.runs):
            folder = Path(name) / f"run-{number}"
            folder.mkdir()
            run = cold_run(base.anew(folder), drop)
            done += run.code == 0
            end = "done" if run.code == 0 else f"exit {run.code}: {run.reason}"
            print(
                f"| {number + 1} | {end} | {run.first_tick_s:.1f} s | {run.major_faults} | {run.late_ms_max:.1f} ms "
                f"| {run.work_ms_max:.1f} ms | {run.missed} |",
                flush=True,
            )
    print(f"\n{done} of {options.runs} ended as they should.")
    sys.exit(done < options.runs)


if __name__ == "__main__":
    main()
