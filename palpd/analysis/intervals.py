"""Intervals of fitted parameters and of means, with residuals that are correlated in time."""

import math
from collections.abc import Sequence

import numpy as np
from scipy.special import stdtrit  # the quantile behind scipy.stats.t, whose import costs the daemon 3 s and 76 MB

from palpd.control.surface import correlation_time
from palpd.tick import Floats


def student_t_95(degrees: float) -> float:
    """Two-sided 95 % point of Student's distribution."""
    return float(stdtrit(degrees, 0.975))


def mean_half_width_95(values: Floats | Sequence[float]) -> float:
    """Half-width of the 95 % interval of a mean, by Student's distribution.

    Args:
        values: Independent values (n,), n at least 2.

    Returns:
        The half-width, in the unit of the values.
    """
    return student_t_95(len(values) - 1) * float(np.std(values, ddof=1)) / math.sqrt(len(values))


def correlated_sigmas(slopes: Floats, residual: Floats, common: Floats | None = None, *, slow: bool = True) -> tuple[Floats, float]:
    """Standard deviations of least-squares parameters when the residual is correlated in time.

    The covariance is a sandwich of correlated scores (Newey and West 1987). Where the slopes vary as slowly as the residual, the
    sandwich is too small in short records; then the plain covariance times the correlation time is taken if it is larger.

    Args:
        slopes: Derivatives (n, p) of the model by its parameters.
        residual: Residuals (n,).
        common: One standard deviation (n,) of an error that all samples share, or None.
        slow: Whether the slopes vary as slowly as the residual.

    Returns:
        Standard deviations (p,) in the units of the parameters, and the effective sample size.
    """
    n, p = slopes.shape
    scale = np.sqrt(np.mean(slopes**2, axis=0))
    scaled = slopes / scale
    time, length = correlation_time(residual)
    n_effective = n / time
    scores = scaled * residual[:, None]
    middle = scores.T @ scores
    window = min(2 * length, n // 4)
    for lag in range(1, window + 1):
        product = scores[lag:].T @ scores[:-lag]
        middle += (1.0 - lag / (window + 1)) * (product + product.T)
    bread = np.linalg.pinv(scaled.T @ scaled)
    variance = np.diag(bread @ middle @ bread)
    if slow:
        variance = np.maximum(variance, np.diag(bread) * time * float(np.mean(residual**2)))
    # residuals are smaller than errors by the parameters they were fitted with
    variance = variance * n_effective / max(n_effective - p, 1.0)
    if common is not None:
        variance = variance + (bread @ scaled.T @ common) ** 2
    return np.sqrt(variance) / scale, n_effective
