"""What a run will meet on this machine and at this cell: each thing measured, judged, and said what to do about it. Moves nothing."""

import os
import resource
import shutil
import socket
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from rich.table import Table

from palpd.clock import RealClock
from palpd.config import Config
from palpd.errors import PalpdError
from palpd.inertial import InertialModel
from palpd.motion import drain
from palpd.realtime import CPU_LATENCY, DEVICE_PRIORITY, LOOP_PRIORITY, fifo, realtime
from palpd.ring import RING_S
from palpd.safety import TILT_RAD
from palpd.state import State
from palpd.tare import DRIFT_N, FREE_N, STABLE_RMS_N, base_from_sensor, tilt_rad, to_base
from palpd.tick import Floats, ForceSensor, Robot, RobotMode, RobotState, SafetyMode

Verdict = Literal["ok", "warn", "fail"]

WAKE_UP_S = 2.0
LOOK_S = 0.0005
RTDE_PORT = 30004
PATIENCE_S = 1.0
DISK_MIB = 32
DISK_MB_PER_S = 5.0
"""A recording at 1 kHz takes 0.2 MB/s; the rest is room for whatever else writes."""
FREE_GB = 1.0
SETTLED_S = 2.0
WEIGHT_OK, WEIGHT_BAD = 0.05, 0.10
"""A hanging weight pulls, and the pulled Fz of a HEX may be 8 % more sensitive than the pressed one, whose calibration is used."""
CROSSTALK = 0.10
STRAIGHT_DOWN = (np.pi, 0.0, 0.0)
AXES = ("Fx", "Fy", "Fz")


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing looked at: what was found, and what to do unless it is well."""

    name: str
    verdict: Verdict
    found: str
    advice: str = ""
    figures: dict[str, Any] = field(default_factory=dict)


class Sensor(ForceSensor, Protocol):
    """A force sensor that also tells who it is."""

    serial_number: str
    calibration_source: Any


Ask = Callable[[str], object]
"""Tells the operator what to do and returns when that is done."""


def examined(
    config: Config,
    open_sensor: Callable[[Config], Sensor],
    open_robot: Callable[[Config], Any],
    watch_s: float,
    weight_N: float | None,
    ask: Ask,
) -> list[Finding]:
    """Everything: kernel to disk, then what is kept, then the devices, watched together for `watch_s`, then the weight."""
    findings = [
        kernel(),
        clock(),
        *wake_up(config),
        limits(),
        governor(),
        disk(config.paths.runs),
        *kept(config),
        *port(config.sensor.port),
    ]
    with ExitStack() as opened:
        sensor, about_sensor = _opened(opened, "sensor.port", config, open_sensor, Path(config.sensor.port).exists(), config.sensor.port)
        robot, about_robot = _opened(opened, "robot.host", config, open_robot, _answers(config.robot.host), config.robot.host)
        seen = watch(sensor, robot, watch_s)
        findings += [about_sensor, *judge_sensor(seen, config, sensor)] if sensor else [about_sensor]
        findings += [about_robot, *judge_robot(seen, config)] if robot else [about_robot]
        if weight_N is not None and sensor is not None:
            findings.append(weigh(sensor, seen.last, config.sensor.rotation_about_flange_z_rad, weight_N, ask))
    return findings


# --- the machine --------------------------------------------------------------------------------------------------------------


def kernel() -> Finding:
    """Whether the kernel was built to be preempted everywhere."""
    name = f"{os.uname().release} {os.uname().version}"
    if Path("/sys/kernel/realtime").exists() or "PREEMPT_RT" in name:
        return Finding("kernel", "ok", f"{os.uname().release}, PREEMPT_RT")
    return Finding(
        "kernel",
        "warn",
        f"{os.uname().release}, not PREEMPT_RT",
        "late ticks remain possible; install a linux-image-rt",
    )


def clock() -> Finding:
    """The source and resolution of the monotonic clock."""
    resolution_us = time.clock_getres(time.CLOCK_MONOTONIC) * 1e6
    source = _text("/sys/devices/system/clocksource/clocksource0/current_clocksource") or "unknown"
    figures = {"source": source, "resolution_us": resolution_us}
    found = f"{source}, resolution {resolution_us:g} µs"
    if resolution_us > 100.0:
        return Finding("clock", "fail", found, "the kernel has no high-resolution timers; boot without highres=off", figures)
    if source in ("hpet", "acpi_pm", "jiffies"):
        return Finding("clock", "warn", found, "every look at the clock is slow; find out why the kernel refuses tsc (dmesg)", figures)
    return Finding("clock", "ok", found, "", figures)


def wake_up(config: Config, duration_s: float = WAKE_UP_S) -> list[Finding]:
    """How late the loop's thread wakes at the loop's rate, and what the kernel grants it."""
    rate_Hz = config.robot.rate_Hz
    late_us, missed = np.zeros(round(duration_s * rate_Hz)), 0
    with realtime() as granted:
        grid = RealClock(rate_Hz, time.monotonic() + 0.01)
        for index in range(len(late_us)):
            timing = grid.wait()
            late_us[index] = (timing.now_s - timing.planned_s) * 1e6
            missed += timing.missed
        locked_kB = int((_status("VmLck") or "0").split()[0])
    p50, p99, top = np.percentile(late_us, [50, 99, 100])
    period_us = 1e6 / rate_Hz
    figures = {"late_us_p50": p50, "late_us_p99": p99, "late_us_max": top, "missed": missed, "rate_Hz": rate_Hz}
    found = f"late by {p50:.0f} µs (p50), {p99:.0f} µs (p99), {top:.0f} µs (most) at {rate_Hz:g} Hz; {missed} ticks missed"
    quiet = "something keeps the processor: end other loads, give FIFO priority, use a PREEMPT_RT kernel"
    if top > config.safety.max_stall_s * 1e6 or p99 > period_us / 2:
        verdict: Verdict = "fail"
    else:
        verdict = "warn" if missed or p99 > period_us / 8 else "ok"
    return [
        Finding("wake-up", verdict, found, "" if verdict == "ok" else quiet, figures),
        Finding("FIFO", "ok", f"SCHED_FIFO {LOOP_PRIORITY} granted")
        if granted.fifo
        else Finding("FIFO", "warn", "SCHED_FIFO refused", "run palpd as the service, or grant rtprio in /etc/security/limits.d"),
        Finding("memory lock", "ok", f"{locked_kB / 1024:.0f} MiB locked", "", {"locked_kB": locked_kB})
        if granted.memory_locked and locked_kB
        else Finding("memory lock", "warn", "memory is not locked", "run palpd as the service, or grant memlock unlimited"),
        Finding("idle", "ok", "no processor sleeps during a run")
        if granted.awake
        else Finding("idle", "warn", f"{CPU_LATENCY} cannot be written", "run palpd as the service, or boot with idle=poll"),
    ]


def limits() -> Finding:
    """The limits behind FIFO and memory lock, and the share of time that the kernel leaves real-time threads."""
    priority, locked = resource.getrlimit(resource.RLIMIT_RTPRIO)[0], resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    runtime_us = int(_text("/proc/sys/kernel/sched_rt_runtime_us") or "-1")
    figures = {"rtprio": priority, "memlock_bytes": locked, "sched_rt_runtime_us": runtime_us}
    endless = locked == resource.RLIM_INFINITY
    found = f"rtprio {priority}, memlock {'unlimited' if endless else f'{locked // 1024} kB'}, sched_rt_runtime {runtime_us} µs"
    if runtime_us == 0:
        return Finding("limits", "fail", found, "real-time threads get no time: sysctl kernel.sched_rt_runtime_us=950000", figures)
    if os.geteuid() != 0 and (priority < LOOP_PRIORITY or not endless):
        return Finding("limits", "warn", found, f"rtprio {LOOP_PRIORITY} and memlock unlimited are needed; the service has both", figures)
    return Finding("limits", "ok", found, "", figures)


def governor() -> Finding:
    """What decides the processors' frequency."""
    names = sorted({path.read_text().strip() for path in Path("/sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/scaling_governor")})
    if not names:
        return Finding("governor", "ok", "no frequency scaling to be seen (virtual machine, or set in the firmware)")
    found = ", ".join(names)
    if names == ["performance"]:
        return Finding("governor", "ok", found)
    return Finding("governor", "warn", found, "a slow clock speeds up only after the tick: cpupower frequency-set -g performance")


def disk(runs: Path) -> Finding:
    """How fast the folder of recordings takes data that must reach the disk, and how much room it has."""
    folder = next(parent for parent in (runs, *runs.absolute().parents) if parent.is_dir())
    block = os.urandom(1 << 20)
    slowest_s = 0.0
    try:
        with tempfile.NamedTemporaryFile(dir=folder) as file:
            began_s = time.monotonic()
            for _ in range(DISK_MIB):
                at_s = time.monotonic()
                file.write(block)
                file.flush()
                os.fsync(file.fileno())
                slowest_s = max(slowest_s, time.monotonic() - at_s)
            mb_per_s = DISK_MIB * 1.048576 / (time.monotonic() - began_s)
    except OSError as error:
        return Finding("disk", "fail", f"{folder} takes no file ({error.strerror})", "set paths.runs to a folder that palpd may write")
    free_gb = shutil.disk_usage(folder).free / 1e9
    figures = {"mb_per_s": mb_per_s, "slowest_ms": slowest_s * 1e3, "free_gb": free_gb}
    found = f"{mb_per_s:.0f} MB/s, slowest MiB {slowest_s * 1e3:.0f} ms, {free_gb:.1f} GB free"
    if slowest_s > RING_S or free_gb < FREE_GB / 10:
        return Finding("disk", "fail", found, "rows would be lost; record to another disk, or make room", figures)
    if mb_per_s < DISK_MB_PER_S or slowest_s > RING_S / 4 or free_gb < FREE_GB:
        return Finding("disk", "warn", found, "watch the notes of a run for lost rows; make room on the disk", figures)
    return Finding("disk", "ok", found, "", figures)


# --- what is kept -------------------------------------------------------------------------------------------------------------


def kept(config: Config) -> list[Finding]:
    """Reference tare, latch and inertial model."""
    state = State(config.paths.state)
    findings = []
    try:
        calibration = state.calibration()
    except PalpdError as error:
        findings.append(Finding("reference tare", "fail", str(error)))
    else:
        findings.append(
            Finding("reference tare", "ok", f"of {calibration.date}, sensor {calibration.sensor_serial or 'unknown'}")
            if calibration
            else Finding("reference tare", "warn", "none", "run palpd calibrate with the probe free and still")
        )
    latch = state.latch()
    if latch is not None:
        findings.append(Finding("latch", "warn", f"{latch.reason} ({latch.date})", "look at the cell, then palpd clear"))
    if config.model.path is None:
        findings.append(Finding("inertial model", "ok", "none configured: inertia is not corrected"))
    else:
        try:
            InertialModel.load(config.model.path, probe_mass_kg=config.cell.probe.mass_kg, sensor_serial=None)
            findings.append(Finding("inertial model", "ok", str(config.model.path.name)))
        except PalpdError as error:
            findings.append(Finding("inertial model", "fail", str(error)))
    return findings


def port(device: str) -> list[Finding]:
    """The serial port's latency timer, and whether ModemManager may speak to it."""
    path = Path(device)
    if not path.exists():
        return []
    timer_ms = _text(f"/sys/class/tty/{path.resolve().name}/device/latency_timer")
    if timer_ms is None:
        findings = [Finding("serial latency", "ok", f"{path.resolve()} has no latency timer (USB CDC and terminals have none)")]
    elif int(timer_ms) > 1:
        advice = f"frames come in lumps: echo 1 > /sys/class/tty/{path.resolve().name}/device/latency_timer"
        findings = [Finding("serial latency", "warn", f"{timer_ms} ms", advice, {"latency_ms": int(timer_ms)})]
    else:
        findings = [Finding("serial latency", "ok", f"{timer_ms} ms", "", {"latency_ms": int(timer_ms)})]
    modem_manager = any(_text(str(comm)) == "ModemManager" for comm in Path("/proc").glob("[0-9]*/comm"))
    if modem_manager and not any(Path("/etc/udev/rules.d").glob("*palpd-hex.rules")):
        findings.append(Finding("ModemManager", "warn", "it runs, and may speak to the sensor", "install the device rule: palpd install"))
    return findings


# --- the devices --------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Seen:
    """What the devices said while they were watched. `state_s` (m,) and `timestamp_s` (m,): host time and stamp of each new robot state."""

    duration_s: float
    wrench: Floats
    status: int
    rejected: int
    counter_steps: np.ndarray[Any, np.dtype[np.int64]]
    longest_silence_s: float
    state_s: Floats
    timestamp_s: Floats
    last: RobotState | None


def watch(sensor: ForceSensor | None, robot: Robot | None, duration_s: float) -> Seen:
    """Look at both twice a millisecond at the loop's priority; without devices at once over."""
    wrenches: list[Floats] = [np.empty((0, 6))]
    counters: list[np.ndarray[Any, np.dtype[np.int64]]] = [np.empty(0, np.int64)]
    state_s: list[float] = []
    stamps_s: list[float] = []
    status, rejected, silence_s, last = 0, 0, 0.0, None
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
                    wrenches.append(frames.wrench)
                    counters.append(frames.counter.astype(np.int64))
                    status |= int(np.bitwise_or.reduce(frames.status))
                    silence_s, heard_s = max(silence_s, now_s - heard_s), now_s
            if robot is not None:
                last = robot.read()
                if not stamps_s or last.timestamp_s != stamps_s[-1]:
                    state_s.append(now_s)
                    stamps_s.append(last.timestamp_s)
            time.sleep(LOOK_S)
            now_s = time.monotonic()
    finally:
        if urgent:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    steps = np.diff(np.concatenate(counters)) & 0xFFFF  # the counter is 16 bits wide
    silence_s = max(silence_s, now_s - heard_s)
    return Seen(now_s - began_s, np.concatenate(wrenches), status, rejected, steps, silence_s, np.array(state_s), np.array(stamps_s), last)


def judge_sensor(seen: Seen, config: Config, sensor: Sensor) -> list[Finding]:
    """Frames, noise, drift, and whether the probe is free against the reference tare."""
    rate_Hz, step = config.sensor.rate_Hz, round(1000 / config.sensor.rate_Hz)
    lost = int((seen.counter_steps // step - 1).clip(min=0).sum())
    figures: dict[str, Any] = {
        "frames": len(seen.wrench),
        "rate_Hz": len(seen.wrench) / seen.duration_s,
        "lost": lost,
        "rejected": seen.rejected,
        "status": seen.status,
        "longest_silence_ms": seen.longest_silence_s * 1e3,
    }
    found = (
        f"{figures['rate_Hz']:.0f} frames/s of {rate_Hz:g}, {lost} lost, {seen.rejected} rejected, status {seen.status:#06x}, "
        f"longest silence {seen.longest_silence_s * 1e3:.1f} ms"
    )
    if seen.status:
        frames = Finding("sensor frames", "fail", found, "the sensor reports a fault or an overload", figures)
    elif figures["rate_Hz"] < 0.98 * rate_Hz or seen.longest_silence_s > config.safety.sensor_stale_s:
        frames = Finding("sensor frames", "fail", found, "the stream has gaps: another USB port, a shorter cable, no hub", figures)
    elif lost or seen.rejected:
        frames = Finding("sensor frames", "warn", found, "single frames are damaged: another USB port, a shorter cable", figures)
    else:
        frames = Finding("sensor frames", "ok", found, "", figures)
    if len(seen.wrench) < 10:
        return [frames]
    return [frames, _noise(seen, config), _drift(seen), *_free(seen, config, sensor)]


def _noise(seen: Seen, config: Config) -> Finding:
    rms_N = seen.wrench[:, :3].std(axis=0)
    model = config.cell.sensor
    usual_N = float(np.hypot(model.noise_rms_N, model.resolution_fz_N))
    found = ", ".join(f"{axis} {value * 1e3:.0f} mN" for axis, value in zip(AXES, rms_N, strict=True)) + " rms"
    figures = {"noise_N": rms_N.tolist()}
    if not seen.wrench.std(axis=0).any():
        return Finding("sensor noise", "fail", found, "no axis moves by a count: it is stuck; unplug it and plug it in", figures)
    if rms_N.max() > STABLE_RMS_N:
        return Finding("sensor noise", "fail", found, f"above {STABLE_RMS_N:g} N no tare is taken: what shakes the probe?", figures)
    if rms_N.max() > 2 * usual_N:
        return Finding("sensor noise", "warn", found, f"expected about {usual_N:.2f} N: is the arm shaking, or the filter off?", figures)
    return Finding("sensor noise", "ok", found, "", figures)


def _drift(seen: Seen) -> Finding:
    """By a straight line through the whole watch."""
    turn = np.linspace(-0.5, 0.5, len(seen.wrench))
    drift_N = (turn @ (seen.wrench[:, :3] - seen.wrench[:, :3].mean(axis=0))) / (turn @ turn)
    worst_N = float(np.abs(drift_N).max())
    figures = {"drift_N": drift_N.tolist(), "duration_s": seen.duration_s}
    found = ", ".join(f"{axis} {value * 1e3:+.0f} mN" for axis, value in zip(AXES, drift_N, strict=True)) + f" in {seen.duration_s:.0f} s"
    if worst_N > 5 * DRIFT_N:
        return Finding("sensor drift", "fail", found, "nothing rests on such a zero: is the arm moving, or the cable pulling?", figures)
    if worst_N > DRIFT_N:
        return Finding("sensor drift", "warn", found, "let the sensor warm up for half an hour, then palpd calibrate", figures)
    return Finding("sensor drift", "ok", found, "", figures)


def _free(seen: Seen, config: Config, sensor: Sensor) -> list[Finding]:
    try:
        calibration = State(config.paths.state).calibration()
    except PalpdError:
        calibration = None
    if calibration is None:
        return []
    away_N = float(np.linalg.norm(seen.wrench[:, :3].mean(axis=0) - calibration.wrench[:3]))
    found, figures = f"{away_N:.2f} N from the reference tare", {"away_N": away_N}
    if calibration.sensor_serial and sensor.serial_number and calibration.sensor_serial != sensor.serial_number:
        found = f"the tare is of sensor {calibration.sensor_serial}, {sensor.serial_number} is connected"
        return [Finding("probe free", "fail", found, "run palpd calibrate")]
    if away_N > FREE_N:
        return [Finding("probe free", "fail", found, "free the probe; if it was changed, run palpd calibrate", figures)]
    return [Finding("probe free", "ok", found, "", figures)]


def judge_robot(seen: Seen, config: Config) -> list[Finding]:
    """Whether states come on time, and whether the arm stands as a run needs it."""
    robot = seen.last
    if robot is None or len(seen.state_s) < 10:
        return [Finding("RTDE jitter", "fail", f"{len(seen.state_s)} states in {seen.duration_s:.0f} s", "restart the controller")]
    period_s = 1.0 / config.robot.rate_Hz
    steps_s = np.diff(seen.state_s)
    off_us = np.abs(steps_s - period_s) * 1e6
    p50, p99 = np.percentile(off_us, [50, 99])
    skipped = int(np.round(np.diff(seen.timestamp_s) / period_s - 1).clip(min=0).sum())
    longest_s = float(steps_s.max())
    figures = {"jitter_us_p50": p50, "jitter_us_p99": p99, "longest_ms": longest_s * 1e3, "skipped": skipped}
    found = f"off by {p50:.0f} µs (p50), {p99:.0f} µs (p99); longest gap {longest_s * 1e3:.1f} ms of {period_s * 1e3:g}; {skipped} skipped"
    cable = "a cable straight to the controller, no switch and no wireless; a quiet machine"
    if longest_s > config.safety.robot_stale_s:
        jitter = Finding("RTDE jitter", "fail", found, f"the guard would stop on that: {cable}", figures)
    elif skipped or p99 > 0.5e6 * period_s:
        jitter = Finding("RTDE jitter", "warn", found, cable, figures)
    else:
        jitter = Finding("RTDE jitter", "ok", found, "", figures)
    ready = robot.robot_mode == RobotMode.RUNNING and robot.safety_mode in (SafetyMode.NORMAL, SafetyMode.REDUCED)
    tilt = tilt_rad(robot.tcp_pose[3:])
    found = f"robot mode {_named(RobotMode, robot.robot_mode)}, safety mode {_named(SafetyMode, robot.safety_mode)}"
    return [
        jitter,
        Finding("robot ready", "ok" if ready else "warn", found, "" if ready else "switch it on and release its brakes at the pendant"),
        Finding(
            "tool upright",
            "ok" if tilt <= TILT_RAD else "warn",
            f"{np.degrees(tilt):.2f}° from straight down",
            "" if tilt <= TILT_RAD else f"turn the tool to within {np.degrees(TILT_RAD):.0f}° of straight down; check robot.tcp",
            {"tilt_rad": tilt},
        ),
    ]


def weigh(sensor: ForceSensor, robot: RobotState | None, about_flange_z_rad: float, weight_N: float, ask: Ask) -> Finding:
    """Sign and scale of the sensor by a known weight, which pulls straight down however the sensor is held.

    Without a robot the tool is taken to point straight down.
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
    found = f"{-z_N:.2f} N down and {across * weight_N:.2f} N across of {weight_N:g} N hung on it"
    if abs(ratio) < 0.2:
        return Finding("known weight", "fail", found, "the weight does not hang on the sensor, or that is dead", figures)
    if ratio < 0:
        advice = "the sign is wrong: pressed would read as pulled, and no limit would act; do not move. Was the weight hung, not pushed?"
        return Finding("known weight", "fail", found, advice, figures)
    if abs(ratio - 1) > WEIGHT_BAD:
        return Finding("known weight", "fail", found, "set counts_per_N and counts_per_Nm from this unit's calibration sheet", figures)
    if abs(ratio - 1) > WEIGHT_OK:
        return Finding("known weight", "warn", found, "pulling may read 8 % more than pressing; else correct counts_per_N", figures)
    if across > CROSSTALK:
        return Finding("known weight", "warn", found, "the weight swings or pulls aslant, or crosstalk is above the sheet's 5 %", figures)
    return Finding("known weight", "ok", found, "", figures)


def _mean(sensor: ForceSensor) -> Floats | None:
    wrench = watch(sensor, None, SETTLED_S).wrench
    return wrench.mean(axis=0) if len(wrench) else None


# --- output -------------------------------------------------------------------------------------------------------------------


def table(findings: list[Finding]) -> Table:
    """One line a finding."""
    shown = Table("check", "", "found", "what to do")
    colours = {"ok": "green", "warn": "yellow", "fail": "red"}
    for finding in findings:
        shown.add_row(finding.name, f"[{colours[finding.verdict]}]{finding.verdict}[/]", finding.found, finding.advice)
    return shown


def as_json(findings: list[Finding]) -> dict[str, Any]:
    """The same, with all figures, and the worst verdict of all."""
    verdicts = [finding.verdict for finding in findings]
    worst = next(verdict for verdict in ("fail", "warn", "ok") if verdict in verdicts)
    return {"verdict": worst, "findings": [asdict(finding) for finding in findings]}


def _opened(opened: ExitStack, key: str, config: Config, build: Callable[[Config], Any], there: bool, where: str) -> tuple[Any, Finding]:
    name = key.split(".")[0]
    if not there:
        return None, Finding(name, "warn", f"absent: nothing at {where}", f"connect it, or correct {key}")
    urgent = fifo(DEVICE_PRIORITY)  # threads of the drivers inherit it, as in a run
    try:
        device = build(config)
    except PalpdError as error:
        return None, Finding(name, "fail", str(error))
    finally:
        if urgent:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    opened.callback(device.close)
    if name == "sensor":
        return device, Finding(name, "ok", f"{device.serial_number} at {where}, calibration from {device.calibration_source}")
    return device, Finding(name, "ok", f"{config.robot.model} at {where}")


def _answers(host: str) -> bool:
    try:
        socket.create_connection((host, RTDE_PORT), PATIENCE_S).close()
    except OSError:
        return False
    return True


def _named(kind: type[RobotMode] | type[SafetyMode], value: int) -> str:
    try:
        return kind(value).name
    except ValueError:
        return f"{value} (unknown)"


def _text(path: str) -> str | None:
    try:
        return Path(path).read_text().strip()
    except OSError:
        return None


def _status(key: str) -> str | None:
    for line in (_text("/proc/self/status") or "").splitlines():
        if line.startswith(f"{key}:"):
            return line.split(":", 1)[1].strip()
    return None
