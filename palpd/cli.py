"""The command line. Exit codes: 0 done, 2 bad input or refused (one sentence on stderr), 3 stopped by the guard or a fault."""

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.console import Console

from palpd.errors import BadInput, PalpdError

app = typer.Typer(
    help="Press soft tissue with a UR5 and a HEX-70, say how stiff it is, and why a cell does not behave like its simulation.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)
console = Console()

ConfigOption = Annotated[Path, typer.Option("--config", help="config.yaml of the cell")]
PlanOption = Annotated[Path, typer.Option("--plan", help="plan.yaml: where, how deep, how often")]
JsonOption = Annotated[Path | None, typer.Option("--json", help="write the figures to this file too")]
SocketOption = Annotated[Path | None, typer.Option("--socket", help="control socket of the daemon (default: the one of --config)")]
DEFAULT_CONFIG = Path("config.yaml")


def main() -> None:
    """Entry point: errors become one sentence and an exit code, never a traceback."""
    try:
        app()
    except PalpdError as error:
        print(f"palpd: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        sys.exit(130)


# --- the cell -----------------------------------------------------------------------------------------------------------------


@app.command()
def run(
    config: ConfigOption = DEFAULT_CONFIG,
    plan: PlanOption = Path("plan.yaml"),
    dry: Annotated[bool, typer.Option("--dry", help="read the real devices, command nothing")] = False,
    take_reference: Annotated[bool, typer.Option("--take-reference", help="take the reference tare now instead of the kept one")] = False,
    json_file: JsonOption = None,
) -> None:
    """Carry out a plan in the foreground and end with it."""
    from palpd.config import load_config, load_plan
    from palpd.session import carry_out, findings, job
    from palpd.wiring import devices

    settings = load_config(config)
    _writable(json_file)
    _clear_latch(settings)
    report = carry_out(job("palpation", settings, load_plan(plan), dry, take_reference), devices, console)
    found = findings(report)
    _tell_run(found)
    _write_json(json_file, found)
    _exit(report.exit_code, report.reason)


@app.command()
def calibrate(
    config: ConfigOption = DEFAULT_CONFIG,
    temperature_C: Annotated[float | None, typer.Option("--temperature-C", help="of the sensor, if known; kept with the tare")] = None,
) -> None:
    """Take the reference tare: probe free, arm still. Every run's absolute force limit is measured against it."""
    from palpd.config import load_config
    from palpd.session import calibrate as take
    from palpd.wiring import devices

    settings = load_config(config)
    calibration = take(settings, devices, console, temperature_C)
    forces = ", ".join(f"{force:.2f}" for force in calibration.wrench[:3])
    console.print(f"Reference tare ({forces}) N of sensor {calibration.sensor_serial or 'unknown'} kept in {settings.paths.state}.")


@app.command("free-motion")
def free_motion(
    out: Annotated[Path, typer.Option("--out", help="recording to write (.mcap)")],
    config: ConfigOption = DEFAULT_CONFIG,
    take_reference: Annotated[bool, typer.Option("--take-reference", help="take the reference tare now")] = False,
) -> None:
    """Move 2 cm up and down ten times in free air and record it; `palpd train` learns from it."""
    from palpd.config import Plan, load_config
    from palpd.session import carry_out, job
    from palpd.wiring import devices

    settings = load_config(config)
    target = out.with_suffix(".mcap")
    if target.exists():
        raise BadInput(f"{target} exists and is not overwritten; choose another name or move it away")
    _clear_latch(settings)
    settings = settings.model_copy(update={"paths": settings.paths.model_copy(update={"runs": target.resolve().parent})})
    report = carry_out(job("free_motion", settings, Plan(), take_reference=take_reference), devices, console, target.stem)
    console.print(f"{report.verdict}: {report.recording}")
    _exit(report.exit_code, report.reason)


@app.command()
def stiffness(config: ConfigOption = DEFAULT_CONFIG, json_file: JsonOption = None) -> None:
    """Press a rigid plate and keep how far sensor and arm give way; every depth is corrected by it afterwards."""
    from palpd.config import Plan, load_config
    from palpd.record import Recording
    from palpd.results import machine_stiffness
    from palpd.session import carry_out, job
    from palpd.state import MachineStiffness, State
    from palpd.supervisor import now
    from palpd.wiring import devices

    settings = load_config(config)
    _clear_latch(settings)
    report = carry_out(job("stiffness", settings, Plan()), devices, console)
    if report.exit_code or report.recording is None:
        _exit(report.exit_code or 3, report.reason)
        return
    value, interval = machine_stiffness(Recording.load(report.recording).rows)
    State(settings.paths.state).keep("stiffness", MachineStiffness(value, interval, now(), report.about.get("sensor_serial")))
    console.print(f"The machine gives way by 1 mm per {value / 1e3:.1f} N (95 %: {interval[0] / 1e3:.1f} to {interval[1] / 1e3:.1f}).")
    _write_json(json_file, {"stiffness_N_per_m": value, "ci95_N_per_m": interval, "recording": str(report.recording)})


@app.command()
def train(
    runs: Annotated[list[Path], typer.Argument(help="recordings of free motion (.mcap or .csv)")],
    out: Annotated[Path, typer.Option("--out", help="model to write (.onnx); its card is written beside it (.json)")],
    config: ConfigOption = DEFAULT_CONFIG,
    method: Annotated[
        str, typer.Option("--method", help="linear (b - m a), network (the paper's 2-10-1), prior-network or bias")
    ] = "linear",
) -> None:
    """Learn the inertial model from free motion; write it with its card. Which method is best: docs/compensation.md."""
    from palpd.config import filter_delay_s, load_config
    from palpd.record import Recording, samples_of
    from palpd.samples import read
    from palpd.train import refuse_other_probe
    from palpd.train import train as learn

    settings = load_config(config if config.exists() else None)
    recordings, serials, delay_s = [], set(), filter_delay_s(settings.sensor.filter_cutoff_Hz)
    for path in runs:
        if path.suffix == ".mcap":
            recording = Recording.load(path)
            recordings.append(samples_of(recording))
            serials.add(recording.header["about"].get("sensor_serial"))
            refuse_other_probe(recording, settings.cell.probe.mass_kg)
            delay_s = recording.header["about"]["delay_s"]
        else:
            recordings.append(read(path))
    if len(serials) > 1:
        raise BadInput(
            f"the recordings come from different sensors ({', '.join(map(str, sorted(serials, key=str)))}); train on one sensor's"
        )
    card = learn(
        recordings,
        out,
        probe_mass_kg=settings.cell.probe.mass_kg,
        sensor_serial=next(iter(serials), None),
        sensor_delay_s=delay_s,
        method=method,  # type: ignore[arg-type]
    )
    console.print(
        f"{out} and its card: {card.n} points, rmse {card.rmse_N * 1e3:.1f} mN; bias {card.bias_N:+.3f} N, "
        f"inertia {card.inertial_rms_N * 1e3:.1f} mN rms of a moving mass of {card.mass_kg:.3f} kg."
    )


@app.command()
def demo(
    full: Annotated[bool, typer.Option("--full", help="the paper's plan: 3 to 10 mm, 10 s holds, ten presses a depth")] = False,
    effect: Annotated[
        str | None, typer.Option("--effect", help="effect id, cell file or effect of yours (.py): give it to the emulated cell and find it")
    ] = None,
    json_file: JsonOption = None,
    folder: Annotated[Path | None, typer.Option("--out", help="where recordings, model and report go (default: runs/demo-<time>)")] = None,
) -> None:
    """The whole job on emulated wires: calibrate, learn the inertia, palpate four sites, say how stiff each is."""
    from palpd import demo as show

    _writable(json_file)
    found = show.gap(effect, folder, console) if effect else show.palpate(full, folder, console)
    _write_json(json_file, found)
    _exit(0 if found["verdict"] == "done" else 3, found.get("reason", ""))


@app.command()
def sim(
    plan: PlanOption = Path("plan.yaml"),
    config: ConfigOption = DEFAULT_CONFIG,
    cell: Annotated[Path | None, typer.Option("--cell", help="cell.yaml to press (default: the paper's phantom)")] = None,
    seed: Annotated[int, typer.Option("--seed", help="of the noise")] = 0,
    json_file: JsonOption = None,
) -> None:
    """Carry out a plan on the cell's physics, without wires and faster than real time."""
    from palpd import results
    from palpd.cell_file import PHANTOM, load_cell
    from palpd.config import load_config, load_plan, refuse_unsafe
    from palpd.motion import Job
    from palpd.sim import run as simulate

    settings, wanted = load_config(config), load_plan(plan)
    refuse_unsafe(settings, wanted)
    _writable(json_file)
    done = simulate(Job("palpation", settings, wanted), load_cell(cell) if cell else PHANTOM, seed=seed)
    found = {
        "verdict": done.outcome.verdict,
        "reason": done.outcome.reason,
        "sites": results.sites(done.rows, done.header),
        "loop": {"ticks": done.outcome.ticks, "missed": done.outcome.missed},
        "model_card": done.header["model_card"],
        "recording": None,
        "notes": ["the cell was simulated without wires: bytes, timing and faults were not part of it"],
    }
    _tell_run(found)
    _write_json(json_file, found)
    _exit(0 if done.outcome.verdict == "done" else 3, done.outcome.reason)


@app.command()
def study(
    out: Annotated[Path, typer.Option("--out", help="folder for study.html and study.json")] = Path("study"),
    seed: Annotated[int, typer.Option("--seed", help="another laboratory: noise, tares, biases")] = 0,
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
    from palpd import study as studying
    from palpd.cell_file import load_cell
    from palpd.record import Recording
    from palpd.study_report import figures_of, means, write

    _writable(json_file)
    of_recordings = bool(bare or free or palpation or cell)
    if published:
        if of_recordings:
            raise BadInput("--published is about the paper's printed numbers alone; leave out --bare, --free, --palpation and --cell")
        _published_gap(json_file)
        return
    if of_recordings:
        if not free or palpation is None:
            raise BadInput("a study of recordings needs both --free and --palpation; without any recording the emulated cell is studied")
        pairs = [each.partition("=") for each in cell or []]
        if wrong := [site for site, equals, _ in pairs if not equals]:
            raise BadInput(f"--cell {wrong[0]} names no site; expected SITE=FILE")
        enriched = {site: load_cell(Path(file)) for site, _, file in pairs}
        runs = [[Recording.load(path) for path in paths] for paths in (bare or [], free)]
        found = studying.study_of(studying.recorded(runs[0], runs[1], Recording.load(palpation), enriched))
    else:
        console.print("The emulated cell is studied: diagnosing four setups takes most of the time, some minutes in all.")
        found = studying.study(seed, days)
    page, _ = write(found, out)
    for name, (mean, half, n) in means(found).items():
        console.print(f"YMBT {100 * mean:5.1f} %" + (f" ± {100 * half:.1f}" if n > 1 else "") + f"  {name}")
    console.print(f"{page}")
    _write_json(json_file, figures_of(found))


def _published_gap(json_file: Path | None) -> None:
    from palpd import study_paper
    from palpd.report import published_table

    found = study_paper.published()
    console.print(published_table(found))
    console.print(found["sentence"], highlight=False)
    _write_json(json_file, found)


@app.command("map")
def map_(
    out: Annotated[Path, typer.Option("--out", help="picture to write (.png); the presses are kept beside it (.csv)")] = Path("map.png"),
    config: Annotated[
        Path | None, typer.Option("--config", help="press with the robot of this config.yaml; where the arm stands is the field's corner")
    ] = None,
    emulated: Annotated[bool, typer.Option("--emulated", help="press with the real daemon on emulated wires")] = False,
    presses: Annotated[
        Path | None, typer.Option("--presses", help="CSV with x_m, y_m, youngs_modulus_Pa: the map of these, and where to press next")
    ] = None,
    width_m: Annotated[float, typer.Option("--width-m", min=0.005, max=0.5)] = 0.06,
    height_m: Annotated[float, typer.Option("--height-m", min=0.005, max=0.5)] = 0.06,
    depth_m: Annotated[float, typer.Option("--depth-m", min=0.001, max=0.02, help="of a press")] = 0.005,
    inclusion_m: Annotated[float, typer.Option("--inclusion-m", min=0.002, max=0.1, help="smallest inclusion not to be missed")] = 0.01,
    seed: Annotated[int, typer.Option("--seed", help="another emulated field")] = 0,
    json_file: JsonOption = None,
) -> None:
    """Press a field where it pays most until a hard inclusion is found or excluded; draw the map.

    Without --config, --emulated or --presses the daemon presses a simulated field, faster than real time.
    """
    from palpd import mapping
    from palpd.mapping_robot import mapped

    where = mapping.Field(width_m=width_m, height_m=height_m, inclusion_m=inclusion_m, depth_m=depth_m)
    for path in (json_file, out):
        _writable(path)
    if presses is not None and (config is not None or emulated):
        raise BadInput("--presses draws presses that were made; leave it out to make new ones with --config or --emulated")
    stopped, truth = None, None
    if presses is not None:
        survey = mapping.read_presses(presses, where)
    else:
        survey, truth, stopped = mapped(where, out, config, emulated, seed, console)
    found = survey.map()
    mapping.draw(survey, found, out, truth)
    console.print(f"{found.sentence}.")
    if not found.done:
        console.print(f"Next press at x = {found.next_m[0] * 1e3:.0f} mm, y = {found.next_m[1] * 1e3:.0f} mm.")
    if truth is not None:
        console.print(f"The emulated inclusion is {truth[2] * 2e3:g} mm wide at ({truth[0] * 1e3:.1f}, {truth[1] * 1e3:.1f}) mm.")
    console.print(f"{len(survey.places_m)} presses; a raster of 5 mm has {len(mapping.raster(where))}.")
    console.print(f"{out}" + (f"; the presses are in {presses or out.with_suffix('.csv')}" if survey.places_m else ""))
    told: dict[str, Any] = {"presses": len(survey.places_m), "done": found.done, "found_m": found.found_m, "next_m": found.next_m}
    told |= {"background_Pa": found.background_Pa, "sentence": found.sentence, "true_inclusion_m": truth}
    _write_json(json_file, {**told, "verdict": "stopped" if stopped else "done", "reason": stopped or ""})
    _exit(3 if stopped else 0, stopped or "")


@app.command()
def emulate(
    model: Annotated[Literal["ur5", "ur5e"], typer.Option("--model", help="ur5: CB3, 125 Hz; ur5e: e-Series, 500 Hz")] = "ur5",
    cell: Annotated[Path | None, typer.Option("--cell", help="cell.yaml of what the wires lead to (default: the paper's phantom)")] = None,
    host: Annotated[str, typer.Option("--host", help="address the controller listens on")] = "127.0.0.1",
    sensor_link: Annotated[Path | None, typer.Option("--sensor-link", help="link to make to the sensor's terminal device")] = None,
    control: Annotated[Path | None, typer.Option("--control", help="unix socket for faults and truth (docs/emulators.md)")] = None,
    effects: Annotated[Path | None, typer.Option("--effects", help="a Python file with effects that the cell file names")] = None,
) -> None:
    """Stand in for a UR controller and a HEX-70 until stopped; prints both addresses when ready."""
    from hw.emulators.process import emulate as stand_in

    stand_in(model, cell, host, sensor_link, control, effects=effects)


# --- the service --------------------------------------------------------------------------------------------------------------


@app.command()
def serve(config: ConfigOption = DEFAULT_CONFIG) -> None:
    """Run the daemon: connect, wait disarmed, obey the control socket."""
    from palpd.config import load_config
    from palpd.logs import configure
    from palpd.service import Service
    from palpd.wiring import devices

    configure()
    Service(load_config(config), devices).serve()


def _speak(request: dict[str, Any], config: Path, socket: Path | None) -> dict[str, Any]:
    from palpd.config import load_config
    from palpd.control import ARM_PATIENCE_S, PATIENCE_S, ask

    patience_s = ARM_PATIENCE_S if request["do"] == "arm" else PATIENCE_S
    return ask(socket or load_config(config).paths.control_socket, request, patience_s)


@app.command()
def status(config: ConfigOption = DEFAULT_CONFIG, socket: SocketOption = None, json_file: JsonOption = None) -> None:
    """What the daemon is doing."""
    answer = _speak({"do": "status"}, config, socket)
    for key, value in answer.items():
        if key != "ok" and value is not None:
            console.print(f"{key:>8}: {value}")
    _write_json(json_file, answer)


@app.command()
def arm(config: ConfigOption = DEFAULT_CONFIG, socket: SocketOption = None) -> None:
    """Check the real devices, which takes some seconds, and let the daemon move at the next start."""
    console.print(_speak({"do": "arm"}, config, socket)["state"])


@app.command()
def start(
    plan: Annotated[Path, typer.Argument(help="plan.yaml")], config: ConfigOption = DEFAULT_CONFIG, socket: SocketOption = None
) -> None:
    """Start a plan on an armed daemon."""
    from palpd.config import load_plan

    values = load_plan(plan).model_dump(mode="json")
    console.print(_speak({"do": "start", "plan": values}, config, socket)["state"])


@app.command()
def doctor(
    config: ConfigOption = DEFAULT_CONFIG,
    weight_N: Annotated[float | None, typer.Option("--weight-N", min=0.5, max=100, help="known weight to hang on the probe")] = None,
    watch_s: Annotated[float, typer.Option("--watch-s", min=1, max=600, help="how long the devices are watched")] = 10.0,
    json_file: JsonOption = None,
) -> None:
    """Judge clock, privileges, disk and devices, and say what to do; reads, and moves nothing."""
    from palpd import doctor as examine
    from palpd.config import load_config
    from palpd.wiring import open_reader, open_sensor

    _writable(json_file)
    settings = load_config(config if config.exists() else None)

    def ask(what: str) -> None:
        console.input(f"{what} Then press Enter. ")

    findings = examine.examined(settings, open_sensor, open_reader, watch_s, weight_N, ask)
    console.print(examine.table(findings))
    failed = [finding for finding in findings if finding.verdict == "fail"]
    _write_json(json_file, examine.as_json(findings))
    _exit(2 if failed else 0, f"{len(failed)} of {len(findings)} checks failed: {', '.join(finding.name for finding in failed)}")


@app.command()
def install(
    prefix: Annotated[Path, typer.Option("--prefix", help="folder that stands for / (a package's build root)")] = Path("/"),
) -> None:
    """Put the service's unit, user, device rule and configuration into place; an existing configuration is kept."""
    from palpd.install import NEXT_STEPS, installed

    for path in installed(prefix):
        console.print(path, soft_wrap=True)
    console.print(NEXT_STEPS, soft_wrap=True)


@app.command()
def pause(config: ConfigOption = DEFAULT_CONFIG, socket: SocketOption = None) -> None:
    """Hold the arm where it is; `palpd resume` goes on."""
    console.print(_speak({"do": "pause"}, config, socket)["state"])


@app.command()
def resume(config: ConfigOption = DEFAULT_CONFIG, socket: SocketOption = None) -> None:
    """Go on after a pause."""
    console.print(_speak({"do": "resume"}, config, socket)["state"])


@app.command()
def abort(config: ConfigOption = DEFAULT_CONFIG, socket: SocketOption = None) -> None:
    """Stop the arm and end the plan. A convenience, not an emergency stop."""
    console.print(_speak({"do": "abort"}, config, socket)["state"])


@app.command()
def clear(config: ConfigOption = DEFAULT_CONFIG, socket: SocketOption = None) -> None:
    """Clear the latch of the last stop, after looking at the cell."""
    console.print(_speak({"do": "clear"}, config, socket)["state"])


# --- recordings ---------------------------------------------------------------------------------------------------------------


@app.command()
def replay(
    recording: Annotated[Path, typer.Argument(help="a recording (.mcap), or a CSV of one site")],
    config: Annotated[Path | None, typer.Option("--config", help="judge it by this configuration instead of its own")] = None,
    json_file: JsonOption = None,
) -> None:
    """Dry run against a recording: the same code, and for an MCAP the same decisions bit for bit."""
    from palpd.config import load_config
    from palpd.record import Recording
    from palpd.replay import replay as again
    from palpd.replay import replay_samples
    from palpd.samples import read

    _writable(json_file)
    if recording.suffix in (".mcap", ".part"):
        found = again(Recording.load(recording), load_config(config) if config else None)
        same = "identical" if found["decisions_identical"] else f"NOT identical: {found['first_difference']}"
        console.print(f"{found['ticks']} ticks, decisions {same}, verdict {found['verdict']}.")
    else:
        found = replay_samples(read(recording), load_config(config))
        console.print(f"{found['ticks']} rows, verdict {found['verdict']}.")
        for trip in found["trips"][:10]:
            console.print(f"  row {trip['row']}, {trip['t_s']:.3f} s: {trip['reason']}")
    console.print(f"Peak force {found['peak_force_N']:.2f} N; {found['realtime_factor']:.0f} × real time.")
    _write_json(json_file, found)


@app.command()
def export(
    recording: Annotated[Path, typer.Argument(help="a recording (.mcap)")],
    csv: Annotated[Path, typer.Option("--csv", help="file to write, one row a sensor sample")],
    site: Annotated[str | None, typer.Option("--site", help="this site only")] = None,
) -> None:
    """Write a recording as CSV for `palpd diagnose` and other tools."""
    from palpd.record import Recording
    from palpd.record import export as write

    samples = write(Recording.load(recording), csv, site)
    console.print(f"{csv}: {len(samples)} rows, {samples.duration_s:.1f} s.")


@app.command()
def recover(part: Annotated[Path, typer.Argument(help="FILE.part of a run that was cut off")]) -> None:
    """Make a readable recording of what a crash left behind."""
    from palpd.record import recover as restore

    recovered = restore(part)
    console.print(f"{recovered.path}: {recovered.ticks} ticks, {recovered.duration_s:.1f} s restored.")


@app.command()
def analyse(
    file: Annotated[Path, typer.Argument(help="a recording (.mcap), or a curve of another machine as CSV")],
    site: Annotated[str | None, typer.Option("--site", help="this site only (recordings)")] = None,
    force_column: Annotated[str | None, typer.Option("--force-column")] = None,
    force_unit: Annotated[Literal["N", "mN", "uN", "nN"], typer.Option("--force-unit")] = "N",
    depth_column: Annotated[str | None, typer.Option("--depth-column", help="grows as the tip goes in")] = None,
    height_column: Annotated[str | None, typer.Option("--height-column", help="falls as the tip goes down")] = None,
    height_down_positive: Annotated[bool, typer.Option("--height-down-positive", help="the height column grows downwards")] = False,
    length_unit: Annotated[Literal["m", "mm", "um", "nm"], typer.Option("--length-unit")] = "m",
    compression_negative: Annotated[bool, typer.Option("--compression-negative", help="pressed is a negative force")] = False,
    time_column: Annotated[str | None, typer.Option("--time-column")] = None,
    tip_radius_m: Annotated[float | None, typer.Option("--tip-radius-m")] = None,
    poisson_ratio: Annotated[float, typer.Option("--poisson-ratio")] = 0.5,
    machine_stiffness: Annotated[float | None, typer.Option("--machine-stiffness-N-per-m", help="taken out of the depth")] = None,
    fit: Annotated[Literal["loading", "peak"], typer.Option("--fit")] = "loading",
    contact: Annotated[Literal["free", "zero"], typer.Option("--contact")] = "free",
    baseline: Annotated[
        Literal["auto", "free", "zero"], typer.Option("--baseline", help="force before contact; auto: zero for a corrected column")
    ] = "auto",
    cell: Annotated[
        Path | None, typer.Option("--cell", help="cell file, as palpd diagnose enriched it: what it knows no longer passes for stiffness")
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Young's modulus with its interval, from a recording of ours or a curve of another machine."""
    _writable(json_file)
    if cell is not None:
        from palpd.cell_file import load_cell
        from palpd.enriched import analysed

        found = analysed(file, load_cell(cell), site)
        for each in found.get("sites", [found]):
            _tell_curve(each)
    elif file.suffix == ".mcap":
        found = _analyse_recording(file, site)
    else:
        from palpd.curves import analyse_curve, read_curve

        mapping = _mapping(
            force_column, force_unit, depth_column, height_column, height_down_positive, length_unit, compression_negative, time_column
        )
        if tip_radius_m is None:
            raise BadInput("--tip-radius-m is missing: a curve says nothing of the tip that made it; give its radius in metres")
        found = analyse_curve(
            read_curve(file, mapping),
            tip_radius_m=tip_radius_m,
            poisson_ratio=poisson_ratio,
            machine_stiffness_N_per_m=machine_stiffness,
            fit=fit,
            contact=contact,
            baseline=baseline,
        )
        _tell_curve(found)
    _write_json(json_file, found)


@app.command("import")
def import_(
    file: Annotated[Path, typer.Argument(help="a curve of another machine as CSV")],
    csv: Annotated[Path, typer.Option("--csv", help="recording to write")],
    force_column: Annotated[str | None, typer.Option("--force-column")] = None,
    force_unit: Annotated[Literal["N", "mN", "uN", "nN"], typer.Option("--force-unit")] = "N",
    depth_column: Annotated[str | None, typer.Option("--depth-column")] = None,
    height_column: Annotated[str | None, typer.Option("--height-column")] = None,
    height_down_positive: Annotated[bool, typer.Option("--height-down-positive")] = False,
    length_unit: Annotated[Literal["m", "mm", "um", "nm"], typer.Option("--length-unit")] = "m",
    compression_negative: Annotated[bool, typer.Option("--compression-negative")] = False,
    time_column: Annotated[str | None, typer.Option("--time-column")] = None,
) -> None:
    """Turn a curve of another machine into a recording that `palpd replay` and `palpd diagnose` read."""
    from palpd.curves import import_curve

    mapping = _mapping(
        force_column, force_unit, depth_column, height_column, height_down_positive, length_unit, compression_negative, time_column
    )
    samples = import_curve(file, mapping, csv)
    console.print(f"{csv}: {len(samples)} rows, {samples.duration_s:.1f} s.")


@app.command("check-config")
def check_config(
    config: Annotated[Path, typer.Argument(help="config.yaml")],
    plan: Annotated[Path | None, typer.Option("--plan", help="plan.yaml to judge with it")] = None,
    json_file: JsonOption = None,
) -> None:
    """Refuse what is wrong or unsafe; print how far a force would run past its limit."""
    from palpd.config import Plan, load_config, load_plan, refuse_unsafe
    from palpd.overshoot import predicted, refuse_overload
    from palpd.report import overshoot_table

    settings = load_config(config)
    wanted = load_plan(plan) if plan else Plan()
    refuse_unsafe(settings, wanted)
    refuse_overload(settings, wanted)
    found = predicted(settings, wanted)
    for table in overshoot_table(found):
        console.print(table)
    console.print(f"{config} is sound." if plan is None else f"{config} and {plan} are sound.")
    _write_json(json_file, found)


# --- the sim-to-real gap ------------------------------------------------------------------------------------------------------

CellOption = Annotated[Path, typer.Option("--cell", help="cell.yaml: what the simulator believes of the cell")]
EffectsOption = Annotated[Path | None, typer.Option("--effects", help="a Python file with effects of your own (docs/examples)")]


@app.command()
def diagnose(
    recordings: Annotated[list[Path], typer.Argument(help="recordings of one cell (.csv, .parquet), or a folder of X.csv with X.yaml")],
    cell: Annotated[Path | None, typer.Option("--cell", help="cell.yaml: what the simulator believes (not for a folder)")] = None,
    json_file: JsonOption = None,
    cell_out: Annotated[Path | None, typer.Option("--cell-out", help="write the cell with what was found")] = None,
    report: Annotated[Path | None, typer.Option("--report", help="write a report (.html)")] = None,
    effects: EffectsOption = None,
    jobs: Annotated[int, typer.Option("--jobs", min=1, help="processes, for a folder")] = 1,
    scheduler: Annotated[
        str | None, typer.Option("--scheduler", help="for a folder: tcp://… of a Dask cluster (palpd[cluster]), in place of processes")
    ] = None,
) -> None:
    """Say where measurement and simulation part, which effect causes it, and how far the gap closes."""
    from palpd.gap.commands import diagnose_files
    from palpd.gap.report import write as write_report
    from palpd.report import diagnosis_lines

    for path in (json_file, cell_out, report):
        _writable(path)
    if len(recordings) == 1 and recordings[0].is_dir():
        _diagnose_fleet(recordings[0], jobs, scheduler, effects, json_file)
        return
    if cell is None:
        raise BadInput("--cell is missing: a gap is a gap to what a simulator believes; give the cell.yaml that describes the cell")
    with console.status("diagnosing"):
        found = diagnose_files(recordings, cell, json_out=json_file, cell_out=cell_out, effects=effects)
    if report is not None:
        write_report(report, found, ", ".join(path.name for path in recordings))
    for line in diagnosis_lines(found.sentence, found.to_json()):
        console.print(line, highlight=False)


def _diagnose_fleet(folder: Path, jobs: int, scheduler: str | None, effects: Path | None, json_file: Path | None) -> None:
    from rich.progress import track

    from palpd.gap.fleet import by_cell, diagnose_folder, recordings_in
    from palpd.report import fleet_table, recordings_table

    doing = diagnose_folder(folder, jobs=jobs, scheduler=scheduler, effects=effects)
    rows = list(track(doing, "diagnosing", len(recordings_in(folder)), console=console, transient=True))
    cells = by_cell(rows)
    console.print(recordings_table(rows))
    if len(cells) < len(rows):
        console.print(fleet_table(cells))
    _write_json(json_file, {"recordings": [asdict(row) for row in rows], "cells": [asdict(cell) for cell in cells]})


@app.command()
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
    effects: EffectsOption = None,
    folder: Annotated[Path | None, typer.Option("--out", help="where everything is kept (default: runs/resolve-<time>)")] = None,
    json_file: JsonOption = None,
) -> None:
    """Diagnose a running cell, propose the motion that decides what is open, run it within the guard, until nothing more is gained."""
    from palpd import resolve as loop
    from palpd.cell_file import load_cell
    from palpd.config import load_config, load_plan
    from palpd.gap.commands import library
    from palpd.session import kept_in
    from palpd.wiring import devices

    settings = load_config(config)
    _writable(json_file)
    _clear_latch(settings)
    known = library(effects)
    kept = kept_in(folder or settings.paths.runs, "resolve" if folder is None else None)
    settings = settings.model_copy(update={"paths": settings.paths.model_copy(update={"runs": kept})})
    nominal = load_cell(cell, known) if cell else settings.cell
    setting = loop.Setting(
        settings, devices, nominal, kept, console, lambda what: yes or typer.confirm(what), known, max_depth_m, take_reference
    )
    found = loop.resolve(setting, load_plan(plan) if plan else loop.STANDARD, recordings or (), rounds)
    console.print(f"Everything is kept in {kept}; the page is gap.html.", highlight=False)
    _write_json(json_file, found)
    _exit(3 if found["verdict"] == "stopped" else 0, found["reason"])


@app.command()
def simulate(
    motion: Annotated[Path, typer.Argument(help="t_s and z_m or z_cmd_m (.csv)")],
    cell: CellOption,
    csv: Annotated[Path, typer.Option("--csv", help="recording to write")],
    source: Annotated[Literal["measured", "commanded"], typer.Option("--from", help="what drives it where both are there")] = "measured",
    noise: Annotated[int | None, typer.Option("--noise", help="seed: add noise and rounding")] = None,
    effects: EffectsOption = None,
) -> None:
    """What a cell, enriched or nominal, gives on any motion."""
    from palpd.gap.commands import simulate_file

    samples = simulate_file(motion, cell, csv, from_commanded=source == "commanded", noise_seed=noise, effects=effects)
    console.print(f"{csv}: {len(samples)} rows, {samples.duration_s:.1f} s.")


@app.command()
def tolerances(
    recordings: Annotated[list[Path], typer.Argument(help="recordings of a healthy cell")], cell: CellOption, json_file: JsonOption = None
) -> None:
    """Estimate the tolerances block of a cell file from recordings of a healthy cell."""
    import yaml

    from palpd.gap.commands import tolerances_of

    found = tolerances_of(recordings, cell)
    console.print(yaml.safe_dump(found, sort_keys=False))
    _write_json(json_file, found)


@app.command("effects")
def effects_(
    names: Annotated[list[str] | None, typer.Argument(help="effects whose likes are wanted (default: those of --effects)")] = None,
    effects: EffectsOption = None,
    cell: Annotated[Path | None, typer.Option("--cell", help="cell.yaml that they are compared on (default: the nominal cell)")] = None,
    json_file: JsonOption = None,
) -> None:
    """List the effects that a cell can have; for some, or your own, what they could be mistaken for, before anything is recorded."""
    from palpd.cell_file import load_cell, nominal
    from palpd.effects import own_effects
    from palpd.gap.commands import library
    from palpd.gap.confounds import confounds
    from palpd.report import confound_table, effect_table

    known = library(effects)
    if unknown := [name for name in names or [] if name not in known]:
        raise BadInput(f"there is no effect {unknown[0]!r}; expected one of {', '.join(known)}")
    wanted = [known[name] for name in names] if names else own_effects(known)
    if not names:
        console.print(effect_table(known))
    if wanted:
        with console.status("comparing"):
            found = confounds(wanted, load_cell(cell, known) if cell else nominal(), known)
        console.print(confound_table(found))
        _write_json(json_file, {"confounds": [asdict(like) for like in found]})


@app.command()
def blind(
    cases: Annotated[int, typer.Option("--cases", min=1, help="how many cells to draw; 200 for a look, 1000 for a table")] = 200,
    seed: Annotated[int, typer.Option("--seed", help="the same seed draws the same cells")] = 1,
    json_file: JsonOption = None,
    docs: Annotated[Path | None, typer.Option("--docs", help="write the table and its figures into this folder")] = None,
    keep: Annotated[Path | None, typer.Option("--keep", help="keep recordings, answers and truths in this new folder")] = None,
    ablation: Annotated[
        str | None, typer.Option("--ablation", help="take a part away: 'no tolerances', 'no press scatter', 'white noise' or 'fz only'")
    ] = None,
    compare: Annotated[list[Path] | None, typer.Option("--compare", help="JSON of an ablation to set beside, in --docs")] = None,
    jobs: Annotated[int, typer.Option("--jobs", min=1, help="processes")] = 2,
    advice: Annotated[bool, typer.Option("--advice", help="instead: the advised next experiment against a random one")] = False,
) -> None:
    """Judge the diagnosis on cells whose truth is sealed: drawn by other physics, diagnosed in another process, then scored."""
    from rich.progress import Progress

    from palpd.gap.blind import ABLATIONS, run
    from palpd.gap.blind_figures import load, write_page
    from palpd.gap.blind_score import as_markdown

    _writable(json_file)
    if advice:
        _blind_advice(cases, seed, jobs, json_file)
        return
    chosen = next((a for a in ABLATIONS if a == ablation), None)
    if ablation is not None and chosen is None:
        raise BadInput(f"--ablation is {ablation!r}; expected one of {', '.join(ABLATIONS)}")
    beside = [load(path) for path in compare or []]
    if other := [each["seed"] for each in beside if each["seed"] != seed]:
        raise BadInput(f"--compare names a check of seed {other[0]}, expected {seed}: only the same cells can be compared")
    if any(each["ablation"] is None for each in beside):
        raise BadInput("--compare names a check from which nothing was taken away; give the JSON of one with --ablation")
    with Progress(console=console, transient=True) as bar:
        task = bar.add_task("blind check", total=cases)
        result = run(cases, seed, jobs=jobs, ablation=chosen, keep=keep, progress=lambda done: bar.update(task, completed=done))
    console.print(as_markdown(result["table"]), soft_wrap=True)
    _write_json(json_file, result)
    if docs is not None:
        console.print(str(write_page(result, docs, beside)))


def _blind_advice(cases: int, seed: int, jobs: int, json_file: Path | None) -> None:
    from rich.progress import Progress

    from palpd.gap.blind_advice import run, sentence

    with Progress(console=console, transient=True) as bar:
        task = bar.add_task("advice", total=cases)
        result = run(cases, seed, jobs=jobs, progress=lambda done: bar.update(task, completed=done))
    console.print(sentence(result["table"]), highlight=False)
    _write_json(json_file, result)


# --- shared -------------------------------------------------------------------------------------------------------------------


def _mapping(
    force_column: str | None,
    force_unit: Literal["N", "mN", "uN", "nN"],
    depth_column: str | None,
    height_column: str | None,
    height_down_positive: bool,
    length_unit: Literal["m", "mm", "um", "nm"],
    compression_negative: bool,
    time_column: str | None,
) -> Any:
    from palpd.curves import Mapping

    return Mapping(
        force_column=force_column,
        force_unit=force_unit,
        depth_column=depth_column,
        height_column=height_column,
        height_down_positive=height_down_positive,
        length_unit=length_unit,
        compression_negative=compression_negative,
        time_column=time_column,
    )


def _analyse_recording(file: Path, site: str | None) -> dict[str, Any]:
    from palpd import results
    from palpd.record import Recording

    recording = Recording.load(file)
    if site is not None:
        recording.site_index(site)
    found = results.analysed(recording.rows, recording.header)
    found = [each for each in found if site in (None, each["name"])]
    for each in found:
        console.print(f"{each['name']}: ", end="")
        _tell_curve(each)
    return {"sites": found, **(found[0] if len(found) == 1 else {})}


def _tell_curve(found: dict[str, Any]) -> None:
    if found.get("youngs_modulus_Pa") is None:
        console.print("no modulus: " + "; ".join(found.get("warnings", ["nothing was pressed"])))
        return
    low, high = found["ci95_Pa"] or (None, None)
    interval = f" (95 %: {low:.6g} to {high:.6g} Pa)" if low is not None and high is not None else ""
    console.print(f"E = {found['youngs_modulus_Pa']:.6g} Pa{interval}, contact at {found['contact_point_m']:.6g} m")
    for warning in found.get("warnings", []):
        console.print(f"  note: {warning}")


def _tell_run(found: dict[str, Any]) -> None:
    from palpd.report import depth_table, site_tables

    card = found.get("model_card")
    if found["sites"]:
        console.print(depth_table(found["sites"]))
        console.print(*site_tables(found["sites"], card["bias_N"] if card else None), sep="\n")
        console.print("Inertial model: " + (f"{card['rmse_N'] * 1e3:.0f} mN rmse" if card else "none, nothing was corrected") + ".")
    for note in found["notes"]:
        console.print(f"[yellow]note:[/] {note}")
    console.print(f"{found['verdict']}: {found['recording'] or 'nothing was recorded'}")


def _clear_latch(settings: Any) -> None:
    """Whoever starts a run in the foreground is the operator who may clear the latch; what it was is shown."""
    from palpd.state import State

    state = State(settings.paths.state)
    latch = state.latch()
    if latch is not None:
        console.print(f"[yellow]The last run was stopped on {latch.date}: {latch.reason}. This start clears it.[/]")
        state.clear_latch()


def _writable(path: Path | None) -> None:
    if path is not None and not path.parent.is_dir():
        raise BadInput(f"{path.parent} is no folder, so {path.name} cannot be written there; make it first")


def _write_json(path: Path | None, found: dict[str, Any]) -> None:
    if path is not None:
        _writable(path)
        path.write_text(json.dumps(found, indent=1, default=str) + "\n")


def _exit(code: int, reason: str) -> None:
    if code:
        print(f"palpd: {reason}", file=sys.stderr)
        raise typer.Exit(code)
