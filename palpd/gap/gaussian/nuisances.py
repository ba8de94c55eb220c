"""Linear Gaussian nuisances, integrated out exactly: y = signal + A c + white noise, c ~ N(0, I).

P = (I + A Aᵀ)⁻¹, and F is the lower Cholesky factor of I + AᵀA. For vectors v and w of the data, vᵀPw = vᵀw - (F⁻¹Aᵀv)ᵀ(F⁻¹Aᵀw).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky
from scipy.linalg.lapack import dtrtrs
from scipy.sparse import csr_array, issparse, vstack

from palpd.tick import Floats

Ints = NDArray[np.intp]

SMALLEST_SQUARE = 1e-24
"""Diagonal element of a symmetric matrix, as a share of the largest, below which its row counts as zero: 16 digits hold no more."""

SHORT_SHARE = 0.25
"""Largest share of all bins over which a column may reach for its values to be stored sparsely: most columns of a press are short."""

PLAUSIBLE_SD = 2.0
"""Standard deviations that a deviation within specification may have: 95 % of all are smaller."""


Rows = Floats | csr_array
"""Columns of one channel as the rows (m, b) of a matrix, which is sparse where each column is zero in most bins."""


class Stretch(NamedTuple):
    """Values (n,) of a column from the bin `first` on; it is zero in all other bins."""

    first: int
    values: Floats


ColumnByChannel = Mapping[int, Floats | Stretch]
"""Values (b,) of one column by channel, in the channels where it is not zero."""


class Block(NamedTuple):
    """What m columns are in one channel, as rows (m, b), and the numbers (m,) of these columns among all."""

    channel: int
    numbers: Ints
    rows: Rows

    def chosen(self, which: NDArray[np.bool_]) -> "Block":
        """The block with some of its columns (m,) alone."""
        return self if which.all() else self._replace(numbers=self.numbers[which], rows=self.rows[which])

    def dense(self) -> Floats:
        """The rows (m, b) with their zeros."""
        return self.rows.toarray() if issparse(self.rows) else self.rows

    def where(self, bins: NDArray[np.bool_]) -> "Block":
        """The columns where only some bins (b,) count; in the others they are zero."""
        if issparse(self.rows):
            kept = self.rows.data * bins[self.rows.indices]
            return self._replace(rows=csr_array((kept, self.rows.indices, self.rows.indptr), shape=self.rows.shape))
        return self._replace(rows=np.where(bins, self.rows, 0.0))

    def joined(self, count: int) -> "Block":
        """The columns with `count` neighbouring bins joined; the noise of a joined bin is N(0, 1) again."""
        m, b = self.rows.shape
        if not issparse(self.rows):
            return self._replace(rows=np.add.reduceat(self.rows, np.arange(0, b, count), axis=1) / count**0.5)
        shares, places = self.rows.data / count**0.5, self.rows.indices // count
        rows = csr_array((shares, places, self.rows.indptr.copy()), shape=(m, -(-b // count)))
        rows.sum_duplicates()
        return self._replace(rows=rows)


@dataclass(frozen=True)
class Columns:
    """Columns A (k, c, b) over c channels and b bins in units of the noise, stored where they are not zero."""

    shape: tuple[int, int]  # (c, b)
    blocks: tuple[Block, ...]  # at most two a channel, a sparse and a dense one
    gram: Floats  # (k, k) inner products AᵀA

    @property
    def size(self) -> int:
        """Number of columns."""
        return len(self.gram)

    @staticmethod
    def of(columns: Sequence[ColumnByChannel], shape: tuple[int, int]) -> "Columns":
        """Gather columns.

        Args:
            shape: Numbers of channels and bins (c, b).
        """
        blocks = _blocks(columns, shape[1])
        return Columns(shape, blocks, _inner_products(blocks, blocks, (len(columns), len(columns))))

    def beside(self, others: "Columns") -> "Columns":
        """These columns, followed by others."""
        n = self.size
        gram = np.zeros((n + others.size, n + others.size))
        gram[:n, :n], gram[n:, n:] = self.gram, others.gram
        gram[:n, n:] = _inner_products(self.blocks, others.blocks, (n, others.size))
        gram[n:, :n] = gram[:n, n:].T
        return Columns(self.shape, _merged([*self.blocks, *(other._replace(numbers=n + other.numbers) for other in others.blocks)]), gram)

    def scaled(self, factor: float) -> "Columns":
        """The columns times a factor."""
        return Columns(self.shape, tuple(block._replace(rows=block.rows * factor) for block in self.blocks), factor**2 * self.gram)

    def without(self, numbers: Ints) -> tuple["Columns", list[Floats]]:
        """The columns with some of them set to zero.

        Args:
            numbers: Numbers (m,) of these, in ascending order.

        Returns:
            The k columns, and the m that were set to zero, each (c, b).
        """
        if not len(numbers):
            return self, []
        taken, blocks, gram = np.zeros((len(numbers), *self.shape)), [], self.gram.copy()
        gram[numbers] = gram[:, numbers] = 0.0
        for block in self.blocks:
            gone = np.isin(block.numbers, numbers)
            taken[np.searchsorted(numbers, block.numbers[gone]), block.channel] = block.chosen(gone).dense()
            blocks.append(block.chosen(~gone))
        return Columns(self.shape, tuple(blocks), gram), list(taken)

    def restricted_to(self, bins: NDArray[np.bool_]) -> "Columns":
        """The columns where only some bins count; in the others they are zero.

        Args:
            bins: Which bins count in all channels (b,), or in each (c, b).
        """
        by_channel = np.broadcast_to(bins, self.shape)
        return self._of_blocks(self.shape[1], [block.where(by_channel[block.channel]) for block in self.blocks])

    def joined(self, count: int) -> "Columns":
        """The columns with `count` neighbouring bins joined; the noise of a joined bin is N(0, 1) again."""
        return self._of_blocks(-(-self.shape[1] // count), [block.joined(count) for block in self.blocks])

    def _of_blocks(self, bins: int, blocks: Sequence[Block]) -> "Columns":
        return Columns((self.shape[0], bins), tuple(blocks), _inner_products(blocks, blocks, self.gram.shape))

    def of_channel(self, channel: int) -> tuple[Ints, Floats]:
        """Columns of one channel.

        Returns:
            The numbers (m,) of those that are not zero there, and these as rows (m, b).
        """
        mine = [block for block in self.blocks if block.channel == channel]
        numbers = np.concatenate([np.zeros(0, dtype=np.intp), *(block.numbers for block in mine)])
        return numbers, np.concatenate([np.zeros((0, self.shape[1])), *(block.dense() for block in mine)])

    def against(self, columns: Mapping[int, Floats]) -> Floats:
        """Inner products with other columns X, or with a vector v.

        Args:
            columns: X (b, n) or v (b,) by channel, zero in the channels that are not named.

        Returns:
            AᵀX (k, n) or Aᵀv (k,).
        """
        out = np.zeros((self.size, *next(iter(columns.values())).shape[1:])) if columns else np.zeros(self.size)
        for channel, numbers, rows in self.blocks:
            if channel in columns:
                out[numbers] += rows @ columns[channel]
        return out

    def times(self, coefficients: Floats) -> Floats:
        """The sum A c (c, b) of the columns times coefficients (k,)."""
        out = np.zeros(self.shape)
        for channel, numbers, rows in self.blocks:
            out[channel] += coefficients[numbers] @ rows
        return out

    def dense(self) -> Floats:
        """The columns (k, c, b) with their zeros."""
        out = np.zeros((self.size, *self.shape))
        for block in self.blocks:
            out[block.numbers, block.channel] = block.dense()
        return out


def _blocks(columns: Sequence[ColumnByChannel], b: int) -> tuple[Block, ...]:
    """Columns gathered by channel: those that reach over many bins in a dense block, the short ones in a sparse block."""
    groups: dict[tuple[int, bool], list[tuple[int, Stretch]]] = {}
    for number, column in enumerate(columns):
        for channel, values in column.items():
            stretch = _live(values)
            if len(stretch.values):
                groups.setdefault((channel, len(stretch.values) <= SHORT_SHARE * b), []).append((number, stretch))
    out = []
    for (channel, short), those in groups.items():
        stretches = [stretch for _, stretch in those]
        numbers = np.array([number for number, _ in those], dtype=np.intp)
        out.append(Block(channel, numbers, _sparse(stretches, b) if short else _sparse(stretches, b).toarray()))
    return tuple(out)


def _live(values: Floats | Stretch) -> Stretch:
    """The stretch from the first bin to the last in which a column is not zero."""
    first, values = values if isinstance(values, Stretch) else (0, values)
    there = values != 0.0
    begin = int(there.argmax())
    end = len(values) - int(there[::-1].argmax()) if there[begin] else begin
    return Stretch(first + begin, values[begin:end])


def _sparse(stretches: Sequence[Stretch], b: int) -> csr_array:
    """Stretches as the rows of a matrix (m, b)."""
    indices = np.concatenate([np.arange(first, first + len(values)) for first, values in stretches])
    starts = np.cumsum([0, *(len(values) for _, values in stretches)])
    return csr_array((np.concatenate([values for _, values in stretches]), indices, starts), shape=(len(stretches), b))


def _merged(blocks: Sequence[Block]) -> tuple[Block, ...]:
    """The blocks, with those of the same channel and kind (dense or sparse) stacked."""
    groups: dict[tuple[int, bool], list[Block]] = {}
    for block in blocks:
        groups.setdefault((block.channel, issparse(block.rows)), []).append(block)
    return tuple(those[0] if len(those) == 1 else _stacked(those) for those in groups.values())


def _stacked(those: Sequence[Block]) -> Block:
    """Blocks of one channel and kind stacked to a single block."""
    sparse = [block.rows for block in those if issparse(block.rows)]
    rows = csr_array(vstack(sparse)) if sparse else np.concatenate([block.dense() for block in those])
    return Block(those[0].channel, np.concatenate([block.numbers for block in those]), rows)


def _inner_products(ones: Sequence[Block], others: Sequence[Block], shape: tuple[int, ...]) -> Floats:
    out = np.zeros(shape)
    for one, other in product(ones, others):
        if one.channel == other.channel:
            products = one.rows @ other.rows.T
            out[np.ix_(one.numbers, other.numbers)] += products.toarray() if issparse(products) else products
    return out


@dataclass(frozen=True)
class Nuisances:
    """Columns A (k, c, b), each times the standard deviation of its coefficient, prepared to be projected out."""

    columns: Columns
    factor: Floats  # F (k, k), the lower Cholesky factor of I + AᵀA
    log_determinant: float  # log det(I + AᵀA)

    @property
    def size(self) -> int:
        """Number of columns."""
        return self.columns.size

    def against(self, values: Floats) -> Floats:
        """Whitened inner products F⁻¹Aᵀv (k,) with a vector v (c, b); the sum of their squares is what the nuisances explain of vᵀv."""
        return self.whitened(self.columns.against({channel: row for channel, row in enumerate(values) if row.any()}))

    def whitened(self, products: Floats) -> Floats:
        """Whiten inner products with the columns.

        Args:
            products: Aᵀv (k,) or AᵀX (k, n).

        Returns:
            F⁻¹Aᵀv (k,) or F⁻¹AᵀX (k, n). The inner products of these are what the nuisances explain.
        """
        return _solved(self.factor, products)

    def coefficients(self, values: Floats) -> Floats:
        """Posterior mean ĉ = (I + AᵀA)⁻¹Aᵀr (k,) of the coefficients, for a residual r (c, b)."""
        return _solved(self.factor, self.against(values), transposed=True)

    def explained(self, coefficients: Floats) -> Floats:
        """The sum A c (c, b) of the columns times coefficients (k,)."""
        return self.columns.times(coefficients)

    def beyond(self, values: Floats) -> Floats:
        """The part (c, b) of a vector (c, b) that plausible nuisances cannot hide: v - A ĉ, each ĉ clipped to ± PLAUSIBLE_SD."""
        return np.asarray(values - self.explained(np.clip(self.coefficients(values), -PLAUSIBLE_SD, PLAUSIBLE_SD)))


def _solved(factor: Floats, right: Floats, *, transposed: bool = False) -> Floats:
    """Solution of a system with a lower triangular matrix (k, k), or with its transpose."""
    if not right.size:
        return right
    solution, failed = dtrtrs(factor, right, lower=1, trans=int(transposed))
    assert not failed, failed
    return np.asarray(solution)


def nuisances(columns: Columns) -> Nuisances:
    """Prepare columns to be projected out.

    Args:
        columns: Whitened columns (k, c, b), each times the standard deviation of its coefficient.
    """
    factor = cholesky(np.eye(columns.size) + columns.gram, lower=True, check_finite=False)
    return Nuisances(columns, factor, 2.0 * float(np.log(np.diag(factor)).sum()))


@dataclass(frozen=True)
class Projected:
    """A vector v (c, b) and its whitened products F⁻¹Aᵀv (k,) with the nuisances, so that inner products are cheap."""

    values: Floats
    seen: Floats

    def dot(self, other: "Projected") -> float:
        """Inner product vᵀPw with another vector, the nuisances projected out."""
        return float(np.vdot(self.values, other.values) - self.seen @ other.seen)


def project(values: Floats, space: Nuisances) -> Projected:
    """Prepare a vector (c, b) for inner products with the nuisances projected out.

    Args:
        values: The vector (c, b).
    """
    return Projected(values, space.against(values))


def gram(vectors: list[Projected]) -> Floats:
    """Inner products (n, n) of n vectors with each other, the nuisances projected out."""
    out = np.zeros((len(vectors), len(vectors)))
    for i, one in enumerate(vectors):
        for j, other in enumerate(vectors[: i + 1]):
            out[i, j] = out[j, i] = one.dot(other)
    return out


@dataclass(frozen=True)
class Vectors:
    """Many vectors (c, b) that are zero in most channels: their inner products take one matrix product a channel."""

    blocks: tuple[Block, ...]
    squares: Floats  # (m,) squared lengths, nothing projected out

    @staticmethod
    def of(vectors: Sequence[Mapping[int, Floats]], b: int) -> "Vectors":
        """Gather vectors.

        Args:
            vectors: Values (b,) of each vector by channel, in the channels where they are not zero.
            b: Number of bins.
        """
        blocks, squares = _blocks(vectors, b), np.zeros(len(vectors))
        for block in blocks:
            squares[block.numbers] += (block.rows * block.rows).sum(axis=1)
        return Vectors(blocks, squares)

    def against(self, space: Nuisances) -> Floats:
        """Whitened products F⁻¹Aᵀv (k, m) of k nuisances with the m vectors."""
        return space.whitened(_inner_products(space.columns.blocks, self.blocks, (space.size, len(self.squares))))

    def dot(self, values: Floats) -> Floats:
        """Inner products (m,) with another vector (c, b), nothing projected out."""
        out = np.zeros(len(self.squares))
        for channel, numbers, rows in self.blocks:
            out[numbers] += rows @ values[channel]
        return out


@dataclass(frozen=True)
class Widened:
    """Nuisances A widened by m further columns d D. The size d is left open: inner products at any d are cheap."""

    columns: Columns  # D
    crossed: Floats  # (k, m) F⁻¹AᵀD
    squares: Floats  # (m, m) DᵀPD, with A projected out

    @staticmethod
    def by(space: Nuisances, columns: Columns) -> "Widened":
        """Widen nuisances A (`space`) by further columns D (`columns`)."""
        crossed = space.whitened(_inner_products(space.columns.blocks, columns.blocks, (space.size, columns.size)))
        return Widened(columns, crossed, columns.gram - crossed.T @ crossed)

    def against(self, vector: Projected) -> Floats:
        """Inner products DᵀPv (m,) of the further columns with a vector, A projected out."""
        return self.columns.against(dict(enumerate(vector.values))) - self.crossed.T @ vector.seen


def stable_inverse(normal: Floats) -> Floats:
    """Pseudo-inverse (k, k) of a symmetric matrix (k, k) whose rows may differ by orders of magnitude."""
    diagonal = np.abs(np.diag(normal))
    scale = np.sqrt(np.maximum(diagonal, max(SMALLEST_SQUARE * float(diagonal.max(initial=0.0)), 1e-300)))
    scaled = normal / scale / scale[:, None]
    return np.asarray(np.linalg.pinv(scaled, rcond=1e-9, hermitian=True) / scale / scale[:, None])
