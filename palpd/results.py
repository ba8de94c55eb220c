"""What a recorded palpation says: per site the surface, the depths reached, the moduli, and what the correction did.

Computed from the recording alone, so a live run, a replay and `palpd analyse` of the file give the same numbers.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from palpd.errors import RecordingError
from palpd.tick import Floats, Mode, Phase
from palpd.young import fit_contact, modulus_peak_Pa, ymbt

PEAK_WINDOW_S = 0.02
"""A peak is the largest mean of this long: the largest single sample would add two sigmas of noise to every force."""


@dataclass(frozen=True, slots=True)
class Track:
    """Every sensor frame of a recording with what the robot and the sequence did then; arrays of equal length (n,).

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
        """The frames for which `chosen` holds."""
        return Track(*(getattr(self, name)[chosen] for name in self.__slots__))


def track(rows: NDArray[np.void], delay_s: float, machine_stiffness_N_per_m: float = math.inf) -> Track:
    """Flatten the rows (ROW of palpd.tick) of a recording to one line per sensor frame."""
    filled = np.arange(rows["frame_t_s"].shape[1]) < rows["frames"][:, None]
    tick_of = np.repeat(np.arange(len(rows)), rows["frames"])
    t_s = rows["frame_t_s"][filled]
    fz_N = rows["tared"][filled][:, 2]
    robot_t_s, first = np.unique(rows["robot_t_s"], return_index=True)
    z_m = np.interp(t_s - delay_s, robot_t_s, rows["tcp_pose"][first, 2])
    return Track(
        t_s=t_s,
        tip_z_m=z_m + fz_N / machine_stiffness_N_per_m,
        fz_N=fz_N,
        inertial_N=rows["inertial_N"][filled],
        **{name: rows[name][tick_of] for name in ("phase", "mode", "site", "repeat", "depth_m", "surface_z_m", "cut_short", "zero_N")},
    )


def sites(rows: NDArray[np.void], header: dict[str, Any]) -> list[dict[str, Any]]:
    """One dictionary per site of the plan, with the keys of the command line's JSON. Absent figures are None."""
    body = header["body"]
    stiffness = body["machine_stiffness_N_per_m"] or math.inf
    whole = track(rows, body["delay_s"], stiffness)
    tip = (body["tip_radius_m"], body["poisson_ratio"])
    return [_site(whole.where(whole.site == index), site["name"], tip) for index, site in enumerate(header["sites"])]


def analysed(rows: NDArray[np.void], header: dict[str, Any]) -> list[dict[str, Any]]:
    """Per site the modulus of Hertz over the whole loading of its deepest press, contact point and force baseline free."""
    body = header["body"]
    whole = track(rows, body["delay_s"], body["machine_stiffness_N_per_m"] or math.inf)
    return [_loading(whole.where(whole.site == index), site["name"], body) for index, site in enumerate(header["sites"])]


def _loading(of_site: Track, name: str, body: dict[str, Any]) -> dict[str, Any]:
    pressed = of_site.where(np.isin(of_site.mode, (Mode.STATIC, Mode.DYNAMIC)) & np.isfinite(of_site.depth_m))
    nothing: dict[str, Any] = {"name": name, "youngs_modulus_Pa": None, "ci95_Pa": None, "contact_point_m": None}
    if not len(pressed.t_s):
        return nothing | {"warnings": ["nothing was pressed here"]}
    deepest = pressed.where(pressed.depth_m == pressed.depth_m.max())
    one = deepest.where((deepest.mode == deepest.mode[-1]) & (deepest.repeat == deepest.repeat[-1]))
    loading = one.where(np.isin(one.phase, (Phase.BASELINE, Phase.PRESS)))
    try:
        fit = fit_contact(loading.tip_z_m, loading.fz_N - loading.inertial_N, body["tip_radius_m"], body["poisson_ratio"])
    except RecordingError as error:
        return nothing | {"warnings": [str(error)]}
    return {
        "name": name,
        "youngs_modulus_Pa": fit.youngs_modulus_Pa,
        "ci95_Pa": list(fit.ci95_Pa),
        "contact_point_m": fit.contact_point_m,
        "baseline_N": fit.baseline_N,
        "depth_m": fit.depth_m,
        "warnings": list(fit.warnings),
    }


def _site(of_site: Track, name: str, tip: tuple[float, float]) -> dict[str, Any]:
    known = of_site.surface_z_m[np.isfinite(of_site.surface_z_m)]
    surface_z_m = float(known[-1]) if len(known) else None
    static = [_held(of_site, depth_m, tip) for depth_m in _depths(of_site, Mode.STATIC)]
    presses = [press for depth_m in _depths(of_site, Mode.DYNAMIC) for press in _presses(of_site, depth_m, tip)]
    static_E = _mean(depth["E_Pa"] for depth in static)
    original_E, corrected_E = (_mean(press[key] for press in presses) for key in ("original_Pa", "corrected_Pa"))
    pressed = of_site.where(np.isin(of_site.phase, (Phase.SEARCH, Phase.PRESS, Phase.HOLD, Phase.RETRACT)))
    contact_N = pressed.fz_N - pressed.inertial_N
    return {
        "name": name,
        "surface_z_m": surface_z_m,
        "static_youngs_modulus_Pa": static_E,
        "dynamic_original_Pa": original_E,
        "dynamic_corrected_Pa": corrected_E,
        "ymbt_original": ymbt(original_E, static_E) if original_E and static_E else None,
        "ymbt_corrected": ymbt(corrected_E, static_E) if corrected_E and static_E else None,
        "peak_force_N": float(contact_N.max()) if len(contact_N) else None,
        "correction_N": _mean(press["correction_N"] for press in presses),
        "running_zero_N": _mean(press["running_zero_N"] for press in presses),
        "cut_short": bool(of_site.cut_short.any()),
        "cut_short_depths_m": sorted({float(d) for d in of_site.depth_m[of_site.cut_short > 0]}),
        "depths": static,
        "presses": presses,
    }


def _held(of_site: Track, depth_m: float, tip: tuple[float, float]) -> dict[str, Any]:
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


def _presses(of_site: Track, depth_m: float, tip: tuple[float, float]) -> list[dict[str, Any]]:
    """Dynamic palpations to one depth: the paper's modulus at the force peak, as measured and with the inertial force taken out."""
    here = of_site.where((of_site.mode == Mode.DYNAMIC) & (of_site.depth_m == depth_m))
    found = []
    for repeat in np.unique(here.repeat):
        press = here.where((here.repeat == repeat) & np.isin(here.phase, (Phase.PRESS, Phase.RETRACT)))
        if len(press.t_s) < 3:
            continue
        width = max(1, round(PEAK_WINDOW_S / float(np.median(np.diff(press.t_s)))))
        window = np.ones(width) / width
        force_N, inertial_N, tip_z_m = (
            np.convolve(values, window, mode="valid") for values in (press.fz_N, press.inertial_N, press.tip_z_m)
        )
        peak = int(np.argmax(force_N))
        at_m = float(press.surface_z_m[-1] - tip_z_m[peak])
        if at_m <= 0:
            continue
        corrected_N = float(force_N[peak] - inertial_N[peak])
        found.append(
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
    return found


def _depths(of_site: Track, mode: Mode) -> list[float]:
    depths = of_site.depth_m[(of_site.mode == mode) & np.isfinite(of_site.depth_m)]
    return [float(depth) for depth in np.unique(depths)]


def _mean(values: Any) -> float | None:
    finite = [value for value in values if value is not None and math.isfinite(value)]
    return math.fsum(finite) / len(finite) if finite else None


def loop_figures(rows: NDArray[np.void]) -> dict[str, float | int]:
    """How the loop kept its rate: ticks, missed ticks, work and wake-up in µs."""
    ticking = rows[rows["phase"] != Phase.IDLE]
    if not len(ticking):
        return {"ticks": 0, "missed": 0}
    wakeup_us = (ticking["now_s"] - ticking["planned_s"]) * 1e6
    work_us = ticking["work_us"][1:] if len(ticking) > 1 else ticking["work_us"]
    return {
        "ticks": len(ticking),
        "missed": int(ticking["missed"].sum()),
        "work_us_p50": float(np.percentile(work_us, 50)),
        "work_us_p99": float(np.percentile(work_us, 99)),
        "wakeup_us_p50": float(np.percentile(wakeup_us, 50)),
        "wakeup_us_p99": float(np.percentile(wakeup_us, 99)),
    }


def machine_stiffness(rows: NDArray[np.void]) -> tuple[float, tuple[float, float]]:
    """Slope of force over reported travel against a rigid plate, N/m, with the 95 % interval over presses.

    Only the part above 1 N counts: below it mount and plate settle. Raises RecordingError.
    """
    whole = track(rows, 0.0)
    slopes = []
    for repeat in np.unique(whole.repeat[whole.repeat >= 0]):
        press = whole.where((whole.mode == Mode.STIFFNESS) & (whole.phase == Phase.PRESS) & (whole.repeat == repeat))
        loaded = np.convolve(press.fz_N, np.ones(50) / 50, mode="same") > 1.0
        press = press.where(loaded)
        if len(press.t_s) > 50:
            # 5 µm of noise on a travel of 0.1 mm would flatten a regression on travel by 4 %; time, which has none, is the instrument
            t_s = press.t_s - press.t_s.mean()
            slopes.append(-float((t_s @ press.fz_N) / (t_s @ press.tip_z_m)))
    if len(slopes) < 2 or min(slopes) <= 0:
        raise RecordingError(f"{len(slopes)} presses of a rigid plate can be judged, expected at least 2; repeat palpd stiffness")
    mean = math.fsum(slopes) / len(slopes)
    half = float(stdtrit(len(slopes) - 1, 0.975)) * float(np.std(slopes, ddof=1)) / math.sqrt(len(slopes))
    return mean, (mean - half, mean + half)
