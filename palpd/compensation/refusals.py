"""Refusals of recordings that an inertial model must not learn from: contact, clipping, different motions, another probe."""

from collections.abc import Sequence

import numpy as np

from palpd.compensation.cycles import Cycle, moving_average
from palpd.control.inertial import MASS_TOLERANCE_KG
from palpd.errors import BadInput, RecordingError
from palpd.recording.reader import Recording
from palpd.recording.samples import Samples

TOUCH_N = 0.3
TOUCH_WINDOW_S = 0.1
"""A mean over the window that is this far from the recording's median is contact: rounding moves it by 0.07 N, noise by 0.02 N."""
APART = 0.1
"""Share of the stroke by which repeats of one motion may differ: a servo repeats itself to a hundredth."""


def refuse_clipping(number: int, samples: Samples) -> None:
    """Refuse a recording whose force clips.

    A clipped signal piles up on its last level; noise that is rounded thins out towards it, to a tenth of the level before. With three
    levels or fewer the two look alike (a bias near half a count fills the last level too), so those pass.

    Args:
        number: Number of the recording, from 1.

    Raises:
        RecordingError: A force stands at its largest or smallest value too often.
    """
    for axis, force_N in zip("xyz", samples.wrench[:, :3].T, strict=True):
        for side, values in (("highest", -force_N), ("lowest", force_N)):
            levels, counts = np.unique(np.round(values, 9), return_counts=True)
            if len(levels) >= 4 and counts[0] > 0.05 * len(values) and counts[0] > 0.5 * counts[1]:
                first = int(np.argmin(values))
                raise RecordingError(
                    f"recording {number} clips: {counts[0]} of {len(values)} samples of f{axis}_N stand at its {side} value of "
                    f"{force_N[first]:.4g} N, first at t = {samples.t_s[first]:.3f} s; tare the sensor or check its range, and record again"
                )


def refuse_contact(number: int, samples: Samples, probe_mass_kg: float) -> None:
    """Refuse a recording with contact: free air has bias, noise and a little inertia; anything larger that lasts is a touch.

    Args:
        number: Number of the recording, from 1.

    Raises:
        RecordingError: The recording is too short, or something was touched.
    """
    width = max(1, round(TOUCH_WINDOW_S * samples.rate_Hz))
    if len(samples) <= 2 * width:
        raise RecordingError(
            f"recording {number} lasts {samples.duration_s:.2g} s, too short for free motion up and down; record for longer"
        )
    speed = moving_average(samples.vz_m_per_s, width)
    inertia_N = probe_mass_kg * float(np.abs(np.gradient(speed)).max()) * samples.rate_Hz
    for axis, force_N in zip("xyz", samples.wrench[:, :3].T, strict=True):
        away_N = np.abs(moving_average(force_N, width) - float(np.median(force_N)))
        allowed_N = TOUCH_N + (inertia_N if axis == "z" else 0.0)
        if float(away_N.max()) > allowed_N:
            at = int(np.argmax(away_N > allowed_N)) + width // 2
            raise RecordingError(
                f"recording {number} is not free: f{axis}_N is {float(away_N.max()):.2f} N away from its median, expected below "
                f"{allowed_N:.2f} N, first at t = {samples.t_s[at]:.2f} s (z = {samples.z_m[at]:.4f} m): the probe touched something "
                "or the sensor drifted; record it in free air with a warm sensor"
            )


def refuse_different(cycles: Sequence[Cycle], step_s: float) -> None:
    """Refuse cycles that are no repeats of one motion, because they are averaged.

    Args:
        cycles: The cycles of all recordings.
        step_s: Time between samples.

    Raises:
        RecordingError: A cycle moves differently.
    """
    height_m = np.array([cycle.z_m for cycle in cycles])
    usual_m = np.median(height_m, axis=0)
    allowed_m = APART * float(np.ptp(usual_m))
    apart_m = np.abs(height_m - usual_m)
    worst, at = np.unravel_index(int(np.argmax(apart_m)), apart_m.shape)
    if apart_m[worst, at] > allowed_m:
        cycle = cycles[int(worst)]
        raise RecordingError(
            f"recording {cycle.recording} moves differently in the cycle that begins at t = {cycle.start_s:.2f} s: "
            f"at t = {cycle.start_s + float(at) * step_s:.2f} s it is {apart_m[worst, at] * 1e3:.1f} mm away from the usual cycle, "
            f"expected below {allowed_m * 1e3:.1f} mm; train on repeats of one motion"
        )


def refuse_other_probe(recording: Recording, mass_kg: float) -> None:
    """Refuse a recording with a probe of another mass, if its header holds the mass.

    Args:
        mass_kg: Expected mass of the probe.

    Raises:
        BadInput: The masses differ.
    """
    recorded_kg = recording.header.get("config", {}).get("cell", {}).get("probe", {}).get("mass_kg", mass_kg)
    if abs(recorded_kg - mass_kg) > MASS_TOLERANCE_KG:
        raise BadInput(
            f"{recording.path.name} was recorded with a probe of {recorded_kg:g} kg, expected the {mass_kg:g} kg of cell.probe.mass_kg; "
            "what one reads beside the contact, another does not: record it with this probe"
        )
