"""The recordings of a folder: which there are, which one a user means, and the files that stand beside each.

A recording is evidence and is never written to. What belongs to it stands beside it under its own name, so that it travels with it:

| file | holds | made by |
|---|---|---|
| NAME.remarks.json | tags and notes | `palpd runs --tag`, `--note` |
| NAME.report.html | the report | `palpd report`, and each run when it is over |
| NAME.diagnosis.json, NAME.SITE.diagnosis.json | a diagnosis of it | `palpd diagnose --json` |
| NAME.check.json | what a morning check measured, and its verdict | `palpd check` |
| NAME.injection.json | what was planted into the second channel, and what the diagnosis said | `palpd inject` |
"""

import contextlib
import os
import stat
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from palpd.errors import BadInput, RecordingError
from palpd.files import is_growing

RECORDING, PART = ".mcap", ".part"
REMARKS, REPORT, DIAGNOSIS, CHECK, INJECTION = ".remarks.json", ".report.html", ".diagnosis.json", ".check.json", ".injection.json"
LAST = "last"
"""Stands for the recording that ended last, by its own time: that of a file is lost in a copy."""
LEVELS = 2
"""Levels of folders below that of the runs: demos and surveys make one. More would search a whole disk where `/` is given."""
MOST_LETTERS = 100
"""Letters of another run's name in the name of a comparison: a file name may have 255 bytes."""
MOST_NAMED = 4
"""Most recordings that a sentence names."""


@dataclass(frozen=True, slots=True)
class FileStamp:
    """Tells whether a file is still the one that was read: its size, and when it was written."""

    bytes: int
    written_ns: int


@dataclass(slots=True)
class StoredRecording:
    """A recording of a folder. `name` is its path in the folder without `.mcap`; `beside` are its remarks and diagnoses by file name."""

    name: str
    path: Path
    stamp: FileStamp
    beside: dict[str, FileStamp] = field(default_factory=dict)


def stored_recordings(folder: Path) -> dict[str, StoredRecording]:
    """All recordings in a folder and in the folders below it, `LEVELS` deep, by name.

    Args:
        folder: The folder of the runs; one that does not exist holds none.

    Returns:
        The recordings with what stands beside them.

    Raises:
        BadInput: The folder cannot be read.
    """
    recordings: dict[str, StoredRecording] = {}
    beside: list[tuple[str, str, FileStamp]] = []
    for place, name, stamp in _listed(folder, RECORDING, REMARKS, DIAGNOSIS):
        if name.endswith(RECORDING):
            stem = place + name.removesuffix(RECORDING)
            recordings[stem] = StoredRecording(stem, folder / (place + name), stamp)
        else:
            beside.append((place, name, stamp))
    for place, name, stamp in beside:
        stem = name.removesuffix(REMARKS).removesuffix(DIAGNOSIS)
        owner = recordings.get(place + stem) or recordings.get(place + stem.rpartition(".")[0])
        if owner is not None:
            owner.beside[name] = stamp
    return recordings


def unfinished_recordings(folder: Path) -> dict[str, Path]:
    """The recordings that were cut off, by name: nobody writes them any more, and nobody has recovered them.

    Args:
        folder: The folder of the runs; one that does not exist holds none.

    Returns:
        The path of each FILE.part.

    Raises:
        BadInput: The folder cannot be read.
    """
    unfinished = {}
    for place, name, _ in _listed(folder, PART):
        part = folder / (place + name)
        with contextlib.suppress(OSError):  # it may not be read, or was removed meanwhile
            if not part.with_suffix(RECORDING).exists() and not is_growing(part):
                unfinished[place + name.removesuffix(PART)] = part
    return unfinished


def stored_beside(folder: Path, ending: str) -> list[Path]:
    """The files with that ending in a folder of runs, in any order; none where there is no folder. Raises BadInput."""
    return [folder / (place + name) for place, name, _ in _listed(folder, ending)]


def _listed(folder: Path, *endings: str) -> list[tuple[str, str, FileStamp]]:
    """The files with these endings, as `_files` gives them; none where there is no folder. Raises BadInput."""
    try:
        return list(_files(os.fspath(folder), "", LEVELS, endings))
    except FileNotFoundError:
        return []
    except OSError as error:
        raise BadInput(f"{folder} cannot be read ({error.strerror or error}); give the folder of the runs") from error


def _files(folder: str, place: str, levels: int, endings: tuple[str, ...]) -> Iterator[tuple[str, str, FileStamp]]:
    """Place, name and stamp of each recording and of what may belong to one; links to folders are not followed."""
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.is_dir(follow_symlinks=False):
                with contextlib.suppress(OSError):  # one that may not be read, or was removed meanwhile, holds nothing
                    yield from _files(entry.path, f"{place}{entry.name}/", levels - 1, endings) if levels else ()
            elif entry.name.endswith(endings):
                try:
                    status = entry.stat()
                except OSError:  # it was removed meanwhile, or is a link to nothing
                    continue
                if stat.S_ISREG(status.st_mode):
                    yield place, entry.name, FileStamp(status.st_size, status.st_mtime_ns)


def beside(recording: Path, ending: str) -> Path:
    """Path of a file that belongs to a recording.

    Args:
        ending: REMARKS, REPORT, or another ending.
    """
    return recording.with_name(recording.name.removesuffix(RECORDING) + ending)


def name_in(folder: Path, recording: Path) -> str | None:
    """Name of a recording in a folder.

    Args:
        folder: The folder of the runs.

    Returns:
        The name; None where the recording stands elsewhere.
    """
    try:
        return Path(os.path.realpath(recording)).relative_to(os.path.realpath(folder)).as_posix().removesuffix(RECORDING)
    except ValueError:
        return None


def report_path(recording: Path) -> Path:
    """Where the report of a run stands."""
    return beside(recording, REPORT)


def comparison_path(recording: Path, other: Path) -> Path:
    """Where the report of a run beside another one stands.

    Returns:
        A path beside the recording of the first.
    """
    return beside(recording, f".beside-{other.name.removesuffix(RECORDING)[:MOST_LETTERS]}.html")


def recording_named(name: str, folder: Path) -> Path:
    """The recording of a folder that a user means. Only what a listing of the folder shows can be named, so no name leaves it.

    Args:
        name: A name as `palpd runs` shows it, the end or the beginning of one, or `last`.
        folder: The folder of the runs.

    Raises:
        RecordingError: None is called so, or several are.
    """
    recordings = stored_recordings(folder)
    if not recordings:
        raise RecordingError(f"there is no recording in {folder}; palpd run makes one")
    if name == LAST:
        from palpd.recording.mcap_file import ended_ns  # the page's server names none so, and needs no reader of recordings

        return max(recordings.values(), key=lambda each: (ended_ns(each.path) or each.stamp.written_ns, each.name)).path
    asked = name.removesuffix(RECORDING)
    if asked in recordings:
        return recordings[asked].path
    alike = [each for each in recordings.values() if asked and (each.name.startswith(asked) or each.name.endswith(f"/{asked}"))]
    if len(alike) == 1:
        return alike[0].path
    if alike:
        names = ", ".join(sorted(each.name for each in alike)[:MOST_NAMED]) + (", …" if len(alike) > MOST_NAMED else "")
        raise RecordingError(f"{name!r} is the name of {len(alike)} recordings in {folder} ({names}); give more of it")
    raise RecordingError(f"no recording in {folder} is called {name!r}; palpd runs lists them")


def recording_meant(run: str, folder: Path) -> Path:
    """The recording that the RUN of a command means.

    Args:
        run: A path, a name, or `last`.
        folder: Where a run with this name, or the `last` one, lies.

    Raises:
        RecordingError: There is none, or several are called so.
    """
    path = Path(run)
    is_path = path.is_absolute() or (path.suffix in (RECORDING, PART) and os.path.lexists(path))
    return path if is_path else recording_named(run, folder)


def printable(text: str) -> str:
    """A text from a file for a terminal, a page or a figure: what is no printable letter is spelled out."""
    return "".join(letter if letter.isprintable() else letter.encode("unicode_escape", "surrogatepass").decode() for letter in text)
