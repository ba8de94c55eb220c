"""The motion process at the end of its loop."""

from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest

from palpd.config import Config, Plan
from palpd.control.loop import Outcome
from palpd.daemon import motion_process
from palpd.daemon.devices import Devices
from palpd.daemon.motion_job import Job, explainer_of
from palpd.daemon.realtime import Granted
from palpd.daemon.supervisor import JobRun
from palpd.errors import Stopped
from palpd.recording.ring import LoopState, Ring
from palpd.tick import Request


@pytest.mark.parametrize("end", [Outcome(), Stopped("the robot refused a command")])
def test_a_loop_says_that_it_runs_only_while_its_thread_is_urgent_and_ticks_are_due(
    monkeypatch: pytest.MonkeyPatch, end: Outcome | Stopped
) -> None:
    """As an ordinary thread it may wait for seconds on a busy machine, and the supervisor took that for a loop that stood still."""
    ring = Ring.create(125.0)
    ring.state = LoopState.STARTING
    states: list[tuple[str, int]] = []

    @contextmanager
    def realtime() -> Iterator[Granted]:
        states.append(("before", ring.state))
        yield Granted(True, True, True, ())
        states.append(("after", ring.state))

    def run() -> Outcome:
        states.append(("ticks", ring.state))
        if isinstance(end, Stopped):
            raise end
        return end

    loop = SimpleNamespace(rehearse=lambda: states.append(("rehearsal", ring.state)), run=run, outcome=Outcome())
    monkeypatch.setattr(motion_process, "realtime", realtime)
    monkeypatch.setattr(motion_process, "drain", lambda sensor: None)
    monkeypatch.setattr(motion_process, "Loop", lambda *arguments: loop)
    try:
        job = Job("palpation", Config(), Plan(), reference=(0.0,) * 6)
        devices = Devices(MagicMock(), MagicMock(), 0.0, {"delay_s": 0.001})
        motion_process._run(job, devices, explainer_of(job, {}, 0.001), ring, lambda: Request.NONE)
        assert states == [
            ("before", LoopState.STARTING),
            ("rehearsal", LoopState.STARTING),
            ("ticks", LoopState.RUNNING),
            ("after", LoopState.ENDED),
        ]
    finally:
        ring.close()


@pytest.mark.parametrize(
    ("job", "reason"),
    [
        (Job("palpation", Config()), "nothing was moved: the sensor is silent"),
        (Job("palpation", Config(), dry=True), "the sensor is silent"),
        (Job("calibrate", Config()), "the sensor is silent"),
        (Job("observe", Config()), "the sensor is silent"),
    ],
)
def test_only_what_would_have_moved_says_that_nothing_was_moved(job: Job, reason: str) -> None:
    run = JobRun.__new__(JobRun)
    run.job, run._motion, run._witness = job, MagicMock(), MagicMock()
    assert run._refuse(MagicMock(about={}), "the sensor is silent").report.reason == reason
