"""How far a force runs past the limit that trips it: stiffness × speed × the sum of all delays, before anything has moved."""

import math
from typing import TypedDict

from palpd.cell.plausible import PLAUSIBLE
from palpd.config import Config, Plan, filter_delay_s, refuse_unsafe
from palpd.control.slopes import GRAVITY_N_PER_KG
from palpd.daemon.stored_state import SOFTEST_N_PER_M
from palpd.errors import ConfigError

LINK_S = 0.001
"""Time from a byte of the sensor to the daemon's buffer. Measured on the emulated line; a USB line was never measured."""
CONTROLLER_CYCLES = 2.0
"""Cycles from a speed command to its effect: it waits for the next cycle and acts in the one after."""
BLUNTEST_M = PLAUSIBLE["tip radius"].high
"""Largest radius of a tip that a palpation counts with."""
WALLS_N_PER_M = (1000.0, 5000.0, 20000.0)
"""Stiffnesses that the forecast covers besides the expected one: soft tissue, firm tissue, a board."""


class Delay(TypedDict):
    """One delay between a force and the arm's reaction, and where its value comes from."""

    name: str
    duration_s: float
    source: str


class OvershootRow(TypedDict):
    """The overshoot against one stiffness at one speed."""

    stiffness_N_per_m: float
    speed_m_per_s: float
    overshoot_N: float


class OvershootForecast(TypedDict):
    """Limits, delays and overshoots of a configuration with a plan."""

    contact_limit_N: float
    absolute_limit_N: float
    delays: list[Delay]
    overshoot: list[OvershootRow]


def delays(config: Config, speed_m_per_s: float) -> list[Delay]:
    """Every delay between the force at the tip and the tip at rest.

    Args:
        speed_m_per_s: Speed of the press, for the time of braking.

    Returns:
        The delays in the order in which they occur.
    """
    sensor, robot, servo = config.sensor, config.robot, config.cell.robot
    lag_s = 2.0 * servo.servo_damping_ratio / (2.0 * math.pi * servo.servo_natural_frequency_Hz)
    terms = (
        ("sensor filter", filter_delay_s(sensor.filter_cutoff_Hz), "one pole at sensor.filter_cutoff_Hz"),
        ("sensor sample", 1.0 / sensor.rate_Hz, "sensor.rate_Hz"),
        ("serial line", LINK_S, "measured on an emulated line"),
        ("loop", 1.0 / robot.rate_Hz, "one tick, worst phase"),
        ("controller", CONTROLLER_CYCLES * {"ur5": 0.008, "ur5e": 0.002}[robot.model], "two cycles of the controller"),
        ("servo lag", lag_s, "2ζ/ωn of cell.robot, a placeholder until measured"),
        ("braking", 0.5 * speed_m_per_s / robot.acceleration_m_per_s2, "v/2a of robot.acceleration_m_per_s2"),
    )
    return [Delay(name=name, duration_s=duration_s, source=source) for name, duration_s, source in terms]


def overshoot_N(config: Config, speed_m_per_s: float, stiffness_N_per_m: float) -> float:
    """Force beyond the limit at which the daemon reacts, against a linear wall: k v times all delays, three sigmas of noise, one count.

    Args:
        speed_m_per_s: Speed of the press.
    """
    sensor = config.cell.sensor
    noise_N = 3.0 * sensor.noise_rms_N + sensor.resolution_fz_N
    return stiffness_N_per_m * speed_m_per_s * math.fsum(delay["duration_s"] for delay in delays(config, speed_m_per_s)) + noise_N


def refuse_overload(config: Config, plan: Plan) -> None:
    """Refuse limits that let the expected stiffness overload the sensor before the arm reacts.

    Args:
        config: The configuration, for limits and delays.
        plan: The plan, for its speeds.

    Raises:
        ConfigError: Contact limit and overshoot reach the sensor's capacity.
    """
    speed = max(plan.press_speed_m_per_s, plan.search.speed_m_per_s)
    stiffness = config.safety.expected_stiffness_N_per_m
    peak_N = config.safety.contact_limit_N + overshoot_N(config, speed, stiffness)
    if peak_N >= config.sensor.capacity_N:
        sentence = (
            f"contact_limit_N of {config.safety.contact_limit_N:g} N and an overshoot of "
            f"{peak_N - config.safety.contact_limit_N:.0f} N at {speed:g} m/s on {stiffness:g} N/m reach {peak_N:.0f} N, "
            f"beyond the sensor's {config.sensor.capacity_N:g} N; press slower or lower the limit"
        )
        raise ConfigError(sentence, {"press_speed_m_per_s" if speed == plan.press_speed_m_per_s else "search.speed_m_per_s": sentence})


def refuse_together(config: Config, plan: Plan) -> None:
    """Refuse limits and a plan that do not fit each other.

    Raises:
        ConfigError: They do not fit, the stated machine is too soft to be one, or the probe too heavy or too blunt.
    """
    refuse_unsafe(config, plan)
    refuse_overload(config, plan)
    probe, weight_N = config.cell.probe, config.cell.probe.mass_kg * GRAVITY_N_PER_KG
    if weight_N >= config.sensor.capacity_N:
        raise ConfigError(
            f"cell.probe.mass_kg is {probe.mass_kg:g}, a weight of {weight_N:.0f} N, beyond the sensor's {config.sensor.capacity_N:g} N; "
            "write it in kg (200 g is 0.2)"
        )
    if probe.tip_radius_m > BLUNTEST_M:
        raise ConfigError(
            f"cell.probe.tip_radius_m is {probe.tip_radius_m:g}, expected at most {BLUNTEST_M:g} m; write it in metres (0.5 mm is 0.0005)"
        )
    stated_N_per_m = config.machine.stiffness_N_per_m
    if stated_N_per_m is not None and stated_N_per_m < SOFTEST_N_PER_M:
        raise ConfigError(
            f"machine.stiffness_N_per_m is {stated_N_per_m:g}, that is {stated_N_per_m / 1e3:.3g} N for 1 mm, expected at least "
            f"{SOFTEST_N_PER_M / 1e3:g} N of a machine on a rigid plate; write it in N/m (48 N for 1 mm is 48000), or null for what "
            "palpd stiffness has measured"
        )


def predicted(config: Config, plan: Plan) -> OvershootForecast:
    """Delays and overshoots for the speeds of a plan, against soft and hard walls and the expected stiffness.

    Args:
        config: The configuration, for limits and delays.

    Returns:
        The forecast of `palpd check-config`.
    """
    speeds = sorted({plan.search.speed_m_per_s, plan.press_speed_m_per_s})
    stiffnesses = sorted({*WALLS_N_PER_M, config.safety.expected_stiffness_N_per_m})
    return {
        "contact_limit_N": config.safety.contact_limit_N,
        "absolute_limit_N": config.safety.absolute_limit_N,
        "delays": delays(config, speeds[-1]),
        "overshoot": [
            {"stiffness_N_per_m": k, "speed_m_per_s": v, "overshoot_N": overshoot_N(config, v, k)} for k in stiffnesses for v in speeds
        ],
    }
