"""The catalogue of the runs in a folder: one SQLite file beside the recordings, made from them and from what stands beside them.

It holds nothing that is not in those files. So it may be deleted, is made anew where it is damaged, and no tag is lost with it.

It uses SQLite's rollback journal and waits for a busy file. The write-ahead log would let readers never wait, but a reader then needs
the right to write in the folder, and network file systems are excluded. Writes are one short transaction a run.
"""

import contextlib
import os
import sqlite3
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any, NamedTuple, Self, TypeVar

from palpd.documents import read_json
from palpd.errors import BadInput, PalpdError, Refused
from palpd.history.dates import local_time
from palpd.history.facts import RunFacts, load
from palpd.history.remarks import remarks_of
from palpd.history.stored import DIAGNOSIS, StoredRecording, stored_recordings

FILE = "catalogue.sqlite"
SCHEMA_NUMBER = 4
"""Raised whenever catalogue.sql or the meaning of a column changes: a catalogue with another number is made anew."""
BUSY_S = 10.0
"""Longest wait for another process that writes. A write takes milliseconds."""
MOST_DIAGNOSIS_BYTES = 20_000_000
UNREADABLE = "unreadable"
"""Verdict of a recording that cannot be read; its reason is the sentence of the refusal."""

AS_IN_FACTS = (
    "started_s", "kind", "dry", "verdict", "reason", "duration_s", "peak_force_N", "config_sha256", "model_sha256",
    "machine_stiffness_N_per_m",
)  # fmt: skip
"""Columns of a run that are facts of the same name."""
SCHEMA = Path(__file__).with_suffix(".sql")

Answer = TypeVar("Answer")
ShowRead = Callable[[int, int, str], None]
"""Shows progress: number of recordings read, number to read, and the name of the next."""


class SiteModuli(NamedTuple):
    """Moduli of a site in one run, in Pa, with 95 % intervals; what the run does not give is None. `dynamic_Pa` is as measured.

    With `hertz_misfit` the moduli change with depth, and the intervals cover their range.
    """

    site: str
    static_Pa: float | None
    static_ci95_Pa: tuple[float, float] | None
    dynamic_Pa: float | None
    corrected_Pa: float | None
    corrected_ci95_Pa: tuple[float, float] | None
    hertz_misfit: bool = False


class RunEntry(NamedTuple):
    """One line of the catalogue. Of a recording that cannot be read the figures are None, and `reason` says why."""

    name: str
    started: str
    started_s: float
    kind: str
    dry: bool
    verdict: str
    reason: str
    duration_s: float | None
    ticks: int | None
    missed: int | None
    peak_force_N: float | None
    cut_short: int | None
    robot_host: str | None
    sensor_serial: str | None
    config_sha256: str | None
    model_sha256: str | None
    machine_stiffness_N_per_m: float | None
    tags: tuple[str, ...]
    note: str
    sites: tuple[SiteModuli, ...] = ()


@dataclass(frozen=True, slots=True)
class RunFilter:
    """Which runs are asked for; an empty field asks for all.

    `since_s` and `until_s` are Unix times, the second one exclusive. `text` is looked for in name, reason, notes, tags, sites and devices.
    """

    since_s: float | None = None
    until_s: float | None = None
    site: str = ""
    verdict: str = ""
    kind: str = ""
    tags: tuple[str, ...] = ()
    text: str = ""
    most: int | None = None


class EffectPoint(NamedTuple):
    """A parameter of an effect that a diagnosis of a run has named, with its 95 % interval."""

    run: str
    started: str
    started_s: float
    site: str
    effect: str
    parameter: str
    value: float
    low: float | None
    high: float | None
    probability: float


class _Damaged(Exception):
    """The file is no catalogue of this version."""


@dataclass
class Catalogue:
    """The catalogue of a folder, open. `notes` are sentences for the user: that it was made anew, or is not kept."""

    folder: Path
    notes: list[str] = field(default_factory=list)
    _connection: sqlite3.Connection | None = field(default=None, repr=False)
    _was_damaged: bool = field(default=False, repr=False)

    @property
    def path(self) -> Path:
        """The file."""
        return self.folder / FILE

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def refresh(self, show: ShowRead = lambda *_: None) -> int:
        """Read what is new or has changed in the folder, and forget what is gone.

        Args:
            show: Shows progress; reading takes a second for some minutes of a run.

        Returns:
            The number of recordings that were read.

        Raises:
            BadInput: The folder cannot be read.
            Refused: Another process keeps the catalogue busy.
        """
        if not os.path.isdir(self.folder):  # noqa: PTH112 - a name that is too long is no folder either, and Path raises
            raise BadInput(f"{self.folder} is no folder, expected that of the runs; palpd run makes it, or give --folder")
        recordings = stored_recordings(self.folder)
        return self._answered(lambda connection: _refresh(connection, recordings, show))

    def keep(self, recording: StoredRecording, facts: RunFacts) -> None:
        """Take up a recording of the folder that was read already.

        Raises:
            Refused: Another process keeps the catalogue busy.
        """
        stamps = _stamp(recording.stamp), _stamp(recording.beside)
        self._answered(lambda connection: _keep(connection, recording, stamps, facts))

    def rebuild(self, show: ShowRead = lambda *_: None) -> int:
        """Make the catalogue anew from the recordings.

        Args:
            show: As for `refresh`.

        Returns:
            The number of recordings that were read.

        Raises:
            BadInput: The folder cannot be read, or the old file cannot be removed.
            Refused: Another process keeps the catalogue busy.
        """
        self._remove()
        return self.refresh(show)

    def runs(self, only: RunFilter = RunFilter()) -> list[RunEntry]:
        """The runs that are asked for, newest first.

        Raises:
            Refused: Another process keeps the catalogue busy.
        """
        return self._answered(lambda connection: _runs(connection, only))

    def count(self, only: RunFilter = RunFilter()) -> int:
        """Number of runs that are asked for, whatever `most` says.

        Raises:
            Refused: Another process keeps the catalogue busy.
        """
        where, values = _conditions(only)
        return int(self._answered(lambda connection: connection.execute(f"SELECT count(*) FROM runs WHERE {where}", values).fetchone()[0]))

    def effects(self, site: str = "") -> list[EffectPoint]:
        """What diagnoses of the runs have named, oldest first.

        Args:
            site: Only diagnoses of this site; empty for all.

        Returns:
            One point a run, effect and parameter.

        Raises:
            Refused: Another process keeps the catalogue busy.
        """
        return self._answered(lambda connection: _effects(connection, site))

    # --- the file --------------------------------------------------------------------------------------------------------------

    def _answered(self, work: Callable[[sqlite3.Connection], Answer]) -> Answer:
        """Work with the open catalogue; make it anew where it turns out to be damaged, and go on in memory where it cannot be written."""
        for last in (False, False, True):
            try:
                return work(self._opened())
            except (_Damaged, sqlite3.DatabaseError) as error:
                kind = _kind(error)
                if kind == "busy":
                    raise Refused(f"{self.path} was kept busy by another process for more than {BUSY_S:g} s; try again") from error
                if last:
                    raise BadInput(f"{self.path} cannot be made or read ({error}); move it away and try again") from error
                if kind == "not writable":
                    self._keep_in_memory(error)
                    continue
                try:
                    self._remove()
                    self._was_damaged = True
                except BadInput:
                    self._keep_in_memory(error, from_file=False)
        raise AssertionError

    def _opened(self) -> sqlite3.Connection:
        if self._connection is None:
            self._connection = _connect(self.path)
            _prepare(self._connection)
        if self._was_damaged:
            read = _refresh(self._connection, stored_recordings(self.folder), lambda *_: None)
            self._was_damaged = False
            why = "was damaged or of another version"
            self.notes.append(f"{self.path} {why}; it was made anew from {read} recordings, and no tag or note was lost")
        return self._connection

    def _keep_in_memory(self, error: Exception, *, from_file: bool = True) -> None:
        """Copy what the file holds into memory and go on there, or make it anew there: a user may look without the right to write."""
        memory = sqlite3.connect(":memory:", isolation_level=None)
        if from_file:
            with contextlib.suppress(sqlite3.DatabaseError, _Damaged), contextlib.closing(_connect(self.path, "ro")) as file:
                _prepare(file, change=False)
                file.backup(memory)
        self.close()
        _prepare(memory)
        if not from_file:
            _refresh(memory, stored_recordings(self.folder), lambda *_: None)
        self._connection = memory
        self.notes.append(f"{self.path} cannot be written ({error}); this answer is right, but is not kept for the next time")

    def _remove(self) -> None:
        self.close()
        for ending in ("", "-journal"):
            try:
                self.path.with_name(FILE + ending).unlink()
            except FileNotFoundError:
                continue
            except OSError as error:
                raise BadInput(f"{self.path} cannot be made anew ({error.strerror}); remove it as a user who may") from error


def _connect(path: Path, mode: str = "rwc") -> sqlite3.Connection:
    return sqlite3.connect(f"{path.absolute().as_uri()}?mode={mode}", uri=True, timeout=BUSY_S, isolation_level=None)


def _prepare(connection: sqlite3.Connection, *, change: bool = True) -> None:
    """Make the tables of an empty file. Raises _Damaged where the file holds something else."""
    number = connection.execute("PRAGMA user_version").fetchone()[0]
    if number == 0 and change:
        with _writing(connection):
            if connection.execute("PRAGMA user_version").fetchone()[0] == 0:  # nobody else has made them meanwhile
                if connection.execute("SELECT 1 FROM sqlite_master").fetchone():
                    raise _Damaged
                for statement in filter(str.strip, SCHEMA.read_text(encoding="utf-8").split(";")):
                    connection.execute(statement)
                connection.execute(f"PRAGMA user_version = {SCHEMA_NUMBER}")
    elif number != SCHEMA_NUMBER:
        raise _Damaged


@contextlib.contextmanager
def _writing(connection: sqlite3.Connection) -> Iterator[None]:
    """One transaction, which begins as a writer: two that begin as readers could block each other."""
    connection.execute("BEGIN IMMEDIATE")
    try:
        yield
        connection.execute("COMMIT")
    except BaseException:
        with contextlib.suppress(sqlite3.DatabaseError):
            connection.execute("ROLLBACK")
        raise


def _kind(error: Exception) -> str:
    code = getattr(error, "sqlite_errorcode", sqlite3.SQLITE_CORRUPT) & 0xFF
    if code in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
        return "busy"
    if code in (sqlite3.SQLITE_READONLY, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_PERM, sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR):
        return "not writable"
    return "damaged"


# --- from files into tables -------------------------------------------------------------------------------------------------------


def _refresh(connection: sqlite3.Connection, recordings: dict[str, StoredRecording], show: ShowRead) -> int:
    """Read what is not known, and what stands beside known recordings where that has changed; forget what is gone."""
    known = {os.fsdecode(name): stamps for name, *stamps in connection.execute("SELECT name, recording, beside FROM runs")}
    if gone := [os.fsencode(name) for name in known.keys() - recordings.keys()]:
        with _writing(connection):
            for table, column in (("runs", "name"), ("moduli", "run"), ("effects", "run")):
                connection.executemany(f"DELETE FROM {table} WHERE {column} = ?", [(name,) for name in gone])
    stamps = {name: (_stamp(each.stamp), _stamp(each.beside)) for name, each in recordings.items()}
    changed = {name for name in recordings if known.get(name, [""])[0] != stamps[name][0]}
    for number, name in enumerate(sorted(changed)):
        show(number, len(changed), name)
        _read(connection, recordings[name], stamps[name])
    for name in recordings.keys() - changed:
        if known[name][1] != stamps[name][1]:
            with _writing(connection):
                _read_beside(connection, recordings[name], stamps[name][1])
    return len(changed)


def _stamp(content: Any) -> str:
    """What tells whether files are still those that were read, as text."""
    if isinstance(content, dict):
        return " ".join(f"{_stamp(stamp)}:{os.fsencode(name).hex()}" for name, stamp in sorted(content.items()))
    return f"{content.bytes}@{content.written_ns}"


def _read(connection: sqlite3.Connection, recording: StoredRecording, stamps: tuple[str, str]) -> None:
    """Read a recording. One that cannot be read is kept with the reason."""
    try:
        _, facts = load(recording.path)
        _keep(connection, recording, stamps, facts)
    except PalpdError as error:
        _insert(connection, recording, stamps, _unreadable(recording, str(error)), [])


def _keep(connection: sqlite3.Connection, recording: StoredRecording, stamps: tuple[str, str], facts: RunFacts) -> None:
    _insert(connection, recording, stamps, _row(facts), [_moduli(place, site) for place, site in enumerate(facts["sites"])])


def _insert(
    connection: sqlite3.Connection,
    recording: StoredRecording,
    stamps: tuple[str, str],
    row: dict[str, Any],
    moduli: list[tuple[Any, ...]],
) -> None:
    """Put a run into the tables, in place of what stood there of it."""
    name = os.fsencode(recording.name)
    texts = {key: _text(value) if isinstance(value, str) else value for key, value in row.items()}
    columns = {"name": name, "recording": stamps[0], "beside": "", **texts}
    with _writing(connection):
        connection.execute(
            f"INSERT OR REPLACE INTO runs ({', '.join(columns)}) VALUES ({', '.join('?' * len(columns))})", tuple(columns.values())
        )
        connection.execute("DELETE FROM moduli WHERE run = ?", (name,))
        connection.executemany(f"INSERT INTO moduli VALUES ({', '.join('?' * 11)})", [(name, *each) for each in moduli])
        _read_beside(connection, recording, stamps[1])


def _row(facts: RunFacts) -> dict[str, Any]:
    about = facts["about"]
    searched = (
        facts["kind"], facts["verdict"], facts["reason"], *(site["name"] for site in facts["sites"]), about.get("robot_host", ""),
        about.get("sensor_serial", ""), *facts["cut_short"],
    )  # fmt: skip
    return {
        **{name: value for name, value in facts.items() if name in AS_IN_FACTS},
        "ticks": facts["loop"]["ticks"],
        "missed": facts["loop"]["missed"],
        "cut_short": len(facts["cut_short"]),
        "robot_host": about.get("robot_host"),
        "sensor_serial": about.get("sensor_serial"),
        "facts": "\n".join(map(_text, searched)).lower(),
    }


def _unreadable(recording: StoredRecording, reason: str) -> dict[str, Any]:
    return {
        "started_s": recording.stamp.written_ns / 1e9,
        "kind": "",
        "dry": False,
        "verdict": UNREADABLE,
        "reason": _text(reason),
        "facts": _text(reason).lower(),
    }


def _moduli(place: int, site: Any) -> tuple[Any, ...]:
    static, corrected = site["static_ci95_Pa"] or (None, None), site["dynamic_corrected_ci95_Pa"] or (None, None)
    return (
        place, _text(site["name"]), site["static_youngs_modulus_Pa"], *static, site["dynamic_original_Pa"], site["dynamic_corrected_Pa"],
        *corrected, site["hertz_misfit"] is not None,
    )  # fmt: skip


def _read_beside(connection: sqlite3.Connection, recording: StoredRecording, stamp: str) -> None:
    """Take over tags, notes and diagnoses; what cannot be read stands as a note."""
    name, problems = os.fsencode(recording.name), []
    tags, note, searched = "", "", ""
    try:
        remarks = remarks_of(recording.path)
        tags = "".join(f" {_text(tag)} " for tag in remarks.tags)
        note = remarks.notes[-1].text if remarks.notes else ""
        searched = "\n".join((*remarks.tags, *(each.text for each in remarks.notes)))
    except PalpdError as error:
        problems.append(str(error))
    points: list[tuple[Any, ...]] = []
    for file in sorted(recording.beside):
        if file.endswith(DIAGNOSIS):
            try:
                points += _named_effects(recording.path.with_name(file), recording.path.stem)
            except PalpdError as error:
                problems.append(str(error))
    note = _text("; ".join(filter(None, (note, *problems))))
    connection.execute(
        "UPDATE runs SET beside = ?, tags = ?, note = ?, remarks = ? WHERE name = ?",
        (stamp, tags, note, _text(f"{os.fsdecode(name)}\n{searched}\n{note}").lower(), name),
    )
    connection.execute("DELETE FROM effects WHERE run = ?", (name,))
    connection.executemany(f"INSERT INTO effects VALUES ({', '.join('?' * 8)})", [(name, *each) for each in points])


def _named_effects(path: Path, stem: str) -> list[tuple[Any, ...]]:
    """What a diagnosis has named. Raises BadInput where the file is no diagnosis."""
    content = read_json(path, most_bytes=MOST_DIAGNOSIS_BYTES)
    site = path.name.removesuffix(DIAGNOSIS)[len(stem) :].removeprefix(".")
    try:
        return [
            (_text(site), _text(effect["id"]), _text(name), *map(float, (p["value"], *p["ci95"], effect["probability"])))
            for effect in content["effects"]
            for name, p in effect["parameters"].items()
        ]
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise BadInput(f"{path} is no diagnosis ({type(error).__name__}: {error}); write it with palpd diagnose --json") from error


def _text(value: object) -> str:
    """A text that a database can hold: bytes of a name that are not UTF-8 are spelled out."""
    return str(value).encode("utf-8", "backslashreplace").decode()


# --- from tables to answers -----------------------------------------------------------------------------------------------------


def _runs(connection: sqlite3.Connection, only: RunFilter) -> list[RunEntry]:
    where, values = _conditions(only)
    limit = f" LIMIT {int(only.most)}" if only.most is not None else ""
    order = f"ORDER BY started_s DESC, name DESC{limit}"
    of_site = (
        "run, site, hertz_misfit, static_Pa, static_low_Pa, static_high_Pa, dynamic_Pa, corrected_Pa, corrected_low_Pa, corrected_high_Pa"
    )
    chosen = "" if where == "1" and not limit else f"WHERE run IN (SELECT name FROM runs WHERE {where} {order})"
    moduli: dict[bytes, list[SiteModuli]] = defaultdict(list)
    query = f"SELECT {of_site} FROM moduli {chosen} ORDER BY run, place"
    for run, site, misfit, static_Pa, low_Pa, high_Pa, dynamic_Pa, corrected_Pa, below_Pa, above_Pa in connection.execute(query, values):
        static, corrected = None if low_Pa is None else (low_Pa, high_Pa), None if below_Pa is None else (below_Pa, above_Pa)
        moduli[run].append(SiteModuli(site, static_Pa, static, dynamic_Pa, corrected_Pa, corrected, bool(misfit)))
    names = [name for name in RunEntry._fields if name not in ("started", "sites")]
    entries = []
    for values_of_run in connection.execute(f"SELECT {', '.join(names)} FROM runs WHERE {where} {order}", values):
        run = dict(zip(names, values_of_run, strict=True))
        run |= {"sites": tuple(moduli.get(run["name"], ())), "name": os.fsdecode(run["name"]), "started": local_time(run["started_s"])}
        entries.append(RunEntry(**run | {"dry": bool(run["dry"]), "tags": tuple(run["tags"].split())}))
    return entries


def _conditions(only: RunFilter) -> tuple[str, tuple[Any, ...]]:
    possible: list[tuple[str, Any]] = [
        ("started_s >= ?", only.since_s),
        ("started_s < ?", only.until_s),
        ("name IN (SELECT run FROM moduli WHERE site = ?)", _text(only.site)),
        ("verdict = ?", _text(only.verdict)),
        ("kind = ?", _text(only.kind)),
        *(("instr(tags, ?) > 0", f" {_text(tag)} ") for tag in only.tags),
        ("instr(facts || char(10) || remarks, ?) > 0", _text(only.text).lower()),
    ]
    conditions = [(condition, value) for condition, value in possible if value not in (None, "")]
    return " AND ".join(condition for condition, _ in conditions) or "1", tuple(value for _, value in conditions)


def _effects(connection: sqlite3.Connection, site: str) -> list[EffectPoint]:
    query = (
        "SELECT run, started_s, site, effect, parameter, value, low, high, probability FROM effects JOIN runs ON runs.name = run "
        "WHERE ? IN ('', site) AND kind <> 'injection' ORDER BY started_s, effect, parameter"
    )
    points = connection.execute(query, (_text(site),))
    return [EffectPoint(os.fsdecode(run), local_time(started_s), started_s, *rest) for run, started_s, *rest in points]


def as_json(thing: Any) -> Any:
    """What the history answers with, for `--json` and for a web page: named tuples and dataclasses become dictionaries."""
    if isinstance(thing, tuple) and hasattr(thing, "_fields"):
        return {name: as_json(value) for name, value in zip(thing._fields, thing, strict=True)}
    if is_dataclass(thing):
        return {each.name: as_json(getattr(thing, each.name)) for each in fields(thing)}
    if isinstance(thing, dict):
        return {key: as_json(value) for key, value in thing.items()}
    return [as_json(each) for each in thing] if isinstance(thing, list | tuple) else thing
