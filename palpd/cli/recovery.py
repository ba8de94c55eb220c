"""`palpd recover-robot`: follow what the service says after a stop of the robot, and ask the operator to acknowledge and to arm.

It opens no connection to the robot while a service answers. Alone it reads the controller as the service does, and commands nothing.
"""

import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from getpass import getuser
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from palpd.cli import at_once
from palpd.daemon.socket_client import ARM_PATIENCE_S, ControlAnswer, ask

if TYPE_CHECKING:
    from palpd.config import Config
    from palpd.daemon.socket_client import ControlRequest

EVERY_S = 0.2
"""Pause between two questions: what a person can follow."""
ASKS: Mapping[str, str] = {
    "clear": "Have you looked at the cell? Acknowledge the stop",
    "arm": "Arm, so that the next start may move the arm",
}
"""The two questions to the operator, by what a yes asks of the service."""
BUSY = ("running", "paused", "waiting")
"""States in which an operator has begun something, such as the retract that was offered."""


@dataclass(frozen=True, slots=True)
class RecoveryEnd:
    """How the recovery ended: exit code 0 where the robot is ready, else 2 with the sentence. `answer` is the last that was heard."""

    exit_code: int
    reason: str = ""
    answer: ControlAnswer | dict[str, Any] = field(default_factory=dict)


def recovered(path: Path) -> RecoveryEnd:
    """Follow the service until it is armed, or the operator says no.

    Args:
        path: The control socket.

    Returns:
        How it ended.

    Raises:
        NoDaemon: No service answers.
        Refused: The service refuses what the operator agreed to.
    """
    answer = ask(path, {"do": "status"})
    if answer["now"]["state"] in BUSY:
        return RecoveryEnd(2, f"{answer['now']['sentence'].removesuffix('.')}; wait for its end, or palpd abort", answer)
    if answer["state"] == "disarmed" and answer["now"]["stop"] is None:
        print("Robot and sensor are looked at, which moves nothing.", flush=True)
        ask(path, {"do": "check"}, ARM_PATIENCE_S)
    shown = ""
    while True:
        answer = ask(path, {"do": "status"})
        now = answer["now"]
        following = now["next"] or ""
        lines = now["word"] if now["state"] in BUSY else f"{now['word']}: {' '.join(at_once.now_lines(now))}"
        if lines != shown:
            done = f" Done when {now['stop']['done']}." if now["stop"] is not None else ""
            print(f"{lines}{done}", flush=True)
            shown = lines
        if now["state"] == "armed":
            return RecoveryEnd(0, answer=answer)
        if not sys.stdin.isatty() and now["state"] != "checking":
            ready = now["state"] == "disarmed"
            return RecoveryEnd(0 if ready else 2, "" if ready else f"the robot is not ready: {now['sentence']}", answer)
        if following in ASKS:
            if not typer.confirm(ASKS[following] + "?"):
                print(f"Nothing was changed; {at_once.NEXT[following]} does it later.")
                return RecoveryEnd(0, answer=answer)
            ask(path, _request(following, now["cause"]), ARM_PATIENCE_S)
        time.sleep(EVERY_S)


def _request(following: str, cause_asked: str | None) -> "ControlRequest":
    """What a yes asks of the service; the cause of a protective stop is asked for where it must be written down."""
    if following == "clear" and cause_asked is not None:
        return {"do": "clear", "cause": typer.prompt("What was the cause")}
    return {"do": following}


def cleared_alone(config: "Config", cause: str | None) -> None:
    """Clear the latch where no service answers, by the rules of the service.

    Args:
        config: Configuration of the cell.
        cause: What caused the last protective stop, where the operator states it.

    Raises:
        Refused: A contact is unfinished, or the cause of a protective stop must be written down.
    """
    from palpd.daemon.known_cell import KnownCell
    from palpd.daemon.stored_state import State
    from palpd.errors import Refused

    known = KnownCell(State(config.paths.state))
    if known.unfinished:
        raise Refused("a contact is unfinished; palpd retract leaves the tissue, or palpd level-test shows a free probe, then palpd clear")
    known.clear(cause, getuser())


def recovered_alone(config: "Config") -> RecoveryEnd:
    """Follow the controller itself until the arm may move, where no service reads it, and ask for a cause that must be written down.

    Args:
        config: Configuration of the cell.

    Returns:
        How it ended.

    Raises:
        PalpdError: The cause cannot be written down.
    """
    from palpd.daemon.controller_watch import ControllerWatch
    from palpd.daemon.known_cell import KnownCell
    from palpd.daemon.stored_state import State
    from palpd.daemon.what_now import Standing, known_stop, what_now
    from palpd.daemon.wiring import open_controller

    print("No service answers, so the controller is read from here; nothing is commanded.", flush=True)
    known, watch, shown = KnownCell(State(config.paths.state)), ControllerWatch(config, open_controller), ""
    watch.begin()
    try:
        while watch.seen is None or watch.stop is not None:
            if watch.seen is not None and watch.stop is not None:
                now = what_now(Standing(stop=watch.stop, stop_reason=watch.seen.reason))
                known.see_controller(watch.seen)
                if now.sentence != shown:
                    print(f"{now.word}: {now.sentence}", flush=True)
                    shown = now.sentence
                if not sys.stdin.isatty():
                    return RecoveryEnd(2, f"the robot is not ready: {now.sentence}", {"stop": known_stop(watch.stop)})
            time.sleep(EVERY_S)
            watch.poll()
        known.see_controller(watch.seen)
    finally:
        watch.end()
    if asked := known.protective_stops.cause_asked:
        print(f"{asked[:1].upper()}{asked[1:]}.")
        if not sys.stdin.isatty():
            return RecoveryEnd(2, f"{asked}; palpd recover-robot asks for it in a terminal", {"stop": None})
        known.write_cause(typer.prompt("What was the cause"), getuser())
    print("The arm may move again. Next: palpd retract where the probe is in the tissue, else palpd run.")
    return RecoveryEnd(0, answer={"stop": None})
