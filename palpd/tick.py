"""The vocabulary: what one tick of the loop sees, decides and does.

SI units. Times `t_s` are seconds on the host's monotonic clock. A wrench is (fx, fy, fz, tx, ty, tz) in N and Nm, what the
environment does to the probe. `z` is up; pressing gives fz > 0 in base axes and raw Fz < 0 in the sensor's own axes.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Words = NDArray[np.uint16]

MAX_FRAMES = 64
"""Most sensor frames that one row holds. A loop that is 64 ms late fills it at 1 kHz; the guard stops the arm long before."""


class RobotMode(IntEnum):
    """`robot_mode` of RTDE. The arm may move in RUNNING only."""

    NO_CONTROLLER = -1
    DISCONNECTED = 0
    CONFIRM_SAFETY = 1
    BOOTING = 2
    POWER_OFF = 3
    POWER_ON = 4
    IDLE = 5
    BACKDRIVE = 6
    RUNNING = 7
    UPDATING_FIRMWARE = 8


class SafetyMode(IntEnum):
    """`safety_mode` of RTDE; palpd moves in NORMAL and REDUCED only."""

    NORMAL = 1
    REDUCED = 2
    PROTECTIVE_STOP = 3
    RECOVERY = 4
    SAFEGUARD_STOP = 5
    SYSTEM_EMERGENCY_STOP = 6
    ROBOT_EMERGENCY_STOP = 7
    VIOLATION = 8
    FAULT = 9


PROGRAM_PLAYING = 2
"""`runtime_state` of a running control program. Without a running program a speed command has no effect."""


@dataclass(frozen=True, slots=True)
class RobotState:
    """One untorn snapshot of the controller.

    Poses are (x, y, z, rx, ry, rz) in m and rad (rotation vector) in the base frame, speeds in m/s and rad/s.
    `t_s` is the controller's sampling time on the host's clock, `timestamp_s` the same instant on the controller's own clock.
    """

    t_s: float
    timestamp_s: float
    tcp_pose: tuple[float, ...]
    tcp_speed: tuple[float, ...]
    target_pose: tuple[float, ...]
    target_speed: tuple[float, ...]
    tool_acceleration_m_per_s2: tuple[float, ...]
    robot_mode: int
    safety_mode: int
    safety_status_bits: int
    runtime_state: int
    connected: bool

    @property
    def z_m(self) -> float:
        """Height of the probe tip as the robot reports it."""
        return self.tcp_pose[2]

    @property
    def vz_m_per_s(self) -> float:
        """Vertical speed of the tip as the robot reports it."""
        return self.tcp_speed[2]


@dataclass(frozen=True, slots=True)
class SensorFrames:
    """Every sensor frame that arrived since the last read, oldest first; there may be none.

    `t_s` (n,) is sensor time on the host's clock, rebuilt from the 1 kHz counter. `wrench` (n, 6) is in the sensor's axes, calibrated
    and not tared. `status` (n,) is the sensor's own status word (0: healthy). `rejected` counts the frames that the parser rejected.
    """

    t_s: Floats
    counter: Words
    status: Words
    wrench: Floats
    rejected: int = 0

    def __len__(self) -> int:
        return len(self.t_s)

    def newest(self, most: int) -> "SensorFrames":
        """The newest frames.

        Args:
            most: Largest number of frames to keep.

        Returns:
            The same frames, without the oldest ones where there are more.
        """
        if len(self.t_s) <= most:
            return self
        return SensorFrames(self.t_s[-most:], self.counter[-most:], self.status[-most:], self.wrench[-most:], self.rejected)


NO_FRAMES = SensorFrames(np.empty(0), np.empty(0, np.uint16), np.empty(0, np.uint16), np.empty((0, 6)))


@dataclass(frozen=True, slots=True)
class Command:
    """A speed for the tip in base axes; palpd never commands orientation. `stop` ends the motion and overrides the speed."""

    velocity_m_per_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    stop: bool = False


STILL = Command()
STOP = Command(stop=True)


class Phase(IntEnum):
    """What the sequence is doing; every recorded tick holds it."""

    IDLE = 0
    TRAVEL = 1
    BASELINE = 2
    SEARCH = 3
    PRESS = 4
    HOLD = 5
    RETRACT = 6
    FREE_MOTION = 7
    PAUSED = 8
    DONE = 9
    TARE = 10
    RETURN = 11
    PAUSE_RETRACT = 12  # up to the safe height, to wait there
    LIFT = 13  # straight up at the beginning, where a contact would show


class Mode(IntEnum):
    """Which kind of palpation a tick belongs to."""

    NONE = 0
    SEARCH = 1
    STATIC = 2
    DYNAMIC = 3
    FREE_MOTION = 4
    STIFFNESS = 5


class Action(IntEnum):
    """What the guard does with a proposed command."""

    PASS = 0
    RETRACT = 1
    STOP = 2


class Trip(IntEnum):
    """Why the guard interfered. `safety.sentence` turns it, the measured value and the limit into text."""

    NONE = 0
    CONTACT_FORCE = 1
    ABSOLUTE_FORCE = 2
    LATERAL_FORCE = 3
    TORQUE = 4
    SPEED = 5
    BELOW_MIN_Z = 6
    OUTSIDE_WORKSPACE = 7
    TOO_DEEP = 8
    TILTED = 9
    SENSOR_STALE = 10
    SENSOR_STATUS = 11
    SENSOR_FROZEN = 12
    SENSOR_REJECTS = 13
    ROBOT_STALE = 14
    ROBOT_MODE = 15
    SAFETY_MODE = 16
    PROGRAM_STOPPED = 17
    CONNECTION = 18
    NOT_FINITE = 19
    OVERLOAD = 20
    LATE_TICKS = 21
    OPERATOR = 22
    SUPERVISOR = 23
    DEVICE = 24  # a device failed before the guard saw a reason


@dataclass(frozen=True, slots=True)
class Verdict:
    """The guard's answer: the command that may go out, and why it differs from the proposed one."""

    command: Command
    action: Action = Action.PASS
    trip: Trip = Trip.NONE
    measured: float = 0.0
    limit: float = 0.0


@dataclass(frozen=True, slots=True)
class Progress:
    """Where in the plan a tick stands, and the bounds of the present step. `surface_z_m` and `depth_m` are NaN until known.

    `floor_z_m` is the lowest height that the step may reach, `safe_z_m` the height at which a retract may end. Above `clear_z_m`
    the script guarantees that the tip touches nothing.
    """

    phase: Phase = Phase.IDLE
    mode: Mode = Mode.NONE
    site: int = -1
    repeat: int = -1
    depth_m: float = float("nan")
    surface_z_m: float = float("nan")
    cut_short: bool = False
    floor_z_m: float = float("-inf")
    safe_z_m: float = float("inf")
    clear_z_m: float = float("inf")


@dataclass(frozen=True, slots=True)
class Proposal:
    """What the sequence proposes to do next, and where in the plan that stands."""

    command: Command = STILL
    progress: Progress = Progress()


class Request(IntEnum):
    """What the operator asks of the loop; NONE in nearly every tick."""

    NONE = 0
    ABORT = 1
    PAUSE = 2
    RESUME = 3
    ORPHANED = 4  # no operator asked: the supervising process is gone


@dataclass(frozen=True, slots=True)
class Timing:
    """When a tick was planned to begin, when it began, and how many ticks were missed before it."""

    index: int
    planned_s: float
    now_s: float
    missed: int = 0


@dataclass(frozen=True, slots=True)
class Contact:
    """What the frames of one tick say about the contact, in base axes.

    `tared` (n, 6) is the measured wrench less the running tare (f_m - f_g), `inertial_N` (n,) the model's share of fz. The scalars
    describe the newest frames: `force_N` is the largest compensated contact force (f_c of Guo, Xiao, Ren 2019, eq. 5), `mean_N` its
    mean, `lateral_N` and `torque_Nm` are the largest. `absolute_N` is the largest raw force against the reference tare: no model and
    no re-tare changes it. `zero_N` is the running zero's share of `inertial_N`. A tick without frames repeats the last scalars; the
    guard limits their age.
    """

    tared: Floats
    inertial_N: Floats
    force_N: float = 0.0
    mean_N: float = 0.0
    lateral_N: float = 0.0
    torque_Nm: float = 0.0
    absolute_N: float = 0.0
    zero_N: float = 0.0


class Observation(NamedTuple):
    """All that one tick saw: the loop makes it once, and sequence, guard and record read the same one.

    `tilt_rad` is the angle between the tool's z axis and the base's -z.
    """

    timing: Timing
    robot: RobotState
    frames: SensorFrames
    contact: Contact
    request: Request = Request.NONE
    tilt_rad: float = 0.0

    @property
    def now_s(self) -> float:
        """Host time at which the tick began."""
        return self.timing.now_s


class TickRecord(NamedTuple):
    """All that is kept of one tick: what it saw, what the sequence proposed, what the guard let out.

    `work_us` is the work of the tick before: a tick cannot time its own last line.
    """

    observation: Observation
    proposal: Proposal
    verdict: Verdict
    work_us: float


class Clock(Protocol):
    """Tells the loop when its next tick has come."""

    def wait(self) -> Timing:
        """Block until the next tick and say which it is."""

    def elapsed_us(self) -> float:
        """Microseconds since the tick began."""


class Robot(Protocol):
    """What the loop needs of a robot. `read` and `move` may raise; `stop` and `end` never raise."""

    def read(self) -> RobotState:
        """Return the newest state without waiting."""

    def move(self, velocity_m_per_s: tuple[float, float, float]) -> None:
        """Command a tip speed in base axes; this also feeds the controller's watchdog."""

    def stop(self) -> None:
        """Bring the tip to rest. Never raises."""

    def end(self) -> None:
        """Bring the tip to rest and end what runs on the controller. Never raises. The connections end with the process."""


class UncommandedRobot:
    """The commands of a robot that is only read: it does nothing of what it is asked."""

    def move(self, velocity_m_per_s: tuple[float, float, float]) -> None:
        """Do nothing."""

    def stop(self) -> None:
        """Do nothing."""

    def end(self) -> None:
        """Do nothing."""


class StateReader(Protocol):
    """A source of robot states that commands nothing: the dry run, and `palpd doctor`."""

    def read(self) -> RobotState:
        """Return the newest state without waiting."""

    def close(self) -> None:
        """Release the connection. Never raises."""


class ForceSensor(Protocol):
    """What the loop needs of a force sensor."""

    def read(self) -> SensorFrames:
        """Return every frame since the last call without waiting."""

    def close(self) -> None:
        """Release the port. Never raises."""


class SensorDriver(ForceSensor, Protocol):
    """An opened force sensor, with what a recording and `palpd doctor` say of it (docs/sensors.md)."""

    @property
    def serial_number(self) -> str:
        """Serial number, empty where the device tells none."""

    @property
    def counts_per_N(self) -> Floats:
        """Counts per N (3,) that convert the readings."""

    @property
    def counts_per_Nm(self) -> Floats:
        """Counts per Nm (3,) that convert the readings."""

    @property
    def calibration_source(self) -> str:
        """Where these counts come from, such as "registers"."""

    @property
    def pulled_over_pressed(self) -> float | None:
        """Ratio of the two slopes of Fz; None where the sensor has one."""

    @property
    def delay_s(self) -> float:
        """How much later than a force the readings show it."""

    @property
    def counter_step(self) -> int:
        """By how much `SensorFrames.counter` grows from one frame to the next."""


Option = str | int | float | bool
"""A value under `options` of a device, for what only its own driver knows."""


class SensorSettings(Protocol):
    """The block `sensor` of config.yaml, as a driver sees it."""

    @property
    def port(self) -> str:
        """Path or address of the device."""

    @property
    def rate_Hz(self) -> float:
        """Frames a second."""

    @property
    def filter_cutoff_Hz(self) -> float | None:
        """Cutoff of the device's low-pass, None for none."""

    @property
    def counts_per_N(self) -> tuple[float, float, float] | None:
        """Of the calibration sheet; None: the device tells."""

    @property
    def counts_per_Nm(self) -> tuple[float, float, float] | None:
        """Of the calibration sheet; None: the device tells."""

    @property
    def fz_slopes(self) -> Literal["pressed", "pulled", "both"]:
        """Which slope of Fz counts, of a sensor with two."""

    @property
    def fz_pulled_counts_per_N(self) -> float | None:
        """The second slope of the calibration sheet."""

    @property
    def options(self) -> Mapping[str, Option]:
        """What only this driver knows."""


SensorKind = Callable[[SensorSettings], SensorDriver]
"""An entry point of `palpd.sensors`: opens the sensor, or raises SensorError in one sentence."""


class RobotSettings(Protocol):
    """The block `robot` of config.yaml, as a driver sees it."""

    @property
    def host(self) -> str:
        """Address of the controller."""

    @property
    def model(self) -> Literal["ur5", "ur5e"]:
        """Model of a UR."""

    @property
    def rate_Hz(self) -> float:
        """Rate of the loop and of the states."""

    @property
    def watchdog_Hz(self) -> float:
        """The controller stops the arm where commands come more rarely than this."""

    @property
    def acceleration_m_per_s2(self) -> float:
        """Acceleration of the tip."""

    @property
    def tcp(self) -> tuple[float, ...] | None:
        """Pose (6,) of the tip on the flange, m and rad; None: as set on the robot."""

    @property
    def options(self) -> Mapping[str, Option]:
        """What only this driver knows."""


class RobotKind(NamedTuple):
    """An entry point of `palpd.robots`. Both functions raise RobotError in one sentence; `open_reader` must not be able to move the arm."""

    open: Callable[[RobotSettings], Robot]
    open_reader: Callable[[RobotSettings], StateReader]
    require: Callable[[], None] = lambda: None
    """Refuses a computer on which the driver cannot work."""
    takes_programs: Callable[[RobotSettings], bool | None] = lambda _: None
    """Asks whether the controller takes programs from this computer; None where it has no such mode, or does not say."""


ROW = np.dtype(
    [
        ("index", "<u8"),
        ("planned_s", "<f8"),
        ("now_s", "<f8"),
        ("missed", "<u4"),
        ("work_us", "<f4"),  # as TickRecord.work_us
        ("robot_t_s", "<f8"),
        ("robot_timestamp_s", "<f8"),
        ("tcp_pose", "<f8", (6,)),
        ("tcp_speed", "<f8", (6,)),
        ("target_pose", "<f8", (6,)),
        ("target_speed", "<f8", (6,)),
        ("tool_acceleration_m_per_s2", "<f8", (3,)),
        ("robot_mode", "<i4"),
        ("safety_mode", "<i4"),
        ("safety_status_bits", "<u4"),
        ("runtime_state", "<u4"),
        ("connected", "u1"),
        ("request", "u1"),
        ("rejected", "<u4"),
        ("frames", "<u2"),  # how many of the slots below are filled
        ("frame_t_s", "<f8", (MAX_FRAMES,)),
        ("counter", "<u2", (MAX_FRAMES,)),
        ("status", "<u2", (MAX_FRAMES,)),
        ("wrench", "<f8", (MAX_FRAMES, 6)),  # as SensorFrames.wrench
        ("tared", "<f8", (MAX_FRAMES, 6)),  # as Contact.tared
        ("inertial_N", "<f8", (MAX_FRAMES,)),
        ("zero_N", "<f8"),
        ("force_N", "<f8"),
        ("absolute_N", "<f8"),
        ("phase", "u1"),
        ("mode", "u1"),
        ("site", "<i2"),
        ("repeat", "<i2"),
        ("depth_m", "<f8"),
        ("surface_z_m", "<f8"),
        ("cut_short", "u1"),
        ("proposed_m_per_s", "<f8", (3,)),
        ("proposed_stop", "u1"),
        ("command_m_per_s", "<f8", (3,)),
        ("command_stop", "u1"),
        ("action", "u1"),
        ("trip", "u1"),
        ("trip_measured", "<f8"),
        ("trip_limit", "<f8"),
    ]
)
"""One tick in the ring and in a recording: every input of a decision, and the decision."""
