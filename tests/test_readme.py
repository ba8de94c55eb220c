"""The README's commands, in its order, in a copy of the repository.

Blocks marked `bash` are run as they stand. Each exception stands here with its reason, so a new command cannot be left out by accident. The
commands of the other pages are run by test_pages.py; here is tested that they exist.
"""

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import typer.main

from palpd.cli import app
from tests.pages import commands_of
from tests.paths import ROOT

PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md"), ROOT / "tests" / "README.md", *(ROOT / "systemd").glob("*.md")])
TOO_LONG = {"make demo": "4 minutes; test_demo.py runs its parts", "make test": "this is it"}
MADE_LATER = {"models/inertial.onnx"}
"""Files that a page names and a command makes."""


@pytest.fixture(scope="module")
def clone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What git knows of the working tree, with the set-up that `make setup` makes."""
    folder = tmp_path_factory.mktemp("clone")
    names = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False).stdout.split("\0")
    if not any(names):
        pytest.skip("the repository is no clone, so nobody knows which files belong to it")
    for name in filter(None, names):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes((ROOT / name).read_bytes())
    (folder / ".venv").symlink_to(sys.prefix)
    return folder


def environment(clone: Path, **variables: str) -> dict[str, str]:
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    return os.environ | {"PYTHONPATH": str(clone), "PATH": path} | variables


def run(line: str, clone: Path, **variables: str) -> str:
    done = subprocess.run(
        ["bash", "-euc", line], cwd=clone, env=environment(clone, **variables), capture_output=True, text=True, check=False,
        stdin=subprocess.DEVNULL, timeout=500,
    )  # fmt: skip
    assert done.returncode == 0, f"{line}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
    return done.stdout


@pytest.mark.timeout(900)  # on a busy computer
def test_the_blocks_of_the_readme_run_in_order(clone: Path) -> None:
    lines = commands_of(ROOT / "README.md")
    left_out = [line for line in lines if line.partition("#")[0].strip() in TOO_LONG]
    assert len(left_out) == len(TOO_LONG)
    kept = [line for line in lines if line not in left_out]
    assert len(kept) >= 7
    for line in kept:
        run(line, clone)
    for name in ("cell/config.yaml", "cell/plan.yaml", "look.html", "look.yaml", "predicted.csv"):
        assert (clone / name).stat().st_size > 100


@pytest.mark.parametrize("page", PAGES, ids=lambda page: f"{page.parent.name}/{page.name}")
def test_every_command_that_a_page_quotes_exists_with_its_options(page: Path) -> None:
    commands: Any = typer.main.get_command(app)
    text = page.read_text()
    code = re.findall(r"^```.*?^```", text, flags=re.MULTILINE | re.DOTALL)
    code += re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL))
    for name, rest in re.findall(r"(?:^|(?<=[\s`/]))palpd ([a-z][a-z-]*)([^#|;\n]*)", "\n".join(code), flags=re.MULTILINE):
        assert name in commands.commands, f"{page.name}: palpd {name}{rest}"
        parameters = commands.commands[name].params
        known = {"--help", *(option for one in parameters for option in (*one.opts, *one.secondary_opts))}
        for option in re.findall(r"(?<=\s)--[A-Za-z][A-Za-z-]*", rest):
            assert option in known, f"{page.name}: palpd {name}{rest}: there is no {option}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: f"{page.parent.name}/{page.name}")
def test_every_test_and_file_that_a_page_names_exists(page: Path) -> None:
    text = page.read_text()
    tests = {name for file in (ROOT / "tests").rglob("*.py") for name in re.findall(r"def (test_\w+)", file.read_text())}
    named = set(re.findall(r"`(test_\w+)`", text))
    assert named <= tests, named - tests
    files = set(re.findall(r"`((?:palpd|hw|tests|benchmarks|docs|systemd|models)/[\w/.-]+\.(?:py|md|yaml|service|onnx|c))`", text))
    absent = {name for name in files if not (ROOT / name).exists()}
    assert not absent - MADE_LATER, absent
