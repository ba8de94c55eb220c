"""What a thread asks of the kernel so that its ticks come on time; what was refused is said, not hidden."""

import ctypes
import gc
import os
import resource
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

LOOP_PRIORITY = 60
DEVICE_PRIORITY = 55
"""The receive threads of ur_rtde inherit it from the thread that makes them: newer states at hand, still below the loop. They hold locks
that the loop needs, and none of these lends its holder the loop's priority, so nothing may stand between the two: interrupt threads of a
real-time kernel have 50."""
CPU_LATENCY = "/dev/cpu_dma_latency"
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_CAP_IPC_LOCK = 14


@dataclass(frozen=True, slots=True)
class Granted:
    """What the kernel gave, and a sentence for each thing it did not."""

    fifo: bool
    memory_locked: bool
    awake: bool
    missing: tuple[str, ...] = ()


def fifo(priority: int) -> bool:
    """SCHED_FIFO for the calling thread; false where that is not permitted."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (PermissionError, OSError):
        return False
    return True


def lock_memory() -> bool:
    """Keep every page that has been touched in memory. Only where the limit allows it: under a small one later allocations would fail.

    Pages never touched (libraries' unused code, 8 MB of stack for each thread) are left out: they would be 200 MB of the process.
    """
    soft, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if soft != resource.RLIM_INFINITY and not _may_lock_any():
        return False
    return bool(ctypes.CDLL(None, use_errno=True).mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) == 0)


def _may_lock_any() -> bool:
    """Whether the limit does not apply: with CAP_IPC_LOCK it does not, and root need not have that."""
    held = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("CapEff:"))
    return bool(int(held.split()[1], 16) >> _CAP_IPC_LOCK & 1)


@contextmanager
def awake() -> Iterator[bool]:
    """Within it no idle processor sleeps (the kernel's PM QoS: the file asks for 0 µs of wake-up latency for as long as it is open).

    One that slept between two ticks wakes late and with cold caches: without this, in a virtual machine, wake-ups took up to three times
    as long and a tick's work twice, and in other hours no longer (docs/benchmarks.md). Yields whether that is granted.
    """
    try:
        request = os.open(CPU_LATENCY, os.O_WRONLY)
    except OSError:
        yield False
        return
    try:
        os.write(request, struct.pack("=i", 0))
        yield True
    finally:
        os.close(request)


@contextmanager
def realtime() -> Iterator[Granted]:
    """Within it the calling thread is a FIFO thread of a locked process without garbage collection, on a processor that does not sleep."""
    gc.collect()
    gc.freeze()
    gc.disable()
    locked, urgent = lock_memory(), fifo(LOOP_PRIORITY)
    missing = []
    if not urgent:
        missing.append("no real-time priority (SCHED_FIFO refused): ticks will be late under load; run as the service or grant rtprio")
    if not locked:
        missing.append("memory is not locked (limit memlock): a page fault can delay a tick; run as the service or raise memlock")
    try:
        with awake() as no_sleep:
            if not no_sleep:
                missing.append(f"idle processors may sleep ({CPU_LATENCY} cannot be written): ticks begin late; run as the service")
            yield Granted(urgent, locked, no_sleep, tuple(missing))
    finally:
        if urgent:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        gc.enable()
        gc.unfreeze()
