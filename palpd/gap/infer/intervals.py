"""Intervals of the parameters of a hypothesis, over all laws that its effects may follow, and as far as the residual says."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
from scipy.optimize import brentq
from scipy.special import ndtr

from palpd.gap.assumptions import ASSUMED
from palpd.gap.gaussian.nuisances import gram, project, stable_inverse
from palpd.gap.infer.evidence import Fit, PossibleLaw, fit
from palpd.gap.infer.fit import gauss_newton, jacobian_at
from palpd.gap.model.coordinates import Coordinate
from palpd.gap.model.linearise import linearise
from palpd.gap.model.problem import Problem
from palpd.tick import Floats

PARABOLIC = 0.03
"""Relative error of the rise of the residual's norm at the end of an interval below which the end is accepted."""

MOST_STEPS = 4
"""Most steps to the end of an interval; most take one."""


@dataclass(frozen=True)
class NamedFit:
    """A hypothesis by the parameters that files can state.

    Attributes:
        parameters: Every parameter by effect: its value and the ends of its 95 % interval, in its unit.
        at_bound: By effect the parameters at the end of their range, or beyond their natural size.
    """

    fit: Fit
    parameters: Mapping[str, dict[str, tuple[float, float, float]]]
    at_bound: Mapping[str, list[str]]


def named_fit(problem: Problem, one: Fit) -> NamedFit:
    """A hypothesis by the parameters that files can state, with their intervals."""
    best = by_named_parameters(problem, one)
    parameters: dict[str, dict[str, tuple[float, float, float]]] = {name: {} for name in best.names}
    at_bound: dict[str, list[str]] = {name: [] for name in best.names}
    for k, c in enumerate(best.where):
        value = best.values[c.effect][c.parameter.name]
        parameters[c.effect][c.parameter.name] = (value, *interval(problem, best, k))
        if not (c.angle or c.fixed) and _at_bound(c, value):
            at_bound[c.effect].append(c.parameter.name)
    return NamedFit(best, parameters, at_bound)


def by_named_parameters(problem: Problem, one: Fit) -> Fit:
    """The hypothesis with the parameters that files can state, fitted again if it has others.

    A parameter without a name in files chooses among several forms of an effect's law, and counts as a nuisance.
    """
    values = {
        name: {parameter.name: mine[parameter.name] for parameter in problem.library[name].named_parameters if parameter.name in mine}
        for name, mine in one.values.items()
    }
    return one if values == one.values else fit(problem, values, linearise(problem, values, one.eta), rounds=1)


def _at_bound(c: Coordinate, value: float) -> bool:
    """Whether a value is at the end of its range, other than zero, or beyond its natural size."""
    margin = 1e-9 * max(abs(c.lower), abs(c.upper))
    if (value <= c.lower + margin and c.lower != 0) or value >= c.upper - margin:
        return True
    return c.parameter.natural is not None and abs(value) >= c.parameter.natural


def half_width(laws: Sequence[PossibleLaw], k: int) -> float:
    """Distance from coordinate `k` of û within which its true value lies with the probability `naming.covered`.

    û is the optimum of the listed law. Where the law is off, the optimum with its discrepancy lies elsewhere, and that distance belongs to
    the uncertainty. So this averages over the laws.
    """
    weight = np.array([law.probability for law in laws])
    move = np.array([law.move[k] for law in laws])
    sd = np.sqrt(np.maximum([law.covariance()[k, k] for law in laws], 1e-300))

    def missed(half: float) -> float:
        return float(weight @ (ndtr((half - move) / sd) - ndtr((-half - move) / sd))) - ASSUMED.naming.covered

    most = float((np.abs(move) + 6.0 * sd).max())
    return float(brentq(missed, 0.0, most, rtol=1e-3)) if missed(most) > 0.0 else most


def interval(problem: Problem, one: Fit, k: int) -> tuple[float, float]:
    """Ends of the interval of parameter `k` of a hypothesis, in its unit; of an angle they may exceed its range."""
    c = one.where[k]
    value = one.values[c.effect][c.parameter.name]
    if c.fixed:
        return value, value
    half = half_width(one.laws, k)
    if c.angle:
        return value - half * c.scale, value + half * c.scale
    profile = _Profile.of(problem, one, k)
    ends = [c.back(profile.end(sign * half)) for sign in (-1.0, 1.0)]
    return min(*ends, value), max(*ends, value)


@dataclass(frozen=True)
class _Profile:
    """The residual's norm along coordinate `k`, all other coordinates fitted again.

    Attributes:
        follow: Change (n,) of all n coordinates for a unit of this one, to first order.
        sd: Standard deviation of the coordinate under the listed law.
    """

    problem: Problem
    one: Fit
    k: int
    follow: Floats
    sd: float

    @staticmethod
    def of(problem: Problem, one: Fit, k: int) -> "_Profile":
        around = one.linearisation
        at = problem.predict(one.values, around.eta)
        normal = gram([project(j, around.space) for j in jacobian_at(problem, one.where, one.u, around.eta, at)])
        covariance = stable_inverse(normal)
        variance = float(covariance[k, k])
        return _Profile(problem, one, k, covariance[:, k] / max(variance, 1e-300), sqrt(max(variance, 0.0)))

    def end(self, distance: float) -> float:
        """The coordinate at which the squared residual has risen by the amount that its parabola predicts at `distance` from û.

        Where the residual does not rise, since the search ended next to its minimum, the end lies further away.
        """
        c, best = self.one.where[self.k], float(self.one.u[self.k])
        enough = abs(distance) / self.sd if self.sd > 0.0 else 0.0

        def at(stretch: float) -> float:
            return c.to(c.back(best + stretch * distance))  # inside the range

        if enough == 0.0 or at(1.0) == best or abs(self._rise(at(1.0), iterations=0) - enough) <= PARABOLIC * enough:
            return at(1.0)
        before, rise_before, stretch = 0.0, 0.0, 1.0
        for _ in range(MOST_STEPS):
            rise = self._rise(at(stretch), iterations=2)
            if abs(rise - enough) <= PARABOLIC * enough:
                break
            slope = (rise - rise_before) / (stretch - before)
            further = stretch + (enough - rise) / slope if slope > 0.0 else 2.0 * stretch
            before, rise_before = stretch, rise
            stretch = float(
                np.clip(
                    further,
                    max(0.5 * stretch, 1.0 / ASSUMED.naming.largest_interval_stretch),
                    min(2.0 * stretch, ASSUMED.naming.largest_interval_stretch),
                )
            )
            if at(stretch) == at(before):
                break
        return at(stretch)

    def _rise(self, x: float, iterations: int) -> float:
        """Square root of the rise of the squared residual at x; the others take `iterations` steps. 0 where it does not rise."""
        one = self.one
        value = one.where[self.k].back(x)
        where = tuple(c.held_at(value) if j == self.k else c for j, c in enumerate(one.where))
        start = one.u + self.follow * (x - float(one.u[self.k]))
        there = gauss_newton(self.problem, one.linearisation, where, start, iterations if len(where) > 1 else 0)
        return sqrt(max(there.misfit - one.misfit, 0.0))
