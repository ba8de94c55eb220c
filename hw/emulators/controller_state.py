"""The state of an emulated UR controller, what stops it, and how its target moves. Control script, dashboard and cycle share it."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from hw.emulators.arm import ArmKinematics
from hw.emulators.pose import Floats, composed, inverse, rotation, rotation_vector
from hw.emulators.target_motion import Ramp, TargetMotion

PROGRAM_STOP_M_PER_S2 = 5.0
"""Deceleration of the tip when a program ends during a motion. No figure is published; from 10 mm/s it takes 2 ms, so one cycle."""
EMERGENCY_STOP_M_PER_S2 = 10.0


class Runtime(IntEnum):
    """`runtime_state` of RTDE."""

    STOPPING = 0
    STOPPED = 1
    PLAYING = 2
    PAUSING = 3
    PAUSED = 4
    RESUMING = 5


class Power(IntEnum):
    """`robot_mode` of RTDE, as far as an emulated arm gets. The dashboard says the name."""

    POWER_OFF = 3
    POWER_ON = 4
    IDLE = 5
    RUNNING = 7


class Safety(IntEnum):
    """`safety_mode` of RTDE. The dashboard says the name."""

    NORMAL = 1
    REDUCED = 2
    PROTECTIVE_STOP = 3
    RECOVERY = 4
    SAFEGUARD_STOP = 5
    SYSTEM_EMERGENCY_STOP = 6
    ROBOT_EMERGENCY_STOP = 7
    VIOLATION = 8
    FAULT = 9


FIT = (Safety.NORMAL, Safety.REDUCED)
"""Safety modes in which programs start."""
EMERGENCY = (Safety.SYSTEM_EMERGENCY_STOP, Safety.ROBOT_EMERGENCY_STOP)
UNPOWERED = (*EMERGENCY, Safety.VIOLATION, Safety.FAULT)
"""Safety modes in which the arm has no power, and gets none."""


@dataclass(frozen=True)
class ControllerModel:
    """A generation of controllers: its cycle and how it identifies itself."""

    name: str
    cycle_s: float
    version: tuple[int, int, int, int]
    polyscope: str
    serial_number: str

    @property
    def e_series(self) -> bool:
        """Whether commands and fields of PolyScope 5 exist."""
        return self.version[0] >= 5


MODELS = {
    "ur5": ControllerModel("ur5", 0.008, (3, 15, 8, 106339), "URSoftware 3.15.8.106339 (Nov 10 2022)", "2018350001"),
    "ur5e": ControllerModel("ur5e", 0.002, (5, 17, 0, 0), "URSoftware 5.17.0.0 (Jan 10 2025)", "20235500001"),
}


@dataclass
class Program:
    """The state of the control script, as far as it has effects."""

    offset: int
    commands: bool  # whether it is a loop over command registers, or a script that runs once
    started: bool = False
    start_s: float = 0.0
    end_s: float = 0.0  # of a script that runs once
    held: bool = False  # the register still holds the command that was executed last
    blocking: bool = False  # a synchronous motion is under way, and the script reads no command
    streaming: bool = False  # the thread of speedL or servoL lives
    moving: bool = False  # the thread of an asynchronous motion lives
    watchdog_s: float | None = None
    watchdog_set_s: float | None = None
    moved: bool = False  # since it started
    stops_linearly: bool = False  # the script's `stop_type`: the first asynchronous stop sets it for good


@dataclass
class ControllerCycle:
    """The next cycle of the target: its pose (6,) at the begin, its displacement (6,), its speed (6,) at both ends."""

    start: Floats
    shift: Floats
    speed_before: Floats
    speed_after: Floats
    settled: float = 1.0  # as Step.settled


class ControllerState:
    """What the controller's parts share: registers, modes, the program, the target and its motion, and a log of what happened."""

    def __init__(self, model: ControllerModel, tip_pose: Floats, tcp: Floats) -> None:
        self.model = model
        self.arm = ArmKinematics(tip_pose)
        self.inputs: dict[str, tuple[float, ...]] = {}
        self.outputs: dict[str, tuple[float, ...]] = {}
        self.power = Power.RUNNING
        self.safety = Safety.NORMAL
        self.runtime = Runtime.STOPPED
        self.remote_control = True
        self.speed = np.zeros(6)
        self.pose = tip_pose.copy()  # of the true tip
        self.motion: TargetMotion | None = None
        self.still_s = 0.0
        self.program: Program | None = None
        self.tcp_true, self.tcp = tcp.copy(), tcp.copy()
        self.payload_kg, self.payload_cog = 0.0, (0.0, 0.0, 0.0)
        self.fed_s = 0.0  # when the watchdog was fed
        self.stopped_s = 0.0  # of the latest protective stop
        self.messages: list[tuple[str, int]] = []
        self.stops: list[tuple[float, str]] = []
        self.armings: list[float] = []
        """When the control program set its watchdog."""

    def stop_program(self, now_s: float, reason: str) -> bool:
        """End the program, its watchdog and its motion.

        Args:
            now_s: host time.
            reason: why, for the log.

        Returns:
            False where no program was loaded.
        """
        loaded = self.program is not None
        if self.program is not None and self.program.started:
            self.stops.append((now_s, reason))
        self.program = None
        if self.runtime is not Runtime.STOPPED:
            self.runtime = Runtime.STOPPING
        self.halt(PROGRAM_STOP_M_PER_S2)
        return loaded

    def pausing_stop(self, now_s: float, mode: Safety, reason: str) -> None:
        """Stop the motion and pause the program: a protective stop until `unlock`, a safeguard stop until the safeguard is closed.

        Args:
            now_s: host time.
            mode: `PROTECTIVE_STOP` or `SAFEGUARD_STOP`.
            reason: why, for the log.
        """
        if self.safety in FIT:
            self.safety, self.stopped_s = mode, now_s
            self.stops.append((now_s, reason))
            self.messages.append((reason.capitalize(), 0))
            if self.runtime is Runtime.PLAYING:
                self.runtime = Runtime.PAUSED
            self.halt(EMERGENCY_STOP_M_PER_S2)

    def cutting_stop(self, now_s: float, mode: Safety, reason: str) -> None:
        """Stop the motion, end the program, cut the power.

        Args:
            now_s: host time.
            mode: the safety mode, one of `UNPOWERED`.
            reason: why, for the log.
        """
        self.stop_program(now_s, reason)
        self.halt(EMERGENCY_STOP_M_PER_S2)
        self.safety, self.power = mode, Power.POWER_OFF

    def halt(self, deceleration: float) -> None:
        """Bring the target to rest.

        Args:
            deceleration: of the tip, in m/s².
        """
        self.motion = Ramp(np.zeros(6), deceleration) if self.speed.any() else None

    def advance(self) -> ControllerCycle:
        """Let the target move for one cycle."""
        before, start = self.speed, self.pose
        if self.motion is None:
            self.still_s += self.model.cycle_s
            return ControllerCycle(start, np.zeros(6), before, before)
        self.still_s = 0.0
        after, shift, over, settled = self.motion.advance(before, start, self.model.cycle_s)
        self.speed = after
        pose = start.copy()
        pose[:3] += shift[:3]
        if shift[3:].any():
            pose[3:] = rotation_vector(rotation(shift[3:]) @ rotation(start[3:]))
        self.pose = pose
        if over:
            self.motion = None
        return ControllerCycle(start, shift, before, after, settled)

    def tip(self, tcp_pose: Floats) -> Floats:
        """Convert a pose of the active TCP to one of the true tip.

        Args:
            tcp_pose: pose (6,) of the active TCP, in m and rad.

        Returns:
            Pose (6,) of the true tip.
        """
        return _of_other_point(tcp_pose, self.tcp, self.tcp_true)

    def tcp_pose(self, tip_pose: Floats) -> Floats:
        """Convert a pose of the true tip to one of the active TCP.

        Args:
            tip_pose: pose (6,) of the true tip, in m and rad.

        Returns:
            Pose (6,) of the active TCP.
        """
        return _of_other_point(tip_pose, self.tcp_true, self.tcp)


def _of_other_point(pose: Floats, point: Floats, other: Floats) -> Floats:
    """From the pose (6,) of one point of the tool that of another; both points (6,) count from the flange."""
    return pose if np.array_equal(point, other) else composed(composed(pose, inverse(point)), other)
