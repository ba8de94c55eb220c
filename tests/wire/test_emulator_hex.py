"""The emulated HEX-70 against bytes and rules that real ones and their makers' interfaces show."""

import fcntl
import os
import struct
import termios
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import serial

from hw.emulators.hex_pty import COUNTS_AT_CAPACITY, UNZEROED, Daq, TerminalLine

CONFIGURE_1_KHZ_500_HZ_ZERO = bytes.fromhex("AA0032030101FF01E0")  # from a public driver
ANSWER_NO_ERROR = bytes.fromhex("AA0050010000FB")  # captured from a real DAQ
REST = np.array(UNZEROED, dtype=float)


def configuration(speed: int, code: int, zero: int) -> bytes:
    body = bytes((0xAA, 0, 50, 3, speed, code, zero))
    return body + struct.pack(">H", sum(body) & 0xFFFF)


def configured(speed: int = 1, code: int = 2, zero: int = 0) -> Daq:
    daq = Daq()
    daq.take(configuration(speed, code, zero))
    daq.answers = b""
    return daq


def values(frame: bytes) -> tuple[int, ...]:
    return struct.unpack(">HH6h", frame[4:20])


def test_a_data_frame_has_the_bytes_of_the_documented_packet() -> None:
    daq = configured()
    daq.counter = 0x2317
    frame = daq.sample(np.array([-251.0, 37.0, -430.0, 95.0, -925.0, 6.0]), 0.0)
    assert frame.hex(" ") == "aa 07 08 10 23 18 00 00 ff 05 00 25 fe 52 00 5f fc 63 00 06 05 41"


def test_the_published_configuration_gets_the_captured_answer_and_takes_effect() -> None:
    daq = Daq()
    daq.take(CONFIGURE_1_KHZ_500_HZ_ZERO)
    assert daq.answers == ANSWER_NO_ERROR
    assert (daq.speed, daq.cutoff_Hz, daq.zeroed) == (1, 500.0, True)


@pytest.mark.parametrize(
    ("request_", "header", "payload"),
    [
        ("AB00120800C5", "AA001208", b"PRE00042"),
        ("AB000A1000C5", "AA000A10", b"OptoForce HEX-70"),
        ("AB00320600E3", "AA003206", bytes((10, 4, 0, 0, 0, 0))),
        ("AB015E0E0118", "AA015E0E", struct.pack(">7H", 200, 200, 200, 10000, 10000, 6500, 200)),
        ("AB01C20E017C", "AA01C20E", struct.pack(">7H", 8264, 8222, 1528, 11259, 10820, 9316, 1656)),
    ],
)
def test_a_read_request_is_answered_with_the_register(request_: str, header: str, payload: bytes) -> None:
    daq = Daq()
    daq.take(bytes.fromhex(request_))
    body = bytes.fromhex(header) + payload
    assert daq.answers == body + struct.pack(">H", sum(body) & 0xFFFF)


def test_bytes_that_are_no_packet_and_wrong_sums_change_nothing() -> None:
    daq = Daq()
    daq.take(b"AT\r\n\x00" + configuration(1, 2, 0)[:-1] + b"\x00" + configuration(3, 3, 0))
    assert (daq.speed, daq.filter_code) == (3, 3)
    assert daq.answers == ANSWER_NO_ERROR


def test_a_configuration_cut_into_single_bytes_is_understood() -> None:
    daq = Daq()
    for byte in configuration(5, 0, 0):
        daq.take(bytes((byte,)))
    assert (daq.speed, daq.cutoff_Hz, daq.answers) == (5, None, ANSWER_NO_ERROR)


def test_a_filter_that_does_not_exist_is_refused_and_leaves_the_old_one() -> None:
    daq = Daq()
    daq.take(configuration(1, 7, 0))
    assert daq.answers[4] != 0
    assert (daq.speed, daq.filter_code) == (10, 4)


def test_it_powers_up_streaming_at_100_hz_through_15_hz_not_zeroed() -> None:
    daq = Daq()
    frames = [frame for _ in range(1000) if (frame := daq.sample(REST, 0.0))]
    assert len(frames) == 100
    assert daq.cutoff_Hz == 15.0
    assert values(frames[-1])[2:] == UNZEROED


@pytest.mark.parametrize("speed", [1, 2, 3, 8, 10, 33, 100, 255])
def test_the_counter_steps_by_the_speed_byte(speed: int) -> None:
    daq = configured(speed)
    daq.counter = 65000
    frames = [frame for _ in range(2000) if (frame := daq.sample(REST, 0.0))]
    counters = np.array([values(frame)[0] for frame in frames])
    assert len(frames) == 2000 // speed
    assert set(np.diff(counters) % 65536) == {speed}


def test_speed_0_is_silence_and_the_counter_goes_on() -> None:
    daq = configured(0)
    assert not any(daq.sample(REST, 0.0) for _ in range(100))
    assert daq.counter == 100


def test_zero_takes_what_is_there_away_and_0_gives_it_back() -> None:
    daq = configured()
    daq.sample(REST, 0.0)
    daq.take(configuration(1, 2, 255))
    assert values(daq.sample(REST, 0.0))[2:] == (0,) * 6
    daq.take(configuration(1, 2, 0))
    assert values(daq.sample(REST, 0.0))[2:] == UNZEROED


def test_a_second_zero_without_a_0_between_is_passed_over() -> None:
    daq = configured()
    daq.sample(REST, 0.0)
    daq.take(configuration(1, 2, 255))
    daq.sample(REST - 100, 0.0)
    daq.take(configuration(1, 2, 255))
    assert values(daq.sample(REST - 100, 0.0))[2:] == (-100,) * 6


def test_counts_are_newtons_times_the_units_own_calibration() -> None:
    counts = Daq().measure(np.array([[10.0, -10.0, -10.0, 1.0, -1.0, 1.0]]))[0] - UNZEROED
    assert counts == pytest.approx([413.2, -411.1, -76.4, 1125.9, -1082.0, 9316 / 6.5], rel=1e-12)


def test_a_pull_beyond_the_zero_of_the_raw_reading_has_the_seventh_registers_sensitivity() -> None:
    daq = Daq()
    offset_N = 430 / 7.64
    counts = daq.measure(np.array([[0.0, 0.0, offset_N + 10.0, 0.0, 0.0, 0.0]]))[0]
    assert counts[2] == pytest.approx(10 * 1656 / 200)


def test_readings_are_rounded_to_counts() -> None:
    daq = configured()
    assert values(daq.sample(np.array([0.4, 0.6, -0.4, -0.6, 1.4, -1.6]), 0.0))[2:] == (0, 1, 0, -1, 1, -2)


def test_a_reading_beyond_16_bits_stands_at_the_end_of_the_scale() -> None:
    shown = values(configured().sample(np.array([4e4, -4e4, 0.0, 0.0, 0.0, 0.0]), 0.0))
    assert shown[2:4] == (32767, -32768)


def test_beyond_capacity_the_axis_raises_its_overload_bit() -> None:
    daq = configured()
    for axis, bit in enumerate((9, 8, 7, 6, 5, 4)):
        counts = REST.copy()
        counts[axis] -= COUNTS_AT_CAPACITY[axis] + 1
        assert values(daq.sample(counts, 0.0))[1] == 1 << bit
    assert values(daq.sample(REST, 0.0))[1] == 0


# faults


def test_a_swap_passes_the_sum_and_a_flip_does_not() -> None:
    def whole(frame: bytes) -> bool:
        return struct.unpack(">H", frame[20:])[0] == sum(frame[:20]) & 0xFFFF

    daq = configured()
    clean = daq.sample(REST, 0.0)
    daq.faults.swaps = 1
    swapped = daq.sample(REST, 0.0)
    assert whole(swapped)
    assert swapped[8:20] != clean[8:20]
    assert sorted(swapped[8:20]) == sorted(clean[8:20])
    for _ in range(50):
        daq.faults.flips = 1
        assert not whole(daq.sample(REST, 0.0))
    assert whole(daq.sample(REST, 0.0))


def test_garbage_and_a_false_header_leave_the_frame_behind_them_whole() -> None:
    daq = configured()
    daq.faults.garbage = b"\x01\x02\x03"
    assert daq.sample(REST, 0.0)[3:7] == b"\xaa\x07\x08\x10"
    daq.faults.false_headers = 1
    data = daq.sample(REST, 0.0)
    assert len(data) == 31
    assert data[:4] == data[9:13] == b"\xaa\x07\x08\x10"


def test_a_silent_sensor_speaks_again_and_its_counter_has_gone_on() -> None:
    daq = configured()
    daq.faults.silent_until_s = 0.05
    frames = [daq.sample(REST, k * 0.001) for k in range(100)]
    assert next(k for k, frame in enumerate(frames) if frame) == 50
    assert values(frames[50])[0] == 51


def test_a_stuck_sensor_repeats_its_values_under_a_running_counter() -> None:
    daq = configured()
    daq.sample(REST, 0.0)
    daq.faults.stuck_until_s = 1.0
    assert values(daq.sample(REST - 50, 0.5)) == (2, 0, *UNZEROED)
    assert values(daq.sample(REST - 50, 1.0))[2:] == tuple(count - 50 for count in UNZEROED)


def test_a_drift_reads_more_and_more_pressed() -> None:
    daq = configured()
    daq.faults.drift_N_per_s = 10.0
    for _ in range(1000):
        frame = daq.sample(REST, 0.0)
    assert values(frame)[4] == -430 - 76


# the terminal device


@pytest.fixture
def line(tmp_path: Path) -> Iterator[TerminalLine]:
    line = TerminalLine(tmp_path / "hex")
    yield line
    line.unplug()


def opened(line: TerminalLine) -> serial.Serial:
    port = serial.Serial(line.path, 1_000_000, timeout=1.0, exclusive=True)
    line.receive()
    return port


def test_bytes_pass_unchanged_in_both_directions(line: TerminalLine) -> None:
    every = bytes(range(256))
    with opened(line) as port:
        line.send(every)
        assert port.read(256) == every
        port.write(every)
        assert line.receive() == every


def test_nothing_of_what_was_sent_before_the_port_was_opened_is_found_in_it(line: TerminalLine) -> None:
    line.receive()
    line.send(b"old")
    with opened(line) as port:
        line.send(b"new")
        assert port.read(3) == b"new"


def test_a_host_that_does_not_read_finds_the_oldest_frames_whole_and_in_order(line: TerminalLine) -> None:
    frames = [struct.pack(">H", k) + bytes(20) for k in range(8000)]
    with opened(line) as port:
        for frame in frames:
            line.send(frame)
        port.timeout = 0.5
        data = b"".join(iter(lambda: port.read(4096), b""))
        for _ in range(3):
            line.send(b"\xff" * 22)
        data += b"".join(iter(lambda: port.read(22), b""))
    numbers = [struct.unpack(">H", data[at : at + 2])[0] for at in range(0, len(data), 22)]
    assert len(data) % 22 == 0
    assert numbers[:100] == list(range(100))
    assert numbers == sorted(set(numbers[:-3])) + [0xFFFF] * 3, "in order; the kernel may make room now and then while it takes them in"
    assert len(numbers) < 8000


def test_an_unplugged_device_is_gone_for_the_host_and_comes_back_behind_the_same_link(line: TerminalLine) -> None:
    with opened(line) as port:
        line.unplug()
        with pytest.raises(serial.SerialException):
            port.read(1)
    assert not os.path.lexists(line.path)
    line.plug_in()
    with opened(line) as port:
        line.send(b"back")
        assert port.read(4) == b"back"


def test_a_port_closed_without_ceremony_can_be_opened_again(line: TerminalLine) -> None:
    for _ in range(3):
        with opened(line) as port:
            fcntl.ioctl(port.fileno(), termios.TIOCEXCL)
        line.receive()
    with opened(line) as port:
        line.send(b"hello")
        assert port.read(5) == b"hello"
