"""One flipped bit anywhere in a recording: all ticks of undamaged chunks come back, nothing comes back altered, and losses are named."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpd.errors import RecordingError
from palpd.recording import recovery
from palpd.recording.header import RecordingFooter, RecordingHeader
from palpd.recording.mcap_file import HEADER_LOST
from palpd.recording.reader import Recording, Rows, same_rows
from palpd.recording.recovery import Recovered, recover
from tests.recording.test_recording import FOOTER, HEADER, chunks_of, palpation, write
from tests.test_file_versions import RECORDING

BATCH = 2
MODEL = b"\x08onnx"
END_OF_DATA = b"\x0f\x04" + bytes(7)


class Restored:
    """Stands for the writer: keeps what `recover` restores."""

    last: "Restored"

    def __init__(self, path: Path, header: RecordingHeader, model_bytes: bytes | None, part: Path) -> None:
        self.path, self.header, self.model_bytes, self.rows = path, header, model_bytes, list[Rows]()
        self.footer: RecordingFooter = {}
        Restored.last = self

    def write(self, rows: Rows) -> None:
        self.rows.append(rows)

    def flush(self) -> None:
        pass

    def abandon(self) -> None:
        pass

    def close(self, footer: RecordingFooter) -> Path:
        self.footer = footer
        return self.path


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """A recording of three chunks with two ticks each, and of some kB."""
    rows = palpation(3 * BATCH)
    rows["frames"] = 1
    return write(tmp_path / "small.mcap", rows, MODEL, batch=BATCH)


def flipped(whole: bytes, bits: range) -> Iterator[tuple[int, bytes]]:
    """The file with each of these bits flipped, and the byte in which it is."""
    for bit in bits:
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << bit % 8
        yield bit // 8, bytes(damaged)


def assert_named_and_unaltered(recovered: Recovered, back: Any, rows: Rows, position: int, chunks: list[tuple[int, int]]) -> None:
    """Assert that no more is lost than the damaged record, that the rest is as it was, and that a loss is named."""
    hit = [number for number, (begin, end) in enumerate(chunks) if begin <= position < end]
    kept = np.concatenate(back.rows)
    lost = sorted(set(rows["index"].tolist()) - set(kept["index"].tolist()))
    assert lost in ([], [BATCH * k + i for k in hit for i in range(BATCH)]), position
    assert same_rows(kept, rows[np.isin(rows["index"], kept["index"])]).all(), position
    assert back.header == HEADER | {"format_version": back.header["format_version"]}, position
    assert back.model_bytes == MODEL or (back.model_bytes is None and recovered.torn), position
    footer = {name: value for name, value in back.footer.items() if name != "damaged_ticks"}
    assert footer == FOOTER or (footer["verdict"] == "unfinished" and recovered.torn), position
    assert not lost or recovered.torn, position
    assert sum(gap.ticks for gap in recovered.lost) == (len(lost) if hit != [len(chunks) - 1] else 0), position


@pytest.mark.parametrize("first", range(4))
def test_every_flipped_bit_of_the_data_loses_at_most_its_own_record(first: int, small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows, chunks, whole = Recording.load(small).rows, chunks_of(small)[-3:], small.read_bytes()
    monkeypatch.setattr(recovery, "RecordingWriter", Restored)
    part = small.with_suffix(".part")
    for position, damaged in flipped(whole, range(first, 8 * whole.index(END_OF_DATA) + 8 * 13, 4)):
        part.write_bytes(damaged)
        assert_named_and_unaltered(recover(part), Restored.last, rows, position, chunks)


def test_what_is_restored_of_any_part_of_a_file_is_a_recording_that_loads(small: Path) -> None:
    original, chunks, whole = Recording.load(small), chunks_of(small)[-3:], small.read_bytes()
    small.unlink()
    part = small.with_suffix(".part")
    for position, damaged in flipped(whole, range(3, 8 * len(whole), 451)):
        part.write_bytes(damaged)
        recovered = recover(part)
        back = Recording.load(recovered.path)
        recovered.path.unlink()
        restored = Restored(part, back.header, back.model_bytes, part)
        restored.rows, restored.footer = [back.rows], back.footer
        assert_named_and_unaltered(recovered, restored, original.rows, position, chunks)


def test_a_flipped_bit_is_refused_by_whoever_loads_the_file(small: Path) -> None:
    whole = small.read_bytes()
    for _, damaged in flipped(whole[: whole.index(END_OF_DATA)], range(0, 8 * whole.index(END_OF_DATA), 97)):
        small.write_bytes(damaged + whole[len(damaged) :])
        with pytest.raises(RecordingError):
            Recording.load(small)


def test_without_any_header_the_ticks_come_back_and_what_needs_the_header_is_refused(tmp_path: Path) -> None:
    """Recordings from before have one header without a checksum."""
    original, part = Recording.load(RECORDING), tmp_path / "old.part"
    part.write_bytes(RECORDING.read_bytes().replace(b'{"', b"{'", 1))
    recovered = recover(part)
    back = Recording.load(recovered.path)
    assert same_rows(back.rows, original.rows).all()
    assert HEADER_LOST in recovered.sentence
    assert HEADER_LOST in back.footer["reason"]
    assert back.header["epoch_offset_s"] == pytest.approx(original.header["epoch_offset_s"], abs=1e-5)
    with pytest.raises(RecordingError, match="does not say its config"):
        back.header["config"]


def test_zeros_up_to_the_first_tick_lose_no_tick(small: Path) -> None:
    rows, whole, (first, _) = Recording.load(small).rows, bytearray(small.read_bytes()), chunks_of(small)[-3]
    small.unlink()
    whole[:first] = bytes(first)
    small.with_suffix(".part").write_bytes(whole)
    back = Recording.load(recover(small.with_suffix(".part")).path)
    assert same_rows(back.rows, rows).all()
    assert back.header["plan"] == HEADER["plan"]
