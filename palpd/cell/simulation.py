"""The physics of a cell: a robot that moves a probe into tissue, and a force sensor that feels it.

One implementation, used step by step by emulators (`SteppedCell`) and on whole recordings by the diagnosis (`predict_motion`,
`predict_wrench`, `simulate`): both hand stretches of samples through the same stages. The stages are robot (target to reported
height), tip (where it really is), tissue (what it feels), probe (what else pushes), clock and sensor; after the nominal physics
of each come the effects of that site. Wrenches are what the environment does to the probe, along base axes, gravity tared away.
"""

from collections.abc import Callable, Iterator, Mapping
from copy import copy
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from palpd.cell.cell_file import CROSSTALK_ARM_M, CellFile, Estimated, Wall
from palpd.cell.cell_file import CellSite as Place
from palpd.cell.dynamics import Constants, Floats, Memory, Span, TipMotion, delayed, lowpass, servo, servo_heights, shifted, steps
from palpd.cell.effects import EFFECTS, Effect, Scale, Site, Values
from palpd.cell.effects.learned import learned_law_of
from palpd.errors import ConfigError

WRENCH = ("fx_N", "fy_N", "fz_N", "tx_Nm", "ty_Nm", "tz_Nm")
Library = Mapping[str, Effect]
"""Effects by id."""
Followed = dict[tuple[float, float], tuple[Floats, Floats, Floats]]


class ActingLaw(NamedTuple):
    """A law that acts on samples, its parameters, and the name under which it remembers."""

    id: str
    act: Callable[[Span, Values, Memory], None]
    values: Values


@dataclass(frozen=True, slots=True)
class Physics:
    """A cell at one site, ready to compute: its numbers, and per site the laws that act there in their order."""

    constants: Constants
    laws: Mapping[Site, tuple[ActingLaw, ...]]

    def apply(self, site: Site, span: Span, memory: Memory) -> None:
        """Let the effects of a site act on a span of samples.

        Args:
            site: Stage of the physics whose effects act.
            span: Samples that the effects change.
            memory: State of the effects, carried from span to span.
        """
        for law in self.laws.get(site, ()):
            law.act(span, law.values, memory.setdefault(law.id, {}))


def physics(cell: CellFile, place: Place | None = None, library: Library = EFFECTS, *, begun: bool = True) -> Physics:
    """The physics of a cell file, at one of its sites.

    Args:
        place: A site of the cell, or None for the cell's own tissue.
        begun: False leaves out what counts from the first row of a recording.

    Returns:
        Numbers and laws, ready to compute.

    Raises:
        ConfigError: The cell has an effect that the library has not.
    """
    tissue, effects = (place.tissue, cell.effects | place.effects) if place is not None else (cell.tissue, cell.effects)
    known = cell.estimated or Estimated()
    wall = cell.wall
    c = Constants(
        servo_natural_frequency_Hz=cell.robot.servo_natural_frequency_Hz * (1.0 + known.servo_natural_frequency),
        servo_damping_ratio=cell.robot.servo_damping_ratio,
        mass_kg=cell.probe.mass_kg + known.mass_kg,
        tip_radius_m=cell.probe.tip_radius_m,
        tip_length_m=cell.probe.tip_length_m,
        youngs_modulus_Pa=tissue.youngs_modulus_Pa * (1.0 + known.youngs_modulus) if tissue else 0.0,
        poisson_ratio=tissue.poisson_ratio if tissue else 0.0,
        surface_z_m=tissue.surface_z_m + known.surface_z_m if tissue else -np.inf,
        cutoff_Hz=(cell.sensor.filter_cutoff_Hz or np.inf) * (1.0 + known.filter_cutoff),
        noise_rms_N=cell.sensor.noise_rms_N,
        noise_rms_Nm=cell.sensor.noise_rms_Nm,
        wall_z_m=wall.z_m if wall else 0.0,
        wall_stiffness_N_per_m=wall.stiffness_N_per_m if wall and (begun or wall.appears_after_s is None) else 0.0,
        wall_after_s=(wall.appears_after_s or 0.0) if wall else 0.0,
        delay_s=known.latency_s,
        tip_compliance_m_per_N=1.0 / (cell.sensor.stiffness_N_per_m or np.inf),
        gain=1.0 + known.gain,
        fx_per_fz=known.crosstalk[0],
        fy_per_fz=known.crosstalk[1],
        tx_per_fz_m=known.crosstalk[2] * CROSSTALK_ARM_M,
        ty_per_fz_m=known.crosstalk[3] * CROSSTALK_ARM_M,
        bias_N=known.bias_N if begun else 0.0,
        drift_N_per_s=known.drift_N_per_min / 60.0 if begun else 0.0,
    )
    laws: dict[Site, list[ActingLaw]] = {}
    if effects:
        if unknown := [name for name in effects if name not in library]:
            raise ConfigError(f"there is no effect {unknown[0]!r} in the library; give its file with --effects")
        for effect in (e for name, e in library.items() if name in effects):
            if effect.starts_at_tare and not begun:
                continue
            if effect.setting is not None:
                effect.setting(c, effects[effect.id])
            if effect.law is not None:
                laws.setdefault(effect.site, []).append(ActingLaw(effect.id, effect.law, effects[effect.id]))
    for learned in cell.learned:
        if begun or not learned.effect().starts_at_tare:
            laws.setdefault(learned.site, []).append(ActingLaw(learned.id, learned.act, {"strength": 1.0}))
    return Physics(c, {site: tuple(listed) for site, listed in laws.items()})


# from the tip to the reading


def _tissue(s: Span, what: Physics, memory: Memory) -> None:
    """The force on a tip that is where it is."""
    s.touch(what.constants.surface_z_m)
    what.apply("tissue", s, memory)
    if stiffness := what.constants.wall_stiffness_N_per_m:
        there = s.t_s >= what.constants.wall_after_s
        wall_N = stiffness * np.maximum(what.constants.wall_z_m - s.tip_m, 0.0)
        s.contact_N = np.where(there, wall_N, s.contact_N)


def _copy(memory: Memory) -> Memory:
    return {key: _copy(value) if isinstance(value, dict) else value for key, value in memory.items()}


def _contact(s: Span, what: Physics, memory: Memory) -> None:
    """Tip, depth and contact force; where the tip gives way, tip = z + compliance · force is solved by secants, sample by sample.

    A force that grows with depth makes the residual fall at least as fast as the force rises, which bounds the secant's slope.
    """
    s.tip_m = s.z_m
    what.apply("tip", s, memory)
    compliance = what.constants.tip_compliance_m_per_N
    if compliance == 0.0:
        _tissue(s, what, memory)
        return
    rigid_m = s.tip_m

    def residual_N(force_N: Floats) -> tuple[Floats, Memory]:
        trial = _copy(memory)
        s.tip_m = rigid_m + force_N * compliance
        _tissue(s, what, trial)
        return s.contact_N - force_N, trial

    last_N = np.full_like(rigid_m, memory.get("force_N", 0.0))
    last_gap, trial = residual_N(last_N)
    if last_gap.any():
        stiff = np.divide(1.5 * np.abs(s.contact_N), s.depth_m, out=np.zeros_like(s.depth_m), where=s.depth_m > 0.0)
        force_N = last_N + last_gap / (1.0 + stiff * compliance)
        for _ in range(60):
            gap, trial = residual_N(force_N)
            if float(np.abs(gap).max()) <= 1e-12 * float(np.abs(force_N).max()):
                break
            step = force_N - last_N
            slope = np.minimum((gap - last_gap) / np.where(step == 0.0, 1.0, step), -1.0)
            slope[step == 0.0] = -1.0
            last_N, last_gap = force_N, gap
            force_N = force_N - gap / slope
    trial["force_N"] = float(s.contact_N[-1])
    memory.update(trial)


def _columns(s: Span) -> Iterator[tuple[str, Floats]]:
    """The axes that carry anything."""
    for name in WRENCH:
        column = getattr(s, name)
        if not isinstance(column, float):
            yield name, column


def _reading(s: Span, what: Physics, memory: Memory, here: Memory) -> None:
    """From motion to the reading's mean: noise-free, neither clipped nor rounded; `here` is what this place remembers."""
    _at_the_sensor(s, what, memory, here)
    _through_the_sensor(s, what, memory)


def _through_the_sensor(s: Span, what: Physics, memory: Memory) -> None:
    """From the wrench on the sensor to the reading's mean."""
    for name, share in _leaks(what.constants):
        setattr(s, name, getattr(s, name) + share * s.fz_N)
    what.apply("sensor", s, memory)
    _filter(s, memory)
    _shift_zero(s)


def _at_the_sensor(s: Span, what: Physics, memory: Memory, here: Memory) -> None:
    """From motion to the wrench on the sensor, its gain included."""
    _contact(s, what, here)
    s.fz_N = s.contact_N - what.constants.mass_kg * s.az_m_per_s2
    _beside_contact_and_inertia(s, what, memory)


def _beside_contact_and_inertia(s: Span, what: Physics, memory: Memory) -> None:
    """What else acts on the sensor, when its wrench is sampled, and its gain."""
    c = what.constants
    what.apply("probe", s, memory)
    if c.delay_s or c.skew or not isinstance(s.lead_s, float):
        if s.even_s and not c.skew and isinstance(s.lead_s, float):
            for name, column in _columns(s):
                setattr(s, name, shifted(column, (c.delay_s + s.lead_s) / s.even_s))
        else:
            when_s = s.t_s * (1.0 + c.skew) - c.delay_s - s.lead_s
            for name, column in _columns(s):
                setattr(s, name, delayed(column, s.t_s, when_s, memory.setdefault(f"late {name}", {})))
    what.apply("clock", s, memory)
    s.fz_N = s.fz_N * c.gain


def _leaks(c: Constants) -> list[tuple[str, float]]:
    """Axes into which fz leaks, and the share of it."""
    shares = (("fx_N", c.fx_per_fz), ("fy_N", c.fy_per_fz), ("tx_Nm", c.tx_per_fz_m), ("ty_Nm", c.ty_per_fz_m))
    return [(name, share) for name, share in shares if share]


def _filter(s: Span, memory: Memory) -> None:
    if np.isfinite(s.constants.cutoff_Hz):
        for name, column in _columns(s):
            setattr(s, name, _filtered(column, s, memory.setdefault(f"filtered {name}", {})))


def _filtered(column: Floats, s: Span, memory: Memory) -> Floats:
    """A column (n,) behind the filter of the sensor."""
    cutoff_Hz = s.constants.cutoff_Hz
    return lowpass(column, s.dt_s, -2.0 * np.pi * cutoff_Hz, memory) if np.isfinite(cutoff_Hz) else column


def _shift_zero(s: Span) -> None:
    c = s.constants
    if c.bias_N or c.drift_N_per_s:
        s.fz_N = s.fz_N + (c.bias_N + c.drift_N_per_s * s.t_s)


def _wrench(s: Span) -> Floats:
    """The six columns, (n, 6)."""
    wrench = np.zeros((len(s.t_s), 6))
    for axis, name in enumerate(WRENCH):
        wrench[:, axis] = getattr(s, name)
    return wrench


# what readings scatter by


def _expected(s: Span) -> None:
    """Clip and round the mean as it is on average: noise dithers the rounding, which leaves Σ (-1)^k q/πk sin(2πkf/q) e^(-2(πkσ/q)²)."""
    c = s.constants
    if c.limit_N < np.inf:
        s.fz_N = np.clip(s.fz_N, -c.limit_N, c.limit_N)
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


def _scatter(wrench: Floats, s: Span, rng: np.random.Generator, memory: Memory) -> Floats:
    """Noise, clipping, a coarse step and held samples on the six columns of a span."""
    c = s.constants
    wrench = wrench + rng.standard_normal(wrench.shape) * _noise_rms(c.noise_rms_N, c.noise_rms_Nm)
    if c.limit_N < np.inf:
        wrench[:, 2] = np.clip(wrench[:, 2], -c.limit_N, c.limit_N)
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


# whole recordings


def place_named(cell: CellFile, site: str | None) -> Place | None:
    """A site of a cell by its name.

    Args:
        site: Name of one of its sites, or None for the cell's own tissue.

    Returns:
        The site; None for the cell's own tissue.

    Raises:
        ConfigError: The cell has no such site.
    """
    if site is None:
        return None
    for place in cell.sites:
        if place.name == site:
            return place
    known = ", ".join(place.name for place in cell.sites) or "none"
    raise ConfigError(f"the cell has no site {site!r}; it has {known}")


def commanded_motion(
    cell: CellFile,
    t_s: Floats,
    z_cmd_m: Floats,
    library: Library = EFFECTS,
    *,
    begin_s: float | None = None,
    followed: Followed | None = None,
) -> TipMotion:
    """How the tip follows commanded heights, starting at rest at the first.

    Args:
        t_s: Times (n,) in s.
        z_cmd_m: Commanded heights (n,) in m.
        begin_s: Time of the recording's first row, from which effects count; None for the first of `t_s`.
        followed: What the servo made of the same heights before, by its natural frequency and damping ratio; the newest is kept there. None
            keeps nothing.

    Returns:
        The true motion of the tip.
    """
    what = physics(cell, None, library)
    c = what.constants
    known, key = {} if followed is None else followed, (c.servo_natural_frequency_Hz, c.servo_damping_ratio)
    if key not in known:
        known.clear()
        known[key] = servo(z_cmd_m, steps(t_s), *key, {})
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
    followed: Followed | None = None,
) -> Floats:
    """Heights that the robot will report for commanded heights.

    Args:
        t_s: Times (n,) in s.
        z_cmd_m: Commanded heights (n,) in m.
        begin_s: As in `commanded_motion`.
        followed: As in `commanded_motion`.

    Returns:
        Heights (n,) in m, without noise.
    """
    what = physics(cell, None, library)
    if what.laws.get("robot"):
        return commanded_motion(cell, t_s, z_cmd_m, library, begin_s=begin_s, followed=followed).z_m
    c = what.constants
    return servo_heights(z_cmd_m, steps(t_s), c.servo_natural_frequency_Hz, c.servo_damping_ratio)


@dataclass(frozen=True, slots=True)
class MeanReading:
    """A mean reading: what each axis has of its own, by its number, and the shares of one signal that leak into some of them.

    Averaging a signal once costs a fifth of averaging it in five axes.
    """

    own: dict[int, Floats]
    leaking_N: Floats
    shares: dict[int, float]

    def plus(self, more: Mapping[int, Floats]) -> "MeanReading":
        """The reading with something added to some axes, which leaks into no other.

        Args:
            more: What to add (n,) by axis.
        """
        return replace(self, own=self.own | {axis: self.own.get(axis, 0.0) + values for axis, values in more.items()})

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


def mean_reading(cell: CellFile, motion: TipMotion, library: Library = EFFECTS, site: str | None = None) -> MeanReading:
    """Mean wrench that the sensor will read during a motion: noise-free, not rounded to the stated steps.

    Args:
        motion: Motion of the tip, n samples.
        site: Name of a site of the cell, or None for the cell's own tissue.
    """
    what = physics(cell, place_named(cell, site), library)
    s = _span(what.constants, motion)
    _at_the_sensor(s, what, {}, {})
    leaks, leaking_N, laws = _leaks(what.constants), s.fz_N, what.laws.get("sensor")
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
    _filter(s, {})
    leaking_N = _filtered(leaking_N, s, {}) if laws and leaks else s.fz_N
    _shift_zero(s)
    _expected(s)
    return MeanReading({WRENCH.index(name): column for name, column in _columns(s)}, leaking_N, {WRENCH.index(n): x for n, x in leaks})


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


def predict_wrench(
    cell: CellFile,
    t_s: Floats,
    z_m: Floats,
    vz_m_per_s: Floats | None = None,
    library: Library = EFFECTS,
    site: str | None = None,
) -> Floats:
    """Mean wrench during a motion that the robot reported.

    Args:
        t_s: Times (n,) in s.
        z_m: Reported heights (n,) in m.
        vz_m_per_s: Reported speeds (n,), or None to take them from the heights.
        site: Name of a site of the cell, or None for the cell's own tissue.

    Returns:
        Wrenches (n, 6) in N and Nm.
    """
    from palpd.cell.tip_motion import estimate_tip_motion

    return wrench_of(cell, estimate_tip_motion(cell, t_s, z_m, vz_m_per_s), library, site)


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
    from palpd.cell.tip_motion import estimate_tip_motion  # here, since an emulator needs none of what it takes a second to import

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
        _reading(s, what, {}, {})
        wrench = _scatter(_wrench(s), s, rng, {})
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


def true_surface_m(cell: CellFile, site: str | None = None, library: Library = EFFECTS) -> float:
    """Height of the untouched surface (or wall) of a site: the stated one with deviations and effects.

    Args:
        site: Name of a site of the cell, or None for the cell's own tissue.

    Returns:
        Height in m; -inf with nothing in reach.
    """
    c = physics(cell, place_named(cell, site), library).constants
    return c.wall_z_m if c.wall_stiffness_N_per_m else c.surface_z_m


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
    _tissue(s, what, {})
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


# step by step


@dataclass(frozen=True, slots=True)
class SampleBlock:
    """Samples of a cell that lives step by step, as they were and as they were reported.

    Reported, with noise: `position_m` and `velocity_m_per_s` (n, 3), `wrench` (n, 6) in N and Nm, filtered, not rounded to the
    sensor's steps. True: `tip_m` (n, 3) and `contact_N` (n,).
    """

    position_m: Floats
    velocity_m_per_s: Floats
    tip_m: Floats
    contact_N: Floats
    wrench: Floats


class SteppedCell:
    """A cell that lives step by step: commanded tip positions in, reports of robot and sensor out.

    One `step_s` passes per row. Until `begin` is called, effects that count from the first row of a recording (a bias that the tare
    does not see, drift, warm-up, …) are absent; at `begin` the memories of all effects are empty.
    """

    def __init__(self, cell: CellFile, *, seed: int = 0, step_s: float = 0.001, library: Library = EFFECTS) -> None:
        self._cell, self._library, self._step_s = cell, library, step_s
        self._rng = np.random.default_rng(seed)
        self._places: list[Place | None] = list(cell.sites) or [None]
        self._where_m = np.array([(place.x_m, place.y_m) if place else (0.0, 0.0) for place in self._places])
        self._begun, self._rows = False, 0
        self._servo: Memory = {}
        self._common: Memory = {}
        self._local: list[Memory] = [{} for _ in self._places]
        self._motion_noise = np.array([cell.robot.position_noise_rms_m] * 3 + [cell.robot.velocity_noise_rms_m_per_s] * 3)
        self._build()

    def _build(self) -> None:
        self._physics = [physics(self._cell, place, self._library, begun=self._begun) for place in self._places]

    def begin(self) -> None:
        """A recording begins here: histories and clocks of effects start afresh; the filter goes on."""
        self._begun, self._rows = True, 0
        self._common = {name: value for name, value in self._common.items() if name.startswith("filtered ")}
        self._local = [{} for _ in self._places]
        self._build()

    def rest(self) -> None:
        """As before any `begin`: what counts from the start of a recording is absent again."""
        self._begun = False
        self._build()

    def shares_held(self) -> dict[str, float]:
        """Share of the samples since `begin` outside the range of each learned effect, where its curve was held."""
        counted: dict[str, list[int]] = {}
        for memory in (self._common, *self._local):
            for name, mine in memory.items():
                if isinstance(mine, dict) and "held" in mine:
                    samples, held = counted.setdefault(name, [0, 0])
                    counted[name] = [samples + mine["samples"], held + mine["held"]]
        return {name: held / samples for name, (samples, held) in counted.items() if samples}

    def set_filter(self, cutoff_Hz: float | None) -> None:
        """The sensor's filter is set to this cutoff, None for none, in place of the stated one."""
        sensor = self._cell.sensor.model_copy(update={"filter_cutoff_Hz": cutoff_Hz})
        self._cell = self._cell.model_copy(update={"sensor": sensor})
        self._common = {name: value for name, value in self._common.items() if not name.startswith("filtered ")}
        self._build()

    def place_wall(self, z_m: float, stiffness_N_per_m: float) -> None:
        """Replace the tissue by a linear wall from now on.

        Args:
            z_m: Height of the wall.
        """
        self._cell = self._cell.model_copy(update={"wall": Wall(z_m=z_m, stiffness_N_per_m=stiffness_N_per_m)})
        self._build()

    def step(self, target_m: Floats) -> SampleBlock:
        """Let n steps pass.

        Args:
            target_m: Commanded tip positions (n, 3) in m.

        Returns:
            The n samples, as they were and as they were reported.
        """
        n = len(target_m)
        place = self._nearest(target_m[-1])
        what, c = self._physics[place], self._physics[place].constants
        t_s: Floats = np.arange(self._rows, self._rows + n, dtype=np.float64) * self._step_s
        self._rows += n
        position, velocity, acceleration = servo(target_m, self._step_s, c.servo_natural_frequency_Hz, c.servo_damping_ratio, self._servo)
        s = Span(c, t_s, self._step_s, position[:, 2], velocity[:, 2], acceleration[:, 2])
        what.apply("robot", s, self._common)
        motion = np.concatenate((position, velocity), axis=1)
        motion[:, 2], motion[:, 5] = s.z_m, s.vz_m_per_s
        if c.delay_s < 0.0 or c.skew > 0.0:  # a wrench that comes early is a robot that reports late
            s.lead_s = np.maximum(c.skew * t_s - c.delay_s, 0.0)
            motion = delayed(motion, t_s, t_s - s.lead_s, self._common.setdefault("reported", {}))
        _reading(s, what, self._common, self._local[place])
        tip_m = position.copy()
        tip_m[:, 2] = s.tip_m
        motion = motion + self._rng.standard_normal((n, 6)) * self._motion_noise
        wrench = _scatter(_wrench(s), s, self._rng, self._common)
        return SampleBlock(motion[:, :3], motion[:, 3:], tip_m, s.contact_N, wrench)

    def _nearest(self, at_m: Floats) -> int:
        if len(self._places) == 1:
            return 0
        return int(np.argmin(((self._where_m - at_m[:2]) ** 2).sum(axis=1)))


# sample by sample, moved by another simulator


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


class MovedCell:
    """A cell whose tip another simulator moves: per sample the contact force first, then what robot and sensor report.

    The other simulator may ask for a sample again, as long as its time is that of the last one; that changes no history.
    """

    def __init__(self, what: Physics, reporting: Reporting, *, noise_seed: int | None = None) -> None:
        """A cell at rest.

        Args:
            reporting: How it reports.
            noise_seed: Seed of noise and rounding; neither without one.
        """
        self.what, self.reporting = what, reporting
        self._seed = noise_seed
        self.restart()

    def restart(self) -> None:
        """A recording begins: all histories are empty, and the noise begins again."""
        self._rng = None if self._seed is None else np.random.default_rng(self._seed)
        self._memory: Memory = {"common": {}, "local": {}}
        self._before: Memory = _copy(self._memory)
        self._t_s = -np.inf

    def touch(self, t_s: float, dt_s: float, motion: tuple[float, float, float]) -> float:
        """The contact force of a sample, along z in N.

        Args:
            t_s: Time since the recording began.
            dt_s: Time since the sample before.
            motion: Height in m, speed in m/s and acceleration in m/s² of the robot.
        """
        if t_s > self._t_s:
            self._before = _copy(self._memory)
        else:
            self._memory = _copy(self._before)
        self._t_s = t_s
        c, common = self.what.constants, self._memory["common"]
        z, v, a = (np.array([x]) for x in motion)
        s = Span(c, np.array([t_s]), dt_s, z, v, a)
        self.what.apply("robot", s, common)
        self._reported = np.array([s.z_m[0], s.vz_m_per_s[0]])
        if c.delay_s < 0.0 or c.skew > 0.0:  # a wrench that comes early is a robot that reports late
            s.lead_s = np.maximum(c.skew * s.t_s - c.delay_s, 0.0)
            self._reported = delayed(self._reported[None], s.t_s, s.t_s - s.lead_s, common.setdefault("reported", {}))[0]
        self._span = s
        self._inertial_N = -c.mass_kg * float(s.az_m_per_s2[0])
        self._beyond_servo_N = self._inertial_N + c.mass_kg * motion[2]
        _contact(s, self.what, self._memory["local"])
        return float(s.contact_N[0])

    @property
    def expected_fz_N(self) -> float:
        """What a force sensor shows of the last sample: contact and inertia, which a simulator with bodies has of its own."""
        return float(self._span.contact_N[0]) + self._inertial_N

    def read(self, fz_N: float | None = None) -> Floats:
        """What robot and sensor report of the sample that was touched last.

        Args:
            fz_N: Force of contact and inertia that the other simulator's own sensor shows; None where it has none.

        Returns:
            Height in m, speed in m/s, and the wrench in N and Nm (8,).
        """
        s, common = self._span, self._memory["common"]
        s.fz_N = np.array([self.expected_fz_N if fz_N is None else fz_N + self._beyond_servo_N])
        _beside_contact_and_inertia(s, self.what, common)
        _through_the_sensor(s, self.what, common)
        if self._rng is None:
            _expected(s)
            return np.concatenate((self._reported, _wrench(s)[0]))
        wrench = round_as_stated(_scatter(_wrench(s), s, self._rng, common), self.reporting.steps, s.constants.step_N)
        noise = self._rng.standard_normal(2) * (self.reporting.position_noise_rms_m, self.reporting.velocity_noise_rms_m_per_s)
        return np.concatenate((self._reported + noise, wrench[0]))


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
