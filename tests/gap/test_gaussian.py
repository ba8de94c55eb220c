"""The linear Gaussian algebra against the normal distributions of scipy, with numbers small enough for a hand."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from palpd.gap.assumptions import ASSUMED
from palpd.gap.gaussian.evidence import group_evidence, posterior_of
from palpd.gap.gaussian.nuisance_space import NuisanceSpace, Products
from palpd.gap.gaussian.nuisances import Columns, Nuisances, ProjectedColumns, Vectors, gram, nuisances, project
from palpd.tick import Floats

SHAPE = (7, 12)
N = SHAPE[0] * SHAPE[1]
RANDOM = np.random.default_rng(5)
A = RANDOM.standard_normal((3, *SHAPE)) * (RANDOM.random((3, *SHAPE)) < 0.3)
R = RANDOM.standard_normal(SHAPE) + 2.0 * A[0]
P = np.linalg.inv(np.eye(N) + A.reshape(3, N).T @ A.reshape(3, N))


def gathered(dense: Floats) -> Columns:
    return Columns.of([dict(enumerate(vector)) for vector in dense], SHAPE)


SPACE: Nuisances = nuisances(gathered(A))


def test_the_density_of_a_residual_is_that_of_scipy() -> None:
    r = project(R, SPACE)
    density = -0.5 * (r.dot(r) + SPACE.log_determinant + N * np.log(2.0 * np.pi))
    assert density == pytest.approx(multivariate_normal(cov=np.linalg.inv(P)).logpdf(R.ravel()))


def test_a_single_bin_by_hand() -> None:
    """A = 3 and r = 5: det(I + AᵀA) = 10, ĉ = 3 · 5 / 10, and r - A ĉ = 5 - 4.5 = P r."""
    space = nuisances(Columns.of([{0: np.array([3.0])}], (1, 1)))
    assert space.log_determinant == pytest.approx(np.log(10.0))
    assert space.coefficients(np.array([[5.0]])) == pytest.approx([1.5])
    assert space.remainder(np.array([[5.0]])) == pytest.approx(np.array([[0.5]]))
    assert project(np.array([[5.0]]), space).dot(project(np.array([[5.0]]), space)) == pytest.approx(2.5)
    assert space.beyond(np.array([[10.0]])) == pytest.approx(np.array([[4.0]])), "ĉ is 3, and 2 of it are plausible"


def test_the_coefficients_are_those_that_the_residual_makes_likeliest() -> None:
    """Coefficients and residual are jointly normal: E[c | r] = cov(c, r) cov(r, r)⁻¹ r."""
    np.testing.assert_allclose(SPACE.coefficients(R), A.reshape(3, N) @ P @ R.ravel(), atol=1e-12)
    np.testing.assert_allclose(SPACE.remainder(R).ravel(), P @ R.ravel(), atol=1e-12)


def test_one_vector_and_many_are_projected_alike() -> None:
    dense = RANDOM.standard_normal((4, *SHAPE))
    flat = dense.reshape(4, N)
    many = ProjectedColumns.of(Vectors.of([dict(enumerate(vector)) for vector in dense], SHAPE), SPACE)
    np.testing.assert_allclose(gram([project(vector, SPACE) for vector in dense]), flat @ P @ flat.T, atol=1e-10)
    np.testing.assert_allclose(many.squares, np.diag(flat @ P @ flat.T), atol=1e-10)
    np.testing.assert_allclose(many.dot(project(R, SPACE)), flat @ P @ R.ravel(), atol=1e-10)


def in_channel(values: Floats, channel: int = 3) -> Floats:
    """Columns (b, n) of one channel as (n, 84) with its zeros."""
    out = np.zeros((values.shape[1], *SHAPE))
    out[:, channel] = values.T
    return out.reshape(-1, N)


def assert_products(products: Products, x: Floats, projection: Floats, residual: Floats) -> None:
    np.testing.assert_allclose(products.gram, x @ projection @ x.T, atol=1e-9)
    np.testing.assert_allclose(products.slope, x @ projection @ residual, atol=1e-9)


def test_products_in_all_bins_and_in_folds_are_those_of_the_projection() -> None:
    columns, fold = RANDOM.standard_normal((12, 2)), np.arange(12) % 3
    space, x = NuisanceSpace(gathered(A), R), in_channel(columns)
    assert_products(space.products({3: columns}), x, P, R.ravel())
    np.testing.assert_allclose(space.products({3: columns}).raw, columns.T @ columns)
    for parts, kept in zip(space.folded({3: columns}, fold, 3), (np.equal, np.not_equal), strict=True):
        for number, products in enumerate(parts):
            live = np.broadcast_to(kept(fold, number), SHAPE).ravel()
            a = np.where(live, A.reshape(3, N), 0.0)
            assert_products(products, np.where(live, x, 0.0), np.linalg.inv(np.eye(N) + a.T @ a), np.where(live, R.ravel(), 0.0))


def test_windows_of_a_shape_are_columns_of_their_own() -> None:
    shape, begin, end = RANDOM.standard_normal(12), np.array([0, 2, 7]), np.array([3, 9, 12])
    cut = np.where((np.arange(12)[:, None] >= begin) & (np.arange(12)[:, None] < end), shape[:, None], 0.0)
    space = NuisanceSpace(gathered(A), R)
    squares, slopes = space.windows(3, shape, begin, end)
    products = space.products({3: cut})
    np.testing.assert_allclose(squares, np.diag(products.gram), atol=1e-10)
    np.testing.assert_allclose(slopes, products.slope, atol=1e-10)


def test_the_evidence_of_one_column_by_hand() -> None:
    """X = 2 in one bin and r = 6: w ~ N(0, s²/4) makes r a normal number of variance 1 + s²."""
    space = NuisanceSpace(Columns.of([], (7, 1)), np.full((7, 1), 6.0))
    products = space.products({3: np.array([[2.0]])})
    ratios = [norm.pdf(6.0, scale=(1.0 + size**2) ** 0.5) / norm.pdf(6.0) for size in ASSUMED.laws.sizes_sd]
    evidence = group_evidence(products, (np.eye(1),))
    assert evidence.nats == pytest.approx(np.log(np.mean(ratios)))
    assert ASSUMED.laws.sizes_sd[int(np.argmax(ratios))] == 8.0
    assert evidence.mean == pytest.approx([6.0 / 2.0 * 64.0 / 65.0])
    assert evidence.covariance == pytest.approx(np.array([[1.0 / 4.0 * 64.0 / 65.0]]))


def test_the_coefficients_of_a_group_are_those_of_two_normal_distributions() -> None:
    columns, root = RANDOM.standard_normal((12, 2)), np.array([[2.0, 0.0], [1.0, 0.5]])
    x, prior = in_channel(columns), root @ root.T
    mean, covariance = posterior_of(NuisanceSpace(gathered(A), R).products({3: columns}), root)
    gain = prior @ x @ np.linalg.inv(np.linalg.inv(P) + x.T @ prior @ x)
    np.testing.assert_allclose(mean, gain @ R.ravel(), atol=1e-9)
    np.testing.assert_allclose(covariance, prior - gain @ x.T @ prior, atol=1e-9)
