"""How clearly an effect shows in one cell: its signal-to-noise ratio beside what tolerances and press scatter can hide."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import least_squares

from palpd.blind.drawn_cells import TOLERANCES, CellRealisation, Deviations, PressedMotion
from palpd.blind.laws import LIBRARY_LAWS, CellScales, Floats, Ints, Law, Planted, Shape, SimulatedRun
from palpd.blind.simulated_run import rows, simulate
from palpd.blind.stated_cell import CHANNELS, PHASES
from palpd.blind.truth import NearestLaw

FINE_HZ = 2400.0
"""Least rate of the fine grid: more than twice that of the fastest recording. The grid takes the next multiple of a recording's rate."""
BIN_S = 0.02
"""Length of the means over which the SNR is counted; shorter than any phase of a motion."""
COARSE_HZ = 500.0
"""Grid of the search for the nearest law, which needs thousands of simulations and no more than two digits."""
LOOSE = 0.25
"""Largest relative error of a signal-to-noise ratio that no strength meets better."""
SHAPES_DRAWN, SHAPES_FITTED = 4, 6
"""Number of shapes that are drawn of each law, and of starts that are fitted in all parameters."""
SHAPES_OF_ONE, FITTED_OF_ONE = 8, 3
"""The same where one law is asked for and its parameters count: a start in the wrong form of it ends at a law that is not the nearest."""


class Detectability:
    """One cell, within its tolerances, on one motion: what effects change in its gap, and how large that is."""

    def __init__(self, cell: CellRealisation, deviations: Deviations, motion: PressedMotion, t_s: Floats, fine_Hz: float = FINE_HZ) -> None:
        self.cell, self.deviations, self.motion, self.t_s = cell, deviations, motion, t_s
        self.dt_s = 1.0 / (cell.rate_Hz * np.ceil(fine_Hz / cell.rate_Hz))
        self.plain = simulate(cell, deviations, motion, dt_s=self.dt_s)
        self.plain_rows = rows(self.plain, t_s)

    def run(self, planted: Sequence[Planted]) -> SimulatedRun:
        """The cell with these effects, through its servo."""
        return simulate(self.cell, self.deviations, self.motion, planted, dt_s=self.dt_s)

    def change(self, planted: Sequence[Planted]) -> Floats:
        """What the effects change in measured minus predicted, row by row (m, 7).

        Heights are compared with the servo's, wrenches with those of a cell without the effects that makes the same motion.

        Returns:
            The change (m, 7), columns as in CHANNELS.
        """
        w = self.run(planted)
        here = rows(w, self.t_s, planted)
        moved = float(np.abs(w.z_m - self.plain.z_m).max()) > 0.0
        without = rows(self._same_motion(w), self.t_s) if moved else self.plain_rows
        return np.column_stack([here[:, 0] - self.plain_rows[:, 0], here[:, 1:] - without[:, 1:]])

    def _same_motion(self, w: SimulatedRun) -> SimulatedRun:
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
        """20 ms means over all channels, in sensor sigmas of such a mean.

        Args:
            change: A change, row by row (m, 7).

        Returns:
            The means, one channel after another (7k,).
        """
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
        """The change with tolerances and press scatter projected out, as far as they can hide it.

        Args:
            change: A change, row by row (m, 7).

        Returns:
            Whitened means (7k,); their norm is the SNR.
        """
        u, weight = self._nuisances
        x = self.means(change)
        return np.asarray(x + u @ (weight * (u.T @ x)))

    def snr(self, change: Floats) -> float:
        """Signal-to-noise ratio of a change beside tolerances and press scatter.

        Args:
            change: A change, row by row (m, 7).

        Returns:
            Norm over the 20 ms means of all channels, in sensor sigmas.
        """
        return float(np.linalg.norm(self.whitened(change)))

    @cached_property
    def phases(self) -> Ints:
        """The phase of every row (m,), index into PHASES."""
        v = np.gradient(self.motion.at(self.t_s), self.t_s)
        moving = np.abs(v) > min(1e-3, 0.05 * float(np.percentile(np.abs(v), 95)))
        contact = self.plain_rows[:, 0] < self.cell.surface_z_m
        return np.where(contact, np.where(moving, np.where(v < 0, 2, 4), 3), np.where(moving, 1, 0))

    def sizes(self, change: Floats) -> Floats:
        """Size of a change by channel and phase: its rms over that of noise, rounding, scatter and tolerances.

        Args:
            change: A change, row by row (m, 7).

        Returns:
            Sizes (7, 5), as in CHANNELS and PHASES.
        """
        out = np.zeros((len(CHANNELS), len(PHASES)))
        for p in range(len(PHASES)):
            here = self.phases == p
            if here.any():
                floor2 = self.cell.sigmas**2 + sum(np.mean(x[here] ** 2, axis=0) for x in self.tangents)
                out[:, p] = np.sqrt(np.mean(change[here] ** 2, axis=0) / floor2)
        return out


@dataclass(frozen=True)
class FittedLaw:
    """A law at a strength, with the change (m, 7) that it makes and its SNR; both None for a law that changes scatter and not the mean."""

    law: Law
    parameters: Shape
    change: Floats | None
    snr: float | None


def fit_strength(detectability: Detectability, law: Law, shape: Shape, snr: float) -> FittedLaw | None:
    """Scale a law until its change has the wanted SNR.

    Args:
        detectability: The cell and motion that show the effect.
        shape: Its drawn shape.
        snr: Wanted signal-to-noise ratio.

    Returns:
        The fit, or None where this cell cannot show the effect at that size.
    """
    strength = 0.3
    for _ in range(9):
        parameters = law.at(shape, strength)
        change = detectability.change([(law, parameters)])
        # Tolerances only make a change smaller. Where it is too small without them, they need not be simulated to know the next strength.
        now = float(np.linalg.norm(detectability.means(change)))
        if now >= (1.0 - LOOSE) * snr or _next_strength(law, strength, snr, now) < law.strongest:
            now = detectability.snr(change)
        if not np.isfinite(now):
            return None
        if abs(now - snr) < 0.04 * snr:
            return FittedLaw(law, parameters, change, now)
        if strength >= law.strongest and now < snr:
            return None
        strength = _next_strength(law, strength, snr, now)
    return FittedLaw(law, parameters, change, now) if abs(now - snr) < LOOSE * snr else None


def _next_strength(law: Law, strength: float, snr: float, now: float) -> float:
    return min(strength * float(np.clip(snr / max(now, 1e-9), 0.1, 20.0)), law.strongest)


def nearest_law(
    detectability: Detectability,
    target: Floats,
    scales: CellScales,
    seed: int,
    *,
    without: Sequence[str] = (),
    only: str | None = None,
    like: Shape | None = None,
) -> NearestLaw:
    """Find the listed law that explains a change best.

    Shapes are drawn, strengths fitted in proportion; the best ones are then fitted in all their parameters.

    Args:
        target: The whitened change (7k,).
        scales: Characteristic sizes of the cell.
        without: Effects that may not be used.
        only: The one effect that may be used; None: all.
        like: Parameters of the law that made the change; one start takes those that the listed law has too. None: all starts are
            drawn.

    Returns:
        Effect (empty where none helps), parameters, and the SNR of the residual that it leaves.
    """
    random = np.random.default_rng(seed)
    tried: list[tuple[float, Law, Shape, float]] = []
    for law in LIBRARY_LAWS:
        if law.variance or law.effect in without or only not in (None, law.effect):
            continue
        for k in range(SHAPES_DRAWN if only is None else SHAPES_OF_ONE):
            shape = law.draw(random, scales)
            if k == 0 and like is not None:
                shape = shape | {name: like[name] for name in shape.keys() & like.keys()}
            x = detectability.whitened(detectability.change([(law, law.at(shape, 0.5))]))
            fit = float(x @ target) / max(float(x @ x), 1e-30)
            if fit > 0.0:
                strength = min(0.5 * fit, law.strongest)
                tried.append((float(np.linalg.norm(target - x * strength / 0.5)), law, shape, strength))
    best = NearestLaw(id="", parameters={}, snr_left=float(np.linalg.norm(target)))
    for left, law, shape, strength in sorted(tried, key=lambda x: x[0])[: SHAPES_FITTED if only is None else FITTED_OF_ONE]:
        fitted = _fitted(detectability, target, law, shape, strength, left)
        if fitted["snr_left"] < best["snr_left"]:
            best = fitted
    return best


def _fitted(detectability: Detectability, target: Floats, law: Law, shape: Shape, strength: float, left: float) -> NearestLaw:
    """A law fitted to a change in its strength and shape, from a start that leaves `left`."""
    names = [name for name, value in shape.items() if value != 0.0]

    def at(q: Floats) -> Shape:
        moved = {n: shape[n] + v if n.endswith("_rad") else shape[n] * float(np.exp(v)) for n, v in zip(names, q[1:], strict=True)}
        return law.at(shape | moved, min(strength * float(np.exp(q[0])), law.strongest))

    def miss(q: Floats) -> Floats:
        return detectability.whitened(detectability.change([(law, at(q))])) - target

    n = 1 + len(names)
    fitted = least_squares(miss, np.zeros(n), bounds=(-2.5, 2.5), diff_step=np.full(n, 0.02), max_nfev=10, x_scale=0.5)
    snr_left = float(np.sqrt(2.0 * fitted.cost))
    parameters = at(fitted.x) if snr_left < left else law.at(shape, strength)
    return NearestLaw(id=law.effect, parameters={name: float(x) for name, x in parameters.items()}, snr_left=min(left, snr_left))


def scales_of(detectability: Detectability) -> CellScales:
    """Characteristic sizes of a cell on its motion."""
    cell, plain, z = detectability.cell, detectability.plain, detectability.plain.z_m
    stroke_m = float(np.ptp(z))
    cutoff_Hz = cell.filter_cutoff_Hz or 0.3 * cell.rate_Hz
    return CellScales(
        force_N=float(plain.contact_N.max()) or float(np.percentile(np.abs(plain.wrench[:, 2]), 99.0)),
        depth_m=max(float(plain.depth_m.max()), 1e-3 * stroke_m),  # without a tissue there is no depth to scale by
        stroke_m=stroke_m,
        speed_m_per_s=float(np.abs(detectability.plain.vz_m_per_s).max()),
        acceleration_m_per_s2=float(np.abs(detectability.plain.az_m_per_s2).max()),
        duration_s=float(detectability.t_s[-1]),
        noise_N=cell.noise_rms_N,
        step_N=cell.resolution_fz_N,
        rate_Hz=cell.rate_Hz,
        mass_kg=cell.mass_kg,
        tip_radius_m=cell.tip_radius_m,
        tip_length_m=cell.tip_length_m,
        cutoff_Hz=min(cutoff_Hz, 0.3 * cell.rate_Hz),
        servo_Hz=cell.servo_natural_frequency_Hz,
        servo_damping=cell.servo_damping_ratio,
        presses=detectability.motion.presses,
    )
