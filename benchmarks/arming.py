"""Every way in which arming can fail: what the run says, how soon, and that nothing moved.

`python -m benchmarks.arming [--samples 10] [--minutes 30] [--json FILE]`. Required sentences and deadlines stand in docs/faults.md. Results
are added to FILE; the column "measured" there is made of all of FILE. Ends with 1 where something was not kept.
"""

import argparse
import json
import os
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.measured_column import FAULTS, condition, fill, results_in, spread
from palpd.testing.emulated_cell import PRESS, Daemon, EmulatedCell, emulated_cell
from palpd.testing.processes import take_signals, until
from palpd.tick import PROGRAM_PLAYING

HANGS_S = 6.0
"""Duration of a fault that ends by itself: longer than the deadline, so that a run that waits for its end is seen."""


@dataclass(frozen=True)
class ArmingFault:
    """A fault of the robot, and when it comes: at the `start`, after `opening`, or when the watchdog was set (`arming`)."""

    when: str
    verb: str
    arguments: dict[str, Any]
    model: str = "ur5"


ARMING_FAULTS = {
    "local control": ArmingFault("start", "local_control", {}, "ur5e"),
    "protective stop after opening": ArmingFault("opening", "protective_stop", {}),
    "power off after opening": ArmingFault("opening", "power_off", {}),
    "program stopped after opening": ArmingFault("opening", "program_stop", {}),
    "other program after opening": ArmingFault("opening", "other_program", {"s": HANGS_S}),
    "controller silent after opening": ArmingFault("opening", "freeze", {"s": HANGS_S}),
    "connection lost after opening": ArmingFault("opening", "drop", {}),
    "watchdog trips": ArmingFault("arming", "deaf", {"s": HANGS_S}),
    "protective stop": ArmingFault("arming", "protective_stop", {}),
    "program stopped": ArmingFault("arming", "program_stop", {}),
    "other program": ArmingFault("arming", "other_program", {"s": HANGS_S}),
    "controller silent": ArmingFault("arming", "freeze", {"s": HANGS_S}),
}


@dataclass(frozen=True)
class ArmingOutcome:
    """What a run said after a fault: `said_s` from the fault to the sentence, and how far the target went."""

    fault: str
    said_s: float
    code: int
    sentence: str
    moved_m: float
    load: float


def _opened(cell: EmulatedCell, daemon: Daemon) -> float:
    """Wait until the control program plays, and return when that was."""

    def plays() -> bool:
        assert daemon.process.poll() is None, f"exit code {daemon.process.returncode}: {daemon.stderr}"
        return any(sample.runtime == PROGRAM_PLAYING for sample in cell.log(time.monotonic() - 0.05))

    until(plays, "the control program plays", every_s=0.005)
    return time.monotonic()


def failed_arming(cell: EmulatedCell, fault: str) -> ArmingOutcome:
    """Begin a run that meets a fault before it moves, and wait for its end.

    Args:
        cell: A cell of the fault's model, ready and calibrated.
        fault: One of `ARMING_FAULTS`.

    Returns:
        The outcome.
    """
    kind = ARMING_FAULTS[fault]
    began_s = time.monotonic()
    if kind.when == "start":
        cell.wires.ask(kind.verb, **kind.arguments)
    elif kind.when == "arming":
        cell.wires.ask("on_arming", then={"do": kind.verb} | kind.arguments)
    daemon = cell.run(PRESS, take_reference=False)
    done_s = None
    if kind.when == "opening":
        _opened(cell, daemon)
        done_s = float(cell.wires.ask(kind.verb, **kind.arguments)["t_s"])
    until(lambda: "palpd: " in daemon.stderr or daemon.process.poll() is not None, "the run says why it ends")
    said_s, code = time.monotonic(), daemon.wait()
    log = cell.wires.ask("log", since_s=began_s)
    if kind.when == "arming":
        assert log["armings"], f"the run did not arm: {daemon.stderr}"
        done_s = float(log["armings"][0])
    samples = cell.log(began_s)
    moved_m = max(sample.target_z_m for sample in samples) - min(sample.target_z_m for sample in samples)
    return ArmingOutcome(fault, said_s - (began_s if done_s is None else done_s), code, daemon.stderr.strip(), moved_m, os.getloadavg()[0])


@dataclass(frozen=True)
class ArmingRow:
    """One row of the table: a phrase of the sentence, and the longest time from the fault to the sentence."""

    phrase: str
    deadline_s: float


CRASHED = "ended by signal"
"""ur_rtde's own thread, which connects anew, takes its process down now and then. Nobody commands the arm then."""


def required() -> dict[str, ArmingRow]:
    """The table of docs/faults.md, by fault."""
    table = {}
    for line in FAULTS.read_text(encoding="utf-8").splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("|") and cells[0] in ARMING_FAULTS:
            table[cells[0]] = ArmingRow(cells[1], float(cells[2]))
    return table


def objection(outcome: ArmingOutcome, row: ArmingRow) -> str:
    """What of the row was not kept, the time aside, or nothing."""
    if not any(phrase in outcome.sentence for phrase in row.phrase.split(" or else ")):
        return f"it said {outcome.sentence.splitlines()[-1:]}, expected {row.phrase!r}"
    if outcome.code not in (2, 3) or (outcome.code == 3 and CRASHED not in outcome.sentence):
        return f"exit code {outcome.code}, expected 2, or 3 after a crash of the library"
    return f"the target moved by {outcome.moved_m:g} m" if outcome.moved_m else ""


def fresh(base: EmulatedCell, folder: Path, calibration: str) -> EmulatedCell:
    """The same cell for another run.

    Args:
        base: The cell.
        folder: Folder of the new run.
        calibration: Content of the file of a reference tare.

    Returns:
        The cell, ready and calibrated.
    """
    (folder / "state").mkdir()
    (folder / "state" / "calibration.json").write_text(calibration)
    return base.anew(folder)


def measure(samples: int, end_s: float, kept: Path, folder: Path) -> None:
    """Inject each fault until FILE holds that many samples of it, in turn.

    Args:
        samples: Number of samples a fault.
        end_s: Host time after which no sample is begun.
        kept: File that takes a line a sample.
        folder: Folder for the files of the runs.
    """
    for model in ("ur5", "ur5e"):
        (folder / model).mkdir()
        with emulated_cell(folder / model, model) as base:
            calibration = base.anew(base.folder).calibrate().read_text()
            for number in range(samples):
                for fault in [name for name, kind in ARMING_FAULTS.items() if kind.model == model]:
                    if sum(result["fault"] == fault for result in results_in(kept)) > number:
                        continue
                    if time.monotonic() > end_s:
                        return
                    cell = fresh(base, Path(tempfile.mkdtemp(dir=folder)), calibration)
                    try:
                        outcome = failed_arming(cell, fault)
                    except AssertionError as error:  # the machine stood still, and the run ended before the fault
                        print(f"{fault}: nothing was measured ({error})", file=sys.stderr, flush=True)
                        continue
                    with kept.open("a") as file:
                        file.write(json.dumps(asdict(outcome) | {"why": objection(outcome, required()[fault])}) + "\n")
                    print(f"{fault}: {outcome.said_s:.2f} s {objection(outcome, required()[fault])}", flush=True)


def write_table(entries: list[dict[str, Any]]) -> bool:
    """Fill the column "measured" of docs/faults.md, and say whether everything was kept.

    Args:
        entries: All results.

    Returns:
        The verdict.
    """
    cells, good = {}, True
    for fault, row in required().items():
        of_fault = [entry for entry in entries if entry["fault"] == fault]
        if not of_fault:
            continue
        said_s, broken = [entry["said_s"] for entry in of_fault], sum(bool(entry["why"]) for entry in of_fault)
        late = sum(value > row.deadline_s for value in said_s)
        cells[fault] = f"{spread(said_s, 2)}, n {len(said_s)}" + (f"; **{broken + late} not kept**" if broken + late else "")
        good = good and not broken and not late
    fill(FAULTS, cells, "Arming measured", condition([entry["load"] for entry in entries], f"{len(entries)} runs"))
    return good


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=10, help="a fault")
    parser.add_argument("--minutes", type=float, default=600.0, help="no sample is begun after that")
    parser.add_argument("--json", type=Path, help="results are added to this file")
    options = parser.parse_args()
    take_signals()
    with tempfile.TemporaryDirectory() as name:
        kept = options.json or Path(name) / "arming.jsonl"
        measure(options.samples, time.monotonic() + options.minutes * 60.0, kept, Path(name))
        entries = results_in(kept)
    sys.exit(0 if entries and write_table(entries) else 1)


if __name__ == "__main__":
    main()
