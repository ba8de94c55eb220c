"""`palpd setup` as an operator uses it, on emulated wires; `benchmarks/setup.py` and `setup_faults.py` do all of it."""

import time
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks.setup import SetupPage, operate, setup_page
from benchmarks.setup_faults import FAULTS, PlantedFault, row, tried
from palpd.config import load_config
from palpd.daemon.setup.commission import Commission, StepResult
from palpd.daemon.setup.flow import NAMES
from palpd.daemon.stored_state import State
from palpd.recording.reader import Recording
from palpd.testing.emulated_cell import PATIENT, EmulatedCell, emulated_cell, retry_if_machine_stalled
from palpd.testing.fixtures import skip_without_ur_rtde
from palpd.testing.processes import until

pytestmark = pytest.mark.hil
QUICK = ("15 Hz filter", "second client on the port", "wrong model", "wrong sign")


def test_an_empty_folder_becomes_a_cell_whose_watchdog_is_measured(tmp_path: Path) -> None:
    skip_without_ur_rtde()
    with emulated_cell(tmp_path) as cell:
        first = operate(cell, tmp_path / "cell", "--skip", "look", until="reference")
        assert first.exit_code == 0, first.text
        second = operate(cell, tmp_path / "cell", until="free-motion")
        assert "7/13 reference: Takes" in second.text
        assert "5/13 weight: ok on" in second.text
        report = cell.palpd("commission", "--config", str(tmp_path / "cell" / "config.yaml"), "--report")
    assert second.steps["watchdog"]["verdict"] == "ok", second.text
    assert second.steps["watchdog"]["findings"][0]["figures"]["stopped_after_ms"] == pytest.approx(200.0, abs=25.0)
    assert load_config(tmp_path / "cell" / "config.yaml").robot.host == cell.wires.host
    assert not (tmp_path / "cell" / "state" / "latch.json").exists()
    assert "confirmed: after" in report.stdout


@pytest.mark.parametrize("fault", [fault for fault in FAULTS if fault.name in QUICK], ids=lambda fault: fault.name)
def test_a_fault_is_found_by_the_step_that_should_find_it(fault: PlantedFault, tmp_path: Path) -> None:
    skip_without_ur_rtde()
    good, text = row(fault, session := tried(fault, tmp_path, "--skip", "look"))
    assert good, f"{text}\n{session.text}"


def before_level(cell: EmulatedCell, folder: Path) -> EmulatedCell:
    """A folder whose steps up to the reference tare are done."""
    folder.mkdir()
    cell.wires.ask("restart", s=0.1)
    wired = EmulatedCell(cell.wires, cell.model, folder, PATIENT)
    wired.calibrate()
    State(folder / "state").keep("commission", Commission({name: StepResult("2026-11-27", "ok") for name in NAMES[: NAMES.index("level")]}))
    return wired


def post_the_abort(server: SetupPage) -> None:
    assert server.ask("/abort", {}) == {"ok": True, "state": "the set-up has ended"}


@pytest.mark.parametrize("end", [post_the_abort, lambda server: server.process.kill()], ids=["abort of the page", "server killed"])
def test_the_arm_of_a_set_up_in_the_page_stops_in_mid_motion(tmp_path: Path, end: Callable[[SetupPage], None]) -> None:
    skip_without_ur_rtde()
    with emulated_cell(tmp_path) as cell:
        numbers = iter(range(9))
        retry_if_machine_stalled(lambda: before_level(cell, tmp_path / str(next(numbers))), lambda wired: end_in_mid_motion(wired, end))


def end_in_mid_motion(cell: EmulatedCell, end: Callable[[SetupPage], None]) -> None:
    """Let `level` begin by the page's routes, end it on its way, and look at the wire and at the recording."""
    with setup_page(cell.folder) as server:
        server.ask("/setup/begin", {})
        until(lambda: server.ask("/setup/talk?after=0")["asked"] is not None, "the step asks", 60.0, every_s=0.05)
        talk = server.ask("/setup/talk?after=0")
        asked = talk["said"][talk["asked"]]
        assert (asked["moves"], asked["usual"]) == ("go", "stop")
        server.ask("/setup/answer", {"number": talk["asked"], "question": asked["ask"], "answer": "go"})
        began_z_m = cell.truth()["tip_z_m"]
        until(lambda: cell.truth()["tip_z_m"] > began_z_m + 0.001, "the arm goes up", 60.0, every_s=0.01)
        ended_s = time.monotonic()
        end(server)
        rest_s = cell.rest_after_s(ended_s)
        print(f"at rest {1e3 * rest_s:.0f} ms after the end")
        assert rest_s < 0.15, "before the controller's watchdog, which takes 200 ms here"
        until(lambda: bool(list((cell.folder / "runs").glob("*.mcap"))), "the recording is closed", 20.0, every_s=0.05)
    recording = Recording.load(next((cell.folder / "runs").glob("*level*.mcap")))
    assert recording.rows[-1]["command_stop"]
    assert cell.truth()["tip_z_m"] < began_z_m + 0.004
