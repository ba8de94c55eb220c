"""Rows of a smooth residual count for less when listed effects are compared."""

import numpy as np
import pytest

from palpd.cell.cell_file import Estimated
from palpd.gap.infer.correlated_residual import correlation_time, row_weights, wrong_tolerances
from palpd.gap.infer.evidence import fit
from palpd.gap.model.linearise import linearise
from palpd.gap.model.problem import NOMINAL_ETA, SHARED, make_problem
from palpd.testing.plain_cells import cell_of, recording


def test_a_tolerance_is_compared_as_wide_as_the_best_hypothesis_needs_it() -> None:
    cell = cell_of("second order")
    far = Estimated(surface_z_m=9.0 * cell.tolerances.surface_z_m)
    problem = make_problem([recording("second order", 5, far)], cell, max_bins=400)
    factors = wrong_tolerances(fit(problem, {}, linearise(problem, {}, NOMINAL_ETA), rounds=3))
    surface = SHARED.index("surface_z_m")
    assert factors[surface] == pytest.approx(9.0, rel=0.2)
    assert (np.delete(factors, surface) == 1.0).all()


def test_white_noise_counts_fully() -> None:
    remainder = np.random.default_rng(0).standard_normal((7, 2000))
    assert (row_weights(remainder) == 1.0).all()


def test_a_first_order_process_is_correlated_over_its_own_time() -> None:
    rng, rho = np.random.default_rng(1), 0.9
    values = np.zeros(50_000)
    for k in range(1, len(values)):
        values[k] = rho * values[k - 1] + rng.standard_normal()
    assert correlation_time(values) == pytest.approx((1 + rho) / (1 - rho), rel=0.15)
    weights = row_weights(np.vstack([values, np.zeros_like(values), rng.standard_normal(len(values))]))
    assert weights[0] < 0.02
    assert weights[1:] == pytest.approx(1.0)
