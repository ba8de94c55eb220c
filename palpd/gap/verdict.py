"""Stage 5 of a diagnosis: from probabilities to a verdict, and the named effects with their intervals."""

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from palpd.cell.cell_file import CellFile, EffectValues, Estimated
from palpd.gap.data.noise import FZ
from palpd.gap.data.scatter import Scatter
from palpd.gap.infer.evidence import Fit, fit
from palpd.gap.infer.intervals import interval
from palpd.gap.infer.posterior import Attribution
from palpd.gap.laws.finding import LawFinding
from palpd.gap.model.coordinates import Coordinate
from palpd.gap.model.linearise import linearise
from palpd.gap.model.problem import Problem, tolerance_key
from palpd.quantities import quantity
from palpd.tick import Floats

P_NONE_TO_ACQUIT = 0.25
"""Probability of no gap above which no effect is named: a false accusation costs more than a missed effect."""

P_TO_NAME = 0.5
"""Probability from which on an effect, together with those that could stand in its place, or something unknown is named."""

P_TO_NAME_WEAK, WEAK_SIGMAS = 0.8, 8.0
"""The same for an effect below that size in a set with a larger effect: a false second name then costs more than a missed effect."""

FAR_OUT_SD = 4.0
"""Standard deviations beyond which a deviation is reported: one in 16 000 healthy cells has such a deviation."""

ZEROS = ("bias_N", "drift_N_per_min")
"""Deviations that each recording has for itself; a cell file holds their mean over the recordings."""

LARGEST_GROUP = 2
"""Number of indistinguishable effects above which the verdict is ambiguous."""

Kind = Literal["effects", "none", "unknown", "ambiguous"]


@dataclass(frozen=True)
class NamedEffect:
    """An effect that the diagnosis names: parameters as (value, low, high), and the effects from which it cannot be distinguished.

    Attributes:
        family: As `Effect.family`: a noun for all laws that look the same; None where there is no such noun.
        at_bound: Parameters at the end of their range, whose value is a bound.
    """

    id: str
    probability: float
    parameters: dict[str, tuple[float, float, float]]
    indistinguishable_from: list[str]
    family: str | None
    at_bound: list[str]

    def to_json(self) -> dict[str, Any]:
        """An entry of `effects` of out.json."""
        return vars(self) | {"parameters": {n: {"value": v, "ci95": [low, high]} for n, (v, low, high) in self.parameters.items()}}


@dataclass(frozen=True)
class DiagnosisVerdict:
    """What the recordings say.

    Attributes:
        effects: The named effects, the most probable first, those of the scatter last; each is probable alone or with its group.
        candidates: Probability of every effect by id.
        p_none: Probability that there is no gap.
        p_unknown: Probability that something outside the list is at work.
        fit: The best hypothesis if effects are named, also with members that are not named; else that without effects.
    """

    kind: Kind
    effects: list[NamedEffect]
    candidates: dict[str, float]
    p_none: float
    p_unknown: float
    fit: Fit


def decide(problem: Problem, nominal: Fit, attribution: Attribution, scatter: Scatter) -> DiagnosisVerdict:
    """Decide which effects to name.

    Args:
        nominal: The hypothesis without effects.
        attribution: The posterior over hypotheses.
    """
    p_unknown = 1.0 - (1.0 - attribution.p_unknown) * (1.0 - scatter.p_lone_axis)
    p_healthy_scatter = float(np.prod([1.0 - s.probability for s in scatter.effects]))
    p_none = attribution.p_none * (1.0 - scatter.p_lone_axis) * p_healthy_scatter
    best = by_named_parameters(problem, attribution.best.fit)
    named: list[NamedEffect] = []
    if best.names and p_none <= P_NONE_TO_ACQUIT:
        named = _named(problem, best, attribution)
    fit = best if named else nominal  # an improbable member is not named, but the set explains how far the gap closes
    named += [NamedEffect(s.id, s.probability, s.parameters, [], None, []) for s in scatter.effects if s.probability > P_TO_NAME]
    kind = _kind(p_none, p_unknown, named)
    candidates = attribution.marginal | {s.id: s.probability for s in scatter.effects}
    return DiagnosisVerdict(kind, [] if kind == "none" else named, candidates, p_none, p_unknown, fit)


def by_named_parameters(problem: Problem, one: Fit) -> Fit:
    """The hypothesis with the parameters that files can state, fitted again if it has others.

    A parameter without a name in files chooses among several forms of an effect's law, and counts as a nuisance.
    """
    values = {
        name: {parameter.name: mine[parameter.name] for parameter in problem.library[name].named_parameters if parameter.name in mine}
        for name, mine in one.values.items()
    }
    return one if values == one.values else fit(problem, values, linearise(problem, values, one.eta), rounds=1)


def with_finding(verdict: DiagnosisVerdict, finding: LawFinding) -> DiagnosisVerdict:
    """The verdict with a law or events that no listed effect explains.

    Returns:
        The same verdict if there are none; else `unknown`, with a larger p_unknown and a smaller p_none. Probabilities of effects stay.
    """
    if finding.p_outside == 0.0:
        return verdict
    p_unknown = 1.0 - (1.0 - verdict.p_unknown) * (1.0 - finding.p_outside)
    return replace(verdict, kind="unknown", p_unknown=p_unknown, p_none=verdict.p_none * (1.0 - finding.p_outside))


def _kind(p_none: float, p_unknown: float, named: list[NamedEffect]) -> Kind:
    if p_none > P_NONE_TO_ACQUIT:
        return "none"
    if p_unknown > P_TO_NAME or not named:
        return "unknown" if p_unknown > p_none else "none"
    if any(len(e.indistinguishable_from) > LARGEST_GROUP for e in named):
        return "ambiguous"
    return "effects"


def _named(problem: Problem, best: Fit, attribution: Attribution) -> list[NamedEffect]:
    """The effects of a hypothesis that are probable, with 95 % intervals of their parameters, the most probable first."""
    out = []
    groups = _probable_groups(best, attribution)
    for name in groups:
        parameters, bound = {}, []
        for k, c in enumerate(best.where):
            if c.effect != name:
                continue
            value = best.values[name][c.parameter.name]
            if not (c.angle or c.fixed) and _at_bound(c, value):
                bound.append(c.parameter.name)
            parameters[c.parameter.name] = (value, *interval(problem, best, k))
        out.append(NamedEffect(name, attribution.marginal[name], parameters, groups[name], problem.library[name].family, bound))
    return sorted(out, key=lambda e: (-e.probability, e.id))


def _at_bound(c: Coordinate, value: float) -> bool:
    """Whether a value is at the end of its range, other than zero, or beyond its natural size."""
    margin = 1e-9 * max(abs(c.lower), abs(c.upper))
    if (value <= c.lower + margin and c.lower != 0) or value >= c.upper - margin:
        return True
    return c.parameter.natural is not None and abs(value) >= c.parameter.natural


def _probable_groups(best: Fit, attribution: Attribution) -> dict[str, list[str]]:
    """The effects of a hypothesis that are probable together with their groups, and the group of each: what could stand in its place.

    If no effect is, the likeliest effect is returned with the next likeliest effects as its group, until they are probable together.
    """
    marginal = attribution.marginal
    groups = {name: attribution.groups[name] for name in best.names}
    largest = max(best.names, key=lambda name: best.sizes[name])
    needed = {name: P_TO_NAME_WEAK if best.sizes[name] < WEAK_SIGMAS and name != largest else P_TO_NAME for name in best.names}
    probable = {name: others for name, others in groups.items() if sum(marginal.get(one, 0.0) for one in (name, *others)) >= needed[name]}
    if probable:
        return probable
    first = max(best.names, key=lambda name: marginal[name])
    others = list(groups[first])
    for name in sorted(marginal, key=lambda name: -marginal[name]):
        if marginal[first] + sum(marginal.get(one, 0.0) for one in others) >= P_TO_NAME:
            break
        if name not in (first, *others):
            others.append(name)
    return {first: others}


def unnatural_notes(problem: Problem, verdict: DiagnosisVerdict) -> list[str]:
    """A sentence for every parameter of a named effect that is larger than working parts have (`Parameter.natural`)."""
    return [
        f"{effect.id} has {parameter.name} {quantity(effect.parameters[parameter.name][0], parameter.unit)}, expected at most "
        f"{quantity(parameter.natural, parameter.unit)} of parts that work; check the times in the recording, and whether rows are missing."
        for effect in verdict.effects
        for parameter in problem.library[effect.id].parameters
        if parameter.natural is not None and abs(effect.parameters[parameter.name][0]) >= parameter.natural
    ]


def deviation_notes(problem: Problem, fit: Fit) -> list[str]:
    """A sentence for every deviation that the answer leaves far out of tolerance.

    Args:
        fit: The hypothesis that is the answer, with what is outside the list taken from its residual.
    """
    around = fit.linearisation
    deviation_sd = around.space.coefficients(fit.residual)
    notes = []
    for k, label in enumerate(around.labels):
        judged = label.scope == "cell" or (label.scope == "recording" and label.channel == FZ and label.name != "rounding")
        unknown = label.name == "youngs_modulus" and not problem.cell.tolerances.modulus_known
        if judged and not unknown and abs(deviation_sd[k]) > FAR_OUT_SD:
            key = tolerance_key(label.name)
            notes.append(
                f"{label.name} is {deviation_sd[k]:+.1f} standard deviations off, expected at most {FAR_OUT_SD:g}; "
                f"check tolerances.{key} ({getattr(problem.cell.tolerances, key):.3g}) and the cell itself."
            )
    return notes


def enriched_cell(problem: Problem, verdict: DiagnosisVerdict) -> CellFile:
    """The cell with the named effects and the in-tolerance deviations that were fitted with them."""
    named: EffectValues = {e.id: {n: v for n, (v, _, _) in e.parameters.items()} for e in verdict.effects}
    effects = verdict.fit.values | named if named else named
    cell = problem.cell.with_effects(problem.cell.effects | effects)
    return cell.with_estimated(estimated_with(problem, verdict.fit))


def estimated_with(problem: Problem, fit: Fit) -> Estimated:
    """The in-tolerance deviations that were fitted with a hypothesis, as the block `estimated` of a cell file.

    Bias and drift, which each recording has for itself, enter by their mean.
    """
    coefficients = fit.linearisation.space.coefficients(fit.residual)
    zeros = {name: _mean_zero(problem, fit, coefficients, name) for name in ZEROS}
    return problem.estimated(coefficients[: len(fit.eta)]).model_copy(update=zeros)


def _mean_zero(problem: Problem, fit: Fit, coefficients: Floats, name: str) -> float:
    """Mean over the recordings of the bias or drift of fz, in the unit of the cell file."""
    tolerance = getattr(problem.cell.tolerances, name)
    values = [coefficients[k] * tolerance for k in fit.linearisation.numbers("recording", name, FZ)]
    return float(np.mean(values)) if values else 0.0
