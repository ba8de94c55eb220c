"""A daemon and an emulated cell as real processes on real wires; the cell logs what happens."""

import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml
from typer.testing import CliRunner

from hw.emulators.controller import TruthSample
from hw.emulators.process import Emulated, started
from palpd.cli import app
from palpd.recording.reader import Recording
from palpd.recording.ring import Ring
from palpd.testing.processes import PATIENCE_S, command_of, family, until
from palpd.tick import Phase

ATTEMPTS = 5
STALLED_S = 0.002
"""An emulator, on a real-time thread where that is permitted, that was later than this measures the machine."""
SOFT_N_PER_M = 500.0
ABOVE_M = 0.008
"""Where a press begins: far enough to reach its speed, near enough not to waste seconds."""
PATIENT_S = 0.2
PATIENT: dict[str, dict[str, Any]] = {
    "robot": {"watchdog_Hz": 1.0 / PATIENT_S},
    "safety": {"contact_limit_N": 16.0, "robot_stale_s": PATIENT_S, "sensor_stale_s": PATIENT_S, "max_stall_s": PATIENT_S},
}
"""For a machine that runs other things too, and may stand still for longer than a cell may; how fast the guard is, is tested elsewhere."""
PRESS: dict[str, Any] = {
    "sites": [{"name": "A"}],
    "mode": "dynamic",
    "depths_m": [0.01],
    "press_speed_m_per_s": 0.01,
    "repeats": 1,
    "safe_height_m": 0.004,
    "search": {"speed_m_per_s": 0.01, "max_travel_m": 0.03},
}
"""One press of 10 mm at 10 mm/s."""
_hosts = count()


def ring_of(pid: int) -> Ring:
    """The ring that a process has mapped."""
    match = re.search(r"/dev/shm/(\S+)", Path(f"/proc/{pid}/maps").read_text())
    assert match is not None, f"process {pid} has no ring"
    return Ring.attach(match.group(1))


@dataclass
class Daemon:
    """A palpd command under way, in a session (and so a process group) of its own."""

    process: subprocess.Popen[bytes]
    json_file: Path
    stderr_file: Path

    def wait(self, timeout_s: float = PATIENCE_S) -> int:
        """Exit code."""
        return self.process.wait(timeout_s)

    @property
    def stderr(self) -> str:
        """What it has written to stderr so far."""
        return self.stderr_file.read_text()

    @property
    def report(self) -> dict[str, Any]:
        """The content of its `--json`."""
        report: dict[str, Any] = json.loads(self.json_file.read_text())
        return report

    @property
    def recording(self) -> Path:
        """The finished recording that its report names."""
        return Path(self.report["recording"])

    @cached_property
    def motion_pid(self) -> int:
        """The process that holds the robot: the child whose spawned main is none of multiprocessing's own."""
        return next(pid for pid in family(self.process.pid) if "spawn_main" in command_of(pid))

    @property
    def newest(self) -> tuple[Phase, float]:
        """Phase of the newest tick, and how long ago it was."""
        rows = self.ring.read(max(0, self.ring.published - 1))[0]
        return (Phase(int(rows[-1]["phase"])), time.monotonic() - float(rows[-1]["now_s"])) if len(rows) else (Phase.IDLE, 0.0)

    @property
    def phase(self) -> Phase:
        """Of the newest tick."""
        return self.newest[0]

    @cached_property
    def ring(self) -> Ring:
        """Of the run under way."""
        return ring_of(self.process.pid)

    @cached_property
    def recorder_pid(self) -> int:
        """The process that writes the file."""
        return next(pid for pid in family(self.process.pid) if "palpd.recording.recorder" in command_of(pid))


@dataclass(frozen=True)
class EmulatedCell:
    """An emulated cell that stays, and a configuration wired to it with a folder of its own."""

    wires: Emulated
    model: str
    folder: Path
    blocks: dict[str, dict[str, Any]] = field(default_factory=dict)
    environment: dict[str, str] = field(default_factory=dict)
    """Of the daemon, besides what this process has."""

    def anew(self, folder: Path, stiffness_N_per_m: float = 1000.0, **blocks: dict[str, Any]) -> "EmulatedCell":
        """The same cell for another test: controller restarted, sensor plugged in, arm at rest 8 mm above a wall."""
        self.wires.ask("replug")
        self.wires.ask("refuse_version", on=False)
        self.wires.ask("restart", s=0.1)
        fresh = EmulatedCell(self.wires, self.model, folder, blocks)
        fresh.wall(ABOVE_M, stiffness_N_per_m)
        time.sleep(0.3)
        fresh.wall(ABOVE_M, stiffness_N_per_m)
        fresh.truth(reset=True)
        return fresh

    @property
    def config(self) -> Path:
        """config.yaml."""
        settings: dict[str, Any] = {
            "robot": {"host": self.wires.host, "model": self.model},
            "sensor": {"port": self.wires.sensor},
            "paths": {"runs": "runs", "state": "state", "write_reports": False},
        }
        for name, block in self.blocks.items():
            settings[name] = settings.get(name, {}) | block
        path = self.folder / "config.yaml"
        path.write_text(yaml.safe_dump(settings))
        return path

    @property
    def part(self) -> Path:
        """The unfinished recording."""
        return next((self.folder / "runs").glob("*.part"))

    def palpd(self, *arguments: str | Path, patience_s: float = PATIENCE_S) -> subprocess.CompletedProcess[str]:
        """Carry out a command to its end."""
        command = [sys.executable, "-m", "palpd", *map(str, arguments)]
        return subprocess.run(command, capture_output=True, text=True, timeout=patience_s, check=False)

    def calibrate(self, patience_s: float = PATIENCE_S) -> Path:
        """Take a reference tare, and return its file. Raises AssertionError with what the command said."""
        done = self.palpd("calibrate", "--config", self.config, patience_s=patience_s)
        assert done.returncode == 0, done.stderr
        return self.folder / "state" / "calibration.json"

    def run(self, plan: dict[str, Any], take_reference: bool = True) -> Daemon:
        """`palpd run` of a plan, under way; the reference tare is taken at its start, or the kept one used."""
        plan_file, json_file = self.folder / "plan.yaml", self.folder / "run.json"
        plan_file.write_text(yaml.safe_dump(plan))
        command = [sys.executable, "-m", "palpd", "run", "--config", str(self.config), "--plan", str(plan_file), "--json", str(json_file)]
        command += ["--take-reference"] if take_reference else []
        stderr_file = self.folder / "stderr.txt"
        with stderr_file.open("wb") as stderr:
            environment = os.environ | self.environment
            process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=stderr, start_new_session=True, env=environment)
        return Daemon(process, json_file, stderr_file)

    def wall(self, below_m: float, stiffness_N_per_m: float) -> float:
        """Place a wall below the tip and return its height."""
        z_m = self.truth()["tip_z_m"] - below_m
        self.wires.ask("wall", z_m=z_m, stiffness_N_per_m=stiffness_N_per_m)
        return z_m

    def truth(self, **arguments: Any) -> dict[str, float]:
        """Where the tip is and what it feels."""
        return self.wires.ask("truth", **arguments)

    def lateness_s(self, since_s: float = 0.0, lasting_s: float = 60.0) -> float:
        """How late the emulator itself was at worst in that time: what the machine, not the daemon, adds to a figure."""
        ago_s = max(0.0, time.monotonic() - since_s - lasting_s)
        return float(self.wires.ask("stats", s=lasting_s, ago_s=ago_s if since_s else 0.0)["late_us_max"]) * 1e-6

    def log(self, since_s: float) -> list[TruthSample]:
        """What the controller did since then."""
        return self.wires.log(since_s)

    def stops(self, since_s: float) -> list[tuple[float, str]]:
        """When the controller ended its program or stopped, and why."""
        return [(t_s, reason) for t_s, reason in self.wires.ask("log", since_s=since_s)["stops"]]

    def until_contact(self, daemon: Daemon, force_N: float) -> None:
        """Wait for that much true force.

        Raises:
            AssertionError: The daemon has ended, and why.
        """

        def pressed() -> bool:
            if daemon.process.poll() is not None:
                raise AssertionError(f"exit code {daemon.process.returncode}: {daemon.stderr}")
            return self.truth()["contact_N"] >= force_N

        until(pressed, f"a contact of {force_N:g} N")

    def rest_after_s(self, since_s: float, settle_s: float = 0.6) -> float:
        """How long after `since_s` the target speed became zero for good; looked at `settle_s` after it.

        The last ramp ends within a cycle: from speed v to rest over the way d takes 2d/v.
        """
        time.sleep(max(0.0, since_s + settle_s - time.monotonic()))
        samples = self.log(since_s - 0.1)
        last = max((index for index, sample in enumerate(samples) if sample.speed_m_per_s > 0.0), default=0)
        assert samples[last].t_s < since_s + settle_s - 0.1, "the arm still moves"
        ramp, rest = samples[last : last + 2]
        ramp_s = 2.0 * abs(rest.target_z_m - ramp.target_z_m) / ramp.speed_m_per_s if ramp.speed_m_per_s else 0.0
        return ramp.t_s + min(ramp_s, rest.t_s - ramp.t_s) - since_s

    def way_after_m(self, since_s: float) -> float:
        """How far the tip went down after `since_s`."""
        samples = self.log(since_s - 0.1)
        at_m = float(np.interp(since_s, [sample.t_s for sample in samples], [sample.tip_z_m for sample in samples]))
        return at_m - min(sample.tip_z_m for sample in samples if sample.t_s >= since_s)


T = TypeVar("T")


def retry_if_machine_stalled(cell: Callable[[], EmulatedCell], attempt: Callable[[EmulatedCell], T]) -> T:
    """Repeat an attempt whose assertion fails while the machine itself stood still; return what the good attempt returns.

    An attempt that failed since the sensor was silent is repeated, too: where the kernel holds up the bytes of the emulated serial line,
    the emulator's lateness shows nothing of it. A silence of palpd's own making comes again.
    """
    for left in reversed(range(ATTEMPTS)):
        wired, began_s = cell(), time.monotonic()
        try:
            return attempt(wired)
        except AssertionError as error:
            held_up = "the sensor was silent" in str(error)
            if not left or not (held_up or wired.lateness_s(lasting_s=time.monotonic() - began_s) > STALLED_S):
                raise
    raise AssertionError("no attempt was made")


@dataclass(frozen=True)
class WallOutcome:
    """Outcome of a press into a wall that nobody had announced; forces in N."""

    code: int
    report: dict[str, Any]
    stderr: str
    predicted_overshoot_N: float
    true_peak_N: float
    seen_peak_N: float  # largest compensated force that the daemon saw
    left_at: dict[str, float]  # truth half a second after the end


def press_into_wall(cell: EmulatedCell, stiffness_N_per_m: float, speed_m_per_s: float, take_reference: bool = True) -> WallOutcome:
    """Palpate something soft; when its surface has been found and the tip is above it again, put the wall there, 3 mm below the tip.

    The wall stands above the surface that the daemon knows, so that nothing it has learned makes it slow down.
    """
    cell.wall(0.004, SOFT_N_PER_M)
    plan = PRESS | {"press_speed_m_per_s": speed_m_per_s, "depths_m": [0.02], "search": {"speed_m_per_s": 0.005, "max_travel_m": 0.03}}
    printed, plan_file = cell.folder / "check.json", cell.folder / "plan.yaml"
    plan_file.write_text(yaml.safe_dump(plan))
    checked = CliRunner().invoke(app, ["check-config", str(cell.config), "--plan", str(plan_file), "--json", str(printed)])
    assert checked.exit_code == 0, checked.output
    daemon = cell.run(plan, take_reference)
    cell.until_contact(daemon, 0.1)
    until(lambda: daemon.phase == Phase.BASELINE, "the tip rests above the surface it has found")
    cell.wall(0.003, stiffness_N_per_m)
    cell.truth(reset=True)
    code = daemon.wait()
    peak_N = cell.truth()["peak_contact_N"]
    time.sleep(0.5)
    rows = Recording.load(daemon.recording).rows
    overshoots = json.loads(printed.read_text())["overshoot"]
    of = {(entry["stiffness_N_per_m"], entry["speed_m_per_s"]): entry["overshoot_N"] for entry in overshoots}
    predicted_N = of[stiffness_N_per_m, speed_m_per_s]
    return WallOutcome(code, daemon.report, daemon.stderr, predicted_N, peak_N, float(rows["force_N"].max()), cell.truth())


@contextmanager
def emulated_cell(folder: Path, model: str = "ur5", cell: Path | None = None, *options: str) -> Iterator[EmulatedCell]:
    """An emulated cell in a process of its own on an address of its own.

    Args:
        folder: Where its device and its control socket stand.
        model: "ur5" at 125 Hz, or "ur5e" at 500 Hz.
        cell: Cell file; None: the phantom of the paper.
        options: More options of `python -m hw.emulators`.
    """
    host = f"127.{os.getpid() % 250 + 2}.{os.getpid() // 250 % 250}.{next(_hosts) % 250 + 2}"  # no other test process has it
    with started(folder, model, cell, host, *options) as wires:
        yield EmulatedCell(wires, model, folder)
