"""Where the gap lies, and how far the answer closes it: computed once, after the verdict."""

from dataclasses import dataclass

from palpd.gap.data.noise import CHANNELS
from palpd.gap.data.phases import FREE_STILL, PHASES
from palpd.gap.data.scatter import LoneAxis
from palpd.gap.decide import DiagnosisVerdict
from palpd.gap.infer.inference import Inference
from palpd.gap.infer.shrink import Shrink, held_out, without_effects
from palpd.gap.infer.where import (
    Band,
    PhaseGap,
    Place,
    Trend,
    Unexplained,
    bands,
    gap_table,
    largest_gap,
    most_structure,
    residuals,
    trend,
    unexplained,
)
from palpd.gap.model.linearise import Linearisation, linearise
from palpd.gap.model.problem import Problem


@dataclass(frozen=True)
class Gap:
    """Where measurement and simulation disagree.

    Attributes:
        table: By channel and phase.
        bands: By frequency.
        trend: By cycle.
        where: Channel and phase of the largest gap; None for the verdict `none`, or if nothing is compared.
        shrink: How far the named effects close the gap on cycles that the fit did not see.
        unexplained: The largest residual of the best hypothesis; None where it is noise, or for the verdict `none`.
    """

    table: list[PhaseGap]
    bands: list[Band]
    trend: list[Trend]
    where: Place | None
    shrink: Shrink
    unexplained: Unexplained | None


def locate(inference: Inference, verdict: DiagnosisVerdict) -> Gap:
    """Where the gap lies with the deviations of the answer, and how far the named effects close it."""
    problem, fit, law = inference.problem, verdict.fit, verdict.law
    if verdict.kind == "none":
        table, by_frequency, by_cycle = _tables(problem, inference.stated)
        return Gap(table, by_frequency, by_cycle, None, without_effects(table, "fz_N"), None)
    # The nominal fit lays a modulus that is not known through the middle of the effects.
    anew = bool(fit.names) and not problem.cell.tolerances.modulus_known
    table, by_frequency, by_cycle = _tables(problem, linearise(problem, {}, fit.eta) if anew else inference.stated)
    where = largest_gap(problem, table, fit.change if law is None or law.secondary else law.sought.law.change)
    rest = unexplained(problem, inference.attribution.best.fit)
    if rest is None and verdict.kind == "unknown":
        rest = _noise_of(verdict.lone_axis) if verdict.lone_axis is not None else most_structure(problem, inference.attribution.best)
        where = where if fit.names or law is not None else Place(channel=rest["channel"], phase=rest["phase"])
    shrink = held_out(problem, fit) if fit.names else without_effects(table, where["channel"] if where else "fz_N")
    return Gap(table, by_frequency, by_cycle, where, shrink, rest)


def _noise_of(axis: LoneAxis) -> Unexplained:
    """What an axis that alone is noisy shows at rest beyond what is expected of it."""
    shown, expected = axis.noise
    return Unexplained(channel=CHANNELS[axis.channel], phase=PHASES[FREE_STILL], rms=(shown**2 - expected**2) ** 0.5)


def _tables(problem: Problem, around: Linearisation) -> tuple[list[PhaseGap], list[Band], list[Trend]]:
    """The gap by channel and phase, by frequency, and by cycle. The residual of a long recording is large: it does not outlive them."""
    residual = residuals(problem, around)
    return gap_table(problem, around, residual), bands(problem, residual), trend(problem, residual)
