"""Cases of the blind check: a drawn cell, the effects planted in it at a wanted signal-to-noise ratio, its recording and its truth.

Nothing here comes from the library that is judged.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NotRequired, TypedDict

import numpy as np

from palpd.blind.detectability import Detectability, best_mimic, fit_strength, scales_of
from palpd.blind.drawn_cells import (
    CHANNELS,
    PHASES,
    TOLERANCES,
    CellRealisation,
    Deviations,
    DrawnMotion,
    draw_cell,
    draw_deviations,
    draw_motion,
    log_uniform,
)
from palpd.blind.laws import FOREIGN_LAWS, LIBRARY_LAWS, NOVEL_LAWS, Floats, Law, Planted, SensorRows, Shape, SimulatedRun
from palpd.blind.simulated_run import rows
from palpd.recording.samples import Samples

CaseKind = Literal["healthy", "library", "foreign", "two", "removed", "novel"]
CASE_KINDS: tuple[CaseKind, ...] = ("healthy", "library", "foreign", "two", "removed", "novel")
SLOW_ROBOT_HZ = 125.0
"""Rate of a robot that reports slower than its sensor: that of a UR5 of the CB3 series."""
MAX_ROWS = 40_000
"""Longest recording, in rows; a longer one would only make its diagnosis slow."""
COARSE_HZ = 500.0
"""Grid of the search for the best mimic, which needs thousands of simulations and no more than two digits."""
STRATA: dict[str, tuple[float, float]] = {"6-10": (6.0, 10.0), "10-20": (10.0, 20.0), "20-60": (20.0, 60.0), "> 60": (60.0, 200.0)}
"""Ranges of the signal-to-noise ratio, from what can just be seen to what nobody can miss."""


class CannotDraw(Exception):
    """This cell and motion cannot show the wanted effect at the wanted size; draw again."""


class SealedEffect(TypedDict):
    """One planted effect as the truth keeps it. `snr` is None for effects that change scatter and not the mean."""

    id: str
    law: str
    parameters: Shape
    snr: float | None
    variance: bool
    snr_per_row_sigma: float | None
    snr_beside_the_other: NotRequired[float]


class Mimic(TypedDict):
    """The listed effect that explains a planted one best, and the SNR of the residual that it leaves."""

    id: str
    snr_left: float


class SecondMotion(TypedDict):
    """Rms by channel on another motion: what tolerances leave there, what the effects change, the noise of one row."""

    floor: dict[str, float]
    change: dict[str, float]
    sigma: dict[str, float]


class Truth(TypedDict):
    """The sealed truth of a case, written as JSON. `sizes` is by channel and phase."""

    kind: CaseKind
    effects: list[SealedEffect]
    without: list[str]
    size: float
    sizes: dict[str, dict[str, float]]
    deviations: dict[str, float]
    rate_Hz: float
    robot_rate_Hz: float
    rows: int
    duration_s: float
    presses: int
    mimic: Mimic | None
    second: SecondMotion
    stratum: NotRequired[str]


@dataclass(frozen=True)
class DrawnCase:
    """One case: what the diagnosis may see (`cell`, `samples`, `without`) and what is sealed (`second`, `truth`).

    `cell` holds the keys of cell.yaml. `second` is the true cell on another motion, without noise and rounding.
    """

    kind: CaseKind
    cell: dict[str, Any]
    samples: Samples
    without: tuple[str, ...]
    second: Samples
    truth: Truth


def _row_times(r: np.random.Generator, cell: CellRealisation, duration_s: float) -> Floats:
    """Even steps in most recordings, steps that differ by a tenth in some."""
    n = min(int(duration_s * cell.rate_Hz), MAX_ROWS)
    t = np.arange(n) / cell.rate_Hz
    return t + (r.uniform(0.0, 0.1, n) / cell.rate_Hz if r.random() < 0.1 else 0.0)


def measured(
    r: np.random.Generator,
    cell: CellRealisation,
    run: SimulatedRun,
    motion: DrawnMotion,
    t_s: Floats,
    planted: Sequence[Planted],
    robot_rate_Hz: float,
) -> Samples:
    """Make the recording of a run: robot noise, sensor noise, the laws of the electronics, rounding.

    Args:
        r: Random generator.
        cell: The cell.
        run: The noise-free run on the fine grid.
        motion: The commanded motion.
        t_s: Times of the rows in s (m,).
        planted: Planted laws with their parameters.
        robot_rate_Hz: Rate of the robot; below the sensor's rate, heights are interpolated.

    Returns:
        The recording, m rows.
    """
    scale = r.uniform(0.85, 1.18, 4)
    t_robot = np.arange(0.0, t_s[-1] + 2.0 / robot_rate_Hz, 1.0 / robot_rate_Hz) if robot_rate_Hz < cell.rate_Hz else t_s
    z = np.interp(t_robot, run.t_s, run.z_m) + scale[0] * cell.position_noise_m * r.standard_normal(len(t_robot))
    v = np.interp(t_robot, run.t_s, run.vz_m_per_s) + scale[1] * cell.velocity_noise_m_per_s * r.standard_normal(len(t_robot))
    wrench = rows(run, t_s)[:, 1:]
    white = r.standard_t(4.0, wrench.shape) / 2.0**0.5 if run.heavy_tails else r.standard_normal(wrench.shape)
    sigma = np.array([scale[2] * cell.noise_N] * 3 + [scale[3] * cell.noise_Nm] * 3)
    readings = SensorRows(t_s, wrench + run.noise_ratio * sigma * white, r)
    for law, shape in planted:
        if law.stage == "row":
            law.apply(readings, shape)
    steps = np.array([cell.step_fxy_N, cell.step_fxy_N, cell.step_fz_N, *[cell.step_Nm] * 3])
    wrench = np.round(readings.wrench / steps) * steps
    return Samples(t_s, motion.at(t_s), np.interp(t_s, t_robot, z), np.interp(t_s, t_robot, v), np.asarray(wrench))


def laws_of(kind: CaseKind, effect: str) -> list[Law]:
    """The laws that a kind of case may plant for an effect.

    Args:
        kind: Kind of the case.
        effect: Id of the effect.

    Returns:
        Laws of that effect.
    """
    table = {"library": LIBRARY_LAWS, "foreign": FOREIGN_LAWS, "novel": NOVEL_LAWS}.get(kind, LIBRARY_LAWS + FOREIGN_LAWS)
    return [law for law in table if law.effect == effect]


def draw_case(seed: int, index: int, kind: CaseKind, effects: Sequence[str] = (), stratum: str = "20-60") -> DrawnCase:
    """Draw a case: cell, deviations, motion, planted effects, recording and truth. The same arguments give the same case.

    Args:
        seed: Seed of the check.
        index: Number of the case in the check.
        kind: Kind of the case.
        effects: Ids of the planted effects: two for `two`, none for `healthy`.
        stratum: Range of the signal-to-noise ratio, a key of STRATA.

    Returns:
        The case.

    Raises:
        CannotDraw: No cell shows the effects in this stratum.
    """
    for attempt in range(40):
        try:
            return _draw_case(np.random.default_rng([seed, index, attempt]), kind, effects, STRATA[stratum])
        except CannotDraw:
            continue
    raise CannotDraw(f"case {index}: no cell shows {', '.join(effects)} at an SNR of {stratum}")


@dataclass(frozen=True)
class _Plant:
    """One effect fitted to its size. `change` (m, 7) is None for a law that changes scatter and not the mean."""

    law: Law
    parameters: Shape
    change: Floats | None
    snr: float | None


def _plant(r: np.random.Generator, detectability: Detectability, law: Law, snrs: tuple[float, float]) -> _Plant:
    shape, snr = law.draw(r, scales_of(detectability)), log_uniform(r, *snrs)
    if law.variance:
        return _Plant(law, law.at(shape, log_uniform(r, 1.0, 5.0)), None, None)
    fitted = fit_strength(detectability, law, shape, snr)
    if fitted is None or not snrs[0] <= fitted.snr <= snrs[1] * 1.05:
        raise CannotDraw(law.effect)
    return _Plant(law, fitted.parameters, fitted.change, fitted.snr)


def _described(plants: Sequence[_Plant], detectability: Detectability) -> list[SealedEffect]:
    described: list[SealedEffect] = [
        {
            "id": one.law.effect,
            "law": one.law.name,
            "parameters": one.parameters,
            "snr": one.snr,
            "variance": one.law.variance,
            "snr_per_row_sigma": None if one.snr is None else one.snr / detectability.rows_per_bin**0.5,
        }
        for one in plants
    ]
    changes = [detectability.whitened(one.change) for one in plants if one.change is not None]
    if len(changes) == len(plants) == 2:
        described[0]["snr_beside_the_other"] = _beside(changes[0], changes[1])
        described[1]["snr_beside_the_other"] = _beside(changes[1], changes[0])
    return described


def _draw_case(r: np.random.Generator, kind: CaseKind, effects: Sequence[str], snrs: tuple[float, float]) -> DrawnCase:
    cell = draw_cell(r)
    motion = draw_motion(r, cell)
    t_s = _row_times(r, cell, motion.duration_s)
    detectability = Detectability(cell, draw_deviations(r, motion), motion, t_s)
    plants: list[_Plant] = []
    for effect in effects:
        laws = laws_of(kind, effect)
        plants.append(_plant(r, detectability, laws[int(r.integers(len(laws)))], snrs))
    planted: list[Planted] = [(one.law, one.parameters) for one in plants]
    changes = [one.change for one in plants if one.change is not None]
    robot_rate_Hz = SLOW_ROBOT_HZ if cell.rate_Hz > 1.5 * SLOW_ROBOT_HZ and r.random() < 0.2 else cell.rate_Hz
    sizes = detectability.sizes(np.sum(changes, axis=0)) if changes else np.zeros((len(CHANNELS), len(PHASES)))
    without = tuple(effects) if kind == "removed" else ()
    mimic: Mimic | None = None
    if kind in {"removed", "novel"} and changes:
        mimic = _mimic(detectability, planted, without, int(r.integers(2**31)))
    samples = measured(r, cell, detectability.run(planted), motion, t_s, planted, robot_rate_Hz)
    second, rms = _second(r, cell, detectability.deviations, planted)
    truth: Truth = {
        "kind": kind,
        "effects": _described(plants, detectability),
        "without": list(without),
        "size": float(sizes.max()),
        "sizes": {c: dict(zip(PHASES, sizes[i].tolist(), strict=True)) for i, c in enumerate(CHANNELS)},
        "deviations": detectability.deviations.of,
        "rate_Hz": cell.rate_Hz,
        "robot_rate_Hz": robot_rate_Hz,
        "rows": len(t_s),
        "duration_s": float(t_s[-1]),
        "presses": motion.presses,
        "mimic": mimic,
        "second": rms,
    }
    return DrawnCase(kind, cell.as_yaml(), samples, without, second, truth)


def _beside(x: Floats, other: Floats) -> float:
    return float(np.linalg.norm(x - other * float(x @ other) / float(other @ other)))


def _mimic(detectability: Detectability, planted: Sequence[Planted], without: Sequence[str], seed: int) -> Mimic:
    d = detectability
    coarse = Detectability(d.cell, d.deviations, d.motion, d.t_s, fine_Hz=COARSE_HZ)
    effect, left = best_mimic(coarse, coarse.whitened(coarse.change(planted)), scales_of(d), without, seed)
    return {"id": effect, "snr_left": left}


def _second(
    r: np.random.Generator, cell: CellRealisation, deviations: Deviations, planted: Sequence[Planted]
) -> tuple[Samples, SecondMotion]:
    """The same cell on another motion, noise-free and without press scatter; what its tolerances and its effects make there."""
    motion = draw_motion(r, cell)
    rate = min(cell.rate_Hz, 250.0)
    t_s = np.arange(min(int(motion.duration_s * rate), MAX_ROWS)) / rate
    still = Deviations(deviations.of, np.zeros(motion.presses), np.zeros(motion.presses))
    detectability = Detectability(cell, still, motion, t_s)
    w = detectability.run(planted)
    readings = rows(w, t_s, planted)
    v = np.interp(t_s, w.t_s, w.vz_m_per_s)
    floor = np.sqrt(sum(np.mean(x**2, axis=0) for x in detectability.tangents[: len(TOLERANCES)]))
    change = np.sqrt(np.mean(detectability.change(planted) ** 2, axis=0)) if planted else np.zeros(len(CHANNELS))
    second = Samples(t_s, motion.at(t_s), readings[:, 0], v, np.asarray(readings[:, 1:]))

    def by_channel(values: Floats) -> dict[str, float]:
        return dict(zip(CHANNELS, values.tolist(), strict=True))

    return second, {"floor": by_channel(floor), "change": by_channel(change), "sigma": by_channel(cell.sigmas)}
