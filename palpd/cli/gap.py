"""Commands for the gap between measurement and simulation: diagnose it, and close it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from palpd.cli.options import (
    DEFAULT_CONFIG,
    AcceptImplausible,
    AdoptedOption,
    CellOption,
    ConfigOption,
    EffectsOption,
    HereOption,
    JsonOption,
    ProgressOption,
    SiteOption,
    adopted_folder,
    app,
    check_kept,
    display,
    finish,
    say_broken_effects,
    say_latch,
    shown_steps,
    terminal,
)
from palpd.cli.output_options import OWN_FOLDER, Output
from palpd.errors import BadInput, RecordingError
from palpd.file_kinds import CSV, HTML, JSON, YAML
from palpd.files import write_json

if TYPE_CHECKING:
    from palpd.config import Config, Plan

DiagnosisOption = Annotated[
    Path | None, typer.Option("--json", help="write the figures to this file too"), Output(JSON, beside=(".next.csv", ".learned.yaml"))
]


@app.command(
    examples=[
        "palpd diagnose recording.csv --cell cell.yaml --report report.html --cell-out enriched.yaml",
        "palpd diagnose --healthy monday.csv tuesday.csv wednesday.csv --now today.csv",
    ]
)
def diagnose(
    recordings: Annotated[
        list[Path] | None, typer.Argument(help="recordings of one cell (.csv, .parquet, .mcap), or a folder of X.csv with X.yaml")
    ] = None,
    cell: Annotated[
        Path | None,
        typer.Option(
            "--cell", help="cell.yaml: what the simulator believes (default: what a .mcap states, E only for its site; not for a folder)"
        ),
    ] = None,
    site: SiteOption = None,
    json_file: DiagnosisOption = None,
    cell_out: Annotated[Path | None, typer.Option("--cell-out", help="write the cell with what was found"), Output(YAML)] = None,
    report: Annotated[Path | None, typer.Option("--report", help="write a report (.html)"), Output(HTML)] = None,
    simulated: Annotated[
        list[Path] | None,
        typer.Option(
            "--simulated", help="your own simulator's output for the recorded motion (.csv), as the nominal; one for each recording"
        ),
    ] = None,
    healthy: Annotated[
        list[Path] | None, typer.Option("--healthy", help="recordings of the cell while it was healthy: only what changed since is judged")
    ] = None,
    now: Annotated[list[Path] | None, typer.Option("--now", help="with --healthy: the recordings to judge")] = None,
    effects: EffectsOption = None,
    adopted: AdoptedOption = True,
    jobs: Annotated[int | None, typer.Option("--jobs", min=1, help="processes, for a folder (default: 1)")] = None,
    scheduler: Annotated[
        str | None, typer.Option("--scheduler", help="for a folder: tcp://… of a Dask cluster (palpd[cluster]), in place of processes")
    ] = None,
    limits: Annotated[
        bool, typer.Option("--limits", help="instead: the smallest size of each effect that the recordings would show")
    ] = False,
    progress: ProgressOption = False,
) -> None:
    """Show where measurement and simulation disagree, which effect causes it, and how far the gap closes."""
    from palpd.cli.printing import say_injected
    from palpd.cli.tables import diagnosis_lines, limits_table
    from palpd.gap.commands import diagnose_files, limits_of_files

    recordings = [*(recordings or []), *(now or [])]
    _refuse_foreign([*recordings, *(healthy or [])])
    say_broken_effects()
    if not recordings:
        raise BadInput(f"no recording is given; name the recordings to judge{' behind --now' if healthy else ''}")
    if now and not healthy:
        raise BadInput("--now is given without --healthy; name the healthy recordings too, or leave --now out")
    if healthy:
        _refuse_with_healthy({"--cell-out": cell_out, "--simulated": simulated or None})
    if len(recordings) == 1 and recordings[0].is_dir():
        beside = {"--cell": cell, "--site": site, "--cell-out": cell_out, "--report": report, "--simulated": simulated or None}
        _refuse_for_a_folder(recordings[0], beside | {"--limits": limits or None, "--healthy": healthy or None})
        _diagnose_fleet(recordings[0], jobs or 1, scheduler, effects, adopted_folder(adopted), json_file)
        return
    if jobs is not None or scheduler is not None:
        raise BadInput(f"{'--jobs' if jobs is not None else '--scheduler'} is for a folder of recordings; give the folder, or leave it out")
    if limits:
        _refuse_with_limits({"--cell-out": cell_out, "--report": report, "--json": json_file})
    with shown_steps("diagnosing", progress) as show:
        try:
            if limits:
                shown = limits_of_files(
                    recordings,
                    cell,
                    effects=effects,
                    adopted=adopted_folder(adopted),
                    site=site,
                    simulated=simulated or (),
                    healthy=healthy or (),
                )
                terminal().print(limits_table(shown.sizes), shown.not_judged, sep="\n")
                return
            diagnosis = diagnose_files(
                recordings,
                cell,
                json_out=json_file,
                cell_out=cell_out,
                effects=effects,
                adopted=adopted_folder(adopted),
                site=site,
                simulated=simulated or (),
                healthy=healthy or (),
                show=show,
            )
        except RecordingError as error:
            raise _with_import_command(error, recordings) from error
    say_injected(recordings)
    for line in diagnosis_lines(diagnosis.to_json()):
        terminal().print(line)
    if report is not None:
        from palpd.gap.report.page import write as write_report

        write_report(report, diagnosis, ", ".join(path.name for path in recordings))


def _refuse_for_a_folder(folder: Path, options: Mapping[str, object]) -> None:
    """Refuse the options that are for one recording: nothing that was asked for is left out without a word."""
    if given := _given(options, "is", "are"):
        raise BadInput(f"{folder} is a folder, and {given} for one recording; name the recording, or the folder alone")


def _refuse_with_limits(options: Mapping[str, object]) -> None:
    """Refuse the options that belong to an answer: limits are only printed, and a diagnosis states them in its outputs."""
    if given := _given(options, "belongs", "belong"):
        raise BadInput(f"--limits prints a table, and {given} to a diagnosis, which states the limits too; leave one out")


def _refuse_with_healthy(options: Mapping[str, object]) -> None:
    """Refuse the options for which the cell file is the nominal."""
    if given := _given(options, "compares", "compare"):
        raise BadInput(f"--healthy compares with the healthy recordings, and {given} with a cell file; leave one out")


def _given(options: Mapping[str, object], verb: str, plural: str) -> str:
    """Names of the options that have a value, with the verb; empty where none has."""
    names = [name for name, value in options.items() if value is not None]
    return f"{' and '.join(names)} {verb if len(names) == 1 else plural}" if names else ""


def _refuse_foreign(recordings: Sequence[Path]) -> None:
    """Refuse bags and files of instruments, and name the command that reads them."""
    from palpd.interchange.foreign import import_command, is_foreign

    for path in recordings:
        if is_foreign(path) and (command := import_command(path)) is not None:
            raise RecordingError(f"{path.name} is no recording yet; this command makes one of it: {command}")


def _with_import_command(error: RecordingError, recordings: Sequence[Path]) -> RecordingError:
    """A refusal, with the command that makes a recording of the first table that has other columns."""
    from palpd.interchange.foreign import import_command

    for path in recordings:
        if path.name in str(error) and (command := import_command(path)) is not None:
            return RecordingError(f"{str(error).rstrip('.')}; {command} makes a recording of it")
    return error


def _diagnose_fleet(
    folder: Path, jobs: int, scheduler: str | None, effects: Path | None, adopted: Path | None, json_file: Path | None
) -> None:
    from rich.progress import track

    from palpd.cli.tables import fleet_table, recordings_table
    from palpd.gap.commands import library
    from palpd.gap.fleet import by_cell, diagnose_folder, recordings_in
    from palpd.gap.notes import adopted_sentence

    known = library(effects, adopted=adopted)
    diagnoses = diagnose_folder(folder, jobs=jobs, scheduler=scheduler, effects=effects, adopted=adopted)
    rows = list(track(diagnoses, "diagnosing", len(recordings_in(folder)), console=terminal(), transient=True))
    cells = by_cell(rows)
    terminal().print(recordings_table(rows))
    if len(cells) < len(rows):
        terminal().print(fleet_table(cells))
    if adopted is not None and (weighed := adopted_sentence(adopted, known)):
        terminal().print(weighed, soft_wrap=True)
    write_json(json_file, {"recordings": [asdict(row) for row in rows], "cells": [asdict(cell) for cell in cells]})


@app.command(examples=["palpd resolve --config cell/config.yaml --rounds 2"], apart={"recordings": ("plan",)})
def resolve(
    config: ConfigOption = DEFAULT_CONFIG,
    recordings: Annotated[
        list[Path] | None, typer.Option("--recording", help="what is there already of this cell (.csv); without it a first one is made")
    ] = None,
    cell: Annotated[Path | None, typer.Option("--cell", help="cell.yaml: what the simulator believes (default: cell: of --config)")] = None,
    plan: Annotated[Path | None, typer.Option("--plan", help="plan of the first recording, one site (default: 40 s of presses)")] = None,
    rounds: Annotated[int, typer.Option("--rounds", min=1, max=20, help="most recordings that are made")] = 4,
    yes: Annotated[bool, typer.Option("--yes", help="do not ask before a motion; the guard stands all the same")] = False,
    max_depth_m: Annotated[
        float | None, typer.Option("--max-depth-m", min=0.0002, max=0.02, help="how deep a proposal may press (default: as before)")
    ] = None,
    take_reference: Annotated[bool, typer.Option("--take-reference", help="take the reference tare now instead of the kept one")] = False,
    here: HereOption = False,
    effects: EffectsOption = None,
    adopted: AdoptedOption = True,
    folder: Annotated[
        Path | None, typer.Option("--out", help="where everything is kept (default: runs/resolve-<time>)"), Output(OWN_FOLDER)
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Diagnose a running cell, propose the motion that decides what is open, run it within the guard, until nothing more is gained."""
    values = locals()
    from palpd.cell.cell_file import load_cell
    from palpd.config import load_config, load_plan
    from palpd.daemon import resolve as loop
    from palpd.daemon.job_client import service_at
    from palpd.daemon.session import ForegroundHost, kept_in
    from palpd.daemon.wiring import devices
    from palpd.gap.commands import library
    from palpd.gap.notes import adopted_sentence

    say_broken_effects()
    settings = load_config(config)
    first_plan = load_plan(plan) if plan else loop.STANDARD

    def agree(question: str) -> bool:
        return yes or typer.confirm(question)

    if service_at(settings.paths.control_socket):
        _resolve_by_service(settings, values, first_plan, agree)
        return
    check_kept(settings)
    say_latch(settings)
    own = adopted_folder(adopted)
    known = library(effects, adopted=own)
    if own is not None and (weighed := adopted_sentence(own, known)):
        terminal().print(weighed, soft_wrap=True)
    kept = kept_in(folder or settings.paths.runs, "resolve" if folder is None else None)
    nominal = load_cell(cell, known) if cell else settings.cell.assumed_at_site(first_plan.sites[0].name)
    host = ForegroundHost(settings, devices, display(), agree)
    host.display.say(f"This makes at most {rounds} run{'s' * (rounds != 1)}.")
    setting = loop.Setting(host, nominal, kept, known, max_depth_m, take_reference, here)
    result = loop.resolve(setting, first_plan, recordings or (), rounds)
    terminal().print(f"Everything is kept in {kept}; the page is gap.html.")
    write_json(json_file, result)
    finish(3 if result["verdict"] == "stopped" else 0, result["reason"])


def _resolve_by_service(settings: "Config", values: Mapping[str, Any], plan: "Plan", agree: Callable[[str], bool]) -> None:
    """Let the service carry it out, and bring what it kept into a folder, if one is named.

    Args:
        values: Values of the parameters of `resolve`.
        plan: Plan of the first recording.

    Raises:
        BadInput: Effects of one's own are given.
    """
    from palpd.cli.jobs import carried_out, fetch
    from palpd.daemon.session import kept_in
    from palpd.documents import read_yaml

    if values["effects"] is not None:
        raise BadInput("--effects may be code, and the service runs none of yours; leave it out, or stop the service first")
    target = kept_in(values["folder"]) if values["folder"] is not None else None
    arguments = {
        "plan": plan.model_dump(mode="json"),
        "cell": read_yaml(values["cell"]).keys_and_values() if values["cell"] else None,
        "recordings": [str(path.absolute()) for path in values["recordings"] or ()],
        **{name: values[name] for name in ("rounds", "max_depth_m", "take_reference", "adopted", "here")},
    }
    end = carried_out("resolve", arguments, settings, settings.paths.runs, agree)
    stands = fetch(end.figures.get("folder"), target) if target is not None else end.figures.get("folder")
    terminal().print(f"Everything is kept in {stands}; the page is gap.html.")
    write_json(values["json_file"], end.figures)
    finish(end.exit_code, end.reason)


@app.command(examples=["palpd simulate recording.csv --cell enriched.yaml --csv predicted.csv"])
def simulate(
    motion: Annotated[Path, typer.Argument(help="t_s and z_m or z_cmd_m (.csv)")],
    cell: CellOption,
    csv: Annotated[Path, typer.Option("--csv", help="recording to write"), Output(CSV)],
    source: Annotated[Literal["measured", "commanded"], typer.Option("--from", help="what drives it where both are there")] = "measured",
    noise: Annotated[int | None, typer.Option("--noise", min=0, help="seed: add noise and rounding")] = None,
    simulated: Annotated[
        Path | None,
        typer.Option("--simulated", help="your own simulator's output for this motion (.csv): add what the cell has beyond --nominal"),
    ] = None,
    nominal: Annotated[Path | None, typer.Option("--nominal", help="cell.yaml that your simulator simulates, with --simulated")] = None,
    effects: EffectsOption = None,
    adopted: AdoptedOption = True,
    accept_implausible: AcceptImplausible = False,
) -> None:
    """What a cell, enriched or nominal, gives on any motion."""
    from palpd.gap.commands import simulate_file

    say_broken_effects()
    samples = simulate_file(
        motion,
        cell,
        csv,
        from_commanded=source == "commanded",
        noise_seed=noise,
        effects=effects,
        adopted=adopted_folder(adopted),
        say=terminal().print,
        simulated=simulated,
        nominal=nominal,
        accept_implausible=accept_implausible,
    )
    terminal().print(f"{csv}: {len(samples)} rows, {samples.duration_s:.1f} s.")


@app.command(
    "export-sim",
    examples=[
        "palpd export-sim enriched.yaml --to fmu --out enriched-fmu",
        "palpd export-sim enriched.yaml --to mujoco --out enriched-mujoco",
    ],
)
def export_sim(
    cell: Annotated[Path, typer.Argument(help="cell.yaml, enriched or not")],
    to: Annotated[Literal["mujoco", "fmu"], typer.Option("--to", help="the simulator (both need palpd[sim])")],
    out: Annotated[Path, typer.Option("--out", help="folder to write"), Output(OWN_FOLDER)],
    randomise: Annotated[
        int | None,
        typer.Option("--randomise", help="draw this many cells from what the diagnosis left open, too"),
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", min=0, help="seed of the draws (default: 0)")] = None,
    site: Annotated[str | None, typer.Option("--site", help="this site of a cell with several")] = None,
    effects: EffectsOption = None,
    adopted: AdoptedOption = True,
) -> None:
    """Write a cell for another simulator: a MuJoCo model or an FMU, checked against palpd's own simulation, with a README."""
    from palpd.cell.cell_file import load_cell
    from palpd.cell.draws import drawn_cells
    from palpd.gap.commands import library
    from palpd.interchange.simulators.export import check_target, export_cell

    if seed is not None and randomise is None:
        raise BadInput("--seed is for draws, and none were asked for; give --randomise too, or leave --seed out")
    check_target(to, out)
    known = library(effects, adopted=adopted_folder(adopted))
    exported = load_cell(cell, known)
    draws = [] if randomise is None else drawn_cells(exported, randomise, seed or 0)
    with terminal().status("exporting"):
        written = export_cell(exported, to, out, draws=draws, library=known, site=site)
    also = f" with {written.draws} drawn cells" if written.draws else ""
    terminal().print(
        f"{out}: the cell for {to}{also}. Its rollout of motion.csv differs from palpd simulate by {written.agreement.worst:.1e} times the "
        f"noise ({written.agreement.channel}). README.md in it says how to run it.",
    )


@app.command(examples=["palpd tolerances healthy-1.csv healthy-2.csv --cell cell.yaml"])
def tolerances(
    recordings: Annotated[list[Path], typer.Argument(help="recordings of a healthy cell")],
    cell: CellOption,
    json_file: JsonOption = None,
    accept_implausible: AcceptImplausible = False,
) -> None:
    """Estimate the tolerances block of a cell file from recordings of a healthy cell."""
    import yaml

    from palpd.gap.commands import tolerances_of

    blocks = tolerances_of(recordings, cell, accept_implausible)
    terminal().print(yaml.safe_dump(blocks, sort_keys=False))
    write_json(json_file, blocks)


@app.command(
    "effects",
    examples=["palpd effects", "palpd effects tissue.thickness --cell cell.yaml"],
    apart={
        "adopt": ("names", "remove", "effects", "adopted"),
        "remove": ("names", "effects", "adopted", "name", "cell", "json_file", "accept_implausible"),
        "names": ("name", "accept_implausible"),
    },
)
def effects_(
    names: Annotated[
        list[str] | None, typer.Argument(help="effects to compare with the library (default: those given with --effects)")
    ] = None,
    effects: EffectsOption = None,
    adopted: AdoptedOption = True,
    adopt: Annotated[Path | None, typer.Option("--adopt", help="let the law of this file (out.learned.yaml) join your library")] = None,
    name: Annotated[str | None, typer.Option("--name", help="with --adopt: its name, such as learned.stiff_foam")] = None,
    remove: Annotated[str | None, typer.Option("--remove", help="take this adopted effect out of your library")] = None,
    cell: Annotated[Path | None, typer.Option("--cell", help="cell.yaml that they are compared on (default: the nominal cell)")] = None,
    json_file: JsonOption = None,
    accept_implausible: AcceptImplausible = False,
) -> None:
    """List the effects that a cell can have; for some, or your own, what they could be mistaken for, before anything is recorded."""
    from palpd.cell.cell_file import load_cell, nominal
    from palpd.cell.effects import user_effects
    from palpd.cell.effects.adopted import user_folder
    from palpd.cli.tables import adopted_table, effect_table, similarity_table
    from palpd.gap import adoption
    from palpd.gap.commands import effects_named, library
    from palpd.gap.similar_effects import similar_effects

    if (name is not None or accept_implausible) and adopt is None:
        raise BadInput("--name and --accept-implausible belong to --adopt, which is not given; give it, or leave them out")
    folder = user_folder()
    if adopt is not None:
        with terminal().status("adopting"):
            written = adoption.adopt(adopt, folder, name, load_cell(cell) if cell else nominal(), accept_implausible)
        terminal().print(f"{written.law.id} is adopted ({written.path}). {written.sentence}", soft_wrap=True)
        write_json(json_file, written.to_json())
        return
    if remove is not None:
        terminal().print(f"{remove} is removed ({adoption.remove(remove, folder)}).", soft_wrap=True)
        return
    say_broken_effects()
    known = library(effects, adopted=folder if adopted else None)
    laws = adoption.load_adopted(folder) if adopted else {}
    compared = effects_named(names, known) if names else user_effects(library(effects))
    if not names:
        terminal().print(effect_table({name: effect for name, effect in known.items() if name not in laws}))
        if laws:
            terminal().print(adopted_table(laws, folder))
    for effect in compared if names else ():
        terminal().print(f"{effect.id}: {effect.what}. {effect.formula}")
    content: dict[str, object] = {"effects": [adoption.described(effect, laws, folder) for effect in known.values()]}
    if compared:
        with terminal().status("comparing"):
            similar = similar_effects(compared, load_cell(cell, known) if cell else nominal(), known)
        terminal().print(similarity_table(similar))
        content["confounds"] = [asdict(each) for each in similar]
    write_json(json_file, content)
