"""Plant laws that the library does not hold, find them, and write the table of docs/outside-the-list.md.

`python benchmarks/law_demos.py [--wires] [--only NAME] [--keep FOLDER] [--docs docs]`. The laws are the files of docs/examples/laws. Each
is planted into the emulated cell of `palpd demo`, which palpates, diagnoses, and tries the enriched cell on another motion.
"""

import argparse
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.marked_text import write_marked
from palpd.cell.cell_file import load_cell
from palpd.daemon.demo import gap
from palpd.daemon.display import Display, NoDisplay

ROOT = Path(__file__).parents[1]
LAWS = ROOT / "docs" / "examples" / "laws"
PAGE = "outside-the-list.md"
"""Marks around the table in the page."""


@dataclass(frozen=True)
class LawDemo:
    """One planted law, and what was found. `closed` is on another motion; `seconds` the CPU time of palpations and diagnosis."""

    name: str
    planted: str
    verdict: str
    answer: str
    formula: str
    closed: float | None
    seconds: float


def demonstrate(law: Path, folder: Path, display: Display, *, wires: bool = False) -> LawDemo:
    """Plant a law and look for it.

    Args:
        law: The file of the law.
        folder: Where recordings and report go.
        display: Shows the progress.
        wires: Whether to palpate on emulated wires.

    Returns:
        What was found.
    """
    began = time.process_time()
    answer: dict[str, Any] = gap(str(law), folder, display, wires=wires).result["diagnosis"]
    learned, check = answer["learned"], answer["another_motion"]
    terms = [] if learned is None else [learned, *learned["further_terms"]]
    formulas = [term["formula"] or "a curve" for term in terms]
    law_words = "no law" if learned is None else str(learned["what"])
    named = " + ".join(f"`{name}`" for name in answer["named"])
    law_words += f", beside {named}" if named and not (learned and learned["replaces_listed"]) else ""
    planted = "; ".join(one.what for one in load_cell(law).learned)
    return LawDemo(law.stem, planted, answer["verdict"], law_words, "; ".join(formulas), check["closed"], time.process_time() - began)


def table(demos: list[LawDemo]) -> str:
    """The table of the laws."""
    lines = ["| planted | found | formula | gap closed on another motion | CPU seconds |", "|---|---|---|---|---|"]
    for one in demos:
        closed = "–" if one.closed is None else f"{one.closed:.0%}"
        formula = f"`{one.formula}`" if one.formula not in ("", "a curve") else one.formula
        lines.append(f"| [{one.planted}](examples/laws/{one.name}.yaml) | {one.answer} | {formula} | {closed} | {one.seconds:.0f} |")
    return "\n".join(lines)


def main() -> None:
    """Demonstrate every law and print or write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--wires", action="store_true", help="palpate on emulated wires, in real time")
    parser.add_argument("--only", help="name of one law")
    parser.add_argument("--keep", type=Path, help="keep recordings and reports in this folder")
    parser.add_argument("--docs", type=Path, help=f"write the table into {PAGE} of this folder")
    options = parser.parse_args()
    laws = [law for law in sorted(LAWS.glob("*.yaml")) if options.only in (None, law.stem)]
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.keep or Path(temporary)
        demos = [demonstrate(law, folder / law.stem, NoDisplay(), wires=options.wires) for law in laws]
    print(table(demos))
    if options.docs is not None:
        write_marked(options.docs / PAGE, "laws", table(demos))


if __name__ == "__main__":
    main()
