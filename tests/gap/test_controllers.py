"""Healthy cells whose controllers are no second-order servo are not accused."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lsim

from palpd.cell.cell_file import CellFile, Estimated
from palpd.cell.simulation import predict_motion
from palpd.gap.data.controller_cycle import comb_period_s, held_command_s
from palpd.gap.data.phases import find_phases
from palpd.gap.diagnosis import diagnose
from palpd.gap.model.linearise import linearise
from palpd.gap.model.problem import NOMINAL_ETA, SHARED, make_problem
from palpd.recording.samples import Samples
from palpd.testing.plain_cells import (
    CONTROLLERS,
    FINE_HZ,
    RATE_HZ,
    SERVO_HZ,
    cell_of,
    commanded,
    follow,
    recording,
)

IN_TOLERANCE = Estimated(youngs_modulus=0.03, mass_kg=-0.004, latency_s=0.001, servo_natural_frequency=-0.03, surface_z_m=3e-5)
HEAVIER = IN_TOLERANCE.model_copy(update={"mass_kg": 0.004})


def heavy_cell_of(controller: str) -> CellFile:
    """The cell file of a controller with a probe of 0.5 kg before a quiet sensor, so that errors of the acceleration show."""
    cell = cell_of(controller)
    sensor = cell.sensor.model_copy(update={"noise_rms_N": 0.01, "resolution_fz_N": 0.002})
    return cell.model_copy(update={"probe": cell.probe.model_copy(update={"mass_kg": 0.5}), "sensor": sensor})


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_a_controller_that_is_not_of_second_order_is_not_accused(controller: str) -> None:
    diagnosis = diagnose([recording(controller, 101, IN_TOLERANCE)], cell_of(controller), max_bins=900, propose=False)
    assert diagnosis.verdict == "none", diagnosis.sentence


@pytest.mark.parametrize("controller", ["second order", "third order"])
def test_a_controller_of_another_order_that_moves_a_heavy_probe_is_no_resonance(controller: str) -> None:
    heavy = recording(controller, 101, HEAVIER, heavy_cell_of)
    diagnosis = diagnose([heavy], heavy_cell_of(controller), max_bins=3000, propose=False)
    assert diagnosis.verdict == "none", diagnosis.sentence


def test_a_drag_that_held_targets_may_feign_is_named_with_a_note() -> None:
    """Each target steps the acceleration, and samples at one phase of the cycle miss its mean in proportion to the speed."""
    heavy = recording("held at 500 Hz", 101, IN_TOLERANCE, heavy_cell_of)
    diagnosis = diagnose([heavy], heavy_cell_of("held at 500 Hz"), max_bins=3000, propose=False)
    assert [effect.id for effect in diagnosis.effects] == ["cable.viscous"], diagnosis.sentence
    assert "A controller that holds each target for one sample" in " ".join(diagnosis.notes)


def uncommanded(controller: str) -> Samples:
    """A heavy probe before a quiet sensor, whose recording has no command: the force of inertia is that of the reported motion."""
    return replace(recording(controller, 101, HEAVIER, heavy_cell_of), z_cmd_m=None)


@pytest.mark.parametrize("controller", ["second order", "third order", "jerk limit", "held at 125 Hz"])
def test_a_motion_that_no_command_says_is_no_damped_resonance(controller: str) -> None:
    """Its acceleration is averaged, and noisy: a heavily damped mount would undo the one and average the other."""
    diagnosis = diagnose([uncommanded(controller)], heavy_cell_of(controller), max_bins=3000, propose=False)
    assert diagnosis.verdict == "none", diagnosis.sentence


def test_a_mount_that_rings_is_still_named_without_a_command() -> None:
    still = uncommanded("second order")
    acceleration_m_per_s2 = np.gradient(still.vz_m_per_s, still.t_s)
    w, zeta = 2.0 * np.pi * 14.0, 0.05
    _, ringing_m_per_s2, _ = lsim(([2.0 * zeta * w, w**2], [1.0, 2.0 * zeta * w, w**2]), acceleration_m_per_s2, still.t_s)
    wrench = still.wrench.copy()
    wrench[:, 2] -= 0.3 * 0.5 * (ringing_m_per_s2 - acceleration_m_per_s2)
    diagnosis = diagnose([replace(still, wrench=wrench)], heavy_cell_of("second order"), max_bins=3000, propose=False)
    assert [effect.id for effect in diagnosis.effects] == ["structure.resonance"], diagnosis.sentence


def test_targets_that_are_held_for_several_samples_of_a_heavy_probe_are_no_resonance() -> None:
    """Bins that hold no whole cycles see an alias of it, and a ringing mount fits that."""
    held = recording("held at 125 Hz", 101, IN_TOLERANCE, heavy_cell_of)
    diagnosis = diagnose([held], heavy_cell_of("held at 125 Hz"), max_bins=3000, propose=False)
    assert diagnosis.verdict == "none", diagnosis.sentence


def with_drag(samples: Samples, coefficient_N_s_per_m: float) -> Samples:
    wrench = samples.wrench.copy()
    wrench[:, 2] -= coefficient_N_s_per_m * samples.vz_m_per_s
    return replace(samples, wrench=wrench)


def test_a_drag_is_not_hidden_by_targets_that_might_be_held_and_the_reader_is_told_of_these() -> None:
    """Nothing in the samples shows whether targets are held for each of them: a push has no other cause, a drag has."""
    heavy, cell = recording("second order", 101, IN_TOLERANCE, heavy_cell_of), heavy_cell_of("second order")
    dragged = diagnose([with_drag(heavy, 0.3)], cell, max_bins=1500, propose=False)
    assert [effect.id for effect in dragged.effects] == ["cable.viscous"], dragged.sentence
    assert "record at twice the rate" in " ".join(dragged.notes)
    pushed = diagnose([with_drag(heavy, -0.3)], cell, max_bins=1500, propose=False)
    assert pushed.verdict == "none", pushed.sentence


def with_held_command(samples: Samples, rows: int) -> Samples:
    """The recording of a robot whose command was recorded as the controller held it."""
    assert samples.z_cmd_m is not None
    return replace(samples, z_cmd_m=np.repeat(samples.z_cmd_m[::rows], rows)[: len(samples)])


def test_a_servo_identified_with_smooth_commands_is_not_fast_where_held_commands_were_recorded() -> None:
    held = with_held_command(recording("held at 125 Hz", 101, IN_TOLERANCE), 4)
    diagnosis = diagnose([held], cell_of("held at 125 Hz"), max_bins=900, propose=False)
    assert diagnosis.verdict == "none", diagnosis.sentence


def test_what_a_limit_of_the_jerk_changes_is_tolerated_to_a_few_parts_in_a_hundred() -> None:
    cell, samples = cell_of("jerk limit"), recording("jerk limit", 101)
    problem = make_problem([samples], cell, max_bins=900)
    prepared, heights_m = problem.recordings[0], problem.servo_errors[0].heights_m
    jerky_m = np.interp(prepared.robot_t_s, samples.t_s, follow("jerk limit", commanded(101), SERVO_HZ)[:: FINE_HZ // RATE_HZ])
    assert prepared.z_cmd_m is not None
    change_m = prepared.z_means @ (jerky_m - predict_motion(cell, prepared.robot_t_s, prepared.z_cmd_m))

    def left(columns_m: np.ndarray) -> float:
        rest_m = change_m - columns_m.T @ np.linalg.lstsq(columns_m.T, change_m, rcond=None)[0]
        return float(np.linalg.norm(rest_m) / np.linalg.norm(change_m))

    every = np.array(list(heights_m.values()))
    sizes = np.linalg.lstsq(every.T, change_m, rcond=None)[0]
    assert left(every) < 0.05
    assert np.abs(sizes).max() < 4.0, dict(zip(heights_m, sizes, strict=True))
    assert left(np.array([column_m for name, column_m in heights_m.items() if name != "jerk limit"])) > 2.0 * left(every)


def test_the_cycle_of_a_controller_is_found_in_its_command_or_else_in_the_force() -> None:
    cell = heavy_cell_of("held at 125 Hz")
    samples = recording("held at 125 Hz", 101, IN_TOLERANCE, heavy_cell_of)
    assert held_command_s(samples) is None
    assert comb_period_s(samples, find_phases(samples, cell)) == pytest.approx(0.008, abs=2e-5)
    assert held_command_s(with_held_command(samples, 4)) == pytest.approx(0.008)


@pytest.mark.parametrize("frequency_Hz", [30.0, 60.0, 125.0])
def test_a_vibration_and_a_ringing_mount_are_no_cycle_of_a_controller(frequency_Hz: float) -> None:
    samples, cell = recording("second order", 101, IN_TOLERANCE, heavy_cell_of), heavy_cell_of("second order")
    phases = find_phases(samples, cell)
    assert comb_period_s(samples, phases) is None
    turns = 2.0 * np.pi * frequency_Hz * samples.t_s
    for added_N in (0.05 * np.sin(turns) + 0.03 * np.sin(2.0 * turns), 0.05 * phases.moving * np.sin(turns)):
        wrench = samples.wrench.copy()
        wrench[:, 2] += added_N
        assert comb_period_s(replace(samples, wrench=wrench), phases) is None


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
    around = linearise(problem, {"sensor.gain": {"error": 0.05}}, NOMINAL_ETA + 1.0)
    gain = SHARED.index("gain")
    assert not around.space.columns.dense()[gain].any()
    assert around.eta[gain] == 0.0
    others = [k for k in range(len(SHARED)) if k != gain]
    assert all(around.space.columns.dense()[k].any() for k in others)
    assert (around.eta[others] == 1.0).all()
