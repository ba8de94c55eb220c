"""The steps that readings are rounded to."""

import numpy as np

from palpd.tick import Floats

MOST_APART = 1.2
"""Largest ratio of the two steps of a sensor with two slopes: a HEX-70 has up to 1.08."""


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
    gaps = np.diff(unique)
    gaps = gaps[gaps > 1e-6 * np.ptp(unique)]
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
