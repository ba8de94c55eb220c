"""Plain English: documents, comments, docstrings, help texts and messages are read for phrases that the glossary rules out.

The glossary is docs/reference/glossary.md.
"""

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
PHRASES = (
    "so many", "as much as", "by so much", "is told", "are told", "was told", "were told", "nor must", "nor may", "of which",
    "what is left", "nothing is left", "what it leaves", "deed", "deeds", "at nought", "for nought", "likes are", "whose likes",
    "twin", "twins", "was wanted", "were wanted", "came of it", "comes of it", "what came of", "is borne", "be borne", "thereof",
)  # fmt: skip
PATTERN = re.compile(r"\b(" + "|".join(phrase.replace(" ", r"\s+") for phrase in PHRASES) + r")\b", re.IGNORECASE)


def documents() -> list[Path]:
    """Markdown and pages that people read; the changelog tells history and is left out."""
    named = [
        ROOT / "README.md",
        ROOT / "ARCHITECTURE.md",
        ROOT / "CONTRIBUTING.md",
        ROOT / "systemd" / "README.md",
        ROOT / "models" / "README.md",
    ]
    return [path for path in [*named, *sorted((ROOT / "docs").rglob("*.md"))] if path.exists()]


def modules() -> list[Path]:
    """All Python files but the two that list retired words."""
    folders = ("palpd", "hw", "tests", "benchmarks")
    return [
        path for folder in folders for path in sorted((ROOT / folder).rglob("*.py")) if path.name not in {"test_prose.py", "test_names.py"}
    ]


def prose_of(source: str) -> Iterator[tuple[int, str]]:
    """(first line, text) of every comment and every string with a space in it: docstrings, help texts, messages."""
    comment_lines: list[tuple[int, str]] = []
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            comment_lines.append((token.start[0], token.string.lstrip("# ")))
    for line, text in comment_lines:
        following = next((more for other, more in comment_lines if other == line + 1), "")
        yield line, f"{text} {' '.join(following.split()[:2])}"  # a phrase may go on in the next line
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
            yield node.lineno, node.value


def findings_in(line: int, text: str) -> Iterator[tuple[int, str]]:
    """(line, phrase) of every phrase in a text that begins at a line."""
    for match in PATTERN.finditer(text):
        yield line + text.count("\n", 0, match.start()), " ".join(match.group().split()).lower()


def findings() -> list[str]:
    """One line a phrase: file, line, phrase."""
    out: list[str] = []
    for path in documents():
        out += [f"{path.relative_to(ROOT)}:{line}: {phrase!r}" for line, phrase in findings_in(1, path.read_text(encoding="utf-8"))]
    for path in modules():
        places = {place for line, text in prose_of(path.read_text(encoding="utf-8")) for place in findings_in(line, text)}
        out += [f"{path.relative_to(ROOT)}:{line}: {phrase!r}" for line, phrase in sorted(places)]
    for path in sorted((ROOT / "palpd").rglob("*.j2")):
        out += [f"{path.relative_to(ROOT)}:{line}: {phrase!r}" for line, phrase in findings_in(1, path.read_text(encoding="utf-8"))]
    return out


def test_prose_is_plain() -> None:
    assert not findings(), "\n".join(["phrases that the glossary rules out:", *findings()])


def test_the_check_reads_comments_docstrings_and_wrapped_phrases() -> None:
    source = '"""It is\ntold."""\n# takes so\n# many of them\nhelp_text = "nor must it"\nname = "deed"\n'
    phrases = {place for line, text in prose_of(source) for place in findings_in(line, text)}
    assert phrases == {(1, "is told"), (3, "so many"), (5, "nor must")}
