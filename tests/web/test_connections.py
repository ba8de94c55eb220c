"""The entrance of the page's server: who sends no header makes room, an abort goes first, and a WebSocket stays."""

import asyncio
import json
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
import uvicorn
from websockets.sync.client import connect

from palpd.web import connections
from palpd.web.application import build
from palpd.web.connections import EntranceServer
from palpd.web.page import PageSettings
from palpd.web.sessions import Sessions
from tests.web.conftest import TOKEN
from tests.web.fake_service import FakeService

HALF = b"GET / HTTP/1.1\r\nHost: "
NO_BODY = b"POST /enter HTTP/1.1\r\nHost: %s\r\nOrigin: http://%s\r\nContent-Length: 9\r\n\r\ntoken"
PATIENCE_S = 60.0


@contextmanager
def served(service: FakeService, folder: Path) -> Iterator[str]:
    """The page's server in a thread within the context; its host and port."""
    listener = socket.create_server(("127.0.0.1", 0))
    port = listener.getsockname()[1]
    config = uvicorn.Config(
        build(PageSettings(service.path, folder, port=port), Sessions(TOKEN)), log_config=None, ws="websockets-sansio", lifespan="on"
    )
    server = EntranceServer(config, listener)
    thread = threading.Thread(target=lambda: asyncio.run(server.serve()))
    thread.start()
    try:
        yield f"127.0.0.1:{port}"
    finally:
        server.should_exit = True
        thread.join()


def opened(host: str, first: bytes) -> socket.socket:
    name, _, port = host.partition(":")
    connection = socket.create_connection((name, int(port)), PATIENCE_S)
    connection.sendall(first)
    return connection


def abort(host: str) -> bool:
    request = urllib.request.Request(f"http://{host}/abort", method="POST", headers={"Origin": f"http://{host}"})
    with urllib.request.urlopen(request, timeout=PATIENCE_S) as answer:
        return bool(json.load(answer)["ok"])


def ends(connection: socket.socket) -> bool:
    """Whether the server closes a connection without a word, while a byte comes now and then."""
    connection.settimeout(0.1)
    until_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < until_s:
        try:
            connection.sendall(b"x")
            if connection.recv(1) == b"":
                return True
        except TimeoutError:
            continue
        except OSError:
            return True
    return False


@pytest.mark.parametrize("first", [b"", HALF], ids=["nothing", "half a header"])
def test_a_connection_without_a_header_is_closed_though_bytes_come(service: FakeService, tmp_path: Path, first: bytes) -> None:
    assert connections.HEADER_S + connections.SWEEP_S < 2.0
    with served(service, tmp_path) as host, opened(host, first) as connection:
        began_s = time.monotonic()
        assert ends(connection)
        assert time.monotonic() - began_s > 0.8 * connections.HEADER_S, "a slow browser has its time"


def test_a_request_without_the_rest_of_its_body_is_closed(service: FakeService, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "BODY_S", 0.3)
    with served(service, tmp_path) as host, opened(host, NO_BODY % (host.encode(), host.encode())) as connection:
        assert connection.recv(1) == b""


def test_a_header_that_is_too_long_is_closed(service: FakeService, tmp_path: Path) -> None:
    with served(service, tmp_path) as host, opened(host, b"GET / HTTP/1.1\r\nX: " + b"x" * 20_000) as connection:
        assert ends(connection)


def test_a_header_in_pieces_is_a_request_and_the_connection_ends_with_the_answer(service: FakeService, tmp_path: Path) -> None:
    with served(service, tmp_path) as host, opened(host, HALF) as connection:
        time.sleep(0.2)
        connection.sendall(host.encode() + b"\r\nAccept: text/html\r\n\r")
        time.sleep(0.2)
        connection.sendall(b"\n")
        answer = b""
        while piece := connection.recv(65536):
            answer += piece
    assert answer.startswith(b"HTTP/1.1 401 ")
    assert b"connection: close\r\n" in answer.lower()
    assert b"This page is not open" in answer


def test_a_page_that_watches_is_not_closed(service: FakeService, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "BODY_S", 0.3)
    monkeypatch.setattr(connections, "HEADER_S", 0.2)
    with served(service, tmp_path) as host:
        bearer = {"Authorization": f"Bearer {TOKEN}"}
        with connect(f"ws://{host}/live", origin=f"http://{host}", additional_headers=bearer, open_timeout=PATIENCE_S) as page:  # type: ignore[arg-type]
            began_s = time.monotonic()
            while time.monotonic() - began_s < 1.0:
                json.loads(page.recv(PATIENCE_S))


def test_an_abort_is_served_though_all_others_must_wait(service: FakeService, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "MOST_SERVED", 3)
    with served(service, tmp_path) as host, ExitStack() as stack:
        no_body = NO_BODY % (host.encode(), host.encode())
        crowd = [stack.enter_context(opened(host, no_body)) for _ in range(8)]
        assert abort(host)
        crowd[0].sendall(b"=abc")
        assert crowd[0].recv(9) == b"HTTP/1.1 "
        for connection in crowd[1:4]:
            connection.sendall(b"=abc")
        assert crowd[3].recv(9) == b"HTTP/1.1 ", "it is served when there is room"


def test_aborts_get_through_more_half_open_connections_than_there_are_descriptors(service: FakeService, tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        host = f"127.0.0.1:{free.getsockname()[1]}"
    command = [sys.executable, "-m", "palpd.web", "--socket", service.path, "--runs", tmp_path, "--token-file", tmp_path / "token"]
    limited = ["sh", "-c", 'ulimit -n 256 && exec "$@"', "sh", *map(str, command), "--port", host.partition(":")[2]]
    with subprocess.Popen(limited, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as server, ExitStack() as stack:
        try:
            assert server.stdout is not None
            assert host in server.stdout.readline()
            for first in (HALF, NO_BODY % (host.encode(), host.encode())):
                for _ in range(300):
                    stack.enter_context(opened(host, first))
                assert all(abort(host) for _ in range(5))
        finally:
            server.terminate()
        _, log = server.communicate(timeout=PATIENCE_S)
    assert len(service.asked("abort")) == 10
    assert "Too many open files" not in log
