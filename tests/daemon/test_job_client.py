"""A command as a client of the service: what it shows, asks and passes on. Worker and runs are scripted, the socket is real."""

import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from palpd.cli import app
from palpd.config import parse_config
from palpd.daemon.control_socket import ControlSocket
from palpd.daemon.display import ShowProgress
from palpd.daemon.interrupts import Interrupted
from palpd.daemon.job_client import awaited, carried_out_by_service, controls, service_at
from palpd.daemon.job_worker import ConsentRequest, Finished, Words
from palpd.daemon.service import Service
from palpd.daemon.socket_client import ask
from palpd.daemon.stored_state import Calibration, State
from palpd.daemon.supervisor import Report
from palpd.errors import BadInput, Refused
from palpd.testing.processes import over_and_over
from palpd.tick import Request
from tests.daemon.test_jobs import MOTION, ScriptedWorker
from tests.daemon.test_service import ScriptedRun


class Checked(ScriptedRun):
    """A run that is done at once: only the check of the devices."""

    def poll(self) -> Report | None:
        return Report("done")


class Proposing(ScriptedWorker):
    """Says a sentence, computes, proposes a motion, and ends with the answer."""

    def __init__(self, order: Any) -> None:
        super().__init__(order)
        self.says.extend([Words("Recording a.csv", False), Words("diagnosing", True), Words("", True), ConsentRequest(MOTION)])

    def answer(self, thing: Any) -> None:
        super().answer(thing)
        self.says.append(Finished("done" if thing else "declined", "", 0, '{"resolved": true}'))


class Kept:
    """A display that keeps what it shows."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def say(self, sentence: str) -> None:
        self.lines.append(sentence)

    @contextmanager
    def waiting(self, activity: str) -> Iterator[None]:
        self.lines.append(f"[{activity}]")
        yield

    def job(self, steps: int) -> AbstractContextManager[ShowProgress]:
        raise AssertionError("no run is under way")


@pytest.fixture
def socket_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A service in a thread; its runs and workers are scripted."""
    monkeypatch.setattr("palpd.daemon.run_under_way.JobRun", Checked)
    monkeypatch.setattr("palpd.daemon.jobs.WorkerProcess", Proposing)
    config = parse_config({"paths": {"state": str(tmp_path / "state"), "runs": str(tmp_path / "runs")}}, "the test's configuration")
    State(config.paths.state).keep("calibration", Calibration((0.0,) * 6, "2026-01-01", None))
    service = Service(config, lambda *_: pytest.fail("nothing is opened here"))
    control = ControlSocket(config.paths.control_socket, service.answer)

    def serve() -> None:
        control.poll(0.005)
        service._poll_run()
        service._poll_job()
        service._publish(control)

    with over_and_over(serve):
        yield config.paths.control_socket
    control.close()
    service._ring.close()


@pytest.mark.parametrize("agree", [True, False])
def test_a_command_shows_the_log_asks_for_consent_and_returns_the_result(socket_path: Path, agree: bool) -> None:
    display, asked = Kept(), []

    def answer(question: str) -> bool:
        asked.append(question)
        assert ask(socket_path, {"do": "status"})["state"] == "waiting"
        return agree

    end = carried_out_by_service(socket_path, "resolve", {"rounds": 2}, display, answer)
    assert (end.verdict, end.figures) == ("done" if agree else "declined", {"resolved": True})
    assert display.lines[0].endswith("of the service makes at most 2 runs.")
    assert "Recording a.csv" in display.lines
    assert "  rehearsed without wires: 20 s, at most 4.0 N of the guard's 12 N" in display.lines
    assert asked == ["Record it?"]
    assert ScriptedWorker.newest.answers == [agree]
    assert ask(socket_path, {"do": "status"})["controls"] is None, "it lets the controls go"


def test_a_command_that_is_interrupted_cancels_its_job(socket_path: Path) -> None:
    def interrupted(_: str) -> bool:
        raise Interrupted("interrupted by SIGINT")

    with pytest.raises(Interrupted):
        carried_out_by_service(socket_path, "resolve", {}, Kept(), interrupted)
    (job,) = ask(socket_path, {"do": "jobs"})["jobs"]
    assert job["verdict"] == "cancelled"
    assert ScriptedWorker.newest.killed


def test_an_answer_does_not_count_where_somebody_took_the_controls_and_the_job_goes_on(socket_path: Path) -> None:
    def slow(_: str) -> bool:
        with controls(socket_path, "Ben", force=True) as lease:
            job_id = ask(socket_path, {"do": "jobs"})["jobs"][0]["id"]
            ask(socket_path, {"do": "decide", "id": job_id, "number": 1, "agree": False, "lease": lease})
        return True

    display = Kept()
    end = carried_out_by_service(socket_path, "resolve", {}, display, slow)
    assert end.verdict == "declined"
    assert any("your answer did not count: the controls were taken by Ben" in line for line in display.lines)


def test_wrong_arguments_arm_nothing(socket_path: Path) -> None:
    with pytest.raises(BadInput, match="rounds is 0"):
        carried_out_by_service(socket_path, "resolve", {"rounds": 0}, Kept(), lambda _: True)
    assert ask(socket_path, {"do": "status"})["state"] == "disarmed"


def test_a_lease_is_renewed_as_long_as_it_is_held(socket_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("palpd.daemon.job_client.RENEW_S", 0.02)
    monkeypatch.setattr("palpd.daemon.controls.LEASE_S", 0.5)
    with controls(socket_path, "Anna"):
        until_s = time.monotonic() + 1.5
        while time.monotonic() < until_s:
            assert ask(socket_path, {"do": "status"})["controls"] == "Anna"
        with pytest.raises(Refused, match="Anna holds the controls"), controls(socket_path, "Ben"):
            pass


def test_where_nobody_serves_the_foreground_does_the_work(tmp_path: Path) -> None:
    assert not service_at(tmp_path / "nobody.sock")


@pytest.mark.parametrize("command", ["retract", "level-test"])
def test_a_way_up_by_the_service_is_awaited_and_a_clear_may_follow_at_once(socket_path: Path, command: str) -> None:
    done = CliRunner().invoke(app, [command, "--socket", str(socket_path)])
    assert done.exit_code == 0
    assert done.output.endswith("\ndone: nothing was recorded\n"), "the service of this test logs there, too"
    assert ask(socket_path, {"do": "jobs"})["jobs"][0]["program"] == command
    assert CliRunner().invoke(app, ["clear", "--socket", str(socket_path)]).output.endswith("disarmed\n")


def test_a_way_up_that_is_refused_or_stopped_says_so_with_its_exit_code(socket_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Checked, "poll", lambda _: Report("stopped", "the probe is held", 3, notes=["look"]))
    done = CliRunner().invoke(app, ["retract", "--socket", str(socket_path)])
    assert done.exit_code == 3
    assert "palpd: the probe is held" in done.output


def test_a_way_up_that_is_interrupted_is_stopped_and_one_that_nobody_awaits_goes_on(
    socket_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Checked, "poll", lambda _: None)
    done = CliRunner().invoke(app, ["retract", "--socket", str(socket_path), "--no-wait"])
    assert done.output.endswith("\nThe daemon goes up; palpd status says how it ends.\n")
    job_id = ask(socket_path, {"do": "jobs"})["jobs"][0]["id"]
    asked: list[Request] = []
    monkeypatch.setattr(Checked, "ask", lambda _, request: asked.append(request))
    monkeypatch.setattr("palpd.daemon.job_client.ASK_EVERY_S", 0.0)

    class Interrupting(Kept):
        @contextmanager
        def job(self, steps: int) -> Iterator[ShowProgress]:  # type: ignore[override]
            yield lambda _: None
            pytest.fail("it has ended")

    monkeypatch.setattr("palpd.daemon.job_client.time.sleep", lambda _: (_ for _ in ()).throw(Interrupted("interrupted by SIGINT")))
    with pytest.raises(Interrupted):
        awaited(socket_path, job_id, Interrupting())
    assert asked == [Request.ABORT]
