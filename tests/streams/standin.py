"""A service that stands in: a real control socket, a real ring, and ticks that a test writes."""

import os
import time
from collections import deque
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from palpd.daemon.control_socket import ControlSocket, Watching
from palpd.recording.ring import Ring, Rows
from palpd.testing.processes import over_and_over
from palpd.tick import ROW, Phase

RATE_Hz = 125.0
FZ_N, MODEL_N = 3.0, 0.5
"""Tared force of every frame, and the model's share of it."""


def ticks(number: int, first: int = 0) -> Rows:
    """Ticks of two frames each, the newest of now; the force grows by 0.01 N a tick."""
    rows = np.zeros(number, ROW)
    index = first + np.arange(number)
    rows["index"] = index
    rows["now_s"] = time.monotonic() + (np.arange(number) - number + 1) / RATE_Hz
    rows["planned_s"] = rows["now_s"] - 1e-4
    rows["robot_t_s"] = rows["now_s"] - 0.004
    rows["work_us"] = 900.0
    rows["frames"] = 2
    rows["frame_t_s"][:, :2] = rows["now_s"][:, None] - [0.002, 0.001]
    rows["tared"][:, :2, 2] = FZ_N + 0.01 * index[:, None]
    rows["inertial_N"][:, :2] = MODEL_N
    rows["force_N"] = FZ_N - MODEL_N
    rows["absolute_N"] = 7.0
    rows["phase"] = Phase.PRESS
    rows["connected"] = 1
    return rows


class StandIn:
    """A service as a watcher sees it."""

    def __init__(self, path: Path) -> None:
        self.ring = Ring.create(RATE_Hz)
        self.state: dict[str, Any] = {
            "state": "running",
            "latched": None,
            "pid": os.getpid(),
            "ring": self.ring.name,
            "controls": None,
            "active": None,
        }
        self._events: deque[dict[str, Any]] = deque()
        self._socket = ControlSocket(path, lambda _: Watching({"ok": True, "event": "status", **self.state}))  # type: ignore[typeddict-item]

    def publish(self, event: str, **more: Any) -> None:
        """Send an event to all watchers; a status is also the first event of later watchers."""
        if event == "status":
            self.state |= more
            more = self.state
        self._events.append({"event": event, **more})

    def write(self, rows: Rows) -> None:
        for row in rows:
            self.ring.write(row)

    def close(self) -> None:
        self._socket.close()
        self.ring.close()

    def serve(self) -> None:
        self._socket.poll(0.01)
        while self._events:
            self._socket.publish(self._events.popleft())


@contextmanager
def standing_in(path: Path) -> Iterator[StandIn]:
    with closing(StandIn(path)) as service, over_and_over(service.serve):
        yield service
