"""Cells and motions of the blind check: drawn at random, each within its tolerances and never on its numbers.

Every press scatters, and no two cycles are alike.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from palpd.blind.laws import Floats, Ints
from palpd.blind.stated_cell import CellNumbers, log_uniform

CROSSTALK_ARM_M = 0.05
"""Torque tolerance of the crosstalk per force tolerance, in Nm per N."""

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
"""Everything that lies within a tolerance, in the order in which deviations are drawn."""


EMULATED_TOLERANCES = {
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
"""Standard deviations of the emulated cell. Keys without a unit are relative."""


NOMINAL: dict[str, Any] = {
    "mass_kg": 0.2, "tip_radius_m": 0.005, "tip_length_m": 0.08, "filter_cutoff_Hz": 150.0, "noise_rms_N": 0.05, "noise_rms_Nm": 0.001,
    "resolution_fxy_N": 0.024, "resolution_fz_N": 0.131, "resolution_Nm": 0.001, "servo_natural_frequency_Hz": 8.0,
    "servo_damping_ratio": 1.0, "position_noise_rms_m": 5.0e-6, "velocity_noise_rms_m_per_s": 2.0e-4, "surface_z_m": 0.0,
    "youngs_modulus_Pa": 72000.0, "poisson_ratio": 0.5,
}  # fmt: skip
"""The numbers of the emulated cell, but for its rate: the defaults of docs/reference/cell-file.md."""


def tolerances_of(noise_N: float, mass_kg: float, tip_radius_m: float) -> dict[str, float]:
    """The tolerances of a cell of that noise, mass and size that states none."""
    own = {"bias_N": 0.4 * noise_N, "drift_N_per_min": 0.2 * noise_N, "mass_kg": 0.015 * mass_kg, "surface_z_m": 0.006 * tip_radius_m}
    return EMULATED_TOLERANCES | own


@dataclass(frozen=True)
class CellRealisation(CellNumbers):
    """The numbers of a cell.yaml, and the standard deviations that hold for it, stated or not.

    `silent` are the columns of CHANNELS that a recording does not hold; nothing can be seen there.
    """

    tolerances: dict[str, float]
    stated: bool = True
    silent: tuple[int, ...] = ()

    @cached_property
    def sigmas(self) -> Floats:
        """Noise and rounding of one row, channel by channel (7,)."""
        sigmas = self.sigma.copy()
        sigmas[list(self.silent)] = np.inf
        return sigmas

    def as_yaml(self) -> dict[str, Any]:
        """The keys of cell.yaml."""
        block = self.blocks() | {"effects": {}}
        if self.stated:
            names = [name for name in TOLERANCES if not name.startswith("crosstalk_")]
            block["tolerances"] = {name: self.tolerances[name] for name in names} | {"crosstalk": self.tolerances["crosstalk_fx"]}
            block["repeatability"] = {"surface_z_m": self.scatter_surface_z_m, "stiffness": self.scatter_stiffness}
        return block


@dataclass(frozen=True)
class Departure:
    """How a recorded cell departs from the nominal one on a fine grid: height, speed, acceleration (n,) and wrench (n, 6)."""

    z_m: Floats
    vz_m_per_s: Floats
    az_m_per_s2: Floats
    wrench: Floats


class PressedMotion(Protocol):
    """A commanded height with presses, drawn or recorded."""

    @property
    def presses(self) -> int:
        """Number of presses."""

    def at(self, t_s: Floats) -> Floats:
        """Commanded height at these times.

        Args:
            t_s: Times in s (n,).

        Returns:
            Heights in m (n,).
        """

    def on_grid(self, dt_s: float) -> tuple[Floats, Floats, Ints]:
        """Times, commanded heights and presses (n,) at even steps over the whole motion."""

    def departure(self, dt_s: float) -> Departure | None:
        """What a recorded cell does besides; None for a drawn one."""


@dataclass(frozen=True)
class DrawnMotion:
    """A commanded height: rests and straight strokes with trapezoidal speed. All arrays (k,), one entry a stroke."""

    begin_s: Floats
    from_m: Floats
    to_m: Floats
    speed_m_per_s: Floats
    acceleration_m_per_s2: Floats
    press_begin_s: Floats
    duration_s: float
    _grids: dict[float, tuple[Floats, Floats, Ints]] = field(default_factory=dict, repr=False, compare=False)

    def at(self, t_s: Floats) -> Floats:
        """Commanded height at these times.

        Args:
            t_s: Times in s (n,).

        Returns:
            Heights in m (n,).
        """
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
        """The press that each moment belongs to.

        Args:
            t_s: Times in s (n,).

        Returns:
            Indices (n,), -1 before the first press.
        """
        return np.asarray(np.searchsorted(self.press_begin_s, t_s, side="right") - 1)

    def on_grid(self, dt_s: float) -> tuple[Floats, Floats, Ints]:
        """Times, commanded heights and presses (n,) at even steps over the whole motion."""
        if dt_s not in self._grids:
            t = np.arange(0.0, self.duration_s + dt_s, dt_s)
            self._grids[dt_s] = (t, self.at(t), self.press(t))
        return self._grids[dt_s]

    @property
    def presses(self) -> int:
        """Number of presses."""
        return len(self.press_begin_s)

    def departure(self, dt_s: float) -> None:  # noqa: ARG002 - the same call as for a recorded motion
        """A drawn cell has no other motion than its servo's."""
        return


@dataclass(frozen=True)
class Deviations:
    """How one cell lies within its tolerances: in standard deviations for every tolerance, and press by press."""

    of: dict[str, float]
    surface: Floats
    stiffness: Floats


def no_deviations(presses: int) -> Deviations:
    """A cell exactly on its numbers."""
    return Deviations(dict.fromkeys(TOLERANCES, 0.0), np.zeros(presses), np.zeros(presses))


def _stated(x: float) -> float:
    return float(f"{x:.4g}")


def draw_cell(r: np.random.Generator) -> CellRealisation:
    """Half of them are the emulated cell at some rate; the others are rigs of other sizes, some without stated tolerances."""
    return _draw_emulated(r) if r.random() < 0.5 else _draw_rig(r)


def _draw_emulated(r: np.random.Generator) -> CellRealisation:
    rate = float(r.choice([125.0, 250.0, 500.0, 500.0, 500.0, 1000.0]))
    return CellRealisation(**NOMINAL, rate_Hz=rate, tolerances=EMULATED_TOLERANCES, scatter_surface_z_m=2.0e-5, scatter_stiffness=0.01)


def _draw_rig(r: np.random.Generator) -> CellRealisation:
    noise = _stated(log_uniform(r, 0.01, 0.12))
    rate = float(r.choice([100.0, 200.0, 333.0, 500.0, 800.0]))
    cutoff = float(r.choice([0.15, 0.3, 0.6])) * rate
    mass = _stated(log_uniform(r, 0.06, 0.6))
    radius = _stated(log_uniform(r, 0.0025, 0.008))
    stated = bool(r.random() < 0.6)
    tolerances = tolerances_of(noise, mass, radius)
    if stated:
        tolerances = {name: _stated(x * log_uniform(r, 0.5, 2.0)) for name, x in tolerances.items()}
        tolerances |= dict.fromkeys(TOLERANCES[-4:], tolerances["crosstalk_fx"])
    return CellRealisation(
        mass_kg=mass,
        tip_radius_m=radius,
        tip_length_m=_stated(log_uniform(r, 0.04, 0.12)),
        rate_Hz=rate,
        filter_cutoff_Hz=cutoff if r.random() < 0.85 else None,
        noise_rms_N=noise,
        noise_rms_Nm=_stated(0.02 * noise),
        resolution_fxy_N=_stated(noise * log_uniform(r, 0.1, 1.0)),
        resolution_fz_N=_stated(noise * log_uniform(r, 0.2, 2.7)),
        resolution_Nm=_stated(0.02 * noise * log_uniform(r, 0.2, 1.0)),
        servo_natural_frequency_Hz=_stated(log_uniform(r, 4.0, min(16.0, 0.06 * rate))),
        servo_damping_ratio=_stated(float(r.uniform(0.7, 1.0))),
        position_noise_rms_m=_stated(log_uniform(r, 2.0e-6, 8.0e-6)),
        velocity_noise_rms_m_per_s=_stated(log_uniform(r, 8.0e-5, 3.0e-4)),
        surface_z_m=_stated(float(r.uniform(-0.05, 0.2))),
        youngs_modulus_Pa=_stated(log_uniform(r, 2.0e4, 2.0e5)),
        poisson_ratio=0.5,
        tolerances=tolerances,
        scatter_surface_z_m=0.004 * radius,
        scatter_stiffness=0.01,
        stated=stated,
    )


def with_coarse_steps(cell: CellRealisation, over_noise: tuple[float, float, float]) -> CellRealisation:
    """Give a cell coarse steps.

    Args:
        over_noise: Steps as in a `CaseSpec`.

    Returns:
        The cell, its noise as it was.
    """
    lateral, vertical, torque = over_noise
    return replace(
        cell,
        resolution_fxy_N=_stated(lateral * cell.noise_rms_N),
        resolution_fz_N=_stated(vertical * cell.noise_rms_N),
        resolution_Nm=_stated(torque * cell.noise_rms_Nm),
    )


def draw_motion(r: np.random.Generator, cell: CellRealisation) -> DrawnMotion:
    """Draw free strokes and presses in a random order, each with its own depth, speeds, acceleration, hold and rest.

    Args:
        cell: The cell, whose noise, tip and tissue set the depths.
    """
    deepest = (log_uniform(r, 60.0, 200.0) * cell.noise_rms_N / cell.hertz_N_per_m15) ** (2.0 / 3.0)
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
                go(cell.surface_z_m + 0.15 * height, height / log_uniform(r, 0.3, 1.5), float(r.uniform(0.3, 0.8)))
            depth = deepest * float(r.uniform(0.35, 1.0))
            go(cell.surface_z_m - depth, deepest / log_uniform(r, 0.15, 2.5), log_uniform(r, 0.4, 5.0))
            go(top, deepest / log_uniform(r, 0.15, 2.5), log_uniform(r, 0.5, 2.0))
        else:
            speed = height / log_uniform(r, 0.2, 1.0)
            go(cell.surface_z_m + height * float(r.uniform(1.5, 2.5)), speed, log_uniform(r, 0.2, 1.0))
            go(top, speed * float(r.uniform(0.5, 1.5)), log_uniform(r, 0.4, 1.0))
    table = np.array(strokes).T
    return DrawnMotion(table[0], table[1], table[2], table[3], table[4], np.array(presses), t)


def draw_deviations(r: np.random.Generator, motion: DrawnMotion) -> Deviations:
    """Draw a cell within its specification.

    Args:
        motion: The motion, whose presses scatter.

    Returns:
        Normal deviates, those of the tolerances cut off at three.
    """
    of = {name: float(np.clip(r.standard_normal(), -3.0, 3.0)) for name in TOLERANCES}
    return Deviations(of, r.standard_normal(motion.presses), r.standard_normal(motion.presses))
