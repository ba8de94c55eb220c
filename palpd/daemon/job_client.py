"""A program as a job of the service, seen from a command: take the controls, arm, begin, show what happens, answer proposals.

A command that ends before its job, by a signal or an error, cancels the job.
"""

import contextlib
import getpass
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from palpd.daemon.display import Display, JobProgress, ShowProgress
from palpd.daemon.program_host import ProposedMotion
from palpd.daemon.programs import ProgramEnd, program_named
from palpd.daemon.session import motion_sentence
from palpd.daemon.socket_client import ARM_PATIENCE_S, ControlAnswer, NoDaemon, ask, watched
from palpd.errors import PalpdError, Refused

ASK_EVERY_S = 0.2
"""Pause between two questions about a job: what a person can follow."""
RENEW_S = 3.0
"""Pause between two renewals of the lease: a third of the time that the service waits."""


def service_at(path: Path) -> bool:
    """Whether a daemon answers at that control socket. Raises Refused where it must not be asked."""
    try:
        ask(path, {"do": "status"})
    except NoDaemon:
        return False
    return True


def carried_out_by_service(
    path: Path, name: str, arguments: Mapping[str, object], display: Display, agree: Callable[[str], bool]
) -> ProgramEnd:
    """Carry out a program as a job of the service.

    Args:
        path: The control socket.
        display: Shows the log and the progress of each run.
        agree: Asks whoever sits at the terminal.

    Returns:
        How the program ended.

    Raises:
        Refused: The service refuses, or somebody else holds its controls.
    """
    program = program_named(name)
    program.validated(dict(arguments))  # before anything is armed for it
    with controls(path, f"{getpass.getuser()} with palpd {name}") as lease, watched(path) as events:
        _wait_for_check(events)
        if program.moves and program.command_arms:
            ask(path, {"do": "arm", "lease": lease}, ARM_PATIENCE_S)
        begun = ask(path, {"do": "begin", "program": name, "arguments": dict(arguments), "lease": lease})
        job_id = begun["id"]
        try:
            display.say(f"Job {job_id} of the service makes at most {begun['most_runs']} run{'s' * (begun['most_runs'] != 1)}.")
            _follow(path, job_id, events, display, agree, lease)
        except BaseException:
            with contextlib.suppress(PalpdError):
                ask(path, {"do": "cancel", "id": job_id})
            raise
        return _end_of(ask(path, {"do": "job", "id": job_id}))


def awaited(path: Path, job_id: str, display: Display) -> ControlAnswer:
    """Wait for the end of a job that is a single run, and show how far it is. It asks again and again, so it needs no place of a watcher.

    Args:
        path: The control socket.
        display: Shows the progress.

    Returns:
        The job that has ended.

    Raises:
        Refused: The service refuses, or is gone.
    """
    try:
        with display.job(1) as show:
            while (job := ask(path, {"do": "job", "id": job_id}))["ended"] is None:
                now = ask(path, {"do": "status"})
                if "force_N" in now:
                    show(JobProgress(now["activity"], now["steps_done"], now["force_N"], now["z_m"]))
                time.sleep(ASK_EVERY_S)
    except BaseException:
        with contextlib.suppress(PalpdError):
            ask(path, {"do": "cancel", "id": job_id})
        raise
    return job


@contextmanager
def controls(path: Path, name: str, force: bool = False) -> Iterator[str]:
    """Hold the service's controls within the context.

    Args:
        path: The control socket.
        name: Who holds them, for people.
        force: Whether to take them from somebody else.

    Yields:
        The lease, which requests must show.
    """
    lease = ask(path, {"do": "take", "name": name[:64], "force": force})["lease"]
    over = threading.Event()

    def renew() -> None:
        while not over.wait(RENEW_S):
            with contextlib.suppress(PalpdError):  # who needs the lease then learns that it has ended, and why
                ask(path, {"do": "renew", "lease": lease})

    thread = threading.Thread(target=renew, daemon=True)
    thread.start()
    try:
        yield lease
    finally:
        over.set()
        with contextlib.suppress(PalpdError):
            ask(path, {"do": "release", "lease": lease})


def _wait_for_check(events: Iterator[dict[str, Any]]) -> None:
    """Wait until the service does not check its devices any more, as it does when it begins."""
    for event in events:
        if event.get("event") == "status" and event["state"] != "checking":
            return


def _follow(path: Path, job_id: str, events: Iterator[dict[str, Any]], display: Display, agree: Callable[[str], bool], lease: str) -> None:
    """Show what happens until the job is over."""
    with ExitStack() as shown:
        bar: ShowProgress | None = None
        activity: str = ""
        for event in events:
            kind = event.get("event")
            if kind == "log" and event["id"] == job_id:
                display.say(event["line"])
            elif kind == "job" and event["id"] == job_id:
                if event["ended"] is not None:
                    return
                if event["proposal"] is not None:
                    shown.close()
                    bar = None
                    _answer(path, job_id, event["proposal"], display, agree, lease)
            elif kind == "status" and event.get("steps") is not None:
                if bar is None:
                    shown.close()
                    bar = shown.enter_context(display.job(event["steps"]))
                bar(JobProgress(event["activity"], event["steps_done"], event["force_N"], event["z_m"]))
            elif kind == "status" and "job" not in event:
                now = event["active"]["activity"] if event["active"] else ""
                if bar is not None or now != activity:
                    shown.close()
                    bar, activity = None, now
                    if now:
                        shown.enter_context(display.waiting(now))


def _answer(path: Path, job_id: str, proposal: dict[str, Any], display: Display, agree: Callable[[str], bool], lease: str) -> None:
    """Ask the operator for consent to a proposed motion, and pass the answer on."""
    motion = ProposedMotion(**{name: value for name, value in proposal.items() if name != "number"})
    display.say(motion_sentence(motion))
    answer = agree("Record it?")
    try:
        ask(path, {"do": "decide", "id": job_id, "number": proposal["number"], "agree": answer, "lease": lease})
    except Refused as refused:  # somebody took the controls by force, and answered
        display.say(f"  your answer did not count: {refused}")


def _end_of(answer: ControlAnswer) -> ProgramEnd:
    end = ProgramEnd(answer["verdict"], answer["reason"], answer["exit_code"], answer["result"])
    if end.exit_code == 2:
        raise Refused(end.reason)
    return end
