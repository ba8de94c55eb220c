"""What may be done, and what is next: claims that hold for every combination of what the service can know."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from typing import get_args

import pytest

from palpd.control.probe_state import EVERYTHING, ProbeAnswer, ProbeState
from palpd.daemon.motion_job import Kind
from palpd.daemon.robot_stops import ROBOT_STOPS
from palpd.daemon.what_now import ACTIONS, COMMANDS, GOES_UP, PAUSES, WORDS, Now, Standing, what_now
from palpd.tick import Phase

UNFINISHED = "the run-7 of yesterday is unfinished, and the tip is low"
PROBES = (
    None,
    ProbeAnswer(ProbeState.FREE),
    ProbeAnswer(ProbeState.PRESSED, (UNFINISHED,), frozenset(("retract",)), 2.13),
    ProbeAnswer(ProbeState.PRESSED, ("31.0 N stand against the reference tare, above the absolute limit of 25 N",), frozenset(), 31.0),
    ProbeAnswer(ProbeState.UNKNOWN, ("the run sent nothing more at its end",), frozenset()),
    ProbeAnswer(ProbeState.UNKNOWN, ("the run-7 of yesterday is unfinished, and the arm was moved",), frozenset(("retract", "level_test"))),
    ProbeAnswer(ProbeState.UNKNOWN, ("the force is 0.50 N off",), frozenset(("level_test", "confirm")), 0.5),
)
EITHER = (False, True)
CAUSE = "a protective stop came again, so its cause must be written down"
LATCH = ("yesterday", "the lateral force was 9 N")


def idle() -> Iterator[Standing]:
    """Nothing runs. An answer that offers the retract comes from an unfinished contact."""
    for armed, latched, reference, unfinished, probe, fault, asks, cause in product(
        EITHER, EITHER, EITHER, EITHER, PROBES, EITHER, EITHER, EITHER
    ):
        if unfinished or probe is None or "retract" not in probe.ways or probe.state == ProbeState.FREE:
            yield Standing(
                armed=armed, latch=LATCH if latched else None, reference=reference, unfinished=unfinished, probe=probe,
                fault="the sensor is silent" if fault else "", question="the arm stands elsewhere" if asks else None,
                last="the operator aborted the run" if asks else "", cause=CAUSE if cause else "",
            )  # fmt: skip


def running() -> Iterator[Standing]:
    """A job, a run of it, or both; the other knowledge comes from before."""
    runs: list[tuple[Kind | None, Phase | None]] = [(None, None)]
    runs += list(product((kind for kind in get_args(Kind) if kind != "check"), (None, *Phase)))
    for (run, phase), job, proposal, asked, pending, armed, reference, probe in product(
        runs, (None, "job-1"), EITHER, EITHER, EITHER, EITHER, EITHER, PROBES
    ):
        if run is not None or job is not None:
            yield Standing(
                armed=armed, run=run, phase=phase, site="B" if run == "palpation" else None, force_N=2.24, depth_m=0.0041, job=job,
                proposal=proposal, pause_asked=asked, pause_pending=pending, reference=reference, probe=probe,
            )  # fmt: skip


def checking() -> Iterator[Standing]:
    for standing, arming in product(idle(), EITHER):
        yield replace(standing, run="check", arming=arming)


def stopped_by_robot() -> Iterator[Standing]:
    """The controller says why the arm may not move; all else is as it may be then."""
    for name, armed, latched, probe, fault, cause in product(ROBOT_STOPS, EITHER, EITHER, PROBES, EITHER, EITHER):
        yield Standing(
            armed=armed, latch=LATCH if latched else None, reference=True, unfinished=True, probe=probe,
            fault="the sensor is silent" if fault else "", cause=CAUSE if cause else "", stop=name,
        )  # fmt: skip


def everything() -> Iterator[tuple[Standing, Now]]:
    for standings in (idle(), stopped_by_robot(), checking(), running()):
        for standing in standings:
            yield standing, what_now(standing)


def possible(now: Now) -> set[str]:
    return set(ACTIONS) - set(now.obstacles)


def test_every_combination_says_what_stands_and_why_each_button_is_impossible() -> None:
    seen = set()
    for standing, now in everything():
        seen.add(now.state)
        assert now.sentence[0] == now.sentence[0].upper(), standing
        assert now.sentence.endswith("."), standing
        assert "None" not in now.sentence, standing
        assert "palpd" not in now.sentence, "operators read buttons"
        assert now.next is None or now.next in possible(now), standing
        for obstacle in now.obstacles.values():
            assert obstacle.reason, standing
            assert "palpd" not in obstacle.reason, standing
            assert obstacle.as_refusal == (f"{obstacle.reason}; {COMMANDS[obstacle.way]}" if obstacle.way else obstacle.reason)
    assert seen == set(WORDS)


def test_a_way_out_that_is_named_is_possible_or_an_abort() -> None:
    for standing, now in everything():
        for obstacle in now.obstacles.values():
            assert obstacle.way in {None, "abort"} | possible(now), (standing, obstacle)


def test_there_is_always_a_next_step_where_nothing_runs() -> None:
    for standing in idle():
        assert what_now(standing).next is not None, standing


def test_following_the_next_step_is_never_a_detour_around_the_tissue() -> None:
    """While the last look found the probe pressed, nothing but the way out and another look is offered."""
    for standing in idle():
        now = what_now(standing)
        if standing.pressed:
            assert possible(now) <= {"check", "retract"}, standing
            assert standing.probe is not None
            assert now.next == ("retract" if "retract" in standing.probe.ways else "check"), standing
        if "start" in possible(now):
            assert standing.armed, standing
            assert standing.latch is None, standing
            assert not standing.cause, standing
            assert standing.probe is None or standing.probe.state == ProbeState.FREE, standing


def test_the_way_out_is_refused_by_no_old_doubt() -> None:
    """A retract judges the force itself. Only a force above the absolute limit is left to hands, and a cell that nobody has ever tared."""
    for standing in idle():
        left_to_hands = standing.pressed and standing.probe is not None and not standing.probe.ways
        assert ("retract" in possible(what_now(standing))) == ((standing.reference or standing.unfinished) and not left_to_hands), standing


def test_while_something_runs_only_a_pause_a_resume_or_an_answer_is_possible() -> None:
    for standing in running():
        now = what_now(standing)
        assert possible(now) <= {"pause", "resume", "decide"}, standing
        assert not {"pause", "resume"} <= possible(now), standing
        if {"pause", "resume"} & possible(now):
            assert standing.run in PAUSES, standing
        assert ("decide" in possible(now)) == standing.proposal, standing
        assert now.obstacles["retract"].way == "abort", standing


def test_a_run_that_was_asked_to_pause_can_be_resumed_before_it_rests() -> None:
    pressing = Standing(run="palpation", phase=Phase.RETRACT, job="job-1", reference=True, pause_asked=True)
    assert what_now(pressing).next == "resume"
    assert what_now(replace(pressing, pause_pending=True)).next is None
    assert what_now(replace(pressing, pause_asked=False, phase=Phase.PAUSE_RETRACT)).next == "resume"
    assert what_now(replace(pressing, pause_asked=False)).next is None


def test_while_the_devices_are_checked_only_what_waits_for_the_check_is_possible() -> None:
    for standing in checking():
        now = what_now(standing)
        assert possible(now) <= {"arm", "clear"}, standing
        assert not (standing.arming and "arm" in possible(now)), standing


def test_a_stop_is_cleared_before_anything_is_armed() -> None:
    for standing in idle():
        if standing.latch is not None:
            now = what_now(standing)
            assert "9 N" in now.obstacles["arm"].reason
            assert now.sentence.startswith("The lateral force was 9 N. "[: len(now.sentence)]), standing
            assert "start" in now.obstacles


def test_the_step_at_the_pendant_comes_before_everything_that_moves_or_acknowledges() -> None:
    for standing in stopped_by_robot():
        assert standing.stop is not None
        now, stop = what_now(standing), ROBOT_STOPS[standing.stop]
        assert possible(now) <= {"check", "calibrate", "recover"}, standing
        assert (now.state, now.word, now.next) == ("robot", stop.word, None), standing
        assert stop.step in now.sentence, standing
        for action in ("arm", "start", "retract", "level-test", "clear"):
            assert now.obstacles[action].as_refusal == f"{stop.says}; at the pendant: {stop.step}", standing
        assert now.published["stop"] == {"name": standing.stop, "says": stop.says, "step": stop.step, "done": stop.done}


def test_nothing_is_armed_before_a_cause_that_is_asked_for_is_written_down() -> None:
    for standing in idle():
        now = what_now(standing)
        if standing.cause:
            assert "arm" in now.obstacles, standing
            assert (now.next == "clear") <= (now.cause == CAUSE), "who is led to the clear reads that it needs a cause"


FREE = Standing(reference=True, probe=ProbeAnswer(ProbeState.FREE))


@pytest.mark.parametrize(
    ("standing", "state", "sentence", "following"),
    [
        (FREE, "disarmed", "The probe is free, and nothing moves.", "arm"),
        (replace(FREE, armed=True), "armed", "The next start moves the arm.", "start"),
        (
            replace(FREE, armed=True, question="elsewhere"),
            "armed",
            "The next start moves the arm, once you have said where its sites count from.",
            "start",
        ),
        (Standing(), "untared", "There is no reference tare: let the probe hang free and still.", "calibrate"),
        (
            replace(FREE, probe=PROBES[2], last="the operator aborted the run", unfinished=True),
            "pressed",
            "The last run was stopped: the operator aborted the run. The probe is in the tissue, with 2.1 N against the reference tare.",
            "retract",
        ),
        (
            replace(FREE, probe=PROBES[3]),
            "pressed",
            "31.0 N stand against the reference tare, above the absolute limit of 25 N: free the probe by hand at the pendant.",
            "check",
        ),
        (replace(FREE, latch=LATCH), "latched", "The lateral force was 9 N.", "clear"),
        (
            replace(FREE, latch=LATCH, probe=PROBES[2], unfinished=True),
            "latched",
            "The lateral force was 9 N. The probe is in the tissue, with 2.1 N against the reference tare.",
            "retract",
        ),
        (replace(FREE, probe=PROBES[6]), "unknown", "Whether the probe is free is not known: the force is 0.50 N off.", "level-test"),
        (
            replace(FREE, probe=PROBES[4]),
            "unknown",
            "Whether the probe is free is not known: the run sent nothing more at its end.",
            "check",
        ),
        (replace(FREE, fault="no sensor at /dev/hex"), "unready", "No sensor at /dev/hex.", "check"),
        (replace(FREE, run="check"), "checking", "Robot and sensor are being checked; nothing moves.", None),
        (
            Standing(run="palpation", phase=Phase.PRESS, site="B", force_N=2.24, depth_m=0.0041, job="j"),
            "running",
            "The probe presses with 2.2 N at site B, 4.1 mm deep.",
            None,
        ),
        (
            Standing(run="palpation", phase=Phase.PAUSED, site="B", job="j", pause_asked=True),
            "paused",
            "The probe waits above the tissue at site B.",
            "resume",
        ),
        (Standing(run="retract", phase=Phase.RETRACT, force_N=1.9, job="j"), "running", "The probe leaves the tissue, 1.9 N.", None),
        (Standing(job="j", proposal=True), "waiting", "The job proposes a motion and waits for your answer.", "decide"),
        (Standing(job="j", activity="fitting 6 hypotheses"), "running", "The job computes: fitting 6 hypotheses.", None),
    ],
)
def test_the_line_says_what_stands_and_what_is_next(standing: Standing, state: str, sentence: str, following: str | None) -> None:
    now = what_now(standing)
    assert (now.state, now.sentence, now.next) == (state, sentence, following)


def test_what_goes_up_is_not_paused_and_says_so() -> None:
    for kind in GOES_UP:
        refused = what_now(Standing(run=kind, phase=Phase.RETRACT, job="j")).obstacles["pause"]
        assert refused.as_refusal == "the arm leaves the tissue already; wait for its end, or palpd abort"


def test_everything_is_allowed_by_a_free_probe() -> None:
    assert PROBES[1] is not None
    assert PROBES[1].ways == EVERYTHING
    assert set(ACTIONS) - possible(what_now(replace(FREE, armed=True))) == {"pause", "resume", "decide"}
