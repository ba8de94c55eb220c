"""What predictions leave behind for later predictions: the only thing of a problem that changes."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from palpd.cell.simulation import Followed
from palpd.tick import Floats

MOST_CACHED = 3_000_000
"""Numbers in the predictions that are kept, 24 MB: a search often returns to a recent state. They are 96 states of a long recording."""


@dataclass
class Workspace:
    """Memory of the predictions of one problem. With a fresh workspace a problem predicts the same, and takes longer.

    Attributes:
        predictions: Binned heights (1, b) and wrenches (6, b) by what they depend on, the newest last.
        followed: How the servo last followed the command of each recording, by the number of that recording.
        simulations: Number of force simulations so far.
    """

    predictions: dict[tuple[str, str, bytes], Floats] = field(default_factory=dict)
    followed: dict[int, Followed] = field(default_factory=dict)
    simulations: int = 0

    def prediction(self, key: tuple[str, str, bytes], simulated: Callable[[], Floats], size: int) -> Floats:
        """Binned heights (1, b) or wrenches (6, b) of a key, simulated where they are not known.

        Args:
            key: All that they depend on.
            size: Number of values that the problem compares.
        """
        if key not in self.predictions:
            if len(self.predictions) * size >= MOST_CACHED:
                del self.predictions[next(iter(self.predictions))]
            bins = simulated()
            # A trial far outside all reason may overflow; it only has to fit badly.
            self.predictions[key] = bins if np.isfinite(bins.sum()) else np.nan_to_num(bins, nan=1e100, posinf=1e100, neginf=-1e100)
        return self.predictions[key]
