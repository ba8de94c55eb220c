"""The supervisor separates a loop that hangs from a computer that stood still: it counts only the time for which it ran itself."""

import pytest

from palpd.daemon.supervisor import STALLED_S
from palpd.daemon.tick_watch import LOOK_S, TickWatch


def test_ticks_that_do_not_advance_while_the_supervisor_looks_are_a_loop_that_hangs() -> None:
    watch = TickWatch(0, 100.0)
    times = [100.0 + 0.02 * k for k in range(1, 111)]
    assert [watch.still_s(0, now_s) for now_s in times][-1] == pytest.approx(2.2)
    assert watch.still_s(1, 102.22) == 0.0, "a tick"


def test_a_computer_that_stood_still_for_longer_is_no_loop_that_hangs() -> None:
    watch = TickWatch(7, 100.0)
    assert watch.still_s(7, 100.02) == pytest.approx(0.02)
    assert watch.still_s(7, 105.0) == pytest.approx(0.02 + LOOK_S)
    assert watch.still_s(8, 105.02) == 0.0, "the loop goes on as soon as it may"


def test_a_loop_that_hangs_after_a_standstill_is_found_all_the_same() -> None:
    watch = TickWatch(7, 100.0)
    watch.still_s(7, 105.0)
    now_s = 105.0
    while watch.still_s(7, now_s) <= STALLED_S:
        now_s += 0.02
    assert now_s < 105.0 + STALLED_S


def test_the_count_begins_anew_where_the_loop_does() -> None:
    watch = TickWatch(0, 100.0)
    watch.still_s(0, 100.2)
    watch.begin(100.2)
    assert watch.still_s(0, 100.3) == pytest.approx(0.1)
