"""Waiting for what a page shows, from outside: the page's policy refuses the `eval` of Playwright's `wait_for_function`."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from palpd.testing.processes import until

PATIENCE_S = 300.0
"""For a machine that does other things besides: the tests look at order and content, not at time."""


def until_text(page: Any, selector: str, true: Callable[[str], bool] | str) -> str:
    """Wait until the text of an element is as it should be: holds that text, or makes the function true. Returns it."""
    text = ""

    def shown() -> bool:
        nonlocal text
        text = str(page.text_content(selector))
        return true in text if isinstance(true, str) else true(text)

    until(shown, f"{selector} shows what it should", PATIENCE_S, every_s=0.2)
    return text


def above(least: float) -> Callable[[str], bool]:
    """Whether a text is a number above that."""

    def is_above(text: str) -> bool:
        try:
            return float(text.replace("−", "-")) > least
        except ValueError:
            return False

    return is_above


def nothing_for_axe(page: Any) -> None:
    """Let axe look at the page as it stands, light and dark."""
    axe = (Path(__file__).parent / "axe.min.js").read_text()
    for scheme in ("light", "dark"):
        page.emulate_media(color_scheme=scheme)
        findings = page.evaluate(f"async () => {{ {axe}; return (await axe.run()).violations; }}")
        assert [f"{each['id']}: {each['nodes'][0]['html'][:120]}" for each in findings] == [], scheme
    page.emulate_media(color_scheme="light")
