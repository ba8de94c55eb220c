"""Dry run against a recording: the loop and the guard of a run on recorded data, faster than real time.

A replay of an MCAP makes every decision again and compares it bit for bit. With another configuration it goes on to the first command
that differs. A CSV has neither robot states at their own rate nor a plan. There the same loop tares, explains and guards row by row, and a
script that stands still replaces the sequence.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol, TypedDict

import numpy as np

from palpd.config import Config, parse_config, parse_plan
from palpd.control.inertial import InertialModel
from palpd.control.loop import Loop, Outcome
from palpd.control.safety import GuardState, Limits, sentence
from palpd.control.sequence import Script, Sequence, Steps
from palpd.control.tare import Tare
from palpd.daemon.motion_job import Job, arm_geometry_of, explainer_of, explainer_with, job_limits, limits_of, sequence_of
from palpd.daemon.other_config import ChangedSetting, WouldHave, as_tested, changed_settings, same_command, would_have
from palpd.daemon.overshoot import refuse_together
from palpd.errors import ConfigError, RecordingError
from palpd.recording.reader import PlainRows, RecordedRobot, RecordedSensor, Recording
from palpd.recording.ring import Rows
from palpd.recording.samples import Samples
from palpd.recording.tick_rows import DECISIONS, RowWriter, decision
from palpd.tick import (
    PROGRAM_PLAYING,
    ROW,
    Action,
    Request,
    RobotMode,
    RobotState,
    SafetyMode,
    SensorFrames,
    TickRecord,
    Timing,
    Trip,
    UncommandedRobot,
)

NEEDED_KEYS = ("kind", "config", "plan", "dry", "reference", "machine_stiffness_N_per_m", "body", "model_card")
"""Keys of a recording's header without which its decisions cannot be made again."""
STALE_PERIODS = 3
"""Sampling periods of a CSV after which it counts as stale: a foreign rig of 8 Hz is not stale at 125 ms."""


class ReplayResult(WouldHave):
    """Whether a replay made the same decisions, and how fast; with another configuration, what that would have done.

    Then `ticks` and `peak_force_N` end at the first different command.
    """

    ticks: int
    decisions_identical: bool
    first_difference: str | None
    peak_force_N: float
    realtime_factor: float
    changed_settings: list[ChangedSetting]


class CsvTrip(TypedDict):
    """A verdict of the guard on a row of a CSV."""

    row: int
    t_s: float
    trip: str
    reason: str


class CsvResult(TypedDict):
    """The guard's verdict on the rows of a CSV; `tare` says where the zero came from."""

    ticks: int
    verdict: str
    trips: list[CsvTrip]
    tare: str
    peak_force_N: float
    realtime_factor: float


class Steppable(Protocol):
    """A device of a recording."""

    def advance(self, number: int) -> None:
        """Go to the tick of that row."""
        ...


@dataclass(slots=True)
class RecordedClock:
    """Hands out the recorded ticks, one after the other, and steps the recorded devices with them."""

    ticks: int
    timing: Callable[[int], Timing]
    devices: tuple[Steppable, ...]
    at: int = -1

    @property
    def over(self) -> bool:
        """Whether the last tick was handed out."""
        return self.at + 1 >= self.ticks

    def wait(self) -> Timing:
        """The next tick."""
        self.at += 1
        for device in self.devices:
            device.advance(self.at)
        return self.timing(self.at)

    def elapsed_us(self) -> float:
        """Nothing: no time passes within a recorded tick."""
        return 0.0


# --- a recording of the daemon ------------------------------------------------------------------------------------------------


def replay(recording: Recording, config: Config | None = None) -> ReplayResult:
    """Make every decision of a recorded run again.

    Args:
        config: Another configuration: what it would have done, up to its first different command. None: the recording's own.

    Returns:
        Whether the decisions are identical, and the figures of the replay.

    Raises:
        RecordingError: The recording holds no tick.
        ConfigError: The other configuration would have refused the run.
        ModelRefused: The inertial model of the other configuration may not be used.
    """
    header, rows = recording.header, recording.rows
    if not len(rows):
        raise RecordingError("the recording holds no tick; there is nothing to replay")
    if missing := [key for key in NEEDED_KEYS if key not in header]:
        raise RecordingError(f"the header of {recording.path} has no {', '.join(missing)}; give a recording of palpd run")
    place = header.get("place")
    back_to_m = place["back_to_m"] if place is not None else None
    own, plan = parse_config(header["config"], "the recording's configuration"), parse_plan(header["plan"], "the recording's plan")
    given = own if config is None else config
    if config is not None and header["kind"] == "palpation":
        try:
            refuse_together(config, plan)
        except ConfigError as error:
            raise ConfigError(f"with this configuration the run would have been refused before it moved: {error}") from error
    job = Job(
        header["kind"],
        as_tested(own, given),
        plan,
        header["dry"],
        reference=tuple(header["reference"]),
        machine_stiffness_N_per_m=(config and config.machine.stiffness_N_per_m) or header["machine_stiffness_N_per_m"],
        returns_to_start=header.get("returns_to_start", False),
        pauses_in_place=header.get("pauses_in_place", True),
        lifts_first=header.get("lifts_first", False),
        fits_slope=header.get("fits_slope", False),
        back_to_m=(back_to_m[0], back_to_m[1], back_to_m[2]) if back_to_m is not None else None,
        top_z_m=place["top_z_m"] if place is not None and place["top_z_m"] is not None else -math.inf,
        unfinished=header.get("unfinished", False),
        clear_z_m=header.get("clear_z_m"),
    )
    delay_s = header["body"]["delay_s"]
    model = None
    if recording.model_bytes is not None and header["model_card"] is not None:
        model = InertialModel.from_bytes(recording.model_bytes, header["model_card"])
    about = header.get("about", {})
    explainer = explainer_with(model, job, delay_s, about.get("pulled_over_pressed"))
    if (given.model.path, given.cell.probe.mass_kg) != (own.model.path, own.cell.probe.mass_kg):
        explainer = explainer_of(job, about, delay_s)  # the recording holds its own model only, for its own probe
    robot, sensor, comparison = RecordedRobot(rows), RecordedSensor(rows), _Comparison(rows)
    plain = PlainRows(rows, ("index", "planned_s", "now_s", "missed", "request"))
    clock = RecordedClock(len(rows), lambda at: Timing(*plain[at][:-1]), (robot, sensor))
    loop = Loop(
        robot, sensor, clock, sequence_of(job, delay_s), explainer, job_limits(job), comparison,
        request=lambda: Request(plain[clock.at][-1]),
    )  # fmt: skip
    began_s, goes_on = time.perf_counter(), True
    while goes_on and not clock.over and (config is None or not comparison.parted):
        goes_on = loop.tick()
    took_s = time.perf_counter() - began_s
    difference = comparison.first or (None if clock.over else "the replay ended earlier")
    again: WouldHave = {
        "verdict": recording.footer.get("verdict", "stopped") if not comparison.first else loop.outcome.verdict,
        "reason": loop.outcome.reason,
        "would_have": None,
        "first_different_command": None,
        "sentences": [],
    }
    return {
        **(again if config is None else would_have(recording, clock.at, comparison.newest, goes_on, loop)),
        "ticks": clock.at + 1,
        "decisions_identical": difference is None,
        "first_difference": difference,
        "peak_force_N": float(rows["force_N"].max()) if config is None else comparison.peak_N,
        "realtime_factor": float(rows["now_s"][clock.at] - rows["now_s"][0]) / max(took_s, 1e-9),
        "changed_settings": changed_settings(own, given),
    }


class _Comparison:
    """Takes the ticks of a replay and compares each with its recorded row; `first` names the first difference."""

    def __init__(self, rows: Rows) -> None:
        self._rows = rows
        self._bytes = np.ascontiguousarray(rows).view(np.uint8).data
        self._ends_at = 0  # the decisions are the last fields of a row
        self._at = 0
        self.first: str | None = None
        self.parted = False
        self.peak_N = -math.inf
        self.newest: TickRecord

    def __call__(self, record: TickRecord) -> None:
        decided = decision(record)
        self._ends_at += self._rows.itemsize
        if self._bytes[self._ends_at - len(decided) : self._ends_at] != decided:
            self.first = self.first or self._difference(record)
            self.parted = self.parted or not same_command(self._rows[self._at], record)
        self.peak_N = max(self.peak_N, record.observation.contact.force_N)
        self.newest = record
        self._at += 1

    def _difference(self, record: TickRecord) -> str:
        row = np.zeros(1, ROW)
        RowWriter(row).fill(0, record)
        recorded, replayed = self._rows[self._at], row[0]
        name = next(name for name in DECISIONS if replayed[name].tobytes() != recorded[name].tobytes())
        return f"tick {int(recorded['index'])}, {name}: recorded {recorded[name]}, replayed {replayed[name]}"

    def rehearse(self, record: TickRecord) -> None:
        """Nothing to warm up."""


# --- a CSV --------------------------------------------------------------------------------------------------------------------


def replay_samples(samples: Samples, config: Config) -> CsvResult:
    """Tare, compensation, contact and guard on every row of a CSV that was tared when it was recorded; no sequence.

    Where the guard ends a run, the next row begins a new one, so that every row has a verdict.

    Args:
        samples: The rows, in base axes.
        config: The configuration that judges them.

    Returns:
        The trips of the guard and the figures of the replay.
    """
    job = Job("palpation", config)
    model = None
    if config.model.path is not None:
        model = InertialModel.load(config.model.path, probe_mass_kg=config.cell.probe.mass_kg, sensor_serial=None)
    explainer = replace(explainer_with(model, job, delay_s=0.0), rotation_about_flange_z_rad=0.0, zero=None)
    robot, sensor, trips = SampledRobot(samples), SampledSensor(samples), _Trips()
    clock = RecordedClock(len(samples), lambda at: Timing(at, float(samples.t_s[at]), float(samples.t_s[at])), (robot, sensor))
    standing = Sequence(StandStill(job, safe_z_m=float(samples.z_m.max())))
    tare = Tare()
    loop = Loop(robot, sensor, clock, standing, explainer, _limits_at_rate_of(samples, config), trips, _tare=tare)
    began_s = time.perf_counter()
    while not clock.over:
        goes_on = loop.tick()
        if loop.outcome.refused:
            explainer.tare = np.zeros(6)
        if not goes_on:
            loop = replace(loop, outcome=Outcome(), _guard_state=GuardState())
    took_s = time.perf_counter() - began_s
    return {
        "ticks": len(samples),
        "verdict": "stopped" if trips.kept else "done",
        "trips": trips.kept,
        "tare": _tare_sentence(tare, tared=explainer.tare is not None),
        "peak_force_N": trips.peak_N,
        "realtime_factor": samples.duration_s / max(took_s, 1e-9),
    }


def _tare_sentence(tare: Tare, tared: bool) -> str:
    if not tared:
        return "as recorded: the recording is shorter than a tare"
    refusal = tare.refusal()
    return f"as recorded: {refusal}" if refusal else "from the first rows"


def _limits_at_rate_of(samples: Samples, config: Config) -> Limits:
    limits, patience_s = limits_of(config), STALE_PERIODS * float(np.median(np.diff(samples.t_s)))
    stale_s = max(limits.robot_stale_s, patience_s), max(limits.sensor_stale_s, patience_s)
    return replace(limits, robot_stale_s=stale_s[0], sensor_stale_s=stale_s[1])


class StandStill(Script):
    """Proposes no motion, as long as it is asked."""

    def __init__(self, job: Job, safe_z_m: float) -> None:
        super().__init__(arm_geometry_of(job, delay_s=0.0))
        self._safe_z_m = safe_z_m

    def run(self) -> Steps:
        """Stand still without end."""
        self.note(floor_z_m=-math.inf, safe_z_m=self._safe_z_m)
        while True:
            yield from self.move()


@dataclass(slots=True)
class _Trips:
    """Takes the ticks of a replay; keeps the first row of each trip and the peak of the contact force."""

    kept: list[CsvTrip] = field(default_factory=list)
    peak_N: float = -math.inf
    _row: int = 0
    _last: Trip = Trip.NONE

    def __call__(self, record: TickRecord) -> None:
        verdict = record.verdict
        self.peak_N = max(self.peak_N, float(record.observation.contact.force_N))
        if verdict.action != Action.PASS and verdict.trip != self._last:
            self.kept.append({"row": self._row, "t_s": record.observation.now_s, "trip": verdict.trip.name, "reason": sentence(verdict)})
        self._last = verdict.trip
        self._row += 1

    def rehearse(self, record: TickRecord) -> None:
        """Nothing to warm up."""


class SampledRobot(UncommandedRobot):
    """The Robot of a CSV: the tool points straight down, and everything is healthy that the row does not contradict."""

    def __init__(self, samples: Samples) -> None:
        self._samples, self._at = samples, 0

    def advance(self, number: int) -> None:
        """Go to that row."""
        self._at = number

    def read(self) -> RobotState:
        """The state of this row."""
        samples, at = self._samples, self._at
        t_s, z_m = float(samples.t_s[at]), float(samples.z_m[at])
        target_z_m = float(samples.z_cmd_m[at]) if samples.z_cmd_m is not None else z_m
        speed = (0.0, 0.0, float(samples.vz_m_per_s[at]), 0.0, 0.0, 0.0)
        return RobotState(
            t_s, t_s, (0.0, 0.0, z_m, np.pi, 0.0, 0.0), speed, (0.0, 0.0, target_z_m, np.pi, 0.0, 0.0), speed, (0.0, 0.0, 0.0),
            RobotMode.RUNNING, SafetyMode.NORMAL, 1, PROGRAM_PLAYING, True,
        )  # fmt: skip


class SampledSensor:
    """The ForceSensor of a CSV: one frame a row, in the axes of a sensor that points down."""

    BASE_FROM_SENSOR = np.array([1.0, -1.0, -1.0, 1.0, -1.0, -1.0])

    def __init__(self, samples: Samples) -> None:
        self._samples, self._at = samples, 0

    def advance(self, number: int) -> None:
        """Go to that row."""
        self._at = number

    def read(self) -> SensorFrames:
        """The frame of this row."""
        t_s, wrench = self._samples.t_s[self._at], self._samples.wrench[self._at] * self.BASE_FROM_SENSOR
        counter = np.array([self._at & 0xFFFF], np.uint16)
        return SensorFrames(np.array([t_s]), counter, np.zeros(1, np.uint16), wrench[None, :])

    def close(self) -> None:
        """Nothing is open."""
