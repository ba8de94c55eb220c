"""How far the gap closes when what was found is put into the simulator, judged on cycles that the fit did not see."""

from dataclasses import dataclass

import numpy as np

from palpd.gap.gaussian import nuisances
from palpd.gap.hypothesis import Fit, climb, values_at
from palpd.gap.noise import CHANNELS
from palpd.gap.problem import Linearisation, Problem
from palpd.tick import Floats

FOLDS = 4


@dataclass(frozen=True)
class Shrink:
    """Rms of the gap before and after in the channel that the effects change most, and the share that closed."""

    channel: str
    before_rms: float
    after_rms: float
    noise_floor: float
    closed: float
    ci95: tuple[float, float]
    on: str


def held_out(problem: Problem, best: Fit) -> Shrink:
    """Fit on all but every fourth cycle, judge there, four times over. In-tolerance deviations are fitted to the judged cycles together
    with the effects as found, and the same ones stand in `before`."""
    cycle, offset = [], 0
    for run in problem.runs:
        cycle.append(run.bin_cycle + offset)
        offset += run.phases.cycles
    cycles = np.concatenate(cycle).astype(int)
    count = np.concatenate([run.bins.count for run in problem.runs])
    folds = min(FOLDS, offset)
    before = np.zeros_like(problem.data)
    after = np.zeros_like(problem.data)
    for fold in range(folds):
        judged = cycles % folds == fold
        fitted = problem.only(~judged)
        around = _restricted(best.linearisation, ~judged)
        u = climb(fitted, around, best.where, best.u, 3)[0]
        values = values_at(best.where, u)
        there = problem.only(judged)
        space = _restricted(best.linearisation, judged)
        at = there.predict(values, space.eta)
        left = there.data + space.offset() - at
        left = left - space.space.explained(space.space.coefficients(left))
        after += left
        before += left + at - there.predict({}, space.eta)
    strength = ((before - after) ** 2).sum(axis=1)
    channel = int(np.argmax(strength))
    before_there, after_there = problem.noise.natural(before)[channel], problem.noise.natural(after)[channel]
    noise = float(np.sqrt(np.mean([run.noise_rms[channel] ** 2 for run in problem.runs if run.judged[channel]])))
    n = int(count.sum())
    per_cycle = np.zeros((offset, 3))
    for k in range(offset):
        mine = cycles == k
        weight = count[mine]
        per_cycle[k] = (
            (weight * before_there[mine] ** 2).sum(),
            (weight * after_there[mine] ** 2).sum(),
            (weight * problem.floor_rms[channel, mine] ** 2).sum(),
        )
    total = per_cycle.sum(axis=0)
    closed = _closed(total)
    rng = np.random.default_rng(0)
    drawn = [_closed(per_cycle[rng.integers(0, offset, offset)].sum(axis=0)) for _ in range(400)]
    low, high = np.quantile(drawn, [0.025, 0.975])
    # Within a bin only noise is left, before and after alike.
    within = max(noise**2 - total[2] / n, 0.0)
    return Shrink(
        CHANNELS[channel],
        float(np.sqrt(total[0] / n + within)),
        float(np.sqrt(total[1] / n + within)),
        noise,
        closed,
        (float(min(low, closed)), float(max(high, closed))),
        "cycles not used for the fit" if min(run.phases.presses for run in problem.runs) > 1 else "stretches not used for the fit",
    )


def _closed(sums: Floats) -> float:
    """1 - (after² - floor²) / (before² - floor²)."""
    before, after, floor = sums
    return float(np.clip(1.0 - (after - floor) / max(before - floor, 1e-12 * max(before, 1e-300)), -1.0, 1.0))


def _restricted(around: Linearisation, bins: Floats) -> Linearisation:
    columns = np.where(bins[None, None, :], around.columns, 0.0)
    space = nuisances(columns)
    prediction = np.where(bins[None, :], around.prediction, 0.0)
    return Linearisation(around.effects, around.eta, columns, space, prediction, around.index)
