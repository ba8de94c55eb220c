"""The marker of a contact while a run is under way. What it means is decided in control/probe_state.py."""

from dataclasses import replace

import numpy as np

from palpd.control.probe_state import ContactMarker, LevelTested, ProbeAnswer, ProbeState, Reference, probe_state
from palpd.control.sequence import CLEAR_SHARE
from palpd.daemon.motion_job import Job
from palpd.daemon.probe_record import evidence_of, identity_of, probe_record
from palpd.daemon.stored_state import State, now
from palpd.recording.header import RunAbout
from palpd.recording.ring import Rows
from palpd.tick import Floats, Phase

END_S = 0.3
"""Length of the end of a run whose frames give the force at rest."""
STILL_M = 1e-4
"""Largest distance from where the arm stands at the end of a tick that counts as at rest: 0.1 N on soft tissue."""
SAYS_NOTHING = (Phase.IDLE, Phase.TARE, Phase.LIFT, Phase.DONE)
"""Phases that do not show that the first way up is over and was level."""


class MarkedRun:
    """The marker of one run that moves: written before the first motion, kept up with what the run sees, removed by a free probe only."""

    def __init__(self, job: Job, state: State, about: RunAbout, reference: tuple[float, ...], pose: tuple[float, ...], name: str) -> None:
        self._job, self._state, self._about = job, state, about
        self._before, self._level_before = state.marker(), state.level()
        start_pose = (*(job.back_to_m or pose[:3]), *pose[3:])
        clear_height_m = CLEAR_SHARE * job.plan.safe_height_m
        self._own = ContactMarker(now(), name, pose, start_pose, clear_height_m, reference, identity_of(job.config, about))
        # an unfinished contact is forgotten for this run's own only when its first way up was level
        self._marker = self._own if self._before is None else replace(self._before, pose=pose, at_rest=False)
        state.keep("contact", self._marker)
        state.forget("level")  # the arm leaves the place that it speaks of

    def undo(self) -> None:
        """Put back what was known before: the run has ended without a motion."""
        self._state.put_back("contact", self._before)
        self._state.put_back("level", self._level_before)

    def follow(self, rows: Rows) -> None:
        """Keep what the newest tick adds: a higher surface, another site, or that the start was free."""
        row = rows[-1]
        phase, site, surface_z_m = Phase(int(row["phase"])), int(row["site"]), float(row["surface_z_m"])
        fresh = self._marker
        if self._job.lifts_first and phase not in SAYS_NOTHING and not self._own.start_free:
            fresh = self._own = replace(self._own, start_free=True)
        if self._job.kind == "palpation" and site >= 0 and fresh.site != (name := self._job.plan.sites[site].name):
            fresh = replace(fresh, site=name)
        if np.isfinite(surface_z_m) and surface_z_m > (fresh.surface_z_m if fresh.surface_z_m is not None else -np.inf):
            fresh = replace(fresh, surface_z_m=surface_z_m)
        if fresh != self._marker:
            self._marker = fresh
            self._state.keep("contact", fresh)

    def end(self, rows: Rows, level: bool, came_to_rest: bool) -> ProbeAnswer:
        """Judge how the run leaves the probe: free removes the marker.

        Args:
            rows: The last ticks, at least `END_S` of them; none where the run died before its first.
            level: Whether the run ended on a way up over which the force stayed level.
            came_to_rest: Whether the loop itself brought the arm to rest; false where its process died.
        """
        if not len(rows):
            return ProbeAnswer(ProbeState.UNKNOWN, ("the run sent no tick",), frozenset())
        self.follow(rows)
        pose = tuple(map(float, rows[-1]["tcp_pose"]))
        last = rows[rows["now_s"] >= rows["now_s"][-1] - END_S]
        still = last[np.linalg.norm(last["tcp_pose"][:, :3] - last["tcp_pose"][-1, :3], axis=1) < STILL_M]
        wrenches = _frames(still) if still["frames"].any() else _frames(last)  # a sensor that fell silent first has only the others
        fault = "" if came_to_rest and len(wrenches) else "the run sent nothing more at its end"
        wrench = tuple(wrenches.mean(axis=0).tolist()) if len(wrenches) else (0.0,) * 6
        self._marker = replace(self._marker, pose=pose, at_rest=not fault)
        evidence = evidence_of(self._job.config, self._about, pose, wrench, fault)
        tested = LevelTested(now(), pose, wrench, evidence.identity) if level and not fault else None
        record = probe_record(self._job.config, self._state)
        reference = record.reference or Reference(self._marker.reference, evidence.identity)  # a run may have taken its own
        answer = probe_state(replace(record, reference=reference, marker=self._marker, level=tested), evidence)
        if tested is not None:
            self._state.keep("level", tested)
        if answer.state == ProbeState.FREE:
            self._state.forget("contact")
        else:
            self._state.keep("contact", self._marker)
        return answer


def _frames(rows: Rows) -> Floats:
    """The wrenches (n, 6) of all frames of these ticks."""
    return np.concatenate([row["wrench"][: row["frames"]] for row in rows])
