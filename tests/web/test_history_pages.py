"""The tab Runs: what the terminal says, in the same words; runs are addressed by names of the catalogue, and hostile ones are only text."""

import json
import os
import shutil
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from palpd.history.remarks import remark
from palpd.web.looking_back import key_of, recording_of
from tests.web.recorded_runs import browser, ended, runs, simulated

__all__ = ["browser", "runs", "simulated"]

HOSTILE = "<img src=x onerror=alert(1)>'\"&..%2F"


def listed(browser: TestClient, **query: str) -> list[str]:
    answer = browser.get("/runs/list", params=query).json()
    assert answer["ok"], answer
    return [run["name"] for run in answer["runs"]]


def refusal(answer: Any) -> str:
    assert answer.status_code == 400, answer.text
    content = answer.json()
    assert not content["ok"]
    assert "\n" not in content["error"]
    return str(content["error"])


def test_runs_are_listed_and_filtered_as_palpd_runs_does(browser: TestClient, runs: Path) -> None:
    assert listed(browser) == ["day-2", "day-1", "day-0"]
    assert listed(browser, verdict="stopped") == ["day-2"]
    assert listed(browser, site="A", until="2026-09-21") == ["day-0"]
    assert listed(browser, text="SIM00001", most="1") == ["day-2"]
    remark(runs / "day-1.mcap", "2026-11-22T10:15:00+00:00", tags=["wet"], note="<b>Probe</b> 7")
    answer = browser.get("/runs/list", params={"tag": "wet"}).json()
    assert (answer["count"], answer["tags"], answer["runs"][0]["note"]) == (1, ["wet"], "<b>Probe</b> 7")
    assert refusal(browser.get("/runs/list", params={"since": "yesterday"})).startswith("the day is 'yesterday', expected year")


def test_a_recording_that_was_cut_off_is_listed_whatever_the_filter(browser: TestClient, runs: Path) -> None:
    (runs / "killed.part").write_bytes(b"x")
    answer = browser.get("/runs/list", params={"verdict": "stopped"}).json()
    (runs / "killed.part").unlink()
    assert answer["unfinished"] == ["killed"]
    assert browser.get("/runs/list").json()["unfinished"] == []


def test_a_damaged_catalogue_is_made_anew_and_the_list_says_so(browser: TestClient, runs: Path) -> None:
    (runs / "catalogue.sqlite").write_bytes(b"no catalogue at all")
    answer = browser.get("/runs/list").json()
    assert answer["count"] == 3
    assert "was damaged or of another version; it was made anew from 3 recordings" in answer["notes"][0]


def test_a_trend_is_that_of_the_terminal(browser: TestClient) -> None:
    answer = browser.get("/runs/trend-of", params={"site": "A"}).json()
    assert len(answer["runs"]) == 3
    assert answer["slopes"]["static"]["points"] >= 3
    assert refusal(browser.get("/runs/trend-of", params={"site": "Z"})).endswith("of a site 'Z'; palpd runs lists the sites")


def test_a_run_is_read_and_its_course_comes_in_bounded_pieces(browser: TestClient) -> None:
    end = ended(browser, browser.post("/runs/read", json={"run": "day-1"}).json())
    assert end["state"] == "done", end
    facts = browser.get(f"/calculations/{end['number']}/result").json()["result"]
    assert facts["headline"] == "Done: 3 presses at 1 site, 1 depth cut short."
    course = f"/calculations/{end['number']}/course"
    whole = browser.get(course, params={"begin_s": 0, "end_s": 1e9}).json()
    assert len(whole["columns"]["t_s"]) <= 1500
    assert max(whole["columns"]["force_high_N"]) == pytest.approx(facts["peak_force_N"], rel=1e-5)
    part = browser.get(course, params={"begin_s": 2.0, "end_s": 3.0}).json()["columns"]
    assert 2.0 <= part["t_s"][0] <= part["t_s"][-1] <= 3.0
    assert refusal(browser.get(course, params={"begin_s": "nan", "end_s": 3.0})) == "begin_s is 'nan', expected a number"
    again = browser.post("/runs/read", json={"run": "day-1"}).json()
    assert again["number"] == end["number"], "what was read is not read again"


def test_a_report_is_framed_without_scripts_and_one_beside_another_run_too(browser: TestClient, runs: Path) -> None:
    end = ended(browser, browser.post("/runs/make-report", json={"run": "day-0", "beside": "day-1"}).json())
    assert end["state"] == "done", end
    page = browser.get(f"/calculations/{end['number']}/report")
    assert "default-src 'none'" in page.headers["content-security-policy"]
    assert "script" not in page.headers["content-security-policy"]
    assert page.headers["x-frame-options"] == "SAMEORIGIN"
    assert "day-1" in page.text
    around = browser.get("/runs/view", params={"run": "day-0"}).headers["content-security-policy"]
    assert "frame-src 'self'; " in around
    assert "script-src 'self'; " in around
    (runs / "day-0.report.html").write_text("<p>as it stands beside the recording</p>")
    assert browser.post("/runs/make-report", json={"run": "day-0"}).json()["report"] == "/runs/report?run=day-0"
    assert "as it stands" in browser.get("/runs/report", params={"run": "day-0"}).text
    download = browser.get("/runs/report", params={"run": "day-0", "download": ""})
    assert download.headers["content-disposition"] == 'attachment; filename="day-0.report.html"'
    os.utime(runs / "day-0.report.html", ns=(1, 1))
    older = browser.post("/runs/make-report", json={"run": "day-0"}).json()
    assert older["name"] == "writing the report", "one that is older than the recording is written again"
    browser.post(f"/calculations/{older['number']}/cancel")


def test_a_recording_is_downloaded_byte_for_byte(browser: TestClient, runs: Path) -> None:
    answer = browser.get("/runs/recording", params={"run": "day-2"})
    assert answer.content == (runs / "day-2.mcap").read_bytes()
    assert answer.headers["content-disposition"] == 'attachment; filename="day-2.mcap"'


@pytest.mark.parametrize(
    "run", ["nothing", "../runs/day-0", "/etc/passwd", "day-0/../day-0", "day-0\0", "%00", "..%2Fday-0", HOSTILE, "day", "x" * 1900]
)
def test_what_is_no_name_of_the_listing_reaches_no_file(browser: TestClient, runs: Path, run: str) -> None:
    for sentence in (
        refusal(browser.post("/runs/read", json={"run": run})),
        refusal(browser.post("/runs/make-report", json={"run": run})),
        refusal(browser.post("/runs/diagnose", json={"run": run, "site": "A"})),
        refusal(browser.get("/runs/recording", params={"run": run})),
        refusal(browser.get("/runs/report", params={"run": run})),
    ):
        assert sentence.startswith(f"no recording in {runs} is called ")


def test_a_recording_that_is_deleted_under_its_report_is_one_sentence(browser: TestClient, runs: Path) -> None:
    shutil.copy(runs / "day-0.mcap", runs / "gone.mcap")
    (runs / "gone.report.html").write_text("<p>report</p>")
    assert browser.get("/runs/report", params={"run": "gone"}).status_code == 200
    (runs / "gone.mcap").unlink()
    assert refusal(browser.get("/runs/report", params={"run": "gone"})) == f"no recording in {runs} is called 'gone'; palpd runs lists them"


def test_a_hostile_name_is_listed_addressed_and_downloaded_as_text(browser: TestClient, runs: Path) -> None:
    name = os.fsdecode(b"\xff<script>alert(1)</script>".replace(b"/", b""))
    (runs / f"{name}.mcap").write_bytes(b"no recording")
    try:
        answer = browser.get("/runs/list", params={"text": "<script>"}).json()
        assert [run["name"] for run in answer["runs"]] == [name]
        assert answer["runs"][0]["verdict"] == "unreadable"
        key = answer["runs"][0]["key"]
        assert recording_of(runs, key).name == f"{name}.mcap"
        download = browser.get("/runs/recording", params={"run": key})
        assert download.headers["content-disposition"] == 'attachment; filename="__script_alert_1__script_.mcap"'
        end = ended(browser, browser.post("/runs/read", json={"run": key}).json())
        assert end["state"] == "refused"
        assert "is not an MCAP file" in end["sentence"]
    finally:
        (runs / f"{name}.mcap").unlink()


def test_a_key_of_any_name_leads_back_to_it(tmp_path: Path) -> None:
    for name in ("plain", "demo/run", "100%", "a b", "ä", HOSTILE, "last", os.fsdecode(b"\xfe\xff")):
        path = tmp_path / f"{name}.mcap"
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"")
        assert recording_of(tmp_path, key_of(name)) == path, name
    assert key_of("demo/run") == "demo/run"


def test_remarks_are_kept_beside_the_recording_or_refused_in_the_words_of_the_terminal(browser: TestClient, runs: Path) -> None:
    answer = browser.post("/runs/remark", json={"run": "day-2", "tag": "dry", "note": "new tip"}).json()
    assert answer["remarks"]["tags"] == ["dry"]
    assert json.loads((runs / "day-2.remarks.json").read_text())["notes"][0]["text"] == "new tip"
    assert refusal(browser.post("/runs/remark", json={"run": "day-2", "tag": "two words"})).startswith("the tag is 'two words', expected")
    assert refusal(browser.post("/runs/remark", json={"run": "day-2", "note": 7})) == "note is no text of at most 2000 letters; correct it"
    assert browser.post("/runs/remark", json={"run": "day-2", "untag": "dry"}).json()["remarks"]["tags"] == []


def test_a_diagnosis_of_what_is_no_site_is_refused_and_one_that_is_cancelled_says_so(browser: TestClient) -> None:
    end = ended(browser, browser.post("/runs/diagnose", json={"run": "day-0", "site": "--help"}).json())
    assert end["state"] == "refused"
    assert "has no site --help; it has A" in end["sentence"]
    begun = browser.post("/runs/diagnose", json={"run": "day-0", "site": "A"}).json()
    assert browser.post("/runs/keep", json={"run": "day-0", "number": begun["number"]}).status_code == 400
    assert browser.post(f"/calculations/{begun['number']}/cancel").json()["state"] == "cancelled"
    assert refusal(browser.get(f"/calculations/{begun['number']}/result")) == "the diagnosis was cancelled"
    assert refusal(browser.post("/runs/keep", json={"run": "day-1", "number": begun["number"]})).endswith("diagnose it again")
    assert refusal(browser.get("/calculations/x%27")) == '"x\'" is no number of a calculation; begin it again'


def test_none_of_it_is_open_without_the_token(browser: TestClient) -> None:
    stranger = TestClient(browser.app, base_url=str(browser.base_url), client=("127.0.0.1", 40001))
    for path in ("/runs/list", "/runs/view", "/runs/recording?run=day-0", "/calculations/1", "/calculations/1/report"):
        assert stranger.get(path).status_code == 401
    forged = {"x-palpd-csrf": "forged"}
    assert browser.post("/runs/diagnose", json={"run": "day-0"}, headers=forged).status_code == 403
