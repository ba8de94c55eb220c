"""Numbers as people read them: three digits, the unit that suits, an interval that says no more than is known."""

import math

import pytest

from palpd.quantities import kilopascals, number, quantity


@pytest.mark.parametrize(
    ("value", "unit", "ci95", "text"),
    [
        (62.5e3, "Pa", (61.8e3, 63.2e3), "62.5 (61.8 to 63.2) kPa"),
        (141.4e3, "Pa", (139.9e3, 142.9e3), "141 (140 to 143) kPa"),
        (2.05e6, "Pa", None, "2.05 MPa"),
        (0.0664, "1", (0.03995, 0.1483), "0.066 (0.040 to 0.148)"),
        (-4.901e-5, "1", (-6.4e-5, -3.4e-5), "-49 (-64 to -34) ppm"),
        (0.32, "N", (0.3195, 0.3205), "0.320 (0.320 to 0.321) N"),
        (0.0312, "N", None, "31.2 mN"),
        (0.00498, "m", None, "4.98 mm"),
        (0.05, "rad", (0.039, 0.061), "2.9 (2.2 to 3.5)°"),
        (0.057, "kg", None, "57 g"),
        (20e3, "N/m", (19e3, math.inf), "20 (19 to ∞) N/mm"),
        (1.0, "s", (1.0, 1.0), "1 s"),
        (0.0, "N", (-1e-3, 1e-3), "0.0 (-1.0 to 1.0) mN"),
        (0.04, "m²/s²", None, "0.04 m²/s²"),
        (math.nan, "N", None, "– N"),
    ],
)
def test_a_quantity_has_three_digits_the_unit_that_suits_and_one_interval(
    value: float, unit: str, ci95: tuple[float, float] | None, text: str
) -> None:
    assert quantity(value, unit, ci95) == text


def test_a_number_of_many_zeros_has_a_power_of_ten() -> None:
    assert number(1.234e-7) == "1.23·10⁻⁷"
    assert number(999.6) == "1000"


@pytest.mark.parametrize(
    ("modulus_Pa", "half_width_Pa", "text"),
    [
        (137_240.0, 2_310.0, "137.2 ± 2.3"),
        (61_700.0, 400.0, "61.7 ± 0.4"),
        (7_432.0, 61.0, "7.43 ± 0.06"),
        (584.0, 12.4, "0.584 ± 0.012"),
        (-60.0, 12.4, "-0.060 ± 0.012"),
    ],
)
def test_a_soft_tissue_keeps_three_digits_in_kPa(modulus_Pa: float, half_width_Pa: float, text: str) -> None:
    assert f"{kilopascals(modulus_Pa)} ± {kilopascals(half_width_Pa, modulus_Pa)}" == text
    assert kilopascals(None) == "–"
