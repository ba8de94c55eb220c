"""config.yaml and plan.yaml as frozen models: unknown keys, missing units and unsafe limits are refused in one sentence."""

import math
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar, get_args

from pydantic import AfterValidator, Field, StrictBool, StrictFloat, StrictInt, ValidationError, field_validator, model_validator
from pydantic.fields import FieldInfo
from pydantic_settings import BaseSettings, EnvSettingsSource

from palpd.cell.cell_file import HINTS, CellFile, Version, nominal
from palpd.cell.effects.drivers import StrictBlock
from palpd.documents import NAME_PATTERN, Document, faults, nearest, parse_yaml, read_yaml, refusal
from palpd.errors import ConfigError
from palpd.file_versions import Kind, refuse_renamed
from palpd.tick import Option

Model = TypeVar("Model", bound=StrictBlock)

ENVIRONMENT_PREFIX = "PALPD_"
"""Begins the names of the environment variables that override config.yaml: PALPD_ROBOT__HOST, or PALPD_ROBOT with a whole block."""
SLOWEST_M_PER_S = 1e-4
"""Lowest speed that a file may ask for: a press of 4 mm then takes 40 s, and a slower one measures the drift of the zero."""
FILTERS_HZ = (500.0, 150.0, 50.0, 15.0, 5.0, 1.5)
HEX_70, UR_RTDE = "hex-70", "ur-rtde"
"""Kinds of sensor and robot that a config.yaml has where it names none."""
OTHER_ROBOTS = (
    "only the controller matters, so a UR3, UR5 or UR10 of the CB3 series counts as ur5, an e-Series one (UR3e, UR10e, UR16e) as ur5e; "
    "of these the UR5 and the UR5e were tried, on emulated wires. An arm of another make needs a driver (docs/what-works.md)"
)
"""What does work, for whoever asks for another robot."""
HEX_70_CAPACITY_N = 200.0
"""Nominal capacity of the HEX-70 of the 200 N class on every force axis; overload begins above it."""


Place = Annotated[StrictFloat, Field(ge=-10.0, le=10.0)]
"""A place in base axes: wide enough for "no limit", and too narrow for millimetres."""
Span = tuple[Place, Place]
"""From a least to a most."""


class RobotConfig(StrictBlock):
    """The arm and how it is spoken to: `kind` names a driver (docs/sensors.md), `options` is what only that driver knows."""

    kind: str = Field(default=UR_RTDE, min_length=1)
    """Name of the driver."""
    host: str = Field(default="127.0.0.1", pattern=r"^\S+$", max_length=253)
    """Address of the controller: RTDE on port 30004, scripts on 30003, dashboard on 29999."""
    model: Literal["ur5", "ur5e"] = "ur5"
    """`ur5`: CB3, 125 Hz. `ur5e`: e-Series, 500 Hz."""
    rtde_rate_Hz: StrictFloat | None = Field(default=None, gt=0, le=500)
    """Rate of the state stream and of the loop; null: the controller's own cycle."""
    tcp: tuple[StrictFloat, StrictFloat, StrictFloat, StrictFloat, StrictFloat, StrictFloat] | None = None
    """Pose of the tip in axes of the flange (three m, three rad); null: as set on the robot."""
    watchdog_Hz: StrictFloat = Field(default=20.0, ge=5, le=100)
    """The controller stops the program 1/`watchdog_Hz` after the last speed command."""
    acceleration_m_per_s2: StrictFloat = Field(default=0.5, gt=0, le=5)
    """Acceleration of every commanded speed."""
    options: dict[str, Option] = Field(default_factory=dict)
    """What only the driver of this `kind` knows."""

    @field_validator("model", mode="before")
    @classmethod
    def _known_model(cls, model: object) -> object:
        if isinstance(model, str) and model not in ("ur5", "ur5e"):
            raise ValueError(f"{model!r} is neither ur5 nor ur5e: {OTHER_ROBOTS}")
        return model

    @property
    def rate_Hz(self) -> float:
        """Rate of the state stream and of the loop: the controller's own cycle unless set."""
        return self.rtde_rate_Hz or {"ur5": 125.0, "ur5e": 500.0}[self.model]

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if self.tcp is not None and (max(map(abs, self.tcp[:3])) >= 1.0 or max(map(abs, self.tcp[3:])) > 6.3):
            raise ValueError(
                f"tcp is {[*self.tcp]}: its first three numbers are metres, less than 1 (120 mm is 0.12), and the last three rad, "
                "at most 6.3; write it so"
            )
        top = {"ur5": 125.0, "ur5e": 500.0}[self.model] if self.kind == UR_RTDE else self.rate_Hz
        if self.kind != UR_RTDE and self.rtde_rate_Hz is None:
            raise ValueError(f"rtde_rate_Hz is not given; a {self.kind} needs it, because it is the rate of the loop")
        if self.rate_Hz > top or abs(top / self.rate_Hz - round(top / self.rate_Hz)) > 1e-9:
            raise ValueError(f"rtde_rate_Hz is {self.rate_Hz:g}, but a {self.model} sends at {top:g} Hz or a whole fraction of it")
        if self.rate_Hz < 2 * self.watchdog_Hz:
            raise ValueError(
                f"watchdog_Hz is {self.watchdog_Hz:g}, more than half of the loop's {self.rate_Hz:g} Hz: one late tick would stop the arm"
            )
        return self


class SensorConfig(StrictBlock):
    """The force sensor and its calibration (null: the device tells). `kind` names a driver (docs/sensors.md), `options` is for it alone."""

    kind: str = Field(default=HEX_70, min_length=1)
    """Name of the driver."""
    port: str = Field(default="/dev/palpd-hex", min_length=1)
    """Terminal device of the DAQ."""
    rate_Hz: StrictFloat = Field(default=1000.0, gt=0, le=1000)
    """Samples per second: 1000/n."""
    filter_cutoff_Hz: StrictFloat | None = 150.0
    """Cutoff of the DAQ's low-pass; null: none."""
    counts_per_N: tuple[StrictFloat, StrictFloat, StrictFloat] | None = None
    """Calibration of fx, fy, fz from the unit's sheet; null: read from the DAQ."""
    counts_per_Nm: tuple[StrictFloat, StrictFloat, StrictFloat] | None = None
    """Calibration of tx, ty, tz from the same sheet; null: read from the DAQ."""
    fz_slopes: Literal["pressed", "pulled", "both"] = "pressed"
    """Which slope converts Fz: that of pressing, that of pulling, or `both`, parted where the sensor carries nothing."""
    fz_pulled_counts_per_N: StrictFloat | None = Field(default=None, gt=0)
    """Slope of Fz when it is pulled; null: read from the DAQ."""
    rotation_about_flange_z_rad: StrictFloat = Field(default=0.0, ge=-6.3, le=6.3)
    """How far the sensor is turned about the flange's z axis."""
    capacity_N: StrictFloat = Field(default=HEX_70_CAPACITY_N, gt=0, le=10_000)
    """Largest force of the sensor: the guard stops before it."""
    options: dict[str, Option] = Field(default_factory=dict)
    """What only the driver of this `kind` knows."""

    @model_validator(mode="after")
    def _as_the_daq_can(self) -> Self:
        if self.kind != HEX_70:
            if self.fz_slopes != "pressed" or self.fz_pulled_counts_per_N is not None:
                raise ValueError(f"fz_slopes and fz_pulled_counts_per_N are for a {HEX_70}, but kind is {self.kind}; leave them out")
            return self
        if self.capacity_N > HEX_70_CAPACITY_N:
            raise ValueError(f"capacity_N is {self.capacity_N:g}, but a {HEX_70} bears {HEX_70_CAPACITY_N:g} N; leave it out")
        if self.filter_cutoff_Hz is not None and self.filter_cutoff_Hz not in FILTERS_HZ:
            raise ValueError(f"filter_cutoff_Hz is {self.filter_cutoff_Hz:g}, but the DAQ knows {FILTERS_HZ} and null (none) only")
        if abs(1000 / self.rate_Hz - round(1000 / self.rate_Hz)) > 1e-9 or not 1 <= 1000 / self.rate_Hz <= 255:
            raise ValueError(f"rate_Hz is {self.rate_Hz:g}, but the DAQ sends at 1000/n Hz only, n from 1 to 255")
        if (self.counts_per_N is None) != (self.counts_per_Nm is None):
            raise ValueError("counts_per_N and counts_per_Nm belong to one calibration sheet: give both or neither")
        if any(abs(counts) < 1e-6 for counts in (*(self.counts_per_N or ()), *(self.counts_per_Nm or ()))):
            raise ValueError("counts_per_N and counts_per_Nm must not be zero")
        if self.fz_pulled_counts_per_N is not None and self.counts_per_N is None:
            raise ValueError("fz_pulled_counts_per_N belongs to the calibration sheet of counts_per_N: give both, or leave it out")
        return self


def filter_delay_s(cutoff_Hz: float | None) -> float:
    """How much later than a force a one-pole low-pass shows it: 1 / (2π f_c); 0 without a filter."""
    return 1.0 / (2.0 * math.pi * cutoff_Hz) if cutoff_Hz else 0.0


class ModelConfig(StrictBlock):
    """The inertial model; without a path nothing is corrected, and the output says so.

    `zero` is where its bias comes from: followed in free air (running), or as it was trained (learned), which is the paper's way.
    """

    path: Path | None = None
    """The inertial model that `palpd train` wrote; null: nothing is corrected."""
    zero: Literal["running", "learned"] = "running"
    """Source of the model's bias: followed in free air (`running`), or kept from training (`learned`)."""
    correction_limit_N: StrictFloat = Field(default=0.5, ge=0, le=5)
    """The most that model and zero together may take from a force."""


class SafetyConfig(StrictBlock):
    """Limits of the guard. Why each default is what it is stands in config.yaml."""

    contact_limit_N: StrictFloat = Field(default=12.0, gt=0, le=150)
    """Corrected force against the running tare at which the probe retracts and the run ends."""
    absolute_limit_N: StrictFloat = Field(default=25.0, gt=0, le=190)
    """Raw force against the reference tare at which the arm stops where it is, latched."""
    lateral_limit_N: StrictFloat = Field(default=8.0, gt=0, le=150)
    """Lateral force at which the arm stops: the probe slips or has met an edge."""
    torque_limit_Nm: StrictFloat = Field(default=1.0, gt=0, le=6.5)
    """Torque at which the arm stops."""
    max_speed_m_per_s: StrictFloat = Field(default=0.05, ge=SLOWEST_M_PER_S, le=0.25)
    """Largest speed of any command, and the speed of free travel."""
    min_z_m: StrictFloat | None = Field(default=None, ge=-2.0, le=2.0)
    """Lowest height of the tip in base axes; null: none."""
    workspace_m: tuple[Span, Span, Span] | None = None
    """Least and most x, y and z of the tip in base axes; null: none."""
    robot_stale_s: StrictFloat = Field(default=0.05, gt=0, le=0.5)
    """Age of the robot's newest state at which the arm stops."""
    sensor_stale_s: StrictFloat = Field(default=0.05, gt=0, le=0.5)
    """Age of the sensor's newest sample at which the arm stops."""
    max_stall_s: StrictFloat = Field(default=0.05, gt=0, le=0.5)
    """Time between two ticks of the daemon at which the arm stops."""
    expected_stiffness_N_per_m: StrictFloat = Field(default=5000.0, ge=100)
    """The hardest material expected under the probe; for the predicted overshoot only."""

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


class MachineConfig(StrictBlock):
    """How far sensor and arm give way under load (null: the last `palpd stiffness`, or rigid and said so)."""

    stiffness_N_per_m: StrictFloat | None = Field(default=None, gt=0)
    """Stiffness of sensor and arm in series, at least 10000 for a palpation; null: the last `palpd stiffness`, without one rigid."""


class PathsConfig(StrictBlock):
    """Where recordings and the state that survives a restart (reference tare, stiffness, latch) are kept."""

    runs: Path = Path("runs")
    """Folder of the recordings."""
    write_reports: bool = True
    """Whether a report is written beside each recording when its run is over."""
    state: Path = Path("state")
    """Folder of reference tare, machine stiffness, latch and kept plans."""
    socket: Path | None = None
    """Control socket of `palpd serve`; null: `palpd.sock` in `state`."""

    @property
    def control_socket(self) -> Path:
        """Where `palpd serve` listens."""
        return self.socket or self.state / "palpd.sock"


SHALLOWEST_M, DEEPEST_M = 0.0002, 0.02
"""Depths of a press that a plan may ask for."""


def _possible_depth(depth_m: float) -> float:
    if not SHALLOWEST_M <= depth_m <= DEEPEST_M:
        raise ValueError(f"a depth of {depth_m:g} m is outside {SHALLOWEST_M} to {DEEPEST_M} m; depths are in metres (4 mm is 0.004)")
    return depth_m


Depth = Annotated[StrictFloat, AfterValidator(_possible_depth), Field(json_schema_extra={"minimum": SHALLOWEST_M, "maximum": DEEPEST_M})]

Offset = Annotated[StrictFloat, Field(ge=-0.5, le=0.5)]
"""Way of a site from where its plan counts, along an axis of the base."""


class CheckTolerances(StrictBlock):
    """What a figure of `palpd check` may change by. Of some the charts name less, where healthy days scatter less."""

    zero_N: StrictFloat = Field(default=0.5, gt=0)
    """Zero of the sensor; the chart names any change that healthy days do not show."""
    noise: StrictFloat = Field(default=0.5, gt=0, le=5)
    """Noise of the sensor, relative."""
    drift_N_per_min: StrictFloat = Field(default=0.2, gt=0)
    """Drift of the zero during the check."""
    friction_N: StrictFloat = Field(default=0.1, gt=0)
    """Friction in free strokes."""
    gain: StrictFloat = Field(default=0.02, gt=0, le=0.5)
    """Scale of the force, relative: what the puck shows."""
    delay_s: StrictFloat = Field(default=0.01, gt=0, le=0.5)
    """Delay of the force."""
    stiffness: StrictFloat = Field(default=0.1, gt=0, le=1)
    """Stiffness of the machine, relative: what the plate shows."""
    play_m: StrictFloat = Field(default=1e-4, gt=0, le=0.005)
    """Play of drive or mount: what the plate shows."""
    lost_percent: StrictFloat = Field(default=1.0, gt=0, le=100)
    """Missed ticks, lost samples, missing states of the robot."""


class CheckConfig(StrictBlock):
    """The morning check, `palpd check`: the arm begins above the plate, or without one above the puck."""

    require_check_h: StrictFloat | None = Field(default=None, gt=0, le=8760)
    """A palpation needs a check that is at most this old, after which one may palpate; null: none is needed."""
    plate: StrictBool = False
    """Whether a rigid plate lies below where the arm begins: it shows play and the stiffness of the machine."""
    puck_m: tuple[Offset, Offset] = (0.0, 0.0)
    """Way from where the arm begins to the elastic puck, along the base's x and y."""
    depth_m: Depth = 0.006
    """Depth of the presses of the puck; the force must stay below 0.9 of the contact limit."""
    search_m: StrictFloat = Field(default=0.03, gt=0, le=0.3)
    """Longest way down to the puck."""
    tolerances: CheckTolerances = CheckTolerances()
    """What the figures may change by."""


class PageConfig(StrictBlock):
    """The operator's page."""

    camera_url: str | None = Field(
        default=None, pattern=r"^https?://([A-Za-z0-9.-]+|\[[0-9A-Fa-f:.]+\])(:[0-9]{1,5})?(/[!-~]*)?$", max_length=2000
    )
    """Address of a camera's picture or MJPEG stream (http or https, without a password), shown beside the charts; null: none."""


AlarmKind = Literal["stop", "overload", "check", "disk", "late-ticks", "dead"]
"""What an alarm may tell of."""


class AlarmsConfig(StrictBlock):
    """Messages of `palpd alarms` to people who are away. An address is a secret as a whole, so only its name stands here."""

    addresses: tuple[str, ...] = ()
    """Names of the addresses that alarms go to, such as `[phone, mail]`; empty: nowhere."""
    credentials: Path | None = None
    """File with a line `name: address` for each; null: the credential `palpd-alarms` of the unit, elsewhere /etc/palpd/alarms.yaml."""
    events: tuple[AlarmKind, ...] = get_args(AlarmKind)
    """What alarms tell of: a run that was stopped, an overload, a failed check, a disk that fills up, late ticks, a dead service."""
    quiet_s: StrictFloat = Field(default=600.0, ge=1, le=86_400)
    """Time after a message in which further events of its kind are only counted; one message then tells of them all."""
    min_free_MB: StrictFloat = Field(default=1000.0, ge=0)
    """Room for recordings below which the disk is an alarm; a run takes up to 15 MB a minute."""

    @field_validator("addresses", mode="before")
    @classmethod
    def _names_only(cls, value: object) -> object:
        """Refuse an address in place of its name, without a word of it in the error."""
        names = value if isinstance(value, list | tuple) else [None]
        if not all(isinstance(name, str) and re.fullmatch(NAME_PATTERN, name) for name in names) or len(set(names)) < len(names):
            raise ValueError(
                "expected different names, such as [phone, mail]; the addresses themselves are secrets and stand in the file of "
                "alarms.credentials"
            )
        return value


class Config(StrictBlock):
    """All of config.yaml. Relative paths are relative to the file."""

    version: Version = 1
    """Version of the form of this file; one that this palpd does not know is refused."""
    robot: RobotConfig = RobotConfig()
    """The arm."""
    sensor: SensorConfig = SensorConfig()
    """The force sensor."""
    model: ModelConfig = ModelConfig()
    """The inertial model."""
    safety: SafetyConfig = SafetyConfig()
    """Limits of the guard."""
    machine: MachineConfig = MachineConfig()
    """How far the machine gives way."""
    paths: PathsConfig = PathsConfig()
    """Folders."""
    page: PageConfig = PageConfig()
    """The operator's page."""
    alarms: AlarmsConfig = AlarmsConfig()
    """Messages to people who are away."""
    check: CheckConfig = CheckConfig()
    """The morning check."""
    cell: CellFile = Field(default_factory=nominal)
    """The cell as the simulator knows it: the keys of cell.yaml."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.model.correction_limit_N >= CONTACT_FORCE_N:
            raise ValueError(
                f"model.correction_limit_N is {self.model.correction_limit_N:g} N, but contact is found at {CONTACT_FORCE_N:g} N: "
                "a correction that large could hide a contact"
            )
        return self

    def with_runs(self, folder: Path) -> "Config":
        """The same configuration, with recordings kept in that folder."""
        return self.model_copy(update={"paths": self.paths.model_copy(update={"runs": folder})})


class _ConfigFromEnvironment(Config, BaseSettings):  # type: ignore[misc] # the two kinds of model_config are merged
    """Tells pydantic-settings the keys of Config; never made, so that `Config(...)` itself does not look at the environment."""


BLOCKS = [name for name in Config.model_fields if name != "version"]
"""Blocks of config.yaml, which the environment may override."""
CONTACT_FORCE_N = 1.0
"""Force at which the surface search takes it as contact: 8 counts of Fz, 2.5 mm into 62 kPa, four times below manual palpation."""


class PlanSite(StrictBlock):
    """A place to press, as an offset along the base's axes from the plan's origin, or from the start pose where it gives none."""

    name: str = Field(min_length=1, max_length=32, pattern=NAME_PATTERN)
    """Letters, digits, `_`, `.` and `-`."""
    x_m: Offset = 0.0
    """Offset along the base's x axis."""
    y_m: Offset = 0.0
    """Offset along the base's y axis."""


class Origin(StrictBlock):
    """A place in the base's axes that a plan counts its sites from. A UR5 reaches 0.85 m."""

    x_m: StrictFloat = Field(ge=-1.0, le=1.0)
    """Along the base's x axis."""
    y_m: StrictFloat = Field(ge=-1.0, le=1.0)
    """Along the base's y axis."""


class Search(StrictBlock):
    """How the surface is looked for."""

    speed_m_per_s: StrictFloat = Field(default=0.005, ge=SLOWEST_M_PER_S, le=0.02)
    """Speed of the search downwards."""
    max_travel_m: StrictFloat = Field(default=0.08, gt=0, le=0.3)
    """The search ends without a surface after this way."""


class Strokes(StrictBlock):
    """Strokes in the air above a site, before anything is pressed there: up from the height of travel and back."""

    strokes: StrictInt = Field(ge=1, le=200)
    """Number of strokes up and back."""
    height_m: StrictFloat = Field(default=0.02, ge=0.001, le=0.1)
    """Height of a stroke."""
    speed_m_per_s: StrictFloat = Field(default=0.02, ge=SLOWEST_M_PER_S, le=0.25)
    """Speed of a stroke."""


class Plan(StrictBlock):
    """plan.yaml: where, how deep, how fast, how often. Without depths nothing is pressed or looked for, which needs free strokes."""

    version: Version = 1
    """Version of the form of this file; one that this palpd does not know is refused."""
    sites: tuple[PlanSite, ...] = Field(default=(PlanSite(name="A"),), min_length=1, max_length=1000)
    """Where to press; a plan must give them."""
    origin: Origin | None = None
    """Place that the sites count from, at most 0.3 m from the arm; null: where the arm stands."""
    mode: Literal["dynamic", "static", "both"] = "both"
    """`static`: press, hold, measure. `dynamic`: press and leave at once. `both`: one after the other."""
    depths_m: tuple[Depth, ...] = Field(default=(0.004, 0.006, 0.008), max_length=100)
    """Depths of the presses, 0.0002 to 0.02; a plan must give them."""
    press_speed_m_per_s: StrictFloat = Field(default=0.01, ge=SLOWEST_M_PER_S, le=0.05)
    """Speed of a press."""
    repeats: StrictInt = Field(default=3, ge=1, le=100)
    """Dynamic presses for each depth."""
    hold_s: StrictFloat = Field(default=3.0, ge=0.1, le=600)
    """Time of a static hold."""
    safe_height_m: StrictFloat = Field(default=0.01, ge=0.002, le=0.1)
    """Height above the surface between presses."""
    search: Search = Search()
    """How the surface is looked for."""
    free: Strokes | None = None
    """Strokes in the air before the presses; null: none."""

    @model_validator(mode="after")
    def _sensible(self) -> Self:
        if not self.depths_m and self.free is None:
            raise ValueError("depths_m is empty and there are no free strokes: the plan does nothing; give one of them")
        names = [site.name for site in self.sites]
        if len(set(names)) != len(names):
            raise ValueError(f"site names must differ, found {', '.join(names)}")
        return self


KINDS: dict[type[StrictBlock], Kind] = {Config: "config", Plan: "plan"}


def load_config(path: Path | None) -> Config:
    """Read config.yaml, with the environment's PALPD_SECTION__KEY=… and PALPD_SECTION='{key: …}' over it.

    None: every default. Raises ConfigError.
    """
    document = read_yaml(path) if path else Document("the default configuration", {})
    document.refuse_empty()
    config = _validated(Config, _overridden(document))
    if path is None:
        return config
    base = path.resolve().parent
    stated = {name: path for name in ("runs", "state", "socket") if (path := getattr(config.paths, name)) is not None}
    paths = config.paths.model_copy(update={name: base / path for name, path in stated.items()})
    model = config.model.model_copy(update={"path": base / config.model.path if config.model.path else None})
    stated_credentials = config.alarms.credentials
    alarms = config.alarms.model_copy(update={"credentials": base / stated_credentials if stated_credentials else None})
    return config.model_copy(update={"paths": paths, "model": model, "alarms": alarms})


def load_plan(path: Path) -> Plan:
    """Read plan.yaml. Raises ConfigError, one sentence."""
    return _complete_plan(read_yaml(path))


def parse_plan(values: object, where: str) -> Plan:
    """Make a plan of data, such as a request's.

    Args:
        values: Keys and values of plan.yaml.
        where: What an error calls them.

    Raises:
        ConfigError: Where the data is no plan, one sentence.
    """
    if not isinstance(values, dict):
        raise ConfigError(f"{where} holds {type(values).__name__}, expected keys and values; see plan.yaml in the repository")
    return _complete_plan(Document(where, values))


def parse_config(values: object, where: str) -> Config:
    """Make a configuration of data, such as a recording's; the environment does not change it.

    Args:
        values: Keys and values of config.yaml.
        where: What an error calls them.

    Raises:
        ConfigError: Where the data is no configuration, one sentence.
    """
    if not isinstance(values, dict):
        raise ConfigError(f"{where} holds {type(values).__name__}, expected keys and values")
    return _validated(Config, Document(where, values))


PlanLimit = tuple[float, float, str]
"""Least and most of a number of a plan, and the key of the configuration that says so."""


def plan_limits(config: Config, plan: Plan) -> dict[str, PlanLimit]:
    """The limits that a configuration sets to the numbers of a plan.

    Args:
        plan: The plan: sites count from its origin.

    Returns:
        The limits by the path of the number's key, such as `sites.2.x_m`.
    """
    return {key: limit for key, _, limit, _ in _limited(config, plan)}


def refuse_unsafe(config: Config, plan: Plan) -> None:
    """Refuse a plan that the limits of the configuration do not allow.

    Args:
        plan: Plan to judge.

    Raises:
        ConfigError: Where a speed of the plan is above the limit, or a place of it is outside the workspace.
    """
    wrong = {key: sentence for key, value, limit, sentence in _limited(config, plan) if not limit[0] <= value <= limit[1]}
    if wrong:
        raise ConfigError(next(iter(wrong.values())), wrong)


def _limited(config: Config, plan: Plan) -> Iterator[tuple[str, float, PlanLimit, str]]:
    """Each number of a plan that the configuration limits: key, value, limit, and the sentence for a value that is outside."""
    safety, origin = config.safety, plan.origin
    speed = (SLOWEST_M_PER_S, safety.max_speed_m_per_s, "safety.max_speed_m_per_s")
    speeds = {
        "press_speed_m_per_s": plan.press_speed_m_per_s,
        "search.speed_m_per_s": plan.search.speed_m_per_s,
        "free.speed_m_per_s": plan.free.speed_m_per_s if plan.free is not None else SLOWEST_M_PER_S,
    }
    for key, value in speeds.items():
        yield key, value, speed, f"the plan's {key} is {value:g} m/s, above {speed[2]} of {speed[1]:g}; lower one of them"
    if origin is None or safety.workspace_m is None:
        return
    places: list[tuple[str, str, Origin | PlanSite, tuple[float, float]]] = [("origin", "origin", origin, (0.0, 0.0))]
    places += [(f"sites.{index}", f"site {site.name}", site, (origin.x_m, origin.y_m)) for index, site in enumerate(plan.sites)]
    for key, name, place, from_m in places:
        for axis, value, base_m, (low_m, high_m) in zip("xy", (place.x_m, place.y_m), from_m, safety.workspace_m, strict=False):
            sentence = (
                f"the plan's {name} is at {axis} = {base_m + value:g} m in the base's axes, but safety.workspace_m allows {low_m:g} to "
                f"{high_m:g} m; move it, or widen the workspace"
            )
            yield f"{key}.{axis}_m", value, (low_m - base_m, high_m - base_m, "safety.workspace_m"), sentence


def close_sites(config: Config, plan: Plan) -> dict[str, str]:
    """Question sites whose contacts may overlap.

    Args:
        config: Configuration with the tip.

    Returns:
        A sentence for each site that is nearer than two tip radii to one before it, by its key.
    """
    apart_m, questions = 2.0 * config.cell.probe.tip_radius_m, {}
    for index, site in enumerate(plan.sites):
        away_m, name = min(
            ((math.hypot(site.x_m - other.x_m, site.y_m - other.y_m), other.name) for other in plan.sites[:index]), default=(math.inf, "")
        )
        if away_m < apart_m - 1e-9:  # decimals such as 0.03 - 0.02 are not exact
            questions[f"sites.{index}"] = (
                f"site {site.name} is {away_m * 1e3:.3g} mm from site {name}, nearer than {apart_m * 1e3:g} mm (two tip radii): "
                "their presses overlap; is that meant?"
            )
    return questions


def _complete_plan(document: Document) -> Plan:
    """A plan whose author says where and how deep: a file without them must not press somewhere by default."""
    plan = _validated(Plan, document)
    if missing := [key for key in ("sites", "depths_m") if key not in document.keys_and_values()]:
        raise ConfigError(
            f"{document.name}: {' and '.join(missing)} {'are' if missing[1:] else 'is'} not given; a plan says where and how deep"
        )
    return plan


def _overridden(document: Document) -> Document:
    """The document with what the environment says in place of its own."""
    variables = {name.upper(): name for name in os.environ if name.upper().startswith(ENVIRONMENT_PREFIX)}
    for name in variables.values():
        _refuse_unknown_variable(name)
    source = _Environment(_ConfigFromEnvironment, case_sensitive=False, env_prefix=ENVIRONMENT_PREFIX, env_nested_delimiter="__")
    values, places = dict(document.keys_and_values()), dict(document.places)
    for section, block in source().items():
        if section == "version":
            continue  # of the file; a variable PALPD_VERSION belongs to another program
        stated = values.get(section)
        if stated is not None and not isinstance(stated, dict):
            raise ConfigError(
                f"{document.place((section,))}: {section} is not a block of keys, so the environment cannot override a key of it"
            )
        if not isinstance(block, dict):
            raise ConfigError(f"{ENVIRONMENT_PREFIX}{section.upper()} is not a block of keys, expected such as {{key: value}}")
        block = _read_texts(_fields_of(Config.model_fields[section]), block, f"{ENVIRONMENT_PREFIX}{section.upper()}")
        values[section] = _merged(stated or {}, block)
        for location in _locations(block, (section,)):
            name = ENVIRONMENT_PREFIX + "__".join(map(str, location)).upper()
            places[location] = f"environment variable {variables.get(name, ENVIRONMENT_PREFIX + section.upper())}"
    return Document(document.name, values, places)


class _Environment(EnvSettingsSource):
    """Overrides from the environment; blocks and lists are read as strictly as a file."""

    def decode_complex_value(self, *arguments: Any) -> Any:
        """Read a block or a list that stands for a key. Raises ConfigError."""
        key, _, text = arguments
        return parse_yaml(text, f"environment variable for {key}").content


def _refuse_unknown_variable(name: str) -> None:
    """Refuse a variable that looks like a key of ours and overrides none; others with our prefix may belong to other programs."""
    section, split, _ = name[len(ENVIRONMENT_PREFIX) :].lower().partition("__")
    known = BLOCKS
    begins = next((each for each in known if section.startswith(f"{each}_")), None)
    if section not in known and (split or begins):
        hint = f" (did you mean {ENVIRONMENT_PREFIX}{begins.upper()}__…?)" if begins else nearest(section, known)
        raise ConfigError(f"environment variable {name}: {section} is not a block of config.yaml{hint}; known: {', '.join(known)}")


def _read_texts(fields: Mapping[str, FieldInfo], block: Mapping[str, Any], name: str) -> dict[str, Any]:
    """The block with texts read as YAML where the key does not hold a text: the environment has no numbers."""
    read: dict[str, Any] = {}
    for key, value in block.items():
        field = fields.get(key)
        types = get_args(field.annotation) or (field.annotation,) if field else ()
        if isinstance(value, dict):
            read[key] = _read_texts(_fields_of(field) if field else {}, value, f"{name}__{key.upper()}")
        elif isinstance(value, str) and (value == "null" or not {str, Path} & set(types)):
            read[key] = parse_yaml(value, f"environment variable {name}__{key.upper()}").content
        else:
            read[key] = value
    return read


def _fields_of(field: FieldInfo) -> Mapping[str, FieldInfo]:
    models = [each for each in (field.annotation, *get_args(field.annotation)) if hasattr(each, "model_fields")]
    return models[0].model_fields if models else {}


def _merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    both = {
        key: _merged(below[key], above[key])
        for key in below.keys() & above.keys()
        if isinstance(below[key], dict) and isinstance(above[key], dict)
    }
    return {**below, **above, **both}


def _locations(block: Mapping[str, Any], at: tuple[str | int, ...]) -> list[tuple[str | int, ...]]:
    return [(*at, key) for key in block] + [
        each for key, value in block.items() if isinstance(value, dict) for each in _locations(value, (*at, key))
    ]


def _validated(model: type[Model], document: Document) -> Model:
    refuse_renamed(KINDS[model], document)
    try:
        return model.model_validate(document.keys_and_values())
    except ValidationError as error:
        raise ConfigError(refusal(error, model, document, HINTS), faults(error, model, HINTS)) from error
