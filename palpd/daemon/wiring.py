"""The devices behind the loop: the drivers that the configuration names, and the emulators. Only this module and the CLI know hw."""

import time
from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from hw.muted import MutedRobot
from palpd.config import Config
from palpd.daemon.devices import ControllerReader, Devices
from palpd.documents import nearest
from palpd.errors import ConfigError
from palpd.plugins import Plugin, plugins
from palpd.recording.header import RunAbout
from palpd.tick import Robot, RobotKind, SensorDriver, SensorKind, StateReader

if TYPE_CHECKING:
    from hw.emulators.process import Emulated
    from hw.rtde import ControllerAbout

SENSORS = {"hex-70": "hw.hex_sensor:open_hex_70", "ati-net-ft": "hw.ati_net_ft:open_ati_net_ft"}
ROBOTS = {"ur-rtde": "hw.rtde:UR_RTDE"}
"""Our own drivers. Those of other packages are entry points of `palpd.sensors` and `palpd.robots`."""
ARRIVAL_MARGIN_S = 0.001
"""The grid of ticks begins this long after a robot state arrives, so that every tick finds a fresh one."""

CONTROLLER_RATE_HZ = 25.0
"""Rate at which a controller is read after a stop: for people, and cheap for this computer and the controller."""


def devices(config: Config, muted: bool) -> Devices:
    """Open sensor and robot of a configuration.

    Args:
        muted: Whether the robot is only read and never commanded.

    Returns:
        The opened devices.

    Raises:
        BadInput: There is no driver of that name, or it cannot be used.
        DeviceError: A device is absent, busy, or not what was configured.
    """
    kind = robot_kind(config)
    kind.require()
    sensor = open_sensor(config)
    try:
        robot: Robot = MutedRobot(kind.open_reader(config.robot)) if muted else kind.open(config.robot)
    except BaseException:
        sensor.close()
        raise
    state = robot.read()
    period_s = 1.0 / config.robot.rate_Hz
    soon_s = time.monotonic() + 0.05
    cycles = (soon_s - state.t_s) // period_s + 1
    first_tick_s = state.t_s + cycles * period_s + ARRIVAL_MARGIN_S
    about: RunAbout = {
        "robot_host": config.robot.host,
        "robot_model": config.robot.model,
        "sensor_serial": sensor.serial_number,
        "sensor_port": config.sensor.port,
        "counts_per_N": sensor.counts_per_N.tolist(),
        "counts_per_Nm": sensor.counts_per_Nm.tolist(),
        "calibration_source": sensor.calibration_source,
        "pulled_over_pressed": sensor.pulled_over_pressed,
        "delay_s": sensor.delay_s,
        "epoch_offset_s": time.time() - time.monotonic(),
    }
    return Devices(robot, sensor, first_tick_s, about, kind.takes_programs(config.robot) if muted else None)


def open_reader(config: Config) -> StateReader:
    """The robot of a configuration, read only. Raises BadInput or RobotError."""
    kind = robot_kind(config)
    kind.require()
    return kind.open_reader(config.robot)


def open_controller(config: Config) -> ControllerReader:
    """What reads the robot's controller after a stop. Raises BadInput or RobotError."""
    slow = config.model_copy(update={"robot": config.robot.model_copy(update={"rate_Hz": min(config.robot.rate_Hz, CONTROLLER_RATE_HZ)})})
    kind = robot_kind(slow)
    return ControllerReader(open_reader(slow), lambda: kind.takes_programs(slow.robot))


def open_sensor(config: Config) -> SensorDriver:
    """The force sensor of a configuration. Raises BadInput or SensorError."""
    return sensor_kind(config)(config.sensor)


def controller_about(host: str) -> "ControllerAbout":
    """What a UR controller says of itself; nothing moves. Raises RobotError."""
    from hw.rtde import controller_about as asked

    return asked(host)


def tool_offset(config: Config) -> tuple[float, ...]:
    """Pose (6,) of the UR's active TCP in axes of the flange, m and rad. Its control script is started for that; nothing moves.

    Raises:
        RobotError: The controller cannot be reached, is not ready, or has another master.
    """
    from hw.rtde import UR_RTDE

    robot: Any = UR_RTDE.open(config.robot)
    try:
        offset: tuple[float, ...] = robot.tool_offset()
        return offset
    finally:
        robot.close()


def sensor_kind(config: Config) -> SensorKind:
    """What opens the sensors of `sensor.kind`. Raises BadInput where no package brings it, or it cannot be used."""
    plugin = _named("sensor.kind", config.sensor.kind, "palpd.sensors", SENSORS)
    opens = plugin.load()
    if not callable(opens):
        raise ConfigError(plugin.failure("it cannot be called, expected a function that opens a sensor"))
    return cast(SensorKind, opens)


def robot_kind(config: Config) -> RobotKind:
    """What opens the robots of `robot.kind`. Raises BadInput where no package brings it, or it cannot be used."""
    plugin = _named("robot.kind", config.robot.kind, "palpd.robots", ROBOTS)
    kind: Any = plugin.load()
    if not isinstance(kind, RobotKind):
        raise ConfigError(plugin.failure(f"it is a {type(kind).__name__}, expected a palpd.tick.RobotKind"))
    return kind


def _named(key: str, name: str, group: str, ours: Mapping[str, str]) -> Plugin:
    if name in ours:
        return Plugin(group, name, ours[name])
    known = plugins(group, ours)
    if name not in known:
        near = nearest(name, list(known))
        raise ConfigError(
            f"{key} is {name!r}{near}; known are {', '.join(sorted(known))}; install the package that brings another, or write a driver "
            "(docs/sensors.md)"
        )
    return known[name]


def emulated(folder: Path, model: str, cell: Path, host: str, effects: Path | None = None) -> "AbstractContextManager[Emulated]":
    """Emulate a UR controller and a HEX-70 in a process of their own within the context.

    Args:
        folder: Folder for the links and sockets.
        model: ur5 or ur5e.
        cell: Cell file of what the arm presses.
        host: Address that the controller listens on.
        effects: Python file with a user's effects that the cell file names; None: it names none.

    Returns:
        The context; it yields the addresses of both devices.
    """
    from hw.emulators.process import started  # imported here, because the motion process needs no physics

    return started(folder, model, cell, host, *(["--effects", str(effects)] if effects else []))
