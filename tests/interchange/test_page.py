"""The commands of docs/import.md, word by word and in its order."""

import re
import runpy
import shlex
import sys
from pathlib import Path

import pytest

from palpd.cli.application import carry_out
from tests.paths import ROOT

PAGE = (ROOT / "docs" / "import.md").read_text()


def test_the_tutorials_run_word_by_word(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    lines = [line for block in re.findall(r"^```bash\n(.*?)^```", PAGE, flags=re.MULTILINE | re.DOTALL) for line in block.splitlines()]
    assert len(lines) == 10
    printed = ""
    for line in lines:
        program, *words = shlex.split(line)
        if program == "python":
            monkeypatch.setattr(sys, "argv", [words[0], *words[1:]])
            runpy.run_path(str(ROOT / words[0]), run_name="__main__")
        else:
            carry_out(words)
            printed += capsys.readouterr().out
    quoted = [text for kind, text in re.findall(r"^```(\w*)\n(.*?)^```$", PAGE, flags=re.MULTILINE | re.DOTALL) if not kind]
    assert len(quoted) == 3
    shown = " ".join(printed.split())
    for block in quoted:
        for sentence in block.splitlines():
            assert " ".join(sentence.split()) in shown
    assert shown.count("tissue.viscoelastic, probability 1.00") == 2
    assert {"recording.csv", "cell.yaml", "report.html", "enriched.yaml", "bag.csv", "bag.yaml"} <= {
        path.name for path in tmp_path.iterdir()
    }
