"""What answers are worth: silence, the first name, nothing else, unknown, and bits."""

from math import log2
from pathlib import Path

import pytest

from palpd.arena.answers import ToolAnswer, content_of
from palpd.arena.cases import KnownTruth, Question
from palpd.arena.page import headline, misses, table, write_page
from palpd.arena.score import LEAST_PROBABILITY, RigScore, ScoredAnswer, Share, over_rigs
from palpd.errors import BadInput

FRICTION = KnownTruth((frozenset({"cable.friction", "cable.viscous"}),), "annotated")
HEALTHY, OUTSIDE = KnownTruth((), "annotated"), KnownTruth((frozenset({"unknown"}),), "measured")
BOTH = KnownTruth((frozenset({"cable.friction"}), frozenset({"sensor.bias"})), "planted")


def scored(
    truth: KnownTruth, verdict: str, probability: dict[str, float] | None = None, p_none: float = 0.1, **more: float
) -> ScoredAnswer:
    question = Question("rig", "j1", Path("j1.csv"), Path("cell.yaml"), ())
    return ScoredAnswer(
        question, truth, ToolAnswer.of(content_of(verdict, probability or {}, p_none, more.get("p_unknown", 0.0)), "j1.json")
    )


def test_a_certain_and_right_answer_costs_nothing_and_ignorance_three_bits() -> None:
    assert scored(HEALTHY, "none", {}, 1.0).bits == 0.0
    assert scored(FRICTION, "effects", {"cable.viscous": 1.0}, 0.0).bits == 0.0
    assert scored(FRICTION, "effects", {"cable.friction": 0.5, "sensor.gain": 0.5}, 0.5).bits == pytest.approx(3.0)
    assert scored(HEALTHY, "effects", {"sensor.gain": 0.75}, 0.5).bits == pytest.approx(1.0 + 2.0)
    certain_and_wrong = scored(FRICTION, "none", {}, 1.0).bits
    assert certain_and_wrong == pytest.approx(-2.0 * log2(LEAST_PROBABILITY))


def test_first_alone_and_silent() -> None:
    assert scored(FRICTION, "effects", {"cable.viscous": 0.9}).alone
    beside = scored(FRICTION, "effects", {"cable.viscous": 0.9, "sensor.gain": 0.8})
    assert (beside.first, beside.alone) == (True, False)
    assert not scored(FRICTION, "effects", {"cable.viscous": 0.7, "sensor.gain": 0.8}).first
    assert scored(BOTH, "effects", {"cable.friction": 0.9, "sensor.bias": 0.8}).alone
    assert not scored(BOTH, "effects", {"cable.friction": 0.9}).alone
    assert scored(HEALTHY, "none").right
    assert not scored(HEALTHY, "unknown").right
    assert scored(OUTSIDE, "unknown", p_unknown=0.9).first
    assert not scored(OUTSIDE, "effects", {"cable.friction": 0.9}).first


def test_a_group_of_four_names_is_no_answer() -> None:
    content = content_of("ambiguous", {"sensor.bias": 0.6}, 0.0)
    content["effects"][0]["indistinguishable_from"] = ["cable.friction", "sensor.drift"]
    question = Question("rig", "j1", Path("j1.csv"), Path("cell.yaml"), ())
    assert ScoredAnswer(question, FRICTION, ToolAnswer.of(content, "")).first
    content["effects"][0]["indistinguishable_from"].append("sensor.creep")
    assert not ScoredAnswer(question, FRICTION, ToolAnswer.of(content, "")).first


def test_what_is_no_answer_is_refused_and_what_failed_counts_as_wrong() -> None:
    with pytest.raises(BadInput, match="verdict are expected to be"):
        ToolAnswer.of({"schema": "palpd.diagnosis/1", "verdict": "maybe"}, "j1.json")
    with pytest.raises(BadInput, match="is no probability"):
        ToolAnswer.of(content_of("none", {}, 1.5), "j1.json")
    failed = ToolAnswer.of({"arena": {"failed": "no answer within 60 s"}}, "j1.json")
    question = Question("rig", "j1", Path("j1.csv"), Path("cell.yaml"), ())
    assert not ScoredAnswer(question, OUTSIDE, failed).right
    assert not ScoredAnswer(question, HEALTHY, failed).right


def test_rigs_weigh_alike_and_small_ones_do_not_count() -> None:
    def rows(rig: str, right: int, n: int) -> list[ScoredAnswer]:
        question = Question(rig, "j1", Path("j1.csv"), Path("cell.yaml"), ())
        both = [scored(HEALTHY, *(("none", {}, 0.9) if k < right else ("unknown", {}, 0.2))) for k in range(n)]
        return [ScoredAnswer(question, each.truth, each.answer) for each in both]

    every = [*rows("a", 20, 20), *rows("b", 0, 5), *rows("c", 0, 4)]
    assert over_rigs(every, lambda row: row.right) == 0.5
    assert str(Share.of(every, lambda row: row.right)).startswith("20 of 29 (51 to 83 %)")
    assert RigScore.of("all", every).silent.right == 20
    assert "healthy silent 50 %" in headline(every)
    assert "| **b** |" in table(every)
    assert misses(every).count("| healthy | unknown |") == 9


def test_the_page_and_its_picture_are_written(tmp_path: Path) -> None:
    rows = [scored(FRICTION, "effects", {"cable.viscous": 0.9}), scored(HEALTHY, "unknown")]
    page = write_page(tmp_path, Path("benchmarks/arena"), [], {"one": rows, "two": rows[:1]})
    text = page.read_text()
    assert "| one |" in text
    assert "## Every miss of one" in text
    assert (tmp_path / "arena-scores.png").stat().st_size > 5000
