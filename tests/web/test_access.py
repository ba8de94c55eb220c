"""Who reaches what: the token, hosts, origins, forged requests, rates, and the abort that needs none of it."""

import json
from collections.abc import Callable
from html import unescape
from pathlib import Path

import pytest
from httpx import Response
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect

from palpd.errors import BadInput
from palpd.web import access
from palpd.web.access import MOST_ADDRESSES, TRIES, Rates
from palpd.web.sessions import SESSION_S, Sessions, read_token
from tests.web.conftest import ELSEWHERE, ORIGIN, TOKEN, Browser, Clock
from tests.web.fake_service import FakeService


def test_without_the_token_nothing_is_reached_but_the_entrance_and_the_abort(browser: Browser, service: FakeService) -> None:
    stranger = browser(opened=False)
    for path in ("/", "/plan", "/runs", "/first-plan"):
        assert stranger.get(path).status_code == 401
    assert stranger.post("/do/arm").status_code == 401
    entrance = stranger.get("/", headers={"accept": "text/html"})
    assert entrance.status_code == 401
    assert 'id="abort"' in entrance.text
    with pytest.raises(WebSocketDisconnect), stranger.websocket_connect("ws://127.0.0.1:8700/live"):
        pass
    assert service.asked("arm") == []
    assert stranger.post("/abort").json() == {"ok": True, "state": "disarmed"}
    assert len(service.asked("abort")) == 1


def test_the_token_opens_the_page_and_leaves_the_address(browser: Browser) -> None:
    client = browser(opened=False)
    answer = client.get("/", params={"token": TOKEN})
    assert (answer.status_code, answer.headers["location"]) == (303, "/")
    cookie = answer.headers["set-cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=strict" in cookie
    assert TOKEN not in cookie
    page = client.get("/")
    assert page.status_code == 200
    assert TOKEN not in page.text
    assert "script-src 'self';" in page.headers["content-security-policy"]
    assert "unsafe" not in page.headers["content-security-policy"]


def test_the_form_of_the_entrance_takes_the_token_too(browser: Browser) -> None:
    client = browser(opened=False)
    assert client.post("/enter", data={"token": "wrong"}).status_code == 401
    assert client.post("/enter", data={"token": TOKEN}).status_code == 303
    assert client.get("/plan").status_code == 200


def test_wrong_tokens_are_limited_and_the_right_one_opens_the_page_after_any_number_of_them(browser: Browser) -> None:
    client = browser(opened=False)
    codes = [client.get("/", params={"token": "x" * each}).status_code for each in range(1, int(access.BURST) + 50)]
    assert codes[: int(TRIES)] == [401] * int(TRIES)
    assert set(codes[int(TRIES) + 5 :]) == {429}
    assert client.post("/enter", data={"token": "wrong"}).status_code == 429
    assert browser(opened=False).get("/", params={"token": TOKEN}).status_code == 303
    assert browser(opened=False).post("/enter", data={"token": TOKEN}).status_code == 303


def test_requests_without_a_token_do_not_keep_the_right_one_out(browser: Browser, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(access, "RATE_PER_S", 0.0)
    client = browser(opened=False)
    assert {client.get("/plan").status_code for _ in range(int(access.BURST) + 5)} == {401, 429}
    assert client.post("/enter", data={"token": TOKEN}).status_code == 303
    assert client.get("/", params={"token": TOKEN}).status_code == 303


@pytest.mark.parametrize(
    ("request_of", "code", "words"),
    [
        (lambda client: client.get("/plan"), 401, "12 hours"),
        (lambda client: client.get("/", params={"token": "wrong"}), 401, "palpd web prints the link"),
        (lambda client: client.post("/enter", data={"token": TOKEN}, headers={"origin": "null"}), 403, "open palpd's own page"),
        (lambda client: client.get("/", headers={"host": "other:8700"}), 421, "not served under 'other:8700'"),
    ],
)
def test_a_refusal_is_a_page_for_a_browser_and_json_for_a_program(
    browser: Browser, request_of: Callable[[TestClient], Response], code: int, words: str
) -> None:
    client = browser(opened=False)
    program = request_of(client)
    assert program.status_code == code
    assert words in program.json()["error"]
    client.headers["accept"] = "text/html,application/xhtml+xml,*/*;q=0.8"
    page = request_of(client)
    assert page.status_code == code
    assert page.headers["content-type"].startswith("text/html")
    assert words in unescape(page.text)


def test_the_page_of_another_site_can_neither_ask_nor_watch_nor_abort(browser: Browser, service: FakeService) -> None:
    opened = browser()
    for origin in ("http://evil.example", "null", "http://127.0.0.1:9999"):
        assert opened.post("/do/arm", headers={"origin": origin}).status_code == 403
        assert opened.post("/abort", headers={"origin": origin}).status_code == 403
        with pytest.raises(WebSocketDisconnect), opened.websocket_connect("ws://127.0.0.1:8700/live", headers={"origin": origin}):
            pass
    assert browser(opened=False, origin=None).post("/abort").status_code == 403
    assert service.asked("arm") == service.asked("abort") == []


def test_a_name_that_was_turned_to_this_computer_is_no_host_of_the_page(browser: Browser) -> None:
    answer = browser().get("/", headers={"host": "rebound.example:8700"})
    assert answer.status_code == 421
    assert "--name" in answer.json()["error"]


def test_a_request_without_the_mark_of_the_page_is_refused(browser: Browser, service: FakeService) -> None:
    client = browser()
    assert client.post("/do/arm", headers={"x-palpd-csrf": "0" * 64}).status_code == 403
    assert service.asked("arm") == []
    assert client.post("/do/arm").json()["ok"]


def test_a_program_may_show_the_token_in_each_request(browser: Browser, service: FakeService) -> None:
    program = browser(opened=False, origin=None)
    assert program.post("/do/jobs", headers={"authorization": f"Bearer {TOKEN}"}).json()["ok"]
    assert program.post("/do/jobs", headers={"authorization": "Bearer other"}).status_code in (401, 403)
    assert len(service.asked("jobs")) == 1


@pytest.mark.parametrize("address", ["127.0.0.1", "::1", ELSEWHERE])
def test_an_expired_page_aborts_and_does_nothing_else(browser: Browser, service: FakeService, clock: Clock, address: str) -> None:
    page = browser(address=address)
    clock.now_s += SESSION_S + 2.0
    refused = page.post("/do/arm")
    assert refused.status_code == 401
    assert refused.json()["expired"]
    assert "12 hours" in refused.json()["error"]
    assert page.post("/abort").json()["ok"]
    assert service.asked("arm") == []
    assert len(service.asked("abort")) == 1


def test_from_elsewhere_a_browser_that_never_showed_the_token_cannot_abort(browser: Browser, service: FakeService) -> None:
    stranger = browser(opened=False, address=ELSEWHERE)
    assert stranger.post("/abort").status_code == 401
    stranger.cookies.set("palpd_8700", "aaaa.1.ffff")
    assert stranger.post("/abort").status_code == 401
    assert service.asked("abort") == []


def test_requests_are_limited_in_their_rate_and_aborts_never(
    browser: Browser, service: FakeService, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(access, "RATE_PER_S", 0.0)
    monkeypatch.setattr(access, "BURST", 10.0)
    client = browser()
    codes = [client.post("/do/jobs").status_code for _ in range(12)]
    assert codes[0] == 200
    assert codes[-1] == 429
    assert {client.post("/abort").status_code for _ in range(30)} == {200}
    assert len(service.asked("abort")) == 30


def test_a_browser_that_waits_may_ask_again_and_the_oldest_is_forgotten() -> None:
    now_s = [0.0]
    rates = Rates(2.0, 3.0, lambda: now_s[0])
    assert [rates.take("a") for _ in range(4)] == [True, True, True, False]
    assert rates.take("b")
    now_s[0] = 0.5
    assert [rates.take("a") for _ in range(2)] == [True, False]
    for number in range(MOST_ADDRESSES):
        rates.take(f"other {number}")
    assert rates.take("a")


def test_an_oversized_request_is_refused_in_one_sentence(browser: Browser, service: FakeService) -> None:
    answer = browser().post("/do/start", content=b"x" * 300_000)
    assert answer.status_code == 413
    assert answer.json()["error"] == "the request has 300000 bytes, expected at most 262144; send less"
    assert service.asked("start") == []


def test_a_session_survives_a_restart_of_the_server_and_a_changed_clock_of_the_browser(clock: Clock) -> None:
    cookie = Sessions(TOKEN, clock).begin()
    later = Sessions(TOKEN, clock)
    known = later.known(cookie)
    assert known is not None
    assert not known.expired
    assert later.known(cookie[:-1] + ("0" if cookie[-1] != "0" else "1")) is None
    assert Sessions("another-token-than-that", clock).known(cookie) is None
    name, _, rest = cookie.partition(".")
    begun, _, signature = rest.partition(".")
    assert later.known(f"{name}.{int(begun) + 9999}.{signature}") is None
    assert later.known("") is None
    assert later.known("é.ü.ö") is None


def test_the_token_file_is_for_its_owner_alone(tmp_path: Path) -> None:
    file = tmp_path / "page-token"
    token = read_token(file)
    assert file.stat().st_mode & 0o777 == 0o600
    assert read_token(file) == token
    file.chmod(0o640)
    with pytest.raises(BadInput, match="has mode 640, expected 600"):
        read_token(file)
    file.chmod(0o600)
    file.write_text("short")
    with pytest.raises(BadInput, match="holds 5 letters"):
        read_token(file)


def test_a_credential_of_systemd_is_the_token(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "palpd-web-token").write_text("a-token-that-systemd-gives\n")
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(tmp_path))
    assert read_token(tmp_path / "absent") == "a-token-that-systemd-gives"
    assert not (tmp_path / "absent").exists()


def test_the_log_holds_who_asked_and_never_a_lease_or_the_token(
    browser: Browser, service: FakeService, capsys: pytest.CaptureFixture[str]
) -> None:
    service.answers["take"] = {"ok": True, "lease": "5ec4e7", "lease_s": 10.0}
    client = browser()
    client.post("/do/take", json={"name": "<b>anna</b>\n../x"})
    client.post("/do/arm", json={"lease": "5ec4e7"})
    client.post("/abort")
    printed = capsys.readouterr().err
    lines = [json.loads(line) for line in printed.splitlines()]
    arm = next(line for line in lines if line.get("do") == "arm")
    assert arm["browser"] == "127.0.0.1 Tablet/1.0"
    assert arm["session"]
    assert any(line["event"] == "abort" for line in lines)
    assert "5ec4e7" not in printed
    assert TOKEN not in printed
    assert service.asked("take")[0]["name"] == "<b>anna</b>\n../x", "whether that is a name says the service"


def test_the_page_is_served_under_its_own_names_only(browser: Browser) -> None:
    assert browser().get("/", headers={"host": "localhost:8700"}).status_code == 200
    assert browser().get("/", headers={"host": ORIGIN.removeprefix("http://")}).status_code == 200
    assert browser().get("/", headers={"host": "127.0.0.1"}).status_code == 421
