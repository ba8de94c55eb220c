"""Answers of the page's routes: JSON that every browser can read, and a refusal as one sentence, in the words of the terminal."""

import json
import math
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from starlette.requests import Request
from starlette.responses import Response

from palpd.documents import finite_json
from palpd.errors import BadInput, PalpdError
from palpd.web.access import json_body

MOST_LETTERS = 2000
"""Longest text of a request, but for a plan."""

Endpoint = Callable[[Request], Awaitable[Response]]


def answering(work: Callable[[Request], Awaitable[Mapping[str, Any] | Response]]) -> Endpoint:
    """Make a route of a function that returns data, a response, or raises a refusal.

    Returns:
        The route's endpoint: `{"ok": true, ...}`, or `{"ok": false, "error": sentence}`.
    """

    async def endpoint(request: Request) -> Response:
        try:
            content = await work(request)
        except PalpdError as error:
            return as_json({"ok": False, "error": str(error)}, 400)
        return content if isinstance(content, Response) else as_json({"ok": True, **content})

    return endpoint


def as_json(content: Mapping[str, Any], code: int = 200) -> Response:
    """Make a response of data.

    Args:
        content: Dictionaries, lists, texts and numbers.
        code: Status of the response.

    Returns:
        The response. Bytes of a name that are no text are escaped, and a number that JSON does not know is null.
    """
    return Response(json.dumps(finite_json(content)), code, media_type="application/json")


async def body_of(request: Request) -> dict[str, Any]:
    """The JSON object that a request holds. Raises BadInput."""
    body = await json_body(request.receive)
    if body is None:
        raise BadInput("the request holds no JSON object of at most 256 kB; reload the page")
    return body


def text_in(body: Mapping[str, Any], name: str, most: int = MOST_LETTERS) -> str:
    """A text of a request.

    Args:
        body: The request's data.
        name: Its key.
        most: Most letters.

    Returns:
        The text; empty where it is not given.

    Raises:
        BadInput: It is no text, or too long.
    """
    text = body.get(name, "")
    if not isinstance(text, str) or len(text) > most:
        raise BadInput(f"{name} is no text of at most {most} letters; correct it")
    return text


def number_in(body: Mapping[str, Any], name: str) -> float:
    """A number of a request or of an address.

    Args:
        body: The request's data, or the queries of its address.
        name: Its key.

    Raises:
        BadInput: It is no finite number.
    """
    try:
        value = float(body.get(name, ""))
    except (TypeError, ValueError):
        value = math.nan
    if not math.isfinite(value):
        raise BadInput(f"{name} is {str(body.get(name, 'not given'))[:40]!r}, expected a number")
    return value
