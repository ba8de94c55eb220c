"""A set-up in the page: one at a time, each question answered once, and a child that is a real `palpd setup` before an empty folder."""

import io
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from palpd.cli.setup_talk import TalkOperator
from palpd.daemon.setup.cell import NoOperator
from palpd.web.application import build
from palpd.web.page import PageSettings
from palpd.web.sessions import Sessions
from tests.web.conftest import ORIGIN, TOKEN

FIRST = "The arm stands. What now?"
STARTED_S = 60.0


@pytest.fixture
def page(tmp_path: Path) -> Iterator[TestClient]:
    """A browser before the page of an empty folder; the token opens it at the tab Set-up."""
    folder = tmp_path / "cell"
    settings = PageSettings(tmp_path / "absent.sock", tmp_path, config=folder / "config.yaml", setup=folder)
    with TestClient(build(settings, Sessions(TOKEN)), base_url=ORIGIN, client=("127.0.0.1", 40000), headers={"origin": ORIGIN}) as client:
        opened = client.get("/", params={"token": TOKEN})
        assert opened.url.path == "/setup"
        client.headers["x-palpd-csrf"] = opened.text.split('name="palpd-csrf" content="')[1].split('"')[0]
        yield client


def talked(page: TestClient, asked: bool) -> dict[str, Any]:
    """The talk, once a question is open, or once it is over."""
    until_s = time.monotonic() + STARTED_S
    while time.monotonic() < until_s:
        talk: dict[str, Any] = page.get("/setup/talk?after=0").json()
        if (talk["asked"] is not None) if asked else not talk["under_way"]:
            return talk
        time.sleep(0.05)
    raise AssertionError(f"the set-up does not go on: {talk}")


def test_a_question_is_answered_once_and_a_second_set_up_is_refused(page: TestClient, tmp_path: Path) -> None:
    assert "Begin in the tab Set-up" in page.get("/setup/rows").json()["error"]
    assert page.post("/setup/begin", json={}).json()["under_way"]
    assert "under way already" in page.post("/setup/begin", json={}).json()["error"]
    talk = talked(page, asked=True)
    question = talk["said"][talk["asked"]]
    assert (question["ask"], question["answers"], question["moves"]) == (FIRST, ["go", "skip", "stop"], "")
    elsewhere = subprocess.run(
        [sys.executable, "-m", "palpd", "setup", str(tmp_path / "cell")], capture_output=True, text=True, check=False
    )
    assert (elsewhere.returncode, "another palpd setup of" in elsewhere.stderr) == (2, True), elsewhere.stderr
    answer = {"number": talk["asked"], "question": FIRST, "answer": "skip"}
    for stale in ({"number": talk["asked"] - 1}, {"question": "The arm will move. What now?"}, {"number": 99}):
        refused = page.post("/setup/answer", json=answer | stale)
        assert (refused.status_code, "is not asked any more" in refused.json()["error"]) == (400, True)
    assert page.post("/setup/answer", json=answer).json()["ok"]
    assert "is not asked any more" in page.post("/setup/answer", json=answer).json()["error"], "a double click"
    talk = talked(page, asked=True)
    assert {"answered": "skip"} in talk["said"]
    assert page.post("/setup/answer", json={"number": talk["asked"], "question": talk["said"][-1]["ask"], "answer": "stop"}).json()["ok"]
    assert talked(page, asked=False)["said"][-1] == {"ended": 0}
    kept = json.loads((tmp_path / "cell" / "state" / "commission.json").read_text())["steps"]
    assert kept["robot"]["verdict"] == "skipped"


def test_an_abort_ends_a_set_up_that_waits_and_a_step_that_does_not_exist_is_a_sentence(page: TestClient) -> None:
    page.post("/setup/begin", json={"redo": "$(reboot)"})
    assert "'$(reboot)' is no step of palpd setup" in str(talked(page, asked=False)["said"])
    page.post("/setup/begin", json={})
    talked(page, asked=True)
    assert page.post("/abort").json() == {"ok": True, "state": "the set-up has ended"}
    assert "interrupted by SIGTERM" in str(talked(page, asked=False)["said"])
    assert not page.post("/abort").json()["ok"], "nobody is there to abort"


def test_the_routes_stand_behind_token_and_mark(page: TestClient) -> None:
    paths = ("/setup/begin", "/setup/answer")
    del page.headers["x-palpd-csrf"]
    assert [page.post(path, json={}).status_code for path in paths] == [403] * 2
    page.cookies.clear()
    assert [page.post(path, json={}).status_code for path in paths] == [401] * 2
    assert page.get("/setup/talk?after=0").status_code == 401


def test_the_operator_of_the_talk_asks_again_and_ends_with_its_input(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO('{"answer": ""}\n{"answer": "go"}\n{"answer": ""}\n'))
    operator = TalkOperator()
    assert operator.choose("The arm will move. What now?", ("stop", "go"), "go") == "go"
    assert operator.ask("Weight in N", "5") == "5"
    with pytest.raises(NoOperator, match="a question has no answer"):
        operator.ask("Mass")
    written = [json.loads(line) for line in capsys.readouterr().out.splitlines() if line]
    assert written[0] == {"ask": "The arm will move. What now?", "usual": "stop", "answers": ["stop", "go"], "moves": "go"}
    assert written[1] == {"say": "'' is none of stop, go."}
