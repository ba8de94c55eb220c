"""Estimates the tolerances of a cell from healthy recordings."""

from collections.abc import Sequence

import numpy as np

from palpd.cell.cell_file import CellFile
from palpd.cell.plausible import ask
from palpd.gap.data.noise import FZ
from palpd.gap.data.plausibility import check_recordings
from palpd.gap.infer.evidence import fit
from palpd.gap.model.linearise import linearise
from palpd.gap.model.problem import NOMINAL_ETA, make_problem, tolerance_key
from palpd.recording.samples import Samples

MOST_TIMES_STATED = 10.0
"""Estimated over stated tolerance that is not questioned: ten standard deviations off, a cell is not within specification."""

ITERATIONS = 4
"""Iterations of expectation-maximisation; each costs a fit of every recording."""


def estimate_tolerances(recordings: Sequence[Samples], cell: CellFile, accept_implausible: bool = False) -> dict[str, dict[str, float]]:
    """Estimate the standard deviation of every deviation over recordings of a healthy cell.

    Variance components by expectation-maximisation from the stated values, which count as one more observation. So the tolerance of a
    deviation that the recordings do not show (a gain apart from the modulus) stays near the stated tolerance.

    Args:
        accept_implausible: Whether doubtful recordings and implausible tolerances count.

    Returns:
        The blocks `tolerances` and `repeatability`, in the units of the cell file.

    Raises:
        RecordingError: A recording cannot be judged.
        BadInput: A recording is doubtful or a tolerance implausible, and `accept_implausible` is false.
    """
    questions = check_recordings(recordings, cell)
    check = "give recordings of a healthy cell in SI units, or correct the cell file"
    ask(questions, accept_implausible, check)
    stated = {"tolerances": cell.tolerances.model_dump(), "repeatability": cell.repeatability.model_dump()}
    estimated = stated
    for _ in range(ITERATIONS):
        tolerances = cell.tolerances.model_copy(update=estimated["tolerances"])
        repeatability = cell.repeatability.model_copy(update=estimated["repeatability"])
        now = cell.model_copy(update={"tolerances": tolerances, "repeatability": repeatability})
        squares: dict[tuple[str, str], list[float]] = {}
        for samples in recordings:
            for key, square in _expected_squares(samples, now):
                squares.setdefault(key, []).append(square)
        estimated = {
            block: {name: _spread(squares.get((block, name), []), value) for name, value in values.items()}
            for block, values in stated.items()
        }
    questions = [
        f"{block}.{name} would be {estimated[block][name]:.3g} and {value:.3g} is stated, expected at most {MOST_TIMES_STATED:g} times that"
        for block, values in stated.items()
        for name, value in values.items()
        if not estimated[block][name] <= MOST_TIMES_STATED * value
    ]
    ask(questions, accept_implausible, check)
    return estimated


def _expected_squares(samples: Samples, cell: CellFile) -> list[tuple[tuple[str, str], float]]:
    """The expected square of every deviation of a recording, by block and key, in squared units of the cell file."""
    problem = make_problem([samples], cell)
    nominal = fit(problem, {}, linearise(problem, {}, NOMINAL_ETA), rounds=2)
    around = nominal.linearisation
    inverse = np.linalg.inv(around.space.factor)
    squares = around.space.coefficients(nominal.residual) ** 2 + (inverse**2).sum(axis=0)  # mean² + variance, prior 1
    out = []
    for label, square in zip(around.labels, squares.tolist(), strict=True):
        if label.scope == "cell" or (label.scope == "recording" and label.channel == FZ and label.name != "rounding"):
            key = tolerance_key(label.name)
            out.append((("tolerances", key), square * getattr(cell.tolerances, key) ** 2))
        elif label.scope == "press":
            out.append((("repeatability", label.name), square * getattr(cell.repeatability, label.name) ** 2))
    return out


def _spread(squares: list[float], stated: float) -> float:
    """Root mean square, in which the stated value counts as one observation."""
    return float(np.sqrt((sum(squares) + stated**2) / (len(squares) + 1)))
