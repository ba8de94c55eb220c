"""Is advice worth its name? On drawn cells whose first recording leaves something open, the advised motion against a random one.

The cells are the blind check's: other physics, in-tolerance errors, scatter, noise. Both second recordings are of the same cell and equally
long; the random one is drawn as the first was, and like the advised one goes no deeper than that. Each is diagnosed jointly with the first.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, TypedDict

import numpy as np
from scipy.stats import bootstrap

from palpd.blind.detectability import Detectability, fit_strength, scales_of
from palpd.blind.drawn_cases import laws_of, measured
from palpd.blind.drawn_cells import CellRealisation, Deviations, DrawnMotion, draw_cell, draw_deviations, draw_motion
from palpd.blind.laws import Floats, Planted, Shape
from palpd.blind.truth import CannotDraw
from palpd.cell.cell_file import CellFile, cell_from
from palpd.gap.advise.motions import MotionLimits, TestMotion
from palpd.gap.advise.next_experiment import advise
from palpd.gap.diagnosis import Diagnosis, diagnose
from palpd.recording.samples import Samples
from palpd.workers import pool

SCHEMA = "palpd.blind.advice/1"
EFFECTS = (
    "sensor.gain", "tissue.thickness", "sensor.creep", "tissue.modulus", "tissue.inclusion", "tissue.viscoelastic",
    "sensor.hysteresis", "tissue.preconditioning", "cable.viscous", "tissue.surface", "robot.compliance", "cable.friction",
)  # fmt: skip
"""Effects with a near relative in the library, in turn."""
SNR = (6.0, 20.0)
"""Range of the signal-to-noise ratio: seen, but not told apart from its relatives."""
MAX_BINS, FASTEST_HZ = 1200, 200.0
"""Fewer bins and slower recordings than the blind check has, since three diagnoses are made for every case."""
ATTEMPTS = 60
"""Cells drawn for one effect before it is given up."""
RESAMPLES = 4000
"""Number of resamples of the bootstrap interval."""
Arm = Literal["advised", "random"]
ARMS: tuple[Arm, ...] = ("advised", "random")


class Answer(TypedDict):
    """What one diagnosis says. `open` are the effects it holds possible, `among` whether the true one is among them."""

    verdict: str
    named: list[str]
    open: list[str]
    resolved: bool
    among: bool
    p: float


class JointAnswer(Answer):
    """What the diagnosis of both recordings says; `duration_s` is the second's."""

    duration_s: float


class Comparison(TypedDict):
    """One open case: the first answer, and that after either second motion."""

    case: int
    effect: str
    law: str
    parameters: Shape
    snr: float
    first: Answer
    advice: str
    expected_gain: float
    advised: JointAnswer
    random: JointAnswer


class AdviceTable(TypedDict):
    """Shares resolved by either motion, their difference, and the true effects that were wrongly excluded."""

    n: int
    resolved_advised: float | None
    resolved_random: float | None
    difference: float | None
    difference_ci95: list[float] | None
    only_advised: int
    only_random: int
    reversals_advised: int
    reversals_random: int
    mean_p_first: float
    mean_p_advised: float
    mean_p_random: float


class AdviceResult(TypedDict):
    """The content of the JSON file."""

    schema: str
    cases: int
    seed: int
    tried: int
    table: AdviceTable
    outcomes: list[Comparison]


def run(cases: int, seed: int, *, jobs: int = 1, progress: Callable[[int], None] = lambda _: None) -> AdviceResult:
    """Draw cells until enough of them are left open by their first recording, and compare both second motions on each.

    Args:
        seed: The same seed draws the same cells.
        jobs: Number of processes.
        progress: Called with the number of open cases.

    Returns:
        The content of the JSON file. A wrong reversal excludes a true effect that was open before.
    """
    comparisons: list[Comparison] = []
    tried = 0
    with pool(jobs) as workers:
        while len(comparisons) < cases:
            batch = range(tried, tried + 2 * jobs)
            tried += len(batch)
            comparisons += [one for one in workers.map(compare, [seed] * len(batch), batch) if one is not None]
            progress(min(len(comparisons), cases))
    comparisons = comparisons[:cases]
    return {"schema": SCHEMA, "cases": cases, "seed": seed, "tried": tried, "table": table(comparisons), "outcomes": comparisons}


@dataclass(frozen=True)
class _Drawn:
    cell: CellRealisation
    motion: DrawnMotion
    deviations: Deviations
    planted: list[Planted]
    snr: float


def compare(seed: int, index: int) -> Comparison | None:
    """Compare the advised motion with a random one on one cell.

    Args:
        seed: Seed of the check.

    Returns:
        The comparison, or None where the first recording leaves nothing open that a motion is advised for.
    """
    r = np.random.default_rng([seed, index, 11])
    effect = EFFECTS[index % len(EFFECTS)]
    for _ in range(ATTEMPTS):
        try:
            drawn = _drawn(r, effect)
            break
        except CannotDraw:
            continue
    else:
        return None
    cell_file = cell_from(drawn.cell.as_yaml(), "the drawn cell")
    first = _recorded(r, drawn, drawn.deviations, drawn.motion)
    diagnosis = diagnose([first], cell_file, max_bins=MAX_BINS, propose=False)
    if diagnosis.verdict == "none" or diagnosis.resolved:
        return None
    limits = MotionLimits.of(diagnosis.problem)
    proposal = advise(diagnosis.problem, diagnosis.attribution, limits).proposal
    if proposal is None:
        return None
    advised = _of_legs(proposal.motion, drawn.cell, limits)
    other = _random(r, drawn.cell, advised.duration_s, limits)
    # the same scatter of presses, cell and noise generator for both: what differs is the motion
    state, presses = int(r.integers(2**31)), max(advised.presses, other.presses, 1)
    law, shape = drawn.planted[0]
    return {
        "case": index,
        "effect": effect,
        "law": law.name,
        "parameters": shape,
        "snr": drawn.snr,
        "first": _answer(diagnosis, effect),
        "advice": proposal.motion.what,
        "expected_gain": proposal.expected_gain,
        "advised": _joint_answer(state, presses, drawn, first, advised, cell_file, effect),
        "random": _joint_answer(state, presses, drawn, first, other, cell_file, effect),
    }


def _joint_answer(
    state: int, presses: int, drawn: _Drawn, first: Samples, second: DrawnMotion, cell_file: CellFile, effect: str
) -> JointAnswer:
    again = np.random.default_rng(state)
    scatter = again.standard_normal((2, presses))
    recorded = _recorded(again, drawn, Deviations(drawn.deviations.of, scatter[0], scatter[1]), second)
    joint = diagnose([first, recorded], cell_file, max_bins=2 * MAX_BINS, propose=False)
    return {**_answer(joint, effect), "duration_s": recorded.duration_s}


def _drawn(r: np.random.Generator, effect: str) -> _Drawn:
    cell = draw_cell(r)
    if cell.rate_Hz > FASTEST_HZ:
        raise CannotDraw("too many rows")
    motion = draw_motion(r, cell)
    detectability = Detectability(cell, draw_deviations(r, motion), motion, _rows(cell, motion))
    laws = laws_of("two", effect)  # the library's and foreign ones
    law = laws[int(r.integers(len(laws)))]
    snr = float(np.exp(r.uniform(*np.log(SNR))))
    fitted = fit_strength(detectability, law, law.draw(r, scales_of(detectability)), snr)
    if fitted is None or fitted.snr is None:
        raise CannotDraw(effect)
    return _Drawn(cell, motion, detectability.deviations, [(law, fitted.parameters)], fitted.snr)


def _rows(cell: CellRealisation, motion: DrawnMotion) -> Floats:
    return np.arange(int(motion.duration_s * cell.rate_Hz)) / cell.rate_Hz


def _recorded(r: np.random.Generator, drawn: _Drawn, deviations: Deviations, motion: DrawnMotion) -> Samples:
    cell = drawn.cell
    t_s = _rows(cell, motion)
    run = Detectability(cell, deviations, motion, t_s).run(drawn.planted)
    return measured(r, cell, run, motion, t_s, drawn.planted, cell.rate_Hz)


def _of_legs(advised: TestMotion, cell: CellRealisation, limits: MotionLimits) -> DrawnMotion:
    """An advised motion in the blind check's own terms."""
    here = advised.start_m(cell.surface_z_m, cell.surface_z_m + limits.home_m)
    rows = [(0.0, here, here - 1e-12, 1.0, 1e9)]
    t_s, presses = 1.0, []
    for to_m, speed, rest_s in advised.legs(cell.surface_z_m, cell.surface_z_m + limits.home_m):
        acceleration, way_m = limits.acceleration_m_per_s2, abs(to_m - here)
        if way_m < 1e-9:
            t_s += rest_s
            continue
        if to_m < cell.surface_z_m:
            presses.append(t_s - 0.05)
        rows.append((t_s, here, to_m, speed, acceleration))
        top = min(speed, (way_m * acceleration) ** 0.5)
        t_s += way_m / top + top / acceleration + rest_s
        here = to_m
    return _motion(rows, presses, t_s)


def _motion(rows: Sequence[tuple[float, ...]], presses: Sequence[float], duration_s: float) -> DrawnMotion:
    columns = np.array(rows).T
    return DrawnMotion(columns[0], columns[1], columns[2], columns[3], columns[4], np.array(presses), duration_s)


def _random(r: np.random.Generator, cell: CellRealisation, duration_s: float, limits: MotionLimits) -> DrawnMotion:
    """Drawn as first recordings are, one after another until it is as long, no deeper than allowed, then cut off."""
    rows: list[tuple[float, ...]] = []
    presses: list[float] = []
    begin_s = 0.0
    while begin_s < duration_s:
        one = draw_motion(r, cell)
        lowest = cell.surface_z_m - limits.depth_m
        from_m, to_m = np.maximum(one.from_m, lowest), np.maximum(one.to_m, lowest)
        if rows:  # go to where the next one begins
            speed, acceleration = float(one.speed_m_per_s[1]), float(one.acceleration_m_per_s2[1])
            way_m = abs(float(from_m[0]) - rows[-1][2])
            rows.append((begin_s, rows[-1][2], float(from_m[0]), speed, acceleration))
            begin_s += way_m / speed + 2.0 * speed / acceleration + 0.5
        columns = np.array([one.begin_s + begin_s, from_m, to_m, one.speed_m_per_s, one.acceleration_m_per_s2]).T
        rows += [tuple(row) for row in columns.tolist() if row[1] != row[2]]
        presses += (one.press_begin_s + begin_s).tolist()
        begin_s += one.duration_s
    return _motion(rows, [p for p in presses if p < duration_s], duration_s)


def _answer(diagnosis: Diagnosis, effect: str) -> Answer:
    named = [e.id for e in diagnosis.effects]
    among = {name for e in diagnosis.effects for name in (e.id, *e.indistinguishable_from)}
    return {
        "verdict": diagnosis.verdict,
        "named": named,
        "open": sorted(among),
        "resolved": diagnosis.resolved and named == [effect],
        "among": effect in among,
        "p": float(min(diagnosis.decision.candidates.get(effect, 0.0), 1.0)),
    }


def table(comparisons: Sequence[Comparison]) -> AdviceTable:
    """Shares resolved, their difference with its bootstrap interval over cases, and wrong reversals, by either motion."""
    n = len(comparisons)
    resolved = {arm: np.array([float(one[arm]["resolved"]) for one in comparisons]) for arm in ARMS}
    gain = resolved["advised"] - resolved["random"]
    interval = None
    if n > 1:
        drawn = bootstrap((gain,), np.mean, n_resamples=RESAMPLES, method="percentile", rng=np.random.default_rng(0)).confidence_interval
        interval = [float(drawn.low), float(drawn.high)]

    def mean_p(when: Literal["first", "advised", "random"]) -> float:
        return float(np.mean([one[when]["p"] for one in comparisons])) if n else 0.0

    return {
        "n": n,
        "resolved_advised": float(resolved["advised"].mean()) if n else None,
        "resolved_random": float(resolved["random"].mean()) if n else None,
        "difference": float(gain.mean()) if n else None,
        "difference_ci95": interval,
        "only_advised": int((gain > 0).sum()),
        "only_random": int((gain < 0).sum()),
        "reversals_advised": sum(one["first"]["among"] > one["advised"]["among"] for one in comparisons),
        "reversals_random": sum(one["first"]["among"] > one["random"]["among"] for one in comparisons),
        "mean_p_first": mean_p("first"),
        "mean_p_advised": mean_p("advised"),
        "mean_p_random": mean_p("random"),
    }


def sentence(figures: AdviceTable) -> str:
    """The table in words."""
    if figures["resolved_advised"] is None or figures["resolved_random"] is None or figures["difference"] is None:
        return "No case was left open by its first recording."
    interval = figures["difference_ci95"]
    span = f" (95 %: {100 * interval[0]:+.0f} to {100 * interval[1]:+.0f})" if interval else ""
    return (
        f"Of {figures['n']} open cases the advised motion resolves {figures['resolved_advised']:.0%}, a random one of equal length "
        f"{figures['resolved_random']:.0%}: {100 * figures['difference']:+.0f} points{span}. "
        f"Truth excluded that was open before: {figures['reversals_advised']} by the advised, {figures['reversals_random']} by the random. "
        f"Mean probability on the truth: {figures['mean_p_first']:.2f} before, {figures['mean_p_advised']:.2f} advised, "
        f"{figures['mean_p_random']:.2f} random."
    )
