"""Jobs of the service without devices and without processes: the worker and the runs are scripted."""

import json
import re
import shutil
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from palpd.config import Config, Plan, parse_config
from palpd.daemon.control_socket import Later, Watching
from palpd.daemon.controls import LEASE_S
from palpd.daemon.job_worker import ConsentRequest, Finished, RunRequest, Words, WorkerOrder
from palpd.daemon.programs import PROGRAMS, program_named
from palpd.daemon.service import Service
from palpd.daemon.stored_state import Calibration, Latch, State
from palpd.daemon.supervisor import Report
from palpd.errors import BadInput, Stopped
from palpd.tick import Request
from tests.daemon.test_service import PLAN, ScriptedRun
from tests.paths import ROOT

OLD_RECORDING = ROOT / "tests" / "version_1" / "recording.mcap"
MOTION = {"gap": "fz", "decides": "gain or modulus", "duration_s": 20.0, "expected_peak_N": 4.0, "limit_N": 12.0, "plan": {}}
PRESS = RunRequest("palpation", Plan(), None, True)


class ScriptedWorker:
    """Says what the test puts into `says`, and keeps what it is answered."""

    newest: "ScriptedWorker"

    def __init__(self, order: WorkerOrder) -> None:
        self.order, self.says, self.answers, self.killed = order, deque[Any](), [], False
        ScriptedWorker.newest = self

    def hear(self) -> Any:
        if not self.says:
            return None
        message = self.says.popleft()
        if isinstance(message, Exception):
            raise message
        return message

    def answer(self, thing: Any) -> None:
        self.answers.append(thing)

    def kill(self) -> None:
        self.killed = True

    @property
    def gone(self) -> bool:
        return self.killed


@pytest.fixture
def service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Service]:
    monkeypatch.setattr("palpd.daemon.run_under_way.JobRun", ScriptedRun)
    monkeypatch.setattr("palpd.daemon.jobs.WorkerProcess", ScriptedWorker)
    config: Config = parse_config({"paths": {"state": str(tmp_path / "state"), "runs": str(tmp_path / "runs")}}, "the test's configuration")
    State(config.paths.state).keep("calibration", Calibration((0.0,) * 6, "2026-01-01", None))
    service = Service(config, lambda *_: pytest.fail("nothing is opened here"))
    yield service
    service._ring.close()


def do(service: Service, what: str, **more: Any) -> dict[str, Any]:
    """The answer to a request, a sentence in `error` where it is refused."""
    answer = service.answer({"do": what, **more})  # type: ignore[typeddict-item]
    if isinstance(answer, bytes):
        return dict(json.loads(answer))
    assert isinstance(answer, dict)
    return dict(answer)


def over(service: Service, report: Report) -> None:
    """The run under way ends so."""
    service._run.current.ends_with = report  # type: ignore[union-attr]
    service._poll_run()


def arm(service: Service) -> None:
    later = service.answer({"do": "arm"})
    over(service, Report("done"))
    assert isinstance(later, Later)
    assert later.answer == {"ok": True, "state": "armed"}


def begun(service: Service, program: str = "resolve", **arguments: Any) -> tuple[str, ScriptedWorker]:
    arm(service)
    answer = do(service, "begin", program=program, arguments=arguments)
    assert answer["ok"], answer
    return answer["id"], ScriptedWorker.newest


def hears(service: Service, worker: ScriptedWorker, *messages: Any) -> None:
    worker.says.extend(messages)
    for _ in messages:
        service._poll_job()


def test_what_moves_needs_arming_and_a_calibration_does_not(service: Service) -> None:
    for program in ("free-motion", "stiffness", "map", "resolve"):
        assert "disarmed" in do(service, "begin", program=program)["error"]
    assert do(service, "begin", program="calibrate")["ok"]


@pytest.mark.parametrize(
    ("request_", "sentence"),
    [
        ({"program": "dance"}, "is no program; expected one of calibrate, free-motion, stiffness, map, resolve, doctor"),
        ({"program": "maps"}, "did you mean 'map'?"),
        ({"program": 3}, "is no program"),
        ({"program": "map", "arguments": {"width_m": 60}}, "width_m is 60"),
        ({"program": "map", "arguments": {"widht_m": 0.06}}, "there is no key 'widht_m' (did you mean 'width_m'?)"),
        ({"program": "map", "arguments": [1]}, "expected keys and values"),
    ],
)
def test_a_wrong_job_is_refused_in_one_sentence_and_leaves_it_armed(service: Service, request_: dict[str, Any], sentence: str) -> None:
    arm(service)
    assert sentence in do(service, "begin", **request_)["error"]
    assert do(service, "status")["state"] == "armed"
    assert do(service, "jobs")["jobs"] == []


def test_a_job_says_how_many_runs_it_may_make_and_gets_no_more(service: Service) -> None:
    job_id, worker = begun(service, "map", most_presses=2)
    assert do(service, "job", id=job_id)["most_runs"] == 2
    for number in (1, 2):
        hears(service, worker, PRESS)
        assert service._run.current is not None
        assert do(service, "status")["active"]["runs"] == number
        over(service, Report("done"))
        assert worker.answers[-1] == Report("done")
    hears(service, worker, PRESS)
    assert service._run.current is None
    assert "a run more than the 2 that it announced" in worker.answers[-1].reason


def test_a_program_ends_with_its_result_and_its_log_is_kept(service: Service) -> None:
    job_id, worker = begun(service, "map")
    hears(service, worker, Words("fitting", True))
    assert do(service, "status")["active"]["activity"] == "fitting"
    hears(service, worker, Words("  1  (5, 5) mm", False), Finished("done", "", 0, '{"presses": 1}'))
    job = do(service, "job", id=job_id)
    assert (job["verdict"], job["log"], job["result"]) == ("done", ["  1  (5, 5) mm"], {"presses": 1})
    assert worker.killed
    assert do(service, "status")["state"] == "disarmed"
    assert do(service, "jobs")["jobs"][0]["id"] == job_id


def test_a_machine_that_starts_no_process_refuses_the_job_and_the_service_goes_on(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: WorkerOrder) -> None:
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr("palpd.daemon.jobs.WorkerProcess", full)
    assert "cannot be started (Resource temporarily unavailable)" in do(service, "begin", program="calibrate")["error"]
    assert do(service, "status")["state"] == "disarmed"
    assert do(service, "jobs")["jobs"] == []


def test_two_jobs_of_one_second_have_two_names(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("palpd.daemon.jobs.recording_name", lambda program: f"now-{program}")
    for expected in ("now-calibrate", "now-calibrate-2", "now-calibrate-3"):
        assert do(service, "begin", program="calibrate")["id"] == expected
        hears(service, ScriptedWorker.newest, Finished("done", "", 0, "{}"))


def test_only_the_last_jobs_are_kept(service: Service) -> None:
    first = do(service, "begin", program="calibrate")["id"]
    hears(service, ScriptedWorker.newest, Finished("done", "", 0, "{}"))
    for _ in range(20):
        do(service, "begin", program="calibrate")
        hears(service, ScriptedWorker.newest, Finished("done", "", 0, "{}"))
    assert "only the last 20" in do(service, "job", id=first)["error"]


def test_nothing_else_begins_while_a_job_runs_also_between_its_runs(service: Service) -> None:
    job_id, _ = begun(service)
    for what in ("arm", "start", "retract", "clear", "begin"):
        assert job_id in do(service, what, plan=PLAN, program="calibrate")["error"]


def test_a_stop_by_the_guard_ends_the_runs_of_the_job(service: Service) -> None:
    _, worker = begun(service, "map")
    hears(service, worker, PRESS)
    service._state.keep("latch", Latch("the lateral force was 9 N", "now"))
    over(service, Report("stopped", "the lateral force was 9 N", 3))
    hears(service, worker, PRESS)
    assert service._run.current is None
    assert "lateral" in worker.answers[-1].reason


def test_a_run_that_is_refused_reaches_the_program_as_one(service: Service) -> None:
    _, worker = begun(service, "free-motion")
    (service._state.folder / "calibration.json").unlink()
    hears(service, worker, RunRequest("free_motion", Plan(), None, False))
    assert worker.answers[-1].exit_code == 2
    assert "palpd calibrate" in worker.answers[-1].reason


def test_the_word_here_of_a_program_is_the_choice_of_its_runs(service: Service) -> None:
    _, worker = begun(service)
    hears(service, worker, RunRequest("palpation", Plan(), None, False, here=True))
    assert service._run.current is not None
    assert service._run.current.job.choice == "here"


def test_a_run_of_a_job_is_judged_by_the_configuration_of_the_service(service: Service, tmp_path: Path) -> None:
    _, worker = begun(service)
    hears(service, worker, RunRequest("palpation", Plan(press_speed_m_per_s=0.05), tmp_path / "kept" / "round-1.mcap", False))
    assert service._run.current is not None or "speed" in worker.answers[-1].reason
    if service._run.current is not None:
        assert service._run.current.job.config.safety == service._config.safety
        assert service._run.current.job.config.paths.runs == tmp_path / "kept"


def test_a_recording_that_was_cut_off_is_recovered_by_a_job_that_moves_nothing(service: Service, tmp_path: Path) -> None:
    """The page cannot write into the folder of the runs; the service can."""
    runs = service._config.paths.runs
    runs.mkdir()
    shutil.copy(OLD_RECORDING, runs / "killed.part")
    assert do(service, "begin", program="recover", arguments={"name": "killed"})["most_runs"] == 0
    program = program_named("recover")
    host = SimpleNamespace(config=service._config)
    end = program.carry_out(host, program.validated({"name": "killed"}), tmp_path)  # type: ignore[arg-type]
    assert (end.verdict, end.figures) == ("done", {"recording": str(runs / "killed.mcap")})
    assert "ticks" in end.reason
    for name in ("killed", "../killed", "absent"):
        with pytest.raises(BadInput, match="no unfinished recording"):
            program.carry_out(host, program.validated({"name": name}), tmp_path)  # type: ignore[arg-type]


# --- consent ------------------------------------------------------------------------------------------------------------------


def test_a_proposed_motion_waits_for_an_answer_to_this_very_motion(service: Service) -> None:
    job_id, worker = begun(service)
    assert "proposes no motion" in do(service, "decide", id=job_id, number=1, agree=True)["error"]
    hears(service, worker, ConsentRequest(MOTION))
    status = do(service, "status")
    assert (status["state"], status["active"]["proposal"]) == ("waiting", {"number": 1, **MOTION})
    assert "number 1, not 0" in do(service, "decide", id=job_id, number=0, agree=True)["error"]
    assert "true or false" in do(service, "decide", id=job_id, number=1, agree="yes")["error"]
    assert "not 'other'" in do(service, "decide", id="other", number=1, agree=True)["error"]
    assert worker.answers == []
    assert do(service, "decide", id=job_id, number=1, agree=True) == {"ok": True, "state": "running"}
    assert worker.answers == [True]
    hears(service, worker, ConsentRequest(MOTION))
    assert "number 2, not 1" in do(service, "decide", id=job_id, number=1, agree=True)["error"], "an answer counts once"


# --- abort --------------------------------------------------------------------------------------------------------------------


def test_an_abort_ends_the_motion_first_and_then_the_job(service: Service) -> None:
    job_id, worker = begun(service, "map")
    hears(service, worker, PRESS)
    run = service._run.current
    assert do(service, "abort")["state"] == "aborting"
    assert run.asked == [Request.ABORT]  # type: ignore[union-attr]
    assert not worker.killed, "the arm has not stopped yet"
    over(service, Report("stopped", "the operator aborted the run", 3))
    assert worker.answers[-1].exit_code == 3
    hears(service, worker, PRESS)
    assert service._run.current is None, "no run follows an abort"
    hears(service, worker, Finished("stopped", "the press was stopped", 3, '{"presses": 1}'))
    assert do(service, "job", id=job_id)["result"] == {"presses": 1}


def test_a_program_that_does_not_end_after_an_abort_is_killed(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    job_id, worker = begun(service, "map")
    hears(service, worker, PRESS)
    do(service, "abort")
    over(service, Report("stopped", "the operator aborted the run", 3))
    later_s = time.monotonic() + 21.0
    monkeypatch.setattr("palpd.daemon.jobs.time.monotonic", lambda: later_s)
    service._poll_job()
    assert worker.killed
    assert do(service, "job", id=job_id)["verdict"] == "stopped"


@pytest.mark.parametrize("message", [Words("diagnosing", True), ConsentRequest(MOTION), None])
def test_an_abort_while_it_computes_or_waits_kills_the_worker_at_once(service: Service, message: Any) -> None:
    job_id, worker = begun(service)
    hears(service, worker, message)
    do(service, "abort")
    assert worker.killed
    assert service._run.current is None
    assert do(service, "status")["state"] == "disarmed"
    assert do(service, "job", id=job_id)["verdict"] == "cancelled"


def test_a_cancel_hits_only_the_job_it_names(service: Service) -> None:
    job_id, worker = begun(service)
    assert job_id in do(service, "cancel", id="another")["error"]
    assert not worker.killed
    do(service, "cancel", id=job_id)
    assert worker.killed
    assert "no job is running" in do(service, "cancel", id=job_id)["error"]


def test_a_worker_that_dies_ends_its_job_with_what_is_known(service: Service) -> None:
    job_id, worker = begun(service)
    hears(service, worker, Stopped("the worker of the job ended by signal 9"))
    job = do(service, "job", id=job_id)
    assert (job["verdict"], job["reason"], job["exit_code"]) == ("failed", "the worker of the job ended by signal 9", 3)
    assert do(service, "status")["state"] == "disarmed"


def test_a_plan_that_is_started_is_a_job_too(service: Service) -> None:
    arm(service)
    do(service, "start", plan=PLAN)
    (job,) = do(service, "jobs")["jobs"]
    assert (job["program"], job["state"], job["runs"]) == ("run", "running", 1)
    over(service, Report("done", recording=Path("r.mcap"), notes=("a note",)))
    done = do(service, "job", id=job["id"])
    assert (done["verdict"], done["result"]["recording"], done["result"]["notes"]) == ("done", "r.mcap", ["a note"])


# --- the controls -------------------------------------------------------------------------------------------------------------


def test_who_does_not_hold_the_controls_may_watch_and_abort_and_nothing_else(service: Service) -> None:
    lease = do(service, "take", name="Anna")["lease"]
    for what in ("arm", "start", "pause", "resume", "retract", "clear", "begin", "decide"):
        assert "Anna holds the controls" in do(service, what, plan=PLAN, program="calibrate")["error"]
    assert do(service, "status")["controls"] == "Anna"
    assert do(service, "jobs")["ok"]
    assert isinstance(service.answer({"do": "watch"}), Watching)
    assert do(service, "abort")["ok"]
    begun_ = do(service, "begin", program="calibrate", lease=lease)
    assert do(service, "job", id=begun_["id"])["by"] == "Anna"
    assert do(service, "cancel", id=begun_["id"])["ok"], "a cancel is an abort"


def test_without_a_holder_requests_without_a_lease_go_on_working(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    lease = do(service, "take", name="Anna")["lease"]
    assert do(service, "renew", lease=lease)["lease_s"] == LEASE_S
    later_s = time.monotonic() + LEASE_S + 1.0
    monkeypatch.setattr("palpd.daemon.pausing.time.monotonic", lambda: later_s)
    assert do(service, "status")["controls"] is None
    assert do(service, "clear")["ok"]
    assert "not renewed" in do(service, "clear", lease=lease)["error"]
    assert "never yours" in do(service, "renew")["error"]
    assert "never yours" in do(service, "release")["error"]


# --- what watchers see --------------------------------------------------------------------------------------------------------


class _Page:
    """Stands for the socket: keeps what is published."""

    watched = True

    def __init__(self) -> None:
        self.events: list[dict[str, Any]] = []

    def publish(self, event: dict[str, Any]) -> None:
        self.events.append(json.loads(json.dumps(event)))


def test_watchers_see_each_change_of_a_job_its_log_and_the_status_once(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    page = _Page()
    job_id, worker = begun(service)
    hears(service, worker, Words("Recording a.csv", False), ConsentRequest(MOTION), Finished("declined", "no", 0, "{}"))
    service._publish(page)  # type: ignore[arg-type]
    kinds = [(event["event"], event.get("state"), event.get("line")) for event in page.events]
    assert kinds == [
        ("job", "running", None),
        ("log", None, "Recording a.csv"),
        ("job", "waiting", None),
        ("job", "declined", None),
        ("status", "disarmed", None),
    ]
    later_s = time.monotonic() + 1.0
    monkeypatch.setattr("palpd.daemon.pausing.time.monotonic", lambda: later_s)
    service._publish(page)  # type: ignore[arg-type]
    assert len(page.events) == len(kinds), "an unchanged status is not repeated"
    assert page.events[0]["id"] == job_id


def test_the_page_of_jobs_lists_every_request_argument_and_key_of_the_status(service: Service) -> None:
    page = (ROOT / "docs" / "jobs.md").read_text(encoding="utf-8")
    known = service.answer({"do": "nothing"})["error"].partition("known: ")[2].split(", ")  # type: ignore[call-overload, index, union-attr]
    assert [name for name in known if f'"do": "{name}"' not in page] == []
    for name, program in PROGRAMS.items():
        row = re.search(rf"^\| `{name}`[^|]*\|([^|]*)\|", page, re.MULTILINE)
        assert row is not None
        assert set(re.findall(r"`(\w+)`", row[1])) == set(program.arguments.model_fields), name
    section = page.partition("## Status")[2].partition("| key of `now` |")[0]
    listed = set(re.findall(r"`(\w+)`", " ".join(re.findall(r"^\|([^|]*)\|", section, re.MULTILINE))))
    assert do(service, "status").keys() - {"ok"} <= listed


@pytest.mark.parametrize(
    ("report", "verdict", "reason"),
    [
        (Report("stopped", "the operator aborted the run (SIGTERM)", 3), "stopped", "the operator aborted the run (SIGTERM)"),
        (Report("done"), "cancelled", "the service ended"),
    ],
)
def test_a_job_whose_run_the_end_of_the_service_has_stopped_is_stopped_for_whoever_watches(
    service: Service, report: Report, verdict: str, reason: str
) -> None:
    """Alarms tell of what was stopped, and of nothing that was cancelled."""
    _, worker = begun(service, "map")
    hears(service, worker, PRESS)
    over(service, report)
    service._jobs.take_events()
    service._jobs.close()
    (event,) = service._jobs.take_events()
    assert (event["verdict"], event["reason"]) == (verdict, reason)
