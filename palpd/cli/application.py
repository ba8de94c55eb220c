"""All commands together."""

import sys
from typing import Any

import typer

from palpd.cli import analysis, arena, blind, gap, history, recordings, run, service, setup, study
from palpd.cli.command_groups import ORDER
from palpd.cli.options import app
from palpd.errors import BadInput, Refused

__all__ = ["app", "carry_out", "name_of"]

UsageError: Any = typer.BadParameter.__bases__[0]
"""What typer raises for words that fit no command; it has no public name."""

FILES = (run, service, setup, history, recordings, analysis, gap, blind, study, arena)
"""Where the commands stand; importing them registers them."""


def name_of(command: Any) -> str:
    """The name of a registered command."""
    return command.name or command.callback.__name__


app.registered_commands.sort(key=lambda command: ORDER.index(name_of(command)))


MANY_FILES = ("--healthy", "--now")
"""Options of `palpd diagnose` that take as many files as follow."""


def carry_out(words: list[str]) -> None:
    """Carry out a command line; words that fit no command are refused in one sentence too. Raises PalpdError."""
    try:
        code = app(one_file_each(words) or ["--help"], prog_name="palpd", standalone_mode=False)
    except UsageError as error:
        context = getattr(error, "ctx", None)
        sentence = " ".join(
            str(error.format_message()).replace("Value error, ", "").replace("Input should be", "expected a value").split()
        ).rstrip(".") + _what_works(error)
        help_line = f"{context.command_path if context else 'palpd'} --help"
        raise BadInput(f"{sentence[:1].lower()}{sentence[1:]}; {help_line} shows what is expected") from None
    except typer.Abort:
        raise Refused("the question was not answered, so nothing was done; answer it, or give --yes where there is one") from None
    if code:
        sys.exit(code)


def one_file_each(words: list[str]) -> list[str]:
    """A command line in which each file of MANY_FILES has its own option: a shell makes several of a pattern.

    Args:
        words: The command line, the command first.

    Raises:
        BadInput: No file follows one of them: the pattern met none.
    """
    out, option = [], ""
    for word, following in zip(words, [*words[1:], "-"], strict=True):
        if word.startswith("-"):
            option = word if word in MANY_FILES and words[0] == "diagnose" else ""
            if option and following.startswith("-"):
                raise BadInput(f"{option} has no file behind it, expected one recording or more; name them, or leave {option} out")
            out += [] if option else [word]
        else:
            out += [option, word] if option else [word]
    return out


def _what_works(error: Any) -> str:
    """What to take instead, where a robot or a simulator was asked for that palpd does not know."""
    option = getattr(getattr(error, "param", None), "name", "") if "is not one of" in str(error.message) else ""
    if option == "model":
        from palpd.config import OTHER_ROBOTS

        return f": {OTHER_ROBOTS}"
    if option == "to":
        from palpd.interchange.simulators.export import OTHER_SIMULATORS

        return f": {OTHER_SIMULATORS}"
    return ""
