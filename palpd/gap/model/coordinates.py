"""The parameters of effects as coordinates in which steps of 1 % are sensible, and where a search in them starts."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from math import inf, log, pi

import numpy as np

from palpd.cell.cell_file import EffectValues
from palpd.cell.effects import Effect, Parameter, Scale
from palpd.tick import Floats

MOST_STARTS = 32
"""Number of starting points of one effect: enough for three parameters at three values each."""


@dataclass(frozen=True)
class Coordinate:
    """One free parameter of a hypothesis: its range, the value that counts as 1, and the value at which the effect is absent."""

    effect: str
    parameter: Parameter
    lower: float
    upper: float
    scale: float
    nominal: float | None

    @property
    def fixed(self) -> bool:
        """Whether it is one of few values, which are tried one by one and not fitted."""
        return bool(self.parameter.choices)

    @property
    def amplitude(self) -> bool:
        """Whether it switches the effect off at its nominal value."""
        return self.nominal is not None

    def to(self, value: float) -> float:
        """Coordinate of a value."""
        return log(max(value, 1e-300)) if self.parameter.log else value / self.scale

    def back(self, u: float) -> float:
        """Value of a coordinate, inside the range."""
        value = float(np.exp(min(u, 700.0))) if self.parameter.log else u * self.scale
        return min(max(value, self.lower), self.upper)

    @property
    def angle(self) -> bool:
        """Whether it is an angle over a whole turn."""
        return self.parameter.unit == "rad" and self.upper - self.lower > 6.28

    @property
    def range(self) -> float:
        """Length of the range in the coordinate."""
        return max(self.to(self.upper) - self.to(max(self.lower, 1e-300 if self.parameter.log else self.lower)), 1e-9)


def coordinates(values: EffectValues, library: Mapping[str, Effect], scale: Scale) -> tuple[Coordinate, ...]:
    """The free parameters of a set of effects.

    Args:
        values: Parameters by effect; an optional one that is absent is not free, nor one that has a few values only.
        library: Effects by id.
        scale: Sizes that their bounds refer to.

    Returns:
        The coordinates, effect by effect.
    """
    out = []
    for name in values:
        effect = library[name]
        for parameter in [p for p in effect.parameters if p.name in values[name]]:
            value = values[name][parameter.name]
            lower, upper = (value, value) if parameter.choices else parameter.bounds(scale)
            typical = max((abs(v) for v in parameter.starts(scale)), default=0.0) or max(abs(lower), abs(upper)) or 1.0
            out.append(Coordinate(effect.id, parameter, lower, upper, typical, parameter.nominal_value(scale)))
    return tuple(out)


def coordinates_of(where: Sequence[Coordinate], values: EffectValues) -> Floats:
    """Coordinates of the values of effects.

    Args:
        where: The k free parameters.
        values: Parameters by effect.

    Returns:
        The coordinates (k,).
    """
    return np.array([c.to(values[c.effect][c.parameter.name]) for c in where])


def values_at(where: Sequence[Coordinate], u: Floats) -> EffectValues:
    """Values of effects at some coordinates.

    Args:
        where: The k free parameters.
        u: Their coordinates (k,).

    Returns:
        Parameters by effect; angles are brought into their range.
    """
    out: EffectValues = {}
    for c, x in zip(where, u.tolist(), strict=True):
        value = c.back(x)
        if c.angle:
            value = float((x * c.scale - c.lower) % (2.0 * pi) + c.lower)
        out.setdefault(c.effect, {})[c.parameter.name] = value
    return out


def inside(where: Sequence[Coordinate], u: Floats) -> Floats:
    """Coordinates brought into the range of their parameters.

    Args:
        where: The k free parameters.
        u: Their coordinates (k,).

    Returns:
        The nearest coordinates (k,) inside the ranges.
    """
    return np.array([x if c.angle else c.to(c.back(x)) for c, x in zip(where, u.tolist(), strict=True)])


def start_values(effect: Effect, scale: Scale, peaks_Hz: Sequence[float]) -> list[dict[str, float]]:
    """Starting points for one effect: every combination of its starting values; time constants are also spread over their range.

    Several amplitudes of either sign start one at a time: a combination with a wrong sign would look like nothing at all.

    Args:
        scale: Sizes that its starting values refer to.
        peaks_Hz: Frequencies that stand out in the residual.

    Returns:
        At most MOST_STARTS sets of parameters, the most typical first.
    """
    lists: list[list[float | None]] = []
    for parameter in effect.parameters:
        starts = list(parameter.starts(scale))
        lower, upper = parameter.bounds(scale)
        if parameter.nominal is None and parameter.log and upper > lower > 0:
            spread = np.geomspace(lower, upper, 7)[1:-1].tolist()
            starts = [*starts, *[s for s in spread if min(abs(log(s / v)) for v in starts) > 0.5]]
        if parameter.unit == "N" and parameter.nominal_value(scale) == inf:
            starts += [0.97 * scale.force_N, 0.9 * scale.force_N]  # a limit lies near the largest readings
        if parameter.unit == "Hz":
            starts = [*[f for f in peaks_Hz if lower < f < upper], *starts]
        lists.append([*parameter.choices] or ([None, *starts] if parameter.optional else [*starts]))
    names = [p.name for p in effect.parameters]
    free = [k for k, p in enumerate(effect.parameters) if p.nominal == 0.0 and p.bounds(scale)[0] < 0.0]
    choices = [lists]
    if len(free) > 1:
        choices = [[values if k == one or k not in free else [0.0] for k, values in enumerate(lists)] for one in free]
    combos = [{n: v for n, v in zip(names, combo, strict=True) if v is not None} for these in choices for combo in product(*these)]
    if len(combos) > MOST_STARTS:
        combos = [combos[k] for k in np.unique(np.linspace(0, len(combos) - 1, MOST_STARTS).astype(int))]
    return combos


def stretched(effect: Effect, values: dict[str, float], factor: float, scale: Scale) -> dict[str, float]:
    """The parameters of an effect that is larger or smaller.

    Args:
        values: Its parameters.
        factor: Change of its size.
        scale: Sizes that its bounds refer to.

    Returns:
        Parameters with changed amplitudes, inside their bounds.
    """
    out = dict(values)
    for parameter in effect.parameters:
        nominal = parameter.nominal_value(scale)
        if nominal is None or parameter.name not in values:
            continue
        lower, upper = parameter.bounds(scale)
        value = values[parameter.name]
        if nominal == 0.0:
            value = value * factor
        elif nominal == inf:
            value = value / min(max(abs(factor), 0.03), 30.0)
        else:
            value = nominal * (value / nominal) ** min(max(factor, -5.0), 5.0)
        out[parameter.name] = min(max(value, lower), upper)
    return out
