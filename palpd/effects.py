"""The library of effects: what a real cell may do that the nominal one does not.

An effect is a name, a site, parameters with unit and bounds, and a law. A law is one of two pure functions: `setting` changes
the numbers of the cell (its mass, its gain) before anything happens, `law` changes a stretch of samples when the physics of its
site has been computed. What a law must remember from block to block it keeps in its `memory`, which is empty where a
recording begins. Within one site, effects act in the order of this file. Bounds and starting values are functions of a Scale,
that is of the cell file and the recording, so that no effect knows how large a cell is.
"""

import runpy
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from math import inf, pi
from pathlib import Path
from typing import Any, Literal

import numpy as np

from palpd.dynamics import Constants, Floats, Memory, Span, lowpass, mounted, play, recurrence
from palpd.errors import ConfigError

Site = Literal["robot", "tip", "tissue", "probe", "sensor", "clock"]
SITES: tuple[Site, ...] = ("robot", "tip", "tissue", "probe", "clock", "sensor")
"""In the order in which a cell's physics passes them."""

Values = Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Scale:
    """How large things are in this cell and recording: what bounds and starting values are multiples of."""

    force_N: float
    depth_m: float
    stroke_m: float
    speed_m_per_s: float
    duration_s: float
    step_s: float
    noise_N: float
    mass_kg: float
    tip_radius_m: float
    tip_length_m: float
    cutoff_Hz: float
    servo_natural_frequency_Hz: float

    @property
    def stiffness_N_per_m(self) -> float:
        """Secant stiffness of the deepest press."""
        return self.force_N / self.depth_m

    @property
    def range_N(self) -> float:
        """More than any effect on the force can sensibly be."""
        return self.force_N + 20.0 * self.noise_N

    @property
    def nyquist_Hz(self) -> float:
        """Highest frequency that the recording can show."""
        return 0.5 / self.step_s


Bound = float | Callable[[Scale], float]
Starts = tuple[float, ...] | Callable[[Scale], tuple[float, ...]]


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number of an effect: its unit, the range it is sought in, where to start, and the value at which it does nothing.

    `nominal` is None where another parameter of the effect switches it off; `log` says that its size, not its value, is
    what is unknown (it is then positive throughout its range).
    """

    name: str
    unit: str
    lower: Bound
    upper: Bound
    typical: Starts
    nominal: Bound | None = 0.0
    log: bool = False

    def bounds(self, scale: Scale) -> tuple[float, float]:
        """The range to search, (lower, upper)."""
        return _at(self.lower, scale), _at(self.upper, scale)

    def starts(self, scale: Scale) -> tuple[float, ...]:
        """Where to start a fit, the most typical first; inside the range."""
        lower, upper = self.bounds(scale)
        values = self.typical(scale) if callable(self.typical) else self.typical
        return tuple(min(max(value, lower), upper) for value in values)

    def nominal_value(self, scale: Scale) -> float | None:
        """The value at which the effect is not there (may be infinite), or None."""
        return None if self.nominal is None else _at(self.nominal, scale)


def _at(bound: Bound, scale: Scale) -> float:
    return float(bound(scale)) if callable(bound) else float(bound)


@dataclass(frozen=True, slots=True)
class Effect:
    """A named change of the nominal physics.

    `afresh`: it counts from the first row of a recording (a tare stands before that, so it is absent until then).
    `variance`: it changes scatter and lattice of the readings and leaves their mean nearly alone. `motion`: the robot reports it,
    so it shows in the heights and not in a force prediction that is driven by the measured motion.
    """

    id: str
    site: Site
    what: str
    parameters: tuple[Parameter, ...]
    law: Callable[[Span, Values, Memory], None] | None = None
    setting: Callable[[Constants, Values], None] | None = None
    afresh: bool = False
    variance: bool = False
    motion: bool = False

    def __post_init__(self) -> None:
        """An effect without any law is a mistake of its author, and so is a site that does not exist."""
        if self.law is None and self.setting is None:
            raise ConfigError(f"effect {self.id} has neither a law nor a setting; give it one of them")
        if self.site not in SITES:
            raise ConfigError(f"effect {self.id} stands at site {self.site!r}; expected one of {', '.join(SITES)}")

    def parameter(self, name: str) -> Parameter:
        """The parameter of that name."""
        return next(p for p in self.parameters if p.name == name)


# robot: how the reported height follows the commanded one


def _lag(c: Constants, p: Values) -> None:
    c.servo_natural_frequency_Hz *= p["bandwidth_ratio"]


def _vibration(s: Span, p: Values, memory: Memory) -> None:
    omega = 2.0 * pi * p["frequency_Hz"]
    angle = omega * s.t_s + p["phase_rad"]
    swing_m, turn_m = p["amplitude_m"] * np.sin(angle), p["amplitude_m"] * np.cos(angle)
    s.z_m = s.z_m + swing_m
    s.vz_m_per_s = s.vz_m_per_s + omega * turn_m
    s.az_m_per_s2 = s.az_m_per_s2 - omega**2 * swing_m


# tip: where it is, when the robot says z


def _backlash(s: Span, p: Values, memory: Memory) -> None:
    s.tip_m = play(s.tip_m, p["width_m"], memory)


def _compliance(c: Constants, p: Values) -> None:
    c.tip_stiffness_N_per_m = 1.0 / (1.0 / c.tip_stiffness_N_per_m + 1.0 / p["stiffness_N_per_m"])


# tissue: what a tip at that height feels


def _surface(c: Constants, p: Values) -> None:
    c.surface_z_m += p["offset_m"]


def _modulus(c: Constants, p: Values) -> None:
    c.youngs_modulus_Pa *= p["ratio"]


def _plasticity(s: Span, p: Values, memory: Memory) -> None:
    """A press has been one when it went a hundredth of the tip's radius deep; the surface sinks when the tip leaves."""
    enough_m = 0.01 * s.constants.tip_radius_m
    presses, pressed, sunk_m = memory.get("presses", 0), memory.get("pressed", False), memory.get("sunk_m", 0.0)
    surface_m = np.broadcast_to(s.surface_m, s.tip_m.shape).tolist()
    for k, (tip_m, surface) in enumerate(zip(s.tip_m.tolist(), surface_m, strict=True)):
        depth_m = surface - sunk_m - tip_m
        if not pressed:
            pressed = depth_m > enough_m
        elif depth_m <= 0.0:
            sunk_m += p["set_m"] * p["ratio"] ** presses
            presses, pressed = presses + 1, False
        surface_m[k] = surface - sunk_m
    memory.update(presses=presses, pressed=pressed, sunk_m=sunk_m)
    s.touch(np.array(surface_m))


def _thickness(s: Span, p: Values, memory: Memory) -> None:
    s.contact_N = s.contact_N * dimitriadis(np.sqrt(s.constants.tip_radius_m * s.depth_m) / p["thickness_m"])


def dimitriadis(chi: Floats) -> Floats:
    """How much stiffer than a half-space a bonded layer of thickness √(r d)/χ is, at ν = 0.5 (Dimitriadis et al. 2002, eq. 12)."""
    factor: Floats = 1.0 + chi * (1.133 + chi * (1.283 + chi * (0.769 + chi * 0.0975)))
    return factor


def _inclusion(s: Span, p: Values, memory: Memory) -> None:
    x2 = (s.depth_m / p["depth_m"]) ** 2
    s.contact_N = s.contact_N * (1.0 + p["contrast"] * x2 / (1.0 + x2))


def _preconditioning(s: Span, p: Values, memory: Memory) -> None:
    deepest_m = np.maximum(np.maximum.accumulate(s.depth_m), memory.get("deepest_m", 0.0))
    memory["deepest_m"] = deepest_m[-1]
    share = s.depth_m / np.maximum(deepest_m, np.finfo(float).tiny)
    s.contact_N = s.contact_N * (1.0 - p["softening"] * (1.0 - share**2))


def _viscoelastic(s: Span, p: Values, memory: Memory) -> None:
    """The spring of the Maxwell arm holds what the elastic force changed by lately; the tissue cannot pull through it."""
    arm_N = s.contact_N - lowpass(s.contact_N, s.dt_s, -1.0 / p["tau_s"], memory)
    s.contact_N = np.maximum(s.contact_N + p["ratio"] * arm_N, 0.0) * (s.depth_m > 0.0)


def _adhesion(s: Span, p: Values, memory: Memory) -> None:
    """Grows over one range as the tip comes back from its deepest point, and fades over one range above the surface."""
    reach_m, lowest_m = p["range_m"], memory.get("lowest_m", inf)
    gap_m = s.tip_m - s.surface_m
    lowest = []
    for tip_m, gap in zip(s.tip_m.tolist(), gap_m.tolist(), strict=True):
        if gap >= reach_m:
            lowest_m = inf
        elif gap <= 0.0 or lowest_m < inf:
            lowest_m = min(lowest_m, tip_m)
        lowest.append(lowest_m)
    memory["lowest_m"] = lowest_m
    bond = np.clip((s.tip_m - np.array(lowest)) / reach_m, 0.0, 1.0)
    s.contact_N = s.contact_N - p["force_N"] * bond * np.clip(1.0 - gap_m / reach_m, 0.0, 1.0)


# probe: what else pushes it, and which way the sensor sees it


def _mass(c: Constants, p: Values) -> None:
    c.mass_kg += p["delta_kg"]


def _resonance(s: Span, p: Values, memory: Memory) -> None:
    ringing = mounted(s.az_m_per_s2, s.dt_s, p["frequency_Hz"], p["damping_ratio"], memory)
    s.fz_N = s.fz_N - s.constants.mass_kg * p["participation"] * (ringing - s.az_m_per_s2)


def _spring(s: Span, p: Values, memory: Memory) -> None:
    s.fz_N = s.fz_N - p["stiffness_N_per_m"] * (s.z_m - memory.setdefault("first_z_m", s.z_m[0]))


def _friction(s: Span, p: Values, memory: Memory) -> None:
    s.fz_N = s.fz_N - p["force_N"] * np.tanh(s.vz_m_per_s / 0.5e-3)


def _viscous(s: Span, p: Values, memory: Memory) -> None:
    s.fz_N = s.fz_N - p["coefficient_N_s_per_m"] * s.vz_m_per_s


def _lateral(s: Span, p: Values, memory: Memory) -> None:
    aside_N = p["ratio"] * s.contact_N
    s.push_sideways(np.cos(p["azimuth_rad"]) * aside_N, np.sin(p["azimuth_rad"]) * aside_N)


def _tilt(s: Span, p: Values, memory: Memory) -> None:
    across, along = np.sin(p["angle_rad"]), np.cos(p["angle_rad"])
    x, y = across * np.cos(p["azimuth_rad"]), across * np.sin(p["azimuth_rad"])
    elsewhere_N = s.fz_N - s.contact_N
    s.push_sideways(x * s.contact_N, y * s.contact_N)
    s.fx_N = s.fx_N + x * elsewhere_N
    s.fy_N = s.fy_N + y * elsewhere_N
    s.fz_N = along * s.fz_N


# clock and sensor: what becomes of the wrench on its way into the recording


def _skew(c: Constants, p: Values) -> None:
    c.skew += p["ratio"]


def _latency(c: Constants, p: Values) -> None:
    c.delay_s += p["delay_s"]


def _gain(c: Constants, p: Values) -> None:
    c.gain *= 1.0 + p["error"]


def _crosstalk(c: Constants, p: Values) -> None:
    c.fx_per_fz += p["fx_per_fz"]
    c.fy_per_fz += p["fy_per_fz"]
    c.tx_per_fz_m += p["tx_per_fz_m"]
    c.ty_per_fz_m += p["ty_per_fz_m"]


def _hysteresis(s: Span, p: Values, memory: Memory) -> None:
    """Exact over a step: w runs towards +1 while fz rises and towards -1 while it falls, by exp(-|Δfz|/width).

    Noise of a measured height would wear the loop down while nothing moves, so as much is taken as a dead band first.
    """
    stiffness_N_per_m = 1.5 * float(s.contact_N.max()) / max(float(s.depth_m.max()), np.finfo(float).tiny)
    drive_N = play(s.fz_N, 8.0 * s.z_noise_m * stiffness_N_per_m, memory) if s.z_noise_m > 0.0 else s.fz_N
    change_N = np.diff(drive_N, prepend=memory.get("fz_N", drive_N[0]))
    keep = np.exp(-np.abs(change_N) / p["width_N"])
    loop = recurrence(keep, np.sign(change_N) * (1.0 - keep), memory.get("w", 0.0))
    memory["fz_N"], memory["w"] = drive_N[-1], loop[-1]
    s.fz_N = s.fz_N + p["amplitude_N"] * loop


def _creep(s: Span, p: Values, memory: Memory) -> None:
    s.fz_N = s.fz_N + p["ratio"] * lowpass(s.fz_N, s.dt_s, -1.0 / p["tau_s"], memory, start=0.0)


def _warmup(s: Span, p: Values, memory: Memory) -> None:
    s.fz_N = s.fz_N - p["amplitude_N"] * np.expm1(-s.t_s / p["tau_s"])


def _filter(c: Constants, p: Values) -> None:
    c.cutoff_Hz = p["cutoff_Hz"]


def _bias(c: Constants, p: Values) -> None:
    c.bias_N += p["offset_N"]


def _drift(c: Constants, p: Values) -> None:
    c.drift_N_per_s += p["rate_N_per_s"]


def _noise(c: Constants, p: Values) -> None:
    c.noise_rms_N *= p["ratio"]
    c.noise_rms_Nm *= p["ratio"]


def _saturation(c: Constants, p: Values) -> None:
    c.limit_N = min(c.limit_N, p["limit_N"])


def _quantization(c: Constants, p: Values) -> None:
    c.step_N = max(c.step_N, p["step_N"])


def _dropout(c: Constants, p: Values) -> None:
    c.dropout_rate_Hz, c.dropout_length_s = p["rate_Hz"], p["length_s"]


def _of_force(*shares: float) -> Callable[[Scale], tuple[float, ...]]:
    return lambda s: tuple(share * s.force_N for share in shares)


def _of_duration(*shares: float) -> Callable[[Scale], tuple[float, ...]]:
    return lambda s: tuple(share * s.duration_s for share in shares)


_AZIMUTH = Parameter("azimuth_rad", "rad", -pi, pi, (0.0, pi / 2, pi, -pi / 2), nominal=None)


def _tau(*shares: float) -> Parameter:
    return Parameter("tau_s", "s", lambda s: s.step_s, lambda s: 5.0 * s.duration_s, _of_duration(*shares), nominal=None, log=True)


LIBRARY: tuple[Effect, ...] = (
    Effect(
        "robot.lag",
        "robot",
        "servo slower than stated",
        (Parameter("bandwidth_ratio", "1", 0.02, 5.0, (0.7, 0.4, 1.5), nominal=1.0, log=True),),
        setting=_lag,
        motion=True,
    ),
    Effect(
        "robot.vibration",
        "robot",
        "sinusoidal motion, reported in z",
        (
            Parameter("amplitude_m", "m", 0.0, lambda s: s.stroke_m, lambda s: (0.01 * s.stroke_m,)),
            Parameter(
                "frequency_Hz",
                "Hz",
                lambda s: 1.0 / s.duration_s,
                lambda s: 0.95 * s.nyquist_Hz,
                lambda s: tuple(s.nyquist_Hz * share for share in (0.05, 0.01, 0.2)),
                nominal=None,
                log=True,
            ),
            Parameter("phase_rad", "rad", -pi, pi, (0.0, pi / 2, pi, -pi / 2), nominal=None),
        ),
        law=_vibration,
        motion=True,
    ),
    Effect(
        "robot.backlash",
        "tip",
        "tip lags the reported height by a dead band at reversals",
        (Parameter("width_m", "m", 0.0, lambda s: 0.5 * s.stroke_m, lambda s: (0.03 * s.depth_m, 0.1 * s.depth_m)),),
        law=_backlash,
    ),
    Effect(
        "robot.compliance",
        "tip",
        "tip gives way under load, the robot does not report it",
        (
            Parameter(
                "stiffness_N_per_m",
                "N/m",
                lambda s: 0.02 * s.stiffness_N_per_m,
                lambda s: 1e4 * s.stiffness_N_per_m,
                lambda s: tuple(s.stiffness_N_per_m * share for share in (20.0, 3.0, 0.5)),
                nominal=inf,
                log=True,
            ),
        ),
        setting=_compliance,
    ),
    Effect(
        "tissue.surface",
        "tissue",
        "surface higher or lower than stated",
        (
            Parameter(
                "offset_m",
                "m",
                lambda s: -s.depth_m,
                lambda s: s.stroke_m,
                lambda s: (0.05 * s.depth_m, -0.05 * s.depth_m),
            ),
        ),
        setting=_surface,
    ),
    Effect(
        "tissue.modulus",
        "tissue",
        "stiffer or softer than stated",
        (Parameter("ratio", "1", 0.01, 100.0, (1.2, 0.8, 3.0, 0.3), nominal=1.0, log=True),),
        setting=_modulus,
    ),
    Effect(
        "tissue.plasticity",
        "tissue",
        "surface sinks after the k-th press by set · ratio^k",
        (
            Parameter("set_m", "m", 0.0, lambda s: s.depth_m, lambda s: (0.02 * s.depth_m, 0.1 * s.depth_m)),
            Parameter("ratio", "1", 0.0, 1.0, (0.7, 0.3), nominal=None),
        ),
        law=_plasticity,
        afresh=True,
    ),
    Effect(
        "tissue.thickness",
        "tissue",
        "finite thickness on a rigid base (Dimitriadis 2002, bonded, ν = 0.5)",
        (
            Parameter(
                "thickness_m",
                "m",
                lambda s: 0.2 * (s.tip_radius_m * s.depth_m) ** 0.5,
                lambda s: 1e3 * (s.tip_radius_m * s.depth_m) ** 0.5,
                lambda s: tuple((s.tip_radius_m * s.depth_m) ** 0.5 * share for share in (5.0, 20.0, 1.5)),
                nominal=inf,
                log=True,
            ),
        ),
        law=_thickness,
    ),
    Effect(
        "tissue.inclusion",
        "tissue",
        "hard inclusion below the surface",
        (
            Parameter("contrast", "1", 0.0, 100.0, (0.5, 3.0)),
            Parameter(
                "depth_m",
                "m",
                lambda s: 0.05 * s.depth_m,
                lambda s: 20.0 * s.depth_m,
                lambda s: (s.depth_m, 3.0 * s.depth_m),
                nominal=None,
                log=True,
            ),
        ),
        law=_inclusion,
    ),
    Effect(
        "tissue.preconditioning",
        "tissue",
        "softer where it has been pressed before (Mullins)",
        (Parameter("softening", "1", 0.0, 1.0, (0.1, 0.4)),),
        law=_preconditioning,
        afresh=True,
    ),
    Effect(
        "tissue.viscoelastic",
        "tissue",
        "standard linear solid: an extra, decaying, rate-dependent part",
        (Parameter("ratio", "1", 0.0, 20.0, (0.2, 1.0)), _tau(0.01, 0.05, 0.002)),
        law=_viscoelastic,
    ),
    Effect(
        "tissue.adhesion",
        "tissue",
        "pulls on the probe while it leaves",
        (
            Parameter("force_N", "N", 0.0, lambda s: s.range_N, _of_force(0.05, 0.2)),
            Parameter(
                "range_m",
                "m",
                lambda s: 0.002 * s.depth_m,
                lambda s: s.stroke_m,
                lambda s: (0.2 * s.depth_m, 0.03 * s.depth_m),
                nominal=None,
                log=True,
            ),
        ),
        law=_adhesion,
    ),
    Effect(
        "probe.mass",
        "probe",
        "moving mass differs",
        (
            Parameter(
                "delta_kg",
                "kg",
                lambda s: -s.mass_kg,
                lambda s: 20.0 * s.mass_kg,
                lambda s: (0.3 * s.mass_kg, -0.3 * s.mass_kg),
            ),
        ),
        setting=_mass,
    ),
    Effect(
        "structure.resonance",
        "probe",
        "part of the probe's inertia rings on a flexible mount",
        (
            Parameter(
                "frequency_Hz",
                "Hz",
                lambda s: 0.1 * s.servo_natural_frequency_Hz,
                lambda s: max(0.95 * s.nyquist_Hz, 0.2 * s.servo_natural_frequency_Hz),
                lambda s: tuple(s.servo_natural_frequency_Hz * share for share in (3.0, 1.5, 6.0)),
                nominal=None,
                log=True,
            ),
            Parameter("damping_ratio", "1", 1e-3, 1.0, (0.05, 0.2), nominal=None, log=True),
            Parameter("participation", "1", 0.0, 1.0, (0.5,)),
        ),
        law=_resonance,
    ),
    Effect(
        "cable.spring",
        "probe",
        "a cable pulls in proportion to the travel",
        (
            Parameter(
                "stiffness_N_per_m",
                "N/m",
                lambda s: -s.range_N / s.stroke_m,
                lambda s: s.range_N / s.stroke_m,
                lambda s: (0.05 * s.force_N / s.stroke_m, -0.05 * s.force_N / s.stroke_m),
            ),
        ),
        law=_spring,
        afresh=True,
    ),
    Effect(
        "cable.friction",
        "probe",
        "Coulomb force against the motion, zero at rest",
        (Parameter("force_N", "N", 0.0, lambda s: s.range_N, _of_force(0.05)),),
        law=_friction,
    ),
    Effect(
        "cable.viscous",
        "probe",
        "force against the motion, linear in speed",
        (
            Parameter(
                "coefficient_N_s_per_m",
                "N s/m",
                0.0,
                lambda s: s.range_N / s.speed_m_per_s,
                lambda s: (0.05 * s.force_N / s.speed_m_per_s,),
            ),
        ),
        law=_viscous,
    ),
    Effect(
        "contact.lateral",
        "probe",
        "oblique contact: lateral force in proportion to the contact force",
        (Parameter("ratio", "1", 0.0, 3.0, (0.05,)), _AZIMUTH),
        law=_lateral,
    ),
    Effect(
        "probe.tilt",
        "probe",
        "sensor tilted against z",
        (Parameter("angle_rad", "rad", 0.0, 1.2, (0.05,)), _AZIMUTH),
        law=_tilt,
    ),
    Effect(
        "clock.skew",
        "clock",
        "the sensor's clock runs fast or slow against the robot's",
        (
            Parameter(
                "ratio",
                "1",
                lambda s: -min(0.2, 0.5),
                0.2,
                lambda s: (0.05 / s.duration_s, -0.05 / s.duration_s, 0.5 / s.duration_s, -0.5 / s.duration_s),
            ),
        ),
        setting=_skew,
        afresh=True,
    ),
    Effect(
        "sensor.latency",
        "clock",
        "wrench late against the robot state",
        (
            Parameter(
                "delay_s",
                "s",
                lambda s: -0.02 * s.duration_s,
                lambda s: 0.1 * s.duration_s,
                lambda s: (2.0 * s.step_s, 10.0 * s.step_s, 40.0 * s.step_s),
            ),
        ),
        setting=_latency,
    ),
    Effect(
        "sensor.gain",
        "sensor",
        "fz · (1 + error)",
        (Parameter("error", "1", -0.95, 10.0, (0.1, -0.1)),),
        setting=_gain,
    ),
    Effect(
        "sensor.crosstalk",
        "sensor",
        "fz leaks into the other axes",
        (
            Parameter("fx_per_fz", "1", -1.0, 1.0, (0.02,)),
            Parameter("fy_per_fz", "1", -1.0, 1.0, (0.02,)),
            Parameter("tx_per_fz_m", "m", lambda s: -s.tip_length_m, lambda s: s.tip_length_m, lambda s: (0.02 * s.tip_length_m,)),
            Parameter("ty_per_fz_m", "m", lambda s: -s.tip_length_m, lambda s: s.tip_length_m, lambda s: (0.02 * s.tip_length_m,)),
        ),
        setting=_crosstalk,
    ),
    Effect(
        "sensor.hysteresis",
        "sensor",
        "rate-independent loop",
        (
            Parameter("width_N", "N", lambda s: s.noise_N, lambda s: 10.0 * s.range_N, _of_force(0.1, 0.5), nominal=None, log=True),
            Parameter("amplitude_N", "N", lambda s: -s.range_N, lambda s: s.range_N, _of_force(0.05, -0.05)),
        ),
        law=_hysteresis,
    ),
    Effect(
        "sensor.creep",
        "sensor",
        "reading creeps up under load",
        (Parameter("ratio", "1", -0.5, 5.0, (0.05, 0.3)), _tau(0.05, 0.3, 0.01)),
        law=_creep,
    ),
    Effect(
        "sensor.warmup",
        "sensor",
        "A · (1 - exp(-t/τ)) on fz",
        (
            Parameter(
                "amplitude_N",
                "N",
                lambda s: -s.range_N,
                lambda s: s.range_N,
                lambda s: (2.0 * s.noise_N, -2.0 * s.noise_N),
            ),
            _tau(0.2, 0.7, 0.05),
        ),
        law=_warmup,
        afresh=True,
    ),
    Effect(
        "sensor.filter",
        "sensor",
        "the real cutoff differs from the stated one",
        (
            Parameter(
                "cutoff_Hz",
                "Hz",
                lambda s: 0.5 / s.duration_s,
                lambda s: max(10.0 * s.nyquist_Hz, 2.0 * s.cutoff_Hz if s.cutoff_Hz < inf else 0.0),
                lambda s: tuple(min(s.cutoff_Hz, s.nyquist_Hz) * share for share in (0.2, 0.05, 0.01)),
                nominal=lambda s: s.cutoff_Hz,
                log=True,
            ),
        ),
        setting=_filter,
    ),
    Effect(
        "sensor.bias",
        "sensor",
        "constant on fz after the tare",
        (Parameter("offset_N", "N", lambda s: -s.range_N, lambda s: s.range_N, lambda s: (2.0 * s.noise_N, -2.0 * s.noise_N)),),
        setting=_bias,
        afresh=True,
    ),
    Effect(
        "sensor.drift",
        "sensor",
        "linear in time on fz",
        (
            Parameter(
                "rate_N_per_s",
                "N/s",
                lambda s: -s.range_N / s.duration_s,
                lambda s: s.range_N / s.duration_s,
                lambda s: (2.0 * s.noise_N / s.duration_s, -2.0 * s.noise_N / s.duration_s),
            ),
        ),
        setting=_drift,
        afresh=True,
    ),
    Effect(
        "sensor.noise",
        "sensor",
        "more noise than stated, all six axes",
        (Parameter("ratio", "1", 0.01, 1e3, (1.5, 3.0), nominal=1.0, log=True),),
        setting=_noise,
        variance=True,
    ),
    Effect(
        "sensor.saturation",
        "sensor",
        "fz clipped",
        (Parameter("limit_N", "N", lambda s: 0.02 * s.force_N, lambda s: 2.0 * s.range_N, _of_force(0.8, 0.4), nominal=inf, log=True),),
        setting=_saturation,
    ),
    Effect(
        "sensor.quantization",
        "sensor",
        "coarser step than stated",
        (Parameter("step_N", "N", 0.0, lambda s: s.range_N, lambda s: (4.0 * s.noise_N, 0.2 * s.force_N)),),
        setting=_quantization,
        variance=True,
    ),
    Effect(
        "sensor.dropout",
        "sensor",
        "samples held now and then",
        (
            Parameter("rate_Hz", "Hz", 0.0, lambda s: s.nyquist_Hz, lambda s: (20.0 / s.duration_s,)),
            Parameter(
                "length_s",
                "s",
                lambda s: s.step_s,
                lambda s: 0.2 * s.duration_s,
                lambda s: (5.0 * s.step_s,),
                nominal=None,
                log=True,
            ),
        ),
        setting=_dropout,
        variance=True,
    ),
)

EFFECTS: dict[str, Effect] = {effect.id: effect for effect in LIBRARY}
"""The effects of this library by id."""


def load_effects(path: str | Path) -> dict[str, Effect]:
    """The library and the effects of a user's own Python file, which lists them as EFFECTS; one of the same id replaces ours."""
    try:
        names: dict[str, Any] = runpy.run_path(str(path))
    except Exception as error:  # a user's file may fail in any way
        raise ConfigError(f"{path} could not be read as effects ({type(error).__name__}: {error}); expected a Python file") from error
    own = names.get("EFFECTS")
    listed = list(own.values() if isinstance(own, Mapping) else own) if isinstance(own, Iterable) else []
    if not listed or not all(isinstance(effect, Effect) for effect in listed):
        raise ConfigError(f"{path} defines no EFFECTS; expected a list of palpd.effects.Effect of that name")
    return EFFECTS | {effect.id: effect for effect in listed}
