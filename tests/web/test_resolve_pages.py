"""The tab Resolve: the requests of the conversation reach the service, and a proposed motion is drawn from the files of its job."""

from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from starlette.testclient import TestClient

from palpd.web.application import build
from palpd.web.page import PageSettings
from palpd.web.sessions import Sessions
from tests.paths import ROOT
from tests.web.fake_resolve import ID, PLAN, PROPOSAL, FakeResolve
from tests.web.recorded_runs import ORIGIN, TOKEN, ended


@pytest.fixture
def service(tmp_path: Path) -> Iterator[FakeResolve]:
    fake = FakeResolve(tmp_path / "palpd.sock")
    yield fake
    fake.close()


@pytest.fixture
def browser(service: FakeResolve, tmp_path: Path) -> Iterator[TestClient]:
    settings = PageSettings(tmp_path / "palpd.sock", tmp_path / "runs", config=ROOT / "config.yaml")
    with TestClient(build(settings, Sessions(TOKEN)), base_url=ORIGIN, client=("127.0.0.1", 40000), headers={"origin": ORIGIN}) as client:
        page = client.get("/", params={"token": TOKEN}).text
        client.headers["x-palpd-csrf"] = page.split('name="palpd-csrf" content="')[1].split('"')[0]
        yield client


def test_a_conversation_reaches_the_service_and_comes_back_unchanged(browser: TestClient, service: FakeResolve) -> None:
    wishes = {"rounds": 4, "take_reference": False}
    begun = browser.post("/do/begin", json={"program": "resolve", "arguments": wishes, "lease": "a-lease"}).json()
    assert begun["id"] == ID
    assert service.requests[-1] == {"do": "begin", "program": "resolve", "arguments": wishes, "lease": "a-lease"}
    assert browser.post("/do/job", json={"id": ID}).json()["proposal"] == PROPOSAL
    browser.post("/do/decide", json={"id": ID, "number": 1, "agree": True, "lease": "a-lease"})
    assert browser.post("/do/job", json={"id": ID}).json()["reason"] == "Resolved: tissue.viscoelastic."


def test_a_proposed_motion_is_drawn_with_the_plan_of_its_job(browser: TestClient, service: FakeResolve, tmp_path: Path) -> None:
    browser.post("/do/begin", json={"program": "resolve", "arguments": {}})
    answer = browser.post("/resolve/rehearse", json={"id": ID}).json()
    assert answer["error"].endswith("plan-2.yaml cannot be read here, so the motion is not drawn; its figures stand above")
    folder = tmp_path / "runs" / ID
    folder.mkdir(parents=True)
    (folder / "plan-2.yaml").write_text(yaml.safe_dump(PLAN))
    end = ended(browser, browser.post("/resolve/rehearse", json={"id": ID}).json())
    assert end["state"] == "done", end
    assert browser.get(f"/calculations/{end['number']}/result").json()["result"]["peak_force_N"] > 1.0
    (folder / "gap.html").write_text("<p>the gap</p>")
    assert "the gap" in browser.get("/resolve/report", params={"id": ID}).text


def test_what_the_service_does_not_know_is_refused_in_its_words(browser: TestClient, tmp_path: Path) -> None:
    (tmp_path / "gap.html").write_text("outside")
    for name in ("..", "/etc", "", "x"):
        answer = browser.get("/resolve/report", params={"id": name}).json()
        assert answer["error"] == f"there is no job {name!r}; palpd jobs lists them"
    assert browser.post("/resolve/rehearse", json={"id": ".."}).json()["ok"] is False
