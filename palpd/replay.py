"""Dry run against a recording: the same loop, guard and sequence on what was recorded, faster than real time.

From an MCAP every decision is made again and compared bit for bit. A CSV has no robot states of its own rate and no plan, so it goes
through tare, compensation, contact and guard row by row.
"""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from palpd.config import Config, Plan, parse_config, parse_plan
from palpd.errors import RecordingError
from palpd.inertial import InertialModel, Motion
from palpd.loop import Explainer, Loop, Turn
from palpd.motion import Job, limits_of, sequence_of, zero_of
from palpd.record import RecordedRobot, RecordedSensor, Recording
from palpd.rows import RowWriter
from palpd.safety import Guard, Sight, guard, sentence
from palpd.samples import Samples
from palpd.tare import Tare
from palpd.tick import (
    PROGRAM_PLAYING,
    ROW,
    STILL,
    Action,
    Request,
    RobotMode,
    RobotState,
    SafetyMode,
    SensorFrames,
    Timing,
)

DECISIONS = (
    "zero_N",
    "phase",
    "mode",
    "site",
    "repeat",
    "depth_m",
    "surface_z_m",
    "cut_short",
    "force_N",
    "absolute_N",
    "proposed_m_per_s",
    "proposed_stop",
    "command_m_per_s",
    "command_stop",
    "action",
    "trip",
    "trip_measured",
    "trip_limit",
)
"""The fields of a row that the daemon decided; all others are what it saw."""


@dataclass(slots=True)
class RecordedClock:
    """Gives out the recorded ticks, one after the other, and moves robot and sensor on with them."""

    recording: Recording
    robot: RecordedRobot
    sensor: RecordedSensor
    at: int = -1

    def wait(self) -> Timing:
        self.at += 1
        self.robot.advance(self.at)
        self.sensor.advance(self.at)
        row = self.recording.rows[self.at]
        return Timing(int(row["index"]), float(row["planned_s"]), float(row["now_s"]), int(row["missed"]))

    def elapsed_us(self) -> float:
        return 0.0


def replay(recording: Recording, config: Config | None = None) -> dict[str, Any]:
    """Make every decision of a recorded run again. With another `config` the decisions may differ, and the first that does is named."""
    header, rows = recording.header, recording.rows
    if not len(rows):
        raise RecordingError("the recording holds no tick; there is nothing to replay")
    config = config or parse_config(header["config"], "the recording's configuration")
    plan: Plan = parse_plan(header["plan"], "the recording's plan")
    job = Job(
        header["kind"],
        config,
        plan,
        header["dry"],
        reference=tuple(header["reference"]),
        machine_stiffness_N_per_m=header["machine_stiffness_N_per_m"],
    )
    model = None
    if recording.model_bytes is not None and header["model_card"] is not None:
        model = InertialModel.from_bytes(recording.model_bytes, header["model_card"])
    explainer = Explainer(
        reference=np.array(header["reference"], dtype=float),
        rotation_about_flange_z_rad=config.sensor.rotation_about_flange_z_rad,
        model=model,
        zero=zero_of(config.model) if model is not None else None,
        correction_limit_N=config.model.correction_limit_N,
        motion=Motion(header["body"]["delay_s"]),
    )
    robot, sensor = RecordedRobot(rows), RecordedSensor(rows)
    clock = RecordedClock(recording, robot, sensor)
    compare = _Compare(rows)
    loop = Loop(
        robot, sensor, clock, sequence_of(job, header["body"]["delay_s"]), explainer, limits_of(config, job.dry), compare,
        request=lambda: Request(int(rows[clock.at]["request"])),
    )  # fmt: skip
    began_s = time.perf_counter()
    while clock.at + 1 < len(rows) and loop.turn():
        pass
    took_s = time.perf_counter() - began_s
    ended_early = clock.at + 1 < len(rows)
    return {
        "ticks": clock.at + 1,
        "decisions_identical": compare.first is None and not ended_early,
        "first_difference": compare.first or ("the replay ended earlier" if ended_early else None),
        "verdict": recording.footer.get("verdict", "stopped") if not compare.first else loop.outcome.verdict,
        "reason": loop.outcome.reason,
        "peak_force_N": float(rows["force_N"].max()),
        "realtime_factor": float(rows["now_s"][-1] - rows["now_s"][0]) / max(took_s, 1e-9),
    }


class _Compare:
    """Takes the turns of a replay and holds them against the recorded rows."""

    def __init__(self, rows: np.ndarray[Any, np.dtype[np.void]]) -> None:
        self._rows = rows
        self._made = np.zeros(1, ROW)
        self._writer = RowWriter(self._made)
        self._at = 0
        self.first: str | None = None

    def __call__(self, turn: Turn) -> None:
        self._writer.fill(0, turn)
        recorded = self._rows[self._at]
        if self.first is None:
            for name in DECISIONS:
                if self._made[0][name].tobytes() != recorded[name].tobytes():
                    self.first = f"tick {int(recorded['index'])}, {name}: recorded {recorded[name]}, replayed {self._made[0][name]}"
                    break
        self._at += 1

    def rehearse(self, turn: Turn) -> None:
        """Nothing to warm up."""


def replay_samples(samples: Samples, config: Config) -> dict[str, Any]:
    """Tare, compensation, contact and guard on every row of a recording that was tared when it was made; no sequence.

    Staleness is judged by the file's own rate: a foreign rig of 8 Hz is not stale at 125 ms.
    """
    period_s = float(np.median(np.diff(samples.t_s)))
    limits = limits_of(config)
    limits = type(limits)(
        **{
            **{name: getattr(limits, name) for name in limits.__slots__},
            "robot_stale_s": max(limits.robot_stale_s, 3 * period_s),
            "sensor_stale_s": max(limits.sensor_stale_s, 3 * period_s),
        }
    )
    model = None
    if config.model.path is not None:
        model = InertialModel.load(config.model.path, probe_mass_kg=config.cell.probe.mass_kg, sensor_serial=None)
    explainer = Explainer(np.zeros(6), model=model, correction_limit_N=config.model.correction_limit_N, tare=np.zeros(6))
    tare = Tare()
    tared = False
    memory, trips, last_trip, peak_N = Guard(), [], 0, -np.inf
    began_s = time.perf_counter()
    for index in range(len(samples)):
        timing, robot, frames = _row(samples, index)
        if not tared and tare.add(robot, frames):
            tared = True
            if tare.refusal() is None:
                explainer.tare = tare.result()
        contact = explainer.contact(robot, frames)
        peak_N = max(peak_N, contact.force_N)
        memory, verdict = guard(limits, memory, Sight(timing, robot, frames, contact, safe_z_m=float(samples.z_m.max())), STILL)
        if verdict.action != Action.PASS and verdict.trip != last_trip:
            trips.append({"row": index, "t_s": timing.now_s, "trip": verdict.trip.name, "reason": sentence(verdict)})
        last_trip = verdict.trip
        if memory.over:  # on the cell the run would be over here; the rest is judged as a new one, so that every row has a verdict
            memory = Guard()
    took_s = time.perf_counter() - began_s
    return {
        "ticks": len(samples),
        "verdict": "stopped" if trips else "done",
        "trips": trips,
        "tare": "from the first rows" if tared and tare.refusal() is None else f"as recorded: {tare.refusal()}",
        "peak_force_N": float(peak_N),
        "realtime_factor": samples.duration_s / max(took_s, 1e-9),
    }


def _row(samples: Samples, index: int) -> tuple[Timing, RobotState, SensorFrames]:
    """One row as the loop would have seen it: the tool straight down, everything healthy but what the row itself says."""
    t_s = float(samples.t_s[index])
    pose = (0.0, 0.0, float(samples.z_m[index]), np.pi, 0.0, 0.0)
    target_z_m = float(samples.z_cmd_m[index]) if samples.z_cmd_m is not None else pose[2]
    speed = (0.0, 0.0, float(samples.vz_m_per_s[index]), 0.0, 0.0, 0.0)
    robot = RobotState(
        t_s, t_s, pose, speed, (*pose[:2], target_z_m, *pose[3:]), speed, (0.0, 0.0, 0.0),
        RobotMode.RUNNING, SafetyMode.NORMAL, 1, PROGRAM_PLAYING, True,
    )  # fmt: skip
    flip = np.array([1.0, -1.0, -1.0, 1.0, -1.0, -1.0])  # base axes back into the axes of a sensor that points down
    frames = SensorFrames(
        np.array([t_s]), np.array([index & 0xFFFF], np.uint16), np.zeros(1, np.uint16), (samples.wrench[index] * flip)[None, :]
    )
    return Timing(index, t_s, t_s), robot, frames
