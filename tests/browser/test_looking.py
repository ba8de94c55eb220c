"""The tabs Runs, Plan and Resolve in a real browser: order and content. PALPD_SCREENSHOTS, where it is set, gets pictures of each."""

import os
import re
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

from palpd.config import parse_plan
from palpd.history.remarks import remark
from palpd.testing.processes import free_port
from tests.browser.waiting import nothing_for_axe
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
    scene.until("#standing .sound")
    scene.until("#force svg")  # the rehearsal begins by itself
    assert "rehearsed on the simulated cell" in scene.text("#tiles")
    scene.until("#standing .sound", "No press is cut short on the simulated cell of config.yaml, which is not the tissue under the probe.")
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


TYPED = """yaml => {
  document.getElementById("standing").replaceChildren(); // what is there next is of this plan; "checking" may be gone before anybody looks
  const text = document.getElementById("yaml");
  text.value = yaml;
  text.dispatchEvent(new Event("input", { bubbles: true }));
}"""


def plan_shown(scene: Scene, yaml: str) -> None:
    """Show the tab with that plan, as its text, and wait until the form has it."""
    scene.show("/plan")
    scene.until("#standing .sound, #standing .warned, #standing .refusal")  # of the plan that the test before has left
    scene.page.evaluate(TYPED, yaml)
    scene.until("#standing .sound, #standing .warned")


def field(scene: Scene, path: str) -> Any:
    """The input of a key."""
    return scene.page.locator(f'[data-path="{path}"]')


def beside(scene: Scene, path: str) -> str:
    """What a screen reader says of a field besides its name: all that stands beside it."""
    described = field(scene, path).get_attribute("aria-describedby")
    return str(scene.page.locator(f'[id="{described}"]').inner_text())


def test_the_form_speaks_millimetres_and_changes_no_number_that_nobody_touched(scene: Scene) -> None:
    exact = "0.0123456789012345"
    plan_shown(
        scene, f"sites: [{{name: A, x_m: {exact}}}]\ndepths_m: [0.0041234567891, 0.006]\nmode: static\nsearch: {{speed_m_per_s: 0.0033}}\n"
    )
    shown = {path: field(scene, path).input_value() for path in ("sites.0.x_m", "depths_m", "search.speed_m_per_s", "hold_s")}
    assert shown == {"sites.0.x_m": "12.3456789012345", "depths_m": "4.1234567891, 6", "search.speed_m_per_s": "3.3", "hold_s": "3"}
    assert scene.page.get_by_label("press speed (mm/s)").input_value() == "10"
    field(scene, "depths_m").fill("4.1234567891, 7.1")
    field(scene, "press_speed_m_per_s").fill("11.1")
    scene.page.wait_for_function("() => document.getElementById('yaml').value.includes('press_speed_m_per_s: 0.0111\\n')")
    text = scene.page.input_value("#yaml")
    for line in (f"x_m: {exact},", "depths_m: [0.0041234567891, 0.0071]", "speed_m_per_s: 0.0033", "hold_s: 3\n"):
        assert line in text
    field(scene, "depths_m").fill("4,5")  # one depth as many languages write it, which was taken for two
    scene.until("#standing .refusal", "One value is not possible; what is wrong stands beside the field.")
    assert "4,5" in beside(scene, "depths_m")
    assert scene.page.get_by_role("button", name="Start this plan").is_disabled()


def test_what_is_wrong_stands_beside_its_field_in_its_unit_and_above_stands_what_has_none(scene: Scene) -> None:
    plan_shown(scene, "sites: [{name: A}, {name: B, x_m: 0.03}]\ndepths_m: [0.004]\nmode: static\n")
    assert beside(scene, "press_speed_m_per_s").startswith("0.1 to 50 mm/s\na force runs 4.1 N past its limit on 5000 N/m")
    field(scene, "press_speed_m_per_s").fill("60")
    field(scene, "depths_m").fill("4, 80")
    field(scene, "sites.1.name").fill("a b")
    scene.until("#standing .refusal", "3 values are not possible; what is wrong stands beside the field.")
    assert beside(scene, "press_speed_m_per_s") == "60 mm/s: expected 0.1 to 50 mm/s"
    assert beside(scene, "depths_m") == "80 mm: expected 0.2 to 20 mm"
    assert beside(scene, "sites.1.name").startswith("sites.1.name is 'a b'")
    assert {each.get_attribute("data-path") for each in scene.page.locator("[aria-invalid]").all()} == {
        "press_speed_m_per_s", "depths_m", "sites.1.name",
    }  # fmt: skip
    assert scene.page.locator("main [role=alert]").count() == 1
    assert scene.page.get_by_role("button", name="Start this plan").is_disabled()
    scene.keep("plan-wrong")
    nothing_for_axe(scene.page)
    field(scene, "press_speed_m_per_s").fill("10")
    field(scene, "depths_m").fill("4")
    field(scene, "sites.1.name").fill("A")
    scene.until("#standing .refusal", "site names must differ, found A, A")
    assert scene.page.locator("[aria-invalid]").count() == 0


def test_a_press_that_would_be_cut_short_is_named_beside_its_depth_and_its_site_and_the_start_says_so(scene: Scene) -> None:
    plan_shown(scene, "sites: [{name: A}, {name: B, x_m: 0.03}]\ndepths_m: [0.003, 0.015]\nmode: static\nhold_s: 0.3\n")
    scene.until("#standing .warned", "2 of 4 presses would be cut short at 10.8 N on the simulated cell of config.yaml")
    assert re.search(r"15 mm: cut short at 1[01]\.\d( to 1[01]\.\d)? mm, 10\.8 N \(A, B\)", beside(scene, "depths_m"))
    assert beside(scene, "depths_m").count("cut short") == 1, "the press to 3 mm is none of them"
    assert re.fullmatch(r"15 mm: cut short at 1[01]\.\d mm, 10\.8 N", beside(scene, "sites.1.x_m"))
    start = scene.page.get_by_role("button", name="Start, though 2 presses would be cut short")
    assert "main" not in (start.get_attribute("class") or "")
    scene.keep("plan-cut-short")
    nothing_for_axe(scene.page)
    field(scene, "depths_m").fill("3")
    scene.until("#standing .sound", "No press is cut short")
    assert "cut short" not in beside(scene, "sites.1.x_m")
    assert "main" in (scene.page.get_by_role("button", name="Start this plan").get_attribute("class") or "")
    field(scene, "depths_m").fill("3, 15")
    scene.until("#standing .warned")
    start.click()
    scene.page.wait_for_url(f"{scene.address}/")
    assert [request for request in scene.service.requests if request["do"] == "start"][-1]["plan"]["depths_m"] == [0.003, 0.015]


@pytest.mark.parametrize(
    ("x_mm", "y_mm", "place"),
    [
        ((0,), (0,), ("20", "0")),
        ((0, 30), (0, 0), ("60", "0")),
        ((0, 12.5), (0, -12.5), ("25", "-25")),
        ((0, 40, 20), (0, 0, 0), ("-20", "0")),
        ((7, 7), (3, 3), ("27", "3")),
        ((460, 490), (0, 0), ("490", "20")),
    ],
)
def test_a_new_site_goes_on_with_the_last_two_and_falls_on_no_other(
    scene: Scene, x_mm: tuple[float, ...], y_mm: tuple[float, ...], place: tuple[str, str]
) -> None:
    sites = ", ".join(f"{{name: S{k}, x_m: {x / 1e3}, y_m: {y / 1e3}}}" for k, (x, y) in enumerate(zip(x_mm, y_mm, strict=True)))
    plan_shown(scene, f"sites: [{sites}]\ndepths_m: [0.004]\n")
    scene.page.get_by_role("button", name="Add a site").click()
    new = len(x_mm)
    assert (field(scene, f"sites.{new}.x_m").input_value(), field(scene, f"sites.{new}.y_m").input_value()) == place
    assert scene.page.locator("#places circle").count() == new + 1


def test_sites_that_overlap_are_questioned_beside_the_second(scene: Scene) -> None:
    plan_shown(scene, "sites: [{name: A}, {name: B, x_m: 0.03}]\ndepths_m: [0.004]\n")
    field(scene, "sites.1.x_m").fill("4")
    scene.until('[id="about-sites.1"] .question', "site B is 4 mm from site A, nearer than 10 mm (two tip radii)")
    assert beside(scene, "sites.0.x_m") == ""
    assert scene.page.get_by_role("img", name="the sites from above: A at x 0, y 0 mm; B at x 4, y 0 mm").is_visible()


def test_a_plan_is_kept_with_its_rehearsal_chosen_on_another_day_and_started(scene: Scene) -> None:
    plan_shown(scene, "sites: [{name: A}]\ndepths_m: [0.003, 0.015]\nmode: static\nhold_s: 0.35\n")
    scene.until("#standing .warned")
    scene.page.fill("#kept-name", "../phantom")
    scene.page.get_by_role("button", name="Keep this plan").click()
    scene.until("#kept-refusal .refusal", "'../phantom' is no name of a plan")
    scene.page.fill("#kept-name", "phantom-3")
    scene.page.get_by_role("button", name="Keep this plan").click()
    scene.until("#kept li[aria-current]", "1 of 2 presses cut short")
    plan_shown(scene, "sites: [{name: A}]\ndepths_m: [0.002]\nmode: static\nhold_s: 0.3\n")
    scene.until("#kept-state", "changed since it was kept")
    scene.page.evaluate("sessionStorage.clear()")  # another day
    scene.show("/plan")
    assert "phantom-3" not in scene.page.input_value("#kept-name")
    scene.page.get_by_role("button", name="Choose: phantom-3").click()
    scene.page.wait_for_function("() => document.querySelector('[data-path=depths_m]')?.value === '3, 15'")
    scene.until("#standing .warned", "1 of 2 presses would be cut short")
    scene.keep("plan-kept")
    nothing_for_axe(scene.page)
    scene.page.get_by_role("button", name="Start, though 1 press would be cut short").click()
    scene.page.wait_for_url(f"{scene.address}/")
    started = [request for request in scene.service.requests if request["do"] == "start"][-1]
    assert (started["plan"]["depths_m"], started["plan"]["hold_s"]) == ([0.003, 0.015], 0.35)
    assert scene.text("#plan-name") == "phantom-3"


def test_a_kept_plan_that_another_operator_has_changed_is_replaced_on_purpose_only(scene: Scene) -> None:
    mine, theirs = ({"sites": [{"name": "A"}], "depths_m": [depth_m], "mode": "static", "hold_s": 0.3} for depth_m in (0.003, 0.004))
    before = scene.service.plans.keep({"do": "keep-plan", "name": "shared"}, parse_plan(mine, "it"), "anna")["plans"][0]
    scene.show("/plan")
    scene.page.get_by_role("button", name="Choose: shared").click()
    scene.page.wait_for_function("() => document.querySelector('[data-path=depths_m]')?.value === '3'")
    scene.service.plans.keep({"do": "keep-plan", "name": "shared", "was": before["sha256"]}, parse_plan(theirs, "it"), "bert")
    field(scene, "depths_m").fill("2.5")
    scene.until("#standing .sound")
    scene.page.get_by_role("button", name="Keep this plan").click()
    scene.until("#kept-refusal .refusal", "the plan shared was changed meanwhile (by bert")
    scene.until("#kept li[aria-current]", "It was changed since you chose it.")
    assert "depths_m: [0.004]" in str(scene.service.plans.answer({"do": "plans", "name": "shared"})["yaml"])
    scene.page.get_by_role("button", name="Replace shared").click()
    scene.page.wait_for_function("() => document.getElementById('kept-refusal').textContent === ''")
    assert "depths_m: [0.0025]" in str(scene.service.plans.answer({"do": "plans", "name": "shared"})["yaml"])
    for _ in range(2):  # the first press only asks
        assert [plan["name"] for plan in scene.service.plans.all() if plan["name"] == "shared"]
        scene.page.get_by_role("button", name="Forget shared").click()
    scene.page.locator("#kept li", has_text="shared").wait_for(state="detached")
    assert not [plan for plan in scene.service.plans.all() if plan["name"] == "shared"]


def test_a_rehearsal_with_another_configuration_counts_no_more_until_the_plan_is_chosen(scene: Scene) -> None:
    plan = parse_plan({"sites": [{"name": "A"}], "depths_m": [0.003], "mode": "static", "hold_s": 0.45}, "it")
    figures = {"verdict": "done", "duration_s": 9.9, "peak_force_N": 1.1, "presses": 1, "cut_short": 0, "config_sha256": "0f" * 32}
    scene.service.plans.keep({"do": "keep-plan", "name": "old", "rehearsal": figures}, plan, "anna")
    scene.show("/plan")
    scene.until("#kept li", "config.yaml has changed since the rehearsal")
    scene.page.get_by_role("button", name="Choose: old").click()
    scene.until("#kept li[aria-current] .chip.done", "no press cut short")
    kept = next(plan for plan in scene.service.plans.all() if plan["name"] == "old")
    assert kept["rehearsal"]["config_sha256"] != figures["config_sha256"]  # type: ignore[index]


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
