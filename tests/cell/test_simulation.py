"""The physics of the cell against closed forms, and step by step against whole recordings."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from palpd.cell.cell_file import PHANTOM, CellFile, Estimated, cell_from, nominal
from palpd.cell.dynamics import Floats, Memory, delayed, lowpass, mounted, play, recurrence, servo, servo_heights, shifted, steps
from palpd.cell.effects import EFFECTS, Effect, Values
from palpd.cell.physics import true_surface_m
from palpd.cell.simulation import commanded_motion, equilibrium_force_N, predict_motion, scale_of, simulate, wrench_of
from palpd.cell.span import Span, TipMotion
from palpd.cell.stepped import SampleBlock, SteppedCell
from palpd.cell.tip_motion import estimate_tip_motion, starting_motion
from palpd.errors import ConfigError

RNG = np.random.default_rng(7)
QUIET = {"sensor": {"noise_rms_N": 1e-15, "noise_rms_Nm": 0.0}, "robot": {"position_noise_rms_m": 0.0, "velocity_noise_rms_m_per_s": 0.0}}


def quiet(**blocks: object) -> CellFile:
    """A cell without noise; keyword blocks are merged into it."""
    given: dict[str, object] = {key: dict(value) for key, value in QUIET.items()}
    for key, value in blocks.items():
        given[key] = {**QUIET.get(key, {}), **value} if isinstance(value, dict) else value
    return cell_from(given, "cell")


def presses(duration_s: float = 6.0, rate_Hz: float = 1000.0, deepest_m: float = 0.004) -> tuple[Floats, Floats]:
    """Commanded heights of presses that are not alike, from 3 mm above the surface."""
    t_s = np.arange(int(duration_s * rate_Hz)) / rate_Hz
    knots_s = np.array([0, 0.5, 1.2, 1.9, 2.3, 3.0, 3.4, 4.3, 4.7, 5.4, 6.0]) * duration_s / 6.0
    heights_m = np.array([3, 3, -deepest_m * 600, -deepest_m * 600, 3, -deepest_m * 1000, 2, -deepest_m * 800, -deepest_m * 800, 3, 3])
    return t_s, np.interp(t_s, knots_s, heights_m * 1e-3)


def reported(cell: CellFile, t_s: Floats, z_m: Floats, vz_m_per_s: Floats) -> Floats:
    """Mean wrench (n, 6) of a motion that the robot reported."""
    return wrench_of(cell, estimate_tip_motion(cell, t_s, z_m, vz_m_per_s))


def lived(cell: CellFile, z_cmd_m: Floats, **options: float) -> SampleBlock:
    """The same commands step by step, in blocks of changing length."""
    one = SteppedCell(cell, step_s=0.001)
    one.begin()
    blocks, k, lengths = [], 0, [1, 1, 2, 8, 3, 20, 1, 70]
    while k < len(z_cmd_m):
        n = lengths[len(blocks) % len(lengths)]
        target = np.zeros((len(z_cmd_m[k : k + n]), 3))
        target[:, 2] = z_cmd_m[k : k + n]
        blocks.append(one.step(target))
        k += n
    return SampleBlock(*(np.concatenate([getattr(block, name) for block in blocks]) for name in SampleBlock.__dataclass_fields__))


# dynamics


def test_a_recurrence_by_doubling_is_the_recurrence_by_hand() -> None:
    a, b = RNG.uniform(-1, 1, 300), RNG.normal(size=300)
    y, expected = 0.7, []
    for k in range(300):
        y = a[k] * y + b[k]
        expected.append(y)
    np.testing.assert_allclose(recurrence(a, b, 0.7), expected, atol=1e-13)


@pytest.mark.parametrize("n", [1, 5, 64, 65, 400])
def test_a_lowpass_does_not_care_how_its_input_is_cut(n: int) -> None:
    u = RNG.normal(size=400)
    whole = lowpass(u, 0.01, -3.0, {})
    memory: dict[str, object] = {}
    pieces = [lowpass(u[k : k + n], 0.01, -3.0, memory) for k in range(0, 400, n)]
    np.testing.assert_allclose(np.concatenate(pieces), whole, atol=1e-13)


def test_a_lowpass_at_uneven_steps_is_the_one_at_even_steps_where_both_have_samples() -> None:
    t_s = np.arange(2001) * 1e-3
    keep = np.sort(RNG.choice(np.arange(1, 2000), 900, replace=False))
    keep = np.concatenate(([0], keep, [2000]))
    ramps = np.interp(t_s, t_s[keep], RNG.normal(size=len(keep)))
    even = lowpass(ramps, 1e-3, -20.0, {})
    uneven = lowpass(ramps[keep], steps(t_s[keep]), -20.0, {})
    np.testing.assert_allclose(uneven, even[keep], atol=1e-12)


def test_a_lowpass_passes_its_cutoff_with_one_over_root_two() -> None:
    t_s = np.arange(4000) / 4000
    out = lowpass(np.sin(2 * np.pi * 50 * t_s), 1 / 4000, -2 * np.pi * 50, {})
    assert np.ptp(out[2000:]) / 2 == pytest.approx(2**-0.5, rel=2e-3)


@pytest.mark.parametrize("damping_ratio", [0.2, 1.0, 1.7])
def test_the_servo_is_the_second_order_system(damping_ratio: float) -> None:
    t_s = np.arange(1500) * 1e-3
    knots = np.array([0, 0.2, 0.6, 0.8, 1.5])
    heights = np.array([0, 0, -0.01, -0.01, 0.004])
    omega = 2 * np.pi * 8.0

    def law(t: float, x: Floats) -> list[float]:
        return [x[1], omega**2 * (np.interp(t, knots, heights) - x[0]) - 2 * damping_ratio * omega * x[1]]

    true = solve_ivp(law, (0, t_s[-1]), [0, 0], t_eval=t_s, rtol=1e-9, atol=1e-13, max_step=0.005).y
    z, v, a = servo(np.interp(t_s, knots, heights), 1e-3, 8.0, damping_ratio, {})
    np.testing.assert_allclose(z, true[0], atol=2e-9)
    np.testing.assert_allclose(v, true[1], atol=1e-7)
    target = np.interp(t_s, knots, heights)
    np.testing.assert_allclose(a, omega**2 * (target - z) - 2 * damping_ratio * omega * v, atol=1e-7)


@pytest.mark.parametrize("damping_ratio", [0.2, 1.0, 1.7])
def test_a_servo_that_starts_in_motion_goes_on_as_one_that_moved_before(damping_ratio: float) -> None:
    t_s = np.cumsum(np.random.default_rng(0).uniform(1e-3, 3e-3, 600))
    target = np.interp(t_s, [0.1, 0.5, 0.8], [0.01, -0.004, 0.002])
    for when_s in (np.arange(600) * 2e-3, t_s):
        z, v, a = servo(target, steps(when_s), 8.0, damping_ratio, {})
        after = slice(150, None)
        rest = servo(target[after], steps(when_s[after]), 8.0, damping_ratio, {}, (z[150], v[150]))
        np.testing.assert_allclose(rest, (z[after], v[after], a[after]), rtol=1e-6, atol=1e-8)  # a double pole is split by 1e-4


def test_the_motion_at_the_first_row_is_measured_where_there_is_any() -> None:
    rng, t_s = np.random.default_rng(0), np.arange(500) / 500
    cell = nominal()
    noise_m, noise_m_per_s = cell.robot.position_noise_rms_m, cell.robot.velocity_noise_rms_m_per_s
    z_m, v = 0.01 - 0.03 * t_s + 0.1 * t_s**2, -0.03 + 0.2 * t_s
    z_m, v = z_m + noise_m * rng.standard_normal(500), v + noise_m_per_s * rng.standard_normal(500)
    moving = starting_motion(cell, t_s, z_m, v)
    assert moving is not None
    assert moving.at(0.01) == pytest.approx((0.00971, -0.028), rel=0.02)
    assert starting_motion(cell, t_s, np.full(500, 0.01), noise_m_per_s * rng.standard_normal(500)) is None


def test_a_servo_that_is_much_faster_than_the_samples_may_start_in_motion() -> None:
    u = np.linspace(0.0, 1.0, 50)
    with np.errstate(over="raise", invalid="raise"):
        z_m = servo_heights(u, 1.0, 120.0, 5.0, (0.3, 0.1))
    np.testing.assert_allclose(np.diff(z_m[1:]), u[1], rtol=1e-3)


def test_the_tip_lags_a_ramp_by_two_zeta_over_omega() -> None:
    cell = quiet()
    t_s = np.arange(3000) / 1000
    lag_m = -0.01 * t_s - predict_motion(cell, t_s, -0.01 * t_s)
    assert lag_m[-1] == pytest.approx(-0.01 * 2 / (2 * np.pi * 8), rel=1e-6)


def test_a_mounted_mass_amplifies_at_its_resonance_as_the_transfer_function_says() -> None:
    t_s = np.arange(20000) / 2000
    out = mounted(np.sin(2 * np.pi * 30 * t_s), 1 / 2000, 30.0, 0.1, {})
    assert np.ptp(out[-4000:]) / 2 == pytest.approx(abs((1 + 0.2j) / 0.2j), rel=5e-3)


def test_play_follows_only_what_leaves_its_band() -> None:
    u = np.cumsum(RNG.normal(size=500))
    follower, expected = u[0], []
    for x in u:
        follower = min(max(follower, x - 0.75), x + 0.75)
        expected.append(follower)
    np.testing.assert_array_equal(play(u, 1.5, {}), expected)


# nominal cell


def test_the_nominal_force_is_hertz() -> None:
    assert equilibrium_force_N(nominal(), 0.004) == pytest.approx(4 / 3 * 72000 / 0.75 * 0.005**0.5 * 0.004**1.5)


def test_a_still_press_reads_the_equilibrium_force_on_fz_alone() -> None:
    t_s = np.arange(500) / 500
    still = np.zeros(500)
    wrench = reported(nominal(), t_s, still - 0.004, still)
    np.testing.assert_allclose(wrench[:, 2], equilibrium_force_N(nominal(), 0.004), rtol=1e-9)
    assert not wrench[:, [0, 1, 3, 4, 5]].any()


def test_a_tip_that_is_accelerated_upwards_weighs_on_the_sensor_downwards() -> None:
    t_s = np.arange(1000) / 500
    wrench = reported(nominal(), t_s, 0.02 + 0.5 * 0.3 * t_s**2, 0.3 * t_s)
    np.testing.assert_allclose(wrench[100:-20, 2], -0.2 * 0.3, rtol=1e-6)


def test_with_nothing_in_reach_there_is_inertia_only() -> None:
    cell = cell_from({"tissue": None}, "cell")
    t_s, z_cmd_m = presses()
    motion = commanded_motion(cell, t_s, z_cmd_m)
    late = lowpass(-0.2 * motion.az_m_per_s2, 1e-3, -2 * np.pi * 150.0, {})
    np.testing.assert_allclose(wrench_of(cell, motion)[:, 2], late, atol=1e-12)


@pytest.mark.parametrize("rate_Hz", [5.0, 60.0, 500.0, 2000.0])
def test_recordings_of_every_rate_give_the_same_forces(rate_Hz: float) -> None:
    cell = quiet(sensor={"filter_cutoff_Hz": None})
    t_s, z_cmd_m = presses(30.0, 4000.0)
    fine = commanded_motion(cell, t_s, z_cmd_m)
    every = round(4000 / rate_Hz)
    rows = slice(None, None, every)
    coarse = reported(cell, t_s[rows], fine.z_m[rows], fine.vz_m_per_s[rows])[:, 2]
    expected = wrench_of(cell, fine)[rows, 2]
    assert np.sqrt(np.mean((coarse - expected) ** 2)) < 0.004 * expected.max()


def test_uneven_steps_give_the_forces_of_even_ones() -> None:
    cell = quiet().with_effects({"tissue.viscoelastic": {"ratio": 0.5, "tau_s": 0.4}})
    t_s, z_cmd_m = presses(12.0)
    fine = commanded_motion(cell, t_s, z_cmd_m)
    rows = np.sort(RNG.choice(len(t_s), len(t_s) // 3, replace=False))
    rows[0] = 0
    sparse = reported(cell, t_s[rows], fine.z_m[rows], fine.vz_m_per_s[rows])[:, 2]
    expected = wrench_of(cell, fine)[rows, 2]
    assert np.sqrt(np.mean((sparse - expected) ** 2)) < 0.004 * expected.max()


def test_noise_of_the_reported_motion_hardly_reaches_the_predicted_force() -> None:
    t_s, z_cmd_m = presses(12.0, 500.0)
    true = commanded_motion(nominal(), t_s, z_cmd_m)
    noisy = simulate(nominal(), t_s, z_cmd_m=z_cmd_m, noise_seed=1)
    error_N = reported(nominal(), t_s, noisy["z_m"], noisy["vz_m_per_s"])[:, 2] - wrench_of(nominal(), true)[:, 2]
    assert np.sqrt(np.mean(error_N**2)) < 0.15 * nominal().sensor.noise_rms_N
    assert np.abs(error_N).max() < nominal().sensor.noise_rms_N


def test_fifty_samples_at_ten_hertz_are_enough_to_predict() -> None:
    t_s = np.arange(50) / 10
    z_m = 0.001 - 0.002 * np.minimum(t_s, 2.5)
    wrench = reported(nominal(), t_s, z_m, np.where(t_s < 2.5, -0.002, 0.0))
    assert np.isfinite(wrench).all()
    assert wrench[-1, 2] == pytest.approx(equilibrium_force_N(nominal(), 0.004), rel=1e-3)


@pytest.mark.parametrize("rows", [0.0, 0.3, 1.0, 2.75, -0.25, -1.0, -3.4, 11.0, 12.5, 40.0, -11.0, -40.0])
def test_a_signal_on_an_even_grid_is_shifted_as_a_delay_shifts_it(rows: float) -> None:
    u: Floats = np.random.default_rng(5).standard_normal(12)
    t_s: Floats = 0.3 + 0.002 * np.arange(12.0)
    np.testing.assert_allclose(shifted(u, rows), delayed(u, t_s, t_s - 0.002 * rows, {}), atol=1e-9)


@pytest.mark.parametrize("pole_per_s", [-2500.0, -2450.0, -1500.0])
def test_a_fast_relaxation_is_the_same_in_one_stretch_and_in_many(pole_per_s: float) -> None:
    u: Floats = 3.0 + np.random.default_rng(6).standard_normal(400)
    memory: Memory = {}
    whole = lowpass(u, 0.002, pole_per_s, {})
    parts = [lowpass(u[k : k + 40], 0.002, pole_per_s, memory) for k in range(0, 400, 40)]
    np.testing.assert_allclose(whole, np.concatenate(parts), rtol=1e-13)


def push_back(s: Span, _values: Values, _memory: Memory) -> None:
    """A user's law that changes its sample arrays in place: fz, and one of the axes into which it leaks."""
    s.fz_N += 0.5
    s.fx_N *= 2.0


def test_laws_of_the_sensor_act_after_the_leak_whatever_axis_they_change() -> None:
    t_s, z_cmd_m = presses()
    motion = commanded_motion(quiet(), t_s, z_cmd_m)
    leaking = quiet().with_estimated(Estimated(crosstalk=(0.1, -0.2, 0.0, 0.0)))
    plain = wrench_of(leaking, motion)
    library = {**EFFECTS, "sensor.user": Effect("sensor.user", "sensor", "changes in place", (), law=push_back)}
    changed = wrench_of(leaking.with_effects({"sensor.user": {}}), motion, library)
    np.testing.assert_allclose(changed, plain * [2.0, 1.0, 1.0, 1.0, 1.0, 1.0] + [0.0, 0.0, 0.5, 0.0, 0.0, 0.0], atol=1e-12)


def test_a_law_of_fz_alone_leaves_the_other_axes_as_they_were_to_the_last_digit() -> None:
    t_s, z_cmd_m = presses()
    motion = commanded_motion(quiet(), t_s, z_cmd_m)
    leaking = quiet().with_estimated(Estimated(crosstalk=(0.1, -0.2, 0.01, 0.02)))
    change = wrench_of(leaking.with_effects({"sensor.creep": {"ratio": 0.1, "tau_s": 1.0}}), motion) - wrench_of(leaking, motion)
    assert np.flatnonzero(change.any(axis=0)).tolist() == [2]


def test_deviations_within_tolerance_change_what_they_are_called_after() -> None:
    t_s, z_cmd_m = presses()
    motion = commanded_motion(quiet(), t_s, z_cmd_m)
    plain = wrench_of(quiet(), motion)

    def with_(**known: object) -> Floats:
        return wrench_of(quiet().with_estimated(Estimated.model_validate(known)), motion)

    np.testing.assert_allclose(with_(bias_N=0.3)[:, 2], plain[:, 2] + 0.3)
    np.testing.assert_allclose(with_(drift_N_per_min=0.6)[:, 2], plain[:, 2] + 0.01 * t_s)
    np.testing.assert_allclose(with_(gain=0.02)[:, 2], plain[:, 2] * 1.02, atol=1e-12)
    np.testing.assert_allclose(with_(crosstalk=(0.1, 0, 0, -0.2))[:, 0], 0.1 * plain[:, 2], atol=1e-12)
    np.testing.assert_allclose(with_(crosstalk=(0.1, 0, 0, -0.2))[:, 4], -0.2 * 0.05 * plain[:, 2], atol=1e-12)
    np.testing.assert_allclose(with_(latency_s=0.02)[50:, 2], plain[30:-20, 2], atol=1e-12)
    still = int(1.85 * 1000)
    assert with_(youngs_modulus=0.1)[still, 2] == pytest.approx(1.1 * plain[still, 2], rel=1e-3)
    assert with_(mass_kg=0.2)[:300, 2] == pytest.approx(2 * plain[:300, 2])
    assert true_surface_m(quiet().with_estimated(Estimated(surface_z_m=1e-4))) == pytest.approx(1e-4)
    slower = predict_motion(quiet().with_estimated(Estimated(servo_natural_frequency=-0.5)), t_s, z_cmd_m)
    np.testing.assert_allclose(slower, predict_motion(quiet(robot={"servo_natural_frequency_Hz": 4.0}), t_s, z_cmd_m))


# simulate


def test_a_simulation_without_noise_is_the_prediction() -> None:
    t_s, z_cmd_m = presses()
    columns = simulate(nominal(), t_s, z_cmd_m=z_cmd_m)
    assert list(columns) == ["t_s", "z_cmd_m", "z_m", "vz_m_per_s", "fx_N", "fy_N", "fz_N", "tx_Nm", "ty_Nm", "tz_Nm"]
    np.testing.assert_array_equal(columns["z_m"], predict_motion(nominal(), t_s, z_cmd_m))
    again = simulate(nominal(), t_s, z_m=columns["z_m"], vz_m_per_s=columns["vz_m_per_s"])
    np.testing.assert_allclose(again["fz_N"], columns["fz_N"], atol=0.01)


def test_simulated_noise_is_that_of_the_cell_file_rounded_to_its_steps() -> None:
    t_s = np.arange(40000) / 500
    columns = simulate(cell_from({"sensor": {"resolution_fz_N": 0.01}}, "cell"), t_s, z_cmd_m=0.0 * t_s + 0.01, noise_seed=3)
    assert np.std(columns["fz_N"]) == pytest.approx(0.05, rel=0.02)
    assert np.std(columns["tx_Nm"]) == pytest.approx(0.001, rel=0.1)
    assert np.std(columns["z_m"]) == pytest.approx(5e-6, rel=0.02)
    np.testing.assert_allclose(columns["fz_N"] / 0.01, np.rint(columns["fz_N"] / 0.01), atol=1e-9)
    np.testing.assert_allclose(columns["fx_N"] / 0.024, np.rint(columns["fx_N"] / 0.024), atol=1e-9)


def test_the_same_seed_gives_the_same_recording_and_another_does_not() -> None:
    t_s, z_cmd_m = presses()
    one, same, other = (simulate(nominal(), t_s, z_cmd_m=z_cmd_m, noise_seed=seed)["fz_N"] for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert (one != other).any()


def test_a_simulation_of_nothing_is_refused() -> None:
    with pytest.raises(ConfigError, match="needs z_m or z_cmd_m"):
        simulate(nominal(), np.arange(10.0))


# step by step


def test_living_step_by_step_is_the_whole_recording_at_once() -> None:
    cell = quiet()
    t_s, z_cmd_m = presses()
    block, columns = lived(cell, z_cmd_m), simulate(cell, t_s, z_cmd_m=z_cmd_m)
    np.testing.assert_allclose(block.position_m[:, 2], columns["z_m"], atol=1e-12)
    np.testing.assert_allclose(block.velocity_m_per_s[:, 2], columns["vz_m_per_s"], atol=1e-9)
    np.testing.assert_allclose(block.wrench[:, 2], columns["fz_N"], atol=1e-9)


def test_the_tip_moves_sideways_by_the_same_servo() -> None:
    one = SteppedCell(quiet())
    target = np.zeros((400, 3))
    target[:, 2] = 0.01
    one.step(target)
    target[:, 0], target[:, 1] = 0.01, -0.02
    tip_m = one.step(target).tip_m
    z = servo(np.concatenate(([0.0], np.ones(400))), 1e-3, 8.0, 1.0, {})[0][1:]
    np.testing.assert_allclose(tip_m, np.stack([0.01 * z, -0.02 * z, 0.01 + 0 * z], axis=1), atol=1e-12)


def test_the_nearest_site_counts() -> None:
    one = SteppedCell(PHANTOM, seed=1)
    for site, x_m in zip("ABCD", (0.002, 0.031, 0.055, 0.2), strict=True):
        target = np.tile([x_m, 0.003, -0.004], (2000, 1))
        assert one.step(target).contact_N[-1] == pytest.approx(equilibrium_force_N(PHANTOM, 0.004, site), rel=1e-9)


def test_a_site_that_is_not_there_is_refused() -> None:
    with pytest.raises(ConfigError, match="no site 'E'; it has A, B, C, D"):
        equilibrium_force_N(PHANTOM, 0.004, "E")


def test_what_the_tare_does_not_see_sets_in_when_the_motion_begins() -> None:
    cell = quiet().with_effects({"sensor.bias": {"offset_N": 0.5}, "sensor.drift": {"rate_N_per_s": 1.0}})
    one = SteppedCell(cell)
    still = np.tile([0.0, 0.0, 0.01], (1000, 1))
    assert np.abs(one.step(still).wrench).max() < 1e-9
    one.begin()
    np.testing.assert_allclose(one.step(still).wrench[:, 2], 0.5 + np.arange(1000) * 1e-3)
    one.begin()
    np.testing.assert_allclose(one.step(still).wrench[:, 2], 0.5 + np.arange(1000) * 1e-3)


def test_the_filter_that_is_set_replaces_the_stated_one() -> None:
    t_s, z_cmd_m = presses()
    target = np.stack([0 * t_s, 0 * t_s, z_cmd_m], axis=1)
    readings = {}
    for cutoff_Hz in (None, 5.0):
        one = SteppedCell(quiet())
        one.begin()
        one.set_filter(cutoff_Hz)
        readings[cutoff_Hz] = one.step(target).wrench[:, 2]
    slow = lowpass(readings[None], 1e-3, -2 * np.pi * 5.0, {})
    np.testing.assert_allclose(readings[5.0], slow, atol=1e-9)


@pytest.mark.parametrize("stiffness_N_per_m", [1e3, 2e4, 5e4])
def test_a_wall_pushes_back_in_proportion(stiffness_N_per_m: float) -> None:
    cell = quiet(wall={"z_m": -0.001, "stiffness_N_per_m": stiffness_N_per_m})
    block = SteppedCell(cell).step(np.tile([0.0, 0.0, -0.0015], (50, 1)))
    np.testing.assert_allclose(block.contact_N, 0.0005 * stiffness_N_per_m)
    assert equilibrium_force_N(cell, 0.0005) == pytest.approx(0.0005 * stiffness_N_per_m)


def test_a_wall_may_appear_after_the_motion_began() -> None:
    one = SteppedCell(quiet(wall={"z_m": 0.0, "stiffness_N_per_m": 1e4, "appears_after_s": 0.5}))
    pressed = np.tile([0.0, 0.0, -0.002], (1000, 1))
    tissue_N = equilibrium_force_N(nominal(), 0.002)
    np.testing.assert_allclose(one.step(pressed).contact_N, tissue_N)
    one.begin()
    contact_N = one.step(pressed).contact_N
    np.testing.assert_allclose(contact_N[:500], tissue_N)
    np.testing.assert_allclose(contact_N[500:], 20.0)


def test_a_wall_can_be_placed_while_the_cell_lives() -> None:
    one = SteppedCell(quiet())
    one.place_wall(0.001, 1e4)
    np.testing.assert_allclose(one.step(np.tile([0.0, 0.0, 0.0], (5, 1))).contact_N, 10.0)


@pytest.mark.parametrize("wall_N_per_m", [1e3, 5e4])
@pytest.mark.parametrize("mount_N_per_m", [2e3, 1e4, 1e6])
def test_a_soft_mount_before_a_hard_wall_is_two_springs_in_series(wall_N_per_m: float, mount_N_per_m: float) -> None:
    cell = quiet(wall={"z_m": 0.0, "stiffness_N_per_m": wall_N_per_m}).with_effects(
        {"robot.compliance": {"stiffness_N_per_m": mount_N_per_m}}
    )
    t_s, z_cmd_m = presses(deepest_m=0.001)
    motion = commanded_motion(cell, t_s, z_cmd_m)
    series_N = np.maximum(-motion.z_m, 0.0) / (1 / wall_N_per_m + 1 / mount_N_per_m)
    block = lived(cell, z_cmd_m)
    np.testing.assert_allclose(block.contact_N, series_N, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(block.tip_m[:, 2], motion.z_m + series_N / mount_N_per_m, atol=1e-12)


# scale


def test_the_scale_of_a_recording_grows_with_it() -> None:
    t_s, z_cmd_m = presses(30.0)
    columns = simulate(nominal(), t_s, z_cmd_m=z_cmd_m, noise_seed=1)
    scale = scale_of(nominal(), t_s, columns["z_m"], columns["vz_m_per_s"], columns["fz_N"])
    assert scale.force_N == pytest.approx(equilibrium_force_N(nominal(), 0.004), rel=0.1)
    assert scale.depth_m == pytest.approx(0.004, rel=0.1)
    assert scale.stroke_m == pytest.approx(0.007, rel=0.05)
    assert scale.duration_s == pytest.approx(30.0, rel=1e-3)
    assert scale.step_s == pytest.approx(0.001)


def test_a_motion_keeps_what_is_left_of_its_noise() -> None:
    t_s, z_cmd_m = presses(12.0, 500.0)
    noisy = simulate(nominal(), t_s, z_cmd_m=z_cmd_m, noise_seed=5)
    true = commanded_motion(nominal(), t_s, z_cmd_m)
    motion = estimate_tip_motion(nominal(), t_s, noisy["z_m"], noisy["vz_m_per_s"])
    assert isinstance(motion, TipMotion)
    still = slice(0, 200)
    assert np.std((motion.z_m - true.z_m)[still]) == pytest.approx(motion.z_noise_m, rel=0.5)
    assert replace(motion, z_noise_m=0.0).z_noise_m == 0.0


@pytest.mark.parametrize("rate_Hz", [50.0, 500.0])
def test_the_noise_of_an_acceleration_is_what_the_motion_says_of_it(rate_Hz: float) -> None:
    t_s = np.arange(20000) / rate_Hz
    speeds = RNG.normal(size=20000) * 2e-4
    motion = estimate_tip_motion(nominal(), t_s, 0 * t_s + 0.01, speeds)
    assert np.std(motion.az_m_per_s2) == pytest.approx(motion.az_noise_m_per_s2, rel=0.05)
    assert 0.2 * motion.az_noise_m_per_s2 < 0.1 * 0.05 or rate_Hz < 100.0


def test_what_the_command_explains_is_not_taken_from_noisy_speeds() -> None:
    t_s, z_cmd_m = presses(12.0, 500.0)
    truth = commanded_motion(nominal(), t_s, z_cmd_m)
    noisy = simulate(nominal(), t_s, z_cmd_m=z_cmd_m, noise_seed=5)
    blind = estimate_tip_motion(nominal(), t_s, noisy["z_m"], noisy["vz_m_per_s"])
    commanded = estimate_tip_motion(nominal(), t_s, noisy["z_m"], noisy["vz_m_per_s"], z_cmd_m)
    error, error_commanded = (np.std(m.az_m_per_s2 - truth.az_m_per_s2) for m in (blind, commanded))
    assert error_commanded < 0.3 * error
    # The estimate follows a robot that does not follow its command.
    swinging_m_per_s = 0.004 * np.sin(2 * np.pi * 30.0 * t_s)
    moved = estimate_tip_motion(nominal(), t_s, noisy["z_m"], noisy["vz_m_per_s"] + swinging_m_per_s, z_cmd_m)
    assert np.std(moved.az_m_per_s2 - truth.az_m_per_s2) == pytest.approx(0.004 * 2 * np.pi * 30.0 / 2**0.5, rel=0.05)


def test_an_acceleration_follows_a_vibration_well_above_the_servo() -> None:
    t_s = np.arange(5000) / 500
    omega = 2 * np.pi * 30.0
    speeds = 0.004 * np.sin(omega * t_s) + RNG.normal(size=5000) * 2e-4
    motion = estimate_tip_motion(nominal(), t_s, 0.01 - 0.004 / omega * np.cos(omega * t_s), speeds)
    assert np.std(motion.az_m_per_s2) == pytest.approx(0.004 * omega / 2**0.5, rel=0.05)
