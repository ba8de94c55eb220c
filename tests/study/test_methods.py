"""Methods of compensation: causal, learn mass and bias, stand still under contact; on the emulated cell with the paper's sensor."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.compensation_methods import LinearModel, methods
from benchmarks.recurrent_method import Recurrent
from palpd.cell.cell_file import TissueBlock
from palpd.cell.motion_profile import Move, commanded_heights
from palpd.study.laboratory import STEP_S, Take, free_cell, setup, take
from palpd.study.methods import LinearModelWithRunningZero, Method, NoCorrection, corrections, features, stream

CELL = setup("A")
BIAS = {"sensor.bias": {"offset_N": 0.19}}
CYCLE = [Move(0.03, 0.02, 0.5), *[Move(0.03 + way, 0.05, 0.3) for _ in range(8) for way in (0.02, 0.0)]]


@pytest.fixture(scope="module")
def learned() -> list[Take]:
    return [take(free_cell(CELL, BIAS), commanded_heights(0.03, CYCLE, STEP_S)[0], seed) for seed in (1, 2)]


@pytest.fixture(scope="module")
def fitted(learned: list[Take]) -> list[Method]:
    compared = [*methods(), Recurrent(zero=True)]
    for method in compared:
        method.fit(learned)
    return compared


def other_day(offset_N: float, seed: int = 7) -> Take:
    return take(free_cell(CELL, {"sensor.bias": {"offset_N": offset_N}}), commanded_heights(0.03, CYCLE[:9], STEP_S)[0], seed)


def pressed(seed: int = 9) -> Take:
    cell = CELL.model_copy(update={"tissue": TissueBlock(youngs_modulus_Pa=8e4), "effects": {"sensor.bias": {"offset_N": 0.25}}})
    moves = [Move(0.008, 0.02, 1.0), Move(-0.004, 0.02, 3.0), Move(0.008, 0.02, 1.0)]
    return take(cell, commanded_heights(0.008, moves, STEP_S)[0], seed)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_no_method_sees_the_future(fitted: list[Method]) -> None:
    whole = pressed()
    cut = len(whole.t_s) // 2
    states = cut // 4 + 1
    arrays = [name for name in Take.__slots__ if name != "clear_z_m"]
    part = replace(whole, **{n: getattr(whole, n)[: states if n.startswith(("robot", "target", "tool")) else cut] for n in arrays})
    for method in fitted:
        early = cut - 12  # the last tick of the part is incomplete
        np.testing.assert_array_equal(corrections(method, whole)[:early], corrections(method, part)[:early], err_msg=method.name)


def test_every_method_but_none_takes_away_bias_and_inertia_on_the_day_it_learned(fitted: list[Method]) -> None:
    run = other_day(0.19)
    for method in fitted:
        left_N = rms(run.fz_N - corrections(method, run))
        if type(method) is NoCorrection:
            assert left_N > 0.15
        else:
            assert left_N < (0.12 if method.name == "bias only" else 0.075), method.name


def test_a_learned_bias_fails_on_another_day_and_a_running_zero_does_not(fitted: list[Method]) -> None:
    run = other_day(0.3)
    left_N = {method.name: rms(run.fz_N - corrections(method, run)) for method in fitted}
    assert left_N["m·a + bias"] > 0.11
    assert left_N["2-10-1 network (the paper's)"] > 0.11
    for name in ("m·a + running zero", "recursive instrumental variables", "extended Kalman", "unscented Kalman + accelerometer"):
        assert left_N[name] < 0.07, name


def test_the_mass_found_is_the_probes(learned: list[Take]) -> None:
    line = LinearModel()
    line.fit(learned)
    assert line.mass_kg == pytest.approx(0.2, abs=0.015)


def test_the_exported_recurrent_network_gives_the_fitted_force(learned: list[Take]) -> None:
    network = Recurrent(zero=False)
    network.fit(learned[:1])
    run = other_day(0.19)
    motion = features(run.robot_t_s, run.robot_vz_m_per_s, run.t_s)[:500]
    fitted_N = network._regressors(motion) @ network._readout + network._bias_N
    network.start()
    network_N = [network.step(sample) for sample, _ in zip(stream(run), range(500), strict=False)]
    assert np.abs(np.array(network_N) - fitted_N).max() < 1e-4


def test_a_running_zero_does_not_learn_the_contact_away(learned: list[Take]) -> None:
    run = pressed()
    method = LinearModelWithRunningZero()
    method.fit(learned)
    held = (run.t_s > 2.5) & (run.t_s < 4.0)
    assert run.contact_N[held].min() > 1.5
    assert rms((run.fz_N - corrections(method, run) - run.contact_N)[held]) < 0.08
    assert float(np.mean((run.fz_N - corrections(method, run) - run.contact_N)[held])) == pytest.approx(0.0, abs=0.04)


def test_features_are_those_of_the_loop() -> None:
    run = other_day(0.0)
    seen = features(run.robot_t_s, run.robot_vz_m_per_s, run.t_s)
    assert seen.shape == (len(run.t_s), 2)
    assert rms(seen[:, 0] - np.interp(run.t_s - 0.0106, run.t_s, run.vz_m_per_s)) < 2e-3
    assert [sample.az_m_per_s2 for sample in stream(run)][::500] == pytest.approx(seen[::500, 1].tolist())
