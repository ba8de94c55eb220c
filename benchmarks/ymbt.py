"""The parts of the YMBT of the study's emulated cell, and a comparison of compensations on days with a larger scatter of bias.

python benchmarks/ymbt.py [--days N]
"""

import argparse
from collections.abc import Callable, Iterable

import numpy as np

from palpd.analysis.intervals import mean_half_width_95
from palpd.cell.cell_file import CellFile, RobotBlock
from palpd.study.evaluation import BIAS_N, LINE, NETWORK, NONE, TRUTH, WINNER, Data, evaluate, fitted, free_motion, palpated
from palpd.study.methods import Method, NoCorrection
from palpd.study.published import SETUPS

Change = Callable[[CellFile], CellFile]
DAYS_OF_PARTS = 5
SPREADS_N = (0.0, 0.03, 0.06)
"""Of a day's bias, one sigma; the study has the second, docs/compensation.md the third and a larger warm-up besides."""


def without(*effects: str) -> Change:
    """The cell less these effects."""
    return lambda cell: cell.model_copy(update={"effects": {name: p for name, p in cell.effects.items() if name not in effects}})


def exact(cell: CellFile) -> CellFile:
    """No noise, no rounding, no filter, and a robot that says where it is."""
    ideal = {"noise_rms_N": 1e-9, "resolution_fz_N": 0.0, "filter_cutoff_Hz": None}
    robot = RobotBlock(position_noise_rms_m=0.0, velocity_noise_rms_m_per_s=0.0)
    return cell.model_copy(update={"sensor": cell.sensor.model_copy(update=ideal), "robot": robot})


def weightless(cell: CellFile) -> CellFile:
    """A probe without mass."""
    return cell.model_copy(update={"probe": cell.probe.model_copy(update={"mass_kg": 0.0})})


def true_zero(cell: CellFile) -> CellFile:
    """The surface where the depth is counted from."""
    assert cell.tissue is not None
    return cell.model_copy(update={"tissue": cell.tissue.model_copy(update={"surface_z_m": 0.0})})


PARTS: tuple[tuple[str, Change], ...] = (
    ("bias and warm-up after the tare", without("sensor.bias", "sensor.warmup")),
    ("the sensor's noise, rounding and filter", exact),
    ("the sensor's hysteresis", without("sensor.hysteresis")),
    ("inertia of the probe", weightless),
    ("rate dependence of the tissue", without("tissue.viscoelastic")),
    ("zero of depth, 0.5 mm off in A", true_zero),
    ("one depth against the mean over 3 to 10 mm", without("tissue.inclusion")),
)
"""What is taken out of the cell one after the other."""


def moduli_over_static(days: Iterable[int], methods: dict[str, Method], changed: Callable[[int], Change]) -> dict[str, np.ndarray]:
    """By method (days, setups): dynamic over static modulus less one, with its sign; `changed(day)` changes the cells of a day."""
    excess: dict[str, list[list[float]]] = {}
    for day in days:
        judged = evaluate(Data([], [], palpated(day, changed=changed(day)), simulated=True), methods)
        for name in (*methods, TRUTH):
            excess.setdefault(name, []).append([each.modulus_Pa[name] / each.static_Pa - 1.0 for each in judged])
    return {name: np.array(rows) for name, rows in excess.items()}


def parts(days: Iterable[int]) -> None:
    """Print what each part adds to the uncorrected dynamic modulus, in points of the static one."""
    print(f"| points of YMBT, uncorrected | {' | '.join(SETUPS)} | mean |")
    print("|---|" + "---|" * (len(SETUPS) + 1))

    def read(change: Change) -> np.ndarray:
        methods: dict[str, Method] = {NONE: NoCorrection()}
        return 100.0 * moduli_over_static(days, methods, lambda _: change)[NONE].mean(axis=0)

    change: Change = without()
    before = read(change)
    _row("as read", before)
    for name, further in PARTS:
        change = _both(change, further)
        after = read(change)
        _row(name, before - after)
        before = after
    _row("residual", before)


def _both(first: Change, then: Change) -> Change:
    return lambda cell: then(first(cell))


def _row(name: str, points: np.ndarray) -> None:
    print(f"| {name} | {' | '.join(f'{each:+.1f}' for each in points)} | {points.mean():+.1f} |", flush=True)


def spreads(days: Iterable[int], methods: dict[str, Method]) -> None:
    """Print YMBT and its error against the true contact force by method, for days that differ by more and more."""
    names = (NETWORK, LINE, WINNER)
    print(f"\n| bias from day to day, one sigma | {' | '.join(f'{name}: YMBT, % | off, points rms' for name in names)} |")
    print("|---|" + "---|" * 2 * len(names))
    for sigma_N in SPREADS_N:

        def on_a_day(day: int, sigma_N: float = sigma_N) -> Change:
            rng = np.random.default_rng([day, 9])

            def changed(cell: CellFile) -> CellFile:
                if "sensor.bias" not in cell.effects:
                    return cell
                return cell.model_copy(update={"effects": cell.effects | {"sensor.bias": {"offset_N": rng.normal(BIAS_N, sigma_N)}}})

            return changed

        excess = moduli_over_static(days, methods, on_a_day)
        cells = []
        for name in names:
            by_day = 100.0 * np.abs(excess[name]).mean(axis=1)
            half = mean_half_width_95(by_day)
            off = 100.0 * float(np.sqrt(np.mean((np.abs(excess[name]) - np.abs(excess[TRUTH])) ** 2)))
            cells.append(f"{by_day.mean():.1f} ± {half:.1f} | {off:.1f}")
        print(f"| {1e3 * sigma_N:.0f} mN | {' | '.join(cells)} |", flush=True)


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--days", type=int, default=20)
    days = range(1, parser.parse_args().days + 1)
    print(f"{len(days[:DAYS_OF_PARTS])} days of four setups.\n")
    parts(days[:DAYS_OF_PARTS])
    print(f"\n{len(days)} days of four setups; the methods learned from the free motion of the study, seed 0.")
    spreads(days, fitted(free_motion(0)))


if __name__ == "__main__":
    main()
