"""Requests go through unchanged, refusals come back in the service's own words, and many aborts are few."""

import asyncio
import time
from pathlib import Path

from palpd.web.service_link import ServiceLink
from tests.web.conftest import Browser
from tests.web.fake_service import FakeService

PLAN = "sites: [{name: A}]\ndepths_m: [0.004]\n"


def test_a_refusal_of_the_service_comes_back_word_by_word(browser: Browser, service: FakeService) -> None:
    sentence = "anna holds the controls; wait until they are free, or free them by force (palpd controls --free)"
    service.answers["start"] = {"ok": False, "error": sentence}
    answer = browser().post("/do/start", json={"text": PLAN, "file": "plan.yaml", "lease": "1"}).json()
    assert answer == {"ok": False, "error": sentence}
    assert service.asked("start") == [{"do": "start", "lease": "1", "plan": {"sites": [{"name": "A"}], "depths_m": [0.004]}}]


def test_a_plan_that_is_no_yaml_is_refused_with_its_line_and_reaches_nobody(browser: Browser, service: FakeService) -> None:
    twice = browser().post("/do/start", json={"text": PLAN + "depths_m: [0.005]\n", "file": "mine.yaml"}).json()
    assert not twice["ok"]
    assert twice["error"].startswith("mine.yaml, line 3: ")
    assert not browser().post("/do/start", json={"text": "[1, 2]", "file": "list.yaml"}).json()["ok"]
    assert service.asked("start") == []


def test_a_plan_to_keep_is_read_as_one_to_start_and_goes_on_with_what_the_page_has_seen(browser: Browser, service: FakeService) -> None:
    figures = {"verdict": "done"}
    content = {"name": "morning", "text": PLAN, "was": "0f", "rehearsal": figures, "lease": "1", "path": "/etc/passwd"}
    assert browser().post("/do/keep-plan", json=content).json()["ok"]
    plan = {"sites": [{"name": "A"}], "depths_m": [0.004]}
    assert service.asked("keep-plan") == [
        {"do": "keep-plan", "lease": "1", "name": "morning", "plan": plan, "was": "0f", "rehearsal": figures}
    ]
    assert not browser().post("/do/keep-plan", json={**content, "text": "a: ["}).json()["ok"]
    assert len(service.asked("keep-plan")) == 1


def test_only_requests_of_the_page_go_through_with_their_own_keys(browser: Browser, service: FakeService) -> None:
    client = browser()
    assert client.post("/do/watch").status_code == 404
    assert client.post("/do/renew", json={"lease": "1", "force": True, "plan": {}}).json()["ok"]
    assert service.asked("renew") == [{"do": "renew", "lease": "1"}]
    assert client.post("/do/renew", content=b"[1]").status_code == 400
    assert client.post("/do/renew", content=b"{" * 5000).status_code == 400


def test_an_abort_that_reaches_no_service_points_at_the_emergency_stop(browser: Browser, service: FakeService) -> None:
    client = browser()
    service.close()
    error = client.post("/abort").json()["error"]
    assert error == f"no daemon answers at {service.path}, so nothing was stopped; if the arm moves, use the emergency stop"
    answer = client.post("/do/arm").json()
    assert answer["error"] == f"no daemon answers at {service.path}; start one with palpd serve, or name its socket with --socket"
    assert answer["unreached"], "a page whose controls are renewed in vain does not take this for a refusal"


def test_aborts_that_come_while_one_is_under_way_are_carried_out_by_one_more(service: FakeService) -> None:
    async def flood() -> None:
        link = ServiceLink(service.path)
        service.held.clear()
        first = asyncio.create_task(link.abort())
        while not service.asked("abort"):
            await asyncio.sleep(0.001)
        rest = [asyncio.create_task(link.abort()) for _ in range(200)]
        await asyncio.sleep(0)
        service.held.set()
        answers = await asyncio.gather(first, *rest)
        link.close()
        assert all(answer["ok"] for answer in answers)

    asyncio.run(flood())
    assert len(service.asked("abort")) == 2


def test_requests_that_hang_do_not_hold_an_abort_back(browser: Browser, service: FakeService) -> None:
    async def many() -> float:
        link = ServiceLink(service.path)
        service.held.clear()
        stuck = [asyncio.create_task(link.ask({"do": "arm"})) for _ in range(40)]
        while len(service.asked("arm")) < 16:
            await asyncio.sleep(0.001)
        began_s = time.monotonic()
        aborting = asyncio.create_task(link.abort())
        while not service.asked("abort"):
            await asyncio.sleep(0.001)
        took_s = time.monotonic() - began_s
        service.held.set()
        await asyncio.gather(aborting, *stuck)
        link.close()
        return took_s

    asyncio.run(many())
    order = [request["do"] for request in service.requests]
    assert order.index("abort") == 16, "it was sent before the 24 that wait for a thread"


def test_the_plan_that_was_given_is_offered_as_text(browser: Browser, service: FakeService, tmp_path: Path) -> None:
    from starlette.testclient import TestClient

    from palpd.web.application import build
    from palpd.web.page import PageSettings
    from palpd.web.sessions import Sessions
    from tests.web.conftest import TOKEN

    plan = tmp_path / "plan.yaml"
    plan.write_text(PLAN)
    client = TestClient(build(PageSettings(service.path, tmp_path, plan=plan), Sessions(TOKEN)), base_url="http://127.0.0.1:8700")
    with_token = {"authorization": f"Bearer {TOKEN}"}
    assert client.get("/first-plan", headers=with_token).json() == {"ok": True, "name": "plan.yaml", "text": PLAN}
    plan.write_text("a: [")
    assert not client.get("/first-plan", headers=with_token).json()["ok"]
