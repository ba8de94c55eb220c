"""Two slopes of Fz that part where the sensor carries nothing: what a sensor of that law gives becomes linear again."""

import numpy as np
import pytest

from palpd.control.slopes import FzSlopes

RATIO, WEIGHT_N = 1656 / 1528, 1.96


def reading_N(load_N: float) -> float:
    """What a sensor of that law gives for a load, pressed positive, in newtons by the slope for pressing."""
    return load_N * (1.0 if load_N > 0.0 else RATIO)


@pytest.mark.parametrize("hanging_N", [WEIGHT_N, 0.0, -WEIGHT_N])
@pytest.mark.parametrize("contact_N", [-3.0, -0.5, 0.0, 0.3, 1.95, 1.97, 12.0])
def test_a_contact_is_read_as_it_is_whatever_hangs_on_the_sensor(hanging_N: float, contact_N: float) -> None:
    offset_N = 56.0  # the sensor's own zero
    zero = [1.0, 2.0, offset_N - reading_N(-hanging_N), 0.1, 0.2, 0.3]
    wrench = [4.0, 5.0, offset_N - reading_N(contact_N - hanging_N), 0.4, 0.5, 0.6]
    corrected = FzSlopes(RATIO, hanging_N).corrected(wrench, zero)
    assert zero[2] - corrected[2] == pytest.approx(contact_N, abs=1e-12)
    assert corrected[:2] + corrected[3:] == wrench[:2] + wrench[3:]


def test_without_the_correction_every_contact_has_too_much() -> None:
    contacts_N = np.array([2.5, 5.0, 10.0])
    read = [reading_N(c - WEIGHT_N) - reading_N(-WEIGHT_N) for c in contacts_N]
    np.testing.assert_allclose(read - contacts_N, (RATIO - 1.0) * WEIGHT_N)
    assert pytest.approx(0.164, abs=0.001) == (RATIO - 1.0) * WEIGHT_N


def test_one_slope_changes_nothing() -> None:
    wrench, zero = [0.0, 0.0, -7.0, 0.0, 0.0, 0.0], [0.0, 0.0, 3.0, 0.0, 0.0, 0.0]
    assert FzSlopes(1.0, WEIGHT_N).corrected(wrench, zero) == pytest.approx(wrench)
