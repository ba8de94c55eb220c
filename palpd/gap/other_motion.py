"""How far an enriched cell closes the gap on a motion that the diagnosis has not seen."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from palpd.cell.cell_file import CellFile
from palpd.errors import BadInput
from palpd.gap.data.noise import CHANNELS, declared_rms
from palpd.gap.diagnosis import Diagnosis
from palpd.gap.model.problem import make_problem
from palpd.gap.plain import CHANNEL_WORDS, unit_of
from palpd.quantities import quantity
from palpd.recording.samples import Samples
from palpd.tick import Floats

MEAN_S = 0.02
"""Length of the stretches whose means are compared; shorter than any phase of a motion."""
LEAST_GAP = 1.5
"""Least gap before, as a multiple of the noise of a mean, for a statement on the closed share."""


@dataclass(frozen=True)
class MotionCheck:
    """Means over 20 ms of one channel on another motion.

    Attributes:
        t_s: Times (n,) of the means, from the first sample.
        measured: Measured means (n,), in the unit of the channel.
        plain: Prediction (n,) of the cell without the found effects and laws, with its fitted deviations within tolerance.
        enriched: Prediction (n,) of the enriched cell.
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
        """Rms of measured minus predicted without the found effects and laws, in the unit of the channel."""
        return float(np.sqrt(np.mean((self.measured - self.plain) ** 2)))

    @property
    def after_rms(self) -> float:
        """Rms of measured minus predicted by the enriched cell, in the unit of the channel."""
        return float(np.sqrt(np.mean((self.measured - self.enriched) ** 2)))

    @property
    def closed(self) -> float | None:
        """Share of the gap beyond the noise that is closed, 1 - (after² - noise²) / (before² - noise²); None without a gap."""
        before, after, noise = self.before_rms, self.after_rms, self.noise
        return None if before < LEAST_GAP * noise else min(1.0, 1.0 - (after**2 - noise**2) / (before**2 - noise**2))

    @property
    def sentence(self) -> str:
        """How far off the cell is without and with what was found, in words."""
        unit = unit_of(self.channel)
        before, after, noise = (quantity(value, unit) for value in (self.before_rms, self.after_rms, self.noise))
        closed = "" if self.closed is None else f" {100 * self.closed:.0f} % of the gap closes there."
        return (
            f"On a motion of {self.t_s[-1]:.0f} s that the diagnosis has not seen, the {CHANNEL_WORDS[self.channel]} is {before} rms off "
            f"without what was found and {after} with it; noise alone makes {noise}.{closed}"
        )

    def to_json(self) -> dict[str, Any]:
        """The comparison for JSON: channel, sentence, duration and figures."""
        figures = {"before_rms": self.before_rms, "after_rms": self.after_rms, "noise": self.noise, "closed": self.closed}
        return {"channel": self.channel, "sentence": self.sentence, "duration_s": float(self.t_s[-1] - self.t_s[0])} | figures


def check_on(diagnosis: Diagnosis, samples: Samples) -> MotionCheck:
    """Compare another recording of the same cell with the prediction of its enriched cell.

    Args:
        samples: A recording that the diagnosis has not seen.

    Returns:
        The comparison in the channel of the learned law, or without a law in that of the largest gap.

    Raises:
        BadInput: The nominal is the output of a user's simulator for the diagnosed motion alone.
    """
    enriched, nominal = diagnosis.enriched_cell(), diagnosis.problem.cell
    learned = diagnosis.decision.learned
    if learned is not None:
        channel: str = max(learned.terms[0].channels.items(), key=lambda item: abs(item[1]) * (item[0] not in ("tx_Nm", "ty_Nm")))[0]
    else:
        channel = diagnosis.gap.where["channel"] if diagnosis.gap.where is not None else "fz_N"
    plain = enriched.model_copy(update={"effects": nominal.effects, "learned": nominal.learned})
    simulators = [its.simulated.simulator for its in diagnosis.problem.recordings if its.simulated is not None][:1]
    if simulators and not simulators[0].any_motion:
        raise BadInput(
            f"the nominal is {simulators[0].name}, which holds the diagnosed motion alone, and another motion is asked for; give a "
            "function, which can be asked again"
        )
    problem = make_problem([samples], nominal, diagnosis.problem.library, simulators=simulators)
    one, rows = problem.recordings[0], max(1, round(MEAN_S * samples.rate_Hz))
    k = CHANNELS.index(channel)

    def predicted(cell: CellFile) -> Floats:
        return _means(problem.raw_prediction(one, cell)[:, k], rows)

    measured = np.column_stack([samples.z_m, samples.wrench])[:, k]
    noise = float(declared_rms(nominal)[k]) / rows**0.5
    return MotionCheck(channel, _means(one.sampled.t_s, rows), _means(measured, rows), predicted(plain), predicted(enriched), noise)


def _means(values: Floats, rows: int) -> Floats:
    """Means (n,) over stretches of `rows` rows."""
    return np.asarray(values[: len(values) // rows * rows].reshape(-1, rows).mean(axis=1))
