"""Inner products of whitened columns, the nuisances A projected out: in all bins, or in the folds of a cross-validation."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from palpd.gap.gaussian.nuisances import Columns, Nuisances, nuisances
from palpd.gap.gaussian.whitening import Whitening
from palpd.tick import Floats

ColumnsByChannel = Mapping[int, Floats]
"""Columns (b, n) by channel, zero in the channels that are not named."""


def whitened(noise: Whitening, columns: ColumnsByChannel) -> dict[int, Floats]:
    """Columns in units of the noise.

    Args:
        columns: Columns (b, n) in the unit of each channel.

    Returns:
        The columns (b, n) in sigmas, without the channels that are not compared.
    """
    return {
        channel: noise.whiten_channel(channel, values) for channel, values in columns.items() if np.isfinite(noise.sigma[channel]).any()
    }


COARSENESS = 3
"""Number of neighbouring bins that are joined while all candidates are scored: smooth columns need no finer bins."""


def coarse(columns: ColumnsByChannel) -> dict[int, Floats]:
    """Join neighbouring bins of whitened columns (b, n); the noise of a joined bin is N(0, 1) again, so evidence stays evidence.

    Returns:
        Columns (b / COARSENESS, n) by channel.
    """
    return {
        channel: np.add.reduceat(values, np.arange(0, len(values), COARSENESS)) / COARSENESS**0.5 for channel, values in columns.items()
    }


@dataclass(frozen=True)
class Products:
    """Inner products of n columns X; P = (I + A Aᵀ)⁻¹ projects the nuisances out.

    Attributes:
        gram: XᵀPX (n, n).
        slope: XᵀPr (n,), with the residual r.
        raw: XᵀX (n, n), nothing projected out.
    """

    gram: Floats
    slope: Floats
    raw: Floats

    def combined(self, matrix: Floats) -> "Products":
        """The products of m linear combinations of the columns.

        Args:
            matrix: The combinations (n, m).
        """
        return Products(matrix.T @ self.gram @ matrix, matrix.T @ self.slope, matrix.T @ self.raw @ matrix)


@dataclass(frozen=True)
class NuisanceSpace:
    """Nuisances A (k, 7, b) with coefficients c ~ N(0, I), and a residual r (7, b), whitened."""

    columns: Columns
    residual: Floats

    @cached_property
    def coarse(self) -> "NuisanceSpace":
        """The space with COARSENESS neighbouring bins joined."""
        rows = np.arange(0, self.residual.shape[1], COARSENESS)
        return NuisanceSpace(self.columns.joined(COARSENESS), np.add.reduceat(self.residual, rows, axis=1) / COARSENESS**0.5)

    @cached_property
    def _nuisances(self) -> Nuisances:
        return nuisances(self.columns)

    @cached_property
    def _seen(self) -> Floats:
        return self._nuisances.against(self.residual)

    @cached_property
    def remainder(self) -> Floats:
        """The residual (7, b) without what the nuisances explain, r - A ĉ."""
        return self._nuisances.remainder(self.residual)

    def products(self, columns: ColumnsByChannel) -> Products:
        """Inner products of columns.

        Args:
            columns: Whitened columns (b, n) by channel.
        """
        seen = self._nuisances.whitened(self.columns.against(columns))
        raw = sum(values.T @ values for values in columns.values())
        slope = sum(values.T @ self.residual[channel] for channel, values in columns.items())
        return Products(raw - seen.T @ seen, slope - seen.T @ self._seen, np.asarray(raw))

    def windows(self, channel: int, shape: Floats, begin: NDArray[np.intp], end: NDArray[np.intp]) -> tuple[Floats, Floats]:
        """Inner products of w columns in one channel: the same shape, each cut to a window of bins. Running sums give them at once.

        Args:
            shape: The whitened shape (b,).
            begin: First bin of every window (w,).
            end: End of every window (w,), not part of it.

        Returns:
            Squared length of every column (w,) and its product with the residual (w,), the nuisances projected out.
        """
        numbers, rows = self.columns.of_channel(channel)
        rows *= shape  # in place: of hundreds of nuisances these are the largest arrays
        running = _running(rows.T)
        products = np.zeros((self.columns.size, len(begin)))
        products[numbers] = (running[end] - running[begin]).T
        seen = self._nuisances.whitened(products)
        raw, product = _running(shape**2), _running(shape * self.residual[channel])
        return raw[end] - raw[begin] - (seen**2).sum(axis=0), product[end] - product[begin] - self._seen @ seen

    def with_columns(self, columns: ColumnsByChannel) -> "NuisanceSpace":
        """The space with further nuisances.

        Args:
            columns: Whitened columns (b, n) by channel, each times the standard deviation of its coefficient.
        """
        count = next(iter(columns.values())).shape[1]
        more = [{channel: values[:, k] for channel, values in columns.items()} for k in range(count)]
        return NuisanceSpace(self.columns.followed_by(Columns.of(more, self.columns.shape)), self.residual)

    def restricted_to(self, bins: NDArray[np.bool_]) -> "NuisanceSpace":
        """The space in which only some bins (7, b) count."""
        return NuisanceSpace(self.columns.restricted_to(bins), np.where(bins, self.residual, 0.0))

    def folded(self, columns: ColumnsByChannel, fold: NDArray[np.intp], folds: int) -> tuple[list[Products], list[Products]]:
        """Inner products of columns inside and outside each fold; each time the bins that count fit the nuisances alone.

        Args:
            columns: Whitened columns (b, n) by channel.
            fold: Number of the fold (b,) of every bin, from 0 on.
            folds: How many there are.

        Returns:
            Products inside every fold, and outside every fold.
        """
        k, n = self.columns.size, next(iter(columns.values())).shape[1]
        total = np.zeros((folds, k + n + 1, k + n + 1))
        for channel, residual in enumerate(self.residual):
            numbers, rows = self.columns.of_channel(channel)
            own = columns.get(channel, np.zeros((len(fold), 0)))
            at = np.concatenate([numbers, np.arange(k, k + own.shape[1]), [k + n]])
            together = np.hstack([rows.T, own, residual[:, None]])
            del rows  # as large
            for number in range(folds):
                bins = together[fold == number]
                total[number][np.ix_(at, at)] += bins.T @ bins
        everything = total.sum(axis=0)
        return [_schur(inside, k, n) for inside in total], [_schur(everything - inside, k, n) for inside in total]


def _running(values: Floats) -> Floats:
    """Running sums (b + 1, ...): row k is the sum of the first k rows."""
    out = np.zeros((len(values) + 1, *values.shape[1:]))
    np.cumsum(values, axis=0, out=out[1:])
    return out


def _schur(moments: Floats, k: int, n: int) -> Products:
    """Products of n columns with k nuisances projected out, from the inner products of nuisances, columns and residual, in this order."""
    cross = moments[:k, k:]
    inner = moments[k:, k:] - cross.T @ cho_solve(cho_factor(moments[:k, :k] + np.eye(k)), cross)
    return Products(inner[:n, :n], inner[:n, n], moments[k : k + n, k : k + n])
