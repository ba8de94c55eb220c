"""The two rigs as MuJoCo models: a vertical slide, and a six-axis arm with the UR5's lengths; below both the same tool."""

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from scipy.interpolate import CubicSpline

from palpd.blind.mujoco.servos import setpoint
from palpd.blind.mujoco.setup import Array, GRAVITY_m_per_s2, PlantSetup

UR5_DH = (
    (0.089159, 0.0, np.pi / 2), (0.0, -0.425, 0.0), (0.0, -0.39225, 0.0), (0.10915, 0.0, np.pi / 2), (0.09465, 0.0, -np.pi / 2),
    (0.0823, 0.0, 0.0),
)  # fmt: skip
"""d, a, alpha of the UR5's joints (Universal Robots, DH parameters of the CB-series)."""
LINK_MASS_kg = (3.7, 8.393, 2.33, 1.219, 1.219, 0.1879)
"""Link masses of the same table."""
JOINT_FRICTION_Nm = (0.08, 0.08, 0.06, 0.01, 0.01, 0.01)
"""Coulomb friction that the controller's compensation leaves: the whole 5 to 10 Nm would move the tip by tens of micrometres."""
JOINT_DAMPING_Nm_s = (2.0, 2.0, 1.5, 0.3, 0.3, 0.3)
"""Viscous friction of the joints."""
ARMATURE_m2 = 0.2
"""Reflected inertia of a big joint per moving mass: more than a UR5's, because a stiff loop stands for the missing integral action."""
ARM_BASE_BELOW_SURFACE_m = 0.15
WRIST_SHARE = 0.08
"""Reflected inertia of a wrist joint relative to that of a big joint: smaller motors, the same gear ratio."""
LOOSE_MASS_kg = 0.02
"""Mass of the plate between a loose screw's stops."""
HARD = 'solref="0.004 1" solimp="0.999 0.999 0.001"'
"""Constraint parameters of what should be nearly rigid at a 1 ms step."""


@dataclass(frozen=True)
class RigModel:
    """A compiled rig, its state at the start, and the targets of its actuators for a height and a speed of the tip."""

    model: Any
    start_position: Array
    joint_heights: CubicSpline | None
    lead_s: Array
    lead_s2: Array

    def controls(self, plant: PlantSetup, t_s: Array, z_cmd_m: Array) -> Array:
        """Targets of the position loops, with the feed-forward that takes the loops' own lag away.

        Args:
            plant: gives the servo design.
            t_s: (n,) times, s.
            z_cmd_m: (n,) commanded height, m.

        Returns:
            (n, actuators) targets in m or rad.
        """
        height, speed, acceleration = (column[:, None] for column in setpoint(plant, t_s, z_cmd_m))
        if self.joint_heights is None:
            position, rate, second = height - z_cmd_m[0], speed, acceleration
        else:
            angles = self.joint_heights
            position, slope = angles(height[:, 0]), angles(height[:, 0], 1)
            rate, second = slope * speed, slope * acceleration + angles(height[:, 0], 2) * speed**2
        return np.ascontiguousarray(position + rate * self.lead_s + second * self.lead_s2)


def build(plant: PlantSetup, z_cmd_m: Array) -> RigModel:
    """Compile the rig of a plant, with the tip at the first commanded height.

    Args:
        z_cmd_m: (n,) commanded height, m; its range is where the arm's inverse kinematics must hold.
    """
    return _slide(plant, float(z_cmd_m[0])) if plant.rig == "slide" else _arm(plant, z_cmd_m)


# The integrator is explicit on purpose: with implicit damping the force sensor would read an acceleration that is not integrated.
def _compiled(plant: PlantSetup, robot: str, actuators: str, tip_z_m: float, tip_x_m: float = 0.0, tip_y_m: float = 0.0) -> Any:
    world, equality, tendon = _surroundings(plant, tip_x_m, tip_y_m, tip_z_m)
    table = plant.table
    open_table, close_table = '<body name="base">', "</body>"
    if table is not None:
        omega = 2 * np.pi * table.frequency_Hz
        open_table = (
            f'<body name="base" gravcomp="1"><joint name="table" type="slide" axis="0 0 1" stiffness="{table.mass_kg * omega**2}" '
            f'damping="{2 * table.damping_ratio * omega * table.mass_kg}"/>'
            f'<inertial pos="0 0 0" mass="{table.mass_kg}" diaginertia="1 1 1"/>'
        )
    text = f"""<mujoco><compiler angle="radian" autolimits="true"/>
<option timestep="{plant.step_s}" integrator="Euler" gravity="0 0 -{GRAVITY_m_per_s2}" iterations="20" tolerance="1e-10">
<flag eulerdamp="disable" midphase="disable" {"" if plant.engine_contact else 'contact="disable"'}/></option>
<default><geom contype="0" conaffinity="0"/></default>
<worldbody>{world}{open_table}{robot}{close_table}</worldbody>
<equality>{equality}</equality><tendon>{tendon}</tendon><actuator>{actuators}</actuator>
<sensor><force site="sensor"/><torque site="sensor"/><framepos objtype="site" objname="tip"/>
<framepos objtype="site" objname="flange" reftype="body" refname="base"/>
<framelinvel objtype="site" objname="flange" reftype="body" refname="base"/>{_extra_sensors(plant)}</sensor></mujoco>"""
    return mujoco.MjModel.from_xml_string(text)


def _extra_sensors(plant: PlantSetup) -> str:
    return '<jointpos joint="dashpot"/>' if plant.dashpot is not None else ""


def _surroundings(plant: PlantSetup, x_m: float, y_m: float, tip_z_m: float) -> tuple[str, str, str]:
    """What stands beside the robot: a cable, a dashpot, a floor for the engine's contact; the equalities and tendons of those."""
    world, equality, tendon = "", "", ""
    if (cable := plant.cable) is not None:
        z = tip_z_m + plant.tip_length_m / 2
        world += (
            f'<body name="cable" pos="{x_m} {y_m} {z}" gravcomp="1"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>'
            f'<joint name="cable" type="slide" axis="0 0 1" stiffness="{cable.stiffness_N_per_m}" damping="{cable.viscous_N_s_per_m}" '
            f'frictionloss="{cable.friction_N}" solreffriction="0.004 1" solimpfriction="0.999 0.999 0.001"/>'
            '<site name="cable"/><inertial pos="0 0 0" mass="0.005" diaginertia="1e-6 1e-6 1e-6"/></body>'
        )
        equality += f'<connect site1="cable" site2="clamp" {HARD}/>'
        if cable.snag_stiffness_N_per_m > 0:
            free = cable.snag_z_m - tip_z_m
            tendon += (
                f'<fixed name="snag" stiffness="{cable.snag_stiffness_N_per_m}" springlength="{free} 10">'
                '<joint joint="cable" coef="1"/></fixed>'
            )
    if plant.backlash_m > 0:
        world += f'<site name="guide" pos="{x_m} {y_m} {tip_z_m + 1.5}"/>'
        tendon += (
            f'<spatial name="guide" frictionloss="{plant.guide_friction_N}" solreffriction="0.004 1" solimpfriction="0.9999 0.9999 0.001">'
            '<site site="guide"/><site site="play"/></spatial>'
        )
    if (dashpot := plant.dashpot) is not None:
        damping = dashpot.stiffness_N_per_m * dashpot.tau_s
        mass = 2 * plant.step_s * damping  # lets the explicit integrator follow; it delays the arm by two steps
        world += (
            f'<body name="dashpot" pos="{x_m} {y_m + 0.1} {plant.surface_z_m}" gravcomp="1">'
            f'<joint name="dashpot" type="slide" axis="0 0 1" '
            f'damping="{damping}"/><inertial pos="0 0 0" mass="{mass}" diaginertia="1e-6 1e-6 1e-6"/></body>'
        )
    if plant.engine_contact:
        world += (
            f'<geom name="floor" type="plane" size="1 1 0.1" pos="0 0 {plant.surface_z_m}" contype="1" conaffinity="1" condim="1" '
            f'priority="1" solimp="{ENGINE_IMPEDANCE[0]} {ENGINE_IMPEDANCE[1]} {ENGINE_WIDTH * plant.deepest_m} 0.0001 {ENGINE_POWER}"/>'
        )
    return world, equality, tendon


ENGINE_IMPEDANCE = (1.0e-4, 2.08e-4)
"""Least and largest impedance: as small as the engine allows, so that the tip's own acceleration hardly changes the force."""
ENGINE_WIDTH, ENGINE_POWER, ENGINE_SCALE = 20.0, 29.0, 1.283
"""Width (in deepest depths), power and scale for which k r d²/(1 - d) comes nearest to r^1.5 (fitted)."""


def engine_stiffness_per_s2(model: Any, plant: PlantSetup, deepest_m: float) -> float:
    """Stiffness (`solref`) that gives the engine's contact Hertz' force at the deepest depth.

    Source: MuJoCo manual, Computation, Constraint model: f = (a_ref - a) d / ((1 - d) A), a_ref = k d r / d_max².

    Args:
        model: the compiled rig.
        plant: gives the Hertz factor.
        deepest_m: depth of the deepest press, m.

    Returns:
        The stiffness, 1/s².
    """
    inverse_mass = float(model.body_invweight0[model.body("tip").id, 0])
    return ENGINE_SCALE * plant.hertz_N_per_m15 * deepest_m**0.5 * inverse_mass


def _tool(plant: PlantSetup, orientation: str = "") -> str:
    """Flange, whatever gives way below it, sensor and probe, in a frame parallel to the base."""
    length = plant.tip_length_m
    opened, closed = f'<body name="tool" {orientation}><site name="flange" pos="0 0 {-length}"/>', "</body>"
    if plant.backlash_m > 0:
        half = plant.backlash_m / 2
        opened += (
            f'<body name="play" gravcomp="1"><joint name="play" type="slide" axis="0 0 1" range="{-half} {half}" damping="5" '
            'solreflimit="0.004 1" solimplimit="0.99 0.99 0.001"/><inertial pos="0 0 0" mass="0.5" diaginertia="1e-3 1e-3 1e-3"/>'
            '<site name="play"/>'
        )
        closed += "</body>"
    if plant.loose_gap_m > 0:
        opened += (
            f'<body name="loose" gravcomp="{_carried(plant)}"><joint name="loose" type="slide" axis="0 0 1" '
            f'range="0 {plant.loose_gap_m}" damping="3" '
            f"{HARD.replace('solref', 'solreflimit').replace('solimp', 'solimplimit')}/>"
            f'<inertial pos="0 0 0" mass="{LOOSE_MASS_kg}" diaginertia="1e-5 1e-5 1e-5"/>'
        )
        closed += "</body>"
    if plant.tip_stiffness_N_per_m is not None:
        stiffness = plant.tip_stiffness_N_per_m
        damping = 2 * 0.3 * np.sqrt(stiffness * plant.mass_kg)
        opened += (
            f'<body name="mount" gravcomp="1"><joint name="mount" type="slide" axis="0 0 1" stiffness="{stiffness}" damping="{damping}"/>'
            '<inertial pos="0 0 0" mass="0.02" diaginertia="1e-5 1e-5 1e-5"/>'
        )
        closed += "</body>"
    return opened + _probe(plant, _carried(plant) if plant.loose_gap_m > 0 else 1.0) + closed


def _carried(plant: PlantSetup) -> float:
    """Share of the weight below a loose screw that does not pull on it."""
    return 1.0 - plant.loose_weight_N / (GRAVITY_m_per_s2 * (plant.mass_kg + LOOSE_MASS_kg))


def _probe(plant: PlantSetup, compensated: float) -> str:
    """The sensor and what hangs on it; a tilt turns both about the tip, so that the tip stays where the user zeroed it."""
    length, azimuth, angle = plant.tip_length_m, plant.tilt_azimuth_rad, -plant.tilt_rad
    axis = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    half = np.sin(angle / 2)
    quaternion = f"{np.cos(angle / 2)} {half * axis[0]} {half * axis[1]} 0"
    x, y = length * np.sin(angle) * np.array([np.cos(azimuth), np.sin(azimuth)])
    ring, rigid, share = "", plant.mass_kg, plant.ring
    if share is not None:
        rigid = plant.mass_kg * (1 - share.participation)
        mass, omega = plant.mass_kg * share.participation, 2 * np.pi * share.frequency_Hz
        ring = (
            f'<body name="ring" gravcomp="1"><joint name="ring" type="slide" axis="0 0 1" stiffness="{mass * omega**2}" '
            f'damping="{2 * share.damping_ratio * omega * mass}"/><inertial pos="0 0 {-length / 2}" mass="{mass}" '
            'diaginertia="1e-5 1e-5 1e-5"/></body>'
        )
    contact = 'contype="1" conaffinity="1" condim="1"' if plant.engine_contact else ""
    return (
        f'<body name="probe" gravcomp="{compensated}" pos="{x} {y} {length * (np.cos(angle) - 1)}" quat="{quaternion}">'
        f'<site name="sensor"/><site name="clamp" pos="0 0 {-length / 2}"/><inertial pos="0 0 {-length / 2}" mass="{rigid}" '
        f'diaginertia="1e-4 1e-4 1e-5"/>{ring}'
        f'<body name="tip" gravcomp="1" pos="0 0 {-length}"><site name="tip"/>'
        '<inertial pos="0 0 0" mass="1e-6" diaginertia="1e-9 1e-9 1e-9"/>'
        f'<geom type="sphere" size="{plant.tip_radius_m}" pos="0 0 {plant.tip_radius_m}" {contact}/></body></body>'
    )


def _slide(plant: PlantSetup, tip_z_m: float) -> RigModel:
    carriage = 5.0
    kp, kv, lag_s = _gains(plant, plant.moving_mass_kg)
    robot = (
        f'<body name="carriage" gravcomp="1" pos="0 0 {tip_z_m + plant.tip_length_m}"><joint name="axis" type="slide" axis="0 0 1" '
        f'armature="{plant.moving_mass_kg - carriage}" damping="20"/>'
        f'<inertial pos="0 0 0" mass="{carriage}" diaginertia="0.1 0.1 0.1"/>{_tool(plant)}</body>'
    )
    actuators = f'<position name="axis" joint="axis" kp="{kp}" kv="{kv}" timeconst="{plant.servo.drive_filter_s}"/>'
    model = _compiled(plant, robot, actuators, tip_z_m)
    return RigModel(model, np.zeros(model.nq), None, np.array([lag_s + 20.0 / kp]), np.array([_second_lead_s2(plant)]))


def _gains(plant: PlantSetup, inertia: float, damping_ratio: float = 1.0) -> tuple[float, float, float]:
    """Gains of a position loop, and its lag at constant speed in s."""
    omega = 2 * np.pi * plant.servo.inner_frequency_Hz
    kp, kv = inertia * omega**2, 2 * damping_ratio * omega * inertia
    return kp, kv, kv / kp + plant.servo.drive_filter_s


def _second_lead_s2(plant: PlantSetup) -> float:
    """The second coefficient of a position loop's delay, in s²: of its inertia, and of drive filter and damping together."""
    omega = 2 * np.pi * plant.servo.inner_frequency_Hz
    return float(1 / omega**2 + plant.servo.drive_filter_s * 2 / omega)


def _arm(plant: PlantSetup, z_cmd_m: Array) -> RigModel:
    big = plant.moving_mass_kg * ARMATURE_m2
    inertias = [big, big, big, WRIST_SHARE * big, WRIST_SHARE * big, WRIST_SHARE * big]
    reach = np.array([1.8, 2.2, 0.6, 0.02, 0.01, 0.003])
    gains = [_gains(plant, armature + own) for armature, own in zip(inertias, reach, strict=True)]
    body, closing = "", ""
    for joint, (_, _, _) in enumerate(UR5_DH):
        d, a, alpha = UR5_DH[joint - 1] if joint else (0.0, 0.0, 0.0)
        next_d, next_a, _ = UR5_DH[joint]
        x, y, z = next_a / 2, 0.0, next_d / 2
        base = f"0 0 {plant.surface_z_m - ARM_BASE_BELOW_SURFACE_m}" if joint == 0 else f"{a} 0 {d}"
        body += (
            f'<body name="link{joint}" gravcomp="1" pos="{base}" quat="{np.cos(alpha / 2)} {np.sin(alpha / 2)} 0 0">'
            f'<joint name="q{joint}" axis="0 0 1" armature="{inertias[joint]}" damping="{JOINT_DAMPING_Nm_s[joint]}" '
            f'frictionloss="{JOINT_FRICTION_Nm[joint]}" solimpfriction="0.99 0.99 0.001"/>'
            f'<inertial pos="{x} {y} {z}" mass="{LINK_MASS_kg[joint]}" diaginertia="{_link_inertia(joint)}"/>'
        )
        closing += "</body>"
    actuators = "".join(
        f'<position joint="q{joint}" kp="{kp}" kv="{kv}" timeconst="{plant.servo.drive_filter_s}"/>'
        for joint, (kp, kv, _) in enumerate(gains)
    )
    tool = _tool(plant, f'pos="0 0 {UR5_DH[5][0]}" quat="0 1 0 0"')
    tip_z = float(z_cmd_m[0])
    bare = mujoco.MjModel.from_xml_string(
        f'<mujoco><compiler angle="radian"/><worldbody>{body}<site name="goal" pos="0 0 {UR5_DH[5][0]}"/>{closing}</worldbody></mujoco>'
    )
    heights, joints, place = _inverse_kinematics(bare, z_cmd_m, plant.tip_length_m)
    spline = CubicSpline(heights, joints)
    model = _compiled(plant, body + tool + closing, actuators, tip_z, place[0], place[1])
    start = np.zeros(model.nq)
    for joint, angle in enumerate(spline(tip_z)):
        start[model.joint(f"q{joint}").qposadr[0]] = angle
    lead = np.array([lag + JOINT_DAMPING_Nm_s[joint] / kp for joint, (kp, _, lag) in enumerate(gains)])
    return RigModel(model, start, spline, lead, np.full(6, _second_lead_s2(plant)))


def _link_inertia(joint: int) -> str:
    """Diagonal inertia of a rod along its link."""
    d, a, _ = UR5_DH[joint]
    mass, length = LINK_MASS_kg[joint], max(abs(a), abs(d))
    across, along = mass * (length**2 / 12 + 0.05**2 / 4), mass * 0.05**2 / 2
    return f"{along} {across} {across}" if abs(a) > abs(d) else f"{across} {across} {along}"


DOWN = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
"""Orientation of the flange with the tool straight down."""


def _inverse_kinematics(bare: Any, z_cmd_m: Array, tip_length_m: float) -> tuple[Array, Array, Array]:
    """Joint angles along the vertical line that keeps the tool straight down: heights (m,), angles (m, 6), and the line's place (2,)."""
    data, site = mujoco.MjData(bare), bare.site("goal").id
    low, high = float(z_cmd_m.min()) - 0.002, float(z_cmd_m.max()) + 0.002
    heights, place = np.linspace(low, high, 25), np.array([-0.49, -0.11])
    q, solutions = np.array([0.0, -1.6, 1.9, -1.9, -1.57, 0.0]), []
    jacobian = np.zeros((6, bare.nv))
    for height in heights:
        goal = np.array([place[0], place[1], height + tip_length_m])
        for _ in range(60):
            data.qpos[:] = q
            mujoco.mj_kinematics(bare, data)
            mujoco.mj_comPos(bare, data)
            turn = DOWN @ data.site_xmat[site].reshape(3, 3).T
            vector = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
            error = np.concatenate([goal - data.site_xpos[site], vector])
            if np.abs(error).max() < 1e-11:
                break
            mujoco.mj_jacSite(bare, data, jacobian[:3], jacobian[3:], site)
            q = q + np.clip(np.linalg.solve(jacobian + 1e-9 * np.eye(6), error), -0.3, 0.3)
        else:
            raise RuntimeError(
                f"the arm's inverse kinematics left {np.abs(error).max():.1e} at {height:.3f} m; choose a height in its reach."
            )
        solutions.append(q.copy())
    return heights, np.array(solutions), place
