"""The reports of a run and of a diagnosis in Chromium: first screen, folded parts, phone, paper, and what axe finds."""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from palpd.cell.cell_file import nominal
from palpd.cell.effects import EFFECTS
from palpd.gap.report.page import curves_of, page
from palpd.history.report import report_of, write_report
from tests.browser.test_page_alone import AXE
from tests.gap.test_diagnosis import quick, recording
from tests.gap.test_report import EVENTS, LAW, PROPOSED
from tests.history.conftest import simulated

__all__ = ["simulated"]

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
playwright_api: Any = pytest.importorskip("playwright.sync_api", reason="Playwright is not installed; pip install playwright")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium here; apt install chromium")
DESK, PHONE = {"width": 1400, "height": 900}, {"width": 390, "height": 844}
REPORTS = ("run", "stopped run", "two runs", "no gap", "one cause", "outside the list")


@pytest.fixture(scope="module")
def reports(simulated: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """One report of every kind."""
    folder = tmp_path_factory.mktemp("reports")
    paths = {name: folder / f"{name.replace(' ', '-')}.html" for name in REPORTS}
    write_report(paths["run"], report_of(simulated / "day-0.mcap"))
    write_report(paths["stopped run"], report_of(simulated / "day-2.mcap"))
    write_report(paths["two runs"], report_of(simulated / "day-0.mcap", simulated / "day-1.mcap"))
    rubbing, healthy = (quick(recording(nominal(), effects), nominal()) for effects in ({"cable.friction": {"force_N": 0.1}}, {}))
    content = rubbing.to_json() | {"next_experiment": PROPOSED, "notes": ["A note."]}
    odd = content | {"verdict": "unknown", "learned": LAW, "events": EVENTS[1], "decisive": ["fz_N is dead."]}
    for name, diagnosis, answer in (
        ("one cause", rubbing, content),
        ("no gap", healthy, healthy.to_json()),
        ("outside the list", rubbing, odd),
    ):
        paths[name].write_text(page(answer, curves_of(diagnosis), EFFECTS, f"{name}.csv"), encoding="utf-8")
    return paths


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright_api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu"])
        yield chromium
        chromium.close()


def opened(browser: Any, path: Path, size: dict[str, int], scheme: str = "light") -> Any:
    shown = browser.new_page(viewport=size, color_scheme=scheme)
    shown.goto(path.as_uri())
    if folder := os.environ.get("PALPD_SCREENSHOTS"):
        shown.screenshot(path=str(Path(folder, f"report-{path.stem}-{size['width']}-{scheme}.png")), full_page=True)
    return shown


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("name", REPORTS)
def test_axe_finds_nothing_in_a_report(browser: Any, reports: dict[str, Path], name: str, scheme: str) -> None:
    shown = opened(browser, reports[name], DESK, scheme)
    shown.evaluate("document.querySelectorAll('details').forEach(folded => { folded.open = true; })")
    findings = shown.evaluate(f"async () => {{ {AXE.read_text()}; return (await axe.run()).violations; }}")
    assert [(each["id"], each["help"], each["nodes"][0]["html"][:200]) for each in findings] == []
    shown.close()


@pytest.mark.parametrize("name", REPORTS)
def test_a_phone_scrolls_a_report_in_one_direction(browser: Any, reports: dict[str, Path], name: str) -> None:
    shown = opened(browser, reports[name], PHONE)
    shown.evaluate("document.querySelectorAll('details').forEach(folded => { folded.open = true; })")
    assert shown.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    shown.close()


@pytest.mark.parametrize("name", REPORTS)
def test_what_is_folded_on_a_screen_is_open_on_paper(browser: Any, reports: dict[str, Path], name: str) -> None:
    shown = opened(browser, reports[name], DESK)
    room = "[...document.querySelectorAll('details.fold')].map(part => part.offsetHeight - part.firstElementChild.offsetHeight)"
    folded = shown.evaluate(room)
    assert len(folded) >= 4
    assert max(folded) < 10
    shown.emulate_media(media="print")
    assert min(shown.evaluate(room)) > 20
    shown.close()


@pytest.mark.parametrize("size", [DESK, PHONE])
@pytest.mark.parametrize("name", ["no gap", "one cause", "outside the list"])
def test_what_to_do_next_begins_on_the_first_screen_of_a_diagnosis(
    browser: Any, reports: dict[str, Path], name: str, size: dict[str, int]
) -> None:
    shown = opened(browser, reports[name], size)
    top = shown.get_by_role("heading", name="Do this next").bounding_box()["y"]
    assert 0 < top < size["height"] - 60
    shown.close()


def test_the_first_screen_of_a_run_says_stiffness_hertz_tare_and_guard(browser: Any, reports: dict[str, Path]) -> None:
    shown = opened(browser, reports["run"], DESK)
    for words in ("Young's modulus", "fits", "Tare.", "Guard.", "Force over depth"):
        box = shown.locator(".card").get_by_text(words, exact=True).first.bounding_box()
        assert box["y"] + box["height"] < DESK["height"], words
    shown.close()
