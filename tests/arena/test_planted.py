"""Each law of the arena does what docs/reference/contract.md says of its effect, at an SNR that was asked for."""

from itertools import accumulate

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from palpd.arena.plant import beside_each_other, times_usual
from palpd.arena.planted import LAWS, PlantingRefusedError, noise_N, plant
from palpd.arena.signals import FloatArray, Recording, rounding_step, snr_against

STEP_N = 0.02
T = np.arange(1000) / 50
SPEED = -0.004 * np.pi / 2 * np.sin(np.pi * T / 2)


def recording(sigma_N: float = 0.0, step_N: float = 0.0, z_noise_m: float = 0.0) -> dict[str, FloatArray]:
    """Five presses of 4 s, 4 mm deep, on a spring of 500 N/m whose surface is at 0."""
    rng = np.random.default_rng(7)
    z_m = 0.004 * np.cos(np.pi * T / 2)
    fz_N = 500 * np.maximum(-z_m, 0) + sigma_N * rng.normal(size=len(T))
    fz_N = step_N * np.rint(fz_N / step_N) if step_N else fz_N
    return {"t_s": T, "z_m": z_m + z_noise_m * rng.normal(size=len(T)), "z_cmd_m": z_m, "fz_N": fz_N, "surface_z_m": np.zeros(len(T))}


CLEAN, NOISY, RAMP = recording(), recording(0.03, STEP_N, 2e-6), {"t_s": T, "z_m": -0.001 * T, "fz_N": 3 * T}
Z, F = CLEAN["z_m"], CLEAN["fz_N"]


@pytest.mark.parametrize(
    ("law", "parameters", "source", "expected", "close"),
    [
        ("sensor.bias", {"offset_N": 0.3}, CLEAN, F + 0.3, 1e-9),
        ("sensor.drift", {"rate_N_per_s": -0.1}, CLEAN, F - 0.1 * T, 1e-9),
        ("sensor.warmup", {"amplitude_N": 0.5, "tau_s": 2.0}, CLEAN, F + 0.5 * (1 - np.exp(-T / 2)), 1e-9),
        ("sensor.gain", {"error": 0.1}, CLEAN, 1.1 * F, 1e-9),
        ("sensor.asymmetry", {"ratio": 0.2, "at_N": 1.0, "side": 1.0}, CLEAN, F + 0.2 * np.maximum(0, F - 1), 1e-9),
        ("sensor.asymmetry", {"ratio": 0.2, "at_N": 1.0, "side": -1.0}, CLEAN, F + 0.2 * np.minimum(F, 1), 1e-9),
        ("sensor.saturation", {"limit_N": 1.5}, CLEAN, np.minimum(F, 1.5), 1e-9),
        ("sensor.filter", {"cutoff_Hz": 1.0}, RAMP, 3 * (T - (1 - np.exp(-2 * np.pi * T)) / (2 * np.pi)), 1e-3),
        ("sensor.latency", {"delay_s": 0.031}, RAMP, np.where(T >= 0.031, 3 * (T - 0.031), np.nan), 0.03),
        ("sensor.latency", {"delay_s": -0.02}, CLEAN, np.append(F[1:], np.nan), 1e-9),
        ("clock.skew", {"ratio": -0.01}, RAMP, 3 * T * 0.99, 0.03),
        ("cable.spring", {"stiffness_N_per_m": 50.0}, CLEAN, F - 50 * (Z - Z[0]), 1e-3),
        ("cable.viscous", {"coefficient_N_s_per_m": 20.0}, CLEAN, F - 20 * SPEED, 2e-3),
        ("probe.mass", {"delta_kg": 5.0}, CLEAN, F + 5 * (np.pi / 2) ** 2 * Z, 5e-3),
        ("tissue.modulus", {"ratio": 1.3}, CLEAN, 1.3 * F, 0.02),
        ("tissue.inclusion", {"contrast": 0.5, "depth_m": 0.004}, CLEAN, F * (1 + 0.5 * Z**2 / (Z**2 + 0.004**2)), 0.02),
    ],
)
def test_a_law_follows_its_formula(law: str, parameters: dict[str, float], source: Recording, expected: FloatArray, close: float) -> None:
    np.testing.assert_allclose(LAWS[law].apply(source, parameters)["fz_N"], expected, atol=close)


def test_laws_with_a_memory_act_in_the_direction_that_the_contract_states() -> None:
    middle = np.abs(np.sin(np.pi * T / 2)) > 0.5
    for presliding in ({}, {"presliding_m": 2e-5}):
        change = LAWS["cable.friction"].apply(CLEAN, {"force_N": 0.2, **presliding})["fz_N"] - F
        np.testing.assert_allclose(change[middle], -0.2 * np.sign(SPEED[middle]), atol=0.01)
    middle = np.abs(F - 1) < 0.2
    change = LAWS["sensor.hysteresis"].apply(CLEAN, {"amplitude_N": 0.1, "width_N": 0.05})["fz_N"] - F
    np.testing.assert_allclose(change[middle], -0.1 * np.sign(SPEED[middle]), atol=1e-3)
    softer = LAWS["tissue.preconditioning"].apply(CLEAN, {"softening": 0.3})["fz_N"]
    assert np.abs(softer - F)[:100].max() < 1e-3
    assert softer[266] == pytest.approx(F[266] * (1 - 0.3 * (1 - (Z[266] / 0.004) ** 2)), abs=0.01)
    hold = {**CLEAN, "fz_N": 2 * np.clip(5 * T - 10, 0, 1), "z_m": 0.001 - 0.005 * np.clip(5 * T - 10, 0, 1)}
    crept = LAWS["sensor.creep"].apply(hold, {"ratio": 0.1, "tau_s": 1.0})["fz_N"][112:]
    relaxed = LAWS["tissue.viscoelastic"].apply(hold, {"ratio": 0.4, "tau_s": 1.0})["fz_N"][112:]
    assert min(np.diff(crept)) >= 0 >= max(np.diff(relaxed))
    assert [crept[0], crept[-1], relaxed[0], relaxed[-1]] == pytest.approx([2, 2.2, 2.7, 2], abs=0.06)


def test_laws_of_the_tip_move_the_reported_and_commanded_height_and_keep_the_force() -> None:
    compliant = LAWS["robot.compliance"].apply(CLEAN, {"stiffness_N_per_m": 4000.0})
    np.testing.assert_allclose(compliant["z_m"] + F / 4000, Z, atol=2e-6)
    assert compliant.keys() == {"z_m", "z_cmd_m"}
    np.testing.assert_allclose(LAWS["tissue.surface"].apply(CLEAN, {"offset_m": 1e-4})["z_m"], Z + 1e-4)
    reported = LAWS["robot.backlash"].apply(CLEAN, {"width_m": 2e-4})["z_m"]
    tip = list(accumulate(reported, lambda tip_m, z_m: min(max(tip_m, z_m - 2e-4), z_m)))  # rests until z has moved by the width against it
    np.testing.assert_allclose(tip, Z, atol=4.1e-5)


@pytest.mark.parametrize("law", LAWS)
@threadpool_limits.wrap(limits=1)
def test_a_law_is_planted_at_the_snr_and_on_the_steps_of_the_recording(law: str) -> None:
    planted = plant(NOISY, law, np.random.default_rng(3), (8, 12))
    assert 8 <= planted.snr <= 12
    assert rounding_step(planted.columns["fz_N"]) == pytest.approx(STEP_N)
    assert noise_N(planted.columns) == pytest.approx(noise_N(NOISY), rel=0.25)
    chosen, snr_of = LAWS[law], snr_against(CLEAN, sigma_N=0.03)
    sizes = [{**planted.parameters, chosen.size: chosen.resize(planted.parameters[chosen.size], share)} for share in (1e-6, 0.3, 1)]
    none, small, full = (snr_of({**CLEAN, **chosen.apply(CLEAN, size)}) for size in sizes)
    assert none < 0.1
    assert none <= small < full


def test_a_seed_gives_the_same_recording_and_a_row_without_change_stays() -> None:
    first, again = (plant(NOISY, "sensor.saturation", np.random.default_rng(5), (8, 12)) for _ in range(2))
    assert all(np.array_equal(first.columns[name], again.columns[name]) for name in NOISY)
    low = NOISY["fz_N"] < first.parameters["limit_N"] - STEP_N
    assert np.array_equal(first.columns["fz_N"][low], NOISY["fz_N"][low])


def test_snr_is_in_standard_deviations_and_at_most_one_within_a_tolerance() -> None:
    in_free_air = {name: CLEAN[name] for name in ("t_s", "z_m", "fz_N")}  # neither tissue nor presses, whose tolerances would cover a gain
    assert snr_against(in_free_air, sigma_N=1e-3)({**in_free_air, "fz_N": 1.005 * F}) == pytest.approx(1, abs=0.3)
    assert snr_against(CLEAN, sigma_N=1e-3)({**CLEAN, "fz_N": F + 0.004}) == pytest.approx(10, abs=0.5)
    assert snr_against(CLEAN, sigma_N=0.01)({**CLEAN, "fz_N": F + 0.01 * np.sin(9 * T)}) == pytest.approx(np.sqrt(500), rel=0.02)
    assert noise_N(recording(0.03)) == pytest.approx(0.03, rel=0.1)
    assert noise_N(recording(1e-5, STEP_N)) == pytest.approx(STEP_N / np.sqrt(12))


def test_what_cannot_be_planted_is_refused() -> None:
    bare = {name: NOISY[name] for name in ("t_s", "z_m", "fz_N")}
    still = bare | {"z_m": NOISY["z_m"] - Z}
    nowhere = {**NOISY, "surface_z_m": np.full(len(T), -1.0)}
    cases = [(bare, "tissue.modulus", 8, "needs surface_z_m"), (nowhere, "tissue.modulus", 8, "no height is below")]
    for source, law, low, reason in [*cases, (bare, "sensor.creep", 1e5, "SNR of"), (still, "probe.mass", 8, "correlate")]:
        with pytest.raises(PlantingRefusedError, match=reason):
            plant(source, law, np.random.default_rng(0), (low, 2 * low))


def test_an_effect_that_the_healthy_recordings_show_of_themselves_is_as_large_as_usual() -> None:
    rubbing = beside_each_other(
        [{**NOISY, "vz_m_per_s": SPEED, "fz_N": NOISY["fz_N"] - force_N * np.sign(SPEED)} for force_N in (0.9, 1.0, 1.1, 1.0)]
    )
    once, thrice = (times_usual("cable.friction", {"force_N": force_N, "presliding_m": 1e-5}, rubbing) for force_N in (0.1, 0.3))
    # beside the mean of the others 0.9 and 1.1 N are off by 0.13 N each, the two in the middle by none: 0.094 N in the mean square
    assert once == pytest.approx(0.1 / 0.094, rel=0.1)
    assert thrice == pytest.approx(3 * once, rel=0.05)
    assert times_usual("sensor.bias", {"offset_N": 1.0}, rubbing) > 30
