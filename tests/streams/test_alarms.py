"""Alarms, as a webhook on this computer receives them."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from palpd.cli import app
from palpd.config import AlarmsConfig, Config, load_config
from palpd.errors import BadInput, ConfigError, Refused
from palpd.streams.addresses import read_addresses
from palpd.streams.alarm_events import LAST_CHECK, LATE_WINDOW_S, SERVICE_END
from palpd.streams.alarms import Alarms
from palpd.streams.outbox import MOST_WAITING, Alarm, Gathering, Message, Outbox
from palpd.testing.http_sink import HttpSink, listening
from palpd.testing.processes import until
from palpd.tick import Trip
from tests.streams.standin import RATE_Hz, StandIn, standing_in, ticks

SECRETS = ("anna", "pass-word-1", "token-abc123")
PATIENCE_S = 20.0


@pytest.fixture
def sink() -> Iterator[HttpSink]:
    with listening() as sink:
        yield sink


class Cell:
    """A folder with a configuration, the credentials of one address, and alarms that a test steps."""

    def __init__(self, folder: Path, url: str, **alarms: Any) -> None:
        self.folder, self.socket, self.sentences = folder, folder / "palpd.sock", list[str]()
        credentials = folder / "secret.yaml"
        credentials.write_text(f"phone: {url}\n")
        credentials.chmod(0o600)
        self.file = folder / "config.yaml"
        values = {"addresses": ["phone"], "credentials": "secret.yaml", "min_free_MB": 0.0, **alarms}
        self.file.write_text(json.dumps({"alarms": values, "paths": {"state": "state", "runs": "runs"}}))
        self.config = load_config(self.file)
        self.config.paths.state.mkdir(exist_ok=True)

    @contextmanager
    def alarms(self) -> Iterator[Alarms]:
        addresses = read_addresses(self.config.alarms)
        alarms = Alarms(self.config, self.socket, addresses, self.folder / "alarms.json", self.sentences.append)
        try:
            yield alarms
        finally:
            alarms.close()

    def end(self, words: str) -> None:
        """What ExecStopPost= writes."""
        (self.config.paths.state / SERVICE_END).write_text(f"{words}\n")

    def step(self, alarms: Alarms, true: Callable[[], Any], what: str) -> Any:
        end_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < end_s:
            alarms.step()
            if answer := true():
                return answer
            time.sleep(0.02)
        raise AssertionError(f"not within {PATIENCE_S:g} s: {what}; {self.sentences}")

    def quiet(self, alarms: Alarms, seconds: float) -> None:
        """Look for some time."""
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s:
            alarms.step()
            time.sleep(0.02)


def job(number: int, **more: Any) -> dict[str, Any]:
    ended = datetime.now().astimezone().isoformat(timespec="seconds")
    about = {"id": f"20260714-10150{number}-run", "ended": ended, "verdict": "stopped", "reason": "12.3 N were pressed", "aborted": False}
    return about | more


def titles(sink: HttpSink) -> list[str]:
    return [message["title"].partition(": ")[2] for message in sink.received]


# --- events -------------------------------------------------------------------------------------------------------------------


def test_a_stop_by_the_guard_is_a_message_with_its_reason_and_time(tmp_path: Path, sink: HttpSink) -> None:
    cell = Cell(tmp_path, sink.url)
    with standing_in(cell.socket) as service, cell.alarms() as alarms:
        cell.quiet(alarms, 0.5)
        service.publish("job", **job(1))
        cell.step(alarms, lambda: sink.received, "the message comes")
    message = sink.received[0]
    assert message["title"] == f"palpd on {socket.gethostname()}: a run was stopped"
    assert message["message"].endswith(": 20260714-101501-run: 12.3 N were pressed")
    assert message["message"][:10] == f"{datetime.now():%Y-%m-%d}"


def test_an_end_in_order_and_an_abort_by_an_operator_are_none(tmp_path: Path, sink: HttpSink) -> None:
    cell = Cell(tmp_path, sink.url)
    with cell.alarms() as alarms:
        with standing_in(cell.socket) as service:
            cell.quiet(alarms, 0.5)
            service.write(ticks(200))
            service.publish("job", **job(1, verdict="done", reason=""))
            service.publish("job", **job(2, aborted=True))
            service.publish("job", **job(3, verdict="refused", reason="nothing was moved"))
            service.publish("status", cell={"ready": True, "reason": "", "date": job(1)["ended"]})
            cell.quiet(alarms, 0.5)
        cell.end("success exited 0")
        cell.quiet(alarms, 1.5)
        cell.socket.unlink(missing_ok=True)
        with standing_in(cell.socket):
            cell.quiet(alarms, 1.5)
    assert sink.received == []


@pytest.mark.parametrize(
    ("trip", "events", "title"),
    [
        (Trip.OVERLOAD, ["stop", "overload"], "overload of the force sensor"),
        (Trip.LATE_TICKS, ["late-ticks"], "ticks are late"),
        (Trip.OVERLOAD, ["stop"], "a run was stopped"),
    ],
)
def test_the_trip_of_the_guard_tells_the_kind(tmp_path: Path, sink: HttpSink, trip: Trip, events: list[str], title: str) -> None:
    cell = Cell(tmp_path, sink.url, events=events)
    with standing_in(cell.socket) as service, cell.alarms() as alarms:
        cell.quiet(alarms, 0.5)
        rows = ticks(20)
        rows["trip"][12:] = trip
        service.write(rows)
        service.publish("job", **job(1))
        cell.step(alarms, lambda: sink.received, "the message comes")
    assert titles(sink) == [title]


def test_a_failed_check_is_told_once(tmp_path: Path, sink: HttpSink) -> None:
    cell = Cell(tmp_path, sink.url)
    with standing_in(cell.socket) as service, cell.alarms() as alarms:
        cell.quiet(alarms, 0.3)
        service.publish("status", cell={"ready": False, "reason": "the sensor is silent", "date": job(1)["ended"]})
        cell.step(alarms, lambda: sink.received, "the message comes")
        service.publish("status", state="disarmed")
        cell.quiet(alarms, 0.5)
    assert titles(sink) == ["a check of the cell failed"]
    assert sink.received[0]["message"].endswith("the sensor is silent")


def test_a_morning_check_that_warns_is_told_once(tmp_path: Path, sink: HttpSink) -> None:
    cell = Cell(tmp_path, sink.url)
    check = {"date": job(1)["ended"], "level": "warn", "sentence": "The zero of the sensor has moved."}
    (cell.config.paths.state / LAST_CHECK).write_text(json.dumps(check))
    for _ in range(2):
        with cell.alarms() as alarms:
            cell.step(alarms, lambda: sink.received, "the message comes")
    assert sink.received[0]["message"].endswith("The zero of the sensor has moved.")
    (cell.config.paths.state / LAST_CHECK).write_text(json.dumps(check | {"level": "ok", "date": "2026-11-26T08:00:00+00:00"}))
    with cell.alarms() as alarms:
        cell.quiet(alarms, 0.3)
    assert titles(sink) == ["a check of the cell failed"]


def test_ticks_that_are_late_are_told_of_and_single_ones_are_not(tmp_path: Path, sink: HttpSink) -> None:
    cell = Cell(tmp_path, sink.url)
    with standing_in(cell.socket) as service, cell.alarms() as alarms:
        cell.quiet(alarms, 0.5)
        for missed in (1, 90):
            number = int(LATE_WINDOW_S * RATE_Hz / 3) + 20
            for part in range(3):
                rows = ticks(number, part * number)
                rows["now_s"] += part * number / RATE_Hz
                rows["missed"][5] = missed if part == 1 else 0
                service.write(rows)
                cell.quiet(alarms, 0.1)
            if missed == 1:
                assert sink.received == []
        cell.step(alarms, lambda: sink.received, "the message comes")
    assert titles(sink) == ["ticks are late"]
    assert "90 of 1398 ticks were missed" in sink.received[0]["message"]


def test_a_disk_that_fills_up_is_told_once_also_over_a_restart(tmp_path: Path, sink: HttpSink) -> None:
    cell = Cell(tmp_path, sink.url, min_free_MB=1e9)
    for _ in range(2):
        with cell.alarms() as alarms:
            cell.step(alarms, lambda: sink.received, "the message comes")
            cell.quiet(alarms, 0.3)
    assert titles(sink) == ["the disk fills up"]


def test_events_that_are_not_chosen_are_not_sent(tmp_path: Path, sink: HttpSink) -> None:
    cell = Cell(tmp_path, sink.url, min_free_MB=1e9, events=["dead"])
    with cell.alarms() as alarms:
        cell.quiet(alarms, 0.5)
    assert sink.received == []


# --- the death of the service ---------------------------------------------------------------------------------------------------


def test_a_socket_that_was_not_closed_is_a_death_and_what_systemd_says_later_is_no_second_one(tmp_path: Path, sink: HttpSink) -> None:
    cell = Cell(tmp_path, sink.url, quiet_s=1.0)
    with cell.alarms() as alarms:
        with killed(cell.socket) as service:
            cell.step(alarms, lambda: alarms._events._up, "it watches")
        killed_s = time.monotonic()
        assert service.returncode == -signal.SIGKILL
        cell.step(alarms, lambda: sink.received, "the message comes")
        assert sink.received[0]["came_s"] - killed_s < 5.0
        cell.end("signal killed KILL")
        cell.quiet(alarms, 2.0)
    assert titles(sink) == ["the service is dead"]


def test_what_systemd_says_comes_first_where_it_is_quick(tmp_path: Path, sink: HttpSink) -> None:
    cell = Cell(tmp_path, sink.url, quiet_s=1.0)
    with cell.alarms() as alarms:
        with killed(cell.socket):
            cell.step(alarms, lambda: alarms._events._up, "it watches")
            cell.end("signal killed KILL")
            cell.step(alarms, lambda: sink.received, "the message comes")
            cell.quiet(alarms, 0.5)
        cell.quiet(alarms, 2.0)
    assert titles(sink) == ["the service is dead"]
    assert "the service ended (signal killed KILL)" in sink.received[0]["message"]


def test_a_service_that_never_answered_is_dead_by_the_words_of_systemd_and_an_old_end_is_not_told_again(
    tmp_path: Path, sink: HttpSink
) -> None:
    cell = Cell(tmp_path, sink.url, quiet_s=1.0)
    cell.end("exit-code exited 1")
    old_s = time.time() - 60.0
    os.utime(cell.config.paths.state / SERVICE_END, (old_s, old_s))
    with cell.alarms() as alarms:
        cell.quiet(alarms, 0.3)
        assert sink.received == [], "it was before the first start of the alarms"
        cell.end("exit-code exited 2")
        cell.step(alarms, lambda: sink.received, "the message comes")
    with cell.alarms() as alarms:
        cell.quiet(alarms, 0.5)
        assert len(sink.received) == 1, "the message came before the restart of the alarms"
    cell.end("watchdog killed ABRT")
    with cell.alarms() as alarms:
        cell.step(alarms, lambda: len(sink.received) == 2, "what happened while the alarms were away comes too")


def test_a_service_that_hangs_is_dead(tmp_path: Path, sink: HttpSink) -> None:
    cell = Cell(tmp_path, sink.url)
    with cell.alarms() as alarms, killed(cell.socket) as service:
        cell.step(alarms, lambda: alarms._events._up, "it watches")
        service.send_signal(signal.SIGSTOP)
        cell.step(alarms, lambda: sink.received, "the message comes")
    assert "the service does not answer" in sink.received[0]["message"]


@contextmanager
def killed(path: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A service of its own process, which is killed at the end of the context."""
    code = "import sys, time, pathlib, tests.streams.standin as s\nwith s.standing_in(pathlib.Path(sys.argv[1])): time.sleep(60)"
    with subprocess.Popen([sys.executable, "-c", code, str(path)]) as process:
        yield process
        process.kill()


# --- messages -------------------------------------------------------------------------------------------------------------------


def test_repeated_events_are_one_message_an_interval_with_their_number() -> None:
    gathering = Gathering(600.0, "here", {})
    gathering.add(Alarm("stop", 0.0, "first"))
    assert [message.body[-5:] for message in gathering.take(0.0)] == ["first"]
    for number in range(3):
        gathering.add(Alarm("stop", 10.0 + number, f"stop {number}"))
    gathering.add(Alarm("disk", 12.0, "full"))
    assert [message.title for message in gathering.take(20.0)] == ["palpd on here: the disk fills up"]
    assert list(gathering.take(599.0)) == []
    (message,) = gathering.take(600.0)
    assert message.body.startswith("3 times since 1970-01-01")
    assert message.body.endswith("stop 2")
    gathering.add(Alarm("stop", 700.0, "again"))
    assert list(gathering.take(1199.0)) == []
    assert len(list(gathering.take(1200.0))) == 1


def test_what_an_address_does_not_take_is_kept_over_a_restart_and_sent_later_with_its_time(tmp_path: Path, sink: HttpSink) -> None:
    cell = Cell(tmp_path, sink.url)
    sink.status = 503
    with standing_in(cell.socket) as service:
        with cell.alarms() as alarms:
            cell.quiet(alarms, 0.5)
            service.publish("job", **job(1))
            cell.step(alarms, lambda: any("has not taken" in sentence for sentence in cell.sentences), "it is said")
        sink.status = 200
        with cell.alarms() as alarms:
            cell.step(alarms, lambda: sink.received, "the message comes")
            cell.quiet(alarms, 0.5)
    assert titles(sink) == ["a run was stopped"]
    assert sink.received[0]["message"][:10] == f"{datetime.now():%Y-%m-%d}"
    kept = (tmp_path / "alarms.json").read_text() + " ".join(cell.sentences)
    assert not [secret for secret in SECRETS if secret in kept]


class Silent:
    """An address that takes nothing until `taken`."""

    name, taken = "phone", False

    def __init__(self) -> None:
        self.bodies: list[str] = []

    def send(self, title: str, body: str) -> str:
        if not self.taken:
            return "no network"
        self.bodies.append(body)
        return ""


def test_what_waits_is_bounded_and_comes_as_one_message() -> None:
    address, sentences = Silent(), list[str]()
    outbox = Outbox(address, [], sentences.append)  # type: ignore[arg-type]
    for number in range(MOST_WAITING + 5):
        outbox.put(Message("title", f"body {number}"))
    assert len(outbox.waiting) == MOST_WAITING
    until(lambda: sentences, "the failure is said")
    assert sentences == ["phone has not taken a message, which is sent again later: no network."]
    address.taken = True
    outbox.close(PATIENCE_S)
    assert outbox.waiting == []
    (body,) = address.bodies
    assert body.splitlines()[0] == "title. body 5"
    assert body.endswith("5 older messages are lost.")


def test_no_address_delays_the_looks_or_the_other_addresses(tmp_path: Path, sink: HttpSink) -> None:
    with socket.socket() as mute:
        mute.bind(("127.0.0.1", 0))
        mute.listen()
        cell = Cell(tmp_path, sink.url, addresses=["mute", "phone"])
        secret = tmp_path / "secret.yaml"
        secret.write_text(f"{secret.read_text()}mute: json://127.0.0.1:{mute.getsockname()[1]}\n")
        with standing_in(cell.socket) as service, cell.alarms() as alarms:
            cell.quiet(alarms, 0.5)
            service.publish("job", **job(1))
            began_s = time.monotonic()
            cell.step(alarms, lambda: sink.received, "the other address has it")
            assert sink.received[0]["came_s"] - began_s < 2.0
            began_s = time.monotonic()
            alarms.step()
            assert time.monotonic() - began_s < 1.0


# --- addresses ------------------------------------------------------------------------------------------------------------------


def refusal(config: Config | AlarmsConfig) -> str:
    with pytest.raises((BadInput, Refused)) as error:
        read_addresses(config.alarms if isinstance(config, Config) else config)
    assert not [secret for secret in SECRETS if secret in str(error.value)], error.value
    return str(error.value)


def test_addresses_that_cannot_be_used_are_one_sentence_without_a_part_of_them(tmp_path: Path, sink: HttpSink) -> None:
    cell = Cell(tmp_path, sink.url)
    secret = tmp_path / "secret.yaml"
    assert refusal(AlarmsConfig()).startswith("alarms.addresses of config.yaml is empty")
    secret.write_text("mail: json://anna:pass-word-1@here\n")
    assert "has no address 'phone'" in refusal(cell.config)
    secret.write_text("phone: nonsense://anna:pass-word-1@here/token-abc123\n")
    assert refusal(cell.config).startswith("the address of alarms 'phone' cannot be used (Unparseable URL …)")
    for text in ("phone: [anna, pass-word-1", "- token-abc123", "phone: {a: token-abc123}", "token-abc123"):
        secret.write_text(text)
        assert "is not a list of lines `name: address`" in refusal(cell.config)
    secret.chmod(0o644)
    assert f"chmod o= {secret}" in refusal(cell.config)
    secret.unlink()
    assert "cannot be read from" in refusal(cell.config)


@pytest.mark.parametrize(
    "text", ["[ntfys://anna:token-abc123@here]", "ntfys://here/token-abc123", "{phone: 'json://anna@here'}", "[phone, phone]", "3"]
)
def test_an_address_in_config_yaml_is_refused_without_a_word_of_it(tmp_path: Path, text: str) -> None:
    path = tmp_path / "config.yaml"
    path.write_text(f"alarms:\n  addresses: {text}\n")
    with pytest.raises(ConfigError, match="the addresses themselves are secrets") as error:
        load_config(path)
    assert not [secret for secret in SECRETS if secret in str(error.value) + str(error.value.faults)]


def test_the_credential_of_the_unit_is_read_where_none_is_configured(
    tmp_path: Path, sink: HttpSink, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "palpd-alarms").write_text(f"phone: {sink.url}\n")
    (tmp_path / "palpd-alarms").chmod(0o400)
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(tmp_path))
    (address,) = read_addresses(AlarmsConfig(addresses=("phone",)))
    assert address.send("title", "body") == ""
    assert titles(sink) == [""]


def test_without_apprise_one_sentence_says_what_to_install(tmp_path: Path, sink: HttpSink, monkeypatch: pytest.MonkeyPatch) -> None:
    cell = Cell(tmp_path, sink.url)
    monkeypatch.setitem(sys.modules, "apprise", None)
    assert refusal(cell.config) == "alarms need apprise, which is not installed; install palpd[alarms]"


# --- the command ----------------------------------------------------------------------------------------------------------------


def test_a_test_says_what_each_address_answered_and_fails_where_one_failed(
    tmp_path: Path, sink: HttpSink, capfd: pytest.CaptureFixture[str]
) -> None:
    cell = Cell(tmp_path, sink.url)
    done = CliRunner().invoke(app, ["alarms", "--config", str(cell.file), "--test"])
    assert (done.exit_code, done.output) == (0, "phone: taken.\n")
    assert titles(sink) == ["a test"]
    sink.status = 401
    done = CliRunner().invoke(app, ["alarms", "--config", str(cell.file), "--test", "--json", str(tmp_path / "out.json")])
    assert done.exit_code == 2
    assert "phone: not taken: Failed to send JSON POST notification: Verification Failed., error=401." in done.output
    assert json.loads((tmp_path / "out.json").read_text())["addresses"][0]["taken"] is False
    printed = done.output + "".join(capfd.readouterr())
    assert not [secret for secret in SECRETS if secret in printed]


def test_a_state_file_that_is_another_file_is_refused_and_stays(tmp_path: Path, sink: HttpSink) -> None:
    cell = Cell(tmp_path, sink.url)
    before = cell.file.read_bytes()
    done = CliRunner().invoke(app, ["alarms", "--config", str(cell.file), "--state-file", str(cell.file)])
    assert str(done.exception) == f"{cell.file} is not what alarms keep; delete it, or name another --state-file"
    assert cell.file.read_bytes() == before


def test_a_check_of_the_configuration_judges_the_addresses(tmp_path: Path) -> None:
    cell = Cell(tmp_path, "nonsense://anna@here")
    done = CliRunner().invoke(app, ["check-config", str(cell.file)])
    assert isinstance(done.exception, ConfigError)
    assert str(done.exception).startswith("the address of alarms 'phone' cannot be used (Unparseable URL …)")
    (tmp_path / "secret.yaml").unlink()
    done = CliRunner().invoke(app, ["check-config", str(cell.file)])
    assert done.exit_code == 0
    assert "question: the addresses of alarms cannot be read from" in done.output.replace("\n", " ")


def test_the_process_ends_in_order_by_a_signal_and_prints_no_secret(tmp_path: Path, sink: HttpSink) -> None:
    cell = Cell(tmp_path, sink.url)
    command = [sys.executable, "-m", "palpd", "alarms", "--config", str(cell.file), "--socket", str(cell.socket)]
    with (
        standing_in(cell.socket) as service,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process,
    ):
        assert process.stdout is not None
        assert process.stdout.readline() == f"Alarms of the service at {cell.socket} go to phone.\n"
        try:
            until(lambda: stopped(service, sink), "the message comes", PATIENCE_S)
        except AssertionError:
            process.kill()
            raise
        process.send_signal(signal.SIGTERM)
        printed = process.communicate(timeout=PATIENCE_S)[0]
        assert process.returncode == 0
    assert "phone has taken 1 message: palpd on" in printed
    assert not [secret for secret in SECRETS if secret in printed]


def stopped(service: StandIn, sink: HttpSink) -> bool:
    with suppress(RuntimeError):
        service.publish("job", **job(1))
    time.sleep(0.1)
    return bool(sink.received)
