"""Young's modulus from force and depth: the paper's peak formula, Hertz over a whole curve, and the height of the surface.

Heights are up positive and tissue is below; pressing gives positive force. One contact law throughout, Hertz for a sphere on an
elastic half-space: f = 4/3 · E/(1-ν²) · √r · d^1.5. For a given contact point it is linear in stiffness and force baseline, so only
the contact point is searched, on a grid that is narrowed: no start value, no iteration that could fail, the same answer every
time. Sums are plain and not matrix products: a product may be split over threads, which changes its last bits.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from palpd.analysis.hertz_misfit import HertzMisfit, covering, misfit_of_curve, range_of
from palpd.analysis.intervals import correlated_sigmas, student_t_95
from palpd.cell.effects.tissue import dimitriadis
from palpd.cell.plausible import doubts
from palpd.control.surface import FEWEST_SAMPLES, GRID, refuse_unfit
from palpd.errors import BadInput, RecordingError
from palpd.quantities import quantity
from palpd.tick import Floats

FINE = 9
"""Passes of an offline fit: 64 · 16^8 steps over the curve are finer than any encoder."""
LARGE_STRAIN = 0.3
"""Depth over tip radius above which a sphere is no longer a paraboloid and strains are no longer small."""
TILT_SIGMAS, TILT_SHARE = 4.0, 0.005
"""A force that changes with height in the air is a tilt beyond this many standard deviations and this share of the peak at full depth."""
TILT_PASSES = 3
"""A tilt moves the contact, and that decides what is air: it settles at once."""
AIR_FROM, LEAST_AIR = 0.1, 0.5
"""A tilt is seen where the tip is clear of the contact by this share of the depth, over a way of at least that share of it."""
THIN_LAYER = 0.1
"""Contact radius over thickness above which a rigid base below is felt (Dimitriadis et al. 2002: 12 % of force at 0.1)."""


@dataclass(frozen=True, slots=True)
class ContactFit:
    """Hertz fitted to a loading curve.

    Attributes:
        ci95_Pa: Its 95 % interval under this contact law; where the modulus changes with depth it covers that range too.
        contact_point_m: Height of the surface.
        contact_sigma_m: One standard deviation of that height.
        baseline_N: Force before contact, at the contact point.
        tilt_N_per_m: How fast that force rises on the way down, where it does.
        rms_N: Rms of the residuals.
        n: Number of samples.
        n_effective: Number of independent samples that they are worth.
        depth_m: Largest indentation.
        warnings: Further assumptions that the data strain.
        misfit: The range of the moduli over depth; None where one modulus describes the curve.
    """

    youngs_modulus_Pa: float
    ci95_Pa: tuple[float, float]
    contact_point_m: float
    contact_sigma_m: float
    baseline_N: float
    tilt_N_per_m: float
    rms_N: float
    n: int
    n_effective: float
    depth_m: float
    warnings: tuple[str, ...] = ()
    misfit: HertzMisfit | None = None


def modulus_peak_Pa(force_N: float, depth_m: float, tip_radius_m: float, poisson_ratio: float) -> float:
    """Young's modulus by eq. 1 of Guo, Xiao, Ren 2019: E = 3 f (1+ν) / (8 d √(r d)).

    It equals Hertz at ν = 0.5 only; elsewhere it is Hertz times 1/(2(1-ν)): 29 % less at ν = 0.3.

    Args:
        force_N: Contact force.
        depth_m: Indentation, above zero.
        tip_radius_m: Radius of the spherical tip, above zero.
        poisson_ratio: Poisson's ratio of the tissue.

    Raises:
        BadInput: Depth or radius is not above zero.
    """
    _refuse_without_depth(depth_m, tip_radius_m)
    return 3.0 * force_N * (1.0 + poisson_ratio) / (8.0 * depth_m * math.sqrt(tip_radius_m * depth_m))


def equation_1_notes(poisson_ratio: float, moduli_are: str, other_way: str) -> list[str]:
    """Say what Hertz gives where a modulus is by `modulus_peak_Pa`.

    Args:
        poisson_ratio: Poisson's ratio of the tissue.
        moduli_are: How the sentence begins.
        other_way: How it ends: where the reader finds Hertz's.

    Returns:
        One sentence, or none where Poisson's ratio is 0.5.
    """
    if abs(poisson_ratio - 0.5) < 1e-6:
        return []
    times = 2.0 * (1.0 - poisson_ratio)
    return [f"Poisson's ratio is {poisson_ratio:g}, and {moduli_are} Hertz at 0.5 only: Hertz gives {times:.3g} times as much{other_way}"]


def modulus_hertz_Pa(force_N: float, depth_m: float, tip_radius_m: float, poisson_ratio: float) -> float:
    """Young's modulus by Hertz for a sphere on a half-space: E = 3 f (1-ν²) / (4 √r d^1.5).

    Args:
        force_N: Contact force.
        depth_m: Indentation, above zero.
        tip_radius_m: Radius of the spherical tip, above zero.
        poisson_ratio: Poisson's ratio of the tissue.

    Raises:
        BadInput: Depth or radius is not above zero.
    """
    _refuse_without_depth(depth_m, tip_radius_m)
    return 3.0 * force_N * (1.0 - poisson_ratio**2) / (4.0 * math.sqrt(tip_radius_m) * depth_m**1.5)


def ymbt(dynamic_Pa: float, static_Pa: float) -> float:
    """Young's modulus bias term |E_dynamic - E_static| / E_static (Guo, Xiao, Ren 2019, eqs. 9 and 10).

    Args:
        dynamic_Pa: Modulus of dynamic palpation.
        static_Pa: Modulus of static palpation.

    Returns:
        The bias as a ratio.
    """
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

    Where both are free and the force in the air changes with height, that tilt is taken out as a straight line: of a cantilever's optics,
    of a cable, of a zero that drifts.
    The give of the machine is taken out: the tip stands (f - baseline)/k higher than the machine reports. The interval is Student's t
    times the sigma of `correlated_sigmas`, so noise that is not white and a law that does not quite hold widen it. Its degrees of freedom
    are the independent samples in contact. Rounding that noise does not dither shifts all samples before contact by up to half a count.
    No residual shows that, so it is added from the count seen in the data. The interval does not hold a baseline that drifts.

    Args:
        height_m: Heights (n,) of the loading in m, up positive, with what was recorded before contact.
        force_N: Forces (n,) in N, compression positive.
        tip_radius_m: Radius of the spherical tip.
        poisson_ratio: Poisson's ratio of the tissue.
        machine_stiffness_N_per_m: Stiffness of the machine in series with the tissue.
        contact_m: Height of contact, or None to fit it.
        baseline_N: Force before contact, or None to fit it.
        thickness_m: Thickness of the tissue, or None; it only decides on a warning.

    Returns:
        The fit with its interval and warnings.

    Raises:
        RecordingError: The samples cannot be fitted, or show no contact.
    """
    refuse_unfit(height_m, force_N)
    height_m, flat_N, tilt_N_per_m = np.asarray(height_m, dtype=float), force_N, 0.0
    hertz = _solve(height_m, force_N, machine_stiffness_N_per_m, contact_m, baseline_N)
    for _ in range(TILT_PASSES if contact_m is None and baseline_N is None else 0):
        before, tilt_N_per_m = tilt_N_per_m, _tilt_N_per_m(height_m, force_N, hertz)
        if before == tilt_N_per_m == 0.0:
            break
        flat_N = force_N - tilt_N_per_m * (hertz.contact_m - height_m)
        hertz = _solve(height_m, flat_N, machine_stiffness_N_per_m, None, None)
    if hertz.stiffness <= 0.0 or not hertz.indentation_m.any():
        raise RecordingError(
            f"the force over {len(height_m)} samples never rises with depth as a contact would (it spans {np.ptp(force_N):.3g} N); "
            "check the force's sign, the columns and the direction of the height"
        )
    residual_N = flat_N - hertz.baseline_N - hertz.stiffness * hertz.indentation_m**1.5
    beside = [*([np.ones_like(height_m)] if baseline_N is None else []), *([height_m - hertz.contact_m] if tilt_N_per_m else [])]
    (stiffness_half, contact_sigma_m), n_effective = _uncertainty(hertz, force_N, residual_N, contact_m is None, beside)
    modulus, depth_m = modulus_hertz_Pa(hertz.stiffness, 1.0, tip_radius_m, poisson_ratio), float(hertz.indentation_m.max())
    half = stiffness_half * modulus / hertz.stiffness
    above_N, stiffness_Pa = flat_N - hertz.baseline_N, modulus_hertz_Pa(1.0, 1.0, tip_radius_m, poisson_ratio)
    misfit = misfit_of_curve(hertz.indentation_m, above_N, residual_N, stiffness_Pa, contact_sigma_m)
    low_Pa, high_Pa = covering((modulus - half, modulus + half), *range_of(misfit))
    return ContactFit(
        youngs_modulus_Pa=modulus,
        ci95_Pa=(low_Pa, high_Pa),
        contact_point_m=hertz.contact_m,
        contact_sigma_m=contact_sigma_m,
        baseline_N=hertz.baseline_N,
        tilt_N_per_m=tilt_N_per_m,
        rms_N=math.sqrt(float(np.mean(residual_N**2))),
        n=len(force_N),
        n_effective=n_effective,
        depth_m=depth_m,
        warnings=(
            *(f"{doubt}; check the units of force, length and tip radius" for doubt in doubts("modulus", modulus, "the modulus")),
            *_tilted(tilt_N_per_m, depth_m, above_N),
            *_strained(depth_m, tip_radius_m, thickness_m),
            *_thin_data(hertz.indentation_m, contact_m, baseline_N),
        ),
        misfit=misfit,
    )


def refuse_undetermined(modulus_Pa: float, ci95_Pa: Sequence[float], misfit: HertzMisfit | None = None) -> None:
    """Refuse a modulus whose 95 % interval holds zero: the force shows no stiffness, or the law does not hold.

    Args:
        misfit: The range of the moduli over depth; None where one modulus describes them.

    Raises:
        RecordingError: The interval holds zero.
    """
    if ci95_Pa[0] <= 0.0:
        todo = "press deeper, and check the columns, the baseline, and the signs of force and height"
        raise RecordingError(
            f"the modulus is not determined: its 95 % interval, {quantity(modulus_Pa, 'Pa', (ci95_Pa[0], ci95_Pa[1]))}, holds zero, "
            f"expected above; {todo if misfit is None else misfit['sentence']}"
        )


class _Hertz(NamedTuple):
    """Solution of least squares: stiffness in N/m^1.5, contact height, baseline, and indentations (n,)."""

    stiffness: float
    contact_m: float
    baseline_N: float
    indentation_m: Floats


def _solve(
    reported_m: Floats, force_N: Floats, machine_stiffness_N_per_m: float, contact_m: float | None, baseline_N: float | None
) -> _Hertz:
    """Hertz over all samples, with the give of the machine taken out of the reported heights."""
    force_at_rest_N = baseline_N or 0.0
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
    return _Hertz(stiffness, contact, baseline, np.maximum(contact - tip_m, 0.0))


def _tilt_N_per_m(height_m: Floats, force_N: Floats, hertz: _Hertz) -> float:
    """How fast the force rises on the way down through the air; 0 where it does not, or too little air was seen to say so."""
    depth_m, above_m = float(hertz.indentation_m.max()), height_m - hertz.contact_m
    air = above_m > AIR_FROM * depth_m
    if int(air.sum()) < FEWEST_SAMPLES or float(np.ptp(above_m[air])) < LEAST_AIR * depth_m:
        return 0.0
    line = np.column_stack([above_m[air], np.ones(int(air.sum()))])
    slope, rest_N = np.linalg.lstsq(line, force_N[air], rcond=None)[0]
    sigmas, _ = correlated_sigmas(line, force_N[air] - line @ (slope, rest_N))
    seen = abs(slope) > TILT_SIGMAS * sigmas[0] and abs(slope) * depth_m > TILT_SHARE * hertz.stiffness * depth_m**1.5
    return -float(slope) if seen else 0.0


def _uncertainty(
    hertz: _Hertz, force_N: Floats, residual_N: Floats, contact_is_free: bool, beside: Sequence[Floats]
) -> tuple[tuple[float, float], float]:
    """Half-width of the stiffness's 95 % interval in N/m^1.5 and one sigma of the contact height in m; effective sample size.

    Args:
        beside: Derivatives (n,) of the force by what was fitted besides stiffness and contact.
    """
    depth_m = hertz.indentation_m
    slopes = [depth_m**1.5]
    slopes += [1.5 * hertz.stiffness * np.sqrt(depth_m)] if contact_is_free else []
    slopes += beside
    air = depth_m <= 0.0
    rounding_N = undithered_N(force_N, residual_N[air])
    sigmas, n_effective = correlated_sigmas(np.column_stack(slopes), residual_N, np.where(air, rounding_N, 0.0))
    degrees = max(n_effective * float(np.mean(~air)) - len(slopes), 1.0)
    return (student_t_95(degrees) * float(sigmas[0]), float(sigmas[1]) if contact_is_free else 0.0), n_effective


def _search(tip_m: Floats, force_N: Floats, contact_m: float | None, baseline_N: float | None) -> tuple[float, float, float]:
    """Stiffness in N/m^1.5, contact height and baseline with the least squares over all samples."""
    low_m, high_m = float(tip_m.min()), float(tip_m.max())
    for number in range(FINE if contact_m is None else 1):
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
        above_m = high_m - low_m if number == 0 and best == GRID - 1 else 2.0 * step_m  # the curve may begin below its contact
        low_m, high_m = contact[best] - 2.0 * step_m, contact[best] + above_m
    return float(stiffness[best]), float(contact[best]), float(rest_N - stiffness[best] * level[best])


def undithered_N(force_N: Floats, at_rest_N: Floats) -> float:
    """One standard deviation of what rounding leaves in the mean of samples at rest.

    Args:
        force_N: Forces (n,), whose smallest step is the count.
        at_rest_N: Residuals (k,) at rest, which show the noise.

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


def _tilted(tilt_N_per_m: float, depth_m: float, above_N: Floats) -> list[str]:
    if not tilt_N_per_m:
        return []
    share = abs(tilt_N_per_m) * depth_m / float(above_N.max())
    return [
        f"the force in the air {'rises' if tilt_N_per_m > 0.0 else 'falls'} on the way down: a tilt of the optics, a cable that pulls, "
        f"or a drift; it was taken out as a straight line, which is {share:.1%} of the force at full depth"
    ]


def _strained(depth_m: float, tip_radius_m: float, thickness_m: float | None) -> list[str]:
    warnings = []
    if depth_m > LARGE_STRAIN * tip_radius_m:
        warnings.append(
            f"the depth of {depth_m:.3g} m is {depth_m / tip_radius_m:.2f} of the tip radius of {tip_radius_m:g} m, "
            f"above {LARGE_STRAIN:g}: Hertz assumes small strain, so compare moduli at equal depth only"
        )
    if thickness_m is not None:
        x = math.sqrt(tip_radius_m * depth_m) / thickness_m
        if x > THIN_LAYER:
            factor = float(dimitriadis(np.array(x)))
            warnings.append(
                f"the contact radius is {x:.2f} of the thickness of {thickness_m:g} m, above {THIN_LAYER:g}: a rigid base makes the "
                f"modulus at this depth up to {factor:.2f} times too large (Dimitriadis et al. 2002, bonded, ν = 0.5)"
            )
    return warnings


def _thin_data(indentation_m: Floats, contact_m: float | None, baseline_N: float | None) -> list[str]:
    before, touching = int(np.sum(indentation_m <= 0.0)), int(np.sum(indentation_m > 0.0))
    warnings = []
    if before < FEWEST_SAMPLES and contact_m is None:
        rest = "contact point and baseline rest" if baseline_N is None else "the contact point rests"
        warnings.append(f"only {before} samples lie before contact, so {rest} on the contact law alone")
    if touching < FEWEST_SAMPLES:
        warnings.append(f"only {touching} samples lie in contact; press deeper or sample faster")
    return warnings


def _refuse_without_depth(depth_m: float, tip_radius_m: float) -> None:
    if not (depth_m > 0.0 and tip_radius_m > 0.0):
        raise BadInput(f"the depth is {depth_m:g} m at a tip radius of {tip_radius_m:g} m; a modulus needs both above zero")
