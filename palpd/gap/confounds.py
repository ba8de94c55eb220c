"""Which effects a motion can tell apart, before anything is recorded: the angle between what they change."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import log

import numpy as np
from scipy.optimize import lsq_linear

from palpd.cell_file import CellFile
from palpd.effects import Effect
from palpd.gap.experiment import Limits, Motion, blank
from palpd.gap.gaussian import Nuisances, Projected, gram, project
from palpd.gap.hypothesis import coordinates, jacobian_at, start_values
from palpd.gap.problem import Problem, make_problem
from palpd.tick import Floats

ONE_DIRECTION = 0.98
"""Above this cosine two effects are one to a recording of that motion."""

ROWS_HZ = 250.0


@dataclass(frozen=True)
class Likeness:
    """How much of an effect's change another can imitate: the cosine of the angle between the change and what the other can make, all
    that is within specification projected out; and at which size of the effect (SNR) the two would be told apart at odds of 20."""

    effect: str
    other: str
    cosine: float
    told_at_snr: float

    @property
    def words(self) -> str:
        """In words."""
        if self.cosine > ONE_DIRECTION:
            return f"not to be told apart by such a motion (told at SNR {self.told_at_snr:.0f})"
        return f"told apart at SNR {self.told_at_snr:.0f} and above" if self.cosine > 0.5 else "nothing alike"


@dataclass(frozen=True)
class Shape:
    """An effect at some values: what it changes there, the slopes in its parameters, and how far each may go (twice or half, or round)."""

    change: Projected
    slopes: list[Projected]
    reach: Floats


def standard_motion(cell: CellFile) -> tuple[Motion, Limits]:
    """Free strokes, holds and presses of three depths, as large as this cell's tip and as fast as its servo allows without lagging far."""
    depth_m = cell.probe.tip_radius_m
    speed = 0.25 * depth_m * cell.robot.servo_natural_frequency_Hz
    limits = Limits(depth_m, np.inf, depth_m, 4.0 * depth_m, speed, 3.0 * speed, 30.0 * speed)
    depths = (0.5 * depth_m, 0.75 * depth_m, depth_m)
    return Motion("standard", depths, speed, 4.0, 2, depth_m, "both", 3, 4.0 * depth_m, 3.0 * speed), limits


def confounds(effects: Sequence[Effect], cell: CellFile, library: Mapping[str, Effect], most: int = 4) -> list[Likeness]:
    """For each effect the library's that are most like it on the standard motion of that cell, most alike first."""
    motion, limits = standard_motion(cell)
    surface_m = cell.tissue.surface_z_m if cell.tissue is not None else 0.0
    t_s, z_cmd_m = motion.heights(1.0 / ROWS_HZ, surface_m, surface_m + limits.home_m, limits.acceleration_m_per_s2)
    problem = make_problem([blank(cell, t_s, z_cmd_m)], cell, library, 2500)
    base = problem.linearise({}, np.zeros(len(problem.shared_sd)))
    out = []
    spans = {name: _span(problem, other, base.prediction, base.space) for name, other in library.items() if not other.variance}
    for effect in effects:
        if effect.variance:
            continue
        change = _change(problem, effect, start_values(effect, problem.scale, ())[0], base.prediction, base.space)
        likes = [_likeness(effect.id, change, other, span) for other, span in spans.items() if other != effect.id and span]
        out += sorted(likes, key=lambda like: -like.cosine)[:most]
    return out


def _change(problem: Problem, effect: Effect, values: dict[str, float], at: Floats, space: Nuisances) -> Projected:
    return project(problem.predict({effect.id: values}, np.zeros(len(problem.shared_sd))) - at, space)


def _span(problem: Problem, effect: Effect, at: Floats, space: Nuisances) -> list[Shape]:
    """What the effect can change around each of its starts."""
    where = coordinates([effect], problem.scale)
    eta = np.zeros(len(problem.shared_sd))
    out = []
    for values in start_values(effect, problem.scale, ()):
        here = problem.predict({effect.id: values}, eta)
        if not (here - at).any():
            continue
        u = np.array([c.to(values[c.parameter.name]) for c in where])
        slopes = [project(slope, space) for slope in jacobian_at(problem, where, u, eta, here)]
        several = 10.0 if sum(c.amplitude for c in where) > 1 else 1.0  # which may differ from each other by any factor
        size = np.where([c.amplitude for c in where], several * np.abs(u), np.abs(u)).tolist()
        reach = [log(2.0) if c.parameter.log else np.pi / c.scale if c.angle else x for c, x in zip(where, size, strict=True)]
        out.append(Shape(project(here - at, space), slopes, np.array(reach)))
    return out


def _likeness(name: str, change: Projected, other: str, span: Sequence[Shape]) -> Likeness:
    size2 = max(change.dot(change), 1e-300)
    best = 0.0
    for shape in span:
        amount = shape.change.dot(change) / max(shape.change.dot(shape.change), 1e-300)
        bound = np.append(np.inf, np.maximum(abs(amount) * shape.reach, 1e-300))
        factor = np.linalg.cholesky(_regular(gram([shape.change, *shape.slopes, change]))).T
        fit = lsq_linear(factor[:, :-1], factor[:, -1], (-bound, bound))
        best = max(best, 1.0 - 2.0 * float(fit.cost) / size2)
    cosine = min(best, 1.0) ** 0.5
    left = max(1.0 - cosine**2, 1e-4) ** 0.5
    return Likeness(name, other, cosine, float((2.0 * log(20.0)) ** 0.5 / left))


def _regular(normal: Floats) -> Floats:
    """With a trace of what makes it positive definite."""
    return np.asarray(normal + np.diag(1e-9 * np.diag(normal) + 1e-300))
