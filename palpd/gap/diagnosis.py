"""The diagnosis of a cell from its recordings: where the gap lies, which effects explain it, how far it shrinks, what to record next.

`_stages` reads from top to bottom: every stage has its modules, and its result goes to the stages below it only.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from palpd.cell.cell_file import CellFile, OpenHypothesis
from palpd.cell.effects import EFFECTS, Effect
from palpd.cell.effects.learned import held_sentence, learned_law_of
from palpd.cell.simulation import share_outside
from palpd.gap.advise.next_experiment import ExperimentProposal, advise
from palpd.gap.calibration import as_stated, stored_map
from palpd.gap.data.observations import observe
from palpd.gap.infer.compared_modulus import ComparedModulus, compared_modulus
from palpd.gap.infer.correlated_residual import compare_again
from palpd.gap.infer.hypotheses import fit_rounding, search
from palpd.gap.infer.posterior import Attribution, posterior
from palpd.gap.infer.shrink import Shrink, held_out, without_effects
from palpd.gap.infer.where import Band, Gap, Place, Trend, Unexplained, bands, gap_table, largest_gap, residuals, trend, unexplained
from palpd.gap.laws.confounds import confounds
from palpd.gap.laws.finding import LawFinding, find, leading_leaves
from palpd.gap.model.linearise import linearise
from palpd.gap.model.problem import MAX_BINS, Problem, problem_of, return_memory
from palpd.gap.nominal_source import NominalSource, nominal_source
from palpd.gap.plain import answer_sentence, plain_answer
from palpd.gap.uncertainty import open_hypotheses
from palpd.gap.user_simulator import UserSimulator, left_out
from palpd.gap.verdict import DiagnosisVerdict, NamedEffect, decide, deviation_notes, enriched_cell, unnatural_notes, with_finding
from palpd.quantities import quantity
from palpd.recording.samples import Samples

SCHEMA = "palpd.diagnosis/1"

LEAST_LISTED = 1e-3
"""Probability below which an effect is not listed among the candidates."""

MOST_HELD_UNSAID = 0.01
"""Share of the rows outside the range of a law up to which no note is made: the range itself leaves out 0.4 % of the data of the law."""

CREEP_NOTE = (
    "Force that decays while the height is held comes from relaxing tissue or from a creeping machine (frame, grip, load cell). "
    "This recording alone cannot distinguish them. Press something rigid and hold: the decay is then the machine's creep."
)


def diagnose(
    recordings: Sequence[Samples],
    cell: CellFile,
    effects: Mapping[str, Effect] = EFFECTS,
    *,
    max_bins: int = MAX_BINS,
    propose: bool = True,
    calibrated: bool = True,
    simulators: Sequence[UserSimulator] = (),
    show: Callable[[str], None] = lambda _: None,
) -> "Diagnosis":
    """Diagnose the recordings of one cell jointly; the same input gives the same answer.

    Args:
        cell: The cell as the simulator knows it; where it has the site that the recordings name, the cell at that site.
        effects: The effects that may be present.
        max_bins: Largest number of bins of all recordings, approximately; fewer are faster.
        propose: Whether to look for the next experiment.
        calibrated: Whether to state scores (`calibration`); otherwise the probabilities of the posterior.
        simulators: A user's own simulator for each recording, as the nominal; empty where palpd itself simulates the nominal cell.
        show: Is called with the name of each step that begins.

    Raises:
        RecordingError: The recordings cannot be judged.
    """

    def begin(step: str) -> None:
        return_memory()
        show(step)

    # The matrices are small: threads cost more than they bring, and add up in another order each time.
    with threadpool_limits(1):
        return _stages(recordings, cell, effects, max_bins, propose, calibrated, simulators, begin)


def _stages(
    recordings: Sequence[Samples],
    cell: CellFile,
    library: Mapping[str, Effect],
    max_bins: int,
    propose: bool,
    calibrated: bool,
    simulators: Sequence[UserSimulator],
    show: Callable[[str], None],
) -> "Diagnosis":
    # A law that the cell file holds is no gap, also where the library has one of that name.
    not_judged = left_out(simulators, cell, library)
    library = {name: effect for name, effect in library.items() if name not in {*not_judged, *(law.id for law in cell.learned)}}
    # 1. Prepare: clean the readings, cut them into bins, estimate noise and tip motion.
    show("1 of 6: preparing the recording")
    observations = observe(recordings, cell, library, simulators, max_bins)
    source = nominal_source(observations.recordings, not_judged)
    decisive, notes = list(observations.decisive), [*observations.notes, *(source.sentences if source is not None else [])]
    problem = problem_of(observations, library)

    # 2. Residual: what the cell without effects leaves, and where.
    nominal = fit_rounding(problem)
    problem = nominal.problem
    stated = nominal.stated
    table = gap_table(problem, stated, residuals(problem, stated))
    modulus = compared_modulus(problem, stated, observations.site)

    # 3. Hypotheses: which sets of effects could have made it, each at its best.
    show("2 of 6: fitting which effects could have made the gap")
    fits = search(nominal)

    # 4. Evidence: how probable each of them is, and something outside the list.
    show("3 of 6: weighing them")
    attribution = compare_again(problem, fits, posterior(problem, fits))

    # 5. Verdict: which effects to name.
    verdict = decide(problem, nominal.fit, attribution, observations.scatter)
    notes += unnatural_notes(problem, verdict)

    # 6. Law: what the list does not hold, as a function of what the cell does, or as events.
    show("4 of 6: looking for what the list does not hold")
    finding = find(problem, nominal.fit, verdict.fit, coarse=observations.coarse)
    if verdict.kind in ("effects", "ambiguous"):
        finding = finding.beside_named(leading_leaves(fits, verdict.fit))
    if finding.learned is not None:
        finding = replace(finding, learned=finding.learned.model_copy(update={"confounds": confounds(finding, fits)}))
    verdict = with_finding(verdict, finding)
    notes += deviation_notes(problem, finding.beside_law(verdict.fit))
    if calibrated:
        verdict = as_stated(verdict, stored_map())
    notes += [finding.note] if finding.note else []
    notes += held_notes(problem, verdict)
    gap = verdict.kind != "none"
    if gap and verdict.fit.names and not cell.tolerances.modulus_known:
        # The nominal fit lays its modulus through the middle of the effects.
        stated = linearise(problem, {}, verdict.fit.eta)
        table = gap_table(problem, stated, residuals(problem, stated))
    change = finding.law.change if finding.law is not None and not finding.secondary else verdict.fit.change
    where = largest_gap(problem, table, change) if gap else None
    involved = {name for e in verdict.effects for name in (e.id, *e.indistinguishable_from)}
    if any(library[name].shows_at_rest for name in involved):
        notes.append(CREEP_NOTE)

    # 7. Shrink: how far the named effects close the gap on cycles that the fit did not see.
    show("5 of 6: closing the gap on cycles that the fit has not seen")
    named = gap and bool(verdict.fit.names)
    shrink = held_out(problem, verdict.fit) if named else without_effects(table, where["channel"] if where else "fz_N")

    # 8. Next experiment: the motion that best separates the hypotheses that are still open.
    show("6 of 6: looking for the next experiment")
    unknown = finding if verdict.kind == "unknown" else None
    proposal = advise(problem, attribution, finding=unknown).proposal if gap and propose else None

    residual = residuals(problem, stated)  # again: of a long recording it is too large to keep meanwhile
    return Diagnosis(
        decision=verdict,
        where=where,
        gap=table,
        bands=bands(problem, residual),
        trend=trend(problem, residual),
        shrink=shrink,
        unexplained=unexplained(problem, attribution.best.fit) if gap else None,
        decisive=decisive,
        notes=[*decisive, *notes],
        proposal=proposal,
        problem=problem,
        attribution=attribution,
        finding=finding,
        modulus=modulus,
        source=source,
    )


def held_notes(problem: Problem, verdict: DiagnosisVerdict) -> list[str]:
    """A sentence for every learned law, of the library or of the cell, that these recordings drive outside its range."""
    cell = problem.cell_at(verdict.fit.values, verdict.fit.eta)
    samples = [one.samples for one in problem.recordings]
    shares: dict[str, list[float]] = {}
    for one in samples:
        for name, share in share_outside(cell, one.t_s, z_cmd_m=one.z_cmd_m, z_m=one.z_m, library=problem.library).items():
            shares.setdefault(name, []).append(share)
    rows = [len(one.t_s) for one in samples]
    means = {name: float(np.average(each, weights=rows)) for name, each in shares.items() if len(each) == len(rows)}
    return [held_sentence(name, share) for name, share in means.items() if share > MOST_HELD_UNSAID]


def with_laws_whole(cell: CellFile, library: Mapping[str, Effect]) -> CellFile:
    """A cell with learned effects of a library as data of its own, in place of their names: it needs that library no longer.

    Args:
        library: Effects by id.
    """
    named = {name: learned_law_of(library[name]) for name in cell.effects}
    whole = {name: law.at(cell.effects[name]) for name, law in named.items() if law is not None}
    rest = {name: values for name, values in cell.effects.items() if name not in whole}
    return cell.model_copy(update={"effects": rest, "learned": (*cell.learned, *whole.values())}) if whole else cell


@dataclass(frozen=True)
class Diagnosis:
    """The answer of a diagnosis, and the data behind it.

    Attributes:
        decision: The verdict with its probabilities and named effects.
        where: Channel and phase of the largest gap; None for the verdict `none`, or if nothing is compared.
        gap: By channel and phase.
        bands: The gap by frequency.
        trend: The gap by cycle.
        shrink: How far the named effects close the gap on cycles that the fit did not see.
        unexplained: The largest residual of the best hypothesis; None where it is noise, or for the verdict `none`.
        decisive: Sentences that make the verdict doubtful, such as a dead sensor or a wrong unit; they stand above it.
        notes: Sentences for the reader, the decisive sentences first.
        proposal: The next experiment; None where it was not asked for, or no motion decides.
        problem: The data, their prediction and their noise.
        attribution: The posterior over hypotheses.
        finding: What is not in the list: a learned effect, events, or nothing.
        modulus: The modulus of the cell file and that of the recordings; None where the file states none, or nothing was touched.
        source: The user's own simulator; None where palpd itself simulates the nominal cell.
    """

    decision: DiagnosisVerdict
    where: Place | None
    gap: list[Gap]
    bands: list[Band]
    trend: list[Trend]
    shrink: Shrink
    unexplained: Unexplained | None
    decisive: list[str]
    notes: list[str]
    proposal: ExperimentProposal | None
    problem: Problem
    attribution: Attribution
    finding: LawFinding
    modulus: ComparedModulus | None = None
    source: NominalSource | None = None

    @property
    def verdict(self) -> str:
        """One of effects, none, unknown, ambiguous."""
        return self.decision.kind

    @property
    def effects(self) -> list[NamedEffect]:
        """The named effects."""
        return self.decision.effects

    @property
    def candidates(self) -> dict[str, float]:
        """Probability of every effect by id."""
        return self.decision.candidates

    @property
    def p_none(self) -> float:
        """Probability that there is no gap."""
        return self.decision.p_none

    @property
    def p_unknown(self) -> float:
        """Probability that something outside the list is at work."""
        return self.decision.p_unknown

    @property
    def resolved(self) -> bool:
        """Whether effects are named, and no other effect could stand in the place of any of them."""
        return self.verdict == "effects" and not any(e.indistinguishable_from for e in self.effects)

    @cached_property
    def uncertainty(self) -> tuple[OpenHypothesis, ...]:
        """The hypotheses that remain, with the joint uncertainty of their numbers; draws of the cell are made from them."""
        with threadpool_limits(1):
            finding = self.finding
            fit = self.decision.fit if finding.learned is None or finding.law is None else finding.beside_law(self.decision.fit)
            return open_hypotheses(self.problem, self.decision, self.attribution, fit)

    def cell_with_uncertainty(self) -> CellFile:
        """The enriched cell with what the diagnosis leaves open, for files."""
        return self.enriched_cell().model_copy(update={"uncertainty": self.uncertainty})

    def enriched_cell(self) -> CellFile:
        """The cell with the named effects, a learned effect, and the in-tolerance deviations that were fitted with them.

        Listed effects that a learned effect replaces are left out. Laws of the library that were named stand in it whole, so that the file
        needs no library.
        """
        finding = self.finding
        if finding.learned is None or finding.law is None:
            return with_laws_whole(enriched_cell(self.problem, self.decision), self.problem.library)
        scatter = [e for e in self.effects if self.problem.library[e.id].scatter]
        cell = enriched_cell(self.problem, replace(self.decision, effects=scatter, fit=finding.beside_law(self.decision.fit)))
        cell = cell.with_effects(cell.effects | finding.beside.values)  # with the parameters that were fitted together with the law
        return with_laws_whole(cell.model_copy(update={"learned": (*cell.learned, finding.learned)}), self.problem.library)

    @property
    def sentence(self) -> str:
        """The answer in words: the verdict, where it shows, how far the gap closes, and the modulus on which it rests."""
        content, library = self._content, self.problem.library
        plain = plain_answer(content, library)
        return " ".join(filter(None, (answer_sentence(content, library, with_ids=True), plain["where"], plain["closed"], content["basis"])))

    @property
    def _basis(self) -> str:
        """Which modulus the answer rests on, and what could not be judged."""
        modulus = self.modulus.sentence if self.modulus is not None else self._fitted_modulus
        return f"{modulus}{self.source.unjudged if self.source is not None else ''}".strip()

    @property
    def _fitted_modulus(self) -> str:
        """The fitted modulus where the cell file states none, and which effects would have changed it."""
        estimated = self.enriched_cell().estimated
        tissue = self.problem.cell.tissue
        if self.problem.cell.tolerances.modulus_known or estimated is None or tissue is None:
            return ""
        value_Pa = tissue.youngs_modulus_Pa * (1.0 + estimated.youngs_modulus)
        return (
            f"The modulus was not known; the fit gives {quantity(value_Pa, 'Pa')}. "
            "A wrong sensor.gain, robot.compliance or tissue.thickness would have changed it."
        )

    def to_json(self) -> dict[str, Any]:
        """The content of out.json, palpd.diagnosis/1."""
        content = self._content
        return {
            "schema": SCHEMA,
            "verdict": self.verdict,
            "sentence": self.sentence,
            "plain": plain_answer(content, self.problem.library),
            **content,
            "uncertainty": [one.model_dump(mode="json", exclude_none=True) for one in self.uncertainty],
        }

    @property
    def _content(self) -> dict[str, Any]:
        """The content of out.json without the answer in words, and without the uncertainty, which takes long to compute."""
        candidates = sorted(self.candidates.items(), key=lambda item: (-item[1], item[0]))
        return {
            "verdict": self.verdict,
            "basis": self._basis,
            "where": self.where,
            "gap": [{name: value for name, value in vars(g).items() if name != "samples"} for g in self.gap],
            "effects": [effect.to_json() for effect in self.effects],
            "candidates": [{"id": name, "probability": p} for name, p in candidates if p > LEAST_LISTED],
            "p_none": self.p_none,
            "p_unknown": self.p_unknown,
            "shrink": self.shrink.to_json(),
            "unexplained": self.unexplained,
            "next_experiment": None if self.proposal is None else self.proposal.to_json(),
            "bands": self.bands,
            "trend": self.trend,
            "learned": self.finding.to_json(),
            "events": self.finding.events or None,
            "modulus": None if self.modulus is None else self.modulus.to_json(),
            "decisive": self.decisive,
            "notes": self.notes,
        } | ({} if self.source is None else {"simulated": self.source.to_json()})
