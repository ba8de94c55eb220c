"""What a cell did while it was healthy, learned from its recordings: the nominal for what it does now.

The simulated cell leaves a residual also where the cell is healthy: friction that depends on the height, a servo of another order, a
relaxation. Here that residual is a sum of curves, over height, direction, speed and inertia, and of forces that remember the load, with
weights as far as the recordings support them (a linear model with Gaussian weights, whose variances maximise the evidence; MacKay 1992).
Palpd's prediction and this sum are a simulator like a user's own, so effects act on it in physical order (`palpd.cell.span`).

A nominal that was learned is uncertain. A diagnosis may change the prediction by the errors of the weights, and by what they differ from
recording to recording, or between the parts of a single one. Beyond the heights and speeds of the healthy recordings nothing is judged.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.special import stdtrit

from palpd.cell.cell_file import MASS_TOLERANCE, CellFile, Tolerances
from palpd.cell.dynamics import lowpass, play, steps
from palpd.cell.effects import Effect
from palpd.cell.physics import physics
from palpd.cell.simulation import predict_motion, wrench_of
from palpd.cell.span import Constants, TipMotion
from palpd.cell.tip_motion import estimate_tip_motion
from palpd.errors import RecordingError
from palpd.gap.beside_healthy import FRICTION
from palpd.gap.data.noise import CHANNELS, FZ, Z, declared_rms
from palpd.gap.data.phases import Ints
from palpd.gap.user_simulator import CONTACT_COLUMN, MotionColumns, OwnParameter, SimulatorDoubt, UserSimulator, asked
from palpd.recording.oddities import dead
from palpd.recording.samples import WRENCH_COLUMNS, Samples
from palpd.tick import Floats

KNOTS, AT_SURFACE, SPEED_KNOTS = 40, 20, 9
"""Knots of the curves over the stroke, over the heights near the surface, and over the speed."""
NEAR = 0.25
"""How far from the surface is near, in depths of the deepest press."""
INTERVALS = 24
"""Intervals of height in which readings are compared with what was learned of them."""
BLOCK_S = 0.02
"""Readings are averaged over this time: no term changes faster."""
MOST_OF_STROKE = 0.05
"""Error of predicted heights, as a share of the stroke, above which a servo was not understood, and heights are not judged."""
MEMORIES_S = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
"""Time constants of forces that remember the load."""
DELAYS_S = (0.01, 0.03, 0.1, 0.3, 1.0)
"""Time constants of the height's errors."""
PLAYS, PRESLIDING = (0.0, 0.01, 0.03, 0.08), (3e-4, 3e-3, 3e-2)
"""Widths of a play, and lengths over which a force builds up after a reversal behind it, as shares of the stroke."""
TURNS = (0.005, 0.03)
"""Speeds at which a direction turns over, as shares of the largest."""
BEYOND = 0.03
"""Share of the stroke, and of the largest speed, by which a motion may leave that of the healthy recordings and still be judged."""
MOST_ALIKE = 0.98
"""Largest correlation of neighbouring errors that counts."""
PARTS = 4
"""Parts of a single recording that take the place of several."""
ROUNDS = 12
"""Rounds in which the variances of the weights are estimated."""
RUBS = ("direction", "reversal", "speed")
"""First words of the terms of fz that act against a motion."""
LEAST_OTHER_WAY = 0.05
"""Share of the rows that move the other way, below which a motion goes one way."""
MOST_ERRORS = 24
"""Errors of the weights that count: those that change the prediction most."""


@dataclass(frozen=True)
class _Motions:
    """What the curves are drawn over: their knots, and what the healthy motions reached."""

    heights_m: Floats
    speeds_m_per_s: Floats
    stroke_m: float
    largest_m_per_s: float

    @staticmethod
    def of(motions: Sequence[MotionColumns], surface_m: float) -> "_Motions":
        z_m, speed = (np.concatenate([one[name] for one in motions]) for name in ("z_m", "vz_m_per_s"))
        stroke_m, largest = float(np.ptp(z_m)), float(np.abs(speed).max())
        if not stroke_m > 0.0:
            raise RecordingError("nothing moves in the healthy recordings; record strokes and presses of the healthy cell")
        knots, deepest_m = np.linspace(z_m.min(), z_m.max(), KNOTS), surface_m - float(z_m.min())
        if 0.0 < deepest_m < stroke_m:
            near_m = np.linspace(surface_m - NEAR * deepest_m, min(surface_m + NEAR * deepest_m, z_m.max()), AT_SURFACE)
            knots = np.unique(np.concatenate([knots, near_m]))
        return _Motions(knots, np.linspace(-largest, largest, SPEED_KNOTS), stroke_m, largest)

    def interval(self, z_m: Floats) -> Ints:
        """Number of the interval of height (n,), 0 to INTERVALS - 1."""
        share = (z_m - self.heights_m[0]) / self.stroke_m
        return np.clip((INTERVALS * share).astype(int), 0, INTERVALS - 1)

    def both_ways(self, motions: Sequence[MotionColumns]) -> bool:
        """Whether they move up and down: else what rubs cannot be told from what depends on the height."""
        speed, least = np.concatenate([motion["vz_m_per_s"] for motion in motions]), TURNS[-1] * self.largest_m_per_s
        return min(float(np.mean(speed > least)), float(np.mean(speed < -least))) > LEAST_OTHER_WAY

    def known(self, motion: MotionColumns) -> NDArray[np.bool_]:
        """Whether a motion stays within the healthy ones (n,)."""
        beyond_m, faster = BEYOND * self.stroke_m, (1.0 + BEYOND) * self.largest_m_per_s
        inside = (motion["z_m"] > self.heights_m[0] - beyond_m) & (motion["z_m"] < self.heights_m[-1] + beyond_m)
        return np.asarray(inside & (np.abs(motion["vz_m_per_s"]) < faster))


def _hats(x: Floats, knots: Floats) -> Floats:
    """Weights (n, k) of linear interpolation between knots, held at their ends."""
    return np.array([np.interp(x, knots, row) for row in np.eye(len(knots))]).T


class _Piece(NamedTuple):
    """One recording in means over BLOCK_S (b,): terms (b, p), residual, time and interval of height."""

    terms: Floats
    residual: Floats
    t_s: Floats
    interval: Ints


@dataclass(frozen=True)
class _Weights:
    """Weights of the terms of one channel.

    Attributes:
        mean: Most probable weights (p,).
        covariance: Of their errors (p, p).
        between: Differences of the weights (m, p), each one standard deviation of a spread between recordings.
        unexplained: Rms of means over BLOCK_S that neither terms nor noise explain, in the unit of the channel, in intervals of the
            height (i,).
    """

    mean: Floats
    covariance: Floats
    between: Floats
    unexplained: Floats


@dataclass(frozen=True)
class HealthyCell:
    """A healthy cell as its recordings show it.

    Attributes:
        cell: The cell file; its effects are part of what was healthy.
        library: Effects of that cell by id.
        recordings: How many there were.
        friction_N: Own friction that a tenth of their samples exceeds.
    """

    cell: CellFile
    library: Mapping[str, Effect]
    recordings: int
    motions: _Motions
    weights: Mapping[int, _Weights]
    friction_N: float = 0.0

    @staticmethod
    def of(recordings: Sequence[Samples], cell: CellFile, library: Mapping[str, Effect]) -> "HealthyCell":
        """Learn a healthy cell.

        Args:
            cell: Its cell file; the numbers need not be right.
            library: Effects of that cell by id.

        Raises:
            RecordingError: Nothing moves in the recordings, fz is dead in them, or there is none.
        """
        if not recordings:
            raise RecordingError("no healthy recording was given; at least one is needed")
        if all(dead(one.wrench[:, FZ - 1]) for one in recordings):
            raise RecordingError("fz_N never changes in the healthy recordings; check that the sensor is alive, and record again")
        motions = [asked(estimate_tip_motion(cell, one.t_s, one.z_m, one.vz_m_per_s, one.z_cmd_m), one.z_cmd_m) for one in recordings]
        empty = HealthyCell(cell, library, len(recordings), _Motions.of(motions, physics(cell, None, library).constants.surface_z_m), {})
        plain = [empty.plain(motion) for motion in motions]
        blocks = [max(1, round(BLOCK_S * one.rate_Hz)) for one in recordings]
        forces = [_blocks(empty.terms(motion, FZ), block) for motion, block in zip(motions, blocks, strict=True)]
        force_groups, weights = empty.groups(motions[0], FZ), {}
        for channel, name in enumerate(CHANNELS):
            measured = [one.z_m if channel == Z else one.wrench[:, channel - 1] for one in recordings]
            if all(dead(values) for values in measured) or (channel == Z and any(one.z_cmd_m is None for one in recordings)):
                continue
            pieces = [
                _Piece(
                    forces[k] if channel != Z else _blocks(empty.terms(motion, channel), block),
                    _blocks(measured[k] - plain[k][name], block),
                    _blocks(motion["t_s"], block),
                    empty.motions.interval(_blocks(motion["z_m"], block)),
                )
                for k, (motion, block) in enumerate(zip(motions, blocks, strict=True))
            ]
            noise = float(declared_rms(cell)[channel])
            # Recordings are tared, so each zero is small; that of the heights does not move.
            zero, drift_per_s = {
                Z: (1e-3 * noise, 1e-6 * noise),
                FZ: (cell.tolerances.bias_N, cell.tolerances.drift_N_per_min / 60.0),
            }.get(channel, (0.4 * noise, 1e-3 * noise))
            groups = empty.groups(motions[0], Z) if channel == Z else force_groups
            learned = _learned(pieces, groups, noise / blocks[0] ** 0.5, zero, drift_per_s)
            if channel != Z or float(learned.unexplained.max()) < MOST_OF_STROKE * empty.motions.stroke_m:
                weights[channel] = learned
        learned_cell = replace(empty, weights=weights)
        if FZ not in weights or not empty.motions.both_ways(motions):
            return learned_cell
        rubbing_N = [learned_cell.own_friction_N(motion) for motion in motions]
        return replace(learned_cell, friction_N=float(np.quantile(np.abs(np.concatenate(rubbing_N)), 0.9)))

    def plain(self, motion: MotionColumns) -> dict[str, Floats]:
        """What palpd predicts for a motion, by channel (n,)."""
        tip = TipMotion(motion["t_s"], motion["z_m"], motion["vz_m_per_s"], motion["az_m_per_s2"])
        wrench = wrench_of(self.cell, tip, self.library)
        columns = {name: wrench[:, axis] for axis, name in enumerate(WRENCH_COLUMNS)}
        if "z_cmd_m" in motion:
            columns["z_m"] = predict_motion(self.cell, motion["t_s"], motion["z_cmd_m"], self.library)
        return columns

    # the terms

    def terms(self, motion: MotionColumns, channel: int) -> Floats:
        """The terms of a channel (n, p)."""
        return np.hstack(list(self._named_terms(motion, channel).values()))

    def groups(self, motion: MotionColumns, channel: int) -> list[int]:
        """Numbers of terms that share a variance, in their order."""
        return [terms.shape[1] for terms in self._named_terms(motion, channel).values()]

    def _named_terms(self, motion: MotionColumns, channel: int) -> dict[str, Floats]:
        if channel == Z:
            return self._servo_terms(motion)
        dt_s, z_m, v, a = steps(motion["t_s"]), motion["z_m"], motion["vz_m_per_s"], motion["az_m_per_s2"]
        directions = [np.tanh(v / (share * self.motions.largest_m_per_s))[:, None] for share in TURNS]
        heights = _hats(z_m, self.motions.heights_m)
        contact_N = self._contact_N(motion)
        slow = np.array([lowpass(contact_N, dt_s, -1.0 / tau_s, {}) for tau_s in MEMORIES_S]).T
        deepest_m = np.maximum.accumulate(np.maximum(self.surface_m - z_m, 0.0)) if np.isfinite(self.surface_m) else np.zeros_like(z_m)
        share = np.maximum(self.surface_m - z_m, 0.0) / np.maximum(deepest_m, 1e-300) if deepest_m.any() else np.zeros_like(z_m)
        built = np.array([self._built_up(z_m, width, length) for width in PLAYS for length in PRESLIDING]).T
        swing = np.array([lowpass(a, dt_s, -1.0 / tau_s, {}) for tau_s in DELAYS_S[:3]]).T
        return {
            "height": heights,
            "level": np.ones((len(z_m), 1)),
            **{f"direction, {share:g}": heights * direction for share, direction in zip(TURNS, directions, strict=True)},
            "reversal": built,
            "reversal at speed": built * (np.abs(v) / self.motions.largest_m_per_s)[:, None],
            "speed": _hats(v, self.motions.speeds_m_per_s),
            "inertia": np.column_stack([a, swing]),
            "memory": contact_N[:, None] - slow,
            "presses": (contact_N * (1.0 - share**2))[:, None],
        }

    def _built_up(self, z_m: Floats, width: float, length: float) -> Floats:
        """A share (n,) from -1 to 1 that builds up over a length after each reversal, behind a play."""
        moved_m = play(z_m, width * self.motions.stroke_m, {})
        length_m = length * self.motions.stroke_m
        return np.asarray((moved_m - play(moved_m, 2.0 * length_m, {})) / length_m)

    def _servo_terms(self, motion: MotionColumns) -> dict[str, Floats]:
        t_s, z_cmd_m = motion["t_s"], motion["z_cmd_m"]
        z_m = self.plain(motion)["z_m"]
        behind_m = z_cmd_m - z_m
        speed = np.gradient(z_m, t_s)
        late = np.array([lowpass(behind_m, steps(t_s), -1.0 / tau_s, {}) for tau_s in DELAYS_S]).T
        directions = np.array([np.tanh(speed / (share * self.motions.largest_m_per_s)) for share in TURNS]).T
        return {
            "late": np.column_stack([behind_m, late]),
            "speed": np.column_stack([speed, np.gradient(speed, t_s), np.gradient(np.gradient(speed, t_s), t_s)]),
            "direction": directions,
            "height": _hats(z_m, self.motions.heights_m),
        }

    @cached_property
    def _constants(self) -> Constants:
        return physics(self.cell, None, self.library).constants

    @property
    def surface_m(self) -> float:
        """Height of the surface as its cell file states it; -inf without tissue."""
        return self._constants.surface_z_m

    def _contact_N(self, motion: MotionColumns) -> Floats:
        """Force of the contact (n,) as palpd has it."""
        depth_m = np.maximum(self.surface_m - motion["z_m"], 0.0)
        return self._constants.elastic_force_N(depth_m)

    # the simulator

    def simulator(self) -> UserSimulator:
        """A simulator of the healthy cell that can be asked for any motion."""
        rubs = (OwnParameter(FRICTION, 0.0, -self.friction_N, self.friction_N),) if self.friction_N > 0.0 else ()
        return UserSimulator("the healthy cell", self.predict, any_motion=True, parameters=rubs, doubt=self.doubt, about=self._about())

    def predict(self, motion: MotionColumns, friction: float = 0.0) -> dict[str, Floats]:
        """What the healthy cell reports on a motion, by column (n,), with the force of its contact.

        Args:
            friction: How much more it rubs, in N, by the curve of its own friction.
        """
        plain, named = self.plain(motion), self._named_terms(motion, FZ)
        out = {CHANNELS[channel]: terms @ weights.mean for channel, weights, terms in self._weighed(motion, np.hstack([*named.values()]))}
        out = {name: plain[name] + values for name, values in out.items()} | {CONTACT_COLUMN: self._contact_of(motion, named)}
        if friction:
            out[CHANNELS[FZ]] += friction / self.friction_N * self._friction_N(motion, named)
        return out

    def own_friction_N(self, motion: MotionColumns) -> Floats:
        """What acts against a motion (n,), of fz: what was learned of directions, reversals and speeds, and the stated friction."""
        return self._friction_N(motion, self._named_terms(motion, FZ))

    def _friction_N(self, motion: MotionColumns, named: Mapping[str, Floats]) -> Floats:
        mean = self._mean_of(named)
        learned_N = np.sum([terms @ mean[name] for name, terms in named.items() if name.startswith(RUBS)], axis=0)
        others = {name: values for name, values in self.cell.effects.items() if name != "cable.friction"}
        if others == self.cell.effects:
            return np.asarray(learned_N)
        without = replace(self, cell=self.cell.with_effects(others))
        return learned_N + self.plain(motion)[CHANNELS[FZ]] - without.plain(motion)[CHANNELS[FZ]]

    def _weighed(self, motion: MotionColumns, forces: Floats) -> Iterator[tuple[int, _Weights, Floats]]:
        """Each learned channel of a motion with its weights and terms; `forces` (n, p) are those that all forces share."""
        for channel, weights in self.weights.items():
            if channel != Z:
                yield channel, weights, forces
            elif "z_cmd_m" in motion:
                yield channel, weights, self.terms(motion, Z)

    def _mean_of(self, named: Mapping[str, Floats]) -> dict[str, Floats]:
        """The most probable weights of the terms of fz by name."""
        parts = np.split(self.weights[FZ].mean, np.cumsum([terms.shape[1] for terms in named.values()])[:-1])
        return dict(zip(named, parts, strict=True))

    def _contact_of(self, motion: MotionColumns, named: Mapping[str, Floats]) -> Floats:
        """Palpd's contact, and what curves over the height and forces that remember the load add while the tip is below the surface.

        Args:
            named: The terms of fz by name.
        """
        if not np.isfinite(self.surface_m):
            return np.zeros_like(motion["z_m"])
        mean = self._mean_of(named)
        at_surface_N = float((_hats(np.array([self.surface_m]), self.motions.heights_m) @ mean["height"])[0])
        height_N, memory_N, presses_N = (named[name] @ mean[name] for name in ("height", "memory", "presses"))
        more_N = height_N - at_surface_N + memory_N + presses_N
        return np.where(motion["z_m"] < self.surface_m, self._contact_N(motion) + more_N, 0.0)

    def doubt(self, motion: MotionColumns) -> SimulatorDoubt:
        """How the prediction for a motion may be wrong."""
        n, interval = len(motion["t_s"]), self.motions.interval(motion["z_m"])
        columns: list[Floats] = []
        for channel, weights, terms in self._weighed(motion, self.terms(motion, FZ)):
            own = np.linalg.cholesky(weights.covariance + 1e-12 * np.trace(weights.covariance) * np.eye(len(weights.mean)))
            # Those combinations of the weights' errors that change this prediction most.
            squares, turned = np.linalg.eigh(own.T @ (terms.T @ terms) @ own)
            errors = (terms @ (own @ turned[:, -MOST_ERRORS:])).T[squares[-MOST_ERRORS:] > 0.0]
            for change in (*errors, *(terms @ difference for difference in weights.between)):
                one = np.zeros((7, n))
                one[channel] = change
                columns.append(one)
        unexplained = np.zeros((7, n))
        for channel, weights in self.weights.items():
            unexplained[channel] = weights.unexplained[interval]
        return SimulatorDoubt(np.array(columns).reshape(-1, 7, n), self.motions.known(motion), unexplained)

    def _about(self) -> tuple[str, ...]:
        if self.recordings == 1:
            return (
                "One healthy recording shows only how the cell varies within a run: a usual change from day to day may be named here; give "
                "healthy recordings of three days or more.",
            )
        if self.recordings == 2:
            return ("Two healthy recordings hardly show how the cell varies from day to day; give three or more.",)
        return ()

    @property
    def compared_cell(self) -> CellFile:
        """The cell file for a comparison: its effects are predicted, and what it does not know is that of the healthy cell."""
        cell, stated = self.cell.without_effects(), self.cell.tolerances
        cell = cell.with_tolerances(mass_kg=min(stated.mass_kg, MASS_TOLERANCE * cell.probe.mass_kg))
        return cell if stated.modulus_known else cell.with_tolerances(youngs_modulus=Tolerances.model_fields["youngs_modulus"].default)


def neighbours_alike(values: Floats) -> float:
    """Correlation of each value (n,) with the next one, around 0."""
    return float(values[1:] @ values[:-1]) / max(float(values @ values), 1e-300)


def means_between(edges: Ints, values: Floats) -> Floats:
    """Means (b,) or (b, p) of successive values.

    Args:
        edges: Rows at which they begin, and the end of the last (b + 1,).
        values: Their rows (n,) or (n, p).
    """
    return np.asarray(np.add.reduceat(values, edges[:-1], axis=0).T / np.diff(edges)).T


def _blocks(values: Floats, block: int) -> Floats:
    """Means (b,) or (b, p) of successive samples."""
    whole = len(values) // block * block
    return np.asarray(values[:whole].reshape(whole // block, block, *values.shape[1:]).mean(axis=1))


def _learned(pieces: Sequence[_Piece], groups: Sequence[int], noise: float, zero: float, drift_per_s: float) -> _Weights:
    """Weights of the terms of one channel.

    Args:
        groups: Numbers of terms that share a variance.
        noise: Rms of one mean.
        zero: Standard deviation of the zero of a recording.
        drift_per_s: Standard deviation of its drift, in units of the channel over s.
    """
    own = [np.column_stack([piece.terms, *_zeros(number, len(pieces), piece.t_s)]) for number, piece in enumerate(pieces)]
    x, y = np.vstack(own), np.concatenate([piece.residual for piece in pieces])
    p = sum(groups)
    sizes = np.sqrt(np.mean(x**2, axis=0))
    scale = np.where(sizes > 0.0, sizes, 1.0)
    x = x / scale
    least = max(noise, 1e-12)
    of_group = np.repeat(np.arange(len(groups)), groups)
    spread, sigma = np.full(len(groups), max(float(np.var(y)), least**2)), max(float(np.std(y)), least)
    gram, against = x.T @ x, x.T @ y
    for _ in range(ROUNDS):
        prior = np.concatenate([spread[of_group], np.square(np.tile([zero, drift_per_s], len(pieces)) * scale[p:])])
        factor = cho_factor(gram / sigma**2 + np.diag(1.0 / prior))
        covariance = cho_solve(factor, np.eye(len(prior)))
        mean = cho_solve(factor, against / sigma**2)
        # MacKay's fixed point: of each group as many weights count as the recordings determine.
        determined = np.bincount(of_group, 1.0 - (np.diag(covariance) / prior)[:p])
        spread = np.maximum(np.bincount(of_group, mean[:p] ** 2) / np.maximum(determined, 1e-3), 1e-8 * least**2)
        settled = float(np.sum(1.0 - np.diag(covariance) / prior))
        rest = y - x @ mean
        # Neighbours that are off alike count as one: (1 + ρ) / (1 - ρ) of them, with ρ their correlation.
        alike = min(max(neighbours_alike(rest), 0.0), MOST_ALIKE)
        sigma = max(float(np.sqrt(np.sum(rest**2) / max(len(y) - settled, 1.0) * (1.0 + alike) / (1.0 - alike))), least)
    # What was learned must carry over: each recording, or each part of a single one, is predicted from the others.
    parts = [slice(a, b) for a, b in pairwise(np.cumsum([0, *(len(piece.t_s) for piece in pieces)]).tolist())]
    if len(parts) == 1:
        parts = [slice(a, b) for a, b in pairwise(np.linspace(0, len(y), PARTS + 1).astype(int).tolist())]
    precision, k = np.diag(1.0 / prior), len(parts)
    square, between = np.empty(len(y)), []
    for part in parts:
        own_gram, own_against = x[part].T @ x[part], x[part].T @ y[part]
        others = np.linalg.solve((gram - own_gram) / sigma**2 + precision, (against - own_against) / sigma**2)
        square[part] = (y[part] - x[part] @ others) ** 2
        between.append(np.linalg.solve(own_gram / sigma**2 + precision, (own_against - own_gram @ mean) / sigma**2)[:p])
    interval = np.concatenate([piece.interval for piece in pieces])
    counts = np.maximum(np.bincount(interval, minlength=INTERVALS), 1)
    unexplained = np.sqrt(np.maximum(np.bincount(interval, square, minlength=INTERVALS) / counts - least**2, 0.0))
    factor_of_few = float(stdtrit(k - 1, 0.841)) * ((k + 1) / (k * (k - 1))) ** 0.5
    return _Weights(
        mean=mean[:p] / scale[:p],
        covariance=covariance[:p, :p] / np.outer(scale[:p], scale[:p]),
        between=factor_of_few * np.array(between) / scale[:p],
        unexplained=unexplained,
    )


def _zeros(number: int, recordings: int, t_s: Floats) -> list[Floats]:
    """Columns (b,) of the zero and the drift of each recording: those of the others are 0."""
    both = (np.ones_like(t_s), t_s - t_s.mean())
    return [values if number == other else np.zeros_like(t_s) for other in range(recordings) for values in both]
