"""`benchmarks.sensitivity` finds what a number moves, by whole diagnoses in processes of their own."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks import sensitivity
from tests.paths import ROOT

FROM_THE_START = """
import json, palpd.gap.assumptions as assumptions
from benchmarks.sensitivity import SEED, Hosts, answer_of, cells, draw, varied
assumptions.ASSUMED = varied("prior.unknown")
print(json.dumps(answer_of(draw(cells(1)[0], SEED, Hosts()), False, 600)))
"""


@pytest.fixture
def run() -> Callable[..., str]:
    """Run Python in a process of its own, and return what it prints."""

    def call(*arguments: str) -> str:
        done = subprocess.run([sys.executable, *arguments], cwd=ROOT, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    return call


def test_a_varied_number_gives_the_answer_that_it_would_give_from_the_start(tmp_path: Path, run: Callable[..., str]) -> None:
    for path in ("prior.unknown", "events.wander_knots"):
        run("-m", "benchmarks.sensitivity", "--cells", "1", "--only", path, "--kept", str(tmp_path), "--jobs", "1", "--bins", "600")
    (answers,) = sensitivity.answers(tmp_path).values()
    assert answers["prior.unknown"]["p_unknown"] > answers[""]["p_unknown"] > 0.0
    assert answers["prior.unknown"] == json.loads(run("-c", FROM_THE_START))
    assert answers["events.wander_knots"] == answers[""] | {"unread": True}
    result = sensitivity.moved("prior.unknown", sensitivity.answers(tmp_path))
    assert (result.cells, result.read) == (1, 1)
    assert result.score == pytest.approx(answers["prior.unknown"]["score"] - answers[""]["score"])
    assert result.score != 0.0


def test_answers_of_two_states_of_the_code_are_pooled_and_no_number_of_a_cell_counts_twice(tmp_path: Path) -> None:
    def keep(folder: str, **by_path: str) -> Path:
        (tmp_path / folder).mkdir()
        lines = [
            {"cell": "one", "path": path, "answer": {"verdict": verdict, "names": [], "score": 0.0}} for path, verdict in by_path.items()
        ]
        (tmp_path / folder / "answers.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        return tmp_path / folder

    older = keep("older", **{"": "none", "prior.one": "none"})
    newer = keep("newer", **{"": "unknown", "prior.one": "none", "prior.two": "unknown"})
    known = sensitivity.pooled([older, newer])
    assert sensitivity.moved("prior.one", known) == sensitivity.Moved(1, 1, [], 0.0)
    assert sensitivity.moved("prior.two", known) == sensitivity.Moved(1, 1, [], 0.0)
    assert sensitivity.moved("prior.one", sensitivity.pooled([newer, older])).changes == ["one, state 0: verdict unknown → none"]
