"""A law as a learned effect: what a cell file holds of it, and what out.json says of it."""

from math import exp, log
from typing import Any

import numpy as np

from palpd.cell.effects.drivers import FAMILIES, UNITS
from palpd.cell.effects.learned import LearnedEffect, Term
from palpd.gap.assumptions import ASSUMED
from palpd.gap.data.noise import CHANNELS
from palpd.gap.gaussian.nuisance_space import NuisanceSpace, whitened
from palpd.gap.laws.formulas import Formula
from palpd.gap.laws.scene import LATERAL, LawCandidate
from palpd.gap.laws.search import LearnedLaw
from palpd.tick import Floats

SHOWN_POINTS = 40
"""Number of points in which the data behind a curve are shown."""


def p_outside(nats: float) -> float:
    """Probability of something outside the list by its evidence beyond the listed answer."""
    return min(ASSUMED.laws.most_certain, 1.0 / (1.0 + exp(-min(nats + log(ASSUMED.prior.unknown / (1.0 - ASSUMED.prior.unknown)), 50.0))))


def learned_effect(law: LearnedLaw, nats: float, confounds: dict[str, float] | None = None) -> LearnedEffect:
    """A law as an effect that a cell file can hold.

    Args:
        nats: Evidence of the law beyond the listed answer.
        confounds: Listed effects that imitate it, with the cosine of each; None where that was not asked.
    """
    terms = tuple(_term(law, number) for number in range(len(law.terms)))
    first = law.terms[0].candidate
    problem = law.scene.problem
    return LearnedEffect(
        id=free_name(
            f"learned.{first.factor}_{first.driver.memory or 'of'}_{first.driver.quantity}",
            {*problem.library, *(one.id for one in problem.cell.learned)},
        ),
        what="; ".join(term.words for term in terms),
        site="robot" if first.channel == "z_m" else "probe",
        rest_speed_m_per_s=law.scene.rest_speed_m_per_s,
        terms=terms,
        alike=tuple(_alike(law)),
        probability=p_outside(nats),
        confounds=confounds,
    )


def law_to_json(law: LearnedLaw, learned: LearnedEffect, replaces: bool) -> dict[str, Any]:
    """The key `learned` of out.json.

    Args:
        replaces: Whether the law replaces the listed effects.
    """
    terms = [_term_to_json(law, learned.terms[number], number) for number in range(len(learned.terms))]
    family = FAMILIES.get(learned.terms[0].driver.quantity)
    whole = {"id": learned.id, "what": learned.what, "site": learned.site, "family": family}
    rest = {"probability": learned.probability, "alike": list(learned.alike), "replaces_listed": replaces, "file": None}
    names = [_name(candidate) for candidate in _alike(law).values()]
    return whole | terms[0] | rest | {"alike_laws": names, "confounds": learned.confounds or {}, "further_terms": terms[1:]}


def _term_to_json(law: LearnedLaw, term: Term, number: int) -> dict[str, Any]:
    fitted = law.terms[number]
    values, sd = np.array(term.values), np.array(term.sd)
    low, high = values - 1.96 * sd, values + 1.96 * sd
    band = {"x": list(term.knots), "value": values.tolist(), "low": low.tolist(), "high": high.tolist()}
    return {
        "channels": term.channels,
        "factor": term.factor,
        "driver": term.driver.words,
        "driver_unit": UNITS[term.driver.quantity],
        "formula": term.formula,
        "curve": band,
        "range": list(term.range),
        "held_out_nats": [round(gain, 1) for gain in fitted.held_out.gains.tolist()],
        "nats": round(fitted.nats, 1),
        "data": _data(law, number),
    }


def _data(law: LearnedLaw, number: int) -> dict[str, list[float]]:
    """Means of the data behind a curve over its driver, in the unit of the curve: without the term, and with it."""
    candidate = law.terms[number].candidate
    problem, change = law.scene.problem, np.zeros_like(law.change)
    mean, _ = law.coefficients(number)
    for channel, values in law.terms[number].columns.items():
        change[channel] = values @ mean
    after = NuisanceSpace(law.space.columns, law.space.residual - law.change).remainder
    factor = law.scene.factor(candidate.channel, candidate.factor)[:, None]
    weights = candidate.weights(problem.cell.probe.tip_length_m)
    unit = whitened(problem.noise, {CHANNELS.index(name): weight * factor for name, weight in weights.items()})
    x = law.scene.driver(candidate.channel, candidate.driver)
    if candidate.driver.period is not None:
        x = np.mod(x, candidate.driver.period)
    live = np.sum([values[:, 0] ** 2 for values in unit.values()], axis=0)
    order = np.flatnonzero(live > 1e-6 * live.max())
    order = order[np.argsort(x[order])]
    # Equal stretches of the driver, so that a curve is seen along its whole range.
    edges = np.searchsorted(x[order], np.linspace(x[order[0]], x[order[-1]], SHOWN_POINTS + 1)[1:-1])
    stretches = [part for part in np.split(order, edges) if len(part)]
    points = [part for part in stretches if len(part) > 2] or stretches  # a short press has few bins

    def means(of: Floats) -> list[float]:
        return [float(sum(v[p, 0] @ of[c, p] for c, v in unit.items()) / live[p].sum()) for p in points]

    spread = [float(live[p].sum() ** -0.5) for p in points]
    at = [float(np.average(x[p], weights=live[p])) for p in points]
    return {"x": at, "before": means(after + change), "after": means(after), "sd": spread}


def free_name(name: str, taken: set[str]) -> str:
    """The name, with a number behind it where it is taken."""
    return next(one for one in (name, *(f"{name}_{k}" for k in range(2, len(taken) + 3))) if one not in taken)


def _alike(law: LearnedLaw) -> dict[str, LawCandidate]:
    """The laws that fit as well as the first term, by their words: the likeliest of those with the same words."""
    alike: dict[str, LawCandidate] = {}
    for one in law.terms[0].alike:
        alike.setdefault(_words(one.candidate), one.candidate)
    alike.pop(_words(law.terms[0].candidate), None)
    return alike


def _name(candidate: LawCandidate) -> dict[str, str | float | None]:
    """Channel, factor and driver of a candidate for programs."""
    driver = candidate.driver.model_dump(include={"quantity", "memory", "constant", "period"})
    return {"channel": candidate.channel, "factor": candidate.factor} | driver


def _words(candidate: LawCandidate) -> str:
    """Factor and driver in words, which distinguish candidates for a reader."""
    side = (
        " to the side" if candidate.channel == LATERAL else f" on {candidate.channel.split('_')[0]}" if candidate.channel != "fz_N" else ""
    )
    factor = "" if candidate.factor == "one" else f"{candidate.factor.replace('_', ' × ')} × "
    return f"{factor}curve of {candidate.driver.words}{side}"


def _term(law: LearnedLaw, number: int) -> Term:
    candidate = law.terms[number].candidate
    mean, _ = law.coefficients(number)
    x = candidate.basis.shown_at()
    columns = candidate.basis.columns(x)
    weights = candidate.weights(law.scene.problem.cell.probe.tip_length_m)
    basis = candidate.basis
    free, covariance = law.uncertain(number)
    sd = _spread(free.basis.columns(x) - (_usual(law, free) if free.factor == "one" else 0.0), covariance)
    return Term(
        channels={name: round(weight, 9) for name, weight in weights.items()},
        factor=candidate.factor,
        driver=candidate.driver,
        knots=_rounded(x),
        values=_rounded(columns @ mean),
        sd=_rounded(sd),
        range=(float(f"{basis.low:.9g}"), float(f"{basis.high:.9g}")),
        formula=basis.text(mean) if isinstance(basis, Formula) else None,
    )


def _usual(law: LearnedLaw, candidate: LawCandidate) -> Floats:
    """Mean of the columns (m,) over the recording: a constant force is the sensor's bias, and no part of a band."""
    return np.asarray(candidate.basis.columns(law.scene.driver(candidate.channel, candidate.driver)).mean(axis=0))


def _spread(columns: Floats, covariance: Floats) -> Floats:
    """Standard deviation (k,) of a curve at k points, from its columns (k, m) there and the covariance (m, m) of w."""
    return np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", columns, covariance, columns), 0.0))


def _rounded(values: Floats) -> tuple[float, ...]:
    """Numbers that a person can read: seven digits, and zero where they are below 1e-9 of the largest."""
    values = np.where(np.abs(values) < 1e-9 * np.abs(values).max(), 0.0, values)
    return tuple(float(f"{value:.7g}") for value in values.tolist())
