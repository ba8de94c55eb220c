"""Runs of ten minutes by the whole daemon at 500 Hz: do they all end "done", with the limits that config.yaml sets?

Each run palpates an emulated cell, with the sensor at 1 kHz and a network on every sample; only the free motion that trains the network is
recorded with patient limits. The witness of the daemon notes when this
computer stood still. A run that ended otherwise while it did is listed and repeated.

`python -m benchmarks.endurance [--runs 10] [--minutes 10] [--parallel 1] [--kept FILE]` prints a markdown table. FILE keeps each run, and a
later call goes on after the last one. Ends with 1 where a run ended otherwise and the computer did not stand still.
"""

import argparse
import json
import os
import sys
import tempfile
import threading
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from benchmarks.daemon import CYCLE_US, Cyclictest, late_share, learn
from palpd.analysis.stalls import stall_figures
from palpd.recording.reader import Recording
from palpd.testing.emulated_cell import PATIENT, PRESS, EmulatedCell, emulated_cell
from palpd.testing.processes import side_by_side

MODEL = "ur5e"
STIFFNESS_N_PER_M = 1000.0
DEPTHS_M = [0.004, 0.006, 0.008]
ROUND_S = 9.0
"""Shortest time of a press to each of these depths."""
STOOD_STILL_MS = 20.0
"""From here on the witness notes it."""


@dataclass(frozen=True)
class LongRun:
    """How one run went. Shares are of all ticks; `late` counts those more than 1 ms late or missed."""

    code: int
    reason: str
    minutes: float
    ticks: int
    missed: int
    late: float
    cyclictest_late: float | None
    work_us_p50: float
    work_us_p99: float
    wakeup_us_p99: float
    stalls: int
    longest_stall_ms: float
    load: float

    @property
    def repeated(self) -> bool:
        """Whether it ended otherwise than it should while the computer stood still."""
        return self.code != 0 and self.longest_stall_ms > STOOD_STILL_MS


def long_run(cell: EmulatedCell, minutes: float) -> LongRun:
    """Palpate for that long.

    Args:
        cell: An emulated cell with a network, in a folder of its own.
        minutes: Least length of the run.

    Returns:
        How it went.
    """
    cell.wall(0.01, STIFFNESS_N_PER_M)
    daemon = cell.run(PRESS | {"depths_m": DEPTHS_M, "repeats": int(np.ceil(minutes * 60.0 / ROUND_S))})
    beside = Cyclictest(CYCLE_US[MODEL])
    code = daemon.wait(timeout_s=minutes * 180.0 + 120.0)
    other = beside.end()
    report = daemon.report
    path = Path(report["recording"])
    recording = Recording.load(path)
    rows = recording.rows
    stalls = stall_figures(rows, recording.footer.get("stalls", []))
    path.unlink()
    work_us = rows["work_us"]
    return LongRun(
        code,
        report.get("reason", ""),
        float(rows["now_s"][-1] - rows["now_s"][0]) / 60.0,
        len(rows),
        int(rows["missed"].sum()),
        late_share(rows),
        other["late"] if other else None,
        float(np.percentile(work_us, 50)),
        float(np.percentile(work_us, 99)),
        float(np.percentile((rows["now_s"] - rows["planned_s"]) * 1e6, 99)),
        stalls["computer"],
        stalls["computer_longest_s"] * 1e3,
        os.getloadavg()[0],
    )


def measure(runs: int, minutes: float, parallel: int, kept: list[LongRun], file: Path | None) -> None:
    """Run until that many ended as they should, or otherwise on a computer that did not stand still; `kept` grows by each."""
    lock = threading.Lock()
    under_way = 0

    def another() -> bool:
        nonlocal under_way
        with lock:
            missing = sum(not run.repeated for run in kept) + under_way < runs and len(kept) < 2 * runs
            under_way += missing
        return missing

    def work(folder: Path) -> None:
        nonlocal under_way
        with emulated_cell(folder, MODEL) as base:
            patient = base.anew(folder, **PATIENT)
            learn(patient)
            while another():
                run = long_run(base.anew(folder, STIFFNESS_N_PER_M, model=patient.blocks["model"]), minutes)
                with lock:
                    under_way -= 1
                    kept.append(run)
                    if file is not None:
                        with file.open("a") as lines:
                            lines.write(json.dumps(asdict(run)) + "\n")
                print(f"{run}", file=sys.stderr, flush=True)

    with tempfile.TemporaryDirectory() as name:
        side_by_side(work, Path(name), parallel)


def table(runs: list[LongRun]) -> str:
    """Markdown."""
    lines = [
        "| run | end | minutes | ticks | missed | more than 1 ms late or missed; cyclictest's | work p50, p99, µs | wake-up p99, µs "
        "| this computer stood still | load |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for number, run in enumerate(runs, 1):
        end = "done" if run.code == 0 else f"exit {run.code}: {run.reason}{' (repeated)' if run.repeated else ''}"
        other = f"{run.cyclictest_late:.3%}" if run.cyclictest_late is not None else "not installed"
        still = f"{run.stalls} times, at most {run.longest_stall_ms:.0f} ms" if run.stalls else "never"
        lines.append(
            f"| {number} | {end} | {run.minutes:.1f} | {run.ticks} | {run.missed} | {run.late:.3%}; {other} "
            f"| {run.work_us_p50:.0f}, {run.work_us_p99:.0f} | {run.wakeup_us_p99:.0f} | {still} | {run.load:.1f} |"
        )
    counted = [run for run in runs if not run.repeated]
    return "\n".join(lines) + f"\n\n{sum(run.code == 0 for run in counted)} of {len(counted)} ended as they should."


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--parallel", type=int, default=1, help="emulated cells at a time")
    parser.add_argument("--kept", type=Path, help="file that keeps the runs")
    options = parser.parse_args()
    kept = [LongRun(**json.loads(line)) for line in options.kept.read_text().splitlines()] if options.kept and options.kept.exists() else []
    measure(options.runs, options.minutes, options.parallel, kept, options.kept)
    print(table(kept))
    sys.exit(any(run.code and not run.repeated for run in kept) or sum(run.code == 0 for run in kept) < options.runs)


if __name__ == "__main__":
    main()
