"""How far the gap closes with the named effects in the simulator, on cycles that the fit did not see."""

from dataclasses import dataclass
from math import log
from typing import Any

import numpy as np

from palpd.gap.data.noise import CHANNELS
from palpd.gap.data.phases import Ints
from palpd.gap.infer.evidence import Fit
from palpd.gap.infer.fit import LEAST_MODULUS_FACTOR, gauss_newton
from palpd.gap.infer.where import PhaseGap
from palpd.gap.model.problem import MODULUS, Problem
from palpd.tick import Floats

FOLDS = 4
"""Every fourth cycle is held out in turn: enough presses remain to fit, and each press is judged once."""

MODULUS_STEP, MODULUS_ROUNDS = 0.01, 3
"""Step of the logarithm of a modulus for its slope, and number of linear fits of it."""

RESAMPLES = 400
"""Number of bootstrap samples of the cycles: ten of them then lie beyond each end of a 95 % interval."""


@dataclass(frozen=True)
class Shrink:
    """Rms of the gap without and with the named effects, in the channel that they change most, and the share that closed.

    The rms values have the unit of the channel. `closed` and its interval are None where no effect is named.

    Attributes:
        after_rms: Equal to `before_rms` where no effect is named.
        noise_floor: Rms of the noise of a sample.
        closed: 1 - (after² - floor²) / (before² - floor²) over bins, in -1 to 1.
        ci95: Interval of `closed` by a bootstrap over cycles.
        on: The data that were judged, in words.
    """

    channel: str
    before_rms: float
    after_rms: float
    noise_floor: float
    closed: float | None
    ci95: tuple[float, float] | None
    on: str

    def to_json(self) -> dict[str, Any]:
        """The block `shrink` of out.json."""
        return vars(self) | {"ci95": None if self.ci95 is None else list(self.ci95)}


def without_effects(table: list[PhaseGap], channel: str) -> Shrink:
    """The gap of one channel where no effect is named.

    Args:
        channel: If it is not in the table, all channels count.
    """
    mine = [g for g in table if g.channel == channel] or table
    n = sum(g.samples for g in mine) or 1
    rms = float(np.sqrt(sum(g.rms**2 * g.samples for g in mine) / n))
    floor = float(np.sqrt(sum(g.noise_floor**2 * g.samples for g in mine) / n))
    return Shrink(mine[0].channel if mine else channel, rms, rms, floor, None, None, "cycles not used for the fit")


def held_out(problem: Problem, best: Fit) -> Shrink:
    """Fit the named effects on all but every fourth cycle and judge them there, four times over (cross-validation).

    Returns:
        Gap before and after, with the same in-tolerance deviations in both, and a bootstrap interval over cycles. An unknown modulus is no
        such deviation: it is fitted anew for the cell without effects.
    """
    first = np.cumsum([0, *(one.phases.cycles for one in problem.recordings)])
    cycle = np.concatenate([one.bin_cycle + k for one, k in zip(problem.recordings, first[:-1].tolist(), strict=True)])
    cycles = int(first[-1])
    before, after = _cross_validated(problem, best, cycle, min(FOLDS, cycles))
    channel = int(np.argmax(((before - after) ** 2).sum(axis=1)))
    before_there, after_there = problem.noise.natural(before)[channel], problem.noise.natural(after)[channel]
    noise = float(np.sqrt(np.mean([one.noise_rms[channel] ** 2 for one in problem.recordings if one.judged[channel]])))
    count = problem.per_bin(lambda one: one.bins.count)
    per_cycle = np.zeros((cycles, 3))
    for k in range(cycles):
        mine = cycle == k
        for column, values in enumerate((before_there, after_there, problem.floor_rms[channel])):
            per_cycle[k, column] = (count[mine] * values[mine] ** 2).sum()
    total = per_cycle.sum(axis=0)
    closed = _closed(total)
    rng = np.random.default_rng(0)
    drawn = [_closed(per_cycle[rng.integers(0, cycles, cycles)].sum(axis=0)) for _ in range(RESAMPLES)]
    low, high = np.quantile(drawn, [0.025, 0.975])
    # Within a bin there is only noise, before and after alike.
    n = int(count.sum())
    within = max(noise**2 - total[2] / n, 0.0)
    return Shrink(
        channel=CHANNELS[channel],
        before_rms=float(np.sqrt(total[0] / n + within)),
        after_rms=float(np.sqrt(total[1] / n + within)),
        noise_floor=noise,
        closed=closed,
        ci95=(float(min(low, closed)), float(max(high, closed))),
        on=f"{'cycles' if min(one.phases.presses for one in problem.recordings) > 1 else 'stretches'} not used for the fit",
    )


def _cross_validated(problem: Problem, best: Fit, cycle: Ints, folds: int) -> tuple[Floats, Floats]:
    """Whitened gap (7, b) before and after; in-tolerance deviations are fitted to the judged cycles together with the effects."""
    before = np.zeros_like(problem.data)
    after = np.zeros_like(problem.data)
    for fold in range(folds):
        judged = cycle % folds == fold
        fitted = gauss_newton(problem.restricted_to(~judged), best.linearisation.restricted_to(~judged), best.where, best.u, 3)
        there, around = problem.restricted_to(judged), best.linearisation.restricted_to(judged)
        at = there.predict(fitted.values, around.eta)
        residual = around.space.remainder(there.data + around.offset() - at)
        after += residual
        before += residual + at - _without_effects_at_its_modulus(there, residual + at, around.eta)
    return before, after


def _without_effects_at_its_modulus(problem: Problem, target: Floats, eta: Floats) -> Floats:
    """Whitened prediction (7, b) without effects; a modulus that is not known takes the value that suits the target best."""
    at = problem.predict({}, eta)
    if problem.cell.tolerances.modulus_known:
        return at
    step = np.divide(MODULUS_STEP, problem.shared_sd, out=np.zeros_like(eta), where=MODULUS)
    for _ in range(MODULUS_ROUNDS):
        slope = (problem.predict({}, eta + step) - at) / MODULUS_STEP
        # The contact force is proportional to the modulus, so the best factor follows from one slope.
        factor = 1.0 + float(np.vdot(slope, target - at)) / max(float(np.vdot(slope, slope)), 1e-300)
        eta = eta + step / MODULUS_STEP * log(max(factor, LEAST_MODULUS_FACTOR))
        at = problem.predict({}, eta)
    return at


def _closed(sums: Floats) -> float:
    """1 - (after² - floor²) / (before² - floor²) in -1 to 1, from the sums of squares (before, after, floor)."""
    before, after, floor = sums
    return float(np.clip(1.0 - (after - floor) / max(before - floor, 1e-12 * max(before, 1e-300)), -1.0, 1.0))
