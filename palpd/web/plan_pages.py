"""The tab Plan: a plan is judged, previewed and rehearsed before it starts, by the commands of the terminal and in their words."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import BaseRoute, Route

from palpd.errors import BadInput, Refused
from palpd.files import MOST_YAML_BYTES
from palpd.web.answers import answering, as_json, body_of, text_in
from palpd.web.page import Page, PageSettings

CHECK_LIMIT_S, REHEARSAL_LIMIT_S = 60.0, 900.0
"""Longest times of the commands. A rehearsal is some 30 times faster than the plan."""
PLAN = "plan.yaml"
"""File that the commands read. They run where it stands, so a refusal names it as the terminal does."""


class PlanPages:
    """The routes of the tab."""

    def __init__(self, page: Page) -> None:
        self._settings, self._children = page.settings, page.children

    async def check(self, request: Request) -> Mapping[str, Any] | Response:
        """Judge a plan as `palpd check-config` does, and predict how far a force would run past its limit. A refusal names its keys."""
        text, config = await _plan_in(request), config_of(self._settings)
        words = ["check-config", str(config), "--plan", PLAN, "--json", "out.json", "--faults"]
        about = ("check", text, _written_ns(config))
        child = self._children.begin("the check of the plan", about, words, limit_s=CHECK_LIMIT_S, files={PLAN: text})
        await child.over.wait()
        content: Mapping[str, Any] = await run_in_threadpool(child.result)
        return as_json({"ok": False, "error": content["refusal"], **content}, 400) if "refusal" in content else content

    async def rehearse(self, request: Request) -> Mapping[str, Any]:
        """Begin to carry out a plan on the simulated cell that the configuration states."""
        text, config = await _plan_in(request), config_of(self._settings)
        words = ["sim", "--plan", PLAN, "--config", str(config), "--configured-cell", "--json", "out.json", "--progress"]
        about = ("rehearsal", text, _written_ns(config))
        return self._children.begin("the rehearsal", about, words, limit_s=REHEARSAL_LIMIT_S, files={PLAN: text}).as_json


def routes(page: Page) -> list[BaseRoute]:
    """The routes of the tab Plan."""
    of = PlanPages(page)
    return [
        Route("/plan/check", answering(of.check), methods=["POST"]),
        Route("/plan/rehearse", answering(of.rehearse), methods=["POST"]),
    ]


def config_of(settings: PageSettings) -> Path:
    """The configuration of the cell. Raises Refused where the page was started without one, or a set-up has not written it yet."""
    if settings.config is None:
        raise Refused("the page does not know the configuration of the cell; start it with palpd web --config config.yaml")
    if settings.setup is not None and not settings.config.exists():
        raise Refused(f"there is no {settings.config} yet; Begin in the tab Set-up asks for the robot and writes it")
    return settings.config.absolute()


async def _plan_in(request: Request) -> str:
    return text_in(await body_of(request), "yaml", most=MOST_YAML_BYTES)


def _written_ns(config: Path) -> int:
    """When the configuration was written: a plan is judged anew by another one. Raises BadInput where it is gone."""
    try:
        return config.stat().st_mtime_ns
    except OSError as error:
        raise BadInput(f"{config} cannot be read ({error.strerror}); give the path of a file that exists") from error
