"""Two zeros: the running tare at the start of every run, and the reference tare of the last calibration.

The running tare removes gravity and offset from the wrench (f_g of Guo, Xiao, Ren 2019, eq. 2). `palpd calibrate` stores the reference
tare on disk. The guard's absolute limit refers to it, so a tare under load cannot loosen that limit.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from palpd.tick import Floats, RobotState, SensorFrames

DURATION_S = 1.0
"""Length of a tare: white noise of 0.05 N then leaves 2 mN on the mean at 1 kHz."""
STILL_M_PER_S = 0.002
"""Largest speed of an arm at rest, above the noise of reported speeds (0.2 mm/s rms)."""
STABLE_RMS_N = 0.5
"""Largest spread within a tare: ten times this sensor's noise (0.05 N rms, one count 0.13 N); beyond it something moves the probe."""
DRIFT_N = 0.2
"""Largest change of the mean between the halves of a tare."""

LINEAR = slice(3)
"""The linear part of a wrench, a speed or a pose."""

Rotation = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
"""Three rows of a rotation matrix, as plain floats: every tick computes one."""


def base_from_sensor(rotation_vector_rad: tuple[float, ...], about_flange_z_rad: float) -> Rotation:
    """Compute the rotation from the sensor's axes to the base's: the TCP orientation times the mounting angle (Rodrigues' formula).

    Args:
        rotation_vector_rad: axis-angle vector (3,) of a UR pose.

    Returns:
        Rotation matrix (3, 3) as rows.
    """
    x, y, z, s, c = _axis(rotation_vector_rad)
    v = 1.0 - c
    sm, cm = math.sin(about_flange_z_rad), math.cos(about_flange_z_rad)
    ax, bx, dx = c + x * x * v, x * y * v - z * s, x * z * v + y * s  # where the tool's three axes point, row by row
    ay, by, dy = y * x * v + z * s, c + y * y * v, y * z * v - x * s
    az, bz, dz = z * x * v - y * s, z * y * v + x * s, c + z * z * v
    return (
        (ax * cm + bx * sm, bx * cm - ax * sm, dx),
        (ay * cm + by * sm, by * cm - ay * sm, dy),
        (az * cm + bz * sm, bz * cm - az * sm, dz),
    )


def tilt_rad(rotation_vector_rad: tuple[float, ...]) -> float:
    """Return the angle between the tool's z axis and the base's -z."""
    x, y, z, s, c = _axis(rotation_vector_rad)
    v = 1.0 - c
    return math.atan2(math.hypot(x * z * v + y * s, y * z * v - x * s), -(c + z * z * v))


def _axis(rotation_vector_rad: tuple[float, ...]) -> tuple[float, float, float, float, float]:
    """The axis of a rotation, and the sine and cosine of its angle."""
    rx, ry, rz = rotation_vector_rad
    angle = math.hypot(rx, ry, rz)
    scale = 1.0 / angle if angle > 1e-12 else 0.0
    return rx * scale, ry * scale, rz * scale, math.sin(angle), math.cos(angle)


def to_base(wrench: Sequence[float], zero: Sequence[float], rotation: Rotation) -> list[float]:
    """Remove the zero from a wrench and rotate it into base axes.

    Args:
        wrench: wrench (6,) in the sensor's axes.
        zero: its zero (6,).
        rotation: rotation matrix (3, 3) from `base_from_sensor`.

    Returns:
        Wrench (6,) in base axes.

    Raises:
        ValueError: Wrench and zero differ in length.
    """
    if len(wrench) != len(zero):
        raise ValueError(f"a wrench of {len(wrench)} numbers is longer or shorter than its zero of {len(zero)}")
    fx, fy, fz, tx, ty, tz = wrench
    fx0, fy0, fz0, tx0, ty0, tz0 = zero
    fx, fy, fz, tx, ty, tz = fx - fx0, fy - fy0, fz - fz0, tx - tx0, ty - ty0, tz - tz0
    (ax, bx, cx), (ay, by, cy), (az, bz, cz) = rotation
    return [
        ax * fx + bx * fy + cx * fz, ay * fx + by * fy + cy * fz, az * fx + bz * fy + cz * fz,
        ax * tx + bx * ty + cx * tz, ay * tx + by * ty + cy * tz, az * tx + bz * ty + cz * tz,
    ]  # fmt: skip


@dataclass(slots=True)
class Tare:
    """Collects frames of a still, free probe for `DURATION_S`; `refusal` says why they are no tare."""

    _wrenches: list[Floats] = field(default_factory=list)
    _first_s: float = float("nan")
    _last_s: float = float("nan")
    _fastest_m_per_s: float = 0.0

    def add(self, robot: RobotState, frames: SensorFrames) -> bool:
        """Take in the data of one tick.

        Args:
            robot: newest state of the robot.
            frames: the frames since the last tick.

        Returns:
            Whether the tare is long enough.
        """
        if len(frames):
            if not self._wrenches:
                self._first_s = float(frames.t_s[0])
            self._wrenches.append(frames.wrench)
            self._last_s = float(frames.t_s[-1])
        speed = max(abs(v) for v in robot.tcp_speed[LINEAR])
        self._fastest_m_per_s = max(self._fastest_m_per_s, speed)
        return self._last_s - self._first_s >= DURATION_S

    def result(self) -> Floats:
        """Return the mean wrench (6,) in the sensor's axes."""
        return np.mean(np.concatenate(self._wrenches), axis=0)

    @property
    def varies(self) -> bool:
        """Whether any axis has moved by a count: a sensor that is stuck sends the same numbers for ever."""
        return bool(np.ptp(np.concatenate(self._wrenches), axis=0).any())

    def refusal(self) -> str | None:
        """Say in one sentence why these frames are no tare, else None: the arm moved, the force varied or drifted."""
        if not self._wrenches:
            return "no frame came from the force sensor during the tare; check its cable and power"
        forces_N = np.concatenate(self._wrenches)[:, LINEAR]
        spread = float(forces_N.std(axis=0).max())
        early, late = np.array_split(forces_N, 2)
        drift = float(np.abs(late.mean(axis=0) - early.mean(axis=0)).max()) if len(late) else 0.0
        if self._fastest_m_per_s > STILL_M_PER_S:
            return (
                f"the arm moved at {self._fastest_m_per_s * 1e3:.1f} mm/s during the tare, expected below "
                f"{STILL_M_PER_S * 1e3:g} mm/s; let it come to rest"
            )
        if spread > STABLE_RMS_N:
            return (
                f"the force varied by {spread:.2f} N rms during the tare, expected below {STABLE_RMS_N:g} N; "
                "is something touching or shaking the probe?"
            )
        if drift > DRIFT_N:
            return f"the force moved by {drift:.2f} N during the tare, expected below {DRIFT_N:g} N; let the sensor warm up"
        return None
