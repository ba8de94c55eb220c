"""What an effect is: a name, a site, parameters with unit and bounds, and a law.

A law is one of two pure functions: `setting` changes the numbers of the cell (its mass, its gain) before anything happens,
`law` changes a stretch of samples when the nominal physics of its site has been computed. What a law must remember from block to
block it keeps in its `memory`, which is empty where a recording begins. Bounds and starting values are functions of a Scale, that
is of the cell file and the recording, so that no effect knows how large a cell is.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import pi
from typing import Literal

from palpd.cell.dynamics import Memory
from palpd.cell.span import Constants, Span
from palpd.errors import ConfigError

Site = Literal["robot", "tip", "tissue", "probe", "clock", "sensor"]
SITES: tuple[Site, ...] = ("robot", "tip", "tissue", "probe", "clock", "sensor")
"""In the order in which the physics of a cell passes them."""

DiscrepancyDriver = Literal["time", "depth", "speed", "rest"]
TIME: tuple[DiscrepancyDriver, ...] = ("time",)
LOAD: tuple[DiscrepancyDriver, ...] = ("time", "depth")
ANY: tuple[DiscrepancyDriver, ...] = ("time", "depth", "speed", "rest")
"""Quantities on which the error of an effect's law may depend."""

ScatterKind = Literal["noise", "coarse step", "held samples"]

Values = Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Scale:
    """How large things are in this cell and recording: what bounds and starting values are multiples of."""

    force_N: float
    depth_m: float
    stroke_m: float
    speed_m_per_s: float
    duration_s: float
    step_s: float
    noise_N: float
    mass_kg: float
    tip_radius_m: float
    tip_length_m: float
    cutoff_Hz: float
    servo_natural_frequency_Hz: float

    @property
    def stiffness_N_per_m(self) -> float:
        """Secant stiffness of the deepest press."""
        return self.force_N / self.depth_m

    @property
    def contact_radius_m(self) -> float:
        """Radius of the contact of the deepest press, √(r d)."""
        return (self.tip_radius_m * self.depth_m) ** 0.5

    @property
    def range_N(self) -> float:
        """More than any effect on the force can sensibly be."""
        return self.force_N + 20.0 * self.noise_N

    @property
    def nyquist_Hz(self) -> float:
        """Highest frequency that the recording can show."""
        return 0.5 / self.step_s


Bound = float | Callable[[Scale], float]
Starts = tuple[float, ...] | Callable[[Scale], tuple[float, ...]]


def of(quantity: str, *shares: float) -> Callable[[Scale], tuple[float, ...]]:
    """Starting values that are shares of a quantity of the scale.

    Args:
        quantity: Name of an attribute of Scale.
        shares: Factors of it, the most typical first.

    Returns:
        The starting values as a function of the scale, in the unit of the quantity.
    """
    return lambda scale: tuple(share * float(getattr(scale, quantity)) for share in shares)


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number of an effect: its unit, the range it is sought in, where to start, and the value at which it does nothing.

    `nominal` is None where another parameter of the effect switches it off. `log` means that its order of magnitude is unknown and
    that it is positive throughout its range. `optional` means that the law also works without it; a diagnosis tries both. `natural` is
    the largest size that working parts have: a diagnosis doubts and reports a larger one. `choices` are the only values that it can
    have, the usual one first; a diagnosis tries each. A `nuisance` says by which of several laws real
    cells show the effect: it is optional, a diagnosis fits it, and no file names it. `words` say what it is where its name does not.
    """

    name: str
    unit: str
    lower: Bound
    upper: Bound
    typical: Starts
    nominal: Bound | None = 0.0
    log: bool = False
    optional: bool = False
    natural: float | None = None
    choices: tuple[float, ...] = ()
    nuisance: bool = False
    words: str = ""

    @property
    def label(self) -> str:
        """What it is, for people: its words, else its name without the unit."""
        unit = self.unit.replace("/", "_per_").replace(" ", "_")
        return self.words or self.name.removesuffix(f"_{unit}").replace("_", " ")

    def bounds(self, scale: Scale) -> tuple[float, float]:
        """The range to search, (lower, upper)."""
        return _at(self.lower, scale), _at(self.upper, scale)

    def starts(self, scale: Scale) -> tuple[float, ...]:
        """Where to start a fit, the most typical first; inside the range."""
        lower, upper = self.bounds(scale)
        values = self.typical(scale) if callable(self.typical) else self.typical
        return tuple(min(max(value, lower), upper) for value in values)

    def nominal_value(self, scale: Scale) -> float | None:
        """The value at which the effect is not there (may be infinite), or None."""
        return None if self.nominal is None else _at(self.nominal, scale)


def _at(bound: Bound, scale: Scale) -> float:
    return float(bound(scale)) if callable(bound) else float(bound)


DEAD_BAND = 6.0
"""Width of the dead band before a loop, in rms of the noise of its drive: rest then moves nothing."""

SLOW_ZERO = "slow shifts of the zero of fz"
SCALE_OF_FORCE = "constant factors on the contact force"
STIFFENING = "causes of a contact that stiffens with depth"
SIDEWAYS = "causes of lateral readings that follow the force along z"
"""Families of effects, as plural nouns: `Other … would look the same.`"""

AZIMUTH = Parameter("azimuth_rad", "rad", -pi, pi, (0.0, pi / 2, pi, -pi / 2), nominal=None)


def relaxation_time(*shares: float, of_a_press: float = 0.0) -> Parameter:
    """A time constant `tau_s` between one sample and five recordings.

    Args:
        shares: Starting values as shares of the duration of the recording.
        of_a_press: Shortest time constant as a share of the time in which a press reaches its depth.

    Returns:
        The parameter, in s.
    """
    starts = of("duration_s", *shares)

    def shortest(s: Scale) -> float:
        return max(s.step_s, of_a_press * s.depth_m / s.speed_m_per_s)

    return Parameter("tau_s", "s", shortest, lambda s: 5.0 * s.duration_s, starts, nominal=None, log=True, words="time constant")


@dataclass(frozen=True, slots=True)
class Effect:
    """A named change of the nominal physics.

    Attributes:
        id: Site and name, such as `sensor.gain`.
        site: The stage of the physics at which it acts.
        what: What it does, as a sentence for people without its first capital and its full stop. What stands before a colon is enough
            where causes are listed; behind it stands how it shows.
        parameters: Its numbers, with unit and bounds.
        law: Changes a stretch of samples; None where `setting` is given.
        setting: Changes the numbers of the cell; None where `law` is given.
        starts_at_tare: It counts from the first row of a recording and is absent before that, so the tare does not see it.
        scatter: The kind of change, for an effect that changes scatter or lattice of the readings and leaves their mean nearly alone;
            None for all others.
        moves_surface: It changes the height at which the tip touches.
        motion: The robot reports it: it shows in the heights and not in a force that is predicted from the measured motion.
        family: A plural noun for all laws, listed or not, that most motions can hardly distinguish from it; None where it has no such name.
        tolerance: Key in the cell file's tolerances of the deviation that this effect is when it exceeds its tolerance.
        shows_at_rest: It changes the force while the height is held.
        gain_at_rest: Factor on a force that has been held for a time (values, time in s), where it settles that fast.
        discrepancy_drivers: What the error of its law may depend on; a zero that drifts does not depend on motion.
        formula: Its law for people, with the names of its parameters without their units.
    """

    id: str
    site: Site
    what: str
    parameters: tuple[Parameter, ...]
    law: Callable[[Span, Values, Memory], None] | None = None
    setting: Callable[[Constants, Values], None] | None = None
    starts_at_tare: bool = False
    scatter: ScatterKind | None = None
    moves_surface: bool = False
    motion: bool = False
    family: str | None = None
    tolerance: str | None = None
    shows_at_rest: bool = False
    gain_at_rest: Callable[[Values, float], float] | None = None
    discrepancy_drivers: tuple[DiscrepancyDriver, ...] = ANY
    formula: str = ""

    def __post_init__(self) -> None:
        """An effect without any law is a mistake of its author, and so is a site that does not exist."""
        if (self.law is None) == (self.setting is None):
            raise ConfigError(
                f"effect {self.id} has {'no law' if self.law is None else 'both a law and a setting'}; give it one of the two"
            )
        if self.site not in SITES:
            raise ConfigError(f"effect {self.id} stands at site {self.site!r}; expected one of {', '.join(SITES)}")

    @property
    def cause(self) -> str:
        """What it is, in few words."""
        return self.what.partition(":")[0]

    @property
    def named_parameters(self) -> tuple[Parameter, ...]:
        """The parameters that files name."""
        return tuple(parameter for parameter in self.parameters if not parameter.nuisance)

    def parameter(self, name: str) -> Parameter:
        """The parameter of that name."""
        return next(parameter for parameter in self.parameters if parameter.name == name)
