"""Bases of curves: columns over the values of a driver, and the priors L Lᵀ of their coefficients w."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky

from palpd.cell.effects.drivers import Driver
from palpd.gap.assumptions import ASSUMED
from palpd.tick import Floats

KNOTS, FINE_KNOTS = 8, 24
"""Number of knots of a usual curve, and of a curve that may have narrow features."""

COVERED = (0.002, 0.998)
"""Quantiles of a driver between which knots lie: single samples beyond them say nothing of a curve."""


ROUNDING = 1e-9
"""Span of a driver relative to its size below which it does not vary: only rounding does."""


@dataclass(frozen=True)
class Basis:
    """Columns of a curve over a driver.

    Attributes:
        low: Value of the driver, in its unit, below which a curve is constant; of no use where the driver repeats.
        high: Value of the driver, in its unit, above which a curve is constant.
        knots: Coordinates of the knots (m,) of hats; empty for other bases.
        priors: Roots L (m, m) of the covariances L Lᵀ that the coefficients w may have.
    """

    driver: Driver
    low: float
    high: float
    knots: Floats
    priors: tuple[Floats, ...]

    @property
    def size(self) -> int:
        """Number m of coefficients."""
        return len(self.priors[0])

    def columns(self, x: Floats) -> Floats:
        """The columns at values of the driver.

        Args:
            x: Values (n,) in the unit of the driver.

        Returns:
            Columns (n, m).
        """
        if self.driver.period is not None:
            angle = 2.0 * np.pi / self.driver.period * x
            return np.stack(
                [wave(k * angle) for k in range(1, len(ASSUMED.laws.harmonic_variances) + 1) for wave in (np.cos, np.sin)], axis=-1
            )
        x = np.clip(x, self.low, self.high)
        if not len(self.knots):
            unit = x / max(abs(self.low), abs(self.high))
            return np.stack([unit, unit**2], axis=-1)
        at = (self.driver.coordinate(x) - self.knots[0]) / (self.knots[1] - self.knots[0])
        out: Floats = at[..., None] - np.arange(len(self.knots))
        np.subtract(1.0, np.abs(out, out=out), out=out)  # in place: it is as large as everything else together
        return np.maximum(out, 0.0, out=out)

    def shown_at(self) -> Floats:
        """Values of the driver (k,) at which a curve of this basis is written down, in its unit."""
        if self.driver.period is not None:
            return np.linspace(0.0, self.driver.period, FINE_KNOTS + 1)
        if not len(self.knots):
            return np.linspace(self.low, self.high, KNOTS + 1)
        scale = self.driver.log_scale
        shown = self.knots if scale is None else scale * np.sinh(self.knots)
        return np.asarray(np.clip(shown, self.low, self.high))


def hats(driver: Driver, x: Floats, count: int = KNOTS) -> Basis | None:
    """Hats at `count` even knots with a Matérn prior of smoothness 3/2 and several lengths; None where the driver does not vary.

    Args:
        x: Values (n,) of the driver where the curve matters, in its unit.
    """
    low, high = _range(x)
    ends = driver.coordinate(np.array([low, high]))
    if not high > low or not ends[1] - ends[0] > ROUNDING * np.abs(ends).max():
        return None
    distance = np.abs(np.subtract.outer(np.arange(count), np.arange(count))) / (count - 1) * (KNOTS - 1)
    scaled = [np.sqrt(3.0) * distance / length for length in ASSUMED.laws.curve_lengths]
    priors = tuple(cholesky((1.0 + s) * np.exp(-s) + 1e-9 * np.eye(count), lower=True) for s in scaled)
    return Basis(driver, low, high, np.linspace(ends[0], ends[1], count), priors)


def powers(driver: Driver, x: Floats) -> Basis | None:
    """Columns x and x² over a relaxed state x; None where the driver does not vary.

    Args:
        x: Values (n,) of the driver, in its unit.
    """
    low, high = _range(x)
    return (
        Basis(driver, low, high, np.zeros(0), (np.diag([1.0, ASSUMED.laws.square_variance**0.5]),))
        if high - low > ROUNDING * max(abs(low), abs(high))
        else None
    )


def harmonics(driver: Driver, x: Floats) -> Basis:
    """Three harmonics of a driver that repeats.

    Args:
        driver: With a period.
        x: Values (n,) of the driver, in its unit.
    """
    low, high = _range(x)
    return Basis(driver, low, high, np.zeros(0), (np.diag(np.repeat(ASSUMED.laws.harmonic_variances, 2) ** 0.5),))


def _range(x: Floats) -> tuple[float, float]:
    if len(x) == 0:
        return 0.0, 0.0
    low, high = np.quantile(x, COVERED)
    return float(low), float(high)
