"""Sign and scale of the force sensor, checked with a known weight."""

from collections.abc import Callable
from typing import Any

import numpy as np

from palpd.config import SensorConfig
from palpd.control.tare import base_from_sensor, to_base
from palpd.daemon.doctor.devices import observed
from palpd.daemon.finding import Finding
from palpd.tick import Floats, ForceSensor, RobotState

SETTLED_S = 2.0
"""How long each of the two forces is averaged: a swinging weight of 0.2 m makes two periods."""
WEIGHT_OK, WEIGHT_BAD = 0.05, 0.10
"""Largest relative errors for ok and for warn. A weight pulls, and a pulled HEX may be 8 % more sensitive on Fz than a pressed one."""
CROSSTALK = 0.10
"""Largest force across the weight, as a share of it: twice the crosstalk of the data sheet."""
STRAIGHT_DOWN = (np.pi, 0.0, 0.0)
"""Axis-angle vector of a tool that points straight down, rad."""

TOOL_DOWN = 0.9
"""Cosine of the angle to straight down within which a hung weight pulls on the sensor."""
LEAST_APART = 0.03
"""Relative difference of two slopes that a weight known to 1 % can show."""

AskOperator = Callable[[str], object]
"""Tells the operator what to do and returns when that is done."""


def check_weight(
    sensor: ForceSensor,
    robot: RobotState | None,
    config: SensorConfig,
    weight_N: float,
    ask: AskOperator,
    pulled_over_pressed: float | None = None,
) -> Finding:
    """Check sign and scale of the sensor with a known weight. It pulls straight down, in any orientation of the sensor.

    Where the sensor has two slopes of Fz and the weight pulls on it, the check also says where the slopes part.

    Args:
        sensor: The open sensor.
        robot: State of the robot, for its orientation; without one the tool points straight down.
        config: How the sensor is mounted and which slopes are set.
        ask: Tells the operator what to do.
        pulled_over_pressed: Ratio of the sensor's two slopes of Fz; None where it has one.
    """
    ask("Leave the probe free and still.")
    free = _mean(sensor)
    ask(f"Hang {weight_N:g} N on the probe and let it come to rest.")
    loaded = _mean(sensor)
    if free is None or loaded is None:
        return Finding("known weight", "fail", "no frame came from the sensor", "check its cable and power")
    rotation = base_from_sensor(robot.tcp_pose[3:] if robot else STRAIGHT_DOWN, config.rotation_about_flange_z_rad)
    x_N, y_N, z_N, *_ = to_base(loaded.tolist(), free.tolist(), rotation)
    ratio, across = -z_N / weight_N, float(np.hypot(x_N, y_N)) / weight_N
    figures = {"weight_N": weight_N, "measured_N": -z_N, "across_N": across * weight_N, "ratio": ratio}
    measured = f"{-z_N:.2f} N down and {across * weight_N:.2f} N across of {weight_N:g} N hung on it"
    if abs(ratio) < 0.5 < across:
        advice = "the weight shows across and not down: the sensor's axes are not the tool's; mount it with its z along the flange's z"
        return Finding("known weight", "fail", measured, advice, figures)
    if abs(ratio) < 0.2:
        return Finding("known weight", "fail", measured, "the weight does not hang on the sensor, or the sensor is dead", figures)
    if ratio < 0:
        advice = "the sign is wrong, and no limit would act; do not move. Was the weight hung, not pushed? Else turn the sensor round"
        return Finding("known weight", "fail", measured, advice, figures)
    pulls = rotation[2][2] < -TOOL_DOWN and config.fz_slopes != "pulled"
    if pulls and pulled_over_pressed is not None and abs(pulled_over_pressed - 1.0) > LEAST_APART:
        finding, ratio = _slopes(ratio, pulled_over_pressed, config.fz_slopes, measured, figures)
        if finding is not None:
            return finding
    if abs(ratio - 1) > WEIGHT_BAD:
        return Finding("known weight", "fail", measured, "set counts_per_N and counts_per_Nm from this unit's calibration sheet", figures)
    if abs(ratio - 1) > WEIGHT_OK:
        return Finding("known weight", "warn", measured, "pulling may read 8 % more than pressing; else correct counts_per_N", figures)
    if across > CROSSTALK:
        return Finding(
            "known weight", "warn", measured, "the weight swings or pulls aslant, or crosstalk is above the sheet's 5 %", figures
        )
    return Finding("known weight", "ok", measured, "", figures)


def _slopes(ratio: float, pulled_over_pressed: float, setting: str, measured: str, figures: dict[str, Any]) -> tuple[Finding | None, float]:
    """Where the slopes of Fz part: a finding where the setting says otherwise, and the ratio of the weight by the law that fits."""
    at_load = abs(ratio - pulled_over_pressed) < abs(ratio - 1.0)
    figures["slopes_part_at"] = "load" if at_load else "reading"
    by_law = ratio / pulled_over_pressed if at_load else ratio
    if abs(by_law - 1.0) > WEIGHT_OK or at_load == (setting == "both"):
        return None, by_law
    if at_load:
        advice = "the slopes of Fz part where the sensor carries nothing: set sensor.fz_slopes to both, or every contact is over-read"
    else:
        advice = "the slopes of Fz do not part where the sensor carries nothing: set sensor.fz_slopes to pressed"
    return Finding("known weight", "warn", measured, advice, figures), by_law


def _mean(sensor: ForceSensor) -> Floats | None:
    wrench = observed(sensor, None, SETTLED_S).wrench
    return wrench.mean(axis=0) if len(wrench) else None
