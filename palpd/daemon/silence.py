"""Which of two it was: a device was silent, or this computer stood still. The guard knows only how old the newest data was."""

from collections.abc import Sequence

from palpd.daemon.witness import Witness, stood_still
from palpd.recording.header import RecordedTrip
from palpd.tick import Trip

DEVICES = {Trip.SENSOR_STALE.name: "the sensor", Trip.ROBOT_STALE.name: "the robot"}
"""Trips that say how old a device's newest data was."""
STARVED = (Trip.PROGRAM_STOPPED.name, Trip.CONNECTION.name, Trip.DEVICE.name)
"""Trips that a computer that stands still can cause: the controller hears no command, and its watchdog ends the program."""
JUST_BEFORE_S = 0.5
"""How long before such a trip a stall may have been its cause: ten times the watchdog's patience."""


def explained(trips: Sequence[RecordedTrip], at_s: float, period_s: float, witness: Witness) -> str:
    """Say of a run that ended for missing data or ticks what was silent.

    Args:
        trips: The guard's verdicts, as they are reported.
        at_s: Time of the last tick.
        witness: The witness of this computer, after it was heard.

    Returns:
        A clause that follows the reason; empty where there is nothing to say.
    """
    clauses = [_of_trip(trip, at_s, period_s, witness) for trip in trips]
    return "".join(f"; {clause}" for clause in dict.fromkeys(clauses) if clause)


def _of_trip(trip: RecordedTrip, at_s: float, period_s: float, witness: Witness) -> str:
    name, stalls = trip["trip"], witness.stalls
    if name in STARVED:
        stood_s, processors = stood_still(stalls, at_s - JUST_BEFORE_S, at_s)
        return f"{_still(stood_s, processors, witness)} just before" if stood_s else ""
    if not witness.processors:
        return ""
    if name in DEVICES:
        silent_s = trip["measured"]
        stood_s, processors = stood_still(stalls, at_s - silent_s, at_s)
        silence = f"{DEVICES[name]} was silent for {silent_s * 1e3:.0f} ms"
        if not stood_s:
            return f"{silence} while this computer ran"
        still = _still(stood_s, processors, witness)
        return f"{still} of these {silent_s * 1e3:.0f} ms" if silent_s - stood_s <= trip["limit"] else f"{silence}, and {still} of them"
    if name == Trip.LATE_TICKS.name:
        held_up_s = trip["measured"] * period_s
        stood_s, processors = stood_still(stalls, at_s - held_up_s - period_s, at_s)
        if not stood_s:
            return f"the motion process was held up for {held_up_s * 1e3:.0f} ms while this computer ran"
        return f"{_still(stood_s, processors, witness)}"
    return ""


def _still(stood_s: float, processors: list[int], witness: Witness) -> str:
    """Name what stood still, all of this computer or some of its processors, and for how long."""
    if len(processors) >= witness.processors:
        what = "this computer"
    else:
        what = f"processor {processors[0]} of this computer" if len(processors) == 1 else f"{len(processors)} processors of this computer"
    how = "stood still" if witness.urgent else "stood still or did other work"
    return f"{what} {how} for {stood_s * 1e3:.0f} ms"
