"""Tags and notes stand in a file beside the recording."""

import json
import threading
from pathlib import Path

import pytest

from palpd.errors import BadInput
from palpd.history.remarks import Remarks, remark, remarks_of

NOW = "2026-11-22T10:15:00+00:00"


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "run.mcap"
    path.write_bytes(b"evidence")
    return path


def test_tags_and_notes_are_kept_and_the_recording_is_not_written_to(recording: Path) -> None:
    remark(recording, NOW, tags=["phantom", "good"], note=" first try ")
    remark(recording, NOW, tags=["good"], untag=["phantom"])
    remarks = remarks_of(recording)
    assert remarks.tags == ("good",)
    assert [note.text for note in remarks.notes] == ["first try"]
    assert recording.read_bytes() == b"evidence"
    assert sorted(path.name for path in recording.parent.iterdir()) == ["run.mcap", "run.remarks.json"]


def test_a_run_without_remarks_has_none_and_gets_no_file(recording: Path) -> None:
    assert remarks_of(recording) == Remarks()
    remark(recording, NOW)
    assert [path.name for path in recording.parent.iterdir()] == ["run.mcap"]


@pytest.mark.parametrize("tag", ["", "two words", "a,b", "-x", "<b>", "../x", "x" * 41, "a\nb", "[red]"])
def test_a_tag_is_one_word(recording: Path, tag: str) -> None:
    with pytest.raises(BadInput, match="expected one word"):
        remark(recording, NOW, tags=[tag])


def test_what_cannot_be_done_is_refused_and_changes_nothing(recording: Path) -> None:
    remark(recording, NOW, tags=["good"])
    before = (recording.parent / "run.remarks.json").read_bytes()
    with pytest.raises(BadInput, match="has no tag 'bad'; it has good"):
        remark(recording, NOW, tags=["new"], untag=["bad"])
    with pytest.raises(BadInput, match="2001 letters"):
        remark(recording, NOW, note="x" * 2001)
    with pytest.raises(BadInput, match="cannot be read"):
        remark(recording.with_name("absent.mcap"), NOW, tags=["x"])
    assert (recording.parent / "run.remarks.json").read_bytes() == before


@pytest.mark.parametrize("content", ["", "[", "[]", '{"tags": 5}', '{"tags": [], "more": 1}', '{"notes": [{"text": "x"}]}', "\xff"])
def test_a_damaged_file_of_remarks_is_one_sentence(recording: Path, content: str) -> None:
    (recording.parent / "run.remarks.json").write_bytes(content.encode("latin-1"))
    with pytest.raises(BadInput) as refused:
        remarks_of(recording)
    assert "run.remarks.json" in str(refused.value)
    assert "\n" not in str(refused.value)


def test_remarks_made_at_the_same_time_are_all_kept(recording: Path) -> None:
    threads = [threading.Thread(target=remark, args=(recording, NOW, [f"tag-{number}"])) for number in range(20)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(json.loads((recording.parent / "run.remarks.json").read_text())["tags"]) == 20


def test_a_file_that_is_no_recording_gets_no_remarks(tmp_path: Path) -> None:
    (tmp_path / "passwd").write_text("root")
    with pytest.raises(BadInput, match="is no recording"):
        remark(tmp_path / "passwd", NOW, ["x"])
    assert [path.name for path in tmp_path.iterdir()] == ["passwd"]
