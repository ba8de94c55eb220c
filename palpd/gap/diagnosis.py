"""The diagnosis of a cell from its recordings: where the gap lies, which effects explain it, how far it shrinks, what to record next.

`_stages` reads from top to bottom: every stage has its modules, and its result goes to the stages below it only.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from palpd.cell.cell_file import CellFile, OpenHypothesis
from palpd.cell.effects import EFFECTS, Effect
from palpd.gap.advise.next_experiment import ExperimentProposal, advise
from palpd.gap.calibration import ProbabilityMap, stored_map
from palpd.gap.data.observations import Observations, observe
from palpd.gap.decide import DiagnosisVerdict, NamedEffect, decide, listed_answer
from palpd.gap.enriched import enriched_cell
from palpd.gap.infer.compared_modulus import ComparedModulus, compared_modulus
from palpd.gap.infer.detectable import DetectableSize, detectable_sizes
from palpd.gap.infer.inference import Inference, infer
from palpd.gap.infer.posterior import Attribution
from palpd.gap.infer.settle import settle
from palpd.gap.laws.evidence import look_for_laws
from palpd.gap.located import Gap, locate
from palpd.gap.model.problem import MAX_BINS, Problem, problem_of, return_memory
from palpd.gap.nominal_source import NominalSource, nominal_source
from palpd.gap.notes import adopted_sentence, verdict_notes
from palpd.gap.plain import answer_sentence, plain_answer
from palpd.gap.uncertainty import open_hypotheses
from palpd.gap.user_simulator import UserSimulator
from palpd.quantities import quantity
from palpd.recording.samples import Samples

SCHEMA = "palpd.diagnosis/1"

LEAST_LISTED = 1e-3
"""Probability below which an effect is not listed among the candidates."""


def diagnose(
    recordings: Sequence[Samples],
    cell: CellFile,
    effects: Mapping[str, Effect] = EFFECTS,
    *,
    max_bins: int = MAX_BINS,
    propose: bool = True,
    calibrated: bool = True,
    simulators: Sequence[UserSimulator] = (),
    adopted: Path | None = None,
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
        adopted: The folder of a user's adopted effects, so that a note says which of `effects` are adopted; None: no such note.
        show: Is called with the name of each step that begins.

    Raises:
        RecordingError: The recordings cannot be judged.
    """

    def begin(step: str) -> None:
        return_memory()
        show(step)

    # The matrices are small: threads cost more than they bring, and add up in another order each time.
    with threadpool_limits(1):
        return _stages(recordings, cell, effects, max_bins, propose, calibrated, simulators, adopted, begin)


def limits(
    recordings: Sequence[Samples],
    cell: CellFile,
    effects: Mapping[str, Effect] = EFFECTS,
    *,
    simulators: Sequence[UserSimulator] = (),
) -> "ShownSizes":
    """The smallest size of each effect that recordings of one cell would show, without a diagnosis.

    Args:
        cell: The cell as the simulator knows it.
        effects: The effects that may be present.
        simulators: As in `diagnose`.

    Raises:
        RecordingError: The recordings cannot be judged.
    """
    with threadpool_limits(1):
        posed = _posed(recordings, cell, effects, MAX_BINS, simulators)
        nominal = settle(problem_of(posed.observations, posed.library))
        sizes = detectable_sizes(nominal.problem, nominal.fit.linearisation)
        return ShownSizes(sizes, "" if posed.source is None else posed.source.not_judged_sentences.strip())


@dataclass(frozen=True)
class ShownSizes:
    """What recordings would show of each effect; `not_judged` says in words which effects the nominal does not let be judged."""

    sizes: tuple[DetectableSize, ...]
    not_judged: str


@dataclass(frozen=True)
class _Posed:
    """Recordings ready to be judged, the nominal of a user, and the effects that can be judged beside both."""

    observations: Observations
    source: NominalSource | None
    library: Mapping[str, Effect]


def _posed(
    recordings: Sequence[Samples], cell: CellFile, library: Mapping[str, Effect], max_bins: int, simulators: Sequence[UserSimulator]
) -> _Posed:
    """Clean the readings, cut them into bins, estimate noise and tip motion."""
    # A law that the cell file holds is no gap, also where the library has one of that name.
    library = {name: effect for name, effect in library.items() if name not in {law.id for law in cell.learned}}
    observations = observe(recordings, cell, library, simulators, max_bins)
    source = nominal_source(observations.recordings, observations.cell, library)
    if source is not None:
        library = {name: effect for name, effect in library.items() if name not in source.not_judged}
    return _Posed(observations, source, library)


def _stages(
    recordings: Sequence[Samples],
    cell: CellFile,
    library: Mapping[str, Effect],
    max_bins: int,
    propose: bool,
    calibrated: bool,
    simulators: Sequence[UserSimulator],
    adopted: Path | None,
    show: Callable[[str], None],
) -> "Diagnosis":
    show("1 of 6: preparing the recording")
    posed = _posed(recordings, cell, library, max_bins, simulators)
    observations, source, library = posed.observations, posed.source, posed.library
    decisive, notes = list(observations.decisive), [*observations.notes, *(source.sentences if source is not None else [])]

    inference = infer(problem_of(observations, library), show)
    show("4 of 6: looking for what the list does not hold")
    laws = look_for_laws(inference, listed_answer(inference, observations.scatter), coarse=observations.coarse)
    verdict = decide(inference, observations.scatter, laws, stored_map() if calibrated else ProbabilityMap())
    show("5 of 6: closing the gap on cycles that the fit has not seen")
    gap = locate(inference, verdict)
    show("6 of 6: looking for the next experiment")
    proposal = _next_experiment(inference, verdict) if propose else None

    weighed = adopted_sentence(adopted, library) if adopted is not None else ""
    return Diagnosis(
        inference=inference,
        decision=verdict,
        gap=gap,
        decisive=decisive,
        notes=[*decisive, *notes, *verdict_notes(inference.problem, verdict), *filter(None, [weighed])],
        proposal=proposal,
        modulus=compared_modulus(inference.problem, inference.stated, observations.site) if source is None else None,
        source=source,
        joint=any(each.joint for each in recordings),
    )


def _next_experiment(inference: Inference, verdict: DiagnosisVerdict) -> ExperimentProposal | None:
    if verdict.kind == "none":
        return None
    beyond = verdict.beyond if verdict.kind == "unknown" else None
    return advise(inference.problem, inference.attribution, beyond=beyond).proposal


@dataclass(frozen=True)
class Diagnosis:
    """The answer of a diagnosis, and the results of its stages behind it.

    Attributes:
        inference: What the list of effects says about the recordings.
        decision: The verdict with its probabilities and named effects.
        gap: Where measurement and simulation disagree, and how far the named effects close that.
        decisive: Sentences that make the verdict doubtful, such as a dead sensor or a wrong unit; they stand above it.
        notes: Sentences for the reader, the decisive sentences first.
        proposal: The next experiment; None where it was not asked for, or no motion decides.
        modulus: The modulus of the cell file and that of the recordings; None where the file states none, nothing was touched, or the
            nominal is a user's simulator.
        source: The user's own simulator; None where palpd itself simulates the nominal cell.
        joint: Whether the recordings are of a single joint: rad for m, and Nm for N.
    """

    inference: Inference
    decision: DiagnosisVerdict
    gap: Gap
    decisive: list[str]
    notes: list[str]
    proposal: ExperimentProposal | None
    modulus: ComparedModulus | None = None
    source: NominalSource | None = None
    joint: bool = False

    @property
    def problem(self) -> Problem:
        """The data, their prediction and their noise."""
        return self.inference.problem

    @property
    def attribution(self) -> Attribution:
        """The posterior over hypotheses."""
        return self.inference.attribution

    @property
    def verdict(self) -> str:
        """One of effects, none, unknown, ambiguous."""
        return self.decision.kind

    @property
    def effects(self) -> list[NamedEffect]:
        """The named effects."""
        return self.decision.effects

    @property
    def resolved(self) -> bool:
        """Whether effects are named, and no other effect could stand in the place of any of them."""
        return self.verdict == "effects" and not any(e.indistinguishable_from for e in self.effects)

    @cached_property
    def uncertainty(self) -> tuple[OpenHypothesis, ...]:
        """The hypotheses that remain, with the joint uncertainty of their numbers; draws of the cell are made from them."""
        with threadpool_limits(1):
            return open_hypotheses(self.inference, self.decision)

    def cell_with_uncertainty(self) -> CellFile:
        """The enriched cell with what the diagnosis leaves open, for files."""
        return self.enriched_cell().model_copy(update={"uncertainty": self.uncertainty})

    def enriched_cell(self) -> CellFile:
        """The cell with the named effects, a learned law, and the in-tolerance deviations that were fitted with them."""
        return enriched_cell(self.problem, self.decision)

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
        return f"{modulus}{self.source.not_judged_sentences if self.source is not None else ''}".strip()

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
            "detectable": [one.to_json() for one in self.detectable],
        }

    @cached_property
    def detectable(self) -> tuple[DetectableSize, ...]:
        """The smallest size of each effect that these recordings would have shown."""
        with threadpool_limits(1):
            return detectable_sizes(self.inference.problem, self.inference.nominal.linearisation)

    @property
    def _content(self) -> dict[str, Any]:
        """The content of out.json without the answer in words, and without the uncertainty, which takes long to compute."""
        candidates = sorted(self.decision.candidates.items(), key=lambda item: (-item[1], item[0]))
        return (
            {
                "verdict": self.verdict,
                "basis": self._basis,
                "where": self.gap.where,
                "gap": [{name: value for name, value in vars(g).items() if name != "samples"} for g in self.gap.table],
                "effects": [effect.to_json() for effect in self.effects],
                "candidates": [{"id": name, "probability": p} for name, p in candidates if p > LEAST_LISTED],
                "p_none": self.decision.p_none,
                "p_unknown": self.decision.p_unknown,
                "shrink": self.gap.shrink.to_json(),
                "unexplained": self.gap.unexplained,
                "next_experiment": None if self.proposal is None else self.proposal.to_json(),
                "bands": self.gap.bands,
                "trend": self.gap.trend,
                "learned": None if self.decision.law is None else self.decision.law.to_json(),
                "events": list(self.decision.beyond.events) or None,
                "modulus": None if self.modulus is None else self.modulus.to_json(),
                "decisive": self.decisive,
                "notes": self.notes,
            }
            | ({} if self.source is None else {"simulated": self.source.to_json()})
            | ({"joint": True} if self.joint else {})
        )
