"""The way back after a stop of the robot: what the controller says, the next step at its pendant, and how palpd sees that it is done.

One table, `ROBOT_STOPS`, in the words that page, terminal and refusals share. palpd only reads: it sends the controller no unlock, no power
and no brake command, because UR forbids the automatic reset of a protective stop.

A protective stop within a minute after the one before asks for its cause: nothing is armed before an operator has written it down.
"""

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

from pydantic import AfterValidator

from palpd.errors import BadInput
from palpd.tick import RobotMode, SafetyMode

AGAIN_S = 60.0
"""A protective stop that comes this soon after the end of the one before has the same cause, which nobody has removed."""
MOST_KEPT = 20
"""Number of protective stops that are remembered: those of a bad day."""
LONGEST_CAUSE = 500
"""Most letters of a cause: some sentences in the status and the log."""
PROGRAM_STOPPED, PROGRAM_STOPPING = 1, 0
"""`runtime_state` of a controller whose program cannot go on."""

StopName = Literal[
    "link_lost", "starting", "fault", "emergency_stop", "system_emergency_stop", "safeguard_program", "safeguard_stop", "recovery",
    "protective_stop", "other_safety", "power_off", "powering", "brakes", "freedrive", "other_mode", "local", "program",
]  # fmt: skip


@dataclass(frozen=True, slots=True)
class RobotStop:
    """A state of the controller in which palpd may not move the arm.

    Attributes:
        word: The state in two or three words.
        says: What the controller says, as a clause without a capital and a full stop.
        step: The next step at the pendant.
        done: How palpd sees that the step is done.
    """

    word: str
    says: str
    step: str
    done: str

    @property
    def reason(self) -> str:
        """What stands against a motion, and the way out, as one clause."""
        return f"{self.says}; at the pendant: {self.step}"


@dataclass(frozen=True, slots=True)
class ControllerSeen:
    """What the controller said when it was last read: the codes of RTDE.

    Attributes:
        connected: Whether states arrive; the others mean nothing where they do not.
        takes_programs: Whether it takes programs from this computer; None where it has no such mode, or does not say.
        reason: Why no state arrives.
    """

    connected: bool = True
    robot_mode: int = RobotMode.RUNNING
    safety_mode: int = SafetyMode.NORMAL
    runtime_state: int = PROGRAM_STOPPED
    takes_programs: bool | None = None
    reason: str = ""


NORMAL_SAFETY = "its safety mode is NORMAL or REDUCED"
ROBOT_STOPS: Mapping[StopName, RobotStop] = {
    "link_lost": RobotStop(
        "No controller", "no state comes from the controller", "check the network cable, and that the controller is on",
        "its states arrive again",
    ),
    "starting": RobotStop(
        "Controller starts", "the controller starts", "wait, and confirm the safety configuration where the screen asks for it",
        "its robot mode is POWER_OFF, or a later one",
    ),
    "fault": RobotStop(
        "Safety fault", "the controller reports a violation or a fault of its safety system",
        "read the message, and restart the safety system with its button; call the service of the maker where it comes again",
        NORMAL_SAFETY,
    ),
    "emergency_stop": RobotStop(
        "Emergency stop", "the emergency stop of the robot is pressed",
        "make sure that the danger is over, then turn the emergency stop button until it comes out", NORMAL_SAFETY,
    ),
    "system_emergency_stop": RobotStop(
        "Emergency stop", "the emergency stop of the system around the robot is active",
        "make sure that the danger is over, then release the emergency stop where it was pressed", NORMAL_SAFETY,
    ),
    "safeguard_program": RobotStop(
        "Safeguard stop", "a safeguard is open, and a program is paused that may go on when it closes",
        "press Stop for the program, before you close the safeguard", "its runtime state is STOPPED",
    ),
    "safeguard_stop": RobotStop(
        "Safeguard stop", "a safeguard is open", "close the safeguard, and press its reset button where it has one", NORMAL_SAFETY,
    ),
    "recovery": RobotStop(
        "Recovery mode", "a joint is outside its safety limits", "move the arm back inside its limits by hand", NORMAL_SAFETY,
    ),
    "protective_stop": RobotStop(
        "Protective stop", "the controller reports a protective stop",
        "read its message, remove what the arm pushes against, wait 5 s, then press Enable Robot", NORMAL_SAFETY,
    ),
    "other_safety": RobotStop(
        "Not safe to move", "the controller reports a safety mode that is not known here", "read the message, and do what it says",
        NORMAL_SAFETY,
    ),
    "power_off": RobotStop(
        "Power off", "the arm has no power", "press ON on the initialisation screen", "its robot mode is IDLE",
    ),
    "powering": RobotStop("Power comes", "the arm is being powered", "wait until it is idle", "its robot mode is IDLE"),
    "brakes": RobotStop(
        "Brakes on", "the arm has power, and its brakes are on", "keep clear of the arm, and press START, which releases the brakes",
        "its robot mode is RUNNING",
    ),
    "freedrive": RobotStop("Freedrive", "the arm is moved by hand", "let go of the freedrive button", "its robot mode is RUNNING"),
    "other_mode": RobotStop(
        "Not ready", "the controller reports a robot mode in which the arm cannot move", "read the message, and do what it says",
        "its robot mode is RUNNING",
    ),
    "local": RobotStop(
        "Local control", "the controller is in local control and takes no program from this computer",
        "switch to remote control, at the top right of the screen", "its dashboard says that it is in remote control",
    ),
    "program": RobotStop(
        "Program there", "a program plays or is paused on the controller", "press Stop, so that it cannot go on",
        "its runtime state is STOPPED",
    ),
}  # fmt: skip
"""All of them, the most urgent first: the order in which an operator meets them."""

_SAFETY: Mapping[int, StopName] = {
    SafetyMode.VIOLATION: "fault",
    SafetyMode.FAULT: "fault",
    SafetyMode.ROBOT_EMERGENCY_STOP: "emergency_stop",
    SafetyMode.SYSTEM_EMERGENCY_STOP: "system_emergency_stop",
    SafetyMode.RECOVERY: "recovery",
    SafetyMode.PROTECTIVE_STOP: "protective_stop",
}
_POWER: Mapping[int, StopName] = {
    RobotMode.POWER_OFF: "power_off",
    RobotMode.POWER_ON: "powering",
    RobotMode.IDLE: "brakes",
    RobotMode.BACKDRIVE: "freedrive",
    RobotMode.UPDATING_FIRMWARE: "other_mode",
}


def stop_of(seen: ControllerSeen) -> StopName | None:
    """What stands against a motion by what the controller says; None where nothing does."""
    loaded = seen.runtime_state not in (PROGRAM_STOPPED, PROGRAM_STOPPING)
    if not seen.connected:
        return "link_lost"
    if seen.robot_mode < RobotMode.POWER_OFF:
        return "starting"
    if seen.safety_mode == SafetyMode.SAFEGUARD_STOP:
        return "safeguard_program" if loaded else "safeguard_stop"
    if seen.safety_mode not in (SafetyMode.NORMAL, SafetyMode.REDUCED):
        return _SAFETY.get(seen.safety_mode, "other_safety")
    if seen.robot_mode != RobotMode.RUNNING:
        return _POWER.get(seen.robot_mode, "other_mode")
    if seen.takes_programs is False:
        return "local"
    return "program" if loaded else None


# --- protective stops, and what caused them -------------------------------------------------------------------------------------


def _dated(date: str) -> str:
    """The date; ValueError where it is none or has no time zone, which pydantic turns into a fault of the file."""
    if datetime.datetime.fromisoformat(date).tzinfo is None:
        raise ValueError("no time zone")
    return date


Date = Annotated[str, AfterValidator(_dated)]
"""Date and time with time zone, ISO 8601."""


@dataclass(frozen=True, slots=True)
class ProtectiveStop:
    """A protective stop, dates in ISO 8601: when it was seen, when its end was seen (empty: it was not), and its cause as `by` wrote it."""

    date: Date
    over: Date | Literal[""] = ""
    cause: str = ""
    by: str = ""
    written: str = ""


@dataclass(frozen=True, slots=True)
class ProtectiveStops:
    """The last protective stops of this robot, the newest last. `damaged` says that they could not be read: then a cause is asked for."""

    stops: tuple[ProtectiveStop, ...] = ()
    damaged: str = ""

    def begin(self, date: str, moved: bool) -> "ProtectiveStops":
        """Note that a protective stop was seen.

        Args:
            date: When.
            moved: Whether the arm could move just before. If not, the stop before may still stand, and is not counted twice.
        """
        if self.stops and not self.stops[-1].over and not moved:
            return self
        return replace(self, stops=(*self.stops, ProtectiveStop(date))[-MOST_KEPT:])

    def end(self, date: str) -> "ProtectiveStops":
        """Note that the controller was seen without a protective stop."""
        if not self.stops or self.stops[-1].over:
            return self
        return replace(self, stops=(*self.stops[:-1], replace(self.stops[-1], over=date)))

    @property
    def cause_asked(self) -> str:
        """Why the cause of the newest one must be written down before anything is armed; empty where it need not."""
        if self.damaged:
            return self.damaged
        if len(self.stops) < 2 or self.stops[-1].cause:
            return ""
        before, newest = self.stops[-2:]
        if _seconds(before.over or before.date, newest.date) > AGAIN_S:
            return ""
        return f"a protective stop came within {AGAIN_S:g} s after the one before, so its cause must be written down"

    def with_cause(self, cause: object, by: str, date: str) -> "ProtectiveStops":
        """Write down the cause of the newest one.

        Args:
            cause: The operator's words.
            by: Who wrote them.
            date: When.

        Raises:
            BadInput: There are no words, too many, or no protective stop.
        """
        if not isinstance(cause, str) or not cause.strip() or len(cause) > LONGEST_CAUSE or not cause.isprintable():
            raise BadInput(
                f"a cause has 1 to {LONGEST_CAUSE} printable letters in one line; say what the arm pushed against, or what was loose"
            )
        if not self.stops and not self.damaged:
            raise BadInput("no protective stop is known whose cause could be written down; leave --cause out")
        newest = self.stops[-1] if self.stops else ProtectiveStop(date, over=date)
        return ProtectiveStops((*self.stops[:-1], replace(newest, cause=cause.strip(), by=by, written=date)))


def protective(trips: Sequence[Mapping[str, object]]) -> bool:
    """Whether a protective stop is among the guard's verdicts, as they are reported."""
    return any(trip["trip"] == "SAFETY_MODE" and trip["measured"] == SafetyMode.PROTECTIVE_STOP for trip in trips)


def _seconds(begin: str, end: str) -> float:
    return (datetime.datetime.fromisoformat(end) - datetime.datetime.fromisoformat(begin)).total_seconds()
