"""A run that ends for want of data says which it was: a device was silent, or this computer stood still."""

import os
import signal
import time
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from palpd.analysis.stalls import stall_figures, stall_note
from palpd.daemon.silence import explained
from palpd.daemon.witness import Stall, Witness, stood_still
from palpd.recording.header import RecordedStall, RecordedTrip
from palpd.testing.processes import until
from palpd.tick import ROW, Trip


def trip(kind: Trip, measured: float, limit: float) -> RecordedTrip:
    return RecordedTrip(trip=kind.name, measured=measured, limit=limit, reason="")


def witness(*stalls: Stall, processors: int = 2, urgent: bool = True) -> Witness:
    return cast(Witness, SimpleNamespace(stalls=list(stalls), processors=processors, urgent=urgent))


BOTH = (Stall(99.935, 99.995, 0), Stall(99.937, 99.995, 1))
SENSOR = trip(Trip.SENSOR_STALE, 0.056, 0.05)


@pytest.mark.parametrize(
    ("kind", "stalls", "sentence"),
    [
        (SENSOR, (), "; the sensor was silent for 56 ms while this computer ran"),
        (SENSOR, (Stall(98.0, 99.0, 0),), "; the sensor was silent for 56 ms while this computer ran"),
        (SENSOR, BOTH, "; this computer stood still for 51 ms of these 56 ms"),
        (SENSOR, BOTH[1:], "; processor 1 of this computer stood still for 51 ms of these 56 ms"),
        (trip(Trip.ROBOT_STALE, 0.2, 0.05), BOTH, "; the robot was silent for 200 ms, and this computer stood still for 60 ms of them"),
        (trip(Trip.LATE_TICKS, 7.0, 6.0), BOTH, "; this computer stood still for 59 ms"),
        (trip(Trip.LATE_TICKS, 7.0, 6.0), (), "; the motion process was held up for 56 ms while this computer ran"),
        (trip(Trip.PROGRAM_STOPPED, 0.0, 2.0), BOTH, "; this computer stood still for 60 ms just before"),
        (trip(Trip.PROGRAM_STOPPED, 0.0, 2.0), (), ""),
        (trip(Trip.CONTACT_FORCE, 13.0, 12.0), BOTH, ""),
    ],
)
def test_the_reason_says_what_stood_still(kind: RecordedTrip, stalls: tuple[Stall, ...], sentence: str) -> None:
    assert explained([kind], 100.0, 0.008, witness(*stalls)) == sentence


def test_two_trips_of_one_cause_say_it_once_each() -> None:
    trips = [trip(Trip.PROGRAM_STOPPED, 0.0, 2.0), trip(Trip.CONNECTION, 1.0, 0.0)]
    assert explained(trips, 100.0, 0.008, witness(*BOTH)) == "; this computer stood still for 60 ms just before"


def test_without_a_witness_nothing_is_claimed_and_without_priority_less() -> None:
    assert explained([SENSOR], 100.0, 0.008, witness(processors=0)) == ""
    assert "stood still or did other work for 51 ms" in explained([SENSOR], 100.0, 0.008, witness(*BOTH, urgent=False))


def test_overlapping_stalls_count_once() -> None:
    stalls = [Stall(1.0, 2.0, 0), Stall(1.5, 1.8, 1), Stall(3.0, 3.5, 1)]
    assert stood_still(stalls, 0.0, 10.0) == (1.5, [0, 1])
    stood_s, processors = stood_still(stalls, 1.9, 3.1)
    assert stood_s == pytest.approx(0.2)
    assert processors == [0, 1]
    assert stood_still(stalls, 4.0, 5.0) == (0.0, [])


def test_a_witness_that_was_held_up_reports_it() -> None:
    seen = Witness(55)
    watched = len(os.sched_getaffinity(0))
    until(lambda: (seen.hear(), seen.processors == watched)[1], "it watches every processor")
    time.sleep(0.1)
    process = seen._process
    assert process is not None
    os.kill(process.pid, signal.SIGINT)  # Ctrl-C reaches all of palpd, and ends no witness
    stopped_s = time.monotonic()
    os.kill(process.pid, signal.SIGSTOP)
    time.sleep(0.08)
    os.kill(process.pid, signal.SIGCONT)
    continued_s = time.monotonic()
    until(lambda: len(stood_still(seen.hear(), stopped_s, continued_s)[1]) == watched, "every processor's stall is reported")
    assert stood_still(seen.stalls, stopped_s, continued_s)[0] > 0.05
    seen.end()
    assert process.poll() is not None


def test_a_witness_ends_with_its_supervisor() -> None:
    seen = Witness(55)
    process = seen._process
    assert process is not None
    assert process.stdin is not None
    process.stdin.close()  # as the kernel does when the supervisor dies
    assert process.wait(10.0) == 0
    seen.end()


def ticks(missing: slice, late: bool = False) -> np.ndarray:
    """A second of ticks at 125 Hz; those of `missing` hear nothing of the sensor, or do not come at all."""
    rows = np.zeros(125, ROW)
    rows["now_s"] = 100.0 + 0.008 * np.arange(125)
    rows["robot_t_s"] = rows["robot_timestamp_s"] = rows["now_s"] - 0.001
    rows["frames"] = 8
    rows["frame_t_s"][:, :8] = rows["now_s"][:, None] - 0.0075 + 0.001 * np.arange(8)
    if late:
        rows["missed"][missing.stop] = missing.stop - missing.start
        return np.delete(rows, missing)
    rows["frames"][missing] = 0
    rows["frame_t_s"][missing] = 0.0
    return rows


def test_silences_and_stalls_of_a_run_are_counted_apart() -> None:
    assert stall_note(stall_figures(ticks(slice(50, 50)), [])) is None
    silent = stall_figures(ticks(slice(50, 56)), [])
    assert (silent["sensor"], silent["robot"], silent["computer"]) == (1, 0, 0)
    assert silent["sensor_longest_s"] == pytest.approx(0.0485)
    assert stall_note(silent) == "the sensor was silent 1 time for more than 20 ms (at most 48 ms)"
    stalls = [RecordedStall(begin_s=100.402, end_s=100.44, processor=0), RecordedStall(begin_s=100.41, end_s=100.447, processor=1)]
    stalled = stall_figures(ticks(slice(50, 56), late=True), stalls)
    assert (stalled["sensor"], stalled["robot"], stalled["computer"]) == (0, 0, 1)
    assert stalled["computer_longest_s"] == pytest.approx(0.045)
    assert stall_figures(ticks(slice(50, 56)), stalls)["sensor"] == 0, "data that this computer did not fetch"


def test_a_stall_that_held_up_the_last_tick_counts_though_the_witness_woke_after_it() -> None:
    last_s = float(ticks(slice(50, 50))["now_s"][-1])
    late = RecordedStall(begin_s=last_s - 0.05, end_s=last_s + 0.001, processor=0)
    after = RecordedStall(begin_s=last_s + 0.001, end_s=last_s + 0.1, processor=1)
    assert stall_figures(ticks(slice(50, 50)), [late])["computer"] == 1
    assert stall_figures(ticks(slice(50, 50)), [after])["computer"] == 0


def test_a_recording_without_ticks_has_no_stalls() -> None:
    assert stall_figures(np.zeros(0, ROW), [])["computer"] == 0


def test_a_run_that_was_stopped_before_the_first_frame_of_its_sensor_has_figures_too() -> None:
    rows = ticks(slice(0, 125))
    without = np.zeros(
        len(rows),
        [
            (name, f"{ROW[name].base}", (0,) if name == "frame_t_s" else ())
            for name in ("now_s", "missed", "frames", "frame_t_s", "robot_t_s", "robot_timestamp_s")
        ],
    )
    for name in set(without.dtype.names or ()) - {"frame_t_s"}:
        without[name] = rows[name]
    assert stall_figures(without, []) == stall_figures(rows, []), "palpd info and palpd runs called such a recording none of palpd's"
