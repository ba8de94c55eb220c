"""How long a controller takes to stop the arm when this PC falls silent, measured on the way up of the level test."""

import numpy as np

from palpd.config import Config
from palpd.daemon.devices import Devices
from palpd.daemon.wiring import devices
from palpd.recording.ring import Rows
from palpd.tick import PROGRAM_PLAYING, Robot, RobotState

SPOKEN_S = 0.4
"""How long speeds upwards are passed on before the silence: the tip reaches its 5 mm/s in it, and less than half of its way."""
SILENT_S = 0.5
"""Length of the silence: longer than the slowest watchdog. Afterwards the loop has the arm again, whatever the controller did."""


class SilentRobot:
    """Passes everything on, but for the speeds of half a second on the way up, counted in ticks. A stop always passes."""

    def __init__(self, robot: Robot, rate_Hz: float) -> None:
        self._robot, self._rate_Hz = robot, rate_Hz
        self._ticks = 0  # since the first speed upwards

    def read(self) -> RobotState:
        """Return the newest state."""
        return self._robot.read()

    def move(self, velocity_m_per_s: tuple[float, float, float]) -> None:
        """Command a speed, except within the silence."""
        self._ticks += self._ticks > 0 or velocity_m_per_s[2] > 0.0
        if not SPOKEN_S * self._rate_Hz < self._ticks <= (SPOKEN_S + SILENT_S) * self._rate_Hz:
            self._robot.move(velocity_m_per_s)

    def stop(self) -> None:
        """Bring the tip to rest."""
        self._robot.stop()

    def end(self) -> None:
        """Bring the tip to rest and end what runs on the controller."""
        self._robot.end()


def silent_devices(config: Config, muted: bool) -> Devices:
    """The devices of a configuration with a robot that falls silent on its way up. Raises as `wiring.devices`."""
    opened = devices(config, muted)
    return Devices(SilentRobot(opened.robot, config.robot.rate_Hz), opened.sensor, opened.first_tick_s, opened.about)


def stopped_after_s(rows: Rows, rate_Hz: float) -> float | None:
    """Time from the last speed that went out to the first state of the stopped program; None where it was not stopped.

    Args:
        rows: The ticks of the run.
        rate_Hz: Rate of the loop.
    """
    up = np.flatnonzero(rows["command_m_per_s"][:, 2] > 0.0)
    last = (up[0] if len(up) else len(rows)) + int(SPOKEN_S * rate_Hz) - 1
    stopped = np.flatnonzero(rows["runtime_state"] != PROGRAM_PLAYING)
    stopped = stopped[stopped > last]
    if not len(stopped):
        return None
    sent_s = rows["now_s"][last] + 1e-6 * rows["work_us"][last + 1]  # a speed goes out at the end of its tick
    return float(rows["robot_t_s"][stopped[0]] - sent_s)
