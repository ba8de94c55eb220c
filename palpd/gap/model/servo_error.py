"""How real controllers differ from the nominal second-order servo without being slower: part of every healthy cell."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import pi

import numpy as np

from palpd.cell.cell_file import CellFile, Estimated
from palpd.cell.dynamics import State, integral
from palpd.cell.effects import Effect
from palpd.cell.simulation import predict_motion
from palpd.gap.assumptions import ASSUMED
from palpd.gap.data.noise import FZ, Z
from palpd.gap.data.prepare import PreparedRecording
from palpd.tick import Floats

ORDER = "controller order"
"""Name of the column for the order of a controller."""
HELD_TARGETS = "held targets"
"""Name of the column for the mean that samples miss between held targets."""


@dataclass(frozen=True)
class ServoErrors:
    """What a controller within specification may change in one recording, each as large as a standard deviation; 0 without a command.

    Attributes:
        heights_m: Heights (b,) by a delay inside the controller, by its order, by a limit of the jerk, and by the tolerance of its damping.
            Where the recorded command is held, also by half of that time: the servo may have been identified with a smooth command.
            Where the recording starts in motion, also by the error of the height and of the speed from which the servo starts.
        inertial_N: Force of inertia (b,) by these, by two further terms of the order's series in the servo's time constant, and by the
            tolerance of the natural frequency. Where a command is known, the acceleration is mostly that of the stated servo. And, with
            no command too, what samples miss between held targets.
    """

    heights_m: Mapping[str, Floats]
    inertial_N: Mapping[str, Floats]

    def without(self, name: str) -> "ServoErrors":
        """The same without a change of the force of inertia."""
        return replace(self, inertial_N={one: change_N for one, change_N in self.inertial_N.items() if one != name})


def servo_errors(recording: PreparedRecording, cell: CellFile, library: Mapping[str, Effect]) -> ServoErrors:
    """What a controller within specification may change.

    Args:
        recording: A prepared recording, b bins.
        cell: Its nominal cell.
        library: Effects by id.
    """
    simulated = recording.simulated
    if recording.z_cmd_m is None or not (recording.judged[Z] or simulated is not None):
        return ServoErrors({}, {HELD_TARGETS: _held_targets_N(recording, cell)})
    t_s, z_cmd_m = recording.robot_t_s, recording.z_cmd_m
    start = recording.state_at(float(t_s[0]))
    nominal_m = predict_motion(cell, t_s, z_cmd_m, library, start=start)
    time_constant_s = 1.0 / (2.0 * pi * cell.robot.servo_natural_frequency_Hz)
    order_m = ASSUMED.noise.acceleration_share * time_constant_s**2 * _second_derivative(nominal_m, t_s)
    largest_delay_s = ASSUMED.noise.largest_delay_share * _lag_s(cell)
    delay_s, width_s = min(ASSUMED.noise.hidden_delay_s, largest_delay_s), min(ASSUMED.noise.jerk_limit_s, 2.0 * largest_delay_s)
    tolerance = cell.tolerances.servo_natural_frequency
    damped = cell.robot.model_copy(update={"servo_damping_ratio": cell.robot.servo_damping_ratio * (1.0 + tolerance)})
    heights_m = {
        "hidden delay": _behind(cell, library, t_s, np.interp(t_s - delay_s, t_s, z_cmd_m), delay_s, 0.0, start) - nominal_m,
        "jerk limit": _behind(cell, library, t_s, _averaged(t_s, z_cmd_m, width_s), 0.5 * width_s, width_s**2 / 12.0, start) - nominal_m,
        ORDER: order_m,
        "damping": predict_motion(cell.model_copy(update={"robot": damped}), t_s, z_cmd_m, library, start=start) - nominal_m,
    }
    if start is not None:
        (height_m, speed_m_per_s), error_m_per_s = start, ASSUMED.noise.starting_speed_share * start[1]
        for name, other in (
            ("height at the start", (height_m + error_m_per_s * time_constant_s, speed_m_per_s)),
            ("speed at the start", (height_m, speed_m_per_s + error_m_per_s)),
        ):
            heights_m[name] = predict_motion(cell, t_s, z_cmd_m, library, start=other) - nominal_m
    if recording.held_command_s is not None:
        heights_m["held command"] = np.interp(t_s - 0.5 * recording.held_command_s, t_s, nominal_m) - nominal_m
    if simulated is not None and simulated.faster_m is not None:
        heights_m["natural frequency of the user's servo"] = np.interp(t_s, simulated.sampled.motion.t_s, simulated.faster_m)
    faster = cell.with_estimated(Estimated(servo_natural_frequency=tolerance))
    accelerated_m = heights_m | {
        f"{ORDER}, 2nd term": time_constant_s * np.gradient(order_m, t_s),
        f"{ORDER}, 3rd term": time_constant_s**2 * _second_derivative(order_m, t_s),
        "natural frequency": predict_motion(faster, t_s, z_cmd_m, library, start=start) - nominal_m,
    }
    inertial_N = _inertial_forces(recording, cell, library, list(accelerated_m.values()))
    return ServoErrors(
        {name: recording.z_means @ change_m for name, change_m in heights_m.items()},
        {HELD_TARGETS: _held_targets_N(recording, cell), **dict(zip(accelerated_m, inertial_N, strict=True))},
    )


def _inertial_forces(recording: PreparedRecording, cell: CellFile, library: Mapping[str, Effect], changes_m: Sequence[Floats]) -> Floats:
    """Changes (c, b) of fz in N if the acceleration alone follows each of c changes (k,) of the heights."""
    t_s, motion = recording.robot_t_s, recording.motion

    def fz_N(az_m_per_s2: Floats) -> Floats:
        reading = recording.reading(cell, replace(motion, az_m_per_s2=az_m_per_s2), library)
        return reading.averaged(lambda values: recording.step_means @ values, len(recording.bins))[FZ - 1]

    unchanged_N = fz_N(motion.az_m_per_s2)
    changes_m_per_s2 = [np.interp(motion.t_s, t_s, _second_derivative(change_m, t_s)) for change_m in changes_m]
    return np.array([fz_N(motion.az_m_per_s2 + change_m_per_s2) - unchanged_N for change_m_per_s2 in changes_m_per_s2])


def largest_miss_N_s_per_m(recording: PreparedRecording, cell: CellFile) -> float:
    """Largest force that samples can miss between held targets, over the commanded speed.

    The servo holds its targets between the cycles of its controller. The acceleration then steps by ω² v T at each target, v the commanded
    speed, and falls until the next one. Samples at one phase of the cycle see the mean up to ω² v Δt / 2 too high or too low: the
    harmonics of these steps at multiples of the rate of the samples look like a constant. A filter of the sensor takes away what it takes
    away there.
    """
    natural_frequency_rad_per_s, rate_Hz = 2.0 * pi * cell.robot.servo_natural_frequency_Hz, recording.samples.rate_Hz
    cutoff_Hz = cell.sensor.filter_cutoff_Hz
    passed = (1.0 + (rate_Hz / cutoff_Hz) ** 2) ** -0.5 if cutoff_Hz else 1.0
    return float(0.5 * cell.probe.mass_kg * natural_frequency_rad_per_s**2 / rate_Hz * passed)


def _held_targets_N(recording: PreparedRecording, cell: CellFile) -> Floats:
    """Standard deviation (b,) of the force that samples miss on average between held targets, with its sign."""
    if recording.judged[Z] and recording.z_cmd_m is not None:
        commanded_m_per_s = recording.z_means @ np.gradient(recording.z_cmd_m, recording.robot_t_s)
    else:
        ahead_s, motion = _lag_s(cell), recording.motion
        commanded_m_per_s = recording.step_means @ (motion.vz_m_per_s + ahead_s * motion.az_m_per_s2)
    return np.asarray(largest_miss_N_s_per_m(recording, cell) / 3.0**0.5 * commanded_m_per_s)


def _second_derivative(x: Floats, t_s: Floats) -> Floats:
    return np.asarray(np.gradient(np.gradient(x, t_s), t_s))


def _behind(
    cell: CellFile,
    library: Mapping[str, Effect],
    t_s: Floats,
    late_m: Floats,
    delay_s: float,
    variance_s2: float,
    start: State | None,
) -> Floats:
    """Heights (k,) of a servo that follows a late command, where both together have the lag and the second moment of the stated servo.

    1 / (1 + b1 s + b2 s²) agrees to second order in s with exp(-τ s) (1 + v s²/2) / (1 + b1' s + b2' s²), where b1' = b1 - τ and
    b2' = b2 - b1 τ + (τ² + v)/2. A target that is held, and a servo of higher order, are a delay to third order.

    Args:
        late_m: Commanded heights (k,) that are late by τ, and spread in time by the variance v.
        start: Height and speed at the first of `t_s`; None: at rest.
    """
    lag_s, natural_frequency_rad_per_s = _lag_s(cell), 2.0 * pi * cell.robot.servo_natural_frequency_Hz
    b2 = natural_frequency_rad_per_s**-2
    b2_rest = max(b2 - lag_s * delay_s + 0.5 * (delay_s**2 + variance_s2), ASSUMED.noise.least_width_share * b2)
    inner = cell.robot.model_copy(
        update={
            "servo_natural_frequency_Hz": b2_rest**-0.5 / (2.0 * pi),
            "servo_damping_ratio": 0.5 * (lag_s - delay_s) * b2_rest**-0.5,
        }
    )
    return predict_motion(cell.model_copy(update={"robot": inner}), t_s, late_m, library, start=start)


def _lag_s(cell: CellFile) -> float:
    """Lag of the stated servo behind a command of constant speed: b1 of its 1 / (1 + b1 s + b2 s²)."""
    return cell.robot.servo_damping_ratio / (pi * cell.robot.servo_natural_frequency_Hz)


def _averaged(t_s: Floats, values: Floats, width_s: float) -> Floats:
    """Means (k,) of values at the times t_s (k,) over the time before each."""
    sums = integral(values, t_s)
    before = np.interp(t_s - width_s, t_s, sums) + np.minimum(t_s - width_s - t_s[0], 0.0) * values[0]
    return np.asarray((sums - before) / width_s)
