"""The palpation sequence: what the arm should do next, written as scripts that read from top to bottom.

A script is a generator: it yields a proposal (a tip speed, and where in the plan it stands) and receives the next observation. It knows no
clock, no device and no guard, so the same observations give the same proposals bit for bit.
"""

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial
from typing import TypeVar

import numpy as np

from palpd.config import CONTACT_FORCE_N, Plan
from palpd.control.surface import FEWEST_SAMPLES, UNSURE_M, fitted_part, surface_from_approach
from palpd.tick import STILL, Command, Floats, Mode, Observation, Phase, Progress, Proposal, Request

GAIN_PER_S = 8.0
"""Commanded speed per metre of remaining way. The controller's target lags two to three cycles: 8/s × 24 ms leaves 78° of phase."""
REACHED_M = 1e-5
"""Distance of the controller's target from its goal that counts as reached: at 10 N/mm less than one count of Fz."""
ACHIEVED_M = 3e-5
"""Distance of the tip from its goal that counts as reached: a third of a UR5's repeatability of 1e-4 m."""
TRIM_BELOW_M_PER_S = 0.001
"""Speed of the target below which the depth is trimmed: at higher speed the arm's lag is no error of position."""
TRIM_GAIN_PER_S = 2.0
"""Rate of the trim, four times slower than `GAIN_PER_S`, so the two loops do not disturb each other."""
TRIM_LIMIT_M = 2e-4
"""Largest trim, below the guard's margin of depth: trimming alone never trips the guard."""
PATIENCE_S = 5.0
"""Time that a press may take beyond twice its planned duration."""
REACTION_S = 0.1
"""Time from a force to the arm at rest, rounded up; `palpd check-config` prints the terms."""
SOFT_END = 0.9
"""Share of the contact limit at which the sequence ends a press by itself, before the guard acts."""
BASELINE_S = 0.5
"""Rest before a press or a search that gives its force baseline: 500 samples at 1 kHz leave 2 mN of noise."""
CLEAR_SHARE = 0.5
"""Share of the safe height above a known surface beyond which the tip is clear of tissue that bulges or clings."""
CLEAR_BELOW_HOME_M = 0.001
"""How far the arm may be seen below its target at home, where the run was tared: this counts as free air."""
SETTLE_WINDOW_S = 0.5
"""Length of the two windows that a settled force is compared over."""
SETTLED_N = 0.02
"""Change between two windows below which a force counts as stable: noise alone changes their means by 3 mN."""
MOST_SETTLE_S = 20.0
"""Longest wait for a stable force."""
ORIGIN_LIMIT_M = 0.3
"""Longest way to a plan's origin: across a table of phantoms. A longer one is more likely a mistake of frame or unit."""
RETRACT_M_PER_S = 0.005
"""Speed of `palpd retract`, that of a search: the arm stops within 0.1 mm where something catches the probe."""
RETRACT_LIMIT_M = 0.06
"""Longest way of `palpd retract`: the deepest press of a plan, 20 mm, three times."""
LEVEL_M = 0.005
"""Way up over which the force must stay level before the tip counts as clear of tissue."""
LEVEL_N = 0.1
"""Change of the force over that way below which it is level, 20 times what noise changes. Tissue of 5 kPa gives 0.17 N over 5 mm."""
LIFT_N = 0.3
"""Change of the raw force from rest to rest over the same way, beyond which the probe touched something.

Larger than the bias that a tare may leave (0.19 N in the paper), smaller than a contact that would shift a modulus by a tenth."""
LIFT_WINDOW_S = 0.1
"""Length of the mean that is compared: 100 samples at 1 kHz leave 5 mN of noise, and the arm rises by 0.5 mm in it."""
RISE_END_N = 0.5
"""Change of the raw force at which such a way up ends early: something presses or holds the probe. A cable that rubs changes it less, and
only while the arm moves; so `LIFT_N` is judged at rest."""
CAUGHT_N = 2.0
"""Pull against the way up, and growth of the press on it, at which `palpd retract` gives up: wet tissue clings with less than 1 N."""
LEAST_AIR_M = 2e-4
"""Least way of a search through the air: twice what a surface is uncertain by. With less the search may have begun in the tissue."""
FREE_STROKE_M = 0.02
"""Stroke of the training motion: long enough to reach every speed of a plan."""
FREE_CYCLES = 10
"""Number of training strokes up and down."""
FREE_SPEED_M_PER_S = 0.02
"""Speed of the training motion, as of fast presses."""
RIGID_PRESSES = 3
"""Number of presses on a rigid plate: their spread gives the interval of the machine's stiffness."""
RIGID_SEARCH_M_PER_S = 0.0005
"""Speed towards a rigid plate."""
RIGID_SPEED_M_PER_S = 0.0002
"""Speed of a press on a rigid plate."""
RIGID_END = 0.7
"""Share of the contact limit at which a press on a rigid plate ends.

A plate is stiff: at 200 N/mm and 80 ms of delay the two speeds above overshoot by 8 N and 3 N.
"""


@dataclass(frozen=True, slots=True)
class ArmGeometry:
    """What the sequence must know of probe, sensor and machine. `delay_s` is the delay of the sensor's filter."""

    tip_radius_m: float
    contact_limit_N: float
    max_speed_m_per_s: float
    delay_s: float
    machine_stiffness_N_per_m: float = math.inf


class ScriptEnded(Exception):
    """A script cannot go on; the sentence says why."""


class SurfaceNotFound(ScriptEnded):
    """The search met nothing, or its data is not credible."""


class NotBegun(ScriptEnded):
    """The script refuses to begin where the arm stands; nothing has moved."""


STEP_NAMES = {Mode.SEARCH: "search for the surface", Mode.STATIC: "static press", Mode.DYNAMIC: "dynamic press", Mode.STIFFNESS: "press"}
Result = TypeVar("Result")
Steps = Generator[Proposal, Observation, None]


class OnPause(Enum):
    """What a pause does to the step under way."""

    STAND = "stand still here, then go on: the tip is in the air"
    BEGIN_AGAIN = "go up to the safe height, wait there, then begin the step again"
    FINISH = "finish the step, then wait: it leads to the safe height"


class _Interrupted(Exception):
    """A pause was asked for in a step that begins again after it."""


class Sequence:
    """A running script. `over`: the plan has ended; `failure`: why it could not be carried out; `refused`: it has moved nothing.

    A script answers a pause itself. With `pauses_in_place` the arm stands still instead, as in the recordings of earlier versions.
    """

    def __init__(self, script: "Script", pauses_in_place: bool = False) -> None:
        self._script = script
        self._pauses_in_place = pauses_in_place
        self._steps: Steps | None = None
        self.over = False
        self.failure: str | None = None
        self.refused = False

    @property
    def notes(self) -> list[str]:
        """One sentence for each step that a pause interrupted."""
        return self._script.notes

    @property
    def level(self) -> bool:
        """Whether the script ended on a way up over which the force stayed level: then the probe is free."""
        return self._script.level

    def step(self, observation: Observation) -> Proposal:
        """Return the next proposal for this observation."""
        self._script.hear(observation.request)
        if self._pauses_in_place and self._script.pause_asked and not self.over:
            return self._script.standing()
        try:
            if self._steps is None:
                self._script.begin(observation)
                self._steps = self._script.whole()
                return next(self._steps)
            return self._steps.send(observation)
        except StopIteration:
            self.over = True
        except ScriptEnded as failure:
            self.over, self.failure, self.refused = True, str(failure), isinstance(failure, NotBegun)
        return Proposal(STILL, replace(self._script.progress, phase=Phase.DONE))


class Script(ABC):
    """The steps that every script consists of. `observation` is the newest one; `progress` travels with each proposal.

    `pause_asked` is true between an operator's pause and the resume, and `on_pause` says what it does to the step under way. A script that
    `lifts_first` shows by a way up that it was not tared in contact.
    """

    def __init__(self, arm: ArmGeometry) -> None:
        self.arm = arm
        self.lifts_first = False
        self.level = False
        self.progress = Progress()
        self.pause_asked = False
        self.on_pause = OnPause.STAND
        self.notes: list[str] = []
        self.observation: Observation
        self.home: tuple[float, float, float]

    def whole(self) -> Steps:
        """Lift first where that is asked for, then run."""
        if self.lifts_first:
            yield from self.lift()
        yield from self.run()

    @abstractmethod
    def run(self) -> Steps:
        """Run the script from where the arm stands."""

    def begin(self, observation: Observation) -> None:
        """Take the arm's present place as home."""
        self.observation = observation
        x_m, y_m, z_m = observation.robot.target_pose[:3]
        self.home = (x_m, y_m, z_m)
        self.note(safe_z_m=z_m, floor_z_m=z_m)

    def hear(self, request: Request) -> None:
        """Remember a pause until it is resumed."""
        if request in (Request.PAUSE, Request.RESUME):
            self.pause_asked = request == Request.PAUSE

    def note(self, **changes: object) -> None:
        """Change the progress that travels with the proposals."""
        self.progress = replace(self.progress, **changes)  # type: ignore[arg-type]

    def move(self, vx_m_per_s: float = 0.0, vy_m_per_s: float = 0.0, vz_m_per_s: float = 0.0) -> Steps:
        """Propose a tip speed for one tick, and answer a pause.

        Args:
            vx_m_per_s: speed along the base's x.
            vy_m_per_s: speed along the base's y.
            vz_m_per_s: speed along the base's z, up.
        """
        self.observation = yield Proposal(Command((vx_m_per_s, vy_m_per_s, vz_m_per_s)), self.progress)
        if self.pause_asked and self.on_pause == OnPause.BEGIN_AGAIN:
            raise _Interrupted
        if self.on_pause == OnPause.STAND:
            yield from self.stand_by()

    def step_name(self) -> str:
        """Say which press or search is under way."""
        depth_m = self.progress.depth_m
        return STEP_NAMES.get(self.progress.mode, "step") + (f" to {depth_m * 1e3:g} mm" if math.isfinite(depth_m) else "")

    def standing(self) -> Proposal:
        """Return the proposal of a tick in a pause. What the tip may touch there is not known, so no zero learns."""
        return Proposal(STILL, replace(self.progress, phase=Phase.PAUSED, clear_z_m=math.inf))

    def stand_by(self) -> Steps:
        """Stand still until no pause is asked for."""
        while self.pause_asked:
            self.observation = yield self.standing()

    def lift(self, rest_N: tuple[float, ...] = (0.0, 0.0, 0.0), begins: str = "tared in contact") -> Steps:
        """Go `LEVEL_M` straight up and come back: where the probe touches something, the force changes on the way.

        Args:
            rest_N: force (3,) before the way, base axes.
            begins: begins the sentence that ends the run.

        Raises:
            ScriptEnded: the force changed.
        """
        self.note(phase=Phase.LIFT)
        changed_N = yield from self.rise(rest_N)
        if changed_N > LIFT_N:
            risen_m = self.observation.robot.z_m - self.home[2]
            raise ScriptEnded(
                f"{begins}: the force changed by {changed_N:.2f} N over the first {risen_m * 1e3:.1f} mm straight up, expected at "
                f"most {LIFT_N:g} N; palpd retract leaves what the probe touches"
            )
        yield from self.go_to(self.home[2], min(FREE_SPEED_M_PER_S, self.arm.max_speed_m_per_s))
        yield from self.come_to_rest()

    def rise(self, rest_N: tuple[float, ...]) -> Generator[Proposal, Observation, float]:
        """Go `LEVEL_M` straight up, slowly, and rest there; end early where the force changes by more than `RISE_END_N`.

        Args:
            rest_N: force (3,) before the way, base axes.

        Returns:
            The change of the mean force over the last `LIFT_WINDOW_S`, N.
        """
        top_m, recent, changed_N = self.home[2] + LEVEL_M, deque[tuple[float, list[float]]](), 0.0
        until_s = math.inf
        while self.observation.now_s < until_s:
            if until_s == math.inf and abs(top_m - self.observation.robot.target_pose[2]) <= REACHED_M:
                until_s = self.observation.now_s + SETTLE_WINDOW_S
            speed_m_per_s = min(RETRACT_M_PER_S, self.arm.max_speed_m_per_s)
            yield from self.move(vz_m_per_s=self._towards(top_m, speed_m_per_s) if until_s == math.inf else 0.0)
            recent.extend((self.observation.now_s, force_N) for force_N in self.observation.contact.tared[:, :3].tolist())
            while recent and recent[0][0] < self.observation.now_s - LIFT_WINDOW_S:
                recent.popleft()
            if recent:
                axes = zip(*(force_N for _, force_N in recent), strict=True)
                changed_N = math.dist(rest_N, [math.fsum(axis) / len(recent) for axis in axes])
            if changed_N > RISE_END_N:
                break
        return changed_N

    def begun_again(self, step: Callable[[], Generator[Proposal, Observation, Result]]) -> Generator[Proposal, Observation, Result]:
        """Carry out a step that begins above the tissue, and begin it again where a pause interrupts it.

        The tip goes up to the safe height first and waits there. A step that is leaving the tissue already ends before the pause.

        Args:
            step: the step; it may be carried out several times.

        Returns:
            What the step returns.
        """
        begin = self.progress
        while True:
            self.progress, self.on_pause = begin, OnPause.BEGIN_AGAIN
            try:
                result = yield from step()
            except _Interrupted:
                self.on_pause = OnPause.FINISH
                self.notes.append(f"{self.step_name()}: a pause interrupted it, and it was begun again from its start")
                self.note(phase=Phase.PAUSE_RETRACT, clear_z_m=math.inf)
                yield from self.move()  # one tick at least: the record shows the interruption also where there is no way up
                yield from self.go_to(max(self.progress.safe_z_m, self.observation.robot.target_pose[2]), self.arm.max_speed_m_per_s)
                yield from self.come_to_rest()
                yield from self.stand_by()
            else:
                self.on_pause = OnPause.STAND
                yield from self.stand_by()
                return result

    def wait(self, duration_s: float) -> Steps:
        """Stand still for a duration."""
        until_s = self.observation.now_s + duration_s
        while self.observation.now_s < until_s:
            yield from self.move()

    def travel(self, x_m: float, y_m: float, phase: Phase = Phase.TRAVEL) -> Steps:
        """Go sideways at the present height.

        Args:
            x_m: goal in base axes.
            y_m: goal in base axes.
            phase: what the record calls it.
        """
        self.note(phase=phase, mode=Mode.NONE, floor_z_m=self.observation.robot.target_pose[2])
        while True:
            dx_m, dy_m = x_m - self.observation.robot.target_pose[0], y_m - self.observation.robot.target_pose[1]
            away_m = math.hypot(dx_m, dy_m)
            if away_m < REACHED_M:
                break
            speed_m_per_s = min(self.arm.max_speed_m_per_s, GAIN_PER_S * away_m)
            yield from self.move(vx_m_per_s=speed_m_per_s * dx_m / away_m, vy_m_per_s=speed_m_per_s * dy_m / away_m)
        yield from self.come_to_rest()

    def go_to(self, z_m: float, speed_m_per_s: float) -> Steps:
        """Go up or down without regard to force: for free air and for leaving the tissue.

        Args:
            z_m: height of the goal.
            speed_m_per_s: speed of the way.
        """
        while abs(z_m - self.observation.robot.target_pose[2]) > REACHED_M:
            yield from self.move(vz_m_per_s=self._towards(z_m, speed_m_per_s))

    def come_to_rest(self) -> Steps:
        """Wait until the arm has reached its target, at most a second."""
        until_s = self.observation.now_s + 1.0
        while self.observation.now_s < until_s:
            pose, target = self.observation.robot.tcp_pose, self.observation.robot.target_pose
            if math.dist(pose[:3], target[:3]) < ACHIEVED_M:
                return
            yield from self.move()

    def mean_wrench(self, duration_s: float) -> Generator[Proposal, Observation, tuple[float, ...]]:
        """Stand still and return the mean wrench (6,), tared and not compensated."""
        until_s = self.observation.now_s + duration_s
        wrenches: list[list[float]] = []
        while self.observation.now_s < until_s or not wrenches:
            yield from self.move()
            wrenches.extend(self.observation.contact.tared.tolist())
        return tuple(math.fsum(axis) / len(wrenches) for axis in zip(*wrenches, strict=True))

    def newest_fz_N(self) -> float:
        """Return the newest force on the tip, tared and not compensated; nan where this tick has none."""
        tared = self.observation.contact.tared
        return _mean(tared[:, 2]) if len(tared) else math.nan

    def tip_z_m(self) -> float:
        """Return the tip's height: the reported height plus the give of sensor and arm, which the encoders do not see."""
        return self.observation.robot.z_m + self.observation.contact.mean_N / self.arm.machine_stiffness_N_per_m

    def _towards(self, z_m: float, speed_m_per_s: float) -> float:
        away_m = z_m - self.observation.robot.target_pose[2]
        return math.copysign(min(speed_m_per_s, GAIN_PER_S * abs(away_m)), away_m)


class Palpation(Script):
    """The plan: find the surface at every site, then press to every depth, statically or dynamically."""

    def __init__(
        self,
        plan: Plan,
        arm: ArmGeometry,
        returns_to_start: bool = True,
        back_to_m: tuple[float, float, float] | None = None,
        top_z_m: float = -math.inf,
        fits_slope: bool = True,
    ) -> None:
        super().__init__(arm)
        self.plan = plan
        self.fits_slope = fits_slope
        self.returns_to_start = returns_to_start
        self.back_to_m = back_to_m
        self.top_z_m = top_z_m
        self.trim_m = 0.0

    def run(self) -> Steps:
        """Visit the sites in order, at the height of the start between them, and end at the start pose."""
        if self.back_to_m is not None:
            yield from self.go_back(self.back_to_m)
        origin_m = self.origin()
        for index, site in enumerate(self.plan.sites):
            self.note(site=index, mode=Mode.NONE, depth_m=math.nan, surface_z_m=math.nan, repeat=-1, cut_short=False)
            self.note(clear_z_m=self.home[2] - CLEAR_BELOW_HOME_M)
            before_N = self.newest_fz_N()
            yield from self.travel(origin_m[0] + site.x_m, origin_m[1] + site.y_m)
            if self.fits_slope and abs(self.newest_fz_N() - before_N) > LIFT_N:
                self.note(clear_z_m=math.inf)
                rest_N = (yield from self.mean_wrench(LIFT_WINDOW_S))[:3]
                yield from self.lift(rest_N, f"site {site.name} begins in contact")
                self.note(clear_z_m=self.home[2] - CLEAR_BELOW_HOME_M)
            yield from self.move_freely()
            if not self.plan.depths_m:
                continue
            surface_z_m = yield from self.begun_again(self.find_surface)
            self.note(surface_z_m=surface_z_m, safe_z_m=surface_z_m + self.plan.safe_height_m)
            if self.plan.mode in ("static", "both"):
                for depth_m in self.plan.depths_m:
                    yield from self.begun_again(partial(self.press_and_hold, surface_z_m, depth_m))
            if self.plan.mode in ("dynamic", "both"):
                for depth_m in self.plan.depths_m:
                    for repeat in range(self.plan.repeats):
                        self.note(repeat=repeat)
                        yield from self.begun_again(partial(self.press_and_leave, surface_z_m, depth_m))
            self.note(phase=Phase.RETRACT, mode=Mode.NONE, depth_m=math.nan, cut_short=False, safe_z_m=self.home[2])
            yield from self.go_to(self.home[2], self.arm.max_speed_m_per_s)
            yield from self.come_to_rest()
        if self.returns_to_start:
            self.note(site=-1, repeat=-1, surface_z_m=math.nan, clear_z_m=self.home[2] - CLEAR_BELOW_HOME_M)
            yield from self.travel(self.home[0], self.home[1], Phase.RETURN)

    def go_back(self, start_m: tuple[float, float, float]) -> Steps:
        """Go to where an unfinished run began, and take that as home: straight up to its greatest height, then sideways, then down."""
        self.note(phase=Phase.RETURN)
        yield from self.go_to(max(self.top_z_m, self.home[2]), self.arm.max_speed_m_per_s)
        yield from self.come_to_rest()
        yield from self.travel(start_m[0], start_m[1], Phase.RETURN)
        self.home = start_m
        self.note(floor_z_m=start_m[2])
        yield from self.go_to(start_m[2], min(FREE_SPEED_M_PER_S, self.arm.max_speed_m_per_s))
        yield from self.come_to_rest()
        self.note(safe_z_m=start_m[2])

    def step_name(self) -> str:
        """Say which press or search is under way, and where."""
        return f"site {self.plan.sites[self.progress.site].name}, {super().step_name()}"

    def origin(self) -> tuple[float, float]:
        """Return x and y, in base axes, that the sites count from: the plan's origin, or the start pose."""
        if self.plan.origin is None:
            return self.home[0], self.home[1]
        place_m = (self.plan.origin.x_m, self.plan.origin.y_m)
        away_m = math.dist(place_m, self.home[:2])
        if away_m > ORIGIN_LIMIT_M:
            raise NotBegun(
                f"the plan's origin is {away_m:.3f} m from where the arm stands ({self.home[0]:.3f}, {self.home[1]:.3f}) m, expected "
                f"at most {ORIGIN_LIMIT_M:g} m; move the arm nearer to it, or correct origin in the plan"
            )
        return place_m

    def move_freely(self) -> Steps:
        """Make the plan's strokes in the air."""
        free = self.plan.free
        if free is None:
            return
        self.note(phase=Phase.FREE_MOTION, mode=Mode.FREE_MOTION)
        yield from self.wait(BASELINE_S)
        for stroke in range(free.strokes):
            self.note(repeat=stroke)
            for z_m in (self.home[2] + free.height_m, self.home[2]):
                yield from self.go_to(z_m, free.speed_m_per_s)
                yield from self.come_to_rest()
        self.note(repeat=-1)

    def find_surface(self) -> Generator[Proposal, Observation, float]:
        """Go down until contact, fit the contact law to the approach, and leave. Returns the height of the surface."""
        search = self.plan.search
        lowest_m = self.observation.robot.target_pose[2] - search.max_travel_m
        self.note(phase=Phase.BASELINE, mode=Mode.SEARCH)
        baseline_N = (yield from self.mean_wrench(BASELINE_S))[2]
        robot_track: list[tuple[float, float]] = []
        force_track: list[tuple[float, float]] = []
        force_N = 0.0
        self.note(phase=Phase.SEARCH, floor_z_m=lowest_m, clear_z_m=math.inf)
        while force_N < CONTACT_FORCE_N:
            if self.observation.robot.target_pose[2] <= lowest_m + REACHED_M:
                raise SurfaceNotFound(
                    f"no contact of {CONTACT_FORCE_N:g} N was met within search.max_travel_m of {search.max_travel_m:g} m; "
                    "start nearer to the tissue or allow a longer way"
                )
            yield from self.move(vz_m_per_s=self._towards(lowest_m, search.speed_m_per_s))
            if len(self.observation.frames):
                force_N = _mean(self.observation.contact.tared[:, 2]) - baseline_N
                if force_N < -CONTACT_FORCE_N:
                    raise SurfaceNotFound(
                        f"the force fell to {force_N:.1f} N in the search, where tissue can only press: the sensor's zero moves, or its "
                        "sign is wrong, and either would hide the surface; check it with palpd doctor --weight-N"
                    )
                mean_t_s = _mean(self.observation.frames.t_s) - self.arm.delay_s
                force_track.append((mean_t_s, force_N))
            robot_track.append((self.observation.robot.t_s, self.observation.robot.z_m))
        yield from self.move()
        robot, force = np.array(robot_track), np.array(force_track)
        height_m = np.interp(force[:, 0], robot[:, 0], robot[:, 1]) + force[:, 1] / self.arm.machine_stiffness_N_per_m
        seen = force[:, 0] <= robot[-1, 0]  # a robot state is newer than the frame, so its height is interpolated
        if int(seen.sum()) < FEWEST_SAMPLES:
            raise SurfaceNotFound(
                f"{force_N:.1f} N stood there {len(force)} ticks after the search began: the probe touches something already, or the "
                "sensor's zero moved; start higher above the tissue, or tare again"
            )
        approach = fitted_part(height_m[seen], force[seen, 1])
        surface_z_m, sigma_m = surface_from_approach(*approach, self.arm.tip_radius_m, self.fits_slope)
        if self.fits_slope and sigma_m > UNSURE_M:
            raise SurfaceNotFound(
                f"{force_N:.1f} N were met, but the way down does not show where: the surface is uncertain by {2e3 * sigma_m:.1f} mm, "
                f"expected at most {2e3 * UNSURE_M:g} mm; a cable pulls, the sensor's zero drifts, or the search began too near. Look at "
                "the cable, let the sensor warm up, or start higher above the tissue"
            )
        if self.fits_slope and height_m[0] - surface_z_m < LEAST_AIR_M:
            raise SurfaceNotFound(
                f"the search began at z = {height_m[0]:.4f} m, and the surface lies at {surface_z_m:.4f} m: the probe may have touched the "
                "tissue already, and then neither depth nor modulus counts from its surface; start higher above the tissue"
            )
        self.note(surface_z_m=surface_z_m, clear_z_m=surface_z_m + CLEAR_SHARE * self.plan.safe_height_m)
        yield from self.leave(surface_z_m, self.arm.max_speed_m_per_s)
        return surface_z_m

    def press_and_hold(self, surface_z_m: float, depth_m: float) -> Steps:
        """Press statically: hold until the force is stable, then record the hold whose mean counts.

        Args:
            surface_z_m: height of the surface.
            depth_m: depth below it.
        """
        yield from self.prepare(Mode.STATIC, depth_m)
        yield from self.press(surface_z_m, depth_m, settle=True)
        if not self.progress.cut_short:
            self.note(phase=Phase.HOLD)
            until_s = self.observation.now_s + self.plan.hold_s
            while self.observation.now_s < until_s and not self._soft_end():
                yield from self.hold_depth(surface_z_m - depth_m)
        yield from self.leave(surface_z_m, self.arm.max_speed_m_per_s)

    def press_and_leave(self, surface_z_m: float, depth_m: float) -> Steps:
        """Press dynamically: reach the depth and leave at once.

        Args:
            surface_z_m: height of the surface.
            depth_m: depth below it.
        """
        yield from self.prepare(Mode.DYNAMIC, depth_m)
        yield from self.press(surface_z_m, depth_m, settle=False)
        yield from self.leave(surface_z_m, self.plan.press_speed_m_per_s)

    def prepare(self, mode: Mode, depth_m: float) -> Steps:
        """Stand still above the surface for the force baseline of the next press.

        Args:
            mode: kind of the press.
            depth_m: its depth below the surface.
        """
        self.note(phase=Phase.BASELINE, mode=mode, depth_m=depth_m, cut_short=False)
        yield from self.wait(BASELINE_S)

    def press(self, surface_z_m: float, depth_m: float, settle: bool) -> Steps:
        """Go down to the depth; end early, and note it, where the force nears its limit.

        Args:
            surface_z_m: height of the surface.
            depth_m: depth below it.
            settle: wait there for a stable force.
        """
        goal_z_m = surface_z_m - depth_m
        give_m = self.arm.contact_limit_N / self.arm.machine_stiffness_N_per_m
        self.note(phase=Phase.PRESS, floor_z_m=goal_z_m - give_m)
        patience_s = self.observation.now_s + 2.0 * (self.plan.safe_height_m + depth_m) / self.plan.press_speed_m_per_s + PATIENCE_S
        while self.tip_z_m() > goal_z_m + ACHIEVED_M and self.observation.now_s < patience_s:
            if self._soft_end():
                self.note(cut_short=True)
                return
            yield from self.hold_depth(goal_z_m)
        if settle:
            yield from self.settle(goal_z_m)

    def settle(self, goal_z_m: float) -> Steps:
        """Hold the depth until two consecutive windows of force agree, for at most `MOST_SETTLE_S`."""
        until_s = self.observation.now_s + MOST_SETTLE_S
        last_N = math.inf
        while self.observation.now_s < until_s:
            window_s = self.observation.now_s + SETTLE_WINDOW_S
            forces: list[float] = []
            while self.observation.now_s < window_s:
                if self._soft_end():
                    self.note(cut_short=True)
                    return
                yield from self.hold_depth(goal_z_m)
                forces.append(self.observation.contact.mean_N)
            mean_N = math.fsum(forces) / len(forces)
            if abs(mean_N - last_N) < max(SETTLED_N, 0.002 * abs(mean_N)):
                return
            last_N = mean_N

    def hold_depth(self, goal_z_m: float) -> Steps:
        """Steer the tip towards a height, or keep it there, for one tick; the machine's give is compensated.

        The speed steers the controller's target, which answers without lag. A slow, bounded trim removes the distance that the arm keeps
        from the target when nearly at rest.
        """
        before_s = self.observation.now_s
        yield from self.move(vz_m_per_s=self._towards(self._reported(goal_z_m) + self.trim_m, self._governed_speed()))
        if abs(self.observation.robot.target_speed[2]) < TRIM_BELOW_M_PER_S:
            missing_m = goal_z_m - self.tip_z_m()
            trim_m = self.trim_m + TRIM_GAIN_PER_S * missing_m * (self.observation.now_s - before_s)
            self.trim_m = min(max(trim_m, -TRIM_LIMIT_M), TRIM_LIMIT_M)

    def _governed_speed(self) -> float:
        """Return the press speed, lower where the stiffness so far would carry the force past the limit before the arm is at rest.

        v <= (limit - F) / (k t) with the slope k = 3F/2d of Hertz's law through the present force and depth.
        """
        force_N, depth_m = self.observation.contact.mean_N, self.progress.surface_z_m - self.tip_z_m()
        if force_N <= 0.0 or depth_m <= 0.0:
            return self.plan.press_speed_m_per_s
        stiffness_N_per_m = 1.5 * force_N / depth_m
        room_N = max(self.arm.contact_limit_N - force_N, 0.0)
        return min(self.plan.press_speed_m_per_s, room_N / (stiffness_N_per_m * REACTION_S))

    def leave(self, surface_z_m: float, speed_m_per_s: float) -> Steps:
        """Go back to the safe height; a pause waits until the tip is there.

        Args:
            speed_m_per_s: speed of the way.
        """
        self.note(phase=Phase.RETRACT)
        self.on_pause = OnPause.FINISH
        yield from self.go_to(surface_z_m + self.plan.safe_height_m, speed_m_per_s)
        yield from self.come_to_rest()

    def _reported(self, tip_z_m: float) -> float:
        """Return the height that the robot reports when the tip is there; the give is limited to that of the contact limit."""
        force_N = min(max(self.observation.contact.mean_N, 0.0), self.arm.contact_limit_N)
        return tip_z_m - force_N / self.arm.machine_stiffness_N_per_m

    def _soft_end(self) -> bool:
        return self.observation.contact.mean_N >= SOFT_END * self.arm.contact_limit_N


class TimedRest(Script):
    """Stands still for a duration: the record shows the devices, the contact and the guard's verdict."""

    def __init__(self, arm: ArmGeometry, duration_s: float) -> None:
        super().__init__(arm)
        self.duration_s = duration_s

    def run(self) -> Steps:
        """Wait."""
        self.note(phase=Phase.IDLE, floor_z_m=-math.inf)
        yield from self.wait(self.duration_s)


class Retract(Script):
    """Leaves the tissue after a stop: straight up, slowly, no farther than `RETRACT_LIMIT_M`.

    The force is the raw one against the reference tare: where the probe is loaded no tare can be taken. Its zero may have moved since,
    so the way ends where the force has stayed level, whatever its value. After an `unfinished` contact it goes up at any force, and at
    least above `clear_z_m`, where that is known.
    """

    def __init__(self, arm: ArmGeometry, unfinished: bool = False, clear_z_m: float | None = None) -> None:
        super().__init__(arm)
        self.unfinished = unfinished
        self.clear_z_m = -math.inf if clear_z_m is None else clear_z_m

    def run(self) -> Steps:
        """Refuse where nothing presses; else go up until the force is level."""
        self.note(phase=Phase.BASELINE, safe_z_m=self.home[2] + RETRACT_LIMIT_M)
        loaded_N = (yield from self.mean_wrench(BASELINE_S))[2]
        if abs(loaded_N) < CONTACT_FORCE_N and not self.unfinished:
            raise NotBegun(
                f"the force is {loaded_N:.2f} N against the reference tare, below the {CONTACT_FORCE_N:g} N of a contact: "
                "the probe is clear of the tissue, and nothing was moved"
            )
        self.note(phase=Phase.RETRACT)
        track: deque[tuple[float, float]] = deque()
        highest_m = self.home[2] + RETRACT_LIMIT_M
        while not _level(track) or self.observation.robot.z_m < self.clear_z_m:
            z_m, force_N = self.observation.robot.z_m, self.observation.contact.mean_N
            if force_N < min(loaded_N, 0.0) - CAUGHT_N or force_N > max(loaded_N, 0.0) + CAUGHT_N:
                raise ScriptEnded(
                    f"the force went from {loaded_N:.1f} to {force_N:.1f} N on the way up, expected it to fade: something holds the probe; "
                    "free it by hand"
                )
            if self.observation.robot.target_pose[2] >= highest_m - REACHED_M:
                raise ScriptEnded(
                    f"the tip is not clear after {RETRACT_LIMIT_M * 1e3:g} mm of way up, where the force is {force_N:.1f} N; look at the "
                    "cell before you go on, and run palpd level-test if the probe is free"
                )
            track.append((z_m, force_N))
            while track[-1][0] - track[0][0] > LEVEL_M:
                track.popleft()
            yield from self.move(vz_m_per_s=self._towards(highest_m, min(RETRACT_M_PER_S, self.arm.max_speed_m_per_s)))
        yield from self.move()
        yield from self.come_to_rest()
        self.level = True


class LevelTest(Script):
    """Goes 5 mm straight up: a force that stays level is no contact that changes with height. A hanging cable it cannot see."""

    def run(self) -> Steps:
        """Go up once; say what changed where the force was not level."""
        self.note(phase=Phase.BASELINE, safe_z_m=self.home[2] + LEVEL_M)
        rest_N = yield from self.mean_wrench(BASELINE_S)
        self.note(phase=Phase.LIFT)
        changed_N = yield from self.rise(rest_N[:3])
        if changed_N > LIFT_N:
            risen_m = self.observation.robot.z_m - self.home[2]
            raise ScriptEnded(
                f"the force changed by {changed_N:.2f} N over {risen_m * 1e3:.1f} mm straight up, expected at most {LIFT_N:g} N: the probe "
                "touches something; palpd retract leaves it"
            )
        self.level = True


def _mean(values: Floats) -> float:
    """The mean as numpy computes it, bit for bit, at a third of its price."""
    return float(values.sum()) / len(values)


def _level(track: deque[tuple[float, float]]) -> bool:
    """Whether the forces of this way, (height, force) each, cover `LEVEL_M` and differ by less than `LEVEL_N`."""
    if not track or track[-1][0] - track[0][0] < 0.95 * LEVEL_M:
        return False
    thirds = np.array_split(np.array([force_N for _, force_N in track]), 3)
    means_N = [float(third.mean()) for third in thirds]
    return max(means_N) - min(means_N) < LEVEL_N


class FreeMotion(Script):
    """Moves 2 cm up and down in free air, ten times: the training data of the inertial model."""

    def run(self) -> Steps:
        """Run all cycles and end where they began."""
        self.note(phase=Phase.BASELINE, mode=Mode.FREE_MOTION)
        yield from self.wait(BASELINE_S)
        self.note(phase=Phase.FREE_MOTION)
        for cycle in range(FREE_CYCLES):
            self.note(repeat=cycle)
            for z_m in (self.home[2] + FREE_STROKE_M, self.home[2]):
                yield from self.go_to(z_m, min(FREE_SPEED_M_PER_S, self.arm.max_speed_m_per_s))
                yield from self.come_to_rest()


class RigidPress(Script):
    """Presses a rigid plate slowly: only the machine itself gives way."""

    def __init__(self, plan: Plan, arm: ArmGeometry) -> None:
        super().__init__(arm)
        self.plan = plan

    def run(self) -> Steps:
        """Find the plate by force, then load and unload it three times."""
        lowest_m = self.home[2] - self.plan.search.max_travel_m
        self.note(phase=Phase.SEARCH, mode=Mode.STIFFNESS, floor_z_m=lowest_m)
        touched_z_m = yield from self.begun_again(partial(self.find_plate, lowest_m))
        for repeat in range(RIGID_PRESSES):
            self.note(phase=Phase.RETRACT, repeat=repeat, surface_z_m=touched_z_m)
            yield from self.begun_again(partial(self.load, touched_z_m, lowest_m))
        self.note(phase=Phase.RETRACT)
        yield from self.go_to(self.home[2], self.arm.max_speed_m_per_s)
        yield from self.come_to_rest()

    def find_plate(self, lowest_m: float) -> Generator[Proposal, Observation, float]:
        """Go down until contact. Returns the height of the tip there."""
        while self.observation.contact.mean_N < CONTACT_FORCE_N:
            if self.observation.robot.target_pose[2] <= lowest_m + REACHED_M:
                travel_m = self.plan.search.max_travel_m
                raise SurfaceNotFound(f"no plate was met within search.max_travel_m of {travel_m:g} m; start nearer to it")
            yield from self.move(vz_m_per_s=self._towards(lowest_m, RIGID_SEARCH_M_PER_S))
        return self.observation.robot.z_m

    def load(self, touched_z_m: float, lowest_m: float) -> Steps:
        """Rest above the plate, then press it once.

        Args:
            touched_z_m: height at which the plate was met.
            lowest_m: height at which it counts as not rigid.

        Raises:
            SurfaceNotFound: the plate gave way.
        """
        yield from self.go_to(touched_z_m + 0.001, RIGID_SEARCH_M_PER_S * 4)
        yield from self.wait(BASELINE_S)
        self.note(phase=Phase.PRESS)
        while self.observation.contact.mean_N < RIGID_END * self.arm.contact_limit_N:
            if self.observation.robot.target_pose[2] <= lowest_m + REACHED_M:
                raise SurfaceNotFound("the plate gave way by the whole search distance; it is not rigid")
            yield from self.move(vz_m_per_s=self._towards(lowest_m, RIGID_SPEED_M_PER_S))
