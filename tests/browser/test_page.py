"""The page in a browser, before a service on emulated wires: order and content, not time. Screenshots are kept."""

import json
import os
import signal
from collections.abc import Callable
from typing import Any

import pytest

from palpd.testing.processes import until
from tests.browser.conftest import PORT, Pages
from tests.browser.waiting import PATIENCE_S, above, until_text

pytestmark = [pytest.mark.hil, pytest.mark.timeout(900)]

ATTEMPTS = 3
NEXT = {"Retract": "retract", "Arm": "arm", "Start": "start"}
Choose = Callable[[Any], None]


def state_is(page: Any, state: str) -> None:
    """Wait until the page says so."""
    page.wait_for_selector(f"body[data-state={state}]")


def message(page: Any) -> str:
    return str(page.text_content("#message"))


def press_the_lit_button(page: Any, name: str, then: str, pages: Pages) -> None:
    """The page leads: press what it lights, and wait for the state that follows.

    Once more where this machine was too slow: the service then refuses, moves nothing, and the same button is lit again.
    """
    for _ in range(ATTEMPTS):
        until(lambda: page.locator(".controls [data-next]").all_inner_texts() == [name], f"{name} is lit", PATIENCE_S, every_s=0.1)
        page.click(".controls [data-next]")
        until(lambda: pages.service.do("status")["now"]["next"] != NEXT[name], f"{name} is answered", PATIENCE_S, every_s=0.05)
        until(lambda: pages.service.do("status")["now"]["next"] or then == "running", "it is over", PATIENCE_S, every_s=0.1)
        now = pages.service.do("status")["now"]
        if now["state"] == then:
            break
        print(f"after {name} the service says {now['word']}: {now['sentence']}; the machine was too slow, once more")
    state_is(page, then)


def press_until_held(page: Any, pages: Pages, choose: Choose) -> None:
    """Arm, start, and wait until the probe is held in the tissue."""
    choose(page)
    press_the_lit_button(page, "Arm", "armed", pages)
    press_the_lit_button(page, "Start", "running", pages)
    until(lambda: pages.service.do("status").get("phase") == "hold", "the probe is held in the tissue", PATIENCE_S, every_s=0.1)


def out_of_the_tissue(page: Any, pages: Pages) -> None:
    """Retract with the button, as after every stop in the tissue."""
    press_the_lit_button(page, "Retract", "disarmed", pages)
    assert pages.service.cell.truth()["contact_N"] < 0.5


def test_a_run_is_started_watched_paused_aborted_and_left(pages: Pages, choose: Choose) -> None:
    page = pages.open()
    pages.keep(page, "1-disarmed")
    press_until_held(page, pages, choose)
    until_text(page, "#force", above(2.0))
    until_text(page, "#depth", above(3.0))
    assert until_text(page, "#progress-text", "holding, about ").endswith(" min left")
    until_text(page, "#doing", "The probe holds with ")
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
    until_text(page, "#doing", "The last run was stopped: the operator aborted the run. The probe is in the tissue")
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
    ben.click("#pause", force=True)  # it is greyed, and says why
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
    assert page.get_attribute("[data-do=start]", "aria-disabled") == "true"
    press_the_lit_button(page, "Arm", "armed", pages)
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


def test_after_an_abort_the_lit_buttons_lead_to_the_next_start(pages: Pages, choose: Choose) -> None:
    page = pages.open()
    press_until_held(page, pages, choose)
    page.click("#abort")
    state_is(page, "pressed")
    page.wait_for_timeout(1000.0)  # the last frames
    before = page.evaluate("document.getElementById('press-chart').toDataURL()")
    assert page.get_attribute("[data-do=arm]", "title") == "The probe is pressed. Retract first."
    press_the_lit_button(page, "Retract", "disarmed", pages)
    assert pages.service.cell.truth()["contact_N"] < 0.5
    assert page.evaluate("document.getElementById('press-chart').toDataURL()") == before, "the curve of the press stays"
    press_the_lit_button(page, "Arm", "armed", pages)
    press_the_lit_button(page, "Start", "running", pages)
    until(lambda: pages.service.do("status").get("phase") == "hold", "the probe is held in the tissue again", PATIENCE_S, every_s=0.1)
    page.click("#abort")
    state_is(page, "pressed")
    press_the_lit_button(page, "Retract", "disarmed", pages)


def test_progress_never_runs_backwards_over_a_run(pages: Pages) -> None:
    page = pages.open()
    plan = {"sites": [{"name": "A"}, {"name": "B", "x_m": 0.005}], "depths_m": [0.002, 0.003], "hold_s": 0.3, "repeats": 1,
            "press_speed_m_per_s": 0.02, "search": {"speed_m_per_s": 0.01, "max_travel_m": 0.03}}  # fmt: skip
    page.set_input_files("#plan-file", {"name": "two.yaml", "mimeType": "text/yaml", "buffer": json.dumps(plan).encode()})
    press_the_lit_button(page, "Arm", "armed", pages)
    press_the_lit_button(page, "Start", "running", pages)
    steps = [(0.0, 1.0)]
    while page.get_attribute("body", "data-state") == "running":
        value, most = page.evaluate("(({ value, max }) => [value, max])(document.getElementById('progress'))")
        if most > 1:
            steps.append((float(value), float(most)))
    done = [value for value, _ in steps]
    assert pages.service.do("status")["last"]["verdict"] == "done", pages.service.do("status")["last"]
    assert done == sorted(done)
    assert {most for _, most in steps[1:]} == {10.0}
    assert len(set(done)) >= 8, "it was followed from step to step"


def test_a_service_that_is_killed_in_contact_comes_back_and_the_page_leads_out(pages: Pages, choose: Choose) -> None:
    page = pages.open()
    press_until_held(page, pages, choose)
    pages.kill_the_service()
    state_is(page, "gone")
    assert page.text_content("#doing") == "The service does not answer. If the arm moves, use the emergency stop."
    page.click("#abort")
    nothing_stopped = "so nothing was stopped; if the arm moves, use the emergency stop"
    until_text(page, "#message", nothing_stopped)
    page.wait_for_event("response", lambda response: response.url.endswith("/do/renew"))  # which cannot know who holds the controls
    page.wait_for_timeout(500.0)
    assert nothing_stopped in str(page.text_content("#message"))
    pages.keep(page, "9-service-dead")
    pages.serve_again()
    state_is(page, "pressed")
    until_text(page, "#message", lambda text: text == "")
    assert page.text_content("#force-name") == "Force against reference"
    until_text(page, "#force", above(2.0))
    pages.keep(page, "10-service-back")
    page.goto(f"http://127.0.0.1:{PORT}/runs")
    page.wait_for_selector("#runs .chip.unfinished")
    name = str(page.text_content("#runs tr .name"))
    page.click(f"[aria-label='recover {name}']")
    until_text(page, "#message", "the probe is pressed; Retract leaves the tissue")
    press_the_lit_button(page, "Retract", "disarmed", pages)
    page.click(f"[aria-label='recover {name}']")
    page.wait_for_selector(f"#runs a:text-is('{name}')")
    assert page.locator(f"[aria-label='recover {name}']").count() == 0
    until_text(page, "#message", "Recover: done. ")
    pages.keep(page, "11-recovered")
