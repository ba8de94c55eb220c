"""Recordings of other rigs: how an answer is judged by what is known to act, and that every declared cause is a listed one."""

from pathlib import Path

import pytest

from benchmarks.real_recordings import CAUSES, RealAnswer, law_words, page
from palpd.blind.injected_cells import DeclaredCauses, declared_recordings, load_causes
from tests.paths import SHARED_DATA

REAL = SHARED_DATA / "real"


def answer(causes: tuple[str, ...], verdict: str, *named: tuple[str, list[str]], unlisted: bool = False) -> RealAnswer:
    effects = [(name, 0.9, group) for name, group in named]
    return RealAnswer("rig", DeclaredCauses(causes, unlisted), verdict, effects, 0.1, 0.9, 1.0, [], "nothing")


@pytest.mark.parametrize(
    ("given", "judgement"),
    [
        (answer(("cable.friction",), "effects", ("cable.friction", [])), "right"),
        (answer(("cable.friction",), "effects", ("sensor.hysteresis", ["cable.friction"])), "right"),
        (answer(("cable.friction", "robot.backlash"), "effects", ("cable.friction", [])), "right"),
        (answer(("cable.friction",), "effects", ("cable.friction", []), ("sensor.warmup", [])), "partly right"),
        (answer(("cable.friction",), "unknown", ("cable.friction", [])), "partly right"),
        (answer(("cable.friction",), "unknown"), "wrong"),
        (answer(("cable.friction",), "none"), "wrong"),
        (answer(("cable.friction",), "effects", ("sensor.warmup", [])), "wrong"),
        (answer((), "unknown", unlisted=True), "right"),
        (answer(("sensor.saturation",), "unknown", ("sensor.saturation", []), unlisted=True), "right"),
        (answer(("sensor.saturation",), "effects", ("sensor.saturation", []), unlisted=True), "partly right"),
        (answer(("sensor.saturation",), "unknown", ("sensor.creep", []), unlisted=True), "right"),
        (answer(("sensor.saturation",), "effects", ("sensor.creep", []), unlisted=True), "wrong"),
    ],
)
def test_an_answer_is_judged_by_what_is_known_to_act(given: RealAnswer, judgement: str) -> None:
    assert given.judgement == judgement


def test_the_page_says_what_is_missing_and_what_was_warned() -> None:
    one = answer(("cable.friction", "robot.backlash"), "effects", ("cable.friction", []))
    text = page([one, RealAnswer("other", one.declared, "none", [], 0.0, None, 1.0, ["RuntimeWarning: overflow"])])
    assert "Right: 1 of 2 (50%" in text
    assert "| `robot.backlash` | right | nothing |" in text
    assert "- other: RuntimeWarning: overflow" in text


def test_the_page_says_what_lies_beyond_the_list() -> None:
    term = {"formula": "0.1 * x", "what": "an added force", "alike": ["curve of depth"], "replaces_listed": False, "further_terms": []}
    answer_ = {"learned": term, "events": None, "effects": [{"id": "cable.friction"}]}
    assert law_words(answer_) == "an added force: `0.1 * x` (beside what is named; 1 others fit as well)"
    event = {"kind": "step", "channel": "fz_N"}
    assert law_words({"learned": None, "events": [event, event], "effects": []}) == "events: 2 step in fz"
    assert law_words({"learned": None, "events": None, "effects": []}) == "nothing"


def test_declared_causes_are_listed_ones() -> None:
    assert len(load_causes(CAUSES)) >= 5


@pytest.mark.skipif(not REAL.is_dir(), reason="the measurements are not in the repository (their licences differ)")
def test_every_declared_recording_is_there_once() -> None:
    recordings = [path for path, _ in declared_recordings(REAL, CAUSES)]
    assert {path.stem for path in recordings} == set(load_causes(CAUSES))
    assert all(isinstance(path, Path) and path.with_suffix(".yaml").exists() for path in recordings)
