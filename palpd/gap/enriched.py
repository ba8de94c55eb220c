"""The cell of the answer: with the named effects, a learned law, and the in-tolerance deviations that were fitted with them."""

from collections.abc import Mapping

import numpy as np

from palpd.cell.cell_file import CellFile, EffectValues, Estimated
from palpd.cell.effects import Effect
from palpd.cell.effects.learned import learned_law_of
from palpd.gap.data.noise import FZ
from palpd.gap.decide import DiagnosisVerdict
from palpd.gap.laws.evidence import FitBeside
from palpd.gap.model.problem import Problem
from palpd.tick import Floats

ZEROS = ("bias_N", "drift_N_per_min")
"""Deviations that each recording has for itself; a cell file holds their mean over the recordings."""


def enriched_cell(problem: Problem, verdict: DiagnosisVerdict) -> CellFile:
    """The cell with the named effects, a learned law, and the in-tolerance deviations that were fitted with them.

    Listed effects that a learned law replaces are left out; others have the parameters that were fitted together with it. Laws of the
    library that were named stand in it whole, so that the file needs no library.
    """
    law, answer = verdict.law, verdict.answer
    named: EffectValues = {
        e.id: {n: v for n, (v, _, _) in e.parameters.items()} for e in verdict.effects if law is None or problem.library[e.id].scatter
    }
    effects = answer.fit.values | named if named or law is not None else {}
    cell = problem.cell.with_effects(problem.cell.effects | effects).with_estimated(estimated_with(problem, answer))
    learned = () if law is None else (law.learned,)
    return with_laws_whole(cell.model_copy(update={"learned": (*cell.learned, *learned)}), problem.library)


def with_laws_whole(cell: CellFile, library: Mapping[str, Effect]) -> CellFile:
    """A cell with learned effects of a library as data of its own, in place of their names: it needs that library no longer.

    Args:
        library: Effects by id.
    """
    named = {name: learned_law_of(library[name]) for name in cell.effects}
    whole = {name: law.at(cell.effects[name]) for name, law in named.items() if law is not None}
    rest = {name: values for name, values in cell.effects.items() if name not in whole}
    return cell.model_copy(update={"effects": rest, "learned": (*cell.learned, *whole.values())}) if whole else cell


def estimated_with(problem: Problem, answer: FitBeside) -> Estimated:
    """The in-tolerance deviations that were fitted with a hypothesis, as the block `estimated` of a cell file.

    Bias and drift, which each recording has for itself, enter by their mean.
    """
    deviation_sd = answer.deviation_sd
    zeros = {name: _mean_zero(problem, answer, deviation_sd, name) for name in ZEROS}
    return problem.estimated(deviation_sd[: len(answer.fit.eta)]).model_copy(update=zeros)


def _mean_zero(problem: Problem, answer: FitBeside, deviation_sd: Floats, name: str) -> float:
    """Mean over the recordings of the bias or drift of fz, in the unit of the cell file."""
    tolerance = getattr(problem.cell.tolerances, name)
    values = [deviation_sd[k] * tolerance for k in answer.fit.linearisation.numbers("recording", name, FZ)]
    return float(np.mean(values)) if values else 0.0
