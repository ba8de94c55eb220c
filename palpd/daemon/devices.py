"""The robot and the sensor that stand behind the loop, opened."""

import time
from collections.abc import Callable
from dataclasses import dataclass

from palpd.config import Config
from palpd.recording.header import RunAbout
from palpd.tick import ForceSensor, Robot, SensorDriver, StateReader

DRAIN_S = 0.1
"""How long queued frames are read and dropped. A terminal hands out 4 kB at a time, so several reads are needed."""


@dataclass(frozen=True, slots=True)
class Devices:
    """An opened robot and sensor. `first_tick_s` is just after the arrival of a robot state; `about` goes into the recording.

    `takes_programs` is that of `ControllerSeen`; a robot that may move was not asked, since it has taken one.
    """

    robot: Robot
    sensor: SensorDriver
    first_tick_s: float
    about: RunAbout
    takes_programs: bool | None = None


Build = Callable[[Config, bool], Devices]
"""Opens what stands behind the loop; the flag mutes the robot. It must be importable, because the motion process is spawned."""


@dataclass(frozen=True, slots=True)
class ControllerReader:
    """A controller that is read and cannot be commanded; `takes_programs` asks it what `ControllerSeen` holds."""

    robot: StateReader
    takes_programs: Callable[[], bool | None]


OpenController = Callable[[Config], ControllerReader]
"""Opens a controller for reading, or raises PalpdError. It must be importable, because the reading process is spawned."""


def drain(sensor: ForceSensor) -> None:
    """Read and drop the queued frames: they are too old, and a terminal hands out 4 kB at a time, which is 0.25 s of frames."""
    until_s = time.monotonic() + DRAIN_S
    while time.monotonic() < until_s:
        sensor.read()
        time.sleep(0.001)
