"""What an operator asks for: each request goes to the control socket as it is, and its answer comes back in the service's own words."""

import asyncio
from typing import Any, cast

from starlette.requests import Request
from starlette.responses import JSONResponse
from starlette.routing import BaseRoute, Route

from palpd.daemon.socket_client import ControlRequest
from palpd.errors import PalpdError
from palpd.web.access import ABORT, json_body
from palpd.web.log import log
from palpd.web.page import Page

KEYS = {
    "status": (),
    "check": ("lease",),
    "arm": ("lease",),
    "start": ("lease", "plan", "place"),
    "pause": ("lease",),
    "resume": ("lease",),
    "retract": ("lease",),
    "level-test": ("lease",),
    "clear": ("lease", "cause"),
    "take": ("name", "force"),
    "renew": ("lease",),
    "release": ("lease",),
    "begin": ("lease", "program", "arguments"),
    "decide": ("lease", "id", "number", "agree"),
    "cancel": ("id",),
    "jobs": (),
    "job": ("id",),
    "plans": ("name",),
    "keep-plan": ("lease", "name", "plan", "was", "rehearsal"),
    "forget-plan": ("lease", "name", "was"),
}
"""Requests of docs/jobs.md that a page may send, and their keys."""
UNLOGGED = ("status", "jobs", "job", "plans", "renew")
"""Requests that change nothing, and come often."""


def routes(page: Page) -> list[BaseRoute]:
    """The requests, the plan that the page offers first, and the abort."""

    async def abort(request: Request) -> JSONResponse:
        session = request.scope["session"]
        log("abort", browser=request.scope["browser"], session=session.id if session else None, expired=bool(session and session.expired))
        setup, answer = await asyncio.gather(page.talk.interrupt(), page.link.abort())
        if setup is not None and (not setup["ok"] or not answer["ok"]):  # a set-up opens the devices itself: no service need be there
            answer = setup
        log("abort answered", browser=request.scope["browser"], **_ending(answer))
        return JSONResponse(answer)

    async def do(request: Request) -> JSONResponse:
        what = request.path_params["what"]
        if what not in KEYS:
            return JSONResponse({"ok": False, "error": f"{what[:32]!r} is no request of the page; known: {', '.join(KEYS)}"}, 404)
        content = await json_body(request.receive)
        if content is None:
            return JSONResponse({"ok": False, "error": "the request is not a JSON object; reload the page"}, 400)
        try:
            await _read_plan(what, content)
        except PalpdError as error:
            return JSONResponse({"ok": False, "error": str(error)})
        fields = {key: content[key] for key in KEYS[what] if content.get(key) is not None}
        answer = await page.link.ask(cast(ControlRequest, {"do": what, **fields}))
        if what not in UNLOGGED:
            session = request.scope["session"].id
            name = str(content.get("name", ""))[:64]
            log("request", do=what, browser=request.scope["browser"], session=session, name=name, **_ending(answer))
        return JSONResponse(answer)

    async def first_plan(_: Request) -> JSONResponse:
        """The plan that `palpd web` was given, as text."""
        path = page.settings.plan
        if path is None:
            return JSONResponse({"ok": True, "name": None})
        from palpd.documents import parse_yaml
        from palpd.files import read_text

        try:
            text = read_text(path)
            parse_yaml(text, str(path))
            return JSONResponse({"ok": True, "name": path.name, "text": text})
        except PalpdError as error:
            return JSONResponse({"ok": False, "error": str(error)})

    return [
        Route(ABORT, abort, methods=["POST"]),
        Route("/do/{what}", do, methods=["POST"]),
        Route("/first-plan", first_plan),
    ]


async def _read_plan(what: str, content: dict[str, Any]) -> None:
    """Turn the text of a plan file into keys and values, as `palpd start` does. Raises ConfigError."""
    from palpd.documents import parse_yaml  # imported here: yaml takes 3 MB, and most requests are no plan

    text = content.pop("text", None)
    if what in ("start", "keep-plan") and isinstance(text, str):
        name = "".join(letter for letter in str(content.pop("file", "plan.yaml")) if letter.isprintable())[:80]
        content["plan"] = (await asyncio.to_thread(parse_yaml, text, name)).keys_and_values()


def _ending(answer: Any) -> dict[str, Any]:
    """What the log keeps of an answer: never a lease."""
    return {"ok": answer.get("ok"), "refusal": answer.get("error"), "state": answer.get("state")}
