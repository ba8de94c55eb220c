"""What a morning check measures: from its recordings to a dozen figures of one day.

One least squares over the dynamic presses gives the puck's stiffness and the delay of the force, one over the presses of the plate gives
the stiffness of the machine and its play. Both linearise the contact law f = k · (c - z)^p about the last estimate (Gauss-Newton).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpd.analysis.results import Track, track
from palpd.analysis.young import modulus_hertz_Pa
from palpd.errors import RecordingError
from palpd.recording.oddities import measured_rms
from palpd.recording.reader import Recording
from palpd.recording.tick_rows import filled_slots
from palpd.tick import Floats, Mode, Phase

HERTZ, LINEAR = 1.5, 1.0
"""Exponents of the force over depth: of a sphere on the puck, and of the machine that gives way behind the tip on a plate."""
SPEED_WINDOW_S = 0.04
"""Time over which a speed is taken: five reports of a UR5."""
BACK_M_PER_S = 0.001
"""Speed above which the tip goes back: half of that from the plate, and five times what noise of 5 µm makes over `SPEED_WINDOW_S`."""
STROKE_M_PER_S = 0.005
"""Speed above which a free stroke counts for friction: a quarter of its speed."""
PLATE_M_PER_S = 0.004
"""Speed below which a sample on the plate counts: presses are slower by far, and the last way up is as fast as the arm may be."""
ROUNDS, STEPS = 4, 8
"""Rounds in which play and delay take each other out, and Gauss-Newton steps of each fit."""
FEWEST = 200
"""Fewest samples of a fit: 0.2 s in contact."""
LEAST_SHARE, LARGEST_SHARE_BACK = 0.15, 0.7
"""Shares of the largest force between which a sample counts: below, the point of contact decides. On the way back, the play is not yet
taken up above."""


@dataclass(frozen=True, slots=True)
class DayFeatures:
    """What one check measured; None where there is no plate.

    Attributes:
        zero_N: Fz of the free probe at rest as the sensor reads it, in the sensor's axes.
        noise_N: Noise of a sample of fz at rest.
        drift_N_per_min: Drift of fz at rest after the tare.
        friction_N: Half of what fz differs by between strokes down and up in the air.
        puck_modulus_Pa: Modulus that the puck seems to have. The gain of the sensor changes it by the same share.
        delay_s: How late the force comes after the height, beyond the delay of the stated filter. What the puck relaxes by stands in it.
        plate_stiffness_N_per_m: Force over travel against the plate: that of arm, mount and sensor, by the gain of the sensor.
        play_m: Way back after a press of the plate on which the force stays.
        missed_ticks_percent: Ticks of the loop that were missed.
        lost_frames_percent: Samples of the sensor that did not arrive.
        repeated_states_percent: Ticks without a new state of the robot.
        tip_radius_m: Number of the configuration by which the modulus was computed; None in checks of older versions.
        poisson_ratio: The same.
    """

    zero_N: float
    noise_N: float
    drift_N_per_min: float
    friction_N: float
    puck_modulus_Pa: float
    delay_s: float
    plate_stiffness_N_per_m: float | None
    play_m: float | None
    missed_ticks_percent: float
    lost_frames_percent: float
    repeated_states_percent: float
    tip_radius_m: float | None = None
    poisson_ratio: float | None = None


def features_of(puck: Recording, plate: Recording | None) -> DayFeatures:
    """Measure one day.

    Args:
        puck: The palpation of the puck, with its free strokes.
        plate: The presses of the plate; None where there is none.

    Raises:
        RecordingError: Something was not recorded.
    """
    body = puck.header["body"]
    tracks = [track(each.rows, body["delay_s"]) if each is not None else None for each in (puck, plate)]
    assert tracks[0] is not None
    return measured(tracks[0], tracks[1], link_figures(puck.rows), body["tip_radius_m"], body["poisson_ratio"])


def measured(puck: Track, plate: Track | None, link: Mapping[str, float], tip_radius_m: float, poisson_ratio: float) -> DayFeatures:
    """Measure one day from the frames of its recordings, whose heights are as reported.

    Args:
        puck: Frames of the palpation of the puck.
        plate: Frames of the presses of the plate; None where there is none.
        link: Zero, loop and links, as `link_figures` gives them.
        tip_radius_m: Radius of the spherical tip.
        poisson_ratio: Poisson's ratio of the puck.

    Raises:
        RecordingError: Something was not recorded.
    """
    rest = puck.where(puck.phase == Phase.BASELINE)
    pressed = puck.where((puck.mode == Mode.DYNAMIC) & np.isin(puck.phase, (Phase.BASELINE, Phase.PRESS, Phase.RETRACT)))
    strokes = puck.where(puck.phase == Phase.FREE_MOTION)
    if min(len(rest.t_s), len(pressed.t_s), len(strokes.t_s)) < FEWEST:
        raise RecordingError(
            f"the check has {len(rest.t_s)} samples at rest, {len(pressed.t_s)} of presses and {len(strokes.t_s)} of free strokes, "
            f"expected at least {FEWEST} of each; repeat palpd check"
        )
    surface_m = float(pressed.surface_z_m[-1])
    fit = _Fit(pressed, HERTZ, surface_m)
    plate_fit = _fit_of_plate(plate) if plate is not None else None
    delay_s, play_m, stiffness = 0.0, None, None
    for _ in range(ROUNDS if plate_fit is not None else 1):
        k, delay_s = fit.solved(play_m or 0.0)
        if plate_fit is not None:
            stiffness, play_m = plate_fit.solved_with_play(delay_s)
    speed = _speed(strokes)
    down, up = (strokes.fz_N[sign * speed > STROKE_M_PER_S] for sign in (-1.0, 1.0))
    slope_N_per_s = float(np.polyfit(rest.t_s - rest.t_s[0], rest.fz_N, 1)[0])
    return DayFeatures(
        noise_N=measured_rms(rest.fz_N),
        drift_N_per_min=60.0 * slope_N_per_s,
        friction_N=0.5 * float(down.mean() - up.mean()),
        puck_modulus_Pa=modulus_hertz_Pa(k, 1.0, tip_radius_m, poisson_ratio),
        delay_s=delay_s,
        plate_stiffness_N_per_m=stiffness,
        play_m=play_m,
        tip_radius_m=tip_radius_m,
        poisson_ratio=poisson_ratio,
        **link,
    )


def link_figures(rows: NDArray[np.void]) -> dict[str, float]:
    """Zero, loop and links of a recording, by their names in `DayFeatures`.

    Args:
        rows: Ticks (n,), with the fields of ROW of palpd.tick.

    Raises:
        RecordingError: No tare was recorded.
    """
    filled = filled_slots(rows)
    taring = filled & (rows["phase"] == Phase.TARE)[:, None]
    if not taring.any():
        raise RecordingError("the recording holds no tare, and the zero is measured there; record it with palpd check")
    counters = rows["counter"][filled].astype(np.int64)
    due = int((np.diff(counters) & 0xFFFF).sum()) + 1
    missed = int(rows["missed"].sum())
    return {
        "zero_N": float(rows["wrench"][taring][:, 2].mean()),
        "missed_ticks_percent": 100.0 * missed / (len(rows) + missed),
        "lost_frames_percent": 100.0 * max(0.0, 1.0 - len(counters) / due),
        "repeated_states_percent": 100.0 * float(np.mean(np.diff(rows["robot_t_s"]) <= 0.0)),
    }


def _speed(frames: Track) -> Floats:
    """Speed (n,) of the tip, over `SPEED_WINDOW_S`."""
    half_s = 0.5 * SPEED_WINDOW_S
    ahead, behind = (np.interp(frames.t_s + sign * half_s, frames.t_s, frames.tip_z_m) for sign in (1.0, -1.0))
    return np.asarray((ahead - behind) / SPEED_WINDOW_S)


def _fit_of_plate(plate: Track) -> "_Fit":
    """The presses of the plate, without the way back from the search: it begins at a smaller force, which the play holds for a while."""
    from_search = (plate.repeat == 0) & (plate.phase == Phase.RETRACT)
    on_plate = plate.where((plate.mode == Mode.STIFFNESS) & (plate.repeat >= 0) & ~from_search)
    known = on_plate.surface_z_m[np.isfinite(on_plate.surface_z_m)]
    if len(known) < FEWEST:
        raise RecordingError(f"the plate was pressed in {len(known)} samples, expected at least {FEWEST}; repeat palpd check")
    return _Fit(on_plate, LINEAR, float(known[-1]))


class _Fit:
    """Least squares of f = k · (c - z)^p over presses, with delay or play as a further unknown."""

    def __init__(self, frames: Track, power: float, surface_m: float) -> None:
        self._z_m, self._power, self._speed = frames.tip_z_m, power, _speed(frames)
        in_air = (frames.tip_z_m > surface_m + 2e-4) & (frames.phase == Phase.BASELINE)
        self._force_N = frames.fz_N - frames.inertial_N - float(frames.fz_N[in_air].mean() if in_air.any() else 0.0)
        largest_N = float(np.percentile(self._force_N, 99))
        back = (self._speed > BACK_M_PER_S) & (self._force_N > LARGEST_SHARE_BACK * largest_N)
        fast = np.abs(self._speed) > (PLATE_M_PER_S if power == LINEAR else math.inf)
        self._counts = (self._force_N > LEAST_SHARE * largest_N) & ~back & ~fast
        if int(self._counts.sum()) < FEWEST:
            raise RecordingError(f"{int(self._counts.sum())} samples were in contact, expected at least {FEWEST}; repeat palpd check")
        self._surface_m = surface_m

    def solved(self, play_m: float) -> tuple[float, float]:
        """Stiffness in N/m^p and the delay in s, where the play is known."""
        back_m = np.where(self._speed > BACK_M_PER_S, play_m, 0.0)
        k, delay_s = self._gauss_newton(self._z_m - back_m, self._speed)
        return k, delay_s

    def solved_with_play(self, delay_s: float) -> tuple[float, float]:
        """Stiffness in N/m^p and the play in m, where the delay is known."""
        return self._gauss_newton(self._z_m - delay_s * self._speed, (self._speed > BACK_M_PER_S).astype(float))

    def _gauss_newton(self, tip_m: Floats, carried: Floats) -> tuple[float, float]:
        """Stiffness, and what multiplies `carried` (n,): the tip is at `tip_m` less that."""
        z_m, along, force_N = tip_m[self._counts], carried[self._counts], self._force_N[self._counts]
        contact_m, amount = self._surface_m, 0.0
        least_m = -math.inf if self._power == LINEAR else 1e-6  # samples in contact whose depth the last estimate has wrong still count
        depth_m = np.maximum(contact_m - z_m, least_m)
        k = float(force_N @ depth_m**self._power / (depth_m**self._power @ depth_m**self._power))
        for _ in range(STEPS):
            depth_m = np.maximum(contact_m - z_m + amount * along, least_m)
            shape = depth_m**self._power
            slope = k * self._power * depth_m ** (self._power - 1.0)
            columns = np.column_stack([shape, slope, slope * along])
            change = np.linalg.lstsq(columns, force_N - k * shape, rcond=None)[0]
            k, contact_m, amount = k + float(change[0]), contact_m + float(change[1]), amount + float(change[2])
        if not (k > 0.0 and math.isfinite(k)):
            raise RecordingError("the presses show no stiffness; look at the recording with palpd report, and repeat palpd check")
        return k, amount
