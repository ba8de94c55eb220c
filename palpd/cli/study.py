"""The command that does the paper again."""

from pathlib import Path
from typing import Annotated

import typer

from palpd.cli.options import JsonOption, app, terminal
from palpd.cli.output_options import FOLDER, Output
from palpd.file_kinds import HTML, JSON
from palpd.files import check_writable, write_json


@app.command(
    examples=["palpd study --days 0 --out study", "palpd study --published"],
    apart={"published": ("out", "seed", "days", "bare", "free", "palpation", "cell"), "palpation": ("seed", "days")},
)
def study(
    out: Annotated[Path, typer.Option("--out", help="folder for study.html and study.json"), Output(FOLDER)] = Path("study"),
    seed: Annotated[int, typer.Option("--seed", min=0, help="another laboratory: noise, tares, biases")] = 0,
    days: Annotated[int, typer.Option("--days", min=0, help="further days by the same models")] = 20,
    bare: Annotated[list[Path] | None, typer.Option("--bare", help="recording of free motion without the probe (.mcap)")] = None,
    free: Annotated[list[Path] | None, typer.Option("--free", help="recordings of free motion with the probe (.mcap)")] = None,
    palpation: Annotated[Path | None, typer.Option("--palpation", help="recording of a plan with mode: both (.mcap)")] = None,
    cell: Annotated[list[str] | None, typer.Option("--cell", help="SITE=FILE, a cell file enriched by palpd diagnose")] = None,
    published: Annotated[
        bool, typer.Option("--published", help="instead: what the published numbers say of their own gap, nothing simulated")
    ] = False,
    json_file: JsonOption = None,
) -> None:
    """Do section 4 of Guo, Xiao, Ren 2019 again: on the emulated cell, or on recordings of a real one; one page of tables and figures."""
    from palpd.study import evaluation
    from palpd.study.recorded_data import Sources, load_recorded
    from palpd.study.report import figures_of, means, write

    sources = Sources(bare or [], free or [], palpation, cell or [])
    if published:
        _published_gap(json_file)
        return
    if out.is_dir():
        check_writable(out / "study.html", kind=HTML)
        check_writable(out / "study.json", kind=JSON)
    if sources:
        result = evaluation.study_of(load_recorded(sources))
    else:
        terminal().print("The emulated cell is studied: diagnosing four setups takes most of the time, some minutes in all.")
        result = evaluation.study(seed, days)
    page, _ = write(result, out)
    for name, (mean, half, n) in means(result).items():
        terminal().print(f"YMBT {100 * mean:5.1f} %" + (f" ± {100 * half:.1f}" if n > 1 else "") + f"  {name}")
    terminal().print(f"{page}")
    write_json(json_file, figures_of(result))


def _published_gap(json_file: Path | None) -> None:
    from palpd.cli.tables import published_table
    from palpd.study import published as study_paper

    figures = study_paper.published()
    terminal().print(published_table(figures))
    terminal().print(figures["sentence"])
    write_json(json_file, figures)
