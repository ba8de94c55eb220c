"""What a recording is compared with where healthy recordings are given, and how far these themselves would be called changed.

What was learned of a cell is a model, and no model of a rig is right. Where it is wrong, a healthy recording is improbable under it, and
some effect or something unknown explains it better. How much better, the healthy recordings show: each is diagnosed against the others, as
a new one will be. What is unexplained then counts as noise, so much that the one that looks least healthy is no alarm.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import log

from threadpoolctl import threadpool_limits

from palpd.cell.cell_file import CellFile
from palpd.cell.effects import Effect
from palpd.gap.assumptions import ASSUMED
from palpd.gap.data.observations import observe
from palpd.gap.healthy import HealthyCell
from palpd.gap.infer.posterior import Attribution, posterior
from palpd.gap.infer.search import search
from palpd.gap.infer.settle import settle
from palpd.gap.model.problem import MAX_BINS, problem_of
from palpd.gap.nominal_source import nominal_source
from palpd.gap.onset import since_onset
from palpd.gap.user_simulator import UserSimulator
from palpd.gap.usual import PRICE_NATS, ComparedRecording, UsualChanges
from palpd.recording.samples import Samples

LARGEST_SET = 1
"""Largest number of effects that may explain a healthy recording: a third one hardly changes how probable it is, and takes long."""
FEWEST = 3
"""Fewest healthy recordings that can be judged: two others show a spread, one does not."""
LEAST_PROBABILITY = 1e-300
"""Smaller probabilities are not told apart."""


@dataclass(frozen=True)
class HealthyReference:
    """What new recordings are compared with.

    Attributes:
        restless: Factor, at least 1, on the variance of what is unexplained, with which no healthy recording is called changed.
    """

    usual: UsualChanges
    restless: float

    @property
    def learned(self) -> HealthyCell:
        """The healthy cell."""
        return self.usual.healthy

    @staticmethod
    def of(healthy: Sequence[Samples], cell: CellFile, library: Mapping[str, Effect]) -> "HealthyReference":
        """Learn a healthy cell, and judge its recordings by each other.

        Args:
            cell: Its cell file; the numbers need not be right.
            library: Effects of that cell by id.

        Raises:
            RecordingError: The recordings cannot be judged.
        """
        usual = UsualChanges.of(healthy, HealthyCell.of(healthy, cell, library))
        with threadpool_limits(1):  # as in a diagnosis
            return HealthyReference(usual, _restless(usual))

    def simulator(self, now: Samples) -> UserSimulator:
        """The simulator of the healthy cell for a recording that is compared."""
        return self.usual.allowed(since_onset(self.learned.simulator(), self.learned, now), now, self.restless)


def _restless(usual: UsualChanges) -> float:
    if len(usual.compared) < FEWEST:
        return 1.0
    before = log((1.0 - ASSUMED.prior.none) / ASSUMED.prior.none) - PRICE_NATS
    least = log((1.0 - ASSUMED.naming.p_none_to_acquit) / ASSUMED.naming.p_none_to_acquit)
    largest = max(_log_odds(_taken_for(one, usual.without(one))) for one in usual.compared)
    return max(1.0, (largest - before) / (least - before))


def _taken_for(one: ComparedRecording, others: UsualChanges) -> Attribution:
    """What a healthy recording is taken for, by what the others show."""
    cell, library = others.healthy.compared_cell, others.healthy.library
    simulator = others.allowed(others.healthy.simulator(), one.recording)
    observations = observe([one.recording], cell, library, [simulator], MAX_BINS)
    source = nominal_source(observations.recordings, observations.cell, library)
    judged = {name: effect for name, effect in library.items() if source is None or name not in source.not_judged}
    nominal = settle(problem_of(observations, judged))
    return posterior(nominal.problem, search(nominal, LARGEST_SET).fits)


def _log_odds(attribution: Attribution) -> float:
    """Logarithm of the odds that something acts."""
    return log(max(1.0 - attribution.p_none, LEAST_PROBABILITY)) - log(max(attribution.p_none, LEAST_PROBABILITY))
