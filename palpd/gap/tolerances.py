"""What is within specification, as recordings of a healthy cell show it."""

from collections.abc import Sequence

import numpy as np

from palpd.cell_file import CellFile
from palpd.gap.hypothesis import fit
from palpd.gap.noise import FZ
from palpd.gap.problem import SHARED, make_problem
from palpd.samples import Samples

ITERATIONS = 4


def estimate_tolerances(recordings: Sequence[Samples], cell: CellFile) -> dict[str, dict[str, float]]:
    """One standard deviation of every deviation over recordings of a healthy cell, in the units of the cell file.

    Variance components by expectation-maximisation from the stated values, which count as one more observation; what a recording does
    not tell (a gain apart from the modulus) hence stays near what is stated.
    """
    stated = {"tolerances": cell.tolerances.model_dump(), "repeatability": cell.repeatability.model_dump()}
    found = stated
    for _ in range(ITERATIONS):
        tolerances = cell.tolerances.model_copy(update=found["tolerances"])
        repeatability = cell.repeatability.model_copy(update=found["repeatability"])
        now = cell.model_copy(update={"tolerances": tolerances, "repeatability": repeatability})
        squares: dict[tuple[str, str], list[float]] = {}
        for samples in recordings:
            for key, square in _expected_squares(samples, now):
                squares.setdefault(key, []).append(square)
        found = {
            block: {name: _spread(squares.get((block, name), []), value) for name, value in values.items()}
            for block, values in stated.items()
        }
    return found


def _expected_squares(samples: Samples, cell: CellFile) -> list[tuple[tuple[str, str], float]]:
    """The expected square of every deviation of one recording, by block and key."""
    problem = make_problem([samples], cell)
    null = fit(problem, (), {}, problem.linearise({}, np.zeros(len(SHARED))), rounds=2)
    space = null.linearisation.space
    inverse = np.linalg.inv(space.factor)
    square = space.coefficients(null.residual) ** 2 + (inverse**2).sum(axis=0)  # mean² + variance, prior 1
    tol, rep = cell.tolerances, cell.repeatability
    out = []
    for k, name in enumerate(SHARED):
        key = "crosstalk" if "_per_fz" in name else name
        out.append((("tolerances", key), float(square[k]) * getattr(tol, key) ** 2))
    for channel, k, kind in null.linearisation.index.own:
        if channel == FZ:
            key = "bias_N" if kind == "bias" else "drift_N_per_min"
            out.append((("tolerances", key), float(square[len(SHARED) + k]) * getattr(tol, key) ** 2))
    for k, name in null.linearisation.index.press:
        out.append((("repeatability", name), float(square[len(SHARED) + k]) * getattr(rep, name) ** 2))
    return out


def _spread(squares: list[float], stated: float) -> float:
    """Root mean square, the stated value counting as one observation."""
    return float(np.sqrt((sum(squares) + stated**2) / (len(squares) + 1)))
