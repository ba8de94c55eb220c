"""What a diagnosis leaves open: hypotheses that remain, with the joint uncertainty of their parameters and in-tolerance deviations."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import log

import numpy as np

from palpd.cell.cell_file import EffectValues, Estimated, OpenHypothesis, OpenParameter
from palpd.gap.assumptions import ASSUMED
from palpd.gap.data.noise import FZ
from palpd.gap.decide import DiagnosisVerdict, NamedEffect
from palpd.gap.enriched import ZEROS, estimated_with
from palpd.gap.infer.evidence import Fit
from palpd.gap.infer.fit import jacobian_at
from palpd.gap.infer.inference import Inference
from palpd.gap.infer.intervals import by_named_parameters
from palpd.gap.laws.evidence import FitBeside
from palpd.gap.model.coordinates import Coordinate
from palpd.gap.model.problem import RELATIVE, SHARED, Problem, own_tolerances
from palpd.tick import Floats

WIDTH_95 = 2.0 * 1.96
"""Width of a 95 % interval of a normal distribution, in standard deviations."""

DECIMALS = 9
"""Decimals of a correlation in a file: where only the sum of two numbers is known, to a thousandth, six are needed."""


@dataclass(frozen=True)
class _Open:
    """Numbers that vary together: what they are, and their covariance (k, k) on their scales."""

    numbers: list[OpenParameter]
    covariance: Floats


def open_hypotheses(inference: Inference, verdict: DiagnosisVerdict) -> tuple[OpenHypothesis, ...]:
    """The hypotheses that remain, each with the joint uncertainty of its numbers.

    Args:
        verdict: Its effects of the scatter belong to every hypothesis.

    Returns:
        The answer first, then the hypotheses that could stand in its place, by falling probability. Their probabilities add up to 1.
    """
    problem, best = inference.problem, inference.attribution.best
    fits, shares = [verdict.answer], [max(best.share, 1e-6)]
    if verdict.law is None and verdict.fit.names:  # nothing outside the list was taken away, so the others explain the same residual
        for one in inference.attribution.hypotheses[1:]:
            if one.fit.names and one.share > ASSUMED.naming.least_open_share * best.share and _is_listed(one.fit):
                fits.append(FitBeside.nothing(by_named_parameters(problem, one.fit)))
                shares.append(one.share)
    scatter = [effect for effect in verdict.effects if problem.library[effect.id].scatter]
    return tuple(open_hypothesis(problem, one, share / sum(shares), scatter) for one, share in zip(fits, shares, strict=True))


def _is_listed(fit: Fit) -> bool:
    """Whether a file can name the effects of a hypothesis: an adopted law stands in a file as a whole."""
    return not any(name.startswith("learned.") for name in fit.names)


def open_hypothesis(problem: Problem, answer: FitBeside, share: float, scatter: Sequence[NamedEffect]) -> OpenHypothesis:
    """A hypothesis with the joint uncertainty of its numbers, as a cell file holds it.

    Args:
        share: Its probability.
        scatter: Effects of the scatter, which act in addition.
    """
    fit = answer.fit
    values: EffectValues = {**problem.cell.effects, **{name: fit.values[name] for name in fit.names if not name.startswith("learned.")}}
    values |= {one.id: {name: value for name, (value, _, _) in one.parameters.items()} for one in scatter}
    together, alone = _of_fit(problem, fit), _of_scatter(problem, scatter)
    n, m = len(together.numbers), len(alone.numbers)
    covariance = np.zeros((n + m, n + m))
    covariance[:n, :n], covariance[n:, n:] = together.covariance, alone.covariance
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    varies = sd > 0.0
    kept, sd = covariance[np.ix_(varies, varies)], sd[varies]
    correlation = np.clip(np.round(kept / np.outer(sd, sd), DECIMALS), -1.0, 1.0)
    numbers = [one for one, here in zip([*together.numbers, *alone.numbers], varies.tolist(), strict=True) if here]
    return OpenHypothesis(
        probability=min(share, 1.0),
        effects=values,
        estimated=Estimated.model_validate(estimated_with(problem, answer).model_dump()),
        open=tuple(one.model_copy(update={"sd": float(x)}) for one, x in zip(numbers, sd.tolist(), strict=True)),
        correlation=tuple(tuple(row) for row in correlation.tolist()),
    )


def _of_fit(problem: Problem, fit: Fit) -> _Open:
    """Parameters of effects and in-tolerance deviations together.

    The covariance of the parameters is that of their intervals. If the parameters move, the posterior mean ĉ of the deviations moves with
    them, as the residual says. In addition the deviations have their own posterior covariance, a part of (I + AᵀA)⁻¹.
    """
    space, where = fit.linearisation.space, fit.where
    names, units, pick = _deviations(problem, fit)
    ends = space.whitened(pick.T)
    covariance = ends.T @ ends
    free = [k for k, c in enumerate(where) if not (c.fixed or c.effect.startswith("learned."))]
    if free:
        at = problem.predict(fit.values, fit.eta)
        slopes = jacobian_at(problem, where, fit.u, fit.eta, at)
        follow = -np.array([pick @ space.coefficients(slopes[k]) for k in free]).T
        each = [law.probability * (law.covariance() + np.outer(law.move, law.move)) for law in fit.laws]
        of_u = np.sum(each, axis=0)[np.ix_(free, free)]
        covariance = np.block([[of_u, of_u @ follow.T], [follow @ of_u, covariance + follow @ of_u @ follow.T]])
    numbers = [_parameter(where[k]) for k in free]
    factors = np.concatenate([[1.0 if where[k].parameter.log else where[k].scale for k in free], units])
    numbers += [OpenParameter(name=f"estimated.{name}", scale="log1p" if name in RELATIVE else "linear", sd=0.0) for name in names]
    return _Open(numbers, covariance * np.outer(factors, factors))


def _deviations(problem: Problem, fit: Fit) -> tuple[list[str], list[float], Floats]:
    """Names of the n in-tolerance deviations that are open, their units, and the matrix (n, m) that gives them from m coefficients.

    A deviation for which an effect stands is not among them.
    """
    around, keys = fit.linearisation, {problem.library[name].tolerance for name in fit.names}
    names, units, rows = [], [], []
    owned = own_tolerances(problem.library[name] for name in fit.names)
    for k, name in enumerate(SHARED):
        if problem.shared_sd[k] > 0.0 and not owned[k]:
            names.append(name)
            units.append(float(problem.shared_sd[k]))
            rows.append(np.eye(1, around.space.size, k)[0])
    for name in ZEROS:
        numbers = around.numbers("recording", name, FZ)
        if numbers and name not in keys:
            names.append(name)
            units.append(float(getattr(problem.cell.tolerances, name)))
            rows.append(np.isin(np.arange(around.space.size), numbers) / len(numbers))
    return names, units, np.array(rows).reshape(len(names), around.space.size)


def _parameter(c: Coordinate) -> OpenParameter:
    """A parameter of an effect, without its standard deviation."""
    name = f"{c.effect}.{c.parameter.name}"
    if c.angle:
        return OpenParameter(name=name, scale="angle", sd=0.0)
    ends = {side: end for side, end in (("lower", c.lower), ("upper", c.upper)) if np.isfinite(end)}
    return OpenParameter(name=name, scale="log" if c.parameter.log else "linear", sd=0.0, **ends)


def _of_scatter(problem: Problem, scatter: Sequence[NamedEffect]) -> _Open:
    """Parameters of effects of the scatter: independent of each other, with the widths of their intervals."""
    numbers, variances = [], []
    for effect in scatter:
        for name, (value, low, high) in effect.parameters.items():
            parameter = problem.library[effect.id].parameter(name)
            in_log = parameter.log and low > 0.0 and value > 0.0
            lower, upper = parameter.bounds(problem.scale)
            numbers.append(OpenParameter(name=f"{effect.id}.{name}", scale="log" if in_log else "linear", sd=0.0, lower=lower, upper=upper))
            variances.append(((log(high / low) if in_log else high - low) / WIDTH_95) ** 2)
    return _Open(numbers, np.diag(variances) if variances else np.zeros((0, 0)))
