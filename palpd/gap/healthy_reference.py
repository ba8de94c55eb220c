"""What a recording is compared with where healthy recordings are given, and what these themselves would be called.

What was learned of a cell is a model, and no model of a rig is right. Where it is wrong, a healthy recording is improbable under it, and
some effect or something unknown explains it better. Which, and how much better, the healthy recordings show: each is diagnosed against the
others, as a new one will be. An effect that one of them seems to have is a habit of the rig. It costs more than it gains there, and so do
effects that look alike.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import log

from threadpoolctl import threadpool_limits

from palpd.cell.cell_file import CellFile
from palpd.cell.effects import Effect
from palpd.gap.beside_healthy import beside_healthy
from palpd.gap.data.observations import observe
from palpd.gap.data.recorded_noise import with_healthy_sensor
from palpd.gap.healthy import HealthyCell
from palpd.gap.infer.posterior import posterior, single_odds
from palpd.gap.infer.search import search
from palpd.gap.infer.settle import settle
from palpd.gap.model.problem import MAX_BINS, problem_of
from palpd.gap.nominal_source import nominal_source
from palpd.gap.onset import since_onset
from palpd.gap.user_simulator import UserSimulator
from palpd.gap.usual import ComparedRecording, UsualChanges
from palpd.recording.samples import Samples

LARGEST_SET = 1
"""Largest number of effects that may explain a healthy recording: a third one hardly changes how probable it is, and takes long."""
FEWEST = 3
"""Fewest healthy recordings that can be judged: two others show a spread, one does not."""
LEAST = 1e-300
"""Smaller probabilities are not told apart."""
HABIT = 2.0
"""What an effect costs, over the largest log odds that it has in a healthy recording: the next one may look worse than the worst of few."""


@dataclass(frozen=True)
class HealthyReference:
    """What new recordings are compared with.

    Attributes:
        habits: What effects cost beyond the least price, by id; of something unknown by "".
    """

    usual: UsualChanges
    habits: Mapping[str, float]

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
        with threadpool_limits(1):  # as in a diagnosis
            learned = HealthyCell.of(healthy, with_healthy_sensor(healthy, cell), beside_healthy(library))
            usual = UsualChanges.of(healthy, learned)
            return HealthyReference(usual, _habits(usual))

    def simulator(self, now: Samples) -> UserSimulator:
        """The simulator of the healthy cell for a recording that is compared."""
        with threadpool_limits(1):
            return self.usual.allowed(since_onset(self.learned.simulator(), self.learned, now), now, self.habits)


def _habits(usual: UsualChanges) -> Mapping[str, float]:
    if len(usual.compared) < FEWEST:
        return {}
    odds, alike = [_odds_of(one, usual.without(one)) for one in usual.compared], usual.alike()
    largest = {name: max(0.0, *(each.get(name, 0.0) for each in odds)) for name in sorted({name for each in odds for name in each})}
    of_kin = {name: max(nats * alike.get((name, other), float(name == other)) for other, nats in largest.items()) for name in largest}
    return {name: HABIT * nats for name, nats in of_kin.items() if nats > 0.0}


def _odds_of(one: ComparedRecording, others: UsualChanges) -> Mapping[str, float]:
    """Log odds of each effect in a healthy recording against none, by what the others show; of something unknown by ""."""
    cell, library = others.healthy.compared_cell, others.healthy.library
    simulator = others.allowed(others.healthy.simulator(), one.recording)
    observations = observe([one.recording], cell, library, [simulator], MAX_BINS)
    source = nominal_source(observations.recordings, observations.cell, library)
    judged = {name: effect for name, effect in library.items() if source is None or name not in source.not_judged}
    nominal = settle(problem_of(observations, judged))
    fits = search(nominal, LARGEST_SET).fits
    (none,) = (each for each in posterior(nominal.problem, fits).hypotheses if not each.fit.names)
    unknown, odds = log(max(none.unknown, LEAST)) - log(max(none.known, LEAST)), single_odds(nominal.problem, fits)
    return {"": max(unknown, *odds.values()), **odds}  # what an effect explains, something of any shape does, too
