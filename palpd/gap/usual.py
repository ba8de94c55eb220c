"""What a healthy cell usually does: how much of each effect its own recordings seem to have, each against what was learned from the others.

A rig is never predicted perfectly. The residual at its reversals, in its fast strokes or from day to day looks a little like a filter, a
latency, friction. So each effect in the list is a deviation of the healthy cell, as large as the healthy recordings show it; only what
exceeds that is a change. The rest of the residual counts as noise, for as long as it lasts.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, stdtrit

from palpd.cell.effects import Scale
from palpd.gap.data.noise import FZ, declared_rms
from palpd.gap.healthy import BLOCK_S, HealthyCell, means_between, neighbours_alike
from palpd.gap.model.coordinates import start_values
from palpd.gap.model.problem import Problem, make_problem, scale_of_longest
from palpd.gap.user_simulator import MotionColumns, SimulatorDoubt, UserSimulator, asked
from palpd.recording.samples import Samples
from palpd.tick import Floats

KINDS = 4
"""Largest number of sets of parameters, such as time constants, for which an effect counts."""
MOST_HEALTHY = 8
"""Largest number of healthy recordings that are compared with the others."""
PRICE_NATS = 4.0
"""Least price of each effect beside what was learned: no sum of curves is exact."""
TAIL_SD = 2.5
"""Standard deviations at which a normal distribution has the tail of Student's distribution for the number of recordings."""
MOST_SQUARE = 9.0
"""Largest factor on the usual square of the residual, by which a recording may be more restless than the healthy ones."""
LEAST_BESIDE_ZERO = 0.05
"""Share of a change's energy that a zero and a drift leave, below which healthy recordings, whose zeros are free, show nothing of it."""
SPREAD_ROUNDS = 12
"""Rounds of the estimate of what is usual: then it explains what was seen. Further rounds only choose among changes that look alike."""
MOST_ALIKE = 0.9
"""Largest correlation of neighbouring means that is believed."""

HABITS = "A healthy recording looks like {} beside the others. So a change of that kind is named only where it is much larger."
MOST_NAMED = 3
"""Most habits that a sentence names, the largest first."""


class _Residual(NamedTuple):
    """A recording against what was learned from others.

    Means (b,) of the residual, over their rms `sd` (b,), and how alike neighbours are.
    """

    white: Floats
    sd: Floats
    alike: float

    def seen(self, changes: Sequence[Floats]) -> Floats:
        """Changes (p,) of n samples each as the residual would show them (p, b); 0 for one that a zero and a drift explain."""
        means = np.array([_means(change, len(self.sd)) for change in changes])
        beside = np.array([_without_zero(each, self.sd) for each in means])
        share = np.sum(beside**2, axis=1) / np.maximum(np.sum((means / self.sd) ** 2, axis=1), 1e-200)
        return np.where((share > LEAST_BESIDE_ZERO)[:, None], beside, 0.0)

    def squares(self, seen: Floats) -> Floats:
        """Median (2,) of the squares, as they are and without the change of (p, b) that leaves least: what acts is not restless."""
        shares = seen @ self.white / np.maximum(np.sum(seen**2, axis=1), 1e-200)
        plain, *without = np.median(np.vstack([self.white, self.white - shares[:, None] * seen]) ** 2, axis=1)
        return np.array([plain, min(plain, *without)])


@dataclass(frozen=True)
class ComparedRecording:
    """A healthy recording against what was learned from the others.

    Attributes:
        share: The share (p,) of each change of the list that the recording seems to have.
        overlap: Square (p, p) of the share of a change that another one seems to be.
        size: Square (p,) of each change over the noise.
        squares: Median square (2,) of the residual, and of what the change that fits best leaves of it.
        kinds: The number of changes of each effect, by its id.
    """

    recording: Samples
    others: HealthyCell
    left: _Residual
    share: Floats
    overlap: Floats
    size: Floats
    squares: Floats
    kinds: Mapping[str, int]

    @staticmethod
    def of(recording: Samples, others: HealthyCell, scale: Scale) -> "ComparedRecording":
        """Compare a healthy recording; the sizes of changes are multiples of `scale`."""
        problem = make_problem([recording], others.compared_cell, others.library, scale=scale, simulators=[others.simulator()])
        simulated = problem.recordings[0].simulated
        assert simulated is not None
        assert simulated.doubt is not None  # it was learned
        left, named = _left(problem, simulated.doubt), dict(_changes(problem))
        seen = left.seen([change for each in named.values() for change in each])
        size = np.maximum(np.sum(seen**2, axis=1), 1e-200)
        kinds = {name: len(each) for name, each in named.items()}
        overlap = (seen @ seen.T / size[:, None]) ** 2
        return ComparedRecording(recording, others, left, seen @ left.white / size, overlap, size, left.squares(seen), kinds)


@dataclass(frozen=True)
class UsualChanges:
    """How much of each effect healthy recordings seem to have.

    Attributes:
        compared: Each healthy recording against the others.
        scale: What the typical sizes of changes are multiples of, in any recording: that of the longest healthy one.
        spread: Standard deviations (k,) of each effect, as shares of its k typical sizes, by its id.
        lasting: Factor on the rms of the residual, since neighbours are off alike.
        squares: Usual squares (2,) of the residual over what was learned, as `ComparedRecording` has them, and the largest usual ones.
    """

    healthy: HealthyCell
    compared: tuple[ComparedRecording, ...]
    scale: Scale
    spread: Mapping[str, Floats]
    lasting: float
    squares: tuple[Floats, Floats]

    @staticmethod
    def of(recordings: Sequence[Samples], healthy: HealthyCell) -> "UsualChanges":
        """Compare each healthy recording with what was learned from the others; a single one with what was learned from itself."""
        scale, compared = scale_of_longest(recordings, healthy.cell), []
        for one in recordings[:: -(-len(recordings) // MOST_HEALTHY)]:
            others = [other for other in recordings if other is not one]
            learned = HealthyCell.of(others, healthy.cell, healthy.library) if others else healthy
            compared.append(ComparedRecording.of(one, learned, scale))
        return UsualChanges._seen_in(tuple(compared), healthy, scale, len(compared))

    def alike(self) -> dict[tuple[str, str], float]:
        """How alike the changes of two effects are in these recordings, by their ids: the largest square of a cosine."""
        squares = np.minimum(np.mean([one.overlap * one.size[:, None] / one.size for one in self.compared], axis=0), 1.0)
        kinds = self.compared[0].kinds
        starts = np.cumsum([0, *kinds.values()])[:-1]
        largest = np.maximum.reduceat(np.maximum.reduceat(squares, starts, axis=0), starts, axis=1)
        return {(one, other): float(largest[k, j]) for k, one in enumerate(kinds) for j, other in enumerate(kinds)}

    def without(self, one: ComparedRecording) -> "UsualChanges":
        """What the other recordings show, of what was learned from them, and believed as far as that of all."""
        return UsualChanges._seen_in(tuple(each for each in self.compared if each is not one), one.others, self.scale, len(self.compared))

    @staticmethod
    def _seen_in(compared: tuple[ComparedRecording, ...], healthy: HealthyCell, scale: Scale, recordings: int) -> "UsualChanges":
        lefts = [one.left for one in compared]
        # Of few recordings the spread may be larger than they show.
        k, squares = max(recordings, 2), np.log(np.maximum([one.squares for one in compared], 1e-6))
        factor = float(stdtrit(k - 1, ndtr(TAIL_SD))) / TAIL_SD * ((k + 1) / k) ** 0.5
        apart = np.minimum(TAIL_SD * factor * (squares.std(axis=0, ddof=1) if len(lefts) > 1 else np.zeros(2)), np.log(MOST_SQUARE))
        usual = squares.mean(axis=0)
        rho = min(max(float(np.median([left.alike for left in lefts])), 0.0), MOST_ALIKE)
        lasting = ((1.0 + rho) / (1.0 - rho)) ** 0.5
        noise = lasting**2 * np.mean([1.0 / one.size for one in compared], axis=0)
        seen = factor**2 * np.mean([one.share**2 for one in compared], axis=0)
        spread = _spread(seen, noise, np.mean([one.overlap for one in compared], axis=0))
        kinds = compared[0].kinds
        edges = np.cumsum(list(kinds.values()))[:-1]
        by_effect = dict(zip(kinds, np.split(spread, edges), strict=True))
        return UsualChanges(healthy, compared, scale, by_effect, lasting, (np.exp(usual), np.exp(usual + apart)))

    def allowed(self, simulator: UserSimulator, now: Samples, habits: Mapping[str, float] | None = None) -> UserSimulator:
        """The simulator of a healthy cell, for which what is usual is no change.

        Args:
            simulator: As it was learned, with its own doubt.
            now: The recording that is compared.
            habits: What effects cost beyond the least price, by id (`healthy_reference`); None: nothing costs anything.
        """
        problem = make_problem([now], self.healthy.compared_cell, self.healthy.library, scale=self.scale, simulators=[simulator])
        whole = self.healthy.doubt(asked(problem.recordings[0].sampled, now.z_cmd_m))  # that of `simulator` may begin with an onset
        changes = dict(_changes(problem))
        usual = [share * change for name, each in changes.items() for share, change in zip(self.spread[name], each, strict=True)]
        t_s = problem.recordings[0].samples.t_s
        left = _left(problem, whole)
        squares, (usual_squares, largest) = left.squares(left.seen([change for each in changes.values() for change in each])), self.squares
        variance = float((np.clip(squares, usual_squares, largest) / usual_squares).min())
        columns = _independent(np.array(usual), 0.01 * float(declared_rms(self.healthy.cell)[FZ]))
        prices = dict.fromkeys(problem.library, PRICE_NATS) if habits is not None else {}
        for name, nats in (habits or {}).items():
            prices[name] = prices.get(name, 0.0) + nats
        own = simulator.doubt
        assert own is not None  # it was learned

        def doubt(motion: MotionColumns) -> SimulatorDoubt:
            learned = own(motion)
            more, unexplained = np.zeros((len(columns), 7, len(motion["t_s"]))), learned.unexplained.copy()
            times_s = motion["t_s"] - motion["t_s"][0]
            for column, values in zip(more, columns, strict=True):
                column[FZ] = np.interp(times_s, t_s - t_s[0], values)
            unexplained[FZ] *= self.lasting * variance**0.5
            errors = np.concatenate([learned.errors, more])
            return replace(learned, errors=errors, unexplained=unexplained, price_nats=prices)

        clearest = sorted((habits or {}).items(), key=lambda habit: -habit[1])[:MOST_NAMED]
        names = " or ".join(name or "something unknown" for name, _ in clearest)
        return replace(simulator, doubt=doubt, about=(*simulator.about, *([HABITS.format(names)] if names else [])))


def _spread(seen: Floats, noise: Floats, overlaps: Floats) -> Floats:
    """Standard deviations (p,) of changes, each as a share of its size, with which each is seen as often as in the healthy recordings.

    Changes look alike: what one shows is not another one's too, and together they explain what is seen. From equal variances on, each
    grows with what it would explain and the others do not yet (Richardson 1972, Lucy 1974). So changes that look alike share.

    Args:
        seen: Mean square (p,) of the share of each change that a healthy recording seems to have.
        noise: What noise alone makes of it (p,).
        overlaps: Square (p, p) of the share of a change that another one, as large as it typically is, seems to be.
    """
    scale = np.maximum(seen, 1e-300)
    beyond_noise, shares = np.maximum(seen - noise, 0.0) / scale, overlaps / scale[:, None]
    total = np.maximum(shares.sum(axis=0), 1e-300)
    variances = np.full(len(seen), beyond_noise.mean() / max(float(shares.sum(axis=1).mean()), 1e-300))
    for _ in range(SPREAD_ROUNDS):
        variances *= shares.T @ (beyond_noise / np.maximum(shares @ variances, 1e-12)) / total
    return np.asarray(np.sqrt(variances))


def _changes(problem: Problem) -> Iterator[tuple[str, list[Floats]]]:
    """What each effect changes of fz (k, n) at its typical sizes, by its id."""
    (recording,) = problem.recordings
    plain = problem.raw_prediction(recording, problem.cell)[:, FZ]
    for name, effect in problem.library.items():
        if effect.motion or effect.scatter:
            continue
        starts = start_values(effect, problem.scale, ())
        kinds = [starts[k] for k in np.unique(np.linspace(0, len(starts) - 1, KINDS).astype(int))]
        cells = [problem.cell_at({name: values}, np.zeros(len(problem.shared_sd))) for values in kinds]
        yield name, [problem.raw_prediction(recording, cell)[:, FZ] - plain for cell in cells]


def _left(problem: Problem, doubt: SimulatorDoubt) -> _Residual:
    (recording,) = problem.recordings
    samples = recording.samples
    count = min(max(8, int(samples.duration_s / BLOCK_S)), len(samples))
    sd = np.hypot(_means(doubt.unexplained[FZ], count), float(declared_rms(problem.cell)[FZ]) * (count / len(samples)) ** 0.5)
    left = samples.wrench[:, FZ - 1] - problem.raw_prediction(recording, problem.cell)[:, FZ]
    white = _without_zero(_means(np.where(doubt.known, left, 0.0), count), sd)
    return _Residual(white, sd, neighbours_alike(white))


def _means(values: Floats, count: int) -> Floats:
    """Means (count,) of successive samples."""
    return means_between(np.linspace(0, len(values), count + 1).astype(int), values)


def _without_zero(values: Floats, sd: Floats) -> Floats:
    """Values (b,) over their standard deviations, without what a zero and its drift explain."""
    basis, _ = np.linalg.qr(np.column_stack([1.0 / sd, np.linspace(-1.0, 1.0, len(sd)) / sd]))
    white = values / sd
    return np.asarray(white - basis @ (basis.T @ white))


def _independent(changes: Floats, least: float) -> Floats:
    """Independent changes (m, n) of the same covariance, without those whose rms is below the least one."""
    if not len(changes):
        return changes
    _, sizes, courses = np.linalg.svd(changes, full_matrices=False)
    kept = sizes > least * changes.shape[1] ** 0.5
    return np.asarray(sizes[kept, None] * courses[kept])
