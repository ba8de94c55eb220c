"""What the service knows of its cell between two runs."""

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from palpd.control.plan_place import PlanPlace, question
from palpd.control.probe_state import ContactMarker, ProbeAnswer, ProbeState
from palpd.daemon.robot_stops import ControllerSeen, ProtectiveStops
from palpd.daemon.socket_client import KnownPlace, KnownProbe, KnownProtectiveStop
from palpd.daemon.stored_state import Latch, State, now
from palpd.daemon.supervisor import Report
from palpd.errors import ConfigError, Refused
from palpd.tick import SafetyMode

Kept = TypeVar("Kept")
SHOWN_STOPS = 5
"""Number of protective stops in the status."""


class KnownCell:
    """The stop that nobody has cleared, what was last seen of the probe and of the tip, and how the last run ended.

    `pose` (6,) is that of the tip, empty until it was seen; `last` is None before the first run.
    """

    def __init__(self, state: State) -> None:
        self._state = state
        self.last: Report | None = None
        self.pose: tuple[float, ...] = ()
        self._probe: tuple[ProbeAnswer, str] | None = None
        self._marker: ContactMarker | None = None  # as it was then
        self._unkept: Latch | None = None

    def note(self, report: Report, newest: np.void | None) -> None:
        """Keep what a run or a check has seen.

        Args:
            report: How it ended.
            newest: Its last tick; None where it sent none.
        """
        if newest is not None:
            self.pose = tuple(map(float, newest["tcp_pose"]))
        if report.probe is not None:
            self._probe, self._marker = (report.probe, now()), _kept(self._state.marker)

    def hold(self, reason: str) -> None:
        """Latch a stop whose latch could not be written: it holds until it is cleared, or this process ends."""
        self._unkept = Latch(reason, now())

    @property
    def latch(self) -> Latch | None:
        """The stop that nobody has cleared."""
        return self._unkept or self._state.latch()

    def clear(self, cause: object, by: str) -> None:
        """Forget the stop, for an operator, who writes down the cause of a protective stop with it.

        Args:
            cause: The operator's words; None: none.
            by: Who the operator is.

        Raises:
            BadInput: The cause is none, or none is to be written down.
            Refused: A cause is asked for, or a file of the state folder cannot be written.
        """
        if cause is not None:
            self.write_cause(cause, by)
        elif asked := self.protective_stops.cause_asked:
            raise Refused(f"{asked}; palpd clear --cause TEXT does it")
        self._unkept = None
        self._state.clear_latch()

    def see_controller(self, seen: ControllerSeen) -> bool:
        """Note whether the controller is in a protective stop. Returns whether one has begun."""
        if not seen.connected:
            return False
        kept = self._state.protective_stops()
        stands = seen.safety_mode == SafetyMode.PROTECTIVE_STOP
        changed = kept.begin(now(), moved=False) if stands else kept.end(now())
        if changed == kept or kept.damaged:
            return False
        self._state.keep("protective", changed)
        return stands

    def write_cause(self, cause: object, by: str) -> None:
        """Write down the cause of the last protective stop, for an operator. Raises BadInput and Refused."""
        self._state.keep("protective", self._state.protective_stops().with_cause(cause, by, now()))

    @property
    def protective_stops(self) -> ProtectiveStops:
        """The last protective stops of the robot."""
        return self._state.protective_stops()

    @property
    def protective(self) -> list[KnownProtectiveStop]:
        """The newest of them as the status holds them, the newest first."""
        newest = self.protective_stops.stops[: -SHOWN_STOPS - 1 : -1]
        return [KnownProtectiveStop(date=each.date, over=each.over, cause=each.cause, by=each.by, written=each.written) for each in newest]

    @property
    def probe(self) -> tuple[ProbeAnswer, str] | None:
        """The last answer about the probe with its date.

        What the state folder says counts where this service has not looked yet, or where a run has begun or freed the probe since.
        """
        try:
            marker = self._state.marker()
        except ConfigError as error:
            return ProbeAnswer(ProbeState.UNKNOWN, (str(error),), frozenset()), now()
        if self._probe is not None and marker == self._marker:
            return self._probe
        if marker is None:
            return None
        return ProbeAnswer(ProbeState.UNKNOWN, (f"the {marker.run} of {marker.date} is unfinished",), frozenset(("retract",))), marker.date

    @property
    def tared(self) -> bool:
        """Whether there is a reference tare."""
        return _kept(self._state.calibration) is not None

    @property
    def unfinished(self) -> bool:
        """Whether a contact is unfinished."""
        return self._state.holds("contact")

    @property
    def question(self) -> str | None:
        """Why a start must say first where its sites count from; None where it need not, or the tip was not seen."""
        return question(self._last_place, self.pose[0], self.pose[1], None) if self.pose else None

    @property
    def place(self) -> KnownPlace | None:
        """Where the tip was last seen, over which site of the last plan, and where its sites count from."""
        last = self._last_place
        if not self.pose and last is None:
            return None
        x_m, y_m = self.pose[:2] if self.pose else (None, None)
        return KnownPlace(
            x_m=x_m,
            y_m=y_m,
            site=last.site_under(x_m, y_m) if last is not None and x_m is not None and y_m is not None else None,
            origin_m=list(last.origin_m) if last is not None else None,
            unfinished=last.run if last is not None and not last.returned else None,
        )

    @property
    def _last_place(self) -> PlanPlace | None:
        return _kept(self._state.place)


def known_probe(answer: ProbeAnswer, date: str) -> KnownProbe:
    """Write an answer about the probe as the status holds it.

    Args:
        answer: What is known of the probe.
        date: When it was given, ISO 8601.

    Returns:
        The entry `probe` of the status.
    """
    return KnownProbe(state=answer.state.value, reasons=list(answer.reasons), ways=sorted(answer.ways), date=date, advice=answer.advice)


def _kept(read: Callable[[], Kept]) -> Kept | None:
    """What a file of the state folder holds; None where it is damaged: whoever needs it then says so, and the status goes on."""
    try:
        return read()
    except ConfigError:
        return None
