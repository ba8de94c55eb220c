"""The minimum-delay clock that both drivers share, on made-up arrivals."""

import pytest

from hw.host_time import MinimumDelayClock


def test_host_time_follows_a_slower_clock_and_the_shortest_way() -> None:
    clock = MinimumDelayClock(leak=1e-4, longest_jump_s=1.0)
    for i in range(125 * 600):
        timestamp_s = i * 0.008
        true_s = 1000 + timestamp_s * (1 + 50e-6)
        clock.see(timestamp_s, true_s + (0.3e-3 if i % 5 else 0.1e-3))
        assert -1e-6 < clock.host_s(timestamp_s) - true_s < 0.32e-3


def test_a_device_clock_that_was_started_anew_finds_its_offset_again() -> None:
    clock = MinimumDelayClock(leak=1e-4, longest_jump_s=1.0)
    clock.see(5000.0, 100.0)
    clock.see(0.0, 101.0)
    assert clock.host_s(0.0) == pytest.approx(101.0)


@pytest.mark.parametrize(("jump_s", "offset_s"), [(1.0, 90.0 + 1e-4), (1.001, 91.001)])
def test_only_a_jump_beyond_the_longest_counts_as_a_new_start(jump_s: float, offset_s: float) -> None:
    clock = MinimumDelayClock(leak=1e-4, longest_jump_s=1.0)
    clock.see(10.0, 100.0)
    assert clock.see(11.0 - jump_s, 101.0) == pytest.approx(offset_s, abs=1e-9)


def test_a_clock_has_no_offset_before_the_first_arrival_and_after_a_restart() -> None:
    clock = MinimumDelayClock(leak=1e-3)
    assert not clock.synchronised
    clock.see(1.0, 3.0)
    assert clock.synchronised
    clock.restart()
    assert not clock.synchronised
    assert clock.see(1.0, 2.5) == 1.5
