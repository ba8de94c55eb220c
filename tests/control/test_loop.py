"""What a tick of the loop sees and keeps."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from palpd.config import Config, Plan
from palpd.control.loop import Loop
from palpd.control.sequence import Sequence, TimedRest
from palpd.daemon.motion_job import Job, arm_geometry_of, explainer_with, limits_of
from palpd.recording.tick_rows import DECISIONS, RowWriter, decision
from palpd.tick import MAX_FRAMES, ROW, RobotState, SensorFrames, TickRecord, Timing, UncommandedRobot
from tests import scenes


class StalledDevices:
    """Clock, robot and sensor of a computer that stood still: the only tick finds that number of frames."""

    def __init__(self, frames: int) -> None:
        self._frames = scenes.frames(n=frames)

    def wait(self) -> Timing:
        return Timing(0, 10.0, 10.0)

    def elapsed_us(self) -> float:
        return 0.0

    def read(self) -> SensorFrames:
        return self._frames


class StillRobot(UncommandedRobot):
    def read(self) -> RobotState:
        return scenes.robot()


class Rows:
    """Writes every tick into a row, rehearsed or not."""

    def __init__(self) -> None:
        self._writer = RowWriter(np.zeros(1, ROW))

    def __call__(self, record: TickRecord) -> None:
        self._writer.fill(0, record)

    rehearse = __call__


def loop_of(record: Any) -> tuple[Loop, StalledDevices]:
    devices = StalledDevices(MAX_FRAMES + 42)
    job = Job("palpation", Config(), Plan(), reference=(0.0,) * 6)
    sequence = Sequence(TimedRest(arm_geometry_of(job, 0.0), 1.0))
    return Loop(StillRobot(), devices, devices, sequence, explainer_with(None, job, 0.0), limits_of(job.config, True), record), devices


def test_a_rehearsal_after_a_stall_fits_a_row_too() -> None:
    loop, _ = loop_of(Rows())
    loop.rehearse(1)
    loop.tick()


def test_a_row_holds_the_frames_and_ends_with_the_decision() -> None:
    records: list[TickRecord] = []
    loop, _ = loop_of(records.append)
    loop.tick()
    rows = np.zeros(2, ROW)
    RowWriter(rows).fill(1, records[0])
    _, _, frames, contact, *_ = records[0].observation
    for name, array in {
        "frame_t_s": frames.t_s, "counter": frames.counter, "status": frames.status,
        "wrench": frames.wrench, "tared": contact.tared, "inertial_N": contact.inertial_N,
    }.items():  # fmt: skip
        assert rows[name][1].tobytes() == array.tobytes()
    assert not rows[:1].tobytes().strip(b"\0"), "no other row is touched"
    decided = decision(records[0])
    assert rows[1].tobytes().endswith(decided)
    assert sum(ROW[name].itemsize for name in DECISIONS) == len(decided)


def test_a_row_refuses_an_array_of_another_type() -> None:
    records: list[TickRecord] = []
    loop, _ = loop_of(records.append)
    loop.tick()
    observation = records[0].observation
    halves = replace(observation.frames, wrench=observation.frames.wrench.astype(np.float32))
    with pytest.raises(ValueError, match=r"size|structure"):
        RowWriter(np.zeros(1, ROW)).fill(0, records[0]._replace(observation=observation._replace(frames=halves)))


def test_a_tick_decides_by_no_more_frames_than_its_row_holds() -> None:
    records: list[TickRecord] = []
    loop, devices = loop_of(records.append)
    loop.tick()
    (record,) = records
    assert len(record.observation.frames) == MAX_FRAMES == len(record.observation.contact.tared)
    assert np.array_equal(record.observation.frames.wrench, devices.read().wrench[-MAX_FRAMES:]), "the newest count"
