"""When, in a recording that is compared with a healthy cell, the change begins.

The rows before an onset are healthy: they also show how the cell deviates on this day, within what healthy recordings do. From these the
rows after it are predicted. The onset is where the likelihood of that is largest; without any it is the whole recording that changed.
"""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpd.cell.tip_motion import estimate_tip_motion
from palpd.gap.data.noise import CHANNELS, FZ, declared_rms
from palpd.gap.data.phases import Ints
from palpd.gap.healthy import HealthyCell, means_between, neighbours_alike
from palpd.gap.user_simulator import MotionColumns, SimulatorDoubt, UserSimulator, asked
from palpd.recording.samples import Samples
from palpd.tick import Floats

PLACES = 120
"""Number of means of a recording, and of places at which a change may begin."""
EDGE = 0.08
"""Share of a recording at both ends in which no change can be seen to begin: its part would be too short to judge."""
LEAST_MEANS = 5
"""Fewest means before and behind an onset."""
SPEEDS = 3
"""Levels of speed in each direction that count as different motions."""
MOST_ALIKE = 0.9
"""Largest correlation of neighbouring means that is believed."""
CLEAR_NATS = 8.0
"""Gain of log likelihood from which on a change has an onset."""
CHANGED = 4.0
"""Mean square of what changed, in that of a healthy recording, below which nothing has changed."""


class _Means(NamedTuple):
    """Means (b,) of fz less its prediction, with their standard deviation.

    `deviations` (b, m) are those of a healthy cell, each of one standard deviation. `motion` numbers the motion: of means with one number a
    change that lasts shows in all.
    """

    residual: Floats
    sd: Floats
    deviations: Floats
    motion: Ints

    def among(self, kept: NDArray[np.bool_]) -> "_Means":
        return _Means(self.residual[kept], self.sd[kept], self.deviations[kept], self.motion[kept])


def since_onset(simulator: UserSimulator, healthy: HealthyCell, recording: Samples) -> UserSimulator:
    """A simulator of a healthy cell that judges nothing before the onset of a change.

    Args:
        simulator: As it was learned.
        recording: What is compared.

    Returns:
        The simulator with the time of the onset; as it was where no onset shows.
    """
    begin, own = _onset(healthy, recording), simulator.doubt
    if begin is None or own is None:
        return simulator
    after_s = float(recording.t_s[begin] - recording.t_s[0])

    def doubt(motion: MotionColumns) -> SimulatorDoubt:
        learned = own(motion)
        return replace(learned, known=learned.known & (motion["t_s"] - motion["t_s"][0] >= after_s))

    return replace(simulator, onset_s=float(recording.t_s[begin]), doubt=doubt)


def _onset(healthy: HealthyCell, recording: Samples) -> int | None:
    """The row at which a change begins; None where no onset shows."""
    edges = np.linspace(0, len(recording), min(PLACES, len(recording) // 8) + 1).astype(int)
    means = _means(healthy, recording, edges)
    count = len(means.sd)
    gains = [(*_gain(means, place), place) for place in range(round(EDGE * count), round((1.0 - EDGE) * count))]
    gain, changed, place = max(gains, default=(0.0, 0.0, 0))
    return None if gain < CLEAR_NATS or changed < CHANGED else int(edges[place])


def _means(healthy: HealthyCell, recording: Samples, edges: Ints) -> _Means:
    tip = estimate_tip_motion(healthy.cell, recording.t_s, recording.z_m, recording.vz_m_per_s, recording.z_cmd_m)
    motion = asked(tip, recording.z_cmd_m)
    doubt, rows = healthy.doubt(motion), np.diff(edges)
    mean = partial(means_between, edges)
    elapsed_min = (recording.t_s - recording.t_s[0]) / 60.0
    bounds = healthy.cell.tolerances
    own = [np.full_like(elapsed_min, bounds.bias_N), bounds.drift_N_per_min * elapsed_min]
    residual = recording.wrench[:, FZ - 1] - healthy.predict(motion)[CHANNELS[FZ]]
    noise = float(declared_rms(healthy.cell)[FZ]) / np.sqrt(rows)
    fastest = max(float(np.abs(motion["vz_m_per_s"]).max()), 1e-300)
    speed, z_m = np.rint(SPEEDS * mean(motion["vz_m_per_s"]) / fastest).astype(int), mean(motion["z_m"])
    height = np.where(z_m < healthy.surface_m, 1 + healthy.motions.interval(z_m), 0)
    sd, deviations = np.sqrt(noise**2 + mean(doubt.unexplained[FZ] ** 2)), mean(np.column_stack([*doubt.errors[:, FZ], *own]))
    means = _Means(mean(residual), sd, deviations, speed + (2 * SPEEDS + 1) * height)
    return means.among(mean(doubt.known.astype(float)) == 1.0)


def _gain(means: _Means, place: int) -> tuple[float, float]:
    """What an onset gains in log likelihood, and the mean square of what it changes, in that of a healthy cell.

    Only motions that occur before and behind the onset count: a press shows nothing of what was well in the air.
    """
    before = np.arange(len(means.sd)) < place
    shared = np.intersect1d(means.motion[before], means.motion[~before])
    kept = np.isin(means.motion, shared)
    early, late, both = means.among(kept & before), means.among(kept & ~before), means.among(kept)
    if min(len(early.sd), len(late.sd)) < LEAST_MEANS:
        return 0.0, 0.0
    healthy, deviation, precision = _healthy(early)
    changed, square = _changed(late, deviation, precision)
    throughout, _ = _changed(both, np.zeros_like(deviation), np.eye(len(deviation)))
    white = (early.residual - early.deviations @ deviation) / early.sd
    alike = min(max(neighbours_alike(white), 0.0), MOST_ALIKE)
    return (healthy + changed - throughout) * (1.0 - alike) / (1.0 + alike), square


def _healthy(means: _Means) -> tuple[float, Floats, Floats]:
    """Log likelihood of a healthy cell, its most probable deviations (m,), and the precision of these (m, m)."""
    x, y = means.deviations / means.sd[:, None], means.residual / means.sd
    precision = np.eye(x.shape[1]) + x.T @ x
    deviation = np.asarray(np.linalg.solve(precision, x.T @ y), dtype=float)
    square = float(y @ y - (x.T @ y) @ deviation)
    return -0.5 * (square + float(np.linalg.slogdet(precision)[1])) - float(np.log(means.sd).sum()), deviation, precision


def _changed(means: _Means, deviation: Floats, precision: Floats) -> tuple[float, float]:
    """Log likelihood where residuals are as large as they are, and their mean square in that of a healthy cell."""
    variance = means.sd**2 + np.einsum("bm,bm->b", means.deviations, np.linalg.solve(precision, means.deviations.T).T)
    square = float(np.mean((means.residual - means.deviations @ deviation) ** 2 / variance))
    size = max(square, 1.0)
    return -0.5 * float(np.log(variance).sum() + len(variance) * (np.log(size) + square / size)), square
