"""The guard: what a limit is, and that nothing loosens one."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from palpd.control.safety import DEPTH_MARGIN_M, FROZEN_FRAMES, RETRACT_M_PER_S, TILT_RAD, GuardState, Limits, guard, sentence
from palpd.tick import (
    NO_FRAMES,
    PROGRAM_PLAYING,
    STOP,
    Action,
    Command,
    Observation,
    Progress,
    Request,
    RobotMode,
    SafetyMode,
    Timing,
    Trip,
    Verdict,
)
from tests.scenes import LIMITS, STEP, contact, frames, observation, robot

DOWN = Command((0.0, 0.0, -0.01))


def one(
    seen: Observation, proposed: Command = DOWN, state: GuardState | None = None, limits: Limits = LIMITS, bounds: Progress = STEP
) -> tuple[GuardState, Verdict]:
    return guard(limits, state or GuardState(), seen, bounds, proposed)


def test_a_healthy_observation_passes_the_proposal_unchanged() -> None:
    state, verdict = one(observation())
    assert verdict == Verdict(DOWN)
    assert not state.over
    assert (state.trip, state.measured, state.limit, state.retracting) == (Trip.NONE, 0.0, 0.0, False)


def test_a_step_without_bounds_and_an_observation_without_tilt_have_none() -> None:
    healthy = observation()
    seen = Observation(healthy.timing, healthy.robot, healthy.frames, healthy.contact)
    assert one(seen, bounds=Progress())[1] == Verdict(DOWN)


def test_the_numbers_of_the_safety_argument() -> None:
    """As docs/safety.md gives them: changing one means changing the argument."""
    assert RETRACT_M_PER_S == 0.02
    assert DEPTH_MARGIN_M == 0.0005
    assert math.degrees(TILT_RAD) == pytest.approx(2.0)
    assert FROZEN_FRAMES == 200
    assert (LIMITS.max_rejected_per_s, LIMITS.overload_N, LIMITS.needs_program) == (50.0, 200.0, True)


def around(limit: float) -> list[tuple[float, bool]]:
    """Values close to a limit on both sides, and whether they are at or beyond it."""
    below, above = math.nextafter(limit, -math.inf), math.nextafter(limit, math.inf)
    return [(0.5 * limit, False), (below, False), (limit, True), (above, True), (2 * limit, True), (1e9, True)]


def forces(name: str) -> Callable[[float], Observation]:
    return lambda value: observation(contact=contact(**{name: value}))


LIMIT_CLAIMS = [
    ("absolute_N", Trip.ABSOLUTE_FORCE, LIMITS.absolute_N),
    ("lateral_N", Trip.LATERAL_FORCE, LIMITS.lateral_N),
    ("torque_Nm", Trip.TORQUE, LIMITS.torque_Nm),
]


@pytest.mark.parametrize(("name", "trip", "limit"), LIMIT_CLAIMS)
def test_a_force_limit_stops_at_its_value_and_not_below(name: str, trip: Trip, limit: float) -> None:
    for value, beyond in around(limit):
        state, verdict = one(forces(name)(value))
        assert verdict == (Verdict(STOP, Action.STOP, trip, value, limit) if beyond else Verdict(DOWN))
        assert state.over == beyond


def test_the_contact_limit_retracts_at_its_value_and_not_below() -> None:
    for value, beyond in around(LIMITS.contact_N):
        state, verdict = one(observation(contact=contact(force_N=value)))
        assert (verdict.action == Action.RETRACT) == beyond
        assert not state.over
        if beyond:
            assert verdict.command.velocity_m_per_s == (0.0, 0.0, RETRACT_M_PER_S)
            assert (verdict.trip, verdict.measured, verdict.limit) == (Trip.CONTACT_FORCE, value, LIMITS.contact_N)


def test_a_retract_is_no_faster_than_the_arm_may_be() -> None:
    _, verdict = one(observation(contact=contact(force_N=13.0)), limits=replace(LIMITS, max_speed_m_per_s=0.015))
    assert verdict.command.velocity_m_per_s == (0.0, 0.0, 0.015)


def test_a_retract_ends_with_a_stop_at_the_safe_height_and_reports_the_force() -> None:
    state, _ = one(observation(contact=contact(force_N=13.0)))
    state, verdict = one(observation(10.008, contact=contact(force_N=14.0)), state=state)
    assert (verdict.action, verdict.measured) == (Action.RETRACT, 13.0), "the verdict names the force that tripped, not a later one"
    state, verdict = one(observation(10.009, contact=contact(force_N=1.0)), state=state)
    assert verdict.action == Action.RETRACT, "below the limit again is no reason to go on"
    state, verdict = one(observation(10.016, robot=robot(10.016, z_m=0.03)), state=state)
    assert state.over
    assert verdict == Verdict(STOP, Action.STOP, Trip.CONTACT_FORCE, 13.0, LIMITS.contact_N)


def test_a_fault_while_retracting_stops_there_for_its_own_reason() -> None:
    state, _ = one(observation(contact=contact(force_N=13.0)))
    state, verdict = one(observation(10.008, contact=contact(force_N=14.0, absolute_N=26.0)), state=state)
    assert state.over
    assert verdict.command == STOP
    assert verdict.trip == Trip.ABSOLUTE_FORCE


def test_after_the_end_only_stops_go_out() -> None:
    state, _ = one(observation(contact=contact(absolute_N=30.0)))
    for step in range(1, 5):
        state, verdict = one(observation(10.0 + 0.008 * step), state=state)
        assert verdict == Verdict(STOP, Action.STOP, Trip.ABSOLUTE_FORCE, 30.0, LIMITS.absolute_N)


def test_retaring_under_load_does_not_raise_the_absolute_limit() -> None:
    """The compensated force may be tared away; what is judged against the reference tare is not."""
    _, verdict = one(observation(contact=contact(force_N=0.0, absolute_N=25.0)))
    assert verdict.trip == Trip.ABSOLUTE_FORCE


FORCE_OF_200_N = np.array([[0.0, 0.0, -200.0, 0.0, 0.0, 0.0], [0.0] * 6])
TOO_TILTED = math.nextafter(TILT_RAD, 1.0)
IN_FLOOR_M, IN_WALL_M = -0.1001, math.nextafter(0.5, 1.0)
FAULTS: list[tuple[Trip, Observation, float, float]] = [  # with what is measured and what was expected
    (Trip.OPERATOR, observation(request=Request.ABORT), 1.0, 0.0),
    (Trip.SUPERVISOR, observation(request=Request.ORPHANED), 1.0, 0.0),
    (Trip.CONNECTION, observation(robot=robot(connected=False)), 1.0, 0.0),
    (Trip.ROBOT_MODE, observation(robot=robot(robot_mode=RobotMode.POWER_OFF)), RobotMode.POWER_OFF, RobotMode.RUNNING),
    (Trip.SAFETY_MODE, observation(robot=robot(safety_mode=SafetyMode.PROTECTIVE_STOP)), SafetyMode.PROTECTIVE_STOP, SafetyMode.NORMAL),
    (Trip.PROGRAM_STOPPED, observation(robot=robot(runtime_state=1)), 1, PROGRAM_PLAYING),
    (Trip.SENSOR_STATUS, observation(frames=frames(status=np.array([0] * 7 + [0x0400], np.uint16))), 0x0400, 0.0),
    (Trip.SENSOR_STATUS, observation(frames=frames(status=np.array([0x0200] + [0] * 7, np.uint16))), 0x0200, 0.0),
    (Trip.SENSOR_REJECTS, observation(frames=frames(rejected=51)), 51.0, 50.0),
    (Trip.LATE_TICKS, observation(timing=Timing(7, 10.0, 10.0, missed=7)), 7, LIMITS.max_missed_ticks),
    (Trip.OVERLOAD, observation(contact=contact(tared=FORCE_OF_200_N)), 200.0, 200.0),
    (Trip.TILTED, observation(tilt_rad=TOO_TILTED), TOO_TILTED, TILT_RAD),
    (Trip.BELOW_MIN_Z, observation(robot=robot(z_m=IN_FLOOR_M)), IN_FLOOR_M, -0.1),
    (Trip.TOO_DEEP, observation(robot=robot(z_m=-0.0506)), -0.0506, -0.05 - DEPTH_MARGIN_M),
    (Trip.OUTSIDE_WORKSPACE, observation(robot=robot(tcp_pose=(IN_WALL_M, 0.0, 0.02, math.pi, 0.0, 0.0))), IN_WALL_M, 0.5),
    (Trip.OUTSIDE_WORKSPACE, observation(robot=robot(tcp_pose=(0.0, -0.6, 0.02, math.pi, 0.0, 0.0))), -0.6, -0.5),
    (Trip.OUTSIDE_WORKSPACE, observation(robot=robot(z_m=0.51)), 0.51, 0.5),
]


@pytest.mark.parametrize(("trip", "seen", "measured", "limit"), FAULTS, ids=[fault[0].name for fault in FAULTS])
def test_a_fault_stops_the_arm_where_it_is_and_says_what_was_measured(trip: Trip, seen: Observation, measured: float, limit: float) -> None:
    state, verdict = one(seen)
    assert verdict == Verdict(STOP, Action.STOP, trip, measured, limit)
    assert state.over


def spoilt(values: tuple[float, ...], at: int) -> tuple[float, ...]:
    return (*values[:at], math.nan, *values[at + 1 :])


BAD = np.array([[0.0] * 6] * 7 + [[0.0] * 5 + [math.inf]])
NOT_FINITE: list[Observation] = [
    observation(contact=contact(force_N=math.nan)),
    observation(contact=contact(absolute_N=math.inf)),
    observation(contact=contact(lateral_N=-math.inf)),
    observation(contact=contact(torque_Nm=math.nan)),
    observation(timing=Timing(0, 10.0, math.nan)),
    observation(robot=robot(math.inf)),
    *[observation(robot=robot(tcp_pose=spoilt(robot().tcp_pose, at))) for at in range(6)],
    *[observation(robot=robot(tcp_speed=spoilt(robot().tcp_speed, at))) for at in range(6)],
    *[observation(robot=robot(target_pose=spoilt(robot().target_pose, at))) for at in range(6)],
    observation(frames=frames(wrench=BAD)),
    observation(frames=frames(wrench=-BAD)),
    observation(frames=replace(frames(), t_s=np.array([math.nan] + [10.0] * 7))),
    observation(frames=replace(frames(wrench=BAD), t_s=np.array([-math.inf] + [10.0] * 7))),
]


@pytest.mark.parametrize("seen", NOT_FINITE)
def test_one_number_that_is_not_finite_stops_the_arm(seen: Observation) -> None:
    assert one(seen)[1] == Verdict(STOP, Action.STOP, Trip.NOT_FINITE, 1.0, 0.0)


def test_numbers_are_finite_where_their_sum_is_not() -> None:
    assert one(observation(frames=frames(wrench=np.full((8, 6), 1e308))))[1].trip == Trip.NONE


@pytest.mark.parametrize(
    "seen",
    [
        observation(robot=robot(safety_mode=SafetyMode.REDUCED)),
        observation(timing=Timing(6, 10.0, 10.0, missed=6)),
        observation(frames=frames(rejected=50)),
        observation(tilt_rad=TILT_RAD),
        observation(robot=robot(z_m=-0.05 - DEPTH_MARGIN_M)),
        observation(robot=robot(tcp_pose=(-0.5, 0.5, 0.02, math.pi, 0.0, 0.0))),
        observation(robot=robot(z_m=0.5)),
        observation(contact=contact(tared=np.array([[199.9, -199.9, 199.9, 500.0, 500.0, 500.0]]))),
        observation(request=Request.PAUSE),
    ],
)
def test_what_is_just_inside_passes(seen: Observation) -> None:
    assert one(seen)[1] == Verdict(DOWN)


def test_the_lowest_height_of_the_configuration_may_be_reached_where_the_step_goes_deeper() -> None:
    for z_m, action in ((-0.1, Action.PASS), (math.nextafter(-0.1, -1.0), Action.STOP)):
        assert one(observation(robot=robot(z_m=z_m)), bounds=Progress(floor_z_m=-1.0))[1].action == action


ORDERED = [
    ({"request": Request.ABORT}, Trip.OPERATOR),
    ({"contact": contact(force_N=math.nan)}, Trip.NOT_FINITE),
    ({"robot": robot(connected=False)}, Trip.CONNECTION),
    ({"frames": frames(status=np.full(8, 1, np.uint16))}, Trip.SENSOR_STATUS),
    ({"contact": contact(absolute_N=30.0)}, Trip.ABSOLUTE_FORCE),
    ({"tilt_rad": 1.0}, Trip.TILTED),
]


@pytest.mark.parametrize("first", range(len(ORDERED)))
def test_of_several_faults_the_operator_reads_the_one_nearest_to_the_cause(first: int) -> None:
    changes: dict[str, object] = {}
    for change, _ in reversed(ORDERED[first:]):
        changes |= change
    assert one(observation(**changes))[1].trip == ORDERED[first][1]


def test_a_device_may_be_silent_for_exactly_as_long_as_it_may() -> None:
    limits = replace(LIMITS, robot_stale_s=0.0625, sensor_stale_s=0.0625)
    heard, _ = one(observation(), limits=limits)
    for now_s, action in ((10.0625, Action.PASS), (math.nextafter(10.0625, 11.0), Action.STOP)):
        silent_robot = one(observation(now_s, robot=robot(10.0)), state=heard, limits=limits)[1]
        silent_sensor = one(observation(now_s, frames=NO_FRAMES), state=heard, limits=limits)[1]
        assert (silent_robot.action, silent_sensor.action) == (action, action)
    assert (silent_robot.trip, silent_robot.limit) == (Trip.ROBOT_STALE, 0.0625)
    assert (silent_sensor.trip, silent_sensor.limit) == (Trip.SENSOR_STALE, 0.0625)
    assert silent_robot.measured == silent_sensor.measured == pytest.approx(0.0625)


def test_without_frames_there_is_no_force_to_judge() -> None:
    silent = observation(frames=NO_FRAMES, contact=contact(tared=np.empty((0, 6))))
    assert one(silent, limits=replace(LIMITS, overload_N=0.5))[1].action == Action.PASS


def test_a_dry_run_needs_no_program() -> None:
    stopped = observation(robot=robot(runtime_state=1))
    assert one(stopped, limits=replace(LIMITS, needs_program=False))[1].action == Action.PASS


def test_a_proposal_that_is_too_fast_or_not_finite_never_goes_out() -> None:
    _, verdict = one(observation(), Command((0.0, 0.04, 0.04)))
    assert verdict == Verdict(STOP, Action.STOP, Trip.SPEED, math.hypot(0.04, 0.04), 0.05)
    assert one(observation(), Command((0.0, 0.0, 0.05 * (1 + 1e-9))))[1].action == Action.PASS, "rounding is no speed"
    assert one(observation(), Command((math.nan, 0.0, 0.0)))[1].trip == Trip.NOT_FINITE
    assert one(observation(), Command((0.0, 0.0, 0.05)))[1].action == Action.PASS


def test_a_silent_sensor_stops_and_does_not_retract() -> None:
    state, _ = one(observation(contact=contact(force_N=5.0)))
    for step in range(1, 30):
        now_s = 10.0 + 0.008 * step
        state, verdict = one(observation(now_s, frames=NO_FRAMES, contact=contact(force_N=5.0)), state=state)
        if verdict.action != Action.PASS:
            break
    assert verdict.trip == Trip.SENSOR_STALE
    assert verdict.command == STOP
    assert now_s - 10.0 == pytest.approx(LIMITS.sensor_stale_s, abs=0.009)


def test_a_sensor_that_never_spoke_stops_too() -> None:
    state = GuardState()
    for step in range(20):
        state, verdict = one(observation(10.0 + 0.008 * step, frames=NO_FRAMES), state=state)
    assert verdict.trip == Trip.SENSOR_STALE


def test_old_frames_that_arrive_late_do_not_make_the_sensor_young() -> None:
    state, _ = one(observation())
    _, verdict = one(observation(10.1, robot=robot(10.1), frames=frames(10.02)), state=state)
    assert verdict.trip == Trip.SENSOR_STALE


@pytest.mark.parametrize("rate_Hz", [125, 500])
def test_rejected_frames_are_counted_over_a_second_whatever_the_rate(rate_Hz: int) -> None:
    def after(pause_s: float) -> Verdict:
        state, verdict = one(observation(frames=frames(rejected=40)))
        for k in range(1, round(pause_s * rate_Hz) + 1):
            now_s = 10.0 + k / rate_Hz
            some = frames(now_s, rejected=40 if now_s >= 10.0 + pause_s else 0, seed=k)
            state, verdict = one(observation(now_s, frames=some), state=state)
        return verdict

    soon, later = after(1.2), after(1.6)  # 40 exp(-1.2) + 40 = 52.0, 40 exp(-1.6) + 40 = 48.1, and 50 are allowed
    assert (soon.trip, later.action) == (Trip.SENSOR_REJECTS, Action.PASS)
    assert soon.measured == pytest.approx(40 * (1 + math.exp(-1.2)))


def test_time_that_goes_back_makes_no_rejects() -> None:
    state, _ = one(observation(frames=frames(rejected=40)))
    state, verdict = one(observation(9.0), state=state)
    assert (verdict.action, state.rejected) == (Action.PASS, 40.0)


def test_a_robot_that_falls_silent_after_it_was_heard_is_stale() -> None:
    state, verdict = one(observation(10.0))
    state, verdict = one(observation(10.008), state=state)
    assert (state.robot_heard_s, verdict.action) == (10.008, Action.PASS)
    _, verdict = one(observation(10.07, robot=robot(10.008)), state=state)
    assert verdict.trip == Trip.ROBOT_STALE


def test_a_robot_that_repeats_itself_is_stale() -> None:
    state = GuardState()
    for step in range(20):
        state, verdict = one(observation(10.0 + 0.008 * step, robot=robot(10.0)), state=state)
        if verdict.action != Action.PASS:
            break
    assert verdict.trip == Trip.ROBOT_STALE
    assert step == 7


def test_a_sensor_stuck_to_the_last_digit_is_found() -> None:
    state = GuardState()
    stuck = np.full((8, 6), 0.3)
    for step in range(FROZEN_FRAMES // 8 + 3):
        now_s = 10.0 + 0.008 * step
        state, verdict = one(observation(now_s, frames=frames(now_s, wrench=stuck)), state=state)
        if verdict.action != Action.PASS:
            break
    assert verdict.trip == Trip.SENSOR_FROZEN
    assert step >= FROZEN_FRAMES // 8
    assert (verdict.measured, verdict.limit) == (state.equal_frames, FROZEN_FRAMES)
    _, verdict = one(observation(), state=state._replace(over=False, trip=Trip.NONE, equal_frames=FROZEN_FRAMES))
    assert verdict.action == Action.PASS, "one frame that differs is life"
    almost = GuardState(last_wrench=stuck[0].tolist(), equal_frames=FROZEN_FRAMES - 8)
    assert one(observation(frames=frames(wrench=stuck)), state=almost)[1].action == Action.PASS
    assert (
        one(observation(frames=frames(wrench=stuck)), state=almost._replace(equal_frames=FROZEN_FRAMES - 7))[1].trip == Trip.SENSOR_FROZEN
    )


def test_no_workspace_and_no_floor_mean_no_such_trip() -> None:
    free = replace(LIMITS, workspace_m=None, min_z_m=None)
    _, verdict = guard(free, GuardState(), observation(robot=robot(z_m=-3.0)), Progress(), DOWN)
    assert verdict.action == Action.PASS


@pytest.mark.parametrize("trip", [trip for trip in Trip if trip != Trip.NONE])
def test_every_trip_has_a_sentence_with_its_numbers(trip: Trip) -> None:
    text = sentence(Verdict(STOP, Action.STOP, trip, 13.25, 12.0))
    assert len(text) > 15
    assert "{" not in text


def test_a_mode_is_said_by_its_name_where_it_has_one() -> None:
    sentences = [sentence(Verdict(STOP, Action.STOP, Trip.SAFETY_MODE, mode, 1.0)) for mode in (3.0, 13.0)]
    assert "was PROTECTIVE_STOP, expected NORMAL" in sentences[0]
    assert "was 13, expected NORMAL" in sentences[1]
    assert "was POWER_OFF, expected RUNNING" in sentence(Verdict(STOP, Action.STOP, Trip.ROBOT_MODE, 3.0, 7.0))


numbers = st.floats(allow_nan=True, allow_infinity=True)


@given(force=numbers, absolute=numbers, lateral=numbers, torque=numbers, z_m=numbers, speed=numbers, tilt=st.floats(0, 4))
def test_whatever_comes_a_command_that_goes_out_is_finite_and_slow(
    force: float, absolute: float, lateral: float, torque: float, z_m: float, speed: float, tilt: float
) -> None:
    seen = observation(
        contact=contact(force_N=force, absolute_N=absolute, lateral_N=lateral, torque_Nm=torque), robot=robot(z_m=z_m), tilt_rad=tilt
    )
    state, verdict = one(seen, Command((0.0, 0.0, speed)))
    velocity = verdict.command.velocity_m_per_s
    assert all(math.isfinite(v) for v in velocity)
    assert math.dist(velocity, (0.0, 0.0, 0.0)) <= LIMITS.max_speed_m_per_s * (1 + 1e-6)
    if not verdict.command.stop and verdict.action == Action.PASS:
        assert absolute < LIMITS.absolute_N
        assert force < LIMITS.contact_N
    assert state.over == verdict.command.stop


@given(st.lists(st.floats(-100, 100), min_size=1, max_size=30))
def test_nothing_follows_a_stop_but_stops(forces_N: list[float]) -> None:
    state, stopped = GuardState(), False
    for step, force_N in enumerate(forces_N):
        seen = observation(10.0 + 0.008 * step, contact=contact(absolute_N=abs(force_N)))
        state, verdict = one(seen, state=state)
        assert not (stopped and not verdict.command.stop)
        stopped = stopped or verdict.command.stop
        assert stopped == any(abs(f) >= LIMITS.absolute_N for f in forces_N[: step + 1])


def test_the_newest_of_several_frames_is_what_the_next_ones_are_compared_with() -> None:
    one_row, other_row = np.full(6, 0.3), np.full(6, 0.4)
    state, _ = one(observation(frames=frames(n=2, wrench=np.array([one_row, other_row]))))
    state, _ = one(observation(frames=frames(n=2, wrench=np.array([other_row, other_row]))), state=state)
    assert state.equal_frames == 2
    state, _ = one(observation(frames=frames(n=2, wrench=np.array([other_row, one_row]))), state=state)
    assert state.equal_frames == 0


def test_the_first_frames_are_compared_among_themselves_and_the_next_with_them() -> None:
    stuck, other = np.full((8, 6), 0.3), np.full((8, 6), 0.4)
    state, _ = one(observation(frames=frames(wrench=stuck)))
    assert state.equal_frames == 8
    state, _ = one(observation(frames=frames(wrench=stuck)), state=state)
    assert state.equal_frames == 16
    state, _ = one(observation(frames=frames(n=1, wrench=other[:1])), state=state)
    assert state.equal_frames == 0
    state, _ = one(observation(frames=frames(wrench=other)), state=state)
    assert state.equal_frames == 8
    state, _ = one(observation(frames=frames(wrench=stuck)), state=state)
    assert state.equal_frames == 0, "all equal, but not what was before"
    mixed = np.concatenate([stuck[:2], other[:1], stuck[:1]])
    state, _ = one(observation(frames=frames(n=4, wrench=mixed)), state=state)
    assert state.equal_frames == 0, "one of them differs"


def test_the_newest_frame_tells_how_old_the_sensor_is() -> None:
    late = replace(frames(), t_s=np.linspace(9.9, 10.0, 8))
    assert one(observation(frames=late))[1].action == Action.PASS
    assert one(observation(frames=late))[0].sensor_heard_s == 10.0
