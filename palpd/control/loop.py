"""The control loop. A tick is six sentences: observe, explain, decide, guard, act, record."""

import math
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from palpd.control.inertial import InertialModel, MotionFeatures
from palpd.control.running_zero import RunningZero
from palpd.control.safety import GuardState, Limits, guard, sentence
from palpd.control.sequence import Sequence
from palpd.control.slopes import FzSlopes
from palpd.control.tare import Tare, base_from_sensor, tilt_rad, to_base
from palpd.errors import PalpdError, Stopped
from palpd.tick import (
    MAX_FRAMES,
    STILL,
    Action,
    Clock,
    Contact,
    Floats,
    ForceSensor,
    Observation,
    Phase,
    Progress,
    Proposal,
    Request,
    Robot,
    RobotState,
    SensorFrames,
    TickRecord,
    Timing,
    Verdict,
)

ONE_FRAME = SensorFrames(np.zeros(1), np.zeros(1, np.uint16), np.zeros(1, np.uint16), np.zeros((1, 6)))
"""Stands for a frame in a rehearsal while none has come."""


class Record(Protocol):
    """Where ticks are kept; it never waits."""

    def __call__(self, record: TickRecord) -> None:
        """Keep one tick."""

    def rehearse(self, record: TickRecord) -> None:
        """Do the same work and keep nothing."""


@dataclass(slots=True)
class Outcome:
    """How a run ended. `reason` is a sentence unless the run was simply done; `trips` holds one verdict of the guard for each reason.

    `notes` say which presses a pause interrupted. `level`: the run ended on a way up over which the force stayed level.
    """

    verdict: str = "done"
    reason: str = ""
    trips: list[Verdict] = field(default_factory=list)
    refused: bool = False
    ticks: int = 0
    missed: int = 0
    notes: list[str] = field(default_factory=list)
    level: bool = False


@dataclass(slots=True)
class Explainer:
    """Turns raw frames into contact: axes, running tare, inertial prediction. `reference` (6,) is the tare of the last calibration.

    The running `zero` removes what the model leaves in free air; without it the bias is the model's own. `correction_limit_N` bounds both
    together, and the range of the training bounds the model's inputs. So they can hide at most that much of a contact. The absolute
    force contains neither, nor the correction for two `slopes` of Fz.
    """

    reference: Floats
    rotation_about_flange_z_rad: float = 0.0
    slopes: FzSlopes | None = None
    model: InertialModel | None = None
    zero: RunningZero | None = None
    correction_limit_N: float = 0.0
    motion: MotionFeatures = field(default_factory=MotionFeatures)
    tare: Floats | None = None
    explained: int = 0
    out_of_range: int = 0
    last: Contact = field(default_factory=lambda: Contact(np.empty((0, 6)), np.empty(0)))

    def contact(self, robot: RobotState, frames: SensorFrames, clear_z_m: float = math.inf) -> Contact:
        """Compute the contact from the new frames.

        Args:
            robot: newest state of the robot.
            frames: the frames since the last tick.
            clear_z_m: height above which the tip touches nothing, and the zero may learn.

        Returns:
            The contact; without new frames the last scalars and no rows.
        """
        self.motion.update(robot)
        if not len(frames):
            self.last = _without_rows(self.last)
            return self.last
        # plain floats: for two to eight rows they cost a third of numpy's calls
        wrenches = frames.wrench.tolist()
        rotation = base_from_sensor(robot.tcp_pose[3:], self.rotation_about_flange_z_rad)
        zero = (self.reference if self.tare is None else self.tare).tolist()
        x0_N, y0_N, z0_N, *_ = self.reference.tolist()
        linear = wrenches if self.slopes is None else [self.slopes.corrected(wrench, zero) for wrench in wrenches]
        tared = [to_base(wrench, zero, rotation) for wrench in linear]
        inertial_N = self._inertial(frames, tared, robot.z_m >= clear_z_m)
        forces_N = [row[2] - inertia for row, inertia in zip(tared, inertial_N, strict=True)]
        lateral_N, torques_Nm = [], []
        for fx, fy, _, tx, ty, tz in tared:
            lateral_N.append(math.hypot(fx, fy))
            torques_Nm += [abs(tx), abs(ty), abs(tz)]
        self.last = Contact(
            np.array(tared),
            np.array(inertial_N),
            force_N=largest(forces_N),
            mean_N=math.fsum(forces_N) / len(forces_N),
            lateral_N=largest(lateral_N),
            torque_Nm=largest(torques_Nm),
            absolute_N=largest([math.hypot(x - x0_N, y - y0_N, z - z0_N) for x, y, z, *_ in wrenches]),
            zero_N=self.zero.zero_N if self.zero is not None else 0.0,
        )
        return self.last

    def notes(self) -> list[str]:
        """Say what the model could not do so far, for the reader of the result."""
        if self.model is None:
            return []
        notes = list(self.model.warnings)
        if self.out_of_range:
            notes.append(
                f"{self.out_of_range / self.explained:.1%} of the samples moved faster or harder than the inertial model was trained for; "
                "it answered for the nearest edge of that range: train on motion like that of the plan"
            )
        if self.model.not_finite:
            notes.append(f"the inertial model gave no number for {self.model.not_finite} samples; they stay uncorrected: train it again")
        return notes

    def _inertial(self, frames: SensorFrames, tared: list[list[float]], clear: bool) -> list[float]:
        """What model and zero subtract from fz at each sample. Where the tip is clear, the zero learns from what the model leaves."""
        if self.model is None:
            return [0.0] * len(frames)
        t_s = frames.t_s.tolist()
        features = self.motion.features(t_s)
        self.explained += len(features)
        self.out_of_range += self.model.out_of_range(features)
        predicted_N, zero, limit_N = self.model.predict(features), self.zero, self.correction_limit_N
        if zero is not None and clear:
            predicted_N = [model_N + zero.step(at_s, row[2] - model_N) for at_s, row, model_N in zip(t_s, tared, predicted_N, strict=True)]
        elif zero is not None:
            predicted_N = [model_N + zero.zero_N for model_N in predicted_N]
        return [min(max(correction_N, -limit_N), limit_N) for correction_N in predicted_N]


def largest(values: list[float]) -> float:
    """Return the largest value, or NaN if any is NaN: max() would skip a NaN, and the guard must see it."""
    if math.isfinite(sum(values)):  # then each is
        return max(values)
    return math.nan if any(map(math.isnan, values)) else max(values)


def _without_rows(contact: Contact) -> Contact:
    return replace(contact, tared=np.empty((0, 6)), inertial_N=np.empty(0))


@dataclass(slots=True)
class Loop:
    """One run: a robot, a sensor, a clock, a sequence, and the guard between them and the wire.

    `refuse_tare` says why a tare (6,) may not begin a run, None where it may.
    """

    robot: Robot
    sensor: ForceSensor
    clock: Clock
    sequence: Sequence
    explainer: Explainer
    limits: Limits
    record: Record
    request: Callable[[], Request] = lambda: Request.NONE
    refuse_tare: Callable[[Observation, Floats], str | None] = lambda _observation, _wrench: None
    stops: int = 3
    outcome: Outcome = field(default_factory=Outcome)
    _guard_state: GuardState = field(default_factory=GuardState)
    _tare: Tare = field(default_factory=Tare)
    _work_us: float = 0.0
    _clear_z_m: float = math.inf

    def run(self) -> Outcome:
        """Tick until the sequence is over. However the run ends, stop goes out `stops` times; whoever opened the devices closes them."""
        try:
            while self.tick():
                pass
        except PalpdError as error:
            self._stop()
            raise Stopped(str(error)) from error
        finally:
            self._stop()
            self.outcome.notes, self.outcome.level = self.sequence.notes, self.sequence.level
        return self.outcome

    def rehearse(self, times: int = 100) -> None:
        """Do the work of a tick without deciding or acting, until caches and allocators are warm: a first tick costs 20 ms."""
        motion = MotionFeatures(self.explainer.motion.sensor_delay_s)
        explainer = replace(self.explainer, motion=motion, zero=deepcopy(self.explainer.zero))
        proposal = Proposal()
        for index in range(times):
            robot, frames = self.robot.read(), self.sensor.read().newest(MAX_FRAMES)
            timing = Timing(index, robot.t_s, robot.t_s)
            contact = explainer.contact(robot, frames if len(frames) else ONE_FRAME, clear_z_m=-math.inf)
            observation = Observation(timing, robot, frames, contact, Request.NONE, tilt_rad(robot.tcp_pose[3:]))
            _, verdict = guard(self.limits, GuardState(), observation, proposal.progress, STILL)
            Tare().add(robot, frames)
            self.record.rehearse(TickRecord(observation, proposal, verdict, 0.0))

    def tick(self) -> bool:
        """Observe, explain, decide, guard, act, record. Returns false when this was the last tick."""
        timing, robot, frames = self._observe()
        observation = self._explain(timing, robot, frames)
        proposal = self._decide(observation)
        verdict = self._guard(observation, proposal)
        self._act(verdict)
        self._keep(observation, proposal, verdict)
        return self._goes_on(timing, verdict)

    def _observe(self) -> tuple[Timing, RobotState, SensorFrames]:
        # A tick decides by the frames that its row can hold, or a replay could not decide the same. More come only after a stall.
        return self.clock.wait(), self.robot.read(), self.sensor.read().newest(MAX_FRAMES)

    def _explain(self, timing: Timing, robot: RobotState, frames: SensorFrames) -> Observation:
        contact = self.explainer.contact(robot, frames, self._clear_z_m)
        return Observation(timing, robot, frames, contact, self.request(), tilt_rad(robot.tcp_pose[3:]))

    def _decide(self, observation: Observation) -> Proposal:
        if self.explainer.tare is not None:
            proposal = self.sequence.step(observation)
        else:
            proposal = Proposal(STILL, Progress(phase=Phase.TARE))
            self._take_tare(observation)
        self._clear_z_m = proposal.progress.clear_z_m
        return proposal

    def _take_tare(self, observation: Observation) -> None:
        if self._tare.add(observation.robot, observation.frames):
            refusal = self._tare.refusal() or self.refuse_tare(observation, self._tare.result())
            if refusal is not None:
                self.outcome.verdict, self.outcome.reason, self.outcome.refused = "stopped", refusal, True
            self.explainer.tare = self._tare.result()

    def _guard(self, observation: Observation, proposal: Proposal) -> Verdict:
        self._guard_state, verdict = guard(self.limits, self._guard_state, observation, proposal.progress, proposal.command)
        return verdict

    def _act(self, verdict: Verdict) -> None:
        if verdict.command.stop:
            self.robot.stop()
        else:
            self.robot.move(verdict.command.velocity_m_per_s)

    def _keep(self, observation: Observation, proposal: Proposal, verdict: Verdict) -> None:
        self.record(TickRecord(observation, proposal, verdict, self._work_us))
        self._work_us = self.clock.elapsed_us()

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
                self.outcome.verdict, self.outcome.reason, self.outcome.refused = "stopped", self.sequence.failure, self.sequence.refused
            return False
        return not self.outcome.refused

    def _stop(self) -> None:
        for _ in range(self.stops):
            self.robot.stop()
