"""The tab Resolve: what the conversation of `palpd resolve` shows besides the requests to the service, which are those of controls.py."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import BaseRoute, Route

from palpd.errors import BadInput, Refused
from palpd.web.answers import answering, body_of, text_in
from palpd.web.calculations import report_response
from palpd.web.page import Page
from palpd.web.plan_pages import REHEARSAL_LIMIT_S, config_of

ENRICHED, REPORT = "enriched.yaml", "gap.html"
"""Files of a job's folder: the cell with what is named so far, and the page of the diagnosis."""


class ResolvePages:
    """The routes of the tab."""

    def __init__(self, page: Page) -> None:
        self._page = page

    async def _job(self, name: str) -> Mapping[str, Any]:
        """A job that the service knows. Raises Refused, in the words of the service."""
        answer = await self._page.link.ask({"do": "job", "id": name})
        if not answer["ok"]:
            raise Refused(answer["error"])
        return {**answer}

    def _folder(self, job: Mapping[str, Any]) -> Path:
        return self._page.settings.runs / Path(str(job["id"])).name

    async def report(self, request: Request) -> Response:
        """The page of a job's newest diagnosis."""
        job = await self._job(request.query_params.get("id", "")[:200])
        return await report_response(self._folder(job) / REPORT, request, f"{job['id']}.html")

    async def rehearse(self, request: Request) -> Mapping[str, Any]:
        """Begin to draw a proposed motion on the simulated cell, with what the job has named so far."""
        job = await self._job(text_in(await body_of(request), "id"))
        if (proposal := job.get("proposal")) is None:
            raise BadInput(f"job {job['id']} proposes no motion now; look at its log")
        folder, config = self._folder(job), config_of(self._page.settings)
        plan, enriched = folder / f"plan-{job['runs'] + 1}.yaml", folder / ENRICHED
        if not plan.exists():
            raise BadInput(f"{plan} cannot be read here, so the motion is not drawn; its figures stand above")
        cell = ["--cell", str(enriched.absolute())] if enriched.exists() else ["--configured-cell"]
        words = ["sim", "--plan", str(plan.absolute()), "--config", str(config), *cell, "--json", "out.json", "--progress"]
        about = ("proposal", job["id"], proposal["number"])
        return self._page.children.begin("the rehearsal", about, words, limit_s=REHEARSAL_LIMIT_S).as_json


def routes(page: Page) -> list[BaseRoute]:
    """The routes of the tab Resolve."""
    of = ResolvePages(page)
    return [
        Route("/resolve/report", answering(of.report)),
        Route("/resolve/rehearse", answering(of.rehearse), methods=["POST"]),
    ]
