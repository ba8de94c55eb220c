"""The registers of RTDE through which the control script and its client speak, and the questions that the script answers in them."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from hw.emulators.controller_state import ControllerState
from hw.emulators.pose import Floats, composed, inverse


@dataclass(frozen=True)
class ScriptRegisters:
    """The registers of one program; its `offset` shifts them all."""

    state: ControllerState
    offset: int

    def integer(self, number: int) -> int:
        """Read an integer of the client; 0 where it wrote none."""
        return int(self.state.inputs.get(f"input_int_register_{self.offset + number}", (0,))[0])

    def doubles(self, count: int, first: int = 0) -> Floats:
        """Read doubles (count,) of the client from the number `first` on; 0 where it wrote none."""
        names = (f"input_double_register_{self.offset + i}" for i in range(first, first + count))
        return np.array([self.state.inputs.get(name, (0.0,))[0] for name in names])

    def say(self, number: int, word: int) -> None:
        """Write an integer for the client."""
        self.state.outputs[f"output_int_register_{self.offset + number}"] = (word,)

    def word(self, number: int) -> int:
        """Read an integer that was written last; 0 where none was."""
        return int(self.state.outputs.get(f"output_int_register_{self.offset + number}", (0,))[0])

    def answer(self, values: Iterable[float]) -> None:
        """Write doubles for the client."""
        for i, value in enumerate(values, self.offset):
            self.state.outputs[f"output_double_register_{i}"] = (float(value),)


Question = Callable[[ControllerState, ScriptRegisters], None]


def _set_tcp(state: ControllerState, registers: ScriptRegisters) -> None:
    state.tcp = registers.doubles(6)


def _set_payload(state: ControllerState, registers: ScriptRegisters) -> None:
    mass, x, y, z = (float(value) for value in registers.doubles(4))
    state.payload_kg, state.payload_cog = mass, (x, y, z)


def _compose(_state: ControllerState, registers: ScriptRegisters) -> None:
    d = registers.doubles(12)
    registers.answer(composed(d[:6], d[6:]))


def _forward_of(state: ControllerState, registers: ScriptRegisters) -> None:
    d = registers.doubles(12)
    registers.answer(composed(composed(state.arm.pose(d[:6]), inverse(state.tcp_true)), d[6:]))


def _backward(state: ControllerState, registers: ScriptRegisters) -> None:
    registers.answer(state.arm.joints(state.tip(registers.doubles(6))))


def _has_solution(_state: ControllerState, registers: ScriptRegisters) -> None:
    registers.say(1, 1)


QUESTIONS: Mapping[int, Question] = {
    17: _set_payload,
    26: lambda state, registers: registers.answer([state.model.cycle_s] if state.model.e_series else []),
    29: _set_tcp,
    30: _backward,
    36: lambda _, registers: registers.say(1, int(np.linalg.norm(registers.doubles(3)) < 0.95)),  # is the pose safe?
    37: lambda _, registers: registers.say(1, int(np.abs(registers.doubles(6)).max() < 2.0 * np.pi)),  # are the joints?
    39: _compose,
    40: lambda state, registers: registers.answer(state.tcp),
    43: lambda state, registers: registers.answer(state.tcp_pose(state.pose)),
    44: _forward_of,
    46: _backward,
    47: lambda state, registers: registers.say(1, int(state.motion is None and state.still_s >= 0.1)),  # is the arm steady?
    58: lambda state, registers: registers.answer(composed(state.pose, inverse(state.tcp_true))),
    60: _has_solution,
    61: _has_solution,
}
"""Commands that set or ask something and move nothing."""
SILENT = frozenset({25, 26, 27, 38, 58, 66, 67, 68, 69, 70, 71})
"""Commands that are answered in every cycle, or not at all, and never report "done"."""
