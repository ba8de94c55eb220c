"""Commands that turn recordings into moduli, inertial models and maps."""

from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from palpd.cli import curve_options
from palpd.cli.options import DEFAULT_CONFIG, AcceptImplausible, ConfigOption, HereOption, JsonOption, app, display, finish, terminal
from palpd.cli.output_options import Output, refuse_left_out
from palpd.file_kinds import CSV, MODEL, PICTURE
from palpd.files import check_writable, write_json

if TYPE_CHECKING:
    from palpd.analysis.curves import CurveResult
    from palpd.analysis.enriched import EnrichedResult
    from palpd.analysis.results import LoadingResult
    from palpd.analysis.stiffness_map import Field
    from palpd.daemon.stiffness_survey import Mapped


CURVE = (
    "force_column", "force_unit", "depth_column", "height_column", "height_down_positive", "length_unit", "compression_negative",
    "time_column", "tip_radius_m", "poisson_ratio", "machine_stiffness_N_per_m", "fit", "contact", "baseline",
)  # fmt: skip
"""Options of `palpd analyse` for curves of other machines alone."""


@app.command(examples=["palpd analyse run.mcap --site A", "palpd analyse recording.csv --cell enriched.yaml"], apart={"cell": CURVE})
def analyse(
    file: Annotated[Path, typer.Argument(help="a recording (.mcap), or a curve of another machine as CSV")],
    site: Annotated[str | None, typer.Option("--site", help="this site only (recordings)")] = None,
    force_column: curve_options.ForceColumn = None,
    force_unit: curve_options.ForceUnitOption = None,
    depth_column: curve_options.DepthColumn = None,
    height_column: curve_options.HeightColumn = None,
    height_down_positive: curve_options.HeightDownPositive = False,
    length_unit: curve_options.LengthUnitOption = None,
    compression_negative: curve_options.CompressionNegative = False,
    time_column: curve_options.TimeColumn = None,
    tip_radius_m: Annotated[
        float | None, typer.Option("--tip-radius-m", help="radius of the spherical tip; needed for a foreign curve")
    ] = None,
    poisson_ratio: Annotated[float, typer.Option("--poisson-ratio", help="of the sample")] = 0.5,
    machine_stiffness_N_per_m: Annotated[float | None, typer.Option("--machine-stiffness-N-per-m", help="taken out of the depth")] = None,
    fit: Annotated[Literal["loading", "peak"], typer.Option("--fit", help="the whole loading curve, or its peak")] = "loading",
    contact: Annotated[Literal["free", "zero"], typer.Option("--contact", help="find the point of contact, or take depth 0")] = "free",
    baseline: curve_options.BaselineOption = "auto",
    cell: Annotated[
        Path | None, typer.Option("--cell", help="cell file, as palpd diagnose enriched it: what it knows no longer passes for stiffness")
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Young's modulus with its interval, from a recording of ours or a curve of another machine."""
    values = locals()
    from palpd.cli.printing import say_injected
    from palpd.recording.reader import Recording, holds_ticks, refuse_site

    if cell is not None:
        from palpd.analysis.enriched import analysed
        from palpd.cell.cell_file import load_cell

        enriched = analysed(file, load_cell(cell), site)
        say_injected([file])
        for each in enriched.get("sites", [enriched]):
            _print_modulus(each)
        write_json(json_file, enriched)
    elif holds_ticks(file):
        from palpd.analysis.results import analysed_sites

        refuse_left_out(analyse, values, CURVE, f"{file.name} is a recording of the daemon", "leave it out")
        sites = analysed_sites(Recording.load(file), site)
        say_injected([file])
        for loading in sites:
            terminal().print(f"{loading['name']}: ", end="")
            _print_modulus(loading)
        write_json(json_file, {"sites": sites, **(sites[0] if len(sites) == 1 else {})})
    else:
        from palpd.analysis.curves import OWN, Mapping, analyse_curve, read_curve, refuse_unknown_tip

        refuse_site(file, site)
        values["force_unit"], notes = curve_options.unit_of(force_column or OWN[0], "force", force_unit)
        values["length_unit"], more = curve_options.unit_of(depth_column or height_column or OWN[1], "length", length_unit)
        read = read_curve(file, Mapping(**{field.name: values[field.name] for field in fields(Mapping)}))
        curve_options.refuse_row_of_units(read, values["force_unit"], values["length_unit"])
        curve = analyse_curve(
            read,
            tip_radius_m=refuse_unknown_tip(tip_radius_m),
            poisson_ratio=poisson_ratio,
            machine_stiffness_N_per_m=machine_stiffness_N_per_m,
            fit=fit,
            contact=contact,
            baseline=baseline,
        )
        curve["warnings"] = [*notes, *more, *curve["warnings"]]
        _print_modulus(curve)
        write_json(json_file, curve)


@app.command(examples=["palpd train free.mcap --out cell/inertial.onnx"])
def train(
    runs: Annotated[list[Path], typer.Argument(help="recordings of free motion (.mcap or .csv)")],
    out: Annotated[
        Path, typer.Option("--out", help="model to write (.onnx); its card is written beside it (.json)"), Output(MODEL, beside=(".json",))
    ],
    config: ConfigOption = DEFAULT_CONFIG,
    method: Annotated[
        str, typer.Option("--method", help="linear (b - m a), network (the paper's 2-10-1), prior-network or bias")
    ] = "linear",
    accept_implausible: AcceptImplausible = False,
) -> None:
    """Learn the inertial model from free motion; write it with its card. Which method is best: docs/compensation.md."""
    from palpd.compensation.model_card import refuse_place
    from palpd.compensation.train import train as learn
    from palpd.compensation.training_data import load_training_data
    from palpd.config import load_config

    refuse_place(out)
    settings = load_config(config if config != DEFAULT_CONFIG or config.exists() else None)
    data = load_training_data(runs, settings)
    card = learn(
        data.recordings,
        out,
        probe_mass_kg=settings.cell.probe.mass_kg,
        sensor_serial=data.sensor_serial,
        sensor_delay_s=data.sensor_delay_s,
        method=method,  # type: ignore[arg-type]
        accept_implausible=accept_implausible,
    )
    terminal().print(
        f"{out} and its card: {card.n} points, rmse {card.rmse_N * 1e3:.1f} mN; bias {card.bias_N:+.3f} N, "
        f"inertia {card.inertial_rms_N * 1e3:.1f} mN rms of a moving mass of {card.mass_kg:.3f} kg."
    )


@app.command(
    "map",
    examples=[
        "palpd map --config cell/config.yaml --width-m 0.04 --height-m 0.02 --out map.png",
        "palpd map --presses presses.csv --out map.png",
    ],
    apart={"presses": ("config", "emulated", "most_presses", "seed", "here"), "config": ("emulated", "seed"), "emulated": ("here",)},
)
def map_(
    out: Annotated[
        Path, typer.Option("--out", help="picture to write (.png); the presses are kept beside it (.csv)"), Output(PICTURE)
    ] = Path("map.png"),
    config: Annotated[
        Path | None, typer.Option("--config", help="press with the robot of this config.yaml; where the arm stands is the field's corner")
    ] = None,
    emulated: Annotated[bool, typer.Option("--emulated", help="press with the real daemon on emulated wires")] = False,
    presses: Annotated[
        Path | None,
        typer.Option("--presses", help="CSV with x_m, y_m, youngs_modulus_Pa (_kPa, _MPa): the map of these, and the next press"),
    ] = None,
    width_m: Annotated[float, typer.Option("--width-m", help="of the field", min=0.005, max=0.5)] = 0.06,
    height_m: Annotated[float, typer.Option("--height-m", help="of the field", min=0.005, max=0.5)] = 0.06,
    depth_m: Annotated[float, typer.Option("--depth-m", min=0.001, max=0.02, help="of a press")] = 0.005,
    inclusion_m: Annotated[float, typer.Option("--inclusion-m", min=0.002, max=0.1, help="smallest inclusion not to be missed")] = 0.01,
    most_presses: Annotated[int, typer.Option("--most-presses", min=1, max=1000, help="end after this number all the same")] = 200,
    seed: Annotated[int, typer.Option("--seed", min=0, help="another emulated field")] = 0,
    here: HereOption = False,
    json_file: JsonOption = None,
    accept_implausible: AcceptImplausible = False,
) -> None:
    """Press a field where it pays most until a hard inclusion is found or excluded; draw the map.

    Without --config, --emulated or --presses the daemon presses a simulated field, faster than real time.
    """
    from palpd.analysis import stiffness_map as mapping
    from palpd.analysis.figure_style import refuse_format
    from palpd.daemon.stiffness_survey import Mapped, figures_of, mapped

    where = mapping.Field(width_m=width_m, height_m=height_m, inclusion_m=inclusion_m, depth_m=depth_m)
    refuse_format(out)
    check_writable(None if presses else out.with_suffix(".csv"), kind=CSV)
    if presses is not None:
        pressed = Mapped(mapping.read_presses(presses, where, accept_implausible))
    elif config is not None:
        pressed = _pressed_by_robot(where, config, out, most_presses, here)
    else:
        pressed = mapped(where, out, emulated, seed, display(), most_presses)
    survey, truth, stopped = pressed.survey, pressed.true_inclusion_m, pressed.stop_reason
    result = survey.map()
    mapping.draw(survey, result, out, truth)
    show = terminal().print
    show(f"{result.sentence}.")
    if not result.done:
        show(f"Next press at x = {result.next_m[0] * 1e3:.0f} mm, y = {result.next_m[1] * 1e3:.0f} mm.")
    if truth is not None:
        show(f"The emulated inclusion is {truth[2] * 2e3:g} mm wide at ({truth[0] * 1e3:.1f}, {truth[1] * 1e3:.1f}) mm.")
    show(f"{len(survey.places_m)} presses; a raster of 5 mm has {len(mapping.raster(where))}.")
    show(f"{out}" + (f"; the presses are in {presses or out.with_suffix('.csv')}" if survey.places_m else ""))
    write_json(json_file, figures_of(pressed))
    finish(3 if stopped else 0, stopped)


def _pressed_by_robot(where: "Field", config: Path, out: Path, most_presses: int, here: bool) -> "Mapped":
    """The presses of the robot of that configuration, by the service or in the foreground."""
    from palpd.analysis.stiffness_map import Survey, write_presses
    from palpd.cli.jobs import carried_out
    from palpd.config import load_config
    from palpd.daemon.stiffness_survey import Mapped

    field = {"width_m": where.width_m, "height_m": where.height_m, "depth_m": where.depth_m, "inclusion_m": where.inclusion_m}
    arguments = {**field, "most_presses": most_presses, "here": here}
    end = carried_out("map", arguments, load_config(config), out)
    survey = Survey(where)
    for (x_m, y_m), modulus_Pa in zip(end.figures.get("places_m", []), end.figures.get("moduli_Pa", []), strict=True):
        survey.add((x_m, y_m), modulus_Pa)
    write_presses(out.with_suffix(".csv"), survey)
    return Mapped(survey, stop_reason=end.reason if end.exit_code else "")


def modulus_line(result: "LoadingResult | CurveResult | EnrichedResult") -> str:
    """A modulus that there is in a line: its interval, the model that gave it, its misfit, and where contact begins."""
    value_Pa = result["youngs_modulus_Pa"]
    assert value_Pa is not None
    scale, unit = (1e6, "MPa") if value_Pa >= 1e6 else (1e3, "kPa")
    low, high = result["ci95_Pa"] or (None, None)
    interval = f" (95 %: {low / scale:.3g} to {high / scale:.3g} {unit})" if low is not None and high is not None else ""
    figures: dict[str, Any] = {**result}
    line = f"E = {value_Pa / scale:.3g} {unit}{interval}{', Hertz does not fit' if figures.get('hertz_misfit') else ''}"
    if (depth_m := figures.get("depth_m")) is not None:
        model = "equation 1 at the peak" if figures.get("fit") == "peak" else "Hertz over the loading"
        line += f" by {model}, {depth_m * 1e3:.3g} mm deep"
    if (rms_N := figures.get("rms_N")) is not None:
        peak_N = figures.get("peak_force_N")
        line += f" by the cell file, misfit {rms_N:.2g} N rms" if peak_N is None else f", misfit {rms_N:.2g} N rms of {peak_N:.3g} N"
    return f"{line}, contact at {result['contact_point_m']:.6g} m"


def _print_modulus(result: "LoadingResult | CurveResult | EnrichedResult") -> None:
    """Print a modulus with its interval and notes, or why there is none."""
    show = terminal().print
    if result.get("youngs_modulus_Pa") is None:
        show("no modulus: " + "; ".join(result.get("warnings", ["nothing was pressed"])))
        return
    show(modulus_line(result))
    for warning in result.get("warnings", []):
        show(f"  note: {warning}")
