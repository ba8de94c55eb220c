"""The PC: kernel, clock, wake-up, limits, frequency, disk, and the kernel's side of the serial port."""

import os
import resource
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np

from palpd.config import Config
from palpd.daemon.clock import RealClock
from palpd.daemon.finding import Finding, Judgement, text_of
from palpd.daemon.realtime import CPU_LATENCY, LOOP_PRIORITY, Granted, realtime
from palpd.recording.ring import RING_S

WAKE_UP_S = 2.0
"""How long wake-ups are measured: 1000 ticks at 500 Hz, so that the 99th percentile rests on ten."""
COARSE_CLOCK_US = 100.0
"""A clock coarser than this cannot place a tick: without high-resolution timers it has 1000 to 4000 µs."""
DISK_MIB = 32
"""Size of the test file: more than a write cache of some disks, written in seconds by all."""
DISK_MB_PER_S = 5.0
"""A recording at 1 kHz takes 0.2 MB/s. The rest is room for other writers."""
FREE_GB = 1.0
"""Free space that is enough for more than an hour of recording at 1 kHz."""


def examine_machine(config: Config) -> list[Finding]:
    """Everything about the PC that a run depends on."""
    return [kernel(), clock(), *wake_up(config), limits(), governor(), disk(config.paths.runs)]


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
    source = text_of("/sys/devices/system/clocksource/clocksource0/current_clocksource") or "unknown"
    figures = {"source": source, "resolution_us": resolution_us}
    measured = f"{source}, resolution {resolution_us:g} µs"
    if resolution_us > COARSE_CLOCK_US:
        return Finding("clock", "fail", measured, "the kernel has no high-resolution timers; boot without highres=off", figures)
    if source in ("hpet", "acpi_pm", "jiffies"):
        return Finding(
            "clock", "warn", measured, "every reading of the clock is slow; find out why the kernel refuses tsc (dmesg)", figures
        )
    return Finding("clock", "ok", measured, "", figures)


def wake_up(config: Config) -> list[Finding]:
    """How late the loop's thread wakes at the loop's rate, and what the kernel grants it.

    Args:
        config: The configuration, for the rate of the loop and the longest stall.

    Returns:
        One finding for the wake-ups, one for each privilege.
    """
    rate_Hz = config.robot.rate_Hz
    late_us, missed = np.zeros(round(WAKE_UP_S * rate_Hz)), 0
    with realtime() as granted:
        grid = RealClock(rate_Hz, time.monotonic() + 0.01)
        for index in range(len(late_us)):
            timing = grid.wait()
            late_us[index] = (timing.now_s - timing.planned_s) * 1e6
            missed += timing.missed
        locked_kilobytes = _locked_kilobytes()
    p50, p99, worst = (float(us) for us in np.percentile(late_us, [50, 99, 100]))
    period_us = 1e6 / rate_Hz
    figures = {"late_us_p50": p50, "late_us_p99": p99, "late_us_max": worst, "missed": missed, "rate_Hz": rate_Hz}
    measured = f"late by {p50:.0f} µs (p50), {p99:.0f} µs (p99), {worst:.0f} µs (worst) at {rate_Hz:g} Hz; {missed} ticks missed"
    advice = "another program occupies the processor: end other loads, give FIFO priority, use a PREEMPT_RT kernel"
    if worst > config.safety.max_stall_s * 1e6 or p99 > period_us / 2:
        verdict: Judgement = "fail"
    else:
        verdict = "warn" if missed or p99 > period_us / 8 else "ok"
    return [Finding("wake-up", verdict, measured, "" if verdict == "ok" else advice, figures), *_privileges(granted, locked_kilobytes)]


def _privileges(granted: Granted, locked_kilobytes: int) -> list[Finding]:
    return [
        Finding("FIFO", "ok", f"SCHED_FIFO {LOOP_PRIORITY} granted")
        if granted.fifo
        else Finding("FIFO", "warn", "SCHED_FIFO refused", "run palpd as the service, or grant rtprio in /etc/security/limits.d"),
        Finding("memory lock", "ok", f"{locked_kilobytes / 1024:.0f} MiB locked", "", {"locked_kB": locked_kilobytes})
        if granted.memory_locked and locked_kilobytes
        else Finding("memory lock", "warn", "memory is not locked", "run palpd as the service, or grant memlock unlimited"),
        Finding("idle", "ok", "no processor sleeps during a run")
        if granted.awake
        else Finding("idle", "warn", f"{CPU_LATENCY} cannot be written", "run palpd as the service, or boot with idle=poll"),
    ]


def _locked_kilobytes() -> int:
    for line in (text_of("/proc/self/status") or "").splitlines():
        if line.startswith("VmLck:"):
            return int(line.split()[1])
    return 0


def limits() -> Finding:
    """The limits behind FIFO and memory lock, and the share of time that the kernel leaves real-time threads."""
    priority, locked = resource.getrlimit(resource.RLIMIT_RTPRIO)[0], resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    runtime_us = int(text_of("/proc/sys/kernel/sched_rt_runtime_us") or "-1")
    figures = {"rtprio": priority, "memlock_bytes": locked, "sched_rt_runtime_us": runtime_us}
    endless = locked == resource.RLIM_INFINITY
    measured = f"rtprio {priority}, memlock {'unlimited' if endless else f'{locked // 1024} kB'}, sched_rt_runtime {runtime_us} µs"
    if runtime_us == 0:
        return Finding("limits", "fail", measured, "real-time threads get no time: sysctl kernel.sched_rt_runtime_us=950000", figures)
    if os.geteuid() != 0 and (priority < LOOP_PRIORITY or not endless):
        return Finding(
            "limits", "warn", measured, f"rtprio {LOOP_PRIORITY} and memlock unlimited are needed; the service has both", figures
        )
    return Finding("limits", "ok", measured, "", figures)


def governor() -> Finding:
    """What decides the processors' frequency."""
    names = sorted({path.read_text().strip() for path in Path("/sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/scaling_governor")})
    if not names:
        return Finding("governor", "ok", "no frequency scaling to be seen (virtual machine, or set in the firmware)")
    measured = ", ".join(names)
    if names == ["performance"]:
        return Finding("governor", "ok", measured)
    return Finding("governor", "warn", measured, "a slow clock speeds up only after the tick: cpupower frequency-set -g performance")


def disk(runs: Path) -> Finding:
    """How fast the folder of recordings takes data that must reach the disk, and how much room it has."""
    folder = next(parent for parent in (runs, *runs.absolute().parents) if os.path.isdir(parent))  # noqa: PTH112 - as in is_there
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
    measured = f"{mb_per_s:.0f} MB/s, slowest MiB {slowest_s * 1e3:.0f} ms, {free_gb:.1f} GB free"
    if slowest_s > RING_S or free_gb < FREE_GB / 10:
        return Finding("disk", "fail", measured, "rows would be lost; record to another disk, or make room", figures)
    if mb_per_s < DISK_MB_PER_S or slowest_s > RING_S / 4 or free_gb < FREE_GB:
        return Finding("disk", "warn", measured, "watch the notes of a run for lost rows; make room on the disk", figures)
    return Finding("disk", "ok", measured, "", figures)


def is_there(device: str) -> bool:
    """Whether a device of that name is there."""
    return os.path.exists(device)  # noqa: PTH110 - Path.exists raises where a name is too long to be one


def port(device: str) -> list[Finding]:
    """The serial port's latency timer, and whether ModemManager may open it."""
    path = Path(device)
    if not is_there(device):
        return []
    timer_ms = text_of(f"/sys/class/tty/{path.resolve().name}/device/latency_timer")
    if timer_ms is None:
        findings = [Finding("serial latency", "ok", f"{path.resolve()} has no latency timer (USB CDC and terminals have none)")]
    elif int(timer_ms) > 1:
        advice = f"frames arrive in bursts: echo 1 > /sys/class/tty/{path.resolve().name}/device/latency_timer"
        findings = [Finding("serial latency", "warn", f"{timer_ms} ms", advice, {"latency_ms": int(timer_ms)})]
    else:
        findings = [Finding("serial latency", "ok", f"{timer_ms} ms", "", {"latency_ms": int(timer_ms)})]
    modem_manager = any(text_of(str(comm)) == "ModemManager" for comm in Path("/proc").glob("[0-9]*/comm"))
    if modem_manager and not any(Path("/etc/udev/rules.d").glob("*palpd-hex.rules")):
        findings.append(
            Finding("ModemManager", "warn", "it runs, and may send commands to the sensor", "install the device rule: palpd install")
        )
    return findings
