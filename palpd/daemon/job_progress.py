"""How far a job is, read from the newest rows of the ring."""

import math
from typing import Literal, NamedTuple

import numpy as np

from palpd.control.sequence import BASELINE_S, FREE_CYCLES, FREE_SPEED_M_PER_S, FREE_STROKE_M, SETTLE_WINDOW_S
from palpd.daemon.display import JobProgress
from palpd.daemon.motion_job import Job
from palpd.recording.ring import Ring
from palpd.tick import Mode, Phase

ACTIVITIES = {
    Phase.IDLE: "watching",
    Phase.TARE: "taring",
    Phase.TRAVEL: "going there",
    Phase.BASELINE: "resting above",
    Phase.SEARCH: "looking for the surface",
    Phase.PRESS: "pressing",
    Phase.HOLD: "holding",
    Phase.RETRACT: "leaving",
    Phase.FREE_MOTION: "moving in free air",
    Phase.PAUSED: "paused",
    Phase.PAUSE_RETRACT: "leaving for a pause",
    Phase.RETURN: "returning to the start",
    Phase.DONE: "done",
    Phase.LIFT: "going up, to show that the probe is free",
}


SEARCH_WAY_M = 0.03
"""Way of a first search that is expected before one was seen: an arm is brought to some 3 cm above the tissue."""
ENDING_S = 0.4
"""What a way takes longer than its length at its speed: its last tenth is ever slower (`GAIN_PER_S`)."""


class CountedStep(NamedTuple):
    """A step that a progress bar counts, and how long it is expected to take."""

    kind: Literal["stroke", "search", "static", "dynamic"]
    expected_s: float


def steps_of(job: Job) -> list[CountedStep]:
    """The steps of a job in their order: strokes, the search, holds and presses of every site.

    Args:
        job: What is carried out.

    Returns:
        The steps; none where the job has no parts that could be counted.
    """
    if job.kind == "free_motion":
        return [CountedStep("stroke", 2.0 * FREE_STROKE_M / FREE_SPEED_M_PER_S)] * FREE_CYCLES
    if job.kind != "palpation":
        return []
    plan, fastest_m_per_s = job.plan, job.config.safety.max_speed_m_per_s
    at_site: list[CountedStep] = []
    if plan.free:
        at_site += [CountedStep("stroke", 2.0 * plan.free.height_m / plan.free.speed_m_per_s)] * plan.free.strokes
    if plan.depths_m:
        at_site.append(CountedStep("search", BASELINE_S + SEARCH_WAY_M / plan.search.speed_m_per_s + ENDING_S))
    for depth_m in plan.depths_m if plan.mode in ("static", "both") else ():
        way_m = plan.safe_height_m + depth_m
        down_s, up_s = way_m / plan.press_speed_m_per_s + ENDING_S, way_m / fastest_m_per_s + ENDING_S
        at_site.append(CountedStep("static", BASELINE_S + down_s + 2.0 * SETTLE_WINDOW_S + plan.hold_s + up_s))
    for depth_m in plan.depths_m if plan.mode in ("dynamic", "both") else ():
        way_s = (plan.safe_height_m + depth_m) / plan.press_speed_m_per_s + ENDING_S
        at_site += [CountedStep("dynamic", BASELINE_S + 2.0 * way_s)] * plan.repeats
    return at_site * len(plan.sites)


class JobMeter:
    """Follows one run by the newest rows of the ring. Its steps never go back: a step that a pause interrupts is the same one again.

    It learns from the steps that are done how long those of their kind take.
    """

    def __init__(self, job: Job, ring: Ring) -> None:
        self._job, self._ring, self._first = job, ring, ring.published
        self._steps = steps_of(job)
        self._done = 0
        self._seen_site = False
        self._last_s = math.nan
        self._in_step_s = 0.0
        self._took = {step.kind: (0.0, 0.0) for step in self._steps}

    @property
    def steps(self) -> int:
        """Number of steps that a progress bar counts; at least one."""
        return max(1, len(self._steps))

    def read(self) -> JobProgress | None:
        """Where the job stands by the newest row; None before its first."""
        if self._ring.published <= self._first:
            return None
        rows, _, _ = self._ring.read(self._ring.published - 1)
        if not len(rows):
            return None
        row = rows[-1]
        phase = Phase(int(row["phase"]))
        self._follow(row, phase)
        at_site = self._job.kind == "palpation" and row["site"] >= 0
        site = self._job.plan.sites[int(row["site"])].name if at_site else None
        activity = (f"site {site}: " if site is not None else "") + ACTIVITIES.get(phase, "")
        return JobProgress(activity, self._done, float(row["force_N"]), float(row["tcp_pose"][2]), site, self._left_s())

    def _follow(self, row: np.void, phase: Phase) -> None:
        """Count the steps that are done, and the time of the present one without its pauses."""
        self._seen_site = self._seen_site or int(row["site"]) >= 0
        done, now_s = max(self._done, self._steps_done(row, phase)), float(row["now_s"])
        begun = self._seen_site or self._job.kind == "free_motion"
        passed_s = now_s - self._last_s if begun and now_s > self._last_s else 0.0
        self._in_step_s = 0.0 if phase == Phase.PAUSED else self._in_step_s + passed_s
        self._last_s = now_s
        if done == self._done:
            return
        over = self._steps[self._done : done]
        expected_s = math.fsum(step.expected_s for step in over)
        for step in over:
            took_s, of_s = self._took[step.kind]
            self._took[step.kind] = took_s + self._in_step_s * step.expected_s / expected_s, of_s + step.expected_s
        self._done, self._in_step_s = done, 0.0

    def _left_s(self) -> float | None:
        """Time that the steps to come are expected to take; None where the job counts none."""
        if not self._steps:
            return None
        pace = {kind: took_s / of_s if of_s else 1.0 for kind, (took_s, of_s) in self._took.items()}
        to_come_s = [step.expected_s * pace[step.kind] for step in self._steps[self._done :]]
        return max(0.0, to_come_s[0] - self._in_step_s) + math.fsum(to_come_s[1:]) if to_come_s else 0.0

    def _steps_done(self, row: np.void, phase: Phase) -> int:
        """Steps before the one that a row belongs to."""
        repeat, site, plan = max(0, int(row["repeat"])), int(row["site"]), self._job.plan
        if self._job.kind == "free_motion":
            return repeat
        if self._job.kind != "palpation" or site < 0:
            ended = self._seen_site and phase in (Phase.RETURN, Phase.DONE)
            return len(self._steps) if ended else 0
        at_site = len(self._steps) // len(plan.sites)
        before, strokes = site * at_site, plan.free.strokes if plan.free else 0
        depth_m, depths_m = float(row["depth_m"]), plan.depths_m
        depth = depths_m.index(depth_m) if depth_m in depths_m else 0
        static = len(depths_m) if plan.mode in ("static", "both") else 0
        match Mode(int(row["mode"])):
            case Mode.FREE_MOTION:
                return before + repeat
            case Mode.SEARCH:
                return before + strokes
            case Mode.STATIC:
                return before + strokes + 1 + depth
            case Mode.DYNAMIC:
                return before + strokes + 1 + static + depth * plan.repeats + repeat
        return before + (at_site if phase == Phase.RETRACT else 0)  # on the way: up from this site, or to it
