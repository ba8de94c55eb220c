"""Tables of text: separators, decimal commas, comments, rows before and after the numbers, and the logs of UR controllers.

A log of the RTDE client library's record.py (blanks between cells) or of ur_rtde's file recording (commas) is a table whose columns are
named after RTDE's output variables; the six columns of a TCP pose, speed or force make one channel.
"""

import csv
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from palpd.errors import RecordingError
from palpd.files import opened
from palpd.interchange.channels import Channel, ChannelData, Kind, refuse_empty, refuse_many
from palpd.interchange.units import unit_named
from palpd.recording.samples import LARGEST, SITE_COLUMN, refuse_mixed_sites
from palpd.recording.tables import read_numbers, refuse_decimal_commas
from palpd.tick import Floats

SEPARATORS = (";", "\t", ",", "|", None)
"""What may separate cells; None is any number of blanks."""
MOST_PREAMBLE_LINES = 2000
"""Number of lines in which the header must stand; the longest preamble that we know has 200."""
MOST_PREAMBLE_BYTES = 4_000_000
"""First bytes of a file in which header and first rows must stand, for a list of its columns."""
LONGEST_LINE = 1_000_000
"""Longest line in letters; a controller's log of 200 columns has 4000."""
HEAD_BYTES = 4096
ENCODINGS = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}
"""Encodings by the first bytes; spreadsheets save "Unicode text" so."""
LEAST_ZEROS = 0.4
"""Share of every second byte that is zero in UTF-16 of a table, whose digits and separators are ASCII."""
COMMON_CHINESE = b"\xd7"
"""Last first byte of the common characters of GBK. The umlauts of cp1252 come after it."""

UR_TIME = "timestamp"
UR_VECTORS: dict[str, Kind] = {
    "actual_TCP_force": "wrench",
    "ft_raw_wrench": "wrench",
    "actual_TCP_pose": "pose",
    "target_TCP_pose": "command",
    "actual_TCP_speed": "twist",
}
"""RTDE's vectors of six, all in axes of the base but `ft_raw_wrench`, which is in axes of the tool flange."""
UR_FRAMES = {"ft_raw_wrench": "tool"}
OPTICS11_TIP = "tip height (nm)"
OPTICS11_COLUMNS = ("Cantilever (nm)", "Piezo (nm)")
"""Columns of the text files of Optics11's nanoindenters, both downwards. Their difference is the height of the tip. `Indentation (nm)` is
not: it is zero until the instrument sees a touch."""


@dataclass(frozen=True)
class TableLayout:
    """How a table is laid out.

    `header` names its columns, `units` (as long) are what a row of units below it says. `separator` is as in SEPARATORS, `begin` and
    `end` bound the lines of numbers. `skipped` counts the other lines that hold something, without the header.
    """

    header: tuple[str, ...]
    units: tuple[str, ...]
    separator: str | None
    decimal_comma: bool
    begin: int
    end: int
    skipped: int


class TableReader:
    """Reads any table of text with a header row."""

    name = "a table of text (.csv, .txt, .tsv, .dat)"

    def reads(self, path: Path) -> bool:
        """Whether a file begins like text."""
        if not path.is_file():
            return False
        with opened(path, error=RecordingError) as stream:
            head = stream.read(HEAD_BYTES)
        return b"\0" not in head or encoding_of(head).startswith("utf-16")

    def channels(self, path: Path) -> Sequence[Channel]:
        """List the columns of a table, and the vectors of a controller's log."""
        layout = layout_of(path, lines_of(path, MOST_PREAMBLE_BYTES))
        tip = [Channel(OPTICS11_TIP, unit="nm")] if set(OPTICS11_COLUMNS) <= set(layout.header) else []
        return [*_vectors(layout), *tip, *(Channel(name, unit=_unit(layout, name)) for name in layout.header)]

    def columns(self, path: Path, names: Sequence[str]) -> dict[str, ChannelData]:
        """Read columns by their names.

        Args:
            names: Names of channels.

        Raises:
            RecordingError: A column is absent, or a row of it holds no number. Or it is our own export of several sites.
        """
        lines = lines_of(path)
        layout = layout_of(path, lines)
        if {SITE_COLUMN, "fz_N"} <= set(layout.header):
            at = layout.header.index(SITE_COLUMN)
            rows = (cells_of(line, layout.separator) for line in lines[layout.begin : layout.end])
            refuse_mixed_sites((cells[at] for cells in rows if at < len(cells)), f"{path.name} holds")
        parts = {name: _parts(layout, name) for name in names}
        scalar = list(dict.fromkeys(part for each in parts.values() for part in each))
        if any(len(each) == 6 for each in parts.values()):
            scalar = list(dict.fromkeys([*scalar, UR_TIME]))
        table = dict(zip(scalar, _numbers(path, lines, layout, scalar).T, strict=True))
        notes = (f"{path.name}: {layout.skipped} rows before and after the numbers were skipped.",) if layout.skipped else ()
        columns = {}
        for name, each in parts.items():
            if len(each) == 1:
                columns[name] = ChannelData(table[name], notes=notes)
            elif name == OPTICS11_TIP:
                deflection, way = (table[part] for part in each)
                columns[name] = ChannelData(deflection - way, notes=notes)
            else:
                values = np.column_stack([table[part] for part in each])
                if UR_VECTORS[name] in ("pose", "command"):
                    values = np.column_stack([values[:, :3], Rotation.from_rotvec(values[:, 3:]).as_quat()])
                columns[name] = ChannelData(values, table[UR_TIME], frame=UR_FRAMES.get(name, "base"), notes=notes)
        return columns


READER = TableReader()


def lines_of(path: Path, most_bytes: int | None = None) -> list[str]:
    """Read the lines of a text in UTF-8, UTF-16, GBK or cp1252.

    Args:
        most_bytes: Number of bytes after which only whole lines count, or None for the whole file.

    Returns:
        Its lines without their ends.

    Raises:
        RecordingError: The file is empty, no text, or has a line that is no row.
    """
    refuse_empty(path)
    with opened(path, error=RecordingError) as stream:
        content = stream.read(-1 if most_bytes is None else most_bytes)
    cut = most_bytes is not None and len(content) == most_bytes
    encoding = encoding_of(content[:HEAD_BYTES])
    wide = encoding.startswith("utf-16")
    if cut and not wide:
        content = content[: content.rfind(b"\n") + 1] or content
    if not wide and (at := content.find(b"\0")) >= 0:
        raise RecordingError(f"{path.name} is not text (byte {at} is 0); export it as CSV")
    try:
        text = content.decode(encoding, "replace" if wide else "strict")
    except UnicodeDecodeError:
        text = content.decode(_of_one_byte(content), "replace")
    lines = text.splitlines()
    lines = lines[:-1] if cut and wide else lines
    if not any(line.strip() for line in lines):
        raise RecordingError(f"{path.name} holds no text; copy or export it again")
    longest = max(range(len(lines)), key=lambda number: len(lines[number]))
    if len(lines[longest]) > LONGEST_LINE:
        raise RecordingError(
            f"{path.name}: row {longest + 1} has {len(lines[longest])} letters, expected at most {LONGEST_LINE}; "
            "a table has one row a sample"
        )
    return lines


def encoding_of(head: bytes) -> str:
    """The encoding of a text by its first bytes: UTF-16 where a mark or the zeros between ASCII say so, else UTF-8."""
    if head[:2] in ENCODINGS:
        return ENCODINGS[head[:2]]
    pairs = len(head) // 2
    for first, encoding in ((1, "utf-16-le"), (0, "utf-16-be")):
        if pairs and head[first : 2 * pairs : 2].count(0) >= LEAST_ZEROS * pairs and 0 not in head[1 - first : 2 * pairs : 2]:
            return encoding
    return "utf-8-sig"


def _of_one_byte(content: bytes) -> str:
    """GBK where all bytes beyond ASCII make pairs, most of common characters; else cp1252, with the µ and ° of western instruments."""
    runs = re.findall(rb"[\x80-\xff]+", content)
    pairs = [run[k : k + 2] for run in runs for k in range(0, len(run), 2)]
    common = sum(1 for pair in pairs if b"\xa1" <= pair[:1] <= COMMON_CHINESE)
    return "gbk" if all(len(run) % 2 == 0 for run in runs) and 2 * common > len(pairs) else "cp1252"


def layout_of(path: Path, lines: list[str]) -> TableLayout:
    """Find header, separator and rows of numbers of a table.

    Raises:
        RecordingError: There are no rows of numbers, or no header fits them.
    """
    head = lines[:MOST_PREAMBLE_LINES]
    separator, comma = max(
        ((each, comma) for each in SEPARATORS for comma in (False, True) if not (comma and each == ",")),
        key=lambda choice: _score(head, *choice),
    )
    rows = [number for number, line in enumerate(head) if _is_row(cells_of(line, separator), comma)]
    if not rows:
        raise RecordingError(
            f"{path.name}: none of its first {len(head)} rows holds two numbers or more; is it a table with one row a sample?"
        )
    widths = [len(cells_of(head[number], separator)) for number in rows]
    width = max(set(widths), key=lambda each: (widths.count(each), each))
    begin = next(number for number, each in zip(rows, widths, strict=True) if each == width)
    refuse_many(path, width)
    end = len(lines)
    while end > begin and not (_is_row(cells := cells_of(lines[end - 1], separator), comma) and len(cells) == width):
        end -= 1
    at, header, units = _header(path, lines, begin, width, separator)
    skipped = sum(1 for number in (*range(begin), *range(end, len(lines))) if lines[number].strip() and number not in at)
    return TableLayout(header, units, separator, comma, begin, end, skipped)


def cells_of(line: str, separator: str | None) -> list[str]:
    """Split a line.

    Args:
        line: A line of a table.
        separator: What separates its cells, None for blanks.

    Returns:
        The cells without blanks around them; an empty last cell is none.
    """
    if separator is None:
        return line.split()
    if '"' in line:
        try:
            cells = next(csv.reader([line], delimiter=separator), [])
        except csv.Error:
            cells = line.split(separator)
    else:
        cells = line.split(separator)
    cells = [cell.strip() for cell in cells]
    return cells[:-1] if cells and not cells[-1] else cells


def _number(text: str, comma: bool) -> float | None:
    try:
        return float(text.replace(",", ".") if comma else text)
    except ValueError:
        return None


def _is_row(cells: list[str], comma: bool) -> bool:
    numbers = sum(1 for cell in cells if _number(cell, comma) is not None)
    return numbers >= 2 and 2 * numbers >= sum(1 for cell in cells if cell)


def _score(lines: list[str], separator: str | None, comma: bool) -> int:
    """How well a separator fits: cells that are numbers, less twice those that are none, over the rows of numbers."""
    score = 0
    for line in lines[:: 1 + len(lines) // 200]:  # 200 lines show the layout
        cells = cells_of(line, separator)
        if _is_row(cells, comma):
            score += sum(1 if _number(cell, comma) is not None else -2 for cell in cells if cell)
    return score


def _header(
    path: Path, lines: list[str], begin: int, width: int, separator: str | None
) -> tuple[set[int], tuple[str, ...], tuple[str, ...]]:
    """Numbers of the lines of the header, its names and its units; a table that begins with numbers names its columns by their number."""
    above = [number for number in range(begin) if lines[number].strip()]
    # a tab alone is no comment: it begins the header of an index without a name, as pandas writes it
    candidates = [(number, cells_of(re.sub(r"^\s*[#%][#%\s]*", "", lines[number]), separator)) for number in reversed(above[-4:])]
    fitting = [(number, cells) for number, cells in candidates if len(cells) == width]
    if not fitting:
        for _, cells in candidates[:1]:
            refuse_decimal_commas(path.name, cells, cells_of(lines[begin], separator), separator)
        return set(), tuple(f"column {number + 1}" for number in range(width)), ("",) * width
    number, cells = fitting[0]
    known = sum(1 for cell in cells if unit_named("", cell) or cell.startswith(("(", "[")))
    if len(fitting) > 1 and known >= 2 and 2 * known >= sum(1 for cell in cells if cell):  # one may be in °C
        return {number, fitting[1][0]}, tuple(fitting[1][1]), tuple(cell.strip("()[]") for cell in cells)
    return {number}, tuple(cells), ("",) * width


def _unit(layout: TableLayout, name: str) -> str:
    return layout.units[layout.header.index(name)] or unit_named(name) or ""


def _vectors(layout: TableLayout) -> Iterator[Channel]:
    """Vectors of six columns in a controller's log."""
    names = set(layout.header)
    for vector, kind in UR_VECTORS.items():
        if UR_TIME in names and all(f"{vector}_{k}" in names for k in range(6)):
            yield Channel(vector, kind, type="six columns of RTDE")


def _parts(layout: TableLayout, name: str) -> list[str]:
    if name == OPTICS11_TIP:
        return list(OPTICS11_COLUMNS)
    return [name] if name in layout.header else [f"{name}_{k}" for k in range(6)]


def _numbers(path: Path, lines: list[str], layout: TableLayout, names: Sequence[str]) -> Floats:
    """The rows of numbers of some columns (n, k)."""
    for name in names:
        if name not in layout.header:
            raise RecordingError(f"{path.name} has no column {name}; it has {', '.join(layout.header)[:300]}; spell it as in the file")
        if layout.header.count(name) > 1:
            raise RecordingError(f"{path.name}: column {name} stands twice in the header; rename one of them")
    at = [layout.header.index(name) for name in names]
    rows: Iterable[str] = lines[layout.begin : layout.end]
    if layout.decimal_comma:
        rows = (line.replace(",", ".") for line in rows)
    try:
        values = read_numbers(rows, layout.separator, at)
    except ValueError:
        raise RecordingError(_first_wrong_cell(path, lines, layout, names, at)) from None
    if not (np.abs(values) <= LARGEST).all() and not _only_stamps(values):
        raise RecordingError(_first_wrong_cell(path, lines, layout, names, at))
    return values


def _only_stamps(values: Floats) -> bool:
    """Whether all numbers are finite, and those that are too large are stamps in nanoseconds: they rise by far less than their size."""
    if not np.isfinite(values).all():
        return False
    large = values[:, (np.abs(values) > LARGEST).any(axis=0)]
    return bool((np.ptp(large, axis=0) < 1e-3 * np.abs(large).max(axis=0)).all())


def _first_wrong_cell(path: Path, lines: list[str], layout: TableLayout, names: Sequence[str], at: Sequence[int]) -> str:
    for number in range(layout.begin, layout.end):
        line = lines[number]
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        cells = cells_of(line.partition("#")[0], layout.separator)
        for name, column in zip(names, at, strict=True):
            text = cells[column] if column < len(cells) else ""
            value = _number(text, layout.decimal_comma)
            if value is None or not abs(value) <= LARGEST:
                what = f"is {text[:40]!r}" if text else "is empty"
                return (
                    f"{path.name}: {name} {what} in row {number + 1}, between rows of numbers; every value must be a finite number, "
                    "so correct or remove that row"
                )
    return f"{path.name} is not a table of numbers; every row must have the {len(layout.header)} columns of the header"
