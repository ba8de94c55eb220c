"""A simulated cell with the loop's two interfaces, without wires and without a clock: each read of the robot lets one tick pass."""

import math

import numpy as np

from palpd.cell.cell_file import CellFile
from palpd.cell.effects import EFFECTS
from palpd.cell.physics import Library
from palpd.cell.stepped import SteppedCell
from palpd.tick import PROGRAM_PLAYING, Floats, RobotMode, RobotState, SafetyMode, SensorFrames

FZ_OFFSET_N = -50.0
"""Offset of the simulated sensor on Fz: a real one that was not zeroed reads tens of newtons."""
HOME_ABOVE_M = 0.03
"""Height above the surface at which the arm begins by default."""


class SimCell:
    """Advances robot, tissue and sensor together, one loop tick at a time. `robot` and `sensor` are its two interfaces to the loop."""

    def __init__(
        self,
        cell: CellFile,
        rate_Hz: float,
        acceleration_m_per_s2: float = 0.5,
        seed: int = 0,
        home_above_m: float = HOME_ABOVE_M,
        library: Library = EFFECTS,
    ) -> None:
        self._cell = SteppedCell(cell, seed=seed, library=library)
        self._steps = round(1000.0 / rate_Hz)
        self._acceleration = acceleration_m_per_s2
        surface_z_m = cell.tissue.surface_z_m if cell.tissue else 0.0
        self._target = np.array([0.0, 0.0, surface_z_m + home_above_m])
        self._speed = np.zeros(3)
        self._commanded = np.zeros(3)
        self._moved = False
        self._ms = 0
        self._resolution = np.array(
            [cell.sensor.resolution_fxy_N] * 2 + [cell.sensor.resolution_fz_N] + [cell.sensor.resolution_Nm] * 3, dtype=float
        )
        self.robot = SimRobot(self)
        self.sensor = SimSensor(self)
        self.advance()

    def advance(self) -> None:
        """Let one tick of time pass."""
        before = self._target.copy()
        change = self._commanded - self._speed
        size = float(np.linalg.norm(change))
        limit = self._acceleration * self._steps * 1e-3
        self._speed = self._speed + (change if size <= limit else change * (limit / size))
        if not self._moved and np.any(self._speed):
            self._moved = True
            self._cell.begin()
        self._target = before + self._speed * self._steps * 1e-3
        share = (np.arange(1, self._steps + 1) / self._steps)[:, None]
        block = self._cell.step(before + share * (self._target - before))
        t_s: Floats = np.arange(self._ms + 1, self._ms + self._steps + 1, dtype=np.float64) * 1e-3
        self._ms += self._steps
        sensor = np.column_stack([block.wrench[:, 0], -block.wrench[:, 1], -block.wrench[:, 2], block.wrench[:, 3], -block.wrench[:, 4:]])
        sensor[:, 2] += FZ_OFFSET_N
        step = np.where(self._resolution > 0, self._resolution, 1e-12)
        wrench: Floats = np.asarray(np.round(sensor / step) * step)
        counters = (np.arange(self._ms - self._steps, self._ms) & 0xFFFF).astype(np.uint16)
        self.frames = SensorFrames(t_s, counters, np.zeros(self._steps, np.uint16), wrench)
        pose = (*block.position_m[-1].tolist(), math.pi, 0.0, 0.0)
        zeros = (0.0, 0.0, 0.0)
        self.state = RobotState(
            float(t_s[-1]), float(t_s[-1]), pose, (*block.velocity_m_per_s[-1].tolist(), *zeros),
            (*self._target.tolist(), math.pi, 0.0, 0.0), (*self._speed.tolist(), *zeros), zeros,
            RobotMode.RUNNING, SafetyMode.NORMAL, 1, PROGRAM_PLAYING, True,
        )  # fmt: skip

    def command(self, velocity_m_per_s: tuple[float, float, float]) -> None:
        """Ramp towards this speed (3,) of the target from now on."""
        self._commanded = np.array(velocity_m_per_s)


class SimRobot:
    """The robot of a SimCell. Each `read` lets one tick pass."""

    def __init__(self, cell: SimCell) -> None:
        self._cell = cell

    def read(self) -> RobotState:
        """The state after one more tick."""
        self._cell.advance()
        return self._cell.state

    def move(self, velocity_m_per_s: tuple[float, float, float]) -> None:
        """Ramp towards this speed (3,)."""
        self._cell.command(velocity_m_per_s)

    def stop(self) -> None:
        """Ramp towards rest."""
        self._cell.command((0.0, 0.0, 0.0))

    def end(self) -> None:
        """Nothing is open."""


class SimSensor:
    """The sensor of a SimCell: the frames of the tick that the last `read` of the robot began."""

    def __init__(self, cell: SimCell) -> None:
        self._cell = cell

    def read(self) -> SensorFrames:
        """The frames of this tick."""
        return self._cell.frames

    def close(self) -> None:
        """Nothing is open."""
