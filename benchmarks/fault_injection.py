"""Faults that are injected into a run, and their outcomes.

Required reactions and deadlines stand in docs/faults.md, and nowhere else.
"""

import contextlib
import mmap
import os
import random
import re
import resource
import shutil
import signal
import socket
import struct
import subprocess
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from hw.rtde import RTDE_PORT, SCRIPT_PORT
from palpd.errors import PalpdError
from palpd.testing.emulated_cell import PRESS, Daemon, EmulatedCell
from palpd.testing.processes import kill, until
from palpd.tick import Phase

TABLE = Path(__file__).parents[1] / "docs" / "faults.md"
CYCLE_S = 0.008
PRESSED_N = 3.0
"""More than the search leaves behind: the arm is in the press, at its full speed for 0.4 s more."""
SPREAD_S = 0.3
AWAKE_S = 3.2
"""From the first tick of the search to the last of the second press: any moment of it is as good as another."""
LOAD_S = 2.0
STOOD_S = 3 * CYCLE_S
"""A run whose newest tick is older stands still or is over: a fault then has no effect."""

Fault = Callable[[EmulatedCell, Daemon], float]
"""Injects the fault and returns when, on the host's monotonic clock."""


def _verb(name: str, **arguments: object) -> Fault:
    return lambda cell, _daemon: float(cell.wires.ask(name, **arguments)["t_s"])


def _signal(victim: Callable[[Daemon], int], number: int = signal.SIGKILL) -> Fault:
    return lambda _cell, daemon: kill(victim(daemon), number)


def _disk_full(cell: EmulatedCell, daemon: Daemon) -> float:
    """The recorder may not write beyond what is written: its next write fails as on a full disk."""
    size = cell.part.stat().st_size
    resource.prlimit(daemon.recorder_pid, resource.RLIMIT_FSIZE, (size, size))
    return time.monotonic()


def _second_reader(cell: EmulatedCell, _daemon: Daemon) -> float:
    """Somebody with root's rights, whom the lock of the port does not keep out, reads from it for a second."""
    port = os.open(cell.wires.sensor, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)

    def steal(until_s: float) -> None:
        while time.monotonic() < until_s:
            with contextlib.suppress(BlockingIOError):
                os.read(port, 64)
            time.sleep(0.001)
        os.close(port)

    threading.Thread(target=steal, args=(time.monotonic() + 1.0,), daemon=True).start()
    return time.monotonic()


def _second_program(cell: EmulatedCell, _daemon: Daemon) -> float:
    """Another computer sends a program to the controller, which replaces the daemon's: done when the controller has it."""
    began_s = time.monotonic()
    with socket.create_connection((cell.wires.host, SCRIPT_PORT)) as connection:
        connection.sendall(b"def other():\n  sleep(10)\nend\n")
    ((done_s, _), *_) = until(lambda: cell.stops(began_s), "the program is replaced")
    return float(done_s)


def _second_client(cell: EmulatedCell, _daemon: Daemon) -> float:
    """Another computer asks RTDE for the registers that the daemon commands by."""
    done_s = time.monotonic()
    with socket.create_connection((cell.wires.host, RTDE_PORT)) as connection:
        for kind, body in ((b"V", struct.pack(">H", 2)), (b"I", b"input_int_register_0,input_double_register_0")):
            connection.sendall(struct.pack(">Hc", 3 + len(body), kind) + body)
        answer = connection.recv(4096)
        while b"IN_USE" not in answer:
            more = connection.recv(4096)
            assert more, answer
            answer += more
    return done_s


def _clock_step(cell: EmulatedCell, _daemon: Daemon) -> float:
    """The wall clock of all of the daemon's processes leaps by up to a day, forwards or backwards."""
    with Path(cell.environment["PALPD_TEST_WALL_CLOCK"]).open("r+b") as file, mmap.mmap(file.fileno(), 8) as page:
        page[:8] = struct.pack("<q", random.randrange(-86400, 86400) * 10**9)
    return time.monotonic()


def _stress(*arguments: str) -> Fault:
    def strain(_cell: EmulatedCell, _daemon: Daemon) -> float:
        command = ["stress-ng", "--quiet", "--timeout", f"{LOAD_S:g}s", *arguments]
        subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        return time.monotonic()

    return strain


FAULTS: dict[str, Fault] = {
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
    "sensor drifts pressed": _verb("drift", N_per_s=100.0),
    "sensor drifts pulled": _verb("drift", N_per_s=-100.0),
    "sensor unplugged": _verb("unplug"),
    "sensor has a second reader": _second_reader,
    "robot network hangs": _verb("freeze", s=1.0),
    "robot connection dropped": _verb("drop"),
    "robot states slow": _verb("slow_packets", every=20, s=2.0),
    "robot protective stop": _verb("protective_stop"),
    "robot emergency stop": _verb("emergency_stop"),
    "robot power off": _verb("power_off"),
    "robot program stopped": _verb("program_stop"),
    "robot program replaced": _second_program,
    "robot has a second client": _second_client,
    "robot controller restart": _verb("restart", s=2.0),
    "motion process killed": _signal(lambda daemon: daemon.motion_pid),
    "motion process crashes": _signal(lambda daemon: daemon.motion_pid, signal.SIGSEGV),
    "motion process stalled": _signal(lambda daemon: daemon.motion_pid, signal.SIGSTOP),
    "main process killed": _signal(lambda daemon: daemon.process.pid),
    "daemon killed": _signal(lambda daemon: -daemon.process.pid),
    "main process TERM": _signal(lambda daemon: daemon.process.pid, signal.SIGTERM),
    "main process INT": _signal(lambda daemon: daemon.process.pid, signal.SIGINT),
    "main process HUP": _signal(lambda daemon: daemon.process.pid, signal.SIGHUP),
    "Ctrl-C": _signal(lambda daemon: -daemon.process.pid, signal.SIGINT),
    "terminal closed": _signal(lambda daemon: -daemon.process.pid, signal.SIGHUP),
    "recorder killed": _signal(lambda daemon: daemon.recorder_pid),
    "disk full": _disk_full,
    "wall clock steps": _clock_step,
    "memory pressure": _stress("--vm", "2", "--vm-bytes", "2g", "--vm-populate"),
    "processors busy": _stress("--cpu", str(2 * (os.cpu_count() or 1))),
}
PAUSE_S = {"memory pressure": LOAD_S + 1.0, "processors busy": LOAD_S + 1.0}
"""Pause between two faults in one run; the guard forgets rejected frames with a time constant of 0.8 s."""


def wall_clock(folder: Path) -> dict[str, str]:
    """Environment for a daemon whose wall clock can be stepped; empty where there is no C compiler."""
    if shutil.which("cc") is None:
        return {}
    library, shift = folder / "wall_clock.so", folder / "wall_clock"
    source = Path(__file__).with_name("wall_clock.c")
    subprocess.run(["cc", "-shared", "-fPIC", "-O1", "-o", str(library), str(source), "-ldl"], check=True)
    shift.write_bytes(bytes(8))
    return {"LD_PRELOAD": str(library), "PALPD_TEST_WALL_CLOCK": str(shift)}


@dataclass(frozen=True)
class Requirement:
    """One row of the table. `deadline` and `measured` are ticks of 8 ms from the fault to a target speed of zero; None: none."""

    fault: str
    reaction: str
    reasons: tuple[str, ...]  # one of these phrases must be in the report
    deadline: float | None
    measured: float | None


@dataclass(frozen=True)
class FaultOutcome:
    """What a fault led to. `ticks` is None where the run went on to its end."""

    ticks: float | None
    code: int
    reason: str
    phase: Phase = Phase.PRESS
    machine_late_s: float = 0.0
    """How late the emulator, on a real-time thread of the same machine, was at worst from the fault to rest."""
    done_s: float = 0.0


def required(table: Path = TABLE) -> dict[str, Requirement]:
    """The table of docs/faults.md, by fault."""
    rows = {}
    for line in table.read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("|") and cells[0] in FAULTS:
            fault, reaction, reason, deadline, measured = cells
            rows[fault] = Requirement(fault, reaction, tuple(reason.split(" or ")), _number(deadline), _number(measured))
    return rows


def _number(cell: str) -> float | None:
    number = re.match(r"[0-9.]+", cell)
    return float(number.group()) if number else None


def in_the_press(wired: EmulatedCell, daemon: Daemon) -> None:
    """Some moment at full speed in the tissue."""
    wired.until_contact(daemon, PRESSED_N)
    _ = daemon.motion_pid, daemon.recorder_pid  # looked up now: it takes some ticks
    time.sleep(random.uniform(0.0, SPREAD_S))


def at_any_moment(_wired: EmulatedCell, daemon: Daemon) -> None:
    """Any moment between the first of the search and the end of the second press."""
    until_searching(daemon)
    _ = daemon.motion_pid, daemon.recorder_pid
    time.sleep(random.uniform(0.0, AWAKE_S))


def until_searching(daemon: Daemon) -> None:
    """Wait until the arm looks for the surface."""

    def searches() -> bool:
        assert daemon.process.poll() is None, f"exit code {daemon.process.returncode}: {daemon.stderr}"
        with contextlib.suppress(AssertionError, PalpdError):  # no ring yet, or one half made
            return daemon.phase >= Phase.SEARCH and daemon.phase != Phase.TARE
        return False

    until(searches, "the arm looks for the surface")


def inject(
    cell: Callable[[], EmulatedCell],
    fault: str,
    moment: Callable[[EmulatedCell, Daemon], None] = in_the_press,
    attempts: int = 3,
    reference: bool = True,
) -> FaultOutcome:
    """Press at 10 mm/s into 1 N/mm, inject the fault at some moment of it, wait for the end."""
    for attempt in range(attempts):
        wired = cell()
        daemon = wired.run(PRESS | {"repeats": 2}, take_reference=reference)
        try:
            moment(wired, daemon)
        except AssertionError:
            if attempt + 1 < attempts:  # a machine that stands still for 40 ms trips the watchdog by itself
                continue
            raise
        phase, ago_s = daemon.newest
        if ago_s > STOOD_S and attempt + 1 < attempts:
            daemon.wait()
            continue
        return _awaited(wired, daemon, FAULTS[fault](wired, daemon), phase)
    raise AssertionError("no attempt was made")


def inject_repeatedly(cell: Callable[[], EmulatedCell], fault: str, times: int, reference: bool = True) -> list[FaultOutcome]:
    """Inject a fault that a run should survive into one run several times. The list is shorter where the run ended."""
    wired = cell()
    daemon = wired.run(PRESS | {"repeats": 100}, take_reference=reference)
    until_searching(daemon)
    pause_s = PAUSE_S.get(fault, 0.7)
    outcomes: list[FaultOutcome] = []
    for _ in range(times):
        time.sleep(pause_s * random.uniform(0.7, 1.3))
        phase = daemon.phase
        done_s = FAULTS[fault](wired, daemon)
        end_s = done_s + pause_s
        while time.monotonic() < end_s and daemon.process.poll() is None:
            time.sleep(0.02)
        if daemon.process.poll() is not None:
            return [*outcomes, _awaited(wired, daemon, done_s, phase)]
        outcomes.append(FaultOutcome(None, 0, "", phase, done_s=done_s))
    kill(daemon.process.pid, signal.SIGTERM)
    daemon.wait()
    assert "operator aborted" in daemon.stderr, daemon.stderr
    return outcomes


def _awaited(wired: EmulatedCell, daemon: Daemon, done_s: float, phase: Phase) -> FaultOutcome:
    code = daemon.wait()
    if code == 0:
        return FaultOutcome(None, code, daemon.report["reason"], phase, done_s=done_s)
    ticks = wired.rest_after_s(done_s, settle_s=max(0.6, time.monotonic() - done_s)) / CYCLE_S
    reason = daemon.report["reason"] if daemon.json_file.exists() else daemon.stderr
    return FaultOutcome(max(0.0, ticks), code, reason, phase, wired.lateness_s(done_s - 0.1, 0.7), done_s)


def objection(came: FaultOutcome, row: Requirement) -> str:
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
