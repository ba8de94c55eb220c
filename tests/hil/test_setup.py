"""`palpd setup` as an operator uses it, on emulated wires; `benchmarks/setup.py` and `setup_faults.py` do all of it."""

from pathlib import Path

import pytest

from benchmarks.setup import operate
from benchmarks.setup_faults import FAULTS, PlantedFault, row, tried
from palpd.config import load_config
from palpd.testing.emulated_cell import emulated_cell
from palpd.testing.fixtures import skip_without_ur_rtde

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
