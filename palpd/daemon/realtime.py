"""What a thread requests from the kernel so that its ticks come on time. It reports everything that the kernel refused."""

import ctypes
import gc
import os
import resource
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

LOOP_PRIORITY = 60
"""FIFO priority of the loop: above the interrupt threads of a real-time kernel, which have 50."""
DEVICE_PRIORITY = 55
"""FIFO priority of ur_rtde's receive threads, which inherit it from the thread that starts them. They hold locks that the loop needs, and
these locks do not lend their holder the loop's priority. So no other thread may have a priority between the two. What waits for these
threads in the library runs below them: it waits without a pause."""
CPU_LATENCY = "/dev/cpu_dma_latency"
"""The kernel's PM QoS: as long as this file is open, idle processors wake up within the written number of µs."""
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_MADV_POPULATE_READ = 22
_CAP_IPC_LOCK = 14


@dataclass(frozen=True, slots=True)
class Granted:
    """What the kernel granted, and a sentence for each request that it refused."""

    fifo: bool
    memory_locked: bool
    awake: bool
    missing: tuple[str, ...] = ()


def fifo(priority: int) -> bool:
    """Request SCHED_FIFO at this priority for the calling thread; false where that is not permitted."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (PermissionError, OSError):
        return False
    return True


def lock_memory() -> bool:
    """Keep every touched page in memory, if the limit allows it: under a small limit later allocations would fail.

    Pages that were never touched stay out: unused code of libraries and 8 MB of stack for each thread would be 200 MB.
    """
    soft, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if soft != resource.RLIM_INFINITY and not _may_lock_any():
        return False
    return bool(ctypes.CDLL(None, use_errno=True).mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) == 0)


def populate(libraries: Sequence[str]) -> int:
    """Map all code of these loaded libraries into memory, so that no first call of a function waits for the disk.

    Args:
        libraries: Beginnings of file names.

    Returns:
        The number of bytes that the kernel has brought into memory; before Linux 5.14 it brings none.
    """
    brought = 0
    for line in Path("/proc/self/maps").read_text().splitlines():
        addresses, permissions, *_, path = line.split(maxsplit=5) if line.count("/") else ("", "", "")
        if "x" in permissions and Path(path).name.startswith(tuple(libraries)):
            begin, end = (int(address, 16) for address in addresses.split("-"))
            if ctypes.CDLL(None).madvise(ctypes.c_void_p(begin), ctypes.c_size_t(end - begin), _MADV_POPULATE_READ) == 0:
                brought += end - begin
    return brought


def _may_lock_any() -> bool:
    """Whether this process has CAP_IPC_LOCK, so that the limit does not apply. Root does not always have it."""
    held = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("CapEff:"))
    return bool(int(held.split()[1], 16) >> _CAP_IPC_LOCK & 1)


@contextmanager
def awake() -> Iterator[bool]:
    """Keep all processors from sleeping within the context; yields whether that is granted.

    A processor that slept between two ticks wakes late and with cold caches. docs/benchmarks.md compares both.
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
    """Within the context the calling thread is a FIFO thread, its process is locked, nothing collects garbage, no processor sleeps."""
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
