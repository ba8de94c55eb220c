"""The error of rounding that noise does not dither: as large as the columns say, and accused of nothing."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.special import ndtri

from palpd.cell.cell_file import CellFile, EffectValues, Estimated, cell_from
from palpd.cell.simulation import simulate
from palpd.cell.stages import WRENCH
from palpd.gap.data.rounding import Rounding
from palpd.gap.diagnosis import diagnose
from palpd.gap.first_cell import first_cell
from palpd.gap.model.rounding_error import MOST_COLUMNS, phase_columns, rounding_error, waves
from palpd.testing.plain_cells import cell_of, recording
from palpd.tick import Floats

STEP_N, EACH = 0.1, 20


def mean_errors_N(force_N: Floats, noise_N: float, levels: int = 400) -> Floats:
    """Errors (levels, b) of bins of EACH readings of a force, for levels that lie anywhere, the noise averaged out."""
    shift_N = STEP_N * (np.arange(levels).reshape(-1, 1, 1) + 0.5) / levels
    noise = noise_N * ndtri((np.arange(400) + 0.5) / 400.0)
    within_N = force_N.reshape(1, -1, EACH)
    return np.mean([(np.rint((within_N + shift_N + n) / STEP_N) * STEP_N - shift_N - within_N).mean(axis=-1) for n in noise], axis=0)


@pytest.mark.parametrize("noise", [0.12, 0.2, 0.3])
def test_the_columns_have_the_covariance_of_simulated_rounding_errors(noise: float) -> None:
    """A force that rests, creeps by a third of a step, then moves by two steps and back, the second time at half a step in a bin."""
    ways = (np.zeros(100), np.linspace(0.0, 0.33, 400), np.linspace(0.33, 2.2, 600), np.linspace(2.2, 0.2, 80))
    force_N = STEP_N * np.concatenate(ways)
    errors_N = mean_errors_N(force_N, noise * STEP_N)
    rounding = Rounding(STEP_N, noise * STEP_N, coarse=False)
    turns = force_N.reshape(-1, EACH).mean(axis=1) / STEP_N
    columns = [values for first, values in phase_columns(list(waves(turns, rounding.harmonics_N)), turns, np.zeros(len(turns), np.intp))]
    assert all(len(values) == len(turns) for values in columns), "all of it is one stretch"
    stated, seen = np.array(columns).T @ np.array(columns), errors_N.T @ errors_N / len(errors_N)
    largest = seen.diagonal().max()
    smooth = np.arange(len(turns)) != np.argmax(np.abs(np.diff(turns, 2))) + 1  # a bin in which the speed jumps has no one sweep
    np.testing.assert_allclose(stated[np.ix_(smooth, smooth)], seen[np.ix_(smooth, smooth)], atol=0.05 * largest)
    left_out = (seen.diagonal() - stated.diagonal())[smooth]
    assert np.sqrt(np.maximum(left_out, 0.0)).max() < 0.4 * rounding.undithered_rms_N + 0.1 * largest**0.5


def test_a_force_that_moves_by_many_steps_has_its_phase_in_short_stretches_alone() -> None:
    turns = np.concatenate([np.zeros(10), np.linspace(0.0, 12.0, 60), np.full(10, 12.0)])
    motion = np.repeat([1, 2, 1], [10, 60, 10])
    stretches = {(first, first + len(values)) for first, values in phase_columns(list(waves(turns, np.array([0.02]))), turns, motion)}
    assert sorted(first for first, _ in stretches) == [0, *sorted(end for _, end in stretches)[:-1]]
    assert all(np.ptp(turns[first:end]) <= 2.5 and np.ptp(motion[first:end]) == 0 for first, end in stretches)
    assert len(stretches) == 7


def test_a_recording_of_hundreds_of_presses_has_columns_for_the_largest_errors_alone() -> None:
    cycle = np.concatenate([np.zeros(4), np.linspace(0.3, 3.0, 6), np.linspace(2.8, 0.2, 5)])
    force_N, press = np.tile(cycle, 300), np.repeat(np.arange(300), 15)
    press[np.tile(cycle, 300) == 0.0] = -1
    many: Any = SimpleNamespace(
        bin_press=press,
        phases=SimpleNamespace(presses=300),
        bin_phase=np.tile(np.repeat([0, 1, 2], [4, 6, 5]), 300),
        measured=np.tile(force_N, (7, 1)),
    )
    columns = list(rounding_error(many, Rounding(0.4, 0.02, coarse=False), force_N, np.full(len(force_N), 0.01)))
    assert MOST_COLUMNS // 2 < len(columns) <= MOST_COLUMNS + 8


def coarse(step_noises: float) -> CellFile:
    """The plain cell with a step of fz of that many noises."""
    cell = cell_of("second order")
    sensor = cell.sensor.model_copy(update={"resolution_fz_N": step_noises * cell.sensor.noise_rms_N})
    return cell.model_copy(update={"sensor": sensor})


@pytest.mark.parametrize(("step_noises", "seed"), [(3.0, 1), (4.0, 2), (5.0, 3), (6.0, 4), (7.0, 5), (8.0, 6), (8.0, 7)])
def test_coarse_steps_of_a_healthy_cell_are_no_gap(step_noises: float, seed: int) -> None:
    rng, cell = np.random.default_rng([seed, 5]), coarse(step_noises)
    off = Estimated(bias_N=0.03 * rng.standard_normal(), youngs_modulus=0.02 * rng.standard_normal(), mass_kg=0.003)
    samples = recording("second order", seed, off, lambda _: cell)
    diagnosis = diagnose([samples], cell, max_bins=1500, propose=False)
    assert diagnosis.verdict == "none", diagnosis.sentence


@pytest.mark.parametrize(
    "effects",
    [
        {"tissue.viscoelastic": {"ratio": 0.5, "tau_s": 0.6}},
        {"cable.friction": {"force_N": 0.4}},
        {"cable.spring": {"stiffness_N_per_m": 80.0}},
    ],
)
def test_an_effect_of_several_steps_is_named_through_coarse_ones(effects: EffectValues) -> None:
    motion, cell = recording("second order", 9), coarse(6.0)
    columns = simulate(cell.with_effects(effects), motion.t_s, z_cmd_m=motion.z_cmd_m, noise_seed=2)
    wrench = np.column_stack([columns[name] for name in WRENCH])
    samples = replace(motion, z_m=columns["z_m"], vz_m_per_s=columns["vz_m_per_s"], wrench=wrench)
    diagnosis = diagnose([samples], cell, max_bins=1500, propose=False)
    assert [effect.id for effect in diagnosis.effects] == list(effects), diagnosis.sentence


@pytest.mark.parametrize(("step_noises", "decimals"), [(8.0, 6), (7.54, 2), (7.54, 1)])
def test_a_first_cell_file_has_the_step_that_a_diagnosis_finds(step_noises: float, decimals: int) -> None:
    """Also where readings are printed with fewer digits than their step has: 0.377 N with two decimals or with one."""
    samples = recording("second order", 101, Estimated(), lambda _: coarse(step_noises))
    wrench = np.column_stack([samples.wrench[:, :2], samples.wrench[:, 2].round(decimals), samples.wrench[:, 3:]])
    samples = replace(samples, wrench=wrench)
    finer = coarse(2.62)
    (named,) = diagnose([samples], finer, max_bins=900, propose=False).effects
    assert named.id == "sensor.quantization"
    first = cell_from(first_cell([samples], finer.probe.tip_radius_m).content, "the first cell file")
    _, low_N, high_N = named.parameters["step_N"]
    assert low_N <= first.sensor.resolution_fz_N <= high_N
    assert diagnose([samples], first, max_bins=900, propose=False).verdict == "none"
