"""The cell of this folder in MuJoCo: what the engine does itself, and one callback for the rest.

    model = mujoco.MjModel.from_xml_path("cell.xml")
    data = mujoco.MjData(model)
    start(model, data)                            # the probe at rest above the tissue
    while data.time < 5.0:
        data.ctrl[0] = 0.0                        # commanded height of the tip in m
        mujoco.mj_step(model, data)
        data.sensor("fz_N").data[0]               # what the force sensor reads, as in a recording

`start(model, data, draw=3)` takes the third drawn cell. A reset of `data` begins a new recording. From a shell:

    python palpd_cell.py motion.csv --csv rollout.csv

The engine has the servo (an actuator), the probe's mass and inertia, the force sensor, and where it is exact the sensor's delay and
the limit of its range. The callback gives the contact force (`xfrc_applied` of the body `probe`), and makes of the engine's force
sensor what the cell's sensor reads. MuJoCo has one sensor callback a process, and `start` takes it.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from palpd.cell.stepped import MovedCell
from palpd.interchange.simulators.exported_cell import (
    COLUMNS,
    at_rows,
    cell_of,
    chosen,
    physics_of,
    read_cells,
    roll_out_file,
    row_times,
)

HERE = Path(__file__).resolve().parent
SEEN = 0.6
"""Opacity of the tissue once it is there."""


class CellInMujoco:
    """A cell whose tip MuJoCo moves.

    Attributes:
        constants: Numbers of the cell, those included that the engine has.
        cell: What the callback steps, without what the engine does itself.
    """

    def __init__(self, model: Any, numbers: dict[str, Any], noise_seed: int | None = None) -> None:
        """Put the numbers of a cell into a model.

        Args:
            model: A model of `cell.xml`; its actuator, mass and sensors change.
            numbers: One cell of `cells.json`.
            noise_seed: Seed of noise and rounding; neither without one.

        Raises:
            ValueError: The model's time step is too short for its buffer of late readings.
        """
        what = physics_of(numbers)
        c = self.constants = what.constants
        # The engine delays its own force sensor, by one step or more, and limits the last value: right where nothing else comes before,
        # or after.
        engine_delays = c.delay_s >= model.opt.timestep and c.skew == 0.0 and not {"robot", "probe", "clock"} & set(what.laws)
        engine_limits = np.isfinite(c.limit_N) and c.step_N == 0.0 and noise_seed is None
        mine = replace(c, delay_s=0.0 if engine_delays else c.delay_s, limit_N=np.inf if engine_limits else c.limit_N)
        self.cell: MovedCell = cell_of(numbers, replace(what, constants=mine), noise_seed)
        self._timestep_s, self._late = model.opt.timestep, engine_delays
        self._joint, self._probe = model.joint("slide"), model.body("probe").id
        self._force = model.sensor("force_on_sensor")
        self._columns = [model.sensor(name).adr[0] for name in COLUMNS]
        omega = 2.0 * np.pi * c.servo_natural_frequency_Hz
        model.body_mass[self._probe] = max(c.mass_kg, 1e-9)
        moved_kg = float(model.dof_armature[self._joint.dofadr[0]]) + float(model.body_mass[self._probe])
        servo = model.actuator("servo").id
        model.actuator_gainprm[servo, 0] = moved_kg * omega**2
        model.actuator_biasprm[servo, :3] = 0.0, -moved_kg * omega**2, -2.0 * c.servo_damping_ratio * omega * moved_kg
        samples = int(model.sensor_history[self._force.id, 0])
        if engine_delays and c.delay_s / model.opt.timestep + 2.0 > samples:
            raise ValueError(f"the time step is {model.opt.timestep} s, so {samples} readings do not hold a delay of {c.delay_s:.3g} s")
        model.geom("tissue").rgba[3] = SEEN
        model.sensor_delay[self._force.id] = c.delay_s if engine_delays else 0.0
        model.sensor_cutoff[model.sensor("fz_N").id] = c.limit_N if engine_limits else 0.0
        self._last_s = np.inf

    def push(self, model: Any, data: Any) -> None:
        """Let the tissue push the probe.

        Args:
            data: Its state, with heights and speeds.
        """
        if data.time < self._last_s:
            self.cell.restart()
            self._begin_s = self._last_s = data.time
        dt_s = data.time - self._last_s
        self._last_s = data.time
        if dt_s > 0.0:
            self._timestep_s = dt_s
        z_m, v = float(data.qpos[self._joint.qposadr[0]]), float(data.qvel[self._joint.dofadr[0]])
        omega, damping = 2.0 * np.pi * self.constants.servo_natural_frequency_Hz, self.constants.servo_damping_ratio
        a = omega**2 * (float(data.ctrl[0]) - z_m) - 2.0 * damping * omega * v
        contact_N = self.cell.touch(data.time - self._begin_s, self._timestep_s, (z_m, v, a))
        data.xfrc_applied[self._probe] = 0.0, 0.0, contact_N, 0.0, 0.0, 0.0
        if self._late and data.time == self._begin_s:  # before the first sample the sensor read the same
            fz_N = np.zeros((int(model.sensor_history[self._force.id, 0]), 3))
            fz_N[:, 2] = -self.cell.expected_fz_N
            mujoco.mj_initSensorHistory(model, data, self._force.id, None, fz_N, 0.0)

    def read(self, data: Any) -> None:
        """Make of the engine's force sensor what the cell's robot and sensor report.

        Args:
            data: The state, with forces.
        """
        first = self._late and data.time == self._begin_s
        fz_N = self.cell.expected_fz_N if first else -float(data.sensordata[self._force.adr[0] + 2])
        data.sensordata[self._columns] = self.cell.read(fz_N)


_ACTING: dict[int, CellInMujoco] = {}
"""The cell that acts on each state."""


def _key(data: Any) -> int:
    address: int = data._address  # noqa: SLF001 (the callback gets another Python object for the same state)
    return address


def _callback(model: Any, data: Any, stage: int) -> None:
    cell = _ACTING.get(_key(data))
    if cell is not None and stage == mujoco.mjtStage.mjSTAGE_VEL:
        cell.push(model, data)
    elif cell is not None and stage == mujoco.mjtStage.mjSTAGE_ACC:
        cell.read(data)


def start(model: Any, data: Any, *, draw: int = 0, z_m: float | None = None, noise_seed: int | None = None) -> CellInMujoco:
    """Reset a state and let a cell of this folder act on it.

    Args:
        model: A model of `cell.xml`.
        draw: 0 for the exported cell, k for the k-th drawn one.
        z_m: Height of the tip; that of the model's key frame where not given.
        noise_seed: Seed of noise and rounding; neither without one.
    """
    cell = CellInMujoco(model, chosen(read_cells(HERE / "cells.json"), draw), noise_seed)
    mujoco.mj_setConst(model, data)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    if z_m is not None:
        data.qpos[0] = data.ctrl[0] = z_m
    _ACTING[_key(data)] = cell
    mujoco.set_mjcb_sensor(_callback)
    return cell


def rollout(t_s: np.ndarray, z_cmd_m: np.ndarray, *, draw: int = 0, noise_seed: int | None = None) -> np.ndarray:
    """What a cell of this folder reports while it follows commanded heights.

    Args:
        t_s: Times (n,) in s, from 0.
        z_cmd_m: Commanded heights (n,) in m, straight between their times.
        draw: 0 for the exported cell, k for the k-th drawn one.
        noise_seed: Seed of noise and rounding; neither without one.

    Returns:
        Values (n, 8) of COLUMNS.
    """
    model = mujoco.MjModel.from_xml_path(str(HERE / "cell.xml"))
    data = mujoco.MjData(model)

    def follow(_model: Any, now: Any) -> None:
        now.ctrl[0] = np.interp(now.time, t_s, z_cmd_m)

    start(model, data, draw=draw, z_m=float(z_cmd_m[0]), noise_seed=noise_seed)
    rows_s = row_times(t_s, chosen(read_cells(HERE / "cells.json"), draw))
    steps = int(np.ceil(rows_s[-1] / model.opt.timestep - 1e-6)) + 1
    times_s, values = np.empty(steps), np.empty((steps, len(COLUMNS)))
    address = [model.sensor(name).adr[0] for name in COLUMNS]
    mujoco.set_mjcb_control(follow)  # the engine asks for the command between its steps, too
    try:
        for k in range(steps):
            follow(model, data)
            times_s[k] = data.time
            mujoco.mj_step(model, data)
            values[k] = data.sensordata[address]
    finally:
        mujoco.set_mjcb_control(None)
        mujoco.set_mjcb_sensor(None)
        _ACTING.pop(_key(data))
    return at_rows(rows_s, times_s, values, noisy=noise_seed is not None)


if __name__ == "__main__":
    roll_out_file(rollout)
