"""Simulated cells that are written from the contract of a diagnosis alone: recording (.csv), cell file (.yaml) and truth (.truth.json).

The physics is that of docs/reference/contract.md, and nothing here is shared with the diagnosis. `benchmarks.foreign` draws these cells and
lets `palpd diagnose` answer.

The SNR of an effect is the norm of its noise-free change in 20 ms means, in standard deviations of the sensor. It counts the six forces and
torques (measured minus nominal, from the reported height), and `z_m` where `z_cmd_m` is recorded. Declared tolerances and press scatter are
projected out first. Each has its stated standard deviation as prior: without a prior, `sensor.bias` would have no SNR at any size.
"""

import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy: two cells at a time, each on one core

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.signal import cont2discrete, lfilter, lfilter_zi

Floats = NDArray[np.float64]
Acting = dict[str, Any]
"""The effects that act, by id: `ListedEffect`, or `OutsideEffect` below `outside.`."""
Deviations = dict[str, Any]
"""Deviations of a real cell from its file, by tolerance (crosstalk: 4 values), and of each press."""

STEP_S = 0.0005
"""Internal step. All sampling rates divide 2 kHz."""
BIN_S = 0.02
"""Length of the means that the SNR is computed from, as in the contract."""
LEAST_SNR, LARGEST_SNR = 5.0, 62.0
MOST_TRIES = 60
"""Number of cells that are drawn until the effects of a case can act in one."""
AXES = ("fx_N", "fy_N", "fz_N", "tx_Nm", "ty_Nm", "tz_Nm")
SCATTER = ("sensor.noise", "sensor.quantization", "sensor.dropout")
"""Effects that change no mean value."""
LISTED = {
    "sensor.bias": (1e-3, 3, "offset grows by 10 % over the recording"),
    "sensor.drift": (1e-5, 0.1, "power of time, not linear"),
    "sensor.warmup": (1e-3, 4, "two time constants"),
    "sensor.gain": (1e-3, 0.5, "gain grows with force, power 1.06"),
    "sensor.crosstalk": (5e-4, 0.3, "leak in power 1.1 of fz"),
    "sensor.filter": (0.02, 60, "two equal poles"),
    "sensor.latency": (2e-4, 0.15, "delay wanders by 15 %"),
    "sensor.hysteresis": (2e-3, 1.5, "two loops of different width"),
    "sensor.creep": (1e-3, 0.5, "two time constants"),
    "sensor.quantization": (0, 0, ""),
    "sensor.noise": (0, 0, "Student t noise, 6 degrees of freedom"),
    "sensor.saturation": (0.005, 0.8, "rounded knee"),
    "sensor.asymmetry": (2e-3, 0.6, "rounded knee"),
    "sensor.dropout": (0.01, 4.0, "lengths exponentially distributed"),
    "clock.skew": (1e-6, 5e-3, "rate wanders by 10 %"),
    "probe.mass": (2e-4, 0.4, "added mass follows through a 40 Hz pole"),
    "probe.tilt": (5e-4, 0.3, "angle grows by 15 % with force"),
    "cable.spring": (0.02, 300, "hardening spring"),
    "cable.friction": (1e-3, 2, "algebraic smoothing, 12 % weaker on the way up"),
    "cable.viscous": (1e-3, 60, "power 0.9 of speed"),
    "structure.resonance": (3e-3, 0.9, "second mode at 1.7 times the frequency with a fifth of the share"),
    "robot.lag": (0.002, 1.5, "additional pole"),
    "robot.compliance": (1e-7, 2e-3, "hardening, power 0.9 of force"),
    "robot.backlash": (1e-6, 1e-3, "two play elements"),
    "robot.vibration": (1e-9, 5e-4, "second harmonic and slow modulation of amplitude"),
    "tissue.surface": (5e-6, 3e-3, "offset changes by 12 % over the recording"),
    "tissue.modulus": (5e-3, 0.6, "changed exponent of depth"),
    "tissue.viscoelastic": (2e-3, 1.2, "two time constants"),
    "tissue.preconditioning": (2e-3, 0.8, "power 1.6 instead of 2"),
    "tissue.adhesion": (2e-3, 2, "weaker at depth"),
    "tissue.thickness": (2, 400, "series of an unbonded layer"),
    "tissue.inclusion": (5e-3, 4, "power 3 instead of 2"),
    "tissue.plasticity": (1e-6, 6e-4, "set depends on the depth of the press"),
    "contact.lateral": (5e-4, 0.4, "power 1.1 of the contact force"),
}
"""By effect: smallest and largest size to try, in the unit of its leading parameter (`parameters`), and how the other law differs."""
OUTSIDE = {
    "rack": (1e-3, 2), "breathing": (1e-6, 2e-3), "speed_squared_share": (1e-3, 5), "stick_slip": (2e-3, 2), "step": (2e-3, 3),
    "turning_lateral": (2e-3, 3), "bent_drift": (2e-3, 3), "force_dead_time": (5e-4, 0.3), "knocks": (5e-3, 4), "pump": (5e-4, 2),
    "twist": (1e-5, 0.02), "gain_wander": (1e-3, 0.5), "puncture": (5e-3, 0.7),
}  # fmt: skip
"""Smallest and largest size to try of what is in no list."""


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number that is uniform in its logarithm, in the unit of the limits."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def rounded(number: float, digits: int = 3) -> float:
    """A number with this many significant digits, as a cell file states it; the unit stays."""
    return float(f"{number:.{digits}g}")


class ListedEffect:
    """An effect of the library: what is drawn of it before its size. Each effect uses a part of it.

    Attributes:
        other_law: Whether it acts by another law than the contract's.
        mix: Crosstalk per unit of size: fx, fy, tx, ty; shape (4,).
        width: Of a hysteresis, as a share of the largest force.
        at: Force where an asymmetry begins, as a share of the largest.
        side: 1 for forces above `at`, -1 below.
        presliding_m: None for a friction without presliding.
        damping_growth: Of a lag, per unit of size.
        depth: Of an inclusion, as a share of the deepest press.
        ratio: Plastic set of a press by that of the press before it.
        power: Exponent of time of a drift by the other law.
        times_s: Where a dropout may begin, shape (380,).
        keep: Uniform numbers that decide which dropouts occur, shape (380,).
        lengths: Of the dropouts by the other law, in units of `length_s`, shape (380,).
        size: In the unit of the leading parameter (`parameters`).
    """

    size, snr = 0.0, 0.0

    def __init__(self, rng: np.random.Generator, effect: str, other_law: bool) -> None:
        u = rng.uniform
        self.other_law = bool(other_law and LISTED[effect][2])
        self.azimuth_rad, self.times_s = u(0, 2 * np.pi), np.sort(u(0, 95, 380))
        self.sign, self.phase_rad = float(rng.choice([-1, 1])), u(0, 2 * np.pi)
        constants_s = {
            "sensor.warmup": u(5, 30),
            "sensor.creep": log_uniform(rng, 1.5, 12),
            "tissue.viscoelastic": log_uniform(rng, 0.15, 4),
        }
        self.time_constant_s = constants_s.get(effect, 1.0)
        self.mix = np.array([np.cos(self.azimuth_rad), np.sin(self.azimuth_rad), 0.05 * u(-0.7, 0.7), 0.05 * u(-0.7, 0.7)])
        self.width, self.at, self.side = u(0.08, 0.3), u(0.2, 0.5), int(rng.choice([-1, 1]))
        self.presliding_m = log_uniform(rng, 1e-4, 1e-3) if rng.random() < 0.4 else None
        self.frequency_Hz = log_uniform(rng, *((3, 15) if effect == "robot.vibration" else (7, 30)))
        self.damping_ratio, self.damping_growth = log_uniform(rng, 0.02, 0.1), float(rng.choice([0, 0.5]))
        self.range_m, self.depth, self.ratio = log_uniform(rng, 5e-4, 3e-3), u(0.5, 1.3), u(0.45, 0.9)
        self.power, self.length_s = float(rng.choice([0.75, 1.3])), log_uniform(rng, 0.024, 0.1)
        self.keep, self.lengths = u(0, 1, 380), rng.exponential(1, 380)

    @property
    def signed(self) -> float:
        """Size with its sign, in the unit of the size."""
        return self.sign * self.size


class OutsideEffect:
    """An effect that is in no list: what is drawn of it before its size. Each law uses a part of it.

    Attributes:
        at: Share of the recording, or of the deepest press.
        times: Of knocks, as shares of the recording; 4 to 11 values.
        size: In the unit of its own law.
    """

    size, snr = 0.0, 0.0

    def __init__(self, rng: np.random.Generator, law: str) -> None:
        u, self.law = rng.uniform, law
        self.pitch_m, self.phase_rad = {"stick_slip": u(0.004, 0.02)}.get(law, u(0.003, 0.014)), u(0, 2 * np.pi)
        self.frequency_Hz = {"breathing": u(0.18, 0.4), "knocks": u(3, 9)}.get(law, u(0.6, 3))
        self.at, self.turn_rad = u(0.35, 0.65), float(rng.choice([-1, 1]) * u(3.5, 6))
        self.times, self.period_s = np.sort(u(0.03, 0.97, rng.integers(4, 12))), u(9, 25)

    def truth(self) -> dict[str, Any]:
        """Its parameters, as the truth states them."""
        names = {"pitch": self.pitch_m, "phase": self.phase_rad, "f": self.frequency_Hz, "at": self.at, "turn": self.turn_rad}
        return names | {"times": self.times.tolist(), "period": self.period_s, "a": float(self.size)}


# --- filters and operators on arrays of the internal step, each of shape (n,) ----------------------------------------------------


def second_order(numerator: list[float], denominator: list[float], x: Floats) -> Floats:
    """Filter x with numerator(s) / denominator(s), exact for a piecewise linear x and started in equilibrium; shape (n,)."""
    b, a, _ = cont2discrete((numerator, denominator), STEP_S, method="foh")
    b = np.atleast_1d(np.squeeze(b))
    return lfilter(b, a, x, zi=lfilter_zi(b, a) * x[0])[0]


def pole(x: Floats, time_constant_s: float) -> Floats:
    """Filter x with one pole, started in equilibrium; shape (n,)."""
    e = np.exp(-STEP_S / time_constant_s)
    g = (1 - e) * time_constant_s / STEP_S
    b, a = np.array([1 - g, g - e]), np.array([1, -e])
    return lfilter(b, a, x, zi=[(1 - b[0]) * x[0]])[0]


def servo(target_m: Floats, frequency_Hz: float, damping_ratio: float) -> tuple[Floats, Floats, Floats]:
    """Height (m), speed (m/s) and acceleration (m/s²) of a second-order system; shapes (n,)."""
    w = 2 * np.pi * frequency_Hz
    z, v, acceleration = (second_order([w * w, *[0.0] * order], [1, 2 * damping_ratio * w, w * w], target_m) for order in range(3))
    return z, v, acceleration


def saturating(x: Floats, width: float) -> Floats:
    """The state w of dw = dx / width · (1 - w · sign(dx)), exact for each step; width in the unit of x, shape (n,)."""
    dx = np.diff(x)
    w, states = 0.0, [0.0]
    for e, s in zip(np.exp(-np.abs(dx) / width).tolist(), np.sign(dx).tolist(), strict=True):
        if s:
            w = s + (w - s) * e
        states.append(w)
    return np.array(states)


def play(x: Floats, width: float) -> Floats:
    """What a part with this play does behind x; width in the unit of x, shape (n,)."""
    y, heights, half = x[0], [], width / 2
    for value in x.tolist():
        y = min(max(y, value - half), value + half)
        heights.append(y)
    return np.array(heights)


# --- the motion that is commanded -------------------------------------------------------------------------------------------------


def profile(way_m: float, speed_m_per_s: float, acceleration_m_per_s2: float, kind: str) -> Floats:
    """Way from 0 to way_m on the internal step with this peak speed, shape (n,); kind is `trapezoid`, `quintic` or `cosine`."""
    if way_m <= 0:
        return np.zeros(0)
    if kind == "trapezoid":
        a = acceleration_m_per_s2
        v = min(speed_m_per_s, np.sqrt(way_m * a))
        ramp_s, total_s = v / a, v / a + way_m / v
        t = np.arange(STEP_S, total_s + STEP_S, STEP_S).clip(max=total_s)
        end = np.where(t < total_s - ramp_s, v * (t - ramp_s / 2), way_m - a * (total_s - t) ** 2 / 2)
        return np.where(t < ramp_s, a * t**2 / 2, end)
    total_s = way_m / speed_m_per_s * (1.875 if kind == "quintic" else np.pi / 2)
    x = np.arange(STEP_S, total_s + STEP_S, STEP_S).clip(max=total_s) / total_s
    return way_m * (x**3 * (10 - 15 * x + 6 * x * x) if kind == "quintic" else (1 - np.cos(np.pi * x)) / 2)


class CommandedMotion:
    """Free strokes, then 5 to 11 presses with holds, stairs or waves, in 30 s or more.

    Attributes:
        height_m: On the internal step, shape (n,).
        starts: First internal step of each press.
    """

    def __init__(self, rng: np.random.Generator, surface_z_m: float, depth_m: float) -> None:
        self._rng, self._kind, self._acceleration_m_per_s2 = rng, rng.choice(["trapezoid", "quintic", "cosine"]), rng.uniform(0.6, 3)
        hover_m, self._top_m = surface_z_m + rng.uniform(0.003, 0.008), surface_z_m + rng.uniform(0.012, 0.03)
        self._parts: list[Floats] = []
        self._z_m, self.starts = self._top_m, list[int]()
        self._rest(rng.uniform(1, 2.5))
        for _ in range(rng.integers(2, 4)):
            self._stroke()
        presses, pace = int(rng.integers(5, 12)), rng.uniform(0.6, 1.6)
        for press_depth_m in rng.permutation(depth_m * np.append(1, rng.uniform(0.35, 1, presses - 1))):
            self._press(hover_m, surface_z_m, press_depth_m, pace)
        self._go(self._top_m, 0.05)
        self._rest(rng.uniform(1, 3))
        if self._steps() * STEP_S < 30:
            self._parts.append(np.full(int((30.2 - self._steps() * STEP_S) / STEP_S), self._z_m))
        self.height_m = np.concatenate(self._parts)

    def _steps(self) -> int:
        return sum(map(len, self._parts))

    def _go(self, to_m: float, speed_m_per_s: float) -> None:
        way = profile(abs(to_m - self._z_m), speed_m_per_s, self._acceleration_m_per_s2, self._kind)
        self._parts.append(np.sign(to_m - self._z_m) * way + self._z_m)
        self._z_m = to_m

    def _rest(self, seconds: float) -> None:
        self._parts.append(np.full(round(seconds / STEP_S), self._z_m))

    def _stroke(self) -> None:
        self._go(self._top_m + self._rng.uniform(0.015, 0.06), log_uniform(self._rng, 0.03, 0.2))
        self._rest(self._rng.uniform(0.1, 0.8))
        self._go(self._top_m, log_uniform(self._rng, 0.03, 0.2))
        self._rest(self._rng.uniform(0.2, 0.8))

    def _press(self, hover_m: float, surface_z_m: float, depth_m: float, pace: float) -> None:
        rng = self._rng
        self.starts.append(self._steps())
        self._go(hover_m, rng.uniform(0.02, 0.08))
        self._rest(rng.uniform(0.1, 0.6))
        speed_m_per_s, hold_s = log_uniform(rng, 0.004, 0.05), log_uniform(rng, 0.3, 3.5) * pace
        style = rng.choice(["plain", "stairs", "wave"], p=[0.65, 0.2, 0.15])
        if style == "stairs":
            self._go(surface_z_m - depth_m * rng.uniform(0.4, 0.7), speed_m_per_s)
            self._rest(hold_s * 0.5)
        self._go(surface_z_m - depth_m, speed_m_per_s)
        if style == "wave":
            period_s = round(1 / rng.uniform(0.4, 1.5) / STEP_S) * STEP_S
            t = np.arange(0, max(1, round(hold_s / period_s)) * period_s - STEP_S / 2, STEP_S)
            self._parts.append(self._z_m + 0.15 * depth_m * (1 - np.cos(2 * np.pi / period_s * t)))
        else:
            self._rest(hold_s)
        self._go(hover_m, log_uniform(rng, 0.006, 0.06))
        self._rest(rng.uniform(0.4, 1.5))
        if rng.random() < 0.35:
            self._go(self._top_m, 0.05)
            self._stroke()


class DrawnController:
    """The controller that the robot really has; half of them are of second order.

    Attributes:
        kind: `second order`, `held` (targets of a slower cycle), `third order` or `jerk limit`.
        log_held: Whether a held target is what the recording has as `z_cmd_m`.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self.kind = str(rng.choice(["held", "third order", "jerk limit"])) if rng.random() < 0.5 else "second order"
        self.frequency_Hz, self.damping_ratio = rounded(rng.uniform(5, 15)), rounded(rng.uniform(0.7, 1.2), 2)
        self.cycle_s, self.pole_Hz = float(rng.choice([0.002, 0.004, 0.008])), rounded(rng.uniform(40, 100))
        self.span_s, self.log_held = rounded(rng.uniform(0.008, 0.025), 2), bool(rng.random() < 0.5)

    def target(self, commanded_m: Floats) -> Floats:
        """What its second-order part follows, in m; shape (n,)."""
        if self.kind == "held":
            k = round(self.cycle_s / STEP_S)
            return np.repeat(commanded_m[::k], k)[: len(commanded_m)]
        if self.kind == "third order":
            return pole(commanded_m, 1 / (2 * np.pi * self.pole_Hz))
        if self.kind == "jerk limit":
            k = round(self.span_s / STEP_S)
            total = np.cumsum(np.concatenate([np.full(k, commanded_m[0]), commanded_m]))
            return (total[k:] - total[:-k]) / k
        return commanded_m

    def identified(self, rng: np.random.Generator) -> tuple[float, float]:
        """Natural frequency (Hz) and damping ratio, as a user fits a second-order system to free strokes."""
        if self.kind == "second order":
            return self.frequency_Hz, self.damping_ratio
        parts = [np.zeros(600)]
        for speed_m_per_s in rng.uniform(0.02, 0.15, 4):
            way = profile(0.04, speed_m_per_s, 2, "trapezoid")
            parts += [way, np.full(900, 0.04), 0.04 - way, np.zeros(900)]
        z = np.concatenate(parts)
        measured = servo(self.target(z), self.frequency_Hz, self.damping_ratio)[0]
        frequency_Hz, damping_ratio = least_squares(
            lambda q: (servo(z, q[0], q[1])[0] - measured)[::10] * 1e5,
            [self.frequency_Hz * 0.8, self.damping_ratio],
            diff_step=1e-4,
            bounds=([0.5, 0.1], [60, 5]),
        ).x
        return rounded(frequency_Hz), rounded(damping_ratio)


# --- the cell ---------------------------------------------------------------------------------------------------------------------


def draw_cell_file(rng: np.random.Generator, exact: bool) -> tuple[dict[str, Any], DrawnController, bool, float]:
    """Draw a cell file, its controller, whether steps of fz are coarse, and the depth of the deepest press in m."""
    coarse = bool(rng.random() < 0.5)
    noise_N, noise_Nm = rounded(log_uniform(rng, 0.01, 0.08)), rounded(log_uniform(rng, 3e-4, 2e-3))
    step_fz_N = noise_N * (rng.uniform(1, 8) if coarse else log_uniform(rng, 0.05, 0.9))
    step_fxy_N = noise_N * (rng.uniform(1, 8) if coarse and rng.random() < 0.5 else log_uniform(rng, 0.05, 0.9))
    while True:
        radius_m, modulus_Pa = rounded(log_uniform(rng, 0.002, 0.01)), rounded(log_uniform(rng, 1e4, 2e5))
        stiffness = 4 / 3 * modulus_Pa / 0.75 * np.sqrt(radius_m)
        depth_m = min((rng.uniform(1, 9) / stiffness) ** (2 / 3), max(1.2 * radius_m, 0.005))
        if stiffness * depth_m**1.5 > max(0.8, 12 * noise_N, 6 * step_fz_N) and depth_m > 8e-4:
            break
    controller = DrawnController(rng)
    if exact:
        controller.kind = "second order"
    frequency_Hz, damping_ratio = controller.identified(rng)
    tolerances = {"bias_N": 0.02, "drift_N_per_min": 0.01, "gain": 0.005, "latency_s": 0.001, "filter_cutoff": 0.05, "crosstalk": 0.003}
    tolerances |= {"mass_kg": 0.003, "youngs_modulus": 0.02, "surface_z_m": 3e-5, "servo_natural_frequency": 0.02}
    repeatability = {"surface_z_m": 2e-5, "stiffness": 0.01}
    if rng.random() < 0.5:
        tolerances = {k: rounded(v * log_uniform(rng, 0.6, 1.7), 2) for k, v in tolerances.items()}
        repeatability = {k: rounded(v * log_uniform(rng, 0.6, 1.7), 2) for k, v in repeatability.items()}
    if rng.random() < 0.2:
        tolerances["youngs_modulus"] = 1.0
    rate_Hz = int(rng.choice([125, 250, 500, 1000]))
    cutoff_Hz = None if rng.random() < 0.25 else rounded(log_uniform(rng, *((20, 150) if rate_Hz < 500 else (40, 200))))
    surface_z_m = rounded(rng.uniform(-0.02, 0.05)) if rng.random() < 0.7 else 0.0
    cell_file = {
        "probe": {"mass_kg": rounded(rng.uniform(0.1, 0.5)), "tip_radius_m": radius_m, "tip_length_m": rounded(rng.uniform(0.04, 0.12))},
        "sensor": {"rate_Hz": rate_Hz, "filter_cutoff_Hz": cutoff_Hz, "noise_rms_N": noise_N, "noise_rms_Nm": noise_Nm,
                   "resolution_fxy_N": rounded(step_fxy_N), "resolution_fz_N": rounded(step_fz_N),
                   "resolution_Nm": rounded(noise_Nm * log_uniform(rng, 0.1, 1.2))},
        "robot": {"servo_natural_frequency_Hz": frequency_Hz, "servo_damping_ratio": damping_ratio,
                  "position_noise_rms_m": rounded(log_uniform(rng, 2e-6, 1e-5)),
                  "velocity_noise_rms_m_per_s": rounded(log_uniform(rng, 1e-4, 4e-4))},
        "tissue": {"surface_z_m": surface_z_m, "youngs_modulus_Pa": modulus_Pa, "poisson_ratio": 0.5},
        "tolerances": tolerances, "repeatability": repeatability, "effects": {},
    }  # fmt: skip
    return cell_file, controller, coarse, depth_m


class ForeignCell:
    """A cell file, the real cell behind it, and a motion. Arrays of shape (n,) are on the internal step.

    Args:
        rng: What all is drawn with.
        exact: Whether the cell is exactly on its file: controller, tolerances, scatter of presses and noise level.

    Attributes:
        file: Content of the cell file.
        depth_m: Depth of the deepest press.
        with_command: Whether the recording has `z_cmd_m`.
        t_s: Shape (n,).
        samples: Which internal steps are samples of the sensor.
        sampled_s: Shape (rows,).
        press: Number of the press that a step belongs to, shape (n,).
        deviations: The real cell's.
        noise: Standard deviation of the real noise by axis in N or Nm, shape (6,).
        step: Of the readings by axis in N or Nm, shape (6,).
        tare: Where the lattice of readings lies, in N or Nm; shape (6,).
        largest_N: Largest force without effects.
    """

    def __init__(self, rng: np.random.Generator, exact: bool = False) -> None:
        self.file, self.controller, self.coarse, self.depth_m = draw_cell_file(rng, exact)
        self._surface_z_m, sensor = self.file["tissue"]["surface_z_m"], self.file["sensor"]
        self.with_command = bool(rng.random() > 1 / 6)
        while len((motion := CommandedMotion(rng, self._surface_z_m, self.depth_m)).height_m) * STEP_S >= 90:
            pass
        self.commanded_m, self.presses = motion.height_m, len(motion.starts)
        n = len(self.commanded_m)
        self.t_s, self.samples = np.arange(n) * STEP_S, slice(None, None, round(1 / sensor["rate_Hz"] / STEP_S))
        self.sampled_s, self._end_s = self.t_s[self.samples], self.t_s[-1]
        self.press = (np.searchsorted([*motion.starts, n + 1], np.arange(n), side="right") - 1).clip(0)
        self._runs = [np.flatnonzero(self.press == k) for k in range(self.presses)]
        self.deviations = self._draw_deviations(rng, exact)
        self.noise = np.array([sensor["noise_rms_N"]] * 3 + [sensor["noise_rms_Nm"]] * 3)
        if not exact:
            self.noise *= np.repeat(rng.uniform(0.9, 1.1, 2), 3)
        self.step = np.array([sensor["resolution_fxy_N"]] * 2 + [sensor["resolution_fz_N"]] + [sensor["resolution_Nm"]] * 3)
        self._sigma = np.sqrt(self.noise**2 + self.step**2 / 12)
        self.tare = rng.uniform(-0.5, 0.5, 6) * self.step
        self._target_m = self.controller.target(self.commanded_m)
        self._bin = np.floor(self.sampled_s / BIN_S + 1e-9).astype(int)
        self.bins = int(self._bin[-1])
        self.largest_N = 0.0  # no law without effects reads it
        self._base = self._residual(self.deviations, {})
        self.largest_N = float(self.simulate(self.deviations, {})[1][2].max())
        self._prepare_projection()

    def _draw_deviations(self, rng: np.random.Generator, exact: bool) -> Deviations:
        normal: Callable[[int], Floats] = np.zeros if exact else rng.standard_normal
        tolerances, repeatability = self.file["tolerances"], self.file["repeatability"]
        deviations = {k: float(normal(1)[0]) * tolerances[k] for k in tolerances if k != "crosstalk"}
        deviations |= {"crosstalk": normal(4) * tolerances["crosstalk"]}
        if tolerances["youngs_modulus"] == 1.0 and not exact:
            deviations["youngs_modulus"] = float(np.exp(rng.normal(0, 0.35)).clip(0.45, 2.2)) - 1
        deviations["press_surface"] = normal(self.presses) * repeatability["surface_z_m"]
        deviations["press_stiffness"] = normal(self.presses) * repeatability["stiffness"]
        return deviations

    # --- physics: robot, tissue, forces at the sensor, sensor

    def _motion(self, deviations: Deviations, acting: Acting) -> tuple[Floats, Floats, Floats]:
        """Height in m, speed in m/s, acceleration in m/s²."""
        frequency_Hz, damping_ratio, target_m = self.controller.frequency_Hz, self.controller.damping_ratio, self._target_m
        frequency_Hz = frequency_Hz * (1 + deviations["servo_natural_frequency"])
        if e := acting.get("robot.lag"):
            frequency_Hz, damping_ratio = frequency_Hz / (1 + e.size), damping_ratio * (1 + e.damping_growth * e.size)
            target_m = pole(target_m, 0.003 * e.size) if e.other_law else target_m
        z, v, acceleration = servo(target_m, frequency_Hz, damping_ratio)
        if e := acting.get("robot.vibration"):
            w, t = 2 * np.pi * e.frequency_Hz, self.t_s
            for h, share in ((1, 1.0), (2, 0.12)) if e.other_law else ((1, 1.0),):
                amplitude_m = e.size * share * (1 + 0.15 * np.sin(2 * np.pi * t / 17) * e.other_law)
                z = z + amplitude_m * np.sin(h * w * t + e.phase_rad)
                v = v + amplitude_m * h * w * np.cos(h * w * t + e.phase_rad)
                acceleration = acceleration - amplitude_m * (h * w) ** 2 * np.sin(h * w * t + e.phase_rad)
        return z, v, acceleration

    def _elastic_N(self, depth_m: Floats, modulus_Pa: float) -> Floats:
        return 4 / 3 * modulus_Pa / 0.75 * np.sqrt(self.file["probe"]["tip_radius_m"]) * depth_m * np.sqrt(depth_m)

    def _nominal_fz_N(self, z: Floats, acceleration: Floats) -> Floats:
        force = self._elastic_N(np.maximum(0, self._surface_z_m - z), self.file["tissue"]["youngs_modulus_Pa"])
        force = force - self.file["probe"]["mass_kg"] * acceleration
        cutoff_Hz = self.file["sensor"]["filter_cutoff_Hz"]
        return pole(force, 1 / (2 * np.pi * cutoff_Hz)) if cutoff_Hz else force

    def _surface_m(self, deviations: Deviations, acting: Acting) -> Floats:
        surface = self._surface_z_m + deviations["surface_z_m"] + deviations["press_surface"][self.press]
        if e := acting.get("tissue.surface"):
            surface = surface + e.signed * (1 + 0.12 * e.other_law * (self.t_s / self._end_s - 0.5))
        if e := acting.get("tissue.plasticity"):
            sets = e.size * e.ratio ** np.arange(self.presses)
            if e.other_law:
                reached_m = np.array([max(0, self._surface_z_m - self.commanded_m[run].min()) for run in self._runs])
                sets = sets * (reached_m / self.depth_m) ** 0.6
            surface = surface - np.append(0, np.cumsum(sets))[self.press]
        if e := acting.get("outside.breathing"):
            surface = surface + e.size * np.sin(np.pi * e.frequency_Hz * self.t_s + e.phase_rad) ** 2
        return surface

    def _stiffened_N(self, f: Floats, d: Floats, acting: Acting) -> Floats:
        """The elastic force f at depth d (m) by all that changes it; d and f have shape (n,)."""
        if e := acting.get("tissue.modulus"):
            f = f * (1 + e.signed * ((d / self.depth_m) ** 0.2 if e.other_law else 1))
        if e := acting.get("tissue.thickness"):
            x = np.sqrt(self.file["probe"]["tip_radius_m"] * d) * e.size
            c = (0.884, 0.781, 0.386, 0.0048) if e.other_law else (1.133, 1.283, 0.769, 0.0975)
            f = f * (1 + x * (c[0] + x * (c[1] + x * (c[2] + x * c[3]))))
        if e := acting.get("tissue.inclusion"):
            x = (d / (e.depth * self.depth_m)) ** (3 if e.other_law else 2)
            f = f * (1 + e.size * x / (1 + x))
        if e := acting.get("tissue.preconditioning"):
            x = d / np.maximum(np.maximum.accumulate(d), 1e-12)
            f = np.where(d > 0, f * (1 - e.size * (1 - x ** (1.6 if e.other_law else 2))), 0)
        return f

    def _contact_N(self, deviations: Deviations, acting: Acting, tip: Floats, v: Floats) -> tuple[Floats, Floats]:
        """Force of the tissue, and depth in m."""
        surface = self._surface_m(deviations, acting)
        d = np.maximum(0, surface - tip)
        f = self._elastic_N(d, self.file["tissue"]["youngs_modulus_Pa"] * (1 + deviations["youngs_modulus"]))
        f = self._stiffened_N(f * (1 + deviations["press_stiffness"][self.press]), d, acting)
        if e := acting.get("outside.speed_squared_share"):
            f = f * (1 + e.size * np.minimum((v / 0.02) ** 2, 9))
        if e := acting.get("outside.puncture"):
            for run in self._runs:
                f[run] *= 1 - e.size * (np.maximum.accumulate(d[run]) > e.at * self.depth_m)
        if e := acting.get("tissue.viscoelastic"):
            parts = ((0.7, 0.6), (0.3, 3.0)) if e.other_law else ((1.0, 1.0),)
            f = f + e.size * sum(share * (f - pole(f, e.time_constant_s * m)) for share, m in parts)
            f = np.where(d > 0, np.maximum(f, 0), 0)  # the surface does not pull
        if e := acting.get("tissue.adhesion"):
            lowest = np.concatenate([np.minimum.accumulate(tip[run]) for run in self._runs])
            pulled = np.where(lowest < surface, ((tip - lowest) / e.range_m).clip(0, 1), 0) * (1 - (tip - surface) / e.range_m).clip(0, 1)
            f = f - e.size * pulled * (np.exp(-d / (3 * e.range_m)) if e.other_law else 1)
        return f, d

    def _pressed_N(self, deviations: Deviations, acting: Acting, z: Floats, v: Floats) -> tuple[Floats, Floats]:
        """Force of the tissue, and depth in m, where the tip may be elsewhere than the robot reports."""
        if e := acting.get("robot.backlash"):
            z = 0.6 * play(z, 0.7 * e.size) + 0.4 * play(z, 1.45 * e.size) if e.other_law else play(z, e.size)
        f, d = self._contact_N(deviations, acting, z, v)
        if e := acting.get("robot.compliance"):
            previous = 0.0
            for _ in range(40):
                give = e.size * np.sign(f) * np.abs(f) ** (0.9 if e.other_law else 1.0)
                if np.max(np.abs(give - previous)) < 1e-10:
                    break
                previous = give
                f, d = self._contact_N(deviations, acting, z + give, v)
        return f, d

    def _inertia_N(self, deviations: Deviations, acting: Acting, acceleration: Floats) -> Floats:
        mass_kg = self.file["probe"]["mass_kg"] + deviations["mass_kg"]
        inertia = -mass_kg * acceleration
        if e := acting.get("structure.resonance"):
            ring = 0.0
            for share, factor in ((0.8, 1.0), (0.2, 1.7)) if e.other_law else ((1.0, 1.0),):
                w = 2 * np.pi * e.frequency_Hz * factor
                ring = ring + share * second_order([w * w], [1, 2 * e.damping_ratio * w, w * w], acceleration)
            inertia = -mass_kg * ((1 - e.size) * acceleration + e.size * ring)
        if e := acting.get("probe.mass"):
            inertia = inertia - e.signed * (pole(acceleration, 1 / (80 * np.pi)) if e.other_law else acceleration)
        return inertia

    def _cable_N(self, acting: Acting, z: Floats, v: Floats) -> Floats:
        cable = np.zeros_like(z)
        if e := acting.get("cable.spring"):
            x = z - z[0]
            cable = cable - e.size * x * (1 + 0.25 * np.abs(x) / np.abs(x).max() * e.other_law)
        if e := acting.get("cable.friction"):
            if e.presliding_m:
                g = saturating(z, e.presliding_m)
            else:
                g = v / np.sqrt(v * v + 0.0006**2) if e.other_law else np.tanh(v / 0.0005)
            cable = cable - e.size * g * (1 - 0.12 * e.other_law * (g > 0))
        if e := acting.get("cable.viscous"):
            cable = cable - e.size * (np.sign(v) * np.abs(v) ** 0.9 * 0.03**0.1 if e.other_law else v)
        if e := acting.get("outside.rack"):
            cable = cable + e.size * np.sin(2 * np.pi * z / e.pitch_m + e.phase_rad)
        if e := acting.get("outside.stick_slip"):
            way = np.concatenate([[0], np.cumsum(np.abs(np.diff(z)))])
            cable = cable - e.size * (way / e.pitch_m % 1) * np.tanh(pole(v, 0.02) / 0.0005)
        return cable

    def _at_sensor(self, acting: Acting, f: Floats, d: Floats, v: Floats, axial: Floats) -> Floats:
        """Wrench of contact force f and axial force (N) at depth d (m) and speed v (m/s), each (n,); shape (6, n)."""
        length_m, t, w = self.file["probe"]["tip_length_m"], self.t_s, np.zeros((6, len(f)))
        w[2] = axial
        if e := acting.get("probe.tilt"):
            angle = e.size * (1 + 0.15 * e.other_law * f / max(f.max(), 1e-9))
            cx, cy, sine = np.cos(e.azimuth_rad), np.sin(e.azimuth_rad), np.sin(angle)
            w[0], w[1], w[2] = sine * cx * axial, sine * cy * axial, np.cos(angle) * axial
            w[3], w[4] = sine * cy * f * length_m, -(sine * cx * f * length_m)
        lateral: tuple[Floats, Floats] | None = None
        if e := acting.get("contact.lateral"):
            g = e.size * (np.sign(f) * np.abs(f) ** 1.1 / self.largest_N**0.1 if e.other_law else f)
            lateral = g * np.cos(e.azimuth_rad), g * np.sin(e.azimuth_rad)
        if e := acting.get("outside.turning_lateral"):
            x = d / self.depth_m
            angle = e.phase_rad + e.turn_rad * x
            lateral = e.size * x**2 * np.cos(angle), e.size * x**2 * np.sin(angle)
        if lateral:
            w[0], w[1], w[3], w[4] = w[0] + lateral[0], w[1] + lateral[1], w[3] + lateral[1] * length_m, w[4] - lateral[0] * length_m
        if e := acting.get("outside.twist"):
            w[5] = w[5] + e.size * f * np.tanh(pole(v, 0.05) / 0.002)
        if e := acting.get("outside.knocks"):
            for begin_s in e.times * self._end_s:
                u = np.maximum(0, t - begin_s)
                w[2] = w[2] + e.size * np.exp(-u / 0.15) * np.sin(2 * np.pi * e.frequency_Hz * u)
        if e := acting.get("outside.pump"):
            w[2] = w[2] + e.size * (np.sin(2 * np.pi * e.frequency_Hz * t) + 0.4 * np.sin(4 * np.pi * e.frequency_Hz * t + 1))
        return w

    def _filtered(self, deviations: Deviations, acting: Acting, w: Floats) -> Floats:
        """Wrench w (6, n) behind the low-pass; shape (6, n)."""
        if not (cutoff_Hz := self.file["sensor"]["filter_cutoff_Hz"]):
            return w
        tau_s = 1 / (2 * np.pi * cutoff_Hz * (1 + deviations["filter_cutoff"]))
        e = acting.get("sensor.filter")
        tau_s = tau_s * (1 + e.size) if e else tau_s
        twice = e is not None and e.other_law
        return np.array([(pole(pole(x, tau_s / 2), tau_s / 2) if twice else pole(x, tau_s)) if x.any() else x for x in w])

    def _read_fz_N(self, deviations: Deviations, acting: Acting, force: Floats) -> Floats:
        """What gain, hysteresis and creep make of fz."""
        fz, largest_N = force, self.largest_N
        if e := acting.get("sensor.gain"):
            fz = fz + e.signed * (np.abs(force / largest_N) ** 0.06 if e.other_law else 1) * force
        if e := acting.get("outside.gain_wander"):
            fz = fz + e.size * force * np.sin(2 * np.pi * self.t_s / e.period_s + e.phase_rad)
        if e := acting.get("sensor.asymmetry"):
            at, w = e.at * largest_N, 0.05 * largest_N * e.other_law + 1e-9
            knee = w * np.log1p(np.exp(((force - at) / w).clip(-40, 40)))
            above = np.where(np.abs(force - at) < 40 * w, knee, np.maximum(0, force - at))
            fz = fz + e.signed * (above if e.side == 1 else force - above)
        if e := acting.get("sensor.hysteresis"):
            w = e.width * largest_N
            loop = 0.6 * saturating(force, 0.6 * w) + 0.4 * saturating(force, 1.8 * w) if e.other_law else saturating(force, w)
            fz = fz + e.size * loop
        if e := acting.get("sensor.creep"):
            tau_s = e.time_constant_s
            fz = fz + e.size * (0.65 * pole(force, 0.6 * tau_s) + 0.35 * pole(force, 3 * tau_s) if e.other_law else pole(force, tau_s))
        return fz * (1 + deviations["gain"]) + deviations["bias_N"] + deviations["drift_N_per_min"] * self.t_s / 60

    def _offset_fz_N(self, acting: Acting, fz: Floats) -> Floats:
        """The reading with what time adds to it, within the range of the sensor."""
        t, end_s = self.t_s, self._end_s
        if e := acting.get("sensor.bias"):
            fz = fz + e.signed * (1 + 0.1 * e.other_law * (t / end_s - 0.5))
        if e := acting.get("sensor.drift"):
            fz = fz + e.signed * (end_s * (t / end_s) ** e.power if e.other_law else t)
        if e := acting.get("sensor.warmup"):
            parts = ((0.7, 0.6), (0.3, 2.5)) if e.other_law else ((1.0, 1.0),)
            fz = fz + e.signed * sum(share * (1 - np.exp(-t / (m * e.time_constant_s))) for share, m in parts)
        if e := acting.get("outside.step"):
            fz = fz + e.size * (t > e.at * end_s)
        if e := acting.get("outside.bent_drift"):
            turn_s = e.at * end_s
            fz = fz + e.size * np.where(t < turn_s, t / turn_s, (1 - 2.2 * (t - turn_s) / (end_s - turn_s)))
        if e := acting.get("sensor.saturation"):
            limit_N = self.largest_N * (1 - e.size)
            if not e.other_law:
                return np.minimum(fz, limit_N)
            knee_N = 0.04 * limit_N
            fz = limit_N - knee_N * np.logaddexp(0, (limit_N - fz) / knee_N)
            fz = fz + (knee_N * np.logaddexp(0, 1 / 0.04) - limit_N)  # zero stays zero
        return fz

    def _sampled(self, deviations: Deviations, acting: Acting, w: Floats) -> Floats:
        """Wrench w (6, n) at the times that latency and clock make of the sensor's; shape (6, rows)."""
        ts = self.sampled_s
        read_s = ts - deviations["latency_s"]
        if e := acting.get("clock.skew"):
            read_s = read_s + e.signed * (ts + 0.1 * e.other_law * 9 * np.sin(ts / 9))
        if e := acting.get("sensor.latency"):
            read_s = read_s - e.size * (1 + 0.15 * e.other_law * np.sin(2 * np.pi * ts / 23))
        if e := acting.get("outside.force_dead_time"):
            read_s = read_s - e.size * np.abs(w[2, self.samples] / self.largest_N)
        if not np.any(read_s - ts):
            return w[:, self.samples]
        return np.array([np.interp(read_s, self.t_s, x) for x in w])

    def _shown_rows(self, dropout: ListedEffect) -> NDArray[np.int64]:
        """For each row the row whose wrench it shows, shape (rows,)."""
        n, rate_Hz = len(self.sampled_s), self.file["sensor"]["rate_Hz"]
        rows = np.arange(n)
        for begin_s, keep, length in zip(dropout.times_s, dropout.keep, dropout.lengths, strict=True):
            if keep < dropout.size / 4 and begin_s < self.sampled_s[-1]:
                i = int(begin_s * rate_Hz)
                held = max(1, round(dropout.length_s * (length if dropout.other_law else 1) * rate_Hz))
                rows[i : min(n, i + 1 + held)] = rows[i]
        return rows

    def simulate(self, deviations: Deviations, acting: Acting) -> tuple[tuple[Floats, Floats, Floats], Floats]:
        """Height, speed and acceleration on the internal step (n,), and the wrench without noise at the samples (6, rows)."""
        z, v, acceleration = self._motion(deviations, acting)
        f, d = self._pressed_N(deviations, acting, z, v)
        axial = f + self._inertia_N(deviations, acting, acceleration) + self._cable_N(acting, z, v)
        w = self._filtered(deviations, acting, self._at_sensor(acting, f, d, v, axial))
        w[2] = fz = self._offset_fz_N(acting, self._read_fz_N(deviations, acting, w[2]))
        w[[0, 1, 3, 4]] += (deviations["crosstalk"] * [1, 1, 0.05, 0.05])[:, None] * fz
        if e := acting.get("sensor.crosstalk"):
            leak = fz * np.abs(fz / self.largest_N) ** 0.1 if e.other_law else fz
            w[[0, 1, 3, 4]] += (e.mix * e.size)[:, None] * leak
        w = self._sampled(deviations, acting, w)
        if e := acting.get("sensor.dropout"):
            w = w[:, self._shown_rows(e)]
        return (z, v, acceleration), w

    # --- SNR

    def _means(self, x: Floats, sigma: float) -> Floats:
        """Means of x (rows,) over bins in standard deviations of such a mean, shape (bins,); sigma in the unit of x."""
        n = np.bincount(self._bin)
        return np.bincount(self._bin, x) / np.maximum(n, 1) * np.sqrt(n) / sigma

    def _residual(self, deviations: Deviations, acting: Acting) -> Floats:
        """Measured minus nominal without noise; shape (7, bins), or (6, bins) without `z_cmd_m`."""
        (z, _, acceleration), w = self.simulate(deviations, acting)
        w = w.copy()
        w[2] -= self._nominal_fz_N(z, acceleration)[self.samples]
        rows = [self._means(x, sigma) for x, sigma in zip(w, self._sigma, strict=True)]
        if self.with_command:
            rows.append(self._means(z[self.samples] - z[0], self.file["robot"]["position_noise_rms_m"]))
        return np.array(rows)

    def _prepare_projection(self) -> None:
        first_rows = np.searchsorted(self._bin, np.arange(self.bins + 1))
        press_of_bin, columns = self.press[self.samples][first_rows], []

        def column(name: str, deviation: float, direction: Floats | float = 1.0) -> Floats:
            h = min(deviation, 0.05) if deviation == 1.0 else deviation
            return (self._residual(self.deviations | {name: self.deviations[name] + h * direction}, {}) - self._base) * (deviation / h)

        for name, deviation in self.file["tolerances"].items():
            columns += [column(name, deviation, unit) for unit in np.eye(4)] if name == "crosstalk" else [column(name, deviation)]
        for name, key in (("press_surface", "surface_z_m"), ("press_stiffness", "stiffness")):
            all_presses = column(name, self.file["repeatability"][key])
            columns += [all_presses * (press_of_bin == i) for i in range(self.presses)]
        self._columns = np.array([c.ravel() for c in columns])
        self._inverse = np.linalg.inv(np.eye(len(columns)) + self._columns @ self._columns.T)

    def logged_m(self) -> Floats:
        """What the recording has as `z_cmd_m`, on the internal step; shape (n,)."""
        return self._target_m if self.controller.kind == "held" and self.controller.log_held else self.commanded_m

    def controller_misfit(self) -> dict[str, float]:
        """What the second-order system of the cell file misses of `z_m`: SNR, and the largest in m."""
        robot = self.file["robot"]
        nominal = servo(self.logged_m(), robot["servo_natural_frequency_Hz"], robot["servo_damping_ratio"])[0]
        missed, rows = self._motion(self.deviations, {})[0] - nominal, np.zeros_like(self._base)
        if self.with_command:
            rows[6] = self._means(missed[self.samples], robot["position_noise_rms_m"])
        d = rows.ravel()
        return {"snr": round(float(np.sqrt(max(0, d @ self.projected(d)))), 1), "largest_m": rounded(np.abs(missed).max(), 2)}

    def projected(self, change: Floats) -> Floats:
        """A change without what tolerances and press scatter can explain; shape (channels · bins,)."""
        return change - self._columns.T @ (self._inverse @ (self._columns @ change))

    def change(self, acting: Acting) -> Floats:
        """What effects change, in standard deviations; shape (channels · bins,)."""
        return (self._residual(self.deviations, acting) - self._base).ravel()

    def snr(self, acting: Acting) -> float:
        """SNR of effects together, in standard deviations."""
        d = self.change(acting)
        return float(np.sqrt(max(0.0, d @ self.projected(d))))

    def scatter_snr(self, effect: str, size: float) -> float:
        """Growth of the variance in bins beyond noise 20 % over the stated, in its standard deviations; size as in `parameters`."""
        sensor = self.file["sensor"]
        stated = np.array([sensor["noise_rms_N"]] * 3 + [sensor["noise_rms_Nm"]] * 3)
        noise, step = self.noise * (size if effect == "sensor.noise" else 1), self.step.copy()
        step[2] = size if effect == "sensor.quantization" else step[2]
        d = np.log((noise**2 + step**2 / 12) / ((1.2 * stated) ** 2 + self.step**2 / 12)).clip(0)
        return float(np.sqrt(self.bins / 2 * np.sum(d**2)))

    def record(self, rng: np.random.Generator, acting: Acting, path: Path) -> None:
        """Write a recording, with noise and rounding."""
        (z, v, _), w = self.simulate(self.deviations, {k: e for k, e in acting.items() if k != "sensor.dropout"})
        n, step, robot = len(self.sampled_s), self.step.copy(), self.file["robot"]
        white = rng.standard_normal((6, n))
        if e := acting.get("sensor.noise"):
            white = (rng.standard_t(6, (6, n)) / np.sqrt(1.5) if e.other_law else white) * e.size
        if e := acting.get("sensor.quantization"):
            step[2] = e.size
        tare = (self.tare / self.step * step)[:, None]
        w = np.round((w + self.noise[:, None] * white - tare) / step[:, None]) * step[:, None] + tare
        if e := acting.get("sensor.dropout"):
            w = w[:, self._shown_rows(e)]
        z_m = z[self.samples] + rng.normal(0, robot["position_noise_rms_m"], n)
        v_m_per_s = v[self.samples] + rng.normal(0, robot["velocity_noise_rms_m_per_s"], n)
        commanded = [self.logged_m()[self.samples]] if self.with_command else []
        head = ",".join(["t_s", *["z_cmd_m"] * self.with_command, "z_m", "vz_m_per_s", *AXES])
        formats = ["%.4f"] + ["%.8f"] * (1 + self.with_command) + ["%.6f"] * 4 + ["%.7f"] * 3
        np.savetxt(path, np.array([self.sampled_s, *commanded, z_m, v_m_per_s, *w]).T, formats, ",", header=head, comments="")


# --- cases ------------------------------------------------------------------------------------------------------------------------


def parameters(cell: ForeignCell, effect: str, e: ListedEffect) -> dict[str, float | None]:
    """The parameters of the library for an effect of this size; None as in the library."""
    size, signed, largest_N = e.size, e.signed, cell.largest_N
    mix = dict(zip(("fx_per_fz", "fy_per_fz", "tx_per_fz_m", "ty_per_fz_m"), size * e.mix, strict=True))
    lag_damping = cell.controller.damping_ratio * (1 + e.damping_growth * size) if e.damping_growth else None
    by_effect: dict[str, dict[str, float | None]] = {
        "sensor.bias": {"offset_N": signed}, "sensor.drift": {"rate_N_per_s": signed}, "sensor.gain": {"error": signed},
        "sensor.warmup": {"amplitude_N": signed, "tau_s": e.time_constant_s}, "sensor.noise": {"ratio": size},
        "sensor.quantization": {"step_N": size}, "sensor.crosstalk": mix,
        "sensor.filter": {"cutoff_Hz": (cell.file["sensor"]["filter_cutoff_Hz"] or 0) / (1 + size)}, "sensor.latency": {"delay_s": size},
        "sensor.hysteresis": {"width_N": e.width * largest_N, "amplitude_N": size},
        "sensor.creep": {"ratio": size, "tau_s": e.time_constant_s}, "sensor.saturation": {"limit_N": largest_N * (1 - size)},
        "sensor.dropout": {"rate_Hz": size, "length_s": e.length_s},
        "sensor.asymmetry": {"ratio": signed, "at_N": e.at * largest_N, "side": e.side}, "clock.skew": {"ratio": signed},
        "probe.mass": {"delta_kg": signed}, "probe.tilt": {"angle_rad": size, "azimuth_rad": e.azimuth_rad},
        "cable.spring": {"stiffness_N_per_m": size}, "cable.friction": {"force_N": size, "presliding_m": e.presliding_m},
        "cable.viscous": {"coefficient_N_s_per_m": size},
        "structure.resonance": {"frequency_Hz": e.frequency_Hz, "damping_ratio": e.damping_ratio, "participation": size},
        "robot.lag": {"bandwidth_ratio": 1 / (1 + size), "damping_ratio": lag_damping},
        "robot.compliance": {"stiffness_N_per_m": 1 / size}, "robot.backlash": {"width_m": size},
        "robot.vibration": {"amplitude_m": size, "frequency_Hz": e.frequency_Hz, "phase_rad": e.phase_rad},
        "tissue.surface": {"offset_m": signed}, "tissue.modulus": {"ratio": 1 + signed},
        "tissue.viscoelastic": {"ratio": size, "tau_s": e.time_constant_s}, "tissue.preconditioning": {"softening": size},
        "tissue.adhesion": {"force_N": size, "range_m": e.range_m}, "tissue.thickness": {"thickness_m": 1 / size},
        "tissue.inclusion": {"contrast": size, "depth_m": e.depth * cell.depth_m}, "tissue.plasticity": {"set_m": size, "ratio": e.ratio},
        "contact.lateral": {"ratio": size, "azimuth_rad": e.azimuth_rad},
    }  # fmt: skip
    return {k: v if v is None else float(v) for k, v in by_effect[effect].items()}


def possible(cell: ForeignCell, effect: str) -> bool:
    """Whether an effect can be seen in this cell at all."""
    if effect == "sensor.filter":
        return bool(cell.file["sensor"]["filter_cutoff_Hz"])
    if effect in ("robot.lag", "robot.vibration"):
        return cell.with_command
    return effect != "tissue.modulus" or cell.file["tolerances"]["youngs_modulus"] != 1.0


def fit_size(rng: np.random.Generator, cell: ForeignCell, effect: str, e: ListedEffect | OutsideEffect) -> bool:
    """Set size and SNR for a drawn SNR from 5 to 60; False where this cell cannot show it."""
    target = log_uniform(rng, 5, 60)
    if effect in ("sensor.noise", "sensor.quantization"):
        is_noise = effect == "sensor.noise"
        sizes = np.linspace(1.2, 6, 481) if is_noise else cell.step[2] * np.linspace(1.5, 60, 2000)
        snrs = np.array([cell.scatter_snr(effect, size) for size in sizes])
        i = int(np.argmin(np.abs(np.log(np.maximum(snrs, 1e-3) / target))))
        e.size, e.snr = rounded(sizes[i], 4), float(snrs[i])
        return LEAST_SNR <= e.snr <= LARGEST_SNR and bool(is_noise or 1.5 * cell.noise[2] < e.size < 0.4 * cell.largest_N)
    low, high = OUTSIDE[e.law] if isinstance(e, OutsideEffect) else LISTED[effect][:2]
    if effect == "probe.mass" and isinstance(e, ListedEffect) and e.sign < 0:
        high = 0.6 * cell.file["probe"]["mass_kg"]
    if effect == "robot.compliance":  # the fixed point must converge
        high = min(high, 0.35 / (1.5 * cell.largest_N / cell.depth_m))
    size = float(np.sqrt(low * high))
    for _ in range(22):
        e.size = size
        e.snr = cell.snr({effect: e})
        if abs(e.snr / target - 1) < 0.03:
            break
        low, high = (low, size) if e.snr > target else (size, high)
        guess = size * (target / max(e.snr, 1e-9))
        size = float(guess if low * 1.02 < guess < high / 1.02 else np.sqrt(low * high))
    return LEAST_SNR <= e.snr <= LARGEST_SNR


def nearest_listed(rng: np.random.Generator, cell: ForeignCell, change: Floats) -> tuple[str, float]:
    """The listed effect that explains the largest share of a change (channels · bins,), and that share."""
    projected, best = cell.projected(change), ("", 0.0)
    varied = ("sensor.warmup", "sensor.creep", "tissue.viscoelastic", "structure.resonance", "sensor.asymmetry")
    for effect, (low, high, _) in LISTED.items():
        if effect in SCATTER or not possible(cell, effect):
            continue
        for _ in range(2 if effect in varied else 1):
            e = ListedEffect(rng, effect, False)
            e.size = np.exp(np.mean(np.log((low, high))))
            if effect == "robot.compliance":
                e.size = 0.05 / (1.5 * cell.largest_N / cell.depth_m)
            c = cell.change({effect: e})
            share = (c @ projected) ** 2 / max(c @ cell.projected(c), 1e-12) / (change @ projected)
            best = max(best, (effect, float(share)), key=lambda candidate: candidate[1])
    return best


def similarity(cell: ForeignCell, acting: Acting) -> float | None:
    """Cosine between the changes of two effects, tolerances projected out; None where an effect changes no mean."""
    a, b = (cell.change({k: e}) for k, e in acting.items())
    projected_a, projected_b = cell.projected(a), cell.projected(b)
    return round(float(a @ projected_b / np.sqrt((a @ projected_a) * (b @ projected_b))), 3) if a @ a > 0 and b @ b > 0 else None


@dataclass(frozen=True)
class ForeignCase:
    """What a cell is drawn for.

    Attributes:
        kind: `healthy`, `single`, `pair` or `outside`.
        effects: Of the library; of a case outside, one law of `OUTSIDE`.
    """

    seed: int
    number: int
    kind: str
    effects: tuple[str, ...]

    @property
    def name(self) -> str:
        """Stem of its files."""
        return f"cell_{self.number:04d}"


def plan_cases(cells: int, seed: int) -> list[ForeignCase]:
    """30 % healthy cells, 40 % with one effect, 15 % with two and 15 % outside the list; each list is used evenly."""
    rng = np.random.default_rng([seed, 999_999])
    healthy, singles, pairs = round(0.3 * cells), round(0.4 * cells), round(0.15 * cells)

    def deck(names: list[str], n: int) -> list[str]:
        return [str(name) for _ in range(-(-n // len(names))) for name in rng.permutation(names)][:n]

    plan: list[tuple[str, ...]] = [("healthy",)] * healthy + [("single", effect) for effect in deck(list(LISTED), singles)]
    first, second = deck(list(LISTED), pairs), deck(list(LISTED), 4 * pairs + 34)
    for effect in first:
        other = next(name for name in second if name != effect and not (effect in SCATTER and name in SCATTER))
        second.remove(other)
        plan.append(("pair", effect, other))
    plan += [("outside", law) for law in deck(list(OUTSIDE), cells - healthy - singles - pairs)]
    return [ForeignCase(seed, number, plan[i][0], plan[i][1:]) for number, i in enumerate(rng.permutation(len(plan)))]


def draw_case(case: ForeignCase) -> tuple[np.random.Generator, ForeignCell, Acting, dict[str, Any]]:
    """Draw cells until the effects of a case can act in one.

    Returns:
        Generator, cell, effects, and what the truth says besides.

    Raises:
        RuntimeError: They acted in none of 60 cells.
    """
    rng = np.random.default_rng([case.seed, case.number])
    for tries in range(1, MOST_TRIES + 1):
        cell, acting, notes = ForeignCell(rng), Acting(), dict[str, Any](tries=tries)
        if not all(possible(cell, effect) for effect in case.effects):
            continue
        for effect in case.effects:
            outside = case.kind == "outside"
            e = OutsideEffect(rng, effect) if outside else ListedEffect(rng, effect, rng.random() < 0.5)
            acting[key := f"outside.{effect}" if outside else effect] = e
            if not fit_size(rng, cell, key, e):
                break
        else:
            if case.kind == "outside":
                notes["nearest_listed"], share = nearest_listed(rng, cell, cell.change(acting))
                notes["nearest_share_of_energy"] = round(share, 3)
                if share > 0.6:
                    continue
            if case.kind == "pair" and (cosine := similarity(cell, acting)) is not None:
                notes["cosine"] = cosine
                if abs(cosine) > 0.85:
                    continue
            return rng, cell, acting, notes
    raise RuntimeError(f"cell {case.number}: {case.kind} {', '.join(case.effects)} acted in none of {MOST_TRIES} cells")


def write_case(case: ForeignCase, folder: Path) -> None:
    """Draw a case and write its recording, its cell file and, last, its truth."""
    rng, cell, acting, notes = draw_case(case)
    stem = folder / case.name
    cell.record(rng, acting, stem.with_suffix(".csv"))
    stem.with_suffix(".yaml").write_text(yaml.safe_dump(cell.file, sort_keys=False), encoding="utf-8")
    listed = {k: e for k, e in acting.items() if isinstance(e, ListedEffect)}
    laws = {k: LISTED[k][2] if e.other_law else "law of the contract" for k, e in listed.items()}
    laws |= {e.law: "own law" for e in acting.values() if isinstance(e, OutsideEffect)}
    words = [f"controller: {cell.controller.kind}"]
    for name, law in laws.items():
        words += [f"{name}: {law}", *["snr is of the variance of 20 ms blocks"] * (name in SCATTER[:2])]
    truth = {
        "kind": case.kind,
        "effects": {k: parameters(cell, k, e) if k in listed else e.truth() for k, e in acting.items()},
        "snr": {k: round(e.snr, 2) for k, e in acting.items()},
        "note": "; ".join(words),
        "coarse": cell.coarse,
        "controller": cell.controller.kind,
        "controller_misfit": cell.controller_misfit(),
        "z_cmd": cell.with_command,
        "inexact": {k: e.other_law for k, e in listed.items()},
        **notes,
        "deviations": {k: v.tolist() if isinstance(v, np.ndarray) else float(v) for k, v in cell.deviations.items()},
    }
    stem.with_suffix(".truth.json").write_text(json.dumps(truth, indent=1), encoding="utf-8")
