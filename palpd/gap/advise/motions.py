"""Motions that a plan can describe, and what they may ask of a cell."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from palpd.cell.cell_file import CellFile
from palpd.cell.simulation import predict_motion
from palpd.gap.assumptions import ASSUMED
from palpd.gap.data.phases import Phases
from palpd.gap.model.problem import Problem
from palpd.recording.samples import Samples
from palpd.tick import Floats

FREE_HEIGHT_M = 0.02
"""Largest length of free strokes, which is that of `palpd free-motion`."""


@dataclass(frozen=True)
class MotionLimits:
    """What a motion may ask of a cell: depth and force of presses, height of home above the surface, strokes up from there, speeds."""

    depth_m: float
    force_N: float
    home_m: float
    stroke_m: float
    press_speed_m_per_s: float
    free_speed_m_per_s: float
    acceleration_m_per_s2: float

    @staticmethod
    def of(problem: Problem) -> "MotionLimits":
        """The largest depth, force, height, speed and acceleration of the recordings: they were safe."""
        samples, phases = [its.samples for its in problem.recordings], [its.phases for its in problem.recordings]
        pressing = [_speed(its, 0.9, its.depth_m > 0.0) for its in phases if (its.depth_m > 0.0).any()]
        free_speed = max(_speed(its, 0.98, np.ones(len(its.depth_m), bool)) for its in phases)
        depth_m = max(float(its.depth_m.max()) for its in phases)
        height_m = max(max(float(its.z_m.max()) for its in samples) - surface_of(problem), 0.2 * depth_m)
        stroke_m = min(FREE_HEIGHT_M, 0.8 * height_m)
        return MotionLimits(
            depth_m=depth_m,
            force_N=max(float(np.quantile(its.wrench[:, 2], 0.999)) for its in samples),
            home_m=height_m - stroke_m,
            stroke_m=stroke_m,
            press_speed_m_per_s=max(pressing, default=free_speed),
            free_speed_m_per_s=free_speed,
            acceleration_m_per_s2=max(float(np.quantile(np.abs(its.motion.az_m_per_s2), 0.99)) for its in problem.recordings),
        )


def _speed(phases: Phases, share: float, where: NDArray[np.bool_]) -> float:
    """Quantile of the speed in m/s at some samples (n,); where that is a speed at rest, the median of the samples that move."""
    speed, moving = np.abs(phases.velocity_m_per_s), where & phases.moving
    quantile = float(np.quantile(speed[where], share))
    return float(np.median(speed[moving])) if moving.any() and quantile < speed[moving].min() else quantile


def surface_of(problem: Problem) -> float:
    """Height of the surface in m; without tissue, the lowest height of the tip."""
    lowest_m = min(float(recording.samples.z_m.min()) for recording in problem.recordings)
    return problem.cell.tissue.surface_z_m if problem.cell.tissue is not None else lowest_m


@dataclass(frozen=True)
class TestMotion:
    """A motion that a plan can describe: strokes in the air, then presses.

    Attributes:
        what: What a person would do, as a sentence without a capital.
        depths_m: Depths below the surface; empty without presses.
        hold_s: Rest in a static press, to which 1 s is added.
        repeats: Number of dynamic presses to each depth.
        height_m: Height above the surface to which the probe returns after each press.
        mode: `static` (presses with a rest), `dynamic` (presses without a rest) or `both`.
        strokes: Number of strokes up from home and down again.
    """

    __test__: ClassVar[bool] = False  # pytest does not collect it

    what: str
    depths_m: tuple[float, ...] = ()
    speed_m_per_s: float = 0.01
    hold_s: float = 0.1
    repeats: int = 1
    height_m: float = 0.01
    mode: str = "dynamic"
    strokes: int = 0
    stroke_m: float = FREE_HEIGHT_M
    stroke_speed_m_per_s: float = 0.02

    def legs(self, surface_m: float, home_m: float) -> list[tuple[float, float, float]]:
        """Strokes up from home, then presses.

        Args:
            home_m: Height at which strokes begin.

        Returns:
            For every leg the height to go to in m, the speed in m/s, and the rest afterwards in s.
        """
        legs: list[tuple[float, float, float]] = []
        for _ in range(self.strokes):
            legs += [(home_m + self.stroke_m, self.stroke_speed_m_per_s, 0.15), (home_m, self.stroke_speed_m_per_s, 0.15)]
        top_m = surface_m + self.height_m
        if self.depths_m:
            legs.append((top_m, self.speed_m_per_s, 0.7))
        for mode, rest_s in (("static", self.hold_s + 1.0), ("dynamic", 0.0)):
            if self.mode in (mode, "both"):
                for depth_m in self.depths_m:
                    for _ in range(1 if mode == "static" else self.repeats):
                        legs += [(surface_m - depth_m, self.speed_m_per_s, rest_s), (top_m, self.speed_m_per_s, 0.7)]
        return legs

    def start_m(self, surface_m: float, home_m: float) -> float:
        """Height in m at which the motion begins with a rest of one second.

        Args:
            home_m: Height at which strokes begin.
        """
        return home_m if self.strokes else surface_m + self.height_m

    def heights(self, step_s: float, surface_m: float, home_m: float, acceleration_m_per_s2: float) -> tuple[Floats, Floats]:
        """Commanded heights over time.

        Args:
            home_m: Height at which strokes begin.
            acceleration_m_per_s2: At both ends of every leg, between which the speed is constant.

        Returns:
            Times (n,) in s and heights (n,) in m.
        """
        z_m = self.start_m(surface_m, home_m)
        pieces = [np.full(max(2, round(1.0 / step_s)), z_m)]
        for to_m, speed, rest_s in self.legs(surface_m, home_m):
            pieces += [_stroke(z_m, to_m, speed, acceleration_m_per_s2, step_s), np.full(round(rest_s / step_s), to_m)]
            z_m = to_m
        heights_m = np.concatenate(pieces)
        return np.asarray(np.arange(len(heights_m)) * step_s), np.asarray(heights_m)

    def plan(self) -> dict[str, Any]:
        """The motion as a plan for `palpd run`."""
        presses = {
            "mode": self.mode,
            "depths_m": [float(d) for d in self.depths_m],
            "press_speed_m_per_s": float(self.speed_m_per_s),
            "repeats": self.repeats,
            "hold_s": float(self.hold_s),
            "safe_height_m": float(self.height_m),
        }
        strokes = {"strokes": self.strokes, "height_m": float(self.stroke_m), "speed_m_per_s": float(self.stroke_speed_m_per_s)}
        return (presses if self.depths_m else {"depths_m": []}) | ({"free": strokes} if self.strokes else {})


def _stroke(from_m: float, to_m: float, speed: float, acceleration: float, step_s: float) -> Floats:
    """Heights of a stroke with trapezoidal speed."""
    way_m = abs(to_m - from_m)
    top = min(speed, (way_m * acceleration) ** 0.5)
    ramp_s = top / acceleration
    duration_s = way_m / top + ramp_s if top > 0 else 0.0  # not way_m: its product with the acceleration may be too small for a number
    t = np.arange(1, ceil(duration_s / step_s) + 1) * step_s
    first, last = np.minimum(t, ramp_s), np.clip(t - (duration_s - ramp_s), 0.0, ramp_s)
    middle = np.clip(t - ramp_s, 0.0, duration_s - ramp_s)
    gone = 0.5 * acceleration * first**2 + top * middle - 0.5 * acceleration * last**2
    return np.asarray(from_m + np.sign(to_m - from_m) * np.minimum(gone, way_m))


def motions(limits: MotionLimits) -> list[TestMotion]:
    """The motions that are tried, all within the limits; without a depth only strokes in the air."""
    depth, stroke = limits.depth_m, limits.stroke_m
    fast, air = limits.press_speed_m_per_s, limits.free_speed_m_per_s
    low = max(0.5 * depth, 0.2 * stroke)

    def strokes(what: str, count: int, speed: float) -> TestMotion:
        return TestMotion(what, height_m=low, strokes=count, stroke_m=stroke, stroke_speed_m_per_s=speed)

    out = [
        strokes("move up and down in the air, fast", 12, air),
        strokes("move up and down in the air, fast, for long", 40, air),
        strokes("move up and down in the air, slowly", 4, 0.15 * air),
    ]
    if depth <= 0.0:
        return out
    return [
        *out,
        TestMotion("press in small steps of depth", tuple(depth * s for s in (0.2, 0.4, 0.6, 0.8, 1.0)), 0.5 * fast, 1.0, 1, low, "both"),
        TestMotion("press to eight depths, again and again", tuple(depth * s / 8.0 for s in range(1, 9)), fast, 0.2, 4, low, "dynamic"),
        TestMotion("press lightly and often", (0.15 * depth, 0.3 * depth), fast, 0.3, 8, low, "dynamic"),
        TestMotion("press to the full depth as fast as before", (depth,), fast, 0.2, 5, low, "dynamic"),
        TestMotion("press slowly to the full depth", (depth,), 0.15 * fast, 0.5, 1, low, "dynamic"),
        TestMotion("press and hold for long", (depth,), fast, 20.0, 1, low, "static"),
        TestMotion("press and hold at two depths", (0.4 * depth, depth), fast, 8.0, 1, low, "static"),
        TestMotion("move fast in the air, then press to two depths", (0.5 * depth, depth), fast, 2.0, 2, low, "both", 8, stroke, air),
    ]


LONG_HOLD_S = 1.0
"""Time at rest in the tissue from which on a press is a hold."""

DEPTH_STEP = 0.05
"""Share of the largest depth to which the depths of a plan are rounded, since no two presses are equally deep."""


def same_again(problem: Problem, limits: MotionLimits) -> tuple[TestMotion, Floats, Floats]:
    """The motion of the longest recording, once more.

    Returns:
        A motion for a plan with the same depths, speeds, holds and strokes; the recorded times (n,) from the first row and heights (n,).
    """
    longest = max(problem.recordings, key=lambda recording: recording.samples.duration_s)
    samples, phases, surface_m = longest.samples, longest.phases, surface_of(problem)
    presses = [phases.press == k for k in range(phases.presses)]
    step_m = DEPTH_STEP * limits.depth_m
    depths = [min(max(round(float(phases.depth_m[press].max()) / step_m), 1) * step_m, limits.depth_m) for press in presses]
    held_s = [float((press & ~phases.moving).sum()) / samples.rate_Hz for press in presses]
    long_s = [held for held in held_s if held >= LONG_HOLD_S]
    quick = len(presses) - len(long_s)
    listed = tuple(dict.fromkeys(depths))
    air = phases.moving & (phases.depth_m == 0.0)
    strokes = int((np.diff(air.astype(int), prepend=0) > 0).sum()) // 2 - len(presses)
    top_m = float(np.median(samples.z_m[phases.depth_m == 0.0])) - surface_m if air.any() else 0.0
    motion = TestMotion(
        "record the same motion again",
        listed,
        limits.press_speed_m_per_s,
        float(np.median(long_s)) if long_s else max(float(np.median(held_s)), 0.1) if held_s else 0.1,
        max(1, round(quick / len(listed))) if listed else 1,
        min(max(top_m, 0.5 * limits.depth_m), limits.home_m + limits.stroke_m),
        "static" if not quick else "both" if long_s else "dynamic",
        max(strokes, 0 if listed else 1),
        limits.stroke_m,
        limits.free_speed_m_per_s,
    )
    return motion, samples.t_s - samples.t_s[0], samples.z_cmd_m if samples.z_cmd_m is not None else samples.z_m


def cycle_again(problem: Problem, recording: int, cycle: int, limits: MotionLimits) -> TestMotion:
    """The press or stroke of a cycle of a recording, `advice.again` times, as deep and as fast as it was within the limits."""
    phases, samples = problem.recordings[recording].phases, problem.recordings[recording].samples
    mine = phases.cycle == cycle
    depth_m, fastest = float(phases.depth_m[mine].max()), float(np.quantile(np.abs(phases.velocity_m_per_s[mine]), 0.98))
    low = max(0.5 * limits.depth_m, 0.2 * limits.stroke_m)
    if not (phases.press[mine] >= 0).any():
        stroke_m = min(float(np.ptp(samples.z_m[mine])), limits.stroke_m)
        speed = min(fastest, limits.free_speed_m_per_s)
        what = f"repeat the stroke at {samples.t_s[mine][0] - samples.t_s[0]:.0f} s {ASSUMED.advice.again} times"
        return TestMotion(what, height_m=low, strokes=ASSUMED.advice.again, stroke_m=stroke_m, stroke_speed_m_per_s=speed)
    press = mine & (phases.press >= 0)
    speed = min(float(np.quantile(np.abs(phases.velocity_m_per_s[press]), 0.9)), limits.press_speed_m_per_s)
    held_s = float((press & ~phases.moving).sum()) / samples.rate_Hz
    what = f"repeat the press at {samples.t_s[press][0] - samples.t_s[0]:.0f} s {ASSUMED.advice.again} times"
    depths = (min(depth_m, limits.depth_m),)
    if held_s < LONG_HOLD_S:
        return TestMotion(what, depths, speed, max(held_s, 0.1), ASSUMED.advice.again, low, "dynamic")
    return TestMotion(what, depths * ASSUMED.advice.again, speed, held_s, 1, low, "static")


def blank_recording(cell: CellFile, t_s: Floats, z_cmd_m: Floats, live: Sequence[bool] = (True,) * 6) -> Samples:
    """A recording of a motion whose wrench is only the stated noise; a channel without noise is not judged.

    Args:
        t_s: Times (n,).
        z_cmd_m: Commanded heights (n,).
        live: Which axes (6,) are measured; the others stay 0.
    """
    random = np.random.default_rng(0)
    z_m = predict_motion(cell, t_s, z_cmd_m)
    speed = np.gradient(z_m, t_s) + random.standard_normal(len(t_s)) * cell.robot.velocity_noise_rms_m_per_s
    z_m = z_m + random.standard_normal(len(t_s)) * cell.robot.position_noise_rms_m
    noise = np.array([cell.sensor.noise_rms_N] * 3 + [cell.sensor.noise_rms_Nm] * 3) * live
    return Samples(t_s, z_cmd_m, z_m, speed, random.standard_normal((len(t_s), 6)) * noise)
