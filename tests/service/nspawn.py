"""The service under a real systemd: `make test-service`. Boots a container, installs palpd as an operator would, and maltreats it.

The figures it measures are printed at the end. It runs as root, in about two minutes; elsewhere it is skipped, and says why.
"""

import json
import time
from collections.abc import Iterator
from typing import Any

import pytest

from palpd.daemon.socket_client import ask
from palpd.errors import Refused
from palpd.recording.reader import Recording
from palpd.recording.recovery import recover
from palpd.testing.fixtures import skip_without_ur_rtde
from palpd.testing.operator import Operator
from tests.service.container import INSIDE_CODE, INSIDE_PYTHON, Container, booted, missing, until

pytestmark = [pytest.mark.hil, pytest.mark.skipif(missing() is not None, reason=f"booting systemd in a container {missing()}")]

PYTHON = "/opt/palpd/.venv/bin/python"
CONFIG = "/etc/palpd/config.yaml"
SOCKET = "/run/palpd/palpd.sock"
EMULATORS = "/run/emulators"
PLAN = {"sites": [{"name": "A"}], "depths_m": [0.004], "mode": "static", "hold_s": 20.0, "search": {"max_travel_m": 0.08}}
LIBRARIES = f"LD_LIBRARY_PATH={INSIDE_PYTHON}/lib"
"""This Python was moved to another path, where a shared libpython would not be found by itself."""
ENVIRONMENT = f"""\
PALPD_SENSOR__PORT={EMULATORS}/hex
# a shared machine may stand still for longer than a cell may; how fast the guard is, is tested elsewhere
PALPD_SAFETY__ROBOT_STALE_S=0.4
PALPD_SAFETY__SENSOR_STALE_S=0.4
PALPD_SAFETY__MAX_STALL_S=0.4
PALPD_ROBOT__WATCHDOG_HZ=5
"""
EMULATED = f"""\
[Service]
# the emulated sensor is a pseudo terminal
DeviceAllow=char-pts rw
Environment={LIBRARIES}
"""


PRIVILEGED = """\
[Service]
# process 1 may not raise limits in this container (no CAP_SYS_RESOURCE): the same by capabilities, as systemd/README.md says
CapabilityBoundingSet=CAP_SYS_NICE CAP_IPC_LOCK
AmbientCapabilities=CAP_SYS_NICE CAP_IPC_LOCK
"""
CAPABILITIES = 1 << 23 | 1 << 14


class Installed:
    """The installed service, and what was measured of it."""

    def __init__(self, container: Container) -> None:
        self.inside, self.figures = container, {}  # type: ignore[var-annotated]

    def do(self, what: str, patience_s: float = 60.0, **more: Any) -> dict[str, Any]:
        """A request over the control socket, from outside."""
        return ask(self.inside.path(SOCKET), {"do": what, **more}, patience_s)

    def emulated(self, verb: str, **more: Any) -> dict[str, Any]:
        """A verb of the emulators."""
        import socket

        with socket.socket(socket.AF_UNIX) as channel:
            channel.connect(str(self.inside.path(f"{EMULATORS}/control")))
            channel.sendall(json.dumps({"do": verb, **more}).encode() + b"\n")
            with channel.makefile("rb") as lines:
                return dict(json.loads(lines.readline()))

    @property
    def pid(self) -> str:
        return self.inside.shows("palpd", "MainPID")

    @property
    def restarts(self) -> int:
        return int(self.inside.shows("palpd", "NRestarts"))

    def state(self) -> str:
        """Of the daemon, or "away"."""
        try:
            return str(self.do("status", 2.0)["state"])
        except Refused:
            return "away"

    def until_state(self, state: str, patience_s: float = 30.0) -> float:
        return until(lambda: self.state() == state, patience_s, f"the daemon is {state}")

    def begin(self) -> None:
        """A run that is well under way: the probe moves. What an earlier one left in the tissue is retracted first."""
        operator = Operator(self.do)
        if (probe := self.do("status")["probe"]) is not None and probe["state"] != "free":
            operator.retract()
        operator.start(PLAN, lambda now: now.get("phase") in ("search", "press", "hold"), "the search begins")

    def processes(self) -> list[str]:
        """Of the user palpd, other than the emulators."""
        lines = self.inside.run("ps", "-u", "palpd", "-o", "pid=,args=", check=False).splitlines()
        return [line for line in lines if "hw.emulators" not in line]


@pytest.fixture(scope="module")
def service(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Installed]:
    """Installed as systemd/README.md says, before emulated wires."""
    skip_without_ur_rtde()
    with booted(tmp_path_factory.mktemp("nspawn")) as inside:
        installed = Installed(inside)
        inside.run(f"{INSIDE_PYTHON}/bin/python3", "-m", "venv", "--without-pip", "/opt/palpd/.venv")
        folder = next(inside.path("/opt/palpd/.venv/lib").iterdir()).name
        packages = f"{INSIDE_CODE}/.venv/lib/{folder}/site-packages"
        inside.write(f"/opt/palpd/.venv/lib/{folder}/site-packages/palpd.pth", f"{INSIDE_CODE}\n{packages}\n")
        inside.run(PYTHON, "-m", "palpd", "install")
        inside.run("systemd-sysusers")
        inside.write("/etc/systemd/system/palpd.service.d/emulated.conf", EMULATED)
        if not inside.raises_limits:
            inside.write("/etc/systemd/system/palpd.service.d/privileged.conf", PRIVILEGED)
        installed.figures["limits_are"] = "as in the unit" if inside.raises_limits else "clamped here, capabilities instead"
        inside.write("/etc/palpd/environment", ENVIRONMENT)
        inside.run("systemctl", "daemon-reload")
        user = ["User=palpd", "RuntimeDirectory=emulators", "AmbientCapabilities=CAP_SYS_NICE", f"Environment={LIBRARIES}"]
        command = [PYTHON, "-m", "hw.emulators", "--sensor-link", f"{EMULATORS}/hex", "--control", f"{EMULATORS}/control"]
        inside.run("systemd-run", "--unit=emulators", *(f"--property={line}" for line in user), *command)
        until(lambda: inside.path(f"{EMULATORS}/control").exists(), 30.0, "the emulators are ready")
        yield installed
        print("\nmeasured:", json.dumps(installed.figures, indent=1))
        if request.session.testsfailed:
            print(inside.run("journalctl", "--unit=palpd", "--output=short-precise", check=False))


def test_the_unit_is_clean_where_it_is_installed(service: Installed) -> None:
    assert service.inside.run("systemd-analyze", "verify", "/etc/systemd/system/palpd.service") == ""


def test_it_starts_is_ready_and_waits_disarmed(service: Installed) -> None:
    began_s = time.monotonic()
    service.inside.run("systemctl", "start", "palpd")
    service.figures["start_s"] = time.monotonic() - began_s
    assert service.inside.shows("palpd", "ActiveState") == "active"
    assert service.do("status")["state"] in ("checking", "disarmed")
    service.until_state("disarmed")
    assert "there is no reference tare; palpd level-test goes 5 mm up" in service.do("status")["cell"]["reason"]
    with pytest.raises(Refused, match="there is no reference tare"):
        service.do("arm")


def test_live_data_comes_from_a_user_without_devices_and_capabilities(service: Installed) -> None:
    fetch = "import urllib.request; print(urllib.request.urlopen('http://127.0.0.1:9464/metrics').read().decode())"
    service.inside.write("/etc/systemd/system/palpd-stream.service.d/python.conf", f"[Service]\nEnvironment={LIBRARIES}\n")
    service.inside.run("systemctl", "daemon-reload")
    assert service.inside.run("systemctl", "is-enabled", "palpd-stream", check=False).strip() == "disabled"
    service.inside.run("systemctl", "start", "palpd-stream")
    try:
        read = ["env", LIBRARIES, PYTHON, "-c", fetch]
        until(lambda: "palpd_up 1.0" in service.inside.run(*read, check=False), 60.0, "it watches the service", every_s=0.5)
        pid = service.inside.shows("palpd-stream", "MainPID")
        fields = dict(line.split(":", 1) for line in service.inside.path(f"/proc/{pid}/status").read_text().splitlines())
        assert set(fields["Uid"].split()) == {service.inside.run("id", "-u", "palpd-stream").strip()}
        assert int(fields["CapEff"], 16) == int(fields["CapBnd"], 16) == 0
        assert not {"ttyACM0", "cpu_dma_latency"} & set(service.inside.run("ls", f"/proc/{pid}/root/dev").split())
        assert "palpd-" in service.inside.run("grep", "/dev/shm/", f"/proc/{pid}/maps"), "it reads the ring"
        assert service.inside.run("stat", "--format=%a %U %G", "/run/palpd-stream/force.sock").strip() == "660 palpd-stream palpd"
    finally:
        service.inside.run("systemctl", "stop", "palpd-stream")
    assert service.inside.shows("palpd-stream", "Result") == "success"


def test_an_operator_calibrates_beside_it_and_arms(service: Installed) -> None:
    calibrate = [PYTHON, "-m", "palpd", "calibrate", "--config", CONFIG]
    service.inside.run("runuser", "-u", "palpd", "--", "env", LIBRARIES, f"PALPD_SENSOR__PORT={EMULATORS}/hex", *calibrate)
    began_s = time.monotonic()
    service.do("arm")
    service.figures["arm_s"] = time.monotonic() - began_s
    assert service.state() == "armed"


def test_it_is_not_root_and_has_no_capability_but_what_stands_for_its_limits(service: Installed) -> None:
    status = service.inside.path(f"/proc/{service.pid}/status").read_text()
    fields = dict(line.split(":", 1) for line in status.splitlines())
    palpd = service.inside.run("id", "-u", "palpd").strip()
    assert set(fields["Uid"].split()) == {palpd} != {"0"}
    assert int(fields["CapBnd"], 16) == int(fields["CapEff"], 16) == (0 if service.inside.raises_limits else CAPABILITIES)
    assert fields["NoNewPrivs"].strip() == "1"


LIMITS = {"LimitRTPRIO": ("80", "Max realtime priority"), "LimitMEMLOCK": ("infinity", "Max locked memory")}
"""What the unit asks for, and under which name the kernel shows it."""


@pytest.mark.parametrize("limit", LIMITS)
def test_systemd_has_read_the_real_time_limits_of_the_unit(service: Installed, limit: str) -> None:
    assert service.inside.shows("palpd", limit) == LIMITS[limit][0]


@pytest.mark.parametrize("limit", LIMITS)
def test_the_process_has_the_real_time_limits_of_the_unit(service: Installed, limit: str) -> None:
    value, name = LIMITS[limit]
    limits = service.inside.path(f"/proc/{service.pid}/limits").read_text()
    got = next(line for line in limits.splitlines() if line.startswith(name))[len(name) :].split()[:2]
    if not service.inside.raises_limits:
        pytest.skip(f"not verified: process 1 may not raise limits here (no CAP_SYS_RESOURCE), so {limit} is clamped to {got}")
    assert got == [value.replace("infinity", "unlimited")] * 2


def test_only_its_group_may_speak_to_it(service: Installed) -> None:
    assert service.inside.run("stat", "--format=%a %U %G", SOCKET).strip() == "660 palpd palpd"
    status = ["env", LIBRARIES, PYTHON, "-m", "palpd", "status", "--config", CONFIG]
    assert "you may not connect to the daemon" in service.inside.run("runuser", "-u", "nobody", "--", *status, check=False)
    assert service.inside.run("runuser", "-u", "nobody", "-G", "palpd", "--", *status).startswith("armed")


def test_the_loop_runs_under_fifo_with_locked_memory_as_that_user(service: Installed) -> None:
    service.begin()
    threads = service.inside.run("ps", "-L", "-u", "palpd", "-o", "cls=,rtprio=,args=")
    motion = [line.split() for line in threads.splitlines() if "spawn_main" in line]
    assert ["FF", "60"] in [words[:2] for words in motion], threads
    owner = service.inside.run("pgrep", "-u", "palpd", "-f", "spawn_main").split()
    locked = [int(line.split()[1]) for pid in owner for line in service.inside.run("grep", "VmLck", f"/proc/{pid}/status").splitlines()]
    service.figures["locked_MiB"] = max(locked) / 1024
    assert max(locked) > 10_000
    service.do("abort")
    service.until_state("disarmed")
    last = service.do("status")["last"]
    assert last["verdict"] == "stopped"
    assert [note for note in last["notes"] if "cpu_dma_latency" not in note] == []  # a file that no container has
    assert Recording.load(service.inside.path(last["recording"])).rows.size


def test_a_daemon_that_hangs_is_restarted_by_the_watchdog_and_comes_up_disarmed(service: Installed) -> None:
    service.do("arm")
    assert service.state() == "armed"
    before, pid = service.restarts, service.pid
    began_s = time.monotonic()
    service.inside.run("kill", "-STOP", pid)
    until(lambda: service.restarts > before and service.pid not in (pid, "0"), 30.0, "the watchdog restarts it")
    until(lambda: service.state() != "away", 30.0, "it answers again")
    service.figures["hang_to_restarted_s"] = time.monotonic() - began_s
    assert service.state() in ("checking", "disarmed")
    assert "Watchdog timeout" in service.inside.run("journalctl", "--unit=palpd", "--output=cat")
    service.until_state("disarmed")


def test_after_kill_9_in_mid_run_the_arm_rests_and_the_daemon_is_back_disarmed(service: Installed) -> None:
    service.begin()
    time.sleep(1.0)
    before, began_s = service.restarts, time.monotonic()
    old = [line.split()[0] for line in service.processes()]
    service.inside.run("kill", "-KILL", service.pid)
    until(lambda: service.emulated("log", since_s=began_s)["samples"][-1][1] == 0.0, 5.0, "the target speed is zero")
    service.figures["kill_to_rest_s"] = time.monotonic() - began_s
    until(lambda: service.restarts > before and service.state() in ("checking", "disarmed"), 30.0, "it is restarted")
    service.figures["kill_to_restarted_s"] = time.monotonic() - began_s
    assert not set(old) & {line.split()[0] for line in service.processes()}
    service.until_state("disarmed")
    part = next(service.inside.path("/var/lib/palpd/runs").glob("*.part"))
    restored = recover(part)
    assert restored.ticks > 100


def test_alarms_hear_of_a_kill_at_rest_and_in_mid_run_within_5_s(service: Installed) -> None:
    inside = service.inside
    inside.run("systemd-run", "--unit=sink", f"--setenv={LIBRARIES}", PYTHON, "-m", "palpd.testing.http_sink", "8099", "/run/messages")
    inside.write("/etc/palpd/alarms.yaml", "phone: json://anna:pass-word-1@127.0.0.1:8099/token-abc123\n")
    inside.path("/etc/palpd/alarms.yaml").chmod(0o600)
    config = inside.path(CONFIG)
    text = config.read_text()
    config.write_text(text.replace("addresses: [] ", "addresses: [phone]").replace("quiet_s: 600", "quiet_s: 1"))
    inside.write("/etc/systemd/system/palpd-alarms.service.d/python.conf", f"[Service]\nEnvironment={LIBRARIES}\n")
    inside.run("systemctl", "daemon-reload")
    inside.run("systemctl", "reset-failed", "palpd")
    inside.run("systemctl", "start", "palpd-alarms")

    def journal() -> str:
        return inside.run("journalctl", "--unit=palpd-alarms", "--output=cat")

    def deaths() -> list[str]:
        lines = inside.run("cat", "/run/messages", check=False).splitlines()
        return [json.loads(line)["message"] for line in lines if "is dead" in line]

    def killed() -> float:
        before = len(deaths())
        began_s = time.monotonic()
        inside.run("kill", "-KILL", service.pid)
        until(lambda: len(deaths()) > before, 30.0, "the message comes")
        return time.monotonic() - began_s

    try:
        until(lambda: "go to phone" in journal(), 30.0, "it watches")
        time.sleep(3.0)  # it has seen the service
        service.figures["kill_at_rest_to_alarm_s"] = killed()
        assert "(signal killed KILL)" in deaths()[0]
        service.until_state("disarmed")
        service.begin()
        service.figures["kill_in_mid_run_to_alarm_s"] = killed()
        assert max(service.figures["kill_at_rest_to_alarm_s"], service.figures["kill_in_mid_run_to_alarm_s"]) < 5.0
        until(lambda: service.state() in ("checking", "disarmed"), 30.0, "it is restarted")
        assert len(deaths()) == 2, "what systemd says later is no further death"
        assert "pass-word-1" not in journal() + inside.run("systemctl", "show", "palpd-alarms")
        test = [PYTHON, "-m", "palpd", "alarms", "--test", "--config", CONFIG]
        assert inside.run("env", LIBRARIES, *test) == "phone: taken.\n"
        assert "cannot be read from" in inside.run("runuser", "-u", "palpd", "--", "env", LIBRARIES, *test, check=False)
    finally:
        inside.run("systemctl", "stop", "palpd-alarms", "sink", check=False)
        config.write_text(text)
        inside.run("systemctl", "reset-failed", "palpd")
        service.until_state("disarmed")
    assert inside.shows("palpd-alarms", "Result") == "success"


def test_the_journal_is_one_json_object_a_line(service: Installed) -> None:
    own = service.inside.run("id", "-u", "palpd").strip()
    lines = service.inside.run("journalctl", "--unit=palpd", "--output=cat", "_UID=" + own)
    events = [json.loads(line)["event"] for line in lines.splitlines() if line.startswith("{")]
    assert {"ready", "checked", "armed", "started", "ended", "request"} <= set(events)
    requests = [json.loads(line) for line in lines.splitlines() if '"request"' in line]
    assert {request["uid"] for request in requests} == {0, int(own)}, "root asks from outside, palpd calibrate as the service's user"
    assert all(request["pid"] >= 0 for request in requests)


def test_stop_in_mid_run_closes_the_recording_and_ends_with_0(service: Installed) -> None:
    service.begin()
    before = set(service.inside.path("/var/lib/palpd/runs").glob("*.mcap"))
    began_s = time.monotonic()
    service.inside.run("systemctl", "stop", "palpd")
    service.figures["stop_in_mid_run_s"] = time.monotonic() - began_s
    assert service.inside.shows("palpd", "Result") == "success"
    assert service.inside.shows("palpd", "ExecMainStatus") == "0"
    assert service.processes() == []
    assert not service.inside.path(SOCKET).exists()
    (recording,) = set(service.inside.path("/var/lib/palpd/runs").glob("*.mcap")) - before
    assert Recording.load(recording).rows.size


@pytest.mark.parametrize("after_s", [0.03, 0.3, 1.0])
def test_a_stop_while_it_starts_is_no_failure(service: Installed, after_s: float) -> None:
    service.inside.run("systemctl", "start", "--no-block", "palpd")
    until(lambda: service.pid != "0", 10.0, "its process is there", every_s=0.005)
    time.sleep(after_s)
    service.inside.run("systemctl", "stop", "palpd")
    assert service.inside.shows("palpd", "ActiveState") == "inactive"
    assert service.inside.shows("palpd", "Result") == "success"
    assert service.processes() == []


def test_a_wrong_configuration_is_refused_once_and_not_again_and_again(service: Installed) -> None:
    config = service.inside.path(CONFIG)
    text = config.read_text()
    config.write_text(text + "\nnonsense: 1\n")
    try:
        service.inside.run("systemctl", "start", "palpd", check=False)
        time.sleep(2.5)
        assert service.inside.shows("palpd", "ActiveState") == "failed"
        assert service.inside.shows("palpd", "ExecMainStatus") == "2"
        assert service.restarts == 0
    finally:
        config.write_text(text)


def test_one_that_dies_again_and_again_is_left_alone(service: Installed) -> None:
    service.inside.run("systemctl", "reset-failed", "palpd")
    service.inside.run("systemctl", "start", "palpd")
    began_s = time.monotonic()
    while service.inside.shows("palpd", "ActiveState") != "failed":
        assert time.monotonic() - began_s < 60.0
        pid = service.pid
        if pid != "0":
            service.inside.run("kill", "-KILL", pid, check=False)
        time.sleep(0.2)
    assert "Start request repeated too quickly" in service.inside.run("journalctl", "--unit=palpd", "--output=cat")
