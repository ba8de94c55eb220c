"""What a law says of strokes that it did not see."""

from dataclasses import dataclass

import numpy as np

from palpd.gap.data.phases import Ints
from palpd.gap.gaussian.evidence import posterior_of
from palpd.gap.gaussian.nuisance_space import ColumnsByChannel, NuisanceSpace
from palpd.tick import Floats

FOLDS = 4
LEAST_GAIN_SHARE = 0.4
"""Least gain on strokes that were not seen, as a share of the evidence."""

FOLDS_THAT_GAIN, LEAST_FOLD_SHARE = 3, 0.02
"""Number of folds that must gain, and how much of the evidence each: a law that one stroke alone shows carries to no other."""


@dataclass(frozen=True)
class HeldOut:
    """Gains (folds,) in nats on strokes that were not seen: half the drop of squared residuals."""

    gains: Floats

    @property
    def total(self) -> float:
        """Sum of the gains."""
        return float(self.gains.sum())

    def carries(self, nats: float, *, folds_too: bool = True) -> bool:
        """Whether the law holds on strokes that it did not see.

        Args:
            nats: Its evidence.
            folds_too: Whether most folds must gain by themselves.

        Returns:
            True where it does.
        """
        folds = int((self.gains > LEAST_FOLD_SHARE * nats).sum())
        return self.total >= LEAST_GAIN_SHARE * nats and (not folds_too or folds >= FOLDS_THAT_GAIN)


def held_out(space: NuisanceSpace, columns: ColumnsByChannel, root: Floats, fold: Ints) -> HeldOut:
    """Fit the coefficients without each fold, and judge them in it.

    Args:
        space: Nuisances and residual.
        columns: Whitened columns (b, m) of the law by channel.
        root: Root (m, m) of the prior covariance of its coefficients.
        fold: Fold (b,) of every bin.

    Returns:
        The gains.
    """
    inside, outside = space.folded(columns, fold, FOLDS)
    gains = []
    for mine, others in zip(inside, outside, strict=True):
        mean, _ = posterior_of(others, root)
        gains.append(float(mine.slope @ mean - 0.5 * mean @ mine.gram @ mean))
    return HeldOut(np.array(gains))
