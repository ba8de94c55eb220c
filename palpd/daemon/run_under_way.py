"""The run that the service carries out now, and its newest tick."""

import math

import numpy as np

from palpd.daemon.devices import Build
from palpd.daemon.display import JobProgress
from palpd.daemon.job_progress import JobMeter
from palpd.daemon.motion_job import Job, Kind
from palpd.daemon.socket_client import ControlAnswer
from palpd.daemon.stored_state import State
from palpd.daemon.supervisor import JobRun
from palpd.recording.ring import Ring
from palpd.tick import Phase


class RunUnderWay:
    """The run of the service, if any. Nothing else may keep `current`: the motion process stops the arm when that object is gone."""

    def __init__(self, build: Build, ring: Ring, state: State) -> None:
        self._build, self._ring, self._state = build, ring, state
        self.current: JobRun | None = None
        self._first_tick = 0
        self._meter: JobMeter | None = None

    def begin(self, work: Job, name: str) -> None:
        """Start the motion process of a job; `name` is that of its recording."""
        self._first_tick = self._ring.published
        self._meter = JobMeter(work, self._ring) if work.kind != "check" else None
        self.current = JobRun(work, self._build, self._ring, self._state, name)

    @property
    def kind(self) -> Kind | None:
        """What is carried out; None where nothing is."""
        return self.current.job.kind if self.current is not None else None

    @property
    def checking(self) -> bool:
        """Whether the devices are being checked, which commands nothing."""
        return self.kind == "check"

    @property
    def ticks(self) -> int:
        """Number of ticks since the service began."""
        return self._ring.published

    def newest(self) -> np.void | None:
        """The newest tick of this run; the ring also holds those of runs before. None before the first."""
        if self._ring.published <= self._first_tick:
            return None
        rows = self._ring.read(self._ring.published - 1)[0]
        return rows[-1] if len(rows) else None

    @property
    def progress(self) -> JobProgress | None:
        """How far the run is; None before its first tick, and for a check."""
        return self._meter.read() if self._meter is not None and self.current is not None else None

    def answer(self) -> ControlAnswer:
        """Where the run stands by its newest tick, as the status says it; without a tick only what it is."""
        row, progress = self.newest(), self.progress
        if row is None or progress is None or self._meter is None:
            return {"job": str(self.kind), "activity": "opening robot and sensor"}
        return {
            "job": str(self.kind),
            "activity": progress.activity,
            "steps_done": progress.steps_done,
            "steps": self._meter.steps,
            "left_s": None if progress.left_s is None else float(round(progress.left_s)),
            "phase": Phase(int(row["phase"])).name.lower(),
            "site": int(row["site"]),
            "force_N": progress.force_N,
            "z_m": progress.z_m,
            "depth_m": depth_m(row),
            "tick": int(row["index"]),
        }


def depth_m(row: np.void | None) -> float | None:
    """Depth of the tip below the surface; None where that is not known."""
    below_m = float(row["surface_z_m"] - row["tcp_pose"][2]) if row is not None else math.nan
    return below_m if math.isfinite(below_m) else None
