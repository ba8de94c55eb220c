"""Commands for whoever keeps the daemon: serve, speak to it, install it, and judge machine, devices and configuration."""

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, NoReturn, cast

import typer

from palpd.cli import at_once
from palpd.cli.options import (
    DEFAULT_CONFIG,
    AcceptImplausible,
    ConfigOption,
    HereOption,
    JsonOption,
    ReturnOption,
    SocketOption,
    app,
    check_kept,
    finish,
    place_choice,
    settings_of,
    stated_address,
    terminal,
)
from palpd.cli.output_options import FOLDER, SOCKET, Output
from palpd.file_kinds import JSON, YAML
from palpd.files import check_folder, check_socket, write_json

if TYPE_CHECKING:
    from palpd.daemon.socket_client import ControlRequest, JobSummary

PAGE_PORT = 8700
"""Port of the operator's page, unless `--port` names another."""
ListenOption = Annotated[
    str,
    typer.Option("--listen", callback=stated_address, help="address to listen at; 0.0.0.0 for other computers too, such as a tablet"),
]
PortOption = Annotated[int, typer.Option("--port", min=1, max=65535, help="port to listen at")]


@app.command(examples=["palpd serve --config cell/config.yaml"])
def serve(config: ConfigOption = DEFAULT_CONFIG) -> None:
    """Run the daemon: connect, wait disarmed, obey the control socket."""
    from palpd.daemon.logs import configure
    from palpd.daemon.service import Service
    from palpd.daemon.wiring import devices, open_controller

    settings = settings_of(config)
    check_kept(settings)
    check_socket(settings.paths.control_socket)
    configure()
    Service(settings, devices, open_controller).serve()


@app.command(examples=["palpd web --config cell/config.yaml --plan cell/plan.yaml"])
def web(
    config: ConfigOption = DEFAULT_CONFIG,
    listen: ListenOption = "127.0.0.1",
    port: PortOption = PAGE_PORT,
    name: Annotated[
        list[str] | None, typer.Option("--name", help="further host name or address under which browsers may open the page")
    ] = None,
    token_file: Annotated[
        Path | None, typer.Option("--token-file", help="where the token is kept (default: page-token in the state folder)")
    ] = None,
    plan: Annotated[Path | None, typer.Option("--plan", help="plan that the page offers first")] = None,
) -> None:
    """Serve the operator's page, in a process of its own, for a browser on this computer."""
    from palpd.config import load_plan

    if plan:
        load_plan(plan)  # a plan that no run would take is refused here, not when someone opens the page
    names = [word for each in name or [] for word in ("--name", each)]
    become_page(config, "--listen", listen, "--port", port, *(["--plan", plan] if plan else []), *names, token_file=token_file)


def become_page(config: Path, *words: object, token_file: Path | None = None) -> NoReturn:
    """Make this process the server of the page.

    Args:
        config: config.yaml; where it is missing, `--setup` must be among the words, and its folder has what a new config.yaml says.
        words: What the server takes besides (`python -m palpd.web --help`).
        token_file: Where the token is kept; None: in the state folder.

    Raises:
        PalpdError: The configuration is wrong, or the folder of the token cannot be written.
    """
    import os
    import sys

    from palpd.config import PathsConfig

    settings = None if "--setup" in words and not config.exists() else settings_of(config)
    paths = settings.paths if settings else PathsConfig(runs=config.absolute().parent / "runs", state=config.absolute().parent / "state")
    kept = token_file or paths.state / "page-token"
    check_folder(kept.parent)
    kept.parent.mkdir(parents=True, exist_ok=True)
    words = ("--socket", paths.control_socket, "--runs", paths.runs, "--token-file", kept, "--config", config, *words)
    words += ("--camera-url", settings.page.camera_url) if settings and settings.page.camera_url else ()
    sys.stdout.flush()
    # this process becomes the server, which imports next to nothing: so it has no configuration and no typer in its memory
    environment = {"MALLOC_ARENA_MAX": "2", "OMP_NUM_THREADS": "1", **os.environ}
    os.execve(sys.executable, [sys.executable, "-m", "palpd.web", *map(str, words)], environment)


@app.command(
    examples=["palpd status --config cell/config.yaml", "palpd status --config cell/config.yaml --watch"], apart={"watch": ("json_file",)}
)
def status(
    config: ConfigOption = DEFAULT_CONFIG,
    socket: SocketOption = None,
    json_file: JsonOption = None,
    watch: Annotated[bool, typer.Option("--watch", help="repeat it until Ctrl-C; on a terminal in place")] = False,
) -> None:
    """Say what the daemon is doing: the job, its site and phase, progress, force and depth."""
    if watch:
        at_once.watch(config, socket)
    at_once.status(config, socket, json_file)


@app.command(examples=["palpd arm --config cell/config.yaml"])
def arm(config: ConfigOption = DEFAULT_CONFIG, socket: SocketOption = None) -> None:
    """Check the real devices, which takes some seconds, and let the daemon move at the next start."""
    print(at_once.speak({"do": "arm"}, config, socket)["state"])


@app.command(examples=["palpd start cell/plan.yaml --config cell/config.yaml", "palpd start --kept phantom --config cell/config.yaml"])
def start(
    plan: Annotated[Path | None, typer.Argument(help="plan.yaml")] = None,
    kept: Annotated[
        str | None, typer.Option("--kept", metavar="NAME", help="a plan that the daemon keeps, as palpd plans lists it")
    ] = None,
    here: HereOption = False,
    go_back: ReturnOption = False,
    config: ConfigOption = DEFAULT_CONFIG,
    socket: SocketOption = None,
) -> None:
    """Start a plan on an armed daemon."""
    from palpd.config import load_plan, parse_plan
    from palpd.documents import parse_yaml
    from palpd.errors import BadInput

    if (plan is None) == (kept is None):
        raise BadInput("a start needs one plan; give a plan.yaml, or --kept NAME")
    if plan is not None:
        steps = load_plan(plan)
    else:
        name = f"the kept plan {kept}"
        steps = parse_plan(parse_yaml(at_once.speak({"do": "plans", "name": kept}, config, socket)["yaml"], name).content, name)
    values = steps.model_dump(mode="json")
    answer = at_once.speak({"do": "start", "plan": values, "place": place_choice(here, go_back)}, config, socket)
    print(f"{answer['state']}: {answer['way_back']}" if "way_back" in answer else answer["state"])


@app.command(examples=["palpd pause --config cell/config.yaml"])
def pause(config: ConfigOption = DEFAULT_CONFIG, socket: SocketOption = None) -> None:
    """Leave the tissue, and wait at the safe height; `palpd resume` begins the press again."""
    print(at_once.position(at_once.speak({"do": "pause"}, config, socket)))


@app.command(examples=["palpd resume --config cell/config.yaml"])
def resume(config: ConfigOption = DEFAULT_CONFIG, socket: SocketOption = None) -> None:
    """Go on after a pause."""
    print(at_once.position(at_once.speak({"do": "resume"}, config, socket)))


@app.command(examples=["palpd abort", "palpd abort --config cell/config.yaml"])
def abort(config: ConfigOption = DEFAULT_CONFIG, socket: SocketOption = None) -> None:
    """Stop the arm and end the plan. A convenience, not an emergency stop."""
    at_once.abort(config, socket)


@app.command(examples=["palpd clear --config cell/config.yaml", "palpd clear --cause 'the tool touched the frame'"])
def clear(
    config: ConfigOption = DEFAULT_CONFIG,
    socket: SocketOption = None,
    cause: Annotated[
        str | None, typer.Option("--cause", metavar="TEXT", help="what caused the last protective stop; kept with the time")
    ] = None,
) -> None:
    """Clear the latch of the last stop, after looking at the cell."""
    from palpd.cli.recovery import cleared_alone
    from palpd.daemon.socket_client import NoDaemon

    request: ControlRequest = {"do": "clear"} if cause is None else {"do": "clear", "cause": cause}
    try:
        print(at_once.speak(request, config, socket)["state"])
    except NoDaemon:
        if socket is not None:
            raise
        cleared_alone(settings_of(config), cause)
        print("cleared; no service answers")


@app.command(
    "recover-robot",
    examples=["palpd recover-robot --config cell/config.yaml", "palpd recover-robot --config cell/config.yaml --json robot.json"],
)
def recover_robot(config: ConfigOption = DEFAULT_CONFIG, socket: SocketOption = None, json_file: JsonOption = None) -> None:
    """Lead back after a stop of the robot: what its controller says, the next step at the pendant; then ask to acknowledge and to arm.

    It moves nothing and sends the controller no command. Without a terminal it says once what stands, and ends with 2 unless the robot is
    ready.
    """
    from palpd.cli.recovery import recovered, recovered_alone
    from palpd.daemon.socket_client import NoDaemon

    try:
        end = recovered(socket or at_once.control_socket(config))
    except NoDaemon:
        if socket is not None:
            raise
        end = recovered_alone(settings_of(config))
    write_json(json_file, end.answer)
    finish(end.exit_code, end.reason)


@app.command(examples=["palpd jobs --config cell/config.yaml"])
def jobs(config: ConfigOption = DEFAULT_CONFIG, socket: SocketOption = None, json_file: JsonOption = None) -> None:
    """List the jobs of the daemon since it began: the running one, and the last ones with how they ended."""
    answer = at_once.speak({"do": "jobs"}, config, socket)
    for each in answer["jobs"]:
        print(at_once.job_line(each))
    if not answer["jobs"]:
        print("No job since the daemon began.")
    write_json(json_file, answer)


@app.command(
    examples=[
        "palpd job 20260714-101502-map --config cell/config.yaml",
        "palpd job 20260714-101502-map --cancel --config cell/config.yaml",
    ],
    apart={"cancel": ("agree", "json_file"), "agree": ("json_file",)},
)
def job(
    job_id: Annotated[str, typer.Argument(metavar="ID", help="as palpd jobs lists it")],
    agree: Annotated[bool | None, typer.Option("--agree/--decline", help="answer the motion that it proposes")] = None,
    cancel: Annotated[bool, typer.Option("--cancel", help="stop the arm and end the job")] = False,
    config: ConfigOption = DEFAULT_CONFIG,
    socket: SocketOption = None,
    json_file: JsonOption = None,
) -> None:
    """Show a job of the daemon with its log and result; answer its proposed motion, or cancel it."""
    if cancel:
        print(at_once.speak({"do": "cancel", "id": job_id}, config, socket)["state"])
        return
    answer = at_once.speak({"do": "job", "id": job_id}, config, socket)
    if agree is not None:
        number = answer["proposal"]["number"] if answer["proposal"] is not None else 0
        print(at_once.speak({"do": "decide", "id": job_id, "number": number, "agree": agree}, config, socket)["state"])
        return
    for line in answer["log"]:
        print(line)
    print(at_once.job_line(cast("JobSummary", answer)))
    for line in at_once.proposal_lines(answer["proposal"]):
        print(line)
    write_json(json_file, answer)


@app.command(examples=["palpd plans --config cell/config.yaml"])
def plans(config: ConfigOption = DEFAULT_CONFIG, socket: SocketOption = None, json_file: JsonOption = None) -> None:
    """List the plans that the daemon keeps, with what their rehearsals gave. The tab Plan of the page keeps and forgets them."""
    from palpd.daemon.kept_plans import rehearsed_config_sha256

    answer = at_once.speak({"do": "plans"}, config, socket)
    current = rehearsed_config_sha256(settings_of(config)) if answer["plans"] else ""
    for plan in answer["plans"]:
        figures, rehearsed = plan["rehearsal"], "not rehearsed"
        if figures is not None:
            end = "" if figures["verdict"] == "done" else ", stopped by the guard"
            presses = f"{figures['cut_short']} of {figures['presses']} presses cut short{end}"
            rehearsed = (
                f"{figures['duration_s']:.0f} s, at most {figures['peak_force_N']:.1f} N, {presses} in the rehearsal of {figures['date']}"
            )
            rehearsed += "" if figures["config_sha256"] == current else ", before the configuration changed"
        print(f"{plan['name']}: {rehearsed}; kept by {plan['by'] or 'hand'} {plan['kept']}")
    if not answer["plans"]:
        print("No plan is kept.")
    write_json(json_file, answer)


@app.command(examples=["palpd controls --config cell/config.yaml"])
def controls(
    free: Annotated[bool, typer.Option("--free", help="take them from whoever holds them, and let them go; logged")] = False,
    config: ConfigOption = DEFAULT_CONFIG,
    socket: SocketOption = None,
) -> None:
    """Say who holds the daemon's controls. Whoever does not may watch, and abort."""
    from getpass import getuser

    if free:
        lease = at_once.speak({"do": "take", "name": f"{getuser()} with palpd controls --free", "force": True}, config, socket)["lease"]
        at_once.speak({"do": "release", "lease": lease}, config, socket)
    holder = at_once.speak({"do": "status"}, config, socket)["controls"]
    print(f"{holder} holds the controls." if holder else "Nobody holds the controls.")


@app.command(
    examples=["palpd stream --config cell/config.yaml --foxglove 8765 --metrics 9464", "palpd stream --layout palpd-layout.json"],
    apart={"layout": ("foxglove", "metrics", "force")},
)
def stream(
    config: ConfigOption = DEFAULT_CONFIG,
    socket: SocketOption = None,
    foxglove: Annotated[
        int | None, typer.Option("--foxglove", metavar="PORT", min=1, max=65535, help="serve Foxglove's WebSocket protocol at this port")
    ] = None,
    metrics: Annotated[
        int | None, typer.Option("--metrics", metavar="PORT", min=1, max=65535, help="serve Prometheus metrics at this port")
    ] = None,
    force: Annotated[
        Path | None,
        typer.Option("--force", metavar="SOCKET", help="send the force of each tick to readers of this Unix socket"),
        Output(SOCKET),
    ] = None,
    listen: Annotated[
        str,
        typer.Option(
            "--listen",
            callback=stated_address,
            help="address to listen at; 0.0.0.0 for other computers too, which may then read all of it",
        ),
    ] = "127.0.0.1",
    layout: Annotated[
        Path | None, typer.Option("--layout", help="write the layout for Foxglove to this file, and end"), Output(JSON)
    ] = None,
) -> None:
    """Show the daemon's live data to other tools until Ctrl-C: Foxglove, Prometheus, and readers of the force. Reads only."""
    from palpd.files import write_bytes
    from palpd.streams import serving

    if layout is not None:
        write_bytes(layout, serving.LAYOUT.read_bytes())
        print(f"{layout} holds the layout; open it in Foxglove with Import from file.")
        return
    settings = settings_of(config)
    outputs = serving.Outputs(listen, foxglove, metrics, force)
    serving.serve(settings, socket or settings.paths.control_socket, outputs, lambda sentence: print(sentence, flush=True))


@app.command(
    examples=["palpd alarms --config cell/config.yaml", "palpd alarms --config cell/config.yaml --test"],
    apart={"test": ("state_file",)},
)
def alarms(
    config: ConfigOption = DEFAULT_CONFIG,
    socket: SocketOption = None,
    state_file: Annotated[
        Path | None,
        typer.Option("--state-file", help="where it remembers which events it has told of (default: alarms.json in the state folder)"),
    ] = None,
    test: Annotated[bool, typer.Option("--test", help="send one test message to each address, say what each answered, and end")] = False,
    json_file: JsonOption = None,
) -> None:
    """Send alarms of the daemon to people who are away, until Ctrl-C: stops, failed checks, a full disk, its death. Moves nothing."""
    from palpd.errors import BadInput
    from palpd.streams.addresses import read_addresses
    from palpd.streams.alarms import serve, tested

    settings = settings_of(config)
    addresses = read_addresses(settings.alarms)
    if not test:
        if json_file is not None:
            raise BadInput("--json is for the answers of a test; add --test, or leave it out")
        kept = state_file or settings.paths.state / "alarms.json"
        serve(settings, socket or settings.paths.control_socket, addresses, kept, lambda sentence: print(sentence, flush=True))
        return
    answers = tested(addresses)
    for name, trouble in answers.items():
        print(f"{name}: not taken: {trouble}." if trouble else f"{name}: taken.")
    failed = [name for name, trouble in answers.items() if trouble]
    write_json(json_file, {"addresses": [{"name": name, "taken": not trouble, "answer": trouble} for name, trouble in answers.items()]})
    finish(2 if failed else 0, f"{len(failed)} of {len(answers)} addresses took no message: {', '.join(failed)}")


@app.command(examples=["palpd init cell", "palpd init cell --model ur5e --limit-N 10 --depths-mm 4,5"])
def init(
    folder: Annotated[Path, typer.Argument(help="where to write both files"), Output(FOLDER)] = Path(),
    model: Annotated[Literal["ur5", "ur5e"], typer.Option("--model", help="ur5: CB3, 125 Hz; ur5e: e-Series, 500 Hz")] = "ur5",
    limit_N: Annotated[float, typer.Option("--limit-N", min=1, max=90, help="contact limit")] = 12.0,
    depths_mm: Annotated[str, typer.Option("--depths-mm", help="depths, such as 4,5,6 (default: what the limit allows on 143 kPa)")] = "",
) -> None:
    """Write a config.yaml and a plan.yaml that fit each other."""
    from palpd.daemon.starting_files import write_starting_files
    from palpd.errors import BadInput

    try:
        depths_m = [float(word) / 1e3 for word in depths_mm.split(",") if word.strip()]
    except ValueError:
        raise BadInput(f"--depths-mm is {depths_mm!r}, expected numbers with commas between, such as 4,5,6") from None
    config, plan = write_starting_files(folder, model, limit_N, depths_m)
    terminal().print(
        f"{config} and {plan} fit each other. Next: set robot.host and sensor.port in {config}, then palpd doctor --config {config}.",
        soft_wrap=True,
    )


@app.command(examples=["palpd install --prefix build"])
def install(
    prefix: Annotated[Path, typer.Option("--prefix", help="folder that stands for / (a package's build root)"), Output(FOLDER)] = Path("/"),
) -> None:
    """Put the service's unit, user, device rule and configuration into place; an existing configuration is kept."""
    from palpd.daemon.install import NEXT_STEPS, installed

    for path in installed(prefix):
        terminal().print(path, soft_wrap=True)
    terminal().print(NEXT_STEPS, soft_wrap=True)


@app.command(examples=["palpd doctor --config cell/config.yaml", "palpd doctor --config cell/config.yaml --weight-N 5"])
def doctor(
    config: ConfigOption = DEFAULT_CONFIG,
    weight_N: Annotated[float | None, typer.Option("--weight-N", min=0.5, max=100, help="known weight to hang on the probe")] = None,
    watch_s: Annotated[float, typer.Option("--watch-s", min=1, max=600, help="how long the devices are watched")] = 10.0,
    json_file: JsonOption = None,
) -> None:
    """Judge clock, privileges, disk and devices, and say what to do; reads, and moves nothing."""
    from palpd.cli.jobs import carried_out
    from palpd.cli.tables import finding_table
    from palpd.daemon import doctor as examine
    from palpd.daemon.finding import Finding
    from palpd.daemon.job_client import service_at
    from palpd.daemon.wiring import open_reader, open_sensor

    settings = settings_of(config, optional=True)

    def ask(what: str) -> None:
        terminal().input(f"{what} Then press Enter. ")

    if weight_N is None and service_at(settings.paths.control_socket):
        end = carried_out("doctor", {"watch_s": watch_s}, settings, settings.paths.state)
        findings = [Finding(**finding) for finding in end.figures["findings"]]
    else:
        findings = examine.examined(settings, open_sensor, open_reader, watch_s, weight_N, ask)
    terminal().print(finding_table(findings))
    failed = [finding for finding in findings if finding.verdict == "fail"]
    write_json(json_file, examine.as_json(findings))
    finish(2 if failed else 0, f"{len(failed)} of {len(findings)} checks failed: {', '.join(finding.name for finding in failed)}")


@app.command(examples=["palpd migrate cell.yaml --dry-run", "palpd migrate cell.yaml"])
def migrate(
    file: Annotated[Path, typer.Argument(help="config.yaml, cell.yaml or plan.yaml of an older palpd")],
    kind: Annotated[
        Literal["config", "cell", "plan"] | None, typer.Option("--kind", help="which of them it is (default: as its keys say)")
    ] = None,
    old: Annotated[Path | None, typer.Option("--old", help="where the file as it was is kept (default: FILE.old)"), Output(YAML)] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="show what would change, and write nothing")] = False,
) -> None:
    """Rewrite a file of an older palpd; comments and all that need not change stay as they are."""
    from palpd.migration import migration_of, write

    migration = migration_of(file, kind)
    show = terminal().print
    if not migration.changes:
        show(migration.unchanged, soft_wrap=True)
        return
    for sentence in migration.changes:
        show(sentence, soft_wrap=True)
    if dry_run:
        return
    kept = old or file.with_name(f"{file.name}.old")
    write(migration, kept)
    show(f"{file} is written anew; as it was it is kept in {kept}.", soft_wrap=True)


@app.command("check-config", examples=["palpd check-config cell/config.yaml --plan cell/plan.yaml"])
def check_config(
    config: Annotated[Path, typer.Argument(help="config.yaml")],
    plan: Annotated[Path | None, typer.Option("--plan", help="plan.yaml to judge with it")] = None,
    json_file: JsonOption = None,
    faults: Annotated[bool, typer.Option("--faults", help="write what is wrong to --json, by its keys, instead of refusing it")] = False,
    accept_implausible: AcceptImplausible = False,
) -> None:
    """Refuse what is wrong or unsafe; print how far a force would run past its limit."""
    from palpd.cli.tables import overshoot_table
    from palpd.config import Plan, close_sites, load_plan, plan_limits
    from palpd.control.sequence import SOFT_END
    from palpd.daemon.doctor.stored import examine_machine_stiffness
    from palpd.daemon.kept_plans import rehearsed_config_sha256
    from palpd.daemon.overshoot import predicted
    from palpd.daemon.starting_files import checked
    from palpd.errors import ConfigError, Refused
    from palpd.streams.addresses import read_addresses

    try:
        settings, steps = checked(config, plan, accept_implausible)
    except ConfigError as error:
        if not faults or json_file is None:
            raise
        about: dict[str, object] = {"refusal": str(error), "faults": error.faults, "plan_schema": Plan.model_json_schema()}
        with suppress(ConfigError):  # a plan that is only unsafe is shown all the same
            about["plan"] = load_plan(plan).model_dump(mode="json", exclude_none=True) if plan is not None else None
        write_json(json_file, about)
        return
    unreadable = []
    if settings.alarms.addresses:
        try:
            read_addresses(settings.alarms)
        except Refused as refused:  # who checks a configuration need not be allowed to read secrets
            unreadable.append(str(refused))
    prediction, questions = predicted(settings, steps), close_sites(settings, steps)
    for table in overshoot_table(prediction):
        terminal().print(table)
    for question in [*questions.values(), *unreadable]:
        terminal().print(f"question: {question}", soft_wrap=True)
    for finding in examine_machine_stiffness(settings):
        terminal().print(f"{finding.name}: {finding.measured}{'; ' * bool(finding.advice)}{finding.advice}", soft_wrap=True)
    terminal().print(f"{config} is sound." if plan is None else f"{config} and {plan} are sound.")
    content = {
        "expected_stiffness_N_per_m": settings.safety.expected_stiffness_N_per_m,
        "plan": steps.model_dump(mode="json", exclude_none=True),
        "plan_schema": Plan.model_json_schema(),
        "limits": plan_limits(settings, steps),
        "questions": questions,
        "soft_end_N": SOFT_END * settings.safety.contact_limit_N,
        "apart_m": 2.0 * settings.cell.probe.tip_radius_m,
        "config_sha256": rehearsed_config_sha256(settings),
    }
    write_json(json_file, {**prediction, **content})
