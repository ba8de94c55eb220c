"""Which reader reads a file."""

from functools import cache
from pathlib import Path
from typing import Any

from palpd.errors import BadInput, RecordingError
from palpd.interchange.channels import FileReader, refuse_empty
from palpd.plugins import Plugin, loaded, plugins
from palpd.recording.reader import holds_ticks

GROUP = "palpd.readers"
OURS = {
    "rosbag": "palpd.interchange.rosbag:READER",
    "tdms": "palpd.interchange.tdms:READER",
    "matlab": "palpd.interchange.matlab:READER",
    "afm": "palpd.interchange.afm:READER",
    "table": "palpd.interchange.table:READER",
}
"""Our own readers. Those of other packages are entry points of `palpd.readers`."""
LAST = "table"
"""The reader that is asked last: any text could be a table."""


@cache
def readers() -> tuple[dict[str, FileReader], tuple[str, ...]]:
    """All readers by their names, and a sentence on each that cannot be used."""
    registered = plugins(GROUP, OURS)
    return loaded(sorted(registered.values(), key=lambda each: (each.name == LAST, each.name)), _checked)


def _checked(plugin: Plugin, reader: Any) -> Any:
    if missing := [name for name in ("name", "reads", "channels", "columns") if not hasattr(reader, name)]:
        raise BadInput(plugin.failure(f"it has no {missing[0]}, expected a palpd.interchange.channels.FileReader"))
    return reader


def reader_of(path: Path) -> FileReader:
    """Find the reader of a file.

    Args:
        path: A foreign file, or the folder of a bag.

    Returns:
        The first reader that takes it.

    Raises:
        RecordingError: None does, or there is no such file.
    """
    try:
        path.stat()
    except (OSError, ValueError) as failure:
        what = getattr(failure, "strerror", None) or failure
        raise RecordingError(f"{path} cannot be read ({what}); give the path of a file that exists") from failure
    refuse_empty(path)
    known, failures = readers()
    for reader in known.values():
        if reader.reads(path):
            return reader
    if holds_ticks(path):
        raise RecordingError(f"{path.name} is a recording of palpd, or a damaged bag; palpd diagnose and palpd export read recordings")
    kinds = ", ".join(reader.name for reader in known.values())
    what = "a folder" if path.is_dir() else "no text"
    raise RecordingError("; ".join((f"{path.name} is {what} and no file of a known kind; known are {kinds}", *failures)))
