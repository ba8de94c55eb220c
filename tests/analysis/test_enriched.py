"""The modulus by a cell file, and its doubt where the cell file does not describe the recording."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from palpd.analysis.enriched import analysed, enriched_modulus
from palpd.cell.cell_file import CellFile, cell_from
from palpd.cell.effects import EFFECTS
from palpd.cell.simulation import simulate
from palpd.cli.application import app
from palpd.config import Config, Plan
from palpd.daemon.motion_job import Job
from palpd.errors import RecordingError
from palpd.gap.data.observations import observe
from palpd.recording.header import RecordedGeometry
from palpd.recording.reader import Recording, samples_of
from palpd.recording.samples import read, samples_from_columns, write_csv
from palpd.recording.stated_geometry import with_stated_machine
from palpd.testing.simulated_recording import write_rows
from tests.simulated import cell_file, ran

CELL_BLOCKS = {
    "probe": {"mass_kg": 0.1, "tip_radius_m": 0.004},
    "sensor": {"filter_cutoff_Hz": None, "noise_rms_N": 0.01, "resolution_fz_N": 0.002},
    "tissue": {"surface_z_m": 0.1, "youngs_modulus_Pa": 40000.0},
}
CELL = cell_from(CELL_BLOCKS, "the test")
MACHINE = {"robot.compliance": {"stiffness_N_per_m": 15e3}}
RELAXES = {"tissue.viscoelastic": {"ratio": 0.35, "tau_s": 1.0}}


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Two presses with holds on a tissue that relaxes."""
    t_s = np.arange(0.0, 12.0, 0.01)
    way_m = np.interp(t_s % 6.0, [0.0, 1.0, 2.0, 4.5, 5.2], [0.0, 0.0, 1.0, 1.0, 0.0]) * 0.006
    columns = simulate(CELL.with_effects(RELAXES), t_s, z_cmd_m=0.102 - way_m, noise_seed=1)
    path = tmp_path / "recording.csv"
    write_csv(path, samples_from_columns(columns, "the test"))
    return path


@pytest.mark.parametrize(
    ("cell", "doubtful"),
    [(CELL, True), (CELL.with_effects(RELAXES), False), (CELL.with_effects({"sensor.noise": {"ratio": 1.1}}), False)],
)
def test_a_cell_file_that_does_not_describe_a_recording_is_doubted(recording: Path, cell: CellFile, doubtful: bool) -> None:
    result = analysed(recording, cell)
    assert bool(result["warnings"]) == doubtful
    if doubtful:
        assert "times what noise and scatter of this cell make: something is not in the cell file" in result["warnings"][0]
    elif "tissue.viscoelastic" in cell.effects:
        assert result["ci95_Pa"][0] < 40000.0 < result["ci95_Pa"][1]


def test_the_interval_holds_the_rounding_that_no_noise_dithers() -> None:
    """Counts of 50 mN, 15 in a press, with 5 mN of noise: the intervals held 8 of 12 moduli."""
    t_s = np.arange(0.0, 12.0, 0.01)
    inside = 0
    for number in range(12):
        rng = np.random.default_rng(number)
        modulus_Pa = 40000.0 * rng.uniform(0.9, 1.1)
        cell = cell_from({**CELL_BLOCKS, "tissue": {"surface_z_m": 0.1, "youngs_modulus_Pa": modulus_Pa}}, "the test")
        way_m = np.interp(t_s % 6.0, [0.0, 1.0, 2.0, 4.5, 5.2], [0.0, 0.0, 1.0, 1.0, 0.0]) * 0.005
        columns = simulate(cell, t_s, z_cmd_m=0.102 - way_m)
        columns["fz_N"] = 0.05 * np.round((columns["fz_N"] + rng.normal(0.0, 0.005, len(t_s))) / 0.05)
        estimate = enriched_modulus([samples_from_columns(columns, "the test")], CELL)
        inside += estimate.ci95_Pa[0] < modulus_Pa < estimate.ci95_Pa[1]
    assert inside >= 11


def test_the_name_of_a_site_is_refused_for_a_table(recording: Path) -> None:
    with pytest.raises(RecordingError, match="--site A chooses nothing in it"):
        analysed(recording, CELL, "A")


def test_a_recording_is_analysed_behind_the_machine_of_its_header(tmp_path: Path) -> None:
    plan, cell = Plan(depths_m=(0.003, 0.004), mode="static", repeats=1, hold_s=0.5), cell_file(tissue={"youngs_modulus_Pa": 143_000.0})
    done = ran(cell.with_effects(MACHINE), plan, machine_stiffness_N_per_m=15e3)
    job = Job("palpation", Config(), plan, machine_stiffness_N_per_m=15e3)
    file, about = tmp_path / "run.mcap", {"delay_s": done.header["body"]["delay_s"], "epoch_offset_s": 1.79e9}
    write_rows(file, done.rows, job, about, {"verdict": "done"})  # type: ignore[arg-type]
    result = analysed(file, cell)
    assert result["youngs_modulus_Pa"] == pytest.approx(143_000.0, rel=0.015)
    note = "the cell file states no robot.compliance; the recording's header states 15000 N/m of the machine, which counts"
    assert result["warnings"] == [note]
    observed = observe([samples_of(Recording.load(file))], cell, EFFECTS, (), 600)
    assert observed.cell.effects == MACHINE
    assert f"{note}." in observed.notes
    csv = tmp_path / "run.csv"
    exported = CliRunner().invoke(app, ["export", str(file), "--csv", str(csv)])
    assert "--machine-stiffness-N-per-m 15000" in " ".join(exported.output.split())


@pytest.mark.parametrize(
    ("blocks", "note"),
    [
        ({"probe": {"tip_radius_m": 0.004}}, "the tip radius of the cell file, 4 mm, counts; the recording's header states 5 mm"),
        ({"tissue": {"poisson_ratio": 0.3}}, "Poisson's ratio of the cell file, 0.3, counts; the recording's header states 0.5"),
        ({"effects": MACHINE}, "the robot.compliance of the cell file, 15000 N/m, counts; the recording's header states 30000 N/m"),
    ],
)
def test_what_cell_file_and_header_state_differently_is_said_with_which_counts(recording: Path, blocks: dict[str, Any], note: str) -> None:
    header = RecordedGeometry(tip_radius_m=0.005, poisson_ratio=0.5, delay_s=0.0, machine_stiffness_N_per_m=None)
    if "effects" in blocks:
        header["machine_stiffness_N_per_m"] = 30e3
    cell = cell_file(**blocks)
    same, notes = with_stated_machine(cell, [replace(read(recording), stated=header)])
    assert (same, notes) == (cell, [note])
