"""Controllers: what becomes of a commanded height before it is a joint's target, and how a user identifies them."""

import numpy as np
from scipy import optimize, signal

from palpd.blind.mujoco.setup import Array, PlantSetup


def linear_filter(numerator: list[float], denominator: list[float], step_s: float, values: Array) -> Array:
    """The output of a continuous linear system whose input runs straight from sample to sample and begins at rest at zero.

    Args:
        numerator: coefficients in s, highest power first.
        denominator: coefficients in s, highest power first.
        values: (n,) input.

    Returns:
        (n,) output.
    """
    b, a, _ = signal.cont2discrete((np.array(numerator), np.array(denominator)), step_s, method="foh")
    return np.asarray(signal.lfilter(np.ravel(b), np.ravel(a), values), dtype=float)


def second_order(z_m: Array, step_s: float, natural_frequency_Hz: float, damping_ratio: float) -> Array:
    """The servo of docs/reference/contract.md §3: the height that follows a commanded height as a second-order system, at rest at first.

    Args:
        z_m: (n,) commanded height, m.

    Returns:
        (n,) height, m.
    """
    omega = 2 * np.pi * natural_frequency_Hz
    return z_m[0] + linear_filter([omega**2], [1.0, 2 * damping_ratio * omega, omega**2], step_s, z_m - z_m[0])


def setpoint(plant: PlantSetup, t_s: Array, z_cmd_m: Array) -> tuple[Array, Array, Array]:
    """Target height, speed and acceleration of the position loop.

    Args:
        plant: its servo design, bandwidth ratio, vibration and time step.
        t_s: (n,) times, s; negative while the rig settles.
        z_cmd_m: (n,) commanded height on the physics grid, m.

    Returns:
        (n,) target height in m, (n,) speed in m/s and (n,) acceleration in m/s².
    """
    servo, step, z = plant.servo, plant.step_s, z_cmd_m - z_cmd_m[0]
    if servo.jerk_window_s > 0:
        width = max(1, round(servo.jerk_window_s / step))
        z = np.convolve(np.concatenate([np.zeros(width - 1), z]), np.full(width, 1 / width), mode="valid")
    every = 1 if servo.hold_Hz is None else round(1 / (servo.hold_Hz * step))
    omega = 2 * np.pi * servo.natural_frequency_Hz * plant.servo_ratio
    poles = [1.0, 2 * servo.damping_ratio * omega, omega**2]
    if servo.extra_pole_Hz is not None:
        poles = list(np.polymul(poles, [1 / (2 * np.pi * servo.extra_pole_Hz * plant.servo_ratio), 1.0]))
    ticks = z[::every]
    height, speed, acceleration = (
        np.repeat(linear_filter([omega**2, *[0.0] * order], poles, step * every, ticks), every)[: len(z)] for order in range(3)
    )
    amplitude, frequency, phase = plant.vibration
    if amplitude:
        wave, angle = 2 * np.pi * frequency, 2 * np.pi * frequency * t_s + phase
        size = amplitude * np.clip(t_s / 0.2 + 1.0, 0.0, 1.0)
        height, speed = height + size * np.sin(angle), speed + size * wave * np.cos(angle)
        acceleration = acceleration - size * wave**2 * np.sin(angle)
    if plant.backlash_m > 0:
        # The controller knows the friction of its own guide, and leans against it as soon as the play is closed.
        dragged = play(height, plant.backlash_m / 2)
        height = height + (height - dragged) / (plant.backlash_m / 2) * plant.guide_friction_N / drive_stiffness_N_per_m(plant)
    return z_cmd_m[0] + height, speed, acceleration


def drive_stiffness_N_per_m(plant: PlantSetup) -> float:
    """Stiffness of the slide's position loop."""
    return plant.moving_mass_kg * (2 * np.pi * plant.servo.inner_frequency_Hz) ** 2


def play(values: Array, width: float) -> Array:
    """The play operator of a series: an output that is dragged along inside of a dead band.

    Args:
        values: (n,) input.
        width: half the dead band, in the input's unit.

    Returns:
        (n,) output.
    """
    out, at = np.empty(len(values)), 0.0
    for i, value in enumerate(values.tolist()):
        if at < value - width:
            at = value - width
        elif at > value + width:
            at = value + width
        out[i] = at
    return out


def identify_servo(t_s: Array, z_cmd_m: Array, z_m: Array) -> tuple[float, float]:
    """Natural frequency and damping ratio of the second-order system that fits a free motion best.

    Args:
        t_s: (n,) uniform times, s.
        z_cmd_m: (n,) commanded height, m.
        z_m: (n,) reported height, m.

    Returns:
        Natural frequency in Hz and damping ratio.
    """
    step = float(np.median(np.diff(t_s)))

    def misfit(log_values: Array) -> Array:
        frequency, damping = np.exp(log_values)
        return (second_order(z_cmd_m, step, frequency, damping) - z_m) * 1e6

    fit = optimize.least_squares(misfit, np.log([6.0, 0.9]), bounds=(np.log([0.5, 0.2]), np.log([40.0, 4.0])))
    frequency, damping = np.exp(fit.x)
    return float(frequency), float(damping)
