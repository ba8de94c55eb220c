"""What is within specification, as recordings of a healthy cell show it."""

from collections.abc import Sequence

import numpy as np

from palpd.cell_file import CellFile
from palpd.gap.hypothesis import fit
from palpd.gap.noise import FZ
from palpd.gap.problem import SHARED, make_problem
from palpd.samples import Samples

WIDER = 20.0
"""How much wider than stated a deviation may turn out to be."""


def estimate_tolerances(recordings: Sequence[Samples], cell: CellFile) -> dict[str, dict[str, float]]:
    """One standard deviation of every deviation over recordings of a healthy cell, in the units of the cell file.

    Deviations are fitted to each recording with the stated tolerances widened; what a recording cannot tell stays as stated. With few
    recordings the stated value counts as one more.
    """
    tol, rep = cell.tolerances, cell.repeatability
    wider = {name: value * WIDER for name, value in tol.model_dump().items()}
    if tol.modulus_known:
        wider["youngs_modulus"] = min(wider["youngs_modulus"], 0.9)  # 1 and more would mean that it is not known at all
    more = {name: value * WIDER for name, value in rep.model_dump().items()}
    wide = cell.model_copy(update={"tolerances": tol.model_copy(update=wider), "repeatability": rep.model_copy(update=more)})
    squares: dict[str, list[float]] = {}
    scatter: dict[str, list[float]] = {"stiffness": [], "surface_z_m": []}
    for samples in recordings:
        problem = make_problem([samples], wide)
        null = fit(problem, (), {}, problem.linearise({}, np.zeros(len(SHARED))), rounds=2)
        space = null.linearisation.space
        found = space.coefficients(null.residual)
        narrow = np.linalg.inv(space.factor @ space.factor.T)  # posterior covariance of the coefficients, prior 1
        for k, name in enumerate(SHARED):
            if narrow[k, k] < 0.5:
                key = "crosstalk" if "_per_fz" in name else name
                squares.setdefault(key, []).append(float((found[k] ** 2 + narrow[k, k]) * problem.shared_sd[k] ** 2))
        first = len(SHARED)
        for channel, k, kind in problem.own_index:
            if channel == FZ:
                sd = problem.cell.tolerances.bias_N if kind == "bias" else problem.cell.tolerances.drift_N_per_min
                key = "bias_N" if kind == "bias" else "drift_N_per_min"
                squares.setdefault(key, []).append(float((found[first + k] * sd) ** 2))
        for k, name in problem.press_index:
            at = first + k
            if narrow[at, at] < 0.5:
                sd = getattr(problem.cell.repeatability, name)
                scatter[name].append(float((found[at] ** 2 + narrow[at, at]) * sd**2))
    stated = tol.model_dump()
    tolerances = {name: _spread(squares.get(name, []), stated[name]) for name in stated}
    repeatability = {name: _spread(values, getattr(rep, name)) for name, values in scatter.items()}
    return {"tolerances": tolerances, "repeatability": repeatability}


def _spread(squares: list[float], stated: float) -> float:
    """Root mean square, the stated value counting as one observation."""
    return float(np.sqrt((sum(squares) + stated**2) / (len(squares) + 1)))
