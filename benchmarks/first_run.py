"""From `palpd demo --page` to a diagnosed run in the browser: how long each step takes.

`python -m benchmarks.first_run`. Headless Chromium does what a new user does: Arm, Start, watch, Runs, Diagnose.
"""

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable

from benchmarks.operator_page import opened_pages

PATIENCE_MS = 600_000


def main() -> None:
    """Serve the demo, drive its page, print a table."""
    begun_s, steps = time.monotonic(), list[tuple[str, float]]()

    def step(what: str) -> None:
        steps.append((what, time.monotonic() - begun_s))

    with tempfile.TemporaryDirectory(prefix="palpd-first-run-") as folder:
        demo = subprocess.Popen(
            [sys.executable, "-m", "palpd", "demo", "--page"], cwd=folder, stdout=subprocess.PIPE, text=True, start_new_session=True
        )
        assert demo.stdout is not None
        try:
            link = next(line.split()[-1] for line in demo.stdout if "?token=" in line)
            step("the page is served")
            drive(link, step)
        finally:
            os.killpg(demo.pid, signal.SIGINT)
            demo.communicate()
    print("| step | s after the command |\n|---|---|")
    for what, at_s in steps:
        print(f"| {what} | {at_s:.0f} |")


def drive(link: str, step: Callable[[str], None]) -> None:
    """Arm, start, watch, and diagnose the first site.

    Args:
        link: The page, with its token.
        step: Told what has been done.
    """
    with opened_pages(link, 1) as (page,):
        page.set_default_timeout(PATIENCE_MS)
        page.set_viewport_size({"width": 1400, "height": 860})
        page.fill("#operator", "anna")
        page.click("[data-do=arm]")
        page.wait_for_selector("body[data-state=armed]")
        step("armed")
        page.click("[data-do=start]")
        page.wait_for_selector("body[data-state=running]")
        page.wait_for_selector("body:not([data-state=running])")
        step(f"the run is {page.text_content('#fault')}")
        page.goto(link.partition("?")[0] + "runs")
        page.click("#runs a")
        page.wait_for_selector("#force svg")
        step("its page shows force and depth over time")
        page.click("#diagnose button")
        page.wait_for_selector("#diagnosis .headline")
        step(f"diagnosed: {page.text_content('#diagnosis .headline')}")


if __name__ == "__main__":
    main()
