"""Linear Gaussian nuisances, integrated out exactly: y = signal + A c + white noise, c ~ N(0, I).

P = (I + A Aᵀ)⁻¹, and F is the lower Cholesky factor of I + AᵀA. For vectors v and w of the data, vᵀPw = vᵀw - (F⁻¹Aᵀv)ᵀ(F⁻¹Aᵀw).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky
from scipy.linalg.lapack import dtrtrs
from scipy.sparse import csr_array, diags_array, issparse

from palpd.gap.assumptions import ASSUMED
from palpd.tick import Floats

Ints = NDArray[np.intp]

SMALLEST_SQUARE = 1e-24
"""Diagonal element of a symmetric matrix, as a share of the largest, below which its row counts as zero: 16 digits hold no more."""

SHORT_SHARE = 0.25
"""Largest share of all bins over which a column may reach for its values to be stored sparsely."""


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


@dataclass(frozen=True)
class Vectors:
    """Vectors (k, c, b) over c channels and b bins in units of the noise, stored where they are not zero."""

    shape: tuple[int, int]  # (c, b)
    size: int  # k
    blocks: tuple[Block, ...]

    @staticmethod
    def of(vectors: Sequence[ColumnByChannel], shape: tuple[int, int]) -> "Vectors":
        """Gather vectors.

        Args:
            shape: Numbers of channels and bins (c, b).
        """
        return Vectors(shape, len(vectors), _blocks(vectors, shape[1]))

    @property
    def squares(self) -> Floats:
        """Squared lengths (k,)."""
        out = np.zeros(self.size)
        for _, numbers, rows in self.blocks:
            out[numbers] += (rows * rows).sum(axis=1)
        return out

    def of_channel(self, channel: int) -> tuple[Ints, Floats]:
        """Vectors of one channel.

        Returns:
            The numbers (m,) of those that are not zero there, and these as rows (m, b).
        """
        mine = [block for block in self.blocks if block.channel == channel]
        numbers = np.concatenate([np.zeros(0, dtype=np.intp), *(block.numbers for block in mine)])
        return numbers, np.concatenate([np.zeros((0, self.shape[1])), *(block.dense() for block in mine)])

    def against(self, columns: Mapping[int, Floats]) -> Floats:
        """Inner products with columns X, or with a vector v.

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
        """The sum A c (c, b) of the vectors times coefficients (k,)."""
        out = np.zeros(self.shape)
        for channel, numbers, rows in self.blocks:
            out[channel] += coefficients[numbers] @ rows
        return out

    def dense(self) -> Floats:
        """The vectors (k, c, b) with their zeros."""
        out = np.zeros((self.size, *self.shape))
        for block in self.blocks:
            out[block.numbers, block.channel] = block.dense()
        return out


@dataclass(frozen=True)
class Columns(Vectors):
    """Vectors with their inner products AᵀA."""

    gram: Floats  # (k, k)

    @staticmethod
    def of(vectors: Sequence[ColumnByChannel], shape: tuple[int, int]) -> "Columns":
        """Gather columns, as Vectors are gathered."""
        blocks = _blocks(vectors, shape[1])
        return Columns(shape, len(vectors), blocks, _inner_products(blocks, blocks, (len(vectors), len(vectors))))

    def followed_by(self, others: "Columns") -> "Columns":
        """These columns, followed by others."""
        crossed = _inner_products(self.blocks, others.blocks, (self.size, others.size))
        gram = np.block([[self.gram, crossed], [crossed.T, others.gram]])
        blocks = (*self.blocks, *(block._replace(numbers=self.size + block.numbers) for block in others.blocks))
        return Columns(self.shape, len(gram), blocks, gram)

    def scaled(self, factor: float) -> "Columns":
        """The columns times a factor."""
        blocks = tuple(block._replace(rows=block.rows * factor) for block in self.blocks)
        return replace(self, blocks=blocks, gram=factor**2 * self.gram)

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
        return replace(self, blocks=tuple(blocks), gram=gram), list(taken)

    def restricted_to(self, bins: NDArray[np.bool_]) -> "Columns":
        """The columns where only some bins count; in the others they are zero.

        Args:
            bins: Which bins count in all channels (b,), or in each (c, b).
        """
        kept = [csr_array(diags_array(of_channel.astype(float))) for of_channel in np.broadcast_to(bins, self.shape)]
        return self._mapped(self.shape[1], kept)

    def joined(self, count: int) -> "Columns":
        """The columns with `count` neighbouring bins joined; the noise of a joined bin is N(0, 1) again."""
        bins = np.arange(self.shape[1])
        join = csr_array((np.full(len(bins), count**-0.5), (bins, bins // count)))
        return self._mapped(join.shape[1], [join] * self.shape[0])

    def _mapped(self, bins: int, matrices: Sequence[csr_array]) -> "Columns":
        """The columns with a matrix (b, bins) applied to each channel."""
        blocks = tuple(block._replace(rows=block.rows @ matrices[block.channel]) for block in self.blocks)
        return Columns((self.shape[0], bins), self.size, blocks, _inner_products(blocks, blocks, self.gram.shape))


def _blocks(columns: Sequence[ColumnByChannel], b: int) -> tuple[Block, ...]:
    """Columns gathered by channel: those that reach over many bins in a dense block, the short ones in a sparse block."""
    groups: dict[tuple[int, bool], list[tuple[int, Stretch]]] = {}
    for number, column in enumerate(columns):
        for channel, values in column.items():
            stretch = _live(values)
            if len(stretch.values):
                groups.setdefault((channel, len(stretch.values) <= SHORT_SHARE * b), []).append((number, stretch))
    out = []
    for (channel, short), numbered in groups.items():
        stretches = [stretch for _, stretch in numbered]
        numbers = np.array([number for number, _ in numbered], dtype=np.intp)
        out.append(Block(channel, numbers, _sparse(stretches, b) if short else _dense(stretches, b)))
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


def _dense(stretches: Sequence[Stretch], b: int) -> Floats:
    """Stretches as the rows (m, b) of an array."""
    out = np.zeros((len(stretches), b))
    for row, (first, values) in zip(out, stretches, strict=True):
        row[first : first + len(values)] = values
    return out


def _inner_products(left: Sequence[Block], right: Sequence[Block], shape: tuple[int, ...]) -> Floats:
    out = np.zeros(shape)
    for a, b in product(left, right):
        if a.channel == b.channel:
            products = a.rows @ b.rows.T
            out[np.ix_(a.numbers, b.numbers)] += products.toarray() if issparse(products) else products
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

    def remainder(self, values: Floats) -> Floats:
        """The part (c, b) of a vector (c, b) that the nuisances do not explain, v - A ĉ."""
        return np.asarray(values - self.explained(self.coefficients(values)))

    def beyond(self, values: Floats) -> Floats:
        """The part (c, b) of a vector (c, b) that plausible nuisances cannot hide: v - A ĉ, each ĉ clipped to ± `noise.plausible_sd`."""
        return np.asarray(
            values - self.explained(np.clip(self.coefficients(values), -ASSUMED.noise.plausible_sd, ASSUMED.noise.plausible_sd))
        )


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
    for i, vector in enumerate(vectors):
        for j, other in enumerate(vectors[: i + 1]):
            out[i, j] = out[j, i] = vector.dot(other)
    return out


@dataclass(frozen=True)
class ProjectedColumns:
    """Many vectors X with their whitened products F⁻¹AᵀX (k, m) with the nuisances."""

    columns: Vectors
    seen: Floats

    @staticmethod
    def of(columns: Vectors, space: Nuisances) -> "ProjectedColumns":
        """Prepare vectors for inner products with the nuisances projected out."""
        products = _inner_products(space.columns.blocks, columns.blocks, (space.size, columns.size))
        return ProjectedColumns(columns, space.whitened(products))

    def dot(self, vector: Projected) -> Floats:
        """Inner products XᵀPv (m,) with another vector."""
        return self.columns.against(dict(enumerate(vector.values))) - self.seen.T @ vector.seen

    @property
    def squares(self) -> Floats:
        """Inner products xᵀPx (m,) of each vector with itself."""
        return np.asarray(self.columns.squares - (self.seen**2).sum(axis=0))


def stable_inverse(normal: Floats) -> Floats:
    """Pseudo-inverse (k, k) of a symmetric matrix (k, k) whose rows may differ by orders of magnitude."""
    diagonal = np.abs(np.diag(normal))
    scale = np.sqrt(np.maximum(diagonal, max(SMALLEST_SQUARE * float(diagonal.max(initial=0.0)), 1e-300)))
    scaled = normal / scale / scale[:, None]
    return np.asarray(np.linalg.pinv(scaled, rcond=1e-9, hermitian=True) / scale / scale[:, None])
