"""The moving probe of every recording in one state of the cell: drivers, factors and columns of candidates in the bins."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import cos, sin

import numpy as np

from palpd.cell.cell_file import EffectValues
from palpd.cell.dynamics import lowpass, servo_heights
from palpd.cell.effects.drivers import Driver, DriverState, FactorName, driver_values, factor_values
from palpd.cell.effects.learned import ChannelName
from palpd.cell.simulation import capture, commanded_motion
from palpd.gap.assumptions import ASSUMED
from palpd.gap.data.noise import CHANNELS, FZ, Z, resolutions
from palpd.gap.data.phases import Ints
from palpd.gap.data.prepare import PreparedRecording
from palpd.gap.data.rounding import sawtooth
from palpd.gap.gaussian.nuisance_space import whitened
from palpd.gap.laws.bases import Basis
from palpd.gap.laws.formulas import Formula
from palpd.gap.model.problem import Problem, return_memory
from palpd.tick import Floats

LATERAL = "lateral"


LEAST_HARMONIC = 0.02
"""Least amplitude of each harmonic of the error of rounded readings after the first, in steps."""
MOST_FILTERED = 600_000
"""Largest number of values that are filtered at once: a filter needs ten times their memory, and of a million rows there are 8 million."""


@dataclass(frozen=True)
class LawCandidate:
    """A term that a law may have: factor × curve(driver) in a channel.

    Attributes:
        channel: A channel, or LATERAL for a force at the tip to the side.
        basis: Curve or formula over the driver.
        price: Nats that are subtracted from its evidence, more for a rarer kind.
        azimuth_rad: Direction of a force to the side, from x to y.
    """

    channel: str
    factor: FactorName
    basis: Basis | Formula
    price: float
    azimuth_rad: float = 0.0

    @property
    def driver(self) -> Driver:
        """The argument of the curve."""
        return self.basis.driver

    @property
    def name(self) -> tuple[str, str, Driver]:
        """What the term says, whatever its curve: channel, factor, driver."""
        return self.channel, self.factor, self.driver

    def weights(self, tip_length_m: float) -> dict[ChannelName, float]:
        """Weight of every channel on which the term acts.

        Args:
            tip_length_m: Arm of a force to the side.
        """
        if self.channel != LATERAL:
            return {self.channel: 1.0}  # type: ignore[dict-item]
        c, s = cos(self.azimuth_rad), sin(self.azimuth_rad)
        return {"fx_N": c, "fy_N": s, "tx_Nm": s * tip_length_m, "ty_Nm": -c * tip_length_m}


@dataclass(frozen=True)
class Scene:
    """The recordings of a problem, simulated in one state of the cell.

    Attributes:
        contact: The moving probe at the steps of every recording.
        robot: The nominal follower of the command in every recording; None in a recording whose heights are not compared.
        rest_speed_m_per_s: Speed at which friction turns over.
    """

    problem: Problem
    contact: tuple[DriverState, ...]
    robot: tuple[DriverState | None, ...]
    rest_speed_m_per_s: float
    _drivers: dict[tuple[bool, Driver], Floats] = field(default_factory=dict, repr=False)

    @staticmethod
    def of(problem: Problem, effects: EffectValues, eta: Floats) -> "Scene":
        """Simulate the recordings.

        Args:
            effects: Parameters θ by effect.
            eta: Shared deviations η (11,) in standard deviations.
        """
        return_memory()
        cell, library = problem.cell_at(effects, eta), problem.library
        speeds = np.concatenate([np.abs(one.motion.vz_m_per_s) for one in problem.recordings])
        rest = min(ASSUMED.laws.rest_speed_m_per_s, max(ASSUMED.laws.rest_speed_share * float(np.quantile(speeds, 0.95)), 1e-12))

        def contact(one: PreparedRecording) -> DriverState:
            span = capture(cell, library, "probe", lambda c, known: one.reading(c, one.motion, known))
            return DriverState.of_contact(span, rest)

        def robot(one: PreparedRecording) -> DriverState | None:
            z_cmd_m = one.z_cmd_m
            if not one.judged[Z] or z_cmd_m is None:
                return None
            start = one.state_at(float(one.robot_t_s[0]))
            span = capture(cell, library, "robot", lambda c, known: commanded_motion(c, one.robot_t_s, z_cmd_m, known, start=start))
            return DriverState.of_robot(span, rest)

        states, followers = (tuple(of(one) for one in problem.recordings) for of in (contact, robot))
        return Scene(problem, states, followers, rest)  # type: ignore[arg-type]

    def with_rest_speed(self, rest_speed_m_per_s: float) -> "Scene":
        """The same recordings with another speed at which friction turns over."""
        contact = tuple(replace(one, rest_speed_m_per_s=rest_speed_m_per_s) for one in self.contact)
        robot = tuple(one and replace(one, rest_speed_m_per_s=rest_speed_m_per_s) for one in self.robot)
        return Scene(self.problem, contact, robot, rest_speed_m_per_s)

    @cached_property
    def shallow_m(self) -> float:
        """Distance from the surface below which it counts in proportion, and above which by its logarithm."""
        return max(ASSUMED.laws.shallow_share * max(float(state.depth_m.max()) for state in self.contact), 1e-9)

    @cached_property
    def duration_s(self) -> float:
        """Duration of the longest recording."""
        return max(float(state.t_s[-1] - state.t_s[0]) for state in self.contact)

    def _means(
        self,
        channel: str,
        of: Callable[[DriverState], Floats],
        behind: Callable[[DriverState, Floats], Floats] = lambda _, values: values,
    ) -> Floats:
        """Means over the bins (b, ...) of what is computed at the steps of every recording; zero where heights are not compared.

        `behind` filters columns (n, k); only a few are passed at once, so that memory suffices.
        """
        out = []
        for one, contact, robot in zip(self.problem.recordings, self.contact, self.robot, strict=True):
            state, means = (contact, one.step_means) if channel != "z_m" else (robot, one.z_means)
            if state is None:
                out.append(np.zeros((len(one.bins), *of(contact).shape[1:])))
                continue
            values = of(state)
            width = max(1, MOST_FILTERED // len(values))
            if values.ndim == 1 or values.shape[1] <= width:
                out.append(means @ behind(state, values))
            else:
                parts = [values[:, k : k + width] for k in range(0, values.shape[1], width)]
                out.append(np.hstack([means @ behind(state, part) for part in parts]))
        return np.concatenate(out)

    def driver(self, channel: str, driver: Driver) -> Floats:
        """Values of a driver in the bins.

        Args:
            channel: `z_m` has the drivers of the follower, all other channels those of the contact.

        Returns:
            Values (b,) in SI units.
        """
        key = channel == "z_m", driver
        if key not in self._drivers:
            self._drivers[key] = self._means(channel, lambda state: driver_values(driver, state, {}))
        return self._drivers[key]

    def factor(self, channel: str, name: FactorName) -> Floats:
        """Values of a factor in the bins.

        Args:
            channel: As in `driver`.

        Returns:
            Values (b,) in SI units.
        """
        return self._means(channel, lambda state: factor_values(name, state))

    def columns(self, candidate: LawCandidate) -> dict[int, Floats]:
        """Columns X: what each coefficient of a candidate changes, after all filters of sensor or servo.

        Returns:
            Columns (b, m) by channel, in the units of the channels.
        """
        cutoff_Hz, robot = self.problem.cell.sensor.filter_cutoff_Hz, self.problem.cell.robot

        def filtered(state: DriverState, values: Floats) -> Floats:
            def each(column: Floats) -> Floats:
                if candidate.channel != "z_m":
                    return lowpass(column, state.dt_s, -2.0 * np.pi * cutoff_Hz, {}) if cutoff_Hz else column
                if candidate.driver.acts_on_target:
                    return servo_heights(column, state.dt_s, robot.servo_natural_frequency_Hz, robot.servo_damping_ratio)
                return column

            # Filters over uneven steps take one column at a time.
            return each(values) if np.ndim(state.dt_s) == 0 else np.stack([each(column) for column in values.T], axis=-1)

        values = self.unfiltered(candidate, filtered)
        weights = candidate.weights(self.problem.cell.probe.tip_length_m)
        return {CHANNELS.index(name): weight * values for name, weight in weights.items() if self.judged(CHANNELS.index(name))}

    def unfiltered(self, candidate: LawCandidate, behind: Callable[[DriverState, Floats], Floats] = lambda _, values: values) -> Floats:
        """Factor times basis in the bins, columns (b, m).

        Args:
            behind: Filters columns (n, k) at the steps of a recording, before the means over the bins.
        """

        def at_steps(state: DriverState) -> Floats:
            columns = candidate.basis.columns(driver_values(candidate.driver, state, {}))
            columns *= factor_values(candidate.factor, state)[:, None]
            return columns

        return self._means(candidate.channel, at_steps, behind)

    def judged(self, channel: int) -> bool:
        """Whether any recording compares a channel."""
        return any(one.judged[channel] for one in self.problem.recordings)

    def strokes(self, folds: int) -> Ints:
        """Number of the fold (b,) of every bin: strokes, each with the rest after it, are dealt out at random, always in the same way."""
        stroke, first = [], 0
        for one in self.problem.recordings:
            begins = np.diff(one.phases.moving.astype(int), prepend=0) > 0
            mine = one.bins.label(np.cumsum(begins))
            if mine.max() < 2 * folds:  # too few strokes: equal stretches of time take their place
                mine = (np.arange(len(mine)) * 4 * folds) // len(mine)
            stroke.append(mine + first)
            first += int(mine.max()) + 1
        dealt = np.random.default_rng(0).permutation(first) % folds
        return np.asarray(dealt[np.concatenate(stroke)])


def rounding_columns(problem: Problem, fitted: Floats) -> dict[int, Floats]:
    """Nuisances for the mean error of rounded readings, Σ q/kπ e^(-2(πkσ/q)²) sin(2πkf/q) with any phases; q is the step of fz.

    Otherwise the levels that a slow press crosses look like a law that repeats over the height.

    Args:
        fitted: Fitted readings (7, b) in the units of the channels, with all deviations: the force between two levels must be known.

    Returns:
        Whitened columns (b, 2k) by channel, each times the standard deviation of its coefficient; empty if readings are not rounded.
    """
    rounding, step_N = problem.rounding, float(resolutions(problem.cell)[FZ])
    if step_N <= 0.0:
        return {}
    square = float(max(one.noise_rms[FZ] for one in problem.recordings)) ** 2
    noise_rms_N = rounding.noise_rms_N if rounding is not None else max(square - step_N**2 / 12.0, 0.0) ** 0.5
    turn = 2.0 * np.pi * fitted[FZ] / step_N
    columns = []
    for k, size_N in enumerate(sawtooth(step_N, noise_rms_N).tolist(), start=1):
        if k == 1 or size_N > LEAST_HARMONIC * step_N:
            columns += [size_N * np.sin(k * turn), size_N * np.cos(k * turn)]
    return whitened(problem.noise, {FZ: np.array(columns).T})
