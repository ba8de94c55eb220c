"""The motion of the tip behind what the robot reports of it."""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d

from palpd.cell.cell_file import CellFile
from palpd.cell.dynamics import Floats, State, integral, servo, steps
from palpd.cell.lattice import lattice_step
from palpd.cell.report_times import Reports, find_reports
from palpd.cell.span import TipMotion

AVERAGED = 1.5
"""Rms that averaging of speeds may remove, in those of their noise, where no command says how fast the robot is."""
SAME_SPEED = 1e-4
"""Difference from the slope of the heights, as a share of the range, below which reported speeds are that slope and as rounded."""
SURE = 2.0
"""Ratio of rms to noise rms above which a speed or acceleration that the command does not explain is believed: two sigmas."""

CLEARLY_MOVING = 10.0
"""Speed at the first row over its error above which a recording starts in motion: noise at rest never reaches it."""


class StartingMotion(NamedTuple):
    """Height, speed and acceleration of the robot at the first row of a recording that starts in motion."""

    height_m: float
    speed_m_per_s: float
    acceleration_m_per_s2: float

    def at(self, after_s: float) -> State:
        """Height and speed a little after the first row."""
        gained_m_per_s = self.acceleration_m_per_s2 * after_s
        return self.height_m + (self.speed_m_per_s + 0.5 * gained_m_per_s) * after_s, self.speed_m_per_s + gained_m_per_s


def starting_motion(cell: CellFile, t_s: Floats, z_m: Floats, vz_m_per_s: Floats) -> StartingMotion | None:
    """How the robot moves at the first row, by a straight line through its speeds over the first quarter of the servo's period.

    What was commanded before the first row is unknown, so the servo starts as it was measured.

    Args:
        cell: The cell; its servo and the stated noise of its speeds are used.
        t_s: Times (n,) in s.
        z_m: Reported heights (n,) in m.
        vz_m_per_s: Reported speeds (n,).

    Returns:
        The motion; None where it starts at rest, to within noise, or where fewer than three rows lie in that time.
    """
    rows = int(np.searchsorted(t_s, t_s[0] + 0.25 / cell.robot.servo_natural_frequency_Hz))
    if rows < 3 or rows >= len(t_s):
        return None
    after_s, v = t_s[:rows] - t_s[0], vz_m_per_s[:rows]
    acceleration, speed = np.polyfit(after_s, v, 1).tolist()
    scatter = float(np.std(v - speed - acceleration * after_s))
    error = 2.0 * max(cell.robot.velocity_noise_rms_m_per_s, scatter) / rows**0.5  # of the end of a line
    if abs(speed) <= CLEARLY_MOVING * error:
        return None
    return StartingMotion(float(np.mean(z_m[:rows] - (speed + 0.5 * acceleration * after_s) * after_s)), speed, acceleration)


def estimate_tip_motion(
    cell: CellFile,
    t_s: Floats,
    z_m: Floats,
    vz_m_per_s: Floats | None = None,
    z_cmd_m: Floats | None = None,
    reports: Reports | None = None,
) -> TipMotion:
    """The motion of the tip behind noisy reports of height and speed.

    Heights and speeds are averaged over a quarter of the servo's period, short enough for it to do nothing quickly: of the
    heights only what the integrated speed does not already say. The acceleration is the slope of the speed over the fewest samples
    that keep its noise, times the mass, below a tenth of the sensor's, and never over more than that quarter.

    Where no commanded heights are given, the servo is unknown too: speeds and heights are then averaged only as far as that removes noise.
    Where they are given, all this is done to what the stated servo does not already say. Slopes may then be taken over half
    its period, and speeds and slopes are believed as far as they stand out of their noise (Wiener's filter, locally): else a filter that
    smooths the noise of a prediction would bring it nearer to the readings, and friction would feel a probe at rest that moves to and fro.

    Args:
        cell: The cell; its servo and the stated noise of its robot and sensor are used.
        t_s: Times (n,) in s.
        z_m: Reported heights (n,) in m.
        vz_m_per_s: Reported speeds (n,), or None to take them from the heights.
        z_cmd_m: Commanded heights (n,) in m, or None.
        reports: When the robot reported, or None to find it in the heights.

    Returns:
        The estimated motion (n,) with its remaining noise.
    """
    n = len(t_s)
    dt_s = float(np.median(np.diff(t_s)))
    half = min(int(0.125 / (cell.robot.servo_natural_frequency_Hz * dt_s)), (n - 1) // 2)
    if vz_m_per_s is None:
        vz_m_per_s = _slope(t_s, z_m, max(half, 1))
    if reports is None:
        reports = find_reports(t_s, z_m)
    each = reports.rows_each
    v_noise = _noise(cell.robot.velocity_noise_rms_m_per_s, reports.values(vz_m_per_s))
    z_noise = _noise(cell.robot.position_noise_rms_m, reports.values(z_m))
    if np.allclose(vz_m_per_s, np.gradient(z_m, t_s), rtol=0.0, atol=SAME_SPEED * float(np.ptp(vz_m_per_s))):
        v_noise = max(v_noise, lattice_step(z_m) / (12.0**0.5 * 2.0**0.5 * dt_s))
    if z_cmd_m is None:
        half = _half_that_removes_noise(vz_m_per_s, v_noise, half)
    widest = half
    if z_cmd_m is not None:
        moving = starting_motion(cell, t_s, z_m, vz_m_per_s)
        start = None if moving is None else moving.at(0.0)
        known = servo(z_cmd_m, steps(t_s), cell.robot.servo_natural_frequency_Hz, cell.robot.servo_damping_ratio, {}, start)
        z_m, vz_m_per_s = z_m - reports.join(known[0], t_s), vz_m_per_s - reports.join(known[1], t_s)
        widest = min(2 * half, (n - 1) // 2)
    width, allowed = 1, 0.1 * cell.sensor.noise_rms_N
    while width < widest and cell.probe.mass_kg * _slope_noise(v_noise, dt_s, width, each) > allowed:
        width += 1
    acceleration = _slope(t_s, vz_m_per_s, width)
    if half:
        path_m = integral(vz_m_per_s, t_s)
        z_m = path_m + uniform_filter1d(z_m - path_m, 2 * half + 1, mode="nearest")
        vz_m_per_s = uniform_filter1d(vz_m_per_s, 2 * half + 1, mode="nearest")
    span = 2 * half + 1
    left_m = np.hypot(z_noise / np.sqrt(span), v_noise * dt_s * np.sqrt((span - 1) / 12.0)) * np.sqrt(each)
    a_noise, acceleration_weight = _slope_noise(v_noise, dt_s, width, each), np.ones(n)
    if z_cmd_m is not None:
        acceleration_weight = _signal_share(acceleration, a_noise, 4 * half + 1)
        vz_m_per_s = known[1] + _signal_share(vz_m_per_s, v_noise * (each / span) ** 0.5, 4 * half + 1) * vz_m_per_s
        z_m, acceleration = z_m + known[0], known[2] + acceleration_weight * acceleration
    left_m_per_s2 = a_noise * float(np.sqrt(np.mean(acceleration_weight**2)))
    return TipMotion(t_s - t_s[0], z_m, vz_m_per_s, acceleration, float(left_m), left_m_per_s2, v_noise, width, acceleration_weight)


def _half_that_removes_noise(v: Floats, noise: float, half: int) -> int:
    """The largest number of neighbours on either side, at most `half`, over which averaging of speeds removes no more than noise."""
    while half and float(np.mean((v - uniform_filter1d(v, 2 * half + 1, mode="nearest")) ** 2)) > (AVERAGED * noise) ** 2:
        half //= 2
    return half


def _signal_share(x: Floats, noise: float, span: int) -> Floats:
    """The share of x that is not noise of the given rms, over `span` neighbours (Wiener's filter)."""
    square = uniform_filter1d(x**2, span, mode="nearest")
    share: Floats = np.clip(1.0 - (SURE * noise) ** 2 / np.maximum(square, 1e-300), 0.0, 1.0)
    return share


def _noise(stated: float, x: Floats) -> float:
    """Rms of the noise of a smooth signal: as stated, or less where less is there, but that of its rounding at least.

    What is white is seen in the second differences (median, so that corners do not count). Most of those of an encoder's steps are 0.
    """
    if len(x) < 8:
        return 0.0
    white = float(np.median(np.abs(np.diff(x, 2)))) / (0.6745 * np.sqrt(6.0))
    return max(min(stated, white), lattice_step(x) / np.sqrt(12.0))


def _slope_noise(noise: float, dt_s: float, half: int, each: float) -> float:
    """What white noise does to the slope that `_slope` takes, where straight lines of `each` samples join the noisy values."""
    if each > 1.0:
        return min(_slope_noise(noise * each**0.5, dt_s, half, 1.0), 2.0**0.5 * noise / (each * dt_s))
    return noise * float(np.linalg.norm(slope_weights(dt_s, half)))


def slope_weights(dt_s: float, half: int) -> Floats:
    """Weights of the neighbours in a measured slope.

    Args:
        dt_s: Step between samples.
        half: Neighbours on either side; below two the nearest ones are taken.

    Returns:
        Weights (2 half + 1,), or (3,), in 1/s.
    """
    if half < 2:
        return np.array([-0.5, 0.0, 0.5]) / dt_s
    k = np.arange(-half, half + 1.0)
    s2, s4, s6 = (float(np.sum(k**power)) for power in (2, 4, 6))
    return (s6 * k - s4 * k**3) / (s2 * s6 - s4**2) / dt_s


def _slope(t_s: Floats, x: Floats, half: int) -> Floats:
    """Slope of the cubic through 2·half + 1 neighbours (Savitzky, Golay 1964), below five of them of the line between the nearest.

    A jump of jerk bends a cubic little over a quarter of the servo's period. The first and last samples lie on the cubic through the
    first and last 2·half + 1.
    """
    half = min(half, (len(x) - 1) // 2)
    if half < 2:
        nearest: Floats = np.gradient(x, t_s)
        return nearest
    dt_s = steps(t_s)
    if not isinstance(dt_s, float):
        even_s = np.arange(t_s[0], t_s[-1] + 0.5 * dt_s[0], dt_s[0])
        uneven: Floats = np.interp(t_s, even_s, _slope(even_s, np.interp(even_s, t_s, x), half))
        return uneven
    k = np.arange(-half, half + 1.0)
    ends = [np.polynomial.Polynomial.fit(k, part, 3).deriv()(k) / dt_s for part in (x[: 2 * half + 1], x[-2 * half - 1 :])]
    inside = np.correlate(x, slope_weights(dt_s, half), "valid")
    return np.concatenate([ends[0][:half], inside, ends[1][half + 1 :]])
