"""Whether the probe is free: all combinations of what may be known, against the table of docs/probe-state.md."""

import math
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import pytest

from palpd.control.probe_state import (
    EVERYTHING,
    LARGEST_DRIFT_N,
    MOVED_M,
    SMALLEST_DRIFT_N,
    ContactMarker,
    LevelTested,
    ProbeAnswer,
    ProbeEvidence,
    ProbeIdentity,
    ProbeRecord,
    ProbeState,
    Reference,
    expected_drift_N,
    probe_state,
)

LIMIT_N, LENGTH_M = 25.0, 0.08
SURFACE_M, CLEAR_M = 0.100, 0.005
IDENTITY = ProbeIdentity("PRE00042", (0.2, 0.005, 0.08), None)
ZERO = (1.0, -2.0, -50.0, 0.01, 0.02, 0.03)
DOWN = (math.pi, 0.0, 0.0)
START = (0.0, 0.0, 0.130, *DOWN)

FORCES_N = {"near": 0.9 * SMALLEST_DRIFT_N, "off": 1.1 * SMALLEST_DRIFT_N, "above the limit": LIMIT_N}
PLACES = {"in the tissue": SURFACE_M - 0.004, "just clear": SURFACE_M + CLEAR_M + 1e-6, "at the start": START[2]}
MARKERS = ("none", "pressed", "no surface", "died", "start not free")
MOVES = ("stayed", "moved aside", "moved up")
REFERENCES = ("none", "good", "other sensor", "other probe", "other TCP", "tilted")
LEVELS = ("none", "here", "elsewhere", "another force")


class Known(NamedTuple):
    """One combination, in words."""

    fault: bool
    force: str
    place: str
    marker: str
    moved: str
    reference: str
    level: str


ALL = [Known(*values) for values in product((False, True), FORCES_N, PLACES, MARKERS, MOVES, REFERENCES, LEVELS)]


def judged(known: Known) -> ProbeAnswer:
    """The combination in numbers, judged."""
    pose = (0.0, 0.0, PLACES[known.place], *DOWN)
    wrench = (ZERO[0], ZERO[1], ZERO[2] - FORCES_N[known.force], *ZERO[3:])
    evidence = ProbeEvidence(pose, wrench, math.radians(0.2), IDENTITY, "the sensor is silent" if known.fault else "")
    reference = {
        "good": Reference(ZERO, IDENTITY, math.radians(0.2)),
        "other sensor": Reference(ZERO, replace(IDENTITY, sensor_serial="PRE00043")),
        "other probe": Reference(ZERO, replace(IDENTITY, probe=(0.2, 0.006, 0.08))),
        "other TCP": Reference(ZERO, replace(IDENTITY, tcp=(0.0,) * 6)),
        "tilted": Reference(ZERO, IDENTITY, math.radians(1.5)),
    }.get(known.reference)
    if known.reference == "other TCP":
        evidence = replace(evidence, identity=replace(IDENTITY, tcp=(0.1,) * 6))
    left = {"stayed": pose, "moved aside": (1.5 * MOVED_M, *pose[1:]), "moved up": (*pose[:2], pose[2] - 1.5 * MOVED_M, *DOWN)}[known.moved]
    marker = ContactMarker(
        "yesterday", "palpation", left, START, CLEAR_M, ZERO, IDENTITY,
        surface_z_m=None if known.marker == "no surface" else SURFACE_M,
        start_free=known.marker != "start not free",
        at_rest=known.marker != "died",
    )  # fmt: skip
    level = {
        "here": LevelTested("today", pose, wrench, evidence.identity),
        "elsewhere": LevelTested("today", (pose[0] + 1.5 * MOVED_M, *pose[1:]), wrench, evidence.identity),
        "another force": LevelTested("today", pose, (*wrench[:2], wrench[2] - 0.5, *wrench[3:]), evidence.identity),
    }.get(known.level)
    return probe_state(ProbeRecord(LIMIT_N, LENGTH_M, reference, None if known.marker == "none" else marker, level), evidence)


def expected(known: Known) -> tuple[ProbeState, frozenset[str]]:
    """The table of docs/probe-state.md, row by row: the first that holds."""
    has_zero = known.reference != "none" or known.marker != "none"
    contact_open = known.marker != "none" and known.level != "here"
    back_at_start = known.place == "at the start" and known.marker in ("pressed", "no surface")  # as the first way up showed it
    if contact_open and back_at_start:
        contact_open = False
    surface_known = known.marker != "no surface"
    over_the_place = known.marker == "died" or known.moved != "moved aside"
    if known.fault:
        return ProbeState.UNKNOWN, frozenset()
    if known.force == "above the limit" and has_zero:
        return ProbeState.PRESSED, frozenset()
    if contact_open and surface_known and over_the_place and known.place == "in the tissue":
        return ProbeState.PRESSED, frozenset(("retract",))
    if contact_open and (known.marker == "died" or known.moved != "stayed" or not surface_known):
        return ProbeState.UNKNOWN, frozenset(("retract", "level_test"))
    if known.level == "here":
        return ProbeState.FREE, EVERYTHING
    if known.reference != "good" or known.force != "near":
        return ProbeState.UNKNOWN, frozenset(("level_test", "confirm"))
    return ProbeState.FREE, EVERYTHING


def test_every_combination_is_answered_as_the_table_says() -> None:
    wrong = [(known, answer, wish) for known in ALL if ((answer := judged(known)).state, answer.ways) != (wish := expected(known))]
    assert len(ALL) == 2 * 3 * 3 * 5 * 3 * 6 * 4
    assert not wrong, wrong[:3]


def test_whatever_is_not_free_has_a_reason_and_an_advice() -> None:
    for known in ALL:
        answer = judged(known)
        if answer.state != ProbeState.FREE:
            assert all(answer.reasons), known
            assert answer.advice in answer.sentence


def test_nothing_moves_down_or_sideways_unless_the_probe_is_free() -> None:
    for known in ALL:
        answer = judged(known)
        assert ("move" in answer.ways) == ("calibrate" in answer.ways) == (answer.state == ProbeState.FREE), known
        assert answer.state != ProbeState.PRESSED or not answer.ways & {"level_test", "confirm"}, "a yes never overrides pressed"


@pytest.mark.parametrize(("side_N", "torque_Nm", "free"), [(0.29, 0.0, True), (0.31, 0.0, False), (0.0, 0.023, True), (0.0, 0.025, False)])
def test_a_side_force_and_a_torque_off_the_reference_are_doubts(side_N: float, torque_Nm: float, free: bool) -> None:
    wrench = (ZERO[0] + side_N, *ZERO[1:3], ZERO[3], ZERO[4] + torque_Nm, ZERO[5])
    evidence = ProbeEvidence(START, wrench, 0.0, IDENTITY)
    answer = probe_state(ProbeRecord(LIMIT_N, LENGTH_M, Reference(ZERO, IDENTITY)), evidence)
    assert (answer.state == ProbeState.FREE) == free
    assert free or f"{'torque' if torque_Nm else 'force'} is" in answer.reasons[0]


def test_a_number_that_is_none_is_never_free() -> None:
    for at in range(6):
        wrench = (*ZERO[:at], math.nan, *ZERO[at + 1 :])
        answer = probe_state(ProbeRecord(LIMIT_N, LENGTH_M, Reference(ZERO, IDENTITY)), ProbeEvidence(START, wrench, 0.0, IDENTITY))
        assert answer.state == ProbeState.UNKNOWN, at


def test_a_run_that_ended_where_its_first_way_up_was_free_is_free_below_the_clear_height_too() -> None:
    low_start = (0.0, 0.0, SURFACE_M + 0.003, *DOWN)
    marker = ContactMarker(
        "today", "palpation", low_start, low_start, CLEAR_M, ZERO, IDENTITY, None, SURFACE_M, start_free=True, at_rest=True
    )
    evidence = ProbeEvidence(low_start, ZERO, 0.0, IDENTITY)
    record = ProbeRecord(LIMIT_N, LENGTH_M, Reference(ZERO, IDENTITY), marker)
    assert probe_state(record, evidence).state == ProbeState.FREE
    assert probe_state(replace(record, marker=replace(marker, start_free=False)), evidence).state == ProbeState.PRESSED


def test_the_age_of_a_reference_excuses_a_drift_within_two_bounds() -> None:
    assert expected_drift_N(0.0, 0.01) == SMALLEST_DRIFT_N
    assert expected_drift_N(3600.0, 0.01) == pytest.approx(0.6)
    assert expected_drift_N(86_400.0, 0.01) == LARGEST_DRIFT_N
    assert expected_drift_N(-3600.0, 0.01) == pytest.approx(0.6), "a clock that was set back makes nothing younger"
