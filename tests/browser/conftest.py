"""A calibrated service before an emulated cell, its page, and Debian's Chromium. What is missing is said, and the tests are skipped."""

import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import pytest

from palpd.testing.emulated_cell import PATIENT, emulated_cell
from palpd.testing.fixtures import skip_without_ur_rtde
from palpd.testing.processes import free_port, until
from palpd.testing.served_cell import ServedCell, served
from palpd.web.sessions import SESSION_S, Sessions
from tests.browser.waiting import PATIENCE_S, until_text

playwright_api: Any = pytest.importorskip("playwright.sync_api", reason="playwright is not installed; pip install playwright")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
PORT = free_port()
PATIENCE_MS = 1000.0 * PATIENCE_S
PLAN = {
    "sites": [{"name": "A"}],
    "mode": "static",
    "depths_m": [0.004],
    "hold_s": 300.0,
    "search": {"speed_m_per_s": 0.01, "max_travel_m": 0.03},
}
"""One hold that is longer than any test."""

UNHURRIED = PATIENT | {"safety": PATIENT["safety"] | {"robot_stale_s": 0.4, "sensor_stale_s": 0.4, "max_stall_s": 0.4}}
"""A browser beside the cell takes much of a small machine. How fast the guard is, is tested elsewhere."""


@dataclass
class Pages:
    """The page's server, and browsers before it."""

    service: ServedCell
    chromium: Any
    shots: Path
    link: str = ""
    process: "subprocess.Popen[str] | None" = None
    contexts: list[Any] = field(default_factory=list)

    def start(self) -> None:
        """Start the server, as an operator does."""
        command = [sys.executable, "-m", "palpd", "web", "--config", str(self.service.cell.config), "--port", str(PORT)]
        with (self.service.cell.folder / "web.log").open("ab") as log:
            self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True)
        assert self.process.stdout is not None
        self.link = self.process.stdout.readline().split()[-1]

        def listens() -> bool:
            with suppress(OSError), urlopen(f"http://127.0.0.1:{PORT}/static/icon.svg", timeout=5.0):
                return True
            return False

        until(listens, "the page is served", PATIENCE_S, every_s=0.2)

    @property
    def free(self) -> bool:
        """Whether the service knows the probe to be free, and nothing runs."""
        status = self.service.do("status")
        return bool(status["state"] in ("disarmed", "armed") and (status["probe"] or {}).get("state") == "free")

    def kill_the_service(self) -> None:
        """As a crash does: nothing of it is left to stop the arm but the controller's watchdog."""
        self.service.end(signal.SIGKILL)

    def serve_again(self) -> None:
        """Start the service as systemd does after a crash."""
        self.service.begin()

    def stop(self) -> None:
        """End the server by force: a page that hangs must not hold a test."""
        if self.process is not None:
            self.process.kill()
            self.process.wait(30.0)

    def open(self, name: str = "anna", scheme: str = "light", size: tuple[int, int] = (1400, 900), path: str = "") -> Any:
        """A page of a new browser, opened with the token and linked."""
        context = self.chromium.new_context(color_scheme=scheme, viewport={"width": size[0], "height": size[1]})
        context.set_default_timeout(PATIENCE_MS)
        self.contexts.append(context)
        page = context.new_page()
        page.goto(self.link, wait_until="commit")
        page.wait_for_selector("body[data-link=open][data-service=open]")
        page.fill("#operator", name)
        if path:
            page.goto(f"http://127.0.0.1:{PORT}{path}", wait_until="commit")
            page.wait_for_selector("body[data-link=open][data-service=open]")
        return page

    def expire(self, page: Any) -> None:
        """Make the session of a page one that began too long ago."""
        token = (self.service.cell.folder / "state" / "page-token").read_text().strip()
        cookie = Sessions(token, lambda: time.time() - SESSION_S - 60.0).begin()
        page.context.add_cookies([{"name": f"palpd_{PORT}", "value": cookie, "url": f"http://127.0.0.1:{PORT}", "sameSite": "Strict"}])

    def keep(self, page: Any, name: str) -> None:
        """Keep a screenshot."""
        page.screenshot(path=str(self.shots / f"{name}.png"))

    def close_browsers(self) -> None:
        """Close all pages, and free the controls that one of them may have held."""
        for context in self.contexts:
            context.close()
        self.contexts.clear()
        lease = self.service.do("take", name="the tests", force=True)["lease"]
        self.service.do("release", lease=lease)


@pytest.fixture(scope="module")
def all_pages(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Pages]:
    if CHROMIUM is None:
        pytest.skip("chromium is not installed; apt install chromium")
    skip_without_ur_rtde()
    with (
        emulated_cell(tmp_path_factory.mktemp("cell"), "ur5") as cell,
        served(cell.anew(tmp_path_factory.mktemp("run"), 1500.0, **UNHURRIED), PATIENCE_S) as service,
        playwright_api.sync_playwright() as playwright,
    ):
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu"], timeout=PATIENCE_MS)
        pages = Pages(service, chromium, tmp_path_factory.mktemp("screenshots"))
        print(f"screenshots are kept in {pages.shots}")
        pages.start()
        yield pages
        pages.stop()
        chromium.close()


@pytest.fixture
def pages(all_pages: Pages) -> Iterator[Pages]:
    """The server of all tests; each begins with no browser, a service that is disarmed, and a tip above the tissue."""
    yield all_pages
    all_pages.close_browsers()
    all_pages.service.do("abort")
    all_pages.service.until_disarmed(PATIENCE_S)
    if not all_pages.free:  # the test has failed
        all_pages.service.do("retract")
        all_pages.service.until_disarmed(PATIENCE_S)
        if all_pages.service.do("status")["latched"]:
            all_pages.service.do("clear")


@pytest.fixture
def choose() -> Callable[[Any], None]:
    """Chooses the plan of these tests on a page, as its file field does."""

    def choose_plan(page: Any) -> None:
        page.set_input_files("#plan-file", {"name": "hold.yaml", "mimeType": "text/yaml", "buffer": json.dumps(PLAN).encode()})
        until_text(page, "#plan-name", "hold.yaml")

    return choose_plan
