"""`palpd doctor`: what a run will meet on this PC and at this cell. Each thing is measured and judged, with advice. It moves nothing."""

import os
import socket
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from typing import Any, TypedDict

from palpd.config import HEX_70, Config
from palpd.daemon.doctor.devices import DeviceRecord, identified, judge_probe, judge_robot, judge_sensor, observed, reached
from palpd.daemon.doctor.machine import examine_machine, is_there, port
from palpd.daemon.doctor.stored import examine_stored
from palpd.daemon.doctor.weight import AskOperator, check_weight
from palpd.daemon.finding import Finding, Judgement
from palpd.daemon.probe_record import probe_record
from palpd.daemon.realtime import DEVICE_PRIORITY, fifo
from palpd.daemon.stored_state import State
from palpd.errors import PalpdError
from palpd.tick import SensorDriver

RTDE_PORT = 30004
"""The controller's port of RTDE: a controller that accepts a connection there is switched on."""
PATIENCE_S = 1.0
"""Longest wait for that connection: a controller on the same cable answers within milliseconds."""


def examined(
    config: Config,
    open_sensor: Callable[[Config], SensorDriver],
    open_robot: Callable[[Config], Any],
    watch_s: float,
    weight_N: float | None,
    ask: AskOperator,
) -> list[Finding]:
    """Examine everything: the machine, the stored state, then the devices together, then the weight.

    Args:
        config: The configuration of the cell.
        open_robot: Opens the robot for reading.
        watch_s: How long the devices are observed.
        weight_N: A known weight that the operator hangs on the probe; None skips that.
        ask: Tells the operator what to do.

    Returns:
        All findings, in the order in which they were made.
    """
    findings = examined_without_devices(config)
    with ExitStack() as opened:
        is_path = config.sensor.port.startswith("/") or config.sensor.kind == HEX_70  # an address says itself that it is silent
        there = not is_path or is_there(config.sensor.port)
        sensor, about_sensor = _opened(opened, "sensor.port", config, open_sensor, there, config.sensor.port)
        robot, about_robot = _opened(opened, "robot.host", config, open_robot, _answers(config.robot.host), config.robot.host)
        record = observed(sensor, robot, watch_s)
        findings += [about_sensor, *judge_sensor(record, config, sensor), *_probe(record, config, sensor)] if sensor else [about_sensor]
        findings += [about_robot, *judge_robot(record, config)] if robot else [about_robot]
        if weight_N is not None and sensor is not None:
            findings.append(check_weight(sensor, record.last, config.sensor, weight_N, ask, sensor.pulled_over_pressed))
    return findings


def examined_without_devices(config: Config) -> list[Finding]:
    """Examine the machine, the stored state, and the sensor's port; nothing is opened.

    Args:
        config: The configuration of the cell.
    """
    return [*examine_machine(config), *examine_stored(config), *port(config.sensor.port)]


class Examination(TypedDict):
    """All findings, and the worst verdict of all."""

    verdict: Judgement
    findings: list[dict[str, object]]


def as_json(findings: Sequence[Finding]) -> Examination:
    """The findings with all their figures, as JSON."""
    verdicts = [finding.verdict for finding in findings]
    order: tuple[Judgement, ...] = ("fail", "warn", "ok")
    worst = next(verdict for verdict in order if verdict in verdicts)
    return {"verdict": worst, "findings": [asdict(finding) for finding in findings]}


def _opened(opened: ExitStack, key: str, config: Config, build: Callable[[Config], Any], there: bool, where: str) -> tuple[Any, Finding]:
    """Open a device until `opened` closes it. Returns None and a finding where it is absent or does not open."""
    name = key.split(".")[0]
    if not there:
        return None, Finding(name, "warn", f"absent: nothing at {where}", f"connect it, or correct {key}")
    urgent = fifo(DEVICE_PRIORITY)  # threads of the drivers inherit it, as in a run
    try:
        device = build(config)
    except PalpdError as error:
        return None, Finding(name, "fail", str(error))
    finally:
        if urgent:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    opened.callback(device.close)
    return device, identified(device, config) if name == "sensor" else reached(config)


def _probe(record: DeviceRecord, config: Config, sensor: SensorDriver) -> list[Finding]:
    """Whether the probe is free, as far as the state folder can be read; `examine_stored` says where it cannot."""
    try:
        return judge_probe(record, config, sensor, probe_record(config, State(config.paths.state)))[0]
    except PalpdError:
        return []


def _answers(host: str) -> bool:
    try:
        socket.create_connection((host, RTDE_PORT), PATIENCE_S).close()
    except (OSError, UnicodeError):  # a name that is none of a host fails in its encoding
        return False
    return True
