"""Stage 2 of a diagnosis: the cell without effects, which settles how readings are rounded and how large the simulator's error may be."""

from dataclasses import dataclass

import numpy as np

from palpd.gap.assumptions import ASSUMED
from palpd.gap.data.rounding import WAYS
from palpd.gap.infer.evidence import Fit, fit
from palpd.gap.model.linearise import Linearisation, linearise
from palpd.gap.model.problem import SHARED, Problem


@dataclass(frozen=True)
class NominalFit:
    """The cell without effects.

    Attributes:
        problem: With the error of the simulator in its noise.
        fit: The hypothesis that there is no effect.
        stated: Linearisation of the cell as stated, η₀ = 0; where its modulus is not known, at the fitted deviations.
        linearisation: From it effects are searched: that of `fit`, or `stated` where a deviation of `fit` is not credible.
    """

    problem: Problem
    fit: Fit
    stated: Linearisation
    linearisation: Linearisation

    @property
    def surprise(self) -> float:
        """Negative log likelihood, up to a constant. It counts the width of the noise, which the error floor changes."""
        sigma = self.problem.noise.sigma
        return -self.fit.log_exact + float(np.log(sigma[np.isfinite(sigma)]).sum())


def fit_nominal(problem: Problem) -> NominalFit:
    """Fit the cell without effects, which also says how large the error of the simulator may be."""
    stated = linearise(problem, {}, problem.nominal_eta)
    if not problem.cell.tolerances.modulus_known:
        first = fit(problem, {}, stated, rounds=8)
        # The force in proportion to the modulus has been fitted: it is the gap's size.
        by_modulus = (np.arange(first.linearisation.space.size) == SHARED.index("youngs_modulus")).astype(float)
        problem = problem.with_model_error_floor(first.linearisation.space.explained(by_modulus) / problem.shared_sd[0])
        nominal = fit(problem, {}, linearise(problem, {}, first.eta), rounds=ASSUMED.search.rounds)
        return NominalFit(problem, nominal, nominal.linearisation, nominal.linearisation)
    problem = problem.with_model_error_floor(problem.data - stated.prediction)
    stated = linearise(problem, {}, problem.nominal_eta)
    nominal = fit(problem, {}, stated, rounds=ASSUMED.search.rounds)
    # Beyond that, hypotheses that are linearised elsewhere would be judged by other tolerances.
    credible = np.abs(nominal.eta).max() < ASSUMED.noise.credible_sd
    return NominalFit(problem, nominal, stated, nominal.linearisation if credible else stated)


def settle(problem: Problem) -> NominalFit:
    """Settle the way in which coarse readings are rounded, and the error floor.

    Another way than to the nearest level must win by `rounding.other_way_nats`, since an effect may imitate it. Only a step that is
    coarser than the stated step is tried in other ways; it may also round readings that were rounded to the stated step before.

    Args:
        problem: With readings rounded to the nearest level, if they are rounded coarsely.
    """
    nearest = fit_nominal(problem)
    stated_N = problem.cell.sensor.resolution_fz_N
    if not problem.roundings or problem.roundings[0].step_N == stated_N:
        return nearest
    tried = [nearest, *(fit_nominal(problem.with_rounding(way, 0.0)) for way in WAYS if way != problem.roundings[0].way)]
    if stated_N:
        likeliest = min(tried, key=lambda nominal: nominal.surprise).problem.roundings[0]
        tried.append(fit_nominal(problem.with_rounding(likeliest.way, stated_N)))
    best = min(tried, key=lambda nominal: nominal.surprise)
    return best if best.surprise < nearest.surprise - ASSUMED.rounding.other_way_nats else nearest
