"""A page over a folder of recorded runs, without a service; its calculations are commands that a test can replace."""

import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from palpd.web.application import build
from palpd.web.page import PageSettings
from palpd.web.sessions import Sessions
from tests.history.conftest import simulated
from tests.paths import ROOT

__all__ = ["browser", "runs", "simulated"]

TOKEN, ORIGIN = "the-token-of-these-tests", "http://127.0.0.1:8700"


@pytest.fixture(scope="module")
def runs(simulated: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of runs with a copy of each of the three."""
    return Path(shutil.copytree(simulated, tmp_path_factory.mktemp("page") / "runs"))


@pytest.fixture(scope="module")
def browser(runs: Path) -> Iterator[TestClient]:
    """A browser that has shown the token. All tests of a module share it: the process beside the server starts once."""
    config = runs.parent / "config.yaml"
    shutil.copy(ROOT / "config.yaml", config)
    settings = PageSettings(runs.parent / "absent.sock", runs, config=config)
    with TestClient(build(settings, Sessions(TOKEN)), base_url=ORIGIN, client=("127.0.0.1", 40000), headers={"origin": ORIGIN}) as client:
        page = client.get("/", params={"token": TOKEN}).text
        client.headers["x-palpd-csrf"] = page.split('name="palpd-csrf" content="')[1].split('"')[0]
        yield client


def ended(browser: TestClient, begun: Any) -> dict[str, Any]:
    """Wait for the end of a calculation."""
    assert begun["ok"], begun
    for _ in range(1200):
        now: dict[str, Any] = browser.get(f"/calculations/{begun['number']}").json()
        if now["state"] not in ("waiting", "running"):
            return now
        time.sleep(0.05)
    raise AssertionError(f"no end: {now}")
