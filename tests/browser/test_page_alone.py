"""The page in a browser before a fake service: expired pages, a lost link, the space bar, hostile names, and what axe finds."""

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import pytest

from palpd.control.probe_state import ProbeAnswer, ProbeState
from palpd.daemon.what_now import Standing
from palpd.testing.processes import free_port, until
from palpd.tick import Mode, Phase
from palpd.web.sessions import SESSION_S, Sessions
from tests.browser.waiting import PATIENCE_S, above, until_text
from tests.web.fake_service import FakeService

playwright_api: Any = pytest.importorskip("playwright.sync_api", reason="playwright is not installed; pip install playwright")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = [
    pytest.mark.timeout(1800),
    pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed; apt install chromium"),
]

PORT = free_port()
ADDRESS = f"http://127.0.0.1:{PORT}"
AXE = Path(__file__).parent / "axe.min.js"
"""axe-core 4.14.1, its released file (MPL 2.0)."""
PRESSING = Standing(run="palpation", phase=Phase.PRESS, site="A", force_N=2.2, depth_m=0.004, job="1", reference=True)
STEPS = {"steps": 8, "steps_done": 3, "left_s": 95.0, "activity": "site A: pressing"}
FREE = Standing(reference=True, probe=ProbeAnswer(ProbeState.FREE))
PRESSED = ProbeAnswer(ProbeState.PRESSED, ("the run-7 of today is unfinished, and the tip is low",), frozenset(("retract",)), 2.13)
STOPPED = "the compensated contact force was 12.3 N, above contact_limit_N of 12 N; the probe was retracted"
LATCHED = replace(FREE, latch=("2026-07-14T10:15:02", STOPPED))
HOSTILE = '<img src=x onerror="document.title=1">'
NO_MODULUS = {"dynamic_Pa": None, "dynamic_ci95_Pa": None, "peak_N": 6.1, "cut_short": False}
SITES = [
    {"name": "A", "x_m": -0.40, "y_m": 0.15, "static_Pa": 62e3, "static_ci95_Pa": [60e3, 64e3]} | NO_MODULUS,
    {"name": HOSTILE, "x_m": -0.37, "y_m": 0.16, "static_Pa": 94e3, "static_ci95_Pa": [91e3, 97e3]} | NO_MODULUS,
]


@dataclass
class Scene:
    """A fake service with a loop that ticks, the page's server, and a browser."""

    service: FakeService
    token_file: Path
    chromium: Any
    shots: Path
    process: "subprocess.Popen[str] | None" = None
    contexts: list[Any] = field(default_factory=list)

    def serve(self) -> None:
        """Start the server."""
        command = [sys.executable, "-m", "palpd.web", "--socket", self.service.path, "--runs", self.token_file.parent]
        command += ["--token-file", self.token_file, "--port", str(PORT)]
        self.process = subprocess.Popen(list(map(str, command)), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, text=True)

        def listens() -> bool:
            with suppress(OSError), urlopen(f"{ADDRESS}/static/icon.svg", timeout=5.0):
                return True
            return False

        until(listens, "the page is served", PATIENCE_S, every_s=0.2)

    def open(self, scheme: str = "light", size: tuple[int, int] = (1400, 900), path: str = "/") -> Any:
        """A page of a new browser, opened with the token and linked."""
        context = self.chromium.new_context(color_scheme=scheme, viewport={"width": size[0], "height": size[1]})
        context.set_default_timeout(1e3 * PATIENCE_S)
        self.contexts.append(context)
        page = context.new_page()
        page.goto(f"{ADDRESS}/?token={self.token_file.read_text().strip()}", wait_until="commit")
        if path != "/":
            page.goto(ADDRESS + path, wait_until="commit")
        page.wait_for_selector("body[data-link=open][data-service=open]")
        return page

    def aborts(self, number: int) -> None:
        """Wait until the service was asked for that number of aborts."""
        until(lambda: len(self.service.asked("abort")) >= number, f"{number} aborts", PATIENCE_S, every_s=0.05)


@pytest.fixture(scope="module")
def whole_scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    folder = tmp_path_factory.mktemp("page")
    service = FakeService(folder / "palpd.sock")
    over = threading.Event()
    with playwright_api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu"], timeout=1e3 * PATIENCE_S)
        scene = Scene(service, folder / "token", chromium, Path(os.environ.get("PALPD_SCREENSHOTS", folder)))
        ticking = threading.Thread(target=press_for_ever, args=(service, over), daemon=True)
        ticking.start()
        scene.serve()
        print(f"screenshots are kept in {scene.shots}")
        yield scene
        over.set()
        ticking.join()
        assert scene.process is not None
        scene.process.kill()
        scene.process.wait()
        chromium.close()
    service.close()


@pytest.fixture
def scene(whole_scene: Scene) -> Iterator[Scene]:
    """A run under way, nobody holds the controls, nobody has asked for anything."""
    whole_scene.service.stand(PRESSING, **STEPS)
    whole_scene.service.requests.clear()
    whole_scene.service.answers.clear()
    yield whole_scene
    for context in whole_scene.contexts:
        context.close()
    whole_scene.contexts.clear()


def press_for_ever(service: FakeService, over: threading.Event) -> None:
    """Ticks of a loop that presses and leaves, one press in six seconds."""
    began_s, number = time.monotonic(), 0
    while not over.wait(0.03):
        while number < (time.monotonic() - began_s) * 125.0:
            t_s = number / 125.0
            press, since_s = divmod(t_s, 6.0)
            depth_m = max(-0.004, 0.003 * min(since_s - 1.0, 1.6, 5.0 - since_s))
            force_N = 2.4e4 * max(0.0, depth_m) ** 1.5
            service.write(
                number, began_s + t_s, force_N, tcp_pose=[0.0, 0.0, 0.1 - depth_m, 0.0, 0.0, 0.0], surface_z_m=0.1, site=0,
                repeat=int(press), mode=Mode.DYNAMIC, depth_m=0.005, phase=Phase.PRESS if depth_m > 0 else Phase.BASELINE,
                absolute_N=force_N + 0.4, work_us=310.0,
            )  # fmt: skip
            number += 1


def test_the_values_live_and_names_are_only_text(scene: Scene) -> None:
    page = scene.open()
    until_text(page, "#force", above(1.0))
    page.wait_for_selector("body:not([data-old])")
    assert page.text_content("#state") == "Running"
    assert page.text_content("#doing") == "The probe presses with 2.2 N at site A, 4.0 mm deep."
    assert page.text_content("#progress-text") == "3 of 8 steps, site A: pressing, about 2 min left"
    scene.service.publish({"event": "sites", "job": "1", "error": "", "sites": SITES})
    scene.service.publish({"event": "log", "id": "1", "line": HOSTILE})
    until_text(page, "#log", "<img")
    rows = page.locator("#sites tr")
    assert rows.nth(0).inner_text().split("\t") == ["A", "62.0", "60.0 – 64.0", "–", "–", "6.1"]
    assert rows.nth(1).locator("th").inner_text() == HOSTILE
    assert page.locator("main img").count() == 0
    assert page.title() == "palpd: Run"
    page.screenshot(path=str(scene.shots / "run.png"))


def test_the_space_bar_aborts_but_in_a_text_field(scene: Scene) -> None:
    page = scene.open()
    page.focus("#operator")
    page.keyboard.type("a b")
    assert page.input_value("#operator") == "a b"
    assert scene.service.asked("abort") == []
    for selector in ("#pause", "#take", "nav a[aria-current]", "#plan-file"):
        scene.service.requests.clear()
        page.evaluate("document.getElementById('message').textContent = ''")
        page.focus(selector)
        page.keyboard.press("Space")
        until_text(page, "#message", "Abort carried out")
        scene.aborts(1)
    assert {request["do"] for request in scene.service.requests} <= {"abort", "status", "watch"}, "no button was pressed by it"


def test_an_expired_page_aborts_and_says_what_to_do_otherwise(scene: Scene) -> None:
    page = scene.open()
    token = scene.token_file.read_text().strip()
    cookie = Sessions(token, lambda: time.time() - SESSION_S - 60.0).begin()
    page.context.add_cookies([{"name": f"palpd_{PORT}", "value": cookie, "url": ADDRESS, "sameSite": "Strict"}])
    page.click("#pause")
    until_text(page, "#message", "12 hours")
    assert scene.service.asked("pause") == scene.service.asked("take") == []
    page.click("#abort")
    scene.aborts(1)
    page.goto(ADDRESS, wait_until="commit")
    page.wait_for_selector("#token")
    page.screenshot(path=str(scene.shots / "entrance.png"))
    page.click("#abort")
    scene.aborts(2)


def test_a_token_that_is_typed_opens_the_page_and_a_wrong_one_is_one_sentence(scene: Scene) -> None:
    context = scene.chromium.new_context()
    context.set_default_timeout(1e3 * PATIENCE_S)
    scene.contexts.append(context)
    page = context.new_page()
    page.goto(ADDRESS, wait_until="commit")
    page.fill("#token", "a wrong one")
    page.click("text=Open the page")
    until_text(page, "#main", "the token is not the one of this page")
    page.fill("#token", scene.token_file.read_text().strip())
    page.keyboard.press("Enter")
    page.wait_for_selector("body[data-link=open][data-service=open]")
    assert page.url == f"{ADDRESS}/"


def test_a_module_that_comes_late_hears_the_first_status(scene: Scene) -> None:
    """Its service says nothing more, as one that is disarmed does."""
    page = scene.open()
    page.route("**/static/run.js", lambda route: (time.sleep(1.0), route.continue_()))
    page.reload(wait_until="commit")
    until(lambda: "3 of 8 steps" in page.text_content("#progress-text"), "the first status is shown", 20.0)


def test_an_abort_without_a_service_points_at_the_emergency_stop(scene: Scene) -> None:
    page = scene.open()
    hidden = scene.service.path.with_name("away.sock")
    scene.service.path.rename(hidden)
    try:
        page.click("#abort")
        until_text(page, "#message", "so nothing was stopped; if the arm moves, use the emergency stop")
    finally:
        hidden.rename(scene.service.path)


def test_a_hung_server_is_a_lost_link_and_a_new_one_is_found(scene: Scene) -> None:
    page = scene.open()
    page.wait_for_selector("body:not([data-old])")
    assert scene.process is not None
    os.kill(scene.process.pid, signal.SIGSTOP)
    try:
        page.wait_for_selector("body[data-link=lost][data-old]")
        assert page.text_content("#link") == "Link lost"
        page.screenshot(path=str(scene.shots / "link-lost.png"))
    finally:
        os.kill(scene.process.pid, signal.SIGCONT)
    page.wait_for_selector("body[data-link=open]:not([data-old])")
    scene.process.kill()
    scene.process.wait()
    page.wait_for_selector("body[data-link=lost]")
    scene.serve()
    page.wait_for_selector("body[data-link=open]:not([data-old])")
    page.keyboard.press("Space")
    scene.aborts(1)


def test_who_does_not_hold_the_controls_is_refused_in_the_words_of_buttons(scene: Scene) -> None:
    page = scene.open(scheme="dark", size=(1024, 768))
    scene.service.publish({"event": "status", **scene.service.status, "controls": "anna"})
    until_text(page, "#holder", "anna holds the controls")
    sentence = "anna holds the controls; wait until they are free, or free them by force (palpd controls --free)"
    scene.service.answers["take"] = {"ok": False, "error": sentence}
    page.click("#pause", force=True)  # it is greyed, and says why
    until_text(page, "#message", sentence.replace("palpd controls --free", "Take by force"))
    assert scene.service.asked("pause") == []
    scene.service.answers["take"] = {"ok": True, "lease": "feed", "lease_s": 10.0}
    before = len(scene.service.asked("take"))
    page.click("#take")
    assert len(scene.service.asked("take")) == before, "one press takes nothing by force"

    def held() -> bool:
        label = page.text_content("#take")
        if label != "Release controls":
            page.click("#take")  # within five seconds of the one before, or it counts as a first one again
        return bool(label == "Release controls")

    until(held, "the controls are taken by force", PATIENCE_S, every_s=0.5)
    assert scene.service.asked("take")[-1]["force"] is True
    page.click("#pause")
    until(lambda: scene.service.asked("pause"), "the pause goes out", PATIENCE_S)
    assert scene.service.asked("pause")[0]["lease"] == "feed"
    page.screenshot(path=str(scene.shots / "held.png"))


def test_controls_that_ran_out_while_the_link_was_lost_are_taken_once_more_by_the_same_press(scene: Scene) -> None:
    page = scene.open()
    scene.service.answers["take"] = {"ok": True, "lease": "one", "lease_s": 10.0}
    page.click("#pause")
    until(lambda: scene.service.asked("pause"), "the pause goes out", PATIENCE_S)
    ended = {"ok": False, "error": "the controls were not renewed within 10 s; take them again"}
    scene.service.answers |= {"pause": ended, "renew": ended, "take": {"ok": True, "lease": "two", "lease_s": 10.0}}
    page.click("#pause")
    until(lambda: scene.service.asked("pause")[-1]["lease"] == "two", "it goes out with the new lease", PATIENCE_S)
    scene.service.answers |= {"take": {"ok": False, "error": "ben holds the controls; wait until they are free"}}
    scene.service.requests.clear()
    page.click("#pause")
    until_text(page, "#message", "ben holds the controls")
    assert [request.get("force") for request in scene.service.asked("take")] == [False], "nothing is taken by force"


def test_a_stop_says_why_and_what_to_do(scene: Scene) -> None:
    page = scene.open(scheme="dark")
    last = {
        "verdict": "stopped",
        "reason": STOPPED,
        "recording": "/runs/20260714-101502-palpation.mcap",
        "notes": ["the probe is pressed; palpd retract leaves the tissue"],
        "last_ticks": [],
    }
    scene.service.stand(LATCHED, last=last)
    page.wait_for_selector("body[data-state=latched][data-old]")
    assert page.text_content("#doing") == f"{STOPPED[0].upper()}{STOPPED[1:]}."
    assert page.text_content("#fault") == f"Stopped: {STOPPED}"
    notes = page.locator("#fault-notes li").all_inner_texts()
    assert notes == ["the probe is pressed; Retract leaves the tissue", "recording 20260714-101502-palpation.mcap"]
    page.screenshot(path=str(scene.shots / "stopped.png"))


# --- what now ---------------------------------------------------------------------------------------------------------------------

STATES = [
    ("untared", Standing(), "No reference", "There is no reference tare", "Calibrate"),
    ("disarmed", FREE, "Disarmed", "The probe is free", "Arm"),
    ("armed", replace(FREE, armed=True), "Armed", "The next start moves the arm", "Start"),
    ("running", PRESSING, "Running", "The probe presses with 2.2 N at site A, 4.0 mm deep", None),
    ("paused", replace(PRESSING, phase=Phase.PAUSED), "Paused", "The probe waits above the tissue at site A", "Resume"),
    ("waiting", Standing(job="1", proposal=True), "Waiting for you", "proposes a motion", "Answer the job"),
    ("latched", LATCHED, "Stopped", STOPPED[1:], "Clear"),
    ("latched", replace(LATCHED, probe=PRESSED, unfinished=True), "Stopped", "The probe is in the tissue, with 2.1 N", "Retract"),
    (
        "pressed",
        replace(FREE, probe=PRESSED, last="the operator aborted the run"),
        "In the tissue",
        "The last run was stopped: the operator aborted the run. The probe is in the tissue, with 2.1 N against the reference tare.",
        "Retract",
    ),
    (
        "unknown",
        replace(FREE, probe=ProbeAnswer(ProbeState.UNKNOWN, ("the force is 0.50 N off",), frozenset(("level_test", "confirm")))),
        "Probe unknown",
        "Whether the probe is free is not known: the force is 0.50 N off.",
        "Level test",
    ),
    ("unready", replace(FREE, fault="no sensor answers; run palpd calibrate then"), "Not ready", "answers; Calibrate then.", "Check"),
    (
        "robot",
        replace(LATCHED, stop="protective_stop", probe=PRESSED, unfinished=True),
        "Protective stop",
        "At the pendant: read its message, remove what the arm pushes against, wait 5 s, then press Enable Robot.",
        None,
    ),
    ("checking", replace(FREE, run="check"), "Checking", "Robot and sensor are being checked", None),
]
SIZES = [(1400, 900), (768, 1024), (390, 844)]
WHOLE = "e => e.scrollHeight <= e.clientHeight + 1 && e.scrollWidth <= e.clientWidth + 1"
CHOOSE = {"name": "plan.yaml", "mimeType": "text/yaml", "buffer": b"sites: [{name: A}]\ndepths_m: [0.004]\n"}


@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}")
def test_each_state_says_in_a_line_what_stands_and_lights_the_next_button(scene: Scene, size: tuple[int, int]) -> None:
    page = scene.open(size=size)
    page.set_input_files("#plan-file", CHOOSE)
    for number, (state, standing, word, sentence, button) in enumerate(STATES):
        scene.service.stand(standing)
        until_text(page, "#state", word)
        until_text(page, "#doing", sentence)
        assert page.get_attribute("body", "data-state") == state
        assert "palpd" not in str(page.text_content("#doing")), "operators read buttons"
        assert page.locator("#doing").evaluate(WHOLE), "nothing of the sentence is cut off"
        lit = page.locator(".controls [data-next]:visible").all_inner_texts()
        assert lit == ([button] if button else []), word
        for greyed in page.locator(".controls [aria-disabled]:visible").all():
            assert len(greyed.get_attribute("title") or "") > 10, "an impossible button says why"
            assert greyed.evaluate("e => { e.focus(); return document.activeElement === e; }"), "and a keyboard reaches it"
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), "nothing stands outside of the screen"
        page.screenshot(path=str(scene.shots / f"now-{number}-{state}-{size[0]}.png"))


def test_an_impossible_button_says_why_where_it_is_tapped_and_asks_for_nothing(scene: Scene) -> None:
    page = scene.open(size=(390, 844))
    scene.service.stand(replace(FREE, probe=PRESSED))
    until_text(page, "#state", "In the tissue")
    for button, sentence in (
        ("arm", "Arm is not possible: The probe is pressed. Retract first."),
        ("start", "Start is not possible: The service is disarmed, and the probe is pressed. Retract first."),
        ("pause", "Pause is not possible: Nothing is running that could pause."),
        ("level-test", "Level test is not possible: The probe is pressed. Retract first."),
    ):
        page.click(f"[data-do={button}]", force=True)
        until_text(page, "#message", sentence)
    assert {request["do"] for request in scene.service.requests} <= {"status", "watch"}
    page.click("[data-next]")
    until(lambda: scene.service.asked("retract"), "the lit button asks", PATIENCE_S)


def test_a_start_without_a_plan_points_at_the_choice_of_one(scene: Scene) -> None:
    page = scene.open()
    scene.service.stand(replace(FREE, armed=True))
    page.wait_for_selector("body[data-no-plan]")
    page.click("[data-do=start]", force=True)
    until_text(page, "#message", "Start is not possible: No plan is chosen. Choose a plan first.")
    assert scene.service.asked("start") == []
    page.set_input_files("#plan-file", CHOOSE)
    page.click("[data-do=start][data-next]")
    until(lambda: scene.service.asked("start"), "the plan starts", PATIENCE_S)


def test_a_plan_of_the_server_that_has_changed_is_read_anew_before_it_starts(scene: Scene) -> None:
    page, texts = scene.open(), ["sites: [{name: A}]\ndepths_m: [0.004]\n"]
    page.route("**/first-plan", lambda route: route.fulfill(json={"ok": True, "name": "plan.yaml", "text": texts[-1]}))
    page.reload()
    until_text(page, "#plan-name", "plan.yaml")
    scene.service.stand(replace(FREE, armed=True))
    texts.append(texts[0].replace("0.004", "0.005"))
    page.click("[data-do=start][data-next]")
    until_text(page, "#message", "plan.yaml has changed since this page read it")
    assert scene.service.asked("start") == []
    page.click("[data-do=start][data-next]")
    until_text(page, "#message", "Started.")
    assert scene.service.asked("start")[0]["plan"]["depths_m"] == [0.005]


def test_a_decimal_comma_is_no_larger_number(scene: Scene) -> None:
    page = scene.open(path="/checks")
    scene.service.stand(FREE)
    for typed, sentence in (("21,5 C", "The temperature is 21,5 C, expected"), ("21,5", "The job has begun")):
        page.fill("#temperature", "")
        page.type("#temperature", typed)
        page.check("#here")
        page.click("main #check")
        until_text(page, "#message", sentence)
    assert scene.service.asked("begin")[0]["arguments"] == {"temperature_C": 21.5, "here": True}


def test_a_change_on_purpose_begins_a_new_baseline_with_a_note(scene: Scene) -> None:
    figures = {"date": "2026-11-18T08:00:00+01:00", "named": [], "temperature_C": None, "baseline": None}
    last = figures | {"level": "stop", "sentence": "The puck has changed; if it is another one, palpd check --new-baseline."}
    page = scene.open()
    answer = {"ok": True, "checks": [last], "figures": [], "injections": {}}
    page.route("**/checks/list", lambda route: route.fulfill(json=answer))
    page.goto(f"{ADDRESS}/checks")
    scene.service.stand(FREE)
    until_text(page, "#last", "if it is another one, begin a new baseline in Checks.")
    page.screenshot(path=str(scene.shots / "renewal.png"))
    page.click("#renew")
    until_text(page, "#message", "The note is empty")
    page.fill("#note", "a new puck")
    page.click("#renew")
    until(lambda: scene.service.asked("begin"), "the baseline begins", PATIENCE_S)
    begun = scene.service.asked("begin")[0]
    assert (begun["program"], begun["arguments"]) == ("baseline", {"note": "a new puck"})
    last["level"] = "ok"
    page.reload()
    until_text(page, "#last", "ok")
    assert not page.is_visible("#renewal")


def test_where_sites_count_from_is_chosen_beside_the_start(scene: Scene) -> None:
    page = scene.open()
    page.set_input_files("#plan-file", CHOOSE)
    assert not page.is_visible("#place-choice")
    asks = "the run run-7 of today was not finished, and the arm stands 30 mm from where it began, at its site B"
    scene.service.stand(replace(FREE, armed=True, question=asks))
    until_text(page, "#place-question", asks[1:])
    until_text(page, "#doing", "The next start moves the arm, once you have said where its sites count from.")
    page.select_option("#place-choice", "return")
    page.click("[data-do=start]")
    until(lambda: scene.service.asked("start"), "the plan starts", PATIENCE_S)
    assert scene.service.asked("start")[0]["place"] == "return"
    page.screenshot(path=str(scene.shots / "place.png"))


@pytest.mark.parametrize(("size", "scheme"), [((1400, 900), "light"), ((768, 1024), "dark")], ids=["wide", "narrow"])
def test_the_cause_of_a_second_protective_stop_is_written_beside_the_clear(scene: Scene, size: tuple[int, int], scheme: str) -> None:
    page = scene.open(scheme=scheme, size=size)
    assert not page.is_visible("#cause")
    asks = "a protective stop came within 60 s after the one before, so its cause must be written down"
    earlier = {"date": "2026-07-14T10:14:02+02:00", "over": "", "cause": "the tool touched the frame", "by": "anna", "written": ""}
    scene.service.stand(replace(LATCHED, cause=asks), protective=[earlier | {"date": "2026-07-14T10:15:02+02:00", "cause": ""}, earlier])
    until_text(page, "#doing", asks[1:])
    assert page.is_visible("#cause")
    until_text(page, "#fault-notes", "protective stop of 2026-07-14 at 10:14:02: the tool touched the frame, written by anna")
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), "nothing stands outside of the screen"
    page.fill("#cause", "a cable is too short")
    page.screenshot(path=str(scene.shots / f"cause-{size[0]}-{scheme}.png"))
    page.click("[data-do=clear]")
    until(lambda: scene.service.asked("clear"), "the stop is acknowledged", PATIENCE_S)
    assert scene.service.asked("clear")[0]["cause"] == "a cable is too short"
    scene.service.stand(FREE)
    page.wait_for_selector("#cause", state="hidden")


def test_a_service_that_dies_leaves_no_refusal_behind_and_comes_back_in_contact(scene: Scene) -> None:
    page = scene.open()
    page.wait_for_selector("body:not([data-old])")
    away = scene.service.path.with_name("away.sock")
    scene.service.path.rename(away)
    scene.service.drop_watchers()
    try:
        until_text(page, "#state", "No service")
        until_text(page, "#doing", "The service does not answer. If the arm moves, use the emergency stop.")
        page.click("#pause", force=True)
        until_text(page, "#message", "Pause is not possible: The service does not answer.")
        page.click("#abort")
        until_text(page, "#message", "use the emergency stop")
        for place in ("#doing", "#message", "#progress-text"):
            assert "palpd serve" not in str(page.text_content(place))
        assert page.locator(".controls [data-next]").count() == 0
        page.screenshot(path=str(scene.shots / "service-dead.png"))
    finally:
        away.rename(scene.service.path)
    scene.service.stand(replace(FREE, probe=PRESSED, unfinished=True), probe={"state": "pressed", "reasons": [], "ways": ["retract"],
                        "advice": "palpd retract leaves the tissue", "date": "2026-07-14T10:15:02+02:00"})  # fmt: skip
    until_text(page, "#state", "In the tissue")
    until_text(page, "#message", lambda text: text == "")
    assert page.locator(".controls [data-next]").all_inner_texts() == ["Retract"]
    assert page.text_content("#force-name") == "Force against reference"
    assert page.text_content("#now-head") == "Last read at 10:15:02"
    texts = page.evaluate("['#force', '#absolute'].map((name) => document.querySelector(name).textContent)")  # of one and the same tick
    shown, absolute = (float(text.split()[0].replace("−", "-")) for text in texts)
    assert shown == pytest.approx(absolute, abs=0.06), "the force against the reference, not that of a tare taken in the tissue"
    page.screenshot(path=str(scene.shots / "service-back.png"))


# --- from afar, and on a telephone --------------------------------------------------------------------------------------------------


def test_the_distance_view_shows_state_force_depth_and_what_now_large_enough_for_two_metres(scene: Scene) -> None:
    """A letter is read at 2 m from 8 mm on: 30 pixels on a usual screen of 0.27 mm a pixel."""
    page = scene.open(path="/?view=distance")
    until_text(page, "#force", above(1.0))
    for selector, least in (("#state", 60.0), ("#doing", 30.0), ("#force", 120.0), ("#depth", 120.0), ("#progress-text", 20.0)):
        box = page.locator(selector).bounding_box()
        assert float(page.evaluate(f"parseFloat(getComputedStyle(document.querySelector('{selector}')).fontSize)")) >= least, selector
        assert box["y"] + box["height"] <= 900, f"{selector} is on the screen"
    assert not page.is_visible("#force-chart")
    assert page.is_visible("#abort")
    page.screenshot(path=str(scene.shots / "distance.png"))
    page.keyboard.press("Space")
    scene.aborts(1)
    scene.service.stand(replace(LATCHED, probe=PRESSED, unfinished=True))
    until_text(page, "#state", "Stopped")
    assert page.locator(".controls button:visible").all_inner_texts() == ["Retract"], "what is sensible stays in reach"
    box = page.locator("#depth").bounding_box()
    assert box["y"] + box["height"] <= 900
    page.screenshot(path=str(scene.shots / "distance-stopped.png"))
    page.click("#distance")
    assert page.url == f"{ADDRESS}/"
    assert page.is_visible("#force-chart")


@pytest.mark.parametrize("size", [(390, 844), (360, 640)], ids=lambda size: f"{size[0]}")
def test_on_a_telephone_the_abort_covers_nothing_and_is_always_in_reach(scene: Scene, size: tuple[int, int]) -> None:
    page = scene.open(size=size, scheme="dark")
    until_text(page, "#force", above(1.0))
    seen = set()
    for scrolled in range(0, 4000, 150):
        page.evaluate(f"document.querySelector('.rest').scrollTo(0, {scrolled})")
        abort = page.locator(".abort-box").bounding_box()
        assert abort["y"] >= 0
        assert abort["y"] + abort["height"] <= size[1] + 1, "the abort is on the screen"
        for name in ("force", "depth", "raw", "inertial", "absolute", "rate", "missed", "work", "progress-text", "doing"):
            box = page.locator(f"#{name}").bounding_box()
            if box["y"] >= 0 and box["y"] + box["height"] <= abort["y"]:
                middle = f"document.elementFromPoint({box['x'] + box['width'] / 2}, {box['y'] + box['height'] / 2})"
                assert page.evaluate(
                    f"document.getElementById('{name}').contains({middle}) || {middle}.contains(document.getElementById('{name}'))"
                )
                seen.add(name)
            assert box["x"] + box["width"] <= size[0], f"{name} is not cut off at the right"
        boxes = "['.abort-box', '.rest'].map((each) => document.querySelector(each).getBoundingClientRect())"
        assert page.evaluate(f"(([abort, rest]) => abort.top >= rest.bottom - 1)({boxes})"), "the page scrolls above the abort"
    assert len(seen) == 10, "each number came into view"
    page.evaluate("document.querySelector('.rest').scrollTo(0, 0)")
    page.screenshot(path=str(scene.shots / f"phone-{size[0]}.png"))


def test_curves_are_told_apart_without_their_colours(scene: Scene) -> None:
    page = scene.open()
    styles = [
        page.evaluate(f"getComputedStyle(document.querySelector('.legend .k-{name}'), '::before').borderTop.replace(/rgb.*/, '')")
        for name in ("force", "raw", "inertial")
    ]
    assert len(set(styles)) == 3, styles


def test_a_camera_is_shown_beside_the_charts_and_pictures_from_elsewhere_are_refused(scene: Scene, tmp_path: Path) -> None:
    class Camera(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "image/svg+xml")
            self.end_headers()
            self.wfile.write(
                b'<svg xmlns="http://www.w3.org/2000/svg" width="64" height="48"><rect width="64" height="48" fill="teal"/></svg>'
            )

        def log_message(self, *_: object) -> None: ...

    cameras = [ThreadingHTTPServer(("127.0.0.1", 0), Camera) for _ in range(2)]
    for camera in cameras:
        threading.Thread(target=camera.serve_forever, daemon=True).start()
    url, elsewhere = (f"http://127.0.0.1:{camera.server_address[1]}/cell.svg" for camera in cameras)
    port = free_port()
    command = [sys.executable, "-m", "palpd.web", "--socket", scene.service.path, "--runs", tmp_path, "--token-file", scene.token_file]
    server = subprocess.Popen([*map(str, command), "--port", str(port), "--camera-url", url], stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        link = server.stdout.readline().split()[-1]
        context = scene.chromium.new_context(viewport={"width": 1400, "height": 900})
        scene.contexts.append(context)
        page = context.new_page()
        page.goto(link)
        loaded = "() => { const e = document.getElementById('camera'); return e.complete && e.naturalWidth > 0; }"
        until(lambda: page.evaluate(loaded), "the picture of the camera is shown", PATIENCE_S)
        page.screenshot(path=str(scene.shots / "camera.png"))
        page.evaluate(f"() => {{ document.getElementById('camera').src = '{elsewhere}'; }}")
        until_text(page, "#camera-note", "no picture from")
        assert not page.evaluate(loaded)
    finally:
        server.kill()
        server.wait()
        for camera in cameras:
            camera.shutdown()
            camera.server_close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing(scene: Scene, scheme: str) -> None:
    for path in ("/", "/?view=distance", "/plan", "/runs", "/resolve"):
        page = scene.open(scheme=scheme, size=(1024, 768), path=path)
        for standing in (PRESSING, replace(FREE, probe=PRESSED)):
            scene.service.stand(standing)
            until_text(page, "#state", "Running" if standing is PRESSING else "In the tissue")
            findings = page.evaluate(f"async () => {{ {AXE.read_text()}; return (await axe.run()).violations; }}")
            words = [f"{path} {each['id']}: {each['nodes'][0]['html'][:120]}" for each in findings]
            assert not findings, json.dumps(words, indent=1)
        page.screenshot(path=str(scene.shots / f"axe-{path.strip('/') or 'run'}-{scheme}.png"))
        page.context.close()
        scene.contexts.remove(page.context)
