"""Evidence of a group of columns: its coefficients are marginalised, and so are tolerances and the group's own size."""

from dataclasses import dataclass
from math import log

import numpy as np

from palpd.gap.gaussian.nuisance_space import Products
from palpd.tick import Floats

SIZES = (8.0, 20.0, 50.0, 150.0)
"""Sizes, in sigmas beyond what tolerances hide, that a law may have before the data are seen."""

LEAST_SHARE, FULL_SHARE = 0.004, 0.1
"""Share of a change that tolerances leave below which it is no law, and above which it pays nothing: a law that tolerances all but hide
has a large coefficient, and opens the gap on another motion."""

SHARE_PRICE = 1.5
"""Nats per factor e by which the share lies below FULL_SHARE."""


@dataclass(frozen=True)
class GroupEvidence:
    """How likely a group is.

    Attributes:
        nats: Log Bayes factor against nothing, less the price of a change that tolerances nearly hide.
        root: Root (n, n) of the prior covariance of the coefficients at the likeliest length and size.
        mean: Posterior mean of the coefficients (n,).
        covariance: Posterior covariance (n, n).
    """

    nats: float
    root: Floats
    mean: Floats
    covariance: Floats


def group_evidence(products: Products, priors: tuple[Floats, ...]) -> GroupEvidence:
    """Evidence of one group, averaged over lengths and sizes.

    Args:
        products: Inner products of its columns.
        priors: Roots (n, n) of the covariances that the coefficients may have.

    Returns:
        The evidence, -inf where tolerances hide the group.
    """
    n = len(products.slope)
    each = _log_factors(products.gram[None], products.slope[None], priors)[:, 0]
    likeliest = int(np.argmax(each))
    if not np.isfinite(each[likeliest]):
        return GroupEvidence(-np.inf, np.zeros((n, n)), np.zeros(n), np.zeros((n, n)))
    prior, size = priors[likeliest // len(SIZES)], SIZES[likeliest % len(SIZES)]
    root = size / float(np.einsum("ij,ji->", products.gram, prior @ prior.T)) ** 0.5 * prior
    nats = float(np.logaddexp.reduce(each) - log(len(each)))
    mean, covariance = posterior_of(products, root)
    whole = float(mean @ products.raw @ mean)
    share = float(mean @ products.gram @ mean) / whole if whole > 0.0 else 0.0
    price = np.inf if share < LEAST_SHARE else SHARE_PRICE * max(log(FULL_SHARE / share), 0.0)
    return GroupEvidence(nats - price, root, mean, covariance)


def batch_nats(grams: Floats, slopes: Floats, priors: tuple[Floats, ...]) -> Floats:
    """Log Bayes factors of many groups, before any price.

    Args:
        grams: Inner products of the columns of every group (k, n, n).
        slopes: Their inner products with the residual (k, n).
        priors: Roots (n, n) of the covariances that the coefficients may have.

    Returns:
        The factors (k,).
    """
    each = _log_factors(grams, slopes, priors)
    return np.asarray(np.logaddexp.reduce(each, axis=0) - log(len(each)))


def _log_factors(grams: Floats, slopes: Floats, priors: tuple[Floats, ...]) -> Floats:
    """Log Bayes factors (priors times sizes, k), -inf where tolerances hide a group altogether."""
    out = []
    for prior in priors:
        values, vectors = np.linalg.eigh(prior.T @ grams @ prior)
        values = np.maximum(values, 0.0)
        total = values.sum(axis=-1)
        live = total > 1e-12
        q = np.einsum("kij,ki->kj", vectors, slopes @ prior)
        for size in SIZES:
            square = (size**2 / np.where(live, total, 1.0))[:, None]
            weight = 1.0 + square * values
            out.append(np.where(live, 0.5 * (square * q**2 / weight - np.log(weight)).sum(axis=-1), -np.inf))
    return np.array(out)


def posterior_of(products: Products, root: Floats) -> tuple[Floats, Floats]:
    """Mean (n,) and covariance (n, n) of coefficients.

    Args:
        products: Inner products of the columns.
        root: Root (n, n) of their prior covariance.

    Returns:
        Both.
    """
    inner = np.linalg.inv(np.eye(len(root)) + root.T @ products.gram @ root)
    covariance = root @ inner @ root.T
    return covariance @ products.slope, covariance
