"""What the diagnosis takes for noise, and where samples stand in time."""

from collections.abc import Callable
from dataclasses import replace
from inspect import getsource
from typing import get_args

import numpy as np
import pytest
from scipy.sparse import csr_array

from palpd.cell.cell_file import CellFile, EffectValues, nominal
from palpd.cell.effects import EFFECTS
from palpd.cell.effects.effect import ScatterKind
from palpd.cell.simulation import simulate
from palpd.cell.stages import WRENCH
from palpd.gap.data.bins import Bins
from palpd.gap.data.cleaning import without_held, without_tails
from palpd.gap.data.noise import FZ, lattice_step
from palpd.gap.data.observations import observe
from palpd.gap.data.rounding import coarse_step_N, noise_before_rounding, rounded_moments, rounding_of
from palpd.gap.data.scatter import scatter_effects
from palpd.gap.diagnosis import diagnose
from palpd.gap.gaussian.whitening import Whitening
from palpd.gap.model.problem import make_problem
from palpd.recording.oddities import measured_rms
from palpd.recording.samples import Samples
from palpd.testing.plain_cells import recording
from palpd.tick import Floats


def test_each_kind_of_scatter_has_a_test_of_the_readings() -> None:
    """An effect of another kind would take part in no fit and in no test: it would never be named, without a word."""
    kinds = {effect.scatter for effect in EFFECTS.values()} - {None}
    assert kinds == set(get_args(ScatterKind))
    assert all(f'"{kind}": ' in getsource(scatter_effects) for kind in kinds)


def test_noise_is_measured_within_rests_and_not_in_the_steps_between_them() -> None:
    height_m = np.repeat([0.0, 0.01, -0.005, 0.02] * 5, 12) + 5e-6 * np.random.default_rng(1).standard_normal(240)
    rest = np.tile(np.arange(12) > 2, 20)
    assert abs(measured_rms(height_m, rest) / 5e-6 - 1.0) < 0.2
    assert measured_rms(height_m[rest]) > 1e-3


def test_steps_of_several_samples_keep_their_length_where_times_jitter() -> None:
    t_s = np.arange(20_000) * 2e-3 + np.random.default_rng(3).uniform(0.0, 2e-4, 20_000)
    assert set(np.unique(Bins.of_equal_length(t_s, 4).count)) == {4}


def test_noise_that_neighbours_share_is_made_white() -> None:
    rng = np.random.default_rng(4)
    columns = csr_array(rng.standard_normal((200, 220)) * (np.abs(np.subtract.outer(np.arange(200), np.arange(220))) < 4))
    sigma = np.full((7, 200), 2.0)
    sigma[0] = np.inf
    noise = Whitening.of(sigma, {FZ: columns})
    drawn = 2.0 * rng.standard_normal((7, 200, 400))
    drawn[FZ] += columns @ rng.standard_normal((220, 400))
    white = np.array([noise.whiten(drawn[:, :, k]) for k in range(400)])
    covariance = white[:, FZ].T @ white[:, FZ] / 400
    assert np.abs(covariance - np.eye(200)).max() < 6.0 / 400**0.5
    assert np.abs(np.linalg.eigvalsh(drawn[FZ] @ drawn[FZ].T / 400 / 4.0)).max() > 4.0  # it was not
    assert not white[:, 0].any()
    np.testing.assert_allclose(noise.natural(white)[:, 1:], np.moveaxis(drawn, 2, 0)[:, 1:], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(noise.rms[FZ], np.std(drawn[FZ], axis=1), rtol=0.2)
    half = noise.restricted_to(np.arange(200) < 100).whiten(drawn[:, :, 0])
    assert not half[:, 100:].any()
    np.testing.assert_allclose(half[FZ, :100], white[0, FZ, :100])


def at_rest(wrench: np.ndarray) -> Samples:
    t_s = np.arange(len(wrench)) / 500.0
    return Samples(t_s, 0 * t_s, 0 * t_s, 0 * t_s, wrench)


def test_repeats_that_rounding_makes_by_chance_are_no_held_samples() -> None:
    """A coarse step that is rounded once more to the stated one lies on no lattice, and repeats all the more."""
    rng = np.random.default_rng(6)
    wrench = rng.normal(0.0, 1.0, (38_000, 6))
    wrench[:, :2] = np.round(wrench[:, :2] * 0.054 / 0.024) * 0.024
    wrench[:, 3:] = np.round(wrench[:, 3:])
    wrench[:, 2] = np.round(np.round((wrench[:, 2] * 0.05 + np.linspace(0.0, 4.0, 38_000)) / 0.48) * 0.48 / 0.131) * 0.131
    assert (np.diff(wrench, axis=0) == 0.0).all(axis=1).sum() >= 8
    assert without_held(at_rest(wrench))[1] == 0
    for row in range(500, 38_000, 1_900):
        wrench[row : row + 12] = wrench[row]
    assert without_held(at_rest(wrench))[1] >= 20


def test_two_long_stretches_are_held_samples_also_where_steps_make_short_ones() -> None:
    rng = np.random.default_rng(8)
    wrench = np.round(rng.normal(0.0, 0.6, (30_000, 6)))
    assert (np.diff(wrench, axis=0) == 0.0).all(axis=1).sum() > 10
    assert without_held(at_rest(wrench))[1] == 0
    for row in (5_000, 20_000):
        wrench[row : row + 40] = wrench[row]
    samples, stretches, held_s = without_held(at_rest(wrench))
    assert samples.held is not None
    assert stretches == 2
    assert samples.held.sum() < 90
    assert held_s == pytest.approx(39 / 500.0, abs=2 / 500.0)


def test_repeats_by_chance_are_counted_whatever_their_last_bits() -> None:
    """A rotation into base axes leaves other last bits in row after row."""
    rng = np.random.default_rng(7)
    wrench = 7.0 + np.round(rng.normal(0.0, 0.6, (20_000, 6)))
    turned = wrench * (1.0 + 4e-16 * (rng.random(20_000) < 0.5))[:, None]
    assert (np.diff(turned, axis=0) == 0.0).all(axis=1).sum() > 50
    assert without_held(at_rest(wrench))[1] == without_held(at_rest(turned))[1] == 0


def test_a_lone_axis_at_its_limits_is_neither_held_nor_coarse() -> None:
    rng, wrench = np.random.default_rng(9), np.zeros((8_000, 6))
    wrench[:, 2] = 0.02 * rng.standard_normal(8_000) + 4.0 * np.sin(np.arange(8_000) / 300.0)
    wrench[:, 2] = np.clip(wrench[:, 2], -0.5, 0.5)
    assert (np.diff(wrench[:, 2]) == 0.0).mean() > 0.8
    assert without_held(at_rest(wrench))[1] == 0
    assert coarse_step_N(at_rest(wrench), nominal()) == 0.0
    for row in np.flatnonzero(np.abs(wrench[:, 2]) < 0.4)[::20]:
        wrench[row : row + 12, 2] = wrench[row, 2]
    assert without_held(at_rest(wrench))[1] > 10, "held samples away from the limits are seen still"


def test_mean_and_variance_of_rounded_readings_are_those_of_simulated_ones() -> None:
    """Noise of 0.02 to 2 steps, forces anywhere between the levels: errors of a simulation of that length, and no larger ones."""
    rng, n = np.random.default_rng(12), 20_000
    for noise in np.exp(rng.uniform(np.log(0.02), np.log(2.0), 40)):
        force = rng.uniform(-3.0, 3.0, 5)
        readings = np.rint(force[:, None] + noise * rng.standard_normal((5, n)))
        mean, variance = rounded_moments(force, noise)
        fourth = ((readings - mean[:, None]) ** 4).mean(axis=1)
        assert (np.abs(readings.mean(axis=1) - mean) < 5.0 * np.sqrt(np.maximum(variance, 1e-4) / n)).all()
        assert (np.abs(readings.var(axis=1) - variance) < 5.0 * np.sqrt(np.maximum(fourth, 1e-4) / n)).all()


def test_noise_before_rounding_is_that_of_the_readings_wherever_they_rest() -> None:
    """Readings that rest in the middle of a level vary less than q²/12 alone, and those between two levels vary more."""
    rng, n = np.random.default_rng(13), 20_000
    seen = []
    for noise in np.exp(rng.uniform(np.log(0.1), np.log(3.0), 60)):
        rest = np.rint(rng.uniform(-0.5, 0.5) + noise * rng.standard_normal(n))
        low, high = noise_before_rounding(0.131 * rest, np.ones(n, bool), 0.131)
        assert 0.85 * low < 0.131 * noise < 1.15 * high
        seen.append(high < 1.3 * low)
        if noise > 0.3:
            assert seen[-1], "noise of 0.3 steps or more shows"
    assert not all(seen), "noise far below a step hides in it"


@pytest.mark.parametrize("cut", [np.rint, np.floor, np.trunc])
def test_the_step_of_coarse_readings_is_found(cut: Callable[[Floats], Floats]) -> None:
    wrench = np.random.default_rng(5).normal(0.0, 0.1, (20_000, 6)) + np.repeat(np.linspace(0.0, 8.0, 200), 100)[:, None]
    wrench[:, 2] = 0.37 * cut(wrench[:, 2] / 0.37)
    assert coarse_step_N(at_rest(wrench), nominal()) == pytest.approx(0.37, rel=2e-3)


def test_rounding_to_the_stated_step_counts_where_noise_does_not_dither_it() -> None:
    step_N = nominal().sensor.resolution_fz_N
    for noise, counts in ((0.3, True), (0.6, False)):
        assert (rounding_of(0.0, nominal(), noise * step_N) is not None) == counts


def free_strokes(cell: CellFile, bias_N: float = 0.0) -> Samples:
    """A recording of strokes and rests in the air."""
    t_s = np.arange(20_000) / 500.0
    z_cmd_m = 0.02 + 0.005 * np.clip(np.sin(2.0 * np.pi * t_s / 8.0) * 3.0, -1.0, 1.0)
    biased = cell.with_effects({"sensor.bias": {"offset_N": bias_N}})
    columns = simulate(biased, t_s, z_cmd_m=z_cmd_m, noise_seed=1)
    wrench = np.column_stack([columns[name] for name in ("fx_N", "fy_N", "fz_N", "tx_Nm", "ty_Nm", "tz_Nm")])
    return Samples(t_s, z_cmd_m, columns["z_m"], columns["vz_m_per_s"], wrench)


def undithered(noise_N: float = 0.03) -> CellFile:
    sensor = nominal().sensor.model_copy(update={"noise_rms_N": noise_N})
    return nominal().model_copy(update={"sensor": sensor})


@pytest.mark.parametrize("noise_N", [0.018, 0.03])
@pytest.mark.parametrize("bias_N", [0.0, 0.03, 0.0655])
def test_an_axis_is_no_noisier_or_quieter_for_where_it_rests_between_its_levels(noise_N: float, bias_N: float) -> None:
    cell = undithered(noise_N)
    samples = free_strokes(cell, bias_N)

    def p_lone_axis(samples: Samples) -> float:
        return observe([samples], cell, EFFECTS, (), 600).scatter.p_lone_axis

    assert p_lone_axis(samples) < 0.01
    louder = samples.wrench + 0.1 * np.random.default_rng(2).standard_normal((20_000, 1)) * (np.arange(6) == 2)
    assert p_lone_axis(replace(samples, wrench=louder)) > 0.99


def rounded_laterals(step_noises: float, effects: EffectValues | None = None) -> tuple[Samples, CellFile]:
    """Presses whose lateral forces and torques are rounded to a step of that many noises, and the cell file that states it."""
    stated, motion = nominal().sensor, recording("second order", 101)
    steps = {"resolution_fxy_N": step_noises * stated.noise_rms_N, "resolution_Nm": step_noises * stated.noise_rms_Nm}
    cell = nominal().model_copy(update={"sensor": stated.model_copy(update=steps)})
    columns = simulate(cell.with_effects(effects or {}), motion.t_s, z_cmd_m=motion.z_cmd_m, noise_seed=1)
    wrench = np.column_stack([columns[name] for name in WRENCH])
    return Samples(motion.t_s, motion.z_cmd_m, columns["z_m"], columns["vz_m_per_s"], wrench), cell


@pytest.mark.parametrize("step_noises", [3.0, 5.0, 8.0])
def test_lateral_axes_that_rest_within_a_level_are_no_gap(step_noises: float) -> None:
    samples, cell = rounded_laterals(step_noises)
    diagnosis = diagnose([samples], cell, max_bins=900, propose=False)
    assert diagnosis.verdict == "none", diagnosis.sentence
    assert not any("sensor.noise" in note for note in diagnosis.notes)


def test_a_lateral_force_of_many_steps_is_seen_through_coarse_ones() -> None:
    samples, cell = rounded_laterals(5.0, {"contact.lateral": {"ratio": 0.15, "azimuth_rad": 0.3}})
    diagnosis = diagnose([samples], cell, max_bins=900, propose=False)
    assert diagnosis.verdict != "none", diagnosis.sentence


def test_no_number_of_bins_averages_an_error_of_rounding_that_noise_does_not_dither() -> None:
    samples, cell = rounded_laterals(8.0)
    fine, coarse = (make_problem([samples], cell, max_bins=bins).noise.sigma[1] for bins in (4000, 600))
    information = [np.sum(sigma**-2.0) * cell.sensor.resolution_fxy_N**2 / 12.0 for sigma in (fine, coarse)]
    assert information[0] == pytest.approx(information[1], rel=0.1)
    assert information[0] < 10.0


def test_tails_are_taken_out_of_noise_that_is_too_large_only() -> None:
    rng = np.random.default_rng(6)
    stated = np.array([nominal().sensor.noise_rms_N] * 3 + [nominal().sensor.noise_rms_Nm] * 3)
    white = rng.standard_t(4.0, (20_000, 6)) / 2.0**0.5
    healthy, noisy = at_rest(0.9 * stated * white), at_rest(2.0 * stated * white)
    assert without_tails(healthy, nominal()) is healthy
    nearer = without_tails(noisy, nominal()).wrench / stated
    assert np.abs(noisy.wrench / stated).max() > 15.0
    assert np.abs(nearer).max() < 9.0
    assert np.abs(nearer.mean(axis=0)).max() < 0.05


@pytest.mark.parametrize("ratio", [1.0, 1.084, 1.15])
def test_readings_of_two_slopes_have_the_finer_of_two_steps(ratio: float) -> None:
    rng = np.random.default_rng(4)
    load_N = np.repeat(rng.uniform(-1.5, 8.0, 200), 40) + rng.normal(0.0, 0.05, 8000)
    counts = np.rint(load_N / 0.131)
    corrected_N = np.where(counts > 15, (counts - 15) * 0.131 + 15 * 0.131 / ratio, counts * 0.131 / ratio)
    assert lattice_step(corrected_N) == pytest.approx(0.131 / ratio, rel=1e-6)


def test_readings_without_a_step_have_none() -> None:
    levels_N = np.sort(np.random.default_rng(5).uniform(0.0, 8.0, 80))
    assert lattice_step(np.repeat(levels_N, 50)) == 0.0
