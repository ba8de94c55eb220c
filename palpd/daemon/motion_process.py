"""The motion process: the only process that holds the robot.

It opens the devices, runs one job at a time on a FIFO thread, and dies with its supervisor.

When a connection is lost, ur_rtde can hang or crash, and it then resumes motion by itself. So a lost connection ends this process, and
the next one starts disarmed. After a crash of the library nobody can send a stop. Then the controller's watchdog stops the arm: it
expects the speed commands.
"""

import os
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from palpd.config import filter_delay_s
from palpd.control.loop import Explainer, Loop, Outcome, Record
from palpd.control.probe_state import ProbeAnswer, ProbeEvidence, probe_state
from palpd.control.safety import sentence
from palpd.control.tare import Tare
from palpd.daemon.clock import RealClock
from palpd.daemon.devices import Build, Devices, drain
from palpd.daemon.finding import Finding
from palpd.daemon.motion_job import BEGIN_LOADED, JUDGE_TARE, Job, explainer_of, job_limits, sequence_of
from palpd.daemon.probe_record import evidence_of
from palpd.daemon.realtime import DEVICE_PRIORITY, fifo, populate, realtime
from palpd.daemon.rehearsal import rehearse, short
from palpd.daemon.robot_stops import ROBOT_STOPS
from palpd.errors import PalpdError, Refused, Stopped
from palpd.recording.header import RecordedTrip, RunAbout
from palpd.recording.ring import LoopState, Ring
from palpd.recording.tick_rows import RowWriter
from palpd.tick import Floats, Observation, Request, Robot, TickRecord, Trip, Verdict

ORPHAN_GRACE_S = 1.0
"""Time between the death of the supervisor and the end of this process: enough for the loop to stop the arm."""
REFERENCE_PATIENCE_S = 5.0
"""Longest wait for the second of frames that a reference tare needs."""
WIRE_LIBRARIES = ("rtde_control", "rtde_receive", "libpython", "libstdc++", "libc.so")
"""Libraries whose code a rehearsal without wires does not call; their files together have 7 MB of code."""

GO = "go"
CALLED_OFF = "called off"
"""The two answers of the supervisor to `Opened`."""


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
    trips: tuple[RecordedTrip, ...]
    notes: tuple[str, ...]
    probe: ProbeAnswer | None


Message = Opened | ReferenceTaken | Observed | Failed | Ended
"""Everything that the motion process sends to its supervisor."""


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
        if job.kind == "check" and devices.takes_programs is False:
            raise Refused(ROBOT_STOPS["local"].reason)
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
    failed: list[RecordedTrip] = []
    drain(devices.sensor)  # before the watchdog is set, because draining takes longer than the watchdog waits
    with realtime() as granted:
        loop.rehearse()
        devices.robot.move((0.0, 0.0, 0.0))  # arms the watchdog, which takes the controller some cycles: the grid begins after it
        clock.begin_soon()
        devices.sensor.read()  # the frames that were queued until now are too old
        ring.state = LoopState.RUNNING  # ticks are due from here on: what came before may have waited for seconds on a busy machine
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


def trip_report(verdict: Verdict) -> RecordedTrip:
    """A verdict of the guard for people and files."""
    return RecordedTrip(trip=verdict.trip.name, measured=verdict.measured, limit=verdict.limit, reason=sentence(verdict))


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
