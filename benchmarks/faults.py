"""Inject every fault of docs/faults.md into runs at random moments and fill its column "measured".

`python benchmarks/faults.py [--repeats 3] [--minutes 60] [--only FAULT,FAULT] [--parallel 2] [--json FILE]`. Some 10 s a fault that ends a
run, 1 s one that does not; the faults take turns, so that an end by `--minutes` leaves all with as many. Results are added to FILE, and the
table is written from all of FILE. Faults that FILE already holds count towards the repeats, those that were left out do not: so the same
command, given again, completes them. Ends with 1 where a required reaction or deadline was not kept.
"""

import argparse
import contextlib
import json
import multiprocessing
import os
import queue
import sys
import tempfile
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.fault_injection import (
    FAULTS,
    TABLE,
    FaultOutcome,
    at_any_moment,
    inject,
    inject_repeatedly,
    objection,
    required,
    wall_clock,
)
from benchmarks.measured_column import condition, fill, results_in
from palpd.daemon.realtime import fifo
from palpd.testing.emulated_cell import EmulatedCell, emulated_cell
from palpd.testing.processes import side_by_side, take_signals

CONTACT_LIMIT_N = 16.0
INJECTED_AT_ONCE = 10
MACHINE_LATE_S = 0.002
"""An emulator, or a thread of the highest priority on any core, that was later than this measures the machine: the outcome of the
fault is left out, and counted. A stall of 50 ms trips the controller's watchdog by itself, and then another reason is reported too."""


def _watch(cpu: int, stalls: "multiprocessing.Queue[tuple[float, float]]") -> None:
    """Wake every millisecond on that core, above all else, and report every wake-up that came too late."""
    os.sched_setaffinity(0, {cpu})
    fifo(99)
    due_s = time.monotonic()
    while True:
        due_s += 0.001
        time.sleep(max(0.0, due_s - time.monotonic()))
        late_s = time.monotonic() - due_s
        if late_s > MACHINE_LATE_S:
            stalls.put((due_s, late_s))
            due_s += late_s


class StallWatch:
    """When each core of the machine stood still, whatever its threads' priorities."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._reports: multiprocessing.Queue[tuple[float, float]] = context.Queue()
        self._stalls: list[tuple[float, float]] = []
        for cpu in os.sched_getaffinity(0):
            context.Process(target=_watch, args=(cpu, self._reports), daemon=True).start()

    def late_s(self, since_s: float, until_s: float) -> float:
        """The longest stall that touches that time."""
        with contextlib.suppress(queue.Empty):
            while True:
                self._stalls.append(self._reports.get_nowait())
        return max((late_s for at_s, late_s in self._stalls if at_s < until_s and at_s + late_s > since_s), default=0.0)


class Bench:
    """Emulated cells side by side, and the outcomes of the faults injected into them."""

    def __init__(self, kept: Path, end_s: float) -> None:
        self.todo: queue.SimpleQueue[tuple[str, int]] = queue.SimpleQueue()
        self._kept, self._end_s, self._lock, self._watch = kept, end_s, threading.Lock(), StallWatch()

    def work(self, folder: Path) -> None:
        """Inject faults into one cell until the list is empty or the time is over."""
        with emulated_cell(folder, "ur5") as base:
            calibration = base.anew(folder).calibrate().read_text()
            environment = wall_clock(folder)

            def cell() -> EmulatedCell:
                fresh = Path(tempfile.mkdtemp(prefix="fault-", dir=folder))
                (fresh / "state").mkdir()
                (fresh / "state" / "calibration.json").write_text(calibration)
                ready = base.anew(fresh, safety={"contact_limit_N": CONTACT_LIMIT_N})
                ready.environment.update(environment)
                return ready

            while time.monotonic() < self._end_s:
                try:
                    fault, times = self.todo.get_nowait()
                except queue.Empty:
                    return
                if fault == "wall clock steps" and not environment:
                    continue
                try:
                    self._do(cell, fault, times)
                except (AssertionError, OSError) as error:  # the machine, or a run that ended by itself: no figure
                    print(f"{fault}: nothing was measured ({error})", file=sys.stderr, flush=True)

    def plan(self, faults: Sequence[str], repeats: int) -> None:
        """List what is missing in the file: each fault that often, in turns."""
        judged = Counter(entry["fault"] for entry in results_in(self._kept) if entry["late_s"] <= MACHINE_LATE_S)
        for number in range(repeats):
            for fault in faults:
                missing = repeats - judged[fault]
                if number >= missing:
                    continue
                if not required()[fault].reaction.startswith("carry on"):
                    self.todo.put((fault, 1))
                elif number % INJECTED_AT_ONCE == 0:
                    self.todo.put((fault, min(INJECTED_AT_ONCE, missing - number)))

    def _do(self, cell: Any, fault: str, times: int) -> None:
        if required()[fault].reaction.startswith("carry on"):
            came = inject_repeatedly(cell, fault, times, reference=False)
            if len(came) < times and not objection(came[-1], required()[fault]):
                self.todo.put((fault, times - len(came)))
        else:
            came = [inject(cell, fault, at_any_moment, reference=False)]
        with self._lock, self._kept.open("a") as file:
            came = [replace(one, machine_late_s=max(one.machine_late_s, self._machine_late_s(one))) for one in came]
            for one in came:
                why = objection(one, required()[fault])
                entry = {"fault": fault, "ticks": one.ticks, "code": one.code, "reason": one.reason, "phase": one.phase.name, "why": why}
                file.write(json.dumps(entry | {"late_s": one.machine_late_s, "load": os.getloadavg()[0]}) + "\n")
        print(f"{fault}: {' '.join(_shown(one) for one in came)} {why}", flush=True)

    def _machine_late_s(self, one: FaultOutcome) -> float:
        """Of a run that has ended: from just before the fault until the arm was at rest. A run that went on has survived it."""
        return 0.0 if one.ticks is None else self._watch.late_s(one.done_s - 0.1, one.done_s + 0.6)


def _shown(came: FaultOutcome) -> str:
    late = "" if came.machine_late_s <= MACHINE_LATE_S else f" (the machine {came.machine_late_s * 1e3:.0f} ms late)"
    return "·" if came.ticks is None else f"{came.ticks:.1f} in {came.phase.name}{late}"


def cell_of(entries: list[dict[str, Any]]) -> tuple[str, int]:
    """What stands in the table for one fault: worst first. And the number of its faults that broke a requirement."""
    judged = [entry for entry in entries if entry["late_s"] <= MACHINE_LATE_S]
    broken = [entry for entry in judged if entry["why"]]
    ticks = [entry["ticks"] for entry in judged if entry["ticks"] is not None]
    on, left_out = sum(entry["ticks"] is None for entry in judged), len(entries) - len(judged)
    parts = [f"{max(ticks):.1f}, p99 {np.percentile(ticks, 99):.1f}, n {len(ticks)}"] if ticks else []
    parts += [f"carried on, n {on}"] if on else []
    parts += [f"{left_out} left out"] if left_out else []
    parts += [f"**{len(broken)} not kept**"] if broken else []
    return "; ".join(parts), len(broken)


def write_table(kept: Path) -> int:
    """Fill the column "measured" of docs/faults.md from a file of results, and return how many faults broke a requirement."""
    by_fault: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for entry in results_in(kept):
        by_fault[entry["fault"]].append(entry)
    cells, all_broken = {}, 0
    for fault, entries in by_fault.items():
        cells[fault], broken = cell_of(entries)
        all_broken += broken
    loads = [entry["load"] for entries in by_fault.values() for entry in entries]
    fill(TABLE, cells, "Faults measured", condition(loads, f"{len(loads)} faults at random moments of search and presses"))
    return all_broken


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--minutes", type=float, default=600.0, help="no fault is begun after that")
    parser.add_argument("--only", help="faults, separated by commas")
    parser.add_argument("--parallel", type=int, default=1, help="emulated cells at a time")
    parser.add_argument("--json", type=Path, help="results are added to this file, and the table is made of all of it")
    options = parser.parse_args()
    faults = options.only.split(",") if options.only else list(FAULTS)
    take_signals()
    with tempfile.TemporaryDirectory() as name:
        kept = options.json or Path(name) / "faults.jsonl"
        bench = Bench(kept, time.monotonic() + options.minutes * 60)
        bench.plan(faults, options.repeats)
        side_by_side(bench.work, Path(name), options.parallel)
        sys.exit(1 if write_table(kept) else 0)


if __name__ == "__main__":
    main()
