"""A recording as rows of samples: what the robot was told, where it says it was, and what the sensor felt."""

import csv
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpd.errors import BadInput, RecordingError
from palpd.tick import Floats

WRENCH_COLUMNS = ("fx_N", "fy_N", "fz_N", "tx_Nm", "ty_Nm", "tz_Nm")
COLUMNS = ("t_s", "z_cmd_m", "z_m", "vz_m_per_s", *WRENCH_COLUMNS)
OPTIONAL_COLUMN = "z_cmd_m"
MIN_SAMPLES = 30


@dataclass(frozen=True)
class Samples:
    """One recording of one cell, sample by sample.

    `t_s` (n,) strictly increasing, `z_cmd_m` (n,) commanded height or None where the rig does not tell it, `z_m` (n,) and
    `vz_m_per_s` (n,) height and vertical speed as the robot reports them (base frame, up positive), `wrench` (n, 6) the tared
    sensor in base axes: fx, fy, fz in N, tx, ty, tz in Nm, what the environment does to the probe. `held` (n,) where the sensor said
    nothing new, and what stands there was put there.
    """

    t_s: Floats
    z_cmd_m: Floats | None
    z_m: Floats
    vz_m_per_s: Floats
    wrench: Floats
    held: NDArray[np.bool_] | None = None

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


def read(path: Path) -> Samples:
    """A recording from a `.parquet` or a CSV file. Raises RecordingError."""
    return read_parquet(path) if path.suffix.lower() in {".parquet", ".pq"} else read_csv(path)


def read_csv(path: Path) -> Samples:
    """A recording from a CSV file with a header; columns that are not known are ignored. Raises RecordingError."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            header = [name.strip() for name in next(csv.reader(file), [])]
            present = _present(path, header)
            at = [header.index(name) for name in present]
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", UserWarning)  # a header alone is refused below, in our own words
                    values = np.loadtxt(file, delimiter=",", usecols=at, ndmin=2, comments=None, quotechar='"', dtype=float)
            except ValueError:
                raise RecordingError(_first_wrong_cell(path, present, at)) from None
    except OSError as error:
        raise RecordingError(f"{path.name} cannot be read ({error.strerror}); give a recording that exists.") from None
    except (UnicodeDecodeError, csv.Error):
        raise RecordingError(f"{path.name} is not text; a recording is a CSV file with the header {','.join(COLUMNS)}.") from None
    return samples_from_columns({name: values[:, k] for k, name in enumerate(present)}, path.name)


def read_parquet(path: Path) -> Samples:
    """A recording from a Parquet file with the columns of the CSV. Raises RecordingError, also where pyarrow is not installed."""
    try:
        from pyarrow import ArrowException, parquet
    except ImportError:
        raise RecordingError(f"{path.name} is Parquet and pyarrow is not installed: install palpd[parquet] or give a CSV.") from None
    try:
        table = parquet.read_table(path)
        present = _present(path, list(table.column_names))
        columns = {name: np.asarray(table.column(name).to_numpy(zero_copy_only=False), dtype=float) for name in present}
    except (OSError, ValueError, TypeError, ArrowException):
        raise RecordingError(f"{path.name} cannot be read as Parquet with numbers in every column; write it again or give a CSV.") from None
    return samples_from_columns(columns, path.name)


def samples_from_columns(columns: dict[str, Floats], name: str) -> Samples:
    """Samples from named columns, checked: enough rows, all finite, time forwards. `name` is what an error calls the recording."""
    present = _present(Path(name), list(columns))
    rows = len(columns["t_s"])
    if rows < MIN_SAMPLES:
        raise RecordingError(f"{name} has {rows} rows and at least {MIN_SAMPLES} are needed to judge a cell; record for longer.")
    for column in present:
        wrong = np.flatnonzero(~np.isfinite(columns[column]))
        if len(wrong):
            row = int(wrong[0])
            raise RecordingError(f"{name}: {column} is {columns[column][row]} in {_row(row)}; every value must be a finite number.")
    step_s = np.diff(columns["t_s"])
    backwards = np.flatnonzero(step_s <= 0)
    if len(backwards):
        row = int(backwards[0]) + 1
        raise RecordingError(
            f"{name}: t_s {'runs backwards' if step_s[row - 1] < 0 else 'stands still'} in {_row(row)} "
            f"({columns['t_s'][row - 1]:.9g} s, then {columns['t_s'][row]:.9g} s); rows must be in the order of time, each with its own."
        )
    wrench = np.column_stack([columns[column] for column in WRENCH_COLUMNS])
    return Samples(columns["t_s"], columns.get(OPTIONAL_COLUMN), columns["z_m"], columns["vz_m_per_s"], wrench)


def write_csv(path: Path, samples: Samples, *, overwrite: bool = False) -> None:
    """Write a recording so that reading it gives the same numbers to the last bit. Raises BadInput where the file exists."""
    columns = [samples.t_s, *([] if samples.z_cmd_m is None else [samples.z_cmd_m]), samples.z_m, samples.vz_m_per_s]
    header = [name for name in COLUMNS if name != OPTIONAL_COLUMN or samples.z_cmd_m is not None]
    table = np.column_stack([*columns, samples.wrench]).tolist()
    try:
        with path.open("w" if overwrite else "x", encoding="utf-8", newline="") as file:
            file.write(",".join(header) + "\n")
            file.writelines(",".join(map(repr, row)) + "\n" for row in table)
    except FileExistsError:
        raise BadInput(f"{path.name} exists and is not overwritten; choose another name or remove it.") from None


def _present(path: Path, header: Sequence[str]) -> list[str]:
    missing = [name for name in COLUMNS if name not in header and name != OPTIONAL_COLUMN]
    if missing:
        raise RecordingError(
            f"{path.name}: column {', '.join(missing)} is missing in row 0 (the header); expected {','.join(COLUMNS)} "
            f"({OPTIONAL_COLUMN} may be absent)."
        )
    twice = [name for name in COLUMNS if list(header).count(name) > 1]
    if twice:
        raise RecordingError(f"{path.name}: column {twice[0]} stands twice in row 0 (the header); leave one of them.")
    return [name for name in COLUMNS if name in header]


def _row(index: int) -> str:
    return f"row {index + 1} (line {index + 2} of a CSV)"


def _first_wrong_cell(path: Path, present: Sequence[str], at: Sequence[int]) -> str:
    with path.open(newline="", encoding="utf-8-sig") as file:
        reader = csv.reader(file)
        next(reader)
        for index, cells in enumerate(cells for cells in reader if cells):
            for name, column in zip(present, at, strict=True):
                text = cells[column].strip() if column < len(cells) else ""
                try:
                    float(text)
                except ValueError:
                    found = f"is {text!r}" if text else "is empty"
                    return f"{path.name}: {name} {found} in {_row(index)}; every value must be a finite number."
    return f"{path.name} is not a table of numbers; every row must have the {len(present)} columns of the header."
