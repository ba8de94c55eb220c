"""Healthy states and frames that tests start from and change one thing of."""

import math
from dataclasses import replace
from typing import Any

import numpy as np

from palpd.control.safety import Limits
from palpd.tick import PROGRAM_PLAYING, Contact, Observation, Progress, RobotMode, RobotState, SafetyMode, SensorFrames, Timing

LIMITS = Limits(
    contact_N=12.0,
    absolute_N=25.0,
    lateral_N=8.0,
    torque_Nm=1.0,
    max_speed_m_per_s=0.05,
    robot_stale_s=0.05,
    sensor_stale_s=0.05,
    max_missed_ticks=6,
    min_z_m=-0.1,
    workspace_m=((-0.5, 0.5), (-0.5, 0.5), (-0.2, 0.5)),
)


def robot(t_s: float = 10.0, z_m: float = 0.02, **changes: Any) -> RobotState:
    """An arm at rest, tool straight down, program playing."""
    pose = (0.0, 0.0, z_m, math.pi, 0.0, 0.0)
    still = (0.0,) * 6
    state = RobotState(t_s, t_s, pose, still, pose, still, (0.0,) * 3, RobotMode.RUNNING, SafetyMode.NORMAL, 1, PROGRAM_PLAYING, True)
    return replace(state, **changes)


def frames(t_s: float = 10.0, n: int = 8, seed: int = 0, **changes: Any) -> SensorFrames:
    """n healthy frames of 1 kHz that end at t_s, with noise."""
    rng = np.random.default_rng(seed)
    at = t_s - np.arange(n - 1, -1, -1) * 1e-3
    some = SensorFrames(at, np.arange(n).astype(np.uint16), np.zeros(n, np.uint16), rng.normal(0.0, 0.05, (n, 6)))
    return replace(some, **changes)


def contact(**changes: Any) -> Contact:
    """Nothing touched."""
    return replace(Contact(np.zeros((8, 6)), np.zeros(8)), **changes)


STEP = Progress(floor_z_m=-0.05, safe_z_m=0.03)
"""Bounds of a step in the tissue."""


def observation(now_s: float = 10.0, **changes: Any) -> Observation:
    """All well in free air at that time."""
    return Observation(Timing(0, now_s, now_s), robot(now_s), frames(now_s), contact())._replace(**changes)
