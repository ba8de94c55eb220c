"""Faults as deeds, done to a run in the middle of a press, and what came of them.

Required reactions and deadlines stand in docs/faults.md, and nowhere else.
"""

import random
import re
import resource
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tests.hil.wired import PRESS, Daemon, Wired, kill

TABLE = Path(__file__).parents[2] / "docs" / "faults.md"
CYCLE_S = 0.008
WATCHDOG_HZ = 25
PRESSED_N = 3.0
"""More than the search leaves behind: the arm is in the press, at its full speed for 0.4 s more."""
SPREAD_S = 0.3

Deed = Callable[[Wired, Daemon], object]


def _verb(name: str, **arguments: object) -> Deed:
    return lambda cell, daemon: cell.wires.ask(name, **arguments)


def _disk_full(cell: Wired, daemon: Daemon) -> None:
    """The recorder may not write beyond what is written: its next write fails as on a full disk."""
    size = cell.part.stat().st_size
    resource.prlimit(daemon.recorder_pid, resource.RLIMIT_FSIZE, (size, size))


DEEDS: dict[str, Deed] = {
    "sensor silent": _verb("silent", s=2.0),
    "sensor slow": _verb("slow", every=100, s=2.0),
    "sensor stuck": _verb("stuck", s=3.0),
    "sensor garbage": _verb("garbage", bytes=200),
    "sensor garbage storm": _verb("garbage", bytes=3000),
    "sensor bytes lost": _verb("lose", bytes=50),
    "sensor bits flipped": _verb("flip", frames=5),
    "sensor bytes swapped": _verb("swap", frames=3),
    "sensor false headers": _verb("false_header", frames=20),
    "sensor counter jump": _verb("counter_jump", by=1000),
    "sensor status bits": _verb("status", word=1 << 10, s=2.0),
    "sensor overload": _verb("overload", s=2.0),
    "sensor unplugged": _verb("unplug"),
    "robot network hangs": _verb("freeze", s=1.0),
    "robot connection dropped": _verb("drop"),
    "robot states slow": _verb("slow_packets", every=20, s=2.0),
    "robot protective stop": _verb("protective_stop"),
    "robot emergency stop": _verb("emergency_stop"),
    "robot power off": _verb("power_off"),
    "robot program stopped": _verb("program_stop"),
    "robot controller restart": _verb("restart", s=2.0),
    "motion process killed": lambda cell, daemon: kill(daemon.motion_pid),
    "motion process crashes": lambda cell, daemon: kill(daemon.motion_pid, signal.SIGSEGV),
    "motion process stalled": lambda cell, daemon: kill(daemon.motion_pid, signal.SIGSTOP),
    "main process killed": lambda cell, daemon: kill(daemon.process.pid),
    "daemon killed": lambda cell, daemon: kill(-daemon.process.pid),
    "main process TERM": lambda cell, daemon: kill(daemon.process.pid, signal.SIGTERM),
    "main process INT": lambda cell, daemon: kill(daemon.process.pid, signal.SIGINT),
    "main process HUP": lambda cell, daemon: kill(daemon.process.pid, signal.SIGHUP),
    "recorder killed": lambda cell, daemon: kill(daemon.recorder_pid),
    "disk full": _disk_full,
}


@dataclass(frozen=True)
class Required:
    """One row of the table. `deadline` and `measured` are ticks of 8 ms from the deed to a target speed of zero; None: none."""

    fault: str
    reaction: str
    reasons: tuple[str, ...]  # phrases, of which one must be in what is reported
    deadline: float | None
    measured: float | None


@dataclass(frozen=True)
class Came:
    """What a fault led to. `ticks` is None where the run went on to its end."""

    ticks: float | None
    code: int
    reason: str


def required(table: Path = TABLE) -> dict[str, Required]:
    """The table of docs/faults.md, by fault."""
    rows = {}
    for line in table.read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("|") and cells[0] in DEEDS:
            fault, reaction, reason, deadline, measured = cells
            rows[fault] = Required(fault, reaction, tuple(reason.split(" or ")), _number(deadline), _number(measured))
    return rows


def _number(cell: str) -> float | None:
    found = re.match(r"[0-9.]+", cell)
    return float(found.group()) if found else None


def suffered(cell: Callable[[], Wired], fault: str, attempts: int = 3) -> Came:
    """Press at 10 mm/s into 1 N/mm, do the deed at some moment of it, wait for the end."""
    for attempt in range(attempts):
        wired = cell()
        daemon = wired.run(PRESS)
        try:
            wired.until_contact(daemon, PRESSED_N)
        except AssertionError:
            if attempt + 1 < attempts:  # a machine that stands still for 40 ms trips the watchdog by itself
                continue
            raise
        _ = daemon.motion_pid, daemon.recorder_pid  # looked up now: it takes some ticks
        time.sleep(random.uniform(0.0, SPREAD_S))
        done_s = time.monotonic()
        DEEDS[fault](wired, daemon)
        return _awaited(wired, daemon, done_s)
    raise AssertionError("no attempt was made")


def _awaited(wired: Wired, daemon: Daemon, done_s: float) -> Came:
    code = daemon.wait()
    if code == 0:
        return Came(None, code, daemon.found["reason"])
    ticks = wired.rest_after_s(done_s, settle_s=max(0.6, time.monotonic() - done_s)) / CYCLE_S
    return Came(ticks, code, daemon.found["reason"] if daemon.json_file.exists() else daemon.stderr)


def objection(came: Came, row: Required) -> str:
    """What of the row was not kept, or nothing."""
    if came.ticks is None:
        return "" if "carry on" in row.reaction else f"the run went on to its end ({came.reason})"
    if row.reaction == "carry on":
        return f"it ended with {came.code}: {came.reason}"
    if row.deadline is not None and came.ticks > row.deadline:
        return f"the target was at rest after {came.ticks:.1f} ticks, {row.deadline:g} are allowed"
    if not any(phrase in came.reason for phrase in row.reasons):
        return f"the reason is {came.reason!r}, expected {' or '.join(row.reasons)}"
    return ""
