"""Coordinates u of the parameters θ of effects, in which steps of 1 % are sensible, and where a search in them starts."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import inf, log, pi

import numpy as np

from palpd.cell.cell_file import EffectValues
from palpd.cell.effects import Effect, Parameter, Scale
from palpd.gap.assumptions import ASSUMED
from palpd.tick import Floats


@dataclass(frozen=True)
class Coordinate:
    """How a free parameter of a hypothesis is scaled for fitting: its logarithm, or the parameter divided by `scale`.

    Attributes:
        effect: Id of the effect.
        lower: Least value of the parameter, in its unit.
        upper: Largest value, in its unit.
        scale: Value whose linear coordinate is 1, in its unit.
        nominal: Value of an amplitude at which the effect is absent, in its unit; None for a shape, such as a time constant.
    """

    effect: str
    parameter: Parameter
    lower: float
    upper: float
    scale: float
    nominal: float | None

    @property
    def fixed(self) -> bool:
        """Whether the parameter has a few values only, which are tried in turn and not fitted."""
        return bool(self.parameter.choices)

    @property
    def amplitude(self) -> bool:
        """Whether the parameter switches the effect off at its nominal value; otherwise it is a shape."""
        return self.nominal is not None

    def held_at(self, value: float) -> "Coordinate":
        """The same coordinate, with this value as its whole range."""
        return replace(self, lower=value, upper=value)

    def to(self, value: float) -> float:
        """Coordinate u of a value of the parameter."""
        return log(max(value, 1e-300)) if self.parameter.log else value / self.scale

    def back(self, u: float) -> float:
        """Value of the parameter at a coordinate u, inside its range."""
        value = float(np.exp(min(u, 700.0))) if self.parameter.log else u * self.scale
        return min(max(value, self.lower), self.upper)

    @property
    def angle(self) -> bool:
        """Whether the parameter is an angle over a whole turn."""
        return self.parameter.unit == "rad" and self.upper - self.lower > 6.28

    @property
    def range(self) -> float:
        """Length of the range in u."""
        return max(self.to(self.upper) - self.to(max(self.lower, 1e-300 if self.parameter.log else self.lower)), 1e-9)


def coordinates(values: EffectValues, library: Mapping[str, Effect], scale: Scale) -> tuple[Coordinate, ...]:
    """Coordinates of the parameters of a set of effects, effect by effect.

    Args:
        values: Parameters by effect. An optional parameter that is absent has no coordinate. A parameter that has a few values only keeps
            its value: its range has no length.
        library: Effects by id.
        scale: Sizes that their bounds refer to.
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
    """Coordinates u (k,) of the values of effects.

    Args:
        where: The k parameters.
        values: Parameters θ by effect.
    """
    return np.array([c.to(values[c.effect][c.parameter.name]) for c in where])


def values_at(where: Sequence[Coordinate], u: Floats) -> EffectValues:
    """Parameters θ by effect at coordinates u; all are brought into their ranges.

    Args:
        where: The k parameters.
        u: Their coordinates (k,).
    """
    out: EffectValues = {}
    for c, x in zip(where, u.tolist(), strict=True):
        value = c.back(x)
        if c.angle:
            value = float((x * c.scale - c.lower) % (2.0 * pi) + c.lower)
        out.setdefault(c.effect, {})[c.parameter.name] = value
    return out


def inside(where: Sequence[Coordinate], u: Floats) -> Floats:
    """The nearest coordinates (k,) inside the ranges of their parameters; angles stay, since they have no ends.

    Args:
        u: The coordinates (k,).
    """
    return np.array([x if c.angle else c.to(c.back(x)) for c, x in zip(where, u.tolist(), strict=True)])


def other_laws(values: EffectValues, library: Mapping[str, Effect], scale: Scale) -> Iterator[EffectValues]:
    """Parameters of effects, once with each nuisance that the law of one of them may have besides."""
    for name, mine in values.items():
        for parameter in library[name].parameters:
            if parameter.nuisance and parameter.name not in mine:
                yield {**values, name: {**mine, parameter.name: parameter.starts(scale)[0]}}


def start_values(effect: Effect, scale: Scale, peaks_Hz: Sequence[float]) -> list[dict[str, float]]:
    """Starting points for one effect: every combination of its starting values; time constants are also spread over their range.

    Of several amplitudes that may have either sign, each starts alone, with the others at 0: a combination with a wrong sign would fit no
    better than none.

    Args:
        scale: Sizes that its starting values refer to.
        peaks_Hz: Frequencies that stand out in the residual.

    Returns:
        At most `search.most_starts` sets of parameters, the most typical first.
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
        choices = [[values if k == alone or k not in free else [0.0] for k, values in enumerate(lists)] for alone in free]
    combos = [{n: v for n, v in zip(names, combo, strict=True) if v is not None} for these in choices for combo in product(*these)]
    if len(combos) > ASSUMED.search.most_starts:
        combos = [combos[k] for k in np.unique(np.linspace(0, len(combos) - 1, ASSUMED.search.most_starts).astype(int))]
    return combos


def stretched(effect: Effect, values: dict[str, float], factor: float, scale: Scale) -> dict[str, float]:
    """Parameters of an effect that is larger or smaller by a factor: shapes stay, amplitudes change within their bounds.

    Args:
        factor: Multiplies an amplitude that is absent at 0. A limit that is absent at infinity is divided by its absolute value. Of a ratio
            to any other nominal value it is the power.
        scale: Sizes that its bounds refer to.
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
