"""A residual with a threshold: detection only, as a monitor on the line does it.

The force less the mean of the healthy recordings (by height and direction) is compared with the same figure of each healthy recording
against the others. It cannot name a cause: where it is alarmed, it says unknown.
"""

from typing import Any

import numpy as np

from palpd.arena.answers import content_of
from palpd.arena.cases import Question
from palpd.arena.columns import Columns, Healthy, load

FACTOR = 1.5
"""An alarm is raised above this multiple of the largest healthy figure."""


def answer(question: Question) -> dict[str, Any]:
    """Silent or alarmed; without healthy recordings it cannot say."""
    healthy = [load(path) for path in question.healthy]
    if len(healthy) < 2:
        return content_of("unknown", {}, 0.5, 0.5)
    usual = max(_rms(Healthy.of([*healthy[:k], *healthy[k + 1 :]]), each) for k, each in enumerate(healthy))
    ratio = _rms(Healthy.of(healthy), load(question.recording)) / max(FACTOR * usual, 1e-300)
    p_none = float(1.0 / (1.0 + ratio**6))
    return content_of("unknown" if ratio > 1.0 else "none", {}, p_none, 1.0 - p_none)


def _rms(reference: Healthy, recording: Columns) -> float:
    left = reference.residual(recording)
    return float(np.sqrt(np.nanmean(left**2))) if np.isfinite(left).any() else float("inf")
