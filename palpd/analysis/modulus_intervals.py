"""95 % intervals of the moduli by equation 1: noise, the height of the surface, and the weight of the probe where two slopes of Fz part.

A correction for two slopes (`sensor.fz_slopes: both`) needs the weight that hung on the sensor at the tare. A weight that is wrong by δ
shifts every contact force above that weight by (ratio - 1) δ. It does not average out. A smaller force it does not change.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from palpd.cell.cell_file import nominal
from palpd.control.slopes import GRAVITY_N_PER_KG
from palpd.control.surface import FEWEST_SAMPLES, correlation_time, fitted_part, surface_from_approach
from palpd.errors import RecordingError
from palpd.recording.header import RecordingHeader
from palpd.tick import Floats

NORMAL_95 = 1.959964
"""Two-sided 95 % point of a normal distribution, for errors whose standard deviation is known."""
APPROACH_SAMPLES = 500
"""Number of means that an approach is averaged to: the fit of a surface gains nothing by more, and takes its time for each."""


@dataclass(frozen=True, slots=True)
class KnownWeight:
    """What is known of the weight that hung on the sensor at the tare. Without a correction for two slopes it matters nothing.

    Attributes:
        force_sigma_N: One standard deviation that its tolerance leaves on a contact force above that weight.
    """

    weight_N: float = 0.0
    force_sigma_N: float = 0.0

    @classmethod
    def of(cls, header: RecordingHeader) -> "KnownWeight":
        """The weight by the cell of a recording, and the uncertainty of a force by the ratio of the sensor's two slopes.

        Returns:
            The weight; without uncertainty where the readings were not corrected for two slopes.
        """
        config, ratio = header.get("config", {}), header.get("about", {}).get("pulled_over_pressed")
        cell = config.get("cell") or {}
        if config.get("sensor", {}).get("fz_slopes") != "both" or ratio is None or "tolerances" not in cell:
            return cls()
        mass_kg, sigma_kg = cell["probe"]["mass_kg"], cell["tolerances"]["mass_kg"]
        return cls(GRAVITY_N_PER_KG * mass_kg, abs(ratio - 1.0) * GRAVITY_N_PER_KG * sigma_kg)

    def shift_N(self, force_N: Floats) -> Floats:
        """How far contact forces shift together where the weight is one standard deviation off.

        Args:
            force_N: Contact forces (n,).

        Returns:
            The shifts (n,) in N.
        """
        return np.where(force_N > self.weight_N, self.force_sigma_N, 0.0)


class PressScatter(NamedTuple):
    """One standard deviation from press to press: relative of the stiffness, and of the height of contact (a cell's `repeatability`)."""

    stiffness: float = 0.01
    surface_m: float = 0.0

    @classmethod
    def of(cls, header: RecordingHeader) -> "PressScatter":
        """The scatter by the cell of a recording; that of a nominal cell where the header holds none."""
        stated = (header.get("config", {}).get("cell") or {}).get("repeatability") or nominal().repeatability.model_dump()
        return cls(stated["stiffness"], stated["surface_z_m"])


class Measured(NamedTuple):
    """One modulus by equation 1, and what it was computed from. `noise_sigma_N` is the standard deviation of its force."""

    modulus_Pa: float
    force_N: float
    depth_m: float
    noise_sigma_N: float

    @property
    def is_usable(self) -> bool:
        """Whether it says something of the tissue: a press that pulled says nothing."""
        return math.isfinite(self.modulus_Pa) and self.force_N > 0.0


def mean_ci95_Pa(measured: Sequence[Measured], surface_sigma_m: float | None, weight: KnownWeight) -> list[float] | None:
    """95 % interval of a mean of moduli of one site.

    By E ~ F / d^1.5, noise is each modulus's own, while surface and weight shift all of them together. An error of the sensor's gain, of
    the tip and of Poisson's ratio is not in it.

    Args:
        surface_sigma_m: Standard deviation of the height of the surface; None where it is not known.
        weight: The weight at the tare.

    Returns:
        Low and high in Pa; None without a modulus or without a surface.
    """
    usable = [press for press in measured if press.is_usable]
    if not usable or surface_sigma_m is None:
        return None
    modulus_Pa, force_N, depth_m, noise_N = np.array(usable).T
    own_Pa = modulus_Pa * noise_N / force_N
    of_surface_Pa = float(np.mean(1.5 * modulus_Pa / depth_m)) * surface_sigma_m
    of_weight_Pa = float(np.mean(modulus_Pa / force_N * weight.shift_N(force_N)))
    half_Pa = NORMAL_95 * math.hypot(math.sqrt(float(np.sum(own_Pa**2))) / len(usable), of_surface_Pa, of_weight_Pa)
    mean_Pa = float(np.mean(modulus_Pa))
    return [mean_Pa - half_Pa, mean_Pa + half_Pa]


def mean_sigma_N(force_N: Floats) -> float:
    """Standard deviation of the mean of forces whose noise is correlated in time.

    Args:
        force_N: Forces (n,).
    """
    if len(force_N) < 2:
        return 0.0
    return float(np.std(force_N, ddof=1)) * math.sqrt(min(correlation_time(force_N)[0] / len(force_N), 1.0))


def approach_sigma_m(tip_z_m: Floats, force_N: Floats, tip_radius_m: float, fits_slope: bool) -> float | None:
    """Standard deviation of the surface that an approach gives, by the fit that the search makes.

    Args:
        tip_z_m: Heights (n,) of the tip on its way down.
        force_N: Forces (n,) at these heights.
        fits_slope: Whether the search fitted the slope of the force in the air.

    Returns:
        The standard deviation in m; None where the approach cannot be fitted.
    """
    tip_z_m, force_N = fitted_part(tip_z_m, force_N)
    together = max(1, len(force_N) // APPROACH_SAMPLES)
    n = len(force_N) // together * together
    if n < FEWEST_SAMPLES * together:
        return None
    heights_m, forces_N = (values[-n:].reshape(-1, together).mean(axis=1) for values in (tip_z_m, force_N))
    try:
        return surface_from_approach(heights_m, forces_N, tip_radius_m, fits_slope)[1]
    except RecordingError:
        return None
