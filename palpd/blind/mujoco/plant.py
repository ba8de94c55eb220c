"""One simulation: the engine steps the rig, and the tissue's force acts at the tip (docs/reference/contract.md §3)."""

from typing import Any

import mujoco
import numpy as np

from palpd.blind.mujoco.rigs import build, engine_stiffness_per_s2
from palpd.blind.mujoco.setup import Array, LateralTerm, PlantRun, PlantSetup, PressPath

LEAD_S = 0.5
"""Time that the rig settles before the recording starts; the sensor is tared at its end."""
TAIL_S = 0.15
"""Time that the simulation runs on, so that a fast sensor clock finds something to read."""
TIP_Z, REPORTED_Z, REPORTED_VZ, DASHPOT = 8, 11, 14, 15
"""Places of these in MuJoCo's sensor data: force, torque, tip, flange height, flange speed, dashpot."""


def simulate(plant: PlantSetup, path: PressPath) -> PlantRun:
    """Run the plant along a commanded motion.

    Args:
        plant: the mechanics.
        path: the commanded motion and the scatter of its presses.

    Returns:
        What the plant did, tared where the recording starts, from LEAD_S before it to TAIL_S after it.

    Raises:
        FloatingPointError: MuJoCo's state did not stay finite.
    """
    step = plant.step_s
    t = np.arange(-round(LEAD_S / step), round((path.t_s[-1] + TAIL_S) / step) + 1) * step
    z_cmd = np.interp(t, path.t_s, path.z_cmd_m)
    rig = build(plant, z_cmd)
    data = mujoco.MjData(rig.model)
    data.qpos[:] = rig.start_position
    controls = rig.controls(plant, t, z_cmd)
    if plant.loose_gap_m > 0:  # the controller compensates the payload that hangs in the gap
        data.xfrc_applied[rig.model.body("tool").id, 2] = plant.loose_weight_N
    if rig.model.na:
        data.act[:] = controls[0]
    log = np.empty((len(t), rig.model.nsensordata))
    _step_through(rig.model, data, plant, path, t, controls, log)
    if not np.isfinite(log).all():
        raise FloatingPointError(
            "MuJoCo's state did not stay finite and every height must be a number; take a smaller step or softer parameters."
        )
    zero = round(LEAD_S / step)
    wrench = -(log[:, :6] - log[zero, :6])
    height = log[:, REPORTED_Z]
    return PlantRun(t, height, log[:, REPORTED_VZ], log[:, TIP_Z], wrench)


def _step_through(model: Any, data: Any, plant: PlantSetup, path: PressPath, t: Array, controls: Array, log: Array) -> None:
    """The loop over the physics steps; everything that can be is computed before it."""
    press = path.press_of(t)
    surface_z = plant.surface_z_m + path.surface_m[press] + sum(motion(path, t) for motion in plant.surface_motions)
    surface: list[float] = np.broadcast_to(surface_z, t.shape).tolist()
    stiffness: list[float] = (plant.hertz_N_per_m15 * (1 + path.stiffness[press])).tolist()
    floor = _EngineFloor(model, plant, surface, stiffness) if plant.engine_contact else None
    changes = set(np.flatnonzero(np.diff(press, prepend=-1)).tolist()) if floor else set()
    forces = [make(path, t) for make in plant.force_terms]
    shifts = [make(path, t) for make in plant.shift_terms]
    probe_terms = [make(path, t) for make in plant.probe_terms]
    lateral: LateralTerm | None = plant.lateral(path, t) if plant.lateral else None
    knocks = plant.knocks(path, t) if plant.knocks else None
    at_tip, at_probe = data.xfrc_applied[model.body("tip").id], data.xfrc_applied[model.body("probe").id]
    dashpot = plant.dashpot
    at_dashpot = data.xfrc_applied[model.body("dashpot").id] if dashpot is not None else None
    ctrl, sensed, mj_step1, mj_step2, busy = data.ctrl, data.sensordata, mujoco.mj_step1, mujoco.mj_step2, bool(forces or dashpot)
    touching = False
    for i in range(len(t)):
        if floor is not None and i in changes:
            floor.lay(i)
        ctrl[:] = controls[i]
        mj_step1(model, data)
        z = sensed[TIP_Z]
        depth = surface[i] - z
        for shift in shifts:
            depth += shift(z, i)
        if floor is None and (depth > 0.0 or busy or touching):
            touching = depth > 0.0
            force = stiffness[i] * depth * depth**0.5 if touching else 0.0
            for term in forces:
                force = term(force, depth, i)
            if dashpot is not None and at_dashpot is not None:
                pull = dashpot.stiffness_N_per_m * (max(depth, 0.0) + sensed[DASHPOT])
                at_dashpot[2] = -pull
                force = max(0.0, force + pull) if touching else 0.0
            at_tip[2] = force
            if lateral is not None:
                at_tip[0], at_tip[1] = lateral(force, i)
        if knocks is not None:
            at_probe[:3] = knocks[i]
        if probe_terms:
            push = sum(term(z, sensed[REPORTED_VZ], i) for term in probe_terms)
            at_probe[2] = push if knocks is None else push + at_probe[2]
        mj_step2(model, data)
        log[i] = sensed


class _EngineFloor:
    """The engine's own contact surface, laid afresh for every press with the height and the stiffness of that press."""

    def __init__(self, model: Any, plant: PlantSetup, surface: list[float], stiffness: list[float]) -> None:
        self.model, self.geom, self.surface = model, model.geom("floor").id, surface
        full = engine_stiffness_per_s2(model, plant, plant.deepest_m)
        self.stiffness = [full * value / plant.hertz_N_per_m15 for value in stiffness]

    def lay(self, step: int) -> None:
        """Set height and stiffness to those of a time step."""
        self.model.geom_pos[self.geom, 2] = self.surface[step]
        self.model.geom_solref[self.geom] = (-self.stiffness[step], -1e-9)
