"""What a diagnosis assumes stands in one place, and `benchmarks.sensitivity` says what a number moves."""

import re
from dataclasses import FrozenInstanceError, fields
from typing import Any

import pytest

from benchmarks import sensitivity
from palpd.gap.assumptions import ASSUMED, Assumptions
from tests.paths import ROOT

STAGES = [field.name for field in fields(Assumptions)]
MODULES = [path.read_text(encoding="utf-8") for path in (ROOT / "palpd" / "gap").rglob("*.py")]


@pytest.mark.parametrize("stage", STAGES)
def test_nobody_changes_an_assumption_of_a_running_program(stage: str) -> None:
    of_stage = getattr(ASSUMED, stage)
    with pytest.raises(FrozenInstanceError):
        setattr(ASSUMED, stage, of_stage)
    with pytest.raises(FrozenInstanceError):
        setattr(of_stage, fields(of_stage)[0].name, 0.0)


@pytest.mark.parametrize("path", sensitivity.paths())
def test_every_assumption_has_a_unit_a_meaning_and_a_source(path: str) -> None:
    assert all(sensitivity.described(path)[key].strip() for key in ("unit", "what", "source"))


@pytest.mark.parametrize("path", sensitivity.paths())
def test_every_assumption_is_read_by_the_diagnosis(path: str) -> None:
    """A number that stands here while another one is used would look as if it changed nothing."""
    stage, name = path.split(".")
    read = re.compile(rf"\b(ASSUMED\.{stage}|a)\.{name}\b")
    assert any(read.search(text) for text in MODULES if f"ASSUMED.{stage}" in text)


@pytest.mark.parametrize("probabilities", sensitivity.SUMS_OF_ONE)
def test_prior_probabilities_of_cases_that_exclude_each_other_add_up_to_one(probabilities: tuple[str, ...]) -> None:
    assert sum(sensitivity.total(sensitivity.value_of(path)) for path in probabilities) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("path", sensitivity.paths())
def test_a_larger_assumption_is_larger_and_what_adds_up_to_one_still_does(path: str) -> None:
    larger = sensitivity.varied(path)
    assert sensitivity.value_of(path, larger) != sensitivity.value_of(path)
    for probabilities in sensitivity.SUMS_OF_ONE:
        now, before = (sum(sensitivity.total(sensitivity.value_of(p, of)) for p in probabilities) for of in (larger, ASSUMED))
        assert now == pytest.approx(before)
    if sensitivity.described(path)["unit"] in ("probability", "cosine"):
        assert sensitivity.total(sensitivity.value_of(path, larger)) < 1.0


def test_the_page_of_assumptions_is_what_the_code_says_now() -> None:
    written = sensitivity.PAGE.read_text(encoding="utf-8")
    assert sensitivity.page({}, written) == written, "run: python -m benchmarks.sensitivity --kept FOLDER --docs"


def test_a_measurement_of_another_value_does_not_stay_on_the_page() -> None:
    kept = "| `prior.unknown` | 0.15 | probability | what | chosen | nothing, 9 cells |"
    other = kept.replace("0.15", "0.2")
    row = [line for line in sensitivity.page({}, kept).splitlines() if line.startswith("| `prior.unknown`")]
    assert row[0].endswith("| nothing, 9 cells |")
    row = [line for line in sensitivity.page({}, other).splitlines() if line.startswith("| `prior.unknown`")]
    assert row[0].endswith(f"| {sensitivity.NOT_MEASURED} |")


def test_a_change_of_the_verdict_and_of_names_is_said_in_words() -> None:
    before: dict[str, Any] = {"verdict": "effects", "names": ["robot.lag"], "groups": [["robot.lag"]], "score": -0.5}
    after: dict[str, Any] = {"verdict": "none", "names": [], "groups": [], "score": -2.5}
    result = sensitivity.moved("prior.none", {"a": {"": before, "prior.none": after}, "b": {"": before, "prior.none": before}})
    assert result.changes == ["a: verdict effects → none, names robot.lag → nothing"]
    assert (result.cells, result.score) == (2, -2.0)
    assert sensitivity.in_words(result) == "1 of 2 cells, score -2.00: verdict effects → none, names robot.lag → nothing"
