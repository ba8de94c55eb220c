"""Columns that live in few bins are kept sparse; this changes no number."""

import numpy as np
import pytest

from palpd.gap.gaussian.nuisances import Columns, ProjectedColumns, Vectors, nuisances
from palpd.tick import Floats

SHAPE = (3, 90)


def values(seed: int, count: int) -> Floats:
    """Columns (count, 3, 90): the first through all bins of two channels, the others in ten bins of one."""
    rng = np.random.default_rng(seed)
    out = np.zeros((count, *SHAPE))
    out[0, :2] = rng.standard_normal((2, 90))
    for k in range(1, count):
        out[k, k % 3, 8 * k : 8 * k + 10] = rng.standard_normal(10)
    return out


def gathered(dense: Floats) -> Columns:
    return Columns.of([dict(enumerate(one)) for one in dense], SHAPE)


def products(dense: Floats) -> Floats:
    return np.asarray(np.tensordot(dense, dense, axes=([1, 2], [1, 2])))


def test_sparse_columns_give_the_same_products() -> None:
    one, other = values(1, 7), values(2, 5)
    both = np.concatenate([one, other])
    columns = gathered(one).followed_by(gathered(other))
    np.testing.assert_array_equal(columns.dense(), both)
    np.testing.assert_allclose(columns.gram, products(both), atol=1e-12)
    signal = np.random.default_rng(3).standard_normal(SHAPE)
    np.testing.assert_allclose(columns.against(dict(enumerate(signal))), np.tensordot(both, signal, axes=2), atol=1e-12)
    np.testing.assert_allclose(columns.times(np.arange(12.0)), np.tensordot(np.arange(12.0), both, axes=1), atol=1e-12)
    numbers, rows = columns.of_channel(1)
    np.testing.assert_array_equal(rows, both[numbers, 1])


@pytest.mark.parametrize("by_channel", [False, True])
def test_columns_restricted_to_some_bins_are_zero_in_the_others(by_channel: bool) -> None:
    dense = values(1, 7)
    bins = np.random.default_rng(4).random(SHAPE if by_channel else SHAPE[1:]) < 0.5
    there = gathered(dense).restricted_to(bins)
    np.testing.assert_array_equal(there.dense(), np.where(bins, dense, 0.0))
    np.testing.assert_allclose(there.gram, products(np.where(bins, dense, 0.0)), atol=1e-12)


def test_joined_bins_keep_the_size_of_noise() -> None:
    dense = values(1, 7)
    joined = np.add.reduceat(dense, np.arange(0, SHAPE[1], 4), axis=2) / 2.0
    there = gathered(dense).joined(4)
    np.testing.assert_allclose(there.dense(), joined, atol=1e-12)
    np.testing.assert_allclose(there.gram, products(joined), atol=1e-12)


def test_columns_that_are_taken_away_are_zero() -> None:
    dense = values(1, 7)
    left, taken = gathered(dense).without(np.array([0, 3]))
    np.testing.assert_array_equal(np.array(taken), dense[[0, 3]])
    dense[[0, 3]] = 0.0
    np.testing.assert_array_equal(left.dense(), dense)
    np.testing.assert_allclose(left.gram, products(dense), atol=1e-12)


def test_nuisances_project_out_sparse_columns_too() -> None:
    dense, signal = values(1, 7), np.random.default_rng(3).standard_normal(SHAPE)
    space = nuisances(gathered(dense))
    flat = dense.reshape(7, -1)
    expected = np.linalg.solve(np.eye(7) + flat @ flat.T, flat @ signal.ravel())
    np.testing.assert_allclose(space.coefficients(signal), expected, atol=1e-12)
    others = Vectors.of([dict(enumerate(signal)), dict(enumerate(dense[2]))], SHAPE)
    np.testing.assert_allclose(ProjectedColumns.of(others, space).seen[:, 0], space.against(signal), atol=1e-12)
    np.testing.assert_allclose(others.squares, [(signal**2).sum(), (dense[2] ** 2).sum()])
