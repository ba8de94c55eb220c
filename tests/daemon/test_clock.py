"""The grid of ticks."""

import time

import pytest

from palpd.daemon.clock import RealClock, SimClock


class FakeTime:
    def __init__(self) -> None:
        self.now_ns = 10_000_000_000

    def monotonic_ns(self) -> int:
        return self.now_ns

    def sleep(self, duration_s: float) -> None:
        self.now_ns += round(duration_s * 1e9)


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> FakeTime:
    fake = FakeTime()
    monkeypatch.setattr(time, "monotonic_ns", fake.monotonic_ns)
    monkeypatch.setattr(time, "sleep", fake.sleep)
    return fake


def test_ticks_stand_on_an_absolute_grid_whatever_the_work_takes(fake: FakeTime) -> None:
    clock = RealClock(125.0, 10.008)
    planned = []
    for work_s in (0.001, 0.0075, 0.002, 0.0):
        timing = clock.wait()
        planned.append(timing.planned_s)
        fake.sleep(work_s)
    assert planned == pytest.approx([10.008, 10.016, 10.024, 10.032])


def test_a_stall_is_skipped_and_counted_and_never_made_up(fake: FakeTime) -> None:
    clock = RealClock(125.0, 10.0)
    assert clock.wait().missed == 0
    fake.sleep(0.0301)  # due at 8, 16 and 24 ms, now at 30.1
    late = clock.wait()
    assert (late.index, late.missed) == (3, 2)
    assert late.planned_s == pytest.approx(10.024)
    assert clock.wait().planned_s == pytest.approx(10.032)


def test_elapsed_time_counts_from_the_tick(fake: FakeTime) -> None:
    clock = RealClock(500.0, 10.0)
    clock.wait()
    fake.sleep(0.000123)
    assert clock.elapsed_us() == pytest.approx(123.0)


def test_simulated_time_is_the_same_grid() -> None:
    clock = SimClock(500.0)
    assert [clock.wait().now_s for _ in range(3)] == pytest.approx([0.0, 0.002, 0.004])
