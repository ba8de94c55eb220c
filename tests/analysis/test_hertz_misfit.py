"""Whether moduli change with depth: a law outside Hertz is said beside the number, and presses of one half-space are left alone."""

from typing import Any

import numpy as np
import pytest

from palpd.analysis.hertz_misfit import SIGNIFICANCE, misfit_over_depth
from palpd.analysis.modulus_intervals import KnownWeight, Measured, PressScatter
from palpd.analysis.young import fit_contact, modulus_hertz_Pa

DEPTHS_M = (0.004, 0.006, 0.008)
RADIUS_M, SURFACE_M = 0.005, 3e-5
SCATTER = PressScatter(0.01, 2e-5)


def held(moduli_kPa: tuple[float, ...], noise_N: float = 0.005) -> dict[float, list[Measured]]:
    """One hold a depth of these moduli."""
    per_N = [modulus_hertz_Pa(1.0, depth_m, RADIUS_M, 0.5) for depth_m in DEPTHS_M]
    return {
        depth_m: [Measured(1e3 * modulus_kPa, 1e3 * modulus_kPa / one_N, depth_m, noise_N)]
        for depth_m, modulus_kPa, one_N in zip(DEPTHS_M, moduli_kPa, per_N, strict=False)
    }


def test_a_modulus_of_105_to_135_kilopascals_over_depth_is_no_single_modulus() -> None:
    misfit = misfit_over_depth(held((105.0, 119.0, 135.0)), SCATTER, SURFACE_M)
    assert misfit is not None
    assert (misfit["low_Pa"], misfit["high_Pa"]) == pytest.approx((105e3, 135e3))
    assert misfit["sentence"].startswith("Hertz does not fit: E changes with depth, from 105 kPa at 4 mm to 135 kPa at 8 mm")


def test_moduli_that_differ_by_the_scatter_of_presses_are_one() -> None:
    assert misfit_over_depth(held((118.0, 119.0, 120.5)), SCATTER, SURFACE_M) is None
    assert misfit_over_depth(held((119.0,)), SCATTER, SURFACE_M) is None
    assert misfit_over_depth({}, SCATTER, SURFACE_M) is None


@pytest.mark.parametrize(
    ("moduli_kPa", "causes"),
    [
        (tuple(120.0 * (1.0 - 1.5 * 4e-4 / depth_m) for depth_m in DEPTHS_M), {"surface_sigma_m": 4e-4}),
        (tuple(120.0 - modulus_hertz_Pa(0.4, depth_m, RADIUS_M, 0.5) / 1e3 for depth_m in DEPTHS_M), {"zero_sigma_N": 0.4}),
        (tuple(120.0 - modulus_hertz_Pa(0.4, depth_m, RADIUS_M, 0.5) / 1e3 for depth_m in DEPTHS_M), {"weight": KnownWeight(0.0, 0.4)}),
    ],
)
def test_what_moves_all_moduli_together_is_no_change_with_depth(moduli_kPa: tuple[float, ...], causes: dict[str, Any]) -> None:
    stated: dict[str, Any] = {"surface_sigma_m": SURFACE_M}
    assert misfit_over_depth(held(moduli_kPa), SCATTER, **stated) is not None
    assert misfit_over_depth(held(moduli_kPa), SCATTER, **stated | causes) is None


def test_noisy_holds_show_no_change_with_depth() -> None:
    assert misfit_over_depth(held((105.0, 119.0, 135.0), noise_N=0.6), SCATTER, SURFACE_M) is None


def test_repeats_that_scatter_more_than_stated_count_by_their_own_scatter() -> None:
    wide = {
        depth_m: [press._replace(modulus_Pa=press.modulus_Pa * share) for share in (0.85, 1.15)]
        for depth_m, (press,) in held((113.0, 119.0, 125.0)).items()
    }
    narrow = {depth_m: group * 8 for depth_m, group in held((113.0, 119.0, 125.0)).items()}
    assert misfit_over_depth(wide, SCATTER, SURFACE_M) is None
    assert misfit_over_depth(narrow, SCATTER, SURFACE_M) is not None


def test_one_in_a_hundred_half_spaces_is_called_otherwise() -> None:
    rng = np.random.default_rng(5)
    false = 0
    for _ in range(2000):
        moduli = held(tuple(100.0 * (1.0 + 0.01 * rng.normal(size=3))), noise_N=0.0)
        surface_m = SURFACE_M * rng.normal()
        shifted = {
            depth_m: [press._replace(modulus_Pa=press.modulus_Pa * (1.0 + 1.5 * (surface_m + 2e-5 * rng.normal()) / depth_m))]
            for depth_m, (press,) in moduli.items()
        }
        false += misfit_over_depth(shifted, SCATTER, SURFACE_M) is not None
    assert false / 2000 == pytest.approx(SIGNIFICANCE, abs=0.008)


@pytest.mark.parametrize("contrast", [0.0, 2.0])
def test_the_interval_of_a_loading_curve_covers_the_moduli_over_depth_where_hertz_does_not_fit(contrast: float) -> None:
    depth_m = np.linspace(-0.003, 0.008, 4000)
    inside_m = np.maximum(depth_m, 0.0)
    x = inside_m / 0.015
    force_N = inside_m**1.5 / modulus_hertz_Pa(1.0, 1.0, RADIUS_M, 0.5) * 90e3 * (1.0 + contrast * x**2 / (1.0 + x**2))
    fit = fit_contact(-depth_m, force_N + np.random.default_rng(3).normal(0.0, 0.02, len(depth_m)), RADIUS_M, 0.5, contact_m=0.0)
    assert (fit.misfit is not None) == (contrast > 0.0)
    if fit.misfit is not None:
        assert fit.misfit["low_Pa"] < 112e3 < 125e3 < fit.misfit["high_Pa"]
        assert fit.ci95_Pa[0] <= fit.misfit["low_Pa"]
        assert fit.misfit["high_Pa"] <= fit.ci95_Pa[1]
