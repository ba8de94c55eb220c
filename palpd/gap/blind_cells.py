"""Recordings of cells whose truth is known, for the blind check: drawn, simulated and sized without the library that is judged.

The physics is integrated anew, several times finer than the rows of the recording and by another rule than the library's. Every
cell lies within its tolerances and never on its numbers, every press scatters, no two cycles are alike, and the noise is not
quite the stated one. Effects (see blind_laws) are scaled to a wanted signal-to-noise ratio.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np
from scipy.optimize import least_squares

from palpd.gap.blind_laws import (
    FOREIGN_LAWS,
    LIBRARY_LAWS,
    NOVEL_LAWS,
    Floats,
    Ints,
    Law,
    Measure,
    Rows,
    Shape,
    World,
    one_pole,
    second_order,
)
from palpd.samples import Samples

Kind = Literal["healthy", "library", "foreign", "two", "removed", "novel"]
KINDS: tuple[Kind, ...] = ("healthy", "library", "foreign", "two", "removed", "novel")
Planted = tuple[Law, Shape]

CHANNELS = ("z_m", "fx_N", "fy_N", "fz_N", "tx_Nm", "ty_Nm", "tz_Nm")
PHASES = ("free_still", "free_moving", "loading", "holding", "unloading")
CROSSTALK_ARM_M = 0.05
"""A crosstalk tolerance stated for forces is this times as large for torques, in Nm per N."""

FINE_HZ = 2400.0
BIN_S = 0.02
SLOW_ROBOT_HZ = 125.0
MAX_ROWS = 40_000
TOLERANCES = (
    "bias_N",
    "drift_N_per_min",
    "gain",
    "latency_s",
    "filter_cutoff",
    "mass_kg",
    "youngs_modulus",
    "surface_z_m",
    "servo_natural_frequency",
    "crosstalk_fx",
    "crosstalk_fy",
    "crosstalk_tx",
    "crosstalk_ty",
)


@dataclass(frozen=True)
class Cell:
    """The numbers of a cell.yaml, and the standard deviations that hold for it, stated or not."""

    mass_kg: float
    tip_radius_m: float
    tip_length_m: float
    rate_Hz: float
    cutoff_Hz: float | None
    noise_N: float
    noise_Nm: float
    step_fxy_N: float
    step_fz_N: float
    step_Nm: float
    servo_Hz: float
    servo_damping: float
    position_noise_m: float
    velocity_noise_m_per_s: float
    surface_z_m: float
    youngs_modulus_Pa: float
    poisson_ratio: float
    tolerances: dict[str, float]
    scatter_surface_m: float
    scatter_stiffness: float
    stated: bool = True

    @property
    def hertz(self) -> float:
        """Force over depth^1.5 of the nominal tissue."""
        return 4.0 / 3.0 * self.youngs_modulus_Pa / (1.0 - self.poisson_ratio**2) * self.tip_radius_m**0.5

    @cached_property
    def sigmas(self) -> Floats:
        """Noise and rounding of one row, channel by channel (7,)."""
        steps = np.array([0.0, self.step_fxy_N, self.step_fxy_N, self.step_fz_N, *[self.step_Nm] * 3])
        noises = np.array([self.position_noise_m, *[self.noise_N] * 3, *[self.noise_Nm] * 3])
        return np.sqrt(noises**2 + steps**2 / 12.0)

    def as_yaml(self) -> dict[str, Any]:
        """The keys of cell.yaml."""
        block: dict[str, Any] = {
            "probe": {"mass_kg": self.mass_kg, "tip_radius_m": self.tip_radius_m, "tip_length_m": self.tip_length_m},
            "sensor": {
                "rate_Hz": self.rate_Hz,
                "filter_cutoff_Hz": self.cutoff_Hz,
                "noise_rms_N": self.noise_N,
                "noise_rms_Nm": self.noise_Nm,
                "resolution_fxy_N": self.step_fxy_N,
                "resolution_fz_N": self.step_fz_N,
                "resolution_Nm": self.step_Nm,
            },
            "robot": {
                "servo_natural_frequency_Hz": self.servo_Hz,
                "servo_damping_ratio": self.servo_damping,
                "position_noise_rms_m": self.position_noise_m,
                "velocity_noise_rms_m_per_s": self.velocity_noise_m_per_s,
            },
            "tissue": {
                "surface_z_m": self.surface_z_m,
                "youngs_modulus_Pa": self.youngs_modulus_Pa,
                "poisson_ratio": self.poisson_ratio,
            },
            "effects": {},
        }
        if self.stated:
            names = [name for name in TOLERANCES if not name.startswith("crosstalk_")]
            block["tolerances"] = {name: self.tolerances[name] for name in names} | {"crosstalk": self.tolerances["crosstalk_fx"]}
            block["repeatability"] = {"surface_z_m": self.scatter_surface_m, "stiffness": self.scatter_stiffness}
        return block


@dataclass(frozen=True)
class Motion:
    """A commanded height: rests and straight strokes with trapezoidal speed. Rows (k,): begin, from, to, speed, acceleration."""

    begin_s: Floats
    from_m: Floats
    to_m: Floats
    speed_m_per_s: Floats
    acceleration_m_per_s2: Floats
    press_begin_s: Floats
    duration_s: float
    _grids: dict[float, tuple[Floats, Floats, Ints]] = field(default_factory=dict, repr=False, compare=False)

    def at(self, t_s: Floats) -> Floats:
        """Commanded height at these times."""
        k = np.clip(np.searchsorted(self.begin_s, t_s, side="right") - 1, 0, None)
        way = np.abs(self.to_m - self.from_m)
        acceleration = self.acceleration_m_per_s2
        top = np.minimum(self.speed_m_per_s, np.sqrt(way * acceleration))
        ramp = top / acceleration
        cruise = way / top - ramp
        t = np.maximum(t_s - self.begin_s[k], 0.0)
        first = np.minimum(t, ramp[k])
        last = np.clip(t - ramp[k] - cruise[k], 0.0, ramp[k])
        middle = np.clip(t - ramp[k], 0.0, cruise[k])
        gone = 0.5 * acceleration[k] * first**2 + top[k] * (middle + last) - 0.5 * acceleration[k] * last**2
        return np.asarray(self.from_m[k] + np.sign(self.to_m - self.from_m)[k] * gone)

    def press(self, t_s: Floats) -> Ints:
        """The press that each moment belongs to, -1 before the first."""
        return np.asarray(np.searchsorted(self.press_begin_s, t_s, side="right") - 1)

    def on_grid(self, dt_s: float) -> tuple[Floats, Floats, Ints]:
        """Times, commanded heights and presses at even steps over the whole motion."""
        if dt_s not in self._grids:
            t = np.arange(0.0, self.duration_s + dt_s, dt_s)
            self._grids[dt_s] = (t, self.at(t), self.press(t))
        return self._grids[dt_s]

    @property
    def presses(self) -> int:
        """How many presses there are."""
        return len(self.press_begin_s)


@dataclass(frozen=True)
class Deviations:
    """How one cell lies within its tolerances: in standard deviations for every tolerance, and press by press."""

    of: dict[str, float]
    surface: Floats
    stiffness: Floats


@dataclass(frozen=True)
class Case:
    """One sealed case: what the diagnosis may see (`cell`, `samples`, `without`) and what it may not.

    `second` is the true cell on another motion, without noise and rounding; `second_floor` (7,) the rms that tolerances leave there,
    `second_change` (7,) the rms of the change that the effects make.
    """

    kind: Kind
    cell: dict[str, Any]
    samples: Samples
    without: tuple[str, ...]
    second: Samples
    truth: dict[str, Any]


def no_deviations(presses: int) -> Deviations:
    """A cell exactly on its numbers."""
    return Deviations(dict.fromkeys(TOLERANCES, 0.0), np.zeros(presses), np.zeros(presses))


def simulate(
    cell: Cell,
    deviations: Deviations,
    motion: Motion,
    planted: Sequence[Planted] = (),
    *,
    dt_s: float,
    reported: World | None = None,
) -> World:
    """A noise-free run of the cell on a fine grid; driven by the motion of `reported` where given, else through the servo."""
    t, command, press = motion.on_grid(dt_s)
    off = {name: value * cell.tolerances[name] for name, value in deviations.of.items()}
    inside = np.maximum(press, 0)
    cutoff = cell.cutoff_Hz if cell.cutoff_Hz else np.inf
    w = World(
        t_s=t,
        dt_s=dt_s,
        press=press,
        command_m=command,
        servo_Hz=cell.servo_Hz * (1.0 + off["servo_natural_frequency"]),
        servo_damping=cell.servo_damping,
        mass_kg=cell.mass_kg + off["mass_kg"],
        tip_radius_m=cell.tip_radius_m,
        tip_length_m=cell.tip_length_m,
        hertz=cell.hertz * (1.0 + off["youngs_modulus"]) * (1.0 + cell.scatter_stiffness * deviations.stiffness[inside]),
        surface_m=cell.surface_z_m + off["surface_z_m"] + cell.scatter_surface_m * deviations.surface[inside],
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
        w.v = second_order(drive, dt_s, [omega2, 0.0], w.servo_Hz, w.servo_damping)
        w.a = second_order(drive, dt_s, [omega2, 0.0, 0.0], w.servo_Hz, w.servo_damping)
        laws("motion")
    else:
        w.z_m, w.v, w.a = reported.z_m, reported.v, reported.a
    w.tip_m = w.z_m
    laws("tip")
    laws("surface")
    w.wrench = np.zeros((len(t), 6), order="F")
    _touch(w, laws)
    w.wrench[:, 2] = w.contact_N - w.mass_kg * w.a
    laws("probe")
    _sense(w, off, laws)
    return w


def _touch(w: World, laws: Callable[[str], None]) -> None:
    """Contact force at the tip; where the tip gives way under it, by iteration to where both agree."""
    rigid = w.tip_m
    for _ in range(60 if w.give else 1):
        last = w.contact_N
        w.depth_m = np.maximum(w.surface_m - w.tip_m, 0.0)
        w.contact_N = w.hertz * w.depth_m**1.5
        laws("tissue")
        laws("history")
        if w.give is None:
            return
        if len(last):
            slope = 1.5 * w.hertz * np.sqrt(np.maximum(w.surface_m - rigid, 0.0))
            small = np.maximum(np.abs(last), 1e-6)
            w.contact_N = last + (w.contact_N - last) / (1.0 + slope * w.give(small) / small)
            if float(np.abs(w.contact_N - last).max()) < 1e-6 * float(np.abs(last).max() + 1e-12):
                return
        w.tip_m = rigid + w.give(w.contact_N)


def _sense(w: World, off: dict[str, float], laws: Callable[[str], None]) -> None:
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


def rows(w: World, t_s: Floats, planted: Sequence[Planted] = (), random: np.random.Generator | None = None) -> Floats:
    """What stands in the rows at these times, (m, 7), noise-free: height, then the wrench as late and skewed as the sensor is."""
    late = np.interp(t_s, w.t_s, w.late_s) if isinstance(w.late_s, np.ndarray) else w.late_s
    when = t_s * (1.0 + w.skew) - late
    wrench = np.zeros((len(t_s), 6))
    for column in np.flatnonzero(w.wrench.any(axis=0)):
        wrench[:, column] = np.interp(when, w.t_s, w.wrench[:, column])
    readings = Rows(t_s, wrench, random or np.random.default_rng(0))
    for law, shape in planted:
        if law.stage == "row" and not law.variance:
            law.apply(readings, shape)
    return np.column_stack([np.interp(t_s, w.t_s, w.z_m), wrench])


class Ground:
    """One cell, within its tolerances, on one motion: what effects change in its gap, and how large that is."""

    def __init__(self, cell: Cell, deviations: Deviations, motion: Motion, t_s: Floats, fine_Hz: float = FINE_HZ) -> None:
        self.cell, self.deviations, self.motion, self.t_s = cell, deviations, motion, t_s
        self.dt_s = 1.0 / (cell.rate_Hz * np.ceil(fine_Hz / cell.rate_Hz))
        self.plain = simulate(cell, deviations, motion, dt_s=self.dt_s)
        self.plain_rows = rows(self.plain, t_s)

    def run(self, planted: Sequence[Planted]) -> World:
        """The cell with these effects, through its servo."""
        return simulate(self.cell, self.deviations, self.motion, planted, dt_s=self.dt_s)

    def change(self, planted: Sequence[Planted]) -> Floats:
        """What the effects change in measured minus predicted, row by row (m, 7): heights against the servo, wrenches against a
        cell without them that makes the same motion."""
        w = self.run(planted)
        here = rows(w, self.t_s, planted)
        moved = float(np.abs(w.z_m - self.plain.z_m).max()) > 0.0
        without = rows(self._same_motion(w), self.t_s) if moved else self.plain_rows
        return np.column_stack([here[:, 0] - self.plain_rows[:, 0], here[:, 1:] - without[:, 1:]])

    def _same_motion(self, w: World) -> World:
        return simulate(self.cell, self.deviations, self.motion, dt_s=self.dt_s, reported=w)

    @cached_property
    def tangents(self) -> list[Floats]:
        """The change (m, 7) of one standard deviation of every tolerance and of the scatter of every press."""
        d, changes = self.deviations, []
        for name in TOLERANCES:
            moved = Deviations(d.of | {name: d.of[name] + 1.0}, d.surface, d.stiffness)
            changes.append(self._tangent(moved))
        for k in range(self.motion.presses):
            one = np.eye(self.motion.presses)[k]
            changes.append(self._tangent(Deviations(d.of, d.surface + one, d.stiffness)))
            changes.append(self._tangent(Deviations(d.of, d.surface, d.stiffness + one)))
        return changes

    def _tangent(self, moved: Deviations) -> Floats:
        servo = moved.of["servo_natural_frequency"] != self.deviations.of["servo_natural_frequency"]
        w = simulate(self.cell, moved, self.motion, dt_s=self.dt_s, reported=None if servo else self.plain)
        change = rows(w, self.t_s) - self.plain_rows
        if servo:  # forces are judged on the motion that was measured
            change[:, 1:] = 0.0
        return np.asarray(change)

    def means(self, change: Floats) -> Floats:
        """20 ms means over all channels in sensor sigmas of such a mean, one after another."""
        m = self.rows_per_bin
        whole = len(change) // m * m
        means = change[:whole].reshape(-1, m, change.shape[1]).mean(axis=1)
        return np.asarray((means / self.cell.sigmas * np.sqrt(m)).ravel(order="F"))

    @property
    def rows_per_bin(self) -> int:
        """How many rows a mean of 20 ms takes together."""
        return max(1, round(BIN_S * self.cell.rate_Hz))

    @cached_property
    def _nuisances(self) -> tuple[Floats, Floats]:
        u, s, _ = np.linalg.svd(np.column_stack([self.means(x) for x in self.tangents]), full_matrices=False)
        return u, 1.0 / np.sqrt(1.0 + s**2) - 1.0

    def whitened(self, change: Floats) -> Floats:
        """The change with tolerances and press scatter projected out, as far as they can hide it; its norm is the SNR."""
        u, weight = self._nuisances
        x = self.means(change)
        return np.asarray(x + u @ (weight * (u.T @ x)))

    def snr(self, change: Floats) -> float:
        """Norm of the change over 20 ms means of all channels, in sensor sigmas, beside tolerances and press scatter."""
        return float(np.linalg.norm(self.whitened(change)))

    @cached_property
    def phases(self) -> Ints:
        """The phase of every row, index into PHASES."""
        v = np.gradient(self.motion.at(self.t_s), self.t_s)
        moving = np.abs(v) > min(1e-3, 0.05 * float(np.percentile(np.abs(v), 95)))
        contact = self.plain_rows[:, 0] < self.cell.surface_z_m
        return np.where(contact, np.where(moving, np.where(v < 0, 2, 4), 3), np.where(moving, 1, 0))

    def sizes(self, change: Floats) -> Floats:
        """Size of a change by channel and phase (7, 5): its rms over what noise, rounding, scatter and tolerances leave there."""
        out = np.zeros((len(CHANNELS), len(PHASES)))
        for p in range(len(PHASES)):
            here = self.phases == p
            if here.any():
                floor2 = self.cell.sigmas**2 + sum(np.mean(x[here] ** 2, axis=0) for x in self.tangents)
                out[:, p] = np.sqrt(np.mean(change[here] ** 2, axis=0) / floor2)
        return out


def fit_strength(ground: Ground, law: Law, shape: Shape, snr: float) -> tuple[Shape, Floats, float] | None:
    """Parameters of a law, its change and SNR, at the wanted SNR; None where the cell cannot show so much of it."""
    strength = 0.3
    for _ in range(9):
        parameters = law.at(shape, strength)
        change = ground.change([(law, parameters)])
        now = ground.snr(change)
        if not np.isfinite(now):
            return None
        if abs(now - snr) < 0.04 * snr:
            return parameters, change, now
        if strength >= law.strongest and now < snr:
            return None
        strength = min(strength * float(np.clip(snr / max(now, 1e-9), 0.1, 20.0)), law.strongest)
    return (parameters, change, now) if abs(now - snr) < 0.25 * snr else None


def best_mimic(ground: Ground, target: Floats, measure: Measure, without: Sequence[str], seed: int) -> tuple[str, float]:
    """The listed effect that explains a whitened change best, and the norm (an SNR) of what it leaves.

    Shapes are drawn, strengths fitted in proportion; the six best are then fitted in all their parameters.
    """
    random = np.random.default_rng(seed)
    tried: list[tuple[float, Law, Shape, float]] = []
    for law in LIBRARY_LAWS:
        if law.effect in without or law.variance:
            continue
        for _ in range(4):
            shape = law.draw(random, measure)
            x = ground.whitened(ground.change([(law, law.at(shape, 0.5))]))
            fit = float(x @ target) / max(float(x @ x), 1e-30)
            if fit > 0.0:
                strength = min(0.5 * fit, law.strongest)
                tried.append((float(np.linalg.norm(target - x * strength / 0.5)), law, shape, strength))
    best = (float(np.linalg.norm(target)), "")
    for left, law, shape, strength in sorted(tried, key=lambda x: x[0])[:6]:
        names = [name for name, value in shape.items() if value != 0.0]

        def miss(q: Floats, law: Law = law, shape: Shape = shape, names: list[str] = names, strength: float = strength) -> Floats:
            s = min(strength * float(np.exp(q[0])), law.strongest)
            trial = shape | {n: shape[n] * float(np.exp(v)) for n, v in zip(names, q[1:], strict=True)}
            return ground.whitened(ground.change([(law, law.at(trial, s))])) - target

        n = 1 + len(names)
        found = least_squares(miss, np.zeros(n), bounds=(-2.5, 2.5), diff_step=np.full(n, 0.02), max_nfev=12, x_scale=0.5)
        best = min(best, (min(left, float(np.sqrt(2.0 * found.cost))), law.effect))
    return best[1], best[0]


# drawing


def _log_uniform(r: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(r.uniform(np.log(low), np.log(high))))


def _stated(x: float) -> float:
    return float(f"{x:.4g}")


def draw_cell(r: np.random.Generator) -> Cell:
    """Half of them are the emulated cell at some rate; the others are rigs of other sizes, some without stated tolerances."""
    emulated = bool(r.random() < 0.5)
    noise = 0.05 if emulated else _stated(_log_uniform(r, 0.01, 0.12))
    rate = float(r.choice([125.0, 250.0, 500.0, 500.0, 500.0, 1000.0] if emulated else [100.0, 200.0, 333.0, 500.0, 800.0]))
    cutoff = 150.0 if emulated else float(r.choice([0.15, 0.3, 0.6])) * rate
    mass = 0.2 if emulated else _stated(_log_uniform(r, 0.06, 0.6))
    radius = 0.005 if emulated else _stated(_log_uniform(r, 0.0025, 0.008))
    tolerances = {
        "bias_N": 0.02,
        "drift_N_per_min": 0.01,
        "gain": 0.005,
        "latency_s": 0.001,
        "filter_cutoff": 0.05,
        "mass_kg": 0.003,
        "youngs_modulus": 0.02,
        "surface_z_m": 3.0e-5,
        "servo_natural_frequency": 0.02,
    } | dict.fromkeys(TOLERANCES[-4:], 0.003)
    scatter = (2.0e-5, 0.01)
    stated = emulated or bool(r.random() < 0.6)
    if not emulated:
        tolerances |= {
            "bias_N": 0.4 * noise,
            "drift_N_per_min": 0.2 * noise,
            "mass_kg": 0.015 * mass,
            "surface_z_m": 0.006 * radius,
        }
        scatter = (0.004 * radius, 0.01)
        if stated:
            tolerances = {name: _stated(x * _log_uniform(r, 0.5, 2.0)) for name, x in tolerances.items()}
            tolerances |= dict.fromkeys(TOLERANCES[-4:], tolerances["crosstalk_fx"])
    return Cell(
        mass_kg=mass,
        tip_radius_m=radius,
        tip_length_m=0.08 if emulated else _stated(_log_uniform(r, 0.04, 0.12)),
        rate_Hz=rate,
        cutoff_Hz=cutoff if emulated or r.random() < 0.85 else None,
        noise_N=noise,
        noise_Nm=_stated(0.02 * noise),
        step_fxy_N=0.024 if emulated else _stated(noise * _log_uniform(r, 0.1, 1.0)),
        step_fz_N=0.131 if emulated else _stated(noise * _log_uniform(r, 0.2, 2.7)),
        step_Nm=0.001 if emulated else _stated(0.02 * noise * _log_uniform(r, 0.2, 1.0)),
        servo_Hz=8.0 if emulated else _stated(_log_uniform(r, 4.0, min(16.0, 0.06 * rate))),
        servo_damping=1.0 if emulated else _stated(float(r.uniform(0.7, 1.0))),
        position_noise_m=5.0e-6 if emulated else _stated(_log_uniform(r, 2.0e-6, 8.0e-6)),
        velocity_noise_m_per_s=2.0e-4 if emulated else _stated(_log_uniform(r, 8.0e-5, 3.0e-4)),
        surface_z_m=0.0 if emulated else _stated(float(r.uniform(-0.05, 0.2))),
        youngs_modulus_Pa=72000.0 if emulated else _stated(_log_uniform(r, 2.0e4, 2.0e5)),
        poisson_ratio=0.5,
        tolerances=tolerances,
        scatter_surface_m=scatter[0],
        scatter_stiffness=scatter[1],
        stated=stated,
    )


def draw_motion(r: np.random.Generator, cell: Cell) -> Motion:
    """Free strokes and presses in a drawn order, each with its own depth, speeds, acceleration, hold and rest."""
    deepest = (_log_uniform(r, 60.0, 200.0) * cell.noise_N / cell.hertz) ** (2.0 / 3.0)
    deepest = float(np.clip(deepest, 0.25 * cell.tip_radius_m, 1.5 * cell.tip_radius_m))
    height = deepest * float(r.uniform(0.8, 2.5))
    cycles = list(r.permutation([True] * int(r.integers(4, 9)) + [False] * int(r.integers(2, 5))))
    here = cell.surface_z_m + height
    t = float(r.uniform(0.8, 2.0))
    strokes: list[tuple[float, float, float, float, float]] = [(0.0, here, here - 1e-12, 1.0, 1e9)]
    presses: list[float] = []

    def go(to: float, speed: float, rest_s: float) -> None:
        nonlocal here, t
        acceleration = speed / float(r.uniform(0.05, 0.25))
        way = abs(to - here)
        top = min(speed, (way * acceleration) ** 0.5)
        strokes.append((t, here, to, speed, acceleration))
        t += way / top + top / acceleration + rest_s
        here = to

    for press in cycles:
        top = cell.surface_z_m + height * float(r.uniform(0.5, 1.0))
        if press:
            presses.append(t - 0.05)
            if r.random() < 0.4:
                go(cell.surface_z_m + 0.15 * height, height / _log_uniform(r, 0.3, 1.5), float(r.uniform(0.3, 0.8)))
            depth = deepest * float(r.uniform(0.35, 1.0))
            go(cell.surface_z_m - depth, deepest / _log_uniform(r, 0.15, 2.5), _log_uniform(r, 0.4, 5.0))
            go(top, deepest / _log_uniform(r, 0.15, 2.5), _log_uniform(r, 0.5, 2.0))
        else:
            speed = height / _log_uniform(r, 0.2, 1.0)
            go(cell.surface_z_m + height * float(r.uniform(1.5, 2.5)), speed, _log_uniform(r, 0.2, 1.0))
            go(top, speed * float(r.uniform(0.5, 1.5)), _log_uniform(r, 0.4, 1.0))
    table = np.array(strokes).T
    return Motion(table[0], table[1], table[2], table[3], table[4], np.array(presses), t)


def draw_deviations(r: np.random.Generator, motion: Motion) -> Deviations:
    """A cell within specification, and never on it."""
    of = {name: float(np.clip(r.standard_normal(), -3.0, 3.0)) for name in TOLERANCES}
    return Deviations(of, r.standard_normal(motion.presses), r.standard_normal(motion.presses))


def measure_of(cell: Cell, ground: Ground) -> Measure:
    """How large things are in this cell and motion."""
    z, cutoff = ground.plain.z_m, cell.cutoff_Hz or 0.3 * cell.rate_Hz
    return Measure(
        force_N=float(ground.plain.contact_N.max()),
        depth_m=float(ground.plain.depth_m.max()),
        stroke_m=float(np.ptp(z)),
        speed_m_per_s=float(np.abs(ground.plain.v).max()),
        acceleration_m_per_s2=float(np.abs(ground.plain.a).max()),
        duration_s=float(ground.t_s[-1]),
        noise_N=cell.noise_N,
        step_N=cell.step_fz_N,
        rate_Hz=cell.rate_Hz,
        mass_kg=cell.mass_kg,
        tip_radius_m=cell.tip_radius_m,
        tip_length_m=cell.tip_length_m,
        cutoff_Hz=min(cutoff, 0.3 * cell.rate_Hz),
        servo_Hz=cell.servo_Hz,
        presses=ground.motion.presses,
    )


def _row_times(r: np.random.Generator, cell: Cell, duration_s: float) -> Floats:
    """Even steps in most recordings, steps that differ by a tenth in some."""
    n = min(int(duration_s * cell.rate_Hz), MAX_ROWS)
    t = np.arange(n) / cell.rate_Hz
    return t + (r.uniform(0.0, 0.1, n) / cell.rate_Hz if r.random() < 0.1 else 0.0)


def measured(
    r: np.random.Generator, cell: Cell, w: World, motion: Motion, t_s: Floats, planted: Sequence[Planted], robot_rate_Hz: float
) -> Samples:
    """The recording of a run: robot noise (interpolated where the robot reports slower than the sensor), sensor noise, what the
    electronics do, rounding."""
    scale = r.uniform(0.85, 1.18, 4)
    t_robot = np.arange(0.0, t_s[-1] + 2.0 / robot_rate_Hz, 1.0 / robot_rate_Hz) if robot_rate_Hz < cell.rate_Hz else t_s
    z = np.interp(t_robot, w.t_s, w.z_m) + scale[0] * cell.position_noise_m * r.standard_normal(len(t_robot))
    v = np.interp(t_robot, w.t_s, w.v) + scale[1] * cell.velocity_noise_m_per_s * r.standard_normal(len(t_robot))
    wrench = rows(w, t_s)[:, 1:]
    white = r.standard_t(4.0, wrench.shape) / 2.0**0.5 if w.heavy_tails else r.standard_normal(wrench.shape)
    sigma = np.array([scale[2] * cell.noise_N] * 3 + [scale[3] * cell.noise_Nm] * 3)
    readings = Rows(t_s, wrench + w.noise_ratio * sigma * white, r)
    for law, shape in planted:
        if law.stage == "row":
            law.apply(readings, shape)
    steps = np.array([cell.step_fxy_N, cell.step_fxy_N, cell.step_fz_N, *[cell.step_Nm] * 3])
    wrench = np.round(readings.wrench / steps) * steps
    return Samples(t_s, motion.at(t_s), np.interp(t_s, t_robot, z), np.interp(t_s, t_robot, v), np.asarray(wrench))


class CannotDraw(Exception):
    """This cell and motion cannot show the wanted effect at the wanted size; draw again."""


STRATA: dict[str, tuple[float, float]] = {"6-10": (6.0, 10.0), "10-20": (10.0, 20.0), "20-60": (20.0, 60.0), "> 60": (60.0, 200.0)}


def laws_of(kind: Kind, effect: str) -> list[Law]:
    """The laws that a kind of case may plant for an effect."""
    table = {"library": LIBRARY_LAWS, "foreign": FOREIGN_LAWS, "novel": NOVEL_LAWS}.get(kind, LIBRARY_LAWS + FOREIGN_LAWS)
    return [law for law in table if law.effect == effect]


def draw_case(seed: int, index: int, kind: Kind, effects: Sequence[str] = (), stratum: str = "20-60") -> Case:
    """The case of that number: cell, tolerances, motion, effects at a signal-to-noise ratio within the stratum, recording, truth.

    `effects`: what is planted (two for `two`, none for `healthy`). The same arguments give the same case.
    """
    for attempt in range(40):
        try:
            return _draw_case(np.random.default_rng([seed, index, attempt]), kind, effects, STRATA[stratum])
        except CannotDraw:
            continue
    raise CannotDraw(f"case {index}: no cell shows {', '.join(effects)} at an SNR of {stratum}")


def _draw_case(r: np.random.Generator, kind: Kind, effects: Sequence[str], snrs: tuple[float, float]) -> Case:
    cell = draw_cell(r)
    motion = draw_motion(r, cell)
    t_s = _row_times(r, cell, motion.duration_s)
    ground = Ground(cell, draw_deviations(r, motion), motion, t_s)
    measure = measure_of(cell, ground)
    planted: list[Planted] = []
    told: list[dict[str, Any]] = []
    changes: list[Floats] = []
    for effect in effects:
        laws = laws_of(kind, effect)
        law = laws[int(r.integers(len(laws)))]
        shape, snr = law.draw(r, measure), _log_uniform(r, *snrs)
        if law.variance:
            fitted: tuple[Shape, Floats | None, float | None] = (law.at(shape, _log_uniform(r, 1.0, 5.0)), None, None)
        else:
            found = fit_strength(ground, law, shape, snr)
            if found is None or not snrs[0] <= found[2] <= snrs[1] * 1.05:
                raise CannotDraw(effect)
            fitted = found
            changes.append(found[1])
        planted.append((law, fitted[0]))
        told.append({"id": law.effect, "law": law.name, "parameters": fitted[0], "snr": fitted[2], "variance": law.variance})
        told[-1]["snr_per_row_sigma"] = None if fitted[2] is None else fitted[2] / ground.rows_per_bin**0.5
    for k, one in enumerate(told):
        if len(changes) == len(told) == 2:
            one["snr_beside_the_other"] = _beside(ground.whitened(changes[k]), ground.whitened(changes[1 - k]))
    robot_rate_Hz = SLOW_ROBOT_HZ if cell.rate_Hz > 1.5 * SLOW_ROBOT_HZ and r.random() < 0.2 else cell.rate_Hz
    sizes = ground.sizes(np.sum(changes, axis=0)) if changes else np.zeros((len(CHANNELS), len(PHASES)))
    without = tuple(effects) if kind == "removed" else ()
    truth: dict[str, Any] = {
        "kind": kind,
        "effects": told,
        "without": list(without),
        "size": float(sizes.max()),
        "sizes": {c: dict(zip(PHASES, sizes[i].tolist(), strict=True)) for i, c in enumerate(CHANNELS)},
        "deviations": ground.deviations.of,
        "rate_Hz": cell.rate_Hz,
        "robot_rate_Hz": robot_rate_Hz,
        "rows": len(t_s),
        "duration_s": float(t_s[-1]),
        "presses": motion.presses,
        "mimic": None,
    }
    if kind in {"removed", "novel"} and changes:
        truth["mimic"] = _mimic(ground, planted, measure, without, int(r.integers(2**31)))
    samples = measured(r, cell, ground.run(planted), motion, t_s, planted, robot_rate_Hz)
    second, truth["second"] = _second(r, cell, ground.deviations, planted)
    return Case(kind, cell.as_yaml(), samples, without, second, truth)


def _beside(x: Floats, other: Floats) -> float:
    return float(np.linalg.norm(x - other * float(x @ other) / float(other @ other)))


def _mimic(ground: Ground, planted: Sequence[Planted], measure: Measure, without: Sequence[str], seed: int) -> dict[str, Any]:
    coarse = Ground(ground.cell, ground.deviations, ground.motion, ground.t_s, fine_Hz=500.0)
    effect, left = best_mimic(coarse, coarse.whitened(coarse.change(planted)), measure, without, seed)
    return {"id": effect, "snr_left": left}


def _second(r: np.random.Generator, cell: Cell, deviations: Deviations, planted: Sequence[Planted]) -> tuple[Samples, dict[str, Any]]:
    """The same cell on another motion, noise-free and without press scatter; what its tolerances and its effects make there."""
    motion = draw_motion(r, cell)
    rate = min(cell.rate_Hz, 250.0)
    t_s = np.arange(min(int(motion.duration_s * rate), MAX_ROWS)) / rate
    still = Deviations(deviations.of, np.zeros(motion.presses), np.zeros(motion.presses))
    ground = Ground(cell, still, motion, t_s)
    w = ground.run(planted)
    readings = rows(w, t_s, planted)
    v = np.interp(t_s, w.t_s, w.v)
    floor = np.sqrt(sum(np.mean(x**2, axis=0) for x in ground.tangents[: len(TOLERANCES)]))
    change = np.sqrt(np.mean(ground.change(planted) ** 2, axis=0)) if planted else np.zeros(len(CHANNELS))
    second = Samples(t_s, motion.at(t_s), readings[:, 0], v, np.asarray(readings[:, 1:]))
    numbers = {"floor": floor, "change": change, "sigma": cell.sigmas}
    return second, {name: dict(zip(CHANNELS, values.tolist(), strict=True)) for name, values in numbers.items()}
