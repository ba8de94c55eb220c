"""Fit the map from the engine's probabilities to stated ones, and say what it does on other cells.

`python benchmarks/calibrate.py --fit A.json … --check B.json … [--write]`. Each file is a result of `palpd blind --json`. The cells to
fit on and the cells to report must have other seeds. `--write` stores the map, if the calibration error of no source of the check
grows. Results that were made with a fitted map in force are refused: store the one that changes nothing first (--reset), then run
`palpd blind` again.
"""

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

from palpd.blind.check import CheckResult
from palpd.blind.figures import load
from palpd.blind.score import CaseOutcome, answered, calibration_error
from palpd.errors import BadInput
from palpd.files import write_json
from palpd.gap.calibration import MAP_FILE, ProbabilityMap

STORED = Path(__file__).parents[1] / "palpd" / "gap" / MAP_FILE
LEAST_CELLS = 100
"""Least number of cells to fit three numbers on."""


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
        outcomes: Cases with their answers, made with the map that changes nothing.
        how: What they are.

    Returns:
        The map.

    Raises:
        BadInput: There are too few.
    """
    n = len(pairs_of(outcomes, ProbabilityMap()))
    if n < LEAST_CELLS:
        raise BadInput(f"the checks to fit on hold {n} cells that count, expected at least {LEAST_CELLS}; run more")

    def loss(q: Any) -> float:
        return log_loss(pairs_of(outcomes, _of(q)))

    def _of(q: Any) -> ProbabilityMap:
        return ProbabilityMap(float(np.exp(-abs(q[0]))), float(0.5 / (1.0 + np.exp(-q[1]))), float(np.exp(q[2])), n, how)

    starts = [(a, b, 0.0) for a in (0.2, 2.0) for b in (-2.0, 0.0)]
    best = min((minimize(loss, start, method="Nelder-Mead") for start in starts), key=lambda solution: float(solution.fun))
    fitted = _of(best.x)
    return ProbabilityMap(round(fitted.power, 4), round(fitted.doubt, 4), round(fitted.power_none, 4), n, how)


def report(outcomes: Sequence[CaseOutcome], by: ProbabilityMap) -> tuple[str, bool]:
    """Calibration error by source before and after, and whether it grows nowhere."""
    lines, helps = ["| source | n | error before | after |", "|---|---|---|---|"], True
    sources = sorted({o["source"] for o in outcomes})
    for name in [*sources, "all"]:
        mine = [o for o in outcomes if name in {o["source"], "all"}]
        before, after = (calibration_error(pairs_of(mine, each)) for each in (ProbabilityMap(), by))
        helps = helps and after <= before
        lines.append(f"| {name} | {len(pairs_of(mine, by))} | {before:.3f} | {after:.3f} |")
    return "\n".join(lines), helps


def loaded(paths: Sequence[Path]) -> list[CheckResult]:
    """Results of blind checks; those made with a fitted map are refused."""
    checks = [load(path) for path in paths]
    for path, check in zip(paths, checks, strict=True):
        if check["probability_map"]["cells"]:
            raise BadInput(f"{path} was made with a fitted map ({check['probability_map']['how']}); reset it and run the check again")
    return checks


def main() -> None:
    """Fit, report, and store where it helps."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fit", type=Path, nargs="+", default=[], help="results of checks to fit on (.json)")
    parser.add_argument("--check", type=Path, nargs="+", default=[], help="results of checks to report (.json), of other seeds")
    parser.add_argument("--write", action="store_true", help="store the map where it helps on every source")
    parser.add_argument("--reset", action="store_true", help="store the map that changes nothing, and stop")
    options = parser.parse_args()
    if options.reset:
        write_json(STORED, asdict(ProbabilityMap()))
        return
    fitting, checking = loaded(options.fit), loaded(options.check)
    seeds = sorted({check["seed"] for check in fitting})
    if set(seeds) & {check["seed"] for check in checking}:
        raise BadInput(f"the cells to fit on and the cells to report share a seed ({seeds}); give checks of other seeds")
    sources = sorted({source for check in fitting for source in check["sources"]})
    how = f"palpd blind, sources {', '.join(sources)}, seeds {', '.join(map(str, seeds))}"
    by = fit([o for check in fitting for o in check["outcomes"]], how)
    print(f"power {by.power:g}, doubt {by.doubt:g}, power of no gap {by.power_none:g}, fitted on {by.cells} cells ({by.how})")
    text, helps = report([o for check in checking for o in check["outcomes"]], by)
    print(text)
    if options.write and not helps:
        raise BadInput("the map makes a source worse; it is not stored")
    if options.write:
        write_json(STORED, asdict(by))
        print(f"stored in {STORED}")


if __name__ == "__main__":
    main()
