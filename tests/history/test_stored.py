"""Which recording a name means, and what stands beside it."""

import fcntl
import os
from pathlib import Path

import pytest

from palpd.errors import RecordingError
from palpd.history.stored import beside, name_in, printable, recording_meant, recording_named, stored_recordings, unfinished_recordings


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("20261122-101500-palpation.mcap", "20261123-101500-palpation.mcap", "demo-1/palpation.mcap", "demo-2/palpation.mcap"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"x")
    os.utime(tmp_path / "demo-1/palpation.mcap", (2e9, 2e9))
    return tmp_path


def test_recordings_in_folders_below_are_listed_with_what_stands_beside_them(folder: Path) -> None:
    for name in ("palpation.remarks.json", "palpation.diagnosis.json", "palpation.A.diagnosis.json", "palpation.report.html"):
        (folder / "demo-1" / name).write_text("{}")
    recordings = stored_recordings(folder)
    assert sorted(recordings) == ["20261122-101500-palpation", "20261123-101500-palpation", "demo-1/palpation", "demo-2/palpation"]
    assert sorted(recordings["demo-1/palpation"].beside) == [
        "palpation.A.diagnosis.json", "palpation.diagnosis.json", "palpation.remarks.json",
    ]  # fmt: skip
    assert not recordings["demo-2/palpation"].beside


def test_recordings_that_were_cut_off_are_listed_until_they_are_recovered_and_not_while_a_run_writes_them(tmp_path: Path) -> None:
    (tmp_path / "map").mkdir()
    for name in ("killed", "recovered", "map/press-3", "running"):
        (tmp_path / f"{name}.part").write_bytes(b"x")
    (tmp_path / "recovered.mcap").write_bytes(b"x")
    with (tmp_path / "running.part").open("rb") as recorder:
        fcntl.flock(recorder, fcntl.LOCK_EX)
        assert unfinished_recordings(tmp_path) == {name: tmp_path / f"{name}.part" for name in ("killed", "map/press-3")}
    assert "running" in unfinished_recordings(tmp_path), "its recorder has died"
    assert unfinished_recordings(tmp_path / "absent") == {}
    assert stored_recordings(tmp_path).keys() == {"recovered"}


def test_a_whole_disk_is_not_searched(tmp_path: Path) -> None:
    deep = tmp_path / "a" / "b" / "c"
    deep.mkdir(parents=True)
    for place in (deep, deep.parent):
        (place / "run.mcap").write_bytes(b"x")
    assert list(stored_recordings(tmp_path)) == ["a/b/run"]


def test_what_is_no_regular_file_is_no_recording(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.mcap")
    (tmp_path / "folder.mcap").mkdir()
    (tmp_path / "nowhere.mcap").symlink_to("nothing")
    (tmp_path / "round").symlink_to(tmp_path)
    assert stored_recordings(tmp_path) == {}
    assert stored_recordings(tmp_path / "absent") == {}


@pytest.mark.parametrize(
    ("name", "path"),
    [
        ("20261122-101500-palpation", "20261122-101500-palpation.mcap"),
        ("20261122-101500-palpation.mcap", "20261122-101500-palpation.mcap"),
        ("20261123", "20261123-101500-palpation.mcap"),
        ("demo-2/palpation", "demo-2/palpation.mcap"),
        ("demo-2", "demo-2/palpation.mcap"),
        ("last", "demo-1/palpation.mcap"),
    ],
)
def test_a_name_a_beginning_an_end_or_last_means_one_recording(folder: Path, name: str, path: str) -> None:
    assert recording_named(name, folder) == folder / path


@pytest.mark.parametrize("name", ["2026", "palpation", "", "../secret", "nothing", "a\nb", "/etc/passwd"])
def test_a_name_that_means_none_or_several_is_refused_and_none_leaves_the_folder(folder: Path, name: str) -> None:
    (folder.parent / "secret.mcap").write_bytes(b"x")
    with pytest.raises(RecordingError):
        recording_named(name, folder)


def test_a_path_is_taken_as_it_is(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    assert recording_meant("demo-2/palpation.mcap", folder / "elsewhere") == Path("demo-2/palpation.mcap")
    assert recording_meant(str(folder / "absent.mcap"), folder) == folder / "absent.mcap"


def test_a_name_in_a_folder_is_relative_to_it(folder: Path) -> None:
    assert name_in(folder, folder / "demo-1" / "palpation.mcap") == "demo-1/palpation"
    assert name_in(folder / "demo-2", folder / "demo-1" / "palpation.mcap") is None
    assert beside(folder / "a.b.mcap", ".report.html") == folder / "a.b.report.html"


def test_control_characters_and_bytes_that_are_no_text_are_spelled_out() -> None:
    assert printable("a\x1b[31m\nb\udcff ü") == "a\\x1b[31m\\nb\\udcff ü"
