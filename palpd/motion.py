"""The motion process: the only one that holds the robot. It opens the devices, runs one job at a time on a FIFO thread, and dies
with its supervisor.

ur_rtde can hang or crash when a connection is lost and then resumes motion by itself; so a job that ended in a lost connection
ends this process, and a fresh one starts disarmed. After a crash of the library nobody is left to send a stop: the controller's
watchdog, fed by the speed commands themselves, brings the arm to rest.
"""

import math
import os
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from multiprocessing.connection import Connection
from typing import Any, Literal

import numpy as np

from palpd.clock import RealClock
from palpd.config import Config, ModelConfig, Plan
from palpd.errors import PalpdError, Refused, Stopped
from palpd.inertial import InertialModel, Motion
from palpd.loop import Explainer, Loop, Turn
from palpd.realtime import DEVICE_PRIORITY, fifo, realtime
from palpd.ring import LoopState, Ring
from palpd.rows import RowWriter
from palpd.running_zero import RunningZero
from palpd.safety import Limits, sentence
from palpd.sequence import Body, FreeMotion, Palpation, RigidPress, Script, Sequence, Watch
from palpd.tare import Tare
from palpd.tick import ForceSensor, Request, Robot, Trip

DRAIN_S = 0.1
ORPHAN_GRACE_S = 1.0
DRY_S = 10.0
"""How long a dry run watches: the arm is not moved, so no plan could come to its end."""
CHECK_S = 1.2
"""How long a check watches: with the second of its tare long enough for the guard to tell a stuck sensor."""
REFERENCE_PATIENCE_S = 5.0

Kind = Literal["palpation", "free_motion", "stiffness", "calibrate", "check"]
"""A check is a short dry run that is not recorded: what would stop a run at its beginning stops it."""


@dataclass(frozen=True, slots=True)
class Devices:
    """An opened robot and sensor. `first_tick_s` is just after the arrival of a robot state; `about` goes into the recording."""

    robot: Robot
    sensor: ForceSensor
    first_tick_s: float
    about: dict[str, Any]


Build = Callable[[Config, bool], Devices]
"""Opens what stands behind the loop; the flag mutes the robot. Must be importable, since the motion process is spawned."""


@dataclass(frozen=True, slots=True)
class Job:
    """One thing to do with the cell. `reference` (6,) is the tare of the last calibration in the axes of the sensor of that serial."""

    kind: Kind
    config: Config
    plan: Plan = field(default_factory=Plan)
    dry: bool = False
    reference: tuple[float, ...] | None = None
    machine_stiffness_N_per_m: float | None = None
    reference_serial: str | None = None


def body_of(job: Job, delay_s: float) -> Body:
    """What the sequence must know of probe, sensor and machine."""
    return Body(
        tip_radius_m=job.config.cell.probe.tip_radius_m,
        contact_limit_N=job.config.safety.contact_limit_N,
        max_speed_m_per_s=job.config.safety.max_speed_m_per_s,
        delay_s=delay_s,
        machine_stiffness_N_per_m=job.machine_stiffness_N_per_m or math.inf,
    )


def limits_of(config: Config, muted: bool = False) -> Limits:
    """The guard's limits of a configuration."""
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
        needs_program=not muted,
    )


def sequence_of(job: Job, delay_s: float) -> Sequence:
    """The script of a job."""
    body = body_of(job, delay_s)
    scripts: dict[str, Callable[[], Script]] = {
        "palpation": lambda: Palpation(job.plan, body),
        "free_motion": lambda: FreeMotion(body),
        "stiffness": lambda: RigidPress(job.plan, body),
    }
    return Sequence(Watch(body, CHECK_S if job.kind == "check" else DRY_S) if job.dry else scripts[job.kind]())


def explainer_of(job: Job, sensor_serial: str | None, delay_s: float) -> Explainer:
    """Axes, reference tare and inertial model of a job. Raises ModelRefused, and Refused where the tare is another sensor's."""
    config = job.config
    if job.reference is not None and job.reference_serial and sensor_serial and job.reference_serial != sensor_serial:
        raise Refused(f"the reference tare is of sensor {job.reference_serial}, but {sensor_serial} is connected; run palpd calibrate")
    model = None
    if config.model.path is not None and job.kind in ("palpation", "check"):
        model = InertialModel.load(config.model.path, probe_mass_kg=config.cell.probe.mass_kg, sensor_serial=sensor_serial)
    return Explainer(
        reference=np.array(job.reference or np.zeros(6), dtype=float),
        rotation_about_flange_z_rad=config.sensor.rotation_about_flange_z_rad,
        model=model,
        zero=zero_of(config.model) if model is not None else None,
        correction_limit_N=config.model.correction_limit_N,
        motion=Motion(delay_s),
    )


def zero_of(model: ModelConfig) -> RunningZero | None:
    """The running zero that follows what the model leaves, where one was chosen."""
    return RunningZero(limit_N=model.correction_limit_N) if model.zero == "running" else None


def serve(build: Build, ring_name: str, pipe: Connection, life: Connection) -> None:
    """Body of the motion process: jobs come over `pipe`, ticks go into the ring, and when `life` closes the supervisor is gone."""
    orphaned = threading.Event()
    threading.Thread(target=_watch, args=(life, orphaned), daemon=True).start()
    terminated = threading.Event()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the supervisor hears it too and asks for the abort
    signal.signal(signal.SIGTERM, lambda *_: terminated.set())
    ring = Ring.attach(ring_name)

    def request() -> Request:
        if orphaned.is_set():
            return Request.ORPHANED
        return Request.ABORT if terminated.is_set() else ring.request()

    while not orphaned.is_set():
        try:
            job = pipe.recv()
        except (EOFError, OSError):
            return
        if job is None:
            return
        try:
            answer, again = _do(build, job, ring, pipe, request)
        except PalpdError as error:
            answer, again = {"error": str(error), "exit_code": error.exit_code}, False
        except Exception as error:  # a defect of ours: it must reach the operator as a sentence, and the process must end
            answer, again = {"error": f"the motion process failed ({type(error).__name__}: {error})", "exit_code": 3}, False
        pipe.send(answer)
        if not again:
            break
    os._exit(0)  # not through ur_rtde's destructors, which can hang or crash after a lost connection


def _watch(life: Connection, orphaned: threading.Event) -> None:
    """Sleep until the supervisor is gone; then let the loop stop, and end the process even if the library hangs."""
    fifo(DEVICE_PRIORITY)  # else it may wait for half a second on a busy machine, or hold the interpreter's lock without running
    try:
        life.recv()
    except (EOFError, OSError):
        orphaned.set()
        time.sleep(ORPHAN_GRACE_S)
        os.kill(os.getpid(), signal.SIGKILL)


def _do(build: Build, job: Job, ring: Ring, pipe: Connection, request: Callable[[], Request]) -> tuple[dict[str, Any], bool]:
    """Open, say what was found, wait for the word, run. Returns the answer and whether this process may go on."""
    fifo(DEVICE_PRIORITY)
    devices = build(job.config, job.dry or job.kind == "calibrate")
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    try:
        if job.kind == "calibrate":
            return {"reference": take_reference(devices).tolist(), "about": devices.about}, True
        explainer = explainer_of(job, devices.about.get("sensor_serial"), devices.about["delay_s"])
        if job.reference is None:
            explainer.reference = take_reference(devices)
        if job.kind != "check":
            pipe.send({"opened": devices.about, "reference": explainer.reference.tolist()})
            if pipe.recv() != "go":
                return {"error": "called off", "exit_code": 2}, True
            ring.state = LoopState.RUNNING
        return _run(job, devices, explainer, ring, request)
    finally:
        ring.state = LoopState.ENDED  # from here on no ticks are due: closing a connection takes ur_rtde half a second
        if not _lost(devices.robot):  # else ur_rtde crashes in less time than closing takes, and the reason would go with it
            devices.robot.stop()
            devices.robot.close()
        devices.sensor.close()


def _lost(robot: Robot) -> bool:
    try:
        return not robot.read().connected
    except PalpdError:
        return True


def _run(job: Job, devices: Devices, explainer: Explainer, ring: Ring, request: Callable[[], Request]) -> tuple[dict[str, Any], bool]:
    """The job itself, on a FIFO thread."""
    sequence, limits, rate_Hz = sequence_of(job, devices.about["delay_s"]), limits_of(job.config, job.dry), job.config.robot.rate_Hz
    clock = RealClock(rate_Hz, devices.first_tick_s)
    loop = Loop(devices.robot, devices.sensor, clock, sequence, explainer, limits, RingWriter(ring), request)
    failed: list[dict[str, Any]] = []
    drain(devices.sensor)  # before the watchdog is set, since it takes its time
    with realtime() as granted:
        loop.rehearse()
        devices.robot.move((0.0, 0.0, 0.0))  # arms the watchdog, which takes the controller some cycles: the grid begins after it
        clock.begin_soon()
        devices.sensor.read()  # what was queued until now is of another time
        try:
            outcome = loop.run()
        except Stopped as stopped:
            outcome = replace(loop.outcome, verdict="stopped", reason=str(stopped))
            failed = [{"trip": Trip.DEVICE.name, "measured": 1.0, "limit": 0.0, "reason": str(stopped)}]
    trips = [{"trip": v.trip.name, "measured": v.measured, "limit": v.limit, "reason": sentence(v)} for v in outcome.trips] + failed
    answer = {
        "outcome": asdict(replace(outcome, trips=[])),
        "trips": trips,
        "notes": [*granted.missing, *explainer.notes()],
    }
    return answer, outcome.verdict == "done"


def take_reference(devices: Devices) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Mean wrench (6,) of a free, still probe. Raises Refused."""
    tare = Tare()
    until_s = time.monotonic() + REFERENCE_PATIENCE_S
    drain(devices.sensor)
    while not tare.add(devices.robot.read(), devices.sensor.read()) and time.monotonic() < until_s:
        time.sleep(0.01)
    refusal = tare.refusal()
    if refusal is not None:
        raise Refused(f"no reference tare was taken: {refusal}")
    return tare.result()


def drain(sensor: ForceSensor) -> None:
    """Let out what was queued before: it is of another time, and a terminal hands out 4 kB at a time, 0.25 s of frames."""
    until_s = time.monotonic() + DRAIN_S
    while time.monotonic() < until_s:
        sensor.read()
        time.sleep(0.001)


class RingWriter:
    """Puts a turn of the loop into the ring: one row, in place, no waiting."""

    def __init__(self, ring: Ring) -> None:
        self._ring = ring
        self._rows = RowWriter(ring.rows)

    def __call__(self, turn: Turn) -> None:
        self._rows.fill(self._ring.begin(), turn)
        self._ring.publish()

    def rehearse(self, turn: Turn) -> None:
        self._rows.fill(self._ring.begin(), turn)  # never published, so no reader sees it
