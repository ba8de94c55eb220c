"""What pages quote of palpd's output is what palpd says now: each sentence fits one in the code, where names and numbers are filled in."""

import ast
import re
from collections.abc import Iterator
from functools import cache

import pytest

from tests.paths import ROOT

QUOTED = {"docs/diagnosis.md": r"^Recording round-"}
"""Pages with sentences of palpd in their blocks, and how such a block is known."""
FEWEST_LETTERS = 9
"""Shortest fixed part of a sentence that tells it from others: "Resolved:" has nine letters."""

FILLED = r"[^,]+?(?:, [a-z]+\.[^,]+?)*"
"""What may be filled in: a comma stands only before the id of an effect."""


@cache
def sentences() -> tuple[re.Pattern[str], ...]:
    """A pattern for each sentence in a string of palpd."""
    patterns: set[str] = set()
    for file in (ROOT / "palpd").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            parts = node.values if isinstance(node, ast.JoinedStr) else [node]
            text = "".join(part.value if isinstance(part, ast.Constant) and isinstance(part.value, str) else "\0" for part in parts)
            for sentence in split(text):
                if len(sentence.replace("\0", "").strip()) >= FEWEST_LETTERS:
                    patterns.add(FILLED.join(map(re.escape, sentence.split("\0"))))
    return tuple(map(re.compile, patterns))


def split(text: str) -> list[str]:
    return [part.strip().rstrip(".") for part in re.split(r"\. |\n", text) if part.strip()]


def quoted(page: str) -> Iterator[str]:
    """Sentences of the page's blocks; lines that a block has broken are joined again."""
    text = (ROOT / page).read_text()
    for block in re.findall(r"^```\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL):
        if re.search(QUOTED[page], block, flags=re.MULTILINE):
            lines = [line for line in block.splitlines() if not line.startswith("palpd ")]
            yield from split(re.sub(r"\n(?=[a-z0-9])|\n(?=constant|Other)", " ", "\n".join(lines)))


def is_ours(sentence: str) -> bool:
    """Whether palpd says such a sentence, alone or after the name of a recording."""
    bare = re.sub(r"^Recording round-\d+\.csv \(\d+ s\): ", "", sentence)
    bare = re.sub(r"^Next: [^(]*", "Some motion ", bare)  # its name has commas of its own
    return any(pattern.fullmatch(bare) for pattern in sentences())


@pytest.mark.parametrize("page", QUOTED)
def test_quoted_output_is_what_palpd_says_now(page: str) -> None:
    lines = list(quoted(page))
    assert len(lines) > 10
    old = [line for line in lines if not is_ours(line)]
    assert not old, "palpd does not say this any more; run the example again"


@pytest.mark.parametrize(
    "old",
    [
        "The gap in fz_N while holding comes from sensor.gain (0.62), which closes 100 % of the gap",
        "by this recording sensor.gain cannot be told from tissue.modulus",
        "it is expected to tell sensor.gain from tissue.modulus by a factor of 740",
    ],
)
def test_a_sentence_that_palpd_does_not_say_any_more_is_seen(old: str) -> None:
    assert not is_ours(old)
