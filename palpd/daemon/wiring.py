"""The devices behind the loop: the real drivers, muted or not, and the emulators. Only this module and the CLI import hw."""

import time
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING

from hw.hex_sensor import HexSensor
from hw.muted import MutedRobot
from hw.rtde import UrReader, UrRobot, require_library
from palpd.config import Config
from palpd.daemon.motion_process import Devices
from palpd.recording.mcap_file import RunAbout

if TYPE_CHECKING:
    from hw.emulators.process import Emulated

ARRIVAL_MARGIN_S = 0.001
"""The grid of ticks begins this long after a robot state arrives, so that every tick finds a fresh one."""


def devices(config: Config, muted: bool) -> Devices:
    """Open sensor and robot of a configuration.

    Args:
        config: The configuration.
        muted: Whether the robot is only read and never commanded.

    Returns:
        The opened devices.

    Raises:
        DeviceError: A device is absent, busy, or not what was configured.
    """
    require_library()
    sensor = open_sensor(config)
    try:
        robot = open_reader(config) if muted else _robot(config)
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
    return Devices(MutedRobot(robot) if isinstance(robot, UrReader) else robot, sensor, first_tick_s, about)


def open_reader(config: Config) -> UrReader:
    """The robot of a configuration, read only. Raises RobotError."""
    return UrReader(config.robot.host, model=config.robot.model, rate_Hz=config.robot.rate_Hz)


def _robot(config: Config) -> UrRobot:
    robot = config.robot
    return UrRobot(
        robot.host,
        model=robot.model,
        rate_Hz=robot.rate_Hz,
        watchdog_Hz=robot.watchdog_Hz,
        acceleration_m_per_s2=robot.acceleration_m_per_s2,
        tcp=robot.tcp,
    )


def open_sensor(config: Config) -> HexSensor:
    """The force sensor of a configuration. Raises SensorError."""
    sensor = config.sensor
    return HexSensor(
        sensor.port,
        rate_Hz=sensor.rate_Hz,
        filter_cutoff_Hz=sensor.filter_cutoff_Hz,
        counts_per_N=sensor.counts_per_N,
        counts_per_Nm=sensor.counts_per_Nm,
        fz_slopes=sensor.fz_slopes,
        fz_pulled_counts_per_N=sensor.fz_pulled_counts_per_N,
    )


def emulated(folder: Path, model: str, cell: Path, host: str, effects: Path | None = None) -> "AbstractContextManager[Emulated]":
    """Emulate a UR controller and a HEX-70 in a process of their own within the context.

    Args:
        folder: Folder for the links and sockets.
        model: ur5 or ur5e.
        cell: Cell file of what the arm presses.
        host: Address that the controller listens on.
        effects: Python file with a user's effects that the cell file names.

    Returns:
        The context; it yields the addresses of both devices.
    """
    from hw.emulators.process import started  # imported here, because the motion process needs no physics

    return started(folder, model, cell, host, *(["--effects", str(effects)] if effects else []))
