"""One stream for all pages: frames of the ring, statuses and events of the service, and the moduli of the sites as they come.

Nobody waits for a page: one that does not read loses frames, and its connection once it has fallen far behind.
"""

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from typing import Any

from starlette.routing import BaseRoute, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from palpd.web.aside import Aside
from palpd.web.log import log
from palpd.web.service_link import Event, ServiceLink
from palpd.web.site_moduli import LiveModuli
from palpd.web.ticks import TickStream, as_line

FRAME_S = 1.0 / 32.0
"""Time between two frames of a run."""
BEAT_S = 0.1
"""Longest silence of the stream: a page that hears nothing for 0.24 s says that the link is lost."""
MOST_WAITING = 64
"""Frames that wait for a page: two seconds. One that is further behind is dropped, and opens its link anew."""
MOST_PAGES = 32
"""Most pages at a time."""
BESIDE = ("retract", "level_test")
"""Runs that leave charts, sites and map of the palpation before on the page."""
FULL = f"{MOST_PAGES} pages are open already, expected fewer; close one of them"


class Live:
    """The stream. `pages` are the queues of all open pages."""

    def __init__(self, link: ServiceLink, aside: Aside) -> None:
        self.link = link
        self.ticks = TickStream()
        self.moduli = LiveModuli(aside, self.publish)
        self.pages: dict[int, asyncio.Queue[str | None]] = {}
        self.greetings: list[Callable[[], Event]] = []  # what else a page receives first
        self._sent_s = 0.0

    def publish(self, event: Event) -> None:
        """Send an event to all pages."""
        if not self.pages:
            return
        line = json.dumps(event, separators=(",", ":"))
        self._sent_s = asyncio.get_running_loop().time()
        for number, queue in list(self.pages.items()):
            try:
                queue.put_nowait(line)
            except asyncio.QueueFull:
                del self.pages[number]
                while not queue.empty():
                    queue.get_nowait()
                queue.put_nowait(None)

    def hear(self, event: Event) -> None:
        """Take an event of the service."""
        if event["event"] == "status":
            self.ticks.watch(event.get("ring"))
            self.ticks.beside = event["state"] == "checking" or event.get("job") in BESIDE
            self.moduli.hear(event)
        elif event["event"] == "lost":
            self.ticks.watch(None)
        self.publish(event)

    async def run(self) -> None:
        """Read the ring and send frames until cancelled."""
        loop = asyncio.get_running_loop()
        while True:
            points = self.ticks.read()
            if points or loop.time() - self._sent_s > BEAT_S:
                self.publish(as_line(points, self.ticks.health, run=self.ticks.run))
            await asyncio.sleep(FRAME_S)

    def greeting(self) -> list[Event]:
        """What a page receives first: where everything stands."""
        service = self.link.status or {"event": "lost", "reason": self.link.lost}
        backlog = as_line(list(self.ticks.points), self.ticks.health, run=self.ticks.run, readable=self.ticks.readable)
        return [*(greet() for greet in self.greetings), service, backlog, self.moduli.event()]


def routes(live: Live) -> list[BaseRoute]:
    """The stream."""

    async def stream(socket: WebSocket) -> None:
        await socket.accept()
        if len(live.pages) >= MOST_PAGES:
            await socket.send_text(json.dumps({"event": "refused", "reason": FULL}))
            await socket.close(4429)
            return
        queue: asyncio.Queue[str | None] = asyncio.Queue(MOST_WAITING)
        live.pages[id(queue)] = queue
        log("page follows", browser=socket.scope["browser"], session=socket.scope["session"].id, pages=len(live.pages))
        sender = asyncio.create_task(_send(socket, queue, live.greeting()))
        try:
            while True:
                await socket.receive_text()  # a page sends nothing; this only learns that it has gone
        except (WebSocketDisconnect, KeyError, RuntimeError):
            pass
        finally:
            live.pages.pop(id(queue), None)
            sender.cancel()

    return [WebSocketRoute("/live", stream)]


async def _send(socket: WebSocket, queue: "asyncio.Queue[str | None]", greeting: list[dict[str, Any]]) -> None:
    with suppress(WebSocketDisconnect, RuntimeError):
        for event in greeting:
            await socket.send_text(json.dumps(event, separators=(",", ":")))
        while (line := await queue.get()) is not None:
            await socket.send_text(line)
    if socket.client_state == WebSocketState.CONNECTED:
        with suppress(RuntimeError):
            await socket.close(4408)


@asynccontextmanager
async def background(live: Live) -> AsyncIterator[None]:
    """Follow the service and read the ring while the server runs."""
    live.link.follow(live.hear)
    task = asyncio.create_task(live.run())
    try:
        yield
    finally:
        task.cancel()
        live.link.close()
