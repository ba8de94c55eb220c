"""palpd itself, as a user would ask it: against the healthy recordings where there are some, else against the cell file."""

from typing import Any

from palpd import api
from palpd.arena.cases import Question


def answer(question: Question) -> dict[str, Any]:
    """What `palpd.diagnose` says."""
    healthy, now = (
        [api.import_file(path, accept_implausible=True) for path in paths] for paths in (question.healthy, [question.recording])
    )
    return api.diagnose(now, question.cell, healthy=healthy or None).to_json()
