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
from multiprocessing.connection import Connection
from pathlib import Path

from palpd.control.plan_place import ANSWERS, PlanPlace, question
from palpd.control.probe_state import ProbeAnswer, ProbeEvidence, ProbeState
from palpd.daemon import motion_process as motion
from palpd.daemon.contact_marker import END_S, MarkedRun
from palpd.daemon.devices import Build
from palpd.daemon.finding import Finding
from palpd.daemon.interrupts import shielded
from palpd.daemon.motion_job import BEGIN_LOADED, Job, Kind
from palpd.daemon.motion_process import CALLED_OFF, GO, Ended, Failed, Message, Observed, Opened, ReferenceTaken, TripReport
from palpd.daemon.realtime import DEVICE_PRIORITY
from palpd.daemon.run_header import header_of, place_of
from palpd.daemon.silence import explained
from palpd.daemon.socket_client import LastTick
from palpd.daemon.stored_state import Latch, State, now
from palpd.daemon.witness import Witness
from palpd.errors import PalpdError, RecordingError
from palpd.recording.header import RecordedStall, RunAbout
from palpd.recording.mcap_file import part_of
from palpd.recording.recorder import Recorder
from palpd.recording.ring import LoopState, RecorderState, Ring, Rows
from palpd.tick import Phase, Request, Trip

STALLED_S = 2.0
"""A loop whose tick counter stands still for this long is killed. The controller's watchdog has stopped the arm long before."""
LOOK_S = 0.25
"""Longest time between two looks at the loop; a longer one shows that this process, and perhaps the whole computer, stood still."""
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
UNLATCHED = {Trip.NONE, Trip.CONTACT_FORCE, Trip.OPERATOR}
"""Trips that are no fault: the next start needs no `palpd clear`."""
CALLED_OFF_WHILE: dict[Kind, str] = {
    "calibrate": "while the reference tare was being taken",
    "check": "while the devices were being checked",
    "observe": "while the devices were being observed",
}
"""What a job was doing before its loop began, where it is not only opening the devices."""
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
    trips: tuple[TripReport, ...] = ()
    recording: Path | None = None
    about: RunAbout = field(default_factory=lambda: RunAbout())
    notes: tuple[str, ...] = ()
    last_ticks: tuple[LastTick, ...] = ()
    findings: tuple[Finding, ...] = ()
    evidence: ProbeEvidence | None = None
    probe: ProbeAnswer | None = None


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


class TickWatch:
    """Time for which ticks did not advance while this process itself ran: a computer that stood still is no loop that hangs."""

    def __init__(self, ticks: int, now_s: float) -> None:
        self._ticks = ticks
        self.begin(now_s)

    def begin(self, now_s: float) -> None:
        """Count from now on."""
        self._since_s = self._looked_s = now_s

    def still_s(self, ticks: int, now_s: float) -> float:
        """The time without a new tick, in s, given the ticks that were counted until now."""
        stood_still_s = max(0.0, now_s - self._looked_s - LOOK_S)
        self._looked_s = now_s
        if ticks != self._ticks:
            self._ticks, self._since_s = ticks, now_s
        else:
            self._since_s += stood_still_s
        return now_s - self._since_s


class JobRun:
    """One job under way. `poll` never waits; it returns a report when the job is over, the devices and the recording are closed."""

    def __init__(self, job: Job, build: Build, ring: Ring, state: State, name: str) -> None:
        self.job, self._ring, self._state, self._name = job, ring, state, name
        self._recorder: Recorder | None = None
        self._about: RunAbout = {}
        self._reported = self._going = self._began_ticking = self._lost_recorder = self._interrupted = False
        self._marked: MarkedRun | None = None
        self._place: PlanPlace | None = None
        self._opened: Opened | None = None
        self._level = self._came_to_rest = False
        self._abort_cause = ""
        self._report: Report | None = None
        self._ended_s = self._end_by_s = math.inf
        self._began_s = self._closing_s = time.monotonic()
        self._first_tick = ring.published
        self._watch = TickWatch(ring.published, self._began_s)
        ring.state = LoopState.STARTING
        ring.forget_requests()  # requests for an earlier run are void; from here on every abort counts
        with shielded():
            self._witness = Witness(DEVICE_PRIORITY)
            self._motion = MotionProcess(build, ring)
        self._motion.pipe.send(job)

    def ask(self, request: Request) -> None:
        """Pass an operator's request to the loop. An abort before the loop was started calls the job off."""
        self._ring.ask(request)
        if request == Request.ABORT:
            self._abort_cause = self._abort_cause or "the operator aborted"

    def interrupt(self, name: str) -> None:
        """Abort because of that signal. What has not ended `SIGNAL_S` later is killed, and the controller's watchdog stops the arm."""
        if not self._interrupted:
            self._interrupted, self._end_by_s = True, time.monotonic() + SIGNAL_S
            self._abort_cause = self._abort_cause or f"interrupted by {name}"
            self._ring.ask(Request.ABORT)

    @property
    def recording(self) -> Path | None:
        """The unfinished recording, where one is written."""
        return part_of(self._recorder.path) if self._recorder is not None else None

    @property
    def called_off(self) -> bool:
        """Whether the job was aborted before its loop was started."""
        return bool(self._abort_cause) and not self._going

    def poll(self) -> Report | None:
        """A report when the job is over, else None."""
        if self._report is None:
            report = self._call_off() if self.called_off else self._advance()
            if report is None:
                return None
            self._begin_closing(report)
        return self._closed()

    def _advance(self) -> Report | None:
        """Take what has come from the motion process and the recorder. A report when nothing more is to be expected of the loop."""
        pipe: Connection = self._motion.pipe
        try:
            if pipe.poll():
                return self._received(pipe.recv())
        except (EOFError, OSError):
            return Report("stopped", self._death(), 3)
        if not self._motion.process.is_alive():
            return Report("stopped", self._death(), 3)
        if self._recorder is not None and not self._going:
            return self._begin_loop(self._recorder)
        return self._watched()

    def _watched(self) -> Report | None:
        """Judge how long everything takes, and whether the run is still recorded."""
        now_s = time.monotonic()
        still_s = self._watch.still_s(self._ring.published, now_s)
        failed = self._ring.recorder_state == RecorderState.FAILED
        if self._recorder is not None and (failed or not self._recorder.alive) and not self._lost_recorder:
            self._lost_recorder = True
            self._ring.ask(Request.ABORT)  # a palpation that is not recorded is worth nothing
        ticking = self._ring.state == LoopState.RUNNING
        if ticking and self._marked is not None and self._ring.published > self._first_tick:
            self._marked.follow(self._ring.read(self._ring.published - 1)[0])
        if ticking and not self._began_ticking:
            self._began_ticking, still_s = True, 0.0
            self._watch.begin(now_s)
        if self._going and self._ring.state == LoopState.STARTING and still_s > OPENING_S:
            return self._kill(f"the loop did not begin within {OPENING_S:g} s{'; nothing was moved' * self.job.moves}")
        if ticking and still_s > STALLED_S:
            return self._kill(f"the loop stood still for {STALLED_S:g} s and was killed; the controller's watchdog stops the arm")
        if self._ring.state != LoopState.ENDED:
            self._ended_s = now_s
        elif now_s - self._ended_s > CLOSING_S:
            return self._kill(f"the devices were not closed within {CLOSING_S:g} s after the last tick; the motion process was killed")
        if not self._reported and now_s - self._began_s > OPENING_S + self.job.watch_s:
            return self._kill(f"the devices were not opened within {OPENING_S:g} s; is the controller's program able to start?")
        if now_s > self._end_by_s:
            return self._kill(
                f"the operator aborted the run, its loop had not ended {SIGNAL_S:g} s later and was killed; "
                "the controller's watchdog stops the arm"
            )
        return None

    def _received(self, message: Message) -> Report | None:
        match message:
            case Opened():
                return self._begin_recording(message)
            case ReferenceTaken(about, evidence):
                return Report("done", about=about, evidence=evidence)
            case Observed(about, findings, probe):
                return Report("done", about=about, findings=findings, probe=probe)
            case Failed(reason, exit_code):
                return Report("refused" if exit_code == 2 else "stopped", reason, exit_code)
            case Ended(outcome, trips, notes):
                exit_code = 0 if outcome.verdict == "done" else 2 if outcome.refused else 3
                self._level, self._came_to_rest = outcome.level, True
                by_signal = f" ({self._abort_cause})" if self._interrupted and exit_code else ""
                reason = outcome.reason + self._silence(trips) + by_signal
                return Report(outcome.verdict, reason, exit_code, trips, notes=notes, probe=message.probe)

    def _silence(self, trips: Sequence[TripReport]) -> str:
        """Whether a device was silent or this computer stood still, as far as that ended the run."""
        self._witness.hear()
        rows, _, _ = self._ring.read(max(self._first_tick, self._ring.published - 1))
        at_s = float(rows["now_s"][-1]) if len(rows) else time.monotonic()
        return explained(trips, at_s, 1.0 / self.job.config.robot.rate_Hz, self._witness)

    def _begin_recording(self, opened: Opened) -> Report | None:
        self._reported, self._about, self._opened = True, opened.about, opened
        if (asked := self._place_question(opened.pose)) is not None:
            return self._refuse(f"{asked}; {ANSWERS}")
        header = header_of(self.job, opened.about, opened.reference, opened.pose)
        model = self.job.config.model.path if self.job.kind == "palpation" else None
        folder = self.job.config.paths.runs
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with shielded():
                self._recorder = Recorder.begin(self._ring, folder / f"{self._name}.mcap", header, model.read_bytes() if model else None)
        except OSError as error:
            return self._refuse(error)
        self._began_s = time.monotonic()
        return None

    def _begin_loop(self, recorder: Recorder) -> Report | None:
        """Start the loop when the recording is open."""
        if not recorder.answered and time.monotonic() - self._began_s < RECORDER_S:
            return None
        try:
            recorder.confirm()
        except RecordingError as error:
            self._recorder = None
            return self._refuse(error)
        try:
            self._mark()
        except PalpdError as error:
            recorder.discard()
            self._recorder = None
            return self._refuse(error)
        self._motion.pipe.send(GO)
        self._going = True
        self._watch.begin(time.monotonic())
        return None

    def _mark(self) -> None:
        """Write the marker of a contact before anything moves; a run that could not be marked does not begin."""
        assert self._opened is not None
        opened = self._opened
        if self.job.kind == "palpation" and not self.job.dry:
            self._place = place_of(self.job, opened.pose, self._name)
            self._state.keep("place", self._place)
        if not self.job.dry:
            self._marked = MarkedRun(self.job, self._state, opened.about, opened.reference, opened.pose, self._name)

    def _place_question(self, pose: tuple[float, ...]) -> str | None:
        """Whether the operator must say first where the sites count from."""
        if self.job.kind != "palpation" or self.job.dry or self.job.plan.origin is not None:
            return None
        return question(self.job.last, pose[0], pose[1], self.job.choice)

    def _refuse(self, reason: object) -> Report:
        self._motion.pipe.send(CALLED_OFF)
        return Report("refused", f"{'nothing was moved: ' * self.job.moves}{reason}", 2)

    def _call_off(self) -> Report:
        """End a job whose loop was not started: nothing has moved, so nothing needs to be stopped."""
        moment = CALLED_OFF_WHILE.get(self.job.kind, "while the devices were being opened")
        if self._reported:
            moment = "while the recording was being opened"
            with contextlib.suppress(OSError):
                self._motion.pipe.send(CALLED_OFF)
        else:
            self._motion.process.kill()  # it may be inside a call that takes seconds
        if self._recorder is not None:
            self._recorder.discard()
            self._recorder = None
        return Report("refused", f"{self._abort_cause} {moment}{'; nothing was moved' * self.job.moves}", 2)

    def _death(self) -> str:
        self._motion.process.join(0.5)
        code = self._motion.process.exitcode
        how = f"by signal {-code}" if code is not None and code < 0 else f"with code {code}"
        return f"the motion process ended {how}; the controller's watchdog stops the arm"

    def _kill(self, reason: str) -> Report:
        self._motion.process.kill()
        return Report("stopped", reason, 3)

    def _begin_closing(self, report: Report) -> None:
        self._report, self._closing_s = report, time.monotonic()
        self._motion.end()
        self._witness.end()
        if self._recorder is not None:
            stalls = [RecordedStall(begin_s=begin_s, end_s=end_s, processor=number) for begin_s, end_s, number in self._witness.stalls]
            self._recorder.finish({"verdict": report.verdict, "reason": report.reason, "trips": list(report.trips), "stalls": stalls})

    def _closed(self) -> Report | None:
        """The report when motion process and recorder have ended, else None."""
        assert self._report is not None
        now_s = time.monotonic()
        if self._motion.process.is_alive():
            if now_s < min(self._closing_s + CLOSING_S, self._end_by_s):
                return None
            self._motion.process.kill()
            self._motion.process.join()
        if self._recorder is not None and not self._recorder.answered and now_s < self._closing_s + FOOTER_S:
            return None
        return self._over(self._report)

    def _over(self, report: Report) -> Report:
        recording, notes = None, report.notes
        if self._recorder is not None:
            try:
                recording = self._recorder.close(timeout_s=0.0)
            except RecordingError as error:
                notes = (*notes, str(error))
                if self._lost_recorder:  # the abort in the trips was ours
                    report = replace(report, reason=f"the run was stopped because it was no longer recorded: {error}")
            answered = self.job.kind == "level_test" and self._came_to_rest  # what it found stands in the marker
            died = report.exit_code == 3 and not report.trips and not answered
            stands = self.job.kind in BEGIN_LOADED and self._state.latch() is not None  # the reason of the stop before stays
            if not stands and (died or any(Trip[trip["trip"]] not in UNLATCHED for trip in report.trips)):
                self._state.keep("latch", Latch(report.reason, now()))
        last_ticks = last_ticks_of(self._rows(LAST_TICKS)) if report.exit_code == 3 else ()
        if self._place is not None and report.verdict == "done":
            self._state.keep("place", replace(self._place, returned=True))
        if self._marked is not None and report.exit_code == 2:
            self._marked.undo()
        elif self._marked is not None:
            rows = self._rows(math.ceil(END_S * self.job.config.robot.rate_Hz) + 1)
            probe = self._marked.end(rows, self._level, self._came_to_rest)
            report = replace(report, probe=probe)
            if probe.state != ProbeState.FREE:
                notes = (*notes, probe.sentence)
        return replace(report, recording=recording, about=report.about or self._about, notes=notes, last_ticks=last_ticks)

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


def wait(run: JobRun, on_poll: Callable[[], None] | None = None, poll_s: float = 0.02) -> Report:
    """Poll a run until it is over. If `on_poll` fails, the run is aborted, and the error raised when the arm is at rest.

    Args:
        on_poll: Called after each poll that found the run still under way; None: no call.
        poll_s: Pause between two polls.

    Returns:
        How the run ended.

    Raises:
        PalpdError: `on_poll` raised it.
    """
    failure: PalpdError | None = None
    while True:
        report = run.poll()
        if report is not None:
            if failure is not None:
                raise failure
            return report
        if on_poll is not None:
            try:
                on_poll()
            except OSError:  # the terminal is gone: nobody can watch or interrupt the run any more
                run.interrupt("the end of the terminal")
                on_poll = None
            except PalpdError as error:
                run.ask(Request.ABORT)
                failure, on_poll = error, None
        time.sleep(poll_s)
