"""Stage 7 of a diagnosis: a safe motion that best separates the hypotheses that are still open, and what no motion can separate."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import exp, inf, log
from pathlib import Path
from typing import Any

import numpy as np

from palpd.cell.cell_file import CROSSTALK
from palpd.cell.simulation import equilibrium_force_N
from palpd.files import writing
from palpd.gap.advise.law_rivals import LawRivals, rivals_of_law
from palpd.gap.advise.motions import MotionLimits, TestMotion, blank_recording, cycle_again, motions, same_again, surface_of
from palpd.gap.advise.rivals import Rival, open_rivals
from palpd.gap.assumptions import ASSUMED
from palpd.gap.data.noise import FX
from palpd.gap.data.prepare import moves
from palpd.gap.decide import BeyondList, RefusedLaw
from palpd.gap.gaussian.nuisances import Nuisances, gram, nuisances, project
from palpd.gap.infer.discrepancy import DISCREPANCY_SIZES, discrepancy_columns
from palpd.gap.infer.posterior import Attribution
from palpd.gap.model.linearise import linearise
from palpd.gap.model.problem import NOMINAL_ETA, SHARED, Problem, make_problem
from palpd.tick import Floats

MOST_ROWS = 12_000
"""Number of rows in which a trial motion is simulated; each counts for the recorded rows that it stands for."""

TRIAL_BINS = 1500
"""Approximate number of bins of a trial motion: a third of a diagnosis, since eleven motions are tried."""


@dataclass(frozen=True)
class ExperimentProposal:
    """A motion to record next: in words, as a plan, as commanded heights over time; the log odds that it is expected to bring."""

    sentence: str
    plan: dict[str, Any]
    t_s: Floats  # (n,)
    z_cmd_m: Floats  # (n,)
    expected_gain: float  # nats
    motion: TestMotion

    def to_json(self) -> dict[str, Any]:
        """For out.json; `motion_csv` is the content until it has been written to a file."""
        every = max(1, len(self.t_s) // 3000)
        rows = "\n".join(f"{t:.4f},{z:.7g}" for t, z in zip(self.t_s[::every], self.z_cmd_m[::every], strict=True))
        return {"sentence": self.sentence, "plan": self.plan, "motion_csv": f"t_s,z_cmd_m\n{rows}\n", "expected_gain": self.expected_gain}

    def write_motion(self, path: Path) -> None:
        """Write the commanded heights as a CSV.

        Raises:
            BadInput: The file cannot be written.
        """
        with writing(path) as stream:
            np.savetxt(stream, np.column_stack([self.t_s, self.z_cmd_m]), "%.9g", ",", header="t_s,z_cmd_m", comments="")


@dataclass(frozen=True)
class ScoredMotion:
    """A motion (n,) and the log odds (h, h) in nats that it is expected to bring between h hypotheses.

    Element (i, j) is for hypothesis i against hypothesis j, if i is true.
    """

    motion: TestMotion
    t_s: Floats
    z_cmd_m: Floats
    odds: Floats

    def apart(self, i: int, j: int) -> float:
        """Expected log odds in nats between two hypotheses, by their numbers: the smaller of those where either of them is true."""
        return float(min(self.odds[i, j], self.odds[j, i]))

    def resolved(self, shares: Floats) -> float:
        """Doubt that the motion removes, as a probability: Σ 2 p_i p_j (1 - e^(-odds/4)) over all pairs.

        This follows Bhattacharyya's bound on the probability of mistaking two hypotheses.

        Args:
            shares: Probabilities p of the hypotheses (h,).
        """
        return sum(2.0 * float(shares[i] * shares[j]) * (1.0 - exp(-0.25 * self.apart(i, j))) for i in range(len(shares)) for j in range(i))


@dataclass(frozen=True)
class Advice:
    """What is open and which motion decides it.

    Attributes:
        names: The open hypotheses, the most probable first.
        shares: Their probabilities (h,), which add up to 1.
        proposal: The best motion; None where no motion reaches `advice.worth_nats`.
        pair: The two hypotheses that it separates, else the two most probable hypotheses; None where fewer are open, or a refused law is to
            be shown again.
        most: Largest expected log odds for that pair, in nats.
        forever: The same if the motion went on `advice.patience` times as long; inf where there is a proposal.
        hidden_by: The tolerance without which `forever` would be largest; None where no tolerance hides much.
    """

    names: tuple[str, ...]
    shares: Floats
    proposal: ExperimentProposal | None
    pair: tuple[str, str] | None
    most: float
    forever: float = inf
    hidden_by: str | None = None

    @property
    def sentence(self) -> str:
        """The proposal in words, or why there is none."""
        if self.proposal is not None:
            return self.proposal.sentence
        if self.pair is None:
            return "Nothing is open that a motion could decide."
        hidden = f" The tolerance of {self.hidden_by} hides the rest." if self.hidden_by else ""
        return (
            f"No motion within the limits distinguishes {self.pair[0]} from {self.pair[1]}. The best is expected to bring "
            f"{self.most:.2g} nats, and {self.forever:.2g} when it goes on {ASSUMED.advice.patience:.0f} times as "
            f"long; a proposal needs {ASSUMED.advice.worth_nats:g}."
            f"{hidden}"
        )


def advise(problem: Problem, attribution: Attribution, limits: MotionLimits | None = None, beyond: BeyondList | None = None) -> Advice:
    """The motion that removes most of the doubt per minute, or why there is none.

    Where the verdict is a law outside the list, that is the motion that would refute it: it spreads the drivers of the law and of the laws
    that fit as well. Where a law was refused, it is the motion that would show it again.

    Args:
        problem: The recordings so far.
        attribution: The posterior over hypotheses.
        limits: What the motion may ask of the cell; None: no more than the recordings.
        beyond: What is outside the list, if the verdict is `unknown`; None: listed hypotheses are separated.
    """
    if beyond is not None and beyond.refused is not None and _anything_moves(problem):
        return _again(problem, beyond.refused, limits)
    if beyond is None or beyond.law is None or beyond.law.secondary:  # a secondary law describes what a listed cause leaves
        return _between(problem, open_rivals(attribution), limits)
    laws = rivals_of_law(problem, attribution, beyond.law)
    advice = _between(laws.problem, laws.alike, limits, laws)
    return advice if advice.proposal is not None or not laws.against_list else _between(laws.problem, laws.against_list, limits, laws)


def _between(problem: Problem, rivals: Sequence[Rival], limits: MotionLimits | None, laws: LawRivals | None = None) -> Advice:
    """The motion that decides between some hypotheses. `laws` is given where these are rivals of a law, for its words and range."""
    names = tuple(rival.name for rival in rivals)
    shares = np.array([rival.share for rival in rivals])
    shares = shares / shares.sum()
    if len(rivals) < 2:
        return Advice(names, shares, None, None, 0.0)
    if limits is None and not _anything_moves(problem):
        return Advice(names, shares, None, (names[0], names[1]), 0.0, 0.0)  # no motion has been shown to be safe
    limits = within_force(problem, rivals, limits or MotionLimits.of(problem))
    scored = [score(problem, rivals, motion, limits) for motion in motions(limits)]
    pairs = [(i, j) for i in range(len(rivals)) for j in range(i + 1, len(rivals))]
    worth = [s for s in scored if any(s.apart(*p) >= ASSUMED.advice.worth_nats for p in pairs)]
    if worth:
        best = max(worth, key=lambda s: s.resolved(shares) / (float(s.t_s[-1]) + ASSUMED.advice.overhead_s))
        able = [p for p in pairs if best.apart(*p) >= ASSUMED.advice.worth_nats]
        i, j = max(able, key=lambda p: shares[p[0]] * shares[p[1]] * (1.0 - exp(-0.25 * best.apart(*p))))
        pair, gain = (names[i], names[j]), best.apart(i, j)
        return Advice(names, shares, _decides(best, pair, gain, laws), pair, gain)
    best = max(scored, key=lambda s: s.apart(0, 1))
    forever, hidden_by = _hidden(problem, rivals[:2], best, limits)
    return Advice(names, shares, None, (names[0], names[1]), best.apart(0, 1), forever, hidden_by)


def within_force(problem: Problem, rivals: Sequence[Rival], limits: MotionLimits) -> MotionLimits:
    """Limit the depth so that no open hypothesis expects more than the allowed force after a long hold.

    Returns:
        The limits with that depth; 0 where it is less than a tenth of the depth in `limits`.
    """
    if problem.cell.tissue is None:
        return limits
    depth_m = limits.depth_m
    for rival in rivals:
        cell = problem.cell_at(rival.fit.values, rival.eta)
        while depth_m > 0.1 * limits.depth_m and equilibrium_force_N(cell, depth_m, None, problem.library) > limits.force_N:
            depth_m *= 0.95
    return replace(limits, depth_m=depth_m if depth_m > 0.1 * limits.depth_m else 0.0)


def _anything_moves(problem: Problem) -> bool:
    return any(moves(recording.samples, problem.cell) for recording in problem.recordings)


def _again(problem: Problem, refused: RefusedLaw, limits: MotionLimits | None) -> Advice:
    """The motion that shows a refused law again: the whole motion where it changes in time, else the press or stroke that showed it."""
    known = limits or MotionLimits.of(problem)
    names, shares = ("a law that repeats", "a change in time that does not"), np.array([0.5, 0.5])
    gain = refused.law.nats
    if refused.reason == "time":
        motion, t_s, z_cmd_m = same_again(problem, known)
        why = "A law repeats, a random walk does not. The plan has the same depths, speeds and holds; the motion file is the recorded one."
    else:
        motion = cycle_again(problem, refused.recording, refused.cycle, known)
        surface_m = surface_of(problem)
        t_s, z_cmd_m = motion.heights(problem.scale.step_s, surface_m, surface_m + known.home_m, known.acceleration_m_per_s2)
        driver = refused.law.terms[0].candidate.driver.words
        why = f"What remains follows {driver}, but one press or stroke alone shows it, and a law must repeat."
    return Advice(names, shares, _proposal(motion, t_s, z_cmd_m, gain, why), None, gain)


def _decides(best: ScoredMotion, pair: tuple[str, str], gain: float, laws: LawRivals | None) -> ExperimentProposal:
    """The proposal of a motion that decides between two hypotheses, or on which a law may fail."""
    first, second = pair if laws is None else (laws.words.get(name, name) for name in pair)
    factor = "more than a thousand" if gain > log(1000.0) else f"{exp(gain):.0f}"
    why = f"This is expected to change the odds between {first} and {second} by a factor of {factor}."
    if laws is not None:
        outside = laws.share_outside(best.t_s, best.z_cmd_m)
        held = f"{outside:.0%} of it lies outside the range of the law, where its curve is held."
        why = f"{held if outside > 0.01 else 'It stays within the range of the law, so the law must hold there.'} {why}"
    return _proposal(best.motion, best.t_s, best.z_cmd_m, gain, why)


def _proposal(motion: TestMotion, t_s: Floats, z_cmd_m: Floats, gain: float, why: str) -> ExperimentProposal:
    sentence = f"{motion.what[0].upper()}{motion.what[1:]} ({t_s[-1]:.0f} s) and diagnose both recordings jointly. {why}"
    return ExperimentProposal(sentence, motion.plan(), t_s, z_cmd_m, gain, motion)


def score(problem: Problem, rivals: Sequence[Rival], motion: TestMotion, limits: MotionLimits, patience: float = 1.0) -> ScoredMotion:
    """What a recording of a motion is expected to say about the open hypotheses.

    Args:
        problem: The recordings so far.
        rivals: The h open hypotheses.
        limits: Where it starts, and its acceleration.
        patience: Number of times that it is recorded.
    """
    surface_m = surface_of(problem)
    rows_s = max(problem.scale.step_s, 1e-4)
    home_m = surface_m + limits.home_m
    _, whole = motion.heights(20.0 * rows_s, surface_m, home_m, limits.acceleration_m_per_s2)
    step_s = rows_s * max(1, round(20 * len(whole) / MOST_ROWS))
    t_s, z_cmd_m = motion.heights(step_s, surface_m, home_m, limits.acceleration_m_per_s2)
    trial = _trial(problem, t_s, z_cmd_m, step_s / rows_s * patience)
    return ScoredMotion(motion, t_s, z_cmd_m, _log_odds(trial, rivals))


def _trial(problem: Problem, t_s: Floats, z_cmd_m: Floats, weight: float) -> Problem:
    """The problem that a recording of that motion would pose, in which each bin counts for `weight` bins."""
    live = np.any([recording.judged[FX:] for recording in problem.recordings], axis=0)
    blank = blank_recording(problem.cell, t_s, z_cmd_m, live)
    trial = make_problem([blank], problem.cell, problem.library, TRIAL_BINS, rounding=problem.rounding, scale=problem.scale)
    return trial.with_row_weight(weight)


def _log_odds(trial: Problem, rivals: Sequence[Rival]) -> Floats:
    """Log odds (h, h) that the recording would bring for hypothesis i (row) against hypothesis j (column), if i is true.

    They are half the squared difference of both predictions, in sigmas, that nothing in hypothesis j can make up for: neither in-tolerance
    deviations, nor its parameters within their uncertainty, nor a discrepancy of its law.
    """
    base = linearise(trial, {}, NOMINAL_ETA)
    gaps = [rival.prediction(trial) - base.prediction for rival in rivals]
    trial = trial.with_model_error_floor(max(gaps, key=lambda g: float(np.vdot(g, g))))
    predictions = [rival.prediction(trial) for rival in rivals]
    odds = np.zeros((len(rivals), len(rivals)))
    for column, other in enumerate(rivals):
        there = linearise(trial, other.fit.values, other.eta)
        free = list(other.free_columns(trial, there.prediction))
        laws, _ = discrepancy_columns(trial, other.fit.values, there.prediction, there)
        wider = laws.scaled(max(size for size, _ in DISCREPANCY_SIZES))
        wide = nuisances(there.space.columns.followed_by(wider)) if wider.size else None
        for row, prediction in enumerate(predictions):
            if row != column:
                difference = prediction - there.prediction
                odds[row, column] = _unexplained(difference, free, there.space)
                if wide is not None:
                    price = 0.5 * (wide.log_determinant - there.space.log_determinant)
                    odds[row, column] = min(odds[row, column], _unexplained(difference, free, wide) + price)
    return odds


def _unexplained(difference: Floats, free: Sequence[Floats], space: Nuisances) -> float:
    """Half the squared difference (7, b) without what nuisances and free columns explain, in nats."""
    d = project(difference, space)
    columns = [project(c, space) for c in free]
    seen = np.array([c.dot(d) for c in columns])
    taken = float(seen @ np.linalg.solve(np.eye(len(columns)) + gram(columns), seen)) if columns else 0.0
    return 0.5 * max(d.dot(d) - taken, 0.0)


def _hidden(problem: Problem, two: Sequence[Rival], best: ScoredMotion, limits: MotionLimits) -> tuple[float, str | None]:
    """Log odds of the motion repeated `advice.patience` times, and the tolerance that hides most; None where none halves them."""
    forever = score(problem, two, best.motion, limits, ASSUMED.advice.patience).apart(0, 1)
    most, hidden_by = max(2.0 * forever, ASSUMED.advice.worth_nats), None
    for k, name in enumerate(SHARED):
        if problem.shared_sd[k] == 0.0 or name in CROSSTALK:
            continue
        exact = np.where(np.arange(len(SHARED)) == k, 1e-6 * problem.shared_sd, problem.shared_sd)
        without = _trial(problem, best.t_s, best.z_cmd_m, ASSUMED.advice.patience).with_shared_sd(exact)
        odds = _log_odds(without, [rival.without_deviation(k) for rival in two])
        gain = float(min(odds[0, 1], odds[1, 0]))
        if gain > most:
            most, hidden_by = gain, name
    return forever, hidden_by
