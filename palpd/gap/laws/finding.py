"""What the search for laws adds to an answer from the list: a learned effect, events, or nothing."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import comb, exp, log
from typing import Any, Literal

import numpy as np

from palpd.cell.effects.drivers import FAMILIES, UNITS
from palpd.cell.effects.learned import LearnedEffect, Term
from palpd.gap.data.noise import CHANNELS
from palpd.gap.gaussian.nuisance_space import NuisanceSpace, whitened
from palpd.gap.gaussian.nuisances import Columns, project
from palpd.gap.infer.discrepancy import discrepancy_columns
from palpd.gap.infer.evidence import Fit, fit
from palpd.gap.infer.fit import jacobian_at
from palpd.gap.infer.posterior import P_NONE, P_ONE, P_THREE, P_TWO, P_UNKNOWN
from palpd.gap.laws.events import Event, find_events, wander_nats
from palpd.gap.laws.formulas import Formula
from palpd.gap.laws.scene import LATERAL, LawCandidate, Scene, rounding_columns
from palpd.gap.laws.search import ALIKE_NATS, NAMED_NATS, LearnedLaw, search
from palpd.gap.model.problem import Problem, return_memory
from palpd.tick import Floats

DISCREPANCY_SIZE = 0.06
"""Share of a listed effect by which its real law may differ in each direction of D while a law is sought in its residual."""

PARAMETER_REACH = 0.5
"""Share of a listed effect by which its parameters may change it while a law is sought in its residual."""

LEAST_SHARE_BESIDE = 0.2
"""Least share of the gap's energy of something that acts in addition to a listed effect: less is an error of that effect's law."""

ALTERNATIONS = 3
"""Number of times that listed parameters and the added law are fitted in turn, before the law is sought again."""

MANY_PARTS = 2
"""Number of listed effects from which on a law alone is tried even if they leave nothing: together they can imitate almost any shape."""

MOST_CERTAIN = 0.97
"""Largest probability of a law: 38 of 38 accepted laws were right, which supports (38 + 1) / (38 + 2)."""

SHOWN_POINTS = 40
"""Number of points in which the data behind a curve are shown."""


ONE_CYCLE = 0.6
"""Share of a law's change, beyond tolerances, from which on one press or stroke alone shows it."""


@dataclass(frozen=True)
class RefusedLaw:
    """A law that the recordings support and that is not named.

    Attributes:
        reason: It changes in time, or a single press or stroke alone shows it.
        recording: Number of the recording with that press, from 0 on.
        cycle: Number of the cycle of that press there, from 0 on.
    """

    law: LearnedLaw
    reason: Literal["time", "one cycle"]
    recording: int = 0
    cycle: int = 0


@dataclass(frozen=True)
class LawFinding:
    """What the search for laws found.

    Attributes:
        learned: The law as an effect for the library; None where no law was accepted.
        law: The same law with its evidence; None where `learned` is.
        beside: Fit of the listed effects to which law or events are added; of the cell without effects where these stand alone.
        replaces: Whether law or events replace the listed effects, which only imitated them.
        events: Events, which are no law.
        note: A sentence for the reader; None where nothing needs to be said.
        nats: Evidence of the law or of the events beyond the listed answer.
        secondary: Whether listed effects stand as the cause, and the law says what they leave: an error of their own laws, or something
            in addition. The verdict is then theirs.
        refused: A law that another recording may show; None where no law was refused.
    """

    learned: LearnedEffect | None
    law: LearnedLaw | None
    beside: Fit
    replaces: bool
    events: list[Event]
    note: str | None
    nats: float
    secondary: bool = False
    refused: RefusedLaw | None = None

    def beside_named(self, leading_leaves: float) -> "LawFinding":
        """The finding where the list names causes that leave little: does it describe the rest, replace them, or become a note?

        An added law describes what the named effects leave, and takes nothing from them. A law that would replace a cause becomes a note: a
        real cause never follows its listed formula exactly. But where none of several listed effects explains most of the gap, a law of a
        single term that is likelier than all of them replaces them: they imitated it.

        Args:
            leading_leaves: Share of what the named effects explain together that the best of them alone leaves; 0 for a single effect.
        """
        if self.events:  # the named cause only imitated them, or they stand out of its residual
            return self if self.replaces else _nothing(self.beside, _EVENTS_BESIDE)
        if not self.replaces or self.learned is None:
            return replace(self, secondary=True)
        if len(self.learned.terms) == 1 and leading_leaves >= LEAST_SHARE_BESIDE:
            return self
        note = f"A law outside the list explains this recording as well: {self.learned.what}. Another motion decides."
        return _nothing(self.beside, note)

    def beside_law(self, listed: Fit) -> Fit:
        """The fit to which the law is added, with the law taken from its residual; the listed answer itself where there is no law."""
        if self.learned is None or self.law is None:
            return listed
        return replace(self.beside, residual=self.beside.residual - self.law.change)

    @property
    def p_outside(self) -> float:
        """Probability that something outside the list is at work, as far as this search says."""
        if self.secondary or (self.learned is None and not self.events):
            return 0.0
        return _probability(self.nats)

    def to_json(self) -> dict[str, Any] | None:
        """The key `learned` of out.json; None where there is no law."""
        if self.learned is None or self.law is None:
            return None
        terms = [self._term(number) for number in range(len(self.learned.terms))]
        family = FAMILIES.get(self.learned.terms[0].driver.quantity)
        whole = {"id": self.learned.id, "what": self.learned.what, "site": self.learned.site, "family": family}
        rest = {"probability": self.learned.probability, "alike": list(self.learned.alike), "replaces_listed": self.replaces, "file": None}
        names = [_name(candidate) for candidate in _alike(self.law).values()]
        return whole | terms[0] | rest | {"alike_laws": names, "confounds": self.learned.confounds or {}, "further_terms": terms[1:]}

    def _term(self, number: int) -> dict[str, Any]:
        assert self.learned is not None
        assert self.law is not None
        term, fitted = self.learned.terms[number], self.law.terms[number]
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
            "data": self._data(number),
        }

    def _data(self, number: int) -> dict[str, list[float]]:
        """Means of the data behind a curve over its driver, in the unit of the curve: without the term, and with it."""
        assert self.law is not None
        law, candidate = self.law, self.law.terms[number].candidate
        problem, change = law.scene.problem, np.zeros_like(self.law.change)
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


def _probability(nats: float) -> float:
    """Probability of something outside the list by its evidence beyond the listed answer."""
    return min(MOST_CERTAIN, 1.0 / (1.0 + exp(-min(nats + log(P_UNKNOWN / (1.0 - P_UNKNOWN)), 50.0))))


def _nothing(beside: Fit, note: str | None = None, refused: RefusedLaw | None = None) -> LawFinding:
    """An empty finding for a fit, with the reason."""
    return LawFinding(None, None, beside, False, [], note, 0.0, refused=refused)


def leading_leaves(fits: Mapping[tuple[str, ...], Fit], listed: Fit) -> float:
    """How much of what listed effects explain together the best of them alone leaves.

    Args:
        fits: The fitted hypotheses by their effects; the empty set is among them.

    Returns:
        A share of the misfit that they take away together; 0 for a single effect, and where none of them was fitted alone.
    """
    if len(listed.names) < MANY_PARTS:
        return 0.0
    nominal = fits[()].misfit
    alone = [nominal - fits[(name,)].misfit for name in listed.names if (name,) in fits]
    return 1.0 - max(alone) / max(nominal - listed.misfit, 1e-300) if alone else 0.0


def _of_one_cycle(law: LearnedLaw) -> RefusedLaw | None:
    """The refusal of a law that is likely enough but that a single press or stroke alone shows; None for any other law."""
    if not law.likely:
        return None
    seen = (NuisanceSpace(law.space.columns, law.change).remainder ** 2).sum(axis=0)
    first, best = 0, (0.0, 0, 0)
    for number, one in enumerate(law.scene.problem.recordings):
        energy = np.bincount(one.bin_cycle, seen[first : first + len(one.bin_cycle)])
        first += len(one.bin_cycle)
        best = max(best, (float(energy.max()), number, int(np.argmax(energy))))
    return RefusedLaw(law, "one cycle", best[1], best[2]) if best[0] >= ONE_CYCLE * float(seen.sum()) else None


def find(problem: Problem, nominal: Fit, listed: Fit, *, coarse: bool = False) -> LawFinding:
    """Search for a law and for events beyond the listed answer, and decide.

    If a single listed effect leaves no law and no events, it stands. Otherwise a law is also sought in the gap of the cell without effects.
    If that law beats the listed effects, and these with an added law, then they only imitated it, and it replaces them. Of two explanations
    that are alike the one with fewer parts counts. In all other cases the law is added to the listed effects.

    Args:
        nominal: The fit without effects.
        listed: The fit of the listed answer; the same as `nominal` where nothing is named.
        coarse: Whether readings are rounded far more coarsely than stated. They then follow the force in steps, and any law fits the steps:
            no law is sought.
    """
    if coarse:
        return _nothing(listed)
    scene, space = Scene.of(problem, listed.values, listed.eta), _space_beside(problem, listed)
    gained = listed.log_evidence - nominal.log_evidence + _log_prior(problem, listed)
    top = search(scene, space, gained)
    return_memory()
    events = find_events(scene, space)
    eventful = events.nats >= max(NAMED_NATS, (top.nats if top.carries else 0.0) - ALIKE_NATS) and _matters(listed, events.change)
    leaves_nothing = not eventful and not top.carries
    if leaves_nothing and len(listed.names) < MANY_PARTS:
        return _nothing(listed, refused=_of_one_cycle(top))
    law, judged_in, beside, replaces, imitated = top, space, listed, False, False
    if listed.names:
        alone_space, alone_scene = _space_beside(problem, nominal), Scene.of(problem, {}, nominal.eta)
        alone = search(alone_scene, alone_space)
        rival = gained + max(NAMED_NATS, (top.nats if top.carries else 0.0) - ALIKE_NATS)
        if eventful:  # where events alone explain more than the listed effects, these imitated a part of them
            alone_events = find_events(alone_scene, alone_space)
            rival = max(rival, gained + events.nats - ALIKE_NATS, alone_events.nats - ALIKE_NATS)
            # In one or two presses nothing repeats: what happens at every press looks like an event.
            repeats = sum(one.phases.presses for one in problem.recordings) not in (1, 2)
            imitated = repeats and alone_events.nats > gained
            events = alone_events if imitated else events
        # A smooth curve of time is no answer where events explain the gap.
        replaces = alone.carries and alone.nats >= rival and not (eventful and _plain_time(alone.terms[0].candidate))
        if replaces:
            law, judged_in, beside = alone, alone_space, nominal
        elif leaves_nothing:
            return _nothing(listed, refused=_of_one_cycle(top))
        elif not eventful:
            law, judged_in, beside = _fitted_together(problem, listed, top, gained)
    if eventful and not replaces:
        return LawFinding(None, None, listed, imitated, events.listed, _EVENTS, max(events.nats - gained, NAMED_NATS))
    wanders = wander_nats(law.scene, judged_in)
    if _plain_time(law.terms[0].candidate) or wanders > law.nats - ALIKE_NATS:
        return _nothing(listed, _IN_TIME, RefusedLaw(law, "time"))
    secondary = not replaces and bool(listed.names)
    nats = law.nats - gained if replaces else top.nats
    return LawFinding(learned_effect(law, nats), law, beside, replaces, [], _time_note(law), nats, secondary)


def _fitted_together(problem: Problem, listed: Fit, top: LearnedLaw, gained: float) -> tuple[LearnedLaw, NuisanceSpace, Fit]:
    """A law in addition to listed effects, the nuisances with which it was found, and the fit of these effects.

    Without the law, the listed parameters imitate a part of it. So both are fitted in turn, and the law is sought again.
    In the end the law is what the listed effects leave with these parameters, and not what they could leave.
    """
    law = replace(top, space=_within_specification(problem, listed))
    # A second term may be the error of the listed parameters, so the first term alone stays while these move.
    moved = replace(law, terms=top.terms[:1])
    beside = listed
    for _ in range(ALTERNATIONS):
        again = fit(problem.without(moved.change), beside.values, beside.linearisation, iterations=3, rounds=1)
        beside = replace(again, residual=again.residual + moved.change)
        moved = replace(moved, space=_within_specification(problem, beside))
    space = _space_beside(problem, beside)
    second = search(Scene.of(problem, beside.values, beside.eta), space, gained)
    if not second.carries or second.terms[0].nats < top.terms[0].nats:
        return law, _space_beside(problem, listed), listed
    return replace(second, space=_within_specification(problem, beside)), space, beside


_EVENTS = (
    "What remains looks like single events (see `events`), and not like a law. Another recording will not show them at the same times."
)
_EVENTS_BESIDE = "What the named effects leave looks like single events in time: steps, pulses or falls of the contact force."
_IN_TIME = (
    "Something changes smoothly or randomly in time, and not by what the cell does. One recording cannot distinguish a slow state from a "
    "random walk. Record the same motion again: a law repeats, a random walk does not."
)


def _time_note(law: LearnedLaw) -> str | None:
    driver = law.terms[0].candidate.driver
    if driver.quantity in ("time", "presses", "deepest") and driver.period is None:
        return (
            "The law follows the course of this recording (time, number of presses or deepest press). One recording cannot distinguish "
            "these, so the law may not hold in another one. Record a second one in another order."
        )
    return None


def _plain_time(candidate: LawCandidate) -> bool:
    """Whether a candidate adds a smooth curve of time, which may be a random walk."""
    driver = candidate.driver
    return driver.quantity == "time" and driver.period is None and candidate.factor in ("one", "air")


def _matters(listed: Fit, change: Floats) -> bool:
    """Whether a change in addition to listed effects holds enough of the gap's energy to be no error of their laws."""
    if not listed.names:
        return True
    own, whole = (project(one, listed.linearisation.space) for one in (change, change + listed.change))
    return own.dot(own) >= LEAST_SHARE_BESIDE * whole.dot(whole)


def _log_prior(problem: Problem, listed: Fit) -> float:
    """Log prior odds of a set of listed effects against the empty set."""
    count, effects = len(listed.names), sum(not effect.scatter for effect in problem.library.values())
    return log((P_NONE, P_ONE, P_TWO, P_THREE)[count] / P_NONE) - log(comb(effects, count))


def _within_specification(problem: Problem, listed: Fit) -> NuisanceSpace:
    """Residual of a fit, with its nuisances A and those of rounding."""
    space = NuisanceSpace(listed.linearisation.space.columns, listed.residual)
    rounding = rounding_columns(problem, problem.noise.natural(problem.data - listed.remainder))
    return space.with_columns(rounding) if rounding else space


def _space_beside(problem: Problem, listed: Fit) -> NuisanceSpace:
    """The same, where the reach of the listed parameters and the discrepancy DISCREPANCY_SIZE × D of the listed laws are nuisances, too."""
    space, around = _within_specification(problem, listed), listed.linearisation
    if not listed.names:
        return space
    prediction = problem.predict(listed.values, around.eta)
    reach = PARAMETER_REACH * float(np.linalg.norm(listed.change))
    jacobian = jacobian_at(problem, listed.where, listed.u, around.eta, prediction)
    moves = [j * (reach / max(float(np.linalg.norm(j)), 1e-300)) for j in jacobian]
    parameters = Columns.of([dict(enumerate(one)) for one in moves], space.columns.shape)
    discrepancies, _ = discrepancy_columns(problem, listed.values, prediction, around)
    return NuisanceSpace(space.columns.beside(parameters).beside(discrepancies.scaled(DISCREPANCY_SIZE)), listed.residual)


def learned_effect(law: LearnedLaw, nats: float) -> LearnedEffect:
    """A law as an effect that a cell file can hold.

    Args:
        nats: Evidence of the law beyond the listed answer.
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
        probability=_probability(nats),
    )


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
