"""What the cell file does not state of noise and known effects comes from the recording and from the file's own list."""

from dataclasses import replace

import numpy as np
import pytest

from palpd.cell.cell_file import CellFile, nominal
from palpd.cell.simulation import simulate
from palpd.cell.stages import WRENCH
from palpd.gap.data.recorded_noise import noise_of_fz_N, with_recorded_noise
from palpd.gap.diagnosis import diagnose
from palpd.gap.model.problem import NOMINAL_ETA, make_problem
from palpd.recording.samples import Samples
from palpd.testing.plain_cells import recording


def in_nanonewtons(samples: Samples) -> Samples:
    return replace(samples, wrench=1e-9 * samples.wrench)


def test_noise_and_resolution_that_are_not_stated_are_those_of_the_recording() -> None:
    cell, _, notes = with_recorded_noise([in_nanonewtons(recording("second order", 101))], CellFile.model_validate({}))
    assert cell.sensor.noise_rms_N == pytest.approx(0.05e-9, rel=0.1)
    assert cell.sensor.resolution_fz_N == pytest.approx(0.131e-9, rel=0.01)
    assert "noise_rms_N" in notes[0]


def test_noise_before_rounding_is_that_of_lateral_axes_where_these_are_healthy() -> None:
    samples = recording("second order", 101)
    assert noise_of_fz_N([samples], nominal()) == pytest.approx(0.05, rel=0.05)
    quieter = replace(samples, wrench=0.8 * samples.wrench)
    assert noise_of_fz_N([quieter], nominal()) == pytest.approx(0.04, rel=0.05)
    silent = replace(samples, wrench=np.where(np.arange(6) == 2, samples.wrench, 0.0))
    assert noise_of_fz_N([silent], nominal()) == noise_of_fz_N([in_nanonewtons(samples)], nominal()) == 0.05


def test_stated_noise_stays_and_is_questioned_where_the_recording_shows_another() -> None:
    samples = recording("second order", 101)
    assert with_recorded_noise([samples], nominal()) == (nominal(), [], [])
    cell, notes, _ = with_recorded_noise([in_nanonewtons(samples)], nominal())
    assert cell == nominal()
    assert "sensor.noise_rms_N is 0.05 and the recording shows 4.9" in notes[0]


def test_known_effects_of_the_cell_file_are_no_gap() -> None:
    known = nominal().with_effects({"cable.spring": {"stiffness_N_per_m": 30.0}, "robot.lag": {"bandwidth_ratio": 0.7}})
    samples = recording("second order", 101)
    assert samples.z_cmd_m is not None
    columns = simulate(known, samples.t_s, z_cmd_m=samples.z_cmd_m, noise_seed=1)
    same = Samples(samples.t_s, samples.z_cmd_m, columns["z_m"], columns["vz_m_per_s"], np.column_stack([columns[name] for name in WRENCH]))
    diagnosis = diagnose([same], known, max_bins=900, propose=False)
    assert diagnosis.verdict == "none", diagnosis.sentence
    assert diagnosis.enriched_cell().effects == known.effects
    problem = make_problem([same], nominal(), max_bins=600)
    assert np.abs(problem.data - problem.predict({}, NOMINAL_ETA)).max() > 20.0


def test_readings_that_rest_within_a_level_say_little_of_the_noise_and_question_no_stated_one() -> None:
    samples = recording("second order", 101)
    step_N = 8.0 * 0.05
    within = np.rint((samples.wrench[:, :2] + 0.1 * step_N) / step_N) * step_N
    coarse = replace(samples, wrench=np.column_stack([within, samples.wrench[:, 2:]]))
    cell = nominal().model_copy(update={"sensor": nominal().sensor.model_copy(update={"resolution_fxy_N": step_N})})
    assert with_recorded_noise([coarse], cell) == (cell, [], [])
    assert noise_of_fz_N([coarse], cell) == 0.05
