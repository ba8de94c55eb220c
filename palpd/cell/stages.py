"""The stages of the simulated cell, from where the tip is to what the sensor shows of it.

The stages are robot (target to reported height), tip (where it really is), tissue (what it feels), probe (what else pushes), clock and
sensor; after the nominal physics of each come the effects of that site. Wrenches are what the environment does to the probe, along
base axes, gravity tared away. `palpd.cell.stepped` and `palpd.cell.simulation` hand stretches of samples through the same stages.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from palpd.cell.cell_file import CellFile
from palpd.cell.dynamics import Floats, Memory, delayed, limited_N, lowpass, shifted
from palpd.cell.physics import Physics
from palpd.cell.span import Constants, Span

WRENCH = ("fx_N", "fy_N", "fz_N", "tx_Nm", "ty_Nm", "tz_Nm")


# from the tip to the reading's mean


def press_tissue(s: Span, what: Physics, memory: Memory) -> None:
    """The force on a tip that is where it is."""
    s.touch(what.constants.surface_z_m)
    what.apply("tissue", s, memory)
    if (stiffness := what.constants.wall_stiffness_N_per_m) and s.nominal is None:
        there = s.t_s >= what.constants.wall_after_s
        wall_N = stiffness * np.maximum(what.constants.wall_z_m - s.tip_m, 0.0)
        s.contact_N = np.where(there, wall_N, s.contact_N)


def memory_copy(memory: Memory) -> Memory:
    """A memory that later samples do not change: its blocks are copied, their arrays are not."""
    return {key: memory_copy(value) if isinstance(value, dict) else value for key, value in memory.items()}


def solve_contact(s: Span, what: Physics, memory: Memory) -> None:
    """Tip, depth and contact force; where the tip gives way, tip = z + compliance · force is solved by secants, sample by sample.

    A force that grows with depth makes the residual fall at least as fast as the force rises, which bounds the secant's slope. A secant
    from the air into a hard tissue says little of the slope in it; there Hertz's stiffness bounds it, too.
    """
    s.tip_m = s.z_m
    what.apply("tip", s, memory)
    compliance = what.constants.tip_compliance_m_per_N
    if compliance == 0.0:
        press_tissue(s, what, memory)
        return
    rigid_m = s.tip_m

    def residual_N(force_N: Floats) -> tuple[Floats, Memory]:
        trial = memory_copy(memory)
        s.tip_m = rigid_m + force_N * compliance
        press_tissue(s, what, trial)
        return s.contact_N - force_N, trial

    def hertz_slope() -> Floats:
        stiff = np.divide(1.5 * np.abs(s.contact_N), s.depth_m, out=np.zeros_like(s.depth_m), where=s.depth_m > 0.0)
        return np.asarray(-1.0 - stiff * compliance)

    last_N = np.full_like(rigid_m, memory.get("force_N", 0.0))
    last_gap, trial = residual_N(last_N)
    if last_gap.any():
        force_N = last_N - last_gap / hertz_slope()
        for _ in range(60):
            gap, trial = residual_N(force_N)
            if float(np.abs(gap).max()) <= 1e-12 * float(np.abs(force_N).max()):
                break
            step = force_N - last_N
            slope = np.minimum((gap - last_gap) / np.where(step == 0.0, 1.0, step), -1.0)
            slope[step == 0.0] = -1.0
            if (entered := (gap > 0.0) & (last_gap < 0.0)).any():
                slope[entered] = np.minimum(slope, hertz_slope())[entered]
            last_N, last_gap = force_N, gap
            force_N = force_N - gap / slope
    trial["force_N"] = float(s.contact_N[-1])
    memory.update(trial)


def loaded_axes(s: Span) -> Iterator[tuple[str, Floats]]:
    """Name and column (n,) of the axes that carry anything."""
    for name in WRENCH:
        column = getattr(s, name)
        if not isinstance(column, float):
            yield name, column


def read_mean(s: Span, what: Physics, memory: Memory) -> None:
    """From the wrench on the sensor to the reading's mean."""
    for name, share in crosstalk_shares(what.constants):
        setattr(s, name, getattr(s, name) + share * s.fz_N)
    what.apply("sensor", s, memory)
    filter_axes(s, memory)
    shift_zero(s)


def load_sensor(s: Span, what: Physics, memory: Memory, here: Memory) -> None:
    """From motion to the wrench on the sensor, its gain included."""
    solve_contact(s, what, here)
    s.fz_N = s.contact_N - what.constants.mass_kg * s.az_m_per_s2
    if s.nominal is not None:
        s.nominal.add_rest(s, WRENCH)
    add_other_loads(s, what, memory)


def add_other_loads(s: Span, what: Physics, memory: Memory) -> None:
    """What else acts on the sensor, when its wrench is sampled, and its gain."""
    c = what.constants
    what.apply("probe", s, memory)
    if s.nominal is not None:
        s.nominal.read(s, WRENCH)
    if c.delay_s or c.skew or not isinstance(s.lead_s, float):
        if s.even_s and not c.skew and isinstance(s.lead_s, float):
            for name, column in loaded_axes(s):
                setattr(s, name, shifted(column, (c.delay_s + s.lead_s) / s.even_s))
        else:
            when_s = s.t_s * (1.0 + c.skew) - c.delay_s - s.lead_s
            for name, column in loaded_axes(s):
                setattr(s, name, delayed(column, s.t_s, when_s, memory.setdefault(f"late {name}", {})))
    what.apply("clock", s, memory)
    s.fz_N = s.fz_N * c.gain


def crosstalk_shares(c: Constants) -> list[tuple[str, float]]:
    """Axes into which fz leaks, and the share of it."""
    shares = (("fx_N", c.fx_per_fz), ("fy_N", c.fy_per_fz), ("tx_Nm", c.tx_per_fz_m), ("ty_Nm", c.ty_per_fz_m))
    return [(name, share) for name, share in shares if share]


def filter_axes(s: Span, memory: Memory) -> None:
    """Let each axis that carries anything pass the filter of the sensor."""
    if np.isfinite(s.constants.cutoff_Hz) or s.nominal is not None:
        for name, column in loaded_axes(s):
            setattr(s, name, filtered_axis(column, s, memory.setdefault(f"filtered {name}", {})))


def filtered_axis(column: Floats, s: Span, memory: Memory) -> Floats:
    """A column behind the filter of the sensor; one that has passed the stated filter passes the ratio of both.

    Args:
        column: Values (n,) of an axis.

    Returns:
        The filtered values (n,).
    """
    if s.nominal is not None:
        return s.nominal.refiltered(column, s)
    cutoff_Hz = s.constants.cutoff_Hz
    return lowpass(column, s.dt_s, -2.0 * np.pi * cutoff_Hz, memory) if np.isfinite(cutoff_Hz) else column


def shift_zero(s: Span) -> None:
    """Add bias and drift to fz."""
    c = s.constants
    if c.bias_N or c.drift_N_per_s:
        s.fz_N = s.fz_N + (c.bias_N + c.drift_N_per_s * s.t_s)


def wrench_array(s: Span) -> Floats:
    """The six columns, (n, 6)."""
    wrench = np.zeros((len(s.t_s), 6))
    for axis, name in enumerate(WRENCH):
        wrench[:, axis] = getattr(s, name)
    return wrench


# what readings scatter by


def clip_and_round_mean(s: Span) -> None:
    """Clip and round the mean as it is on average: noise dithers the rounding, which leaves Σ (-1)^k q/πk sin(2πkf/q) e^(-2(πkσ/q)²)."""
    c = s.constants
    if c.limit_N < np.inf:
        s.fz_N = limited_N(s.fz_N, c.limit_N, c.knee_N)
    if c.step_N <= 0.0:
        return
    dither = c.noise_rms_N / c.step_N
    if dither < 0.05:
        s.fz_N = _rounded(s.fz_N, c.step_N)
        return
    phase = 2.0 * np.pi * s.fz_N / c.step_N
    for k in range(1, int(1.4 / dither) + 2):
        weight = (-1) ** k * c.step_N / (np.pi * k) * np.exp(-2.0 * (np.pi * k * dither) ** 2)
        s.fz_N = s.fz_N + weight * np.sin(k * phase)


def _rounded(x: Floats, step: float) -> Floats:
    if step <= 0.0:
        return x
    result: Floats = np.rint(x / step) * step
    return result


def scattered_wrench(wrench: Floats, s: Span, rng: np.random.Generator, memory: Memory) -> Floats:
    """Noise, clipping, a coarse step and held samples on the wrench of a span.

    Args:
        wrench: Mean readings (n, 6).

    Returns:
        The readings (n, 6).
    """
    c = s.constants
    wrench = wrench + rng.standard_normal(wrench.shape) * _noise_rms(c.noise_rms_N, c.noise_rms_Nm)
    if c.limit_N < np.inf:
        wrench[:, 2] = limited_N(wrench[:, 2], c.limit_N, c.knee_N)
    wrench[:, 2] = _rounded(wrench[:, 2], c.step_N)
    if c.dropout_rate_Hz > 0.0:
        _hold_dropouts(wrench, s, rng, memory.setdefault("dropout", {}))
    return wrench


def _noise_rms(noise_N: float, noise_Nm: float) -> Floats:
    return np.array([noise_N] * 3 + [noise_Nm] * 3)


def _hold_dropouts(wrench: Floats, s: Span, rng: np.random.Generator, memory: Memory) -> None:
    """From time to time the last good row stands for a while."""
    begins = rng.random(len(wrench)) < s.constants.dropout_rate_Hz * s.dt_s
    left_s, held = memory.get("left_s", 0.0), memory.get("held", wrench[0].copy())
    dt_s = np.broadcast_to(s.dt_s, len(wrench)).tolist()
    for k, begin in enumerate(begins.tolist()):
        if left_s > 0.0:
            wrench[k] = held
            left_s -= dt_s[k]
        elif begin:
            wrench[k] = held
            left_s = s.constants.dropout_length_s - dt_s[k]
        else:
            held = wrench[k].copy()
    memory.update(left_s=left_s, held=held)


class Reporting(NamedTuple):
    """Steps that a recording rounds the readings to, and noise of the reported motion (rms)."""

    resolution_fxy_N: float
    resolution_fz_N: float
    resolution_Nm: float
    position_noise_rms_m: float
    velocity_noise_rms_m_per_s: float

    @property
    def steps(self) -> Floats:
        """The steps (6,) of the axes of WRENCH."""
        return np.array([self.resolution_fxy_N] * 2 + [self.resolution_fz_N] + [self.resolution_Nm] * 3)


def reporting_of(cell: CellFile) -> Reporting:
    """How a cell file says that robot and sensor report."""
    robot, sensor = cell.robot, cell.sensor
    return Reporting(
        sensor.resolution_fxy_N,
        sensor.resolution_fz_N,
        sensor.resolution_Nm,
        robot.position_noise_rms_m,
        robot.velocity_noise_rms_m_per_s,
    )


def round_as_stated(wrench: Floats, stated: Floats, step_N: float) -> Floats:
    """Round readings to the stated steps; an axis that a coarser step has rounded already stays as it is.

    Args:
        wrench: Readings (n, 6) in N and Nm.
        stated: Steps (6,) of the axes.
        step_N: Step to which fz is rounded already.

    Returns:
        The readings (n, 6).
    """
    columns = [column if axis == 2 and step_N > stated[2] else _rounded(column, stated[axis]) for axis, column in enumerate(wrench.T)]
    return np.column_stack(columns)
