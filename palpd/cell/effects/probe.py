"""Probe: what else pushes it, and which way the sensor sees that."""

import numpy as np

from palpd.cell.dynamics import Memory, mounted, play, recurrence, slack_dahl
from palpd.cell.effects.effect import AZIMUTH, DEAD_BAND, LOAD, SIDEWAYS, Effect, Parameter, Values, of
from palpd.cell.span import Constants, Span

REST_SPEED_M_PER_S = 0.5e-3
"""Where Coulomb friction turns over, as the nominal tanh of it has it."""


def _mass(c: Constants, p: Values) -> None:
    c.mass_kg += p["delta_kg"]


MASS = Effect(
    "probe.mass",
    "probe",
    "the moving mass is not the stated one: the force is off while the arm speeds up or brakes",
    (Parameter("delta_kg", "kg", lambda s: -s.mass_kg, lambda s: 20.0 * s.mass_kg, of("mass_kg", 0.3, -0.3), words="further mass"),),
    setting=_mass,
    tolerance="mass_kg",
    formula="f - (mass_stated + delta) · a",
)


def _resonance(s: Span, p: Values, memory: Memory) -> None:
    ringing_m_per_s2 = mounted(s.az_m_per_s2, s.dt_s, p["frequency_Hz"], p["damping_ratio"], memory)
    s.fz_N = s.fz_N - s.constants.mass_kg * p["participation"] * (ringing_m_per_s2 - s.az_m_per_s2)


RESONANCE = Effect(
    "structure.resonance",
    "probe",
    "the probe's mount rings: the force swings on after the arm has started or stopped",
    (
        Parameter(
            "frequency_Hz",
            "Hz",
            lambda s: 0.1 * s.servo_natural_frequency_Hz,
            lambda s: max(0.95 * s.nyquist_Hz, 0.2 * s.servo_natural_frequency_Hz),
            of("servo_natural_frequency_Hz", 3.0, 1.5, 6.0),
            nominal=None,
            log=True,
        ),
        Parameter("damping_ratio", "1", 1e-3, 1.0, (0.05, 0.2), nominal=None, log=True),
        Parameter("participation", "1", 0.0, 1.0, (0.5,), words="share of the mass that rings"),
    ),
    law=_resonance,
    formula="f - mass · ((1 - participation) · a + participation · a_m), with a_m behind a mount of frequency and damping_ratio",
)


def _spring(s: Span, p: Values, memory: Memory) -> None:
    s.fz_N = s.fz_N - p["stiffness_N_per_m"] * (s.z_m - memory.setdefault("first_z_m", s.z_m[0]))


SPRING = Effect(
    "cable.spring",
    "probe",
    "a cable pulls like a spring: the force changes with the height, also in the air",
    (
        Parameter(
            "stiffness_N_per_m",
            "N/m",
            lambda s: -s.range_N / s.stroke_m,
            lambda s: s.range_N / s.stroke_m,
            lambda s: (0.05 * s.force_N / s.stroke_m, -0.05 * s.force_N / s.stroke_m),
        ),
    ),
    law=_spring,
    starts_at_tare=True,
    discrepancy_drivers=LOAD,
    formula="fz - stiffness · (z - z_first)",
)


def _friction(s: Span, p: Values, memory: Memory) -> None:
    """Coulomb, or Dahl (1968) over the presliding length: dF/dx = (1 - F sign v) / length, exact over a step.

    The friction acts on the tip: it stands still while the robot moves through a dead band. With presliding it springs back into the
    play first, since a slack link carries no force. Noise of a measured motion would wear the force down at rest, so a dead band comes
    first.
    """
    tip_m = s.tip_m if "presliding_m" not in p else s.tip_m - s.behind_m
    if "presliding_m" in p and s.z_noise_m > 0.0:  # a whole recording: no block follows that would need a memory
        tip_m = play(tip_m, DEAD_BAND * s.z_noise_m, {})
    change_m = np.diff(tip_m, prepend=memory.get("tip_m", tip_m[0]))
    memory["tip_m"] = tip_m[-1]
    if "presliding_m" in p and s.slack_m > 0.0:
        share = slack_dahl(tip_m, p["presliding_m"], s.slack_m, memory)
    elif "presliding_m" not in p:
        share = np.where(change_m != 0.0, np.tanh(s.vz_m_per_s / REST_SPEED_M_PER_S), 0.0)
    else:
        keep = np.exp(-np.abs(change_m) / p["presliding_m"])
        share = recurrence(keep, (1.0 - keep) * np.sign(change_m), memory.get("share", 0.0))
        memory["share"] = share[-1]
    s.fz_N = s.fz_N - p["force_N"] * share


FRICTION = Effect(
    "cable.friction",
    "probe",
    "something rubs: a force of constant size acts against the motion",
    (
        # strokes that are short against the presliding length show a part of it
        Parameter("force_N", "N", 0.0, lambda s: 4.0 * s.range_N, of("force_N", 0.05)),
        Parameter(
            "presliding_m",
            "m",
            lambda s: 1e-4 * s.stroke_m,
            lambda s: s.stroke_m,
            of("stroke_m", 0.02, 0.1),
            nominal=None,
            log=True,
            optional=True,
        ),
    ),
    law=_friction,
    formula="fz - force · tanh(v / 0.5 mm/s); with presliding: fz - force · w, with dw/dx = (sign v - w) / presliding over the way x",
)


def _viscous(s: Span, p: Values, _memory: Memory) -> None:
    s.fz_N = s.fz_N - p["coefficient_N_s_per_m"] * s.vz_m_per_s


VISCOUS = Effect(
    "cable.viscous",
    "probe",
    "something drags: a force against the motion grows with the speed",
    (
        Parameter(
            "coefficient_N_s_per_m",
            "N s/m",
            0.0,
            lambda s: s.range_N / s.speed_m_per_s,
            lambda s: (0.05 * s.force_N / s.speed_m_per_s,),
        ),
    ),
    law=_viscous,
    formula="fz - coefficient · v",
)


def _lateral(s: Span, p: Values, _memory: Memory) -> None:
    aside_N = p["ratio"] * s.contact_N
    s.push_sideways(np.cos(p["azimuth_rad"]) * aside_N, np.sin(p["azimuth_rad"]) * aside_N)


LATERAL = Effect(
    "contact.lateral",
    "probe",
    "the contact is oblique: each press also pushes the probe to the side",
    (Parameter("ratio", "1", 0.0, 3.0, (0.05,), words="lateral force over vertical force"), AZIMUTH),
    law=_lateral,
    family=SIDEWAYS,
    discrepancy_drivers=LOAD,
    formula="fx + ratio · f · cos(azimuth), fy + ratio · f · sin(azimuth), and the torque of both at the tip",
)


def _tilt(s: Span, p: Values, _memory: Memory) -> None:
    """The contact's share acts at the tip and so has a torque; inertia and cable act where the sensor is."""
    across = np.sin(p["angle_rad"])
    x, y = across * np.cos(p["azimuth_rad"]), across * np.sin(p["azimuth_rad"])
    elsewhere_N = s.fz_N - s.contact_N
    s.push_sideways(x * s.contact_N, y * s.contact_N)
    s.fx_N = s.fx_N + x * elsewhere_N
    s.fy_N = s.fy_N + y * elsewhere_N
    s.fz_N = np.cos(p["angle_rad"]) * s.fz_N


TILT = Effect(
    "probe.tilt",
    "probe",
    "the sensor is tilted: a part of each vertical force shows as a lateral one",
    (Parameter("angle_rad", "rad", 0.0, 1.2, (0.05,)), AZIMUTH),
    law=_tilt,
    family=SIDEWAYS,
    discrepancy_drivers=LOAD,
    formula="fz · cos(angle), fx + fz · sin(angle) · cos(azimuth), fy + fz · sin(angle) · sin(azimuth), and the torque",
)

EFFECTS = (MASS, RESONANCE, SPRING, FRICTION, VISCOUS, LATERAL, TILT)
