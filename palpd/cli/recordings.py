"""Commands for recordings: replay, export, recover and import them."""

from pathlib import Path
from typing import Annotated

import typer

from palpd.cli.curve_options import (
    CompressionNegative,
    DepthColumn,
    ForceColumn,
    ForceUnitOption,
    HeightColumn,
    HeightDownPositive,
    LengthUnitOption,
    TimeColumn,
)
from palpd.cli.options import JsonOption, app, terminal
from palpd.files import check_writable, write_json


@app.command()
def replay(
    recording: Annotated[Path, typer.Argument(help="a recording (.mcap), or a CSV of one site")],
    config: Annotated[Path | None, typer.Option("--config", help="judge it by this configuration instead of its own")] = None,
    json_file: JsonOption = None,
) -> None:
    """Dry run against a recording: the same code, and for an MCAP the same decisions bit for bit."""
    from palpd.config import load_config
    from palpd.daemon.replay import replay as again
    from palpd.daemon.replay import replay_samples
    from palpd.recording.reader import Recording, holds_ticks
    from palpd.recording.samples import read

    check_writable(json_file)
    show = terminal().print
    if holds_ticks(recording):
        replayed = again(Recording.load(recording), load_config(config) if config else None)
        same = "identical" if replayed["decisions_identical"] else f"NOT identical: {replayed['first_difference']}"
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


@app.command()
def export(
    recording: Annotated[Path, typer.Argument(help="a recording (.mcap)")],
    csv: Annotated[Path, typer.Option("--csv", help="file to write, one row a sensor sample")],
    site: Annotated[str | None, typer.Option("--site", help="this site only")] = None,
) -> None:
    """Write a recording as CSV for `palpd diagnose` and other tools."""
    from palpd.recording.reader import Recording
    from palpd.recording.reader import export as write

    check_writable(csv, overwrite=False)
    samples = write(Recording.load(recording), csv, site)
    terminal().print(f"{csv}: {len(samples)} rows, {samples.duration_s:.1f} s.")


@app.command()
def recover(part: Annotated[Path, typer.Argument(help="FILE.part of a run that was cut off")]) -> None:
    """Make a readable recording of what a crash left behind."""
    from palpd.recording.reader import recover as restore

    recovered = restore(part)
    terminal().print(f"{recovered.path}: {recovered.sentence}")


@app.command("import")
def import_(
    file: Annotated[Path, typer.Argument(help="a curve of another machine as CSV")],
    csv: Annotated[Path, typer.Option("--csv", help="recording to write")],
    force_column: ForceColumn = None,
    force_unit: ForceUnitOption = "N",
    depth_column: DepthColumn = None,
    height_column: HeightColumn = None,
    height_down_positive: HeightDownPositive = False,
    length_unit: LengthUnitOption = "m",
    compression_negative: CompressionNegative = False,
    time_column: TimeColumn = None,
) -> None:
    """Turn a curve of another machine into a recording that `palpd replay` and `palpd diagnose` read."""
    from palpd.analysis.curves import Mapping, import_curve

    check_writable(csv, overwrite=False)
    mapping = Mapping(
        force_column, force_unit, depth_column, height_column, height_down_positive, length_unit, compression_negative, time_column
    )
    samples = import_curve(file, mapping, csv)
    terminal().print(f"{csv}: {len(samples)} rows, {samples.duration_s:.1f} s.")
