"""The main process: small, without ur_rtde. It owns the ring, starts motion process and recorder, sees them die, and keeps the reason.

It never resumes a motion: whatever ended a run, the next one begins with an operator's start and a fresh motion process.
"""

import contextlib
import datetime
import math
import multiprocessing
import time
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from palpd import motion
from palpd.errors import PalpdError, RecordingError
from palpd.inertial import read_card
from palpd.motion import Build, Job
from palpd.recorder import Recorder
from palpd.ring import LoopState, RecorderState, Ring
from palpd.state import Latch, State
from palpd.tick import Request, Trip

STALLED_S = 2.0
"""A loop whose tick counter stands still for this long is killed; the controller's watchdog has stopped the arm long before."""
OPENING_S = 40.0
CLOSING_S = 10.0
UNLATCHED = {Trip.NONE, Trip.CONTACT_FORCE, Trip.OPERATOR}


@dataclass(frozen=True, slots=True)
class Report:
    """How a run ended, for the operator and the exit code."""

    verdict: str
    reason: str = ""
    exit_code: int = 0
    trips: tuple[dict[str, Any], ...] = ()
    recording: Path | None = None
    about: dict[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    reference: tuple[float, ...] | None = None


class MotionProcess:
    """A spawned motion process and the pipes to it; it dies when this object's process does."""

    def __init__(self, build: Build, ring: Ring) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, far = context.Pipe()
        far_life, self._life = context.Pipe(duplex=False)
        self.process = context.Process(target=motion.serve, args=(build, ring.name, far, far_life), name="palpd-motion")
        self.process.start()
        far.close()
        far_life.close()

    def end(self) -> None:
        """Ask it to end, then make it."""
        with contextlib.suppress(OSError):
            self.pipe.send(None)
        self.process.join(2.0)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()


class Run:
    """One job under way. `poll` moves it on without waiting and returns a report when it is over."""

    def __init__(self, job: Job, build: Build, ring: Ring, state: State, name: str) -> None:
        self.job, self._ring, self._state, self._name = job, ring, state, name
        self._recorder: Recorder | None = None
        self._about: dict[str, Any] = {}
        self._lost_recorder = False
        self._ended_s = math.inf
        self._began_s = time.monotonic()
        self._ticks, self._ticked_s = ring.published, self._began_s
        ring.state = LoopState.STARTING
        ring.forget_requests()  # what was asked of an earlier run is void; from here on every abort counts
        self._motion = MotionProcess(build, ring)
        self._motion.pipe.send(job)

    def ask(self, request: Request) -> None:
        """Pass an operator's wish to the loop."""
        self._ring.ask(request)

    @property
    def opened(self) -> bool:
        """Whether the devices answered and the loop was started."""
        return self._recorder is not None

    def poll(self) -> Report | None:
        """A report when the job is over, else None."""
        pipe: Connection = self._motion.pipe
        try:
            if pipe.poll():
                return self._answered(pipe.recv())
        except (EOFError, OSError):
            return self._over(Report("stopped", self._death(), 3))
        if not self._motion.process.is_alive():
            return self._over(Report("stopped", self._death(), 3))
        now_s = time.monotonic()
        if self._ring.published != self._ticks:
            self._ticks, self._ticked_s = self._ring.published, now_s
        failed = self._ring.recorder_state == RecorderState.FAILED
        if self._recorder is not None and (failed or not self._recorder.alive) and not self._lost_recorder:
            self._lost_recorder = True
            self.ask(Request.ABORT)  # a palpation that is not recorded is worth nothing
        ticking = self._ring.state == LoopState.RUNNING
        if ticking and now_s - self._ticked_s > STALLED_S:
            return self._kill(f"the loop stood still for {STALLED_S:g} s and was killed; the controller's watchdog stops the arm")
        if self._ring.state != LoopState.ENDED:
            self._ended_s = now_s
        elif now_s - self._ended_s > CLOSING_S:
            return self._kill(f"the devices were not closed within {CLOSING_S:g} s after the last tick; the motion process was killed")
        if not self.opened and now_s - self._began_s > OPENING_S:
            return self._kill(f"the devices were not opened within {OPENING_S:g} s; is the controller's program able to start?")
        return None

    def _answered(self, answer: dict[str, Any]) -> Report | None:
        if "opened" in answer:
            self._about = answer["opened"]
            header = header_of(self.job, self._about, answer["reference"])
            model = self.job.config.model.path if self.job.kind == "palpation" else None
            folder = self.job.config.paths.runs
            try:
                folder.mkdir(parents=True, exist_ok=True)
                self._recorder = Recorder.start(self._ring, folder / f"{self._name}.mcap", header, model.read_bytes() if model else None)
            except (RecordingError, OSError) as error:
                self._motion.pipe.send("called off")
                return self._over(Report("refused", f"nothing was moved: {error}", 2))
            self._motion.pipe.send("go")
            self._ticked_s = time.monotonic()
            return None
        if "error" in answer:
            code = answer["exit_code"]
            return self._over(Report("refused" if code == 2 else "stopped", answer["error"], code))
        if "outcome" not in answer:
            return self._over(Report("done", about=answer["about"], reference=tuple(answer["reference"])))
        return self._over(_report(answer))

    def _death(self) -> str:
        self._motion.process.join(0.5)
        code = self._motion.process.exitcode
        how = f"by signal {-code}" if code is not None and code < 0 else f"with code {code}"
        return f"the motion process ended {how}; the controller's watchdog stops the arm"

    def _kill(self, reason: str) -> Report:
        self._motion.process.kill()
        return self._over(Report("stopped", reason, 3))

    def _over(self, report: Report) -> Report:
        self._motion.end()
        recording, notes = None, report.notes
        if self._recorder is not None:
            try:
                recording = self._recorder.close({"verdict": report.verdict, "reason": report.reason, "trips": list(report.trips)})
            except RecordingError as error:
                notes = (*notes, str(error))
                if self._lost_recorder:  # the abort in the trips was ours
                    report = replace(report, reason=f"the run was stopped because it was no longer recorded: {error}")
            died = report.exit_code == 3 and not report.trips
            if died or any(Trip[trip["trip"]] not in UNLATCHED for trip in report.trips):
                self._state.keep("latch", Latch(report.reason, now()))
        return Report(
            report.verdict,
            report.reason,
            report.exit_code,
            report.trips,
            recording,
            report.about or self._about,
            notes,
            report.reference,
        )


def _report(answer: dict[str, Any]) -> Report:
    outcome = answer["outcome"]
    code = 0 if outcome["verdict"] == "done" else 2 if outcome["refused"] else 3
    return Report(outcome["verdict"], outcome["reason"], code, tuple(answer["trips"]), notes=tuple(answer["notes"]))


def header_of(job: Job, about: dict[str, Any], reference: list[float]) -> dict[str, Any]:
    """What a recording must hold for its decisions to be made again: body, limits, plan, tare, model; and where it came from."""
    body = motion.body_of(job, about["delay_s"])
    return {
        "kind": job.kind,
        "dry": job.dry,
        "config": job.config.model_dump(mode="json"),
        "plan": job.plan.model_dump(mode="json"),
        "sites": [site.model_dump() for site in job.plan.sites],
        "reference": reference,
        "machine_stiffness_N_per_m": job.machine_stiffness_N_per_m,
        "body": {
            "tip_radius_m": body.tip_radius_m,
            "poisson_ratio": job.config.cell.tissue.poisson_ratio if job.config.cell.tissue else 0.5,
            "delay_s": body.delay_s,
            "machine_stiffness_N_per_m": job.machine_stiffness_N_per_m,
        },
        "about": about,
        "epoch_offset_s": about["epoch_offset_s"],
        "model_card": _card(job),
        "versions": {name: version(name) for name in ("palpd", "numpy", "ur-rtde", "onnxruntime")},
        "started": now(),
    }


def _card(job: Job) -> dict[str, Any] | None:
    path = job.config.model.path
    return read_card(path) if path and job.kind == "palpation" else None


def now() -> str:
    """Date and time with zone."""
    return datetime.datetime.now().astimezone().isoformat(timespec="seconds")


def recording_name(kind: str) -> str:
    """A name that sorts by time."""
    return f"{datetime.datetime.now():%Y%m%d-%H%M%S}-{kind.replace('_', '-')}"


def wait(run: Run, on_poll: Any = None, poll_s: float = 0.02) -> Report:
    """Poll a run until it is over; Ctrl-C or a termination asks the loop for an abort and goes on waiting for its stop."""
    while True:
        try:
            report = run.poll()
            if report is not None:
                return report
            if on_poll is not None:
                on_poll(run)
            time.sleep(poll_s)
        except KeyboardInterrupt:
            run.ask(Request.ABORT)
        except PalpdError:
            run.ask(Request.ABORT)
            raise
