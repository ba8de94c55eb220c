"""How exact moduli of plain elastic tissue are, and how often 95 % intervals hold the truth, on emulated cells that are drawn at random.

The daemon palpates each: it tares, finds the surface by contact, holds and presses; it knows nothing of the cell.

python benchmarks/moduli.py [--cells N] [--seed N] [--no-hysteresis]
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from palpd.analysis import results
from palpd.cell.cell_file import CellFile, TissueBlock
from palpd.compensation.train import train
from palpd.config import Config, Plan, filter_delay_s
from palpd.daemon.motion_job import Job
from palpd.daemon.simulated_run import SimulatedRecording, run
from palpd.quantities import wilson
from palpd.recording.reader import Recording, samples_of
from palpd.study.laboratory import CUTOFF_Hz, free_cell, setup
from palpd.tick import Phase

PLAN = Plan(depths_m=(0.004, 0.006, 0.008), mode="both", repeats=1)
HOME_ABOVE_M = 0.012
"""Where a simulated arm begins: a search of 5 mm/s from higher only takes longer."""
FILTERS_Hz = (CUTOFF_Hz, 150.0)


def drawn(rng: np.random.Generator) -> CellFile:
    """Elastic tissue; bias and warm-up after the tare, hysteresis within the data sheet; counts behind a filter of 15 or 150 Hz."""
    cell = setup("A")
    sensor = cell.sensor.model_copy(update={"filter_cutoff_Hz": float(rng.choice(FILTERS_Hz))})
    effects = {
        "sensor.bias": {"offset_N": rng.normal(0.19, 0.06)},
        "sensor.warmup": {"amplitude_N": rng.uniform(-0.1, 0.1), "tau_s": rng.uniform(60.0, 600.0)},
        "sensor.hysteresis": {"width_N": 1.0, "amplitude_N": rng.uniform(0.0, 0.02)},
    }
    tissue = TissueBlock(youngs_modulus_Pa=rng.uniform(4e4, 1.5e5))
    return cell.model_copy(update={"sensor": sensor, "tissue": tissue, "effects": effects})


def trained(folder: Path, cutoff_Hz: float) -> Path:
    """The inertial model for a sensor with that filter, from the daemon's own free motion on a day with 0.19 N of bias."""
    config = Config.model_validate({"sensor": {"filter_cutoff_Hz": cutoff_Hz}})
    done = run(Job("free_motion", config, Plan()), free_cell(setup("A"), {"sensor.bias": {"offset_N": 0.19}}), seed=10_000)
    path = folder / f"{cutoff_Hz:g}.onnx"
    moving = Recording(path, done.rows[done.rows["phase"] == Phase.FREE_MOTION], done.header, {}, None)
    train([samples_of(moving)], path, probe_mass_kg=config.cell.probe.mass_kg, sensor_delay_s=filter_delay_s(cutoff_Hz))
    return path


def palpated(cell: CellFile, model: Path, seed: int) -> SimulatedRecording:
    """One run of the daemon's loop on the cell, the inertial model and its running zero at work."""
    config = Config.model_validate({"sensor": {"filter_cutoff_Hz": cell.sensor.filter_cutoff_Hz}, "model": {"path": model}})
    done = run(Job("palpation", config, PLAN), cell, seed=seed, home_above_m=HOME_ABOVE_M)
    if done.outcome.verdict != "done":
        raise RuntimeError(f"the run of seed {seed} was stopped: {done.outcome.reason}")
    return done


def main() -> None:
    """Print errors and coverage."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--no-hysteresis", action="store_true", help="the same cells, their sensors without it")
    asked = parser.parse_args()
    static, dynamic, loading, surface_m = [], [], [], []
    intervals_Pa: dict[str, list[list[float]]] = {"static holds": [], "dynamic peaks": [], "loading curve": []}
    truths_Pa = []
    with TemporaryDirectory() as folder:
        models = {cutoff_Hz: trained(Path(folder), cutoff_Hz) for cutoff_Hz in FILTERS_Hz}
        for k in range(asked.cells):
            cell = drawn(np.random.default_rng([asked.seed, k]))
            if asked.no_hysteresis:
                cell.effects.pop("sensor.hysteresis")
            assert cell.tissue is not None
            assert cell.sensor.filter_cutoff_Hz is not None
            true_Pa = cell.tissue.youngs_modulus_Pa
            done = palpated(cell, models[cell.sensor.filter_cutoff_Hz], 1000 * asked.seed + k)
            (site,), (curve,) = results.sites(done.rows, done.header), results.analysed(done.rows, done.header)
            by = (site["static_ci95_Pa"], site["dynamic_corrected_ci95_Pa"], curve["ci95_Pa"])
            for kept, interval_Pa in zip(intervals_Pa.values(), by, strict=True):
                kept.append(interval_Pa)
            truths_Pa.append(true_Pa)
            static.append(site["static_youngs_modulus_Pa"] / true_Pa - 1.0)
            dynamic.append(site["dynamic_corrected_Pa"] / true_Pa - 1.0)
            loading.append(curve["youngs_modulus_Pa"] / true_Pa - 1.0)
            surface_m.append(site["surface_z_m"])
    print(f"{asked.cells} cells of 40 to 150 kPa, seed {asked.seed}. Error of the modulus (%):")
    print("| by | mean | rms | largest | within |")
    print("|---|---|---|---|---|")
    rows = (("static holds, equation 1", static, 3), ("dynamic peaks, corrected", dynamic, 6), ("loading curve, Hertz", loading, 3))
    for name, errors, most in rows:
        e = 100.0 * np.array(errors)
        good = (np.abs(e) <= most).tolist()
        print(
            f"| {name} | {e.mean():+.2f} | {np.sqrt(np.mean(e**2)):.2f} | {np.abs(e).max():.2f} "
            f"| {sum(good)} of {len(good)} within {most} % ({_share(good)}) |"
        )
    print("\n| 95 % interval of | median | holds the truth |")
    print("|---|---|---|")
    for name, kept in intervals_Pa.items():
        low_Pa, high_Pa, true = *np.array(kept).T, np.array(truths_Pa)
        covered = ((low_Pa <= true) & (true <= high_Pa)).tolist()
        half = float(np.median((high_Pa - low_Pa) / 2.0 / true))
        print(f"| {name} | ± {100 * half:.2f} % | {sum(covered)} of {len(covered)} ({_share(covered)}) |")
    print()
    um = 1e6 * np.array(surface_m)
    print(f"The surface that the daemon found is {um.mean():+.0f} µm off on the mean, {np.sqrt(np.mean(um**2)):.0f} rms, ", end="")
    together = np.corrcoef(static, um)[0, 1]
    print(f"{np.abs(um).max():.0f} at most; error of a static modulus and of its surface correlate by {together:+.2f}.")


def _share(hits: Sequence[bool]) -> str:
    """95 % interval of a share, in percent."""
    low, high = wilson(sum(hits), len(hits))
    return f"{100 * low:.0f}–{100 * high:.0f} %"


if __name__ == "__main__":
    main()
