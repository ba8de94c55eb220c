"""Reading recordings: the rows, samples for the diagnosis, and a robot and a sensor that repeat them."""

import json
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from palpd.errors import RecordingError
from palpd.files import opened
from palpd.recording import cdr
from palpd.recording.header import RecordingFooter, RecordingHeader
from palpd.recording.mcap_file import FOOTER, HEADER, Contents
from palpd.recording.samples import SITE_COLUMN, Samples, is_parquet, samples_from_columns, write_csv, write_parquet
from palpd.recording.tick_rows import filled_slots
from palpd.tick import NO_FRAMES, ROW, Floats, Mode, Phase, RobotState, SensorFrames, UncommandedRobot

Rows = NDArray[np.void]

MOST_BYTES = 30_000_000_000
"""Largest recording; a day of 17 MB a minute has 24 GB."""


@dataclass(frozen=True)
class Recording:
    """One closed recording.

    `rows` has the fields of ROW, with as many frame slots as the fullest tick needs (a ROW of 64 would be 1 MB a second);
    `widened` turns them into ROWs. Slots that a tick did not fill are zero. `second` (n, 6) is the second channel of a run of
    `palpd inject`, frame by frame; None for all other runs.
    """

    path: Path
    rows: Rows
    header: RecordingHeader
    footer: RecordingFooter
    model_bytes: bytes | None
    second: Floats | None = None

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a recording and verify every checksum in it. Raises RecordingError."""
        if path.suffix == ".part":
            raise RecordingError(f"{path} was never closed; run palpd recover {path} and give the file it writes")
        with opened(path, most_bytes=MOST_BYTES, error=RecordingError):
            pass  # a pipe would be waited for
        contents = Contents()
        messages = [message for batch in contents.batches(path) for message in batch]
        if contents.torn:
            raise RecordingError(
                f"{path} is truncated or corrupt {contents.torn}; rename it to {path.stem}.part and run palpd recover to save what is whole"
            )
        contents.refuse_foreign(path)
        if contents.footer is None:
            raise RecordingError(f"{path} has no end; rename it to {path.stem}.part and run palpd recover")
        assert contents.header is not None
        if not messages:
            raise RecordingError(f"{path} holds no tick; give a recording of a run that began")
        rows = cdr.unpack_ticks(messages, contents.absent)
        second = cdr.unpack_wrenches(contents.second) if contents.second else None
        return cls(path, rows, contents.header, contents.footer, contents.model_bytes, second)

    @property
    def injected(self) -> bool:
        """Whether it is a run of `palpd inject`. Its rows are those of the sensor all the same."""
        return bool(self.header.get("injection"))

    def refuse_injected(self) -> None:
        """Refuse a run of `palpd inject`, for what learns from recordings. Raises RecordingError."""
        if self.injected:
            raise RecordingError(
                f"{self.path} is a run of palpd inject, from which nothing is learned; give a run without a planted effect"
            )

    def with_second_channel(self) -> Self:
        """The same run with its second channel in the place of the tared wrench. Raises RecordingError where it has none, or a torn one."""
        filled = filled_slots(self.rows)
        frames, held = int(filled.sum()), 0 if self.second is None else len(self.second)
        if self.second is None or held != frames:
            raise RecordingError(
                f"{self.path} holds {held} frames of a second channel, expected {frames}; give a whole recording of palpd inject"
            )
        rows = self.rows.copy()
        rows["tared"][filled] = self.second
        return replace(self, rows=rows)

    def site_index(self, name: str) -> int:
        """Return the number of a site in the rows. Raises RecordingError."""
        names = [site["name"] for site in self.header.get("sites", [])]
        if name not in names:
            raise RecordingError(f"{self.path} has no site {name or 'without a name'}; it has {', '.join(names) or 'none'}")
        return names.index(name)

    def site_name(self, number: int) -> str:
        """Return the name of a site by its number in the rows; the number itself where the header names none."""
        sites = self.header.get("sites", [])
        return str(sites[number]["name"]) if number < len(sites) else str(number)


def read_header(path: Path) -> RecordingHeader:
    """Read the header of a recording without its ticks. Raises RecordingError."""
    contents = Contents()
    next(contents.batches(path), None)
    contents.refuse_foreign(path)
    assert contents.header is not None
    return contents.header


def refuse_site(path: Path, site: str | None) -> None:
    """Refuse the name of a site for a file that is no recording of the daemon.

    Args:
        site: The name, or None.

    Raises:
        RecordingError: A site is named.
    """
    if site is not None:
        raise RecordingError(f"{path.name} is no recording of the daemon, so --site {site} chooses nothing in it; leave --site out")


def holds_ticks(path: Path) -> bool:
    """Whether a file is a recording of the daemon's ticks by its name; others are tables of samples."""
    return path.suffix in (".mcap", ".part")


def widened(rows: Rows) -> Rows:
    """Give rows the full width of ROW.

    Args:
        rows: rows (n,) with the fields of ROW and any number of frame slots.

    Returns:
        The same rows as ROWs (n,).
    """
    wide = np.zeros(len(rows), ROW)
    for name in rows.dtype.names or ():
        if name in cdr.PER_FRAME:
            wide[name][:, : rows[name].shape[1]] = rows[name]
        else:
            wide[name] = rows[name]
    return wide


def same_rows(one: Rows, other: Rows) -> NDArray[np.bool_]:
    """Compare two lists of rows bit for bit: a NaN equals itself, 0.0 does not equal -0.0.

    Args:
        one: rows (n,) with the fields of ROW.
        other: as many others.

    Returns:
        For each pair (n,) whether every filled field is the same.
    """
    same: NDArray[np.bool_] = one["frames"] == other["frames"]
    filled = np.arange(ROW["frame_t_s"].shape[0]) < one["frames"][:, None]
    for name in ROW.names or ():
        a, b = (np.ascontiguousarray(rows[name]) for rows in (one, other))
        if name in cdr.PER_FRAME:
            slots = min(a.shape[1], b.shape[1])
            a, b = a[:, :slots], b[:, :slots]
            unlike = _bytes(a, 2) != _bytes(b, 2)
            same &= ~(unlike.any(axis=2) & filled[:, :slots]).any(axis=1)
        else:
            same &= (_bytes(a, 1) == _bytes(b, 1)).all(axis=1)
    return same


def _bytes(values: NDArray[Any], axes: int) -> NDArray[np.uint8]:
    entries = values.shape[:axes]
    width = values.dtype.itemsize * int(np.prod(values.shape[axes:]))
    return np.frombuffer(values.tobytes(), np.uint8).reshape(*entries, width)


STILL_M_PER_S = 1e-6
"""Target speed below which the arm stands still: controllers report exactly zero, or rounding."""


def samples_of(recording: Recording, site: str | None = None, *, at_reports: bool = False) -> Samples:
    """Make one sample of each sensor frame and interpolate the robot's state between its reports.

    The wrench is the tared sensor in base axes without compensation. Frames before the robot's first and after its last report are left
    out, and so are frames that are not newer than all before. The samples of one site begin where its own part begins: after the tare
    (which ends with the first motion of the run) and after the travel to the site.

    Args:
        recording: a closed recording.
        site: name of the only site to use; None uses all.
        at_reports: whether to keep only the frame next to each report of the robot: with fewer rows a diagnosis is faster. Every n-th row
            would hold heights that were interpolated between two reports, whose noise is not white.

    Returns:
        The samples, beginning at 0 s.

    Raises:
        RecordingError: the site is unknown, or too few states or frames are usable.
    """
    return _samples_and_rows(recording, site, at_reports)[0]


def _samples_and_rows(recording: Recording, site: str | None, at_reports: bool = False) -> tuple[Samples, Rows, NDArray[np.intp]]:
    """Samples (n,), the rows of the recording from which they come, and the number of each sample's row (n,) among them."""
    rows = recording.rows
    known = np.isfinite(rows["robot_t_s"]) & (rows["connected"] != 0)
    robot_t_s, first = np.unique(rows["robot_t_s"][known], return_index=True)
    if len(robot_t_s) < 2:
        raise RecordingError(f"{recording.path} holds {len(robot_t_s)} states of the robot, at least 2 are needed; record for longer")
    states = rows[known][first]
    begin_s = robot_t_s[0]
    chosen = rows
    if site is not None:
        chosen = _own_part(rows[rows["site"] == recording.site_index(site)])
        begin_s = max(begin_s, _last_rest_s(robot_t_s, states))
    filled = filled_slots(chosen)
    t_s, wrench, row_of = chosen["frame_t_s"][filled], chosen["tared"][filled], np.repeat(np.arange(len(chosen)), chosen["frames"])
    later = np.ones(len(t_s), bool)
    later[1:] = t_s[1:] > np.maximum.accumulate(t_s)[:-1]
    usable = later & (t_s >= begin_s) & (t_s <= robot_t_s[-1])
    t_s, wrench, row_of = t_s[usable], wrench[usable], row_of[usable]
    if at_reports and len(t_s):
        between_s = 0.5 * (t_s[1:] + t_s[:-1])
        kept = np.unique(np.searchsorted(between_s, robot_t_s[(robot_t_s >= t_s[0]) & (robot_t_s <= t_s[-1])]))
        t_s, wrench, row_of = t_s[kept], wrench[kept], row_of[kept]
    columns = {
        "t_s": t_s - t_s[:1],
        "z_cmd_m": np.interp(t_s, robot_t_s, states["target_pose"][:, 2]),
        "z_m": np.interp(t_s, robot_t_s, states["tcp_pose"][:, 2]),
        "vz_m_per_s": np.interp(t_s, robot_t_s, states["tcp_speed"][:, 2]),
        **dict(zip(("fx_N", "fy_N", "fz_N", "tx_Nm", "ty_Nm", "tz_Nm"), wrench.T, strict=True)),
    }
    samples = samples_from_columns(columns, f"{recording.path.name}{f', site {site}' if site else ''}")
    visited = np.unique(chosen["site"][row_of])
    names = tuple(recording.site_name(number) for number in visited.tolist() if number >= 0)
    return replace(samples, sites=names, stated=recording.header.get("body")), chosen, row_of


def _last_rest_s(robot_t_s: Floats, states: Rows) -> float:
    """Time of the last state (k,) before the target first moves, -inf where it does not.

    The tare ends with that motion: what a sensor shows from its tare on (a bias, a drift) begins there in an emulated cell. The state
    before is still at rest. Samples that began in the motion would put a servo that starts from rest off by what the target had moved.
    """
    moves = np.linalg.norm(states["target_speed"][:, :3], axis=1) > STILL_M_PER_S
    return float(robot_t_s[max(int(np.argmax(moves)) - 1, 0)]) if moves.any() else -np.inf


def _own_part(rows: Rows) -> Rows:
    """The rows of a site (n,) without tare and travel before and after its presses."""
    work = np.flatnonzero(~np.isin(rows["phase"], (Phase.IDLE, Phase.TARE, Phase.TRAVEL)))
    return rows[work[0] : work[-1] + 1] if len(work) else rows


def visited_sites(recording: Recording) -> list[str]:
    """Names of the sites that a recording has rows of, in the order of its plan."""
    return [recording.site_name(number) for number in np.unique(recording.rows["site"]).tolist() if number >= 0]


def export(recording: Recording, path: Path, site: str | None = None) -> Samples:
    """Write the samples of a recording as CSV, or as Parquet by the ending of the file; Parquet holds header and footer as JSON besides.

    Args:
        recording: a closed recording.
        site: name of the only site to use, which a column says. None uses all; where there are several, columns say site, phase, mode and
            place of each row.

    Returns:
        The samples that were written.

    Raises:
        RecordingError: as `samples_of`.
        BadInput: the file cannot be written, another stands there, or Parquet was asked for and pyarrow is not installed.
    """
    visited = visited_sites(recording)
    if site is None and len(visited) == 1:
        site = visited[0]
    samples, rows, row_of = _samples_and_rows(recording, site)
    named = {SITE_COLUMN: [site] * len(samples)} if site else {}
    extra = named if len(visited) < 2 or site else _places(recording, rows, row_of)
    if is_parquet(path):
        metadata = {HEADER: json.dumps(recording.header), FOOTER: json.dumps(recording.footer)}
        write_parquet(path, samples, extra=extra, metadata=metadata)
    else:
        write_csv(path, samples, extra=extra)
    return samples


def _places(recording: Recording, rows: Rows, row_of: NDArray[np.intp]) -> dict[str, list[str | float]]:
    """Columns (n,) with site, phase, mode and reported place of each sample, from the number of its row."""
    return {
        SITE_COLUMN: [recording.site_name(number) if number >= 0 else "" for number in rows["site"][row_of].tolist()],
        "phase": [Phase(number).name.lower() for number in rows["phase"][row_of].tolist()],
        "mode": [Mode(number).name.lower() for number in rows["mode"][row_of].tolist()],
        "x_m": rows["tcp_pose"][row_of, 0].tolist(),
        "y_m": rows["tcp_pose"][row_of, 1].tolist(),
    }


BLOCK = 1024
"""Number of rows that are converted at once: one by one costs ten times as much, and a whole day of plain numbers has 50 GB."""


class PlainRows:
    """Some fields of rows as plain numbers; a field with several becomes a tuple."""

    def __init__(self, rows: Rows, names: tuple[str, ...]) -> None:
        self._rows, self._names = rows, names
        self._begin, self._block = -BLOCK, list[tuple[Any, ...]]()

    def __getitem__(self, number: int) -> tuple[Any, ...]:
        """The fields of this row."""
        if not 0 <= number - self._begin < BLOCK:
            self._begin = number - number % BLOCK
            rows = self._rows[self._begin : self._begin + BLOCK]
            columns = [rows[name].tolist() for name in self._names]
            self._block = list(zip(*[map(tuple, each) if isinstance(each[0], list) else each for each in columns], strict=True))
        return self._block[number - self._begin]


class RecordedRobot(UncommandedRobot):
    """The Robot of a recording: it repeats the state of the tick chosen by `advance`, and commands do nothing."""

    FIELDS = ("robot_t_s", "robot_timestamp_s", *(state.name for state in fields(RobotState)[2:]))
    """Those of RobotState, in its order."""

    def __init__(self, rows: Rows) -> None:
        self._states, self._at = PlainRows(rows, self.FIELDS), 0

    def advance(self, number: int) -> None:
        """Go to the tick of this row."""
        self._at = number

    def read(self) -> RobotState:
        """Return the state that the loop saw in this tick."""
        *values, connected = self._states[self._at]
        return RobotState(*(*values, bool(connected)))


class RecordedSensor:
    """The ForceSensor of a recording: it repeats the frames of the tick chosen by `advance`."""

    def __init__(self, rows: Rows) -> None:
        self._rows, self._counts, self._at = rows, PlainRows(rows, ("frames", "rejected")), 0
        self._begin, self._block = -BLOCK, list[NDArray[Any]]()

    def advance(self, number: int) -> None:
        """Go to the tick of this row."""
        self._at = number

    def read(self) -> SensorFrames:
        """Return the frames that the loop saw in this tick, aligned like live ones."""
        n, rejected = self._counts[self._at]
        if n == 0 and rejected == 0:
            return NO_FRAMES
        if not 0 <= self._at - self._begin < BLOCK:
            self._begin = self._at - self._at % BLOCK
            rows = self._rows[self._begin : self._begin + BLOCK]
            self._block = [np.ascontiguousarray(rows[name]) for name in ("frame_t_s", "counter", "status", "wrench")]
        at = self._at - self._begin
        t_s, counter, status, wrench = self._block
        return SensorFrames(t_s[at, :n], counter[at, :n], status[at, :n], wrench[at, :n], rejected)

    def close(self) -> None:
        """Do nothing."""
