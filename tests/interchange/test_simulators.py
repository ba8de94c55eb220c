"""A cell in other simulators gives what palpd's own simulation gives, and what cannot is refused before anything is written."""

import json
import os
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="MuJoCo is not installed; install the dev group to export cells to it.")
pytest.importorskip("pythonfmu3", reason="pythonfmu3 is not installed; install the dev group to export FMUs.")

import mujoco

from palpd.cell.cell_file import CellFile, Estimated, cell_from, load_cell, nominal, save_cell
from palpd.cell.effects import EFFECTS, Effect, Parameter
from palpd.cell.effects.learned import LearnedEffect
from palpd.cell.motion_profile import Move, commanded_heights
from palpd.cell.simulation import simulate
from palpd.errors import BadInput, ConfigError
from palpd.interchange.simulators import export
from palpd.interchange.simulators.bundle import bundled
from palpd.interchange.simulators.export import MOST_OFF, agreement_of, export_cell
from palpd.interchange.simulators.exported_cell import COLUMNS

CAUSES: dict[str, dict[str, float]] = {
    "robot.lag": {"bandwidth_ratio": 0.7},
    "robot.vibration": {"amplitude_m": 2e-4, "frequency_Hz": 11.0, "phase_rad": 0.4},
    "robot.backlash": {"width_m": 1e-3},
    "robot.compliance": {"stiffness_N_per_m": 800.0},
    "tissue.plasticity": {"set_m": 5e-4, "ratio": 0.6},
    "tissue.viscoelastic": {"ratio": 0.8, "tau_s": 0.7},
    "cable.friction": {"force_N": 0.4, "presliding_m": 2e-4},
    "probe.tilt": {"angle_rad": 0.3, "azimuth_rad": 2.0},
    "sensor.latency": {"delay_s": 0.0317},
    "sensor.hysteresis": {"width_N": 1.0, "amplitude_N": 0.5},
    "sensor.saturation": {"limit_N": 1.4},
    "sensor.quantization": {"step_N": 0.8},
}
"""One effect or two of every site, plain to see."""
SEEN = 5.0 * MOST_OFF
"""Difference to a cell without the effect, in rms of the noise: an export that lacked it would be seen."""


def motion() -> tuple[np.ndarray, np.ndarray]:
    """Two presses with a hold, a half lift and a deeper press: 2.5 s that no export uses."""
    moves = [
        Move(-0.0045, 0.02, 0.3),
        Move(0.001, 0.03, 0.1),
        Move(-0.003, 0.02, 0.05),
        Move(-0.0015, 0.02, 0.0),
        Move(-0.006, 0.02, 0.3),
        Move(0.003, 0.03, 0.2),
    ]
    heights_m, _ = commanded_heights(0.002, moves, 0.002)
    return np.arange(len(heights_m) + 1) * 0.002, np.concatenate(([0.002], heights_m))


def exported(cell: CellFile, folder: Path, target: export.Target = "mujoco", **options: Any) -> Path:
    return export_cell(cell, target, folder, **options).folder


def rolled_out(folder: Path, script: str = "palpd_cell.py", **options: Any) -> np.ndarray:
    rows: np.ndarray = runpy.run_path(str(folder / script))["rollout"](*motion(), **options)
    return rows


def worst(cell: CellFile, rows: np.ndarray) -> float:
    t_s, z_cmd_m = motion()
    return agreement_of(cell, rows, simulate(cell, t_s, z_cmd_m=z_cmd_m)).worst


@pytest.mark.parametrize("name", CAUSES)
def test_a_rollout_in_mujoco_is_what_palpd_simulates(name: str, tmp_path: Path) -> None:
    cell = nominal().with_effects({name: CAUSES[name]})
    rows = rolled_out(exported(cell, tmp_path / "out"))
    assert worst(cell, rows) <= MOST_OFF / 4.0
    assert worst(nominal(), rows) >= SEEN


@pytest.mark.parametrize("deviations", [{"latency_s": -0.0037, "mass_kg": 0.01, "gain": 0.01}, {"latency_s": 0.0013, "surface_z_m": 1e-4}])
def test_in_tolerance_deviations_are_exported_also_a_sensor_that_is_ahead(deviations: dict[str, float], tmp_path: Path) -> None:
    cell = (
        nominal()
        .with_estimated(Estimated(**deviations))
        .with_effects({"clock.skew": {"ratio": 1e-3 if deviations["latency_s"] > 0 else -1e-3}})
    )
    for target, script in (("mujoco", "palpd_cell.py"), ("fmu", "rollout.py")):
        pytest.importorskip("fmpy", reason="fmpy is not installed; install the dev group to run FMUs.")
        assert worst(cell, rolled_out(exported(cell, tmp_path / target, target), script)) <= MOST_OFF / 2.0


@pytest.mark.parametrize("name", ["robot.vibration", "tissue.viscoelastic"])
def test_an_fmu_gives_what_palpd_simulates(name: str, tmp_path: Path) -> None:
    pytest.importorskip("fmpy", reason="fmpy is not installed; install the dev group to run FMUs.")
    from fmpy.validation import validate_fmu

    cell = nominal().with_effects({name: CAUSES[name]})
    folder = exported(cell, tmp_path / "out", "fmu")
    assert not validate_fmu(str(folder / "PalpdCell.fmu"))
    rows = rolled_out(folder, "rollout.py")
    assert worst(cell, rows) <= MOST_OFF / 4.0
    assert worst(nominal(), rows) >= SEEN
    np.testing.assert_array_equal(rolled_out(folder, "rollout.py"), rows)  # a second instance in the same process


def test_noise_comes_with_a_seed_and_is_that_of_palpd(tmp_path: Path) -> None:
    cell = nominal().with_effects({"sensor.noise": {"ratio": 3.0}, "sensor.dropout": {"rate_Hz": 60.0, "length_s": 0.004}})
    folder = exported(cell, tmp_path / "out")
    t_s, z_cmd_m = motion()
    columns = simulate(cell, t_s, z_cmd_m=z_cmd_m, noise_seed=5)
    own = np.column_stack([columns[name] for name in COLUMNS])
    clean, noisy = rolled_out(folder), rolled_out(folder, noise_seed=4)
    np.testing.assert_array_equal(rolled_out(folder, noise_seed=4), noisy)
    assert np.std(noisy - clean, axis=0) == pytest.approx(np.std(own - clean, axis=0), rel=0.1)
    held = [float(np.mean(np.diff(rows[:, 2:5], axis=0).any(axis=1))) for rows in (noisy, own)]
    assert held[0] == pytest.approx(held[1], abs=0.09)
    assert held[0] < 0.9


def test_a_learned_law_is_exported(tmp_path: Path) -> None:
    law = {
        "channels": {"fz_N": 1.0},
        "factor": "one",
        "driver": {"quantity": "depth"},
        "knots": [0.0, 0.003, 0.006],
        "values": [0.0, 0.6, 0.2],
    }
    learned = LearnedEffect.model_validate({"id": "learned.skin", "terms": [law | {"range": [0.0, 0.006]}]})
    cell = nominal().model_copy(update={"learned": (learned,)})
    rows = rolled_out(exported(cell, tmp_path / "out"))
    assert worst(cell, rows) <= MOST_OFF / 4.0
    assert worst(nominal(), rows) >= SEEN


def test_one_model_holds_all_draws(tmp_path: Path) -> None:
    late = nominal().with_effects({"sensor.latency": {"delay_s": 0.05}, "tissue.modulus": {"ratio": 1.5}})
    heavy = nominal().with_effects(
        {"robot.lag": {"bandwidth_ratio": 0.6}, "sensor.saturation": {"limit_N": 2.0}, "probe.mass": {"delta_kg": 1.0}}
    )
    folder = exported(nominal(), tmp_path / "out", draws=[late, heavy])
    for draw, cell in enumerate((nominal(), late, heavy)):
        assert worst(cell, rolled_out(folder, draw=draw)) <= MOST_OFF / 4.0
    assert worst(nominal(), rolled_out(folder, draw=2)) >= SEEN
    assert load_cell(folder / "draws" / "draw-001.yaml") == late
    with pytest.raises(ValueError, match=r"there is no draw 3; expected 0 \(the exported cell\) to 2"):
        rolled_out(folder, draw=3)


def test_the_folder_runs_elsewhere_without_palpd(tmp_path: Path) -> None:
    folder = exported(nominal().with_effects({"tissue.viscoelastic": CAUSES["tissue.viscoelastic"]}), tmp_path / "out")
    moved = folder.rename(tmp_path / "moved")
    program = "import runpy, sys; sys.modules['palpd'] = None; sys.argv = sys.argv[1:]; runpy.run_path(sys.argv[0], run_name='__main__')"
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()

    def run(*words: str) -> subprocess.CompletedProcess[str]:
        line = [sys.executable, "-c", program, str(moved / "palpd_cell.py"), str(moved / "motion.csv"), *words]
        return subprocess.run(line, cwd=elsewhere, env=environment, capture_output=True, text=True, check=False)

    done = run("--csv", "rollout.csv")
    assert done.returncode == 0, done.stderr
    rows = np.genfromtxt(elsewhere / "rollout.csv", delimiter=",", names=True)
    expected = simulate(load_cell(moved / "cell.yaml"), rows["t_s"], z_cmd_m=rows["z_cmd_m"])
    assert np.abs(rows["fz_N"] - expected["fz_N"]).max() < 1e-3
    assert float(rows["fz_N"].max()) > 0.1
    for words, sentence in (
        (("--csv", "rollout.csv"), "rollout.csv exists; give another --csv"),
        (("--csv", "other.csv", "--draw", "1"), "there is no draw 1; expected 0 (the exported cell) to 0"),
    ):
        refused = run(*words)
        assert (refused.returncode, refused.stderr.strip()) == (1, sentence)
    assert sorted(path.name for path in elsewhere.iterdir()) == ["rollout.csv"]


def test_a_model_that_is_loaded_alone_says_so_and_shows_no_tissue(tmp_path: Path) -> None:
    """Without the callback all sensors read zero, which looks like a cell that never touches."""
    folder = exported(nominal(), tmp_path / "out")
    text = (folder / "cell.xml").read_text()
    assert 'model="palpd_cell, dead without palpd_cell.py"' in text
    assert "every user sensor reads zero" in text
    model = mujoco.MjModel.from_xml_path(str(folder / "cell.xml"))
    assert model.geom("tissue").rgba[3] == 0.0
    runpy.run_path(str(folder / "palpd_cell.py"))["start"](model, mujoco.MjData(model))
    mujoco.set_mjcb_sensor(None)
    assert model.geom("tissue").rgba[3] > 0.5


def test_a_reset_begins_a_new_recording_and_looking_twice_changes_nothing(tmp_path: Path) -> None:
    folder = exported(nominal().with_effects({"tissue.viscoelastic": {"ratio": 2.0, "tau_s": 0.5}}), tmp_path / "out")
    start = runpy.run_path(str(folder / "palpd_cell.py"))["start"]
    model = mujoco.MjModel.from_xml_path(str(folder / "cell.xml"))
    data = mujoco.MjData(model)
    start(model, data)
    pressed = []
    for looks in (0, 2):
        mujoco.mj_resetDataKeyframe(model, data, 0)
        for k in range(400):
            data.ctrl[0] = 0.005 - 0.02 * min(k * 0.002, 0.5)
            for _ in range(looks):
                mujoco.mj_forward(model, data)
            mujoco.mj_step(model, data)
        pressed.append(float(data.sensor("fz_N").data[0]))
    mujoco.set_mjcb_sensor(None)
    assert pressed[0] == pressed[1] > 0.5


def _squeak(span: Any, values: Any, _memory: Any) -> None:
    span.fz_N = span.fz_N + values["force_N"] * np.sin(200.0 * span.t_s)


SQUEAK = Effect("probe.squeak", "probe", "squeaks", (Parameter("force_N", "N", 0.0, 5.0, (1.0,)),), law=_squeak)


def test_effects_of_a_user_are_exported_where_their_law_can_be_copied(tmp_path: Path) -> None:
    cell = nominal().with_effects({"probe.squeak": {"force_N": 0.5}})
    assert exported(cell, tmp_path / "out", library={**EFFECTS, "probe.squeak": SQUEAK}).is_dir()
    nameless = Effect("probe.squeak", "probe", "squeaks", SQUEAK.parameters, law=lambda span, values, memory: None)
    with pytest.raises(BadInput, match=r"law of probe.squeak is no function at the top of a file"):
        exported(cell, tmp_path / "other", library={**EFFECTS, "probe.squeak": nameless})
    assert not (tmp_path / "other").exists()


def test_an_export_that_is_not_the_cell_is_refused_with_its_figure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def wrong(place: Path, content: Any) -> Any:
        rows = write(place, content)
        rows[:, 4] += 0.05
        return rows

    write = export._WRITERS["mujoco"]
    monkeypatch.setitem(export._WRITERS, "mujoco", wrong)
    with pytest.raises(
        BadInput, match=r"\(sensor.gain\) differs from palpd's simulation by 1 times the noise of fz_N, expected at most 0.2"
    ):
        exported(nominal().with_effects({"sensor.gain": {"error": 0.1}}), tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_a_stiff_servo_and_a_slow_sensor_get_steps_of_their_own(tmp_path: Path) -> None:
    cell = cell_from({"sensor": {"rate_Hz": 30.0}, "robot": {"servo_natural_frequency_Hz": 40.0}}, "cell")
    numbers = json.loads((exported(cell, tmp_path / "out") / "cells.json").read_text())["cells"][0]
    assert 2.0 * np.pi * 40.0 * numbers["step_s"] <= 0.25
    assert 1.0 / 30.0 / numbers["step_s"] == pytest.approx(round(1.0 / 30.0 / numbers["step_s"]))
    with pytest.raises(ConfigError, match=r"a sensor at 500 Hz and a servo at 1e\+06 Hz need steps of .* s, expected 5e-05 s or more"):
        exported(cell_from({"robot": {"servo_natural_frequency_Hz": 1e6}}, "cell"), tmp_path / "other")


@pytest.mark.parametrize(
    ("effect", "sentence"),
    [
        (
            {"tissue.preconditioning": {"softening": 1.4}},
            "tissue.preconditioning.softening is 1.4, expected 0 to 1; correct the cell file",
        ),
        ({"tissue.thickness": {"thickness_m": -0.01}}, "tissue.thickness.thickness_m is -0.01 m, expected more than 0"),
        ({"tissue.viscoelastic": {"ratio": -1.0, "tau_s": 1.0}}, "tissue.viscoelastic.ratio is -1, expected 0 to 20"),
    ],
)
def test_an_effect_outside_its_range_is_refused(effect: dict[str, dict[str, float]], sentence: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as refused:
        exported(nominal().with_effects(effect), tmp_path / "out")
    assert sentence in str(refused.value)
    assert not (tmp_path / "out").exists()


def test_a_cell_that_mujoco_takes_no_model_of_is_refused_in_a_sentence(tmp_path: Path) -> None:
    cell = cell_from({"probe": {"tip_length_m": 1e-300}}, "it")
    with pytest.raises(BadInput, match=r"MuJoCo takes no model of this cell .*; correct the sizes of probe and tissue"):
        export_cell(cell, "mujoco", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_folder_that_holds_something_is_refused_and_an_empty_one_is_not(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").touch()
    with pytest.raises(BadInput, match="mine is not empty"):
        exported(nominal(), tmp_path / "mine")
    with pytest.raises(BadInput, match="is no folder"):
        exported(nominal(), tmp_path / "mine" / "thesis.tex")
    (tmp_path / "empty").mkdir()
    assert (exported(nominal(), tmp_path / "empty") / "cell.xml").exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty", "mine"]


def test_a_missing_package_is_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(export, "find_spec", lambda name: None)
    for target, needed in export.NEEDS.items():
        with pytest.raises(BadInput, match=rf"--to {target} needs {needed}, which is not installed; install palpd\[sim\]"):
            exported(nominal(), tmp_path / "out", target)
    assert list(tmp_path.iterdir()) == []


def test_a_site_a_wall_and_no_tissue_are_exported(tmp_path: Path) -> None:
    cell = cell_from({"sites": [{"name": "B", "tissue": {"surface_z_m": -0.001, "youngs_modulus_Pa": 20000.0}}]}, "cell")
    rows = rolled_out(exported(cell, tmp_path / "site", site="B"))
    t_s, z_cmd_m = motion()
    assert agreement_of(cell, rows, simulate(cell, t_s, z_cmd_m=z_cmd_m, site="B")).worst <= MOST_OFF
    for name, blocks in (("wall", {"wall": {"z_m": 0.001, "stiffness_N_per_m": 900.0}}), ("air", {"tissue": None})):
        cell = cell_from(blocks, "cell")
        assert worst(cell, rolled_out(exported(cell, tmp_path / name))) <= MOST_OFF


def test_two_definitions_of_one_name_are_refused(tmp_path: Path) -> None:
    for name in ("one", "two"):
        (tmp_path / f"{name}.py").write_text("def law(s, p, memory):\n    pass\n")
    with pytest.raises(BadInput, match=r"two.py and one.py both define law.*rename one"):
        bundled(tmp_path / "one.py", [(tmp_path / "one.py", "law"), (tmp_path / "two.py", "law")], "", "")


def test_the_numbers_of_an_export_are_those_of_the_cell_and_plain_json(tmp_path: Path) -> None:
    save_cell(
        tmp_path / "cell.yaml", nominal().model_copy(update={"sensor": nominal().sensor.model_copy(update={"filter_cutoff_Hz": None})})
    )
    folder = exported(load_cell(tmp_path / "cell.yaml"), tmp_path / "out")

    def refuse(word: str) -> None:
        raise AssertionError(word)

    numbers = json.loads((folder / "cells.json").read_text(), parse_constant=refuse)["cells"][0]
    assert numbers["constants"]["cutoff_Hz"] is None
    assert numbers["constants"]["youngs_modulus_Pa"] == 72000.0
