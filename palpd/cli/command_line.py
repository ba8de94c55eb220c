"""From the words of a command line to its exit code. Imports little, so that `palpd abort` speaks to the daemon at once."""

import contextlib
import io
import os
import sys

from palpd.cli.at_once import done_at_once
from palpd.daemon import interrupts
from palpd.errors import PalpdError


def exit_code_of(words: list[str]) -> int:
    """Carry out a command line; an error of ours is one sentence on stderr.

    Args:
        words: What stands on the command line after `palpd`.

    Returns:
        The exit code. A process that a signal has interrupted ends here.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # a name, or a sign such as ±, that the terminal cannot show ends no command
    try:
        try:
            exit_code = _carried_out(words)
        finally:
            interrupts.ignore()
    except interrupts.Interrupted as interrupted:
        exit_code = _say(str(interrupted), interrupts.exit_code())
    if interrupts.received():
        interrupts.end(exit_code)
    return exit_code


def _carried_out(words: list[str]) -> int:
    try:
        if not done_at_once(words):
            from palpd.cli.application import carry_out

            interrupts.listen()
            carry_out(words)
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
