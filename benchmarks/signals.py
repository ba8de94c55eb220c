"""Signals at random moments of every command that moves the arm: when the arm rests, when the process is gone, whether the reason is true.

`python -m benchmarks.signals [--samples 100] [--parallel 2] [--only run,serve] [--minutes 60] [--json FILE]`. The moment is random: in the
start of the command, in the first seconds of its motion, or in its shut-down (`STAGES`). The emulated controller's log says when the arm
rests. Results are added to FILE, so that a measurement can be interrupted and continued; the column "measured" of docs/faults.md is made of
all of FILE. Some 7 s a sample on a quiet machine. Ends with 1 where something was not kept.
"""

import argparse
import contextlib
import json
import os
import pty
import queue
import random
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from benchmarks.measured_column import FAULTS, condition, fill, results_in, spread
from hw.emulators.controller import TruthSample
from hw.emulators.process import Emulated
from palpd.daemon.socket_client import ask
from palpd.errors import PalpdError
from palpd.recording.reader import Recording
from palpd.testing.emulated_cell import ABOVE_M, PATIENT, PRESS, EmulatedCell, emulated_cell
from palpd.testing.processes import family, side_by_side, take_signals

REST_TARGET_S = 0.150
GONE_TARGET_S = 1.0
PATIENCE_S = 60.0
SETTLE_S = 0.6
"""Time after the end of the main process in which its helpers (the keeper of the shared memory) may end too."""
STAGES = {"start": 0.65, "motion": 0.31, "end": 0.04}
"""Share of the signals that come before the loop runs, in the first `MOTION_S` of it, and after its recording was closed.

Every moment of a long motion is like another, and the end of a long command costs a minute, so these are not drawn by their lengths."""
MOTION_S = 4.0
END_S = 1.5
RIGID_N_PER_M = 20000.0
"""Stiffness of the plate for `palpd stiffness`."""
STARTING_S = 0.5
"""Python's own start, before the first line of palpd. A signal then ends Python by its own rules; nothing has been opened."""

Arguments = Callable[[EmulatedCell], list[str]]


def _plan(cell: EmulatedCell) -> str:
    path = cell.folder / "plan.yaml"
    path.write_text(yaml.safe_dump(PRESS))
    return str(path)


def _with_tissue(cell: EmulatedCell) -> str:
    """A configuration whose cell file knows the height of the tissue, as the diagnosis needs it."""
    settings = yaml.safe_load(cell.config.read_text()) | {"cell": {"tissue": {"surface_z_m": cell.truth()["tip_z_m"] - ABOVE_M}}}
    path = cell.folder / "tissue.yaml"
    path.write_text(yaml.safe_dump(settings))
    return str(path)


COMMANDS: dict[str, Arguments] = {
    "run": lambda cell: ["run", "--config", str(cell.config), "--plan", _plan(cell), "--json", str(cell.folder / "run.json")],
    "calibrate": lambda cell: ["calibrate", "--config", str(cell.config)],
    "free-motion": lambda cell: ["free-motion", "--config", str(cell.config), "--out", str(cell.folder / "runs" / "free.mcap")],
    "stiffness": lambda cell: ["stiffness", "--config", str(cell.config)],
    "map": lambda cell: ["map", "--config", str(cell.config), "--out", str(cell.folder / "map.png")],
    "resolve": lambda cell: [
        "resolve", "--config", _with_tissue(cell), "--plan", _plan(cell), "--rounds", "1", "--yes", "--out", str(cell.folder / "runs"),
    ],
    "demo": lambda cell: ["demo", "--out", str(cell.folder / "runs")],
    "serve": lambda cell: ["serve", "--config", str(cell.config)],
}  # fmt: skip
SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP", "Ctrl-C", "terminal closed", "SIGINT twice")


@dataclass(frozen=True)
class SignalOutcome:
    """What one signal led to. `rest_s` is None where the emulated cell of the command itself was not there yet, or was gone before."""

    command: str
    stage: str
    signal: str
    moment_s: float
    rest_s: float | None
    gone_s: float
    code: int
    sentence: str
    why: str
    load: float


def _begin(cell: EmulatedCell, command: str) -> tuple[subprocess.Popen[bytes], int, Path]:
    """Start a command on a terminal of its own, and return the process, our side of the terminal, and the file of its stderr."""
    ours, theirs = pty.openpty()
    stderr = cell.folder / "stderr.txt"
    # setsid --ctty makes it the terminal's foreground group: a keystroke and a closed terminal reach it as at a desk
    arguments = ["setsid", "--ctty", sys.executable, "-m", "palpd", *COMMANDS[command](cell)]
    with stderr.open("wb") as file:
        process = subprocess.Popen(arguments, stdin=theirs, stdout=theirs, stderr=file, cwd=cell.folder)
    os.close(theirs)
    return process, ours, stderr


class Reader:
    """Reads our side of a terminal and drops what it reads, as a window does, until it is closed."""

    def __init__(self, terminal: int) -> None:
        self.terminal, self._over = terminal, threading.Event()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        with contextlib.suppress(OSError):  # the other side is closed
            while not self._over.is_set():
                if select.select([self.terminal], [], [], 0.02)[0]:
                    os.read(self.terminal, 65536)

    def close(self) -> None:
        """Close the window."""
        if not self._over.is_set():
            self._over.set()
            self._thread.join()
            os.close(self.terminal)


class OwnCell:
    """Keeps the log of an emulated cell that belongs to a command, and ends with it."""

    def __init__(self, control: Path) -> None:
        self._wires, self._since_s = Emulated("", "", 0, control), time.monotonic() - 0.1
        self._samples: list[TruthSample] = []
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        with contextlib.suppress(OSError, ValueError, RuntimeError):  # it has ended, or was not there yet
            while True:
                self._samples += self._wires.log(self._samples[-1].t_s if self._samples else self._since_s)
                time.sleep(0.01)

    def rest_s(self, sent_s: float) -> float | None:
        """Time from `sent_s` to a target speed of zero; None where there was no cell, or it ended before."""
        self._thread.join(PATIENCE_S)
        if not self._samples or self._samples[-1].speed_m_per_s > 0.0:
            return None
        moving_s = [sample.t_s for sample in self._samples if sample.speed_m_per_s > 0.0]
        return max(0.0, moving_s[-1] - sent_s) if moving_s else 0.0


def _operate(cell: EmulatedCell, process: subprocess.Popen[bytes]) -> None:
    """Arm the service and start a plan as soon as it listens."""
    socket = cell.folder / "state" / "palpd.sock"
    while process.poll() is None:
        with contextlib.suppress(PalpdError, OSError):
            ask(socket, {"do": "arm"}, 20.0)
            ask(socket, {"do": "start", "plan": PRESS | {"repeats": 3}})
            return
        time.sleep(0.2)


def _send(process: subprocess.Popen[bytes], window: Reader, name: str) -> float:
    """Send the signal as a shell, a keyboard or a closed window does, and return when."""
    sent_s = time.monotonic()
    with contextlib.suppress(ProcessLookupError, OSError):
        if name == "Ctrl-C":
            os.write(window.terminal, b"\x03")
        elif name == "terminal closed":
            window.close()
        elif name == "SIGTERM":
            os.kill(process.pid, signal.SIGTERM)
        else:
            os.killpg(process.pid, signal.SIGHUP if name == "SIGHUP" else signal.SIGINT)
            if name.endswith("twice"):
                time.sleep(random.uniform(0.0, 0.3))
                os.killpg(process.pid, signal.SIGINT)
    return sent_s


def _awaited(cell: EmulatedCell, process: subprocess.Popen[bytes], stage: str, start_s: float) -> float | None:
    """Wait until a random moment of the stage. Returns when it was, s after the start of the process; None where that ended before."""
    began_s = time.monotonic()
    until_s = began_s + random.uniform(0.0, start_s)
    if stage != "start":
        suffix = "*.part" if stage == "motion" else "*.mcap"
        while not any((cell.folder / "runs").rglob(suffix)):
            if process.poll() is not None or time.monotonic() > began_s + PATIENCE_S:
                return None
            time.sleep(0.01)
        until_s = time.monotonic() + random.uniform(0.0, MOTION_S if stage == "motion" else END_S)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(max(0.0, until_s - time.monotonic()))
        return None
    return time.monotonic() - began_s


def interrupted(cell: EmulatedCell, command: str, name: str, stage: str, start_s: float) -> SignalOutcome | None:
    """Start a command, send it a signal, and judge its end.

    Args:
        cell: The cell, ready.
        command: One of `COMMANDS`.
        name: One of `SIGNALS`.
        stage: One of `STAGES`.
        start_s: How long the command takes to start.

    Returns:
        The outcome; None where the command was over before the signal.
    """
    process, terminal, stderr = _begin(cell, command)
    window = Reader(terminal)
    if command == "serve":
        threading.Thread(target=_operate, args=(cell, process), daemon=True).start()
    moment_s = _awaited(cell, process, stage, start_s)
    if moment_s is None:
        _end(process)
        window.close()
        return None
    own_cell = OwnCell(cell.folder / "runs" / "control") if command == "demo" else None
    sent_s = _send(process, window, name)
    try:
        code = process.wait(PATIENCE_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        code = process.wait()
    gone_s = time.monotonic() - sent_s
    window.close()
    rest_s = own_cell.rest_s(sent_s) if own_cell is not None else max(0.0, cell.rest_after_s(sent_s, settle_s=max(0.6, gone_s)))
    sentence = stderr.read_text()
    time.sleep(max(0.0, sent_s + gone_s + SETTLE_S - time.monotonic()))
    left = family(process.pid)
    objections = _objections(cell, command, moment_s, code, sentence) + ([f"{len(left)} processes are left"] if left else [])
    return SignalOutcome(command, stage, name, moment_s, rest_s, gone_s, code, sentence[-300:], "; ".join(objections), os.getloadavg()[0])


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a command that is not measured."""
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGTERM)
        process.wait(PATIENCE_S)


def _objections(cell: EmulatedCell, command: str, moment_s: float, code: int, sentence: str) -> list[str]:
    """What is not as the pages say, times aside."""
    if moment_s < STARTING_S and "palpd:" not in sentence:
        return []  # Python itself was interrupted
    objections = ["a traceback"] if "Traceback" in sentence else []
    if code > 128 and "interrupted by" not in sentence:
        objections.append("no reason is given")
    if code == 3 and "operator aborted the run (interrupted by" not in sentence:
        objections.append("another reason is given")
    finished = code == 0 and not sentence  # the signal came in Python's own shutdown, when all was done
    if code not in (0, 3, 130, 143, 129) or (code == 0 and command != "serve" and not finished):
        objections.append(f"exit code {code}")
    runs = cell.folder / "runs"
    objections += [f"{part.name} is unfinished" for part in runs.glob("*.part")]
    for path in runs.glob("*.mcap"):
        try:
            Recording.load(path)
        except PalpdError as error:
            objections += [] if "no tick" in str(error) else [f"{path.name} cannot be read: {error}"]
    return objections


def start_s(cell: EmulatedCell, command: str) -> float:
    """How long a command takes until its loop runs; of one without a recording, its whole life.

    Args:
        cell: The cell, ready.
        command: One of `COMMANDS`.

    Returns:
        The time.
    """
    began_s = time.monotonic()
    process, terminal, _ = _begin(cell, command)
    window = Reader(terminal)
    if command == "serve":
        threading.Thread(target=_operate, args=(cell, process), daemon=True).start()
    while process.poll() is None and not any((cell.folder / "runs").rglob("*.part")) and time.monotonic() < began_s + PATIENCE_S:
        time.sleep(0.01)
    lasted_s = time.monotonic() - began_s
    _end(process)
    window.close()
    return lasted_s


class SignalBench:
    """Emulated cells side by side, and what signals led to in them."""

    def __init__(self, kept: Path, end_s: float) -> None:
        self.todo: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._kept, self._end_s, self._lock = kept, end_s, threading.Lock()
        self._starts_s: dict[str, float] = {}

    def work(self, folder: Path) -> None:
        """Interrupt commands in one cell until the list is empty or the time is over."""
        with emulated_cell(folder) as base:
            calibration = base.anew(folder).calibrate()

            def fresh(command: str) -> EmulatedCell:
                own = Path(tempfile.mkdtemp(prefix="signal-", dir=folder))
                (own / "state").mkdir()
                shutil.copy(calibration, own / "state")
                rigid = {"stiffness_N_per_m": RIGID_N_PER_M} if command == "stiffness" else {}
                return base.anew(own, **rigid, **PATIENT)

            while time.monotonic() < self._end_s:
                try:
                    command = self.todo.get_nowait()
                except queue.Empty:
                    return
                try:
                    self._do(lambda: fresh(command), command)  # noqa: B023 - called before the next command
                except (AssertionError, OSError, RuntimeError) as error:  # the machine, or a run that ended by itself: no figure
                    print(f"{command}: nothing was measured ({error})", file=sys.stderr, flush=True)
                    self.todo.put(command)

    def _do(self, fresh: Callable[[], EmulatedCell], command: str) -> None:
        if command not in self._starts_s:
            self._starts_s[command] = start_s(fresh(), command)
        stage = "start" if command == "calibrate" else random.choices(list(STAGES), list(STAGES.values()))[0]
        outcome = interrupted(fresh(), command, random.choice(SIGNALS), stage, self._starts_s[command])
        if outcome is None:
            self.todo.put(command)
            return
        with self._lock, self._kept.open("a") as file:
            file.write(json.dumps(asdict(outcome)) + "\n")
        rest = "not known" if outcome.rest_s is None else f"{outcome.rest_s * 1e3:.0f} ms"
        print(
            f"{command}, {stage}, {outcome.signal} at {outcome.moment_s:.2f} s: code {outcome.code}, rest {rest}, "
            f"gone {outcome.gone_s:.2f} s {outcome.why}",
            flush=True,
        )


def write_table(outcomes: Sequence[dict[str, Any]]) -> bool:
    """Fill the column "measured" of docs/faults.md, and say whether everything was kept.

    Args:
        outcomes: All results.

    Returns:
        The verdict.
    """
    cells, kept = {}, True
    for command in COMMANDS:
        of_command = [outcome for outcome in outcomes if outcome["command"] == command]
        if not of_command:
            continue
        rests_ms = [outcome["rest_s"] * 1e3 for outcome in of_command if outcome["rest_s"] is not None]
        gone_s = [outcome["gone_s"] for outcome in of_command]
        broken = sum(bool(outcome["why"]) for outcome in of_command)
        late = (["rest"] if rests_ms and np.percentile(rests_ms, 99) > REST_TARGET_S * 1e3 else []) + (
            ["gone"] if np.percentile(gone_s, 99) > GONE_TARGET_S else []
        )
        rest = f"rest {spread(rests_ms, 0)} ms; " if rests_ms else ""
        notes = f"; **{broken} not kept**" * bool(broken) + f"; **p99 of {' and '.join(late)} not kept**" * bool(late)
        cells[f"palpd {command}"] = f"{rest}gone {spread(gone_s, 2)} s; n {len(of_command)}{notes}"
        kept = kept and not broken and not late
    fill(FAULTS, cells, "Signals measured", condition([outcome["load"] for outcome in outcomes], f"{len(outcomes)} signals"))
    return kept


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=100, help="a command")
    parser.add_argument("--parallel", type=int, default=2, help="emulated cells at a time")
    parser.add_argument("--only", help="commands, separated by commas")
    parser.add_argument("--minutes", type=float, default=600.0, help="no sample is begun after that")
    parser.add_argument("--json", type=Path, help="results are added to this file")
    options = parser.parse_args()
    take_signals()
    commands = options.only.split(",") if options.only else list(COMMANDS)
    with tempfile.TemporaryDirectory() as name:
        kept = options.json or Path(name) / "signals.jsonl"
        have = [result["command"] for result in results_in(kept)]
        bench = SignalBench(kept, time.monotonic() + options.minutes * 60.0)
        for number in range(options.samples):
            for command in commands:
                if have.count(command) <= number:
                    bench.todo.put(command)
        side_by_side(bench.work, Path(name), options.parallel)
        outcomes = results_in(kept)
    for outcome in outcomes:
        if outcome["why"]:
            print(
                f"not kept: {outcome['command']}, {outcome['stage']}, {outcome['signal']} at {outcome['moment_s']:.2f} s: {outcome['why']}"
            )
    sys.exit(0 if outcomes and write_table(outcomes) else 1)


if __name__ == "__main__":
    main()
