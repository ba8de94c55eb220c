"""What stands in the blocks of a page: commands to type, and what they print."""

import re
from collections.abc import Container
from itertools import pairwise
from pathlib import Path

FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", flags=re.MULTILINE | re.DOTALL)


def commands_of(page: Path) -> list[str]:
    """The lines of the blocks marked `bash`, which a reader types and a test runs."""
    return [line for kind, text in FENCE.findall(page.read_text(encoding="utf-8")) if kind == "bash" for line in text.splitlines()]


def quoted_in(page: Path, left_out: Container[str] = ()) -> list[str]:
    """The lines that a page quotes of what its commands print: an unmarked block that follows a block whose last command is run."""
    blocks = [("", ""), *FENCE.findall(page.read_text(encoding="utf-8"))]
    quotes = [
        text for (before, typed), (kind, text) in pairwise(blocks) if before == "bash" and not kind and last_of(typed) not in left_out
    ]
    return [line for text in quotes for line in text.splitlines()]


def last_of(text: str) -> str:
    """The last line of a block."""
    return text.rstrip().rpartition("\n")[2]


def words(text: str) -> str:
    """The text with every gap one space, since a terminal breaks lines."""
    return " ".join(text.split())
