"""Which effects a motion can distinguish, before anything is recorded: the angle between their changes."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import log

import numpy as np
from scipy.optimize import lsq_linear

from palpd.cell.cell_file import CellFile
from palpd.cell.effects import Effect
from palpd.gap.advise.motions import MotionLimits, TestMotion, blank_recording
from palpd.gap.assumptions import ASSUMED
from palpd.gap.gaussian.nuisances import Projected, gram, project
from palpd.gap.infer.fit import jacobian_at
from palpd.gap.model.coordinates import coordinates, coordinates_of, start_values
from palpd.gap.model.linearise import Linearisation, linearise
from palpd.gap.model.problem import NOMINAL_ETA, Problem, make_problem
from palpd.tick import Floats

ROWS_HZ, MAX_BINS = 250.0, 2500
"""Rate of the simulated motion, and its number of bins: a comparison needs less detail than a diagnosis."""


@dataclass(frozen=True)
class Similarity:
    """How much of an effect's change another effect can make.

    Attributes:
        cosine: Of the angle between the change by `effect` and the nearest change that `other` can make, the nuisances projected out.
        told_at_snr: Size s of the effect in sigmas (SNR) from which on the two are distinguished at odds of 20.
    """

    effect: str
    other: str
    cosine: float
    told_at_snr: float

    @property
    def words(self) -> str:
        """In words."""
        if self.cosine > ASSUMED.advice.one_direction:
            return f"indistinguishable by such a motion (distinguished from SNR {self.told_at_snr:.0f} on)"
        return f"distinguished from SNR {self.told_at_snr:.0f} on" if self.cosine > ASSUMED.advice.mostly_alike else "not similar"


@dataclass(frozen=True)
class Shape:
    """An effect with some parameters: its change, the slopes J of k parameters, and how far each coordinate may go (k,).

    A logarithmic parameter may double or halve, an angle may make half a turn to either side, and any other parameter may change by its own
    size. If an effect has several amplitudes, each may change by ten times its size.
    """

    change: Projected
    slopes: list[Projected]
    reach: Floats


def standard_motion(cell: CellFile) -> tuple[TestMotion, MotionLimits]:
    """Free strokes, holds and presses of three depths, scaled to the tip and the servo of a cell."""
    depth_m = cell.probe.tip_radius_m
    speed = 0.25 * depth_m * cell.robot.servo_natural_frequency_Hz
    limits = MotionLimits(
        depth_m=depth_m,
        force_N=np.inf,
        home_m=depth_m,
        stroke_m=4.0 * depth_m,
        press_speed_m_per_s=speed,
        free_speed_m_per_s=3.0 * speed,
        acceleration_m_per_s2=30.0 * speed,
    )
    motion = TestMotion(
        "standard",
        depths_m=(0.5 * depth_m, 0.75 * depth_m, depth_m),
        speed_m_per_s=speed,
        hold_s=4.0,
        repeats=2,
        height_m=depth_m,
        mode="both",
        strokes=3,
        stroke_m=limits.stroke_m,
        stroke_speed_m_per_s=limits.free_speed_m_per_s,
    )
    return motion, limits


def standard_heights(cell: CellFile) -> tuple[Floats, Floats]:
    """Times (n,) in s and commanded heights (n,) in m of the standard motion of a cell."""
    motion, limits = standard_motion(cell)
    surface_m = cell.tissue.surface_z_m if cell.tissue is not None else 0.0
    return motion.heights(1.0 / ROWS_HZ, surface_m, surface_m + limits.home_m, limits.acceleration_m_per_s2)


def similar_effects(effects: Sequence[Effect], cell: CellFile, library: Mapping[str, Effect], most: int = 4) -> list[Similarity]:
    """The effects of a library that are most similar to some effects, on the standard motion of a cell.

    Args:
        library: The effects to compare with, by id.
        most: Largest number of similar effects for each.

    Returns:
        The similarities, for each effect the most similar first; effects of the scatter have none.
    """
    t_s, z_cmd_m = standard_heights(cell)
    problem = make_problem([blank_recording(cell, t_s, z_cmd_m)], cell, library, MAX_BINS)
    base = linearise(problem, {}, NOMINAL_ETA)
    shapes = {name: list(_shapes(problem, other, base)) for name, other in library.items() if not other.scatter}
    out = []
    for effect in effects:
        if effect.scatter:
            continue
        values = start_values(effect, problem.scale, ())[0]
        change = project(problem.predict({effect.id: values}, NOMINAL_ETA) - base.prediction, base.space)
        similar = [_similarity(effect.id, change, other, those) for other, those in shapes.items() if other != effect.id and those]
        out += sorted(similar, key=lambda one: -one.cosine)[:most]
    return out


def _shapes(problem: Problem, effect: Effect, base: Linearisation) -> Iterator[Shape]:
    """The changes that an effect can make near each of its starting values."""
    eta = NOMINAL_ETA
    for values in start_values(effect, problem.scale, ()):
        where = coordinates({effect.id: values}, problem.library, problem.scale)
        at = problem.predict({effect.id: values}, eta)
        if not (at - base.prediction).any():
            continue
        u = coordinates_of(where, {effect.id: values})
        slopes = [project(slope, base.space) for slope in jacobian_at(problem, where, u, eta, at)]
        several = 10.0 if sum(c.amplitude for c in where) > 1 else 1.0  # they may differ from each other by any factor
        size = np.where([c.amplitude for c in where], several * np.abs(u), np.abs(u)).tolist()
        reach = [log(2.0) if c.parameter.log else np.pi / c.scale if c.angle else x for c, x in zip(where, size, strict=True)]
        yield Shape(project(at - base.prediction, base.space), slopes, np.array(reach))


def _similarity(name: str, change: Projected, other: str, shapes: Sequence[Shape]) -> Similarity:
    size2 = max(change.dot(change), 1e-300)
    best = 0.0
    for shape in shapes:
        amount = shape.change.dot(change) / max(shape.change.dot(shape.change), 1e-300)
        bound = np.append(np.inf, np.maximum(abs(amount) * shape.reach, 1e-300))
        factor = _factor(gram([shape.change, *shape.slopes, change]))
        fit = lsq_linear(factor[:, :-1], factor[:, -1], (-bound, bound), method="bvls")  # of a few columns: in half the time
        best = max(best, 1.0 - 2.0 * float(fit.cost) / size2)
    cosine = min(best, 1.0) ** 0.5
    sine = max(1.0 - cosine**2, 1e-4) ** 0.5
    return Similarity(name, other, cosine, float((2.0 * log(ASSUMED.advice.odds)) ** 0.5 / sine))


def _factor(normal: Floats) -> Floats:
    """A matrix F of full rank with FᵀF = normal.

    What is projected out may be 1e5 times as large as what remains, so rounding can make an eigenvalue negative.
    """
    size = np.sqrt(np.diag(normal) + 1e-300)
    values, vectors = np.linalg.eigh(normal / np.outer(size, size))
    return np.asarray((vectors * np.sqrt(np.maximum(values, 1e-9))).T * size)
