"""The second channel of palpd inject: its laws against other formulas, its seal, and the recording, whose ticks stay as they are."""

import hashlib
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from scipy.signal import lfilter

from palpd.errors import RecordingError
from palpd.recording.mcap_file import RecordingWriter
from palpd.recording.reader import Recording, Rows, same_rows
from palpd.recording.recorder import Recorder
from palpd.recording.recovery import recover
from palpd.recording.ring import Ring
from palpd.recording.second_channel import DRIVE_TAU_S, SealedAnswer, SecondChannel
from palpd.recording.topics import SECOND_TOPIC, TICK_TOPIC
from palpd.tick import ROW, Floats, Phase
from tests.recording.test_recording import FOOTER, HEADER, ring

__all__ = ["ring"]

STEP_S, TARED = 1e-3, 40
"""Distance of the frames, and the number of ticks until the tare is over."""
ALL = {
    "": {}, "sensor.gain": {"error": -0.1}, "sensor.bias": {"offset_N": 0.3}, "sensor.drift": {"rate_N_per_s": 0.02},
    "sensor.latency": {"delay_s": 0.0123}, "sensor.filter": {"cutoff_Hz": 5.0}, "sensor.hysteresis": {"amplitude_N": 0.4, "width_N": 1.0},
}  # fmt: skip


def rows_of(force_N: Floats) -> Rows:
    """Ticks with 0 to 9 frames 1 ms apart; the force is fz, and the other axes follow it."""
    counts = np.random.default_rng(1).integers(0, 10, len(force_N))
    counts = counts[: int(np.searchsorted(np.cumsum(counts), len(force_N), "right"))]
    rows, first = np.zeros(len(counts), ROW), 0
    rows["index"], rows["frames"] = np.arange(len(counts)), counts
    rows["phase"] = np.where(np.arange(len(counts)) < TARED, Phase.TARE, Phase.PRESS)
    for row, count in zip(rows, counts.tolist(), strict=True):
        row["frame_t_s"][:count] = 50.0 + STEP_S * np.arange(first, first + count)
        row["tared"][:count] = force_N[first : first + count, None] * [0.1, -0.2, 1.0, 0.01, 0.02, 0.03]
        row["now_s"] = 50.0 + STEP_S * (first + count)
        first += count
    return rows


def filled_of(rows: Rows) -> np.ndarray:
    return np.arange(rows["frame_t_s"].shape[1]) < rows["frames"][:, None]


def second(rows: Rows, effect: str, channel: SecondChannel | None = None) -> Floats:
    return (channel or SecondChannel(SealedAnswer(effect, ALL[effect]))).wrench(rows, filled_of(rows))


@pytest.fixture(scope="module")
def rows() -> Rows:
    return rows_of(np.random.default_rng(2).normal(0.0, 0.05, 3000) + 4.0 * np.sin(np.arange(3000) / 300.0) ** 2)


@pytest.mark.parametrize("effect", ALL)
def test_a_law_gives_what_another_formula_gives_and_before_the_tare_nothing(rows: Rows, effect: str) -> None:
    raw, parameters = rows["tared"][filled_of(rows)], ALL[effect]
    t_s, begun = rows["frame_t_s"][filled_of(rows)], np.repeat(rows["phase"] != Phase.TARE, rows["frames"])
    expected, fz = raw.copy(), raw[:, 2]
    if effect == "sensor.gain":
        expected[:, 2] = 0.9 * fz
    elif effect == "sensor.bias":
        expected[:, 2] = fz + 0.3
    elif effect == "sensor.drift":
        expected[:, 2] = fz + 0.02 * (t_s - t_s[begun][0])
    elif effect == "sensor.latency":
        expected = raw[[int(np.argmin(np.abs(t_s - (now_s - 0.0123)))) for now_s in t_s]]
    elif effect == "sensor.filter":
        kept = np.exp(-2.0 * np.pi * 5.0 * STEP_S)
        expected = lfilter([1.0 - kept], [1.0, -kept], raw, axis=0, zi=kept * raw[:1])[0]
    elif effect == "sensor.hysteresis":
        kept = np.exp(-STEP_S / DRIVE_TAU_S)
        drive_N = lfilter([1.0 - kept], [1.0, -kept], fz, zi=[kept * fz[0]])[0]
        for limit_N in (0.5, 1.0, 2.0):  # a slider that is dragged: its place is the drive minus a play of that half-width
            place = np.zeros(len(drive_N))
            place[0] = drive_N[0]
            for k in range(1, len(drive_N)):
                place[k] = min(max(place[k - 1], drive_N[k] - limit_N), drive_N[k] + limit_N)
            expected[:, 2] += parameters["amplitude_N"] / 3.0 * (drive_N - place) / limit_N
    expected[~begun] = raw[~begun]
    assert second(rows, effect) == pytest.approx(expected, abs=1e-9)
    assert (second(rows, effect) != raw).any() == bool(effect)


def test_the_loop_of_the_hysteresis_has_the_corners_of_its_three_elements() -> None:
    """After a long way up all three have slipped; a way back of the width turns the first, and brings the second to its middle."""
    up_N, down_N = np.linspace(0.0, 10.0, 4000), np.linspace(10.0, 9.0, 1000)
    rows = rows_of(np.concatenate([np.zeros(500), up_N, np.full(300, 10.0), down_N, np.full(300, 9.0)]))
    loop_N = (second(rows, "sensor.hysteresis") - rows["tared"][filled_of(rows)])[:, 2]
    assert loop_N[4700] == pytest.approx(0.4, abs=1e-3)
    assert loop_N[-1] == pytest.approx(0.4 * (-1.0 + 0.0 + 0.5) / 3.0, abs=1e-3)


@pytest.mark.parametrize("effect", ALL)
def test_ticks_in_pieces_give_what_they_give_as_a_whole(rows: Rows, effect: str) -> None:
    channel = SecondChannel(SealedAnswer(effect, ALL[effect]))
    pieces = [second(piece, effect, channel) for piece in np.split(rows, [1, 2, TARED - 1, TARED + 1, 300, 301])]
    assert np.concatenate(pieces).tobytes() == second(rows, effect).tobytes()


def test_the_seal_is_that_of_the_text_and_the_salt_keeps_it_from_being_guessed() -> None:
    planted = SealedAnswer("sensor.gain", {"error": 0.1}, "c0ffee")
    assert planted.text == '{"effect": "sensor.gain", "parameters": {"error": 0.1}, "salt": "c0ffee"}'
    assert planted.seal == hashlib.sha256(planted.text.encode()).hexdigest()
    assert planted.seal != SealedAnswer("sensor.gain", {"error": 0.1}, "c0ffef").seal


def ticks(path: Path) -> list[tuple[int, int, bytes]]:
    """Channel, time and bytes of each message of the topic that holds the rows."""
    with path.open("rb") as stream:
        messages = make_reader(stream, validate_crcs=True).iter_messages(topics=TICK_TOPIC)
        return [(channel.id, message.log_time, message.data) for _, channel, message in messages]


def test_the_recorder_writes_the_channel_beside_ticks_that_do_not_differ_by_a_byte(rows: Rows, tmp_path: Path, ring: Ring) -> None:
    planted, rows = SealedAnswer("sensor.latency", ALL["sensor.latency"], "salt"), rows[:300]
    recorder = Recorder.begin(ring, tmp_path / "injected.mcap", {**HEADER, "injection": planted.seal}, planted=planted)
    recorder.confirm(20.0)
    for row in rows:
        ring.write(row)
    recorder.close(FOOTER)
    injected = Recording.load(tmp_path / "injected.mcap")
    assert injected.second is not None
    assert injected.second.tobytes() == second(rows, "sensor.latency").tobytes()
    assert same_rows(injected.rows, rows).all()
    plain = RecordingWriter(tmp_path / "plain.mcap", HEADER)
    plain.write(rows)
    plain.close(FOOTER)
    assert ticks(tmp_path / "injected.mcap") == ticks(tmp_path / "plain.mcap")
    assert SECOND_TOPIC.encode() not in (tmp_path / "plain.mcap").read_bytes()
    judged = injected.with_second_channel().rows
    assert judged["tared"][filled_of(judged)].tobytes() == injected.second.tobytes()
    assert same_rows(injected.rows, rows).all()  # the recording itself stays as it was
    with pytest.raises(RecordingError, match="holds 0 frames of a second channel, expected"):
        Recording.load(tmp_path / "plain.mcap").with_second_channel()


def test_a_recovered_run_keeps_its_mark_and_loses_the_channel(rows: Rows, tmp_path: Path) -> None:
    planted = SealedAnswer("", {}, "salt")
    writer = RecordingWriter(tmp_path / "run.mcap", {**HEADER, "injection": planted.seal}, second=SecondChannel(planted))
    writer.write(rows)
    writer.flush()
    writer.abandon()
    recovered = Recording.load(recover(tmp_path / "run.part").path)
    assert (recovered.injected, recovered.second) == (True, None)
    with pytest.raises(RecordingError, match="from which nothing is learned"):
        recovered.refuse_injected()
