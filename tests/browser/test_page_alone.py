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
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import pytest

from benchmarks.emulated_cell import until
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

PORT = 8791
ADDRESS = f"http://127.0.0.1:{PORT}"
AXE = Path(__file__).parent / "axe.min.js"
"""axe-core 4.14.1, its released file (MPL 2.0)."""
SERIOUS = ("serious", "critical")
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
    running = {
        "state": "running",
        "job": "palpation",
        "activity": "site A: pressing",
        "steps": 8,
        "steps_done": 3,
        "phase": "press",
        "tick": 7,
    }
    whole_scene.service.publish({"event": "status", **whole_scene.service.status, **running, "controls": None, "latched": None})
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
    assert page.text_content("#doing") == "site A: pressing"
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
    page.click("[data-do=arm]")
    until_text(page, "#message", "12 hours")
    assert scene.service.asked("arm") == scene.service.asked("take") == []
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


def test_who_does_not_hold_the_controls_is_refused_in_the_services_words(scene: Scene) -> None:
    page = scene.open(scheme="dark", size=(1024, 768))
    scene.service.publish({"event": "status", **scene.service.status, "controls": "anna"})
    until_text(page, "#holder", "anna holds the controls")
    sentence = "anna holds the controls; wait until they are free, or free them by force (palpd controls --free)"
    scene.service.answers["take"] = {"ok": False, "error": sentence}
    page.click("#pause")
    until_text(page, "#message", sentence)
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


def test_a_stop_says_why_and_what_to_do(scene: Scene) -> None:
    page = scene.open(scheme="dark")
    reason = "the compensated contact force was 12.3 N, above contact_limit_N of 12 N; the probe was retracted"
    last = {
        "verdict": "stopped",
        "reason": reason,
        "recording": "/runs/20260714-101502-palpation.mcap",
        "notes": ["a note"],
        "last_ticks": [],
    }
    status = {
        key: value for key, value in scene.service.status.items() if key not in ("job", "activity", "steps", "steps_done", "phase", "tick")
    }
    scene.service.publish({"event": "status", **status, "state": "disarmed", "latched": reason, "last": last})
    page.wait_for_selector("body[data-state=latched][data-old]")
    assert page.text_content("#fault") == f"Stopped: {reason}"
    assert "Retract" in page.text_content("#fault-do")
    assert page.locator("#fault-notes li").all_inner_texts() == ["a note", "recording 20260714-101502-palpation.mcap"]
    page.screenshot(path=str(scene.shots / "stopped.png"))


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing_serious(scene: Scene, scheme: str) -> None:
    for path in ("/", "/plan", "/runs", "/resolve"):
        page = scene.open(scheme=scheme, size=(1024, 768), path=path)
        findings = page.evaluate(f"async () => {{ {AXE.read_text()}; return (await axe.run()).violations; }}")
        page.screenshot(path=str(scene.shots / f"axe-{path.strip('/') or 'run'}-{scheme}.png"))
        serious = [f"{path} {each['id']}: {each['nodes'][0]['html'][:120]}" for each in findings if each["impact"] in SERIOUS]
        assert not serious, json.dumps(serious, indent=1)
        page.context.close()
        scene.contexts.remove(page.context)
