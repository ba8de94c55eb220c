"""Laws of the effects that the arena plants into recordings of real rigs, written apart from the diagnosis.

Names, parameters and signs are those of docs/reference/contract.md and docs/reference/effects.md. No law has a model of the contact:

- A law of the tissue scales the recorded force.
- A law of the tip (backlash, compliance, surface) keeps the force, and moves the reported and commanded height away from the tip.
- A law that depends on force or motion sees them smoothed, so that noise stays as recorded. Gain, asymmetry, saturation, latency and skew
  act on each reading.
- A planted filter comes behind those that act already. So the force of a rig that filters upstream has both.

Real cells follow no formula exactly, so some laws have a shape of their own. Friction before sliding, hysteresis and backlash are
generalised Maxwell-slip elements (Al-Bender, Lampaert and Swevers 2005, doi:10.1109/TAC.2005.858676). Friction while sliding is rounded in
proportion to the speed of the recording. What creeps or relaxes has two time constants.
"""

import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from palpd.arena.signals import FloatArray, PlantingRefusedError, Recording, acceleration, contact, motion, noise_N, smooth

Parameters = Mapping[str, float]

FORCE = ("fz_N",)
"""What a law needs that changes the recorded force: one that varies."""
TOUCH = ("fz_N", "surface_z_m")
"""What a law of tip or tissue needs besides: where the contact begins."""
LEAST_RANGE = 6
"""Least range of the smoothed force for these laws, in standard deviations of its noise."""
TINY = 1e-12
"""Least scale of a motion in SI units. A recording at rest has less, and its laws of motion are then without effect."""
TAPS = 6
"""Half the width of the interpolation of a shifted force, in rows: wide enough to keep the spectrum of noise."""


class _Scales(NamedTuple):
    """Scales of a recording: `top_N` is the largest pressing force, `rise_s` the time of a fast loading, `swift` an acceleration."""

    force_N: float
    top_N: float
    rise_s: float
    duration_s: float
    step_s: float
    stroke_m: float
    depth_m: float
    speed: float
    swift: float


@dataclass(frozen=True)
class PlantedLaw:
    """A law that adds a change to columns of a recording.

    Attributes:
        name: As in the contract, or `unknown.` and a name of the arena's own.
        size: Parameter that is scaled to reach an SNR; the others are shape.
        largest: Draws parameters of the largest plausible size.
        change: What is added to `fz_N`, or to `z_m` and `z_cmd_m` where the law moves the tip; NaN where a shift in time has no data.
        needs: Columns without which the law cannot be planted; `fz_N` is in it where the force must vary.
        resize: Value of the size from its largest value and a share; at share 0 there is no effect.
    """

    name: str
    size: str
    largest: Callable[[_Scales, np.random.Generator], dict[str, float]]
    change: Callable[[Recording, Parameters], FloatArray]
    needs: tuple[str, ...] = ()
    resize: Callable[[float, float], float] = operator.mul
    moves_tip: bool = False

    @property
    def effect(self) -> str:
        """Name in the contract's list, or `unknown`."""
        return "unknown" if self.name.startswith("unknown.") else self.name

    def draw(self, recording: Recording, rng: np.random.Generator) -> dict[str, float]:
        """Draw parameters of the largest plausible size, relative to the recording's own scales.

        Raises:
            PlantingRefusedError: If the law needs a varying force or a contact, and there is none.
        """
        t_s, force_N = recording["t_s"], smooth(recording["fz_N"])
        speed, swift, slope = (float(np.percentile(np.abs(x), 99)) for x in (*motion(recording), np.gradient(force_N, t_s)))
        bottom, top = (float(x) for x in np.percentile(force_N, [1, 99]))
        range_N, duration_s, noise = top - bottom, float(np.ptp(t_s)), noise_N(recording)
        if "fz_N" in self.needs and range_N < LEAST_RANGE * noise:
            raise PlantingRefusedError(f"{self.name} needs a varying force, but {range_N:.3g} N is within its noise; take another law")
        range_N, depth_m = max(range_N, 20 * noise), float(contact(recording)[0].max())
        if "surface_z_m" in self.needs and not depth_m:
            raise PlantingRefusedError(f"{self.name} needs a contact, but no height is below the surface; correct surface_z_m")
        scales = _Scales(
            force_N=range_N,
            top_N=max(top, 0.0),
            rise_s=min(duration_s / 20, range_N / max(slope, range_N / duration_s)),
            duration_s=duration_s,
            step_s=float(np.median(np.diff(t_s))),
            stroke_m=max(float(np.ptp(recording["z_m"])), TINY),
            depth_m=depth_m,
            speed=max(speed, TINY),
            swift=max(swift, TINY),
        )
        return self.largest(scales, rng)

    def apply(self, recording: Recording, parameters: Parameters) -> dict[str, FloatArray]:
        """Columns (n,) that the law changes, before rounding."""
        change, names = self.change(recording, parameters), ("z_m", "z_cmd_m") if self.moves_tip else ("fz_N",)
        return {name: recording[name] + change for name in names if name in recording}


def _low_pass(values: FloatArray, t_s: FloatArray, tau_s: float) -> FloatArray:
    """One pole, at rest on the first value; exact for values that are linear between rows of even step."""
    step_s = float(np.median(np.diff(t_s)))
    kept = float(np.exp(-step_s / tau_s))
    lag = (1 - kept) * tau_s / step_s
    return np.asarray(lfilter([1 - lag, lag - kept], [1, -kept], values - values[0]), float) + values[0]


def _slow(values: FloatArray, t_s: FloatArray, tau_s: float) -> FloatArray:
    """Mean of low-passes of half and of twice the time constant."""
    return (_low_pass(values, t_s, tau_s / 2) + _low_pass(values, t_s, tau_s * 2)) / 2


def _slip(way: FloatArray, width: float, start: float = 0.0) -> FloatArray:
    """Mean of three Maxwell-slip elements, from -1 to 1, which slip after half, once and twice the width."""
    out = np.zeros_like(way)
    for limit in (width / 2, width, 2 * width):
        state, states = start * limit, []
        for step in np.diff(way, prepend=way[0]).tolist():
            state = min(max(state + step, -limit), limit)
            states.append(state)
        out += np.array(states) / (3 * limit)
    return out


def _shift(recording: Recording, when_s: FloatArray) -> FloatArray:
    """Change of fz where each row holds the force of another time.

    Interpolation by a windowed sine (Duchon 1979, doi:10.1175/1520-0450(1979)018<1016:LFIOAT>2.0.CO;2).
    """
    force_N, rows = recording["fz_N"], np.arange(len(when_s))
    place = np.interp(when_s, recording["t_s"], rows, left=np.nan, right=np.nan)
    whole, taps = np.floor(np.nan_to_num(place)).astype(int)[:, None], np.arange(1 - TAPS, TAPS + 1)
    off = place[:, None] - whole - taps
    weights = np.sinc(off) * np.sinc(off / TAPS)
    return np.sum(weights * force_N[np.clip(whole + taps, 0, rows[-1])], axis=1) / weights.sum(axis=1) - force_N


def _friction(recording: Recording, p: Parameters) -> FloatArray:
    if "presliding_m" in p:
        return -p["force_N"] * _slip(smooth(recording["z_m"]), p["presliding_m"])
    speed = motion(recording)[0]
    slow, fast = np.percentile(np.abs(speed), [10, 95])
    return -p["force_N"] * np.tanh(speed / max(np.clip(2 * slow, 0.025 * fast, 0.1 * fast), TINY))


def _backlash(recording: Recording, p: Parameters) -> FloatArray:
    """Reported height less that of the tip: it grows by the width at each reversal, over a fifth of the width of the tip's way."""
    z_m = smooth(recording["z_m"])
    moved = z_m - z_m[0]
    first = float(np.sign(moved[np.argmax(np.abs(moved) > 0.05 * np.ptp(z_m))]))
    return p["width_m"] / 2 * (_slip(z_m, 0.05 * p["width_m"], first) - first)


def _stiffening(recording: Recording, p: Parameters) -> FloatArray:
    depth_m, pressed_N, _ = contact(recording)
    x2 = (depth_m / p["depth_m"]) ** 2
    return p["contrast"] * x2 / (1 + x2) * pressed_N


def _softening(recording: Recording, p: Parameters) -> FloatArray:
    depth_m, pressed_N, _ = contact(recording)
    deepest_m = np.maximum.accumulate(depth_m)
    return -p["softening"] * (1 - (depth_m / np.where(deepest_m > 0, deepest_m, 1)) ** 2) * pressed_N


def _relaxation(recording: Recording, p: Parameters) -> FloatArray:
    pressed_N = contact(recording)[1]
    return np.maximum(p["ratio"] * (pressed_N - _slow(pressed_N, recording["t_s"], p["tau_s"])), -pressed_N)


def _sign(rng: np.random.Generator) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(max(low, high)))))


def _asymmetry(recording: Recording, p: Parameters) -> FloatArray:
    force_N = recording["fz_N"]
    return p["ratio"] * (np.maximum(force_N - p["at_N"], 0) if p["side"] > 0 else np.minimum(force_N, p["at_N"]))


def _filter(recording: Recording, p: Parameters) -> FloatArray:
    force_N = smooth(recording["fz_N"])
    return _low_pass(force_N, recording["t_s"], 1 / (2 * np.pi * p["cutoff_Hz"])) - force_N


def _phase(rng: np.random.Generator) -> dict[str, float]:
    return {"phase_rad": float(rng.uniform(0, 2 * np.pi))}


# fmt: off
_TABLE = (
    PlantedLaw("sensor.bias", "offset_N", lambda s, r: {"offset_N": 0.5 * s.force_N * _sign(r)},
        lambda c, p: np.full_like(c["t_s"], p["offset_N"])),
    PlantedLaw("sensor.drift", "rate_N_per_s", lambda s, r: {"rate_N_per_s": 0.5 * s.force_N / s.duration_s * _sign(r)},
        lambda c, p: p["rate_N_per_s"] * (c["t_s"] - c["t_s"][0])),
    PlantedLaw("sensor.warmup", "amplitude_N", lambda s, r: {
        "amplitude_N": 0.5 * s.force_N * _sign(r), "tau_s": s.duration_s * _between(r, 0.05, 0.3)},
        lambda c, p: -p["amplitude_N"] * np.expm1((c["t_s"][0] - c["t_s"]) / p["tau_s"])),
    PlantedLaw("sensor.gain", "error", lambda _s, r: {"error": 0.5 * _sign(r)}, lambda c, p: p["error"] * c["fz_N"], FORCE),
    PlantedLaw("sensor.creep", "ratio", lambda s, r: {"ratio": 0.3, "tau_s": s.duration_s * _between(r, 0.02, 0.2)},
        lambda c, p: p["ratio"] * _slow(smooth(c["fz_N"]), c["t_s"], p["tau_s"]), FORCE),
    PlantedLaw("sensor.hysteresis", "amplitude_N", lambda s, r: {
        "amplitude_N": 0.3 * s.force_N, "width_N": s.force_N * _between(r, 0.05, 0.3)},
        lambda c, p: p["amplitude_N"] * _slip(smooth(c["fz_N"]), p["width_N"]), FORCE),
    PlantedLaw("sensor.asymmetry", "ratio", lambda s, r: {"ratio": 0.5 * _sign(r), "at_N": s.top_N * r.uniform(0, 0.6), "side": _sign(r)},
        _asymmetry, FORCE),
    PlantedLaw("sensor.saturation", "limit_N", lambda s, _r: {"limit_N": 0.4 * max(s.top_N, s.force_N - s.top_N)},
        lambda c, p: np.clip(c["fz_N"], -p["limit_N"], p["limit_N"]) - c["fz_N"], FORCE, operator.truediv),
    PlantedLaw("sensor.filter", "cutoff_Hz", lambda s, _r: {"cutoff_Hz": 1 / (np.pi * s.rise_s)}, _filter, FORCE, operator.truediv),
    PlantedLaw("sensor.latency", "delay_s", lambda s, r: {"delay_s": 0.5 * s.rise_s * _sign(r)},
        lambda c, p: _shift(c, c["t_s"] - p["delay_s"]), FORCE),
    PlantedLaw("clock.skew", "ratio", lambda s, r: {"ratio": 0.5 * s.rise_s / s.duration_s * _sign(r)},
        lambda c, p: _shift(c, c["t_s"] + p["ratio"] * (c["t_s"] - c["t_s"][0])), FORCE),
    PlantedLaw("cable.spring", "stiffness_N_per_m", lambda s, _r: {"stiffness_N_per_m": 0.5 * s.force_N / s.stroke_m},
        lambda c, p: -p["stiffness_N_per_m"] * (smooth(c["z_m"]) - c["z_m"][0])),
    PlantedLaw("cable.friction", "force_N", lambda s, r: {"force_N": 0.3 * s.force_N} | (
        {"presliding_m": s.stroke_m * _between(r, 0.002, 0.02)} if r.random() < 0.5 else {}), _friction),
    PlantedLaw("cable.viscous", "coefficient_N_s_per_m", lambda s, _r: {"coefficient_N_s_per_m": 0.5 * s.force_N / s.speed},
        lambda c, p: -p["coefficient_N_s_per_m"] * motion(c)[0]),
    PlantedLaw("probe.mass", "delta_kg", lambda s, r: {"delta_kg": 0.5 * s.force_N / s.swift * _sign(r)},
        lambda c, p: -p["delta_kg"] * acceleration(c)),
    PlantedLaw("robot.backlash", "width_m", lambda s, _r: {"width_m": 0.3 * s.depth_m}, _backlash, TOUCH, moves_tip=True),
    PlantedLaw("robot.compliance", "stiffness_N_per_m", lambda s, _r: {"stiffness_N_per_m": 2 * s.force_N / s.depth_m},
        lambda c, p: -contact(c)[1] / p["stiffness_N_per_m"], TOUCH, operator.truediv, moves_tip=True),
    PlantedLaw("tissue.surface", "offset_m", lambda s, r: {"offset_m": 0.3 * s.depth_m * _sign(r)},
        lambda c, p: np.full_like(c["t_s"], p["offset_m"]), TOUCH, moves_tip=True),
    PlantedLaw("tissue.modulus", "ratio", lambda _s, r: {"ratio": 2.0 ** _sign(r)}, lambda c, p: (p["ratio"] - 1) * contact(c)[1],
        TOUCH, lambda value, share: 1 + (value - 1) * share),
    PlantedLaw("tissue.viscoelastic", "ratio", lambda s, r: {"ratio": 0.5, "tau_s": s.duration_s * _between(r, 0.01, 0.1)},
        _relaxation, TOUCH),
    PlantedLaw("tissue.inclusion", "contrast", lambda s, r: {"contrast": 1.0, "depth_m": s.depth_m * _between(r, 0.3, 1)},
        _stiffening, TOUCH),
    PlantedLaw("tissue.preconditioning", "softening", lambda _s, _r: {"softening": 0.5}, _softening, TOUCH),
    PlantedLaw("unknown.ripple", "amplitude_N", lambda s, r: {"amplitude_N": 0.3 * s.force_N} | _phase(r) | {
        "length_m": s.stroke_m * _between(r, 0.08, 0.3)},
        lambda c, p: p["amplitude_N"] * np.sin(2 * np.pi * smooth(c["z_m"]) / p["length_m"] + p["phase_rad"])),
    PlantedLaw("unknown.hum", "amplitude_N", lambda s, r: {"amplitude_N": 0.3 * s.force_N} | _phase(r) | {
        "frequency_Hz": _between(r, 5 / s.duration_s, min(10, 1 / (6 * s.step_s)))},
        lambda c, p: p["amplitude_N"] * np.sin(2 * np.pi * p["frequency_Hz"] * c["t_s"] + p["phase_rad"])),
    PlantedLaw("unknown.drag", "coefficient_N_s2_per_m2", lambda s, _r: {"coefficient_N_s2_per_m2": 0.5 * s.force_N / s.speed**2},
        lambda c, p: -p["coefficient_N_s2_per_m2"] * motion(c)[0] * np.abs(motion(c)[0])),
)
# fmt: on
LAWS = {law.name: law for law in _TABLE}
"""All laws by name. The contract has no name for the three that begin with `unknown.`."""
