"""Commands for whoever sets a cell up: the steps from an empty folder to the first press, and what they have shown."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from palpd.cli.options import DEFAULT_CONFIG, ConfigOption, JsonOption, app, display, finish, settings_of, terminal
from palpd.cli.output_options import FOLDER, Output
from palpd.cli.service import PAGE_PORT, ListenOption, PortOption, become_page
from palpd.file_kinds import YAML
from palpd.files import write_json

if TYPE_CHECKING:
    from palpd.daemon.display import Display
    from palpd.daemon.setup.cell import StepOperator


class TerminalOperator:
    """Whoever sits at the terminal, or a program that types into a pipe."""

    def say(self, sentence: str) -> None:
        """Print a sentence."""
        terminal().print(sentence, soft_wrap=True)

    def ask(self, question: str, usual: str = "") -> str:
        """Ask for a text; an empty answer is the usual one.

        Raises:
            NoOperator: The input has ended.
        """
        try:
            return input(f"{question}{f' [{usual}]' if usual else ''} > ").strip() or usual
        except EOFError:
            from palpd.daemon.setup.cell import NoOperator

            raise NoOperator(
                "a question has no answer, expected a terminal; run palpd setup in one, where it goes on, or leave the step out with --skip"
            ) from None

    def choose(self, question: str, answers: Sequence[str], moves: str = "") -> str:
        """Ask for one of the answers; its first letters suffice, and an empty answer is the first. The question says what `moves` does."""
        del moves
        while True:
            word = self.ask(f"{question} ({', '.join(answers)})", answers[0])
            fitting = [answer for answer in answers if answer.startswith(word)]
            if word in answers or len(fitting) == 1:
                return word if word in answers else fitting[0]
            self.say(f"{word!r} is none of {', '.join(answers)}.")


@app.command(
    examples=["palpd setup cell --robot 192.168.1.10 --redo weight", "palpd setup cell --page"],
    apart={"page": ("robot", "sensor", "redo", "skip", "talk")},
)
def setup(
    folder: Annotated[Path, typer.Argument(metavar="CELL", help="folder of the cell; made where it is missing"), Output(FOLDER)] = Path(
        "cell"
    ),
    robot: Annotated[str | None, typer.Option("--robot", help="address of the controller (default: asked)")] = None,
    sensor: Annotated[str | None, typer.Option("--sensor", help="port of the sensor (default: searched for)")] = None,
    redo: Annotated[list[str] | None, typer.Option("--redo", metavar="STEP", help="do this step again; may be repeated")] = None,
    skip: Annotated[list[str] | None, typer.Option("--skip", metavar="STEP", help="leave this step out; may be repeated")] = None,
    page: Annotated[bool, typer.Option("--page", help="lead through it in a browser: serve the page for this cell")] = False,
    port: PortOption = PAGE_PORT,
    listen: ListenOption = "127.0.0.1",
    talk: Annotated[bool, typer.Option("--talk", help="speak JSON lines, for the page, and end with the program that began it")] = False,
) -> None:
    """Set a cell up step by step, from an empty folder to the first press of 1 N; goes on where it ended."""
    import os
    import signal

    from palpd.daemon.setup.cell import SetupCell
    from palpd.daemon.setup.flow import NAMES, set_up

    if page:
        become_page(folder / "config.yaml", "--setup", folder, "--listen", listen, "--port", port)
    operator: StepOperator = TerminalOperator()
    shown: Display = display()
    if talk:
        from palpd.cli.setup_talk import TalkOperator
        from palpd.workers import end_with

        end_with(os.getppid(), signal.SIGTERM)  # as Ctrl-C, so that a run of the arm ends in a stop and its recording is closed
        operator = shown = TalkOperator()
    commission = set_up(SetupCell(folder, operator, shown, robot, sensor), redo or (), skip or ())
    failed = [name for name in NAMES if name in commission.steps and commission.steps[name].verdict == "fail"]
    open_steps = [name for name in NAMES if name not in commission.steps]
    config = folder / "config.yaml"
    if not failed and not open_steps:
        operator.say(f"The cell is set up. What it confirms: palpd commission --config {config} --report")
    elif not failed:
        operator.say(f"Next is {open_steps[0]}: palpd setup {folder} goes on there.")
    finish(2 if failed else 0, f"{', '.join(failed)} failed; do what its lines say, and palpd setup {folder} goes on there")


@app.command(
    examples=["palpd commission --config cell/config.yaml --report", "palpd commission --config cell/config.yaml --cell-out cell.yaml"]
)
def commission(
    config: ConfigOption = DEFAULT_CONFIG,
    report: Annotated[
        bool, typer.Option("--report", help="what it says of each row of the README's table Never tested on hardware")
    ] = False,
    cell_out: Annotated[
        Path | None, typer.Option("--cell-out", help="write a cell.yaml with what was measured in place of what was assumed"), Output(YAML)
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Show what palpd setup has done so far: each step with its date and verdict."""
    from dataclasses import asdict

    from rich.table import Table

    from palpd.cell.cell_file import save_cell
    from palpd.daemon.setup.flow import NAMES
    from palpd.daemon.setup.report import ASSUMPTIONS, measured_cell
    from palpd.daemon.stored_state import State

    settings = settings_of(config)
    done = State(settings.paths.state).commission()
    rows = {assumption.rests_on: assumption.state(done) for assumption in ASSUMPTIONS}
    table = Table("rests on", "on this cell") if report else Table("step", "verdict", "date", "measured")
    for name, result in ((name, done.steps.get(name)) for name in NAMES):
        measured = "\n".join(f"{finding.name}: {finding.measured}" for finding in result.findings) if result else ""
        if not report:
            table.add_row(name, result.verdict if result else "open", result.date[:16] if result else "", measured)
    for rests_on, state in rows.items() if report else ():
        table.add_row(rests_on, state)
    terminal().print(table)
    if cell_out is not None:
        save_cell(cell_out, measured_cell(settings, done))
    write_json(json_file, {**asdict(done), "assumptions": rows, "order": NAMES})
