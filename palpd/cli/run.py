"""Commands for whoever stands at the cell: run a plan, calibrate, or do it all on an emulated or simulated cell."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from palpd.cli.last_ticks import print_last_ticks
from palpd.cli.options import (
    DEFAULT_CONFIG,
    DEFAULT_PLAN,
    ConfigOption,
    HereOption,
    JsonOption,
    PlanOption,
    ProgressOption,
    ReturnOption,
    SocketOption,
    app,
    check_kept,
    display,
    finish,
    place_choice,
    say_latch,
    settings_of,
    shown_steps,
    stated_address,
    terminal,
)
from palpd.cli.output_options import LINK, NEW_RECORDING, OWN_FOLDER, SOCKET, Output
from palpd.files import check_folder, with_ending, write_json

if TYPE_CHECKING:
    from palpd.daemon.programs import ProgramEnd


@app.command(
    examples=[
        "palpd run --config cell/config.yaml --plan cell/plan.yaml --dry",
        "palpd run --config cell/config.yaml --plan cell/plan.yaml",
    ],
    apart={"dry": ("here", "go_back")},
)
def run(
    config: ConfigOption = DEFAULT_CONFIG,
    plan: PlanOption = DEFAULT_PLAN,
    dry: Annotated[bool, typer.Option("--dry", help="read the real devices, command nothing")] = False,
    take_reference: Annotated[bool, typer.Option("--take-reference", help="take the reference tare now instead of the kept one")] = False,
    here: HereOption = False,
    go_back: ReturnOption = False,
    json_file: JsonOption = None,
) -> None:
    """Carry out a plan in the foreground and end with it."""
    from palpd.cli.printing import print_run
    from palpd.config import load_plan
    from palpd.daemon.run_reports import begin_report
    from palpd.daemon.run_result import run_result
    from palpd.daemon.session import carry_out, job
    from palpd.daemon.wiring import devices
    from palpd.history.stored import report_path

    settings, steps = settings_of(config), load_plan(plan)
    check_kept(settings)
    work = job("palpation", settings, steps, dry, take_reference, place_choice(here, go_back))
    if not dry:
        say_latch(settings)
    report = carry_out(work, devices, display())
    if report.recording is not None and settings.paths.write_reports:
        begin_report(report.recording, settings.paths.runs)
    result = run_result(report)
    print_run(result)
    if report.recording is not None and settings.paths.write_reports:
        terminal().print(f"report, in some seconds: {report_path(report.recording)}", soft_wrap=True)
    write_json(json_file, result)
    finish(report.exit_code, report.reason)


@app.command(examples=["palpd calibrate --config cell/config.yaml"])
def calibrate(
    config: ConfigOption = DEFAULT_CONFIG,
    temperature_C: Annotated[float | None, typer.Option("--temperature-C", help="of the sensor, if known; kept with the tare")] = None,
    probe_free: Annotated[bool, typer.Option("--probe-free", help="your word that the probe is free, where nothing else shows it")] = False,
) -> None:
    """Take the reference tare: probe free, arm still. Every run's absolute force limit is measured against it."""
    import sys

    from palpd.cli.jobs import carried_out
    from palpd.errors import Refused

    settings = settings_of(config)

    def taken(word: bool) -> "ProgramEnd":
        return carried_out("calibrate", {"temperature_C": temperature_C, "probe_free": word}, settings, settings.paths.state)

    try:
        end = taken(probe_free)
    except Refused as refused:
        if "--probe-free" not in str(refused) or not sys.stdin.isatty():  # a job of the service passes the sentence on, and nothing else
            raise
        terminal().print(f"{refused}.", soft_wrap=True)
        if not typer.confirm("Is the probe free? Look at it."):
            raise
        end = taken(True)
    finish(end.exit_code, end.reason)
    forces = ", ".join(f"{force:.2f}" for force in end.figures["wrench"][:3])
    terminal().print(f"Reference tare ({forces}) N of sensor {end.figures['sensor_serial'] or 'unknown'} kept in {end.figures['state']}.")


@app.command(
    examples=["palpd check --config cell/config.yaml", 'palpd check --new-baseline "new mount" --config cell/config.yaml'],
    apart={"new_baseline": ("temperature_C", "here")},
)
def check(
    config: ConfigOption = DEFAULT_CONFIG,
    temperature_C: Annotated[
        float | None, typer.Option("--temperature-C", help="of the sensor or the room, if known: the zero follows it")
    ] = None,
    new_baseline: Annotated[
        str | None,
        typer.Option(
            "--new-baseline", metavar="NOTE", help="the last check shows what was changed on purpose: charts begin anew; nothing moves"
        ),
    ] = None,
    json_file: JsonOption = None,
    here: Annotated[bool, typer.Option("--here", help="the arm stands where a check begins, though the last run was not finished")] = False,
) -> None:
    """Check the cell on its plate and puck, and name what has changed since it was well; exit code 1: warning, 2: do not palpate."""
    from palpd.cli.jobs import carried_out
    from palpd.cli.printing import print_check

    settings = settings_of(config)
    if new_baseline is not None:
        end = carried_out("baseline", {"note": new_baseline}, settings, settings.paths.state)
    else:
        end = carried_out("check", {"temperature_C": temperature_C, "here": here}, settings, settings.paths.state)
    if end.exit_code:
        print_last_ticks(end.figures.get("last_ticks", []))
        write_json(json_file, {"level": "stop", "sentence": f"It did not come to its end: {end.reason}."})
        finish(end.exit_code, end.reason)
    figures = end.figures
    print_check(figures)
    write_json(json_file, figures)
    finish({"ok": 0, "warn": 1, "stop": 2}[figures["level"]], figures["sentence"])


@app.command(
    examples=["palpd inject --config cell/config.yaml --plan cell/plan.yaml --times 10", "palpd inject --report --config cell/config.yaml"],
    apart={"report": ("plan", "cell", "times", "opened", "here", "go_back"), "opened": ("plan", "times", "here", "go_back")},
)
def inject(
    config: ConfigOption = DEFAULT_CONFIG,
    plan: PlanOption = DEFAULT_PLAN,
    cell: Annotated[Path | None, typer.Option("--cell", help="the cell as the simulator knows it, instead of the configuration's")] = None,
    times: Annotated[int, typer.Option("--times", min=1, max=200, help="number of runs, each with an effect of its own")] = 1,
    opened: Annotated[
        str | None, typer.Option("--open", metavar="RUN", help="diagnose and open a run that this command could not end; nothing moves")
    ] = None,
    report: Annotated[bool, typer.Option("--report", help="what all injections say of this cell; nothing moves")] = False,
    here: HereOption = False,
    go_back: ReturnOption = False,
    json_file: JsonOption = None,
) -> None:
    """Palpate with a sealed effect in a second recorded channel, which the diagnosis alone reads: does it name the effect?"""
    from palpd.cell.cell_file import load_cell
    from palpd.cli.printing import print_injections
    from palpd.config import load_plan
    from palpd.daemon.injection import inject as palpate_once
    from palpd.daemon.injection import open_injection, unopened
    from palpd.daemon.wiring import devices
    from palpd.gap.commands import library
    from palpd.history.injections import injection_report, injection_sentence
    from palpd.history.stored import recording_meant

    settings, known, show, choice = settings_of(config), library(None), display(), place_choice(here, go_back)
    stated = load_cell(cell, known) if cell is not None else None
    exit_code, reason = 0, ""
    if opened is not None:
        show.say(injection_sentence(open_injection(settings, recording_meant(opened, settings.paths.runs), stated, known)))
    elif not report:
        steps = load_plan(plan)
        check_kept(settings)
        say_latch(settings)
        for number in range(times):  # only the first one may follow an unfinished palpation
            ended = palpate_once(settings, steps, stated, known, devices, show, choice if number == 0 else None)
            exit_code, reason = ended.exit_code, ended.reason
            for note in ended.notes:
                show.say(f"note: {note}")
            if exit_code:
                print_last_ticks(list(ended.last_ticks))
                break
    figures, waiting = injection_report(settings.paths.runs), unopened(settings)
    print_injections(figures, waiting)
    write_json(json_file, figures | {"unopened": [str(path) for path in waiting], "reason": reason})
    finish(exit_code, reason)


@app.command("free-motion", examples=["palpd free-motion --config cell/config.yaml --out free.mcap"])
def free_motion(
    out: Annotated[Path, typer.Option("--out", help="recording to write (.mcap)"), Output(NEW_RECORDING)],
    config: ConfigOption = DEFAULT_CONFIG,
    take_reference: Annotated[bool, typer.Option("--take-reference", help="take the reference tare now")] = False,
) -> None:
    """Move 2 cm up and down ten times in free air and record it; `palpd train` learns from it."""
    from palpd.cli.jobs import carried_out, fetch
    from palpd.daemon.supervisor import recording_name

    target = with_ending(out, ".mcap").absolute()
    settings = settings_of(config)
    fresh = target.with_name(f"{recording_name('free_motion')}.mcap") if target.exists() else target
    end = carried_out("free-motion", {"take_reference": take_reference}, settings, fresh)
    recording = fetch(end.figures.get("recording"), target)
    if recording is not None and fresh != target:
        fresh.unlink(missing_ok=True)
    print_last_ticks(end.figures.get("last_ticks", []))
    terminal().print(f"{end.verdict}: {recording}")
    finish(end.exit_code, end.reason)


@app.command(examples=["palpd stiffness --config cell/config.yaml"])
def stiffness(config: ConfigOption = DEFAULT_CONFIG, json_file: JsonOption = None) -> None:
    """Press a rigid plate and keep how far sensor and arm give way; every depth is corrected by it afterwards."""
    from palpd.cli.jobs import carried_out

    settings = settings_of(config)
    end = carried_out("stiffness", {}, settings, settings.paths.state)
    last_ticks = end.figures.pop("last_ticks", [])
    if end.exit_code:
        print_last_ticks(last_ticks)
        finish(end.exit_code, end.reason)
    value_N_per_mm, low, high = (each / 1e3 for each in (end.figures["stiffness_N_per_m"], *end.figures["ci95_N_per_m"]))
    terminal().print(f"The machine gives way by 1 mm per {value_N_per_mm:.1f} N (95 %: {low:.1f} to {high:.1f}).")
    write_json(json_file, end.figures)


NoWaitOption = Annotated[bool, typer.Option("--no-wait", help="where the service does it: do not wait for its end")]


@app.command("level-test", examples=["palpd level-test --config cell/config.yaml"])
def level_test(config: ConfigOption = DEFAULT_CONFIG, socket: SocketOption = None, no_wait: NoWaitOption = False) -> None:
    """Go 5 mm straight up, slowly, and say whether the probe is free: the force must not change with the height."""
    _go_up("level-test", config, socket, no_wait)


@app.command(examples=["palpd retract --config cell/config.yaml"])
def retract(config: ConfigOption = DEFAULT_CONFIG, socket: SocketOption = None, no_wait: NoWaitOption = False) -> None:
    """Leave the tissue after a stop: straight up, slowly, under the guard. Works while the stop is latched, and leaves it latched."""
    _go_up("retract", config, socket, no_wait)


def _go_up(command: Literal["retract", "level-test"], config: Path, socket: Path | None, no_wait: bool) -> None:
    """Ask the service for that way up and wait for its end; go it in the foreground where none answers."""
    from palpd.cli.at_once import control_socket, probe_lines
    from palpd.daemon.job_client import awaited
    from palpd.daemon.socket_client import NoDaemon, ask

    show, path = terminal().print, socket or control_socket(config)
    try:
        begun = ask(path, {"do": command})
    except NoDaemon:
        if socket is not None:
            raise
    else:
        if no_wait or "id" not in begun:  # a service of an older palpd does not say it
            show("The daemon goes up; palpd status says how it ends.")
            return
        job = awaited(path, begun["id"], display())
        print_last_ticks(job["result"]["last_ticks"])
        show(f"{job['verdict']}: {job['result']['recording'] or 'nothing was recorded'}", soft_wrap=True)
        for line in probe_lines(ask(path, {"do": "status"}).get("probe"), None):
            show(line, soft_wrap=True)
        finish(job["exit_code"], job["reason"])
        return
    from palpd.config import Plan
    from palpd.daemon.session import carry_out
    from palpd.daemon.session import job as checked_job
    from palpd.daemon.wiring import devices

    settings = settings_of(config)
    check_kept(settings)
    report = carry_out(checked_job("retract" if command == "retract" else "level_test", settings, Plan()), devices, display())
    print_last_ticks(report.last_ticks)
    show(f"{report.verdict}: {report.recording or 'nothing was recorded'}", soft_wrap=True)
    if report.probe is not None:
        show(f"{report.probe.sentence}.", soft_wrap=True)
    finish(report.exit_code, report.reason)


@app.command(
    examples=["palpd demo", "palpd demo --effect tissue.viscoelastic --no-wires"],
    apart={"page": ("full", "effect", "wires", "json_file"), "effect": ("full",)},
)
def demo(
    full: Annotated[bool, typer.Option("--full", help="the paper's plan: 3 to 10 mm, 10 s holds, ten presses a depth")] = False,
    effect: Annotated[
        str | None,
        typer.Option(
            "--effect", help="effect id, cell file, file of laws (.yaml) or effect of yours (.py): plant it in the cell and find it"
        ),
    ] = None,
    wires: Annotated[
        bool, typer.Option("--wires/--no-wires", help="emulated wires, or the cell's physics alone: faster, without ur-rtde")
    ] = True,
    json_file: JsonOption = None,
    folder: Annotated[
        Path | None, typer.Option("--out", help="where recordings, model and report go (default: runs/demo-<time>)"), Output(OWN_FOLDER)
    ] = None,
    page: Annotated[bool, typer.Option("--page", help="serve the emulated cell and the operator's page, until Ctrl-C")] = False,
) -> None:
    """The whole job on emulated wires: calibrate, learn the inertia, palpate four sites, say how stiff each is."""
    from palpd.cli.printing import print_demonstration
    from palpd.daemon import demo as show
    from palpd.daemon.run_reports import begin_report

    if wires:
        _require_library(page)
    if page:
        _serve_demo(folder)
        return
    check_folder(folder or Path("runs"))
    demonstration = show.gap(effect, folder, display(), wires=wires) if effect else show.palpate(full, folder, display(), wires=wires)
    result = demonstration.result
    if effect is None and result["recording"] is not None:
        recording = Path(result["recording"])
        begin_report(recording, recording.parent)
    print_demonstration(demonstration)
    write_json(json_file, result)
    finish(0 if result["verdict"] == "done" else 3, result["reason"])


def _require_library(page: bool) -> None:
    """Refuse emulated wires where the robot's library is not installed, and offer the run without them."""
    from palpd.config import Config
    from palpd.daemon.wiring import robot_kind
    from palpd.errors import RobotError

    try:
        robot_kind(Config()).require()
    except RobotError as error:
        raise (
            error if page else RobotError(f"{error}, or add --no-wires: the cell's physics alone, without bytes, timing and faults")
        ) from None


def _serve_demo(folder: Path | None) -> None:
    """Serve an emulated cell and its page until Ctrl-C."""
    import socket
    import subprocess

    from palpd.cli.service import PAGE_PORT
    from palpd.daemon.demo import service_on_wires
    from palpd.errors import Refused
    from palpd.workers import beside

    check_folder(folder or Path("runs"))
    try:
        socket.create_server(("127.0.0.1", PAGE_PORT)).close()  # the cell takes some seconds, which a page that cannot listen would waste
    except OSError as error:
        raise Refused(f"the page cannot listen at port {PAGE_PORT} ({error.strerror}); end the palpd web or demo that does") from error
    with service_on_wires(folder, display()) as config:
        command = beside("palpd", "web", "--config", str(config), "--plan", str(config.with_name("plan.yaml")))
        log = config.with_name("page.log")
        with log.open("wb") as file:
            page = subprocess.Popen(command, stderr=file)
        try:
            code = page.wait()
        finally:
            page.terminate()
            page.wait()
    finish(3 if code else 0, f"the server of the page has died ({f'signal {-code}' if code < 0 else f'exit code {code}'}); see {log}")


@app.command(examples=["palpd sim --config cell/config.yaml --plan cell/plan.yaml"], apart={"cell": ("configured",)})
def sim(
    plan: PlanOption = DEFAULT_PLAN,
    config: ConfigOption = DEFAULT_CONFIG,
    cell: Annotated[Path | None, typer.Option("--cell", help="cell.yaml to press (default: the paper's phantom)")] = None,
    configured: Annotated[bool, typer.Option("--configured-cell", help="press the cell that --config states")] = False,
    seed: Annotated[int, typer.Option("--seed", min=0, help="of the noise")] = 0,
    progress: ProgressOption = False,
    json_file: JsonOption = None,
) -> None:
    """Carry out a plan on the cell's physics, without wires and faster than real time."""
    from palpd.cell.cell_file import PHANTOM, load_cell
    from palpd.cell.effects import load_effects
    from palpd.cli.printing import print_run
    from palpd.config import load_plan, refuse_unsafe
    from palpd.daemon.kept_plans import rehearsed_config_sha256
    from palpd.daemon.motion_job import Job
    from palpd.daemon.run_result import simulated_result
    from palpd.daemon.simulated_run import run as simulate

    settings, steps = settings_of(config), load_plan(plan)
    refuse_unsafe(settings, steps)
    library = load_effects()
    pressed = load_cell(cell, library) if cell else settings.cell if configured else PHANTOM
    with shown_steps("simulating", progress) as show:
        job = Job("palpation", settings, steps)
        simulated = simulate(job, pressed, seed=seed, library=library, show=lambda at_s: show(f"{at_s:.0f} s of the plan"))
    result = simulated_result(simulated)
    print_run(result)
    write_json(json_file, {**result, "config_sha256": rehearsed_config_sha256(settings)})
    finish(0 if result["verdict"] == "done" else 3, result["reason"])


@app.command(
    examples=["palpd emulate --sensor-link hex", "palpd emulate --model ur5e --cell cell.yaml --sensor-link hex"],
    apart={"net_ft_port": ("sensor_link", "fz_parts_at")},
)
def emulate(
    model: Annotated[Literal["ur5", "ur5e"], typer.Option("--model", help="ur5: CB3, 125 Hz; ur5e: e-Series, 500 Hz")] = "ur5",
    cell: Annotated[Path | None, typer.Option("--cell", help="cell.yaml of what the wires lead to (default: the paper's phantom)")] = None,
    host: Annotated[str, typer.Option("--host", callback=stated_address, help="address the controller listens on")] = "127.0.0.1",
    sensor_link: Annotated[
        Path | None, typer.Option("--sensor-link", help="link to make to the sensor's terminal device"), Output(LINK)
    ] = None,
    control: Annotated[
        Path | None, typer.Option("--control", help="unix socket for faults and truth (docs/emulators.md)"), Output(SOCKET)
    ] = None,
    effects: Annotated[
        Path | None, typer.Option("--effects", help="effects that the cell file names: a Python file or learned ones (.yaml)")
    ] = None,
    fz_parts_at: Annotated[
        Literal["reading", "load"],
        typer.Option("--fz-parts-at", help="where Fz changes its slope: at its own zero, or where the sensor carries nothing"),
    ] = "reading",
    net_ft_port: Annotated[
        int | None,
        typer.Option("--net-ft-port", min=1, max=65535, help="an ATI Net F/T in place of the HEX-70, with its page on this port"),
    ] = None,
) -> None:
    """Stand in for a UR controller and a force sensor until stopped; prints both addresses when ready."""
    from hw.emulators.process import emulate as stand_in

    stand_in(model, cell, host, sensor_link, control, effects=effects, fz_parts_at=fz_parts_at, net_ft_port=net_ft_port)
