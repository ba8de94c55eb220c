"""Young's modulus from force and depth: the paper's peak formula, Hertz over a whole curve, and the height of the surface.

Heights are up positive and tissue is below; pressing gives positive force. One contact law throughout, Hertz for a sphere on an
elastic half-space: f = 4/3 · E/(1-ν²) · √r · d^1.5. For a given contact point it is linear in stiffness and force baseline, so only
the contact point is searched, on a grid that is narrowed: no start value, no iteration that could fail, the same answer every
time. Sums are plain and not matrix products: a product may be split over threads, which changes its last bits.
"""

import math
from dataclasses import dataclass

import numpy as np

from palpd.errors import BadInput, RecordingError
from palpd.tick import Floats

GRID = 64
"""Contact points tried at once; the next grid spans four steps of the last, so each pass is 16 times finer."""
FINE = 9
"""Passes of an offline fit: 64 · 16^8 steps over the curve are finer than any encoder."""
STIFFENINGS = np.linspace(0.0, 1.0, 33) ** 2 * 3.0
"""Stiffenings g·r² that a surface fit weighs, closer together near none."""
STIFFENING_SCALE = 0.7
"""One prior sigma of g·r². An inclusion of contrast 3 at 2 to 3 tip radii has 0.75 to 0.33, plain tissue none."""
SURFACE_PASSES = 4
FEWEST_SAMPLES = 10
LARGE_STRAIN = 0.3
"""Depth over tip radius above which a paraboloid is no longer a sphere and strains are no longer small."""
THIN_LAYER = 0.1
"""Contact radius over thickness above which a rigid base below is felt (Dimitriadis et al. 2002: 12 % of force at 0.1)."""


@dataclass(frozen=True, slots=True)
class ContactFit:
    """Hertz fitted to a loading curve.

    `ci95_Pa` is the 95 % interval of the modulus under this contact law; `contact_point_m` the height of the surface and
    `contact_sigma_m` one standard deviation of it; `baseline_N` the force before contact; `rms_N` of the residuals; `n` samples, worth
    `n_effective` independent ones; `depth_m` the largest indentation; `warnings` name the assumptions that the data strain.
    """

    youngs_modulus_Pa: float
    ci95_Pa: tuple[float, float]
    contact_point_m: float
    contact_sigma_m: float
    baseline_N: float
    rms_N: float
    n: int
    n_effective: float
    depth_m: float
    warnings: tuple[str, ...] = ()


def modulus_peak_Pa(force_N: float, depth_m: float, tip_radius_m: float, poisson_ratio: float) -> float:
    """Young's modulus by eq. 1 of Guo, Xiao, Ren 2019: E = 3 f (1+ν) / (8 d √(r d)).

    It equals Hertz at ν = 0.5 only; elsewhere it is Hertz times 1/(2(1-ν)): 29 % less at ν = 0.3. Raises BadInput at no depth.
    """
    _refuse_without_depth(depth_m, tip_radius_m)
    return 3.0 * force_N * (1.0 + poisson_ratio) / (8.0 * depth_m * math.sqrt(tip_radius_m * depth_m))


def modulus_hertz_Pa(force_N: float, depth_m: float, tip_radius_m: float, poisson_ratio: float) -> float:
    """Young's modulus by Hertz for a sphere on a half-space: E = 3 f (1-ν²) / (4 √r d^1.5). Raises BadInput at no depth."""
    _refuse_without_depth(depth_m, tip_radius_m)
    return 3.0 * force_N * (1.0 - poisson_ratio**2) / (4.0 * math.sqrt(tip_radius_m) * depth_m**1.5)


def ymbt(dynamic_Pa: float, static_Pa: float) -> float:
    """Young's modulus bias term |E_dynamic - E_static| / E_static, a ratio (Guo, Xiao, Ren 2019, eqs. 9 and 10)."""
    return abs(dynamic_Pa - static_Pa) / static_Pa


def fit_contact(
    height_m: Floats,
    force_N: Floats,
    tip_radius_m: float,
    poisson_ratio: float,
    *,
    machine_stiffness_N_per_m: float = math.inf,
    contact_m: float | None = None,
    baseline_N: float | None = None,
    thickness_m: float | None = None,
) -> ContactFit:
    """Least squares of Hertz over a whole loading curve, contact point and force baseline free unless they are given.

    `height_m` and `force_N` are (n,), with what was recorded before contact. The machine in series with the tissue is taken out:
    the tip stands (f - baseline)/k higher than the machine reports. The interval is Student's t times the larger sigma of two
    covariances, the plain one times the correlation time of the residuals and a sandwich of scores summed over their correlation
    (Newey and West 1987), so that noise which is not white and a law that does not quite hold widen it; degrees of freedom are the
    independent samples in contact. Rounding that noise does not dither leaves the baseline wrong by up to half a count in every
    sample before contact at once, which no residual shows: it is added from the count found in the data. A baseline that drifts is
    not in it. Raises RecordingError where there is no contact.
    """
    _refuse_unfit(height_m, force_N)
    reported_m, force_at_rest_N = np.asarray(height_m, dtype=float), baseline_N or 0.0
    if contact_m is None or math.isinf(machine_stiffness_N_per_m):
        tip_m = reported_m + (force_N - force_at_rest_N) / machine_stiffness_N_per_m
        stiffness, contact, baseline = _search(tip_m, force_N, contact_m, baseline_N)
        shift_m = (baseline - force_at_rest_N) / machine_stiffness_N_per_m
        tip_m, contact = tip_m - shift_m, contact - (shift_m if contact_m is None else 0.0)
    else:
        for _ in range(5):  # the baseline moves a tip whose contact is held, by a share of itself: it settles at once
            tip_m = reported_m + (force_N - force_at_rest_N) / machine_stiffness_N_per_m
            stiffness, contact, force_at_rest_N = _search(tip_m, force_N, contact_m, baseline_N)
        baseline = force_at_rest_N
    indentation_m = np.maximum(contact - tip_m, 0.0)
    if stiffness <= 0.0 or not indentation_m.any():
        raise RecordingError(
            f"the force over {len(height_m)} samples never rises with depth as a contact would (it spans {np.ptp(force_N):.3g} N); "
            "check the force's sign, the columns and the direction of the height"
        )
    residual_N = force_N - baseline - stiffness * indentation_m**1.5
    slopes = [indentation_m**1.5]
    slopes += [1.5 * stiffness * np.sqrt(indentation_m)] if contact_m is None else []
    slopes += [np.ones_like(indentation_m)] if baseline_N is None else []
    air = indentation_m <= 0.0
    rounding_N = _undithered_N(force_N, residual_N[air])
    sigmas, n_effective = correlated_sigmas(np.column_stack(slopes), residual_N, np.where(air, rounding_N, 0.0))
    degrees = max(n_effective * float(np.mean(~air)) - len(slopes), 1.0)
    modulus = modulus_hertz_Pa(stiffness, 1.0, tip_radius_m, poisson_ratio)
    half = student_t_95(degrees) * float(sigmas[0]) * modulus / stiffness
    return ContactFit(
        youngs_modulus_Pa=modulus,
        ci95_Pa=(modulus - half, modulus + half),
        contact_point_m=contact,
        contact_sigma_m=float(sigmas[1]) if contact_m is None else 0.0,
        baseline_N=baseline,
        rms_N=math.sqrt(float(np.mean(residual_N**2))),
        n=len(force_N),
        n_effective=n_effective,
        depth_m=float(indentation_m.max()),
        warnings=tuple(
            _strained(float(indentation_m.max()), tip_radius_m, thickness_m) + _thin_data(indentation_m, contact_m, baseline_N)
        ),
    )


def surface_from_approach(height_m: Floats, force_N: Floats, tip_radius_m: float) -> tuple[float, float]:
    """Height of the surface, extrapolated back from the first millimetres of contact, and one standard deviation of it, in m.

    `height_m` and `force_N` are (n,), from free air into the tissue, the sensor's delay already taken out. The law is
    f = baseline + a · d^1.5 · (1 + g · d²), where g stands for tissue that stiffens with depth (an inclusion below): too little force
    is seen to fit g, and leaving it out puts the surface too low, so the answer is the mean over all g weighed by a half-normal prior
    and by the data (Student's likelihood, the noise unknown). Raises RecordingError where there is too little to fit.
    """
    _refuse_unfit(height_m, force_N)
    stiffenings = STIFFENINGS / tip_radius_m**2
    log_prior = -0.5 * (STIFFENINGS / STIFFENING_SCALE) ** 2
    n = len(height_m)
    centred_N = force_N - force_N.mean()
    total = float(np.sum(centred_N**2))
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
        slope = np.maximum(product, 0.0) / np.maximum(squares, np.finfo(float).tiny)
        left = np.maximum(total - 2.0 * slope * product + slope**2 * squares, 1e-12 * total)
        best = np.unravel_index(np.argmin(left), left.shape)
        residual_N = centred_N - slope[best] * (hertz[best[0]] + stiffenings[best[1]] * stiffer[best[0]])
        share = 1.0 / _correlation(residual_N)[0]
        log_weight = log_prior - 0.5 * (share * n - 4.0) * np.log(left / left.min())
        weight = np.exp(log_weight - log_weight.max())
        of_surface = weight.sum(axis=1) / weight.sum()
        mean_m = float(np.sum(of_surface * surface_m))
        sigma_m = math.sqrt(float(np.sum(of_surface * (surface_m - mean_m) ** 2)))
        half_m = max(5.0 * sigma_m, 2.5 * (high_m - low_m) / (GRID - 1))
        low_m, high_m = mean_m - half_m, mean_m + half_m
    return mean_m, sigma_m


def _search(tip_m: Floats, force_N: Floats, contact_m: float | None, baseline_N: float | None) -> tuple[float, float, float]:
    """Stiffness in N/m^1.5, contact height and baseline with the least squares over all samples."""
    low_m, high_m = float(tip_m.min()), float(tip_m.max())
    for _ in range(FINE if contact_m is None else 1):
        contact = np.linspace(low_m, high_m, GRID) if contact_m is None else np.array([contact_m])
        depth_m = np.maximum(contact[:, None] - tip_m, 0.0)
        hertz = depth_m * np.sqrt(depth_m)
        level = hertz.mean(axis=1) if baseline_N is None else np.zeros(len(contact))
        rest_N = float(force_N.mean()) if baseline_N is None else baseline_N
        hertz -= level[:, None]
        squares = np.sum(hertz**2, axis=1)
        product = np.maximum(np.sum(hertz * (force_N - rest_N), axis=1), 0.0)
        stiffness = product / np.maximum(squares, np.finfo(float).tiny)
        best = int(np.argmax(product * stiffness))
        step_m = (high_m - low_m) / (GRID - 1)
        low_m, high_m = contact[best] - 2.0 * step_m, contact[best] + 2.0 * step_m
    return float(stiffness[best]), float(contact[best]), float(rest_N - stiffness[best] * level[best])


def correlated_sigmas(
    slopes: Floats, residual: Floats, common: Floats | None = None, *, slow: bool = True
) -> tuple[Floats, float]:
    """Standard deviations (p,) of least-squares parameters with the slopes (n, p), and the effective sample size.

    From a sandwich over correlated scores (Newey and West 1987); where the slopes are as `slow` as the residual it is too small in short
    records, and the plain covariance times the residual's correlation time is taken if it is larger. `common` (n,) is one standard
    deviation of an error that all samples share.
    """
    n, p = slopes.shape
    scale = np.sqrt(np.mean(slopes**2, axis=0))
    scaled = slopes / scale
    time, length = _correlation(residual)
    n_effective = n / time
    scores = scaled * residual[:, None]
    middle = scores.T @ scores
    window = min(2 * length, n // 4)
    for lag in range(1, window + 1):
        product = scores[lag:].T @ scores[:-lag]
        middle += (1.0 - lag / (window + 1)) * (product + product.T)
    bread = np.linalg.pinv(scaled.T @ scaled)
    variance = np.diag(bread @ middle @ bread)
    if slow:
        variance = np.maximum(variance, np.diag(bread) * time * float(np.mean(residual**2)))
    # residuals are smaller than errors by the parameters they were fitted with
    variance = variance * n_effective / max(n_effective - p, 1.0)
    if common is not None:
        variance = variance + (bread @ scaled.T @ common) ** 2
    return np.sqrt(variance) / scale, n_effective


def _undithered_N(force_N: Floats, at_rest_N: Floats) -> float:
    """One standard deviation of what rounding leaves in the mean of the samples at rest.

    A count q that noise of sigma s dithers leaves Σ (q/πk)² exp(-(2πks/q)²)/2 of variance, q²/12 without noise (Widrow 1956).
    """
    levels = np.unique(force_N)
    gaps = np.diff(levels)
    gaps = gaps[gaps > 1e-9 * (levels[-1] - levels[0])]
    if len(at_rest_N) < 2 or not len(gaps):
        return 0.0
    count_N = float(gaps.min())
    noise = math.sqrt(max(float(np.var(at_rest_N)) / count_N**2 - 1.0 / 12.0, 0.0))
    k = np.arange(1, 50)
    return count_N * math.sqrt(float(np.sum(np.exp(-((2.0 * np.pi * k * noise) ** 2)) / (np.pi * k) ** 2)) / 2.0)


def _correlation(residual: Floats) -> tuple[float, int]:
    """Integrated correlation time in samples (1 for white noise) and the lag at which the correlation first vanishes."""
    n = len(residual)
    power = np.abs(np.fft.rfft(residual - residual.mean(), 2 * n)) ** 2
    correlation = np.fft.irfft(power)[: n // 2]
    if correlation[0] <= 0.0:
        return 1.0, 1
    correlation /= correlation[0]
    vanished = np.flatnonzero(correlation <= 0.0)
    length = int(vanished[0]) if len(vanished) else len(correlation)
    return max(1.0, 1.0 + 2.0 * float(np.sum(correlation[1:length]))), max(length, 1)


def student_t_95(degrees: float) -> float:
    """Two-sided 95 % point of Student's distribution."""
    from scipy.special import stdtrit  # here, since 26 MB of scipy are of no use to the control loop, which needs the surface only

    return float(stdtrit(degrees, 0.975))


def _strained(depth_m: float, tip_radius_m: float, thickness_m: float | None) -> list[str]:
    found = []
    if depth_m > LARGE_STRAIN * tip_radius_m:
        found.append(
            f"the depth of {depth_m:.3g} m is {depth_m / tip_radius_m:.2f} of the tip radius of {tip_radius_m:g} m, "
            f"above {LARGE_STRAIN:g}: Hertz assumes small strain, so compare moduli at equal depth only"
        )
    if thickness_m is not None:
        x = math.sqrt(tip_radius_m * depth_m) / thickness_m
        if x > THIN_LAYER:
            factor = 1.0 + 1.133 * x + 1.283 * x**2 + 0.769 * x**3 + 0.0975 * x**4
            found.append(
                f"the contact radius is {x:.2f} of the thickness of {thickness_m:g} m, above {THIN_LAYER:g}: a rigid base makes the "
                f"modulus at this depth up to {factor:.2f} times too large (Dimitriadis et al. 2002, bonded, ν = 0.5)"
            )
    return found


def _thin_data(indentation_m: Floats, contact_m: float | None, baseline_N: float | None) -> list[str]:
    before, touching = int(np.sum(indentation_m <= 0.0)), int(np.sum(indentation_m > 0.0))
    found = []
    if before < FEWEST_SAMPLES and contact_m is None and baseline_N is None:
        found.append(f"only {before} samples lie before contact, so contact point and baseline hang on the contact law alone")
    if touching < FEWEST_SAMPLES:
        found.append(f"only {touching} samples lie in contact; press deeper or sample faster")
    return found


def _refuse_without_depth(depth_m: float, tip_radius_m: float) -> None:
    if not (depth_m > 0.0 and tip_radius_m > 0.0):
        raise BadInput(f"the depth is {depth_m:g} m at a tip radius of {tip_radius_m:g} m; a modulus needs both above zero")


def _refuse_unfit(height_m: Floats, force_N: Floats) -> None:
    if len(height_m) != len(force_N) or len(height_m) < FEWEST_SAMPLES:
        raise RecordingError(f"{len(height_m)} heights and {len(force_N)} forces were given; {FEWEST_SAMPLES} or more of each are needed")
    if not (np.isfinite(height_m).all() and np.isfinite(force_N).all()):
        raise RecordingError("a height or force is not a finite number; take such rows out")
