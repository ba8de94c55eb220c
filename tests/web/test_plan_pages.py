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
        (
            SHORT.replace("0.003", "4"),
            "plan.yaml, line 2: depths_m.0: a depth of 4 m is outside 0.0002 to 0.02 m; depths are in metres (4 mm is 0.004)",
        ),
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


def test_a_refusal_names_every_key_that_is_wrong(browser: TestClient) -> None:
    wrong = SHORT.replace("0.003", "0.003, 4").replace("{name: A}", "{name: A}, {name: a b, x_m: 0.03}").replace("hold_s: 0.2", "hold_s: 0")
    answer = browser.post("/plan/check", json={"yaml": wrong}).json()
    assert set(answer["faults"]) == {"depths_m.1", "sites.1.name", "hold_s"}
    assert answer["faults"]["hold_s"] == "hold_s is 0; expected greater than or equal to 0.1"
    assert answer["error"].startswith("plan.yaml, line 1: sites.1.name is 'a b'"), "the sentence of the terminal is that of the first"
    assert answer["plan_schema"] == Plan.model_json_schema()
    assert "plan" not in answer
    assert browser.post("/plan/check", json={"yaml": "a: ["}).json()["faults"] == {}


def test_what_only_the_cell_does_not_allow_comes_back_with_the_plan_and_its_limits(browser: TestClient, runs: Path) -> None:
    config = runs.parent / "config.yaml"
    before, plan = config.read_text(), SHORT + "origin: {x_m: 0.0, y_m: 0.3}\n"
    config.write_text("safety: {max_speed_m_per_s: 0.01, workspace_m: [[-0.1, 0.1], [-0.1, 0.2], [-0.1, 0.4]]}\n")
    try:
        answer = browser.post("/plan/check", json={"yaml": plan}).json()
        slower = plan.replace("0.02", "0.01").replace("y_m: 0.3", "y_m: 0.15")
        sound = browser.post("/plan/check", json={"yaml": slower}).json()
    finally:
        config.write_text(before)
    assert set(answer["faults"]) == {"press_speed_m_per_s", "search.speed_m_per_s", "origin.y_m", "sites.0.y_m"}
    assert answer["plan"]["press_speed_m_per_s"] == 0.02
    assert sound["ok"], sound
    assert sound["limits"]["press_speed_m_per_s"] == [1e-4, 0.01, "safety.max_speed_m_per_s"]
    assert sound["limits"]["sites.0.y_m"] == [pytest.approx(-0.25), pytest.approx(0.05), "safety.workspace_m"]


def test_sites_whose_presses_overlap_are_questioned_and_the_plan_is_sound(browser: TestClient) -> None:
    answer = browser.post("/plan/check", json={"yaml": SHORT.replace("{name: A}", "{name: A}, {name: B, x_m: 0.004, y_m: 0.003}")}).json()
    sentence = "site B is 5 mm from site A, nearer than 10 mm (two tip radii): their presses overlap; is that meant?"
    assert (answer["ok"], answer["questions"], answer["apart_m"]) == (True, {"sites.1": sentence}, 0.01)


def test_a_rehearsal_is_known_by_the_configuration_of_the_check(browser: TestClient) -> None:
    end = ended(browser, browser.post("/plan/rehearse", json={"yaml": SHORT}).json())
    result = browser.get(f"/calculations/{end['number']}/result").json()["result"]
    checked = browser.post("/plan/check", json={"yaml": SHORT}).json()
    assert result["config_sha256"] == checked["config_sha256"]


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


def test_the_set_up_shows_the_steps_the_next_one_and_what_the_cell_confirms(browser: TestClient) -> None:
    answer = browser.get("/setup/rows").json()
    assert (answer["ok"], answer["steps"], answer["order"][0]) == (True, {}, "robot")
    assert set(answer["assumptions"].values()) == {"not tried"}
