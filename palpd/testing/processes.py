"""Processes under test: those of a session, signals to them and from a terminal, and waiting for what they do."""

import os
import resource
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

PATIENCE_S = 60.0


def family(session: int) -> list[int]:
    """Every living process of a session, zombies left out."""
    members = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if int(fields[3]) == session and fields[0] != "Z":
                members.append(int(entry.name))
    return members


def command_of(pid: int) -> str:
    """Its command line."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode()
    except OSError:
        return ""


def processor_s(pid: int) -> float:
    """Processor time that a process has used, user and kernel."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def children_s() -> float:
    """Processor time, user and kernel, of all processes that this one has started and that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def timed(command: Sequence[str]) -> tuple[float, float]:
    """Carry out a command whose output nobody reads. Returns its processor and wall time, in s."""
    before_s, began_s = children_s(), time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return children_s() - before_s, time.perf_counter() - began_s


def resident_MB(pid: int) -> float:
    """Memory of a process that is in RAM, in MiB."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def free_port() -> int:
    """A port of this computer that nobody listens at."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def until(true: Callable[[], Any], what: str, timeout_s: float = PATIENCE_S, every_s: float = 0.01) -> Any:
    """Ask again until it is true, and return what it is."""
    end_s = time.monotonic() + timeout_s
    while time.monotonic() < end_s:
        if answer := true():
            return answer
        time.sleep(every_s)
    raise AssertionError(f"not within {timeout_s:g} s: {what}")


def side_by_side(work: Callable[[Path], None], folder: Path, number: int) -> None:
    """Do the same work in that many threads, each in a folder of its own for an emulated cell of its own, until all are done."""
    threads = []
    for k in range(number):
        own = folder / f"cell-{k}"
        own.mkdir()
        threads.append(threading.Thread(target=work, args=(own,)))
        threads[-1].start()
    for thread in threads:
        thread.join()


@contextmanager
def over_and_over(act: Callable[[], object]) -> Iterator[None]:
    """Act again and again, in a thread of its own, within the context."""
    over = threading.Event()

    def work() -> None:
        while not over.is_set():
            act()

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def kill(pid: int, number: int = signal.SIGKILL) -> float:
    """Send a signal, to a whole group if negative, and return when."""
    os.kill(pid, number)
    return time.monotonic()


def take_signals() -> None:
    """Take SIGINT and SIGHUP, which a background job ignores (a shell, `nohup`); the commands that it starts would ignore them too."""
    for number, handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, handler)
