"""Controller, cell and sensor together, millisecond by millisecond, told the time."""

import os
import socket
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import serial

from hw.emulators.controller_state import MODELS, Runtime
from hw.emulators.hex_pty import UNZEROED
from hw.emulators.rig import Rig
from hw.emulators.verbs import VERBS, obey
from palpd.cell.cell_file import cell_from

SCRIPT = "def rtde_control():\n# float register offset\n0 # int register offset\n0\nend\n"
QUIET = {"noise_rms_N": 1e-9, "noise_rms_Nm": 0.0}


class Bench:
    """A rig with a clock that the test sets, and a program that takes speeds."""

    def __init__(self, link: Path, model: str = "ur5", mount_rotation_rad: float = 0.0, **cell: Any) -> None:
        file = cell_from({"sensor": QUIET, **cell}, "test")
        self.host = f"127.1.{os.getpid() % 250 + 2}.{MODELS[model].version[0]}"
        self.rig = Rig(MODELS[model], file, self.host, link, mount_rotation_rad=mount_rotation_rad)
        self.t_s = 100.0
        self.begin_program()

    def begin_program(self) -> None:
        self.rig.controller.upload(SCRIPT, self.t_s)
        self.run(0.3)
        assert self.rig.controller.state.runtime is Runtime.PLAYING

    def run(self, duration_s: float) -> None:
        for _ in range(round(duration_s * 1000)):
            self.t_s += 0.001
            self.rig.tick(self.t_s, self.t_s)

    def speed(self, vz: float) -> None:
        values = {f"input_double_register_{i}": (value,) for i, value in enumerate((0.0, 0.0, vz, 0.0, 0.0, 0.0, 0.5, 0.0))}
        self.rig.controller.write({"input_int_register_0": (10,), **values}, self.t_s)

    def go(self, z_m: float, speed_m_per_s: float = 0.02) -> None:
        """To that height and to rest."""
        way_m = z_m - float(self.rig.controller.state.pose[2])
        self.speed(np.copysign(speed_m_per_s, way_m))
        self.run(abs(way_m) / speed_m_per_s)
        self.speed(0.0)
        self.run(0.5)

    @property
    def counts(self) -> np.ndarray:
        """What the sensor measures, less its un-zeroed offset."""
        return self.rig.daq.latest - UNZEROED


@pytest.fixture
def link(tmp_path: Path) -> Path:
    return tmp_path / "hex"


@pytest.fixture(autouse=True)
def rigs(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Rigs are closed after each test."""
    rigs: list[Rig] = []
    make = Rig.__init__

    def remembered(self: Rig, *args: Any, **options: Any) -> None:
        make(self, *args, **options)
        rigs.append(self)

    monkeypatch.setattr(Rig, "__init__", remembered)
    yield
    for rig in rigs:
        rig.close()


@pytest.mark.parametrize("model", ["ur5", "ur5e"])
def test_a_hanging_probe_pulls_and_a_pressed_one_pushes(link: Path, model: str) -> None:
    bench = Bench(link, model)
    assert bench.counts[2] == pytest.approx(0.2 * 9.81 * 7.64, abs=1e-3)
    free = bench.counts
    bench.go(-0.008)
    tip_m, contact_N = bench.rig.tip
    assert tip_m == pytest.approx(-0.008, abs=2e-4)
    assert contact_N == pytest.approx(4 / 3 * 72000 / 0.75 * 0.005**0.5 * (-tip_m) ** 1.5, rel=1e-6)
    assert bench.counts - free == pytest.approx([0, 0, -contact_N * 7.64, 0, 0, 0], abs=0.02)


def test_the_start_is_30_mm_above_the_true_surface_of_the_first_site(link: Path) -> None:
    sites = [{"name": "A", "x_m": 0.1, "y_m": -0.2, "tissue": {"surface_z_m": 0.05}, "effects": {"tissue.surface": {"offset_m": 0.001}}}]
    rig = Bench(link, sites=sites).rig
    assert rig.controller.state.pose == pytest.approx([0.1, -0.2, 0.081, np.pi, 0.0, 0.0])


@pytest.mark.parametrize(("mount_rad", "expected"), [(0.0, (1, 0)), (np.pi / 2, (0, -1)), (np.pi, (-1, 0))])
def test_a_lateral_force_points_along_the_sensors_axes_as_it_is_mounted(link: Path, mount_rad: float, expected: tuple[int, int]) -> None:
    bench = Bench(link, mount_rotation_rad=mount_rad, effects={"contact.lateral": {"ratio": 0.2, "azimuth_rad": 0.0}})
    free = bench.counts
    bench.go(-0.008)
    lateral_N = 0.2 * bench.rig.tip[1]
    fx, fy, _, tx, ty, tz = (bench.counts - free) / (41.32, 41.11, 7.64, 1125.9, 1082.0, 9316 / 6.5)
    assert (fx, fy) == pytest.approx((expected[0] * lateral_N, expected[1] * lateral_N), abs=2e-3)
    # base torque of a force along base x at the tip is about base y, ty = -fx L; the tool's y is the base's -y
    assert (tx, ty) == pytest.approx((-expected[1] * lateral_N * 0.08, expected[0] * lateral_N * 0.08), abs=1e-4)
    assert tz == pytest.approx(0.0, abs=1e-9)


def test_a_force_along_base_y_is_against_the_sensors_y(link: Path) -> None:
    bench = Bench(link, effects={"contact.lateral": {"ratio": 0.2, "azimuth_rad": np.pi / 2}})
    free = bench.counts
    bench.go(-0.008)
    assert (bench.counts - free)[1] / 41.11 == pytest.approx(-0.2 * bench.rig.tip[1], abs=2e-3)


def test_a_bias_after_the_tare_comes_with_the_first_motion_and_goes_with_a_new_program(link: Path) -> None:
    bench = Bench(link, effects={"sensor.bias": {"offset_N": 0.5}})
    tare = bench.counts[2]
    bench.run(0.5)
    assert bench.counts[2] == pytest.approx(tare, abs=1e-3)
    bench.go(0.035)
    assert bench.counts[2] - tare == pytest.approx(-0.5 * 7.64, abs=0.02)
    bench.rig.controller.write({"input_int_register_0": (0,)}, bench.t_s)
    bench.begin_program()
    assert bench.counts[2] == pytest.approx(tare, abs=1e-3)


@pytest.mark.parametrize(("code", "cutoff_Hz"), [(2, 150.0), (4, 15.0), (5, 5.0)])
def test_the_filter_that_is_configured_is_the_one_that_acts(link: Path, code: int, cutoff_Hz: float) -> None:
    bench = Bench(link, "ur5e")
    body = bytes((0xAA, 0, 50, 3, 1, code, 0))
    bench.rig.daq.take(body + struct.pack(">H", sum(body)))
    bench.run(0.5)
    before = bench.counts[2]
    bench.rig.place_wall(0.031, 10_000.0)  # 10 N at once
    reached = []
    for _ in range(400):
        bench.run(0.001)
        reached.append((before - bench.counts[2]) / 76.4)
    contact = next(k for k, share in enumerate(reached) if share > 0.0)
    rise_s = 0.001 * sum(share < 1 - np.exp(-1) for share in reached[contact:])
    assert rise_s == pytest.approx(1 / (2 * np.pi * cutoff_Hz), abs=0.0015)


def test_rates_below_the_cycle_are_counted_in_samples_not_in_cycles(link: Path) -> None:
    bench = Bench(link)
    with serial.Serial(bench.rig.line.path, 1_000_000, timeout=0.5) as port:
        bench.run(0.001)
        body = bytes((0xAA, 0, 50, 3, 2, 2, 0))
        bench.rig.daq.take(body + struct.pack(">H", sum(body)))
        bench.run(0.1)
        data = port.read(8192)
    at = data.index(b"\xaa\x07\x08\x10", data.index(b"\xaa\x00\x50\x01"))
    counters = [struct.unpack(">H", data[k + 4 : k + 6])[0] for k in range(at, len(data), 22)]
    assert set(np.diff(counters)) == {2}
    assert len(counters) in (50, 51)


@pytest.mark.parametrize("model", ["ur5", "ur5e"])
def test_the_tip_follows_the_target_with_the_servos_lag(link: Path, model: str) -> None:
    bench = Bench(link, model)
    bench.speed(-0.01)
    bench.run(0.6)
    lag_m = bench.rig.tip[0] - float(bench.rig.controller.state.pose[2])
    assert lag_m == pytest.approx(0.01 * 2 / (2 * np.pi * 8.0), rel=0.01)


def test_the_log_tells_when_the_target_came_to_rest(link: Path) -> None:
    bench = Bench(link)
    bench.speed(0.01)
    bench.run(0.2)
    stopped_s = bench.t_s
    bench.rig.controller.state.stop_program(stopped_s, "test")
    bench.run(0.1)
    moving = [sample.t_s for sample in bench.rig.samples if sample.speed_m_per_s > 0.0]
    assert 0.0 <= moving[-1] - stopped_s <= 2 * 0.008
    assert bench.rig.samples[-1].runtime == Runtime.STOPPED


def test_a_client_that_does_not_read_is_disconnected_after_ten_seconds(link: Path) -> None:
    bench = Bench(link)
    with socket.socket() as lazy:
        lazy.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        lazy.connect((bench.host, 30004))
        names = b"actual_q,target_q,actual_qd,target_qd,actual_TCP_pose,target_TCP_pose,actual_TCP_speed,target_TCP_speed"
        lazy.sendall(struct.pack(">HBd", 11 + len(names), ord("O"), 125.0) + names + struct.pack(">HB", 3, ord("S")))
        bench.run(9.0)
        assert len(bench.rig.wires.rtde.wires) == 1
        for _ in range(20):  # how long the buffers between last is the kernel's
            bench.run(1.0)
            if not bench.rig.wires.rtde.wires:
                return
        pytest.fail("the client is still connected")


def test_a_late_rig_skips_packages_and_still_sends_one_a_cycle(link: Path) -> None:
    bench = Bench(link)
    with socket.create_connection((bench.host, 30004), timeout=1.0) as client:
        client.sendall(struct.pack(">HBd", 20, ord("O"), 125.0) + b"timestamp" + struct.pack(">HB", 3, ord("S")))
        bench.run(0.02)
        client.recv(4096)
        for k in range(800):  # 0.8 s are rigs up in 0.2 s
            bench.t_s += 0.001
            bench.rig.tick(bench.t_s, 200.0 + 0.2 * k / 800, late=True)
        assert len(client.recv(65536)) / 12 == pytest.approx(0.2 / 0.008, abs=2)


def test_every_verb_stands_in_the_document() -> None:
    document = (Path(__file__).parents[2] / "docs" / "emulators.md").read_text(encoding="utf-8")
    assert [verb for verb in (*VERBS, "stats") if f"`{verb}`" not in document] == []


@pytest.mark.parametrize(
    ("request_", "seen"),
    [
        ({"do": "silent", "s": 1.0}, lambda rig: rig.daq.faults.silent_until_s > 100.0),
        ({"do": "slow", "every": 4, "s": 1.0}, lambda rig: rig.daq.faults.slow_every == 4),
        ({"do": "stuck", "s": 1.0}, lambda rig: rig.daq.faults.stuck_until_s > 100.0),
        ({"do": "garbage", "bytes": 9}, lambda rig: len(rig.daq.faults.garbage) == 9),
        ({"do": "lose", "bytes": 9}, lambda rig: rig.daq.faults.lose_bytes == 9),
        ({"do": "flip"}, lambda rig: rig.daq.faults.flips == 1),
        ({"do": "swap", "frames": 3}, lambda rig: rig.daq.faults.swaps == 3),
        ({"do": "false_header"}, lambda rig: rig.daq.faults.false_headers == 1),
        ({"do": "status", "word": 0x400, "s": 1.0}, lambda rig: rig.daq.faults.status == 0x400),
        ({"do": "overload", "s": 1.0}, lambda rig: rig.daq.faults.status == 1 << 7),
        ({"do": "drift", "N_per_s": 1.0}, lambda rig: rig.daq.faults.drift_N_per_s == 1.0),
        ({"do": "unplug"}, lambda rig: rig.line._master is None),
        ({"do": "refuse_version"}, lambda rig: rig.wires.refuse_version),
        ({"do": "emergency_stop"}, lambda rig: rig.controller.state.safety == 7),
        ({"do": "protective_stop"}, lambda rig: rig.controller.state.safety == 3),
        ({"do": "emergency_stop", "system": True}, lambda rig: rig.controller.state.safety == 6),
        ({"do": "safeguard_stop"}, lambda rig: rig.controller.state.safety == 5),
        ({"do": "safety_fault"}, lambda rig: rig.controller.state.safety == 9),
        ({"do": "pendant", "press": "power off"}, lambda rig: rig.controller.state.power == 3),
        ({"do": "power_off"}, lambda rig: rig.controller.state.power == 3),
        ({"do": "program_stop"}, lambda rig: rig.controller.state.program is None),
        (
            {"do": "other_program", "s": 5.0},
            lambda rig: rig.controller.state.program is not None and not rig.controller.state.program.commands,
        ),
        ({"do": "local_control"}, lambda rig: not rig.controller.state.remote_control),
        ({"do": "wall", "z_m": 0.01, "stiffness_N_per_m": 1e3}, lambda rig: rig.surface_m(0.0, 0.0) == 0.01),
    ],
)
def test_a_verb_makes_its_fault(link: Path, request_: dict[str, Any], seen: Callable[[Rig], bool]) -> None:
    rig = Bench(link).rig
    assert not seen(rig)
    assert obey(rig, request_, 100.5, [0.0]) == {"ok": True, "t_s": 100.5}
    assert seen(rig)


def test_a_fault_on_arming_comes_when_the_program_has_set_its_watchdog_and_once(link: Path) -> None:
    bench = Bench(link)
    rig, set_watchdog = bench.rig, {"input_int_register_0": (35,), "input_double_register_0": (10.0,)}
    obey(rig, {"do": "on_arming", "then": {"do": "local_control"}, "delay_s": 0.05}, bench.t_s, [0.0])
    bench.run(0.1)
    assert rig.controller.state.remote_control
    rig.controller.write(set_watchdog, bench.t_s)
    bench.run(0.03)
    assert rig.controller.state.remote_control
    bench.run(0.06)
    assert not rig.controller.state.remote_control
    rig.controller.state.remote_control = True
    bench.run(0.2)
    assert rig.controller.state.remote_control
    with pytest.raises(ValueError, match="there is no verb 'nonsense'"):
        obey(rig, {"do": "on_arming", "then": {"do": "nonsense"}}, bench.t_s, [0.0])


def test_a_deaf_controller_still_sends_its_states_and_trips_the_watchdog(link: Path) -> None:
    bench = Bench(link)
    rig = bench.rig
    rig.controller.write({"input_int_register_0": (35,), "input_double_register_0": (10.0,)}, bench.t_s)
    bench.run(0.02)
    with socket.create_connection((bench.host, 30004)) as client:
        client.sendall(struct.pack(">HcH", 5, b"V", 2))
        obey(rig, {"do": "deaf", "s": 0.3}, bench.t_s, [0.0])
        bench.run(0.25)
        client.setblocking(False)
        with pytest.raises(BlockingIOError):
            client.recv(100)
        assert rig.controller.state.stops[-1][1] == "watchdog"
        bench.run(0.1)
        assert client.recv(100) == struct.pack(">HcB", 4, b"V", 1)


def test_another_clients_program_plays_for_its_time_and_answers_no_command(link: Path) -> None:
    bench = Bench(link)
    rig = bench.rig
    obey(rig, {"do": "other_program", "s": 1.0}, bench.t_s, [0.0])
    bench.run(0.5)
    before = dict(rig.controller.state.outputs)
    rig.controller.write({"input_int_register_0": (35,)}, bench.t_s)
    bench.run(0.3)
    assert rig.controller.state.runtime is Runtime.PLAYING
    assert rig.controller.state.outputs == before
    bench.run(0.5)
    assert rig.controller.state.runtime is Runtime.STOPPED


def test_in_local_control_scripts_and_the_dashboards_commands_are_ignored(link: Path) -> None:
    bench = Bench(link, "ur5e")
    rig = bench.rig
    obey(rig, {"do": "local_control"}, bench.t_s, [0.0])
    rig.controller.upload("def other():\n  sleep(1)\nend\n", bench.t_s)
    bench.run(0.3)
    assert rig.controller.state.program is not None
    assert rig.controller.state.program.commands
    with socket.create_connection((bench.host, 29999)) as client:
        client.sendall(b"is in remote control\nstop\n")
        bench.run(0.05)
        _, remote, stop = client.recv(1000).decode().splitlines()
    assert remote == "false"
    assert stop.startswith("Command is not allowed")
    assert rig.controller.state.runtime is Runtime.PLAYING


def test_the_counter_leaps_when_told_and_goes_on_where_the_process_did_not(link: Path) -> None:
    rig = Bench(link).rig
    before = rig.daq.counter
    obey(rig, {"do": "counter_jump", "by": 1000}, 100.5, [0.0])
    rig.skip(250)
    assert (rig.daq.counter - before) % 65536 == 1250


def test_a_process_that_stood_still_right_after_it_had_read_counts_that_time_as_none_of_the_watchdogs(link: Path) -> None:
    bench = Bench(link)
    rig = bench.rig
    rig.controller.write({"input_int_register_0": (35,), "input_double_register_0": (10.0,)}, bench.t_s)
    bench.run(0.02)
    rig.skip(500)
    bench.t_s += 0.5
    bench.run(0.05)
    assert rig.controller.state.runtime is Runtime.PLAYING
    bench.run(0.1)
    assert rig.controller.state.stops[-1][1] == "watchdog"
