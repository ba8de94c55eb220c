"""`palpd serve`: waits disarmed, answers over the control socket, carries out one job at a time, and feeds the watchdog of systemd.

A job is a single run (`start`, `retract`), or a program whose worker asks for runs. What a worker computes, and whether it lives, changes
nothing here: aborts are served, and the service alone starts runs.
"""

import math
import os
import socket
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TypeVar, cast, get_args

import numpy as np
import structlog

from palpd.config import Config, Plan, parse_plan, refuse_unsafe
from palpd.control.plan_place import ANSWERS, Choice, PlanPlace, question
from palpd.control.probe_state import ProbeAnswer, ProbeState
from palpd.daemon.control_socket import ControlSocket, Later, Watching
from palpd.daemon.controls import LEASE_S, Controls
from palpd.daemon.devices import Build
from palpd.daemon.interrupts import held, received, shielded
from palpd.daemon.job_progress import JobMeter
from palpd.daemon.job_worker import RunRequest
from palpd.daemon.jobs import Jobs
from palpd.daemon.kept_plans import KeptPlans
from palpd.daemon.motion_job import STILL_KINDS, Job, Kind
from palpd.daemon.overshoot import refuse_overload
from palpd.daemon.programs import program_named
from palpd.daemon.run_reports import RunReports
from palpd.daemon.session import job as checked_job
from palpd.daemon.session import measured_job
from palpd.daemon.socket_client import CheckedCell, ControlAnswer, ControlRequest, KnownPlace, KnownProbe, LastRun
from palpd.daemon.stored_state import Latch, State, now
from palpd.daemon.supervisor import JobRun, Report, recording_name
from palpd.daemon.what_now import LOOKS, Action, Standing, what_now
from palpd.errors import BadInput, ConfigError, PalpdError, Refused
from palpd.recording.ring import LoopState, Ring
from palpd.tick import Phase, Request

POLL_S = 0.02
"""Longest wait for a request before the run is polled again."""
PAUSE_PATIENCE_S = 1.0
"""Longest wait for the arm to rest in a pause. The sequence takes it within a tick, but not before the tare is over."""
STATUS_S = 0.2
"""Shortest time between two statuses that watchers receive: what a person can follow."""
NEEDS_CONTROLS = (
    "check",
    "arm",
    "start",
    "pause",
    "resume",
    "retract",
    "level-test",
    "clear",
    "begin",
    "decide",
    "keep-plan",
    "forget-plan",
)
"""Requests of whoever holds the controls. Everyone may ask for the status and abort."""
STANDS_FOR: Mapping[str, Action] = {"calibrate": "calibrate", "doctor": "check", "recover": "recover"}
"""The button that a program has; the others have that of a start, since they move the arm."""
WATCHDOG_S = 0.5
"""Period of feeding the watchdog of systemd: a small part of WatchdogSec in the unit."""


Kept = TypeVar("Kept")


@dataclass(frozen=True, slots=True)
class PendingPause:
    """A pause or a resume whose effect was not seen yet. `ticks` is the number of ticks when it was asked for."""

    later: Later
    wish: Request
    ticks: int
    until_s: float


class Service:
    """States: disarmed, checking, armed, running. A restart, a stop, a fault and the end of a plan all lead to disarmed.

    Before it arms, the service checks the real devices: it reads them and commands nothing. It also checks them once at the start, for
    the log; if a device is absent, it keeps running.
    """

    def __init__(self, config: Config, build: Build) -> None:
        self._config, self._build = config, build
        self._state = State(config.paths.state)
        with shielded():
            self._ring: Ring = Ring.create(config.robot.rate_Hz)
        self._armed = False
        self._run: JobRun | None = None
        self._last: Report | None = None
        self._arming: Later | None = None
        self._looking: Later | None = None
        self._pausing: PendingPause | None = None
        self._pause_asked = False
        self._first_tick = 0
        self._meter: JobMeter | None = None
        self._cell: CheckedCell | None = None
        self._fault = ""
        self._probe: tuple[ProbeAnswer, str] | None = None
        self._pose: tuple[float, ...] = ()
        self._log = structlog.get_logger("palpd.service")
        self._reports = RunReports(config.paths.runs)
        self._ending = False
        self._unkept: Latch | None = None
        self._controls = Controls()
        self._jobs = Jobs(config)
        self._plans = KeptPlans(config.paths.state / "plans")
        self._published: tuple[float, ControlAnswer] = (0.0, {})

    def serve(self) -> None:
        """Serve until SIGTERM, SIGINT or SIGHUP. It aborts a running plan and closes the recording first."""
        with held(self._end):
            self._serve()

    def _serve(self) -> None:
        try:
            control = ControlSocket(self._config.paths.control_socket, self.answer)
        except BaseException:
            self._free_ring()
            raise
        latch = self._latch()
        self._log.info("ready", socket=str(self._config.paths.control_socket), latched=latch.reason if latch else None)
        _notify("READY=1")
        try:
            self._check()
        except PalpdError as error:
            self._log.warning("not checked", reason=str(error))
        fed_s, ticks = 0.0, -1
        try:
            while not self._ending or self._run is not None:
                control.poll(POLL_S)
                self._poll_run()
                self._poll_job()
                self._answer_pause()
                self._reports.poll(busy=self._run is not None or self._armed)
                self._publish(control)
                if time.monotonic() - fed_s > WATCHDOG_S:
                    idle = self._run is None or self._ring.state != LoopState.RUNNING
                    if idle or self._ring.published != ticks:  # fed only while ticks advance, so that systemd notices a loop that hangs
                        _notify(f"WATCHDOG=1\nSTATUS={self._word}")
                    fed_s, ticks = time.monotonic(), self._ring.published
        finally:
            _notify("STOPPING=1")
            self._jobs.close()
            self._reports.close()
            control.close()
            self._free_ring()

    @property
    def _word(self) -> str:
        if self._checking:
            return "checking"
        if self._jobs.current is not None:
            return "waiting" if self._jobs.current.proposal is not None else "running"
        return "armed" if self._armed else "disarmed"

    @property
    def _checking(self) -> bool:
        return self._run is not None and self._run.job.kind == "check"

    def answer(self, request: ControlRequest) -> ControlAnswer | Later | Watching | bytes:
        """Carry out one request of the control socket; refusals are sentences and change nothing."""
        commands: dict[str, Callable[[ControlRequest], ControlAnswer | Later | Watching | bytes]] = {
            "status": self._status,
            "check": self._look,
            "arm": self._arm,
            "start": self._start,
            "pause": lambda _: self._ask(Request.PAUSE),
            "resume": lambda _: self._ask(Request.RESUME),
            "abort": self._abort,
            "retract": lambda _: self._go_up("retract"),
            "level-test": lambda _: self._go_up("level_test"),
            "clear": self._clear,
            "begin": self._begin_job,
            "decide": self._decide,
            "cancel": self._cancel,
            "jobs": lambda _: {"jobs": [record.summary for record in self._jobs.all()]},
            "job": lambda request: self._jobs.known(request.get("id")).answer(),
            "plans": self._plans.answer,
            "keep-plan": self._change_plans,
            "forget-plan": self._change_plans,
            "watch": lambda request: Watching({"ok": True, "event": "status", **self._status(request)}),
            "take": self._take,
            "renew": self._renew,
            "release": self._release,
        }
        command = commands.get(request["do"])
        if command is None:
            return {"ok": False, "error": f"{request['do'][:32]!r} is no command; known: {', '.join(commands)}"}
        try:
            if request["do"] in NEEDS_CONTROLS:
                self._controls.require(request.get("lease"), time.monotonic())
            answer = command(request)
            return answer if isinstance(answer, Later | Watching | bytes) else {"ok": True, **answer}
        except PalpdError as error:
            return {"ok": False, "error": str(error)}

    def _status(self, _: ControlRequest) -> ControlAnswer:
        place, probe = _kept(self._state.place), self._known_probe()
        standing = self._standing(place)
        answer: ControlAnswer = {
            "state": self._word,
            "now": what_now(standing).published,
            "latched": standing.latch[1] if standing.latch else None,
            "pid": os.getpid(),
            "cell": self._cell,
            "probe": known_probe(*probe) if probe is not None else None,
            "place": self._place(place),
            "controls": self._controls.holder(time.monotonic()),
            "ring": self._ring.name,
            "active": self._jobs.current.summary if self._jobs.current is not None else None,
            "limits": {"contact_N": self._config.safety.contact_limit_N, "absolute_N": self._config.safety.absolute_limit_N},
        }
        if self._run is not None and not self._checking:
            answer.update(self._under_way(self._run.job))
            answer["recording"] = str(self._run.recording) if self._run.recording is not None else None
        if self._last is not None:
            answer["last"] = LastRun(
                verdict=self._last.verdict,
                reason=self._last.reason,
                recording=str(self._last.recording) if self._last.recording else None,
                notes=list(self._last.notes),
                last_ticks=list(self._last.last_ticks),
            )
        return answer

    def _under_way(self, job: Job) -> ControlAnswer:
        """Where the running job stands by its newest tick; without a tick only what it is."""
        row, progress = self._newest(), self._meter.read() if self._meter is not None else None
        if row is None or progress is None or self._meter is None:
            return {"job": job.kind, "activity": "opening robot and sensor"}
        return {
            "job": job.kind,
            "activity": progress.activity,
            "steps_done": progress.steps_done,
            "steps": self._meter.steps,
            "left_s": None if progress.left_s is None else float(round(progress.left_s)),
            "phase": Phase(int(row["phase"])).name.lower(),
            "site": int(row["site"]),
            "force_N": progress.force_N,
            "z_m": progress.z_m,
            "depth_m": _depth_m(row),
            "tick": int(row["index"]),
        }

    def _standing(self, place: PlanPlace | None) -> Standing:
        """Where everything stands, for `what_now`."""
        run, row, job = self._run.job if self._run is not None else None, self._newest(), self._jobs.current
        progress = self._meter.read() if self._meter is not None and run is not None and not self._checking else None
        latch, last, probe = self._latch(), self._last, self._known_probe()
        stopped = last is not None and last.verdict != "done" and last.exit_code != 2
        return Standing(
            armed=self._armed,
            arming=self._arming is not None,
            run=run.kind if run is not None else None,
            phase=Phase(int(row["phase"])) if row is not None and run is not None else None,
            site=progress.site if progress is not None else None,
            force_N=progress.force_N if progress is not None else 0.0,
            depth_m=_depth_m(row) if row is not None else None,
            job=job.id if job is not None else None,
            activity=job.activity if job is not None else "",
            proposal=job is not None and job.proposal is not None,
            pause_asked=self._pause_asked,
            pause_pending=self._pausing is not None,
            latch=(latch.date, latch.reason) if latch is not None else None,
            reference=_kept(self._state.calibration) is not None,
            unfinished=self._state.holds("contact"),
            probe=probe[0] if probe is not None else None,
            fault=self._fault,
            question=question(place, self._pose[0], self._pose[1], None) if self._pose else None,
            last=last.reason if stopped and last is not None else "",
        )

    def _refuse(self, action: Action) -> None:
        """Refuse what `what_now` finds impossible. What looks at the devices itself is judged without what was seen before."""
        standing = self._standing(_kept(self._state.place))
        obstacle = what_now(replace(standing, probe=None) if action in LOOKS else standing).obstacles.get(action)
        if obstacle is not None:
            raise Refused(obstacle.as_refusal)

    def _newest(self) -> np.void | None:
        """The newest tick of the running job; the ring also holds those of jobs before."""
        if self._ring.published <= self._first_tick:
            return None
        rows = self._ring.read(self._ring.published - 1)[0]
        return rows[-1] if len(rows) else None

    def _arm(self, _: ControlRequest) -> ControlAnswer | Later:
        self._refuse("arm")
        self._armed = False
        if self._run is None:
            self._check()
        self._arming = Later()
        return self._arming

    def _look(self, _: ControlRequest) -> Later:
        """Check the devices and the probe anew; it commands nothing."""
        self._refuse("check")
        self._armed = False
        self._check()
        self._looking = Later()
        return self._looking

    def _check(self) -> None:
        self._first_tick, self._meter = self._ring.published, None
        self._run = JobRun(self._job("check", Plan(), dry=True), self._build, self._ring, self._state, "check")

    def _checked(self, report: Report) -> None:
        ready = report.verdict == "done" and self._run is not None and self._run.job.reference is not None
        reason = report.reason or ("" if ready else "there is no reference tare; run palpd calibrate with the probe free and still")
        self._cell = {"ready": ready, "reason": reason, "date": now()}
        self._fault = reason if report.probe is None else ""
        self._log.info("checked", ready=ready, reason=reason, date=self._cell["date"], notes=report.notes)
        if self._looking is not None:
            self._looking.answer = {"ok": True, "state": "disarmed", "cell": self._cell}
            self._looking = None
        arming, self._arming = self._arming, None
        if arming is None:
            return
        if not ready:
            arming.answer = {"ok": False, "error": f"not armed: {reason}"}
        elif arming.abandoned:
            self._log.info("not armed: the client has gone")
        else:
            self._armed = True
            arming.answer = {"ok": True, "state": "armed"}
            self._log.info("armed")

    def _job(self, kind: Kind, plan: Plan, dry: bool = False) -> Job:
        return measured_job(kind, self._config, plan, dry)

    def _start(self, request: ControlRequest) -> ControlAnswer:
        self._refuse("start")
        plan = self._plan_of(request)
        choice = request.get("place")
        if choice is not None and choice not in get_args(Choice):
            raise BadInput(f"the place is {str(choice)[:32]!r}, expected one of {', '.join(get_args(Choice))}")
        work = measured_job("palpation", self._config, plan, choice=cast(Choice | None, choice))
        if self._pose and plan.origin is None and (asked := question(work.last, self._pose[0], self._pose[1], work.choice)) is not None:
            raise Refused(f"nothing was moved: {asked}; {ANSWERS}")
        self._start_run(work, recording_name("palpation"))
        self._jobs.begin_run("run", self._asking)
        self._log.info("started", sites=len(plan.sites))
        return {"state": "running"}

    def _go_up(self, kind: Kind) -> ControlAnswer:
        """Leave the tissue, or test whether the probe is free. It needs no arming and no cleared latch: it goes straight up, guarded."""
        self._refuse("retract" if kind == "retract" else "level-test")
        self._start_run(self._job(kind, Plan()), recording_name(kind))
        job_id = self._jobs.begin_run(kind.replace("_", "-"), self._asking)
        self._log.info("going up", job=kind)
        return {"state": "running", "id": job_id}

    def _start_run(self, work: Job, name: str) -> None:
        self._first_tick, self._armed, self._pause_asked = self._ring.published, False, False
        self._meter = JobMeter(work, self._ring)
        self._run = JobRun(work, self._build, self._ring, self._state, name)

    def _plan_of(self, request: ControlRequest) -> Plan:
        """The plan of a request, within the limits of this cell. Raises ConfigError."""
        plan = parse_plan(request.get("plan"), "the plan")
        refuse_unsafe(self._config, plan)
        refuse_overload(self._config, plan)
        return plan

    def _change_plans(self, request: ControlRequest) -> ControlAnswer:
        """Keep or forget a plan. A run comes first: a slow disk must not delay its abort."""
        if self._word in ("checking", "running", "waiting"):
            raise Refused("the arm is at work, and a slow disk must not delay an abort; keep and forget plans when it is over")
        if request["do"] == "forget-plan":
            return self._plans.forget(request)
        return self._plans.keep(request, self._plan_of(request), self._asking)

    # --- jobs with a program ------------------------------------------------------------------------------------------------

    def _begin_job(self, request: ControlRequest) -> ControlAnswer:
        """Start the worker of a program. Where the program moves the arm, this spends the arming, for all runs that it announces."""
        program = program_named(request.get("program"))
        self._refuse(STANDS_FOR.get(program.name, "start"))
        record = self._jobs.begin(program, request.get("arguments", {}), self._asking)
        self._armed = False
        return {"state": "running", "id": record.id, "most_runs": record.most_runs}

    def _poll_job(self) -> None:
        """Read one message of the worker, and start the run that it asks for."""
        asked = self._jobs.hear()
        if asked is None:
            return
        try:
            self._run_for_job(asked)
        except PalpdError as error:
            self._jobs.report(Report("refused", str(error), 2))

    def _run_for_job(self, asked: RunRequest) -> None:
        if self._ending or self._jobs.current is None or self._jobs.current.aborted:
            raise Refused("the job was aborted" + ("" if asked.kind in STILL_KINDS else "; nothing more was moved"))
        latch = self._latch()
        if latch is not None and asked.kind not in STILL_KINDS:
            raise Refused(f"a run was stopped on {latch.date}: {latch.reason}; nothing more was moved")
        config = self._config.with_runs(asked.recording.parent) if asked.recording is not None else self._config
        work = replace(checked_job(asked.kind, config, asked.plan, take_reference=asked.take_reference), watch_s=asked.watch_s)
        self._jobs.note_run()
        self._start_run(work, asked.recording.stem if asked.recording is not None else recording_name(asked.kind))

    def _decide(self, request: ControlRequest) -> ControlAnswer:
        self._jobs.decide(request.get("id"), request.get("number"), request.get("agree"))
        return {"state": self._word}

    def _cancel(self, request: ControlRequest) -> ControlAnswer:
        """An abort that cannot hit a later job."""
        self._jobs.running(request.get("id"))
        return self._abort(request)

    # --- who holds the controls ----------------------------------------------------------------------------------------------

    @property
    def _asking(self) -> str:
        """Who asks for something that needs the controls, for people."""
        return self._controls.holder(time.monotonic()) or "a client without the controls"

    def _take(self, request: ControlRequest) -> ControlAnswer:
        token, loser = self._controls.take(request.get("name"), request.get("force") is True, time.monotonic())
        self._log.info("controls taken", by=self._asking, by_force_from=loser)
        return {"lease": token, "lease_s": LEASE_S}

    def _renew(self, request: ControlRequest) -> ControlAnswer:
        self._controls.require(request.get("lease", ""), time.monotonic())
        return {"lease_s": LEASE_S}

    def _release(self, request: ControlRequest) -> ControlAnswer:
        holder = self._asking
        self._controls.release(request.get("lease", ""), time.monotonic())
        self._log.info("controls released", by=holder)
        return {"controls": None}

    def _publish(self, control: ControlSocket) -> None:
        """Send watchers what happened, and the status where it has changed."""
        for event in self._jobs.take_events():
            control.publish(event)
        sent_s, before = self._published
        if not control.watched or time.monotonic() - sent_s < STATUS_S:
            return
        status = self._status({"do": "status"})
        if status != before:
            control.publish({"event": "status", **status})
        self._published = time.monotonic(), status

    # --- a run under way ----------------------------------------------------------------------------------------------------

    def _ask(self, wish: Request) -> Later:
        self._refuse("pause" if wish == Request.PAUSE else "resume")
        assert self._run is not None
        self._run.ask(wish)
        self._pause_asked = wish == Request.PAUSE
        self._pausing = PendingPause(Later(), wish, self._ring.published, time.monotonic() + PAUSE_PATIENCE_S)
        return self._pausing.later

    def _answer_pause(self) -> None:
        """Answer a pause or a resume as soon as a tick shows it, or the run has ended. Where the arm leaves the tissue first, say so."""
        if self._pausing is None:
            return
        pending, row = self._pausing, self._newest()
        phase = Phase(int(row["phase"])) if row is not None else Phase.TARE
        pausing = pending.wish == Request.PAUSE
        seen = phase == Phase.PAUSED if pausing else phase not in (Phase.PAUSED, Phase.PAUSE_RETRACT)
        if self._run is None:
            pending.later.answer = {"ok": False, "error": "the run ended meanwhile; see palpd status"}
        elif self._ring.published > pending.ticks and seen and row is not None:
            pending.later.answer = {"ok": True, "state": "paused" if pausing else "running", **self._under_way(self._run.job)}
        elif time.monotonic() > pending.until_s and phase != Phase.TARE:
            pending.later.answer = {"ok": True, "state": "pausing" if pausing else "resuming", **self._under_way(self._run.job)}
        elif time.monotonic() > pending.until_s:
            done = "paused" if pausing else "resumed"
            reason = f"the run was not {done} within {PAUSE_PATIENCE_S:g} s: it still opens its devices or tares; try again"
            pending.later.answer = {"ok": False, "error": reason}
        if pending.later.answer is not None:
            self._pausing = None

    def _abort(self, _: ControlRequest) -> ControlAnswer:
        self._armed = False
        arming, self._arming = self._arming, None
        if arming is not None:
            arming.answer = {"ok": False, "error": "not armed: a client asked for an abort meanwhile"}
        if self._run is not None:
            self._run.ask(Request.ABORT)
        self._jobs.abort()
        return {"state": "aborting" if self._run else "disarmed"}

    def _clear(self, _: ControlRequest) -> ControlAnswer:
        self._refuse("clear")
        self._unkept = None
        self._state.clear_latch()
        self._log.info("cleared")
        return {"state": "disarmed"}

    def _known_probe(self) -> tuple[ProbeAnswer, str] | None:
        """The last answer about the probe with its date; what the state folder says, where this service has not looked yet."""
        if self._probe is not None:
            return self._probe
        try:
            marker = self._state.marker()
        except ConfigError as error:
            return ProbeAnswer(ProbeState.UNKNOWN, (str(error),), frozenset()), now()
        if marker is None:
            return None
        return ProbeAnswer(ProbeState.UNKNOWN, (f"the {marker.run} of {marker.date} is unfinished",), frozenset(("retract",))), marker.date

    def _place(self, last: PlanPlace | None) -> KnownPlace | None:
        """Where the tip was last seen, over which site of the last plan, and where its sites count from."""
        if not self._pose and last is None:
            return None
        x_m, y_m = self._pose[:2] if self._pose else (None, None)
        return KnownPlace(
            x_m=x_m,
            y_m=y_m,
            site=last.site_under(x_m, y_m) if last is not None and x_m is not None and y_m is not None else None,
            origin_m=list(last.origin_m) if last is not None else None,
            unfinished=last.run if last is not None and not last.returned else None,
        )

    def _latch(self) -> Latch | None:
        return self._unkept or self._state.latch()

    def _poll_run(self) -> None:
        if self._run is None:
            return
        if self._ending:
            self._run.interrupt(received())
        try:
            report = self._run.poll()
        except PalpdError as error:  # the latch could not be written: it holds until this process ends
            report, self._unkept = Report("stopped", str(error), 3), Latch(str(error), now())
        if report is not None and (row := self._newest()) is not None:
            self._pose = tuple(map(float, row["tcp_pose"]))
        if report is not None and report.probe is not None:
            self._probe = report.probe, now()
        if report is not None and self._checking:
            self._checked(report)
            self._run = None
        elif report is not None:
            self._run, self._last, self._cell, self._fault = None, report, None, ""
            if report.recording is not None and self._config.paths.write_reports:
                self._reports.add(report.recording)
            self._log.info("ended", verdict=report.verdict, reason=report.reason, recording=str(report.recording), notes=report.notes)
            self._jobs.report(report)

    def _free_ring(self) -> None:
        self._ring.unlink()
        self._ring.close()

    def _end(self) -> None:
        self._ending = True


def known_probe(answer: ProbeAnswer, date: str) -> KnownProbe:
    """Write an answer about the probe as the status holds it.

    Args:
        answer: What is known of the probe.
        date: When it was given, ISO 8601.

    Returns:
        The entry `probe` of the status.
    """
    return KnownProbe(state=answer.state.value, reasons=list(answer.reasons), ways=sorted(answer.ways), date=date, advice=answer.advice)


def _depth_m(row: np.void) -> float | None:
    """Depth of the tip below the surface; None where that is not known."""
    depth_m = float(row["surface_z_m"] - row["tcp_pose"][2])
    return depth_m if math.isfinite(depth_m) else None


def _kept(read: Callable[[], Kept]) -> Kept | None:
    """What a file of the state folder holds; None where it is damaged: whoever needs it then says so, and the status goes on."""
    try:
        return read()
    except ConfigError:
        return None


def _notify(message: str) -> None:
    """sd_notify(3): send one datagram to the socket that systemd names, if there is one."""
    address = os.environ.get("NOTIFY_SOCKET")
    if address:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notifier:
            notifier.connect("\0" + address[1:] if address.startswith("@") else address)
            notifier.sendall(message.encode())
