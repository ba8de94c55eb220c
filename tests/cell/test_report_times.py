"""Reports of a robot that is slower than the sensor are found in a recording."""

import numpy as np
import pytest

from palpd.cell.report_times import find_reports, straight_between
from palpd.tick import Floats


def heights_m(t_s: Floats) -> Floats:
    return 0.01 * np.cos(2.0 * np.pi * 0.4 * t_s)


def rows(rows_each: float, late: float, seed: int = 1) -> tuple[Floats, Floats, Floats, Floats]:
    """Times and heights of 12 000 rows at 500 Hz, and the times and heights of the reports behind them."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(12_000) / 500.0
    known_s = (np.arange(-1, 12_000 / rows_each + 2) + late) * rows_each / 500.0
    known_m = heights_m(known_s) + 5e-6 * rng.standard_normal(len(known_s))
    return t_s, np.interp(t_s, known_s, known_m), known_s, known_m


@pytest.mark.parametrize("rows_each", [1.6, 2.0, 2.664, 4.0, 6.4, 8.0])
@pytest.mark.parametrize("late", [0.0, 0.37])
def test_reports_are_found_wherever_they_fall_between_rows(rows_each: float, late: float) -> None:
    t_s, z_m, known_s, known_m = rows(rows_each, late)
    reports = find_reports(t_s, z_m)
    assert reports.rows_each == pytest.approx(rows_each, rel=3e-3)
    nearest_s = known_s[np.rint(np.interp(reports.t_s[5:-5], known_s, np.arange(len(known_s)))).astype(int)]
    assert np.abs(reports.t_s[5:-5] - nearest_s).max() < 0.1 * rows_each / 500.0
    error_m = reports.values(z_m)[5:-5] - np.interp(reports.t_s[5:-5], known_s, known_m)
    assert np.sqrt(np.mean(error_m**2)) < 1e-6
    assert np.std(reports.joined @ reports.values(z_m) - z_m) < 1e-6


@pytest.mark.parametrize(
    ("frequency_Hz", "amplitude_m"), [(0.0, 0.0), (7.0, 1e-3), (33.3, 1e-3), (60.0, 1e-4), (100.0, 1e-5), (125.0, 1e-5), (155.0, 1e-5)]
)
def test_a_robot_as_fast_as_the_sensor_is_not_taken_for_a_slower_one_where_it_shakes(frequency_Hz: float, amplitude_m: float) -> None:
    t_s, z_m, _, _ = rows(1.0, 0.0)
    assert find_reports(t_s, z_m + amplitude_m * np.sin(2.0 * np.pi * frequency_Hz * t_s)).rows_each == 1.0


def test_values_of_uneven_times_are_found_from_those_of_even_ones() -> None:
    uneven_s = np.cumsum(np.random.default_rng(2).uniform(0.8e-3, 1.2e-3, 500))
    even_s = np.linspace(uneven_s[0], uneven_s[-1], 500)
    there = straight_between(uneven_s, even_s) @ np.sin(20.0 * even_s)
    assert float(np.abs(there - np.sin(20.0 * uneven_s)).max()) < 1e-4


@pytest.mark.parametrize("n", [2, 30, 600])
def test_little_or_nothing_is_taken_as_it_is(n: int) -> None:
    t_s = np.arange(float(n))
    assert find_reports(t_s, 0.0 * t_s).rows_each == 1.0
