"""Cells with MuJoCo's physics: drawn the same twice, healthy within tolerance, and each effect where it belongs."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import optimize, signal

pytest.importorskip("mujoco", reason="MuJoCo is not installed; install the dev group to draw cells with its physics.")

from palpd.blind.detectability import COARSE_HZ
from palpd.blind.injected_cells import simulated_host
from palpd.blind.mujoco.cases import PlantedEffect, change_by
from palpd.blind.mujoco.effects import Values
from palpd.blind.mujoco.nominal import phase_of
from palpd.blind.mujoco.setup import StatedCell
from palpd.blind.mujoco_cells import (
    EFFECTS,
    LARGEST_FORCE_MISMATCH,
    MujocoCase,
    draw_case,
    draw_healthy,
    draw_mujoco,
    healthy_mismatch,
    sealed_truth,
)
from palpd.blind.recorded_cells import detectability_of
from palpd.blind.stated_cell import CHANNELS, PHASES
from palpd.blind.truth import CaseSpec
from palpd.cell.cell_file import cell_from
from palpd.recording.samples import Samples

SEED = 11
Floats = NDArray[np.float64]


@pytest.fixture(scope="module")
def slide() -> MujocoCase:
    """A healthy slide that presses on the tissue law of this code, with a filter and a fine resolution."""
    for index in range(40):
        case = draw_case(SEED, index, effects=[])
        plant, stated = case.healthy.plant, case.stated
        if (
            plant.rig == "slide"
            and not plant.engine_contact
            and stated.rate_Hz <= 500
            and stated.filter_cutoff_Hz
            and case.path.t_s[-1] < 45
        ):
            return case
    raise AssertionError("no such slide among forty cells")


@pytest.fixture(scope="module")
def arm() -> MujocoCase:
    """A healthy arm."""
    return next(case for case in (draw_case(SEED, index, effects=[]) for index in range(40)) if case.healthy.plant.rig == "arm")


def test_the_same_seed_gives_the_same_case_to_the_last_bit() -> None:
    one, two = (draw_case(SEED, 5, effects=["cable.friction", "sensor.dropout"]) for _ in range(2))
    for other in (False, True):
        assert np.array_equal(one.recording(other=other).wrench, two.recording(other=other).wrench)
        assert np.array_equal(one.recording(other=other).z_m, two.recording(other=other).z_m)
    assert sealed_truth(one) == sealed_truth(two)
    assert not np.array_equal(one.recording().wrench, draw_case(SEED, 6, effects=["cable.friction"]).recording().wrench)


def test_a_case_of_the_check_is_what_the_contract_asks_for_and_keeps_its_truth() -> None:
    case = draw_mujoco(CaseSpec("mujoco", 0, "library", ("sensor.gain",), "20-60"), 3)
    assert case.second is not None
    for samples in (case.samples, case.second):
        assert 20 <= samples.duration_s <= 120
    cell = cell_from(case.cell, "cell")
    assert cell.effects == {}
    assert case.samples.rate_Hz == pytest.approx(cell.sensor.rate_Hz)
    (effect,) = case.truth["effects"]
    assert (effect["id"], effect["law"]) == ("sensor.gain", "library")
    places = {(channel, phase): size for channel, row in case.truth["sizes"].items() for phase, size in row.items()}
    assert max(places, key=lambda place: places[place])[0] == "fz_N"
    assert case.truth["second"] is not None
    assert case.truth["second"]["change"]["fz_N"] > case.truth["second"]["floor"]["z_m"]


def test_the_ratio_of_an_effect_is_the_same_in_mujocos_own_yardstick_and_in_the_drawn_cells() -> None:
    """Both count the same recording in noise beside tolerances and press scatter, by code of their own."""
    case = draw_case(SEED, 90, effects=["sensor.creep"])
    here = detectability_of(case.stated.as_yaml(), case.reading([]).samples, COARSE_HZ, noise_free=True)
    own = sealed_truth(case)["effects"][0]["snr"]
    assert here.snr(change_by(case, case.planted)) == pytest.approx(own, rel=0.15)


def contract_prediction(samples: Samples, cell: StatedCell, d: Floats, case: MujocoCase) -> Floats:
    """(n, 7) the nominal physics of docs/reference/contract.md §3 with deviations d in standard deviations, for this test alone."""
    tolerance, step = cell.tolerances, 1 / cell.rate_Hz

    def filtered(b: list[float], a: list[float], values: Floats) -> Floats:
        discrete = signal.StateSpace(*signal.tf2ss(b, a)).to_discrete(step, method="foh")
        poles = np.poly(discrete.A)
        zeros = np.poly(discrete.A - discrete.B @ discrete.C) + (discrete.D[0, 0] - 1) * poles
        return values[0] + signal.lfilter(zeros, poles, values - values[0])

    press = np.searchsorted(case.path.edges_s, samples.t_s)
    surface = cell.surface_z_m + d[0] * tolerance.surface_z_m + case.path.surface_m[press]
    modulus = cell.youngs_modulus_Pa * (1 + d[1] * tolerance.youngs_modulus) * (1 + case.path.stiffness[press])
    depth = np.clip(surface - samples.z_m, 0, None)
    force = 4 / 3 * modulus / (1 - cell.poisson_ratio**2) * np.sqrt(cell.tip_radius_m) * depth**1.5
    force -= (cell.mass_kg + d[2] * tolerance.mass_kg) * np.gradient(samples.vz_m_per_s, samples.t_s)
    force *= 1 + d[3] * tolerance.gain
    leak = d[4:8] * tolerance.crosstalk * np.array([1, 1, 0.05, 0.05])
    wrench = np.column_stack([leak[0] * force, leak[1] * force, force, leak[2] * force, leak[3] * force, 0 * force])
    if cell.filter_cutoff_Hz:
        omega = 2 * np.pi * cell.filter_cutoff_Hz * (1 + d[8] * tolerance.filter_cutoff)
        wrench = np.column_stack([filtered([omega], [1, omega], column) for column in wrench.T])
    late = samples.t_s - d[9] * tolerance.latency_s
    wrench = np.column_stack([np.interp(late, samples.t_s, column) for column in wrench.T])
    wrench[:, 2] += d[10] * tolerance.bias_N + d[11] * tolerance.drift_N_per_min / 60 * samples.t_s
    omega = 2 * np.pi * cell.servo_natural_frequency_Hz * (1 + d[12] * tolerance.servo_natural_frequency)
    assert samples.z_cmd_m is not None
    z = filtered([omega**2], [1, 2 * cell.servo_damping_ratio * omega, omega**2], samples.z_cmd_m)
    return np.column_stack([z, wrench])


@pytest.mark.parametrize("index", [0, 1, 2, 3])
def test_a_healthy_cell_is_the_contracts_physics_within_tolerance_and_never_exactly(index: int) -> None:
    case = draw_case(SEED, 50 + index, effects=[])
    cell, samples = case.stated, case.reading([]).samples
    measured = np.column_stack([samples.z_m, samples.wrench])

    def misfit(d: Floats) -> Floats:
        return ((measured - contract_prediction(samples, cell, d, case)) / cell.sigma)[::5].ravel()

    exact = misfit(np.zeros(13)).reshape(-1, 7)
    fit = optimize.least_squares(lambda d: np.concatenate([misfit(d), d]), np.zeros(13))
    left = (measured - contract_prediction(samples, cell, fit.x, case)) / cell.sigma
    rms = np.sqrt((left**2).mean(axis=0))
    assert rms[0] < 0.6, f"z is {rms[0]:.2f} sigma off after the fit of the tolerances"
    assert np.all(rms[1:] < 0.35), f"the wrench is {rms[1:].max():.2f} sigma off after the fit of the tolerances"
    assert np.abs(fit.x).max() < 3.5, "a deviation of the fit is outside of its tolerance"
    assert np.sqrt((exact**2).mean()) > 1.2 * np.sqrt((left**2).mean()), "the cell sits on its nominal numbers"


def test_the_noise_of_a_healthy_recording_is_what_the_cell_file_states(slide: MujocoCase) -> None:
    noise = slide.recording().wrench - slide.reading().samples.wrench
    assert np.all(np.abs(noise.std(axis=0) / slide.stated.sigma[1:] - 1) < 0.25)


# id, parameters, channel, phase, sign of the mean change there (0: both signs occur)
PLACES: list[tuple[str, Values, str, str, int]] = [
    ("sensor.bias", {"offset_N": -0.2}, "fz_N", "free_still", -1),
    ("sensor.drift", {"rate_N_per_s": 0.01}, "fz_N", "free_still", 1),
    ("sensor.warmup", {"amplitude_N": 0.3, "tau_s": 4.0}, "fz_N", "free_still", 1),
    ("sensor.gain", {"error": -0.05}, "fz_N", "holding", -1),
    ("sensor.crosstalk", {"fx_per_fz": 0.1, "fy_per_fz": 0, "tx_per_fz_m": 0, "ty_per_fz_m": 0}, "fx_N", "holding", 1),
    ("sensor.filter", {"cutoff_Hz": 2.0}, "fz_N", "loading", -1),
    ("sensor.latency", {"delay_s": 0.05}, "fz_N", "unloading", 1),
    ("sensor.hysteresis", {"width_N": 0.2, "amplitude_N": 0.2}, "fz_N", "loading", 1),
    ("sensor.creep", {"ratio": 0.1, "tau_s": 1.0}, "fz_N", "holding", 1),
    ("sensor.saturation", {"limit_N": 0.3}, "fz_N", "holding", -1),
    ("sensor.asymmetry", {"ratio": 0.2, "at_N": 0.2, "side": 1.0}, "fz_N", "holding", 1),
    ("sensor.dropout", {"rate_Hz": 1.0, "length_s": 0.2, "seed": 1.0}, "fz_N", "loading", -1),
    ("clock.skew", {"ratio": 1e-3}, "fz_N", "unloading", -1),
    ("probe.mass", {"delta_kg": 0.4}, "fz_N", "free_moving", 0),
    ("probe.tilt", {"angle_rad": 0.1, "azimuth_rad": 0.0}, "fx_N", "holding", 1),
    ("cable.spring", {"stiffness_N_per_m": 20.0}, "fz_N", "holding", 1),
    ("cable.friction", {"force_N": 0.3}, "fz_N", "loading", 1),
    ("cable.viscous", {"coefficient_N_s_per_m": 20.0}, "fz_N", "unloading", -1),
    ("structure.resonance", {"frequency_Hz": 4.0, "damping_ratio": 0.02, "participation": 0.8}, "fz_N", "free_moving", 0),
    ("robot.lag", {"slowing": 0.3}, "z_m", "loading", 1),
    ("robot.compliance", {"stiffness_N_per_m": 3000.0}, "fz_N", "holding", -1),
    ("robot.backlash", {"width_m": 3e-4, "guide_friction_N": 10.0}, "fz_N", "loading", -1),
    ("robot.vibration", {"amplitude_m": 1e-4, "frequency_Hz": 4.0, "phase_rad": 0.0}, "z_m", "holding", 0),
    ("tissue.surface", {"offset_m": 3e-4}, "fz_N", "holding", 1),
    ("tissue.modulus", {"excess": -0.2}, "fz_N", "holding", -1),
    ("tissue.viscoelastic", {"stiffness_N_per_m": 100.0, "tau_s": 0.5}, "fz_N", "loading", 1),
    ("tissue.preconditioning", {"softening": 0.3}, "fz_N", "unloading", -1),
    ("tissue.adhesion", {"force_N": 0.3, "range_m": 1e-3}, "fz_N", "unloading", -1),
    ("tissue.thickness", {"thickness_m": 0.02}, "fz_N", "holding", 1),
    ("tissue.inclusion", {"contrast": 0.5, "depth_m": 2e-3}, "fz_N", "holding", 1),
    ("tissue.plasticity", {"set_m": 2e-4, "ratio": 0.9}, "fz_N", "holding", -1),
    ("contact.lateral", {"ratio": 0.2, "azimuth_rad": 0.0}, "ty_Nm", "holding", -1),
    ("mount.thermal_growth", {"growth_m": 3e-4, "tau_s": 10.0}, "fz_N", "holding", 1),
    ("drive.height_ripple", {"amplitude_m": 2e-4, "pitch_m": 1e-3, "phase_rad": 0.0}, "fz_N", "loading", 0),
    ("cable.height_friction", {"force_N": 0.5}, "fz_N", "loading", 1),
    ("guide.stick_slip", {"static_N": 0.4, "stretch_m": 5e-4, "kinetic_ratio": 0.3}, "fz_N", "loading", 1),
    ("contact.tip_slip", {"ratio": 0.2, "threshold_N": 0.3, "azimuth_rad": 0.0}, "fx_N", "holding", 1),
    ("mount.loose_screw", {"gap_m": 3e-4, "hold_down_N": 0.3}, "fz_N", "holding", -1),
    ("arm.flex_gravity", {"turn_rad_per_m": 5.0}, "fx_N", "loading", 0),
    ("cable.snag", {"stiffness_N_per_m": 300.0, "height_m": 0.0}, "fz_N", "holding", 1),
    ("tissue.poroelastic", {"ratio": 0.4, "diffusivity_m2_per_s": 2e-5}, "fz_N", "loading", 1),
    ("table.wobble", {"table_mass_kg": 15.0, "frequency_Hz": 3.0, "damping_ratio": 0.03}, "fz_N", "holding", -1),
    ("phantom.breathing", {"amplitude_m": 3e-4, "frequency_Hz": 0.3, "phase_rad": 0.0}, "fz_N", "holding", 0),
    ("sensor.speed_tone", {"amplitude_N": 0.3, "frequency_Hz": 8.0}, "fz_N", "free_moving", 0),
    ("sensor.temperature_step", {"offset_N": 0.3, "when": 0.4}, "fz_N", "free_still", 1),
    ("rig.knocks", {"force_N": 2.0, "seed": 2.0}, "fy_N", "", 0),
    ("sensor.random_walk", {"rate_N_per_sqrt_s": 0.1, "seed": 3.0}, "fz_N", "free_still", 0),
]


@pytest.mark.parametrize(("name", "values", "channel", "phase", "sign"), PLACES, ids=[place[0] for place in PLACES])
def test_an_effect_changes_what_it_should(slide: MujocoCase, name: str, values: Values, channel: str, phase: str, sign: int) -> None:
    if name == "cable.snag":
        values = values | {"height_m": slide.stated.surface_z_m}
    change = change_by(slide, [PlantedEffect(EFFECTS[name], values, 0.0)])
    phases = phase_of(slide.reading([]).samples, slide.stated)
    rows = np.ones(len(phases), dtype=bool) if not phase else phases == PHASES.index(phase)
    column = change[rows, CHANNELS.index(channel)]
    sigma = slide.stated.sigma[CHANNELS.index(channel)]
    rms = float(np.sqrt((column**2).mean()))
    assert rms > 0.05 * sigma, f"{name} moves {channel} by {rms / sigma:.3f} sigma"
    if sign:
        assert np.sign(column.mean()) == sign
        assert abs(column.mean()) > 0.1 * rms
    if name.startswith(("sensor.", "tissue.", "clock.")):
        assert np.abs(change[:, 0]).max() < 3 * slide.stated.sigma[0], "the robot's height is not touched but by its own stiffness"


def test_every_effect_has_a_place_and_enough_are_made() -> None:
    assert {place[0] for place in PLACES} == set(EFFECTS)
    assert sum(effect.listed for effect in EFFECTS.values()) >= 20
    assert sum(not effect.listed for effect in EFFECTS.values()) >= 8


def test_a_lateral_force_at_the_tip_gives_the_contracts_torques(slide: MujocoCase, arm: MujocoCase) -> None:
    for case in (slide, arm):
        values = {"ratio": 0.3, "azimuth_rad": 0.7}
        change = change_by(case, [PlantedEffect(EFFECTS["contact.lateral"], values, 0.0)])
        pressed = phase_of(case.reading([]).samples, case.stated) == PHASES.index("holding")
        fx, fy, tx, ty = (change[pressed, CHANNELS.index(name)].mean() for name in ("fx_N", "fy_N", "tx_Nm", "ty_Nm"))
        assert fy / fx == pytest.approx(np.tan(0.7), rel=0.02)
        assert tx == pytest.approx(fy * case.stated.tip_length_m, rel=0.02)
        assert ty == pytest.approx(-fx * case.stated.tip_length_m, rel=0.02)


@pytest.mark.parametrize("name", ["sensor.creep", "cable.viscous", "tissue.adhesion", "cable.friction"])
def test_the_size_of_an_effect_gives_the_ratio_that_was_drawn(name: str) -> None:
    case = draw_case(SEED, 90, effects=[name])
    (planted,) = case.planted
    assert 4 <= planted.sought_snr <= 60
    scale = case.yardstick()
    change = scale.whitened(change_by(case, case.planted))
    directions = np.column_stack([scale.whitened(direction) for direction in scale.directions])
    both = np.vstack([directions, np.eye(directions.shape[1])])
    aim = np.concatenate([change, np.zeros(directions.shape[1])])
    left = aim - both @ np.linalg.lstsq(both, aim, rcond=None)[0]
    assert np.linalg.norm(left) == pytest.approx(planted.sought_snr, rel=0.1)
    assert sealed_truth(case)["effects"][0]["snr"] == pytest.approx(float(np.linalg.norm(left)), rel=1e-3)


def test_switching_off_all_effects_of_a_pair_leaves_the_healthy_reading() -> None:
    case = draw_case(SEED, 60, effects=["tissue.modulus", "sensor.bias"])
    planted = {each.effect.id: each for each in case.planted}
    without_bias = case.reading([planted["tissue.modulus"]], other=True).samples
    with_all = case.reading(other=True).samples
    bias = planted["sensor.bias"].values["offset_N"]
    assert np.allclose(with_all.wrench[:, 2] - without_bias.wrench[:, 2], bias)
    assert np.array_equal(with_all.z_m, without_bias.z_m)
    healthy = case.reading([], other=True).samples
    without_modulus = case.reading([planted["sensor.bias"]], other=True).samples
    assert np.allclose(without_modulus.wrench[:, 2], healthy.wrench[:, 2] + bias)


def test_a_host_whose_forces_are_not_within_tolerance_is_drawn_again() -> None:
    seed, index = 3490631021, 51  # a cell with the engine's own soft contact

    def mismatch(case: MujocoCase) -> float:
        return float(healthy_mismatch(case, case.yardstick())["snr_of_forces"])

    assert mismatch(draw_case(seed, index, effects=[])) > LARGEST_FORCE_MISMATCH
    healthy = draw_healthy(seed, index)
    assert mismatch(healthy) <= LARGEST_FORCE_MISMATCH
    assert simulated_host(seed, index).content == healthy.stated.as_yaml()
