"""Which command reads a file that is no recording yet."""

import shlex
from pathlib import Path

from palpd.errors import PalpdError
from palpd.interchange.channels import Channel
from palpd.interchange.import_files import KNOWN_COLUMNS, OWN, Source, source_of
from palpd.interchange.units import FACTORS, VOLTS, unit_named

RECORDING_ENDINGS = (".parquet", ".pq", ".part")
WORDS = {
    "force": ("force", "load", "fz", "f"),
    "length": ("height", "depth", "indentation", "position", "disp", "z"),
    "time": ("time", "t"),
}
"""Beginnings of names by which a column is proposed for a role, where its unit fits."""
DEPTHS = ("depth", "indentation", "disp", "u_")
"""Words in a name that say that it grows inwards."""


def import_command(path: Path) -> str | None:
    """Name the command that makes a recording of a foreign file.

    Args:
        path: A file that a diagnosis was asked to read.

    Returns:
        A command line, or None where the file is a recording already or nothing that palpd can import.
    """
    if path.suffix.lower() in RECORDING_ENDINGS:
        return None
    try:
        source = source_of(path)
    except PalpdError:
        return None
    names = [channel.name for channel in source.channels]
    if {"t_s", "z_m", "vz_m_per_s", "fz_N"} <= set(names):
        return None
    words = ["palpd", "import", str(path), *_column_options(source), "--csv", f"{path.stem}.recording.csv" if path.suffix == ".csv" else
             f"{path.stem}.csv"]  # fmt: skip
    return shlex.join(words)


def is_foreign(path: Path) -> bool:
    """Whether a path is a bag or a file of an instrument. An MCAP file of ours is a recording, and a table may be one."""
    return path.suffix.lower() not in (".csv", *RECORDING_ENDINGS) and import_command(path) is not None


def _column_options(source: Source) -> list[str]:
    """Options that name the columns of a table; none for a format that fixes them."""
    if source.of_kind("wrench") or source.of_kind("pose"):
        return []
    names = {channel.name for channel in source.channels}
    if any({force, height} <= names for force, height, _ in KNOWN_COLUMNS if force != OWN[0]):
        return []
    columns = source.of_kind("column")
    force, length, time = (_proposed(columns, quantity) for quantity in ("force", "length", "time"))
    depth = length is not None and any(word in length.lower() for word in DEPTHS)
    options = ["--force-column", force or "FORCE", "--depth-column" if depth else "--height-column", length or "HEIGHT"]
    has_times = bool(columns) and all(channel.rate_Hz is not None for channel in columns)
    return options if has_times else [*options, "--time-column", time or "TIME"]


def _proposed(columns: list[Channel], quantity: str) -> str | None:
    """The first column whose unit fits a quantity, or else whose name begins like one."""
    units = {**FACTORS[quantity], **VOLTS} if quantity == "force" else FACTORS[quantity]  # type: ignore[index]
    fitting = [channel.name for channel in columns if unit_named(channel.name, channel.unit) in units]
    if quantity != "time":
        likely = [name for name in fitting if any(word in name.lower() for word in WORDS[quantity])]
        fitting = likely or fitting
    named = [channel.name for channel in columns if channel.name.lower().startswith(WORDS[quantity])]
    return next(iter([*fitting, *named]), None)
