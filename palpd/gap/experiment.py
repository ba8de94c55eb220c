"""What to record next: a safe motion that best separates the explanations that are still open, and what no motion can separate."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import ceil, exp, inf, log
from pathlib import Path
from typing import Any

import numpy as np

from palpd.cell import equilibrium_force_N, predict_motion
from palpd.cell_file import CellFile
from palpd.errors import BadInput
from palpd.gap.attribute import Attribution, Weighed
from palpd.gap.gaussian import Nuisances, gram, nuisances, project
from palpd.gap.hypothesis import INEXACT, law_columns, values_at
from palpd.gap.problem import SHARED, Linearisation, Problem, make_problem
from palpd.samples import Samples
from palpd.tick import Floats

OPEN_ABOVE = 0.03
"""Hypotheses that hold more than this share of the best one's are still open."""

WORTH_NATS = 1.0
"""A motion that is not expected to change the odds of any two by e is not worth proposing."""

OVERHEAD_S = 20.0
"""What a run takes besides its motion: opening, taring, looking for the surface."""

MOST_ROWS = 12_000
"""Rows in which a trial motion is simulated; fewer than would be recorded count for as many as they stand for."""

FOREVER = 100.0
"""So many times as long as proposed is for ever, when it is asked what no patience would bring."""

FREE_HEIGHT_M = 0.02
"""Free strokes are as long as those of `palpd free-motion`."""


@dataclass(frozen=True)
class Limits:
    """What a motion may ask of a cell: how deep and with what force, from how high above the surface and how far up from there, how fast in
    contact and in the air."""

    depth_m: float
    force_N: float
    home_m: float
    stroke_m: float
    press_speed_m_per_s: float
    free_speed_m_per_s: float
    acceleration_m_per_s2: float

    @staticmethod
    def of(problem: Problem) -> "Limits":
        """Never deeper, harder, higher, faster or more abruptly than what the recordings have already done safely."""
        surface_m = _surface_m(problem)
        speeds = [np.abs(run.phases.velocity_m_per_s) for run in problem.runs]
        pressing = [v[run.phases.depth_m > 0] for v, run in zip(speeds, problem.runs, strict=True) if (run.phases.depth_m > 0).any()]
        free_speed = max(float(np.quantile(v, 0.98)) for v in speeds)
        height_m = max(float(run.samples.z_m.max()) for run in problem.runs) - surface_m
        depth_m = max(float(run.phases.depth_m.max()) for run in problem.runs)
        height_m = max(height_m, 0.2 * depth_m)
        stroke_m = min(FREE_HEIGHT_M, 0.8 * height_m)
        return Limits(
            depth_m=depth_m,
            force_N=max(float(np.quantile(run.samples.wrench[:, 2], 0.999)) for run in problem.runs),
            home_m=height_m - stroke_m,
            stroke_m=stroke_m,
            press_speed_m_per_s=max((float(np.quantile(v, 0.9)) for v in pressing), default=free_speed),
            free_speed_m_per_s=free_speed,
            acceleration_m_per_s2=max(float(np.quantile(np.abs(run.motion.az_m_per_s2), 0.99)) for run in problem.runs),
        )


def _surface_m(problem: Problem) -> float:
    """Height of the tissue, or where there is none, the lowest that the tip has been at."""
    lowest_m = min(float(run.samples.z_m.min()) for run in problem.runs)
    return problem.cell.tissue.surface_z_m if problem.cell.tissue is not None else lowest_m


@dataclass(frozen=True)
class Motion:
    """One kind of motion that a plan can describe: strokes in the air, then presses."""

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
        """Strokes up from home, then down and up again, press after press: each as height to go to, speed, and rest afterwards in s."""
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
        """Height at which it begins, with a rest of a second."""
        return home_m if self.strokes else surface_m + self.height_m

    def heights(self, step_s: float, surface_m: float, home_m: float, acceleration_m_per_s2: float) -> tuple[Floats, Floats]:
        """Times and commanded heights (n,)."""
        z_m = self.start_m(surface_m, home_m)
        pieces = [np.full(max(2, round(1.0 / step_s)), z_m)]
        for to_m, speed, rest_s in self.legs(surface_m, home_m):
            pieces += [_stroke(z_m, to_m, speed, acceleration_m_per_s2, step_s), np.full(round(rest_s / step_s), to_m)]
            z_m = to_m
        heights_m = np.concatenate(pieces)
        return np.asarray(np.arange(len(heights_m)) * step_s), np.asarray(heights_m)

    def plan(self) -> dict[str, Any]:
        """The same as a plan for `palpd run`."""
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
    duration_s = way_m / top + ramp_s if way_m > 0 else 0.0
    t = np.arange(1, ceil(duration_s / step_s) + 1) * step_s
    first, last = np.minimum(t, ramp_s), np.clip(t - (duration_s - ramp_s), 0.0, ramp_s)
    middle = np.clip(t - ramp_s, 0.0, duration_s - ramp_s)
    gone = 0.5 * acceleration * first**2 + top * middle - 0.5 * acceleration * last**2
    return np.asarray(from_m + np.sign(to_m - from_m) * np.minimum(gone, way_m))


def motions(limits: Limits) -> list[Motion]:
    """What may be tried within the limits."""
    depth, stroke = limits.depth_m, limits.stroke_m
    fast, air = limits.press_speed_m_per_s, limits.free_speed_m_per_s
    low = max(0.5 * depth, 0.2 * stroke)

    def strokes(what: str, count: int, speed: float) -> Motion:
        return Motion(what, height_m=low, strokes=count, stroke_m=stroke, stroke_speed_m_per_s=speed)

    out = [
        strokes("move up and down in the air, fast", 12, air),
        strokes("move up and down in the air, fast, for long", 40, air),
        strokes("move up and down in the air, slowly", 4, 0.15 * air),
    ]
    if depth <= 0.0:
        return out
    return [
        *out,
        Motion("press in small steps of depth", tuple(depth * s for s in (0.2, 0.4, 0.6, 0.8, 1.0)), 0.5 * fast, 1.0, 1, low, "both"),
        Motion("press to eight depths, again and again", tuple(depth * s / 8.0 for s in range(1, 9)), fast, 0.2, 4, low, "dynamic"),
        Motion("press lightly and often", (0.15 * depth, 0.3 * depth), fast, 0.3, 8, low, "dynamic"),
        Motion("press to the full depth as fast as before", (depth,), fast, 0.2, 5, low, "dynamic"),
        Motion("press slowly to the full depth", (depth,), 0.15 * fast, 0.5, 1, low, "dynamic"),
        Motion("press and hold for long", (depth,), fast, 20.0, 1, low, "static"),
        Motion("press and hold at two depths", (0.4 * depth, depth), fast, 8.0, 1, low, "static"),
        Motion("move fast in the air, then press to two depths", (0.5 * depth, depth), fast, 2.0, 2, low, "both", 8, stroke, air),
    ]


def within_force(problem: Problem, rivals: Sequence[Weighed], limits: Limits) -> Limits:
    """The limits with the depth at which no open explanation expects more than the force allowed after a long hold; none where that is
    less than a tenth of the depth allowed."""
    if problem.cell.tissue is None:
        return limits
    depth_m = limits.depth_m
    for w in rivals:
        cell = problem.cell_at(w.fit.values, w.fit.eta)
        while depth_m > 0.1 * limits.depth_m and equilibrium_force_N(cell, depth_m, None, problem.library) > limits.force_N:
            depth_m *= 0.95
    return replace(limits, depth_m=depth_m if depth_m > 0.1 * limits.depth_m else 0.0)


@dataclass(frozen=True)
class Proposal:
    """A motion to record next: in words, as a plan, as commanded heights over time; the log odds that it is expected to bring."""

    sentence: str
    plan: dict[str, Any]
    t_s: Floats
    z_cmd_m: Floats
    expected_gain: float
    motion: Motion

    def to_json(self) -> dict[str, Any]:
        """For out.json; `motion_csv` is the content until it has been written to a file."""
        every = max(1, len(self.t_s) // 3000)
        rows = "\n".join(f"{t:.4f},{z:.7g}" for t, z in zip(self.t_s[::every], self.z_cmd_m[::every], strict=True))
        return {"sentence": self.sentence, "plan": self.plan, "motion_csv": f"t_s,z_cmd_m\n{rows}\n", "expected_gain": self.expected_gain}

    def write_motion(self, path: Path) -> None:
        """Commanded heights as a CSV."""
        try:
            np.savetxt(path, np.column_stack([self.t_s, self.z_cmd_m]), "%.9g", ",", header="t_s,z_cmd_m", comments="")
        except OSError as error:
            raise BadInput(f"{path} could not be written ({error.strerror}); choose another place.") from None


@dataclass(frozen=True)
class Scored:
    """A motion with what it is expected to say: log odds (h, h) for the row's hypothesis against the column's, were the row's true."""

    motion: Motion
    t_s: Floats
    z_cmd_m: Floats
    odds: Floats

    def apart(self, one: int, other: int) -> float:
        """Expected log odds between two, whichever is true."""
        return float(min(self.odds[one, other], self.odds[other, one]))

    def resolved(self, shares: Floats) -> float:
        """How much of the doubt it takes away: 2 p_i p_j (1 - e^(-odds/4)) over all pairs, by Bhattacharyya's bound on mistaking them."""
        return sum(
            2.0 * float(shares[i] * shares[j]) * (1.0 - exp(-0.25 * self.apart(i, j))) for i in range(len(shares)) for j in range(i)
        )


@dataclass(frozen=True)
class Advice:
    """What is open (most probable first), the best motion for it if any is worth its time, and what stands in the way if none is.

    `most` is the largest expected log odds that any motion brings for any open pair; `forever` what its `pair` would bring if that
    motion went on a hundred times as long, and `hidden_by` the tolerance without which that would be most.
    """

    names: tuple[str, ...]
    shares: Floats
    proposal: Proposal | None
    pair: tuple[str, str] | None
    most: float
    forever: float = inf
    hidden_by: str | None = None

    @property
    def sentence(self) -> str:
        """In words."""
        if self.proposal is not None:
            return self.proposal.sentence
        if self.pair is None:
            return "Nothing is open that a motion could decide."
        hidden = f"; the tolerance of {self.hidden_by} hides the rest" if self.hidden_by else ""
        return (
            f"No motion within the limits tells {self.pair[0]} from {self.pair[1]}: the best is expected to bring {self.most:.2g} nats, "
            f"{FOREVER:.0f} times as long {self.forever:.2g}, and {WORTH_NATS:g} is what would be worth it{hidden}."
        )


def rivals_of(attribution: Attribution) -> list[Weighed]:
    """Explanations that are still open, most probable first, at most four. One that only adds an effect to a more probable one is none."""
    top = attribution.best.share
    out: list[Weighed] = []
    for w in attribution.weighed:
        if w.share > OPEN_ABOVE * top and not any(set(o.fit.names) < set(w.fit.names) and o.fit.names for o in out):
            out.append(w)
    return out[:4]


def next_experiment(problem: Problem, attribution: Attribution, verdict: str, limits: Limits | None = None) -> Proposal | None:
    """The motion that best separates what is open, per minute; None where all is clear or no motion helps."""
    return None if verdict == "none" else advise(problem, attribution, limits).proposal


def advise(problem: Problem, attribution: Attribution, limits: Limits | None = None) -> Advice:
    """The motion that takes away most of the doubt per minute, or why there is none."""
    rivals = rivals_of(attribution)
    names = tuple(w.name for w in rivals)
    shares = np.array([w.share for w in rivals])
    shares = shares / shares.sum()
    if len(rivals) < 2:
        return Advice(names, shares, None, None, 0.0)
    limits = within_force(problem, rivals, limits or Limits.of(problem))
    scored = [score(problem, rivals, motion, limits) for motion in motions(limits)]
    pairs = [(i, j) for i in range(len(rivals)) for j in range(i + 1, len(rivals))]
    worth = [s for s in scored if any(s.apart(*p) >= WORTH_NATS for p in pairs)]
    if worth:
        best = max(worth, key=lambda s: s.resolved(shares) / (float(s.t_s[-1]) + OVERHEAD_S))
        able = [p for p in pairs if best.apart(*p) >= WORTH_NATS]
        told = max(able, key=lambda p: shares[p[0]] * shares[p[1]] * (1.0 - exp(-0.25 * best.apart(*p))))
        pair, gain = (names[told[0]], names[told[1]]), best.apart(*told)
        return Advice(names, shares, _proposal(best, pair, gain), pair, gain)
    first = (names[0], names[1])
    chance = max(scored, key=lambda s: s.apart(0, 1))
    forever, hidden_by = _hidden(problem, rivals[:2], chance, limits)
    return Advice(names, shares, None, first, chance.apart(0, 1), forever, hidden_by)


def _proposal(best: Scored, pair: tuple[str, str], gain: float) -> Proposal:
    what = best.motion.what
    sentence = (
        f"{what[0].upper()}{what[1:]} ({best.t_s[-1]:.0f} s) and diagnose both recordings jointly: it is expected to tell "
        f"{pair[0]} from {pair[1]} by a factor of {_factor(gain)}."
    )
    return Proposal(sentence, best.motion.plan(), best.t_s, best.z_cmd_m, gain, best.motion)


def _factor(gain: float) -> str:
    return "more than a thousand" if gain > log(1000.0) else f"{exp(gain):.0f}"


def score(problem: Problem, rivals: Sequence[Weighed], motion: Motion, limits: Limits, patience: float = 1.0) -> Scored:
    """What a recording of this motion is expected to say about the rivals; `patience` as if it were recorded so many times."""
    surface_m = _surface_m(problem)
    rows_s = max(problem.scale.step_s, 1e-4)
    home_m = surface_m + limits.home_m
    _, whole = motion.heights(20.0 * rows_s, surface_m, home_m, limits.acceleration_m_per_s2)
    step_s = rows_s * max(1, round(20 * len(whole) / MOST_ROWS))
    t_s, z_cmd_m = motion.heights(step_s, surface_m, home_m, limits.acceleration_m_per_s2)
    trial = _trial(problem, t_s, z_cmd_m, step_s / rows_s * patience)
    return Scored(motion, t_s, z_cmd_m, _log_odds(trial, rivals))


def blank(cell: CellFile, t_s: Floats, z_cmd_m: Floats) -> Samples:
    """A recording of that motion whose wrench is nothing but the stated noise."""
    random = np.random.default_rng(0)
    z_m = predict_motion(cell, t_s, z_cmd_m)
    speed = np.gradient(z_m, t_s) + random.standard_normal(len(t_s)) * cell.robot.velocity_noise_rms_m_per_s
    z_m = z_m + random.standard_normal(len(t_s)) * cell.robot.position_noise_rms_m
    noise = np.array([cell.sensor.noise_rms_N] * 3 + [max(cell.sensor.noise_rms_Nm, 1e-300)] * 3)
    return Samples(t_s, z_cmd_m, z_m, speed, random.standard_normal((len(t_s), 6)) * noise)


def _trial(problem: Problem, t_s: Floats, z_cmd_m: Floats, weight: float) -> Problem:
    """What a recording of that motion would be judged by, each row counting for `weight` rows."""
    trial = make_problem([blank(problem.cell, t_s, z_cmd_m)], problem.cell, problem.library, 1500, problem.rounding)
    trial.scale = problem.scale
    trial.weigh(weight)
    return trial


def _log_odds(trial: Problem, rivals: Sequence[Weighed]) -> Floats:
    """Log odds (h, h) that the recording would bring for the row's hypothesis, were it true, against the column's: half the squared
    difference of their predictions in sigmas that nothing can make up for: neither in-tolerance deviations, nor the other's parameters
    as uncertain as they are, nor a law of the other's that is not quite the listed one."""
    base = trial.linearise({}, np.zeros(len(trial.shared_sd)))
    gaps = [trial.predict(w.fit.values, w.fit.eta) - base.prediction for w in rivals]
    trial.soften(max(gaps, key=lambda g: float(np.vdot(g, g))))
    predictions = [trial.predict(w.fit.values, w.fit.eta) for w in rivals]
    odds = np.zeros((len(rivals), len(rivals)))
    for column, other in enumerate(rivals):
        there = trial.linearise(other.fit.values, other.fit.eta)
        free = _free_columns(trial, other, there)
        laws = law_columns(trial, other.fit.values, there.prediction, there)[0]
        wider = max(size for size, _ in INEXACT) * laws
        wide = nuisances(np.concatenate([there.columns, wider])) if len(wider) else None
        for row, prediction in enumerate(predictions):
            if row != column:
                difference = prediction - there.prediction
                odds[row, column] = _unexplained(difference, free, there.space)
                if wide is not None:
                    price = 0.5 * (wide.log_determinant - there.space.log_determinant)
                    odds[row, column] = min(odds[row, column], _unexplained(difference, free, wide) + price)
    return odds


def _free_columns(trial: Problem, other: Weighed, there: Linearisation) -> list[Floats]:
    """What one standard deviation of each independent combination of the other's parameters changes."""
    fit = other.fit
    if not fit.names:
        return []
    values, vectors = np.linalg.eigh(fit.covariance)
    out = []
    for value, vector in zip(values, vectors.T, strict=True):
        spread = min(max(float(value), 0.0), 1e6) ** 0.5
        step = min(1e-2, spread) if spread > 0.0 else 1e-2
        moved = trial.predict(values_at(fit.where, fit.u + step * vector), fit.eta)
        out.append((moved - there.prediction) * (spread / step))
    return out


def _unexplained(difference: Floats, free: Sequence[Floats], space: Nuisances) -> float:
    d = project(difference, space)
    columns = [project(c, space) for c in free]
    seen = np.array([c.dot(d) for c in columns])
    taken = float(seen @ np.linalg.solve(np.eye(len(columns)) + gram(columns), seen)) if columns else 0.0
    return 0.5 * max(d.dot(d) - taken, 0.0)


def _hidden(problem: Problem, two: Sequence[Weighed], best: Scored, limits: Limits) -> tuple[float, str | None]:
    """What the motion would bring for ever, and the tolerance without which it would bring most, if that is worth it."""
    forever = score(problem, two, best.motion, limits, FOREVER).apart(0, 1)
    found: tuple[float, str | None] = (max(2.0 * forever, WORTH_NATS), None)
    exact = problem.shared_sd
    for k, name in enumerate(SHARED):
        if exact[k] == 0.0 or name.startswith(("fx", "fy", "tx", "ty")):
            continue
        without = _trial(problem, best.t_s, best.z_cmd_m, FOREVER)
        without.shared_sd = np.where(np.arange(len(exact)) == k, 1e-6 * exact, exact)
        odds = _log_odds(without, [_moved(w, k) for w in two])
        gain = float(min(odds[0, 1], odds[1, 0]))
        if gain > found[0]:
            found = (gain, name)
    return forever, found[1]


def _moved(w: Weighed, k: int) -> Weighed:
    """The same with the k-th deviation, which is to be none, at nought."""
    eta = w.fit.eta.copy()
    eta[k] = 0.0
    return replace(w, fit=replace(w.fit, eta=eta))
