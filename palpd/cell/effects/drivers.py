"""What a learned law can be a function of: quantities of the moving probe, their memories, and factors.

Everything here is causal and keeps its state in a `memory`, so that blocks of samples give what the whole recording gives. The search
for a law and the simulator that carries it use the same functions.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, StrictFloat, model_validator

from palpd.cell.dynamics import Column, Floats, Memory, lowpass, play
from palpd.cell.span import Span
from palpd.quantities import quantity

Quantity = Literal[
    "time", "height", "gap", "depth", "force", "force_rate", "speed", "acceleration", "direction", "time_in_contact", "time_in_motion",
    "deepest", "presses", "contact", "air", "absolute_speed", "squared_speed", "power", "command",
]  # fmt: skip
FactorName = Literal["one", "force", "surface", "speed", "direction", "force_direction", "air", "pushing", "acceleration"]
Remembered = Literal["relaxed", "play", "stop", "slew"]

UNITS: dict[Quantity, str] = {
    "time": "s", "height": "m", "gap": "m", "depth": "m", "force": "N", "force_rate": "N/s", "speed": "m/s", "acceleration": "m/s²",
    "direction": "1", "time_in_contact": "s", "time_in_motion": "s", "deepest": "m", "presses": "1", "contact": "1", "air": "1",
    "absolute_speed": "m/s", "squared_speed": "m²/s²", "power": "W", "command": "m",
}  # fmt: skip
WORDS: dict[Quantity, str] = {
    "time": "the time since the start",
    "height": "the height of the probe",
    "gap": "the distance from the surface",
    "depth": "the depth of the press",
    "force": "the contact force",
    "force_rate": "the rate of the contact force",
    "speed": "the speed",
    "acceleration": "the acceleration",
    "direction": "the direction of motion",
    "time_in_contact": "the time since contact began or ended",
    "time_in_motion": "the time since motion began or ended",
    "deepest": "the deepest press until then",
    "presses": "the number of presses",
    "contact": "contact",
    "air": "time in the air",
    "absolute_speed": "the absolute speed",
    "squared_speed": "the square of the speed",
    "power": "contact force times absolute speed",
    "command": "the commanded height",
}
FACTOR_WORDS: dict[FactorName, str] = {
    "one": "an added force",
    "force": "a share of the contact force",
    "surface": "a moved surface",
    "speed": "a damping",
    "direction": "a friction",
    "force_direction": "a friction in proportion to the contact force",
    "air": "an added force in the air",
    "pushing": "an added force while the probe moves down",
    "acceleration": "a moving mass",
}
FAMILIES: dict[str, str] = {"depth": "with how deep it presses", "force": "with how deep it presses"}


class StrictBlock(BaseModel):
    """One block of a file: no key but these, and nothing infinite."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Driver(StrictBlock):
    """What a curve is drawn over.

    Attributes:
        quantity: The quantity, in SI units.
        memory: `relaxed`: low-pass from zero; `play`: follower with a dead band; `stop`: the quantity less that follower; `slew`: a
            follower of limited speed, less the quantity.
        constant: Time constant in s, width of the dead band, or largest speed of the follower, in SI units; None without `memory`.
        period: Period, in the unit of the quantity, of a curve that repeats; None: it does not.
        log_scale: The curve is straight between its knots over asinh(x / log_scale); over x where not given.
    """

    quantity: Quantity
    memory: Remembered | None = None
    constant: Annotated[StrictFloat, Field(gt=0.0)] | None = None
    period: Annotated[StrictFloat, Field(gt=0.0)] | None = None
    log_scale: Annotated[StrictFloat, Field(gt=0.0)] | None = None

    @model_validator(mode="after")
    def _complete(self) -> "Driver":
        if (self.memory is None) != (self.constant is None):
            raise ValueError("memory and constant belong together; give both or neither")
        return self

    @property
    def acts_on_target(self) -> bool:
        """Whether a law of heights changes the target that the servo follows, and not the height itself."""
        return self.quantity == "command"

    @property
    def words(self) -> str:
        """The driver in words."""
        words, unit, constant = WORDS[self.quantity], UNITS[self.quantity], self.constant or 0.0
        if self.memory == "relaxed":
            words = f"{words}, low-passed with a time constant of {quantity(constant, 's')}"
        elif self.memory in ("play", "stop"):
            words = f"{words} with a dead band of {quantity(constant, unit)}"
        elif self.memory == "slew":
            words = f"how far a speed limit of {quantity(constant, unit)}/s holds back {words}"
        return f"{words}, repeating every {quantity(self.period, unit)}" if self.period else words

    @property
    def dependence(self) -> str:
        """How something follows the driver, in words that go on after it."""
        if self.period is None or self.memory is not None:
            return f"that depends on {self.words}"
        of = "" if self.quantity == "time" else f" of {WORDS[self.quantity].removeprefix('the ').partition(' of the ')[0]}"
        return f"that repeats every {quantity(self.period, UNITS[self.quantity])}{of}"

    def coordinate(self, x: Floats) -> Floats:
        """The coordinate over which the curve is straight between knots.

        Args:
            x: Values (n,) of the driver, in SI units.

        Returns:
            Coordinates (n,).
        """
        if self.period is not None:
            return np.asarray(np.mod(x, self.period))
        return x if self.log_scale is None else np.arcsinh(x / self.log_scale)


@dataclass(frozen=True, slots=True)
class DriverState:
    """The moving probe, in arrays of (n,): `gap_m` is the height of the tip above the surface, `force_N` the force of the contact."""

    t_s: Floats
    dt_s: Column
    z_m: Floats
    v_m_per_s: Floats
    a_m_per_s2: Floats
    gap_m: Floats
    force_N: Floats
    stiffness_N_per_m: Floats
    command_m: Floats
    rest_speed_m_per_s: float

    @staticmethod
    def of_contact(s: Span, rest_speed_m_per_s: float) -> "DriverState":
        """The state where the contact force is known.

        Args:
            s: Samples at the stage of the probe.
            rest_speed_m_per_s: Speed at which friction turns over.
        """
        gap_m = s.tip_m - s.surface_m
        if not np.isfinite(gap_m).all():  # there is no tissue
            gap_m = np.zeros_like(s.z_m)
        depth_m = np.maximum(-gap_m, 0.0)
        slope = np.where(depth_m > 0.0, 1.5 * s.elastic_force_N(depth_m) / np.maximum(depth_m, 1e-300), 0.0)
        v, a = s.vz_m_per_s, s.az_m_per_s2
        return DriverState(s.t_s, s.dt_s, s.z_m, v, a, gap_m, s.contact_N, slope, s.z_m, rest_speed_m_per_s)

    @staticmethod
    def of_robot(s: Span, rest_speed_m_per_s: float) -> "DriverState":
        """The state of a robot that follows its target, with the target that its second-order servo must have had.

        Args:
            s: Samples at the stage of the robot.
            rest_speed_m_per_s: Speed below which it rests.

        Returns:
            The state, without contact.
        """
        omega = 2.0 * np.pi * s.constants.servo_natural_frequency_Hz
        z, v, a, none = s.z_m, s.vz_m_per_s, s.az_m_per_s2, np.zeros_like(s.z_m)
        target_m = z + 2.0 * s.constants.servo_damping_ratio / omega * v + a / omega**2
        return DriverState(s.t_s, s.dt_s, z, v, a, none, none, none, target_m, rest_speed_m_per_s)

    @property
    def depth_m(self) -> Floats:
        """Depth below the surface (n,)."""
        return np.maximum(-self.gap_m, 0.0)

    @property
    def direction(self) -> Floats:
        """Direction of motion (n,), -1 to 1, 0 at rest."""
        return np.asarray(np.tanh(self.v_m_per_s / self.rest_speed_m_per_s))

    @property
    def contact(self) -> Floats:
        """1 in contact, 0 in the air (n,)."""
        return np.asarray((self.gap_m < 0.0).astype(float))


def _since_change(on: Floats, t_s: Floats, memory: Memory) -> Floats:
    """Time since a flag (n,) last changed, or since the first sample."""
    changed = np.diff(on, prepend=memory.get("on", on[0])) != 0.0
    last_s = np.maximum.accumulate(np.concatenate(([memory.get("last_s", t_s[0])], np.where(changed, t_s, -np.inf))))[1:]
    memory["on"], memory["last_s"] = on[-1], last_s[-1]
    return np.asarray(t_s - last_s)


def _deepest(s: DriverState, memory: Memory) -> Floats:
    deepest_m = np.maximum.accumulate(np.concatenate(([memory.get("deepest_m", 0.0)], s.depth_m)))[1:]
    memory["deepest_m"] = deepest_m[-1]
    return np.asarray(deepest_m)


def _presses(s: DriverState, memory: Memory) -> Floats:
    """Number of contacts until then; one that ends within the noise of the heights counts like any other."""
    on = s.contact
    begun = np.cumsum(np.diff(on, prepend=memory.get("on", 0.0)) > 0.0) + memory.get("count", 0.0)
    memory["on"], memory["count"] = on[-1], begun[-1]
    return np.asarray(begun)


def _moving(s: DriverState) -> Floats:
    return np.asarray((np.abs(s.v_m_per_s) > 2.0 * s.rest_speed_m_per_s).astype(float))


_OF: dict[Quantity, Callable[[DriverState, Memory], Floats]] = {
    "time": lambda s, _: s.t_s,
    "height": lambda s, _: s.z_m,
    "gap": lambda s, _: s.gap_m,
    "depth": lambda s, _: s.depth_m,
    "force": lambda s, _: s.force_N,
    "force_rate": lambda s, _: -s.stiffness_N_per_m * s.v_m_per_s,
    "speed": lambda s, _: s.v_m_per_s,
    "acceleration": lambda s, _: s.a_m_per_s2,
    "direction": lambda s, _: s.direction,
    "time_in_contact": lambda s, m: _since_change(s.contact, s.t_s, m),
    "time_in_motion": lambda s, m: _since_change(_moving(s), s.t_s, m),
    "deepest": _deepest,
    "presses": _presses,
    "contact": lambda s, _: s.contact,
    "air": lambda s, _: 1.0 - s.contact,
    "absolute_speed": lambda s, _: np.abs(s.v_m_per_s),
    "squared_speed": lambda s, _: s.v_m_per_s**2,
    "power": lambda s, _: s.force_N * np.abs(s.v_m_per_s),
    "command": lambda s, _: s.command_m,
}


def driver_values(driver: Driver, s: DriverState, memory: Memory) -> Floats:
    """Values of a driver over a stretch of samples.

    Args:
        s: The moving probe.
        memory: State that is carried from one stretch of samples to the next.

    Returns:
        Values (n,) in SI units.
    """
    x = _OF[driver.quantity](s, memory)
    if driver.memory is None or driver.constant is None:
        return x
    if driver.memory == "relaxed":
        return np.real(lowpass(x, s.dt_s, -1.0 / driver.constant, memory.setdefault("relaxed", {}), 0.0))
    if driver.memory == "slew":
        return _follow(x, np.broadcast_to(s.dt_s, len(x)) * driver.constant, memory) - x
    follower = play(x + 0.0, driver.constant, memory)
    return follower if driver.memory == "play" else x - follower


def _follow(x: Floats, most: Floats, memory: Memory) -> Floats:
    """Follower that moves by at most `most` (n,) from sample to sample."""
    y = np.empty_like(x)
    last = memory.get("follower", float(x[0]))
    for k, (target, step) in enumerate(zip(x.tolist(), most.tolist(), strict=True)):
        last = min(max(target, last - step), last + step)
        y[k] = last
    memory["follower"] = last
    return y


def factor_values(factor: FactorName, s: DriverState) -> Floats:
    """What a curve is multiplied with.

    Args:
        factor: Its name; that of a moved surface is taken to first order, as the slope of the force.
        s: The moving probe.

    Returns:
        Factors (n,), in SI units.
    """
    of: dict[FactorName, Callable[[], Floats]] = {
        "one": lambda: np.ones_like(s.z_m),
        "force": lambda: s.force_N,
        "surface": lambda: s.stiffness_N_per_m,
        "speed": lambda: s.v_m_per_s,
        "direction": lambda: s.direction,
        "force_direction": lambda: s.force_N * s.direction,
        "air": lambda: 1.0 - s.contact,
        "pushing": lambda: 0.5 * (1.0 - s.direction),
        "acceleration": lambda: s.a_m_per_s2,
    }
    return of[factor]()
