"""Healthy cells whose controllers are no second-order servo are not accused."""

from dataclasses import replace

import numpy as np
import pytest

from palpd.gap.diagnosis import diagnose
from palpd.gap.model.linearise import linearise
from palpd.gap.model.problem import SHARED, make_problem
from palpd.recording.samples import Samples
from palpd.testing.plain_cells import CONTROLLERS, PlantedDeviations, cell_of, heavy_cell_of, recording

IN_TOLERANCE = PlantedDeviations(youngs_modulus=0.03, mass_kg=-0.004, latency_s=0.001, servo_natural_frequency=-0.03, surface_z_m=3e-5)


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_a_controller_that_is_not_of_second_order_is_not_accused(controller: str) -> None:
    diagnosis = diagnose([recording(controller, 101, IN_TOLERANCE)], cell_of(controller), max_bins=900, propose=False)
    assert diagnosis.verdict == "none", diagnosis.sentence


@pytest.mark.parametrize("controller", ["second order", "third order"])
def test_a_controller_of_another_order_that_moves_a_heavy_probe_is_no_resonance(controller: str) -> None:
    heavy = recording(controller, 101, replace(IN_TOLERANCE, mass_kg=0.004), heavy_cell_of)
    diagnosis = diagnose([heavy], heavy_cell_of(controller), max_bins=3000, propose=False)
    assert diagnosis.verdict == "none", diagnosis.sentence


def test_targets_that_are_held_and_sampled_with_a_heavy_probe_are_no_drag() -> None:
    """Each target steps the acceleration, and samples at one phase of the cycle miss its mean in proportion to the speed."""
    heavy = recording("held at 500 Hz", 101, IN_TOLERANCE, heavy_cell_of)
    diagnosis = diagnose([heavy], heavy_cell_of("held at 500 Hz"), max_bins=3000, propose=False)
    assert diagnosis.verdict == "none", diagnosis.sentence


def giving_way(share: float) -> Samples:
    """A recording of a robot that gives way under load, by that share of the noise of one height at the largest force."""
    samples, cell = recording("second order", 101), cell_of("second order")
    load = np.maximum(-samples.z_m, 0.0) ** 1.5
    return replace(samples, z_m=samples.z_m + share * cell.robot.position_noise_rms_m * load / load.max())


def test_a_position_loop_that_gives_way_by_less_than_it_can_report_is_not_accused() -> None:
    diagnosis = diagnose([giving_way(1.5)], cell_of("second order"), max_bins=900, propose=False)
    assert diagnosis.verdict == "none", diagnosis.sentence


def test_a_position_loop_that_gives_way_visibly_is_outside_the_list() -> None:
    diagnosis = diagnose([giving_way(12.0)], cell_of("second order"), max_bins=900, propose=False)
    assert diagnosis.verdict == "unknown", diagnosis.sentence


def test_an_effect_replaces_the_tolerance_of_its_own_deviation() -> None:
    problem = make_problem([recording("second order", 101)], cell_of("second order"), max_bins=600)
    around = linearise(problem, {"sensor.gain": {"error": 0.05}}, problem.nominal_eta + 1.0)
    gain = SHARED.index("gain")
    assert not around.space.columns.dense()[gain].any()
    assert around.eta[gain] == 0.0
    others = [k for k in range(len(SHARED)) if k != gain]
    assert all(around.space.columns.dense()[k].any() for k in others)
    assert (around.eta[others] == 1.0).all()
