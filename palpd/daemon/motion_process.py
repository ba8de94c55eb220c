"""The motion process: the only process that holds the robot.

It opens the devices, runs one job at a time on a FIFO thread, and dies with its supervisor.

When a connection is lost, ur_rtde can hang or crash, and it then resumes motion by itself. So a lost connection ends this process, and
the next one starts disarmed. After a crash of the library nobody can send a stop. Then the controller's watchdog stops the arm: it
expects the speed commands.
"""

import math
import os
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from typing import Any, Literal, TypedDict

import numpy as np

from palpd.config import Config, ModelConfig, Plan, filter_delay_s
from palpd.control.inertial import InertialModel, MotionFeatures
from palpd.control.loop import Explainer, Loop, Outcome, Record
from palpd.control.plan_place import Choice, PlanPlace
from palpd.control.probe_state import ProbeAnswer, ProbeEvidence, ProbeRecord, probe_state
from palpd.control.running_zero import RunningZero
from palpd.control.safety import Limits, sentence
from palpd.control.sequence import ArmGeometry, FreeMotion, LevelTest, Palpation, Retract, RigidPress, Script, Sequence, TimedRest
from palpd.control.slopes import GRAVITY_N_PER_KG, FzSlopes
from palpd.control.tare import Tare
from palpd.daemon.clock import RealClock
from palpd.daemon.finding import Finding
from palpd.daemon.probe_record import evidence_of
from palpd.daemon.realtime import DEVICE_PRIORITY, fifo, populate, realtime
from palpd.daemon.rehearsal import rehearse, short
from palpd.errors import PalpdError, Refused, Stopped
from palpd.recording.mcap_file import RunAbout
from palpd.recording.ring import LoopState, Ring
from palpd.recording.tick_rows import RowWriter
from palpd.tick import Floats, ForceSensor, Observation, Request, Robot, TickRecord, Trip, Verdict

DRAIN_S = 0.1
"""How long queued frames are read and dropped. A terminal hands out 4 kB at a time, so several reads are needed."""
ORPHAN_GRACE_S = 1.0
"""Time between the death of the supervisor and the end of this process: enough for the loop to stop the arm."""
DRY_S = 10.0
"""How long a dry run watches. The arm does not move, so no plan could come to its end."""
CHECK_S = 1.2
"""How long a check watches. Together with the second of its tare, the guard has time to detect a stuck sensor."""
REFERENCE_PATIENCE_S = 5.0
"""Longest wait for the second of frames that a reference tare needs."""
WIRE_LIBRARIES = ("rtde_control", "rtde_receive", "libpython", "libstdc++", "libc.so")
"""Libraries whose code a rehearsal without wires does not call; their files together have 7 MB of code."""

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

GO = "go"
CALLED_OFF = "called off"
"""The two answers of the supervisor to `Opened`."""


@dataclass(frozen=True, slots=True)
class Devices:
    """An opened robot and sensor. `first_tick_s` is just after the arrival of a robot state; `about` goes into the recording."""

    robot: Robot
    sensor: ForceSensor
    first_tick_s: float
    about: RunAbout


Build = Callable[[Config, bool], Devices]
"""Opens what stands behind the loop; the flag mutes the robot. It must be importable, because the motion process is spawned."""


@dataclass(frozen=True, slots=True)
class Job:
    """One task for the cell.

    Attributes:
        kind: What to do.
        plan: The plan of a palpation.
        dry: Whether to read the devices and command nothing.
        reference: Tare (6,) of the last calibration; None: the job takes its own.
        machine_stiffness_N_per_m: Stiffness of sensor, mount and arm; None: rigid.
        reference_serial: The sensor of the reference; None where nobody knows.
        reference_date: When that was taken; None where nobody knows.
        returns_to_start: A palpation that is done returns to its start pose; in the recordings of earlier versions it did not.
        pauses_in_place: A pause stands still instead of leaving the tissue, as in the recordings of earlier versions.
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
    """

    kind: Kind
    config: Config
    plan: Plan = field(default_factory=Plan)
    dry: bool = False
    reference: tuple[float, ...] | None = None
    machine_stiffness_N_per_m: float | None = None
    reference_serial: str | None = None
    reference_date: str | None = None
    returns_to_start: bool = True
    pauses_in_place: bool = False
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

    @property
    def moves(self) -> bool:
        """Whether it commands the arm."""
        return not self.dry and self.kind not in STILL_KINDS


class TripReport(TypedDict):
    """One verdict of the guard, or a device that failed: what was measured, the limit, and both as a sentence."""

    trip: str
    measured: float
    limit: float
    reason: str


@dataclass(frozen=True, slots=True)
class Opened:
    """The devices have answered. The motion process waits for `GO` before the loop starts. `reference` (6,) is in the sensor's axes.

    `pose` (6,) is that of the tip.
    """

    about: RunAbout
    reference: tuple[float, ...]
    pose: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class ReferenceTaken:
    """The frames of a reference tare were taken; whether they are kept is not decided here."""

    about: RunAbout
    evidence: ProbeEvidence


@dataclass(frozen=True, slots=True)
class Observed:
    """The devices were read for some seconds; the findings are those of the doctor."""

    about: RunAbout
    findings: tuple[Finding, ...]
    probe: ProbeAnswer | None


@dataclass(frozen=True, slots=True)
class Failed:
    """The job has failed before its first tick, or by a defect; `exit_code` is that of the command line."""

    reason: str
    exit_code: int


@dataclass(frozen=True, slots=True)
class Ended:
    """The loop has ended; `outcome` says how, `trips` and `notes` are for people, `probe` is what was judged of the tare."""

    outcome: Outcome
    trips: tuple[TripReport, ...]
    notes: tuple[str, ...]
    probe: ProbeAnswer | None


Message = Opened | ReferenceTaken | Observed | Failed | Ended
"""Everything that the motion process sends to its supervisor."""


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
        "palpation": lambda: Palpation(job.plan, arm, job.returns_to_start, job.back_to_m, job.top_z_m),
        "free_motion": lambda: FreeMotion(arm),
        "stiffness": lambda: RigidPress(job.plan, arm),
        "retract": lambda: Retract(arm, job.unfinished, job.clear_z_m),
        "level_test": lambda: LevelTest(arm),
    }
    script = TimedRest(arm, CHECK_S if job.kind == "check" else DRY_S) if job.dry else scripts[job.kind]()
    script.lifts_first = job.lifts_first and not job.dry
    return Sequence(script, job.pauses_in_place)


def explainer_of(job: Job, about: RunAbout, delay_s: float) -> Explainer:
    """Axes, reference tare and inertial model of a job.

    Args:
        job: What is carried out.
        about: The opened devices; empty where there are none.
        delay_s: Delay of the sensor's filter.

    Returns:
        The explainer, not yet tared.

    Raises:
        Refused: The reference tare is another sensor's.
        ModelRefused: The inertial model may not be used for this probe or sensor.
    """
    config, sensor_serial = job.config, about.get("sensor_serial")
    if job.reference is not None and job.reference_serial and sensor_serial and job.reference_serial != sensor_serial:
        raise Refused(f"the reference tare is of sensor {job.reference_serial}, but {sensor_serial} is connected; run palpd calibrate")
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


def serve(build: Build, ring_name: str, pipe: Connection, life: Connection) -> None:
    """Run the motion process: one job, after which the process ends.

    Args:
        build: Opens robot and sensor.
        ring_name: Name of the shared ring that takes the ticks.
        pipe: The job comes in over it, messages go out.
        life: A pipe that closes when the supervisor dies.
    """
    orphaned = threading.Event()
    threading.Thread(target=_end_with_supervisor, args=(life, orphaned), daemon=True).start()
    terminated = threading.Event()
    for number in (signal.SIGINT, signal.SIGHUP):  # the supervisor gets them too and asks for the abort
        signal.signal(number, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: terminated.set())
    signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGINT, signal.SIGHUP, signal.SIGTERM))  # the supervisor blocked them at the start
    ring = Ring.attach(ring_name)

    def request() -> Request:
        if orphaned.is_set():
            return Request.ORPHANED
        return Request.ABORT if terminated.is_set() else ring.request()

    try:
        job = pipe.recv()
    except (EOFError, OSError):  # the supervisor is gone
        os._exit(0)
    try:
        fifo(DEVICE_PRIORITY)
        devices = build(job.config, not job.moves)  # kept here: see the end
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        _do(devices, job, ring, pipe, request)
    except PalpdError as error:
        pipe.send(Failed(str(error), error.exit_code))
        os._exit(0)  # while the error still holds the devices
    except Exception as error:  # a defect of ours: it must reach the operator as a sentence, and the process must end
        pipe.send(Failed(f"the motion process failed ({type(error).__name__}: {error})", 3))
        os._exit(0)
    os._exit(0)  # not through ur_rtde's destructors: they take a second, and after a lost connection they can hang or crash


def _end_with_supervisor(life: Connection, orphaned: threading.Event) -> None:
    """Sleep until the supervisor is gone; then let the loop stop, and end the process even if the library hangs."""
    fifo(DEVICE_PRIORITY)  # without it this thread may wait half a second on a busy machine, or hold the interpreter's lock without running
    try:
        life.recv()
    except (EOFError, OSError):
        orphaned.set()
        time.sleep(ORPHAN_GRACE_S)
        os.kill(os.getpid(), signal.SIGKILL)


def _do(devices: Devices, job: Job, ring: Ring, pipe: Connection, request: Callable[[], Request]) -> None:
    """Report the devices, wait for `GO`, run, send the last message, end the program on the controller.

    The robot's connections end with the process: after closing one, ur_rtde sleeps half a second.
    """
    try:
        if job.kind == "calibrate":
            wrench = tuple(take_reference(devices).tolist())
            pipe.send(ReferenceTaken(devices.about, evidence_of(job.config, devices.about, devices.robot.read().tcp_pose, wrench)))
            return
        if job.kind == "observe":
            from palpd.daemon.doctor.devices import judged  # only the doctor needs it

            findings, probe = judged(devices, job.config, job.watch_s, job.probe)
            pipe.send(Observed(devices.about, tuple(findings), probe))
            return
        explainer = explainer_of(job, devices.about, devices.about["delay_s"])
        if job.reference is None:
            explainer.reference = take_reference(devices)
            if explainer.tare is not None:
                explainer.tare = explainer.reference.copy()
        if job.kind != "check":
            pipe.send(Opened(devices.about, tuple(explainer.reference.tolist()), devices.robot.read().tcp_pose))
            rehearse_job(job, explainer, RingWriter(ring), lambda: ring.abort_waits)  # meanwhile the recorder opens its file
            if pipe.recv() != GO:
                pipe.send(Failed(CALLED_OFF, 2))
                return
            ring.state = LoopState.RUNNING
        pipe.send(_run(job, devices, explainer, ring, request))
    finally:
        ring.state = LoopState.ENDED  # also where the loop did not begin
        if not _lost(devices.robot):  # with a lost connection ur_rtde may crash, and the reason would be lost too
            devices.robot.end()
        devices.sensor.close()


def rehearse_job(job: Job, explainer: Explainer, record: Record, called_off: Callable[[], bool] = lambda: False) -> Outcome:
    """Carry out a job in small on a simulated cell, and bring the code of the wires into memory, before anything moves.

    Args:
        job: What will be carried out.
        explainer: The explainer of the run; it is copied.
        record: Takes the ticks of the run; it keeps none of these.
        called_off: Whether the run is not wanted any more; the rehearsal then ends.

    Returns:
        How the rehearsal ended; nothing depends on it.
    """
    populate(WIRE_LIBRARIES)
    small = replace(job, plan=short(job.plan, job.config), back_to_m=None, lifts_first=False)
    in_small = sequence_of(small, filter_delay_s(job.config.sensor.filter_cutoff_Hz))
    return rehearse(job.config, in_small, explainer, job_limits(job), record, loaded=job.kind in BEGIN_LOADED, called_off=called_off)


def _lost(robot: Robot) -> bool:
    try:
        return not robot.read().connected
    except PalpdError:
        return True


def _run(job: Job, devices: Devices, explainer: Explainer, ring: Ring, request: Callable[[], Request]) -> Ended:
    """Run the job's loop on a FIFO thread."""
    sequence, limits, rate_Hz = sequence_of(job, devices.about["delay_s"]), job_limits(job), job.config.robot.rate_Hz
    clock = RealClock(rate_Hz, devices.first_tick_s)
    tare_judge = TareJudge(job, devices.about)
    loop = Loop(devices.robot, devices.sensor, clock, sequence, explainer, limits, RingWriter(ring), request, tare_judge.refusal)
    failed: list[TripReport] = []
    drain(devices.sensor)  # before the watchdog is set, because draining takes longer than the watchdog waits
    with realtime() as granted:
        loop.rehearse()
        devices.robot.move((0.0, 0.0, 0.0))  # arms the watchdog, which takes the controller some cycles: the grid begins after it
        clock.begin_soon()
        devices.sensor.read()  # the frames that were queued until now are too old
        try:
            outcome = loop.run()
        except Stopped as stopped:
            outcome = replace(loop.outcome, verdict="stopped", reason=str(stopped))
            failed = [{"trip": Trip.DEVICE.name, "measured": 1.0, "limit": 0.0, "reason": str(stopped)}]
        ring.state = (
            LoopState.ENDED
        )  # here no ticks are due any more, and as an ordinary thread this one may wait for seconds on a busy machine
    trips = [trip_report(verdict) for verdict in outcome.trips] + failed
    return Ended(outcome, tuple(trips), (*granted.missing, *explainer.notes(), *outcome.notes), tare_judge.answer)


class TareJudge:
    """Lets a run begin only where its tare is that of a free probe, or where an operator's word stands for it."""

    def __init__(self, job: Job, about: RunAbout) -> None:
        self._job, self._about = job, about
        self.answer: ProbeAnswer | None = None

    def refusal(self, observation: Observation, wrench: Floats) -> str | None:
        """Why the run may not begin, None where it may.

        Args:
            observation: The last tick of the tare.
            wrench: The tare (6,), in the sensor's axes.

        Returns:
            The sentence, or None.
        """
        if self._job.probe is None or self._job.kind not in JUDGE_TARE or (self._job.dry and self._job.kind != "check"):
            return None
        evidence = evidence_of(self._job.config, self._about, observation.robot.tcp_pose, tuple(wrench.tolist()))
        self.answer = probe_state(self._job.probe, evidence)
        may_begin = "move" in self.answer.ways or (self._job.confirmed and "confirm" in self.answer.ways)
        return None if may_begin else self.answer.sentence


def trip_report(verdict: Verdict) -> TripReport:
    """A verdict of the guard for people and files."""
    return TripReport(trip=verdict.trip.name, measured=verdict.measured, limit=verdict.limit, reason=sentence(verdict))


def take_reference(devices: Devices) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Mean wrench (6,) of a free, still probe, in the sensor's axes, N and Nm. Raises Refused where the frames are no tare."""
    tare = Tare()
    until_s = time.monotonic() + REFERENCE_PATIENCE_S
    drain(devices.sensor)
    while not tare.add(devices.robot.read(), devices.sensor.read()) and time.monotonic() < until_s:
        time.sleep(0.01)
    refusal = tare.refusal() or (None if tare.varies else "no axis of the force sensor moved by a count; unplug it and plug it in")
    if refusal is not None:
        raise Refused(f"no reference tare was taken: {refusal}")
    return tare.result()


def drain(sensor: ForceSensor) -> None:
    """Read and drop the queued frames: they are too old, and a terminal hands out 4 kB at a time, which is 0.25 s of frames."""
    until_s = time.monotonic() + DRAIN_S
    while time.monotonic() < until_s:
        sensor.read()
        time.sleep(0.001)


class RingWriter:
    """Writes each tick of the loop into the ring: one row, in place, without waiting."""

    def __init__(self, ring: Ring) -> None:
        self._ring = ring
        self._rows = RowWriter(ring.rows)

    def __call__(self, record: TickRecord) -> None:
        """Write one tick."""
        self._rows.fill(self._ring.begin(), record)
        self._ring.publish()

    def rehearse(self, record: TickRecord) -> None:
        """Fill the next row without publishing it."""
        self._rows.fill(self._ring.begin(), record)  # never published, so no reader sees it
