"""Healthy cells simulated in a few lines from docs/reference/contract.md, with controllers that the diagnosis does not assume.

No physics comes from `palpd.cell`: it is written again, so that a test of the engine does not use the engine's own.
"""

from collections.abc import Callable
from functools import cache

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import cont2discrete, lfilter

from palpd.cell.cell_file import CellFile, Estimated
from palpd.recording.samples import Samples
from palpd.tick import Floats

FINE_HZ = 4000
RATE_HZ = 500
SERVO_HZ, SERVO_DAMPING = 8.0, 1.0
CONTROLLERS = ("second order", "held at 125 Hz", "held at 500 Hz", "third order", "jerk limit")
NO_DEVIATIONS = Estimated()


def commanded(seed: int) -> Floats:
    """Heights (n,) at FINE_HZ of strokes in free air, holds and presses, no two alike."""
    rng = np.random.default_rng([seed, 11])
    at_m, pieces = 0.012, [np.full(FINE_HZ, 0.012)]

    def move(to_m: float, speed_m_per_s: float, rest_s: float) -> None:
        nonlocal at_m
        way_m, acceleration = to_m - at_m, 0.5
        peak = min(speed_m_per_s, np.sqrt(abs(way_m) * acceleration))
        ramp_s = peak / acceleration
        total_s = abs(way_m) / peak + ramp_s
        t = np.arange(1, int(total_s * FINE_HZ) + 1) / FINE_HZ
        speed = np.clip(np.minimum(t, total_s - t) / ramp_s, 0.0, 1.0) * peak
        path = np.cumsum(speed) / FINE_HZ
        pieces.append(at_m + np.sign(way_m) * path * abs(way_m) / path[-1])
        pieces.append(np.full(int(rest_s * FINE_HZ), to_m))
        at_m = to_m

    for _ in range(2):
        move(0.012 + rng.uniform(0.006, 0.015), rng.uniform(0.01, 0.04), rng.uniform(0.3, 1.0))
        move(0.012, rng.uniform(0.01, 0.04), rng.uniform(0.3, 1.0))
    for _ in range(6):
        move(0.002, 0.02, rng.uniform(0.2, 0.5))
        move(-rng.uniform(0.002, 0.007), rng.uniform(0.004, 0.015), rng.uniform(0.5, 3.0))
        move(rng.uniform(0.002, 0.006), rng.uniform(0.005, 0.02), rng.uniform(0.3, 0.8))
    return np.concatenate(pieces)


def second_order(z_cmd_m: Floats, natural_frequency_Hz: float, damping_ratio: float) -> Floats:
    """The answer (n,) of a second-order servo at rest to commanded heights.

    Args:
        z_cmd_m: Commanded heights (n,) at FINE_HZ.
    """
    w = 2.0 * np.pi * natural_frequency_Hz
    b, a, _ = cont2discrete((np.array([w * w]), np.array([1.0, 2.0 * damping_ratio * w, w * w])), 1.0 / FINE_HZ, "zoh")
    return np.asarray(lfilter(b.ravel(), a, z_cmd_m - z_cmd_m[0]) + z_cmd_m[0])


def follow(controller: str, z_cmd_m: Floats, natural_frequency_Hz: float) -> Floats:
    """Heights (n,) of the tip.

    Args:
        controller: One of CONTROLLERS: "second order", "held at 125 Hz", "held at 500 Hz", "third order", "jerk limit".
        z_cmd_m: Commanded heights (n,) at FINE_HZ.
    """
    if controller.startswith("held"):
        hold = FINE_HZ // (125 if "125" in controller else 500)
        z_cmd_m = np.repeat(z_cmd_m[::hold], hold)[: len(z_cmd_m)]
    if controller == "third order":
        pole = np.exp(-2.0 * np.pi * 5.0 * natural_frequency_Hz / FINE_HZ)
        z_cmd_m = lfilter([1.0 - pole], [1.0, -pole], z_cmd_m - z_cmd_m[0]) + z_cmd_m[0]
    if controller == "jerk limit":
        window = int(0.03 * FINE_HZ)
        z_cmd_m = lfilter(np.full(window, 1.0 / window), [1.0], z_cmd_m - z_cmd_m[0]) + z_cmd_m[0]
    return second_order(z_cmd_m, natural_frequency_Hz, SERVO_DAMPING)


@cache
def identified(controller: str) -> tuple[float, float]:
    """Natural frequency (Hz) and damping ratio of the second-order servo nearest to a controller, as a user would fit them in free air."""
    z_cmd_m = commanded(99)[: 12 * FINE_HZ]
    z_m = follow(controller, z_cmd_m, SERVO_HZ)

    def misfit(x: Floats) -> Floats:
        return np.asarray((second_order(z_cmd_m, float(x[0]), float(x[1])) - z_m)[::16] * 1e5)

    nearest = least_squares(misfit, [SERVO_HZ, SERVO_DAMPING])
    return float(nearest.x[0]), float(nearest.x[1])


def cell_of(controller: str) -> CellFile:
    """The cell file that a user would write for it."""
    natural_frequency_Hz, damping_ratio = identified(controller)
    return CellFile.model_validate(
        {
            "sensor": {"rate_Hz": RATE_HZ},
            "robot": {"servo_natural_frequency_Hz": natural_frequency_Hz, "servo_damping_ratio": damping_ratio},
            "tissue": {"youngs_modulus_Pa": 72000},
        }
    )


def recording(controller: str, seed: int, deviations: Estimated = NO_DEVIATIONS, of_cell: Callable[[str], CellFile] = cell_of) -> Samples:
    """One recording of a healthy cell with these deviations, and press-to-press scatter as declared.

    Args:
        of_cell: Makes the cell file for a controller.
    """
    rng = np.random.default_rng([seed, 12])
    cell = of_cell(controller)
    z_cmd_m = commanded(seed)
    z_m = follow(controller, z_cmd_m, SERVO_HZ * (1.0 + deviations.servo_natural_frequency))
    every = FINE_HZ // RATE_HZ
    v = np.gradient(z_m, 1.0 / FINE_HZ)
    a = np.gradient(v, 1.0 / FINE_HZ)
    sinking = z_m < 0.0
    press = np.cumsum(np.diff(sinking.astype(int), prepend=0) == 1)
    count = press.max() + 1
    surface_m = deviations.surface_z_m + rng.normal(0.0, cell.repeatability.surface_z_m, count)[press]
    stiffness = 1.0 + rng.normal(0.0, cell.repeatability.stiffness, count)[press]
    reduced_Pa = 72000 * (1.0 + deviations.youngs_modulus) / 0.75
    depth_m = np.maximum(surface_m - z_m, 0.0)
    contact_N = 4.0 / 3.0 * reduced_Pa * stiffness * np.sqrt(cell.probe.tip_radius_m) * depth_m**1.5
    fz_N = (contact_N - (cell.probe.mass_kg + deviations.mass_kg) * a) * (1.0 + deviations.gain)
    late = round(deviations.latency_s * FINE_HZ)
    if late > 0:
        fz_N = np.concatenate([np.full(late, fz_N[0]), fz_N[:-late]])
    elif late < 0:
        fz_N = np.concatenate([fz_N[-late:], np.full(-late, fz_N[-1])])
    pole = np.exp(-2.0 * np.pi * 150.0 * (1.0 + deviations.filter_cutoff) / FINE_HZ)
    fz_N = lfilter([1.0 - pole], [1.0, -pole], fz_N)[::every]
    t_s = np.arange(len(fz_N)) / RATE_HZ
    wrench = np.zeros((len(t_s), 6))
    wrench[:, 2] = fz_N + deviations.bias_N + deviations.drift_N_per_min / 60.0 * t_s
    for axis, share, arm_m in zip((0, 1, 3, 4), deviations.crosstalk, (1.0, 1.0, 0.05, 0.05), strict=True):
        wrench[:, axis] = share * arm_m * fz_N
    wrench[:, :3] += rng.normal(0.0, cell.sensor.noise_rms_N, (len(t_s), 3))
    wrench[:, 3:] += rng.normal(0.0, cell.sensor.noise_rms_Nm, (len(t_s), 3))
    for axes, step in (((0, 1), cell.sensor.resolution_fxy_N), ((2,), cell.sensor.resolution_fz_N), ((3, 4, 5), cell.sensor.resolution_Nm)):
        wrench[:, list(axes)] = np.rint(wrench[:, list(axes)] / step) * step if step > 0 else wrench[:, list(axes)]
    reported_m = z_m[::every] + rng.normal(0.0, cell.robot.position_noise_rms_m, len(t_s))
    reported_v = v[::every] + rng.normal(0.0, cell.robot.velocity_noise_rms_m_per_s, len(t_s))
    return Samples(t_s, z_cmd_m[::every], reported_m, reported_v, wrench)
