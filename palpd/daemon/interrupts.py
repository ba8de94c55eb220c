"""SIGINT, SIGTERM and SIGHUP at any moment of a command: one handler, installed before anything is started.

| moment | what a signal does |
|---|---|
| palpd imports its commands | the process ends at once (`palpd.cli.main`) |
| no job is under way | `Interrupted` is raised in the main thread, and the process ends, at the latest after `LEAVE_S` |
| a job is under way (`held`) | the job is asked to end; it goes its own way to a closed recording |

While nothing moved, the exit code is 128 + the number of the signal. The first signal counts. A later one changes nothing. This file
imports little, because an abort imports it.
"""

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""What ends a command: Ctrl-C, `kill`, and a terminal that is closed."""
LEAVE_S = 0.3
"""Longest time from a signal to the end of a process without a job. Code that swallows the exception cannot make it longer."""


class Interrupted(BaseException):
    """A signal ended the command while nothing moved; the text says which and when. No `except Exception` may swallow it."""


class _Received:
    """What this process has received. A module of handlers cannot do without a place that all its functions see."""

    name = ""
    at_s = 0.0
    on_signal: Callable[[], None] | None = None
    last_sentence = "interrupted"
    last_code = 1


def listen() -> None:
    """Install the handler: from here on a signal raises `Interrupted`, so that files, displays and emulators are closed in order.

    A signal that was ignored stays ignored (nohup).
    """
    signal.signal(signal.SIGALRM, _leave)
    sys.unraisablehook = _report_unraisable
    _install()


def ignore() -> None:
    """The command is over: a signal must not spoil its exit code any more."""
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def received() -> str:
    """Name of the first signal that this process has received; empty while there is none."""
    return _Received.name


def exit_code() -> int:
    """Exit code of a command that the first signal has ended while nothing moved: 128 + its number, as shells have it."""
    return 128 + signal.Signals[_Received.name]


def waited_s() -> float:
    """Time since the first signal; zero while there is none."""
    return time.monotonic() - _Received.at_s if _Received.name else 0.0


@contextmanager
def held(on_signal: Callable[[], None]) -> Iterator[None]:
    """Within the context a signal raises nothing: it calls `on_signal`, in the main thread."""
    outer = _Received.on_signal
    _Received.on_signal = on_signal
    before = _install() if threading.current_thread() is threading.main_thread() else {}
    try:
        yield
    finally:
        _Received.on_signal = outer
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def shielded() -> Iterator[None]:
    """Processes that are started within the context inherit that these signals wait, from their first instruction.

    Ctrl-C and a closed terminal reach all processes of palpd. Only the main process may react: it stops the arm and closes the recording.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def leave_within(patience_s: float, sentence: str, exit_code: int) -> None:
    """End the process after that time, whatever it does then.

    Args:
        patience_s: Time that is left for tables and files.
        sentence: What is printed in their place.
    """
    _Received.last_sentence, _Received.last_code = sentence, exit_code
    if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGALRM) is _leave:
        signal.setitimer(signal.ITIMER_REAL, patience_s)


def end(exit_code: int) -> NoReturn:
    """End an interrupted process without Python's own shutdown, which takes up to a second where many libraries are loaded."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(exit_code)


def last_words() -> tuple[str, int]:
    """Sentence and exit code of a command that a signal has ended."""
    return _Received.last_sentence, _Received.last_code


def _install() -> dict[signal.Signals, Callable[[int, FrameType | None], object] | int]:
    """Install the handler, and return what was there and Python can put back."""
    before = {number: signal.getsignal(number) for number in SIGNALS}
    taken = {number: handler for number, handler in before.items() if handler not in (None, signal.SIG_IGN, _handle)}
    for number in taken:
        signal.signal(number, _handle)
    return {number: handler for number, handler in taken.items() if handler is not None}


def _handle(number: int, _frame: FrameType | None) -> None:
    first = not _Received.name
    if first:
        _Received.name, _Received.at_s = signal.Signals(number).name, time.monotonic()
        _Received.last_code = exit_code()
    if _Received.on_signal is not None:
        _Received.on_signal()
    elif first:
        sentence = f"interrupted by {_Received.name}"
        leave_within(LEAVE_S, sentence, exit_code())
        raise Interrupted(sentence)


def _report_unraisable(lost: "sys.UnraisableHookArgs") -> None:
    """Say nothing where a signal came while Python ran a destructor or a callback of a weak reference; `_leave` ends the process then."""
    if not issubclass(lost.exc_type, Interrupted):
        sys.__unraisablehook__(lost)


def _leave(_number: int, _frame: FrameType | None) -> None:
    _end_saying(_Received.last_sentence, _Received.last_code)


def _end_saying(sentence: str, exit_code: int) -> NoReturn:
    """End at once. It writes past Python's buffers, which a signal may have interrupted."""
    with contextlib.suppress(OSError):
        os.write(2, f"palpd: {sentence}\n".encode())
    os._exit(exit_code)
