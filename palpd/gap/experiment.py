"""What to record next: a safe motion that best separates the explanations that are still open."""

from dataclasses import dataclass
from math import log
from pathlib import Path
from typing import Any

import numpy as np

from palpd.errors import BadInput
from palpd.gap.attribute import Attribution, Weighed
from palpd.gap.gaussian import gram, project
from palpd.gap.hypothesis import coordinates, values_at
from palpd.gap.problem import Problem, make_problem
from palpd.samples import Samples
from palpd.tick import Floats

OPEN_ABOVE = 0.03
"""Hypotheses that hold more than this share of the best one's are still open."""

WORTH_NATS = 1.0
"""A motion that is not expected to change the odds by e is not worth proposing."""


@dataclass(frozen=True)
class Proposal:
    """A motion to record next: in words, as a plan, as commanded heights over time; the log odds that it is expected to bring."""

    sentence: str
    plan: dict[str, Any]
    t_s: Floats
    z_cmd_m: Floats
    expected_gain: float

    def to_json(self) -> dict[str, Any]:
        """For out.json; `motion_csv` is the content until it has been written to a file."""
        rows = "\n".join(f"{t:.4f},{z:.7g}" for t, z in zip(self.t_s[::10], self.z_cmd_m[::10], strict=True))
        return {"sentence": self.sentence, "plan": self.plan, "motion_csv": f"t_s,z_cmd_m\n{rows}\n", "expected_gain": self.expected_gain}

    def write_motion(self, path: Path) -> None:
        """Commanded heights as a CSV."""
        try:
            np.savetxt(path, np.column_stack([self.t_s, self.z_cmd_m]), "%.9g", ",", header="t_s,z_cmd_m", comments="")
        except OSError as error:
            raise BadInput(f"{path} could not be written ({error.strerror}); choose another place.") from None


@dataclass(frozen=True)
class Motion:
    """One kind of motion that a plan can describe."""

    what: str
    depths_m: tuple[float, ...]
    speed_m_per_s: float
    hold_s: float
    repeats: int
    height_m: float
    mode: str

    def heights(self, step_s: float, surface_m: float) -> tuple[Floats, Floats]:
        """Commanded heights: rest, then down and up again, press after press."""
        top = surface_m + self.height_m
        pieces = [np.full(max(2, round(1.0 / step_s)), top)]
        for depth in self.depths_m:
            for _ in range(self.repeats):
                bottom = surface_m - depth
                n = max(2, int(abs(top - bottom) / (self.speed_m_per_s * step_s)))
                ramp = np.linspace(top, bottom, n)
                rest = np.full(max(1, int(self.hold_s / step_s)), bottom)
                pieces += [ramp, rest, ramp[::-1], np.full(max(2, round(0.7 / step_s)), top)]
        z = np.concatenate(pieces)
        return np.asarray(np.arange(len(z)) * step_s), np.asarray(z)

    def plan(self) -> dict[str, Any]:
        """The same as a plan for `palpd run`."""
        return {
            "mode": self.mode,
            "depths_m": [float(d) for d in self.depths_m],
            "press_speed_m_per_s": float(self.speed_m_per_s),
            "repeats": self.repeats,
            "hold_s": float(self.hold_s),
            "safe_height_m": float(self.height_m),
        }


def motions(problem: Problem) -> list[Motion]:
    """What may be tried: never deeper, faster or further than what the recordings have already done safely."""
    depth = max(float(run.phases.depth_m.max()) for run in problem.runs)
    if problem.cell.tissue is None or depth <= 0:
        return []
    surface = problem.cell.tissue.surface_z_m
    height = max(float(max(run.samples.z_m.max() for run in problem.runs)) - surface, 0.2 * depth)
    speed = max(float(np.quantile(np.abs(run.phases.velocity_m_per_s), 0.98)) for run in problem.runs)
    slow = 0.1 * speed
    low = min(height, 0.5 * depth)
    return [
        Motion("press in small steps of depth", tuple(depth * s for s in (0.2, 0.4, 0.6, 0.8, 1.0)), 0.5 * speed, 1.0, 1, low, "both"),
        Motion("press lightly and often", (0.25 * depth,), speed, 0.3, 8, low, "dynamic"),
        Motion("press to the full depth as fast as before", (depth,), speed, 0.2, 5, low, "dynamic"),
        Motion("press slowly to the full depth", (depth,), slow, 0.5, 1, min(height, 0.2 * depth), "dynamic"),
        Motion("press and hold for long", (depth,), speed, 20.0, 1, low, "static"),
        Motion("press and hold at two depths", (0.4 * depth, depth), speed, 8.0, 1, low, "static"),
        Motion("move up and down above the tissue, fast", (-0.1 * height,), speed, 0.3, 6, height, "dynamic"),
        Motion("move fast and slowly, from high above to the full depth", (0.5 * depth, depth), speed, 2.0, 2, height, "both"),
    ]


def next_experiment(problem: Problem, attribution: Attribution, verdict: str) -> Proposal | None:
    """The motion that best separates the two most probable explanations per minute; None where one is clear or no motion helps."""
    rivals = _open(attribution)
    if verdict == "none" or len(rivals) < 2:
        return None
    first, second = rivals[0], rivals[1]
    step_s = max(problem.scale.step_s, 1e-4)
    surface = problem.cell.tissue.surface_z_m if problem.cell.tissue is not None else 0.0
    best: tuple[float, float, Motion] | None = None
    for motion in motions(problem):
        t_s, z_m = motion.heights(step_s, surface)
        if len(t_s) > 200_000 or len(t_s) < 30:
            continue
        gain = min(expected_log_odds(problem, first, second, t_s, z_m), expected_log_odds(problem, second, first, t_s, z_m))
        rate = gain / (t_s[-1] / 60.0 + 0.2)
        if best is None or rate > best[0]:
            best = (rate, gain, motion)
    if best is None or best[1] < WORTH_NATS:
        return None
    _, gain, motion = best
    t_s, z_m = motion.heights(step_s, surface)
    names = [" with ".join(w.fit.names) or "no effect" for w in (first, second)]
    sentence = (
        f"{motion.what[0].upper()}{motion.what[1:]} ({t_s[-1]:.0f} s) and diagnose both recordings jointly: it is expected to tell "
        f"{names[0]} from {names[1]} by a factor of {_factor(gain)}."
    )
    return Proposal(sentence, motion.plan(), t_s, z_m, gain)


def _factor(gain: float) -> str:
    return "more than a thousand" if gain > log(1000.0) else f"{np.exp(gain):.0f}"


def _open(attribution: Attribution) -> list[Weighed]:
    top = attribution.best.share
    return [w for w in attribution.weighed if w.share > OPEN_ABOVE * top][:4]


def expected_log_odds(problem: Problem, true: Weighed, other: Weighed, t_s: Floats, z_m: Floats) -> float:
    """Log odds for `true` that a recording of this motion would bring, were it true: half the squared difference of the two predictions
    in sigmas that neither in-tolerance deviations nor the other's parameters, as uncertain as they are, can make up for."""
    velocity = np.gradient(z_m, t_s)
    blank = Samples(t_s, z_m, z_m, velocity, np.random.default_rng(0).standard_normal((len(t_s), 6)) * _noise(problem))
    trial = make_problem([blank], problem.cell, problem.library, 1500, problem.fz_step_N)
    trial.scale = problem.scale
    there = trial.linearise(other.fit.values, other.fit.eta)
    difference = trial.predict(true.fit.values, true.fit.eta) - there.prediction
    d = project(difference, there.space)
    where = coordinates([problem.library[name] for name in other.fit.names], problem.scale)
    columns = []
    for k, _ in enumerate(where):
        moved = other.fit.u.copy()
        moved[k] += 1e-2
        spread = max(float(other.fit.covariance[k, k]), 0.0) ** 0.5 if len(other.fit.covariance) > k else 0.0
        slope = (trial.predict(values_at(where, moved), other.fit.eta) - there.prediction) / 1e-2
        columns.append(project(slope * min(3.0 * spread, 1e3), there.space))
    if not columns:
        return 0.5 * d.dot(d)
    seen = np.array([c.dot(d) for c in columns])
    return 0.5 * max(d.dot(d) - float(seen @ np.linalg.solve(np.eye(len(columns)) + gram(columns), seen)), 0.0)


def _noise(problem: Problem) -> Floats:
    sensor = problem.cell.sensor
    return np.array([sensor.noise_rms_N] * 3 + [max(sensor.noise_rms_Nm, 1e-300)] * 3)
