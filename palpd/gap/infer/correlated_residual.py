"""Stage 4 of a diagnosis, continued: hypotheses compared with bins that count for less where the residual is smooth.

Neighbours in a smooth residual are not independent, and a further effect of any kind then explains some of it. So the noise that
listed effects are compared with is the residual's own (a model discrepancy in the sense of Kennedy and O'Hagan, 2001). Whether
something outside the list is at work is still judged by the stated noise, hypothesis by hypothesis. Its total is not taken from the
posterior with the stated noise: that sees fewer effects outside the list.

Where even the best hypothesis needs a deviation far out of its tolerance, that tolerance is wrong. Hypotheses are then compared with a
tolerance as wide as the deviation (empirical Bayes). Otherwise the far tail of a normal distribution decides, which no cell file means.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from palpd.gap.infer.evidence import Fit, fit
from palpd.gap.infer.hypotheses import CREDIBLE_SD
from palpd.gap.infer.posterior import Attribution, Hypothesis, attribution_of, posterior
from palpd.gap.model.linearise import linearise
from palpd.gap.model.problem import Problem
from palpd.tick import Floats

WHITE_ENOUGH = 1.5
"""Variance of a whitened residual times its correlation time in bins below which bins count fully: estimates of white noise stay
below."""

COMPARED = 10
"""Number of likeliest hypotheses that are compared again; less likely hypotheses have never come first."""

ROUNDS = 2
"""Largest number of comparisons: the second follows where the first changes the best hypothesis, and so its residual."""


def compare_again(problem: Problem, fits: Mapping[tuple[str, ...], Fit], first: Attribution) -> Attribution:
    """Compare the likeliest hypotheses again, with the noise that the residual of the best hypothesis shows.

    Args:
        problem: With the stated noise.
        first: The posterior with the stated noise.

    Returns:
        The posterior; `first` where the residual of its best hypothesis is white, or that is the empty set.
    """
    now, wider = first, wrong_tolerances(fits[first.best.fit.names])
    for _ in range(ROUNDS):
        best = fits[now.best.fit.names]
        weight = row_weights(best.remainder)
        if not best.names or weight.min() == 1.0:
            break
        comparable = problem.with_row_weight(weight).with_shared_sd(wider * problem.shared_sd)
        now = _with_stated_noise(problem, fits, _compared(comparable, fits, first, wider), wider)
        if now.best.fit.names == best.names:
            break
    return now


def row_weights(remainder: Floats) -> Floats:
    """For how many bins a bin of each channel counts: 1 / (variance of the residual × correlation time), at most 1.

    Args:
        remainder: Whitened residual without what the nuisances explain (7, b).

    Returns:
        The weights (7,).
    """
    weights = np.ones(len(remainder))
    for channel, values in enumerate(remainder):
        live = values[values != 0.0]
        if len(live) > 1:
            size = float(np.mean(live**2)) * correlation_time(live)
            weights[channel] = 1.0 / size if size > WHITE_ENOUGH else 1.0
    return weights


def wrong_tolerances(best: Fit) -> Floats:
    """Factors (11,) by which the tolerances of shared deviations are too narrow for a hypothesis; 1 where a deviation is credible."""
    deviation_sd = np.abs(best.linearisation.space.coefficients(best.residual)[: len(best.eta)])
    return np.where(deviation_sd > CREDIBLE_SD, deviation_sd, 1.0)


def correlation_time(values: Floats) -> float:
    """Integrated autocorrelation time of a residual (n,), in bins: 1 + 2 Σ ρ up to the first negative ρ (Geyer 1992).

    White noise has 1.
    """
    n = len(values)
    power = np.abs(np.fft.rfft(values, 2 * n)) ** 2
    correlation = np.fft.irfft(power)[:n]
    rho = correlation / max(float(correlation[0]), 1e-300)
    negative = np.flatnonzero(rho < 0.0)
    return float(1.0 + 2.0 * rho[1 : negative[0] if len(negative) else n].sum())


def _compared(problem: Problem, fits: Mapping[tuple[str, ...], Fit], first: Attribution, wider: Floats) -> Attribution:
    """The posterior of the likeliest hypotheses, of their subsets and of no effect, fitted again with other weights and tolerances."""
    likeliest = [one.fit.names for one in first.hypotheses[:COMPARED]]
    single = [(name,) for names in likeliest[:3] for name in names if (name,) in fits]
    again: dict[tuple[str, ...], Fit] = {}
    for names in dict.fromkeys([(), *likeliest, *single]):
        one = fits[names]
        again[names] = fit(problem, one.values, linearise(problem, one.values, one.eta / wider), iterations=3, rounds=1)
    return posterior(problem, again, len(again))


def _with_stated_noise(problem: Problem, fits: Mapping[tuple[str, ...], Fit], compared: Attribution, wider: Floats) -> Attribution:
    """The hypotheses with their probabilities from the comparison; fits and odds for something unknown are those of the stated noise.

    The best hypothesis keeps the parameters of the comparison and their intervals.
    """
    names = [one.fit.names for one in compared.hypotheses]
    stated = {one.fit.names: one for one in posterior(problem, {n: fits[n] for n in names}, len(names)).hypotheses}

    def judged(one: Hypothesis) -> Hypothesis:
        now = fits[one.fit.names]
        if one is compared.best:
            there = linearise(problem, one.fit.values, one.fit.eta * wider)
            now = replace(fit(problem, one.fit.values, there, iterations=0), covariance=one.fit.covariance, laws=one.fit.laws)
        return replace(one, fit=now, residual=stated[one.fit.names].residual, share_known=stated[one.fit.names].share_known)

    return attribution_of([judged(one) for one in compared.hypotheses])
