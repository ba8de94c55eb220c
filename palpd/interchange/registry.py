"""Which reader reads a file."""

from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path

from palpd.errors import RecordingError
from palpd.interchange.channels import FileReader, refuse_empty
from palpd.recording.reader import holds_ticks

GROUP = "palpd.readers"
OURS = {
    "rosbag": "palpd.interchange.rosbag:READER",
    "tdms": "palpd.interchange.tdms:READER",
    "matlab": "palpd.interchange.matlab:READER",
    "afm": "palpd.interchange.afm:READER",
    "table": "palpd.interchange.table:READER",
}
"""The readers that pyproject.toml registers, for a checkout that is not installed."""
LAST = "table"
"""The reader that is asked last: any text could be a table."""


@cache
def readers() -> dict[str, FileReader]:
    """All readers by the names of their entry points; a package may replace one of ours."""
    places = OURS | {point.name: point.value for point in entry_points(group=GROUP)}
    loaded: dict[str, FileReader] = {}
    for name, place in sorted(places.items(), key=lambda each: (each[0] == LAST, each[0])):
        module, _, attribute = place.partition(":")
        loaded[name] = getattr(import_module(module), attribute)
    return loaded


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
    for reader in readers().values():
        if reader.reads(path):
            return reader
    if holds_ticks(path):
        raise RecordingError(f"{path.name} is a recording of palpd, or a damaged bag; palpd diagnose and palpd export read recordings")
    kinds = ", ".join(reader.name for reader in readers().values())
    raise RecordingError(f"{path.name} is {'a folder' if path.is_dir() else 'no text'} and no file of a known kind; known are {kinds}")
