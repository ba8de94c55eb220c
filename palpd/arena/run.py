"""Ask a tool every question, in processes of its own, with the same limit of processor time for each; answers that stand are kept."""

import json
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from importlib.metadata import version
from pathlib import Path
from platform import python_version
from types import FrameType
from typing import Any

from palpd.arena.answers import ToolAnswer
from palpd.arena.cases import KnownTruth, Question
from palpd.arena.runners import runner
from palpd.arena.score import ScoredAnswer
from palpd.errors import BadInput, PalpdError
from palpd.files import write_json
from palpd.workers import pool


class _OutOfTime(Exception): ...


def ask(tool: str, questions: Sequence[Question], out: Path, *, jobs: int, limit_s: float, advance: Callable[[int], None]) -> None:
    """Write the answer to every question as OUT/RIG/NAME.json.

    Args:
        tool: One of palpd.arena.runners.RUNNERS.
        jobs: Number of processes.
        limit_s: Processor time for a question.
        advance: Takes the number of further answers.

    Raises:
        BadInput: There is no such tool.
    """
    runner(tool)
    left = [question for question in questions if not answer_file(out, question).is_file()]
    advance(len(questions) - len(left))
    with pool(jobs) as workers:
        for question, content in zip(left, workers.map(partial(_answer, tool, limit_s, _made_by()), left), strict=True):
            file = answer_file(out, question)
            file.parent.mkdir(parents=True, exist_ok=True)
            write_json(file, content)
            advance(1)


def scored(of: Sequence[tuple[Question, KnownTruth]], answers: Path) -> list[ScoredAnswer]:
    """Answers beside their truths.

    Raises:
        BadInput: An answer is missing or none.
    """
    missing = [f"{question.rig}/{question.name}.json" for question, _ in of if not answer_file(answers, question).is_file()]
    if missing:
        more = f" and {len(missing) - 3} more" if len(missing) > 3 else ""
        raise BadInput(f"{answers} has no {', '.join(missing[:3])}{more}; palpd arena run writes what is missing")
    return [ScoredAnswer(question, truth, ToolAnswer.load(answer_file(answers, question))) for question, truth in of]


def answer_file(answers: Path, question: Question) -> Path:
    """Where the answer to a question stands."""
    return answers / question.rig / f"{question.name}.json"


def _made_by() -> str:
    """Versions of what answers, and the commit where palpd runs from a checkout."""
    describe = ["git", "-C", str(Path(__file__).parents[2]), "describe", "--always", "--dirty", "--exclude=*", "--abbrev=12"]
    try:
        commit = subprocess.run(describe, capture_output=True, text=True, check=False).stdout.strip()
    except OSError:
        commit = ""
    of = ", ".join(f"{name} {version(name)}" for name in ("numpy", "scipy"))
    return f"palpd {version('palpd')}{f' (commit {commit})' if commit else ''}, Python {python_version()}, {of}"


def _answer(tool: str, limit_s: float, made_by: str, question: Question) -> dict[str, Any]:
    began = time.process_time()
    try:
        with _limited(limit_s):
            content = runner(tool)(question)
    except _OutOfTime:
        content = {"arena": {"failed": f"no answer within {limit_s:g} s of processor time"}}
    except PalpdError as error:
        content = {"arena": {"failed": str(error)}}
    extra = content.get("arena") or {}
    plain = {
        key: content[key] for key in ("schema", "verdict", "sentence", "effects", "candidates", "p_none", "p_unknown") if key in content
    }
    extra |= {"tool": tool, "made_by": made_by, "cpu_s": time.process_time() - began}
    result: dict[str, Any] = json.loads(json.dumps(plain | {"arena": extra}))
    return result


@contextmanager
def _limited(limit_s: float) -> Iterator[None]:
    """Raise _OutOfTime when the context has used its processor time.

    Python drops an exception that a signal raises inside a weak reference's callback, as imports have them. So the timer asks again,
    and the time is read once more at the end.
    """
    began = time.process_time()

    def end(_number: int, _frame: FrameType | None) -> None:
        raise _OutOfTime

    before = signal.signal(signal.SIGPROF, end)
    signal.setitimer(signal.ITIMER_PROF, limit_s, 1.0)
    try:
        yield
        if time.process_time() - began > limit_s:
            raise _OutOfTime
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)
