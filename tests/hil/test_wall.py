"""A stiff wall where something soft was found: soft end, guard and absolute limit, and how far the force runs past them."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from palpd.testing.emulated_cell import EmulatedCell, WallOutcome, press_into_wall, retry_if_machine_stalled

pytestmark = pytest.mark.hil

LIMITS = {"contact_limit_N": 12.0, "absolute_limit_N": 25.0}
SHIFT_N = 2.5
"""Error of the reference tare in the test of the absolute limit, which then trips before the soft end."""


def _bounded(met: WallOutcome, limit_N: float) -> None:
    assert met.true_peak_N <= limit_N + 1.1 * met.predicted_overshoot_N
    assert met.seen_peak_N <= limit_N + 1.1 * met.predicted_overshoot_N


def test_a_wall_of_1_N_per_mm_ends_the_press_softly_and_the_run_replays_identically(cell: Callable[..., EmulatedCell]) -> None:
    def attempt(wired: EmulatedCell) -> tuple[EmulatedCell, WallOutcome]:
        met = press_into_wall(wired, 1000.0, 0.005)
        assert met.code == 0, met.stderr
        assert met.report["verdict"] == "done"
        assert met.report["trips"] == []
        assert met.report["sites"][0]["cut_short"]
        _bounded(met, 0.9 * LIMITS["contact_limit_N"])
        return wired, met

    wired, met = retry_if_machine_stalled(lambda: cell(safety=LIMITS), attempt)
    again = wired.folder / "replay.json"
    done = wired.palpd("replay", met.report["recording"], "--json", again)
    assert done.returncode == 0, done.stderr
    assert json.loads(again.read_text())["decisions_identical"]


def test_a_wall_of_20_N_per_mm_trips_the_guard_which_retracts_and_ends_the_run(cell: Callable[..., EmulatedCell]) -> None:
    def attempt(wired: EmulatedCell) -> None:
        met = press_into_wall(wired, 20000.0, 0.01)
        assert met.code == 3
        assert met.report["verdict"] == "stopped"
        assert [trip["trip"] for trip in met.report["trips"]] == ["CONTACT_FORCE"], met.stderr
        assert "12 N" in met.stderr
        assert met.left_at["contact_N"] == 0.0, "the probe has left the wall"
        _bounded(met, LIMITS["contact_limit_N"])

    retry_if_machine_stalled(lambda: cell(safety=LIMITS), attempt)


def test_the_absolute_limit_stops_the_arm_where_it_is_and_stays_latched(cell: Callable[..., EmulatedCell]) -> None:
    def attempt(wired: EmulatedCell) -> None:
        _shift_reference(wired.calibrate())
        level = wired.palpd("level-test", "--config", wired.config)  # without it a run refuses a force that far off its reference
        assert level.returncode == 0, level.stderr
        met = press_into_wall(wired, 5000.0, 0.01, take_reference=False)
        assert met.code == 3
        assert [trip["trip"] for trip in met.report["trips"]] == ["ABSOLUTE_FORCE"], met.stderr
        assert met.left_at["contact_N"] > 5.0, "the arm stays where it was stopped"
        _bounded(met, 12.5 - SHIFT_N)
        assert "absolute limit" in json.loads((wired.folder / "state" / "latch.json").read_text())["reason"]

    retry_if_machine_stalled(lambda: cell(safety={"contact_limit_N": 12.0, "absolute_limit_N": 12.5}), attempt)


def _shift_reference(path: Path) -> None:
    """Pressed is negative in the sensor's own z: a reference that is higher makes every reading look more pressed."""
    calibration: dict[str, Any] = json.loads(path.read_text())
    calibration["wrench"][2] += SHIFT_N
    path.write_text(json.dumps(calibration))
