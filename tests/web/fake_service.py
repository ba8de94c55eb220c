"""A control socket that answers what a test wants, and a ring with ticks that a test writes: the service as the page sees it."""

import json
import socket
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from palpd.daemon.what_now import Standing, what_now
from palpd.recording.ring import Ring
from palpd.tick import ROW, Mode, Phase

RATE_HZ = 125.0


class FakeService:
    """Listens at `path`. `requests` are what it was asked; `answers` gives answers by command; `status` is the status."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.ring = Ring.create(RATE_HZ)
        self.requests: list[dict[str, Any]] = []
        self.answers: dict[str, dict[str, Any]] = {}
        self.status: dict[str, Any] = {
            "state": "disarmed", "latched": None, "pid": 1, "cell": None, "controls": None, "ring": self.ring.name, "active": None,
            "limits": {"contact_N": 12.0, "absolute_N": 25.0}, "now": what_now(Standing(reference=True)).published,
        }  # fmt: skip
        self._over = False
        self.held = threading.Event()
        self.held.set()
        self._watchers: list[socket.socket] = []
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listener.bind(str(path))
        self._listener.listen(64)
        threading.Thread(target=self._accept, daemon=True).start()

    def asked(self, what: str) -> list[dict[str, Any]]:
        """All requests of that kind so far."""
        return [request for request in self.requests if request["do"] == what]

    def publish(self, event: dict[str, Any]) -> None:
        """Send an event to all watchers; a status is also the answer to `status` from now on."""
        if event["event"] == "status":
            self.status = {key: value for key, value in event.items() if key != "event"}
        for watcher in self._watchers:
            with suppress(OSError):
                watcher.sendall(json.dumps(event).encode() + b"\n")

    def stand(self, standing: Standing, **more: Any) -> None:
        """Publish that this stands, in the words of the real service; `more` is what a status holds besides."""
        kept = {key: self.status[key] for key in ("pid", "cell", "ring", "limits")}
        now = what_now(standing).published
        run = {"job": standing.run, "activity": now["sentence"], "force_N": standing.force_N, "z_m": 0.1, "depth_m": standing.depth_m,
               "tick": 7, "site": 0} if standing.busy and standing.run is not None else {}  # fmt: skip
        if standing.phase is not None:
            run["phase"] = standing.phase.name.lower()
        state = {"latched": "disarmed", "pressed": "disarmed", "paused": "running"}.get(now["state"], now["state"])
        latched = standing.latch[1] if standing.latch is not None else None
        status = {"state": state, "now": now, "latched": latched, "controls": None, "active": None, **kept, **run, **more}
        self.publish({"event": "status", **status})

    def write(self, number: int, t_s: float, force_N: float = 0.0, **fields: Any) -> None:
        """Write one tick into the ring."""
        row = np.zeros(1, ROW)
        row["index"], row["now_s"], row["planned_s"] = number, t_s, t_s
        row["robot_t_s"], row["frames"] = t_s - 0.004, 1
        row["frame_t_s"][0, 0] = t_s - 0.002
        row["tared"][0, 0, 2] = row["force_N"] = row["absolute_N"] = force_N
        row["surface_z_m"], row["site"], row["repeat"], row["phase"], row["mode"] = np.nan, -1, -1, Phase.IDLE, Mode.NONE
        for name, value in fields.items():
            row[name] = value
        self.ring.write(row)

    def drop_watchers(self) -> None:
        """Break the connections of all watchers."""
        watchers, self._watchers = self._watchers, []
        for watcher in watchers:
            with suppress(OSError):
                watcher.shutdown(socket.SHUT_RDWR)
            watcher.close()

    def close(self) -> None:
        """End as a service that dies: every connection breaks."""
        if self._over:
            return
        self._over = True
        self.held.set()
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self.drop_watchers()
        self.path.unlink(missing_ok=True)
        self.ring.close()

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def _serve(self, connection: socket.socket) -> None:
        line = b""
        while not line.endswith(b"\n"):
            piece = connection.recv(65536)
            if not piece:
                connection.close()
                return
            line += piece
        request = json.loads(line)
        self.requests.append(request)
        if request["do"] not in ("status", "watch"):
            self.held.wait(10.0)
        if request["do"] == "watch":
            self._watchers.append(connection)
            connection.sendall(json.dumps({"ok": True, "event": "status", **self.status}).encode() + b"\n")
            return
        standard = {"ok": True, **self.status} if request["do"] == "status" else {"ok": True, "state": "disarmed"}
        with suppress(OSError):
            connection.sendall(json.dumps(self.answers.get(request["do"], standard)).encode() + b"\n")
        connection.close()
