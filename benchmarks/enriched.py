"""Moduli of emulated cells with effects that the estimator does not know, before and after a diagnosis of another recording.

python benchmarks/enriched.py [--cells N] [--seed N] [--first N] [--no-plate]

Before, the machine is pressed against a rigid plate as `palpd stiffness` does it, by the daemon's own script on the cell's physics.
"""

import argparse
import math
import time
from dataclasses import replace

import numpy as np

from palpd.analysis.enriched import enriched_modulus
from palpd.analysis.results import machine_stiffness
from palpd.analysis.young import modulus_peak_Pa
from palpd.cell.cell_file import CellFile, TissueBlock, Wall
from palpd.cell.effects import EFFECTS
from palpd.cell.motion_profile import Move, commanded_heights
from palpd.cell.physics import true_surface_m
from palpd.cell.simulation import equilibrium_force_N
from palpd.config import Config, Plan
from palpd.daemon.motion_job import Job
from palpd.daemon.simulated_run import run
from palpd.gap.diagnosis import diagnose
from palpd.recording.samples import Samples
from palpd.study.laboratory import STEP_S, Take, setup, take
from palpd.study.methods import SENSOR_DELAY_S

DEPTHS_M = (0.003, 0.004, 0.005, 0.006)
REST_M = 0.010
PLATE_N_PER_M = 1e7
GIVE_KNOWN = {name: effect for name, effect in EFFECTS.items() if name != "robot.compliance"}
"""Effects that may be named after the plate has removed the machine's compliance."""
DRAWN = ("tissue.viscoelastic", "tissue.surface", "robot.compliance", "sensor.latency", "sensor.bias", "tissue.inclusion")


def effects_of(rng: np.random.Generator) -> dict[str, dict[str, float]]:
    """One to three effects of drawn size."""
    drawn = {
        "tissue.viscoelastic": {"ratio": rng.uniform(0.1, 0.5), "tau_s": rng.uniform(0.3, 2.0)},
        "tissue.surface": {"offset_m": rng.choice([-1.0, 1.0]) * rng.uniform(0.0002, 0.0006)},
        "robot.compliance": {"stiffness_N_per_m": rng.uniform(8e3, 3e4)},
        "sensor.latency": {"delay_s": rng.uniform(0.01, 0.04)},
        "sensor.bias": {"offset_N": rng.choice([-1.0, 1.0]) * rng.uniform(0.1, 0.3)},
        "tissue.inclusion": {"contrast": rng.uniform(0.5, 2.0), "depth_m": rng.uniform(0.005, 0.010)},
    }
    return {name: drawn[name] for name in rng.choice(DRAWN, rng.integers(1, 4), replace=False)}


def cells(rng: np.random.Generator) -> tuple[CellFile, CellFile]:
    """The true cell and what is believed of it: the same sensor, no effects, a modulus that nobody knows."""
    base = setup("A").model_copy(update={"tissue": TissueBlock(youngs_modulus_Pa=rng.uniform(4e4, 1.2e5))})
    believed = base.model_copy(
        update={"tissue": TissueBlock(youngs_modulus_Pa=7e4), "tolerances": base.tolerances.model_copy(update={"youngs_modulus": 1.0})}
    )
    return base.model_copy(update={"effects": effects_of(rng)}), believed


def scattered(cell: CellFile, rng: np.random.Generator, moves: list[tuple[float, float, float]], seed: int) -> tuple[Take, list[slice]]:
    """Presses (depth, speed, hold) below the believed surface, each with its own height of contact."""
    way = [Move(REST_M, 0.02, 1.0)]
    for depth_m, speed, hold_s in moves:
        way += [Move(rng.normal(0.0, 2e-5) - depth_m, speed, hold_s), Move(REST_M, speed, 1.0)]
    z_cmd_m, spans = commanded_heights(REST_M, way, STEP_S)
    return take(cell, z_cmd_m, seed), [slice(spans[k][0], spans[k][1]) for k in range(1, len(way), 2)]


def tip_of(run: Take, stiffness_N_per_m: float) -> Samples:
    """The recording with the machine's give taken out of its heights, as the daemon does."""
    samples = run.samples()
    smooth_N = np.convolve(run.fz_N, np.full(15, 1.0 / 15.0), mode="same")
    now_N = np.interp(run.t_s + SENSOR_DELAY_S, run.t_s, smooth_N)  # the sensor's filter shows a force late
    if math.isinf(stiffness_N_per_m):
        return samples
    return replace(samples, z_cmd_m=None, z_m=samples.z_m + now_N / stiffness_N_per_m)  # the robot was not told to give way


def plate_N_per_m(cell: CellFile, seed: int) -> float:
    """What `palpd stiffness` finds. A machine that does not give way (no `robot.compliance`) is rigid, and nothing is taken out."""
    give = {name: values for name, values in cell.effects.items() if name in ("robot.compliance", "sensor.bias", "sensor.latency")}
    if "robot.compliance" not in give:
        return math.inf
    wall = Wall(z_m=0.0, stiffness_N_per_m=PLATE_N_PER_M)
    daemon = cell.model_copy(update={"tissue": TissueBlock(), "wall": wall, "effects": give})
    done = run(Job("stiffness", Config(), Plan()), daemon, seed=seed, home_above_m=0.002)
    if done.outcome.verdict != "done":
        raise RuntimeError(f"the plate press was stopped: {done.outcome.reason}")
    return machine_stiffness(done.rows)[0]


def truth_Pa(cell: CellFile) -> float:
    """Equation 1 on the noise-free force at rest, at the true depth below the true surface, mean over the depths."""
    return float(np.mean([modulus_peak_Pa(equilibrium_force_N(cell, d), d, 0.005, 0.5) for d in DEPTHS_M]))


def main() -> None:
    """Print a row for each cell and the summary."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=1, help="number of the first cell")
    parser.add_argument("--no-plate", action="store_true", help="the machine's give is not measured")
    asked = parser.parse_args()
    print("| cell | its effects | plate, N/mm | named | dynamic, peak formula | static, equation 1 | enriched | interval holds it |")
    print("|---|---|---|---|---|---|---|---|")
    errors, inside = [], []
    for k in range(asked.first - 1, asked.first - 1 + asked.cells):
        begun_s = time.perf_counter()
        rng = np.random.default_rng([asked.seed, k])
        true, believed = cells(rng)
        probing = [(0.003, 0.005, 3.0), (0.005, 0.02, 3.0), (0.006, 0.01, 2.0), (0.004, 0.04, 2.0), (0.006, 0.005, 3.0)]
        seen, _ = scattered(true, rng, probing, 2 * k + 10_000 * asked.seed)
        stiffness = math.inf if asked.no_plate else plate_N_per_m(true, k + 10_000 * asked.seed)
        diagnosis = diagnose([tip_of(seen, stiffness)], believed, EFFECTS if asked.no_plate else GIVE_KNOWN)
        dynamic, presses = scattered(true, rng, [(d, 0.01, 0.0) for d in DEPTHS_M] * 2, 2 * k + 1 + 10_000 * asked.seed)
        static, holds = scattered(true, rng, [(d, 0.01, 8.0) for d in DEPTHS_M], 500 + 2 * k + 10_000 * asked.seed)
        peak = np.mean([_peak_Pa(dynamic, span) for span in presses])
        held = np.mean([_held_Pa(static, span) for span in holds])
        estimate = enriched_modulus([tip_of(dynamic, stiffness)], diagnosis.enriched_cell())
        true_Pa, after_Pa = truth_Pa(true), estimate.static_Pa(DEPTHS_M)
        half = (estimate.ci95_Pa[1] / estimate.youngs_modulus_Pa - 1.0) * after_Pa
        errors.append([peak / true_Pa - 1.0, held / true_Pa - 1.0, after_Pa / true_Pa - 1.0])
        inside.append(abs(after_Pa - true_Pa) <= half)
        shown = " | ".join(f"{100 * each:+.1f} %" for each in errors[-1])
        named = ", ".join(effect.id for effect in diagnosis.effects) or diagnosis.verdict
        measured = f"{stiffness / 1e3:.2f}" if math.isfinite(stiffness) else "rigid"
        print(
            f"| {k + 1} | {', '.join(true.effects)} | {measured} | {named} | {shown} | {'yes' if inside[-1] else 'no'} |"
            f" <!-- surface {1e6 * (estimate.surface_z_m - true_surface_m(true)):+.0f} µm, {time.perf_counter() - begun_s:.0f} s -->",
            flush=True,
        )
    table = np.abs(np.array(errors)) * 100
    n = len(table)
    print(f"\nn = {n} cells. Mean |error|: {', '.join(f'{each:.1f} %' for each in table.mean(axis=0))}; ", end="")
    print(f"median {', '.join(f'{each:.1f} %' for each in np.median(table, axis=0))}; ", end="")
    print(f"within 5 %: {', '.join(f'{int(each)}/{n}' for each in (table <= 5.0).sum(axis=0))} (peak, static, enriched). ", end="")
    print(f"95 % intervals hold the truth in {sum(inside)}/{n}.")


def _peak_Pa(run: Take, span: slice) -> float:
    mean = np.convolve(run.fz_N[span], np.full(10, 0.1), mode="valid")
    at = span.start + int(np.argmax(mean))
    return modulus_peak_Pa(float(mean.max()), -float(run.z_m[at : at + 10].mean()), 0.005, 0.5)


def _held_Pa(run: Take, span: slice) -> float:
    held = slice(span.stop - 2500, span.stop)
    return modulus_peak_Pa(float(run.fz_N[held].mean()), -float(run.z_m[held].mean()), 0.005, 0.5)


if __name__ == "__main__":
    main()
