"""How well a law predicts strokes that its fit did not see (cross-validation)."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from palpd.gap.assumptions import ASSUMED
from palpd.gap.data.phases import Ints
from palpd.gap.gaussian.evidence import posterior_of
from palpd.gap.gaussian.nuisance_space import ColumnsByChannel, NuisanceSpace, Products
from palpd.tick import Floats


@dataclass(frozen=True)
class HeldOut:
    """Gains (folds,) in nats on strokes that the fit did not see: half the drop of the squared residual."""

    gains: Floats

    @property
    def total(self) -> float:
        """Sum of the gains."""
        return float(self.gains.sum())

    def carries(self, nats: float, *, folds_too: bool = True) -> bool:
        """Whether the law holds on strokes that its fit did not see.

        Args:
            nats: Evidence of the law.
            folds_too: Whether `laws.folds_that_gain` of the folds must gain by themselves, too.
        """
        folds = int((self.gains > ASSUMED.laws.least_fold_share * nats).sum())
        return self.total >= ASSUMED.laws.least_gain_share * nats and (not folds_too or folds >= ASSUMED.laws.folds_that_gain)


def held_out(space: NuisanceSpace, columns: ColumnsByChannel, root: Floats, fold: Ints) -> HeldOut:
    """Fit the coefficients w without each fold, and judge them in it.

    Args:
        columns: Whitened columns X (b, m) of the law by channel.
        root: Root s L (m, m) of the prior covariance of w.
        fold: Number of the fold (b,) of every bin.
    """
    fits = _fits_without(space, columns, root, fold)
    return HeldOut(np.array([float(mine.slope @ mean - 0.5 * mean @ mine.gram @ mean) for mine, mean in fits]))


def spread_over_folds(space: NuisanceSpace, columns: ColumnsByChannel, root: Floats, fold: Ints) -> Floats:
    """Covariance (m, m) of w as the fits without each fold differ, a jackknife (Efron 1982). It holds of a wrong law, too.

    Args:
        columns: Whitened columns X (b, m) of the law by channel.
        root: Root s L (m, m) of the prior covariance of w.
        fold: Number of the fold (b,) of every bin.
    """
    means = np.array([mean for _, mean in _fits_without(space, columns, root, fold)])
    apart = means - means.mean(axis=0)
    return (ASSUMED.laws.folds - 1) / ASSUMED.laws.folds * apart.T @ apart


def _fits_without(space: NuisanceSpace, columns: ColumnsByChannel, root: Floats, fold: Ints) -> Iterator[tuple[Products, Floats]]:
    """For each fold the products inside it, and the mean (m,) of w that is fitted outside it."""
    inside, outside = space.folded(columns, fold, ASSUMED.laws.folds)
    for mine, others in zip(inside, outside, strict=True):
        yield mine, posterior_of(others, root)[0]
