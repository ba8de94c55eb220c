"""What the operator's page shows and lights after each end of a run, over emulated wires, and the pictures of docs/page.md.

`python -m benchmarks.page_states --docs docs` writes table and pictures. `--all FOLDER` keeps a picture of each state at three sizes, light
and dark, with an operator at one page and another who watches. Headless Chromium presses the button that is lit, until a start is.
"""

import argparse
import io
import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

from benchmarks.after_a_run import ENDS, SOFT_N_PER_M
from benchmarks.marked_text import write_marked
from benchmarks.operator_page import page_server
from palpd.testing.emulated_cell import PATIENT, EmulatedCell, emulated_cell
from palpd.testing.processes import until
from palpd.testing.served_cell import ServedCell, served

SIZES = ((1400, 900), (768, 1024), (390, 844))
SCHEMES = ("light", "dark")
PLAN = "sites: [{name: A}, {name: B, x_m: 0.03}, {name: C, x_m: 0.06}]\nmode: both\ndepths_m: [0.004, 0.006]\nhold_s: 3.0\nrepeats: 1\n"
MOST_BUTTONS = 6
"""Longest way from an end to a start: retract, clear, calibrate, arm, and two more."""
COLOURS = 96
"""Colours of a picture: enough for letters and lines, a third of the bytes."""
PATIENCE_S = 180.0


class Shown(NamedTuple):
    """What the page says, and the button that it lights."""

    word: str
    sentence: str
    lit: str


class Watched:
    """A cell with its page: `operator` presses buttons, the others look on, each with a screen and colours of its own."""

    def __init__(self, service: ServedCell, link: str, chromium: Browser, folder: Path | None) -> None:
        self.service, self.folder = service, folder
        self.operator = self._opened(chromium, link, SIZES[0], "light", "anna")
        others = [(size, scheme) for size in SIZES for scheme in SCHEMES if (size, scheme) != (SIZES[0], "light")]
        self.others = [self._opened(chromium, link, size, scheme, "ben") for size, scheme in others] if folder is not None else []
        plan = {"name": "plan.yaml", "mimeType": "text/yaml", "buffer": PLAN.encode()}
        self.operator.set_input_files("#plan-file", [plan])  # type: ignore[list-item]

    @staticmethod
    def _opened(chromium: Browser, link: str, size: tuple[int, int], scheme: str, name: str) -> Page:
        width, height = size
        context = chromium.new_context(viewport={"width": width, "height": height}, color_scheme="dark" if scheme == "dark" else "light")
        context.set_default_timeout(1e3 * PATIENCE_S)
        page = context.new_page()
        page.goto(link)
        page.wait_for_selector("body[data-link=open]")
        page.fill("#operator", name)
        page.evaluate("document.activeElement.blur()")
        return page

    def idle(self) -> Shown:
        """What the page says once nothing runs."""
        until(lambda: self.service.status()["state"] in ("disarmed", "armed"), "nothing runs", PATIENCE_S, every_s=0.1)
        now = self.service.status()["now"]
        until(
            lambda: self.operator.text_content("#doing") is not None and self._shown().word == now["word"], "the page says so", PATIENCE_S
        )
        return self._shown()

    def _shown(self) -> Shown:
        lit = self.operator.locator(".controls [data-next]").all_inner_texts()
        texts = [str(self.operator.text_content(place)) for place in ("#state", "#doing")]
        return Shown(texts[0], texts[1], lit[0] if lit else "")

    def keep(self, name: str) -> None:
        """Keep a picture of each screen."""
        for page in (self.operator, *self.others) if self.folder is not None else ():
            size = page.viewport_size or {"width": 0}
            scheme = "dark" if page.evaluate("matchMedia('(prefers-color-scheme: dark)').matches") else "light"
            page.screenshot(path=str(Path(self.folder or ".", f"{name}-{size['width']}-{scheme}.png")))

    def follow(self, name: str) -> list[Shown]:
        """Press what is lit until a start is, and keep what each step shows."""
        steps = [self.idle()]
        self.keep(f"{name}-0-{steps[0].lit}")
        while steps[-1].lit not in ("Start", "") and len(steps) <= MOST_BUTTONS:
            self.operator.click(".controls [data-next]")
            before = steps[-1]
            until(lambda shown=before: self._shown() != shown, "the page answers", PATIENCE_S, every_s=0.1)  # type: ignore[misc]
            steps.append(self.idle())
            self.keep(f"{name}-{len(steps) - 1}-{steps[-1].lit}")
        return steps


@contextmanager
def watched(folder: Path, chromium: Browser, kept: Path | None, *, phantom: bool = False) -> Iterator[Watched]:
    """An emulated cell with service and page within the context; before the paper's phantom, or before a soft wall."""
    (folder / "run").mkdir(parents=True)
    with ExitStack() as stack:
        wired = stack.enter_context(emulated_cell(folder))
        if phantom:
            wired = EmulatedCell(wired.wires, wired.model, folder / "run", PATIENT)
        else:
            wired = wired.anew(folder / "run", SOFT_N_PER_M, **PATIENT)
        service = stack.enter_context(served(wired))
        server = stack.enter_context(page_server(wired.config))
        yield Watched(service, server.url, chromium, kept)


def after_each_end(folder: Path, chromium: Browser, kept: Path | None) -> dict[str, list[Shown]]:
    """End a run in each way, and follow what the page lights."""
    rows = {}
    for end, finish in ENDS.items():
        name = end.replace(" ", "-")
        with watched(folder / name, chromium, kept) as watching:
            finish(watching.service)
            rows[end] = watching.follow(name)
            print(end, rows[end], flush=True)
    return rows


def table(rows: Mapping[str, list[Shown]]) -> str:
    """The rows as Markdown."""
    lines = ["| the last run ended by | the page says | and lights, one after the other |", "|---|---|---|"]
    for end, steps in rows.items():
        lines.append(f"| {end} | **{steps[0].word}.** {steps[0].sentence} | {', '.join(step.lit for step in steps)} |")
    return re.sub(r"\d{8}-\d{6}", "TIME", "\n".join(lines))


def pictures(folder: Path, chromium: Browser, figures: Path) -> None:
    """Take the pictures of docs/page.md."""
    with watched(folder, chromium, None, phantom=True) as watching:
        page, service = watching.operator, watching.service
        page.set_viewport_size({"width": 1400, "height": 880})
        page.click("[data-do=arm]")
        page.wait_for_selector("body[data-state=armed]")
        _picture(page, figures / "page-armed.png")
        page.click("[data-do=start]")
        until(lambda: service.status().get("site") == 1 and service.status().get("phase") == "hold", "it holds", PATIENCE_S, every_s=0.1)
        until(lambda: page.locator("#sites tr").count() >= 1, "a site is analysed", PATIENCE_S, every_s=0.1)
        _picture(page, figures / "page-pressing.png")
        page.click("#distance")
        _picture(page, figures / "page-distance.png")
        page.click("#distance")
        page.click("#abort")
        page.wait_for_selector("body[data-state=pressed]")
        _picture(page, figures / "page-pressed.png")
        page.set_viewport_size({"width": 390, "height": 844})
        _picture(page, figures / "page-phone.png")
        page.set_viewport_size({"width": 1400, "height": 880})
        watching.follow("way-out")
        page.select_option("#place-choice", "return")
        page.click("[data-do=start]")
        until(lambda: service.status().get("phase") == "hold", "it holds", PATIENCE_S, every_s=0.1)
        service.cell.wires.ask("silent", s=1.0)
        page.wait_for_selector("body[data-state=latched]")
        _picture(page, figures / "page-stopped.png")


def _picture(page: Page, path: Path) -> None:
    """Keep a small picture of what is seen, without a focus."""
    page.evaluate("document.activeElement.blur()")
    page.wait_for_timeout(400)  # the frames and colours of the newest status
    picture = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    picture.quantize(COLOURS, dither=Image.Dither.NONE).save(path, optimize=True)
    print(f"{path}: {path.stat().st_size / 1e3:.0f} kB", flush=True)


def main() -> None:
    """Write what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--docs", type=Path, help="folder of the pages: table and pictures are written into it")
    parser.add_argument("--all", type=Path, metavar="FOLDER", help="keep a picture of each state on each screen")
    parser.add_argument("--pictures-only", action="store_true", help="leave the table as it is")
    arguments = parser.parse_args()
    if arguments.all is not None:
        arguments.all.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch, sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox", "--disable-gpu"])
        if not arguments.pictures_only:
            rows = after_each_end(Path(scratch), chromium, arguments.all)
            print(table(rows))
        if arguments.docs is not None:
            pictures(Path(scratch, "pictures"), chromium, arguments.docs / "figures")
        if arguments.docs is not None and not arguments.pictures_only:
            write_marked(arguments.docs / "page.md", "page-states", table(rows))
        chromium.close()


if __name__ == "__main__":
    main()
