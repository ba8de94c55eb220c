"""The control script that ur_rtde 1.6.5 uploads, as observed on the wire: commands and answers in the registers of RTDE."""

from collections.abc import Callable, Mapping

import numpy as np

from hw.emulators.controller_state import ControllerState, Program, Safety
from hw.emulators.pose import Floats
from hw.emulators.script_registers import QUESTIONS, SILENT, ScriptRegisters
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
STREAM_STOPS = frozenset({15, 16})
"""Commands that end such a stream: speedStop, servoStop."""


class ControlScript:
    """Carries out the commands that a client writes into the registers, pass by pass."""

    def __init__(self, state: ControllerState) -> None:
        self._state = state
        self._operation = 0

    def _registers(self, program: Program) -> ScriptRegisters:
        return ScriptRegisters(self._state, program.offset)

    def start(self, program: Program) -> None:
        """Show in the registers that no command was answered yet."""
        self._registers(program).say(0, 0)

    def run(self, program: Program, t_s: float) -> None:
        """One pass of the program."""
        if not program.commands:
            if t_s < program.end_s:
                return
            self._registers(program).say(0, 2)
            self._state.stop_program(t_s, "script ended")
            return
        if self._state.motion is None and program.moving:
            program.moving = False
            self._progress(program, running=False)
        if program.blocking:
            if self._state.motion is not None:
                return
            program.blocking = False
            self._registers(program).say(0, 2)
        command = self._registers(program).integer(0)
        if command == 0:
            program.held = False
            self._registers(program).say(0, 1)
        elif command in UNEMULATED and (self._state.model.e_series or command not in STRIPPED_ON_CB3):
            self._runtime_error(t_s, f"{UNEMULATED[command]} is not emulated")
        elif command in STREAMED:
            self._stream(program, command, t_s)
        elif command in SILENT:
            self._answer(program, command)
        elif not program.held:
            program.held = True
            self._execute(program, command, t_s)

    def _stream(self, program: Program, command: int, t_s: float) -> None:
        if program.moving:
            self._runtime_error(t_s, "two threads move the robot at once")
            return
        program.streaming = True
        d = self._registers(program).doubles(11)
        if command in (9, 10):
            self._state.motion = Ramp(self._state.arm.tip_speed(d[:6]) if command == 9 else d[:6], float(d[6]))
        else:
            goal = self._state.arm.pose(d[:6]) if command == 11 else self._state.tip(d[:6])
            self._state.motion = Servo(goal, float(d[9]))

    def _answer(self, program: Program, command: int) -> None:
        if (question := QUESTIONS.get(command)) is not None:
            question(self._state, self._registers(program))

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
            self._state.pausing_stop(t_s, Safety.PROTECTIVE_STOP, "protective stop requested by the client")
            return
        if command == 35:
            rate_Hz = float(self._registers(program).doubles(1)[0])
            program.watchdog_s = 1.0 / rate_Hz if rate_Hz > 0 else None
            program.watchdog_set_s = t_s
            self._state.armings.append(t_s)
            self._state.fed_s = max(self._state.fed_s, t_s)
        if command in STREAM_STOPS:
            self._stop_stream(program)
        self._answer(program, command)
        if not program.blocking:
            self._registers(program).say(0, 2)

    def _runtime_error(self, t_s: float, reason: str) -> None:
        self._state.messages.append((f"Runtime error: {reason}", 0))
        self._state.stop_program(t_s, reason)

    def _progress(self, program: Program, running: bool) -> None:
        writes = ((self._registers(program).word(2) >> 16) + 1) & 0x7F
        self._registers(program).say(2, (self._operation & 0x7F) << 24 | writes << 16 | running << 15)

    def _go(self, program: Program, goal: Floats, leading: float | None = None) -> None:
        speed, acceleration = (max(float(value), 1e-6) for value in self._registers(program).doubles(2, 6))
        if program.moving:
            self._progress(program, running=False)
        self._state.motion = TrapezoidalMove(goal, speed, acceleration, leading)
        self._launch(program, self._registers(program).integer(1) != 0)

    def _launch(self, program: Program, asynchronous: bool) -> None:
        if asynchronous:
            self._operation += 1
            program.moving = True
            self._progress(program, running=True)
            self._registers(program).say(0, 2)
        else:
            program.blocking = True

    def _move_joints(self, program: Program, joints: Floats) -> None:
        leading = float(np.abs(joints - self._state.arm.joints(self._state.pose)).max())
        self._go(program, self._state.arm.pose(joints), leading)

    def _move_j(self, program: Program) -> None:
        self._move_joints(program, self._registers(program).doubles(6))

    def _move_j_ik(self, program: Program) -> None:
        self._move_joints(program, self._state.arm.joints(self._state.tip(self._registers(program).doubles(6))))

    def _move_l(self, program: Program) -> None:
        self._go(program, self._state.tip(self._registers(program).doubles(6)))

    def _move_l_fk(self, program: Program) -> None:
        self._go(program, self._state.arm.pose(self._registers(program).doubles(6)))

    def _stop_motion(self, program: Program) -> None:
        asynchronous = self._registers(program).integer(1) != 0
        program.stops_linearly |= asynchronous
        if program.moving:
            program.moving = False
            self._progress(program, running=False)
        if self._state.motion is not None:
            # A joint-wise stop (rad/s2) acts on the tip over an arm of about half a metre.
            self._state.halt(max(float(self._registers(program).doubles(1)[0]), 1e-3) * (1.0 if program.stops_linearly else 0.5))
        self._launch(program, asynchronous)

    def _stop_stream(self, program: Program) -> None:
        program.streaming = False
        self._state.halt(max(float(self._registers(program).doubles(1)[0]), 1e-3))
        program.blocking = True

    _moves: Mapping[int, Callable[["ControlScript", Program], None]] = {
        1: _move_j,
        2: _move_j_ik,
        3: _move_l,
        4: _move_l_fk,
        33: _stop_motion,
        34: _stop_motion,
    }
