"""How long `palpd setup` takes from an empty folder to the first press, on an emulated cell and without an edited file.

`python -m benchmarks.setup [--model ur5e]`. The command runs in a process of its own. An operator types the answers, hangs the weight,
and puts plate and tissue below the probe. Prints what the operator read. Ends with 1 where a step failed or it took too long.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from palpd.testing.emulated_cell import PATIENT, EmulatedCell, emulated_cell

TARGET_S = 300.0
PATIENCE_S = 120.0
"""Longest wait for the next question."""
TRIES = 3
"""How often the operator goes again where this PC stood still."""
WEIGHT_N = 5.0
TOOL_KG = 0.4
"""Sensor and probe of the emulated cell."""
OF_THIS_PC = ("kernel", "wake-up", "FIFO", "memory lock", "idle", "limits", "governor", "disk", "RTDE jitter", "sensor frames")
"""Findings that depend on how busy this PC is; it also does the work of robot and sensor here."""
PLATE_N_PER_M, TISSUE_N_PER_M = 100_000.0, 1000.0
"""As the arm feels them: the machine gives way on the plate, the emulated arm does not."""


@dataclass(frozen=True)
class SetupSession:
    """What one call of `palpd setup` showed: its text, its exit code, its duration, and the commission that it kept."""

    text: str
    exit_code: int
    duration_s: float
    steps: Mapping[str, Any]

    def complaints(self) -> list[tuple[str, Mapping[str, Any]]]:
        """Step and finding of all that is not ok and is not this PC's."""
        return [
            (name, finding)
            for name, step in self.steps.items()
            for finding in step["findings"]
            if finding["verdict"] != "ok" and finding["name"] not in OF_THIS_PC
        ]


def operate(
    cell: EmulatedCell, folder: Path, *options: str, again: bool = True, until: str = "", plate_N_per_m: float = PLATE_N_PER_M
) -> SetupSession:
    """Carry out `palpd setup` as an operator who answers everything.

    Args:
        folder: Folder of the cell.
        options: Further options.
        again: Whether a failed step is tried again.
        until: Name of the step at which the operator stops; empty: the last.
        plate_N_per_m: Stiffness that the arm feels on the plate.
    """
    quiet = {key: value for key, value in PATIENT["safety"].items() if key != "contact_limit_N"}
    environment = os.environ | {"PALPD_ROBOT": json.dumps(PATIENT["robot"]), "PALPD_SAFETY": json.dumps(quiet)}
    command = [sys.executable, "-m", "palpd", "setup", str(folder), "--robot", cell.wires.host, "--sensor", cell.wires.sensor, *options]
    began_s, text, tries = time.monotonic(), "", 0
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=environment)
    assert process.stdin is not None
    assert process.stdout is not None
    os.set_blocking(process.stdout.fileno(), False)
    pending, heard_s = "", time.monotonic()
    while process.poll() is None:
        piece = process.stdout.read()
        if piece:
            heard_s = time.monotonic()
            text += piece.decode()
            pending += piece.decode()
        if pending.endswith(" > "):
            lines = pending.splitlines()
            question, pending = lines[-1], ""
            failed = "has failed" in "".join(lines[-3:])
            tries += failed
            step = next((line.split()[1].rstrip(":") for line in reversed(text.splitlines()) if line[:1].isdigit()), "")
            if "What now?" in question:
                answer = _decision(question, step, until, not failed or (again and tries < TRIES))
            else:
                answer = _answer(cell, question, plate_N_per_m)
            text += answer + "\n"
            process.stdin.write(answer.encode() + b"\n")
            process.stdin.flush()
        elif not piece:
            if time.monotonic() - heard_s > PATIENCE_S:
                process.kill()
                raise TimeoutError(f"palpd setup asked nothing for {PATIENCE_S:g} s:\n{text[-2000:]}")
            time.sleep(0.02)
    rest = process.stdout.read()
    text += rest.decode() if rest else ""
    kept = folder / "state" / "commission.json"
    return SetupSession(
        text, process.returncode, time.monotonic() - began_s, json.loads(kept.read_text())["steps"] if kept.exists() else {}
    )


def _decision(question: str, step: str, until: str, may_go: bool) -> str:
    if step == until:
        return "stop"
    if step == "service":
        return "skip"
    return "go" if may_go and re.search(r"\bgo\b", question) else "stop"


def _answer(cell: EmulatedCell, question: str, plate_N_per_m: float) -> str:
    """Do what a question asks for, and say so."""
    tip_z_m = cell.truth()["tip_z_m"]
    actions: dict[str, Callable[[], object]] = {
        "Hang": lambda: cell.wires.ask("hang", weight_N=WEIGHT_N),
        "Take the weight off": lambda: cell.wires.ask("hang", weight_N=0.0),
        "Put a rigid plate": lambda: cell.wires.ask("wall", z_m=tip_z_m - 0.003, stiffness_N_per_m=plate_N_per_m),
        "Put the tissue": lambda: cell.wires.ask("wall", z_m=tip_z_m - 0.008, stiffness_N_per_m=TISSUE_N_PER_M),
    }
    for begins, act in actions.items():
        if question.startswith(begins):
            act()
            time.sleep(0.5)
    return {"Mass": f"{TOOL_KG:g}", "Weight": f"{WEIGHT_N:g}"}.get(question.split()[0], "")


def main() -> int:
    """Set an emulated cell up, and print how that went."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", choices=("ur5", "ur5e"), default="ur5")
    model = parser.parse_args().model
    with tempfile.TemporaryDirectory() as folder, emulated_cell(Path(folder), model) as cell:
        session = operate(cell, Path(folder) / "cell")
    print(session.text)
    print(f"{session.duration_s:.0f} s from an empty folder to the first press, target {TARGET_S:g} s; exit code {session.exit_code}")
    done = session.steps.get("press", {}).get("verdict") == "ok"
    return 0 if done and session.duration_s <= TARGET_S else 1


if __name__ == "__main__":
    sys.exit(main())
