"""What the commands share: the application they belong to, options, the terminal, and the way out."""

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from palpd.cell.plausible import ACCEPT_OPTION
from palpd.cli.at_once import DEFAULT_CONFIG as DEFAULT_CONFIG
from palpd.cli.command_groups import GroupedCommands
from palpd.cli.output_options import Application, Output
from palpd.errors import BadInput
from palpd.file_kinds import JSON
from palpd.files import check_folder

if TYPE_CHECKING:
    from rich.console import Console

    from palpd.cli.terminal import TerminalDisplay
    from palpd.config import Config
    from palpd.control.plan_place import Choice

app = Application(
    cls=GroupedCommands,
    help="Press soft tissue with a UR5 and a HEX-70, say how stiff it is, and why a cell does not behave like its simulation.",
    epilog="palpd COMMAND --help shows the options of a command, and examples. Begin with palpd demo, or with docs/start.md.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # help in colours takes 0.3 s more to import
    context_settings={"max_content_width": 140},
)


def _print_version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        print(f"palpd {version('palpd')}")
        raise typer.Exit


@app.callback()
def _options_before_a_command(
    _version: Annotated[bool, typer.Option("--version", callback=_print_version, is_eager=True, help="print the version and end")] = False,
) -> None: ...


ConfigOption = Annotated[Path, typer.Option("--config", help="config.yaml of the cell")]
PlanOption = Annotated[Path, typer.Option("--plan", help="plan.yaml: where, how deep, how often")]
JsonOption = Annotated[Path | None, typer.Option("--json", help="write the figures to this file too"), Output(JSON)]
SocketOption = Annotated[Path | None, typer.Option("--socket", help="control socket of the daemon (default: the one of --config)")]
CellOption = Annotated[Path, typer.Option("--cell", help="cell.yaml: what the simulator believes of the cell")]
EffectsOption = Annotated[
    Path | None, typer.Option("--effects", help="effects of your own: a Python file (docs/examples) or learned ones (.yaml)")
]
SiteOption = Annotated[str | None, typer.Option("--site", help="this site only, of recordings of the daemon (.mcap)")]
ProgressOption = Annotated[bool, typer.Option("--progress", help="write each step to stderr, one a line, for programs")]
AdoptedOption = Annotated[bool, typer.Option("--adopted/--no-adopted", help="whether your adopted effects count (palpd effects --adopt)")]
HereOption = Annotated[bool, typer.Option("--here", help="count sites from where the arm stands, though the last run was not finished")]
ReturnOption = Annotated[bool, typer.Option("--return", help="go back first to where the last, unfinished run began")]
AcceptImplausible = Annotated[bool, typer.Option(ACCEPT_OPTION, help="let values count that palpd questions, such as a mass of 100 kg")]
DEFAULT_PLAN = Path("plan.yaml")

PIPE_WIDTH = 200
"""Letters in a line where the output is no terminal: rich takes 80 there, and cut names of effects."""


@cache
def terminal() -> "Console":
    """The terminal that the commands print to; made when something is printed, since rich takes a tenth of a second to import.

    Texts are printed as they are, since names of files and sites may look like markup. In a pipe no line is broken, and no table is cut.
    """
    from rich.console import Console

    console = Console(markup=False, highlight=False)
    console.soft_wrap = not console.is_terminal
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = PIPE_WIDTH
    return console


def display() -> "TerminalDisplay":
    """The terminal as the daemon's jobs report to it."""
    from palpd.cli.terminal import TerminalDisplay

    return TerminalDisplay(terminal())


def stated_address(option: typer.CallbackParam, address: str) -> str:
    """Refuse an empty address to listen at, which would mean all addresses of this computer.

    Args:
        option: The option that states it.
        address: What it states.

    Raises:
        BadInput: It is empty.
    """
    if not address.strip():
        raise BadInput(f"--{option.name} is empty, expected an address; 127.0.0.1 is this computer only, 0.0.0.0 all of its addresses")
    return address


@contextmanager
def shown_steps(activity: str, progress: bool) -> Iterator[Callable[[str], None]]:
    """Show the steps of a calculation within the context: on a terminal in one line that changes, for a program as lines on stderr.

    Args:
        activity: What is calculated.
        progress: Whether a program reads the steps.

    Yields:
        Shows the step that begins.
    """
    if progress:
        yield lambda step: print(step, file=sys.stderr, flush=True)
        return
    from rich.text import Text

    with terminal().status(activity) as status:
        yield lambda step: status.update(Text(f"{activity}: {step}"))


def finish(exit_code: int, reason: str) -> None:
    """End the command with that exit code and its reason on stderr; go on where the code is 0.

    Args:
        exit_code: 0 to 3.
        reason: Sentence that says why.

    Raises:
        typer.Exit: Where the code is not 0.
    """
    if exit_code:
        print(f"palpd: {reason}", file=sys.stderr)
        raise typer.Exit(exit_code)


def settings_of(config: Path, *, optional: bool = False) -> "Config":
    """Read the configuration of the cell.

    Args:
        config: What --config states.
        optional: Whether the command takes the default configuration where --config is not given and there is no config.yaml.

    Raises:
        ConfigError: The file cannot be read, or is wrong.
    """
    from palpd.config import load_config

    return load_config(None if optional and config == DEFAULT_CONFIG and not config.exists() else config)


def say_broken_effects() -> None:
    """Say on stderr which installed effects are left out, and why."""
    from palpd.cell.effects import installed_effects

    for sentence in installed_effects()[1]:
        print(f"palpd: {sentence}", file=sys.stderr)


def adopted_folder(adopted: bool) -> Path | None:
    """The folder of this user's adopted effects; None where they shall not count."""
    from palpd.cell.effects.adopted import user_folder

    return user_folder() if adopted else None


def say_latch(config: "Config") -> None:
    """Show the latch of the last stop, which a run in the foreground clears: who starts it is the operator who may.

    Raises:
        Refused: The cause of a protective stop must be written down first.
    """
    from palpd.daemon.stored_state import State
    from palpd.errors import Refused

    state = State(config.paths.state)
    if asked := state.protective_stops().cause_asked:
        raise Refused(f"{asked}; palpd recover-robot asks for it")
    latch = state.latch()
    if latch is not None:
        terminal().print(f"The last run was stopped on {latch.date}: {latch.reason}. A run that begins now clears it.", style="yellow")


def place_choice(here: bool, go_back: bool) -> "Choice | None":
    """What the operator answers to the question of the place.

    Args:
        here: The sites count from where the arm stands.
        go_back: The arm returns to the start of the last palpation first.

    Returns:
        The answer, None where neither was given.

    Raises:
        BadInput: Both answers are given.
    """
    if here and go_back:
        raise BadInput("--here and --return contradict each other, expected one of them; leave one out")
    return "here" if here else "return" if go_back else None


def check_kept(config: "Config") -> None:
    """Refuse folders of recordings and state that cannot be written into, before anything moves. Raises BadInput."""
    check_folder(config.paths.runs, config.paths.state)
