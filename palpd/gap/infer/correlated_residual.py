"""Hypotheses compared with bins that count for less where the residual is smooth: the noise is estimated again from it.

Neighbours in a smooth residual are not independent, and a further effect of any kind then explains some of it. So the noise that
listed effects are compared with is the residual's own (a model discrepancy in the sense of Kennedy and O'Hagan, 2001). Whether
something outside the list is at work is still judged by the stated noise, hypothesis by hypothesis. Its total is not taken from the
posterior with the stated noise: that sees fewer effects outside the list.

Where even the best hypothesis needs a deviation far out of its tolerance, that tolerance is wrong. Hypotheses are then compared with a
tolerance as wide as the deviation (empirical Bayes). Otherwise the far tail of a normal distribution decides, which no cell file means.
"""

from collections.abc import Mapping

import numpy as np

from palpd.gap.assumptions import ASSUMED
from palpd.gap.infer.evidence import Fit, fit
from palpd.gap.infer.posterior import Attribution, Hypothesis, attribution_of, posterior
from palpd.gap.model.linearise import linearise
from palpd.gap.model.problem import Problem
from palpd.tick import Floats


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
            weights[channel] = 1.0 / size if size > ASSUMED.noise.white_enough else 1.0
    return weights


def wrong_tolerances(best: Fit) -> Floats:
    """Factors (11,) by which the tolerances of shared deviations are too narrow for a hypothesis; 1 where a deviation is credible."""
    deviation_sd = np.abs(best.linearisation.space.coefficients(best.residual)[: len(best.eta)])
    return np.where(deviation_sd > ASSUMED.noise.credible_sd, deviation_sd, 1.0)


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


def compared_again(problem: Problem, fits: Mapping[tuple[str, ...], Fit], first: Attribution, weight: Floats, wider: Floats) -> Attribution:
    """Compare the likeliest hypotheses, their subsets and no effect, fitted again with other weights and tolerances.

    Fits and odds for something unknown are those of the stated noise. The best hypothesis has the parameters of the comparison and their
    intervals.

    Args:
        first: The posterior with the stated noise.
        weight: For how many bins a bin of each channel counts (7,).
        wider: Factors (11,) on the tolerances of shared deviations.
    """
    likeliest = [one.fit.names for one in first.hypotheses[: ASSUMED.noise.compared]]
    single = [(name,) for names in likeliest[:3] for name in names if (name,) in fits]
    comparable = problem.with_row_weight(weight).with_shared_sd(wider * problem.shared_sd)
    again: dict[tuple[str, ...], Fit] = {}
    for names in dict.fromkeys([(), *likeliest, *single]):
        one = fits[names]
        again[names] = fit(comparable, one.values, linearise(comparable, one.values, one.eta / wider), iterations=3, rounds=1)
    compared = posterior(comparable, again, len(again))
    stated = {one.fit.names: one for one in posterior(problem, {n: fits[n] for n in again}, len(again)).hypotheses}

    def judged(one: Hypothesis) -> Hypothesis:
        of_stated_noise, now = stated[one.fit.names], fits[one.fit.names]
        if one is compared.best:
            there = linearise(problem, one.fit.values, one.fit.eta * wider)
            now = fit(problem, one.fit.values, there, iterations=0, laws=one.fit.laws)
        return Hypothesis(now, of_stated_noise.residual, one.share, of_stated_noise.share_known)

    return attribution_of([judged(one) for one in compared.hypotheses])
