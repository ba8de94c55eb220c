"""A robot that is read and never commanded: the dry run on the real cell."""

from typing import Protocol

from palpd.tick import RobotState


class Reader(Protocol):
    """What can show a robot's state."""

    def read(self) -> RobotState: ...

    def close(self) -> None: ...


class MutedRobot:
    """Shows what `reader` sees; a command goes nowhere.

    Given a reader that owns no control connection, nothing in the process could move the arm.
    """

    def __init__(self, reader: Reader) -> None:
        self._reader = reader

    def read(self) -> RobotState:
        """Newest state of the real robot."""
        return self._reader.read()

    def move(self, velocity_m_per_s: tuple[float, float, float]) -> None:
        """Command nothing."""

    def stop(self) -> None:
        """Command nothing."""

    def close(self) -> None:
        """Let go of the reader."""
        self._reader.close()
