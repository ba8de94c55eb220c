"""The pages of docs/reference are what docs/generate.py makes of the code now."""

import re
import runpy
from pathlib import Path
from typing import Any

import pytest

from palpd.cell.effects import EFFECTS
from tests.cli.test_application import COMMANDS
from tests.paths import ROOT

FOLDER = ROOT / "docs" / "reference"
GENERATED: dict[str, Any] = runpy.run_path(str(ROOT / "docs" / "generate.py"))
NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e-?\d+)?")


@pytest.mark.parametrize("page", GENERATED["PAGES"])
def test_a_page_is_what_the_code_says_now(page: str) -> None:
    """Words must agree; a figure may differ in its last digit from machine to machine."""
    stored, current = (FOLDER / page).read_text(encoding="utf-8"), GENERATED["PAGES"][page]().rstrip() + "\n"
    assert NUMBER.sub("#", stored) == NUMBER.sub("#", current), "run: python docs/generate.py"
    figures = [list(map(float, NUMBER.findall(text))) for text in (stored, current)]
    assert figures[0] == pytest.approx(figures[1], rel=0.05, abs=0.011), "run: python docs/generate.py"


def test_every_command_is_in_the_reference() -> None:
    described = re.findall(r"^### palpd (\S+)$", (FOLDER / "commands.md").read_text(), re.M)
    assert sorted(described) == sorted(COMMANDS)


def test_every_effect_has_a_figure_and_no_figure_is_left_over() -> None:
    assert {path.stem for path in (FOLDER / "figures").glob("*.svg")} == set(EFFECTS)


def test_a_figure_shows_what_an_effect_changes() -> None:
    figure = GENERATED["effect_figure"](EFFECTS["contact.lateral"])
    above, below = figure.axes
    assert above.get_ylabel() == "fx, N"
    assert max(abs(below.lines[0].get_ydata())) > 0.1


def test_every_option_says_what_it_is() -> None:
    silent = [line for line in (FOLDER / "commands.md").read_text().splitlines() if line.startswith("| `") and line.endswith("|  |")]
    assert not silent


def test_the_pages_of_the_site_are_all_in_its_navigation() -> None:
    sources = [path for ending in ("md", "ipynb") for path in (ROOT / "docs").rglob(f"*.{ending}")]
    pages = {str(path.relative_to(ROOT / "docs").with_suffix(".md")) for path in sources}
    assert set(re.findall(r"\S+\.md$", Path(ROOT / "docs" / "mkdocs.yml").read_text(), flags=re.MULTILINE)) == pages
