"""The catalogue says what the recordings say, survives damage, and gets along with others."""

import json
import os
import shutil
import sqlite3
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from palpd.errors import BadInput, Refused
from palpd.history import catalogue as module
from palpd.history.catalogue import FILE, Catalogue, RunEntry, RunFilter, as_json
from palpd.history.dates import days_s
from palpd.history.facts import load
from palpd.history.remarks import remark
from tests.history.conftest import BEGAN_S, DAY_S

NOW = "2026-11-22T10:15:00+00:00"


def listed(folder: Path, **only: object) -> list[RunEntry]:
    with Catalogue(folder) as catalogue:
        catalogue.refresh()
        return catalogue.runs(RunFilter(**only))  # type: ignore[arg-type]


def names(folder: Path, **only: object) -> list[str]:
    return [entry.name for entry in listed(folder, **only)]


def test_it_lists_the_newest_first_with_what_the_recordings_say(runs: Path) -> None:
    entries = listed(runs)
    assert [entry.name for entry in entries] == ["day-2", "day-1", "day-0"]
    _, facts = load(runs / "day-0.mcap")
    oldest = entries[-1]
    assert (oldest.verdict, oldest.kind, oldest.dry, oldest.ticks) == ("done", "palpation", False, facts["loop"]["ticks"])
    assert oldest.started_s == pytest.approx(BEGAN_S)
    assert oldest.sites[0].static_Pa == facts["sites"][0]["static_youngs_modulus_Pa"]
    assert list(oldest.sites[0].static_ci95_Pa or ()) == facts["sites"][0]["static_ci95_Pa"]
    assert json.loads(json.dumps(as_json(oldest)))["sites"][0]["site"] == "A"


def test_the_day_that_is_shown_is_the_one_that_filters_in_any_time_zone(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hours = {}
    for zone in ("UTC0", "AAA-14", "BBB12"):
        with monkeypatch.context() as patched:
            patched.setenv("TZ", zone)
            time.tzset()
            shown = listed(runs)[1].started
            since_s, until_s = days_s(shown[:10], shown[:10])
            assert names(runs, since_s=since_s, until_s=until_s) == ["day-1"]
            assert load(runs / "day-1.mcap")[1]["started"] == shown
            hours[zone] = shown[11:13]
        time.tzset()
    assert len(set(hours.values())) > 1


def test_it_filters_by_day_site_verdict_tag_and_text(runs: Path) -> None:
    remark(runs / "day-1.mcap", NOW, tags=["good", "goodness"], note="Probe 7, wet")
    remark(runs / "day-2.mcap", NOW, tags=["goodness"])
    assert names(runs, since_s=BEGAN_S + DAY_S / 2, until_s=BEGAN_S + 1.5 * DAY_S) == ["day-1"]
    assert names(runs, tags=("good",)) == ["day-1"]
    assert names(runs, tags=("goodness",)) == ["day-2", "day-1"]
    assert names(runs, tags=("goodness", "good")) == ["day-1"]
    assert names(runs, text="probe 7") == ["day-1"]
    assert names(runs, text="%") == []
    assert names(runs, text="SIM00001", most=2) == ["day-2", "day-1"]
    assert names(runs, site="A", verdict="done", kind="palpation") == ["day-1", "day-0"]
    assert names(runs, verdict="stopped") == ["day-2"]
    assert names(runs, site="B") == names(runs, verdict="ended") == names(runs, kind="free_motion") == []
    assert names(runs, site="' OR 1=1 --") == names(runs, text="' OR 1=1 --") == []


def test_only_what_is_new_or_has_changed_is_read_and_what_is_gone_is_forgotten(runs: Path) -> None:
    with Catalogue(runs) as catalogue:
        assert catalogue.refresh() == 3
        assert catalogue.refresh() == 0
        (runs / "day-0.mcap").unlink()
        shutil.move(runs / "day-1.mcap", runs / "renamed.mcap")
        os.utime(runs / "day-2.mcap", ns=(1, 1))
        assert catalogue.refresh() == 2
        assert [entry.name for entry in catalogue.runs()] == ["day-2", "renamed"]


def test_tags_survive_a_rebuild_and_are_seen_without_reading_the_recording_again(runs: Path) -> None:
    with Catalogue(runs) as catalogue:
        catalogue.refresh()
        remark(runs / "day-0.mcap", NOW, tags=["good"], note="kept")
        assert catalogue.refresh() == 0
        assert catalogue.runs(RunFilter(tags=("good",)))[0].note == "kept"
        assert catalogue.rebuild() == 3
        assert catalogue.runs(RunFilter(tags=("good",)))[0].note == "kept"


DAMAGES = {
    "noise": lambda path: path.write_bytes(b"this is no database at all" * 100),
    "half of it": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "zeros in the middle": lambda path: path.write_bytes(path.read_bytes()[:4096] + bytes(8192) + path.read_bytes()[12288:]),
    "another version": lambda path: altered(path, "PRAGMA user_version = 99"),
    "another database": lambda path: (path.unlink(), altered(path, "CREATE TABLE runs (x)")),
    "a table is gone": lambda path: altered(path, "DROP TABLE moduli"),
}


def altered(path: Path, statement: str) -> None:
    connection = sqlite3.connect(path)
    connection.execute(statement)
    connection.commit()
    connection.close()


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_catalogue_is_made_anew_with_one_sentence(runs: Path, damage: str) -> None:
    remark(runs / "day-0.mcap", NOW, tags=["good"])
    listed(runs)
    DAMAGES[damage](runs / FILE)
    with Catalogue(runs) as catalogue:
        catalogue.refresh()
        entries = catalogue.runs()
        assert [entry.name for entry in entries] == ["day-2", "day-1", "day-0"]
        assert entries[-1].tags == ("good",)
        (sentence,) = catalogue.notes
        assert "was damaged or of another version; it was made anew from 3 recordings" in sentence
    with Catalogue(runs) as catalogue:
        assert catalogue.refresh() == 0
        assert not catalogue.notes


def test_a_damage_that_only_a_question_meets_is_mended_too(runs: Path) -> None:
    listed(runs)
    DAMAGES["a table is gone"](runs / FILE)
    with Catalogue(runs) as catalogue:
        assert len(catalogue.runs()) == 3
        assert len(catalogue.notes) == 1


def test_a_recording_that_cannot_be_read_is_listed_with_the_reason(runs: Path) -> None:
    content = (runs / "day-0.mcap").read_bytes()
    (runs / "day-0.mcap").write_bytes(content[: len(content) // 2])
    (runs / "day-1.mcap").write_bytes(b"")
    entries = {entry.name: entry for entry in listed(runs)}
    assert [entries[name].verdict for name in ("day-0", "day-1", "day-2")] == ["unreadable", "unreadable", "stopped"]
    assert "truncated or corrupt" in entries["day-0"].reason
    assert entries["day-0"].duration_s is None


def test_hostile_names_and_remarks_are_data(runs: Path) -> None:
    hostile = "<script>alert(1)</script>'; DROP TABLE runs; --\x1b[31m"
    (runs / "day-0.mcap").rename(runs / os.fsdecode(b"\xff\xfe" + hostile.replace("/", "").encode() + b".mcap"))
    (runs / "day-1.remarks.json").write_text(json.dumps({"tags": ["x y', 'z"], "notes": [{"date": NOW, "text": hostile}]}))
    entries = listed(runs)
    assert len(entries) == 3
    assert any(entry.name.startswith("\udcff\udcfe<script>") for entry in entries)
    assert names(runs, text="drop table") == [entry.name for entry in entries if entry.name != "day-2"]


def test_damaged_remarks_and_diagnoses_are_a_note_of_their_run(runs: Path) -> None:
    (runs / "day-0.remarks.json").write_text("[")
    (runs / "day-1.diagnosis.json").write_text('{"effects": [{"id": 5}]}')
    entries = {entry.name: entry for entry in listed(runs)}
    assert "day-0.remarks.json, line 1: this is not JSON" in entries["day-0"].note
    assert "day-1.diagnosis.json is no diagnosis" in entries["day-1"].note
    assert entries["day-2"].note == ""


def test_named_effects_of_diagnoses_beside_a_recording_are_points_in_time(runs: Path) -> None:
    for day, force_N in ((1, 0.2), (0, 0.1)):
        effect = {"id": "cable.friction", "probability": 0.9, "parameters": {"force_N": {"value": force_N, "ci95": [0.0, 0.3]}}}
        (runs / f"day-{day}.A.diagnosis.json").write_text(json.dumps({"effects": [effect]}))
    with Catalogue(runs) as catalogue:
        catalogue.refresh()
        assert [(point.run, point.site, point.value) for point in catalogue.effects("A")] == [("day-0", "A", 0.1), ("day-1", "A", 0.2)]
        assert catalogue.effects("B") == []
        (runs / "day-1.A.diagnosis.json").unlink()
        catalogue.refresh()
        assert [point.run for point in catalogue.effects()] == ["day-0"]


def test_a_folder_that_may_not_be_written_is_listed_all_the_same(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    listed(runs)
    shutil.copy(runs / "day-0.mcap", runs / "new.mcap")
    connect = module._connect
    monkeypatch.setattr(module, "_connect", lambda path, mode="ro": connect(path, "ro"))
    with Catalogue(runs) as catalogue:
        assert catalogue.refresh() == 1
        assert len(catalogue.runs()) == 4
        (sentence,) = catalogue.notes
        assert "cannot be written" in sentence
    monkeypatch.undo()
    with Catalogue(runs) as catalogue:
        assert catalogue.refresh() == 1


def test_a_damaged_catalogue_that_may_not_be_replaced_is_made_anew_in_memory(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    listed(runs)
    (runs / FILE).write_bytes(b"no database" * 1000)

    def refused(self: Path, missing_ok: bool = False) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "unlink", refused)
    with Catalogue(runs) as catalogue:
        assert len(catalogue.runs()) == 3
        assert len(catalogue.notes) == 1
    assert (runs / FILE).read_bytes() == b"no database" * 1000


def test_a_full_disk_is_a_sentence_and_the_answer_is_right(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    listed(runs)
    connect = module._connect

    def full(path: Path, mode: str = "rwc") -> sqlite3.Connection:
        connection = connect(path, mode)
        pages = connection.execute("PRAGMA page_count").fetchone()[0]
        connection.execute(f"PRAGMA max_page_count = {pages}")
        return connection

    monkeypatch.setattr(module, "_connect", full)
    for number in range(12):
        (runs / f"{'n' * 200}{number}.mcap").write_bytes(b"")
    with Catalogue(runs) as catalogue:
        catalogue.refresh()
        assert len(catalogue.runs()) == 15
        (sentence,) = catalogue.notes
        assert "full" in sentence


def test_a_folder_that_is_none_is_refused(tmp_path: Path) -> None:
    for name in ("absent", "x" * 5000):
        with pytest.raises(BadInput, match="is no folder"), Catalogue(tmp_path / name) as catalogue:
            catalogue.refresh()


def test_readers_and_writers_at_the_same_time_all_get_their_answer(runs: Path) -> None:
    """Processes that refresh, threads that list, and recordings that come: as when a run ends while somebody looks."""
    code = (
        "import sys\nfrom pathlib import Path\nfrom palpd.history.catalogue import Catalogue\n"
        "for _ in range(15):\n    with Catalogue(Path(sys.argv[1])) as c:\n        c.refresh()\n"
        "        assert len(c.runs()) >= 3 and not c.notes, c.notes\n"
    )
    listed(runs)
    processes = [subprocess.Popen([sys.executable, "-c", code, str(runs)], stderr=subprocess.PIPE) for _ in range(2)]
    counts: list[int] = []
    readers = [threading.Thread(target=lambda: counts.extend(len(listed(runs)) for _ in range(15))) for _ in range(2)]
    for reader in readers:
        reader.start()
    for number in range(5):
        shutil.copy(runs / "day-0.mcap", runs / "coming.part")
        (runs / "coming.part").rename(runs / f"new-{number}.mcap")
    for reader in readers:
        reader.join()
    errors = [process.communicate()[1] for process in processes]
    assert [process.returncode for process in processes] == [0, 0], errors
    assert len(counts) == 30
    assert min(counts) >= 3
    assert len(listed(runs)) == 8


def test_a_catalogue_that_stays_busy_is_refused_in_a_sentence(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    listed(runs)
    monkeypatch.setattr(module, "BUSY_S", 0.05)
    other = sqlite3.connect(runs / FILE, isolation_level=None)
    other.execute("BEGIN EXCLUSIVE")
    with pytest.raises(Refused, match="busy"), Catalogue(runs) as catalogue:
        catalogue.runs()
    other.execute("ROLLBACK")
    other.close()
