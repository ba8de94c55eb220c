"""The tab Checks: the days since the baseline, each figure with its range, and a damaged file as a sentence."""

from dataclasses import replace
from pathlib import Path

from starlette.testclient import TestClient

from palpd.config import CheckTolerances
from palpd.history.check_days import Baseline, MorningCheck, keep_check
from palpd.history.control_charts import judged
from palpd.history.injections import Injection, keep_injection
from palpd.recording.second_channel import SealedAnswer
from tests.history.test_control_charts import changed, healthy
from tests.web.recorded_runs import browser, runs, simulated

__all__ = ["browser", "runs", "simulated"]


def test_the_charts_begin_at_the_baseline(browser: TestClient, runs: Path) -> None:
    assert browser.get("/checks/list").json()["checks"] == []
    days = [replace(day, date=f"2026-11-{number + 1:02d}T08:00:00+01:00") for number, day in enumerate(healthy(15))]
    days[-1] = changed(days[-1], play_m=3e-4)
    for number, (day, verdict) in enumerate(zip(days, judged(days, CheckTolerances()), strict=True)):
        baseline = Baseline("2026-11-22", "<b>new</b> mount") if number == 2 else None
        keep_check(runs / f"{number:03d}.mcap", MorningCheck(day, verdict, baseline=baseline))
    answer = browser.get("/checks/list").json()
    assert (len(answer["checks"]), answer["checks"][0]["baseline"]) == (13, "<b>new</b> mount")
    assert answer["checks"][-1]["level"] == "stop"
    play = next(figure for figure in answer["figures"] if figure["words"] == "the play")
    assert play["unit"] == "mm"
    assert play["changed"] == [False] * 12 + [True]
    assert play["values"][-1] > play["high"][-1]
    assert "Morning checks" in browser.get("/checks").text


def test_a_damaged_check_is_a_sentence(browser: TestClient, runs: Path) -> None:
    damaged = runs / "999.check.json"
    damaged.write_text("{}")
    answer = browser.get("/checks/list")
    damaged.unlink()
    assert answer.status_code == 400
    assert "999.check.json holds no check" in answer.json()["error"]


def test_the_injections_stand_below_the_checks_and_a_damaged_one_hides_no_check(browser: TestClient, runs: Path) -> None:
    assert browser.get("/checks/list").json()["injections"]["injections"] == 0
    planted = SealedAnswer("sensor.gain", {"error": 0.2}, "salt")
    kept = keep_injection(runs / "9-injection.mcap", Injection("2026-11-26", planted.seal, planted, "effects", ("sensor.gain",), 0.7))
    answer = browser.get("/checks/list").json()["injections"]
    assert [(limit["effect"], limit["named"]) for limit in answer["limits"]] == [("sensor.gain", 1)]
    assert "Planted was sensor.gain (error of the scale 20 %)" in answer["last"]
    kept.write_text("{}")
    answer = browser.get("/checks/list").json()
    kept.unlink()
    assert answer["checks"]
    assert "9-injection.injection.json holds no injection" in answer["injections"]["refusal"]
