"""The guard, last before the wire: pure, default deny, told the time.

Two force limits against two zeros. The compensated contact force against the running tare sends the probe up and ends the
run; the raw force against the reference tare of the last calibration stops the arm where it is, latched. No model output and
no re-tare loosens the second. With a dead sensor it stops and does not retract: that would be moving blind.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from palpd.tick import (
    PROGRAM_PLAYING,
    STOP,
    Action,
    Command,
    Contact,
    Floats,
    Request,
    RobotMode,
    RobotState,
    SafetyMode,
    SensorFrames,
    Timing,
    Trip,
    Verdict,
)

RETRACT_M_PER_S = 0.02
"""Speed at which the guard leaves the tissue: fast enough to matter, slow enough to stop within 1 mm."""
DEPTH_MARGIN_M = 0.0005
"""How far below the commanded depth the tip may be seen before that is a fault."""
TILT_RAD = math.radians(2.0)
FROZEN_FRAMES = 200
"""A living sensor dithers: so many frames equal to the last digit on all six axes are a stuck one. Quiet Fz alone may rest on one count
for long; six axes at rest move by a count or two within 0.12 s even behind the 15 Hz filter. At 1 kHz and 10 mm/s it is 2 mm blind."""

ABORT, ORPHANED, RUNNING = Request.ABORT, Request.ORPHANED, RobotMode.RUNNING
FIT_TO_MOVE = (SafetyMode.NORMAL, SafetyMode.REDUCED)
"""Taken out of their enums once: before Python 3.12 every look at a member costs as much as ten comparisons, and a tick has many."""


@dataclass(frozen=True, slots=True)
class Limits:
    """What the guard enforces; N, Nm, m, m/s, s, rad. `workspace_m` is ((x, x), (y, y), (z, z)) or None.

    Without `needs_program` the robot may be read while no program of ours plays: a dry run, which commands nothing.
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


class Sight(NamedTuple):
    """All the guard looks at in one tick. `floor_z_m` is the lowest height the present step may reach, `safe_z_m` where a retract ends."""

    timing: Timing
    robot: RobotState
    frames: SensorFrames
    contact: Contact
    request: Request = Request.NONE
    floor_z_m: float = -math.inf
    safe_z_m: float = math.inf
    tilt_rad: float = 0.0


class Guard(NamedTuple):
    """What the guard remembers from tick to tick; `trip` other than NONE is latched until a new run begins."""

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


def guard(limits: Limits, memory: Guard, sight: Sight, proposed: Command) -> tuple[Guard, Verdict]:
    """Decide what may go out. Returns what to remember and the verdict; `memory.over` means the run has ended."""
    memory = _listen(memory, sight)
    fault = _fault(limits, memory, sight, proposed)
    if memory.over:
        return memory, Verdict(STOP, Action.STOP, memory.trip, memory.measured, memory.limit)
    if fault is not None:
        return _stopped(memory, *fault)
    if not memory.retracting and sight.contact.force_N >= limits.contact_N:
        memory = memory._replace(trip=Trip.CONTACT_FORCE, measured=sight.contact.force_N, limit=limits.contact_N, retracting=True)
    if not memory.retracting:
        return memory, Verdict(proposed)
    if sight.robot.z_m >= sight.safe_z_m:
        return _stopped(memory, memory.trip, memory.measured, memory.limit)
    up = Command((0.0, 0.0, min(RETRACT_M_PER_S, limits.max_speed_m_per_s)))
    return memory, Verdict(up, Action.RETRACT, memory.trip, memory.measured, memory.limit)


def _stopped(memory: Guard, trip: Trip, measured: float, limit: float) -> tuple[Guard, Verdict]:
    memory = memory._replace(trip=trip, measured=measured, limit=limit, over=True)
    return memory, Verdict(STOP, Action.STOP, trip, measured, limit)


def _listen(memory: Guard, sight: Sight) -> Guard:
    """Note when each device was last heard and whether it says anything new."""
    now_s = sight.timing.now_s
    frames = sight.frames
    wrench, equal = memory.last_wrench, memory.equal_frames
    if len(frames):
        first_row, *others = frames.wrench.tolist()
        newest = others[-1] if others else first_row
        same = all(row == first_row for row in others) and (not wrench or first_row == wrench)
        wrench, equal = newest, (equal + len(frames) if same else 0)
    fresh = sight.robot.timestamp_s != memory.robot_timestamp_s
    first = math.isnan(memory.sensor_heard_s)
    forgotten = math.exp(min(memory.looked_s - now_s, 0.0))  # over a second, whatever the rate of the loop
    return memory._replace(
        sensor_heard_s=float(frames.t_s[-1]) if len(frames) else (now_s if first else memory.sensor_heard_s),
        robot_heard_s=sight.robot.t_s if fresh else memory.robot_heard_s,
        robot_timestamp_s=sight.robot.timestamp_s,
        last_wrench=wrench,
        equal_frames=equal,
        rejected=memory.rejected * forgotten + frames.rejected,
        looked_s=now_s,
    )


def _fault(limits: Limits, memory: Guard, sight: Sight, proposed: Command) -> tuple[Trip, float, float] | None:
    """First reason to stop the arm where it is: (trip, measured, limit), or None."""
    timing, robot, frames, contact, request, floor_z_m, _, tilt_rad = sight
    if request == ABORT:
        return Trip.OPERATOR, 1.0, 0.0
    if request == ORPHANED:
        return Trip.SUPERVISOR, 1.0, 0.0
    if not _finite(robot, frames, contact, proposed, timing.now_s):
        return Trip.NOT_FINITE, 1.0, 0.0
    if not robot.connected:
        return Trip.CONNECTION, 1.0, 0.0
    if (age_s := timing.now_s - memory.robot_heard_s) > limits.robot_stale_s:
        return Trip.ROBOT_STALE, age_s, limits.robot_stale_s
    if (age_s := timing.now_s - memory.sensor_heard_s) > limits.sensor_stale_s:
        return Trip.SENSOR_STALE, age_s, limits.sensor_stale_s
    if robot.robot_mode != RUNNING:
        return Trip.ROBOT_MODE, robot.robot_mode, RUNNING
    if robot.safety_mode not in FIT_TO_MOVE:
        return Trip.SAFETY_MODE, robot.safety_mode, FIT_TO_MOVE[0]
    if limits.needs_program and robot.runtime_state != PROGRAM_PLAYING:
        return Trip.PROGRAM_STOPPED, robot.runtime_state, PROGRAM_PLAYING
    if (status := max(frames.status.tolist(), default=0)) != 0:
        return Trip.SENSOR_STATUS, status, 0.0
    if memory.equal_frames > FROZEN_FRAMES:
        return Trip.SENSOR_FROZEN, memory.equal_frames, FROZEN_FRAMES
    if memory.rejected > limits.max_rejected_per_s:
        return Trip.SENSOR_REJECTS, memory.rejected, limits.max_rejected_per_s
    if timing.missed > limits.max_missed_ticks:
        return Trip.LATE_TICKS, timing.missed, limits.max_missed_ticks
    if (largest_N := _largest(contact.tared)) >= limits.overload_N:
        return Trip.OVERLOAD, largest_N, limits.overload_N
    if contact.absolute_N >= limits.absolute_N:
        return Trip.ABSOLUTE_FORCE, contact.absolute_N, limits.absolute_N
    if contact.lateral_N >= limits.lateral_N:
        return Trip.LATERAL_FORCE, contact.lateral_N, limits.lateral_N
    if contact.torque_Nm >= limits.torque_Nm:
        return Trip.TORQUE, contact.torque_Nm, limits.torque_Nm
    if tilt_rad > TILT_RAD:
        return Trip.TILTED, tilt_rad, TILT_RAD
    if (speed_m_per_s := math.hypot(*proposed.velocity_m_per_s)) > limits.max_speed_m_per_s * (1 + 1e-9):
        return Trip.SPEED, speed_m_per_s, limits.max_speed_m_per_s
    if limits.min_z_m is not None and robot.z_m < limits.min_z_m:
        return Trip.BELOW_MIN_Z, robot.z_m, limits.min_z_m
    if robot.z_m < floor_z_m - DEPTH_MARGIN_M:
        return Trip.TOO_DEEP, robot.z_m, floor_z_m - DEPTH_MARGIN_M
    return _outside(robot, limits.workspace_m)


def _finite(robot: RobotState, frames: SensorFrames, contact: Contact, proposed: Command, now_s: float) -> bool:
    numbers = (
        now_s,
        robot.t_s,
        *robot.tcp_pose,
        *robot.tcp_speed,
        *robot.target_pose,
        contact.force_N,
        contact.absolute_N,
        contact.lateral_N,
        contact.torque_Nm,
        *proposed.velocity_m_per_s,
    )
    return all(map(math.isfinite, numbers)) and math.isfinite(frames.wrench.sum()) and math.isfinite(frames.t_s.sum())


def _outside(robot: RobotState, workspace_m: tuple[tuple[float, float], ...] | None) -> tuple[Trip, float, float] | None:
    for position_m, (low_m, high_m) in zip(robot.tcp_pose, workspace_m or (), strict=False):
        nearest_m = min(max(position_m, low_m), high_m)
        if position_m != nearest_m:
            return Trip.OUTSIDE_WORKSPACE, position_m, nearest_m
    return None


def _largest(wrench: Floats) -> float:
    return max((abs(force_N) for row in wrench.tolist() for force_N in row[:3]), default=0.0)


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
    Trip.ROBOT_MODE: "robot mode is {m:.0f}, expected {l:.0f} (running); power the arm on and release its brakes",
    Trip.SAFETY_MODE: "safety mode is {m:.0f}, expected {l:.0f} (normal); clear it on the pendant",
    Trip.PROGRAM_STOPPED: "the control program is in state {m:.0f}, expected {l:.0f} (playing): stopped, or its watchdog starved",
    Trip.CONNECTION: "the connection to the robot was lost",
    Trip.NOT_FINITE: "a number that is not finite came from a device or a model",
    Trip.OVERLOAD: "force {m:.0f} N is beyond the sensor's capacity of {l:.0f} N",
    Trip.LATE_TICKS: "{m:.0f} ticks were missed in a row, expected at most {l:.0f}; is the machine overloaded, or FIFO priority missing?",
    Trip.OPERATOR: "the operator aborted the run",
    Trip.SUPERVISOR: "the supervising process is gone",
    Trip.DEVICE: "a device failed; the reason of the run says how",
}


def sentence(verdict: Verdict) -> str:
    """Why the guard interfered, for a person."""
    return _SENTENCES.get(verdict.trip, "the guard interfered").format(m=verdict.measured, l=verdict.limit)
