"""Loop, guard and the real drivers on emulated wires, in this process and on a FIFO thread: one push after another, nothing opened again.

What `palpd run` has besides (supervisor, recorder, a process of its own) is not in it; what stands between a sensor byte and a command is.
"""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hw.rtde import UrRobot
from palpd.config import Config, Plan, load_config
from palpd.control.loop import Explainer, Loop, Outcome
from palpd.control.sequence import ArmGeometry, Script, Sequence, Steps
from palpd.daemon.clock import RealClock
from palpd.daemon.devices import Devices
from palpd.daemon.motion_job import Job, arm_geometry_of, explainer_of, limits_of
from palpd.daemon.motion_process import RingWriter, take_reference
from palpd.daemon.realtime import DEVICE_PRIORITY, fifo, realtime
from palpd.daemon.wiring import devices
from palpd.errors import Stopped
from palpd.recording.ring import Ring
from palpd.testing.emulated_cell import EmulatedCell
from palpd.testing.processes import until
from palpd.tick import PROGRAM_PLAYING, Phase

WAY_M = 0.02
UP_M_PER_S = 0.02


class Push(Script):
    """Go down and up again."""

    def __init__(self, arm: ArmGeometry, speed_m_per_s: float) -> None:
        super().__init__(arm)
        self._speed_m_per_s = speed_m_per_s

    def run(self) -> Steps:
        """Down and up."""
        self.note(floor_z_m=self.home[2] - WAY_M - 0.001)
        self.note(phase=Phase.PRESS)
        while self.observation.robot.target_pose[2] > self.home[2] - WAY_M:
            yield from self.move(vz_m_per_s=-self._speed_m_per_s)
        self.note(phase=Phase.RETRACT)
        while self.observation.robot.target_pose[2] < self.home[2]:
            yield from self.move(vz_m_per_s=UP_M_PER_S)
        self.note(phase=Phase.BASELINE)
        yield from self.wait(0.1)


@dataclass(frozen=True)
class PushOutcome:
    """Outcome of a push, and every tick as a row (ROW)."""

    outcome: Outcome
    rows: NDArray[np.void]


class DirectCell:
    """An opened cell. `push` may be called again and again, as long as the controller's program lives."""

    def __init__(self, cell: EmulatedCell, config: Config, opened: Devices) -> None:
        self.cell, self.config, self._devices = cell, config, opened
        self._job = Job("palpation", config, Plan())
        explainer = explainer_of(self._job, opened.about, opened.about["delay_s"])
        self._reference = take_reference(opened)
        self._explainer = explainer
        self._ring = Ring.create(config.robot.rate_Hz, seconds=20.0)
        self._home_z_m = opened.robot.read().target_pose[2]

    def push(self, speed_m_per_s: float) -> PushOutcome:
        """Push from home until the guard or the script ends it; the arm stays where that is."""
        explainer = Explainer(
            self._reference, self._explainer.rotation_about_flange_z_rad, motion=self._explainer.motion, tare=self._reference
        )
        script = Push(arm_geometry_of(self._job, self._devices.about["delay_s"]), speed_m_per_s)
        robot, sensor = self._robot, self._devices.sensor
        clock = RealClock(self.config.robot.rate_Hz, self._devices.first_tick_s)
        loop = Loop(robot, sensor, clock, Sequence(script), explainer, limits_of(self.config), RingWriter(self._ring))
        first = self._ring.published
        with realtime():
            loop.rehearse()
            self._play()
            robot.move((0.0, 0.0, 0.0))
            clock.begin_soon()
            sensor.read()
            try:
                outcome = loop.run()
            except Stopped as stopped:
                outcome = Outcome("stopped", str(stopped), trips=loop.outcome.trips)
        rows, _, _ = self._ring.read(first)
        return PushOutcome(outcome, rows)

    def home(self) -> None:
        """Go up to where it began, unguarded: nothing is above."""
        robot = self._robot
        self._play()
        while robot.read().target_pose[2] < self._home_z_m:
            robot.move((0.0, 0.0, UP_M_PER_S))
            time.sleep(0.004)
        robot.stop()
        time.sleep(0.15)

    def _play(self) -> None:
        """Between two pushes nobody feeds the controller's watchdog, so its program is uploaded again."""
        robot, control = self._robot, self._robot._control  # noqa: SLF001 - a run of palpd begins in a new process instead
        if robot.read().runtime_state != PROGRAM_PLAYING:
            control.reuploadScript()
            until(lambda: robot.read().runtime_state == PROGRAM_PLAYING and control.isProgramRunning(), "the program plays")
            robot.arm()

    @property
    def _robot(self) -> UrRobot:
        assert isinstance(self._devices.robot, UrRobot)
        return self._devices.robot

    def close(self) -> None:
        """Let go of everything."""
        self._robot.close()
        self._devices.sensor.close()
        self._ring.close()


@contextmanager
def opened(cell: EmulatedCell) -> Iterator[DirectCell]:
    """The cell as its configuration says."""
    config = load_config(cell.config)
    fifo(DEVICE_PRIORITY)
    try:
        devices_of_cell = devices(config, False)
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    direct = DirectCell(cell, config, devices_of_cell)
    try:
        yield direct
    finally:
        direct.close()
