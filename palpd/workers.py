"""Processes that compute for a command. They end with it, however it ends: the kernel kills them when it is gone.

`python -m palpd.workers PID MODULE ARGUMENTS` runs a module so; `beside` makes that command line.
"""

import contextlib
import ctypes
import os
import runpy
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from concurrent.futures import ProcessPoolExecutor

KILL_WITH_PARENT = 1
"""PR_SET_PDEATHSIG of prctl(2). Parent means the thread that started this process: a pool is made and used by one thread."""

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""What ends a command."""


@contextmanager
def pool(jobs: int) -> Iterator["ProcessPoolExecutor"]:
    """Compute in several processes within the context; where it raises, such as by Ctrl-C, they end at once."""
    # A signal during a fork would raise in the hooks of the fork, which swallow it, or in a worker that has the handler of the command.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        workers = started(jobs, method="fork")
        workers.submit(os.getpid)  # the first task starts all processes
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    try:
        yield workers
    except BaseException:
        end(workers)
        raise
    workers.shutdown()


def started(jobs: int, *, method: Literal["fork", "spawn"], niceness: int = 0) -> "ProcessPoolExecutor":
    """Make a pool that `end` ends.

    Args:
        jobs: Number of processes.
        method: How they start; a process with threads, such as a server, must spawn.
        niceness: What is added to their niceness.
    """
    from concurrent.futures import ProcessPoolExecutor  # imported here: whoever starts a command alone needs none of it
    from multiprocessing import get_context

    return ProcessPoolExecutor(jobs, get_context(method), initializer=_begin, initargs=(os.getpid(), niceness))


def end(workers: "ProcessPoolExecutor") -> None:
    """End the processes of a pool now, whatever they compute."""
    processes = list((getattr(workers, "_processes", None) or {}).values())
    workers.shutdown(wait=False, cancel_futures=True)
    for process in processes:
        with contextlib.suppress(OSError):
            process.kill()


def beside(module: str, *arguments: str) -> list[str]:
    """Make the command line that runs a module in a process that ends with this one.

    Args:
        module: Name of the module, which runs as its own program.
    """
    return [sys.executable, "-m", "palpd.workers", str(os.getpid()), module, *arguments]


def _begin(parent: int, niceness: int) -> None:
    end_with(parent)
    for number in (signal.SIGINT, signal.SIGHUP):  # these reach all of palpd; the command ends its workers
        signal.signal(number, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # a pool that is broken ends its processes so; a fork has the command's own handler
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    os.nice(niceness)


def end_with(parent: int, number: signal.Signals = signal.SIGKILL) -> None:
    """Let the kernel end this process when its parent is gone.

    Args:
        parent: Process id of the parent when this process began.
        number: SIGTERM lets it end in order.
    """
    ctypes.CDLL(None).prctl(KILL_WITH_PARENT, number, 0, 0, 0)
    if os.getppid() != parent:  # it died before
        os._exit(1)


if __name__ == "__main__":
    end_with(int(sys.argv[1]))
    del sys.argv[:2]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
