"""The worker of a job as a real process: what it says, what it takes, and that it does not outlive the service."""

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from palpd.config import Config, parse_config
from palpd.control.plan_place import PlanPlace
from palpd.control.probe_state import ProbeEvidence, ProbeIdentity
from palpd.daemon.job_worker import Finished, RunRequest, Words, WorkerOrder, WorkerProcess
from palpd.daemon.stored_state import State
from palpd.daemon.supervisor import Report
from palpd.errors import Stopped

PATIENCE_S = 60.0


@pytest.fixture
def config(tmp_path: Path) -> Config:
    return parse_config({"paths": {"state": str(tmp_path / "state"), "runs": str(tmp_path / "runs")}}, "the test's configuration")


@pytest.fixture
def begun(config: Config, tmp_path: Path) -> Iterator[Callable[..., WorkerProcess]]:
    workers: list[WorkerProcess] = []

    def begin(program: str, **arguments: Any) -> WorkerProcess:
        workers.append(WorkerProcess(WorkerOrder(program, arguments, config, tmp_path / "kept", "Ann")))
        return workers[-1]

    yield begin
    for worker in workers:
        worker.kill()


def heard(worker: WorkerProcess) -> Any:
    """The next message."""
    until_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < until_s:
        if (message := worker.hear()) is not None:
            return message
        time.sleep(0.01)
    raise AssertionError("the worker says nothing")


def test_a_program_asks_for_its_run_and_keeps_what_came(begun: Callable[..., WorkerProcess], config: Config) -> None:
    worker = begun("calibrate", temperature_C=21.0)
    request = heard(worker)
    assert isinstance(request, RunRequest)
    assert (request.kind, request.recording) == ("calibrate", None)
    assert worker.hear() is None, "it waits for the report"
    evidence = ProbeEvidence((0.0,) * 6, (1.0, 2.0, 3.0, 0.0, 0.0, 0.0), 0.0, ProbeIdentity("PRE00042", None, None))
    worker.answer(Report("done", evidence=evidence))
    end = heard(worker)
    assert isinstance(end, Finished)
    assert (end.verdict, end.exit_code) == ("done", 0)
    assert '"wrench": [1.0, 2.0, 3.0, 0.0, 0.0, 0.0]' in end.result
    kept = State(config.paths.state).calibration()
    assert kept is not None
    assert kept.temperature_C == 21.0


def test_the_word_here_goes_with_the_run_and_a_job_that_is_killed_before_it_leaves_the_question(
    begun: Callable[..., WorkerProcess], config: Config
) -> None:
    """The program had forgotten the unfinished palpation by then, so the next start elsewhere was not asked."""
    state = State(config.paths.state)
    state.keep("place", PlanPlace("2026-11-22", "a-run", (0.0, 0.0), (0.0, 0.0, 0.1), 0.1, (("A", 0.03, 0.0),)))
    last = state.place()
    worker = begun("map", here=True)
    request = heard(worker)
    worker.kill()
    assert isinstance(request, RunRequest)
    assert request.here
    assert state.place() == last


def test_a_refused_run_ends_the_program_with_the_sentence(begun: Callable[..., WorkerProcess]) -> None:
    worker = begun("free-motion")
    assert isinstance(heard(worker), RunRequest)
    worker.answer(Report("refused", "there is no reference tare", 2))
    end = heard(worker)
    assert (end.verdict, end.reason, end.exit_code) == ("refused", "there is no reference tare", 2)


def test_a_program_computes_between_its_runs_and_says_so(begun: Callable[..., WorkerProcess], tmp_path: Path) -> None:
    worker = begun("resolve", recordings=[str(tmp_path / "absent.csv")])
    end = heard(worker)
    while isinstance(end, Words):
        end = heard(worker)
    assert isinstance(end, Finished)
    assert end.exit_code == 2
    assert "absent.csv" in end.reason


def test_a_killed_worker_is_gone_and_said_to_be(begun: Callable[..., WorkerProcess]) -> None:
    worker = begun("calibrate")
    subprocess.run(["kill", "-KILL", str(worker.pid)], check=True)
    with pytest.raises(Stopped, match=r"ended by signal 9|closed its pipe"):
        heard(worker)


def test_what_is_no_message_is_refused_as_one(begun: Callable[..., WorkerProcess]) -> None:
    worker = begun("calibrate")
    worker._received += b'{"message": "run"}\n'
    with pytest.raises(Stopped, match="no message of its own"):
        worker.hear()


SERVICE = """
import os, sys, time
from pathlib import Path
from palpd.config import Config
from palpd.daemon.job_worker import WorkerOrder, WorkerProcess
worker = WorkerProcess(WorkerOrder("calibrate", {}, Config(), Path("kept"), "Ann"))
while worker.hear() is None:
    time.sleep(0.01)
print(worker.pid, flush=True)
os.kill(os.getpid(), 9)
"""


def test_the_kernel_kills_a_worker_whose_service_died(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, "-c", SERVICE], capture_output=True, text=True, cwd=tmp_path, check=False)
    worker = Path("/proc", done.stdout.strip())
    until_s = time.monotonic() + 2.0
    while time.monotonic() < until_s and worker.exists() and "Z" not in (worker / "stat").read_text().rpartition(")")[2].split()[:1]:
        time.sleep(0.01)
    assert not worker.exists() or (worker / "stat").read_text().rpartition(")")[2].split()[0] == "Z"
