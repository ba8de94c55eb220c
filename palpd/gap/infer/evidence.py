"""Stage 4 of a diagnosis: how likely the data are under a hypothesis, a set of effects. Laplace's approximation at û."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import lgamma, log, pi

import numpy as np

from palpd.cell.cell_file import EffectValues
from palpd.cell.effects import Scale
from palpd.gap.assumptions import ASSUMED
from palpd.gap.gaussian.nuisances import Nuisances, gram, project, stable_inverse
from palpd.gap.infer.discrepancy import model_discrepancies
from palpd.gap.infer.fit import Optimum, fit_values, jacobian_at
from palpd.gap.model.coordinates import Coordinate
from palpd.gap.model.linearise import Linearisation
from palpd.gap.model.problem import Problem
from palpd.tick import Floats


@dataclass(frozen=True)
class PossibleLaw:
    """A law that the effects of a hypothesis may follow: the listed formulas, or these with a discrepancy.

    Attributes:
        probability: Posterior probability of this law, given the effects.
        move: Move v (k,) of the coordinates from the optimum û of the listed law; 0 for the listed law itself.
        normal: Inverse (k, k) of the covariance of u if the tolerances that the effects stand for were zero.
        of_tolerances: JᵀPB (k, p), with the slopes J, and the changes B by the p replaced tolerances
            (`Linearisation.tolerance_columns`).
    """

    probability: float
    move: Floats
    normal: Floats
    of_tolerances: Floats

    def covariance(self) -> Floats:
        """Covariance (k, k) of u: the data show only the sum of an effect and of the in-tolerance deviation that it stands for."""
        covariance = stable_inverse(self.normal)
        shift = covariance @ self.of_tolerances
        return covariance + shift @ shift.T


@dataclass(frozen=True)
class Fit:
    """A hypothesis at its best parameters, and how likely the data are under it.

    Attributes:
        names: Ids of its effects.
        where: The k parameters.
        u: Their coordinates û (k,).
        covariance: Covariance (k, k) of u under the likeliest law.
        laws: All laws that the effects may follow, the listed law first; empty without effects.
        sizes: Size s of each effect in sigmas: the norm of its change with the nuisances projected out.
        change: Change (7, b) of the whitened prediction by the effects.
        residual: Residual r = y - f + A (η₀, 0) (7, b), whitened.
        remainder: r - A ĉ (7, b): the residual without what the nuisances explain.
        misfit: rᵀPr in squared sigmas.
        log_exact: log L, the log likelihood with the listed laws at û, without n/2 log 2π.
        log_likelihood: log L*, averaged over model discrepancies.
        occam: log E - log P(set) - log L*: log of prior density times posterior volume.
        discrepancy_energy: Squared sigmas by which the likeliest law differs from the listed law, beyond what tolerances hide.
        linearisation: State η₀ and nuisances A of the fit.
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
        """Shared deviations η₀ (11,) of the linearisation, in standard deviations."""
        return self.linearisation.eta

    @property
    def log_evidence(self) -> float:
        """Log E without the prior of the set, log P(set)."""
        return self.occam + self.log_likelihood


def fit(
    problem: Problem,
    start: EffectValues,
    linearisation: Linearisation,
    *,
    iterations: int = 8,
    rounds: int = 0,
    laws: Sequence[PossibleLaw] = (),
) -> Fit:
    """Fit a set of effects (`fit_values`) and compute its evidence.

    Args:
        start: Parameters by effect at which the search starts; empty for a cell without effects.
        linearisation: State and nuisances to begin with.
        iterations: Largest number of iterations of the first search.
        rounds: Largest number of times that the nuisances are linearised again.
        laws: As in `laplace_evidence`.
    """
    return laplace_evidence(problem, fit_values(problem, start, linearisation, iterations=iterations, rounds=rounds), laws)


def laplace_evidence(problem: Problem, best: Optimum, laws: Sequence[PossibleLaw] = ()) -> Fit:
    """Laplace's approximation of the evidence of a hypothesis, over parameters, nuisances and model discrepancies.

    Args:
        best: The optimum û under the listed laws.
        laws: The laws that its effects may follow, where another noise says how well u is known; empty: as `problem` says.
    """
    linearisation, at = best.linearisation, best.prediction
    space, eta = linearisation.space, linearisation.eta
    residual = problem.data + linearisation.offset() - at
    log_exact = -0.5 * best.misfit - 0.5 * space.log_determinant
    jacobian = jacobian_at(problem, best.where, best.u, eta, at)
    slopes = [project(j, space) for j in jacobian]
    occam, covariance, change = 0.0, np.zeros((0, 0)), np.zeros_like(at)
    sizes = _sizes(problem, best)
    log_likelihood, discrepancy_energy = log_exact, 0.0
    if best.names:
        slopes_gram = gram(slopes)
        occam, normal = _occam(problem, best, slopes_gram, sizes)
        change = at - problem.predict({}, eta)
        discrepancies = model_discrepancies(problem, best, project(residual, space), slopes, slopes_gram)
        log_each = np.array([log(ASSUMED.law_error.p_exact), *(d.log_prior + d.gain for d in discrepancies)])
        total = float(np.logaddexp.reduce(log_each))
        if discrepancies:
            log_likelihood = log_exact + total
            if likeliest := int(np.argmax(log_each)):
                discrepancy_energy = _unfittable_energy(discrepancies[likeliest - 1].change, jacobian, space)
        replaced = [project(tolerance, space) for tolerance in linearisation.tolerance_columns]
        of_tolerances = np.array([[slope.dot(tolerance) for tolerance in replaced] for slope in slopes])
        fitted = [(np.zeros(len(best.u)), normal), *((d.move, d.normal) for d in discrepancies)]
        laws = laws or [PossibleLaw(p, *of_law, of_tolerances) for p, of_law in zip(np.exp(log_each - total).tolist(), fitted, strict=True)]
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
        remainder=space.remainder(residual),
        misfit=best.misfit,
        log_exact=log_exact,
        log_likelihood=log_likelihood,
        occam=occam,
        discrepancy_energy=discrepancy_energy,
        linearisation=linearisation,
    )


def _unfittable_energy(change: Floats, jacobian: list[Floats], space: Nuisances) -> float:
    """Energy, in squared sigmas, of the part of a change (7, b) that neither the parameters nor tolerances could have made."""
    slopes = np.array([j.ravel() for j in jacobian]).T
    rest = change.ravel() - slopes @ np.linalg.lstsq(slopes, change.ravel(), rcond=1e-9)[0]
    return float((space.beyond(rest.reshape(change.shape)) ** 2).sum())


def _sizes(problem: Problem, best: Optimum) -> dict[str, float]:
    """Norm of the change by each effect in a cell with the others, with everything within specification projected out."""
    out = {}
    for name in best.values:
        others = {other: v for other, v in best.values.items() if other != name}
        change = project(best.prediction - problem.predict(others, best.linearisation.eta), best.linearisation.space)
        out[name] = max(change.dot(change), 0.0) ** 0.5
    return out


def _occam(problem: Problem, best: Optimum, normal: Floats, sizes: dict[str, float]) -> tuple[float, Floats]:
    """Log π(û) + k/2 log 2π - ½ log det(JᵀPJ + W⁻²), and JᵀPJ + W⁻² (k, k).

    `normal` is JᵀPJ. All effects have the same kind of prior π: the size s in sigmas is log-uniform, the direction among several amplitudes
    is uniform, and shapes are uniform in u over their range.
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
        size = max(sizes[name], ASSUMED.prior.least_size_sd)
        if m:
            _, log_density = np.linalg.slogdet(normal[np.ix_(amplitudes, amplitudes)] + 1e-12 * np.eye(m))
            sphere = log(2.0) + 0.5 * m * log(pi) - lgamma(0.5 * m)
            prior += -log(ASSUMED.prior.log_size_range) - m * log(size) - sphere + 0.5 * log_density
        prior -= sum(log(where[k].range) for k in index if not (where[k].amplitude or where[k].fixed))
        prior -= sum(_unnatural(where[k], values[name][where[k].parameter.name]) for k in index)
        prior -= ASSUMED.prior.contrary_nats * sum(
            _contrary(where[k], values[name][where[k].parameter.name], problem.scale) for k in amplitudes
        )
    return prior + volume, full


def _unnatural(c: Coordinate, value: float) -> float:
    """Nats that a value beyond its natural size costs: the prior is normal there, with half of the natural size as its scale."""
    if c.parameter.natural is None:
        return 0.0
    return 0.5 * (max(abs(value) / c.parameter.natural - 1.0, 0.0) / ASSUMED.prior.natural_spread) ** 2


def _contrary(c: Coordinate, value: float, scale: Scale) -> bool:
    """Whether an amplitude has the opposite sign of all its starting values."""
    return c.nominal == 0.0 and all(start * value < 0.0 for start in c.parameter.starts(scale))
