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
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.request import Request, urlopen

from palpd.testing.emulated_cell import PATIENT, EmulatedCell, emulated_cell
from palpd.testing.processes import free_port, until

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
    environment = _patient()
    command = [sys.executable, "-m", "palpd", "setup", str(folder), "--robot", cell.wires.host, "--sensor", cell.wires.sensor, *options]
    began_s, text, person = time.monotonic(), "", Person(cell, again, until, plate_N_per_m)
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
            answer, pending = person.answer(pending.splitlines()), ""
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
    return SetupSession(text, process.returncode, time.monotonic() - began_s, _steps(folder))


def _steps(folder: Path) -> Mapping[str, Any]:
    kept = folder / "state" / "commission.json"
    steps: Mapping[str, Any] = json.loads(kept.read_text())["steps"] if kept.exists() else {}
    return steps


def _patient() -> dict[str, str]:
    quiet = {key: value for key, value in PATIENT["safety"].items() if key != "contact_limit_N"}
    return os.environ | {"PALPD_ROBOT": json.dumps(PATIENT["robot"]), "PALPD_SAFETY": json.dumps(quiet)}


@dataclass
class Person:
    """Whoever answers: at a terminal or in the page, and hangs, puts and presses what a question asks for."""

    cell: EmulatedCell
    again: bool = True
    until: str = ""
    plate_N_per_m: float = PLATE_N_PER_M
    step: str = ""
    tries: int = 0

    def answer(self, lines: Sequence[str]) -> str:
        """The answer to the last of these lines; those before it were said since the answer before."""
        self.step = next((line.split()[1].rstrip(":") for line in reversed(lines) if re.match(r"\d+/\d+ \w", line)), self.step)
        failed = "has failed" in "".join(lines[-3:])
        self.tries += failed
        answer = _answer(self.cell, lines[-1], self.plate_N_per_m)
        if "What now?" not in lines[-1]:
            return answer
        if self.step in (self.until, "service"):
            return "stop" if self.step == self.until else "skip"
        may_go = not failed or (self.again and self.tries < TRIES)
        return "go" if may_go and re.search(r"\bgo\b", lines[-1]) else "stop"


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
    if "may it be cleared" in question:
        return "yes"
    return {"Mass": f"{TOOL_KG:g}", "Weight": f"{WEIGHT_N:g}"}.get(question.split()[0], "")


@dataclass(frozen=True)
class SetupPage:
    """`palpd setup CELL --page` under way, seen by a program that shows the token with each request."""

    process: subprocess.Popen[str]
    address: str
    token: str

    def ask(self, path: str, content: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """GET a route, or POST to it; the answer, also where it is a refusal."""
        body = json.dumps(content).encode() if content is not None else None
        request = Request(f"{self.address}{path}", body, {"Authorization": f"Bearer {self.token}"})
        try:
            with urlopen(request, timeout=PATIENCE_S) as answer:
                return dict(json.load(answer))
        except HTTPError as refusal:
            return dict(json.load(refusal))


@contextmanager
def setup_page(folder: Path) -> Iterator[SetupPage]:
    """Serve the page for a set-up of a folder within the context."""
    command = [sys.executable, "-m", "palpd", "setup", str(folder), "--page", "--port", str(free_port())]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=_patient())
    assert process.stdout is not None
    try:
        address, _, token = process.stdout.readline().split()[-1].partition("/?token=")
        yield SetupPage(process, address, token)
    finally:
        process.terminate()
        process.wait(PATIENCE_S)


def operate_in_page(server: SetupPage, person: Person, folder: Path) -> SetupSession:
    """Carry out the set-up by the page's routes. The person types both addresses too."""
    addresses = {"Address of": person.cell.wires.host, "No DAQ": person.cell.wires.sensor}
    began_s, shown, pending = time.monotonic(), list[str](), list[str]()
    assert server.ask("/setup/begin", {})["ok"]
    lines = heard = 0
    heard_s = time.monotonic()
    while True:
        talk = server.ask(f"/setup/talk?after={lines}")
        for line in talk["said"]:
            words = f"{line['ask']} ({', '.join(line['answers'])})" if "ask" in line else str(next(iter(line.values())))
            shown.append(words)
            pending.append(words)
        lines += len(talk["said"])
        if talk["asked"] is not None:
            question = talk["said"][-1]["ask"]
            typed = next((value for begins, value in addresses.items() if question.startswith(begins)), person.answer(pending))
            answer, pending = typed or talk["said"][-1]["usual"], []
            assert server.ask("/setup/answer", {"number": talk["asked"], "question": question, "answer": answer})["ok"]
        elif not talk["under_way"]:
            return SetupSession("\n".join(shown), int(talk["said"][-1]["ended"]), time.monotonic() - began_s, _steps(folder))
        heard, heard_s = (lines, time.monotonic()) if lines != heard else (heard, heard_s)
        if time.monotonic() - heard_s > PATIENCE_S:
            raise TimeoutError(f"the set-up said nothing for {PATIENCE_S:g} s:\n{shown[-20:]}")
        time.sleep(0.1)


def check_in_page(server: SetupPage, folder: Path) -> Path | None:
    """Start the service of the folder, arm, and make the first morning check by the page's routes; the file that it keeps."""
    config = folder / "config.yaml"
    service = subprocess.Popen([sys.executable, "-m", "palpd", "serve", "--config", str(config)], stderr=subprocess.DEVNULL, env=_patient())
    try:
        until(lambda: server.ask("/do/status", {}).get("state") == "disarmed", "the service is ready", PATIENCE_S, every_s=0.2)
        lease = server.ask("/do/take", {"name": "benchmark"})["lease"]
        for what, more in (("arm", {}), ("begin", {"program": "check", "arguments": {"temperature_C": 21.0}})):
            answer = server.ask(f"/do/{what}", {"lease": lease, **more})
            print(f"{what}: {answer.get('error') or answer.get('state') or answer.get('id')}")
        job = answer.get("id")

        def ended() -> bool:
            server.ask("/do/renew", {"lease": lease})
            return server.ask("/do/job", {"id": job}).get("ended") is not None

        if job is not None:
            until(ended, "the check is over", PATIENCE_S, every_s=0.5)
        print(json.dumps(server.ask("/do/job", {"id": job}).get("reason")))
        for check in server.ask("/checks/list")["checks"]:
            print(f"check of {check['date']}: {check['level']}: {check['sentence']}")
        return next((folder / "runs").glob("*.check.json"), None)
    finally:
        service.terminate()
        service.wait(PATIENCE_S)


def main() -> int:
    """Set an emulated cell up, and print how that went."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", choices=("ur5", "ur5e"), default="ur5")
    parser.add_argument("--page", action="store_true", help="by the routes of the page, up to the first morning check")
    arguments = parser.parse_args()
    checked = None
    with tempfile.TemporaryDirectory() as name, emulated_cell(Path(name), arguments.model) as cell:
        folder = Path(name) / "cell"
        if arguments.page:
            began_s = time.monotonic()
            with setup_page(folder) as server:
                session = operate_in_page(server, Person(cell), folder)
                checked = check_in_page(server, folder)
            print(f"{time.monotonic() - began_s:.0f} s to the first morning check: {checked.name if checked else 'none'}")
        else:
            session = operate(cell, folder)
    print(session.text)
    print(f"{session.duration_s:.0f} s from an empty folder to the first press, target {TARGET_S:g} s; exit code {session.exit_code}")
    done = session.steps.get("press", {}).get("verdict") == "ok"
    return 0 if done and (checked or not arguments.page) and session.duration_s <= TARGET_S else 1


if __name__ == "__main__":
    sys.exit(main())
