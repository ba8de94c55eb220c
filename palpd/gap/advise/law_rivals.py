"""A learned law and what it could be mistaken for, as hypotheses that a motion can decide between."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import exp

import numpy as np

from palpd.cell.effects.learned import LearnedEffect
from palpd.cell.simulation import share_outside
from palpd.gap.gaussian.nuisance_space import whitened
from palpd.gap.infer.evidence import fit
from palpd.gap.infer.posterior import Attribution, Hypothesis
from palpd.gap.laws.finding import LawFinding, free_name, learned_effect
from palpd.gap.laws.scene import Scene
from palpd.gap.laws.search import LearnedLaw
from palpd.gap.model.problem import Problem
from palpd.tick import Floats

MOST_ALIKE = 3
"""Number of laws that fit as well, against which a motion is sought; the cost grows with its square."""


@dataclass(frozen=True)
class LawHypothesis(Hypothesis):
    """A law as a hypothesis. Its curve is known no better than its band, so another motion may show it elsewhere in the band."""

    law: LearnedLaw

    def curve_columns(self, trial: Problem) -> list[Floats]:
        """Whitened changes (7, b) of a prediction by one standard deviation of each independent combination of a curve's coefficients w.

        Args:
            trial: The problem that another recording would pose, b bins.
        """
        scene = Scene.of(trial, self.fit.values, self.fit.eta).with_rest_speed(self.law.scene.rest_speed_m_per_s)
        out = []
        for number in range(len(self.law.terms)):
            candidate, covariance = self.law.uncertain(number)
            columns = whitened(trial.noise, scene.columns(candidate))
            variances, vectors = np.linalg.eigh(covariance)
            for step in (vectors * np.sqrt(np.maximum(variances, 0.0))).T:
                change = np.zeros_like(trial.data)
                for channel, values in columns.items():
                    change[channel] = values @ step
                if change.any():
                    out.append(change)
        return out


@dataclass(frozen=True)
class LawRivals:
    """A law and its rivals.

    Attributes:
        problem: With these laws in its library.
        alike: The law, and the laws that fit as well.
        against_list: The law, and what the list says without it; empty where two recordings have shown the law already.
        words: Every law in words, by its name.
    """

    problem: Problem
    alike: list[Hypothesis]
    against_list: list[Hypothesis]
    words: Mapping[str, str]

    def share_outside(self, t_s: Floats, z_cmd_m: Floats) -> float:
        """Share of a motion on which the law leaves its range.

        Args:
            t_s: Times (n,).
            z_cmd_m: Commanded heights (n,).
        """
        law = self.alike[0].fit
        cell = self.problem.cell_at(law.values, law.eta)
        return max(share_outside(cell, t_s, z_cmd_m=z_cmd_m, library=self.problem.library).values(), default=0.0)


def rivals_of_law(problem: Problem, attribution: Attribution, finding: LawFinding) -> LawRivals | None:
    """A learned law, the laws that the recordings do not distinguish from it, and the answer of the list.

    Args:
        attribution: The posterior over listed hypotheses.

    Returns:
        The rivals; None where there is no law, or a listed effect is the cause and the law describes only what that leaves.
    """
    law = finding.law
    if law is None or finding.learned is None or finding.secondary:
        return None
    listed: list[tuple[LearnedEffect, LearnedLaw, float]] = [(finding.learned, law, law.terms[0].nats)]
    taken = {*problem.library, *(one.id for one in problem.cell.learned), finding.learned.id}
    for scored in law.terms[0].alike[:MOST_ALIKE]:
        if (other := law.instead(scored.candidate)) is not None:
            effect = learned_effect(other, finding.nats)
            effect = effect.model_copy(update={"id": free_name(effect.id, taken)})
            taken.add(effect.id)
            listed.append((effect, other, min(scored.nats, law.terms[0].nats)))
    problem = problem.with_library({one.id: one.effect() for one, _, _ in listed})
    weights = np.array([exp(nats - listed[0][2]) for _, _, nats in listed])
    shares = finding.p_outside * weights / weights.sum()
    beside = finding.beside
    alike: list[Hypothesis] = []
    for (effect, behind, _), share in zip(listed, shares.tolist(), strict=True):
        start = beside.values | {effect.id: effect.as_learned}
        one = fit(problem, start, beside.linearisation, iterations=3, rounds=1)
        alike.append(LawHypothesis(one, attribution.best.residual, share, 1.0, behind))
    first_time = len(problem.recordings) == 1
    against = [replace(alike[0], share=finding.p_outside), replace(attribution.best, share=1.0 - finding.p_outside)]
    return LawRivals(problem, alike, against if first_time else [], {one.id: one.what for one, _, _ in listed})
