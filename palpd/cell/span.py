"""A stretch of samples on its way from the motion of the tip to the reading of the sensor, with the numbers of its cell.

The nominal prediction may be that of another simulator (`NominalOutput`). With u its output, c the contact force in it and N the stated
filter, a reading is then sensor(clock(u + N[change of the load])). The load is contact, inertia and what else pushes the probe; tissue
and probe change it as they change palpd's own. Clock and sensor act on what is then read, and a filter by its ratio to the stated one.
Without an effect the reading is u, bit for bit.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from palpd.cell.dynamics import Column, Floats, filtered, steps, unfiltered

HERTZ = 2.0 / 3.0
"""Power of a contact force that grows in proportion to the depth by Hertz: levels are interpolated in it."""

SHALLOW = 0.05
"""Share of the deepest press above which a contact force over that of Hertz says how stiff the tissue is."""


@dataclass(frozen=True, slots=True)
class TipMotion:
    """How the tip moved, in arrays of (n,), and what heights and accelerations still carry of measurement noise (rms).

    A measured acceleration is the slope of reported speeds, each with its own error of `v_noise_m_per_s`, over `slope_half` samples to
    either side. Where a command is known, only the share `acceleration_weight` of what it does not explain is used. `dt_s` are the steps
    of the times, where they have been computed already. `even_s` is their step where they were made on an even grid, else 0.
    """

    t_s: Floats
    z_m: Floats
    vz_m_per_s: Floats
    az_m_per_s2: Floats
    z_noise_m: float = 0.0
    az_noise_m_per_s2: float = 0.0
    v_noise_m_per_s: float = 0.0
    slope_half: int = 0
    acceleration_weight: Floats | float = 1.0
    dt_s: Column | None = None
    even_s: float = 0.0


@dataclass(slots=True)
class Constants:
    """The numbers of one cell at one site, after in-tolerance deviations and effects have changed them.

    `simulator` holds parameters of a user's own simulator that are not as it has them.
    """

    servo_natural_frequency_Hz: float
    servo_damping_ratio: float
    mass_kg: float
    tip_radius_m: float
    tip_length_m: float
    youngs_modulus_Pa: float
    poisson_ratio: float
    surface_z_m: float
    cutoff_Hz: float
    noise_rms_N: float
    noise_rms_Nm: float
    tip_compliance_m_per_N: float = 0.0
    wall_z_m: float = 0.0
    wall_stiffness_N_per_m: float = 0.0
    wall_after_s: float = 0.0
    delay_s: float = 0.0
    skew: float = 0.0
    gain: float = 1.0
    fx_per_fz: float = 0.0
    fy_per_fz: float = 0.0
    tx_per_fz_m: float = 0.0
    ty_per_fz_m: float = 0.0
    bias_N: float = 0.0
    drift_N_per_s: float = 0.0
    limit_N: float = float("inf")
    knee_N: float = 0.0
    step_N: float = 0.0
    dropout_rate_Hz: float = 0.0
    dropout_length_s: float = 0.0
    simulator: dict[str, float] = field(default_factory=dict)

    def elastic_force_N(self, depth_m: Floats) -> Floats:
        """Hertz for a sphere on a half-space, 4/3 E/(1-ν²) √r d^1.5, which at ν = 0.5 is eq. 1 of Guo, Xiao, Ren 2019.

        Args:
            depth_m: Indentations (n,), zero or more, in m.

        Returns:
            Forces (n,) in N.
        """
        reduced_Pa = self.youngs_modulus_Pa / (1.0 - self.poisson_ratio**2)
        force_N: Floats = (4.0 / 3.0 * reduced_Pa * self.tip_radius_m**0.5) * depth_m * np.sqrt(depth_m)
        return force_N


@dataclass(frozen=True)
class Variation:
    """How one parameter of another simulator changes its output.

    Attributes:
        values: Values (g,) of the parameter, ascending.
        changes: Changes (g, n) of the mean reading at these values, by number of the axis.
    """

    values: Floats
    changes: Mapping[int, Floats]

    def change(self, axis: int, value: float) -> Floats | float:
        """Change (n,) of an axis on a smooth curve through those that are known; 0 of an axis that no value changes.

        Args:
            value: Of the parameter, in the unit of `values`.
        """
        if axis not in self.changes:
            return 0.0
        from scipy.interpolate import CubicSpline  # here, since the control loop reads cell files and needs none of it

        weights = CubicSpline(self.values, np.eye(len(self.values)))(value)
        return np.asarray(weights @ self.changes[axis])


@dataclass(frozen=True)
class NominalOutput:
    """What another simulator predicts for one motion of n samples.

    Attributes:
        constants: The numbers of the nominal cell, without any effect.
        motion: The motion of the tip for which the simulator was asked.
        axes: Mean readings (n,) by number of the axis, behind the stated filter; axis 2 is there.
        contact_N: Force of the contact (k, n) with the tip raised by k distances.
        raised_m: These distances (k,), ascending; 0 is one of them.
        sideways: What the contact pushes on other axes, over its force (n,), by number of the axis.
        variations: How its own parameters change it, by their names.
    """

    constants: Constants
    motion: TipMotion
    axes: Mapping[int, Floats]
    contact_N: Floats
    raised_m: Floats
    sideways: Mapping[int, Floats] = field(default_factory=dict)
    variations: Mapping[str, "Variation"] = field(default_factory=dict)

    def averaged(self, motion: TipMotion, average: Callable[[Floats], Floats]) -> "NominalOutput":
        """The same for a motion of m steps.

        Args:
            motion: The same motion at the steps.
            average: Takes values (n,) of the samples to those of the steps (m,).
        """

        def rows(levels: Floats) -> Floats:
            return np.array([average(level) for level in levels])

        axes, sideways = ({axis: average(values) for axis, values in its.items()} for its in (self.axes, self.sideways))
        variations = {
            name: replace(one, changes={axis: rows(change) for axis, change in one.changes.items()})
            for name, one in self.variations.items()
        }
        return replace(self, motion=motion, axes=axes, contact_N=rows(self.contact_N), sideways=sideways, variations=variations)

    # the contact

    @cached_property
    def _plain(self) -> int:
        return int(np.flatnonzero(self.raised_m == 0.0)[0])

    @cached_property
    def _levels(self) -> Floats:
        return np.sign(self.contact_N) * np.abs(self.contact_N) ** HERTZ

    def contact_force_N(self, s: "Span", surface_m: Column) -> Floats:
        """Force (n,) of a contact whose tip or surface may have moved.

        Args:
            s: Samples whose tip is known.
            surface_m: Height of the surface, one number or (n,).
        """
        plain = self.constants
        if plain.youngs_modulus_Pa == 0.0:
            return np.zeros_like(s.tip_m)
        raised_m = s.tip_m - self.motion.z_m + (plain.surface_z_m - surface_m)
        force_N = self.contact_N[self._plain]
        if raised_m.any():
            level = _between(self._levels, self.raised_m, raised_m)
            force_N = np.sign(level) * np.abs(level) ** (1.0 / HERTZ)
        return force_N * (s.constants.youngs_modulus_Pa / plain.youngs_modulus_Pa)

    @cached_property
    def over_hertz(self) -> Floats:
        """Contact force over that of Hertz (n,); where the tip is shallow or free, that of the nearest deeper sample."""
        plain = self.constants
        depth_m = np.maximum(plain.surface_z_m - self.motion.z_m, 0.0)
        deep = np.flatnonzero(depth_m > SHALLOW * float(depth_m.max()))
        if plain.youngs_modulus_Pa == 0.0 or not len(deep):
            return np.ones_like(depth_m)
        ratio = self.contact_N[self._plain, deep] / plain.elastic_force_N(depth_m[deep])
        return np.asarray(np.interp(self.motion.t_s, self.motion.t_s[deep], np.maximum(ratio, 0.0)))

    @cached_property
    def stiffness_N_per_m(self) -> Floats:
        """Slope of the contact force over the depth (n,), between the distances next to the plain one; 0 where only one is known."""
        k = self._plain
        low, high = max(k - 1, 0), min(k + 1, len(self.raised_m) - 1)
        way_m = self.raised_m[high] - self.raised_m[low]
        return np.abs(self.contact_N[low] - self.contact_N[high]) / way_m if way_m else np.zeros_like(self.contact_N[k])

    # the reading

    @cached_property
    def rest_N(self) -> Floats:
        """What the output has beyond contact and inertia (n,)."""
        return self.axes[2] - self._filtered(self._contact_and_inertia_N)

    @cached_property
    def _contact_and_inertia_N(self) -> Floats:
        return self.contact_N[self._plain] - self.constants.mass_kg * self.motion.az_m_per_s2

    def _filtered(self, column: Floats) -> Floats:
        return filtered(column, self._dt_s, self.constants.cutoff_Hz)

    @cached_property
    def _dt_s(self) -> Column:
        return steps(self.motion.t_s) if self.motion.dt_s is None else self.motion.dt_s

    def add_rest(self, s: "Span", wrench: tuple[str, ...]) -> None:
        """Add what the output has beyond contact and inertia, and what a change of the contact pushes to the side.

        Args:
            s: Samples whose contact and inertia are known.
            wrench: Names of the axes.
        """
        s.fz_N = s.fz_N + self.rest_N
        change_N = s.contact_N - self.contact_N[self._plain]
        for axis, share in self.sideways.items():
            setattr(s, wrench[axis], getattr(s, wrench[axis]) + share * change_N)

    def read(self, s: "Span", wrench: tuple[str, ...]) -> None:
        """From the load on the sensor to what it reads of it: the output, and what the filter passes of the change.

        Args:
            s: Samples whose load is known.
            wrench: Names of the axes.
        """
        for axis, name in enumerate(wrench):
            change = getattr(s, name) - (self._contact_and_inertia_N + self.rest_N if axis == 2 else 0.0)
            reading = self.axes.get(axis, 0.0)
            for parameter, value in s.constants.simulator.items():
                reading = reading + self.variations[parameter].change(axis, value)
            setattr(s, name, reading + self._filtered(change) if np.any(change) else reading)

    def refiltered(self, column: Floats, s: "Span") -> Floats:
        """A column that has passed the stated filter, as if it had passed that of the samples: the ratio of both.

        Args:
            column: Values (n,) of an axis.

        Returns:
            The values (n,) behind the other filter.
        """
        stated_Hz, cutoff_Hz = self.constants.cutoff_Hz, s.constants.cutoff_Hz
        if cutoff_Hz == stated_Hz:
            return column
        if not np.isfinite(cutoff_Hz):
            return unfiltered(column, self.motion.t_s, stated_Hz)
        ratio = cutoff_Hz / stated_Hz
        return ratio * column + (1.0 - ratio) * filtered(column, s.dt_s, cutoff_Hz)


def _between(levels: Floats, raised_m: Floats, at_m: Floats) -> Floats:
    """Values (n,) on straight lines between levels (k, n) that are known for the distances `raised_m` (k,); constant beyond their ends."""
    at_m = np.clip(at_m, raised_m[0], raised_m[-1])
    above = np.clip(np.searchsorted(raised_m, at_m), 1, len(raised_m) - 1)
    share = (at_m - raised_m[above - 1]) / (raised_m[above] - raised_m[above - 1])
    row = np.arange(len(at_m))
    return (1.0 - share) * levels[above - 1, row] + share * levels[above, row]


@dataclass(slots=True)
class Span:
    """Successive samples on their way from the motion of the tip to the reading of the sensor.

    All arrays are (n,); `t_s` counts from where histories began, `dt_s` is the step before each sample (one number where
    even), and `even_s` as in TipMotion. Lateral forces and torques stay plain 0.0 until something makes them. `slack_m` is the width of
    a play before the tip, and `behind_m` how far the tip is from where it were without it. `z_noise_m` and `az_noise_m_per_s2` are what a
    measured motion still carries of noise; 0 for a true one. `nominal` is what another simulator predicts of the nominal cell, None where
    palpd does. Laws of effects change these fields.
    """

    constants: Constants
    t_s: Floats
    dt_s: Column
    z_m: Floats
    vz_m_per_s: Floats
    az_m_per_s2: Floats
    z_noise_m: float = 0.0
    az_noise_m_per_s2: float = 0.0
    lead_s: Column = 0.0
    tip_m: Floats = None  # type: ignore[assignment]
    slack_m: float = 0.0
    behind_m: Column = 0.0
    surface_m: Column = 0.0
    depth_m: Floats = None  # type: ignore[assignment]
    contact_N: Floats = None  # type: ignore[assignment]
    fx_N: Column = 0.0
    fy_N: Column = 0.0
    fz_N: Floats = None  # type: ignore[assignment]
    tx_Nm: Column = 0.0
    ty_Nm: Column = 0.0
    tz_Nm: Column = 0.0
    even_s: float = 0.0
    nominal: NominalOutput | None = None

    def touch(self, surface_m: Column) -> None:
        """Put the surface at a height: depth and elastic force follow from where the tip is.

        A law that moves the surface calls this, so it must act before laws that change the force.

        Args:
            surface_m: Height of the surface in m, one number or (n,).
        """
        self.surface_m = surface_m
        self.depth_m = np.maximum(surface_m - self.tip_m, 0.0)
        self.contact_N = self.elastic_force_N(self.depth_m) if self.nominal is None else self.nominal.contact_force_N(self, surface_m)

    def elastic_force_N(self, depth_m: Floats) -> Floats:
        """Elastic force (n,) in N at other depths (n,) of the same moments, by Hertz: as stiff as the tissue is in a nominal prediction."""
        force_N = self.constants.elastic_force_N(depth_m)
        return force_N if self.nominal is None else force_N * self.nominal.over_hertz

    def push_sideways(self, fx_N: Column, fy_N: Column) -> None:
        """Add a lateral force at the tip: the sensor sees the force and its torque, tx = +fy L and ty = -fx L.

        Args:
            fx_N: Force along x in N, one number or (n,).
            fy_N: Force along y in N, one number or (n,).
        """
        arm_m = self.constants.tip_length_m
        self.fx_N = self.fx_N + fx_N
        self.fy_N = self.fy_N + fy_N
        self.tx_Nm = self.tx_Nm + fy_N * arm_m
        self.ty_Nm = self.ty_Nm - fx_N * arm_m
