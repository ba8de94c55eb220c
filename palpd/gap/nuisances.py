"""Linear Gaussian nuisances, marginalised exactly: data = signal + columns · coefficients + white noise, coefficients ~ N(0, 1)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular

from palpd.tick import Floats

Ints = NDArray[np.intp]

SMALLEST_SQUARE = 1e-24
"""Square of a row, as a share of the largest one's, below which the row is taken for zero: 16 digits hold no more."""

SHORT_SHARE = 0.25
"""Share of all bins below which only the bins of a column are kept in which it is not zero: most columns of a press are so."""

PLAUSIBLE_SD = 2.0
"""Standard deviations that a deviation within specification may have: 95 % of all are smaller."""


class Block(NamedTuple):
    """Columns (n, m) that are zero but in one channel and there in some bins, and their numbers (m,)."""

    channel: int
    bins: slice
    numbers: Ints
    columns: Floats


@dataclass(frozen=True)
class Columns:
    """Columns (k, c, b) over c channels and b bins in units of the noise, kept where they are not zero."""

    shape: tuple[int, int]  # (c, b)
    blocks: tuple[Block, ...]
    gram: Floats  # (k, k) their inner products

    @property
    def size(self) -> int:
        """Number of columns."""
        return len(self.gram)

    @staticmethod
    def of(columns: Sequence[Mapping[int, Floats]], shape: tuple[int, int]) -> "Columns":
        """Gather columns.

        Args:
            columns: Values (b,) of each column by channel, in the channels where they are not zero.
            shape: Numbers of channels and bins (c, b).

        Returns:
            The columns.
        """
        blocks = _blocks(columns, shape[1])
        return Columns(shape, blocks, _inner_products(blocks, blocks, (len(columns), len(columns))))

    def beside(self, others: "Columns") -> "Columns":
        """These columns, and others after them."""
        n = self.size
        gram = np.zeros((n + others.size, n + others.size))
        gram[:n, :n], gram[n:, n:] = self.gram, others.gram
        gram[:n, n:] = _inner_products(self.blocks, others.blocks, (n, others.size))
        gram[n:, :n] = gram[:n, n:].T
        return Columns(self.shape, (*self.blocks, *(other._replace(numbers=n + other.numbers) for other in others.blocks)), gram)

    def without(self, numbers: Ints) -> tuple["Columns", list[Floats]]:
        """The columns with some of them set to zero.

        Args:
            numbers: Which of them, in ascending order.

        Returns:
            The columns, and those that were taken away, each (c, b).
        """
        if not len(numbers):
            return self, []
        taken, blocks, gram = np.zeros((len(numbers), *self.shape)), [], self.gram.copy()
        gram[numbers] = gram[:, numbers] = 0.0
        for block in self.blocks:
            gone = np.flatnonzero(np.isin(block.numbers, numbers))
            taken[np.searchsorted(numbers, block.numbers[gone]), block.channel, block.bins] = block.columns[:, gone].T
            blocks.append(block._replace(numbers=np.delete(block.numbers, gone), columns=np.delete(block.columns, gone, axis=1)))
        return Columns(self.shape, tuple(blocks), gram), list(taken)

    def restricted_to(self, bins: NDArray[np.bool_]) -> "Columns":
        """The columns where only some bins count; the others are zero.

        Args:
            bins: Which of them (b,).

        Returns:
            New columns.
        """
        blocks = tuple(block._replace(columns=np.where(bins[block.bins, None], block.columns, 0.0)) for block in self.blocks)
        return Columns(self.shape, blocks, _inner_products(blocks, blocks, self.gram.shape))

    def dense(self) -> Floats:
        """The columns (k, c, b) with their zeros."""
        out = np.zeros((self.size, *self.shape))
        for block in self.blocks:
            out[block.numbers, block.channel, block.bins] = block.columns.T
        return out


def _blocks(columns: Sequence[Mapping[int, Floats]], b: int) -> tuple[Block, ...]:
    """Columns that live in the same bins of a channel, together; most live in nearly all bins."""
    groups: dict[tuple[int, int, int], list[tuple[int, Floats]]] = {}
    for number, column in enumerate(columns):
        for channel, values in column.items():
            if len(there := np.flatnonzero(values)):
                first, end = int(there[0]), int(there[-1]) + 1
                if end - first > SHORT_SHARE * b:
                    first, end = 0, b
                groups.setdefault((channel, first, end), []).append((number, values[first:end]))
    return tuple(
        Block(channel, slice(first, end), np.array([n for n, _ in those], dtype=np.intp), np.array([values for _, values in those]).T)
        for (channel, first, end), those in groups.items()
    )


def _inner_products(ones: Sequence[Block], others: Sequence[Block], shape: tuple[int, ...]) -> Floats:
    out = np.zeros(shape)
    for one, other in product(ones, others):
        first, end = max(one.bins.start, other.bins.start), min(one.bins.stop, other.bins.stop)
        if one.channel == other.channel and first < end:
            a = one.columns[first - one.bins.start : end - one.bins.start]
            b = other.columns[first - other.bins.start : end - other.bins.start]
            out[np.ix_(one.numbers, other.numbers)] += a.T @ b
    return out


@dataclass(frozen=True)
class Nuisances:
    """Columns (k, c, b), each multiplied with the standard deviation of its coefficient, prepared to be projected out."""

    columns: Columns
    factor: Floats  # lower Cholesky factor of I + AᵀA
    log_determinant: float

    @property
    def size(self) -> int:
        """Number of columns."""
        return self.columns.size

    def against(self, values: Floats) -> Floats:
        """Inner products of the columns with a vector, whitened.

        Args:
            values: The vector (c, b).

        Returns:
            The products (k,).
        """
        products = np.zeros(self.size)
        live = [channel.any() for channel in values]
        for channel, bins, numbers, columns in self.columns.blocks:
            if live[channel]:
                products[numbers] += columns.T @ values[channel, bins]
        return np.asarray(solve_triangular(self.factor, products, lower=True, check_finite=False))

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
        out = np.zeros(self.columns.shape)
        for channel, bins, numbers, columns in self.columns.blocks:
            out[channel, bins] += columns @ coefficients[numbers]
        return out

    def beyond(self, values: Floats) -> Floats:
        """The part of a vector that plausible coefficients cannot hide.

        Args:
            values: The vector (c, b).

        Returns:
            The vector without what coefficients within PLAUSIBLE_SD explain (c, b).
        """
        return np.asarray(values - self.explained(np.clip(self.coefficients(values), -PLAUSIBLE_SD, PLAUSIBLE_SD)))


def nuisances(columns: Columns) -> Nuisances:
    """Prepare columns to be projected out.

    Args:
        columns: Columns (k, c, b), each multiplied with the standard deviation of its coefficient.

    Returns:
        The nuisances.
    """
    factor = cholesky(np.eye(columns.size) + columns.gram, lower=True, check_finite=False)
    return Nuisances(columns, factor, 2.0 * float(np.log(np.diag(factor)).sum()))


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
class Vectors:
    """Many vectors (c, b) that are zero in most channels, so that their inner products with another take one product a channel."""

    blocks: tuple[Block, ...]
    squares: Floats  # (m,)

    @staticmethod
    def of(vectors: Sequence[Mapping[int, Floats]], b: int) -> "Vectors":
        """Gather vectors.

        Args:
            vectors: Values (b,) of each vector by channel, in the channels where they are not zero.
            b: Number of bins.

        Returns:
            The vectors.
        """
        blocks, squares = _blocks(vectors, b), np.zeros(len(vectors))
        for block in blocks:
            squares[block.numbers] += np.einsum("bm,bm->m", block.columns, block.columns)
        return Vectors(blocks, squares)

    def against(self, space: Nuisances) -> Floats:
        """Inner products of the columns of nuisances with the vectors, whitened.

        Args:
            space: The k nuisances.

        Returns:
            The products (k, m).
        """
        products = _inner_products(space.columns.blocks, self.blocks, (space.size, len(self.squares)))
        return np.asarray(solve_triangular(space.factor, products, lower=True, check_finite=False))

    def dot(self, values: Floats) -> Floats:
        """Inner products with another vector, nothing projected out.

        Args:
            values: The other vector (c, b).

        Returns:
            The products (m,).
        """
        out = np.zeros(len(self.squares))
        for channel, bins, numbers, columns in self.blocks:
            out[numbers] += values[channel, bins] @ columns
        return out


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
            for block in space.columns.blocks:
                if block.channel == channel:
                    products[np.ix_(block.numbers, live)] += block.columns.T @ part[:, block.bins].T
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
