"""The guard, the last step before the wire: pure, default deny. The time is an argument.

It enforces two force limits against two zeros. The compensated contact force against the running tare retracts the probe and ends
the run. The raw force against the reference tare of the last calibration stops the arm where it is, latched. No model output and
no re-tare loosens the second limit. With a dead sensor the guard stops and does not retract: a retract would be moving blind.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from typing import NamedTuple

from palpd.tick import (
    PROGRAM_PLAYING,
    STOP,
    Action,
    Command,
    Contact,
    Floats,
    Observation,
    Progress,
    Request,
    RobotMode,
    RobotState,
    SafetyMode,
    Trip,
    Verdict,
)

RETRACT_M_PER_S = 0.02
"""Speed at which the guard leaves the tissue: fast enough to unload it quickly, slow enough to stop within 1 mm."""
DEPTH_MARGIN_M = 0.0005
"""How far the tip may be seen below the commanded depth; beyond that the guard stops."""
TILT_RAD = math.radians(2.0)
"""Largest tilt of the tool: at 2 degrees the vertical force is still 99.9 % of the axial one."""
FROZEN_FRAMES = 200
"""Number of equal frames in a row that mark a stuck sensor, equal to the last digit on all six axes.

Quiet Fz alone may rest on one count for long. Six axes at rest move by a count or two within 0.12 s, even behind the 15 Hz filter.
At 1 kHz and 10 mm/s, 200 frames are 2 mm of blind motion."""

ABORT, ORPHANED, RUNNING = Request.ABORT, Request.ORPHANED, RobotMode.RUNNING
FIT_TO_MOVE = (SafetyMode.NORMAL, SafetyMode.REDUCED)
"""Enum members, looked up once: before Python 3.12 one lookup costs ten comparisons, and a tick has many."""


@dataclass(frozen=True, slots=True)
class Limits:
    """What the guard enforces. `workspace_m` is ((x, x), (y, y), (z, z)), lowest and highest, or None.

    Without `needs_program` the guard accepts a controller that plays no program of ours: a dry run commands nothing.
    """

    contact_N: float
    absolute_N: float
    lateral_N: float
    torque_Nm: float
    max_speed_m_per_s: float
    robot_stale_s: float
    sensor_stale_s: float
    max_missed_ticks: int
    max_rejected_per_s: float = 50.0
    overload_N: float = 200.0
    needs_program: bool = True
    min_z_m: float | None = None
    workspace_m: tuple[tuple[float, float], ...] | None = None


class GuardState(NamedTuple):
    """What the guard remembers from tick to tick; a `trip` other than NONE stays latched until a new run begins.

    `over` means that the run has ended. `sensor_heard_s` and `robot_heard_s` are the times of the newest data, `rejected` is the
    number of rejected frames, fading over a second.
    """

    trip: Trip = Trip.NONE
    measured: float = 0.0
    limit: float = 0.0
    retracting: bool = False
    over: bool = False
    sensor_heard_s: float = math.nan
    robot_heard_s: float = math.nan
    robot_timestamp_s: float = math.nan
    last_wrench: Sequence[float] = ()
    equal_frames: int = 0
    rejected: float = 0.0
    looked_s: float = math.inf


Fault = tuple[Trip, float, float]
"""A reason to stop the arm where it is: the trip, the measured value and the limit."""


def guard(limits: Limits, state: GuardState, observation: Observation, bounds: Progress, proposed: Command) -> tuple[GuardState, Verdict]:
    """Decide which command may go out.

    Args:
        limits: what the configuration allows.
        state: what the guard remembers of the ticks before.
        observation: what this tick saw.
        bounds: the present step; only its `floor_z_m` and `safe_z_m` count here.
        proposed: the command that the sequence proposes.

    Returns:
        The state for the next tick, and the verdict with the command that may go out.
    """
    wrenches = observation.frames.wrench.tolist()  # plain floats: for two to eight rows they cost a third of numpy's calls
    state = _listen(state, observation, wrenches)
    fault = _first_fault(limits, state, observation, wrenches, bounds, proposed)
    if state.over:
        return state, Verdict(STOP, Action.STOP, state.trip, state.measured, state.limit)
    if fault is not None:
        return _stopped(state, *fault)
    contact_N = observation.contact.force_N
    if not state.retracting and contact_N >= limits.contact_N:
        state = state._replace(trip=Trip.CONTACT_FORCE, measured=contact_N, limit=limits.contact_N, retracting=True)
    if not state.retracting:
        return state, Verdict(proposed)
    if observation.robot.z_m >= bounds.safe_z_m:
        return _stopped(state, state.trip, state.measured, state.limit)
    up = Command((0.0, 0.0, min(RETRACT_M_PER_S, limits.max_speed_m_per_s)))
    return state, Verdict(up, Action.RETRACT, state.trip, state.measured, state.limit)


def _stopped(state: GuardState, trip: Trip, measured: float, limit: float) -> tuple[GuardState, Verdict]:
    state = state._replace(trip=trip, measured=measured, limit=limit, over=True)
    return state, Verdict(STOP, Action.STOP, trip, measured, limit)


def _listen(state: GuardState, observation: Observation, wrenches: list[list[float]]) -> GuardState:
    """Note when each device was last heard and whether it says anything new."""
    now_s, frames, robot = observation.timing.now_s, observation.frames, observation.robot
    wrench, equal = state.last_wrench, state.equal_frames
    if wrenches:
        first_row, *others = wrenches
        same = others.count(first_row) == len(others) and (not wrench or first_row == wrench)
        wrench, equal = wrenches[-1], (equal + len(wrenches) if same else 0)
    fresh = robot.timestamp_s != state.robot_timestamp_s
    first = math.isnan(state.sensor_heard_s)
    faded = math.exp(min(state.looked_s - now_s, 0.0))  # over a second, whatever the rate of the loop
    return GuardState(
        state.trip,
        state.measured,
        state.limit,
        state.retracting,
        state.over,
        sensor_heard_s=float(frames.t_s[-1]) if wrenches else (now_s if first else state.sensor_heard_s),
        robot_heard_s=robot.t_s if fresh else state.robot_heard_s,
        robot_timestamp_s=robot.timestamp_s,
        last_wrench=wrench,
        equal_frames=equal,
        rejected=state.rejected * faded + frames.rejected,
        looked_s=now_s,
    )


def _first_fault(
    limits: Limits, state: GuardState, observation: Observation, wrenches: list[list[float]], bounds: Progress, proposed: Command
) -> Fault | None:
    """The first reason to stop the arm. The order decides which of several reasons the operator reads."""
    return (
        _operator_fault(observation.request)
        or _data_fault(limits, state, observation, wrenches, proposed)
        or _readiness_fault(limits, state, observation)
        or _force_fault(limits, observation.contact)
        or _motion_fault(limits, observation, bounds, proposed)
    )


def _operator_fault(request: Request) -> Fault | None:
    """Somebody wants the run to end, or nobody watches it any more."""
    if request == ABORT:
        return Trip.OPERATOR, 1.0, 0.0
    if request == ORPHANED:
        return Trip.SUPERVISOR, 1.0, 0.0
    return None


def _data_fault(
    limits: Limits, state: GuardState, observation: Observation, wrenches: list[list[float]], proposed: Command
) -> Fault | None:
    """The numbers cannot be trusted: not finite, disconnected or too old."""
    now_s = observation.timing.now_s
    if not _finite(observation, wrenches, proposed):
        return Trip.NOT_FINITE, 1.0, 0.0
    if not observation.robot.connected:
        return Trip.CONNECTION, 1.0, 0.0
    if (age_s := now_s - state.robot_heard_s) > limits.robot_stale_s:
        return Trip.ROBOT_STALE, age_s, limits.robot_stale_s
    if (age_s := now_s - state.sensor_heard_s) > limits.sensor_stale_s:
        return Trip.SENSOR_STALE, age_s, limits.sensor_stale_s
    return None


def _readiness_fault(limits: Limits, state: GuardState, observation: Observation) -> Fault | None:
    """Robot, sensor or loop is not fit to go on."""
    robot, missed = observation.robot, observation.timing.missed
    if robot.robot_mode != RUNNING:
        return Trip.ROBOT_MODE, robot.robot_mode, RUNNING
    if robot.safety_mode not in FIT_TO_MOVE:
        return Trip.SAFETY_MODE, robot.safety_mode, FIT_TO_MOVE[0]
    if limits.needs_program and robot.runtime_state != PROGRAM_PLAYING:
        return Trip.PROGRAM_STOPPED, robot.runtime_state, PROGRAM_PLAYING
    if (status := max(observation.frames.status.tolist(), default=0)) != 0:
        return Trip.SENSOR_STATUS, status, 0.0
    if state.equal_frames > FROZEN_FRAMES:
        return Trip.SENSOR_FROZEN, state.equal_frames, FROZEN_FRAMES
    if state.rejected > limits.max_rejected_per_s:
        return Trip.SENSOR_REJECTS, state.rejected, limits.max_rejected_per_s
    if missed > limits.max_missed_ticks:
        return Trip.LATE_TICKS, missed, limits.max_missed_ticks
    return None


def _force_fault(limits: Limits, contact: Contact) -> Fault | None:
    """A force that no retract may answer."""
    if (largest_N := _largest(contact.tared)) >= limits.overload_N:
        return Trip.OVERLOAD, largest_N, limits.overload_N
    if contact.absolute_N >= limits.absolute_N:
        return Trip.ABSOLUTE_FORCE, contact.absolute_N, limits.absolute_N
    if contact.lateral_N >= limits.lateral_N:
        return Trip.LATERAL_FORCE, contact.lateral_N, limits.lateral_N
    if contact.torque_Nm >= limits.torque_Nm:
        return Trip.TORQUE, contact.torque_Nm, limits.torque_Nm
    return None


def _motion_fault(limits: Limits, observation: Observation, bounds: Progress, proposed: Command) -> Fault | None:
    """The tip is, or would be, where or as fast as it must not be."""
    robot, lowest_z_m = observation.robot, bounds.floor_z_m - DEPTH_MARGIN_M
    if observation.tilt_rad > TILT_RAD:
        return Trip.TILTED, observation.tilt_rad, TILT_RAD
    if (speed_m_per_s := math.hypot(*proposed.velocity_m_per_s)) > limits.max_speed_m_per_s * (1 + 1e-9):
        return Trip.SPEED, speed_m_per_s, limits.max_speed_m_per_s
    if limits.min_z_m is not None and robot.z_m < limits.min_z_m:
        return Trip.BELOW_MIN_Z, robot.z_m, limits.min_z_m
    if robot.z_m < lowest_z_m:
        return Trip.TOO_DEEP, robot.z_m, lowest_z_m
    return _outside(robot, limits.workspace_m)


def _finite(observation: Observation, wrenches: list[list[float]], proposed: Command) -> bool:
    timing, robot, frames, contact, _, _ = observation
    numbers = (
        timing.now_s,
        robot.t_s,
        *robot.tcp_pose,
        *robot.tcp_speed,
        *robot.target_pose,
        contact.force_N,
        contact.absolute_N,
        contact.lateral_N,
        contact.torque_Nm,
        *proposed.velocity_m_per_s,
        *frames.t_s.tolist(),
        *chain.from_iterable(wrenches),
    )
    return math.isfinite(sum(numbers)) or all(map(math.isfinite, numbers))  # where a sum is finite, each number is; it costs a quarter


def _outside(robot: RobotState, workspace_m: tuple[tuple[float, float], ...] | None) -> Fault | None:
    for position_m, (low_m, high_m) in zip(robot.tcp_pose, workspace_m or (), strict=False):
        nearest_m = min(max(position_m, low_m), high_m)
        if position_m != nearest_m:
            return Trip.OUTSIDE_WORKSPACE, position_m, nearest_m
    return None


def _largest(wrench: Floats) -> float:
    return max(map(abs, chain.from_iterable(wrench[:, :3].tolist())), default=0.0)


_SENTENCES = {
    Trip.CONTACT_FORCE: "contact force {m:.2f} N reached the limit of {l:g} N; the probe was retracted",
    Trip.ABSOLUTE_FORCE: "raw force {m:.2f} N against the reference tare reached the absolute limit of {l:g} N; the arm was stopped",
    Trip.LATERAL_FORCE: "lateral force {m:.2f} N reached the limit of {l:g} N; the arm was stopped",
    Trip.TORQUE: "torque {m:.3f} Nm reached the limit of {l:g} Nm; the arm was stopped",
    Trip.SPEED: "a speed of {m:.4f} m/s was proposed, above the limit of {l:g} m/s",
    Trip.BELOW_MIN_Z: "the tip was at z = {m:.4f} m, below safety.min_z_m of {l:g} m",
    Trip.OUTSIDE_WORKSPACE: "the tip was at {m:.4f} m, outside the workspace that ends at {l:g} m",
    Trip.TOO_DEEP: "the tip was at z = {m:.5f} m, below the {l:.5f} m that this step may reach",
    Trip.TILTED: "the tool is tilted by {m:.3f} rad against the base's -z, expected at most {l:.3f}; align it",
    Trip.SENSOR_STALE: "the newest frame of the force sensor was {m:.3f} s old, expected at most {l:g} s; check cable and power",
    Trip.SENSOR_STATUS: "the force sensor reports status bits {m:.0f}, expected 0",
    Trip.SENSOR_FROZEN: "{m:.0f} frames of the force sensor were equal to the last digit; it is stuck",
    Trip.SENSOR_REJECTS: "{m:.0f} sensor frames were rejected lately, expected at most {l:.0f}; check cable and other readers of the port",
    Trip.ROBOT_STALE: "the robot's newest state was {m:.3f} s old, expected at most {l:g} s; check the network",
    Trip.ROBOT_MODE: "robot mode was {name}, expected RUNNING; power the arm on and release its brakes",
    Trip.SAFETY_MODE: "safety mode was {name}, expected NORMAL; clear it at the pendant",
    Trip.PROGRAM_STOPPED: "the control program is in state {m:.0f}, expected {l:.0f} (playing): stopped, or its watchdog starved",
    Trip.CONNECTION: "the connection to the robot was lost",
    Trip.NOT_FINITE: "a number that is not finite came from a device or a model",
    Trip.OVERLOAD: "force {m:.0f} N is beyond the sensor's capacity of {l:.0f} N",
    Trip.LATE_TICKS: "{m:.0f} ticks were missed in a row, expected at most {l:.0f}; is the machine overloaded, or FIFO priority missing?",
    Trip.OPERATOR: "the operator aborted the run",
    Trip.SUPERVISOR: "the supervising process is gone",
    Trip.DEVICE: "a device failed; the reason of the run says how",
}
_MODES: dict[Trip, dict[float, str]] = {
    Trip.ROBOT_MODE: {mode: mode.name for mode in RobotMode},
    Trip.SAFETY_MODE: {mode: mode.name for mode in SafetyMode},
}


def sentence(verdict: Verdict) -> str:
    """Say in one sentence why the guard interfered."""
    named = _MODES.get(verdict.trip, {})
    name = named.get(verdict.measured, f"{verdict.measured:.0f}")
    return _SENTENCES.get(verdict.trip, "the guard interfered").format(m=verdict.measured, l=verdict.limit, name=name)
