"""Cells drawn from what a diagnosis left open, for simulations that shall hold the real cell among their variants."""

import numpy as np

from palpd.cell.cell_file import CROSSTALK, CellFile, Estimated, OpenHypothesis, OpenParameter
from palpd.errors import BadInput
from palpd.tick import Floats

MOST_DRAWS = 10_000
"""Largest number of drawn cells: their files take 20 MB."""


def drawn_cells(cell: CellFile, count: int, seed: int) -> list[CellFile]:
    """Draw cells: a hypothesis by its probability, and around it all open numbers together.

    Args:
        cell: A cell with its uncertainty, as a diagnosis writes it.

    Returns:
        The cells, without uncertainty.

    Raises:
        BadInput: The count is none, or the cell says nothing about its uncertainty.
    """
    if not 1 <= count <= MOST_DRAWS:
        raise BadInput(f"{count} cells were asked for, expected 1 to {MOST_DRAWS}; give --randomise a number of cells")
    if not cell.uncertainty:
        raise BadInput(
            "this cell file has no block `uncertainty`, so nothing says how far its numbers may be off; "
            "make it with palpd diagnose --cell-out of this version"
        )
    rng = np.random.default_rng(seed)
    shares = np.array([one.probability for one in cell.uncertainty])
    chosen = rng.choice(len(shares), size=count, p=shares / shares.sum())
    return [drawn_cell(cell, cell.uncertainty[k], rng) for k in chosen.tolist()]


def drawn_cell(cell: CellFile, hypothesis: OpenHypothesis, rng: np.random.Generator) -> CellFile:
    """Draw a cell from one hypothesis.

    Args:
        hypothesis: What it may be.

    Returns:
        The cell, without uncertainty.
    """
    moves = spread(hypothesis) @ rng.standard_normal(len(hypothesis.open))
    effects = {name: dict(values) for name, values in hypothesis.effects.items()}
    deviations = hypothesis.estimated.model_dump()
    crosstalk = list(deviations.pop("crosstalk"))
    for one, move in zip(hypothesis.open, moves.tolist(), strict=True):
        effect, _, name = one.name.rpartition(".")
        if effect != "estimated":
            effects[effect][name] = _moved(one, effects[effect][name], move)
        elif name in CROSSTALK:
            crosstalk[CROSSTALK.index(name)] = _moved(one, crosstalk[CROSSTALK.index(name)], move)
        else:
            deviations[name] = _moved(one, deviations[name], move)
    estimated = Estimated(**deviations, crosstalk=tuple(crosstalk))
    return cell.model_copy(update={"effects": effects, "estimated": estimated, "uncertainty": ()})


def spread(hypothesis: OpenHypothesis) -> Floats:
    """A factor (k, k) of the covariance of the open numbers: times k standard normal numbers it gives their moves on their scales."""
    if not hypothesis.open:
        return np.zeros((0, 0))
    variance, directions = np.linalg.eigh(np.array(hypothesis.correlation))
    sd = np.array([one.sd for one in hypothesis.open])
    return np.asarray(sd[:, None] * directions * np.sqrt(np.maximum(variance, 0.0)))


def _moved(one: OpenParameter, value: float, move: float) -> float:
    """A value after a move on its scale, inside its range."""
    if one.scale == "log":
        value *= float(np.exp(move))
    elif one.scale == "log1p":
        value = (1.0 + value) * float(np.exp(move)) - 1.0
    elif one.scale == "angle":
        value = float((value + move + np.pi) % (2.0 * np.pi) - np.pi)
    else:
        value += move
    return min(max(value, -np.inf if one.lower is None else one.lower), np.inf if one.upper is None else one.upper)
