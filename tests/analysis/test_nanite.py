"""The same curves, the same moduli as the package nanite: its answers were recorded by benchmarks/nanite_reference.py."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpd.analysis.young import fit_contact

RECORDED = json.loads((Path(__file__).parent / "nanite_reference.json").read_text())


@pytest.mark.parametrize("curve", RECORDED["curves"], ids=lambda curve: f"{curve['true']['youngs_modulus_Pa']:g} Pa")
def test_moduli_contact_points_and_baselines_are_those_of_nanite(curve: dict[str, Any]) -> None:
    fit = fit_contact(np.array(curve["tip_m"]), np.array(curve["force_N"]), RECORDED["tip_radius_m"], curve["true"]["poisson_ratio"])
    theirs = curve["nanite"]
    assert fit.youngs_modulus_Pa == pytest.approx(theirs["youngs_modulus_Pa"], rel=1e-5)
    assert fit.contact_point_m == pytest.approx(theirs["contact_point_m"], abs=2e-8)
    assert fit.baseline_N == pytest.approx(theirs["baseline_N"], abs=5e-6)
