"""What a UR controller does with its registers, cycle by cycle: the control program, its watchdog, the motion, the stops.

No socket and no clock: `ur.py` owns the bytes, and the time is an argument. The program's side of the registers follows the script that
ur_rtde 1.6.5 uploads, as observed on the wire. Nothing here was compared with a real robot.
"""

import re
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from hw.emulators.arm import ArmKinematics
from hw.emulators.pose import Floats, composed, inverse, rotation, rotation_vector
from hw.emulators.target_motion import Ramp, Servo, TargetMotion, TrapezoidalMove

PROGRAM_STOP_M_PER_S2 = 5.0
"""Deceleration of the tip when a program ends during a motion. No figure is published; from 10 mm/s it takes 2 ms, so one cycle."""
EMERGENCY_STOP_M_PER_S2 = 10.0
COMMANDS_KEPT = 15_000
PROGRAM_START_S = 0.1
"""From the last byte of an uploaded script to its first cycle."""
UNLOCK_AFTER_S = 5.0
"""Age of a protective stop before which it cannot be unlocked."""


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


UNEMULATED = {
    6: "forceMode",
    12: "servoC",
    18: "teachMode",
    41: "jogStart",
    45: "movePath",
    51: "moveUntilContact",
    52: "freedriveMode",
}
"""Motion commands that are not emulated: the program ends with an error."""
STRIPPED_ON_CB3 = frozenset({51, 52})
STREAMED = frozenset({9, 10, 11, 24})
"""Commands that run again in every cycle in which the register holds them: speedJ, speedL, servoJ, servoL."""
SILENT = frozenset({25, 26, 27, 38, 58, 66, 67, 68, 69, 70, 71})
"""Commands that answer in every cycle and never report "done"."""


class TruthSample(NamedTuple):
    """Target and truth at one millisecond: when the controller commanded rest, and where the tip came to rest."""

    t_s: float  # of the host's monotonic clock
    speed_m_per_s: float
    vz_m_per_s: float
    target_z_m: float
    tip_z_m: float  # where the tip truly is
    contact_N: float
    runtime: int


@dataclass
class ControllerCycle:
    """The next cycle of the target: its pose (6,) at the begin, its displacement (6,), its speed (6,) at both ends."""

    start: Floats
    shift: Floats
    speed_before: Floats
    speed_after: Floats
    settled: float = 1.0  # as Step.settled


class Controller:
    """A UR controller from power-up: `write` its inputs, `upload` a script, `cycle` it."""

    def __init__(
        self,
        model: ControllerModel,
        tip_pose: Floats,
        tcp: Floats,
        began: Callable[[], None] = lambda: None,
        started: Callable[[], None] = lambda: None,
    ) -> None:
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
        self.program: Program | None = None
        self.tcp_true, self.tcp = tcp.copy(), tcp.copy()
        self.payload_kg, self.payload_cog = 0.0, (0.0, 0.0, 0.0)
        self.messages: list[tuple[str, int]] = []
        self.stops: list[tuple[float, str]] = []
        self.armings: list[float] = []
        """When the control program set its watchdog."""
        self.commands: deque[tuple[float, float]] = deque(maxlen=COMMANDS_KEPT)  # when, and the vertical speed that was asked
        self._began = began  # at a program's first motion
        self._started = started  # when a program starts
        self._fed_s = 0.0
        self._stopped_s = 0.0
        self._operation = 0
        self._still_s = 0.0

    # What comes over the wires -------------------------------------------------------------------------------------------

    def write(self, values: Mapping[str, tuple[float, ...]], now_s: float) -> None:
        """Take a package of inputs; it feeds the watchdog if it holds the command register.

        Args:
            values: value of each input field.
            now_s: host time.
        """
        self.inputs.update(values)
        offset = self.program.offset if self.program else 0
        if f"input_double_register_{offset + 2}" in values:
            self.commands.append((now_s, values[f"input_double_register_{offset + 2}"][0]))
        if f"input_int_register_{offset}" in values:
            self._fed_s = max(self._fed_s, now_s)

    def stand_still(self, duration_s: float) -> None:
        """Count a time in which the whole controller stood still as none of the watchdog's."""
        self._fed_s += duration_s

    def upload(self, script: str, now_s: float) -> None:
        """Take a script. It replaces the running program and starts `PROGRAM_START_S` later, if the arm may move.

        A script without command registers sleeps for as long as its `sleep` lines say, and ends. In local control scripts are ignored.

        Args:
            now_s: host time.
        """
        if not self.remote_control:
            return
        self.stop_program(now_s, "replaced by a new script")
        if self.power is not Power.RUNNING or self.safety is not Safety.NORMAL:
            self.messages.append(("Robot cannot run a program: it is not in normal mode", 1))
            return
        offset = re.search(r"# int register offset\s*\n(\d+)", script)
        commands = "rtde_control" in script
        start_s = now_s + PROGRAM_START_S
        end_s = start_s + sum(float(slept_s) for slept_s in re.findall(r"\bsleep\(([0-9.]+)\)", script))
        self.program = Program(int(offset.group(1)) if offset else 0, commands, start_s=start_s, end_s=end_s)

    def play(self) -> bool:
        """Resume a paused program. Returns False where none is paused."""
        if self.runtime is not Runtime.PAUSED or self.safety is not Safety.NORMAL or self.program is None:
            return False
        self.runtime = Runtime.PLAYING
        return True

    def pause(self) -> bool:
        """Pause a running program. Returns False where none runs."""
        if self.runtime is not Runtime.PLAYING:
            return False
        self.runtime = Runtime.PAUSED
        self._halt(PROGRAM_STOP_M_PER_S2)
        return True

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
        self._halt(PROGRAM_STOP_M_PER_S2)
        return loaded

    def protective_stop(self, now_s: float, reason: str = "protective stop") -> None:
        """Stop the motion and pause the program until `unlock`.

        Args:
            now_s: host time.
            reason: why, for the log.
        """
        if self.safety is Safety.NORMAL:
            self.safety, self._stopped_s = Safety.PROTECTIVE_STOP, now_s
            self.stops.append((now_s, reason))
            self.messages.append(("Protective stop", 0))
            if self.runtime is Runtime.PLAYING:
                self.runtime = Runtime.PAUSED
            self._halt(EMERGENCY_STOP_M_PER_S2)

    def unlock(self, now_s: float) -> bool:
        """Release a protective stop. Returns False while it is younger than `UNLOCK_AFTER_S`."""
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
        """Switch the power on, brakes still on; this also releases an emergency stop."""
        self.safety = Safety.NORMAL
        if self.power is Power.POWER_OFF:
            self.power = Power.IDLE

    def release_brakes(self) -> None:
        """Switch the power on and release the brakes."""
        self.power_on()
        self.power = Power.RUNNING

    # One cycle -----------------------------------------------------------------------------------------------------------

    def cycle(self, t_s: float) -> ControllerCycle:
        """Check the watchdog, run one pass of the program, and return the target's way until the next cycle."""
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

    def _move(self) -> ControllerCycle:
        before, start = self.speed, self.pose
        if self.motion is None:
            self._still_s += self.model.cycle_s
            return ControllerCycle(start, np.zeros(6), before, before)
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
        return ControllerCycle(start, shift, before, after, settled)

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
            if t_s < program.end_s:
                return
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
            self.protective_stop(t_s, "protective stop requested by the client")
            return
        if command == 35:
            rate_Hz = float(self._doubles(program, 1)[0])
            program.watchdog_s = 1.0 / rate_Hz if rate_Hz > 0 else None
            program.watchdog_set_s = t_s
            self.armings.append(t_s)
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
        """Return the pose of the true tip when the active TCP is at `tcp_pose`."""
        if np.array_equal(self.tcp, self.tcp_true):
            return np.array(tcp_pose)
        return composed(composed(tcp_pose, inverse(self.tcp)), self.tcp_true)

    def tcp_pose(self, tip_pose: Floats) -> Floats:
        """Convert a pose of the true tip to one of the active TCP.

        Args:
            tip_pose: pose (6,) of the true tip, in m and rad.

        Returns:
            Pose (6,) of the active TCP.
        """
        if np.array_equal(self.tcp, self.tcp_true):
            return tip_pose
        return composed(composed(tip_pose, inverse(self.tcp_true)), self.tcp)

    def _go(self, program: Program, goal: Floats, leading: float | None = None) -> None:
        speed, acceleration = (max(float(value), 1e-6) for value in self._doubles(program, 2, 6))
        if program.moving:
            self._progress(program, running=False)
        self.motion = TrapezoidalMove(goal, speed, acceleration, leading)
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
