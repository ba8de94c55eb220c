"""How far an enriched cell closes the gap on a motion that the diagnosis has not seen."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from palpd.cell.cell_file import CellFile
from palpd.cell.simulation import simulate
from palpd.gap.diagnosis import Diagnosis
from palpd.gap.noise import CHANNELS, declared_rms
from palpd.recording.samples import WRENCH_COLUMNS, Samples
from palpd.tick import Floats

MEAN_S = 0.02
"""Length of the means that are compared; shorter than any phase of a motion."""
LEAST_GAP = 1.5
"""Least gap before, as a multiple of the noise of a mean, for a statement on the closed share."""


@dataclass(frozen=True)
class MotionCheck:
    """Means over 20 ms of one channel on another motion.

    Attributes:
        channel: The channel.
        t_s: Times (n,) of the means.
        measured: What was measured (n,).
        plain: What the cell predicts without effects and laws, its fitted deviations within tolerance included (n,).
        enriched: What the enriched cell predicts (n,).
        noise: Standard deviation of a mean by the stated noise and rounding.
    """

    channel: str
    t_s: Floats
    measured: Floats
    plain: Floats
    enriched: Floats
    noise: float

    @property
    def before_rms(self) -> float:
        """Rms of measured minus predicted without effects and laws."""
        return float(np.sqrt(np.mean((self.measured - self.plain) ** 2)))

    @property
    def after_rms(self) -> float:
        """Rms of measured minus predicted by the enriched cell."""
        return float(np.sqrt(np.mean((self.measured - self.enriched) ** 2)))

    @property
    def closed(self) -> float | None:
        """Share of the gap beyond the noise that is closed, 1 - (after² - noise²) / (before² - noise²); None without a gap."""
        before, after, noise = self.before_rms, self.after_rms, self.noise
        return None if before < LEAST_GAP * noise else min(1.0, 1.0 - (after**2 - noise**2) / (before**2 - noise**2))

    def to_json(self) -> dict[str, Any]:
        """The figures."""
        figures = {"before_rms": self.before_rms, "after_rms": self.after_rms, "noise": self.noise, "closed": self.closed}
        return {"channel": self.channel, "duration_s": float(self.t_s[-1] - self.t_s[0])} | figures


def check_on(diagnosis: Diagnosis, samples: Samples) -> MotionCheck:
    """Compare another recording of the same cell with what the diagnosed one lets expect.

    Args:
        diagnosis: The diagnosis.
        samples: A recording that it has not seen.

    Returns:
        The comparison in the channel of the learned law, or in that of the largest gap without one.
    """
    enriched, nominal = diagnosis.enriched_cell(), diagnosis.problem.cell
    learned = diagnosis.finding.learned
    if learned is not None:
        channel: str = max(learned.terms[0].channels.items(), key=lambda item: abs(item[1]) * (item[0] not in ("tx_Nm", "ty_Nm")))[0]
    else:
        channel = diagnosis.where["channel"] if diagnosis.where is not None else "fz_N"
    plain = enriched.model_copy(update={"effects": nominal.effects, "learned": nominal.learned})
    height, t_s = channel == "z_m", samples.t_s - samples.t_s[0]
    z_m, vz_m_per_s = (None, None) if height else (samples.z_m, samples.vz_m_per_s)
    rows = max(1, round(MEAN_S * samples.rate_Hz))

    def predicted(cell: CellFile) -> Floats:
        library = diagnosis.problem.library
        columns = simulate(cell, t_s, z_cmd_m=samples.z_cmd_m, z_m=z_m, vz_m_per_s=vz_m_per_s, library=library)
        return _means(columns[channel], rows)

    measured = samples.z_m if height else np.asarray(samples.wrench[:, WRENCH_COLUMNS.index(channel)])
    noise = float(declared_rms(nominal)[CHANNELS.index(channel)]) / rows**0.5
    return MotionCheck(channel, _means(t_s, rows), _means(measured, rows), predicted(plain), predicted(enriched), noise)


def _means(values: Floats, rows: int) -> Floats:
    """Means (n,) over stretches of rows."""
    return np.asarray(values[: len(values) // rows * rows].reshape(-1, rows).mean(axis=1))
