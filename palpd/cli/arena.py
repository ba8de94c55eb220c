"""The command of the open benchmark: ask a tool, score its answers, plant new questions."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from palpd.cli.options import app, terminal
from palpd.cli.output_options import FOLDER, Output
from palpd.errors import BadInput
from palpd.files import check_folder

CASES = Path("benchmarks/arena")


@app.command(
    examples=["palpd arena run --tool palpd --answers answers", "palpd arena score --answers answers"],
    apart={"docs": ("to",)},
)
def arena(
    action: Annotated[
        Literal["run", "score", "plant"], typer.Argument(help="ask a tool, score answers, or plant effects into healthy recordings")
    ],
    answers: Annotated[list[Path] | None, typer.Option("--answers", help="folder of answers; for score, one for each tool")] = None,
    tool: Annotated[str, typer.Option("--tool", help="palpd, least-squares, sindy, threshold or always")] = "palpd",
    cases: Annotated[Path, typer.Option("--cases", help="folder of rigs")] = CASES,
    docs: Annotated[Path | None, typer.Option("--docs", help="for score: write the page and its picture here"), Output(FOLDER)] = None,
    to: Annotated[Path | None, typer.Option("--to", help="for plant: a new folder of rigs"), Output(FOLDER)] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="for plant: the same seed plants the same effects")] = 1,
    number: Annotated[int | None, typer.Option("--number", min=1, help="this number of questions only, in turn from each rig")] = None,
    limit_s: Annotated[float, typer.Option("--limit-s", min=1.0, help="processor time of a tool for each question")] = 60.0,
    jobs: Annotated[int, typer.Option("--jobs", min=1, help="processes")] = 2,
) -> None:
    """Judge diagnosis tools on recordings of other rigs whose cause is known: ask a tool, then score its answers."""
    from palpd.arena.cases import every, rigs

    shipped = rigs(cases)
    if action == "plant":
        if to is None:
            raise BadInput("palpd arena plant writes a folder of rigs; give --to FOLDER")
        from palpd.arena.plant import plant_all

        terminal().print(f"{to}: {plant_all(shipped, to, seed, number)} questions. palpd arena run --cases {to} asks a tool.")
        return
    if not answers:
        raise BadInput(f"palpd arena {action} needs a folder of answers; give --answers FOLDER")
    questions = every(shipped, number)
    if action == "score":
        from palpd.arena.page import headline, table, write_page
        from palpd.arena.run import scored

        tools = {folder.name: scored(questions, folder) for folder in answers}
        for name, rows in tools.items():
            terminal().print(f"{name}: {headline(rows)}\n\n{table(rows)}\n", soft_wrap=True)
        if docs is not None:
            terminal().print(str(write_page(docs, cases, shipped, tools)))
        return
    if len(answers) > 1:
        raise BadInput("palpd arena run writes one folder of answers; give --answers once")
    from rich.progress import Progress

    from palpd.arena.run import ask

    check_folder(answers[0])
    with Progress(console=terminal(), transient=True) as shown:
        bar = shown.add_task(tool, total=len(questions))
        ask(
            tool, [question for question, _ in questions], answers[0], jobs=jobs, limit_s=limit_s,
            advance=lambda done: shown.update(bar, advance=done),
        )  # fmt: skip
    terminal().print(f"{answers[0]}: {len(questions)} answers. palpd arena score --answers {answers[0]} scores them.")
