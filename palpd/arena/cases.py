"""Rigs and questions: recordings with roles, a cell file, and the truth, which no tool sees."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice, zip_longest
from pathlib import Path
from typing import Any, Literal, get_args

from palpd.documents import read_json, read_yaml
from palpd.errors import BadInput

Known = Literal["planted", "annotated", "measured", "inferred"]
"""How a truth is known: planted into data, stated by their makers, measured by them, or inferred from physics."""
UNKNOWN = "unknown"
"""Truth of a recording in which something acts that the list has no name for."""


@dataclass(frozen=True)
class Question:
    """What a tool is asked: the files that it may see.

    Attributes:
        recording: The CSV to judge.
        healthy: CSVs of the same rig while it was healthy; there may be none.
    """

    rig: str
    name: str
    recording: Path
    cell: Path
    healthy: tuple[Path, ...]


@dataclass(frozen=True)
class KnownTruth:
    """What acts in a recording.

    Attributes:
        causes: For each cause the names that are right; none for a healthy recording.
    """

    causes: tuple[frozenset[str], ...]
    known: Known

    @property
    def healthy(self) -> bool:
        """Whether nothing acts."""
        return not self.causes

    @property
    def outside(self) -> bool:
        """Whether something acts that the list has no name for."""
        return any(UNKNOWN in names for names in self.causes)


@dataclass(frozen=True)
class ArenaRig:
    """A rig: what it is, where its data come from, and its questions.

    Attributes:
        used_to_mend: Whether a tool of this repository was mended by its data.
    """

    name: str
    title: str
    folder: Path
    used_to_mend: bool
    questions: tuple[Question, ...]
    truths: Mapping[str, KnownTruth]

    @staticmethod
    def load(folder: Path) -> "ArenaRig":
        """Read the folder of a rig.

        Raises:
            BadInput: A file is missing or wrong; the sentence says which.
        """
        stated, truth_file = mapping(read_yaml(folder / "rig.yaml", error=BadInput).content, folder / "rig.yaml"), folder / "truth.json"
        truths = {name: _truth(each, f"{truth_file}: {name}") for name, each in mapping(read_json(truth_file), truth_file).items()}
        recordings = folder / "recordings"
        for name in {*stated["judged"], *stated["healthy"]}:
            if stated["shipped"] and not (recordings / name).is_file():
                raise BadInput(f"{recordings / name} is missing; rig.yaml names it")
        if truths.keys() != set(stated["judged"]):
            apart = sorted(truths.keys() ^ set(stated["judged"]))
            raise BadInput(f"{folder.name}: {', '.join(apart)} stands in only one of rig.yaml (judged) and truth.json")
        healthy = tuple(recordings / name for name in stated["healthy"])
        if set(stated["healthy"]) & set(stated["judged"]):
            raise BadInput(f"{folder.name}: a healthy recording that a tool is given is judged too; take it from one of both lists")
        questions = tuple(
            Question(folder.name, Path(name).stem, recordings / name, folder / "cell.yaml", healthy) for name in stated["judged"]
        )
        return ArenaRig(
            folder.name, stated["title"], folder, bool(stated["used_to_mend"]), questions,
            {Path(name).stem: truth for name, truth in truths.items()},
        )  # fmt: skip

    @property
    def healthy(self) -> list[Question]:
        """Questions whose recording is healthy."""
        return [question for question in self.questions if self.truths[question.name].healthy]


def rigs(folder: Path) -> list[ArenaRig]:
    """All rigs whose recordings are there.

    Args:
        folder: Holds a folder for each rig.

    Raises:
        BadInput: There is none, or one is wrong.
    """
    shipped = [ArenaRig.load(each.parent) for each in sorted(folder.glob("*/rig.yaml")) if (each.parent / "recordings").is_dir()]
    if not shipped:
        raise BadInput(f"{folder} holds no rig with recordings; expected folders with rig.yaml and recordings/, as in benchmarks/arena")
    return shipped


def every(of: Sequence[ArenaRig], sample: int | None = None) -> list[tuple[Question, KnownTruth]]:
    """Every question with its truth, rig by rig.

    Args:
        sample: Take only this number, in turn from each rig; None: all.
    """
    in_turn = (question for each in zip_longest(*(rig.questions for rig in of)) for question in each if question is not None)
    chosen = set(islice(in_turn, sample))
    return [(question, rig.truths[question.name]) for rig in of for question in rig.questions if question in chosen]


def _truth(stated: Mapping[str, Any], where: str) -> KnownTruth:
    if stated.get("known") not in get_args(Known):
        raise BadInput(f"{where}: known is {stated.get('known')!r}, expected one of {', '.join(get_args(Known))}")
    causes = stated.get("causes")
    if not isinstance(causes, list):
        raise BadInput(f"{where}: causes is {causes!r}, expected a list of names (empty: healthy)")
    return KnownTruth(tuple(frozenset(each.split("|")) for each in causes), stated["known"])


def mapping(content: Any, path: Path) -> dict[str, Any]:
    """The content of a file that must be a mapping.

    Raises:
        BadInput: It is none.
    """
    if not isinstance(content, dict):
        raise BadInput(f"{path} holds no mapping")
    return content
