"""The control socket of the service: one JSON line asks, one JSON line answers. File permissions decide who may connect.

Requests: {"do": "status" | "arm" | "start" | "pause" | "resume" | "abort" | "clear", "plan": {...}}; answers {"ok": true, ...} or
{"ok": false, "error": sentence}. A request that is malformed, oversized or slow is answered or dropped and changes nothing.

An abort gets through, whatever other clients do: all waiting connections are accepted and read at once, the oldest one that has sent no
complete line makes room for the newest, and aborts are carried out before all other requests.
"""

import contextlib
import json
import os
import selectors
import socket
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import cast

import structlog

from palpd.daemon.socket_client import ControlAnswer, ControlRequest
from palpd.errors import Refused

MOST_BYTES = 262_144
"""Largest request: a plan of a thousand sites has 60 kB."""
MOST_CLIENTS = 64
"""Largest number of connections at a time: more than operators have terminals, fewer than exhaust file descriptors."""
BACKLOG = 1024
"""Connections that the kernel lets wait. They are accepted in their order; 1024 take about 30 ms."""
LINE_S = 1.0
"""Longest wait for a complete line. A client of palpd sends it in one piece."""
WORK_S = 0.02
"""Longest time that one poll serves requests: a run under way is polled in between. Further requests wait for the next poll."""


@dataclass(slots=True)
class Later:
    """An answer that takes time. Its client waits for `answer` while others are served; `abandoned` says that the client has gone."""

    answer: ControlAnswer | None = None
    abandoned: bool = False


AnswerRequest = Callable[[ControlRequest], ControlAnswer | Later]


@dataclass(slots=True)
class _Client:
    connection: socket.socket
    since_s: float
    received: bytearray = field(default_factory=bytearray)
    request: ControlRequest | None = None
    awaits: Later | None = None

    @property
    def idle(self) -> bool:
        """Whether it has sent no complete line yet."""
        return self.request is None and self.awaits is None

    @property
    def aborts(self) -> bool:
        """Whether it asks for an abort that is not carried out yet."""
        return self.request is not None and self.request["do"] == "abort"


class ControlSocket:
    """Listens at `path` (mode 660). `poll` serves all waiting clients and never blocks on one of them."""

    def __init__(self, path: Path, answer: AnswerRequest) -> None:
        self._path, self._answer = path, answer
        self._log = structlog.get_logger("palpd.daemon.control_socket")
        self._selector = selectors.DefaultSelector()
        self._clients: dict[int, _Client] = {}
        path.parent.mkdir(parents=True, exist_ok=True)
        if _is_alive(path):
            raise Refused(f"another palpd already serves {path}; stop it first, or set paths.socket")
        path.unlink(missing_ok=True)
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        mask = os.umask(0o117)  # never open wider, not even for the moment between bind and chmod
        try:
            self._listener.bind(str(path))
        finally:
            os.umask(mask)
        self._listener.listen(BACKLOG)
        self._listener.setblocking(False)
        self._selector.register(self._listener, selectors.EVENT_READ)

    def poll(self, wait_s: float = 0.0) -> None:
        """Receive what has arrived, for at most `wait_s`, and answer complete requests, aborts first."""
        work_is_left = any(client.request is not None for client in self._clients.values())
        for key, _ in self._selector.select(0.0 if work_is_left else wait_s):
            if key.fileobj is self._listener:
                self._accept()
            elif key.fd in self._clients:  # not dropped meanwhile for a newer one
                self._receive(self._clients[key.fd])
        self._serve_requests()
        late_s = time.monotonic() - LINE_S
        for client in list(self._clients.values()):
            if client.awaits is not None and client.awaits.answer is not None:
                self._reply(client, client.awaits.answer)
            elif client.idle and client.since_s < late_s:
                self._drop(client)

    def close(self) -> None:
        """Stop listening and remove the socket's file."""
        for client in list(self._clients.values()):
            self._drop(client)
        self._selector.close()
        self._listener.close()
        self._path.unlink(missing_ok=True)

    def _accept(self) -> None:
        """Accept and read all connections that wait. One that is in the way of a newer one has had its time to send a line."""
        until_s = time.monotonic() + WORK_S
        while time.monotonic() < until_s:
            try:
                connection, _ = self._listener.accept()
            except BlockingIOError:
                return
            except OSError as error:  # no file descriptors are left: make room, and accept in the next poll
                self._log.warning("a connection cannot be accepted", reason=str(error))
                self._drop_oldest()
                return
            connection.setblocking(False)
            client = _Client(connection, time.monotonic())
            self._clients[connection.fileno()] = client
            self._selector.register(connection, selectors.EVENT_READ)
            self._receive(client)
            if len(self._clients) > MOST_CLIENTS:
                self._drop_oldest()

    def _drop_oldest(self) -> None:
        """Close the oldest connection that has sent no complete line; without one, the oldest whose request nobody must hear."""
        oldest = next((client for client in self._clients.values() if client.idle), None)
        oldest = oldest or next((client for client in self._clients.values() if not client.aborts), None)
        if oldest is not None:
            self._drop(oldest)

    def _receive(self, client: _Client) -> None:
        try:
            chunk = client.connection.recv(65536)
        except BlockingIOError:
            return
        except OSError:
            chunk = b""
        if not chunk and client.request is not None:
            self._selector.unregister(client.connection)  # it has gone, and what it asked for is carried out all the same
        elif not chunk:
            self._drop(client)
        elif client.idle:  # one request a connection
            client.received += chunk
            if len(client.received) > MOST_BYTES:
                self._drop(client)
            elif b"\n" in client.received:
                self._read_line(client)

    def _read_line(self, client: _Client) -> None:
        try:
            request = json.loads(bytes(client.received.split(b"\n", 1)[0]))
        except (ValueError, RecursionError):
            self._reply(client, {"ok": False, "error": "the request is not one line of JSON"})
            return
        if not isinstance(request, dict) or not isinstance(request.get("do"), str):
            self._reply(client, {"ok": False, "error": 'the request has no "do" that names a command'})
            return
        client.request = cast(ControlRequest, request)

    def _serve_requests(self) -> None:
        """Carry out all aborts, then the other requests in their order, as far as the time allows."""
        waiting = [client for client in self._clients.values() if client.request is not None]
        until_s = time.monotonic() + WORK_S
        for client in sorted(waiting, key=lambda client: not client.aborts):
            if client.aborts or time.monotonic() < until_s:
                self._carry_out(client)

    def _carry_out(self, client: _Client) -> None:
        request, client.request = client.request, None
        assert request is not None
        if request["do"] != "status":
            pid, uid, gid = struct.unpack("3i", client.connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
            self._log.info("request", do=request["do"][:32], pid=pid, uid=uid, gid=gid)
        answer = self._answer(request)
        if isinstance(answer, Later):
            client.awaits = answer
        else:
            self._reply(client, answer)

    def _reply(self, client: _Client, answer: ControlAnswer) -> None:
        """Send the answer and close the connection, without waiting: an answer fits the socket's buffer."""
        with contextlib.suppress(OSError):  # the client has gone; the request itself was carried out and logged
            client.connection.send(json.dumps(answer).encode() + b"\n")
        self._drop(client)

    def _drop(self, client: _Client) -> None:
        if client.awaits is not None and client.awaits.answer is None:
            client.awaits.abandoned = True
        self._clients.pop(client.connection.fileno(), None)
        with contextlib.suppress(KeyError):
            self._selector.unregister(client.connection)
        client.connection.close()


def _is_alive(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(0.5)
        try:
            probe.connect(str(path))
        except OSError:
            return False
        return True
