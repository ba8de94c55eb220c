"""What a recording says of its run before the first tick: the header, and where the sites count from."""

import contextlib
import math
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from palpd.control.inertial import read_card
from palpd.control.plan_place import PlanPlace
from palpd.control.sequence import LEVEL_M
from palpd.daemon.motion_job import Job, arm_geometry_of
from palpd.daemon.stored_state import now
from palpd.recording.header import RecordedPlace, RecordingHeader, RunAbout


def place_of(job: Job, pose: tuple[float, ...], name: str) -> PlanPlace:
    """Where the sites of a palpation count from.

    Args:
        pose: Pose (6,) of the tip before it moves.
        name: Name of the run.

    Returns:
        The place, not yet returned to.
    """
    start_m = job.back_to_m or (pose[0], pose[1], pose[2])
    origin = job.plan.origin
    origin_m = (start_m[0], start_m[1]) if origin is None else (origin.x_m, origin.y_m)
    top_m = max(LEVEL_M, job.plan.free.height_m if job.plan.free is not None else 0.0)
    sites = tuple((site.name, site.x_m, site.y_m) for site in job.plan.sites)
    return PlanPlace(now(), name, origin_m, start_m, start_m[2] + top_m, sites)


def _recorded_place(job: Job, pose: tuple[float, ...]) -> RecordedPlace:
    """How the sites of a run count, and how far from those of the unfinished run before."""
    place, last = place_of(job, pose, ""), job.last
    moved_m = None if last is None or last.returned else math.dist(place.origin_m, last.origin_m)
    taken = "plan" if job.plan.origin is not None else "start" if job.choice is None or moved_m is None else job.choice
    return {
        "x_m": place.origin_m[0],
        "y_m": place.origin_m[1],
        "taken": taken,
        "unfinished": None if moved_m is None or last is None else last.run,
        "moved_m": moved_m,
        "back_to_m": list(job.back_to_m) if job.back_to_m is not None else None,
        "top_z_m": job.top_z_m if job.back_to_m is not None else None,
    }


def header_of(job: Job, about: RunAbout, reference: tuple[float, ...], pose: tuple[float, ...]) -> RecordingHeader:
    """Everything that a replay needs to make the decisions again, and where the recording came from.

    Args:
        job: What is carried out.
        about: What the opened devices say of themselves.
        reference: Reference tare (6,) in the sensor's axes, N and Nm.
        pose: Pose (6,) of the tip before it moves.
    """
    arm = arm_geometry_of(job, about["delay_s"])
    return {
        "kind": job.kind,
        "dry": job.dry,
        "config": job.config.model_dump(mode="json"),
        "plan": job.plan.model_dump(mode="json"),
        "sites": [{"name": site.name, "x_m": site.x_m, "y_m": site.y_m} for site in job.plan.sites],
        "place": _recorded_place(job, pose) if job.kind == "palpation" else None,
        "returns_to_start": job.returns_to_start,
        "pauses_in_place": job.pauses_in_place,
        "lifts_first": job.lifts_first,
        "fits_slope": job.fits_slope,
        "unfinished": job.unfinished,
        "clear_z_m": job.clear_z_m,
        "reference": list(reference),
        "reference_date": now() if job.reference is None else job.reference_date,
        "machine_stiffness_N_per_m": job.machine_stiffness_N_per_m,
        "body": {
            "tip_radius_m": arm.tip_radius_m,
            "poisson_ratio": job.config.cell.tissue.poisson_ratio if job.config.cell.tissue else 0.5,
            "delay_s": arm.delay_s,
            "machine_stiffness_N_per_m": job.machine_stiffness_N_per_m,
        },
        "about": about,
        "epoch_offset_s": about["epoch_offset_s"],
        "model_card": _card(job),
        "versions": _versions(),
        "started": now(),
        "injection": job.planted.seal if job.planted is not None else None,
    }


def _versions() -> dict[str, str]:
    """Versions of what a recording rests on, as far as it is installed: another driver's robot needs no ur-rtde."""
    versions = {}
    for name in ("palpd", "numpy", "ur-rtde", "onnxruntime"):
        with contextlib.suppress(PackageNotFoundError):
            versions[name] = version(name)
    return versions


def _card(job: Job) -> dict[str, Any] | None:
    path = job.config.model.path
    return read_card(path) if path and job.kind == "palpation" else None
