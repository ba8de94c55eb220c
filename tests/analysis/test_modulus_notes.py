"""A run whose moduli are doubtful says so, and one whose moduli are right does not."""

from pathlib import Path

import pytest

from palpd.analysis.modulus_notes import give_notes, modulus_notes
from palpd.analysis.results import sites
from palpd.cell.cell_file import CellFile
from palpd.config import Config, Plan
from palpd.recording.reader import Recording
from palpd.testing.simulated_recording import write_simulated


def notes(folder: Path, config: dict[str, object] | None = None, **cell: object) -> list[str]:
    plan = Plan.model_validate({"sites": [{"name": "A"}], "depths_m": [0.004, 0.005], "mode": "both", "repeats": 1})
    path = folder / "run.mcap"
    write_simulated(path, plan, CellFile.model_validate(cell), Config.model_validate(config or {}), seed=0)
    recording = Recording.load(path)
    return modulus_notes(recording.rows, recording.header)


@pytest.mark.parametrize("effects", [{}, {"sensor.bias": {"offset_N": 0.2}}])
def test_a_contact_where_the_search_met_it_is_not_doubted(tmp_path: Path, effects: dict[str, dict[str, float]]) -> None:
    assert notes(tmp_path, effects=effects) == []


def test_a_surface_that_sank_after_the_search_is_said_with_what_it_does_to_the_modulus(tmp_path: Path) -> None:
    (note,) = notes(tmp_path, effects={"tissue.plasticity": {"set_m": 0.001, "ratio": 0.0}})
    assert "site A" in note
    assert " lower than the search did" in note
    assert "off by 3" in note


def test_a_cable_that_rubs_moves_the_zero_and_not_the_contact(tmp_path: Path) -> None:
    (note,) = notes(tmp_path, effects={"cable.friction": {"force_N": 0.3, "presliding_m": 0.0005}})
    assert "at rest in the air" in note


@pytest.mark.parametrize(("stiffness_N_per_m", "words"), [(25.0, "the force rose by 0.025 N"), (-20.0, "the force fell by 0.02 N")])
def test_a_cable_that_pulls_in_the_air_is_said_with_what_it_does_to_the_modulus(
    tmp_path: Path, stiffness_N_per_m: float, words: str
) -> None:
    note = notes(tmp_path, effects={"cable.spring": {"stiffness_N_per_m": stiffness_N_per_m}})[0]
    assert note.startswith(f"site A: on its way down through the air {words} for each mm: a cable pulls, or the zero drifts")
    assert 10 <= int(note.split("That is ")[1].split("%")[0]) <= 20, "12 % by the cell's own physics"


def test_a_zero_that_no_model_follows_is_said_with_what_it_does_to_a_dynamic_modulus(tmp_path: Path) -> None:
    (note,) = notes(tmp_path, effects={"sensor.bias": {"offset_N": 0.5}})
    assert note.startswith("site A: at rest in the air before its dynamic presses the force was +0.5")
    assert "a dynamic modulus may be off by 1" in note


@pytest.mark.parametrize(
    ("effects", "words"),
    [
        ({"tissue.viscoelastic": {"ratio": 0.5, "tau_s": 10.0}}, ("fell by", "the tissue relaxes")),
        ({"tissue.viscoelastic": {"ratio": 0.5, "tau_s": 60.0}}, ("fell by", "the tissue relaxes")),
        ({"sensor.creep": {"ratio": 0.1, "tau_s": 5.0}}, ("rose by", "the sensor creeps")),
    ],
)
def test_a_force_that_still_moves_while_it_is_held_is_said(
    tmp_path: Path, effects: dict[str, dict[str, float]], words: tuple[str, str]
) -> None:
    (note,) = (each for each in notes(tmp_path, effects=effects) if "within the hold" in each)
    assert note.startswith("site A, static ")
    assert all(each in note for each in words)


@pytest.mark.parametrize(
    "effects", [{"tissue.viscoelastic": {"ratio": 0.5, "tau_s": 0.3}}, {"sensor.creep": {"ratio": 0.02, "tau_s": 10.0}}]
)
def test_a_force_that_has_come_to_rest_before_the_hold_is_not_doubted(tmp_path: Path, effects: dict[str, dict[str, float]]) -> None:
    assert not [each for each in notes(tmp_path, effects=effects) if "within the hold" in each]


def test_a_machine_whose_give_nobody_measured_is_said_with_what_it_may_do(tmp_path: Path) -> None:
    notes(tmp_path)
    recording = Recording.load(tmp_path / "run.mcap")
    measured = sites(recording.rows, recording.header)
    (note,) = give_notes(measured, recording.header["body"]["machine_stiffness_N_per_m"])
    force_N, depth_m = 3.4, 0.005
    assert f"would be {1.5 * force_N / 1e4 / depth_m:.0%} too low" in note
    assert give_notes(measured, 5e4) == []


def test_equation_1_is_not_taken_for_hertz(tmp_path: Path) -> None:
    (note,) = notes(tmp_path, {"cell": {"tissue": {"poisson_ratio": 0.3}}}, tissue={"poisson_ratio": 0.3})
    assert "Hertz gives 1.4 times as much" in note
