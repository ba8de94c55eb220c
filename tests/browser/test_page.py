"""The page in a browser, before a service on emulated wires: order and content, not time. Screenshots are kept."""

import os
import signal
from collections.abc import Callable
from typing import Any

import pytest

from benchmarks.emulated_cell import until
from tests.browser.conftest import Pages
from tests.browser.waiting import PATIENCE_S, above, until_text

pytestmark = [pytest.mark.hil, pytest.mark.timeout(900)]

Choose = Callable[[Any], None]


def state_is(page: Any, state: str) -> None:
    """Wait until the page says so."""
    page.wait_for_selector(f"body[data-state={state}]")


def message(page: Any) -> str:
    return str(page.text_content("#message"))


def press_until_held(page: Any, pages: Pages, choose: Choose) -> None:
    """Arm, start, and wait until the probe is held in the tissue."""
    choose(page)
    page.click("[data-do=arm]")
    state_is(page, "armed")
    page.click("[data-do=start]")
    state_is(page, "running")
    until(lambda: pages.service.do("status").get("phase") == "hold", "the probe is held in the tissue", PATIENCE_S, every_s=0.1)


def out_of_the_tissue(page: Any, pages: Pages) -> None:
    """Retract with the button, as after every stop in the tissue."""
    page.click("[data-do=retract]")
    until(
        lambda: pages.service.do("status").get("last", {}).get("recording", "").endswith("retract.mcap"), "the arm left", 120.0, every_s=0.1
    )
    pages.service.until_disarmed(PATIENCE_S)
    assert pages.service.cell.truth()["contact_N"] < 0.5


def test_a_run_is_started_watched_paused_aborted_and_left(pages: Pages, choose: Choose) -> None:
    page = pages.open()
    pages.keep(page, "1-disarmed")
    press_until_held(page, pages, choose)
    until_text(page, "#force", above(2.0))
    until_text(page, "#depth", above(3.0))
    until_text(page, "#progress-text", "holding")
    until_text(page, "#rate", above(20.0))
    assert "contact_N" not in str(page.text_content("body"))
    pages.keep(page, "2-holding")

    page.click("#pause")
    state_is(page, "paused")
    assert page.text_content("#pause") == "Resume"
    assert pages.service.cell.truth()["contact_N"] < 0.5, "a pause leaves the tissue"
    pages.keep(page, "3-paused")
    page.click("#pause")
    until(lambda: pages.service.do("status").get("phase") == "hold", "the press has begun again", PATIENCE_S, every_s=0.1)

    page.focus("#pause")
    page.keyboard.press("Space")
    until(lambda: pages.service.do("status")["state"] == "disarmed", "the space bar aborts, also while Pause has the focus", PATIENCE_S)
    until_text(page, "#fault", "the operator aborted")
    assert "Abort carried out" in message(page)
    assert pages.service.cell.truth()["contact_N"] > 2.0, "the arm rests where it was"
    pages.keep(page, "4-aborted")
    out_of_the_tissue(page, pages)


def test_an_expired_page_aborts_and_can_do_nothing_else(pages: Pages, choose: Choose) -> None:
    page = pages.open()
    press_until_held(page, pages, choose)
    pages.expire(page)
    page.click("#pause")
    until_text(page, "#message", "12 hours")
    assert pages.service.do("status")["state"] == "running"
    page.click("#abort")
    until(lambda: pages.service.do("status")["state"] == "disarmed", "an expired page aborts", PATIENCE_S)
    pages.keep(page, "5-expired")
    pages.close_browsers()
    out_of_the_tissue(pages.open(), pages)


def test_a_server_that_hangs_or_dies_is_a_lost_link_and_the_run_goes_on(pages: Pages, choose: Choose) -> None:
    page = pages.open()
    press_until_held(page, pages, choose)
    page.wait_for_selector("body:not([data-old])")
    assert pages.process is not None
    os.kill(pages.process.pid, signal.SIGSTOP)
    try:
        page.wait_for_selector("body[data-link=lost][data-old]")
        assert page.text_content("#link") == "Link lost"
        pages.keep(page, "7-link-lost")
    finally:
        os.kill(pages.process.pid, signal.SIGCONT)
    page.wait_for_selector("body[data-link=open]:not([data-old])")
    pages.stop()
    page.wait_for_selector("body[data-link=lost]")
    ticks = pages.service.do("status")["tick"]
    until(lambda: pages.service.do("status")["tick"] > ticks + 50, "the run goes on without its page", PATIENCE_S)
    assert pages.service.do("status")["state"] == "running"
    pages.start()
    page.wait_for_selector("body[data-link=open]:not([data-old])")
    page.keyboard.press("Space")
    until(lambda: pages.service.do("status")["state"] == "disarmed", "the page of the server before aborts", PATIENCE_S)
    out_of_the_tissue(page, pages)


def test_one_operator_holds_the_controls_and_everyone_aborts(pages: Pages, choose: Choose) -> None:
    anna, ben = pages.open("anna"), pages.open("ben", scheme="dark", size=(1024, 768))
    press_until_held(anna, pages, choose)
    until_text(ben, "#holder", "anna holds the controls")
    ben.click("#pause")
    until_text(ben, "#message", "anna holds the controls; ")
    assert pages.service.do("status")["phase"] == "hold"
    pages.keep(ben, "8-second-operator")
    ben.fill("#operator", "")
    ben.focus("#operator")
    ben.keyboard.type("b b")
    assert ben.input_value("#operator") == "b b", "in a text field the space bar is a space"
    assert pages.service.do("status")["phase"] == "hold"
    ben.click("#abort")
    until(lambda: pages.service.do("status")["state"] == "disarmed", "whoever watches may abort", PATIENCE_S)
    out_of_the_tissue(anna, pages)


def test_a_wrong_plan_is_refused_in_one_sentence_and_nothing_moves(pages: Pages) -> None:
    page = pages.open("<img src=x onerror=alert(1)>")
    page.click("[data-do=arm]")
    state_is(page, "armed")
    until_text(page, "#holder", "You hold the controls")
    for text, sentence in (
        ("sites: [{name: A}]\ndepths_m: [0.4]\n", "a depth of 0.4 m is outside 0.0002 to 0.02 m"),
        ("sites: [{name: '../x'}]\ndepths_m: [0.004]\n", "sites.0.name"),
        ("sites: [", "wrong.yaml"),
    ):
        page.set_input_files("#plan-file", {"name": "wrong.yaml", "mimeType": "text/yaml", "buffer": text.encode()})
        page.click("[data-do=start]")
        until_text(page, "#message", sentence)
        assert pages.service.do("status")["state"] == "armed"
    assert page.query_selector("main img") is None
