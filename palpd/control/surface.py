"""The height of the surface, from the force of the approach.

Heights are up positive and tissue is below; pressing gives positive force. Sums are plain and not matrix products: a product may be
split over threads, which changes its last bits.
"""

import math

import numpy as np

from palpd.errors import RecordingError
from palpd.tick import Floats

GRID = 64
"""Number of contact points in one grid; the next grid spans five of its steps or more, so it is at most 12.6 times finer."""
STIFFENINGS = np.linspace(0.0, 1.0, 33) ** 2 * 3.0
"""Values of the stiffening g·r² that a surface fit weighs, denser near zero."""
STIFFENING_SCALE = 0.7
"""One prior sigma of g·r². An inclusion of contrast 3 at 2 to 3 tip radii has 0.75 to 0.33, plain tissue none."""
SURFACE_PASSES = 4
"""Number of grids: the steps over an approach of 2 cm end below 1 µm."""
FEWEST_SAMPLES = 10
"""Fewest samples of an approach: the fit has five unknowns."""
TINY = np.finfo(float).tiny

UNSURE_M = 0.0005
"""Standard deviation of a surface above which no modulus can be had from it: 38 % at the 2 mm of a shallow press."""
FITTED_SAMPLES = 2000
"""Samples at the end of an approach that a surface is fitted to, 2 cm at 5 mm/s and 500 Hz: more would keep the loop waiting."""
CONTACT_SHARE = 0.2
"""Share of the last force that stands out of the noise; Hertz reaches it at this share to the power of 2/3 of the depth."""
AIR_SHARE = 1.5
"""Way in the air that a fit needs for its baseline, as a share of that in contact."""


def fitted_part(height_m: Floats, force_N: Floats) -> tuple[Floats, Floats]:
    """The end of an approach that a surface is fitted to.

    These are the last FITTED_SAMPLES. Where tissue is soft, or the way down slow, they lie in contact altogether, and a fit of them takes
    contact for the baseline. So the part reaches back to enough air, and neighbours are averaged.

    Args:
        height_m: Heights (n,) of the tip from free air into the tissue.
        force_N: Forces (n,) at these heights.

    Returns:
        Heights and forces (m,), m at most FITTED_SAMPLES.
    """
    first = len(height_m) - FITTED_SAMPLES
    if first <= 0:
        return height_m, force_N
    air_N = float(np.median(force_N[:FEWEST_SAMPLES]))
    light = np.flatnonzero(force_N < air_N + CONTACT_SHARE * (force_N[-1] - air_N))
    depth_m = (height_m[light[-1]] - height_m[-1]) / (1.0 - CONTACT_SHARE ** (2.0 / 3.0)) if len(light) else math.inf
    enough = np.flatnonzero(height_m >= height_m[-1] + (1.0 + AIR_SHARE) * depth_m)
    first = min(first, int(enough[-1])) if len(enough) else 0
    together = math.ceil((len(height_m) - first) / FITTED_SAMPLES)
    whole = (len(height_m) - first) // together * together
    return height_m[-whole:].reshape(-1, together).mean(axis=1), force_N[-whole:].reshape(-1, together).mean(axis=1)


def surface_from_approach(height_m: Floats, force_N: Floats, tip_radius_m: float, fits_slope: bool = True) -> tuple[float, float]:
    """Extrapolate the height of the surface back from the first millimetres of contact.

    The law is f = baseline + slope · height + a · d^1.5 · (1 + g · d²). The slope is that of a cable which pulls, or of a zero that drifts
    on the way down. g stands for tissue that stiffens with depth (an inclusion below). The force is too small to fit g, and without g the
    surface comes out too low. So the result is the mean over all g, weighed by a half-normal prior and by the data (Student's likelihood,
    unknown noise). Where too little air was seen to tell a slope from contact, and no slope leaves the surface certain, there is none.

    Args:
        height_m: heights (n,) of the tip from free air into the tissue.
        force_N: forces (n,) at these heights, the sensor's delay removed.
        tip_radius_m: radius of the spherical tip.
        fits_slope: whether the slope is fitted; in the recordings of earlier versions it was 0.

    Returns:
        Height of the surface and its standard deviation, in m.

    Raises:
        RecordingError: too few samples, or a force without any change.
    """
    found_m, sigma_m = _surface(height_m, force_N, tip_radius_m, fits_slope)
    if fits_slope and sigma_m > UNSURE_M:
        plain_m, plain_sigma_m = _surface(height_m, force_N, tip_radius_m, False)
        if plain_sigma_m <= UNSURE_M:
            return plain_m, plain_sigma_m
    return found_m, sigma_m


def _surface(height_m: Floats, force_N: Floats, tip_radius_m: float, fits_slope: bool) -> tuple[float, float]:
    """Height of the surface and its standard deviation, with a slope or without one."""
    refuse_unfit(height_m, force_N)
    stiffenings = STIFFENINGS / tip_radius_m**2
    log_prior = -0.5 * (STIFFENINGS / STIFFENING_SCALE) ** 2
    n = len(height_m)
    centred_N = force_N - force_N.mean()
    line = (height_m - height_m.mean()) * fits_slope
    line /= max(math.sqrt(float(np.sum(line**2))), TINY)
    along_N = float(np.sum(centred_N * line))
    total = float(np.sum(centred_N**2)) - along_N**2
    if total <= 0.0:
        raise RecordingError(f"the force stands still over all {n} samples of the approach, so no surface was met; go further down")
    low_m, high_m = float(height_m.min()), float(height_m.max())
    share = 1.0
    for _ in range(SURFACE_PASSES):
        surface_m = np.linspace(low_m, high_m, GRID)
        depth_m = np.maximum(surface_m[:, None] - height_m, 0.0)
        hertz = depth_m * np.sqrt(depth_m)
        stiffer = hertz * depth_m**2
        hertz -= hertz.mean(axis=1, keepdims=True)
        stiffer -= stiffer.mean(axis=1, keepdims=True)
        hh, hs, ss = (np.sum(one * other, axis=1)[:, None] for one, other in ((hertz, hertz), (hertz, stiffer), (stiffer, stiffer)))
        squares = hh + 2.0 * stiffenings * hs + stiffenings**2 * ss
        product = np.sum(hertz * centred_N, axis=1)[:, None] + stiffenings * np.sum(stiffer * centred_N, axis=1)[:, None]
        along = np.sum(hertz * line, axis=1)[:, None] + stiffenings * np.sum(stiffer * line, axis=1)[:, None]
        squares, product = squares - along**2, product - along * along_N  # what the line cannot explain
        scale = np.maximum(product, 0.0) / np.maximum(squares, TINY)
        left = np.maximum(total - 2.0 * scale * product + scale**2 * squares, 1e-12 * total)
        best = np.unravel_index(np.argmin(left), left.shape)
        residual_N = centred_N - scale[best] * (hertz[best[0]] + stiffenings[best[1]] * stiffer[best[0]])
        residual_N -= (along_N - scale[best] * along[best]) * line
        share = 1.0 / correlation_time(residual_N)[0]
        log_weight = log_prior - 0.5 * (share * n - (4.0 + fits_slope)) * np.log(left / left.min())
        weight = np.exp(log_weight - log_weight.max())
        of_surface = weight.sum(axis=1) / weight.sum()
        mean_m = float(np.sum(of_surface * surface_m))
        sigma_m = math.sqrt(float(np.sum(of_surface * (surface_m - mean_m) ** 2)))
        half_m = max(5.0 * sigma_m, 2.5 * (high_m - low_m) / (GRID - 1))
        low_m, high_m = mean_m - half_m, mean_m + half_m
    return mean_m, sigma_m


def correlation_time(residual: Floats) -> tuple[float, int]:
    """Estimate the integrated correlation time of a residual.

    Args:
        residual: samples (n,).

    Returns:
        The correlation time in samples (1 for white noise), and the lag at which the correlation first vanishes.
    """
    n = len(residual)
    power = np.abs(np.fft.rfft(residual - residual.mean(), 2 * n)) ** 2
    correlation = np.fft.irfft(power)[: n // 2]
    if correlation[0] <= 0.0:
        return 1.0, 1
    correlation /= correlation[0]
    vanished = np.flatnonzero(correlation <= 0.0)
    length = int(vanished[0]) if len(vanished) else len(correlation)
    return max(1.0, 1.0 + 2.0 * float(np.sum(correlation[1:length]))), max(length, 1)


def refuse_unfit(height_m: Floats, force_N: Floats) -> None:
    """Refuse an approach that no contact law can be fitted to.

    Args:
        height_m: heights (n,).
        force_N: forces (n,).

    Raises:
        RecordingError: the lengths differ, are too short, or a number is not finite.
    """
    if len(height_m) != len(force_N) or len(height_m) < FEWEST_SAMPLES:
        raise RecordingError(f"{len(height_m)} heights and {len(force_N)} forces were given; {FEWEST_SAMPLES} or more of each are needed")
    if not (np.isfinite(height_m).all() and np.isfinite(force_N).all()):
        raise RecordingError("a height or force is not a finite number; take such rows out")
