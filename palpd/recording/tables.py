"""How a table of text is laid out: what separates its cells, which lines are comments, and whether commas are decimal.

Instruments and spreadsheets write tables with commas, semicolons or tabs, with comments behind `#`, and, in many languages, with a decimal
comma. A decimal comma is understood where something else separates the cells.
"""

import csv
import warnings
from collections.abc import Iterable, Iterator, Sequence
from typing import IO, NamedTuple

import numpy as np

from palpd.errors import RecordingError
from palpd.tick import Floats

DELIMITERS = (",", ";", "\t")
LONGEST_LINE = 100_000
"""Longest header or first row in letters; a recording of ten columns has 200."""


class Layout(NamedTuple):
    """Columns of a table, what separates its cells, whether commas are decimal, and the number of lines up to the header."""

    header: list[str]
    delimiter: str
    decimal_comma: bool
    lines: int


def is_comment(line: str) -> bool:
    """Whether a line holds nothing, or a comment."""
    return line.lstrip()[:1] in ("", "#")


def cells_of(line: str, delimiter: str | None) -> list[str]:
    """Split a line into cells without blanks around them.

    Args:
        line: One line of a table.
        delimiter: What separates its cells; None: white space.

    Returns:
        The cells (n,).

    Raises:
        RecordingError: A cell is longer than any number or name.
    """
    if delimiter is None:
        return line.split()
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter), [])]
    except csv.Error as error:
        raise RecordingError(f"a line that begins with {line[:20]!r} is no row of a table ({error}); give a table of numbers") from None


def read_numbers(rows: Iterable[str], delimiter: str | None, columns: Sequence[int]) -> Floats:
    """Read the numbers of some columns; `#` begins a comment.

    Args:
        delimiter: None: white space.
        columns: Their places in a row, from 0 on.

    Returns:
        The numbers (n, columns), where there is no row (0, 1).

    Raises:
        ValueError: A cell is no number, or a row is too short.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a table without rows is refused later, in our own words
        return np.loadtxt(rows, delimiter=delimiter, usecols=columns, ndmin=2, comments="#", quotechar='"', dtype=float)


def with_points(text: str, layout: Layout) -> str:
    """A cell or a line of a table with decimal points.

    Returns:
        The text, changed where the table has decimal commas.
    """
    return text.replace(",", ".") if layout.decimal_comma else text


def read_layout(file: IO[str], name: str, columns: Sequence[str]) -> Layout:
    """Read the header of a table and go on to its first row.

    Args:
        file: The table, at its beginning; afterwards it stands behind the header.
        name: What errors call it.
        columns: Names that the header should have.

    Raises:
        RecordingError: The lines are too long, or decimal commas separate nothing.
    """
    above, line = _next_line(file, name)
    splits = {delimiter: cells_of(line, delimiter) for delimiter in DELIMITERS}
    delimiter = max(splits, key=lambda each: len(set(splits[each]) & set(columns)))
    header = splits[delimiter]
    place = file.tell()
    row = _next_line(file, name)[1]
    file.seek(place)
    refuse_decimal_commas(name, header, cells_of(row, delimiter), delimiter)
    return Layout(header, delimiter, delimiter != "," and "," in row, above)


def refuse_decimal_commas(name: str, header: Sequence[str], row: Sequence[str], delimiter: str | None) -> None:
    """Refuse a row in which commas stand both for the decimal point and between cells.

    Args:
        name: What errors call the table.
        delimiter: What separates its cells; None: white space.

    Raises:
        RecordingError: The row has more cells than the header.
    """
    filled = [cell for cell in row if cell]
    if delimiter == "," and len(filled) > len(header):
        raise RecordingError(
            f"{name}: a row has {len(filled)} cells and the header {len(header)}; if its commas are decimal, "
            "separate the cells with semicolons or tabs"
        )


def _next_line(file: IO[str], name: str) -> tuple[int, str]:
    """The next line that is no comment, and how many lines were read for it."""
    for number, line in enumerate(_lines(file), start=1):
        if len(line) >= LONGEST_LINE:
            raise RecordingError(f"{name} has a line of more than {LONGEST_LINE} letters; a recording is a table with one row a sample")
        if not is_comment(line):
            return number, line
    return 0, ""


def _lines(file: IO[str]) -> Iterator[str]:
    while line := file.readline(LONGEST_LINE):  # not `for`: afterwards the file could not tell its place
        yield line
