"""Every command tries the places of its outputs before it works, and refuses bad input in one sentence."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from palpd.cli import app
from palpd.daemon.programs import ProgramEnd
from palpd.errors import BadInput, ConfigError, PalpdError
from palpd.files import write_json
from tests.paths import ROOT

CONFIG, PLAN, PHANTOM = ROOT / "config.yaml", ROOT / "plan.yaml", ROOT / "palpd" / "cell" / "phantom.yaml"


def refused(*arguments: str | Path) -> PalpdError:
    """What a command raises; it must be an error of ours."""
    result: Result = CliRunner().invoke(app, [str(each) for each in arguments])
    assert isinstance(result.exception, PalpdError), result.output
    return result.exception


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder to work in, with the shipped files."""
    for file in (CONFIG, PLAN):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    "command",
    [
        ["run"], ["stiffness"], ["demo"], ["sim"], ["doctor"], ["check-config", "config.yaml"], ["replay", "no.mcap"],
        ["analyse", "no.csv"], ["map"], ["diagnose", "no.csv"], ["resolve"], ["tolerances", "no.csv", "--cell", "no.yaml"], ["effects"],
        ["blind"], ["study"], ["runs"], ["info", "no.mcap"],
    ],
)  # fmt: skip
def test_a_json_that_cannot_be_written_is_refused_before_anything_else(home: Path, command: list[str]) -> None:
    before = sorted(home.rglob("*"))
    error = refused(*command, "--json", "missing/out.json")
    assert "out.json cannot be written" in str(error)
    assert sorted(home.rglob("*")) == before


@pytest.mark.parametrize(
    ("command", "option"),
    [
        (["export", "no.mcap"], "--csv"), (["import", "no.csv"], "--csv"), (["simulate", "no.csv", "--cell", "no.yaml"], "--csv"),
        (["map"], "--out"), (["diagnose", "no.csv"], "--cell-out"), (["diagnose", "no.csv"], "--report"), (["blind"], "--resume"),
    ],
)  # fmt: skip
def test_an_output_that_cannot_be_written_is_refused_before_the_input_is_read(home: Path, command: list[str], option: str) -> None:
    (home / "folder.csv").mkdir()
    assert "cannot be written" in str(refused(*command, option, "missing/out.png"))
    assert "is a folder" in str(refused(*command, option, "folder.csv"))


@pytest.mark.parametrize("command", [["export", "no.mcap"], ["import", "no.csv"], ["simulate", "no.csv", "--cell", "no.yaml"]])
def test_a_recording_that_exists_is_not_overwritten(home: Path, command: list[str]) -> None:
    (home / "out.csv").write_text("kept")
    assert "exists and is not overwritten" in str(refused(*command, "--csv", "out.csv"))
    assert (home / "out.csv").read_text() == "kept"


def test_folders_that_cannot_be_written_into_are_refused_before_the_arm_is_spoken_to(home: Path) -> None:
    (home / "config.yaml").write_text("paths: {runs: /proc/runs, state: state}")
    for command in (["run"], ["calibrate"], ["serve"], ["stiffness"], ["resolve"]):
        error = refused(*command)
        assert isinstance(error, BadInput)
        assert "cannot be written" in str(error)


@pytest.mark.parametrize("place", ["state", "runs"])
def test_a_service_with_a_read_only_folder_ends_with_one_sentence(home: Path, place: str) -> None:
    (home / "config.yaml").write_text("paths: {runs: runs, state: state}")
    (home / place).mkdir()
    mount = f"mount --bind {place} {place} && mount -o remount,ro,bind {place} || exit 77"
    done = subprocess.run(
        ["unshare", "--mount", "sh", "-c", f"{mount}; exec {sys.executable} -m palpd serve"],
        capture_output=True, text=True, check=False, timeout=60.0, env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    if done.returncode not in (0, 2):
        pytest.skip(f"this user may not mount: {done.stderr}")
    assert done.returncode == 2
    assert "Read-only file system" in done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("safety: {contact_limit_N: 5}\nsafety: {contact_limit_N: 24}\n", "line 2: the key 'safety' stands here and in line 1"),
        ("safety: {contact_limit_N: yes}\n", "line 1: safety.contact_limit_N is true; expected a number"),
        ("robot: {host: ''}\n", "robot.host is ''"),
        ("safety: {contact_limit_N: " + "9" * 5000 + "}\n", "5000 digits"),
        ("[" * 5000, "nested deeper"),
    ],
)
def test_check_config_refuses_what_would_move_a_limit(home: Path, text: str, words: str) -> None:
    (home / "config.yaml").write_text(text)
    error = refused("check-config", "config.yaml")
    assert isinstance(error, ConfigError)
    assert words in str(error)
    assert "\n" not in str(error)


def test_a_pipe_and_a_device_are_refused_as_input(home: Path) -> None:
    os.mkfifo(home / "pipe")
    for path in ("pipe", "/dev/zero"):
        for command in (
            ["check-config", path],
            ["check-config", "config.yaml", "--plan", path],
            ["diagnose", "no.csv", "--cell", path],
            ["diagnose", path, "--cell", str(PHANTOM)],
            ["simulate", path, "--cell", str(PHANTOM), "--csv", "out.csv"],
            ["analyse", path, "--force-column", "F", "--depth-column", "z"],
            ["map", "--presses", path],
            ["blind", "--compare", path],
            ["train", path, "--out", "model.onnx"],
            ["replay", path],
        ):
            assert "expected a regular file" in str(refused(*command)), command


def test_an_empty_plan_is_refused(home: Path) -> None:
    (home / "plan.yaml").write_text("")
    for command in (["run"], ["sim"], ["start", "plan.yaml"], ["check-config", "config.yaml", "--plan", "plan.yaml"]):
        assert "plan.yaml: sites and depths_m are not given" in str(refused(*command))


def test_what_belongs_together_is_asked_for(home: Path) -> None:
    for command, words in (
        (["diagnose", "no.csv"], "--cell is required: give the cell.yaml that your simulator uses; palpd cell-from writes a first one"),
        (["effects", "no.such"], "there is no effect 'no.such'"),
        (["blind", "--ablation", "nothing"], "--ablation is 'nothing'; expected one of"),
        (["blind", "--source", "nothing"], "--source is 'nothing'; expected one of"),
        (["blind", "--recordings", "."], "--recordings belongs to --source injected"),
        (["blind", "--source", "injected", "--causes", "plan.yaml"], "--causes says what acts in --recordings"),
        (["blind", "--source", "injected", "--recordings", "."], "causes.yaml"),
        (["study", "--free", "a.mcap"], "needs both --free and --palpation"),
    ):
        assert words in str(refused(*command)), command


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("analyse a.csv --cell c.yaml --force-column f --fit peak", "--cell is given, so --force-column and --fit would not count"),
        ("analyse run.mcap --tip-radius-m 3", "run.mcap is a recording of the daemon, so --tip-radius-m would not count; leave it out"),
        ("analyse a.csv --site A", "a.csv is no recording of the daemon, so --site A chooses nothing in it"),
        ("analyse a.csv --cell cell.yaml --site A", "a.csv is no recording of the daemon, so --site A chooses nothing in it"),
        ("import a.csv --force-column f", "without --csv files are only listed, so --force-column would not count; give --csv too"),
        ("demo --page --no-wires", "--page is given, so --no-wires would not count"),
        ("demo --full --effect sensor.gain", "--effect is given, so --full would not count"),
        ("sim --cell c.yaml --configured-cell", "--cell is given, so --configured-cell would not count"),
        ("emulate --net-ft-port 8099 --sensor-link hex", "--net-ft-port is given, so --sensor-link would not count"),
        ("run --dry --return", "--dry is given, so --return would not count"),
        ("status --watch --json a.json", "--watch is given, so --json would not count"),
        ("job x --agree --cancel", "--cancel is given, so --agree would not count"),
        ("stream --layout a.json --foxglove 8765", "--layout is given, so --foxglove would not count"),
        ("map --presses p.csv --emulated", "--presses is given, so --emulated would not count"),
        ("study --published --free a.mcap", "--published is given, so --free would not count"),
        ("effects sensor.gain --remove learned.a", "--remove is given, so NAMES would not count"),
        ("blind --advice --docs d", "--advice is given, so --docs would not count"),
        ("resolve --recording a.csv --plan p.yaml", "--recording is given, so --plan would not count"),
        ("runs last --tag good --since 2026-11-22", "RUN is given, so --since would not count"),
    ],
)
def test_an_option_that_would_not_count_is_refused(home: Path, line: str, words: str) -> None:
    shutil.copy(ROOT / "palpd" / "cell" / "phantom.yaml", home / "cell.yaml")
    (home / "a.csv").write_text("t_s\n")
    before = sorted(home.iterdir())
    assert words in str(refused(*line.split()))
    assert sorted(home.iterdir()) == before


def test_a_file_of_effects_is_read_or_refused(home: Path) -> None:
    os.mkfifo(home / "pipe.py")
    (home / "exits.py").write_text("import sys; sys.exit(0)")
    assert "expected a regular file" in str(refused("effects", "--effects", "pipe.py"))
    assert "could not be read as effects (SystemExit" in str(refused("effects", "--effects", "exits.py"))


@pytest.mark.parametrize("command", [["train", "no.mcap", "--out", "model.onnx"], ["doctor"]])
def test_a_configuration_that_is_named_must_exist(home: Path, command: list[str]) -> None:
    assert "other.yaml cannot be read" in str(refused(*command, "--config", "other.yaml"))


@pytest.mark.parametrize("command", [["free-motion"], ["map"], ["train", "no.csv"]])
@pytest.mark.parametrize("name", ["", "/", "loop.mcap"])
def test_an_output_that_is_no_name_of_a_file_is_refused(home: Path, command: list[str], name: str) -> None:
    (home / "loop.mcap").symlink_to("loop.mcap")
    assert isinstance(refused(*command, "--out", name), BadInput)


@pytest.mark.parametrize(
    "command",
    [
        ["import", "a.csv", "--csv", "b.csv", "--force-N-per-V", "nan"], ["import", "a.csv", "--csv", "b.csv", "--tare-s", "inf"],
        ["analyse", "a.csv", "--poisson-ratio", "nan"], ["analyse", "a.csv", "--machine-stiffness-N-per-m", "inf"],
        ["analyse", "a.csv", "--machine-stiffness-N-per-m", "1e-300"],
    ],
)  # fmt: skip
def test_no_option_is_a_number_beyond_every_unit(home: Path, command: list[str]) -> None:
    assert "expected 0 or a number of 1e-18 to 1e+15" in str(refused(*command))


@pytest.mark.parametrize(
    "command",
    [
        ["simulate", "a.csv", "--cell", "c.yaml", "--csv", "o.csv", "--noise", "-1"],
        *([name, "--seed", "-1"] for name in ("sim", "map", "blind", "study")),
    ],
)
def test_seeds_begin_at_zero(home: Path, command: list[str]) -> None:
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 2
    assert "greater than or equal to 0" in result.output


@pytest.mark.parametrize(("option", "value"), [("--jobs", "2"), ("--scheduler", "tcp://127.0.0.1:1")])
def test_options_for_a_folder_are_refused_with_one_recording(home: Path, option: str, value: str) -> None:
    error = refused("diagnose", "no.csv", "--cell", "no.yaml", option, value)
    assert f"{option} is for a folder of recordings" in str(error)


def test_empty_files_are_refused(home: Path) -> None:
    (home / "empty.yaml").write_text("# nothing\n")
    assert "empty.yaml is empty, expected keys and values" in str(refused("check-config", "empty.yaml"))
    assert "empty.yaml is empty, expected keys and values" in str(refused("diagnose", "no.csv", "--cell", "empty.yaml"))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("model: {path: missing.onnx}", "missing"),
        ("paths: {runs: /proc/nope}", "cannot be written"),
        ("safety: {workspace_m: [[-1.0, 1.0], [-1.0, 1.0], [0.0, 5.0]]}", "a height of safety is 5 m, expected -2 to 2 m"),
        ("cell: {probe: {mass_kg: 10.0}}", "probe.mass_kg is 10 kg, expected 0 to 5 kg"),
        ("cell: {probe: {mass_kg: 200.0}}", "a weight of 1962 N, beyond the sensor's 200 N; write it in kg"),
        ("cell: {probe: {tip_radius_m: 0.5}}", "tip_radius_m is 0.5, expected at most 0.1 m; write it in metres (0.5 mm is 0.0005)"),
    ],
)
def test_a_configuration_is_not_sound_with_what_cannot_be_used(home: Path, text: str, words: str) -> None:
    (home / "odd.yaml").write_text(text)
    assert words in str(refused("check-config", "odd.yaml"))


def test_an_implausible_configuration_is_sound_once_it_is_accepted(home: Path) -> None:
    (home / "odd.yaml").write_text("cell: {probe: {mass_kg: 10.0}}")
    assert "--accept-implausible" in str(refused("check-config", "odd.yaml"))
    assert CliRunner().invoke(app, ["check-config", "odd.yaml", "--accept-implausible"]).exit_code == 0


def test_a_check_that_was_stopped_does_not_leave_the_figures_of_the_day_before(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_json(home / "today.json", {"level": "ok"})
    end = ProgramEnd("stopped", "the guard ended it at 12.3 N", 3, {})
    monkeypatch.setattr("palpd.cli.jobs.carried_out", lambda *_: end)
    result = CliRunner().invoke(app, ["check", "--config", "config.yaml", "--json", "today.json"])
    assert result.exit_code == 3
    figures = json.loads((home / "today.json").read_text(encoding="utf-8"))
    assert figures["level"] == "stop"
    assert figures["sentence"] == "It did not come to its end: the guard ended it at 12.3 N."
