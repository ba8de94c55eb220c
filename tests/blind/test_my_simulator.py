"""The benchmark of a user's own simulator: its MuJoCo model is that of the drawn cells, and its shares are counted as stated."""

import numpy as np

from benchmarks.my_simulator import NominalComparison, lines, mujoco_simulator, specs
from palpd.blind.mujoco.cases import draw_case
from palpd.cell.cell_file import cell_from
from palpd.cell.simulation import wrench_of
from palpd.cell.tip_motion import estimate_tip_motion
from palpd.gap.user_simulator import asked


def test_the_mujoco_model_without_effects_reads_what_the_cell_file_says() -> None:
    case = draw_case(1, 1)
    plant, content, samples = case.healthy.plant, case.stated.as_yaml(), case.recording()
    assert plant.rig == "arm"
    about = {"rig": plant.rig, "controller": vars(plant.servo), "physics_step_s": plant.step_s, "contact": "Hertz"}
    cell = cell_from(content, "the drawn cell")
    motion = estimate_tip_motion(cell, samples.t_s, samples.z_m, samples.vz_m_per_s, samples.z_cmd_m)
    output = mujoco_simulator(content, about)(asked(motion, samples.z_cmd_m))
    apart_N = output["fz_N"] - wrench_of(cell, motion)[:, 2]
    assert float(np.ptp(output["fz_N"])) > 1.0
    assert float(apart_N.std()) < 0.1 * cell.sensor.noise_rms_N
    assert float((output["z_m"] - samples.z_m).std()) < 3e-5


def test_the_shares_leave_out_what_a_file_cannot_judge() -> None:
    def cell(planted: str, own: bool, function: bool, file: bool) -> NominalComparison:
        right = {"palpd": own, "function": function, "file": file}
        named = {nominal: [planted] if each else [] for nominal, each in right.items()}
        return {
            "case": planted,
            "planted": planted,
            "snr": 9.0,
            "first": right,
            "alone": right,
            "named": named,
            "cpu_s": dict.fromkeys(right, 1.0),
        }

    text = lines([cell("sensor.bias", True, True, False), cell("robot.compliance", True, False, False)])
    assert text[0].startswith("named first, MuJoCo as a function: 50.0%")
    assert "of 2 cells, palpd's own nominal 100.0%, difference -50.0 points" in text[0]
    assert "met" not in text[0]
    assert "of 1 cells" in text[2]
    many = lines([cell("sensor.bias", True, True, True)] * 200)
    assert all(line.endswith("(target: within 3): met") for line in (many[0], many[2]))


def test_the_cells_are_the_single_effect_cells_of_the_blind_check() -> None:
    drawn = specs(7, seed=1)
    assert len(drawn) == 7
    assert all(len(spec.effects) == 1 and spec.source == "mujoco" for spec in drawn)
    assert drawn == specs(9, seed=1)[:7]
