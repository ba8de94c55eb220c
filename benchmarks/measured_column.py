"""The column "measured" of a table in docs/: a benchmark fills it from all of its results, and writes below it how it was measured."""

import datetime
import json
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

FAULTS = Path(__file__).parents[1] / "docs" / "faults.md"
"""The page with the tables of faults, failed arming, signals and aborts."""


def results_in(kept: Path) -> list[dict[str, Any]]:
    """Results that a resumable benchmark has kept, one JSON object a line.

    Args:
        kept: The file; it need not exist yet.

    Returns:
        The results, oldest first.
    """
    return [json.loads(line) for line in kept.read_text().splitlines()] if kept.exists() else []


def fill(document: Path, cells: Mapping[str, str], subject: str, condition: str) -> None:
    """Write the last cell of each row, and the line that begins with `subject`.

    Args:
        document: Markdown page; each row is found by its first cell, which stands there once.
        cells: New last cell of each row that was measured.
        subject: First words of the line that says how it was measured, such as "Aborts measured".
        condition: The rest of that line.

    Raises:
        ValueError: A row, or that line, does not stand there exactly once.
    """
    text = document.read_text(encoding="utf-8")
    for row, cell in cells.items():
        text = _replaced(text, rf"^(\| {re.escape(row)} \|.*\|)[^|\n]*\|$", rf"\g<1> {cell} |", row)
    document.write_text(_replaced(text, rf"^{re.escape(subject)} on .*$", f"{subject} on {condition}", subject), encoding="utf-8")


def _replaced(text: str, pattern: str, replacement: str, name: str) -> str:
    text, times = re.subn(pattern, replacement, text, flags=re.M)
    if times != 1:
        raise ValueError(f"{name!r} begins {times} lines, expected 1")
    return text


def condition(loads: Sequence[float], what: str) -> str:
    """Date, what was measured, cores and load, for the line below a table.

    Args:
        loads: Load average at each sample.
        what: What was measured, with its number.

    Returns:
        The end of a sentence.
    """
    return (
        f"{datetime.date.today()}, {what}, {os.cpu_count()} cores, load {min(loads):.1f} to {max(loads):.1f} "
        f"(median {np.median(loads):.1f}), emulated wires on the same machine."
    )


def spread(values: Sequence[float], digits: int) -> str:
    """Median, 99th percentile and largest value, for a cell."""
    p50, p99 = np.percentile(values, (50, 99))
    return f"p50 {p50:.{digits}f}, p99 {p99:.{digits}f}, max {max(values):.{digits}f}"
