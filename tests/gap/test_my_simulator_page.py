"""docs/my-simulator.md: its Python and its commands, in their order, and what they print."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from palpd.recording.samples import read_csv
from tests.paths import ROOT

EVERYTHING = "palpd simulate recording.csv --cell enriched.yaml --simulated sim.csv --nominal cell.yaml --csv x.csv"
PAGE = (ROOT / "docs" / "my-simulator.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE, flags=re.MULTILINE | re.DOTALL)


def run(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    arguments = [sys.executable, "-m", *command.split()]
    return subprocess.run(arguments, cwd=folder, capture_output=True, text=True, check=False, env=os.environ | {"PYTHONPATH": str(ROOT)})


def test_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    (code,) = blocks("python")
    exec(code, {"__name__": "page"})
    own, mine = capsys.readouterr().out.strip().splitlines()
    assert "something rubs (cable.friction" not in own
    assert "something rubs (cable.friction" in mine
    for command in "".join(blocks("bash")).splitlines():
        done = run(command, tmp_path)
        assert done.returncode == 0, done.stderr
    content = json.loads((tmp_path / "out.json").read_text())
    assert [effect["id"] for effect in content["effects"]] == ["cable.friction"]
    assert content["simulated"]["not_judged"] == [
        *("robot.backlash", "robot.compliance", "tissue.surface", "tissue.plasticity"),
        *("robot.lag", "robot.vibration"),
    ]
    predicted, recorded = read_csv(tmp_path / "predicted.csv"), read_csv(tmp_path / "recording.csv")
    assert float((predicted.wrench[:, 2] - recorded.wrench[:, 2]).std()) < 0.06  # the noise of the sensor is 0.05 N
    refusals = {
        "palpd diagnose recording.csv recording.csv --cell cell.yaml --simulated sim.csv": "files of --simulated: 1 (sim.csv)",
        "palpd diagnose . --simulated sim.csv": "--simulated is for one recording",
        "palpd simulate recording.csv --cell enriched.yaml --simulated sim.csv --csv x.csv": "--simulated and --nominal belong together",
        f"{EVERYTHING} --noise 1": "leave --noise or --simulated out",
    }
    for command, sentence in refusals.items():
        done = run(command, tmp_path)
        assert (done.returncode, done.stdout) == (2, "")
        assert sentence in " ".join(done.stderr.split()), done.stderr
    assert not (tmp_path / "x.csv").exists()


def test_the_refusals_of_the_page_are_those_of_the_code() -> None:
    code = "".join((ROOT / "palpd" / "gap" / name).read_text() for name in ("user_simulator.py", "nominal_source.py"))
    quoted = re.findall(r"^\| ((?:fz_N|z_m|sim\.csv) .*?) \|", PAGE.split("## What is refused")[1], flags=re.MULTILINE)
    assert len(quoted) == 7
    for sentence in quoted:
        words = max(re.split(r"sim\.csv|…|\d+|\bfz_N\b|\bz_m\b|\(a note\)|expected", sentence), key=len).strip(" ,")
        assert words in code, words
