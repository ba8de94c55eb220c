"""A calibrated service before an emulated cell."""

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from palpd.daemon.socket_client import NoDaemon, ask
from palpd.testing.emulated_cell import PRESS, EmulatedCell
from palpd.testing.operator import Operator
from palpd.testing.processes import until

PRESSED_N = 4.0
"""A force that an operator sees after an abort: well above that of a contact, far below the limits."""


@dataclass(frozen=True)
class Served:
    """A calibrated service before an emulated cell."""

    cell: EmulatedCell
    process: subprocess.Popen[bytes]

    @property
    def socket(self) -> Path:
        return self.cell.folder / "state" / "palpd.sock"

    def do(self, what: str, **more: Any) -> dict[str, Any]:
        return dict(ask(self.socket, {"do": what, **more}, 60.0))  # type: ignore[typeddict-item]

    def until_disarmed(self, timeout_s: float = 60.0) -> dict[str, Any]:
        """How the last job ended."""

        def disarmed() -> bool:
            with suppress(NoDaemon):  # it does not listen yet
                return bool(self.do("status")["state"] == "disarmed")
            return False

        until(disarmed, "the service is disarmed", timeout_s, every_s=0.05)
        return dict(self.do("status").get("last", {}))

    def until_phase(self, phase: str) -> None:
        """The running job is in the phase; a job that ends before fails the test with its reason."""

        def reached() -> bool:
            status = self.do("status")
            assert status["state"] != "disarmed", f"the job ended before {phase}: {status.get('last')}"
            return bool(status.get("phase") == phase)

        until(reached, phase, every_s=0.02)

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
def served(cell: EmulatedCell, patience_s: float = 60.0, *, calibrate: bool = True) -> Iterator[Served]:
    """Calibrate, and serve within the context."""
    if calibrate:
        calibrated = cell.palpd("calibrate", "--config", cell.config, patience_s=patience_s)
        assert calibrated.returncode == 0, calibrated.stderr
    with Path(cell.folder, "log.jsonl").open("wb") as log:
        process = subprocess.Popen([sys.executable, "-m", "palpd", "serve", "--config", str(cell.config)], stderr=log)
    try:
        service = Served(cell, process)
        service.until_disarmed(patience_s)
        yield service
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
        process.wait(30.0)
