"""Test cells with independent physics: MuJoCo moves a rig, this code presses it into tissue, and the truth is sealed.

One case is a recording and a cell.yaml as the contract (docs/reference/contract.md) asks, a second recording of the same cell on another
motion, and the truth: which effects act, how large they are (§5), and where they show. The same seed and specification give the same
case.

Rigs: a vertical slide, and a six-axis arm with the UR5's lengths and link masses. Five controllers: second order; its targets held at
125 or 500 Hz; a third pole; a jerk-limiting average. The stated servo is a second-order fit to a noisy free motion of the healthy cell.
Contact: Hertz from the contract's formula, applied by `xfrc_applied` at the tip; on a part of the slides the engine's own soft contact,
whose impedance is fitted so that it stays inside the tolerances of E and surface (the truth says which).

SNR: the contract says (§5) that tolerances are projected out. Then the listed effects that are the tolerances themselves (bias, drift,
gain, crosstalk, latency, filter, mass, modulus, surface) have none at any size. So `snr` takes every tolerance as normal with its
declared standard deviation (generalised least squares), and `snr_projected` beside it is the strict reading. A sigma is that of a
20 ms mean, from white noise and rounding.

How exact healthy cells are, their tolerances fitted (seed 1, cases 0 to 29, `healthy_mismatch` of the truth), rms in standard
deviations of one sample: z 0.02 to 0.45 (median 0.08), fz 0.002 to 0.11 (median 0.008), fx and ty at most 0.005. Most of z is the
third order, the jerk limit or the 125 Hz hold, which no second-order servo has, and the give of the position loops under load. Over a
whole recording this z is a signal-to-noise ratio of 1.3 to 68 (median 7.5): a judge of such cells needs a floor for it.

What MuJoCo cannot make, and what stands in its place:
- Hertz, thickness, inclusion, Mullins softening, adhesion and plasticity: the engine's contact has no memory and few shapes; own code.
- A force that a joint limit, a tendon or a joint's friction exerts on the probe is not in the force sensor (only contacts,
  `xfrc_applied` and connect constraints are); cables are therefore bodies of their own, connected to the probe.
- Implicit integration: the force sensor reads an acceleration that is then not integrated; the integrator is explicit Euler.
- Integral action of a real servo: the position loops are stiff instead, with armatures above a real UR5's.
- Sensor effects (clock, filter, hysteresis, creep, zero) have no primitive; own sensor model.
- Not made: `sensor.noise` and `sensor.quantization` (they have no noise-free change, hence no SNR); a leak from torque into fz (a
  healthy cell has no torque).
"""

from typing import Any

import numpy as np

from palpd.blind.detectability import COARSE_HZ, Detectability, nearest_law, scales_of
from palpd.blind.drawn_cases import by_place, second_rms
from palpd.blind.mujoco.cases import EFFECTS, MujocoCase, change_by, draw_case, healthy_mismatch, sealed_truth
from palpd.blind.mujoco.nominal import force_residual, phase_of
from palpd.blind.mujoco.snr import sizes
from palpd.blind.plans import VARIANCE
from palpd.blind.recorded_cells import detectability_of
from palpd.blind.stated_cell import CHANNELS, PHASES
from palpd.blind.truth import CannotDraw, CaseSpec, NearestLaw, SealedCase, SealedEffect, SecondMotion, TrueChange, Truth

__all__ = ["EFFECTS", "MujocoCase", "change_by", "draw_case", "draw_mujoco", "healthy_mismatch", "sealed_truth"]

LEAST_SNR = 3.6
"""Least signal-to-noise ratio of a planted effect; a motion that shows it less is drawn again."""
LARGEST_FORCE_MISMATCH = 3.0
"""Largest signal-to-noise ratio of what a healthy cell's forces leave with its tolerances fitted: a cell with more is not within
tolerance of its cell file, as the contract asks. The heights have no such bound: no real controller is the stated second order."""
CELLS_TRIED = 40
"""Number of cells that are tried for one specification."""
NEXT_CELL = 1_000_003
"""Step in the number of the cell from one trial to the next, so that no two specifications share a cell."""


def draw_mujoco(spec: CaseSpec, seed: int) -> SealedCase:
    """Draw a case with MuJoCo's physics. The same arguments give the same case.

    Args:
        spec: What the case shall be; its stratum is not used, the ratios are log-uniform over `SNR_RANGE`.
        seed: Seed of the check.

    Raises:
        CannotDraw: No cell shows the effects.
    """
    for attempt in range(CELLS_TRIED):
        case = draw_case(seed, spec.index + attempt * NEXT_CELL, spec.effects, spec.steps_over_noise)
        unfiltered = case.stated.filter_cutoff_Hz is None and "sensor.filter" in spec.effects
        shown = not unfiltered and all(each.reached_snr >= LEAST_SNR for each in case.planted)
        if shown and _within_tolerance(case):
            return _sealed(spec, case)
    raise CannotDraw(f"case {spec.index}: no cell within tolerance of its file shows {', '.join(spec.effects) or 'nothing'}")


def draw_healthy(seed: int, index: int) -> MujocoCase:
    """Draw a cell without effects, whose forces are within tolerance of its cell file.

    Args:
        seed: Seed of the check.

    Raises:
        CannotDraw: No cell is within tolerance.
    """
    for attempt in range(CELLS_TRIED):
        case = draw_case(seed, index + attempt * NEXT_CELL, effects=[])
        if _within_tolerance(case):
            return case
    raise CannotDraw(f"no cell {index} is within tolerance of its file")


def _within_tolerance(case: MujocoCase) -> bool:
    """Whether the forces of a cell without its effects are within tolerance of the cell file."""
    return bool(healthy_mismatch(case, case.yardstick())["snr_of_forces"] <= LARGEST_FORCE_MISMATCH)


def _sealed(spec: CaseSpec, case: MujocoCase) -> SealedCase:
    content, about = case.stated.as_yaml(), sealed_truth(case)
    healthy = case.reading([]).samples
    here = detectability_of(content, healthy, COARSE_HZ, noise_free=True)
    change = change_by(case, case.planted)
    effects = [_sealed_effect(effect, here) for effect in about.pop("effects")]
    mimic: NearestLaw | None = None
    true_change: TrueChange | None = None
    if spec.kind == "novel":
        effects[0]["statement"] = case.planted[0].effect.states(case.planted[0].values, case.stated)
        true_change = TrueChange(case.reading().samples, change)
        mimic = None if spec.extra else nearest_law(here, here.whitened(change), scales_of(here), spec.index)
    elif spec.kind == "foreign" and not effects[0]["variance"]:
        like = effects[0]["parameters"]
        effects[0]["nearest"] = nearest_law(here, here.whitened(change), scales_of(here), spec.index, only=effects[0]["id"], like=like)
    table = np.zeros((len(CHANNELS), len(PHASES)))
    for entry in sizes(change, phase_of(healthy, case.stated), case.yardstick()):
        table[CHANNELS.index(entry["channel"]), PHASES.index(entry["phase"])] = entry["size"]
    truth: Truth = {
        "source": "mujoco",
        "kind": spec.kind,
        "effects": effects,
        "host_causes": [],
        "without": [],
        "size": float(table.max()),
        "sizes": by_place(table),
        "rate_Hz": case.stated.rate_Hz,
        "robot_rate_Hz": min(case.stated.rate_Hz, case.stated.report_rate_Hz),
        "rows": len(healthy),
        "duration_s": healthy.duration_s,
        "mimic": mimic,
        "second": _second(case),
        "about": about,
    }
    return SealedCase(content, case.recording(), (), case.reading(other=True).samples, truth, true_change)


def _sealed_effect(effect: dict[str, Any], here: Detectability) -> SealedEffect:
    return {
        "id": effect["id"],
        "law": "library" if effect["law"] == "same" else effect["description"],
        "parameters": effect["parameters"],
        "snr": effect["snr"],
        "variance": effect["id"] in VARIANCE,
        "snr_per_row_sigma": effect["snr"] / here.rows_per_bin**0.5,
    }


def _second(case: MujocoCase) -> SecondMotion:
    path, stated = case.other_path, case.stated
    healthy = case.reading([], other=True).samples
    there = detectability_of(stated.as_yaml(), healthy, COARSE_HZ, noise_free=True)
    change = force_residual(case.reading(other=True).samples, stated, path) - force_residual(healthy, stated, path)
    return second_rms(there, change)
