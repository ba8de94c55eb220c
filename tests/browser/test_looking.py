"""The tabs Runs, Plan and Resolve in a real browser: order and content. PALPD_SCREENSHOTS, where it is set, gets pictures of each."""

import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from palpd.history.remarks import remark
from tests.browser.waiting import free_port
from tests.history.conftest import simulated
from tests.paths import ROOT
from tests.web.fake_resolve import PROPOSAL, FakeResolve

__all__ = ["simulated"]

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytest.importorskip("playwright.sync_api", reason="Playwright is not installed; pip install playwright")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium here; apt install chromium")

HOSTILE = "<img src=x onerror=\"document.title='hacked'\">"
PATIENCE_MS = 1000 * int(os.environ.get("PALPD_PATIENCE_S", "120"))
"""Longest wait for a calculation: these tests check no times, and a busy machine may take longer."""
SIZES = {"desktop": (1400, 900), "tablet": (1024, 768)}


@dataclass
class Scene:
    """A server over recorded runs with a fake service, and a browser that has shown the token."""

    page: Any
    service: FakeResolve
    address: str
    runs: Path

    def show(self, path: str) -> None:
        """Go to a page."""
        self.page.goto(f"{self.address}{path}")

    def text(self, selector: str) -> str:
        """The text of the first element there."""
        return str(self.page.locator(selector).first.inner_text())

    def until(self, selector: str, text: str | None = None) -> None:
        """Wait until something is there, with a text in it."""
        where = self.page.locator(selector)
        (where.filter(has_text=text) if text else where).first.wait_for(timeout=PATIENCE_MS)

    def keep(self, name: str) -> None:
        """Keep pictures of the whole page: light and dark, desktop and tablet."""
        folder = os.environ.get("PALPD_SCREENSHOTS")
        if folder is None:
            return
        for scheme, size in (("light", "desktop"), ("dark", "desktop"), ("light", "tablet"), ("dark", "tablet")):
            width, height = SIZES[size]
            self.page.emulate_media(color_scheme=scheme)
            self.page.set_viewport_size({"width": width, "height": height})
            self.page.wait_for_timeout(200)
            self.page.screenshot(path=str(Path(folder, f"{name}-{size}-{scheme}.png")), full_page=True)
        self.page.emulate_media(color_scheme="light")
        self.page.set_viewport_size({"width": 1400, "height": 900})


@pytest.fixture(scope="module")
def scene(simulated: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    from playwright.sync_api import sync_playwright

    folder = tmp_path_factory.mktemp("looking")
    runs = Path(shutil.copytree(simulated, folder / "runs"))
    remark(runs / "day-1.mcap", "2026-11-22T10:15:00+00:00", tags=["wet"], note=HOSTILE)
    shutil.copy(ROOT / "config.yaml", folder)
    service, port, token_file = FakeResolve(folder / "palpd.sock"), free_port(), folder / "token"
    words = ["--socket", folder / "palpd.sock", "--runs", runs, "--token-file", token_file, "--port", port]
    words += ["--config", folder / "config.yaml"]
    server = subprocess.Popen([sys.executable, "-m", "palpd.web", *map(str, words)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        address = f"http://127.0.0.1:{port}"
        for _ in range(600):
            with closing(socket.socket()) as client:
                if client.connect_ex(("127.0.0.1", port)) == 0:
                    break
            assert server.poll() is None, "the server of the page has ended"
            time.sleep(0.1)
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu"])
            page = browser.new_page(viewport={"width": 1400, "height": 900}, accept_downloads=True)
            page.set_default_timeout(PATIENCE_MS)
            page.goto(f"{address}/?token={token_file.read_text().strip()}")
            yield Scene(page, service, address, runs)
            browser.close()
    finally:
        server.terminate()
        server.wait()
        service.close()


def test_the_list_is_filtered_and_a_hostile_note_is_only_text(scene: Scene) -> None:
    scene.show("/runs")
    scene.until("#count", "3 runs")
    assert [row.inner_text() for row in scene.page.locator("#runs .name").all()] == ["day-2", "day-1", "day-0"]
    assert HOSTILE in scene.text("#runs tr:nth-child(2) .words")
    assert scene.page.title() == "palpd: Runs"
    scene.keep("runs")
    scene.page.select_option("[name=verdict]", "stopped")
    scene.until("#count", "1 run ")
    assert scene.text("#runs .name") == "day-2"
    scene.page.fill("[name=text]", "no such thing")
    scene.until("#count", "No run in")


def test_a_run_shows_facts_slider_and_report(scene: Scene) -> None:
    scene.show("/runs/view?run=day-1")
    scene.until("#headline", "Done: 3 presses at 1 site, 1 depth cut short.")
    scene.until("#curve svg")
    whole = scene.text("#window")
    scene.page.get_by_role("button", name="site A").click()
    scene.page.wait_for_function("before => document.getElementById('window').textContent !== before", arg=whole)
    scene.page.evaluate("const s = document.getElementById('length'); s.value = 300; s.dispatchEvent(new Event('input'))")
    scene.page.wait_for_function("() => document.querySelector('#force svg').getAttribute('aria-label').startsWith('contact force')")
    scene.until("#report iframe")
    report = scene.page.frame_locator("#report iframe")
    report.get_by_text("Young's modulus").first.wait_for()
    assert scene.page.locator(".note").inner_text().endswith(HOSTILE)
    assert scene.page.title() == "palpd: a run"
    scene.keep("run")
    before = len([request for request in scene.service.requests if request["do"] == "abort"])
    scene.page.locator("#report iframe").click(force=True, position={"x": 50, "y": 50})
    scene.page.keyboard.press("Space")
    scene.until("#message", "Abort carried out")
    assert len([request for request in scene.service.requests if request["do"] == "abort"]) > before  # the report took no focus


def test_tags_and_notes_stay_on_the_page_of_a_run_after_a_reload(scene: Scene) -> None:
    """The facts of a run are read once and kept; its remarks change."""
    scene.show("/runs/view?run=day-2")
    scene.page.wait_for_selector("#facts:not([hidden])")
    scene.page.fill("[name=tag]", "new-tip")
    scene.page.fill("[name=note]", "a note that stays")
    scene.page.get_by_role("button", name="Keep", exact=True).click()
    scene.until(".note", "a note that stays")
    scene.page.reload()
    scene.until(".note", "a note that stays")
    scene.until(".tag", "new-tip")
    scene.page.get_by_label("take the tag new-tip away").click()
    scene.page.wait_for_selector(".tag", state="detached")
    scene.page.reload()
    scene.until(".note", "a note that stays")
    scene.page.wait_for_selector("#curve svg")
    assert scene.page.locator(".tag").count() == 0


def test_lines_of_a_run_end_at_a_gap_another_site_and_a_pause(scene: Scene) -> None:
    scene.show("/runs/view?run=day-1")
    columns = {
        "t_s": [0.0, 0.1, 0.2, 1.2, 1.3, 1.4, 1.5, 1.6], "site": [0, 0, 0, 0, 0, 1, 1, 1], "phase": [4, 4, 4, 4, 4, 4, 12, 4],
        "force_high_N": [1, 2, 3, 4, 5, 6, 7, 8],
    }  # fmt: skip
    script = "(columns) => import('/static/chart.js').then(({ broken }) => broken(columns).force_high_N)"
    assert scene.page.evaluate(script, columns) == [1, 2, 3, None, 4, 5, None, 6, None, 7, None, 8]


def test_two_runs_are_chosen_and_compared(scene: Scene) -> None:
    scene.show("/runs")
    scene.until("#count", "3 runs")
    for name in ("day-0", "day-1"):
        scene.page.get_by_label(f"choose {name} to compare").check()
    scene.page.get_by_role("button", name="Compare").click()
    scene.until("#report iframe")
    scene.page.frame_locator("#report iframe").get_by_text("day-1").first.wait_for()
    assert scene.text("#report-title") == "Report beside day-1"
    scene.keep("compare")


def test_a_run_is_diagnosed_with_progress_or_cancelled(scene: Scene) -> None:
    scene.show("/runs/view?run=day-0")
    scene.until("#curve svg")
    scene.page.get_by_role("button", name="Diagnose").click()
    scene.until("#diagnosing .step")
    scene.page.get_by_role("button", name="Cancel").first.click()
    scene.until("#diagnosis .refusal", "the diagnosis was cancelled")
    scene.page.get_by_role("button", name="Diagnose").click()
    scene.until("#diagnosing .step", "of 6")
    scene.until("#diagnosis .headline")
    scene.page.frame_locator("#diagnosis iframe").locator("h1").first.wait_for()
    scene.keep("diagnosis")
    scene.page.get_by_role("button", name="Keep for the trend").click()
    scene.until("#message", "day-0.A.diagnosis.json")
    assert (scene.runs / "day-0.A.diagnosis.json").exists()


def test_a_trend_shows_all_runs_of_a_site(scene: Scene) -> None:
    scene.show("/runs/trend?site=A")
    scene.until("#moduli circle")
    assert scene.page.locator("#moduli > svg circle.line0").count() == 3
    assert "kPa per day" in scene.text("#slopes")
    scene.keep("trend")


def test_a_plan_is_edited_judged_rehearsed_and_started(scene: Scene) -> None:
    scene.show("/plan")
    scene.until("#standing .sound")
    scene.page.fill("#yaml", "sites: [{name: A}]\ndepths_m: [0.003]\nmode: static\nhold_s: 0.5\nrepeat: 3\n")
    scene.until("#standing .refusal", "plan.yaml, line 5: there is no key 'repeat' (did you mean 'repeats'?)")
    scene.keep("plan-refused")
    scene.page.fill("#yaml", "sites: [{name: A}]\ndepths_m: [0.003]\nmode: static\nhold_s: 0.5\n")
    scene.until("#standing .sound")
    scene.page.get_by_label("hold (s)").fill("0.4")
    scene.page.wait_for_function("() => document.getElementById('yaml').value.includes('hold_s: 0.4')")
    scene.page.get_by_label("press speed (m/s)").fill("1")
    scene.until("#standing .refusal", "press_speed_m_per_s is 1")
    assert scene.page.locator("[aria-invalid]").get_attribute("data-path") == "press_speed_m_per_s"
    scene.page.get_by_label("press speed (m/s)").fill("0.02")
    scene.until("#standing .sound")
    scene.until("#force svg")  # the rehearsal begins by itself
    assert "rehearsed on the simulated cell" in scene.text("#tiles")
    first = scene.text("#tiles .tile")
    scene.page.get_by_label("hold (s)").fill("2.4")
    scene.page.wait_for_function("() => document.getElementById('yaml').value.includes('hold_s: 2.4')")
    scene.page.get_by_role("button", name="Rehearse").click()
    scene.page.wait_for_selector("#rehearsal:not([data-old])")
    assert scene.text("#tiles .tile") != first
    scene.keep("plan")
    scene.page.get_by_role("button", name="Start this plan").click()
    scene.page.wait_for_url(f"{scene.address}/")
    started = [request for request in scene.service.requests if request["do"] == "start"]
    assert (started[-1]["plan"]["hold_s"], started[-1]["lease"]) == (2.4, "a-lease")


def test_resolve_is_a_conversation(scene: Scene) -> None:
    scene.service.refusal = "the daemon is not armed; arm it first (palpd arm)"
    scene.show("/resolve")
    scene.page.get_by_role("button", name="Begin").click()
    scene.until("#refusal .refusal", scene.service.refusal)
    scene.service.refusal = ""
    scene.page.fill("[name=depth]", "5")
    scene.page.get_by_role("button", name="Begin").click()
    scene.until("#gap", str(PROPOSAL["gap"]))
    begun = [request for request in scene.service.requests if request["do"] == "begin"][-1]
    assert begun["arguments"] == {"rounds": 4, "take_reference": False, "max_depth_m": 0.005}
    assert "7.9 N" in scene.text("#figures")
    assert "round-1.csv" in scene.text("#log")
    scene.keep("resolve")
    scene.page.get_by_role("button", name="Agree").click()
    scene.until("#sentence", "Resolved: tissue.viscoelastic.")
    assert [request["agree"] for request in scene.service.requests if request["do"] == "decide"] == [True]
    assert not scene.page.locator("#proposal").is_visible()
    scene.keep("resolve-done")
