"""Two zeros and the axes between them."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from palpd.control.tare import STABLE_RMS_N, Tare, base_from_sensor, tilt_rad, to_base
from palpd.tick import NO_FRAMES
from tests.scenes import frames, robot

vectors = st.tuples(*[st.floats(-4, 4)] * 3)


def collected(wrench: np.ndarray, speed_m_per_s: float = 0.0) -> Tare:
    tare = Tare()
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
    ],
    ids=["silent", "moving", "shaken", "drifting"],
)
def test_what_is_no_tare_is_refused_with_the_reason(tare: Tare, word: str) -> None:
    refusal = tare.refusal()
    assert refusal is not None
    assert word in refusal


def test_the_reason_names_what_was_measured() -> None:
    assert collected(still(), speed_m_per_s=0.5).refusal() == (
        "the arm moved at 500.0 mm/s during the tare, expected below 2 mm/s; let it come to rest"
    )


def rested(*wrenches: list[float], tcp_speed: tuple[float, ...] = (0.0,) * 6) -> str | None:
    """What is said of these frames."""
    tare = Tare()
    tare.add(robot(tcp_speed=tcp_speed), frames(n=len(wrenches), wrench=np.array(wrenches)))
    return tare.refusal()


NOUGHT = [0.0] * 6


def test_what_is_exactly_allowed_is_a_tare() -> None:
    assert rested(NOUGHT) is None, "one frame has no halves"
    assert rested(NOUGHT, NOUGHT, tcp_speed=(0.002, 0.0, 0.0, 0.0, 0.0, 0.0)) is None
    assert rested([1.0] + [0.0] * 5, NOUGHT, NOUGHT, [1.0] + [0.0] * 5) is None, "0.5 N rms"
    assert rested(NOUGHT, [0.0, 0.2, 0.0, 0.0, 0.0, 0.0]) is None


def test_only_forces_and_speeds_are_judged_not_torques_and_turns() -> None:
    swinging, drifted = [0.0] * 3 + [2.0] * 3, [0.0] * 3 + [0.9] * 3
    assert rested(swinging, NOUGHT, NOUGHT, swinging) is None
    assert rested(NOUGHT, drifted) is None
    assert rested(NOUGHT, NOUGHT, tcp_speed=(0.0, 0.0, 0.0, 0.5, 0.5, 0.5)) is None


def test_a_sensor_that_sends_the_same_numbers_for_ever_does_not_vary() -> None:
    assert collected(still()).varies
    assert not collected(np.full((1200, 6), -50.0)).varies


def test_the_halves_of_a_tare_are_compared() -> None:
    """A step in the middle shows whole; between a third and the rest only three quarters of it would."""
    assert rested(*[NOUGHT] * 6, *[[0.0, 0.0, 0.21, 0.0, 0.0, 0.0]] * 6) is not None
    assert rested(*[NOUGHT] * 6, *[[0.0, 0.0, 0.19, 0.0, 0.0, 0.0]] * 6) is None


def test_a_second_is_from_the_first_frame_of_all_to_the_newest() -> None:
    tare = Tare()
    assert not tare.add(robot(), NO_FRAMES)
    assert not tare.add(robot(), replace(frames(n=2), t_s=np.array([10.0, 10.5])))
    assert not tare.add(robot(), replace(frames(n=2), t_s=np.array([10.9, 10.99])))
    assert tare.add(robot(), replace(frames(n=2), t_s=np.array([10.995, 11.0])))
    assert tare.add(robot(), NO_FRAMES)


@pytest.mark.parametrize(
    ("tare", "refused"),
    [
        (collected(still(0.45)), False),
        (collected(still(0.55)), True),
        (collected(still(), speed_m_per_s=0.0019), False),
        (collected(still(), speed_m_per_s=-0.0021), True),
        (collected(still(0.01) + np.linspace(0, 0.36, 1200)[:, None]), False),
        (collected(still(0.01) + np.linspace(0, 0.44, 1200)[:, None]), True),
    ],
)
def test_a_tare_may_shake_by_half_a_newton_move_2_mm_per_s_and_drift_by_a_fifth(tare: Tare, refused: bool) -> None:
    assert (tare.refusal() is not None) == refused


def test_with_the_tool_down_pressing_is_positive_in_base_axes() -> None:
    rotation = base_from_sensor((math.pi, 0.0, 0.0), 0.0)
    assert to_base([1.0, 0.0, -5.0, 0.5, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0, 0.0, 0.25], rotation) == pytest.approx([0, 0, 5.0, 0.5, 0, 0.25])


@given(st.lists(st.floats(-50, 50), min_size=6, max_size=6), vectors, st.floats(-4, 4))
def test_force_and_torque_are_turned_alike(wrench: list[float], vector: tuple[float, float, float], angle: float) -> None:
    rotation, zero = base_from_sensor(vector, angle), [1.0, -2.0, 3.0, 0.5, -0.25, 0.125]
    free = np.reshape(np.subtract(wrench, zero), (2, 3))
    assert to_base(wrench, zero, rotation) == pytest.approx((free @ np.array(rotation).T).ravel(), abs=1e-9)


def test_a_wrench_of_other_length_than_its_zero_is_no_wrench() -> None:
    with pytest.raises(ValueError, match="shorter"):
        to_base([0.0] * 7, [0.0] * 6, base_from_sensor((0.0, 0.0, 0.0), 0.0))


def test_the_mounting_angle_turns_about_the_flange() -> None:
    rotation = np.array(base_from_sensor((0.0, 0.0, 0.0), math.pi / 2))
    assert np.allclose(rotation @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    assert np.allclose(rotation @ [0.0, 0.0, 1.0], [0.0, 0.0, 1.0])


@given(vectors, st.floats(-4, 4))
@example((0.0, 0.0, 5e-324), 0.0)
def test_the_axes_are_those_of_the_rotation_vector_and_the_mounting_angle(vector: tuple[float, float, float], angle: float) -> None:
    expected = Rotation.from_rotvec(vector) * Rotation.from_euler("z", angle)
    assert np.allclose(base_from_sensor(vector, angle), expected.as_matrix(), atol=1e-9)


def test_small_tilts_are_as_exact_as_large_ones() -> None:
    assert tilt_rad((math.pi, 0.0, 0.0)) == pytest.approx(0.0, abs=1e-15)
    assert tilt_rad((math.pi - 1e-9, 0.0, 0.0)) == pytest.approx(1e-9, rel=1e-6)
    assert tilt_rad((0.0, 0.0, 0.0)) == pytest.approx(math.pi)


@given(vectors)
def test_the_tilt_is_the_angle_between_the_tool_and_straight_down(vector: tuple[float, float, float]) -> None:
    down = base_from_sensor(vector, 0.0)[2][2]
    assert math.cos(tilt_rad(vector)) == pytest.approx(-down, abs=1e-9)
