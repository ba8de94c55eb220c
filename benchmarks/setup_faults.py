"""Twelve faults of a new cell, one at a time: does the step of `palpd setup` find it that should, in words that say what to do?

`python -m benchmarks.setup_faults [--only WORDS] [--docs docs]`. Each begins with an empty folder and an emulated cell with that fault, and
ends at the step that should find it. Prints a table; `--docs` writes it into how-to/setup.md. Ends with 1 where a fault is missed, or
something else is complained of.
"""

import argparse
import contextlib
import socket
import struct
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.marked_text import write_marked
from benchmarks.setup import PLATE_N_PER_M, SetupSession, operate
from palpd.cell.cell_file import PHANTOM, save_cell
from palpd.daemon.setup.flow import NAMES
from palpd.daemon.starting_files import write_starting_files
from palpd.testing.emulated_cell import EmulatedCell, emulated_cell

LOOSE_N_PER_M = 3000.0
"""Stiffness of a sensor whose screws are loose, in series with the rest of the machine (assumed)."""


@dataclass(frozen=True)
class PlantedFault:
    """One fault of a cell.

    Attributes:
        name: What is wrong.
        step: The step that should find it.
        finding: Name of the finding that should say it.
        plant: Brings it about on an emulated cell.
        model: ur5 or ur5e.
        effects: Effects of the emulated cell.
        meanwhile: What goes on besides, while palpd setup runs.
        config_model: Model that a config.yaml says which somebody wrote before; empty: there is none.
        plate_N_per_m: Stiffness that the arm feels on a rigid plate.
    """

    name: str
    step: str
    finding: str
    plant: Callable[[EmulatedCell], object] = lambda _: None
    model: str = "ur5"
    effects: dict[str, dict[str, float]] = field(default_factory=dict)
    meanwhile: Callable[[EmulatedCell], AbstractContextManager[object]] = lambda _: nullcontext()
    config_model: str = ""
    plate_N_per_m: float = PLATE_N_PER_M


@contextlib.contextmanager
def second_client(cell: EmulatedCell) -> Iterator[None]:
    """Another program that owns the input registers of the controller."""
    with socket.create_connection((cell.wires.host, 30004)) as connection:
        for kind, body in ((b"V", struct.pack(">H", 2)), (b"I", b"input_int_register_0,input_double_register_0")):
            connection.sendall(struct.pack(">Hc", 3 + len(body), kind) + body)
            connection.recv(4096)
        yield


FAULTS = (
    PlantedFault("swapped axes", "weight", "known weight", lambda cell: cell.wires.ask("mounting", axes=[2, 1, 0])),
    PlantedFault("wrong sign", "weight", "known weight", lambda cell: cell.wires.ask("mounting", signs=[1, 1, -1])),
    PlantedFault("wrong counts", "weight", "known weight", lambda cell: cell.wires.ask("registers", scale=1.3)),
    PlantedFault("15 Hz filter", "sensor", "sensor", lambda cell: cell.wires.ask("keep_filter")),
    PlantedFault("wrong TCP", "tool", "TCP", lambda cell: cell.wires.ask("installation", tcp=[0.0, 0.0, 0.035, 0.0, 0.0, 0.0])),
    PlantedFault("second client on the port", "tool", "tool", meanwhile=second_client),
    PlantedFault("payload not set", "tool", "payload", lambda cell: cell.wires.ask("installation", payload_kg=0.0)),
    PlantedFault("soft cable", "level", "free air", effects={"cable.spring": {"stiffness_N_per_m": 100.0}}),
    PlantedFault("wrong model", "robot", "robot model", config_model="ur5e"),
    PlantedFault("USB latency 16 ms", "look", "sensor latency", lambda cell: cell.wires.ask("usb_latency", ms=16)),
    PlantedFault("loose sensor", "stiffness", "stiffness", plate_N_per_m=1.0 / (1.0 / PLATE_N_PER_M + 1.0 / LOOSE_N_PER_M)),
    PlantedFault(
        "125 Hz taken for 500", "robot", "robot states", lambda cell: cell.wires.ask("slow_packets", every=4, s=600.0), model="ur5e"
    ),
)


def tried(fault: PlantedFault, folder: Path, *options: str) -> SetupSession:
    """Set a cell with that fault up until the step that should find it.

    Args:
        options: Further options of palpd setup.
    """
    effects = folder / "emulated.yaml"
    save_cell(effects, PHANTOM.with_effects(fault.effects))
    if fault.config_model:
        write_starting_files(folder / "cell", fault.config_model, 12.0, ())
    after = NAMES[NAMES.index(fault.step) + 1]
    with emulated_cell(folder, fault.model, effects) as cell:
        fault.plant(cell)
        with fault.meanwhile(cell):
            return operate(cell, folder / "cell", *options, again=False, until=after, plate_N_per_m=fault.plate_N_per_m)


def row(fault: PlantedFault, session: SetupSession) -> tuple[bool, str]:
    """Whether that fault was found as it should be, and its line of the table."""
    complaints = session.complaints()
    good = bool(complaints) and all((name, finding["name"]) == (fault.step, fault.finding) for name, finding in complaints)
    name, finding = complaints[0] if complaints else ("none", {"measured": "", "advice": "", "expected": ""})
    expected = f"; expected {finding['expected']}" if finding.get("expected") else ""
    advice = f" → {finding['advice']}" if finding["advice"] else ""
    return good, f"| {fault.name} | {'' if good else '**missed** '}`{name}` | {finding['measured']}{expected}{advice} |"


def main() -> int:
    """Try the faults, and print or write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="faults whose name holds these words")
    parser.add_argument("--docs", type=Path, help="folder of the pages")
    arguments = parser.parse_args()
    rows, missed = ["| fault | found by | what the step says |", "|---|---|---|"], 0
    for fault in (fault for fault in FAULTS if arguments.only in fault.name):
        with tempfile.TemporaryDirectory() as folder:
            session = tried(fault, Path(folder))
            good, text = row(fault, session)
            rows.append(text.replace(folder, "…"))
        missed += not good
        print(rows[-1], "" if good else f"\n{session.text}", flush=True)
    if arguments.docs:
        write_marked(arguments.docs / "how-to" / "setup.md", "faults", "\n".join(rows))
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
