"""What the diagnosis takes for noise, and where samples stand in time."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.sparse import csr_array

from palpd.cell.cell_file import nominal
from palpd.gap.bins import Bins
from palpd.gap.noise import FZ, lattice_step
from palpd.gap.rounding import Rounding, Way, coarse_step_N, rounding_of
from palpd.gap.scatter import without_held, without_tails
from palpd.gap.whitening import Whitening
from palpd.recording.oddities import measured_rms
from palpd.recording.samples import Samples
from palpd.tick import Floats


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


def test_repeats_by_chance_are_counted_whatever_their_last_bits() -> None:
    """A rotation into base axes leaves other last bits in row after row."""
    rng = np.random.default_rng(7)
    wrench = 7.0 + np.round(rng.normal(0.0, 0.6, (20_000, 6)))
    turned = wrench * (1.0 + 4e-16 * (rng.random(20_000) < 0.5))[:, None]
    assert (np.diff(turned, axis=0) == 0.0).all(axis=1).sum() > 50
    assert without_held(at_rest(wrench))[1] == without_held(at_rest(turned))[1] == 0


@pytest.mark.parametrize("level", [0.0, 0.5])
def test_coarse_rounding_is_found_and_followed_on_average(level: float) -> None:
    rng = np.random.default_rng(5)
    wrench = rng.normal(0.0, 0.1, (20_000, 6)) + np.linspace(0.0, 8.0, 20_000)[:, None]
    wrench[:, 2] = (np.rint(wrench[:, 2] / 0.37 - level) + level) * 0.37
    coarse = rounding_of([at_rest(wrench)], [coarse_step_N(at_rest(wrench), nominal())], nominal(), 0.1, 0.0)
    assert coarse is not None
    assert coarse.step_N == pytest.approx(0.37, rel=2e-3)
    assert abs((coarse.level_N / 0.37 - level + 0.5) % 1.0 - 0.5) < 0.1
    rounding = Rounding(0.37, 0.1, 0.12)
    for force_N in (0.0, 0.2, 1.23):
        readings = 0.1 + 0.37 * np.rint((force_N + rng.normal(0.0, 0.12, 200_000) - 0.1) / 0.37)
        assert rounding.mean(np.array([force_N]))[0] == pytest.approx(readings.mean(), abs=2e-3)
    assert rounding.slope(np.linspace(0.0, 3.7, 1000)).mean() == pytest.approx(1.0, abs=0.01)


def test_rounding_to_the_stated_step_counts_where_noise_does_not_dither_it() -> None:
    rng = np.random.default_rng(8)
    step_N = nominal().sensor.resolution_fz_N
    for noise, counts in ((0.3, True), (0.6, False)):
        wrench = np.zeros((20_000, 6))
        wrench[:, 2] = np.round(rng.normal(0.4 * step_N, noise * step_N, 20_000) / step_N) * step_N
        rounding = rounding_of([at_rest(wrench)], [0.0], nominal(), noise * step_N, 0.0)
        mean_N = 0.4 * step_N if rounding is None else float(rounding.mean(np.array([0.4 * step_N]))[0])
        assert (rounding is not None) == counts
        assert mean_N == pytest.approx(wrench[:, 2].mean(), abs=4.0 * noise * step_N / 20_000**0.5 + 1e-3 * step_N)


def test_levels_lie_where_the_zero_of_the_sensor_puts_them_and_are_known_in_the_air_only() -> None:
    """A bias of a quarter of a step moves the force at rest to the side of its level."""
    step_N, noise_N = nominal().sensor.resolution_fz_N, 0.3 * nominal().sensor.resolution_fz_N
    rng = np.random.default_rng(9)
    force_N, bias_N = 0.1 * step_N, 0.25 * step_N
    wrench = np.zeros((200_000, 6))
    wrench[:, 2] = np.round((rng.normal(bias_N, noise_N, 200_000)) / step_N) * step_N
    rounding = rounding_of([at_rest(wrench)], [0.0], nominal(), noise_N, float(wrench[:, 2].mean()))
    assert rounding is not None
    more = np.round(rng.normal(force_N + bias_N, noise_N, 200_000) / step_N) * step_N
    at_zero_N, there_N = rounding.mean(np.array([0.0, force_N]))
    assert there_N - at_zero_N == pytest.approx(more.mean() - wrench[:, 2].mean(), abs=0.01 * step_N)
    far_N = np.array([5.3 * step_N])
    assert rounding.mean(far_N) == far_N


@pytest.mark.parametrize(("way", "cut"), [("down", np.floor), ("to zero", np.trunc)])
def test_readings_that_are_cut_and_not_rounded_are_followed_on_average(way: Way, cut: Callable[[Floats], Floats]) -> None:
    rng = np.random.default_rng(7)
    for force_N in (-1.1, -0.1, 0.0, 0.2, 1.23):
        readings = 0.37 * cut((force_N + rng.normal(0.0, 0.12, 200_000)) / 0.37)
        assert Rounding(0.37, 0.0, 0.12, way).mean(np.array([force_N]))[0] == pytest.approx(readings.mean(), abs=2e-3)


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
