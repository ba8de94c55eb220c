"""The numbers of a cell.yaml, flat, as every source of cases states them, and the names of channels and phases."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

CHANNELS = ("z_m", "fx_N", "fy_N", "fz_N", "tx_Nm", "ty_Nm", "tz_Nm")
PHASES = ("free_still", "free_moving", "loading", "holding", "unloading")
BLOCKS = {
    "probe": ("mass_kg", "tip_radius_m", "tip_length_m"),
    "sensor": ("rate_Hz", "filter_cutoff_Hz", "noise_rms_N", "noise_rms_Nm", "resolution_fxy_N", "resolution_fz_N", "resolution_Nm"),
    "robot": ("servo_natural_frequency_Hz", "servo_damping_ratio", "position_noise_rms_m", "velocity_noise_rms_m_per_s"),
    "tissue": ("surface_z_m", "youngs_modulus_Pa", "poisson_ratio"),
}
"""Keys of a cell.yaml by block."""


@dataclass(frozen=True)
class CellNumbers:
    """The numbers of a cell.yaml under their names there, and the scatter of presses."""

    mass_kg: float
    tip_radius_m: float
    tip_length_m: float
    rate_Hz: float
    filter_cutoff_Hz: float | None
    noise_rms_N: float
    noise_rms_Nm: float
    resolution_fxy_N: float
    resolution_fz_N: float
    resolution_Nm: float
    servo_natural_frequency_Hz: float
    servo_damping_ratio: float
    position_noise_rms_m: float
    velocity_noise_rms_m_per_s: float
    surface_z_m: float
    youngs_modulus_Pa: float
    poisson_ratio: float
    scatter_surface_z_m: float
    scatter_stiffness: float

    @property
    def hertz_N_per_m15(self) -> float:
        """Force per depth to the power of 1.5 of a sphere on an elastic half-space (docs/reference/contract.md §3)."""
        return 4.0 / 3.0 * self.youngs_modulus_Pa / (1.0 - self.poisson_ratio**2) * self.tip_radius_m**0.5

    @property
    def noises(self) -> Floats:
        """Rms of the white noise of the wrench (6,)."""
        return np.array([self.noise_rms_N] * 3 + [self.noise_rms_Nm] * 3)

    @property
    def steps(self) -> Floats:
        """Steps of the wrench (6,); 0 is no step."""
        return np.array([self.resolution_fxy_N] * 2 + [self.resolution_fz_N] + [self.resolution_Nm] * 3)

    @cached_property
    def sigma(self) -> Floats:
        """Noise and rounding of one row together, channel by channel (7,)."""
        return np.concatenate([[self.position_noise_rms_m], np.sqrt(self.noises**2 + self.steps**2 / 12.0)])

    def blocks(self) -> dict[str, Any]:
        """The blocks of cell.yaml that hold these numbers."""
        return {block: {name: getattr(self, name) for name in keys} for block, keys in BLOCKS.items()}


def rounded(wrench: Floats, steps: Floats) -> Floats:
    """Round readings to the steps of their axes.

    Args:
        wrench: Readings (n, 6) in N and Nm.
        steps: Steps (6,); 0 is no step.

    Returns:
        The readings (n, 6).
    """
    return np.where(steps > 0.0, np.round(wrench / np.where(steps > 0.0, steps, 1.0)) * steps, wrench)


def log_uniform(r: np.random.Generator, low: float, high: float) -> float:
    """Draw from a distribution that is uniform in the logarithm.

    Args:
        low: Lower bound, above zero, in the unit of what is drawn.
        high: Upper bound, in the same unit.
    """
    return float(np.exp(r.uniform(np.log(low), np.log(high))))
