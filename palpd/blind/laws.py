"""Laws of effects for the blind check, written anew: the listed ones, other laws for the same effects, and effects not in the list.

Nothing here comes from the library that is being judged. A law changes a SimulatedRun, a recording in the making at a step finer than
its rows, at one stage of its physics. Every law has a shape (drawn once) and a strength s, so that its size can be set: at s = 0
it is not there.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from math import inf, pi
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from palpd.blind.stated_cell import log_uniform
from palpd.blind.truth import DEEP, EVENT, HIGH, LawStatement, is_law, names

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Shape = dict[str, float]
Stage = Literal["command", "motion", "tip", "surface", "tissue", "history", "probe", "sensor", "row"]


@dataclass(frozen=True)
class CellScales:
    """How large things are in one cell and motion: what effects are drawn in proportion to."""

    force_N: float
    depth_m: float
    stroke_m: float
    speed_m_per_s: float
    acceleration_m_per_s2: float
    duration_s: float
    noise_N: float
    step_N: float
    rate_Hz: float
    mass_kg: float
    tip_radius_m: float
    tip_length_m: float
    cutoff_Hz: float
    servo_Hz: float
    servo_damping: float
    presses: int


@dataclass
class SimulatedRun:
    """A recording in the making: fine arrays (n,), all from the physics of the cell, changed by laws.

    `press` is the number of the press each moment belongs to, `lowered` whether the probe was commanded under the surface.
    """

    t_s: Floats
    dt_s: float
    press: Ints
    command_m: Floats
    servo_Hz: float
    servo_damping: float
    mass_kg: float
    tip_radius_m: float
    tip_length_m: float
    hertz_N_per_m15: Floats
    surface_m: Floats
    cutoff_Hz: float
    late_s: Floats | float = 0.0
    skew: float = 0.0
    noise_ratio: float = 1.0
    heavy_tails: bool = False
    extra_pole_Hz: float = inf
    deflection_m: Callable[[Floats], Floats] | None = None
    z_m: Floats = field(default_factory=lambda: np.empty(0))
    vz_m_per_s: Floats = field(default_factory=lambda: np.empty(0))
    az_m_per_s2: Floats = field(default_factory=lambda: np.empty(0))
    tip_m: Floats = field(default_factory=lambda: np.empty(0))
    depth_m: Floats = field(default_factory=lambda: np.empty(0))
    contact_N: Floats = field(default_factory=lambda: np.empty(0))
    wrench: Floats = field(default_factory=lambda: np.empty((0, 6)))

    def add_lateral_force(self, fx_N: Floats, fy_N: Floats) -> None:
        """Add a lateral force at the tip, with its torque about the sensor.

        Args:
            fx_N: Force along x in N (n,).
            fy_N: Force along y in N (n,).
        """
        self.wrench[:, 0] += fx_N
        self.wrench[:, 1] += fy_N
        self.wrench[:, 3] += fy_N * self.tip_length_m
        self.wrench[:, 4] -= fx_N * self.tip_length_m


@dataclass(frozen=True)
class SensorRows:
    """Readings of the sensor, row by row, on which the laws of its electronics act last: they change `wrench` (m, 6) in place."""

    t_s: Floats
    wrench: Floats
    random: np.random.Generator


def _times_first(p: Shape, s: float) -> Shape:
    first = next(iter(p))
    return p | {first: p[first] * s}


@dataclass(frozen=True)
class Law:
    """One law of one effect. `at` gives its parameters at a strength; by default that is a factor on the first number of its shape.

    `variance` laws move scatter or lattice, not the mean.

    The `name` of a law of docs/reference/contract.md is `library`, and that of an effect outside the list is `novel`.

    `states` says what a law outside the list is, from its parameters and the height of the surface.
    """

    effect: str
    stage: Stage
    apply: Callable[[Any, Shape], None]
    draw: Callable[[np.random.Generator, CellScales], Shape]
    at: Callable[[Shape, float], Shape] = _times_first
    name: str = "library"
    strongest: float = inf
    variance: bool = False
    states: Callable[[Shape, float], LawStatement] = lambda _, __: EVENT


Planted = tuple[Law, Shape]

# small mathematics


def relax(u: Floats, dt_s: float, tau_s: float, start: float = 0.0) -> Floats:
    """First-order relaxation towards a signal, by the trapezoidal rule.

    Args:
        u: Signal (n,).
        dt_s: Step in s.
        tau_s: Time constant in s.
        start: Value before the first sample.

    Returns:
        The relaxed signal (n,).
    """
    k = dt_s / (2.0 * tau_s)
    b, a = [k / (1.0 + k), k / (1.0 + k)], [1.0, -(1.0 - k) / (1.0 + k)]
    return np.asarray(lfilter(b, a, u - start) + start)


def second_order(u: Floats, dt_s: float, numerator: list[float], frequency_Hz: float, damping: float) -> Floats:
    """Output of a second-order filter, (numerator in s)/(s² + 2ζωs + ω²), from rest at zero.

    The bilinear rule s = 2/dt (x - 1)/(x + 1) makes it discrete.

    Args:
        u: Signal (n,).
        dt_s: Step in s.
        numerator: Coefficients in s, highest power first, at most three.
        frequency_Hz: Natural frequency in Hz.
        damping: Damping ratio ζ.

    Returns:
        The filtered signal (n,).
    """
    omega, c = 2.0 * pi * frequency_Hz, 2.0 / dt_s
    n2, n1, n0 = [0.0] * (3 - len(numerator)) + numerator
    b = [n2 * c**2 + n1 * c + n0, 2.0 * (n0 - n2 * c**2), n2 * c**2 - n1 * c + n0]
    damped = 2.0 * damping * omega * c
    a = [c**2 + damped + omega**2, 2.0 * (omega**2 - c**2), c**2 - damped + omega**2]
    return np.asarray(lfilter(b, a, u))


def one_pole(u: Floats, dt_s: float, cutoff_Hz: float) -> Floats:
    """One-pole low-pass, settled on its first input; the cutoff is exact, since it is prewarped.

    Args:
        u: Signals (n,) or (n, k).
        dt_s: Step in s.

    Returns:
        The filtered signals, in the shape of u.
    """
    k = np.tan(min(pi * cutoff_Hz * dt_s, 1.5))
    b, a = [k / (1.0 + k), k / (1.0 + k)], [1.0, (k - 1.0) / (k + 1.0)]
    return np.asarray(lfilter(b, a, u - u[:1], axis=0) + u[:1])


def play(u: Floats, band: float) -> Floats:
    """Play operator: the output rests until the input leaves a band around it.

    Args:
        u: Signal (n,).
        band: Full width of the band, in the unit of u.

    Returns:
        The output (n,).
    """
    half, here, out = 0.5 * band, float(u[0]), []
    for x in u.tolist():
        if x - here > half:
            here = x - half
        elif here - x > half:
            here = x + half
        out.append(here)
    return np.array(out)


def _times(*names: str) -> Callable[[Shape, float], Shape]:
    return lambda p, s: {k: x * s if k in names else x for k, x in p.items()}


def _over(name: str) -> Callable[[Shape, float], Shape]:
    return lambda p, s: p | {name: p[name] / s}


def _power(name: str) -> Callable[[Shape, float], Shape]:
    return lambda p, s: p | {name: p[name] ** s}


def _sign(r: np.random.Generator) -> float:
    return float(r.choice([-1.0, 1.0]))


def _angle(r: np.random.Generator) -> float:
    return float(r.uniform(-pi, pi))


# robot


def _lag(w: SimulatedRun, p: Shape) -> None:
    w.servo_Hz *= p["bandwidth_ratio"]


def _lag_damped_otherwise(w: SimulatedRun, p: Shape) -> None:
    w.servo_Hz *= p["bandwidth_ratio"]
    w.servo_damping = p["damping_ratio"]


def _lag_extra_pole(w: SimulatedRun, p: Shape) -> None:
    w.command_m = relax(w.command_m, w.dt_s, p["extra_tau_s"], float(w.command_m[0]))
    w.servo_Hz *= p["bandwidth_ratio"]


def _vibration(w: SimulatedRun, p: Shape) -> None:
    omega = 2.0 * pi * p["frequency_Hz"]
    angle = omega * w.t_s + p["phase_rad"]
    w.z_m = w.z_m + p["amplitude_m"] * np.sin(angle)
    w.vz_m_per_s = w.vz_m_per_s + p["amplitude_m"] * omega * np.cos(angle)
    w.az_m_per_s2 = w.az_m_per_s2 - p["amplitude_m"] * omega**2 * np.sin(angle)


def _vibration_harmonics(w: SimulatedRun, p: Shape) -> None:
    _vibration(w, p)
    _vibration(w, {"amplitude_m": 0.2 * p["amplitude_m"], "frequency_Hz": 2.0 * p["frequency_Hz"], "phase_rad": p["second_rad"]})


def _backlash(w: SimulatedRun, p: Shape) -> None:
    w.tip_m = play(w.tip_m, p["width_m"])


def _backlash_soft(w: SimulatedRun, p: Shape) -> None:
    w.tip_m = np.mean([play(w.tip_m, p["width_m"] * share) for share in (0.6, 1.0, 1.4)], axis=0)


def _compliance(w: SimulatedRun, p: Shape) -> None:
    w.deflection_m = lambda f_N: f_N / p["stiffness_N_per_m"]


def _compliance_hardening(w: SimulatedRun, p: Shape) -> None:
    w.deflection_m = lambda f_N: f_N / p["stiffness_N_per_m"] / (1.0 + np.abs(f_N) / p["hardening_N"])


# tissue


def _surface(w: SimulatedRun, p: Shape) -> None:
    w.surface_m = w.surface_m + p["offset_m"]


def _surface_settling(w: SimulatedRun, p: Shape) -> None:
    w.surface_m = w.surface_m + p["offset_m"] * (1.0 - p["share"] * np.exp(-w.t_s / p["tau_s"]))


def _modulus(w: SimulatedRun, p: Shape) -> None:
    w.hertz_N_per_m15 = w.hertz_N_per_m15 * p["ratio"]


def _modulus_strain(w: SimulatedRun, p: Shape) -> None:
    w.contact_N = w.contact_N * p["ratio"] * (1.0 + p["stiffening"] * (p["ratio"] - 1.0) * w.depth_m / p["depth_m"])


def _chi(w: SimulatedRun, p: Shape) -> Floats:
    return np.sqrt(w.tip_radius_m * w.depth_m) / p["thickness_m"]


def _thickness(w: SimulatedRun, p: Shape) -> None:
    """Dimitriadis 2002, bonded, ν = 0.5."""
    x = _chi(w, p)
    w.contact_N = w.contact_N * (1.0 + 1.133 * x + 1.283 * x**2 + 0.769 * x**3 + 0.0975 * x**4)


def _thickness_exponential(w: SimulatedRun, p: Shape) -> None:
    x = np.minimum(_chi(w, p), 3.0)
    w.contact_N = w.contact_N * np.exp(1.1 * x + 0.55 * x**2)


def _inclusion(w: SimulatedRun, p: Shape, power: int = 2) -> None:
    x = (w.depth_m / p["depth_m"]) ** power
    w.contact_N = w.contact_N * (1.0 + p["contrast"] * x / (1.0 + x))


def _viscoelastic(w: SimulatedRun, p: Shape) -> None:
    _maxwell(w, [(p["ratio"], p["tau_s"])])


def _maxwell(w: SimulatedRun, arms: list[tuple[float, float]]) -> None:
    elastic = w.contact_N
    total = elastic + sum((g * (elastic - relax(elastic, w.dt_s, tau, float(elastic[0]))) for g, tau in arms), np.zeros_like(elastic))
    w.contact_N = np.where(w.depth_m > 0.0, np.maximum(total, 0.0), 0.0)


def _wiechert(w: SimulatedRun, p: Shape) -> None:
    _maxwell(w, [(0.6 * p["ratio"], p["tau_s"]), (0.4 * p["ratio"], p["tau_s"] * p["spread"])])


def _power_law_relaxation(w: SimulatedRun, p: Shape) -> None:
    taus = p["tau_s"] * np.geomspace(0.1, 10.0, 5)
    weights = taus ** -p["exponent"]
    _maxwell(w, [(p["ratio"] * float(g), float(tau)) for g, tau in zip(weights / weights.sum(), taus, strict=True)])


def _share_of_deepest(w: SimulatedRun) -> Floats:
    deepest = np.maximum.accumulate(w.depth_m)
    return np.divide(w.depth_m, deepest, out=np.zeros_like(deepest), where=deepest > 0.0)


def _preconditioning(w: SimulatedRun, p: Shape) -> None:
    w.contact_N = w.contact_N * (1.0 - p["softening"] * (1.0 - _share_of_deepest(w) ** 2))


def _preconditioning_linear(w: SimulatedRun, p: Shape) -> None:
    w.contact_N = w.contact_N * (1.0 - p["softening"] * (1.0 - _share_of_deepest(w)) ** 0.8)


def _plasticity(w: SimulatedRun, p: Shape) -> None:
    w.surface_m = w.surface_m - p["set_m"] * _sunk(w, p["ratio"] ** np.arange(w.press.max() + 1.0))


def _plasticity_hyperbolic(w: SimulatedRun, p: Shape) -> None:
    w.surface_m = w.surface_m - p["set_m"] * _sunk(w, 1.0 / (1.0 + np.arange(w.press.max() + 1.0)) ** p["exponent"])


def _sunk(w: SimulatedRun, steps: Floats) -> Floats:
    total = np.concatenate([[0.0], np.cumsum(steps)])
    return np.asarray(total[np.maximum(w.press, 0)])


def _pull(w: SimulatedRun, reach_m: float) -> tuple[Floats, Floats]:
    """How far the tip has risen since its lowest point in this press, and how far it stands above the surface."""
    gap = w.tip_m - w.surface_m
    rise = np.zeros_like(gap)
    lowest = inf
    for k, (tip, over) in enumerate(zip(w.tip_m.tolist(), gap.tolist(), strict=True)):
        if over > reach_m:
            lowest = inf
        elif over <= 0.0 or lowest < inf:
            lowest = min(lowest, tip)
            rise[k] = tip - lowest
    return rise, gap


def _adhesion(w: SimulatedRun, p: Shape) -> None:
    rise, gap = _pull(w, p["range_m"])
    w.contact_N = w.contact_N - p["force_N"] * np.clip(rise / p["range_m"], 0.0, 1.0) * np.clip(1.0 - gap / p["range_m"], 0.0, 1.0)


def _adhesion_stringy(w: SimulatedRun, p: Shape) -> None:
    rise, gap = _pull(w, 4.0 * p["range_m"])
    w.contact_N = w.contact_N - p["force_N"] * (1.0 - np.exp(-rise / (0.5 * p["range_m"]))) * np.exp(
        -np.maximum(gap, 0.0) / (0.5 * p["range_m"])
    )


# probe


def _mass(w: SimulatedRun, p: Shape) -> None:
    w.mass_kg += p["delta_kg"]


def _mass_sloshing(w: SimulatedRun, p: Shape) -> None:
    w.wrench[:, 2] -= p["delta_kg"] * (0.85 * w.az_m_per_s2 + 0.15 * relax(w.az_m_per_s2, w.dt_s, p["tau_s"]))


def _resonance(w: SimulatedRun, p: Shape) -> None:
    ringing = -second_order(w.az_m_per_s2, w.dt_s, [1.0, 0.0, 0.0], p["frequency_Hz"], p["damping_ratio"])
    w.wrench[:, 2] -= w.mass_kg * p["participation"] * ringing


def _resonance_two_modes(w: SimulatedRun, p: Shape) -> None:
    _resonance(w, p)
    _resonance(w, {**p, "participation": 0.15 * p["participation"], "frequency_Hz": p["second_Hz"]})


def _spring(w: SimulatedRun, p: Shape) -> None:
    w.wrench[:, 2] -= p["stiffness_N_per_m"] * (w.z_m - w.z_m[0])


def _spring_cubic(w: SimulatedRun, p: Shape) -> None:
    x = w.z_m - w.z_m[0]
    w.wrench[:, 2] -= p["stiffness_N_per_m"] * x * (1.0 + 0.6 * (x / p["stroke_m"]) ** 2)


def _friction(w: SimulatedRun, p: Shape) -> None:
    w.wrench[:, 2] -= p["force_N"] * np.tanh(w.vz_m_per_s / 0.5e-3)


def _friction_dahl(w: SimulatedRun, p: Shape) -> None:
    w.wrench[:, 2] -= p["force_N"] * _loop(w.z_m, p["presliding_m"], 1.0)


def _friction_stribeck(w: SimulatedRun, p: Shape) -> None:
    speed = np.abs(w.vz_m_per_s)
    level = 1.0 + p["breakaway"] * np.exp(-((speed / p["stribeck_m_per_s"]) ** 2))
    w.wrench[:, 2] -= p["force_N"] * level * np.tanh(w.vz_m_per_s / 0.3e-3)


def _viscous(w: SimulatedRun, p: Shape) -> None:
    w.wrench[:, 2] -= p["coefficient_N_s_per_m"] * w.vz_m_per_s


def _viscous_thinning(w: SimulatedRun, p: Shape) -> None:
    pace = np.abs(w.vz_m_per_s) / p["speed_m_per_s"]
    w.wrench[:, 2] -= p["coefficient_N_s_per_m"] * w.vz_m_per_s / (1.0 + pace) ** 0.3


def _lateral(w: SimulatedRun, p: Shape) -> None:
    f = p["ratio"] * w.contact_N
    w.add_lateral_force(f * np.cos(p["azimuth_rad"]), f * np.sin(p["azimuth_rad"]))


def _lateral_growing(w: SimulatedRun, p: Shape) -> None:
    f = p["ratio"] * w.contact_N * (np.maximum(w.contact_N, 0.0) / p["force_N"]) ** 0.15
    w.add_lateral_force(f * np.cos(p["azimuth_rad"]), f * np.sin(p["azimuth_rad"]))


def _tilt(w: SimulatedRun, p: Shape) -> None:
    _tilted(w, np.full_like(w.t_s, p["angle_rad"]), p["azimuth_rad"])


def _tilt_bending(w: SimulatedRun, p: Shape) -> None:
    _tilted(w, p["angle_rad"] * (1.0 + 0.15 * w.contact_N / p["force_N"]), p["azimuth_rad"])


def _tilted(w: SimulatedRun, angle: Floats, azimuth: float) -> None:
    across, x, y = np.sin(angle), np.cos(azimuth), np.sin(azimuth)
    other = w.wrench[:, 2] - w.contact_N
    w.add_lateral_force(across * x * w.contact_N, across * y * w.contact_N)
    w.wrench[:, 0] += across * x * other
    w.wrench[:, 1] += across * y * other
    w.wrench[:, 2] *= np.cos(angle)


# sensor


def _bias(w: SimulatedRun, p: Shape) -> None:
    w.wrench[:, 2] += p["offset_N"]


def _bias_settling(w: SimulatedRun, p: Shape) -> None:
    w.wrench[:, 2] += p["offset_N"] * (1.0 - p["share"] * np.exp(-w.t_s / p["tau_s"]))


def _drift(w: SimulatedRun, p: Shape) -> None:
    w.wrench[:, 2] += p["rate_N_per_s"] * w.t_s


def _drift_nonlinear(w: SimulatedRun, p: Shape) -> None:
    w.wrench[:, 2] += p["rate_N_per_s"] * w.t_s * (1.0 + p["bend"] * np.sin(2.0 * pi * w.t_s / p["period_s"]))


def _warmup(w: SimulatedRun, p: Shape) -> None:
    w.wrench[:, 2] += p["amplitude_N"] * (1.0 - np.exp(-w.t_s / p["tau_s"]))


def _warmup_stretched(w: SimulatedRun, p: Shape) -> None:
    w.wrench[:, 2] += p["amplitude_N"] * (1.0 - np.exp(-((w.t_s / p["tau_s"]) ** p["exponent"])))


def _gain(w: SimulatedRun, p: Shape) -> None:
    w.wrench[:, 2] *= 1.0 + p["error"]


def _gain_nonlinear(w: SimulatedRun, p: Shape) -> None:
    w.wrench[:, 2] *= 1.0 + p["error"] * (1.0 + p["bend"] * (np.abs(w.wrench[:, 2]) / p["force_N"] - 0.5))


def _asymmetry(w: SimulatedRun, p: Shape) -> None:
    f = w.wrench[:, 2]
    w.wrench[:, 2] = f + p["ratio"] * np.where(p["side"] > 0.0, np.maximum(f - p["at_N"], 0.0), np.minimum(f, p["at_N"]))


def _asymmetry_rounded(w: SimulatedRun, p: Shape) -> None:
    """The slope changes over a range of forces and not at one."""
    f, side = w.wrench[:, 2], float(np.sign(p["side"]))
    beyond = side * p["width_N"] * np.logaddexp(0.0, side * (f - p["at_N"]) / p["width_N"])
    unloaded = side * p["width_N"] * np.logaddexp(0.0, -side * p["at_N"] / p["width_N"])
    w.wrench[:, 2] = f + p["ratio"] * (beyond - unloaded)


def _asymmetry_shape(r: np.random.Generator, m: CellScales) -> Shape:
    return {"ratio": 0.05 * _sign(r), "at_N": float(r.uniform(0.05, 0.6)) * m.force_N, "side": _sign(r)}


def _asymmetry_at(p: Shape, s: float) -> Shape:
    return {**p, "ratio": p["ratio"] * s, "side": float(np.sign(p["side"]))}


def _crosstalk(w: SimulatedRun, p: Shape) -> None:
    for column, name in ((0, "fx_per_fz"), (1, "fy_per_fz"), (3, "tx_per_fz_m"), (4, "ty_per_fz_m")):
        w.wrench[:, column] += p[name] * w.wrench[:, 2]


def _crosstalk_nonlinear(w: SimulatedRun, p: Shape) -> None:
    fz = w.wrench[:, 2].copy()
    w.wrench[:, 2] = fz * (1.0 + 0.15 * np.abs(fz) / p["force_N"])
    _crosstalk(w, p)
    w.wrench[:, 2] = fz


def _filter(w: SimulatedRun, p: Shape) -> None:
    w.cutoff_Hz = p["cutoff_Hz"]


def _filter_two_poles(w: SimulatedRun, p: Shape) -> None:
    w.cutoff_Hz = p["cutoff_Hz"]
    w.extra_pole_Hz = p["cutoff_Hz"] * p["second"]


def _latency(w: SimulatedRun, p: Shape) -> None:
    w.late_s = w.late_s + p["delay_s"]


def _latency_wandering(w: SimulatedRun, p: Shape) -> None:
    w.late_s = w.late_s + p["delay_s"] * (1.0 + p["share"] * np.sin(2.0 * pi * w.t_s / p["period_s"]))


def _hysteresis(w: SimulatedRun, p: Shape) -> None:
    w.wrench[:, 2] += p["amplitude_N"] * _loop(w.wrench[:, 2], p["width_N"], p.get("exponent", 1.0))


def _loop(f: Floats, width_N: float, exponent: float) -> Floats:
    """Bouc-Wen: dw = df/width · (1 - sign(w df)·|w|^n), n = 1 being the listed law; that is exact step by step, others by Heun's rule."""

    def slope(x: float, up: float) -> float:
        return 1.0 - float(np.copysign(1.0, x * up)) * abs(x) ** exponent

    x, out, steps = 0.0, [0.0], np.diff(f) / width_N
    if exponent == 1.0:
        for target, kept in zip(np.sign(steps).tolist(), np.exp(-np.abs(steps)).tolist(), strict=True):
            x = target + (x - target) * kept
            out.append(x)
        return np.array(out)
    for change in steps.tolist():
        if change != 0.0:
            pieces = min(1 + int(abs(change) / 0.05), 50)
            h = change / pieces
            for _ in range(pieces):
                first = slope(x, h)
                x = min(1.0, max(-1.0, x + 0.5 * h * (first + slope(x + h * first, h))))
        out.append(x)
    return np.array(out)


def _prandtl(w: SimulatedRun, p: Shape) -> None:
    """Prandtl-Ishlinskii: a sum of plays."""
    f = w.wrench[:, 2]
    w.wrench[:, 2] = f + p["amplitude_N"] / p["width_N"] * np.mean([f - play(f, p["width_N"] * x) for x in (0.5, 1.0, 2.0, 4.0)], axis=0)


def _creep(w: SimulatedRun, p: Shape) -> None:
    w.wrench[:, 2] += p["ratio"] * relax(w.wrench[:, 2], w.dt_s, p["tau_s"])


def _creep_power_law(w: SimulatedRun, p: Shape) -> None:
    f = w.wrench[:, 2].copy()
    taus = p["tau_s"] * np.array([0.05, 0.25, 1.0, 4.0])
    w.wrench[:, 2] += p["ratio"] * np.mean([relax(f, w.dt_s, float(tau)) for tau in taus], axis=0)


def _skew(w: SimulatedRun, p: Shape) -> None:
    w.skew += p["ratio"]


def _skew_nonlinear(w: SimulatedRun, p: Shape) -> None:
    w.late_s = w.late_s - p["ratio"] * w.t_s * (1.0 + 0.15 * np.sin(2.0 * pi * w.t_s / w.t_s[-1]))


def _noise(w: SimulatedRun, p: Shape) -> None:
    w.noise_ratio *= p["ratio"]


def _noise_heavy(w: SimulatedRun, p: Shape) -> None:
    w.noise_ratio *= p["ratio"]
    w.heavy_tails = True


def _saturation(r: SensorRows, p: Shape) -> None:
    r.wrench[:, 2] = np.clip(r.wrench[:, 2], -p["limit_N"], p["limit_N"])


def _saturation_soft(r: SensorRows, p: Shape) -> None:
    over = np.abs(r.wrench[:, 2]) / p["limit_N"]
    r.wrench[:, 2] /= (1.0 + over ** p["knee"]) ** (1.0 / p["knee"])


def _quantization(r: SensorRows, p: Shape) -> None:
    r.wrench[:, 2] = np.round(r.wrench[:, 2] / p["step_N"]) * p["step_N"]


def _quantization_floor(r: SensorRows, p: Shape) -> None:
    r.wrench[:, 2] = (np.floor(r.wrench[:, 2] / p["step_N"]) + 0.5) * p["step_N"]


def _dropout(r: SensorRows, p: Shape) -> None:
    _hold(r, p["rate_Hz"], lambda: p["length_s"])


def _dropout_random(r: SensorRows, p: Shape) -> None:
    _hold(r, p["rate_Hz"], lambda: float(r.random.exponential(p["length_s"])))


def _hold(r: SensorRows, rate_Hz: float, length_s: Callable[[], float]) -> None:
    t = float(r.t_s[0])
    while (t := t + float(r.random.exponential(1.0 / rate_Hz))) < r.t_s[-1]:
        a, b = np.searchsorted(r.t_s, [t, t + length_s()])
        r.wrench[a:b] = r.wrench[max(int(a) - 1, 0)]


# what is not in the list


def _breathing(w: SimulatedRun, p: Shape) -> None:
    w.surface_m = w.surface_m + p["amplitude_m"] * np.sin(2.0 * pi * p["frequency_Hz"] * w.t_s + p["phase_rad"]) ** 3


def _hum(w: SimulatedRun, p: Shape) -> None:
    w.wrench[:, 2] += p["force_N"] * np.sin(2.0 * pi * p["frequency_Hz"] * w.t_s + p["phase_rad"])


def _wander(w: SimulatedRun, p: Shape) -> None:
    random = np.random.default_rng(int(p["seed"]))
    coarse = np.arange(0.0, w.t_s[-1] + 2.0, 0.5)
    walk = lfilter([1.0], [1.0, -np.exp(-0.5 / p["tau_s"])], random.standard_normal(len(coarse)))
    walk = (walk - walk[0]) / max(float(np.std(walk)), 1e-12)
    w.wrench[:, 2] += p["force_N"] * np.interp(w.t_s, coarse, walk)


def _cogging(w: SimulatedRun, p: Shape) -> None:
    w.wrench[:, 2] += p["force_N"] * np.sin(2.0 * pi * w.z_m / p["pitch_m"] + p["phase_rad"])


def _slip(w: SimulatedRun, p: Shape) -> None:
    """In some presses the tissue slides away under the tip while it is held: force falls, and stays lower until the tip leaves."""
    random = np.random.default_rng(int(p["seed"]))
    for k in range(int(w.press.max()) + 1):
        inside = np.flatnonzero((w.press == k) & (w.contact_N > 0.0))
        if len(inside) and random.random() < 0.6:
            a = inside[int(random.uniform(0.3, 0.75) * len(inside))]
            b = inside[-1] + 1
            fall = p["share"] * w.contact_N[a:b] * (1.0 - np.exp(-(w.t_s[a:b] - w.t_s[a]) / 0.03))
            w.contact_N[a:b] -= fall


def _sticking(w: SimulatedRun, p: Shape) -> None:
    """Wall friction in the tissue: a force against the way of the tip that grows with the depth."""
    way = relax(np.tanh(w.vz_m_per_s / 1e-3), w.dt_s, 0.05)
    w.contact_N = np.maximum(w.contact_N * (1.0 - p["share"] * way * np.minimum(w.depth_m / p["depth_m"], 1.5)), 0.0)


def _pulse(w: SimulatedRun, p: Shape) -> None:
    """Something knocks against the cell a few times."""
    random = np.random.default_rng(int(p["seed"]))
    for begin in random.uniform(0.0, w.t_s[-1], int(p["count"])):
        since = np.maximum(w.t_s - begin, 0.0)
        direction = random.normal(size=3) * [0.4, 0.4, 1.0]
        shape = np.exp(-since / 0.08) * np.sin(2.0 * pi * 11.0 * since)
        for axis in range(3):
            w.wrench[:, axis] += p["force_N"] * direction[axis] * shape


def _slow_servo(w: SimulatedRun, p: Shape) -> None:
    """A drive that cannot go faster than this."""
    step, here, out = p["speed_m_per_s"] * w.dt_s, float(w.command_m[0]), []
    for target in w.command_m.tolist():
        here += min(max(target - here, -step), step)
        out.append(here)
    w.command_m = np.array(out)


def _stair_servo(w: SimulatedRun, p: Shape) -> None:
    """A drive that goes in coarse steps."""
    w.command_m = np.round(w.command_m / p["step_m"]) * p["step_m"]


def _second_body(w: SimulatedRun, p: Shape) -> None:
    """From some height on the probe's shaft rubs against an edge: a lateral force in proportion to how far it has passed."""
    past = np.maximum(p["height_m"] - w.z_m, 0.0) / p["stroke_m"]
    w.wrench[:, 0] += p["force_N"] * past * np.cos(p["azimuth_rad"]) * np.tanh(w.vz_m_per_s / 2e-3)
    w.wrench[:, 1] += p["force_N"] * past * np.sin(p["azimuth_rad"]) * np.tanh(w.vz_m_per_s / 2e-3)


def _twist(w: SimulatedRun, p: Shape) -> None:
    w.wrench[:, 5] += p["torque_Nm"] * np.maximum(w.contact_N, 0.0) / p["force_N"] * np.tanh(relax(w.vz_m_per_s, w.dt_s, 0.02) / 2e-3)


def _hook(w: SimulatedRun, p: Shape) -> None:
    """A cable that goes taut above some height."""
    w.wrench[:, 2] -= p["stiffness_N_per_m"] * np.maximum(w.z_m - p["height_m"], 0.0)


def _steps(w: SimulatedRun, p: Shape) -> None:
    """The zero jumps now and then."""
    random = np.random.default_rng(int(p["seed"]))
    for begin in random.uniform(0.1, 0.9, int(p["count"])) * w.t_s[-1]:
        w.wrench[:, 2] += p["force_N"] * float(random.choice([-1.0, 1.0])) * (w.t_s > begin)


def _heat(w: SimulatedRun, p: Shape) -> None:
    """The drive warms with its work, and the reading follows the square of the speed, slowly."""
    w.wrench[:, 2] += p["force_N"] * relax((w.vz_m_per_s / p["speed_m_per_s"]) ** 2, w.dt_s, p["tau_s"])


def _swelling(w: SimulatedRun, p: Shape) -> None:
    """The tissue comes up while it is left alone and is pressed flat while it is not."""
    loaded = (w.command_m < w.surface_m).astype(float)
    w.surface_m = w.surface_m + p["amplitude_m"] * (1.0 - 3.0 * relax(loaded, w.dt_s, p["tau_s"]))


# the tables: shapes are what strength one means, some 1 to 10 % of the cell's own scale


def _taut(r: np.random.Generator, m: CellScales, low: float, high: float) -> float:
    return log_uniform(r, low * m.duration_s, high * m.duration_s)


def _hysteresis_shape(r: np.random.Generator, m: CellScales) -> Shape:
    return {"width_N": m.force_N * log_uniform(r, 0.06, 0.4), "amplitude_N": _sign(r) * 0.03 * m.force_N}


def _crosstalk_shape(r: np.random.Generator, m: CellScales) -> Shape:
    x = r.normal(size=4) * 0.02
    return {"fx_per_fz": x[0], "fy_per_fz": x[1], "tx_per_fz_m": x[2] * m.tip_length_m, "ty_per_fz_m": x[3] * m.tip_length_m}


def _resonance_shape(r: np.random.Generator, m: CellScales) -> Shape:
    f = log_uniform(r, 1.5 * m.servo_Hz, min(6.0 * m.servo_Hz, 0.3 * m.rate_Hz))
    return {"frequency_Hz": f, "damping_ratio": log_uniform(r, 0.02, 0.15), "participation": 0.3}


def _vibration_shape(r: np.random.Generator, m: CellScales) -> Shape:
    return {"amplitude_m": 1e-3 * m.depth_m, "frequency_Hz": log_uniform(r, 1.5, 0.15 * m.rate_Hz), "phase_rad": _angle(r)}


def _filter_at(p: Shape, s: float) -> Shape:
    return {**p, "cutoff_Hz": p["base_Hz"] / (1.0 + s)}


def _filter_shape(r: np.random.Generator, m: CellScales) -> Shape:
    return {"cutoff_Hz": m.cutoff_Hz / 2.0, "base_Hz": m.cutoff_Hz, "second": log_uniform(r, 1.0, 2.5)}


def _saturation_at(p: Shape, s: float) -> Shape:
    return {**p, "limit_N": p["peak_N"] * (1.0 - 0.1 * s)}


def _softly_saturating_at(p: Shape, s: float) -> Shape:
    return {**p, "limit_N": p["peak_N"] / s**0.5}


def _noise_at(p: Shape, s: float) -> Shape:
    return {**p, "ratio": 1.0 + 0.4 * s}


LIBRARY_LAWS: tuple[Law, ...] = (
    Law(
        "robot.lag",
        "command",
        _lag,
        lambda r, m: {"bandwidth_ratio": 0.8 if r.random() < 0.7 else 1.25},
        _power("bandwidth_ratio"),
        strongest=6.0,
    ),
    Law(
        "robot.lag",
        "command",
        _lag_damped_otherwise,
        lambda r, m: {"bandwidth_ratio": 1.0, "damping_ratio": m.servo_damping},
        lambda p, s: {**p, "damping_ratio": p["damping_ratio"] * 0.8**s},
        strongest=6.0,
    ),
    Law("robot.vibration", "motion", _vibration, _vibration_shape),
    Law("robot.backlash", "tip", _backlash, lambda r, m: {"width_m": 0.03 * m.depth_m}, strongest=10.0),
    Law(
        "robot.compliance",
        "tip",
        _compliance,
        lambda r, m: {"stiffness_N_per_m": 20.0 * m.force_N / m.depth_m},
        _over("stiffness_N_per_m"),
        strongest=40.0,
    ),
    Law("tissue.surface", "surface", _surface, lambda r, m: {"offset_m": _sign(r) * 0.05 * m.depth_m}, strongest=8.0),
    Law("tissue.modulus", "surface", _modulus, lambda r, m: {"ratio": 1.1 ** _sign(r)}, _power("ratio"), strongest=12.0),
    Law("tissue.viscoelastic", "history", _viscoelastic, lambda r, m: {"ratio": 0.1, "tau_s": log_uniform(r, 0.1, 6.0)}, strongest=30.0),
    Law("tissue.preconditioning", "history", _preconditioning, lambda r, m: {"softening": 0.1}, strongest=7.0),
    Law(
        "tissue.adhesion",
        "history",
        _adhesion,
        lambda r, m: {"force_N": 0.03 * m.force_N, "range_m": m.depth_m * log_uniform(r, 0.08, 0.5)},
        strongest=20.0,
    ),
    Law(
        "tissue.thickness",
        "tissue",
        _thickness,
        lambda r, m: {"thickness_m": 12.0 * (m.tip_radius_m * m.depth_m) ** 0.5},
        _over("thickness_m"),
        strongest=12.0,
    ),
    Law(
        "tissue.inclusion",
        "tissue",
        _inclusion,
        lambda r, m: {"contrast": 0.3, "depth_m": m.depth_m * log_uniform(r, 0.4, 2.5)},
        strongest=30.0,
    ),
    Law(
        "tissue.plasticity",
        "surface",
        _plasticity,
        lambda r, m: {"set_m": 0.02 * m.depth_m, "ratio": float(r.uniform(0.3, 0.8))},
        strongest=10.0,
    ),
    Law("probe.mass", "command", _mass, lambda r, m: {"delta_kg": (0.15 if r.random() < 0.7 else -0.15) * m.mass_kg}, strongest=6.0),
    Law("structure.resonance", "probe", _resonance, _resonance_shape, _times("participation"), strongest=3.3),
    Law("cable.spring", "probe", _spring, lambda r, m: {"stiffness_N_per_m": _sign(r) * 0.03 * m.force_N / m.stroke_m}),
    Law("cable.friction", "probe", _friction, lambda r, m: {"force_N": 0.02 * m.force_N}),
    Law(
        "cable.friction",
        "probe",
        _friction_dahl,
        lambda r, m: {"force_N": 0.02 * m.force_N, "presliding_m": m.depth_m * log_uniform(r, 0.02, 0.2)},
    ),
    Law("cable.viscous", "probe", _viscous, lambda r, m: {"coefficient_N_s_per_m": 0.02 * m.force_N / m.speed_m_per_s}),
    Law("contact.lateral", "probe", _lateral, lambda r, m: {"ratio": 0.02, "azimuth_rad": _angle(r)}, strongest=40.0),
    Law("probe.tilt", "probe", _tilt, lambda r, m: {"angle_rad": 0.02, "azimuth_rad": _angle(r)}, strongest=25.0),
    Law("clock.skew", "sensor", _skew, lambda r, m: {"ratio": _sign(r) * 0.01 / m.duration_s}, strongest=100.0),
    Law("sensor.latency", "sensor", _latency, lambda r, m: {"delay_s": 0.003}, strongest=60.0),
    Law("sensor.gain", "sensor", _gain, lambda r, m: {"error": _sign(r) * 0.03}, strongest=15.0),
    Law("sensor.asymmetry", "sensor", _asymmetry, _asymmetry_shape, _asymmetry_at, strongest=12.0),
    Law(
        "sensor.crosstalk",
        "sensor",
        _crosstalk,
        _crosstalk_shape,
        _times("fx_per_fz", "fy_per_fz", "tx_per_fz_m", "ty_per_fz_m"),
        strongest=15.0,
    ),
    Law("sensor.hysteresis", "sensor", _hysteresis, _hysteresis_shape, _times("amplitude_N"), strongest=10.0),
    Law("sensor.creep", "sensor", _creep, lambda r, m: {"ratio": 0.05, "tau_s": log_uniform(r, 0.3, 20.0)}, strongest=20.0),
    Law("sensor.warmup", "sensor", _warmup, lambda r, m: {"amplitude_N": _sign(r) * 2.0 * m.noise_N, "tau_s": _taut(r, m, 0.05, 0.4)}),
    Law("sensor.filter", "sensor", _filter, _filter_shape, _filter_at, strongest=50.0),
    Law("sensor.bias", "sensor", _bias, lambda r, m: {"offset_N": _sign(r) * m.noise_N}),
    Law("sensor.drift", "sensor", _drift, lambda r, m: {"rate_N_per_s": _sign(r) * m.noise_N / m.duration_s}),
    Law("sensor.saturation", "row", _saturation, lambda r, m: {"limit_N": m.force_N, "peak_N": m.force_N}, _saturation_at, strongest=8.0),
    Law("sensor.noise", "sensor", _noise, lambda r, m: {"ratio": 1.4}, _noise_at, variance=True),
    Law("sensor.quantization", "row", _quantization, lambda r, m: {"step_N": 2.0 * max(m.noise_N, m.step_N)}, variance=True),
    Law(
        "sensor.dropout",
        "row",
        _dropout,
        lambda r, m: {"rate_Hz": log_uniform(r, 0.4, 3.0), "length_s": 0.02},
        _times("length_s"),
        variance=True,
    ),
)
"""The listed effects, each with the listed law."""


def _with(
    effect: str,
    name: str,
    apply: Callable[[Any, Shape], None],
    more: Callable[[np.random.Generator, CellScales], Shape] = lambda r, m: {},
    **changes: Any,
) -> Law:
    """Another law for a listed effect: the same shape and strength, and what else the law asks for."""
    own = next(law for law in LIBRARY_LAWS if law.effect == effect)
    return replace(own, name=name, draw=lambda r, m: own.draw(r, m) | more(r, m), apply=apply, **changes)


def _lag_foreign_at(p: Shape, s: float) -> Shape:
    return {**p, "bandwidth_ratio": 0.85**s, "extra_tau_s": p["extra_tau_s"] * s}


def _seed(r: np.random.Generator) -> float:
    return float(r.integers(1, 2**31))


FOREIGN_LAWS: tuple[Law, ...] = (
    _with("robot.lag", "third-order servo", _lag_extra_pole, lambda r, m: {"extra_tau_s": 0.01 / m.servo_Hz}, at=_lag_foreign_at),
    _with("robot.vibration", "with a harmonic", _vibration_harmonics, lambda r, m: {"second_rad": _angle(r)}),
    _with("robot.backlash", "three dead bands", _backlash_soft),
    _with("robot.compliance", "hardening", _compliance_hardening, lambda r, m: {"hardening_N": log_uniform(r, 1.5, 5.0) * m.force_N}),
    _with("tissue.surface", "settling", _surface_settling, lambda r, m: {"share": 0.15, "tau_s": _taut(r, m, 0.1, 0.5)}),
    _with("tissue.modulus", "strain stiffening", _modulus_strain, lambda r, m: {"stiffening": 0.25, "depth_m": m.depth_m}, stage="tissue"),
    _with("tissue.viscoelastic", "Maxwell-Wiechert, two arms", _wiechert, lambda r, m: {"spread": log_uniform(r, 4.0, 12.0)}),
    _with("tissue.viscoelastic", "power law", _power_law_relaxation, lambda r, m: {"exponent": float(r.uniform(0.05, 0.3))}),
    _with("tissue.preconditioning", "sharper", _preconditioning_linear),
    _with("tissue.adhesion", "exponential", _adhesion_stringy),
    _with("tissue.thickness", "exponential", _thickness_exponential),
    _with("tissue.inclusion", "sharper", partial(_inclusion, power=3)),
    _with("tissue.plasticity", "hyperbolic", _plasticity_hyperbolic, lambda r, m: {"exponent": float(r.uniform(0.8, 2.0))}),
    _with("probe.mass", "part of it sloshes", _mass_sloshing, lambda r, m: {"tau_s": 0.15 / m.servo_Hz}, stage="probe"),
    _with("structure.resonance", "two modes", _resonance_two_modes, lambda r, m: {"second_Hz": min(7.5 * m.servo_Hz, 0.35 * m.rate_Hz)}),
    _with("cable.spring", "hardening", _spring_cubic, lambda r, m: {"stroke_m": m.stroke_m}),
    _with(
        "cable.friction",
        "Stribeck",
        _friction_stribeck,
        lambda r, m: {"breakaway": float(r.uniform(0.1, 0.4)), "stribeck_m_per_s": log_uniform(r, 0.05, 0.3) * m.speed_m_per_s},
    ),
    _with("cable.viscous", "shear thinning", _viscous_thinning, lambda r, m: {"speed_m_per_s": m.speed_m_per_s}),
    _with("contact.lateral", "grows with load", _lateral_growing, lambda r, m: {"force_N": m.force_N}),
    _with("probe.tilt", "bends under load", _tilt_bending, lambda r, m: {"force_N": m.force_N}),
    _with("clock.skew", "wandering", _skew_nonlinear),
    _with("sensor.latency", "wandering", _latency_wandering, lambda r, m: {"share": 0.2, "period_s": _taut(r, m, 0.1, 0.5)}),
    _with("sensor.gain", "slightly bent", _gain_nonlinear, lambda r, m: {"bend": 0.25 * _sign(r), "force_N": m.force_N}),
    _with("sensor.asymmetry", "rounded corner", _asymmetry_rounded, lambda r, m: {"width_N": float(r.uniform(0.03, 0.12)) * m.force_N}),
    _with("sensor.crosstalk", "slightly bent", _crosstalk_nonlinear, lambda r, m: {"force_N": m.force_N}),
    _with("sensor.hysteresis", "Bouc-Wen", _hysteresis, lambda r, m: {"exponent": float(r.uniform(1.3, 2.5))}),
    _with("sensor.hysteresis", "Prandtl-Ishlinskii", _prandtl),
    _with("sensor.creep", "power law", _creep_power_law),
    _with("sensor.warmup", "stretched", _warmup_stretched, lambda r, m: {"exponent": float(r.uniform(0.6, 0.85))}),
    _with("sensor.filter", "two poles", _filter_two_poles),
    _with("sensor.bias", "settling", _bias_settling, lambda r, m: {"share": 0.2, "tau_s": _taut(r, m, 0.1, 0.4)}),
    _with("sensor.drift", "bent", _drift_nonlinear, lambda r, m: {"bend": 0.1, "period_s": _taut(r, m, 0.5, 1.5)}),
    _with(
        "sensor.saturation",
        "soft",
        _saturation_soft,
        lambda r, m: {"knee": float(r.uniform(12.0, 20.0))},
        at=_softly_saturating_at,
        strongest=8.0,
    ),
    _with("sensor.noise", "heavy tails", _noise_heavy),
    _with("sensor.quantization", "truncated", _quantization_floor),
    _with("sensor.dropout", "random lengths", _dropout_random),
)
"""The listed effects, each with another law (real cells never follow the list exactly)."""

# what the effects outside the list are


def _states_sticking(_: Shape, __: float) -> LawStatement:
    """Contact force × depth × direction, which lags by 0.05 s; force and depth are functions of each other."""
    lagging = names("fz_N", ("force",), ("direction",), memory="relaxed", constant=0.05)
    return is_law(lagging, names("fz_N", ("force_direction", "direction"), DEEP), names("fz_N", ("force",), ("direction",)))


def _states_hook(p: Shape, surface_z_m: float) -> LawStatement:
    """A cable that goes taut above the surface acts in the air alone."""
    return is_law(names("fz_N", ("one", "air") if p["height_m"] >= surface_z_m else ("one",), HIGH))


_novel = partial(Law, name="novel")

NOVEL_LAWS: tuple[Law, ...] = (
    _novel(
        "breathing",
        "surface",
        _breathing,
        lambda r, m: {"amplitude_m": 0.02 * m.depth_m, "frequency_Hz": log_uniform(r, 0.15, 0.6), "phase_rad": _angle(r)},
        strongest=10.0,
        states=lambda p, _: is_law(names("fz_N", ("surface",), ("time",), period=1.0 / p["frequency_Hz"])),
    ),
    _novel(
        "hum",
        "probe",
        _hum,
        lambda r, m: {"force_N": 0.5 * m.noise_N, "frequency_Hz": log_uniform(r, 0.3, 8.0), "phase_rad": _angle(r)},
        states=lambda p, _: is_law(names("fz_N", ("one",), ("time",), period=1.0 / p["frequency_Hz"])),
    ),
    _novel("wander", "sensor", _wander, lambda r, m: {"force_N": m.noise_N, "tau_s": _taut(r, m, 0.04, 0.15), "seed": _seed(r)}),
    _novel(
        "cogging",
        "probe",
        _cogging,
        lambda r, m: {"force_N": m.noise_N, "pitch_m": m.stroke_m * log_uniform(r, 0.05, 0.3), "phase_rad": _angle(r)},
        states=lambda p, _: is_law(names("fz_N", ("one",), HIGH, period=p["pitch_m"]), names("fz_N", ("one",), HIGH)),
    ),
    _novel("slip", "history", _slip, lambda r, m: {"share": 0.05, "seed": _seed(r)}, strongest=12.0),
    _novel("sticking", "history", _sticking, lambda r, m: {"share": 0.03, "depth_m": m.depth_m}, strongest=12.0, states=_states_sticking),
    _novel("pulses", "probe", _pulse, lambda r, m: {"force_N": 2.0 * m.noise_N, "count": float(r.integers(2, 7)), "seed": _seed(r)}),
    _novel(
        "drive with a speed limit",
        "command",
        _slow_servo,
        lambda r, m: {"speed_m_per_s": m.speed_m_per_s},
        lambda p, s: {"speed_m_per_s": p["speed_m_per_s"] / (1.0 + 0.1 * s)},
        strongest=40.0,
        states=lambda p, _: is_law(names("z_m", ("one",), ("command",), memory="slew", constant=p["speed_m_per_s"])),
    ),
    _novel(
        "drive in steps",
        "command",
        _stair_servo,
        lambda r, m: {"step_m": 0.02 * m.depth_m},
        strongest=10.0,
        states=lambda p, _: is_law(names("z_m", ("one",), ("command",), period=p["step_m"]), names("z_m", ("one",), ("command",))),
    ),
    _novel(
        "rubbing shaft",
        "probe",
        _second_body,
        lambda r, m: {
            "force_N": m.noise_N,
            "stroke_m": m.stroke_m,
            "azimuth_rad": _angle(r),
            "height_m": float(r.uniform(0.0, 0.4)) * m.stroke_m,
        },
        states=lambda _, __: is_law(*(names(channel, ("direction",), HIGH) for channel in ("lateral", "fx_N", "fy_N"))),
    ),
    _novel(
        "twist",
        "probe",
        _twist,
        lambda r, m: {"torque_Nm": 0.02 * m.noise_N, "force_N": m.force_N},
        states=lambda _, __: is_law(
            names("tz_Nm", ("force",), ("speed", "direction")), names("tz_Nm", ("direction", "force_direction"), DEEP)
        ),
    ),
    _novel(
        "taut cable",
        "probe",
        _hook,
        lambda r, m: {"stiffness_N_per_m": 5.0 * m.noise_N / m.stroke_m, "height_m": float(r.uniform(0.3, 0.6)) * m.stroke_m},
        states=_states_hook,
    ),
    _novel("jumping zero", "sensor", _steps, lambda r, m: {"force_N": m.noise_N, "count": float(r.integers(2, 6)), "seed": _seed(r)}),
    _novel(
        "warming drive",
        "sensor",
        _heat,
        lambda r, m: {"force_N": 2.0 * m.noise_N, "speed_m_per_s": m.speed_m_per_s, "tau_s": _taut(r, m, 0.02, 0.1)},
        states=lambda p, _: is_law(names("fz_N", ("one",), ("squared_speed",), memory="relaxed", constant=p["tau_s"])),
    ),
    _novel(
        "swelling tissue",
        "surface",
        _swelling,
        lambda r, m: {"amplitude_m": 0.02 * m.depth_m, "tau_s": _taut(r, m, 0.02, 0.1)},
        strongest=10.0,
        states=lambda p, _: is_law(names("fz_N", ("surface",), ("contact", "air"), memory="relaxed", constant=p["tau_s"])),
    ),
)
"""What can go wrong in a cell and is not in the list."""

INDISTINGUISHABLE: Mapping[str, tuple[str, ...]] = {
    "sensor.bias": ("sensor.warmup",),
    "sensor.drift": ("sensor.warmup",),
    "sensor.warmup": ("sensor.bias", "sensor.drift"),
    "sensor.gain": ("tissue.modulus",),
    "tissue.modulus": ("sensor.gain",),
    "tissue.thickness": ("tissue.inclusion",),
    "tissue.inclusion": ("tissue.thickness",),
    "probe.tilt": ("sensor.crosstalk",),
    "sensor.crosstalk": ("probe.tilt",),
}
"""For an effect, those that most motions can hardly tell from it."""
