"""The diagnosis of the published numbers of Guo, Xiao, Ren 2019, each with its uncertainty.

Tables 1 to 3 are in palpd/data/paper (CC BY). Nothing here is simulated. Intervals are 95 %.
"""

import csv
import math
from dataclasses import asdict, dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import f as fisher

from palpd.analysis.intervals import mean_half_width_95, student_t_95
from palpd.analysis.young import modulus_peak_Pa
from palpd.tick import Floats

SETUPS = {"A": "none", "B": "inclusion_5mm", "C": "inclusion_8mm", "D": "inclusion_10mm"}
"""The paper's setups and how its tables call them."""
TIP_RADIUS_M, POISSON_RATIO, PROBE_KG = 0.005, 0.5, 0.2
MEAN_FREE_N = {"without the probe": 0.0874, "with the probe": 0.1929}
"""Mean force of free motion. Published with a minus: the paper counts compression as negative, palpd as positive."""
STROKE_M, STROKE_S = 0.02, 4.0
"""2 cm up and down ten times in about 80 s."""


@dataclass(frozen=True, slots=True)
class Value:
    """A number with its 95 % interval."""

    value: float
    low: float
    high: float

    def text(self, scale: float = 1.0, digits: int = 2) -> str:
        """The number and its interval in print.

        Args:
            scale: Factor from SI to the printed unit.
            digits: Digits after the point.

        Returns:
            For example `0.19 (0.15 to 0.23)`.
        """
        return f"{self.value * scale:.{digits}f} ({self.low * scale:.{digits}f} to {self.high * scale:.{digits}f})"


@dataclass(frozen=True, slots=True)
class Averages:
    """A row of Tables 2 and 3."""

    original_Pa: float
    corrected_Pa: float
    static_Pa: float
    ymbt_original: float
    ymbt_corrected: float


def _rows(name: str) -> list[dict[str, str]]:
    with files("palpd.study").joinpath("paper", name).open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


@cache
def static(setup: str) -> tuple[Floats, Floats, Floats]:
    """Table 1 of a setup: depths in m, forces in N and published moduli in Pa, each (8,)."""
    rows = [row for row in _rows("table1_static.csv") if row["setup"] == SETUPS[setup]]
    depth_m, force_N, modulus_Pa = (
        np.array([float(row[name]) for row in rows]) for name in ("depth_m", "force_N", "published_youngs_modulus_Pa")
    )
    return depth_m, force_N, modulus_Pa


@cache
def averages(setup: str) -> Averages:
    """Tables 2 and 3 of a setup; YMBT as a ratio."""
    two = next(row for row in _rows("table2_average_modulus.csv") if row["setup"] == SETUPS[setup])
    three = next(row for row in _rows("table3_bias.csv") if row["setup"] == SETUPS[setup])
    return Averages(
        float(two["original_Pa"]),
        float(two["corrected_Pa"]),
        float(two["static_Pa"]),
        float(three["ymbt_original_static_percent"]) / 100.0,
        float(three["ymbt_corrected_static_percent"]) / 100.0,
    )


def achieved_depths_m(setup: str) -> Floats:
    """The depths (8,) at which equation 1 turns Table 1's printed forces into its printed moduli."""
    _, force_N, modulus_Pa = static(setup)
    unit_Pa = modulus_peak_Pa(1.0, 1.0, TIP_RADIUS_M, POISSON_RATIO)
    return np.asarray((unit_Pa * force_N / modulus_Pa) ** (2.0 / 3.0))


def table_1_misses() -> tuple[Floats, Floats]:
    """Table 1 recomputed: relative miss of the moduli (32,) from forces and nominal depths, and from depths to the next 10 µm (32,)."""
    nominal: list[float] = []
    achieved: list[float] = []
    for setup in SETUPS:
        depth_m, force_N, modulus_Pa = static(setup)
        rounded_m = np.round(achieved_depths_m(setup), 5)
        for which, at_m in ((nominal, depth_m), (achieved, rounded_m)):
            moduli_Pa = [modulus_peak_Pa(f, d, TIP_RADIUS_M, POISSON_RATIO) for f, d in zip(force_N, at_m, strict=True)]
            which.extend(np.array(moduli_Pa) / modulus_Pa - 1.0)
    return np.array(nominal), np.array(achieved)


def count_N() -> tuple[Value, float]:
    """The largest step that divides all 32 forces of Table 1, and the rms distance from its multiples in N.

    Forces printed to 0.01 N are 2.9 mN rms from what they were; forces that are no multiples of a step q would be q/√12 away. The
    interval is where that rms stays within what printing explains.
    """
    force_N = np.concatenate([static(setup)[1] for setup in SETUPS])
    steps_N = np.arange(0.10, 0.16, 1e-5)
    away_N = force_N[:, None] - np.round(force_N[:, None] / steps_N) * steps_N
    rms_N = np.sqrt(np.mean(away_N**2, axis=0))
    good = steps_N[np.max(np.abs(away_N), axis=0) <= 0.005 + 1e-9]
    best = int(np.argmin(rms_N))
    low, high = (float(good.min()), float(good.max())) if len(good) else (float(steps_N[best]),) * 2
    return Value(float(steps_N[best]), low, high), float(rms_N[best])


def correction_Pa() -> Value:
    """Mean over the four setups of the modulus that the correction took away."""
    return _mean(np.array([averages(setup).original_Pa - averages(setup).corrected_Pa for setup in SETUPS]))


def depth_of_peaks_m() -> Value:
    """Depth at which the published mean force of free motion, taken away as it is, makes that correction.

    The correction of a modulus by a force is 3(1+ν)/(8 √r d^1.5) times the force, so d = (…·f/ΔE)^(2/3).
    """
    taken = correction_Pa()
    depths = [
        (modulus_peak_Pa(MEAN_FREE_N["with the probe"], 1.0, TIP_RADIUS_M, POISSON_RATIO) / each) ** (2.0 / 3.0)
        for each in (taken.value, taken.high, taken.low)
    ]
    return Value(depths[0], depths[1], depths[2])


def exponent(setup: str) -> Value:
    """Exponent n of f ∝ d^n in Table 1, by regression of the logarithms; Hertz has 1.5."""
    depth_m, force_N, _ = static(setup)
    x, y = np.log(depth_m), np.log(force_N)
    slope, offset = np.polyfit(x, y, 1)
    residual = y - slope * x - offset
    half = student_t_95(len(x) - 2) * math.sqrt(float(np.sum(residual**2)) / (len(x) - 2) / float(np.sum((x - x.mean()) ** 2)))
    return Value(float(slope), float(slope) - half, float(slope) + half)


def surface_offset_m(setup: str) -> Value:
    """How far above the paper's zero of depth Hertz would have the surface, by least squares of relative errors of Table 1."""
    depth_m, force_N, _ = static(setup)

    def misses(p: Floats) -> Floats:
        return np.asarray(np.exp(p[0]) * np.maximum(depth_m * 1e3 + p[1], 1e-9) ** 1.5 / force_N - 1.0)

    fit = least_squares(misses, [math.log(force_N[0] / 5.2), 0.0])
    slopes = np.asarray(fit.jac, dtype=float)
    covariance = np.linalg.inv(slopes.T @ slopes) * 2.0 * fit.cost / (len(depth_m) - 2)
    half = student_t_95(len(depth_m) - 2) * math.sqrt(float(covariance[1, 1]))
    return Value(float(fit.x[1]) * 1e-3, (float(fit.x[1]) - half) * 1e-3, (float(fit.x[1]) + half) * 1e-3)


def rate_excess(setup: str) -> Value:
    """Corrected dynamic modulus over the static one *at the same depth*, less one.

    Table 3 compares peaks at one depth with a static mean over 3 to 10 mm. Here the static modulus is that of the power law through
    Table 1 at the depth of the peaks; the interval holds that line's scatter and the depth's.
    """
    line = _static_line(setup)
    half = student_t_95(6) * math.hypot(line.sigma, line.of_depth)
    ratio = averages(setup).corrected_Pa / line.modulus_Pa
    return Value(ratio - 1.0, ratio * math.exp(-half) - 1.0, ratio * math.exp(half) - 1.0)


@dataclass(frozen=True, slots=True)
class _StaticLine:
    """Power law through Table 1 of a setup at the depth of the peaks.

    Force and modulus; and two standard deviations of the modulus' logarithm: from the line's scatter (6 degrees of freedom), and from
    the depth's, which all setups share.
    """

    force_N: float
    modulus_Pa: float
    sigma: float
    of_depth: float


def _static_line(setup: str) -> _StaticLine:
    depth_m, force_N, _ = static(setup)
    x, y = np.log(depth_m), np.log(force_N)
    slope, offset = np.polyfit(x, y, 1)
    residual = y - slope * x - offset
    scatter = float(np.sum(residual**2)) / (len(x) - 2)
    depth = depth_of_peaks_m()
    at = math.log(depth.value)
    of_line = scatter * (1.0 / len(x) + (at - float(x.mean())) ** 2 / float(np.sum((x - x.mean()) ** 2)))
    of_depth = (float(slope) - 1.5) * math.log(depth.high / depth.low) / 2.0 / student_t_95(3)
    there_N = math.exp(slope * at + offset)
    return _StaticLine(there_N, modulus_peak_Pa(there_N, depth.value, TIP_RADIUS_M, POISSON_RATIO), math.sqrt(of_line), of_depth)


@dataclass(frozen=True, slots=True)
class Explanation:
    """A family of effects that one peak depth cannot tell apart, as the cause of the gap of all four setups by one number.

    `value` in `unit` (95 %), `misfit` the squared residual in sigmas with `freedom` degrees of freedom, `p` how often a true explanation
    would fit as badly; `needs` what each setup by itself would take.
    """

    what: str
    effects: tuple[str, ...]
    unit: str
    value: Value | None
    misfit: float
    freedom: int
    p: float
    needs: dict[str, float]


FORCE = ("sensor.bias", "sensor.warmup", "sensor.drift", "cable.friction")
SHARE = ("sensor.gain", "tissue.modulus", "tissue.viscoelastic", "tissue.preconditioning", "tissue.surface", "robot.compliance")


def explanations() -> list[Explanation]:
    """Explanations of a dynamic modulus of Table 2 that exceeds the static one at the same depth.

    They are nothing, one force in all setups, or one share of the contact force in all. Weighted least squares on the logarithms of the
    four ratios; the depth's error is common to all.
    """
    lines = {setup: _static_line(setup) for setup in SETUPS}
    ratio = np.array([averages(s).corrected_Pa / lines[s].modulus_Pa for s in SETUPS])
    force_N = np.array([lines[s].force_N for s in SETUPS])
    of_depth = np.array([lines[s].of_depth for s in SETUPS])
    factor = np.linalg.cholesky(np.diag([lines[s].sigma ** 2 for s in SETUPS]) + np.outer(of_depth, of_depth))

    def misses(predicted: Floats) -> Floats:
        return np.asarray(np.linalg.solve(factor, np.log(ratio) - predicted))

    def of_force(p: Floats) -> Floats:
        return misses(np.log1p(p[0] / force_N))

    def of_share(p: Floats) -> Floats:
        return misses(np.full(4, math.log1p(p[0])))

    nothing = float(np.sum(misses(np.zeros(4)) ** 2))
    force, share = least_squares(of_force, [0.1]), least_squares(of_share, [0.1])
    needs_N = dict(zip(SETUPS, ((ratio - 1.0) * force_N).tolist(), strict=True))
    needs = dict(zip(SETUPS, (ratio - 1.0).tolist(), strict=True))
    return [
        Explanation("nothing", (), "", None, nothing, 4, _chance(nothing, 4), {}),
        _explained("one force", FORCE, "N", force, needs_N),
        _explained("one share of the contact force", SHARE, "1", share, needs),
    ]


def _explained(what: str, effects: tuple[str, ...], unit: str, fit: Any, needs: dict[str, float]) -> Explanation:
    misfit, value = 2.0 * float(fit.cost), float(fit.x[0])
    half = 1.96 / float(np.linalg.norm(fit.jac)) * max(1.0, math.sqrt(misfit / 3.0))
    return Explanation(what, effects, unit, Value(value, value - half, value + half), misfit, 3, _chance(misfit, 3), needs)


def _chance(misfit: float, freedom: int) -> float:
    """How often noise alone is as large: F, since the sigmas themselves come from four lines of 6 degrees of freedom each."""
    return float(fisher.sf(misfit / freedom, freedom, 24))


def deeper_m() -> dict[str, float]:
    """How much deeper than the static presses the dynamic peaks would have to be, by Hertz, for the whole gap of each setup."""
    return {s: depth_of_peaks_m().value * ((1.0 + rate_excess(s).value) ** (2.0 / 3.0) - 1.0) for s in SETUPS}


def alike_N() -> tuple[float, Value]:
    """Setups B and D press with nearly the same force at that depth, and their gaps differ.

    Returns the difference of their static forces in N, and the difference of the logarithms of their gaps. Neither one force nor one
    share can make that difference.
    """
    b, d = _static_line("B"), _static_line("D")
    difference = math.log((1.0 + rate_excess("B").value) / (1.0 + rate_excess("D").value))
    half = student_t_95(12) * math.hypot(math.hypot(b.sigma, d.sigma), b.of_depth - d.of_depth)
    return b.force_N - d.force_N, Value(difference, difference - half, difference + half)


def published() -> dict[str, Any]:
    """The diagnosis of the published gap as plain data."""
    return {
        "schema": "palpd.study.published/1",
        "gap": {s: [v.value, v.low, v.high] for s, v in ((s, rate_excess(s)) for s in SETUPS)},
        "explanations": [asdict(e) for e in explanations()],
        "deeper_m": deeper_m(),
        "verdict": "ambiguous" if max(e.p for e in explanations()[1:]) > 0.05 else "unknown",
        "sentence": published_sentence(),
    }


def published_sentence() -> str:
    """The verdict on the published numbers, in words."""
    nothing, force, share = explanations()
    odds = ((1.0 + share.misfit / 24.0) / (1.0 + force.misfit / 24.0)) ** 14.0  # as of Student's t, the sigmas being estimated
    assert force.value is not None
    assert share.value is not None
    away_N, differ = alike_N()
    return (
        f"There is a gap of one sign (no gap: misfit {nothing.misfit:.0f} with {nothing.freedom} degrees of freedom). "
        f"One force in all setups, {force.value.text()} N, leaves {force.misfit:.1f} with 3 (p = {force.p:.2g}); one share of "
        f"the contact, {share.value.text(100.0, 0)} %, leaves {share.misfit:.1f} (p = {share.p:.1g}): the force is {odds:.0f} times as "
        f"likely, and neither suffices. B and D press with forces that differ by {away_N:.2f} N, and their "
        f"ratios by a factor of {math.exp(differ.value):.2f} ({math.exp(differ.low):.2f} to {math.exp(differ.high):.2f}). "
        "So something differs from setup to setup: how the tissue depends on rate, or where its surface was taken to be. "
        "Peaks at one depth and one speed cannot say which."
    )


def largest_inertia_N() -> float:
    """Inertia of the probe at the ends of a sinusoidal stroke of the paper's length and time, m A ω²: the most that motion asks for."""
    return PROBE_KG * STROKE_M / 2.0 * (math.pi / STROKE_S) ** 2


def _mean(values: Floats) -> Value:
    half = mean_half_width_95(values)
    return Value(float(values.mean()), float(values.mean()) - half, float(values.mean()) + half)
