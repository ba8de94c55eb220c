"""A learned law and what it could be mistaken for, as hypotheses that a motion can decide between."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import exp

import numpy as np

from palpd.cell.effects.learned import LearnedEffect
from palpd.cell.simulation import share_outside
from palpd.gap.advise.rivals import Rival
from palpd.gap.assumptions import ASSUMED
from palpd.gap.decide import NamedLaw
from palpd.gap.infer.evidence import fit
from palpd.gap.infer.posterior import Attribution
from palpd.gap.laws.learned import free_name, learned_effect
from palpd.gap.laws.search import LearnedLaw
from palpd.gap.model.problem import Problem
from palpd.tick import Floats


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
    alike: list[Rival]
    against_list: list[Rival]
    words: Mapping[str, str]

    def share_outside(self, t_s: Floats, z_cmd_m: Floats) -> float:
        """Share of a motion on which the law leaves its range.

        Args:
            t_s: Times (n,).
            z_cmd_m: Commanded heights (n,).
        """
        law = self.alike[0]
        cell = self.problem.cell_at(law.fit.values, law.eta)
        return max(share_outside(cell, t_s, z_cmd_m=z_cmd_m, library=self.problem.library).values(), default=0.0)


def rivals_of_law(problem: Problem, attribution: Attribution, named: NamedLaw) -> LawRivals:
    """A learned law, the laws that the recordings do not distinguish from it, and the answer of the list.

    Args:
        attribution: The posterior over listed hypotheses.
        named: No secondary law.
    """
    law = named.sought.law
    listed: list[tuple[LearnedEffect, LearnedLaw, float]] = [(named.learned, law, law.terms[0].nats)]
    taken = {*problem.library, *(known.id for known in problem.cell.learned), named.learned.id}
    for scored in law.terms[0].alike[: ASSUMED.advice.most_alike]:
        if (other := law.instead(scored.candidate)) is not None:
            effect = learned_effect(other, named.nats)
            effect = effect.model_copy(update={"id": free_name(effect.id, taken)})
            taken.add(effect.id)
            listed.append((effect, other, min(scored.nats, law.terms[0].nats)))
    problem = replace(problem, library={**problem.library, **{effect.id: effect.effect() for effect, _, _ in listed}})
    weights = np.array([exp(nats - listed[0][2]) for _, _, nats in listed])
    shares = named.p_outside * weights / weights.sum()
    beside = named.sought.beside
    alike: list[Rival] = []
    for (effect, behind, _), share in zip(listed, shares.tolist(), strict=True):
        start = beside.values | {effect.id: effect.as_learned}
        with_law = fit(problem, start, beside.linearisation, iterations=3, rounds=1)
        alike.append(Rival(with_law, share, with_law.eta, behind))
    by_list = attribution.best.fit
    against = [replace(alike[0], share=named.p_outside), Rival(by_list, 1.0 - named.p_outside, by_list.eta)]
    first_time = len(problem.recordings) == 1
    return LawRivals(problem, alike, against if first_time else [], {effect.id: effect.what for effect, _, _ in listed})
