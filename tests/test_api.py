"""The Python API: what a notebook does."""

import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

import palpd
from palpd.cell.cell_file import nominal
from palpd.errors import BadInput, ConfigError, PalpdError, RecordingError
from tests.paths import ROOT


@pytest.fixture(scope="module")
def motion() -> dict[str, np.ndarray]:
    """Two free strokes and four presses with a hold."""
    t_s = np.arange(0.0, 40.0, 0.004)
    heights_m = {0: 0.01, 2: 0.01, 3: 0.002, 4: 0.01, 6: 0.01, 8: -0.004, 11: -0.004, 13: 0.01, 15: -0.006, 19: -0.006, 21: 0.01}
    heights_m |= {23: -0.003, 26: -0.003, 28: 0.01, 31: -0.005, 35: -0.005, 37: 0.01, 40: 0.01}
    return {"t_s": t_s, "z_cmd_m": np.interp(t_s, list(heights_m), list(heights_m.values()))}


@pytest.fixture(scope="module")
def softer(motion: dict[str, np.ndarray]) -> palpd.LoadedRecording:
    """A recording of a cell whose tissue is softer than stated."""
    cell = palpd.Cell.nominal().with_effects({"tissue.modulus": {"ratio": 0.7}})
    return palpd.simulate(motion, cell, noise_seed=3)


@pytest.fixture(scope="module")
def answer(softer: palpd.LoadedRecording) -> palpd.GapDiagnosis:
    return palpd.diagnose(softer, palpd.Cell.nominal())


def test_importing_palpd_imports_nothing_heavy() -> None:
    code = "import palpd, sys; print(sorted({'numpy', 'scipy', 'pydantic', 'matplotlib'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


def test_a_data_frame_is_diagnosed_as_a_recording_is(softer: palpd.LoadedRecording, answer: palpd.GapDiagnosis) -> None:
    assert answer.verdict == "effects"
    assert [row["effect"] for row in answer.table()] == ["tissue.modulus"]
    assert "tissue.modulus" in answer.sentence
    again = palpd.diagnose(dict(softer.columns), palpd.Cell.nominal())
    assert again.probabilities == answer.probabilities


def test_the_found_cell_predicts_the_recording_and_gives_its_modulus(softer: palpd.LoadedRecording, answer: palpd.GapDiagnosis) -> None:
    again = palpd.simulate(softer, answer.cell)
    assert float(np.std(again["fz_N"] - softer["fz_N"])) < 0.1
    assert float(np.std(palpd.simulate(softer, palpd.Cell.nominal())["fz_N"] - softer["fz_N"])) > 0.3
    modulus = palpd.analyse(softer, answer.cell)
    assert modulus.table()[0]["low_Pa"] < 0.7 * 72000.0 < modulus.table()[0]["high_Pa"]
    assert "Note" not in modulus.sentence


def test_what_the_cell_does_not_explain_stands_beside_the_modulus(softer: palpd.LoadedRecording) -> None:
    odd = {**softer.columns, "fz_N": softer["fz_N"] + 0.5 * np.sin(20.0 * softer["t_s"])}
    modulus = palpd.analyse(odd, palpd.Cell.nominal())
    assert "something is not in the cell file" in modulus.sentence
    assert "something is not in the cell file" in modulus.table()[0]["notes"]


def test_a_modulus_refuses_a_wrong_sign_and_a_wrong_unit_by_their_names(softer: palpd.LoadedRecording) -> None:
    with pytest.raises(RecordingError, match="multiply the forces by -1"):
        palpd.analyse({**softer.columns, "fz_N": -softer["fz_N"]}, palpd.Cell.nominal())
    with pytest.raises(RecordingError, match="check the units"):
        palpd.analyse({**softer.columns, "fz_N": 1e3 * softer["fz_N"]}, palpd.Cell.nominal())


def test_ones_own_simulator_is_the_nominal_as_a_function_and_as_a_data_frame(softer: palpd.LoadedRecording) -> None:
    stated = palpd.Cell.nominal()

    def mine(motion: dict[str, np.ndarray]) -> palpd.LoadedRecording:
        return palpd.simulate(motion, stated)

    output = palpd.simulate({**palpd.tip_motion(softer, stated)}, stated)
    for simulated in (mine, output.to_pandas(), [output]):
        answer = palpd.diagnose(softer, stated, simulated=simulated)
        assert [row["effect"] for row in answer.table()] == ["tissue.modulus"]
        assert answer.to_json()["simulated"]["other_motions"] is callable(simulated)
    again = palpd.simulate(softer, answer.cell, simulated=mine, nominal=stated)
    assert float(np.std(again["fz_N"] - softer["fz_N"])) < 0.1
    with pytest.raises(BadInput, match="1 outputs for 2 recordings"):
        palpd.diagnose([softer, softer], stated, simulated=output)
    with pytest.raises(BadInput, match=r"simulated= and nominal= belong together"):
        palpd.simulate(softer, answer.cell, simulated=mine)


def test_a_cell_without_tissue_and_filter_stays_so_with_effects() -> None:
    bare = palpd.Cell.of(tissue=None, sensor={"filter_cutoff_Hz": None}).with_effects({"sensor.gain": {"error": 0.1}}).file
    assert bare.tissue is None
    assert bare.sensor.filter_cutoff_Hz is None
    assert bare.effects == {"sensor.gain": {"error": 0.1}}


def test_what_is_saved_loads_again(softer: palpd.LoadedRecording, answer: palpd.GapDiagnosis, tmp_path: Path) -> None:
    softer.save(tmp_path / "run.csv")
    assert np.array_equal(palpd.load(tmp_path / "run.csv")["fz_N"], softer["fz_N"])
    answer.cell.save(tmp_path / "cell.yaml")
    assert palpd.Cell.load(tmp_path / "cell.yaml").file.effects == answer.cell.file.effects
    answer.report(tmp_path / "gap.html", "a run")
    assert "a run" in (tmp_path / "gap.html").read_text()


def test_a_recording_becomes_a_data_frame_and_back(softer: palpd.LoadedRecording) -> None:
    frame = softer.to_pandas()
    assert list(frame.columns) == list(softer)
    again = palpd.simulate(frame, palpd.Cell.nominal())
    assert np.array_equal(again["fz_N"], palpd.simulate(softer, palpd.Cell.nominal())["fz_N"])


def test_a_notebook_shows_sentence_and_table_with_names_escaped(softer: palpd.LoadedRecording, answer: palpd.GapDiagnosis) -> None:
    shown = answer._repr_html_()
    assert "tissue.modulus" in shown
    assert "<td>ratio</td>" in shown
    assert "&lt;b&gt;" in palpd.LoadedRecording(softer.samples, "<b>")._repr_html_()


def test_figures_are_drawn(softer: palpd.LoadedRecording, answer: palpd.GapDiagnosis) -> None:
    assert len(softer.figure().axes) == 2
    assert answer.figure().axes[0].get_ylabel() == "measured less simulated vertical force (fz), N"
    assert palpd.analyse(softer, answer.cell).figure().axes[0].lines


def test_bad_input_is_one_sentence(softer: palpd.LoadedRecording) -> None:
    with pytest.raises(RecordingError, match=r"column fz_N is missing"):
        palpd.diagnose({name: values for name, values in softer.columns.items() if name != "fz_N"}, palpd.Cell.nominal())
    with pytest.raises(RecordingError, match="no column t_s"):
        palpd.simulate({"z_m": np.zeros(3)}, palpd.Cell.nominal())
    with pytest.raises(RecordingError, match="no number"):
        palpd.diagnose({**softer.columns, "fz_N": ["x"] * len(softer)}, palpd.Cell.nominal())
    with pytest.raises(BadInput, match="needs a cell"):
        palpd.analyse(softer)
    with pytest.raises(ConfigError, match=r"robot\.lagg"):
        palpd.Cell.nominal().with_effects({"robot.lagg": {}})
    with pytest.raises(BadInput, match="no column 'force'"):
        softer["force"]
    with pytest.raises(AttributeError, match="no attribute 'diagnos'"):
        palpd.diagnos  # noqa: B018


def test_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    page = (ROOT / "docs" / "api.md").read_text()
    code = re.search(r"^```python\n(.*?)^```", page, flags=re.MULTILINE | re.DOTALL)
    assert code is not None
    monkeypatch.chdir(tmp_path)
    exec(code[1], {})
    printed = capsys.readouterr().out
    assert "tissue.modulus" in printed
    assert "kPa" in printed
    assert {"enriched.yaml", "gap.html"} == {path.name for path in tmp_path.iterdir()}
    assert set(palpd.__all__) <= set(re.findall(r"\w+", page))


@pytest.mark.parametrize("thing", [None, 3, np.zeros((40, 10))], ids=["None", "number", "array"])
def test_what_is_no_recording_is_refused_in_a_sentence(thing: object) -> None:
    for asked in (palpd.load, lambda source: palpd.simulate(source, {}), lambda source: palpd.diagnose(source, {})):
        with pytest.raises(BadInput, match=r"is no path of a recording|is no recording; give"):
            asked(thing)


@pytest.mark.parametrize(
    ("column", "values", "words"),
    [
        ("z_m", np.zeros(5), "z_m holds 5 values and t_s 200"),
        ("z_m", np.full(200, np.nan), "z_m is nan in row 1"),
        ("z_m", np.ma.masked_less(np.arange(200.0), 3.0), "z_m has 3 masked values"),
        ("z_m", np.datetime64("2026-01-01") + np.arange(200).astype("timedelta64[ms]"), "z_m holds dates or durations"),
        ("t_s", np.zeros(200, "timedelta64[ms]"), "t_s stands still"),
        ("t_s", np.zeros(200), "t_s stands still"),
    ],
)
def test_a_motion_that_cannot_be_is_refused(column: str, values: np.ndarray, words: str) -> None:
    columns = {"t_s": np.arange(200) * 0.01, "z_m": np.full(200, 0.01)} | {column: values}
    with pytest.raises(RecordingError, match=words):
        palpd.simulate(columns, {})


@pytest.mark.parametrize("seed", [-1, 0.5])
def test_a_seed_is_a_whole_number(motion: dict[str, np.ndarray], seed: int) -> None:
    with pytest.raises(BadInput, match="expected a whole number from 0 on"):
        palpd.simulate(motion, {}, noise_seed=seed)


def test_the_version_is_that_of_the_package() -> None:
    assert palpd.__version__ == version("palpd")


def test_a_foreign_table_becomes_a_recording_a_cell_and_tolerances(motion: dict[str, np.ndarray], tmp_path: Path) -> None:
    recording = palpd.simulate(motion, palpd.Cell.nominal(), noise_seed=1)
    table = np.column_stack([recording["t_s"], 1e3 * recording["z_m"], recording["fz_N"]])
    path = tmp_path / "rig.csv"
    np.savetxt(path, table, delimiter=",", header="t (s),z (mm),Fz (N)", comments="")
    columns = {"force_column": "Fz (N)", "height_column": "z (mm)", "time_columns": "t (s)", "units_confirmed": True}
    imported = palpd.import_file(path, **columns)
    np.testing.assert_allclose(imported["fz_N"], recording["fz_N"])
    assert any("No speed was recorded" in note for note in imported.notes)
    with pytest.raises(BadInput, match="import_file has no option force_colum \\(did you mean"):
        palpd.import_file(path, force_colum="Fz (N)")
    with pytest.raises(BadInput, match="no file was given"):
        palpd.import_file([])
    cell = palpd.cell_from(imported, tip_radius_m=nominal().probe.tip_radius_m)
    assert cell.file.tissue.surface_z_m == pytest.approx(nominal().tissue.surface_z_m, abs=5e-4)
    assert cell.notes[0].startswith("Sensor: 250 Hz")
    assert palpd.cell_from(imported, contact=False).file.tissue is None
    blocks = palpd.tolerances([recording], palpd.Cell.nominal())
    assert set(blocks) == {"tolerances", "repeatability"}


def test_a_data_frame_without_lateral_forces_and_torques_is_judged(motion: dict[str, np.ndarray]) -> None:
    whole = palpd.simulate(motion, palpd.Cell.nominal().with_effects({"tissue.modulus": {"ratio": 0.6}}), noise_seed=1)
    answer = palpd.diagnose({name: whole[name] for name in ("t_s", "z_m", "vz_m_per_s", "fz_N")}, palpd.Cell.nominal())
    assert [row["effect"] for row in answer.table()] == ["tissue.modulus"]


def test_a_cell_is_exported(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    assert (palpd.export_sim(palpd.Cell.nominal(), tmp_path / "cell", "mujoco") / "cell.xml").is_file()


@pytest.mark.parametrize("array", [np.zeros((40, 3)), np.zeros(40)])
def test_an_array_as_a_simulator_or_a_cell_is_refused_in_a_sentence(motion: dict[str, np.ndarray], array: np.ndarray) -> None:
    recording = palpd.simulate(motion, palpd.Cell.nominal(), noise_seed=1)
    with pytest.raises(PalpdError, match="a ndarray is no recording; give"):
        palpd.diagnose(recording, {}, simulated=array)
    with pytest.raises(PalpdError, match="cell"):
        palpd.diagnose(recording, array)
