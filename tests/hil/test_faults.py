"""The table of docs/faults.md: every fault has a row, deadlines follow from the configuration, and some faults are injected here."""

from collections.abc import Callable

import pytest

from benchmarks.fault_injection import CYCLE_S, FAULTS, inject, objection, required
from hw.emulators.controller_state import PROGRAM_STOP_M_PER_S2
from hw.rtde import STOP_M_PER_S2
from palpd.config import Config
from palpd.daemon.overshoot import CONTROLLER_CYCLES
from palpd.testing.emulated_cell import PRESS, EmulatedCell, retry_if_machine_stalled

pytestmark = pytest.mark.hil

AGAIN = ("robot connection dropped", "recorder killed")
"""Two of those that are the hardest to survive; `python benchmarks/faults.py` injects all of them."""
MARGIN_TICKS = 3.0
"""A deadline may be this much longer than the configuration explains: phases of loop and controller, rounded up."""


def test_every_fault_that_can_be_done_has_a_row() -> None:
    assert set(required()) == set(FAULTS)


def explained_ticks(reaction: str) -> float:
    """Ticks from the fault to a target speed of zero that the default configuration explains."""
    config = Config()
    speed_m_per_s = PRESS["press_speed_m_per_s"]
    if reaction == "watchdog":
        return (1.0 / config.robot.watchdog_Hz + speed_m_per_s / PROGRAM_STOP_M_PER_S2) / CYCLE_S + 1.0
    return (config.safety.sensor_stale_s + speed_m_per_s / STOP_M_PER_S2) / CYCLE_S + 1.0 + CONTROLLER_CYCLES


@pytest.mark.parametrize("fault", [*(name for name, row in required().items() if row.reaction == "watchdog"), "sensor silent"])
def test_a_deadline_is_what_the_default_configuration_explains_and_little_more(fault: str) -> None:
    row = required()[fault]
    assert row.deadline is not None
    assert explained_ticks(row.reaction) <= row.deadline <= explained_ticks(row.reaction) + MARGIN_TICKS


@pytest.mark.parametrize("fault", AGAIN)
def test_the_fault_is_met_as_the_table_says(cell: Callable[..., EmulatedCell], fault: str) -> None:
    def attempt(wired: EmulatedCell) -> None:
        assert not objection(inject(lambda: wired, fault, attempts=1), required()[fault])

    retry_if_machine_stalled(lambda: cell(safety={"contact_limit_N": 16.0}), attempt)
