"""How exact moduli of plain elastic tissue are, and how often 95 % intervals hold the truth, on emulated cells that are drawn at random.

python benchmarks/moduli.py [--cells N] [--seed N]
"""

import argparse
import math

import numpy as np

from palpd.cell_file import CellFile, Tissue
from palpd.compensate import LineAndRunningZero, corrections
from palpd.errors import RecordingError
from palpd.inclusion import PRESS_SIGMA_M, SURFACE_SIGMA_M
from palpd.results import PEAK_WINDOW_S
from palpd.study_cell import STEP_S, Move, Take, free_cell, ramps, setup, take
from palpd.young import fit_contact, modulus_peak_Pa, student_t_95

REST_M, RADIUS_M = 0.010, 0.005
DEPTHS_M = (0.004, 0.006, 0.008)
"""The daemon's short plan."""


def drawn(rng: np.random.Generator) -> CellFile:
    """Elastic tissue; bias and warm-up after the tare, hysteresis within the data sheet; counts behind a filter of 15 or 150 Hz."""
    cell = setup("A")
    sensor = cell.sensor.model_copy(update={"filter_cutoff_Hz": float(rng.choice([15.0, 150.0]))})
    effects = {
        "sensor.bias": {"offset_N": rng.normal(0.19, 0.06)},
        "sensor.warmup": {"amplitude_N": rng.uniform(-0.1, 0.1), "tau_s": rng.uniform(60.0, 600.0)},
        "sensor.hysteresis": {"width_N": 1.0, "amplitude_N": rng.uniform(0.0, 0.02)},
    }
    tissue = Tissue(youngs_modulus_Pa=rng.uniform(4e4, 1.5e5))
    return cell.model_copy(update={"sensor": sensor, "tissue": tissue, "effects": effects})


def mean_N(values: np.ndarray, span: slice, length_s: float) -> float:
    """Over the end of a span."""
    return float(values[span.stop - round(length_s / STEP_S) : span.stop].mean())


def static_Pa(run: Take, spans: list[slice], depths_m: list[float]) -> float:
    """Mean of equation 1 on holds less the rest before each."""
    forces = [mean_N(run.fz_N, spans[k + 1], 3.0) - mean_N(run.fz_N, spans[k], 0.5) for k in range(0, len(spans) - 1, 2)]
    return float(np.mean([modulus_peak_Pa(f, d, RADIUS_M, 0.5) for f, d in zip(forces, depths_m, strict=True)]))


def dynamic_Pa(run: Take, corrected_N: np.ndarray, delay_s: float, surface_m: float) -> float:
    """Mean of equation 1 at the peaks, which the sensor's filter shows late."""
    width = round(PEAK_WINDOW_S / STEP_S)
    window = np.full(width, 1.0 / width)
    tip_m = np.convolve(np.interp(run.t_s - delay_s, run.t_s, run.z_m), window, mode="valid")
    force_N = np.convolve(corrected_N, window, mode="valid")
    touching = np.convolve(run.z_m, window, mode="valid") < surface_m - 0.001
    edges = np.flatnonzero(np.diff(np.concatenate(([0], touching.astype(int), [0]))))
    found = []
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        at = first + int(np.argmax(force_N[first:last]))
        found.append(modulus_peak_Pa(float(force_N[at]), surface_m - float(tip_m[at]), RADIUS_M, 0.5))
    return float(np.mean(found))


def main() -> None:
    """Print errors and coverage."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    winner = LineAndRunningZero()
    cycle = [Move(0.03, 0.02, 0.5), *[Move(0.03 + way, 0.02, 0.3) for _ in range(10) for way in (0.02, 0.0)]]
    winner.fit([take(free_cell(setup("A"), {"sensor.bias": {"offset_N": 0.19}}), ramps(0.03, cycle)[0], 10_000 + k) for k in range(2)])
    static, dynamic, loading, covered = [], [], [], []
    for k in range(asked.cells):
        rng = np.random.default_rng([asked.seed, k])
        cell = drawn(rng)
        assert cell.tissue is not None
        true_Pa = cell.tissue.youngs_modulus_Pa
        believed_m = rng.normal(0.0, SURFACE_SIGMA_M)
        reached = [believed_m - d + rng.normal(0.0, PRESS_SIGMA_M) for d in DEPTHS_M]
        holds, presses = [Move(REST_M, 0.02, 1.0)], [Move(REST_M, 0.02, 1.0)]
        for z_m in reached:
            holds += [Move(z_m, 0.01, 4.0), Move(REST_M, 0.01, 1.0)]
            presses += [Move(z_m, 0.01), Move(REST_M, 0.01, 0.5)]
        z_cmd_m, spans = ramps(REST_M, holds)
        held = take(cell, z_cmd_m, 2 * k)
        static.append(static_Pa(held, [slice(*span) for span in spans], list(DEPTHS_M)) / true_Pa - 1.0)
        z_cmd_m, spans = ramps(REST_M, presses)
        run = take(cell, z_cmd_m, 2 * k + 1)
        delay_s = 1.0 / (2.0 * math.pi * float(cell.sensor.filter_cutoff_Hz or math.inf))
        corrected_N = run.fz_N - corrections(winner, run)
        dynamic.append(dynamic_Pa(run, corrected_N, delay_s, believed_m) / true_Pa - 1.0)
        deepest = slice(spans[-3][1] - round(0.5 / STEP_S), spans[-2][1])
        height_m = np.interp(run.t_s - delay_s, run.t_s, run.z_m)[deepest]
        try:
            fit = fit_contact(height_m, run.fz_N[deepest], RADIUS_M, 0.5)
        except RecordingError:
            continue
        loading.append(fit.youngs_modulus_Pa / true_Pa - 1.0)
        covered.append(fit.ci95_Pa[0] <= true_Pa <= fit.ci95_Pa[1])
    print(f"{asked.cells} cells of 40 to 150 kPa, seed {asked.seed}. Error of the modulus (%):")
    print("| by | mean | rms | largest | within |")
    print("|---|---|---|---|---|")
    told = (("static holds, equation 1", static, 3), ("dynamic peaks, corrected", dynamic, 6), ("loading curve, Hertz", loading, 3))
    for name, errors, most in told:
        e = 100.0 * np.array(errors)
        print(
            f"| {name} | {e.mean():+.2f} | {np.sqrt(np.mean(e**2)):.2f} | {np.abs(e).max():.2f} "
            f"| {int(np.sum(np.abs(e) <= most))} of {len(e)} within {most} % |"
        )
    n, p, z = len(covered), float(np.mean(covered)), student_t_95(1e9)
    centre, half = (p + z**2 / (2 * n)) / (1 + z**2 / n), z / (1 + z**2 / n) * math.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    print(f"\n95 % intervals of the loading curve hold the truth in {sum(covered)} of {n}: {100 * p:.0f} %", end=" ")
    print(f"({100 * (centre - half):.0f} to {100 * (centre + half):.0f} %).")


if __name__ == "__main__":
    main()
