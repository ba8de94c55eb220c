"""The palpation sequence: what the arm should do next, written as scripts that read from top to bottom.

A script is a generator: it yields a proposal (a tip speed and where in the plan it stands) and gets the next look at the cell.
It knows no clock, no device and no guard, so the same looks give the same proposals bit for bit.
"""

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Generator
from dataclasses import dataclass, replace

import numpy as np

from palpd.config import CONTACT_FORCE_N, Plan
from palpd.tick import STILL, Command, Contact, Mode, Phase, Progress, Proposal, Request, RobotState, SensorFrames
from palpd.young import FEWEST_SAMPLES, surface_from_approach

GAIN_PER_S = 8.0
"""Speed asked per metre still to go. The controller's target answers two to three cycles later: 8/s × 24 ms leaves 78° of phase."""
REACHED_M = 1e-5
ACHIEVED_M = 3e-5
TRIM_BELOW_M_PER_S = 0.001
TRIM_GAIN_PER_S = 2.0
TRIM_LIMIT_M = 2e-4
"""Below the guard's margin of depth, so that trimming alone can never trip it."""
PATIENCE_S = 5.0
REACTION_S = 0.1
"""From a force to the arm at rest, rounded up; `palpd check-config` prints the terms."""
SOFT_END = 0.9
"""Share of the contact limit at which the sequence ends a press by itself, before the guard has to."""
BASELINE_S = 0.5
CLEAR_SHARE = 0.5
"""Of the safe height above a surface that was found: higher than this the tip is clear of tissue that bulges or clings."""
CLEAR_BELOW_HOME_M = 0.001
"""Where the run was tared and the arm travels is free air; the arm may be seen so far below its target."""
SETTLE_WINDOW_S = 0.5
SETTLED_N = 0.02
"""Change between two windows below which a force counts as stable: their means differ by 3 mN of noise alone."""
MOST_SETTLE_S = 20.0
APPROACH_KEPT_S = 4.0
"""Of the way down to the surface this much is kept for the fit: 2 cm at 5 mm/s."""
FREE_STROKE_M = 0.02
FREE_CYCLES = 10
FREE_SPEED_M_PER_S = 0.02
RIGID_PRESSES = 3
RIGID_SEARCH_M_PER_S = 0.0005
RIGID_SPEED_M_PER_S = 0.0002
RIGID_END = 0.7
"""A plate stops nothing softly: at 200 N/mm and 80 ms of delays these speeds overshoot by 8 N and 3 N."""


@dataclass(frozen=True, slots=True)
class Look:
    """What the sequence sees in one tick."""

    now_s: float
    robot: RobotState
    frames: SensorFrames
    contact: Contact
    request: Request = Request.NONE


@dataclass(frozen=True, slots=True)
class Body:
    """What the sequence must know of the probe, sensor and machine; m, N, N/m, s. `delay_s` is the sensor filter's."""

    tip_radius_m: float
    contact_limit_N: float
    max_speed_m_per_s: float
    delay_s: float
    machine_stiffness_N_per_m: float = math.inf


class SurfaceNotFound(Exception):
    """The search met nothing, or what it saw cannot be believed; the sentence says why."""


Turn = Generator[Proposal, Look, None]


class Sequence:
    """A script under way. `step` gives the next proposal, `over` says that the plan has ended, `failure` why it could not."""

    def __init__(self, script: "Script") -> None:
        self._script = script
        self._turns: Turn | None = None
        self._paused = False
        self.over = False
        self.failure: str | None = None

    def step(self, look: Look) -> Proposal:
        """Next proposal for what is seen now."""
        if look.request == Request.PAUSE:
            self._paused = True
        if look.request == Request.RESUME:
            self._paused = False
        if self._paused and not self.over:
            return Proposal(STILL, replace(self._script.progress, phase=Phase.PAUSED, clear_z_m=math.inf))
        try:
            if self._turns is None:
                self._script.begin(look)
                self._turns = self._script.run()
                return next(self._turns)
            return self._turns.send(look)
        except StopIteration:
            self.over = True
        except SurfaceNotFound as failure:
            self.over, self.failure = True, str(failure)
        return Proposal(STILL, replace(self._script.progress, phase=Phase.DONE))


class Script(ABC):
    """The steps that every script is made of. `look` is always the newest; `progress` travels with each proposal."""

    def __init__(self, body: Body) -> None:
        self.body = body
        self.progress = Progress()
        self.look: Look
        self.home: tuple[float, float, float]

    @abstractmethod
    def run(self) -> Turn:
        """The whole script."""

    def begin(self, look: Look) -> None:
        """Where the arm stands is home."""
        self.look = look
        x_m, y_m, z_m = look.robot.target_pose[:3]
        self.home = (x_m, y_m, z_m)
        self.note(safe_z_m=z_m, floor_z_m=z_m)

    def note(self, **changes: object) -> None:
        """Remember where in the plan we are."""
        self.progress = replace(self.progress, **changes)  # type: ignore[arg-type]

    def move(self, vx: float = 0.0, vy: float = 0.0, vz: float = 0.0) -> Turn:
        """One tick at this speed."""
        self.look = yield Proposal(Command((vx, vy, vz)), self.progress)

    def wait(self, duration_s: float) -> Turn:
        """Stand still for this long."""
        until_s = self.look.now_s + duration_s
        while self.look.now_s < until_s:
            yield from self.move()

    def travel(self, x_m: float, y_m: float) -> Turn:
        """Go sideways, at this height, to a place given in base axes."""
        self.note(phase=Phase.TRAVEL, mode=Mode.NONE, floor_z_m=self.look.robot.target_pose[2])
        while True:
            dx, dy = x_m - self.look.robot.target_pose[0], y_m - self.look.robot.target_pose[1]
            away_m = math.hypot(dx, dy)
            if away_m < REACHED_M:
                break
            speed = min(self.body.max_speed_m_per_s, GAIN_PER_S * away_m)
            yield from self.move(vx=speed * dx / away_m, vy=speed * dy / away_m)
        yield from self.come_to_rest()

    def go_to(self, z_m: float, speed_m_per_s: float) -> Turn:
        """Go up or down to this height without regard to force: for free air and for leaving the tissue."""
        while abs(z_m - self.look.robot.target_pose[2]) > REACHED_M:
            yield from self.move(vz=self._towards(z_m, speed_m_per_s))

    def come_to_rest(self) -> Turn:
        """Wait until the arm, which lags behind its target, stands still (at most a second)."""
        until_s = self.look.now_s + 1.0
        while self.look.now_s < until_s:
            pose, target = self.look.robot.tcp_pose, self.look.robot.target_pose
            if math.dist(pose[:3], target[:3]) < ACHIEVED_M:
                return
            yield from self.move()

    def tip_z_m(self) -> float:
        """Height of the tip: what the robot reports plus what sensor and arm gave way, which its encoders do not see."""
        return self.look.robot.z_m + self.look.contact.mean_N / self.body.machine_stiffness_N_per_m

    def _towards(self, z_m: float, speed_m_per_s: float) -> float:
        away_m = z_m - self.look.robot.target_pose[2]
        return math.copysign(min(speed_m_per_s, GAIN_PER_S * abs(away_m)), away_m)


class Palpation(Script):
    """The plan: at every site find the surface, then press to every depth, held still or in motion."""

    def __init__(self, plan: Plan, body: Body) -> None:
        super().__init__(body)
        self.plan = plan
        self.trim_m = 0.0

    def run(self) -> Turn:
        """From the first site to the last, ending above it at the height of the start."""
        for index, site in enumerate(self.plan.sites):
            self.note(site=index, mode=Mode.NONE, depth_m=math.nan, surface_z_m=math.nan, repeat=-1, cut_short=False)
            self.note(clear_z_m=self.home[2] - CLEAR_BELOW_HOME_M)
            yield from self.travel(self.home[0] + site.x_m, self.home[1] + site.y_m)
            yield from self.move_freely()
            if not self.plan.depths_m:
                continue
            surface_z_m = yield from self.find_surface()
            self.note(surface_z_m=surface_z_m, safe_z_m=surface_z_m + self.plan.safe_height_m)
            if self.plan.mode in ("static", "both"):
                for depth_m in self.plan.depths_m:
                    yield from self.press_and_hold(surface_z_m, depth_m)
            if self.plan.mode in ("dynamic", "both"):
                for depth_m in self.plan.depths_m:
                    for repeat in range(self.plan.repeats):
                        self.note(repeat=repeat)
                        yield from self.press_and_leave(surface_z_m, depth_m)
            self.note(phase=Phase.RETRACT, mode=Mode.NONE, depth_m=math.nan, cut_short=False, safe_z_m=self.home[2])
            yield from self.go_to(self.home[2], self.body.max_speed_m_per_s)
            yield from self.come_to_rest()

    def move_freely(self) -> Turn:
        """The strokes in the air that the plan asks for here."""
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

    def find_surface(self) -> Generator[Proposal, Look, float]:
        """Go down until contact, fit the contact law to the way there, and leave. Returns the surface's height."""
        search = self.plan.search
        lowest_m = self.look.robot.target_pose[2] - search.max_travel_m
        self.note(phase=Phase.BASELINE, mode=Mode.SEARCH)
        baseline_N = yield from self.mean_force(BASELINE_S)
        kept = round(APPROACH_KEPT_S / 0.002)
        robot_track: deque[tuple[float, float]] = deque(maxlen=kept)
        force_track: deque[tuple[float, float]] = deque(maxlen=kept)
        force_N = 0.0
        self.note(phase=Phase.SEARCH, floor_z_m=lowest_m, clear_z_m=math.inf)
        while force_N < CONTACT_FORCE_N:
            if self.look.robot.target_pose[2] <= lowest_m + REACHED_M:
                raise SurfaceNotFound(
                    f"no contact of {CONTACT_FORCE_N:g} N was met within search.max_travel_m of {search.max_travel_m:g} m; "
                    "start nearer to the tissue or allow a longer way"
                )
            yield from self.move(vz=self._towards(lowest_m, search.speed_m_per_s))
            if len(self.look.frames):
                force_N = float(np.mean(self.look.contact.tared[:, 2])) - baseline_N
                if force_N < -CONTACT_FORCE_N:
                    raise SurfaceNotFound(
                        f"the force fell to {force_N:.1f} N in the search, where tissue can only press: the sensor's zero moves, or its "
                        "sign is wrong, and either would hide the surface; check it with palpd doctor --weight-N"
                    )
                mean_t_s = float(np.mean(self.look.frames.t_s)) - self.body.delay_s
                force_track.append((mean_t_s, force_N))
            robot_track.append((self.look.robot.t_s, self.look.robot.z_m))
        yield from self.move()
        robot, force = np.array(robot_track), np.array(force_track)
        height_m = np.interp(force[:, 0], robot[:, 0], robot[:, 1]) + force[:, 1] / self.body.machine_stiffness_N_per_m
        seen = force[:, 0] <= robot[-1, 0]  # a robot state newer than the frame, else its height would be guessed
        if int(seen.sum()) < FEWEST_SAMPLES:
            raise SurfaceNotFound(
                f"{force_N:.1f} N stood there {len(force)} ticks after the search began: the probe touches something already, or the "
                "sensor's zero moved; start higher above the tissue, or tare again"
            )
        surface_z_m, _ = surface_from_approach(height_m[seen], force[seen, 1], self.body.tip_radius_m)
        self.note(phase=Phase.RETRACT, surface_z_m=surface_z_m, clear_z_m=surface_z_m + CLEAR_SHARE * self.plan.safe_height_m)
        yield from self.go_to(surface_z_m + self.plan.safe_height_m, self.body.max_speed_m_per_s)
        yield from self.come_to_rest()
        return surface_z_m

    def press_and_hold(self, surface_z_m: float, depth_m: float) -> Turn:
        """Static palpation: press, hold until the force is stable, then record the hold of which the mean counts."""
        yield from self.prepare(Mode.STATIC, depth_m)
        yield from self.press(surface_z_m, depth_m, settle=True)
        if not self.progress.cut_short:
            self.note(phase=Phase.HOLD)
            until_s = self.look.now_s + self.plan.hold_s
            while self.look.now_s < until_s and not self._soft_end():
                yield from self.hold_depth(surface_z_m - depth_m)
        yield from self.leave(surface_z_m, self.body.max_speed_m_per_s)

    def press_and_leave(self, surface_z_m: float, depth_m: float) -> Turn:
        """Dynamic palpation: press to the depth and leave at once."""
        yield from self.prepare(Mode.DYNAMIC, depth_m)
        yield from self.press(surface_z_m, depth_m, settle=False)
        yield from self.leave(surface_z_m, self.plan.press_speed_m_per_s)

    def prepare(self, mode: Mode, depth_m: float) -> Turn:
        """Stand still above the surface for the force baseline of the press to come."""
        self.note(phase=Phase.BASELINE, mode=mode, depth_m=depth_m, cut_short=False)
        yield from self.wait(BASELINE_S)

    def press(self, surface_z_m: float, depth_m: float, settle: bool) -> Turn:
        """Go down to the depth; end early, and say so, where the force nears its limit."""
        goal_z_m = surface_z_m - depth_m
        give_m = self.body.contact_limit_N / self.body.machine_stiffness_N_per_m
        self.note(phase=Phase.PRESS, floor_z_m=goal_z_m - give_m)
        patience_s = self.look.now_s + 2.0 * (self.plan.safe_height_m + depth_m) / self.plan.press_speed_m_per_s + PATIENCE_S
        while self.tip_z_m() > goal_z_m + ACHIEVED_M and self.look.now_s < patience_s:
            if self._soft_end():
                self.note(cut_short=True)
                return
            yield from self.hold_depth(goal_z_m)
        if settle:
            yield from self.settle(goal_z_m)

    def settle(self, goal_z_m: float) -> Turn:
        """Hold the depth until two following windows of force agree (or long enough has passed)."""
        until_s = self.look.now_s + MOST_SETTLE_S
        last_N = math.inf
        while self.look.now_s < until_s:
            window_s = self.look.now_s + SETTLE_WINDOW_S
            forces: list[float] = []
            while self.look.now_s < window_s:
                if self._soft_end():
                    self.note(cut_short=True)
                    return
                yield from self.hold_depth(goal_z_m)
                forces.append(self.look.contact.mean_N)
            mean_N = math.fsum(forces) / len(forces)
            if abs(mean_N - last_N) < max(SETTLED_N, 0.002 * abs(mean_N)):
                return
            last_N = mean_N

    def hold_depth(self, goal_z_m: float) -> Turn:
        """One tick towards this height of the tip, or of keeping it there, whatever the machine gives way.

        The controller's target answers without lag and is what is steered; what the arm stays away from it when nearly at rest
        is trimmed slowly, within a bound.
        """
        before_s = self.look.now_s
        yield from self.move(vz=self._towards(self._reported(goal_z_m) + self.trim_m, self._governed_speed()))
        if abs(self.look.robot.target_speed[2]) < TRIM_BELOW_M_PER_S:
            missing_m = goal_z_m - self.tip_z_m()
            wanted_m = self.trim_m + TRIM_GAIN_PER_S * missing_m * (self.look.now_s - before_s)
            self.trim_m = min(max(wanted_m, -TRIM_LIMIT_M), TRIM_LIMIT_M)

    def _governed_speed(self) -> float:
        """Press speed, less where the tissue seen so far would carry the force past the contact limit before the arm is at rest.

        v <= (limit - F) / (k t) with the slope k = 3F/2d of Hertz's law through the present force and depth.
        """
        force_N, depth_m = self.look.contact.mean_N, self.progress.surface_z_m - self.tip_z_m()
        if force_N <= 0.0 or depth_m <= 0.0:
            return self.plan.press_speed_m_per_s
        stiffness_N_per_m = 1.5 * force_N / depth_m
        room_N = max(self.body.contact_limit_N - force_N, 0.0)
        return min(self.plan.press_speed_m_per_s, room_N / (stiffness_N_per_m * REACTION_S))

    def leave(self, surface_z_m: float, speed_m_per_s: float) -> Turn:
        """Back to the safe height."""
        self.note(phase=Phase.RETRACT)
        yield from self.go_to(surface_z_m + self.plan.safe_height_m, speed_m_per_s)
        yield from self.come_to_rest()

    def mean_force(self, duration_s: float) -> Generator[Proposal, Look, float]:
        """Mean of fz (tared, not compensated) over a rest."""
        until_s = self.look.now_s + duration_s
        sums: list[float] = []
        while self.look.now_s < until_s or not sums:
            yield from self.move()
            sums.extend(self.look.contact.tared[:, 2].tolist())
        return math.fsum(sums) / len(sums)

    def _reported(self, tip_z_m: float) -> float:
        """Height the robot must report for the tip to be there; the force may not ask for more give than its limit has."""
        force_N = min(max(self.look.contact.mean_N, 0.0), self.body.contact_limit_N)
        return tip_z_m - force_N / self.body.machine_stiffness_N_per_m

    def _soft_end(self) -> bool:
        return self.look.contact.mean_N >= SOFT_END * self.body.contact_limit_N


class Watch(Script):
    """Moves nothing: shows what the devices say, what contact it would be and what the guard thinks of it."""

    def __init__(self, body: Body, duration_s: float) -> None:
        super().__init__(body)
        self.duration_s = duration_s

    def run(self) -> Turn:
        """For so long."""
        self.note(phase=Phase.IDLE, floor_z_m=-math.inf)
        yield from self.wait(self.duration_s)


class FreeMotion(Script):
    """Two centimetres up and down, ten times, touching nothing: what the inertial model learns from."""

    def __init__(self, body: Body, cycles: int = FREE_CYCLES, speed_m_per_s: float = FREE_SPEED_M_PER_S) -> None:
        super().__init__(body)
        self.cycles = cycles
        self.speed_m_per_s = min(speed_m_per_s, body.max_speed_m_per_s)

    def run(self) -> Turn:
        """All cycles, ending where they began."""
        self.note(phase=Phase.BASELINE, mode=Mode.FREE_MOTION)
        yield from self.wait(BASELINE_S)
        self.note(phase=Phase.FREE_MOTION)
        for cycle in range(self.cycles):
            self.note(repeat=cycle)
            for z_m in (self.home[2] + FREE_STROKE_M, self.home[2]):
                yield from self.go_to(z_m, self.speed_m_per_s)
                yield from self.come_to_rest()


class RigidPress(Script):
    """Press a rigid plate, slowly: what moves then is the machine itself."""

    def __init__(self, plan: Plan, body: Body) -> None:
        super().__init__(body)
        self.plan = plan

    def run(self) -> Turn:
        """Find the plate by force, then load and unload it up to the soft end, three times."""
        search = self.plan.search
        lowest_m = self.home[2] - search.max_travel_m
        self.note(phase=Phase.SEARCH, mode=Mode.STIFFNESS, floor_z_m=lowest_m)
        while self.look.contact.mean_N < CONTACT_FORCE_N:
            if self.look.robot.target_pose[2] <= lowest_m + REACHED_M:
                raise SurfaceNotFound(f"no plate was met within search.max_travel_m of {search.max_travel_m:g} m; start nearer to it")
            yield from self.move(vz=self._towards(lowest_m, RIGID_SEARCH_M_PER_S))
        touched_z_m = self.look.robot.z_m
        for repeat in range(RIGID_PRESSES):
            self.note(phase=Phase.RETRACT, repeat=repeat, surface_z_m=touched_z_m)
            yield from self.go_to(touched_z_m + 0.001, RIGID_SEARCH_M_PER_S * 4)
            yield from self.wait(BASELINE_S)
            self.note(phase=Phase.PRESS)
            while self.look.contact.mean_N < RIGID_END * self.body.contact_limit_N:
                if self.look.robot.target_pose[2] <= lowest_m + REACHED_M:
                    raise SurfaceNotFound("the plate gave way by the whole search distance; it is not rigid")
                yield from self.move(vz=self._towards(lowest_m, RIGID_SPEED_M_PER_S))
        self.note(phase=Phase.RETRACT)
        yield from self.go_to(self.home[2], self.body.max_speed_m_per_s)
        yield from self.come_to_rest()
