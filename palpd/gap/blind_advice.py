"""Is advice worth its name? On drawn cells whose first recording leaves something open, the advised motion against a random one.

The cells are the blind check's: other physics, in-tolerance errors, scatter, noise. Both second recordings are of the same cell and equally
long; the random one is drawn as the first was, and like the advised one goes no deeper than that. Each is diagnosed jointly with the first.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np

from palpd.cell_file import cell_from
from palpd.gap.blind_cells import (
    CannotDraw,
    Cell,
    Deviations,
    Ground,
    Motion,
    Planted,
    draw_cell,
    draw_deviations,
    draw_motion,
    fit_strength,
    laws_of,
    measure_of,
    measured,
)
from palpd.gap.blind_laws import Floats
from palpd.gap.diagnosis import Diagnosis, diagnose
from palpd.gap.experiment import Limits, advise
from palpd.gap.experiment import Motion as Advised
from palpd.samples import Samples

SCHEMA = "palpd.blind.advice/1"
EFFECTS = (
    "sensor.gain", "tissue.thickness", "sensor.creep", "tissue.modulus", "tissue.inclusion", "tissue.viscoelastic",
    "sensor.hysteresis", "tissue.preconditioning", "cable.viscous", "tissue.surface", "robot.compliance", "cable.friction",
)  # fmt: skip
"""Effects with a near relative in the library, in turn."""
SNR = (6.0, 20.0)
MAX_BINS, FASTEST_HZ = 1200, 200.0
"""Fewer bins and slower recordings than the blind check has, since three diagnoses are made for every case."""
ATTEMPTS = 60


def run(cases: int, seed: int, *, jobs: int = 1, progress: Callable[[int], None] = lambda done: None) -> dict[str, Any]:
    """Draw cells until that many have been left open by their first recording; the content of the JSON file.

    `table` holds the shares resolved (the true effect named, alone and without a group) by either motion, their difference with the 95 %
    interval of a bootstrap over cases, and wrong reversals: the truth was among what was open, and is then excluded.
    """
    outcomes: list[dict[str, Any]] = []
    tried = 0
    with ProcessPoolExecutor(jobs) as pool:
        while len(outcomes) < cases:
            batch = range(tried, tried + 2 * jobs)
            tried += len(batch)
            outcomes += [one for one in pool.map(compare, [seed] * len(batch), batch) if one is not None]
            progress(min(len(outcomes), cases))
    return {"schema": SCHEMA, "cases": cases, "seed": seed, "tried": tried, "table": table(outcomes[:cases]), "outcomes": outcomes[:cases]}


def compare(seed: int, index: int) -> dict[str, Any] | None:
    """One cell; None where its first recording leaves nothing open that a motion is advised for."""
    r = np.random.default_rng([seed, index, 11])
    effect = EFFECTS[index % len(EFFECTS)]
    for _ in range(ATTEMPTS):
        try:
            cell, motion, deviations, planted, snr = _drawn(r, effect)
            break
        except CannotDraw:
            continue
    else:
        return None
    file = cell_from(cell.as_yaml(), "the drawn cell")
    first = _recorded(r, cell, deviations, motion, planted)
    found = diagnose([first], file, max_bins=MAX_BINS, propose=False)
    if found.verdict == "none" or found.resolved:
        return None
    limits = Limits.of(found.problem)
    proposal = advise(found.problem, found.attribution, limits).proposal
    if proposal is None:
        return None
    advised = _of_legs(proposal.motion, cell, limits)
    other = _random(r, cell, advised.duration_s, limits)
    # the same scatter of presses, cell and noise generator for both: what differs is the motion
    state = int(r.integers(2**31))
    answers = {}
    for name, second in (("advised", advised), ("random", other)):
        again = np.random.default_rng(state)
        scatter = again.standard_normal((2, max(advised.presses, other.presses, 1)))
        there = Deviations(deviations.of, scatter[0], scatter[1])
        recorded = _recorded(again, cell, there, second, planted)
        joint = diagnose([first, recorded], file, max_bins=2 * MAX_BINS, propose=False)
        answers[name] = _answer(joint, effect) | {"duration_s": recorded.duration_s}
    law, shape = planted[0]
    return {
        "case": index,
        "effect": effect,
        "law": law.name,
        "parameters": shape,
        "snr": snr,
        "first": _answer(found, effect),
        "advice": proposal.motion.what,
        "expected_gain": proposal.expected_gain,
        **answers,
    }


def _drawn(r: np.random.Generator, effect: str) -> tuple[Cell, Motion, Deviations, list[Planted], float]:
    cell = draw_cell(r)
    if cell.rate_Hz > FASTEST_HZ:
        raise CannotDraw("too many rows")
    motion = draw_motion(r, cell)
    ground = Ground(cell, draw_deviations(r, motion), motion, _rows(cell, motion))
    laws = laws_of("two", effect)  # the library's and foreign ones
    law = laws[int(r.integers(len(laws)))]
    snr = float(np.exp(r.uniform(*np.log(SNR))))
    fitted = fit_strength(ground, law, law.draw(r, measure_of(cell, ground)), snr)
    if fitted is None:
        raise CannotDraw(effect)
    return cell, motion, ground.deviations, [(law, fitted[0])], fitted[2]


def _rows(cell: Cell, motion: Motion) -> Floats:
    return np.arange(int(motion.duration_s * cell.rate_Hz)) / cell.rate_Hz


def _recorded(r: np.random.Generator, cell: Cell, deviations: Deviations, motion: Motion, planted: Sequence[Planted]) -> Samples:
    t_s = _rows(cell, motion)
    return measured(r, cell, Ground(cell, deviations, motion, t_s).run(planted), motion, t_s, planted, cell.rate_Hz)


def _of_legs(advised: Advised, cell: Cell, limits: Limits) -> Motion:
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


def _motion(rows: Sequence[tuple[float, ...]], presses: Sequence[float], duration_s: float) -> Motion:
    table = np.array(rows).T
    return Motion(table[0], table[1], table[2], table[3], table[4], np.array(presses), duration_s)


def _random(r: np.random.Generator, cell: Cell, duration_s: float, limits: Limits) -> Motion:
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


def _answer(found: Diagnosis, effect: str) -> dict[str, Any]:
    named = [e.id for e in found.effects]
    among = {name for e in found.effects for name in (e.id, *e.indistinguishable_from)}
    return {
        "verdict": found.verdict,
        "named": named,
        "open": sorted(among),
        "resolved": found.resolved and named == [effect],
        "among": effect in among,
        "p": float(min(found.candidates.get(effect, 0.0), 1.0)),
    }


def table(outcomes: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Shares resolved, their difference with its interval, wrong reversals, by either motion."""
    resolved = {arm: np.array([float(o[arm]["resolved"]) for o in outcomes]) for arm in ("advised", "random")}
    gain = resolved["advised"] - resolved["random"]
    random = np.random.default_rng(0)
    drawn = [float(gain[random.integers(0, len(gain), len(gain))].mean()) for _ in range(4000)] if len(gain) else [0.0]
    return {
        "n": len(outcomes),
        **{f"resolved_{arm}": float(values.mean()) if len(values) else None for arm, values in resolved.items()},
        "difference": float(gain.mean()) if len(gain) else None,
        "difference_ci95": [float(q) for q in np.quantile(drawn, [0.025, 0.975])],
        "only_advised": int((gain > 0).sum()),
        "only_random": int((gain < 0).sum()),
        **{f"reversals_{arm}": sum(o["first"]["among"] > o[arm]["among"] for o in outcomes) for arm in resolved},
        **{f"mean_p_{arm}": float(np.mean([o[arm]["p"] for o in outcomes] or [0.0])) for arm in ("first", *resolved)},
    }


def sentence(figures: dict[str, Any]) -> str:
    """The table in words."""
    low, high = figures["difference_ci95"]
    return (
        f"Of {figures['n']} open cases the advised motion resolves {figures['resolved_advised']:.0%}, a random one of equal length "
        f"{figures['resolved_random']:.0%}: {100 * figures['difference']:+.0f} points (95 %: {100 * low:+.0f} to {100 * high:+.0f}). "
        f"Truth excluded that was open before: {figures['reversals_advised']} by the advised, {figures['reversals_random']} by the random. "
        f"Mean probability on the truth: {figures['mean_p_first']:.2f} before, {figures['mean_p_advised']:.2f} advised, "
        f"{figures['mean_p_random']:.2f} random."
    )
