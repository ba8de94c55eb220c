"""What every calculation of the page shares: how far it is, its result, its course and its report, and how it is cancelled."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, Response
from starlette.routing import BaseRoute, Route

from palpd.errors import BadInput
from palpd.files import opened, read_text
from palpd.web import looking_back
from palpd.web.answers import answering, number_in
from palpd.web.children import Child
from palpd.web.page import Page

MOST_REPORT_BYTES = 50_000_000
"""Largest report; one of an hour has some 2 MB."""
FRAMED = {
    "Content-Security-Policy": (
        "default-src 'none'; style-src 'unsafe-inline'; img-src data:; sandbox allow-same-origin; frame-ancestors 'self'"
    ),
    "X-Frame-Options": "SAMEORIGIN",
}
"""Headers of a report in its frame: it may look as it likes, and run no script, load nothing and send nothing."""


class Calculations:
    """The routes of the calculations, by their number."""

    def __init__(self, page: Page) -> None:
        self._page = page

    def _asked(self, request: Request) -> Child:
        text = request.path_params["number"]
        if not text.isdecimal() or len(text) > 12:
            raise BadInput(f"{text[:40]!r} is no number of a calculation; begin it again")
        return self._page.children.numbered(int(text))

    async def state(self, request: Request) -> Mapping[str, Any]:
        """How far it is."""
        return self._asked(request).as_json

    async def result(self, request: Request) -> Mapping[str, Any]:
        """Its figures, or its refusal."""
        child = self._asked(request)
        return {"result": await run_in_threadpool(child.result)}

    async def course(self, request: Request) -> Mapping[str, Any]:
        """Force, height and depth between two times."""
        child = self._asked(request)
        child.refuse_unless_done()
        begin_s, end_s = number_in(request.query_params, "begin_s"), number_in(request.query_params, "end_s")
        return await self._page.aside.compute(looking_back.course_window, child.folder / "course.npy", begin_s, end_s)

    async def report(self, request: Request) -> Response:
        """The page that it has written."""
        child = self._asked(request)
        child.refuse_unless_done()
        return await report_response(child.folder / "report.html", request, f"{child.name}.html")

    async def cancel(self, request: Request) -> Mapping[str, Any]:
        """End it now."""
        return self._page.children.cancel(self._asked(request).number).as_json


def routes(page: Page) -> list[BaseRoute]:
    """The routes of the calculations."""
    of = Calculations(page)
    return [
        Route("/calculations/{number}", answering(of.state)),
        Route("/calculations/{number}/result", answering(of.result)),
        Route("/calculations/{number}/course", answering(of.course)),
        Route("/calculations/{number}/report", answering(of.report)),
        Route("/calculations/{number}/cancel", answering(of.cancel), methods=["POST"]),
    ]


async def report_response(path: Path, request: Request, name: str) -> Response:
    """A report for its frame, or as a download where the address says so.

    Args:
        path: The HTML file.

    Raises:
        BadInput: The file is absent or too large.
    """
    if "download" in request.query_params:
        return download_response(path, name)
    return HTMLResponse(await run_in_threadpool(read_text, path, most_bytes=MOST_REPORT_BYTES), headers=FRAMED)


def download_response(path: Path, name: str) -> Response:
    """A file as a download. Letters that a header cannot hold become underscores.

    Args:
        name: Its name at the user's.

    Raises:
        BadInput: The file is absent.
    """
    with opened(path):
        pass  # one that was removed meanwhile is a sentence
    plain = "".join(letter if letter.isascii() and (letter.isalnum() or letter in "._-") else "_" for letter in name)
    return FileResponse(path, media_type="application/octet-stream", filename=plain)
