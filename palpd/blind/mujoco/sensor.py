"""The force sensor and the robot's report, from docs/reference/contract.md: transducer, low-pass, clock, zero, noise, rounding."""

import numpy as np

from palpd.blind.mujoco.servos import linear_filter
from palpd.blind.mujoco.setup import Array, PlantRun, PressPath, Reading, SensorSetup, StatedCell
from palpd.blind.stated_cell import rounded
from palpd.recording.samples import Samples


def low_pass(values: Array, cutoff_Hz: float | None, step_s: float) -> Array:
    """A one-pole low-pass that starts settled on the first row.

    Args:
        values: (n,) or (n, k) input on a uniform grid.
        cutoff_Hz: its cutoff, Hz; None leaves the input alone.

    Returns:
        The filtered values, same shape.
    """
    if cutoff_Hz is None:
        return values
    omega = 2 * np.pi * cutoff_Hz
    columns = values.reshape(len(values), -1)
    out = [column[0] + linear_filter([omega], [1.0, omega], step_s, column - column[0]) for column in columns.T]
    return np.column_stack(out).reshape(values.shape)


def read(run: PlantRun, sensor: SensorSetup, cell: StatedCell, path: PressPath) -> Reading:
    """What the recording would hold without noise and rounding.

    Args:
        run: what the plant did.
        sensor: the true sensor.
        cell: gives the sample rate and the rate of the robot's report.
        path: the commanded motion.

    Returns:
        The noise-free recording.
    """
    wrench = run.wrench.copy()
    for stage in sensor.stages:
        wrench = stage(wrench, run)
    wrench[:, 2] *= 1 + sensor.gain
    wrench[:, [0, 1, 3, 4]] += wrench[:, 2:3] * np.array(sensor.crosstalk)
    step = float(run.t_s[1] - run.t_s[0])
    wrench = low_pass(wrench, sensor.cutoff_Hz, step)
    t = np.arange(int(path.t_s[-1] * cell.rate_Hz) + 1) / cell.rate_Hz
    instants = t * (1 + sensor.clock_skew) - sensor.latency_s
    rows = np.column_stack([np.interp(instants, run.t_s, column) for column in wrench.T])
    rows[:, 2] += sensor.bias_N + sensor.drift_N_per_s * t
    for zero in sensor.zero_stages:
        rows[:, 2] += zero(t, run)
    keep = sensor.dropout(t) if sensor.dropout else np.arange(len(t))
    reports = report_times(path, cell)
    z, vz = (np.interp(t, reports, np.interp(reports, run.t_s, column)) for column in (run.z_m, run.vz_m_per_s))
    return Reading(Samples(t, np.interp(t, path.t_s, path.z_cmd_m), z, vz, rows[keep]), keep)


def report_times(path: PressPath, cell: StatedCell) -> Array:
    """(n,) instants at which the robot reports its state, s; the recording runs straight between them.

    Args:
        path: gives the length of the recording.
        cell: gives the rate.

    Returns:
        The instants, from 0 to just past the end.
    """
    return np.arange(int(path.t_s[-1] * cell.report_rate_Hz) + 2) / cell.report_rate_Hz


def record(reading: Reading, cell: StatedCell, path: PressPath, rng: np.random.Generator, noise_ratio: float = 1.0) -> Samples:
    """The recording: the reading with the stated noise and rounding.

    Args:
        reading: noise-free.
        cell: gives noise and resolution.
        path: gives the robot's report times.
        noise_ratio: true noise of the sensor relative to the stated; within 20 % it is healthy.

    Returns:
        The rows of the CSV.
    """
    samples, reports = reading.samples, report_times(path, cell)
    rms = cell.noises * noise_ratio
    noise = rng.standard_normal(samples.wrench.shape) * rms
    wrench = samples.wrench + noise[reading.noise_row]
    z_noise, vz_noise = rng.standard_normal((2, len(reports)))
    z = samples.z_m + np.interp(samples.t_s, reports, cell.position_noise_rms_m * z_noise)
    vz = samples.vz_m_per_s + np.interp(samples.t_s, reports, cell.velocity_noise_rms_m_per_s * vz_noise)
    return Samples(samples.t_s, samples.z_cmd_m, z, vz, rounded(wrench, cell.steps))
