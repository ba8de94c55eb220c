"""The worker of a job: a process that computes, asks the service for runs and consent, and touches no device.

The service must feed its watchdog and serve aborts, so nothing that takes longer than some milliseconds runs in it. A worker speaks in
lines of JSON, which the service reads as they come; what the service answers comes pickled over stdin. The kernel kills the worker
when the service dies.
"""

import contextlib
import json
import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NoReturn

from palpd.config import Config, Plan, parse_plan
from palpd.daemon.display import NoDisplay
from palpd.daemon.finding import Finding
from palpd.daemon.interrupts import shielded
from palpd.daemon.motion_job import Kind
from palpd.daemon.program_host import ProposedMotion
from palpd.daemon.programs import PROGRAMS, ProgramEnd
from palpd.daemon.supervisor import Report
from palpd.documents import finite_json
from palpd.errors import PalpdError, Refused, Stopped
from palpd.workers import beside

MOST_RESULT_BYTES = 1_000_000
"""Longest result that the service keeps: it reads that much in 5 ms. A diagnosis has 0.1 MB; the files of a job may hold more."""
READ_BYTES = 262_144
"""Most that the service reads of a worker at a time."""
PIPE_BYTES = 1_048_576
"""Size of the pipes' buffers: the service writes an order, at most a request of the socket, without waiting for a worker that starts."""
DEATH_S = 0.02
"""Longest wait for the exit code of a worker that has closed its pipe."""
NICENESS = 10
"""A computation must leave the processors to the loop's helpers, which have no real-time priority either."""
EASY_TO_KILL = "500"
"""oom_score_adj of a worker: where memory runs out, the computation goes and the service stays."""


@dataclass(frozen=True, slots=True)
class WorkerOrder:
    """What a worker is to do: a program, its arguments, the configuration, the file or folder that it keeps, and who asked for it."""

    program: str
    arguments: dict[str, Any]
    config: Config
    kept: Path
    by: str


@dataclass(frozen=True, slots=True)
class RunRequest:
    """The program asks for a run and waits for its report."""

    kind: Kind
    plan: Plan
    recording: Path | None
    take_reference: bool
    watch_s: float = 0.0
    here: bool = False


@dataclass(frozen=True, slots=True)
class ConsentRequest:
    """The program proposes a motion and waits for the operator; the keys are those of ProposedMotion."""

    motion: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Words:
    """A sentence for the job's log, or what the program computes now (`activity`)."""

    text: str
    activity: bool


@dataclass(frozen=True, slots=True)
class Finished:
    """The program has ended; `result` is its figures as JSON, turned into text by the worker."""

    verdict: str
    reason: str
    exit_code: int
    result: str


Message = RunRequest | ConsentRequest | Words | Finished


class WorkerProcess:
    """A worker as the service sees it. `hear` never waits for it."""

    def __init__(self, order: WorkerOrder) -> None:
        with shielded():
            self._process = subprocess.Popen(
                beside("palpd.daemon.job_worker"),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                pipesize=PIPE_BYTES,
                env={**os.environ, "OMP_NUM_THREADS": "1"},
            )
        assert self._process.stdout is not None
        self._output = self._process.stdout.fileno()
        os.set_blocking(self._output, False)
        self._received = bytearray()
        self.answer(order)

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def gone(self) -> bool:
        """Whether it has ended, so that the kernel keeps nothing of it."""
        return self._process.poll() is not None

    def hear(self) -> Message | None:
        """The next message, if a whole one has come.

        Raises:
            Stopped: The worker has died, or says what is no message.
        """
        if b"\n" not in self._received:
            try:
                piece = os.read(self._output, READ_BYTES)
            except BlockingIOError:
                return None
            if not piece:
                raise Stopped(f"the worker of the job {self._death()}")
            self._received += piece
        line, newline, rest = self._received.partition(b"\n")
        if not newline:
            return None
        self._received = rest
        try:
            return _message_of(json.loads(line))
        except (ValueError, KeyError, TypeError) as error:
            raise Stopped(f"the worker of the job sent no message of its own ({type(error).__name__}: {error})") from error

    def answer(self, thing: "WorkerOrder | Report | bool") -> None:
        """Send what the worker waits for. It fits the pipe's buffer, so nothing waits here."""
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):  # it has died; `hear` says so
            self._process.stdin.write(pickle.dumps(thing))
            self._process.stdin.flush()

    def kill(self) -> None:
        """End it now, whatever it computes, without waiting for its end."""
        self._process.kill()
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                with contextlib.suppress(OSError):
                    stream.close()

    def _death(self) -> str:
        try:
            code = self._process.wait(DEATH_S)
        except subprocess.TimeoutExpired:
            return "closed its pipe"
        return f"ended by signal {-code}" if code < 0 else f"ended with code {code}"


def _message_of(values: dict[str, Any]) -> Message:
    kind = values.pop("message")
    if kind == "run":
        path = values["recording"]
        plan = parse_plan(values["plan"], "the plan of the job")
        recording, watch_s = Path(path) if path is not None else None, float(values["watch_s"])
        return RunRequest(values["kind"], plan, recording, bool(values["take_reference"]), watch_s, bool(values["here"]))
    if kind == "consent":
        return ConsentRequest(values["motion"])
    if kind == "words":
        return Words(str(values["text"]), bool(values["activity"]))
    return Finished(str(values["verdict"]), str(values["reason"]), int(values["exit_code"]), str(values["result"]))


# --- in the worker ------------------------------------------------------------------------------------------------------------


class _Lines:
    """Writes messages to the service. Whatever prints to stdout prints to the service's log instead."""

    def __init__(self) -> None:
        self._output = os.dup(1)
        os.dup2(2, 1)

    def send(self, message: str, **values: object) -> None:
        line = json.dumps({"message": message, **values}).encode() + b"\n"
        while line:
            line = line[os.write(self._output, line) :]


class _WorkerDisplay(NoDisplay):
    """Turns sentences and activities into messages. How far a run is, the service sees itself."""

    def __init__(self, lines: _Lines) -> None:
        self._lines = lines

    def say(self, sentence: str) -> None:
        """Send one sentence for the log."""
        self._lines.send("words", text=sentence, activity=False)

    @contextmanager
    def waiting(self, activity: str) -> Iterator[None]:
        """Send what is computed now."""
        self._lines.send("words", text=activity, activity=True)
        yield
        self._lines.send("words", text="", activity=True)


@dataclass(frozen=True, slots=True)
class _WorkerHost:
    """The host of a program in a worker: passes everything on to the service."""

    config: Config
    display: _WorkerDisplay
    lines: _Lines
    operator: str

    def carry_out(self, kind: Kind, plan: Plan, recording: Path | None = None, take_reference: bool = False, here: bool = False) -> Report:
        """Ask the service for the run, and wait for its report."""
        return self._asked(kind, plan, str(recording) if recording is not None else None, take_reference, here=here)

    def observe(self, watch_s: float) -> tuple[Finding, ...]:
        """Ask the service to read the devices."""
        report = self._asked("observe", Plan(), watch_s=watch_s)
        if report.exit_code:
            raise Stopped(report.reason)
        return report.findings

    def _asked(
        self,
        kind: Kind,
        plan: Plan,
        recording: str | None = None,
        take_reference: bool = False,
        watch_s: float = 0.0,
        here: bool = False,
    ) -> Report:
        values = plan.model_dump(mode="json")
        self.lines.send("run", kind=kind, plan=values, recording=recording, take_reference=take_reference, watch_s=watch_s, here=here)
        report: Report = pickle.load(sys.stdin.buffer)
        if report.exit_code == 2:
            raise Refused(report.reason)
        return report

    def approve(self, motion: ProposedMotion) -> bool:
        """Ask whoever holds the service's controls."""
        self.lines.send("consent", motion=asdict(motion))
        return bool(pickle.load(sys.stdin.buffer))


def carried_out(host: _WorkerHost, order: WorkerOrder) -> ProgramEnd:
    """Carry out a program.

    Args:
        host: Passes its wishes on.

    Returns:
        How it ended; an error is an end too.
    """
    program = PROGRAMS[order.program]
    try:
        return program.carry_out(host, program.validated(order.arguments), order.kept)
    except PalpdError as error:
        return ProgramEnd("refused" if error.exit_code == 2 else "stopped", str(error), error.exit_code)
    except Exception as error:  # a defect of ours must reach the operator as a sentence
        return ProgramEnd("failed", f"the job failed ({type(error).__name__}: {error}); its log may say more", 3)


def main() -> NoReturn:
    """Run a worker as `WorkerProcess` starts it."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):  # these reach all of palpd; the service ends its worker
        signal.signal(number, signal.SIG_IGN)
    os.nice(NICENESS)
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(EASY_TO_KILL)
    lines = _Lines()
    order: WorkerOrder = pickle.load(sys.stdin.buffer)
    end = carried_out(_WorkerHost(order.config, _WorkerDisplay(lines), lines, order.by), order)
    reason, result = end.reason, json.dumps(finite_json(end.figures), default=str)
    if len(result) > MOST_RESULT_BYTES:
        reason, result = f"{reason} (the result is too long for the service's memory; see the files of the job)".strip(), "{}"
    lines.send("finished", verdict=end.verdict, reason=reason, exit_code=end.exit_code, result=result)
    os._exit(0)


if __name__ == "__main__":
    main()
