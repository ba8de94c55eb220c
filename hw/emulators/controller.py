"""What a UR controller does with its registers, cycle by cycle: the control program, its watchdog, the motion, the stops.

No socket and no clock: bytes are `ur.py`'s, and time is told. The program's side of the registers is that of the script which
ur_rtde 1.6.5 uploads, written from observed traffic; nothing here was compared with a real robot.
"""

import re
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from hw.emulators.pose import Floats, composed, inverse, rotation, rotation_vector

PROGRAM_STOP_M_PER_S2 = 5.0
"""Deceleration of the tip when a program ends under way. No published figure was found: from 10 mm/s it takes 2 ms, so one cycle."""
EMERGENCY_STOP_M_PER_S2 = 10.0
COMMANDS_KEPT = 15_000
PROGRAM_START_S = 0.1
"""From the last byte of an uploaded script to its first cycle."""
UNLOCK_AFTER_S = 5.0
"""A protective stop cannot be unlocked before."""


class Runtime(IntEnum):
    """`runtime_state` of RTDE."""

    STOPPING = 0
    STOPPED = 1
    PLAYING = 2
    PAUSING = 3
    PAUSED = 4
    RESUMING = 5


class Power(IntEnum):
    """`robot_mode` of RTDE, as far as an emulated arm gets."""

    POWER_OFF = 3
    POWER_ON = 4
    IDLE = 5
    RUNNING = 7


class Safety(IntEnum):
    """`safety_mode` of RTDE, as far as an emulated arm gets."""

    NORMAL = 1
    PROTECTIVE_STOP = 3
    ROBOT_EMERGENCY_STOP = 7


@dataclass(frozen=True)
class Model:
    """A generation of controllers: its cycle and what it calls itself."""

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
    "ur5": Model("ur5", 0.008, (3, 15, 8, 106339), "URSoftware 3.15.8.106339 (Nov 10 2022)", "2018350001"),
    "ur5e": Model("ur5e", 0.002, (5, 17, 0, 0), "URSoftware 5.17.0.0 (Jan 10 2025)", "20235500001"),
}

BASE_JOINTS_RAD = np.array([0.0, -1.75, -1.95, -1.01, 1.5708, 0.0])
"""A UR5 with its elbow up and its tool straight down."""
JOINT_ROWS = (  # Denavit-Hartenberg d, a, alpha of the UR5 (UR's article "DH parameters")
    (0.089159, 0.0, np.pi / 2),
    (0.0, -0.425, 0.0),
    (0.0, -0.39225, 0.0),
    (0.10915, 0.0, np.pi / 2),
    (0.09465, 0.0, -np.pi / 2),
    (0.0823, 0.0, 0.0),
)


def jacobian(joints_rad: Floats) -> Floats:
    """Geometric Jacobian (6, 6) of the UR5's flange: m/s and rad/s in base axes per rad/s."""
    frame, frames = np.eye(4), [np.eye(4)]
    for q, (d, a, alpha) in zip(joints_rad, JOINT_ROWS, strict=True):
        cq, sq, ca, sa = np.cos(q), np.sin(q), np.cos(alpha), np.sin(alpha)
        step = np.array([[cq, -sq * ca, sq * sa, a * cq], [sq, cq * ca, -cq * sa, a * sq], [0.0, sa, ca, d], [0.0, 0.0, 0.0, 1.0]])
        frame = frame @ step
        frames.append(frame)
    tip = frames[-1][:3, 3]
    columns = [np.concatenate([np.cross(f[:3, 2], tip - f[:3, 3]), f[:3, 2]]) for f in frames[:-1]]
    return np.array(columns).T


class Arm:
    """Joint angles beside tip poses: the UR5's map, linear about one posture.

    A cell may put its tissue anywhere in the base frame, also where no UR5 reaches, so the posture is fixed and only the
    displacements are the arm's.
    """

    def __init__(self, tip_pose: Floats) -> None:
        self._origin = tip_pose.copy()
        self._jacobian = jacobian(BASE_JOINTS_RAD)
        self._inverse = np.linalg.inv(self._jacobian)

    def joints(self, tip_pose: Floats) -> Floats:
        """Joint angles (6,) in rad of a tip pose."""
        joints: Floats = BASE_JOINTS_RAD + self._inverse @ displacement(self._origin, tip_pose)
        return joints

    def pose(self, joints_rad: Floats) -> Floats:
        """Tip pose (6,) of joint angles."""
        moved = self._jacobian @ (joints_rad - BASE_JOINTS_RAD)
        turn = rotation(moved[3:]) @ rotation(self._origin[3:])
        return np.concatenate([self._origin[:3] + moved[:3], rotation_vector(turn)])

    def joint_speed(self, tip_speed: Floats) -> Floats:
        """Joint speeds (6,) in rad/s of a tip speed."""
        speed: Floats = self._inverse @ tip_speed
        return speed

    def tip_speed(self, joint_speed_rad_per_s: Floats) -> Floats:
        """Tip speed (6,) in m/s and rad/s of joint speeds."""
        speed: Floats = self._jacobian @ joint_speed_rad_per_s
        return speed


class Step(NamedTuple):
    """What a motion makes of a cycle: speed (6,) at its end, displacement (6,), whether it is over, and after which share of the
    cycle the speed is reached, linearly in time."""

    speed: Floats
    shift: Floats
    over: bool
    settled: float = 1.0


@dataclass
class Ramp:
    """A speed that is approached with a limited acceleration and then kept (URScript's speedl; with a goal of zero, stopl)."""

    goal: Floats
    acceleration: float

    def advance(self, speed: Floats, place: Floats, cycle_s: float) -> Step:
        """One cycle further; over when it is a stop and the tip is at rest."""
        after, shift, settled = speed.copy(), speed * cycle_s, 0.0
        for part in (slice(0, 3), slice(3, 6)):
            change = self.goal[part] - speed[part]
            needed = float(np.linalg.norm(change)) / (self.acceleration * cycle_s)
            if needed > 1.0:
                change /= needed
            after[part] += change
            shift[part] += change * cycle_s * (1.0 - 0.5 * min(needed, 1.0))
            settled = max(settled, min(needed, 1.0))
        return Step(after, shift, not self.goal.any() and not after.any(), settled)


@dataclass
class Line:
    """A straight way to a pose with a trapezoid of speed along it (movel; movej with the leading joint's profile).

    `length` is what speed and acceleration refer to: the longer of way (m) and turn (rad) unless given. A tip that is still moving
    comes to rest first.
    """

    goal: Floats
    speed: float
    acceleration: float
    length: float | None = None
    _way: Floats | None = None
    _elapsed_s: float = 0.0
    _share: float = 0.0

    def _profile(self, length: float, t_s: float) -> tuple[float, float]:
        """Distance gone and speed after t_s."""
        top = min(self.speed, float(np.sqrt(length * self.acceleration)))
        rise_s = top / self.acceleration
        left_s = length / top + rise_s - t_s
        if left_s <= 0.0:
            return length, 0.0
        if t_s < rise_s:
            return 0.5 * self.acceleration * t_s * t_s, self.acceleration * t_s
        if left_s < rise_s:
            return length - 0.5 * self.acceleration * left_s * left_s, self.acceleration * left_s
        return top * (t_s - 0.5 * rise_s), top

    def advance(self, speed: Floats, place: Floats, cycle_s: float) -> Step:
        """One cycle further; over when the goal is reached."""
        if self._way is None:
            if speed.any():
                return Ramp(np.zeros(6), self.acceleration).advance(speed, place, cycle_s)._replace(over=False)
            self._way = displacement(place, self.goal)
        length = self.length or max(float(np.linalg.norm(self._way[:3])), float(np.linalg.norm(self._way[3:])))
        if length < 1e-9:
            return Step(np.zeros(6), self._way, True)
        self._elapsed_s += cycle_s
        gone, now = self._profile(length, self._elapsed_s)
        step = gone / length - self._share
        self._share += step
        return Step(self._way * (now / length), self._way * step, gone >= length)


@dataclass
class Servo:
    """A pose that is followed with a delay (servol, servoj); speed is capped as a controller would."""

    goal: Floats
    lookahead_s: float

    def advance(self, speed: Floats, place: Floats, cycle_s: float) -> Step:
        """Speed and displacement (6,) at the end of a cycle; it never ends by itself."""
        after = displacement(place, self.goal) / max(self.lookahead_s, 2.0 * cycle_s)
        fastest = float(np.linalg.norm(after[:3]))
        if fastest > 1.0:
            after *= 1.0 / fastest
        return Step(after, 0.5 * (speed + after) * cycle_s, False)


Motion = Ramp | Line | Servo


def displacement(start: Floats, end: Floats) -> Floats:
    """What leads from one pose to another (6,): m, and a rotation vector in base axes."""
    if np.array_equal(start[3:], end[3:]):
        return np.concatenate([end[:3] - start[:3], np.zeros(3)])
    return np.concatenate([end[:3] - start[:3], rotation_vector(rotation(end[3:]) @ rotation(start[3:]).T)])


@dataclass
class Program:
    """The control script as far as its effects go: where its registers are, what it is busy with."""

    offset: int
    commands: bool  # whether it is a loop over command registers, or a script that runs once
    started: bool = False
    start_s: float = 0.0
    held: bool = False  # the register still holds the command that was executed last
    blocking: bool = False  # a synchronous motion is under way, and nothing else is looked at
    streaming: bool = False  # the thread of speedL or servoL lives
    moving: bool = False  # the thread of an asynchronous motion lives
    watchdog_s: float | None = None
    moved: bool = False  # since it started
    stops_linearly: bool = False  # the script's `stop_type`: set by the first asynchronous stop, and never taken back


UNEMULATED = {
    6: "forceMode",
    12: "servoC",
    18: "teachMode",
    41: "jogStart",
    45: "movePath",
    51: "moveUntilContact",
    52: "freedriveMode",
}
"""Commands that would move the arm in ways that are not emulated: the program ends with an error rather than pretend."""
STRIPPED_ON_CB3 = frozenset({51, 52})
STREAMED = frozenset({9, 10, 11, 24})
"""Commands carried out anew in every cycle in which the register holds them: speedJ, speedL, servoJ, servoL."""
SILENT = frozenset({25, 26, 27, 38, 58, 66, 67, 68, 69, 70, 71})
"""Commands that answer in every cycle and never report "done"."""


class Sample(NamedTuple):
    """Target and truth at one millisecond, for whoever wants to know when the arm was told to rest, and where it came to rest."""

    t_s: float  # of the host's monotonic clock
    speed_m_per_s: float
    vz_m_per_s: float
    target_z_m: float
    tip_z_m: float  # where the tip truly is
    contact_N: float
    runtime: int


@dataclass
class Cycle:
    """What the next cycle holds: the target's pose (6,) at its begin, its displacement, its speed at both ends."""

    start: Floats
    shift: Floats
    speed_before: Floats
    speed_after: Floats
    settled: float = 1.0  # the share of the cycle after which the speed is reached, linearly in time


class Controller:
    """A UR controller from power-up: `write` its inputs, `upload` a script, `cycle` it."""

    def __init__(
        self,
        model: Model,
        tip_pose: Floats,
        tcp: Floats,
        began: Callable[[], None] = lambda: None,
        started: Callable[[], None] = lambda: None,
    ) -> None:
        self.model = model
        self.arm = Arm(tip_pose)
        self.inputs: dict[str, tuple[float, ...]] = {}
        self.outputs: dict[str, tuple[float, ...]] = {}
        self.power = Power.RUNNING
        self.safety = Safety.NORMAL
        self.runtime = Runtime.STOPPED
        self.speed = np.zeros(6)
        self.pose = tip_pose.copy()  # of the true tip
        self.motion: Motion | None = None
        self.program: Program | None = None
        self.tcp_true, self.tcp = tcp.copy(), tcp.copy()
        self.payload_kg, self.payload_cog = 0.0, (0.0, 0.0, 0.0)
        self.messages: list[tuple[str, int]] = []
        self.stops: list[tuple[float, str]] = []
        self.commands: deque[tuple[float, float]] = deque(maxlen=COMMANDS_KEPT)  # when, and the vertical speed that was asked
        self._began = began  # at a program's first motion
        self._started = started  # when a program starts
        self._fed_s = 0.0
        self._stopped_s = 0.0
        self._operation = 0
        self._still_s = 0.0
        self._start_power_s: float | None = None

    # What comes over the wires -------------------------------------------------------------------------------------------

    def write(self, values: Mapping[str, tuple[float, ...]], now_s: float) -> None:
        """Take a package of inputs; it feeds the watchdog if it holds the command register."""
        self.inputs.update(values)
        offset = self.program.offset if self.program else 0
        if f"input_double_register_{offset + 2}" in values:
            self.commands.append((now_s, values[f"input_double_register_{offset + 2}"][0]))
        if f"input_int_register_{offset}" in values:
            self._fed_s = max(self._fed_s, now_s)

    def upload(self, script: str, now_s: float) -> None:
        """Take a script; it replaces what runs, and starts a little later, if the arm may move."""
        self.stop_program(now_s, "replaced by a new script")
        if self.power is not Power.RUNNING or self.safety is not Safety.NORMAL:
            self.messages.append(("Robot cannot run a program: it is not in normal mode", 1))
            return
        offset = re.search(r"# int register offset\s*\n(\d+)", script)
        commands = "rtde_control" in script
        self.program = Program(int(offset.group(1)) if offset else 0, commands, start_s=now_s + PROGRAM_START_S)

    def play(self) -> bool:
        """Resume a paused program; False where there is none."""
        if self.runtime is not Runtime.PAUSED or self.safety is not Safety.NORMAL or self.program is None:
            return False
        self.runtime = Runtime.PLAYING
        return True

    def pause(self) -> bool:
        """Pause a running program; False where none runs."""
        if self.runtime is not Runtime.PLAYING:
            return False
        self.runtime = Runtime.PAUSED
        self._halt(PROGRAM_STOP_M_PER_S2)
        return True

    def stop_program(self, now_s: float, reason: str) -> bool:
        """End the program, its watchdog and its motion; False where none was there."""
        was = self.program is not None
        if self.program is not None and self.program.started:
            self.stops.append((now_s, reason))
        self.program = None
        if self.runtime is not Runtime.STOPPED:
            self.runtime = Runtime.STOPPING
        self._halt(PROGRAM_STOP_M_PER_S2)
        return was

    def protective_stop(self, now_s: float, reason: str = "protective stop") -> None:
        """Stop the motion and pause the program until somebody unlocks."""
        if self.safety is Safety.NORMAL:
            self.safety, self._stopped_s = Safety.PROTECTIVE_STOP, now_s
            self.stops.append((now_s, reason))
            self.messages.append(("Protective stop", 0))
            if self.runtime is Runtime.PLAYING:
                self.runtime = Runtime.PAUSED
            self._halt(EMERGENCY_STOP_M_PER_S2)

    def unlock(self, now_s: float) -> bool:
        """Release a protective stop; False before its time."""
        if self.safety is Safety.PROTECTIVE_STOP:
            if now_s - self._stopped_s < UNLOCK_AFTER_S:
                return False
            self.safety = Safety.NORMAL
        return True

    def emergency_stop(self, now_s: float) -> None:
        """Stop the motion, end the program, cut the power."""
        self.stop_program(now_s, "emergency stop")
        self._halt(EMERGENCY_STOP_M_PER_S2)
        self.safety, self.power = Safety.ROBOT_EMERGENCY_STOP, Power.POWER_OFF

    def power_off(self, now_s: float) -> None:
        """End the program and cut the power."""
        self.stop_program(now_s, "power off")
        self.power = Power.POWER_OFF

    def power_on(self) -> None:
        """Give power, brakes still on; an emergency stop is released with it."""
        self.safety = Safety.NORMAL
        if self.power is Power.POWER_OFF:
            self.power = Power.IDLE

    def release_brakes(self) -> None:
        """Make the arm able to move."""
        self.power_on()
        self.power = Power.RUNNING

    # One cycle -----------------------------------------------------------------------------------------------------------

    def cycle(self, t_s: float) -> Cycle:
        """Judge the watchdog, run one pass of the program, and say where the target goes until the next cycle."""
        if self.runtime is Runtime.STOPPING and not self.speed.any():
            self.runtime = Runtime.STOPPED
        program = self.program
        if program is not None and not program.started and t_s >= program.start_s and self.runtime is Runtime.STOPPED:
            program.started, self.runtime, self._fed_s = True, Runtime.PLAYING, t_s
            self._started()
            self._say(program, 0, 0)
        if program is not None and program.started:
            if program.watchdog_s is not None and t_s - self._fed_s > program.watchdog_s:
                self.messages.append(("RTDE watchdog: input update did not arrive in time, program stopped", 1))
                self.stop_program(t_s, "watchdog")
            elif self.runtime is Runtime.PLAYING:
                self._run(program, t_s)
        return self._move()

    def _halt(self, deceleration: float) -> None:
        self.motion = Ramp(np.zeros(6), deceleration) if self.speed.any() else None

    def _move(self) -> Cycle:
        before, start = self.speed, self.pose
        if self.motion is None:
            self._still_s += self.model.cycle_s
            return Cycle(start, np.zeros(6), before, before)
        self._still_s = 0.0
        after, shift, over, settled = self.motion.advance(before, start, self.model.cycle_s)
        program = self.program
        if program is not None and not program.moved and after.any():
            program.moved = True
            self._began()
        self.speed = after
        pose = start.copy()
        pose[:3] += shift[:3]
        if shift[3:].any():
            pose[3:] = rotation_vector(rotation(shift[3:]) @ rotation(start[3:]))
        self.pose = pose
        if over:
            self.motion = None
        return Cycle(start, shift, before, after, settled)

    # The program ---------------------------------------------------------------------------------------------------------

    def _ints(self, program: Program, first: int) -> int:
        return int(self.inputs.get(f"input_int_register_{program.offset + first}", (0,))[0])

    def _doubles(self, program: Program, count: int, first: int = 0) -> Floats:
        names = (f"input_double_register_{program.offset + i}" for i in range(first, first + count))
        return np.array([self.inputs.get(name, (0.0,))[0] for name in names])

    def _say(self, program: Program, register: int, word: int) -> None:
        self.outputs[f"output_int_register_{program.offset + register}"] = (word,)

    def _answer(self, program: Program, values: Iterable[float]) -> None:
        for i, value in enumerate(values, program.offset):
            self.outputs[f"output_double_register_{i}"] = (float(value),)

    def _run(self, program: Program, t_s: float) -> None:
        if not program.commands:
            self._say(program, 0, 2)
            self.stop_program(t_s, "script ended")
            return
        if self.motion is None and program.moving:
            program.moving = False
            self._progress(program, running=False)
        if program.blocking:
            if self.motion is not None:
                return
            program.blocking = False
            self._say(program, 0, 2)
        command = self._ints(program, 0)
        if command == 0:
            program.held = False
            self._say(program, 0, 1)
        elif command in UNEMULATED and (self.model.e_series or command not in STRIPPED_ON_CB3):
            self._runtime_error(t_s, f"{UNEMULATED[command]} is not emulated")
        elif command in STREAMED:
            self._stream(program, command, t_s)
        elif command in SILENT:
            self._reply(program, command)
        elif not program.held:
            program.held = True
            self._execute(program, command, t_s)

    def _stream(self, program: Program, command: int, t_s: float) -> None:
        if program.moving:
            self._runtime_error(t_s, "two threads move the robot at once")
            return
        program.streaming = True
        d = self._doubles(program, 11)
        if command in (9, 10):
            self.motion = Ramp(self.arm.tip_speed(d[:6]) if command == 9 else d[:6], float(d[6]))
        else:
            goal = self.arm.pose(d[:6]) if command == 11 else self._tip(d[:6])
            self.motion = Servo(goal, float(d[9]))

    def _reply(self, program: Program, command: int) -> None:
        if command == 26 and self.model.e_series:
            self._answer(program, [self.model.cycle_s])
        elif command == 58:
            self._answer(program, composed(self.pose, inverse(self.tcp_true)))

    def _execute(self, program: Program, command: int, t_s: float) -> None:
        move = self._moves.get(command)
        if move is not None:
            if program.streaming:
                self._runtime_error(t_s, "two threads move the robot at once")
                return
            move(self, program)
            return
        if command == 255:
            self.stop_program(t_s, "stopped by the client")
            return
        if command == 31:
            self.protective_stop(t_s, "protective stop asked for by the client")
            return
        if command == 35:
            rate_Hz = float(self._doubles(program, 1)[0])
            program.watchdog_s = 1.0 / rate_Hz if rate_Hz > 0 else None
            self._fed_s = max(self._fed_s, t_s)
        question = self._questions.get(command)
        if question is not None:
            question(self, program)
        if not program.blocking:
            self._say(program, 0, 2)

    def _runtime_error(self, t_s: float, reason: str) -> None:
        self.messages.append((f"Runtime error: {reason}", 0))
        self.stop_program(t_s, reason)

    def _progress(self, program: Program, running: bool) -> None:
        word = int(self.outputs.get(f"output_int_register_{program.offset + 2}", (0,))[0])
        writes = ((word >> 16) + 1) & 0x7F
        self._say(program, 2, (self._operation & 0x7F) << 24 | writes << 16 | running << 15)

    def _tip(self, tcp_pose: Floats) -> Floats:
        """Pose of the true tip when the active TCP is at `tcp_pose`."""
        if np.array_equal(self.tcp, self.tcp_true):
            return np.array(tcp_pose)
        return composed(composed(tcp_pose, inverse(self.tcp)), self.tcp_true)

    def tcp_pose(self, tip_pose: Floats) -> Floats:
        """Pose of the active TCP when the true tip is at `tip_pose`."""
        if np.array_equal(self.tcp, self.tcp_true):
            return tip_pose
        return composed(composed(tip_pose, inverse(self.tcp_true)), self.tcp)

    def _go(self, program: Program, goal: Floats, leading: float | None = None) -> None:
        speed, acceleration = (max(float(value), 1e-6) for value in self._doubles(program, 2, 6))
        if program.moving:
            self._progress(program, running=False)
        self.motion = Line(goal, speed, acceleration, leading)
        self._launch(program, self._ints(program, 1) != 0)

    def _launch(self, program: Program, asynchronous: bool) -> None:
        if asynchronous:
            self._operation += 1
            program.moving = True
            self._progress(program, running=True)
            self._say(program, 0, 2)
        else:
            program.blocking = True

    def _move_joints(self, program: Program, joints: Floats) -> None:
        leading = float(np.abs(joints - self.arm.joints(self.pose)).max())
        self._go(program, self.arm.pose(joints), leading)

    def _move_j(self, program: Program) -> None:
        self._move_joints(program, self._doubles(program, 6))

    def _move_j_ik(self, program: Program) -> None:
        self._move_joints(program, self.arm.joints(self._tip(self._doubles(program, 6))))

    def _move_l(self, program: Program) -> None:
        self._go(program, self._tip(self._doubles(program, 6)))

    def _move_l_fk(self, program: Program) -> None:
        self._go(program, self.arm.pose(self._doubles(program, 6)))

    def _stop_motion(self, program: Program) -> None:
        asynchronous = self._ints(program, 1) != 0
        program.stops_linearly |= asynchronous
        if program.moving:
            program.moving = False
            self._progress(program, running=False)
        if self.motion is not None:
            # A joint-wise stop (rad/s2) acts on the tip over an arm of about half a metre.
            self._halt(max(float(self._doubles(program, 1)[0]), 1e-3) * (1.0 if program.stops_linearly else 0.5))
        self._launch(program, asynchronous)

    def _stop_stream(self, program: Program) -> None:
        program.streaming = False
        self._halt(max(float(self._doubles(program, 1)[0]), 1e-3))
        program.blocking = True

    def _set_tcp(self, program: Program) -> None:
        self.tcp = self._doubles(program, 6)

    def _get_tcp(self, program: Program) -> None:
        self._answer(program, self.tcp)

    def _set_payload(self, program: Program) -> None:
        mass, x, y, z = (float(value) for value in self._doubles(program, 4))
        self.payload_kg, self.payload_cog = mass, (x, y, z)

    def _is_steady(self, program: Program) -> None:
        self._say(program, 1, int(self.motion is None and self._still_s >= 0.1))

    def _pose_is_safe(self, program: Program) -> None:
        self._say(program, 1, int(np.linalg.norm(self._doubles(program, 3)) < 0.95))

    def _joints_are_safe(self, program: Program) -> None:
        self._say(program, 1, int(np.abs(self._doubles(program, 6)).max() < 2.0 * np.pi))

    def _compose(self, program: Program) -> None:
        d = self._doubles(program, 12)
        self._answer(program, composed(d[:6], d[6:]))

    def _forward(self, program: Program) -> None:
        self._answer(program, self.tcp_pose(self.pose))

    def _forward_of(self, program: Program) -> None:
        d = self._doubles(program, 12)
        self._answer(program, composed(composed(self.arm.pose(d[:6]), inverse(self.tcp_true)), d[6:]))

    def _backward(self, program: Program) -> None:
        self._answer(program, self.arm.joints(self._tip(self._doubles(program, 6))))

    def _has_solution(self, program: Program) -> None:
        self._say(program, 1, 1)

    _moves: Mapping[int, Callable[["Controller", Program], None]] = {
        1: _move_j,
        2: _move_j_ik,
        3: _move_l,
        4: _move_l_fk,
        33: _stop_motion,
        34: _stop_motion,
    }
    _questions: Mapping[int, Callable[["Controller", Program], None]] = {
        15: _stop_stream,
        16: _stop_stream,
        17: _set_payload,
        29: _set_tcp,
        30: _backward,
        36: _pose_is_safe,
        37: _joints_are_safe,
        39: _compose,
        40: _get_tcp,
        43: _forward,
        44: _forward_of,
        46: _backward,
        47: _is_steady,
        60: _has_solution,
        61: _has_solution,
    }
