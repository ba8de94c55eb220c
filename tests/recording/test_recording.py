"""Recordings: written, read back, cut off, damaged, restored, and lived through again."""

import csv
import errno
import fcntl
import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from multiprocessing import Pipe
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.highlevel import AnyReader

from palpd.errors import BadInput, RecordingError
from palpd.recording import cdr
from palpd.recording.mcap_file import RecordingWriter, part_of
from palpd.recording.reader import RecordedRobot, RecordedSensor, Recording, Rows, export, same_rows, samples_of, widened
from palpd.recording.recorder import Recorder, record
from palpd.recording.recovery import recover
from palpd.recording.ring import RecorderState, Ring
from palpd.recording.samples import COLUMNS, read_csv
from palpd.tick import MAX_FRAMES, ROW, Phase

HEADER = {"format_version": 1, "epoch_offset_s": 1.7e9, "sites": [{"name": "A"}, {"name": "B"}], "plan": {"depths_m": [0.004]}}
FOOTER = {"verdict": "done", "reason": ""}


def random_rows(seed: int, counts: list[int]) -> Rows:
    """Rows of random bits: NaNs with payloads, infinities, nonsense in the slots that are not filled."""
    rows = np.frombuffer(np.random.default_rng(seed).bytes(ROW.itemsize * len(counts)), ROW).copy()
    rows["frames"] = counts
    return rows


def palpation(n: int = 250, start_s: float = 100.0) -> Rows:
    """Two sites pressed at 125 Hz with eight frames a tick, on clocks that do not coincide."""
    rows = np.zeros(n, ROW)
    rows["index"] = np.arange(n)
    rows["planned_s"] = start_s + np.arange(n) / 125
    rows["now_s"] = rows["planned_s"] + 5e-5
    rows["robot_t_s"] = rows["now_s"] - 0.0013
    rows["connected"], rows["robot_mode"], rows["safety_mode"], rows["runtime_state"] = 1, 7, 1, 2
    rows["tcp_pose"] = [0.3, -0.2, 0.05, np.pi, 0.0, 0.0]
    rows["tcp_pose"][:, 2] -= 0.01 * (rows["robot_t_s"] - start_s)
    rows["target_pose"] = rows["tcp_pose"]
    rows["target_pose"][:, 2] -= 0.0005
    rows["tcp_speed"][:, 2] = -0.01
    rows["frames"] = 8
    rows["frame_t_s"][:, :8] = rows["now_s"][:, None] - 0.0095 + np.arange(8) / 1000
    rows["counter"][:, :8] = np.arange(8 * n).reshape(n, 8)
    rows["wrench"][:, :8] = rows["frame_t_s"][:, :8, None] * [1, 2, -3, 4, 5, 6]
    rows["tared"][:, :8] = rows["frame_t_s"][:, :8, None] * [1, 2, 3, 4, 5, 6]
    rows["inertial_N"][:, :8] = 0.25
    rows["site"] = np.arange(n) // (n // 2)
    return rows


def write(path: Path, rows: Rows, model_bytes: bytes | None = None, batch: int = 20) -> Path:
    writer = RecordingWriter(path, HEADER, model_bytes)
    for start in range(0, len(rows), batch):
        writer.write(rows[start : start + batch])
        writer.flush()
    return writer.close(FOOTER)


@pytest.fixture
def ring() -> Iterator[Ring]:
    with closing(Ring.create(rate_Hz=125)) as ring:
        yield ring


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32), counts=st.lists(st.integers(0, MAX_FRAMES), min_size=1, max_size=12), batch=st.integers(1, 5))
def test_any_row_comes_back_bit_for_bit(tmp_path: Path, seed: int, counts: list[int], batch: int) -> None:
    rows = random_rows(seed, counts)
    path = write(tmp_path / "run.mcap", rows, batch=batch)
    back = Recording.load(path).rows
    path.unlink()
    assert len(back) == len(rows)
    assert same_rows(back, rows).all()
    assert same_rows(rows, widened(back)).all()
    assert widened(back).dtype == ROW


def test_a_single_changed_bit_in_a_filled_field_is_a_difference() -> None:
    rows = random_rows(3, [2, 0])
    assert same_rows(rows, rows).all()
    for name in ROW.names or ():
        other = rows.copy()
        bits = other[name].reshape(2, -1).view(f"u{ROW[name].base.itemsize}")
        bits[0, 0] ^= 1
        assert same_rows(rows, other).tolist() == [False, True], name
    other = rows.copy()
    other["tared"][0, 2:], other["tared"][1] = 0, 0
    assert same_rows(rows, other).all()


def test_header_footer_and_model_come_back(tmp_path: Path) -> None:
    recording = Recording.load(write(tmp_path / "run.mcap", palpation(20), b"\x08onnx"))
    assert recording.header == HEADER
    assert recording.footer == FOOTER
    assert recording.model_bytes == b"\x08onnx"


def test_rosbags_reads_every_topic_with_the_embedded_schemas(tmp_path: Path) -> None:
    rows = palpation(50)
    rows["frames"][7] = 0
    path = write(tmp_path / "run.mcap", rows)
    seen: dict[str, list[Any]] = {}
    with AnyReader([path]) as bag:
        for connection, time_ns, data in bag.messages():
            seen.setdefault(connection.topic, []).append((time_ns, bag.deserialize(data, connection.msgtype)))
    assert {topic: len(messages) for topic, messages in seen.items()} == {
        "/tcp_pose": 50,
        "/tcp_twist": 50,
        "/target_pose": 50,
        "/wrench_raw": 392,
        "/wrench": 392,
        "/tick": 50,
    }
    time_ns, tick = seen["/tick"][9]
    row = rows[9]
    assert time_ns == tick.header.stamp.sec * 10**9 + tick.header.stamp.nanosec == 1_700_000_000 * 10**9 + round(row["now_s"] * 1e9)
    for name in ROW.names or ():
        sent = row[name][:8] if name in cdr.PER_FRAME else row[name]
        assert np.asarray(getattr(tick, name.lower()), ROW[name].base).tobytes() == sent.tobytes(), name
    assert tick.PHASE_PRESS == 4
    assert len(seen["/tick"][7][1].frame_t_s) == 0
    pose = seen["/tcp_pose"][9][1]
    assert pose.header.frame_id == "base"
    assert [pose.pose.position.x, pose.pose.position.y, pose.pose.position.z] == row["tcp_pose"][:3].tolist()
    turned = [pose.pose.orientation.x, pose.pose.orientation.y, pose.pose.orientation.z, pose.pose.orientation.w]
    assert turned == pytest.approx([1, 0, 0, 0], abs=1e-9)
    assert seen["/target_pose"][9][1].pose.position.z == row["target_pose"][2]
    assert seen["/tcp_twist"][9][1].twist.linear.z == -0.01
    _, raw = seen["/wrench_raw"][0]
    assert raw.header.frame_id == "sensor"
    assert [raw.wrench.force.z, raw.wrench.torque.z] == rows["wrench"][0, 0, [2, 5]].tolist()
    _, contact = seen["/wrench"][0]
    assert contact.header.frame_id == "base"
    assert contact.wrench.force.z == rows["tared"][0, 0, 2] - 0.25
    assert contact.wrench.force.x == rows["tared"][0, 0, 0]


def test_the_mcap_reader_finds_everything_through_the_index(tmp_path: Path) -> None:
    path = write(tmp_path / "run.mcap", palpation(50), b"model")
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        assert sum(1 for _ in reader.iter_messages(topics="/wrench")) == 400
        times_ns = [message.log_time for _, _, message in reader.iter_messages()]
        assert times_ns == sorted(times_ns)
        assert [attachment.data for attachment in reader.iter_attachments()] == [b"model"]
        assert [metadata.name for metadata in reader.iter_metadata()] == ["palpd.header", "palpd.footer"]


def test_quaternions_are_those_of_the_rotation_vectors() -> None:
    vectors_rad = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, np.pi / 2], [1e-9, 0.0, 0.0]])
    half = np.sqrt(0.5)
    assert cdr.quaternion(vectors_rad) == pytest.approx(np.array([[0, 0, 0, 1], [0, 0, half, half], [5e-10, 0, 0, 1]]), abs=2e-10)


def test_of_a_fast_robot_the_standard_topics_show_about_125_states_a_second(tmp_path: Path) -> None:
    rows = palpation(100)
    rows["now_s"] = 100 + np.arange(100) / 500
    rows["robot_t_s"] = rows["now_s"] - 0.001
    path = write(tmp_path / "run.mcap", rows)
    with AnyReader([path]) as bag:
        counts = {connection.topic: connection.msgcount for connection in bag.connections}
    assert counts["/tcp_pose"] == 25
    assert counts["/tick"] == 100


def test_a_robot_that_never_answered_does_not_move_the_recording_to_the_year_1970(tmp_path: Path) -> None:
    rows = palpation(10)
    rows["robot_t_s"][:5], rows["robot_t_s"][5:] = 0.0, np.nan
    with AnyReader([write(tmp_path / "run.mcap", rows)]) as bag:
        assert bag.start_time > 1.7e18


def test_an_existing_recording_is_never_overwritten(tmp_path: Path) -> None:
    path = write(tmp_path / "run.mcap", palpation(4))
    before = path.read_bytes()
    with pytest.raises(RecordingError, match="not overwritten"):
        RecordingWriter(path, HEADER)
    writer = RecordingWriter(tmp_path / "other.mcap", HEADER)
    writer.write(palpation(4))
    with pytest.raises(RecordingError, match=r"other\.part exists"):
        RecordingWriter(tmp_path / "other.mcap", HEADER)
    (tmp_path / "other.mcap").write_bytes(b"came in between")
    with pytest.raises(RecordingError, match="holds the whole recording"):
        writer.close(FOOTER)
    writer.abandon()
    assert (tmp_path / "other.mcap").read_bytes() == b"came in between"
    assert path.read_bytes() == before


def test_a_recorder_whose_supervisor_waits_no_longer_ends_without_a_traceback(tmp_path: Path, ring: Ring) -> None:
    ours, recorders = Pipe()
    ours.send((tmp_path / "a.mcap", HEADER, None, None, ring.published))
    ours.close()
    with recorders:
        record(ring, recorders)
    assert ring.recorder_state == RecorderState.ABSENT


def test_a_folder_that_is_not_there_is_refused_with_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="No such file or directory"):
        RecordingWriter(tmp_path / "nowhere" / "run.mcap", HEADER)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [(b"", "not an MCAP file"), (b"t_s,z_m,fz_N\n0,0,0\n", "not an MCAP file"), (b"\x89MCAP0\r\n", "truncated or corrupt")],
)
def test_a_file_of_another_kind_is_refused_with_a_sentence(tmp_path: Path, content: bytes, sentence: str) -> None:
    path = tmp_path / "foreign.mcap"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=sentence):
        Recording.load(path)


def test_an_mcap_file_of_somebody_else_is_refused_with_a_sentence(tmp_path: Path) -> None:
    path = tmp_path / "foreign.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        channel = writer.register_channel("/tick", "cdr", writer.register_schema("std_msgs/msg/Empty", "ros2msg", b""))
        writer.add_message(channel, 0, b"\0\1\0\0", 0)
        writer.finish()
    with pytest.raises(RecordingError, match="no recording of palpd"):
        Recording.load(path)
    with pytest.raises(RecordingError, match="no recording of palpd"):
        recover(path.rename(tmp_path / "foreign.part"))


def test_a_recording_whose_ticks_have_other_fields_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "run.mcap", palpation(4))
    monkeypatch.setattr(cdr, "TICK", cdr.TICK.replace("float64 depth_m", "float32 depth_mm"))
    with pytest.raises(RecordingError, match="other fields"):
        Recording.load(path)


def test_a_recording_of_before_a_new_phase_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "run.mcap", palpation(4))
    monkeypatch.setattr(cdr, "TICK", cdr.TICK.replace("uint8 MODE_NONE=0", "uint8 PHASE_OF_TOMORROW=99\nuint8 MODE_NONE=0"))
    assert len(Recording.load(path).rows) == len(palpation(4))


def test_a_missing_file_a_directory_and_a_part_are_refused_with_a_sentence(tmp_path: Path) -> None:
    for path, sentence in ((tmp_path / "no.mcap", "No such file"), (tmp_path, "is a folder"), (tmp_path / "a.part", "palpd recover")):
        with pytest.raises(RecordingError, match=sentence):
            Recording.load(path)


def test_a_recording_without_a_tick_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no tick"):
        Recording.load(write(tmp_path / "run.mcap", palpation(0)))


def test_a_changed_byte_anywhere_in_the_data_is_found(tmp_path: Path) -> None:
    path = write(tmp_path / "run.mcap", palpation(30), b"model")
    whole = path.read_bytes()
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    last = summary.metadata_indexes[-1]
    end = last.offset + last.length
    rng = np.random.default_rng(0)
    for position in rng.integers(0, end, 150).tolist():
        damaged = bytearray(whole)
        damaged[position] ^= int(rng.integers(1, 256))
        path.write_bytes(damaged)
        with pytest.raises(RecordingError):
            Recording.load(path)


def test_a_file_cut_anywhere_is_refused_and_what_is_whole_is_restored(tmp_path: Path) -> None:
    rows = palpation(60)
    whole = write(tmp_path / "run.mcap", rows).read_bytes()
    restored = []
    for length in np.linspace(100, len(whole) - 1, 25).astype(int).tolist():
        cut = tmp_path / f"{length}.mcap"
        cut.write_bytes(whole[:length])
        with pytest.raises(RecordingError, match="palpd recover"):
            Recording.load(cut)
        part = cut.rename(part_of(cut))
        try:
            recovered = recover(part)
        except RecordingError:
            restored.append(0)
            continue
        back = Recording.load(recovered.path)
        assert same_rows(back.rows, rows[: len(back.rows)]).all()
        assert recovered.ticks == len(back.rows)
        assert recovered.duration_s == pytest.approx((len(back.rows) - 1) / 125)
        assert back.header == HEADER
        restored.append(len(back.rows))
    assert restored == sorted(restored)
    assert set(restored) == {0, 20, 40, 60}


def chunks_of(path: Path) -> list[tuple[int, int]]:
    """First and last byte of the compressed ticks of every chunk."""
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return [(chunk.chunk_start_offset, chunk.chunk_start_offset + chunk.chunk_length) for chunk in summary.chunk_indexes]


@pytest.mark.parametrize("place", ["payload", "checksum", "length", "opcode"])
def test_a_damaged_chunk_is_skipped_and_its_ticks_are_reported_missing_with_their_time(tmp_path: Path, place: str) -> None:
    rows = palpation(100)
    path = write(tmp_path / "run.mcap", rows, b"model")
    begin, end = chunks_of(path)[2]
    damaged = bytearray(path.read_bytes())
    damaged[{"payload": (begin + end) // 2, "checksum": begin + 33, "length": begin + 3, "opcode": begin}[place]] ^= 16
    (tmp_path / "run.part").write_bytes(damaged)
    path.unlink()
    recovered = recover(tmp_path / "run.part")
    back = Recording.load(recovered.path)
    assert back.rows["index"].tolist() == [*range(40), *range(60, 100)]
    assert (recovered.ticks, back.footer["damaged_ticks"], back.model_bytes) == (80, 20, b"model")
    (lost,) = recovered.lost
    assert (lost.ticks, lost.begin_s, lost.end_s) == (20, pytest.approx(39 / 125), pytest.approx(60 / 125))
    assert "20 ticks are missing (20 from 0.31 s to 0.48 s): the file is damaged at byte" in recovered.sentence


def test_missed_ticks_are_not_taken_for_lost_ones(tmp_path: Path) -> None:
    rows = palpation(60)
    rows["index"][20:] += 5
    rows["missed"][20] = 5
    (tmp_path / "run.part").write_bytes(write(tmp_path / "whole.mcap", rows).read_bytes())
    recovered = recover(tmp_path / "run.part")
    assert (recovered.lost, recovered.torn, recovered.ticks) == ((), "", 60)
    assert recovered.sentence == "60 ticks, 0.5 s restored."


def test_a_damaged_model_is_left_out_and_said(tmp_path: Path) -> None:
    path = write(tmp_path / "run.mcap", palpation(40), b"model " * 100)
    damaged = bytearray(path.read_bytes())
    damaged[damaged.index(b"model model") + 50] ^= 1
    (tmp_path / "run.part").write_bytes(damaged)
    path.unlink()
    recovered = recover(tmp_path / "run.part")
    assert Recording.load(recovered.path).model_bytes is None
    assert recovered.ticks == 40
    assert "damaged at byte" in recovered.sentence


def test_an_altered_header_is_said_though_every_chunk_is_whole(tmp_path: Path) -> None:
    path = write(tmp_path / "run.mcap", palpation(40))
    (tmp_path / "run.part").write_bytes(path.read_bytes().replace(b'"depths_m": [0.004]', b'"depths_m": [0.009]', 1))
    path.unlink()
    recovered = recover(tmp_path / "run.part")
    assert recovered.ticks == 40
    assert "header or footer may be altered" in recovered.sentence


@pytest.mark.parametrize(
    "forged", ["[]", "5", "null", '{"epoch_offset_s": "noon"}', '{"epoch_offset_s": NaN}', '{"epoch_offset_s": 1e300}']
)
def test_a_header_that_no_recording_has_is_refused_and_nothing_is_restored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, forged: str
) -> None:
    with monkeypatch.context() as forging:
        forging.setattr(json, "dumps", lambda *_: forged)
        writer = RecordingWriter(tmp_path / "run.mcap", HEADER)
    writer.write(palpation(40))
    writer.close({"verdict": "done", "reason": ""})
    with pytest.raises(RecordingError):
        Recording.load(tmp_path / "run.mcap")
    (tmp_path / "run.mcap").rename(tmp_path / "other.part")
    with pytest.raises(RecordingError, match="no recording of palpd"):
        recover(tmp_path / "other.part")
    assert [path.name for path in tmp_path.iterdir()] == ["other.part"]


@pytest.mark.parametrize("name", ["", "/", "x.mcap", "n" * 300 + ".part", "missing.part", ".part"])
def test_a_name_behind_which_no_part_stands_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RecordingError):
        recover(Path(name))
    assert not list(tmp_path.iterdir())


def test_a_restored_file_opens_everywhere_and_says_what_it_is(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "run.mcap", HEADER, b"model")
    writer.write(palpation(40))
    writer.flush()
    writer.abandon()
    recovered = recover(tmp_path / "run.part")
    assert recovered.path == tmp_path / "run.mcap"
    recording = Recording.load(recovered.path)
    assert recording.footer["verdict"] == "unfinished"
    assert recording.model_bytes == b"model"
    with AnyReader([recovered.path]) as bag:
        assert {connection.topic: connection.msgcount for connection in bag.connections}["/wrench"] == 320
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run.mcap", "run.part"]


def test_recovery_overwrites_nothing_and_refuses_what_is_not_a_part(tmp_path: Path) -> None:
    path = write(tmp_path / "run.mcap", palpation(4))
    with pytest.raises(RecordingError, match=r"not called \.part"):
        recover(path)
    part = tmp_path / "run.part"
    part.write_bytes(path.read_bytes())
    with pytest.raises(RecordingError, match="not overwritten"):
        recover(part)
    with pytest.raises(RecordingError, match="No such file"):
        recover(tmp_path / "none.part")
    growing = RecordingWriter(tmp_path / "growing.mcap", HEADER)
    with pytest.raises(RecordingError, match="still being written"):
        recover(tmp_path / "growing.part")
    growing.abandon()
    with pytest.raises(RecordingError, match="no whole tick"):
        recover(tmp_path / "growing.part")


def test_samples_are_the_tared_frames_with_the_robot_interpolated_in_time(tmp_path: Path) -> None:
    rows = palpation()
    samples = samples_of(Recording.load(write(tmp_path / "run.mcap", rows)))
    frame_t_s = rows["frame_t_s"][:, :8].ravel()
    host_s = samples.t_s + frame_t_s[frame_t_s >= rows["robot_t_s"][0]][0]
    assert samples.t_s[0] == 0.0
    assert samples.rate_Hz == pytest.approx(1000)
    assert samples.z_m == pytest.approx(0.05 - 0.01 * (host_s - 100), abs=1e-12)
    assert samples.z_cmd_m == pytest.approx(samples.z_m - 0.0005, abs=1e-12)
    assert samples.vz_m_per_s == pytest.approx(np.full(len(samples), -0.01))
    assert samples.wrench == pytest.approx(host_s[:, None] * [1, 2, 3, 4, 5, 6])


def test_the_samples_at_the_reports_have_their_noise_and_not_that_between_two(tmp_path: Path) -> None:
    rows, rng = palpation(), np.random.default_rng(4)
    noise_m = 1e-5 * rng.standard_normal(len(rows))
    rows["tcp_pose"][:, 2] += noise_m
    recording = Recording.load(write(tmp_path / "run.mcap", rows))
    whole, few = samples_of(recording), samples_of(recording, at_reports=True)
    assert few.rate_Hz == pytest.approx(125)
    away_s = np.abs(few.wrench[:, :1] - rows["robot_t_s"]).min(axis=1)  # the force fx of this recording is the time
    assert away_s.max() < 0.51e-3, "half the way between two frames"
    seen_m = few.z_m + 0.01 * few.t_s
    assert seen_m.std() > 0.85 * noise_m.std()
    assert (whole.z_m + 0.01 * whole.t_s).std() < 0.85 * noise_m.std(), "straight lines between reports"


def test_samples_of_one_site_begin_at_zero_and_hold_its_rows_only(tmp_path: Path) -> None:
    recording = Recording.load(write(tmp_path / "run.mcap", palpation()))
    whole, second = samples_of(recording), samples_of(recording, "B")
    assert second.t_s[0] == 0.0
    assert second.duration_s == pytest.approx(0.999, abs=0.01)
    assert second.wrench[0, 0] == pytest.approx(101.0, abs=0.02)
    assert len(second) < len(whole)
    with pytest.raises(RecordingError, match="no site C; it has A, B"):
        samples_of(recording, "C")


def test_a_robot_state_that_stays_for_several_ticks_counts_once(tmp_path: Path) -> None:
    rows = palpation()
    held = rows.copy()
    for name in ("robot_t_s", "tcp_pose", "tcp_speed", "target_pose"):
        held[name][1::2] = rows[name][:-1:2]
    samples = samples_of(Recording.load(write(tmp_path / "run.mcap", held)))
    assert np.diff(samples.z_m) == pytest.approx(np.full(len(samples) - 1, -1e-5), abs=1e-10)


def test_a_frame_that_does_not_come_later_is_left_out(tmp_path: Path) -> None:
    rows = palpation()
    rows["frame_t_s"][100, 3] = rows["frame_t_s"][100, 2] - 0.5
    samples = samples_of(Recording.load(write(tmp_path / "run.mcap", rows)))
    assert np.diff(samples.t_s).min() > 0
    assert np.diff(samples.t_s).max() == pytest.approx(0.002)


def test_samples_without_a_robot_are_refused(tmp_path: Path) -> None:
    rows = palpation(40)
    rows["connected"] = 0
    with pytest.raises(RecordingError, match="0 states of the robot"):
        samples_of(Recording.load(write(tmp_path / "run.mcap", rows)))


def test_an_export_reads_back_and_replaces_an_export_and_nothing_else(tmp_path: Path) -> None:
    recording = Recording.load(write(tmp_path / "run.mcap", palpation()))
    path = tmp_path / "a.csv"
    written = export(recording, path, "A")
    assert read_csv(path).wrench.tobytes() == written.wrench.tobytes()
    export(recording, path)
    assert len(read_csv(path)) > len(written)
    path.write_text("t_s,force\n0,1\n")
    with pytest.raises(BadInput, match="exists and is not overwritten"):
        export(recording, path)


def test_an_export_of_several_sites_says_where_each_row_belongs(tmp_path: Path) -> None:
    rows = palpation()
    rows["site"][:10] = -1
    rows["phase"] = Phase.PRESS
    recording = Recording.load(write(tmp_path / "run.mcap", rows))
    export(recording, tmp_path / "all.csv")
    with (tmp_path / "all.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert list(table[0])[-5:] == ["site", "phase", "mode", "x_m", "y_m"]
    assert [table[k]["site"] for k in (0, 200, -1)] == ["", "A", "B"]
    assert (table[-1]["phase"], table[-1]["mode"], float(table[-1]["x_m"]), float(table[-1]["y_m"])) == ("press", "none", 0.3, -0.2)
    assert read_csv(tmp_path / "all.csv").sites == samples_of(recording).sites == ("A", "B")


def test_an_export_of_one_site_has_the_columns_of_a_recording_and_the_name_of_the_site(tmp_path: Path) -> None:
    recording = Recording.load(write(tmp_path / "run.mcap", palpation()))
    export(recording, tmp_path / "b.csv", "B")
    assert (tmp_path / "b.csv").read_text().splitlines()[0] == ",".join((*COLUMNS, "site"))
    assert read_csv(tmp_path / "b.csv").sites == ("B",)
    assert samples_of(recording, "B").sites == ("B",)


@pytest.mark.parametrize("site", ["A", None], ids=["named", "the only one"])
def test_the_samples_of_a_site_begin_with_the_last_rest_before_the_first_motion_and_without_the_travel(
    tmp_path: Path, site: str | None
) -> None:
    rows = palpation(200)
    rows["site"] = 0
    rows["target_speed"][50:, 2] = -0.01
    rows["phase"] = Phase.PRESS
    rows["phase"][:40] = Phase.TARE
    rows["phase"][40:50] = Phase.BASELINE
    rows["phase"][180:] = Phase.TRAVEL
    export(Recording.load(write(tmp_path / "run.mcap", rows)), tmp_path / "a.csv", site)
    samples = read_csv(tmp_path / "a.csv")
    assert samples.wrench[0, 0] == pytest.approx(rows["robot_t_s"][49], abs=1e-3)
    assert samples.wrench[-1, 0] == pytest.approx(rows["frame_t_s"][179, 7])


@pytest.mark.parametrize("block", [1024, 7])
def test_recorded_devices_say_again_what_was_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block: int) -> None:
    monkeypatch.setattr("palpd.recording.reader.BLOCK", block)
    rows = palpation(20)
    rows["frames"][3], rows["rejected"][3] = 0, 2
    rows["frames"][4] = 0
    back = Recording.load(write(tmp_path / "run.mcap", rows)).rows
    robot, sensor = RecordedRobot(back), RecordedSensor(back)
    for number, row in enumerate(rows):
        robot.advance(number)
        sensor.advance(number)
        state, frames = robot.read(), sensor.read()
        assert (state.t_s, state.z_m, state.connected, state.robot_mode) == (row["robot_t_s"], row["tcp_pose"][2], True, 7)
        assert type(state.t_s) is float
        assert type(state.connected) is bool
        for name in ("tcp_pose", "tcp_speed", "target_pose", "target_speed", "tool_acceleration_m_per_s2"):
            assert getattr(state, name) == tuple(row[name])
        assert len(frames) == row["frames"]
        assert frames.rejected == row["rejected"]
        assert frames.wrench.tobytes() == row["wrench"][: len(frames)].tobytes()
        assert frames.wrench.flags.aligned
        assert frames.t_s.tobytes() == row["frame_t_s"][: len(frames)].tobytes()
        robot.move((0.0, 0.0, -0.01))
        robot.stop()
    robot.end()
    sensor.close()


def begun(ring: Ring, folder: Path) -> Recorder:
    """A recorder whose file is open and holds the header."""
    recorder = Recorder.begin(ring, folder / "run.mcap", HEADER, b"model")
    recorder.confirm(20.0)
    return recorder


@pytest.mark.hil
def test_the_recorder_process_writes_every_row_and_closes_in_order(tmp_path: Path, ring: Ring) -> None:
    rows = random_rows(1, [5] * 300)
    ring.write(rows[0])  # before the recording begins
    recorder = begun(ring, tmp_path)
    assert ring.recorder_state == RecorderState.WRITING
    for row in rows:
        ring.write(row)
    os.kill(recorder.pid, signal.SIGTERM)  # as systemd sends to all of palpd; the supervisor's close comes after
    assert recorder.close(FOOTER) == tmp_path / "run.mcap"
    recording = Recording.load(tmp_path / "run.mcap")
    assert same_rows(recording.rows, rows).all()
    assert recording.footer == {**FOOTER, "lost_rows": 0}
    assert (ring.recorder_state, ring.recorder_lag, ring.recorder_lost) == (RecorderState.CLOSED, 0, 0)
    assert not recorder.alive
    with pytest.raises(RecordingError, match="not overwritten"):
        begun(ring, tmp_path)


@pytest.mark.hil
def test_after_kill_9_of_the_recorder_at_most_half_a_second_is_missing(tmp_path: Path, ring: Ring) -> None:
    recorder = begun(ring, tmp_path)
    rows, begin_s = palpation(150), time.monotonic()
    for number, row in enumerate(rows):
        time.sleep(max(0.0, begin_s + number / 125 - time.monotonic()))
        ring.write(row)
    os.kill(recorder.pid, signal.SIGKILL)
    with pytest.raises(RecordingError, match=r"palpd recover .*run\.part"):
        recorder.close(FOOTER)
    assert not (tmp_path / "run.mcap").exists()
    recovered = recover(tmp_path / "run.part")
    back = Recording.load(recovered.path).rows
    assert same_rows(back, rows[: len(back)]).all()
    assert (len(rows) - len(back)) / 125 <= 0.5


@pytest.mark.hil
def test_when_the_supervisor_is_killed_the_ring_is_emptied_and_the_part_stays(tmp_path: Path) -> None:
    code = f"""
import os, sys, time
import numpy as np
from pathlib import Path
from palpd.recording.recorder import Recorder, record
from palpd.recording.ring import Ring
from palpd.tick import ROW
ring = Ring.create(125)
recorder = Recorder.begin(ring, Path({str(tmp_path / "run.mcap")!r}), {HEADER!r})
recorder.confirm(20.0)
row = np.zeros((), ROW)
for number in range(100):
    row["index"] = number
    ring.write(row[()])
print(recorder.pid, ring.name, flush=True)
time.sleep(60)
"""
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as supervisor:
        assert supervisor.stdout is not None
        pid, name = supervisor.stdout.readline().split()
        supervisor.kill()
    until_s = time.monotonic() + 10
    while (Path("/proc") / pid).exists() and time.monotonic() < until_s:
        time.sleep(0.02)
    assert not (Path("/proc") / pid).exists()
    assert recover(tmp_path / "run.part").ticks == 100
    while (Path("/dev/shm") / name).exists() and time.monotonic() < until_s:
        time.sleep(0.02)
    assert not (Path("/dev/shm") / name).exists()


@pytest.mark.hil
def test_a_full_disk_is_told_and_the_producer_goes_on(tmp_path: Path, ring: Ring) -> None:
    recorder = begun(ring, tmp_path)
    resource.prlimit(recorder.pid, resource.RLIMIT_FSIZE, (100_000, 100_000))
    rows = random_rows(2, [20] * 100)
    until_s = time.monotonic() + 10
    while ring.recorder_state != RecorderState.FAILED and time.monotonic() < until_s:
        for row in rows[:10]:
            ring.write(row)
        time.sleep(0.02)
    assert ring.recorder_state == RecorderState.FAILED
    assert ring.recorder_errno != 0
    ring.write(rows[0])
    with pytest.raises(RecordingError, match=r"stopped after \d+ ticks \(File too large\); palpd recover"):
        recorder.close(FOOTER)
    assert recover(tmp_path / "run.part").ticks > 0


@pytest.mark.hil
def test_rows_that_the_recorder_was_too_slow_for_are_counted(tmp_path: Path) -> None:
    ring = Ring.create(rate_Hz=20, seconds=1.0)
    recorder = begun(ring, tmp_path)
    for row in palpation(100):
        ring.write(row)  # five times what the ring holds, faster than the recorder looks
    recording = Recording.load(recorder.close(FOOTER))
    ring.close()
    assert recording.footer["lost_rows"] == 100 - len(recording.rows) > 0
    assert recording.rows["index"].tolist() == sorted(set(recording.rows["index"].tolist()))


def test_recovering_onto_a_full_disk_is_a_sentence_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    part = write(tmp_path / "some.mcap", palpation()).rename(tmp_path / "some.part")

    def full(_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(RecordingWriter, "flush", full)
    with pytest.raises(RecordingError, match=r"some\.mcap cannot be written \(No space left on device\)"):
        recover(part)
    assert list(tmp_path.iterdir()) == [part]


def test_a_recovery_that_was_cut_off_itself_is_begun_again_unless_it_is_under_way(tmp_path: Path) -> None:
    """After a loss of power in a recovery, each further one was refused: "some.recovering exists"; the page offers no other way."""
    part = write(tmp_path / "some.mcap", palpation()).rename(tmp_path / "some.part")
    left = tmp_path / "some.recovering"
    left.write_bytes(b"half")
    with left.open("rb") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        with pytest.raises(RecordingError, match=r"some\.recovering exists"):
            recover(part)
    assert recover(part).path.exists()
    assert not left.exists()


def test_a_pipe_is_no_recording(tmp_path: Path) -> None:
    for name, read in (("some.mcap", Recording.load), ("some.part", recover)):
        os.mkfifo(tmp_path / name)
        with pytest.raises(RecordingError, match="regular file"):
            read(tmp_path / name)


@pytest.mark.hil
def test_a_recording_that_cannot_begin_says_what_to_do_and_leaves_no_file(tmp_path: Path) -> None:
    ring = Ring.create(rate_Hz=20, seconds=1.0)
    usual = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, usual[1]))  # the recorder inherits it: its disk is as good as full
    try:
        recorder = Recorder.begin(ring, tmp_path / "run.mcap", HEADER)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, usual)
    with pytest.raises(RecordingError, match=r"run\.part cannot be written \(File too large\); make room there$"):
        recorder.confirm(20.0)
    assert not list(tmp_path.iterdir())
    ring.close()
