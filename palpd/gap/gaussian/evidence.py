"""Evidence of a group of columns X: nuisances and the coefficients w ~ N(0, s² L Lᵀ) are integrated out, and s and L averaged over.

docs/explanation/inference.md states the formula under "Laws and events". P, below, projects the nuisances out.
"""

from dataclasses import dataclass
from math import log

import numpy as np

from palpd.gap.assumptions import ASSUMED
from palpd.gap.gaussian.nuisance_space import Products
from palpd.tick import Floats


@dataclass(frozen=True)
class GroupEvidence:
    """How likely a group of n columns is.

    Attributes:
        nats: Log Bayes factor against w = 0, less the price of a change that nuisances nearly hide; -inf where they hide it.
        root: Root s L (n, n) of the prior covariance of w, for the likeliest s and L.
        mean: Posterior mean of w (n,).
        covariance: Posterior covariance of w (n, n).
    """

    nats: float
    root: Floats
    mean: Floats
    covariance: Floats


def group_evidence(products: Products, priors: tuple[Floats, ...]) -> GroupEvidence:
    """Evidence of one group, averaged over its priors and sizes.

    Args:
        products: Of the n columns of the group.
        priors: The roots L (n, n), such as one for each length over which a curve is smooth.
    """
    n = len(products.slope)
    log_factors = _log_factors(products.gram[None], products.slope[None], priors)[:, 0]
    likeliest = int(np.argmax(log_factors))
    if not np.isfinite(log_factors[likeliest]):
        return GroupEvidence(-np.inf, np.zeros((n, n)), np.zeros(n), np.zeros((n, n)))
    prior, size = priors[likeliest // len(ASSUMED.laws.sizes_sd)], ASSUMED.laws.sizes_sd[likeliest % len(ASSUMED.laws.sizes_sd)]
    energy = float(np.einsum("ij,ji->", products.gram, prior @ prior.T))
    root = size / max(energy, 1e-300) ** 0.5 * prior  # rounding can make the energy of a group that does nothing negative
    nats = float(np.logaddexp.reduce(log_factors) - log(len(log_factors)))
    mean, covariance = posterior_of(products, root)
    whole = float(mean @ products.raw @ mean)
    share = float(mean @ products.gram @ mean) / whole if whole > 0.0 else 0.0
    price = np.inf if share < ASSUMED.laws.least_share else ASSUMED.laws.share_price_nats * max(log(ASSUMED.laws.full_share / share), 0.0)
    return GroupEvidence(nats - price, root, mean, covariance)


def batch_nats(grams: Floats, slopes: Floats, priors: tuple[Floats, ...]) -> Floats:
    """Log Bayes factors of many groups, before any price.

    Args:
        grams: XᵀPX of every group (k, n, n).
        slopes: XᵀPr of every group (k, n).
        priors: The roots L (n, n).

    Returns:
        The factors (k,) in nats, -inf where nuisances hide a group.
    """
    log_factors = _log_factors(grams, slopes, priors)
    return np.asarray(np.logaddexp.reduce(log_factors, axis=0) - log(len(log_factors)))


def _log_factors(grams: Floats, slopes: Floats, priors: tuple[Floats, ...]) -> Floats:
    """Log Bayes factors (priors times sizes, k), -inf where nuisances hide a group altogether."""
    out = []
    for prior in priors:
        values, vectors = np.linalg.eigh(prior.T @ grams @ prior)
        values = np.maximum(values, 0.0)
        total = values.sum(axis=-1)
        live = total > 1e-12
        q = np.einsum("kij,ki->kj", vectors, slopes @ prior)
        for size in ASSUMED.laws.sizes_sd:
            square = (size**2 / np.where(live, total, 1.0))[:, None]
            weight = 1.0 + square * values
            out.append(np.where(live, 0.5 * (square * q**2 / weight - np.log(weight)).sum(axis=-1), -np.inf))
    return np.array(out)


def posterior_of(products: Products, root: Floats) -> tuple[Floats, Floats]:
    """Posterior mean (n,) and covariance (n, n) of the coefficients w.

    Args:
        root: Root s L (n, n) of the prior covariance of w.
    """
    inner = np.linalg.inv(np.eye(len(root)) + root.T @ products.gram @ root)
    covariance = root @ inner @ root.T
    return covariance @ products.slope, covariance
