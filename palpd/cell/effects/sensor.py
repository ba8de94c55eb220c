"""Clock and sensor: what becomes of the wrench on its way into the recording."""

from math import inf

import numpy as np

from palpd.cell.dynamics import Memory, excess_N, lowpass, play, recurrence
from palpd.cell.effects.effect import (
    DEAD_BAND,
    LOAD,
    SCALE_OF_FORCE,
    SIDEWAYS,
    SLOW_ZERO,
    TIME,
    Effect,
    Parameter,
    Scale,
    Values,
    of,
    relaxation_time,
)
from palpd.cell.span import Constants, Span


def _skew(c: Constants, p: Values) -> None:
    c.skew += p["ratio"]


NATURAL_SKEW, LARGEST_SKEW = 1e-3, 3e-3
"""Largest clock error of working clocks, and the largest that is sought: crystals stay within 1e-4, a clock that software corrects within
some 1e-3."""


SKEW = Effect(
    "clock.skew",
    "clock",
    "the clocks of sensor and robot run apart: the force comes later and later, or earlier and earlier",
    (Parameter("ratio", "1", -LARGEST_SKEW, LARGEST_SKEW, (1e-4, -1e-4, 1e-3, -1e-3), natural=NATURAL_SKEW, words="error of the clock"),),
    setting=_skew,
    starts_at_tare=True,
    formula="the row at t holds the wrench of t · (1 + ratio)",
)


def _latency(c: Constants, p: Values) -> None:
    c.delay_s += p["delay_s"]


LATENCY = Effect(
    "sensor.latency",
    "clock",
    "the sensor reports late or early: force and height are shifted by a constant time",
    (Parameter("delay_s", "s", lambda s: -0.02 * s.duration_s, lambda s: 0.1 * s.duration_s, of("step_s", 2.0, 10.0, 40.0)),),
    setting=_latency,
    tolerance="latency_s",
    formula="the row at t holds the wrench of t - delay",
)


def _gain(c: Constants, p: Values) -> None:
    c.gain *= 1.0 + p["error"]


GAIN = Effect(
    "sensor.gain",
    "sensor",
    "the sensor's scale is off: each vertical force is too large or too small by one factor",
    (Parameter("error", "1", -0.95, 10.0, (0.1, -0.1), words="error of the scale"),),
    setting=_gain,
    tolerance="gain",
    family=SCALE_OF_FORCE,
    discrepancy_drivers=LOAD,
    formula="fz · (1 + error)",
)


def _crosstalk(c: Constants, p: Values) -> None:
    c.fx_per_fz += p["fx_per_fz"]
    c.fy_per_fz += p["fy_per_fz"]
    c.tx_per_fz_m += p["tx_per_fz_m"]
    c.ty_per_fz_m += p["ty_per_fz_m"]


CROSSTALK = Effect(
    "sensor.crosstalk",
    "sensor",
    "the vertical force leaks into other axes: lateral forces and torques rise with it",
    (
        Parameter("fx_per_fz", "1", -1.0, 1.0, (0.02,), words="share in fx"),
        Parameter("fy_per_fz", "1", -1.0, 1.0, (0.02,), words="share in fy"),
        Parameter("tx_per_fz_m", "m", lambda s: -s.tip_length_m, lambda s: s.tip_length_m, of("tip_length_m", 0.02), words="arm of tx"),
        Parameter("ty_per_fz_m", "m", lambda s: -s.tip_length_m, lambda s: s.tip_length_m, of("tip_length_m", 0.02), words="arm of ty"),
    ),
    setting=_crosstalk,
    tolerance="crosstalk",
    family=SIDEWAYS,
    discrepancy_drivers=LOAD,
    formula="fx + fx_per_fz · fz, fy + fy_per_fz · fz, tx + tx_per_fz · fz, ty + ty_per_fz · fz",
)


def _hysteresis(s: Span, p: Values, memory: Memory) -> None:
    """Exact over a step: w goes towards +1 while fz rises and towards -1 while it falls, by exp(-|Δfz|/width).

    It starts where the loads before the recording have left it, which nobody knows.

    Noise of a measured motion would wear the loop down while nothing moves, so dead bands come first: in the air for the noise of
    accelerations, in contact for that of heights, as the force to 2/3, which a sphere makes proportional to depth.
    """
    drive_N = s.fz_N
    if s.z_noise_m > 0.0 or s.az_noise_m_per_s2 > 0.0:  # a whole recording: no block follows that would need a memory
        inertial_N = play(s.fz_N - s.contact_N, DEAD_BAND * s.constants.mass_kg * s.az_noise_m_per_s2, {})
        as_depth = np.sign(s.contact_N) * np.abs(s.contact_N) ** (2.0 / 3.0)
        per_m = float(as_depth.max()) / max(float(s.depth_m.max()), float(np.finfo(float).tiny))
        as_depth = play(as_depth, DEAD_BAND * per_m * s.z_noise_m, {})
        drive_N = inertial_N + np.sign(as_depth) * np.abs(as_depth) ** 1.5
    change_N = np.diff(drive_N, prepend=memory.get("fz_N", drive_N[0]))
    keep = np.exp(-np.abs(change_N) / p["width_N"])
    loop = recurrence(keep, np.sign(change_N) * (1.0 - keep), memory.get("w", p.get("start", 0.0)))
    memory["fz_N"], memory["w"] = drive_N[-1], loop[-1]
    s.fz_N = s.fz_N + p["amplitude_N"] * loop


HYSTERESIS = Effect(
    "sensor.hysteresis",
    "sensor",
    "the sensor has hysteresis: a force reads differently while it rises and while it falls",
    (
        Parameter("width_N", "N", lambda s: s.noise_N, lambda s: 10.0 * s.range_N, of("force_N", 0.1, 0.5), nominal=None, log=True),
        Parameter("amplitude_N", "N", lambda s: -s.range_N, lambda s: s.range_N, of("force_N", 0.05, -0.05)),
        Parameter("start", "1", -1.0, 1.0, (-0.5,), nominal=None, optional=True, nuisance=True),
    ),
    law=_hysteresis,
    discrepancy_drivers=LOAD,
    formula="fz + amplitude · w, with dw = (1 - w · sign dfz) · dfz / width",
)


def _creep(s: Span, p: Values, memory: Memory) -> None:
    s.fz_N = s.fz_N + p["ratio"] * lowpass(s.fz_N, s.dt_s, -1.0 / p["tau_s"], memory, start=0.0)


def _settled_creep(p: Values, within_s: float) -> float:
    return 1.0 + p["ratio"] if p["tau_s"] < within_s else 1.0


CREEP = Effect(
    "sensor.creep",
    "sensor",
    "the sensor creeps: its reading keeps rising while the load stays",
    # what has settled before a press is over is no creep: nothing could tell it from a gain
    (Parameter("ratio", "1", 0.0, 5.0, (0.05, 0.3), words="creep over load"), relaxation_time(0.05, 0.3, 0.01, of_a_press=0.3)),
    law=_creep,
    shows_at_rest=True,
    gain_at_rest=_settled_creep,
    formula="fz + ratio · (low-pass of fz with time constant tau)",
)


def _warmup(s: Span, p: Values, _memory: Memory) -> None:
    s.fz_N = s.fz_N - p["amplitude_N"] * np.expm1(-s.t_s / p["tau_s"])


WARMUP = Effect(
    "sensor.warmup",
    "sensor",
    "the sensor warms up: its zero moves fast at first and then settles",
    (
        Parameter("amplitude_N", "N", lambda s: -s.range_N, lambda s: s.range_N, of("noise_N", 2.0, -2.0)),
        relaxation_time(0.2, 0.7, 0.05),
    ),
    law=_warmup,
    starts_at_tare=True,
    family=SLOW_ZERO,
    discrepancy_drivers=TIME,
    formula="fz + amplitude · (1 - exp(-t / tau))",
)


def _filter(c: Constants, p: Values) -> None:
    c.cutoff_Hz = p["cutoff_Hz"]


FILTER = Effect(
    "sensor.filter",
    "sensor",
    "the sensor's filter is not the stated one: fast changes of the force are smoothed more, or less",
    (
        Parameter(
            "cutoff_Hz",
            "Hz",
            lambda s: 0.5 / s.duration_s,
            lambda s: max(10.0 * s.nyquist_Hz, 2.0 * s.cutoff_Hz if s.cutoff_Hz < inf else 0.0),
            lambda s: tuple(share * min(s.cutoff_Hz, s.nyquist_Hz) for share in (0.2, 0.05, 0.01)),
            nominal=lambda s: s.cutoff_Hz,
            log=True,
        ),
    ),
    setting=_filter,
    tolerance="filter_cutoff",
    formula="all six axes behind a one-pole low-pass of cutoff in place of the stated one",
)


def _bias(c: Constants, p: Values) -> None:
    c.bias_N += p["offset_N"]


BIAS = Effect(
    "sensor.bias",
    "sensor",
    "the sensor's zero is off: a constant force is added after the tare",
    (Parameter("offset_N", "N", lambda s: -s.range_N, lambda s: s.range_N, of("noise_N", 2.0, -2.0)),),
    setting=_bias,
    tolerance="bias_N",
    starts_at_tare=True,
    family=SLOW_ZERO,
    discrepancy_drivers=TIME,
    formula="fz + offset",
)


def _drift(c: Constants, p: Values) -> None:
    c.drift_N_per_s += p["rate_N_per_s"]


DRIFT = Effect(
    "sensor.drift",
    "sensor",
    "the sensor's zero drifts: the force rises or falls steadily in time",
    (
        Parameter(
            "rate_N_per_s",
            "N/s",
            lambda s: -s.range_N / s.duration_s,
            lambda s: s.range_N / s.duration_s,
            lambda s: (2.0 * s.noise_N / s.duration_s, -2.0 * s.noise_N / s.duration_s),
        ),
    ),
    setting=_drift,
    tolerance="drift_N_per_min",
    starts_at_tare=True,
    family=SLOW_ZERO,
    discrepancy_drivers=TIME,
    formula="fz + rate · t",
)


KNEE = Parameter(
    "knee_N",
    "N",
    lambda s: 0.01 * s.force_N,
    lambda s: 0.3 * s.force_N,
    of("force_N", 0.05),
    nominal=None,
    log=True,
    optional=True,
    nuisance=True,
)
"""Over which force a slope changes to another one: at a corner in the formula, gradually in a real sensor."""


def _asymmetry(s: Span, p: Values, _memory: Memory) -> None:
    excess = excess_N(s.fz_N - p["at_N"], p.get("knee_N", 0.0))
    s.fz_N = s.fz_N + p["ratio"] * (excess if p.get("side", PUSHED) > 0.0 else s.fz_N - excess)


PUSHED, PULLED = 1.0, -1.0
"""The side of `at_N` on which the slope differs: above it, or below it."""

ASYMMETRY = Effect(
    "sensor.asymmetry",
    "sensor",
    "the sensor's slope changes at some force: readings beyond it are too large or too small",
    (
        Parameter("ratio", "1", -0.95, 10.0, (0.1, -0.1), words="change of the slope"),
        Parameter(
            "at_N", "N", 0.0, lambda s: s.range_N, of("force_N", 0.3, 0.0, 0.6), nominal=None, words="force at which the slope changes"
        ),
        Parameter(
            "side",
            "1",
            PULLED,
            PUSHED,
            (PUSHED, PULLED),
            nominal=None,
            optional=True,
            choices=(PUSHED, PULLED),
            words="side (1: above that force, -1: below)",
        ),
        KNEE,
    ),
    law=_asymmetry,
    family=SCALE_OF_FORCE,
    discrepancy_drivers=LOAD,
    formula="side 1: fz + ratio · max(0, fz - at); side -1: fz + ratio · min(fz, at)",
)


def _noise(c: Constants, p: Values) -> None:
    c.noise_rms_N *= p["ratio"]
    c.noise_rms_Nm *= p["ratio"]


NOISE = Effect(
    "sensor.noise",
    "sensor",
    "the sensor is noisier than stated: the readings of all axes scatter more",
    (Parameter("ratio", "1", 0.01, 1e3, (1.5, 3.0), nominal=1.0, log=True, words="noise over the stated noise"),),
    setting=_noise,
    scatter="noise",
    formula="rms of the noise = ratio · rms_stated",
)


def _saturation(c: Constants, p: Values) -> None:
    if p["limit_N"] < c.limit_N:
        c.limit_N, c.knee_N = p["limit_N"], p.get("knee_N", 0.0)


def _least_limit(s: Scale) -> float:
    """Readings beyond the limit do not exist, but for their noise and a zero that shifted."""
    return max(0.98 * s.force_N - 5.0 * s.noise_N, 0.02 * s.force_N)


SATURATION = Effect(
    "sensor.saturation",
    "sensor",
    "the sensor is at its limit: the reading stays flat above some force",
    (Parameter("limit_N", "N", _least_limit, lambda s: 2.0 * s.range_N, of("force_N", 0.8), nominal=inf, log=True), KNEE),
    setting=_saturation,
    discrepancy_drivers=LOAD,
    formula="fz clipped to ±limit",
)


def _quantization(c: Constants, p: Values) -> None:
    c.step_N = max(c.step_N, p["step_N"])


QUANTIZATION = Effect(
    "sensor.quantization",
    "sensor",
    "the sensor rounds more coarsely than stated: the readings stand on steps",
    (Parameter("step_N", "N", 0.0, lambda s: s.range_N, lambda s: (4.0 * s.noise_N, 0.2 * s.force_N)),),
    setting=_quantization,
    scatter="coarse step",
    formula="fz rounded to the nearest multiple of step",
)


def _dropout(c: Constants, p: Values) -> None:
    c.dropout_rate_Hz, c.dropout_length_s = p["rate_Hz"], p["length_s"]


DROPOUT = Effect(
    "sensor.dropout",
    "sensor",
    "samples are lost: now and then the last reading is repeated",
    (
        Parameter("rate_Hz", "Hz", 0.0, lambda s: s.nyquist_Hz, lambda s: (20.0 / s.duration_s,)),
        Parameter("length_s", "s", lambda s: s.step_s, lambda s: 0.2 * s.duration_s, of("step_s", 5.0), nominal=None, log=True),
    ),
    setting=_dropout,
    scatter="held samples",
    formula="rate times a second the last sample is held for length",
)

EFFECTS = (
    SKEW,
    LATENCY,
    GAIN,
    CROSSTALK,
    HYSTERESIS,
    CREEP,
    WARMUP,
    ASYMMETRY,
    FILTER,
    BIAS,
    DRIFT,
    NOISE,
    SATURATION,
    QUANTIZATION,
    DROPOUT,
)
