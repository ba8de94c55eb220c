"""Learned effects: laws that a diagnosis drew from a recording, as data that a person can read and edit.

A learned effect adds terms factor(state) × curve(driver) to channels of the readings, before the sensor's filter, or to the height of
the robot. A curve is a table of knots, straight between them, or a formula of the driver. Outside its range it is held.
"""

import ast
from collections.abc import Callable, Iterable
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import Field, StrictFloat, ValidationError, model_validator

from palpd.cell.dynamics import Floats, Memory, servo
from palpd.cell.effects.drivers import FACTOR_WORDS, Driver, DriverState, FactorName, StrictBlock, driver_values, factor_values
from palpd.cell.effects.effect import Effect, Parameter, Values
from palpd.cell.span import Span
from palpd.documents import read_yaml, refusal
from palpd.errors import ConfigError
from palpd.files import write_yaml

ChannelName = Literal["z_m", "fx_N", "fy_N", "fz_N", "tx_Nm", "ty_Nm", "tz_Nm"]

_FUNCTIONS: dict[str, Callable[..., Floats]] = {
    "abs": np.abs, "sign": np.sign, "exp": np.exp, "log": np.log, "sqrt": np.sqrt, "tanh": np.tanh, "sin": np.sin, "cos": np.cos,
    "minimum": np.minimum, "maximum": np.maximum,
}  # fmt: skip
_ARGUMENTS = {name: 2 if name in ("minimum", "maximum") else 1 for name in _FUNCTIONS}
_OPERATORS: dict[type[ast.AST], Callable[..., Floats]] = {
    ast.Add: np.add, ast.Sub: np.subtract, ast.Mult: np.multiply, ast.Div: np.divide, ast.Pow: np.power,
    ast.USub: np.negative, ast.UAdd: np.positive,
}  # fmt: skip
STRENGTH, SIZE = Parameter("strength", "1", -10.0, 10.0, (1.0,)), Parameter("strength", "1", 0.0, 10.0, (1.0,))
PHASE = Parameter("phase_rad", "rad", -np.pi, np.pi, (0.0, np.pi / 2, np.pi, -np.pi / 2), nominal=None)
"""Parameters of a learned effect: a factor on the whole law, and where a law that repeats in time stands when a recording begins; half a
turn is its other sign."""

LARGEST = 1e12
"""Largest value of a curve, as of any column of a recording."""

PROBED = 1001
"""Number of values of the driver, over the range of a law, at which its formula is tried when it is read."""

MOST_LETTERS = 500
"""Longest formula: a law that is longer is a table."""


class LawNotFinite(ConfigError, ValueError):
    """A law gives inf, NaN or a number that overflows sooner or later."""


@lru_cache(maxsize=4096)
def formula_of(text: str) -> Callable[[Floats], Floats]:
    """Compile a formula of x: numbers, x, pi, + - * / **, and the functions of _FUNCTIONS. Nothing else is evaluated.

    Where it has no value it gives inf or NaN.

    Raises:
        ValueError: The text is no such formula.
    """
    expected = f"expected numbers, x, pi, + - * / ** and {', '.join(_FUNCTIONS)}"
    if len(text) > MOST_LETTERS:
        raise ValueError(f"the formula has {len(text)} letters, expected at most {MOST_LETTERS}; give knots and values")
    try:
        tree = ast.parse(text, mode="eval").body
    except (SyntaxError, RecursionError, MemoryError):
        raise ValueError(f"{text!r} is no formula; {expected}") from None

    def value(node: ast.AST, x: Floats) -> Floats:
        match node:
            case ast.Constant(value=int() | float() as number):
                return np.float64(number)  # type: ignore[return-value]
            case ast.Name(id="x"):
                return x
            case ast.Name(id="pi"):
                return np.float64(np.pi)  # type: ignore[return-value]
            case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
                return _OPERATORS[type(op)](value(left, x), value(right, x))
            case ast.UnaryOp(op=op, operand=operand) if type(op) in _OPERATORS:
                return _OPERATORS[type(op)](value(operand, x))
            case ast.Call(func=ast.Name(id=name), args=args, keywords=[]) if len(args) == _ARGUMENTS.get(name):
                return _FUNCTIONS[name](*(value(argument, x) for argument in args))
        raise ValueError(f"{text!r} holds {ast.unparse(node)!r}; {expected}")

    def evaluated(x: Floats) -> Floats:
        with np.errstate(all="ignore"):
            return np.broadcast_to(value(tree, x), x.shape).astype(float)

    evaluated(np.ones(1))
    return evaluated


class Term(StrictBlock):
    """One term: channels += weights × factor × curve(driver).

    Attributes:
        channels: Weight of every channel that the term acts on; lateral forces come with the torques of their arm.
        factor: What the curve is multiplied with; it says what kind of law the term is.
        driver: What the curve is drawn over.
        knots: Values of the driver (k,), ascending, in its unit.
        values: The curve there (k,), in the unit of the channels over that of the factor; m for a moved surface.
        sd: Standard deviation of the values (k,); empty where not known.
        range: Values of the driver that the recording held; outside them the curve is held.
        formula: The curve as a formula of x, the driver in its unit; it replaces `values`.
    """

    channels: dict[ChannelName, StrictFloat]
    factor: FactorName
    driver: Driver
    knots: tuple[StrictFloat, ...]
    values: tuple[StrictFloat, ...]
    sd: tuple[StrictFloat, ...] = ()
    range: tuple[StrictFloat, StrictFloat]
    formula: str | None = None

    @model_validator(mode="after")
    def _fits_together(self) -> "Term":
        if not self.channels:
            raise ValueError("channels names no channel; give one such as fz_N: 1.0")
        if len(self.knots) != len(self.values) or not self.knots or len(self.sd) not in (0, len(self.knots)):
            raise ValueError(
                f"{len(self.knots)} knots, {len(self.values)} values and {len(self.sd)} sd; expected one of each for every knot"
            )
        if any(b <= a for a, b in zip(self.knots[:-1], self.knots[1:], strict=True)) or self.range[0] > self.range[1]:
            raise ValueError("knots or range do not ascend; give them from the smallest to the largest")
        if not np.all(np.abs(self.values) <= LARGEST):
            raise ValueError(f"values hold {max(self.values, key=abs):g}, expected numbers up to {LARGEST:g}; correct them")
        if self.formula is not None:
            formula_of(self.formula)
            self.curve(np.linspace(*self.range, PROBED) if self.driver.period is None else np.linspace(0.0, self.driver.period, PROBED))
        return self

    @property
    def words(self) -> str:
        """The term in words."""
        names = list(self.channels)
        lateral = " to the side" if any(name in ("fx_N", "fy_N") for name in names) else ""
        lateral = f" on {names[0].split('_')[0]}" if len(names) == 1 and names[0] not in ("fz_N", "z_m") else lateral
        words = FACTOR_WORDS[self.factor]
        if "z_m" in self.channels:
            words = words.replace("an added force", "an added height")
        return f"{words}{lateral} {self.driver.dependence}"

    def curve(self, x: Floats) -> Floats:
        """The curve, held outside its range.

        Args:
            x: Values (n,) of the driver, in its unit.

        Returns:
            Values (n,).

        Raises:
            LawNotFinite: The formula has no value somewhere in its range.
        """
        if self.driver.period is None:
            x = np.clip(x, *self.range)
        if self.formula is not None:
            values = formula_of(self.formula)(x)
            wrong = np.flatnonzero(~(np.abs(values) <= LARGEST))
            if len(wrong):
                raise LawNotFinite(
                    f"the formula {self.formula} is {values[wrong[0]]:g} at x = {x[wrong[0]]:g}, expected a finite number up to "
                    f"{LARGEST:g} in its whole range; correct the formula or the range"
                )
            return values
        knots = np.asarray(self.knots, float)
        # Knots of a curve that repeats lie in [0, period], where the coordinate would fold the last one back.
        at = knots if self.driver.period else self.driver.coordinate(knots)
        return np.interp(self.driver.coordinate(x), at, np.asarray(self.values, float), period=self.driver.period)

    def outside(self, x: Floats) -> NDArray[np.bool_]:
        """Where the curve is held, because the driver leaves the range.

        Args:
            x: Values (n,) of the driver, in its unit.

        Returns:
            Flags (n,).
        """
        if self.driver.period is not None:
            return np.zeros(len(x), bool)
        slack = 1e-3 * (self.range[1] - self.range[0])
        return np.asarray((x < self.range[0] - slack) | (x > self.range[1] + slack))

    @property
    def of_phase(self) -> bool:
        """Whether it repeats in time."""
        return self.driver.quantity == "time" and self.driver.period is not None

    def at(self, factor: float, shift_s: float) -> "Term":
        """The term with its curve multiplied by a number; one that repeats in time also has its clock ahead.

        Args:
            shift_s: By how much the clock is ahead.
        """
        if self.of_phase and shift_s:
            curve = self.curve(np.asarray(self.knots, float) + shift_s)
            return self.model_copy(update={"values": tuple((factor * curve).tolist()), "sd": (), "formula": None})
        if factor == 1.0:
            return self
        values, sd = tuple(factor * value for value in self.values), tuple(abs(factor) * sd for sd in self.sd)
        formula = None if self.formula is None else f"{factor:.6g} * ({self.formula})"
        return self.model_copy(update={"values": values, "sd": sd, "formula": formula})


class LearnedEffect(StrictBlock):
    """A law that a recording showed and that no library effect is.

    Attributes:
        id: Its name, such as `learned.stiff_foam`.
        what: What it does, in words.
        site: `probe` for readings of the sensor, `robot` for heights.
        rest_speed_m_per_s: Speed v0 at which friction turns over; direction is tanh(v / v0).
        terms: One or two terms.
        alike: Drivers, in words, that the recording could not tell from the one that is used.
        probability: Probability that a law like this is at work; None where the file does not say.
        confounds: Listed effects that imitate the law on the motion that it was learned from: the cosine of the angle between its change
            and what the effect can make, with everything within specification projected out. None where that was not measured.
    """

    id: Annotated[str, Field(pattern=r"^learned\.\w+$")]
    what: str = ""
    site: Literal["probe", "robot"] = "probe"
    rest_speed_m_per_s: Annotated[StrictFloat, Field(gt=0.0)] = 0.5e-3
    terms: tuple[Term, ...] = Field(min_length=1)
    alike: tuple[str, ...] = ()
    probability: Annotated[StrictFloat, Field(ge=0.0, le=1.0)] | None = None
    confounds: dict[str, Annotated[StrictFloat, Field(ge=0.0, le=1.0)]] | None = None

    @model_validator(mode="after")
    def _acts_at_its_site(self) -> "LearnedEffect":
        for term in self.terms:
            if ("z_m" in term.channels) != (self.site == "robot") or (self.site == "robot" and len(term.channels) > 1):
                raise ValueError(
                    f"channels {', '.join(term.channels)} do not belong to site {self.site}; robot has z_m alone, probe has the others"
                )
        return self

    def state(self, s: Span) -> DriverState:
        """The moving probe as this effect's drivers see it."""
        return (DriverState.of_robot if self.site == "robot" else DriverState.of_contact)(s, self.rest_speed_m_per_s)

    def act(self, s: Span, values: Values, memory: Memory) -> None:
        """Change a stretch of samples.

        Args:
            values: `strength`, a factor on the whole law, and `phase_rad` of a law that repeats in time.
            memory: State that is carried from one stretch of samples to the next, and how many samples were outside the range.
        """
        state = self.state(s)
        held, shift_s = np.zeros(len(s.t_s), bool), self._shift_s(values)
        for number, term in enumerate(self.terms):
            remembered = memory.setdefault(f"term {number}", {})
            x = driver_values(term.driver, state, remembered) + (shift_s if term.of_phase else 0.0)
            curve = values["strength"] * term.curve(x)
            held |= term.outside(x)
            change = _moved_surface_N(s, curve) if term.factor == "surface" else curve * factor_values(term.factor, state)
            if self.site == "robot":
                _move(s, change * term.channels["z_m"], remembered, through_servo=term.driver.acts_on_target)
                continue
            for name, weight in term.channels.items():
                setattr(s, name, getattr(s, name) + weight * change)
        memory["samples"] = memory.get("samples", 0) + len(held)
        memory["held"] = memory.get("held", 0) + int(np.count_nonzero(held))

    def outside(self, s: Span) -> Floats:
        """Samples at which a driver leaves its range, so that the curve is held there.

        Args:
            s: Samples (n,) at the stage at which the effect acts.

        Returns:
            1 outside, 0 inside (n,).
        """
        each = [term.outside(driver_values(term.driver, self.state(s), {})) for term in self.terms]
        return np.any(each, axis=0).astype(float)

    @property
    def as_learned(self) -> dict[str, float]:
        """The parameters at which the effect is the law as it was learned."""
        return {parameter.name: 0.0 if parameter is PHASE else 1.0 for parameter in self.effect().parameters}

    def at(self, values: Values) -> "LearnedEffect":
        """The law with these values of its parameters as part of its curves.

        Args:
            values: `strength`, and `phase_rad` of a law that repeats in time.

        Returns:
            The law that is the effect at those values.
        """
        shift_s = self._shift_s(values)
        return self.model_copy(update={"terms": tuple(term.at(values["strength"], shift_s) for term in self.terms)})

    def _shift_s(self, values: Values) -> float:
        """By how much its clock is ahead: no two recordings begin at the same moment of something that repeats in time."""
        period_s = next((term.driver.period for term in self.terms if term.of_phase), None) or 0.0
        return values.get(PHASE.name, 0.0) / (2.0 * np.pi) * period_s

    def effect(self) -> Effect:
        """The effect of a library that it is, with a factor on the whole law as its parameter."""
        return Effect(
            self.id,
            self.site,
            self.what or "; ".join(term.words for term in self.terms),
            (SIZE, PHASE) if any(term.of_phase for term in self.terms) else (STRENGTH,),
            law=self.act,
            starts_at_tare=self.site == "probe" and any(term.factor in ("one", "air", "pushing") for term in self.terms),
            motion=self.site == "robot",
        )


def held_sentence(name: str, share: float, what: str = "rows") -> str:
    """The sentence that says how far a law was used outside its range.

    Args:
        name: The learned effect.
        share: Share of the samples.
        what: What the samples are.
    """
    return f"{name}: {share:.1%} of the {what} lie outside the range that it was learned in; its curve is held there."


def learned_law_of(effect: Effect) -> LearnedEffect | None:
    """The learned law behind an effect of a library; None where it is another kind of effect."""
    law = getattr(effect.law, "__self__", None)
    return law if isinstance(law, LearnedEffect) else None


def _moved_surface_N(s: Span, up_m: Floats) -> Floats:
    """Change of the force where the surface is higher by `up_m`."""
    gap_m = s.tip_m - s.surface_m
    elastic = s.elastic_force_N
    return elastic(np.maximum(up_m - gap_m, 0.0)) - elastic(np.maximum(-gap_m, 0.0))


def _move(s: Span, up_m: Floats, memory: Memory, *, through_servo: bool) -> None:
    """Add to the height, directly or as a change of the target that the servo follows, with the speed and acceleration of that."""
    if through_servo:
        c = s.constants
        z, v, a = servo(up_m, s.dt_s, c.servo_natural_frequency_Hz, c.servo_damping_ratio, memory.setdefault("servo", {}))
    else:
        z = up_m
        v = np.diff(z, prepend=memory.get("z", z[0])) / s.dt_s
        a = np.diff(v, prepend=memory.get("v", 0.0)) / s.dt_s
        memory["z"], memory["v"] = z[-1], v[-1]
    s.z_m, s.vz_m_per_s, s.az_m_per_s2 = s.z_m + z, s.vz_m_per_s + v, s.az_m_per_s2 + a


class LearnedFile(StrictBlock):
    """A file of learned effects."""

    learned: tuple[LearnedEffect, ...] = Field(min_length=1)


def load_learned(path: str | Path) -> tuple[LearnedEffect, ...]:
    """Read a file of learned effects, or the block `learned` of a file with that block alone.

    Args:
        path: The YAML file.

    Raises:
        ConfigError: Where it is no such file, one sentence that names line and key.
    """
    document = read_yaml(Path(path))
    try:
        return LearnedFile.model_validate(document.keys_and_values()).learned
    except ValidationError as error:
        raise ConfigError(refusal(error, LearnedFile, document)) from None


def save_learned(path: str | Path, learned: Iterable[LearnedEffect]) -> None:
    """Write a file that `load_learned` reads back equal.

    Raises:
        BadInput: The file cannot be written.
    """
    content = {"learned": [one.model_dump(mode="json", exclude_none=True) for one in learned]}
    write_yaml(Path(path), in_yaml(content))


def in_yaml(content: object) -> str:
    """Data as YAML, in the order of its keys, with lists of numbers in one line."""
    text: str = yaml.dump(content, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=140)
    return text


class _Dumper(yaml.SafeDumper):
    """Writes lists of numbers in one line, so that a person sees knots above values."""


def _list(dumper: _Dumper, values: list[object]) -> yaml.Node:
    return dumper.represent_sequence("tag:yaml.org,2002:seq", values, flow_style=all(isinstance(v, int | float) for v in values) or None)


_Dumper.add_representer(list, _list)
