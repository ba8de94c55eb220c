"""Tools that answer questions of the arena: each takes a question and gives the content of an answer."""

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

from palpd.arena.cases import Question
from palpd.errors import BadInput

Runner = Callable[[Question], dict[str, Any]]
"""Takes a question, gives the content of an answer's file (docs/arena.md)."""

RUNNERS: Mapping[str, str] = {
    "palpd": "palpd_runner",
    "least-squares": "least_squares",
    "sindy": "sindy",
    "threshold": "threshold",
    "always": "always",
}
"""Modules of this folder by the name of the tool."""


def runner(tool: str) -> Runner:
    """The function of a tool. Raises BadInput where there is no such tool, or its package is not installed."""
    if tool not in RUNNERS:
        raise BadInput(f"the arena has no tool {tool}; it has {', '.join(RUNNERS)}")
    try:
        answer: Runner = import_module(f"palpd.arena.runners.{RUNNERS[tool]}").answer
    except ImportError as error:
        raise BadInput(f"{tool} needs {error.name}, which is not installed; install palpd[arena]") from None
    return answer
