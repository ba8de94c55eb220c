"""Reports are written after runs, by a process of their own, and never while something runs."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from palpd.config import Plan
from palpd.daemon import run_reports
from palpd.daemon.run_reports import RunReports, begin_report
from palpd.testing.simulated_recording import write_simulated

PLAN = Plan.model_validate(
    {"sites": [{"name": "A"}], "depths_m": [0.003], "mode": "static", "hold_s": 0.2, "search": {"speed_m_per_s": 0.02}}
)


class ScriptedProcess:
    """Stands for the process that writes a report."""

    def __init__(self) -> None:
        self.code: int | None = None
        self.terminated = 0

    def poll(self) -> int | None:
        return self.code

    def terminate(self) -> None:
        self.terminated += 1


@pytest.fixture
def begun(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Path, Any]]:
    """What was started: recordings and processes."""
    begun: list[tuple[Path, Any]] = []

    def begin(recording: Path, folder: Path, *, stays: bool) -> Any:
        begun.append((recording, ScriptedProcess()))
        return begun[-1][1]

    monkeypatch.setattr(run_reports, "begin_report", begin)
    return begun


def test_nothing_is_written_while_something_runs(begun: list[tuple[Path, Any]]) -> None:
    reports = RunReports(Path("runs"))
    reports.add(Path("a.mcap"))
    reports.poll(busy=True)
    assert begun == []
    reports.poll(busy=False)
    assert [recording.name for recording, _ in begun] == ["a.mcap"]


def test_a_report_waits_where_this_computer_starts_no_process(begun: list[tuple[Path, Any]], monkeypatch: pytest.MonkeyPatch) -> None:
    """The service ended with a traceback."""

    def full(*_: object, **__: object) -> None:
        raise OSError(24, "Too many open files")

    reports = RunReports(Path("runs"))
    reports.add(Path("a.mcap"))
    with monkeypatch.context() as without:
        without.setattr(run_reports, "begin_report", full)
        reports.poll(busy=False)
    reports.poll(busy=False)
    assert [recording.name for recording, _ in begun] == ["a.mcap"]


def test_reports_are_written_one_after_the_other(begun: list[tuple[Path, Any]]) -> None:
    reports = RunReports(Path("runs"))
    for name in ("a.mcap", "b.mcap"):
        reports.add(Path(name))
    for _ in range(3):
        reports.poll(busy=False)
    assert len(begun) == 1
    begun[0][1].code = 0
    reports.poll(busy=False)
    assert [recording.name for recording, _ in begun] == ["a.mcap", "b.mcap"]
    begun[1][1].code = 1
    for _ in range(3):
        reports.poll(busy=False)
    assert len(begun) == 2, "a report that failed is not tried again"


def test_a_run_that_begins_calls_the_report_off_and_it_is_written_afterwards(begun: list[tuple[Path, Any]]) -> None:
    reports = RunReports(Path("runs"))
    reports.add(Path("a.mcap"))
    reports.poll(busy=False)
    for _ in range(3):
        reports.poll(busy=True)
    assert begun[0][1].terminated == 1
    begun[0][1].code = 1
    reports.poll(busy=True)
    assert len(begun) == 1
    reports.poll(busy=False)
    assert [recording.name for recording, _ in begun] == ["a.mcap", "a.mcap"]


def test_the_process_writes_the_report_at_the_lowest_priority_and_in_a_session_of_its_own(tmp_path: Path) -> None:
    recording = write_simulated(tmp_path / "run.mcap", PLAN)
    process = begin_report(recording, tmp_path)
    try:
        assert os.getsid(process.pid) == process.pid
        until_s, niceness = time.monotonic() + 60.0, 0
        while process.poll() is None and time.monotonic() < until_s and niceness < 19:
            niceness = os.getpriority(os.PRIO_PROCESS, process.pid)
            time.sleep(0.01)
        assert niceness == 19
        assert process.wait(60.0) == 0
    finally:
        process.kill()
    assert (tmp_path / "run.report.html").read_text().startswith("<!doctype html>")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["catalogue.sqlite", "run.mcap", "run.report.html"]


def test_a_report_that_is_called_off_leaves_no_file_behind(tmp_path: Path) -> None:
    recording = write_simulated(tmp_path / "run.mcap", PLAN)
    for wait_s in (0.3, 1.0, 1.6):
        process = begin_report(recording, tmp_path)
        time.sleep(wait_s)
        process.send_signal(signal.SIGTERM)
        process.wait(60.0)
        assert {path.name for path in tmp_path.iterdir()} <= {"run.mcap", "catalogue.sqlite", "run.report.html"}


def test_a_recording_that_is_gone_is_sentences_and_no_traceback(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, "-m", run_reports.MODULE, tmp_path / "gone.mcap", tmp_path], capture_output=True, text=True)
    assert done.returncode == 0
    assert "Traceback" not in done.stderr
    assert all(line.startswith("palpd: ") for line in done.stderr.splitlines())
    assert "gone.mcap cannot be read" in done.stderr
