"""The command line as a whole: what it imports, what it refuses, and the way to the daemon that does not wait for imports."""

import json
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from palpd.cli import app, application, at_once, first_abort, main
from palpd.cli.command_groups import GROUPS
from palpd.cli.first_abort import socket_paths
from palpd.cli.options import PIPE_WIDTH, terminal
from palpd.cli.output_options import examples_of
from palpd.config import load_config
from palpd.control.plan_place import ANSWERS
from palpd.daemon import interrupts
from palpd.daemon.kept_plans import rehearsed_config_sha256
from palpd.errors import PalpdError, Refused
from tests.paths import ROOT
from tests.web.fake_service import FakeService

HEAVY = ("numpy", "pydantic", "rich", "typer", "structlog", "scipy", "dataclasses", "inspect")
COMMANDS = (
    "run", "calibrate", "free-motion", "stiffness", "level-test", "retract", "demo", "sim", "emulate", "serve", "web", "status", "arm",
    "start", "pause", "resume", "abort", "clear", "recover-robot", "jobs", "job", "plans", "controls", "stream", "alarms", "init",
    "install", "doctor", "migrate", "check-config", "runs", "info", "report", "replay", "export", "recover", "import", "cell-from",
    "analyse", "train", "setup", "commission", "map", "diagnose", "resolve", "simulate", "export-sim", "tolerances", "effects", "blind",
    "study", "arena", "check", "inject",
)  # fmt: skip


@pytest.fixture(autouse=True)
def signals_as_before() -> Iterator[None]:
    """A command that has ended ignores signals; what a later test starts would inherit that."""
    before = {number: signal.getsignal(number) for number in (*interrupts.SIGNALS, signal.SIGALRM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def written(folder: Path, text: str) -> Path:
    path = folder / "config.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("command", ["abort", "status"])
def test_what_is_carried_out_at_once_imports_nothing_heavy(tmp_path: Path, command: str) -> None:
    code = (
        f"import sys; from palpd.cli import main\ntry: main()\nfinally: print(sorted(set(sys.modules) & set({HEAVY!r})), file=sys.stderr)"
    )
    config = written(tmp_path, "paths: {state: here}")
    done = subprocess.run(
        [sys.executable, "-c", code, command, "--config", str(config)], capture_output=True, text=True, cwd=ROOT, check=False
    )
    sentence, imported = sorted(done.stderr.splitlines(), reverse=True)
    assert done.returncode == 2
    assert sentence.startswith(f"palpd: no daemon answers at {tmp_path}/here/palpd.sock")
    assert imported == "[]"


def test_help_imports_neither_numbers_nor_models_nor_colours() -> None:
    code = (
        "import sys; from palpd.cli import main\n"
        "try: main()\n"
        "finally: print(sorted(set(sys.modules) & {'numpy', 'pydantic', 'rich', 'structlog', 'scipy'}), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code, "--help"], capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0
    assert done.stderr == "[]\n"
    for title, names in GROUPS.items():
        shown = done.stdout.partition(f"\n{title}:\n")[2].partition("\n\n")[0]
        assert tuple(re.findall(r"^  (\S+)  ", shown, re.M)) == names
    assert sorted(name for names in GROUPS.values() for name in names) == sorted(COMMANDS)


@pytest.mark.parametrize("registered", application.app.registered_commands, ids=application.name_of)
def test_the_help_of_a_command_ends_with_examples_that_its_options_allow(registered: Any) -> None:
    name, group = application.name_of(registered), typer.main.get_command(app)
    examples = examples_of(registered)
    help_text = CliRunner().invoke(app, [name, "--help"]).output
    assert help_text.rstrip().endswith("\n    ".join(["  Examples:", *examples]))
    assert 1 <= len(examples) <= 2
    for example in examples:
        words = shlex.split(example)
        assert words[:2] == ["palpd", name]
        group.commands[name].make_context(name, words[2:])
    with pytest.raises(application.UsageError):
        group.commands[name].make_context(name, ["--colour"])


@pytest.mark.parametrize("place", ["", "."])
def test_a_folder_is_not_diagnosed_with_the_options_of_one_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], place: str
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["palpd", "diagnose", place, "--site", "A", "--json", "out.json"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    assert ". is a folder, and --site is for one recording; name the recording, or the folder alone" in capsys.readouterr().err
    assert not (tmp_path / "out.json").exists()


@pytest.mark.parametrize(
    ("text", "variables"),
    [
        ("version: 1", {}),
        ("robot: {model: ur5}", {}),
        ("paths: {state: kept}", {}),
        ("paths: {state: /var/lib/palpd, socket: /run/palpd/palpd.sock}", {}),
        ("paths: {runs: a, state: b, socket: c.sock}", {}),
        ("paths: {socket: null}", {}),
        ("paths: {}", {}),
        ("paths: {state: kept}", {"PALPD_PATHS__SOCKET": "/run/other.sock"}),
        ("paths: {state: kept}", {"PALPD_PATHS": '{"state": "elsewhere"}'}),
        ("paths: {state: kept}", {"palpd_paths__state": "lower"}),
        ("paths: {state: ''}", {}),
    ],
)
def test_both_ways_to_the_control_socket_agree(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, variables: dict[str, str]
) -> None:
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    config = written(tmp_path, text)
    assert at_once.control_socket(config) == load_config(config).paths.control_socket
    monkeypatch.chdir(tmp_path)
    assert at_once.control_socket(Path("config.yaml")) == load_config(Path("config.yaml")).paths.control_socket


@pytest.mark.parametrize(
    "text", ["paths: 5", "paths: {socket: 5}", "paths: {state: null}", "paths: null", "- 1", "paths: {state: a, state: b}"]
)
def test_both_ways_to_the_control_socket_refuse_the_same(tmp_path: Path, text: str) -> None:
    config = written(tmp_path, text)
    sentences = []
    for way in (at_once.control_socket, load_config):
        with pytest.raises(PalpdError) as refused:
            way(config)
        sentences.append(str(refused.value))
    assert sentences[0] == sentences[1]


PLAIN = "robot:\n  host: a # b\n# c\npaths:\n  state: kept/here # d\n  runs: runs\nsafety: {contact_limit_N: 5}\n"


@pytest.mark.parametrize(
    "text",
    [
        "version: 1",
        "robot: {model: ur5}",
        "paths: {state: kept}",
        "paths: {state: /var/lib, socket: /run/p.sock}",
        "paths: {socket: null}",
        PLAIN,
    ],
)
def test_the_first_abort_goes_where_the_daemon_listens(tmp_path: Path, text: str) -> None:
    config = written(tmp_path, text)
    expected = str(load_config(config).paths.control_socket)
    assert socket_paths(["--config", str(config)]) == [expected]
    assert socket_paths(["--socket", "/a"]) == ["/a"]


@pytest.mark.parametrize(
    "text",
    [
        "paths: 5", "paths: {state: null}", "paths: {state: 'a'}", "paths: {state: a, state: b}", "paths:\n  state: a\n    b",
        "paths: {state: yes}", "paths: {state: 5}", "paths: {state: a}\npaths: {state: b}", "'paths': {state: a}", "paths: {State: a}",
        "paths:{state: a}", "<<: {paths: {state: a}}", "paths: {state: {a: b}}", "paths: {state: a", "paths: ~", "paths: &x {}", "- 1",
    ],
)  # fmt: skip
def test_the_first_abort_leaves_to_the_whole_reader_what_is_not_plain(tmp_path: Path, text: str) -> None:
    assert socket_paths(["--config", str(written(tmp_path, text))]) == []


def test_the_first_abort_waits_for_no_pipe_and_no_device(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.yaml")
    (tmp_path / "zero.yaml").symlink_to("/dev/zero")
    (tmp_path / "huge.yaml").write_text("")
    os.truncate(tmp_path / "huge.yaml", 3_000_000_000)
    for name in ("pipe.yaml", "zero.yaml", "huge.yaml", "", "a\0b"):
        assert socket_paths(["--config", str(tmp_path / name)]) == []


def test_the_first_abort_leaves_other_options_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    written(tmp_path, "")
    assert socket_paths([]) == [str(tmp_path / "state" / "palpd.sock")]
    assert socket_paths(["--help"]) == []
    assert socket_paths(["--socket", "/a", "--config", "b"]) == []


@pytest.mark.parametrize(
    ("text", "variables", "place"),
    [
        ("paths: {state: kept}", {"palpd_paths__state": "elsewhere"}, "elsewhere/palpd.sock"),
        ("paths: {socket: a.sock}", {"PALPD_PATHS__STATE": "elsewhere"}, "a.sock"),
        ("paths: {state: [", {"PALPD_PATHS__SOCKET": "b.sock"}, "b.sock"),
        ("paths: {state: [", {"PALPD_PATHS__STATE": "elsewhere"}, None),
        ("", {"PALPD_PATHS__SOCKET": "null"}, None),
        ("", {"PALPD_PATHS__STATE": "with a blank"}, None),
        ("", {"PALPD_PATHS": "{state: elsewhere}"}, None),
    ],
)
def test_the_first_abort_goes_where_the_environment_says_plainly(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, variables: dict[str, str], place: str | None
) -> None:
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert socket_paths(["--config", str(written(tmp_path, text))]) == ([] if place is None else [str(tmp_path / place)])


def test_the_first_abort_without_a_configuration_goes_to_every_usual_socket(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    usual = [str(tmp_path / "state" / "palpd.sock"), first_abort.INSTALLED_SOCKET]
    assert list(dict.fromkeys(socket_paths([]))) == usual
    monkeypatch.setenv("PALPD_PATHS__SOCKET", "/a")
    assert socket_paths([]) == ["/a", *usual]


def test_an_abort_is_sent_before_anything_large_is_imported(tmp_path: Path) -> None:
    path = tmp_path / "palpd.sock"
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()
        code = (
            "import sys; from palpd.cli import main, first_abort\n"
            "sent = first_abort.send_first_abort\n"
            "def show(arguments):\n"
            "  sent(arguments); print(*sorted({'typing', 're', 'json', 'socket', 'yaml'} & set(sys.modules))); sys.exit()\n"
            "first_abort.send_first_abort = show\nmain()"
        )
        command = [sys.executable, "-S", "-c", code, "abort", "--socket", str(path)]
        done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=True)
        connection, _ = listener.accept()
        with connection:
            assert json.loads(connection.recv(100)) == {"do": "abort"}
    assert done.stdout == "\n"


@pytest.fixture
def daemon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], FakeService]]:
    """Starts fake services in the test's folder; that of an installation stands there too."""
    services: list[FakeService] = []

    def start(place: str) -> FakeService:
        path = tmp_path / place
        path.parent.mkdir(exist_ok=True)
        services.append(FakeService(path))
        return services[-1]

    monkeypatch.setattr(first_abort, "INSTALLED_SOCKET", str(tmp_path / "run" / "palpd.sock"))
    yield start
    for service in services:
        service.close()


UNREADABLE = ["safety: {a: 1}\nsafety: {a: 2}\n", "paths: 5", "paths: {state: [", "\0", None]


@pytest.mark.parametrize("text", UNREADABLE)
@pytest.mark.parametrize("place", ["state/palpd.sock", "run/palpd.sock"])
def test_abort_and_status_find_the_daemon_without_a_readable_configuration(
    tmp_path: Path, daemon: Callable[[str], FakeService], capsys: pytest.CaptureFixture[str], text: str | None, place: str
) -> None:
    service, config = daemon(place), tmp_path / "config.yaml"
    if text is not None:
        written(tmp_path, text)
    at_once.abort(config, None)
    printed = capsys.readouterr()
    assert printed.out == "disarmed\n"
    assert f"{config}" in printed.err
    assert f"palpd: the daemon at {service.path} answers\n" in printed.err
    assert service.asked("abort")
    at_once.status(config, None, tmp_path / "status.json")
    printed = capsys.readouterr()
    assert printed.out == "disarmed\nNothing moves. Next: palpd arm.\n"
    assert f"palpd: the daemon at {service.path} answers\n" in printed.err
    assert json.loads((tmp_path / "status.json").read_text())["state"] == "disarmed"


@pytest.mark.parametrize(
    ("text", "variables"),
    [
        ("paths: {state: kept}\nsafety: {a: 1}\nsafety: {a: 2}\n", {}),
        (None, {"PALPD_PATHS__STATE": "kept"}),
        (None, {"palpd_paths__socket": "kept/palpd.sock"}),
        (None, {"PALPD_PATHS": "{state: kept}"}),
        ("safety: [", {"PALPD_PATHS": "{state: other}", "PALPD_PATHS__STATE": "kept"}),
    ],
)
def test_plain_lines_and_the_environment_say_where_an_abort_without_a_configuration_goes(
    tmp_path: Path, daemon: Callable[[str], FakeService], monkeypatch: pytest.MonkeyPatch, text: str | None, variables: dict[str, str]
) -> None:
    service = daemon("kept/palpd.sock")
    if text is not None:
        written(tmp_path, text)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    at_once.abort(tmp_path / "config.yaml", None)
    assert service.asked("abort")


def test_an_abort_without_a_configuration_reaches_all_daemons_and_one_that_refuses_is_an_error(
    tmp_path: Path, daemon: Callable[[str], FakeService], capsys: pytest.CaptureFixture[str]
) -> None:
    here, installed = daemon("state/palpd.sock"), daemon("run/palpd.sock")
    here.answers["abort"] = {"ok": False, "error": "it hangs"}
    with pytest.raises(Refused, match="it hangs"):
        at_once.abort(tmp_path / "config.yaml", None)
    assert here.asked("abort")
    assert installed.asked("abort")
    assert f"{installed.path} answers" in capsys.readouterr().err


def test_an_abort_that_finds_nobody_says_where_it_looked_and_points_at_the_emergency_stop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(first_abort, "INSTALLED_SOCKET", str(tmp_path / "run" / "palpd.sock"))
    with pytest.raises(Refused) as refused:
        at_once.abort(tmp_path / "config.yaml", None)
    for words in ("config.yaml cannot be read", f"{tmp_path}/state/palpd.sock or {tmp_path}/run/palpd.sock", "emergency stop"):
        assert words in str(refused.value)
    with pytest.raises(Refused, match="--socket"):
        at_once.status(tmp_path / "config.yaml", None, None)
    with pytest.raises(Refused, match="emergency stop"):
        at_once.abort(tmp_path / "config.yaml", tmp_path / "absent.sock")


def test_a_readable_configuration_names_the_one_daemon_that_is_asked(tmp_path: Path, daemon: Callable[[str], FakeService]) -> None:
    other = daemon("run/palpd.sock")
    with pytest.raises(Refused, match="no daemon answers at"):
        at_once.abort(written(tmp_path, "paths: {state: kept}"), None)
    assert other.requests == []


@pytest.mark.parametrize("text", [*UNREADABLE, "safety: {contact_limit_N: yes}"])
def test_a_retract_without_limits_that_hold_moves_nothing_and_seeks_no_other_daemon(
    tmp_path: Path, daemon: Callable[[str], FakeService], monkeypatch: pytest.MonkeyPatch, text: str | None
) -> None:
    monkeypatch.setattr("palpd.daemon.session.carry_out", lambda *_: pytest.fail("it ran in the foreground"))
    installed, config = daemon("run/palpd.sock"), tmp_path / "config.yaml"
    if text is not None:
        written(tmp_path, text)
    done = CliRunner().invoke(app, ["retract", "--config", str(config)])
    assert isinstance(done.exception, PalpdError)
    assert done.exception.exit_code == 2
    assert installed.requests == []
    assert CliRunner().invoke(app, ["retract", "--config", str(config), "--socket", str(installed.path)]).exit_code == 0
    assert installed.asked("retract")


KEPT = {"name": "morning", "sha256": "0f", "by": "anna", "kept": "2026-11-25T08:00:00+00:00", "rehearsal": None}


def test_the_plans_that_the_daemon_keeps_are_listed_with_their_rehearsals(tmp_path: Path, daemon: Callable[[str], FakeService]) -> None:
    service, config = daemon("state/palpd.sock"), written(tmp_path, "safety: {contact_limit_N: 11}")
    figures = {
        "verdict": "done",
        "duration_s": 61.5,
        "peak_force_N": 9.94,
        "presses": 24,
        "cut_short": 14,
        "date": "2026-11-24T10:15",
    }
    current = rehearsed_config_sha256(load_config(config))
    plans = [
        KEPT,
        *({**KEPT, "name": name, "rehearsal": {**figures, "config_sha256": of}} for name, of in (("b", current), ("c", "0f" * 32))),
    ]
    service.answers["plans"] = {"ok": True, "plans": plans}
    done = CliRunner().invoke(app, ["plans", "--config", str(config)])
    first, second, third = done.output.splitlines()
    assert first == "morning: not rehearsed; kept by anna 2026-11-25T08:00:00+00:00"
    figures_in_words = "62 s, at most 9.9 N, 14 of 24 presses cut short in the rehearsal of 2026-11-24T10:15"
    assert second == f"b: {figures_in_words}; kept by anna 2026-11-25T08:00:00+00:00"
    assert third == f"c: {figures_in_words}, before the configuration changed; kept by anna 2026-11-25T08:00:00+00:00"
    service.answers["plans"] = {"ok": True, "plans": []}
    assert CliRunner().invoke(app, ["plans", "--config", str(config)]).output == "No plan is kept.\n"


def test_a_kept_plan_is_started_by_its_name(tmp_path: Path, daemon: Callable[[str], FakeService]) -> None:
    service, config = daemon("state/palpd.sock"), str(written(tmp_path, "paths: {}"))
    service.answers["plans"] = {"ok": True, "plans": [KEPT], "yaml": 'sites:\n  - {"name": "A"}\ndepths_m: [0.0041]\n'}
    assert CliRunner().invoke(app, ["start", "--kept", "morning", "--config", config]).exit_code == 0
    assert service.asked("plans") == [{"do": "plans", "name": "morning"}]
    assert service.asked("start")[0]["plan"]["depths_m"] == [0.0041]
    for words in ([], ["plan.yaml", "--kept", "morning"]):
        done = CliRunner().invoke(app, ["start", *words, "--config", config])
        assert isinstance(done.exception, PalpdError)
        assert "needs one plan" in str(done.exception)
    assert len(service.asked("start")) == 1


def test_an_abort_without_a_configuration_imports_nothing_heavy(tmp_path: Path, daemon: Callable[[str], FakeService]) -> None:
    service = daemon("state/palpd.sock")
    code = f"import sys; from palpd.cli import main\ntry: main()\nfinally: print(sorted(set(sys.modules) & set({HEAVY!r})))"
    command = [sys.executable, "-c", code, "abort", "--config", str(tmp_path / "config.yaml")]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=True)
    assert done.stdout == "disarmed\n[]\n"
    assert service.asked("abort")


def test_an_abort_does_not_depend_on_the_rest_of_the_configuration(tmp_path: Path) -> None:
    assert at_once.control_socket(written(tmp_path, "safety: {contact_limit_N: yes}")) == tmp_path / "state" / "palpd.sock"


@pytest.mark.parametrize(
    "spelling", [["--socket", "/a", "--config", "c.yaml"], ["--config=c.yaml", "--socket=/a"], ["--socket=/b", "--socket", "/a"]]
)
@pytest.mark.parametrize("command", ["abort", "status"])
def test_the_short_way_and_the_whole_command_line_ask_the_same(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], command: str, spelling: list[str]
) -> None:
    asked: list[tuple[Path, str]] = []
    tick = {"before_end_s": 0.008, "phase": "press", "force_N": 12.1, "z_m": 0.0, "vz_m_per_s": 0.0, "command_stop": True}

    def answer(socket: Path, request: dict[str, str], patience_s: float) -> dict[str, object]:
        assert patience_s == at_once.PATIENCE_S
        asked.append((socket, request["do"]))
        return {"ok": True, "state": "disarmed", "last": {"verdict": "stopped", "last_ticks": [tick]}}

    monkeypatch.setattr(at_once, "ask", answer)
    assert at_once.done_at_once([command, *spelling])
    short = capsys.readouterr().out
    whole = CliRunner().invoke(app, [command, *spelling])
    assert asked == [(Path("/a"), command)] * 2
    assert whole.output == short
    assert "disarmed" in short
    assert ("12.10 N" in short) == (command == "status")


@pytest.mark.parametrize(
    "arguments", [[], ["--help"], ["abort", "--help"], ["abort", "now"], ["abort", "--json", "a"], ["abort", "--socket"], ["arm"]]
)
def test_what_is_not_spelled_plainly_is_left_to_the_whole_command_line(monkeypatch: pytest.MonkeyPatch, arguments: list[str]) -> None:
    monkeypatch.setattr(at_once, "ask", lambda *_: pytest.fail("nothing is asked"))
    assert not at_once.done_at_once(arguments)


def test_a_status_is_written_as_json_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(at_once, "ask", lambda *_: {"ok": True, "state": "armed", "latched": None})
    assert CliRunner().invoke(app, ["status", "--socket", "/a", "--json", str(tmp_path / "status.json")]).exit_code == 0
    assert json.loads((tmp_path / "status.json").read_text()) == {"made_by": "palpd", "ok": True, "state": "armed", "latched": None}


def test_a_status_for_people_says_what_where_and_how_far() -> None:
    answer = {
        "ok": True, "state": "running", "latched": None, "job": "palpation", "activity": "site B: holding", "steps_done": 9, "steps": 28,
        "phase": "hold", "site": 1, "force_N": 5.2134567890123456, "z_m": 0.0123, "depth_m": 0.00402, "tick": 5000,
        "cell": {"ready": True, "reason": "", "date": "2026-01-01T12:00:00"},
        "last": {"verdict": "stopped", "reason": "the operator aborted the run", "recording": "runs/a.mcap", "notes": ["it presses"]},
    }  # fmt: skip
    assert at_once.status_lines(answer) == [  # type: ignore[arg-type]
        "running: palpation, site B: holding, 9 of 28 steps done, force 5.21 N, 4.0 mm deep",
        "Robot and sensor, checked 2026-01-01T12:00:00: ready.",
        "Last job: stopped (the operator aborted the run), recording runs/a.mcap.",
        "  note: it presses",
    ]
    idle = {"ok": True, "state": "disarmed", "latched": "the lateral force was 9 N"}
    lines = at_once.status_lines(idle)  # type: ignore[arg-type]
    assert lines[0] == "disarmed"
    assert "palpd retract" in lines[1]


def test_a_status_says_what_is_sensible_next_with_its_command() -> None:
    now = {"state": "pressed", "word": "In the tissue", "sentence": "The probe is in the tissue.", "next": "retract"}
    more = {"obstacles": {}, "question": None}
    answer = {"ok": True, "state": "disarmed", "latched": None, "now": now | more}
    assert at_once.status_lines(answer)[1] == "The probe is in the tissue. Next: palpd retract."  # type: ignore[arg-type]
    answer["now"] = now | more | {"next": None}
    assert at_once.status_lines(answer)[1] == "The probe is in the tissue."  # type: ignore[arg-type]


def test_a_status_asks_where_sites_count_from_only_where_a_start_would_be_asked() -> None:
    """Of a run that was under way it said: "was not finished: start with --return to its start, or --here"."""
    now = {"state": "running", "word": "Running", "sentence": "The probe presses.", "next": "abort", "obstacles": {}, "question": None}
    place = {"x_m": 0.03, "y_m": 0.0, "site": None, "origin_m": [0.0, 0.0], "unfinished": "run-7"}
    answer: Any = {"ok": True, "state": "running", "latched": None, "now": now, "place": place}
    assert "--return" not in " ".join(at_once.status_lines(answer))
    now |= {"state": "armed", "question": "the run run-7 of today was not finished"}
    assert f"The run run-7 of today was not finished; {ANSWERS}." in at_once.status_lines(answer)


def test_a_watch_without_a_terminal_prints_a_line_whenever_the_status_has_changed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    states = iter(["disarmed", "disarmed", "armed"])
    monkeypatch.setattr(at_once.time, "sleep", lambda _: None)

    def answer(*_: object) -> dict[str, object]:
        try:
            return {"ok": True, "state": next(states)}
        except StopIteration:
            raise KeyboardInterrupt from None

    monkeypatch.setattr(at_once, "ask", answer)
    with pytest.raises(KeyboardInterrupt):
        at_once.watch(Path("c.yaml"), Path("/a"))
    assert capsys.readouterr().out == "disarmed\narmed\n"


def test_an_error_is_one_sentence_and_its_exit_code(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def refuse(*_: object) -> None:
        raise Refused("nothing is running")

    monkeypatch.setattr(at_once, "ask", refuse)
    monkeypatch.setattr(signal, "signal", lambda *_: None)  # the handlers of this process are pytest's
    monkeypatch.setattr(sys, "argv", ["palpd", "abort", "--socket", "/a"])
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code == 2
    assert capsys.readouterr().err == "palpd: nothing is running\n"


@pytest.mark.parametrize(("command", "moved"), [("effects", ""), ("run", "; nothing was moved")])
@pytest.mark.parametrize("name", [number.name for number in interrupts.SIGNALS])
def test_a_signal_while_palpd_imports_its_commands_is_one_sentence(name: str, command: str, moved: str) -> None:
    code = (
        "import os, signal, sys\n"
        "for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP): signal.signal(number, signal.SIG_DFL)\n"  # a shell may ignore them
        "class Interrupting:\n"
        "    def find_spec(self, name, *_):\n"
        f"        if name == 'palpd.cli.command_line': os.kill(os.getpid(), signal.{name})\n"
        "sys.meta_path.insert(0, Interrupting())\n"
        "from palpd.cli import main\n"
        "main()"
    )
    done = subprocess.run([sys.executable, "-c", code, command], capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 128 + signal.Signals[name]
    assert done.stderr == f"palpd: interrupted by {name} while palpd was starting{moved}\n"


def test_before_the_handler_of_signals_almost_nothing_is_imported() -> None:
    code = "import sys; before = set(sys.modules); import palpd.cli; print(*(set(sys.modules) - before - {'palpd', 'palpd.cli'}))"
    done = subprocess.run([sys.executable, "-S", "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert not {"typing", "contextlib", "collections", "enum", "signal", "re", "palpd.errors"} & set(done.stdout.split())


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--colour"], "no such option: --colour; palpd --help shows what is expected"),
        (["bogus"], "no such command 'bogus'; palpd --help shows what is expected"),
        (["export", "run.mcap"], "export was given no file to write; give --csv FILE, --parquet FILE, or both"),
        (["start", "a\nb.yaml"], "a b.yaml cannot be read (No such file or directory); give the path of a file that exists"),
    ],
)
def test_words_that_fit_no_command_are_one_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: list[str], sentence: str
) -> None:
    monkeypatch.setattr(sys, "argv", ["palpd", *words])
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code == 2
    assert capsys.readouterr().err == f"palpd: {sentence}\n"


PALPD = [sys.executable, "-m", "palpd"]


@pytest.mark.parametrize("words", [["--help"], ["check-config", "config.yaml"]])
def test_a_stdout_on_a_full_disk_is_one_sentence(words: list[str]) -> None:
    with open("/dev/full", "w") as full:  # noqa: PTH123 - a device
        done = subprocess.run([*PALPD, *words], stdout=full, stderr=subprocess.PIPE, text=True, cwd=ROOT, check=False)
    assert done.returncode == 2
    assert done.stderr == "palpd: what it prints cannot be written (No space left on device); send it to another place\n"


def test_a_reader_that_leaves_early_is_no_error_to_speak_of() -> None:
    with subprocess.Popen([*PALPD, "--help"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT) as process:
        assert process.stdout is not None
        process.stdout.close()
        assert process.stderr is not None
        assert process.stderr.read() == ""
    assert process.returncode == 1


def test_a_terminal_without_the_signs_gets_the_tables_all_the_same(tmp_path: Path) -> None:
    config = tmp_path / os.fsdecode(b"c\xff.yaml")
    config.write_bytes((ROOT / "config.yaml").read_bytes())
    done = subprocess.run(
        [*PALPD, "check-config", config], capture_output=True, cwd=ROOT, check=False, env=os.environ | {"PYTHONIOENCODING": "ascii"}
    )
    assert done.returncode == 0
    assert done.stderr == b""
    assert done.stdout.rstrip().endswith(b"c\\udcff.yaml is sound.")


@pytest.mark.parametrize("name", ["c[/x].yaml", "c[red].yaml", "c[bold]"])
def test_a_name_that_looks_like_markup_is_printed_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.chdir(tmp_path)
    Path(name).parent.mkdir(exist_ok=True)
    Path(name).write_bytes((ROOT / "config.yaml").read_bytes())
    done = CliRunner().invoke(app, ["check-config", name])
    assert done.exit_code == 0
    assert f"{name} is sound." in done.output


def test_the_page_is_not_served_with_a_plan_that_no_run_would_take(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    plan, config = tmp_path / "plan.yaml", written(tmp_path, "paths: {state: here}")
    plan.write_text("depths_m: [deep]\n")
    monkeypatch.setattr(os, "execve", lambda *_: pytest.fail("the server was started"))
    monkeypatch.setattr(sys, "argv", ["palpd", "web", "--config", str(config), "--plan", str(plan)])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    assert str(plan) in capsys.readouterr().err
    assert not (tmp_path / "here").exists()


@pytest.mark.parametrize("words", [["web", "--listen", ""], ["stream", "--metrics", "9464", "--listen", " "], ["emulate", "--host", ""]])
def test_an_empty_address_is_refused_and_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str]) -> None:
    monkeypatch.chdir(tmp_path)
    written(tmp_path, "")
    done = CliRunner().invoke(app, words)
    assert isinstance(done.exception, PalpdError)
    assert "127.0.0.1 is this computer only" in str(done.exception)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["config.yaml"]


def test_a_demo_whose_page_cannot_listen_says_so_before_anything_is_emulated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        monkeypatch.setattr("palpd.cli.service.PAGE_PORT", taken.getsockname()[1])
        done = CliRunner().invoke(app, ["demo", "--page", "--out", str(tmp_path / "demo")])
    assert isinstance(done.exception, Refused)
    assert "Address already in use" in str(done.exception)
    assert not (tmp_path / "demo").exists()


def test_a_demo_says_that_the_server_of_its_page_has_died(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    @contextmanager
    def no_service(folder: Path, _: object) -> Iterator[Path]:
        yield written(folder, "")

    monkeypatch.setattr("palpd.cli.service.PAGE_PORT", 0)
    monkeypatch.setattr("palpd.daemon.demo.service_on_wires", no_service)
    monkeypatch.setattr(sys, "executable", "false")
    done = CliRunner().invoke(app, ["demo", "--page", "--out", str(tmp_path)])
    assert done.exit_code == 3
    assert f"the server of the page has died (exit code 1); see {tmp_path}/page.log" in done.output


@pytest.mark.parametrize(
    ("words", "answers"),
    [
        (["emulate", "--model", "ur10e"], ("'ur10e'", "UR10e", "counts", "needs a driver", "docs/what-works.md")),
        (["init", "--model", "franka"], ("'franka'", "needs a driver", "docs/what-works.md")),
        (["export-sim", "cell.yaml", "--to", "isaac", "--out", "x"], ("'isaac'", "FMI 3.0", "--simulated FILE", "docs/what-works.md")),
    ],
)
def test_whoever_asks_for_another_robot_or_simulator_reads_what_works(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: list[str], answers: tuple[str, ...]
) -> None:
    monkeypatch.setattr(sys, "argv", ["palpd", *words])
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code == 2
    sentence = capsys.readouterr().err
    assert all(answer in sentence for answer in answers)
    assert "Value error" not in sentence


def test_a_table_in_a_pipe_is_as_wide_as_it_needs_and_on_a_narrow_line_as_it_was_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    try:
        for columns, width in ((None, PIPE_WIDTH), ("60", 60)):
            terminal.cache_clear()
            monkeypatch.delenv("COLUMNS", raising=False) if columns is None else monkeypatch.setenv("COLUMNS", columns)
            assert not terminal().is_terminal
            assert terminal().width == width
    finally:
        terminal.cache_clear()


def test_a_curve_is_read_in_the_unit_that_the_name_of_its_column_says(tmp_path: Path) -> None:
    """A force in mN was taken for N, and made a modulus of a thousand times its size."""
    depths_mm = [0.01 * step for step in range(-100, 200)]
    rows = [f"{depth},{4e3 / 3 * 50e3 / 0.75 * 0.004**0.5 * max(depth * 1e-3, 0.0) ** 1.5}" for depth in depths_mm]

    def modulus(force: str, *options: str) -> Any:
        (tmp_path / "curve.csv").write_text("\n".join([f"depth (mm),{force}", *rows]))
        words = ["analyse", str(tmp_path / "curve.csv"), "--depth-column", "depth (mm)", "--force-column", force, "--tip-radius-m", "0.004"]
        return CliRunner().invoke(app, [*words, *options, "--json", str(tmp_path / "out.json"), "--force"])

    assert "E = 50 kPa" in modulus("load (mN)").output
    assert "was read in" not in modulus("load (mN)", "--force-unit", "mN").output
    assert "column load (mN) was read in N, as given, and its name says mN" in " ".join(
        modulus("load (mN)", "--force-unit", "N").output.split()
    )
    for name, unit in (
        ("load (lbf)", "lbf"),
        ("load (g)", "gf"),
        ("load (KN)", "kN"),
        ("load (V)", "V"),
        ("load (cps)", "cps"),
        ("a (mm)", "mm"),
    ):
        assert f"column {name} is in {unit}, expected a force in N, mN, uN, nN" in str(modulus(name).exception)
    assert "E = 50 kPa" in modulus("load (cps)", "--force-unit", "mN").output
    rows.insert(0, "mm,mN")
    assert "mN stands below load, and it was read in N; give --force-unit" in str(modulus("load").exception)
    assert "E = 50 kPa" in modulus("load", "--force-unit", "mN").output


def test_what_a_stopped_free_motion_has_left_does_not_stand_in_the_way_of_the_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept: list[Path] = []
    monkeypatch.setattr("palpd.cli.jobs.carried_out", lambda *words: kept.append(words[3]))
    (tmp_path / "config.yaml").write_text("paths: {runs: runs, state: state}")
    for name in ("free.mcap", "free.new.mcap"):
        (tmp_path / name).touch()
    words = ["free-motion", "--config", str(tmp_path / "config.yaml"), "--out", str(tmp_path / "free.mcap"), "--force"]
    CliRunner().invoke(app, words)
    assert not kept[0].exists()
