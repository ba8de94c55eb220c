"""Tools on a sample of the shipped recordings, planted ones, and the command that asks and scores them."""

import json
import time
from importlib.resources import files
from pathlib import Path

import jsonschema
import pytest

from palpd.arena.cases import Question, every, rigs
from palpd.arena.run import ask, scored
from palpd.cli.application import carry_out
from palpd.errors import BadInput
from tests.arena.test_cases import CASES

SCHEMA = json.loads(files("palpd.arena").joinpath("answer.schema.json").read_text(encoding="utf-8"))


def check_schema(answers: Path) -> None:
    """Every answer of a folder is as the schema says that other tools should write it."""
    written = list(answers.glob("*/*.json"))
    assert written
    for path in written:
        jsonschema.validate(json.loads(path.read_text(encoding="utf-8")), SCHEMA)


def test_palpd_answers_ten_of_the_shipped_questions(tmp_path: Path) -> None:
    questions = every(rigs(CASES), 10)
    summary: list[int] = []
    ask("palpd", [question for question, _ in questions], tmp_path, jobs=1, limit_s=120.0, advance=summary.append)
    rows = scored(questions, tmp_path)
    check_schema(tmp_path)
    assert sum(summary) == 10
    assert not [row.answer.failed for row in rows if row.answer.failed]
    assert all(row.answer.cpu_s for row in rows)
    assert all(row.answer.made_by.startswith("palpd ") for row in rows)
    assert sum(row.right for row in rows) >= 5, [(row.question.rig, row.question.name, row.answer.verdict) for row in rows]


@pytest.mark.parametrize("tool", ["threshold", "always", "least-squares", "sindy"])
def test_every_other_tool_gives_answers_that_can_be_scored(tool: str, tmp_path: Path) -> None:
    if tool == "sindy":
        pytest.importorskip("pysindy")
    shipped = [rig for rig in rigs(CASES) if rig.name in ("pneumatic_seal_1bar", "mr_damper_off")]
    questions = every(shipped, 4)
    ask(tool, [question for question, _ in questions], tmp_path, jobs=1, limit_s=60.0, advance=lambda _: None)
    rows = scored(questions, tmp_path)
    check_schema(tmp_path)
    assert len(rows) == 4
    assert not [row.answer.failed for row in rows if row.answer.failed]
    assert all(0.0 <= row.bits < 21.0 for row in rows)


def test_a_tool_that_takes_too_long_has_no_answer(tmp_path: Path) -> None:
    questions = every(rigs(CASES), 1)
    ask("least-squares", [question for question, _ in questions], tmp_path, jobs=1, limit_s=0.02, advance=lambda _: None)
    check_schema(tmp_path)
    assert scored(questions, tmp_path)[0].answer.failed == "no answer within 0.02 s of processor time"


def test_a_limit_holds_where_python_drops_the_exception_of_its_signal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Dropping:
        def __del__(self) -> None:
            spend_s(0.1)

    def spend_s(duration_s: float) -> None:
        until_s = time.process_time() + duration_s
        while time.process_time() < until_s:
            pass

    def drops(_question: Question) -> dict[str, object]:
        Dropping()
        spend_s(30.0 if again else 0.0)
        return {}

    monkeypatch.setattr("palpd.arena.run.runner", lambda _tool: drops)
    for again in (False, True):
        folder = tmp_path / str(again)
        questions = every(rigs(CASES), 1)
        ask("any", [question for question, _ in questions], folder, jobs=1, limit_s=0.02, advance=lambda _: None)
        answer = scored(questions, folder)[0].answer
        assert answer.failed == "no answer within 0.02 s of processor time"
        assert answer.cpu_s is not None
        assert answer.cpu_s < 3.0


def test_effects_are_planted_by_seed_asked_and_scored(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    planted, again, answers = tmp_path / "planted", tmp_path / "again", tmp_path / "answers"
    for folder in (planted, again):
        carry_out(["arena", "plant", "--to", str(folder), "--seed", "3", "--number", "12"])
    shipped = rigs(planted)
    assert len(every(shipped)) == 12
    for rig in shipped:
        assert not rig.healthy
        for question in rig.questions:
            same = again / rig.name / "recordings" / question.recording.name
            assert question.recording.read_text() == same.read_text()
        truth = json.loads((rig.folder / "truth.json").read_text())
        assert all(9.0 < each["snr"] < 62.0 and each["known"] == "planted" for each in truth.values())
    carry_out(["arena", "run", "--tool", "threshold", "--cases", str(planted), "--answers", str(answers), "--jobs", "1"])
    carry_out(["arena", "score", "--cases", str(planted), "--answers", str(answers)])
    assert "| all |" in capsys.readouterr().out
    next(answers.rglob("*.json")).unlink()
    with pytest.raises(BadInput, match="palpd arena run writes what is missing"):
        carry_out(["arena", "score", "--cases", str(planted), "--answers", str(answers)])


def test_wrong_orders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="the arena has no tool guess; it has palpd, least-squares"):
        carry_out(["arena", "run", "--tool", "guess", "--cases", str(CASES), "--answers", str(tmp_path / "a")])
    with pytest.raises(BadInput, match="needs a folder of answers"):
        carry_out(["arena", "score", "--cases", str(CASES)])
    with pytest.raises(BadInput, match="give --to FOLDER"):
        carry_out(["arena", "plant", "--cases", str(CASES)])
