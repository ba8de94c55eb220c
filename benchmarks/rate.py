"""Do the ticks come? The daemon's loop at 125, 500 and 1000 Hz beside cyclictest, on the machine as it is and under stress-ng.

Beside it runs the loop as one would write it instead: on processors that may sleep, with `time.sleep`, with ur_rtde's `waitPeriod`, or
with Python's logging in every tick.

`python benchmarks/rate.py [--seconds 20] [--rates 125,500,1000] [--stress] [--alternatives]` prints a markdown table. Loop, guard, tare
and ring are the daemon's own; robot and sensor are stand-ins in memory with a kilohertz of dithering frames, so that nothing but the ticks
is measured.
"""

import argparse
import contextlib
import logging
import os
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from benchmarks.daemon import Cyclictest
from palpd.config import Config, Plan
from palpd.control.loop import Loop, Record
from palpd.control.sequence import Sequence, TimedRest
from palpd.daemon.clock import RealClock
from palpd.daemon.motion_job import Job, arm_geometry_of, explainer_of, limits_of
from palpd.daemon.motion_process import RingWriter
from palpd.daemon.realtime import CPU_LATENCY, realtime
from palpd.recording.ring import Ring
from palpd.tick import PROGRAM_PLAYING, Clock, Floats, RobotMode, RobotState, SafetyMode, SensorFrames, TickRecord, Timing, UncommandedRobot


class IdleRobot(UncommandedRobot):
    """Stands still and says so."""

    def read(self) -> RobotState:
        """A new state every time."""
        now_s, zeros = time.monotonic(), (0.0,) * 6
        pose = (0.0, 0.0, 0.05, np.pi, 0.0, 0.0)
        return RobotState(
            now_s, now_s, pose, zeros, pose, zeros, (0.0, 0.0, 9.81), RobotMode.RUNNING, SafetyMode.NORMAL, 1, PROGRAM_PLAYING, True
        )


class DitheringSensor:
    """A kilohertz of frames that dither about nothing."""

    def __init__(self) -> None:
        self._frames = np.random.default_rng(1).normal(0.0, 0.05, (4096, 6))
        self._last_s, self._count = time.monotonic(), 0

    def read(self) -> SensorFrames:
        """Those of the milliseconds since the last look, at most eight."""
        now_s = time.monotonic()
        n = max(1, min(8, round((now_s - self._last_s) * 1e3)))
        self._last_s, self._count = now_s, self._count + n
        t_s: Floats = np.linspace(now_s - 1e-3 * (n - 1), now_s, n)
        numbers = np.arange(self._count - n, self._count)
        return SensorFrames(t_s, numbers.astype(np.uint16), np.zeros(n, np.uint16), self._frames[numbers % 4096])

    def close(self) -> None:
        """Nothing."""


class OtherClock:
    """A period that somebody else waits for; planned is what was asked of it: a period after the last wake-up."""

    def __init__(self, rate_Hz: float, wait: Callable[[], None]) -> None:
        self._period_s, self._wait, self._index, self._began_s = 1.0 / rate_Hz, wait, -1, time.monotonic()

    def wait(self) -> Timing:
        """The next tick."""
        planned_s = self._began_s + self._period_s
        self._wait()
        self._index, self._began_s = self._index + 1, time.monotonic()
        return Timing(self._index, planned_s, self._began_s)

    def elapsed_us(self) -> float:
        """Since the tick began."""
        return (time.monotonic() - self._began_s) * 1e6


class Logged:
    """The ring, and a line of Python's logger in every tick."""

    def __init__(self, writer: RingWriter, path: Path) -> None:
        self._writer, self._log = writer, logging.getLogger("benchmark")
        self._log.addHandler(logging.FileHandler(path))
        self._log.setLevel(logging.INFO)

    def __call__(self, record: TickRecord) -> None:
        """Both."""
        self._writer(record)
        seen = record.observation
        self._log.info("tick %d force %.3f N z %.5f m", seen.timing.index, seen.contact.force_N, seen.robot.z_m)

    def rehearse(self, record: TickRecord) -> None:
        """The ring only."""
        self._writer.rehearse(record)


@contextlib.contextmanager
def waits(kind: str, rate_Hz: float, folder: Path) -> Iterator[tuple[Any, AbstractContextManager[Any]]]:
    """The clock of a kind, and what the thread asks of the kernel."""
    if kind == "time.sleep":
        yield OtherClock(rate_Hz, lambda: time.sleep(1.0 / rate_Hz)), nullcontext()
    elif kind == "waitPeriod":
        from rtde_receive import RTDEReceiveInterface

        from palpd.testing.emulated_cell import emulated_cell

        with emulated_cell(folder, "ur5e") as cell:
            receive = RTDEReceiveInterface(cell.wires.host, 125.0, ["timestamp"])
            start = [receive.initPeriod()]

            def wait() -> None:
                receive.waitPeriod(start[0])  # as its examples do: at the end of a turn, from its beginning
                start[0] = receive.initPeriod()

            yield OtherClock(rate_Hz, wait), nullcontext()
            receive.disconnect()
    else:
        file = "/nowhere" if kind == "processors may sleep" else CPU_LATENCY
        with patch("palpd.daemon.realtime.CPU_LATENCY", file):
            yield RealClock(rate_Hz, time.monotonic() + 0.3), realtime()


def idle_loop(seconds: float, clock: Clock, record: Record) -> Loop:
    """The daemon's own loop with stand-ins for robot and sensor, which rests for that long."""
    config = Config.model_validate({"safety": {"max_stall_s": 0.5, "robot_stale_s": 0.5, "sensor_stale_s": 0.5}})
    job = Job("palpation", config, Plan(), reference=(0.0,) * 6)
    explainer = explainer_of(job, {}, 0.001)
    explainer.tare = np.zeros(6)
    sequence = Sequence(TimedRest(arm_geometry_of(job, 0.001), seconds))
    return Loop(IdleRobot(), DitheringSensor(), clock, sequence, explainer, limits_of(config), record)


def measure(kind: str, rate_Hz: float, seconds: float, stress: bool) -> str:
    """One line of the table."""
    with tempfile.TemporaryDirectory() as name, waits(kind, rate_Hz, Path(name)) as (clock, privileges):
        ring = Ring.create(rate_Hz, seconds + 2.0)
        writer = RingWriter(ring)
        record: Record = Logged(writer, Path(name) / "log") if kind == "logger" else writer
        loop = idle_loop(seconds, clock, record)
        strain = _strained(seconds + 1.0) if stress else None
        beside = Cyclictest(round(1e6 / rate_Hz))
        time.sleep(0.3)
        with privileges:
            loop.rehearse(200)
            if isinstance(clock, RealClock):
                clock.begin_soon()
            outcome = loop.run()
        other = beside.end()
        if strain is not None:
            strain.wait()
        rows, _, _ = ring.read(0)
        rows = rows[5:].copy()
        ring.close()
    late_us = (rows["now_s"] - rows["planned_s"]) * 1e6
    reached_Hz = (len(rows) - 1) / (rows["now_s"][-1] - rows["now_s"][0])
    p50, p99 = np.percentile(late_us, [50, 99])
    work50, work99 = np.percentile(rows["work_us"][1:], [50, 99])
    missed = int(rows["missed"].sum())
    beside_it = f"{other['p50']:.0f}, {other['p99']:.0f} | {p50 / other['p50']:.1f}, {p99 / other['p99']:.1f}" if other else "– | –"
    machine = f"{'stress-ng' if stress else 'as it was'}, load {os.getloadavg()[0]:.1f}"
    early = "" if outcome.verdict == "done" else f" (ended early: {outcome.reason})"
    return (
        f"| {kind} | {rate_Hz:g} Hz | {machine} | {len(rows)}{early} | {reached_Hz:.2f} | "
        f"{missed} ({missed / (len(rows) + missed):.3%}) | {p50:.0f}, {p99:.0f} | {beside_it} | {work50:.0f}, {work99:.0f} |"
    )


def _strained(seconds: float) -> subprocess.Popen[bytes]:
    return subprocess.Popen(["stress-ng", "--quiet", "--cpu", str(os.cpu_count()), "--timeout", f"{seconds:.0f}s"])


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--rates", default="125,500,1000")
    parser.add_argument("--stress", action="store_true", help="also with every processor busy")
    parser.add_argument("--alternatives", action="store_true", help="also what one would write instead, at the middle rate")
    options = parser.parse_args()
    rates = [float(rate) for rate in options.rates.split(",")]
    cases = [("palpd", rate) for rate in rates]
    if options.alternatives:
        cases += [(kind, rates[len(rates) // 2]) for kind in ("processors may sleep", "time.sleep", "waitPeriod", "logger")]
    print("| loop | asked | machine | ticks | reached, Hz | missed | wake-up p50, p99, µs | cyclictest's | ratio | work p50, p99, µs |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for stress in (False, True) if options.stress else (False,):
        for kind, rate_Hz in cases:
            print(measure(kind, rate_Hz, options.seconds, stress), flush=True)


if __name__ == "__main__":
    main()
