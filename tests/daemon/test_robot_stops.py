"""What stands against a motion by what the controller says, and when the cause of a protective stop must be written down."""

import pytest

from palpd.daemon.robot_stops import ROBOT_STOPS, ControllerSeen, ProtectiveStops, StopName, stop_of
from palpd.errors import BadInput
from palpd.tick import RobotMode, SafetyMode

NOON = "2026-07-14T12:00:{:02d}+02:00"
PLAYING, PAUSED = 2, 4


@pytest.mark.parametrize(
    ("seen", "stop"),
    [
        (ControllerSeen(), None),
        (ControllerSeen(safety_mode=SafetyMode.REDUCED), None),
        (ControllerSeen(takes_programs=True), None),
        (ControllerSeen(connected=False), "link_lost"),
        (ControllerSeen(robot_mode=RobotMode.BOOTING, safety_mode=SafetyMode.FAULT), "starting"),
        (ControllerSeen(safety_mode=SafetyMode.VIOLATION), "fault"),
        (ControllerSeen(safety_mode=SafetyMode.FAULT, robot_mode=RobotMode.POWER_OFF), "fault"),
        (ControllerSeen(safety_mode=SafetyMode.ROBOT_EMERGENCY_STOP, robot_mode=RobotMode.POWER_OFF), "emergency_stop"),
        (ControllerSeen(safety_mode=SafetyMode.SYSTEM_EMERGENCY_STOP, robot_mode=RobotMode.POWER_OFF), "system_emergency_stop"),
        (ControllerSeen(safety_mode=SafetyMode.SAFEGUARD_STOP), "safeguard_stop"),
        (ControllerSeen(safety_mode=SafetyMode.SAFEGUARD_STOP, runtime_state=PAUSED), "safeguard_program"),
        (ControllerSeen(safety_mode=SafetyMode.RECOVERY), "recovery"),
        (ControllerSeen(safety_mode=SafetyMode.PROTECTIVE_STOP, runtime_state=PAUSED), "protective_stop"),
        (ControllerSeen(safety_mode=13), "other_safety"),
        (ControllerSeen(robot_mode=RobotMode.POWER_OFF), "power_off"),
        (ControllerSeen(robot_mode=RobotMode.POWER_ON), "powering"),
        (ControllerSeen(robot_mode=RobotMode.IDLE, takes_programs=False), "brakes"),
        (ControllerSeen(robot_mode=RobotMode.BACKDRIVE), "freedrive"),
        (ControllerSeen(robot_mode=RobotMode.UPDATING_FIRMWARE), "other_mode"),
        (ControllerSeen(takes_programs=False, runtime_state=PLAYING), "local"),
        (ControllerSeen(runtime_state=PAUSED), "program"),
        (ControllerSeen(runtime_state=PLAYING), "program"),
    ],
)
def test_a_state_of_the_controller_is_named(seen: ControllerSeen, stop: StopName | None) -> None:
    assert stop_of(seen) == stop


def test_the_arm_may_move_only_where_every_code_allows_it() -> None:
    fit = {SafetyMode.NORMAL, SafetyMode.REDUCED}
    for robot in range(-2, 12):
        for safety in range(-1, 15):
            for runtime in range(6):
                for programs in (None, True, False):
                    free = robot == RobotMode.RUNNING and safety in fit and runtime in (0, 1) and programs is not False
                    assert (stop_of(ControllerSeen(True, robot, safety, runtime, programs)) is None) == free


def test_every_row_says_what_to_do_and_how_it_is_seen_to_be_done() -> None:
    for stop in ROBOT_STOPS.values():
        for words in (stop.says, stop.step, stop.done):
            assert words == words.strip(" .")
            assert words[0].islower()


def stops(*dates: tuple[int, int | None]) -> ProtectiveStops:
    """Protective stops that began and were over in these seconds after noon."""
    kept = ProtectiveStops()
    for begin, end in dates:
        kept = kept.begin(NOON.format(begin), moved=True)
        kept = kept.end(NOON.format(end)) if end is not None else kept
    return kept


def test_the_first_stop_asks_for_no_cause_and_one_soon_after_its_end_does() -> None:
    assert not stops().cause_asked
    assert not stops((0, 5)).cause_asked
    assert "within 60 s" in stops((0, 5), (59, None)).cause_asked
    assert "within 60 s" in stops((0, None), (59, None)).cause_asked, "nobody saw the end of the first"
    late = ProtectiveStops().begin(NOON.format(0), moved=True).end(NOON.format(1)).begin("2026-07-14T12:01:02+02:00", moved=True)
    assert not late.cause_asked
    slow = ProtectiveStops().begin("2026-07-14T11:00:00+02:00", moved=True).end(NOON.format(0)).begin(NOON.format(50), moved=True)
    assert slow.cause_asked, "what counts is the end of the first"


def test_a_stop_that_still_stands_is_not_counted_twice_where_nothing_could_move() -> None:
    once = stops((0, None))
    assert once.begin(NOON.format(20), moved=False) == once
    assert len(once.end(NOON.format(21)).begin(NOON.format(22), moved=False).stops) == 2
    assert len(once.begin(NOON.format(20), moved=True).stops) == 2


def test_a_cause_is_kept_with_its_time_and_ends_the_question_until_the_next_stop() -> None:
    explained = stops((0, 5), (10, 15)).with_cause("the frame", "anna", NOON.format(30))
    assert not explained.cause_asked
    assert (explained.stops[-1].cause, explained.stops[-1].by, explained.stops[-1].written) == ("the frame", "anna", NOON.format(30))
    assert explained.begin(NOON.format(40), moved=True).cause_asked
    with pytest.raises(BadInput, match="no protective stop is known"):
        stops().with_cause("the frame", "anna", NOON.format(30))
