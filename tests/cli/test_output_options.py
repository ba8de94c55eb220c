"""Every option that names an output, found by its type: what a command reads, and what palpd did not make, stays as it was."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest
from typer.models import ArgumentInfo, OptionInfo
from typer.testing import CliRunner, Result

from benchmarks.fuzz_commands import LINES, spelled
from palpd.cli import app
from palpd.cli.output_options import FOLDER, LINK, NEW_RECORDING, OWN_FOLDER, RESUMED, SOCKET, Output, inputs_of, outputs_of
from palpd.errors import PalpdError
from palpd.file_kinds import JSON, RECORDING, kind_made
from palpd.files import clear_socket, write_json
from tests.paths import ROOT

CELL = (ROOT / "palpd" / "cell" / "phantom.yaml").read_bytes()
RUN = (ROOT / "tests" / "version_1" / "recording.mcap").read_bytes()
NO_FILE = (FOLDER, OWN_FOLDER, NEW_RECORDING, SOCKET, LINK, RESUMED)
"""What an option names besides a plain file."""
READ_OR_MADE = {"token_file", "state_file", "socket", "folder", "prefix"}
"""Paths that are neither: a secret or a memory that is read or made, places to look at, and the root of an installation."""


def commands() -> dict[str, Callable[..., Any]]:
    listed = [(command.name, command.callback) for command in app.registered_commands]
    return {name or callback.__name__.replace("_", "-"): callback for name, callback in listed if callback is not None}


def option_of(command: Callable[..., Any], parameter: str) -> str:
    """The option of a parameter, empty for an argument."""
    hint = get_type_hints(command, include_extras=True)[parameter]
    info = next(part for part in hint.__metadata__ if isinstance(part, OptionInfo | ArgumentInfo))
    return spelled(info)


def outputs() -> Iterator[tuple[str, str, Output]]:
    for name, command in commands().items():
        for parameter, output in outputs_of(command).items():
            yield name, option_of(command, parameter), output


FILES = [each for each in outputs() if each[2].kind not in NO_FILE]


def is_input(word: str) -> bool:
    return word.startswith("{") and not word.startswith(("{out", "{new", "{folder"))


def template_of(name: str) -> list[str]:
    return next(line.split() for line in LINES.strip().splitlines() if line.split()[0] == name)


def with_output(name: str, option: str, path: str, read: str) -> list[str]:
    """A line of a command in which every input is one file, with this output."""
    words = [read if is_input(word) else word.strip("{}") for word in template_of(name)]
    if option in words:
        words[words.index(option) + 1] = path
        return words
    return [*words, option, path]


def refused(words: list[str]) -> str:
    result: Result = CliRunner().invoke(app, words)
    assert isinstance(result.exception, PalpdError | SystemExit), (words, result.exception, result.output)
    assert result.exit_code
    return str(result.exception)


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "read.yaml").write_bytes(CELL)
    (tmp_path / "link.yaml").symlink_to("read.yaml")
    os.link(tmp_path / "read.yaml", tmp_path / "hard.yaml")
    (tmp_path / "run.mcap").write_bytes(RUN)
    (tmp_path / "mine").write_text("my thesis")
    write_json(tmp_path / "made.json", {"verdict": "done"})
    monkeypatch.chdir(tmp_path)
    return tmp_path


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_every_path_of_every_command_is_an_input_or_an_output_and_outputs_have_force() -> None:
    assert len(commands()) == 54
    words = ("write", "kept", "keep", "link to make", "save")
    for name, command in commands().items():
        for parameter in inputs_of(command):
            hint = get_type_hints(command, include_extras=True)[parameter]
            about = next(part.help or "" for part in hint.__metadata__ if isinstance(part, OptionInfo | ArgumentInfo))
            assert parameter in READ_OR_MADE or not any(word in about.lower().split() for word in words), (name, parameter, about)
        if outputs_of(command) and name != "stream":  # whose --force is a socket for newtons
            assert "--force" in CliRunner().invoke(app, [name, "--help"]).output, name


@pytest.mark.parametrize(("name", "option", "output"), FILES, ids=lambda value: str(value).strip("-") if isinstance(value, str) else "")
def test_no_output_is_written_over_an_input_or_a_recording_or_what_palpd_did_not_make(
    home: Path, name: str, option: str, output: Output
) -> None:
    before = contents(home)
    force = [] if name == "stream" else ["--force"]
    reads = any(map(is_input, template_of(name)))
    for path in ("read.yaml", "link.yaml", "hard.yaml"):
        for more in ([], force) if reads else ([],):
            sentence = refused([*with_output(name, option, path, "read.yaml"), *more])
            assert not reads or "is an input of this command" in sentence or "the same file as" in sentence, sentence
    for more in ([], force):
        assert "is a recording" in refused([*with_output(name, option, "run.mcap", "read.yaml"), *more])
    assert "is not overwritten" in refused(with_output(name, option, "mine", "read.yaml"))
    if output.kind != JSON:
        assert "is JSON, not" in refused(with_output(name, option, "made.json", "read.yaml"))
    assert contents(home) == before


SEVERAL = [name for name, command in commands().items() if sum(each.kind not in NO_FILE for each in outputs_of(command).values()) > 1]


@pytest.mark.parametrize("name", SEVERAL)
def test_two_outputs_of_a_call_cannot_be_one_file(home: Path, name: str) -> None:
    before = contents(home)
    (home / "other").symlink_to("new")
    options = [option for command, option, output in FILES if command == name]
    words = with_output(name, options[0], "new", "read.yaml")
    words = words if options[1] not in words else [*words[: words.index(options[1])], *words[words.index(options[1]) + 2 :]]
    assert "is given for two outputs" in refused([*words, options[1], "other"])
    assert contents(home) == before


@pytest.mark.parametrize(("name", "option", "kind"), [(a, b, c.kind) for a, b, c in outputs() if c.kind in (SOCKET, LINK)])
def test_sockets_and_links_replace_nothing_else(home: Path, name: str, option: str, kind: str) -> None:
    before = contents(home)
    (home / "device").symlink_to("/dev/null")
    for path in ("read.yaml", "run.mcap", "device", "n" * 5000, "/dev/null"):
        refused([name, option, path])
    assert (home / "device").readlink() == Path("/dev/null")
    assert contents(home) == before


@pytest.mark.parametrize(("name", "option"), [(a, b) for a, b, c in outputs() if c.kind == OWN_FOLDER])
def test_a_folder_of_recordings_is_not_written_into_and_others_need_force(home: Path, name: str, option: str) -> None:
    before = contents(home)
    assert "holds a recording" in refused([*with_output(name, option, ".", "read.yaml"), "--force"])
    (home / "run.mcap").unlink()
    assert "is not empty" in refused(with_output(name, option, ".", "read.yaml"))
    assert contents(home) == {path: content for path, content in before.items() if path != "run.mcap"}


def test_what_palpd_made_is_replaced_and_what_was_edited_since_is_not(home: Path) -> None:
    for _ in range(2):
        assert CliRunner().invoke(app, ["init", "cell"]).exit_code == 0
        assert CliRunner().invoke(app, ["check-config", "read.yaml", "--json", "made.json"]).exit_code in (0, 1)
    config = home / "cell" / "config.yaml"
    config.write_text(config.read_text().replace("contact_limit_N: 12", "contact_limit_N: 9"))
    assert "is not overwritten" in refused(["init", "cell"])
    assert "contact_limit_N: 9" in config.read_text()
    assert CliRunner().invoke(app, ["init", "cell", "--force"]).exit_code == 0
    assert "contact_limit_N: 12" in config.read_text()


def test_every_kind_of_output_is_known_by_its_content_when_it_is_written_again(home: Path) -> None:
    run, csv = "run.mcap", "a.csv"
    lines = (
        f"export {run} --csv {csv} --parquet a.parquet --site A",
        f"info {run} --json a.json --course a.npy --folder .",
        f"report {run} --out a.html --pdf a.pdf --png a.png --folder .",
        f"cell-from {csv} --out a.yaml --tip-radius-m 0.005",
        "map --presses p.csv --out a.svg",
    )
    (home / "p.csv").write_text("x_m,y_m,youngs_modulus_Pa\n" + "".join(f"{k / 100},{k / 200},{6e4 + k}\n" for k in range(6)))
    for _ in range(2):
        for line in lines:
            result = CliRunner().invoke(app, line.split())
            assert result.exit_code == 0, (line, result.exception, result.output)
    assert {path.suffix for path in home.glob("a.*") if kind_made(path)} == {path.suffix for path in home.glob("a.*")}
    assert kind_made(home / run) == RECORDING
    assert kind_made(home / "p.csv") is None


def test_a_served_socket_is_not_taken_away(home: Path) -> None:
    import socket

    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind("served")
        listener.listen()
        assert "already serves" in refused(["emulate", "--control", "served"])
        assert (home / "served").is_socket()
    clear_socket(Path("served"))
    assert not (home / "served").exists()


@pytest.mark.parametrize("number", ["nan", "-inf", "1e999"])
def test_no_option_takes_a_number_that_is_not_finite(home: Path, number: str) -> None:
    numbers = [(name, parameter) for name, command in commands().items() for parameter, hint in get_type_hints(command).items()
               if float in (hint, *get_args(hint))]  # fmt: skip
    assert len(numbers) > 15
    for name, parameter in numbers:
        option = option_of(commands()[name], parameter)
        words = [word if not is_input(word) else "read.yaml" for word in template_of(name)]
        assert refused([*(word.strip("{}") for word in words), f"{option}={number}"])
