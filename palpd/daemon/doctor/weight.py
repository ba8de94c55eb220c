"""Sign and scale of the force sensor, checked with a known weight."""

from collections.abc import Callable

import numpy as np

from palpd.control.tare import base_from_sensor, to_base
from palpd.daemon.doctor.devices import observed
from palpd.daemon.doctor.finding import Finding
from palpd.tick import Floats, ForceSensor, RobotState

SETTLED_S = 2.0
"""How long each of the two forces is averaged: a swinging weight of 0.2 m makes two periods."""
WEIGHT_OK, WEIGHT_BAD = 0.05, 0.10
"""Largest relative errors for ok and for warn. A weight pulls, and a pulled HEX may be 8 % more sensitive on Fz than a pressed one."""
CROSSTALK = 0.10
"""Largest force across the weight, as a share of it: twice the crosstalk of the data sheet."""
STRAIGHT_DOWN = (np.pi, 0.0, 0.0)
"""Axis-angle vector of a tool that points straight down, rad."""

AskOperator = Callable[[str], object]
"""Tells the operator what to do and returns when that is done."""


def check_weight(sensor: ForceSensor, robot: RobotState | None, about_flange_z_rad: float, weight_N: float, ask: AskOperator) -> Finding:
    """Check sign and scale of the sensor with a known weight. It pulls straight down, in any orientation of the sensor.

    Args:
        sensor: The open sensor.
        robot: State of the robot, for its orientation; without one the tool points straight down.
        about_flange_z_rad: Mounting angle of the sensor.
        weight_N: The weight.
        ask: Tells the operator what to do.

    Returns:
        One finding.
    """
    ask("Leave the probe free and still.")
    free = _mean(sensor)
    ask(f"Hang {weight_N:g} N on the probe and let it come to rest.")
    loaded = _mean(sensor)
    if free is None or loaded is None:
        return Finding("known weight", "fail", "no frame came from the sensor", "check its cable and power")
    rotation = base_from_sensor(robot.tcp_pose[3:] if robot else STRAIGHT_DOWN, about_flange_z_rad)
    x_N, y_N, z_N, *_ = to_base(loaded.tolist(), free.tolist(), rotation)
    ratio, across = -z_N / weight_N, float(np.hypot(x_N, y_N)) / weight_N
    figures = {"weight_N": weight_N, "measured_N": -z_N, "across_N": across * weight_N, "ratio": ratio}
    measured = f"{-z_N:.2f} N down and {across * weight_N:.2f} N across of {weight_N:g} N hung on it"
    if abs(ratio) < 0.2:
        return Finding("known weight", "fail", measured, "the weight does not hang on the sensor, or the sensor is dead", figures)
    if ratio < 0:
        advice = "the sign is wrong: pressed would read as pulled, and no limit would act; do not move. Was the weight hung, not pushed?"
        return Finding("known weight", "fail", measured, advice, figures)
    if abs(ratio - 1) > WEIGHT_BAD:
        return Finding("known weight", "fail", measured, "set counts_per_N and counts_per_Nm from this unit's calibration sheet", figures)
    if abs(ratio - 1) > WEIGHT_OK:
        return Finding("known weight", "warn", measured, "pulling may read 8 % more than pressing; else correct counts_per_N", figures)
    if across > CROSSTALK:
        return Finding(
            "known weight", "warn", measured, "the weight swings or pulls aslant, or crosstalk is above the sheet's 5 %", figures
        )
    return Finding("known weight", "ok", measured, "", figures)


def _mean(sensor: ForceSensor) -> Floats | None:
    wrench = observed(sensor, None, SETTLED_S).wrench
    return wrench.mean(axis=0) if len(wrench) else None
