"""Connections of browsers: whoever sends no header makes room for whoever does, and an abort goes before all others.

uvicorn waits without end for the rest of a header. A thousand connections with half of one would leave no descriptor for an abort. So
`Entrance` accepts and reads before uvicorn does, in the way of the service's control socket. A connection carries one request.
"""

import asyncio
import resource
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

HEADER_S = 1.5
"""Longest time from a connection to the end of its header. A browser sends it in one piece."""
BODY_S = 10.0
"""Longest time for the rest of a request: a plan of 256 kB over a slow network. Also the longest wait for room to be served."""
MOST_HEADER_BYTES = 16_384
"""Largest header; that of a browser has some 700 bytes."""
BACKLOG = 4096
"""Connections that the kernel lets wait. They are accepted in their order; a thousand take some 30 ms."""
MOST_AT_A_TIME = 64
"""Most connections that are accepted before others are read and served."""
MOST_WAITING = min(384, resource.getrlimit(resource.RLIMIT_NOFILE)[0] // 3)
"""Most connections that wait, for their header or to be served."""
MOST_SERVED = min(256, resource.getrlimit(resource.RLIMIT_NOFILE)[0] // 4)
"""Most connections that are served, besides aborts: 32 open pages, and what they ask. The other descriptors are left to aborts."""
SWEEP_S = 0.05
"""Pause between two looks at who waits."""


@dataclass(slots=True)
class _Waiting:
    since_s: float
    received: bytearray = field(default_factory=bytearray)
    complete: bool = False


class Entrance:
    """Accepts connections at `listener` and passes those with a whole header on to `serve`, with what was received of them."""

    def __init__(self, listener: socket.socket, serve: Callable[[socket.socket, bytes], None], served: Callable[[], int]) -> None:
        self._listener, self._serve, self._served = listener, serve, served
        self._waiting: dict[socket.socket, _Waiting] = {}

    def open(self) -> None:
        """Begin to accept, in the event loop that runs now."""
        self._loop = asyncio.get_running_loop()
        self._listener.setblocking(False)
        self._listener.listen(BACKLOG)
        self._loop.add_reader(self._listener, self._accept)
        self._sweeping = self._loop.call_later(SWEEP_S, self._sweep)

    def close(self) -> None:
        """Accept no more, and close all that wait."""
        self._sweeping.cancel()
        self._loop.remove_reader(self._listener)
        self._listener.close()
        for connection in list(self._waiting):
            self._drop(connection)

    def _accept(self) -> None:
        for _ in range(MOST_AT_A_TIME):
            try:
                connection, _ = self._listener.accept()
            except BlockingIOError:
                return
            except OSError:  # no descriptors are left
                self._drop_oldest()
                return
            connection.setblocking(False)
            self._waiting[connection] = _Waiting(time.monotonic())
            self._loop.add_reader(connection, self._receive, connection)
            self._receive(connection)
            if len(self._waiting) > MOST_WAITING:
                self._drop_oldest()

    def _receive(self, connection: socket.socket) -> None:
        waiting = self._waiting[connection]
        try:
            piece = connection.recv(MOST_HEADER_BYTES)
        except BlockingIOError:
            return
        except OSError:
            piece = b""
        before = max(0, len(waiting.received) - 3)
        waiting.received += piece
        waiting.complete = waiting.received.find(b"\r\n\r\n", before) >= 0 or waiting.received.find(b"\n\n", before) >= 0
        if waiting.complete:
            self._loop.remove_reader(connection)
            self._pass_on(connection, waiting)
        elif not piece or len(waiting.received) > MOST_HEADER_BYTES:
            self._drop(connection)

    def _pass_on(self, connection: socket.socket, waiting: _Waiting) -> None:
        """Have a request served: an abort at once, another where there is room."""
        if waiting.received.startswith(b"POST /abort ") or self._served() < MOST_SERVED:
            del self._waiting[connection]
            self._serve(connection, bytes(waiting.received))

    def _sweep(self) -> None:
        now_s = time.monotonic()
        for connection, waiting in list(self._waiting.items()):
            if waiting.complete:
                self._pass_on(connection, waiting)
            if waiting.since_s < now_s - (BODY_S if waiting.complete else HEADER_S) and connection in self._waiting:
                self._drop(connection)
        self._sweeping = self._loop.call_later(SWEEP_S, self._sweep)

    def _drop_oldest(self) -> None:
        oldest = next(iter(self._waiting), None)
        if oldest is not None:
            self._drop(oldest)

    def _drop(self, connection: socket.socket) -> None:
        del self._waiting[connection]
        self._loop.remove_reader(connection)
        connection.close()


class OneRequest(H11Protocol):
    """A connection whose header has arrived. It is closed where the rest of its request does not."""

    def __init__(self, received: bytes, **of_the_server: Any) -> None:
        super().__init__(**of_the_server)
        self._received = received

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override] # as uvicorn has it
        """Begin with what was received already."""
        super().connection_made(transport)
        self._due = self.loop.call_later(BODY_S, self._close_unfinished)
        self.data_received(self._received)

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait no more; None: the connection ended without an error."""
        self._due.cancel()
        super().connection_lost(exc)

    def _close_unfinished(self) -> None:
        is_websocket = self.transport.get_protocol() is not self
        if self.conn.their_state is h11.SEND_BODY and not is_websocket:
            self.transport.abort()


class EntranceServer(uvicorn.Server):
    """uvicorn behind an entrance."""

    def __init__(self, config: uvicorn.Config, listener: socket.socket) -> None:
        super().__init__(config)
        self._entrance = Entrance(listener, self._serve_connection, self._number_served)
        self._beginning: set[asyncio.Task[Any]] = set()

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start the application, then listen; None: at no further sockets."""
        await super().startup(sockets or [])
        self._entrance.open()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen no more, then end what is under way; None: there are no further sockets."""
        self._entrance.close()
        await super().shutdown(sockets)

    def _number_served(self) -> int:
        return len(self.server_state.connections) + len(self._beginning)

    def _serve_connection(self, connection: socket.socket, received: bytes) -> None:
        def protocol() -> OneRequest:
            return OneRequest(received, config=self.config, server_state=self.server_state, app_state=self.lifespan.state)

        task = asyncio.ensure_future(asyncio.get_running_loop().connect_accepted_socket(protocol, connection))
        self._beginning.add(task)
        task.add_done_callback(self._beginning.discard)
