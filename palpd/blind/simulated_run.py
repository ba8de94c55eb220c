"""The physics of the blind check: a recording in the making, integrated several times finer than its rows.

The integration rule differs from the library's, so that both cannot be wrong in the same way.
"""

from collections.abc import Callable, Sequence

import numpy as np

from palpd.blind.drawn_cells import CROSSTALK_ARM_M, CellRealisation, Deviations, PressedMotion
from palpd.blind.laws import Floats, Planted, SensorRows, SimulatedRun, one_pole, second_order


def simulate(
    cell: CellRealisation,
    deviations: Deviations,
    motion: PressedMotion,
    planted: Sequence[Planted] = (),
    *,
    dt_s: float,
    reported: SimulatedRun | None = None,
) -> SimulatedRun:
    """Simulate a noise-free run of the cell on a fine grid.

    Args:
        deviations: Where the cell lies within its tolerances.
        motion: Commanded motion.
        dt_s: Step of the grid in s.
        reported: A run whose motion drives this one; None: the servo does.

    Returns:
        The run, all arrays (n,).
    """
    t, command, press = motion.on_grid(dt_s)
    besides = motion.departure(dt_s)
    off = {name: value * cell.tolerances[name] for name, value in deviations.of.items()}
    inside = np.maximum(press, 0)
    cutoff = cell.filter_cutoff_Hz if cell.filter_cutoff_Hz else np.inf
    w = SimulatedRun(
        t_s=t,
        dt_s=dt_s,
        press=press,
        command_m=command,
        servo_Hz=cell.servo_natural_frequency_Hz * (1.0 + off["servo_natural_frequency"]),
        servo_damping=cell.servo_damping_ratio,
        mass_kg=cell.mass_kg + off["mass_kg"],
        tip_radius_m=cell.tip_radius_m,
        tip_length_m=cell.tip_length_m,
        hertz_N_per_m15=cell.hertz_N_per_m15
        * (1.0 + off["youngs_modulus"])
        * (1.0 + cell.scatter_stiffness * deviations.stiffness[inside]),
        surface_m=cell.surface_z_m + off["surface_z_m"] + cell.scatter_surface_z_m * deviations.surface[inside],
        cutoff_Hz=cutoff * (1.0 + off["filter_cutoff"]),
        late_s=off["latency_s"],
    )

    def laws(stage: str) -> None:
        for law, shape in planted:
            if law.stage == stage:
                law.apply(w, shape)

    laws("command")
    if reported is None:
        start = w.command_m[0]
        drive = w.command_m - start
        omega2 = (2.0 * np.pi * w.servo_Hz) ** 2
        w.z_m = start + second_order(drive, dt_s, [omega2], w.servo_Hz, w.servo_damping)
        w.vz_m_per_s = second_order(drive, dt_s, [omega2, 0.0], w.servo_Hz, w.servo_damping)
        w.az_m_per_s2 = second_order(drive, dt_s, [omega2, 0.0, 0.0], w.servo_Hz, w.servo_damping)
        if besides is not None:
            w.z_m, w.vz_m_per_s = w.z_m + besides.z_m, w.vz_m_per_s + besides.vz_m_per_s
            w.az_m_per_s2 = w.az_m_per_s2 + besides.az_m_per_s2
        laws("motion")
    else:
        w.z_m, w.vz_m_per_s, w.az_m_per_s2 = reported.z_m, reported.vz_m_per_s, reported.az_m_per_s2
    w.tip_m = w.z_m
    laws("tip")
    laws("surface")
    w.wrench = np.zeros((len(t), 6), order="F")
    _touch(w, laws)
    w.wrench[:, 2] = w.contact_N - w.mass_kg * w.az_m_per_s2
    if besides is not None:
        w.wrench += besides.wrench
    laws("probe")
    _sense(w, off, laws)
    return w


def _touch(w: SimulatedRun, laws: Callable[[str], None]) -> None:
    """Contact force at the tip; where the tip gives way under it, by iteration to where both agree."""
    rigid = w.tip_m
    for _ in range(60 if w.deflection_m else 1):
        last = w.contact_N
        w.depth_m = np.maximum(w.surface_m - w.tip_m, 0.0)
        w.contact_N = w.hertz_N_per_m15 * w.depth_m**1.5
        laws("tissue")
        laws("history")
        if w.deflection_m is None:
            return
        if len(last):
            slope = 1.5 * w.hertz_N_per_m15 * np.sqrt(np.maximum(w.surface_m - rigid, 0.0))
            small = np.maximum(np.abs(last), 1e-6)
            w.contact_N = last + (w.contact_N - last) / (1.0 + slope * w.deflection_m(small) / small)
            if float(np.abs(w.contact_N - last).max()) < 1e-6 * float(np.abs(last).max() + 1e-12):
                return
        w.tip_m = rigid + w.deflection_m(w.contact_N)


def _sense(w: SimulatedRun, off: dict[str, float], laws: Callable[[str], None]) -> None:
    fz = w.wrench[:, 2].copy()
    for column, name, arm in ((0, "fx", 1.0), (1, "fy", 1.0), (3, "tx", CROSSTALK_ARM_M), (4, "ty", CROSSTALK_ARM_M)):
        w.wrench[:, column] += off[f"crosstalk_{name}"] * arm * fz
    w.wrench[:, 2] = fz * (1.0 + off["gain"])
    laws("sensor")
    w.wrench[:, 2] += off["bias_N"] + off["drift_N_per_min"] / 60.0 * w.t_s
    for cutoff_Hz in (w.cutoff_Hz, w.extra_pole_Hz):
        if cutoff_Hz < 0.45 / w.dt_s:
            for column in np.flatnonzero(w.wrench.any(axis=0)).tolist():
                w.wrench[:, column] = one_pole(w.wrench[:, column], w.dt_s, cutoff_Hz)


def rows(w: SimulatedRun, t_s: Floats, planted: Sequence[Planted] = (), random: np.random.Generator | None = None) -> Floats:
    """The noise-free rows of a run: height, then the wrench with the sensor's delay and clock skew.

    Args:
        t_s: Times of the rows in s (m,).
        planted: Laws with their parameters; those at the stage `row` are applied here.
        random: Generator for such laws; None: one of seed 0.

    Returns:
        Rows (m, 7), columns as in CHANNELS.
    """
    late = np.interp(t_s, w.t_s, w.late_s) if isinstance(w.late_s, np.ndarray) else w.late_s
    when = t_s * (1.0 + w.skew) - late
    wrench = np.zeros((len(t_s), 6))
    for column in np.flatnonzero(w.wrench.any(axis=0)):
        wrench[:, column] = np.interp(when, w.t_s, w.wrench[:, column])
    readings = SensorRows(t_s, wrench, random or np.random.default_rng(0))
    for law, shape in planted:
        if law.stage == "row" and not law.variance:
            law.apply(readings, shape)
    return np.column_stack([np.interp(t_s, w.t_s, w.z_m), wrench])
