"""Intervals of parameters hold the truth as often as they say, follow a residual that is no parabola, and know of inexact laws."""

from dataclasses import replace
from math import pi

import numpy as np
import pytest
from scipy.stats import binom

from palpd.cell.cell_file import EffectValues
from palpd.gap.assumptions import ASSUMED
from palpd.gap.infer.evidence import PossibleLaw, fit, laplace_evidence
from palpd.gap.infer.fit import gauss_newton
from palpd.gap.infer.intervals import half_width, interval
from palpd.gap.model.linearise import linearise
from palpd.gap.model.problem import NOMINAL_ETA, Problem, make_problem
from palpd.testing.plain_cells import cell_of, recording

SIZES: dict[str, dict[str, tuple[float, float]]] = {
    "cable.friction": {"force_N": (0.02, 0.1)},
    "tissue.viscoelastic": {"ratio": (0.05, 0.2), "tau_s": (0.3, 1.5)},
    "sensor.hysteresis": {"width_N": (0.3, 1.5), "amplitude_N": (0.05, 0.1)},
    "tissue.inclusion": {"contrast": (0.3, 0.8), "depth_m": (0.004, 0.012)},
    "tissue.surface": {"offset_m": (1e-4, 3e-4)},
    "sensor.gain": {"error": (0.1, 0.3)},
}
"""Ranges of the planted parameters."""
DRAWS = 8


@pytest.fixture(scope="module")
def problem() -> Problem:
    return make_problem([recording("second order", 3)], cell_of("second order"), max_bins=400)


def drawn(problem: Problem, effects: EffectValues, random: np.random.Generator) -> Problem:
    """The problem with data of a cell that has these effects by the listed laws, deviations within tolerance, and the stated noise."""
    eta = random.standard_normal(len(NOMINAL_ETA))
    there = linearise(problem, effects, eta)
    own = np.array([label.scope != "cell" for label in there.labels])
    others = there.space.explained(np.where(own, random.standard_normal(there.space.size), 0.0))
    white = problem.predict(effects, eta) + others + random.standard_normal(problem.data.shape)
    return replace(problem, measured=problem.noise.natural(white))


def test_intervals_hold_the_truth_as_often_as_they_say(problem: Problem) -> None:
    random = np.random.default_rng(20)
    held = []
    for name, ranges in SIZES.items():
        for _ in range(DRAWS):
            true = {parameter: float(random.uniform(*bounds)) for parameter, bounds in ranges.items()}
            data = drawn(problem, {name: true}, random)
            start = {name: {parameter: 1.2 * value for parameter, value in true.items()}}
            one = fit(data, start, linearise(data, start, NOMINAL_ETA), rounds=3)
            for k, c in enumerate(one.where):
                low, high = interval(data, one, k)
                held.append(low <= true[c.parameter.name] <= high)
    n, missed = len(held), held.count(False)
    assert n == 9 * DRAWS
    # Laws of any discrepancy are allowed for, so exact ones may be held more often.
    assert missed <= binom.ppf(0.999, n, 1.0 - ASSUMED.naming.covered)


def law(probability: float, move: float, sd: float) -> PossibleLaw:
    return PossibleLaw(probability, np.array([move]), np.array([[sd**-2]]), np.zeros((1, 0)))


def test_one_exact_law_gives_the_normal_interval() -> None:
    assert half_width([law(1.0, 0.0, 2.0)], 0) == pytest.approx(1.96 * 2.0, rel=2e-3)


def test_where_the_law_is_off_the_distance_to_its_better_parameters_belongs_to_the_interval() -> None:
    assert half_width([law(0.0, 0.0, 1.0), law(1.0, -7.0, 1.0)], 0) == pytest.approx(7.0 + 1.645, rel=2e-3)
    half = half_width([law(0.5, 0.0, 1.0), law(0.5, 3.0, 2.0)], 0)
    random = np.random.default_rng(1)
    errors = np.where(random.random(200_000) < 0.5, random.normal(0.0, 1.0, 200_000), random.normal(3.0, 2.0, 200_000))
    assert np.mean(np.abs(errors) <= half) == pytest.approx(ASSUMED.naming.covered, abs=2e-3)


def test_a_law_that_hardly_any_data_support_does_not_widen_the_interval() -> None:
    assert half_width([law(0.99, 0.0, 1.0), law(0.01, 0.0, 1000.0)], 0) < 2.2


def test_an_end_lies_where_the_residual_has_risen_enough(problem: Problem) -> None:
    # A deep inclusion fixes contrast / depth² only, so the parameters run along a curve.
    true: EffectValues = {"tissue.inclusion": {"contrast": 0.8, "depth_m": 0.012}}
    data = drawn(problem, true, np.random.default_rng(3))
    one = fit(data, true, linearise(data, true, NOMINAL_ETA), rounds=3)
    k = [c.parameter.name for c in one.where].index("contrast")
    low, high = interval(data, one, k)
    value = one.values["tissue.inclusion"]["contrast"]
    half = half_width(one.laws, k) * one.where[k].scale
    assert high - value > 1.1 * half
    assert value - low < 0.95 * half


def test_a_search_that_ended_beside_the_best_place_has_its_interval_there(problem: Problem) -> None:
    true: EffectValues = {"cable.friction": {"force_N": 0.06}}
    data = drawn(problem, true, np.random.default_rng(5))
    best = fit(data, true, linearise(data, true, NOMINAL_ETA), rounds=3)
    sd = float(best.laws[0].covariance()[0, 0]) ** 0.5
    beside = gauss_newton(data, best.linearisation, best.where, best.u + 2.0 * sd, iterations=0)
    low_N, high_N = interval(data, laplace_evidence(data, beside), 0)
    value_N, sd_N = beside.values["cable.friction"]["force_N"], sd * best.where[0].scale
    assert value_N - low_N > 4.0 * sd_N
    assert high_N - value_N < 0.5 * (value_N - low_N)


def test_an_angle_and_a_choice_keep_theirs(problem: Problem) -> None:
    true: EffectValues = {
        "contact.lateral": {"ratio": 0.1, "azimuth_rad": 3.0},
        "sensor.asymmetry": {"ratio": 0.1, "at_N": 1.0, "side": -1.0},
    }
    data = drawn(problem, true, np.random.default_rng(4))
    one = fit(data, true, linearise(data, true, NOMINAL_ETA), rounds=2)
    ends = {c.parameter.name: interval(data, one, k) for k, c in enumerate(one.where) if c.parameter.name != "ratio"}
    assert ends["side"] == (-1.0, -1.0)
    low_rad, high_rad = ends["azimuth_rad"]
    assert low_rad < 3.0 < high_rad < 3.0 + pi
