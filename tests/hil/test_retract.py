"""After an abort in the tissue: `palpd retract` leaves it slowly, straight up and under the guard, and arming works again."""

from collections.abc import Callable

import pytest

from palpd.control.sequence import RETRACT_M_PER_S
from palpd.errors import Refused
from palpd.testing.emulated_cell import PATIENT, EmulatedCell
from palpd.testing.processes import until
from palpd.testing.served_cell import served

pytestmark = pytest.mark.hil


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
        service.arm()
        assert service.do("status")["state"] == "armed"


def test_a_typed_retract_ends_with_its_end_so_that_a_clear_may_follow(cell: Callable[..., EmulatedCell]) -> None:
    with served(cell(**PATIENT)) as service:
        service.abort_in_the_tissue()
        done = service.cell.palpd("retract", "--config", service.cell.config)
        assert done.returncode == 0, done.stderr
        assert service.cell.truth()["contact_N"] == 0.0
        assert "done: " in done.stdout
        assert "The probe is free" in done.stdout
        assert service.do("clear")["state"] == "disarmed"


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
