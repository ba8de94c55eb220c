"""After an abort in the tissue: `palpd retract` leaves it slowly, straight up and under the guard, and arming works again."""

import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from benchmarks.emulated_cell import PATIENT, PRESS, EmulatedCell, until
from palpd.control.sequence import RETRACT_M_PER_S
from palpd.daemon.socket_client import NoDaemon, ask
from palpd.errors import Refused

pytestmark = pytest.mark.hil

PRESSED_N = 4.0
"""A force that an operator sees after an abort: well above that of a contact, far below the limits."""


@dataclass(frozen=True)
class Served:
    """A calibrated service before an emulated cell."""

    cell: EmulatedCell

    def do(self, what: str, **more: Any) -> dict[str, Any]:
        return dict(ask(self.cell.folder / "state" / "palpd.sock", {"do": what, **more}, 60.0))  # type: ignore[typeddict-item]

    def until_disarmed(self) -> dict[str, Any]:
        """How the last job ended."""

        def disarmed() -> bool:
            with suppress(NoDaemon):  # it does not listen yet
                return bool(self.do("status")["state"] == "disarmed")
            return False

        until(disarmed, "the service is disarmed", every_s=0.05)
        return dict(self.do("status").get("last", {}))

    def abort_in_the_tissue(self) -> None:
        """Press, and abort with a probe that is loaded."""
        self.do("arm")
        self.do("start", plan=PRESS)
        until(lambda: self.cell.truth()["contact_N"] >= PRESSED_N, "the probe presses")
        self.do("abort")
        last = self.until_disarmed()
        assert last["verdict"] == "stopped"
        assert any("palpd retract leaves the tissue" in note for note in last["notes"])
        assert self.cell.truth()["contact_N"] >= PRESSED_N, "the arm stays where it was stopped"


@contextmanager
def served(cell: EmulatedCell) -> Iterator[Served]:
    """Calibrate, and serve within the context."""
    calibrated = cell.palpd("calibrate", "--config", cell.config)
    assert calibrated.returncode == 0, calibrated.stderr
    with Path(cell.folder, "log.jsonl").open("wb") as log:
        process = subprocess.Popen([sys.executable, "-m", "palpd", "serve", "--config", str(cell.config)], stderr=log)
    try:
        service = Served(cell)
        service.until_disarmed()
        yield service
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(30.0)


def test_after_an_abort_a_retract_leaves_slowly_and_arming_works_again(cell: Callable[..., EmulatedCell]) -> None:
    with served(cell(**PATIENT)) as service:
        service.abort_in_the_tissue()
        with pytest.raises(Refused, match="not armed"):
            service.do("arm")
        began_s = float(service.cell.wires.ask("truth")["t_s"])
        service.do("retract")
        last = service.until_disarmed()
        assert last["verdict"] == "done", last
        way = service.cell.log(began_s)
        assert 0.0 < max(sample.vz_m_per_s for sample in way) <= RETRACT_M_PER_S + 1e-6
        assert min(sample.vz_m_per_s for sample in way) >= 0.0
        assert max(sample.speed_m_per_s - abs(sample.vz_m_per_s) for sample in way) == pytest.approx(0.0, abs=1e-9)
        assert way[-1].contact_N == 0.0
        assert service.do("arm")["state"] == "armed"


def test_a_sensor_that_falls_silent_during_a_retract_stops_the_arm(cell: Callable[..., EmulatedCell]) -> None:
    with served(cell(**PATIENT)) as service:
        service.abort_in_the_tissue()
        service.do("retract")
        until(lambda: service.cell.log(0.0)[-1].vz_m_per_s > 0.0, "the arm goes up")
        silent_s = float(service.cell.wires.ask("silent", s=2.0)["t_s"])
        assert service.cell.rest_after_s(silent_s, settle_s=1.5) < 1.0
        last = service.until_disarmed()
        assert last["verdict"] == "stopped"
        assert "newest frame of the force sensor" in last["reason"]
        assert service.do("status")["latched"]
