"""A sensor with two slopes of Fz without wires: a simulated run whose readings went through the emulated DAQ."""

from dataclasses import replace

import numpy as np

from hw.emulators.hex_pty import CAPACITY, COUNTS_AT_CAPACITY, Daq, PartsAt
from palpd.cell.cell_file import CellFile
from palpd.control.slopes import FZ, GRAVITY_N_PER_KG
from palpd.daemon.motion_job import Job
from palpd.daemon.sim_cell import FZ_OFFSET_N
from palpd.daemon.simulated_run import SimulatedRecording, run
from palpd.tick import Floats, ForceSensor, SensorFrames

COUNTS_PER_UNIT = np.array(COUNTS_AT_CAPACITY[:6]) / (np.array(CAPACITY[:6]) * [1.0, 1.0, 1.0, 1e-3, 1e-3, 1e-3])
RATIO = COUNTS_AT_CAPACITY[6] / CAPACITY[6] / COUNTS_PER_UNIT[FZ]
"""Ratio of the slope for pulling to the slope for pressing."""


class PartedSensor:
    """A simulated sensor seen through the emulated DAQ: counts by its law, converted with the slope for pressing."""

    def __init__(self, sensor: ForceSensor, law: PartsAt, weight_N: float) -> None:
        self._sensor, self._daq, self._weight_N = sensor, Daq(fz_parts_at=law), weight_N
        self._rest = self._counts(np.zeros((1, 6)))[0]

    def read(self) -> SensorFrames:
        """The frames of this tick."""
        frames = self._sensor.read()
        wrench = frames.wrench.copy()
        wrench[:, FZ] -= FZ_OFFSET_N
        converted = (np.round(self._counts(wrench)) - self._rest) / COUNTS_PER_UNIT
        converted[:, FZ] += FZ_OFFSET_N
        return replace(frames, wrench=converted)

    def close(self) -> None:
        """Nothing is open."""

    def _counts(self, wrench: Floats) -> Floats:
        loaded = wrench.copy()
        loaded[:, FZ] += self._weight_N  # it pulls, and a press is negative
        return self._daq.measure(loaded)


def pressed(job: Job, cell: CellFile, law: PartsAt, mass_kg: float, seed: int) -> SimulatedRecording:
    """Carry out a job without wires on a sensor of that law.

    Args:
        law: Where the slopes of the sensor part: at zero "load", or at a "reading" of zero untared.
        mass_kg: True mass of the probe.

    Raises:
        RuntimeError: The run was stopped.
    """
    exact = cell.sensor.model_copy(update=dict.fromkeys(("resolution_fxy_N", "resolution_fz_N", "resolution_Nm"), 0.0))
    done = run(
        job,
        cell.model_copy(update={"sensor": exact}),
        seed=seed,
        home_above_m=0.012,
        behind=lambda sensor: PartedSensor(sensor, law, mass_kg * GRAVITY_N_PER_KG),
        about={"pulled_over_pressed": RATIO},
    )
    if done.outcome.verdict != "done":
        raise RuntimeError(f"the run on the law {law} was stopped: {done.outcome.reason}")
    return done
