"""The tab Plan: a plan is judged in the words of the terminal, with the place, and rehearsed on the cell of the configuration."""

from pathlib import Path

import pytest
from starlette.testclient import TestClient

from palpd.config import Plan, load_plan
from palpd.tick import Phase
from tests.paths import ROOT
from tests.web.recorded_runs import browser, ended, runs, simulated

__all__ = ["browser", "runs", "simulated"]

SHORT = "sites: [{name: A}]\ndepths_m: [0.003]\nmode: static\nhold_s: 0.2\npress_speed_m_per_s: 0.02\nsearch: {speed_m_per_s: 0.02}\n"


def test_a_sound_plan_comes_back_with_its_schema_and_how_far_a_force_would_run(browser: TestClient) -> None:
    plan = ROOT / "plan.yaml"
    answer = browser.post("/plan/check", json={"yaml": plan.read_text()}).json()
    assert answer["ok"], answer
    assert answer["plan"]["depths_m"] == list(load_plan(plan).depths_m)
    assert answer["plan_schema"] == Plan.model_json_schema()
    assert any(row["overshoot_N"] > 0.0 for row in answer["overshoot"])


@pytest.mark.parametrize(
    ("yaml", "sentence"),
    [
        ("", "plan.yaml: sites and depths_m are not given; a plan says where and how deep"),
        (SHORT.replace("0.003", "4"), "plan.yaml: a depth of 4 m is outside 0.0002 to 0.02 m; depths are in metres (4 mm is 0.004)"),
        (SHORT + "repeat: 3\n", "plan.yaml, line 7: there is no key 'repeat' (did you mean 'repeats'?); expected "),
        (SHORT + "depths_m: [0.004]\n", "plan.yaml, line 7: the key 'depths_m' stands here and in line 2, expected once"),
        (SHORT.replace("0.02\n", "0.051\n"), "plan.yaml, line 5: press_speed_m_per_s is 0.051; expected less than or equal to 0.05"),
        ("sites: [{name: <script>}]\ndepths_m: [0.003]\n", "plan.yaml, line 1: sites.0.name is '<script>'"),
    ],
)
def test_a_plan_that_is_wrong_is_refused_as_in_the_terminal(browser: TestClient, yaml: str, sentence: str) -> None:
    answer = browser.post("/plan/check", json={"yaml": yaml})
    assert answer.status_code == 400
    assert answer.json()["error"].startswith(sentence)


def test_a_plan_outside_the_workspace_is_refused(browser: TestClient, runs: Path) -> None:
    config = runs.parent / "config.yaml"
    before = config.read_text()
    config.write_text("safety: {workspace_m: [[-0.1, 0.1], [-0.1, 0.1], [-0.1, 0.4]]}\n")
    try:
        answer = browser.post("/plan/check", json={"yaml": SHORT + "origin: {x_m: 0.5, y_m: 0.0}\n"}).json()
        assert answer["error"].startswith("the plan's origin is at x = 0.5 m in the base's axes, but safety.workspace_m allows -0.1")
    finally:
        config.write_text(before)


def test_a_rehearsal_that_the_guard_stops_is_drawn_too(browser: TestClient, runs: Path) -> None:
    config = runs.parent / "config.yaml"
    before = config.read_text()
    config.write_text("safety: {contact_limit_N: 2.5}\n")
    fast = SHORT.replace("0.003", "0.003, 0.005").replace("static", "both") + "repeats: 1\nsafe_height_m: 0.005\n"
    try:
        end = ended(browser, browser.post("/plan/rehearse", json={"yaml": fast}).json())
        result = browser.get(f"/calculations/{end['number']}/result").json()["result"]
    finally:
        config.write_text(before)
    assert (end["state"], end["sentence"]) == ("stopped", result["reason"])
    assert result["verdict"] == "stopped"
    assert len(result["course"]["t_s"]) > 100


def test_a_rehearsal_gives_time_force_and_course(browser: TestClient) -> None:
    end = ended(browser, browser.post("/plan/rehearse", json={"yaml": SHORT}).json())
    assert end["state"] == "done", end
    assert end["step"].endswith("s of the plan")
    result = browser.get(f"/calculations/{end['number']}/result").json()["result"]
    assert 5.0 < result["duration_s"] < 60.0
    assert 1.0 < result["peak_force_N"] < 12.0
    course = result["course"]  # at this speed the search runs deeper than the press that follows
    held_m = [depth_m for phase, depth_m in zip(course["phase"], course["depth_high_m"], strict=True) if phase == Phase.HOLD]
    assert max(held_m) == pytest.approx(0.003, abs=1e-4)
