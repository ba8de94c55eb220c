"""The one way in and the one way out for files: what is read is checked first, what is written appears whole or not at all."""

import errno
import fcntl
import io
import json
import os
import re
import shutil
import stat
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from types import MappingProxyType
from typing import IO, TYPE_CHECKING, Any, NamedTuple

import yaml

from palpd.errors import BadInput, ConfigError, PalpdError, Refused
from palpd.file_kinds import RECORDING, kind_made, marked_json, marked_text, what_it_is

if TYPE_CHECKING:
    from pydantic import BaseModel, ValidationError
    from pydantic_core import ErrorDetails

Location = tuple[str | int, ...]

MOST_YAML_BYTES = 262_144
"""Largest YAML file; a plan of a thousand sites has 60 kB, and a larger one takes seconds to parse."""
MOST_JSON_BYTES = 64_000_000
"""Largest JSON file; a blind check of 1000 cases has some 5 MB."""
MOST_TABLE_BYTES = 2_000_000_000
"""Largest CSV file; a million samples of ten columns have 200 MB."""
MOST_LEVELS = 32
"""Deepest nesting of YAML and JSON; our own files have 6 levels."""
MOST_NODES = 200_000
"""Most values that a YAML file may stand for with its aliases written out; 256 kB of plain YAML hold fewer."""
STREAMS = ("/dev/stdout", "/dev/stderr", "/dev/fd/", "/proc/self/fd/")
"""Names of what a process has open already: a regular file behind one of them is appended to, never replaced."""
SINKS = ("/dev/null", "/dev/full", "/dev/tty")
"""Devices that outputs may go to, since they keep nothing."""
MOST_SOCKET_BYTES = 107
"""Longest path of a Unix socket."""
MOST_DIGITS = 40
"""Longest whole number; a 64-bit one has 19 digits, and Python refuses more than 4300."""
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


class Document(NamedTuple):
    """What a YAML file holds, and where: `places` gives a key's place, such as "plan.yaml, line 3", by its path of keys."""

    name: str
    content: Any
    places: Mapping[Location, str] = MappingProxyType({})

    def place(self, location: Location) -> str:
        """Where that key stands, or the nearest block around it that has a place."""
        for length in range(len(location), 0, -1):
            if location[:length] in self.places:
                return self.places[location[:length]]
        return self.name

    def refuse_empty(self) -> None:
        """Refuse a file that holds nothing: it was cut off, or is another one. Raises ConfigError."""
        if self.content is None:
            raise ConfigError(f"{self.name} is empty, expected keys and values; write at least one, such as version: 1")

    def keys_and_values(self) -> dict[str, Any]:
        """The content of a file that must be a mapping; an empty file is an empty one. Raises ConfigError."""
        if self.content is None:
            return {}
        if not isinstance(self.content, dict):
            raise ConfigError(f"{self.name} holds a {type(self.content).__name__}, expected keys and values")
        return self.content


def read_yaml(path: Path, *, error: type[PalpdError] = ConfigError) -> Document:
    """Read a YAML file; a key that stands twice in one block is refused with both line numbers.

    Args:
        error: Class of the refusal.

    Returns:
        Its content, None where the file is empty, with the line of each key.

    Raises:
        PalpdError: Of the class `error`, as `read_text` does, and where the text is not what `parse_yaml` accepts.
    """
    return parse_yaml(read_text(path, error=error), str(path), error=error)


def parse_yaml(text: str, name: str, *, error: type[PalpdError] = ConfigError) -> Document:
    """Parse YAML in which every key stands once and numbers are decimal (1e-3 is a number; 1:30 and 0x1F are text).

    Args:
        text: One YAML document.
        name: What an error calls it.
        error: Class of the refusal.

    Returns:
        Its content with the line of each key.

    Raises:
        PalpdError: Of the class `error`, one sentence with the line.
    """
    try:
        loader = _StrictLoader(text)
        node = loader.get_single_node()
        content = None if node is None else loader.construct_document(node)
    except yaml.MarkedYAMLError as failure:
        mark = failure.problem_mark or failure.context_mark
        line = f", line {mark.line + 1}" if mark else ""
        ours = isinstance(failure, _Refusal)
        what = failure.problem if ours else f"this is not YAML ({failure.problem or failure.context}); correct it"
        raise error(f"{name}{line}: {what}") from failure
    except (yaml.YAMLError, ValueError) as failure:
        raise error(f"{name} is not YAML ({str(failure).splitlines()[0]}); correct it") from failure
    places = {} if node is None else {location: f"{name}, line {line}" for location, line in _lines(node, ())}
    return Document(name, content, places)


def read_json(path: Path, *, most_bytes: int = MOST_JSON_BYTES, error: type[PalpdError] = BadInput) -> Any:
    """Read a JSON file; a key that stands twice in one object is refused.

    Args:
        most_bytes: Largest size in bytes.
        error: Class of the refusal.

    Raises:
        PalpdError: Of the class `error`, as `read_text` does, and where the text is not what `parse_json` accepts.
    """
    return parse_json(read_text(path, most_bytes=most_bytes, error=error), str(path), error=error)


def parse_json(text: str, name: str, *, error: type[PalpdError] = BadInput) -> Any:
    """Parse JSON in which every key stands once.

    Args:
        text: One JSON value.
        name: What an error calls it.
        error: Class of the refusal.

    Raises:
        PalpdError: Of the class `error`, one sentence.
    """
    try:
        content = json.loads(text, object_pairs_hook=_pairs, parse_int=_whole)
        if "\\u" in text:  # else nothing but a plain letter can stand in it
            _refuse_letters(content)
    except json.JSONDecodeError as failure:
        raise error(f"{name}, line {failure.lineno}: this is not JSON ({failure.msg}); correct it") from failure
    except ValueError as failure:
        raise error(f"{name}: {failure}") from failure
    except RecursionError as failure:
        raise error(_too_deep(name)) from failure
    if _deeper_than(content, MOST_LEVELS):
        raise error(_too_deep(name))
    return content


# --- what a model says of a file ----------------------------------------------------------------------------------------------


NAME_PATTERN = r"^[A-Za-z0-9_.-]+$"
"""Names that are parts of file names and of columns."""


def refusal(error: "ValidationError", model: "type[BaseModel]", document: Document, hints: Mapping[str, str] | None = None) -> str:
    """Turn the first complaint of pydantic into one sentence: file, line, what was found, what was expected.

    Args:
        error: What validation raised.
        model: Model that the document was validated against.
        document: Names the file and the lines of its keys.
        hints: Questions to ask about a number out of range, by the end of the key that it belongs to; None for none.
    """
    first = error.errors(include_url=False)[0]
    return f"{document.place(first['loc'])}: {_complaint(first, model, hints)}"


def faults(error: "ValidationError", model: "type[BaseModel]", hints: Mapping[str, str] | None = None) -> dict[str, str]:
    """Turn every complaint of pydantic into a sentence without its place.

    Args:
        error: As for `refusal`.
        model: As for `refusal`.
        hints: As for `refusal`.

    Returns:
        The sentences by the path of their key, such as `sites.2.x_m`; the path of what belongs to no key is empty.
    """
    wrong = {".".join(map(str, each["loc"])): _complaint(each, model, hints) for each in error.errors(include_url=False)}
    # a list without what is wrong in it may be too short, which is no fault of its own
    return {path: sentence for path, sentence in wrong.items() if not any(each.startswith(f"{path}.") for each in wrong)}


def _complaint(complaint: "ErrorDetails", model: "type[BaseModel]", hints: Mapping[str, str] | None) -> str:
    location, message = complaint["loc"], complaint["msg"]
    key = ".".join(map(str, location)) or "the file"
    if complaint["type"] == "extra_forbidden":
        known = _fields_at(model, location[:-1])
        return f"there is no key {key!r}{nearest(str(location[-1]), known)}; expected {', '.join(known)}"
    if complaint["type"] == "missing":
        return f"{key} is not given; it has no default"
    if complaint["type"] == "value_error":
        return f"{f'{key}: ' if location else ''}{message.removeprefix('Value error, ')}"
    if complaint["type"] == "string_pattern_mismatch" and complaint["ctx"]["pattern"] == NAME_PATTERN:
        return f"{key} is {_shown(complaint['input'])}; expected letters (a to z), digits, '.', '_' and '-', without a space"
    bounds = ("less_than", "less_than_equal", "greater_than", "greater_than_equal")
    ranged = complaint["type"] in bounds or isinstance(complaint["input"], str)
    hint = next((f" ({hint})" for end, hint in (hints or {}).items() if ranged and key.endswith(end)), "")
    expected = message.replace("Input should be", "expected").replace("a valid ", "a ")
    return f"{key} is {_shown(complaint['input'])}{hint}; {expected[0].lower()}{expected[1:]}"


def nearest(word: str, known: list[str]) -> str:
    """Ask whether a known word was meant: " (did you mean 'x'?)", or nothing where none is like it.

    Args:
        known: What could have been written.

    Returns:
        The question, or an empty text.
    """
    import difflib  # here and not above: only a refusal needs it, and an abort must not wait for it

    close = difflib.get_close_matches(word, known, n=1, cutoff=0.5)
    return f" (did you mean {close[0]!r}?)" if close else ""


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


class _Refusal(yaml.MarkedYAMLError):
    """A refusal of ours; its problem is a sentence already."""


class _StrictLoader(yaml.SafeLoader):
    """YAML as our files use it: no duplicate keys, bounded nesting and aliases, numbers in decimal only."""

    yaml_implicit_resolvers = {  # noqa: RUF012 - PyYAML declares it so
        first: [(tag, pattern) for tag, pattern in resolvers if not tag.endswith((":int", ":float"))]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._level = 0
        self._sizes: dict[int, int] = {}

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Compose the next node, and refuse nesting that is too deep and aliases that stand for too much.

        Args:
            parent: Node around it.
            index: Its key or number there.

        Returns:
            The node.

        Raises:
            yaml.MarkedYAMLError: Where it is refused.
        """
        mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
        if self._level >= MOST_LEVELS:
            raise _Refusal(problem=f"blocks are nested deeper than {MOST_LEVELS} levels; write it flatter", problem_mark=mark)
        alias = self.check_event(yaml.AliasEvent)
        self._level += 1
        node = super().compose_node(parent, index)
        self._level -= 1
        if node is None or id(node) in self._sizes:
            return node
        if alias:
            raise _Refusal(problem="an alias stands inside what it names; write the value out", problem_mark=mark)
        children = [child for pair in node.value for child in pair] if isinstance(node, yaml.MappingNode) else node.value
        inner = children if isinstance(node, yaml.CollectionNode) else []
        self._sizes[id(node)] = 1 + sum(self._sizes[id(child)] for child in inner)
        if self._sizes[id(node)] > MOST_NODES:
            raise _Refusal(problem=f"the aliases stand for more than {MOST_NODES} values; write fewer", problem_mark=mark)
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Construct a mapping, and refuse a key that stands in it twice.

        Args:
            deep: Whether what it holds is constructed at once.

        Raises:
            yaml.MarkedYAMLError: Where a key stands twice or is no name.
        """
        lines: dict[Any, int] = {}
        for key_node, _ in node.value:
            merge = key_node.tag == "tag:yaml.org,2002:merge"
            key = "<<" if merge else self.construct_object(key_node, deep=True)
            if not isinstance(key, str | int | float | bool | None):
                raise _Refusal(problem=f"a {type(key).__name__} is no key; expected a name", problem_mark=key_node.start_mark)
            line = key_node.start_mark.line + 1
            if key in lines:
                raise _Refusal(
                    problem=f"the key {str(key)!r} stands here and in line {lines[key]}, expected once; remove one of them",
                    problem_mark=key_node.start_mark,
                )
            lines[key] = line
        return super().construct_mapping(node, deep)

    def text(self, node: yaml.ScalarNode) -> str:
        """Construct a text that file names and terminals can hold."""
        try:
            return _plain(node.value)
        except ValueError as failure:
            raise _Refusal(problem=str(failure), problem_mark=node.start_mark) from failure

    def whole_number(self, node: yaml.ScalarNode) -> int:
        """Construct a decimal whole number of bounded length."""
        try:
            return _whole(node.value)
        except ValueError as failure:
            raise _Refusal(problem=str(failure), problem_mark=node.start_mark) from failure


_StrictLoader.add_implicit_resolver("tag:yaml.org,2002:int", re.compile(r"^[-+]?[0-9]+$"), list("-+0123456789"))
_StrictLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^(?:[-+]?(?:[0-9]+\.[0-9]*|\.[0-9]+|[0-9]+(?=[eE]))(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"),
    list("-+0123456789."),
)
_StrictLoader.add_constructor("tag:yaml.org,2002:int", _StrictLoader.whole_number)
_StrictLoader.add_constructor("tag:yaml.org,2002:str", _StrictLoader.text)


def _lines(node: yaml.Node, at: Location) -> Iterator[tuple[Location, int]]:
    """The line of every key and list entry of a node, by its path of keys."""
    if isinstance(node, yaml.MappingNode):
        inner = [(key.value, key, value) for key, value in node.value if isinstance(key, yaml.ScalarNode)]
    elif isinstance(node, yaml.SequenceNode):
        inner = [(number, value, value) for number, value in enumerate(node.value)]
    else:
        return
    for key, where, value in inner:
        yield (*at, key), where.start_mark.line + 1
        yield from _lines(value, (*at, key))


def _pairs(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the key {twice!r} stands twice in one object, expected once; remove one of them")
    return content


def _plain(text: str) -> str:
    try:
        os.fsencode(text)  # as Python gives it to the system: a byte of a file name that is not UTF-8 stands for itself
    except UnicodeEncodeError as failure:
        raise ValueError(f"a text holds {text[failure.start]!r}, which no file name can hold; remove it") from failure
    if "\0" in text:
        raise ValueError("a text holds '\\x00', which no file name can hold; remove it")
    return text


def _whole(text: str) -> int:
    if len(text) > MOST_DIGITS:
        raise ValueError(f"a whole number has {len(text)} digits, expected at most {MOST_DIGITS}; correct it")
    return int(text)


def _too_deep(name: str) -> str:
    return f"{name}: blocks are nested deeper than {MOST_LEVELS} levels; write it flatter"


def _deeper_than(content: object, levels: int) -> bool:
    inner = content.values() if isinstance(content, dict) else content if isinstance(content, list) else ()
    return any(levels <= 1 or _deeper_than(each, levels - 1) for each in inner)


def _refuse_letters(content: object) -> None:
    """Refuse JSON that holds a letter which is none. Raises ValueError."""
    if isinstance(content, str):
        _plain(content)
    for each in (*content, *content.values()) if isinstance(content, dict) else content if isinstance(content, list) else ():
        _refuse_letters(each)


def _shown(value: object) -> str:
    """A value as the file has it, cut short."""
    if isinstance(value, bool):
        return "true" if value else "false"
    import reprlib

    return "null" if value is None else reprlib.repr(value)


def _fields_at(model: Any, location: Location) -> list[str]:
    """The keys that a block may hold, by its place in the file."""
    for part in location:
        inner = getattr(model, "model_fields", {}).get(part)
        if inner is not None:
            model = model_in(inner.annotation) or model
    return list(getattr(model, "model_fields", {}))


def model_in(annotation: Any) -> Any:
    """Find the model that an annotation such as `tuple[Site, ...]` or `Wall | None` speaks of.

    Args:
        annotation: Type of a field.

    Returns:
        The first model in it, or None.
    """
    if hasattr(annotation, "model_fields"):
        return annotation
    return next((model for part in getattr(annotation, "__args__", ()) if (model := model_in(part))), None)


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
