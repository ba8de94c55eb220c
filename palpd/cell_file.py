"""cell.yaml: what the simulator believes about a cell, and how exactly it is known.

Absent blocks and keys get the defaults of a nominal cell; unknown keys, effects and parameters are refused.
"""

from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from palpd.effects import EFFECTS, Effect
from palpd.errors import ConfigError

T = TypeVar("T", bound="Block")
EffectValues = dict[str, dict[str, float]]
Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]
Length = Annotated[float, Field(gt=0.0, lt=1.0)]
Height = Annotated[float, Field(gt=-10.0, lt=10.0)]
Modulus = Annotated[float, Field(ge=1.0, le=1e13)]


class Block(BaseModel):
    """One block of the file: no key but these, and nothing infinite."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Probe(Block):
    """What hangs on the sensor: its moving mass, its spherical tip, and how far that is from the sensor."""

    mass_kg: NotNegative = 0.2
    tip_radius_m: Length = 0.005
    tip_length_m: Annotated[float, Field(ge=0.0, lt=5.0)] = 0.08


class Sensor(Block):
    """The force sensor as its data sheet has it; `filter_cutoff_Hz` None is no filter."""

    rate_Hz: Positive = 500.0
    filter_cutoff_Hz: Positive | None = 150.0
    noise_rms_N: Positive = 0.05
    noise_rms_Nm: NotNegative = 0.001
    resolution_fxy_N: NotNegative = 0.024
    resolution_fz_N: NotNegative = 0.131
    resolution_Nm: NotNegative = 0.001


class Robot(Block):
    """How the tip follows its target, and how noisily that is reported."""

    servo_natural_frequency_Hz: Positive = 8.0
    servo_damping_ratio: Positive = 1.0
    position_noise_rms_m: NotNegative = 5.0e-6
    velocity_noise_rms_m_per_s: NotNegative = 2.0e-4


class Tissue(Block):
    """An elastic half-space below `surface_z_m`."""

    surface_z_m: Height = 0.0
    youngs_modulus_Pa: Modulus = 72000.0
    poisson_ratio: Annotated[float, Field(ge=0.0, le=0.5)] = 0.5


class Tolerances(Block):
    """One standard deviation of what is within specification. `gain`, `filter_cutoff`, `youngs_modulus` and
    `servo_natural_frequency` are relative; `crosstalk` is fx/fz and fy/fz, for torques times 0.05 m."""

    bias_N: NotNegative
    drift_N_per_min: NotNegative
    gain: NotNegative = 0.005
    latency_s: NotNegative = 0.001
    filter_cutoff: NotNegative = 0.05
    crosstalk: NotNegative = 0.003
    mass_kg: NotNegative
    youngs_modulus: NotNegative = 0.02
    surface_z_m: NotNegative
    servo_natural_frequency: NotNegative = 0.02

    @property
    def modulus_known(self) -> bool:
        """Whether the tissue's modulus is known at all."""
        return self.youngs_modulus < 1.0


class Repeatability(Block):
    """One standard deviation from press to press: of the height of contact, and of the stiffness (relative)."""

    surface_z_m: NotNegative
    stiffness: NotNegative = 0.01


CROSSTALK_ARM_M = 0.05
"""What a relative crosstalk is multiplied with to give torque per force."""


class Estimated(Block):
    """In-tolerance deviations that a diagnosis has fitted, in the units of `tolerances`; `crosstalk` is that of fx, fy, tx, ty."""

    bias_N: float = 0.0
    drift_N_per_min: float = 0.0
    gain: float = 0.0
    latency_s: float = 0.0
    filter_cutoff: Annotated[float, Field(gt=-1.0)] = 0.0
    crosstalk: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    mass_kg: float = 0.0
    youngs_modulus: Annotated[float, Field(gt=-1.0)] = 0.0
    surface_z_m: float = 0.0
    servo_natural_frequency: Annotated[float, Field(gt=-1.0)] = 0.0


class Site(Block):
    """A place with a tissue of its own; the one nearest to the tip counts.

    What its tissue leaves out is as in the common one, and its effects come on top of the common ones or in place of the same.
    """

    name: str
    x_m: Height = 0.0
    y_m: Height = 0.0
    tissue: Tissue | None = Tissue()
    effects: EffectValues = {}


class Wall(Block):
    """Something linear and hard instead of the tissue, from the start or from `appears_after_s` after the motion began."""

    z_m: Height
    stiffness_N_per_m: Positive
    appears_after_s: NotNegative | None = None


class CellFile(Block):
    """The whole file. `tissue` None: nothing in reach."""

    probe: Probe = Probe()
    sensor: Sensor = Sensor()
    robot: Robot = Robot()
    tissue: Tissue | None = Tissue()
    tolerances: Tolerances
    repeatability: Repeatability
    effects: EffectValues = {}
    estimated: Estimated | None = None
    sites: tuple[Site, ...] = ()
    wall: Wall | None = None

    @model_validator(mode="before")
    @classmethod
    def _fill_in(cls, given: Any) -> Any:
        """Tolerances and repeatability that are not given follow from noise, mass and tip, a site's tissue from the common one."""
        if not isinstance(given, Mapping):
            return given
        probe, sensor = _part(Probe, given.get("probe")), _part(Sensor, given.get("sensor"))
        usual = {
            "tolerances": {
                "bias_N": 0.4 * sensor.noise_rms_N,
                "drift_N_per_min": 0.2 * sensor.noise_rms_N,
                "mass_kg": 0.015 * probe.mass_kg,
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

    def with_effects(self, effects: EffectValues) -> "CellFile":
        """The same cell with these effects in place of its own (not checked: they come from a fit)."""
        return self.model_copy(update={"effects": effects})

    def with_estimated(self, estimated: Estimated | None) -> "CellFile":
        """The same cell with these in-tolerance deviations."""
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
    """The cell of all defaults."""
    return CellFile.model_validate({})


def cell_from(given: Any, where: str, library: Mapping[str, Effect] = EFFECTS) -> CellFile:
    """A cell from what a YAML file or a `cell:` block holds; `where` names it in the sentence of the ConfigError."""
    try:
        cell = CellFile.model_validate({} if given is None else given)
    except ValidationError as error:
        raise ConfigError(_sentence(error, where)) from None
    for place, effects in [("effects", cell.effects), *((f"sites.{site.name}.effects", site.effects) for site in cell.sites)]:
        _check_effects(effects, f"{where}: {place}", library)
    return cell


def load_cell(path: str | Path, library: Mapping[str, Effect] = EFFECTS) -> CellFile:
    """Read a cell file; what is wrong with it is said in one ConfigError that names the key."""
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} could not be read ({getattr(error, 'strerror', None) or 'not text'}); give a cell file") from None
    try:
        given = yaml.safe_load(text)
    except yaml.YAMLError as error:
        line = f" at line {mark.line + 1}" if (mark := getattr(error, "problem_mark", None)) else ""
        raise ConfigError(f"{path} is not YAML{line}; expected the blocks of a cell file") from None
    if given is not None and not isinstance(given, Mapping):
        raise ConfigError(f"{path} holds a {type(given).__name__}; expected the blocks of a cell file (probe, sensor, robot, …)")
    return cell_from(given, str(path), library)


def save_cell(path: str | Path, cell: CellFile) -> None:
    """Write a cell file that `load_cell` reads back equal."""
    content = cell.model_dump(mode="json")
    for key in ("estimated", "wall", "sites"):
        if not content[key]:
            del content[key]
    Path(path).write_text(yaml.safe_dump(content, sort_keys=False, allow_unicode=True), encoding="utf-8")


def _check_effects(effects: EffectValues, where: str, library: Mapping[str, Effect]) -> None:
    for name, values in effects.items():
        if name not in library:
            near = _nearest(name, library)
            raise ConfigError(f"{where}: there is no effect {name!r}{near}; give one of the library's, or --effects with your own")
        expected = [parameter.name for parameter in library[name].parameters]
        for parameter in values:
            if parameter not in expected:
                raise ConfigError(f"{where}.{name}: there is no parameter {parameter!r}; expected {', '.join(expected)}")
        if missing := [parameter for parameter in expected if parameter not in values]:
            raise ConfigError(f"{where}.{name}: {', '.join(missing)} not given; expected {', '.join(expected)}")


def _nearest(word: str, words: Mapping[str, object]) -> str:
    near = get_close_matches(word, list(words), n=1)
    return f" (did you mean {near[0]!r}?)" if near else ""


def _sentence(error: ValidationError, where: str) -> str:
    """The first complaint of pydantic in our words."""
    first = error.errors(include_url=False)[0]
    key = ".".join(str(part) for part in first["loc"]) or "the file"
    if first["type"] == "extra_forbidden":
        block, _, last = key.rpartition(".")
        fields = _fields(block)
        near = _nearest(last, dict.fromkeys(fields))
        return f"{where}: there is no key {key!r}{near}; expected {', '.join(fields)}"
    if first["type"] == "missing":
        return f"{where}: {key} is not given; it has no default"
    hint = ""
    if key.endswith("_m") and first["type"] in ("less_than", "greater_than"):
        hint = " (is it in millimetres?)"
    elif key.endswith("youngs_modulus_Pa"):
        hint = " (is it in kPa or MPa?)"
    said = first["msg"][0].lower() + first["msg"][1:]
    return f"{where}: {key} is {first['input']!r}{hint}; {said}"


def _fields(block: str) -> list[str]:
    """The keys that a block may hold, by its dotted place in the file."""
    model: Any = CellFile
    for part in block.split("."):
        inner = model.model_fields.get(part) if isinstance(model, type) and issubclass(model, BaseModel) else None
        if inner is not None:
            model = next((a for a in _models(inner.annotation)), model)
    return list(model.model_fields)


def _models(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in getattr(annotation, "__args__", ()) for model in _models(part)]


PHANTOM = load_cell(Path(__file__).with_name("phantom.yaml"))
"""The paper's phantom, sites A to D."""
