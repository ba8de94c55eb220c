"""config.yaml and plan.yaml as frozen models: unknown keys, missing units and unsafe limits are refused in one sentence."""

import difflib
import math
import os
from pathlib import Path
from typing import Any, Literal, Self, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from palpd.cell_file import CellFile, nominal
from palpd.errors import ConfigError

Model = TypeVar("Model", bound=BaseModel)

ENVIRONMENT_PREFIX = "PALPD_"
FILTERS_HZ = (500.0, 150.0, 50.0, 15.0, 5.0, 1.5)
FZ_CAPACITY_N = 200.0
"""Nominal capacity of the HEX-70 of the 200 N class on every force axis; overload begins above it."""


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class RobotConfig(_Frozen):
    """The arm and how it is spoken to."""

    host: str = "127.0.0.1"
    model: Literal["ur5", "ur5e"] = "ur5"
    rtde_rate_Hz: float | None = Field(default=None, gt=0, le=500)
    tcp: tuple[float, float, float, float, float, float] | None = None
    watchdog_Hz: float = Field(default=20.0, ge=5, le=100)
    acceleration_m_per_s2: float = Field(default=0.5, gt=0, le=5)

    @property
    def rate_Hz(self) -> float:
        """Rate of the state stream and of the loop: the controller's own cycle unless set."""
        return self.rtde_rate_Hz or {"ur5": 125.0, "ur5e": 500.0}[self.model]

    @model_validator(mode="after")
    def _possible(self) -> Self:
        top = {"ur5": 125.0, "ur5e": 500.0}[self.model]
        if self.rate_Hz > top or abs(top / self.rate_Hz - round(top / self.rate_Hz)) > 1e-9:
            raise ValueError(f"rtde_rate_Hz is {self.rate_Hz:g}, but a {self.model} sends at {top:g} Hz or a whole fraction of it")
        if self.rate_Hz < 2 * self.watchdog_Hz:
            raise ValueError(
                f"watchdog_Hz is {self.watchdog_Hz:g}, more than half of the loop's {self.rate_Hz:g} Hz: one late tick would stop the arm"
            )
        return self


class SensorConfig(_Frozen):
    """The HEX-70 and its calibration (null: read from the DAQ's registers)."""

    port: str = "/dev/palpd-hex"
    rate_Hz: float = Field(default=1000.0, gt=0, le=1000)
    filter_cutoff_Hz: float | None = 150.0
    counts_per_N: tuple[float, float, float] | None = None
    counts_per_Nm: tuple[float, float, float] | None = None
    rotation_about_flange_z_rad: float = Field(default=0.0, ge=-6.3, le=6.3)

    @model_validator(mode="after")
    def _as_the_daq_can(self) -> Self:
        if self.filter_cutoff_Hz is not None and self.filter_cutoff_Hz not in FILTERS_HZ:
            raise ValueError(f"filter_cutoff_Hz is {self.filter_cutoff_Hz:g}, but the DAQ knows {FILTERS_HZ} and null (none) only")
        if abs(1000 / self.rate_Hz - round(1000 / self.rate_Hz)) > 1e-9 or not 1 <= 1000 / self.rate_Hz <= 255:
            raise ValueError(f"rate_Hz is {self.rate_Hz:g}, but the DAQ sends at 1000/n Hz only, n from 1 to 255")
        if (self.counts_per_N is None) != (self.counts_per_Nm is None):
            raise ValueError("counts_per_N and counts_per_Nm belong to one calibration sheet: give both or neither")
        if any(abs(counts) < 1e-6 for counts in (*(self.counts_per_N or ()), *(self.counts_per_Nm or ()))):
            raise ValueError("counts_per_N and counts_per_Nm must not be zero")
        return self


def filter_delay_s(cutoff_Hz: float | None) -> float:
    """How much later than a force a one-pole low-pass shows it: 1 / (2π f_c)."""
    return 1.0 / (2.0 * math.pi * cutoff_Hz) if cutoff_Hz else 0.0


class ModelConfig(_Frozen):
    """The inertial model; without a path nothing is corrected, and the output says so.

    `zero` is where its bias comes from: followed in free air (running), or as it was trained (learned), which is the paper's way.
    """

    path: Path | None = None
    zero: Literal["running", "learned"] = "running"
    correction_limit_N: float = Field(default=0.5, ge=0, le=5)


class SafetyConfig(_Frozen):
    """Limits of the guard. Why each default is what it is stands in config.yaml."""

    contact_limit_N: float = Field(default=12.0, gt=0, le=150)
    absolute_limit_N: float = Field(default=25.0, gt=0, le=190)
    lateral_limit_N: float = Field(default=8.0, gt=0, le=150)
    torque_limit_Nm: float = Field(default=1.0, gt=0, le=6.5)
    max_speed_m_per_s: float = Field(default=0.05, gt=0, le=0.25)
    min_z_m: float | None = None
    workspace_m: tuple[tuple[float, float], tuple[float, float], tuple[float, float]] | None = None
    robot_stale_s: float = Field(default=0.05, gt=0, le=0.5)
    sensor_stale_s: float = Field(default=0.05, gt=0, le=0.5)
    max_stall_s: float = Field(default=0.05, gt=0, le=0.5)
    expected_stiffness_N_per_m: float = Field(default=5000.0, gt=0)

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.absolute_limit_N <= self.contact_limit_N:
            raise ValueError(
                f"absolute_limit_N is {self.absolute_limit_N:g} N and contact_limit_N {self.contact_limit_N:g} N: "
                "the absolute limit is the last net and must be the larger"
            )
        for axis, span in zip("xyz", self.workspace_m or (), strict=False):
            if span[0] >= span[1]:
                raise ValueError(f"workspace_m for {axis} runs from {span[0]:g} to {span[1]:g} m, which is empty")
        return self


class MachineConfig(_Frozen):
    """How far sensor and arm give way under load (null: the last `palpd stiffness`, or rigid and said so)."""

    stiffness_N_per_m: float | None = Field(default=None, gt=0)


class PathsConfig(_Frozen):
    """Where recordings and the state that survives a restart (reference tare, stiffness, latch) are kept."""

    runs: Path = Path("runs")
    state: Path = Path("state")
    socket: Path | None = None

    @property
    def control_socket(self) -> Path:
        """Where `palpd serve` listens."""
        return self.socket or self.state / "palpd.sock"


class Config(_Frozen):
    """All of config.yaml. Relative paths are relative to the file."""

    robot: RobotConfig = RobotConfig()
    sensor: SensorConfig = SensorConfig()
    model: ModelConfig = ModelConfig()
    safety: SafetyConfig = SafetyConfig()
    machine: MachineConfig = MachineConfig()
    paths: PathsConfig = PathsConfig()
    cell: CellFile = Field(default_factory=nominal)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.model.correction_limit_N >= CONTACT_FORCE_N:
            raise ValueError(
                f"model.correction_limit_N is {self.model.correction_limit_N:g} N, but contact is found at {CONTACT_FORCE_N:g} N: "
                "a correction that large could hide a contact"
            )
        return self


CONTACT_FORCE_N = 1.0
"""Force at which the surface search takes it as contact: 8 counts of Fz, 2.5 mm into 62 kPa, four times below manual palpation."""


class Site(_Frozen):
    """A place to press, as an offset from the start pose along the base's axes."""

    name: str = Field(min_length=1, max_length=32, pattern=r"^[A-Za-z0-9_.-]+$")
    x_m: float = Field(default=0.0, ge=-0.5, le=0.5)
    y_m: float = Field(default=0.0, ge=-0.5, le=0.5)


class Search(_Frozen):
    """How the surface is looked for."""

    speed_m_per_s: float = Field(default=0.005, gt=0, le=0.02)
    max_travel_m: float = Field(default=0.08, gt=0, le=0.3)


class Strokes(_Frozen):
    """Strokes in the air above a site, before anything is pressed there: up from the height of travel and back."""

    strokes: int = Field(ge=1, le=200)
    height_m: float = Field(default=0.02, ge=0.001, le=0.1)
    speed_m_per_s: float = Field(default=0.02, gt=0, le=0.25)


class Plan(_Frozen):
    """plan.yaml: where, how deep, how fast, how often. Without depths nothing is pressed or looked for, which needs free strokes."""

    sites: tuple[Site, ...] = Field(default=(Site(name="A"),), min_length=1, max_length=1000)
    mode: Literal["dynamic", "static", "both"] = "both"
    depths_m: tuple[float, ...] = Field(default=(0.004, 0.006, 0.008), max_length=100)
    press_speed_m_per_s: float = Field(default=0.01, gt=0, le=0.05)
    repeats: int = Field(default=3, ge=1, le=100)
    hold_s: float = Field(default=3.0, ge=0.1, le=600)
    safe_height_m: float = Field(default=0.01, ge=0.002, le=0.1)
    search: Search = Search()
    free: Strokes | None = None

    @model_validator(mode="after")
    def _sensible(self) -> Self:
        if not self.depths_m and self.free is None:
            raise ValueError("depths_m is empty and there are no free strokes: the plan does nothing; give one of them")
        for depth_m in self.depths_m:
            if not 0.0002 <= depth_m <= 0.02:
                raise ValueError(f"a depth of {depth_m:g} m is outside 0.0002 to 0.02 m; depths are in metres (4 mm is 0.004)")
        names = [site.name for site in self.sites]
        if len(set(names)) != len(names):
            raise ValueError(f"site names must differ, found {', '.join(names)}")
        return self


def load_config(path: Path | None) -> Config:
    """Read config.yaml, with `PALPD_SECTION__KEY` of the environment over it. Raises ConfigError, one sentence."""
    values = _read_yaml(path) if path else {}
    for name, text in os.environ.items():
        section, _, key = name.removeprefix(ENVIRONMENT_PREFIX).partition("__")
        if name.startswith(ENVIRONMENT_PREFIX) and key:
            block = values.setdefault(section.lower(), {})
            if not isinstance(block, dict):
                raise ConfigError(f"{path}: {section.lower()} is not a block of keys, so {name} cannot override it")
            block[_key_as_spelled(section.lower(), key)] = yaml.safe_load(text)
    config = _validated(Config, values, str(path or "the default configuration"))
    if path is None:
        return config
    base = path.resolve().parent
    paths = config.paths.model_copy(
        update={
            "runs": base / config.paths.runs,
            "state": base / config.paths.state,
            "socket": base / config.paths.socket if config.paths.socket else None,
        }
    )
    model = config.model.model_copy(update={"path": base / config.model.path if config.model.path else None})
    return config.model_copy(update={"paths": paths, "model": model})


def load_plan(path: Path) -> Plan:
    """Read plan.yaml. Raises ConfigError, one sentence."""
    return _validated(Plan, _read_yaml(path), str(path))


def parse_plan(values: object, where: str) -> Plan:
    """A plan that came as data. Raises ConfigError, one sentence."""
    if not isinstance(values, dict):
        raise ConfigError(f"{where} holds {type(values).__name__}, expected keys and values; see plan.yaml in the repository")
    return _validated(Plan, values, where)


def parse_config(values: object, where: str) -> Config:
    """A configuration that came as data, such as a recording's. Raises ConfigError, one sentence."""
    if not isinstance(values, dict):
        raise ConfigError(f"{where} holds {type(values).__name__}, expected keys and values")
    return _validated(Config, values, where)


def refuse_unsafe(config: Config, plan: Plan) -> None:
    """Refuse a plan that the limits of the configuration do not allow. Raises ConfigError."""
    safety = config.safety
    speeds = [("press_speed_m_per_s", plan.press_speed_m_per_s), ("search.speed_m_per_s", plan.search.speed_m_per_s)]
    if plan.free is not None:
        speeds.append(("free.speed_m_per_s", plan.free.speed_m_per_s))
    for name, speed in speeds:
        if speed > safety.max_speed_m_per_s:
            raise ConfigError(
                f"the plan's {name} is {speed:g} m/s, above safety.max_speed_m_per_s of {safety.max_speed_m_per_s:g}; lower one of them"
            )


def _key_as_spelled(section: str, key: str) -> str:
    """The environment often comes in capitals; a key keeps the spelling of its unit."""
    field = Config.model_fields.get(section)
    known = getattr(field.annotation, "model_fields", {}) if field else {}
    return next((name for name in known if name.lower() == key.lower()), key.lower())


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        values = yaml.safe_load(path.read_text())
    except OSError as error:
        raise ConfigError(f"{path} cannot be read ({error.strerror}); give the path of a YAML file") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        where = getattr(error, "problem_mark", None)
        raise ConfigError(f"{path} is not YAML{f' (line {where.line + 1})' if where else ''}; correct it") from error
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise ConfigError(f"{path} holds {type(values).__name__}, expected keys and values; see config.yaml in the repository")
    return values


def _validated(model: type[Model], values: dict[str, Any], where: str) -> Model:
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise ConfigError(f"{where}: {_sentence(model, error)}") from error


def _sentence(model: type[BaseModel], error: ValidationError) -> str:
    first = error.errors()[0]
    key = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        known = _fields_at(model, first["loc"][:-1])
        close = difflib.get_close_matches(str(first["loc"][-1]), known, n=1, cutoff=0.5)
        return f"{key} is not a key" + (f"; did you mean {close[0]}?" if close else f"; known here: {', '.join(known)}")
    message = first["msg"].removeprefix("Value error, ")
    if first["type"] == "value_error":
        return f"{key}: {message}" if key else message
    return f"{key} is {first.get('input')!r}: {message[0].lower()}{message[1:]}"


def _fields_at(model: Any, location: tuple[int | str, ...]) -> list[str]:
    for part in location:
        field = getattr(model, "model_fields", {}).get(part)
        if field is not None:
            model = field.annotation
    return list(getattr(model, "model_fields", {}))
