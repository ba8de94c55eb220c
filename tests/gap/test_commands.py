"""Recordings in, answers out: one, a folder of them, and a simulation of what was found."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpd.analysis.enriched import analysed
from palpd.cell.cell_file import PHANTOM, CellFile, cell_from, load_cell, nominal, save_cell
from palpd.cell.effects import EFFECTS
from palpd.config import Config, Plan, PlanSite
from palpd.errors import BadInput, RecordingError
from palpd.gap.commands import diagnose_files, nominal_cell, read_recording, simulate_file, tolerances_of
from palpd.gap.data.plausibility import check_recordings
from palpd.gap.diagnosis import diagnose
from palpd.recording.oddities import questions_of
from palpd.recording.reader import Recording, export, samples_of
from palpd.recording.samples import read_csv, write_csv
from palpd.testing.simulated_recording import write_simulated
from tests.gap.test_diagnosis import recording
from tests.paths import SHARED_DATA
from tests.simulated import cell_file, ran

EFFECT = {"tissue.viscoelastic": {"ratio": 0.2, "tau_s": 0.8}}


def test_a_file_is_diagnosed_and_its_enriched_cell_simulates_it(tmp_path: Path) -> None:
    samples = recording(nominal(), EFFECT)
    write_csv(tmp_path / "a.csv", samples)
    save_cell(tmp_path / "cell.yaml", nominal())
    diagnose_files(
        [tmp_path / "a.csv"], tmp_path / "cell.yaml", json_out=tmp_path / "a.json", cell_out=tmp_path / "rich.yaml", propose=False
    )
    assert json.loads((tmp_path / "a.json").read_text())["effects"][0]["id"] == "tissue.viscoelastic"
    assert load_cell(tmp_path / "rich.yaml").estimated is not None
    simulate_file(tmp_path / "a.csv", tmp_path / "rich.yaml", tmp_path / "predicted.csv")
    assert np.std(read_csv(tmp_path / "predicted.csv").wrench[:, 2] - samples.wrench[:, 2]) < 0.08
    simulate_file(tmp_path / "a.csv", tmp_path / "rich.yaml", tmp_path / "predicted.csv")  # a file of palpd's is replaced


def test_without_a_cell_file_a_recording_of_the_daemon_is_diagnosed_against_the_cell_that_it_states(tmp_path: Path) -> None:
    cell = cell_file(tissue={"poisson_ratio": 0.41})
    write_simulated(tmp_path / "run.mcap", Plan(sites=(PlanSite(name="A"),), depths_m=(0.003,), hold_s=0.2), config=Config(cell=cell))
    assert nominal_cell(None, [tmp_path / "run.mcap"], EFFECTS) == cell
    with pytest.raises(BadInput, match="--cell is required"):
        nominal_cell(None, [tmp_path / "run.mcap", tmp_path / "other.csv"], EFFECTS)


def test_a_simulation_needs_a_time_and_a_height(tmp_path: Path) -> None:
    (tmp_path / "m.csv").write_text("t_s,force\n0,0\n1,1\n")
    save_cell(tmp_path / "cell.yaml", nominal())
    with pytest.raises(RecordingError, match="z_cmd_m"):
        simulate_file(tmp_path / "m.csv", tmp_path / "cell.yaml", tmp_path / "out.csv")


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_a_motion_is_a_table_like_any_recording(tmp_path: Path, delimiter: str) -> None:
    rows = ["t_s,z_m,remark", *(f"{k / 1000},{0.01 - k * 1e-5},free" for k in range(40))]
    (tmp_path / "m.csv").write_text("# by hand\n" + "\n".join(rows).replace(",", delimiter) + "\n")
    save_cell(tmp_path / "cell.yaml", nominal())
    assert len(simulate_file(tmp_path / "m.csv", tmp_path / "cell.yaml", tmp_path / "out.csv")) == 40


@pytest.mark.parametrize(
    ("rows", "sentence"),
    [
        ("t_s,t_s,z_m\n0,0,1\n1,1,1\n", "column t_s stands twice"),
        ("t_s,z_m\n0,1\n", "has 1 rows; a motion needs two"),
        ("t_s,z_m\n1,1\n0,1\n", "t_s runs backwards in row 2"),
        ("t_s,z_m\n0,1\n1,nan\n", "z_m is nan in row 2"),
        ("t_s,z_m\n0,1\n1,1e300\n", r"z_m is 1e\+300 in row 2"),
        ("t_s,z_m\n0,1\n1,up\n", "z_m is 'up' in row 2"),
    ],
)
def test_a_motion_that_none_can_make_is_refused_with_the_row(tmp_path: Path, rows: str, sentence: str) -> None:
    (tmp_path / "m.csv").write_text(rows)
    save_cell(tmp_path / "cell.yaml", nominal())
    with pytest.raises(RecordingError, match=sentence):
        simulate_file(tmp_path / "m.csv", tmp_path / "cell.yaml", tmp_path / "out.csv")


def test_tolerances_follow_from_healthy_recordings(tmp_path: Path) -> None:
    save_cell(tmp_path / "cell.yaml", nominal())
    paths = []
    for seed in (1, 2):
        paths.append(tmp_path / f"{seed}.csv")
        write_csv(paths[-1], recording(nominal(), {}, seed=seed))
    estimated = tolerances_of(paths, tmp_path / "cell.yaml")
    assert 0.005 < estimated["tolerances"]["youngs_modulus"] < 0.05
    assert 0.005 < estimated["tolerances"]["bias_N"] < 0.05


@pytest.mark.parametrize(
    ("factor", "error", "words"),
    [
        (1e3, RecordingError, "fz_N looks like mN"),
        (-1.0, RecordingError, "multiply the forces by -1"),
        (1.6, BadInput, r"tolerances\.youngs_modulus would be .* expected at most 10 times that; .*--accept-implausible"),
    ],
)
def test_no_tolerances_follow_from_sick_recordings(tmp_path: Path, factor: float, error: type[BadInput], words: str) -> None:
    save_cell(tmp_path / "cell.yaml", nominal())
    samples = recording(nominal(), {})
    write_csv(tmp_path / "sick.csv", replace(samples, wrench=factor * samples.wrench))
    with pytest.raises(error, match=words):
        tolerances_of([tmp_path / "sick.csv"], tmp_path / "cell.yaml")
    if error is BadInput:
        assert tolerances_of([tmp_path / "sick.csv"], tmp_path / "cell.yaml", accept_implausible=True)["tolerances"]["youngs_modulus"] > 0.2


def test_a_simulation_of_a_cell_that_cannot_be_carried_is_questioned(tmp_path: Path) -> None:
    save_cell(tmp_path / "cell.yaml", cell_from({"probe": {"mass_kg": 106.0}}, "heavy"))
    t_s = np.arange(0.0, 2.0, 0.01)
    (tmp_path / "m.csv").write_text("t_s,z_m\n" + "".join(f"{t:.2f},{0.01 + 0.001 * np.sin(t):.6f}\n" for t in t_s))
    with pytest.raises(BadInput, match=r"probe\.mass_kg is 106 kg.*--accept-implausible"):
        simulate_file(tmp_path / "m.csv", tmp_path / "cell.yaml", tmp_path / "out.csv")
    assert not (tmp_path / "out.csv").exists()
    simulate_file(tmp_path / "m.csv", tmp_path / "cell.yaml", tmp_path / "out.csv", accept_implausible=True)


@pytest.mark.parametrize("path", sorted(SHARED_DATA.rglob("*.yaml")), ids=lambda path: path.stem)
def test_no_shared_recording_is_refused(path: Path) -> None:
    samples = read_recording(path.with_suffix(".csv"))
    check_recordings([samples], load_cell(path))
    assert questions_of(samples) == []


def test_the_bias_after_the_tare_is_found_in_the_export_of_the_first_site() -> None:
    """The emulated bias begins with the first motion of the run; the export of site A begins there too."""
    cell = nominal().model_copy(update={"sensor": nominal().sensor.model_copy(update={"rate_Hz": 1000.0})})
    plan = Plan(sites=(PlanSite(name="A"),), depths_m=(0.004, 0.006), hold_s=1.0, repeats=1)
    run = ran(cell.with_effects({"sensor.bias": {"offset_N": 0.19}}), plan, safety={"contact_limit_N": 16.0, "absolute_limit_N": 40.0})
    samples = samples_of(Recording(Path("run.mcap"), run.rows, run.header, {}, None), "A")
    diagnosis = diagnose([samples], cell, max_bins=900, propose=False)
    (effect,) = diagnosis.effects
    assert "sensor.bias" in {effect.id, *effect.indistinguishable_from}, diagnosis.sentence
    assert diagnosis.verdict == "effects"
    assert effect.id != "sensor.bias" or abs(effect.parameters["offset_N"][0] - 0.19) < 0.04


@pytest.fixture(scope="module")
def palpated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as the demo leaves it: the recording of two sites of an emulated phantom, its cell file, and the export of each site."""
    folder = tmp_path_factory.mktemp("demo")
    cell = PHANTOM.with_effects({"sensor.bias": {"offset_N": 0.19}, "sensor.drift": {"rate_N_per_s": 1.5e-4}})
    plan = Plan(sites=(PlanSite(name="A"), PlanSite(name="C", x_m=0.06)), depths_m=(0.004, 0.006), hold_s=1.0, repeats=1)
    save_cell(folder / "emulated-cell.yaml", cell)
    recording = Recording.load(write_simulated(folder / "run.mcap", plan, cell=cell, config=Config(cell=nominal()), seed=1))
    for site in "AC":
        export(recording, folder / f"{site}.csv", site)
    return folder


@pytest.mark.parametrize("site", ["A", "C"])
def test_an_exported_site_is_compared_with_its_own_block_of_a_cell_file_with_sites(palpated: Path, site: str) -> None:
    assert read_csv(palpated / f"{site}.csv").sites == (site,)
    diagnosis = diagnose_files([palpated / f"{site}.csv"], palpated / "emulated-cell.yaml", propose=False)
    own_Pa = next(place.tissue.youngs_modulus_Pa for place in PHANTOM.sites if place.name == site and place.tissue is not None)
    assert diagnosis.verdict == "none", diagnosis.sentence
    assert diagnosis.modulus is not None
    assert (diagnosis.modulus.compared_Pa, diagnosis.modulus.site, diagnosis.modulus.far) == (own_Pa, site, False)
    assert diagnosis.modulus.measured_Pa == pytest.approx(own_Pa, rel=0.02)
    assert not any("has sites" in note for note in diagnosis.notes)


def test_a_cell_file_that_is_given_is_believed_and_the_answer_says_how_far_its_modulus_is_from_the_measured_one(palpated: Path) -> None:
    save_cell(palpated / "common.yaml", load_cell(palpated / "emulated-cell.yaml").model_copy(update={"sites": ()}))
    diagnosis = diagnose_files([palpated / "A.csv"], palpated / "common.yaml", propose=False)
    assert diagnosis.modulus is not None
    assert diagnosis.modulus.compared_Pa == 72e3
    assert diagnosis.modulus.measured_Pa == pytest.approx(62.5e3, rel=0.02)
    assert diagnosis.modulus.ci95_Pa[0] < 62.5e3 < diagnosis.modulus.ci95_Pa[1]
    assert "The cell file's modulus is 72 kPa; the recording measures 62." in diagnosis.sentence
    assert "Is it this sample's?" in diagnosis.sentence
    assert diagnosis.to_json()["modulus"]["far"] is True


def test_without_a_cell_file_the_modulus_of_a_site_is_not_known_unless_the_recording_states_it_for_that_site(palpated: Path) -> None:
    diagnosis = diagnose_files([palpated / "run.mcap"], None, site="A", propose=False)
    assert not any("tissue.modulus" in (effect.id, *effect.indistinguishable_from) for effect in diagnosis.effects), diagnosis.sentence
    assert diagnosis.modulus is None
    assert "The modulus was not known; the fit gives 62." in diagnosis.sentence


def test_only_a_site_with_a_modulus_of_its_own_has_a_known_one() -> None:
    cell = CellFile.model_validate({"sites": [{"name": "A", "tissue": {"youngs_modulus_Pa": 62500}}, {"name": "B", "x_m": 0.03}]})
    assert cell.assumed_at_site("A").at_site("A").tolerances.modulus_known
    for name in ("B", "C", None):
        assert not cell.assumed_at_site(name).at_site(name).tolerances.modulus_known


def test_simulation_and_modulus_of_an_exported_site_use_its_own_block(palpated: Path) -> None:
    predicted = simulate_file(palpated / "C.csv", palpated / "emulated-cell.yaml", palpated / "predicted.csv")
    measured = read_csv(palpated / "C.csv")
    assert np.std(predicted.wrench[:, 2] - measured.wrench[:, 2]) < 0.08
    cell = load_cell(palpated / "emulated-cell.yaml")
    for file in (palpated / "C.csv", palpated / "run.mcap"):
        assert analysed(file, cell, None if file.suffix == ".csv" else "C")["youngs_modulus_Pa"] == pytest.approx(92140, rel=0.02)
