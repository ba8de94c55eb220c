"""A calibrated service before an emulated cell."""

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from palpd.daemon.socket_client import NoDaemon, ask
from palpd.testing.emulated_cell import PRESS, EmulatedCell
from palpd.testing.operator import Operator
from palpd.testing.processes import PATIENCE_S, until

PRESSED_N = 4.0
"""A force that an operator sees after an abort: well above that of a contact, far below the limits."""
JOB_S = 180.0
"""Longest wait for a job: a map draws a picture after its press."""


class ServedCell:
    """A service before an emulated cell, under way, which may be ended and begun again."""

    def __init__(self, cell: EmulatedCell) -> None:
        self.cell = cell
        self.socket = cell.folder / "state" / "palpd.sock"
        self.process = self._begun()

    def _begun(self) -> subprocess.Popen[bytes]:
        with (self.cell.folder / "log.jsonl").open("ab") as log:
            command = [sys.executable, "-m", "palpd", "serve", "--config", str(self.cell.config)]
            return subprocess.Popen(command, stderr=log, start_new_session=True)

    def begin(self) -> None:
        """Begin the service again, as systemd does after a crash, and wait until it has looked at its devices."""
        self.process = self._begun()
        self.until_idle()

    def end(self, number: int = signal.SIGTERM) -> None:
        """End the service with a signal."""
        if self.process.poll() is None:
            self.process.send_signal(number)
        self.process.wait(30.0)

    def do(self, what: str, **more: Any) -> dict[str, Any]:
        """Send one request. Raises Refused."""
        return dict(ask(self.socket, {"do": what, **more}, 60.0))  # type: ignore[typeddict-item]

    def status(self) -> dict[str, Any]:
        """The status of the service."""
        return self.do("status")

    def until_idle(self) -> dict[str, Any]:
        """Wait until nothing runs; returns how the last job ended."""
        return self._until(("disarmed", "armed"), JOB_S)

    def until_disarmed(self, timeout_s: float = PATIENCE_S) -> dict[str, Any]:
        """Wait until nothing runs and nothing may start; returns how the last job ended."""
        return self._until(("disarmed",), timeout_s)

    def _until(self, states: tuple[str, ...], timeout_s: float) -> dict[str, Any]:
        def reached() -> bool:
            with suppress(NoDaemon):  # it does not listen yet
                return self.status()["state"] in states
            return False

        until(reached, f"the service is {' or '.join(states)}", timeout_s, every_s=0.05)
        return dict(self.status().get("last", {}))

    def until_phase(self, phase: str) -> None:
        """Wait until the running job is in the phase. Raises AssertionError where it ends before."""

        def reached() -> bool:
            status = self.status()
            assert status["state"] != "disarmed", f"the job ended before {phase}: {status.get('last')}"
            return bool(status.get("phase") == phase)

        until(reached, phase, every_s=0.02)

    def program(self, name: str, **arguments: Any) -> dict[str, Any]:
        """Carry out a program as a job; returns its record. Raises Refused."""
        job = self.do("begin", program=name, arguments=arguments)["id"]
        self.until_idle()
        return self.do("job", id=job)

    def arm(self) -> None:
        """Arm, as an operator does beside a computer that stands still now and then."""
        Operator(self.do).arm()

    def press(self) -> None:
        """Press until the probe is loaded."""
        Operator(self.do).start(PRESS, lambda _: bool(self.cell.truth()["contact_N"] >= PRESSED_N), "the probe presses")

    def abort_in_the_tissue(self) -> None:
        """Press, and abort with a probe that is loaded."""
        self.press()
        self.do("abort")
        last = self.until_disarmed()
        assert last["verdict"] == "stopped"
        assert any("palpd retract leaves the tissue" in note for note in last["notes"])
        assert self.cell.truth()["contact_N"] >= PRESSED_N, "the arm stays where it was stopped"


@contextmanager
def served(cell: EmulatedCell, patience_s: float = PATIENCE_S, *, calibrate: bool = True) -> Iterator[ServedCell]:
    """Calibrate, and serve within the context."""
    if calibrate:
        cell.calibrate(patience_s)
    service = ServedCell(cell)
    try:
        service.until_disarmed(patience_s)
        yield service
    finally:
        service.end()
