"""The docs site builds: every link has its target, and no page asks for anything from elsewhere."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.paths import ROOT

NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
LOADED = re.compile(r"""<(?:script|link|img|iframe)\b[^>]*?(?:src|href)=["']?(https?:[^"'\s>]*)""")
"""What a browser fetches by itself when it opens a page."""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-f", ROOT / "docs" / "mkdocs.yml", "-d", folder]
    built = subprocess.run(command, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"}, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stdout + built.stderr
    return folder


def test_the_site_builds_with_every_link_and_page(site: Path) -> None:
    sources = [path for ending in ("md", "ipynb") for path in (ROOT / "docs").rglob(f"*.{ending}")]
    assert all((site / path.relative_to(ROOT / "docs").with_suffix(".html")).exists() for path in sources)
    assert not list(site.rglob("generate.py"))


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_its_page_shows_figures_and_tables(site: Path, notebook: Path) -> None:
    page = (site / "notebooks" / f"{notebook.stem}.html").read_text()
    pictures = re.findall(rf'<img[^>]*src="({notebook.stem}-\d+\.png)"', page)
    assert pictures
    assert all((site / "notebooks" / picture).read_bytes().startswith(b"\x89PNG") for picture in pictures)
    assert "<table>" in page
    assert f'href="{notebook.name}"' in page, "it can be downloaded"
    assert (site / "notebooks" / notebook.name).exists()
    links = re.findall(r'href="(notebooks/[^"]*)"', (site / "api.html").read_text())
    assert f"notebooks/{notebook.stem}.html" in links


@pytest.mark.parametrize("word", ["UR10", "UR10e", "Franka", "Isaac", "Gazebo", "Simulink", "Windows", "ROS"])
def test_the_search_finds_what_works(site: Path, word: str) -> None:
    entries = json.loads((site / "search" / "search_index.json").read_text())["docs"]
    places = [entry["location"] for entry in entries if re.search(rf"\b{word}\b", entry["text"])]
    assert any(place.startswith("what-works.html") for place in places)


def test_no_page_loads_anything_from_elsewhere(site: Path) -> None:
    assert LOADED.findall('<script src="https://elsewhere.example/x.js">') == ["https://elsewhere.example/x.js"]
    assert {page.name: addresses for page in site.rglob("*.html") if (addresses := LOADED.findall(page.read_text()))} == {}
    assert not [sheet for sheet in site.rglob("*.css") if re.search(r"@import|url\(['\"]?https?:", sheet.read_text())]
