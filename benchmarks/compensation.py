"""Comparison of the methods of compensation on motion and days that none has seen; writes the table of docs/compensation.md.

python benchmarks/compensation.py [--seed N] [--recordings N] [--presses N] [--only WORDS] [--write]
"""

import argparse
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.stats import bootstrap

from benchmarks.compensation_methods import methods
from benchmarks.marked_text import write_marked
from benchmarks.recurrent_method import Recurrent
from palpd.analysis.intervals import mean_half_width_95
from palpd.analysis.results import PEAK_WINDOW_S
from palpd.cell.cell_file import CellFile, TissueBlock
from palpd.cell.motion_profile import Move, commanded_heights
from palpd.compensation.cycles import SMOOTHING_S
from palpd.recording.samples import runs_of_true
from palpd.study.laboratory import STEP_S, Take, free_cell, setup, take
from palpd.study.methods import (
    SENSOR_DELAY_S,
    ExportedModel,
    LinearModelWithRunningZero,
    Method,
    OnlineSample,
    corrections,
    features,
    stream,
)
from palpd.tick import Floats

DOC = Path(__file__).parents[1] / "docs" / "compensation.md"
HOME_M = 0.03
TRAINED_BIAS_N = 0.19
Effects = dict[str, dict[str, float]]


@dataclass
class Figures:
    """What one method did: errors of free motion per recording, of peaks per recording and press, in N; of moduli likewise; cost in s."""

    same_day: list[float] = field(default_factory=list)
    other_day: list[float] = field(default_factory=list)
    outside: list[float] = field(default_factory=list)
    peak: list[list[float]] = field(default_factory=list)
    modulus: list[list[float]] = field(default_factory=list)
    step_s: float = 0.0


def floor_N(cell: CellFile) -> float:
    """Noise and rounding of one sample."""
    return math.hypot(cell.sensor.noise_rms_N, cell.sensor.resolution_fz_N / math.sqrt(12.0))


def day(rng: np.random.Generator) -> Effects:
    """Another day: what the tare leaves, how the sensor warms up, and its hysteresis, within the data sheet (2 % of 200 N)."""
    return {
        "sensor.bias": {"offset_N": rng.normal(TRAINED_BIAS_N, 0.06)},
        "sensor.warmup": {"amplitude_N": rng.uniform(-0.1, 0.3), "tau_s": rng.uniform(60.0, 600.0)},
        "sensor.hysteresis": {"width_N": 1.0, "amplitude_N": rng.uniform(0.0, 0.03)},
    }


def training_day() -> Effects:
    """The day of the free motion that all methods learned from."""
    return {"sensor.bias": {"offset_N": TRAINED_BIAS_N}, "sensor.warmup": {"amplitude_N": 0.05, "tau_s": 600.0}}


def strokes(rng: np.random.Generator, speed: tuple[float, float], acceleration: tuple[float, float]) -> list[Move]:
    """Free motion of drawn speeds, accelerations and strokes."""
    moves = [Move(HOME_M, 0.02, 1.0)]
    for _ in range(6):
        v, a = rng.uniform(*speed), rng.uniform(*acceleration)
        moves += [Move(HOME_M + rng.uniform(0.005, 0.04), v, 0.3, a), Move(HOME_M, v, 0.3, a)]
    return moves


def presses(rng: np.random.Generator, count: int) -> list[Move]:
    """Presses of one depth, from 8 mm above the surface, at drawn speeds."""
    depth_m = rng.uniform(0.002, 0.006)
    moves = [Move(0.008, 0.02, 1.0)]
    for _ in range(count):
        v, a = rng.uniform(0.005, 0.05), rng.uniform(0.2, 1.0)
        moves += [Move(-depth_m, v, 0.0, a), Move(0.008, v, 0.5, a)]
    return moves


def recordings(cell: CellFile, seed: int, count: int, pressed: int) -> tuple[list[Take], dict[str, list[Take]]]:
    """Free motion to learn from, and recordings for the comparison, in groups; those of contact hold `pressed` presses each."""
    cycle = [Move(HOME_M, 0.02, 0.5), *[Move(HOME_M + stroke, 0.02, 0.3) for _ in range(10) for stroke in (0.02, 0.0)]]
    learned = [take(free_cell(cell, training_day()), commanded_heights(HOME_M, cycle, STEP_S)[0], seed * 1000 + k) for k in range(2)]
    judged: dict[str, list[Take]] = {"same_day": [], "other_day": [], "outside": [], "contact": []}
    for k in range(count):
        rng = np.random.default_rng([seed, k])
        slow, fast = ((0.005, 0.05), (0.2, 0.5)), ((0.05, 0.1), (1.0, 2.0))
        plan = [("same_day", training_day(), slow), ("other_day", day(rng), slow), ("outside", day(rng), fast)]
        for group, effects, drawn in plan:
            judged[group].append(
                take(free_cell(cell, effects), commanded_heights(HOME_M, strokes(rng, *drawn), STEP_S)[0], seed * 1000 + 100 + k)
            )
        tissue = cell.model_copy(update={"tissue": TissueBlock(youngs_modulus_Pa=rng.uniform(5e4, 1.5e5)), "effects": day(rng)})
        judged["contact"].append(take(tissue, commanded_heights(0.008, presses(rng, pressed), STEP_S)[0], seed * 1000 + 500 + k))
    return learned, judged


def compare(method: Method, judged: dict[str, list[Take]]) -> Figures:
    """Run a method over all recordings."""
    figures = Figures()
    for group in ("same_day", "other_day", "outside"):
        getattr(figures, group).extend(_rms(run.fz_N - corrections(method, run)) for run in judged[group])
    for run in judged["contact"]:
        corrected_N = run.fz_N - corrections(method, run)
        pairs = peaks(run, corrected_N)
        figures.peak.append([error_N for error_N, _ in pairs])
        figures.modulus.append([error_N / contact_N for error_N, contact_N in pairs])
    figures.step_s = cost_s(method, list(stream(judged["contact"][0])))
    return figures


def cost_s(method: Method, samples: list[OnlineSample], batch: int = 100, rounds: int = 3) -> float:
    """Of one sample, called one by one: mean over batches, of each the quickest of some rounds, which nothing has interrupted."""
    costs_s = np.full((rounds, -(-len(samples) // batch)), math.inf)
    for of_round in costs_s:
        method.start()
        for number in range(len(of_round)):
            some = samples[number * batch : (number + 1) * batch]
            begin_s = time.perf_counter()
            for sample in some:
                method.step(sample)
            of_round[number] = (time.perf_counter() - begin_s) / len(some)
    return float(costs_s.min(axis=0).mean())


def peaks(run: Take, corrected_N: Floats) -> list[tuple[float, float]]:
    """Error of the contact force at each peak of the reading, and the true force there, means over the window of a peak."""
    width = round(PEAK_WINDOW_S / STEP_S)
    mean = np.convolve(run.fz_N, np.full(width, 1.0 / width), mode="valid")
    touching = run.contact_N[: len(mean)] > 0.1
    pairs = []
    for first, last in zip(*runs_of_true(touching), strict=True):
        at = first + int(np.argmax(mean[first:last]))
        window = slice(at, at + width)
        true_N = float(run.contact_N[window].mean())
        pairs.append((float(corrected_N[window].mean()) - true_N, true_N))
    return pairs


def smoothing_gap_N(exported: ExportedModel, runs: Sequence[Take]) -> float:
    """How far a model's answer from causal features is from that with features smoothed over past and future, rms."""
    gaps = []
    for run in runs:
        width = 2 * round(SMOOTHING_S / STEP_S / 2.0) + 1
        window = np.full(width, 1.0 / width)
        smooth = np.convolve(np.convolve(run.vz_m_per_s, window, mode="same"), window, mode="same")
        both = np.column_stack([smooth, np.gradient(smooth, STEP_S)])
        both = np.column_stack([np.interp(run.t_s - SENSOR_DELAY_S, run.t_s, column) for column in both.T])[width:-width]
        causal = features(run.robot_t_s, run.robot_vz_m_per_s, run.t_s)[width:-width]
        gaps.append(np.mean((np.array(exported.model.predict(causal.tolist())) - exported.model.predict(both.tolist())) ** 2))
    return math.sqrt(float(np.mean(gaps)))


def table(compared: list[tuple[Method, Figures]], floor: float, seed: int, count: int) -> str:
    """Markdown; intervals are 95 % of the mean over recordings."""
    floor_of_peak = floor / math.sqrt(PEAK_WINDOW_S / STEP_S)
    lines = [
        f"Seed {seed}; {count} recordings a column of free motion, {np.size(compared[0][1].peak)} presses. Noise and rounding: "
        f"{floor * 1e3:.0f} mN rms in a sample, {floor_of_peak * 1e3:.0f} mN in a peak of {PEAK_WINDOW_S * 1e3:.0f} ms.",
        "",
        "| method | free motion, same day (mN rms) | other days | other days, faster than trained | peak force, rms error (mN) "
        "| of it beyond noise and rounding | modulus at the peak, rms error (%) | cost (µs a sample) |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for method, figures in compared:
        free = [_interval(np.array(values) * 1e3) for values in (figures.same_day, figures.other_day, figures.outside)]
        peak, modulus = _rms_interval(np.array(figures.peak) * 1e3), _rms(np.array(figures.modulus)) * 100
        beyond = math.sqrt(max(_rms(np.array(figures.peak)) ** 2 - floor_of_peak**2, 0.0)) * 1e3
        lines.append(f"| {method.name} | {' | '.join(free)} | {peak} | {beyond:.0f} | {modulus:.1f} | {figures.step_s * 1e6:.1f} |")
    return "\n".join(lines)


def against_targets(compared: list[tuple[Method, Figures]], floor: float) -> str:
    """The daemon's default in free motion against noise and rounding, and at the peaks against the paper's network."""
    winner = next(figures for method, figures in compared if isinstance(method, LinearModelWithRunningZero))
    network = next(figures for method, figures in compared if method.name.startswith("2-10-1"))
    free = [_mean_interval(np.array(values) / floor) for values in (winner.same_day, winner.other_day, winner.outside)]
    worst, half = max(free)
    floor_of_peak = floor / math.sqrt(PEAK_WINDOW_S / STEP_S)
    ours, theirs = (_by_recording(np.array(figures.peak)) for figures in (winner, network))

    def ratio(ours: Floats, theirs: Floats, axis: int = -1) -> Floats:
        """Of the errors beyond noise and rounding."""
        beyond = (np.mean(squares, axis=axis) - floor_of_peak**2 for squares in (ours, theirs))
        return np.asarray(np.sqrt(np.maximum(next(beyond), 0.0) / next(beyond)))

    low, high = _bootstrap((ours, theirs), ratio)
    return (
        f"m·a + running zero against the targets: in free motion at most {worst:.2f} ± {half:.2f} of noise and rounding (1.2 allowed); "
        f"at the peaks, beyond these, {ratio(ours, theirs):.2f} ({low:.2f} to {high:.2f}) of the paper's network's error (0.5)."
    )


def _interval(values: Floats) -> str:
    mean, half = _mean_interval(values)
    return f"{mean:.0f} ± {half:.0f}"


def _mean_interval(values: Floats) -> tuple[float, float]:
    return float(values.mean()), mean_half_width_95(values)


def _by_recording(errors: Floats) -> Floats:
    """Mean square of each recording's presses."""
    return np.asarray((errors**2).mean(axis=1))


def _rms_interval(errors: Floats) -> str:
    """Bootstrap over recordings."""
    low, high = np.sqrt(_bootstrap((_by_recording(errors),), np.mean))
    return f"{_rms(errors):.0f} ({low:.0f}–{high:.0f})"


def _bootstrap(data: tuple[Floats, ...], statistic: Callable[..., Floats]) -> tuple[float, float]:
    """95 % interval by resampling recordings, the same for all data."""
    drawn = bootstrap(data, statistic, paired=True, n_resamples=2000, method="percentile", rng=np.random.default_rng(0))
    return float(drawn.confidence_interval.low), float(drawn.confidence_interval.high)


def _rms(values: Floats) -> float:
    return math.sqrt(float(np.mean(np.square(values))))


def main() -> None:
    """Measure, print, and write into the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--recordings", type=int, default=16)
    parser.add_argument("--presses", type=int, default=4, help="in each recording of contact")
    parser.add_argument("--only", default="", help="methods whose names contain one of these words, separated by commas")
    parser.add_argument("--write", action="store_true", help="put the table into docs/compensation.md")
    asked = parser.parse_args()
    cell = setup("A")
    learned, judged = recordings(cell, asked.seed, asked.recordings, asked.presses)
    compared = []
    for method in (*methods(), Recurrent(zero=False), Recurrent(zero=True)):
        if not any(word in method.name for word in asked.only.split(",")):
            continue
        method.fit(learned)
        compared.append((method, compare(method, judged)))
    text = table(compared, floor_N(cell), asked.seed, asked.recordings)
    if not asked.only:
        text += f"\n\n{against_targets(compared, floor_N(cell))}"
    gaps = [(method.name, smoothing_gap_N(method, judged["outside"])) for method, _ in compared if isinstance(method, ExportedModel)]
    text += "\n\nError at run time because features may not look ahead (faster motion, mN rms): "
    text += "; ".join(f"{name} {gap * 1e3:.1f}" for name, gap in gaps) + "."
    print(text)
    if asked.write:
        write_marked(DOC, "table", text)


if __name__ == "__main__":
    main()
