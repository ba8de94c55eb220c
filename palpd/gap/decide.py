"""From evidence to a verdict: which effects are named, whether a law or events outside the list act, and how probable each is.

It fits nothing and simulates nothing. `decide` is made of two tables.

| what the list says, in this order (`_kind`) | kind |
|---|---|
| p_none > `naming.p_none_to_acquit` | `none`, without names |
| p_unknown > `naming.p_to_name`, or no name | `unknown` if p_unknown > p_none, else `none` |
| an effect has more than `naming.largest_group` others in its group | `ambiguous` |
| else | `effects` |

| what was sought beyond the list, in this order (`_beyond_list`) | what is decided |
|---|---|
| nothing was sought, since readings are coarse | the list stands |
| events alone, no more than the listed effects, explain more (`events_replace_list`) | `unknown` with these events |
| a law alone beats the listed effects (`law_beats_list`) | that law: the last three rows judge it |
| events explain what remains (`eventful`) | `unknown` with events; a note where the list names the cause, and that did not imitate them |
| neither law nor events remain (`leaves_nothing`) | the list stands; a likely law that one press alone shows is refused |
| a law acts beside the listed effects, or in a cell without effects | that law: the last three rows judge it |
| that law follows time, or a random walk explains as much (`wanders`) | the list stands, with a note; the law is refused |
| it replaces effects that are the named cause | a note; it stands if it has one term and the best effect leaves `laws.least_share_added` |
| else | `unknown` with the law; where listed effects stand beside it, the kind stays theirs and the law is `secondary` |
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from palpd.cell.effects.learned import LearnedEffect
from palpd.gap.assumptions import ASSUMED
from palpd.gap.calibration import ProbabilityMap
from palpd.gap.data.scatter import LoneAxis, Scatter
from palpd.gap.infer.evidence import Fit
from palpd.gap.infer.inference import Inference
from palpd.gap.infer.posterior import Attribution
from palpd.gap.laws.events import Event, Events
from palpd.gap.laws.evidence import FitBeside, LawEvidence, SoughtLaw
from palpd.gap.laws.learned import law_to_json, learned_effect, p_outside
from palpd.gap.laws.search import LearnedLaw

Kind = Literal["effects", "none", "unknown", "ambiguous"]

EVENTS = "What remains looks like single events (see `events`), and not like a law. Another recording will not show them at the same times."
EVENTS_BESIDE = (
    "What the named effects leave looks like single events in time: steps, pulses, falls of the contact force or changes of drift."
)
IN_TIME = (
    "Something changes smoothly or randomly in time, and not by what the cell does. One recording cannot distinguish a slow state from a "
    "random walk. Record the same motion again: a law repeats, a random walk does not."
)
OF_COURSE = (
    "The law follows the course of this recording (time, number of presses or deepest press). One recording cannot distinguish "
    "these, so the law may not hold in another one. Record a second one in another order."
)
NOT_REPLACED = "A law outside the list explains this recording as well: {what}. Another motion decides."


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
class NamedLaw:
    """A law outside the list that the verdict names.

    Attributes:
        learned: The law as an effect for the library.
        sought: The same law with its evidence.
        nats: Its evidence beyond the listed answer.
        replaces: Whether it replaces the listed effects, which only imitated it.
        secondary: Whether listed effects stand as the cause, and the law says what they leave: an error of their own laws, or something
            in addition. The verdict is then theirs.
    """

    learned: LearnedEffect
    sought: SoughtLaw
    nats: float
    replaces: bool
    secondary: bool

    @property
    def p_outside(self) -> float:
        """Probability that something outside the list is at work, as far as this law says."""
        return 0.0 if self.secondary else p_outside(self.nats)

    def to_json(self) -> dict[str, Any]:
        """The key `learned` of out.json."""
        return law_to_json(self.sought.law, self.learned, self.replaces)


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
class BeyondList:
    """What the search beyond the list adds to its answer: a law, events, a note that says why neither, or nothing.

    Attributes:
        law: A law that is named; None where no law was accepted.
        events: Events, which are no law; empty where they are not named.
        note: A sentence for the reader; None where nothing needs to be said.
        refused: A law that another recording may show; None where no law was refused.
        p_outside: Probability that something outside the list is at work, as far as this search says.
    """

    law: NamedLaw | None = None
    events: tuple[Event, ...] = ()
    note: str | None = None
    refused: RefusedLaw | None = None
    p_outside: float = 0.0


@dataclass(frozen=True)
class DiagnosisVerdict:
    """What the recordings say.

    Attributes:
        effects: The named effects, the most probable first, those of the scatter last; each is probable alone or with its group.
        candidates: Probability of every effect by id.
        p_none: Probability that there is no gap.
        p_unknown: Probability that something outside the list is at work.
        fit: The best hypothesis if effects are named, also with members that are not named; else that without effects.
        beyond: What is outside the list.
        lone_axis: The axis that alone is noisy; None where none is.
    """

    kind: Kind
    effects: list[NamedEffect]
    candidates: dict[str, float]
    p_none: float
    p_unknown: float
    fit: Fit
    beyond: BeyondList
    lone_axis: LoneAxis | None

    @property
    def law(self) -> NamedLaw | None:
        """The law outside the list that is named; None where there is none."""
        return self.beyond.law

    @property
    def learned(self) -> LearnedEffect | None:
        """The same law as an effect for the library."""
        return None if self.law is None else self.law.learned

    @property
    def answer(self) -> FitBeside:
        """The listed effects of the answer, and what they leave with the law beside them."""
        return FitBeside.nothing(self.fit) if self.law is None else self.law.sought.fit_beside


def listed_answer(inference: Inference, scatter: Scatter) -> Fit:
    """The hypothesis that the list answers with: the best one where its effects may be named, else that without effects."""
    best = inference.best.fit
    return best if best.names and _p_none(inference.attribution, scatter) <= ASSUMED.naming.p_none_to_acquit else inference.nominal


def decide(inference: Inference, scatter: Scatter, laws: LawEvidence, score_map: ProbabilityMap) -> DiagnosisVerdict:
    """Decide which effects are named, and whether a law or events outside the list act.

    Args:
        laws: What was sought beside `listed_answer`.
        score_map: Which probabilities are stated for those of the posterior; it changes neither kind nor names.
    """
    attribution, listed, best = inference.attribution, laws.listed, inference.best
    p_unknown = 1.0 - (1.0 - attribution.p_unknown) * (1.0 - scatter.p_lone_axis)
    p_none = _p_none(attribution, scatter)
    groups = _probable_groups(listed, attribution) if listed.names else {}
    order = sorted(groups, key=lambda name: (-attribution.marginal[name], name))
    of_scatter = [one for one in scatter.effects if one.probability > ASSUMED.naming.p_to_name]
    kind = _kind(p_none, p_unknown, groups, named=bool(groups or of_scatter))
    candidates = attribution.marginal | {one.id: one.probability for one in scatter.effects}
    beyond = _beyond_list(laws, is_cause=kind in ("effects", "ambiguous"))
    if beyond.p_outside > 0.0:
        p_unknown, p_none = 1.0 - (1.0 - p_unknown) * (1.0 - beyond.p_outside), p_none * (1.0 - beyond.p_outside)
    if score_map.cells:
        candidates = score_map.of_effects(candidates)
        p_none, p_unknown = score_map.of_classes(p_none, p_unknown)
    family = {name: inference.problem.library[name].family for name in order}
    effects = [NamedEffect(n, candidates[n], best.parameters[n], groups[n], family[n], best.at_bound[n]) for n in order]
    effects += [NamedEffect(one.id, candidates[one.id], one.parameters, [], None, []) for one in of_scatter]
    stands = "unknown" if beyond.p_outside > 0.0 else kind
    lone_axis = scatter.lone_axis if scatter.p_lone_axis > ASSUMED.naming.p_to_name else None
    return DiagnosisVerdict(stands, [] if kind == "none" else effects, candidates, p_none, p_unknown, listed, beyond, lone_axis)


def _p_none(attribution: Attribution, scatter: Scatter) -> float:
    """Probability that neither the means nor the scatter of the readings have a gap."""
    p_healthy_scatter = float(np.prod([1.0 - one.probability for one in scatter.effects]))
    return attribution.p_none * (1.0 - scatter.p_lone_axis) * p_healthy_scatter


def _kind(p_none: float, p_unknown: float, groups: Mapping[str, list[str]], *, named: bool) -> Kind:
    if p_none > ASSUMED.naming.p_none_to_acquit:
        return "none"
    if p_unknown > ASSUMED.naming.p_to_name or not named:
        return "unknown" if p_unknown > p_none else "none"
    if any(len(others) > ASSUMED.naming.largest_group for others in groups.values()):
        return "ambiguous"
    return "effects"


def _probable_groups(best: Fit, attribution: Attribution) -> dict[str, list[str]]:
    """The effects of a hypothesis that are probable together with their groups, and the group of each: what could stand in its place.

    If no effect is, the likeliest effect is returned with the next likeliest effects as its group, until they are probable together.
    """
    marginal = attribution.marginal
    groups = {name: attribution.groups[name] for name in best.names}
    largest = max(best.names, key=lambda name: best.sizes[name])
    needed = {
        name: ASSUMED.naming.p_to_name_weak if best.sizes[name] < ASSUMED.naming.weak_sd and name != largest else ASSUMED.naming.p_to_name
        for name in best.names
    }
    probable = {name: others for name, others in groups.items() if sum(marginal.get(one, 0.0) for one in (name, *others)) >= needed[name]}
    if probable:
        return probable
    first = max(best.names, key=lambda name: marginal[name])
    others = list(groups[first])
    for name in sorted(marginal, key=lambda name: -marginal[name]):
        if marginal[first] + sum(marginal.get(one, 0.0) for one in others) >= ASSUMED.naming.p_to_name:
            break
        if name not in (first, *others):
            others.append(name)
    return {first: others}


def _beyond_list(laws: LawEvidence, *, is_cause: bool) -> BeyondList:
    """The second table.

    Args:
        is_cause: Whether the list names effects as the cause.
    """
    if laws.on_top is None:
        return BeyondList()
    if laws.events_replace_list and laws.events_alone is not None:
        return _of_events(laws.events_alone, laws.events_alone.nats - laws.gained)
    if laws.law_beats_list and laws.alone is not None:
        return _of_law(laws, laws.alone, laws.alone.nats - laws.gained, replaces=True, is_cause=is_cause)
    if laws.eventful and laws.events is not None:
        if is_cause and not laws.events_beat_list:
            return BeyondList(note=EVENTS_BESIDE)
        events = laws.events_alone if laws.events_beat_list and laws.events_alone is not None else laws.events
        return _of_events(events, max(events.nats - laws.gained, ASSUMED.laws.named_nats))
    if laws.leaves_nothing:
        once = laws.on_top.one_cycle
        return BeyondList(refused=None if once is None else RefusedLaw(laws.on_top.law, "one cycle", *once))
    return _of_law(laws, laws.together or laws.on_top, laws.on_top.nats, replaces=False, is_cause=is_cause)


def _of_events(events: Events, nats: float) -> BeyondList:
    """Events that nothing listed explains.

    Args:
        nats: Their evidence beyond the listed answer.
    """
    return BeyondList(events=tuple(events.listed), note=EVENTS, p_outside=p_outside(nats))


def _of_law(laws: LawEvidence, sought: SoughtLaw, nats: float, *, replaces: bool, is_cause: bool) -> BeyondList:
    """The last three rows of the second table.

    Args:
        nats: Evidence of the law beyond the listed answer.
    """
    law = sought.law
    if sought.wanders:
        return BeyondList(note=IN_TIME, refused=RefusedLaw(law, "time"))
    learned = learned_effect(law, nats, sought.confounds)
    if is_cause and replaces and not (len(law.terms) == 1 and laws.leading_leaves >= ASSUMED.laws.least_share_added):
        # a real cause never follows its listed formula exactly
        return BeyondList(note=NOT_REPLACED.format(what=learned.what))
    named = NamedLaw(learned, sought, nats, replaces, secondary=not replaces and (is_cause or bool(laws.listed.names)))
    driver = law.terms[0].candidate.driver
    in_course = driver.quantity in ("time", "presses", "deepest") and driver.period is None
    return BeyondList(named, note=OF_COURSE if in_course else None, p_outside=named.p_outside)
