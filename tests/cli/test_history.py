"""palpd runs, info and report as a user types them."""

import io
import json
import os
from pathlib import Path
from typing import get_args

import pytest
from rich.console import Console
from typer.testing import CliRunner, Result

from palpd.cli import app
from palpd.daemon.motion_job import STILL_KINDS, Kind
from palpd.errors import BadInput, PalpdError, RecordingError
from palpd.history.course import read_course
from palpd.history.stored import recording_named
from tests.history.conftest import runs, simulated

__all__ = ["runs", "simulated"]


def typed(*words: str | Path) -> Result:
    result = CliRunner().invoke(app, [str(word) for word in words], env={"COLUMNS": "160"})
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def refusal(*words: str | Path) -> str:
    with pytest.raises(PalpdError) as refused:
        typed(*words)
    assert "\n" not in str(refused.value)
    return str(refused.value)


def test_the_help_of_runs_names_every_kind_that_is_recorded() -> None:
    help_text = " ".join(typed("runs", "--help").stdout.replace("│", " ").split())
    assert [kind for kind in get_args(Kind) if kind not in (*STILL_KINDS, "check") and kind not in help_text] == []


def test_runs_are_listed_tagged_filtered_and_written_as_json(runs: Path, tmp_path: Path) -> None:
    assert typed("runs", "--folder", runs).stdout.index("day-2") < typed("runs", "--folder", runs).stdout.index("day-0")
    printed = typed("runs", "day-0", "last", "--tag", "good", "--note", "[red]a probe[/]", "--folder", runs).stdout
    assert "tags good; 1 note" in printed
    json_file = tmp_path / "runs.json"
    printed = typed("runs", "--tagged", "good", "--until", "2026-09-21", "--folder", runs, "--json", json_file).stdout
    assert "[red]a probe[/]" in printed
    assert [run["name"] for run in json.loads(json_file.read_text())["runs"]] == ["day-0"]
    assert "No run in" in typed("runs", "--tagged", "bad", "--folder", runs).stdout
    assert "2 older runs are not shown; --most 3 shows all" in typed("runs", "--most", "1", "--folder", runs).stdout
    typed("runs", "day-0", "--untag", "good", "--folder", runs)
    assert "day-0" not in typed("runs", "--tagged", "good", "--folder", runs).stdout
    (runs / "catalogue.sqlite").write_bytes(b"no catalogue")
    typed("runs", "--folder", runs, "--json", json_file)
    assert "was damaged or of another version; it was made anew from 3 recordings" in json.loads(json_file.read_text())["notes"][0]
    assert "made anew from 3 recordings" in typed("runs", "--rebuild", "--folder", runs).stdout


def test_a_recording_that_was_cut_off_is_named_with_the_command_that_restores_it(tmp_path: Path) -> None:
    """After a loss of power the run of the day before was in no list, and nothing said that it can be had."""
    (tmp_path / "20261126-101500-palpation.part").write_bytes(b"half")
    listed = typed("runs", "--folder", tmp_path, "--json", tmp_path / "runs.json").stdout
    assert f"20261126-101500-palpation; palpd recover {tmp_path / '20261126-101500-palpation.part'} restores" in listed
    assert json.loads((tmp_path / "runs.json").read_text())["unfinished"] == ["20261126-101500-palpation"]


LONG = "palpation-20261122-233001-of-the-sample-of-november"


@pytest.mark.parametrize(("width", "tty"), [(20, True), (60, True), (20, False)])
def test_a_narrow_terminal_and_a_pipe_break_no_name_of_a_run(runs: Path, monkeypatch: pytest.MonkeyPatch, width: int, tty: bool) -> None:
    (runs / "day-0.mcap").rename(runs / f"{LONG}.mcap")
    printed = io.StringIO()
    console = Console(file=printed, width=width, force_terminal=tty, color_system=None)
    monkeypatch.setattr("palpd.cli.history.terminal", lambda: console)
    for words in (["runs"], ["runs", "--trend", "A"], ["info", LONG]):
        typed(*words, "--folder", runs)
        lines = [line for line in printed.getvalue().splitlines() if LONG in line]
        assert lines, words
        if not tty and words == ["runs"]:
            assert all(cell in lines[0] for cell in ("done", "A ")), "a line for each run"
        printed.truncate(0)


def test_the_folder_of_the_runs_is_that_of_the_configuration(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(runs.parent)
    assert "day-0" in typed("runs").stdout
    (runs.parent / "config.yaml").write_text("paths: {runs: elsewhere}")
    assert "elsewhere is no folder" in refusal("runs")
    (runs.parent / "config.yaml").write_text("paths: {runs: runs}")
    assert "day-0" in typed("runs").stdout


def test_a_trend_is_a_table_and_a_slope(runs: Path, tmp_path: Path) -> None:
    printed = typed("runs", "--trend", "A", "--folder", runs, "--json", tmp_path / "trend.json").stdout
    assert "kPa per day" in printed
    assert len(json.loads((tmp_path / "trend.json").read_text())["runs"]) == 3
    assert "no run in" in refusal("runs", "--trend", "Z", "--folder", runs)


def test_info_is_one_screen_of_what_a_run_was(runs: Path, tmp_path: Path) -> None:
    typed("runs", "day-1", "--note", "wet\x1b[2J", "--folder", runs)
    printed = typed("info", "day-1", "--folder", runs, "--json", tmp_path / "info.json", "--course", tmp_path / "course.npy").stdout
    for words in (
        "done: 3 presses at 1 site, 1 depth cut short.",
        "robot",
        "limits",
        "Moduli in kPa",
        "Loop: ",
        "cut short: site A",
        "SHA-256",
        "report: none yet",
    ):
        assert words in printed, words
    assert "\x1b" not in printed
    assert len(printed.splitlines()) < 40
    facts = json.loads((tmp_path / "info.json").read_text())
    assert facts["remarks"]["notes"][0]["text"] == "wet\x1b[2J"
    assert (facts["mood"], facts["headline"]) == ("remarkable", "Done: 3 presses at 1 site, 1 depth cut short.")
    assert len(read_course(tmp_path / "course.npy")) == facts["loop"]["ticks"]


def test_a_report_stands_beside_its_recording_or_where_it_is_asked_for(runs: Path, tmp_path: Path) -> None:
    typed("report", "day-0", "--folder", runs)
    assert (runs / "day-0.report.html").exists()
    typed("report", runs / "day-0.mcap", "--beside", "day-1", "--folder", runs, "--pdf", tmp_path / "a.pdf", "--png", tmp_path / "a.png")
    assert (runs / "day-0.beside-day-1.html").exists()
    assert (tmp_path / "a.pdf").read_bytes().startswith(b"%PDF")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    typed("report", "day-0", "--folder", runs, "--out", tmp_path / "x.html")
    assert (tmp_path / "x.html").exists()


def test_what_cannot_be_done_is_one_sentence(runs: Path, tmp_path: Path) -> None:
    assert "no recording" in refusal("info", "nothing", "--folder", runs)
    assert "day-" in refusal("report", "day", "--folder", runs)
    assert "expected .pdf" in refusal("report", "day-0", "--folder", runs, "--pdf", tmp_path / "a.png")
    assert "expected one word" in refusal("runs", "day-0", "--tag", "two words", "--folder", runs)
    assert "no RUN is given" in refusal("runs", "--tag", "good", "--folder", runs)
    assert "nothing is given to do" in refusal("runs", "day-0", "--folder", runs)
    assert "the day is 'yesterday'" in refusal("runs", "--since", "yesterday", "--folder", runs)
    assert "cannot be written" in refusal("report", "day-0", "--folder", runs, "--out", tmp_path / "absent" / "x.html")
    (runs / "broken.mcap").write_bytes(b"no recording")
    with pytest.raises(RecordingError, match="not an MCAP file"):
        typed("info", "broken", "--folder", runs)
    with pytest.raises(BadInput, match="cannot be written"):
        typed("runs", "day-0", "--tag", "x", "--folder", runs, "--json", "absent/x.json")


def test_one_word_that_is_wrong_tags_no_run(runs: Path) -> None:
    assert "nothing" in refusal("runs", "day-0", "nothing", "--tag", "good", "--folder", runs)
    assert not (runs / "day-0.remarks.json").exists()


def test_the_last_run_is_that_which_was_recorded_last_whatever_the_times_of_the_files(runs: Path) -> None:
    days = sorted(runs.glob("day-*.mcap"))
    for age, path in enumerate(days):
        os.utime(path, (2e9 - age, 2e9 - age))
    assert recording_named("last", runs) == days[-1]
    os.utime(days[-1], (1.0, 1.0))
    assert recording_named("last", runs) == days[-1]
