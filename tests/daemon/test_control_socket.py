"""The control socket: what is malformed, oversized or slow changes nothing."""

import json
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from palpd.daemon import control_socket as control
from palpd.daemon.control_socket import MOST_BYTES, ControlSocket, Watching
from palpd.daemon.socket_client import ask, follow
from palpd.errors import Refused
from palpd.testing.processes import over_and_over

LONG = json.dumps({"ok": True, "log": ["x" * 100] * 50_000}).encode() + b"\n"


class Listening:
    def __init__(self, path: Path) -> None:
        self.path, self.heard = path, []  # type: ignore[var-annotated]
        self.socket = ControlSocket(path, self.answer)

    def answer(self, request: dict[str, Any]) -> dict[str, Any] | bytes:
        self.heard.append(request)
        return LONG if request["do"] == "job" else {"ok": request["do"] != "refuse", "error": "no", "echo": request.get("plan")}

    def raw(self, data: bytes) -> bytes:
        with socket.socket(socket.AF_UNIX) as client:
            client.settimeout(3.0)
            client.connect(str(self.path))
            try:
                client.sendall(data)
                return client.recv(65536)
            except (ConnectionResetError, BrokenPipeError):
                return b""


@pytest.fixture(scope="module")
def listening(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Listening]:
    server = Listening(tmp_path_factory.mktemp("control") / "palpd.sock")
    with closing(server.socket), over_and_over(lambda: server.socket.poll(0.01)):
        yield server
    assert not server.path.exists()


class Polled(NamedTuple):
    """A socket that is polled by hand, and the requests that it heard."""

    server: ControlSocket
    path: Path
    heard: list[str]


@pytest.fixture
def polled(tmp_path: Path) -> Iterator[Polled]:
    heard: list[str] = []

    def answer(request: Any) -> Any:
        heard.append(request["do"])
        return {"watch": Watching({"ok": True, "state": "disarmed"}), "job": LONG}.get(request["do"], {"ok": True})

    server = ControlSocket(tmp_path / "palpd.sock", answer)
    yield Polled(server, tmp_path / "palpd.sock", heard)
    server.close()


def test_a_request_is_answered(listening: Listening) -> None:
    assert ask(listening.path, {"do": "start", "plan": {"a": 1}})["echo"] == {"a": 1}


def test_a_refusal_is_raised_with_its_sentence(listening: Listening) -> None:
    with pytest.raises(Refused, match="no"):
        ask(listening.path, {"do": "refuse"})


def test_the_socket_is_not_open_to_others(listening: Listening) -> None:
    assert listening.path.stat().st_mode & 0o007 == 0


@pytest.mark.parametrize("data", [b"abort\n", b"[]\n", b'{"do": 3}\n', b"\xff\xfe\n", b"[" * 100_000 + b"\n"])
def test_what_is_no_request_is_told_so_and_not_carried_out(listening: Listening, data: bytes) -> None:
    before = len(listening.heard)
    assert json.loads(listening.raw(data))["ok"] is False
    assert len(listening.heard) == before


def test_an_endless_request_is_dropped(listening: Listening) -> None:
    before = len(listening.heard)
    assert listening.raw(b"x" * (MOST_BYTES + 65536)) == b""
    assert len(listening.heard) == before


def test_a_slow_client_is_told_so_and_others_are_served_meanwhile(listening: Listening, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control, "LINE_S", 0.5)
    with socket.socket(socket.AF_UNIX) as slow:
        slow.settimeout(3.0)
        slow.connect(str(listening.path))
        slow.sendall(b'{"do":')
        began_s = time.monotonic()
        assert ask(listening.path, {"do": "status"})["ok"]
        assert time.monotonic() - began_s < 0.8
        assert "no complete request came within 0.5 s" in json.loads(slow.recv(65536))["error"]
        assert slow.recv(1) == b""


def _crowd(path: Path, number: int, line: bytes = b"") -> list[socket.socket]:
    clients = [socket.socket(socket.AF_UNIX) for _ in range(number)]
    for client in clients:
        client.settimeout(3.0)
        client.connect(str(path))
        client.sendall(line)
    return clients


@pytest.mark.parametrize("line", [b"", b'{"do": "status"'])
def test_an_abort_gets_through_200_connections_that_never_complete_a_line(listening: Listening, line: bytes) -> None:
    crowd = _crowd(listening.path, 200, line)
    before = len(listening.heard)
    assert ask(listening.path, {"do": "abort"})["ok"]
    assert listening.heard[before:] == [{"do": "abort"}]
    for client in crowd:
        client.close()


def test_an_abort_overtakes_requests_that_came_before_it(polled: Polled) -> None:
    server, path, heard = polled
    crowd = _crowd(path, 20, b'{"do": "status"}\n') + _crowd(path, 1, b'{"do": "abort"}\n')
    server.poll()
    assert heard[0] == "abort"
    for client in crowd:
        client.close()


def test_an_abort_is_carried_out_although_its_client_has_gone(polled: Polled) -> None:
    server, path, heard = polled
    for client in _crowd(path, 1, b'{"do": "abort"}\n'):
        client.close()
    server.poll()
    server.poll()
    assert heard == ["abort"]


@pytest.mark.hil
def test_an_abort_gets_through_a_flood_of_requests_and_connections(listening: Listening) -> None:
    with ExitStack() as stack:
        for client in _crowd(listening.path, 200):
            stack.enter_context(client)
        for _ in range(20):
            stack.enter_context(over_and_over(lambda: listening.raw(b'{"do": "status"}\n')))
        for _ in range(10):
            assert ask(listening.path, {"do": "abort"})["ok"]


@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(st.binary(max_size=200))
def test_no_bytes_bring_it_down(listening: Listening, data: bytes) -> None:
    listening.raw(data.replace(b"\n", b"") + b"\n")
    assert ask(listening.path, {"do": "status"})["ok"]


def test_a_second_daemon_on_the_same_socket_is_refused(listening: Listening) -> None:
    with pytest.raises(Refused, match="already serves"):
        ControlSocket(listening.path, listening.answer)


def test_no_daemon_is_said_in_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(Refused, match="no daemon answers"):
        ask(tmp_path / "nobody.sock", {"do": "status"})


# --- watchers and long answers ------------------------------------------------------------------------------------------------


def _watching(server: ControlSocket, path: Path) -> socket.socket:
    watcher = socket.socket(socket.AF_UNIX)
    watcher.settimeout(3.0)
    watcher.connect(str(path))
    watcher.sendall(b'{"do": "watch"}\n')
    server.poll()
    return watcher


def test_a_watcher_receives_every_event_until_it_leaves(polled: Polled) -> None:
    server, path, _ = polled
    assert not server.watched
    with _watching(server, path) as watcher, watcher.makefile() as lines:
        server.publish({"event": "log", "line": "one"})
        server.publish({"event": "log", "line": "two"})
        assert [json.loads(lines.readline()).get("line") for _ in range(3)] == [None, "one", "two"]
    server.poll()
    assert not server.watched


def test_a_stuck_watcher_is_dropped_and_delays_nobody(polled: Polled) -> None:
    server, path, _ = polled
    stuck, reader = _watching(server, path), _watching(server, path)
    with stuck, reader, reader.makefile() as lines:
        lines.readline()
        began_s = time.process_time()
        for number in range(1000):
            server.publish({"event": "log", "line": "x" * 1000, "number": number})
            assert json.loads(lines.readline())["number"] == number
        assert time.process_time() - began_s < 1.0
        assert len(server._watchers) == 1
    server.poll()


def test_a_watcher_that_speaks_is_dropped(polled: Polled) -> None:
    server, path, _ = polled
    with _watching(server, path) as watcher:
        watcher.sendall(b'{"do": "abort"}\n')
        server.poll()
        assert not server.watched


def test_there_are_not_more_watchers_than_the_service_can_serve(polled: Polled) -> None:
    server, path, _ = polled
    watchers = [_watching(server, path) for _ in range(control.MOST_WATCHERS + 1)]
    assert b"16 others watch already" in watchers[-1].recv(65536)
    assert len(server._watchers) == control.MOST_WATCHERS
    for watcher in watchers:
        watcher.close()


def test_an_abort_gets_through_watchers_and_a_client_that_does_not_take_its_long_answer(polled: Polled) -> None:
    server, path, heard = polled
    watchers = [_watching(server, path) for _ in range(control.MOST_WATCHERS)]
    slow = _crowd(path, 10, b'{"do": "job"}\n')
    for _ in range(5):
        server.poll()
        server.publish({"event": "status"})
    began_s = time.process_time()
    crowd = _crowd(path, 1, b'{"do": "abort"}\n')
    while "abort" not in heard:
        server.poll()
    assert time.process_time() - began_s < 0.05
    for client in [*watchers, *slow, *crowd]:
        client.close()


def test_an_answer_longer_than_the_buffer_arrives_whole(listening: Listening) -> None:
    assert ask(listening.path, {"do": "job", "id": "x"}) == json.loads(LONG)


@pytest.mark.parametrize("answer", [b"HTTP/1.1 400 Bad Request\r\n", b"[]\n", b"\xff\xfe\n"])
def test_whoever_follows_outlives_a_foreign_program_at_the_socket(tmp_path: Path, answer: bytes) -> None:
    path, over, events = tmp_path / "palpd.sock", threading.Event(), list[dict[str, Any]]()
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()

        def serve() -> None:
            for _ in range(2):
                connection, _address = listener.accept()
                with connection:
                    connection.recv(4096)
                    connection.sendall(answer)

        def publish(event: dict[str, Any]) -> None:
            events.append(event)
            if len(events) == 2:
                over.set()

        foreign = threading.Thread(target=serve)
        foreign.start()
        follow(path, publish, over, 0.01)
        foreign.join()
    assert [event["event"] for event in events] == ["lost", "lost"]
    assert str(path) in events[0]["reason"]
