"""What the search for laws and events says beside the listed answer: how much each explains. It takes no decision."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from palpd.gap.assumptions import ASSUMED
from palpd.gap.gaussian.nuisance_space import NuisanceSpace
from palpd.gap.gaussian.nuisances import Columns, project
from palpd.gap.infer.discrepancy import discrepancy_columns
from palpd.gap.infer.evidence import Fit, fit
from palpd.gap.infer.fit import jacobian_at
from palpd.gap.infer.inference import Inference
from palpd.gap.infer.posterior import log_prior, price_nats
from palpd.gap.laws.confounds import confounds
from palpd.gap.laws.events import Events, find_events, wander_nats
from palpd.gap.laws.scene import Scene, rounding_columns
from palpd.gap.laws.search import LearnedLaw, search
from palpd.gap.model.problem import Problem, return_memory
from palpd.tick import Floats


@dataclass(frozen=True)
class FitBeside:
    """Listed effects with something outside the list beside them.

    Attributes:
        residual: Whitened residual (7, b) that they and what acts beside them leave; that of the fit where nothing does.
    """

    fit: Fit
    residual: Floats

    @staticmethod
    def nothing(fit: Fit) -> "FitBeside":
        """The listed effects with nothing beside them."""
        return FitBeside(fit, fit.residual)

    @property
    def deviation_sd(self) -> Floats:
        """Coefficients ĉ (m,) of the nuisances, in standard deviations; the first 11 are η."""
        return self.fit.linearisation.space.coefficients(self.residual)


@dataclass(frozen=True)
class SoughtLaw:
    """A law, and what speaks against it.

    Attributes:
        law: Without terms where no candidate is likely enough. Its residual is what the listed effects leave.
        beside: The listed effects beside which it was sought, at their parameters there; no effects where it stands alone.
        wander_nats: Evidence of a random walk in time of the same residual; -inf for a law that does not carry.
        one_cycle: Numbers of the recording, and of the press or stroke in it, that alone shows the law; None where others show it, too.
        confounds: Listed effects that imitate it, with the cosine of each; empty for a law that does not carry.
    """

    law: LearnedLaw
    beside: Fit
    wander_nats: float = -np.inf
    one_cycle: tuple[int, int] | None = None
    confounds: dict[str, float] = field(default_factory=dict)

    @property
    def fit_beside(self) -> FitBeside:
        """The listed effects with this law beside them."""
        return FitBeside(self.beside, self.law.space.residual - self.law.change)

    @property
    def nats(self) -> float:
        """Evidence of a law that carries, less what something unknown costs; 0 of any other."""
        return self.law.nats - price_nats(self.law.scene.problem, "") if self.law.carries else 0.0

    @property
    def plain_time(self) -> bool:
        """Whether it adds a smooth curve of time, which may be a random walk."""
        candidate = self.law.terms[0].candidate
        return candidate.driver.quantity == "time" and candidate.driver.period is None and candidate.factor in ("one", "air")

    @property
    def wanders(self) -> bool:
        """Whether a random walk in time explains as much."""
        return self.plain_time or self.wander_nats > self.law.nats - ASSUMED.laws.alike_nats


@dataclass(frozen=True)
class LawEvidence:
    """What was sought beyond the list, and found.

    Attributes:
        listed: The fit of the listed answer; that without effects where nothing is named.
        gained: Nats by which the listed effects beat the cell without effects, with their prior.
        on_top: The law in what the listed answer leaves; None where readings are so coarse that no law is sought.
        events: Events there; None where `on_top` is.
        events_share: Share of the gap's energy beyond the listed answer's laws that these events hold.
        alone: The law in the gap of the cell without effects, where listed effects could have imitated one; else None.
        events_alone: Events there; None where `alone` is.
        together: The law that was fitted in turn with the listed effects; None where it is not needed.
        presses: Number of presses in all recordings.
        leading_leaves: Share of what the listed effects explain together that the best of them alone leaves; 0 for a single effect.
    """

    listed: Fit
    gained: float = 0.0
    on_top: SoughtLaw | None = None
    events: Events | None = None
    events_share: float = 0.0
    alone: SoughtLaw | None = None
    events_alone: Events | None = None
    together: SoughtLaw | None = None
    presses: int = 0
    leading_leaves: float = 0.0

    @property
    def eventful(self) -> bool:
        """Whether events explain what the listed answer leaves as well as a law, and are no error of listed laws."""
        if self.on_top is None or self.events is None:
            return False
        return (
            self.events.nats >= max(ASSUMED.laws.named_nats, self.on_top.nats - ASSUMED.laws.alike_nats)
            and self.events_share >= ASSUMED.laws.least_share_added
        )

    @property
    def leaves_nothing(self) -> bool:
        """Whether the listed answer leaves neither events nor a law."""
        return not self.eventful and (self.on_top is None or not self.on_top.law.carries)

    @property
    def law_beats_list(self) -> bool:
        """Whether a law alone explains more than the listed effects, also with a law or events beside them: these only imitated it.

        Of two explanations that are alike the one with fewer parts counts. Where events explain the gap, a curve of time is no answer.
        """
        if self.alone is None or self.on_top is None or not self.alone.law.carries or (self.eventful and self.alone.plain_time):
            return False
        rivals = [ASSUMED.laws.named_nats, self.on_top.nats - ASSUMED.laws.alike_nats]
        if self.events_alone is not None and self.events is not None:
            rivals += [self.events.nats - ASSUMED.laws.alike_nats, self.events_alone.nats - ASSUMED.laws.alike_nats - self.gained]
        return self.alone.nats >= self.gained + max(rivals)

    @property
    def events_beat_list(self) -> bool:
        """Whether events alone explain more than the listed effects, which imitated a part of them.

        In one or two presses nothing repeats: what happens at every press looks like an event.
        """
        return self.events_alone is not None and self.presses not in (1, 2) and self.events_alone.nats > self.gained

    @property
    def events_replace_list(self) -> bool:
        """Whether events alone explain more than the listed effects, which imitated them, with no more parts than these.

        A drift that bends looks like a drift and a warm-up together. Neither does a law alone explain more, but for a curve of time: that
        is no answer where events explain the gap.
        """
        if self.alone is None or self.events_alone is None or not self.events_beat_list:
            return False
        law_nats = 0.0 if self.alone.law.carries and self.alone.plain_time else self.alone.nats
        return len(self.events_alone.listed) <= len(self.listed.names) and self.events_alone.nats >= max(
            self.gained + ASSUMED.laws.alike_nats, law_nats - ASSUMED.laws.alike_nats
        )


def look_for_laws(inference: Inference, listed: Fit, *, coarse: bool = False) -> LawEvidence:
    """Search for a law and for events beyond the listed answer.

    What a single listed effect leaves is searched first. Only where that is something, or several effects are named, the gap of the cell
    without effects is searched, too.

    Args:
        listed: The fit of the listed answer; that without effects where nothing is named.
        coarse: Whether readings are rounded far more coarsely than stated. They then follow the force in steps, and any law fits the steps:
            no law is sought.
    """
    if coarse:
        return LawEvidence(listed)
    problem, nominal = inference.problem, inference.nominal
    scene, space = Scene.of(problem, listed.values, listed.eta), _space_beside(problem, listed)
    gained = listed.log_evidence - nominal.log_evidence + log_prior(problem, listed.names) - log_prior(problem, ())
    top = search(scene, space, gained)
    return_memory()
    events = _priced(problem, find_events(scene, space))
    evidence = LawEvidence(
        listed,
        gained,
        _judged(inference, top, space, listed, acts=not listed.names),
        events,
        _share(listed, events.change),
        presses=sum(one.phases.presses for one in problem.recordings),
        leading_leaves=leading_leaves(inference.fits, listed),
    )
    if not listed.names or (evidence.leaves_nothing and len(listed.names) < ASSUMED.laws.many_parts):
        return evidence
    alone_scene, alone_space = Scene.of(problem, {}, nominal.eta), _space_beside(problem, nominal)
    alone = _judged(inference, search(alone_scene, alone_space), alone_space, nominal)
    evidence = replace(evidence, alone=alone, events_alone=_priced(problem, find_events(alone_scene, alone_space)))
    if not evidence.eventful and not evidence.leaves_nothing and not evidence.law_beats_list:
        evidence = replace(evidence, together=_judged(inference, *_fitted_together(problem, listed, top, gained)))
    return evidence


def _priced(problem: Problem, events: Events) -> Events:
    return replace(events, nats=events.nats - price_nats(problem, ""))


def _judged(inference: Inference, law: LearnedLaw, space: NuisanceSpace, beside: Fit, *, acts: bool = True) -> SoughtLaw:
    """A law with what speaks against it.

    Args:
        space: Nuisances and residual in which it was sought.
        acts: Whether it would be named as it is; else it is only compared.
    """
    if not (law.carries and acts):
        return SoughtLaw(law, beside, one_cycle=_one_cycle(law) if law.likely and not law.carries else None)
    return SoughtLaw(law, beside, wander_nats(law.scene, space), None, confounds(law.change, beside, inference.fits))


def leading_leaves(fits: Mapping[tuple[str, ...], Fit], listed: Fit) -> float:
    """How much of what listed effects explain together the best of them alone leaves.

    Args:
        fits: The fitted hypotheses by their effects; the empty set is among them.

    Returns:
        A share of the misfit that they take away together; 0 for a single effect, and where none of them was fitted alone.
    """
    if len(listed.names) < ASSUMED.laws.many_parts:
        return 0.0
    nominal = fits[()].misfit
    alone = [nominal - fits[(name,)].misfit for name in listed.names if (name,) in fits]
    return 1.0 - max(alone) / max(nominal - listed.misfit, 1e-300) if alone else 0.0


def _one_cycle(law: LearnedLaw) -> tuple[int, int] | None:
    """Numbers of the recording and of the press or stroke in it that alone shows a law, from 0 on; None where others show it, too."""
    seen = (NuisanceSpace(law.space.columns, law.change).remainder ** 2).sum(axis=0)
    first, best = 0, (0.0, 0, 0)
    for number, one in enumerate(law.scene.problem.recordings):
        energy = np.bincount(one.bin_cycle, seen[first : first + len(one.bin_cycle)])
        first += len(one.bin_cycle)
        best = max(best, (float(energy.max()), number, int(np.argmax(energy))))
    return best[1:] if best[0] >= ASSUMED.laws.one_cycle * float(seen.sum()) else None


def _fitted_together(problem: Problem, listed: Fit, top: LearnedLaw, gained: float) -> tuple[LearnedLaw, NuisanceSpace, Fit]:
    """A law in addition to listed effects, the nuisances with which it was found, and the fit of these effects.

    Without the law, the listed parameters imitate a part of it. So both are fitted in turn, and the law is sought again.
    In the end the law is what the listed effects leave with these parameters, and not what they could leave.
    """
    law = replace(top, space=_within_specification(problem, listed, listed.residual))
    # A second term may be the error of the listed parameters, so the first term alone stays while these move.
    moved = replace(law, terms=top.terms[:1])
    beside, residual = listed, listed.residual
    for _ in range(ASSUMED.laws.alternations):
        without = problem.without(moved.change)
        beside = fit(without, beside.values, beside.linearisation, iterations=3, rounds=1)
        residual = beside.residual + moved.change
        moved = replace(moved, space=_within_specification(problem, beside, residual))
    space = _space_beside(problem, beside, residual)
    second = search(Scene.of(problem, beside.values, beside.eta), space, gained)
    if not second.carries or second.terms[0].nats < top.terms[0].nats:
        return law, _space_beside(problem, listed), listed
    return replace(second, space=_within_specification(problem, beside, residual)), space, beside


def _share(listed: Fit, change: Floats) -> float:
    """Share of the gap's energy that a change in addition to listed effects holds: a small one is an error of their laws."""
    if not listed.names:
        return 1.0
    own, whole = (project(one, listed.linearisation.space) for one in (change, change + listed.change))
    return own.dot(own) / max(whole.dot(whole), 1e-300)


def _within_specification(problem: Problem, listed: Fit, residual: Floats) -> NuisanceSpace:
    """The residual that listed effects leave of the recordings, with their nuisances A and those of rounding.

    Args:
        listed: Fitted to the recordings, or to these less the change of a law.
        residual: That of the recordings (7, b), whitened.
    """
    space = NuisanceSpace(listed.linearisation.space.columns, residual)
    rounding = rounding_columns(problem, problem.noise.natural(problem.data - listed.remainder))
    return space.with_columns(rounding) if rounding else space


def _space_beside(problem: Problem, listed: Fit, residual: Floats | None = None) -> NuisanceSpace:
    """The same, where the reach of the listed parameters and the discrepancy `law_error.sizes[1]` × D of their laws are nuisances."""
    residual = listed.residual if residual is None else residual
    space, around = _within_specification(problem, listed, residual), listed.linearisation
    if not listed.names:
        return space
    prediction = problem.predict(listed.values, around.eta)
    reach = ASSUMED.law_error.reach * float(np.linalg.norm(listed.change))
    jacobian = jacobian_at(problem, listed.where, listed.u, around.eta, prediction)
    moves = [j * (reach / max(float(np.linalg.norm(j)), 1e-300)) for j in jacobian]
    parameters = Columns.of([dict(enumerate(one)) for one in moves], space.columns.shape)
    discrepancies, _ = discrepancy_columns(problem, listed.values, prediction, around)
    return NuisanceSpace(space.columns.followed_by(parameters).followed_by(discrepancies.scaled(ASSUMED.law_error.sizes[1])), residual)
