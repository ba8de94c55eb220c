"""Reading recordings: the rows, samples for the diagnosis, and a robot and a sensor that live through them again."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from palpd import cdr
from palpd.errors import RecordingError
from palpd.mcap_file import Contents, Recovered, recover
from palpd.samples import Samples, samples_from_columns, write_csv
from palpd.tick import NO_FRAMES, ROW, RobotState, SensorFrames

__all__ = ["RecordedRobot", "RecordedSensor", "Recording", "Recovered", "export", "recover", "same_rows", "samples_of", "widened"]

Rows = NDArray[np.void]


@dataclass(frozen=True)
class Recording:
    """One closed recording.

    `rows` has the fields of ROW, with as many frame slots as the fullest tick needs (a ROW of 64 would be 1 MB a second);
    `widened` makes them ROWs. What a tick did not fill is zero.
    """

    path: Path
    rows: Rows
    header: dict[str, Any]
    footer: dict[str, Any]
    model_bytes: bytes | None

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a recording, checking every checksum in it. Raises RecordingError."""
        if path.suffix == ".part":
            raise RecordingError(f"{path} was never closed; run palpd recover {path} and give the file it writes")
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
        rows = cdr.unpack_ticks(messages)
        return cls(path, rows, contents.header, contents.footer, contents.model_bytes)

    def site_index(self, name: str) -> int:
        """The number by which rows call a site. Raises RecordingError."""
        names = [site["name"] for site in self.header.get("sites", [])]
        if name not in names:
            raise RecordingError(f"{self.path} has no site {name}; it has {', '.join(names) or 'none'}")
        return names.index(name)


def widened(rows: Rows) -> Rows:
    """The same rows as ROWs."""
    wide = np.zeros(len(rows), ROW)
    for name in rows.dtype.names or ():
        if name in cdr.PER_FRAME:
            wide[name][:, : rows[name].shape[1]] = rows[name]
        else:
            wide[name] = rows[name]
    return wide


def same_rows(one: Rows, other: Rows) -> NDArray[np.bool_]:
    """For each pair of rows whether every filled field is the same, bit for bit (a NaN equals itself, 0.0 does not equal -0.0)."""
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


def samples_of(recording: Recording, site: str | None = None) -> Samples:
    """One sample for each sensor frame (of one site, if named), the robot's state interpolated in time between its reports.

    The wrench is the tared sensor in base axes without any compensation. Frames before the robot's first and after its last
    report, and frames that do not come later than all before, are left out. Raises RecordingError.
    """
    rows = recording.rows
    known = np.isfinite(rows["robot_t_s"]) & (rows["connected"] != 0)
    robot_t_s, first = np.unique(rows["robot_t_s"][known], return_index=True)
    if len(robot_t_s) < 2:
        raise RecordingError(f"{recording.path} holds {len(robot_t_s)} states of the robot, at least 2 are needed; record for longer")
    states = rows[known][first]
    chosen = rows if site is None else rows[rows["site"] == recording.site_index(site)]
    filled = np.arange(chosen["frame_t_s"].shape[1]) < chosen["frames"][:, None]
    t_s, wrench = chosen["frame_t_s"][filled], chosen["tared"][filled]
    later = np.ones(len(t_s), bool)
    later[1:] = t_s[1:] > np.maximum.accumulate(t_s)[:-1]
    usable = later & (t_s >= robot_t_s[0]) & (t_s <= robot_t_s[-1])
    t_s, wrench = t_s[usable], wrench[usable]
    columns = {
        "t_s": t_s - t_s[:1],
        "z_cmd_m": np.interp(t_s, robot_t_s, states["target_pose"][:, 2]),
        "z_m": np.interp(t_s, robot_t_s, states["tcp_pose"][:, 2]),
        "vz_m_per_s": np.interp(t_s, robot_t_s, states["tcp_speed"][:, 2]),
        **dict(zip(("fx_N", "fy_N", "fz_N", "tx_Nm", "ty_Nm", "tz_Nm"), wrench.T, strict=True)),
    }
    return samples_from_columns(columns, f"{recording.path.name}{f', site {site}' if site else ''}")


def export(recording: Recording, csv_path: Path, site: str | None = None, *, overwrite: bool = False) -> Samples:
    """Write `samples_of` as CSV. Raises RecordingError, BadInput where the file exists."""
    samples = samples_of(recording, site)
    write_csv(csv_path, samples, overwrite=overwrite)
    return samples


class RecordedRobot:
    """The Robot of a recording. It says what was said at tick `advance(i)`, and does nothing."""

    def __init__(self, rows: Rows) -> None:
        self._rows = rows
        self._row = rows[0]

    def advance(self, number: int) -> None:
        """Go to the tick of that row."""
        self._row = self._rows[number]

    def read(self) -> RobotState:
        """The state that the loop saw in this tick."""
        row = self._row
        return RobotState(
            t_s=float(row["robot_t_s"]),
            timestamp_s=float(row["robot_timestamp_s"]),
            tcp_pose=tuple(row["tcp_pose"].tolist()),
            tcp_speed=tuple(row["tcp_speed"].tolist()),
            target_pose=tuple(row["target_pose"].tolist()),
            target_speed=tuple(row["target_speed"].tolist()),
            tool_acceleration_m_per_s2=tuple(row["tool_acceleration_m_per_s2"].tolist()),
            robot_mode=int(row["robot_mode"]),
            safety_mode=int(row["safety_mode"]),
            safety_status_bits=int(row["safety_status_bits"]),
            runtime_state=int(row["runtime_state"]),
            connected=bool(row["connected"]),
        )

    def move(self, velocity_m_per_s: tuple[float, float, float]) -> None:
        """The past cannot be moved."""

    def stop(self) -> None:
        """The past cannot be stopped."""

    def close(self) -> None:
        """Nothing to let go of."""


class RecordedSensor:
    """The ForceSensor of a recording: the frames that came in the tick of `advance(i)`."""

    def __init__(self, rows: Rows) -> None:
        self._rows = rows
        self._row = rows[0]

    def advance(self, number: int) -> None:
        """Go to the tick of that row."""
        self._row = self._rows[number]

    def read(self) -> SensorFrames:
        """The frames that the loop saw in this tick, as arrays of their own, aligned like live ones."""
        row, rejected = self._row, int(self._row["rejected"])
        n = int(row["frames"])
        if n == 0 and rejected == 0:
            return NO_FRAMES
        t_s, counter, status, wrench = (row[name][:n].copy() for name in ("frame_t_s", "counter", "status", "wrench"))
        return SensorFrames(t_s, counter, status, wrench, rejected)

    def close(self) -> None:
        """Nothing to let go of."""
