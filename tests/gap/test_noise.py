"""What the diagnosis takes for noise, and where samples stand in time."""

import numpy as np

from palpd.gap.bins import Bins, straight_between
from palpd.gap.noise import measured_rms


def test_noise_is_measured_within_rests_and_not_in_the_steps_between_them() -> None:
    height_m = np.repeat([0.0, 0.01, -0.005, 0.02] * 5, 12) + 5e-6 * np.random.default_rng(1).standard_normal(240)
    rest = np.tile(np.arange(12) > 2, 20)
    assert abs(measured_rms(height_m, rest) / 5e-6 - 1.0) < 0.2
    assert measured_rms(height_m[rest]) > 1e-3


def test_values_of_uneven_times_are_found_from_those_of_even_ones() -> None:
    uneven_s = np.cumsum(np.random.default_rng(2).uniform(0.8e-3, 1.2e-3, 500))
    even_s = np.linspace(uneven_s[0], uneven_s[-1], 500)
    there = straight_between(uneven_s, even_s) @ np.sin(20.0 * even_s)
    assert float(np.abs(there - np.sin(20.0 * uneven_s)).max()) < 1e-4


def test_steps_of_several_samples_keep_their_length_where_times_jitter() -> None:
    t_s = np.arange(20_000) * 2e-3 + np.random.default_rng(3).uniform(0.0, 2e-4, 20_000)
    assert set(np.unique(Bins.of_equal_length(t_s, 4).count)) == {4}
