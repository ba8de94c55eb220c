"""All commands together."""

import sys
from typing import Any

import typer

from palpd.cli import analysis, gap, history, recordings, run, service, study
from palpd.cli.options import app
from palpd.errors import BadInput, Refused

__all__ = ["app", "carry_out"]

UsageError: Any = typer.BadParameter.__bases__[0]
"""What typer raises for words that fit no command; it has no public name."""

FILES = [each.__name__ for each in (run, service, history, recordings, analysis, gap, study)]
"""The files of commands, in the order of `palpd --help`."""


def _place(command: Any) -> int:
    return FILES.index(command.callback.__module__)


app.registered_commands.sort(key=_place)


def carry_out(words: list[str]) -> None:
    """Carry out a command line; words that fit no command are refused in one sentence too. Raises PalpdError."""
    try:
        code = app(words or ["--help"], prog_name="palpd", standalone_mode=False)
    except UsageError as error:
        context = getattr(error, "ctx", None)
        sentence = " ".join(str(error.format_message()).split()).rstrip(".")
        help_line = f"{context.command_path if context else 'palpd'} --help"
        raise BadInput(f"{sentence[:1].lower()}{sentence[1:]}; {help_line} shows what is expected") from None
    except typer.Abort:
        raise Refused("the question was not answered, so nothing was done; answer it, or give --yes where there is one") from None
    if code:
        sys.exit(code)
