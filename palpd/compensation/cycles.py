"""Cycles of free motion: one recording's repeats cut out, averaged and smoothed, with the features that the loop would have had."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from palpd.control.inertial import MotionFeatures
from palpd.errors import RecordingError
from palpd.recording.samples import Samples
from palpd.tick import Floats, RobotMode, RobotState, SafetyMode

SMOOTHING_S = 0.025
"""Window of the centred moving average, applied twice: it leaves 1 mN of a 0.06 N noise averaged over ten cycles, and a start of the
arm lasts 40 ms or more."""
LEAST_STROKE_M = 0.002
"""Least stroke of free motion: below it the arm accelerates too little to show a mass."""
ROBOT_STEP_S = 0.008
"""Cycle of a CB3 controller, at which the model is tried with the features that it will have at run time."""


@dataclass(frozen=True, slots=True)
class Cycle:
    """One repeat of the motion, in arrays over the time since it began.

    Attributes:
        recording: Number of the recording, from 1.
        start_s: When it began.
        z_m: Heights (n,).
        vz_m_per_s: Speeds (n,).
        fz_N: Forces (n,).
        at_run_time: Speed and acceleration (n, 2) as the loop would have had them.
    """

    recording: int
    start_s: float
    z_m: Floats
    vz_m_per_s: Floats
    fz_N: Floats
    at_run_time: Floats


def find_cycles(recordings: Sequence[Samples], step_s: float, sensor_delay_s: float) -> list[Cycle]:
    """Find every repeat of the motion, cut a quarter period before the tip rises through the middle of the first recording's stroke.

    Args:
        recordings: Recordings of one free motion.
        step_s: Time between samples of a cycle.
        sensor_delay_s: Delay with which the sensor's filter shows a force.

    Raises:
        RecordingError: A recording moves too little, differs from the first, or holds no whole cycle.
    """
    middle_m = (float(recordings[0].z_m.min()) + float(recordings[0].z_m.max())) / 2.0
    quarter_m = float(np.ptp(recordings[0].z_m)) / 4.0
    if 4.0 * quarter_m < LEAST_STROKE_M:
        raise RecordingError(
            f"recording 1 moves by {4.0 * quarter_m:.2g} m only, expected {LEAST_STROKE_M:g} m or more up and down; "
            "record it with palpd free-motion"
        )
    rises = [_rises(samples, middle_m, quarter_m) for samples in recordings]
    for number, rises_s in enumerate(rises, start=1):
        if not len(rises_s):
            raise RecordingError(
                f"recording {number} never rises through {middle_m:.4g} m, the middle of recording 1's motion; "
                "train on repeats of one motion"
            )
    periods = np.concatenate([np.diff(rises_s) for rises_s in rises])
    period_s = float(np.median(periods)) if len(periods) else min(samples.duration_s for samples in recordings)
    cycles = []
    for number, (samples, rises_s) in enumerate(zip(recordings, rises, strict=True), start=1):
        at_run_time = _at_run_time(samples, sensor_delay_s)
        for rise_s in rises_s:
            start_s = rise_s - period_s / 4.0 if len(periods) else samples.t_s[0]
            grid_s = start_s + np.arange(round(period_s / step_s)) * step_s
            if grid_s[0] < samples.t_s[0] - step_s or grid_s[-1] > samples.t_s[-1] + step_s:
                continue
            columns = (samples.z_m, samples.vz_m_per_s, samples.wrench[:, 2])
            z_m, vz_m_per_s, fz_N, *motion = (np.interp(grid_s, samples.t_s, column) for column in (*columns, *at_run_time.T))
            cycles.append(Cycle(number, float(start_s), z_m, vz_m_per_s, fz_N, np.column_stack(motion)))
    if not cycles:
        raise RecordingError("no recording holds a whole cycle up and down; record it with palpd free-motion")
    return cycles


def _rises(samples: Samples, middle_m: float, quarter_m: float) -> Floats:
    """Times at which the tip rises through the middle, each after it was a quarter of the stroke below."""
    rises_s = []
    low = False
    above = samples.z_m > middle_m
    below = samples.z_m < middle_m - quarter_m
    for i in np.flatnonzero(below | (above & ~np.roll(above, 1))):
        if below[i]:
            low = True
        elif low:
            rises_s.append(float(samples.t_s[i]))
            low = False
    return np.array(rises_s)


def mean_cycle(cycles: list[Cycle], step_s: float, sensor_delay_s: float) -> tuple[Floats, Floats]:
    """Mean cycle with features from past and future; all are smoothed alike, so that a linear law between them stays true.

    Args:
        cycles: Repeats of one motion.
        step_s: Time between samples.
        sensor_delay_s: Delay with which the sensor's filter shows a force.

    Returns:
        Speed and acceleration (n, 2), and force (n,) in N.
    """
    speed = np.mean([cycle.vz_m_per_s for cycle in cycles], axis=0)
    force_N = np.mean([cycle.fz_N for cycle in cycles], axis=0)
    width = _width(step_s)
    speed = moving_average(moving_average(speed, width), width)
    force_N = moving_average(moving_average(force_N, width), width)
    acceleration = np.gradient(speed, step_s)
    at = np.arange(len(speed)) * step_s
    delayed = [np.interp(at - sensor_delay_s, at, column) for column in (speed, acceleration)]
    return np.column_stack(delayed), force_N


def mean_cycle_at_run_time(cycles: list[Cycle], step_s: float) -> Floats:
    """Features of the mean cycle as the loop would have had them, smoothed like the force; they keep the lag of run time.

    Args:
        cycles: Repeats of one motion.
        step_s: Time between samples.

    Returns:
        Speed and acceleration (n, 2).
    """
    motion = np.mean([cycle.at_run_time for cycle in cycles], axis=0)
    width = _width(step_s)
    return np.column_stack([moving_average(moving_average(column, width), width) for column in motion.T])


def _width(step_s: float) -> int:
    """Odd number of samples in the window of the moving average."""
    return max(1, 2 * round(SMOOTHING_S / step_s / 2.0) + 1)


def moving_average(values: Floats, width: int) -> Floats:
    """Centred moving average, only where the window is full.

    Args:
        values: Values (n,).
        width: Number of samples in the window.

    Returns:
        Means (n - width + 1,).
    """
    return np.convolve(values, np.full(width, 1.0 / width), mode="valid")


def run_time_features(robot_t_s: Floats, speed: Floats, t_s: Floats, sensor_delay_s: float) -> Floats:
    """Features as the loop has them when it explains each sample: from the robot states up to its tick.

    Args:
        robot_t_s: Times (k,) of the robot states, in s.
        speed: Vertical speeds (k,) in m/s.
        t_s: Times (n,) of the sensor samples, in s.
        sensor_delay_s: Delay with which the sensor's filter shows a force.

    Returns:
        Speed and acceleration (n, 2).
    """
    motion, features = MotionFeatures(sensor_delay_s), np.empty((len(t_s), 2))
    zeros = (0.0,) * 6
    ends = np.searchsorted(t_s, robot_t_s, side="right")
    begin = 0
    for end, when_s, vz in zip(ends.tolist(), robot_t_s.tolist(), speed.tolist(), strict=True):
        moving = (0.0, 0.0, vz, 0.0, 0.0, 0.0)
        motion.update(RobotState(when_s, when_s, zeros, moving, zeros, moving, zeros[:3], RobotMode.RUNNING, SafetyMode.NORMAL, 1, 2, True))
        features[begin:end] = np.reshape(motion.features(t_s[begin:end].tolist()), (-1, 2))
        begin = end
    features[begin:] = np.reshape(motion.features(t_s[begin:].tolist()), (-1, 2))
    return features


def _at_run_time(samples: Samples, sensor_delay_s: float) -> Floats:
    """The features (n, 2) that the loop would have had at each sample of a recording, from robot states at a controller's cycle."""
    robot_s = np.arange(samples.t_s[0], samples.t_s[-1], ROBOT_STEP_S)
    return run_time_features(robot_s, np.interp(robot_s, samples.t_s, samples.vz_m_per_s), samples.t_s, sensor_delay_s)
