"""The simulated cell on whole recordings: what robot and sensor report of a motion, as the diagnosis predicts it."""

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass

import numpy as np

from palpd.cell.cell_file import CellFile
from palpd.cell.dynamics import Floats, State, servo, servo_heights, steps
from palpd.cell.effects import EFFECTS, Effect, Scale, Site
from palpd.cell.effects.learned import learned_law_of
from palpd.cell.physics import Library, physics, place_named, true_surface_m
from palpd.cell.span import Constants, NominalOutput, Span, TipMotion
from palpd.cell.stages import (
    WRENCH,
    clip_and_round_mean,
    crosstalk_shares,
    filter_axes,
    filtered_axis,
    load_sensor,
    loaded_axes,
    press_tissue,
    read_mean,
    reporting_of,
    round_as_stated,
    scattered_wrench,
    shift_zero,
    wrench_array,
)
from palpd.cell.tip_motion import estimate_tip_motion
from palpd.errors import ConfigError

Followed = dict[tuple[float, float], tuple[Floats, Floats, Floats]]


def commanded_motion(
    cell: CellFile,
    t_s: Floats,
    z_cmd_m: Floats,
    library: Library = EFFECTS,
    *,
    begin_s: float | None = None,
    start: State | None = None,
    followed: Followed | None = None,
) -> TipMotion:
    """How the tip follows commanded heights.

    Args:
        t_s: Times (n,) in s.
        z_cmd_m: Commanded heights (n,) in m.
        begin_s: Time of the recording's first row, from which effects count; None for the first of `t_s`.
        start: Height and speed at the first of `t_s`; None: at rest at the first commanded height.
        followed: What the servo made of the same heights and start before, by its natural frequency and damping ratio; the newest is kept
            there. None keeps nothing.

    Returns:
        The true motion of the tip.
    """
    what = physics(cell, None, library)
    c = what.constants
    known, key = {} if followed is None else followed, (c.servo_natural_frequency_Hz, c.servo_damping_ratio)
    if key not in known:
        known.clear()
        known[key] = servo(z_cmd_m, steps(t_s), *key, {}, start)
    z, v, a = known[key]
    s = Span(c, t_s - (t_s[0] if begin_s is None else begin_s), steps(t_s), z, v, a)
    what.apply("robot", s, {})
    return TipMotion(s.t_s, s.z_m, s.vz_m_per_s, s.az_m_per_s2)


def predict_motion(
    cell: CellFile,
    t_s: Floats,
    z_cmd_m: Floats,
    library: Library = EFFECTS,
    *,
    begin_s: float | None = None,
    start: State | None = None,
    followed: Followed | None = None,
) -> Floats:
    """Heights that the robot will report for commanded heights.

    Args:
        t_s: Times (n,) in s.
        z_cmd_m: Commanded heights (n,) in m.
        begin_s: As in `commanded_motion`.
        start: As in `commanded_motion`.
        followed: As in `commanded_motion`.

    Returns:
        Heights (n,) in m, without noise.
    """
    what = physics(cell, None, library)
    if what.laws.get("robot"):
        return commanded_motion(cell, t_s, z_cmd_m, library, begin_s=begin_s, start=start, followed=followed).z_m
    c = what.constants
    return servo_heights(z_cmd_m, steps(t_s), c.servo_natural_frequency_Hz, c.servo_damping_ratio, start)


@dataclass(frozen=True, slots=True)
class MeanReading:
    """A mean reading: what each axis has of its own, by its number, and the shares of one signal that leak into some of them.

    Averaging a signal once costs a fifth of averaging it in five axes.
    """

    own: dict[int, Floats]
    leaking_N: Floats
    shares: dict[int, float]

    def averaged(self, average: Callable[[Floats], Floats], n: int) -> Floats:
        """All six axes after a linear operation.

        Args:
            average: Takes an axis of all samples to n values.

        Returns:
            The axes (6, n).
        """
        out = np.zeros((6, n))
        for axis, values in self.own.items():
            out[axis] = average(values)
        if self.shares:
            leaking_N = out[2] if self.own.get(2) is self.leaking_N else average(self.leaking_N)
            for axis, share in self.shares.items():
                out[axis] += share * leaking_N
        return out

    def wrench(self, n: int) -> Floats:
        """All six axes of the n samples, (n, 6)."""
        return self.averaged(lambda values: values, n).T


def mean_reading(
    cell: CellFile, motion: TipMotion, library: Library = EFFECTS, site: str | None = None, nominal: NominalOutput | None = None
) -> MeanReading:
    """Mean wrench that the sensor will read during a motion: noise-free, not rounded to the stated steps.

    Args:
        motion: Motion of the tip, n samples.
        site: Name of a site of the cell, or None for the cell's own tissue.
        nominal: What another simulator predicts of the cell without effects and deviations, at the same times; None where palpd does.
    """
    what = physics(cell, place_named(cell, site), library)
    s = _span(what.constants, motion)
    if nominal is not None:
        s.nominal = nominal
        what.constants.tip_compliance_m_per_N -= nominal.constants.tip_compliance_m_per_N
    load_sensor(s, what, {}, {})
    leaks, leaking_N, laws = crosstalk_shares(what.constants), s.fz_N, what.laws.get("sensor")
    if laws:
        own = {name: getattr(s, name) for name, _ in leaks}
        s.fz_N = leaking_N.copy()  # a law may change it in place
        for name, share in leaks:
            setattr(s, name, own[name] + share * leaking_N)
        what.apply("sensor", s, {})
        # A law may also change what has leaked; that is then an axis of its own.
        leaks = [(name, share) for name, share in leaks if np.array_equal(getattr(s, name), own[name] + share * leaking_N)]
        for name, _ in leaks:
            setattr(s, name, own[name])
    filter_axes(s, {})
    leaking_N = filtered_axis(leaking_N, s, {}) if laws and leaks else s.fz_N
    shift_zero(s)
    clip_and_round_mean(s)
    return MeanReading({WRENCH.index(name): column for name, column in loaded_axes(s)}, leaking_N, {WRENCH.index(n): x for n, x in leaks})


def wrench_of(cell: CellFile, motion: TipMotion, library: Library = EFFECTS, site: str | None = None) -> Floats:
    """Mean wrench that the sensor will read during a motion: noise-free, not rounded to the stated steps.

    Args:
        motion: Motion of the tip, n samples.
        site: Name of a site of the cell, or None for the cell's own tissue.

    Returns:
        Wrenches (n, 6) in N and Nm.
    """
    return mean_reading(cell, motion, library, site).wrench(len(motion.t_s))


def _span(c: Constants, m: TipMotion) -> Span:
    dt_s = steps(m.t_s) if m.dt_s is None else m.dt_s
    return Span(c, m.t_s, dt_s, m.z_m, m.vz_m_per_s, m.az_m_per_s2, m.z_noise_m, m.az_noise_m_per_s2, even_s=m.even_s)


def simulate(
    cell: CellFile,
    t_s: Floats,
    *,
    z_cmd_m: Floats | None = None,
    z_m: Floats | None = None,
    vz_m_per_s: Floats | None = None,
    noise_seed: int | None = None,
    library: Library = EFFECTS,
    site: str | None = None,
) -> dict[str, Floats]:
    """The columns of a recording of this cell.

    Args:
        t_s: Times (n,) in s.
        z_cmd_m: Commanded heights (n,) in m; they drive the cell where no heights are given.
        z_m: Reported heights (n,) in m, or None to simulate them.
        vz_m_per_s: Reported speeds (n,), or None to simulate them.
        noise_seed: Seed of the noise on sensor and simulated motion, with readings rounded to their steps; None for no noise.
        site: Name of a site of the cell, or None for the cell's own tissue.

    Returns:
        Columns (n,) by name, as in a CSV recording.

    Raises:
        ConfigError: Neither heights nor commanded heights were given.
    """
    if z_m is None and z_cmd_m is None:
        raise ConfigError("a simulation needs z_m or z_cmd_m; neither was given")
    motion = estimate_tip_motion(cell, t_s, z_m, vz_m_per_s, z_cmd_m) if z_m is not None else commanded_motion(cell, t_s, z_cmd_m, library)  # type: ignore[arg-type]
    reported_z = z_m if z_m is not None else motion.z_m
    reported_v = vz_m_per_s if vz_m_per_s is not None else motion.vz_m_per_s
    if noise_seed is None:
        wrench = wrench_of(cell, motion, library, site)
    else:
        rng = np.random.default_rng(noise_seed)
        what = physics(cell, place_named(cell, site), library)
        s = _span(what.constants, motion)
        load_sensor(s, what, {}, {})
        read_mean(s, what, {})
        wrench = scattered_wrench(wrench_array(s), s, rng, {})
        wrench = round_as_stated(wrench, reporting_of(cell).steps, what.constants.step_N)
        if z_m is None:
            reported_z = reported_z + rng.standard_normal(len(t_s)) * cell.robot.position_noise_rms_m
            reported_v = reported_v + rng.standard_normal(len(t_s)) * cell.robot.velocity_noise_rms_m_per_s
    columns = {"t_s": t_s} | ({"z_cmd_m": z_cmd_m} if z_cmd_m is not None else {})
    columns |= {"z_m": reported_z, "vz_m_per_s": reported_v}
    return columns | {name: wrench[:, axis] for axis, name in enumerate(WRENCH)}


def capture(cell: CellFile, library: Library, site: Site, run: Callable[[CellFile, Library], object]) -> Span:
    """The samples of a simulation at one stage.

    Args:
        run: Simulates a cell with a library.

    Returns:
        The samples after the effects of that stage.
    """
    spans: list[Span] = []

    def keep(s: Span, *_: object) -> None:
        spans.append(copy(s))

    watching = Effect("capture", site, "keeps what happens", (), law=keep)
    run(cell.with_effects(cell.effects | {"capture": {}}), {**library, "capture": watching})
    return spans[-1]


def share_outside(
    cell: CellFile,
    t_s: Floats,
    *,
    z_cmd_m: Floats | None = None,
    z_m: Floats | None = None,
    vz_m_per_s: Floats | None = None,
    library: Library = EFFECTS,
) -> dict[str, float]:
    """How far a simulation leaves what learned effects know: there their curves are held.

    Args:
        t_s: Times (n,) in s.
        z_cmd_m: Commanded heights (n,) in m; None needs `z_m`.
        z_m: Reported heights (n,) in m, or None to simulate them.
        vz_m_per_s: Reported speeds (n,), or None to simulate them.

    Returns:
        Share of the samples outside the range, by learned effect.
    """
    listed = [learned_law_of(library[name]) for name in cell.effects if name in library]
    out = {}
    for learned in [*(one for one in listed if one is not None), *cell.learned]:
        if learned.site == "robot" and (z_m is not None or z_cmd_m is None):
            continue

        def run(other: CellFile, known: Library) -> object:
            return simulate(other, t_s, z_cmd_m=z_cmd_m, z_m=z_m, vz_m_per_s=vz_m_per_s, library=known)

        out[learned.id] = float(learned.outside(capture(cell, library, learned.site, run)).mean())
    return out


def equilibrium_force_N(cell: CellFile, depth_m: float, site: str | None = None, library: Library = EFFECTS) -> float:
    """Noise-free contact force of a first press after a long hold.

    Args:
        depth_m: Depth below the true surface.
        site: Name of a site of the cell, or None for the cell's own tissue.
    """
    what = physics(cell, place_named(cell, site), library)
    c = what.constants
    still = np.zeros(1)
    s = Span(c, np.array([c.wall_after_s]), 1.0, still, still, still)
    s.tip_m = np.array([true_surface_m(cell, site, library) - depth_m])
    press_tissue(s, what, {})
    return float(s.contact_N[0])


def scale_of(cell: CellFile, t_s: Floats, z_m: Floats, vz_m_per_s: Floats, fz_N: Floats | None = None) -> Scale:
    """The scale of a recording; bounds and starting values of effects are multiples of it.

    Args:
        t_s: Times (n,) in s.
        z_m: Heights (n,) in m.
        vz_m_per_s: Vertical speeds (n,).
        fz_N: Measured forces (n,), or None to expect those of the cell.

    Returns:
        Typical force, depth, stroke, speed and times.
    """
    stroke_m = max(float(np.ptp(z_m)), 1e-12)
    surface_m = cell.tissue.surface_z_m if cell.tissue is not None else -np.inf
    depth_m = max(surface_m - float(z_m.min()), 0.01 * stroke_m) if cell.tissue is not None else stroke_m
    largest_N = 0.0 if fz_N is None else float(np.quantile(np.abs(fz_N), 0.999))
    expected_N = equilibrium_force_N(cell.with_effects({}), depth_m) if cell.tissue is not None else 0.0
    return Scale(
        force_N=max(largest_N or expected_N, 5.0 * cell.sensor.noise_rms_N),
        depth_m=min(depth_m, stroke_m),
        stroke_m=stroke_m,
        speed_m_per_s=max(float(np.quantile(np.abs(vz_m_per_s), 0.95)), stroke_m / float(t_s[-1] - t_s[0])),
        duration_s=float(t_s[-1] - t_s[0]),
        step_s=float(np.median(np.diff(t_s))),
        noise_N=cell.sensor.noise_rms_N,
        mass_kg=max(cell.probe.mass_kg, 1e-12),
        tip_radius_m=cell.probe.tip_radius_m,
        tip_length_m=max(cell.probe.tip_length_m, cell.probe.tip_radius_m),
        cutoff_Hz=cell.sensor.filter_cutoff_Hz or np.inf,
        servo_natural_frequency_Hz=cell.robot.servo_natural_frequency_Hz,
    )
