"""A cause outside the list that repeats: its law is adopted from one recording, and must be named in another one of the same cell."""

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from palpd.cell.cell_file import CellFile
from palpd.gap.adoption import adopt
from palpd.gap.commands import library, write_answer
from palpd.gap.diagnosis import diagnose
from palpd.gap.problem import MAX_BINS
from palpd.recording.samples import Samples


@dataclass(frozen=True)
class AdoptionOutcome:
    """What became of a law.

    Attributes:
        law: Name of the law that the first recording gave; None where none was accepted, and nothing else is known.
        what: The law in words.
        secondary: Whether the first recording named a listed cause, and the law only what that leaves.
        verdict: The verdict on the second recording.
        effects: The effects that it named.
        named: Whether the law is among them.
        in_group: Whether it is among them, or among those that they cannot be distinguished from.
        factor: Its strength in the second recording, 1 as learned; None where it is not named.
        again: The law that the second recording gave beside it, in words; None where it gave none.
    """

    law: str | None
    what: str = ""
    secondary: bool = False
    verdict: str = ""
    effects: tuple[str, ...] = ()
    named: bool = False
    in_group: bool = False
    factor: float | None = None
    again: str | None = None


def adopt_and_name(first: Samples, second: Samples, cell: CellFile, max_bins: int = MAX_BINS) -> AdoptionOutcome:
    """Diagnose a recording, adopt the law that it gives into a library of its own, and diagnose another recording with that.

    Args:
        first: A recording of a cell.
        second: Another recording of the same cell, of another motion.
        cell: The cell as the simulator knows it.
        max_bins: Largest number of bins of each diagnosis, about.

    Returns:
        The outcome.
    """
    learning = diagnose([first], cell, max_bins=max_bins, propose=False)
    if learning.finding.learned is None:
        return AdoptionOutcome(None)
    with TemporaryDirectory() as folder:
        write_answer(Path(folder) / "first.json", learning)
        law = adopt(Path(folder) / "first.learned.yaml", Path(folder) / "library", None, cell).law
        known = library(None, adopted=Path(folder) / "library")
    answer = diagnose([second], cell, known, max_bins=max_bins, propose=False)
    mine = next((one for one in answer.effects if one.id == law.id), None)
    groups = {name for one in answer.effects for name in (one.id, *one.indistinguishable_from)}
    again = answer.finding.learned
    return AdoptionOutcome(
        law.id,
        law.what,
        learning.finding.secondary,
        answer.verdict,
        tuple(one.id for one in answer.effects),
        named=mine is not None and answer.verdict != "none",
        in_group=law.id in groups and answer.verdict != "none",
        factor=mine.parameters["strength"][0] if mine is not None else None,
        again=again.what if again is not None else None,
    )
