"""Who reaches what: host, origin, token, forged requests and rates are checked before any route is asked.

One path is apart: an abort. From this computer it needs the right origin only; from elsewhere also a page that was once opened with the
token, expired or not. It is never limited in its rate.
"""

import hmac
import ipaddress
import json
import time
from collections.abc import Callable
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import HTMLResponse, JSONResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from palpd.web.log import log
from palpd.web.sessions import SESSION_S, Session, Sessions

ABORT = "/abort"
ENTER = "/enter"
OPEN = ("/static/",)
"""Paths that need no token: what every visitor's page is drawn with."""
RATE_PER_S, BURST = 20.0, 120.0
"""Requests of one browser: a page asks some 2 a second, and 30 at once when it is opened."""
TRIES_PER_S, TRIES = 0.1, 10.0
"""Wrong tokens of one address that are answered and logged singly. The right one opens the page whatever came before it."""
MOST_AT_ONCE = 64
"""Most requests under way, besides aborts and streams."""
MOST_ADDRESSES = 1000
"""Browsers whose rate is remembered; the oldest is forgotten first."""
MOST_BODY_BYTES = 262_144
"""Largest request: as the control socket takes it."""
EXPIRED = "this page is not open any more: its 12 hours are over, or it was never opened with the token; open it with the link of palpd web"
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:{pictures_from}; connect-src 'self'; "
    "font-src 'self'; frame-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
"""What a page may load, and from where: this server, and pictures of the camera where one is configured."""
HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=()",
    "Cache-Control": "no-store",
    "Connection": "close",
}
"""Headers of every answer, unless its route has set one itself. A connection carries one request (connections.py)."""


class Rates:
    """A bucket of requests for each browser, refilled at `per_s`."""

    def __init__(self, per_s: float, most: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._per_s, self._most, self._clock = per_s, most, clock
        self._left: dict[str, tuple[float, float]] = {}

    def take(self, who: str) -> bool:
        """Take one request; whether there was one left."""
        now_s = self._clock()
        left, at_s = self._left.pop(who, (self._most, now_s))
        left = min(self._most, left + (now_s - at_s) * self._per_s)
        self._left[who] = (left - 1.0 if left >= 1.0 else left, now_s)
        if len(self._left) > MOST_ADDRESSES:
            del self._left[next(iter(self._left))]
        return left >= 1.0


class Access:
    """ASGI middleware around the whole application."""

    def __init__(
        self,
        app: ASGIApp,
        sessions: Sessions,
        hosts: frozenset[str],
        cookie: str,
        entrance: Callable[[str], str],
        first: str = "/",
        pictures_from: str | None = None,
    ) -> None:
        policy = POLICY.format(pictures_from=f" {pictures_from}" if pictures_from else "")
        self._headers = {"Content-Security-Policy": policy, **HEADERS}
        self._app, self._sessions, self._hosts, self._cookie, self._entrance = app, sessions, hosts, cookie, entrance
        self._first = first
        self._at_once = 0
        self._rates, self._tries = Rates(RATE_PER_S, BURST), Rates(TRIES_PER_S, TRIES)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request that is refused here; pass all others on, with the session in `scope`."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        session = self._session(headers)
        scope["session"] = session
        scope["browser"] = browser_of(scope, headers)
        refusal = self._refusal(scope, headers, session)
        if refusal is None and scope["path"] == ENTER:
            await self._enter(scope, receive, self._with_headers(send))
        elif refusal is None and (scope["type"] == "websocket" or scope["path"] == ABORT):
            await self._app(scope, receive, self._with_headers(send))
        elif refusal is None and self._at_once >= MOST_AT_ONCE:
            sentence = f"{MOST_AT_ONCE} requests are under way, expected fewer; try again in a second"
            await self._refused(headers, sentence, 503)(scope, receive, self._with_headers(send))
        elif refusal is None:
            self._at_once += 1
            try:
                await self._app(scope, receive, self._with_headers(send))
            finally:
                self._at_once -= 1
        elif scope["type"] == "websocket":
            await receive()  # the handshake
            await send({"type": "websocket.close", "code": 4401, "reason": "refused"})
        else:
            await refusal(scope, receive, self._with_headers(send))

    def _with_headers(self, send: Send) -> Send:
        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in self._headers.items():
                    headers.setdefault(name, value)
            await send(message)

        return send_with_headers

    def _session(self, headers: Headers) -> Session | None:
        scheme, _, token = headers.get("authorization", "").partition(" ")
        if scheme.lower() == "bearer" and self._sessions.opened_by(token.strip()):
            return Session("token", "", expired=False)
        try:
            morsel = SimpleCookie(headers.get("cookie", "")).get(self._cookie)
        except CookieError:
            return None
        return self._sessions.known(morsel.value) if morsel is not None else None

    def _refusal(self, scope: Scope, headers: Headers, session: Session | None) -> Response | None:
        """The answer to a request that goes no further."""
        path, origin = scope["path"], headers.get("origin")
        if path == ABORT:
            return self._abort_refusal(scope, headers, session)
        if headers.get("host", "") not in self._hosts:
            names = ", ".join(sorted(self._hosts))
            sentence = f"this page is not served under {headers.get('host', '')[:80]!r}, expected one of {names}; see --name"
            return self._refused(headers, sentence, 421)
        changes = scope["type"] == "websocket" or scope["method"] not in ("GET", "HEAD")
        if (changes or origin is not None) and not self._own(origin) and not _is_token(session):
            return self._refused(headers, "the request comes from another page than palpd's; open palpd's own page", 403)
        token = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0] if path == "/" else ""
        if token or path == ENTER:
            return self._entered(scope, headers, token) if token else None
        who = session.id if session is not None else scope["browser"]
        if not self._rates.take(who):
            log("requests refused, too many", browser=scope["browser"], session=who)
            return self._refused(headers, f"more than {RATE_PER_S:g} requests a second came from this browser; wait some seconds", 429)
        if scope["type"] == "http" and _length(headers) > MOST_BODY_BYTES:
            sentence = f"the request has {_length(headers)} bytes, expected at most {MOST_BODY_BYTES}; send less"
            return self._refused(headers, sentence, 413)
        if path.startswith(OPEN):
            return None
        if session is None or session.expired:
            return self._refused(headers, EXPIRED, 401, expired=True)
        if scope["type"] == "http" and changes and not _is_token(session) and not _same(headers.get("x-palpd-csrf", ""), session.csrf):
            return self._refused(headers, "the request does not carry the mark of an open page; reload the page", 403)
        return None

    def _abort_refusal(self, scope: Scope, headers: Headers, session: Session | None) -> Response | None:
        if scope["type"] != "http" or scope["method"] != "POST":
            return self._refused(headers, "an abort is sent with POST", 405)
        if not self._own(headers.get("origin")) and not _is_token(session):
            return self._refused(headers, "the abort comes from another page than palpd's; open palpd's own page, or use palpd abort", 403)
        if not is_loopback(scope) and session is None:
            return self._refused(
                headers, "an abort from another computer needs a page that was once opened with the token; use palpd abort", 401
            )
        return None

    def _own(self, origin: str | None) -> bool:
        scheme, _, host = (origin or "").partition("://")
        return scheme in ("http", "https") and host in self._hosts

    def _entered(self, scope: Scope, headers: Headers, token: str) -> Response:
        """The answer to a token: a cookie and an address without it, or a refusal.

        Only wrong tokens are counted. A page of another site can send as many as it likes, and must not lock the operator out.
        """
        if not self._sessions.opened_by(token):
            if not self._tries.take(scope["client"][0] if scope.get("client") else ""):
                return self._refused(headers, "too many wrong tokens came from this address; the right one still opens the page", 429)
            log("wrong token", browser=scope["browser"])
            sentence = "the token is not the one of this page; palpd web prints the link, and keeps the token in its token file"
            return self._refused(headers, sentence, 401)
        cookie = self._sessions.begin()
        log("page opened", browser=scope["browser"], session=cookie.partition(".")[0])
        answer = RedirectResponse(self._first, 303)
        answer.set_cookie(self._cookie, cookie, max_age=int(30 * SESSION_S), httponly=True, samesite="strict", path="/")
        return answer

    async def _enter(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Take the token from the form of the entrance page."""
        body = bytearray()
        more = True
        while more and len(body) <= 4096:
            message = await receive()
            body += message.get("body", b"")
            more = message.get("more_body", False)
        token = parse_qs(body.decode("latin-1")).get("token", [""])[0]
        await self._entered(scope, Headers(scope=scope), token)(scope, receive, send)

    def _refused(self, headers: Headers, sentence: str, code: int, **more: bool) -> Response:
        """A refusal: a page for a browser that opens an address, JSON for a program."""
        if "text/html" in headers.get("accept", ""):
            return HTMLResponse(self._entrance(sentence), code)
        return JSONResponse({"ok": False, "error": sentence, **more}, code)


def browser_of(scope: Scope, headers: Headers) -> str:
    """What the log calls a browser.

    Args:
        scope: Of the request.
        headers: Of the request.

    Returns:
        Its address and what it says of itself, cut short.
    """
    address = scope["client"][0] if scope.get("client") else "unknown"
    agent = "".join(letter for letter in headers.get("user-agent", "no name") if letter.isprintable())[:120]
    return f"{address} {agent}"


def is_loopback(scope: Scope) -> bool:
    """Whether a request comes from this computer."""
    try:
        address = ipaddress.ip_address(scope["client"][0] if scope.get("client") else "")
    except ValueError:
        return False
    mapped = getattr(address, "ipv4_mapped", None)
    return (mapped or address).is_loopback


def _is_token(session: Session | None) -> bool:
    """Whether a program shows the token itself with each request, which no other page can make a browser do."""
    return session is not None and session.id == "token"


def _same(given: str, expected: str) -> bool:
    return hmac.compare_digest(given.encode(), expected.encode())


def _length(headers: Headers) -> int:
    text = headers.get("content-length", "0")
    return int(text) if text.isdigit() else 0


async def json_body(receive: Receive) -> dict[str, Any] | None:
    """Read a request's JSON object, at most `MOST_BODY_BYTES` of it; None where it is something else."""
    body, more = bytearray(), True
    while more:
        message = await receive()
        if message["type"] == "http.disconnect":
            return None
        body += message.get("body", b"")
        more = message.get("more_body", False)
        if len(body) > MOST_BODY_BYTES:
            return None
    try:
        content = json.loads(body or b"{}")
    except (ValueError, RecursionError):
        return None
    return content if isinstance(content, dict) else None
