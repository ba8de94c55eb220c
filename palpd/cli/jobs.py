"""A program of the command line: a job of the service where one serves this cell, else in the foreground."""

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path

import typer

from palpd.cli.options import check_kept, display, say_latch
from palpd.config import Config
from palpd.daemon.job_client import carried_out_by_service, service_at
from palpd.daemon.programs import ProgramEnd, program_named
from palpd.daemon.stored_state import State
from palpd.errors import BadInput, Refused
from palpd.files import copy_file


def carried_out(
    name: str, arguments: Mapping[str, object], config: Config, kept: Path, agree: Callable[[str], bool] = typer.confirm
) -> ProgramEnd:
    """Carry out a program where it belongs.

    Args:
        arguments: Its arguments, as a request to the service holds them.
        config: Configuration of the cell.
        kept: File or folder that the program keeps in the foreground; a job of the service keeps its own, in the service's runs.
        agree: Asks for consent to a motion.

    Returns:
        How the program ended.

    Raises:
        PalpdError: Nothing was done, or the service refused.
    """
    program = program_named(name)
    if service_at(config.paths.control_socket):
        return carried_out_by_service(config.paths.control_socket, name, arguments, display(), agree)
    from palpd.daemon.session import ForegroundHost
    from palpd.daemon.wiring import devices

    check_kept(config)
    validated = program.validated(dict(arguments))
    if program.moves and program.command_arms:
        say_latch(config)
    elif program.moves and (latch := State(config.paths.state).latch()) is not None:
        raise Refused(f"the last run was stopped on {latch.date}: {latch.reason}; look at the cell, then palpd clear")
    if (most_runs := program.most_runs(validated)) > 1:
        display().say(f"This makes at most {most_runs} runs.")
    return program.carry_out(ForegroundHost(config, devices, display(), agree), validated, kept)


def fetch(kept: str | None, target: Path) -> Path | None:
    """Copy what a job of the service keeps to where this command was asked to write; nothing where it stands there already.

    Args:
        kept: File or folder of the job; None where it kept nothing.
        target: Where it should stand.

    Returns:
        Where it stands; None where the job kept nothing.

    Raises:
        BadInput: It cannot be copied.
    """
    if kept is None or Path(kept).absolute() == target.absolute():
        return Path(kept) if kept is not None else None
    try:
        if Path(kept).is_dir():
            shutil.copytree(kept, target, copy_function=lambda source, copy: copy_file(Path(source), Path(copy)), dirs_exist_ok=True)
        else:
            copy_file(Path(kept), target)
    except (OSError, shutil.Error, BadInput) as error:
        raise BadInput(f"{kept} is complete, but cannot be copied to {target} ({error}); copy it as a user who may") from error
    return target
