"""The steps that readings are rounded to."""

import numpy as np

from palpd.tick import Floats

MOST_APART = 1.2
"""Largest ratio of the two steps of a sensor with two slopes: a HEX-70 has up to 1.08."""
ALIGNED = 0.9
"""Length of the mean of the phases of readings within a step, 1 if all are multiples of it but for one constant."""


def gaps_between(levels: Floats) -> Floats:
    """Distances (m,) of neighbouring levels (n,), which ascend; one level may have two values that differ in the last bits."""
    gaps = np.diff(levels)
    return np.asarray(gaps[gaps > 1e-6 * np.ptp(levels)])


def lattice_step(values: Floats) -> float:
    """The step to whose multiples readings are rounded.

    A sensor with two slopes has two steps after its readings were corrected, one below and one above a load.

    Args:
        values: The readings (n,).

    Returns:
        The step in the unit of the readings, the finer of two; 0 if they are not rounded.
    """
    unique = np.unique(values)
    if len(unique) < 3 or len(unique) > 0.2 * len(values):
        return 0.0
    gaps = gaps_between(unique)
    if len(gaps) < 2:
        return float(gaps[0]) if len(gaps) else 0.0
    step, other = float(np.quantile(gaps, 0.1)), float(np.median(gaps))
    if other > MOST_APART * step:
        other = step
    on_lattice = np.zeros(len(gaps), bool)
    for candidate in (step, other):
        multiples = gaps / candidate
        on_lattice |= np.abs(multiples - np.rint(multiples)) < 0.02 * np.maximum(multiples, 1.0)
    return step if on_lattice.mean() > 0.9 else 0.0


def finest_step(values: Floats) -> float:
    """The smallest distance of two different readings, where all of them stand on its multiples; else 0.

    It is found among any number of levels, where `lattice_step` needs each of them several times; a sensor with two slopes has none.

    Args:
        values: The readings (n,).

    Returns:
        The step in the unit of the readings; 0 if there is none.
    """
    gaps = gaps_between(np.unique(values))
    if len(gaps) < 2:
        return 0.0
    step = float(gaps.min())
    return step if abs(np.exp(2j * np.pi * values / step).mean()) > ALIGNED else 0.0
