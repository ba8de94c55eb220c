"""Recordings in which nothing moves, the sensor stands at its limit, or a clock is far out."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.signal import bilinear, lfilter

from palpd.cell.cell_file import CellFile, Estimated, nominal
from palpd.cell.tip_motion import estimate_tip_motion
from palpd.errors import RecordingError
from palpd.gap.data.phases import find_phases
from palpd.gap.diagnosis import Diagnosis, diagnose
from palpd.gap.infer.candidates import ringing_frequencies, spectral_peaks
from palpd.gap.infer.settle import settle
from palpd.gap.model.problem import make_problem
from palpd.recording.samples import Samples
from palpd.testing.plain_cells import cell_of, recording
from palpd.tick import Floats
from tests.gap.test_diagnosis import recording as simulated
from tests.gap.test_rigs import names, quick, rig


def changed(cell: CellFile, **blocks: Any) -> CellFile:
    content = cell.model_dump(exclude_unset=True)
    return CellFile.model_validate(content | {key: (content.get(key) or {}) | value for key, value in blocks.items()})


def resting(rounding: bool, commanded: bool, surface_m: float | None) -> tuple[Samples, CellFile]:
    """A drifting sensor on a robot that rests at 12.3 mm, its heights exact or with the last bit to and fro."""
    samples, cell = rig(rate_Hz=20.0, seconds=20.0, tissue=surface_m is not None)
    rng, n = np.random.default_rng(0), len(samples)
    z_m = np.full(n, 0.0123)
    if rounding:
        z_m = z_m + np.spacing(z_m) * rng.integers(-1, 2, n)
    wrench = np.zeros((n, 6))
    wrench[:, 2] = 0.01 * rng.standard_normal(n) + 0.05 * samples.t_s / 20.0
    cell = changed(cell, sensor={"noise_rms_N": 0.01})
    if surface_m is not None:
        cell = changed(cell, tissue={"surface_z_m": surface_m})
    still = replace(samples, z_m=z_m, vz_m_per_s=np.gradient(z_m, samples.t_s), wrench=wrench)
    return replace(still, z_cmd_m=z_m) if commanded else still, cell


@pytest.mark.parametrize("surface_m", [None, 0.0, 0.02], ids=["no tissue", "in the air", "in the tissue"])
@pytest.mark.parametrize("commanded", [False, True])
@pytest.mark.parametrize("rounding", [False, True])
def test_where_nothing_moves_there_is_an_answer_and_no_motion_to_advise(rounding: bool, commanded: bool, surface_m: float | None) -> None:
    samples, cell = resting(rounding, commanded, surface_m)
    diagnosis = diagnose([samples], cell, max_bins=600)
    assert any("nothing moves" in note for note in diagnosis.notes)
    assert diagnosis.gap.where is not None
    assert diagnosis.gap.where["phase"] in ("free_still", "holding")
    assert diagnosis.proposal is None


def test_the_last_bit_of_a_constant_height_is_no_motion() -> None:
    samples, cell = resting(rounding=True, commanded=True, surface_m=None)
    assert not find_phases(samples, cell).moving.any()


def saturated(limit: float, modulus_Pa: float, known: bool = False) -> Diagnosis:
    samples, cell = rig(rate_Hz=20.0, seconds=30.0)
    wrench = samples.wrench.copy()
    wrench[:, 2] = np.minimum(wrench[:, 2], limit * wrench[:, 2].max())
    modulus = {"tolerances": {} if known else {"youngs_modulus": 1.0}, "tissue": {"youngs_modulus_Pa": modulus_Pa}}
    return quick(replace(samples, wrench=wrench), changed(cell, **modulus))


@pytest.mark.parametrize("limit", [0.5, 0.8])
@pytest.mark.parametrize("modulus_Pa", [1.5e4, 5e4, 2e5])
def test_a_sensor_at_its_limit_is_found_where_nobody_knows_the_modulus(limit: float, modulus_Pa: float) -> None:
    diagnosis = saturated(limit, modulus_Pa)
    assert [e.id for e in diagnosis.effects] == ["sensor.saturation"], diagnosis.sentence
    assert any("looks saturated" in note for note in diagnosis.notes)


def test_speeds_that_are_dead_are_refused() -> None:
    samples, cell = rig()
    with pytest.raises(RecordingError, match="vz_m_per_s is 0 throughout and z_m spans"):
        quick(replace(samples, vz_m_per_s=np.zeros(len(samples))), cell)


def test_a_lateral_channel_that_no_noise_is_stated_for_needs_none() -> None:
    samples, cell = rig(rate_Hz=10.0, seconds=5.0)
    wrench = samples.wrench.copy()
    wrench[:, 4] = 1e-4 * wrench[:, 2]
    diagnosis = quick(replace(samples, wrench=wrench), cell)  # a warning is an error
    assert np.isfinite(diagnosis.decision.p_unknown)


def test_one_largest_reading_is_not_called_saturated() -> None:
    samples, cell = rig(rate_Hz=10.0, seconds=4.9)
    assert not any("saturated" in note for note in quick(samples, cell).notes)


def test_a_hold_at_the_largest_force_is_not_called_saturated() -> None:
    samples, cell = rig(rate_Hz=20.0, seconds=20.0)
    z_m = np.maximum(samples.z_m, 0.6 * samples.z_m.min())
    exact_N = 16.0 / 9.0 * 5e4 * np.sqrt(5e-3) * np.maximum(-z_m, 0.0) ** 1.5
    wrench = np.zeros((len(samples), 6))
    wrench[:, 2] = np.rint(exact_N / 0.05) * 0.05
    held = replace(samples, z_m=z_m, vz_m_per_s=np.gradient(z_m, samples.t_s), wrench=wrench)
    assert not any("saturated" in note for note in quick(held, changed(cell, sensor={"resolution_fz_N": 0.05})).notes)


def test_a_plateau_whose_last_digit_moves_is_called_saturated() -> None:
    samples, cell = rig(rate_Hz=20.0, seconds=30.0)
    wrench = samples.wrench.copy()
    limit_N = 0.6 * wrench[:, 2].max()
    wrench[:, 2] = np.minimum(wrench[:, 2], limit_N + 1e-4 * np.random.default_rng(0).integers(-1, 2, len(samples)) * limit_N)
    assert any("saturated" in note for note in quick(replace(samples, wrench=wrench), cell).notes)


def from_row(samples: Samples, first: int) -> Samples:
    """The recording without its first rows."""
    assert samples.z_cmd_m is not None
    t_s = samples.t_s[first:] - samples.t_s[first]
    return Samples(t_s, samples.z_cmd_m[first:], samples.z_m[first:], samples.vz_m_per_s[first:], samples.wrench[first:])


@pytest.mark.parametrize("speed_m_per_s", [0.008, 0.018])
def test_a_healthy_recording_that_starts_in_motion_is_healthy(speed_m_per_s: float) -> None:
    samples = recording("second order", 5)
    assert samples.z_cmd_m is not None
    first = int(np.flatnonzero(np.gradient(samples.z_cmd_m, samples.t_s) < -speed_m_per_s)[25])
    assert quick(from_row(samples, first), cell_of("second order")).verdict == "none"


def test_a_recording_that_starts_in_a_hold_of_relaxing_tissue_names_the_tissue_alone() -> None:
    samples = simulated(nominal(), {"tissue.viscoelastic": {"ratio": 1.0, "tau_s": 2.0}})
    first = int(np.argmax(samples.z_m < -0.0039)) + 10
    diagnosis = quick(from_row(samples, first), nominal())
    assert [effect.id for effect in diagnosis.effects] == ["tissue.viscoelastic"], diagnosis.sentence


def with_a_fast_sensor_clock(ratio: float) -> Diagnosis:
    samples = recording("second order", 101)
    t_s = samples.t_s
    wrench = np.column_stack([np.interp(t_s * (1.0 + ratio), t_s, samples.wrench[:, axis]) for axis in range(6)])
    return diagnose([replace(samples, wrench=wrench)], cell_of("second order"), max_bins=900, propose=False)


def test_a_clock_that_is_farther_out_than_working_clocks_is_reported() -> None:
    diagnosis = with_a_fast_sensor_clock(0.0025)
    assert [(e.id, e.at_bound) for e in diagnosis.effects] == [("clock.skew", ["ratio"])], diagnosis.sentence
    assert any("expected at most 0.001" in note for note in diagnosis.notes)


def test_a_clock_as_working_clocks_are_is_named_without_a_doubt() -> None:
    diagnosis = with_a_fast_sensor_clock(0.0008)
    assert [(e.id, e.at_bound) for e in diagnosis.effects] == [("clock.skew", [])], diagnosis.sentence
    assert not any("expected at most 0.001" in note for note in diagnosis.notes)


def shaking_rig(rate_Hz: float, frequency_Hz: float) -> tuple[Samples, Floats]:
    """A rig that nobody commands, shaken at one frequency, and its true speeds."""
    t_s = np.arange(int(8.0 * rate_Hz)) / rate_Hz
    omega = 2.0 * np.pi * frequency_Hz
    z_m, speed = 1e-3 * np.sin(omega * t_s), 1e-3 * omega * np.cos(omega * t_s)
    rng = np.random.default_rng(2)
    reported = speed + 1e-4 * rng.standard_normal(len(t_s))
    return Samples(t_s, None, z_m + 1e-6 * rng.standard_normal(len(t_s)), reported, np.zeros((len(t_s), 6))), speed


@pytest.mark.parametrize("frequency_Hz", [0.5, 10.0, 25.0])
def test_a_motion_that_nobody_commands_is_not_smoothed_by_a_servo_that_may_not_exist(frequency_Hz: float) -> None:
    samples, speed = shaking_rig(500.0, frequency_Hz)
    cell = changed(cell_of("second order"), robot={"velocity_noise_rms_m_per_s": 1e-4, "position_noise_rms_m": 1e-6})
    motion = estimate_tip_motion(cell, samples.t_s, samples.z_m, samples.vz_m_per_s)
    inner = slice(100, -100)
    error = float(np.sqrt(np.mean((motion.vz_m_per_s - speed)[inner] ** 2)))
    assert error < 1.5e-4, error


def test_a_cantilever_of_known_stiffness_is_part_of_the_nominal_cell() -> None:
    samples, cell = rig(rate_Hz=20.0, seconds=20.0)
    depth_m = np.maximum(-samples.z_m, 0.0)
    force_N = 16.0 / 9.0 * 5e4 * np.sqrt(5e-3) * depth_m**1.5
    stiffness_N_per_m = 4.0 * float(force_N.max() / depth_m.max())
    z_m = samples.z_m - force_N / stiffness_N_per_m
    bending = replace(samples, z_m=z_m, vz_m_per_s=np.gradient(z_m, samples.t_s))
    assert quick(bending, cell).verdict != "none"
    diagnosis = quick(bending, changed(cell, sensor={"stiffness_N_per_m": stiffness_N_per_m}))
    assert diagnosis.verdict == "none", diagnosis.sentence


def relaxing_holds(modulus_Pa: float) -> tuple[Samples, CellFile]:
    """Quick presses with long holds, a slow relaxation, a modulus that nobody knows."""
    _, cell = rig(rate_Hz=20.0, seconds=1.0)
    t_s = np.arange(1500) / 20.0
    phase_s = t_s % 15.0
    z_m = 5e-3 * (0.3 - 0.8 * np.clip(phase_s / 0.4, 0.0, 1.0) + 0.8 * np.clip((phase_s - 13.5) / 0.4, 0.0, 1.0))
    elastic_N = 16.0 / 9.0 * 5e4 * np.sqrt(5e-3) * np.maximum(-z_m, 0.0) ** 1.5
    arm_N = np.zeros(len(t_s))
    for k in range(1, len(t_s)):
        arm_N[k] = arm_N[k - 1] * np.exp(-0.05 / 4.0) + 0.3 * (elastic_N[k] - elastic_N[k - 1])
    rng = np.random.default_rng(3)
    wrench = np.zeros((len(t_s), 6))
    wrench[:, 2] = np.maximum(elastic_N + arm_N, 0.0) + cell.sensor.noise_rms_N * rng.standard_normal(len(t_s))
    samples = Samples(t_s, None, z_m + 1e-6 * rng.standard_normal(len(t_s)), np.gradient(z_m, t_s), wrench)
    return samples, changed(cell, tolerances={"youngs_modulus": 1.0}, tissue={"youngs_modulus_Pa": modulus_Pa})


@pytest.mark.parametrize("modulus_Pa", [2e4, 5e4, 2e5])
def test_the_place_of_a_gap_does_not_depend_on_a_modulus_that_nobody_knows(modulus_Pa: float) -> None:
    samples, unknown = relaxing_holds(modulus_Pa)
    known = changed(unknown, tolerances={"youngs_modulus": 0.02}, tissue={"youngs_modulus_Pa": 5e4})
    free, stated = quick(samples, unknown), quick(samples, known)
    assert "tissue.viscoelastic" in names(free), free.sentence
    assert free.gap.where == stated.gap.where


def test_a_slow_vibration_is_found_below_what_the_servo_explains() -> None:
    samples, cell = recording("second order", 101, Estimated(servo_natural_frequency=-0.04)), cell_of("second order")
    swinging = replace(samples, z_m=samples.z_m + 8e-7 * np.sin(2.0 * np.pi * 2.0 * samples.t_s))
    nominal = settle(make_problem([swinging], cell, max_bins=900))
    predicted = nominal.problem.raw_prediction(nominal.problem.recordings[0], nominal.problem.cell_at({}, nominal.fit.eta))
    assert any(abs(peak_Hz - 2.0) < 0.02 for peak_Hz in spectral_peaks(nominal.problem, predicted))


@pytest.mark.parametrize("over_servo", [0.9, 2.1, 4.4])
def test_a_search_for_a_resonance_starts_near_its_frequency(over_servo: float) -> None:
    samples, cell = recording("second order", 101, Estimated()), cell_of("second order")
    frequency_Hz, damping_ratio = over_servo * cell.robot.servo_natural_frequency_Hz, 0.03
    w = 2.0 * np.pi * frequency_Hz
    b, a = bilinear([2.0 * damping_ratio * w, w**2], [1.0, 2.0 * damping_ratio * w, w**2], samples.rate_Hz)
    push_m_per_s2 = np.gradient(samples.vz_m_per_s, samples.t_s)
    wrench = samples.wrench.copy()
    wrench[:, 2] -= 0.5 * cell.probe.mass_kg * (lfilter(b, a, push_m_per_s2) - push_m_per_s2)
    nominal = settle(make_problem([replace(samples, wrench=wrench)], cell, max_bins=900))
    predicted = nominal.problem.raw_prediction(nominal.problem.recordings[0], nominal.problem.cell_at({}, nominal.fit.eta))
    starts_Hz = ringing_frequencies(nominal.problem, predicted)
    assert any(abs(start_Hz / frequency_Hz - 1.0) < 0.05 for start_Hz in starts_Hz), starts_Hz
