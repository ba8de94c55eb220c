"""How far a job is, read from the newest row of the ring."""

import numpy as np

from palpd.control.sequence import FREE_CYCLES
from palpd.daemon.display import JobProgress
from palpd.daemon.motion_process import Job
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


def job_steps(job: Job) -> int:
    """Number of steps that a progress bar counts: strokes, the search, holds and presses of every site."""
    if job.kind == "free_motion":
        return FREE_CYCLES
    if job.kind != "palpation":
        return 1
    strokes, static, dynamic = _steps_per_site(job)
    return len(job.plan.sites) * (strokes + bool(job.plan.depths_m) + static + dynamic)


def job_progress(job: Job, ring: Ring) -> JobProgress | None:
    """Where a job stands by the newest row.

    Args:
        job: What is carried out.
        ring: The ring that the motion process fills.

    Returns:
        The progress, or None before the first row.
    """
    if not ring.published:
        return None
    rows, _, _ = ring.read(ring.published - 1)
    if not len(rows):
        return None
    row = rows[-1]
    at_site = job.kind == "palpation" and row["site"] >= 0
    site = f"site {job.plan.sites[int(row['site'])].name}: " if at_site else ""
    activity = ACTIVITIES.get(Phase(int(row["phase"])), "")
    return JobProgress(site + activity, _steps_done(job, row), float(row["force_N"]), float(row["tcp_pose"][2]))


def _steps_per_site(job: Job) -> tuple[int, int, int]:
    """Free strokes, holds and presses in motion at each site."""
    plan = job.plan
    static = len(plan.depths_m) if plan.mode in ("static", "both") else 0
    dynamic = len(plan.depths_m) * plan.repeats if plan.mode in ("dynamic", "both") else 0
    return plan.free.strokes if plan.free else 0, static, dynamic


def _steps_done(job: Job, row: np.void) -> int:
    repeat = max(0, int(row["repeat"]))
    if job.kind == "free_motion":
        return repeat
    if job.kind == "palpation" and row["phase"] in (Phase.RETURN, Phase.DONE):
        return job_steps(job)
    if job.kind != "palpation" or row["site"] < 0:
        return 0
    strokes, static, _ = _steps_per_site(job)
    before = int(row["site"]) * (job_steps(job) // len(job.plan.sites))
    if row["mode"] == Mode.FREE_MOTION:
        return before + repeat
    depth_m, depths_m = float(row["depth_m"]), job.plan.depths_m
    depth = depths_m.index(depth_m) if depth_m in depths_m else 0
    if row["mode"] == Mode.STATIC:
        return before + strokes + 1 + depth
    if row["mode"] == Mode.DYNAMIC:
        return before + strokes + 1 + static + depth * job.plan.repeats + repeat
    return before + strokes
