"""Least squares over the same effects: each is fitted alone to the recording by palpd's simulator, and BIC decides.

What the healthy recordings differ from the simulation (by height and direction) is added to it, so that only a change counts. The
effects and their bounds are those of `palpd effects`.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from palpd import api
from palpd.arena.answers import content_of
from palpd.arena.cases import Question
from palpd.arena.columns import Columns, Floats, Healthy, load
from palpd.errors import PalpdError

ROWS = 3000
EVALUATIONS = 12
"""Most simulations of one fit, beside those of its slopes."""


def answer(question: Question) -> dict[str, Any]:
    """The effect whose fit has the least BIC, with the weights of BIC as probabilities."""
    recording, cell = _thinned(load(question.recording)), api.Cell.load(question.cell)
    healthy = [_thinned(load(path)) for path in question.healthy]

    def left(of: Columns, with_effects: api.Cell) -> Floats:
        return of["fz_N"] - api.simulate(of, with_effects)["fz_N"]

    usual = Healthy.of([{**each, "fz_N": left(each, cell)} for each in healthy]) if healthy else None

    def residual(with_effects: api.Cell) -> Floats:
        out = left(recording, with_effects)
        if usual is not None:
            out = usual.residual({**recording, "fz_N": out})
        out = out[np.isfinite(out)]
        return out - out.mean()

    n = len(residual(cell))
    floor = usual.rms_N**2 if usual is not None else 0.0
    independent = n**0.5  # neighbours are not independent
    bic = {"none": independent * float(np.log(np.mean(residual(cell) ** 2) + floor))}
    for name, parameters in _effects(recording, has_tissue=cell.file.tissue is not None).items():
        left_over = _fit(cell, name, parameters, residual)
        bic[name] = independent * float(np.log(left_over + floor)) + len(parameters) * float(np.log(n))
    weights = {name: float(np.exp(-0.5 * (value - min(bic.values())))) for name, value in bic.items()}
    shares = {name: weight / sum(weights.values()) for name, weight in weights.items()}
    p_none = shares.pop("none")
    best = max(shares, key=lambda name: shares[name])
    if p_none > max(0.5, shares[best]):
        return content_of("none", shares, p_none)
    return content_of("effects", shares | {best: max(shares[best], 0.501)}, p_none)


def _effects(recording: Columns, *, has_tissue: bool) -> dict[str, dict[str, tuple[float, float, float]]]:
    """Start, least and largest value of each parameter, by effect: in shares of the recording's own force, stroke, speed and length."""
    force, stroke = float(np.ptp(recording["fz_N"])), float(np.ptp(recording["z_m"]))
    speed = float(np.abs(recording["vz_m_per_s"]).max())
    accelerated = float(np.percentile(np.abs(np.gradient(recording["vz_m_per_s"], recording["t_s"])), 99))
    length_s, rate_Hz = float(np.ptp(recording["t_s"])), len(recording["t_s"]) / float(np.ptp(recording["t_s"]))
    air: dict[str, dict[str, tuple[float, float, float]]] = {
        "cable.friction": {"force_N": (0.05 * force, 0.0, force)},
        "cable.viscous": {"coefficient_N_s_per_m": (0.05 * force / speed, 0.0, 10.0 * force / speed)},
        "cable.spring": {"stiffness_N_per_m": (0.05 * force / stroke, -5.0 * force / stroke, 5.0 * force / stroke)},
        "probe.mass": {"delta_kg": (0.05 * force / accelerated, -force / accelerated, force / accelerated)},
        "sensor.gain": {"error": (0.02, -0.9, 2.0)},
        "sensor.bias": {"offset_N": (0.02 * force, -force, force)},
        "sensor.drift": {"rate_N_per_s": (0.02 * force / length_s, -force / length_s, force / length_s)},
        "sensor.latency": {"delay_s": (1.0 / rate_Hz, 0.0, min(1.0, 0.2 * length_s))},
        "sensor.creep": {"ratio": (0.02, 0.0, 1.0), "tau_s": (0.1 * length_s, 2.0 / rate_Hz, 5.0 * length_s)},
        "sensor.hysteresis": {"width_N": (0.2 * force, 0.01 * force, force), "amplitude_N": (0.02 * force, 0.0, force)},
        "sensor.filter": {"cutoff_Hz": (0.1 * rate_Hz, 0.002 * rate_Hz, 0.45 * rate_Hz)},
        "sensor.saturation": {"limit_N": (0.9 * float(recording["fz_N"].max()), 0.2 * force, 2.0 * force)},
        "robot.backlash": {"width_m": (0.01 * stroke, 0.0, 0.3 * stroke)},
    }
    if not has_tissue:
        return {name: values for name, values in air.items() if name != "robot.backlash"}
    return air | {
        "tissue.modulus": {"ratio": (1.05, 0.1, 10.0)},
        "tissue.surface": {"offset_m": (0.01 * stroke, -0.3 * stroke, 0.3 * stroke)},
        "tissue.viscoelastic": {"ratio": (0.1, 0.0, 5.0), "tau_s": (0.1 * length_s, 2.0 / rate_Hz, 5.0 * length_s)},
        "tissue.adhesion": {"force_N": (0.02 * force, 0.0, force), "range_m": (0.02 * stroke, 0.001 * stroke, stroke)},
        "robot.compliance": {"stiffness_N_per_m": (50.0 * force / stroke, 0.5 * force / stroke, 1e4 * force / stroke)},
    }


def _fit(cell: api.Cell, name: str, parameters: dict[str, tuple[float, float, float]], residual: Callable[[api.Cell], Floats]) -> float:
    """Mean square that an effect leaves at its best; infinite where it cannot be simulated."""
    names = list(parameters)
    start, low, high = np.array(list(parameters.values())).T

    def of(x: Floats) -> Floats:
        return residual(cell.with_effects({name: dict(zip(names, map(float, low + x * (high - low)), strict=True))}))

    try:
        inside = np.clip((start - low) / (high - low), 1e-3, 1.0 - 1e-3)
        fit = least_squares(of, inside, bounds=(0.0, 1.0), max_nfev=EVALUATIONS, diff_step=np.full(len(names), 1e-3))
    except PalpdError:
        return float("inf")
    return float(2.0 * fit.cost / len(fit.fun))


def _thinned(recording: Columns) -> Columns:
    every = max(1, len(recording["t_s"]) // ROWS)
    return {name: values[::every] for name, values in recording.items()}
