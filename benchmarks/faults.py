"""Do every fault of docs/faults.md to a run in a press and write the worst of what came into its column "measured".

`python benchmarks/faults.py [--repeats 3] [--only FAULT,FAULT]`. A minute a fault and repeat on a machine under load, 10 s on a quiet one.
Ends with 1 where a required reaction or deadline was not kept.
"""

import argparse
import datetime
import os
import re
import signal
import sys
import tempfile
from pathlib import Path

from tests.hil.faults import DEEDS, TABLE, objection, required, suffered
from tests.hil.wired import Wired, wired

CONTACT_LIMIT_N = 16.0
STAND = re.compile(r"^Measured on .*$", re.M)


def written(table: str, fault: str, cell: str) -> str:
    """The table with another last cell in the row of that fault."""
    return re.sub(rf"^(\| {re.escape(fault)} \|.*\|)[^|]*\|$", rf"\1 {cell} |", table, flags=re.M)


def worst_of(base: Wired, fault: str, repeats: int) -> tuple[str, bool]:
    """The cell for the table, and whether every repeat kept what is required."""
    row, ticks, kept = required()[fault], [], True
    for _ in range(repeats):
        cell = base.anew(Path(tempfile.mkdtemp(prefix="fault-", dir=base.folder)), safety={"contact_limit_N": CONTACT_LIMIT_N})
        came = suffered(lambda cell=cell: cell, fault)  # type: ignore[misc]
        ticks += [came.ticks] if came.ticks is not None else []
        if why := objection(came, row):
            kept = False
            print(f"{fault}: {why}", file=sys.stderr, flush=True)
    cell_text = f"{max(ticks):.1f} (worst of {len(ticks)})" if ticks else f"carried on ({repeats})"
    return cell_text if kept else f"{cell_text}, **not kept**", kept


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--only", help="faults, separated by commas")
    options = parser.parse_args()
    faults = options.only.split(",") if options.only else list(DEEDS)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it, and so would its children
    all_kept = True
    with tempfile.TemporaryDirectory() as folder, wired(Path(folder), "ur5") as base:
        for fault in faults:
            cell, kept = worst_of(base, fault, options.repeats)
            all_kept &= kept
            print(f"{fault}: {cell}", flush=True)
            TABLE.write_text(written(TABLE.read_text(), fault, cell))
    load = os.getloadavg()[1]
    stand = f"Measured on {datetime.date.today()}, {os.cpu_count()} cores, load {load:.1f} (5 min), emulated wires on the same machine."
    text = STAND.sub("", TABLE.read_text()).rstrip()
    TABLE.write_text(f"{text}\n\n{stand}\n")
    sys.exit(0 if all_kept else 1)


if __name__ == "__main__":
    main()
