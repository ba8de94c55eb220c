"""A recording as rows of samples: commanded height, reported height and speed, and the wrench of the sensor."""

import csv
import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from palpd.errors import BadInput, RecordingError
from palpd.file_kinds import MADE_BY
from palpd.files import opened, opened_text, writing, writing_text
from palpd.recording.header import RecordedGeometry
from palpd.recording.tables import Layout, cells_of, is_comment, read_layout, read_numbers, with_points
from palpd.tick import Floats

WRENCH_COLUMNS = ("fx_N", "fy_N", "fz_N", "tx_Nm", "ty_Nm", "tz_Nm")
COLUMNS = ("t_s", "z_cmd_m", "z_m", "vz_m_per_s", *WRENCH_COLUMNS)
OPTIONAL_COLUMN = "z_cmd_m"
SIDE_COLUMNS = (("fx_N", "fy_N"), ("tx_Nm", "ty_Nm", "tz_Nm"))
"""Columns that a sensor of one axis, or of forces alone, does not have: absent together, they are zero and not compared."""
JOINT_COLUMNS = {"angle_cmd_rad": "z_cmd_m", "angle_rad": "z_m", "speed_rad_per_s": "vz_m_per_s", "torque_Nm": "fz_N"}
"""Columns of a single joint, and those of an axis in whose place they stand: rad for m, and Nm for N."""
SITE_COLUMN = "site"
"""Column with the name of the site of every row, in a table of several sites; empty between sites."""
MIN_SAMPLES = 30
MANY_ROWS = 100_000
"""Rows from which a table is written with pyarrow where that is installed: a million take 1.5 s of processor time instead of 7.5."""
LARGEST = 1e12
"""Largest value of any column; Unix time has 1.7e9 s, and squares of larger numbers overflow sooner or later."""


@dataclass(frozen=True)
class Samples:
    """One recording of one cell, sample by sample.

    `t_s` (n,) strictly increasing, `z_cmd_m` (n,) commanded height or None where the rig does not tell it, `z_m` (n,) and
    `vz_m_per_s` (n,) height and vertical speed as the robot reports them (base frame, up positive), `wrench` (n, 6) the tared
    sensor in base axes: fx, fy, fz in N, tx, ty, tz in Nm, what the environment does to the probe. `held` (n,) where the sensor sent
    nothing new, and what stands there was put there. `joint`: heights are angles in rad, and forces torques in Nm.
    """

    t_s: Floats
    z_cmd_m: Floats | None
    z_m: Floats
    vz_m_per_s: Floats
    wrench: Floats
    held: NDArray[np.bool_] | None = None
    joint: bool = False
    sites: tuple[str, ...] = ()
    """Names in the column `site` of a file, or of the sites of a recording of the daemon, in their order; empty where nothing names one."""
    stated: RecordedGeometry | None = None
    """Tip and machine as the header of a recording of the daemon states them; None for other files."""

    def __len__(self) -> int:
        return len(self.t_s)

    @property
    def rate_Hz(self) -> float:
        """The usual number of samples per second."""
        return 1.0 / float(np.median(np.diff(self.t_s)))

    @property
    def duration_s(self) -> float:
        """From the first sample to the last."""
        return float(self.t_s[-1] - self.t_s[0])


def runs_of_true(mask: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Runs of successive True values.

    Args:
        mask: Values (n,).

    Returns:
        The first index of every run (k,), and the index after its last (k,).
    """
    edges = np.diff(mask.astype(np.int8), prepend=0, append=0)
    return np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)


def read(path: Path) -> Samples:
    """A recording from a `.parquet` or a CSV file. Raises RecordingError."""
    return read_parquet(path) if is_parquet(path) else read_csv(path)


def common_site(recordings: Iterable[Samples]) -> str | None:
    """The only site that recordings name; None where they name none or several."""
    names = {name for samples in recordings for name in samples.sites}
    return names.pop() if len(names) == 1 else None


def refuse_mixed_sites(names: Iterable[str], holder: str) -> None:
    """Refuse samples of several sites where one is judged; empty names are none.

    Args:
        names: The sites, in any number of rows.
        holder: How the sentence begins: "the recording holds".

    Raises:
        RecordingError: There are several.
    """
    if len(sites := _distinct(names)) > 1:
        raise RecordingError(
            f"{holder} {len(sites)} sites ({', '.join(sites)}), expected one; export each with palpd export --site and give it alone, with "
            "its own cell file where one is asked for"
        )


def is_parquet(path: Path) -> bool:
    """Whether a file is Parquet by its name."""
    return path.suffix.lower() in {".parquet", ".pq"}


def read_csv(path: Path) -> Samples:
    """A recording from a CSV file with a header; of other columns only `site` is read, for its names. Raises RecordingError.

    Semicolons and tabs between cells, decimal commas between these, and comments behind `#` are understood.
    """
    columns, layout = read_columns(path, _present)
    samples = samples_from_columns(columns, path.name)
    return replace(samples, sites=_site_names(path, layout)) if SITE_COLUMN in layout.header else samples


def read_columns(path: Path, present: Callable[[Path, Sequence[str]], list[str]]) -> tuple[dict[str, Floats], Layout]:
    """Read columns of numbers from a CSV file.

    Args:
        present: Which columns are read of a header; it refuses a header that lacks some.

    Returns:
        Arrays (n,) by the names of the columns, and the layout of the table.

    Raises:
        RecordingError: The file is no such table.
    """
    try:
        with opened_text(path, error=RecordingError) as file:
            layout = read_layout(file, path.name, COLUMNS)
            names = present(path, layout.header)
            at = [layout.header.index(name) for name in names]
            rows = (with_points(line, layout) for line in file) if layout.decimal_comma else file
            try:
                values = read_numbers(rows, layout.delimiter, at)
            except ValueError:
                raise RecordingError(_first_wrong_cell(path, names, at, layout)) from None
    except csv.Error:
        raise RecordingError(f"{path.name} is not text; a recording is a CSV file with the header {','.join(COLUMNS)}.") from None
    return {name: values[:, k] for k, name in enumerate(names)}, layout


def read_parquet(path: Path) -> Samples:
    """A recording from a Parquet file with the columns of the CSV. Raises RecordingError, also where pyarrow is not installed."""
    try:
        from pyarrow import ArrowException, parquet
    except ImportError:
        raise RecordingError(f"{path.name} is Parquet and pyarrow is not installed: install palpd[parquet] or give a CSV.") from None
    try:
        with opened(path, error=RecordingError) as file:
            table = parquet.read_table(file)
        present = _present(path, list(table.column_names))
        columns = {name: numbers_of(table.column(name).to_numpy(zero_copy_only=False), path.name, name) for name in present}
        names = table.column(SITE_COLUMN).to_pylist() if SITE_COLUMN in table.column_names else []
    except (OSError, ValueError, TypeError, ArrowException):
        raise RecordingError(f"{path.name} cannot be read as Parquet with numbers in every column; write it again or give a CSV.") from None
    return replace(samples_from_columns(columns, path.name), sites=_distinct(map(str, names)))


def samples_from_columns(columns: Mapping[str, Floats], name: str) -> Samples:
    """Check named columns and make samples of them.

    Args:
        columns: arrays (n,) by the names of COLUMNS; a group of SIDE_COLUMNS may be absent. Or those of JOINT_COLUMNS.
        name: what errors call the recording.

    Raises:
        RecordingError: a column is missing, too short or not finite, or time does not increase.
    """
    _present(Path(name), list(columns))
    joint = of_joint(columns)
    columns = {JOINT_COLUMNS.get(column, column): values for column, values in columns.items()} if joint else columns
    rows = np.size(columns["t_s"])
    columns = {name: np.zeros(rows) for name in WRENCH_COLUMNS if name not in columns} | dict(columns)
    if rows < MIN_SAMPLES:
        raise RecordingError(f"{name} has {rows} rows and at least {MIN_SAMPLES} are needed to judge a cell; record for longer.")
    refuse_values(columns, name)
    wrench = np.column_stack([columns[column] for column in WRENCH_COLUMNS])
    # Columns of one table keep all of it in memory.
    motion = {column: np.ascontiguousarray(columns[column]) for column in COLUMNS if column in columns and column not in WRENCH_COLUMNS}
    return Samples(motion["t_s"], motion.get(OPTIONAL_COLUMN), motion["z_m"], motion["vz_m_per_s"], wrench, joint=joint)


def of_joint(columns: Iterable[str]) -> bool:
    """Whether columns are those of a joint."""
    return "angle_rad" in columns


def numbers_of(values: object, name: str, column: str) -> Floats:
    """A column of a table or a data frame as numbers.

    Args:
        values: What stands in the column; dates, also with a time zone, or durations for `t_s` only.
        name: What errors call the recording.

    Returns:
        The numbers (n,); of dates the seconds since the first.

    Raises:
        RecordingError: Another column holds dates, a date is missing, or values are masked.
        TypeError: It holds something that is no number.
        ValueError: It holds something that is no number.
    """
    array = np.asanyarray(values)
    if array.dtype.kind == "O" and array.ndim == 1 and len(array) and all(isinstance(value, datetime) for value in array):
        array = (array - array[:1]).astype("timedelta64[ns]")
    if array.dtype.kind in "mM":
        if column != "t_s":
            raise RecordingError(f"{name}: {column} holds dates or durations ({array.dtype}), expected numbers; name another column.")
        if np.isnat(array).any():
            row = int(np.flatnonzero(np.isnat(array))[0])
            raise RecordingError(f"{name}: t_s holds no time in {_row(row)}; leave that row out.")
        return np.asarray((array - array[:1]) / np.timedelta64(1, "s"), dtype=float)  # in the column's own unit, whichever it is
    if np.ma.is_masked(array):
        raise RecordingError(
            f"{name}: {column} has {int(np.sum(np.ma.getmaskarray(array)))} masked values, expected none; leave these rows out."
        )
    return np.asarray(array, dtype=float)


def refuse_values(columns: Mapping[str, Floats], name: str) -> None:
    """Refuse values that no recording and no motion has.

    Args:
        columns: Arrays (n,) by the names of COLUMNS, with `t_s`.
        name: What errors call the recording.

    Raises:
        RecordingError: Columns differ in length, a value is not finite, or time does not increase.
    """
    shapes = {column: np.shape(values) for column, values in columns.items()}
    if uneven := [column for column, shape in shapes.items() if len(shape) != 1 or shape != shapes["t_s"]]:
        of = " × ".join(map(str, shapes[uneven[0]])) or "one"
        raise RecordingError(
            f"{name}: {uneven[0]} holds {of} values and t_s {' × '.join(map(str, shapes['t_s'])) or 'one'}; give columns of one length."
        )
    for column in columns:
        wrong = np.flatnonzero(~(np.abs(columns[column]) <= LARGEST))
        if len(wrong):
            row = int(wrong[0])
            expected = "every value must be a finite number" + ("" if not np.isfinite(columns[column][row]) else f" up to {LARGEST:g}")
            raise RecordingError(f"{name}: {column} is {columns[column][row]} in {_row(row)}; {expected}.")
    step_s = np.diff(columns["t_s"])
    backwards = np.flatnonzero(step_s <= 0)
    if len(backwards):
        row = int(backwards[0]) + 1
        raise RecordingError(
            f"{name}: t_s {'runs backwards' if step_s[row - 1] < 0 else 'stands still'} in {_row(row)} "
            f"({columns['t_s'][row - 1]:.9g} s, then {columns['t_s'][row]:.9g} s); rows must be in the order of time, each with its own."
        )


def write_parquet(
    path: Path,
    samples: Samples,
    *,
    extra: Mapping[str, Sequence[str | float]] = MappingProxyType({}),
    metadata: Mapping[str, str] = MappingProxyType({}),
) -> None:
    """Write a recording as Parquet with the columns of the CSV; reading it gives the same numbers to the last bit.

    Args:
        samples: The recording, n samples.
        extra: Further columns (n,) by their names.
        metadata: Texts that the file holds besides, by their names.

    Raises:
        BadInput: The file cannot be written, another stands there, or pyarrow is not installed.
    """
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        raise BadInput(f"{path.name} would be Parquet and pyarrow is not installed: install palpd[parquet] or write a CSV") from None
    table = pyarrow.table({**columns_of(samples), **extra}).replace_schema_metadata({**metadata, **MADE_BY})
    with writing(path) as stream:
        parquet.write_table(table, stream)


def columns_of(samples: Samples) -> dict[str, Floats]:
    """The columns (n,) of a file by their names, in their order."""
    commanded = {} if samples.z_cmd_m is None else {OPTIONAL_COLUMN: samples.z_cmd_m}
    wrench = dict(zip(WRENCH_COLUMNS, samples.wrench.T, strict=True))
    columns = {"t_s": samples.t_s, **commanded, "z_m": samples.z_m, "vz_m_per_s": samples.vz_m_per_s, **wrench}
    if samples.joint:
        return {"t_s": samples.t_s} | {name: columns[axis] for name, axis in JOINT_COLUMNS.items() if axis in columns}
    return columns


def write_csv(path: Path, samples: Samples, *, extra: Mapping[str, Sequence[str | float]] = MappingProxyType({})) -> None:
    """Write a recording as CSV; reading it gives the same numbers to the last bit.

    Args:
        samples: the recording, n samples.
        extra: further columns (n,) by their names.

    Raises:
        BadInput: the file cannot be written, or another stands there.
    """
    columns = columns_of(samples)
    header = [*columns, *extra]
    if len(samples) >= MANY_ROWS and find_spec("pyarrow") is not None:  # to the last bit the same, and five times as fast
        import pyarrow
        from pyarrow import csv as arrow_csv

        rows = pyarrow.table({str(k): pyarrow.array(column) for k, column in enumerate((*columns.values(), *extra.values()))})
        with writing(path) as stream:
            stream.write((",".join(header) + "\n").encode())
            arrow_csv.write_csv(rows, stream, arrow_csv.WriteOptions(include_header=False, quoting_style="none"))
        return
    table: list[list[str | float]] = np.column_stack(list(columns.values())).tolist()
    for row, *values in zip(table, *extra.values(), strict=True):
        row += values
    with writing_text(path) as file:
        file.write(",".join(header) + "\n")
        file.writelines(",".join(map(str, row)) + "\n" for row in table)


def _present(path: Path, header: Sequence[str]) -> list[str]:
    if of_joint(header):
        expected = ("t_s", *JOINT_COLUMNS)
        if missing := [name for name in expected if name not in header and name != "angle_cmd_rad"]:
            raise RecordingError(
                f"{path.name}: column {', '.join(missing)} is missing in row 0 (the header); a joint has {', '.join(expected)} "
                "(angle_cmd_rad may be absent)."
            )
        return named_once(path, header, expected)
    without = [name for group in SIDE_COLUMNS if not set(group) & set(header) for name in group]
    missing = [name for name in COLUMNS if name not in header and name not in (OPTIONAL_COLUMN, *without)]
    if missing:
        raise RecordingError(
            f"{path.name}: column {', '.join(missing)} is missing in row 0 (the header); expected {','.join(COLUMNS)} "
            f"({OPTIONAL_COLUMN}, both lateral forces and all three torques may be absent)."
        )
    return named_once(path, header, COLUMNS)


def named_once(path: Path, header: Sequence[str], names: Sequence[str]) -> list[str]:
    """The names that a header holds; one that stands in it twice is refused.

    Args:
        path: File of the table.
        header: Its columns.
        names: Columns that may be there.

    Returns:
        Those that are, in the order of `names`.

    Raises:
        RecordingError: One stands there twice.
    """
    twice = [name for name in names if list(header).count(name) > 1]
    if twice:
        raise RecordingError(f"{path.name}: column {twice[0]} stands twice in row 0 (the header); leave one of them.")
    return [name for name in names if name in header]


def _site_names(path: Path, layout: Layout) -> tuple[str, ...]:
    column = layout.header.index(SITE_COLUMN)
    with opened_text(path, error=RecordingError) as file:
        read_layout(file, path.name, COLUMNS)
        rows = (cells_of(line, layout.delimiter) for line in file if not is_comment(line))
        return _distinct(cells[column] for cells in rows if column < len(cells))


def site_named_in(path: Path) -> str | None:
    """The only site that a CSV file names in its column `site`; None where it names none or several. Raises RecordingError."""
    with opened_text(path, error=RecordingError) as file:
        layout = read_layout(file, path.name, COLUMNS)
    names = _site_names(path, layout) if SITE_COLUMN in layout.header else ()
    return names[0] if len(names) == 1 else None


def _distinct(names: Iterable[str]) -> tuple[str, ...]:
    """Names in the order of their first row, without empty ones."""
    return tuple(name for name in dict.fromkeys(each.strip() for each in names) if name)


def _row(index: int) -> str:
    return f"row {index + 1} (line {index + 2} of a CSV)"


def _first_wrong_cell(path: Path, present: Sequence[str], at: Sequence[int], layout: Layout) -> str:
    with opened_text(path, error=RecordingError) as file:
        rows = [line for line in itertools.islice(file, layout.lines, None) if not is_comment(line)]
        for index, cells in enumerate(csv.reader(rows, delimiter=layout.delimiter)):
            for name, column in zip(present, at, strict=True):
                text = with_points(cells[column].strip(), layout) if column < len(cells) else ""
                try:
                    float(text)
                except ValueError:
                    value = f"is {text[:40]!r}" if text else "is empty"
                    return f"{path.name}: {name} {value} in {_row(index)}; every value must be a finite number."
    return f"{path.name} is not a table of numbers; every row must have the {len(present)} columns of the header."
