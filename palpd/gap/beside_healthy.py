"""The effects that may be present beside a healthy cell.

Such a cell rubs, drags and moves a mass already. So it may now do less of each, and how much of each it does its recordings say, not its
cell file.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace

from palpd.cell.dynamics import Memory
from palpd.cell.effects import Effect
from palpd.cell.effects.effect import Parameter, Scale, Values
from palpd.cell.span import Span

FRICTION = "friction"
"""Parameter of the simulator of a healthy cell: how much more it rubs than it did, in N, by the curve of its own friction."""
OWN_CURVE = Parameter("own_curve", "1", 0.0, 1.0, (0.0,), nominal=None, choices=(0.0, 1.0), nuisance=True)
"""Whether a change of the friction follows that curve, or the law of the list."""
SINCE = "change since it was healthy"
"""What the size of such an effect is called."""
MOST_OF_FORCE = 3.0
"""Largest change of the inertial force, over the largest force."""


def beside_healthy(library: Mapping[str, Effect]) -> dict[str, Effect]:
    """The same effects, beside what was instead of what is stated; those that a healthy cell has already may have either sign."""
    changed = {"cable.friction": _friction, "cable.viscous": _drag, "probe.mass": _mass}
    return {name: changed.get(name, _since)(effect) for name, effect in library.items()}


def _since(effect: Effect) -> Effect:
    what = effect.what.replace("than stated", "than while the cell was healthy").replace("not the stated one", "not what it was")
    return replace(effect, what=what)


def _friction(effect: Effect) -> Effect:
    listed = effect.law
    assert listed is not None

    def law(s: Span, values: Values, memory: Memory) -> None:
        if not values.get(OWN_CURVE.name):
            listed(s, values, memory)
        elif s.nominal is not None and FRICTION in s.nominal.variations:
            s.constants.simulator[FRICTION] = values["force_N"]

    size, *shape = effect.parameters
    what = "the friction is not what it was: a force of constant size against the motion became larger or smaller"
    return replace(effect, what=what, parameters=(_either_way(size), *shape, OWN_CURVE), law=law)


def _drag(effect: Effect) -> Effect:
    what = "the drag is not what it was: a force against the motion that grows with the speed became larger or smaller"
    return replace(effect, what=what, parameters=tuple(map(_either_way, effect.parameters)))


def _either_way(size: Parameter) -> Parameter:
    def starts(scale: Scale) -> tuple[float, ...]:
        return tuple(sign * value for value in size.starts(scale) for sign in (1.0, -1.0))

    return replace(size, lower=lambda scale: -size.bounds(scale)[1], typical=starts, words=SINCE)


def _mass(effect: Effect) -> Effect:
    def mass_kg(share: float) -> Callable[[Scale], float]:
        """The mass whose inertial force is a share of the largest force, at the acceleration of the motion."""
        return lambda scale: share * scale.force_N * scale.stroke_m / scale.speed_m_per_s**2

    def starts(scale: Scale) -> tuple[float, ...]:
        return mass_kg(0.1)(scale), mass_kg(-0.1)(scale)

    (size,) = effect.parameters
    size = replace(size, lower=mass_kg(-MOST_OF_FORCE), upper=mass_kg(MOST_OF_FORCE), typical=starts, words=SINCE)
    what = "the moving mass is not what it was: the force is off while the arm speeds up or brakes"
    return replace(effect, what=what, parameters=(size,))
