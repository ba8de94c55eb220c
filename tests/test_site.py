"""The docs site builds: every link has its target, and no page asks for anything from elsewhere."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.paths import ROOT

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
    pages = {path.relative_to(ROOT / "docs").with_suffix(".html") for path in (ROOT / "docs").rglob("*.md")}
    assert all((site / page).exists() for page in pages)
    assert not list(site.rglob("generate.py"))


def test_no_page_loads_anything_from_elsewhere(site: Path) -> None:
    assert LOADED.findall('<script src="https://elsewhere.example/x.js">') == ["https://elsewhere.example/x.js"]
    assert {page.name: addresses for page in site.rglob("*.html") if (addresses := LOADED.findall(page.read_text()))} == {}
    assert not [sheet for sheet in site.rglob("*.css") if re.search(r"@import|url\(['\"]?https?:", sheet.read_text())]
