"""How often inclusions at 5, 8 and 10 mm are found, and plain tissue is accused, on emulated cells.

python benchmarks/inclusion.py [--seeds N] [--deepest-mm N] [--series N]
"""

import argparse
from collections.abc import Sequence

import numpy as np

from palpd.analysis.inclusion import DEPTHS_M, Inclusion, find_inclusion
from palpd.cell.cell_file import CellFile, TissueBlock
from palpd.cell.motion_profile import Move, commanded_heights
from palpd.quantities import wilson
from palpd.study.laboratory import STEP_S, setup, take

LIMIT_N = 25.0
"""Holds are left out where a press would pass this, as the daemon would."""


def cell_of(rng: np.random.Generator, inclusion_m: float | None) -> CellFile:
    """A cell of drawn stiffness, rate dependence, bias and hysteresis, with an inclusion of drawn contrast or none."""
    effects = {
        "tissue.viscoelastic": {"ratio": rng.uniform(0.0, 0.4), "tau_s": rng.uniform(0.2, 1.0)},
        "sensor.bias": {"offset_N": rng.normal(0.0, 0.1)},
        "sensor.hysteresis": {"width_N": 1.0, "amplitude_N": rng.uniform(0.0, 0.02)},
    }
    if inclusion_m is not None:
        effects["tissue.inclusion"] = {"contrast": float(np.exp(rng.uniform(np.log(0.5), np.log(3.0)))), "depth_m": inclusion_m}
    tissue = TissueBlock(youngs_modulus_Pa=rng.uniform(4e4, 1.2e5))
    return setup("A").model_copy(update={"tissue": tissue, "effects": effects})


def palpate(cell: CellFile, holds_m: Sequence[float], rng: np.random.Generator, seed: int) -> tuple[list[float], list[float]]:
    """Depths below the surface that was found and forces of the holds, each less the rest before it."""
    found_m = rng.normal(0.0, 5e-5)
    moves = [Move(0.006, 0.02, 0.5)]
    for depth_m in holds_m:
        moves += [Move(found_m + rng.normal(0.0, 2e-5) - depth_m, 0.01, 6.0), Move(0.006, 0.01, 1.5)]
    z_cmd_m, spans = commanded_heights(0.006, moves, STEP_S)
    run = take(cell, z_cmd_m, seed)
    depths_m, forces_N = [], []
    rest_N = float(run.fz_N[spans[0][1] - 200 : spans[0][1]].mean())
    for k, depth_m in enumerate(holds_m):
        _, end = spans[1 + 2 * k]
        force_N = float(run.fz_N[end - 750 : end].mean()) - rest_N
        force_N *= 1.0 + rng.normal(0.0, 0.01)
        last = spans[2 + 2 * k][1]
        rest_N = float(run.fz_N[last - 400 : last].mean())
        if force_N > LIMIT_N:
            continue
        if force_N > 0.0:
            depths_m.append(depth_m)
            forces_N.append(force_N)
    return depths_m, forces_N


def judged(inclusion_m: float | None, holds_m: Sequence[float], seed: int) -> Inclusion:
    """One emulated site."""
    rng = np.random.default_rng([seed, 0 if inclusion_m is None else round(inclusion_m * 1e6)])
    return find_inclusion(*palpate(cell_of(rng, inclusion_m), holds_m, rng, seed))


def share(hits: list[bool]) -> str:
    """With Wilson's 95 % interval."""
    low, high = wilson(sum(hits), len(hits))
    return f"{100 * sum(hits) / len(hits):.0f} % ({100 * low:.0f}–{100 * high:.0f})"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--deepest-mm", type=int, default=10, help="holds at every millimetre down to this")
    parser.add_argument("--series", type=int, default=2, help="how often")
    asked = parser.parse_args()
    count, holds_m = asked.seeds, [0.001 * d for d in range(1, asked.deepest_mm + 1)] * asked.series
    plain = [judged(None, holds_m, seed) for seed in range(count)]
    print("| below the surface | judged to hold an inclusion (p > 0.5) | class of depth right | contrast within its 95 % interval |")
    print("|---|---|---|---|")
    print(f"| nothing | {share([each.probability > 0.5 for each in plain])} | – | – |")
    for depth_m in DEPTHS_M:
        presses = [judged(depth_m, holds_m, seed) for seed in range(count)]
        true = []
        for seed in range(count):
            rng = np.random.default_rng([seed, round(depth_m * 1e6)])
            true.append(cell_of(rng, depth_m).effects["tissue.inclusion"]["contrast"])
        within = [each.contrast_ci95[0] * 0.95 <= c <= each.contrast_ci95[1] * 1.05 for each, c in zip(presses, true, strict=True)]
        print(
            f"| {depth_m * 1e3:g} mm | {share([each.probability > 0.5 for each in presses])} "
            f"| {share([each.depth_m == depth_m for each in presses])} | {share(within)} |"
        )


if __name__ == "__main__":
    main()
