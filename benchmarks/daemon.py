"""The daemon at work at 500 Hz with a 1 kHz sensor and the network on every sample.

It measures tick work, wake-ups against cyclictest in the same run, memory, recording and replay.

`python benchmarks/daemon.py [--model ur5e] [--presses 6] [--runs 3]` prints a markdown table. Of several runs
it gives the median, with the lowest and the highest: on a shared machine one run says little.
"""

import argparse
import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from palpd.daemon.replay import replay
from palpd.recording.reader import Recording, Rows
from palpd.testing.emulated_cell import PRESS, Daemon, EmulatedCell, emulated_cell
from palpd.testing.processes import command_of, family, resident_MB

LATE_US = 1000.0
CYCLE_US = {"ur5": 8000, "ur5e": 2000}


class Cyclictest:
    """cyclictest at the loop's own rate, beside the daemon; nothing where it is not installed or not permitted.

    `--laptop`: it leaves it to whom it is compared with whether processors may sleep; else it forbids it for both.
    """

    def __init__(self, interval_us: int) -> None:
        self._process: subprocess.Popen[str] | None = None
        if shutil.which("cyclictest"):
            command = ["cyclictest", "--quiet", "--laptop", "--mlockall", "--priority=60", f"--interval={interval_us}", "--histogram=20000"]
            self._process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)

    def end(self) -> dict[str, float] | None:
        """p50, p99 in µs and the share later than a millisecond."""
        if self._process is None:
            return None
        self._process.send_signal(2)
        text, _ = self._process.communicate(timeout=10)
        counts = np.array([(int(us), int(n)) for us, n in re.findall(r"^(\d{6}) (\d{6,})$", text, re.M)])
        overflow = int(match.group(1)) if (match := re.search(r"Histogram Overflows: 0*(\d+)", text)) else 0
        if not len(counts) or not counts[:, 1].sum():
            return None
        total = int(counts[:, 1].sum()) + overflow
        share = np.cumsum(counts[:, 1]) / total
        late = int(counts[counts[:, 0] > LATE_US, 1].sum()) + overflow
        p50, p99 = (float(counts[np.searchsorted(share, q), 0]) if share[-1] >= q else 20000.0 for q in (0.5, 0.99))
        return {"p50": p50, "p99": p99, "late": late / total}


def memory_MB(daemon: Daemon) -> dict[str, float]:
    """Resident memory of each process of the daemon, by what it is."""
    names = {
        "spawn_main": "motion",
        "palpd.recording.recorder": "recorder",
        "resource_tracker": "resource tracker",
        "witness.py": "witness",
        "palpd run": "main",
    }
    sizes_MB: dict[str, float] = {}
    for pid in family(daemon.process.pid):
        command = command_of(pid)
        name = next((name for part, name in names.items() if part in command), command[:40])
        sizes_MB[name] = resident_MB(pid)
    return sizes_MB


def measure(model: str, presses: int, folder: Path) -> dict[str, Any]:
    """Learn a model from free motion, palpate with it, and take the figures of that run."""
    with emulated_cell(folder, model) as base:
        cell = base.anew(folder, safety={"contact_limit_N": 16.0})
        learn(cell)
        cell.wall(0.01, 1000.0)
        daemon = cell.run(PRESS | {"repeats": presses})
        cell.until_contact(daemon, 1.0)
        beside = Cyclictest(CYCLE_US[model])
        memory: dict[str, float] = {}
        while daemon.process.poll() is None:
            try:
                now = memory_MB(daemon)
            except (OSError, AttributeError):
                break
            memory = now if sum(now.values()) > sum(memory.values()) else memory
            time.sleep(0.5)
        code = daemon.wait()
        assert code == 0, daemon.stderr
        other = beside.end()
    path = Path(daemon.report["recording"])
    recording = Recording.load(path)
    duration_s = float(recording.rows["now_s"][-1] - recording.rows["now_s"][0])
    began_s = time.process_time()
    again = replay(recording)
    replayed_s = time.process_time() - began_s
    return {
        **daemon.report["loop"],
        "late": late_share(recording.rows),
        "cyclictest": other,
        "memory": memory,
        "MB_per_min": path.stat().st_size / 1e6 / duration_s * 60,
        "replay": again["realtime_factor"],
        "replay_alone": duration_s / replayed_s,
        "identical": again["decisions_identical"],
    }


def late_share(rows: Rows) -> float:
    """Share of the ticks of a recording that came more than 1 ms late or were missed."""
    missed, late = int(rows["missed"].sum()), int(((rows["now_s"] - rows["planned_s"]) * 1e6 > LATE_US).sum())
    return (late + missed) / (len(rows) + missed)


def learn(cell: EmulatedCell) -> None:
    """Train an inertial network on free motion of this cell, and configure it for the runs that follow."""
    free, network = cell.folder / "free.mcap", cell.folder / "inertial.onnx"
    _done(cell, "free-motion", "--config", cell.config, "--take-reference", "--out", free)
    _done(cell, "train", free, "--out", network, "--config", cell.config)
    cell.blocks["model"] = {"path": str(network)}


def _done(cell: EmulatedCell, *arguments: str | Path) -> None:
    done = cell.palpd(*arguments)
    assert done.returncode == 0, done.stderr


def table(runs: Sequence[dict[str, Any]], model: str) -> str:
    """Markdown: the median of the runs, with the lowest and the highest."""
    fast = model == "ur5e"  # at 125 Hz four times the frames come in one tick
    flat = [_flat(run) for run in runs]

    def of(key: str, form: str = ".0f") -> str:
        values = [run[key] for run in flat if key in run]
        middle, lowest, highest = (format(value, form) for value in (float(np.median(values)), min(values), max(values)))
        return middle if lowest == highest else f"{middle} ({lowest} to {highest})"

    lines = [
        f"| {model}, sensor 1 kHz, network on every sample, runs: {len(runs)} | measured | target |",
        "|---|---|---|",
        f"| work of a tick, p50, µs | {of('work_us_p50')} | {200 if fast else 400} |",
        f"| work of a tick, p99, µs | {of('work_us_p99')} | {600 if fast else ''} |",
        f"| wake-up, p50 and p99, µs | {of('wakeup_us_p50')} and {of('wakeup_us_p99')} | |",
    ]
    if all(run["cyclictest"] for run in runs):
        lines += [
            f"| cyclictest in the same run, p50 and p99, µs | {of('other_p50')} and {of('other_p99')} | |",
            f"| ticks later than 1 ms or missed | {of('late', '.2%')} | |",
            f"| the same of cyclictest | {of('other_late', '.2%')} | |",
            f"| difference of the two | {of('above', '+.2%')} | 0.05% |",
        ]
    else:
        lines.append(f"| ticks later than 1 ms or missed (cyclictest is not installed) | {of('late', '.2%')} | |")
    lines += [
        f"| resident memory, all processes, MB | {of('memory_MB')} | 300 |",
        *(f"| – {name} | {of(name)} | |" for name in runs[0]["memory"]),
        f"| recording, MB/min | {of('MB_per_min', '.1f')} | 15 |",
        f"| replay, × real time; all identical: {all(run['identical'] for run in runs)} | {of('replay', '.1f')} | {20 if fast else 60} |",
        f"| the same by processor time, as with a core to itself | {of('replay_alone', '.1f')} | |",
    ]
    return "\n".join(lines)


def _flat(run: dict[str, Any]) -> dict[str, float]:
    """The figures of a run in one level."""
    flat: dict[str, float] = {key: value for key, value in run.items() if isinstance(value, float | int)} | run["memory"]
    flat["memory_MB"] = sum(run["memory"].values())
    if run["cyclictest"]:
        flat |= {f"other_{key}": value for key, value in run["cyclictest"].items()}
        flat["above"] = run["late"] - run["cyclictest"]["late"]
    return flat


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", default="ur5e", choices=("ur5", "ur5e"))
    parser.add_argument("--presses", type=int, default=4)
    parser.add_argument("--runs", type=int, default=3)
    options = parser.parse_args()
    runs = []
    for _ in range(options.runs):
        with tempfile.TemporaryDirectory() as folder:
            runs.append(measure(options.model, options.presses, Path(folder)))
    print(table(runs, options.model), flush=True)


if __name__ == "__main__":
    main()
