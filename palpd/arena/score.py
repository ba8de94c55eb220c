"""What answers are worth, rig by rig: silence, cause, nothing else, what is outside the list, and stated probabilities."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import log2
from statistics import fmean, median

from palpd.arena.answers import ToolAnswer
from palpd.arena.cases import UNKNOWN, KnownTruth, Question
from palpd.quantities import wilson

LEAST_PROBABILITY = 0.01
"""Smaller ones count as this: a single answer then costs at most 6.6 bits a statement."""
MOST_ALIKE = 3
"""Most names that a group may have and still be an answer."""
COUNTED = 5
"""Fewest questions of a rig that counts in the mean over rigs."""


@dataclass(frozen=True)
class ScoredAnswer:
    """An answer beside its truth."""

    question: Question
    truth: KnownTruth
    answer: ToolAnswer

    @property
    def alarm(self) -> bool:
        """Whether the answer says that something acts."""
        return self.answer.verdict != "none"

    @property
    def first(self) -> bool:
        """Whether a true cause is named first; outside the list: whether the verdict is unknown."""
        if self.answer.failed:
            return False
        if self.truth.outside:
            return self.answer.verdict == UNKNOWN
        group = self.answer.named[0] if self.answer.named else frozenset()
        return len(group) <= MOST_ALIKE and any(group & names for names in self.truth.causes)

    @property
    def alone(self) -> bool:
        """Whether all listed causes are named and nothing else."""
        listed = [names for names in self.truth.causes if UNKNOWN not in names]
        right = all(any(group & names for names in listed) for group in self.answer.named)
        return self.first and right and all(any(group & names for group in self.answer.named) for names in listed)

    @property
    def right(self) -> bool:
        """Whether a healthy recording is kept silent, or a cause named first."""
        return self.first if self.truth.causes else not self.alarm

    @property
    def bits(self) -> float:
        """Logarithmic score: bits that the truth costs under the stated probabilities, 0 at best.

        Three statements count: whether anything acts, whether each true cause acts (the mean), and whether the false cause that the answer
        believes most acts.
        """
        answer, truth = self.answer, self.truth
        believed = {**answer.probability, UNKNOWN: answer.p_unknown}
        right = frozenset().union(*truth.causes) if truth.causes else frozenset()
        alike = frozenset().union(*(group for group in answer.named if group & right)) if answer.named else frozenset()
        false = max((p for name, p in believed.items() if name not in right | alike), default=0.0)
        present = [max((believed.get(name, 0.0) for name in names | alike), default=0.0) for names in truth.causes]
        return (
            _bits(answer.p_none if truth.healthy else 1.0 - answer.p_none)
            + (fmean(map(_bits, present)) if present else 0.0)
            + _bits(1.0 - false)
        )


@dataclass(frozen=True)
class Share:
    """How many of n, with the 95 % interval of Wilson."""

    right: int
    n: int

    @staticmethod
    def of(rows: Sequence[ScoredAnswer], holds: Callable[[ScoredAnswer], bool]) -> "Share":
        """For how many rows something holds."""
        return Share(sum(map(holds, rows)), len(rows))

    @property
    def interval(self) -> tuple[float, float]:
        """Low and high end."""
        return wilson(self.right, self.n)

    def __str__(self) -> str:
        low, high = self.interval
        return f"{self.right} of {self.n} ({100 * low:.0f} to {100 * high:.0f} %)" if self.n else "–"


@dataclass(frozen=True)
class RigScore:
    """Figures of one tool on one rig, or on all of a kind."""

    name: str
    silent: Share
    first: Share
    alone: Share
    outside: Share
    bits: float
    cpu_s: float | None
    failed: int

    @staticmethod
    def of(name: str, rows: Sequence[ScoredAnswer]) -> "RigScore":
        """The figures of rows."""
        acting = [row for row in rows if not row.truth.healthy]
        listed = [row for row in acting if not row.truth.outside]
        seconds = [row.answer.cpu_s for row in rows if row.answer.cpu_s is not None]
        return RigScore(
            name,
            Share.of([row for row in rows if row.truth.healthy], lambda row: not row.alarm),
            Share.of(listed, lambda row: row.first),
            Share.of(listed, lambda row: row.alone),
            Share.of([row for row in acting if row.truth.outside], lambda row: row.first),
            fmean(row.bits for row in rows),
            median(seconds) if seconds else None,
            sum(bool(row.answer.failed) for row in rows),
        )


def by_rig(rows: Sequence[ScoredAnswer]) -> list[RigScore]:
    """Figures of every rig, in the order of their names."""
    return [RigScore.of(name, [row for row in rows if row.question.rig == name]) for name in sorted({row.question.rig for row in rows})]


def over_rigs(
    rows: Sequence[ScoredAnswer], of: Callable[[ScoredAnswer], float], among: Callable[[ScoredAnswer], bool] = lambda _row: True
) -> float | None:
    """Mean over rigs weighed alike, of those with COUNTED questions or more; None where there is none.

    Args:
        among: Which rows count.
    """
    of_rig: dict[str, list[float]] = {}
    for row in rows:
        if among(row):
            of_rig.setdefault(row.question.rig, []).append(of(row))
    counted = [fmean(values) for values in of_rig.values() if len(values) >= COUNTED]
    return fmean(counted) if counted else None


def _bits(probability: float) -> float:
    return -log2(max(probability, LEAST_PROBABILITY))
