"""The UR driver: refusals against a small controller of our own, motion against the emulated one.

Everything that constructs an ur_rtde object runs in a process of its own: the constructors hold the GIL, and a dropped
connection may crash the process.
"""

import contextlib
import json
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from hw.muted import MutedRobot
from hw.rtde import STOP_TIMEOUT_S, VARIABLES, UrReader, UrRobot
from palpd.errors import RobotError
from palpd.testing.emulated_cell import EmulatedCell, emulated_cell
from palpd.testing.fixtures import skip_without_ur_rtde
from palpd.tick import RobotState
from tests.paths import ROOT

WATCHDOG_HZ = 10
REST_WITHIN_S = 0.110
"""After the last speed command: the watchdog's 100 ms, a cycle and the ramp."""
STOPS_WITHIN_S = STOP_TIMEOUT_S + 0.25
"""The rest is the machine's; a call that hangs does so for seconds."""
ATTEMPTS = 20
"""The library crashed 22 of 50 clients whose connection was dropped, up to seven in a row."""
CRASHES = (-signal.SIGSEGV, -signal.SIGABRT)
_hosts = (f"127.0.{90 + os.getpid() % 100}.{n}" for n in count(1))


class LibraryCrashed(Exception):
    """ur_rtde took its process down with it."""


class FarController:
    """Speaks RTDE on port 30004 as far as `silent_after` lets it."""

    def __init__(self, major: int = 3, missing: str = "", version_ok: bool = True, silent_after: bytes = b"") -> None:
        self.host = next(_hosts)
        self._major, self._missing, self._version_ok, self._silent_after = major, missing, version_ok, silent_after
        self._server = socket.create_server((self.host, 30004))
        threading.Thread(target=self._serve, daemon=True).start()

    def close(self) -> None:
        self._server.close()

    def _serve(self) -> None:
        while True:
            try:
                connection, _ = self._server.accept()
            except OSError:
                return
            with connection, connection.makefile("rb") as stream:
                self._talk(connection, stream)

    def _talk(self, connection: socket.socket, stream: Any) -> None:
        silent = False
        while len(head := stream.read(3)) == 3:
            size, kind = struct.unpack(">Hc", head)
            body = stream.read(size - 3)
            if silent:
                continue
            connection.sendall(struct.pack(">Hc", 8, b"M") + b"\x02hi\x00\x03"[:5])  # a text message may come at any time
            match kind:
                case b"V":
                    reply = bytes([self._version_ok])
                case b"v":
                    reply = struct.pack(">4I", self._major, 15, 8, 0)
                case b"O":
                    names = body[8:].decode().split(",")
                    reply = b"\x01" + ",".join("NOT_FOUND" if name == self._missing else "DOUBLE" for name in names).encode()
                case _:
                    reply = b"\x01"
            connection.sendall(struct.pack(">Hc", 3 + len(reply), kind) + reply)
            silent = kind == self._silent_after


@pytest.fixture
def controller() -> Iterator[Callable[..., FarController]]:
    controllers: list[FarController] = []

    def make(**kinds: Any) -> FarController:
        controllers.append(FarController(**kinds))
        return controllers[-1]

    yield make
    for one in controllers:
        one.close()


# refusals


@pytest.mark.parametrize(("model", "rate_Hz"), [("ur5", 126.0), ("ur5e", 501.0), ("ur5", 0.0)])
def test_a_rate_that_the_model_does_not_have_is_refused(model: Any, rate_Hz: float) -> None:
    with pytest.raises(RobotError, match=f"rate of {rate_Hz:g} Hz is not possible on a {model}"):
        UrReader("127.0.0.1", model=model, rate_Hz=rate_Hz)


def test_a_watchdog_faster_than_the_commands_is_refused() -> None:
    with pytest.raises(RobotError, match="watchdog of 130 Hz would trip between two commands at 125 Hz"):
        UrRobot("127.0.0.1", model="ur5", rate_Hz=125, watchdog_Hz=130, acceleration_m_per_s2=0.5)


def test_a_robot_that_is_not_there_is_refused_at_once() -> None:
    skip_without_ur_rtde()
    began_s = time.monotonic()
    with pytest.raises(RobotError, match=r"cannot be reached .* on port 30004 within 2 s; check robot\.host"):
        UrReader(next(_hosts), model="ur5", rate_Hz=125)
    assert time.monotonic() - began_s < 1


@pytest.mark.parametrize("silent_after", [b"V", b"O", b"S"])
def test_a_controller_that_falls_silent_is_refused_in_bounded_time(
    controller: Callable[..., FarController], silent_after: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    skip_without_ur_rtde()
    monkeypatch.setattr("hw.rtde.CONNECT_TIMEOUT_S", 0.2)
    began_s = time.monotonic()
    with pytest.raises(RobotError, match=r"does not answer on port 30004 within 0\.2 s after the connection was made"):
        UrReader(controller(silent_after=silent_after).host, model="ur5", rate_Hz=125)
    assert time.monotonic() - began_s < 2


@pytest.mark.parametrize(
    ("kinds", "sentence"),
    [
        ({"major": 5}, r"runs software 5\.15\.8, but robot\.model is ur5, which has 3\.x; correct robot\.model"),
        ({"missing": "safety_status_bits"}, "has no safety_status_bits; 3.10 or newer is needed"),
        ({"version_ok": False}, "does not speak RTDE version 2"),
    ],
)
def test_a_controller_of_another_kind_is_refused(controller: Callable[..., FarController], kinds: dict[str, Any], sentence: str) -> None:
    skip_without_ur_rtde()
    with pytest.raises(RobotError, match=sentence):
        UrReader(controller(**kinds).host, model="ur5", rate_Hz=125)


def test_a_robot_without_its_script_port_is_refused(controller: Callable[..., FarController]) -> None:
    with pytest.raises(RobotError, match="on port 30003"):
        UrRobot(controller().host, model="ur5", rate_Hz=125, watchdog_Hz=50, acceleration_m_per_s2=0.5)


# dry run


def test_a_muted_robot_shows_the_state_and_commands_nothing() -> None:
    state = RobotState(1.0, 2.0, (0.0,) * 6, (0.0,) * 6, (0.0,) * 6, (0.0,) * 6, (0.0,) * 3, 7, 1, 1, 2, True)

    class Reader:
        def read(self) -> RobotState:
            return state

        def move(self, velocity_m_per_s: tuple[float, float, float]) -> None:
            raise AssertionError(velocity_m_per_s)

        stop = move

    reader = Reader()
    robot = MutedRobot(reader)
    assert robot.read() is state
    robot.move((0.1, 0.1, 0.1))
    robot.stop()
    robot.end()


# against the emulated controller


class Client:
    """Runs a body of Python against an emulated controller, in a process of its own that has `connect`, `go`, `say` and a dict `out`."""

    def __init__(self, cell: EmulatedCell) -> None:
        self.cell = cell

    def start(self, body: str) -> subprocess.Popen[str]:
        """The process; what it puts into `out` is its last line."""
        rate_Hz = 125 if self.cell.model == "ur5" else 500
        head = f"""
import json, os, sys, time
from hw.rtde import UrReader, UrRobot
from palpd.errors import RobotError
from palpd.daemon.realtime import DEVICE_PRIORITY, LOOP_PRIORITY, fifo
fifo(DEVICE_PRIORITY)  # as the motion process has it while it opens and closes
host, model, rate_Hz = {self.cell.wires.host!r}, {self.cell.model!r}, {rate_Hz}
out = {{}}
def connect(**more):
    return UrRobot(host, model=model, rate_Hz=rate_Hz, watchdog_Hz={WATCHDOG_HZ}, acceleration_m_per_s2=0.5, **more)
def go(robot, vz, seconds):
    for _ in range(int(seconds * rate_Hz)):
        robot.read(); robot.move((0.0, 0.0, vz)); time.sleep(1 / rate_Hz)
def say(word):
    print(word, flush=True); sys.stdin.readline()
def refusal_of(act):
    try:
        act(); return ""
    except RobotError as error:
        return str(error)
"""
        tail = "\nprint(json.dumps(out), flush=True)\nos._exit(0)\n"
        script = head + textwrap.dedent(body) + tail
        return subprocess.Popen(
            [sys.executable, "-c", script], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )

    def run(self, body: str, meanwhile: dict[str, Callable[[], object]] | None = None) -> dict[str, Any]:
        """`out` of the body. LibraryCrashed where the library took the process down with it."""
        process = self.start(body)
        assert process.stdout is not None
        assert process.stdin is not None
        assert process.stderr is not None
        while True:
            ready, _, _ = select.select([process.stdout], [], [], 30)
            assert ready, "the client hangs"
            line = process.stdout.readline()
            if not line:
                stderr = process.stderr.read()
                if process.wait(10) in CRASHES:
                    raise LibraryCrashed(stderr)
                raise AssertionError(stderr)
            if meanwhile and line.strip() in meanwhile:
                meanwhile[line.strip()]()
                with contextlib.suppress(BrokenPipeError):  # it has crashed: the next line says so
                    process.stdin.write("\n")
                    process.stdin.flush()
            elif line.startswith("{"):  # the library prints now and then
                answer: dict[str, Any] = json.loads(line)
                assert process.wait(10) == 0
                return answer

    def run_through(self, fault: str, body: str, **arguments: Any) -> dict[str, Any]:
        """`out` of the first client that lives through a fault, done when it says "moving".

        After a lost connection the library's own thread crashes the process now and then. Whether the client lived or not, the
        controller's watchdog must have brought the arm to rest; what an emulator that was late itself adds is the machine's.
        """
        done_s: list[float] = []
        for _ in range(ATTEMPTS):
            report = None
            with contextlib.suppress(LibraryCrashed):
                report = self.run(body, {"moving": lambda: done_s.append(self.cell.wires.ask(fault, **arguments)["t_s"])})
            rest_s = self.cell.rest_after_s(done_s[-1])
            assert rest_s <= REST_WITHIN_S + self.cell.lateness_s(done_s.pop() - 0.1, 0.7)
            if report is not None:
                return report
        raise AssertionError(f"the library crashed {ATTEMPTS} of {ATTEMPTS} clients after {fault!r}: our own behaviour was never seen")


@pytest.fixture(scope="module", params=["ur5", "ur5e"])
def client(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    skip_without_ur_rtde()
    with emulated_cell(tmp_path_factory.mktemp(request.param), request.param) as cell:
        yield Client(cell)


@pytest.mark.hil
def test_a_command_that_waits_leaves_a_single_processor_to_the_thread_that_hears_the_answer(client: Client) -> None:
    report = client.run("""
        os.sched_setaffinity(0, {os.sched_getaffinity(0).pop()})
        robot = connect()
        out["urgent"] = fifo(LOOP_PRIORITY)
        began = time.monotonic(); robot.move((0.0, 0.0, 0.01)); out["moves_s"] = time.monotonic() - began
        go(robot, 0.01, 0.2)
        began = time.monotonic(); robot.stop(); robot.stop(); robot.stop(); out["stops_s"] = time.monotonic() - began
        out["connected"] = robot.read().connected
        """)
    assert report["connected"]
    assert report["moves_s"] < 1.0  # at the loop's priority the library waits for 4 s, and then in vain
    assert report["stops_s"] < 1.0
    if not report["urgent"]:
        pytest.skip("SCHED_FIFO is not permitted here: nothing keeps another thread from the processor")


@pytest.mark.hil
def test_a_robot_is_read_moved_and_stopped(client: Client) -> None:
    report = client.run("""
        robot = connect()
        before = robot.read()
        robot.arm()
        go(robot, 0.01, 0.4)
        moving = robot.read()
        began = time.monotonic(); robot.stop(); out["stop_s"] = time.monotonic() - began
        for _ in range(int(0.4 * rate_Hz)):
            robot.stop(); time.sleep(1 / rate_Hz)
        after = robot.read()
        out.update(age=time.monotonic() - after.t_s, rose=after.z_m - before.z_m, vz=moving.target_speed[2],
            rest=after.target_speed[2], runtime=after.runtime_state, connected=after.connected,
            mode=after.robot_mode, safety=after.safety_mode, pose=after.tcp_pose, g=after.tool_acceleration_m_per_s2)
        out["moved_s"] = moving.timestamp_s - before.timestamp_s
        began = time.monotonic(); robot.close(); out["close_s"] = time.monotonic() - began
        robot.stop()
        """)
    assert report["vz"] == pytest.approx(0.01, abs=1e-4)
    assert report["rose"] == pytest.approx(0.01 * report["moved_s"], abs=0.001)
    assert report["rest"] == 0
    assert (report["runtime"], report["connected"], report["mode"], report["safety"]) == (2, True, 7, 1)
    assert -0.001 < report["age"] < 0.05
    assert len(report["pose"]) == 6
    assert len(report["g"]) == 3
    assert report["stop_s"] < STOPS_WITHIN_S
    assert report["close_s"] < 5


@pytest.mark.hil
def test_a_configured_tcp_is_set(client: Client) -> None:
    report = client.run("""
        reader = UrReader(host, model=model, rate_Hz=rate_Hz); z = reader.read().z_m
        robot = connect(tcp=[0, 0, 0.2, 0, 0, 0]); time.sleep(0.1); out["apart"] = robot.read().z_m - z; robot.close()
        """)
    assert abs(report["apart"]) > 0.01  # the flange is fixed and the tip is somewhere else now


@pytest.mark.hil
def test_a_killed_client_stops_by_the_watchdog_and_a_new_one_takes_over(client: Client) -> None:
    client.cell.wires.ask("truth", reset=True)
    process = client.start("""
        robot = connect(); go(robot, 0.01, 0.3); print("moving", flush=True); go(robot, 0.01, 5)
        """)
    assert process.stdout is not None
    assert process.stdout.readline().strip() == "moving"
    process.kill()
    process.wait()
    time.sleep(0.3)
    resting = client.cell.wires.ask("truth")["target_z_m"]
    time.sleep(0.2)
    assert client.cell.wires.ask("truth")["target_z_m"] == resting
    report = client.run("robot = connect(); go(robot, -0.01, 0.3); out['vz'] = robot.read().target_speed[2]; robot.close()")
    assert report["vz"] == pytest.approx(-0.01, abs=1e-4)


@pytest.mark.hil
def test_after_the_watchdog_has_tripped_motion_is_refused_with_its_reason(client: Client) -> None:
    report = client.run("""
        robot = connect()
        go(robot, 0.005, 0.1); robot.stop()
        time.sleep(0.4)
        out["tripped"] = robot.read().runtime_state
        out["refusal"] = refusal_of(lambda: robot.move((0.0, 0.0, 0.0)))
        out["rest"] = robot.read().target_speed[2]
        robot.close()
        """)
    assert report["tripped"] != 2
    assert "does not take a speed command: its control script was stopped (runtime state 1, 2 expected)" in report["refusal"]
    assert report["rest"] == 0


@pytest.mark.hil
def test_a_command_does_not_wait_for_the_acknowledgement_of_the_one_before(client: Client) -> None:
    report = client.run("""
        import os, socket
        robot = connect(); go(robot, 0.001, 0.1); out["delayed"] = []
        for entry in os.listdir("/proc/self/fd"):
            try:
                connection = socket.socket(fileno=int(entry))
            except OSError:
                continue
            if connection.family == socket.AF_INET and connection.getpeername()[1] == 30004:
                out["delayed"].append(connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) == 0)
            connection.detach()
        robot.close()
        """)
    assert report["delayed"]
    assert not any(report["delayed"])


@pytest.mark.hil
def test_a_second_master_is_refused_and_a_second_reader_is_not(client: Client) -> None:
    report = client.run("""
        robot = connect()
        reader = UrReader(host, model=model, rate_Hz=rate_Hz); out["z"] = reader.read().z_m; reader.close()
        out["refusal"] = refusal_of(connect)
        go(robot, 0.001, 0.1)
        robot.close()
        """)
    assert "registers are owned by another program" in report["refusal"]


@pytest.mark.hil
def test_a_lost_connection_is_lost_for_good_and_nothing_hangs(client: Client) -> None:
    report = client.run_through(
        "drop",
        """
        robot = connect(); go(robot, 0.01, 0.2)
        say("moving")
        began = time.monotonic()
        while robot.read().connected and time.monotonic() - began < 2:
            time.sleep(0.001)
        out["seen_s"] = time.monotonic() - began
        out["refusal"] = refusal_of(lambda: robot.move((0.0, 0.0, 0.01)))
        began = time.monotonic(); robot.stop(); out["stop_s"] = time.monotonic() - began
        out["connected"] = robot.read().connected
        began = time.monotonic(); robot.close(); out["close_s"] = time.monotonic() - began
        """,
    )
    assert report["seen_s"] < 1.0
    assert "was lost, and is not taken up again while the arm may move" in report["refusal"]
    assert report["stop_s"] < STOPS_WITHIN_S
    assert report["connected"] is False
    assert report["close_s"] < 3


@pytest.mark.hil
def test_a_frozen_network_does_not_hang_stop_or_close(client: Client) -> None:
    report = client.run_through(
        "freeze",
        """
        robot = connect(); go(robot, 0.01, 0.2)
        say("moving")
        began = time.monotonic(); robot.stop(); out["stop_s"] = time.monotonic() - began
        began = time.monotonic(); robot.close(); out["close_s"] = time.monotonic() - began
        """,
        s=1.5,
    )
    assert report["stop_s"] < STOPS_WITHIN_S
    assert report["close_s"] < 5
    time.sleep(1.5)


@pytest.mark.hil
def test_a_protective_stop_shows_and_refuses_motion_with_its_reason(tmp_path: Path) -> None:
    skip_without_ur_rtde()
    with emulated_cell(tmp_path, "ur5") as cell:
        client = Client(cell)
        report = client.run(
            """
            robot = connect(); go(robot, 0.01, 0.2)
            say("moving")
            time.sleep(0.05)
            out["safety"] = robot.read().safety_mode
            out["refusal"] = refusal_of(lambda: robot.move((0.0, 0.0, 0.01)))
            robot.stop(); robot.close()
            """,
            {"moving": lambda: cell.wires.ask("protective_stop")},
        )
        assert report["safety"] == 3
        assert "its safety mode is PROTECTIVE_STOP; clear it at the teach pendant" in report["refusal"]
        cell.wires.ask("power_off")
        report = client.run("out['refusal'] = refusal_of(connect)")
        assert "RUNNING is needed; switch it on" in report["refusal"]


def test_the_states_that_are_read_exist_on_the_oldest_supported_controller() -> None:
    assert VARIABLES[0] == "timestamp"
    assert len(set(VARIABLES)) == len(VARIABLES) == 10
