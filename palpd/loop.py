"""The control loop. A tick is six sentences: observe, explain, decide, guard, act, record."""

import math
from collections import deque
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol

import numpy as np

from palpd.clock import Clock
from palpd.errors import PalpdError, Stopped
from palpd.inertial import InertialModel, Motion
from palpd.running_zero import RunningZero
from palpd.safety import Guard, Limits, Sight, guard, sentence
from palpd.sequence import Look, Sequence
from palpd.tare import Tare, base_from_sensor, tilt_rad, to_base
from palpd.tick import (
    STILL,
    Action,
    Contact,
    Floats,
    ForceSensor,
    Phase,
    Progress,
    Proposal,
    Request,
    Robot,
    RobotState,
    SensorFrames,
    Timing,
    Verdict,
)

LAST_TICKS = 50
ONE_FRAME = SensorFrames(np.zeros(1), np.zeros(1, np.uint16), np.zeros(1, np.uint16), np.zeros((1, 6)))


class Turn(NamedTuple):
    """All of one tick: what was seen, thought and done."""

    timing: Timing
    robot: RobotState
    frames: SensorFrames
    contact: Contact
    request: Request
    proposal: Proposal
    verdict: Verdict
    work_us: float


class Record(Protocol):
    """Where ticks go; never waits."""

    def __call__(self, turn: Turn) -> None: ...

    def rehearse(self, turn: Turn) -> None:
        """Do the same and keep nothing."""
        ...


@dataclass(slots=True)
class Outcome:
    """How a run ended. `reason` is a sentence where it was not simply done; `trips` are the guard's verdicts, one for each reason."""

    verdict: str = "done"
    reason: str = ""
    trips: list[Verdict] = field(default_factory=list)
    refused: bool = False
    ticks: int = 0
    missed: int = 0


@dataclass(slots=True)
class Explainer:
    """Turns raw frames into contact: axes, running tare, inertial prediction. `reference` (6,) is the tare of the last calibration.

    What the model leaves in free air, the running `zero` takes away (without one the bias is the model's own). Both together are bounded
    by `correction_limit_N` and the model's inputs by the range it was trained in, so they can hide at most that much of a contact; the
    absolute force never sees them.
    """

    reference: Floats
    rotation_about_flange_z_rad: float = 0.0
    model: InertialModel | None = None
    zero: RunningZero | None = None
    correction_limit_N: float = 0.0
    motion: Motion = field(default_factory=Motion)
    tare: Floats | None = None
    explained: int = 0
    out_of_range: int = 0
    last: Contact = field(default_factory=lambda: Contact(np.empty((0, 6)), np.empty(0)))

    def contact(self, robot: RobotState, frames: SensorFrames, clear_z_m: float = math.inf) -> Contact:
        """What the new frames say; without new frames the last numbers with no rows. Above `clear_z_m` the tip touches nothing."""
        self.motion.update(robot)
        if not len(frames):
            self.last = _without_rows(self.last)
            return self.last
        # two to eight rows: plain floats cost a third of numpy's calls on arrays this short
        wrenches = frames.wrench.tolist()
        rotation = base_from_sensor(robot.tcp_pose[3:], self.rotation_about_flange_z_rad)
        zero = (self.reference if self.tare is None else self.tare).tolist()
        x0_N, y0_N, z0_N, *_ = self.reference.tolist()
        tared = [to_base(wrench, zero, rotation) for wrench in wrenches]
        inertial_N = self._inertial(frames, tared, robot.z_m >= clear_z_m)
        forces_N = [row[2] - inertia for row, inertia in zip(tared, inertial_N, strict=True)]
        self.last = Contact(
            np.array(tared),
            np.array(inertial_N),
            force_N=largest(forces_N),
            mean_N=math.fsum(forces_N) / len(forces_N),
            lateral_N=largest([math.hypot(row[0], row[1]) for row in tared]),
            torque_Nm=largest([abs(torque) for row in tared for torque in row[3:]]),
            absolute_N=largest([math.hypot(x - x0_N, y - y0_N, z - z0_N) for x, y, z, *_ in wrenches]),
            zero_N=self.zero.zero_N if self.zero is not None else 0.0,
        )
        return self.last

    def notes(self) -> list[str]:
        """What the model could not do so far, for whoever reads the result."""
        if self.model is None:
            return []
        notes = list(self.model.warnings)
        if self.out_of_range:
            notes.append(
                f"{self.out_of_range / self.explained:.1%} of the samples moved faster or harder than the inertial model was trained for; "
                "there it was asked for the nearest edge: train on motion like that of the plan"
            )
        if self.model.not_finite:
            notes.append(f"the inertial model gave no number for {self.model.not_finite} samples; they stay uncorrected: train it again")
        return notes

    def _inertial(self, frames: SensorFrames, tared: list[list[float]], clear: bool) -> list[float]:
        """What model and zero take from fz at each sample. The zero learns from what the model leaves, where the tip is clear."""
        if self.model is None:
            return [0.0] * len(frames)
        t_s = frames.t_s.tolist()
        features = self.motion.features(t_s)
        self.explained += len(features)
        self.out_of_range += self.model.out_of_range(features)
        found_N, zero, limit_N = self.model.predict(features), self.zero, self.correction_limit_N
        if zero is not None and clear:
            found_N = [model_N + zero.step(at_s, row[2] - model_N) for at_s, row, model_N in zip(t_s, tared, found_N, strict=True)]
        elif zero is not None:
            found_N = [model_N + zero.zero_N for model_N in found_N]
        return [min(max(correction_N, -limit_N), limit_N) for correction_N in found_N]


def largest(values: list[float]) -> float:
    """The largest, or NaN if any is: max() would pass a NaN over, and the guard must see it."""
    return math.nan if any(map(math.isnan, values)) else max(values)


def _without_rows(contact: Contact) -> Contact:
    return replace(contact, tared=np.empty((0, 6)), inertial_N=np.empty(0))


@dataclass(slots=True)
class Loop:
    """One run: a robot, a sensor, a clock, a sequence and the guard between them and the wire."""

    robot: Robot
    sensor: ForceSensor
    clock: Clock
    sequence: Sequence
    explainer: Explainer
    limits: Limits
    record: Record
    request: Callable[[], Request] = lambda: Request.NONE
    stops: int = 3
    outcome: Outcome = field(default_factory=Outcome)
    _memory: Guard = field(default_factory=Guard)
    _tare: Tare = field(default_factory=Tare)
    _last: deque[Turn] = field(default_factory=lambda: deque(maxlen=LAST_TICKS))
    _work_us: float = 0.0
    _clear_z_m: float = math.inf

    def run(self) -> Outcome:
        """Turn until the sequence is over. However this is left, stop goes out `stops` times; the devices are closed by who opened them."""
        try:
            self._tare.reference = self.explainer.reference
            while self.turn():
                pass
        except PalpdError as error:
            self._stop()
            raise Stopped(str(error), list(self._last)) from error
        finally:
            self._stop()
        return self.outcome

    def rehearse(self, times: int = 100) -> None:
        """Do what a tick does short of deciding and acting, until caches and allocators are warm: a first time costs 20 ms."""
        motion = Motion(self.explainer.motion.sensor_delay_s)
        rehearsed = replace(self.explainer, motion=motion, zero=deepcopy(self.explainer.zero))
        for index in range(times):
            robot, frames = self.robot.read(), self.sensor.read()
            timing = Timing(index, robot.t_s, robot.t_s)
            contact = rehearsed.contact(robot, frames if len(frames) else ONE_FRAME, clear_z_m=-math.inf)
            sight = self._sight(timing, robot, frames, contact, Request.NONE, Progress())
            _, verdict = guard(self.limits, Guard(), sight, STILL)
            Tare().add(robot, frames)
            self.record.rehearse(Turn(timing, robot, frames, contact, Request.NONE, Proposal(), verdict, 0.0))

    def turn(self) -> bool:
        """One tick; false when it was the last."""
        timing = self.clock.wait()
        robot, frames = self.robot.read(), self.sensor.read()
        contact = self.explainer.contact(robot, frames, self._clear_z_m)
        request = self.request()
        proposal = self._decide(timing, robot, frames, contact, request)
        self._clear_z_m = proposal.progress.clear_z_m
        self._memory, verdict = guard(
            self.limits, self._memory, self._sight(timing, robot, frames, contact, request, proposal.progress), proposal.command
        )
        self._act(verdict)
        turn = Turn(timing, robot, frames, contact, request, proposal, verdict, self._work_us)
        self.record(turn)
        self._last.append(turn)
        self._work_us = self.clock.elapsed_us()
        return self._goes_on(timing, verdict)

    def _decide(self, timing: Timing, robot: RobotState, frames: SensorFrames, contact: Contact, request: Request) -> Proposal:
        if self.explainer.tare is not None:
            return self.sequence.step(Look(timing.now_s, robot, frames, contact, request))
        if self._tare.add(robot, frames):
            refusal = self._tare.refusal()
            if refusal is not None:
                self.outcome.verdict, self.outcome.reason, self.outcome.refused = "stopped", refusal, True
            self.explainer.tare = self._tare.result()
        return Proposal(STILL, Progress(phase=Phase.TARE))

    def _sight(
        self, timing: Timing, robot: RobotState, frames: SensorFrames, contact: Contact, request: Request, progress: Progress
    ) -> Sight:
        return Sight(
            timing,
            robot,
            frames,
            contact,
            request,
            floor_z_m=progress.floor_z_m,
            safe_z_m=progress.safe_z_m,
            tilt_rad=tilt_rad(robot.tcp_pose[3:]),
        )

    def _act(self, verdict: Verdict) -> None:
        if verdict.command.stop:
            self.robot.stop()
        else:
            self.robot.move(verdict.command.velocity_m_per_s)

    def _goes_on(self, timing: Timing, verdict: Verdict) -> bool:
        self.outcome.ticks += 1
        self.outcome.missed += timing.missed
        if verdict.trip and verdict.trip not in {before.trip for before in self.outcome.trips}:
            self.outcome.trips.append(verdict)
        if verdict.action == Action.STOP:
            self.outcome.verdict, self.outcome.reason = "stopped", "; then ".join(map(sentence, self.outcome.trips))
            return False
        if self.sequence.over and verdict.action == Action.PASS:
            if self.sequence.failure:
                self.outcome.verdict, self.outcome.reason = "stopped", self.sequence.failure
            return False
        return not self.outcome.refused

    def _stop(self) -> None:
        for _ in range(self.stops):
            self.robot.stop()
