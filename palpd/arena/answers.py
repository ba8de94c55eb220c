"""What a tool answers: the part of palpd.diagnosis/1 that is scored."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from palpd.arena.cases import mapping
from palpd.documents import read_json
from palpd.errors import BadInput

VERDICTS = ("none", "effects", "ambiguous", "unknown")
SCHEMA = "palpd.diagnosis/1"


@dataclass(frozen=True)
class ToolAnswer:
    """An answer.

    Attributes:
        named: The named causes in their order, each with the names that the recording cannot tell from it.
        probability: Stated probability that a cause acts, by name; a name that is missing has 0.
        p_none: That nothing acts.
        p_unknown: That something acts that the list has no name for.
        cpu_s: Processor time; None where the tool does not say.
        failed: Why there is no answer; empty where there is one.
        made_by: Versions and commit of what answered; empty where the tool does not say.
    """

    verdict: str
    named: tuple[frozenset[str], ...]
    probability: Mapping[str, float]
    p_none: float
    p_unknown: float
    cpu_s: float | None = None
    failed: str = ""
    made_by: str = ""

    @staticmethod
    def of(content: Mapping[str, Any], where: str) -> "ToolAnswer":
        """An answer of the content of its file.

        Args:
            where: Names the file in what is said of it.

        Raises:
            BadInput: It is none.
        """
        extra = content.get("arena") or {}
        made_by = str(extra.get("made_by", ""))
        if "failed" in extra:
            return ToolAnswer("unknown", (), {}, 0.5, 0.5, cpu_s=extra.get("cpu_s"), failed=str(extra["failed"]), made_by=made_by)
        if content.get("schema") != SCHEMA or content.get("verdict") not in VERDICTS:
            raise BadInput(f"{where} is no answer: schema and verdict are expected to be {SCHEMA!r} and one of {', '.join(VERDICTS)}")
        try:
            named = tuple(frozenset({each["id"], *each.get("indistinguishable_from", ())}) for each in content["effects"])
            probability = {str(each["id"]): _share(each["probability"]) for each in content["candidates"]}
            p_none, p_unknown = _share(content["p_none"]), _share(content["p_unknown"])
        except (KeyError, TypeError, ValueError) as error:
            raise BadInput(f"{where} is no answer: {error!r}; docs/arena.md says what it must hold") from None
        return ToolAnswer(content["verdict"], named, probability, p_none, p_unknown, extra.get("cpu_s"), made_by=made_by)

    @staticmethod
    def load(path: Path) -> "ToolAnswer":
        """Read an answer. Raises BadInput."""
        return ToolAnswer.of(mapping(read_json(path), path), str(path))


def content_of(verdict: str, probability: Mapping[str, float], p_none: float, p_unknown: float = 0.0) -> dict[str, Any]:
    """The content of an answer's file, for a runner.

    Args:
        verdict: One of VERDICTS: with `effects` and `ambiguous` what is more probable than not is named.
        probability: That a cause acts, by name.
        p_none: That nothing acts.
        p_unknown: That something acts that the list has no name for.
    """
    order = sorted(probability, key=lambda name: -probability[name])
    named = [name for name in order if probability[name] > 0.5] if verdict in ("effects", "ambiguous") else []
    return {
        "schema": SCHEMA,
        "verdict": verdict,
        "effects": [{"id": name, "probability": probability[name], "parameters": {}, "indistinguishable_from": []} for name in named],
        "candidates": [{"id": name, "probability": probability[name]} for name in order],
        "p_none": p_none,
        "p_unknown": p_unknown,
    }


def _share(value: Any) -> float:
    if not 0.0 <= float(value) <= 1.0:
        raise ValueError(f"{value} is no probability")
    return float(value)
