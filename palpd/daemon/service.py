"""`palpd serve`: waits disarmed, answers over the control socket, carries out one job at a time, and feeds the watchdog of systemd.

A job is a single run (`start`, `retract`), or a program whose worker asks for runs. What a worker computes, and whether it lives, changes
nothing here: aborts are served, and the service alone starts runs.
"""

import os
import socket
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Literal, cast, get_args

import numpy as np
import structlog

from palpd.config import Config, Plan, parse_plan
from palpd.control.plan_place import ANSWERS, Choice, question, way_back
from palpd.daemon.arming import Arming
from palpd.daemon.control_socket import ControlSocket, Later, Watching
from palpd.daemon.controller_watch import ControllerWatch
from palpd.daemon.controls import Controls
from palpd.daemon.devices import Build, OpenController
from palpd.daemon.interrupts import held, received, shielded
from palpd.daemon.jobs import Jobs
from palpd.daemon.kept_plans import KeptPlans
from palpd.daemon.known_cell import KnownCell, known_probe
from palpd.daemon.motion_job import STILL_KINDS, Job
from palpd.daemon.overshoot import refuse_together
from palpd.daemon.pausing import Pausing
from palpd.daemon.programs import program_named
from palpd.daemon.robot_stops import ROBOT_STOPS, ControllerSeen, stop_of
from palpd.daemon.run_reports import RunReports
from palpd.daemon.run_under_way import RunUnderWay, depth_m
from palpd.daemon.session import job as checked_job
from palpd.daemon.session import measured_job
from palpd.daemon.socket_client import ControlAnswer, ControlRequest
from palpd.daemon.stored_state import State
from palpd.daemon.supervisor import Report, recording_name
from palpd.daemon.what_now import LOOKS, Action, Standing, what_now
from palpd.errors import BadInput, PalpdError, Refused
from palpd.recording.ring import LoopState, Ring
from palpd.tick import Phase, Request, Trip

POLL_S = 0.02
"""Longest wait for a request before the run is polled again."""
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
STANDS_FOR: Mapping[str, Action] = {"calibrate": "calibrate", "doctor": "check", "baseline": "check", "recover": "recover"}
"""The button that a program has; the others have that of a start, since they move the arm."""
ROBOT_TRIPS = {
    each.name for each in (Trip.ROBOT_STALE, Trip.ROBOT_MODE, Trip.SAFETY_MODE, Trip.PROGRAM_STOPPED, Trip.CONNECTION, Trip.DEVICE)
}
"""Trips after which the controller may have something to say."""
WATCHDOG_S = 0.5
"""Period of feeding the watchdog of systemd: a small part of WatchdogSec in the unit."""


class Service:
    """States: disarmed, checking, armed, running. A restart, a stop, a fault and the end of a plan all lead to disarmed.

    Before it arms, the service checks the real devices: it reads them and commands nothing. It also checks them once at the start, for
    the log; if a device is absent, it keeps running.

    After a stop of the robot it reads what the controller says, with `open_controller`; without that it reads nothing. It commands nothing
    either: an operator does the steps at the pendant. When they are done, it looks at robot and sensor again where it must.
    """

    def __init__(self, config: Config, build: Build, open_controller: OpenController | None = None) -> None:
        self._config = config
        self._state = State(config.paths.state)
        with shielded():
            self._ring: Ring = Ring.create(config.robot.rate_Hz)
        self._run = RunUnderWay(build, self._ring, self._state)
        self._arming, self._pausing, self._jobs = Arming(), Pausing(), Jobs(config)
        self._known = KnownCell(self._state)
        self._watch = ControllerWatch(config, open_controller) if open_controller is not None else None
        self._seen: ControllerSeen | None = None
        self._controls = Controls()
        self._plans = KeptPlans(config.paths.state / "plans")
        self._reports = RunReports(config.paths.runs)
        self._log = structlog.get_logger("palpd.service")
        self._ending = threading.Event()
        self._published: tuple[float, ControlAnswer] = (0.0, {})

    def serve(self) -> None:
        """Serve until SIGTERM, SIGINT or SIGHUP. It aborts a running plan and closes the recording first."""
        with held(self._ending.set):
            try:
                control = ControlSocket(self._config.paths.control_socket, self.answer)
            except BaseException:
                self._ring.close()
                raise
            latch = self._known.latch
            self._log.info("ready", socket=str(self._config.paths.control_socket), latched=latch.reason if latch else None)
            _notify("READY=1")
            self._check()
            fed_s, ticks = 0.0, -1
            try:
                while not self._ending.is_set() or self._run.current is not None:
                    control.poll(POLL_S)
                    self._poll_run()
                    self._poll_job()
                    self._poll_controller()
                    self._pausing.poll(self._run)
                    self._reports.poll(busy=self._run.current is not None or self._arming.armed)
                    self._publish(control)
                    if time.monotonic() - fed_s > WATCHDOG_S:
                        idle = self._run.current is None or self._ring.state != LoopState.RUNNING
                        if idle or self._run.ticks != ticks:  # so that systemd notices a loop that hangs
                            _notify(f"WATCHDOG=1\nSTATUS={self._word}")
                        fed_s, ticks = time.monotonic(), self._run.ticks
            finally:
                _notify("STOPPING=1")
                self._jobs.close()
                for event in self._jobs.take_events():
                    control.publish(event)
                self._reports.close()
                if self._watch is not None:
                    self._watch.end()
                control.close()
                self._ring.close()

    @property
    def _word(self) -> str:
        if self._run.checking:
            return "checking"
        if self._jobs.current is not None:
            return self._jobs.current.state
        return "armed" if self._arming.armed else "disarmed"

    def answer(self, request: ControlRequest) -> ControlAnswer | Later | Watching | bytes:
        """Carry out one request of the control socket; refusals are sentences and change nothing."""
        commands: dict[str, Callable[[ControlRequest], ControlAnswer | Later | Watching | bytes]] = {
            "status": self._status,
            "check": self._look,
            "arm": self._look,
            "start": self._start,
            "pause": lambda _: self._pause(Request.PAUSE),
            "resume": lambda _: self._pause(Request.RESUME),
            "abort": self._abort,
            "retract": lambda _: self._go_up("retract"),
            "level-test": lambda _: self._go_up("level_test"),
            "clear": self._clear,
            "begin": self._begin_job,
            "decide": self._jobs.decide,
            "cancel": self._abort,
            "jobs": lambda _: {"jobs": [record.summary for record in self._jobs.all()]},
            "job": lambda request: self._jobs.known(request.get("id")).answer(),
            "plans": self._plans.answer,
            "keep-plan": self._change_plans,
            "forget-plan": self._change_plans,
            "watch": lambda request: Watching({"ok": True, "event": "status", **self._status(request)}),
            "take": self._controls.answer,
            "renew": self._controls.answer,
            "release": self._controls.answer,
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
        standing, probe, run = self._standing, self._known.probe, self._run
        answer: ControlAnswer = {
            "state": self._word,
            "now": what_now(standing).published,
            "latched": standing.latch[1] if standing.latch else None,
            "pid": os.getpid(),
            "cell": self._arming.cell,
            "probe": known_probe(*probe) if probe is not None else None,
            "place": self._known.place,
            "protective": self._known.protective,
            "controls": self._controls.holder(time.monotonic()),
            "ring": self._ring.name,
            "active": self._jobs.current.summary if self._jobs.current is not None else None,
            "limits": {"contact_N": self._config.safety.contact_limit_N, "absolute_N": self._config.safety.absolute_limit_N},
        }
        if run.current is not None and not run.checking:
            answer.update(run.answer())
            answer["recording"] = str(run.current.recording) if run.current.recording is not None else None
        if self._known.last is not None:
            answer["last"] = self._known.last.summary
        return answer

    @property
    def _standing(self) -> Standing:
        """Where everything stands, for `what_now`."""
        run, row, job = self._run, self._run.newest(), self._jobs.current
        progress, latch, last, probe = run.progress, self._known.latch, self._known.last, self._known.probe
        stopped = last is not None and last.verdict != "done" and last.exit_code != 2
        return Standing(
            armed=self._arming.armed,
            arming=self._arming.waits,
            run=run.kind,
            phase=Phase(int(row["phase"])) if row is not None and run.current is not None else None,
            site=progress.site if progress is not None else None,
            force_N=progress.force_N if progress is not None else 0.0,
            depth_m=depth_m(row),
            job=job.id if job is not None else None,
            activity=job.activity if job is not None else "",
            proposal=job is not None and job.proposal is not None,
            pause_asked=self._pausing.asked,
            pause_pending=self._pausing.pending,
            latch=(latch.date, latch.reason) if latch is not None else None,
            reference=self._known.tared,
            unfinished=self._known.unfinished,
            probe=probe[0] if probe is not None else None,
            fault=self._arming.fault,
            question=self._known.question,
            last=last.reason if stopped and last is not None else "",
            stop=self._watch.stop if self._watch is not None else None,
            stop_reason=self._seen.reason if self._seen is not None else "",
            cause=self._known.protective_stops.cause_asked,
        )

    def _refuse(self, action: Action) -> None:
        """Refuse what `what_now` finds impossible. What looks at the devices itself is judged without what was seen before."""
        standing = self._standing
        obstacle = what_now(replace(standing, probe=None) if action in LOOKS else standing).obstacles.get(action)
        if obstacle is not None:
            raise Refused(obstacle.as_refusal)

    def _look(self, request: ControlRequest) -> Later:
        """Check the devices and the probe anew, and arm if that was asked for and they are ready. It commands nothing."""
        arm = request["do"] == "arm"
        self._refuse("arm" if arm else "check")
        self._arming.armed = False
        if self._run.current is None:  # a check that is under way serves an arm too
            self._begin_run(measured_job("check", self._config, Plan(), dry=True), "check")
        return self._arming.wait(arm)

    def _check(self) -> None:
        """Look at robot and sensor without being asked; a state folder that is damaged prevents it, and is said in the log."""
        try:
            self._begin_run(measured_job("check", self._config, Plan(), dry=True), "check")
        except PalpdError as error:
            self._log.warning("not checked", reason=str(error))

    def _start(self, request: ControlRequest) -> ControlAnswer:
        self._refuse("start")
        plan = _plan_of(request, self._config)
        choice = request.get("place")
        if choice is not None and choice not in get_args(Choice):
            raise BadInput(f"the place is {str(choice)[:32]!r}, expected one of {', '.join(get_args(Choice))}")
        work, pose = measured_job("palpation", self._config, plan, choice=cast(Choice | None, choice)), self._known.pose
        if pose and plan.origin is None and (asked := question(work.last, pose[0], pose[1], work.choice)) is not None:
            raise Refused(f"nothing was moved: {asked}; {ANSWERS}")
        self._begin_run(work, recording_name("palpation"))
        self._jobs.begin_run("run", self._controls.asking(time.monotonic()))
        self._log.info("started", sites=len(plan.sites))
        if pose and work.last is not None and work.back_to_m is not None:
            return {"state": "running", "way_back": way_back(work.last, pose[0], pose[1])[1]}
        return {"state": "running"}

    def _go_up(self, kind: Literal["retract", "level_test"]) -> ControlAnswer:
        """Leave the tissue, or test whether the probe is free. It needs no arming and no cleared latch: it goes straight up, guarded."""
        self._refuse("retract" if kind == "retract" else "level-test")
        self._begin_run(measured_job(kind, self._config, Plan()), recording_name(kind))
        job_id = self._jobs.begin_run(kind.replace("_", "-"), self._controls.asking(time.monotonic()))
        self._log.info("going up", job=kind)
        return {"state": "running", "id": job_id}

    def _begin_run(self, work: Job, name: str) -> None:
        """Start a run or a check: it spends the arming."""
        self._arming.armed = self._pausing.asked = False
        if self._watch is not None and work.moves:  # the run reads the controller itself
            self._watch.end()
        self._run.begin(work, name)

    def _change_plans(self, request: ControlRequest) -> ControlAnswer:
        """Keep or forget a plan. A run comes first: a slow disk must not delay its abort."""
        if self._word in ("checking", "running", "waiting"):
            raise Refused("the arm is at work, and a slow disk must not delay an abort; keep and forget plans when it is over")
        if request["do"] == "forget-plan":
            return self._plans.forget(request)
        return self._plans.keep(request, _plan_of(request, self._config), self._controls.asking(time.monotonic()))

    def _begin_job(self, request: ControlRequest) -> ControlAnswer:
        """Start the worker of a program. Where the program moves the arm, this spends the arming, for all runs that it announces."""
        program = program_named(request.get("program"))
        self._refuse(STANDS_FOR.get(program.name, "start"))
        record = self._jobs.begin(program, request.get("arguments", {}), self._controls.asking(time.monotonic()))
        self._arming.armed = False
        return {"state": "running", "id": record.id, "most_runs": record.most_runs}

    def _poll_job(self) -> None:
        """Read one message of the worker, and start the run that it asks for."""
        asked = self._jobs.hear()
        if asked is None:
            return
        try:
            if self._ending.is_set() or self._jobs.current is None or self._jobs.current.aborted:
                raise Refused("the job was aborted" + ("" if asked.kind in STILL_KINDS else "; nothing more was moved"))
            latch = self._known.latch
            if latch is not None and asked.kind not in STILL_KINDS:
                raise Refused(f"a run was stopped on {latch.date}: {latch.reason}; nothing more was moved")
            config = self._config.with_runs(asked.recording.parent) if asked.recording is not None else self._config
            choice: Choice | None = "here" if asked.here else None
            work = checked_job(asked.kind, config, asked.plan, take_reference=asked.take_reference, choice=choice)
            work = replace(work, watch_s=asked.watch_s)
            self._jobs.note_run()
            self._begin_run(work, asked.recording.stem if asked.recording is not None else recording_name(asked.kind))
        except PalpdError as error:
            self._jobs.report(Report("refused", str(error), 2))

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

    def _pause(self, wish: Literal[Request.PAUSE, Request.RESUME]) -> Later:
        self._refuse("pause" if wish == Request.PAUSE else "resume")
        assert self._run.current is not None
        self._run.current.ask(wish)
        return self._pausing.begin(wish, self._run.ticks)

    def _abort(self, request: ControlRequest) -> ControlAnswer:
        """Abort whatever goes on; a `cancel` names its job, so it cannot hit a later one."""
        if request["do"] == "cancel":
            self._jobs.running(request.get("id"))
        self._arming.abort()
        if self._run.current is not None:
            self._run.current.ask(Request.ABORT)
        self._jobs.abort()
        return {"state": "aborting" if self._run.current is not None else "disarmed"}

    def _clear(self, request: ControlRequest) -> ControlAnswer:
        """Clear the latch: the operator's word that the cell was looked at. The cause of a protective stop is written down with it."""
        self._refuse("clear")
        cause, by = request.get("cause"), self._controls.asking(time.monotonic())
        self._known.clear(cause, by)
        if cause is not None:
            self._log.info("cause of a protective stop written", cause=cause, by=by)
        self._log.info("cleared")
        return {"state": "disarmed"}

    def _poll_controller(self) -> None:
        """Take in what the controller says after a stop. When the arm may move again, look at the devices where that is sensible next."""
        if self._watch is None:
            return
        self._watch.poll()
        seen, before = self._watch.seen, self._seen
        if seen == before:
            return
        self._seen, stop = seen, self._watch.stop
        if seen is None:
            return
        self._arming.armed &= stop is None
        try:
            if self._known.see_controller(seen):
                self._log.warning("protective stop", cause_asked=self._known.protective_stops.cause_asked)
        except PalpdError as error:  # it could not be written, so a cause may never be asked for
            self._known.hold(str(error))
        if before is None or stop_of(before) != stop:
            self._log.info("controller", stop=stop, says=ROBOT_STOPS[stop].says if stop is not None else "the arm may move")
        ended = before is not None and stop_of(before) is not None and stop is None and not self._ending.is_set()
        if ended and what_now(self._standing).next == "check":  # it moves nothing, so nobody has to ask for it
            self._check()

    def _poll_run(self) -> None:
        if self._run.current is None:  # nothing else may hold it: where it fails, its motion process stops the arm as soon as it is gone
            return
        if self._ending.is_set():
            self._run.current.interrupt(received())
        job, report = self._run.current.job, self._run.current.poll()
        if report is None:
            return
        if self._run.current.unkept:  # nor could a latch
            self._known.hold(report.reason)
        newest = self._run.newest()
        self._known.note(report, newest)
        if self._watch is not None and robot_may_be_out(report):
            self._watch.begin(last_seen(report, newest))
        self._run.current = None
        if job.kind == "check":
            self._arming.checked(report, tared=job.reference is not None)
            return
        self._known.last, self._arming.cell, self._arming.fault = report, None, ""
        if report.recording is not None and self._config.paths.write_reports:
            self._reports.add(report.recording)
        self._log.info("ended", verdict=report.verdict, reason=report.reason, recording=str(report.recording), notes=report.notes)
        self._jobs.report(report)


def robot_may_be_out(report: Report) -> bool:
    """Whether a run or a check ended so that the controller may have stopped the arm: by its state, or before any device answered."""
    return report.verdict != "done" and (not report.trips or any(trip["trip"] in ROBOT_TRIPS for trip in report.trips))


def last_seen(report: Report, newest: np.void | None) -> ControllerSeen | None:
    """What the last tick saw of the controller; None where it says nothing. The program that it saw has ended with the run.

    Args:
        newest: The last tick; None where none was sent.
    """
    if newest is None or not any(trip["trip"] in ROBOT_TRIPS for trip in report.trips):
        return None
    return ControllerSeen(bool(newest["connected"]), int(newest["robot_mode"]), int(newest["safety_mode"]))


def _plan_of(request: ControlRequest, config: Config) -> Plan:
    """The plan of a request, within the limits of the cell. Raises ConfigError."""
    plan = parse_plan(request.get("plan"), "the plan")
    refuse_together(config, plan)
    return plan


def _notify(message: str) -> None:
    """sd_notify(3): send one datagram to the socket that systemd names, if there is one."""
    address = os.environ.get("NOTIFY_SOCKET")
    if address:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notifier:
            notifier.connect("\0" + address[1:] if address.startswith("@") else address)
            notifier.sendall(message.encode())
