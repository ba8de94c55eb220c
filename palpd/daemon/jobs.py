"""The jobs of the service: the one under way with its worker, and the last ones with their results.

Everything here is quick: it reads what a worker has sent, and never waits for it. The service alone starts runs.
"""

import json
import time
from collections import deque
from dataclasses import dataclass, field
from typing import Any, cast

import structlog

from palpd.config import Config
from palpd.daemon.job_worker import ConsentRequest, Finished, RunRequest, Words, WorkerOrder, WorkerProcess
from palpd.daemon.programs import JobProgram
from palpd.daemon.socket_client import ControlAnswer, ControlRequest, JobSummary, ProposedRun
from palpd.daemon.stored_state import now
from palpd.daemon.supervisor import Report, recording_name
from palpd.errors import BadInput, PalpdError, Refused

KEPT_JOBS = 20
"""Number of jobs that are over and still known, with log and result; their files stay on disk."""
KEPT_LINES = 1000
"""Number of lines of a job's log that are kept: the last ones."""
END_S = 20.0
"""Longest time that a program may take to end after its last run was aborted; then its worker is killed, and its result is lost. On a
busy computer a map takes more than 5 s to analyse and draw."""


@dataclass(slots=True)
class JobRecord:
    """One job: who began it and when, how far it is, its log, and how it ended. `result` is JSON."""

    id: str
    program: str
    by: str
    most_runs: int
    begun: str
    state: str = "running"
    activity: str = ""
    runs: int = 0
    log: deque[str] = field(default_factory=lambda: deque(maxlen=KEPT_LINES))
    proposal: ProposedRun | None = None
    proposals: int = 0
    aborted: bool = False
    ended: str | None = None
    verdict: str | None = None
    reason: str = ""
    exit_code: int | None = None
    result: str = "{}"

    @property
    def summary(self) -> JobSummary:
        """All but log and result."""
        return cast(JobSummary, {name: getattr(self, name) for name in JobSummary.__annotations__})

    def answer(self) -> bytes:
        """The whole job as a finished answer of the socket; the result is JSON already."""
        head = json.dumps({"ok": True, **self.summary, "log": list(self.log)})
        return f'{head[:-1]}, "result": {self.result}}}\n'.encode()


class Jobs:
    """The running job, if any, and the last ones. `events` are what watchers have not been sent yet."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self.current: JobRecord | None = None
        self._worker: WorkerProcess | None = None
        self._killed: list[WorkerProcess] = []
        self._runs, self._stopped = False, ""
        self._end_by_s: float | None = None
        self._past: deque[JobRecord] = deque(maxlen=KEPT_JOBS)
        self._events: list[dict[str, object]] = []
        self._log = structlog.get_logger("palpd.jobs")

    # --- what clients ask -------------------------------------------------------------------------------------------------

    def begin(self, program: JobProgram, values: object, by: str) -> JobRecord:
        """Start the worker of a program. It moves nothing before the service starts a run for it.

        Args:
            program: What to carry out.
            values: Its arguments, as a request holds them.
            by: Who asked for it, for people.

        Raises:
            BadInput: The arguments are wrong.
            Refused: This machine starts no process.
        """
        arguments = program.validated(values)
        record = self._recorded(program.name, by, program.most_runs(arguments))
        kept = self._config.paths.runs / f"{record.id}{program.ending}"
        try:
            self._worker = WorkerProcess(WorkerOrder(program.name, arguments.model_dump(), self._config, kept.absolute(), by))
        except OSError as error:
            self.current = None
            raise Refused(f"the worker of the job cannot be started ({error.strerror}){'; nothing was moved' * program.moves}") from error
        self._changed(f"begun, at most {record.most_runs} run{'s' * (record.most_runs != 1)}")
        return record

    def begin_run(self, kind: str, by: str) -> str:
        """Note a job that is a single run without a program, such as that of `palpd start`.

        Args:
            by: Who asked for it, for people.

        Returns:
            The id of the job.
        """
        record = self._recorded(kind, by, 1)
        record.runs, self._runs = 1, True
        self._changed("begun")
        return record.id

    def decide(self, request: ControlRequest) -> ControlAnswer:
        """Pass on the operator's answer to a proposed motion. It names job and number of the proposal, so it counts for no later one.

        Raises:
            Refused: Another motion is proposed, or none.
            BadInput: The answer is neither yes nor no.
        """
        number, agree = request.get("number"), request.get("agree")
        record = self.running(request.get("id"))
        if record.proposal is None or self._worker is None:
            raise Refused(f"the job {record.id} proposes no motion now; see palpd status")
        if number != record.proposal["number"]:
            raise Refused(f"the proposed motion is number {record.proposal['number']}, not {number!r}; look at it again")
        if not isinstance(agree, bool):
            raise BadInput('the answer to a proposed motion has no "agree" that is true or false')
        record.proposal, record.state = None, "running"
        self._worker.answer(agree)
        self._changed("the operator agreed to the motion" if agree else "the operator declined the motion")
        return {"state": record.state}

    def running(self, job_id: object) -> JobRecord:
        """The job under way, if it has that id. Raises Refused."""
        if self.current is None:
            raise Refused("no job is running; see palpd jobs")
        if job_id != self.current.id:
            raise Refused(f"the job that is running is {self.current.id}, not {str(job_id)[:64]!r}; see palpd jobs")
        return self.current

    def known(self, job_id: object) -> JobRecord:
        """The job with that id, running or over. Raises Refused."""
        for record in self.all():
            if record.id == job_id:
                return record
        raise Refused(f"no job {str(job_id)[:64]!r} is known, only the last {KEPT_JOBS} since the service began; see palpd jobs")

    def all(self) -> list[JobRecord]:
        """The running job first, then the others, the newest first."""
        return [*([self.current] if self.current is not None else []), *reversed(self._past)]

    def take_events(self) -> list[dict[str, object]]:
        """What happened since the last call, for watchers."""
        events, self._events = self._events, []
        return events

    # --- what the service does -----------------------------------------------------------------------------------------------

    def hear(self) -> RunRequest | None:
        """Read what the worker has sent. Returns a run that it asks for, or None."""
        self._killed = [worker for worker in self._killed if not worker.gone]
        if self._worker is None or self.current is None:
            return None
        if self._end_by_s is not None and time.monotonic() > self._end_by_s:
            self._end("stopped", f"aborted; the program had not ended {END_S:g} s after its last run", 3)
            return None
        try:
            message = self._worker.hear()
        except PalpdError as error:
            self._end("cancelled" if self.current.aborted else "failed", str(error), 3)
            return None
        match message:
            case RunRequest():
                return message
            case ConsentRequest(motion):
                self._propose(motion)
            case Words(text, activity):
                self._hear_words(text, activity)
            case Finished(verdict, reason, exit_code, result):
                self.current.result = result
                self._end(verdict, reason, exit_code)
            case None:
                pass
        return None

    def note_run(self) -> None:
        """Count a run that the service has started for the job. Raises Refused where the job has announced no more."""
        record = self.current
        assert record is not None
        if record.runs >= record.most_runs:
            raise Refused(f"the job asked for a run more than the {record.most_runs} that it announced; nothing was moved")
        record.runs += 1
        self._runs = True
        self._changed(f"run {record.runs} of at most {record.most_runs}")

    def report(self, report: Report) -> None:
        """Pass on how a run ended, or that it was refused."""
        record, self._runs = self.current, False
        self._stopped = report.reason if report.verdict == "stopped" else ""
        if record is None:
            return
        if self._worker is None:
            record.result = json.dumps({name: report.summary[name] for name in ("recording", "notes", "last_ticks")})
            self._end(report.verdict, report.reason, report.exit_code)
            return
        if record.aborted:
            self._end_by_s = time.monotonic() + END_S
        self._worker.answer(report)

    def abort(self) -> None:
        """End the job. Where a run of it is under way, that is over first: the program hears of it and ends."""
        record = self.current
        if record is None or record.aborted:
            return
        record.aborted = True
        self._changed("aborted")
        if self._worker is not None and not self._runs:
            self._end("cancelled", "aborted while no run was under way; nothing moved", 3)

    def close(self) -> None:
        """The service ends: so does the worker. A run that this has stopped is the end of its job, which alarms tell of."""
        if self.current is not None:
            self._end("stopped" if self._stopped else "cancelled", self._stopped or "the service ended", 3)

    def _recorded(self, program: str, by: str, most_runs: int) -> JobRecord:
        name = recording_name(program)
        taken = {record.id for record in self.all()}
        job_id = next(each for each in (name, *(f"{name}-{number}" for number in range(2, KEPT_JOBS + 3))) if each not in taken)
        self.current = JobRecord(job_id, program, by, most_runs, now())
        self._runs, self._stopped, self._end_by_s = False, "", None
        return self.current

    def _propose(self, motion: dict[str, Any]) -> None:
        record = self.current
        assert record is not None
        record.proposals += 1
        record.proposal, record.state = cast(ProposedRun, {"number": record.proposals, **motion}), "waiting"
        self._changed(f"motion {record.proposals} is proposed and waits for an answer")

    def _hear_words(self, text: str, activity: bool) -> None:
        record = self.current
        assert record is not None
        if activity:
            record.activity = text
        else:
            record.log.append(text)
            self._events.append({"event": "log", "id": record.id, "line": text})

    def _end(self, verdict: str, reason: str, exit_code: int) -> None:
        record, worker = self.current, self._worker
        assert record is not None
        self.current = self._worker = None
        if worker is not None:
            worker.kill()
            self._killed.append(worker)
        record.state = record.verdict = verdict
        record.reason, record.exit_code, record.ended = reason, exit_code, now()
        record.proposal, record.activity = None, ""
        self._past.append(record)
        self._tell(record, f"{verdict}{f': {reason}' if reason else ''}")

    def _changed(self, what: str) -> None:
        assert self.current is not None
        self._tell(self.current, what)

    def _tell(self, record: JobRecord, what: str) -> None:
        self._log.info("job", id=record.id, what=what)
        self._events.append({"event": "job", **record.summary})
