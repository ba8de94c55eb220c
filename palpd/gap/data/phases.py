"""What the probe is doing at every sample of a recording: free or in contact, moving or not, and in which cycle."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpd.cell.cell_file import CellFile
from palpd.recording.samples import Samples, runs_of_true
from palpd.tick import Floats

Ints = NDArray[np.intp]

PHASES = ("free_still", "free_moving", "loading", "holding", "unloading")
FREE_STILL, FREE_MOVING, LOADING, HOLDING, UNLOADING = range(5)

PHASE_PHRASES = {
    "free_still": "at rest in the air",
    "free_moving": "during free motion",
    "loading": "while the probe presses in",
    "holding": "during holds",
    "unloading": "while the probe retracts",
}
"""The phases within a sentence."""


ROUNDING = 1e-12
"""Change of a height, as a share of its size, that only rounding makes: numbers of 16 digits keep 12 of them through a conversion."""


@dataclass(frozen=True)
class Phases:
    """What the probe does at every sample.

    Attributes:
        phase: Index into PHASES (n,).
        moving: Whether it moves (n,).
        velocity_m_per_s: Commanded speed (n,); the smoothed reported speed without a command.
        depth_m: Depth below the nominal surface (n,), 0 in free space.
        cycle: Number of the cycle (n,): a press, with half of the free motion before and after it.
        press: Number of the press (n,), -1 for none.
        since_s: Time since the motion last began or ended (n,).
        until_s: Time until the motion next begins or ends (n,).
    """

    phase: Ints
    moving: NDArray[np.bool_]
    velocity_m_per_s: Floats
    depth_m: Floats
    cycle: Ints
    press: Ints
    since_s: Floats
    until_s: Floats

    @property
    def cycles(self) -> int:
        """Number of cycles."""
        return int(self.cycle.max()) + 1

    @property
    def presses(self) -> int:
        """Number of presses."""
        return int(self.press.max()) + 1


def find_phases(samples: Samples, cell: CellFile) -> Phases:
    """Find the five phases of a recording.

    Contact is where the reported height is below the nominal surface. Moving is |v| > min(1 mm/s, 5 % of the 95th percentile
    of |v|). v is the derivative of the commanded height where there is a command, else the reported speed low-passed at 5 Hz.
    """
    surface_m = cell.tissue.surface_z_m if cell.tissue is not None else -np.inf
    velocity = _velocity(samples)
    speed = np.abs(velocity)
    rounding_m_per_s = ROUNDING * float(np.abs(samples.z_m).max()) * samples.rate_Hz
    moving = speed > max(min(1e-3, 0.05 * float(np.percentile(speed, 95))), rounding_m_per_s)
    contact = samples.z_m < surface_m
    phase = np.where(
        contact,
        np.where(moving, np.where(velocity < 0, LOADING, UNLOADING), HOLDING),
        np.where(moving, FREE_MOVING, FREE_STILL),
    )
    cycle, press = _cycles(samples, surface_m, cell.robot.position_noise_rms_m, moving)
    changes = np.flatnonzero(np.diff(moving.astype(np.int8))) + 1
    edges = np.concatenate([[0], changes, [len(moving)]])
    segment = np.repeat(np.arange(len(edges) - 1), np.diff(edges))
    since_s = samples.t_s - samples.t_s[edges[segment]]
    until_s = samples.t_s[np.minimum(edges[segment + 1], len(moving) - 1)] - samples.t_s
    return Phases(phase, moving, velocity, np.maximum(0.0, surface_m - samples.z_m), cycle, press, since_s, until_s)


def _velocity(samples: Samples) -> Floats:
    if samples.z_cmd_m is not None:
        return np.asarray(np.gradient(samples.z_cmd_m, samples.t_s))
    if samples.rate_Hz <= 10.0:
        return samples.vz_m_per_s
    from scipy.signal import butter, sosfiltfilt  # here, since a recording with a command needs none of its 0.3 s

    # One low-pass at 5 Hz, run both ways so that the phases are not late.
    sos = butter(1, 5.0, fs=samples.rate_Hz, output="sos")
    return np.asarray(sosfiltfilt(sos, samples.vz_m_per_s))


def _cycles(samples: Samples, surface_m: float, noise_m: float, moving: NDArray[np.bool_]) -> tuple[Ints, Ints]:
    """Cycle and press of each sample.

    A press is a stay below the surface, deeper than noise; its cycle reaches half-way to the next. Without two presses, strokes take
    their place, and without strokes eight blocks of equal length.
    """
    n = len(samples)
    depth = surface_m - samples.z_m
    press = np.full(n, -1, dtype=np.intp)
    begins, ends = runs_of_true(depth > 0)
    real = [(a, b) for a, b in zip(begins, ends, strict=True) if depth[a:b].max() > 6 * noise_m + 0.02 * max(depth.max(), 0.0)]
    for k, (a, b) in enumerate(real):
        press[a:b] = k
    if len(real) >= 2:
        borders = [(real[k][1] + real[k + 1][0]) // 2 for k in range(len(real) - 1)]
    else:
        begins, ends = runs_of_true(moving)
        borders = [int(a) for a in begins[2::2]] if len(real) == 0 and len(begins) >= 4 else [n * k // 8 for k in range(1, 8)]
    cycle = np.searchsorted(np.asarray(borders), np.arange(n), side="right").astype(np.intp)
    return cycle, press
