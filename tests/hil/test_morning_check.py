"""The morning check over emulated wires: a palpation waits for it, and it measures the machine behind the tip."""

import json
from pathlib import Path

import pytest
import yaml

from palpd.history.check_days import kept_checks
from palpd.testing.emulated_cell import PATIENT, PRESS, EmulatedCell, emulated_cell
from palpd.testing.fixtures import skip_without_ur_rtde
from palpd.testing.served_cell import served

pytestmark = pytest.mark.hil

PLATE = {"name": "plate", "tissue": {"youngs_modulus_Pa": 5e11}}
PUCK = {"name": "puck", "x_m": 0.03, "tissue": {"youngs_modulus_Pa": 72e3}}
MACHINE = {"robot.compliance": {"stiffness_N_per_m": 1e5}, "robot.backlash": {"width_m": 1e-4}}
BUSY = {"lost_percent": 50.0}
"""How many states a machine loses that runs other things too is no part of these tests."""
CHECK = {"plate": True, "puck_m": [0.03, 0.0], "search_m": 0.035, "require_check_h": 24.0, "tolerances": BUSY}


def test_a_check_shows_puck_machine_and_play_and_lets_a_palpation_through(tmp_path: Path) -> None:
    skip_without_ur_rtde()
    cell_file = tmp_path / "plate-and-puck.yaml"
    cell_file.write_text(yaml.safe_dump({"sites": [PLATE, PUCK], "effects": MACHINE}))
    with emulated_cell(tmp_path, "ur5", cell=cell_file) as wired:
        cell = EmulatedCell(wired.wires, wired.model, tmp_path, {**PATIENT, "check": CHECK})
        cell.calibrate()
        plan = tmp_path / "plan.yaml"
        search = {"speed_m_per_s": 0.01, "max_travel_m": 0.035}
        plan.write_text(yaml.safe_dump({**PRESS, "sites": [{"name": "A", "x_m": 0.03}], "depths_m": [0.004], "search": search}))
        refused = cell.palpd("run", "--config", cell.config, "--plan", plan)
        assert (refused.returncode, "run palpd check first" in refused.stderr) == (2, True), refused.stderr
        out = tmp_path / "check.json"
        done = cell.palpd("check", "--config", cell.config, "--temperature-C", "21", "--json", out, patience_s=180.0)
        assert done.returncode == 0, done.stderr
        figures = json.loads(out.read_text())
        features = figures["features"]
        assert features["plate_stiffness_N_per_m"] == pytest.approx(1e5, rel=0.1)
        assert features["play_m"] == pytest.approx(1e-4, abs=1.5e-5)
        assert features["puck_modulus_Pa"] == pytest.approx(72e3, rel=0.05)
        assert abs(features["delay_s"]) < 5e-3
        ((recording, kept),) = kept_checks(tmp_path / "runs")
        assert str(recording) == figures["recording"]
        assert (kept.day.temperature_C, kept.plate) == (21.0, figures["plate"])
        assert cell.palpd("run", "--config", cell.config, "--plan", plan).returncode == 0
        with served(cell, calibrate=False):
            renewed = cell.palpd("check", "--config", cell.config, "--new-baseline", "new mount")
        assert renewed.returncode == 0, renewed.stderr
        ((_, kept),) = kept_checks(tmp_path / "runs")
        assert kept.baseline is not None
        assert kept.baseline.note == "new mount"
