"""A run without wires: `Cell` stands directly behind the loop, faster than real time.

It serves the sequence and the analysis. For bytes, timing and faults there are the emulated wires.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from palpd.cell.cell_file import CellFile
from palpd.cell.effects import EFFECTS
from palpd.cell.simulation import Cell, Library
from palpd.config import filter_delay_s
from palpd.control.loop import Loop, Outcome
from palpd.daemon.clock import SimClock
from palpd.daemon.motion_process import Job, explainer_of, job_limits, sequence_of
from palpd.recording.mcap_file import RecordingHeader
from palpd.recording.tick_rows import RowWriter
from palpd.tick import PROGRAM_PLAYING, ROW, Floats, Request, RobotMode, RobotState, SafetyMode, SensorFrames, TickRecord

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
        self._cell = Cell(cell, seed=seed, library=library)
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


class RowList:
    """Keeps each tick as a row (ROW of palpd.tick)."""

    def __init__(self) -> None:
        self.rows: list[np.void] = []

    def __call__(self, record: TickRecord) -> None:
        """Keep one tick."""
        row = np.zeros(1, ROW)
        RowWriter(row).fill(0, record)
        self.rows.append(row[0])

    def rehearse(self, record: TickRecord) -> None:
        """Keep nothing."""


@dataclass(frozen=True)
class SimulatedRecording:
    """The result of a run without wires: how it ended, its rows (n,) of ROW, and the header's part that the analysis needs."""

    outcome: Outcome
    rows: NDArray[np.void]
    header: RecordingHeader


def run(
    job: Job,
    cell: CellFile,
    *,
    seed: int = 0,
    requests: Mapping[int, Request] = MappingProxyType({}),
    home_above_m: float = HOME_ABOVE_M,
    library: Library = EFFECTS,
) -> SimulatedRecording:
    """Carry out a job on a simulated cell.

    Args:
        job: The job; its reference tare is replaced by that of the simulated sensor.
        cell: The cell to press.
        seed: Seed of the noise.
        requests: What the operator asks, by the number of the tick.
        home_above_m: Height above the surface at which the arm begins.
        library: Effects that the cell file may name.

    Returns:
        The outcome and the rows.
    """
    config = job.config
    rate_Hz, delay_s = config.robot.rate_Hz, filter_delay_s(config.sensor.filter_cutoff_Hz)
    sensor = cell.sensor.model_copy(update={"filter_cutoff_Hz": config.sensor.filter_cutoff_Hz, "rate_Hz": 1000.0})
    sim = SimCell(cell.model_copy(update={"sensor": sensor}), rate_Hz, config.robot.acceleration_m_per_s2, seed, home_above_m, library)
    job = replace(job, reference=(0.0, 0.0, FZ_OFFSET_N, 0.0, 0.0, 0.0))
    record = RowList()
    loop = Loop(
        sim.robot,
        sim.sensor,
        SimClock(rate_Hz),
        sequence_of(job, delay_s),
        explainer_of(job, {}, delay_s),
        job_limits(job),
        record,
        request=lambda: requests.get(len(record.rows), Request.NONE),
    )
    outcome = loop.run()
    model = loop.explainer.model
    poisson = cell.tissue.poisson_ratio if cell.tissue else 0.5
    header: RecordingHeader = {
        "config": config.model_dump(mode="json"),
        "model_card": model.card if model is not None else None,
        "sites": [{"name": site.name, "x_m": site.x_m, "y_m": site.y_m} for site in job.plan.sites],
        "body": {
            "tip_radius_m": config.cell.probe.tip_radius_m,
            "poisson_ratio": poisson,
            "delay_s": delay_s,
            "machine_stiffness_N_per_m": job.machine_stiffness_N_per_m,
        },
    }
    return SimulatedRecording(outcome, np.array(record.rows), header)
