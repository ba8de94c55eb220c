"""cell.yaml: what the simulator believes about a cell, and how exactly it is known.

Absent blocks and keys get the defaults of a nominal cell; unknown keys, effects and parameters are refused.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, BeforeValidator, Field, StrictFloat, StrictInt, ValidationError, model_validator

from palpd.cell.effects import EFFECTS, Effect
from palpd.cell.effects.drivers import StrictBlock
from palpd.cell.effects.learned import LearnedEffect, in_yaml
from palpd.documents import Document, nearest, read_yaml, refusal
from palpd.errors import ConfigError
from palpd.file_versions import NEWEST_FILE, newer, refuse_renamed
from palpd.files import write_yaml

T = TypeVar("T", bound="StrictBlock")


def _without_nulls(values: Any) -> Any:
    """Parameters of an effect without those that are null: null and absent mean the same."""
    return {name: value for name, value in values.items() if value is not None} if isinstance(values, Mapping) else values


EffectValues = dict[str, Annotated[dict[str, StrictFloat], BeforeValidator(_without_nulls)]]
Positive = Annotated[StrictFloat, Field(gt=0.0, le=1e15)]
NotNegative = Annotated[StrictFloat, Field(ge=0.0, le=1e15)]
Length = Annotated[StrictFloat, Field(gt=0.0, lt=1.0)]
Height = Annotated[StrictFloat, Field(gt=-10.0, lt=10.0)]
Modulus = Annotated[StrictFloat, Field(ge=1.0, le=1e13)]
HINTS = {"_m": "is it in millimetres?", "youngs_modulus_Pa": "is it in kPa or MPa?"}
"""Questions about a value out of range, by the end of its key."""


def _known(version: int) -> int:
    if sentence := newer(version, NEWEST_FILE, "the file"):
        raise ValueError(sentence)
    return version


Version = Annotated[StrictInt, Field(ge=1), AfterValidator(_known)]
"""The key `version` of a file; it stands first in a model, so that a newer file is refused for its version and not for a new key."""


class ProbeBlock(StrictBlock):
    """What hangs on the sensor: its moving mass, its spherical tip, and how far that is from the sensor."""

    mass_kg: NotNegative = 0.2
    """Moving mass: everything that hangs on the sensor."""
    tip_radius_m: Length = 0.005
    """Radius of the spherical tip."""
    tip_length_m: Annotated[StrictFloat, Field(ge=0.0, lt=5.0)] = 0.08
    """Distance from the sensor to the tip: the arm of lateral forces."""


class SensorBlock(StrictBlock):
    """The force sensor as its data sheet has it; `filter_cutoff_Hz` None is no filter, `stiffness_N_per_m` None is rigid."""

    rate_Hz: Positive = 500.0
    """Samples per second."""
    filter_cutoff_Hz: Positive | None = 150.0
    """Cutoff of the one-pole low-pass; null: none."""
    noise_rms_N: Positive = 0.05
    """Noise of a sample of force; absent: as the recording shows."""
    noise_rms_Nm: NotNegative = 0.001
    """Noise of a sample of torque; absent: as the recording shows."""
    resolution_fxy_N: NotNegative = 0.024
    """Smallest step of fx and fy; absent: as the recording shows."""
    resolution_fz_N: NotNegative = 0.131
    """Smallest step of fz; absent: as the recording shows."""
    resolution_Nm: NotNegative = 0.001
    """Smallest step of the torques; absent: as the recording shows."""
    stiffness_N_per_m: Positive | None = None
    """Known stiffness of a cantilever or load cell; null: rigid."""


class RobotBlock(StrictBlock):
    """How the tip follows its target, and how noisily that is reported."""

    servo_natural_frequency_Hz: Positive = 8.0
    """Natural frequency of the servo, of second order. 8 Hz is a placeholder, not a measured UR5."""
    servo_damping_ratio: Positive = 1.0
    """Damping ratio of the servo."""
    position_noise_rms_m: NotNegative = 5.0e-6
    """Noise of reported heights."""
    velocity_noise_rms_m_per_s: NotNegative = 2.0e-4
    """Noise of reported speeds."""


class TissueBlock(StrictBlock):
    """An elastic half-space below `surface_z_m`."""

    surface_z_m: Height = 0.0
    """Height of the surface in base axes."""
    youngs_modulus_Pa: Modulus = 72000.0
    """Young's modulus of the half-space."""
    poisson_ratio: Annotated[StrictFloat, Field(ge=0.0, le=0.5)] = 0.5
    """Poisson's ratio; 0.5: incompressible."""


class Tolerances(StrictBlock):
    """One standard deviation of each deviation that is within specification.

    `gain`, `filter_cutoff`, `youngs_modulus` and `servo_natural_frequency` are relative; `crosstalk` is fx/fz and fy/fz, for torques
    times 0.05 m.
    """

    bias_N: NotNegative
    """Zero of fz after the tare; absent: 0.4 × `noise_rms_N`."""
    drift_N_per_min: NotNegative
    """Drift of that zero; absent: 0.2 × `noise_rms_N`."""
    gain: NotNegative = 0.005
    """Relative error of the force."""
    latency_s: NotNegative = 0.001
    """Delay of the wrench."""
    filter_cutoff: NotNegative = 0.05
    """Relative error of the filter's cutoff."""
    crosstalk: NotNegative = 0.003
    """fx/fz and fy/fz; for torques × 0.05 m."""
    mass_kg: NotNegative
    """Error of the moving mass; absent: 1.5 % of it."""
    youngs_modulus: NotNegative = 0.02
    """Relative error of the modulus; 1.0 or more: not known."""
    surface_z_m: NotNegative
    """Error of the surface's height; absent: 0.6 % of the tip's radius."""
    servo_natural_frequency: NotNegative = 0.02
    """Relative error of the servo's natural frequency."""

    @property
    def modulus_known(self) -> bool:
        """Whether the tissue's modulus is known at all."""
        return self.youngs_modulus < 1.0


class Repeatability(StrictBlock):
    """One standard deviation from press to press: of the height of contact, and of the stiffness (relative)."""

    surface_z_m: NotNegative
    """Height of contact; absent: 0.4 % of the tip's radius."""
    stiffness: NotNegative = 0.01
    """Relative stiffness."""


MASS_TOLERANCE = 0.015
"""Error of a stated mass, over it, where the file says nothing of it."""

CROSSTALK_ARM_M = 0.05
"""What a relative crosstalk is multiplied with to give torque per force."""


class Estimated(StrictBlock):
    """In-tolerance deviations that a diagnosis has fitted, in the units of `tolerances`; `crosstalk` is that of fx, fy, tx, ty."""

    bias_N: StrictFloat = 0.0
    """Zero of fz."""
    drift_N_per_min: StrictFloat = 0.0
    """Drift of that zero."""
    gain: StrictFloat = 0.0
    """Relative error of the force."""
    latency_s: StrictFloat = 0.0
    """Delay of the wrench."""
    filter_cutoff: Annotated[StrictFloat, Field(gt=-1.0)] = 0.0
    """Relative error of the cutoff."""
    crosstalk: tuple[StrictFloat, StrictFloat, StrictFloat, StrictFloat] = (0.0, 0.0, 0.0, 0.0)
    """Of fx, fy, tx and ty."""
    mass_kg: StrictFloat = 0.0
    """Error of the moving mass."""
    youngs_modulus: Annotated[StrictFloat, Field(gt=-1.0)] = 0.0
    """Relative error of the modulus."""
    surface_z_m: StrictFloat = 0.0
    """Error of the surface's height."""
    servo_natural_frequency: Annotated[StrictFloat, Field(gt=-1.0)] = 0.0
    """Relative error of the servo's natural frequency."""


CROSSTALK = ("fx_per_fz", "fy_per_fz", "tx_per_fz", "ty_per_fz")
"""Names of the four deviations of crosstalk."""


class OpenParameter(StrictBlock):
    """One number that a diagnosis left open, and how its standard deviation is meant.

    Attributes:
        name: `<effect>.<parameter>`, or `estimated.<deviation>`, where crosstalk has the names of CROSSTALK.
        scale: `linear`, `log` (of the value), `log1p` (of one plus the value, for relative deviations), or `angle` (in one turn).
        sd: Standard deviation on that scale.
        lower: Least value; None: no bound.
        upper: Largest value; None: no bound.
    """

    name: Annotated[str, Field(pattern=r"^[\w.]+\.\w+$")]
    scale: Literal["linear", "log", "log1p", "angle"] = "linear"
    sd: NotNegative
    lower: StrictFloat | None = None
    upper: StrictFloat | None = None


class OpenHypothesis(StrictBlock):
    """What the cell may be: effects and deviations that a diagnosis could not rule out, and how they vary together.

    Attributes:
        probability: Its share of all hypotheses that are kept.
        effects: Its effects at their likeliest parameters, in place of the cell's.
        estimated: Its likeliest in-tolerance deviations.
        open: The k numbers that vary around these.
        correlation: Correlations (k, k) of the open numbers on their scales.
    """

    probability: Annotated[StrictFloat, Field(gt=0.0, le=1.0)]
    effects: EffectValues = Field(default_factory=dict)
    estimated: Estimated = Estimated()
    open: tuple[OpenParameter, ...] = ()
    correlation: tuple[tuple[Annotated[StrictFloat, Field(ge=-1.0, le=1.0)], ...], ...] = ()

    @model_validator(mode="after")
    def _fits_together(self) -> "OpenHypothesis":
        sides = {len(self.correlation), *(len(row) for row in self.correlation)} - {len(self.open)}
        if sides:
            raise ValueError(f"{len(self.open)} open numbers have a correlation of side {sides.pop()}; give one row and column for each")
        for one in self.open:
            effect, _, name = one.name.rpartition(".")
            known = (*Estimated.model_fields, *CROSSTALK) if effect == "estimated" else tuple(self.effects.get(effect, {}))
            if name not in known:
                raise ValueError(f"open number {one.name} is none of this hypothesis; expected one of its effects or of estimated")
        return self


class CellSite(StrictBlock):
    """A place with a tissue of its own; the one nearest to the tip counts.

    What its tissue leaves out is as in the common one, and its effects come on top of the common ones or in place of the same.
    """

    name: str
    """Name of the site."""
    x_m: Height = 0.0
    """Place along the base's x axis."""
    y_m: Height = 0.0
    """Place along the base's y axis."""
    tissue: TissueBlock | None = TissueBlock()
    """Its tissue; null: nothing in reach."""
    effects: EffectValues = Field(default_factory=dict)
    """Effects that only this site has."""


class Wall(StrictBlock):
    """Something linear and hard instead of the tissue, from the start or from `appears_after_s` after the motion began."""

    z_m: Height
    """Height of its surface."""
    stiffness_N_per_m: Positive
    """Its stiffness."""
    appears_after_s: NotNegative | None = None
    """It appears this long after the motion began; null: it stands there from the start."""


class CellFile(StrictBlock):
    """The whole file. `tissue` None: nothing in reach. `learned` holds laws that a diagnosis drew from recordings; they always act.

    `uncertainty` is what a diagnosis left open. A simulation does not use it; `palpd.cell.draws` draws cells from it.
    """

    version: Version = 1
    """Version of the form of this file; one that this palpd does not know is refused."""
    probe: ProbeBlock = ProbeBlock()
    """What hangs on the sensor."""
    sensor: SensorBlock = SensorBlock()
    """The force sensor."""
    robot: RobotBlock = RobotBlock()
    """How the tip follows its target."""
    tissue: TissueBlock | None = TissueBlock()
    """The tissue; null: nothing in reach."""
    tolerances: Tolerances
    """What is within specification."""
    repeatability: Repeatability
    """What differs from press to press."""
    effects: EffectValues = Field(default_factory=dict)
    """Known effects with their parameters; they are no gap."""
    learned: tuple[LearnedEffect, ...] = ()
    """Laws that a diagnosis drew from recordings; they are no gap."""
    estimated: Estimated | None = None
    """In-tolerance deviations that a diagnosis fitted."""
    uncertainty: tuple[OpenHypothesis, ...] = ()
    """What a diagnosis left open; `palpd export-sim --randomise` draws from it."""
    sites: tuple[CellSite, ...] = ()
    """Places with a tissue of their own, for emulated cells."""
    wall: Wall | None = None
    """A wall in place of the tissue, for emulated cells."""

    @model_validator(mode="before")
    @classmethod
    def _fill_in(cls, given: Any) -> Any:
        """Tolerances and repeatability that are not given follow from noise, mass and tip, a site's tissue from the common one."""
        if not isinstance(given, Mapping):
            return given
        probe, sensor = _part(ProbeBlock, given.get("probe")), _part(SensorBlock, given.get("sensor"))
        usual = {
            "tolerances": {
                "bias_N": 0.4 * sensor.noise_rms_N,
                "drift_N_per_min": 0.2 * sensor.noise_rms_N,
                "mass_kg": MASS_TOLERANCE * probe.mass_kg,
                "surface_z_m": 0.006 * probe.tip_radius_m,
            },
            "repeatability": {"surface_z_m": 0.004 * probe.tip_radius_m},
        }
        filled = {key: value for key, value in given.items() if value is not None or key == "tissue"}
        for block, values in usual.items():
            stated = filled.get(block, {})
            if isinstance(stated, Mapping):
                filled[block] = values | dict(stated)
        if isinstance(sites := filled.get("sites"), list):
            filled["sites"] = [_with_common_tissue(site, filled) for site in sites]
        return filled

    @model_validator(mode="after")
    def _each_law_once(self) -> "CellFile":
        names = [*(one.id for one in self.learned), *self.effects]
        if twice := [name for name in names if names.count(name) > 1]:
            raise ValueError(f"learned effect {twice[0]} stands twice in this cell; give the other one another id, or remove it")
        return self

    def at_site(self, name: str | None) -> "CellFile":
        """The cell at one of its sites, as a cell without sites; the same cell where it has no site of that name."""
        for site in self.sites:
            if site.name == name:
                return self.model_copy(update={"tissue": site.tissue, "effects": self.effects | site.effects, "sites": ()})
        return self

    def assumed_at_site(self, name: str | None) -> "CellFile":
        """The same cell, whose modulus counts as not known where nobody said that it is that of a site.

        It is, where the file has that site with another modulus than the common one.
        """
        own, common = self.at_site(name).tissue, self.tissue or TissueBlock()
        if own is None or own.youngs_modulus_Pa != common.youngs_modulus_Pa:
            return self
        return self.with_tolerances(youngs_modulus=max(self.tolerances.youngs_modulus, 1.0))

    def with_effects(self, effects: EffectValues) -> "CellFile":
        """The same cell with these effects in place of its own (not checked: they come from a fit)."""
        return self.model_copy(update={"effects": effects})

    def without_effects(self) -> "CellFile":
        """The same cell without effects and learned laws."""
        return self.model_copy(update={"effects": {}, "learned": ()})

    def with_tolerances(self, **tolerances: float) -> "CellFile":
        """The same cell with these tolerances (not checked); a modulus with 1.0 or more is not known."""
        return self.model_copy(update={"tolerances": self.tolerances.model_copy(update=tolerances)})

    def with_estimated(self, estimated: Estimated | None) -> "CellFile":
        """The same cell with these in-tolerance deviations; None: without any."""
        return self.model_copy(update={"estimated": estimated})


def _with_common_tissue(site: Any, cell: Mapping[str, Any]) -> Any:
    """The site with what its tissue does not say taken from the cell's."""
    common = cell.get("tissue", {})
    if not isinstance(site, Mapping) or not (common is None or isinstance(common, Mapping)):
        return site
    own = site.get("tissue", common)
    merged = dict(common or {}) | dict(own) if isinstance(own, Mapping) else own
    return dict(site) | {"tissue": merged}


def _part(model: type[T], given: Any) -> T:
    """That block if it is a good one; a bad one is complained of when its turn comes."""
    if isinstance(given, model):
        return given
    try:
        return model.model_validate(given or {})
    except ValidationError:
        return model()


def nominal() -> CellFile:
    """The emulated cell: every default, with the sensor's noise and resolution stated."""
    return CellFile.model_validate({"sensor": SensorBlock().model_dump()})


def cell_from(content: object, where: str, library: Mapping[str, Effect] = EFFECTS) -> CellFile:
    """Make a cell of data, such as a `cell:` block.

    Args:
        content: Blocks of a cell file, or None for the nominal cell.
        where: What an error calls them.
        library: Effects that the cell may have, by id.

    Raises:
        ConfigError: Where the data is no cell, one sentence that names the key.
    """
    return _cell_of(Document(where, content), library)


def load_cell(path: str | Path, library: Mapping[str, Effect] = EFFECTS) -> CellFile:
    """Read a cell file.

    Args:
        library: Effects that the cell may have, by id.

    Raises:
        ConfigError: Where the file is absent, empty or no cell, one sentence that names line and key.
    """
    document = read_yaml(Path(path))
    document.refuse_empty()
    return _cell_of(document, library)


def parse_cell(values: object, where: str, library: Mapping[str, Effect] = EFFECTS) -> CellFile:
    """Make a cell of data, such as a request's.

    Args:
        values: Keys and values of cell.yaml.
        where: What an error calls them.
        library: Effects that the cell may have, by id.

    Raises:
        ConfigError: Where the data is no cell, one sentence.
    """
    if not isinstance(values, dict):
        raise ConfigError(f"{where} holds {type(values).__name__}, expected keys and values; see docs/cell.md")
    return _cell_of(Document(where, values), library)


def save_cell(path: str | Path, cell: CellFile) -> None:
    """Write a cell file that `load_cell` reads back equal.

    Raises:
        BadInput: Where the file cannot be written.
    """
    content = cell.model_dump(mode="json")
    content["learned"] = [one.model_dump(mode="json", exclude_none=True) for one in cell.learned]
    content["uncertainty"] = [one.model_dump(mode="json", exclude_none=True, exclude_defaults=True) for one in cell.uncertainty]
    for key in ("estimated", "uncertainty", "wall", "sites", "learned"):
        if not content[key]:
            del content[key]
    write_yaml(Path(path), in_yaml(content))


def _cell_of(document: Document, library: Mapping[str, Effect]) -> CellFile:
    if document.content is not None and not isinstance(document.content, Mapping):
        what = type(document.content).__name__
        raise ConfigError(f"{document.name} holds a {what}; expected the blocks of a cell file (probe, sensor, robot, …)")
    refuse_renamed("cell", document)
    try:
        cell = CellFile.model_validate(document.content or {})
    except ValidationError as error:
        raise ConfigError(refusal(error, CellFile, document, HINTS)) from None
    _check_effects(cell.effects, f"{document.place(('effects',))}: effects", library)
    for number, open_one in enumerate(cell.uncertainty):
        _check_effects(open_one.effects, f"{document.place(('uncertainty', number, 'effects'))}: uncertainty.{number}.effects", library)
    for number, site in enumerate(cell.sites):
        _check_effects(site.effects, f"{document.place(('sites', number, 'effects'))}: sites.{site.name}.effects", library)
    return cell


def _check_effects(effects: EffectValues, where: str, library: Mapping[str, Effect]) -> None:
    for name, values in effects.items():
        if name not in library:
            near = nearest(name, list(library))
            raise ConfigError(f"{where}: there is no effect {name!r}{near}; give one of the library's, or --effects with your own")
        expected = [parameter.name for parameter in library[name].named_parameters]
        for parameter in values:
            if parameter not in expected:
                raise ConfigError(f"{where}.{name}: there is no parameter {parameter!r}; expected {', '.join(expected)}")
        needed = [parameter.name for parameter in library[name].parameters if not parameter.optional]
        if missing := [parameter for parameter in needed if parameter not in values]:
            raise ConfigError(f"{where}.{name}: {', '.join(missing)} not given; expected {', '.join(expected)}")
        for known in library[name].parameters:
            if known.choices and values.get(known.name, known.choices[0]) not in known.choices:
                choices = " or ".join(f"{choice:g}" for choice in known.choices)
                raise ConfigError(f"{where}.{name}.{known.name} is {values[known.name]:g}, expected {choices}")


PHANTOM = load_cell(Path(__file__).with_name("phantom.yaml"))
"""The paper's phantom, sites A to D."""
