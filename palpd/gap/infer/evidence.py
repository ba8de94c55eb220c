"""Stage 4 of a diagnosis: how likely the data are under one hypothesis, a set of effects at its best."""

from collections.abc import Callable
from dataclasses import dataclass
from math import lgamma, log, pi

import numpy as np

from palpd.cell.cell_file import EffectValues
from palpd.cell.effects import Scale
from palpd.gap.gaussian.nuisances import Nuisances, gram, project, stable_inverse
from palpd.gap.infer.discrepancy import P_EXACT_LAW, model_discrepancies
from palpd.gap.infer.fit import Optimum, fit_values
from palpd.gap.model.coordinates import Coordinate
from palpd.gap.model.linearise import Linearisation
from palpd.gap.model.problem import Problem
from palpd.tick import Floats

LOG_SIZE_RANGE = 7.0
"""Width of the prior of an effect's size in sigmas, log-uniform: e^7 is a factor of a thousand."""

CONTRARY_NATS = 4.0
"""Price of an amplitude with the sign that is possible but not typical of its effect (a reading that creeps down under load)."""


@dataclass(frozen=True)
class PossibleLaw:
    """A law that the effects of a hypothesis may follow: the listed one, or that with a discrepancy.

    Attributes:
        probability: Its posterior probability.
        move: Move (k,) of the coordinates from the optimum of the listed law.
        of_fit: Gives the covariance (k, k) of the coordinates as the fit sees it.
        owned: Products (k, m) of the slopes with the deviations within tolerance that the effects stand for.
    """

    probability: float
    move: Floats
    of_fit: Callable[[], Floats]
    owned: Floats

    def covariance(self) -> Floats:
        """Covariance (k, k) of the coordinates under it: the fit sees the sum of an effect and of the deviation that it stands for."""
        of_fit = self.of_fit()
        shift = of_fit @ self.owned
        return np.asarray(of_fit + shift @ shift.T)


@dataclass(frozen=True)
class Fit:
    """A hypothesis at its best, and how likely the data are under it.

    Attributes:
        names: Its effects.
        values: Their parameters.
        where: The k free parameters.
        u: Their coordinates (k,).
        covariance: Covariance (k, k) of the coordinates under the likeliest law.
        laws: All laws that the effects may follow, the listed one first.
        sizes: Size of each effect, in sigmas, that nothing within specification hides.
        change: What the effects do to the whitened prediction (7, b).
        residual: Data minus prediction (7, b), whitened.
        remainder: The residual without what the nuisances explain (7, b).
        misfit: Squared whitened residual of the exact laws.
        log_exact: Log likelihood with exact laws at their best parameters.
        log_likelihood: Log likelihood with laws of any discrepancy.
        occam: Log of prior times posterior volume of the parameters.
        discrepancy_energy: Squared sigmas by which the most likely laws differ from the exact ones, beyond what tolerances hide.
        linearisation: The nuisances.
    """

    names: tuple[str, ...]
    values: EffectValues
    where: tuple[Coordinate, ...]
    u: Floats
    covariance: Floats
    laws: tuple[PossibleLaw, ...]
    sizes: dict[str, float]
    change: Floats
    residual: Floats
    remainder: Floats
    misfit: float
    log_exact: float
    log_likelihood: float
    occam: float
    discrepancy_energy: float
    linearisation: Linearisation

    @property
    def eta(self) -> Floats:
        """Shared deviations (11,) around which it was fitted, in standard deviations."""
        return self.linearisation.eta

    @property
    def log_evidence(self) -> float:
        """Log evidence with laws of any discrepancy."""
        return self.occam + self.log_likelihood


def fit(problem: Problem, start: EffectValues, around: Linearisation, *, iterations: int = 8, rounds: int = 0) -> Fit:
    """Fit a set of effects and weigh it.

    Args:
        problem: The data and their prediction.
        start: Parameters by effect at which the search starts; empty for a cell without effects.
        around: Nuisances to begin with.
        iterations: Most iterations of the first search.
        rounds: Number of times that the nuisances are linearised again.

    Returns:
        The hypothesis at its best.
    """
    return laplace_evidence(problem, fit_values(problem, start, around, iterations=iterations, rounds=rounds))


def laplace_evidence(problem: Problem, best: Optimum) -> Fit:
    """Laplace's approximation of the evidence of a hypothesis, over parameters, nuisances and model discrepancies.

    Args:
        problem: The data and their prediction.
        best: The optimum under the exact laws.
    """
    space, at, eta = best.around.space, best.prediction, best.around.eta
    residual = problem.data + best.around.offset() - at
    log_exact = -0.5 * best.misfit - 0.5 * space.log_determinant
    slopes = [project(j, space) for j in best.jacobian]
    normal = gram(slopes)
    occam, covariance, change = 0.0, np.zeros((0, 0)), np.zeros_like(at)
    sizes = _sizes(problem, best)
    log_likelihood, discrepancy_energy = log_exact, 0.0
    laws: list[PossibleLaw] = []
    if best.names:
        occam, covariance = _occam(problem, best, normal, sizes)
        change = at - problem.predict({}, eta)
        discrepancies = model_discrepancies(problem, best, project(residual, space), slopes, normal)
        each = np.array([log(P_EXACT_LAW), *(one.log_prior + one.gain for one in discrepancies)])
        total = float(np.logaddexp.reduce(each))
        if discrepancies:
            log_likelihood = log_exact + total
            if likeliest := int(np.argmax(each)):
                discrepancy_energy = _unfittable_energy(discrepancies[likeliest - 1].change(), best.jacobian, space)
        projected = [project(change, space) for change in best.around.owned]
        owned = np.array([[slope.dot(one) for one in projected] for slope in slopes])
        listed = covariance
        fitted = [(np.zeros(len(best.u)), lambda: listed), *((one.move, one.covariance) for one in discrepancies)]
        laws = [PossibleLaw(p, *of_law, owned) for p, of_law in zip(np.exp(each - total).tolist(), fitted, strict=True)]
        covariance = max(laws, key=lambda law: law.probability).covariance()
    return Fit(
        names=best.names,
        values=best.values,
        where=best.where,
        u=best.u,
        covariance=covariance,
        laws=tuple(laws),
        sizes=sizes,
        change=change,
        residual=residual,
        remainder=residual - space.explained(space.coefficients(residual)),
        misfit=best.misfit,
        log_exact=log_exact,
        log_likelihood=log_likelihood,
        occam=occam,
        discrepancy_energy=discrepancy_energy,
        linearisation=best.around,
    )


def _unfittable_energy(change: Floats, jacobian: list[Floats], space: Nuisances) -> float:
    """Energy of a change that neither the parameters nor tolerances could have made."""
    slopes = np.array([j.ravel() for j in jacobian]).T
    rest = change.ravel() - slopes @ np.linalg.lstsq(slopes, change.ravel(), rcond=1e-9)[0]
    return float((space.beyond(rest.reshape(change.shape)) ** 2).sum())


def _sizes(problem: Problem, best: Optimum) -> dict[str, float]:
    """Norm of the change that each effect makes beside the others, with everything within specification projected out."""
    out = {}
    for name in best.values:
        others = {other: v for other, v in best.values.items() if other != name}
        change = project(best.prediction - problem.predict(others, best.around.eta), best.around.space)
        out[name] = max(change.dot(change), 0.0) ** 0.5
    return out


def _occam(problem: Problem, best: Optimum, normal: Floats, sizes: dict[str, float]) -> tuple[float, Floats]:
    """Log of prior times posterior volume, and the covariance of the coordinates.

    The prior is the same for every effect in what matters: its size in sigmas is log-uniform, its direction among several amplitudes
    uniform, and its shapes are uniform over their range.
    """
    where, values = best.where, best.values
    # The prior range binds a coordinate that the data do not bind.
    widths = np.array([1.0 if c.fixed else 1e3 if c.amplitude else c.range / 3.46 for c in where])
    full = normal + np.diag(1.0 / widths**2)
    sign, log_det = np.linalg.slogdet(full)
    volume = 0.5 * (sum(not c.fixed for c in where) * log(2.0 * pi) - (log_det if sign > 0 else 0.0))
    prior = -sum(log(len(c.parameter.choices)) for c in where if c.fixed)
    for name in values:
        index = [k for k, c in enumerate(where) if c.effect == name]
        amplitudes = [k for k in index if where[k].amplitude]
        m = len(amplitudes)
        size = max(sizes[name], 1.0)
        if m:
            _, log_density = np.linalg.slogdet(normal[np.ix_(amplitudes, amplitudes)] + 1e-12 * np.eye(m))
            sphere = log(2.0) + 0.5 * m * log(pi) - lgamma(0.5 * m)
            prior += -log(LOG_SIZE_RANGE) - m * log(size) - sphere + 0.5 * log_density
        prior -= sum(log(where[k].range) for k in index if not (where[k].amplitude or where[k].fixed))
        prior -= sum(_unnatural(where[k], values[name][where[k].parameter.name]) for k in index)
        prior -= CONTRARY_NATS * sum(_contrary(where[k], values[name][where[k].parameter.name], problem.scale) for k in amplitudes)
    return prior + volume, stable_inverse(full)


def _unnatural(c: Coordinate, value: float) -> float:
    """Nats by which a value is less probable for being larger than its natural size: normal beyond that, with half of it as its scale."""
    if c.parameter.natural is None:
        return 0.0
    return 0.5 * (max(abs(value) / c.parameter.natural - 1.0, 0.0) / 0.5) ** 2


def _contrary(c: Coordinate, value: float, scale: Scale) -> bool:
    """Whether an amplitude has the opposite sign of all its starting values."""
    return c.nominal == 0.0 and all(start * value < 0.0 for start in c.parameter.starts(scale))
