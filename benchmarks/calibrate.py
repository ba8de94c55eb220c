"""Draw cells, fit the map from the engine's probabilities to stated ones, and say what it does on other cells.

`python -m benchmarks.calibrate --cells 200 --kept FOLDER [--write]` draws that many cells of each source to fit on (seed FIT_SEED) and
as many to report (seed CHECK_SEED), by `palpd blind`; `--cells` may differ: 200 100. Both seeds are apart from those of a published
table, which come from a commit. FOLDER keeps every scored batch, so an interrupted command goes on where it was, and one with more cells
uses the kept ones. The cells state the engine's own probabilities, whatever map is in force. `--write` stores the map, if the logarithmic
score of every source of the check gets better: the calibration error of few cells is mostly chance. `--reset` stores the map that changes
nothing.
"""

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

from palpd.blind.check import CheckResult, run
from palpd.blind.outcome import CaseOutcome
from palpd.blind.score import answered, calibration_error, error_of_a_calibrated_forecaster
from palpd.blind.truth import SOURCES
from palpd.errors import BadInput
from palpd.files import write_json
from palpd.gap.calibration import MAP_FILE, ProbabilityMap

STORED = Path(__file__).parents[1] / "palpd" / "gap" / MAP_FILE
FIT_SEED, CHECK_SEED = 271828182, 314159265
"""Seeds of the cells to fit on and of the cells to report."""
LEAST_CELLS = 100
"""Least number of cells to fit three numbers on."""
PRIOR_SD = 1.0
"""Standard deviation of the logarithm of each exponent before any cell is seen, so that a few cells do not lead to an extreme map."""


def stated(outcome: CaseOutcome, by: ProbabilityMap) -> CaseOutcome:
    """The outcome with the probabilities that a map states."""
    mapped = outcome.copy()
    mapped["p"] = by.of_effects(outcome["p"])
    mapped["p_none"], mapped["p_unknown"] = by.of_classes(outcome["p_none"], outcome["p_unknown"])
    return mapped


def pairs_of(outcomes: Sequence[CaseOutcome], by: ProbabilityMap) -> list[tuple[float, bool]]:
    """Probability of the most probable answer and whether it is right, of every case that counts."""
    return [pair for o in outcomes if not o["extra"] and (pair := answered(stated(o, by))) is not None]


def log_loss(pairs: Sequence[tuple[float, bool]]) -> float:
    """Mean negative logarithm of what was said of the answers."""
    p = np.clip([p if right else 1.0 - p for p, right in pairs], 1e-6, 1.0)
    return float(-np.mean(np.log(p)))


def fit(outcomes: Sequence[CaseOutcome], how: str) -> ProbabilityMap:
    """Fit the three numbers of the map by the logarithmic score.

    Args:
        outcomes: Cases with their answers, made with the engine's own probabilities.
        how: What they are.

    Returns:
        The map.

    Raises:
        BadInput: There are too few.
    """
    n = len(pairs_of(outcomes, ProbabilityMap()))
    if n < LEAST_CELLS:
        raise BadInput(f"the cells to fit on hold {n} that count, expected at least {LEAST_CELLS}; draw more")

    def loss(q: Any) -> float:
        by = _of(q)
        prior = 0.5 * (np.log(by.power) ** 2 + np.log(by.power_none) ** 2) / PRIOR_SD**2
        return log_loss(pairs_of(outcomes, by)) + float(prior) / n

    def _of(q: Any) -> ProbabilityMap:
        return ProbabilityMap(float(np.exp(-abs(q[0]))), float(0.5 / (1.0 + np.exp(-q[1]))), float(np.exp(q[2])), n, how)

    starts = [(a, b, 0.0) for a in (0.2, 2.0) for b in (-2.0, 0.0)]
    best = min((minimize(loss, start, method="Nelder-Mead") for start in starts), key=lambda solution: float(solution.fun))
    fitted = _of(best.x)
    return ProbabilityMap(round(fitted.power, 4), round(fitted.doubt, 4), round(fitted.power_none, 4), n, how)


def report(outcomes: Sequence[CaseOutcome], by: ProbabilityMap) -> tuple[str, bool]:
    """By source: logarithmic score and calibration error before and after, and the error of a calibrated forecaster on as many cases.

    Args:
        outcomes: Cases with their answers, made with the engine's own probabilities.
        by: The map.

    Returns:
        The table, and whether the score gets better for every source.
    """
    lines = ["| source | n | score before | after | error before | after | of a calibrated forecaster |", "|---|---|---|---|---|---|---|"]
    helps, sources = True, sorted({o["source"] for o in outcomes})
    for name in [*sources, "all"]:
        mine = [o for o in outcomes if name in {o["source"], "all"}]
        pairs = pairs_of(mine, by)
        own = pairs_of(mine, ProbabilityMap())
        helps = helps and log_loss(pairs) < log_loss(own)
        scores, errors = (f"{of(own):.3f} | {of(pairs):.3f}" for of in (log_loss, calibration_error))
        lines.append(f"| {name} | {len(pairs)} | {scores} | {errors} | {error_of_a_calibrated_forecaster(pairs):.3f} |")
    return "\n".join(lines), helps


def drawn(cells: int, seed: int, jobs: int, kept: Path) -> CheckResult:
    """Cells of every source with the engine's own probabilities; what is kept is not run again."""

    def progress(done: int) -> None:
        print(f"seed {seed}: {done} of {cells * len(SOURCES)} cells", flush=True)

    resume = kept / f"cells-{seed}.jsonl"
    return run(cells, seed, sources=SOURCES, jobs=jobs, resume=resume, calibrated=False, progress=progress)


def main() -> None:
    """Draw, fit, report, and store where it helps."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, nargs="+", default=[200], help="cells of each source: to fit on, and to report if not as many")
    parser.add_argument("--kept", type=Path, default=Path("calibration"), help="folder that keeps what was drawn and scored")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--write", action="store_true", help="store the map where it helps on every source")
    parser.add_argument("--reset", action="store_true", help="store the map that changes nothing, and stop")
    options = parser.parse_args()
    if options.reset:
        write_json(STORED, asdict(ProbabilityMap()))
        return
    options.kept.mkdir(parents=True, exist_ok=True)
    to_fit, to_report = options.cells[0], options.cells[-1]
    how = f"python -m benchmarks.calibrate --cells {to_fit} {to_report}: {to_fit} cells of each of {', '.join(SOURCES)}, seed {FIT_SEED}"
    by = fit(drawn(to_fit, FIT_SEED, options.jobs, options.kept)["outcomes"], how)
    print(f"power {by.power:g}, doubt {by.doubt:g}, power of no gap {by.power_none:g}, fitted on {by.cells} cells that count ({by.how})")
    text, helps = report(drawn(to_report, CHECK_SEED, options.jobs, options.kept)["outcomes"], by)
    print(text)
    if options.write and not helps:
        raise BadInput("the map makes a source worse; it is not stored")
    if options.write:
        write_json(STORED, asdict(by))
        print(f"stored in {STORED}")


if __name__ == "__main__":
    main()
