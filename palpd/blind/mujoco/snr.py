"""How large an effect is: its signal-to-noise ratio beside everything that a healthy cell may do, and where it is largest."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpd.blind.mujoco.setup import Array, StatedCell
from palpd.blind.stated_cell import CHANNELS, PHASES
from palpd.recording.samples import Samples

BIN_S = 0.02
"""Length of the means that docs/reference/contract.md compares (§5)."""
MIN_ROWS_IN_PHASE = 20
"""A phase with fewer rows has no rms worth a place in the table."""


@dataclass(frozen=True)
class Yardstick:
    """The healthy variation of one recording: directions (k, n, 7) of one declared standard deviation each, and the noise of a row."""

    directions: Array
    sigma: Array
    bins: NDArray[np.intp]
    weight: Array

    def whitened(self, change: Array) -> Array:
        """Means of 20 ms of a change, in standard deviations of such a mean.

        Args:
            change: (n, 7) change of height and wrench.

        Returns:
            One vector of all means.
        """
        count = np.bincount(self.bins)
        means = np.column_stack([np.bincount(self.bins, weights=column) for column in change.T]) / count[:, None]
        return np.asarray((means * self.weight).ravel())


def yardstick(samples: Samples, cell: StatedCell, directions: list[Array]) -> Yardstick:
    """The yardstick of a recording.

    Args:
        samples: gives the times.
        cell: gives the noise and the robot's report rate.
        directions: (n, 7) changes for one standard deviation of every tolerance and of every press.
    """
    bins = np.floor(samples.t_s / BIN_S + 1e-9).astype(np.intp)
    rows = np.bincount(bins).astype(float)
    reports = np.minimum(rows, max(1.0, BIN_S * cell.report_rate_Hz))
    weight = np.sqrt(np.column_stack([reports, *[rows] * 6])) / cell.sigma
    return Yardstick(np.array(directions), cell.sigma, bins, weight)


def snr(change: Array, scale: Yardstick) -> tuple[float, float]:
    """The signal-to-noise ratio of a change (contract §5), in two readings of "projected out".

    The first takes every healthy direction as normal with its declared standard deviation, so that a bias of ten tolerances still
    counts. The second lets every direction take any size: what the tolerances can imitate counts nothing.

    Args:
        change: (n, 7) noise-free change of height and wrench.

    Returns:
        Both ratios.
    """
    c = scale.whitened(change)
    d = np.column_stack([scale.whitened(direction) for direction in scale.directions])
    dc = d.T @ c
    kept = float(c @ c - dc @ np.linalg.solve(np.eye(d.shape[1]) + d.T @ d, dc))
    size = np.linalg.norm(d, axis=0)
    q, r = np.linalg.qr(d[:, size > 1e-9] / size[size > 1e-9])
    basis = q[:, np.abs(np.diag(r)) > 1e-6]
    left = c - basis @ (basis.T @ c)
    return float(np.sqrt(max(0.0, kept))), float(np.linalg.norm(left))


def sizes(change: Array, phases: NDArray[np.intp], scale: Yardstick) -> list[dict[str, Any]]:
    """The size of a change at every channel and phase: its rms over the floor of a healthy cell (contract §5), largest first.

    Args:
        change: (n, 7) noise-free change.
        phases: (n,) number of the phase of every row.
        scale: noise and healthy directions.

    Returns:
        One entry for every place with at least 20 rows: channel, phase, rms, floor, size.
    """
    table: list[dict[str, Any]] = []
    for number, phase in enumerate(PHASES):
        rows = phases == number
        if rows.sum() < MIN_ROWS_IN_PHASE:
            continue
        rms = np.sqrt((change[rows] ** 2).mean(axis=0))
        floor = np.sqrt(scale.sigma**2 + (scale.directions[:, rows] ** 2).mean(axis=1).sum(axis=0))
        table += [
            {"channel": channel, "phase": phase, "rms": float(rms[k]), "floor": float(floor[k]), "size": float(rms[k] / floor[k])}
            for k, channel in enumerate(CHANNELS)
        ]
    return sorted(table, key=lambda entry: -entry["size"])
