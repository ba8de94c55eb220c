"""What a benchmark writes into a page of docs/: the text between two comments, `<!-- NAME:begin -->` and `<!-- NAME:end -->`."""

from pathlib import Path


def parted(page: str, name: str) -> tuple[str, str, str]:
    """The text of a page up to the first comment, that between the two, and the rest."""
    before, begin, rest = page.partition(f"<!-- {name}:begin -->\n")
    text, end, after = rest.partition(f"\n<!-- {name}:end -->")
    assert begin, f"the page has no text {name}"
    assert end, f"the text {name} of the page has no end"
    return before + begin, text, end + after


def write_marked(path: Path, name: str, text: str) -> None:
    """Replace the text between the two comments of a page."""
    before, _, after = parted(path.read_text(encoding="utf-8"), name)
    path.write_text(before + text + after, encoding="utf-8")
