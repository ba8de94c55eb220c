"""`palpd abort` and `palpd status` without the rest of the command line: an abort must reach the daemon within 0.25 s of the keystroke.

The commands that `--help` shows (service.py) call the same functions; what is not plainly one of their options is left to them.
Both work without a configuration that can be read: they then ask at the usual control sockets.
"""

import os
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from palpd.cli.first_abort import configured_path, default_sockets, send_abort
from palpd.cli.last_ticks import print_last_ticks
from palpd.daemon.socket_client import ARM_PATIENCE_S, PATIENCE_S, NoDaemon, ask
from palpd.errors import ConfigError, Refused

if TYPE_CHECKING:
    from palpd.daemon.socket_client import (
        ControlAnswer,
        ControlRequest,
        JobSummary,
        KnownNow,
        KnownPlace,
        KnownProbe,
        KnownProtectiveStop,
        ProposedRun,
    )

WATCH_EVERY_S = 0.5
"""Pause between two questions of `palpd status --watch`: what a person can read."""
DEFAULT_CONFIG = Path("config.yaml")
NEXT = {
    "check": "palpd doctor", "arm": "palpd arm", "start": "palpd start PLAN", "resume": "palpd resume", "retract": "palpd retract",
    "level-test": "palpd level-test", "calibrate": "palpd calibrate", "clear": "palpd clear", "decide": "palpd job ID --agree or --decline",
}  # fmt: skip
"""The command of each button that may be sensible next."""
OPTIONS = {"abort": ("--config", "--socket"), "status": ("--config", "--socket")}
"""Options of the commands that are carried out at once, each with a value."""


def done_at_once(arguments: Sequence[str]) -> bool:
    """Carry out an abort or a status that is spelled plainly.

    Args:
        arguments: What stands on the command line after `palpd`.

    Returns:
        Whether it was carried out; all else needs the whole command line.

    Raises:
        PalpdError: What the command raises.
    """
    command = arguments[0] if arguments else ""
    options = _options(arguments[1:], OPTIONS.get(command, ()))
    if command not in OPTIONS or options is None:
        return False
    config = options.get("--config", DEFAULT_CONFIG)
    if command == "abort":
        abort(config, options.get("--socket"))
    else:
        status(config, options.get("--socket"), None)
    return True


def abort(config: Path, socket: Path | None) -> None:
    """Ask the daemon to stop the arm, and print its answer. Without a readable `config` all daemons at the usual sockets are asked.

    Args:
        config: config.yaml, which says where the daemon listens.
        socket: Control socket in place of the one of `config`.

    Raises:
        PalpdError: Where no daemon answers, or one refuses.
    """
    for _, answer in _answers({"do": "abort"}, config, socket):
        print(answer["state"])


def status(config: Path, socket: Path | None, json_file: Path | None) -> None:
    """Print what the daemon is doing. Without a readable `config` it is the first that answers at the usual sockets.

    Args:
        config: config.yaml, which says where the daemon listens.
        socket: Control socket in place of the one of `config`.
        json_file: File to write the answer to, if any.

    Raises:
        PalpdError: Where no daemon answers, or the file cannot be written.
    """
    _, answer = next(_answers({"do": "status"}, config, socket))
    last = answer.get("last")
    for line in status_lines(answer):
        print(line)
    print_last_ticks(last["last_ticks"] if last else [])
    if json_file is not None:
        from palpd.files import write_json

        write_json(json_file, answer)


def watch(config: Path, socket: Path | None) -> None:
    """Print the status every `WATCH_EVERY_S`: on a terminal in place, else a line whenever it has changed. Ends with Ctrl-C.

    Args:
        config: config.yaml, which says where the daemon listens.
        socket: Control socket in place of the one of `config`.

    Raises:
        PalpdError: Where no daemon answers.
    """
    before: list[str] = []
    path, answer = next(_answers({"do": "status"}, config, socket))
    while True:
        lines = status_lines(answer)
        if sys.stdout.isatty():
            print(f"\x1b[{len(before)}F\x1b[J" * bool(before), *(f"{line}\n" for line in lines), sep="", end="", flush=True)
        elif lines != before:
            print(lines[0], flush=True)
        before = lines
        time.sleep(WATCH_EVERY_S)
        answer = ask(path, {"do": "status"}, PATIENCE_S)


def status_lines(answer: "ControlAnswer") -> list[str]:
    """Say for people what the daemon answers to `status`.

    Returns:
        Lines: what it does now and what is sensible next, the latch, the last check of the devices, the last job.
    """
    lines = [position(answer), *now_lines(answer.get("now"))]
    if answer.get("latched"):
        lines.append(f"The last stop is latched: {answer['latched']}. Leave the tissue with palpd retract, then palpd clear.")
    if answer.get("controls"):
        lines.append(f"{answer['controls']} holds the controls.")
    active = answer.get("active")
    if active:
        lines += [job_line(active), *proposal_lines(active["proposal"])]
    lines += cause_lines(answer.get("protective", []))
    lines += probe_lines(None if "job" in answer else answer.get("probe"), answer.get("place"))
    cell, last = answer.get("cell"), answer.get("last")
    if cell:
        verdict = "ready" if cell["ready"] else f"not ready: {cell['reason']}"
        lines.append(f"Robot and sensor, checked {cell['date']}: {verdict}.")
    if last:
        reason, recording = last.get("reason"), last.get("recording")
        kept = f", recording {recording}" if recording else ""
        lines.append(f"Last job: {last['verdict']}{f' ({reason})' if reason else ''}{kept}.")
        lines.extend(f"  note: {note}" for note in last.get("notes", []))
    return lines


def now_lines(now: "KnownNow | None") -> list[str]:
    """Say what stands, the command that is sensible next, and what a start would be asked.

    Args:
        now: What the daemon says of it; None from a daemon of an older version.

    Returns:
        At most two lines.
    """
    if now is None:
        return []
    command, asked = NEXT.get(now["next"] or ""), now["question"]
    lines = [f"{now['sentence']}{f' Next: {command}.' if command else ''}"]
    if asked is not None:
        from palpd.control.plan_place import ANSWERS  # imported here: few are asked, and an abort waits for no import

        lines.append(f"{asked[:1].upper()}{asked[1:]}; {ANSWERS}.")
    return lines


def cause_lines(stops: "Sequence[KnownProtectiveStop]") -> list[str]:
    """Say what operators wrote down of protective stops.

    Args:
        stops: The last ones, as the daemon lists them.

    Returns:
        A line for each cause.
    """
    return [f"Protective stop of {stop['date']}: {stop['cause']}, written by {stop['by']}." for stop in stops if stop["cause"]]


def probe_lines(probe: "KnownProbe | None", place: "KnownPlace | None") -> list[str]:
    """Say whether the probe is free, and where the tip stands.

    Args:
        probe: The last answer about the probe, if any.
        place: The last known place, if any.

    Returns:
        Lines; none where nothing is known.
    """
    lines = []
    if probe is not None:
        reasons = f" ({'; '.join(probe['reasons'])})" if probe["reasons"] else ""
        advice = "" if probe["state"] == "free" else f"; {probe['advice']}"
        state = "not known to be free" if probe["state"] == "unknown" else probe["state"]
        lines.append(f"The probe is {state}{reasons}, judged {probe['date']}{advice}.")
    if place is not None and place["x_m"] is not None and place["y_m"] is not None:
        over = f", over site {place['site']} of the last plan" if place["site"] else ""
        lines.append(f"The tip is at x = {place['x_m'] * 1e3:.1f} mm, y = {place['y_m'] * 1e3:.1f} mm{over}.")
    return lines


def job_line(job: "JobSummary") -> str:
    """Say in one line what a job is and how far it is.

    Returns:
        Id, state, runs, and the activity or the reason.
    """
    runs = f"run {job['runs']} of at most {job['most_runs']}" if job["ended"] is None else f"{job['runs']} run{'s' * (job['runs'] != 1)}"
    more = job["activity"] or job["reason"]
    return f"Job {job['id']} of {job['by']}: {job['state']}, {runs}{f', {more}' if more else ''}."


def proposal_lines(proposal: "ProposedRun | None") -> list[str]:
    """Say what a job proposes, and how to answer.

    Args:
        proposal: The proposed motion, if any.

    Returns:
        Lines; none without a proposal.
    """
    if proposal is None:
        return []
    return [
        f"  the gap so far: {proposal['gap']}",
        f"  proposed motion {proposal['number']}: {proposal['decides']}",
        f"  it takes {proposal['duration_s']:.0f} s and presses with at most {proposal['expected_peak_N']:.1f} N "
        f"of the guard's {proposal['limit_N']:g} N; answer with palpd job ID --agree or --decline",
    ]


def position(answer: "ControlAnswer") -> str:
    """Say in one line what the daemon does, and where a running job stands.

    Args:
        answer: An answer to `status`, `pause` or `resume`.

    Returns:
        State, job, activity, progress, force and depth, as far as the answer has them.
    """
    words = [f"{answer['state']}: {answer['job'].replace('_', ' ')}" if "job" in answer else answer["state"]]
    if "activity" in answer:
        words.append(answer["activity"])
    if answer.get("steps", 0) > 1:
        words.append(f"{answer['steps_done']} of {answer['steps']} steps done")
    if "force_N" in answer:
        words.append(f"force {answer['force_N']:.2f} N")
        depth_m = answer.get("depth_m")
        height = depth_m is None or depth_m < 0.0
        words.append(f"tip at z = {answer['z_m'] * 1e3:.1f} mm" if height else f"{(depth_m or 0.0) * 1e3:.1f} mm deep")
    return ", ".join(words)


def speak(request: "ControlRequest", config: Path, socket: Path | None) -> "ControlAnswer":
    """Send a request to the daemon.

    Args:
        request: What to do, as the control socket takes it.
        config: config.yaml, which says where the daemon listens.
        socket: Control socket in place of the one of `config`.

    Raises:
        PalpdError: Where no daemon answers, or it refuses, or `config` cannot be read.
    """
    return ask(socket or control_socket(config), request, ARM_PATIENCE_S if request["do"] == "arm" else PATIENCE_S)


def control_socket(config: Path) -> Path:
    """Where the daemon of that config.yaml listens, read from its `paths` alone; what is wrong there is said by the models."""
    socket = _stated_socket(config)
    if socket is None:
        from palpd.config import load_config

        return load_config(config).paths.control_socket
    return socket


def usual_sockets(config: Path) -> list[Path]:
    """Where a daemon may listen whose config.yaml cannot be read: as the environment, its plain lines and the defaults have it."""
    paths: list[Path | None] = []
    with suppress(ConfigError):
        if overrides := _paths_of_environment():
            paths.append(_socket_in(overrides, Path(os.path.realpath(config)).parent))
    plain = configured_path(str(config))
    paths += [Path(path) for path in ([plain] if plain else []) + default_sockets(str(config))]
    return [path for path in dict.fromkeys(paths) if path is not None]


def _answers(request: "ControlRequest", config: Path, socket: Path | None) -> "Iterator[tuple[Path, ControlAnswer]]":
    """The daemon's control socket and its answer; those of each daemon that answers at a usual socket where `config` cannot be read."""
    try:
        stated, unreadable = socket or _stated_socket(config), f"{config} does not say where the daemon listens; correct its paths"
    except ConfigError as error:
        stated, unreadable = None, str(error)
    if stated is not None:
        yield stated, ask(stated, request, PATIENCE_S)
        return
    paths, refusals, silent = usual_sockets(config), list[Refused](), True
    for path in paths if request["do"] == "abort" else ():
        send_abort(str(path))  # a daemon that hangs must not delay the abort of the next
    for path in paths:
        try:
            answer = ask(path, request, PATIENCE_S)
        except NoDaemon:
            continue
        except Refused as refused:
            refusals.append(refused)
            continue
        if silent:
            print(f"palpd: {unreadable}", file=sys.stderr)
        silent = False
        print(f"palpd: the daemon at {path} answers", file=sys.stderr)
        yield path, answer
    if refusals:
        raise refusals[0]
    if silent:
        places = " or ".join(map(str, paths))
        end = "nothing was stopped; if the arm moves, use the emergency stop" if request["do"] == "abort" else "give its --socket"
        raise NoDaemon(f"{unreadable}. No daemon answers at {places} either: {end}")


def _stated_socket(config: Path) -> Path | None:
    """The control socket that config.yaml and the environment state; None where the paths are wrong. Raises ConfigError."""
    from palpd.documents import read_yaml

    paths = read_yaml(config).keys_and_values().get("paths", {})
    return _socket_in({**paths, **_paths_of_environment()}, config.resolve().parent) if isinstance(paths, dict) else None


def _socket_in(paths: dict[str, Any], base: Path) -> Path | None:
    """The control socket of the block `paths`, relative to a folder; None where the block is wrong."""
    socket, state = paths.get("socket"), paths.get("state", "state")
    if not isinstance(socket, str | None) or not isinstance(state, str):
        return None
    return base / socket if socket is not None else base / state / "palpd.sock"


def _paths_of_environment() -> dict[str, Any]:
    """What the environment says in place of the block `paths`, by the rules of palpd.config. Raises ConfigError."""
    variables = {name.upper(): value for name, value in os.environ.items() if name.upper().startswith("PALPD_PATHS")}
    if not variables:
        return {}
    from palpd.documents import parse_yaml

    block = parse_yaml(variables.get("PALPD_PATHS", "{}"), "environment variable PALPD_PATHS").keys_and_values()
    texts = {key: variables.get(f"PALPD_PATHS__{key.upper()}") for key in ("socket", "state")}
    return {**block, **{key: None if text == "null" else text for key, text in texts.items() if text is not None}}


def _options(arguments: Sequence[str], known: Sequence[str]) -> dict[str, Path] | None:
    """The values of options spelled `--name value` or `--name=value`; None where something else stands among them."""
    options: dict[str, Path] = {}
    rest = list(arguments)
    while rest:
        name, equals, value = rest.pop(0).partition("=")
        if name not in known or not (equals or rest):
            return None
        options[name] = Path(value if equals else rest.pop(0))
    return options
