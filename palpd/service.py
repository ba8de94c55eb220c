"""`palpd serve`: waits disarmed, speaks over the control socket, runs one plan at a time, tells systemd that it lives."""

import os
import signal
import socket
import time
from collections.abc import Callable
from typing import Any

import structlog

from palpd.config import Config, Plan, parse_plan, refuse_unsafe
from palpd.control import ControlSocket, Later
from palpd.errors import PalpdError, Refused
from palpd.motion import Build, Job, Kind
from palpd.overshoot import refuse_overload
from palpd.ring import LoopState, Ring
from palpd.state import Latch, State
from palpd.supervisor import Report, Run, now, recording_name
from palpd.tick import Phase, Request

POLL_S = 0.02
WATCHDOG_S = 0.5


class Service:
    """States: disarmed, checking, armed, running. A restart, a stop, a fault and the end of a plan all lead to disarmed.

    Between disarmed and armed stands a check of the real devices, which are read and not commanded. One is made at the start too, for
    the log: where a device is absent the service runs on.
    """

    def __init__(self, config: Config, build: Build) -> None:
        self._config, self._build = config, build
        self._state = State(config.paths.state)
        self._ring: Ring = Ring.create(config.robot.rate_Hz)
        self._armed = False
        self._run: Run | None = None
        self._last: Report | None = None
        self._arming: Later | None = None
        self._cell: dict[str, Any] | None = None
        self._log = structlog.get_logger("palpd.service")
        self._ending = False
        self._unkept: Latch | None = None

    def serve(self) -> None:
        """Serve until SIGTERM or SIGINT; a run that is under way is aborted and its recording closed first."""
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(number, self._end)
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
                if time.monotonic() - fed_s > WATCHDOG_S:
                    idle = self._run is None or self._ring.state != LoopState.RUNNING
                    if idle or self._ring.published != ticks:  # fed only while ticks advance, so that systemd sees a loop that hangs
                        _notify(f"WATCHDOG=1\nSTATUS={self._standing}")
                    fed_s, ticks = time.monotonic(), self._ring.published
        finally:
            _notify("STOPPING=1")
            control.close()
            self._free_ring()

    @property
    def _standing(self) -> str:
        if self._run is None:
            return "armed" if self._armed else "disarmed"
        return "checking" if self._checking else "running"

    @property
    def _checking(self) -> bool:
        return self._run is not None and self._run.job.kind == "check"

    def answer(self, request: dict[str, Any]) -> dict[str, Any] | Later:
        """Carry out one request of the control socket; refusals are sentences and change nothing."""
        commands: dict[str, Callable[[dict[str, Any]], dict[str, Any] | Later]] = {
            "status": self._status,
            "arm": self._arm,
            "start": self._start,
            "pause": lambda _: self._ask(Request.PAUSE),
            "resume": lambda _: self._ask(Request.RESUME),
            "abort": self._abort,
            "clear": self._clear,
        }
        todo = commands.get(request["do"])
        if todo is None:
            return {"ok": False, "error": f"{request['do'][:32]!r} is no command; known: status, arm, start, pause, resume, abort, clear"}
        try:
            done = todo(request)
            return done if isinstance(done, Later) else {"ok": True, **done}
        except PalpdError as error:
            return {"ok": False, "error": str(error)}

    def _status(self, _: dict[str, Any]) -> dict[str, Any]:
        newest = self._ring.read(max(0, self._ring.published - 1))[0]
        latch = self._latch()
        found: dict[str, Any] = {
            "state": self._standing,
            "latched": latch.reason if latch else None,
            "pid": os.getpid(),
            "cell": self._cell,
        }
        if self._run is not None and not self._checking and len(newest):
            row = newest[-1]
            found |= {
                "phase": Phase(int(row["phase"])).name.lower(),
                "site": int(row["site"]),
                "force_N": float(row["force_N"]),
                "z_m": float(row["tcp_pose"][2]),
                "tick": int(row["index"]),
            }
        if self._last is not None:
            found["last"] = {
                "verdict": self._last.verdict,
                "reason": self._last.reason,
                "recording": str(self._last.recording) if self._last.recording else None,
                "notes": list(self._last.notes),
            }
        return found

    def _arm(self, _: dict[str, Any]) -> dict[str, Any] | Later:
        if not self._checking:
            self._refuse_running()
        if self._arming is not None:
            raise Refused("somebody else is arming the daemon; see palpd status")
        latch = self._latch()
        if latch is not None:
            raise Refused(f"the last run was stopped on {latch.date}: {latch.reason}; look at the cell, then palpd clear")
        if self._state.calibration() is None:
            raise Refused("there is no reference tare; run palpd calibrate with the probe free and still")
        self._armed = False
        self._arming = Later()
        if self._run is None:
            self._check()
        return self._arming

    def _check(self) -> None:
        self._run = Run(self._job("check", Plan(), dry=True), self._build, self._ring, self._state, "check")

    def _checked(self, report: Report) -> None:
        ready = report.verdict == "done" and self._run is not None and self._run.job.reference is not None
        reason = report.reason or ("" if ready else "there is no reference tare; run palpd calibrate with the probe free and still")
        self._cell = {"ready": ready, "reason": reason, "date": now()}
        self._log.info("checked", **self._cell, notes=report.notes)
        arming, self._arming = self._arming, None
        if arming is None:
            return
        if not ready:
            arming.answer = {"ok": False, "error": f"not armed: {reason}"}
        elif arming.abandoned:
            self._log.info("not armed: who asked for it has gone")
        else:
            self._armed = True
            arming.answer = {"ok": True, "state": "armed"}
            self._log.info("armed")

    def _job(self, kind: Kind, plan: Plan, dry: bool = False) -> Job:
        calibration, stiffness = self._state.calibration(), self._state.machine_stiffness()
        return Job(
            kind,
            self._config,
            plan,
            dry,
            reference=calibration.wrench if calibration else None,
            reference_serial=calibration.sensor_serial if calibration else None,
            machine_stiffness_N_per_m=self._config.machine.stiffness_N_per_m or (stiffness.stiffness_N_per_m if stiffness else None),
        )

    def _start(self, request: dict[str, Any]) -> dict[str, Any]:
        self._refuse_running()
        if not self._armed:
            raise Refused("the daemon is disarmed; run palpd arm first")
        plan: Plan = parse_plan(request.get("plan"), "the plan")
        refuse_unsafe(self._config, plan)
        refuse_overload(self._config, plan)
        self._run = Run(self._job("palpation", plan), self._build, self._ring, self._state, recording_name("palpation"))
        self._armed = False
        self._log.info("started", sites=len(plan.sites))
        return {"state": "running"}

    def _ask(self, wish: Request) -> dict[str, Any]:
        if self._run is None or self._checking:
            raise Refused("nothing is running")
        self._run.ask(wish)
        return {"state": "running"}

    def _abort(self, _: dict[str, Any]) -> dict[str, Any]:
        self._armed = False
        arming, self._arming = self._arming, None
        if arming is not None:
            arming.answer = {"ok": False, "error": "not armed: somebody asked for an abort meanwhile"}
        if self._run is not None:
            self._run.ask(Request.ABORT)
        return {"state": "aborting" if self._run else "disarmed"}

    def _clear(self, _: dict[str, Any]) -> dict[str, Any]:
        if not self._checking:
            self._refuse_running()
        self._unkept = None
        self._state.clear_latch()
        self._log.info("cleared")
        return {"state": "disarmed"}

    def _refuse_running(self) -> None:
        if self._checking:
            raise Refused("the devices are being checked; try again in some seconds")
        if self._run is not None:
            raise Refused("a plan is running; wait for its end, or palpd abort")

    def _latch(self) -> Latch | None:
        return self._unkept or self._state.latch()

    def _poll_run(self) -> None:
        if self._run is None:
            return
        if self._ending:
            self._run.ask(Request.ABORT)
        try:
            report = self._run.poll()
        except PalpdError as error:  # the latch could not be written: it holds as long as this process lives
            report, self._unkept = Report("stopped", str(error), 3), Latch(str(error), now())
        if report is not None and self._checking:
            self._checked(report)
            self._run = None
        elif report is not None:
            self._run, self._last, self._cell = None, report, None
            self._log.info("ended", verdict=report.verdict, reason=report.reason, recording=str(report.recording), notes=report.notes)

    def _free_ring(self) -> None:
        self._ring.unlink()
        self._ring.close()

    def _end(self, *_: object) -> None:
        self._ending = True


def _notify(message: str) -> None:
    """sd_notify(3): one datagram to the socket that systemd names, if it does."""
    address = os.environ.get("NOTIFY_SOCKET")
    if address:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notifier:
            notifier.connect("\0" + address[1:] if address.startswith("@") else address)
            notifier.sendall(message.encode())
