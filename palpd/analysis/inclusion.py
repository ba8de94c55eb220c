"""Detection of a hard inclusion below a place, its depth and contrast, from how the tissue stiffens with depth.

It takes holds at several depths, in which rate dependence has died away. The law is that of the emulated cell: Hertz times
1 + c·x²/(1+x²), with x = depth of the press over depth of the inclusion. The stiffness itself is free, because tissues differ. The
height of the surface is free within its uncertainty, which stiffens or softens the first millimetres. All is summed over a grid: no
start value, no iteration, the same answer every time.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from palpd.errors import RecordingError
from palpd.tick import Floats

DEPTHS_M = (0.005, 0.008, 0.010)
"""Classes of depth that are compared: those of the paper's phantom."""
CONTRASTS = np.geomspace(0.2, 6.0, 32)
"""How much stiffer a deep press gets, equally likely by ratio."""
PRIOR = 0.5
"""Probability of an inclusion before anything is pressed; half, so that the presses decide."""
SURFACES = np.linspace(-2.5, 2.5, 41)
"""Surface errors that are summed over, in sigmas; 2.5 holds 99 %."""
FEWEST_HOLDS = 4
"""Stiffness, contrast and depth need three holds; a fourth tests them."""
SURFACE_SIGMA_M = 5e-5
"""One sigma of the surface that the approach measured."""
PRESS_SIGMA_M, STIFFNESS_SIGMA = 2e-5, 0.01
"""One sigma from press to press of the height of contact, and of the stiffness (relative); the defaults of a cell file."""
FORCE_SIGMA_N = 0.02
"""One sigma of a hold's mean less the rest before it: rounding that noise dithers only in part, and hysteresis."""


@dataclass(frozen=True, slots=True)
class Inclusion:
    """Evidence of an inclusion in the holds of one site.

    Attributes:
        probability: Probability that there is an inclusion.
        depth_probability: Probability by class of depth (m), given that there is one.
        contrast: Median of the contrast, given that there is one.
        contrast_ci95: Its 95 % interval.
        warnings: Reasons why the presses cannot decide.
    """

    probability: float
    depth_probability: dict[float, float]
    contrast: float
    contrast_ci95: tuple[float, float]
    warnings: tuple[str, ...] = ()

    @property
    def depth_m(self) -> float:
        """The likeliest class of depth."""
        return max(self.depth_probability, key=lambda depth_m: self.depth_probability[depth_m])


def stiffening(depth_m: Floats, inclusion_m: float, contrast: Floats | float) -> Floats:
    """Stiffness above an inclusion, relative to plain tissue.

    Args:
        depth_m: Depths (...,) of presses in m.
        inclusion_m: Depth of the inclusion.
        contrast: How much stiffer a deep press gets, one number or (...,).

    Returns:
        Factors (...,) on the force.
    """
    x2 = (depth_m / inclusion_m) ** 2
    return np.asarray(1.0 + contrast * x2 / (1.0 + x2))


def find_inclusion(
    depth_m: Sequence[float],
    force_N: Sequence[float],
    *,
    surface_sigma_m: float = SURFACE_SIGMA_M,
    force_sigma_N: float = FORCE_SIGMA_N,
) -> Inclusion:
    """Compare plain tissue with an inclusion in each class of depth on the holds of one site.

    Errors of the logarithm of a force: press to press, hold, and surface (common to all).

    Args:
        depth_m: Depths (n,) of the holds below the surface, in m.
        force_N: Forces (n,) of the holds, in N.
        surface_sigma_m: One sigma of the height of the surface.

    Returns:
        Probability, depth and contrast of an inclusion.

    Raises:
        RecordingError: Too few holds, or holds without contact.
    """
    d, f = np.asarray(depth_m, dtype=float), np.asarray(force_N, dtype=float)
    if len(d) != len(f) or len(d) < FEWEST_HOLDS or not (d > 0.0).all() or not (f > 0.0).all():
        raise RecordingError(
            f"{len(d)} holds were given, {int(np.sum(f > 0))} of them with a force; an inclusion needs {FEWEST_HOLDS} or more at "
            "different depths, all in contact"
        )
    variance = STIFFNESS_SIGMA**2 + (1.5 * PRESS_SIGMA_M / d) ** 2 + (force_sigma_N / f) ** 2
    shift_m = np.maximum(SURFACES * surface_sigma_m, -0.5 * float(d.min()))
    weight_of_shift = np.exp(-0.5 * SURFACES**2) / np.sum(np.exp(-0.5 * SURFACES**2))
    true_m = d + shift_m[:, None]

    def evidence(factor: Floats) -> Floats:
        """Likelihood (...,) of holds that are `factor` (..., shifts, n) stiffer than Hertz, the stiffness itself integrated out."""
        log_stiffness = np.log(f) - 1.5 * np.log(true_m) - np.log(factor)
        weights = 1.0 / variance
        mean = np.sum(log_stiffness * weights, axis=-1, keepdims=True) / weights.sum()
        return np.asarray(np.sum(np.exp(-0.5 * np.sum((log_stiffness - mean) ** 2 * weights, axis=-1)) * weight_of_shift, axis=-1))

    plain = float(evidence(np.ones((1, *true_m.shape)))[0])
    by_class = {D: evidence(stiffening(true_m, D, CONTRASTS[:, None, None])) for D in DEPTHS_M}
    total = float(np.mean([values.mean() for values in by_class.values()]))
    warnings = []
    if plain + total <= 0.0:
        nothing = dict.fromkeys(DEPTHS_M, 0.0)
        return Inclusion(0.5, nothing, math.nan, (math.nan, math.nan), ("neither plain tissue nor an inclusion fits these holds",))
    probability = PRIOR * total / (PRIOR * total + (1.0 - PRIOR) * plain)
    if total > 0.0:
        shares = {D: float(values.sum()) for D, values in by_class.items()}
        summed = np.sum(list(by_class.values()), axis=0)
    else:
        shares, summed = dict.fromkeys(DEPTHS_M, 1.0), np.ones(len(CONTRASTS))
    cumulative = np.cumsum(summed) / summed.sum()
    low, middle, high = (float(CONTRASTS[int(np.searchsorted(cumulative, q))]) for q in (0.025, 0.5, 0.975))
    if float(d.max()) < 0.5 * min(DEPTHS_M):
        warnings.append(f"the deepest hold is {d.max() * 1e3:.1f} mm, too shallow to feel an inclusion {min(DEPTHS_M) * 1e3:g} mm down")
    norm = sum(shares.values())
    return Inclusion(probability, {D: share / norm for D, share in shares.items()}, middle, (low, high), tuple(warnings))
