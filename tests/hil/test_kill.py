"""The daemon is killed in the middle of a press: the arm comes to rest, nobody is left behind, the recording is restored."""

import time
from collections.abc import Callable
from pathlib import Path

import mcap.reader
import pytest
from rosbags.highlevel import AnyReader

from palpd.recording.reader import Recording
from palpd.testing.emulated_cell import ATTEMPTS, PRESS, STALLED_S, Daemon, EmulatedCell
from palpd.testing.processes import family, kill, until

pytestmark = pytest.mark.hil

REST_WITHIN_S = {10: 0.110, 50: 0.045}
WAY_WITHIN_M = {10: 0.0015, 50: 0.0007}
LOST_WITHIN_S = 0.5


def _killed_while_pressing(
    cell: Callable[..., EmulatedCell], watchdog_Hz: int, victim: Callable[[Daemon], int]
) -> tuple[EmulatedCell, Daemon, float]:
    """Press, kill, and see the arm come to rest; once more where the machine itself stood still meanwhile. Returns also when.

    At 125 Hz a watchdog of 50 Hz leaves room for one late tick only, so there a machine under load may also end a run before the test does,
    before the contact or after it.
    """
    for attempt in range(ATTEMPTS):
        begun_s = time.monotonic()
        wired = cell(robot={"watchdog_Hz": watchdog_Hz}, safety={"contact_limit_N": 16.0})
        daemon = wired.run(PRESS)
        patient = attempt + 1 < ATTEMPTS
        try:
            wired.until_contact(daemon, 3.0)
        except AssertionError:
            if patient:
                continue
            raise
        killed_s = kill(victim(daemon))
        rest_s, way_m = wired.rest_after_s(killed_s), wired.way_after_m(killed_s)
        if patient and any(t_s < killed_s and reason == "watchdog" for t_s, reason in wired.stops(begun_s)):
            continue  # what was killed no longer moved the arm
        kept = rest_s <= REST_WITHIN_S[watchdog_Hz] and way_m <= WAY_WITHIN_M[watchdog_Hz]
        if patient and not kept and wired.lateness_s() > STALLED_S:
            continue
        assert rest_s <= REST_WITHIN_S[watchdog_Hz]
        assert way_m <= WAY_WITHIN_M[watchdog_Hz]
        return wired, daemon, killed_s
    raise AssertionError("no attempt was made")


def _restored(wired: EmulatedCell, killed_s: float) -> Path:
    """The recording after `palpd recover`, found to reach to the kill."""
    part = wired.part
    done = wired.palpd("recover", part)
    assert done.returncode == 0, done.stderr
    path = part.with_suffix(".mcap")
    last_s = float(Recording.load(path).rows["now_s"][-1])
    assert killed_s - last_s <= LOST_WITHIN_S
    return path


@pytest.mark.parametrize("watchdog_Hz", [10, 50])
def test_when_the_whole_daemon_is_killed_the_watchdog_stops_the_arm(cell: Callable[..., EmulatedCell], watchdog_Hz: int) -> None:
    wired, daemon, killed_s = _killed_while_pressing(cell, watchdog_Hz, lambda daemon: -daemon.process.pid)
    assert [reason for _, reason in wired.stops(killed_s)] == ["watchdog"]
    until(lambda: not family(daemon.process.pid), "nothing of the daemon is left")
    path = _restored(wired, killed_s)
    with path.open("rb") as file:
        topics = {channel.topic for _, channel, _ in mcap.reader.make_reader(file).iter_messages()}
    with AnyReader([path]) as reader:
        poses = sum(1 for _ in reader.messages([c for c in reader.connections if c.topic == "/tcp_pose"]))
    assert {"/tcp_pose", "/wrench_raw", "/wrench", "/target_pose", "/tcp_twist", "/tick"} <= topics
    assert poses > 100


def test_when_the_main_process_is_killed_the_loop_stops_the_arm_and_all_end(cell: Callable[..., EmulatedCell]) -> None:
    wired, daemon, killed_s = _killed_while_pressing(cell, 10, lambda daemon: daemon.process.pid)
    until(lambda: not family(daemon.process.pid), "nothing of the daemon is left", 5.0)
    _restored(wired, killed_s)


def test_when_the_motion_process_is_killed_the_run_ends_with_the_reason_and_a_whole_recording(cell: Callable[..., EmulatedCell]) -> None:
    wired, daemon, killed_s = _killed_while_pressing(cell, 50, lambda daemon: daemon.motion_pid)
    assert daemon.wait() == 3
    assert "ended by signal 9" in daemon.stderr
    assert daemon.report["verdict"] == "stopped"
    until(lambda: not family(daemon.process.pid), "nothing of the daemon is left", 5.0)
    rows = Recording.load(Path(daemon.report["recording"])).rows
    assert killed_s - float(rows["now_s"][-1]) <= LOST_WITHIN_S
    assert (wired.folder / "state" / "latch.json").exists()
