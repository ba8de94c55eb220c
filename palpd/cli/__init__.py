"""The command line: options and printing.

Exit codes: 0 done, 2 bad input or refused (one sentence on stderr), 3 stopped by the guard, a fault or a signal, 128 + the number of a
signal that interrupted while nothing moved. This file imports next to nothing: the handler of signals stands before anything else is
imported. Only Python's own start comes before it. `app` holds all commands and is built when it is asked for.
"""

import _signal  # type: ignore[import-not-found] # not signal, which imports enum, as long as half of Python's own start
import os
import sys

TYPE_CHECKING = False  # `typing` takes longer to import than all else before the handler
if TYPE_CHECKING:
    from types import FrameType
    from typing import Any

    from palpd.cli.application import app as app

SIGNALS = {_signal.SIGINT: "SIGINT", _signal.SIGTERM: "SIGTERM", _signal.SIGHUP: "SIGHUP"}
"""What ends a command: Ctrl-C, `kill`, and a terminal that is closed."""
MOVE = ("setup", "run", "free-motion", "stiffness", "level-test", "retract", "map", "resolve")
"""Commands that move an arm, where an interrupted one says that none was moved."""


def main() -> None:
    """Entry point: errors and signals become one sentence and an exit code, never a traceback."""
    for number in SIGNALS:
        if _signal.getsignal(number) != _signal.SIG_IGN:  # what was ignored stays ignored (nohup)
            _signal.signal(number, _end_at_once)
    if sys.argv[1:2] == ["abort"]:
        from palpd.cli.first_abort import send_first_abort

        send_first_abort(sys.argv[2:])
    from palpd.cli.command_line import exit_code_of

    sys.exit(exit_code_of(sys.argv[1:]))


def _end_at_once(number: int, _frame: "FrameType | None") -> None:
    """End a process that has not begun its work."""
    moved = "; nothing was moved" if sys.argv[1:2] and sys.argv[1] in MOVE else ""
    os.write(2, f"palpd: interrupted by {SIGNALS[number]} while palpd was starting{moved}\n".encode())
    os._exit(128 + number)


def __getattr__(name: str) -> "Any":
    """Build the commands when `app` is first asked for."""
    if name == "app":
        from palpd.cli.application import app

        return app
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
