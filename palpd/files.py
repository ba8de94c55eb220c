"""The one way in and the one way out for files: what is read is checked first, what is written appears whole or not at all."""

import errno
import fcntl
import io
import json
import os
import shutil
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from typing import IO

from palpd.errors import BadInput, PalpdError, Refused
from palpd.file_kinds import RECORDING, kind_made, marked_json, marked_text, what_it_is

MOST_YAML_BYTES = 262_144
"""Largest YAML file; a plan of a thousand sites has 60 kB, and a larger one takes seconds to parse."""
MOST_JSON_BYTES = 64_000_000
"""Largest JSON file; a blind check of 1000 cases has some 5 MB."""
MOST_TABLE_BYTES = 2_000_000_000
"""Largest CSV file; a million samples of ten columns have 200 MB."""
STREAMS = ("/dev/stdout", "/dev/stderr", "/dev/fd/", "/proc/self/fd/")
"""Names of what a process has open already: a regular file behind one of them is appended to, never replaced."""
SINKS = ("/dev/null", "/dev/full", "/dev/tty")
"""Devices that outputs may go to, since they keep nothing."""
MOST_SOCKET_BYTES = 107
"""Longest path of a Unix socket."""
_PACKAGE = Path(__file__).parent


def shipped(name: str) -> Path:
    """Path of a file that comes with palpd: a wheel holds it below `palpd/shipped`, a checkout at its top.

    Args:
        name: config.yaml, plan.yaml, or a file below systemd/.

    Returns:
        The path; the file exists unless palpd was copied without it.

    Raises:
        Refused: The file is in neither place.
    """
    for path in (_PACKAGE / "shipped" / name, _PACKAGE.parent / name):
        if path.exists():
            return path
    raise Refused(f"{name} is neither in {_PACKAGE / 'shipped'} nor in {_PACKAGE.parent}; install palpd from its wheel or a checkout")


# --- the files of one call ------------------------------------------------------------------------------------------------------


class FileUse:
    """The files of one call, a command or a function of the API.

    Attributes:
        inputs: What it reads, by device and inode, so that links to it are known.
        outputs: What it will write, links resolved.
        force: Whether it may replace what palpd did not make; None where its user has no way to say so.
    """

    def __init__(self, force: bool | None) -> None:
        self.inputs: dict[tuple[int, int], Path] = {}
        self.outputs: set[str] = set()
        self.force = force


_USE: ContextVar[FileUse | None] = ContextVar("palpd_file_use", default=None)


@contextmanager
def file_use(inputs: Iterable[Path] = (), *, force: bool | None = None) -> Iterator[None]:
    """Keep the files of one call apart within the context: nothing is written over an input, or twice to the same place.

    A context within another one has its inputs and its force, and counts its own outputs.

    Args:
        inputs: What the call will read; what `opened` opens within the context counts too.
        force: Whether files that palpd did not make may be replaced; None: no, and no option would allow it.

    Raises:
        BadInput: A path cannot be one of a file.
    """
    use, around = FileUse(force), _USE.get()
    if around is not None:
        use.inputs, use.force = around.inputs, around.force
    token = _USE.set(use)
    try:
        for path in inputs:
            try:
                status = _status(path)
            except PermissionError:  # whoever reads it says so
                continue
            except OSError as failure:
                raise BadInput(f"{path} cannot be read ({failure.strerror or failure}); give the path of a file") from failure
            _count_input(path, status)
        yield
    finally:
        _USE.reset(token)


def read_by_others(path: Path) -> None:
    """Count a file as an input of this call, where something else than `opened` reads it.

    Args:
        path: The file; one that cannot be read is none.
    """
    with suppress(OSError):
        _count_input(path, _status(path))


def _count_input(path: Path, status: os.stat_result | None) -> None:
    use = _USE.get()
    if use is not None and status is not None and stat.S_ISREG(status.st_mode):
        use.inputs[status.st_dev, status.st_ino] = path


# --- reading ------------------------------------------------------------------------------------------------------------------


@contextmanager
def opened(path: Path, *, most_bytes: int = MOST_TABLE_BYTES, error: type[PalpdError] = BadInput) -> Iterator[IO[bytes]]:
    """Open a regular file of bounded size for reading; a failed read inside the block is refused too.

    Args:
        most_bytes: Largest size in bytes.
        error: Class of the refusal.

    Raises:
        PalpdError: Of the class `error`, where the file is absent, no regular file, too large or not readable.
    """
    try:
        kind = path.stat().st_mode  # before it is opened: opening a serial device or a pipe has effects of its own
        if not stat.S_ISREG(kind):
            raise error(f"{path} is {_kind(kind)}, expected a regular file; give the path of a file")
        with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as stream:
            status = os.fstat(stream.fileno())
            if status.st_size > most_bytes:
                raise error(f"{path} has {status.st_size} bytes, expected at most {most_bytes}; is it the right file?")
            _count_input(path, status)
            yield stream
    except OSError as failure:
        raise error(f"{path} cannot be read ({failure.strerror or failure}); give the path of a file that exists") from failure


@contextmanager
def opened_text(path: Path, *, error: type[PalpdError] = BadInput) -> Iterator[IO[str]]:
    """Open a table for reading as UTF-8, with or without a byte order mark, line ends as they are.

    Args:
        error: Class of the refusal.

    Raises:
        PalpdError: Of the class `error`, as `opened` does, and where the bytes are not UTF-8.
    """
    with opened(path, error=error) as stream, io.TextIOWrapper(stream, encoding="utf-8-sig", newline="") as text:
        try:
            yield text
        except UnicodeDecodeError as failure:
            raise error(_no_text(str(path), f"byte {failure.start}", os.pread(stream.fileno(), 16, 0))) from failure


def read_text(path: Path, *, most_bytes: int = MOST_YAML_BYTES, error: type[PalpdError] = BadInput) -> str:
    """Read a whole text file in UTF-8.

    Args:
        most_bytes: Largest size in bytes.
        error: Class of the refusal.

    Returns:
        The text without a byte order mark.

    Raises:
        PalpdError: Of the class `error`, as `opened` does, and where the bytes are not UTF-8.
    """
    with opened(path, most_bytes=most_bytes, error=error) as stream:
        content = stream.read(most_bytes + 1)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as failure:
        line = content.count(b"\n", 0, failure.start) + 1
        raise error(_no_text(str(path), f"line {line}", content)) from failure


def _no_text(name: str, place: str, head: bytes) -> str:
    if kind := what_it_is(head):
        advice = "save it as UTF-8" if kind.startswith("text") else "give the text file that belongs in its place"
        return f"{name} is {kind}, expected text in UTF-8; {advice}"
    return f"{name}, {place}: a byte is not UTF-8, expected text; save the file as UTF-8"


# --- writing ------------------------------------------------------------------------------------------------------------------


def refuse_twice(path: Path) -> None:
    """Refuse a place that another output of this call has. Raises BadInput."""
    use = _USE.get()
    if use is not None:
        with _refusing(path):
            target = os.path.realpath(path)
        if target in use.outputs:
            raise BadInput(f"{path} is given for two outputs of this command; give each a name of its own")
        use.outputs.add(target)


def check_writable(*paths: Path | None, kind: str | None = None) -> None:
    """Try the places of output files before any work begins; each may be given once in a call.

    Args:
        paths: Files that will be written; None is no file.
        kind: What they will be, one of palpd.file_kinds; None where only `writing` will know.

    Raises:
        BadInput: Where a file could not be written, is an input or another output of this call, or stands there and may not be replaced.
    """
    for path in filter(None, paths):
        _refuse_input(path)
        if not _is_stream(path):
            refuse_twice(path)
            _try_place(path, kind)


def check_resumed(path: Path | None) -> None:
    """Try the place of a file that this call reads first, if it exists, and then writes anew.

    Args:
        path: The file; None is no file.

    Raises:
        BadInput: As `check_writable` does.
    """
    if path is not None:
        _refuse_input(path)
        with _beside(path):
            pass


def check_folder(*folders: Path | None, empty: bool = False) -> None:
    """Try folders that will be made or written into; the nearest one that exists must take a file.

    Args:
        folders: Folders of outputs; None is no folder.
        empty: Whether they are kept for this call alone. With force others' files may stand there, but no recording.

    Raises:
        BadInput: Where no file could be written, or a folder is not empty.
    """
    use = _USE.get()
    for folder in filter(None, folders):
        place = folder
        while not os.path.lexists(place) and place != place.parent:
            place = place.parent
        with _refusing(folder):
            _status(folder)
            inside = sorted(entry.name for entry in folder.iterdir()) if empty and folder.is_dir() else []
            if not place.is_dir():
                raise BadInput(f"{folder} cannot be written, because {place} is no folder; give another one")
        if recordings := [name for name in inside if name.endswith((".mcap", ".part"))]:
            raise BadInput(f"{folder} holds a recording ({recordings[0]}), and recordings are not replaced; give another folder")
        if inside and not (use and use.force):
            raise BadInput(f"{folder} is not empty, and files in it might be replaced; {_way_out()}give another folder")
        with _new_file(place, folder) as stream:
            stream.write(b"\0")


def check_socket(path: Path) -> None:
    """Refuse a place where no Unix socket can be made: only a socket that nobody serves is replaced.

    Raises:
        Refused: The path is too long, or something else stands there.
    """
    import socket  # here and not above: an abort must not wait for it

    length = len(os.fsencode(path))
    if length > MOST_SOCKET_BYTES:
        raise Refused(f"the path of the socket {path} has {length} bytes, expected at most {MOST_SOCKET_BYTES}; choose a shorter one")
    if not os.path.lexists(path):
        return
    if path.is_symlink() or not path.is_socket():
        raise Refused(f"{path} exists and is no socket; name another place")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            probe.connect(str(path))
        except (ConnectionRefusedError, FileNotFoundError):
            return
        except OSError:  # another type of socket, or one that is full
            pass
    raise Refused(f"another program already serves {path}; stop it first, or name another socket")


def clear_socket(path: Path) -> None:
    """Make room for a socket: one that nobody serves is removed. Raises Refused as `check_socket` does."""
    check_socket(path)
    path.unlink(missing_ok=True)


def check_link(path: Path) -> None:
    """Refuse a place where no link to a terminal device can be made: only such a link, or one to nothing, is replaced.

    Raises:
        BadInput: Something else stands there.
    """
    with _refusing(path):
        ours = path.is_symlink() and (path.readlink().is_relative_to("/dev/pts") or not path.exists())
        if os.path.lexists(path) and not ours:
            raise BadInput(f"{path} exists and is no link to an emulated sensor; name another place")
    check_folder(path.absolute().parent)


def with_ending(path: Path, ending: str) -> Path:
    """Give an output another ending.

    Args:
        path: File that was asked for.
        ending: Ending with its dot.

    Returns:
        The path with that ending in place of its own.

    Raises:
        BadInput: Where the path names no file.
    """
    if not path.name:
        raise BadInput(f"the output is {str(path)!r}, expected the name of a file; give one")
    return path.with_suffix(ending)


@contextmanager
def writing(path: Path, *, own: bool = False) -> Iterator[IO[bytes]]:
    """Write a file that appears whole, on disk, when the block ends; where it raises, the place stays as it was.

    What stands there is replaced where palpd made it, as the same kind of file; anything else with the force of this call. A recording is
    replaced with force by another recording only, and an input of this call never. A pipe or /dev/stdout is written to directly.

    Args:
        own: Whether the file is palpd's by its name and place, such as stored state: it is replaced whatever it holds.

    Yields:
        A stream for the bytes.

    Raises:
        BadInput: Where the file cannot be written, or stands there and may not be replaced.
    """
    if not own:
        _refuse_input(path)
    if _is_stream(path):
        with _refusing(path), path.open("ab") as device:
            yield device
        return
    with _beside(path) as (stream, target):
        if not own:
            _refuse_replacing(path, target)
        yield stream
        stream.flush()
        os.fsync(stream.fileno())
        if not own:
            _refuse_replacing(path, target, kind_made(Path(stream.name)) or "")
        status = os.fstat(stream.fileno())
        if (use := _USE.get()) is not None:
            use.inputs.pop((status.st_dev, status.st_ino), None)  # a file that was read and removed had its inode before
        Path(stream.name).replace(target)
        folder = os.open(target.parent, os.O_RDONLY)
        with suppress(OSError):  # a file system that cannot synchronise a folder has written the file all the same
            os.fsync(folder)
        os.close(folder)


@contextmanager
def writing_text(path: Path) -> Iterator[IO[str]]:
    """Write a text file in UTF-8 as `writing` does, line ends as given.

    Yields:
        A stream for the text.

    Raises:
        BadInput: As `writing` does.
    """
    with writing(path) as stream:
        text = io.TextIOWrapper(stream, encoding="utf-8", newline="")
        yield text
        text.flush()
        text.detach()


def is_growing(path: Path) -> bool:
    """Whether a process holds the lock of a regular file that it writes. Raises OSError where the file cannot be opened."""
    with path.open("rb") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def write_bytes(path: Path, content: bytes, *, own: bool = False) -> None:
    """Write a file whole or not at all.

    Args:
        own: Whether it is palpd's by its place, as for `writing`.

    Raises:
        BadInput: As `writing` does.
    """
    with writing(path, own=own) as stream:
        stream.write(content)


def copy_file(source: Path, target: Path) -> None:
    """Copy a file whole or not at all.

    Raises:
        BadInput: As `opened` and `writing` do.
    """
    with opened(source, most_bytes=1 << 50) as stream, writing(target) as copy:
        shutil.copyfileobj(stream, copy)


def write_text(path: Path, text: str, *, own: bool = False) -> None:
    """Write a text file in UTF-8 whole or not at all.

    Args:
        own: Whether it is palpd's by its place, as for `writing`.

    Raises:
        BadInput: As `writing` does.
    """
    write_bytes(path, text.encode("utf-8", "backslashreplace"), own=own)


def write_yaml(path: Path, text: str) -> None:
    """Write YAML, or other text with comments that begin with #, below a comment by which palpd knows it while it is unchanged.

    Raises:
        BadInput: As `writing` does.
    """
    write_text(path, marked_text(text))


def write_json(path: Path | None, content: object, *, own: bool = False) -> None:
    """Write data as JSON whole or not at all; what JSON has no word for (a path) is written as text.

    Args:
        path: File to write; None writes nothing.
        content: Data of dictionaries, lists, texts and numbers.
        own: Whether it is palpd's by its place, as for `writing`; it then gets no mark.

    Raises:
        BadInput: As `writing` does.
    """
    if path is not None:
        text = json.dumps(content if own else marked_json(content), indent=1, ensure_ascii=False, default=str)
        write_text(path, text + "\n", own=own)


# --- how --------------------------------------------------------------------------------------------------------------------------


def _kind(mode: int) -> str:
    kinds = {stat.S_IFDIR: "a folder", stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket"}
    return kinds.get(stat.S_IFMT(mode), "a device")


def _status(path: Path) -> os.stat_result | None:
    """What stands there, links followed; None where nothing does. Raises OSError, also where no file can be called so."""
    try:
        return path.stat()
    except OSError as failure:
        if failure.errno in (errno.ENOENT, errno.ENOTDIR, errno.ELOOP):
            return None
        raise


def _is_stream(path: Path) -> bool:
    """Whether a pipe, or a device that keeps nothing, stands there, which is written to and not replaced."""
    with _refusing(path):
        status, sink = _status(path), os.path.realpath(path) in SINKS
    mode = stat.S_IFREG if status is None else status.st_mode
    if sink or str(path).startswith(STREAMS) or stat.S_ISFIFO(mode):
        return True
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise BadInput(f"{path} is {_kind(mode)}, expected a file or a pipe; give the name of a file")
    return False


def _refuse_input(path: Path) -> None:
    use = _USE.get()
    with _refusing(path):
        status = _status(path)
    source = use.inputs.get((status.st_dev, status.st_ino)) if use and status else None
    if source is not None:
        names = f"{path} is" if source == path else f"{path} is the same file as {source},"
        raise BadInput(f"{names} an input of this command, which is never written to; give another name for the output")


def _refuse_replacing(path: Path, target: Path, kind: str | None = None) -> None:
    """Refuse to replace what stands there by a file of that kind; None: of a kind that is not known yet."""
    with _refusing(path):
        status = _status(target)
        there = kind_made(target) if status and status.st_size else None
    if status is None or status.st_size == 0:
        return
    use = _USE.get()
    force = bool(use and use.force)
    if there == RECORDING:
        if force and kind in (None, RECORDING):
            return
        way_out = _way_out() if kind == RECORDING else "only a recording may replace it; "
        raise BadInput(f"{path} is a recording, which is evidence; {way_out}give another name")
    if there is not None and kind in (None, there):
        return
    if not force:
        what = "palpd did not write what it holds" if there is None else f"it is {there}, not {kind or 'what is to be written'}"
        raise BadInput(f"{path} exists and is not overwritten: {what}; {_way_out()}give another name")


def _way_out() -> str:
    use = _USE.get()
    return "" if use is None or use.force is None else "--force replaces it all the same, or "


@contextmanager
def _beside(path: Path) -> Iterator[tuple[IO[bytes], Path]]:
    """A new file beside the one to write, gone afterwards unless it was renamed; and what it is to be renamed to."""
    with _refusing(path):
        target = Path(os.path.realpath(path))  # behind a link, so that the link stays
        status = _status(target)
        mode = None if status is None else status.st_mode
        if target.is_symlink():
            raise BadInput(f"{path} cannot be written, because it is a link that leads back to itself; remove it")
        if mode is not None and stat.S_ISDIR(mode):
            raise BadInput(f"{path} is a folder, expected the name of a file; give one")
        if status is None and target.is_relative_to("/dev") and not target.is_relative_to("/dev/shm"):
            raise BadInput(f"{path} is no device that is there, and no place for files; give another name")
        if not target.parent.is_dir():
            raise BadInput(f"{path} cannot be written, because {target.parent} is no folder; make it first")
        if mode is not None and not os.access(target, os.W_OK):
            raise BadInput(f"{path} cannot be written (it is read-only); choose another place")
    with _new_file(target.parent, path) as stream:
        if mode is not None:
            os.fchmod(stream.fileno(), stat.S_IMODE(mode))
        yield stream, target


@contextmanager
def _new_file(folder: Path, path: Path) -> Iterator[IO[bytes]]:
    """A new file in a folder, gone afterwards unless it was renamed; a failure is one of `path`."""
    with _refusing(path):
        fresh = folder / f".palpd-{os.urandom(6).hex()}"
        try:
            with fresh.open("xb") as stream:
                yield stream
        finally:
            fresh.unlink(missing_ok=True)


def _try_place(path: Path, kind: str | None) -> None:
    """Write a byte beside a file and take it back: a full disk takes a file, but no content."""
    with _beside(path) as (stream, target):
        _refuse_replacing(path, target, kind)
        stream.write(b"\0")
        stream.flush()


@contextmanager
def _refusing(path: Path) -> Iterator[None]:
    """Turn what the system says of a file that cannot be written into a sentence."""
    try:
        yield
    except OSError as failure:
        raise BadInput(f"{path} cannot be written ({failure.strerror or failure}); choose another place") from failure
