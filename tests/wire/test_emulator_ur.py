"""The emulated controller and sensor as clients see them that use nothing but ur_rtde, pyserial and sockets.

Constructors of ur_rtde hold the interpreter's lock, and some of its faults end its process: every client is a process of its own.
"""

import itertools
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import serial

from hw.emulators.__main__ import main
from hw.emulators.process import Emulated, started
from palpd.testing.fixtures import skip_without_ur_rtde

pytestmark = pytest.mark.hil

PRELUDE = """
import contextlib, json, os, sys, time
with contextlib.suppress(OSError):  # else a busy machine keeps it from its watchdog
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(55))
from rtde_control import RTDEControlInterface
from rtde_receive import RTDEReceiveInterface
host, out = sys.argv[1], {}
DOWN, UP, STILL = [0, 0, -0.01, 0, 0, 0], [0, 0, 0.01, 0, 0, 0], [0] * 6
def wait(true, s=3.0):
    end = time.monotonic() + s
    while not true() and time.monotonic() < end:
        time.sleep(0.001)
    return true()
def say():
    print(json.dumps(out), flush=True)
"""
CONNECT = "r = RTDEReceiveInterface(host)\nc = RTDEControlInterface(host)\n"
_hosts = (f"127.0.{os.getpid() % 250 + 2}.{k}" for k in itertools.count(2))


@contextmanager
def client(host: str, body: str) -> Iterator[subprocess.Popen[str]]:
    """A client process that runs `body`."""
    skip_without_ur_rtde()
    program = PRELUDE + body + "\nsay()\nos._exit(0)\n"
    process = subprocess.Popen([sys.executable, "-c", program, host], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def report_of(process: subprocess.Popen[str]) -> dict[str, Any]:
    """What the client says on its next line."""
    assert process.stdout is not None
    assert process.stderr is not None
    line = process.stdout.readline()
    assert line, process.stderr.read()
    answer: dict[str, Any] = json.loads(line)
    return answer


def run(host: str, body: str) -> dict[str, Any]:
    """What a client says at its end."""
    with client(host, body) as process:
        return report_of(process)


@pytest.fixture(scope="module", params=["ur5", "ur5e"])
def wires(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Emulated]:
    with started(tmp_path_factory.mktemp(request.param), request.param, None, next(_hosts)) as wires:
        yield wires


@pytest.fixture(scope="module")
def cb3(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Emulated]:
    with started(tmp_path_factory.mktemp("cb3"), "ur5", None, next(_hosts)) as wires:
        yield wires


def dashboard(host: str, *lines: str) -> list[str]:
    with socket.create_connection((host, 29999), timeout=2.0) as connection, connection.makefile("rw") as stream:
        assert stream.readline() == "Connected: Universal Robots Dashboard Server\n"
        answers = []
        for line in lines:
            stream.write(line + "\n")
            stream.flush()
            answers.append(stream.readline().rstrip("\n"))
        return answers


# both generations


def test_ur_rtde_connects_and_its_six_getters_tell_one_state(wires: Emulated) -> None:
    report = run(
        wires.host,
        CONNECT
        + """
t0, w0 = r.getTimestamp(), time.monotonic(); time.sleep(2.0)  # a machine that stands still for 50 ms is no clock's fault
out.update(rate=(r.getTimestamp() - t0) / (time.monotonic() - w0), pose=r.getActualTCPPose(), target=r.getTargetTCPPose(),
    speed=r.getActualTCPSpeed(), force=r.getActualTCPForce(), safety=r.getSafetyMode(), mode=r.getRobotMode(),
    runtime=r.getRuntimeState(), bits=r.getSafetyStatusBits(), robot=r.getRobotStatus(), q=r.getActualQ(), g=r.getActualToolAccelerometer())
""",
    )
    assert report["rate"] == pytest.approx(1.0, abs=0.05)
    assert report["target"] == pytest.approx([0.0, 0.0, 0.03, 3.14159265, 0.0, 0.0], abs=1e-6)
    assert report["pose"] == pytest.approx(report["target"], abs=1e-4)
    assert max(map(abs, report["speed"])) < 0.002
    assert (report["safety"], report["mode"], report["runtime"], report["bits"], report["robot"]) == (1, 7, 2, 1, 3)
    assert len(report["q"]) == 6
    assert report["g"] == pytest.approx([0.0, 0.0, -9.81], abs=1.0)


def test_commands_that_do_not_move_answer_what_was_set(wires: Emulated) -> None:
    report = run(
        wires.host,
        CONNECT
        + """
out["tcp"] = c.getTCPOffset(); out["set"] = c.setTcp([0, 0, 0.2, 0, 0, 0]); out["new"] = c.getTCPOffset()
out["shown"] = wait(lambda: abs(r.getTargetTCPPose()[2] + 0.055) < 1e-6)
c.setTcp(out["tcp"])
out["payload"] = c.setPayload(0.4, [0.0, 0.0, 0.05]); out["payload_shown"] = wait(lambda: r.getPayload() == 0.4)
out["inside"] = c.isPoseWithinSafetyLimits([0, 0, 0.03, 3.14, 0, 0]); out["outside"] = c.isPoseWithinSafetyLimits([2, 0, 0, 3.14, 0, 0])
out["steady"] = wait(c.isSteady)
c.speedL(UP, 0.5); time.sleep(0.1); out["unsteady"] = c.isSteady(); c.speedStop()
q = r.getTargetQ(); back = c.getInverseKinematics(c.getForwardKinematics(q, out["tcp"]))
out["there_and_back"] = max(abs(a - b) for a, b in zip(q, back))
out["trans"] = c.poseTrans([0, 0, 1, 0, 0, 1.5707963267948966], [1, 0, 0, 0, 0, 0])
""",
    )
    assert report["tcp"] == pytest.approx([0.0, 0.0, 0.115, 0.0, 0.0, 0.0])
    assert report["new"] == pytest.approx([0.0, 0.0, 0.2, 0.0, 0.0, 0.0])
    assert report["set"]
    assert report["shown"]
    assert report["payload"]
    assert report["payload_shown"]
    assert report["inside"]
    assert not report["outside"]
    assert report["steady"]
    assert not report["unsteady"]
    assert report["there_and_back"] < 1e-6
    assert report["trans"][:3] == pytest.approx([0.0, 1.0, 1.0], abs=1e-9)


def test_speed_goes_on_after_its_time_and_stops_when_told(wires: Emulated) -> None:
    report = run(
        wires.host,
        CONNECT
        + """
c.speedL(UP, 0.5, 0.1); time.sleep(0.6)
out.update(vz=r.getTargetTCPSpeed()[2], actual=r.getActualTCPSpeed()[2]); t = time.monotonic()
out.update(stopped=c.speedStop(), took=time.monotonic() - t); time.sleep(0.05); out["after"] = r.getTargetTCPSpeed()
""",
    )
    assert report["vz"] == pytest.approx(0.01)
    assert report["actual"] == pytest.approx(0.01, abs=0.001)
    assert report["stopped"]
    assert report["took"] < 0.2
    assert report["after"] == [0.0] * 6


def test_moves_reach_their_goals_blocking_and_not_blocking(wires: Emulated) -> None:
    report = run(
        wires.host,
        CONNECT
        + """
p = r.getTargetTCPPose(); goal = p[:2] + [0.04] + p[3:]; near = p[:2] + [0.035] + p[3:]
c.moveL(goal, 0.25, 1.2)
t = time.monotonic(); out["sync"] = c.moveL(near, 0.05, 10.0); out["took"] = time.monotonic() - t
time.sleep(0.02); out["error"] = abs(r.getTargetTCPPose()[2] - 0.035)
before = c.getAsyncOperationProgress()
t = time.monotonic(); out["async"] = c.moveL(goal, 0.05, 10.0, True); out["returned"] = time.monotonic() - t
out["running"] = wait(lambda: c.getAsyncOperationProgress() == 0, 0.08)
out["ended"] = wait(lambda: c.getAsyncOperationProgress() < 0, 1.0); out["other"] = c.getAsyncOperationProgress() != before
time.sleep(0.02); out["async_error"] = abs(r.getTargetTCPPose()[2] - 0.04)
c.moveL(near, 0.01, 10.0, True); time.sleep(0.1); c.stopL(2.0, True); time.sleep(0.05)
out.update(rest=r.getTargetTCPSpeed() == STILL, z=r.getTargetTCPPose()[2], runtime=r.getRuntimeState())
q = r.getTargetQ(); q[0] += 0.01; out["joints"] = c.moveJ(q, 0.5, 1.0); time.sleep(0.02)
out["joint_error"] = max(abs(a - b) for a, b in zip(q, r.getTargetQ()))
c.moveL(p[:2] + [0.03] + p[3:], 0.25, 1.2)
""",
    )
    assert report["sync"]
    assert 0.1 <= report["took"] < 0.3
    assert report["error"] < 1e-7
    assert report["async"]
    assert report["returned"] < 0.08
    assert report["running"]
    assert report["ended"]
    assert report["other"]
    assert report["async_error"] < 1e-7
    assert report["rest"]
    assert 0.036 < report["z"] < 0.0395
    assert report["runtime"] == 2
    assert report["joints"]
    assert report["joint_error"] < 1e-6


@pytest.mark.parametrize(("watchdog_Hz", "send_s", "stopped_s", "travel_m"), [(10.0, 0.008, 0.110, 0.0015), (50.0, 0.008, 0.045, 0.0007)])
def test_after_kill_9_of_the_client_the_watchdog_brings_target_and_tip_to_rest(
    wires: Emulated, watchdog_Hz: float, send_s: float, stopped_s: float, travel_m: float
) -> None:
    body = f"""
out["watchdog"] = c.setWatchdog({watchdog_Hz})
for k in range(1000):
    c.speedL(UP if k < 50 else DOWN, 0.5)
    if k == 150: say()
    time.sleep({send_s})
"""
    for _ in range(5):
        with client(wires.host, CONNECT + body) as process:
            assert report_of(process)["watchdog"]
            process.send_signal(signal.SIGKILL)
            killed_s = time.monotonic()
            process.wait()
        time.sleep(0.6)
        log = wires.log(killed_s - 0.05)
        at_kill = min(log, key=lambda row: abs(row.t_s - killed_s))
        if at_kill.vz_m_per_s == pytest.approx(-0.01):  # else the machine kept the client from feeding the watchdog: no sample
            break
    moving = [row.t_s for row in log if row.speed_m_per_s > 0.0]
    assert at_kill.vz_m_per_s == pytest.approx(-0.01)
    assert log[-1].runtime == 1
    late_s = wires.ask("stats")["late_us_max"] * 1e-6  # what the machine adds: an emulator that wakes late reads late, too
    assert 0.5 / watchdog_Hz < moving[-1] - killed_s <= stopped_s + late_s
    assert at_kill.tip_z_m - log[-1].tip_z_m <= travel_m + 0.01 * late_s
    assert log[-1].tip_z_m == pytest.approx(log[-1].target_z_m, abs=1e-6)


def test_an_emulator_that_stood_still_does_not_trip_the_watchdog_of_a_client_that_did_not(wires: Emulated) -> None:
    body = """
c.setWatchdog(10.0); say()
for k in range(200):
    c.speedL(UP if k % 100 < 50 else DOWN, 0.5); time.sleep(0.005)
out["runtime"] = r.getRuntimeState()
"""
    with client(wires.host, CONNECT + body) as process:
        report_of(process)
        time.sleep(0.2)
        os.kill(wires.pid, signal.SIGSTOP)
        time.sleep(0.5)
        os.kill(wires.pid, signal.SIGCONT)
        assert report_of(process)["runtime"] == 2


def test_a_blocking_move_under_a_watchdog_stops_itself(wires: Emulated) -> None:
    report = run(
        wires.host,
        CONNECT
        + """
p = r.getTargetTCPPose(); c.setWatchdog(10.0)
out.update(moved=c.moveL(p[:2] + [p[2] + 0.02] + p[3:], 0.04, 1.0), way=r.getTargetTCPPose()[2] - p[2])
out["runtime"] = wait(lambda: r.getRuntimeState() == 1)
""",
    )
    assert not report["moved"]
    assert 0.0 < report["way"] < 0.010  # 5 mm, and as much for a machine that stands still; of the 20 mm that were asked for
    assert report["runtime"]


def test_a_move_while_a_commanded_speed_lives_ends_the_program_until_the_script_is_uploaded_again(wires: Emulated) -> None:
    report = run(
        wires.host,
        CONNECT
        + """
p = r.getTargetTCPPose(); c.speedL(UP, 0.5); time.sleep(0.1)
out.update(moved=c.moveL(p, 0.05, 1.0), stopped=wait(lambda: r.getRuntimeState() == 1), still=r.getTargetTCPSpeed() == STILL)
out.update(again=c.reuploadScript(), playing=wait(lambda: r.getRuntimeState() == 2)); time.sleep(0.1)
out["moved_again"] = c.moveL(p, 0.05, 1.0)
""",
    )
    assert not report["moved"]
    assert report["stopped"]
    assert report["still"]
    assert report["again"]
    assert report["playing"]
    assert report["moved_again"]


def test_a_wall_stands_where_it_was_placed(wires: Emulated) -> None:
    wires.ask("wall", z_m=0.025, stiffness_N_per_m=5000.0)
    go = "p = r.getTargetTCPPose(); c.moveL(p[:2] + [{}] + p[3:], 0.02, 0.5); time.sleep(0.4)"
    run(wires.host, CONNECT + go.format(0.03))
    wires.ask("truth", reset=True)
    run(wires.host, CONNECT + go.format(0.0235))
    truth = wires.ask("truth")
    assert truth["surface_z_m"] == 0.025
    assert truth["contact_N"] == pytest.approx(7.5, abs=0.05)
    assert truth["peak_contact_N"] < 8.0
    run(wires.host, CONNECT + go.format(0.03))
    wires.ask("truth", reset=True)
    assert wires.ask("truth")["peak_contact_N"] == 0.0


# the rest is the same for both; one is enough


def test_without_a_watchdog_a_killed_client_leaves_the_robot_moving_and_a_new_one_stops_it(cb3: Emulated) -> None:
    with client(cb3.host, CONNECT + "c.speedL(UP, 0.5); time.sleep(0.1); say(); time.sleep(10)") as process:
        report_of(process)
        process.send_signal(signal.SIGKILL)
        process.wait()
    time.sleep(0.4)
    assert min(row.vz_m_per_s for row in cb3.log(time.monotonic() - 0.1)) == pytest.approx(0.01)
    report = run(cb3.host, CONNECT + "time.sleep(0.1); out.update(v=r.getTargetTCPSpeed(), runtime=r.getRuntimeState())")
    assert report == {"v": [0.0] * 6, "runtime": 2}


def test_a_second_control_is_refused_and_any_number_may_listen(cb3: Emulated) -> None:
    report = run(
        cb3.host,
        CONNECT
        + """
more = [RTDEReceiveInterface(host) for _ in range(3)]
try:
    RTDEControlInterface(host)
except RuntimeError as error:
    out["refused"] = str(error)
out["poses"] = [m.getTargetTCPPose()[2] for m in more]; out["alive"] = c.isConnected() and c.speedStop()
""",
    )
    assert "already in use" in report["refused"]
    assert len(report["poses"]) == 3
    assert report["alive"]


def test_receive_notices_a_drop_at_once_and_reconnects(cb3: Emulated) -> None:
    with client(
        cb3.host,
        """
r = RTDEReceiveInterface(host); say(); t = time.monotonic()
out["noticed"] = wait(lambda: not r.isConnected(), 3.0); out["again"] = r.reconnect()
t0 = r.getTimestamp(); out["runs"] = wait(lambda: r.getTimestamp() > t0 + 0.1)
""",
    ) as process:
        report_of(process)
        cb3.ask("drop")
        report = report_of(process)
    assert report == {"noticed": True, "again": True, "runs": True}


def test_while_the_network_hangs_getters_repeat_themselves_and_say_nothing(cb3: Emulated) -> None:
    with client(
        cb3.host,
        """
r = RTDEReceiveInterface(host); say(); sys.stdin.readline(); time.sleep(0.1)
t = r.getTimestamp(); time.sleep(0.5); out["stale"] = r.getTimestamp() == t; out["connected"] = r.isConnected()
out["runs"] = wait(lambda: r.getTimestamp() > t + 0.1)
""".replace("sys.stdin.readline(); ", "time.sleep(0.2); "),
    ) as process:
        report_of(process)
        cb3.ask("freeze", s=1.2)
        report = report_of(process)
    assert report == {"stale": True, "connected": True, "runs": True}


def test_after_a_protective_stop_motion_needs_the_unlock_and_a_new_upload(cb3: Emulated) -> None:
    with client(
        cb3.host,
        CONNECT
        + """
p = r.getTargetTCPPose(); out["z"] = p[2]; say()
out["moved"] = c.moveL(p[:2] + [p[2] + 0.01] + p[3:], 0.01, 1.0)
time.sleep(0.05); out.update(safety=r.getSafetyMode(), bits=r.getSafetyStatusBits(), still=r.getTargetTCPSpeed() == STILL)
t = time.monotonic(); out["again"] = c.moveL(p, 0.01, 1.0); out["at_once"] = time.monotonic() - t < 0.1; say()
out["unlocked"] = wait(lambda: r.getSafetyMode() == 1, 8.0)
out["upload"] = c.reuploadScript(); time.sleep(0.4); out["moves"] = c.moveL(p, 0.05, 1.0)
""",
    ) as process:
        report_of(process)
        time.sleep(0.2)
        cb3.ask("protective_stop")
        stopped_s = time.monotonic()
        report = report_of(process)
        assert report["bits"] == 0x404
        assert (report["safety"], report["still"], report["moved"], report["again"], report["at_once"]) == (3, True, False, False, True)
        assert dashboard(cb3.host, "safetystatus", "unlock protective stop")[0] == "Safetystatus: PROTECTIVE_STOP"
        assert "Cannot unlock" in dashboard(cb3.host, "unlock protective stop")[0]
        time.sleep(max(0.0, stopped_s + 5.05 - time.monotonic()))
        assert dashboard(cb3.host, "unlock protective stop") == ["Protective stop releasing"]
        report = report_of(process)
    assert report["unlocked"]
    assert report["upload"]
    assert report["moves"]


def test_the_client_can_trigger_a_protective_stop_and_stop_the_script(cb3: Emulated) -> None:
    report = run(cb3.host, CONNECT + "c.stopScript(); out['stopped'] = wait(lambda: r.getRuntimeState() == 1)")
    assert report["stopped"]
    report = run(cb3.host, CONNECT + "c.triggerProtectiveStop(); out['safety'] = wait(lambda: r.getSafetyMode() == 3)")
    cb3.ask("restart", s=0.05)
    time.sleep(0.2)
    assert report["safety"]


@pytest.mark.parametrize(
    ("verb", "seen"),
    [
        ("emergency_stop", "r.getSafetyMode() == 7 and r.getRobotMode() == 3 and r.isEmergencyStopped()"),
        ("power_off", "r.getRobotMode() == 3"),
        ("program_stop", "r.getRuntimeState() == 1"),
    ],
)
def test_what_happens_at_the_robot_is_seen_by_the_client(cb3: Emulated, verb: str, seen: str) -> None:
    body = f"out['seen'] = wait(lambda: {seen}); out['still'] = wait(lambda: r.getTargetTCPSpeed() == STILL)"
    with client(cb3.host, CONNECT + "c.speedL(UP, 0.5); say()\n" + body) as process:
        report_of(process)
        time.sleep(0.1)
        cb3.ask(verb)
        report = report_of(process)
    if verb == "emergency_stop":
        assert dashboard(cb3.host, "power on", "brake release", "robotmode", "safetymode")[2:] == [
            "Robotmode: POWER_OFF", "Safetymode: ROBOT_EMERGENCY_STOP",
        ], "no power clears a stop"  # fmt: skip
        cb3.ask(verb, on=False)
    released = dashboard(cb3.host, "power on", "brake release", "robotmode")
    assert report == {"seen": True, "still": True}
    assert released == ["Powering on", "Brake releasing", "Robotmode: RUNNING"]


def test_a_restarted_controller_is_away_and_comes_back_with_empty_registers(cb3: Emulated) -> None:
    cb3.ask("restart", s=0.5)
    with pytest.raises(OSError, match="refused"):
        socket.create_connection((cb3.host, 30004), timeout=1.0)
    time.sleep(0.7)
    report = run(cb3.host, CONNECT + "out.update(t=r.getTimestamp(), playing=wait(lambda: r.getRuntimeState() == 2))")
    assert report["t"] < 5.0
    assert report["playing"]


def test_slow_packets_are_every_so_manyeth(cb3: Emulated) -> None:
    with client(
        cb3.host,
        """
r = RTDEReceiveInterface(host); say(); time.sleep(0.1); seen = set(); end = time.monotonic() + 0.5
while time.monotonic() < end:
    seen.add(r.getTimestamp()); time.sleep(0.001)
seen = sorted(seen); out["gaps"] = [b - a for a, b in zip(seen, seen[1:])]
""",
    ) as process:
        report_of(process)
        cb3.ask("slow_packets", every=5, s=1.0)
        gaps = report_of(process)["gaps"]
    time.sleep(0.5)
    assert sorted(gaps)[len(gaps) // 2] == pytest.approx(0.04)


# RTDE, byte by byte


@pytest.fixture
def rtde(cb3: Emulated) -> Iterator[Callable[..., tuple[str, bytes]]]:
    with socket.create_connection((cb3.host, 30004), timeout=2.0) as connection, connection.makefile("rb") as stream:

        def ask(kind: str = "", body: bytes = b"") -> tuple[str, bytes]:
            if kind:
                connection.sendall(struct.pack(">HB", 3 + len(body), ord(kind)) + body)
            size, got = struct.unpack(">HB", stream.read(3))
            return chr(got), stream.read(size - 3)

        yield ask


def test_the_handshake_has_the_bytes_of_the_guide(rtde: Callable[..., tuple[str, bytes]]) -> None:
    assert rtde("V", b"\x00\x02") == ("V", b"\x01")
    assert rtde("V", b"\x00\x63") == ("V", b"\x00")
    assert rtde("v") == ("v", struct.pack(">4I", 3, 15, 8, 106339))
    kind, body = rtde("S")
    assert (kind, body[1:20]) == ("M", b"No output recipe: n")
    assert rtde() == ("S", b"\x00")
    names = b"timestamp,actual_TCP_pose,robot_mode,actual_digital_input_bits,payload_cog,joint_mode,"
    assert rtde("O", struct.pack(">d", 125.0) + names) == ("O", b"\x01DOUBLE,VECTOR6D,INT32,UINT64,VECTOR3D,VECTOR6INT32")
    assert rtde("S") == ("S", b"\x01")
    kind, body = rtde()
    assert (kind, len(body), body[0]) == ("U", 1 + 8 + 48 + 4 + 8 + 24 + 24, 1)
    first_s, *pose = struct.unpack_from(">7d", body, 1)
    second_s = struct.unpack_from(">d", rtde()[1], 1)[0]
    assert second_s - first_s == pytest.approx(0.008)
    assert pose[3] == pytest.approx(3.14159265)
    answers = [rtde("P")]
    while answers[-1][0] == "U":
        answers.append(rtde())
    assert answers[-1] == ("P", b"\x01")


def test_unknown_fields_and_owned_inputs_are_refused_by_name(rtde: Callable[..., tuple[str, bytes]], cb3: Emulated) -> None:
    assert rtde("O", struct.pack(">d", 125.0) + b"timestamp,ft_raw_wrench") == ("O", b"\x00DOUBLE,NOT_FOUND")
    assert rtde("I", b"input_int_register_40,input_int_register_99,") == ("I", b"\x00INT32,NOT_FOUND")
    assert rtde("I", b"input_int_register_40,input_double_register_40,") == ("I", b"\x01INT32,DOUBLE")
    with socket.create_connection((cb3.host, 30004), timeout=2.0) as other:
        other.sendall(struct.pack(">HB", 3 + 42, ord("I")) + b"input_int_register_40,input_int_register_4")
        assert other.recv(64) == struct.pack(">HB", 3 + 13, ord("I")) + b"\x00IN_USE,INT32"
    kind, body = rtde("U", b"\x07")
    assert kind == "M"
    assert b"unknown recipe" in body
    kind, body = rtde("U", b"\x01\x00")
    assert kind == "M"
    assert body[-1] == 1


def test_a_refused_protocol_version_is_a_fault_that_can_be_had(rtde: Callable[..., tuple[str, bytes]], cb3: Emulated) -> None:
    cb3.ask("refuse_version", on=True)
    assert rtde("V", b"\x00\x02") == ("V", b"\x00")
    cb3.ask("refuse_version", on=False)
    assert rtde("V", b"\x00\x02") == ("V", b"\x01")


# one cell behind both wires


def counts(port: serial.Serial, frames: int) -> list[tuple[int, ...]]:
    """That number of data frames from now on: counter, status, six counts."""
    port.reset_input_buffer()
    data = port.read(22 * (frames + 2))
    data = data[data.index(b"\xaa\x07\x08\x10") :]
    whole = [data[at : at + 22] for at in range(0, 22 * frames, 22)]
    assert all(frame[:4] == b"\xaa\x07\x08\x10" and sum(frame[:20]) & 0xFFFF == int.from_bytes(frame[20:], "big") for frame in whole)
    return [struct.unpack(">HH6h", frame[4:20]) for frame in whole]


def test_pressing_is_felt_by_the_sensor_as_much_as_the_cell_says(cb3: Emulated) -> None:
    with serial.Serial(cb3.sensor, 1_000_000, timeout=2.0) as port:
        powered_up = counts(port, 20)
        assert {(b[0] - a[0]) % 65536 for a, b in itertools.pairwise(powered_up)} == {10}
        port.write(bytes.fromhex("AA003203010200") + bytes.fromhex("00E2"))
        until = port.read_until(bytes.fromhex("AA0050010000FB"))
        assert until.endswith(bytes.fromhex("AA0050010000FB"))
        assert (len(until) - 7) % 22 == 0
        run(cb3.host, CONNECT + "p = r.getTargetTCPPose(); c.moveL(p[:2] + [0.03] + p[3:], 0.05, 0.5); time.sleep(0.3)")
        free = counts(port, 500)
        assert {(b[0] - a[0]) % 65536 for a, b in itertools.pairwise(free)} == {1}
        hanging_N = sum(row[4] for row in free) / 500 / 7.64 + 430 / 7.64
        assert hanging_N == pytest.approx(0.2 * 9.81, abs=0.05)
        run(cb3.host, CONNECT + "p = r.getTargetTCPPose(); c.moveL(p[:2] + [-0.008] + p[3:], 0.05, 0.5); time.sleep(0.4)")
        pressed = counts(port, 500)
        truth = cb3.ask("truth")
        assert truth["tip_z_m"] == pytest.approx(-0.008, abs=1e-5)
        assert truth["surface_z_m"] == 0.0
        assert 4.0 < truth["contact_N"] <= truth["peak_contact_N"]
        felt_N = (sum(row[4] for row in free) - sum(row[4] for row in pressed)) / 500 / 7.64
        assert felt_N == pytest.approx(truth["contact_N"], abs=0.05)
        assert all(row[1] == 0 for row in pressed)


def test_an_unplugged_sensor_comes_back_powered_up_afresh(cb3: Emulated) -> None:
    with serial.Serial(cb3.sensor, 1_000_000, timeout=2.0) as port:
        port.write(bytes.fromhex("AA003203010200") + bytes.fromhex("00E2"))
        port.read_until(bytes.fromhex("AA0050010000FB"))
        cb3.ask("unplug")
        with pytest.raises(serial.SerialException):
            port.read(100_000)
    assert not Path(cb3.sensor).exists()
    cb3.ask("replug")
    with serial.Serial(cb3.sensor, 1_000_000, timeout=2.0) as port:
        assert {(b[0] - a[0]) % 65536 for a, b in itertools.pairwise(counts(port, 5))} == {10}


# the process


def test_a_port_that_is_taken_is_one_sentence_and_exit_2(
    cb3: Emulated, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["emulators", "--host", cb3.host, "--sensor-link", str(tmp_path / "hex")])
    assert main() == 2
    report = capsys.readouterr()
    assert report.out == ""
    assert report.err.count("\n") == 1
    assert f"cannot listen on {cb3.host}" in report.err
    assert not os.path.lexists(tmp_path / "hex")


def test_it_prints_two_lines_and_ends_with_the_process_that_started_it(tmp_path: Path) -> None:
    host, link = next(_hosts), tmp_path / "hex"
    command = f"{sys.executable} -m hw.emulators --host {host} --sensor-link {link} --end-with-parent & wait"
    with subprocess.Popen(["sh", "-c", command], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        assert [parent.stdout.readline(), parent.stdout.readline()] == [f"robot {host}\n", f"sensor {link}\n"]
        assert link.is_symlink()
        parent.kill()
        assert parent.stdout.read() == ""  # ends when the emulators have
    assert not os.path.lexists(link)


def test_a_verb_that_is_wrong_is_refused_and_harms_nothing(cb3: Emulated) -> None:
    with pytest.raises(RuntimeError, match="there is no verb 'jump'"):
        cb3.ask("jump")
    with pytest.raises(RuntimeError, match="missing"):
        cb3.ask("silent")
    assert cb3.ask("truth")["contact_N"] >= 0.0
