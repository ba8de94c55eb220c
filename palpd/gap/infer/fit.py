"""The best parameters û of a set of effects: Gauss-Newton, with everything within specification integrated out."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from palpd.cell.cell_file import EffectValues
from palpd.gap.assumptions import ASSUMED
from palpd.gap.gaussian.nuisances import Projected, gram, project
from palpd.gap.model.coordinates import Coordinate, coordinates, coordinates_of, inside, values_at
from palpd.gap.model.linearise import Linearisation, linearise
from palpd.gap.model.problem import MODULUS, Problem
from palpd.tick import Floats

GAIN_TO_STOP = 0.02
"""Gain of one iteration, in squared sigmas, below which an optimum has been reached: it is one hundredth of a nat."""

CONVERGED_SD = 0.1
"""Move of the shared deviations between two linearisations below which the nuisances have converged, in standard deviations."""


LEAST_MODULUS_FACTOR = 0.01
"""Least factor of a modulus from one linearisation to the next: a linear step may lead below zero."""

LARGEST_MOVE = 2.0
"""Largest move of a coordinate in one iteration: two units, or a factor of seven."""


@dataclass(frozen=True)
class Optimum:
    """Parameters of a set of effects at which the squared residual is least.

    Attributes:
        where: The k parameters.
        u: Their coordinates û (k,).
        misfit: rᵀPr: the squared whitened residual with the nuisances projected out.
        prediction: Whitened prediction f (7, b) there.
        linearisation: State η₀ and nuisances A that were held fixed meanwhile.
    """

    where: tuple[Coordinate, ...]
    u: Floats
    misfit: float
    prediction: Floats
    linearisation: Linearisation

    @property
    def names(self) -> tuple[str, ...]:
        """Ids of the effects."""
        return tuple(dict.fromkeys(c.effect for c in self.where))

    @property
    def values(self) -> EffectValues:
        """Parameters θ by effect."""
        return values_at(self.where, self.u)


def fit_values(problem: Problem, start: EffectValues, linearisation: Linearisation, *, iterations: int = 8, rounds: int = 0) -> Optimum:
    """The best parameters of a set of effects: û with A fixed, then η₀ and A at the optimum, and so on.

    Args:
        start: Parameters by effect at which the search starts; empty for a cell without effects.
        linearisation: State and nuisances to begin with.
        iterations: Largest number of iterations of the first search; later searches have half as many.
        rounds: Largest number of times that the nuisances are linearised again at the optimum. Fewer do where η has converged.
    """
    where = coordinates(start, problem.library, problem.scale)
    best = gauss_newton(problem, linearisation, where, coordinates_of(where, start), iterations)
    for _ in range(rounds):
        residual = problem.data + linearisation.offset() - best.prediction
        eta = linearisation.space.coefficients(residual)[: len(linearisation.eta)]
        eta = _with_modulus_by_its_factor(problem, linearisation.eta, eta)
        eta = np.clip(eta, linearisation.eta - ASSUMED.search.largest_step_sd, linearisation.eta + ASSUMED.search.largest_step_sd)
        eta = np.clip(eta, -ASSUMED.search.largest_deviation_sd, ASSUMED.search.largest_deviation_sd)
        move = np.abs(eta - linearisation.eta).max()
        linearisation = linearise(problem, best.values, eta)
        best = gauss_newton(problem, linearisation, where, best.u, max(2, iterations // 2))
        if move < CONVERGED_SD:
            break
    return best


def _with_modulus_by_its_factor(problem: Problem, before: Floats, linear: Floats) -> Floats:
    """Shared deviations (11,) after a linear step, the logarithm of the modulus moved so that the force grows as that step says."""
    factor = 1.0 + (linear - before) * problem.shared_sd
    step = np.log(np.maximum(factor, LEAST_MODULUS_FACTOR)) / np.maximum(problem.shared_sd, 1e-300)
    return np.where(MODULUS, before + step, linear)


def gauss_newton(problem: Problem, linearisation: Linearisation, where: tuple[Coordinate, ...], u: Floats, iterations: int) -> Optimum:
    """Damped Gauss-Newton (Levenberg 1944, Marquardt 1963) with fixed nuisances.

    Args:
        linearisation: State η₀ and nuisances A that stay fixed.
        where: The k parameters.
        u: Coordinates (k,) at which the search starts.
        iterations: Largest number of steps.
    """
    target = problem.data + linearisation.offset()

    def residual_at(u: Floats) -> tuple[Floats, Projected, float]:
        at = problem.predict(values_at(where, u), linearisation.eta)
        r = project(target - at, linearisation.space)
        return at, r, r.dot(r)

    u = inside(where, u)
    at, r, misfit = residual_at(u)
    damping = 1e-3
    for _ in range(iterations):
        columns = [project(j, linearisation.space) for j in jacobian_at(problem, where, u, linearisation.eta, at)]
        normal = gram(columns)
        slope = np.array([j.dot(r) for j in columns])
        for _ in range(5):
            diagonal = np.diag(normal)
            lhs = normal + np.diag(damping * diagonal + 1e-12 * max(diagonal.max(initial=0.0), 1e-300))
            move = np.linalg.lstsq(lhs, slope, rcond=None)[0]
            trial = inside(where, u + np.clip(move, -LARGEST_MOVE, LARGEST_MOVE))
            at_trial, r_trial, misfit_trial = residual_at(trial)
            if misfit_trial < misfit:
                break
            damping = max(damping, 1e-4) * 10.0
        else:
            break
        gained = misfit - misfit_trial
        u, at, r, misfit = trial, at_trial, r_trial, misfit_trial
        damping = max(damping * 0.1, 1e-6)
        if gained < GAIN_TO_STOP:
            break
    return Optimum(where, u, misfit, at, linearisation)


def jacobian_at(problem: Problem, where: Sequence[Coordinate], u: Floats, eta: Floats, at: Floats) -> list[Floats]:
    """J: slopes ∂f/∂u of the whitened prediction, by forward differences.

    Args:
        where: The k parameters.
        u: Their coordinates (k,).
        eta: Shared deviations η₀ (11,) in standard deviations.
        at: The whitened prediction f (7, b) there.

    Returns:
        k slopes (7, b).
    """
    out = []
    for k, c in enumerate(where):
        h = _difference(c, float(u[k]), problem.scale.duration_s)
        if not c.angle and u[k] + h > c.to(c.upper):
            h = -h
        there = u.copy()
        there[k] += h
        out.append((problem.predict(values_at(where, there), eta) - at) / h)
    return out


def _difference(c: Coordinate, u: float, duration_s: float) -> float:
    """Step of a forward difference, in u."""
    if c.parameter.unit == "Hz" and c.parameter.log:
        # One hundredth of a frequency may be many turns at the end of a recording.
        return 1e-2 / max(1.0, float(np.exp(min(u, 300.0))) * duration_s)
    if c.parameter.log or c.angle:
        return 1e-2 / (c.scale if c.angle else 1.0)
    return 1e-2 * max(abs(u), 0.1)
