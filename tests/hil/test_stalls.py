"""Over wires: a run that ends for want of data says whether the sensor was silent or this computer stood still."""

import os
import signal
import time
from collections.abc import Callable

import pytest

from palpd.testing.emulated_cell import PATIENT, PATIENT_S, PRESS, Daemon, EmulatedCell, retry_if_machine_stalled
from palpd.testing.processes import command_of, family

pytestmark = pytest.mark.hil

STALL_S = 0.7 * PATIENT_S
"""How long everything of this run stands still: longer than its loop may, shorter than data may be old."""
LIMITS = PATIENT["safety"] | {"max_stall_s": 0.05}


@pytest.fixture
def strict(cell: Callable[..., EmulatedCell]) -> Callable[[], EmulatedCell]:
    """Makes the cell ready with a daemon that is patient with data and not with its own loop."""
    return lambda: cell(robot=PATIENT["robot"], safety=LIMITS)


def begun(wired: EmulatedCell) -> Daemon:
    daemon = wired.run(PRESS)
    wired.until_contact(daemon, 0.5)
    return daemon


def silent_sensor(wired: EmulatedCell) -> None:
    daemon = begun(wired)
    wired.wires.ask("silent", s=1.0)
    assert daemon.wait() == 3
    assert "; the sensor was silent for 2" in daemon.report["reason"], daemon.report["reason"]
    assert daemon.report["loop"]["stalls"]["sensor"] >= 1


def stopped_processes(wired: EmulatedCell) -> None:
    daemon = begun(wired)
    witness = next(pid for pid in family(daemon.process.pid) if "witness.py" in command_of(pid))
    for number, pause_s in ((signal.SIGSTOP, STALL_S), (signal.SIGCONT, 0.0)):
        for pid in (daemon.motion_pid, witness):
            os.kill(pid, number)
        time.sleep(pause_s)
    assert daemon.wait() == 3
    assert "; this computer stood still for 1" in daemon.report["reason"], daemon.report["reason"]
    stalls = daemon.report["loop"]["stalls"]
    assert stalls["computer"] >= 1
    # on a busy computer the emulators, too, may be late by tens of milliseconds; the stop of the run's own processes is none of theirs
    assert stalls["robot_longest_s"] < 0.5 * STALL_S
    assert stalls["sensor_longest_s"] < 0.5 * STALL_S, f"the sensor was silent for {stalls['sensor_longest_s']:.3f} s"


def test_a_sensor_that_is_silent_is_told_from_this_computer(strict: Callable[[], EmulatedCell]) -> None:
    retry_if_machine_stalled(strict, silent_sensor)


def test_a_computer_that_stands_still_is_told_from_its_devices(strict: Callable[[], EmulatedCell]) -> None:
    retry_if_machine_stalled(strict, stopped_processes)
