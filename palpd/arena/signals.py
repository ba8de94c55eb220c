"""What a recording shows of itself: rounding, noise, motion and contact, and how strong a change of its force is.

A recording is a mapping of columns (n,) in SI units: `t_s`, `z_m`, `fz_N`, perhaps `z_cmd_m`, and `surface_z_m`, the stated height of the
surface, where there is a contact. It imports nothing of the diagnosis that the arena scores.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

FloatArray = NDArray[np.float64]
Recording = Mapping[str, FloatArray]

MEAN_S = 0.02
"""Length of the means over which docs/reference/contract.md takes the SNR of an effect."""
BLOCK = 32
"""Rows of a block. Noise is the median over blocks, so that impacts and contacts do not count."""
WINDOWS = (5, 13, 33, 81)
"""Rows over which values are smoothed; more takes time and hardly any further noise."""
POWERS = (1.0, 1.5, 2.0, 3.0)
"""Powers of depth whose sum, with no weight below 0, follows the force of a contact; only its slope is used."""


class PlantingRefusedError(ValueError):
    """A law that the recording does not allow, or a size that it cannot have."""


def rounding_step(values: FloatArray) -> float:
    """Step of the lattice on which values (n,) stand, in their unit; 0 where they stand on none."""
    gaps = np.diff(np.unique(values))
    gaps = gaps[gaps > 1e-9 * np.max(np.abs(values), initial=0)]
    if not len(gaps):
        return 0.0
    counts = np.rint(gaps / gaps.min())
    step = float(gaps.sum() / counts.sum())
    return step if np.max(np.abs(gaps / step - counts)) < 0.1 else 0.0


def _powers(values: FloatArray) -> FloatArray:
    """Mean square of each block of BLOCK rows; a shorter rest is left out."""
    rows = min(BLOCK, len(values))
    return np.mean(values[: len(values) // rows * rows].reshape(-1, rows) ** 2, axis=1)


def noise(values: FloatArray) -> float:
    """Noise of values (n,), in their unit: rms of second differences, median over blocks, at least that of rounding."""
    return float(max(np.sqrt(np.median(_powers(np.diff(values, 2))) / 6), rounding_step(values) / np.sqrt(12)))


def noise_N(recording: Recording) -> float:
    """Noise of a sample of fz, in N.

    It takes noise as white. For a force that was filtered or resampled upstream it is too small: state `sigma_N` instead.
    """
    return noise(recording["fz_N"])


@cache
def _hat(window: int) -> FloatArray:
    """Matrix (window, window) from values to their fit by a quadratic."""
    terms = np.vander(np.linspace(-1, 1, window), 3)
    return terms @ np.linalg.pinv(terms)


def smooth(values: FloatArray) -> FloatArray:
    """Values (n,) without their noise: quadratics, in each block over the widest window that takes only noise there and next to it.

    Source: Savitzky and Golay 1964, doi:10.1021/ac60214a047.
    """
    out, most = values, (1.5 * noise(values)) ** 2
    plain = np.ones(max(1, len(values) // BLOCK))
    for window in WINDOWS:
        if window > len(values) / 4:
            break
        hat, half = _hat(window), window // 2
        trial = np.convolve(values, hat[half], "same")
        trial[:half], trial[-half:] = hat[:half] @ values[:window], hat[-half:] @ values[-window:]
        fits = np.pad((_powers(values - trial) <= most).astype(float), 1, mode="edge")
        plain = np.minimum.reduce([plain, fits[:-2], fits[1:-1], fits[2:]])
        if not plain.any():
            break
        share = np.interp(np.arange(len(values)), BLOCK * np.arange(len(plain)) + BLOCK / 2, plain)
        out = share * trial + (1 - share) * out
    return out


def motion(recording: Recording) -> tuple[FloatArray, FloatArray]:
    """Speed and acceleration (n,) of smoothed heights."""
    speed = smooth(np.gradient(smooth(recording["z_m"]), recording["t_s"], edge_order=2))
    return speed, smooth(np.gradient(speed, recording["t_s"], edge_order=2))


def acceleration(recording: Recording) -> FloatArray:
    """Acceleration (n,) of smoothed heights.

    Raises:
        PlantingRefusedError: If it is noise of the height: even and odd rows do not show the same one.
    """
    halves = [{name: recording[name][start::2] for name in ("t_s", "z_m")} for start in (0, 1)]
    even, odd = (np.interp(recording["t_s"], half["t_s"], motion(half)[1]) for half in halves)
    same = float(np.corrcoef(even, odd)[0, 1]) if np.ptp(even) and np.ptp(odd) else 0.0
    if same < 0.8:
        raise PlantingRefusedError(f"accelerations of even and odd rows correlate by {same:.2f}, but 0.8 is expected; take a faster motion")
    return motion(recording)[1]


def contact(recording: Recording) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Depth below the stated surface in m, force of the contact in N, and its slope over depth in N/m, (n,) each; zeros in the air."""
    force_N = smooth(recording["fz_N"])
    depth_m = np.maximum(recording.get("surface_z_m", np.full_like(force_N, -np.inf)) - smooth(recording["z_m"]), 0)
    touching, deepest_m = depth_m > 0, float(depth_m.max()) or 1.0
    parts = [(depth_m / deepest_m)[touching] ** power for power in POWERS]
    weights = nnls(np.array(parts).T, force_N[touching])[0] if touching.any() else np.zeros(len(POWERS))
    slope = np.zeros_like(depth_m)
    slope[touching] = sum(w * k * (depth_m / deepest_m)[touching] ** (k - 1) for w, k in zip(weights, POWERS, strict=True)) / deepest_m
    return depth_m, np.where(touching, np.maximum(force_N, 0), 0), slope


def snr_against(healthy: Recording, *, sigma_N: float, free: Sequence[FloatArray] = ()) -> Callable[[Recording], float]:
    """Make the function that gives the SNR of an effect (docs/reference/contract.md) for recordings that belong to one healthy recording.

    It is the norm of the change of fz over means of 20 ms, less the best healthy deviation. Each mean counts in its own standard deviation.
    Deviations are subtracted by least squares, each at the cost of its size over its tolerance: an effect of one tolerance has an SNR of at
    most 1. The tolerances are the defaults of a cell file. Mass and heights have none, as these need a scale of the rig; that of the filter
    acts like latency. A changed height counts with the slope of the recorded contact. Rows that are NaN count as not changed.

    Args:
        healthy: Columns (n,). Where a law moves noise too, smooth fz in both recordings and give `sigma_N`.
        sigma_N: Noise of a sample.
        free: Further changes in N (n,) that are subtracted at no cost.

    Raises:
        PlantingRefusedError: If the noise is 0.
    """
    if not sigma_N > 0:
        raise PlantingRefusedError(f"the noise of fz is {sigma_N} N, but more than 0 is expected; state sigma_N")
    t_s, force_N, (depth_m, pressed_N, slope) = healthy["t_s"], smooth(healthy["fz_N"]), contact(healthy)
    columns = [np.full_like(t_s, 0.4 * sigma_N), 0.2 * sigma_N * (t_s - t_s[0]) / 60]  # bias, drift
    columns += [0.005 * force_N, 0.001 * np.gradient(force_N, t_s), 0.02 * pressed_N]  # gain, latency, modulus
    press = np.cumsum(np.diff(depth_m > 0, prepend=False) & (depth_m > 0))
    columns += [np.where(press == number, 0.01 * pressed_N, 0) for number in range(1, press[-1] + 1) if pressed_N.any()]
    place = np.unique(((t_s - t_s[0]) / MEAN_S).astype(int), return_inverse=True)[1]
    scale = sigma_N * np.sqrt(np.bincount(place))
    whitened = [np.bincount(place, column) / scale for column in (*columns, *free)]
    directions, lengths, _ = np.linalg.svd(np.vstack([np.array(whitened).T, np.eye(len(columns), len(whitened))]), full_matrices=False)
    directions = directions[:, lengths > 1e-9 * lengths[0]]

    def snr_of(changed: Recording) -> float:
        change_N = changed["fz_N"] - healthy["fz_N"] + slope * (changed["z_m"] - healthy["z_m"])
        target = np.append(np.bincount(place, np.nan_to_num(change_N)) / scale, np.zeros(len(columns)))
        return float(np.linalg.norm(target - directions @ (directions.T @ target)))

    return snr_of
