"""The command that judges the diagnosis itself, on cells whose truth is sealed."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from palpd.cli.options import JsonOption, app, terminal
from palpd.cli.output_options import FOLDER, RESUMED, Output
from palpd.files import check_writable, write_json

if TYPE_CHECKING:
    from palpd.blind.check import CheckResult


FEW_CASES = 20
"""Number of cases below which a blind check shows the cases and no rates: of 19, a rate is known to a fifth at best."""


@app.command(
    examples=["palpd blind --cases 3 --jobs 1 --keep look"],
    apart={
        "advice": (
            "source",
            "recordings",
            "causes",
            "large",
            "unlisted",
            "coarse",
            "docs",
            "keep",
            "resume",
            "ablation",
            "compare",
            "others",
        )
    },
)
def blind(
    cases: Annotated[int, typer.Option("--cases", min=1, help="how many cells of each source; 200 for a look, 1000 for a table")] = 200,
    seed: Annotated[int, typer.Option("--seed", min=0, help="the same seed draws the same cells")] = 1,
    source: Annotated[str, typer.Option("--source", help="drawn, mujoco, injected, several of them (drawn,mujoco) or all")] = "drawn",
    recordings: Annotated[
        Path | None, typer.Option("--recordings", help="for injected: folder of X.csv and X.yaml to plant effects into (default: MuJoCo's)")
    ] = None,
    causes: Annotated[
        Path | None, typer.Option("--causes", help="what acts in these recordings (.yaml; default: causes.yaml in that folder)")
    ] = None,
    large: Annotated[int, typer.Option("--large", min=0, help="further drawn cells with one effect of SNR > 20")] = 0,
    unlisted: Annotated[
        int, typer.Option("--unlisted", min=0, help="further cells of each source with an effect outside the list, for the lines on laws")
    ] = 0,
    coarse: Annotated[
        int, typer.Option("--coarse", min=0, help="further cells of each source with steps of 1 to 8 times the noise, 2 of 3 healthy")
    ] = 0,
    json_file: JsonOption = None,
    docs: Annotated[Path | None, typer.Option("--docs", help="write the table and its figures into this folder"), Output(FOLDER)] = None,
    keep: Annotated[
        Path | None, typer.Option("--keep", help="keep recordings, answers and truths in this new folder"), Output(FOLDER)
    ] = None,
    resume: Annotated[
        Path | None, typer.Option("--resume", help="save each scored batch here and continue after the last"), Output(RESUMED)
    ] = None,
    ablation: Annotated[
        str | None, typer.Option("--ablation", help="take a part away: 'no tolerances', 'no press scatter', 'white noise' or 'fz only'")
    ] = None,
    compare: Annotated[list[Path] | None, typer.Option("--compare", help="JSON of an ablation to set beside, in --docs")] = None,
    others: Annotated[
        list[Path] | None, typer.Option("--others", help="JSON of a check of other sources with the same seed, for the same page (--docs)")
    ] = None,
    jobs: Annotated[int, typer.Option("--jobs", min=1, help="processes")] = 2,
    advice: Annotated[bool, typer.Option("--advice", help="instead: the advised next experiment against a random one")] = False,
) -> None:
    """Judge the diagnosis on cells whose truth is sealed: drawn by other physics, diagnosed in another process, then scored."""
    from palpd.blind.check import run
    from palpd.blind.comparison import ablation_named, load_ablations, load_other_sources
    from palpd.blind.figures import PAGE_FILES, write_page
    from palpd.blind.sources import Hosts, sources_named

    if docs is not None:
        check_writable(*(docs / name for name in PAGE_FILES if docs.is_dir()))
    if advice:
        _blind_advice(cases, seed, jobs, json_file)
        return
    chosen, beside = ablation_named(ablation), load_ablations(compare or [], seed)
    hosts = Hosts(recordings, causes)
    sources = sources_named(source, hosts)
    more = load_other_sources(others or [], seed, sources)
    with _progress("blind check", (cases + unlisted + coarse) * len(sources) + large) as advance:
        result = run(
            cases, seed, sources=sources, hosts=hosts, large=large, unlisted=unlisted, coarse=coarse, jobs=jobs, ablation=chosen,
            keep=keep, resume=resume, progress=advance,
        )  # fmt: skip
    _print_blind(result)
    write_json(json_file, result)
    if docs is not None:
        terminal().print(str(write_page(result, docs, beside, more)))


def _print_blind(result: "CheckResult") -> None:
    """Tables of rates, or the cases themselves where they are too few for rates."""
    from palpd.blind.score import cases_as_markdown, tables_as_markdown

    if len(result["outcomes"]) < FEW_CASES:
        terminal().print(cases_as_markdown(result["outcomes"]), soft_wrap=True)
        n = len(result["outcomes"])
        terminal().print(f"{n} case{'s' * (n != 1)} cannot show rates: --cases 200 gives a table of them. --json holds all figures.")
    else:
        terminal().print(tables_as_markdown(result["tables"]), soft_wrap=True)


def _blind_advice(cases: int, seed: int, jobs: int, json_file: Path | None) -> None:
    from palpd.blind.advice import run, sentence

    with _progress("advice", cases) as advance:
        result = run(cases, seed, jobs=jobs, progress=advance)
    terminal().print(sentence(result["table"]))
    write_json(json_file, result)


@contextmanager
def _progress(what: str, total: int) -> Iterator[Callable[[int], None]]:
    """A bar in the terminal; what it gives takes the number that is done."""
    from rich.progress import Progress

    with Progress(console=terminal(), transient=True) as bar:
        task = bar.add_task(what, total=total)
        yield lambda done: bar.update(task, completed=done)
