"""One hypothesis: a set of effects, fitted to a problem with everything within specification marginalised."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import product
from math import inf, lgamma, log, pi

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular

from palpd.cell_file import EffectValues
from palpd.effects import Effect, Parameter, Scale
from palpd.gap.gaussian import Nuisances, Projected, Widened, gram, project
from palpd.gap.problem import Linearisation, Problem
from palpd.tick import Floats

LOG_SIZE_RANGE = 7.0
"""An effect's size in sigmas is taken to be log-uniform over e^7, a thousand."""

CONTRARY = 4.0
"""How much less plausible, in nats, an effect is with the sign that it usually does not have."""

EXACT = 0.3
"""How probable it is that an effect follows its law exactly."""

INEXACT = ((0.02, 0.3), (0.06, 0.25), (0.12, 0.15))
"""How large, as a share of the effect, each way may be in which a real law differs from the library's, and how probable that is."""


BENDS = {"time": ("time",), "load": ("time", "depth"), "any": ("time", "depth", "speed", "rest")}
"""What a law may deviate by, for what an effect says of it."""


@dataclass(frozen=True)
class Coordinate:
    """One free parameter of a hypothesis, in a coordinate in which steps of 1 % are sensible."""

    effect: str
    parameter: Parameter
    lower: float
    upper: float
    scale: float
    nominal: float | None

    @property
    def amplitude(self) -> bool:
        """Whether it switches the effect off at its nominal value."""
        return self.nominal is not None

    def to(self, value: float) -> float:
        """Coordinate of a value."""
        return log(max(value, 1e-300)) if self.parameter.log else value / self.scale

    def back(self, u: float) -> float:
        """Value of a coordinate, inside the range."""
        value = float(np.exp(min(u, 700.0))) if self.parameter.log else u * self.scale
        return min(max(value, self.lower), self.upper)

    @property
    def angle(self) -> bool:
        """Whether it goes round."""
        return self.parameter.unit == "rad" and self.upper - self.lower > 6.28

    @property
    def range(self) -> float:
        """Length of the range in the coordinate."""
        return max(self.to(self.upper) - self.to(max(self.lower, 1e-300 if self.parameter.log else self.lower)), 1e-9)


def coordinates(effects: Iterable[Effect], scale: Scale) -> list[Coordinate]:
    """The free parameters of a set of effects, effect by effect."""
    out = []
    for effect in effects:
        for parameter in effect.parameters:
            lower, upper = parameter.bounds(scale)
            typical = max((abs(v) for v in parameter.starts(scale)), default=0.0) or max(abs(lower), abs(upper)) or 1.0
            out.append(Coordinate(effect.id, parameter, lower, upper, typical, parameter.nominal_value(scale)))
    return out


def values_at(where: Sequence[Coordinate], u: Floats) -> EffectValues:
    """The effects with these coordinates."""
    out: EffectValues = {}
    for c, x in zip(where, u.tolist(), strict=True):
        value = c.back(x)
        if c.angle:
            value = float((x * c.scale - c.lower) % (2.0 * pi) + c.lower)
        out.setdefault(c.effect, {})[c.parameter.name] = value
    return out


def start_values(effect: Effect, scale: Scale, peaks_Hz: Sequence[float], most: int = 32) -> list[dict[str, float]]:
    """Where to look for an effect first: every combination of its starting values, shapes also spread over their range."""
    lists = []
    for parameter in effect.parameters:
        starts = list(parameter.starts(scale))
        if parameter.nominal is None and parameter.log:
            lower, upper = parameter.bounds(scale)
            if upper > lower > 0:
                spread = np.geomspace(lower, upper, 7)[1:-1].tolist()
                starts = [*starts, *[s for s in spread if min(abs(log(s / v)) for v in starts) > 0.5]]
        if parameter.unit == "N" and parameter.nominal_value(scale) == inf:
            starts += [0.97 * scale.force_N, 0.9 * scale.force_N]  # a limit stands where the largest readings are
        if parameter.unit == "Hz":
            lower, upper = parameter.bounds(scale)
            starts = [*[f for f in peaks_Hz if lower < f < upper], *starts]
        lists.append(starts)
    names = [p.name for p in effect.parameters]
    combos = [dict(zip(names, combo, strict=True)) for combo in product(*lists)]
    if len(combos) > most:
        combos = [combos[k] for k in np.unique(np.linspace(0, len(combos) - 1, most).astype(int))]
    return combos


def stretched(effect: Effect, values: dict[str, float], factor: float, scale: Scale) -> dict[str, float]:
    """The effect made `factor` times as large, by its amplitudes."""
    out = dict(values)
    for parameter in effect.parameters:
        nominal = parameter.nominal_value(scale)
        if nominal is None:
            continue
        lower, upper = parameter.bounds(scale)
        value = values[parameter.name]
        if nominal == 0.0:
            value = value * factor
        elif nominal == inf:
            value = value / min(max(abs(factor), 0.03), 30.0)
        else:
            value = nominal * (value / nominal) ** min(max(factor, -5.0), 5.0)
        out[parameter.name] = min(max(value, lower), upper)
    return out


@dataclass(frozen=True)
class Fit:
    """A hypothesis at its best: the values of its effects, and how likely the data are under it.

    `log_exact` is the log likelihood of exact laws at their best values, `log_likelihood` that of laws as inexact as they may be, and
    `occam` the prior times the volume of the values. `change` (c, b) is what the effects do to the whitened prediction, `covariance`
    that of the coordinates; `misfit` the whitened squared residual of the exact laws, `remainder` what they leave, and `law_energy`
    how much the most likely laws differ from them beyond what tolerances hide, in squared sigmas.
    """

    names: tuple[str, ...]
    values: EffectValues
    where: tuple[Coordinate, ...]
    u: Floats
    eta: Floats
    covariance: Floats
    change: Floats
    size: float
    residual: Floats
    remainder: Floats
    law_energy: float
    misfit: float
    occam: float
    log_exact: float
    log_likelihood: float
    linearisation: Linearisation

    @property
    def log_evidence(self) -> float:
        """Log evidence, however inexact the laws are."""
        return self.occam + self.log_likelihood


def _step(c: Coordinate, u: float, duration_s: float) -> float:
    if c.parameter.unit == "Hz" and c.parameter.log:
        # A hundredth of a frequency may be many turns at the end of a recording.
        return 1e-2 / max(1.0, float(np.exp(min(u, 300.0))) * duration_s)
    if c.parameter.log or c.angle:
        return 1e-2 / (c.scale if c.angle else 1.0)
    return 1e-2 * max(abs(u), 0.1)


def jacobian_at(problem: Problem, where: Sequence[Coordinate], u: Floats, eta: Floats, at: Floats) -> list[Floats]:
    """Slopes of the prediction, which is `at` there, with every coordinate."""
    out = []
    for k, c in enumerate(where):
        h = _step(c, float(u[k]), problem.scale.duration_s)
        if not c.angle and u[k] + h > c.to(c.upper):
            h = -h
        there = u.copy()
        there[k] += h
        out.append((problem.predict(values_at(where, there), eta) - at) / h)
    return out


def _clip(where: Sequence[Coordinate], u: Floats) -> Floats:
    out = u.copy()
    for k, c in enumerate(where):
        if not c.angle:
            out[k] = c.to(c.back(float(u[k])))
    return out


def climb(
    problem: Problem, around: Linearisation, where: Sequence[Coordinate], u: Floats, iterations: int
) -> tuple[Floats, float, Floats, list[Floats]]:
    """Gauss-Newton with the nuisances of `around`: coordinates, squared residual, prediction and Jacobian there."""
    target = problem.data + around.offset()
    u = _clip(where, u)
    at = problem.predict(values_at(where, u), around.eta)
    r = project(target - at, around.space)
    misfit = r.dot(r)
    damping = 1e-3
    jacobian = jacobian_at(problem, where, u, around.eta, at)
    for _ in range(iterations):
        columns = [project(j, around.space) for j in jacobian]
        normal = gram(columns)
        slope = np.array([j.dot(r) for j in columns])
        better = False
        for _ in range(5):
            diagonal = np.diag(normal)
            lhs = normal + np.diag(damping * diagonal + 1e-12 * max(diagonal.max(initial=0.0), 1e-300))
            move = np.linalg.lstsq(lhs, slope, rcond=None)[0]
            trial = _clip(where, u + np.clip(move, -2.0, 2.0) * 1.0)
            there = problem.predict(values_at(where, trial), around.eta)
            r_there = project(target - there, around.space)
            m_there = r_there.dot(r_there)
            if m_there < misfit:
                better = True
                break
            damping = max(damping, 1e-4) * 10.0
        if not better:
            break
        gained = misfit - m_there
        u, at, r, misfit = trial, there, r_there, m_there
        damping = max(damping * 0.1, 1e-6)
        jacobian = jacobian_at(problem, where, u, around.eta, at)
        if gained < 0.02:
            break
    return u, misfit, at, jacobian


def fit(
    problem: Problem,
    names: tuple[str, ...],
    start: EffectValues,
    around: Linearisation,
    *,
    iterations: int = 8,
    rounds: int = 0,
) -> Fit:
    """The best values of a set of effects from `start`; `rounds` times the nuisances are linearised again at what was found."""
    where = coordinates([problem.library[name] for name in names], problem.scale)
    u = np.array([c.to(start[c.effect][c.parameter.name]) for c in where])
    u, misfit, at, jacobian = climb(problem, around, where, u, iterations)
    for _ in range(rounds):
        left = problem.data + around.offset() - at
        eta = around.space.coefficients(left)[: len(around.eta)]
        around = problem.linearise(values_at(where, u), np.clip(eta, around.eta - 4.0, around.eta + 4.0))
        u, misfit, at, jacobian = climb(problem, around, where, u, max(2, iterations // 2))
    return judge(problem, names, where, u, misfit, at, jacobian, around)


def judge(
    problem: Problem,
    names: tuple[str, ...],
    where: Sequence[Coordinate],
    u: Floats,
    misfit: float,
    at: Floats,
    jacobian: list[Floats],
    around: Linearisation,
) -> Fit:
    """Laplace evidence of a hypothesis at its best, its laws taken as exact and as more or less inexact."""
    values = values_at(where, u)
    space = around.space
    residual = problem.data + around.offset() - at
    remainder = residual - space.explained(space.coefficients(residual))
    exact = -0.5 * misfit - 0.5 * space.log_determinant
    if not names:
        none, nothing = np.zeros((0, 0)), np.zeros_like(at)
        return Fit(names, values, (), u, around.eta, none, nothing, 0.0, residual, remainder, 0.0, misfit, 0.0, exact, exact, around)
    change = at - problem.predict({}, around.eta)
    seen = project(change, space)
    columns = [project(j, space) for j in jacobian]
    normal = gram(columns)
    occam, covariance = _occam(problem, names, where, values, normal, around)
    law_energy, likelihood = 0.0, exact
    if bent := _bent(problem, where, u, values, at, project(residual, space), jacobian, columns, normal, around):
        every = np.array([log(EXACT), *(b.log_share + b.gained for b in bent)])
        likelihood = exact + float(np.logaddexp.reduce(every))
        if best := int(np.argmax(every)):
            law_energy = _unfittable(bent[best - 1].bend(), jacobian, space)
            covariance = bent[best - 1].covariance
    return Fit(
        names,
        values,
        tuple(where),
        u,
        around.eta,
        covariance,
        change,
        max(seen.dot(seen), 0.0) ** 0.5,
        residual,
        remainder,
        law_energy,
        misfit,
        occam,
        exact,
        likelihood,
        around,
    )


@dataclass(frozen=True)
class Bent:
    """Laws bent so far as to fit best: how probable that is beforehand, what it gains in log likelihood, the bend (c, b), and the
    values' covariance then."""

    log_share: float
    gained: float
    bend: Callable[[], Floats]
    covariance: Floats


def _bent(
    problem: Problem,
    where: Sequence[Coordinate],
    u: Floats,
    values: EffectValues,
    at: Floats,
    r: Projected,
    jacobian: list[Floats],
    columns: list[Projected],
    normal: Floats,
    around: Linearisation,
) -> list[Bent]:
    """The laws bent in one kind of way or in all, as much as each of INEXACT says. The values may move while the laws bend, by a
    Gauss-Newton step; what such a step promises without any bend, the climb has found not to be there."""
    law, kind = law_columns(problem, values, at, around)
    if not len(law):
        return []
    wide = Widened.by(around.space, law)
    against_r = wide.against(r)
    against_j = np.array([wide.against(j) for j in columns]).T
    slope = np.array([j.dot(r) for j in columns])
    reach = np.diag([_reach(c, x) ** -2 for c, x in zip(where, u.tolist(), strict=True)])
    promised = 0.5 * float(slope @ np.linalg.solve(normal + reach, slope))
    ways = [kind == k for k in np.unique(kind)]
    if len(ways) > 1:
        ways.append(np.ones(len(kind), dtype=bool))

    def one(way: NDArray[np.bool_], size: float, share: float) -> Bent:
        factor = cholesky(np.eye(int(way.sum())) + size**2 * wide.squares[np.ix_(way, way)], lower=True)
        of_r, of_j = (size * solve_triangular(factor, x[way], lower=True) for x in (against_r, against_j))
        inner = normal - of_j.T @ of_j
        pull = slope - of_j.T @ of_r
        move = np.linalg.solve(inner + reach, pull)
        gained = 0.5 * (float(of_r @ of_r) + float(pull @ move)) - promised - float(np.log(np.diag(factor)).sum())

        def bend() -> Floats:
            coefficients = size * solve_triangular(factor, of_r - of_j @ move, lower=True, trans="T")
            bent = np.tensordot(coefficients, law[way], axes=1) + np.tensordot(move, np.array(jacobian), axes=1)
            return np.asarray(bent)

        return Bent(log(share / len(ways)), gained, bend, _inverse(inner))

    return [one(way, size, share) for size, share in INEXACT for way in ways]


def _reach(c: Coordinate, u: float) -> float:
    """How far a parameter moves when its law bends: by about half of itself."""
    if c.parameter.log:
        return 0.5
    return 0.5 / c.scale if c.angle else 0.5 * max(abs(u), 1e-3)


def _unfittable(bend: Floats, jacobian: list[Floats], space: Nuisances) -> float:
    """Energy of a change that neither the parameters nor tolerances could have made."""
    slopes = np.array([j.ravel() for j in jacobian]).T
    rest = bend.ravel() - slopes @ np.linalg.lstsq(slopes, bend.ravel(), rcond=1e-9)[0]
    return float((space.beyond(rest.reshape(bend.shape)) ** 2).sum())


def _inverse(normal: Floats) -> Floats:
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    return np.asarray(np.linalg.pinv(normal / np.outer(scale, scale), rcond=1e-9, hermitian=True) / np.outer(scale, scale))


def _occam(
    problem: Problem,
    names: tuple[str, ...],
    where: Sequence[Coordinate],
    values: EffectValues,
    normal: Floats,
    around: Linearisation,
) -> tuple[float, Floats]:
    """Log of prior × posterior volume. The prior is the same for every effect in what matters: its size in sigmas is log-uniform, its
    direction among several amplitudes uniform, its shapes uniform over their range."""
    # A coordinate that the data do not bind is bound by its prior range.
    widths = np.array([1e3 if c.amplitude else c.range / 3.46 for c in where])
    full = normal + np.diag(1.0 / widths**2)
    sign, log_det = np.linalg.slogdet(full)
    volume = 0.5 * (len(where) * log(2.0 * pi) - (log_det if sign > 0 else 0.0))
    prior = 0.0
    complete = problem.predict(values, around.eta) if len(names) > 1 else None
    for name in names:
        index = [k for k, c in enumerate(where) if c.effect == name]
        amplitudes = [k for k in index if where[k].amplitude]
        m = len(amplitudes)
        others = {other: v for other, v in values.items() if other != name}
        at = complete if complete is not None else problem.predict(values, around.eta)
        change = project(at - problem.predict(others, around.eta), around.space)
        size = max(change.dot(change), 1.0) ** 0.5
        if m:
            _, log_density = np.linalg.slogdet(normal[np.ix_(amplitudes, amplitudes)] + 1e-12 * np.eye(m))
            sphere = log(2.0) + 0.5 * m * log(pi) - lgamma(0.5 * m)
            prior += -log(LOG_SIZE_RANGE) - m * log(size) - sphere + 0.5 * log_density
        prior -= sum(log(where[k].range) for k in index if not where[k].amplitude)
        prior -= CONTRARY * sum(_contrary(where[k], values[name][where[k].parameter.name], problem.scale) for k in amplitudes)
    return prior + volume, _inverse(full)


def _contrary(c: Coordinate, value: float, scale: Scale) -> bool:
    """Whether an amplitude has a sign that is possible but not typical of its effect (a reading that creeps down under load)."""
    return c.nominal == 0.0 and all(start * value < 0.0 for start in c.parameter.starts(scale))


def law_columns(problem: Problem, values: EffectValues, at: Floats, around: Linearisation) -> tuple[Floats, NDArray[np.str_]]:
    """Ways in which the effects' real laws may differ from the library's: stronger or weaker with depth, speed, direction, time and
    since the motion changed, and mixed with the same law at other shapes. Each is as large as what of the effect tolerances
    do not hide, or smaller. Columns (m, c, b), and of what kind (m,) each is."""
    out, kinds = [], []
    complete = at
    for name in values:
        others = {other: v for other, v in values.items() if other != name}
        part = complete - problem.predict(others, around.eta)
        energy = float(np.linalg.norm(around.space.beyond(part)))
        if energy < 1.0:
            continue
        live = np.flatnonzero(part.any(axis=1))
        shapes: list[tuple[str, Floats]] = []
        for parameter in problem.library[name].parameters:
            if parameter.nominal is None and parameter.log:
                lower, upper = parameter.bounds(problem.scale)
                for factor in (0.2, 0.45, 2.2, 5.0):
                    other = min(max(values[name][parameter.name] * factor, lower), upper)
                    bent = problem.predict(values | {name: values[name] | {parameter.name: other}}, around.eta)
                    shapes.append(("shape", bent - complete))
        for kind, basis in _modulations(problem):
            if kind not in BENDS[problem.library[name].bends]:
                continue
            shape = np.zeros_like(part)
            shape[live] = part[live] * basis
            shapes.append((kind, shape))
        if len(live) > 1:
            for channel in live:
                shape = np.zeros_like(part)
                shape[channel] = part[channel]
                shapes.append(("channel", shape))
        for kind, shape in shapes:
            norm = float(np.vdot(shape, shape)) ** 0.5
            if norm > 1e-6 * energy:
                out.append(shape * min(energy / norm, 6.0))
                kinds.append(kind)
    return np.array(out), np.array(kinds)


def _modulations(problem: Problem) -> list[tuple[str, Floats]]:
    """Smooth functions of what the probe is doing, one value a bin, and what each is a function of."""
    pieces = []
    for run in problem.runs:
        mean = run.bins.mean
        depth = mean(run.phases.depth_m) / problem.scale.depth_m
        speed = mean(run.phases.velocity_m_per_s) / problem.scale.speed_m_per_s
        rest = np.log1p(mean(run.phases.since_s) / (3.0 * problem.scale.step_s))
        rest = rest / max(rest.max(), 1e-9)
        moving = mean(run.phases.moving.astype(float))
        late = run.t_s / max(problem.scale.duration_s, 1e-9)
        pieces.append(
            {
                "depth": [depth, depth**2],
                "speed": [np.abs(speed), np.clip(speed, -1.0, 1.0), moving],
                "rest": [rest, rest * moving],
                "time": [late, np.exp(-10.0 * late), (run.bin_cycle == 0).astype(float)],
            }
        )
    out = []
    for kind, rows in pieces[0].items():
        for k in range(len(rows)):
            row = np.concatenate([piece[kind][k] for piece in pieces])
            out.append((kind, row - row.mean()))
    return out
