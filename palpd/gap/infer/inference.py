"""Which sets of effects could have made the gap, and how probable each is: from the cell without effects to the best set by its names."""

from collections.abc import Callable
from dataclasses import dataclass

from palpd.gap.assumptions import ASSUMED
from palpd.gap.infer.correlated_residual import compared_again, row_weights, wrong_tolerances
from palpd.gap.infer.evidence import Fit
from palpd.gap.infer.intervals import NamedFit, named_fit
from palpd.gap.infer.posterior import Attribution, posterior
from palpd.gap.infer.search import Fits, search
from palpd.gap.infer.settle import settle
from palpd.gap.model.linearise import Linearisation
from palpd.gap.model.problem import Problem


@dataclass(frozen=True)
class Inference:
    """What the list of effects says about the recordings.

    Attributes:
        problem: The data, with the error of the simulator in their noise.
        nominal: The hypothesis that there is no effect.
        stated: Linearisation of the cell as stated, η₀ = 0; where its modulus is not known, at the fitted deviations.
        fits: Every set that was fitted, by its effects; with the stated noise.
        attribution: The posterior over hypotheses.
        best: The most probable hypothesis, by parameters that files can state.
    """

    problem: Problem
    nominal: Fit
    stated: Linearisation
    fits: Fits
    attribution: Attribution
    best: NamedFit


def infer(problem: Problem, show: Callable[[str], None] = lambda _: None) -> Inference:
    """Fit sets of effects, and weigh them.

    Where the residual of the best hypothesis is not white, its noise is estimated again from it, and the likeliest hypotheses are compared
    with that noise.

    Args:
        problem: As prepared.
        show: Is called with the name of each step that begins.
    """
    nominal = settle(problem)
    problem = nominal.problem
    show("2 of 6: fitting which effects could have made the gap")
    fits = search(nominal).fits
    show("3 of 6: weighing them")
    first = attribution = posterior(problem, fits)
    wider = wrong_tolerances(fits[first.best.fit.names])
    for _ in range(ASSUMED.noise.rounds):
        best = fits[attribution.best.fit.names]
        weight = row_weights(best.remainder)
        if not best.names or weight.min() == 1.0:
            break
        attribution = compared_again(problem, fits, first, weight, wider)
        if attribution.best.fit.names == best.names:
            break
    return Inference(problem, nominal.fit, nominal.stated, fits, attribution, named_fit(problem, attribution.best.fit))
