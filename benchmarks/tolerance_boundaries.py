"""Answers at the boundary of every tolerance that has an effect of its own, with controllers that are no second-order servo.

`python -m benchmarks.tolerance_boundaries [--bins 900] [--jobs 2]`. One deviation at a time stands at 0, 1, 2, 3 and 5 standard
deviations; every other one is zero. Up to 2 the answer must be silent, up to 4 silent or the deviation's own effect with its group,
and beyond 4 named or reported where its SNR beside the other tolerances is 10 or more. Each `!` marks a wrong answer.
"""

import argparse
from functools import partial
from itertools import product

from benchmarks.boundaries import KEYS, Boundary, answer_to
from palpd.testing.plain_cells import CONTROLLERS
from palpd.workers import pool

DEVIATIONS_SD = (0.0, 1.0, 2.0, 3.0, 5.0)


def main() -> None:
    """Print a table of answers, one row per recording."""
    parser = argparse.ArgumentParser(description="Answers at the boundaries of tolerances.")
    parser.add_argument("--bins", type=int, default=900, help="largest number of bins of a diagnosis")
    parser.add_argument("--jobs", type=int, default=1, help="number of processes")
    parser.add_argument("--controllers", nargs="+", choices=CONTROLLERS, default=CONTROLLERS[1:], help="controllers to try")
    parser.add_argument("--keys", nargs="+", choices=sorted(KEYS), default=sorted(KEYS), help="tolerances to try")
    options = parser.parse_args()
    zero = [Boundary(controller, "gain", 0.0) for controller in options.controllers]  # without a deviation all keys are the same cell
    off = product(options.controllers, options.keys, DEVIATIONS_SD[1:])
    boundaries = [*zero, *(Boundary(controller, key, sd) for controller, key, sd in off)]
    print("| controller | tolerance | sd | SNR | answer | |")
    print("|---|---|---|---|---|---|")
    wrong = 0
    with pool(options.jobs) as workers:
        for one, outcome in zip(boundaries, workers.map(partial(answer_to, max_bins=options.bins), boundaries), strict=True):
            wrong += not outcome.right
            mark = "" if outcome.right else "!"
            print(f"| {one.controller} | {one.key} | {one.off_sd:g} | {outcome.snr:.1f} | {outcome.answer} | {mark} |", flush=True)
    print(f"\n{len(boundaries) - wrong} of {len(boundaries)} answers are right.")


if __name__ == "__main__":
    main()
