"""What may be done now, why not, and what is sensible next: one pure function, `what_now`.

`Standing` is all that the service knows, frozen. `Now` is the answer: the state in a word, a sentence, the next button, and an `Obstacle`
for each button that is impossible. The service refuses by it and publishes it, so page, terminal and refusals never disagree.

An obstacle is a fact. Its `way` is the button that leads out: the page shows the button's name, the terminal the command (`as_refusal`).

What was seen of the probe may be old: somebody may have moved the arm since. So the requests of `LOOKS`, which look at the devices before
they do anything, are judged without it. The others wait for a new look (Check, `palpd doctor`).

What the controller says after a stop is read all the time, so it counts for all: what to do at the pendant comes first (`robot_stops`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

from palpd.control.probe_state import ProbeAnswer, ProbeState
from palpd.daemon.motion_job import Kind
from palpd.daemon.robot_stops import ROBOT_STOPS, StopName
from palpd.daemon.socket_client import KnownNow, KnownObstacle, KnownStop
from palpd.tick import Phase

Action = Literal["check", "arm", "start", "pause", "resume", "retract", "level-test", "calibrate", "clear", "decide", "recover"]
"""The buttons, but for the abort, which is always possible. `start` stands for every program that moves the arm."""
ACTIONS: tuple[Action, ...] = get_args(Action)
LOOKS: tuple[Action, ...] = ("check", "arm", "calibrate", "retract")
"""What looks at robot and sensor before it does anything."""
PAUSES: tuple[Kind, ...] = ("palpation", "free_motion", "stiffness")
"""Runs that can pause."""
GOES_UP: tuple[Kind, ...] = ("retract", "level_test")
READS: Mapping[Kind, str] = {"calibrate": "The reference tare is taken", "observe": "Robot and sensor are watched"}

MOVES_OR_FOLLOWS: tuple[Action, ...] = ("arm", "start", "retract", "level-test", "clear")
"""What waits for the steps at the pendant: motions, and the acknowledgement that they are done."""

State = Literal[
    "checking", "waiting", "paused", "running", "robot", "latched", "pressed", "untared", "unknown", "unready", "armed", "disarmed"
]
WORDS: Mapping[State, str] = {
    "checking": "Checking",
    "waiting": "Waiting for you",
    "paused": "Paused",
    "running": "Running",
    "robot": "Robot stopped",
    "latched": "Stopped",
    "pressed": "In the tissue",
    "untared": "No reference",
    "unknown": "Probe unknown",
    "unready": "Not ready",
    "armed": "Armed",
    "disarmed": "Disarmed",
}
COMMANDS: Mapping[Action | Literal["abort"], str] = {
    "check": "palpd doctor looks again",
    "arm": "run palpd arm first",
    "start": "palpd start begins",
    "pause": "palpd pause leaves the tissue",
    "resume": "palpd resume goes on",
    "retract": "palpd retract leaves the tissue",
    "level-test": "palpd level-test goes 5 mm up and tells",
    "calibrate": "run palpd calibrate with the probe free and still",
    "clear": "look at the cell, then palpd clear",
    "decide": "palpd job ID --agree or --decline answers it",
    "recover": "palpd recover restores it",
    "abort": "wait for its end, or palpd abort",
}
"""What the terminal says of a way out."""


@dataclass(frozen=True, slots=True)
class Obstacle:
    """Why something is impossible now, and the button that leads out; None where only time or hands do."""

    reason: str
    way: Action | Literal["abort"] | None = None

    @property
    def as_refusal(self) -> str:
        """One sentence for the terminal."""
        return f"{self.reason}; {COMMANDS[self.way]}" if self.way is not None else self.reason


@dataclass(frozen=True, slots=True)
class Standing:
    """Where everything stands; None for what there is not.

    Attributes:
        armed: Whether the next start moves the arm.
        arming: Whether an arm waits for its check.
        run: Kind of the run under way; a check of the devices is one.
        phase: Of the run's newest tick.
        site: Name of the site that the run is at.
        force_N: Contact force of the newest tick.
        depth_m: Depth of the tip below the surface; None where that is not known.
        job: Id of the job under way, also between its runs.
        activity: What the worker of the job says that it does.
        proposal: Whether the job proposes a motion and waits.
        pause_asked: Whether a pause was asked for and not resumed.
        pause_pending: Whether a pause or a resume waits for its effect.
        latch: Date and reason of the stop that nobody has cleared.
        reference: Whether there is a reference tare.
        unfinished: Whether a contact is unfinished.
        probe: The last answer about the probe.
        fault: Why the last check found the devices not ready.
        question: Why a start must say first where its sites count from.
        last: How the last run ended, where it was not done.
        stop: What the controller says where the arm may not move.
        stop_reason: Why no state comes from the controller.
        cause: Why a clear must write down the cause of a protective stop; empty where it need not.
    """

    armed: bool = False
    arming: bool = False
    run: Kind | None = None
    phase: Phase | None = None
    site: str | None = None
    force_N: float = 0.0
    depth_m: float | None = None
    job: str | None = None
    activity: str = ""
    proposal: bool = False
    pause_asked: bool = False
    pause_pending: bool = False
    latch: tuple[str, str] | None = None
    reference: bool = False
    unfinished: bool = False
    probe: ProbeAnswer | None = None
    fault: str = ""
    question: str | None = None
    last: str = ""
    stop: StopName | None = None
    stop_reason: str = ""
    cause: str = ""

    @property
    def checking(self) -> bool:
        """Whether the devices are being checked for an arm, for a look, or at the start of the service."""
        return self.run == "check"

    @property
    def busy(self) -> bool:
        """Whether a job or its run is under way."""
        return not self.checking and (self.job is not None or self.run is not None)

    @property
    def paused(self) -> bool:
        """Whether the run waits, or will wait as soon as it has left the tissue."""
        return self.busy and (self.pause_asked or self.phase in (Phase.PAUSED, Phase.PAUSE_RETRACT))

    @property
    def pressed(self) -> bool:
        """Whether the probe was pressed when it was last looked at."""
        return self.probe is not None and self.probe.state == ProbeState.PRESSED


@dataclass(frozen=True, slots=True)
class Now:
    """What stands, what is sensible next (None: nothing but to wait), and what is impossible."""

    state: State
    sentence: str
    next: Action | None
    obstacles: Mapping[Action, Obstacle] = field(default_factory=dict)
    question: str | None = None
    cause: str | None = None
    stop: StopName | None = None

    @property
    def word(self) -> str:
        """The state in a word or two."""
        return ROBOT_STOPS[self.stop].word if self.state == "robot" and self.stop is not None else WORDS[self.state]

    @property
    def published(self) -> KnownNow:
        """As the status holds it."""
        return KnownNow(
            state=self.state,
            word=self.word,
            sentence=self.sentence,
            next=self.next,
            obstacles={name: KnownObstacle(reason=each.reason, way=each.way) for name, each in self.obstacles.items()},
            question=self.question,
            cause=self.cause,
            stop=known_stop(self.stop) if self.stop is not None else None,
        )


def known_stop(name: StopName) -> KnownStop:
    """What the controller says, as the status holds it."""
    stop = ROBOT_STOPS[name]
    return KnownStop(name=name, says=stop.says, step=stop.step, done=stop.done)


def what_now(standing: Standing) -> Now:
    """Say what may be done, and what is sensible next.

    Args:
        standing: Where everything stands.

    Returns:
        The answer.
    """
    answers = {action: _obstacle(action, standing) for action in ACTIONS}
    open_ways = {"abort"} | {action for action, obstacle in answers.items() if obstacle is None}
    obstacles = {
        action: obstacle if obstacle.way in open_ways else replace(obstacle, way=None)
        for action, obstacle in answers.items()
        if obstacle is not None
    }
    state = _state(standing)
    question = standing.question if state in ("armed", "disarmed") else None
    stop = standing.stop if state == "robot" else None
    cause = standing.cause or None if state in ("latched", "pressed") else None
    return Now(state, _sentence(standing, state), _next(standing, obstacles), obstacles, question, cause, stop)


def _next(standing: Standing, obstacles: Mapping[Action, Obstacle]) -> Action | None:
    """The button that is sensible next; None where only time, or a step at the pendant, helps."""
    if standing.checking or (standing.stop is not None and not standing.busy):
        return None
    if not standing.busy:
        return _sensible(standing)
    return next((action for action in ("decide", "resume") if action not in obstacles), None)


def _obstacle(action: Action, standing: Standing) -> Obstacle | None:
    """Why a button is impossible; None where it is possible."""
    if action in ("pause", "resume"):
        return _pause_obstacle(action, standing)
    if action == "decide":
        return None if standing.proposal and standing.busy else Obstacle("no motion is proposed")
    if standing.busy:
        return Obstacle(f"the job {standing.job} is running" if standing.job else "a run is under way", "abort")
    if standing.checking and action == "arm" and standing.arming:
        return Obstacle("another client is arming the daemon")
    if standing.checking and action not in ("arm", "clear"):
        return Obstacle("the devices are being checked, which takes some seconds")
    if standing.stop is not None and action in MOVES_OR_FOLLOWS:
        return Obstacle(ROBOT_STOPS[standing.stop].reason)
    match action:
        case "arm":
            return _arm_obstacle(standing)
        case "start" if not standing.armed:
            more = _arm_obstacle(standing)
            return Obstacle(f"the daemon is disarmed, and {more.reason}", more.way) if more else Obstacle("the daemon is disarmed", "arm")
        case "start":
            return _arm_obstacle(standing)
        case "retract":
            return _retract_obstacle(standing)
        case "level-test":
            return _probe_obstacle(standing, "level_test")
        case "calibrate":
            return _probe_obstacle(standing, "calibrate" if standing.reference else "confirm")
        case "clear" | "recover" if standing.pressed:
            return _probe_obstacle(standing, "move")
    return None


def _arm_obstacle(standing: Standing) -> Obstacle | None:
    """What stands against an arming. The way to it is what is sensible in any case."""
    way = _sensible(standing)
    if standing.latch is not None:
        return Obstacle(f"the last run was stopped on {standing.latch[0]}: {standing.latch[1]}", way)
    if standing.cause:
        return Obstacle(standing.cause, way)
    if not standing.reference:
        return Obstacle("there is no reference tare", way)
    obstacle = _probe_obstacle(standing, "move")
    return replace(obstacle, way=way) if obstacle is not None else None


def _retract_obstacle(standing: Standing) -> Obstacle | None:
    """The way out is refused by no old doubt: the run judges the force anew. Only a force above the absolute limit is left to hands."""
    if standing.pressed and standing.probe is not None and "retract" not in standing.probe.ways:
        return Obstacle("; ".join(standing.probe.reasons), "check")
    if not standing.reference and not standing.unfinished:
        return Obstacle("there is no reference tare to judge the force by, and no run is unfinished: free the probe by hand at the pendant")
    return None


def _probe_obstacle(standing: Standing, way: Literal["move", "level_test", "calibrate", "confirm"]) -> Obstacle | None:
    probe = standing.probe
    if probe is None or way in probe.ways:
        return None
    return Obstacle(probe.head, _way_out(standing))


def _way_out(standing: Standing) -> Action:
    """What ends a doubt about the probe."""
    ways = standing.probe.ways if standing.probe is not None else frozenset()
    return "retract" if "retract" in ways else "level-test" if "level_test" in ways else "check"


def _pause_obstacle(action: Action, standing: Standing) -> Obstacle | None:
    if standing.run in GOES_UP:
        return Obstacle("the arm leaves the tissue already", "abort")
    if standing.run not in PAUSES:
        return Obstacle("nothing is running that could pause")
    if standing.pause_pending:
        return Obstacle("another client is pausing or resuming the run")
    if action == "pause" and standing.paused:
        return Obstacle("the run is paused", "resume")
    return Obstacle("the run is not paused") if action == "resume" and not standing.paused else None


def _state(standing: Standing) -> State:
    if standing.checking:
        return "checking"
    if standing.busy:
        return "waiting" if standing.proposal else "paused" if standing.phase == Phase.PAUSED else "running"
    if standing.stop is not None:
        return "robot"
    if standing.latch is not None or (standing.cause and not standing.pressed):
        return "latched"
    if standing.pressed:
        return "pressed"
    if standing.fault:
        return "unready"
    if not standing.reference and not standing.unfinished:
        return "untared"
    if standing.probe is not None and standing.probe.state == ProbeState.UNKNOWN:
        return "unknown"
    return "armed" if standing.armed else "disarmed"


def _sensible(standing: Standing) -> Action:
    """What an operator does next where nothing runs: out of the tissue first, then the latch, then the reference, then the run."""
    doubt = standing.probe is not None and standing.probe.state != ProbeState.FREE
    if standing.fault and not standing.pressed:
        return "check"
    if doubt and _way_out(standing) != "level-test":
        return _way_out(standing)
    if standing.latch is not None or standing.cause:
        return "clear"
    if not standing.reference:
        return "calibrate"
    if doubt:
        return "level-test"
    return "start" if standing.armed else "arm"


def _sentence(standing: Standing, state: State) -> str:
    if state == "checking":
        return "Robot and sensor are being checked; nothing moves."
    if standing.busy:
        return _doing(standing)
    facts = []
    if standing.stop is not None:
        stop, why = ROBOT_STOPS[standing.stop], f" ({standing.stop_reason})" if standing.stop_reason else ""
        facts = [f"{stop.says}{why}", f"at the pendant: {stop.step}"]
        facts += ["the probe is in the tissue: the retract comes after that"] if standing.pressed else []
        return _sentences(facts)
    if standing.latch is not None:
        facts.append(standing.latch[1])
    elif standing.last:
        facts.append(f"the last run was stopped: {standing.last}")
    if standing.cause:
        facts.append(standing.cause)
    probe = standing.probe
    if standing.fault and not standing.pressed:
        facts.append(standing.fault)
    elif probe is not None and standing.pressed and "retract" not in probe.ways:
        facts.append(f"{'; '.join(probe.reasons)}: free the probe by hand at the pendant")
    elif probe is not None and standing.pressed:
        force = f", with {probe.away_N:.1f} N against the reference tare" if probe.away_N is not None else ""
        facts.append(f"the probe is in the tissue{force}")
    elif not standing.reference and not standing.unfinished:
        facts.append("there is no reference tare: let the probe hang free and still")
    elif probe is not None and probe.state == ProbeState.UNKNOWN:
        facts.append(f"{probe.head}: {'; '.join(probe.reasons)}")
    elif state == "armed":
        facts.append("the next start moves the arm" + (", once you have said where its sites count from" if standing.question else ""))
    elif state == "disarmed":
        facts.append("the probe is free, and nothing moves" if probe is not None else "nothing moves")
    return _sentences(facts)


def _sentences(facts: Sequence[str]) -> str:
    return " ".join(f"{fact[:1].upper()}{fact[1:].removesuffix('.')}." for fact in facts)


def _doing(standing: Standing) -> str:
    """What goes on, by the run's newest tick."""
    if standing.proposal:
        return "The job proposes a motion and waits for your answer."
    if standing.run is None:
        return f"The job computes: {standing.activity}." if standing.activity else "The job computes; nothing moves."
    if standing.run in READS:
        return f"{READS[standing.run]}; nothing moves."
    site = f" at site {standing.site}" if standing.site is not None else ""
    depth_mm = (standing.depth_m or 0.0) * 1e3
    deep = f", {depth_mm:.1f} mm deep" if depth_mm > 0.0 else ""
    force = f"{standing.force_N:.1f} N"
    goes_up = standing.run in GOES_UP
    doing = {
        None: "rests while robot and sensor are opened",
        Phase.IDLE: "rests and is watched",
        Phase.TARE: "rests for the tare",
        Phase.TRAVEL: f"goes to site {standing.site}" if standing.site is not None else "goes sideways",
        Phase.BASELINE: "rests before it goes up" if goes_up else f"rests above the tissue{site}",
        Phase.SEARCH: f"looks for the surface{site}",
        Phase.PRESS: f"presses with {force}{site}{deep}" if deep else f"goes down{site}",
        Phase.HOLD: f"holds with {force}{site}{deep}",
        Phase.RETRACT: f"leaves the tissue{site}" + (f", {force}" if goes_up else ""),
        Phase.FREE_MOTION: f"moves in free air{site}",
        Phase.PAUSED: f"waits above the tissue{site}",
        Phase.PAUSE_RETRACT: f"leaves the tissue{site} for the pause",
        Phase.RETURN: "goes back to the start",
        Phase.DONE: "has ended its run",
        Phase.LIFT: "goes 5 mm up, to show that it is free",
    }
    return f"The probe {doing[standing.phase]}."
