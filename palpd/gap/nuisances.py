"""Linear Gaussian nuisances, marginalised exactly: data = signal + columns · coefficients + white noise, coefficients ~ N(0, 1)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular

from palpd.tick import Floats

Ints = NDArray[np.intp]

SMALLEST_SQUARE = 1e-24
"""Square of a row, as a share of the largest one's, below which the row is taken for zero: 16 digits hold no more."""

PLAUSIBLE_SD = 2.0
"""Standard deviations that a deviation within specification may have: 95 % of all are smaller."""


@dataclass(frozen=True)
class Nuisances:
    """Columns (k, c, b) over c channels and b bins in units of the noise, kept per channel where they are not zero."""

    per_channel: tuple[tuple[Ints, Floats], ...]  # indices into k, and columns (b, those)
    factor: Floats  # lower Cholesky factor of I + AᵀA
    log_determinant: float

    @property
    def size(self) -> int:
        """Number of columns."""
        return len(self.factor)

    def against(self, values: Floats) -> Floats:
        """Inner products of the columns with a vector, whitened.

        Args:
            values: The vector (c, b).

        Returns:
            The products (k,).
        """
        product = np.zeros(self.size)
        for (index, columns), channel in zip(self.per_channel, values, strict=True):
            if len(index) and channel.any():
                product[index] += columns.T @ channel
        return np.asarray(solve_triangular(self.factor, product, lower=True, check_finite=False))

    def coefficients(self, values: Floats) -> Floats:
        """Posterior mean of the coefficients.

        Args:
            values: Residual (c, b).

        Returns:
            The coefficients (k,).
        """
        return np.asarray(solve_triangular(self.factor, self.against(values), lower=True, trans="T", check_finite=False))

    def explained(self, coefficients: Floats) -> Floats:
        """Columns times coefficients.

        Args:
            coefficients: The coefficients (k,).

        Returns:
            Their sum (c, b).
        """
        return np.array([columns @ coefficients[index] for index, columns in self.per_channel])

    def beyond(self, values: Floats) -> Floats:
        """The part of a vector that plausible coefficients cannot hide.

        Args:
            values: The vector (c, b).

        Returns:
            The vector without what coefficients within PLAUSIBLE_SD explain (c, b).
        """
        return np.asarray(values - self.explained(np.clip(self.coefficients(values), -PLAUSIBLE_SD, PLAUSIBLE_SD)))


def nuisances(columns: Floats) -> Nuisances:
    """Prepare columns to be projected out.

    Args:
        columns: Columns (k, c, b), each multiplied with the standard deviation of its coefficient.

    Returns:
        The nuisances.
    """
    k, c, b = columns.shape
    return nuisances_by_channel([list(enumerate(columns[:, channel])) for channel in range(c)], k, b)


def nuisances_by_channel(columns: Sequence[Sequence[tuple[int, Floats]]], k: int, b: int) -> Nuisances:
    """Prepare columns that are zero in most channels to be projected out.

    Args:
        columns: Numbers and values (b,) of the columns in each channel, in ascending order, as in `nuisances`.
        k: Number of columns.
        b: Number of bins.

    Returns:
        The nuisances.
    """
    gram = np.eye(k)
    per_channel: list[tuple[Ints, Floats]] = []
    for channel in columns:
        live = [(number, values) for number, values in channel if values.any()]
        index = np.array([number for number, _ in live], dtype=np.intp)
        part = np.column_stack([values for _, values in live]) if live else np.zeros((b, 0))
        gram[np.ix_(index, index)] += part.T @ part
        per_channel.append((index, part))
    factor = cholesky(gram, lower=True, check_finite=False)
    return Nuisances(tuple(per_channel), factor, 2.0 * float(np.log(np.diag(factor)).sum()))


@dataclass(frozen=True)
class Projected:
    """A vector (c, b) and its inner products with the nuisances, so that further inner products are cheap."""

    values: Floats
    seen: Floats

    def dot(self, other: "Projected") -> float:
        """Inner product with the nuisances projected out."""
        return float(np.vdot(self.values, other.values) - self.seen @ other.seen)


def project(values: Floats, space: Nuisances) -> Projected:
    """Prepare a vector for inner products with the nuisances projected out.

    Args:
        values: The vector (c, b).
        space: The nuisances.

    Returns:
        The projected vector.
    """
    return Projected(values, space.against(values))


def gram(vectors: list[Projected]) -> Floats:
    """Inner products (n, n) of n vectors with each other."""
    return np.array([[a.dot(b) for b in vectors] for a in vectors]).reshape(len(vectors), len(vectors))


@dataclass(frozen=True)
class Widened:
    """Nuisances with further columns (m, c, b) whose size is left open: at every size of them inner products are cheap."""

    space: Nuisances
    columns: Floats
    crossed: Floats  # (k, m) columns of the space against the further ones, whitened
    squares: Floats  # (m, m) inner products of the further ones, with the space projected out

    @staticmethod
    def by(space: Nuisances, columns: Floats) -> "Widened":
        """Widen nuisances by further columns.

        Args:
            space: The nuisances.
            columns: The further columns (m, c, b).

        Returns:
            Both together.
        """
        m, c, _ = columns.shape
        raw, products = np.zeros((m, m)), np.zeros((space.size, m))
        for channel in range(c):
            live = np.flatnonzero(columns[:, channel].any(axis=1))
            part = columns[live, channel]
            raw[np.ix_(live, live)] += part @ part.T
            index, nuisance = space.per_channel[channel]
            if len(index):
                products[np.ix_(index, live)] += nuisance.T @ part.T
        crossed = solve_triangular(space.factor, products, lower=True, check_finite=False)
        return Widened(space, columns, crossed, raw - crossed.T @ crossed)

    def against(self, vector: Projected) -> Floats:
        """Inner products (m,) of the further columns with a vector, the nuisances projected out."""
        return np.asarray(np.tensordot(self.columns, vector.values, axes=2) - self.crossed.T @ vector.seen)


def stable_inverse(normal: Floats) -> Floats:
    """Inverse of a symmetric matrix whose rows may differ by orders of magnitude.

    Args:
        normal: The matrix (k, k).

    Returns:
        Its pseudo-inverse (k, k).
    """
    diagonal = np.abs(np.diag(normal))
    scale = np.sqrt(np.maximum(diagonal, max(SMALLEST_SQUARE * float(diagonal.max(initial=0.0)), 1e-300)))
    scaled = normal / scale / scale[:, None]
    return np.asarray(np.linalg.pinv(scaled, rcond=1e-9, hermitian=True) / scale / scale[:, None])
