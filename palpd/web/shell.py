"""The frame of every page: tabs, the abort bar, and the page's own part, put together from HTML files without a template engine.

Everything that comes from outside (names of runs, notes, sentences of the service) reaches a page as JSON and is shown by `textContent`.
So no page is made with foreign text in it, except here, where it is escaped.
"""

from functools import cache
from html import escape
from pathlib import Path
from string import Template
from typing import NamedTuple

from starlette.requests import Request
from starlette.responses import HTMLResponse
from starlette.routing import Route

PAGES = Path(__file__).parent / "pages"
STATIC = Path(__file__).parent / "static"


class Tab(NamedTuple):
    """A tab: `pages/NAME.html` is its part of the page, and `static/NAME.js`, where it exists, its ES module."""

    name: str
    title: str
    path: str


TABS = (
    Tab("run", "Run", "/"),
    Tab("plan", "Plan", "/plan"),
    Tab("runs", "Runs", "/runs"),
    Tab("checks", "Checks", "/checks"),
    Tab("resolve", "Resolve", "/resolve"),
    Tab("commission", "Set-up", "/setup"),
)


def page(request: Request, part: str, title: str, tab: str, *, camera: str = "") -> HTMLResponse:
    """Make a page of the application.

    Args:
        request: The request, for the mark of its session.
        part: Name of the file in `pages/`, without ending; `static/PART.js` is loaded with it where it exists.
        title: Of the page, for the browser.
        tab: Name of the tab that it belongs to.
        camera: HTML that shows the camera's picture, on the Run page.
    """
    return HTMLResponse(_framed(part, title, tab, request.scope["session"].csrf).replace("$camera", camera))


def entrance(sentence: str) -> str:
    """The page of a browser that has not shown the token, or whose session has expired: a sentence, a field, and the abort bar."""
    return _framed("entrance", "palpd: not open", "", "").replace("$sentence", escape(sentence))


def routes(camera_url: str | None) -> list[Route]:
    """One route a tab.

    Args:
        camera_url: Address of a camera's picture, for the Run page; None: it shows none.
    """
    camera = Template(_read("camera")).substitute(url=escape(camera_url)) if camera_url is not None else ""

    def of(tab: Tab) -> Route:
        async def show(request: Request) -> HTMLResponse:
            return page(request, tab.name, f"palpd: {tab.title}", tab.name, camera=camera)

        return Route(tab.path, show, name=tab.name)

    return [of(tab) for tab in TABS]


def _framed(part: str, title: str, tab: str, csrf: str) -> str:
    links = "".join(
        f'<a href="{each.path}"{" aria-current=page" if each.name == tab else ""}>{each.title}</a>' for each in (TABS if tab else ())
    )
    module = f'<script type="module" src="/static/{part}.js"></script>' if (STATIC / f"{part}.js").exists() else ""
    return Template(_read("base")).safe_substitute(
        title=escape(title), tabs=links, part=_read(part), module=module, csrf=escape(csrf), page=part
    )


@cache
def _read(name: str) -> str:
    return (PAGES / f"{name}.html").read_text(encoding="utf-8")
