"""Robot and tip: how the reported height follows the commanded one, and where the tip is when the robot reports z."""

from math import inf, pi

import numpy as np

from palpd.cell.dynamics import Memory, play
from palpd.cell.effects.effect import DEAD_BAND, LOAD, Effect, Parameter, Values, of
from palpd.cell.span import Constants, Span


def _lag(c: Constants, p: Values) -> None:
    c.servo_natural_frequency_Hz *= p["bandwidth_ratio"]
    c.servo_damping_ratio = p.get("damping_ratio", c.servo_damping_ratio)


LAG = Effect(
    "robot.lag",
    "robot",
    "the robot follows its command faster or slower than stated: its height runs ahead, lags behind or overshoots",
    (
        Parameter("bandwidth_ratio", "1", 0.02, 5.0, (0.7, 0.4, 1.5), nominal=1.0, log=True, words="bandwidth over the stated one"),
        Parameter("damping_ratio", "1", 0.1, 5.0, (0.7,), nominal=None, log=True, optional=True),
    ),
    setting=_lag,
    tolerance="servo_natural_frequency",
    motion=True,
    formula="z follows z_cmd as z'' = ω² · (z_cmd - z) - 2 · damping_ratio · ω · z', with ω = bandwidth_ratio · ω_stated",
)


def _vibration(s: Span, p: Values, _memory: Memory) -> None:
    omega = 2.0 * pi * p["frequency_Hz"]
    angle = omega * s.t_s + p["phase_rad"]
    swing_m = p["amplitude_m"] * np.sin(angle)
    s.z_m = s.z_m + swing_m
    s.vz_m_per_s = s.vz_m_per_s + omega * p["amplitude_m"] * np.cos(angle)
    s.az_m_per_s2 = s.az_m_per_s2 - omega**2 * swing_m


VIBRATION = Effect(
    "robot.vibration",
    "robot",
    "the robot vibrates: its height swings to and fro at one frequency",
    (
        Parameter("amplitude_m", "m", 0.0, lambda s: s.stroke_m, of("stroke_m", 0.01)),
        Parameter(
            "frequency_Hz",
            "Hz",
            lambda s: 1.0 / s.duration_s,
            lambda s: 0.95 * s.nyquist_Hz,
            of("nyquist_Hz", 0.05, 0.01, 0.2),
            nominal=None,
            log=True,
        ),
        Parameter("phase_rad", "rad", -pi, pi, (0.0, pi / 2, pi, -pi / 2), nominal=None),
    ),
    law=_vibration,
    motion=True,
    formula="z = z_stated + amplitude · sin(2π · frequency · t + phase)",
)


def _backlash(s: Span, p: Values, memory: Memory) -> None:
    """A dead band as wide as the noise of the heights would swallow it, and so bring the prediction of any cell nearer to its readings."""
    moved_m = play(s.tip_m, DEAD_BAND * s.z_noise_m, {}) if s.z_noise_m > 0.0 else s.tip_m  # a whole recording: no block follows
    s.slack_m, s.behind_m = p["width_m"], play(moved_m, p["width_m"], memory) - moved_m
    s.tip_m = s.tip_m + s.behind_m


BACKLASH = Effect(
    "robot.backlash",
    "tip",
    "the drive has play: after a reversal the tip stands still while the reported height already moves",
    (Parameter("width_m", "m", 0.0, lambda s: 0.5 * s.stroke_m, of("depth_m", 0.03, 0.1)),),
    law=_backlash,
    formula="the tip follows z behind a dead band: it rests until z has moved by width against it",
)


def _compliance(c: Constants, p: Values) -> None:
    c.tip_compliance_m_per_N += 1.0 / p["stiffness_N_per_m"]


COMPLIANCE = Effect(
    "robot.compliance",
    "tip",
    "the arm or the mount gives way: the larger the force, the less deep the tip is than the robot reports",
    (
        Parameter(
            "stiffness_N_per_m",
            "N/m",
            lambda s: 0.02 * s.stiffness_N_per_m,
            lambda s: 1e4 * s.stiffness_N_per_m,
            of("stiffness_N_per_m", 20.0, 3.0, 0.5),
            nominal=inf,
            log=True,
        ),
    ),
    setting=_compliance,
    discrepancy_drivers=LOAD,
    formula="tip = z + f / stiffness",
)

EFFECTS = (LAG, VIBRATION, BACKLASH, COMPLIANCE)
