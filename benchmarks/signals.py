"""Signals at random moments of every command that moves the arm: when the arm rests, when the process is gone, whether the reason is true.

`python -m benchmarks.signals [--samples 100] [--only run,serve] [--minutes 60] [--json FILE]`. The moment is uniform over the life of the
command, start and shut-down included. The emulated controller's log says when the arm rests. Results are added to FILE, so that a
measurement can be interrupted and continued; the table is made of all of FILE. Ends with 1 where something was not kept.
"""

import argparse
import contextlib
import json
import os
import pty
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

from benchmarks.emulated_cell import ABOVE_M, PRESS, EmulatedCell, emulated_cell, family
from palpd.daemon.socket_client import ask
from palpd.errors import PalpdError
from palpd.recording.reader import Recording

REST_TARGET_S = 0.150
GONE_TARGET_S = 1.0
PATIENCE_S = 60.0
CALIBRATION = "calibration.json"
SETTLE_S = 0.6
"""Time after the end of the main process in which its helpers (the keeper of the shared memory) may end too."""
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
    """What one signal led to. `rest_s` is None where the emulated cell belongs to the command and ended with it."""

    command: str
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


def interrupted(cell: EmulatedCell, command: str, name: str, moment_s: float) -> SignalOutcome | None:
    """Start a command, send it a signal, and judge its end.

    Args:
        cell: The cell, ready.
        command: One of `COMMANDS`.
        name: One of `SIGNALS`.
        moment_s: When, s after the start of the process.

    Returns:
        The outcome; None where the command was over before the signal.
    """
    process, terminal, stderr = _begin(cell, command)
    window = Reader(terminal)
    if command == "serve":
        threading.Thread(target=_operate, args=(cell, process), daemon=True).start()
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(moment_s)
        window.close()
        return None
    sent_s = _send(process, window, name)
    try:
        code = process.wait(PATIENCE_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        code = process.wait()
    gone_s = time.monotonic() - sent_s
    window.close()
    rest_s = None if command == "demo" else max(0.0, cell.rest_after_s(sent_s, settle_s=max(0.6, gone_s)))
    sentence = stderr.read_text()
    time.sleep(max(0.0, sent_s + gone_s + SETTLE_S - time.monotonic()))
    left = family(process.pid)
    objections = _objections(cell, command, moment_s, code, sentence) + ([f"{len(left)} processes are left"] if left else [])
    late = [f"rest after {rest_s * 1e3:.0f} ms"] if rest_s is not None and rest_s > REST_TARGET_S else []
    late += [f"gone after {gone_s:.2f} s"] if gone_s > GONE_TARGET_S else []
    why = "; ".join(objections + late)
    return SignalOutcome(command, name, moment_s, rest_s, gone_s, code, sentence[-300:], why, os.getloadavg()[0])


def _objections(cell: EmulatedCell, command: str, moment_s: float, code: int, sentence: str) -> list[str]:
    """What is not as the pages say, times aside."""
    if moment_s < STARTING_S and "palpd:" not in sentence:
        return []  # Python itself was interrupted
    objections = ["a traceback"] if "Traceback" in sentence else []
    if code == 130 and "interrupted by" not in sentence:
        objections.append("no reason is given")
    if code == 3 and "operator aborted the run (interrupted by" not in sentence:
        objections.append("another reason is given")
    finished = code == 0 and not sentence  # the signal came in Python's own shutdown, when all was done
    if code not in (0, 3, 130) or (code == 0 and command != "serve" and not finished):
        objections.append(f"exit code {code}")
    runs = cell.folder / "runs"
    objections += [f"{part.name} is unfinished" for part in runs.glob("*.part")]
    for path in runs.glob("*.mcap"):
        try:
            Recording.load(path)
        except PalpdError as error:
            objections += [] if "no tick" in str(error) else [f"{path.name} cannot be read: {error}"]
    return objections


def life_s(cell: EmulatedCell, command: str) -> float:
    """How long a command lives without a signal; the service, until it has pressed for some seconds."""
    began_s = time.monotonic()
    process, terminal, _ = _begin(cell, command)
    window = Reader(terminal)
    if command == "serve":
        _operate(cell, process)
        time.sleep(6.0)
    else:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(PATIENCE_S)
    lived_s = time.monotonic() - began_s
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGTERM)
        process.wait(PATIENCE_S)
    window.close()
    return lived_s


def table(outcomes: Sequence[dict[str, Any]]) -> list[str]:
    """Lines of a markdown table, one row a command."""
    lines = ["| command | n | rest p50, ms | p99 | max | gone p50, s | p99 | max | not kept |", "|---|---|---|---|---|---|---|---|---|"]
    for command in COMMANDS:
        of_command = [outcome for outcome in outcomes if outcome["command"] == command]
        if not of_command:
            continue
        rests_ms = [outcome["rest_s"] * 1e3 for outcome in of_command if outcome["rest_s"] is not None]
        rest = " | ".join(f"{value:.0f}" for value in _spread(rests_ms)) if rests_ms else "– | – | –"
        gone = " | ".join(f"{value:.2f}" for value in _spread([outcome["gone_s"] for outcome in of_command]))
        broken = sum(bool(outcome["why"]) for outcome in of_command)
        lines.append(f"| {command} | {len(of_command)} | {rest} | {gone} | {broken} |")
    loads = [outcome["load"] for outcome in outcomes]
    return [*lines, "", f"{os.cpu_count()} cores, load {min(loads):.1f} to {max(loads):.1f} (median {np.median(loads):.1f})."]


def _spread(values: Sequence[float]) -> tuple[float, float, float]:
    return float(np.median(values)), float(np.percentile(values, 99)), max(values)


def measure(commands: Sequence[str], samples: int, end_s: float, kept: Path, folder: Path) -> None:
    """Interrupt each command until FILE holds that many samples of it, in turn.

    Args:
        commands: Names of `COMMANDS`.
        samples: Number of samples a command.
        end_s: Host time after which no sample is begun.
        kept: File that takes a line a sample.
        folder: Folder for the files of the commands.
    """
    with emulated_cell(folder) as base:
        first = base.anew(folder)
        assert first.palpd("calibrate", "--config", first.config).returncode == 0

        def fresh() -> EmulatedCell:
            own = Path(tempfile.mkdtemp(prefix="signal-", dir=folder))
            (own / "state").mkdir()
            shutil.copy(folder / "state" / CALIBRATION, own / "state" / CALIBRATION)
            return base.anew(own, safety={"contact_limit_N": 16.0})

        lives_s: dict[str, float] = {}
        for number in range(samples):
            for command in commands:
                have = sum(json.loads(line)["command"] == command for line in kept.read_text().splitlines()) if kept.exists() else 0
                if have > number:
                    continue
                if time.monotonic() > end_s:
                    return
                if command not in lives_s:
                    lives_s[command] = life_s(fresh(), command)
                outcome = interrupted(fresh(), command, random.choice(SIGNALS), random.uniform(0.0, lives_s[command]))
                if outcome is not None:
                    with kept.open("a") as file:
                        file.write(json.dumps(asdict(outcome)) + "\n")
                    print(
                        f"{command} {outcome.signal} at {outcome.moment_s:.2f} s of {lives_s[command]:.1f}: code {outcome.code}, "
                        f"gone {outcome.gone_s:.2f} s, rest {outcome.rest_s}; {outcome.why or 'kept'}",
                        flush=True,
                    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=100, help="a command")
    parser.add_argument("--only", help="commands, separated by commas")
    parser.add_argument("--minutes", type=float, default=600.0, help="no sample is begun after that")
    parser.add_argument("--json", type=Path, help="results are added to this file")
    options = parser.parse_args()
    commands = options.only.split(",") if options.only else list(COMMANDS)
    with tempfile.TemporaryDirectory() as name:
        kept = options.json or Path(name) / "signals.jsonl"
        measure(commands, options.samples, time.monotonic() + options.minutes * 60.0, kept, Path(name))
        outcomes = [json.loads(line) for line in kept.read_text().splitlines()] if kept.exists() else []
    if outcomes:
        print("\n".join(table(outcomes)))
    for outcome in outcomes:
        if outcome["why"]:
            print(f"not kept: {outcome['command']}, {outcome['signal']} at {outcome['moment_s']:.2f} s: {outcome['why']}")
    sys.exit(1 if any(outcome["why"] for outcome in outcomes) else 0)


if __name__ == "__main__":
    main()
