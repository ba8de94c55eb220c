"""Results of a recorded palpation: per site the surface, the depths reached, the moduli, and the effect of the correction.

Computed from the recording alone, so a run, a replay and `palpd analyse` of the file give the same numbers.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, NotRequired, TypedDict

import numpy as np
from numpy.typing import NDArray

from palpd.analysis.hertz_misfit import HertzMisfit, covering, misfit_over_depth, range_of, span_Pa
from palpd.analysis.interruptions import interrupted
from palpd.analysis.intervals import mean_half_width_95
from palpd.analysis.modulus_intervals import (
    NORMAL_95,
    KnownWeight,
    Measured,
    PressScatter,
    approach_sigma_m,
    mean_ci95_Pa,
    mean_sigma_N,
)
from palpd.analysis.stalls import StallFigures
from palpd.analysis.young import ContactFit, fit_contact, modulus_peak_Pa, refuse_undetermined, ymbt
from palpd.control.sequence import SOFT_END
from palpd.errors import RecordingError
from palpd.quantities import kilopascals
from palpd.recording.header import RecordedGeometry, RecordingHeader
from palpd.recording.reader import Recording
from palpd.recording.tick_rows import filled_slots
from palpd.tick import Floats, Mode, Phase

PEAK_WINDOW_S = 0.02
"""A peak is the largest mean of this long: the largest single sample would add two sigmas of noise to every force."""


LOADED_N = 1.0
"""Force against a rigid plate above which a press counts for the machine's stiffness: below it mount and plate settle."""
MOST_HARDENING = 1.25
"""How many times as stiff the upper half of a press on a rigid plate may be as the lower one. A plate has 1, and a mount may harden a
little; a sphere on anything soft has 1.37 by Hertz's law."""


CORRECTED_ZERO_N, UNCORRECTED_ZERO_N = 0.02, 1.0
"""Standard deviation of the zero of a dynamic peak, with an inertial model and without one. The model's running zero follows a bias to
some 0.02 N. Without it nothing does, and the value leaves the zero free."""
UNCORRECTED_BIAS_N = 0.19
"""The same for the interval of a dynamic modulus without an inertial model: the bias that a tare left in the paper (docs/paper.md)."""


SAME_MODULUS = 0.05
"""Relative difference of two moduli of a site that needs no explanation: about the accuracy of either."""


class DepthResult(TypedDict):
    """Static palpation to one depth; figures that the hold does not give are None."""

    commanded_m: float
    achieved_m: float | None
    force_N: float | None
    E_Pa: float | None
    cut_short: bool


class PressResult(TypedDict):
    """One dynamic palpation: the peak of the measured force, what of it was no contact, and the moduli with and without that."""

    commanded_m: float
    achieved_m: float
    peak_depth_m: float
    original_N: float
    correction_N: float
    running_zero_N: float
    original_Pa: float
    corrected_Pa: float
    cut_short: bool


class SiteResult(TypedDict):
    """One site of a plan; figures that the recording does not give are None, and only an emulated cell has a true modulus.

    The intervals `…noise_ci95_Pa` hold noise, the height of the surface and the weight of the probe
    (`palpd.analysis.modulus_intervals`). The intervals `…ci95_Pa` cover the range of the moduli over depth too, where `hertz_misfit` says
    that these change (`palpd.analysis.hertz_misfit`).
    """

    name: str
    surface_z_m: float | None
    static_youngs_modulus_Pa: float | None
    static_ci95_Pa: list[float] | None
    static_noise_ci95_Pa: list[float] | None
    dynamic_original_Pa: float | None
    dynamic_corrected_Pa: float | None
    dynamic_corrected_ci95_Pa: list[float] | None
    dynamic_corrected_noise_ci95_Pa: list[float] | None
    hertz_misfit: HertzMisfit | None
    ymbt_original: float | None
    ymbt_corrected: float | None
    peak_force_N: float | None
    correction_N: float | None
    running_zero_N: float | None
    cut_short: bool
    cut_short_depths_m: list[float]
    depths: list[DepthResult]
    presses: list[PressResult]
    true_youngs_modulus_Pa: NotRequired[float]


class LoadingResult(TypedDict):
    """Hertz over the loading of the deepest press of a site; the figures are None where `warnings` say why.

    `hertz_misfit` is that of the holds or presses, whose depths count from the surface of the search; of the loading where these show none.
    """

    name: str
    youngs_modulus_Pa: float | None
    ci95_Pa: list[float] | None
    hertz_misfit: HertzMisfit | None
    contact_point_m: float | None
    baseline_N: NotRequired[float]
    depth_m: NotRequired[float]
    rms_N: NotRequired[float]
    peak_force_N: NotRequired[float]
    static_youngs_modulus_Pa: NotRequired[float | None]
    warnings: list[str]


class DryFigures(TypedDict):
    """What a dry run saw, in base axes: mean tared force, noise of fz (standard deviation), and the mean pose of the tip."""

    force_N: list[float]
    noise_N: float
    tcp_pose: list[float]


class LoopFigures(TypedDict):
    """How the loop kept its rate, and what kept data from it; a recording without ticks has no times."""

    ticks: int
    missed: int
    work_us_p50: NotRequired[float]
    work_us_p99: NotRequired[float]
    wakeup_us_p50: NotRequired[float]
    wakeup_us_p99: NotRequired[float]
    stalls: NotRequired[StallFigures]


@dataclass(frozen=True, slots=True)
class Track:
    """Every sensor frame of a recording with the state of robot and sequence; arrays of equal length (n,).

    `tip_z_m` is the height of the tip (the machine's give taken out) when the tissue gave the force that the frame reports.
    """

    t_s: Floats
    tip_z_m: Floats
    fz_N: Floats
    inertial_N: Floats
    zero_N: Floats
    phase: NDArray[np.uint8]
    mode: NDArray[np.uint8]
    site: NDArray[np.int16]
    repeat: NDArray[np.int16]
    depth_m: Floats
    surface_z_m: Floats
    cut_short: NDArray[np.uint8]

    def where(self, chosen: NDArray[np.bool_]) -> "Track":
        """Some of the frames.

        Args:
            chosen: True (n,) for the frames to keep.
        """
        return Track(*(getattr(self, name)[chosen] for name in self.__slots__))


def track(rows: NDArray[np.void], delay_s: float, machine_stiffness_N_per_m: float = math.inf) -> Track:
    """Flatten the ticks of a recording to one line per sensor frame.

    Args:
        rows: Ticks, with the fields of ROW of palpd.tick.
        delay_s: Delay of the sensor's filter.
        machine_stiffness_N_per_m: Stiffness of the machine; its give is taken out of the heights.

    Returns:
        The frames, without presses that a pause interrupted.
    """
    filled = filled_slots(rows)
    tick_of = np.repeat(np.arange(len(rows)), rows["frames"])
    t_s = rows["frame_t_s"][filled]
    fz_N = rows["tared"][filled][:, 2]
    robot_t_s, first = np.unique(rows["robot_t_s"], return_index=True)
    z_m = np.interp(t_s - delay_s, robot_t_s, rows["tcp_pose"][first, 2])
    whole = Track(
        t_s=t_s,
        tip_z_m=z_m + fz_N / machine_stiffness_N_per_m,
        fz_N=fz_N,
        inertial_N=rows["inertial_N"][filled],
        **{name: rows[name][tick_of] for name in ("phase", "mode", "site", "repeat", "depth_m", "surface_z_m", "cut_short", "zero_N")},
    )
    dropped = interrupted(rows)
    return whole.where(~dropped[tick_of]) if dropped.any() else whole


class _Errors(NamedTuple):
    """What a recording's header says of the errors of its moduli; `peak_zero_sigma_N` is the standard deviation of the zero of a peak."""

    weight: KnownWeight
    scatter: PressScatter
    peak_zero_sigma_N: float
    fits_slope: bool

    @classmethod
    def of(cls, header: RecordingHeader) -> "_Errors":
        zero_sigma_N = CORRECTED_ZERO_N if header.get("model_card") else UNCORRECTED_ZERO_N
        return cls(KnownWeight.of(header), PressScatter.of(header), zero_sigma_N, header.get("fits_slope", False))


def sites(rows: NDArray[np.void], header: RecordingHeader) -> list[SiteResult]:
    """Surface, depths and moduli of every site of the plan.

    Args:
        rows: Ticks, with the fields of ROW of palpd.tick.

    Returns:
        One result per site, in the order of the plan.
    """
    body = header["body"]
    stiffness = body["machine_stiffness_N_per_m"] or math.inf
    whole = track(rows, body["delay_s"], stiffness)
    tip = (body["tip_radius_m"], body["poisson_ratio"])
    errors = _Errors.of(header)
    results = [_site(whole.where(whole.site == index), site["name"], tip, errors) for index, site in enumerate(header["sites"])]
    return results if header.get("model_card") else [_with_bias(site) for site in results]


def _with_bias(site: SiteResult) -> SiteResult:
    """A site whose dynamic interval also holds the bias of a force that no model has corrected."""
    ci95_Pa, value_Pa = site["dynamic_corrected_ci95_Pa"], site["dynamic_corrected_Pa"]
    per_N = _mean(
        press["corrected_Pa"] / force_N for press in site["presses"] if (force_N := press["original_N"] - press["correction_N"]) > 0.0
    )
    if ci95_Pa is None or value_Pa is None or per_N is None:
        return site
    return {**site, "dynamic_corrected_ci95_Pa": [*_widened(value_Pa, ci95_Pa, UNCORRECTED_BIAS_N * per_N)]}


def analysed(rows: NDArray[np.void], header: RecordingHeader) -> list[LoadingResult]:
    """Young's modulus of every site by Hertz over the whole loading of its deepest press, contact point and force baseline free.

    Args:
        rows: Ticks, with the fields of ROW of palpd.tick.

    Returns:
        One result per site, in the order of the plan.
    """
    body = header["body"]
    whole = track(rows, body["delay_s"], body["machine_stiffness_N_per_m"] or math.inf)
    errors = _Errors.of(header)
    return [_loading(whole.where(whole.site == index), site["name"], body, errors) for index, site in enumerate(header["sites"])]


def analysed_sites(recording: Recording, site: str | None = None) -> list[LoadingResult]:
    """The moduli of a recording as `analysed` gives them.

    Args:
        recording: Recording of a palpation.
        site: Name of the only site to analyse, or None for all.

    Raises:
        RecordingError: Where the recording has no such site.
    """
    if site is not None:
        recording.site_index(site)
    return [each for each in analysed(recording.rows, recording.header) if site in (None, each["name"])]


def _loading(of_site: Track, name: str, body: RecordedGeometry, errors: _Errors) -> LoadingResult:
    pressed = of_site.where(np.isin(of_site.mode, (Mode.STATIC, Mode.DYNAMIC)) & np.isfinite(of_site.depth_m))
    if not len(pressed.t_s):
        return _no_loading(name, "nothing was pressed here")
    deepest = pressed.where(pressed.depth_m == pressed.depth_m.max())
    one = deepest.where((deepest.mode == deepest.mode[-1]) & (deepest.repeat == deepest.repeat[-1]))
    loading = one.where(np.isin(one.phase, (Phase.BASELINE, Phase.PRESS)))
    tip, force_N = (body["tip_radius_m"], body["poisson_ratio"]), loading.fz_N - loading.inertial_N
    try:
        fit = fit_contact(loading.tip_z_m, force_N, *tip)
        if errors.weight.force_sigma_N:
            heavier = fit_contact(loading.tip_z_m, force_N + errors.weight.shift_N(force_N), *tip)
            fit = _with_weight(fit, heavier.youngs_modulus_Pa - fit.youngs_modulus_Pa)
        held = _site(of_site, name, tip, errors)
        misfit = held["hertz_misfit"] or fit.misfit
        ci95_Pa = covering(fit.ci95_Pa, *range_of(misfit))
        refuse_undetermined(fit.youngs_modulus_Pa, ci95_Pa, misfit)
    except RecordingError as error:
        return _no_loading(name, str(error))
    return {
        "name": name,
        "youngs_modulus_Pa": fit.youngs_modulus_Pa,
        "ci95_Pa": ci95_Pa,
        "hertz_misfit": misfit,
        "contact_point_m": fit.contact_point_m,
        "baseline_N": fit.baseline_N,
        "depth_m": fit.depth_m,
        "rms_N": fit.rms_N,
        "peak_force_N": float(loading.fz_N.max() - fit.baseline_N),
        "static_youngs_modulus_Pa": held["static_youngs_modulus_Pa"],
        "warnings": [*([] if misfit is None else [misfit["sentence"]]), *fit.warnings, *_two_moduli(fit, held)],
    }


def _with_weight(fit: ContactFit, sigma_Pa: float) -> ContactFit:
    """The fit with an interval that also holds what the tolerance of the probe's weight leaves, one standard deviation of the modulus."""
    return replace(fit, ci95_Pa=_widened(fit.youngs_modulus_Pa, fit.ci95_Pa, sigma_Pa))


def _widened(value_Pa: float, ci95_Pa: Sequence[float], sigma_Pa: float) -> tuple[float, float]:
    """The interval of a modulus with a further, independent error of one standard deviation `sigma_Pa`."""
    low_Pa, high_Pa = (math.hypot(bound_Pa - value_Pa, NORMAL_95 * sigma_Pa) for bound_Pa in ci95_Pa)
    return value_Pa - low_Pa, value_Pa + high_Pa


def _two_moduli(fit: ContactFit, held: SiteResult) -> list[str]:
    """Why the table of a run shows another modulus: the mean of equation 1 over the holds at several depths, from the found surface."""
    static_Pa, surface_m = held["static_youngs_modulus_Pa"], held["surface_z_m"]
    if static_Pa is None or surface_m is None or abs(static_Pa / fit.youngs_modulus_Pa - 1.0) < SAME_MODULUS:
        return []
    depths = [depth["achieved_m"] for depth in held["depths"] if depth["E_Pa"] is not None and depth["achieved_m"] is not None]
    return [
        f"the results table of the run shows {kilopascals(static_Pa)} kPa. That is equation 1, the mean of {len(depths)} holds "
        f"{min(depths) * 1e3:.2g} to {max(depths) * 1e3:.2g} mm below the surface of its search. The "
        f"{kilopascals(fit.youngs_modulus_Pa)} kPa are Hertz over one whole loading, with the contact "
        f"{(fit.contact_point_m - surface_m) * 1e3:+.2f} mm from that surface"
    ]


def _no_loading(name: str, reason: str) -> LoadingResult:
    return {"name": name, "youngs_modulus_Pa": None, "ci95_Pa": None, "hertz_misfit": None, "contact_point_m": None, "warnings": [reason]}


def _site(of_site: Track, name: str, tip: tuple[float, float], errors: _Errors) -> SiteResult:
    known = of_site.surface_z_m[np.isfinite(of_site.surface_z_m)]
    surface_z_m = float(known[-1]) if len(known) else None
    static = [_held(of_site, depth_m, tip) for depth_m in _depths(of_site, Mode.STATIC)]
    presses = [press for depth_m in _depths(of_site, Mode.DYNAMIC) for press in _presses(of_site, depth_m, tip)]
    static_Pa = _mean(depth["E_Pa"] for depth in static)
    original_Pa, corrected_Pa = _mean(press["original_Pa"] for press in presses), _mean(press["corrected_Pa"] for press in presses)
    pressed = of_site.where(np.isin(of_site.phase, (Phase.SEARCH, Phase.PRESS, Phase.HOLD, Phase.RETRACT)))
    contact_N = pressed.fz_N - pressed.inertial_N
    approach = of_site.where((of_site.mode == Mode.SEARCH) & (of_site.phase == Phase.SEARCH))
    surface_sigma_m = approach_sigma_m(approach.tip_z_m, approach.fz_N, tip[0], errors.fits_slope) if static or presses else None
    holds = _measured_holds(of_site, static)
    peaks = _measured_peaks(of_site.where(of_site.phase == Phase.BASELINE), presses)
    static_ci95_Pa, dynamic_ci95_Pa = (mean_ci95_Pa(measured, surface_sigma_m, errors.weight) for measured in (_all(holds), _all(peaks)))
    misfit = None
    if surface_sigma_m is not None:  # holds have a zero of their own just before them, so they decide where there are enough
        judged, zero_sigma_N = (holds, 0.0) if len(holds) > 1 else (peaks, errors.peak_zero_sigma_N)
        misfit = misfit_over_depth(judged, errors.scatter, surface_sigma_m, errors.weight, zero_sigma_N)
    return {
        "name": name,
        "surface_z_m": surface_z_m,
        "static_youngs_modulus_Pa": static_Pa,
        "static_ci95_Pa": _with_range(static_ci95_Pa, holds, misfit),
        "static_noise_ci95_Pa": static_ci95_Pa,
        "dynamic_original_Pa": original_Pa,
        "dynamic_corrected_Pa": corrected_Pa,
        "dynamic_corrected_ci95_Pa": _with_range(dynamic_ci95_Pa, peaks, misfit),
        "dynamic_corrected_noise_ci95_Pa": dynamic_ci95_Pa,
        "hertz_misfit": misfit,
        "ymbt_original": ymbt(original_Pa, static_Pa) if original_Pa and static_Pa else None,
        "ymbt_corrected": ymbt(corrected_Pa, static_Pa) if corrected_Pa and static_Pa else None,
        "peak_force_N": float(contact_N.max()) if len(contact_N) else None,
        "correction_N": _mean(press["correction_N"] for press in presses),
        "running_zero_N": _mean(press["running_zero_N"] for press in presses),
        "cut_short": bool(of_site.cut_short.any()),
        "cut_short_depths_m": sorted({float(d) for d in of_site.depth_m[of_site.cut_short > 0]}),
        "depths": static,
        "presses": presses,
    }


def _held(of_site: Track, depth_m: float, tip: tuple[float, float]) -> DepthResult:
    """Static palpation to one depth: mean of the hold less the mean of the rest before it."""
    here = of_site.where((of_site.mode == Mode.STATIC) & (of_site.depth_m == depth_m))
    hold, rest = here.where(here.phase == Phase.HOLD), here.where(here.phase == Phase.BASELINE)
    cut_short = bool(here.cut_short.any())
    if not len(hold.t_s) or not len(rest.t_s):
        pressed = here.where(here.phase == Phase.PRESS)
        deepest_m = float(here.surface_z_m[-1] - pressed.tip_z_m.min()) if len(pressed.t_s) else None
        return {"commanded_m": depth_m, "achieved_m": deepest_m, "force_N": None, "E_Pa": None, "cut_short": cut_short}
    force_N = float(hold.fz_N.mean() - rest.fz_N.mean())
    achieved_m = float(hold.surface_z_m[-1] - hold.tip_z_m.mean())
    return {
        "commanded_m": depth_m,
        "achieved_m": achieved_m,
        "force_N": force_N,
        "E_Pa": modulus_peak_Pa(force_N, achieved_m, *tip),
        "cut_short": cut_short,
    }


ByDepth = Mapping[float, Sequence[Measured]]
"""Moduli by the depth that was commanded."""


def _all(by_depth: ByDepth) -> list[Measured]:
    return [press for group in by_depth.values() for press in group]


def _with_range(ci95_Pa: list[float] | None, by_depth: ByDepth, misfit: HertzMisfit | None) -> list[float] | None:
    """An interval of a mean over depths, with the range of these and of the misfit where Hertz does not fit."""
    return ci95_Pa if ci95_Pa is None or misfit is None else covering(ci95_Pa, span_Pa(by_depth), *range_of(misfit))


def _measured_holds(of_site: Track, depths: list[DepthResult]) -> dict[float, list[Measured]]:
    """The holds that gave a modulus, with the noise of their mean forces."""
    measured = {}
    for depth in depths:
        if depth["E_Pa"] is not None and depth["force_N"] is not None and depth["achieved_m"] is not None:
            here = of_site.where((of_site.mode == Mode.STATIC) & (of_site.depth_m == depth["commanded_m"]))
            noise_N = math.hypot(*(mean_sigma_N(here.fz_N[here.phase == phase]) for phase in (Phase.HOLD, Phase.BASELINE)))
            measured[depth["commanded_m"]] = [Measured(depth["E_Pa"], depth["force_N"], depth["achieved_m"], noise_N)]
    return measured


def _measured_peaks(rest: Track, presses: list[PressResult]) -> dict[float, list[Measured]]:
    """The dynamic presses, with the noise that a window as short as their peak shows at rest."""
    width = peak_width(rest.t_s) if len(rest.t_s) > 2 else 1
    noise_N = float(np.std(np.convolve(rest.fz_N, np.ones(width) / width, mode="valid"))) if len(rest.t_s) > width else 0.0
    measured: dict[float, list[Measured]] = {}
    for press in presses:
        force_N = press["original_N"] - press["correction_N"]
        measured.setdefault(press["commanded_m"], []).append(Measured(press["corrected_Pa"], force_N, press["peak_depth_m"], noise_N))
    return measured


def peak_width(t_s: Floats) -> int:
    """Number of frames in the window of a peak.

    Args:
        t_s: Times (n,) of the frames.
    """
    return max(1, round(PEAK_WINDOW_S / float(np.median(np.diff(t_s)))))


def _presses(of_site: Track, depth_m: float, tip: tuple[float, float]) -> list[PressResult]:
    """Dynamic palpations to one depth: the paper's modulus at the force peak, as measured and with the inertial force taken out."""
    here = of_site.where((of_site.mode == Mode.DYNAMIC) & (of_site.depth_m == depth_m))
    presses: list[PressResult] = []
    for repeat in np.unique(here.repeat):
        press = here.where((here.repeat == repeat) & np.isin(here.phase, (Phase.PRESS, Phase.RETRACT)))
        if len(press.t_s) < 3:
            continue
        width = peak_width(press.t_s)
        window = np.ones(width) / width
        force_N, inertial_N, tip_z_m = (
            np.convolve(values, window, mode="valid") for values in (press.fz_N, press.inertial_N, press.tip_z_m)
        )
        peak = int(np.argmax(force_N))
        at_m = float(press.surface_z_m[-1] - tip_z_m[peak])
        if at_m <= 0:
            continue
        corrected_N = float(force_N[peak] - inertial_N[peak])
        presses.append(
            {
                "commanded_m": depth_m,
                "achieved_m": float(press.surface_z_m[-1] - tip_z_m.min()),
                "peak_depth_m": at_m,
                "original_N": float(force_N[peak]),
                "correction_N": float(inertial_N[peak]),
                "running_zero_N": float(press.zero_N[peak]),
                "original_Pa": modulus_peak_Pa(float(force_N[peak]), at_m, *tip),
                "corrected_Pa": modulus_peak_Pa(corrected_N, at_m, *tip),
                "cut_short": bool(press.cut_short.any()),
            }
        )
    return presses


def _depths(of_site: Track, mode: Mode) -> list[float]:
    depths = of_site.depth_m[(of_site.mode == mode) & np.isfinite(of_site.depth_m)]
    return [float(depth) for depth in np.unique(depths)]


def _mean(values: Iterable[float | None]) -> float | None:
    finite = [value for value in values if value is not None and math.isfinite(value)]
    return math.fsum(finite) / len(finite) if finite else None


def cut_short_notes(sites: list[SiteResult], contact_limit_N: float) -> list[str]:
    """Say of every press that was cut short which limit ended it.

    Args:
        sites: Results of a run.
        contact_limit_N: The contact limit of its configuration.

    Returns:
        One sentence for each site, kind of press and depth.
    """
    reason = f"{contact_limit_N:g} N limit reached (the sequence ends a press at {SOFT_END:g} x contact_limit_N)"
    presses = [
        (site["name"], kind, press["commanded_m"])
        for site in sites
        for kind, all_presses in (("static", site["depths"]), ("dynamic", site["presses"]))
        for press in all_presses
        if press["cut_short"]
    ]
    return [f"site {name}, {kind} press to {depth_m * 1e3:g} mm: {reason}" for name, kind, depth_m in dict.fromkeys(presses)]


def dry_figures(rows: NDArray[np.void]) -> DryFigures | None:
    """Force, noise and pose of a dry run.

    Args:
        rows: Ticks, with the fields of ROW of palpd.tick.

    Returns:
        The figures after the tare; None where the run ended before.
    """
    watched = rows[rows["phase"] != Phase.TARE]
    filled = filled_slots(watched)
    forces_N = watched["tared"][filled][:, :3]
    if not len(forces_N):
        return None
    return {
        "force_N": forces_N.mean(axis=0).tolist(),
        "noise_N": float(forces_N[:, 2].std()),
        "tcp_pose": watched["tcp_pose"].mean(axis=0).tolist(),
    }


def loop_figures(rows: NDArray[np.void]) -> LoopFigures:
    """How the loop kept its rate.

    Args:
        rows: Ticks, with the fields of ROW of palpd.tick.

    Returns:
        Numbers of ticks and missed ticks, and percentiles of work and wake-up delay in µs.
    """
    ticking = rows["phase"] != Phase.IDLE
    now_s, planned_s, work_us, missed = (rows[name][ticking] for name in ("now_s", "planned_s", "work_us", "missed"))
    if not len(now_s):
        return {"ticks": 0, "missed": 0}
    wakeup_us = (now_s - planned_s) * 1e6
    work_us = work_us[1:] if len(work_us) > 1 else work_us
    return {
        "ticks": len(now_s),
        "missed": int(missed.sum()),
        "work_us_p50": float(np.percentile(work_us, 50)),
        "work_us_p99": float(np.percentile(work_us, 99)),
        "wakeup_us_p50": float(np.percentile(wakeup_us, 50)),
        "wakeup_us_p99": float(np.percentile(wakeup_us, 99)),
    }


def machine_stiffness(rows: NDArray[np.void]) -> tuple[float, tuple[float, float]]:
    """Stiffness of the machine: slope of force over reported travel against a rigid plate.

    Args:
        rows: Ticks of `palpd stiffness`, with the fields of ROW of palpd.tick.

    Returns:
        Mean over the presses in N/m, and its 95 % interval.

    Raises:
        RecordingError: Fewer than two presses can be evaluated, one gives way upwards, or they harden as no rigid plate does.
    """
    whole = track(rows, 0.0)
    slopes, lower, upper = [], [], []
    for repeat in np.unique(whole.repeat[whole.repeat >= 0]):
        press = whole.where((whole.mode == Mode.STIFFNESS) & (whole.phase == Phase.PRESS) & (whole.repeat == repeat))
        loaded = np.convolve(press.fz_N, np.ones(50) / 50, mode="same") > LOADED_N
        press = press.where(loaded)
        if len(press.t_s) > 50:
            slopes.append(1.0 / _compliance_m_per_N(press))
            first = np.arange(len(press.t_s)) < len(press.t_s) // 2
            lower.append(_compliance_m_per_N(press.where(first)))
            upper.append(_compliance_m_per_N(press.where(~first)))
    if len(slopes) < 2 or min(slopes) <= 0:
        raise RecordingError(f"{len(slopes)} presses of a rigid plate can be evaluated, expected at least 2; repeat palpd stiffness")
    mean = math.fsum(slopes) / len(slopes)
    beyond = [below - MOST_HARDENING * above for below, above in zip(lower, upper, strict=True)]
    if math.fsum(beyond) / len(beyond) > mean_half_width_95(beyond):
        raise RecordingError(
            f"the presses measure {mean / 1e3:.3g} N for 1 mm, and their upper half is {math.fsum(lower) / math.fsum(upper):.2f} times as "
            f"stiff as their lower half, expected at most {MOST_HARDENING:g} times: something soft was pressed. Put a rigid plate on firm "
            "ground under the probe, and repeat palpd stiffness"
        )
    half = mean_half_width_95(slopes)
    return mean, (mean - half, mean + half)


def _compliance_m_per_N(press: Track) -> float:
    """How far a press at constant speed gives way per newton.

    5 µm of noise on a travel of 0.1 mm would flatten a regression on travel by 4 %; time, which has none, is the instrument.
    """
    t_s = press.t_s - press.t_s.mean()
    return -float((t_s @ press.tip_z_m) / (t_s @ press.fz_N))
