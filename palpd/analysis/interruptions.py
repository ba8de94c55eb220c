"""Presses that a pause interrupted: the sequence begins them again, so only the second attempt counts."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from palpd.tick import Phase

STEP = ("site", "mode", "repeat", "depth_m")
"""Fields of a row that say which press or search a tick belongs to."""


def interrupted(rows: NDArray[np.void]) -> NDArray[np.bool_]:
    """Find the ticks of attempts that were begun again, and those of the pauses.

    Args:
        rows: Ticks (n,), with the fields of ROW of palpd.tick.

    Returns:
        True (n,) where a tick must not count for a result.
    """
    dropped = np.isin(rows["phase"], (Phase.PAUSED, Phase.PAUSE_RETRACT))
    for begin, end in _attempts(rows):
        dropped[begin:end] = True
    return dropped


def _attempts(rows: NDArray[np.void]) -> Iterator[tuple[int, int]]:
    """(first row, row after the last) of each attempt whose step goes on after a retract for a pause."""
    leaving = rows["phase"] == Phase.PAUSE_RETRACT
    for at in np.flatnonzero(leaving[1:] & ~leaving[:-1]) + 1:
        same = np.ones(len(rows), bool)
        for name in STEP:
            values, value = rows[name], rows[name][at]
            same &= np.isnan(values) if values.dtype.kind == "f" and np.isnan(value) else values == value
        others = np.flatnonzero(~same[:at])
        begin = int(others[-1]) + 1 if len(others) else 0
        resumed = np.flatnonzero(same[at:] & ~np.isin(rows["phase"][at:], (Phase.PAUSED, Phase.PAUSE_RETRACT)))
        if len(resumed):
            yield begin, int(at)
