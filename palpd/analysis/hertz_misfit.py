"""Whether one modulus describes a site: moduli at several depths against everything but the tissue that can make them differ.

The test is χ² of equal moduli. Their covariance holds the noise of each and the scatter from press to press. It also holds what moves all
of them together: the surface, the weight of the probe and the zero. The scatter is the cell's `repeatability`, or that of the repeats
where these scatter more. So a change below what presses of one tissue show is none, and longer holds or more presses make the test finer.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import TypedDict

import numpy as np
from scipy.special import chdtrc

from palpd.analysis.modulus_intervals import KnownWeight, Measured, PressScatter
from palpd.quantities import kilopascals, quantity
from palpd.tick import Floats

SIGNIFICANCE = 0.01
"""Probability below which equal moduli are given up: of 100 sites that Hertz describes, at most one is called otherwise."""

BANDS = (0.2, 0.4, 0.6, 0.8, 1.0)
"""Edges of the bands of a loading curve, in shares of its depth. Above the first one the contact point hides every law."""

FEWEST_IN_BAND = 3
"""Fewest samples of a band: the mean of fewer is one reading."""


class HertzMisfit(TypedDict):
    """The range of the moduli over depth where they change with it, and that in a sentence."""

    low_Pa: float
    high_Pa: float
    sentence: str


def range_of(misfit: HertzMisfit | None) -> list[tuple[float, float]]:
    """The range of a misfit, for `covering`; empty where Hertz fits."""
    return [] if misfit is None else [(misfit["low_Pa"], misfit["high_Pa"])]


def misfit_over_depth(
    by_depth: Mapping[float, Sequence[Measured]],
    scatter: PressScatter,
    surface_sigma_m: float,
    weight: KnownWeight | None = None,
    zero_sigma_N: float = 0.0,
) -> HertzMisfit | None:
    """Test whether moduli change with depth.

    Args:
        by_depth: The moduli at each depth.
        scatter: What differs from press to press.
        surface_sigma_m: Standard deviation of the height of the surface.
        weight: The weight at the tare; None where no force depends on it.
        zero_sigma_N: Standard deviation of the zero of all forces.

    Returns:
        The range; None where one modulus describes all depths, or there are fewer than two.
    """
    usable = [[press for press in by_depth[depth] if press.is_usable] for depth in sorted(by_depth)]
    groups = [np.array(group, dtype=float) for group in usable if group]
    if len(groups) < 2:
        return None
    modulus_Pa, force_N, depth_m, _ = np.array([group.mean(axis=0) for group in groups]).T
    counts = np.array([len(group) for group in groups])
    noise = np.array([np.sqrt(np.mean(group[:, 3] ** 2)) for group in groups]) / force_N
    by_surface, by_force = 1.5 / depth_m, 1.0 / force_N
    expected = noise**2 + scatter.stiffness**2 + (by_surface * scatter.surface_m) ** 2
    repeats = sum(float(np.sum((group[:, 0] / group[:, 0].mean() - 1.0) ** 2)) for group in groups)
    seen = repeats / max(int(np.sum(counts - 1)), 1)
    covariance = np.diag(np.maximum(expected, seen) / counts)
    shared = [by_surface * surface_sigma_m, by_force * zero_sigma_N]
    shared += [] if weight is None else [by_force * weight.shift_N(force_N)]
    for column in shared:
        covariance += np.outer(column, column)
    relative = modulus_Pa / modulus_Pa.mean()
    by_covariance = np.linalg.solve(covariance, np.column_stack([np.ones_like(relative), relative]))
    mean = float(np.sum(by_covariance[:, 1]) / np.sum(by_covariance[:, 0]))
    chi_square = float((relative - mean) @ (by_covariance[:, 1] - mean * by_covariance[:, 0]))
    probability = float(chdtrc(len(groups) - 1, max(chi_square, 0.0)))
    if probability >= SIGNIFICANCE:
        return None
    lowest, highest = (
        f"{quantity(float(modulus_Pa[k]), 'Pa')} at {depth_m[k] * 1e3:.2g} mm" for k in (np.argmin(modulus_Pa), np.argmax(modulus_Pa))
    )
    return {
        "low_Pa": float(modulus_Pa.min()),
        "high_Pa": float(modulus_Pa.max()),
        "sentence": (
            f"Hertz does not fit: E changes with depth, from {lowest} to {highest} (p {_level(probability)} for one modulus). One modulus "
            "does not describe this sample (inclusion, layer, relaxation, tip shape), so compare at equal depth"
        ),
    }


def _level(probability: float) -> str:
    return "< 1e-6" if probability < 1e-6 else f"= {probability:.1g}"


def span_Pa(by_depth: Mapping[float, Sequence[Measured]]) -> tuple[float, float]:
    """Smallest and largest mean modulus of a depth; there is at least one."""
    means = [float(np.mean([press.modulus_Pa for press in group])) for group in by_depth.values() if group]
    return min(means), max(means)


def misfit_of_curve(
    depth_m: Floats, force_N: Floats, residual_N: Floats, stiffness_Pa: float, contact_sigma_m: float
) -> HertzMisfit | None:
    """Test whether the moduli along one loading curve change with depth.

    Args:
        depth_m: Indentations (n,).
        force_N: Forces (n,) above the baseline.
        residual_N: What Hertz leaves of them (n,).
        stiffness_Pa: Modulus for 1 N at 1 m.
        contact_sigma_m: Standard deviation of the contact point.

    Returns:
        The range; None where one modulus describes the curve.
    """
    noise_N = float(np.sqrt(np.mean(np.diff(residual_N, 2) ** 2) / 6.0))  # white noise has 6 variances in its second differences
    deepest_m = float(depth_m.max())
    by_depth: dict[float, list[Measured]] = {}
    for low, high in pairwise(BANDS):
        band = (depth_m > low * deepest_m) & (depth_m <= high * deepest_m)
        if int(band.sum()) < FEWEST_IN_BAND:
            continue
        modulus_Pa = stiffness_Pa * float(np.sum(force_N[band]) / np.sum(depth_m[band] ** 1.5))
        sigma_N = noise_N / float(np.sqrt(band.sum()))
        by_depth[high] = [Measured(modulus_Pa, float(force_N[band].mean()), float(depth_m[band].mean()), sigma_N)]
    return misfit_over_depth(by_depth, PressScatter(), contact_sigma_m)


def covering(ci95_Pa: Sequence[float], *ranges_Pa: Sequence[float]) -> list[float]:
    """An interval that covers ranges too.

    Args:
        ci95_Pa: The interval, low and high.
        ranges_Pa: The ranges, low and high each.

    Returns:
        Low and high.
    """
    return [min(low for low, _ in (ci95_Pa, *ranges_Pa)), max(high for _, high in (ci95_Pa, *ranges_Pa))]


STAR_MEANS = "* Hertz does not fit: E changes with depth"
"""What the star beside a modulus in a table means."""


def starred(text: str, misfit: object) -> str:
    """A modulus as a table shows it: with a star where Hertz does not fit.

    Args:
        misfit: The misfit, or whether there is one.

    Returns:
        The text of the cell.
    """
    return f"{text} *" if misfit else text


def star_note(misfits: Mapping[str, HertzMisfit | None]) -> str:
    """What the stars of a table mean, with the range over depth of each site; empty where Hertz fits all.

    Args:
        misfits: The misfit of each site; None where none shows.
    """
    ranges = [f"{site} {kilopascals(m['low_Pa'])} to {kilopascals(m['high_Pa'])} kPa" for site, m in misfits.items() if m is not None]
    return f"{STAR_MEANS} ({', '.join(ranges)})" if ranges else ""
