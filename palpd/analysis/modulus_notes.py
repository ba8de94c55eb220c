"""What makes the moduli of a table doubtful, although every press came to its end: sentences for a run, its report and `palpd info`."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpd.analysis.modulus_intervals import mean_sigma_N
from palpd.analysis.results import SiteResult, Track, peak_width, track
from palpd.analysis.young import equation_1_notes
from palpd.control.surface import FEWEST_SAMPLES
from palpd.recording.header import RecordingHeader
from palpd.tick import Mode, Phase

LIGHT_N = 0.6
"""Force at which the contacts of a search and of a press are compared: above the noise, and below the 1 N that end a search."""
FELT_N = 0.2
"""Force of a press above which a share of it means something: four times the noise of one reading."""
AIR_PARTS = 5
"""The first of as many parts of a way down is in the air: presses begin well above the surface."""
MOST_OFF = 0.1
"""Share of a modulus by which a moved contact may change it without a word: speed and preconditioning change tissue by less."""
CLEAR_M = 0.001
"""Height above the surface from which the tip is in the air for certain: no tissue clings or bulges so far."""
SOFT_MACHINE_N_PER_M = 1e4
"""An arm and a mount that give way much: the softest machine that `palpd stiffness` keeps."""
MOST_PULLED = 0.05
"""Share of a force that a cable may pull without a word: about the accuracy of a modulus."""
STEADY_SHARE, STEADY_N = 0.01, 0.02
"""A force that moves by less than this share of itself, or less than this, within a hold is steady: sensors creep by 0.5 %."""
STEADY_SIGMAS = 4.0
"""Standard deviations of its own noise beyond which a force moves."""


def modulus_notes(rows: NDArray[np.void], header: RecordingHeader) -> list[str]:
    """Say what makes the moduli doubtful.

    Args:
        rows: Ticks, with the fields of ROW of palpd.tick.

    Returns:
        One sentence where Poisson's ratio is not 0.5. For each site one where its presses met the tissue elsewhere than its search, where
        the force changed on the way through the air, where it still moved while it was held, and where it was not 0 at rest and no model
        follows that.
    """
    body = header["body"]
    whole = track(rows, body["delay_s"], body["machine_stiffness_N_per_m"] or math.inf)
    notes = equation_1_notes(
        body["poisson_ratio"], "the moduli of this table are by equation 1 of the paper, which is", ", as palpd analyse says"
    )
    for index, site in enumerate(header["sites"]):
        of_site, name = whole.where(whole.site == index), site["name"]
        slope_N_per_m = _slope_in_the_air_N_per_m(of_site)
        notes += [*_moved(of_site, name, slope_N_per_m), *_pulled(of_site, name, slope_N_per_m), *_unsteady(of_site, name)]
        notes += [] if header.get("model_card") else _off_zero(of_site, name)
    return notes


def give_notes(sites: Sequence[SiteResult], machine_stiffness_N_per_m: float | None) -> list[str]:
    """Say what an unmeasured stiffness of the machine may do to the moduli of a real cell; a simulated one is rigid.

    Args:
        sites: Results of a run.
        machine_stiffness_N_per_m: What it counted with; None: nobody measured it.

    Returns:
        One sentence, or none where the stiffness is known or would change no modulus by much.
    """
    if machine_stiffness_N_per_m is not None:
        return []
    holds = [(hold["force_N"] or 0.0, hold["commanded_m"]) for site in sites for hold in site["depths"]]
    peaks = [(press["original_N"] - press["correction_N"], press["commanded_m"]) for site in sites for press in site["presses"]]
    share = max((1.5 * force_N / SOFT_MACHINE_N_PER_M / depth_m for force_N, depth_m in holds + peaks), default=0.0)
    if share < MOST_PULLED:
        return []
    return [
        f"how far arm, mount and sensor give way is not measured, so they count as rigid: at {SOFT_MACHINE_N_PER_M / 1e3:g} N for 1 mm a "
        f"modulus of this run would be {share:.0%} too low, at ten times that {share / 10.0:.1%}; put a rigid plate under the probe and "
        "run palpd stiffness"
    ]


def _slope_in_the_air_N_per_m(of_site: Track) -> float:
    """How fast the force falls with height while the search is still in the air; 0 where that was too short."""
    searched = of_site.where((of_site.mode == Mode.SEARCH) & (of_site.phase == Phase.SEARCH))
    air = searched.where(searched.tip_z_m > of_site.surface_z_m[-1:] + CLEAR_M)
    if len(air.t_s) < FEWEST_SAMPLES:
        return 0.0
    height_m = air.tip_z_m - air.tip_z_m.mean()
    return -float(height_m @ (air.fz_N - air.inertial_N)) / float(height_m @ height_m)


def _moved(of_site: Track, name: str, slope_N_per_m: float) -> list[str]:
    searched = of_site.where(of_site.mode == Mode.SEARCH)
    met_m = _light_contact_m(searched, Phase.SEARCH, slope_N_per_m)
    if met_m is None:
        return []
    moves = []
    pressed = of_site.where(np.isin(of_site.mode, (Mode.STATIC, Mode.DYNAMIC)) & np.isfinite(of_site.depth_m))
    for mode, depth_m, repeat in np.unique(np.column_stack([pressed.mode, pressed.depth_m, pressed.repeat]), axis=0):
        press = pressed.where((pressed.mode == mode) & (pressed.depth_m == depth_m) & (pressed.repeat == repeat))
        again_m = _light_contact_m(press, Phase.PRESS, slope_N_per_m)
        if again_m is not None:
            moves.append((max(1.0 + (again_m - met_m) / float(depth_m), 0.0) ** 1.5 - 1.0, again_m - met_m))
    share, moved_m = max(moves, key=lambda one: abs(one[0]), default=(0.0, 0.0))
    if abs(share) < MOST_OFF:
        return []
    return [
        f"site {name}: a press reached {LIGHT_N:g} N {abs(moved_m) * 1e3:.2g} mm {'higher' if moved_m > 0.0 else 'lower'} than the search "
        "did: the surface has moved, the tissue has changed, or the sensor lags. Depths count from the surface of the search, so a modulus "
        f"of this site may be off by {abs(share):.0%}; palpd analyse finds the contact of its deepest press itself"
    ]


def _pulled(of_site: Track, name: str, slope_N_per_m: float) -> list[str]:
    presses = _deepest(of_site, (Mode.STATIC, Mode.DYNAMIC))
    shares = [(slope_N_per_m * one.travel_m / one.force_N, one.force_N, one.depth_m) for one in presses]
    share, force_N, depth_m = max(shares, key=lambda one: abs(one[0]), default=(0.0, 0.0, 0.0))
    if abs(share) < MOST_PULLED:
        return []
    return [
        f"site {name}: on its way down through the air the force {'rose' if share > 0.0 else 'fell'} by {abs(slope_N_per_m) * 1e-3:.2g} N "
        f"for each mm: a cable pulls, or the zero drifts. That is {abs(share):.0%} of the {force_N:.2g} N at {depth_m * 1e3:g} mm, and the "
        "modulus may be off by as much; palpd diagnose tells which"
    ]


def _off_zero(of_site: Track, name: str) -> list[str]:
    shares = [(one.rest_N / (one.force_N + one.rest_N), one.rest_N) for one in _deepest(of_site, (Mode.DYNAMIC,))]
    share, rest_N = max(shares, key=lambda one: abs(one[0]), default=(0.0, 0.0))
    if abs(share) < MOST_OFF:
        return []
    return [
        f"site {name}: at rest in the air before its dynamic presses the force was {rest_N:+.2f} N, expected 0 after the tare, and no "
        f"inertial model follows that: a dynamic modulus may be off by {abs(share):.0%}. Let the sensor warm up, or train a model"
    ]


class _Deepest(NamedTuple):
    """The deepest point of the presses to one depth: force above that at rest before them, and the way from there."""

    depth_m: float
    force_N: float
    rest_N: float
    travel_m: float


def _deepest(of_site: Track, modes: tuple[Mode, ...]) -> list[_Deepest]:
    """One for each depth whose force stands out of the noise."""
    deepest = []
    pressed = of_site.where(np.isin(of_site.mode, modes) & np.isfinite(of_site.depth_m))
    for depth_m in np.unique(pressed.depth_m):
        press = pressed.where(pressed.depth_m == depth_m)
        rest, at = press.where(press.phase == Phase.BASELINE), int(np.argmin(press.tip_z_m))
        if len(rest.t_s) and (force_N := float(press.fz_N[at] - rest.fz_N.mean())) > FELT_N:
            travel_m = float(rest.tip_z_m.mean() - press.tip_z_m[at])
            deepest.append(_Deepest(float(depth_m), force_N, float(rest.fz_N.mean()), travel_m))
    return deepest


def _unsteady(of_site: Track, name: str) -> list[str]:
    changes = []
    held = of_site.where((of_site.mode == Mode.STATIC) & (of_site.phase == Phase.HOLD))
    for depth_m in np.unique(held.depth_m):
        hold = held.where(held.depth_m == depth_m)
        t_s, mean_N = hold.t_s - hold.t_s.mean(), float(hold.fz_N.mean())
        if len(t_s) < FEWEST_SAMPLES:
            continue
        slope = float(t_s @ hold.fz_N) / float(t_s @ t_s)
        held_s = float(t_s[-1] - t_s[0])
        change_N = slope * held_s
        noise_N = math.sqrt(12.0) * mean_sigma_N(hold.fz_N - mean_N - slope * t_s)  # of a line's rise over the whole of it
        if abs(change_N) > max(STEADY_SHARE * abs(mean_N), STEADY_N, STEADY_SIGMAS * noise_N):
            changes.append((abs(change_N / mean_N), change_N, depth_m, held_s))
    if not changes:
        return []
    share, change_N, depth_m, held_s = max(changes)
    cause = "the tissue relaxes, and its modulus at rest is lower" if change_N < 0.0 else "the sensor creeps or drifts, or the arm sinks"
    return [
        f"site {name}, static {depth_m * 1e3:g} mm: the force still {'fell' if change_N < 0.0 else 'rose'} by {abs(change_N):.2g} N "
        f"({share:.1%}) within the hold of {held_s:.2g} s, expected at most {STEADY_SHARE:.0%}: {cause}. The static modulus is that of "
        "this hold; hold longer (hold_s), and compare equal holds only"
    ]


def _light_contact_m(press: Track, phase: Phase, slope_N_per_m: float) -> float | None:
    """Height of the tip on one way down below which the force stays LIGHT_N above that in the air; None where it does not."""
    down = press.where(press.phase == phase)
    if len(down.t_s) < FEWEST_SAMPLES:
        return None
    width = min(peak_width(down.t_s), len(down.t_s))
    force_N, tip_z_m = (
        np.convolve(values, np.full(width, 1.0 / width), mode="valid")
        for values in (down.fz_N - down.inertial_N + slope_N_per_m * down.tip_z_m, down.tip_z_m)
    )
    light = np.flatnonzero(force_N < float(np.median(force_N[: 1 + len(force_N) // AIR_PARTS])) + LIGHT_N)
    return float(tip_z_m[light[-1]]) if len(light) and light[-1] < len(force_N) - 1 else None
