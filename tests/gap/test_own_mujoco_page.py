"""docs/tutorials/own-mujoco.md: its Python runs in its order, and prints what the page shows."""

from itertools import pairwise

import pytest

from tests.pages import FENCE
from tests.paths import ROOT

PAGE = ROOT / "docs" / "tutorials" / "own-mujoco.md"


def test_the_tutorial_runs_and_prints_what_it_shows(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("mujoco", reason="MuJoCo is not installed; pip install 'palpd[sim]'.")
    blocks = [*FENCE.findall(PAGE.read_text(encoding="utf-8")), ("", "")]
    names = {"__name__": "page"}
    for (kind, text), (next_kind, shown) in pairwise(blocks):
        if kind == "python":
            exec(text, names)
            assert capsys.readouterr().out == ("" if next_kind else shown)
