"""The equations of docs/explanation/inference.md against the code, on a linear cell of 18 values that fit on a page."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.optimize import minimize
from scipy.sparse import csr_array
from scipy.special import gammaln
from scipy.stats import multivariate_normal

from palpd.cell.cell_file import EffectValues
from palpd.cell.effects.effect import Parameter
from palpd.gap.assumptions import ASSUMED
from palpd.gap.calibration import ProbabilityMap
from palpd.gap.decide import decide
from palpd.gap.gaussian.nuisances import Columns, gram, nuisances, project
from palpd.gap.gaussian.whitening import Whitening
from palpd.gap.infer import discrepancy, evidence
from palpd.gap.infer import posterior as hypotheses
from palpd.gap.infer.discrepancy import DISCREPANCY_SIZES, ModelDiscrepancy, model_discrepancies
from palpd.gap.infer.evidence import Fit, laplace_evidence
from palpd.gap.infer.fit import Optimum, gauss_newton, jacobian_at
from palpd.gap.infer.posterior import Attribution, known_and_unknown
from palpd.gap.infer.residual import ResidualStructure
from palpd.gap.laws.evidence import LawEvidence
from palpd.gap.laws.learned import p_outside
from palpd.gap.model.coordinates import Coordinate, values_at
from palpd.gap.model.fixed_nuisances import Column
from palpd.gap.model.linearise import Linearisation
from palpd.tick import Floats

CHANNELS, BINS = 2, 9
SHAPE = (CHANNELS, BINS)
N = CHANNELS * BINS
GAIN, WIDTH = Parameter("gain", "N", -1e6, 1e6, (1.0,)), Parameter("width", "m", -3.0, 3.0, (1.0,), nominal=None)
WHERE = (Coordinate("spring", GAIN, -1e6, 1e6, 1.0, 0.0), Coordinate("spring", WIDTH, -3.0, 3.0, 1.0, None))
RANDOM = np.random.default_rng(12)
J, A, D = RANDOM.standard_normal((2, *SHAPE)), RANDOM.standard_normal((3, *SHAPE)), 3.0 * RANDOM.standard_normal((4, *SHAPE))
Y = 9.0 * J[0] + 0.7 * J[1] + 1.2 * A[0] + 0.4 * D[1] + RANDOM.standard_normal(SHAPE)
COVARIANCE = np.eye(N) + A.reshape(3, N).T @ A.reshape(3, N)
SLOPES = J.reshape(2, N).T


def predict(values: EffectValues, _eta: Floats) -> Floats:
    spring = values.get("spring", {"gain": 0.0, "width": 0.0})
    return np.asarray(spring["gain"] * J[0] + spring["width"] * J[1])


CELL: Any = SimpleNamespace(data=Y, scale=SimpleNamespace(duration_s=1.0), predict=predict)
"""A cell whose prediction is gain J_0 + width J_1: what a fit asks of a problem."""


def columns_of(dense: Floats) -> Columns:
    return Columns.of([dict(enumerate(each)) for each in dense], SHAPE)


def optimum() -> Optimum:
    labels = tuple(Column("press", str(number)) for number in range(len(A)))
    around = Linearisation({}, np.zeros(0), labels, nuisances(columns_of(A)), np.zeros(SHAPE), np.zeros((0, *SHAPE)))
    return gauss_newton(CELL, around, WHERE, np.zeros(2), 8)


def log_normal(residual: Floats, covariance: Floats = COVARIANCE) -> float:
    """The log density without n/2 log 2π."""
    return float(multivariate_normal(cov=covariance).logpdf(residual.ravel())) + 0.5 * N * np.log(2.0 * np.pi)


def fitted(monkeypatch: pytest.MonkeyPatch, laws: list[ModelDiscrepancy] | None = None) -> Fit:
    monkeypatch.setattr(evidence, "model_discrepancies", lambda *_: laws or [])
    return laplace_evidence(CELL, optimum())


def test_whitened_values_have_the_density_of_their_noise() -> None:
    rng = np.random.default_rng(1)
    sigma, shared = rng.uniform(0.5, 2.0, (7, BINS)), rng.standard_normal((BINS, 2))
    noise, values = Whitening.of(sigma, {3: csr_array(shared)}), rng.standard_normal((7, BINS))
    covariance = block_diag(*[np.diag(row**2) + (shared @ shared.T if channel == 3 else 0.0) for channel, row in enumerate(sigma)])
    white = noise.whiten(values)
    assert float((white**2).sum()) == pytest.approx(values.ravel() @ np.linalg.solve(covariance, values.ravel()))
    np.testing.assert_allclose(noise.natural(white), values, atol=1e-12)


def test_the_likelihood_is_that_of_a_normal_distribution_with_the_nuisances_in_its_covariance(monkeypatch: pytest.MonkeyPatch) -> None:
    one = fitted(monkeypatch)
    assert one.log_exact == pytest.approx(log_normal(one.residual))


def test_the_projection_and_the_coefficients_are_those_of_the_page() -> None:
    space, flat, r = nuisances(columns_of(A)), A.reshape(3, N).T, Y.ravel()
    projection = np.linalg.inv(np.eye(N) + flat @ flat.T)
    assert project(Y, space).dot(project(Y, space)) == pytest.approx(r @ projection @ r)
    assert space.log_determinant == pytest.approx(np.linalg.slogdet(np.eye(3) + flat.T @ flat)[1])
    np.testing.assert_allclose(space.coefficients(Y), np.linalg.solve(np.eye(3) + flat.T @ flat, flat.T @ r))


def test_one_value_and_one_tolerance_by_hand() -> None:
    """A column of 2 sigmas and a residual of 5: the tolerance takes 2 · 5 / (1 + 4) = 2 of its own, and log L is -½ · 25/5 - ½ log 5."""
    space = nuisances(Columns.of([{0: np.array([2.0])}], (1, 1)))
    residual = project(np.array([[5.0]]), space)
    assert space.coefficients(residual.values) == pytest.approx([2.0])
    assert -0.5 * residual.dot(residual) - 0.5 * space.log_determinant == pytest.approx(-2.5 - 0.5 * np.log(5.0))


def test_gauss_newton_ends_at_the_greatest_likelihood() -> None:
    inverse = np.linalg.inv(COVARIANCE)
    expected = np.linalg.solve(SLOPES.T @ inverse @ SLOPES, SLOPES.T @ inverse @ Y.ravel())
    np.testing.assert_allclose(optimum().u, expected, rtol=1e-4)


def test_the_laplace_step_is_prior_times_volume_as_the_page_says(monkeypatch: pytest.MonkeyPatch) -> None:
    one = fitted(monkeypatch)
    normal = SLOPES.T @ np.linalg.inv(COVARIANCE) @ SLOPES
    width_range = 6.0
    size = one.sizes["spring"]
    sphere = 2.0 * np.pi**0.5 / np.exp(gammaln(0.5))
    prior = 1.0 / (ASSUMED.prior.log_size_range * size) / sphere * np.sqrt(normal[0, 0]) / width_range
    curvature = normal + np.diag([1e3**-2, (width_range / np.sqrt(12.0)) ** -2])
    volume = 2.0 * np.pi / np.sqrt(np.linalg.det(curvature))
    assert one.occam == pytest.approx(np.log(prior * volume), abs=2e-3)
    assert size == pytest.approx(np.sqrt(one.change.ravel() @ np.linalg.inv(COVARIANCE) @ one.change.ravel()))


def test_the_laplace_step_is_the_integral_over_the_parameters(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a linear cell it neglects nothing but the slope of the prior: summed over a grid, likelihood times W is L* times volume."""
    one = fitted(monkeypatch)
    normal, weight = SLOPES.T @ np.linalg.inv(COVARIANCE) @ SLOPES, np.diag([1e3**-2, (6.0 / np.sqrt(12.0)) ** -2])
    sd = np.sqrt(np.diag(np.linalg.inv(normal + weight)))
    axes = [np.linspace(-8.0 * s, 8.0 * s, 161) for s in sd]
    moves = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    residuals = one.residual.ravel() - moves @ SLOPES.T
    logs = multivariate_normal(cov=COVARIANCE).logpdf(residuals) + 0.5 * N * np.log(2.0 * np.pi)
    logs -= 0.5 * np.einsum("ni,ij,nj->n", moves, weight, moves)
    integral = np.logaddexp.reduce(logs) + sum(np.log(axis[1] - axis[0]) for axis in axes)
    volume = np.log(2.0 * np.pi) - 0.5 * np.linalg.slogdet(normal + weight)[1]
    assert integral == pytest.approx(one.log_exact + volume, abs=1e-3)


def discrepancies(monkeypatch: pytest.MonkeyPatch, kinds: list[str], best: Optimum, directions: Floats = D) -> list[ModelDiscrepancy]:
    monkeypatch.setattr(discrepancy, "discrepancy_columns", lambda *_: (columns_of(directions), np.array(kinds)))
    space = best.linearisation.space
    slopes = [project(j, space) for j in jacobian_at(CELL, best.where, best.u, best.linearisation.eta, best.prediction)]
    return model_discrepancies(CELL, best, project(Y - best.prediction, space), slopes, gram(slopes))


def test_a_law_that_is_off_gains_what_the_page_says(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where the search ended beside the optimum: what a step to it promises is no gain of the discrepancy."""
    u = optimum().u + np.array([0.1, -0.2])
    best, kinds = replace(optimum(), u=u, prediction=predict(values_at(WHERE, u), u)), ["depth", "depth", "rest", "rest"]
    residual = (Y - best.prediction).ravel()
    reach = np.diag(0.5 * np.abs(best.u)) ** 2

    def gained(covariance: Floats) -> float:
        """Greatest value, over moves v of the parameters, of log N(r - J v) less its price."""

        def loss(v: Floats) -> float:
            return -log_normal(residual - SLOPES @ v, covariance) + 0.5 * float(v @ np.linalg.solve(reach, v))

        return -float(minimize(loss, np.zeros(2), method="BFGS").fun)

    deviations = discrepancies(monkeypatch, kinds, best)
    ways = [[0, 1], [2, 3], [0, 1, 2, 3]]
    expected = [
        (prior / len(ways), gained(COVARIANCE + size**2 * D[way].reshape(-1, N).T @ D[way].reshape(-1, N)))
        for size, prior in DISCREPANCY_SIZES
        for way in ways
    ]
    assert [one.log_prior for one in deviations] == pytest.approx([np.log(prior) for prior, _ in expected])
    promised = gained(COVARIANCE)
    assert [one.gain for one in deviations] == pytest.approx([gain - promised for _, gain in expected], abs=1e-3)
    assert pytest.approx(1.0) == ASSUMED.law_error.p_exact + sum(prior for _, prior in DISCREPANCY_SIZES)


def test_a_law_that_is_huge_and_that_tolerances_hide_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """What tolerances leave of it is the difference of two large numbers: it came out negative, and the diagnosis ended in a traceback."""
    huge = np.concatenate([D[:2], 1e12 * D[[2, 2]]])
    laws = discrepancies(monkeypatch, ["depth", "depth", "rest", "rest"], optimum(), huge)
    assert {one.log_prior for one in laws} == {np.log(prior / 3) for _, prior in DISCREPANCY_SIZES}
    assert len(laws) == len(DISCREPANCY_SIZES), "the others stay"
    assert all(np.isfinite(one.gain) for one in laws)


def test_the_likelihood_of_an_effect_averages_over_the_laws_that_it_may_follow(monkeypatch: pytest.MonkeyPatch) -> None:
    laws = discrepancies(monkeypatch, ["depth", "depth", "rest", "rest"], optimum())
    one = fitted(monkeypatch, laws)
    expected = ASSUMED.law_error.p_exact * np.exp(one.log_exact) + sum(np.exp(law.log_prior + one.log_exact + law.gain) for law in laws)
    assert one.log_likelihood == pytest.approx(np.log(expected))
    assert sum(law.probability for law in one.laws) == pytest.approx(1.0)


def hypothesis(
    names: tuple[str, ...], *, exact: float, likelihood: float, occam: float = 0.0, misfit: float = 0.0, energy: float = 0.0
) -> Any:
    return SimpleNamespace(
        names=names, log_exact=exact, log_likelihood=likelihood, occam=occam, misfit=misfit, discrepancy_energy=energy, remainder=None
    )


def known_at(share: float) -> float:
    """The probability, by the odds of the page, that what explains this share of the gap is a law that is off."""
    odds = 0.85 / 0.15 / 0.04 * np.exp(-share / 0.04)
    return float(odds / (1.0 + odds))


def test_a_hypothesis_is_split_by_the_share_of_the_gap_that_its_law_is_off() -> None:
    one = hypothesis(("spring",), exact=-30.0, likelihood=-24.0, energy=30.0)
    residual = ResidualStructure(4.0, 60.0, "fz", "hold")
    known, unknown = known_and_unknown(one, residual, 300.0, most=np.inf)
    a, b = 0.85 * np.exp(-24.0), 0.15 * np.exp(-26.0)
    assert np.exp(known) == pytest.approx(a * known_at(0.1) + b * known_at(0.2))
    assert np.exp(unknown) == pytest.approx(a + b - a * known_at(0.1) - b * known_at(0.2))
    assert known_at(0.2) == pytest.approx(0.5, abs=0.15)


def test_a_cap_bounds_what_a_residual_of_any_shape_lends_and_without_effects_nothing_is_split() -> None:
    one, residual = hypothesis((), exact=-30.0, likelihood=-30.0), ResidualStructure(40.0, 60.0, "fz", "hold")
    assert known_and_unknown(one, residual, 300.0, most=-28.0) == pytest.approx((np.log(0.85) - 30.0, np.log(0.15) - 28.0))


def weighed(monkeypatch: pytest.MonkeyPatch, fits: list[Any], structure: float) -> Attribution:
    monkeypatch.setattr(hypotheses, "segments_of", lambda _: ())
    monkeypatch.setattr(hypotheses, "test_residual", lambda *_: ResidualStructure(structure, 1.0, "fz", "hold"))
    library: dict[str, Any] = {name: SimpleNamespace(scatter=False) for name in ("spring", "friction", "mass", "bias")} | {
        "noise": SimpleNamespace(scatter=True)
    }
    problem: Any = SimpleNamespace(library=library, recordings=())
    return hypotheses.posterior(problem, {one.names: one for one in fits})


def test_the_probabilities_of_hypotheses_are_prior_times_likelihood_over_their_sum(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four listed effects with a mean, no residual: the prior of one of them is 0.6/4, and a set of two pays 3 nats at least."""
    fits = [
        hypothesis((), exact=-14.0, likelihood=-14.0, misfit=28.0),
        hypothesis(("spring",), exact=-10.0, likelihood=-10.0, occam=-2.0),
        hypothesis(("spring", "mass"), exact=-6.0, likelihood=-6.0, occam=-3.0),
    ]
    attribution = weighed(monkeypatch, fits, structure=-np.inf)
    parts = np.array([0.3 * np.exp(-14.0), 0.6 / 4 * np.exp(-12.0), 0.12 / 6 * np.exp(-6.0 + min(-3.0, -2.0 - 3.0))])
    by_names = {one.fit.names: one.share for one in attribution.hypotheses}
    assert [by_names[one.names] for one in fits] == pytest.approx((parts / parts.sum()).tolist())
    assert attribution.marginal["spring"] == pytest.approx((parts[1] + parts[2]) / parts.sum())
    assert attribution.p_none == pytest.approx(parts[0] / parts.sum())
    assert sum(one.known + one.unknown for one in attribution.hypotheses) == pytest.approx(1.0)


def test_a_set_is_worth_no_more_than_a_smaller_one_less_the_price_of_a_further_effect(monkeypatch: pytest.MonkeyPatch) -> None:
    def odds(occam: float) -> float:
        pair = hypothesis(("spring", "mass"), exact=-6.0, likelihood=-6.0, occam=occam)
        single = hypothesis(("spring",), exact=-6.0, likelihood=-6.0, occam=-2.0)
        none = hypothesis((), exact=-14.0, likelihood=-14.0)
        shares = {one.fit.names: one.share for one in weighed(monkeypatch, [none, single, pair], structure=-np.inf).hypotheses}
        return shares[("spring", "mass")] / shares[("spring",)]

    assert odds(0.0) == odds(-5.0) == pytest.approx(0.12 / 6 / (0.6 / 4) * np.exp(-3.0))
    assert odds(-9.0) == pytest.approx(0.12 / 6 / (0.6 / 4) * np.exp(-7.0))


@pytest.mark.parametrize(
    ("p_none", "p_unknown", "lone_axis", "kind"),
    [
        (0.26, 0.74, 0.0, "none"),
        (0.24, 0.76, 0.0, "unknown"),
        (0.24, 0.2, 0.0, "none"),
        (0.0, 0.0, 0.9, "unknown"),
        (0.9, 0.0, 0.9, "unknown"),
    ],
)
def test_where_nothing_is_named_the_verdict_follows_the_table(p_none: float, p_unknown: float, lone_axis: float, kind: str) -> None:
    nobody = hypothesis((), exact=0.0, likelihood=0.0)
    attribution = SimpleNamespace(p_none=p_none, p_unknown=p_unknown, marginal={}, groups={})
    inference: Any = SimpleNamespace(nominal=nobody, best=None, attribution=attribution)
    scatter: Any = SimpleNamespace(p_lone_axis=lone_axis, lone_axis=None, effects=())
    verdict = decide(inference, scatter, LawEvidence(nobody), ProbabilityMap())
    assert verdict.kind == kind
    assert verdict.effects == []
    assert verdict.p_none == pytest.approx(p_none * (1.0 - lone_axis))
    assert verdict.p_unknown == pytest.approx(1.0 - (1.0 - p_unknown) * (1.0 - lone_axis))


def test_the_probability_of_a_law_follows_its_nats() -> None:
    for nats in (0.0, 3.0):
        assert p_outside(nats) == pytest.approx(1.0 / (1.0 + 0.85 / 0.15 * np.exp(-nats)))
    assert p_outside(100.0) == 0.97


def test_the_score_tempers_the_odds_and_mixes_in_the_prior() -> None:
    by = ProbabilityMap(power=0.5, doubt=0.1, power_none=2.0, cells=1)
    odds = (0.9 / 0.1) ** 0.5
    prior = (1.0 - ASSUMED.prior.none - ASSUMED.prior.unknown) / 2.0
    assert by.of_effects({"spring": 0.9, "mass": 0.0}) == pytest.approx({"spring": 0.9 * odds / (1.0 + odds) + 0.1 * prior, "mass": 0.0})
    none, unknown = by.of_classes(0.25, 0.0)
    assert none == pytest.approx(0.25)
    assert unknown == pytest.approx(0.75 * 0.1 * ASSUMED.prior.unknown / (1.0 - ASSUMED.prior.none))
