"""The control script that ur_rtde 1.6.5 uploads, as observed on the wire: commands and answers in the registers of RTDE."""

from collections.abc import Callable, Iterable, Mapping

import numpy as np

from hw.emulators.controller_state import ControllerState, Program
from hw.emulators.pose import Floats, composed, inverse
from hw.emulators.target_motion import Ramp, Servo, TrapezoidalMove

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


class ControlScript:
    """Carries out the commands that a client writes into the registers, pass by pass."""

    def __init__(self, state: ControllerState) -> None:
        self._state = state
        self._operation = 0

    def start(self, program: Program) -> None:
        """Show in the registers that no command was answered yet."""
        self._say(program, 0, 0)

    def run(self, program: Program, t_s: float) -> None:
        """One pass of the program."""
        if not program.commands:
            if t_s < program.end_s:
                return
            self._say(program, 0, 2)
            self._state.stop_program(t_s, "script ended")
            return
        if self._state.motion is None and program.moving:
            program.moving = False
            self._progress(program, running=False)
        if program.blocking:
            if self._state.motion is not None:
                return
            program.blocking = False
            self._say(program, 0, 2)
        command = self._ints(program, 0)
        if command == 0:
            program.held = False
            self._say(program, 0, 1)
        elif command in UNEMULATED and (self._state.model.e_series or command not in STRIPPED_ON_CB3):
            self._runtime_error(t_s, f"{UNEMULATED[command]} is not emulated")
        elif command in STREAMED:
            self._stream(program, command, t_s)
        elif command in SILENT:
            self._reply(program, command)
        elif not program.held:
            program.held = True
            self._execute(program, command, t_s)

    def _ints(self, program: Program, first: int) -> int:
        return int(self._state.inputs.get(f"input_int_register_{program.offset + first}", (0,))[0])

    def _doubles(self, program: Program, count: int, first: int = 0) -> Floats:
        names = (f"input_double_register_{program.offset + i}" for i in range(first, first + count))
        return np.array([self._state.inputs.get(name, (0.0,))[0] for name in names])

    def _say(self, program: Program, register: int, word: int) -> None:
        self._state.outputs[f"output_int_register_{program.offset + register}"] = (word,)

    def _answer(self, program: Program, values: Iterable[float]) -> None:
        for i, value in enumerate(values, program.offset):
            self._state.outputs[f"output_double_register_{i}"] = (float(value),)

    def _stream(self, program: Program, command: int, t_s: float) -> None:
        if program.moving:
            self._runtime_error(t_s, "two threads move the robot at once")
            return
        program.streaming = True
        d = self._doubles(program, 11)
        if command in (9, 10):
            self._state.motion = Ramp(self._state.arm.tip_speed(d[:6]) if command == 9 else d[:6], float(d[6]))
        else:
            goal = self._state.arm.pose(d[:6]) if command == 11 else self._state.tip(d[:6])
            self._state.motion = Servo(goal, float(d[9]))

    def _reply(self, program: Program, command: int) -> None:
        if command == 26 and self._state.model.e_series:
            self._answer(program, [self._state.model.cycle_s])
        elif command == 58:
            self._answer(program, composed(self._state.pose, inverse(self._state.tcp_true)))

    def _execute(self, program: Program, command: int, t_s: float) -> None:
        move = self._moves.get(command)
        if move is not None:
            if program.streaming:
                self._runtime_error(t_s, "two threads move the robot at once")
                return
            move(self, program)
            return
        if command == 255:
            self._state.stop_program(t_s, "stopped by the client")
            return
        if command == 31:
            self._state.protective_stop(t_s, "protective stop requested by the client")
            return
        if command == 35:
            rate_Hz = float(self._doubles(program, 1)[0])
            program.watchdog_s = 1.0 / rate_Hz if rate_Hz > 0 else None
            program.watchdog_set_s = t_s
            self._state.armings.append(t_s)
            self._state.fed_s = max(self._state.fed_s, t_s)
        question = self._questions.get(command)
        if question is not None:
            question(self, program)
        if not program.blocking:
            self._say(program, 0, 2)

    def _runtime_error(self, t_s: float, reason: str) -> None:
        self._state.messages.append((f"Runtime error: {reason}", 0))
        self._state.stop_program(t_s, reason)

    def _progress(self, program: Program, running: bool) -> None:
        word = int(self._state.outputs.get(f"output_int_register_{program.offset + 2}", (0,))[0])
        writes = ((word >> 16) + 1) & 0x7F
        self._say(program, 2, (self._operation & 0x7F) << 24 | writes << 16 | running << 15)

    def _go(self, program: Program, goal: Floats, leading: float | None = None) -> None:
        speed, acceleration = (max(float(value), 1e-6) for value in self._doubles(program, 2, 6))
        if program.moving:
            self._progress(program, running=False)
        self._state.motion = TrapezoidalMove(goal, speed, acceleration, leading)
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
        leading = float(np.abs(joints - self._state.arm.joints(self._state.pose)).max())
        self._go(program, self._state.arm.pose(joints), leading)

    def _move_j(self, program: Program) -> None:
        self._move_joints(program, self._doubles(program, 6))

    def _move_j_ik(self, program: Program) -> None:
        self._move_joints(program, self._state.arm.joints(self._state.tip(self._doubles(program, 6))))

    def _move_l(self, program: Program) -> None:
        self._go(program, self._state.tip(self._doubles(program, 6)))

    def _move_l_fk(self, program: Program) -> None:
        self._go(program, self._state.arm.pose(self._doubles(program, 6)))

    def _stop_motion(self, program: Program) -> None:
        asynchronous = self._ints(program, 1) != 0
        program.stops_linearly |= asynchronous
        if program.moving:
            program.moving = False
            self._progress(program, running=False)
        if self._state.motion is not None:
            # A joint-wise stop (rad/s2) acts on the tip over an arm of about half a metre.
            self._state.halt(max(float(self._doubles(program, 1)[0]), 1e-3) * (1.0 if program.stops_linearly else 0.5))
        self._launch(program, asynchronous)

    def _stop_stream(self, program: Program) -> None:
        program.streaming = False
        self._state.halt(max(float(self._doubles(program, 1)[0]), 1e-3))
        program.blocking = True

    def _set_tcp(self, program: Program) -> None:
        self._state.tcp = self._doubles(program, 6)

    def _get_tcp(self, program: Program) -> None:
        self._answer(program, self._state.tcp)

    def _set_payload(self, program: Program) -> None:
        mass, x, y, z = (float(value) for value in self._doubles(program, 4))
        self._state.payload_kg, self._state.payload_cog = mass, (x, y, z)

    def _is_steady(self, program: Program) -> None:
        self._say(program, 1, int(self._state.motion is None and self._state.still_s >= 0.1))

    def _pose_is_safe(self, program: Program) -> None:
        self._say(program, 1, int(np.linalg.norm(self._doubles(program, 3)) < 0.95))

    def _joints_are_safe(self, program: Program) -> None:
        self._say(program, 1, int(np.abs(self._doubles(program, 6)).max() < 2.0 * np.pi))

    def _compose(self, program: Program) -> None:
        d = self._doubles(program, 12)
        self._answer(program, composed(d[:6], d[6:]))

    def _forward(self, program: Program) -> None:
        self._answer(program, self._state.tcp_pose(self._state.pose))

    def _forward_of(self, program: Program) -> None:
        d = self._doubles(program, 12)
        self._answer(program, composed(composed(self._state.arm.pose(d[:6]), inverse(self._state.tcp_true)), d[6:]))

    def _backward(self, program: Program) -> None:
        self._answer(program, self._state.arm.joints(self._state.tip(self._doubles(program, 6))))

    def _has_solution(self, program: Program) -> None:
        self._say(program, 1, 1)

    _moves: Mapping[int, Callable[["ControlScript", Program], None]] = {
        1: _move_j,
        2: _move_j_ik,
        3: _move_l,
        4: _move_l_fk,
        33: _stop_motion,
        34: _stop_motion,
    }
    _questions: Mapping[int, Callable[["ControlScript", Program], None]] = {
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
