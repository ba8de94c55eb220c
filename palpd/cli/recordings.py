"""Commands for recordings: replay, export, recover and import them, and make a first cell file of them."""

import json
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Literal

import typer

from palpd.cli import curve_options
from palpd.cli.options import AcceptImplausible, JsonOption, SiteOption, app, terminal
from palpd.cli.output_options import Output, refuse_left_out
from palpd.errors import BadInput
from palpd.file_kinds import CSV, PARQUET, YAML
from palpd.files import write_json, write_yaml

MOST_SETTINGS = 10
"""Most settings that differ which a replay shows; the JSON has all."""


@app.command(examples=["palpd replay run.mcap", "palpd replay run.mcap --config cell/config.yaml"])
def replay(
    recording: Annotated[Path, typer.Argument(help="a recording (.mcap), or a CSV of one site")],
    config: Annotated[Path | None, typer.Option("--config", help="say what this configuration would have done instead")] = None,
    json_file: JsonOption = None,
) -> None:
    """Dry run against a recording: the same code, and for an MCAP the same decisions bit for bit."""
    from palpd.config import load_config
    from palpd.daemon.replay import replay as again
    from palpd.daemon.replay import replay_samples
    from palpd.recording.reader import Recording, holds_ticks
    from palpd.recording.samples import read

    show = terminal().print
    if holds_ticks(recording):
        replayed = again(Recording.load(recording), load_config(config) if config else None)
        same = "identical" if replayed["decisions_identical"] else f"NOT identical: {replayed['first_difference']}"
        if config is not None:
            for setting in [each for each in replayed["changed_settings"] if each["tested"]][:MOST_SETTINGS]:
                show(f"{setting['key']}: {json.dumps(setting['given'])} in place of {json.dumps(setting['recorded'])}")
            if untested := [each["key"] for each in replayed["changed_settings"] if not each["tested"]]:
                more = f" and {len(untested) - MOST_SETTINGS} more" if len(untested) > MOST_SETTINGS else ""
                show(f"A replay does not show what these would have changed: {', '.join(untested[:MOST_SETTINGS])}{more}.")
            for sentence in replayed["sentences"]:
                show(sentence)
        show(f"{replayed['ticks']} ticks, decisions {same}, verdict {replayed['verdict']}.")
        show(f"Peak force {replayed['peak_force_N']:.2f} N; {replayed['realtime_factor']:.0f} × real time.")
        write_json(json_file, replayed)
        return
    judged = replay_samples(read(recording), load_config(config))
    show(f"{judged['ticks']} rows, verdict {judged['verdict']}.")
    for trip in judged["trips"][:10]:
        show(f"  row {trip['row']}, {trip['t_s']:.3f} s: {trip['reason']}")
    show(f"Peak force {judged['peak_force_N']:.2f} N; {judged['realtime_factor']:.0f} × real time.")
    write_json(json_file, judged)


@app.command(examples=["palpd export run.mcap --site A --csv site-A.csv"])
def export(
    recording: Annotated[Path, typer.Argument(help="a recording (.mcap)")],
    csv: Annotated[Path | None, typer.Option("--csv", help="file to write, one row a sensor sample"), Output(CSV)] = None,
    parquet: Annotated[
        Path | None,
        typer.Option("--parquet", help="the same columns as Parquet, with the recording's header; ends in .parquet"),
        Output(PARQUET),
    ] = None,
    site: Annotated[str | None, typer.Option("--site", help="this site only")] = None,
) -> None:
    """Write a recording as CSV or Parquet for `palpd diagnose` and other tools."""
    from palpd.recording.reader import Recording
    from palpd.recording.reader import export as write
    from palpd.recording.samples import is_parquet

    files = [file for file in (csv, parquet) if file is not None]
    if not files:
        raise BadInput("export was given no file to write; give --csv FILE, --parquet FILE, or both")
    if parquet is not None and not is_parquet(parquet):
        raise BadInput(f"--parquet is {parquet}, expected a name that ends in .parquet, by which palpd reads it; rename it")
    if csv is not None and is_parquet(csv):
        raise BadInput(f"--csv is {csv}, which is a name of a Parquet file; give it to --parquet, or rename it")
    whole = Recording.load(recording)
    for file in files:
        samples = write(whole, file, site)
        terminal().print(f"{file}: {len(samples)} rows, {samples.duration_s:.1f} s.")
    if stiffness_N_per_m := whole.header.get("machine_stiffness_N_per_m"):
        terminal().print(
            f"The recording's header states a machine of {stiffness_N_per_m:.6g} N/m, and the rows do not hold it: give palpd analyse "
            f"--machine-stiffness-N-per-m {stiffness_N_per_m:.6g}, or write it into the cell file as robot.compliance.",
            soft_wrap=True,
        )


@app.command(examples=["palpd recover cut-off.part"])
def recover(part: Annotated[Path, typer.Argument(help="FILE.part of a run that was cut off")]) -> None:
    """Make a readable recording of what a crash left behind."""
    from palpd.recording.recovery import recover as restore

    recovered = restore(part)
    terminal().print(f"{recovered.path}: {recovered.sentence}")


@app.command(
    "import",
    examples=[
        "palpd import press.csv",
        "palpd import press.csv --force-column 'Force (mN)' --height-column 'Height (mm)' --time-column 'Time (s)' "
        "--compression-negative --units confirmed --csv recording.csv",
    ],
)
def import_(
    files: Annotated[
        list[Path], typer.Argument(help="a table, bag, TDMS, MATLAB or AFM file; or two, one with the motion and one with the force")
    ],
    csv: Annotated[
        Path | None, typer.Option("--csv", help="recording to write; without it, what the files hold is listed"), Output(CSV)
    ] = None,
    force_column: curve_options.ForceColumn = None,
    force_unit: Annotated[
        Literal["N", "cN", "mN", "uN", "nN", "pN", "kN", "kip", "lbf", "gf", "kgf", "V", "mV", "Nm", "mNm", "Nmm", "Ncm"] | None,
        typer.Option("--force-unit", help="unit of the force, or of the torque of a joint"),
    ] = None,
    depth_column: curve_options.DepthColumn = None,
    height_column: curve_options.HeightColumn = None,
    height_down_positive: curve_options.HeightDownPositive = False,
    length_unit: Annotated[
        Literal["m", "cm", "mm", "um", "nm", "in", "V", "mV", "rad", "mrad", "deg", "rev"] | None,
        typer.Option("--length-unit", help="unit of depth or height, or of the angle of a joint"),
    ] = None,
    compression_negative: curve_options.CompressionNegative = False,
    time_column: Annotated[
        list[str] | None, typer.Option("--time-column", help="name of the column of the time, for all files or once for each")
    ] = None,
    rate_Hz: Annotated[float | None, typer.Option("--rate-Hz", help="rows per second, for a table without times")] = None,
    time_unit: Annotated[Literal["s", "ms", "us", "ns", "min"] | None, typer.Option("--time-unit", help="unit of the time")] = None,
    column: Annotated[
        list[str] | None, typer.Option("--column", help="a further column of the recording, such as fx_N=Fx or vz_m_per_s=Speed")
    ] = None,
    force_N_per_V: Annotated[float | None, typer.Option("--force-N-per-V", help="of the amplifier, for a force in V")] = None,
    length_m_per_V: Annotated[float | None, typer.Option("--length-m-per-V", help="of the amplifier, for a length in V")] = None,
    units: Annotated[Literal["confirmed"] | None, typer.Option("--units", help="apply the units that palpd guesses")] = None,
    wrench: Annotated[str | None, typer.Option("--wrench", help="topic of the force (default: the only one of its type)")] = None,
    pose: Annotated[str | None, typer.Option("--pose", help="topic of the tip's pose; /tf:FRAME for transforms")] = None,
    twist: Annotated[str | None, typer.Option("--twist", help="topic of the tip's speed (default: slope of the heights)")] = None,
    command: Annotated[str | None, typer.Option("--command", help="topic of the commanded pose")] = None,
    wrench_in: Annotated[
        Literal["tool", "base"] | None, typer.Option("--wrench-in", help="axes of the wrench (default: as its frame says)")
    ] = None,
    axis: Annotated[
        Literal["x", "y", "z", "-x", "-y", "-z"] | None, typer.Option("--axis", help="axis of the pose that points out of the tissue")
    ] = None,
    offset_s: Annotated[float | None, typer.Option("--offset-s", help="added to the times of the force, for two clocks")] = None,
    tare_s: Annotated[float | None, typer.Option("--tare-s", help="take the mean of the first seconds from the force")] = None,
    accept_implausible: AcceptImplausible = False,
    joint: Annotated[bool, typer.Option("--joint", help="the columns hold angle (for height) and torque (for force) of one joint")] = False,
) -> None:
    """Turn what another machine recorded into a recording that `palpd diagnose` and `palpd replay` read."""
    values = locals()
    from palpd.interchange.import_files import ImportOptions, columns_given, import_files

    show = terminal().print
    if csv is None:
        others = values.keys() - {"files", "csv"}
        refuse_left_out(import_, values, sorted(others), "without --csv files are only listed", "give --csv too, or leave them out")
        _list_channels(files)
        return
    same = {field.name: values[field.name] for field in fields(ImportOptions) if field.name in values}
    options = ImportOptions(
        time_columns=tuple(time_column or ()), columns=columns_given(column or ()), units_confirmed=units == "confirmed", **same
    )
    imported = import_files(files, options, csv)
    for note in imported.notes:
        show(note)
    show(f"{csv}: {len(imported.samples)} rows, {imported.samples.duration_s:.1f} s.")


def _list_channels(files: list[Path]) -> None:
    from palpd.interchange.import_files import source_of

    for path in files:
        source = source_of(path)
        terminal().print(f"{path} is {source.reader.name}; it holds")
        for channel in source.channels:
            terminal().print(f"  {channel}")


@app.command("cell-from", examples=["palpd cell-from recording.csv --tip-radius-m 0.004 --out cell.yaml"])
def cell_from(
    recordings: Annotated[list[Path], typer.Argument(help="recordings of one cell (.csv, .parquet, .mcap)")],
    out: Annotated[Path, typer.Option("--out", help="cell.yaml to write; every value says where it comes from"), Output(YAML)],
    tip_radius_m: Annotated[float | None, typer.Option("--tip-radius-m", help="radius of the tip (default: 5 mm, a guess)")] = None,
    contact: Annotated[bool, typer.Option("--contact/--no-contact", help="whether the probe touches something in them")] = True,
    site: SiteOption = None,
    accept_implausible: AcceptImplausible = False,
) -> None:
    """Write a first cell.yaml from recordings: rates, noise, resolution, the touch and a stiffness that counts as not known."""
    from palpd.gap.commands import read_recording
    from palpd.gap.first_cell import first_cell, written_out

    names = ", ".join(path.name for path in recordings)
    first = first_cell([read_recording(path, site, learns=True) for path in recordings], tip_radius_m, accept_implausible, contact=contact)
    write_yaml(out, written_out(first, names))
    for sentence in first.sentences:
        terminal().print(sentence)
    terminal().print(f"{out}: read its comments, and correct what you know better.")
