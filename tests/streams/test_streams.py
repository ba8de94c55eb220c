"""Live data in other tools, seen by their own clients: a WebSocket client, HTTP GET, and a reader of the force."""

import json
import re
import signal
import socket
import struct
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect

from palpd.cli import app
from palpd.config import Config
from palpd.errors import BadInput, Refused
from palpd.recording.topics import SCHEMAS, TOPICS, TopicMessages
from palpd.streams import serving
from palpd.streams.force_socket import MAGIC, RECORD, VERSION, ForceRecord, ForceSocket
from palpd.streams.foxglove import STATUS_SCHEMA, FoxgloveServer, flat
from palpd.streams.metrics import MetricsServer
from palpd.streams.serving import Outputs, Stream, _is_loopback, opened
from palpd.testing.processes import over_and_over
from tests.paths import ROOT
from tests.streams.standin import FZ_N, MODEL_N, StandIn, standing_in, ticks

PATIENCE_S = 20.0


def until(stream: Stream, true: Callable[[], Any], what: str) -> Any:
    """Step the stream until something is true, and return it."""
    end_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < end_s:
        stream.step()
        if answer := true():
            return answer
    raise AssertionError(f"not within {PATIENCE_S:g} s: {what}")


class Served:
    """A stream of all three outputs on free ports, before a service that stands in."""

    def __init__(self, folder: Path) -> None:
        self.stack = ExitStack()
        self.path = folder / "palpd.sock"
        self.service: StandIn = self.stack.enter_context(standing_in(self.path))
        self.sentences: list[str] = []
        outputs = Outputs(foxglove_port=0, metrics_port=0, force_socket=folder / "force.sock")
        self.stream: Stream = self.stack.enter_context(opened(Config(), self.path, outputs, self.sentences.append))
        until(self.stream, lambda: self.stream.follows, "it follows the ring")

    def page(self) -> dict[str, float]:
        """What a scrape reads, by name and labels."""
        assert self.stream.metrics is not None
        with urllib.request.urlopen(f"http://127.0.0.1:{self.stream.metrics.port}/metrics", timeout=PATIENCE_S) as answer:
            lines = answer.read().decode().splitlines()
        return {name: float(value) for name, _, value in (line.rpartition(" ") for line in lines if not line.startswith("#"))}

    @contextmanager
    def reader(self) -> Iterator[socket.socket]:
        """A reader of the force that was let in."""
        assert self.stream.force is not None
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as reader:
            reader.connect(str(self.stream.force.path))
            reader.setblocking(False)
            until(self.stream, lambda: self.stream.force is not None and self.stream.force.read, "the reader is let in")
            yield reader


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    stream = Served(tmp_path)
    with stream.stack:
        yield stream


def records_of(reader: socket.socket) -> list[ForceRecord]:
    """All records that wait."""
    records = []
    while True:
        try:
            records.append(ForceRecord(*RECORD.unpack(reader.recv(4096, socket.MSG_DONTWAIT))))
        except BlockingIOError:
            return records


# --- the force ----------------------------------------------------------------------------------------------------------------


def test_a_reader_receives_the_compensated_force_with_its_times_and_number(served: Served) -> None:
    with served.reader() as reader:
        rows = ticks(1)
        before_s = time.monotonic()
        served.service.write(rows)
        served.stream.step()
        (record,) = records_of(reader)
    assert (record.magic, record.version, record.sequence) == (MAGIC, VERSION, 0)
    assert record.fz_N == FZ_N - MODEL_N
    assert record.sensor_s == rows["frame_t_s"][0, 1]
    assert record.tick_s == rows["now_s"][0]
    assert before_s <= record.sent_s <= time.monotonic()


def test_a_tick_without_frames_repeats_the_force_with_its_old_time(served: Served) -> None:
    with served.reader() as reader:
        rows = ticks(2)
        rows["frames"][1] = 0
        for row in rows:
            served.service.ring.write(row)
            served.stream.step()
        with_frames, without = records_of(reader)
    assert (without.fz_N, without.sensor_s) == (with_frames.fz_N, with_frames.sensor_s)
    assert without.tick_s > with_frames.tick_s
    assert without.sequence == 1


def test_of_ticks_that_come_together_the_newest_is_sent(served: Served) -> None:
    with served.reader() as reader:
        served.service.write(ticks(5))
        served.stream.step()
        (record,) = records_of(reader)
    assert record.sequence == 4
    assert record.fz_N == pytest.approx(FZ_N - MODEL_N + 0.04)


def test_a_reader_that_does_not_read_loses_records_and_delays_nobody(served: Served) -> None:
    with served.reader() as stuck, served.reader() as awake:
        for number in range(200):
            served.service.write(ticks(1, number))
            served.stream.step()
            assert [record.sequence for record in records_of(awake)] == [number]
        waiting = records_of(stuck)
        assert 1 <= len(waiting) <= 8, "what waits is a few old records"
        served.service.write(ticks(1, 200))
        served.stream.step()
        assert records_of(stuck)[-1].sequence == 200


def test_readers_that_leave_or_are_too_many_disturb_nobody(served: Served) -> None:
    with served.reader() as stays:
        for _ in range(40):
            with served.reader():
                pass
        served.service.write(ticks(1))
        served.stream.step()
        assert records_of(stays)[-1].sequence == 0


def test_only_user_and_group_may_read_the_force(served: Served) -> None:
    assert served.stream.force is not None
    assert served.stream.force.path.stat().st_mode & 0o777 == 0o660


def test_a_socket_that_is_served_or_a_file_is_refused_and_an_old_one_replaced(tmp_path: Path) -> None:
    path = tmp_path / "force.sock"
    first = ForceSocket(path)
    with pytest.raises(Refused, match="another program already serves"):
        ForceSocket(path)
    first.close()
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as killed:
        killed.bind(str(path))
    ForceSocket(path).close()
    path.write_text("mine")
    with pytest.raises(Refused, match="is no socket"):
        ForceSocket(path)
    assert path.read_text() == "mine"
    with pytest.raises(Refused, match="cannot be made"):
        ForceSocket(tmp_path / "absent" / "force.sock")


def test_the_client_of_the_page_reads_the_force(served: Served) -> None:
    assert served.stream.force is not None
    example = ROOT / "docs" / "examples" / "read_force.py"
    command = [sys.executable, str(example), str(served.stream.force.path), "3"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as client:
        until(served.stream, lambda: served.stream.force is not None and served.stream.force.read, "the client is let in")
        numbers = count()

        def tick() -> None:
            served.service.write(ticks(1, next(numbers)))
            time.sleep(0.01)

        with over_and_over(tick):
            until(served.stream, lambda: client.poll() is not None, "the client has read three records")
        assert client.stdout is not None
        lines = client.stdout.read().splitlines()
    assert client.returncode == 0
    assert len(lines) == 3
    assert all(re.fullmatch(r"\d+: fz \+\d+\.\d\d N, \d+\.\d ms after the sensor, \d+ lost", line) for line in lines), lines


def test_the_page_says_the_layout_of_the_record() -> None:
    page = (ROOT / "docs" / "streams.md").read_text()
    rows = re.findall(r"^\| (\d+) \| `(\w+)` \| `(\w+)` \|", page, re.M)
    codes = {"char4": "4s", "uint8": "B", "uint16": "H", "uint64": "Q", "float64": "d"}
    assert [name for _, _, name in rows] == list(ForceRecord._fields)
    layout = "<" + "".join(codes[kind] for _, kind, _ in rows)
    assert struct.calcsize(layout) == RECORD.size
    assert struct.unpack(layout, bytes(range(RECORD.size))) == RECORD.unpack(bytes(range(RECORD.size)))
    assert [int(offset) for offset, _, _ in rows] == [
        struct.calcsize("<" + "".join(codes[kind] for _, kind, _ in rows[:n])) for n in range(len(rows))
    ]


# --- metrics ------------------------------------------------------------------------------------------------------------------


def test_a_scrape_reads_state_latch_ticks_ages_force_and_work(served: Served) -> None:
    rows = ticks(4)
    rows["missed"][2] = 3
    served.service.write(rows)
    served.service.publish("status", state="disarmed", latched="18 N were pressed")
    until(served.stream, lambda: served.page()["palpd_latched"], "the latch is seen")
    page = served.page()
    assert page["palpd_up"] == 1.0
    assert {name for name, value in page.items() if name.startswith("palpd_state") and value} == {'palpd_state{palpd_state="disarmed"}'}
    assert (page["palpd_ticks_total"], page["palpd_ticks_missed_total"]) == (4.0, 3.0)
    assert page["palpd_force_newtons"] == FZ_N - MODEL_N
    assert page["palpd_absolute_force_newtons"] == 7.0
    assert page["palpd_sensor_age_seconds"] == pytest.approx(0.001, abs=1e-6)
    assert page["palpd_robot_age_seconds"] == pytest.approx(0.004, abs=1e-6)
    assert 0.0 < page["palpd_tick_age_seconds"] < PATIENCE_S
    assert page['palpd_tick_work_seconds_bucket{le="0.001"}'] == 4.0
    assert page['palpd_tick_work_seconds_bucket{le="0.0005"}'] == 0.0
    assert page["palpd_service_process_resident_memory_bytes"] > 0.0


def test_ticks_that_came_too_fast_are_lost_and_counted(served: Served) -> None:
    served.service.write(ticks(served.service.ring.capacity + 7))
    served.stream.step()
    page = served.page()
    assert page["palpd_stream_lost_ticks_total"] == 7.0
    assert page["palpd_ticks_total"] == served.service.ring.capacity


def test_without_a_tick_nothing_is_said_of_force_and_ages(served: Served) -> None:
    assert not any("age" in name or "newtons" in name for name in served.page())


def test_a_service_that_is_away_is_said_and_its_successor_is_followed(tmp_path: Path) -> None:
    path, sentences = tmp_path / "palpd.sock", list[str]()
    with opened(Config(), path, Outputs(metrics_port=0), sentences.append) as stream:
        assert stream.metrics is not None
        url = f"http://127.0.0.1:{stream.metrics.port}/metrics"

        def page() -> str:
            with urllib.request.urlopen(url, timeout=PATIENCE_S) as answer:
                text: str = answer.read().decode()
                return text

        until(stream, lambda: any(sentence.startswith("Nothing to show now: no daemon answers at") for sentence in sentences), "it says so")
        assert 'palpd_state{palpd_state="away"} 1.0' in page()
        for expected in (2, 4):
            with standing_in(path) as service:
                until(stream, lambda: stream.follows, "it follows the ring")
                service.write(ticks(2))
                until(stream, lambda: f"palpd_ticks_total {expected:.1f}" in page(), "the ticks are counted")  # noqa: B023
            until(stream, lambda: not stream.follows, "the service has gone")
        assert "palpd_up 0.0" in page()


def test_a_ring_that_cannot_be_read_is_one_sentence(served: Served) -> None:
    served.service.publish("status", ring="palpd-absent")
    until(served.stream, lambda: any("palpd-absent cannot be opened" in sentence for sentence in served.sentences), "it is said")
    for _ in range(20):
        served.stream.step()
    assert sum("palpd-absent" in sentence for sentence in served.sentences) == 1


# --- Foxglove -----------------------------------------------------------------------------------------------------------------


@contextmanager
def viewer(served: Served, *topics: str) -> Iterator[tuple[ClientConnection, dict[int, dict[str, Any]]]]:
    """A client that has subscribed to topics; its channels by the number of the subscription."""
    assert served.stream.foxglove is not None
    url = f"ws://127.0.0.1:{served.stream.foxglove.port}"
    with connect(url, subprotocols=["foxglove.sdk.v1"], open_timeout=PATIENCE_S) as client:  # type: ignore[list-item]
        assert json.loads(client.recv(PATIENCE_S))["capabilities"] == [], "a viewer can send nothing"
        advertised = json.loads(client.recv(PATIENCE_S))["channels"]
        channels = {channel["id"] + 100: channel for channel in advertised if channel["topic"] in topics}
        subscriptions = [{"id": number, "channelId": channel["id"]} for number, channel in channels.items()]
        client.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))
        foxglove = served.stream.foxglove
        until(served.stream, lambda: foxglove.subscribed >= set(topics), "the server has heard it")
        yield client, channels


def message_of(served: Served, client: ClientConnection) -> tuple[int, int, bytes]:
    """Subscription, time and content of the next message, for which the stream may have to go on."""
    end_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < end_s:
        served.stream.step()
        with suppress(TimeoutError):
            data = client.recv(0.01)
            if isinstance(data, bytes) and data[0] == 1:
                number, time_ns = struct.unpack_from("<IQ", data, 1)
                return number, time_ns, data[13:]
    raise AssertionError("no message came")


def test_a_viewer_receives_the_messages_of_a_recording(served: Served) -> None:
    with viewer(served, *TOPICS) as (client, channels):
        assert {channel["topic"]: channel["schemaName"] for channel in channels.values()} == TOPICS
        assert all(channel["encoding"] == "cdr" and channel["schemaEncoding"] == "ros2msg" for channel in channels.values())
        assert all(channel["schema"] == SCHEMAS[channel["schemaName"]] for channel in channels.values())
        rows = ticks(1)
        served.service.write(rows)
        expected = [(topic, message) for topic, _, messages in TopicMessages(0.0).of(rows) for message in messages]
        got = [message_of(served, client) for _ in expected]
    assert [channels[number]["topic"] for number, _, _ in got] == [topic for topic, _ in expected]
    stamp = slice(4, 12)  # of the header: Unix time here, time since boot there
    for (_, time_ns, data), (_, message) in zip(got, expected, strict=True):
        assert data[: stamp.start] + data[stamp.stop :] == message[: stamp.start] + message[stamp.stop :]
        assert abs(time_ns * 1e-9 - time.time()) < PATIENCE_S
        assert struct.unpack_from("<iI", data, 4) == divmod(time_ns, 1_000_000_000)


def test_a_viewer_reads_the_status_the_log_and_the_latch(served: Served) -> None:
    with viewer(served, "/status", "/log") as (client, channels):
        topic = {number: channel["topic"] for number, channel in channels.items()}
        number, _, data = message_of(served, client)
        assert topic[number] == "/status"
        assert json.loads(data) == flat(served.service.state)
        served.service.publish("log", id="job", line="press 3 of 9")
        number, _, data = message_of(served, client)
        assert topic[number] == "/log"
        assert b"press 3 of 9" in data
        served.service.publish("status", latched="18 N were pressed")
        seen = [message_of(served, client) for _ in range(2)]
    assert {topic[number] for number, _, _ in seen} == {"/status", "/log"}
    assert all(b"18 N were pressed" in data for _, _, data in seen)


def test_a_viewer_of_the_older_protocol_is_refused_and_the_sentence_names_what_to_install(served: Served) -> None:
    assert served.stream.foxglove is not None
    url = f"ws://127.0.0.1:{served.stream.foxglove.port}"
    for _ in range(2):
        with pytest.raises(InvalidStatus) as refused:
            connect(url, subprotocols=["foxglove.websocket.v1"], open_timeout=PATIENCE_S)  # type: ignore[list-item]
        assert refused.value.response.status_code == 400
        assert b"sec-websocket-protocol" in bytes(refused.value.response.body or b"")
    until(served.stream, lambda: len(served.sentences) > 3, "the refusal is said")
    printed = [sentence for sentence in served.sentences if "refused" in sentence]
    assert printed == ["Foxglove: a viewer at 127.0.0.1 was refused, since it does not speak foxglove.sdk.v1; install a newer viewer."], (
        "once for a computer, though a viewer tries again and again"
    )


def test_a_status_fits_its_schema() -> None:
    kinds = {"string": str, "integer": int}
    for status in (None, {"state": "running", "latched": None, "active": {"activity": "fits"}, "site": 2, "steps": 5, "steps_done": 1}):
        values = flat(status)
        assert set(values) == set(STATUS_SCHEMA["properties"])
        assert all(isinstance(values[name], kinds[entry["type"]]) for name, entry in STATUS_SCHEMA["properties"].items())


def test_every_path_of_the_layout_is_a_field_of_a_topic() -> None:
    layout = json.loads(serving.LAYOUT.read_text())
    text = json.dumps(layout)
    panels = set(re.findall(r'"(\w+!\w+)"', json.dumps(layout["layout"])))
    assert panels == set(layout["configById"])
    paths = set(re.findall(r'"(/[a-z_/.]+)"', text))
    fields = {f"/status.{name}" for name in STATUS_SCHEMA["properties"]} | {"/status", "/log"}
    fields |= {f"/tick.{line.split()[1]}" for line in SCHEMAS["palpd_msgs/msg/Tick"].splitlines() if re.fullmatch(r"\w+ [a-z_]+", line)}
    for topic, name in TOPICS.items():
        part = {"PoseStamped": "pose.position", "WrenchStamped": "wrench.force"}.get(name.rpartition("/")[2])
        fields |= {f"{topic}.{part}.{axis}" for axis in "xyz"} if part else set()
    assert len(paths) > 10
    assert paths <= fields, paths - fields


# --- the command --------------------------------------------------------------------------------------------------------------


def test_nothing_is_served_without_an_option(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="nothing is to be served; give --foxglove PORT"), opened(Config(), tmp_path / "s", Outputs(), print):
        pass


@pytest.mark.parametrize("server", [FoxgloveServer, MetricsServer])
def test_a_port_that_is_taken_is_one_sentence(server: type[FoxgloveServer | MetricsServer]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(Refused, match=r"cannot be served at 127\.0\.0\.1"):
            server("127.0.0.1", taken.getsockname()[1])


@pytest.mark.parametrize(("server", "package"), [(FoxgloveServer, "foxglove"), (MetricsServer, "prometheus_client")])
def test_without_its_library_an_output_says_what_to_install(
    server: type[FoxgloveServer | MetricsServer], package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(BadInput, match=r"not installed; install palpd\[live\]"):
        server("127.0.0.1", 0)


def test_a_host_of_a_network_is_served_with_one_warning_and_loopback_without(tmp_path: Path) -> None:
    for host, warnings in (("0.0.0.0", 1), ("127.0.0.1", 0)):
        sentences: list[str] = []
        with opened(Config(), tmp_path / "palpd.sock", Outputs(host, metrics_port=0), sentences.append):
            assert sum(sentence.startswith("Warning: whoever reaches") for sentence in sentences) == warnings
    assert _is_loopback("localhost")
    assert _is_loopback("::1")
    assert not _is_loopback("palpation-pc")


def test_the_layout_is_written_and_nothing_served(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["stream", "--layout", str(tmp_path / "palpd.json")])
    assert done.exit_code == 0, done.output
    assert json.loads((tmp_path / "palpd.json").read_text()) == json.loads(serving.LAYOUT.read_text())


@pytest.mark.hil
def test_a_signal_ends_the_command_with_0_and_removes_the_socket(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("{}")
    force = tmp_path / "force.sock"
    command = [sys.executable, "-m", "palpd", "stream", "--config", str(tmp_path / "config.yaml"), "--force", str(force)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, preexec_fn=_as_from_a_shell) as process:
        assert process.stdout is not None
        try:
            assert process.stdout.readline() == f"Force: {force}\n"
            assert process.stdout.readline().startswith("Nothing to show now: ")
            process.terminate()
            assert process.wait(PATIENCE_S) == 0
        finally:
            process.kill()
    assert not force.exists()


def _as_from_a_shell() -> None:
    """No signal is blocked or ignored, whatever the tests before have left."""
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
