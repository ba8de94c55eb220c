"""The sensor's clock on made-up arrivals, and the port on a terminal of our own with a small DAQ behind it."""

import os
import pty
import select
import struct
import threading
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hw.hex_sensor import HexSensor, SampleClock
from palpd.errors import SensorError

REGISTERS = {0x015E: (200, 200, 200, 10000, 10000, 6500, 200), 0x01C2: (8264, 8222, 1528, 11259, 10820, 9316, 1656)}


def packet(body: bytes) -> bytes:
    return body + (sum(body) & 0xFFFF).to_bytes(2, "big")


class FarDaq:
    """Answers on the far end of a terminal; what it does not do is chosen by the test."""

    def __init__(
        self,
        registers: dict[int, tuple[int, ...]] = REGISTERS,
        answer: int | None = 0,
        obeys: bool = True,
        axes: int = 6,
        ignore: int = 0,
        serial_number: bytes = b"IRE00042",
    ) -> None:
        self.master, slave = pty.openpty()
        tty.setraw(self.master)
        self.path = os.ttyname(slave)
        os.close(slave)
        self.registers, self.answer, self.obeys, self.axes, self.ignore = registers, answer, obeys, axes, ignore
        self.serial_number = serial_number
        self.step, self.configurations = 10, list[bytes]()
        self.counts = (-251, 37, -430, 95, -925, 6)
        self.before_next = b""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def unplug(self) -> None:
        self._stop.set()
        self._thread.join()
        os.close(self.master)

    def _run(self) -> None:
        counter, next_s, heard = 65000, time.monotonic(), b""
        while not self._stop.is_set():
            try:
                ready, _, _ = select.select([self.master], [], [], max(0.0, next_s - time.monotonic()))
                if ready:
                    heard = self._reply(heard + os.read(self.master, 4096))
                if time.monotonic() >= next_s:
                    counter = counter + self.step & 0xFFFF
                    next_s += self.step * 1e-3
                    header = b"\xaa\x07\x08" + bytes([4 + 2 * self.axes])
                    data = packet(header + struct.pack(f">HH{self.axes}h", counter, 0, *self.counts[: self.axes]))
                    spoilt, self.before_next = self.before_next, b""
                    os.write(self.master, spoilt + data)
            except OSError:  # nobody has the terminal open
                time.sleep(0.01)

    def _reply(self, heard: bytes) -> bytes:
        while len(heard) >= 6:
            length = 6 if heard[0] == 0xAB else 9
            if len(heard) < length:
                break
            command, heard = heard[:length], heard[length:]
            assert packet(command[:-2]) == command
            if self.ignore:
                self.ignore -= 1
                continue
            address = command[1] << 8 | command[2]
            if command[0] == 0xAA and address == 0x32:
                self.configurations.append(command[4:7])
                if self.obeys and self.answer == 0:
                    self.step = command[4]
                if self.answer is not None:
                    os.write(self.master, packet(bytes((0xAA, 0x00, 0x50, 0x01, self.answer))))
            elif address == 0x12 and self.serial_number:
                os.write(self.master, packet(b"\xaa\x00\x12\x08" + self.serial_number))
            elif address in self.registers:
                os.write(self.master, packet(b"\xaa" + command[1:4] + struct.pack(">7H", *self.registers[address])))
        return heard


@pytest.fixture
def daq() -> Iterator[Callable[..., FarDaq]]:
    stand_ins: list[FarDaq] = []

    def make(**kinds: object) -> FarDaq:
        stand_ins.append(FarDaq(**kinds))  # type: ignore[arg-type]
        return stand_ins[-1]

    yield make
    for one in stand_ins:
        if not one._stop.is_set():
            one.unplug()


@pytest.fixture
def short_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hw.hex_sensor.ANSWER_TIMEOUT_S", 0.1)


def collect(sensor: HexSensor, frames: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    t_s, counter, wrench = [], [], []
    until_s = time.monotonic() + 5
    while sum(map(len, t_s)) < frames and time.monotonic() < until_s:
        got = sensor.read()
        t_s.append(got.t_s)
        counter.append(got.counter)
        wrench.append(got.wrench)
        time.sleep(0.002)
    return np.concatenate(t_s), np.concatenate(counter), np.concatenate(wrench)


# the port


@pytest.mark.hil
def test_a_sensor_is_identified_configured_and_read(daq: Callable[..., FarDaq]) -> None:
    far = daq()
    sensor = HexSensor(far.path)
    assert sensor.serial_number == "IRE00042"
    assert sensor.calibration_source == "registers"
    assert far.configurations == [bytes((1, 2, 0))]  # 1 kHz, 150 Hz, the DAQ's own zero taken off
    assert sensor.delay_s == pytest.approx(1.06e-3, rel=0.01)
    np.testing.assert_allclose(sensor.counts_per_N, [41.32, 41.11, 7.64])
    t_s, counter, wrench = collect(sensor, 300)
    assert (np.diff(counter.astype(int)) % 65536 == 1).all()
    assert (np.diff(t_s) > 0).all()
    assert 0 <= time.monotonic() - t_s[-1] < 0.5
    np.testing.assert_allclose(wrench[0], np.array(far.counts) / [41.32, 41.11, 7.64, 1125.9, 1082.0, 9316 / 6.5])
    sensor.close()


@pytest.mark.hil
def test_reading_never_waits_and_counts_rejects_of_each_look(daq: Callable[..., FarDaq]) -> None:
    far = daq()
    sensor = HexSensor(far.path, rate_Hz=100)
    collect(sensor, 2)
    began_s = time.monotonic()
    for _ in range(100):
        sensor.read()
    assert time.monotonic() - began_s < 0.5, "frames come every 10 ms: a hundred of them would take a second"
    far.before_next = bytes(range(30))
    rejected, until_s = [], time.monotonic() + 5
    while time.monotonic() < until_s and not any(rejected):
        rejected.append(sensor.read().rejected)
    assert sum(rejected) == 2
    assert sensor.read().rejected == 0
    sensor.close()


@pytest.mark.hil
@pytest.mark.usefixtures("short_answers")
def test_an_answer_that_was_missed_is_asked_for_again(daq: Callable[..., FarDaq]) -> None:
    far = daq(ignore=1)
    sensor = HexSensor(far.path)
    assert sensor.serial_number == "IRE00042"
    sensor.close()


@pytest.mark.hil
def test_the_pulled_sensitivity_of_fz_can_be_chosen(daq: Callable[..., FarDaq]) -> None:
    sensor = HexSensor(daq().path, fz_slopes="pulled")
    assert sensor.counts_per_N[2] == pytest.approx(8.28)
    sensor.close()


@pytest.mark.hil
def test_with_both_slopes_readings_have_that_for_pressing_and_the_ratio_is_told(daq: Callable[..., FarDaq]) -> None:
    sensor = HexSensor(daq().path, fz_slopes="both")
    assert sensor.counts_per_N[2] == pytest.approx(7.64)
    assert sensor.pulled_over_pressed == pytest.approx(8.28 / 7.64)
    sensor.close()


@pytest.mark.hil
@pytest.mark.usefixtures("short_answers")
def test_both_slopes_without_registers_need_both_in_the_sheet(daq: Callable[..., FarDaq]) -> None:
    sheet = {"counts_per_N": (40, 41, 7.6), "counts_per_Nm": (1100, 1000, 1400), "fz_slopes": "both"}
    with pytest.raises(SensorError, match="its sheet has one slope; set fz_pulled_counts_per_N"):
        HexSensor(daq(registers={}).path, **sheet)
    sensor = HexSensor(daq(registers={}).path, fz_pulled_counts_per_N=8.2, **sheet)
    assert sensor.pulled_over_pressed == pytest.approx(8.2 / 7.6)
    sensor.close()


@pytest.mark.hil
@pytest.mark.usefixtures("short_answers")
def test_calibration_comes_from_the_configuration_where_registers_are_not_answered(daq: Callable[..., FarDaq]) -> None:
    sensor = HexSensor(daq(registers={}).path, counts_per_N=(40, 41, 7.6), counts_per_Nm=(1100, 1000, 1400))
    assert sensor.calibration_source == "config"
    np.testing.assert_allclose(sensor.counts_per_N, [40, 41, 7.6])
    sensor.close()


@pytest.mark.hil
@pytest.mark.usefixtures("short_answers")
def test_a_sensor_without_any_calibration_is_refused(daq: Callable[..., FarDaq]) -> None:
    with pytest.raises(SensorError, match="none is configured; set counts_per_N"):
        HexSensor(daq(registers={}).path)


@pytest.mark.hil
@pytest.mark.parametrize(("fz", "accepted"), [(7.70, True), (7.73, False)])
def test_a_configuration_that_contradicts_the_registers_is_refused(daq: Callable[..., FarDaq], fz: float, accepted: bool) -> None:
    far = daq()
    given_N, given_Nm = (41.32, 41.11, fz), (1125.9, 1082.0, 1433.2)
    if accepted:
        HexSensor(far.path, counts_per_N=given_N, counts_per_Nm=given_Nm).close()
    else:
        with pytest.raises(SensorError, match=r"7\.73 counts per N on Fz are 1\.2% off the 7\.64"):
            HexSensor(far.path, counts_per_N=given_N, counts_per_Nm=given_Nm)


@pytest.mark.hil
@pytest.mark.usefixtures("short_answers")
@pytest.mark.parametrize(
    ("kinds", "sentence"),
    [
        ({"answer": None}, "has not answered its configuration"),
        ({"answer": 3}, r"refuses 1000 Hz with its filter at 150\.0 Hz \(code 3\)"),
        ({"obeys": False}, r"counter goes in steps of \[10\], not 1"),
        ({"axes": 3, "answer": None}, "three-axis sensor"),
    ],
)
def test_a_device_that_is_not_as_configured_is_refused(daq: Callable[..., FarDaq], kinds: dict[str, object], sentence: str) -> None:
    far = daq(**kinds)
    with pytest.raises(SensorError, match=sentence):
        HexSensor(far.path, counts_per_N=(41.32, 41.11, 7.64), counts_per_Nm=(1125.9, 1082.0, 1433.2))


@pytest.mark.hil
@pytest.mark.usefixtures("short_answers")
def test_a_silent_device_is_refused() -> None:
    master, slave = pty.openpty()
    with pytest.raises(SensorError, match="sends nothing"):
        HexSensor(os.ttyname(slave), counts_per_N=(1, 1, 1), counts_per_Nm=(1, 1, 1))
    os.close(master)
    os.close(slave)


@pytest.mark.hil
def test_a_port_has_one_owner(daq: Callable[..., FarDaq]) -> None:
    far = daq()
    sensor = HexSensor(far.path)
    with pytest.raises(SensorError, match="is in use by another program"):
        HexSensor(far.path)
    assert len(collect(sensor, 20)[0]) >= 20
    sensor.close()


def test_a_port_that_is_absent_or_no_terminal_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SensorError, match="does not exist; plug the sensor in"):
        HexSensor(str(tmp_path / "none"))
    (tmp_path / "file").write_text("")
    with pytest.raises(SensorError, match="cannot be opened as a serial port"):
        HexSensor(str(tmp_path / "file"))


@pytest.mark.hil
def test_an_unplugged_sensor_raises_and_a_closed_one_too(daq: Callable[..., FarDaq]) -> None:
    far = daq()
    sensor = HexSensor(far.path)
    collect(sensor, 20)
    far.unplug()
    with pytest.raises(SensorError, match="is gone"):
        collect(sensor, 10_000)
    sensor.close()
    with pytest.raises(SensorError, match="is closed"):
        sensor.read()


@pytest.mark.parametrize(
    ("settings_", "sentence"),
    [
        ({"filter_cutoff_Hz": 100.0}, "filter of 100 Hz does not exist"),
        ({"rate_Hz": 600.0}, "rate of 600 Hz does not exist"),
        ({"rate_Hz": 2000.0}, "rate of 2000 Hz does not exist"),
        ({"rate_Hz": 0.0}, "rate of 0 Hz does not exist"),
        ({"counts_per_N": (1.0, 1.0, 1.0)}, "only one of counts_per_N and counts_per_Nm"),
        ({"counts_per_N": (1.0, 1.0), "counts_per_Nm": (1.0, 1.0, 1.0, 1.0)}, "three positive numbers each"),
        ({"counts_per_N": (1.0, -1.0, 1.0), "counts_per_Nm": (1.0, 1.0, 1.0)}, "three positive numbers each"),
    ],
)
def test_settings_that_the_daq_does_not_have_are_refused_before_the_port_is_opened(settings_: dict[str, object], sentence: str) -> None:
    with pytest.raises(SensorError, match=sentence):
        HexSensor("/nowhere", **settings_)  # type: ignore[arg-type]


# the clock


def read_in_batches(
    rate_error: float, duration_s: float, period_s: float, jitter_s: float, lost: float = 0.0, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """True times of samples and the times given, for a DAQ clock off by `rate_error` and reads on a jittering grid."""
    rng = np.random.default_rng(seed)
    count = np.arange(int(duration_s * 1000))
    true_s = 500.0 + count * 1e-3 * (1 + rate_error)
    arrival_s = np.maximum.accumulate(true_s + 0.2e-3 + rng.exponential(0.1e-3, len(count)))
    kept = rng.random(len(count)) >= lost
    clock, counters = SampleClock(), (count + 60000) & 0xFFFF
    stamped, at = [], 0
    for planned_s in np.arange(500.0, true_s[-1], period_s):
        now_s = planned_s + rng.exponential(jitter_s)
        to = max(at, int(np.searchsorted(arrival_s, now_s)))
        chosen = np.arange(at, to)[kept[at:to]]
        stamped.append(clock.stamp(counters[chosen].astype(np.uint16), now_s))
        at = to
    return true_s[:at][kept[:at]], np.concatenate(stamped)


@pytest.mark.parametrize("rate_error", [-0.8e-3, -50e-6, 0.0, 50e-6, 0.8e-3])
@pytest.mark.parametrize("period_s", [0.002, 0.008])
def test_sensor_time_is_late_by_less_than_two_samples_under_jitter_loss_and_wraps(rate_error: float, period_s: float) -> None:
    true_s, given_s = read_in_batches(rate_error, 80.0, period_s, 0.3e-3, lost=0.02)
    late_s = (given_s - true_s)[1000:]
    assert late_s.min() > -0.1e-3
    assert late_s.max() < 2e-3
    assert np.abs(np.diff(given_s) - np.diff(true_s))[1000:].max() < 1.1e-3


@given(
    st.lists(st.tuples(st.lists(st.integers(0, 65535), max_size=5), st.floats(0, 100)), max_size=20),
)
@settings(max_examples=200, deadline=None)
def test_sensor_time_never_runs_backwards_whatever_the_counter_does(looks: list[tuple[list[int], float]]) -> None:
    clock, now_s, last_s = SampleClock(), 1000.0, -np.inf
    for counters, pause_s in looks:
        now_s += pause_s
        times = clock.stamp(np.array(counters, np.uint16), now_s)
        assert (np.diff(times) >= 0).all()
        if len(times):
            assert times[0] >= last_s
            last_s = times[-1]


def test_an_outage_longer_than_a_wrap_of_the_counter_is_bridged() -> None:
    clock = SampleClock()
    assert clock.stamp(np.array([100], np.uint16), 10.0)[-1] == pytest.approx(10.0)
    outage_s = 200.0
    counter = (100 + 200_000) & 0xFFFF
    assert clock.stamp(np.array([counter], np.uint16), 10.0 + outage_s)[-1] == pytest.approx(210.0)


def test_a_restarted_counter_finds_its_place_again() -> None:
    clock = SampleClock()
    clock.stamp(np.array([30000], np.uint16), 10.0)
    assert clock.stamp(np.array([5], np.uint16), 11.0)[-1] == pytest.approx(11.0, abs=1e-3)
    assert clock.stamp(np.array([6], np.uint16), 11.001)[-1] == pytest.approx(11.001, abs=1e-3)
