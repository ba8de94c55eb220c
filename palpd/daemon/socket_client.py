"""The control socket from outside: requests, answers, and how to ask. Imports nothing large: an abort must not wait for imports."""

import json
import socket
import time
from pathlib import Path
from typing import NotRequired, TypedDict, cast

from palpd.errors import Refused

PATIENCE_S = 5.0
"""Longest wait of either side for the other: both are on the same machine."""
ARM_PATIENCE_S = 60.0
"""Longest wait for `palpd arm`: it checks the devices first, and absent ones take longest to open."""

RETRY_S = 0.005
"""Pause before a request is repeated."""
REPEATABLE = ("abort", "status")
"""Requests that do the same when they are carried out twice. They are repeated until the patience is over."""


class NoDaemon(Refused):
    """Nobody listens at the control socket."""


class ControlRequest(TypedDict):
    """One request: a command, and a plan for `start`. The plan is not validated yet."""

    do: str
    plan: NotRequired[object]


class CheckedCell(TypedDict):
    """The last check of the devices."""

    ready: bool
    reason: str
    date: str


class LastTick(TypedDict):
    """One of the last ticks before a stop. `before_end_s` counts back from the newest tick."""

    before_end_s: float
    phase: str
    force_N: float
    z_m: float
    vz_m_per_s: float
    command_m_per_s: list[float]
    command_stop: bool


class LastRun(TypedDict):
    """How the last run ended; `last_ticks` is filled where it was stopped."""

    verdict: str
    reason: str
    recording: str | None
    notes: list[str]
    last_ticks: list[LastTick]


class ControlAnswer(TypedDict, total=False):
    """The answer to a request: `ok` and what the command answers, or `error` with a sentence. All but `ok` depend on the command."""

    ok: bool
    error: str
    state: str
    latched: str | None
    pid: int
    cell: CheckedCell | None
    job: str
    activity: str
    steps_done: int
    steps: int
    phase: str
    site: int
    force_N: float
    z_m: float
    depth_m: float | None
    tick: int
    last: LastRun


def ask(path: Path, request: ControlRequest, patience_s: float = PATIENCE_S) -> ControlAnswer:
    """Send one request to the daemon and return its answer.

    Args:
        path: The control socket.
        request: The request.
        patience_s: Longest wait for the answer.

    Returns:
        The answer; its `ok` is true.

    Raises:
        NoDaemon: Nobody listens there.
        Refused: The daemon refused, or did not answer.
    """
    until_s = time.monotonic() + patience_s
    while True:
        try:
            answer = json.loads(_exchange(path, json.dumps(request).encode() + b"\n", until_s))
            break
        except PermissionError as error:
            raise Refused(f"you may not connect to the daemon at {path}; join the group that owns the socket") from error
        except (FileNotFoundError, ConnectionRefusedError) as error:
            raise NoDaemon(f"no daemon answers at {path}; start one with palpd serve, or name its socket with --socket") from error
        except (OSError, ValueError) as error:
            if time.monotonic() + RETRY_S < until_s and request["do"] in REPEATABLE:
                time.sleep(RETRY_S)  # the daemon is crowded and had to close this connection
                continue
            if isinstance(error, ValueError):
                raise Refused(f"the daemon at {path} closed the connection without an answer") from error
            raise Refused(f"the daemon at {path} did not answer within {patience_s:g} s ({error})") from error
    if not answer.get("ok"):
        raise Refused(answer.get("error", "the daemon refused without a reason"))
    return cast(ControlAnswer, answer)


def _exchange(path: Path, line: bytes, until_s: float) -> bytes:
    """Send one line, and receive until there is one."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(max(RETRY_S, until_s - time.monotonic()))
        connection.connect(str(path))
        connection.sendall(line)
        received = bytearray()
        while b"\n" not in received:
            chunk = connection.recv(65536)
            if not chunk:
                break
            received += chunk
    return bytes(received)
