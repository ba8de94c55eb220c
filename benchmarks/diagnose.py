"""Cost of a diagnosis: time by length of the recording, memory, the spread over cells, a million rows, and the gain of a second process.

`python benchmarks/diagnose.py [--length 90] [--cells 9] [--rows 1000000] [--recordings 6]`; 0 leaves a part out. No two strokes are alike;
the rate is 500 Hz. Every figure comes from its own process, the last ones from a folder as `palpd diagnose FOLDER` does it.
Targets: 90 s of recording in a median of 2.5 s and a 95th percentile of 6 s, at most 500 MB; a million rows in 60 s and 1 GB; two
processes 1.8 times as fast as one. One run times everything, so that other load on the machine cancels best in the ratios.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from palpd.cell.cell_file import Estimated, nominal, save_cell
from palpd.cell.simulation import simulate
from palpd.cell.stages import WRENCH
from palpd.gap.commands import diagnose_files
from palpd.gap.fleet import diagnose_folder
from palpd.recording.samples import Samples, write_csv

RATE_HZ = 500.0
EFFECTS = {"tissue.viscoelastic": {"ratio": 0.2, "tau_s": 0.7}, "cable.friction": {"force_N": 0.06}}
"""Two strong effects: pairs are searched, and the gap is large enough to change how tolerances act. This is the slowest kind."""

KINDS: list[dict[str, dict[str, float]]] = [
    {},
    {"sensor.gain": {"error": 0.04}},
    {"cable.friction": {"force_N": 0.02}},
    {"robot.lag": {"bandwidth_ratio": 0.9}},
    {"tissue.viscoelastic": {"ratio": 0.02, "tau_s": 0.7}},
    {"sensor.latency": {"delay_s": 0.006}},
    {"sensor.creep": {"ratio": 0.02, "tau_s": 5.0}, "probe.mass": {"delta_kg": 0.02}},
    {"tissue.thickness": {"thickness_m": 0.1}},
    EFFECTS,
]
"""What the cells of the spread have, in turn: nothing, one effect near what tolerances hide or clear of it, two."""


def heights(seconds: float, seed: int) -> np.ndarray:
    """Commanded heights (n,) of strokes in the air and presses with random depths, speeds and rests."""
    rng = np.random.default_rng(seed)
    pieces, z_m, missing = [np.full(int(RATE_HZ), 0.01)], 0.01, int(seconds * RATE_HZ) - int(RATE_HZ)
    while missing > 0:
        free = rng.random() < 0.3
        for to_m, rest_s in ((rng.uniform(0.003, 0.006) if free else -rng.uniform(0.004, 0.008), rng.uniform(0.3, 3.0)), (0.01, 0.6)):
            ramp = np.linspace(z_m, to_m, int(abs(z_m - to_m) / rng.uniform(0.005, 0.03) * RATE_HZ))
            piece = np.concatenate([ramp, np.full(int(rest_s * RATE_HZ), to_m)])
            pieces.append(piece)
            z_m, missing = to_m, missing - len(piece)
    return np.concatenate(pieces)[: int(seconds * RATE_HZ)]


def record(path: Path, seconds: float, seed: int, effects: dict[str, dict[str, float]] | None = None) -> None:
    """Write a recording of a cell with effects (default: EFFECTS) and in-tolerance deviations, and its cell file beside it."""
    off = Estimated(bias_N=0.015, gain=0.004, latency_s=-0.0005, mass_kg=0.002, youngs_modulus=0.015, surface_z_m=-2e-5)
    z_cmd_m = heights(seconds, seed)
    t_s = np.arange(len(z_cmd_m)) / RATE_HZ
    cell = nominal().with_effects(EFFECTS if effects is None else effects).with_estimated(off)
    columns = simulate(cell, t_s, z_cmd_m=z_cmd_m, noise_seed=seed)
    wrench = np.column_stack([columns[name] for name in WRENCH])
    write_csv(path, Samples(t_s, z_cmd_m, columns["z_m"], columns["vz_m_per_s"], wrench))
    save_cell(path.with_suffix(".yaml"), nominal())


def measure(path: Path) -> None:
    """Diagnose a recording and print the cost as JSON."""
    began, before = time.perf_counter(), os.times()
    diagnosis = diagnose_files([path], path.with_suffix(".yaml"))
    after = os.times()
    cost = {
        "wall_s": time.perf_counter() - began,
        "cpu_s": after.user + after.system - before.user - before.system,
        "peak_MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        "simulations": diagnosis.problem.workspace.simulations,
        "named": [effect.id for effect in diagnosis.effects],
    }
    print(json.dumps(cost))


def cost_of(path: Path, seconds: float, seed: int, effects: dict[str, dict[str, float]]) -> dict[str, Any]:
    """Record a cell, diagnose it in a process of its own, and return the cost as `measure` prints it."""
    record(path, seconds, seed, effects)
    command = [sys.executable, __file__, "--measure", str(path)]
    cost: dict[str, Any] = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    return cost


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--length", type=float, default=90.0, help="seconds; half, a third and twice as much are timed too")
    parser.add_argument("--cells", type=int, default=9, help="how many cells of that length for the spread")
    parser.add_argument("--rows", type=int, default=0, help="rows of one long recording that is timed besides; a million takes minutes")
    parser.add_argument("--recordings", type=int, default=6, help="how many, of a third of that length, over one and two processes")
    parser.add_argument("--measure", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.measure is not None:
        measure(given.measure)
        return
    print(f"load {os.getloadavg()[0]:.1f} before it began, {os.cpu_count()} cores\n")
    print("| length | wall | CPU | CPU a second recorded | peak memory | simulations | named |\n|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as name:
        lengths_s = [share * given.length for share in (1 / 3, 2 / 3, 1.0, 2.0)] + [given.rows / RATE_HZ] * (given.rows > 0)
        for seconds in lengths_s:
            cost = cost_of(Path(name) / f"{seconds:.0f}.csv", seconds, 1, EFFECTS)
            print(
                f"| {seconds:.0f} s | {cost['wall_s']:.1f} s | {cost['cpu_s']:.1f} s | {1e3 * cost['cpu_s'] / seconds:.0f} ms | "
                f"{cost['peak_MB']:.0f} MB | {cost['simulations']} | {', '.join(cost['named'])} |",
                flush=True,
            )
        costs = [cost_of(Path(name) / f"cell-{k}.csv", given.length, 100 + k, KINDS[k % len(KINDS)]) for k in range(given.cells)]
        if costs:
            wall_s, cpu_s, peak_MB = (np.array([cost[key] for cost in costs]) for key in ("wall_s", "cpu_s", "peak_MB"))
            usual = f"median {np.median(wall_s):.1f} s (CPU {np.median(cpu_s):.1f} s)"
            slow = f"95th percentile {np.quantile(wall_s, 0.95):.1f} s (CPU {np.quantile(cpu_s, 0.95):.1f} s)"
            print(f"\n{given.cells} cells of {given.length:.0f} s: {usual}, {slow}, at most {peak_MB.max():.0f} MB.", flush=True)
        if not given.recordings:
            return
        folder = Path(name) / "folder"
        folder.mkdir()
        for k in range(given.recordings):
            record(folder / f"{k}.csv", given.length / 3, seed=10 + k)
        by_jobs_s = []
        for jobs in (1, 2):
            began = time.perf_counter()
            rows = list(diagnose_folder(folder, jobs=jobs))
            by_jobs_s.append(time.perf_counter() - began)
            assert all(row.verdict is not None for row in rows)
        one_s, two_s = by_jobs_s
        print(
            f"\n{given.recordings} recordings of {given.length / 3:.0f} s: {one_s:.1f} s in one process, {two_s:.1f} s in two, "
            f"{one_s / two_s:.2f} times as fast."
        )


if __name__ == "__main__":
    main()
