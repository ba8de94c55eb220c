"""The noise Σ of binned channels: dividing by it (whitening), and back."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky_banded
from scipy.linalg.lapack import dtbtrs
from scipy.sparse import csr_array

from palpd.tick import Floats

NEGLIGIBLE = 1e-3
"""A channel's shared noise is left out if its variance is at most this share of a bin's own variance in every bin."""


@dataclass(frozen=True)
class Whitening:
    """Gaussian noise Σ of 7 channels in b bins; channels are independent of each other.

    Attributes:
        sigma: Standard deviation (7, b) of the noise that every bin has for itself, infinite where nothing is compared.
        shared: Noise that neighbouring bins share, in some channels: a matrix S (b, k) times k independent standard normal numbers.
        factors: Of those channels, the lower Cholesky factor of diag(sigma²) + S Sᵀ as a band matrix of LAPACK: (bandwidth, b).
    """

    sigma: Floats
    shared: Mapping[int, csr_array]
    factors: Mapping[int, Floats]

    @staticmethod
    def of(sigma: Floats, shared: Mapping[int, csr_array]) -> "Whitening":
        """Prepare noise for whitening.

        Args:
            sigma: As the attribute, (7, b).
            shared: As the attribute; channels in which it is negligible stay without a factor.
        """
        factors = {channel: _factor(sigma[channel] ** 2, columns) for channel, columns in shared.items()}
        return Whitening(sigma, shared, {channel: factor for channel, factor in factors.items() if factor is not None})

    def widened(self, factor: Floats) -> "Whitening":
        """The noise with another `sigma`; the shared part stays.

        Args:
            factor: Ratio (7, b) of the new `sigma` to this one.
        """
        return Whitening.of(self.sigma * factor, self.shared)

    def with_row_weight(self, weight: float | Floats) -> "Whitening":
        """The noise in which every bin counts for `weight` bins: its variance is divided by it.

        Args:
            weight: A number for all channels, or a number for each channel (7,); below 1 where neighbouring residuals are correlated.
        """
        factor = np.broadcast_to(np.asarray(weight) ** -0.5, len(self.sigma))
        return Whitening.of(self.sigma * factor[:, None], {channel: columns * factor[channel] for channel, columns in self.shared.items()})

    def restricted_to(self, bins: NDArray[np.bool_]) -> "Whitening":
        """The noise where only some bins (b,) count; it is infinite in the others."""
        return replace(self, sigma=np.where(bins, self.sigma, np.inf))

    def whiten(self, values: Floats) -> Floats:
        """Values in units of their noise.

        Args:
            values: Values (7, b) in the units of the channels.

        Returns:
            Values (7, b) in sigmas, 0 where nothing is compared.
        """
        white = values / self.sigma
        for channel in self.factors:
            white[channel] = self.whiten_channel(channel, values[channel])
        return white

    def whiten_channel(self, channel: int, values: Floats) -> Floats:
        """Values of one channel in units of their noise.

        Args:
            values: Values (b,) or columns (b, n), in the unit of the channel.

        Returns:
            Values (b,) or columns (b, n) in sigmas, 0 where nothing is compared.
        """
        sigma = self.sigma[channel].reshape(-1, *[1] * (values.ndim - 1))
        if channel not in self.factors:
            return np.asarray(values / sigma)
        white, failed = dtbtrs(self.factors[channel], values, uplo="L")
        assert not failed, failed
        return np.where(np.isfinite(sigma), white, 0.0)

    def natural(self, values: Floats) -> Floats:
        """Values in their own units, the inverse of `whiten`.

        Args:
            values: Values (..., 7, b) in sigmas.

        Returns:
            Values (..., 7, b) in the units of the channels; 0 where nothing is compared.
        """
        return np.stack([self.natural_channel(channel, values[..., channel, :]) for channel in range(len(self.sigma))], axis=-2)

    def natural_channel(self, channel: int, values: Floats) -> Floats:
        """Values of one channel in its unit, the inverse of `whiten_channel`.

        Args:
            values: Values (..., b) in sigmas.

        Returns:
            Values (..., b) in the unit of the channel; 0 where nothing is compared.
        """
        judged = np.isfinite(self.sigma[channel])
        values = np.where(judged, values, 0.0)
        if channel not in self.factors:
            return np.asarray(values * np.where(judged, self.sigma[channel], 0.0))
        factor = self.factors[channel]
        total = factor[0] * values
        for k in range(1, len(factor)):
            total[..., k:] += factor[k, :-k] * values[..., :-k]
        return np.where(judged, total, 0.0)

    @property
    def rms(self) -> Floats:
        """Rms of the noise of every bin (7, b), 0 where nothing is compared."""
        square = np.where(np.isfinite(self.sigma), self.sigma, 0.0) ** 2
        for channel, columns in self.shared.items():
            square[channel] += np.where(np.isfinite(self.sigma[channel]), columns.power(2).sum(axis=1), 0.0)
        return np.asarray(np.sqrt(square))


def _factor(variance: Floats, columns: csr_array) -> Floats | None:
    """Cholesky factor of a channel's covariance as a band matrix; None where the shared noise is negligible."""
    if not (columns.power(2).sum(axis=1) > NEGLIGIBLE * variance).any():
        return None
    together = (columns @ columns.T).tocoo()
    row, column = together.coords
    below = row >= column
    band = np.zeros((int((row - column).max()) + 1, len(variance)))
    band[(row - column)[below], column[below]] = together.data[below]
    band[0] += np.where(np.isfinite(variance), variance, 1.0)
    return np.asarray(cholesky_banded(band, lower=True, check_finite=False))
