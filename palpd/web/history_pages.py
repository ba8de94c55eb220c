"""The tabs Runs and Checks: the list of the runs, one run with its report, two side by side, trends, the diagnosis of a run, and charts."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import BaseRoute, Route

from palpd.errors import BadInput
from palpd.files import copy_file
from palpd.history.stored import DIAGNOSIS, beside, report_path
from palpd.web import looking_back, shell
from palpd.web.answers import answering, body_of, number_in, text_in
from palpd.web.calculations import download_response, report_response
from palpd.web.page import Page

INFO_LIMIT_S, REPORT_LIMIT_S, DIAGNOSIS_LIMIT_S = 300.0, 300.0, 1800.0
"""Longest times of the commands: a report of an hour takes some 20 s, a diagnosis some minutes."""
MOST_LETTERS = 200
"""Longest text of a filter."""


class HistoryPages:
    """The routes of both tabs."""

    def __init__(self, page: Page) -> None:
        self._runs, self._aside, self._children = page.settings.runs, page.aside, page.children

    async def _recording(self, key: str) -> Path:
        return await run_in_threadpool(looking_back.recording_of, self._runs, key)

    async def listed(self, request: Request) -> Mapping[str, Any]:
        """The runs that fit a filter."""
        return await self._aside.compute(looking_back.listed, self._runs, _query(request))

    async def trend(self, request: Request) -> Mapping[str, Any]:
        """A site over the days."""
        return await self._aside.compute(looking_back.trend, self._runs, _query(request))

    async def checks(self, _: Request) -> Mapping[str, Any]:
        """The morning checks with their charts."""
        return await self._aside.compute(looking_back.checks, self._runs)

    async def read(self, request: Request) -> Mapping[str, Any]:
        """Begin to read the facts and the course of a run."""
        recording = await self._recording(text_in(await body_of(request), "run"))
        words = ["info", "--json", "out.json", "--course", "course.npy", "--", str(recording)]
        return self._children.begin("reading the recording", ("info", *stamp_of(recording)), words, limit_s=INFO_LIMIT_S).as_json

    async def report(self, request: Request) -> Mapping[str, Any]:
        """Say where the report of a run stands, or begin to write it; with `beside` that of two runs."""
        body = await body_of(request)
        key, other = text_in(body, "run"), text_in(body, "beside")
        recording = await self._recording(key)
        second = await self._recording(other) if other else None
        if second is None and await run_in_threadpool(_is_current, recording):
            return {"report": f"/runs/report?run={quote(key)}"}
        words = ["report", "--out", "report.html", "--folder", str(self._runs)]
        words += ["--beside", str(second)] if second is not None else []
        about = ("report", *stamp_of(recording), *(stamp_of(second) if second is not None else ()))
        return self._children.begin("writing the report", about, [*words, "--", str(recording)], limit_s=REPORT_LIMIT_S).as_json

    async def stored_report(self, request: Request) -> Response:
        """The report that stands beside a recording."""
        path = report_path(await self._recording(request.query_params.get("run", "")))
        return await report_response(path, request, path.name)

    async def download(self, request: Request) -> Response:
        """The recording itself."""
        recording = await self._recording(request.query_params.get("run", ""))
        return download_response(recording, recording.name)

    async def diagnose(self, request: Request) -> Mapping[str, Any]:
        """Begin to diagnose a site of a run."""
        body = await body_of(request)
        recording, site = await self._recording(text_in(body, "run")), text_in(body, "site")
        words = ["diagnose", "--json", "out.json", "--report", "report.html", "--progress", *([f"--site={site}"] if site else [])]
        about = ("diagnose", *stamp_of(recording), site)
        return self._children.begin("the diagnosis", about, [*words, "--", str(recording)], limit_s=DIAGNOSIS_LIMIT_S).as_json

    async def keep(self, request: Request) -> Mapping[str, Any]:
        """Put a diagnosis beside its recording, where the trend finds it."""
        body = await body_of(request)
        child = self._children.numbered(int(number_in(body, "number")))
        recording = await self._recording(text_in(body, "run"))
        if child.key[:-1] != ("diagnose", *stamp_of(recording)):
            raise BadInput(f"calculation {child.number} is no diagnosis of this run; diagnose it again")
        child.refuse_unless_done()
        site = child.key[-1]
        target = beside(recording, f"{f'.{site}' if site else ''}{DIAGNOSIS}")
        await run_in_threadpool(copy_file, child.folder / "out.json", target)
        return {"kept": str(target)}

    async def remark(self, request: Request) -> Mapping[str, Any]:
        """Tag a run, take a tag away, or note something."""
        body = await body_of(request)
        recording = await self._recording(text_in(body, "run"))
        tags, untag = ([text] if (text := text_in(body, name)) else [] for name in ("tag", "untag"))
        return await self._aside.compute(looking_back.remarked, recording, tags, untag, text_in(body, "note"))


def routes(page: Page) -> list[BaseRoute]:
    """The routes of the tabs Runs and Checks."""
    of = HistoryPages(page)
    return [
        Route("/runs/view", partial(shell.page, part="recorded", title="palpd: a run", tab="runs")),
        Route("/runs/trend", partial(shell.page, part="trend", title="palpd: trend", tab="runs")),
        Route("/runs/list", answering(of.listed)),
        Route("/runs/trend-of", answering(of.trend)),
        Route("/checks/list", answering(of.checks)),
        Route("/runs/read", answering(of.read), methods=["POST"]),
        Route("/runs/make-report", answering(of.report), methods=["POST"]),
        Route("/runs/report", answering(of.stored_report)),
        Route("/runs/recording", answering(of.download)),
        Route("/runs/diagnose", answering(of.diagnose), methods=["POST"]),
        Route("/runs/keep", answering(of.keep), methods=["POST"]),
        Route("/runs/remark", answering(of.remark), methods=["POST"]),
    ]


def _query(request: Request) -> dict[str, str]:
    return {name: value[:MOST_LETTERS] for name, value in request.query_params.items()}


def stamp_of(recording: Path) -> tuple[str, int, int]:
    """Tells whether a recording is still the one that was read. Raises BadInput where it is gone."""
    try:
        status = recording.stat()
    except OSError as error:
        raise BadInput(f"{recording} cannot be read ({error.strerror}); palpd runs lists what is there") from error
    return str(recording), status.st_size, status.st_mtime_ns


def _is_current(recording: Path) -> bool:
    """Whether the report beside a recording is newer than the recording."""
    try:
        return report_path(recording).stat().st_mtime_ns >= recording.stat().st_mtime_ns
    except OSError:
        return False
