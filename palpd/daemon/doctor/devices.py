"""Sensor and robot: observed together for some seconds, then judged."""

import os
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from palpd.config import Config
from palpd.control.probe_state import ProbeAnswer, ProbeRecord, ProbeState, probe_state
from palpd.control.safety import TILT_RAD
from palpd.control.tare import DRIFT_N, STABLE_RMS_N, tilt_rad
from palpd.daemon.devices import Devices, drain
from palpd.daemon.finding import Finding
from palpd.daemon.probe_record import evidence_of
from palpd.daemon.realtime import LOOP_PRIORITY, fifo
from palpd.tick import Floats, ForceSensor, Robot, RobotMode, RobotState, SafetyMode, SensorDriver, StateReader

READ_EVERY_S = 0.0005
"""Pause between two readings: half the period of the sensor."""
AXES = ("Fx", "Fy", "Fz")
BURST_MS = 5.0
"""Longest time beyond the sensor's period between two arrivals: a latency timer of 16 ms shows, a PC that wakes some ms late does not."""
FEWEST_FRAMES = 10
"""Fewest frames that say anything of noise, drift or contact."""


@dataclass(frozen=True, slots=True)
class DeviceRecord:
    """Everything that the devices sent while they were observed.

    `state_s` (m,) is the host time and `timestamp_s` (m,) the robot's stamp of each new state; `arrivals` counts the reads that brought
    frames.
    """

    duration_s: float
    wrench: Floats
    status: int
    rejected: int
    counter_steps: np.ndarray[Any, np.dtype[np.int64]]
    longest_silence_s: float
    state_s: Floats
    timestamp_s: Floats
    last: RobotState | None
    arrivals: int = 0


def observed(sensor: ForceSensor | None, robot: Robot | StateReader | None, duration_s: float) -> DeviceRecord:
    """Read both devices twice a millisecond at the loop's priority. Without devices it returns at once.

    Args:
        sensor: The open sensor, if any.
        robot: The open robot, if any.
        duration_s: How long to read.

    Returns:
        What came.
    """
    wrenches: list[Floats] = [np.empty((0, 6))]
    counters: list[np.ndarray[Any, np.dtype[np.int64]]] = [np.empty(0, np.int64)]
    state_s: list[float] = []
    stamps_s: list[float] = []
    status, rejected, silence_s, last, arrivals = 0, 0, 0.0, None, 0
    if sensor is not None:
        drain(sensor)
    began_s = heard_s = now_s = time.monotonic()
    until_s = began_s + (duration_s if sensor or robot else 0.0)
    urgent = fifo(LOOP_PRIORITY)
    try:
        while now_s < until_s:
            if sensor is not None:
                frames = sensor.read()
                rejected += frames.rejected
                if len(frames):
                    arrivals += 1
                    wrenches.append(frames.wrench)
                    counters.append(frames.counter.astype(np.int64))
                    status |= int(np.bitwise_or.reduce(frames.status))
                    silence_s, heard_s = max(silence_s, now_s - heard_s), now_s
            if robot is not None:
                last = robot.read()
                if not stamps_s or last.timestamp_s != stamps_s[-1]:
                    state_s.append(now_s)
                    stamps_s.append(last.timestamp_s)
            time.sleep(READ_EVERY_S)
            now_s = time.monotonic()
    finally:
        if urgent:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    steps = np.diff(np.concatenate(counters)) & 0xFFFF  # the counter is 16 bits wide
    silence_s = max(silence_s, now_s - heard_s)
    return DeviceRecord(
        now_s - began_s, np.concatenate(wrenches), status, rejected, steps, silence_s, np.array(state_s), np.array(stamps_s), last, arrivals
    )


def judged(devices: Devices, config: Config, watch_s: float, known: ProbeRecord | None) -> tuple[list[Finding], ProbeAnswer | None]:
    """Observe both devices, and judge them.

    Args:
        config: The configuration, for rates and limits.
        watch_s: How long to read.
        known: What is known of the probe from before; None judges nothing of it.

    Returns:
        All findings, and whether the probe is free; None where there is nothing to judge it by.
    """
    sensor = devices.sensor
    record = observed(sensor, devices.robot, watch_s)
    probe, answer = judge_probe(record, config, sensor, known)
    findings = [identified(sensor, config), *judge_sensor(record, config, sensor), *probe, reached(config), *judge_robot(record, config)]
    return findings, answer


def identified(sensor: SensorDriver, config: Config) -> Finding:
    """Which sensor answers.

    Args:
        sensor: The opened sensor.
        config: The configuration, for its port.
    """
    return Finding("sensor", "ok", f"{sensor.serial_number} at {config.sensor.port}, calibration from {sensor.calibration_source}")


def reached(config: Config) -> Finding:
    """Which robot answers."""
    return Finding("robot", "ok", f"{config.robot.model} at {config.robot.host}")


def judge_sensor(record: DeviceRecord, config: Config, sensor: SensorDriver) -> list[Finding]:
    """Judge frames, noise and drift.

    Args:
        record: What the sensor sent.
        config: The configuration, for rate, noise and limits.
        sensor: The sensor, for its serial number.
    """
    expected_Hz, step = config.sensor.rate_Hz, sensor.counter_step
    lost = int((record.counter_steps // step - 1).clip(min=0).sum())
    rate_Hz = len(record.wrench) / record.duration_s
    figures: dict[str, object] = {
        "frames": len(record.wrench),
        "rate_Hz": rate_Hz,
        "lost": lost,
        "rejected": record.rejected,
        "status": record.status,
        "longest_silence_ms": record.longest_silence_s * 1e3,
    }
    measured = (
        f"{rate_Hz:.0f} frames/s of {expected_Hz:g}, {lost} lost, {record.rejected} rejected, status {record.status:#06x}, "
        f"longest silence {record.longest_silence_s * 1e3:.1f} ms"
    )
    if record.status:
        frames = Finding("sensor frames", "fail", measured, "the sensor reports a fault or an overload", figures)
    elif rate_Hz < 0.98 * expected_Hz or record.longest_silence_s > config.safety.sensor_stale_s:
        frames = Finding("sensor frames", "fail", measured, "the stream has gaps: another USB port, a shorter cable, no hub", figures)
    elif lost or record.rejected:
        frames = Finding("sensor frames", "warn", measured, "single frames are damaged: another USB port, a shorter cable", figures)
    else:
        frames = Finding("sensor frames", "ok", measured, "", figures)
    if len(record.wrench) < FEWEST_FRAMES:
        return [frames]
    return [frames, *_bursts(record, config), _noise(record, config), _drift(record)]


def _bursts(record: DeviceRecord, config: Config) -> list[Finding]:
    """Judge how often frames arrive: an adapter that holds bytes back makes all of them late by up to one burst."""
    if not record.arrivals:
        return []
    every_ms, most_ms = 1e3 * record.duration_s / record.arrivals, 1e3 / config.sensor.rate_Hz + BURST_MS
    late = every_ms > most_ms
    advice = (
        "the USB adapter holds bytes back, so each reaction is late: write 1 to its latency_timer in /sys/class/tty/…/device"
        if late
        else ""
    )
    measured, figures = f"frames arrive every {every_ms:.1f} ms", {"arrival_every_ms": every_ms}
    return [Finding("sensor latency", "warn" if late else "ok", measured, advice, figures, f"at most every {most_ms:g} ms")]


def _noise(record: DeviceRecord, config: Config) -> Finding:
    rms_N = record.wrench[:, :3].std(axis=0)
    model = config.cell.sensor
    expected_N = float(np.hypot(model.noise_rms_N, model.resolution_fz_N))
    measured = ", ".join(f"{axis} {value * 1e3:.0f} mN" for axis, value in zip(AXES, rms_N, strict=True)) + " rms"
    figures: dict[str, object] = {"noise_N": rms_N.tolist(), "noise_fxy_N": float(rms_N[:2].mean())}
    if not record.wrench.std(axis=0).any():
        return Finding("sensor noise", "fail", measured, "no axis moves by a count: it is stuck; unplug it and plug it in", figures)
    if rms_N.max() > STABLE_RMS_N:
        return Finding(
            "sensor noise", "fail", measured, f"above {STABLE_RMS_N:g} N no tare is taken: find out what shakes the probe", figures
        )
    if rms_N.max() > 2 * expected_N:
        return Finding(
            "sensor noise", "warn", measured, f"expected about {expected_N:.2f} N: is the arm shaking, or the filter off?", figures
        )
    return Finding("sensor noise", "ok", measured, "", figures)


def _drift(record: DeviceRecord) -> Finding:
    """Judge the drift by a straight line through all samples."""
    ramp = np.linspace(-0.5, 0.5, len(record.wrench))
    drift_N = (ramp @ (record.wrench[:, :3] - record.wrench[:, :3].mean(axis=0))) / (ramp @ ramp)
    worst_N = float(np.abs(drift_N).max())
    figures = {"drift_N": drift_N.tolist(), "duration_s": record.duration_s}
    measured = (
        ", ".join(f"{axis} {value * 1e3:+.0f} mN" for axis, value in zip(AXES, drift_N, strict=True)) + f" in {record.duration_s:.0f} s"
    )
    if worst_N > 5 * DRIFT_N:
        return Finding("sensor drift", "fail", measured, "no tare would hold: is the arm moving, or the cable pulling?", figures)
    if worst_N > DRIFT_N:
        return Finding("sensor drift", "warn", measured, "let the sensor warm up for half an hour, then palpd calibrate", figures)
    return Finding("sensor drift", "ok", measured, "", figures)


def judge_probe(
    record: DeviceRecord, config: Config, sensor: SensorDriver, known: ProbeRecord | None
) -> tuple[list[Finding], ProbeAnswer | None]:
    """Judge whether the probe is free.

    Args:
        record: What both devices sent.
        sensor: The sensor, for its serial number.
        known: What is known from before; None judges nothing.

    Returns:
        One finding and the answer, or none of both.
    """
    if known is None or (known.reference is None and known.marker is None):
        return [], None
    robot, fault = record.last, ""
    if robot is None:
        fault = "no state came from the robot"
    elif len(record.wrench) < FEWEST_FRAMES or record.status or not np.ptp(record.wrench, axis=0).any():
        fault = "the force sensor sent no frames that can be used"
    wrench = tuple(record.wrench.mean(axis=0).tolist()) if len(record.wrench) else (0.0,) * 6
    pose = robot.tcp_pose if robot is not None else (0.0,) * 6
    answer = probe_state(known, evidence_of(config, {"sensor_serial": sensor.serial_number}, pose, wrench, fault))
    measured = "free" if answer.away_N is None else f"{answer.state.value}, {answer.away_N:.2f} N from the reference tare"
    figures: dict[str, object] = {"away_N": answer.away_N, "state": answer.state.value, "reasons": list(answer.reasons)}
    if answer.state == ProbeState.FREE:
        return [Finding("probe free", "ok", measured, "", figures)], answer
    return [Finding("probe free", "fail", f"{answer.state.value}: {'; '.join(answer.reasons)}", answer.advice, figures)], answer


def judge_robot(record: DeviceRecord, config: Config) -> list[Finding]:
    """Judge whether states come on time, and whether the arm stands as a run needs it.

    Args:
        record: What the robot sent.
        config: The configuration, for rate and limits.
    """
    robot = record.last
    if robot is None or len(record.state_s) < 10:
        return [Finding("RTDE jitter", "fail", f"{len(record.state_s)} states in {record.duration_s:.0f} s", "restart the controller")]
    period_s = 1.0 / config.robot.rate_Hz
    steps_s = np.diff(record.state_s)
    off_us = np.abs(steps_s - period_s) * 1e6
    p50, p99 = np.percentile(off_us, [50, 99])
    skipped = int(np.round(np.diff(record.timestamp_s) / period_s - 1).clip(min=0).sum())
    longest_s = float(steps_s.max())
    figures = {"jitter_us_p50": p50, "jitter_us_p99": p99, "longest_ms": longest_s * 1e3, "skipped": skipped}
    measured = (
        f"off by {p50:.0f} µs (p50), {p99:.0f} µs (p99); longest gap {longest_s * 1e3:.1f} ms of {period_s * 1e3:g}; {skipped} skipped"
    )
    cable = "a cable straight to the controller, no switch and no wireless; a quiet machine"
    if longest_s > config.safety.robot_stale_s:
        jitter = Finding("RTDE jitter", "fail", measured, f"the guard would stop a run here: {cable}", figures)
    elif skipped or p99 > 0.5e6 * period_s:
        jitter = Finding("RTDE jitter", "warn", measured, cable, figures)
    else:
        jitter = Finding("RTDE jitter", "ok", measured, "", figures)
    ready = robot.robot_mode == RobotMode.RUNNING and robot.safety_mode in (SafetyMode.NORMAL, SafetyMode.REDUCED)
    tilt = tilt_rad(robot.tcp_pose[3:])
    measured = f"robot mode {_named(RobotMode, robot.robot_mode)}, safety mode {_named(SafetyMode, robot.safety_mode)}"
    return [
        jitter,
        Finding("robot ready", "ok" if ready else "warn", measured, "" if ready else "switch it on and release its brakes at the pendant"),
        Finding(
            "tool upright",
            "ok" if tilt <= TILT_RAD else "warn",
            f"{np.degrees(tilt):.2f}° from straight down",
            "" if tilt <= TILT_RAD else f"turn the tool to within {np.degrees(TILT_RAD):.0f}° of straight down; check robot.tcp",
            {"tilt_rad": tilt},
        ),
    ]


def _named(kind: type[RobotMode] | type[SafetyMode], value: int) -> str:
    try:
        return kind(value).name
    except ValueError:
        return f"{value} (unknown)"
