"""The tab Set-up in a real browser: from an empty folder, a reload in mid-question, and an abort by the space bar while the arm moves.

PALPD_SCREENSHOTS, where it is set, gets pictures.
"""

import os
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from benchmarks.setup import SetupPage, setup_page
from palpd.daemon.setup.commission import Commission, StepResult, seen
from palpd.daemon.setup.flow import NAMES
from palpd.daemon.stored_state import State
from palpd.testing.emulated_cell import EmulatedCell, emulated_cell
from palpd.testing.fixtures import skip_without_ur_rtde
from palpd.testing.processes import until
from tests.browser.conftest import CHROMIUM, PATIENCE_MS, playwright_api
from tests.browser.waiting import nothing_for_axe, until_text

SHOTS = os.environ.get("PALPD_SCREENSHOTS")


@pytest.fixture
def browser() -> Iterator[Any]:
    if CHROMIUM is None:
        pytest.skip("chromium is not installed; apt install chromium")
    with playwright_api.sync_playwright() as playwright:
        yield playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu"], timeout=PATIENCE_MS)


def keep(page: Any, name: str) -> None:
    for scheme, width in [(scheme, width) for scheme in ("light", "dark") for width in (1400, 768)] if SHOTS else ():
        page.emulate_media(color_scheme=scheme)
        page.set_viewport_size({"width": width, "height": 900})
        page.wait_for_timeout(200)
        page.screenshot(path=str(Path(str(SHOTS), f"{name}-{width}-{scheme}.png")), full_page=True)
    page.emulate_media(color_scheme="light")
    page.set_viewport_size({"width": 1400, "height": 900})


def press(page: Any, name: str) -> None:
    page.locator("#question").get_by_role("button", name=name, exact=True).click()


def kept(folder: Path, until_step: str, **others: StepResult) -> None:
    """Keep all steps before one as done."""
    fine = StepResult("2026-11-27T08:00", "ok", (seen("thing", "1 N", "1 N"),))
    State(folder / "state").keep("commission", Commission(dict.fromkeys(NAMES[: NAMES.index(until_step)], fine) | others))


def test_a_person_with_a_browser_alone_begins_reloads_and_aborts(tmp_path: Path, browser: Any) -> None:
    skip_without_ur_rtde()
    folder = tmp_path / "cell"
    with emulated_cell(tmp_path) as cell, setup_page(folder) as server:
        page = browser.new_page(viewport={"width": 1400, "height": 900})
        page.set_default_timeout(PATIENCE_MS)
        page.goto(f"{server.address}/?token={server.token}")
        until_text(page, "#next", "There is no")
        until_text(page, "#doing", "no set-up is under way")
        keep(page, "empty")
        page.click("#begin")
        until_text(page, "#question", "What now?")
        press(page, "Go")
        for question, answer in (("Address of the robot", cell.wires.host), ("Contact limit", None)):
            until_text(page, "#question", question)
            until_text(page, "#doing", "waits for an answer")
            if answer:
                page.fill("#typed", answer)
                page.reload()
                until_text(page, "#question", question)
                assert page.input_value("#typed") == "", "what was only typed is not an answer"
                until_text(page, "#said", "1/13 robot: Finds the controller")
                keep(page, "question")
                page.fill("#typed", answer)
            page.keyboard.press("Enter") if page.evaluate("document.activeElement.id") == "typed" else press(page, "Answer")
        until_text(page, "#said", "2/13 sensor")
        press(page, "Go")
        until_text(page, "#question", "Port or address of the sensor")
        page.fill("#typed", cell.wires.sensor)
        press(page, "Answer")
        until_text(page, "#question", "Where is the calibration?")
        press(page, "Registers")
        until_text(page, "#said", "3/13 tool")
        press(page, "Stop")
        until_text(page, "#next", "Next is tool: Go on leads there")
        abort_while_level_moves(page, cell, folder)
        show_the_ends(page, server, folder)


def abort_while_level_moves(page: Any, cell: EmulatedCell, folder: Path) -> None:
    assert cell.palpd("calibrate", "--config", folder / "config.yaml").returncode == 0
    kept(folder, "level")
    page.click("#begin")
    go = page.locator("#question .moves")
    go.wait_for()
    assert go.inner_text() == "Go: the arm moves"
    nothing_for_axe(page)
    keep(page, "moves")
    go.focus()
    page.keyboard.press("Enter")
    page.wait_for_timeout(300)
    assert "What now?" in page.text_content("#question"), "Enter moves nothing"
    began_z_m = cell.truth()["tip_z_m"]
    go.click()
    until_text(page, "#doing", "Abort stops its motion")
    until(lambda: cell.truth()["tip_z_m"] > began_z_m + 0.001, "the arm goes up", 60.0, every_s=0.01)
    aborted_s = time.monotonic()
    page.keyboard.press("Space")
    until_text(page, "#message", "Abort carried out: the set-up has ended")
    assert cell.truth()["tip_z_m"] < began_z_m + 0.0049
    assert cell.rest_after_s(aborted_s) < 1.0
    until_text(page, "#said", "The set-up has ended with code 3")


def show_the_ends(page: Any, server: SetupPage, folder: Path) -> None:
    advice = "give the cable a loop that hangs loose, and redo reference and level"
    finding = seen("free air", "the force changed by 0.50 N over 5 mm of free air", "at most 0.3 N", advice, fails=True)
    kept(folder, "level", level=StepResult("2026-11-27T08:00", "fail", (finding,)))
    page.reload()
    until_text(page, "#next", "Next is level")
    keep(page, "failed")
    kept(folder, "service", service=StepResult("2026-11-27T08:00", "skipped"))
    page.reload()
    until_text(page, "#next", re.compile("All steps are done.*palpd serve --config").search)  # type: ignore[arg-type]
    keep(page, "finished")
    page.goto(f"{server.address}/checks")
    until_text(page, "#last", "There is no check yet")
    nothing_for_axe(page)
    keep(page, "checks")
