"""The ring as pages see it: one reader for all of them, and a few points a frame."""

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpd.errors import PalpdError
from palpd.recording.ring import Ring, Rows
from palpd.tick import Mode, Phase

MOST_POINTS = 4
"""Most points of a frame: 120 a second at 30 frames, which a chart of 20 s shows one to a pixel."""
KEPT_POINTS = 3000
"""Points that a page receives when it is opened: the last 25 s."""
PRESSES = (Mode.STATIC, Mode.DYNAMIC, Mode.STIFFNESS)
IN_TISSUE = (Phase.PRESS, Phase.HOLD, Phase.RETRACT)
PAUSED = (Phase.PAUSED, Phase.PAUSE_RETRACT)
BROKEN_S = 0.25
"""Time without a tick that a line is not drawn across: a loop that stood still for so long has missed 30 ticks."""
ASIDE_S = 1.0
"""Time on the charts between a palpation and a retract or a look after it, however long that came later."""
RATE_OVER_S = 1.0
"""Time over which the rate of the loop is counted."""

Point = list[float | int | None]
"""t_s, raw_N, inertial_N, force_N, z_m, depth_m, press: `t_s` since the run's first tick; `press` counts, 0 outside of a press.

All but the time are null where lines end: before a gap in time, and where a pause or another site begins or ends."""


@dataclass(slots=True)
class Health:
    """How the loop does: over the rows of the last frame, but for `missed` and `lost`, which count since the run began."""

    rate_Hz: float = 0.0
    missed: int = 0
    robot_age_ms: float = 0.0
    sensor_age_ms: float = 0.0
    work_us: float = 0.0
    absolute_N: float = 0.0
    lost: int = 0

    def values(self) -> list[float]:
        """In the order of the fields, rounded."""
        return [round(self.rate_Hz, 1), self.missed, round(self.robot_age_ms, 1), round(self.sensor_age_ms, 1), round(self.work_us),
                round(self.absolute_N, 3), self.lost]  # fmt: skip


@dataclass(slots=True)
class TickStream:
    """Reads the ring of the service. `points` are the last ones of the run; `run` counts the runs that were seen.

    A run that is `beside` the matter, such as a retract, a level test or a look at the devices, goes on with the points of the one before.
    """

    points: deque[Point] = field(default_factory=lambda: deque(maxlen=KEPT_POINTS))
    health: Health = field(default_factory=Health)
    run: int = 0
    beside: bool = False
    _ring: Ring | None = None
    _cursor: int = 0
    _began_s: float = math.nan
    _last_index: int = -1
    _press: int = 0
    _press_key: tuple[int, int, int, float] | None = None
    _before: Rows | None = None
    _times: deque[float] = field(default_factory=deque)

    def watch(self, name: str | None) -> None:
        """Read the ring of that name from now on; None ends the reading. A ring that cannot be opened reads as one without rows."""
        if self._ring is not None and self._ring.name == name:
            return
        if self._ring is not None:
            self._ring.close()
            self._ring = None
        if name is None:
            return
        try:
            self._ring = Ring.watch(name)
        except PalpdError:
            return
        self._cursor = self._ring.published

    @property
    def readable(self) -> bool:
        """Whether there is a ring that this process may read."""
        return self._ring is not None

    def read(self) -> list[Point]:
        """The points of all ticks since the last call; none where there was no tick."""
        if self._ring is None or self._ring.published == self._cursor:
            return []
        rows, self._cursor, lost = self._ring.read(self._cursor)
        if not len(rows):
            return []
        if int(rows["index"][-1]) <= self._last_index or not self.run:
            rows = rows[int(np.argmin(rows["index"])) :]
            self._begin(rows)
        self._last_index = int(rows["index"][-1])
        self._note_health(rows, lost)
        points, broken = list[Point](), self._broken(rows)
        done = 0
        for at in _chosen(rows):
            point = self._point(rows[at])
            if broken[done : at + 1].any():
                points.append([point[0], None, None, None, None, None, 0])
            points.append(point)
            done = at + 1
        self.points.extend(points)
        return points

    def _broken(self, rows: Rows) -> NDArray[np.bool_]:
        """Which rows (n,) a line must not lead to from the row before: after a gap in time, at another site, around a pause."""
        known = rows if self._before is None else np.concatenate((self._before, rows))
        self._before = rows[-1:].copy()
        paused = np.isin(known["phase"], PAUSED)
        away = (np.diff(known["now_s"]) > BROKEN_S) | (np.diff(known["site"]) != 0) | (paused[1:] != paused[:-1])
        return away if len(known) > len(rows) else np.concatenate(([False], away))

    def _begin(self, rows: Rows) -> None:
        """A new run: its ticks are counted from its beginning; those of a run beside the matter go on from the run before."""
        self._times.clear()
        self.health, self._press_key, self._began_s = Health(), None, float(rows["now_s"][0])
        last_s = self.points[-1][0] if self.points else None
        if self.beside and last_s is not None:
            self._began_s -= last_s + ASIDE_S
            return
        self.run += 1
        self.points.clear()
        self._press, self._before = 0, None

    def _note_health(self, rows: Rows, lost: int) -> None:
        health, now_s = self.health, rows["now_s"]
        self._times.extend(now_s.tolist())
        while self._times and self._times[0] < now_s[-1] - RATE_OVER_S:
            self._times.popleft()
        span_s = self._times[-1] - self._times[0]
        health.rate_Hz = (len(self._times) - 1) / span_s if span_s > 0.0 else 0.0
        health.missed += int(rows["missed"].sum())
        health.lost += lost
        health.robot_age_ms = _finite(float((now_s - rows["robot_t_s"]).max()) * 1e3)
        filled = rows["frames"] > 0
        if filled.any():
            newest_s = rows["frame_t_s"][filled, rows["frames"][filled].astype(int) - 1]
            health.sensor_age_ms = _finite(float((now_s[filled] - newest_s).max()) * 1e3)
        health.work_us, health.absolute_N = _finite(float(rows["work_us"].max())), _finite(float(rows["absolute_N"][-1]))

    def _point(self, row: np.void) -> Point:
        newest = int(row["frames"]) - 1
        raw_N = float(row["tared"][newest][2]) if newest >= 0 else math.nan
        inertial_N = float(row["inertial_N"][newest]) if newest >= 0 else math.nan
        z_m = float(row["tcp_pose"][2])
        depth_m = float(row["surface_z_m"]) - z_m
        key = (int(row["site"]), int(row["mode"]), int(row["repeat"]), float(row["depth_m"]))
        press = 0
        if int(row["phase"]) in PAUSED:
            self._press_key = None  # the press begins again
        if int(row["mode"]) in PRESSES and int(row["phase"]) in IN_TISSUE:
            if key != self._press_key:
                self._press, self._press_key = self._press + 1, key
            press = self._press
        values = (float(row["now_s"]) - self._began_s, raw_N, inertial_N, float(row["force_N"]), z_m, depth_m)
        return [*(_short(value) for value in values), press]


def _chosen(rows: Rows) -> list[int]:
    """Which rows become points: of each of `MOST_POINTS` parts the one with the largest force, so that no peak is left out."""
    force_N = np.abs(rows["force_N"])
    return [
        int(part[np.argmax(np.nan_to_num(force_N[part], nan=np.inf))])
        for part in np.array_split(np.arange(len(rows)), MOST_POINTS)
        if len(part)
    ]


def _short(value: float) -> float | None:
    return round(value, 5) if math.isfinite(value) else None


def _finite(value: float) -> float:
    return value if math.isfinite(value) else 0.0


def as_line(points: list[Point], health: Health, **more: Any) -> dict[str, Any]:
    """One frame for the pages.

    Args:
        points: New points; there may be none.
        health: How the loop does.
        more: What belongs to it besides.

    Returns:
        The frame, short names for what comes thirty times a second.
    """
    return {"event": "frame", "p": points, "h": health.values(), **more}
