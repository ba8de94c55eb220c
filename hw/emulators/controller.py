"""What a UR controller does, cycle by cycle: its inputs, the upload of scripts, the watchdog, the motion of its target.

No socket and no clock: `ur.py` owns the bytes, and the time is an argument. Nothing here was compared with a real robot.
"""

import re
from collections import deque
from collections.abc import Callable, Mapping
from typing import NamedTuple

from hw.emulators.control_script import ControlScript
from hw.emulators.controller_state import FIT, ControllerCycle, ControllerModel, ControllerState, Power, Program, Runtime
from hw.emulators.dashboard import Dashboard
from hw.emulators.pose import Floats

COMMANDS_KEPT = 15_000
PROGRAM_START_S = 0.1
"""From the last byte of an uploaded script to its first cycle."""


class TruthSample(NamedTuple):
    """Target and truth at one millisecond: when the controller commanded rest, and where the tip came to rest."""

    t_s: float  # of the host's monotonic clock
    speed_m_per_s: float
    vz_m_per_s: float
    target_z_m: float
    tip_z_m: float  # where the tip truly is
    contact_N: float
    runtime: int


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
        self.state = ControllerState(model, tip_pose, tcp)
        self.script = ControlScript(self.state)
        self.dashboard = Dashboard(self.state)
        self.commands: deque[tuple[float, float]] = deque(maxlen=COMMANDS_KEPT)  # when, and the vertical speed that was asked
        self._began = began  # at a program's first motion
        self._started = started  # when a program starts

    def write(self, values: Mapping[str, tuple[float, ...]], now_s: float) -> None:
        """Take a package of inputs; it feeds the watchdog if it holds the command register.

        Args:
            values: value of each input field.
            now_s: host time.
        """
        self.state.inputs.update(values)
        offset = self.state.program.offset if self.state.program else 0
        if f"input_double_register_{offset + 2}" in values:
            self.commands.append((now_s, values[f"input_double_register_{offset + 2}"][0]))
        if f"input_int_register_{offset}" in values:
            self.state.fed_s = max(self.state.fed_s, now_s)

    def upload(self, script: str, now_s: float) -> None:
        """Take a script. It replaces the running program and starts `PROGRAM_START_S` later, if the arm may move.

        A script without command registers sleeps for as long as its `sleep` lines say, and ends. In local control scripts are ignored.

        Args:
            now_s: host time.
        """
        if not self.state.remote_control:
            return
        self.state.stop_program(now_s, "replaced by a new script")
        if self.state.power is not Power.RUNNING or self.state.safety not in FIT:
            self.state.messages.append(("Robot cannot run a program: it is not in normal mode", 1))
            return
        offset = re.search(r"# int register offset\s*\n(\d+)", script)
        commands = "rtde_control" in script
        start_s = now_s + PROGRAM_START_S
        end_s = start_s + sum(float(slept_s) for slept_s in re.findall(r"\bsleep\(([0-9.]+)\)", script))
        self.state.program = Program(int(offset.group(1)) if offset else 0, commands, start_s=start_s, end_s=end_s)

    def cycle(self, t_s: float) -> ControllerCycle:
        """Check the watchdog, run one pass of the program, and return the target's way until the next cycle."""
        state = self.state
        if state.runtime is Runtime.STOPPING and not state.speed.any():
            state.runtime = Runtime.STOPPED
        program = state.program
        if program is not None and not program.started and t_s >= program.start_s and state.runtime is Runtime.STOPPED:
            program.started, state.runtime, state.fed_s = True, Runtime.PLAYING, t_s
            self._started()
            self.script.start(program)
        if program is not None and program.started:
            if program.watchdog_s is not None and t_s - state.fed_s > program.watchdog_s:
                state.messages.append(("RTDE watchdog: input update did not arrive in time, program stopped", 1))
                state.stop_program(t_s, "watchdog")
            elif state.runtime is Runtime.PLAYING:
                self.script.run(program, t_s)
        way = state.advance()
        if state.program is not None and not state.program.moved and way.speed_after.any():
            state.program.moved = True
            self._began()
        return way
