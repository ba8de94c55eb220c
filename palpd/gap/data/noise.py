"""How noisy a recording is: the stated noise, the measured noise, the steps of readings, and readings that repeat."""

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from palpd.cell.cell_file import CellFile
from palpd.cell.lattice import lattice_step
from palpd.gap.data.phases import Ints
from palpd.recording.oddities import dead, measured_rms
from palpd.recording.samples import Samples, runs_of_true
from palpd.tick import Floats

CHANNELS = ("z_m", "fx_N", "fy_N", "fz_N", "tx_Nm", "ty_Nm", "tz_Nm")
Z, FX, FY, FZ, TX, TY, TZ = range(7)


def resolutions(cell: CellFile) -> Floats:
    """Stated rounding step per channel (7,); heights are not rounded."""
    s = cell.sensor
    return np.array([0.0, s.resolution_fxy_N, s.resolution_fxy_N, s.resolution_fz_N, *[s.resolution_Nm] * 3])


def pure_rms(cell: CellFile) -> Floats:
    """Stated noise of one sample per channel (7,), before it is rounded."""
    s = cell.sensor
    return np.array([cell.robot.position_noise_rms_m, *[s.noise_rms_N] * 3, *[s.noise_rms_Nm] * 3])


def declared_rms(cell: CellFile) -> Floats:
    """Stated noise of one sample per channel (7,), rounding included."""
    return np.asarray(np.sqrt(pure_rms(cell) ** 2 + resolutions(cell) ** 2 / 12.0))


SAME_READING = 1e-9
"""Change of a reading, as a share of its range, that is none: readings that were rotated into base axes repeat but for the last bits."""


def _repeats(readings: Floats) -> NDArray[np.bool_]:
    """Whether a reading repeats the reading before it (n - 1, k), of readings (n, k) of k axes."""
    return np.asarray(np.abs(np.diff(readings, axis=0)) <= SAME_READING * np.ptp(readings, axis=0))


def held_runs(samples: Samples) -> tuple[Ints, Ints, float]:
    """Stretches of rows whose six readings all repeat.

    Returns:
        First repeat and end (r,) of each, counted from the second row, and the probability that chance alone makes a row repeat: each live
        axis repeats by itself as often as it does while another axis changes.
    """
    live = [k for k in range(6) if not dead(samples.wrench[:, k])]
    none = np.zeros(0, dtype=np.intp)
    if not live:
        return none, none, 0.0
    same = _repeats(samples.wrench[:, live])
    together = np.asarray(same.all(axis=1))
    alone = [same[~np.delete(same, k, axis=1).all(axis=1), k] for k in range(len(live))] if len(live) > 1 else []
    shares = [max(float(axis.mean()), 1e-6) for axis in alone if len(axis)] or [_repeat_chance(samples.wrench[:, k]) for k in live]
    first, end = runs_of_true(together)
    if len(live) == 1:
        alone_values = samples.wrench[:, live[0]]
        held = ~np.isin(alone_values[first], (alone_values.min(), alone_values.max()))  # at its limit it repeats, and is not held
        first, end = first[held], end[held]
        if len(first) and (end - first).mean() < 3.0:
            return none, none, 0.0  # one axis alone repeats itself for many reasons
    return first, end, float(np.prod(shares))


def _repeat_chance(values: Floats) -> float:
    """How often neighbours of a signal at rest with normal noise round to the same step, over all places between steps."""
    step = lattice_step(values)
    if step == 0.0:
        return 1e-6
    pure = np.sqrt(max(measured_rms(values) ** 2 - step**2 / 12.0, (0.05 * step) ** 2))
    a = step / (np.sqrt(2.0) * pure)
    density = np.exp(-0.5 * a**2) / np.sqrt(2.0 * np.pi)
    return float(erf(a / np.sqrt(2.0)) - 2.0 / a * (1.0 / np.sqrt(2.0 * np.pi) - density))
