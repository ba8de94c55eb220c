"""Commanded vertical motions with unequal cycles: presses, holds, and strokes that touch nothing."""

import numpy as np

from palpd.blind.mujoco.setup import Array, PressPath, StatedCell

GRID_S = 0.001
"""Time grid of a commanded motion: the finest physics step."""


def move(start_m: float, end_m: float, speed_m_per_s: float, acceleration_m_per_s2: float) -> Array:
    """A move with trapezoidal speed on the 1 ms grid, without its first row.

    Args:
        start_m: height at the beginning, m.
        end_m: height at the end, m.
        speed_m_per_s: largest speed, m/s.
        acceleration_m_per_s2: acceleration and deceleration, m/s².

    Returns:
        (n,) heights in m; the last one is `end_m`.
    """
    length = abs(end_m - start_m)
    top = min(speed_m_per_s, np.sqrt(length * acceleration_m_per_s2))
    ramp_s = top / acceleration_m_per_s2
    total_s = length / top + ramp_s
    t = np.minimum(np.arange(1, int(np.ceil(total_s / GRID_S)) + 1) * GRID_S, total_s)
    up = 0.5 * acceleration_m_per_s2 * np.minimum(t, ramp_s) ** 2
    cruise = top * np.clip(t - ramp_s, 0.0, total_s - 2 * ramp_s)
    late = np.clip(t - (total_s - ramp_s), 0.0, None)
    return start_m + np.sign(end_m - start_m) * (up + cruise + top * late - 0.5 * acceleration_m_per_s2 * late**2)


def draw_path(rng: np.random.Generator, cell: StatedCell, duration_s: float, force_N: float) -> PressPath:
    """A motion of about that length: every cycle has its own speeds, depth and hold.

    Args:
        cell: gives the surface, the tip and the press scatter.
        duration_s: length to reach, s; the last cycle may overrun it.
        force_N: force of the deepest press, N.

    Returns:
        The path with the scatter of its presses.
    """
    surface = cell.surface_z_m
    deepest = float(min((force_N / cell.hertz_N_per_m15) ** (2 / 3), 0.8 * cell.tip_radius_m))
    acceleration = float(np.exp(rng.uniform(np.log(0.08), np.log(0.6))))
    fast = float(np.exp(rng.uniform(np.log(0.008), np.log(0.04))))
    clearance = rng.uniform(0.004, 0.010)
    pieces, edges = [np.full(int(rng.uniform(0.6, 1.5) / GRID_S), surface + clearance)], []

    def travel(target: float, speed: float, dwell_s: float) -> None:
        pieces.append(move(float(pieces[-1][-1]), target, speed, acceleration))
        pieces.append(np.full(max(1, int(dwell_s / GRID_S)), target))

    presses = 0
    while (elapsed := sum(map(len, pieces)) * GRID_S) < duration_s - 2.0 or presses < 3:
        if presses:
            edges.append(elapsed)
        if rng.random() < 0.4:
            travel(surface + rng.uniform(0.015, 0.03), fast * rng.uniform(0.6, 1.5), rng.uniform(0.0, 0.6))
            travel(surface + rng.uniform(0.003, 0.010), fast * rng.uniform(0.6, 1.5), rng.uniform(0.1, 0.6))
        depth = deepest * (1.0 if presses == 1 else rng.uniform(0.4, 1.0))
        travel(surface - depth, fast * rng.uniform(0.15, 1.0), rng.uniform(0.2, 4.0))
        travel(surface + rng.uniform(0.004, 0.010), fast * rng.uniform(0.2, 1.0), rng.uniform(0.3, 1.5))
        presses += 1
    pieces.append(np.full(int(0.6 / GRID_S), pieces[-1][-1]))
    z: Array = np.concatenate(pieces)
    return PressPath(
        GRID_S * np.arange(len(z), dtype=np.float64),
        z,
        np.array(edges),
        cell.scatter_surface_z_m * rng.standard_normal(presses),
        cell.scatter_stiffness * rng.standard_normal(presses),
        deepest,
    )


def calibration_path(rng: np.random.Generator, surface_z_m: float, speed_m_per_s: float) -> PressPath:
    """A free up-and-down motion of some six seconds, as a user records it to identify the servo.

    Args:
        surface_z_m: the tip stays above this height, m.
        speed_m_per_s: usual speed of the strokes, m/s.

    Returns:
        The path; it has one press that never happens.
    """
    pieces = [np.full(300, surface_z_m + 0.01)]
    for height in (0.03, 0.015, 0.04, 0.01):
        speed = speed_m_per_s * rng.uniform(0.7, 1.5)
        pieces.append(move(float(pieces[-1][-1]), surface_z_m + height, speed, rng.uniform(0.15, 0.5)))
        pieces.append(np.full(500, surface_z_m + height))
    z: Array = np.concatenate(pieces)
    return PressPath(GRID_S * np.arange(len(z), dtype=np.float64), z, np.empty(0), np.zeros(1), np.zeros(1), 1e-4)
