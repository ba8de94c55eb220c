"""The audit of the evidence, on a linear cell whose integral is known."""

import numpy as np
import pytest

from benchmarks.evidence_audit import Integrand, audited, nested
from tests.gap.test_inference_page import CELL, fitted


def test_a_linear_cell_differs_from_its_parabola_by_the_ends_and_the_slope_of_the_prior_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    integrand = Integrand(CELL, fitted(monkeypatch))
    one = audited("linear", 1.0, integrand, np.random.default_rng(1))
    assert one.own_prior == pytest.approx(0.0, abs=1e-3), "the prior is that of the page, and of the diagnosis"
    assert one.of_likelihood == pytest.approx(0.0, abs=1e-6)
    assert one.difference == pytest.approx(one.of_ends + one.of_likelihood + one.of_prior)
    assert abs(one.difference) < 0.2
    assert one.samples > 100.0


def test_nested_sampling_finds_the_same_integral(monkeypatch: pytest.MonkeyPatch) -> None:
    integrand = Integrand(CELL, fitted(monkeypatch))
    about = audited("linear", 1.0, integrand, np.random.default_rng(2))
    whole, error = nested(integrand, np.random.default_rng(3))
    assert whole == pytest.approx(about.difference, abs=4.0 * np.hypot(error, about.error))
    assert error < 0.5
