"""Back after a stop of the robot: what the controller says, each step at the pendant, and the order that the service insists on."""

import os
import pty
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

import pytest

from palpd.daemon.robot_stops import ROBOT_STOPS, StopName
from palpd.errors import Refused
from palpd.testing.emulated_cell import PATIENT, PRESS, EmulatedCell, emulated_cell
from palpd.testing.fixtures import skip_without_ur_rtde
from palpd.testing.operator import Operator
from palpd.testing.processes import until
from palpd.testing.served_cell import ServedCell, served

pytestmark = pytest.mark.hil

MOST_S = 20.0
"""Longest way from a protective stop to armed, the steps at the pendant aside."""
PENDANT_S = 5.1
"""Age of a protective stop at which the controller lets it be unlocked."""


@pytest.fixture(scope="module")
def ur5e(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServedCell]:
    """A calibrated service before an e-Series, which has a local mode; each test begins and ends with a robot that may move."""
    skip_without_ur_rtde()
    with emulated_cell(tmp_path_factory.mktemp("ur5e"), "ur5e") as base, served(base.anew(base.folder, **PATIENT)) as service:
        yield service


def says(service: ServedCell, stop: StopName | None) -> None:
    """Wait until the service says that this stands, and has looked at the cell anew where nothing does."""

    def seen() -> bool:
        status = service.do("status")
        known = status["now"]["stop"]
        return bool(status["state"] == "disarmed" and (known["name"] if known else None) == stop)

    until(seen, f"the service says {stop}", 20.0, every_s=0.05)


def refused(service: ServedCell, stop: StopName, *orders: str) -> None:
    """Each order is refused with the words of the table, and nothing moves."""
    for order in orders:
        with pytest.raises(Refused, match=re.escape(ROBOT_STOPS[stop].reason)):
            service.do(order)


@dataclass(frozen=True)
class Following:
    """`palpd recover-robot` in a terminal of its own."""

    process: subprocess.Popen[bytes]
    terminal: int
    heard: bytearray

    @property
    def output(self) -> str:
        return self.heard.decode(errors="replace")

    def hears(self, words: str) -> None:
        """Wait for these words."""
        until(lambda: words in self.output, f"{words!r}, after {self.output}")

    def answer(self, question: str, words: str = "y") -> None:
        """Answer a question when it comes."""
        self.hears(question)
        os.write(self.terminal, words.encode() + b"\n")


@contextmanager
def following(service: ServedCell) -> Iterator[Following]:
    near, far = pty.openpty()
    command = [sys.executable, "-m", "palpd", "recover-robot", "--config", str(service.cell.config)]
    process, heard = subprocess.Popen(command, stdin=far, stdout=far, stderr=far, start_new_session=True), bytearray()
    os.close(far)

    def read() -> None:
        with suppress(OSError):  # the other end has gone
            while piece := os.read(near, 4096):
                heard.extend(piece)

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    try:
        yield Following(process, near, heard)
    finally:
        process.kill()
        process.wait()
        reader.join(5.0)
        os.close(near)


Step = tuple[StopName, dict[str, Any]]
WAYS: dict[str, tuple[dict[str, Any], list[Step]]] = {
    "emergency stop": (
        {"do": "emergency_stop"},
        [("emergency_stop", {"do": "emergency_stop", "on": False}), ("power_off", {"do": "pendant", "press": "power on"}),
         ("brakes", {"do": "pendant", "press": "brake release"})],
    ),
    "emergency stop of the system": (
        {"do": "emergency_stop", "system": True},
        [("system_emergency_stop", {"do": "emergency_stop", "on": False}), ("power_off", {"do": "pendant", "press": "brake release"})],
    ),
    "safeguard stop": ({"do": "safeguard_stop"}, [("safeguard_stop", {"do": "safeguard_stop", "on": False})]),
    "power off": ({"do": "power_off"}, [("power_off", {"do": "pendant", "press": "brake release"})]),
    "safety fault": (
        {"do": "safety_fault"},
        [("fault", {"do": "pendant", "press": "restart safety"}), ("power_off", {"do": "pendant", "press": "brake release"})],
    ),
    "local control": ({"do": "local_control"}, [("local", {"do": "local_control", "on": False})]),
    "lost link": ({"do": "freeze", "s": 9.0}, [("link_lost", {"do": "freeze", "s": 0.0})]),
}  # fmt: skip
"""Each stop, and what the operator does at the robot, step by step."""


@pytest.mark.parametrize("way", WAYS)
def test_each_step_is_said_waited_for_and_seen_and_nothing_is_armed_before(ur5e: ServedCell, way: str) -> None:
    stop, steps = WAYS[way]
    until(lambda: ur5e.do("status")["state"] == "disarmed", "the service rests", every_s=0.05)
    began_s = float(ur5e.cell.wires.ask(stop.pop("do"), **stop)["t_s"])
    with pytest.raises(Refused):
        ur5e.do("arm")
    for name, step in steps:
        says(ur5e, name)
        refused(ur5e, name, "arm", "start", "retract", "clear")
        ur5e.cell.wires.ask(step.pop("do"), **step)
    says(ur5e, None)
    assert "arm" not in ur5e.do("status")["now"]["obstacles"]
    assert all(sample.speed_m_per_s == 0.0 for sample in ur5e.cell.log(began_s)), "nothing moves by itself"


def test_a_program_that_could_go_on_is_stopped_at_the_pendant_before_the_safeguard_closes(ur5e: ServedCell) -> None:
    wires = ur5e.cell.wires
    until(lambda: ur5e.do("status")["state"] == "disarmed", "the service rests", every_s=0.05)
    wires.ask("other_program", s=60.0)
    time.sleep(0.3)
    wires.ask("safeguard_stop")
    with pytest.raises(Refused):
        ur5e.do("arm")
    says(ur5e, "safeguard_program")
    refused(ur5e, "safeguard_program", "arm", "clear")
    wires.ask("pendant", press="stop")
    says(ur5e, "safeguard_stop")
    wires.ask("safeguard_stop", on=False, resume=True)
    says(ur5e, None)


def test_from_a_protective_stop_in_the_tissue_to_armed_with_the_command_that_follows(cell: Callable[..., EmulatedCell]) -> None:
    with served(cell(**PATIENT)) as service:
        service.press()
        stopped_s = float(service.cell.wires.ask("protective_stop")["t_s"])
        says(service, "protective_stop")
        said_s = time.monotonic() - stopped_s
        pressed_N = service.cell.truth()["contact_N"]
        refused(service, "protective_stop", "clear", "retract", "arm", "start")
        with following(service) as command:
            command.hears("Enable Robot")
            time.sleep(max(0.0, stopped_s + PENDANT_S - time.monotonic()))
            unlocked_s = float(service.cell.wires.ask("pendant", press="unlock protective stop")["t_s"])
            command.hears("Next: palpd retract")
            assert service.cell.truth()["contact_N"] == pytest.approx(pressed_N, abs=0.5), "the retract is offered, not begun"
            with pytest.raises(Refused, match=r"pressed|in the tissue|unfinished"):
                service.do("clear")
            began_s = time.monotonic()
            Operator(service.do).retract()
            retract_s = time.monotonic() - began_s
            command.answer("Acknowledge the stop")
            command.answer("Arm, so that")
            until(lambda: service.do("status")["state"] == "armed", "armed", every_s=0.02)
            armed_s = time.monotonic() - unlocked_s
            assert command.process.wait(10.0) == 0, command.output
        print(f"said after {said_s:.2f} s; armed {armed_s:.2f} s after the unlock, {retract_s:.2f} s of it for the retract")
        assert said_s + armed_s - retract_s < MOST_S, "a busy machine makes the retract as slow as it likes"


def test_a_second_protective_stop_within_a_minute_needs_a_cause_over_a_restart(cell: Callable[..., EmulatedCell]) -> None:
    wired = cell(**PATIENT)
    with served(wired) as service:
        for _ in range(2):
            stopped_s = float(wired.wires.ask("protective_stop")["t_s"])
            with pytest.raises(Refused):
                service.do("arm")
            says(service, "protective_stop")
            time.sleep(max(0.0, stopped_s + PENDANT_S - time.monotonic()))
            wired.wires.ask("pendant", press="unlock protective stop")
            says(service, None)
        with pytest.raises(Refused, match="its cause must be written down"):
            service.do("arm")
    with served(wired, calibrate=False) as service:
        with pytest.raises(Refused, match="its cause must be written down"):
            service.do("arm")
        foreground = wired.run(PRESS, take_reference=False)
        assert foreground.wait() == 2
        assert "palpd recover-robot asks for it" in foreground.stderr
        cleared = wired.palpd("clear", "--config", wired.config, "--cause", "the tool touched the frame")
        assert cleared.returncode == 0, cleared.stderr
        assert "the tool touched the frame" in wired.palpd("status", "--config", wired.config).stdout
        Operator(service.do).arm()
        assert "the tool touched the frame" in (wired.folder / "log.jsonl").read_text()


def test_without_a_service_the_command_reads_the_controller_and_asks_for_nothing(cell: Callable[..., EmulatedCell]) -> None:
    wired = cell(**PATIENT)
    fit = wired.palpd("recover-robot", "--config", wired.config)
    assert fit.returncode == 0, fit.stderr
    wired.wires.ask("power_off")
    off = wired.palpd("recover-robot", "--config", wired.config, "--json", wired.folder / "robot.json")
    assert off.returncode == 2
    assert "press ON on the initialisation screen" in off.stderr
    assert '"power_off"' in (wired.folder / "robot.json").read_text()
