"""A user's own simulator as the nominal: what palpd's nominal would call a gap is none, and what was planted is found."""

import re
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest

import palpd
from palpd.cell.cell_file import CellFile, EffectValues, cell_from, nominal
from palpd.cell.effects import EFFECTS
from palpd.cell.simulation import predict_motion, simulate, wrench_of
from palpd.cell.span import TipMotion
from palpd.errors import BadInput, RecordingError
from palpd.gap.diagnosis import Diagnosis, diagnose
from palpd.gap.model.problem import Problem, make_problem
from palpd.gap.nominal_source import nominal_source
from palpd.gap.other_motion import check_on
from palpd.gap.report.page import curves_of, write
from palpd.gap.user_simulator import UserSimulator, simulate_with
from palpd.recording.samples import WRENCH_COLUMNS, Samples
from palpd.tick import Floats

RATE_HZ = 250
PRESSES_M = (0.004, 0.006, 0.003, 0.005)
SLOPE_N_PER_M, KNEE_M = 900.0, 0.002

SCALES = {"tissue.modulus", "sensor.gain", "sensor.asymmetry"}
"""Effects that a factor on the contact force may be."""

Wrench = Callable[[Mapping[str, Floats]], dict[str, Floats]]


def commanded(presses_m: tuple[float, ...] = PRESSES_M) -> tuple[Floats, Floats]:
    """Times and heights of two strokes in the air, and of presses at two speeds with holds."""
    corners = [(0.0, 0.01), (2.0, 0.01), (3.0, 0.002), (4.0, 0.01), (5.0, 0.01), (5.5, 0.02), (6.0, 0.01)]
    for number, depth_m in enumerate(presses_m):
        t_s, slow = corners[-1][0], 1.0 + number % 2
        corners += [(t_s + 1, 0.01), (t_s + 1 + slow, -depth_m), (t_s + 4 + slow, -depth_m), (t_s + 4 + 2 * slow, 0.01)]
    corners.append((corners[-1][0] + 1.0, 0.01))
    t_s = np.arange(0.0, corners[-1][0], 1.0 / RATE_HZ)
    return t_s, np.interp(t_s, *np.array(corners).T)


def foam_N(depth_m: Floats) -> Floats:
    """A contact that palpd's cell does not have: a foam that is linear until its cells collapse, and softer from there on."""
    return SLOPE_N_PER_M * (np.minimum(depth_m, KNEE_M) + 0.4 * np.maximum(depth_m - KNEE_M, 0.0))


def own_simulator(motion: Mapping[str, Floats]) -> dict[str, Floats]:
    """The user's simulator of the foam: contact and inertia behind the filter of the sensor, and a cable that pulls to the side."""
    fz_N = foam_N(np.maximum(-motion["z_m"], 0.0)) - 0.2 * motion["az_m_per_s2"]
    filtered, share = fz_N.copy(), 1.0 - np.exp(-2.0 * np.pi * 150.0 / RATE_HZ)
    for k in range(1, len(fz_N)):
        filtered[k] = filtered[k - 1] + share * (fz_N[k] - filtered[k - 1])
    return {"fz_N": filtered, "fx_N": 30.0 * (motion["z_m"] - motion["z_m"][0])}


def stated(**tissue: float) -> CellFile:
    """The cell file of the foam: its mean stiffness as Hertz would have it, and what is within specification."""
    return cell_from({"tissue": {"youngs_modulus_Pa": 62e3} | tissue}, "stated")


def record(
    wrench_of: Wrench, seed: int = 1, presses_m: tuple[float, ...] = PRESSES_M, raised: Callable[[Floats], Floats] | None = None
) -> Samples:
    """A recording of the real foam: the servo of the cell file, the wrench of `wrench_of`, noise; `raised` moves the tip, unreported."""
    t_s, z_cmd_m = commanded(presses_m)
    moved = simulate(nominal().model_copy(update={"tissue": None}), t_s, z_cmd_m=z_cmd_m)
    z_m, v = moved["z_m"], moved["vz_m_per_s"]
    tip = {"t_s": t_s, "z_m": z_m if raised is None else z_m + raised(z_m), "vz_m_per_s": v, "az_m_per_s2": np.gradient(v, t_s)}
    rng, columns = np.random.default_rng(seed), wrench_of(tip)
    wrench = np.column_stack([columns.get(name, np.zeros(len(t_s))) for name in WRENCH_COLUMNS])
    wrench += rng.standard_normal(wrench.shape) * np.array([0.05] * 3 + [0.001] * 3)
    noise_m, noise_m_per_s = 5e-6 * rng.standard_normal(len(t_s)), 2e-4 * rng.standard_normal(len(t_s))
    return Samples(t_s, z_cmd_m, z_m + noise_m, v + noise_m_per_s, wrench)


FUNCTION = UserSimulator.of_function(own_simulator, "foam")


def smooth(samples: Samples) -> dict[str, Floats]:
    """The output of the user's simulator for a recording, driven by the motion that palpd estimates."""
    one = make_problem([samples], stated()).recordings[0].sampled
    motion = {"t_s": one.t_s, "z_m": one.z_m, "vz_m_per_s": one.vz_m_per_s, "az_m_per_s2": one.az_m_per_s2}
    return {"t_s": samples.t_s, "z_m": samples.z_m} | own_simulator(motion)


def as_file(samples: Samples) -> UserSimulator:
    return UserSimulator.of_columns(smooth(samples), samples.t_s, "foam.csv")


@pytest.fixture(scope="module")
def healthy() -> Samples:
    return record(own_simulator)


@pytest.fixture(scope="module")
def drifting() -> Samples:
    """The healthy cell, with a zero of the sensor that drifts."""
    return record(lambda tip: own_simulator(tip) | {"fz_N": own_simulator(tip)["fz_N"] + 0.01 * tip["t_s"]})


def diagnosis_of(samples: Samples, *simulators: UserSimulator, cell: CellFile | None = None) -> Diagnosis:
    return diagnose([samples], cell or stated(), propose=False, simulators=simulators)


@pytest.fixture(scope="module")
def drift_by_file(drifting: Samples) -> Diagnosis:
    return diagnosis_of(drifting, as_file(drifting))


@pytest.fixture(scope="module")
def drift_by_function(drifting: Samples) -> Diagnosis:
    return diagnosis_of(drifting, FUNCTION)


def named(answer: Diagnosis) -> set[str]:
    """The named effects with their groups."""
    return {name for effect in answer.effects for name in (effect.id, *effect.indistinguishable_from)}


def test_a_law_that_the_users_simulator_has_and_palpd_has_not_is_a_gap_for_palpd_alone(healthy: Samples) -> None:
    palpd_alone = diagnosis_of(healthy)
    assert palpd_alone.verdict != "none"
    assert "simulated" not in palpd_alone.to_json()
    for simulator in (FUNCTION, as_file(healthy)):
        answer = diagnosis_of(healthy, simulator)
        assert answer.verdict == "none", answer.sentence


def test_an_effect_is_found_beside_the_users_law(drift_by_file: Diagnosis, drift_by_function: Diagnosis) -> None:
    for answer in (drift_by_file, drift_by_function):
        assert [effect.id for effect in answer.effects] == ["sensor.drift"]
        value, low, high = answer.effects[0].parameters["rate_N_per_s"]
        assert low <= 0.01 <= high, (value, low, high)
        assert answer.gap.shrink.closed is not None
        assert answer.gap.shrink.closed > 0.95


def test_what_a_file_cannot_judge_stands_in_sentence_and_json(drift_by_file: Diagnosis, drift_by_function: Diagnosis) -> None:
    content = drift_by_file.to_json()
    assert content["simulated"] == {
        "names": ["foam.csv"],
        "other_motions": False,
        "channels": ["fx_N", "fz_N"],
        "not_judged": [
            *("robot.backlash", "robot.compliance", "tissue.surface", "tissue.plasticity"),
            *("robot.lag", "robot.vibration"),
        ],
    }
    not_judged = "whether robot.backlash or robot.compliance or tissue.surface or tissue.plasticity is there: foam.csv holds no motion but"
    assert not_judged in drift_by_file.sentence
    assert "whether robot.lag or robot.vibration is there: foam.csv does not predict z_m." in drift_by_file.sentence
    assert any("palpd simulate MOTION --cell ENRICHED --simulated OUTPUT --nominal CELL" in note for note in content["notes"])
    asked = drift_by_function.to_json()["simulated"]
    assert asked["other_motions"]
    assert asked["not_judged"] == ["robot.lag", "robot.vibration"]


def palpds_own(cell: CellFile, *, contact: bool = False) -> UserSimulator:
    """Palpd's own cell by other means, so that the truth is known."""

    def mine(motion: Mapping[str, Floats]) -> dict[str, Floats]:
        tip = TipMotion(motion["t_s"], motion["z_m"], motion["vz_m_per_s"], motion["az_m_per_s2"])
        out = {"fz_N": wrench_of(cell, tip)[:, 2], "z_m": predict_motion(cell, motion["t_s"], motion["z_cmd_m"])}
        light = cell.model_copy(update={"probe": cell.probe.model_copy(update={"mass_kg": 1e-9})})
        return out | {"contact_N": wrench_of(light, tip)[:, 2]} if contact else out

    return UserSimulator.of_function(mine, "mine")


def pressed(effects: EffectValues, seed: int = 2) -> Samples:
    """A recording of the nominal cell with effects."""
    t_s, z_cmd_m = commanded()
    real = simulate(nominal().with_effects(effects), t_s, z_cmd_m=z_cmd_m, noise_seed=seed)
    return Samples(t_s, z_cmd_m, real["z_m"], real["vz_m_per_s"], np.column_stack([real[name] for name in WRENCH_COLUMNS]))


def of_modulus(factor: float) -> CellFile:
    """The nominal cell with a modulus that nobody cared about."""
    cell = nominal()
    assert cell.tissue is not None
    tissue = cell.tissue.model_copy(update={"youngs_modulus_Pa": factor * cell.tissue.youngs_modulus_Pa})
    return cell.model_copy(update={"tissue": tissue})


def test_without_an_effect_the_prediction_is_the_users_output_bit_for_bit(healthy: Samples) -> None:
    for simulator, cell in ((FUNCTION, stated()), (as_file(healthy), stated()), (palpds_own(nominal()), of_modulus(7.0))):
        problem = make_problem([healthy], cell, simulators=[simulator])
        one = problem.recordings[0]
        assert one.simulated is not None
        assert np.array_equal(problem.raw_prediction(one, problem.cell)[:, 3], one.simulated.output["fz_N"])


@pytest.mark.parametrize("effect", sorted(name for name, effect in EFFECTS.items() if not effect.scatter))
def test_an_effect_changes_the_users_output_as_it_changes_palpds_own_whatever_modulus_the_cell_file_has(effect: str) -> None:
    """The user's simulator is palpd's own cell, so both changes are known; the files state a tenth, and ten times, of its modulus."""
    healthy = pressed({})
    own = make_problem([healthy], nominal())

    def change(problem: Problem) -> Floats:
        values = {one.name: one.starts(own.scale)[0] for one in EFFECTS[effect].parameters if not one.optional}
        one = problem.recordings[0]
        return problem.raw_prediction(one, problem.cell.with_effects({effect: values})) - problem.raw_prediction(one, problem.cell)

    expected = change(own)
    for factor in (0.1, 10.0):
        apart = change(make_problem([healthy], of_modulus(factor), simulators=[palpds_own(nominal())])) - expected
        sizes, errors = (np.sqrt(np.mean(values**2, axis=0)) for values in (expected, apart))
        largest = int(np.argmax(sizes))
        assert sizes[largest] > 0.0
        # A loop of hysteresis follows the force behind the filter, and a mount the slope of the predicted heights.
        assert errors[largest] < (0.05 if effect in ("sensor.hysteresis", "structure.resonance") else 0.01) * sizes[largest]


def test_the_answer_does_not_depend_on_the_modulus_of_the_cell_file() -> None:
    recording = pressed({"robot.backlash": {"width_m": 3e-4}}, seed=5)
    answers = [diagnosis_of(recording, palpds_own(nominal()), cell=of_modulus(factor)) for factor in (0.1, 1.0, 10.0)]
    assert [[effect.id for effect in answer.effects] for answer in answers] == [["robot.backlash"]] * 3
    assert not any(answer.decisive for answer in answers)
    first, *others = ((answer.effects[0].probability, answer.effects[0].parameters) for answer in answers)
    for probability, parameters in others:
        assert abs(probability - first[0]) < 0.02
        for name, (value, low, high) in parameters.items():
            assert abs(value - first[1][name][0]) < 0.1 * (high - low)


def test_what_needs_the_contact_force_is_judged_where_the_output_says_it() -> None:
    """Something in the air that depends on the height hides which part of the force is the contact's."""
    recording = pressed({})

    def wavy(motion: Mapping[str, Floats]) -> dict[str, Floats]:
        out = dict(palpds_own(nominal(), contact=True).run(motion))
        return out | {"fz_N": out["fz_N"] + 0.5 * np.sin(2.0 * np.pi * motion["z_m"] / 0.0041)}

    def not_judged(simulator: UserSimulator) -> dict[str, tuple[str, ...]]:
        problem = make_problem([recording], nominal(), simulators=[simulator])
        source = nominal_source(problem.recordings, nominal(), EFFECTS)
        assert source is not None
        return dict(source.unjudged)

    (why, names), *_ = not_judged(
        UserSimulator.of_function(lambda motion: {name: wavy(motion)[name] for name in ("fz_N", "z_m")}, "wavy")
    ).items()
    assert why == "wavy does not say which part of fz_N is the contact's; add that as contact_N"
    assert {"tissue.modulus", "contact.lateral", "probe.tilt"} <= set(names)
    assert not {"sensor.gain", "probe.mass", "robot.backlash"} & set(names)
    assert not not_judged(UserSimulator.of_function(wavy, "wavy"))


def test_effects_of_the_cell_file_act_on_the_output_of_the_simulator(drifting: Samples, drift_by_file: Diagnosis) -> None:
    again = diagnosis_of(drifting, as_file(drifting), cell=drift_by_file.enriched_cell())
    assert again.verdict == "none", again.sentence


def test_a_tip_that_gives_way_is_found_by_asking_the_function_again() -> None:
    compliance = {"robot.compliance": {"stiffness_N_per_m": 3000.0}}
    cell = nominal()
    t_s, z_cmd_m = commanded()
    real = simulate(cell.with_effects(compliance), t_s, z_cmd_m=z_cmd_m, noise_seed=2)
    samples = Samples(t_s, z_cmd_m, real["z_m"], real["vz_m_per_s"], np.column_stack([real[name] for name in WRENCH_COLUMNS]))
    asked: list[float] = []

    def thicker(motion: Mapping[str, Floats]) -> dict[str, Floats]:
        """Palpd's own cell by other means, so that the truth is known; it notes how high it is asked."""
        asked.append(float(motion["z_m"].mean()))
        out = simulate(cell, motion["t_s"], z_m=motion["z_m"], vz_m_per_s=motion["vz_m_per_s"], z_cmd_m=motion["z_cmd_m"])
        return {name: out[name] for name in WRENCH_COLUMNS}

    answer = diagnose([samples], cell, propose=False, simulators=[UserSimulator.of_function(thicker, "mine")])
    assert [effect.id for effect in answer.effects] == ["robot.compliance"]
    value, low, high = answer.effects[0].parameters["stiffness_N_per_m"]
    assert low <= 3000.0 <= high, (value, low, high)
    assert len(set(asked)) == len(asked) - 1 == 8  # the recorded motion twice, and seven that are raised


def test_the_raised_tip_changes_the_users_own_law_and_not_palpds() -> None:
    """A compliance that lifts the tip: the prediction is the user's law where the tip is then, far from Hertz."""
    healthy = record(own_simulator)
    stiffness = 1500.0
    cell = stated().with_effects({"robot.compliance": {"stiffness_N_per_m": stiffness}})

    problem = make_problem([healthy], stated(), simulators=[FUNCTION])
    one = problem.recordings[0]
    rigid_N, predicted_N = (problem.raw_prediction(one, each)[:, 3] for each in (problem.cell, cell))
    depth_m = -one.sampled.z_m
    deepest = (depth_m > 0.98 * depth_m.max()) & (one.phases.since_s > 0.5) & ~one.phases.moving
    lifted_N = np.zeros_like(depth_m)
    for _ in range(60):  # the force that lifts the tip is that at its height
        lifted_N += 0.5 * (foam_N(np.maximum(depth_m - lifted_N / stiffness, 0.0)) - lifted_N)
    change_N = lifted_N - foam_N(np.maximum(depth_m, 0.0))
    assert np.abs(predicted_N - rigid_N - change_N)[deepest].max() < 0.05 * np.abs(change_N[deepest]).max()


def test_a_factor_on_the_users_own_contact_force_is_named() -> None:
    """The foam is far from Hertz: a smaller modulus once was another surface and a sensor with two slopes."""

    def softer(tip: Mapping[str, Floats]) -> dict[str, Floats]:
        still = own_simulator({**tip, "az_m_per_s2": 0.0 * tip["az_m_per_s2"]})
        return own_simulator(tip) | {"fz_N": own_simulator(tip)["fz_N"] - 0.15 * still["fz_N"]}

    recording = record(softer, seed=3)
    for simulator in (FUNCTION, as_file(recording)):
        assert {"tissue.modulus", "sensor.gain"} <= named(diagnosis_of(recording, simulator)) <= SCALES


def test_the_report_draws_and_names_the_users_simulation(drifting: Samples, drift_by_file: Diagnosis, tmp_path: Path) -> None:
    curves = curves_of(drift_by_file)
    assert np.allclose(curves.nominal[:, 3], smooth(drifting)["fz_N"], atol=1e-9)
    before, after = curves.gaps(3)
    assert float(np.std(after)) < 0.06 < float(np.std(before))
    write(tmp_path / "gap.html", drift_by_file, "a run")
    assert "Nominal cell: as foam.csv simulates it." in (tmp_path / "gap.html").read_text()


def test_the_gap_closes_on_another_motion_where_the_simulator_can_be_asked(drift_by_file: Diagnosis, drift_by_function: Diagnosis) -> None:
    other = record(
        lambda tip: own_simulator(tip) | {"fz_N": own_simulator(tip)["fz_N"] + 0.01 * tip["t_s"]}, seed=7, presses_m=(0.005, 0.002)
    )
    closed = check_on(drift_by_function, other).closed
    assert closed is not None
    assert closed > 0.95
    with pytest.raises(BadInput, match=r"foam\.csv, which holds the diagnosed motion alone"):
        check_on(drift_by_file, other)


def test_a_next_experiment_needs_no_output_of_the_simulator_for_the_motions_that_it_tries() -> None:
    cell, (t_s, z_cmd_m) = nominal(), commanded()
    real = simulate(cell.with_effects({"tissue.modulus": {"ratio": 0.7}}), t_s, z_cmd_m=z_cmd_m, noise_seed=2)
    samples = Samples(t_s, z_cmd_m, real["z_m"], real["vz_m_per_s"], np.column_stack([real[name] for name in WRENCH_COLUMNS]))
    mine = simulate(cell, t_s, z_m=real["z_m"], vz_m_per_s=real["vz_m_per_s"], z_cmd_m=z_cmd_m)
    answer = diagnose([samples], cell, simulators=[UserSimulator.of_columns(mine, t_s, "mine.csv")])
    assert named(answer) == {"tissue.modulus", "sensor.gain"}
    assert answer.proposal is not None
    assert "sensor.gain" in answer.proposal.sentence
    assert "tissue.modulus" in answer.proposal.sentence


def test_a_servo_of_the_users_own_is_the_nominal_of_the_heights() -> None:
    """The real robot is twice as fast as the cell file says, and the user's simulator knows it."""
    t_s, z_cmd_m = commanded()
    fast = cell_from({"robot": {"servo_natural_frequency_Hz": 16.0}, "tissue": None}, "fast")
    moved = simulate(fast, t_s, z_cmd_m=z_cmd_m, noise_seed=3)
    samples = Samples(t_s, z_cmd_m, moved["z_m"], moved["vz_m_per_s"], np.column_stack([moved[name] for name in WRENCH_COLUMNS]))
    slow = cell_from({"tissue": None}, "slow")
    assert [effect.id for effect in diagnose([samples], slow, propose=False).effects] == ["robot.lag"]

    def mine(motion: Mapping[str, Floats]) -> dict[str, Floats]:
        out = simulate(fast, motion["t_s"], z_cmd_m=motion["z_cmd_m"])
        return {"z_m": out["z_m"], "fz_N": simulate(fast, motion["t_s"], z_m=motion["z_m"], vz_m_per_s=motion["vz_m_per_s"])["fz_N"]}

    answer = diagnose([samples], slow, propose=False, simulators=[UserSimulator.of_function(mine, "mine")])
    assert answer.verdict == "none", answer.sentence


# a rig without tissue


def axis(motion: Mapping[str, Floats]) -> dict[str, Floats]:
    """A linear axis with a force sensor and a moved mass: inertia, the cogging of its motor, and a cable chain; nothing is ever touched."""
    cogging_N = 0.25 * np.sin(2.0 * np.pi * motion["z_m"] / 0.016)
    return {"fz_N": cogging_N - 0.8 * motion["az_m_per_s2"] - 12.0 * (motion["z_m"] - motion["z_m"][0])}


def moved_axis(extra: Wrench, seed: int = 1) -> tuple[Samples, CellFile]:
    """A recording of the axis, and its cell file."""
    blocks = {
        "probe": {"mass_kg": 0.8},
        "sensor": {"filter_cutoff_Hz": None, "resolution_fz_N": 0.0, "noise_rms_N": 0.05},
        "tissue": None,
    }
    cell = cell_from(blocks, "axis")
    t_s, rng = np.arange(0.0, 30.0, 0.004), np.random.default_rng(seed)
    corners = np.array([(0, 0), (2, 0), (3, 0.04), (5, 0.04), (6.5, 0.01), (8, 0.01), (8.6, 0.05), (11, 0.05), (14, 0.0), (16, 0.0)])
    corners = np.vstack([corners, corners[1:] + np.array([14.0, 0.0])])
    z_cmd_m = np.interp(t_s, *corners.T)
    moved = simulate(cell, t_s, z_cmd_m=z_cmd_m)
    tip = {"t_s": t_s, "z_m": moved["z_m"], "vz_m_per_s": moved["vz_m_per_s"]}
    tip["az_m_per_s2"] = np.gradient(tip["vz_m_per_s"], t_s)
    wrench = rng.standard_normal((len(t_s), 6)) * np.array([0.05] * 3 + [0.001] * 3)
    wrench[:, 2] += extra(tip)["fz_N"]
    z_m, v = tip["z_m"] + 5e-6 * rng.standard_normal(len(t_s)), tip["vz_m_per_s"] + 2e-4 * rng.standard_normal(len(t_s))
    return Samples(t_s, z_cmd_m, z_m, v, wrench), cell


def test_a_linear_axis_without_tissue_is_healthy_by_its_own_simulator_alone() -> None:
    samples, cell = moved_axis(axis)
    assert diagnose([samples], cell, propose=False).verdict != "none"
    answer = diagnose([samples], cell, propose=False, simulators=[UserSimulator.of_function(axis, "axis")])
    assert answer.verdict == "none", answer.sentence


def test_friction_in_a_linear_axis_without_tissue_is_found() -> None:
    samples, cell = moved_axis(lambda tip: {"fz_N": axis(tip)["fz_N"] - 0.2 * np.tanh(tip["vz_m_per_s"] / 5e-4)}, seed=2)
    answer = diagnose([samples], cell, propose=False, simulators=[UserSimulator.of_function(axis, "axis")])
    assert [effect.id for effect in answer.effects] == ["cable.friction"], answer.sentence
    value, low, high = answer.effects[0].parameters["force_N"]
    assert low <= 0.2 <= high, (value, low, high)


def test_a_parameter_of_the_users_own_is_named_with_the_value_that_the_real_cell_has() -> None:
    def mine(motion: Mapping[str, Floats], joint_friction: float = 0.1, cogging: float = 0.25) -> dict[str, Floats]:
        wave_N = cogging * np.sin(2.0 * np.pi * motion["z_m"] / 0.016)
        return {"fz_N": wave_N - 0.8 * motion["az_m_per_s2"] - joint_friction * np.tanh(motion["vz_m_per_s"] / 2e-3)}

    parameters = {"joint_friction": (0.1, 0.0, 1.0), "cogging": (0.25, 0.0, 0.5)}
    for friction, expected in ((0.1, []), (0.25, ["simulator.joint_friction"])):
        samples, cell = moved_axis(lambda tip, friction=friction: mine(tip, friction))
        answer = palpd.diagnose(samples, cell, simulated=mine, parameters=parameters)
        assert [effect["id"] for effect in answer.to_json()["effects"]] == expected
    low, high = answer.to_json()["effects"][0]["parameters"]["value"]["ci95"]
    assert low <= 0.25 <= high
    assert "joint_friction of your simulator is not that of the real cell" in answer.sentence
    again = palpd.simulate(samples, answer.cell, simulated=mine, nominal=palpd.Cell(cell), parameters=parameters)
    assert float(np.std(again.samples.wrench[:, 2] - samples.wrench[:, 2])) < 0.052  # the noise is 0.05 N


def test_a_parameter_that_cannot_be_one_is_refused() -> None:
    samples, cell = moved_axis(axis)

    def refusal(simulated: object, limits: tuple[float, float, float]) -> str:
        with pytest.raises(BadInput) as error:
            palpd.diagnose(samples, cell, simulated=simulated, parameters={"stiffness": limits})  # type: ignore[arg-type]
        return str(error.value)

    output = {"t_s": samples.t_s, "fz_N": np.zeros(len(samples))}
    assert "parameters= are those of a function" in refusal(output, (0.0, -1.0, 1.0))
    assert "stiffness is 2 with limits 0 and 1" in refusal(axis, (2.0, 0.0, 1.0))
    assert "unexpected keyword argument 'stiffness'" in refusal(axis, (0.0, -1.0, 1.0))
    idle = lambda motion, stiffness=0.0: axis(motion)  # noqa: E731
    assert "stiffness from -1 to 1 changes no force of <lambda>" in refusal(idle, (0.0, -1.0, 1.0))


# palpd simulate


def test_a_simulation_is_the_users_output_and_what_the_cell_has_beyond_the_nominal(healthy: Samples) -> None:
    columns = {"t_s": healthy.t_s, "z_m": healthy.z_m, "vz_m_per_s": healthy.vz_m_per_s, "z_cmd_m": healthy.z_cmd_m}
    drift = stated().with_effects({"sensor.drift": {"rate_N_per_s": 0.02}})
    out = simulate_with(as_file(healthy), stated(), drift, columns, {**EFFECTS}, measured=True)  # type: ignore[arg-type]
    assert np.allclose(out["fz_N"], smooth(healthy)["fz_N"] + 0.02 * healthy.t_s, atol=1e-9)
    soft = stated().with_effects({"robot.compliance": {"stiffness_N_per_m": 3000.0}})
    with pytest.raises(BadInput, match=r"robot\.compliance changes the motion, and foam\.csv"):
        simulate_with(as_file(healthy), stated(), soft, columns, {**EFFECTS}, measured=True)  # type: ignore[arg-type]
    lag = stated().with_effects({"robot.lag": {"bandwidth_ratio": 0.5}})
    with pytest.raises(BadInput, match=r"robot\.lag changes the motion"):
        simulate_with(as_file(healthy), stated(), lag, columns, {**EFFECTS}, measured=False)  # type: ignore[arg-type]


# what does not fit


def refused(samples: Samples, **columns: Floats) -> str:
    """The sentence with which an output is refused."""
    output = smooth(samples) | columns
    with pytest.raises(RecordingError) as error:
        diagnosis_of(samples, UserSimulator.of_columns(output, samples.t_s, "foam.csv"))
    return str(error.value)


def test_an_output_in_other_units_or_with_another_sign_is_refused(healthy: Samples) -> None:
    output = smooth(healthy)
    assert "looks like mN, divide by 1000" in refused(healthy, fz_N=1e3 * output["fz_N"])
    assert "looks like kN, multiply by 1000" in refused(healthy, fz_N=1e-3 * output["fz_N"])
    assert "multiply fz_N of foam.csv by -1" in refused(healthy, fz_N=-output["fz_N"])
    assert "looks like mm, divide by 1000" in refused(healthy, z_m=1e3 * output["z_m"])
    assert "multiply z_m of foam.csv by -1" in refused(healthy, z_m=-output["z_m"])
    assert "the output is for another motion" in refused(healthy, z_m=np.roll(output["z_m"], 1300))


def test_an_output_of_another_length_is_interpolated_where_it_covers_the_recording(healthy: Samples) -> None:
    output = smooth(healthy)
    every = {name: values[::2] for name, values in output.items()}
    at = UserSimulator.of_columns(every, healthy.t_s, "foam.csv").run({})
    assert np.allclose(at["fz_N"][::2][:-1], output["fz_N"][::2][:-1])
    assert len(at["fz_N"]) == len(healthy)
    half = {name: values[: len(values) // 2] for name, values in output.items()}
    with pytest.raises(RecordingError, match=r"covers 0 s to .* expected all of it; simulate the whole motion"):
        UserSimulator.of_columns(half, healthy.t_s, "foam.csv")


def test_an_output_that_is_no_output_is_refused(healthy: Samples, tmp_path: Path) -> None:
    output = smooth(healthy)
    with pytest.raises(RecordingError, match="fz_N is nan in row 4"):
        UserSimulator.of_columns(output | {"fz_N": np.where(np.arange(len(healthy)) == 3, np.nan, 0.0)}, healthy.t_s, "foam.csv")
    (tmp_path / "foam.csv").write_text("t_s,force\n0,1\n1,2\n")
    with pytest.raises(RecordingError, match=r"foam\.csv: column fz_N is missing in row 0"):
        UserSimulator.of_file(tmp_path / "foam.csv", healthy.t_s)


def test_a_function_that_fails_is_one_sentence(healthy: Samples) -> None:
    def broken(motion: Mapping[str, Floats]) -> dict[str, Floats]:
        return {"fz_N": motion["depth_m"]}

    with pytest.raises(BadInput, match=r"the simulator broken failed on a motion of \d+ rows \(KeyError: 'depth_m'\)"):
        diagnosis_of(healthy, UserSimulator.of_function(broken, "broken"))
    short = UserSimulator.of_function(lambda motion: {"fz_N": motion["z_m"][:-1]}, "short")
    with pytest.raises(RecordingError, match=r"fz_N has the shape \(\d+,\) and the motion has \d+ rows"):
        diagnosis_of(healthy, short)
    without = UserSimulator.of_function(lambda motion: {"fx_N": motion["z_m"]}, "without")
    with pytest.raises(RecordingError, match="fz_N is needed"):
        diagnosis_of(healthy, without)


def notes_on(samples: Samples, fz_N: Floats) -> str:
    simulator = UserSimulator.of_columns(smooth(samples) | {"fz_N": fz_N}, samples.t_s, "foam.csv")
    source = nominal_source(make_problem([samples], stated(), simulators=[simulator]).recordings, stated(), EFFECTS)
    assert source is not None
    return " ".join(source.notes)


def test_a_force_with_gravity_is_noted_and_one_with_noise_or_steps_is_refused(healthy: Samples) -> None:
    fz_N = smooth(healthy)["fz_N"]
    assert not notes_on(healthy, fz_N)
    assert re.search(r"fz_N of foam\.csv begins -1\.9\d* N beside the recording", notes_on(healthy, fz_N - 1.96))
    noisy_N = fz_N + 0.05 * np.random.default_rng(9).standard_normal(len(fz_N))
    assert re.search(r"fz_N of foam\.csv has 0\.0[45]\d* N of noise", refused(healthy, fz_N=noisy_N))
    assert "fz_N of foam.csv stands on steps of 0.13 N" in refused(healthy, fz_N=np.rint(fz_N / 0.13) * 0.13)
