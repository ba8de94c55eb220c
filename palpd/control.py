"""The control socket of the service: one JSON line asks, one JSON line answers. Who may connect is decided by file permissions.

Requests: {"do": "status" | "arm" | "start" | "pause" | "resume" | "abort" | "clear", "plan": {...}}; answers {"ok": true, ...} or
{"ok": false, "error": sentence}. A request that is malformed, oversized or slow is answered or dropped and changes nothing.
"""

import json
import os
import selectors
import socket
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import structlog

from palpd.errors import Refused

MOST_BYTES = 262_144
"""A plan of a thousand sites is 60 kB."""
MOST_CLIENTS = 16
PATIENCE_S = 5.0

ARM_PATIENCE_S = 60.0
"""Arming looks at the devices first; opening absent ones takes longest."""


@dataclass(slots=True)
class Later:
    """An answer that takes its time: who asked waits for `answer`, others are served meanwhile; `abandoned` once nobody waits any more."""

    answer: dict[str, Any] | None = None
    abandoned: bool = False


Answer = Callable[[dict[str, Any]], dict[str, Any] | Later]


@dataclass(slots=True)
class _Client:
    connection: socket.socket
    since_s: float
    received: bytearray = field(default_factory=bytearray)
    awaits: Later | None = None


class ControlSocket:
    """Listens at `path` (mode 660); `poll` serves whoever is waiting without ever blocking."""

    def __init__(self, path: Path, answer: Answer) -> None:
        self._path, self._answer = path, answer
        self._log = structlog.get_logger("palpd.control")
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
        self._listener.listen(MOST_CLIENTS)
        self._listener.setblocking(False)
        self._selector.register(self._listener, selectors.EVENT_READ)

    def poll(self, wait_s: float = 0.0) -> None:
        """Take in what has come and answer complete requests."""
        for key, _ in self._selector.select(wait_s):
            if key.fileobj is self._listener:
                self._accept()
            else:
                self._receive(self._clients[key.fd])
        late_s = time.monotonic() - PATIENCE_S
        for client in list(self._clients.values()):
            if client.awaits is None and client.since_s < late_s:
                self._drop(client)
            elif client.awaits is not None and client.awaits.answer is not None:
                self._reply(client, client.awaits.answer)
                self._drop(client)

    def close(self) -> None:
        """Stop listening and remove the socket's file."""
        for client in list(self._clients.values()):
            self._drop(client)
        self._selector.close()
        self._listener.close()
        self._path.unlink(missing_ok=True)

    def _accept(self) -> None:
        connection, _ = self._listener.accept()
        if len(self._clients) >= MOST_CLIENTS:
            connection.close()
            return
        connection.setblocking(False)
        self._clients[connection.fileno()] = _Client(connection, time.monotonic())
        self._selector.register(connection, selectors.EVENT_READ)

    def _receive(self, client: _Client) -> None:
        try:
            some = client.connection.recv(65536)
        except BlockingIOError:
            return
        except OSError:
            some = b""
        if some and client.awaits is not None:
            return  # one request a connection
        client.received += some
        if not some or len(client.received) > MOST_BYTES:
            self._drop(client)
        elif b"\n" in client.received:
            answer = self._handled(bytes(client.received.split(b"\n", 1)[0]), client)
            if isinstance(answer, Later):
                client.awaits = answer
                return
            self._reply(client, answer)
            self._drop(client)

    def _handled(self, line: bytes, client: _Client) -> dict[str, Any] | Later:
        try:
            request = json.loads(line)
        except (ValueError, RecursionError):
            return {"ok": False, "error": "the request is not one line of JSON"}
        if not isinstance(request, dict) or not isinstance(request.get("do"), str):
            return {"ok": False, "error": 'the request has no "do" that names a command'}
        if request["do"] != "status":
            pid, uid, gid = struct.unpack("3i", client.connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
            self._log.info("request", do=request["do"][:32], pid=pid, uid=uid, gid=gid)
        return self._answer(request)

    def _reply(self, client: _Client, answer: dict[str, Any]) -> None:
        try:
            client.connection.setblocking(True)
            client.connection.settimeout(0.2)
            client.connection.sendall(json.dumps(answer).encode() + b"\n")
        except OSError:
            pass  # who asked has gone; the request itself was carried out and logged

    def _drop(self, client: _Client) -> None:
        if client.awaits is not None and client.awaits.answer is None:
            client.awaits.abandoned = True
        self._clients.pop(client.connection.fileno(), None)
        self._selector.unregister(client.connection)
        client.connection.close()


def ask(path: Path, request: dict[str, Any], patience_s: float = PATIENCE_S) -> dict[str, Any]:
    """Send one request to the daemon and return its answer. Raises Refused, one sentence."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(patience_s)
        try:
            connection.connect(str(path))
            connection.sendall(json.dumps(request).encode() + b"\n")
            received = bytearray()
            while b"\n" not in received:
                some = connection.recv(65536)
                if not some:
                    break
                received += some
        except PermissionError as error:
            raise Refused(f"you may not speak to the daemon at {path}; join the group that owns the socket") from error
        except (FileNotFoundError, ConnectionRefusedError) as error:
            raise Refused(f"no daemon answers at {path}; start one with palpd serve, or name its socket with --socket") from error
        except OSError as error:
            raise Refused(f"the daemon at {path} did not answer within {patience_s:g} s ({error})") from error
    try:
        answer = json.loads(received)
    except ValueError as error:
        raise Refused(f"the daemon at {path} closed the connection without an answer") from error
    if not answer.get("ok"):
        raise Refused(answer.get("error", "the daemon refused without a reason"))
    return dict(answer)


def _is_alive(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(0.5)
        try:
            probe.connect(str(path))
        except OSError:
            return False
        return True
