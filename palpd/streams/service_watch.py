"""What the service says, kept up to date by a thread; it asks again where the service goes and comes."""

import threading
from collections import deque
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from palpd.daemon.socket_client import follow

AGAIN_S = 1.0
"""Pause before a service that does not answer is asked again."""
MOST_EVENTS = 1000
"""Events that are kept until somebody takes them; older ones are dropped."""

Status = Mapping[str, Any]
"""A status of docs/jobs.md."""


class ServiceWatch:
    """Watches the service at a control socket from a thread of its own until `close`.

    Attributes:
        status: The newest status; None while no service answers.
        reason: Why none answers; empty while one does.
    """

    def __init__(self, path: Path) -> None:
        self.status: Status | None = None
        self.reason = ""
        self._events: deque[dict[str, Any]] = deque(maxlen=MOST_EVENTS)
        self._over = threading.Event()
        self._thread = threading.Thread(target=follow, args=(path, self._take, self._over, AGAIN_S), name="service watch", daemon=True)
        self._thread.start()

    def events(self) -> Iterator[dict[str, Any]]:
        """Take the events of jobs since the last call, the oldest first."""
        while self._events:
            yield self._events.popleft()

    def close(self) -> None:
        """End the thread."""
        self._over.set()
        self._thread.join()

    def _take(self, event: dict[str, Any]) -> None:
        kind = event.get("event")
        if kind == "status":
            self.status, self.reason = event, ""
        elif kind == "lost":
            self.status, self.reason = None, event["reason"]
        else:
            self._events.append(event)
