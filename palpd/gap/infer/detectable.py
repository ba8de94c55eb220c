"""The smallest size of each effect that the recordings would have shown, if it acted alone in the cell without effects."""

from dataclasses import dataclass
from math import exp, isfinite, log
from typing import Any

import numpy as np

from palpd.cell.effects import Effect, Parameter, Scale
from palpd.gap.assumptions import ASSUMED
from palpd.gap.data.noise import FZ, Z
from palpd.gap.data.phases import FREE_MOVING, HOLDING
from palpd.gap.gaussian.nuisances import project
from palpd.gap.infer.posterior import price_nats
from palpd.gap.model.coordinates import start_values, stretched
from palpd.gap.model.linearise import Linearisation
from palpd.gap.model.problem import Problem

IN_SIZE = 0.05
"""Relative error of a size at which the search for it ends."""
MOST_STEPS = 8
"""Largest number of sizes that are tried of an effect."""
MOST_APART = 1e6
"""Largest ratio of a size and the needed one that counts."""
LARGEST_STEP = 30.0
"""Largest factor from one size to the next."""


@dataclass(frozen=True)
class DetectableSize:
    """The smallest size of an effect that the recordings would have shown.

    Attributes:
        parameter: The parameter that switches it on, with its unit.
        smallest: Value of that parameter; None where no value within its range would have shown.
        of_typical: The same as a multiple of a typical size; None likewise.
        specification: One standard deviation of the tolerance that the effect exceeds, as the same multiple; None without one.
        others: The other parameters by name, at their most typical values.
        needs: What a recording needs that would show it; None where this one does.
    """

    effect: str
    parameter: Parameter
    smallest: float | None
    of_typical: float | None
    specification: float | None
    others: dict[str, float]
    needs: str | None

    def to_json(self) -> dict[str, Any]:
        """An entry of `detectable` of out.json."""
        entry = {name: value for name, value in vars(self).items() if name not in ("effect", "parameter")}
        return {"id": self.effect, "parameter": self.parameter.name, "unit": self.parameter.unit} | entry


def detectable_sizes(problem: Problem, around: Linearisation) -> tuple[DetectableSize, ...]:
    """The smallest detectable size of every effect that changes the mean of the readings.

    An effect counts as shown where its expected Bayes factor against the cell without effects reaches `limits.odds`. That is about the
    inverse of its prior odds, so half of such effects are named. Tolerances, scatter of presses and the error of the simulator may hide it,
    as in the diagnosis. The other parameters of an effect stay at their typical values.

    Args:
        around: The cell without effects, with its nuisances.
    """
    out = []
    for effect in problem.library.values():
        start = start_values(effect, problem.scale, ())[0]
        switch = next((p for p in effect.parameters if _acts(p, start, problem.scale)), None)
        if effect.scatter is None and switch is not None:
            factor, values = _smallest(problem, around, effect, start)
            others = {p.name: values[p.name] for p in effect.named_parameters if p.name in values and p is not switch}
            specification = _specification(effect, switch, start[switch.name], problem)
            smallest, needs = (None, _needs(effect, problem)) if factor is None else (values[switch.name], None)
            out.append(DetectableSize(effect.id, switch, smallest, factor, specification, others, needs))
    return tuple(out)


def _acts(parameter: Parameter, start: dict[str, float], scale: Scale) -> bool:
    """Whether a parameter is an amplitude that is switched on."""
    nominal = parameter.nominal_value(scale)
    return nominal is not None and start.get(parameter.name, nominal) != nominal


def _specification(effect: Effect, switch: Parameter, typical: float, problem: Problem) -> float | None:
    """One standard deviation of an effect's tolerance, as a multiple of a typical size of its parameter."""
    if effect.tolerance is None:
        return None
    sd, nominal = getattr(problem.cell.tolerances, effect.tolerance), switch.nominal_value(problem.scale)
    if nominal == 0.0:
        return float(sd) / (60.0 if effect.tolerance == "drift_N_per_min" else 1.0) / abs(typical)
    return log(1.0 + sd) / abs(log(typical / nominal)) if nominal is not None and isfinite(nominal) else None


def _smallest(problem: Problem, around: Linearisation, effect: Effect, start: dict[str, float]) -> tuple[float | None, dict[str, float]]:
    """The factor on typical parameters at which an effect shows, and the parameters there; None and the typical ones where none does.

    Secants in the logarithms of factor and size.
    """
    nominal, needed_sd = problem.predict({}, around.eta), _needed_sd(effect, price_nats(problem, effect.id))
    tried: list[tuple[float, float]] = []
    log_factor = 0.0
    for _ in range(MOST_STEPS):
        values = stretched(effect, start, exp(log_factor), problem.scale)
        change = project(problem.predict({effect.id: values}, around.eta) - nominal, around.space)
        size_sd = max(change.dot(change), 0.0) ** 0.5
        short = -log(min(max(size_sd / needed_sd, 1.0 / MOST_APART), MOST_APART))  # the law of a user may overflow
        tried.append((log_factor, short))
        if abs(short) < IN_SIZE:
            break
        slope = 1.0
        if len(tried) > 1 and abs(log_factor - tried[-2][0]) > 1e-6:
            slope = float(np.clip((tried[-2][1] - short) / (log_factor - tried[-2][0]), 0.2, 20.0))
        log_factor += float(np.clip(short / slope, -log(LARGEST_STEP), log(LARGEST_STEP)))
    shown = min((factor for factor, short in tried if short < IN_SIZE), default=None)  # of a size that jumps, the smallest that shows
    return (None, start) if shown is None else (exp(shown), stretched(effect, start, exp(shown), problem.scale))


def _needed_sd(effect: Effect, price: float) -> float:
    """Size s in sigmas at which the expected log Bayes factor s²/2, less what an effect of unknown size costs, reaches `limits.odds`.

    Args:
        price: What it costs beside a learned simulator, in nats.
    """
    shapes = sum(p.nominal is None and not p.nuisance for p in effect.parameters)
    cost = price + log(2.0 * ASSUMED.prior.log_size_range) + shapes * ASSUMED.limits.shape_nats
    size_sd = 5.0
    for _ in range(20):  # the prior of a size is 1/s
        size_sd = (2.0 * (log(ASSUMED.limits.odds) + cost + log(size_sd))) ** 0.5
    return size_sd


def _needs(effect: Effect, problem: Problem) -> str:
    """What a recording needs that would show an effect."""
    recordings = problem.recordings
    if effect.motion and all(one.z_cmd_m is None for one in recordings):
        return "record the commanded height z_cmd_m"
    if not any(one.judged[Z if effect.motion else FZ] for one in recordings):
        return f"record a {'height' if effect.motion else 'vertical force'} that can be compared"
    if effect.site in ("tissue", "tip") and not any(one.phases.presses for one in recordings):
        return "press the tissue" if problem.cell.tissue is not None else "state the tissue in the cell file, and press it"
    if effect.site == "probe" and not any((one.bin_phase == FREE_MOVING).any() for one in recordings):
        return "move freely in the air: nothing moves there"
    if effect.shows_at_rest and not any((one.bin_phase == HOLDING).any() for one in recordings):
        return "hold a force for some seconds"
    if effect.tolerance == "youngs_modulus" and not problem.cell.tolerances.modulus_known:
        return "state the modulus in the cell file: it counts as not known"
    return "move faster and farther, press deeper and longer, or repeat it"
