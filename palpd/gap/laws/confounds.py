"""Which listed effects imitate a law on the motion that it was learned from."""

from collections.abc import Mapping

from palpd.gap.assumptions import ASSUMED
from palpd.gap.gaussian.nuisances import project
from palpd.gap.infer.evidence import Fit
from palpd.tick import Floats

MOST = 4
"""Largest number of imitations that are listed."""


def confounds(change: Floats, beside: Fit, fits: Mapping[tuple[str, ...], Fit]) -> dict[str, float]:
    """The effects that imitate a law, each as it was fitted to the same recordings.

    Args:
        change: Change (7, b) of the whitened prediction by the law.
        beside: The listed effects with which the law acts.
        fits: The fitted hypotheses by their effects. Those count that add one effect to `beside`.

    Returns:
        Cosine of the angle between the change of the law and that of the effect, by effect, the most similar first; everything within
        specification is projected out.
    """
    space = beside.linearisation.space
    law = project(change, space)
    out = {}
    for names, one in fits.items():
        further = set(names) - set(beside.names)
        if len(further) != 1 or len(names) != len(beside.names) + 1:
            continue
        imitated = project(one.change - beside.change, space)
        size = (law.dot(law) * imitated.dot(imitated)) ** 0.5
        out[further.pop()] = round(float(law.dot(imitated)) / size, 3) if size > 0.0 else 0.0
    similar = sorted((item for item in out.items() if item[1] > ASSUMED.laws.imitation_cosine), key=lambda item: -item[1])
    return {name: min(cosine, 1.0) for name, cosine in similar[:MOST]}
