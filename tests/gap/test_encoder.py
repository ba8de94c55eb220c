"""A rig whose heights are an encoder's: rounded to steps of 10 µm, its speeds their slope, before a quiet sensor."""

from dataclasses import replace

import numpy as np
import pytest

from palpd.cell.cell_file import CellFile
from palpd.gap.diagnosis import diagnose
from palpd.gap.first_cell import first_cell
from palpd.recording.samples import Samples
from palpd.testing.plain_cells import FINE_HZ, RATE_HZ, commanded, second_order
from palpd.tick import Floats
from tests.gap.test_rigs import names

STEP_M = 1e-5
CELL = CellFile.model_validate(
    {
        "sensor": {"rate_Hz": RATE_HZ, "filter_cutoff_Hz": None, "noise_rms_N": 0.01, "resolution_fz_N": 0.0},
        "robot": {"servo_natural_frequency_Hz": 6.0, "servo_damping_ratio": 0.8, "position_noise_rms_m": STEP_M / 12**0.5},
        "tissue": {"youngs_modulus_Pa": 60000},
    }
)


def direction(z_m: Floats) -> Floats:
    """1 on the way up and -1 on the way down; friction stays as it is while the probe rests, and turns over a tenth of a millimetre."""
    turned_m, out = 0.0, np.zeros(len(z_m))
    for k, change_m in enumerate(np.diff(z_m).tolist(), start=1):
        turned_m = min(max(turned_m + change_m, -5e-5), 5e-5)
        out[k] = turned_m / 5e-5
    return out


def recorded(*, friction_N: float = 0.0, with_command: bool = False) -> Samples:
    z_cmd_m = commanded(3)
    z_m = second_order(z_cmd_m, 6.0, 0.8)
    v = np.gradient(z_m, 1.0 / FINE_HZ)
    fz_N = 4.0 / 3.0 * 60000 / 0.75 * CELL.probe.tip_radius_m**0.5 * np.maximum(-z_m, 0.0) ** 1.5
    fz_N += -CELL.probe.mass_kg * np.gradient(v, 1.0 / FINE_HZ) - friction_N * direction(z_m)
    every = FINE_HZ // RATE_HZ
    t_s, rounded_m = np.arange(len(z_m[::every])) / RATE_HZ, STEP_M * np.rint(z_m[::every] / STEP_M)
    wrench = np.zeros((len(t_s), 6))
    wrench[:, 2] = fz_N[::every] + np.random.default_rng(1).normal(0.0, 0.01, len(t_s))
    samples = Samples(t_s, z_cmd_m[::every], rounded_m, np.gradient(rounded_m, t_s), wrench)
    return samples if with_command else replace(samples, z_cmd_m=None)


@pytest.mark.parametrize("with_command", [False, True])
def test_steps_of_the_height_are_no_gap(with_command: bool) -> None:
    diagnosis = diagnose([recorded(with_command=with_command)], CELL)
    assert (diagnosis.verdict, names(diagnosis)) == ("none", set())


def test_friction_behind_an_encoder_is_named_alone() -> None:
    assert names(diagnose([recorded(friction_N=0.1)], CELL)) == {"cable.friction"}


@pytest.mark.parametrize("in_motion", [False, True])
def test_the_servo_of_a_first_cell_file_is_the_recordings_own(in_motion: bool) -> None:
    whole = recorded(with_command=True)
    assert whole.z_cmd_m is not None
    begin = int(np.flatnonzero(np.diff(whole.z_cmd_m) < 0.0)[100]) if in_motion else 0
    cut = slice(begin, begin + RATE_HZ * 12)
    robot = first_cell([Samples(whole.t_s[cut], whole.z_cmd_m[cut], whole.z_m[cut], whole.vz_m_per_s[cut], whole.wrench[cut])]).blocks[
        "robot"
    ]
    assert robot is not None
    assert (robot["servo_natural_frequency_Hz"].value, robot["servo_damping_ratio"].value) == pytest.approx((6.0, 0.8), rel=0.01)
