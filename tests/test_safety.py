"""The guard: what a limit is, and that nothing loosens one."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from palpd.safety import FROZEN_FRAMES, RETRACT_M_PER_S, TILT_RAD, Guard, Sight, guard, sentence
from palpd.tick import NO_FRAMES, STOP, Action, Command, Request, RobotMode, SafetyMode, Timing, Trip, Verdict
from tests.scenes import LIMITS, contact, frames, robot, sight

DOWN = Command((0.0, 0.0, -0.01))


def one(seen: Sight, proposed: Command = DOWN, memory: Guard | None = None) -> tuple[Guard, Verdict]:
    return guard(LIMITS, memory or Guard(), seen, proposed)


def test_a_healthy_sight_passes_the_proposal_unchanged() -> None:
    memory, verdict = one(sight())
    assert verdict == Verdict(DOWN)
    assert not memory.over


def around(limit: float) -> list[tuple[float, bool]]:
    """Values close to a limit on both sides, and whether they are at or beyond it."""
    below, above = math.nextafter(limit, -math.inf), math.nextafter(limit, math.inf)
    return [(0.5 * limit, False), (below, False), (limit, True), (above, True), (2 * limit, True), (1e9, True)]


def forces(name: str) -> Callable[[float], Sight]:
    return lambda value: sight(contact=contact(**{name: value}))


LIMIT_CLAIMS = [
    ("absolute_N", Trip.ABSOLUTE_FORCE, LIMITS.absolute_N),
    ("lateral_N", Trip.LATERAL_FORCE, LIMITS.lateral_N),
    ("torque_Nm", Trip.TORQUE, LIMITS.torque_Nm),
]


@pytest.mark.parametrize(("name", "trip", "limit"), LIMIT_CLAIMS)
def test_a_force_limit_stops_at_its_value_and_not_below(name: str, trip: Trip, limit: float) -> None:
    for value, beyond in around(limit):
        memory, verdict = one(forces(name)(value))
        assert (verdict.trip == trip) == beyond, value
        assert memory.over == beyond
        assert verdict.command == (STOP if beyond else DOWN)


def test_the_contact_limit_retracts_at_its_value_and_not_below() -> None:
    for value, beyond in around(LIMITS.contact_N):
        memory, verdict = one(sight(contact=contact(force_N=value)))
        assert (verdict.action == Action.RETRACT) == beyond
        assert not memory.over
        if beyond:
            assert verdict.command.velocity_m_per_s == (0.0, 0.0, RETRACT_M_PER_S)
            assert RETRACT_M_PER_S > 0.0, "up is away from the tissue"
            assert verdict.trip == Trip.CONTACT_FORCE
            assert verdict.measured == value


def test_a_retract_ends_with_a_stop_at_the_safe_height_and_reports_the_force() -> None:
    memory, _ = one(sight(contact=contact(force_N=13.0)))
    memory, verdict = one(sight(10.008, contact=contact(force_N=1.0)), memory=memory)
    assert verdict.action == Action.RETRACT, "below the limit again is no reason to go on"
    memory, verdict = one(sight(10.016, robot=robot(10.016, z_m=0.031)), memory=memory)
    assert memory.over
    assert verdict == Verdict(STOP, Action.STOP, Trip.CONTACT_FORCE, 13.0, LIMITS.contact_N)


def test_a_fault_while_retracting_stops_there_for_its_own_reason() -> None:
    memory, _ = one(sight(contact=contact(force_N=13.0)))
    memory, verdict = one(sight(10.008, contact=contact(force_N=14.0, absolute_N=26.0)), memory=memory)
    assert memory.over
    assert verdict.command == STOP
    assert verdict.trip == Trip.ABSOLUTE_FORCE


def test_after_the_end_only_stops_go_out() -> None:
    memory, _ = one(sight(contact=contact(absolute_N=30.0)))
    for step in range(1, 5):
        memory, verdict = one(sight(10.0 + 0.008 * step), memory=memory)
        assert verdict.command == STOP
        assert verdict.trip == Trip.ABSOLUTE_FORCE


def test_retaring_under_load_does_not_raise_the_absolute_limit() -> None:
    """The compensated force may be tared away; what is judged against the reference tare is not."""
    _, verdict = one(sight(contact=contact(force_N=0.0, absolute_N=25.0)))
    assert verdict.trip == Trip.ABSOLUTE_FORCE


FAULTS: list[tuple[Trip, Sight]] = [
    (Trip.OPERATOR, sight(request=Request.ABORT)),
    (Trip.SUPERVISOR, sight(request=Request.ORPHANED)),
    (Trip.CONNECTION, sight(robot=robot(connected=False))),
    (Trip.ROBOT_MODE, sight(robot=robot(robot_mode=RobotMode.POWER_OFF))),
    (Trip.SAFETY_MODE, sight(robot=robot(safety_mode=SafetyMode.PROTECTIVE_STOP))),
    (Trip.PROGRAM_STOPPED, sight(robot=robot(runtime_state=1))),
    (Trip.SENSOR_STATUS, sight(frames=frames(status=np.array([0] * 7 + [0x0400], np.uint16)))),
    (Trip.SENSOR_STATUS, sight(frames=frames(status=np.array([0x0200] + [0] * 7, np.uint16)))),
    (Trip.SENSOR_REJECTS, sight(frames=frames(rejected=51))),
    (Trip.LATE_TICKS, sight(timing=Timing(7, 10.0, 10.0, missed=7))),
    (Trip.OVERLOAD, sight(contact=contact(tared=np.full((1, 6), 200.0)))),
    (Trip.TILTED, sight(tilt_rad=math.nextafter(TILT_RAD, 1.0))),
    (Trip.BELOW_MIN_Z, sight(robot=robot(z_m=-0.1001), floor_z_m=-1.0)),
    (Trip.TOO_DEEP, sight(robot=robot(z_m=-0.0506))),
    (Trip.OUTSIDE_WORKSPACE, sight(robot=robot(tcp_pose=(0.6, 0.0, 0.02, math.pi, 0.0, 0.0)))),
    (Trip.OUTSIDE_WORKSPACE, sight(robot=robot(tcp_pose=(0.0, -0.6, 0.02, math.pi, 0.0, 0.0)))),
    (Trip.NOT_FINITE, sight(contact=contact(force_N=math.nan))),
    (Trip.NOT_FINITE, sight(robot=robot(tcp_pose=(0.0, 0.0, math.nan, math.pi, 0.0, 0.0)))),
    (Trip.NOT_FINITE, sight(frames=frames(wrench=np.full((8, 6), np.inf)))),
]


@pytest.mark.parametrize(("trip", "seen"), FAULTS, ids=lambda value: value.name if isinstance(value, Trip) else "")
def test_a_fault_stops_the_arm_where_it_is(trip: Trip, seen: Sight) -> None:
    memory, verdict = one(seen)
    assert verdict.trip == trip
    assert verdict.command == STOP
    assert memory.over


@pytest.mark.parametrize(
    "seen",
    [
        sight(robot=robot(safety_mode=SafetyMode.REDUCED)),
        sight(timing=Timing(6, 10.0, 10.0, missed=6)),
        sight(frames=frames(rejected=50)),
        sight(tilt_rad=TILT_RAD),
        sight(robot=robot(z_m=-0.0505), floor_z_m=-0.05),
        sight(request=Request.PAUSE),
    ],
)
def test_what_is_just_inside_passes(seen: Sight) -> None:
    assert one(seen)[1].action == Action.PASS


def test_a_proposal_that_is_too_fast_or_not_finite_never_goes_out() -> None:
    assert one(sight(), Command((0.0, 0.04, 0.04)))[1].trip == Trip.SPEED
    assert one(sight(), Command((math.nan, 0.0, 0.0)))[1].trip == Trip.NOT_FINITE
    assert one(sight(), Command((0.0, 0.0, 0.05)))[1].action == Action.PASS


def test_a_silent_sensor_stops_and_does_not_retract() -> None:
    memory, _ = one(sight(contact=contact(force_N=5.0)))
    for step in range(1, 30):
        now_s = 10.0 + 0.008 * step
        memory, verdict = one(sight(now_s, frames=NO_FRAMES, contact=contact(force_N=5.0)), memory=memory)
        if verdict.action != Action.PASS:
            break
    assert verdict.trip == Trip.SENSOR_STALE
    assert verdict.command == STOP
    assert now_s - 10.0 == pytest.approx(LIMITS.sensor_stale_s, abs=0.009)


def test_a_sensor_that_never_spoke_stops_too() -> None:
    memory = Guard()
    for step in range(20):
        memory, verdict = one(sight(10.0 + 0.008 * step, frames=NO_FRAMES), memory=memory)
    assert verdict.trip == Trip.SENSOR_STALE


def test_old_frames_that_arrive_late_do_not_make_the_sensor_young() -> None:
    memory, _ = one(sight())
    _, verdict = one(sight(10.1, robot=robot(10.1), frames=frames(10.02)), memory=memory)
    assert verdict.trip == Trip.SENSOR_STALE


@pytest.mark.parametrize("rate_Hz", [125, 500])
def test_rejected_frames_are_counted_over_a_second_whatever_the_rate(rate_Hz: int) -> None:
    def after(pause_s: float) -> Verdict:
        memory, verdict = one(sight(frames=frames(rejected=40)))
        for k in range(1, round(pause_s * rate_Hz) + 1):
            now_s = 10.0 + k / rate_Hz
            some = frames(now_s, rejected=40 if now_s >= 10.0 + pause_s else 0, seed=k)
            memory, verdict = one(sight(now_s, frames=some), memory=memory)
        return verdict

    soon, later = after(1.2), after(1.6)  # 40 exp(-1.2) + 40 = 52.0, 40 exp(-1.6) + 40 = 48.1, and 50 are allowed
    assert (soon.trip, later.action) == (Trip.SENSOR_REJECTS, Action.PASS)
    assert soon.measured == pytest.approx(40 * (1 + math.exp(-1.2)))


def test_a_robot_that_falls_silent_after_it_was_heard_is_stale() -> None:
    memory, verdict = one(sight(10.0))
    memory, verdict = one(sight(10.008), memory=memory)
    assert (memory.robot_heard_s, verdict.action) == (10.008, Action.PASS)
    _, verdict = one(sight(10.07, robot=robot(10.008)), memory=memory)
    assert verdict.trip == Trip.ROBOT_STALE


def test_a_robot_that_repeats_itself_is_stale() -> None:
    memory = Guard()
    for step in range(20):
        memory, verdict = one(sight(10.0 + 0.008 * step, robot=robot(10.0)), memory=memory)
        if verdict.action != Action.PASS:
            break
    assert verdict.trip == Trip.ROBOT_STALE
    assert step == 7


def test_a_sensor_stuck_to_the_last_digit_is_found() -> None:
    memory = Guard()
    stuck = np.full((8, 6), 0.3)
    for step in range(FROZEN_FRAMES // 8 + 3):
        now_s = 10.0 + 0.008 * step
        memory, verdict = one(sight(now_s, frames=frames(now_s, wrench=stuck)), memory=memory)
        if verdict.action != Action.PASS:
            break
    assert verdict.trip == Trip.SENSOR_FROZEN
    assert step >= FROZEN_FRAMES // 8
    _, verdict = one(sight(), memory=memory._replace(over=False, trip=Trip.NONE, equal_frames=FROZEN_FRAMES))
    assert verdict.action == Action.PASS, "one frame that differs is life"


def test_no_workspace_and_no_floor_mean_no_such_trip() -> None:
    free = replace(LIMITS, workspace_m=None, min_z_m=None)
    _, verdict = guard(free, Guard(), sight(robot=robot(z_m=-3.0), floor_z_m=-math.inf), DOWN)
    assert verdict.action == Action.PASS


@pytest.mark.parametrize("trip", [trip for trip in Trip if trip != Trip.NONE])
def test_every_trip_has_a_sentence_with_its_numbers(trip: Trip) -> None:
    text = sentence(Verdict(STOP, Action.STOP, trip, 13.25, 12.0))
    assert len(text) > 15
    assert "{" not in text


numbers = st.floats(allow_nan=True, allow_infinity=True)


@given(force=numbers, absolute=numbers, lateral=numbers, torque=numbers, z_m=numbers, speed=numbers, tilt=st.floats(0, 4))
def test_whatever_comes_a_command_that_goes_out_is_finite_and_slow(
    force: float, absolute: float, lateral: float, torque: float, z_m: float, speed: float, tilt: float
) -> None:
    seen = sight(
        contact=contact(force_N=force, absolute_N=absolute, lateral_N=lateral, torque_Nm=torque), robot=robot(z_m=z_m), tilt_rad=tilt
    )
    memory, verdict = one(seen, Command((0.0, 0.0, speed)))
    velocity = verdict.command.velocity_m_per_s
    assert all(math.isfinite(v) for v in velocity)
    assert math.dist(velocity, (0.0, 0.0, 0.0)) <= LIMITS.max_speed_m_per_s * (1 + 1e-6)
    if not verdict.command.stop and verdict.action == Action.PASS:
        assert absolute < LIMITS.absolute_N
        assert force < LIMITS.contact_N
    assert memory.over == verdict.command.stop


@given(st.lists(st.floats(-100, 100), min_size=1, max_size=30))
def test_nothing_follows_a_stop_but_stops(forces_N: list[float]) -> None:
    memory, stopped = Guard(), False
    for step, force_N in enumerate(forces_N):
        seen = sight(10.0 + 0.008 * step, contact=contact(absolute_N=abs(force_N)))
        memory, verdict = one(seen, memory=memory)
        assert not (stopped and not verdict.command.stop)
        stopped = stopped or verdict.command.stop
        assert stopped == any(abs(f) >= LIMITS.absolute_N for f in forces_N[: step + 1])


def test_the_newest_of_several_frames_is_what_the_next_ones_are_compared_with() -> None:
    one_row, other_row = np.full(6, 0.3), np.full(6, 0.4)
    memory, _ = one(sight(frames=frames(n=2, wrench=np.array([one_row, other_row]))))
    memory, _ = one(sight(frames=frames(n=2, wrench=np.array([other_row, other_row]))), memory=memory)
    assert memory.equal_frames == 2
    memory, _ = one(sight(frames=frames(n=2, wrench=np.array([other_row, one_row]))), memory=memory)
    assert memory.equal_frames == 0


def test_the_newest_frame_tells_how_old_the_sensor_is() -> None:
    late = replace(frames(), t_s=np.linspace(9.9, 10.0, 8))
    assert one(sight(frames=late))[1].action == Action.PASS
    assert one(sight(frames=late))[0].sensor_heard_s == 10.0
