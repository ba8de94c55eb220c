"""The command line: options and printing.

Exit codes: 0 done, 2 bad input or refused (one sentence on stderr), 3 stopped by the guard, a fault or a signal, 130 interrupted by a
signal while nothing moved. This file imports little, so that
`palpd abort` speaks to the daemon at once; `app` holds all commands and is built when it is asked for.
"""

import contextlib
import io
import os
import sys
from typing import TYPE_CHECKING, Any

from palpd.errors import PalpdError

if TYPE_CHECKING:
    from palpd.cli.application import app as app


def main() -> None:
    """Entry point: errors and signals become one sentence and an exit code, never a traceback."""
    from palpd.daemon import interrupts

    interrupts.listen()
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # a name, or a sign such as ±, that the terminal cannot show ends no command
    try:
        try:
            exit_code = _carry_out()
        finally:
            interrupts.ignore()
    except interrupts.Interrupted as interrupted:
        exit_code = _say(str(interrupted), interrupts.EXIT_CODE)
    if interrupts.received():
        interrupts.end(exit_code)
    sys.exit(exit_code)


def _carry_out() -> int:
    """Carry out the command line and return its exit code."""
    from palpd.cli.at_once import done_at_once
    from palpd.daemon import interrupts

    try:
        if not done_at_once(sys.argv[1:]):
            from palpd.cli.application import carry_out

            interrupts.started()
            carry_out(sys.argv[1:])
        if sys.stdout:
            sys.stdout.flush()
    except PalpdError as error:
        return _say(str(error), error.exit_code)
    except SystemExit as ended:
        return ended.code if isinstance(ended.code, int) else 0
    except Exception as error:  # a library that was interrupted in its import raises anything, and a closed terminal takes no tables
        if interrupts.received():
            return _say(*interrupts.last_words())
        failure = _failure_of_stdout() if isinstance(error, OSError) and sys.stdout else None
        if failure is None:
            raise
        if isinstance(failure, BrokenPipeError):  # `palpd effects | head` has all that it asked for
            return 1
        return _say(f"what it prints cannot be written ({failure.strerror}); send it to another place", 2)
    return 0


def _failure_of_stdout() -> OSError | None:
    """Why stdout takes nothing more, if so; what stands in its buffer is given up, so that the way out does not try it again."""
    try:
        sys.stdout.flush()
        os.write(sys.stdout.fileno(), b"\n")  # a buffer that has failed once has forgotten what it held, and flushes well
    except OSError as failure:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return failure
    return None


def _say(sentence: str, exit_code: int) -> int:
    """Print one sentence on stderr, if there still is one, and return the exit code."""
    with contextlib.suppress(OSError):
        print(f"palpd: {' '.join(sentence.split())}", file=sys.stderr)  # a name with a line break stays in one line
    return exit_code


def __getattr__(name: str) -> Any:
    """Build the commands when `app` is first asked for."""
    if name == "app":
        from palpd.cli.application import app

        return app
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
