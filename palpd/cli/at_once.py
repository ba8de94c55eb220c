"""`palpd abort` and `palpd status` without the rest of the command line: an abort must reach the daemon within 0.25 s of the keystroke.

The commands that `--help` shows (service.py) call the same functions; what is not plainly one of their options is left to them.
"""

import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from palpd.cli.last_ticks import print_last_ticks
from palpd.daemon.socket_client import ARM_PATIENCE_S, PATIENCE_S, ask

if TYPE_CHECKING:
    from palpd.daemon.socket_client import ControlAnswer, ControlRequest, JobSummary, ProposedRun

WATCH_EVERY_S = 0.5
"""Pause between two questions of `palpd status --watch`: what a person can read."""
DEFAULT_CONFIG = Path("config.yaml")
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
    """Ask the daemon to stop the arm, and print its answer.

    Args:
        config: config.yaml, which says where the daemon listens.
        socket: Control socket in place of the one of `config`.

    Raises:
        PalpdError: Where no daemon answers, or `config` cannot be read.
    """
    print(speak({"do": "abort"}, config, socket)["state"])


def status(config: Path, socket: Path | None, json_file: Path | None) -> None:
    """Print what the daemon is doing.

    Args:
        config: config.yaml, which says where the daemon listens.
        socket: Control socket in place of the one of `config`.
        json_file: File to write the answer to, if any.

    Raises:
        PalpdError: Where no daemon answers, or a file cannot be read or written.
    """
    answer = speak({"do": "status"}, config, socket)
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
        PalpdError: Where no daemon answers, or `config` cannot be read.
    """
    before: list[str] = []
    while True:
        lines = status_lines(speak({"do": "status"}, config, socket))
        if sys.stdout.isatty():
            print(f"\x1b[{len(before)}F\x1b[J" * bool(before), *(f"{line}\n" for line in lines), sep="", end="", flush=True)
        elif lines != before:
            print(lines[0], flush=True)
        before = lines
        time.sleep(WATCH_EVERY_S)


def status_lines(answer: "ControlAnswer") -> list[str]:
    """Say for people what the daemon answers to `status`.

    Args:
        answer: The answer.

    Returns:
        Lines: what it does now, the latch, the last check of the devices, the last job.
    """
    lines = [position(answer)]
    if answer.get("latched"):
        lines.append(f"The last stop is latched: {answer['latched']}. Leave the tissue with palpd retract, then palpd clear.")
    if answer.get("controls"):
        lines.append(f"{answer['controls']} holds the controls.")
    active = answer.get("active")
    if active:
        lines += [job_line(active), *proposal_lines(active["proposal"])]
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


def job_line(job: "JobSummary") -> str:
    """Say in one line what a job is and how far it is.

    Args:
        job: The job.

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

    Returns:
        The answer of the daemon.

    Raises:
        PalpdError: Where no daemon answers, or it refuses, or `config` cannot be read.
    """
    return ask(socket or control_socket(config), request, ARM_PATIENCE_S if request["do"] == "arm" else PATIENCE_S)


def control_socket(config: Path) -> Path:
    """Where the daemon of that config.yaml listens, read from its `paths` alone; what is not plain there is left to the models."""
    from palpd.files import read_yaml

    content = read_yaml(config).keys_and_values()
    paths = content.get("paths", {})
    plain = isinstance(paths, dict) and all(isinstance(paths.get(key), str | None) for key in ("socket", "state"))
    overridden = any(name.upper().startswith("PALPD_PATHS") for name in os.environ)
    if not plain or overridden or paths.get("state", "state") is None:
        from palpd.config import load_config

        return load_config(config).paths.control_socket
    base, socket = config.resolve().parent, paths.get("socket")
    return base / socket if socket is not None else base / paths.get("state", "state") / "palpd.sock"


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
