"""What turns recordings of a cell into a vector of unit noise, and back."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky_banded
from scipy.linalg.lapack import dtbtrs
from scipy.sparse import csr_array

from palpd.tick import Floats

NEGLIGIBLE = 1e-3
"""Noise that bins share is left out below this share of the variance that each has for itself."""


@dataclass(frozen=True)
class Whitening:
    """Gaussian noise of binned channels (7, b): `sigma` (7, b), which every bin has for itself, infinite where nothing is judged; and
    in some channels what neighbours share, `shared` (b, k) · k independent standard normal numbers."""

    sigma: Floats
    shared: Mapping[int, csr_array]
    factors: Mapping[int, Floats]  # lower Cholesky factors of the covariances of those channels, banded as LAPACK has them

    @staticmethod
    def of(sigma: Floats, shared: Mapping[int, csr_array]) -> "Whitening":
        """That noise, ready to be used."""
        found = {channel: _factor(sigma[channel] ** 2, columns) for channel, columns in shared.items()}
        return Whitening(sigma, shared, {channel: factor for channel, factor in found.items() if factor is not None})

    def softened(self, wider: Floats) -> "Whitening":
        """With what every bin has for itself so many times as wide (7, b)."""
        return Whitening.of(self.sigma * wider, self.shared)

    def weighed(self, weight: float) -> "Whitening":
        """With every row counting for so many."""
        return Whitening.of(self.sigma / weight**0.5, {channel: columns / weight**0.5 for channel, columns in self.shared.items()})

    def restricted(self, bins: NDArray[np.bool_]) -> "Whitening":
        """With all other bins weighing nothing."""
        return replace(self, sigma=np.where(bins, self.sigma, np.inf))

    def whiten(self, values: Floats) -> Floats:
        """Values (7, b) in their units, in sigmas."""
        out = values / self.sigma
        for channel, factor in self.factors.items():
            solved, failed = dtbtrs(factor, values[channel], uplo="L")
            assert not failed, failed
            out[channel] = np.where(np.isfinite(self.sigma[channel]), solved, 0.0)
        return np.asarray(out)

    def natural(self, values: Floats) -> Floats:
        """Values (…, 7, b) in sigmas, in their units; 0 where nothing is judged."""
        judged = np.isfinite(self.sigma)
        values = np.where(judged, values, 0.0)
        out = values * np.where(judged, self.sigma, 0.0)
        for channel, factor in self.factors.items():
            total = factor[0] * values[..., channel, :]
            for k in range(1, len(factor)):
                total[..., k:] += factor[k, :-k] * values[..., channel, :-k]
            out[..., channel, :] = np.where(judged[channel], total, 0.0)
        return np.asarray(out)

    @property
    def rms(self) -> Floats:
        """Noise of every bin by itself, (7, b), 0 where nothing is judged."""
        square = np.where(np.isfinite(self.sigma), self.sigma, 0.0) ** 2
        for channel, columns in self.shared.items():
            square[channel] += np.where(np.isfinite(self.sigma[channel]), columns.power(2).sum(axis=1), 0.0)
        return np.asarray(np.sqrt(square))


def _factor(own: Floats, columns: csr_array) -> Floats | None:
    """The factor of a channel's covariance; None where what is shared does not matter."""
    if not (columns.power(2).sum(axis=1) > NEGLIGIBLE * own).any():
        return None
    together = (columns @ columns.T).tocoo()
    row, column = together.coords
    below = row >= column
    band = np.zeros((int((row - column).max()) + 1, len(own)))
    band[(row - column)[below], column[below]] = together.data[below]
    band[0] += np.where(np.isfinite(own), own, 1.0)
    return np.asarray(cholesky_banded(band, lower=True, check_finite=False))
