"""Commanded heights: trapezoids of speed between rests."""

import numpy as np
import pytest

from palpd.cell.motion_profile import Move, Trapezoid, commanded_heights

STEP_S = 0.002


def test_moves_end_at_their_heights_and_keep_to_speed_and_acceleration() -> None:
    z_m, spans = commanded_heights(0.0, [Move(0.02, 0.05, 0.1), Move(-0.001, 0.02)], STEP_S)
    assert z_m[spans[0][1] - 1] == pytest.approx(0.02, abs=1e-9)
    assert z_m[-1] == pytest.approx(-0.001, abs=2e-5)
    assert np.abs(np.diff(z_m)).max() / STEP_S == pytest.approx(0.05, rel=1e-6)
    assert np.abs(np.diff(z_m, 2)).max() / STEP_S**2 < 1.1


def test_a_short_way_ends_before_its_speed_is_reached() -> None:
    profile = Trapezoid(0.001, 1.0, 0.5)
    t_s = np.linspace(0.0, 2.0 * profile.duration_s, 2001)
    travelled_m = profile.travelled_m(t_s)
    assert profile.duration_s == pytest.approx(2.0 * (0.001 / 0.5) ** 0.5)
    assert travelled_m[500] == pytest.approx(0.0005, abs=1e-9)  # half the way at half the time
    assert travelled_m[t_s >= profile.duration_s] == pytest.approx(0.001)
    assert (np.diff(travelled_m) >= -1e-15).all()


def test_a_move_to_the_same_height_is_a_rest() -> None:
    z_m, spans = commanded_heights(0.01, [Move(0.01, 0.02, 0.1)], STEP_S)
    assert spans == [(0, 50)]
    assert (z_m == 0.01).all()
