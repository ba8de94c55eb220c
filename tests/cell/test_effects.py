"""Every effect: its law against values by hand, that no parameter is dead, and that it is the same step by step and at once."""

import re
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from palpd.cell.cell_file import CellFile, cell_from, nominal
from palpd.cell.dynamics import Floats
from palpd.cell.effects import EFFECTS, Effect, Parameter, Scale, load_effects
from palpd.cell.effects.tissue import dimitriadis
from palpd.cell.physics import true_surface_m
from palpd.cell.simulation import commanded_motion, equilibrium_force_N, predict_motion, scale_of, simulate, wrench_of
from palpd.cell.span import TipMotion
from palpd.cell.stepped import SteppedCell
from palpd.cell.tip_motion import estimate_tip_motion
from palpd.errors import ConfigError
from tests.paths import EXAMPLE

LISTED = [
    "sensor.bias",
    "sensor.drift",
    "sensor.warmup",
    "sensor.gain",
    "sensor.crosstalk",
    "sensor.filter",
    "sensor.latency",
    "sensor.hysteresis",
    "sensor.creep",
    "sensor.quantization",
    "sensor.noise",
    "sensor.saturation",
    "sensor.asymmetry",
    "sensor.dropout",
    "clock.skew",
    "probe.mass",
    "probe.tilt",
    "cable.spring",
    "cable.friction",
    "cable.viscous",
    "structure.resonance",
    "robot.lag",
    "robot.compliance",
    "robot.backlash",
    "robot.vibration",
    "tissue.surface",
    "tissue.modulus",
    "tissue.viscoelastic",
    "tissue.preconditioning",
    "tissue.adhesion",
    "tissue.thickness",
    "tissue.inclusion",
    "tissue.plasticity",
    "contact.lateral",
]
ALL = pytest.mark.parametrize("name", LISTED)


def still_cell(**blocks: object) -> CellFile:
    """A cell without noise and without a filter."""
    quiet: dict[str, object] = {
        "sensor": {"noise_rms_N": 1e-15, "noise_rms_Nm": 0.0, "filter_cutoff_Hz": None},
        "robot": {"position_noise_rms_m": 0.0, "velocity_noise_rms_m_per_s": 0.0},
    }
    return cell_from(quiet | blocks, "cell")


def presses(rate_Hz: float = 1000.0) -> tuple[Floats, Floats]:
    """Commanded heights over 8 s: free motion, then three presses that are not alike."""
    t_s = np.arange(int(8 * rate_Hz)) / rate_Hz
    knots_s = [0, 0.2, 0.5, 0.9, 1.6, 2.4, 2.9, 3.3, 4.0, 4.5, 5.4, 6.3, 6.7, 7.3, 8.0]
    heights_mm = [3, 3, 9, 3, -3, -3, 3, 3, -4, 2, -3.2, -3.2, -1, 3, 3]
    return t_s, np.interp(t_s, knots_s, heights_mm) * 1e-3


T_S, Z_CMD_M = presses()
MOTION = commanded_motion(still_cell(), T_S, Z_CMD_M)
PLAIN = wrench_of(still_cell(), MOTION)
SCALE = scale_of(nominal(), T_S, MOTION.z_m, MOTION.vz_m_per_s, PLAIN[:, 2])


def typical(effect: Effect) -> dict[str, float]:
    """The values at which a fit of the effect starts."""
    return {parameter.name: parameter.starts(SCALE)[0] for parameter in effect.parameters}


def felt(cell: CellFile, motion: TipMotion = MOTION) -> Floats:
    """fz of a cell during a motion."""
    return wrench_of(cell, motion)[:, 2]


def with_(name: str, **values: float) -> CellFile:
    return still_cell().with_effects({name: values})


def ramp(*knots: tuple[float, float], rate_Hz: float = 1000.0) -> TipMotion:
    """A motion straight between (time in s, height in mm), without inertia."""
    t_s = np.arange(int(knots[-1][0] * rate_Hz) + 1) / rate_Hz
    z_m = np.interp(t_s, [t for t, _ in knots], [z * 1e-3 for _, z in knots])
    return TipMotion(t_s, z_m, np.gradient(z_m, t_s), np.zeros_like(t_s))


# all of them


def test_the_library_is_the_whole_list() -> None:
    assert sorted(EFFECTS) == sorted(LISTED)
    assert all(name == effect.id for name, effect in EFFECTS.items())


@ALL
def test_no_parameter_is_dead(name: str) -> None:
    effect = EFFECTS[name]

    def everything(values: dict[str, float]) -> Floats:
        cell = nominal().with_effects({name: values})
        columns = simulate(cell, T_S, z_cmd_m=Z_CMD_M, noise_seed=1)
        return np.concatenate([predict_motion(cell, T_S, Z_CMD_M), wrench_of(cell, MOTION).ravel(), *columns.values()])

    values = {"rate_Hz": 30.0, "length_s": 0.01} if name == "sensor.dropout" else typical(effect)
    there = everything(values)
    assert (there != simulate_nominal()).any()
    for parameter in effect.parameters:
        other = values[parameter.name] * 1.4 + (0.3 if parameter.unit == "rad" else 0.0)
        moved = values | {parameter.name: parameter.choices[-1] if parameter.choices else other}
        assert np.abs(everything(moved) - there).max() > 1e-6, parameter.name


def simulate_nominal() -> Floats:
    columns = simulate(nominal(), T_S, z_cmd_m=Z_CMD_M, noise_seed=1)
    return np.concatenate([predict_motion(nominal(), T_S, Z_CMD_M), wrench_of(nominal(), MOTION).ravel(), *columns.values()])


@ALL
def test_at_its_nominal_value_an_effect_is_not_there(name: str) -> None:
    effect = EFFECTS[name]
    values = typical(effect)
    values |= {p.name: nothing for p in effect.parameters if (nothing := p.nominal_value(SCALE)) is not None}
    values = {p.name: values[p.name] for p in effect.parameters if not p.optional}
    assert values != typical(effect)
    cell = nominal().with_effects({name: values})
    np.testing.assert_allclose(wrench_of(cell, MOTION), wrench_of(nominal(), MOTION), atol=1e-12)
    np.testing.assert_allclose(predict_motion(cell, T_S, Z_CMD_M), MOTION.z_m, atol=1e-15)
    ours, theirs = (simulate(c, T_S, z_cmd_m=Z_CMD_M, noise_seed=1)["fz_N"] for c in (cell, nominal()))
    assert np.mean(ours == theirs) > 0.999


DIFFERENT_BY_NATURE = ("sensor.dropout",)
"""Drawn at random."""


@pytest.mark.parametrize("name", [name for name in LISTED if name not in DIFFERENT_BY_NATURE])
def test_an_effect_is_the_same_step_by_step_and_at_once(name: str) -> None:
    values = typical(EFFECTS[name])
    if name == "clock.skew":
        values["ratio"] = -abs(values["ratio"])
    cell = still_cell(sensor={"noise_rms_N": 1e-15, "noise_rms_Nm": 0.0}).with_effects({name: values})
    compare_step_by_step(cell)


def test_all_effects_together_are_the_same_step_by_step_and_at_once() -> None:
    values = {name: typical(EFFECTS[name]) for name in LISTED if name not in (*DIFFERENT_BY_NATURE, "sensor.quantization")}
    values["clock.skew"]["ratio"] = -1e-3
    compare_step_by_step(still_cell(sensor={"noise_rms_N": 1e-15, "noise_rms_Nm": 0.0}).with_effects(values), atol=1e-8)


def compare_step_by_step(cell: CellFile, atol: float = 1e-9) -> None:
    one = SteppedCell(cell, step_s=0.001)
    one.begin()
    readings, heights, k = [], [], 0
    while k < len(T_S):
        n = (1, 1, 4, 8, 2, 30)[len(readings) % 6]
        target = np.zeros((len(T_S[k : k + n]), 3))
        target[:, 2] = Z_CMD_M[k : k + n]
        block = one.step(target)
        readings.append(block.wrench)
        heights.append(block.position_m[:, 2])
        k += n
    columns = simulate(cell, T_S, z_cmd_m=Z_CMD_M)
    np.testing.assert_allclose(np.concatenate(heights), columns["z_m"], atol=1e-12)
    for axis, column in enumerate(("fx_N", "fy_N", "fz_N", "tx_Nm", "ty_Nm", "tz_Nm")):
        np.testing.assert_allclose(np.concatenate(readings)[:, axis], columns[column], atol=atol, err_msg=column)


@ALL
def test_starts_lie_within_bounds_and_bounds_are_a_range(name: str) -> None:
    for parameter in EFFECTS[name].parameters:
        lower, upper = parameter.bounds(SCALE)
        assert np.isfinite([lower, upper]).all()
        assert lower < upper
        assert all(lower <= start <= upper for start in parameter.starts(SCALE))
        if parameter.log:
            assert lower > 0.0


POWERS = {  # of length, force and time in each unit
    "1": (0, 0, 0),
    "rad": (0, 0, 0),
    "m": (1, 0, 0),
    "N": (0, 1, 0),
    "s": (0, 0, 1),
    "Hz": (0, 0, -1),
    "N/m": (-1, 1, 0),
    "N s/m": (-1, 1, 1),
    "N/s": (0, 1, -1),
    "kg": (-1, 1, 2),
}


@ALL
def test_bounds_and_starts_scale_with_the_cell(name: str) -> None:
    longer, stronger, slower = 1e-3, 1e-6, 7.0
    of_field = {"force_N": "N", "noise_N": "N", "speed_m_per_s": None, "mass_kg": "kg", "cutoff_Hz": "Hz"}

    def factor(unit: str) -> float:
        length, force, time = POWERS[unit]
        return longer**length * stronger**force * slower**time

    scaled = {}
    for field in fields(Scale):
        unit = of_field.get(field.name, "Hz" if field.name.endswith("_Hz") else "s" if field.name.endswith("_s") else "m")
        scaled[field.name] = getattr(SCALE, field.name) * (longer / slower if unit is None else factor(unit))
    small = Scale(**scaled)
    for parameter in EFFECTS[name].parameters:
        expected = np.array(parameter.bounds(SCALE)) * factor(parameter.unit)
        np.testing.assert_allclose(parameter.bounds(small), expected, rtol=1e-9)
        np.testing.assert_allclose(parameter.starts(small), np.array(parameter.starts(SCALE)) * factor(parameter.unit), rtol=1e-9)


def test_effects_that_count_from_the_first_row_are_absent_before_it() -> None:
    for effect in EFFECTS.values():
        if effect.starts_at_tare:
            one, other = SteppedCell(still_cell().with_effects({effect.id: typical(effect)})), SteppedCell(still_cell())
            target = np.stack([0 * T_S, 0 * T_S, Z_CMD_M], axis=1)[:4000]
            np.testing.assert_array_equal(one.step(target).wrench, other.step(target).wrench)


# robot and tip


def test_a_servo_of_half_the_bandwidth_is_a_servo_of_half_the_frequency() -> None:
    slow = predict_motion(with_("robot.lag", bandwidth_ratio=0.5), T_S, Z_CMD_M)
    robot = {"servo_natural_frequency_Hz": 4.0}
    np.testing.assert_array_equal(slow, predict_motion(still_cell(robot=robot), T_S, Z_CMD_M))


def test_a_vibration_is_reported_with_its_speed_and_pushes_the_probe() -> None:
    cell = with_("robot.vibration", amplitude_m=1e-4, frequency_Hz=10.0, phase_rad=0.5)
    motion = commanded_motion(cell, T_S, Z_CMD_M)
    np.testing.assert_allclose(motion.z_m - MOTION.z_m, 1e-4 * np.sin(20 * np.pi * T_S + 0.5), atol=1e-12)
    np.testing.assert_allclose(np.gradient(motion.z_m, T_S)[2000:2400], motion.vz_m_per_s[2000:2400], atol=1e-5)
    free = simulate(cell, T_S, z_cmd_m=Z_CMD_M * 0 + 0.01)["fz_N"]
    assert free.max() == pytest.approx(0.2 * 1e-4 * (20 * np.pi) ** 2, rel=1e-3)


def test_backlash_holds_the_tip_at_a_reversal_for_its_width() -> None:
    motion = ramp((0, -1.0), (1, -3.0), (2, -1.0))
    depth_m = np.cbrt((felt(with_("robot.backlash", width_m=2e-4), motion) / equilibrium_force_N(still_cell(), 1.0)) ** 2)
    np.testing.assert_allclose(depth_m[500], 0.0019, atol=1e-9)
    np.testing.assert_allclose(depth_m[1000:1100], 0.0029, atol=1e-9)
    np.testing.assert_allclose(depth_m[1500], 0.0021, atol=1e-9)


def test_backlash_does_not_swallow_the_noise_of_the_heights() -> None:
    """Else a narrow dead band would bring any prediction nearer to the readings, and healthy cells would have one."""
    t_s = np.arange(5000) / 500
    z_cmd_m = np.interp(t_s, [0, 1, 2, 8, 9], [0.003, 0.003, -0.003, -0.003, 0.003])
    noisy = simulate(nominal(), t_s, z_cmd_m=z_cmd_m, noise_seed=2)
    motion = estimate_tip_motion(nominal(), t_s, noisy["z_m"], noisy["vz_m_per_s"], z_cmd_m)
    holding = slice(1500, 3500)  # only noise moves the prediction there
    narrow_N = felt(with_("robot.backlash", width_m=2e-5), motion)[holding]
    assert np.std(narrow_N) == pytest.approx(np.std(felt(still_cell(), motion)[holding]), rel=0.1)


def test_a_compliant_tip_stands_where_both_forces_agree() -> None:
    cell = with_("robot.compliance", stiffness_N_per_m=2000.0)
    depth_m = np.linspace(0.0, 0.004, 300)
    motion = TipMotion(np.arange(300) / 100, -depth_m, 0 * depth_m, 0 * depth_m)
    force_N = felt(cell, motion)
    given_way_m = force_N / 2000.0
    np.testing.assert_allclose(force_N, equilibrium_force_N(cell, 1.0) * (depth_m - given_way_m) ** 1.5, rtol=1e-9, atol=1e-12)
    assert given_way_m.max() > 5e-4


def test_a_compliant_tip_on_a_plate_lets_go_along_the_way_it_was_pressed() -> None:
    """A plate's force is there within a micrometre, so a force that is asked for in the air misses it by thousands of newtons."""
    cell = with_("robot.compliance", stiffness_N_per_m=1e5)
    cell = cell.model_copy(update={"tissue": cell.tissue.model_copy(update={"youngs_modulus_Pa": 5e11})})
    one = SteppedCell(cell)
    one.begin()
    z_m = np.concatenate([np.full(400, -1e-4), np.linspace(-1e-4, 1e-4, 200)]).reshape(-1, 8)
    blocks = [one.step(np.stack([0 * each, 0 * each, each], axis=1)) for each in z_m]
    force_N = np.concatenate([block.contact_N for block in blocks])
    given_way_m = np.concatenate([block.tip_m[:, 2] - block.position_m[:, 2] for block in blocks])
    np.testing.assert_allclose(force_N, 1e5 * given_way_m, rtol=1e-9, atol=1e-9)
    assert (force_N[400], force_N[-1]) == (pytest.approx(10.0, rel=0.05), 0.0)


def test_a_compliant_tip_converges_with_tissue_that_remembers() -> None:
    effects = {
        "robot.compliance": {"stiffness_N_per_m": 500.0},
        "tissue.viscoelastic": {"ratio": 2.0, "tau_s": 0.05},
        "tissue.preconditioning": {"softening": 0.5},
        "tissue.adhesion": {"force_N": 0.2, "range_m": 5e-4},
    }
    cell = still_cell().with_effects(effects)
    tips = []
    one = SteppedCell(cell)
    one.begin()
    for z_m in Z_CMD_M[:6000]:
        block = one.step(np.array([[0.0, 0.0, z_m]]))
        tips.append((block.position_m[0, 2], block.tip_m[0, 2], block.contact_N[0]))
    reported_m, tip_m, contact_N = np.array(tips).T
    np.testing.assert_allclose(tip_m - reported_m, contact_N / 500.0, atol=1e-10)
    assert contact_N.min() < -0.05


# tissue


def test_the_surface_and_the_modulus_move_as_told() -> None:
    assert true_surface_m(with_("tissue.surface", offset_m=2e-4)) == pytest.approx(2e-4)
    stiffer = with_("tissue.modulus", ratio=1.3)
    assert equilibrium_force_N(stiffer, 0.004) == pytest.approx(1.3 * equilibrium_force_N(still_cell(), 0.004))


def test_a_thin_layer_is_stiffer_by_dimitriadis() -> None:
    assert dimitriadis(np.array([0.0, 0.5, 1.0])) == pytest.approx([1.0, 1.98946875, 4.2825])
    cell = with_("tissue.thickness", thickness_m=(0.005 * 0.004) ** 0.5 / 0.5)
    assert equilibrium_force_N(cell, 0.004) == pytest.approx(1.98946875 * equilibrium_force_N(still_cell(), 0.004))


def test_an_inclusion_stiffens_with_depth() -> None:
    cell = with_("tissue.inclusion", contrast=2.0, depth_m=0.004)
    assert equilibrium_force_N(cell, 0.004) == pytest.approx(2.0 * equilibrium_force_N(still_cell(), 0.004))
    assert equilibrium_force_N(cell, 0.002) == pytest.approx(1.4 * equilibrium_force_N(still_cell(), 0.002))


def test_a_viscoelastic_press_relaxes_as_the_standard_linear_solid() -> None:
    motion = ramp((0, 0.0), (0.5, -3.0), (4, -3.0))
    force_N = felt(with_("tissue.viscoelastic", ratio=0.8, tau_s=0.6), motion)
    k = equilibrium_force_N(still_cell(), 1.0)

    def law(t: float, arm: Floats) -> list[float]:
        rate = k * 1.5 * (0.006 * t) ** 0.5 * 0.006 if t < 0.5 else 0.0
        return [rate - arm[0] / 0.6]

    arm = solve_ivp(law, (0, 4), [0], t_eval=motion.t_s, rtol=1e-9, atol=1e-12, max_step=0.01).y[0]
    np.testing.assert_allclose(force_N, felt(still_cell(), motion) + 0.8 * arm, atol=2e-5)
    held = slice(500, None)
    decay = force_N[held][:2000] - k * 0.003**1.5
    np.testing.assert_allclose(decay / decay[0], np.exp(-np.arange(2000) * 1e-3 / 0.6), rtol=1e-6)


def test_tissue_that_is_left_behind_does_not_pull() -> None:
    force_N = felt(with_("tissue.viscoelastic", ratio=2.0, tau_s=5.0))
    assert force_N[MOTION.z_m < 0].min() > -0.2
    contact_N = force_N + 0.2 * MOTION.az_m_per_s2
    assert contact_N.min() > -1e-12


def test_tissue_that_was_pressed_before_is_softer_down_to_there() -> None:
    motion = ramp((0, 1.0), (1, -2.0), (2, 1.0), (3, -4.0))
    share = felt(with_("tissue.preconditioning", softening=0.4), motion) / np.maximum(felt(still_cell(), motion), 1e-12)
    np.testing.assert_allclose(share[400:1000], 1.0)
    at = int(2000 + 1000 * (1.0 + 1.0) / 5.0)
    assert share[at] == pytest.approx(1 - 0.4 * (1 - 0.5**2), rel=1e-6)
    np.testing.assert_allclose(share[2700:], 1.0)


def test_adhesion_pulls_only_while_the_tip_leaves_and_is_gone_at_its_range() -> None:
    motion = ramp((0, 2.0), (1, -2.0), (2, 2.0))
    pull_N = felt(with_("tissue.adhesion", force_N=0.3, range_m=5e-4), motion) - felt(still_cell(), motion)
    np.testing.assert_array_equal(pull_N[:1001], 0.0)
    assert pull_N.min() == pytest.approx(-0.3)
    at_surface = np.argmin(np.abs(motion.z_m[1000:])) + 1000
    assert pull_N[at_surface] == pytest.approx(-0.3)
    assert pull_N[np.argmin(np.abs(motion.z_m[1000:] - 2.5e-4)) + 1000] == pytest.approx(-0.15, rel=0.02)
    np.testing.assert_array_equal(pull_N[motion.z_m > 5e-4], 0.0)


def test_a_pull_that_holds_until_it_snaps_is_a_nuisance_that_no_file_names() -> None:
    motion = ramp((0, 2.0), (1, -2.0), (2, 2.0))
    pull_N = felt(with_("tissue.adhesion", force_N=0.3, range_m=5e-4, fading=4.0), motion) - felt(still_cell(), motion)
    assert pull_N[np.argmin(np.abs(motion.z_m[1000:] - 2.5e-4)) + 1000] == pytest.approx(-0.3 * (1.0 - 0.5**4), rel=0.02)
    assert [parameter.name for parameter in EFFECTS["tissue.adhesion"].named_parameters] == ["force_N", "range_m"]
    with pytest.raises(ConfigError, match="there is no parameter 'fading'; expected force_N, range_m"):
        cell_from({"effects": {"tissue.adhesion": {"force_N": 0.3, "range_m": 5e-4, "fading": 4.0}}}, "cell")


@pytest.mark.parametrize(("name", "sharp"), [("sensor.saturation", {"limit_N": 0.5}), ("sensor.asymmetry", {"ratio": 0.3, "at_N": 0.5})])
def test_a_slope_may_change_gradually_which_is_a_nuisance_that_no_file_names(name: str, sharp: dict[str, float]) -> None:
    motion = ramp((0, 2.0), (1, -2.0), (2, 2.0))
    nominal_N, corner_N = felt(still_cell(), motion), felt(with_(name, **sharp), motion)
    knee_N = felt(with_(name, **sharp, knee_N=0.03), motion)
    assert nominal_N.max() > 0.8
    away = np.abs(nominal_N - 0.5) > 0.3
    np.testing.assert_allclose(knee_N[away], corner_N[away], atol=1e-4)
    at = np.argmin(np.abs(nominal_N - 0.5))
    change_of_slope = sharp.get("ratio", -1.0)
    assert knee_N[at] - corner_N[at] == pytest.approx(change_of_slope * 0.03 * np.log(2.0), rel=0.05)
    assert "knee_N" not in [parameter.name for parameter in EFFECTS[name].named_parameters]


def test_a_loop_begins_where_earlier_loads_have_left_it() -> None:
    motion = ramp((0, 0.0), (1, -2.0), (2, 2.0))
    loop = {"width_N": 0.5, "amplitude_N": 0.1}
    begun, fresh = (felt(with_("sensor.hysteresis", **loop, **start), motion) for start in ({"start": 0.8}, {}))
    assert begun[0] - fresh[0] == pytest.approx(0.08)
    assert abs(begun[-1] - fresh[-1]) < abs(begun[0] - fresh[0])  # it forgets as it turns
    assert [parameter.name for parameter in EFFECTS["sensor.hysteresis"].named_parameters] == ["width_N", "amplitude_N"]


def test_the_surface_sinks_after_every_press_by_less() -> None:
    motion = ramp(*[(k, 1.0 if k % 2 == 0 else -2.0) for k in range(9)])
    force_N = felt(with_("tissue.plasticity", set_m=3e-4, ratio=0.5), motion)
    depth_m = np.cbrt((force_N[1000::2000] / equilibrium_force_N(still_cell(), 1.0)) ** 2)
    sunk_m = 3e-4 * np.array([0.0, 1.0, 1.5, 1.75])
    np.testing.assert_allclose(depth_m, 0.002 - sunk_m, atol=1e-9)


# probe


def test_a_heavier_probe_weighs_more_when_it_is_accelerated() -> None:
    extra_N = felt(with_("probe.mass", delta_kg=0.1)) - PLAIN[:, 2]
    np.testing.assert_allclose(extra_N, -0.1 * MOTION.az_m_per_s2, atol=1e-12)


def test_a_ringing_part_of_the_probe_reads_its_own_acceleration() -> None:
    t_s = np.arange(8000) / 1000
    shake = np.sin(2 * np.pi * 20 * t_s)
    motion = TipMotion(t_s, 0 * t_s + 0.01, 0 * t_s, shake)
    force_N = felt(with_("structure.resonance", frequency_Hz=20.0, damping_ratio=0.05, participation=0.4), motion)
    gain = 0.6 + 0.4 * (1 + 0.1j) / 0.1j
    assert np.ptp(force_N[-2000:]) / 2 == pytest.approx(0.2 * abs(gain), rel=0.02)


@pytest.mark.parametrize(
    ("name", "value", "law"),
    [
        ("cable.spring", {"stiffness_N_per_m": 5.0}, lambda z, v: -5.0 * (z - z[0])),
        ("cable.friction", {"force_N": 0.3}, lambda z, v: -0.3 * np.tanh(v / 0.5e-3)),
        ("cable.viscous", {"coefficient_N_s_per_m": 4.0}, lambda z, v: -4.0 * v),
    ],
)
def test_a_cable_pulls_by_its_law(name: str, value: dict[str, float], law: Callable[[Floats, Floats], Floats]) -> None:
    extra_N = felt(with_(name, **value)) - PLAIN[:, 2]
    # A tip that moves by less than a float can hold stands still, and friction is zero there.
    np.testing.assert_allclose(extra_N, law(MOTION.z_m, MOTION.vz_m_per_s), atol=1e-8)


def test_an_oblique_contact_pushes_sideways_at_the_tip() -> None:
    contact_N = PLAIN[:, 2] + 0.2 * MOTION.az_m_per_s2
    wrench = wrench_of(with_("contact.lateral", ratio=0.1, azimuth_rad=np.pi / 6), MOTION)
    fx_N, fy_N = 0.1 * np.cos(np.pi / 6) * contact_N, 0.1 * np.sin(np.pi / 6) * contact_N
    expected = np.stack([fx_N, fy_N, PLAIN[:, 2], fy_N * 0.08, -fx_N * 0.08, 0 * fx_N], axis=1)
    np.testing.assert_allclose(wrench, expected, atol=1e-12)


def test_a_tilted_sensor_sees_all_forces_aslant_but_torque_of_the_contact_only() -> None:
    contact_N = PLAIN[:, 2] + 0.2 * MOTION.az_m_per_s2
    wrench = wrench_of(with_("probe.tilt", angle_rad=0.2, azimuth_rad=np.pi / 2), MOTION)
    np.testing.assert_allclose(wrench[:, 2], np.cos(0.2) * PLAIN[:, 2], atol=1e-12)
    np.testing.assert_allclose(wrench[:, 1], np.sin(0.2) * PLAIN[:, 2], atol=1e-12)
    np.testing.assert_allclose(wrench[:, 0], 0.0, atol=1e-12)
    np.testing.assert_allclose(wrench[:, 3], np.sin(0.2) * contact_N * 0.08, atol=1e-12)


# clock and sensor


def test_a_latency_shows_the_wrench_of_a_while_ago() -> None:
    np.testing.assert_allclose(felt(with_("sensor.latency", delay_s=0.025))[100:], PLAIN[75:-25, 2], atol=1e-12)
    np.testing.assert_allclose(felt(with_("sensor.latency", delay_s=-0.025))[:-25], PLAIN[25:, 2], atol=1e-12)


@pytest.mark.parametrize("ratio", [-0.01, 0.01])
def test_a_skewed_row_holds_the_wrench_of_another_time(ratio: float) -> None:
    expected = np.interp(T_S * (1 + ratio), T_S, PLAIN[:, 2])
    np.testing.assert_allclose(felt(with_("clock.skew", ratio=ratio)), expected, atol=1e-12)


def test_a_wrench_that_comes_early_is_a_robot_that_reports_late() -> None:
    one = SteppedCell(with_("sensor.latency", delay_s=-0.02))
    one.begin()
    block = one.step(np.stack([0 * T_S, 0 * T_S, Z_CMD_M], axis=1))
    np.testing.assert_allclose(block.wrench[:, 2], PLAIN[:, 2], atol=1e-9)
    np.testing.assert_allclose(block.position_m[20:, 2], MOTION.z_m[:-20], atol=1e-12)


def test_a_fast_sensor_clock_is_a_robot_that_falls_behind() -> None:
    one = SteppedCell(with_("clock.skew", ratio=0.01))
    one.begin()
    block = one.step(np.stack([0 * T_S, 0 * T_S, Z_CMD_M], axis=1))
    np.testing.assert_allclose(block.position_m[:, 2], np.interp(T_S * 0.99, T_S, MOTION.z_m), atol=1e-12)
    np.testing.assert_allclose(block.wrench[:, 2], PLAIN[:, 2], atol=1e-9)


def test_gain_crosstalk_bias_drift_warmup_and_asymmetry_are_what_they_say() -> None:
    fz_N = PLAIN[:, 2]
    np.testing.assert_allclose(felt(with_("sensor.gain", error=0.1)), 1.1 * fz_N, atol=1e-12)
    np.testing.assert_allclose(felt(with_("sensor.bias", offset_N=-0.2)), fz_N - 0.2, atol=1e-12)
    np.testing.assert_allclose(felt(with_("sensor.drift", rate_N_per_s=0.02)), fz_N + 0.02 * T_S, atol=1e-12)
    warm_N = felt(with_("sensor.warmup", amplitude_N=0.5, tau_s=2.0))
    np.testing.assert_allclose(warm_N, fz_N + 0.5 * (1 - np.exp(-T_S / 2.0)), atol=1e-12)
    pushed, pulled = felt(with_("sensor.asymmetry", ratio=0.1, at_N=0.5)), felt(with_("sensor.asymmetry", ratio=0.1, at_N=0.0, side=-1.0))
    np.testing.assert_allclose(pushed, fz_N + 0.1 * np.maximum(0.0, fz_N - 0.5), atol=1e-12)
    np.testing.assert_allclose(pulled, fz_N + 0.1 * np.minimum(fz_N, 0.0), atol=1e-12)
    assert (pulled < fz_N).any(), "the inertia pulls"
    leak = wrench_of(with_("sensor.crosstalk", fx_per_fz=0.1, fy_per_fz=-0.2, tx_per_fz_m=0.003, ty_per_fz_m=0.004), MOTION)
    np.testing.assert_allclose(leak, np.outer(fz_N, [0.1, -0.2, 1.0, 0.003, 0.004, 0.0]), atol=1e-12)


def test_another_cutoff_takes_the_place_of_the_stated_one() -> None:
    stated = cell_from({"sensor": {"filter_cutoff_Hz": 7.0}}, "cell")
    real = nominal().with_effects({"sensor.filter": {"cutoff_Hz": 7.0}})
    np.testing.assert_array_equal(felt(real), felt(stated))


def test_hysteresis_is_the_rate_independent_loop() -> None:
    motion = ramp((0, 1.0), (1, -4.0), (2, -1.5), (3, -3.0), (4, 1.0), rate_Hz=4000.0)
    plain_N = felt(still_cell(), motion)
    w, loop = 0.0, [0.0]
    for change_N in np.diff(plain_N):
        for _ in range(20):
            w += change_N / 20 / 0.7 * (1 - w * np.sign(change_N))
        loop.append(w)
    added_N = felt(with_("sensor.hysteresis", width_N=0.7, amplitude_N=0.2), motion) - plain_N
    np.testing.assert_allclose(added_N, 0.2 * np.array(loop), atol=2e-5)
    slower = felt(
        with_("sensor.hysteresis", width_N=0.7, amplitude_N=0.2),
        TipMotion(3 * motion.t_s, *[getattr(motion, f) for f in ("z_m", "vz_m_per_s", "az_m_per_s2")]),
    )
    np.testing.assert_allclose(slower - plain_N, added_N, atol=1e-12)


def test_noise_of_the_reported_height_does_not_wear_the_loop_down() -> None:
    t_s = np.arange(15000) / 500
    z_cmd_m = np.interp(t_s, [0, 1, 2, 28, 29], [0.003, 0.003, -0.003, -0.003, 0.003])
    cell = nominal().with_effects({"sensor.hysteresis": {"width_N": 0.5, "amplitude_N": 0.3}})
    true = simulate(cell, t_s, z_cmd_m=z_cmd_m)
    noisy = simulate(nominal(), t_s, z_cmd_m=z_cmd_m, noise_seed=2)
    error_N = simulate(cell, t_s, z_m=noisy["z_m"], vz_m_per_s=noisy["vz_m_per_s"])["fz_N"] - true["fz_N"]
    assert np.abs(error_N[1500:13500]).max() < 0.05


def test_creep_grows_towards_its_share_of_the_load() -> None:
    motion = ramp((0, 0.0), (0.001, -3.0), (10, -3.0))
    share = felt(with_("sensor.creep", ratio=0.1, tau_s=2.0), motion) / max(felt(still_cell(), motion)) - 1.0
    np.testing.assert_allclose(share[10:], 0.1 * (1 - np.exp(-motion.t_s[10:] / 2.0)), atol=1e-4)


def test_a_saturated_reading_stops_at_its_limit() -> None:
    limited = felt(with_("sensor.saturation", limit_N=1.2))
    assert limited.max() == 1.2
    np.testing.assert_array_equal(limited, np.clip(PLAIN[:, 2], -1.2, 1.2))


def test_a_coarse_step_rounds_and_noise_dithers_it() -> None:
    np.testing.assert_allclose(felt(with_("sensor.quantization", step_N=0.5)), np.rint(PLAIN[:, 2] / 0.5) * 0.5, atol=1e-12)
    cell = nominal().with_effects({"sensor.quantization": {"step_N": 0.25}})
    depth_m = np.repeat(np.linspace(0.001, 0.002, 12), 40000)
    still = TipMotion(np.arange(len(depth_m)) * 1e-3, -depth_m, 0 * depth_m, 0 * depth_m)
    mean_N = felt(cell, still)[20000::40000]
    noisy_N = simulate(cell, still.t_s, z_m=still.z_m, vz_m_per_s=still.vz_m_per_s, noise_seed=4)["fz_N"]
    drawn_N = noisy_N.reshape(12, 40000)[:, 1000:-1000].mean(axis=1)
    np.testing.assert_allclose(mean_N, drawn_N, atol=0.003)
    np.testing.assert_allclose(noisy_N / 0.25, np.rint(noisy_N / 0.25), atol=1e-9)


def test_more_noise_is_more_noise_on_every_axis() -> None:
    t_s = np.arange(20000) / 500
    cell = nominal().with_effects({"sensor.noise": {"ratio": 3.0}})
    columns = simulate(cell, t_s, z_cmd_m=0 * t_s + 0.01, noise_seed=6)
    assert np.std(columns["fx_N"]) == pytest.approx(0.15, rel=0.03)
    assert np.std(columns["tz_Nm"]) == pytest.approx(0.003, rel=0.03)


def test_dropouts_hold_the_last_good_row_as_long_as_they_last() -> None:
    t_s = np.arange(50000) / 500
    cell = cell_from({"sensor": {"resolution_fz_N": 0.0}}, "cell").with_effects({"sensor.dropout": {"rate_Hz": 2.0, "length_s": 0.02}})
    fz_N = simulate(cell, t_s, z_cmd_m=0 * t_s + 0.01, noise_seed=8)["fz_N"]
    held = np.diff(fz_N) == 0.0
    assert held.mean() == pytest.approx(2.0 * 0.02, rel=0.25)
    edges = np.flatnonzero(np.diff(np.concatenate(([0], held, [0]))))
    assert np.median(edges[1::2] - edges[::2]) == 10
    block = SteppedCell(cell, seed=3)
    block.begin()
    steps = np.concatenate([block.step(np.tile([0.0, 0.0, 0.01], (8, 1))).wrench[:, 2] for _ in range(5000)])
    assert (np.diff(steps) == 0.0).mean() == pytest.approx(0.04, rel=0.3)


# one's own


def test_an_effect_of_ones_own_takes_less_than_thirty_lines_and_acts() -> None:
    assert len(EXAMPLE.read_text().splitlines()) < 30
    library = load_effects(EXAMPLE)
    assert len(library) == len(EFFECTS) + 1
    cell = still_cell().with_effects({"tissue.pulse": {"share": 0.1, "frequency_Hz": 1.5, "phase_rad": 0.0}})
    held = ramp((0, -3.0), (2, -3.0))
    force_N = wrench_of(cell, held, library)[:, 2]
    np.testing.assert_allclose(force_N, felt(still_cell(), held) * (1 + 0.1 * np.sin(3 * np.pi * held.t_s)))
    with pytest.raises(ConfigError, match=r"no effect 'tissue\.pulse' in the library"):
        wrench_of(cell, held)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("EFFECTS = 3", "defines no EFFECTS"),
        ("EFFECTS = ['sensor.bias']", "defines no EFFECTS"),
        ("1 / 0", "ZeroDivisionError"),
        ("from palpd.cell.effects import Effect\nEFFECTS = [Effect('a.b', 'probe', 'x', ())]", "has no law"),
        ("from palpd.cell.effects import Effect\nEFFECTS = [Effect('a.b', 'arm', 'x', (), law=print)]", "stands at site 'arm'"),
    ],
)
def test_a_file_without_effects_is_refused(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(text)
    with pytest.raises(ConfigError, match=message):
        load_effects(tmp_path / "mine.py")


def test_a_parameter_is_found_by_its_name() -> None:
    parameter = EFFECTS["tissue.viscoelastic"].parameter("tau_s")
    assert isinstance(parameter, Parameter)
    assert parameter.unit == "s"
    assert parameter.log


@pytest.mark.parametrize("effect", EFFECTS.values(), ids=lambda effect: effect.id)
def test_a_formula_names_every_parameter_without_its_unit(effect: Effect) -> None:
    words = set(re.findall(r"[a-z_]+", effect.formula))
    units = r"_(N_per_s|N_per_m|N_s_per_m|N|m|s|Hz|rad|kg)$"
    assert {re.sub(units, "", parameter.name) for parameter in effect.named_parameters} <= words
