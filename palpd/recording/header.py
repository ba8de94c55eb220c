"""What a recording says of its whole run: the header when it begins, the footer when it has ended."""

from typing import Any, Literal, TypedDict


class RunAbout(TypedDict, total=False):
    """The devices of a run, as they were opened; empty where they were not.

    `delay_s` is the sensor filter's delay, `pulled_over_pressed` the ratio of the two slopes of Fz where the sensor gives both.
    """

    robot_host: str
    robot_model: str
    sensor_serial: str
    sensor_port: str
    counts_per_N: list[float]
    counts_per_Nm: list[float]
    calibration_source: str
    pulled_over_pressed: float | None
    delay_s: float
    epoch_offset_s: float


class RecordedSite(TypedDict):
    """A place of the plan, as an offset along the base's axes from the plan's origin, or from the start pose where it gives none."""

    name: str
    x_m: float
    y_m: float


class RecordedPlace(TypedDict):
    """Where the sites count from, in base axes.

    `taken` says how: as the `plan` states, the `start` pose, `here` by the operator's word, or after a `return`. `unfinished` is the run
    before, where it did not end at its start, and `moved_m` the way from its origin to this one. A run that went back first went to
    `back_to_m`, not below `top_z_m` on its way.
    """

    x_m: float
    y_m: float
    taken: Literal["plan", "start", "here", "return"]
    unfinished: str | None
    moved_m: float | None
    back_to_m: list[float] | None
    top_z_m: float | None


class RecordedGeometry(TypedDict):
    """What the moduli of a run depend on. Without a measured machine stiffness the machine counts as rigid."""

    tip_radius_m: float
    poisson_ratio: float
    delay_s: float
    machine_stiffness_N_per_m: float | None


class RecordingHeader(TypedDict, total=False):
    """What a recording holds besides its ticks, so that every decision can be made again.

    `config` and `plan` are config.yaml and plan.yaml as parsed, `model_card` is the inertial model's card, `reference` (6,) the tare of the
    last calibration, taken on `reference_date` where that is known. `epoch_offset_s` turns monotonic seconds into Unix time. A palpation
    without `returns_to_start` ended above its last site; with `pauses_in_place` a pause stood still where the arm was; without
    `lifts_first` nothing showed that it was not tared in contact, and without `fits_slope` its search took every force for contact. A
    retract of an `unfinished` contact went up at any force, at least to `clear_z_m`. `injection` marks a run of `palpd inject` for ever:
    the SHA-256 of its sealed answer; other runs have None. A simulated run fills only what the analysis reads. `format_version` is that of
    the file, 1 where it is absent.
    """

    format_version: int
    kind: Literal["palpation", "free_motion", "stiffness", "retract", "level_test", "calibrate", "check", "observe"]
    dry: bool
    config: dict[str, Any]
    plan: dict[str, Any]
    sites: list[RecordedSite]
    place: RecordedPlace | None
    returns_to_start: bool
    pauses_in_place: bool
    lifts_first: bool
    fits_slope: bool
    unfinished: bool
    clear_z_m: float | None
    reference: list[float]
    reference_date: str | None
    machine_stiffness_N_per_m: float | None
    body: RecordedGeometry
    about: RunAbout
    epoch_offset_s: float
    model_card: dict[str, Any] | None
    versions: dict[str, str]
    started: str
    injection: str | None


class RecordedTrip(TypedDict):
    """A verdict of the guard, or a device that failed: measured value and limit, and both as a sentence."""

    trip: str
    measured: float
    limit: float
    reason: str


class RecordedStall(TypedDict):
    """A processor of this computer stood still, on the clock of the ticks."""

    begin_s: float
    end_s: float
    processor: int


class RecordingFooter(TypedDict, total=False):
    """How a recorded run ended.

    `stalls` is what the witness of this computer reported, `lost_rows` the number of ticks that were overwritten before the recorder read
    them, `damaged_ticks` the number that `recover` could not restore.
    """

    verdict: str
    reason: str
    trips: list[RecordedTrip]
    stalls: list[RecordedStall]
    lost_rows: int
    damaged_ticks: int
