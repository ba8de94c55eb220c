"""What comes in from files is checked, and what goes out appears whole or not at all."""

import contextlib
import errno
import json
import os
import resource
import stat
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import pytest

from palpd.documents import parse_json, parse_yaml, read_json, read_yaml  # fmt: skip
from palpd.errors import BadInput, ConfigError, RecordingError
from palpd.files import MOST_YAML_BYTES, check_folder, check_writable, opened_text, read_text, write_json, write_text, writing, writing_text

MOTION = "t_s,z_cmd_m\n0,1\n"
"""A table that palpd knows as its own."""
READERS: list[Callable[[Path], Any]] = [read_text, read_yaml, read_json, lambda path: opened_text(path).__enter__()]


def written(folder: Path, text: str) -> Path:
    path = folder / "some.yaml"
    path.write_text(text, encoding="utf-8")
    return path


# --- reading ------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("read", READERS)
@pytest.mark.parametrize(
    ("make", "words"),
    [
        (os.mkfifo, "is a pipe, expected a regular file"),
        (os.mkdir, "is a folder, expected a regular file"),
        (lambda path: path.symlink_to("/dev/zero"), "is a device, expected a regular file"),
        (lambda path: None, "cannot be read"),
    ],
)
def test_only_a_regular_file_is_read(tmp_path: Path, read: Callable[[Path], Any], make: Callable[[Path], None], words: str) -> None:
    path = tmp_path / "input"
    make(path)
    with pytest.raises(BadInput, match=words):
        read(path)


@pytest.mark.parametrize("read", [read_yaml, read_json])
def test_a_file_that_is_too_large_is_refused_before_it_is_read(tmp_path: Path, read: Callable[[Path], Any]) -> None:
    path = tmp_path / "large"
    with path.open("wb") as file:
        file.truncate(10**9)
    with pytest.raises(BadInput, match=r"has 1000000000 bytes, expected at most"):
        read(path)


@pytest.mark.parametrize(
    ("head", "what", "advice"),
    [
        (b"PK\x03\x04", "a zip archive", "give the text file that belongs in its place"),
        (b"\xff\xfe", "text in UTF-16", "save it as UTF-8"),
    ],
)
def test_only_a_text_is_to_be_saved_as_utf_8(tmp_path: Path, head: bytes, what: str, advice: str) -> None:
    path = tmp_path / "plan.yaml"
    path.write_bytes(head + b"\x00\xff\xfe")
    with pytest.raises(BadInput) as refused:
        read_text(path)
    assert str(refused.value) == f"{path} is {what}, expected text in UTF-8; {advice}"


def test_what_is_not_utf_8_is_refused_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "some.yaml"
    path.write_bytes(b"a: 1\nb: \xff\n")
    with pytest.raises(ConfigError, match="line 2: a byte is not UTF-8"):
        read_yaml(path)
    with pytest.raises(RecordingError, match="byte 8: a byte is not UTF-8"), opened_text(path, error=RecordingError) as file:
        file.read()


def test_a_byte_order_mark_is_no_part_of_the_text(tmp_path: Path) -> None:
    path = tmp_path / "some.yaml"
    path.write_bytes(b"\xef\xbb\xbfa: 1\n")
    assert read_yaml(path).content == {"a": 1}


def test_a_key_that_stands_twice_in_a_yaml_block_is_refused_with_both_lines(tmp_path: Path) -> None:
    path = written(tmp_path, "safety:\n  contact_limit_N: 5\n  lateral_limit_N: 8\n  contact_limit_N: 100\n")
    with pytest.raises(ConfigError, match=r"some\.yaml, line 4: the key 'contact_limit_N' stands here and in line 2, expected once"):
        read_yaml(path)


def test_a_block_that_stands_twice_in_a_yaml_file_is_refused_with_both_lines(tmp_path: Path) -> None:
    path = written(tmp_path, "safety: {contact_limit_N: 5}\nrobot: {}\nsafety: {}\n")
    with pytest.raises(ConfigError, match="line 3: the key 'safety' stands here and in line 1"):
        read_yaml(path)


def test_the_same_key_in_two_blocks_is_no_duplicate() -> None:
    assert parse_yaml("a: {x: 1}\nb: {x: 2}\nc: [{x: 3}, {x: 4}]", "it").content == {
        "a": {"x": 1},
        "b": {"x": 2},
        "c": [{"x": 3}, {"x": 4}],
    }


def test_a_key_that_stands_twice_in_a_json_object_is_refused() -> None:
    with pytest.raises(BadInput, match="card: the key 'bias_N' stands twice in one object"):
        parse_json('{"a": {"bias_N": 0.1, "bias_N": 100.0}}', "card")
    assert parse_json('{"a": {"x": 1}, "b": {"x": 2}}', "card") == {"a": {"x": 1}, "b": {"x": 2}}


@pytest.mark.parametrize("levels", [33, 1000, 100_000])
@pytest.mark.parametrize("parse", [parse_yaml, parse_json])
def test_deep_nesting_is_refused(parse: Callable[[str, str], Any], levels: int) -> None:
    with pytest.raises(BadInput, match="nested deeper than 32 levels"):
        parse("[" * levels + "]" * levels, "it")


@pytest.mark.parametrize("parse", [parse_yaml, parse_json])
def test_nesting_as_deep_as_allowed_is_read(parse: Callable[[str, str], Any]) -> None:
    assert parse("[" * 30 + "]" * 30, "it")


@pytest.mark.parametrize("parse", [parse_yaml, parse_json])
def test_a_number_of_5000_digits_is_refused_in_a_sentence(parse: Callable[[str, str], Any]) -> None:
    with pytest.raises(BadInput, match="a whole number has 5000 digits, expected at most 40"):
        parse('{"repeats": ' + "9" * 5000 + "}", "it")


@pytest.mark.parametrize("text", ['{"a": ["\\u0000"]}', '{"a": "b\\ud800"}', '{"\\udfff": 1}'])
@pytest.mark.parametrize("parse", [parse_yaml, parse_json])
def test_letters_that_no_file_name_can_hold_are_refused(parse: Callable[[str, str], Any], text: str) -> None:
    with pytest.raises(BadInput, match="which no file name can hold"):
        parse(text, "it")


def test_letters_that_are_written_as_numbers_are_read() -> None:
    assert parse_json('{"a": "\\ud83d\\ude00 \\\\u0000"}', "it") == {"a": "😀 \\u0000"}


def test_aliases_that_stand_for_millions_of_values_are_refused() -> None:
    text = "a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n"
    text += "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]\n" for n in range(1, 9))
    with pytest.raises(ConfigError, match="line 6: the aliases stand for more than 200000 values"):
        parse_yaml(text, "it")
    with pytest.raises(ConfigError, match="an alias stands inside what it names"):
        parse_yaml("a: &a [*a]", "it")
    assert parse_yaml("a: &a {x: 1}\nb: *a\nc: {<<: *a, y: 2}", "it").content["c"] == {"x": 1, "y": 2}


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1", 1), ("-3", -3), ("012", 12), ("1e-3", 1e-3), ("72e3", 72e3), (".5", 0.5), ("2.", 2.0), ("1.5e+2", 150.0),
        ("1:30", "1:30"), ("0x1F", "0x1F"), ("1_000", "1_000"), ("yes", True), ("null", None), ("ur5", "ur5"),
    ],
)  # fmt: skip
def test_numbers_in_yaml_are_decimal_only(text: str, value: object) -> None:
    content = parse_yaml(f"x: {text}", "it").content
    assert content == {"x": value}
    assert type(content["x"]) is type(value)


@pytest.mark.parametrize(
    "text", ["a: [", "a: b: c", "\x00", "a: 1\n--- \nb: 2", "? [1, 2]\n: 3", "!!python/name:os.system x", "x: 2024-99-99", "*a"]
)
def test_what_is_not_one_plain_yaml_document_is_refused_in_one_sentence(text: str) -> None:
    with pytest.raises(ConfigError) as refused:
        parse_yaml(text, "it.yaml")
    assert str(refused.value).startswith("it.yaml")
    assert "\n" not in str(refused.value)


def test_what_is_not_json_is_refused_with_its_line() -> None:
    with pytest.raises(BadInput, match=r"it, line 2: this is not JSON"):
        parse_json('{"a": 1,\n b: 2}', "it")


def test_a_document_knows_the_line_of_every_key() -> None:
    document = parse_yaml("a: 1\nsites:\n- name: A\n- name: B\n  x_m: 2\n", "plan.yaml")
    assert document.place(("sites", 1, "x_m")) == "plan.yaml, line 5"
    assert document.place(("sites", 1, "absent")) == "plan.yaml, line 4"
    assert document.place(("absent",)) == "plan.yaml"


def test_yaml_of_the_largest_size_is_parsed_within_the_patience_of_a_test() -> None:
    line = "- {name: A, x_m: 0.001}\n"
    assert len(parse_yaml(line * (MOST_YAML_BYTES // 4 // len(line)), "it").content) > 2000


# --- writing ------------------------------------------------------------------------------------------------------------------


def test_a_place_that_cannot_be_written_is_refused_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("kept")
    for path, words in (
        (tmp_path / "missing" / "out.json", "is no folder"),
        (tmp_path, "is a folder"),
        (tmp_path / "file" / "out.json", "is no folder"),
        (tmp_path / ("x" * 300), "cannot be written"),
        (Path("/proc/out.json"), "cannot be written"),
    ):
        with pytest.raises(BadInput, match=words):
            check_writable(None, path)
    assert sorted(each.name for each in tmp_path.iterdir()) == ["file"]


def test_a_read_only_place_is_refused_before_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: Path, mode: str = "r", *arguments: Any, **options: Any) -> IO[Any]:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(Path, "open", refuse)  # root may write anywhere, so the system's answer is put in its mouth
    with pytest.raises(BadInput, match=r"cannot be written \(Read-only file system\)"):
        check_writable(tmp_path / "out.json")


def test_trying_a_place_leaves_no_trace_and_keeps_what_stands_there(tmp_path: Path) -> None:
    write_json(tmp_path / "old.json", {})
    before = (tmp_path / "old.json").read_bytes()
    check_writable(tmp_path / "new.json", tmp_path / "old.json", None)
    assert [(each.name, each.read_bytes()) for each in tmp_path.iterdir()] == [("old.json", before)]


def test_a_file_that_may_not_be_replaced_is_refused_before_the_work(tmp_path: Path) -> None:
    path = tmp_path / "old.csv"
    path.write_text("old")
    with pytest.raises(BadInput, match="exists and is not overwritten"):
        check_writable(path)
    with pytest.raises(BadInput, match="exists and is not overwritten"):
        write_text(path, "new")
    assert path.read_text() == "old"


def test_a_folder_to_be_made_is_tried_at_the_nearest_one_that_exists(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    check_folder(tmp_path / "a" / "b" / "c", tmp_path, None)
    assert sorted(each.name for each in tmp_path.iterdir()) == ["file"]
    with pytest.raises(BadInput):
        check_folder(tmp_path / "file" / "a")


def test_a_file_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "out.csv"
    path.write_text(MOTION)
    with contextlib.suppress(ZeroDivisionError), writing_text(path) as file:
        file.write("half" * 100_000)
        assert path.read_text() == MOTION
        raise ZeroDivisionError
    assert [(each.name, each.read_text()) for each in tmp_path.iterdir()] == [("out.csv", MOTION)]


def test_a_full_disk_is_a_sentence_and_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    path = tmp_path / "out.json"
    write_json(path, {"old": 1})
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(BadInput, match=r"out\.json cannot be written \(No space left on device\)"):
        write_json(path, {"new": 2})
    assert json.loads(path.read_text())["old"] == 1
    assert len(list(tmp_path.iterdir())) == 1


def test_what_is_written_reads_back_equal(tmp_path: Path) -> None:
    path = tmp_path / "out.json"
    write_json(path, {"µ": [1, 2.5, None], "path": Path("/a"), "lone surrogate": "\udcff"})
    assert read_json(path)["µ"] == [1, 2.5, None]
    assert read_json(path)["path"] == "/a"
    write_json(None, {})


def test_permissions_are_those_of_the_file_before_or_of_any_new_file(tmp_path: Path) -> None:
    old, new, plain = tmp_path / "old", tmp_path / "new", tmp_path / "plain"
    old.write_text("")
    old.chmod(0o640)
    plain.write_text("")
    write_text(old, "x")
    write_text(new, "x")
    assert stat.S_IMODE(old.stat().st_mode) == 0o640
    assert new.stat().st_mode == plain.stat().st_mode


def test_a_link_stays_a_link_and_a_device_stays_a_device(tmp_path: Path) -> None:
    target, link = tmp_path / "target", tmp_path / "link"
    target.write_text(MOTION)
    link.symlink_to(target)
    write_text(link, MOTION + MOTION[-4:])
    assert link.is_symlink()
    assert target.read_text() == MOTION + MOTION[-4:]
    with writing(Path("/dev/null")) as stream:
        stream.write(b"gone")
    check_writable(Path("/dev/null"))
    assert stat.S_ISCHR(Path("/dev/null").stat().st_mode)


def test_a_place_on_a_full_disk_is_refused_before_the_work(tmp_path: Path) -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, limits[1]))
    try:
        for check in (check_writable, check_folder):
            with pytest.raises(BadInput, match="cannot be written"):
                check(tmp_path / "out.json")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not list(tmp_path.iterdir())


def test_a_link_to_itself_is_not_written_to(tmp_path: Path) -> None:
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(BadInput, match="leads back to itself"):
        write_text(tmp_path / "loop", "some")
    assert (tmp_path / "loop").is_symlink()
