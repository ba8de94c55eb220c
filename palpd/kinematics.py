"""The motion of the tip behind what the robot reports of it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid
from scipy.ndimage import uniform_filter1d
from scipy.signal import savgol_filter

from palpd.cell_file import CellFile
from palpd.dynamics import Floats, steps

CUBIC = 3

STRAIGHT = 0.01
"""Bends below this share of their rms are none: what is interpolated is straight to the last digits that were written."""


@dataclass(frozen=True, slots=True)
class Motion:
    """How the tip moved, in arrays of (n,), and what heights and accelerations still carry of measurement noise (rms)."""

    t_s: Floats
    z_m: Floats
    vz_m_per_s: Floats
    az_m_per_s2: Floats
    z_noise_m: float = 0.0
    az_noise_m_per_s2: float = 0.0


def reports(t_s: Floats, x: Floats) -> NDArray[np.intp]:
    """The samples (k,) at which a robot reported `x` (n,): all, or where it is slower than the sensor and its reports were joined by
    straight lines, those nearest to the corners, with the first and the last sample."""
    n = len(x)
    every = np.arange(n)
    bend = np.abs(np.diff(np.diff(x) / np.diff(t_s)))
    bent = bend > STRAIGHT * float(np.sqrt(np.mean(bend**2))) if n > 32 else np.ones(1, dtype=bool)
    if bent.mean() > 0.7 or not bent.any():
        return every
    first = np.flatnonzero(np.diff(bent.astype(np.int8), prepend=0) == 1)
    after = np.minimum(first + 1, n - 3)
    corners = np.where(bend[after] > bend[first], after, first) + 1  # a corner between two samples bends at both
    gap_s = np.diff(t_s[corners])
    usual_s = float(np.median(gap_s)) if len(gap_s) else 0.0
    tolerated_s = max(0.25 * usual_s, 1.1 * float(np.median(np.diff(t_s))))
    if len(gap_s) <= 8 or len(corners) > 0.7 * n or float(np.mean(np.abs(gap_s - usual_s) < tolerated_s)) < 0.8:
        return every
    return np.unique(np.concatenate([[0], corners, [n - 1]]))


def measured_motion(cell: CellFile, t_s: Floats, z_m: Floats, vz_m_per_s: Floats | None = None) -> Motion:
    """The motion behind noisy reports of height and speed; without reported speeds they are taken from the heights.

    Heights and speeds are averaged over a quarter of the servo's period, short enough for it to do nothing quickly: of the
    heights only what the integrated speed does not already say. The acceleration is the slope of the speed over the fewest samples
    that keep its noise, times the mass, below a tenth of the sensor's, and never over more than that quarter.
    """
    n = len(t_s)
    dt_s = float(np.median(np.diff(t_s)))
    half = min(int(0.125 / (cell.robot.servo_natural_frequency_Hz * dt_s)), (n - 1) // 2)
    if vz_m_per_s is None:
        vz_m_per_s = _slope(t_s, z_m, max(half, 1))
    reported = reports(t_s, z_m)
    each = n / len(reported)
    v_noise = min(cell.robot.velocity_noise_rms_m_per_s, _white_noise(vz_m_per_s[reported]))
    z_noise = min(cell.robot.position_noise_rms_m, _white_noise(z_m[reported]))
    width, allowed = 1, 0.1 * cell.sensor.noise_rms_N
    while width < half and cell.probe.mass_kg * _slope_noise(v_noise, dt_s, width, each) > allowed:
        width += 1
    acceleration = _slope(t_s, vz_m_per_s, width)
    if half:
        path_m = cumulative_trapezoid(vz_m_per_s, t_s, initial=0)
        z_m = path_m + uniform_filter1d(z_m - path_m, 2 * half + 1, mode="nearest")
        vz_m_per_s = uniform_filter1d(vz_m_per_s, 2 * half + 1, mode="nearest")
    span = 2 * half + 1
    left_m = np.hypot(z_noise / np.sqrt(span), v_noise * dt_s * np.sqrt((span - 1) / 12.0)) * np.sqrt(each)
    return Motion(t_s - t_s[0], z_m, vz_m_per_s, acceleration, float(left_m), _slope_noise(v_noise, dt_s, width, each))


def _white_noise(x: Floats) -> float:
    """Rms of what is white in a smooth signal, from its second differences (median, so that corners do not count)."""
    if len(x) < 8:
        return 0.0
    return float(np.median(np.abs(np.diff(x, 2)))) / (0.6745 * np.sqrt(6.0))


def _slope_noise(noise: float, dt_s: float, half: int, each: float) -> float:
    """What white noise does to the slope that `_slope` takes, where straight lines of `each` samples join the noisy values."""
    if each > 1.0:
        return min(_slope_noise(noise * each**0.5, dt_s, half, 1.0), 2.0**0.5 * noise / (each * dt_s))
    if half < 2:
        return noise / (dt_s * 2.0**0.5)
    k2 = np.arange(-half, half + 1.0) ** 2
    s2, s4, s6 = float(k2.sum()), float((k2**2).sum()), float((k2**3).sum())
    return float(noise / dt_s * np.sqrt(s6 / (s2 * s6 - s4**2)))


def _slope(t_s: Floats, x: Floats, half: int) -> Floats:
    """Slope of the cubic through 2·half + 1 neighbours (Savitzky, Golay 1964), below five of them of the line between the nearest."""
    half = min(half, (len(x) - 1) // 2)
    if half < 2:
        nearest: Floats = np.gradient(x, t_s)
        return nearest
    dt_s = steps(t_s)
    if not isinstance(dt_s, float):
        even_s = np.arange(t_s[0], t_s[-1] + 0.5 * dt_s[0], dt_s[0])
        uneven: Floats = np.interp(t_s, even_s, _slope(even_s, np.interp(even_s, t_s, x), half))
        return uneven
    slope: Floats = savgol_filter(x, 2 * half + 1, CUBIC, deriv=1, delta=dt_s, mode="interp")
    return slope
