"""The tab Set-up: what `palpd setup` has done on this cell, and where the page leads through it, what it says and asks."""

from collections.abc import Mapping
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.routing import BaseRoute, Route

from palpd.web.answers import answering, body_of, number_in, text_in
from palpd.web.page import Page
from palpd.web.plan_pages import config_of

READ_LIMIT_S = 60.0
"""Longest time of `palpd commission`, which takes a second."""


def routes(page: Page) -> list[BaseRoute]:
    """The routes of the tab Set-up."""
    talk = page.talk

    async def rows(_: Request) -> Mapping[str, Any]:
        """The steps with their findings, their order, and the rows of the README."""
        words = ["commission", "--config", str(config_of(page.settings)), "--json", "out.json"]
        child = page.children.begin("reading the set-up", ("commission", object()), words, limit_s=READ_LIMIT_S)  # anew each time
        await child.over.wait()
        content: Mapping[str, Any] = await run_in_threadpool(child.result)
        return content

    async def lines(request: Request) -> Mapping[str, Any]:
        """All lines from a number on, and what stands."""
        after = max(0, int(number_in(request.query_params, "after")))
        config = page.settings.config
        configured = config is not None and config.exists()
        return {**talk.event, "said": talk.lines[after:], "config": str(config), "configured": configured}

    async def begin(request: Request) -> Mapping[str, Any]:
        """Begin, or go on where it ended."""
        talk.begin(text_in(await body_of(request), "redo", 40))
        return talk.event

    async def answer(request: Request) -> Mapping[str, Any]:
        """Answer the question that is open."""
        body = await body_of(request)
        talk.answer(int(number_in(body, "number")), text_in(body, "question"), text_in(body, "answer"))
        return talk.event

    return [
        Route("/setup/rows", answering(rows)),
        Route("/setup/talk", answering(lines)),
        Route("/setup/begin", answering(begin), methods=["POST"]),
        Route("/setup/answer", answering(answer), methods=["POST"]),
    ]
