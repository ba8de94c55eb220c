"""One task for the cell, and what it makes of the core: its script, its limits, its tare and model. A run and its replay share it."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from palpd.config import Config, ModelConfig, Plan
from palpd.control.inertial import InertialModel, MotionFeatures
from palpd.control.loop import Explainer
from palpd.control.plan_place import Choice, PlanPlace
from palpd.control.probe_state import ProbeRecord
from palpd.control.running_zero import RunningZero
from palpd.control.safety import Limits
from palpd.control.sequence import ArmGeometry, FreeMotion, LevelTest, Palpation, Retract, RigidPress, Script, Sequence, TimedRest
from palpd.control.slopes import GRAVITY_N_PER_KG, FzSlopes
from palpd.errors import Refused
from palpd.recording.header import RunAbout
from palpd.recording.second_channel import SealedAnswer

DRY_S = 10.0
"""How long a dry run watches. The arm does not move, so no plan could come to its end."""
CHECK_S = 1.2
"""How long a check watches. Together with the second of its tare, the guard has time to detect a stuck sensor."""

Kind = Literal["palpation", "free_motion", "stiffness", "retract", "level_test", "calibrate", "check", "observe"]
"""A retract leaves the tissue after a stop, and a level test shows whether the probe is free.
To observe is to read the devices for some seconds and judge them: the doctor's part.

A check is a short dry run that is not recorded. Whatever would stop a run at its beginning also stops a check."""
STILL_KINDS: tuple[Kind, ...] = ("calibrate", "observe")
"""Jobs that move nothing: the robot is only read. In a dry run it is, too."""
BEGIN_LOADED: tuple[Kind, ...] = ("retract", "level_test")
"""Jobs that may begin in the tissue: no tare can be taken there."""
JUDGE_TARE: tuple[Kind, ...] = ("palpation", "free_motion", "stiffness", "check")
"""Jobs whose tare must be that of a free probe. A dry run that only looks is let in."""


@dataclass(frozen=True, slots=True)
class Job:
    """One task for the cell.

    Attributes:
        kind: What to do.
        plan: The plan of a palpation.
        dry: Whether to read the devices and command nothing.
        reference: Tare (6,) of the last calibration; None: the job takes its own.
        machine_stiffness_N_per_m: Stiffness of sensor, mount and arm; None: rigid.
        machine_serial: The sensor with which that was measured; None where nobody knows.
        reference_serial: The sensor of the reference; None where nobody knows.
        reference_date: When that was taken; None where nobody knows.
        returns_to_start: A palpation that is done returns to its start pose; in the recordings of earlier versions it did not.
        pauses_in_place: A pause stands still instead of leaving the tissue, as in the recordings of earlier versions.
        fits_slope: The search allows for a force that changes along the way down, and a site that begins in contact ends the run; in the
            recordings of earlier versions neither was so.
        watch_s: How long devices are observed.
        lifts_first: A way up shows first that the job was not tared in contact.
        probe: What is known of the probe from before; None asks nothing of the tare.
        confirmed: An operator's word stands for a doubtful reference.
        unfinished: A retract goes up at any force, at least to `clear_z_m` where that is known.
        clear_z_m: Height that clears the highest surface of the unfinished run; None where that is not known.
        last: Place of the palpation before.
        choice: What the operator answered where that one was not finished.
        back_to_m: Start pose that a palpation goes to before it begins, not below `top_z_m` on its way.
        top_z_m: Greatest height of the unfinished run.
        planted: What the recorder plants into the second channel; None: there is none. The motion process never gets it.
        clears_latch: Its start is the operator's word that the stop before may be forgotten, once the arm could move.
    """

    kind: Kind
    config: Config
    plan: Plan = field(default_factory=Plan)
    dry: bool = False
    reference: tuple[float, ...] | None = None
    machine_stiffness_N_per_m: float | None = None
    machine_serial: str | None = None
    reference_serial: str | None = None
    reference_date: str | None = None
    returns_to_start: bool = True
    pauses_in_place: bool = False
    fits_slope: bool = True
    watch_s: float = 0.0
    lifts_first: bool = False
    probe: ProbeRecord | None = None
    confirmed: bool = False
    unfinished: bool = False
    clear_z_m: float | None = None
    last: PlanPlace | None = None
    choice: Choice | None = None
    back_to_m: tuple[float, float, float] | None = None
    top_z_m: float = -math.inf
    planted: SealedAnswer | None = None
    clears_latch: bool = False

    @property
    def moves(self) -> bool:
        """Whether it commands the arm."""
        return not self.dry and self.kind not in STILL_KINDS


def arm_geometry_of(job: Job, delay_s: float) -> ArmGeometry:
    """The dimensions and limits of probe, sensor and machine that the sequence needs.

    Args:
        job: What is carried out.
        delay_s: Delay of the sensor's filter.

    Returns:
        The bundle for a script.
    """
    return ArmGeometry(
        tip_radius_m=job.config.cell.probe.tip_radius_m,
        contact_limit_N=job.config.safety.contact_limit_N,
        max_speed_m_per_s=job.config.safety.max_speed_m_per_s,
        delay_s=delay_s,
        machine_stiffness_N_per_m=job.machine_stiffness_N_per_m or math.inf,
    )


def limits_of(config: Config, muted: bool = False) -> Limits:
    """The guard's limits of a configuration.

    Args:
        muted: Whether the robot is only read, so that no program needs to run on its controller.
    """
    safety = config.safety
    return Limits(
        contact_N=safety.contact_limit_N,
        absolute_N=safety.absolute_limit_N,
        lateral_N=safety.lateral_limit_N,
        torque_Nm=safety.torque_limit_Nm,
        max_speed_m_per_s=safety.max_speed_m_per_s,
        robot_stale_s=safety.robot_stale_s,
        sensor_stale_s=safety.sensor_stale_s,
        max_missed_ticks=max(1, round(safety.max_stall_s * config.robot.rate_Hz)),
        min_z_m=safety.min_z_m,
        workspace_m=safety.workspace_m,
        overload_N=config.sensor.capacity_N,
        needs_program=not muted,
    )


def job_limits(job: Job) -> Limits:
    """The guard's limits of a job.

    A job that may begin in the tissue goes up only, and slowly, so the limits that stop the arm are its only force limits.
    """
    limits = limits_of(job.config, job.dry)
    return replace(limits, contact_N=limits.absolute_N) if job.kind in BEGIN_LOADED else limits


def sequence_of(job: Job, delay_s: float) -> Sequence:
    """The script of a job.

    Args:
        job: What is carried out.
        delay_s: Delay of the sensor's filter.

    Returns:
        The sequence, not begun.
    """
    arm = arm_geometry_of(job, delay_s)
    scripts: dict[str, Callable[[], Script]] = {
        "palpation": lambda: Palpation(job.plan, arm, job.returns_to_start, job.back_to_m, job.top_z_m, job.fits_slope),
        "free_motion": lambda: FreeMotion(arm),
        "stiffness": lambda: RigidPress(job.plan, arm),
        "retract": lambda: Retract(arm, job.unfinished, job.clear_z_m),
        "level_test": lambda: LevelTest(arm),
    }
    script = TimedRest(arm, CHECK_S if job.kind == "check" else DRY_S) if job.dry else scripts[job.kind]()
    script.lifts_first = job.lifts_first and not job.dry
    return Sequence(script, job.pauses_in_place)


def other_machine(measured_serial: str, serial: str) -> str:
    """Say that the stiffness of a machine is that of another sensor, and what to do.

    Args:
        measured_serial: The sensor with which it was measured.
        serial: The sensor that is mounted.
    """
    return (
        f"the stiffness of the machine was measured with sensor {measured_serial}, but {serial} is mounted; put a rigid plate under the "
        "probe and run palpd stiffness"
    )


def explainer_of(job: Job, about: RunAbout, delay_s: float) -> Explainer:
    """Axes, reference tare and inertial model of a job.

    Args:
        job: What is carried out.
        about: The opened devices; empty where there are none.
        delay_s: Delay of the sensor's filter.

    Returns:
        The explainer, not yet tared.

    Raises:
        Refused: The reference tare or the stiffness of the machine is another sensor's.
        ModelRefused: The inertial model may not be used for this probe or sensor.
    """
    config, sensor_serial = job.config, about.get("sensor_serial")
    if job.reference is not None and job.reference_serial and sensor_serial and job.reference_serial != sensor_serial:
        raise Refused(f"the reference tare is of sensor {job.reference_serial}, but {sensor_serial} is connected; run palpd calibrate")
    if job.machine_serial and sensor_serial and job.machine_serial != sensor_serial:
        raise Refused(other_machine(job.machine_serial, sensor_serial))
    model = None
    if config.model.path is not None and job.kind in ("palpation", "check"):
        model = InertialModel.load(config.model.path, probe_mass_kg=config.cell.probe.mass_kg, sensor_serial=sensor_serial)
    return explainer_with(model, job, delay_s, about.get("pulled_over_pressed"))


def explainer_with(model: InertialModel | None, job: Job, delay_s: float, pulled_over_pressed: float | None = None) -> Explainer:
    """Axes and reference tare of a job, with a model that is loaded already. Where a job may begin loaded, the reference is its tare.

    Args:
        model: The inertial model, or None for no correction.
        job: What is carried out.
        delay_s: Delay of the sensor's filter.
        pulled_over_pressed: Ratio of the sensor's two slopes of Fz; None where it has one.

    Returns:
        The explainer, not yet tared.
    """
    config, reference = job.config, np.array(job.reference or np.zeros(6), dtype=float)
    slopes = None
    if config.sensor.fz_slopes == "both" and pulled_over_pressed is not None:
        slopes = FzSlopes(pulled_over_pressed, config.cell.probe.mass_kg * GRAVITY_N_PER_KG)
    return Explainer(
        reference=reference,
        rotation_about_flange_z_rad=config.sensor.rotation_about_flange_z_rad,
        slopes=slopes,
        model=model,
        zero=zero_of(config.model) if model is not None else None,
        correction_limit_N=config.model.correction_limit_N,
        motion=MotionFeatures(delay_s),
        tare=reference.copy() if job.kind in BEGIN_LOADED else None,
    )


def zero_of(model: ModelConfig) -> RunningZero | None:
    """The running zero that follows the residual of the model; None where the configuration chooses none."""
    return RunningZero(limit_N=model.correction_limit_N) if model.zero == "running" else None
