"""The files of the page: what others wrote is unchanged, nothing comes from the internet, nothing is inline, abort stands on every page."""

import hashlib
import re
from html import escape
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from palpd.web.application import build
from palpd.web.page import PageSettings
from palpd.web.sessions import Sessions
from palpd.web.shell import PAGES, STATIC, TABS
from tests.web.conftest import HERE, ORIGIN, TOKEN, Browser
from tests.web.fake_service import FakeService

VENDORED = {
    "uPlot.iife.min.js": "19c8d4c6ad88929a79f4ae49d6f7161566dfd0ba3d15cc495e974f787eb78f1f",
    "uPlot.min.css": "df630c6a8d6f8eeaff264b50f73ce5b114f646ffd9a0bb74f049b0a00135fa04",
    "uPlot-LICENSE": "8f989229699b4fe2f1a0432d0e9edc338a8a911e250e2d1b01ecd770a5f5b1bd",
}
"""SHA-256 of the files of the npm package uplot 1.6.32, as released."""
OURS = sorted([*PAGES.glob("*.html"), *STATIC.glob("*.js"), *STATIC.glob("*.css")])


def test_what_others_wrote_is_as_they_released_it() -> None:
    hashes = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in (STATIC / "vendor").iterdir()}
    assert hashes == VENDORED


@pytest.mark.parametrize("path", OURS, ids=lambda path: path.name)
def test_nothing_comes_from_elsewhere_and_nothing_is_made_of_text(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert not re.search(r"""(src|href|from|import|url)\s*[=(]?\s*["'(]\s*(https?:)?//""", text), "an address of the internet"
    assert not re.search(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\(", text), "foreign text could become HTML"
    assert not re.search(r"<[^>]+\s(on\w+|style)=", text), "the policy refuses it"
    assert not re.search(r"\b(confirm|alert|prompt)\(", text), "a dialog holds the space bar back"


def test_abort_stands_on_every_page_apart_from_tabs_and_pause(browser: Browser) -> None:
    client = browser()
    for tab in TABS:
        page = client.get(tab.path).text
        assert page.count('id="abort"') == 1
        assert "not the emergency stop" in page
        box = page[page.index('class="abort-box"') : page.index('class="standing"')]
        assert box.count("<button") == 1
        assert f'<a href="{tab.path}" aria-current=page>{tab.title}</a>' in page


@pytest.mark.parametrize("url", [None, "http://camera.lab:8080/stream?fps=5&x=$y", "https://10.0.0.7/cell.jpg"])
def test_only_the_origin_of_the_configured_camera_may_send_pictures(service: FakeService, tmp_path: Path, url: str | None) -> None:
    application = build(PageSettings(service.path, tmp_path, camera_url=url), Sessions(TOKEN))
    client = TestClient(application, base_url=ORIGIN, client=(HERE, 40000), headers={"authorization": f"Bearer {TOKEN}"})
    origin = "" if url is None else f" {url[: url.index('/', 8)]}"
    page = client.get("/")
    for answer in (page, client.get("/runs"), client.get("/static/page.css")):
        assert f"; img-src 'self' data: blob:{origin}; connect-src 'self';" in answer.headers["content-security-policy"]
    assert page.text.count('id="camera"') == (url is not None)
    assert "$camera" not in page.text
    if url is not None:
        assert f'src="{escape(url)}"' in page.text
