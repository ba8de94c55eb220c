"""How far the Laplace step of the diagnosis is from the integral that it stands for.

`python -m benchmarks.evidence_audit --kept FOLDER [--recordings 40] [--jobs 2] [--docs]`. It diagnoses sealed cells (those of
`benchmarks.sensitivity`) and takes the three likeliest sets of effects of each. For each set it integrates prior times likelihood over
the parameters u, with the linear nuisances integrated out exactly at the fit's own linearisation. It draws u from Student distributions
about the optimum (importance sampling). The difference of log evidence has three parts: the ends of ranges, the likelihood that is no
parabola, and the prior that is not flat. Where fewer than LEAST_SAMPLES effective draws are left, nested sampling (dynesty) integrates
the same within REACH_SD of the optimum. Model discrepancies are left out on both sides.

The prior is written here from docs/explanation/inference.md, and shares no code with the diagnosis. FOLDER keeps what was computed.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from math import lgamma, log, pi
from pathlib import Path

import numpy as np
from scipy.special import logsumexp
from scipy.stats import multivariate_t

from benchmarks.sensitivity import BINS, SEED, cells
from palpd.blind.sources import Hosts, draw
from palpd.blind.truth import CaseSpec
from palpd.cell.cell_file import cell_from
from palpd.cell.effects import EFFECTS
from palpd.gap.assumptions import ASSUMED
from palpd.gap.diagnosis import diagnose
from palpd.gap.gaussian.nuisances import gram, project
from palpd.gap.infer.evidence import Fit
from palpd.gap.infer.fit import jacobian_at
from palpd.gap.model.coordinates import Coordinate, values_at
from palpd.gap.model.problem import Problem
from palpd.tick import Floats
from palpd.workers import pool

SETS, DRAWS, WIDTHS, FREEDOM = 3, 500, (1.0, 3.0), 4.0
"""Sets for each recording; draws for each set; widths of the distributions that are drawn from, in those of Laplace's; their freedom."""
LEAST_SAMPLES = 50.0
"""Effective number of draws from which on importance sampling counts."""
NESTED, LIVE_POINTS, REACH_SD, MOST_CALLS = 8, 60, 12.0, 20_000
"""Sets that nested sampling integrates, its number of live points, how far it goes from the optimum, and when it ends at the latest."""
NOTABLE_NATS = 1.0
PAGE = Path(__file__).parents[1] / "docs" / "evidence.md"


@dataclass(frozen=True)
class Audited:
    """One set of effects on one recording, all differences in nats of log evidence, integral less Laplace.

    Attributes:
        share: Probability of the set in the answer.
        difference: By importance sampling; the sum of the next three.
        of_ends: Because parameters end, or Laplace's parabola leads beyond its range.
        of_likelihood: Because the likelihood is no parabola.
        of_prior: Because the prior is not flat.
        error: Standard error of the difference.
        samples: Effective number of draws.
        own_prior: Log prior at the optimum as written here, less the diagnosis' own: 0 where both say the same.
        nested: Difference by nested sampling; None where it was not asked.
        nested_error: Its standard error.
    """

    cell: str
    names: tuple[str, ...]
    share: float
    difference: float
    of_ends: float
    of_likelihood: float
    of_prior: float
    error: float
    samples: float
    own_prior: float
    nested: float | None = None
    nested_error: float | None = None

    @property
    def cause(self) -> str:
        """The largest part, in words."""
        parts = {"ends of ranges": self.of_ends, "likelihood is no parabola": self.of_likelihood, "prior is not flat": self.of_prior}
        return max(parts, key=lambda name: abs(parts[name]))


class Integrand:
    """Prior times likelihood of one set of effects, over its parameters that are not held."""

    def __init__(self, problem: Problem, fitted: Fit) -> None:
        """Linearise nothing anew: state and nuisances are those of the fit."""
        self.problem, self.fitted, self.space = problem, fitted, fitted.linearisation.space
        self.free = np.array([k for k, c in enumerate(fitted.where) if not c.fixed])
        self.target = problem.data + fitted.linearisation.offset()
        eta, at = fitted.eta, problem.predict(fitted.values, fitted.eta)
        self.normal = gram([project(j, self.space) for j in jacobian_at(problem, fitted.where, fitted.u, eta, at)])
        prior_sd = np.array([1e3 if c.amplitude else c.range / 12.0**0.5 for c in self.coordinates])
        self.posterior = self.normal[np.ix_(self.free, self.free)] + np.diag(prior_sd**-2.0)

    @property
    def coordinates(self) -> list[Coordinate]:
        """The parameters that are not held."""
        return [self.fitted.where[k] for k in self.free]

    @property
    def mode(self) -> Floats:
        """Their optimum û."""
        return np.asarray(self.fitted.u[self.free])

    def _others(self, u: Floats, name: str) -> dict[str, dict[str, float]]:
        return {other: values for other, values in values_at(self.fitted.where, u).items() if other != name}

    def whole(self, free: Floats) -> Floats:
        """All coordinates, from those that are not held."""
        u = self.fitted.u.copy()
        u[self.free] = free
        return u

    def ends(self) -> list[tuple[float, float]]:
        """Range of each coordinate: of an angle one turn about the optimum."""
        out = []
        for c, at in zip(self.coordinates, self.mode.tolist(), strict=True):
            turn = 2.0 * pi / c.scale
            # the logarithm of an amplitude that may be 0 has no lower end, and far below the optimum there is no effect
            low = max(c.to(c.lower), at - 20.0) if c.parameter.log else c.to(c.lower)
            out.append((at - turn / 2, at + turn / 2) if c.angle else (low, c.to(c.upper)))
        return out

    def log_likelihood(self, free: Floats) -> float:
        """Log likelihood less its value at the optimum."""
        r = project(self.target - self.problem.predict(values_at(self.fitted.where, self.whole(free)), self.fitted.eta), self.space)
        return 0.5 * (self.fitted.misfit - r.dot(r))

    def log_prior(self, free: Floats) -> float:
        """Log density in u: sizes log-uniform, directions uniform in the metric of the data, shapes uniform, as the page says."""
        where, u = self.fitted.where, self.whole(free)
        values, prior = values_at(where, u), 0.0
        at = self.problem.predict(values, self.fitted.eta)
        for name in self.fitted.names:
            mine = [k for k, c in enumerate(where) if c.effect == name]
            moving = [k for k in mine if where[k].amplitude]
            if moving:
                change = project(at - self.problem.predict(self._others(u, name), self.fitted.eta), self.space)
                size, m = max(max(change.dot(change), 0.0) ** 0.5, ASSUMED.prior.least_size_sd), len(moving)
                metric = self.normal[np.ix_(moving, moving)] + 1e-12 * np.eye(m)
                sphere = log(2.0) + 0.5 * m * log(pi) - lgamma(0.5 * m)
                prior += 0.5 * float(np.linalg.slogdet(metric)[1]) - log(ASSUMED.prior.log_size_range) - m * log(size) - sphere
            for k in mine:
                c, value = where[k], values[name][where[k].parameter.name]
                if c.fixed:
                    prior -= log(len(c.parameter.choices))
                elif not c.amplitude:
                    prior -= log(c.range)
                elif c.nominal == 0.0 and all(start * value < 0.0 for start in c.parameter.starts(self.problem.scale)):
                    prior -= ASSUMED.prior.contrary_nats
                if c.parameter.natural is not None:
                    prior -= 0.5 * (max(abs(value) / c.parameter.natural - 1.0, 0.0) / ASSUMED.prior.natural_spread) ** 2
        return prior


def audited(cell: str, share: float, integrand: Integrand, rng: np.random.Generator) -> Audited:
    """Integrate about the optimum, and part the difference to Laplace's evidence."""
    mode, posterior, ends = integrand.mode, integrand.posterior, np.array(integrand.ends())
    n, at_mode = len(mode), integrand.log_prior(mode)
    sd, correlation = widths(posterior)
    laplace = 0.5 * n * log(2.0 * pi) - 0.5 * float(np.linalg.slogdet(posterior)[1])
    students = [multivariate_t(np.zeros(n), correlation * width**2, df=FREEDOM) for width in WIDTHS]
    moves = np.vstack([np.reshape(one.rvs(DRAWS // len(WIDTHS), random_state=rng), (-1, n)) for one in students])
    log_density = logsumexp([np.reshape(one.logpdf(moves), -1) for one in students], axis=0) - log(len(students)) - np.log(sd).sum()
    draws = mode + moves * sd
    inside = ((draws >= ends[:, 0]) & (draws <= ends[:, 1])).all(axis=1)
    parabola = -0.5 * np.einsum("ni,ij,nj->n", draws - mode, integrand.normal[np.ix_(integrand.free, integrand.free)], draws - mode)
    likelihood, prior = np.full(len(draws), -np.inf), np.zeros(len(draws))
    for k in np.flatnonzero(inside):
        likelihood[k], prior[k] = integrand.log_likelihood(draws[k]), integrand.log_prior(draws[k]) - at_mode

    def integral(log_target: Floats) -> float:
        return float(logsumexp(np.where(inside, log_target, -np.inf) - log_density) - log(len(draws))) - laplace

    of_ends, flat, full = integral(parabola), integral(likelihood), integral(likelihood + prior)
    weights = np.exp(likelihood + prior - log_density - np.max(likelihood + prior - log_density))
    samples = float(weights.sum() ** 2 / (weights**2).sum())
    own = at_mode + laplace - integrand.fitted.occam
    error = float(np.std(weights) / np.mean(weights) / len(weights) ** 0.5)
    return Audited(cell, integrand.fitted.names, share, full, of_ends, flat - of_ends, full - flat, error, samples, own)


def widths(posterior: Floats) -> tuple[Floats, Floats]:
    """Standard deviations (n,) by Laplace, and the correlations (n, n): parameters differ by ten orders of magnitude."""
    scale = 1.0 / np.sqrt(np.diag(posterior))
    scaled = np.linalg.inv(posterior * np.outer(scale, scale))
    sd = np.sqrt(np.diag(scaled))
    return scale * sd, scaled / np.outer(sd, sd)


def nested(integrand: Integrand, rng: np.random.Generator) -> tuple[float, float]:
    """Log evidence within REACH_SD of the optimum less Laplace's, in nats, and its standard error."""
    import dynesty

    ends, reach = np.array(integrand.ends()), REACH_SD * widths(integrand.posterior)[0]
    ends = np.clip(ends, (integrand.mode - reach)[:, None], (integrand.mode + reach)[:, None])
    span, at_mode = ends[:, 1] - ends[:, 0], integrand.log_prior(integrand.mode)
    laplace = 0.5 * len(span) * log(2.0 * pi) - 0.5 * float(np.linalg.slogdet(integrand.posterior)[1])
    sampler = dynesty.NestedSampler(
        lambda free: integrand.log_likelihood(free) + integrand.log_prior(free) - at_mode,
        lambda cube: ends[:, 0] + cube * span,
        len(span),
        nlive=LIVE_POINTS,
        rstate=rng,
    )
    sampler.run_nested(dlogz=0.5, maxcall=MOST_CALLS, print_progress=False)
    return float(sampler.results.logz[-1] + np.log(span).sum() - laplace), float(sampler.results.logzerr[-1])


def of_recording(spec: CaseSpec, kept: Path, to_nest: frozenset[tuple[str, tuple[str, ...]]] = frozenset()) -> list[Audited]:
    """Audit the likeliest sets of one recording, or read what is kept of it.

    Args:
        kept: Folder of what was computed.
        to_nest: Cell and effects of the sets that nested sampling integrates, as far as it has not yet.
    """
    file, out = kept / f"{spec.name}.json", []
    known = [Audited(**(one | {"names": tuple(one["names"])})) for one in json.loads(file.read_text())] if file.exists() else None
    if known is not None and not any((one.cell, one.names) in to_nest for one in known if one.nested is None):
        return known
    case = draw(spec, SEED, Hosts())
    library = {name: effect for name, effect in EFFECTS.items() if name not in case.without}
    inference = diagnose([case.samples], cell_from(case.cell, "cell"), library, max_bins=BINS).inference
    rng = np.random.default_rng(20_001)
    for one in [one for one in inference.attribution.hypotheses if one.fit.names][:SETS]:
        integrand = Integrand(inference.problem, inference.fits[one.fit.names])
        before = next((each for each in known or () if each.names == one.fit.names), None)
        result = before or audited(spec.name, one.share, integrand, rng)
        if (result.cell, result.names) in to_nest and result.nested is None:
            difference, error = nested(integrand, rng)
            result = Audited(**(asdict(result) | {"nested": difference, "nested_error": error}))
        out.append(result)
    file.write_text(json.dumps([asdict(one) for one in out], indent=1))
    return out


HEAD = """<!-- written by python -m benchmarks.evidence_audit --docs -->
# The evidence, audited

A diagnosis compares sets of effects by Laplace's approximation ([the model](explanation/inference.md)). Here prior times likelihood is
integrated over the parameters instead, by importance sampling about the optimum ({draws} draws of two Student distributions). Nuisances
are integrated out exactly, as linearised at the optimum. Model discrepancies are left out on both sides.
Audited are the {sets} likeliest sets of {recordings} sealed recordings of `benchmarks.sensitivity`.
A positive difference says that Laplace's evidence is too small. A difference that all sets of a recording share changes no answer.

`python -m benchmarks.evidence_audit --kept FOLDER --docs` writes this page.
"""


def page(results: Sequence[Audited], recordings: int) -> str:
    """The page: how large the differences are, each one above a nat with its cause, and nested sampling beside importance sampling."""
    counted = [one for one in results if one.samples >= LEAST_SAMPLES]
    size, others = np.abs([one.difference for one in counted]), 0
    for cell in dict.fromkeys(one.cell for one in results):
        mine = [one for one in results if one.cell == cell]
        others += max(mine, key=lambda one: one.share) is not max(mine, key=lambda one: log(max(one.share, 1e-300)) + one.difference)
    lines = [
        HEAD.format(draws=DRAWS, sets=SETS, recordings=recordings),
        f"{len(results)} sets; {len(counted)} keep {LEAST_SAMPLES:g} effective draws or more. In these the difference is at most "
        f"{np.median(size):.2f} nats for half, {np.quantile(size, 0.9):.2f} for nine of ten, and {size.max():.1f} for the worst. "
        f"All sets that differ by more than {NOTABLE_NATS:g} nat follow. A part of -0.7 at an end is a parameter at the end of its "
        "range, where half of Laplace's parabola lies outside. With the integrals, the likeliest of the sets is another one in "
        f"{others} of {recordings} recordings.\n",
        "| recording | effects | share in the answer | effective draws | integral less Laplace, nats | ends | likelihood | prior | cause |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for one in sorted(results, key=lambda one: -abs(one.difference)):
        if abs(one.difference) > NOTABLE_NATS:
            parts = " | ".join(f"{part:+.1f}" for part in (one.of_ends, one.of_likelihood, one.of_prior))
            about = f"{one.cell} | {', '.join(one.names)} | {one.share:.2g} | {one.samples:.0f}"
            lines.append(f"| {about} | {one.difference:+.1f} ± {one.error:.1f} | {parts} | {one.cause} |")
    lines += [
        "\n## Nested sampling where importance sampling does not suffice\n",
        f"dynesty with {LIVE_POINTS} live points, within {REACH_SD:g} of Laplace's standard deviations of the optimum, for the {NESTED} "
        "likeliest sets that kept fewer draws.\n",
        "| recording | effects | effective draws | importance sampling, nats | nested sampling, nats |",
        "|---|---|---|---|---|",
    ]
    lines += [
        f"| {one.cell} | {', '.join(one.names)} | {one.samples:.0f} | {one.difference:+.1f} | {one.nested:+.1f} ± {one.nested_error:.1f} |"
        for one in results
        if one.nested is not None
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Audit, and print or write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=int, default=40)
    parser.add_argument("--kept", type=Path, default=Path("evidence_audit"), help="folder of the results")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--docs", action="store_true", help="write docs/evidence.md")
    options = parser.parse_args()
    options.kept.mkdir(parents=True, exist_ok=True)
    todo = cells(options.recordings)
    with pool(options.jobs) as workers:
        each = list(workers.map(partial(of_recording, kept=options.kept), todo))
        poor = sorted((one for some in each for one in some if one.samples < LEAST_SAMPLES), key=lambda one: (-one.share, one.cell))
        chosen = frozenset((one.cell, one.names) for one in poor[:NESTED])
        each = list(workers.map(partial(of_recording, kept=options.kept, to_nest=chosen), todo))
    text = page([one for some in each for one in some], len(todo))
    if options.docs:
        PAGE.write_text(text, encoding="utf-8")
    else:
        print(text)


if __name__ == "__main__":
    main()
