"""A page before a fake service; browsers are httpx clients."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from palpd.web.application import build
from palpd.web.page import PageSettings
from palpd.web.sessions import Sessions
from tests.web.fake_service import FakeService

TOKEN = "the-token-of-these-tests"
HERE, ELSEWHERE = "127.0.0.1", "192.168.1.50"
ORIGIN = "http://127.0.0.1:8700"
Browser = Callable[..., TestClient]


class Clock:
    """Wall clock of the server."""

    def __init__(self) -> None:
        self.now_s = 1.8e9

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def service(tmp_path: Path) -> Iterator[FakeService]:
    fake = FakeService(tmp_path / "palpd.sock")
    yield fake
    fake.close()


@pytest.fixture
def browser(service: FakeService, tmp_path: Path, clock: Clock) -> Browser:
    """Makes browsers of one server: `opened` with the token or not, from this computer or another."""
    application = build(PageSettings(service.path, tmp_path), Sessions(TOKEN, clock))

    def make(opened: bool = True, address: str = HERE, origin: str | None = ORIGIN) -> TestClient:
        headers = {"origin": origin, "user-agent": "Tablet/1.0"} if origin else {}
        client = TestClient(application, base_url=ORIGIN, client=(address, 40000), headers=headers, follow_redirects=False)
        if opened:
            assert client.get("/", params={"token": TOKEN}).status_code == 303
            page = client.get("/").text
            client.headers["x-palpd-csrf"] = page.split('name="palpd-csrf" content="')[1].split('"')[0]
        return client

    return make
