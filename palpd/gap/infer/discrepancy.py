"""How the real law of an effect may differ from the formula of the library: the model discrepancy of Kennedy and O'Hagan (2001).

docs/explanation/inference.md states D, d, v, R and L_j under "Model discrepancy".
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import log

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular

from palpd.cell.cell_file import EffectValues
from palpd.cell.effects import Scale
from palpd.gap.assumptions import ASSUMED
from palpd.gap.data.prepare import PreparedRecording
from palpd.gap.gaussian.nuisances import Columns, Projected, ProjectedColumns
from palpd.gap.infer.fit import Optimum
from palpd.gap.model.coordinates import Coordinate
from palpd.gap.model.linearise import Linearisation
from palpd.gap.model.problem import Problem
from palpd.tick import Floats

DISCREPANCY_SIZES = tuple(zip(ASSUMED.law_error.sizes, ASSUMED.law_error.p_sizes, strict=True))
"""Sizes d that a discrepancy may have in each direction, as shares of the effect, and their prior probabilities."""

SPREAD = "spread"
"""Kind of the directions that mix in the same law at other time constants or widths: with several of them an effect stays what it is."""


@dataclass(frozen=True)
class ModelDiscrepancy:
    """A discrepancy of one kind and size, integrated out, with the parameters that are best under it.

    Attributes:
        log_prior: log p_j.
        gain: log L_j - log L.
        normal: Inverse (k, k) of the covariance of u under it.
        move: Move v (k,) of the coordinates from the optimum û of the listed law.
        directions: The m directions D.
        coefficients: The likeliest coefficients (m,) of D; 0 for the directions of other kinds and of the kind SPREAD.
    """

    log_prior: float
    gain: float
    normal: Floats
    move: Floats
    directions: Columns
    coefficients: Floats

    @property
    def change(self) -> Floats:
        """Change (7, b) of the whitened prediction by the likeliest coefficients."""
        return self.directions.times(self.coefficients)


def model_discrepancies(
    problem: Problem, best: Optimum, residual: Projected, slopes: list[Projected], normal: Floats
) -> list[ModelDiscrepancy]:
    """Discrepancies of every size, in the directions of each kind alone and of all kinds together.

    The parameters move with the discrepancy by one Gauss-Newton step v. What such a step would gain without a discrepancy is subtracted:
    at the optimum nothing can be gained, and what the step seems to gain is an error of the linear model.

    Args:
        best: The optimum û under the listed laws.
        slopes: The k slopes J.
        normal: JᵀPJ (k, k).

    Returns:
        A discrepancy for every size and kind that can be computed; empty where the effects are too small to show any.
    """
    columns, kind = discrepancy_columns(problem, best.values, best.prediction, best.linearisation)
    if not columns.size:
        return []
    directions = ProjectedColumns.of(columns, best.linearisation.space)
    against_residual, squares = directions.dot(residual), columns.gram - directions.seen.T @ directions.seen
    against_slopes = np.array([directions.dot(j) for j in slopes]).T
    slope = np.array([j.dot(residual) for j in slopes])
    reach = np.diag([_reach(c, x) ** -2 for c, x in zip(best.where, best.u.tolist(), strict=True)])
    promised = 0.5 * float(slope @ np.linalg.solve(normal + reach, slope))
    ways = [kind == k for k in np.unique(kind)]
    if len(ways) > 1:
        ways.append(np.ones(len(kind), dtype=bool))

    def discrepancy(way: NDArray[np.bool_], size: float, prior: float) -> ModelDiscrepancy | None:
        try:
            factor = cholesky(np.eye(int(way.sum())) + size**2 * squares[np.ix_(way, way)], lower=True)
        except np.linalg.LinAlgError:  # so far from every reading that rounding is larger than what nuisances leave of it
            return None
        of_residual, of_slopes = (size * solve_triangular(factor, x[way], lower=True) for x in (against_residual, against_slopes))
        inner = normal - of_slopes.T @ of_slopes
        pull = slope - of_slopes.T @ of_residual
        move = np.asarray(np.linalg.solve(inner + reach, pull))
        gain = 0.5 * (float(of_residual @ of_residual) + float(pull @ move)) - promised - float(np.log(np.diag(factor)).sum())
        coefficients = np.zeros(columns.size)
        coefficients[way] = size * solve_triangular(factor, of_residual - of_slopes @ move, lower=True, trans="T")
        return ModelDiscrepancy(log(prior / len(ways)), gain, inner, move, columns, np.where(kind == SPREAD, 0.0, coefficients))

    each = (discrepancy(way, size, prior) for size, prior in DISCREPANCY_SIZES for way in ways)
    return [one for one in each if one is not None]


def _reach(c: Coordinate, u: float) -> float:
    """R: how far a coordinate may move with a discrepancy, so that the parameter moves by about half of itself."""
    reach = ASSUMED.law_error.reach
    if c.parameter.log:
        return reach
    return reach / c.scale if c.angle else reach * max(abs(u), 1e-3)


def discrepancy_columns(
    problem: Problem, values: EffectValues, at: Floats, linearisation: Linearisation
) -> tuple[Columns, NDArray[np.str_]]:
    """D: directions in which real laws may differ from the formulas of the library.

    An effect may be stronger or weaker with depth, speed, direction of motion, time, and time since the motion changed, or in a channel
    alone. It may be mixed with the same law at other time constants or widths. Each direction is as large as the part of the effect that
    tolerances do not hide, or smaller; that of the kind SPREAD is `law_error.spread_size` times larger.

    Args:
        values: Parameters θ by effect.
        at: The whitened prediction f (7, b) there.
        linearisation: State η₀ and nuisances A.

    Returns:
        The m directions D, and the kind (m,) of each.
    """
    columns, kinds = [], []
    modulations = list(_modulations(problem)) if values else []
    for name in values:
        others = {other: v for other, v in values.items() if other != name}
        part = at - problem.predict(others, linearisation.eta)
        energy = float(np.linalg.norm(linearisation.space.beyond(part)))
        if energy < ASSUMED.law_error.smallest_effect_sd:
            continue
        for kind, shape in _shapes(problem, values, name, at, part, linearisation.eta, modulations):
            norm = sum(float(there @ there) for there in shape.values()) ** 0.5
            if norm > 1e-6 * energy:
                factor = min(energy / norm, ASSUMED.law_error.largest_stretch) * (ASSUMED.law_error.spread_size if kind == SPREAD else 1.0)
                columns.append({channel: there * factor for channel, there in shape.items()})
                kinds.append(kind)
    return Columns.of(columns, (at.shape[0], at.shape[1])), np.array(kinds)


def _shapes(
    problem: Problem,
    values: EffectValues,
    name: str,
    at: Floats,
    part: Floats,
    eta: Floats,
    modulations: Sequence[tuple[str, Floats]],
) -> Iterator[tuple[str, dict[int, Floats]]]:
    """Kind and direction (b,) by channel, of all directions of an effect whose part of the prediction `at` is `part`."""
    effect = problem.library[name]
    live = np.flatnonzero(part.any(axis=1)).tolist()
    for parameter in effect.parameters:
        if parameter.nominal is None and parameter.log and parameter.name in values[name]:
            lower, upper = parameter.bounds(problem.scale)
            for factor in ASSUMED.law_error.other_shapes:
                other = min(max(values[name][parameter.name] * factor, lower), upper)
                yield SPREAD, dict(enumerate(problem.predict(values | {name: values[name] | {parameter.name: other}}, eta) - at))
    for driver, modulation in modulations:
        if driver in effect.discrepancy_drivers:
            yield driver, {channel: part[channel] * modulation for channel in live}
    if len(live) > 1:
        for channel in live:
            yield "channel", {channel: part[channel]}


def _modulations(problem: Problem) -> Iterator[tuple[str, Floats]]:
    """Drivers of a discrepancy and smooth functions (b,) of each, with mean 0 over all recordings."""
    depth, speed, moving, rest, late, first = np.hstack([_drivers(problem.scale, recording) for recording in problem.recordings])
    functions = {
        "depth": (depth, depth**2),
        "speed": (np.abs(speed), np.clip(speed, -1.0, 1.0), moving),
        "rest": (rest, rest * moving),
        "time": (late, np.exp(-10.0 * late), first),
    }
    for driver, rows in functions.items():
        for row in rows:
            yield driver, row - row.mean()


def _drivers(scale: Scale, recording: PreparedRecording) -> Floats:
    """Depth, speed, whether it moves, time since the motion changed, time, and whether it is the first cycle (6, b)."""
    mean, phases = recording.bins.mean, recording.phases
    rest = np.log1p(mean(phases.since_s) / (3.0 * scale.step_s))
    return np.array(
        [
            mean(phases.depth_m) / scale.depth_m,
            mean(phases.velocity_m_per_s) / scale.speed_m_per_s,
            mean(phases.moving.astype(float)),
            rest / max(rest.max(), 1e-9),
            recording.t_s / max(scale.duration_s, 1e-9),
            recording.bin_cycle == 0,
        ]
    )
