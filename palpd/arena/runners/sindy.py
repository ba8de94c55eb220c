"""pysindy's sequentially thresholded least squares on the residual: the sparse sum of terms that explains it, each a cause.

The residual is the force less the mean of the healthy recordings; without these, the force less that of palpd's cell file.
"""

from typing import Any

import numpy as np
from pysindy.optimizers import STLSQ

from palpd import api
from palpd.arena.answers import content_of
from palpd.arena.cases import Question
from palpd.arena.columns import Columns, Floats, Healthy, load

ROWS = 4000
SHARES = (0.02, 0.05, 0.1, 0.2)
"""Thresholds that are tried, as shares of the residual's rms; the one of the least BIC counts."""
OWN = 0.02
"""Coefficients below this share of the force's range are within what a healthy rig does."""


def answer(question: Question) -> dict[str, Any]:
    """The sparse model of least BIC, and its terms as causes."""
    recording = load(question.recording)
    healthy = [load(path) for path in question.healthy]
    if healthy:
        residual, usual = Healthy.of(healthy).residual(recording), Healthy.of(healthy).rms_N
    else:
        residual, usual = recording["fz_N"] - api.simulate(recording, question.cell)["fz_N"], 0.0
    library = _library(recording, residual)
    known = np.isfinite(residual) & np.all([np.isfinite(term) for term in library.values()], axis=0)
    rows = np.flatnonzero(known)[:: max(1, int(known.sum()) // ROWS)]
    names = list(library)
    terms = np.array([library[name][rows] for name in names]).T
    scale = np.maximum(terms.std(axis=0), 1e-300)
    y = residual[rows] - residual[rows].mean()
    x = (terms - terms.mean(axis=0)) / scale
    best, weights = np.inf, np.zeros(len(names))
    for share in SHARES:
        fit = np.asarray(STLSQ(threshold=share * float(y.std()), alpha=1e-6).fit(x, y[:, None]).coef_).ravel()
        left = float(((y - x @ fit) ** 2).mean()) + usual**2
        bic = len(y) ** 0.5 * np.log(left) + np.count_nonzero(fit) * np.log(len(y))  # neighbours are not independent: root of n
        if bic < best:
            best, weights = bic, fit
    range_N = float(np.ptp(recording["fz_N"]))
    strength = {name: abs(weight) / max(usual, OWN * range_N, 1e-300) for name, weight in zip(names, weights, strict=True)}
    probability = {name: float(s**2 / (1.0 + s**2)) for name, s in strength.items() if s > 0.0}
    p_none = float(np.prod([1.0 - p for p in probability.values()])) if probability else 0.9
    return content_of("effects" if any(p > 0.5 for p in probability.values()) else "none", probability, p_none)


def _library(recording: Columns, residual: Floats) -> dict[str, Floats]:
    """Terms (n,) by the cause that each would be."""
    t, z, v, fz = (recording[name] for name in ("t_s", "z_m", "vz_m_per_s", "fz_N"))
    usual = np.nan_to_num(fz - residual)
    return {
        "cable.friction": np.tanh(v / (0.05 * np.abs(v).max() + 1e-300)),
        "cable.viscous": v,
        "cable.spring": z - z[0],
        "probe.mass": np.gradient(v, t),
        "sensor.drift": t,
        "sensor.gain": usual,
        "sensor.latency": np.gradient(usual, t),
        "sensor.asymmetry": np.abs(usual),
    }
