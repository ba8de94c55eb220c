"""Cases of the blind check: a drawn cell, the effects planted in it at a wanted signal-to-noise ratio, its recording and its truth.

Nothing here comes from the library that is judged.
"""

from collections.abc import Sequence

import numpy as np

from palpd.blind.detectability import COARSE_HZ, Detectability, FittedLaw, fit_strength, nearest_law, scales_of
from palpd.blind.drawn_cells import (
    TOLERANCES,
    CellRealisation,
    Deviations,
    DrawnMotion,
    draw_cell,
    draw_deviations,
    draw_motion,
    with_coarse_steps,
)
from palpd.blind.laws import FOREIGN_LAWS, LIBRARY_LAWS, NOVEL_LAWS, Floats, Law, Planted, SensorRows, SimulatedRun
from palpd.blind.simulated_run import rows
from palpd.blind.stated_cell import CHANNELS, PHASES, log_uniform, rounded
from palpd.blind.truth import CannotDraw, CaseKind, CaseSpec, NearestLaw, SealedCase, SealedEffect, SecondMotion, TrueChange, Truth
from palpd.recording.samples import Samples

SLOW_ROBOT_HZ = 125.0
"""Rate of a robot that reports slower than its sensor: that of a UR5 of the CB3 series."""
MAX_ROWS = 40_000
"""Longest recording, in rows; a longer one would only make its diagnosis slow."""
STRATA: dict[str, tuple[float, float]] = {"6-10": (6.0, 10.0), "10-20": (10.0, 20.0), "20-60": (20.0, 60.0), "> 60": (60.0, 200.0)}
"""Ranges of the signal-to-noise ratio, from what can just be seen to what nobody can miss."""


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
        run: The noise-free run on the fine grid.
        motion: The commanded motion.
        t_s: Times of the rows in s (m,).
        robot_rate_Hz: Rate of the robot; below the sensor's rate, heights are interpolated.

    Returns:
        The recording, m rows.
    """
    scale = r.uniform(0.85, 1.18, 4)
    t_robot = np.arange(0.0, t_s[-1] + 2.0 / robot_rate_Hz, 1.0 / robot_rate_Hz) if robot_rate_Hz < cell.rate_Hz else t_s
    z = np.interp(t_robot, run.t_s, run.z_m) + scale[0] * cell.position_noise_rms_m * r.standard_normal(len(t_robot))
    v = np.interp(t_robot, run.t_s, run.vz_m_per_s) + scale[1] * cell.velocity_noise_rms_m_per_s * r.standard_normal(len(t_robot))
    wrench = rows(run, t_s)[:, 1:]
    white = r.standard_t(4.0, wrench.shape) / 2.0**0.5 if run.heavy_tails else r.standard_normal(wrench.shape)
    sigma = np.repeat(scale[2:], 3) * cell.noises
    readings = SensorRows(t_s, wrench + run.noise_ratio * sigma * white, r)
    for law, shape in planted:
        if law.stage == "row":
            law.apply(readings, shape)
    wrench = rounded(readings.wrench, cell.steps)
    return Samples(t_s, motion.at(t_s), np.interp(t_s, t_robot, z), np.interp(t_s, t_robot, v), wrench)


def laws_of(kind: CaseKind, effect: str) -> list[Law]:
    """The laws that a kind of case may plant for an effect.

    Args:
        effect: Id of the effect.
    """
    table = {"library": LIBRARY_LAWS, "foreign": FOREIGN_LAWS, "novel": NOVEL_LAWS}.get(kind, LIBRARY_LAWS + FOREIGN_LAWS)
    return [law for law in table if law.effect == effect]


def draw_case(seed: int, spec: CaseSpec) -> SealedCase:
    """Draw a case: cell, deviations, motion, planted effects, recording and truth. The same arguments give the same case.

    Args:
        seed: Seed of the check.
        spec: What the case shall be: two effects for `two`, none for `healthy`; the stratum is a key of STRATA.

    Raises:
        CannotDraw: No cell shows the effects in this stratum.
    """
    for attempt in range(40):
        try:
            return _draw_case(np.random.default_rng([seed, spec.index, attempt]), spec)
        except CannotDraw:
            continue
    raise CannotDraw(f"case {spec.index}: no cell shows {', '.join(spec.effects)} at an SNR of {spec.stratum}")


def plant(r: np.random.Generator, detectability: Detectability, law: Law, snrs: tuple[float, float]) -> FittedLaw:
    """Draw a law's shape and scale it to a drawn signal-to-noise ratio.

    Args:
        snrs: Range of the ratio.

    Raises:
        CannotDraw: This cell does not show the law at that size.
    """
    try:
        shape, snr = law.draw(r, scales_of(detectability)), log_uniform(r, *snrs)
    except ValueError:
        raise CannotDraw(f"{law.effect} has no parameters at the rate and length of this recording") from None
    if law.variance:
        return FittedLaw(law, law.at(shape, log_uniform(r, 1.0, 5.0)), None, None)
    fitted = fit_strength(detectability, law, shape, snr)
    if fitted is None or fitted.snr is None or not snrs[0] <= fitted.snr <= snrs[1] * 1.05:
        raise CannotDraw(law.effect)
    return fitted


def describe(plants: Sequence[FittedLaw], detectability: Detectability) -> list[SealedEffect]:
    """The planted laws as the truth keeps them.

    Args:
        plants: The laws with their sizes.

    Returns:
        One entry a law.
    """
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


def _draw_case(r: np.random.Generator, spec: CaseSpec) -> SealedCase:
    kind, effects = spec.kind, spec.effects
    cell = draw_cell(r)
    if spec.steps_over_noise:
        cell = with_coarse_steps(cell, spec.steps_over_noise)
    motion = draw_motion(r, cell)
    t_s = _row_times(r, cell, motion.duration_s)
    detectability = Detectability(cell, draw_deviations(r, motion), motion, t_s)
    plants: list[FittedLaw] = []
    for effect in effects:
        laws = laws_of(kind, effect)
        plants.append(plant(r, detectability, laws[int(r.integers(len(laws)))], STRATA[spec.stratum]))
    planted: list[Planted] = [(one.law, one.parameters) for one in plants]
    changes = [one.change for one in plants if one.change is not None]
    robot_rate_Hz = SLOW_ROBOT_HZ if cell.rate_Hz > 1.5 * SLOW_ROBOT_HZ and r.random() < 0.2 else cell.rate_Hz
    sizes = detectability.sizes(np.sum(changes, axis=0)) if changes else np.zeros((len(CHANNELS), len(PHASES)))
    without = tuple(effects) if kind == "removed" else ()
    sealed = describe(plants, detectability)
    run = detectability.run(planted)
    true_change: TrueChange | None = None
    if kind == "novel":
        sealed[0]["statement"] = plants[0].law.states(plants[0].parameters, cell.surface_z_m)
        true_change = true_change_of(run, motion.at(t_s), t_s, changes[0]) if changes else None
    mimic: NearestLaw | None = None
    if kind in {"removed", "novel"} and changes and not spec.extra:
        mimic = nearest_listed(detectability, planted, int(r.integers(2**31)), without=without)
    elif kind == "foreign" and changes:
        sealed[0]["nearest"] = nearest_listed(detectability, planted, spec.index, only=effects[0])
    samples = measured(r, cell, run, motion, t_s, planted, robot_rate_Hz)
    second, rms = _second(r, cell, detectability.deviations, planted)
    truth: Truth = {
        "source": "drawn",
        "kind": kind,
        "effects": sealed,
        "host_causes": [],
        "without": list(without),
        "size": float(sizes.max()),
        "sizes": by_place(sizes),
        "rate_Hz": cell.rate_Hz,
        "robot_rate_Hz": robot_rate_Hz,
        "rows": len(t_s),
        "duration_s": float(t_s[-1]),
        "mimic": mimic,
        "second": rms,
        "about": {"deviations": detectability.deviations.of, "presses": motion.presses, "stratum": spec.stratum},
    }
    return SealedCase(cell.as_yaml(), samples, without, second, truth, true_change)


def true_change_of(run: SimulatedRun, z_cmd_m: Floats, t_s: Floats, change: Floats) -> TrueChange:
    """What planted effects change, on the noise-free motion.

    Args:
        z_cmd_m: Commanded heights (m,).
        t_s: Times of the rows (m,).
        change: The change (m, 7).
    """
    z, v = (np.interp(t_s, run.t_s, x) for x in (run.z_m, run.vz_m_per_s))
    return TrueChange(Samples(t_s, z_cmd_m, z, v, np.zeros((len(t_s), 6))), change)


def by_place(sizes: Floats) -> dict[str, dict[str, float]]:
    """Sizes by the names of channel and phase.

    Args:
        sizes: Sizes (7, 5), as in CHANNELS and PHASES.

    Returns:
        The sizes of every phase by channel.
    """
    return {channel: dict(zip(PHASES, sizes[i].tolist(), strict=True)) for i, channel in enumerate(CHANNELS)}


def by_channel(values: Floats) -> dict[str, float]:
    """Values by the names of the channels.

    Args:
        values: Values (7,), as in CHANNELS.
    """
    return dict(zip(CHANNELS, values.tolist(), strict=True))


def _beside(x: Floats, other: Floats) -> float:
    return float(np.linalg.norm(x - other * float(x @ other) / float(other @ other)))


def nearest_listed(
    fine: Detectability, planted: Sequence[Planted], seed: int, *, without: Sequence[str] = (), only: str | None = None
) -> NearestLaw:
    """The listed law nearest to what planted laws change, on a coarse grid.

    Args:
        seed: Seed of the shapes that are tried.
        without: Effects that may not be used.
        only: The one effect that may be used; None: all.
    """
    coarse = Detectability(fine.cell, fine.deviations, fine.motion, fine.t_s, fine_Hz=COARSE_HZ)
    target, like = coarse.whitened(coarse.change(planted)), planted[0][1] if only else None
    return nearest_law(coarse, target, scales_of(fine), seed, without=without, only=only, like=like)


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
    change = detectability.change(planted) if planted else np.zeros((len(t_s), len(CHANNELS)))
    second = Samples(t_s, motion.at(t_s), readings[:, 0], v, np.asarray(readings[:, 1:]))
    return second, second_rms(detectability, change)


def second_rms(detectability: Detectability, change: Floats) -> SecondMotion:
    """What tolerances and effects make on the second motion.

    Args:
        detectability: The cell on that motion, without press scatter.
        change: What the effects change there, row by row (m, 7).

    Returns:
        Rms by channel.
    """
    floor = np.sqrt(sum(np.mean(x**2, axis=0) for x in detectability.tangents[: len(TOLERANCES)]))
    rms = np.sqrt(np.mean(change**2, axis=0))
    return {"floor": by_channel(floor), "change": by_channel(rms), "sigma": by_channel(detectability.cell.sigmas)}
