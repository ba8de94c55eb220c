"""Commands for looking back: which runs there are, what one was, and its page."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from palpd.cli.options import DEFAULT_CONFIG, ConfigOption, JsonOption, ProgressOption, app, settings_of, shown_steps, terminal
from palpd.cli.output_options import Output
from palpd.errors import BadInput
from palpd.file_kinds import COURSE, HTML, PICTURE
from palpd.files import check_writable, write_json

if TYPE_CHECKING:
    from rich.table import Table

    from palpd.history.catalogue import Catalogue, RunFilter

MOST_COLUMNS = 1000
"""Widest table: a row has a reason of 60 letters and moduli of as many sites as a plan has."""
MOST_UNBROKEN = 12
"""Letters of a word in a narrow table up to which it is not broken; names and figures never are."""
FolderOption = Annotated[Path | None, typer.Option("--folder", help="folder of the runs (default: paths.runs of --config)")]
RunArgument = Annotated[str, typer.Argument(metavar="RUN", help="a recording (.mcap), a name that palpd runs shows, or: last")]


LISTING = ("since", "until", "site", "verdict", "kind", "tagged", "text", "most", "trend", "rebuild", "json_file")
"""Options of `palpd runs` that list; with runs to tag they would not count."""


@app.command(
    examples=["palpd runs --folder runs", "palpd runs last --folder runs --tag good"], apart={"chosen": LISTING, "trend": ("most",)}
)
def runs(
    chosen: Annotated[
        list[str] | None, typer.Argument(metavar="[RUN]...", help="runs to tag or to note something of: paths, names, or: last")
    ] = None,
    tag: Annotated[list[str] | None, typer.Option("--tag", help="add this tag to each RUN")] = None,
    untag: Annotated[list[str] | None, typer.Option("--untag", help="take this tag from each RUN")] = None,
    note: Annotated[str, typer.Option("--note", help="add this note to each RUN")] = "",
    since: Annotated[str, typer.Option("--since", help="list runs from this day on, such as 2026-11-22 (local time here)")] = "",
    until: Annotated[str, typer.Option("--until", help="list runs up to this day, with it")] = "",
    site: Annotated[str, typer.Option("--site", help="list runs that have this site")] = "",
    verdict: Annotated[str, typer.Option("--verdict", help="list runs that ended so: done, stopped, unreadable, …")] = "",
    kind: Annotated[
        str, typer.Option("--kind", help="list runs of this kind: palpation, injection, free_motion, stiffness, retract, level_test")
    ] = "",
    tagged: Annotated[list[str] | None, typer.Option("--tagged", help="list runs with this tag (several: with all of them)")] = None,
    text: Annotated[str, typer.Option("--text", help="list runs with this in name, reason, notes, tags, sites or devices")] = "",
    most: Annotated[int, typer.Option("--most", min=1, help="list this many, the newest")] = 30,
    trend: Annotated[
        str | None, typer.Option("--trend", metavar="SITE", help="how this site's moduli and effects change over the days")
    ] = None,
    rebuild: Annotated[bool, typer.Option("--rebuild", help="make the catalogue anew from the recordings")] = False,
    progress: ProgressOption = False,
    folder: FolderOption = None,
    config: ConfigOption = DEFAULT_CONFIG,
    json_file: JsonOption = None,
) -> None:
    """List the runs, newest first; tag them, note something of them, or show a trend. No recording is changed or deleted."""
    from palpd.history.catalogue import Catalogue, RunFilter
    from palpd.history.dates import days_s

    place = _folder(folder, config)
    if chosen or tag or untag or note:
        _remark(chosen or [], tag or [], untag or [], note, place)
        return
    only = RunFilter(*days_s(since, until), site=site, verdict=verdict, kind=kind, tags=tuple(tagged or ()), text=text)
    with Catalogue(place) as catalogue:
        _brought_up_to_date(catalogue, rebuild, progress)
        if trend is not None:
            _print_trend(catalogue, trend, only, json_file)
        else:
            _print_runs(catalogue, only, most, place, json_file)
        for sentence in catalogue.notes:
            _say(f"note: {sentence}")


@app.command(examples=["palpd info last --folder runs", "palpd info run.mcap"])
def info(
    run: RunArgument,
    course: Annotated[
        Path | None, typer.Option("--course", help="write force and height over time too, thinned, as an array (.npy)"), Output(COURSE)
    ] = None,
    folder: FolderOption = None,
    config: ConfigOption = DEFAULT_CONFIG,
    json_file: JsonOption = None,
) -> None:
    """Show what a run was: conditions, verdict and reason, sites and moduli, health of the loop, faults, files."""
    from palpd.cli.history_tables import info_lines, moduli_table
    from palpd.history.course import course_of, write_course
    from palpd.history.facts import load
    from palpd.history.remarks import remarks_of
    from palpd.history.report import fault_sentences, headline, mood, report_conditions
    from palpd.history.stored import recording_meant

    path = recording_meant(run, _folder(folder, config))
    recording, facts = load(path)
    if course is not None:
        write_course(course, course_of(path))
    remarks = remarks_of(path)
    before, after = info_lines(recording, facts, remarks)
    for line in before:
        _say(line)
    if facts["sites"]:
        _show(moduli_table(facts["sites"]))
    for line in after:
        _say(line)
    words = {
        "remarks": remarks.model_dump(mode="json"),
        "mood": mood(facts),
        "headline": headline(facts),
        "faults": fault_sentences(facts),
        "conditions": report_conditions(recording, facts),
    }
    write_json(json_file, {**facts, **words})


@app.command(examples=["palpd report run.mcap", "palpd report last --folder runs --pdf run.pdf"])
def report(
    run: RunArgument,
    beside: Annotated[str | None, typer.Option("--beside", metavar="OTHER", help="a run to compare it with: path, name, or: last")] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="page to write (default: RUN.report.html beside the recording)"), Output(HTML)
    ] = None,
    pdf: Annotated[Path | None, typer.Option("--pdf", help="write one printed page too (.pdf)"), Output(PICTURE)] = None,
    png: Annotated[Path | None, typer.Option("--png", help="write the same as a picture (.png)"), Output(PICTURE)] = None,
    folder: FolderOption = None,
    config: ConfigOption = DEFAULT_CONFIG,
) -> None:
    """Write the page of a run: one file without links to others. Each run writes its own when it is over."""
    from palpd.history.report import refuse_ending, report_of, save_sheet, site_history, write_report
    from palpd.history.stored import comparison_path, recording_meant, report_path

    place = _folder(folder, config)
    path = recording_meant(run, place)
    other = None if beside is None else recording_meant(beside, place)
    page = out or (report_path(path) if other is None else comparison_path(path, other))
    for sheet, ending in ((pdf, ".pdf"), (png, ".png")):
        refuse_ending(sheet, ending)
    if out is None:
        check_writable(page, kind=HTML)
    content = report_of(path, other, site_history(path, place))
    write_report(page, content)
    for file in filter(None, (pdf, png)):
        save_sheet(file, content)
    for file in filter(None, (page, pdf, png)):
        _say(str(file))


def _folder(folder: Path | None, config: Path) -> Path:
    """The folder of the runs; without a config.yaml the one that a new one would name."""
    return folder if folder is not None else settings_of(config, optional=True).paths.runs


def _say(line: str) -> None:
    """Print a line as it is: what files hold is neither markup nor a command to the terminal."""
    from palpd.history.stored import printable

    terminal().print(printable(line), soft_wrap=True)


def _show(table: "Table") -> None:
    """Print a table with a line for each row in a pipe; in a narrow terminal its lines run on: a broken name cannot be copied."""
    console = terminal()
    for column in table.columns:
        cells = [str(column.header), *map(str, column.cells)]
        column.min_width = max(map(len, cells)) if column.no_wrap else min(max(map(len, " ".join(cells).split())), MOST_UNBROKEN)
    width = table.__rich_measure__(console, console.options.update(max_width=MOST_COLUMNS))
    table.width = max(width.minimum, min(width.maximum, console.width)) if console.is_terminal else width.maximum
    console.print(table, crop=False)


def _remark(chosen: list[str], tag: list[str], untag: list[str], note: str, place: Path) -> None:
    from palpd.history.dates import now
    from palpd.history.remarks import refuse_remarks, remark
    from palpd.history.stored import recording_meant

    if not chosen:
        raise BadInput("no RUN is given to tag or to note something of; give its name, or list tagged runs with --tagged")
    if not (tag or untag or note):
        raise BadInput("nothing is given to do with these runs; give --tag, --untag or --note, or look at one with palpd info")
    refuse_remarks(tag, untag, note)
    for path in [recording_meant(run, place) for run in chosen]:
        remarks = remark(path, now(), tag, untag, note)
        _say(f"{path}: tags {', '.join(remarks.tags) or 'none'}; {len(remarks.notes)} {'note' if len(remarks.notes) == 1 else 'notes'}")


def _brought_up_to_date(catalogue: "Catalogue", rebuild: bool, progress: bool) -> None:
    """Read what the catalogue does not know yet, with a line of progress on a terminal."""
    from palpd.history.stored import printable

    with shown_steps("looking for new recordings", progress) as show:
        read = (catalogue.rebuild if rebuild else catalogue.refresh)(
            lambda read, total, name: show(f"reading recording {read + 1} of {total}: {printable(name)}")
        )
    if rebuild:
        _say(f"{catalogue.path}: made anew from {read} recordings.")


def _print_runs(catalogue: "Catalogue", only: "RunFilter", most: int, place: Path, json_file: Path | None) -> None:
    from palpd.cli.history_tables import runs_table
    from palpd.history.catalogue import as_json
    from palpd.history.stored import MOST_NAMED, unfinished_recordings

    entries, count = catalogue.runs(replace(only, most=most)), catalogue.count(only)
    if entries:
        _show(runs_table(entries))
    else:
        _say(f"No run in {place} is like that.")
    if count > most:
        _say(f"{count - most} older runs are not shown; --most {count} shows all.")
    cut_off = unfinished_recordings(place)
    newest = sorted(cut_off, reverse=True)[:MOST_NAMED]
    if newest:
        more = f" and {len(cut_off) - len(newest)} more" * (len(cut_off) > len(newest))
        _say(f"Cut off, and not in this list: {', '.join(newest)}{more}; palpd recover {cut_off[newest[0]]} restores the first.")
    words = {"folder": str(place), "count": count, "unfinished": sorted(cut_off, reverse=True)}
    write_json(json_file, words | {"runs": as_json(entries), "notes": catalogue.notes})


def _print_trend(catalogue: "Catalogue", site: str, only: "RunFilter", json_file: Path | None) -> None:
    from palpd.cli.history_tables import effect_trend_table, modulus_trend_table, slope_lines
    from palpd.history.trend import site_trend, trend_as_json

    points, slopes, effects = site_trend(catalogue, site, only)
    if points:
        _show(modulus_trend_table(points, site))
    if effects:
        _show(effect_trend_table(effects))
    for line in slope_lines(slopes):
        _say(line)
    content = trend_as_json(site, points, slopes, effects)
    for note in content["notes"]:
        _say(f"note: {note}")
    write_json(json_file, content | {"notes": [*catalogue.notes, *content["notes"]]})
