"""The page's link to the service: what it publishes comes in, requests go out. Both in threads, so that a stuck service stops no page."""

import asyncio
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from palpd.daemon.socket_client import ARM_PATIENCE_S, PATIENCE_S, ControlAnswer, ControlRequest, NoAnswer, ask, follow
from palpd.errors import Refused

RETRY_S = 0.5
"""Pause before a lost link to the service is sought again."""
THREADS = 16
"""Most requests under way, besides aborts: an `arm` takes seconds, and 16 pages may ask at once."""

Event = dict[str, Any]


class ServiceLink:
    """Follows the service and passes requests on. `status` is its last status; `lost` says why there is none, and is empty otherwise."""

    def __init__(self, socket: Path) -> None:
        self.socket = socket
        self.status: Event | None = None
        self.lost = "the page has not reached the service yet"
        self._pool = ThreadPoolExecutor(THREADS, "request")
        self._abort_pool = ThreadPoolExecutor(1, "abort")
        self._abort_under_way: asyncio.Task[ControlAnswer] | None = None
        self._abort_queued: asyncio.Task[ControlAnswer] | None = None
        self._over = threading.Event()

    def follow(self, on_event: Callable[[Event], None]) -> None:
        """Follow the service in a thread of its own until `close`; `on_event` is called in the event loop that runs now.

        An event is one of docs/jobs.md, or `{"event": "lost", "reason": sentence}`.
        """
        loop = asyncio.get_running_loop()

        def pass_on(event: Event) -> None:
            if event["event"] == "status":
                self.status, self.lost = event, ""
            elif event["event"] == "lost":
                self.status, self.lost = None, event["reason"]
            on_event(event)

        def publish(event: Event) -> None:
            if not self._over.is_set():
                loop.call_soon_threadsafe(pass_on, event)

        following = (self.socket, publish, self._over, RETRY_S)
        threading.Thread(target=follow, args=following, daemon=True, name="follow").start()

    async def ask(self, request: ControlRequest) -> ControlAnswer:
        """Send a request; the answer's `error` holds the refusal, in the words of the service; `unreached` says that it has not spoken."""
        patience_s = ARM_PATIENCE_S if request["do"] in ("arm", "check") else PATIENCE_S
        return await asyncio.get_running_loop().run_in_executor(self._pool, _answer, self.socket, request, patience_s)

    async def abort(self) -> ControlAnswer:
        """Abort. However many ask at once, one abort is under way, and one more follows for all who asked since it was sent."""
        if self._abort_queued is None:
            self._abort_queued = asyncio.create_task(self._abort_after(self._abort_under_way))
        return await asyncio.shield(self._abort_queued)

    async def _abort_after(self, before: asyncio.Task[ControlAnswer] | None) -> ControlAnswer:
        if before is not None and not before.done():
            await asyncio.wait([before])
        self._abort_under_way, self._abort_queued = self._abort_queued, None
        request: ControlRequest = {"do": "abort"}
        return await asyncio.get_running_loop().run_in_executor(self._abort_pool, _answer, self.socket, request, PATIENCE_S)

    def close(self) -> None:
        """Follow no longer."""
        self._over.set()
        for pool in (self._pool, self._abort_pool):
            pool.shutdown(wait=False, cancel_futures=True)


def _answer(socket: Path, request: ControlRequest, patience_s: float) -> ControlAnswer:
    try:
        return ask(socket, request, patience_s)
    except NoAnswer as silence:
        return {"ok": False, "error": str(silence), "unreached": True}
    except Refused as refused:
        return {"ok": False, "error": str(refused)}
