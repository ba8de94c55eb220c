"""The operator's page in a headless Chromium: its server as a process of its own, and pages that say what they show. Benchmarks use it."""

import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from playwright.sync_api import Page, sync_playwright

from palpd.testing.processes import free_port

PATIENCE_MS = 60_000
BRACKETS = 20
"""Questions to a page for its clock; the narrowest bracket counts."""


class PageServer(NamedTuple):
    """A server of the page, and the link that opens it."""

    process: subprocess.Popen[str]
    url: str


@contextmanager
def page_server(config: Path, descriptors: int = 4096) -> Iterator[PageServer]:
    """Serve the page of a configuration within the context, on a free port. The server may open that many files."""
    limited = ["sh", "-c", f'ulimit -n {descriptors} && exec "$@"', "sh"]
    command = [*limited, sys.executable, "-m", "palpd", "web", "--config", str(config), "--port", str(free_port())]
    with (config.parent / "page.jsonl").open("wb") as log:
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True, start_new_session=True)
    try:
        assert process.stdout is not None
        yield PageServer(process, process.stdout.readline().split()[-1])
    finally:
        process.kill()
        process.communicate()


@contextmanager
def opened_pages(url: str, number: int) -> Iterator[list[Page]]:
    """Open the page in that many tabs of one browser, until each hears the stream.

    Args:
        url: The link with the token.
        number: How many tabs.

    Yields:
        The tabs.
    """
    chromium = shutil.which("chromium")
    assert chromium is not None, "chromium is not installed (Debian: apt install chromium)"
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"], timeout=PATIENCE_MS)
        context = browser.new_context(bypass_csp=True)  # Playwright waits by evaluating text, which the page's policy refuses
        context.set_default_timeout(PATIENCE_MS)
        pages = [context.new_page() for _ in range(number)]
        for page in pages:
            page.goto(url)
            page.wait_for_function("document.body.dataset.link === 'open' && document.body.dataset.service === 'open'")
        yield pages
        browser.close()


def clock_offset_s(page: Page) -> float:
    """What turns a page's `performance.now()`, in s, into the host's monotonic time; right to half of the narrowest bracket, some 1 ms."""
    brackets = []
    for _ in range(BRACKETS):
        before_s = time.monotonic()
        now_ms = page.evaluate("performance.now()")
        after_s = time.monotonic()
        brackets.append((after_s - before_s, 0.5 * (before_s + after_s) - now_ms * 1e-3))
    return min(brackets)[1]


WATCH_ABORT = """() => {
  const message = document.getElementById("message");
  const painted = (name) => requestAnimationFrame(() => setTimeout(() => { window.abortTimes[name] ??= performance.now(); }));
  window.abortTimes = {};
  const clicked = (event) => { window.abortTimes = { click: event.timeStamp }; };
  document.getElementById("abort").addEventListener("click", clicked, { capture: true });
  new MutationObserver(() => {
    if ("click" in window.abortTimes && message.textContent.startsWith("Abort carried out")) painted("shown");
  }).observe(message, { childList: true, characterData: true, subtree: true });
  new MutationObserver(() => {
    if ("click" in window.abortTimes && document.body.dataset.state !== "running") painted("ended");
  }).observe(document.body, { attributeFilter: ["data-state"] });
}"""
"""Notes when the button was clicked, when the page has drawn that the abort was carried out, and when it shows no run any more."""


def click_abort(page: Page) -> dict[str, float]:
    """Click the abort button of a page prepared with `WATCH_ABORT`.

    Args:
        page: The page.

    Returns:
        Host times of `click`, `shown` and `ended`.
    """
    offset_s = clock_offset_s(page)
    box = page.locator("#abort").bounding_box()
    assert box is not None, "the page has no abort button"
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.wait_for_function("'shown' in window.abortTimes && 'ended' in window.abortTimes")
    times_ms: dict[str, float] = page.evaluate("window.abortTimes")
    return {name: offset_s + ms * 1e-3 for name, ms in times_ms.items()}


COUNT_FRAMES = """async () => {
  const { on } = await import("/static/link.js");
  window.frameCounts = { heard: 0, drawn: 0 };
  on("frame", () => { window.frameCounts.heard++; });
  const draw = () => { window.frameCounts.drawn++; requestAnimationFrame(draw); };
  requestAnimationFrame(draw);
}"""
"""Counts the frames that a page hears from the server, and those that it draws."""


def frame_counts(pages: list[Page]) -> list[dict[str, int]]:
    """How many frames each page, prepared with `COUNT_FRAMES`, has heard and drawn."""
    counts: list[Any] = [page.evaluate("window.frameCounts") for page in pages]
    return counts
