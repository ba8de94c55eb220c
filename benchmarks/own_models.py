"""Ten rigs with simulators of their own, and recordings of the real rigs with one hidden effect or none.

The effects follow the formulas of docs/reference/contract.md, in code of their own. They act inside the rig: on its servo, on the
place of its tip, on its own contact, on its cables, or on its sensor. Everything is deterministic by seed.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline
from scipy.signal import cont2discrete, lfilter, ss2tf

Array = NDArray[np.float64]
WRENCH = ("fx_N", "fy_N", "fz_N", "tx_Nm", "ty_Nm", "tz_Nm")
# Seconds that a real rig runs on after the recording, so that a fast sensor clock has forces to show.
EXTRA_S = 1.0
# Range of the signal-to-noise ratio that a recording aims at.
TARGET_SNR = (75.0, 270.0)
SCATTER_EFFECTS = ("sensor.noise", "sensor.quantization", "sensor.dropout")
ROBOT_EFFECTS = ("robot.lag", "robot.vibration")


# ---------------------------------------------------------------- numerical helpers


def low_pass(values: Array, tau_s: float, dt_s: float, start: float | None = None) -> Array:
    """One-pole low-pass, exact for input that is linear between samples; it starts at `start` (None: at the first value)."""
    decay = np.exp(-dt_s / tau_s)
    share = (1 - decay) * tau_s / dt_s
    new, old = 1 - share, share - decay
    first = values[0] if start is None else start
    return lfilter([new, old], [1, -decay], values, zi=[first - new * values[0]])[0]


def saturating_memory(values: Array, width: float) -> Array:
    """Solution of dw = (1 - w·sign dx)·dx/width along x, from w = 0 (Dahl, Bouc-Wen)."""
    w = np.zeros(len(values))
    state = 0.0
    steps = np.diff(values)
    signs, decays = np.sign(steps).tolist(), np.exp(-np.abs(steps) / width).tolist()
    for index, (sign, decay) in enumerate(zip(signs, decays, strict=True), start=1):
        state = sign + (state - sign) * decay
        w[index] = state
    return w


def play(z_m: Array, width_m: float) -> Array:
    """Tip behind a dead band: it follows at once in the first direction (down), and rests at a reversal until z has moved by `width_m`."""
    tip = np.empty(len(z_m))
    state = float(z_m[0])
    for index, height in enumerate(z_m.tolist()):
        state = min(max(state, height - width_m), height)
        tip[index] = state
    return tip


def linear_response(numerator: list[float], denominator: list[float], values: Array, dt_s: float) -> tuple[Array, Array, Array]:
    """Output of a strictly proper linear system of order 2 or more with its first two derivatives, from rest at the first value."""
    order = len(denominator) - 1
    a = np.zeros((order, order))
    a[:-1, 1:] = np.eye(order - 1)
    a[-1] = -np.array(denominator[:0:-1]) / denominator[0]
    b = np.zeros((order, 1))
    b[-1] = 1 / denominator[0]
    c0 = np.zeros(order)
    c0[: len(numerator)] = numerator[::-1]
    c = np.array([c0, c0 @ a, c0 @ a @ a])
    d = np.array([[0.0], [float(c0 @ b[:, 0])], [float(c0 @ a @ b[:, 0])]])
    a_d, b_d, c_d, d_d, _ = cont2discrete((a, b, c, d), dt_s, method="foh")
    numerators, shared = ss2tf(a_d, b_d, c_d, d_d)
    output, speed, acceleration = (lfilter(row, shared, values - values[0]) for row in numerators)
    return output + values[0], speed, acceleration


# ---------------------------------------------------------------- servos: height, speed and acceleration for a command

Servo = Callable[[Array, float, float], tuple[Array, Array, Array]]


def third_order_servo(
    z_cmd_m: Array, dt_s: float, bandwidth: float, *, frequency_Hz: float, damping: float, lag_s: float
) -> tuple[Array, ...]:
    """Second-order servo behind a first-order lag of the drive."""
    w, tau = 2 * np.pi * frequency_Hz * bandwidth, lag_s / bandwidth
    poles = np.polymul([1, 2 * damping * w, w * w], [tau, 1])
    return linear_response([w * w], poles.tolist(), z_cmd_m, dt_s)


def jerk_limited_servo(z_cmd_m: Array, dt_s: float, bandwidth: float, *, times_s: tuple[float, ...]) -> tuple[Array, ...]:
    """Path smoothing by moving averages in a row, as motion controllers limit jerk."""
    z = z_cmd_m
    for time_s in times_s:
        length = time_s / bandwidth / dt_s
        whole = int(length)
        weights = np.append(np.ones(whole), length - whole) / length
        z = lfilter(weights, [1.0], z - z[0]) + z[0]
    v = np.gradient(z, dt_s)
    return z, v, np.gradient(v, dt_s)


def delayed_pi_servo(
    z_cmd_m: Array, dt_s: float, bandwidth: float, *, kp_per_s: float, ki_per_s2: float, lag_s: float, delay_s: float
) -> tuple[Array, ...]:
    """PI position loop over a speed drive with a lag; the position comes back late."""
    kp, ki, tau, delay = kp_per_s * bandwidth, ki_per_s2 * bandwidth**2, lag_s / bandwidth, delay_s / bandwidth / dt_s
    pole = np.exp(-dt_s / tau)
    # Polynomials in the one-sample delay q, lowest power first.
    control = np.array([kp + ki * dt_s, -kp]) * (1 - pole)
    loop = np.convolve(control, [dt_s / 2, dt_s / 2])
    open_loop = np.convolve(np.convolve([1, -1], [1, -1]), [1, -pole])
    whole = int(delay)
    late = np.zeros(whole + 2)
    late[whole:] = 1 - (delay - whole), delay - whole
    back = np.convolve(loop, late)
    denominator = np.zeros(max(len(open_loop), len(back)))
    denominator[: len(open_loop)] += open_loop
    denominator[: len(back)] += back
    change = z_cmd_m - z_cmd_m[0]
    z = lfilter(loop, denominator, change) + z_cmd_m[0]
    v = lfilter(np.convolve(control, [1, -1]), denominator, change)
    return z, v, np.gradient(v, dt_s)


def rate_limited_servo(
    z_cmd_m: Array, dt_s: float, bandwidth: float, *, kp_per_s: float, lag_s: float, v_max_m_per_s: float, a_max_m_per_s2: float
) -> tuple[Array, ...]:
    """Proportional position loop over a speed drive whose speed and acceleration have limits."""
    kp, tau = kp_per_s * bandwidth, lag_s / bandwidth
    smooth_s = 0.3 * tau
    z, v, a = float(z_cmd_m[0]), 0.0, 0.0
    states = np.empty((len(z_cmd_m), 3))
    for index, command in enumerate(z_cmd_m.tolist()):
        states[index] = z, v, a
        v_wanted = min(max(kp * (command - z), -v_max_m_per_s), v_max_m_per_s)
        a_wanted = min(max((v_wanted - v) / tau, -a_max_m_per_s2), a_max_m_per_s2)
        a_next = a + (a_wanted - a) * dt_s / smooth_s
        v_next = v + 0.5 * (a + a_next) * dt_s
        z += 0.5 * (v + v_next) * dt_s
        v, a = v_next, a_next
    return states[:, 0], states[:, 1], states[:, 2]


def smoothed_second_order_servo(
    z_cmd_m: Array, dt_s: float, bandwidth: float, *, frequency_Hz: float, damping: float, time_s: float
) -> tuple[Array, ...]:
    """Moving average of the command, then a second-order servo."""
    averaged = jerk_limited_servo(z_cmd_m, dt_s, bandwidth, times_s=(time_s,))[0]
    w = 2 * np.pi * frequency_Hz * bandwidth
    return linear_response([w * w], [1, 2 * damping * w, w * w], averaged, dt_s)


def mujoco_servo(
    z_cmd_m: Array,
    dt_s: float,
    bandwidth: float,
    *,
    kp_N_per_m: float,
    kv_N_s_per_m: float,
    lag_s: float,
    mass_kg: float,
    armature_kg: float,
    damping_N_s_per_m: float,
    step_s: float = 0.002,
) -> tuple[Array, ...]:
    """MuJoCo position actuator on a slide joint with armature and damping; a lag of the activation makes it third order."""
    actuator = f'<general joint="z" dyntype="filterexact" dynprm="{lag_s / bandwidth}" gainprm="{kp_N_per_m * bandwidth**2}" '
    actuator += f'biastype="affine" biasprm="0 {-kp_N_per_m * bandwidth**2} {-kv_N_s_per_m * bandwidth}"/>'
    if lag_s == 0:
        actuator = f'<position joint="z" kp="{kp_N_per_m * bandwidth**2}" kv="{kv_N_s_per_m * bandwidth}"/>'
    model = mujoco.MjModel.from_xml_string(f"""
<mujoco><option timestep="{step_s}" gravity="0 0 0" integrator="implicitfast"/><worldbody><body>
<joint name="z" type="slide" axis="0 0 1" armature="{armature_kg}" damping="{damping_N_s_per_m * bandwidth}"/>
<geom type="box" size=".02 .02 .02" mass="{mass_kg}" contype="0" conaffinity="0"/></body></worldbody>
<actuator>{actuator}</actuator></mujoco>""")
    data = mujoco.MjData(model)
    times = np.arange(len(z_cmd_m)) * dt_s
    step_times = np.arange(0, times[-1] + 2 * step_s, step_s)
    commands = np.interp(step_times, times, z_cmd_m - z_cmd_m[0])
    states = np.empty((len(step_times), 2))
    qpos, qvel, ctrl = data.qpos, data.qvel, data.ctrl
    for index, command in enumerate(commands.tolist()):
        ctrl[0] = command
        states[index, 0], states[index, 1] = qpos[0], qvel[0]
        mujoco.mj_step(model, data)
    # The slope of the speed: `qacc` of an implicit integrator lacks the damping of the step.
    slopes = np.gradient(states[:, 1], step_times)
    z = CubicHermiteSpline(step_times, states[:, 0], states[:, 1])(times)
    v = CubicHermiteSpline(step_times, states[:, 1], slopes)(times)
    return z + z_cmd_m[0], v, np.interp(times, step_times, slopes)


# ---------------------------------------------------------------- contacts: force on the probe for its height above the surface

# (times, height above the surface, speed, stiffness ratio) -> columns "fz_N" (pressing positive) and where the contact has them "fx_N".
Contact = Callable[[Array, Array, Array, float], dict[str, Array]]


def foam_contact(t_s: Array, height_m: Array, v_m_per_s: Array, ratio: float) -> dict[str, Array]:
    """Open-cell foam under a disc: linear, then the cells collapse, then they lie on each other."""
    depth = np.maximum(0, -height_m)
    linear, collapse_N = 900.0 * depth, 2.6
    f = linear / (1 + (linear / collapse_N) ** 5) ** 0.2 + 60.0 * depth + 6.0e5 * np.maximum(0, depth - 0.0068) ** 2
    return {"fz_N": ratio * f}


def layered_gel_contact(t_s: Array, height_m: Array, v_m_per_s: Array, ratio: float) -> dict[str, Array]:
    """Soft skin of power 1.2 over a core that a deep press reaches."""
    depth = np.maximum(0, -height_m)
    return {"fz_N": ratio * (950.0 * depth**1.2 + 3200.0 * np.maximum(0, depth - 0.0022) ** 1.4)}


def cone_contact(t_s: Array, height_m: Array, v_m_per_s: Array, ratio: float) -> dict[str, Array]:
    """Sneddon's cone with a half angle of 60 degrees in silicone."""
    depth = np.maximum(0, -height_m)
    return {"fz_N": ratio * 2 / np.pi * 1.6e5 * np.tan(np.radians(60)) * depth**2}


def relaxing_punch_contact(t_s: Array, height_m: Array, v_m_per_s: Array, ratio: float) -> dict[str, Array]:
    """Flat punch on a gel with two relaxation times and a dashpot: it can only push."""
    depth, dt = np.maximum(0, -height_m), t_s[1] - t_s[0]
    relaxing = 0.35 * (depth - low_pass(depth, 0.4, dt)) + 0.25 * (depth - low_pass(depth, 3.5, dt))
    dashpot = np.where(depth > 0, -6.0 * v_m_per_s * np.minimum(1, depth / 2e-4), 0.0)
    return {"fz_N": ratio * np.maximum(0, 1100.0 * (depth + relaxing) + dashpot)}


def winkler_contact(t_s: Array, height_m: Array, v_m_per_s: Array, ratio: float) -> dict[str, Array]:
    """Sphere of 20 mm on a bed of separate springs that harden with the cube of their shortening."""
    depth = np.maximum(0, -height_m)
    return {"fz_N": ratio * 2 * np.pi * 0.02 * (4.4e6 * depth**2 / 2 + 3.2e11 * depth**4 / 4)}


def bellows_contact(t_s: Array, height_m: Array, v_m_per_s: Array, ratio: float) -> dict[str, Array]:
    """Pneumatic bellows: wall spring, isothermal air in bellows and hose, and a leak; the probe can only push it."""
    area, volume, pressure, wall, leak_s = 4.0e-4, 4.6e-5, 101325.0, 230.0, 2.2
    step = 0.002
    times = np.arange(0, t_s[-1] - t_s[0] + 2 * step, step)
    depths = np.interp(times, t_s - t_s[0], np.maximum(0, -height_m))
    forces = np.zeros(len(times))
    air = 1.0
    gas_stiffness = area * area * pressure / volume
    for index, depth in enumerate(depths.tolist()):
        free = max(0.0, area * pressure * (1 - air) / (gas_stiffness + wall))
        shortening = max(depth, free)
        over = volume * air / (volume - area * shortening) - 1
        if depth > 0:
            forces[index] = max(0.0, area * pressure * over + wall * depth)
        air -= over / leak_s * step
    return {"fz_N": ratio * np.interp(t_s - t_s[0], times, forces)}


def prescribed_steps(t_s: Array, height_m: Array, v_m_per_s: Array, step_s: float) -> tuple[Array, Array, Array]:
    """Times from 0 of MuJoCo's steps, with the height and speed to prescribe there."""
    times = t_s - t_s[0]
    step_times = np.arange(0, times[-1] + step_s, step_s)
    inside = np.minimum(step_times, times[-1])
    return step_times, np.interp(inside, times, height_m), np.interp(inside, times, v_m_per_s)


def mujoco_ball_contact(t_s: Array, height_m: Array, v_m_per_s: Array, ratio: float) -> dict[str, Array]:
    """MuJoCo: a round tip presses a ball on a sprung and damped slide joint, through MuJoCo's soft contact."""
    step = 0.002
    model = mujoco.MjModel.from_xml_string(f"""
<mujoco><option timestep="{step}" gravity="0 0 0" integrator="implicitfast" tolerance="1e-10"/><worldbody>
<body pos="0 0 .006"><joint type="slide" axis="0 0 1"/><geom type="sphere" size=".006" mass="300" contype="1" conaffinity="2" condim="1"
 solref="{-26000 * ratio} {-260 * ratio}" solimp=".35 .95 .003 .5 2"/></body>
<body pos="0 0 -.02"><joint type="slide" axis="0 0 1" stiffness="{900 * ratio}" damping="{9 * ratio}"/>
<geom type="sphere" size=".02" mass=".06" contype="2" conaffinity="1" condim="1"
 solref="{-26000 * ratio} {-260 * ratio}" solimp=".35 .95 .003 .5 2"/></body></worldbody></mujoco>""")
    data = mujoco.MjData(model)
    times, heights, speeds = prescribed_steps(t_s, height_m, v_m_per_s, step)
    forces = np.zeros(len(times))
    qpos, qvel = data.qpos, data.qvel
    for index, (height, speed) in enumerate(zip(heights.tolist(), speeds.tolist(), strict=True)):
        qpos[0], qvel[0] = height, speed
        mujoco.mj_step(model, data)
        if data.nefc:
            forces[index] = data.efc_force[0]
    return {"fz_N": np.interp(t_s - t_s[0], times, forces)}


def mujoco_plate_contact(t_s: Array, height_m: Array, v_m_per_s: Array, ratio: float) -> dict[str, Array]:
    """MuJoCo: a tip presses a hinged plate that a position actuator holds; the plate turns away, so the tip is pushed sideways too."""
    step = 0.002
    model = mujoco.MjModel.from_xml_string(f"""
<mujoco><option timestep="{step}" gravity="0 0 0" integrator="implicitfast" tolerance="1e-10"/><worldbody>
<body pos="0 0 .005"><joint type="slide" axis="0 0 1"/><geom type="sphere" size=".005" mass="300" contype="1" conaffinity="2" condim="1"
 solref="{-40000 * ratio} {-400 * ratio}" solimp=".8 .95 .001 .5 2"/></body>
<body pos="-.06 0 -.004"><joint name="hinge" type="hinge" axis="0 1 0" damping="{0.012 * ratio}" armature="2e-5"/>
<geom type="box" pos=".05 0 0" size=".05 .03 .004" mass=".05" contype="2" conaffinity="1" condim="1"
 solref="{-40000 * ratio} {-400 * ratio}" solimp=".8 .95 .001 .5 2"/></body></worldbody>
<actuator><position joint="hinge" kp="{2.1 * ratio}" kv="{0.01 * ratio}"/></actuator></mujoco>""")
    data = mujoco.MjData(model)
    times, heights, speeds = prescribed_steps(t_s, height_m, v_m_per_s, step)
    forces, angles = np.zeros(len(times)), np.zeros(len(times))
    qpos, qvel = data.qpos, data.qvel
    for index, (height, speed) in enumerate(zip(heights.tolist(), speeds.tolist(), strict=True)):
        qpos[0], qvel[0] = height, speed
        angles[index] = qpos[1]
        mujoco.mj_step(model, data)
        if data.nefc:
            forces[index] = data.efc_force[0]
    at = t_s - t_s[0]
    return {"fz_N": np.interp(at, times, forces * np.cos(angles)), "fx_N": np.interp(at, times, forces * np.sin(angles))}


# ---------------------------------------------------------------- other known forces: on the sensor, without contact and inertia

# (times, height, speed) -> columns, zero where the recording starts.
Background = Callable[[Array, Array, Array], dict[str, Array]]


def no_background(t_s: Array, z_m: Array, v_m_per_s: Array) -> dict[str, Array]:
    """Nothing else acts."""
    return {}


def drag_background(t_s: Array, z_m: Array, v_m_per_s: Array) -> dict[str, Array]:
    """Known drag of a seal."""
    return {"fz_N": -1.5 * v_m_per_s}


def chain_background(t_s: Array, z_m: Array, v_m_per_s: Array) -> dict[str, Array]:
    """Known weight of an air hose that the axis lifts."""
    return {"fz_N": -9.0 * (z_m - z_m[0])}


def cogging_background(t_s: Array, z_m: Array, v_m_per_s: Array) -> dict[str, Array]:
    """Magnetic cogging of two orders, a cable that stiffens, and the cable's pull to the side."""

    def cogging(z: Array) -> Array:
        return 0.35 * np.sin(2 * np.pi * z / 0.024 + 0.4) + 0.12 * np.sin(2 * np.pi * z / 0.008 - 1.1)

    way = z_m - z_m[0]
    return {"fz_N": cogging(z_m) - cogging(z_m[:1]) - 14.0 * way - 1500.0 * way**3, "fx_N": 4.0 * way}


def mujoco_tendon_background(t_s: Array, z_m: Array, v_m_per_s: Array) -> dict[str, Array]:
    """MuJoCo: above a height a tendon is taut and pulls the tip down; its other end is on a sprung and damped clamp."""
    step = 0.0025
    model = mujoco.MjModel.from_xml_string(f"""
<mujoco><option timestep="{step}" gravity="0 0 0" integrator="implicitfast"/><worldbody>
<body><joint type="slide" axis="0 0 1"/><geom type="sphere" size=".01" mass="100" contype="0" conaffinity="0"/><site name="tip"/></body>
<body pos="0 0 -.1"><joint type="slide" axis="0 0 1" stiffness="1500" damping="14"/>
<geom type="box" size=".01 .01 .01" mass=".12" contype="0" conaffinity="0"/><site name="clamp"/></body></worldbody>
<tendon><spatial stiffness="260" damping="1.2" springlength="0 .112"><site site="tip"/><site site="clamp"/></spatial></tendon></mujoco>""")
    data = mujoco.MjData(model)
    times, heights, speeds = prescribed_steps(t_s, z_m, v_m_per_s, step)
    forces = np.empty(len(times))
    qpos, qvel, passive = data.qpos, data.qvel, data.qfrc_passive
    for index, (height, speed) in enumerate(zip(heights.tolist(), speeds.tolist(), strict=True)):
        qpos[0], qvel[0] = height, speed
        mujoco.mj_step(model, data)
        forces[index] = passive[0]
    return {"fz_N": np.interp(t_s - t_s[0], times, forces)}


# ---------------------------------------------------------------- rigs


@dataclass(frozen=True)
class OwnRig:
    """Physics of a rig, real and simulated."""

    cell: dict
    contact: Contact | None
    servo: Servo
    background: Background = no_background
    # Deepest press, or for a rig without tissue half of the longest stroke.
    reach_m: float = 0.005
    # Height of the middle of the strokes, for a rig without tissue.
    middle_z_m: float = 0.0
    speeds_m_per_s: tuple[float, float] = (0.02, 0.06)
    # Largest force of the contact or the background in a usual recording.
    force_N: float = 4.0
    predicts_height: bool = False
    gives_contact: bool = False
    choices: Mapping[str, float] = field(default_factory=dict)

    @property
    def rate_Hz(self) -> float:
        return self.cell["sensor"]["rate_Hz"]

    @property
    def mass_kg(self) -> float:
        return self.cell["probe"]["mass_kg"]

    @property
    def surface_z_m(self) -> float:
        return self.cell["tissue"]["surface_z_m"] if self.cell["tissue"] else 0.0

    @property
    def fine_steps(self) -> int:
        """Steps of the physics in a sample, for about 1 kHz."""
        return int(np.ceil(1000 / self.rate_Hz))


@dataclass(frozen=True)
class MotionPlan:
    """Commanded motion of a recording, sampled, with EXTRA_S more than is recorded."""

    t_s: Array
    z_cmd_m: Array
    rows: int
    # Times in the air between presses: the k-th press lies before the k-th time.
    between_s: tuple[float, ...]


@dataclass(frozen=True)
class RigDeviations:
    """RigDeviations within the tolerances, and the scatter of each press."""

    bias_N: float = 0.0
    drift_N_per_min: float = 0.0
    gain: float = 0.0
    latency_s: float = 0.0
    filter_cutoff: float = 0.0
    crosstalk: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    mass_kg: float = 0.0
    youngs_modulus: float = 0.0
    surface_z_m: float = 0.0
    servo_natural_frequency: float = 0.0
    press_surface_m: tuple[float, ...] = ()
    press_stiffness: tuple[float, ...] = ()


@dataclass(frozen=True)
class TrueMotion:
    """Motion of the robot on the fine grid."""

    t_s: Array
    z_m: Array
    v_m_per_s: Array
    a_m_per_s2: Array

    @property
    def dt_s(self) -> float:
        return float(self.t_s[1] - self.t_s[0])


@dataclass(frozen=True)
class RigRecording:
    """A recording of the real rig, the hidden effect, and its signal-to-noise ratio (0 when healthy)."""

    columns: dict[str, Array]
    truth: dict[str, dict[str, float]]
    snr: float


def draw_deviations(rig: OwnRig, plan: MotionPlan, rng: np.random.Generator) -> RigDeviations:
    tolerances, scatter = rig.cell["tolerances"], rig.cell["repeatability"]

    def draw(sigma: float) -> float:
        return sigma * float(np.clip(rng.standard_normal(), -2, 2))

    leak = tolerances["crosstalk"]
    presses = len(plan.between_s) + 1
    plain = ("bias_N", "drift_N_per_min", "gain", "latency_s", "filter_cutoff", "mass_kg", "servo_natural_frequency")
    return RigDeviations(
        **{name: draw(tolerances[name]) for name in plain},
        youngs_modulus=draw(tolerances["youngs_modulus"]),
        surface_z_m=draw(tolerances["surface_z_m"]),
        crosstalk=(draw(leak), draw(leak), draw(0.05 * leak), draw(0.05 * leak)),
        press_surface_m=tuple(draw(scatter["surface_z_m"]) for _ in range(presses)),
        press_stiffness=tuple(draw(scatter["stiffness"]) for _ in range(presses)),
    )


def draw_plan(rig: OwnRig, rng: np.random.Generator) -> MotionPlan:
    """Strokes in the air at two speeds with rests, then presses of different depth with holds."""
    dt = 1 / rig.rate_Hz
    slow, fast = (speed * rng.uniform(0.85, 1.15) for speed in rig.speeds_m_per_s)
    times, heights = [0.0], []
    between: list[float] = []

    def rest(seconds: float) -> None:
        times.append(times[-1] + max(1, round(seconds / dt)) * dt)
        heights.append(heights[-1])

    def go(height: float, speed: float) -> None:
        times.append(times[-1] + max(1, round(abs(height - heights[-1]) / speed / dt)) * dt)
        heights.append(height)

    if rig.contact is None:
        top, bottom = rig.middle_z_m + rig.reach_m, rig.middle_z_m - rig.reach_m
        heights.append(rig.middle_z_m - 0.1 * rig.reach_m)
        rest(rng.uniform(1.5, 2.0))
        for speed in [fast, slow, fast, 0.4 * slow, fast, slow, fast, 0.6 * fast, slow]:
            go(bottom + rng.uniform(0, 0.5) * rig.reach_m, speed)
            rest(rng.uniform(0.3, 1.2))
            go(top - rng.uniform(0, 0.35) * rig.reach_m, speed)
            rest(rng.uniform(0.3, 1.2))
        go(heights[0], slow)
        rest(rng.uniform(0.8, 1.2))
    else:
        surface, stroke = rig.surface_z_m, float(np.clip(4 * rig.reach_m, 0.015, 0.04))
        heights.append(surface + 0.005 + stroke)
        rest(rng.uniform(1.5, 2.0))
        for speed in [slow, fast, fast] if rng.random() < 0.5 else [fast, slow, fast]:
            go(surface + rng.uniform(0.004, 0.006), speed)
            rest(rng.uniform(0.3, 0.8))
            go(surface + 0.005 + stroke * rng.uniform(0.7, 1.0), speed)
            rest(rng.uniform(0.3, 0.8))
        gap = 0.0035
        go(surface + gap, slow)
        rest(0.6)
        shares = rng.permutation([0.4, 0.55, 0.7, 0.85, 1.0, 0.62][: int(rng.integers(5, 7))])
        unit_speed = np.clip(rig.reach_m, 0.003, 0.012)
        for index, share in enumerate(shares):
            go(surface - share * rig.reach_m * rng.uniform(0.92, 1.0), unit_speed * rng.uniform(0.5, 2.0))
            rest(rng.choice([0.5, 1.2, 2.2]) * rng.uniform(0.8, 1.2))
            go(surface + gap, unit_speed * rng.uniform(0.8, 2.5))
            rest(rng.uniform(0.5, 1.0))
            if index < len(shares) - 1:
                between.append(times[-1] - 0.2)
        go(surface + 0.005 + 0.8 * stroke, fast)
        rest(rng.uniform(0.8, 1.2))
    rows = round(times[-1] / dt) + 1
    t_s = np.arange(rows + round(EXTRA_S / dt)) * dt
    return MotionPlan(t_s=t_s, z_cmd_m=np.interp(t_s, times, heights), rows=rows, between_s=tuple(between))


def fine_grid(t_s: Array, steps: int) -> Array:
    dt = (t_s[-1] - t_s[0]) / (len(t_s) - 1) / steps
    return t_s[0] + np.arange((len(t_s) - 1) * steps + 1) * dt


def sensor_filter(rig: OwnRig, values: Array, dt_s: float, cutoff_Hz: float | None) -> Array:
    return values if cutoff_Hz is None else low_pass(values, 1 / (2 * np.pi * cutoff_Hz), dt_s)


def add(columns: dict[str, Array], more: Mapping[str, Array]) -> None:
    for name, values in more.items():
        columns[name] = columns[name] + values


def simulated(rig: OwnRig, motion: Mapping[str, Array]) -> dict[str, Array]:
    """What the rig's own simulator predicts for a motion, without noise and rounding."""
    t_s = np.asarray(motion["t_s"], float)
    z_m, v_m_per_s, a_m_per_s2 = (np.asarray(motion[name], float) for name in ("z_m", "vz_m_per_s", "az_m_per_s2"))
    fine = fine_grid(t_s, rig.fine_steps)
    fine_inside = np.minimum(fine, t_s[-1])
    z = CubicHermiteSpline(t_s, z_m, v_m_per_s)(fine_inside)
    v = CubicHermiteSpline(t_s, v_m_per_s, a_m_per_s2)(fine_inside)
    a = np.interp(fine, t_s, a_m_per_s2)
    dt = float(fine[1] - fine[0])
    sums = {name: np.zeros(len(fine)) for name in WRENCH}
    outputs = {"fz_N"}
    answer: dict[str, Array] = {}
    if rig.contact is not None:
        contact = rig.contact(fine, z - rig.surface_z_m, v, 1.0)
        add(sums, contact)
        outputs |= set(contact)
        if "fx_N" in contact:
            sums["ty_Nm"] = sums["ty_Nm"] - contact["fx_N"] * rig.cell["probe"]["tip_length_m"]
            outputs.add("ty_Nm")
        if rig.gives_contact:
            answer["contact_N"] = np.interp(t_s, fine, contact["fz_N"])
    background = rig.background(fine, z, v)
    add(sums, background)
    outputs |= set(background)
    sums["fz_N"] = sums["fz_N"] - rig.mass_kg * a
    for name in outputs:
        answer[name] = np.interp(t_s, fine, sensor_filter(rig, sums[name], dt, rig.cell["sensor"]["filter_cutoff_Hz"]))
    if rig.predicts_height and "z_cmd_m" in motion:
        z_cmd = np.interp(fine, t_s, np.asarray(motion["z_cmd_m"], float))
        answer["z_m"] = np.interp(t_s, fine, rig.servo(z_cmd, dt, 1.0)[0])
    return answer


# ---------------------------------------------------------------- the real rig


def press_steps(plan: MotionPlan, t_s: Array, values: tuple[float, ...]) -> Array:
    """A value for each press, changed in the air between presses."""
    if not values:
        return np.zeros(len(t_s))
    return np.asarray(values)[np.searchsorted(plan.between_s, t_s)]


def true_motion(rig: OwnRig, plan: MotionPlan, deviations: RigDeviations, effect: str | None, p: Mapping[str, float]) -> TrueMotion:
    t_s = fine_grid(plan.t_s, rig.fine_steps)
    bandwidth = 1 + deviations.servo_natural_frequency
    if effect == "robot.lag":
        bandwidth *= p["bandwidth_ratio"]
    z, v, a = rig.servo(np.interp(t_s, plan.t_s, plan.z_cmd_m), float(t_s[1] - t_s[0]), bandwidth)
    if effect == "robot.vibration":
        w = 2 * np.pi * p["frequency_Hz"]
        angle = w * t_s + p["phase_rad"]
        z = z + p["amplitude_m"] * np.sin(angle)
        v = v + p["amplitude_m"] * w * np.cos(angle)
        a = a - p["amplitude_m"] * w * w * np.sin(angle)
    return TrueMotion(t_s, z, v, a)


def contact_on_tip(
    rig: OwnRig, plan: MotionPlan, motion: TrueMotion, deviations: RigDeviations, effect: str | None, p: Mapping[str, float], tip_m: Array
) -> tuple[dict[str, Array], Array]:
    """Contact force for a tip's height, with what acts inside the contact; also the height above the real surface."""
    surface = rig.surface_z_m + deviations.surface_z_m + press_steps(plan, motion.t_s, deviations.press_surface_m)
    ratio = 1 + deviations.youngs_modulus
    if effect == "tissue.surface":
        surface = surface + p["offset_m"]
    if effect == "tissue.modulus":
        ratio *= p["ratio"]
    if effect == "tissue.plasticity":
        presses = np.searchsorted(plan.between_s, motion.t_s)
        dents = np.concatenate([[0.0], np.cumsum(p["set_m"] * p["ratio"] ** np.arange(len(plan.between_s)))])
        surface = surface - dents[presses]
    height = tip_m - surface
    speed = motion.v_m_per_s if effect not in ("robot.backlash", "robot.compliance") else np.gradient(tip_m, motion.dt_s)
    forces = rig.contact(motion.t_s, height, speed, ratio)
    scatter = 1 + press_steps(plan, motion.t_s, deviations.press_stiffness)
    return {name: values * scatter for name, values in forces.items()}, height


def contact_effects(
    rig: OwnRig, motion: TrueMotion, effect: str | None, p: Mapping[str, float], forces: dict[str, Array], height: Array
) -> dict[str, Array]:
    """The contact with what changes its law."""
    depth = np.maximum(0, -height)
    factor = None
    if effect == "tissue.thickness":
        chi = np.sqrt(rig.cell["probe"]["tip_radius_m"] * depth) / p["thickness_m"]
        factor = 1 + 1.133 * chi + 1.283 * chi**2 + 0.769 * chi**3 + 0.0975 * chi**4
    if effect == "tissue.inclusion":
        x = depth / p["depth_m"]
        factor = 1 + p["contrast"] * x**2 / (1 + x**2)
    if effect == "tissue.preconditioning":
        deepest = np.maximum.accumulate(depth)
        factor = 1 - p["softening"] * (1 - (depth / np.where(deepest > 0, deepest, 1)) ** 2)
    if factor is not None:
        forces = {name: values * factor for name, values in forces.items()}
    if effect == "tissue.viscoelastic":
        f = forces["fz_N"]
        changed = np.maximum(0, f + p["ratio"] * (f - low_pass(f, p["tau_s"], motion.dt_s)))
        share = np.divide(changed, f, out=np.ones_like(f), where=f > 1e-9)
        forces = {name: values * share for name, values in forces.items()} | {"fz_N": changed}
    if effect == "tissue.adhesion":
        pull = np.zeros(len(height))
        touching, deepest = False, 0.0
        for index, h in enumerate(height.tolist()):
            if h <= 0:
                deepest = min(deepest, h) if touching else h
                touching = True
            if touching and h >= p["range_m"]:
                touching = False
            if touching:
                pull[index] = p["force_N"] * min((h - deepest) / p["range_m"], 1) * (1 - max(h, 0) / p["range_m"])
        forces = forces | {"fz_N": forces["fz_N"] - pull}
    return forces


def true_contact(
    rig: OwnRig, plan: MotionPlan, motion: TrueMotion, deviations: RigDeviations, effect: str | None, p: Mapping[str, float]
) -> dict[str, Array]:
    tip = play(motion.z_m, p["width_m"]) if effect == "robot.backlash" else motion.z_m
    forces, height = contact_on_tip(rig, plan, motion, deviations, effect, p, tip)
    if effect == "robot.compliance":
        # The tip and its force are found together, by repeated substitution; it converges as long as the mount is stiffer than the contact.
        for _ in range(30):
            next_tip = motion.z_m + forces["fz_N"] / p["stiffness_N_per_m"]
            change, tip = float(np.max(np.abs(next_tip - tip))), next_tip
            forces, height = contact_on_tip(rig, plan, motion, deviations, effect, p, tip)
            if change < 2e-7:
                break
    return contact_effects(rig, motion, effect, p, forces, height)


def noise_free(
    rig: OwnRig,
    plan: MotionPlan,
    deviations: RigDeviations,
    effect: str | None,
    p: Mapping[str, float],
    contact: dict[str, Array] | None = None,
) -> tuple[dict[str, Array], TrueMotion]:
    """Sampled readings of the real rig before noise and rounding, with the true height and speed; `contact` saves its computation."""
    motion = true_motion(rig, plan, deviations, effect, p)
    t_s, dt = motion.t_s, motion.dt_s
    arm = rig.cell["probe"]["tip_length_m"]
    zero = np.zeros(len(t_s))
    sums = dict.fromkeys(WRENCH, zero)
    if rig.contact is not None:
        contact = true_contact(rig, plan, motion, deviations, effect, p) if contact is None else contact
        if effect == "contact.lateral":
            side = p["ratio"] * contact["fz_N"]
            contact = contact | {
                "fx_N": contact.get("fx_N", zero) + side * np.cos(p["azimuth_rad"]),
                "fy_N": side * np.sin(p["azimuth_rad"]),
            }
    else:
        contact = {"fz_N": zero}
    contact = {"fx_N": zero, "fy_N": zero} | contact
    add(sums, rig.background(t_s, motion.z_m, motion.v_m_per_s))

    mass = rig.mass_kg + deviations.mass_kg + (p["delta_kg"] if effect == "probe.mass" else 0)
    acceleration = motion.a_m_per_s2
    if effect == "structure.resonance":
        w, damping = 2 * np.pi * p["frequency_Hz"], p["damping_ratio"]
        ringing = linear_response([2 * damping * w, w * w], [1, 2 * damping * w, w * w], acceleration, dt)[0]
        acceleration = (1 - p["participation"]) * acceleration + p["participation"] * ringing
    along = sums["fz_N"] - mass * acceleration
    if effect == "cable.spring":
        along = along - p["stiffness_N_per_m"] * (motion.z_m - motion.z_m[0])
    if effect == "cable.viscous":
        along = along - p["coefficient_N_s_per_m"] * motion.v_m_per_s
    if effect == "cable.friction":
        rubbing = saturating_memory(motion.z_m, p["presliding_m"]) if "presliding_m" in p else np.tanh(motion.v_m_per_s / 5e-4)
        along = along - p["force_N"] * rubbing
    if effect == "probe.tilt":
        sine, cosine = np.sin(p["angle_rad"]), np.cos(p["angle_rad"])
        for name, direction in (("fx_N", np.cos(p["azimuth_rad"])), ("fy_N", np.sin(p["azimuth_rad"]))):
            sums[name] = sums[name] + sine * direction * along
            contact[name] = contact[name] + sine * direction * contact["fz_N"]
        along, contact["fz_N"] = cosine * along, cosine * contact["fz_N"]
    sums["fz_N"] = along
    add(sums, contact)
    sums["tx_Nm"] = sums["tx_Nm"] + contact["fy_N"] * arm
    sums["ty_Nm"] = sums["ty_Nm"] - contact["fx_N"] * arm

    cutoff = rig.cell["sensor"]["filter_cutoff_Hz"]
    if cutoff is not None:
        cutoff *= 1 + deviations.filter_cutoff
    if effect == "sensor.filter":
        cutoff = p["cutoff_Hz"]
    read = {name: sensor_filter(rig, values, dt, cutoff) for name, values in sums.items()}
    leaks = np.array(deviations.crosstalk)
    if effect == "sensor.crosstalk":
        leaks = leaks + np.array([p["fx_per_fz"], p["fy_per_fz"], p["tx_per_fz_m"], p["ty_per_fz_m"]])
    for name, leak in zip(("fx_N", "fy_N", "tx_Nm", "ty_Nm"), leaks, strict=True):
        read[name] = read[name] + leak * read["fz_N"]
    fz = read["fz_N"] * (1 + deviations.gain)
    if effect == "sensor.gain":
        fz = fz * (1 + p["error"])
    if effect == "sensor.hysteresis":
        fz = fz + p["amplitude_N"] * saturating_memory(fz, p["width_N"])
    if effect == "sensor.creep":
        fz = fz + p["ratio"] * low_pass(fz, p["tau_s"], dt, start=0.0)
    if effect == "sensor.asymmetry":
        fz = fz + p["ratio"] * (np.maximum(0, fz - p["at_N"]) if p["side"] > 0 else np.minimum(fz, p["at_N"]))
    read["fz_N"] = fz

    sample_times = plan.t_s[: plan.rows]
    skew = p["ratio"] if effect == "clock.skew" else 0.0
    late = deviations.latency_s + (p["delay_s"] if effect == "sensor.latency" else 0.0)
    columns = {name: np.interp(sample_times * (1 + skew) - late, t_s, values) for name, values in read.items()}
    fz = columns["fz_N"] + deviations.bias_N + deviations.drift_N_per_min / 60 * sample_times
    if effect == "sensor.bias":
        fz = fz + p["offset_N"]
    if effect == "sensor.drift":
        fz = fz + p["rate_N_per_s"] * sample_times
    if effect == "sensor.warmup":
        fz = fz + p["amplitude_N"] * (1 - np.exp(-sample_times / p["tau_s"]))
    if effect == "sensor.saturation":
        fz = np.clip(fz, -p["limit_N"], p["limit_N"])
    columns["fz_N"] = fz
    steps = rig.fine_steps
    columns["z_m"] = motion.z_m[::steps][: plan.rows]
    columns["vz_m_per_s"] = motion.v_m_per_s[::steps][: plan.rows]
    return columns, motion


def channel_noise(rig: OwnRig) -> dict[str, float]:
    sensor, robot = rig.cell["sensor"], rig.cell["robot"]
    noise = {name: sensor["noise_rms_N"] if name.startswith("f") else sensor["noise_rms_Nm"] for name in WRENCH}
    return noise | {"z_m": robot["position_noise_rms_m"], "vz_m_per_s": robot["velocity_noise_rms_m_per_s"]}


def resolution(rig: OwnRig, name: str) -> float:
    key = "resolution_fz_N" if name == "fz_N" else "resolution_fxy_N" if name.startswith("f") else "resolution_Nm"
    return rig.cell["sensor"][key]


def read_out(
    rig: OwnRig,
    plan: MotionPlan,
    columns: Mapping[str, Array],
    noise: Mapping[str, Array],
    effect: str | None,
    p: Mapping[str, float],
    starts_s: Array,
) -> dict[str, Array]:
    """Readings with noise, lost samples and rounding."""
    t_s = plan.t_s[: plan.rows]
    out = {"t_s": t_s, "z_cmd_m": plan.z_cmd_m[: plan.rows]}
    ratio = p["ratio"] if effect == "sensor.noise" else 1.0
    for name in ("z_m", "vz_m_per_s"):
        out[name] = columns[name] + noise[name]
    for name in WRENCH:
        values = columns[name] + ratio * noise[name]
        if effect == "sensor.dropout":
            length = max(1, round(p["length_s"] * rig.rate_Hz))
            source = np.arange(len(values))
            for first in np.searchsorted(t_s, starts_s):
                source[first : first + length] = source[max(first - 1, 0)]
            values = values[source]
        step = resolution(rig, name)
        if effect == "sensor.quantization" and name == "fz_N":
            step = p["step_N"]
        out[name] = np.round(values / step) * step if step else values
    return out


def block_snr(
    rig: OwnRig, plan: MotionPlan, changed: Mapping[str, Array], healthy: Mapping[str, Array], channels: tuple[str, ...]
) -> float:
    """Norm of the change of 20 ms block means over the noise of a block mean."""
    blocks = np.floor(plan.t_s[: plan.rows] / 0.02 + 1e-6).astype(int)
    counts = np.bincount(blocks)
    noise = channel_noise(rig)
    total = 0.0
    for name in channels:
        sums = np.bincount(blocks, changed[name] - healthy[name])
        total += float(np.sum(sums[counts > 0] ** 2 / counts[counts > 0])) / noise[name] ** 2
    return float(np.sqrt(total))


# ---------------------------------------------------------------- sizes of effects


@dataclass(frozen=True)
class Draws:
    """Random numbers of an effect that its size does not change."""

    sign: float
    u: float
    v: float
    azimuth_rad: float
    duration_s: float


def effect_parameters(rig: OwnRig, effect: str, size: float, draws: Draws) -> dict[str, float]:
    """Parameters of an effect; at `size` 1 it is typical, at 0 it is nothing."""
    noise, mass = rig.cell["sensor"]["noise_rms_N"], rig.mass_kg
    force, reach, fast = rig.force_N, rig.reach_m, rig.speeds_m_per_s[1]
    radius = rig.cell["probe"]["tip_radius_m"]
    sign, u, v = draws.sign, draws.u, draws.v
    cos_azimuth, sin_azimuth = float(np.cos(draws.azimuth_rad)), float(np.sin(draws.azimuth_rad))
    match effect:
        case "sensor.bias":
            return {"offset_N": sign * size * noise}
        case "sensor.drift":
            return {"rate_N_per_s": sign * size * noise / draws.duration_s}
        case "sensor.warmup":
            return {"amplitude_N": sign * size * noise, "tau_s": 4 + 6 * u}
        case "sensor.gain":
            return {"error": sign * 0.05 * size}
        case "sensor.crosstalk":
            leak = 0.03 * size
            return {
                "fx_per_fz": leak * cos_azimuth,
                "fy_per_fz": leak * sin_azimuth,
                "tx_per_fz_m": 0.03 * leak * (2 * u - 1),
                "ty_per_fz_m": 0.03 * leak * (2 * v - 1),
            }
        case "sensor.filter":
            return {"cutoff_Hz": rig.cell["sensor"]["filter_cutoff_Hz"] / (1 + size)}
        case "sensor.latency":
            return {"delay_s": 0.006 * size}
        case "sensor.hysteresis":
            return {"width_N": (0.15 + 0.25 * u) * force, "amplitude_N": sign * 0.04 * force * size}
        case "sensor.creep":
            return {"ratio": 0.05 * size, "tau_s": 1.5 + 3 * u}
        case "sensor.quantization":
            return {"step_N": (4 + 3 * u) * noise}
        case "sensor.noise":
            return {"ratio": 1.7 + 0.8 * u}
        case "sensor.dropout":
            return {"rate_Hz": 2 + 2 * u, "length_s": 0.03 + 0.04 * v}
        case "sensor.saturation":
            return {"limit_N": force * (1 - 0.12 * size)}
        case "sensor.asymmetry":
            side = rig.choices.get("asymmetry side", 1.0)
            return {"ratio": sign * 0.08 * size, "at_N": (0.15 + 0.3 * u) * force if side > 0 else 0.0, "side": side}
        case "clock.skew":
            return {"ratio": sign * 1e-3 * size}
        case "probe.mass":
            return {"delta_kg": sign * 0.1 * mass * size}
        case "probe.tilt":
            return {"angle_rad": 0.04 * size, "azimuth_rad": draws.azimuth_rad}
        case "cable.spring":
            return {"stiffness_N_per_m": size * noise / 0.01}
        case "cable.friction":
            friction = {"force_N": size * noise}
            presliding = rig.choices.get("presliding", 1.0)
            return friction | {"presliding_m": 1e-4 + 2e-4 * u} if presliding else friction
        case "cable.viscous":
            return {"coefficient_N_s_per_m": size * noise / fast}
        case "structure.resonance":
            return {"frequency_Hz": 6 + 8 * u, "damping_ratio": 0.03 + 0.05 * v, "participation": 0.3 * size}
        case "robot.lag":
            return {"bandwidth_ratio": 1 / (1 + 0.1 * size) if sign > 0 else 1 + 0.1 * size}
        case "robot.compliance":
            return {"stiffness_N_per_m": force / reach / (0.1 * size)}
        case "robot.backlash":
            return {"width_m": 0.03 * reach * size}
        case "robot.vibration":
            return {"amplitude_m": 1e-5 * size, "frequency_Hz": 4 + 8 * u, "phase_rad": draws.azimuth_rad}
        case "tissue.surface":
            return {"offset_m": sign * 0.03 * reach * size}
        case "tissue.modulus":
            return {"ratio": 1 + sign * 0.1 * size}
        case "tissue.viscoelastic":
            return {"ratio": 0.1 * size, "tau_s": 0.3 + 1.5 * u}
        case "tissue.preconditioning":
            return {"softening": 0.1 * size}
        case "tissue.adhesion":
            return {"force_N": 3 * noise * size, "range_m": (0.2 + 0.2 * u) * min(reach, 0.006)}
        case "tissue.thickness":
            return {"thickness_m": float(np.sqrt(radius * reach)) / (0.1 * size)}
        case "tissue.inclusion":
            return {"contrast": 0.3 * size, "depth_m": (0.5 + 0.4 * u) * reach}
        case "tissue.plasticity":
            return {"set_m": 0.045 * reach * size * (0.5 - 0.35 * u), "ratio": 0.5 + 0.35 * u}
        case "contact.lateral":
            return {"ratio": 0.03 * size, "azimuth_rad": draws.azimuth_rad}
    raise ValueError(f"effect is {effect!r}, expected an id of the contract")


def size_limits(rig: OwnRig, effect: str) -> tuple[float, float]:
    """Smallest size well beyond the tolerances, and largest credible one."""
    tolerances, noise = rig.cell["tolerances"], rig.cell["sensor"]["noise_rms_N"]
    scale = tolerances["gain"] if rig.contact is None else tolerances["youngs_modulus"]
    height = float(np.hypot(tolerances["surface_z_m"], rig.cell["repeatability"]["surface_z_m"]))
    smallest = {
        "sensor.bias": 4.2 * tolerances["bias_N"] / noise,
        "sensor.gain": 4.2 * tolerances["gain"] / 0.05,
        "sensor.crosstalk": 4.2 * tolerances["crosstalk"] / 0.03,
        "contact.lateral": 4.2 * tolerances["crosstalk"] / 0.03,
        "probe.tilt": 4.2 * tolerances["crosstalk"] / 0.04,
        "sensor.filter": 8 * tolerances["filter_cutoff"],
        "sensor.latency": 4.2 * tolerances["latency_s"] / 0.006,
        "probe.mass": 5.2 * tolerances["mass_kg"] / (0.1 * rig.mass_kg),
        "robot.lag": 4.5 * tolerances["servo_natural_frequency"] / 0.1,
        "tissue.surface": 4.2 * tolerances["surface_z_m"] / (0.03 * rig.reach_m),
        "tissue.modulus": 4.2 * tolerances["youngs_modulus"] / 0.1,
        # A change of the contact's strength, against the tolerance of its modulus or of the gain.
        "sensor.creep": 4.2 * scale / 0.05,
        "sensor.asymmetry": 4.2 * scale / 0.08,
        "robot.compliance": 3.4 * scale / 0.1,
        "tissue.viscoelastic": 4.2 * scale / 0.1,
        "tissue.preconditioning": 4.2 * scale / 0.1,
        "tissue.thickness": 4.2 * scale / 0.09,
        "tissue.inclusion": 4.2 * scale / 0.15,
        # A change of height: some five dents reach at least half of 0.045 of the reach.
        "tissue.plasticity": 4.2 * height / (0.6 * 0.045 * rig.reach_m),
        "robot.backlash": 4.2 * height / (0.03 * rig.reach_m),
        # Against the tolerance at the end of a recording of 40 s.
        "sensor.drift": 4.2 * tolerances["drift_N_per_min"] * 40 / 60 / noise,
    }.get(effect, 0.05)
    largest = {
        "tissue.modulus": 6.0,
        "sensor.saturation": 5.0,
        "structure.resonance": 3.0,
        "tissue.preconditioning": 6.0,
        "robot.compliance": 2.5,
        "sensor.filter": 15.0,
        "probe.mass": 6.0,
        "sensor.crosstalk": 4.0,
        "sensor.latency": 8.0,
        "clock.skew": 6.0,
        "robot.backlash": 8.0,
        "tissue.surface": 6.0,
        "tissue.thickness": 8.0,
        "tissue.inclusion": 8.0,
        "tissue.plasticity": 5.0,
        "tissue.viscoelastic": 10.0,
        "probe.tilt": 6.0,
    }.get(effect, 20.0)
    return smallest, largest


def with_target_snr(
    rig: OwnRig, plan: MotionPlan, deviations: RigDeviations, effect: str, draws: Draws, target: float
) -> tuple[dict[str, float], dict[str, Array], float]:
    """Parameters, readings and signal-to-noise ratio of an effect sized for a target ratio, within its limits."""
    healthy_motion = true_motion(rig, plan, deviations, None, {})
    contact = None if rig.contact is None else true_contact(rig, plan, healthy_motion, deviations, None, {})
    healthy, _ = noise_free(rig, plan, deviations, None, {}, contact)
    if effect.startswith(("tissue.", "robot.")):
        contact = None

    def snr_of(size: float) -> float:
        parameters = effect_parameters(rig, effect, size, draws)
        if effect in ROBOT_EFFECTS:
            z_m = true_motion(rig, plan, deviations, effect, parameters).z_m[:: rig.fine_steps][: plan.rows]
            return block_snr(rig, plan, {"z_m": z_m}, healthy, ("z_m",))
        changed, _ = noise_free(rig, plan, deviations, effect, parameters, contact)
        return block_snr(rig, plan, changed, healthy, WRENCH)

    smallest, largest = size_limits(rig, effect)
    size = float(np.clip(1.0, smallest, largest))
    snr = snr_of(size)
    too_small, too_large = 0.0, np.inf
    for _ in range(8):
        too_small, too_large = (size, too_large) if snr < target else (too_small, size)
        next_size = size * float(np.clip(target / max(snr, 1e-3), 0.1, 4))
        if not too_small < next_size < too_large:
            next_size = float(np.sqrt(too_small * too_large))
        next_size = float(np.clip(next_size, smallest, largest))
        if abs(next_size / size - 1) < 0.04:
            break
        size, snr = next_size, snr_of(next_size)
    parameters = effect_parameters(rig, effect, size, draws)
    return parameters, noise_free(rig, plan, deviations, effect, parameters, contact)[0], snr


@dataclass(frozen=True)
class Model:
    """A rig with its simulator, and recordings of the real rig."""

    name: str
    about: str
    cell: dict
    simulate: Callable[[Mapping[str, Array]], dict[str, Array]]
    effects: tuple[str, ...]
    rig: OwnRig

    def record(self, effect: str | None, seed: int) -> RigRecording:
        """A recording with one hidden effect (None: healthy), deterministic by seed."""
        if effect is not None and effect not in self.effects:
            raise ValueError(f"effect is {effect!r}, expected one of {self.effects}")
        rng = np.random.default_rng([zlib.crc32(self.name.encode()), zlib.crc32((effect or "").encode()), seed])
        rig = self.rig
        plan = draw_plan(rig, rng)
        deviations = draw_deviations(rig, plan, rng)
        duration = float(plan.t_s[plan.rows - 1])
        draws = Draws(
            sign=float(rng.choice([-1, 1])),
            u=float(rng.random()),
            v=float(rng.random()),
            azimuth_rad=float(rng.uniform(-np.pi, np.pi)),
            duration_s=duration,
        )
        target = float(np.exp(rng.uniform(*np.log(TARGET_SNR))))
        # The noise of a healthy recording lies within 10 % of the stated one.
        noise_ratio = 1 + 0.05 * float(np.clip(rng.standard_normal(), -2, 2))
        noise = {
            name: sigma * (1.0 if name in ("z_m", "vz_m_per_s") else noise_ratio) * rng.standard_normal(plan.rows)
            for name, sigma in channel_noise(rig).items()
        }
        parameters: dict[str, float] = {}
        snr, starts_s = 0.0, np.empty(0)
        if effect is None or effect in SCATTER_EFFECTS:
            columns, _ = noise_free(rig, plan, deviations, None, {})
            if effect is not None:
                parameters = effect_parameters(rig, effect, 1.0, draws)
                starts_s = np.sort(rng.uniform(0.5, duration, int(rng.poisson(parameters.get("rate_Hz", 0) * duration))))
        else:
            parameters, columns, snr = with_target_snr(rig, plan, deviations, effect, draws, target)
        readings = read_out(rig, plan, columns, noise, effect, parameters, starts_s)
        if effect == "sensor.noise":
            # Here the change of the variance of all samples of fz over the scatter of that variance.
            snr = float(np.sqrt(plan.rows / 2) * (parameters["ratio"] ** 2 - 1))
        elif effect in SCATTER_EFFECTS:
            # Here the change of the readings themselves, with the same noise.
            snr = block_snr(rig, plan, readings, read_out(rig, plan, columns, noise, None, {}, np.empty(0)), WRENCH)
        return RigRecording(columns=readings, truth={effect: parameters} if effect else {}, snr=snr)


def healthy_residual(model: Model, seed: int) -> dict[str, float]:
    """Rms of recording minus simulator over the stated noise, without deviations, driven by the true motion."""
    rig, rng = model.rig, np.random.default_rng(seed)
    plan = draw_plan(rig, rng)
    columns, motion = noise_free(rig, plan, RigDeviations(), None, {})
    sigmas = channel_noise(rig)
    noise = {name: sigma * rng.standard_normal(plan.rows) for name, sigma in sigmas.items()}
    readings = read_out(rig, plan, columns, noise, None, {}, np.empty(0))
    steps = rig.fine_steps
    given = {
        "t_s": readings["t_s"],
        "z_cmd_m": readings["z_cmd_m"],
        "z_m": motion.z_m[::steps][: plan.rows],
        "vz_m_per_s": motion.v_m_per_s[::steps][: plan.rows],
        "az_m_per_s2": motion.a_m_per_s2[::steps][: plan.rows],
    }
    predicted = model.simulate(given)
    names = [*WRENCH, "z_m"] if rig.predicts_height else list(WRENCH)
    ratios = {name: float(np.sqrt(np.mean((readings[name] - predicted.get(name, 0.0)) ** 2)) / sigmas[name]) for name in names}
    exact = {
        f"{name} without noise": float(np.sqrt(np.mean((columns[name] - predicted[name]) ** 2)) / sigmas[name])
        for name in names
        if name in predicted
    }
    return ratios | exact


# ---------------------------------------------------------------- the ten models


def make_cell(
    *,
    mass_kg: float,
    tip_radius_m: float,
    tip_length_m: float,
    rate_Hz: float,
    cutoff_Hz: float | None,
    noise_N: float,
    noise_Nm: float,
    servo_Hz: float,
    servo_damping: float,
    surface_z_m: float | None,
    youngs_modulus_Pa: float = 72000,
    tolerances: Mapping[str, float],
    position_noise_m: float = 5e-6,
    press_surface_m: float = 2e-5,
    press_stiffness: float = 0.006,
) -> dict:
    tissue = None if surface_z_m is None else {"surface_z_m": surface_z_m, "youngs_modulus_Pa": youngs_modulus_Pa, "poisson_ratio": 0.5}
    usual = {
        "bias_N": 0.1 * noise_N,
        "drift_N_per_min": 0.1 * noise_N,
        "gain": 0.004,
        "latency_s": 0.001,
        "filter_cutoff": 0.05,
        "crosstalk": 0.003,
        "mass_kg": 0.012 * mass_kg,
        "youngs_modulus": 0.012,
        "surface_z_m": 3e-5,
        "servo_natural_frequency": 0.01,
    }
    return {
        "probe": {"mass_kg": mass_kg, "tip_radius_m": tip_radius_m, "tip_length_m": tip_length_m},
        "sensor": {
            "rate_Hz": rate_Hz,
            "filter_cutoff_Hz": cutoff_Hz,
            "noise_rms_N": noise_N,
            "noise_rms_Nm": noise_Nm,
            "resolution_fxy_N": 0.2 * noise_N,
            "resolution_fz_N": 0.4 * noise_N,
            "resolution_Nm": 0.2 * noise_Nm,
        },
        "robot": {
            "servo_natural_frequency_Hz": servo_Hz,
            "servo_damping_ratio": servo_damping,
            "position_noise_rms_m": position_noise_m,
            "velocity_noise_rms_m_per_s": 2.0e-4,
        },
        "tissue": tissue,
        "tolerances": usual | dict(tolerances),
        "repeatability": {"surface_z_m": press_surface_m, "stiffness": press_stiffness},
    }


def build(name: str, about: str, effects: tuple[str, ...], rig: OwnRig) -> Model:
    return Model(name=name, about=about, cell=rig.cell, simulate=partial(simulated, rig), effects=effects, rig=rig)


FOAM = OwnRig(
    cell=make_cell(
        mass_kg=0.25,
        tip_radius_m=0.015,
        tip_length_m=0.06,
        rate_Hz=250,
        cutoff_Hz=100,
        noise_N=0.04,
        noise_Nm=0.0012,
        position_noise_m=1.2e-05,
        servo_Hz=4.51,
        servo_damping=0.794,
        surface_z_m=0.02,
        youngs_modulus_Pa=230000,
        tolerances={"surface_z_m": 4e-5},
    ),
    contact=foam_contact,
    servo=partial(third_order_servo, frequency_Hz=7.0, damping=0.8, lag_s=0.02),
    reach_m=0.0095,
    speeds_m_per_s=(0.025, 0.07),
    force_N=6.8,
    predicts_height=True,
)
LAYERED_GEL = OwnRig(
    cell=make_cell(
        mass_kg=0.15,
        tip_radius_m=0.006,
        tip_length_m=0.09,
        rate_Hz=500,
        cutoff_Hz=150,
        noise_N=0.035,
        noise_Nm=0.0015,
        servo_Hz=3.57,
        servo_damping=0.746,
        surface_z_m=0.0,
        youngs_modulus_Pa=48000,
        tolerances={"servo_natural_frequency": 0.03, "youngs_modulus": 0.015},
    ),
    contact=layered_gel_contact,
    servo=partial(jerk_limited_servo, times_s=(0.07, 0.04, 0.03)),
    reach_m=0.005,
    speeds_m_per_s=(0.025, 0.09),
    force_N=2.6,
)
CONE = OwnRig(
    cell=make_cell(
        mass_kg=0.3,
        tip_radius_m=0.003,
        tip_length_m=0.05,
        rate_Hz=200,
        cutoff_Hz=60,
        noise_N=0.05,
        noise_Nm=0.001,
        servo_Hz=3.71,
        servo_damping=0.37,
        surface_z_m=-0.01,
        youngs_modulus_Pa=12000,
        tolerances={"gain": 0.003, "surface_z_m": 2.5e-5},
    ),
    contact=cone_contact,
    servo=partial(delayed_pi_servo, kp_per_s=18.0, ki_per_s2=25.0, lag_s=0.012, delay_s=0.014),
    background=drag_background,
    reach_m=0.006,
    speeds_m_per_s=(0.02, 0.05),
    force_N=6.3,
    predicts_height=True,
)
RELAXING_PUNCH = OwnRig(
    cell=make_cell(
        mass_kg=0.2,
        tip_radius_m=0.005,
        tip_length_m=0.08,
        rate_Hz=250,
        cutoff_Hz=80,
        noise_N=0.03,
        noise_Nm=0.001,
        servo_Hz=4.3,
        servo_damping=0.84,
        surface_z_m=0.005,
        youngs_modulus_Pa=220000,
        tolerances={"servo_natural_frequency": 0.03},
    ),
    contact=relaxing_punch_contact,
    servo=partial(rate_limited_servo, kp_per_s=16.0, lag_s=0.02, v_max_m_per_s=0.05, a_max_m_per_s2=0.45),
    reach_m=0.0032,
    speeds_m_per_s=(0.015, 0.04),
    force_N=4.3,
    gives_contact=True,
)
WINKLER_BED = OwnRig(
    cell=make_cell(
        mass_kg=0.4,
        tip_radius_m=0.02,
        tip_length_m=0.1,
        rate_Hz=125,
        cutoff_Hz=None,
        noise_N=0.05,
        noise_Nm=0.002,
        servo_Hz=4.0,
        servo_damping=0.583,
        surface_z_m=0.1,
        youngs_modulus_Pa=400000,
        tolerances={"servo_natural_frequency": 0.03, "youngs_modulus": 0.015, "surface_z_m": 3e-5},
    ),
    contact=winkler_contact,
    servo=partial(delayed_pi_servo, kp_per_s=15.0, ki_per_s2=1.0, lag_s=0.02, delay_s=0.02),
    reach_m=0.004,
    speeds_m_per_s=(0.02, 0.05),
    force_N=6.5,
)
BELLOWS = OwnRig(
    cell=make_cell(
        mass_kg=0.35,
        tip_radius_m=0.012,
        tip_length_m=0.07,
        rate_Hz=400,
        cutoff_Hz=120,
        noise_N=0.08,
        noise_Nm=0.002,
        position_noise_m=1.5e-05,
        servo_Hz=5.25,
        servo_damping=0.83,
        surface_z_m=0.03,
        youngs_modulus_Pa=72000,
        tolerances={"surface_z_m": 6e-5},
        press_surface_m=4e-5,
    ),
    contact=bellows_contact,
    servo=partial(rate_limited_servo, kp_per_s=20.0, lag_s=0.018, v_max_m_per_s=0.066, a_max_m_per_s2=1.0),
    background=chain_background,
    reach_m=0.012,
    speeds_m_per_s=(0.03, 0.068),
    force_N=6.5,
    predicts_height=True,
)
MUJOCO_BALL = OwnRig(
    cell=make_cell(
        mass_kg=0.18,
        tip_radius_m=0.006,
        tip_length_m=0.075,
        rate_Hz=250,
        cutoff_Hz=90,
        noise_N=0.025,
        noise_Nm=0.001,
        servo_Hz=4.33,
        servo_damping=0.8,
        surface_z_m=0.004,
        youngs_modulus_Pa=66000,
        tolerances={},
    ),
    contact=mujoco_ball_contact,
    servo=partial(
        mujoco_servo,
        kp_N_per_m=2600,
        kv_N_s_per_m=95,
        lag_s=0.012,
        mass_kg=1.2,
        armature_kg=0.6,
        damping_N_s_per_m=25,
    ),
    reach_m=0.006,
    speeds_m_per_s=(0.02, 0.06),
    force_N=3.85,
    predicts_height=True,
    gives_contact=True,
)
MUJOCO_PLATE = OwnRig(
    cell=make_cell(
        mass_kg=0.22,
        tip_radius_m=0.005,
        tip_length_m=0.08,
        rate_Hz=500,
        cutoff_Hz=150,
        noise_N=0.035,
        noise_Nm=0.0015,
        servo_Hz=4.45,
        servo_damping=0.833,
        surface_z_m=0.05,
        youngs_modulus_Pa=12000,
        tolerances={"servo_natural_frequency": 0.02, "youngs_modulus": 0.012},
    ),
    contact=mujoco_plate_contact,
    servo=partial(third_order_servo, frequency_Hz=6.0, damping=0.9, lag_s=0.012),
    reach_m=0.008,
    speeds_m_per_s=(0.025, 0.085),
    force_N=4.5,
)
COGGING_AXIS = OwnRig(
    cell=make_cell(
        mass_kg=0.9,
        tip_radius_m=0.005,
        tip_length_m=0.05,
        rate_Hz=250,
        cutoff_Hz=100,
        noise_N=0.05,
        noise_Nm=0.001,
        servo_Hz=4.07,
        servo_damping=0.744,
        surface_z_m=None,
        tolerances={"servo_natural_frequency": 0.03, "mass_kg": 0.008},
    ),
    contact=None,
    servo=partial(smoothed_second_order_servo, frequency_Hz=7.0, damping=0.75, time_s=0.05),
    background=cogging_background,
    reach_m=0.035,
    middle_z_m=0.05,
    speeds_m_per_s=(0.03, 0.09),
    force_N=1.5,
    choices={"presliding": 0.0},
)
MUJOCO_TENDON = OwnRig(
    cell=make_cell(
        mass_kg=0.5,
        tip_radius_m=0.004,
        tip_length_m=0.06,
        rate_Hz=200,
        cutoff_Hz=70,
        noise_N=0.06,
        noise_Nm=0.001,
        position_noise_m=1.5e-05,
        servo_Hz=4.12,
        servo_damping=0.721,
        surface_z_m=None,
        tolerances={},
    ),
    contact=None,
    servo=partial(
        mujoco_servo,
        kp_N_per_m=2500,
        kv_N_s_per_m=85,
        lag_s=0.015,
        mass_kg=1.5,
        armature_kg=0.5,
        damping_N_s_per_m=15,
    ),
    background=mujoco_tendon_background,
    reach_m=0.03,
    middle_z_m=0.008,
    speeds_m_per_s=(0.02, 0.06),
    force_N=5.5,
    predicts_height=True,
    choices={"asymmetry side": -1.0},
)

MODELS: dict[str, Model] = {
    model.name: model
    for model in (
        build(
            "foam",
            "A disc presses open-cell foam; the simulator knows its linear part, collapse and "
            "densification, and predicts the third-order servo.",
            (
                "tissue.modulus",
                "tissue.surface",
                "robot.compliance",
                "tissue.viscoelastic",
                "sensor.latency",
                "tissue.plasticity",
                "robot.lag",
                "cable.spring",
            ),
            FOAM,
        ),
        build(
            "layered gel",
            "A sphere presses a gel of power 1.2 over a stiffer core; the simulator knows both layers, not the jerk-limited motion.",
            (
                "tissue.preconditioning",
                "sensor.gain",
                "robot.backlash",
                "tissue.adhesion",
                "sensor.creep",
                "contact.lateral",
                "probe.mass",
                "sensor.noise",
            ),
            LAYERED_GEL,
        ),
        build(
            "cone",
            "A cone presses silicone (force over depth squared) through a seal with known drag; the "
            "simulator predicts the PI servo with its delay.",
            (
                "tissue.thickness",
                "sensor.hysteresis",
                "sensor.saturation",
                "robot.vibration",
                "cable.viscous",
                "tissue.surface",
                "sensor.bias",
                "tissue.inclusion",
            ),
            CONE,
        ),
        build(
            "relaxing punch",
            "A flat punch presses a gel with two relaxation times and a dashpot, all known and given "
            "as contact_N; the servo is rate-limited.",
            (
                "tissue.modulus",
                "tissue.viscoelastic",
                "sensor.creep",
                "sensor.filter",
                "robot.backlash",
                "cable.friction",
                "sensor.crosstalk",
                "tissue.plasticity",
            ),
            RELAXING_PUNCH,
        ),
        build(
            "winkler bed",
            "A large sphere presses a bed of separate hardening springs, known; the servo is a PI loop "
            "with delay, unknown to the simulator.",
            (
                "tissue.inclusion",
                "sensor.asymmetry",
                "tissue.adhesion",
                "clock.skew",
                "robot.compliance",
                "probe.tilt",
                "sensor.drift",
                "sensor.quantization",
            ),
            WINKLER_BED,
        ),
        build(
            "bellows",
            "A probe presses a leaking pneumatic bellows under a hanging hose; the simulator knows "
            "air, leak, wall, hose and the rate-limited servo.",
            (
                "sensor.gain",
                "robot.lag",
                "cable.friction",
                "tissue.preconditioning",
                "sensor.warmup",
                "structure.resonance",
                "tissue.surface",
                "sensor.latency",
            ),
            BELLOWS,
        ),
        build(
            "mujoco soft ball",
            "MuJoCo: a tip presses a sprung ball through a soft contact, given as contact_N; a MuJoCo "
            "position actuator predicts the height.",
            (
                "tissue.modulus",
                "tissue.thickness",
                "robot.compliance",
                "sensor.filter",
                "contact.lateral",
                "cable.spring",
                "sensor.saturation",
                "tissue.adhesion",
            ),
            MUJOCO_BALL,
        ),
        build(
            "mujoco hinged plate",
            "MuJoCo: a tip presses a hinged plate held by an actuator, with known lateral force and "
            "torque; the third-order servo is unknown.",
            (
                "contact.lateral",
                "tissue.viscoelastic",
                "probe.mass",
                "sensor.bias",
                "robot.backlash",
                "sensor.dropout",
                "robot.vibration",
                "tissue.modulus",
            ),
            MUJOCO_PLATE,
        ),
        build(
            "cogging axis",
            "No tissue: a linear motor with two known orders of cogging and a cable that stiffens and "
            "pulls sideways; its smoothed servo is unknown.",
            (
                "cable.friction",
                "cable.viscous",
                "probe.mass",
                "structure.resonance",
                "sensor.warmup",
                "sensor.latency",
                "cable.spring",
                "sensor.crosstalk",
            ),
            COGGING_AXIS,
        ),
        build(
            "mujoco tendon",
            "No tissue: in MuJoCo a tendon on a sprung clamp pulls the tip above some height; a MuJoCo "
            "actuator of third order predicts the height.",
            (
                "sensor.gain",
                "sensor.hysteresis",
                "clock.skew",
                "robot.lag",
                "cable.friction",
                "probe.tilt",
                "sensor.drift",
                "sensor.asymmetry",
            ),
            MUJOCO_TENDON,
        ),
    )
}
