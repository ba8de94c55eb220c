"""What `palpd diagnose` costs: processor time of the whole command, with start, import and reading, on one machine in one run.

`python -m benchmarks.diagnosis_cost [--cells 18] [--rows 1000000]` prints a markdown table. No two strokes of a recording are alike. Some
of the cells are healthy, some have an effect near what tolerances hide, some a clear one or two. A second pass diagnoses a recording with
the cell file that the first one wrote. Ends with 1 where a target is missed.
"""

import argparse
import resource
import sys
import tempfile
from pathlib import Path

import numpy as np

from palpd.cell.cell_file import Estimated, nominal, save_cell
from palpd.cell.simulation import simulate
from palpd.recording.samples import WRENCH_COLUMNS, Samples, write_csv
from palpd.testing.processes import timed
from palpd.tick import Floats

TWO_EFFECTS = {"tissue.viscoelastic": {"ratio": 0.2, "tau_s": 0.7}, "cable.friction": {"force_N": 0.06}}
"""Strong enough that sets of two and three are searched: the slowest kind."""
KINDS: list[dict[str, dict[str, float]]] = [
    {},
    {"sensor.gain": {"error": 0.04}},
    {"cable.friction": {"force_N": 0.02}},
    {"robot.lag": {"bandwidth_ratio": 0.9}},
    {"tissue.viscoelastic": {"ratio": 0.02, "tau_s": 0.7}},
    {"sensor.latency": {"delay_s": 0.006}},
    {"sensor.creep": {"ratio": 0.02, "tau_s": 5.0}, "probe.mass": {"delta_kg": 0.02}},
    {"tissue.thickness": {"thickness_m": 0.1}},
    TWO_EFFECTS,
]
"""What the cells have, in turn."""
DEVIATIONS = Estimated(bias_N=0.015, gain=0.004, latency_s=-0.0005, mass_kg=0.002, youngs_modulus=0.015, surface_z_m=-2e-5)
MOST_S = {"median": 2.5, "95th percentile": 6.0, "short": 10.0, "long": 30.0}
"""Targets in processor seconds: of the cells, and of the two long recordings."""
SECOND_PASSES = 8


def heights(rows: int, rate_Hz: float, seed: int) -> Floats:
    """Commanded heights (n,) of strokes in the air and presses with random depths, speeds and rests."""
    rng = np.random.default_rng(seed)
    pieces, z_m = [np.full(int(rate_Hz), 0.01)], 0.01
    while sum(map(len, pieces)) < rows:
        free = rng.random() < 0.3
        for to_m, rest_s in ((rng.uniform(0.003, 0.006) if free else -rng.uniform(0.004, 0.008), rng.uniform(0.3, 3.0)), (0.01, 0.6)):
            ramp = np.linspace(z_m, to_m, int(abs(z_m - to_m) / rng.uniform(0.005, 0.03) * rate_Hz))
            pieces += [ramp, np.full(int(rest_s * rate_Hz), to_m)]
            z_m = to_m
    return np.concatenate(pieces)[:rows]


def record(path: Path, rows: int, rate_Hz: float, seed: int, effects: dict[str, dict[str, float]]) -> None:
    """Write a recording of a cell with effects and deviations within tolerance, and its cell file beside it."""
    z_cmd_m = heights(rows, rate_Hz, seed)
    t_s = np.arange(rows) / rate_Hz
    columns = simulate(nominal().with_effects(effects).with_estimated(DEVIATIONS), t_s, z_cmd_m=z_cmd_m, noise_seed=seed)
    wrench = np.column_stack([columns[name] for name in WRENCH_COLUMNS])
    write_csv(path, Samples(t_s, z_cmd_m, columns["z_m"], columns["vz_m_per_s"], wrench))
    save_cell(path.with_suffix(".yaml"), nominal())


def diagnosed_s(recording: Path, cell: Path) -> float:
    """Diagnose a recording, write beside its cell file, and return the processor time of the command."""
    outputs = ["--json", str(cell.with_suffix(".json")), "--cell-out", str(cell.with_suffix(".enriched.yaml")), "--force"]
    processor_s, _ = timed([sys.executable, "-m", "palpd", "diagnose", str(recording), "--cell", str(cell), *outputs])
    return processor_s


def main() -> None:
    """Record, diagnose, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, default=2 * len(KINDS), help="of 90 s at 500 Hz")
    parser.add_argument("--rows", type=int, default=1_000_000, help="of the longest recording")
    options = parser.parse_args()
    print("| recordings | processor time | target | peak memory so far |\n|---|---|---|---|", flush=True)
    all_kept = True

    def row(what: str, seconds: float, most_s: float | None) -> None:
        nonlocal all_kept
        all_kept &= most_s is None or seconds <= most_s
        peak_MB = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024.0
        print(f"| {what} | {seconds:.1f} s | {'' if most_s is None else f'{most_s:g} s'} | {peak_MB:.0f} MB |", flush=True)

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        recordings = [folder / f"cell-{k}.csv" for k in range(options.cells)]
        for k, path in enumerate(recordings):
            record(path, 45_000, 500.0, 100 + k, KINDS[k % len(KINDS)])
        costs_s = [diagnosed_s(path, path.with_suffix(".yaml")) for path in recordings]
        row(f"{len(costs_s)} of 90 s at 500 Hz, median", float(np.median(costs_s)), MOST_S["median"])
        row("the same, 95th percentile", float(np.quantile(costs_s, 0.95)), MOST_S["95th percentile"])
        again_s = [diagnosed_s(path, path.with_suffix(".enriched.yaml")) for path in recordings[:SECOND_PASSES]]
        row(f"a second pass of {len(again_s)} of these, median", float(np.median(again_s)), MOST_S["median"])
        for what, rows in (("short", 25_000), ("long", options.rows)):
            path = folder / f"{what}.csv"
            record(path, rows, 1000.0, 1, TWO_EFFECTS)
            row(f"{rows} rows at 1 kHz", diagnosed_s(path, path.with_suffix(".yaml")), MOST_S[what])
    sys.exit(not all_kept)


if __name__ == "__main__":
    main()
