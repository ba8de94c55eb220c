"""What the published tables of Guo, Xiao, Ren 2019 say when they are computed again."""

import csv

import numpy as np
import pytest
from scipy.optimize import curve_fit

from palpd.analysis.young import modulus_hertz_Pa, modulus_peak_Pa, ymbt
from palpd.tick import Floats
from tests.paths import ROOT

TABLES = ROOT / "palpd" / "study" / "paper"
RADIUS_M, POISSON_RATIO = 0.005, 0.5
SETUPS = ("none", "inclusion_5mm", "inclusion_8mm", "inclusion_10mm")


def rows(name: str) -> list[dict[str, str]]:
    with (TABLES / name).open(newline="") as file:
        return list(csv.DictReader(file))


def static(setup: str) -> tuple[Floats, Floats, Floats]:
    """Depths, forces and published moduli of one setup of Table 1."""
    of_setup = [row for row in rows("table1_static.csv") if row["setup"] == setup]
    columns = ("depth_m", "force_N", "published_youngs_modulus_Pa")
    return tuple(np.array([float(row[name]) for row in of_setup]) for name in columns)  # type: ignore[return-value]


def averages() -> dict[str, dict[str, float]]:
    """Table 2 by setup."""
    return {row["setup"]: {key: float(value) for key, value in row.items() if key != "setup"} for row in rows("table2_average_modulus.csv")}


def test_table_1_follows_from_its_own_forces_and_depths() -> None:
    away = []
    for setup in SETUPS:
        for depth_m, force_N, published_Pa in zip(*static(setup), strict=True):
            away.append(modulus_peak_Pa(force_N, depth_m, RADIUS_M, POISSON_RATIO) / published_Pa - 1.0)
    assert len(away) == 32
    assert min(away) == pytest.approx(-0.005, abs=0.001)
    assert max(away) == pytest.approx(0.0065, abs=0.001)


def test_table_1_is_hertz_as_well_since_the_phantom_does_not_change_volume() -> None:
    depth_m, force_N, _ = static("none")
    for d, f in zip(depth_m, force_N, strict=True):
        assert modulus_peak_Pa(f, d, RADIUS_M, POISSON_RATIO) == pytest.approx(modulus_hertz_Pa(f, d, RADIUS_M, POISSON_RATIO))


def test_the_static_column_of_table_2_is_the_mean_of_table_1() -> None:
    for setup, row in averages().items():
        assert row["static_Pa"] == pytest.approx(static(setup)[2].mean(), rel=2e-4)


def test_table_3_follows_from_table_2() -> None:
    table = averages()
    for row in rows("table3_bias.csv"):
        of_setup = table[row["setup"]]
        for dynamic in ("original", "corrected"):
            computed = 100.0 * ymbt(of_setup[f"{dynamic}_Pa"], of_setup["static_Pa"])
            assert computed == pytest.approx(float(row[f"ymbt_{dynamic}_static_percent"]), abs=0.02)


def test_the_correction_is_one_modulus_and_hence_one_force_in_all_setups() -> None:
    taken_Pa = [row["original_Pa"] - row["corrected_Pa"] for row in averages().values()]
    assert taken_Pa == pytest.approx([6869, 6660, 6740, 6690])
    assert np.ptp(taken_Pa) / np.mean(taken_Pa) < 0.035


def test_the_mean_force_of_free_motion_alone_makes_that_correction() -> None:
    bias_N, depth_m = 0.1929, 0.0037
    assert modulus_peak_Pa(bias_N, depth_m, RADIUS_M, POISSON_RATIO) == pytest.approx(6740, rel=0.05)


def test_inertia_of_the_papers_motion_is_two_orders_below_its_bias() -> None:
    t_s = np.linspace(0.0, 4.0, 4001)
    height_m = 0.01 * (1.0 - np.cos(2.0 * np.pi * t_s / 8.0))  # 2 cm in 4 s, from rest to rest
    inertia_N = -0.2 * np.gradient(np.gradient(height_m, t_s), t_s)
    assert np.abs(inertia_N).max() < 0.1929 / 100
    assert abs(inertia_N.mean()) < 1e-5


@pytest.mark.parametrize(("setup", "exponent"), list(zip(SETUPS, (1.36, 1.61, 1.84, 1.49), strict=True)))
def test_force_grows_with_depth_by_these_exponents(setup: str, exponent: float) -> None:
    depth_m, force_N, _ = static(setup)
    assert np.polyfit(np.log(depth_m), np.log(force_N), 1)[0] == pytest.approx(exponent, abs=0.01)


def test_the_plain_phantom_was_touched_half_a_millimetre_before_the_zero_of_depth() -> None:
    depth_m, force_N, _ = static("none")

    def hertz(depth_mm: Floats, scale: float, early_mm: float) -> Floats:
        return scale * (depth_mm + early_mm) ** 1.5

    relative, _ = curve_fit(hertz, depth_m * 1e3, force_N, p0=(0.3, 0.1), sigma=force_N)
    absolute, _ = curve_fit(hertz, depth_m * 1e3, force_N, p0=(0.3, 0.1))
    assert min(relative[1], absolute[1]) > 0.35
    assert max(relative[1], absolute[1]) < 0.55


def test_after_the_correction_the_plain_phantom_is_still_a_third_too_stiff() -> None:
    plain = averages()["none"]
    assert ymbt(plain["corrected_Pa"], plain["static_Pa"]) == pytest.approx(0.32, abs=0.005)


@pytest.mark.parametrize(("noise_counts", "largest_N"), [(0.1, 0.037), (0.2, 0.019), (0.3, 0.007)])
def test_a_tare_keeps_a_rounding_error_that_the_next_tare_redraws(noise_counts: float, largest_N: float) -> None:
    count_N = 0.131
    rng = np.random.default_rng(0)
    noise = rng.normal(0.0, noise_counts, 100_000)
    errors_N = [abs(float(np.mean(np.round(at + noise))) - at) * count_N for at in np.linspace(0.0, 0.5, 51)]
    assert max(errors_N) == pytest.approx(largest_N, abs=0.0015)
