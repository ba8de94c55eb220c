"""Scores: the stated probabilities. They are those of the posterior, mapped by three numbers that were fitted on sealed cells.

No real effect follows its listed law exactly, and the list is never complete. So a posterior that trusts both is too sure of a cause. And
every effect has a small posterior probability in a healthy cell, so it is not sure enough that there is no gap. The map changes no verdict
and no name; it changes the probabilities that are stated. `benchmarks/calibrate.py` fits it on cells of the blind check, and stores it in
the folder of this file.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

from palpd.documents import parse_json
from palpd.gap.assumptions import ASSUMED

MAP_FILE = "calibration.json"


@dataclass(frozen=True)
class ProbabilityMap:
    """How stated probabilities follow from those of the posterior.

    Attributes:
        power: Exponent of the odds of a cause; below 1 they come nearer to even.
        doubt: Share of the prior that is mixed in where there is a gap: no cause is surer than it allows.
        power_none: Exponent of the odds of no gap, against the odds from which on no effect is named; above 1 they come nearer to certain.
        cells: Number of cells that it was fitted on; 0 for the map that changes nothing.
        how: On which cells, and when.
    """

    power: float = 1.0
    doubt: float = 0.0
    power_none: float = 1.0
    cells: int = 0
    how: str = "not fitted"

    def of_classes(self, p_none: float, p_unknown: float) -> tuple[float, float]:
        """The stated probabilities of no gap and of something outside the list; what they lack to 1 is that of listed effects alone."""
        none = _tempered(p_none, self.power_none, ASSUMED.naming.p_none_to_acquit)
        given_a_gap = min(max(p_unknown, 0.0) / max(1.0 - p_none, 1e-300), 1.0)
        unknown = (1.0 - self.doubt) * _tempered(given_a_gap, self.power) + self.doubt * ASSUMED.prior.unknown / (1.0 - ASSUMED.prior.none)
        return none, (1.0 - none) * unknown

    def of_effects(self, marginal: Mapping[str, float]) -> dict[str, float]:
        """The stated probabilities of listed effects by id; an effect whose probability is 0 keeps it."""
        prior = (1.0 - ASSUMED.prior.none - ASSUMED.prior.unknown) / max(len(marginal), 1)
        return {
            name: (1.0 - self.doubt) * _tempered(p, self.power) + self.doubt * prior if p > 0.0 else 0.0 for name, p in marginal.items()
        }


def _tempered(p: float, power: float, pivot: float = 0.5) -> float:
    """A probability whose odds against those of a pivot are raised to a power; the pivot, which decides, stays where it is."""
    present, absent = (min(max(p, 0.0), 1.0) / pivot) ** power, (min(max(1.0 - p, 0.0), 1.0) / (1.0 - pivot)) ** power
    return pivot * present / (pivot * present + (1.0 - pivot) * absent)


@cache
def stored_map() -> ProbabilityMap:
    """The map of this version."""
    content = parse_json(files("palpd.gap").joinpath(MAP_FILE).read_text(encoding="utf-8"), MAP_FILE)
    return ProbabilityMap(**content)
