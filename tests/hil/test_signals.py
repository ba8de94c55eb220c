"""Signals to every command that moves the arm, in the phases that are the hardest to interrupt: all processes end, the reason is true."""

import os
import shutil
import signal
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from benchmarks.signals import COMMANDS, RIGID_N_PER_M, interrupted
from palpd.recording.reader import Recording
from palpd.testing.emulated_cell import PATIENT, PRESS, Daemon, EmulatedCell, retry_if_machine_stalled
from palpd.testing.processes import command_of, family, until

pytestmark = pytest.mark.hil

END_S = 10.0
"""Longest time from a signal to the end in a test: generous, because the machine runs other things. A benchmark measures it."""


def _child(daemon: Daemon, words: str) -> Callable[[], bool]:
    def is_there() -> bool:
        assert daemon.process.poll() is None, daemon.stderr
        return any(words in command_of(pid) for pid in family(daemon.process.pid))

    return is_there


def _interrupt(daemon: Daemon, number: signal.Signals = signal.SIGINT) -> int:
    """Signal the whole process group, as a terminal does. Returns the exit code when no process is left."""
    os.killpg(daemon.process.pid, number)
    code = daemon.wait(END_S)
    until(lambda: not family(daemon.process.pid), "nothing of palpd is left", END_S)
    assert "Traceback" not in daemon.stderr
    return code


def test_an_interrupt_while_the_motion_process_starts_ends_the_run_before_anything_moved(cell: Callable[..., EmulatedCell]) -> None:
    wired = cell(**PATIENT)
    daemon = wired.run(PRESS)
    until(_child(daemon, "spawn_main"), "the motion process starts")
    assert _interrupt(daemon) == 130
    assert "interrupted by SIGINT while the devices were being opened; nothing was moved" in daemon.stderr
    assert not list(wired.folder.glob("runs/*"))


def test_an_interrupt_while_the_recorder_starts_ends_the_run_before_anything_moved(cell: Callable[..., EmulatedCell]) -> None:
    wired = cell(**PATIENT)
    daemon = wired.run(PRESS)
    until(_child(daemon, "palpd.recording.recorder"), "the recorder starts", every_s=0.002)
    assert _interrupt(daemon) == 130
    assert "interrupted by SIGINT while the recording was being opened; nothing was moved" in daemon.stderr
    assert not list(wired.folder.glob("runs/*"))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_a_signal_in_the_press_stops_the_arm_and_closes_the_recording(cell: Callable[..., EmulatedCell], number: signal.Signals) -> None:
    def attempt(wired: EmulatedCell) -> None:
        daemon = wired.run(PRESS)
        wired.until_contact(daemon, 1.0)
        os.killpg(daemon.process.pid, number)
        with suppress(ProcessLookupError):
            assert _interrupt(daemon, number) == 3, "a second signal changes nothing"
        assert f"the operator aborted the run (interrupted by {number.name})" in daemon.stderr
        assert wired.log(0.0)[-1].speed_m_per_s == 0.0
        assert not list(wired.folder.glob("runs/*.part"))
        (recording,) = map(Recording.load, Path(wired.folder, "runs").glob("*.mcap"))
        assert recording.footer["verdict"] == "stopped"

    retry_if_machine_stalled(lambda: cell(**PATIENT), attempt)


STAGE_OF = dict.fromkeys(COMMANDS, "motion") | {"calibrate": "start", "demo": "start"}
"""When each command is interrupted here; the benchmark interrupts all at random moments."""
START_S = {"calibrate": 2.0, "demo": 6.0}
"""Longest time to the signal of those that are interrupted at the start: within the shortest life that they have on a fast machine."""


@pytest.fixture(scope="module")
def calibration(cb3: EmulatedCell, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A reference tare for all commands."""
    return cb3.anew(tmp_path_factory.mktemp("calibrated")).calibrate()


NAMES = ("SIGTERM", "Ctrl-C", "SIGINT twice", "terminal closed") * 2


@pytest.mark.parametrize(("command", "name"), list(zip(COMMANDS, NAMES, strict=True)))
def test_every_command_that_moves_ends_with_the_true_reason(
    cell: Callable[..., EmulatedCell], calibration: Path, command: str, name: str
) -> None:
    wired = cell(RIGID_N_PER_M if command == "stiffness" else 1000.0, **PATIENT)
    (wired.folder / "state").mkdir()
    shutil.copy(calibration, wired.folder / "state")
    outcome = interrupted(wired, command, name, STAGE_OF[command], START_S.get(command, 0.0))
    assert outcome is not None, "the command ended before the signal"
    assert not outcome.why, outcome
    assert outcome.gone_s < END_S
    assert command != "calibrate" or "moved" not in outcome.sentence
