"""Healthy cells whose controllers are no second-order servo are not accused."""

import pytest

from benchmarks.plain_cells import CONTROLLERS, PlantedDeviations, cell_of, recording
from palpd.gap.diagnosis import diagnose
from palpd.gap.linearise import linearise
from palpd.gap.problem import SHARED, make_problem

IN_TOLERANCE = PlantedDeviations(youngs_modulus=0.03, mass_kg=-0.004, latency_s=0.001, servo_natural_frequency=-0.03, surface_z_m=3e-5)


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_a_controller_that_is_not_of_second_order_is_not_accused(controller: str) -> None:
    diagnosis = diagnose([recording(controller, 101, IN_TOLERANCE)], cell_of(controller), max_bins=900, propose=False)
    assert diagnosis.verdict == "none", diagnosis.sentence


def test_an_effect_replaces_the_tolerance_of_its_own_deviation() -> None:
    problem = make_problem([recording("second order", 101)], cell_of("second order"), max_bins=600)
    around = linearise(problem, {"sensor.gain": {"error": 0.05}}, problem.nominal_eta + 1.0)
    gain = SHARED.index("gain")
    assert not around.columns[gain].any()
    assert around.eta[gain] == 0.0
    others = [k for k in range(len(SHARED)) if k != gain]
    assert all(around.columns[k].any() for k in others)
    assert (around.eta[others] == 1.0).all()
