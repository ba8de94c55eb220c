"""The probability of every hypothesis, of no effect, and of something outside the list."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import comb, log

import numpy as np

from palpd.gap.assumptions import ASSUMED
from palpd.gap.infer.evidence import Fit
from palpd.gap.infer.residual import ResidualStructure, segments_of, test_residual
from palpd.gap.model.problem import Problem
from palpd.gap.user_simulator import SimulatorDoubt

COARSE = 0.05
"""Share of a gap beside a learned nominal that the listed law of a real effect may leave, so that it says nothing for another law."""


@dataclass(frozen=True)
class Hypothesis:
    """A hypothesis with the structure of its residual and its posterior probability.

    Attributes:
        share: Probability that these effects act, with or without something unknown.
        share_known: Ratio of the probability without anything unknown to `share`.
    """

    fit: Fit
    residual: ResidualStructure
    share: float
    share_known: float

    @property
    def known(self) -> float:
        """Probability that these effects act and nothing unknown does."""
        return self.share * self.share_known

    @property
    def unknown(self) -> float:
        """Probability that these effects and something unknown act."""
        return self.share * (1.0 - self.share_known)

    @property
    def name(self) -> str:
        """The ids of its effects in words."""
        return " with ".join(self.fit.names) or "no effect"


@dataclass(frozen=True)
class Attribution:
    """The posterior over hypotheses.

    Attributes:
        hypotheses: Those whose residual was tested, the most probable first; their probabilities add up to 1.
        p_none: Probability that there is no effect and nothing unknown.
        p_unknown: Probability that something outside the list is at work.
        marginal: Probability of every effect: the sum over the sets that hold it.
        groups: For every effect of the best hypothesis the effects that could stand in its place, the most probable first.
    """

    hypotheses: list[Hypothesis]
    p_none: float
    p_unknown: float
    marginal: dict[str, float]
    groups: dict[str, list[str]]

    @property
    def best(self) -> Hypothesis:
        """The most probable hypothesis."""
        return self.hypotheses[0]


def posterior(problem: Problem, fits: Mapping[tuple[str, ...], Fit], most_tested: int = ASSUMED.search.tested) -> Attribution:
    """The posterior over the hypotheses, each without and with something unknown in addition.

    Args:
        fits: The fitted hypotheses by their effects; the empty set is among them.
        most_tested: Number of likeliest hypotheses whose residual is tested. All others but the empty set are left out.
    """
    worth = _worth(problem, fits)
    order = sorted(fits, key=lambda names: -(worth[names] + fits[names].log_likelihood))
    segments = segments_of(problem)
    tested = {names: test_residual(problem, fits[names], segments) for names in dict.fromkeys([*order[:most_tested], ()])}
    most = _most_of_any_shape(fits, tested, worth)
    nominal, gap = fits[()], tested[()]
    logs: dict[tuple[str, ...], tuple[float, float]] = {}
    for names, residual in tested.items():
        energy = max(gap.energy, nominal.misfit - fits[names].misfit + residual.energy)
        known, unknown = known_and_unknown(fits[names], residual, energy, most - worth[names])
        logs[names] = worth[names] + known, worth[names] + unknown - price_nats(problem, "")
    logs = _coarse(problem, logs)
    total = float(np.logaddexp.reduce([w for both in logs.values() for w in both]))
    return attribution_of(
        [
            Hypothesis(
                fits[names],
                tested[names],
                share=float(np.exp(np.logaddexp(known, unknown) - total)),
                share_known=float(np.exp(known - np.logaddexp(known, unknown))),
            )
            for names, (known, unknown) in logs.items()
        ]
    )


def _coarse(problem: Problem, logs: Mapping[tuple[str, ...], tuple[float, float]]) -> dict[tuple[str, ...], tuple[float, float]]:
    """Logs of the hypotheses, where the nominal was learned from a real cell.

    No real effect follows its listed law, and the larger a gap, the more of it such a law leaves: a share of it decides nothing. So beside
    a gap of G nats the log odds among sets with effects count 1 / (1 + ε G) (a coarsened posterior: Miller and Dunson 2019). Those of the
    likeliest set against no effect stay.
    """
    sums = {names: float(np.logaddexp(*both)) for names, both in logs.items()}
    best = max((weight for names, weight in sums.items() if names), default=sums[()])
    coarseness = 1.0 + COARSE * max(best - sums[()], 0.0) if _doubts(problem) else 1.0
    more = {names: (best - weight) * (1.0 - 1.0 / coarseness) if names else 0.0 for names, weight in sums.items()}
    return {names: (known + more[names], unknown + more[names]) for names, (known, unknown) in logs.items()}


def attribution_of(hypotheses: list[Hypothesis]) -> Attribution:
    """The posterior over hypotheses whose probabilities add up to 1."""
    hypotheses = sorted(hypotheses, key=lambda one: -one.share)
    marginal: dict[str, float] = {}
    for one in hypotheses:
        for name in one.fit.names:
            marginal[name] = marginal.get(name, 0.0) + one.share
    p_none = sum(one.known for one in hypotheses if not one.fit.names)
    p_unknown = sum(one.unknown for one in hypotheses)
    return Attribution(hypotheses, p_none, p_unknown, marginal, _groups(hypotheses))


def log_prior(problem: Problem, names: Sequence[str]) -> float:
    """Log P(set) of a set of effects: all sets of a size are equally probable, but for what their effects cost."""
    listed = sum(not effect.scatter for effect in problem.library.values())
    of_size = (ASSUMED.prior.none, ASSUMED.prior.one, ASSUMED.prior.two, ASSUMED.prior.three)[len(names)]
    return log(of_size) - log(comb(listed, len(names))) - sum(price_nats(problem, name) for name in names)


def price_nats(problem: Problem, name: str) -> float:
    """What an effect costs beside a simulator that was learned; of something unknown with an empty name."""
    return max((problem.price_share * doubt.price_nats.get(name, 0.0) for doubt in _doubts(problem)), default=0.0)


def _doubts(problem: Problem) -> list[SimulatorDoubt]:
    """How the nominal of each recording may be wrong, where it was learned."""
    return [one.simulated.doubt for one in problem.recordings if one.simulated is not None and one.simulated.doubt is not None]


def single_odds(problem: Problem, fits: Mapping[tuple[str, ...], Fit]) -> dict[str, float]:
    """Logarithm of the odds of each fitted single effect against none."""
    worth = _worth(problem, fits)
    none = worth[()] + fits[()].log_exact
    return {names[0]: float(worth[names] + one.log_likelihood - none) for names, one in fits.items() if len(names) == 1}


def _worth(problem: Problem, fits: Mapping[tuple[str, ...], Fit]) -> dict[tuple[str, ...], float]:
    """Log P(set) plus log volume (`Fit.occam`) of every hypothesis.

    The log volume of a set counts as `prior.further_effect_nats` below that of each fitted set with an effect less, or as it is where
    it is lower.
    """
    by_set = {frozenset(names): one.occam for names, one in fits.items()}
    out = {}
    for names, one in fits.items():
        smaller = [by_set[rest] for name in names if len(names) > 1 and (rest := frozenset(names) - {name}) in by_set]
        out[names] = log_prior(problem, names) + min([one.occam, *(occam - ASSUMED.prior.further_effect_nats for occam in smaller)])
    return out


def _most_of_any_shape(
    fits: Mapping[tuple[str, ...], Fit], tested: Mapping[tuple[str, ...], ResidualStructure], worth: Mapping[tuple[str, ...], float]
) -> float:
    """Logarithm of the cap: the largest prior times likelihood that a hypothesis may have with a residual of any shape; else inf.

    Where a single listed effect leaves only noise, no explanation can be better. Then the data do not support something of any shape, alone
    or in addition to that effect. Several hypotheses above the cap share it.
    """
    clean = [
        worth[names] + fits[names].log_exact for names, residual in tested.items() if len(names) == 1 and residual.log_bayes_factor < 0.0
    ]
    most = max(clean, default=np.inf)
    above = sum(worth[names] + fits[names].log_exact + residual.log_bayes_factor > most for names, residual in tested.items())
    return most - log(max(1, above))


def known_and_unknown(one: Fit, residual: ResidualStructure, gap_energy: float, most: float) -> tuple[float, float]:
    """Logarithms of `known` and `unknown`, the likelihoods of a hypothesis without and with something unknown in addition.

    Either a model discrepancy suffices (a = 0.85 L*), or the listed laws leave a residual of any shape (b = 0.15 L exp B, capped). The
    share e of the gap's energy in the discrepancy or in the residual then says which of both it is: e is small for a discrepancy, and
    anything for something unknown. Formulas: docs/explanation/inference.md, "Something outside the list".

    Args:
        gap_energy: Energy of the gap in squared sigmas.
        most: Largest log likelihood log(L exp B) that a residual of any shape may have.
    """
    any_shape = log(ASSUMED.prior.unknown) + min(one.log_exact + residual.log_bayes_factor, most)
    if not one.names:
        return log(1.0 - ASSUMED.prior.unknown) + one.log_exact, any_shape
    sums = []
    for evidence, energy in (
        (log(1.0 - ASSUMED.prior.unknown) + one.log_likelihood, one.discrepancy_energy),
        (any_shape, residual.energy),
    ):
        share = min(energy / max(gap_energy, 1.0), 1.0)
        log_odds = (
            log(1.0 - ASSUMED.prior.unknown)
            - log(ASSUMED.prior.unknown)
            - share / ASSUMED.law_error.mean_energy
            - log(ASSUMED.law_error.mean_energy)
        )
        sums.append((evidence - float(np.logaddexp(0.0, -log_odds)), evidence - float(np.logaddexp(0.0, log_odds))))
    known, unknown = np.logaddexp(*np.array(sums))
    return float(known), float(unknown)


def _groups(hypotheses: list[Hypothesis]) -> dict[str, list[str]]:
    """For every effect of the best hypothesis the effects that could stand in its place, the most probable first."""
    best = hypotheses[0]
    out: dict[str, list[str]] = {}
    for name in best.fit.names:
        rest = set(best.fit.names) - {name}
        rivals: list[tuple[float, str]] = []
        for one in hypotheses[1:]:
            others = set(one.fit.names) - rest
            if rest <= set(one.fit.names) and len(others) == 1 and one.share > ASSUMED.naming.indistinguishable * best.share:
                rivals.append((one.share, others.pop()))
        out[name] = [other for _, other in sorted(rivals, reverse=True)]
    return out
