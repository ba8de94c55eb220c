"""The control socket from outside: requests, answers, and how to ask. Imports nothing large: an abort must not wait for imports."""

import json
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NotRequired, TypedDict, cast

from palpd.errors import Refused

if TYPE_CHECKING:
    import threading

PATIENCE_S = 5.0
"""Longest wait of either side for the other: both are on the same machine."""
ARM_PATIENCE_S = 60.0
"""Longest wait for `palpd arm`: it checks the devices first, and absent ones take longest to open."""

QUIET_S = 0.5
"""Longest wait of a watcher for an event before it may do something else."""
RETRY_S = 0.005
"""Pause before a request is repeated."""
SILENT_PATIENCE_S = 1.0
"""Longest wait for the answer of a daemon that has published nothing for a while."""
REPEATABLE = ("abort", "status")
"""Requests that do the same when they are carried out twice. They are repeated until the patience is over."""

NOBODY = "no daemon answers at {path}; start one with palpd serve, or name its socket with --socket"
NOBODY_TO_STOP = "no daemon answers at {path}, so nothing was stopped; if the arm moves, use the emergency stop"


class NoAnswer(Refused):
    """The daemon did not say this: it could not be reached, or has not answered."""


class NoDaemon(NoAnswer):
    """Nobody listens at the control socket."""


class ControlRequest(TypedDict):
    """One request: a command and what belongs to it; docs/jobs.md lists them. Nothing of it is validated yet."""

    do: str
    lease: NotRequired[object]
    plan: NotRequired[object]
    place: NotRequired[object]
    name: NotRequired[object]
    force: NotRequired[object]
    program: NotRequired[object]
    arguments: NotRequired[object]
    id: NotRequired[object]
    number: NotRequired[object]
    agree: NotRequired[object]
    was: NotRequired[object]
    cause: NotRequired[object]
    rehearsal: NotRequired[object]


class CheckedCell(TypedDict):
    """The last check of the devices."""

    ready: bool
    reason: str
    date: str


class KnownProbe(TypedDict):
    """Whether the probe is free, pressed or unknown, why, what that allows, what to do, and when that was judged."""

    state: str
    reasons: list[str]
    ways: list[str]
    advice: str
    date: str


class KnownPlace(TypedDict):
    """Where the tip was last seen, in base axes, and the site of the last plan under it.

    `origin_m` is where the sites of the last palpation count from, `unfinished` its name where it did not end at its start.
    """

    x_m: float | None
    y_m: float | None
    site: str | None
    origin_m: list[float] | None
    unfinished: str | None


class KnownObstacle(TypedDict):
    """Why a button is impossible now, and the button that leads out."""

    reason: str
    way: str | None


class KnownStop(TypedDict):
    """What the controller says where the arm may not move, the next step at the pendant, and how it is seen to be done."""

    name: str
    says: str
    step: str
    done: str


class KnownProtectiveStop(TypedDict):
    """A protective stop: when it was seen, when it was over, and its cause as an operator wrote it down."""

    date: str
    over: str
    cause: str
    by: str
    written: str


class KnownNow(TypedDict):
    """What stands: `state` for programs, `word` and `sentence` for people; what is sensible `next`, and why the rest is impossible.

    `question` says why a start must answer first where its sites count from, `cause` why a clear must write down a cause. `stop` is what
    the controller says.
    """

    state: str
    word: str
    sentence: str
    next: str | None
    obstacles: dict[str, KnownObstacle]
    question: str | None
    cause: str | None
    stop: KnownStop | None


class ForceLimits(TypedDict):
    """The guard's limits as the service read them when it began: on the compensated force, and on the raw one."""

    contact_N: float
    absolute_N: float


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


class ProposedRun(TypedDict):
    """A motion of a job that waits for the operator: `number` counts the proposals of the job, the others are those of ProposedMotion."""

    number: int
    gap: str
    decides: str
    duration_s: float
    expected_peak_N: float
    limit_N: float
    plan: dict[str, Any]


class JobSummary(TypedDict):
    """A job without log and result. `state` is running, waiting (for consent to `proposal`), or the verdict of a job that is over.

    `aborted` says that a client asked for its end.
    """

    id: str
    program: str
    by: str
    begun: str
    state: str
    activity: str
    runs: int
    most_runs: int
    proposal: ProposedRun | None
    aborted: bool
    ended: str | None
    verdict: str | None
    reason: str
    exit_code: int | None


class KeptPlan(TypedDict):
    """A plan that the service keeps: who kept it when, the hash of its text, and what its rehearsal gave, if there was one."""

    name: str
    sha256: str
    by: str
    kept: str
    rehearsal: dict[str, Any] | None


class ControlAnswer(TypedDict, total=False):
    """The answer to a request: `ok` and what the command answers, or `error` with a sentence. All but `ok` depend on the command."""

    ok: bool
    error: str
    unreached: bool
    event: str
    state: str
    latched: str | None
    pid: int
    cell: CheckedCell | None
    now: KnownNow
    probe: KnownProbe | None
    place: KnownPlace | None
    job: str
    activity: str
    steps_done: int
    steps: int
    left_s: float | None
    phase: str
    site: int
    force_N: float
    z_m: float
    depth_m: float | None
    tick: int
    last: LastRun
    protective: list[KnownProtectiveStop]
    controls: str | None
    ring: str
    active: JobSummary | None
    limits: ForceLimits
    recording: str | None
    jobs: list[JobSummary]
    lease: str
    lease_s: float
    id: str
    most_runs: int
    proposal: ProposedRun | None
    log: list[str]
    result: dict[str, Any]
    exit_code: int
    verdict: str
    reason: str
    ended: str | None
    plans: list[KeptPlan]
    yaml: str
    way_back: str


def ask(path: Path, request: ControlRequest, patience_s: float = PATIENCE_S) -> ControlAnswer:
    """Send one request to the daemon and return its answer.

    Args:
        path: The control socket.
        patience_s: Longest wait for the answer.

    Returns:
        The answer; its `ok` is true.

    Raises:
        NoDaemon: Nobody listens there.
        NoAnswer: It did not answer.
        Refused: The daemon refused.
    """
    until_s = time.monotonic() + patience_s
    way_out = "; if the arm moves, use the emergency stop" if request["do"] == "abort" else ""
    while True:
        try:
            answer = json.loads(_exchange(path, json.dumps(request).encode() + b"\n", until_s))
            break
        except PermissionError as error:
            raise NoAnswer(f"you may not connect to the daemon at {path}; join the group that owns the socket{way_out}") from error
        except (FileNotFoundError, ConnectionRefusedError) as error:
            raise NoDaemon((NOBODY_TO_STOP if way_out else NOBODY).format(path=path)) from error
        except (OSError, ValueError) as error:
            if time.monotonic() + RETRY_S < until_s and request["do"] in REPEATABLE:
                time.sleep(RETRY_S)  # the daemon is crowded and had to close this connection
                continue
            if isinstance(error, ValueError):
                raise NoAnswer(f"the daemon at {path} closed the connection without an answer{way_out}") from error
            raise NoAnswer(f"the daemon at {path} did not answer within {patience_s:g} s ({error}){way_out}") from error
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


@contextmanager
def watched(path: Path) -> Iterator[Iterator[dict[str, Any]]]:
    """Receive within the context what the daemon publishes.

    Args:
        path: The control socket.

    Yields:
        Events as docs/jobs.md lists them, the status first. An empty one comes where nothing happened for `QUIET_S`.

    Raises:
        NoDaemon: Nobody listens there.
        Refused: The daemon lets nobody watch, or it ended.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(PATIENCE_S)
        try:
            connection.connect(str(path))
            connection.sendall(b'{"do": "watch"}\n')
        except (FileNotFoundError, ConnectionRefusedError) as error:
            raise NoDaemon(NOBODY.format(path=path)) from error
        except OSError as error:
            raise Refused(f"the daemon at {path} cannot be watched ({error})") from error
        connection.settimeout(QUIET_S)
        yield _events(connection, path)


def follow(path: Path, publish: Callable[[dict[str, Any]], None], over: "threading.Event", again_s: float) -> None:
    """Pass on what the daemon publishes, and seek it again whenever it goes; for a thread of its own.

    Args:
        path: The control socket.
        publish: Takes each event of docs/jobs.md, and `{"event": "lost", "reason": sentence}` where nobody answers.
        over: Ends it when it is set.
        again_s: Pause before a lost daemon is sought again.
    """
    while not over.is_set():
        try:
            ask(path, {"do": "status"}, SILENT_PATIENCE_S)  # NoDaemon says more than a watcher learns
            with watched(path) as events:
                for event in events:
                    if over.is_set():
                        return
                    if "event" in event:
                        publish(event)
                    else:  # silent for a while: does it still live?
                        ask(path, {"do": "status"}, SILENT_PATIENCE_S)
        except Refused as refused:
            publish({"event": "lost", "reason": str(refused)})
        except Exception as error:  # whatever a foreign program answers there, the daemon is sought again
            publish({"event": "lost", "reason": f"what answers at {path} does not speak as palpd does ({type(error).__name__})"})
        over.wait(again_s)


def _events(connection: socket.socket, path: Path) -> Iterator[dict[str, Any]]:
    received = bytearray()
    while True:
        line, newline, rest = received.partition(b"\n")
        if newline:
            received = rest
            event = json.loads(line)
            if event.get("ok") is False:
                raise Refused(event["error"])
            yield event
            continue
        try:
            piece = connection.recv(65536)
        except TimeoutError:
            yield {}
            continue
        except OSError:
            piece = b""
        if not piece:
            raise Refused(f"the daemon at {path} has ended, or dropped this watcher; palpd status says more")
        received += piece
