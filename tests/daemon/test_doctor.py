import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from hw.emulators.process import Emulated, started
from palpd.config import Config, SensorConfig, parse_config
from palpd.daemon import doctor
from palpd.daemon.doctor import devices, machine, stored, weight
from palpd.daemon.doctor.devices import DeviceRecord
from palpd.daemon.finding import Finding
from palpd.daemon.probe_record import probe_record
from palpd.daemon.stored_state import Calibration, Latch, State
from palpd.errors import SensorError
from palpd.testing.fixtures import skip_without_ur_rtde
from palpd.tick import NO_FRAMES, RobotMode, SafetyMode, SensorFrames
from tests.paths import ROOT
from tests.scenes import robot

HOST = "127.0.9.73"
FREE = np.array([1.0, -2.0, 30.0, 0.0, 0.0, 0.0])


class ScriptedSensor:
    """Gives one frame a look, of the wrench it is set to."""

    serial_number, calibration_source, pulled_over_pressed, counter_step = "PRE00042", "registers", None, 1

    def __init__(self) -> None:
        self.wrench, self.count, self.rng = FREE.copy(), 0, np.random.default_rng(1)

    def read(self) -> SensorFrames:
        self.count += 1
        noisy = self.wrench + self.rng.normal(0.0, 0.05, 6)
        return SensorFrames(np.zeros(1), np.array([self.count & 0xFFFF], np.uint16), np.zeros(1, np.uint16), noisy[None])

    def close(self) -> None: ...


def record(n: int = 10_000, **changes: Any) -> DeviceRecord:
    """Ten healthy seconds at 1 kHz and 125 Hz."""
    rng = np.random.default_rng(0)
    stamps_s = np.arange(1250) * 0.008
    usual: dict[str, Any] = {
        "duration_s": 10.0,
        "wrench": FREE + rng.normal(0.0, 0.05, (n, 6)),
        "status": 0,
        "rejected": 0,
        "counter_steps": np.ones(n - 1, np.int64),
        "longest_silence_s": 0.002,
        "state_s": stamps_s + rng.uniform(0.0, 0.0005, 1250),
        "timestamp_s": stamps_s,
        "last": robot(),
    }
    return DeviceRecord(**{**usual, **changes})


def config(folder: Path, **blocks: Any) -> Config:
    return parse_config({"paths": {"state": str(folder), "runs": str(folder)}, **blocks}, "the test's configuration")


def named(findings: list[Finding], name: str) -> Finding:
    return next(finding for finding in findings if finding.name == name)


def of_sensor(folder: Path, **changes: Any) -> list[Finding]:
    return devices.judge_sensor(record(**changes), config(folder), ScriptedSensor())


def of_probe(folder: Path, **changes: Any) -> list[Finding]:
    settings = config(folder)
    return devices.judge_probe(record(**changes), settings, ScriptedSensor(), probe_record(settings, State(folder)))[0]


def of_robot(folder: Path, **changes: Any) -> list[Finding]:
    return devices.judge_robot(record(**changes), config(folder))


def test_a_healthy_cell_has_nothing_to_complain_of(tmp_path: Path) -> None:
    State(tmp_path).keep("calibration", Calibration(tuple(FREE), "today", "PRE00042"))
    findings = of_sensor(tmp_path) + of_probe(tmp_path) + of_robot(tmp_path)
    assert [finding.verdict for finding in findings] == ["ok"] * 7
    assert named(findings, "sensor noise").figures["noise_N"] == pytest.approx([0.05] * 3, rel=0.1)
    assert max(map(abs, named(findings, "sensor drift").figures["drift_N"])) < 0.01


@pytest.mark.parametrize(
    ("name", "verdict", "changes"),
    [
        ("sensor frames", "fail", {"status": 1 << 10}),
        ("sensor frames", "fail", {"longest_silence_s": 0.3}),
        ("sensor frames", "fail", {"n": 9_000}),
        ("sensor frames", "warn", {"rejected": 3}),
        ("sensor frames", "warn", {"counter_steps": np.array([1, 1, 3, 1])}),
        ("sensor noise", "fail", {"wrench": np.ones((10_000, 6))}),
        ("sensor noise", "warn", {"wrench": np.random.default_rng(0).normal(0.0, 0.4, (10_000, 6))}),
        ("sensor noise", "fail", {"wrench": np.random.default_rng(0).normal(0.0, 0.6, (10_000, 6))}),
        ("sensor drift", "warn", {"wrench": np.linspace(0.0, 0.4, 10_000)[:, None] * np.ones(6)}),
        ("sensor drift", "fail", {"wrench": np.linspace(0.0, -1.4, 10_000)[:, None] * np.ones(6)}),
    ],
)
def test_what_the_sensor_shows_is_judged(tmp_path: Path, name: str, verdict: str, changes: dict[str, Any]) -> None:
    finding = named(of_sensor(tmp_path, **changes), name)
    assert finding.verdict == verdict
    assert finding.advice


def test_drift_is_measured_over_the_whole_watch(tmp_path: Path) -> None:
    wrench = np.linspace(0.0, 0.4, 10_000)[:, None] * np.array([1.0, 0.0, -0.5, 0.0, 0.0, 0.0])
    assert named(of_sensor(tmp_path, wrench=wrench), "sensor drift").figures["drift_N"] == pytest.approx([0.4, 0.0, -0.2], abs=1e-4)


def test_a_loaded_probe_and_another_sensor_differ_from_the_tare(tmp_path: Path) -> None:
    State(tmp_path).keep("calibration", Calibration((1.0, -2.0, 34.0, 0.0, 0.0, 0.0), "today", "PRE00042"))
    assert named(of_probe(tmp_path), "probe free").verdict == "fail"
    State(tmp_path).keep("calibration", Calibration(tuple(FREE), "today", "PRE00007"))
    assert "PRE00007" in named(of_probe(tmp_path), "probe free").measured


@pytest.mark.parametrize("changes", [{"last": None}, {"status": 1}, {"wrench": np.tile(FREE, (10_000, 1))}, {"n": 3}])
def test_data_that_cannot_be_used_never_show_a_free_probe(tmp_path: Path, changes: dict[str, Any]) -> None:
    State(tmp_path).keep("calibration", Calibration(tuple(FREE), "today", "PRE00042"))
    finding = named(of_probe(tmp_path, **changes), "probe free")
    assert finding.verdict == "fail"
    assert "nothing may move" in finding.advice


def late(by_s: float) -> np.ndarray[Any, Any]:
    at_s = np.arange(1250) * 0.008
    at_s[600:] += by_s
    return at_s


@pytest.mark.parametrize(
    ("name", "verdict", "changes"),
    [
        ("RTDE jitter", "fail", {"state_s": late(0.06)}),
        ("RTDE jitter", "warn", {"timestamp_s": late(0.008)}),
        ("RTDE jitter", "fail", {"state_s": np.empty(0), "timestamp_s": np.empty(0), "last": None}),
        ("robot ready", "warn", {"last": robot(robot_mode=RobotMode.IDLE)}),
        ("robot ready", "warn", {"last": robot(safety_mode=SafetyMode.PROTECTIVE_STOP)}),
        ("robot ready", "warn", {"last": robot(safety_mode=99)}),
        ("tool upright", "warn", {"last": robot(tcp_pose=(0.0, 0.0, 0.1, 3.0, 0.0, 0.0))}),
    ],
)
def test_what_the_robot_shows_is_judged(tmp_path: Path, name: str, verdict: str, changes: dict[str, Any]) -> None:
    finding = named(of_robot(tmp_path, **changes), name)
    assert finding.verdict == verdict
    assert finding.advice


@pytest.mark.parametrize(
    ("hung_N", "verdict"),
    [
        ((0.0, 0.0, 10.0), "ok"),
        ((0.0, 0.0, 10.8), "warn"),  # the other sensitivity of Fz
        ((0.0, 0.0, 13.0), "fail"),
        ((0.0, 0.0, -10.0), "fail"),  # the sign
        ((1.5, 0.0, 10.0), "warn"),
        ((0.0, 0.0, 0.5), "fail"),
    ],
)
def test_a_known_weight_tells_sign_and_scale(monkeypatch: pytest.MonkeyPatch, hung_N: tuple[float, ...], verdict: str) -> None:
    monkeypatch.setattr(weight, "SETTLED_S", 0.1)
    sensor = ScriptedSensor()

    def ask(what: str) -> None:
        if what.startswith("Hang"):
            sensor.wrench[:3] += hung_N  # raw Fz > 0: pulled, z points out of the sensor

    finding = weight.check_weight(sensor, None, SensorConfig(), 10.0, ask)
    assert finding.verdict == verdict, finding


@pytest.mark.parametrize(
    ("setting", "hung_N", "verdict", "part_at"),
    [
        ("pressed", 10.0, "ok", "reading"),
        ("pressed", 10.84, "warn", "load"),
        ("both", 10.84, "ok", "load"),
        ("both", 10.0, "warn", "reading"),
        ("both", 12.3, "fail", "load"),
    ],
)
def test_a_hung_weight_says_where_the_slopes_of_fz_part(
    monkeypatch: pytest.MonkeyPatch, setting: Literal["pressed", "both"], hung_N: float, verdict: str, part_at: str
) -> None:
    monkeypatch.setattr(weight, "SETTLED_S", 0.1)
    sensor = ScriptedSensor()

    def ask(what: str) -> None:
        if what.startswith("Hang"):
            sensor.wrench[2] += hung_N

    finding = weight.check_weight(sensor, None, SensorConfig(fz_slopes=setting), 10.0, ask, 1656 / 1528)
    assert (finding.verdict, finding.figures["slopes_part_at"]) == (verdict, part_at), finding
    assert ("fz_slopes" in finding.advice) == (verdict == "warn")


def test_a_weight_that_rests_on_an_upturned_sensor_is_the_same_weight(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(weight, "SETTLED_S", 0.1)
    sensor = ScriptedSensor()

    def ask(what: str) -> None:
        if what.startswith("Hang"):
            sensor.wrench[2] -= 10.0

    assert weight.check_weight(sensor, robot(tcp_pose=(0.0,) * 6), SensorConfig(), 10.0, ask).verdict == "ok"


def test_no_frame_at_all_is_a_failed_weight(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(weight, "SETTLED_S", 0.05)
    sensor = ScriptedSensor()
    monkeypatch.setattr(sensor, "read", lambda: NO_FRAMES)
    assert weight.check_weight(sensor, None, SensorConfig(), 10.0, lambda _: None).verdict == "fail"


def test_the_stored_state_is_judged(tmp_path: Path) -> None:
    assert named(stored.examine_stored(config(tmp_path)), "reference tare").verdict == "warn"
    State(tmp_path).keep("latch", Latch("9 N across", "yesterday"))
    assert "9 N across" in named(stored.examine_stored(config(tmp_path)), "latch").measured
    State(tmp_path).folder.joinpath("contact.json").write_text("{half")
    assert "contact.json" in named(stored.examine_stored(config(tmp_path)), "contact").measured
    absent = config(tmp_path, model={"path": str(tmp_path / "none.onnx")})
    assert named(stored.examine_stored(absent), "inertial model").verdict == "fail"


def test_a_folder_that_takes_no_file_fails() -> None:
    assert machine.disk(Path("/proc")).verdict == "fail"


def test_a_kernel_that_gives_real_time_nothing_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "text_of", lambda path: "0")
    assert machine.limits().verdict == "fail"


def test_a_serial_port_that_bursts_is_reported_with_the_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    device = tmp_path / "ttyUSB0"
    device.touch()
    monkeypatch.setattr(machine, "text_of", lambda path: "16" if path.endswith("latency_timer") else None)
    assert "echo 1" in named(machine.port(str(device)), "serial latency").advice


@pytest.mark.parametrize(
    ("host", "port"), [("127.0.9.78", "none"), ("x" * 200, "n" * 300)], ids=["nothing there", "names that are too long to be any"]
)
def test_absent_devices_are_a_warning_and_no_failure(tmp_path: Path, host: str, port: str) -> None:
    lonely = config(tmp_path, robot={"host": host}, sensor={"port": str(tmp_path / port)}, paths={"runs": tmp_path / ("r" * 300)})
    findings = doctor.examined(lonely, pytest.fail, pytest.fail, 1.0, None, pytest.fail)
    for name in ("sensor", "robot"):
        assert named(findings, name).verdict == "warn"
        assert "absent" in named(findings, name).measured
    assert json.loads(json.dumps(doctor.as_json(findings)))["findings"]


def test_a_device_that_is_there_and_does_not_open_fails(tmp_path: Path) -> None:
    port = tmp_path / "port"
    port.touch()

    def busy(_: Config) -> Any:
        raise SensorError("sensor port is in use by another program")

    findings = doctor.examined(
        config(tmp_path, sensor={"port": str(port)}, robot={"host": "127.0.9.78"}), busy, pytest.fail, 1.0, None, print
    )
    assert named(findings, "sensor").verdict == "fail"
    assert doctor.as_json(findings)["verdict"] == "fail"


@pytest.fixture(scope="module")
def emulated(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Emulated]:
    skip_without_ur_rtde()
    with started(tmp_path_factory.mktemp("doctor"), "ur5", ROOT / "palpd" / "cell" / "phantom.yaml", HOST) as cell:
        yield cell


@pytest.mark.hil
def test_emulated_devices_are_observed_and_their_weight_is_judged(emulated: Emulated, tmp_path: Path) -> None:
    from palpd.daemon.wiring import open_reader, open_sensor

    def press(what: str) -> None:
        if what.startswith("Hang"):  # there is nothing to hang it on: press from below instead, which must be noticed
            emulated.ask("wall", z_m=emulated.ask("truth")["tip_z_m"] + 0.002, stiffness_N_per_m=5000.0)

    there = config(tmp_path, robot={"host": emulated.host}, sensor={"port": emulated.sensor})
    findings = doctor.examined(there, open_sensor, open_reader, 2.0, 10.0, press)
    assert named(findings, "sensor frames").figures["rate_Hz"] == pytest.approx(1000, rel=0.1)
    assert 0.0 < max(named(findings, "sensor noise").figures["noise_N"]) < 0.3
    assert named(findings, "RTDE jitter").figures["jitter_us_p50"] < 4000
    assert named(findings, "robot ready").verdict == "ok"
    assert named(findings, "tool upright").verdict == "ok"
    weight = named(findings, "known weight")
    assert weight.figures["ratio"] == pytest.approx(-1.0, abs=0.1)
    assert weight.verdict == "fail"
    assert "sign" in weight.advice
