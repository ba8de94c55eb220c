"""The tab Set-up: what `palpd setup` has done on this cell, in the words of `palpd commission`. It reads only."""

from collections.abc import Mapping
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.routing import BaseRoute, Route

from palpd.web.answers import answering
from palpd.web.page import Page
from palpd.web.plan_pages import config_of

READ_LIMIT_S = 60.0
"""Longest time of `palpd commission`, which takes a second."""


def routes(page: Page) -> list[BaseRoute]:
    """The route of the tab Set-up."""

    async def rows(_: Request) -> Mapping[str, Any]:
        """The steps with their findings, their order, and the rows of the README."""
        words = ["commission", "--config", str(config_of(page.settings)), "--json", "out.json"]
        child = page.children.begin("reading the set-up", ("commission", object()), words, limit_s=READ_LIMIT_S)  # anew each time
        await child.over.wait()
        content: Mapping[str, Any] = await run_in_threadpool(child.result)
        return content

    return [Route("/setup/rows", answering(rows))]
