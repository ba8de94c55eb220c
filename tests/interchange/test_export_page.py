"""The commands of docs/export-sim.md, word by word and in its order."""

import re
import runpy
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest

from palpd.cli.application import carry_out
from tests.paths import ROOT

PAGE = (ROOT / "docs" / "export-sim.md").read_text()


def test_the_tutorial_runs_word_by_word(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for package in ("mujoco", "pythonfmu3", "fmpy"):
        pytest.importorskip(package, reason=f"{package} is not installed; install the dev group to export cells.")
    monkeypatch.chdir(tmp_path)
    lines = [line for block in re.findall(r"^```bash\n(.*?)^```", PAGE, flags=re.MULTILINE | re.DOTALL) for line in block.splitlines()]
    assert len(lines) == 9
    for line in lines:
        program, *words = shlex.split(line)
        if program == "python":
            monkeypatch.setattr(sys, "argv", words)
            runpy.run_path(words[0], run_name="__main__")
        else:
            carry_out(words)
    expected, mujoco_fz_N, fmu_fz_N = (
        np.genfromtxt(f"{name}.csv", delimiter=",", names=True)["fz_N"] for name in ("expected", "rollout", "rollout-fmu")
    )
    assert expected.max() > 0.1
    assert np.abs(mujoco_fz_N - expected).max() < 2e-3
    assert np.abs(fmu_fz_N - expected).max() < 2e-3
    assert len(list((tmp_path / "cells-mujoco" / "draws").iterdir())) == 50
    drawn = np.genfromtxt("rollout-7.csv", delimiter=",", names=True)["fz_N"]
    assert 1e-4 < np.abs(drawn - expected).max() < 0.2
