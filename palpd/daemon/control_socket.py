"""The control socket of the service: one JSON line asks, one JSON line answers. File permissions decide who may connect.

A request is {"do": command, ...}; the answer {"ok": true, ...} or {"ok": false, "error": sentence}. docs/jobs.md lists all of them. A
request that is malformed, oversized or slow is answered or dropped and changes nothing.

A watcher asks once and then receives each published event as a line. Nobody waits for it: one whose buffer is full is dropped.

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
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import cast

import structlog

from palpd.daemon.socket_client import ControlAnswer, ControlRequest
from palpd.files import clear_socket

MOST_BYTES = 262_144
"""Largest request: a plan of a thousand sites has 60 kB."""
MOST_CLIENTS = 64
"""Largest number of connections at a time: more than operators have terminals, fewer than exhaust file descriptors."""
MOST_WATCHERS = 16
"""Largest number of watchers, besides these: an event costs 10 µs for each."""
BACKLOG = 1024
"""Connections that the kernel lets wait. They are accepted in their order; 1024 take about 30 ms."""
LINE_S = 5.0
"""Longest wait for a complete line. A client of palpd sends it in one piece, but this computer may stand still for a second."""
SEND_S = 5.0
"""Longest time that a client may take to receive its answer."""
PIECE_BYTES = 65_536
"""Largest piece of a long answer that one poll sends, so that no client delays the others."""
WORK_S = 0.02
"""Longest time that one poll serves requests: a run under way is polled in between. Further requests wait for the next poll."""


@dataclass(slots=True)
class Later:
    """An answer that takes time. Its client waits for `answer` while others are served; `abandoned` says that the client has gone."""

    answer: ControlAnswer | None = None
    abandoned: bool = False


@dataclass(frozen=True, slots=True)
class Watching:
    """The first answer to a client that stays and receives every event that is published."""

    answer: ControlAnswer


AnswerRequest = Callable[[ControlRequest], ControlAnswer | Later | Watching | bytes]
"""Carries out a request. Bytes are a finished line: a long result is turned into JSON elsewhere."""
UNLOGGED = ("status", "jobs", "job", "plans", "watch", "renew")
"""Requests that change nothing, and come often."""


@dataclass(slots=True)
class _Client:
    connection: socket.socket
    since_s: float
    received: bytearray = field(default_factory=bytearray)
    request: ControlRequest | None = None
    awaits: Later | None = None
    unsent: memoryview | None = None

    @property
    def idle(self) -> bool:
        """Whether it has sent no complete line yet."""
        return self.request is None and self.awaits is None and self.unsent is None

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
        self._watchers: dict[int, socket.socket] = {}
        path.parent.mkdir(parents=True, exist_ok=True)
        clear_socket(path)
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
            elif key.fd in self._watchers:  # it has gone, or it speaks where it should listen
                self._drop_watcher(key.fd)
            elif key.fd in self._clients:  # not dropped meanwhile for a newer one
                self._receive(self._clients[key.fd])
        self._serve_requests()
        now_s = time.monotonic()
        for client in list(self._clients.values()):
            if client.awaits is not None and client.awaits.answer is not None:
                self._reply(client, client.awaits.answer)
            elif client.unsent is not None and client.since_s > now_s - SEND_S:
                self._send(client, client.unsent)
            elif client.unsent is not None:
                self._drop(client)
            elif client.idle and client.since_s < now_s - LINE_S:
                self._reply(client, {"ok": False, "error": f"no complete request came within {LINE_S:g} s; send it again"})

    @property
    def watched(self) -> bool:
        """Whether anybody would receive an event."""
        return bool(self._watchers)

    def publish(self, event: Mapping[str, object]) -> None:
        """Send an event to all watchers, without waiting for any of them."""
        if not self._watchers:
            return
        line = json.dumps(event).encode() + b"\n"
        for number, connection in list(self._watchers.items()):
            if not _taken(connection, line):
                self._log.warning("a watcher was dropped: it does not read what it asked for")
                self._drop_watcher(number)

    def close(self) -> None:
        """Stop listening and remove the socket's file."""
        for client in list(self._clients.values()):
            self._drop(client)
        for number in list(self._watchers):
            self._drop_watcher(number)
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
        if request["do"] not in UNLOGGED:
            pid, uid, gid = struct.unpack("3i", client.connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
            self._log.info("request", do=request["do"][:32], pid=pid, uid=uid, gid=gid)
        answer = self._answer(request)
        if isinstance(answer, Later):
            client.awaits = answer
        elif isinstance(answer, Watching):
            self._begin_watching(client, answer.answer)
        else:
            self._reply(client, answer)

    def _begin_watching(self, client: _Client, answer: ControlAnswer) -> None:
        if len(self._watchers) >= MOST_WATCHERS:
            self._reply(client, {"ok": False, "error": f"{MOST_WATCHERS} others watch already, expected fewer; close one of them"})
            return
        self._clients.pop(client.connection.fileno(), None)
        self._watchers[client.connection.fileno()] = client.connection
        if not _taken(client.connection, json.dumps(answer).encode() + b"\n"):
            self._drop_watcher(client.connection.fileno())

    def _reply(self, client: _Client, answer: ControlAnswer | bytes) -> None:
        """Send the answer and close the connection, without waiting: later polls send the rest of an answer that is long."""
        line = answer if isinstance(answer, bytes) else json.dumps(answer).encode() + b"\n"
        client.awaits, client.since_s = None, time.monotonic()
        with contextlib.suppress(KeyError):  # it asks once
            self._selector.unregister(client.connection)
        self._send(client, memoryview(line))

    def _send(self, client: _Client, unsent: memoryview) -> None:
        client.unsent = unsent
        try:
            client.unsent = unsent[client.connection.send(unsent[:PIECE_BYTES]) :]
        except BlockingIOError:
            return
        except OSError:  # the client has gone; the request itself was carried out and logged
            self._drop(client)
            return
        if not client.unsent:
            self._drop(client)

    def _drop_watcher(self, number: int) -> None:
        connection = self._watchers.pop(number)
        with contextlib.suppress(KeyError):
            self._selector.unregister(connection)
        connection.close()

    def _drop(self, client: _Client) -> None:
        if client.awaits is not None and client.awaits.answer is None:
            client.awaits.abandoned = True
        self._clients.pop(client.connection.fileno(), None)
        with contextlib.suppress(KeyError):
            self._selector.unregister(client.connection)
        client.connection.close()


def _taken(connection: socket.socket, line: bytes) -> bool:
    """Whether the connection took the whole line at once."""
    try:
        return connection.send(line) == len(line)
    except OSError:
        return False
