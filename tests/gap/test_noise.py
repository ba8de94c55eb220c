"""What the diagnosis takes for noise, and where samples stand in time."""

import numpy as np
from scipy.sparse import csr_array

from palpd.gap.bins import Bins
from palpd.gap.noise import FZ, measured_rms
from palpd.gap.whitening import Whitening


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
    half = noise.restricted(np.arange(200) < 100).whiten(drawn[:, :, 0])
    assert not half[:, 100:].any()
    np.testing.assert_allclose(half[FZ, :100], white[0, FZ, :100])
