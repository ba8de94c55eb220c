"""The main process: small, without ur_rtde. It owns the ring, starts motion process and recorder, notices their death, keeps the reason.

It never resumes a motion. Whatever ended a run, the next run begins with an operator's start and a new motion process.
"""

import contextlib
import datetime
import math
import multiprocessing
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from multiprocessing.connection import Connection
from pathlib import Path

from palpd.control.plan_place import ANSWERS, PlanPlace, question, way_back
from palpd.control.probe_state import ProbeAnswer, ProbeEvidence, ProbeState
from palpd.control.sequence import ORIGIN_LIMIT_M
from palpd.daemon import motion_process as motion
from palpd.daemon.contact_marker import END_S, MarkedRun
from palpd.daemon.devices import Build
from palpd.daemon.finding import Finding
from palpd.daemon.interrupts import shielded
from palpd.daemon.motion_job import BEGIN_LOADED, Job, Kind
from palpd.daemon.motion_process import CALLED_OFF, GO, Ended, Failed, Message, Observed, Opened, ReferenceTaken
from palpd.daemon.realtime import DEVICE_PRIORITY
from palpd.daemon.required_check import still_on_the_check
from palpd.daemon.robot_stops import protective
from palpd.daemon.run_header import header_of, place_of
from palpd.daemon.silence import explained
from palpd.daemon.socket_client import LastRun, LastTick
from palpd.daemon.stored_state import Latch, State, now
from palpd.daemon.tick_watch import TickWatch
from palpd.daemon.witness import Witness
from palpd.errors import PalpdError, RecordingError, Refused
from palpd.recording.header import RecordedStall, RecordedTrip, RunAbout
from palpd.recording.mcap_file import part_of
from palpd.recording.recorder import Recorder
from palpd.recording.ring import LoopState, RecorderState, Ring, Rows
from palpd.tick import Phase, Request, Trip

STALLED_S = 2.0
"""A loop whose tick counter stands still for this long is killed. The controller's watchdog has stopped the arm long before."""
OPENING_S = 40.0
"""Longest wait for the devices to open, including the start of the program on the controller."""
CLOSING_S = 10.0
"""Longest wait for the devices to close. ur_rtde needs a second; it can also hang."""
RECORDER_S = 20.0
"""Longest wait for the recorder to open its file, imports included."""
FOOTER_S = 60.0
"""Longest wait for the recorder to close its file: a slow disk must not cost the recording."""
SIGNAL_S = 0.6
"""Longest time from a signal to the end of the loop and of the devices: together with the recording and the tables within 1 s."""
ASKED = "the operator aborted"
"""Cause of an abort that the loop names by itself; any other one is recorded beside it."""
UNLATCHED = {Trip.NONE, Trip.CONTACT_FORCE, Trip.OPERATOR}
"""Trips that are no fault: the next start needs no `palpd clear`."""
CALLED_OFF_WHILE: dict[Kind, str] = {
    "calibrate": "while the reference tare was being taken",
    "check": "while the devices were being checked",
    "observe": "while the devices were being observed",
}
"""What a job was doing before its loop began, where it is not only opening the devices."""
UNKEPT_PROBE = ProbeAnswer(ProbeState.UNKNOWN, ("how the last run left it could not be kept",), frozenset(("retract", "level_test")))
LAST_TICKS = 10
"""Number of ticks before a stop that are kept for the operator: 80 ms at 125 Hz, a table that fits the terminal."""


@dataclass(frozen=True, slots=True)
class Report:
    """How a run ended, for the operator and the exit code. `last_ticks` is filled where a run was stopped.

    `probe` says how it leaves the probe, where it moved or looked; `evidence` is that of a reference tare.
    """

    verdict: str
    reason: str = ""
    exit_code: int = 0
    trips: tuple[RecordedTrip, ...] = ()
    recording: Path | None = None
    about: RunAbout = field(default_factory=lambda: RunAbout())
    notes: tuple[str, ...] = ()
    last_ticks: tuple[LastTick, ...] = ()
    findings: tuple[Finding, ...] = ()
    evidence: ProbeEvidence | None = None
    probe: ProbeAnswer | None = None

    @property
    def summary(self) -> LastRun:
        """What the status, a job and a result say of it."""
        recording = str(self.recording) if self.recording is not None else None
        return LastRun(
            verdict=self.verdict, reason=self.reason, recording=recording, notes=list(self.notes), last_ticks=list(self.last_ticks)
        )


class MotionProcess:
    """A spawned motion process and the pipes to it. It dies together with the process of this object."""

    def __init__(self, build: Build, ring: Ring) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, far = context.Pipe()
        far_life, self._life = context.Pipe(duplex=False)
        self.process = context.Process(target=motion.serve, args=(build, ring.name, far, far_life), name="palpd-motion")
        self.process.start()
        far.close()
        far_life.close()

    def end(self) -> None:
        """Ask the process to end, without waiting for it."""
        with contextlib.suppress(OSError):
            self.pipe.send(None)


# --- the states of a job, and what happens to it --------------------------------------------------------------------------------


class Underway:
    """It is open how the job ends."""

    __slots__ = ()


@dataclass(frozen=True, slots=True)
class Opening(Underway):
    """The motion process opens the devices. A check, a calibration and an observation are carried out whole here."""

    since_s: float


@dataclass(frozen=True, slots=True)
class OpeningRecorder(Underway):
    """The devices are open, and the recorder opens its file."""

    opened: Opened
    recorder: Recorder
    since_s: float


@dataclass(frozen=True, slots=True)
class StartedLoop:
    """What a job has once its loop may move the arm.

    `marked` is None for a dry run, `place` for whatever is no palpation; `recorded` is false once the recorder has failed.
    """

    opened: Opened
    recorder: Recorder
    marked: MarkedRun | None
    place: PlanPlace | None
    recorded: bool = True


@dataclass(frozen=True, slots=True)
class Starting(Underway):
    """The loop may begin; no tick is due yet."""

    loop: StartedLoop


@dataclass(frozen=True, slots=True)
class Running(Underway):
    """Ticks are due, or the last one was sent and the devices close."""

    loop: StartedLoop


@dataclass(frozen=True, slots=True)
class Closing:
    """It is known how the job ends; motion process and recorder end. `loop` is None where it was never started.

    `recorder` is None where no file is kept, `ended` where the loop sent no last word.
    """

    report: Report
    since_s: float
    recorder: Recorder | None = None
    loop: StartedLoop | None = None
    ended: Ended | None = None


@dataclass(frozen=True, slots=True)
class Closed:
    """All is over. `loop` is None where it was never started."""

    report: Report
    loop: StartedLoop | None


class Happened(Enum):
    """What the supervisor sees by itself; the messages of the motion process are the other events."""

    ABORTED = "abort"  # before the loop was started; later it is the loop that aborts
    DIED = "motion process died"
    RECORDER_ANSWERED = "recorder answered, or is late"
    TICKING = "ticks are due"
    RECORDING_LOST = "recording failed"
    MOTION_LATE = "motion process is late"
    ALL_ENDED = "motion process and recorder ended, or the recorder is late"


@dataclass(frozen=True, slots=True)
class Overdue:
    """A time limit has passed, and the motion process is killed."""

    reason: str


Stage = Opening | OpeningRecorder | Starting | Running | Closing | Closed
Event = Message | Happened | Overdue


def _held(stage: Stage) -> tuple[RunAbout, Recorder | None, StartedLoop | None]:
    """What is known of the devices, the recorder in use, and the loop that was started."""
    match stage:
        case OpeningRecorder(opened, recorder):
            return opened.about, recorder, None
        case Starting(loop) | Running(loop):
            return loop.opened.about, loop.recorder, loop
        case Closing(report, _, recorder, loop):
            return report.about, recorder, loop
        case Closed(report, loop):
            return report.about, None, loop
        case Opening():
            return {}, None, None


class JobRun:
    """One job under way. `poll` never waits; it returns a report when the job is over, the devices and the recording are closed.

    Where the state folder cannot be written, `unkept` says why; the job is aborted and counts as stopped, since the arm may have moved.
    """

    def __init__(self, job: Job, build: Build, ring: Ring, state: State, name: str) -> None:
        self.job, self._ring, self._state, self._name = job, ring, state, name
        self._abort_cause, self._kill_at_s, began_s = "", math.inf, time.monotonic()
        self.unkept = ""  # why the state folder could not be written
        self.way_back = ""  # where the arm goes first, once that is known
        self._stage: Stage = Opening(began_s)
        self._first_tick, self._watch = ring.published, TickWatch(ring.published, began_s)
        ring.state = LoopState.STARTING
        ring.forget_requests()  # requests for an earlier run are void; from here on every abort counts
        try:
            with shielded():
                self._witness = Witness(DEVICE_PRIORITY)
                self._motion = MotionProcess(build, ring)
            self._motion.pipe.send(replace(job, planted=None))  # what is planted is for the recorder alone
        except OSError as error:
            moved = "; nothing was moved" * job.moves
            raise Refused(f"this computer starts no process ({error.strerror}){moved}; end other programs, and try again") from error

    def ask(self, request: Request, cause: str = ASKED) -> None:
        """Pass a request to the loop. An abort before the loop was started calls the job off; a `cause` that is no operator is recorded."""
        self._ring.ask(request)
        if request == Request.ABORT:
            self._abort_cause = self._abort_cause or cause

    def interrupt(self, name: str) -> None:
        """Abort because of that signal. What has not ended `SIGNAL_S` later is killed, and the controller's watchdog stops the arm."""
        if math.isinf(self._kill_at_s):
            self._kill_at_s = time.monotonic() + SIGNAL_S
            self._abort_cause = self._abort_cause or f"interrupted by {name}"
            self._ring.ask(Request.ABORT)

    @property
    def recording(self) -> Path | None:
        """The unfinished recording, where one is written."""
        _, recorder, _ = _held(self._stage)
        return part_of(recorder.path) if recorder is not None else None

    @property
    def closed_recording(self) -> Path | None:
        """The finished recording, where there is one."""
        _, recorder, _ = _held(self._stage)
        return recorder.path if recorder is not None and recorder.path.exists() else None

    @property
    def called_off(self) -> bool:
        """Whether the job was aborted before its loop was started."""
        _, _, loop = _held(self._stage)
        return bool(self._abort_cause) and loop is None

    def poll(self) -> Report | None:
        """A report when the job is over, else None."""
        try:
            while (event := self._event(self._stage)) is not None:
                self._stage = self._next(self._stage, event)
        except PalpdError as error:
            if self.unkept:  # the second time it is the end of the job that cannot be kept; its recording is closed by then
                _, _, loop = _held(self._stage)
                probe = UNKEPT_PROBE if loop is not None and loop.marked is not None else None
                return Report("stopped", self.unkept, 3, recording=self.closed_recording, probe=probe)
            self.unkept = f"the run does not count as done: {error}"
            self.ask(Request.ABORT, self.unkept)
            return None
        if not isinstance(self._stage, Closed):
            return None
        report = self._stage.report
        return replace(report, verdict="stopped", reason=self.unkept, exit_code=3) if self.unkept else report

    def _next(self, stage: Stage, event: Event) -> Stage:
        """The state after an event. An event without a line here changes nothing. ARCHITECTURE.md shows the lines as a table."""
        match stage, event:
            case (Opening() | OpeningRecorder()) as early, Happened.ABORTED:
                return self._call_off(early)
            case Opening(), Opened() as opened:
                return self._open_recorder(opened)
            case OpeningRecorder() as ready, Happened.RECORDER_ANSWERED:
                return self._start_loop(ready)
            case Starting(loop), Happened.TICKING:
                self._watch.begin(time.monotonic())
                return Running(loop)
            case (Starting(loop) | Running(loop)) as moving, Happened.RECORDING_LOST:
                self._ring.ask(Request.ABORT)  # a palpation that is not recorded is worth nothing
                return replace(moving, loop=replace(loop, recorded=False))
            case Underway(), Happened.DIED:
                return self._close(Report("stopped", self._death(), 3), stage)
            case Underway(), Overdue(reason):
                self._motion.process.kill()
                return self._close(Report("stopped", reason, 3), stage)
            case Underway(), (ReferenceTaken() | Observed() | Failed() | Ended()) as message:
                return self._close(self._reported(message), stage, message if isinstance(message, Ended) else None)
            case Closing(), Happened.MOTION_LATE:
                self._motion.process.kill()
                self._motion.process.join()
            case Closing() as closing, Happened.ALL_ENDED:
                return Closed(self._over(closing), closing.loop)
        return stage

    def _event(self, stage: Stage) -> Event | None:
        """What has happened since the last look, the most urgent first; None where nothing has."""
        if isinstance(stage, Closed):
            return None
        if isinstance(stage, Closing):
            return self._closing_event(stage, time.monotonic())
        if self.called_off:
            return Happened.ABORTED
        pipe: Connection = self._motion.pipe
        try:
            if pipe.poll():
                message: Message = pipe.recv()
                return message
        except (EOFError, OSError):
            return Happened.DIED
        if not self._motion.process.is_alive():
            return Happened.DIED
        if isinstance(stage, OpeningRecorder):
            late = time.monotonic() - stage.since_s >= RECORDER_S
            return Happened.RECORDER_ANSWERED if stage.recorder.answered or late else None
        now_s = time.monotonic()
        ended_s = self._watch.ended_s(self._ring.state, now_s)
        event = self._loop_event(stage, now_s) if isinstance(stage, Starting | Running) else None
        if event is not None:
            return event
        if ended_s > CLOSING_S:
            return Overdue(f"the devices were not closed within {CLOSING_S:g} s after the last tick; the motion process was killed")
        if isinstance(stage, Opening) and now_s - stage.since_s > OPENING_S + self.job.watch_s:
            return Overdue(f"the devices were not opened within {OPENING_S:g} s; is the controller's program able to start?")
        if now_s > self._kill_at_s:
            return Overdue(
                f"the operator aborted the run, its loop had not ended {SIGNAL_S:g} s later and was killed; "
                "the controller's watchdog stops the arm"
            )
        return None

    def _loop_event(self, stage: Starting | Running, now_s: float) -> Event | None:
        """Judge whether the run is recorded and its loop begins and ticks; keep its marker up."""
        loop, ring = stage.loop, self._ring
        still_s, ticking = self._watch.still_s(ring.published, now_s), ring.state == LoopState.RUNNING
        if loop.recorded and (ring.recorder_state == RecorderState.FAILED or not loop.recorder.alive):
            return Happened.RECORDING_LOST
        if ticking and loop.marked is not None and ring.published > self._first_tick:
            loop.marked.follow(ring.read(ring.published - 1)[0])
        if ticking and isinstance(stage, Starting):
            return Happened.TICKING
        if ring.state == LoopState.STARTING and still_s > OPENING_S:
            return Overdue(f"the loop did not begin within {OPENING_S:g} s{'; nothing was moved' * self.job.moves}")
        if ticking and still_s > STALLED_S:
            return Overdue(f"the loop stood still for {STALLED_S:g} s and was killed; the controller's watchdog stops the arm")
        return None

    def _closing_event(self, closing: Closing, now_s: float) -> Event | None:
        if self._motion.process.is_alive():
            late = now_s >= min(closing.since_s + CLOSING_S, self._kill_at_s)
            return Happened.MOTION_LATE if late else None
        recorder = closing.recorder
        if recorder is not None and not recorder.answered and now_s < closing.since_s + FOOTER_S:
            return None
        return Happened.ALL_ENDED

    # --- what a transition does -------------------------------------------------------------------------------------------------

    def _open_recorder(self, opened: Opened) -> OpeningRecorder | Closing:
        """Start the recorder, where the operator need not say first where the sites count from."""
        job = self.job
        if job.kind == "palpation" and not job.dry and job.plan.origin is None:
            asked = question(job.last, opened.pose[0], opened.pose[1], job.choice)
            if asked is not None:
                return self._refuse(opened, f"{asked}; {ANSWERS}")
        if job.back_to_m is not None and job.last is not None:
            away_m, self.way_back = way_back(job.last, opened.pose[0], opened.pose[1])
            if away_m > ORIGIN_LIMIT_M:
                return self._refuse(
                    opened, f"{self.way_back}, expected at most {ORIGIN_LIMIT_M * 1e3:g} mm; move the arm nearer, or give --here instead"
                )
        header = header_of(job, opened.about, opened.reference, opened.pose)
        model = job.config.model.path if job.kind == "palpation" else None
        folder = job.config.paths.runs
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with shielded():
                recorder = Recorder.begin(
                    self._ring, folder / f"{self._name}.mcap", header, model.read_bytes() if model else None, job.planted
                )
        except OSError as error:
            return self._refuse(opened, error)
        return OpeningRecorder(opened, recorder, time.monotonic())

    def _start_loop(self, ready: OpeningRecorder) -> Starting | Closing:
        """Write the marker of a contact, then let the loop begin; a run that is not recorded or not marked does not begin."""
        job, opened, recorder = self.job, ready.opened, ready.recorder
        marked = place = None
        try:
            recorder.confirm()
        except RecordingError as error:
            without = ", or free the probe at the pendant" * (job.kind in ("retract", "level_test"))
            return self._refuse(opened, f"{error}{without}")
        try:
            if job.kind == "palpation" and not job.dry:
                place = place_of(job, opened.pose, self._name)
                self._state.keep("place", place)
            if not job.dry:
                marked = MarkedRun(job, self._state, opened.about, opened.reference, opened.pose, self._name)
        except PalpdError as error:
            recorder.discard()
            return self._refuse(opened, error)
        self._motion.pipe.send(GO)
        self._watch.begin(time.monotonic())
        return Starting(StartedLoop(opened, recorder, marked, place))

    def _refuse(self, opened: Opened, reason: object) -> Closing:
        self._motion.pipe.send(CALLED_OFF)
        return self._close(Report("refused", f"{'nothing was moved: ' * self.job.moves}{reason}", 2, about=opened.about))

    def _call_off(self, stage: Opening | OpeningRecorder) -> Closing:
        """End a job whose loop was not started: nothing has moved, so nothing needs to be stopped."""
        moment = CALLED_OFF_WHILE.get(self.job.kind, "while the devices were being opened")
        if isinstance(stage, OpeningRecorder):
            moment = "while the recording was being opened"
            with contextlib.suppress(OSError):
                self._motion.pipe.send(CALLED_OFF)
            stage.recorder.discard()
        else:
            self._motion.process.kill()  # it may be inside a call that takes seconds
        about, _, _ = _held(stage)
        return self._close(Report("refused", f"{self._abort_cause} {moment}{'; nothing was moved' * self.job.moves}", 2, about=about))

    def _reported(self, message: ReferenceTaken | Observed | Failed | Ended) -> Report:
        match message:
            case ReferenceTaken(about, evidence):
                return Report("done", about=about, evidence=evidence)
            case Observed(about, findings, probe):
                return Report("done", about=about, findings=findings, probe=probe)
            case Failed(reason, exit_code):
                return Report("refused" if exit_code == 2 else "stopped", reason, exit_code)
            case Ended(outcome, trips, notes, probe):
                exit_code = 0 if outcome.verdict == "done" else 2 if outcome.refused else 3
                cause = f" ({self._abort_cause})" if self._abort_cause not in ("", ASKED) and exit_code else ""
                reason = outcome.reason + self._silence(trips) + cause
                return Report(outcome.verdict, reason, exit_code, trips, notes=notes, probe=probe)

    def _silence(self, trips: Sequence[RecordedTrip]) -> str:
        """Whether a device was silent or this computer stood still, as far as that ended the run."""
        self._witness.hear()
        rows = self._rows(1)
        at_s = float(rows["now_s"][-1]) if len(rows) else time.monotonic()
        return explained(trips, at_s, 1.0 / self.job.config.robot.rate_Hz, self._witness)

    def _death(self) -> str:
        self._motion.process.join(0.5)
        code = self._motion.process.exitcode
        how = f"by signal {-code}" if code is not None and code < 0 else f"with code {code}"
        return f"the motion process ended {how}; the controller's watchdog stops the arm"

    def _close(self, report: Report, kept: Stage | None = None, ended: Ended | None = None) -> Closing:
        """Ask motion process, witness and recorder to end, without waiting for them.

        Args:
            report: How the job ends.
            kept: The state that it ends from, with recorder and loop; None where no file is kept and no loop was started.
            ended: The last word of the loop; None where it sent none.
        """
        about, recorder, loop = _held(kept) if kept is not None else (report.about, None, None)
        closing = Closing(replace(report, about=report.about or about), time.monotonic(), recorder, loop, ended)
        self._motion.end()
        self._witness.end()
        if recorder is not None:
            stalls = [RecordedStall(begin_s=begin_s, end_s=end_s, processor=number) for begin_s, end_s, number in self._witness.stalls]
            recorder.finish({"verdict": report.verdict, "reason": report.reason, "trips": list(report.trips), "stalls": stalls})
        return closing

    def _over(self, closing: Closing) -> Report:
        """Close the recording, latch a fault, and judge how the run leaves the probe."""
        report, loop = closing.report, closing.loop
        recording, notes = None, report.notes
        if closing.recorder is not None:
            try:
                recording = closing.recorder.close(timeout_s=0.0)
            except RecordingError as error:
                notes = (*notes, str(error))
                if loop is not None and not loop.recorded:  # the abort in the trips was ours
                    report = replace(report, reason=f"the run was stopped because it was no longer recorded: {error}")
            answered = self.job.kind == "level_test" and closing.ended is not None  # what it found stands in the marker
            if self.job.clears_latch and report.exit_code != 2:
                self._state.clear_latch()
            died = report.exit_code == 3 and not report.trips and not answered
            stands = self.job.kind in BEGIN_LOADED and self._state.latch() is not None  # the reason of the stop before stays
            if not stands and (died or any(Trip[trip["trip"]] not in UNLATCHED for trip in report.trips)):
                self._state.keep("latch", Latch(report.reason, now()))
        if protective(report.trips):
            self._state.keep("protective", self._state.protective_stops().begin(now(), moved=self.job.moves))
        last_ticks = last_ticks_of(self._rows(LAST_TICKS)) if report.exit_code == 3 else ()
        if loop is not None and loop.place is not None:
            doubt = still_on_the_check(loop.place, self.job.last, self.job.config.check.plate)
            notes = (*notes, doubt) if doubt else notes
        if loop is not None and loop.place is not None and report.verdict == "done":
            self._state.keep("place", replace(loop.place, returned=True))
        marked = loop.marked if loop is not None else None
        if marked is not None and report.exit_code == 2:
            marked.undo()
            if self.job.kind == "palpation":  # it counts as no unfinished one: nothing has moved
                self._state.put_back("place", self.job.last)
        elif marked is not None:
            rows = self._rows(math.ceil(END_S * self.job.config.robot.rate_Hz) + 1)
            level = closing.ended is not None and closing.ended.outcome.level
            probe = marked.end(rows, level, closing.ended is not None)
            report = replace(report, probe=probe)
            if probe.state != ProbeState.FREE:
                notes = (*notes, probe.sentence)
        return replace(report, recording=recording, notes=notes, last_ticks=last_ticks)

    def _rows(self, most: int) -> Rows:
        """The newest rows of this run. They come from the ring: it also holds them after a crash or without a recording."""
        return self._ring.read(max(self._first_tick, self._ring.published - most))[0]


def last_ticks_of(rows: Rows) -> tuple[LastTick, ...]:
    """Force, height, speed and command of each row.

    Args:
        rows: Rows (n,) of the ring or of a recording, oldest first.

    Returns:
        One entry a row, in the same order.
    """
    return tuple(
        LastTick(
            before_end_s=float(rows["now_s"][-1] - row["now_s"]),
            phase=Phase(int(row["phase"])).name.lower(),
            force_N=float(row["force_N"]),
            z_m=float(row["tcp_pose"][2]),
            vz_m_per_s=float(row["tcp_speed"][2]),
            command_m_per_s=row["command_m_per_s"].tolist(),
            command_stop=bool(row["command_stop"]),
        )
        for row in rows
    )


def recording_name(kind: str) -> str:
    """A file name that sorts by time."""
    return f"{datetime.datetime.now():%Y%m%d-%H%M%S}-{kind.replace('_', '-')}"


def wait(run: JobRun, on_poll: Callable[[], None] | None = None) -> Report:
    """Poll a run until it is over. If `on_poll` fails, the run is aborted, and the error raised when the arm is at rest.

    Args:
        on_poll: Called after each poll that found the run still under way; None: no call.

    Returns:
        How the run ended.

    Raises:
        PalpdError: `on_poll` raised it.
    """
    failure: PalpdError | None = None
    while (report := run.poll()) is None:
        if on_poll is not None:
            try:
                on_poll()
            except OSError:  # the terminal is gone: nobody can watch or interrupt the run any more
                run.interrupt("the end of the terminal")
                on_poll = None
            except PalpdError as error:
                run.ask(Request.ABORT, str(error))
                failure, on_poll = error, None
        time.sleep(0.02)
    if failure is not None:
        raise failure
    return report
