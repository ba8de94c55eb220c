"""Arming: a check of the devices that commands nothing decides whether the next start may move the arm."""

import structlog

from palpd.daemon.control_socket import Later
from palpd.daemon.socket_client import CheckedCell
from palpd.daemon.stored_state import now
from palpd.daemon.supervisor import Report


class Arming:
    """Whether the service is armed, who waits for the check under way, and what the last check found.

    `cell` is None and `fault` empty after a run: what a check found before it is old.
    """

    def __init__(self) -> None:
        self.armed = False
        self.cell: CheckedCell | None = None
        self.fault = ""
        self._arming: Later | None = None
        self._looking: Later | None = None
        self._log = structlog.get_logger("palpd.service")

    @property
    def waits(self) -> bool:
        """Whether a client waits to be armed."""
        return self._arming is not None

    def wait(self, arm: bool) -> Later:
        """The answer to come of a client that waits for a check, to be armed or only to look."""
        later = Later()
        if arm:
            self._arming = later
        else:
            self._looking = later
        return later

    def abort(self) -> None:
        """Disarm, and refuse whoever waits to be armed."""
        self.armed = False
        arming, self._arming = self._arming, None
        if arming is not None:
            arming.answer = {"ok": False, "error": "not armed: a client asked for an abort meanwhile"}

    def checked(self, report: Report, tared: bool) -> None:
        """Answer whoever waits, and arm where that was asked for and the devices are ready.

        Args:
            report: How the check ended.
            tared: Whether it had a reference tare.
        """
        ready = report.verdict == "done" and tared
        reason = report.reason or ("" if ready else "there is no reference tare; run palpd calibrate with the probe free and still")
        self.cell = {"ready": ready, "reason": reason, "date": now()}
        self.fault = reason if report.probe is None else ""
        self._log.info("checked", ready=ready, reason=reason, date=self.cell["date"], notes=report.notes)
        if self._looking is not None:
            self._looking.answer = {"ok": True, "state": "disarmed", "cell": self.cell}
            self._looking = None
        arming, self._arming = self._arming, None
        if arming is None:
            return
        if not ready:
            arming.answer = {"ok": False, "error": f"not armed: {reason}"}
        elif arming.abandoned:
            self._log.info("not armed: the client has gone")
        else:
            self.armed = True
            arming.answer = {"ok": True, "state": "armed"}
            self._log.info("armed")
