"""Moduli by the package `nanite` (AFM-analysis) of known curves, for tests/analysis/test_nanite.py.

In an environment of its own, for palpd does not need it:  pip install nanite==4.2.3 && python benchmarks/nanite_reference.py
"""

import json
import math
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from nanite.indent import Indentation
from nanite.model import get_init_parms

OUT = Path(__file__).parents[1] / "tests" / "analysis" / "nanite_reference.json"
RADIUS_M, POINTS = 0.005, 400
ABOVE_M, DEPTH_M = 0.004, 0.004
CURVES = (
    (62.5e3, 0.5, 0.0, 0.0, 0.0),
    (135.5e3, 0.5, 3e-4, 0.19, 0.0),
    (20e3, 0.3, -5e-4, -0.1, 0.0),
    (62.5e3, 0.5, 1e-4, 0.19, 0.05),
    (135.5e3, 0.5, -2e-4, -0.05, 0.05),
    (92.1e3, 0.45, 0.0, 0.3, 0.1),
)
"""Young's modulus (Pa), Poisson's ratio, contact point (m), baseline (N), noise (N rms)."""


def curve(modulus_Pa: float, poisson: float, contact_m: float, baseline_N: float, noise_N: float, seed: int) -> tuple[Any, Any]:
    """Heights of the tip (m) and forces (N) of a press, to the last digit that is kept."""
    tip_m = np.linspace(ABOVE_M, -DEPTH_M, POINTS)
    pressed = np.maximum(contact_m - tip_m, 0.0) ** 1.5
    force_N = baseline_N + 4.0 / 3.0 * modulus_Pa / (1.0 - poisson**2) * math.sqrt(RADIUS_M) * pressed
    return np.round(tip_m, 9), np.round(force_N + np.random.default_rng(seed).normal(0.0, noise_N, POINTS), 6)


def by_nanite(tip_m: Any, force_N: Any, poisson: float) -> dict[str, float]:
    """Its fit of the paraboloidal Hertz model: modulus, contact point and baseline free."""
    data = {"force": force_N, "tip position": tip_m, "segment": np.zeros(POINTS, np.uint8), "time": np.arange(POINTS) * 1e-3}
    press = Indentation(data=data, metadata={"imaging mode": "force-distance", "point count": POINTS, "path": "curve", "enum": 0})
    start = get_init_parms("hertz_para")
    start["R"].value, start["nu"].value = RADIUS_M, poisson
    start["E"].value = 5e4
    press.fit_model(model_key="hertz_para", params_initial=start, preprocessing=[], weight_cp=False, range_x=(0, 0), segment=0)
    fitted = press.fit_properties["params_fitted"]
    return {
        "youngs_modulus_Pa": fitted["E"].value,
        "contact_point_m": fitted["contact_point"].value,
        "baseline_N": fitted["baseline"].value,
    }


def main() -> None:
    """Write the file."""
    curves = []
    for seed, (modulus_Pa, poisson, contact_m, baseline_N, noise_N) in enumerate(CURVES):
        tip_m, force_N = curve(modulus_Pa, poisson, contact_m, baseline_N, noise_N, seed)
        true = {"youngs_modulus_Pa": modulus_Pa, "poisson_ratio": poisson, "contact_point_m": contact_m, "noise_N": noise_N}
        curves.append({"true": true, "tip_m": tip_m.tolist(), "force_N": force_N.tolist(), "nanite": by_nanite(tip_m, force_N, poisson)})
        print(f"{modulus_Pa:9.0f} Pa, noise {noise_N:g} N: nanite {curves[-1]['nanite']}")
    content = {"made_with": {"nanite": version("nanite")}, "model": "hertz_para", "tip_radius_m": RADIUS_M, "curves": curves}
    OUT.write_text(json.dumps(content) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
