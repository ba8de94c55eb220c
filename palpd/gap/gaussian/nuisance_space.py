"""Inner products of whitened columns with everything within specification projected out, in all bins or without one fold of them."""

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
        noise: Noise of the bins.
        columns: ColumnsByChannel (b, n) by channel, in the units of the channels.

    Returns:
        The columns in sigmas, without the channels that are not compared.
    """
    return {
        channel: noise.whiten_channel(channel, values) for channel, values in columns.items() if np.isfinite(noise.sigma[channel]).any()
    }


COARSENESS = 3
"""Neighbouring rows that are joined where all candidates are scored: that is all that smooth laws need."""


def coarse(columns: ColumnsByChannel) -> dict[int, Floats]:
    """Whitened columns with neighbouring rows joined; noise of one row stays N(0, 1), so evidence stays evidence.

    Args:
        columns: ColumnsByChannel (b, n) by channel.

    Returns:
        Columns (b / COARSENESS, n) by channel.
    """
    return {
        channel: np.add.reduceat(values, np.arange(0, len(values), COARSENESS)) / COARSENESS**0.5 for channel, values in columns.items()
    }


@dataclass(frozen=True)
class Products:
    """Inner products of n columns.

    Attributes:
        gram: With each other (n, n), the nuisances projected out.
        slope: With the residual (n,), the nuisances projected out.
        raw: With each other (n, n), nothing projected out.
    """

    gram: Floats
    slope: Floats
    raw: Floats

    def of(self, chosen: slice) -> "Products":
        """The products of some of the columns."""
        return Products(self.gram[chosen, chosen], self.slope[chosen], self.raw[chosen, chosen])

    def combined(self, matrix: Floats) -> "Products":
        """The products of combinations of the columns.

        Args:
            matrix: The combinations (n, m).

        Returns:
            The products of m columns.
        """
        return Products(matrix.T @ self.gram @ matrix, matrix.T @ self.slope, matrix.T @ self.raw @ matrix)


@dataclass(frozen=True)
class NuisanceSpace:
    """Nuisances (k, 7, b) with coefficients N(0, 1), and a residual (7, b), whitened."""

    columns: Columns
    residual: Floats

    @cached_property
    def coarse(self) -> "NuisanceSpace":
        """The space with neighbouring rows joined."""
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
        """The residual (7, b) without what the nuisances explain."""
        return self.residual - self._nuisances.explained(self._nuisances.coefficients(self.residual))

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
        """Inner products of one whitened shape cut to many windows, by running sums.

        Args:
            shape: The shape (b,).
            begin: First bin of every window (w,).
            end: End of every window (w,), not part of it.

        Returns:
            Square of every window and its product with the residual (w,), the nuisances projected out.
        """
        numbers, rows = self.columns.of_channel(channel)
        rows *= shape  # in place: of hundreds of presses these are the largest arrays
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

        Returns:
            The wider space.
        """
        count = next(iter(columns.values())).shape[1]
        more = [{channel: values[:, k] for channel, values in columns.items()} for k in range(count)]
        return NuisanceSpace(self.columns.beside(Columns.of(more, self.columns.shape)), self.residual)

    def restricted_to(self, bins: NDArray[np.bool_]) -> "NuisanceSpace":
        """The space in which only some bins count.

        Args:
            bins: Which of them in each channel (7, b).
        """
        return NuisanceSpace(self.columns.restricted_to(bins), np.where(bins, self.residual, 0.0))

    def folded(self, columns: ColumnsByChannel, fold: NDArray[np.intp], folds: int) -> tuple[list[Products], list[Products]]:
        """Inner products of columns inside each fold and outside it; the nuisances are fitted there alone.

        Args:
            columns: Whitened columns (b, n) by channel.
            fold: The fold (b,) of every bin.

        Returns:
            Products inside every fold, and outside every fold.
        """
        k, n = self.columns.size, next(iter(columns.values())).shape[1]
        total = np.zeros((folds, k + n + 1, k + n + 1))
        for channel, residual in enumerate(self.residual):
            index, part = self.columns.of_channel(channel)
            mine = [part.T, residual[:, None]]
            at = np.concatenate([index, [k + n]])
            if channel in columns:
                mine.insert(1, columns[channel])
                at = np.concatenate([index, np.arange(k, k + n + 1)])
            together = np.hstack(mine)
            del mine, part  # as large
            for number in range(folds):
                rows = together[fold == number]
                total[number][np.ix_(at, at)] += rows.T @ rows
        everything = total.sum(axis=0)
        return [_schur(one, k, n) for one in total], [_schur(everything - one, k, n) for one in total]


def _running(values: Floats) -> Floats:
    """Sums (b + 1, ...) of all rows before each."""
    out = np.zeros((len(values) + 1, *values.shape[1:]))
    np.cumsum(values, axis=0, out=out[1:])
    return out


def _schur(moments: Floats, k: int, n: int) -> Products:
    """Products of the n columns after the first k nuisances have been projected out; the last row is the residual."""
    cross = moments[:k, k:]
    inner = moments[k:, k:] - cross.T @ cho_solve(cho_factor(moments[:k, :k] + np.eye(k)), cross)
    return Products(inner[:n, :n], inner[:n, n], moments[k : k + n, k : k + n])
