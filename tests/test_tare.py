"""Two zeros and the axes between them."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from palpd.tare import FREE_N, STABLE_RMS_N, Tare, base_from_sensor, tilt_rad, to_base
from tests.scenes import frames, robot


def collected(wrench: np.ndarray, reference: np.ndarray | None = None, speed_m_per_s: float = 0.0) -> Tare:
    tare = Tare(reference)
    for step in range(len(wrench) // 8):
        t_s = 10.0 + 0.008 * step
        moving = robot(t_s, tcp_speed=(0.0, 0.0, speed_m_per_s, 0.0, 0.0, 0.0))
        tare.add(moving, frames(t_s, wrench=wrench[step * 8 : step * 8 + 8]))
    return tare


def still(rms_N: float = 0.05, mean: float = -50.0) -> np.ndarray:
    return np.random.default_rng(1).normal(mean, rms_N, (1200, 6))


def test_a_quiet_second_is_a_tare_and_its_mean_is_the_zero() -> None:
    tare = collected(still())
    assert tare.refusal() is None
    assert np.allclose(tare.result(), -50.0, atol=0.01)


def test_a_tare_takes_a_whole_second_of_frames() -> None:
    tare = Tare()
    enough = [tare.add(robot(10 + 0.008 * k), frames(10 + 0.008 * k)) for k in range(130)]
    assert enough.index(True) * 0.008 == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize(
    ("tare", "word"),
    [
        (Tare(), "no frame"),
        (collected(still(), speed_m_per_s=0.003), "moved"),
        (collected(still(STABLE_RMS_N * 1.3)), "varied"),
        (collected(still() + np.linspace(0, 0.8, 1200)[:, None]), "warm up"),
        (collected(still(), reference=np.full(6, -50.0 + FREE_N)), "loaded"),
    ],
    ids=["silent", "moving", "shaken", "drifting", "loaded"],
)
def test_what_is_no_tare_is_refused_with_the_reason(tare: Tare, word: str) -> None:
    refusal = tare.refusal()
    assert refusal is not None
    assert word in refusal


def test_a_reference_close_by_does_not_refuse() -> None:
    assert collected(still(), reference=np.full(6, -50.5)).refusal() is None


@pytest.mark.parametrize(
    ("tare", "refused"),
    [
        (collected(still(0.45)), False),
        (collected(still(0.55)), True),
        (collected(still(), speed_m_per_s=0.0019), False),
        (collected(still(), speed_m_per_s=-0.0021), True),
        (collected(still(0.01) + np.linspace(0, 0.36, 1200)[:, None]), False),
        (collected(still(0.01) + np.linspace(0, 0.44, 1200)[:, None]), True),
        (collected(still(0.01), reference=np.array([-50.0, -50.0, -47.1, 0.0, 0.0, 0.0])), False),
        (collected(still(0.01), reference=np.array([-50.0, -50.0, -46.9, 0.0, 0.0, 0.0])), True),
    ],
)
def test_a_tare_may_shake_by_half_a_newton_move_2_mm_per_s_drift_by_a_fifth_and_be_3_N_away(tare: Tare, refused: bool) -> None:
    assert (tare.refusal() is not None) == refused


def test_with_the_tool_down_pressing_is_positive_in_base_axes() -> None:
    rotation = base_from_sensor((math.pi, 0.0, 0.0), 0.0)
    assert to_base([1.0, 0.0, -5.0, 0.5, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0, 0.0, 0.25], rotation) == pytest.approx([0, 0, 5.0, 0.5, 0, 0.25])


def test_the_mounting_angle_turns_about_the_flange() -> None:
    rotation = np.array(base_from_sensor((0.0, 0.0, 0.0), math.pi / 2))
    assert np.allclose(rotation @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    assert np.allclose(rotation @ [0.0, 0.0, 1.0], [0.0, 0.0, 1.0])


@given(st.tuples(*[st.floats(-4, 4)] * 3), st.floats(-4, 4))
def test_a_rotation_keeps_lengths_and_hands(vector: tuple[float, float, float], angle: float) -> None:
    rotation = np.array(base_from_sensor(vector, angle))
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(rotation) == pytest.approx(1.0)


@given(st.tuples(*[st.floats(-4, 4)] * 3))
def test_the_tilt_is_the_angle_between_the_tool_and_straight_down(vector: tuple[float, float, float]) -> None:
    down = base_from_sensor(vector, 0.0)[2][2]
    assert math.cos(tilt_rad(vector)) == pytest.approx(-down, abs=1e-9)
