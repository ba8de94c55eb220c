"""A robot that is read and never commanded: the dry run on the real cell."""

from palpd.tick import RobotState, StateReader, UncommandedRobot


class MutedRobot(UncommandedRobot):
    """Shows the states of `reader` and drops every command.

    With a reader that owns no control connection, no part of the process can move the arm.
    """

    def __init__(self, reader: StateReader) -> None:
        self._reader = reader

    def read(self) -> RobotState:
        """Return the newest state of the real robot."""
        return self._reader.read()
