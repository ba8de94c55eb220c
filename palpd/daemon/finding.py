"""One result of an examination, and a helper to read the kernel's files."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

Judgement = Literal["ok", "warn", "fail"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was examined: what was measured, the judgement, and what to do unless it is ok. `figures` go into the JSON.

    `expected` stands beside what was measured; it is empty where that says it itself.
    """

    name: str
    verdict: Judgement
    measured: str
    advice: str = ""
    figures: Mapping[str, object] = field(default_factory=dict)
    expected: str = ""


def text_of(path: str) -> str | None:
    """The stripped text of a file of the kernel; None where it cannot be read."""
    try:
        return Path(path).read_text().strip()
    except OSError:
        return None
