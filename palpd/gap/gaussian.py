"""Linear Gaussian nuisances, marginalised exactly: data = signal + columns · coefficients + white noise, coefficients ~ N(0, 1)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular

from palpd.tick import Floats

Ints = NDArray[np.intp]


PLAUSIBLE = 2.0
"""So many standard deviations a deviation within specification may well have."""


@dataclass(frozen=True)
class Nuisances:
    """Columns (k, c, b) over c channels and b bins in units of the noise, kept per channel where they are not zero."""

    per_channel: tuple[tuple[Ints, Floats], ...]  # indices into k, and columns (b, those)
    factor: Floats  # lower Cholesky factor of I + AᵀA
    log_determinant: float

    @property
    def size(self) -> int:
        """How many columns."""
        return len(self.factor)

    def against(self, values: Floats) -> Floats:
        """Columnsᵀ · values, whitened: (k,) for values (c, b)."""
        product = np.zeros(self.size)
        for (index, columns), channel in zip(self.per_channel, values, strict=True):
            if len(index) and channel.any():
                product[index] += columns.T @ channel
        return np.asarray(solve_triangular(self.factor, product, lower=True, check_finite=False))

    def coefficients(self, values: Floats) -> Floats:
        """Posterior mean of the coefficients, given values (c, b)."""
        return np.asarray(solve_triangular(self.factor, self.against(values), lower=True, trans="T", check_finite=False))

    def beyond(self, values: Floats) -> Floats:
        """What of values (c, b) is left when no coefficient may be larger than two standard deviations: more than that they hide not."""
        return np.asarray(values - self.explained(np.clip(self.coefficients(values), -PLAUSIBLE, PLAUSIBLE)))

    def explained(self, coefficients: Floats) -> Floats:
        """Columns · coefficients, (c, b)."""
        return np.array([columns @ coefficients[index] for index, columns in self.per_channel])


def nuisances(columns: Floats) -> Nuisances:
    """Prepared columns (k, c, b); each already multiplied with the standard deviation of its coefficient."""
    k, c, _ = columns.shape
    gram = np.eye(k)
    per_channel: list[tuple[Ints, Floats]] = []
    for channel in range(c):
        index = np.flatnonzero(columns[:, channel].any(axis=1))
        part = np.ascontiguousarray(columns[index, channel].T)
        gram[np.ix_(index, index)] += part.T @ part
        per_channel.append((index, part))
    factor = cholesky(gram, lower=True, check_finite=False)
    return Nuisances(tuple(per_channel), factor, 2.0 * float(np.log(np.diag(factor)).sum()))


@dataclass(frozen=True)
class Widened:
    """Nuisances together with further columns (m, c, b) whose size is left open: at every size of them inner products are cheap."""

    space: Nuisances
    columns: Floats
    crossed: Floats  # (k, m) columns of the space against the further ones, whitened
    squares: Floats  # (m, m) the further ones among themselves, with the space projected out

    @staticmethod
    def by(space: Nuisances, columns: Floats) -> "Widened":
        """The space widened by columns."""
        m, c, _ = columns.shape
        raw, products = np.zeros((m, m)), np.zeros((space.size, m))
        for channel in range(c):
            live = np.flatnonzero(columns[:, channel].any(axis=1))
            part = columns[live, channel]
            raw[np.ix_(live, live)] += part @ part.T
            index, own = space.per_channel[channel]
            if len(index):
                products[np.ix_(index, live)] += own.T @ part.T
        crossed = solve_triangular(space.factor, products, lower=True, check_finite=False)
        return Widened(space, columns, crossed, raw - crossed.T @ crossed)

    def against(self, vector: "Projected") -> Floats:
        """The further columns' inner products (m,) with a vector, the space projected out."""
        return np.asarray(np.tensordot(self.columns, vector.values, axes=2) - self.crossed.T @ vector.seen)


@dataclass(frozen=True)
class Projected:
    """A vector (c, b) together with what the nuisances see of it, so that inner products are cheap."""

    values: Floats
    seen: Floats

    def dot(self, other: "Projected") -> float:
        """Inner product with the nuisances projected out."""
        return float(np.vdot(self.values, other.values) - self.seen @ other.seen)


def project(values: Floats, space: Nuisances) -> Projected:
    """The vector as the nuisances leave it."""
    return Projected(values, space.against(values))


def gram(vectors: list[Projected], others: list[Projected] | None = None) -> Floats:
    """Inner products of all with all, (n, m)."""
    others = vectors if others is None else others
    return np.array([[a.dot(b) for b in others] for a in vectors]).reshape(len(vectors), len(others))
