"""Samples gathered into bins: finely while the probe moves and just after it stops, coarsely (in log time) while it rests."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from palpd.gap.phases import Ints, Phases
from palpd.tick import Floats

MAX_BINS = 4500


@dataclass(frozen=True)
class Bins:
    """Neighbouring samples taken together: `begin` (b,) the first sample of each, `count` (b,) how many it has."""

    begin: Ints
    count: Ints

    def __len__(self) -> int:
        return len(self.begin)

    @staticmethod
    def of_equal_length(t_s: Floats, count: int) -> "Bins":
        """Of samples at times (n,), `count` together each time, or as many as come while that many usually do; the last may be shorter."""
        n = len(t_s)
        step_s = np.diff(t_s)
        usual_s = float(np.median(step_s))
        width_s = count * float(np.mean(step_s[step_s < 1.5 * usual_s]))
        index = np.floor((t_s - t_s[0]) / width_s + 0.5 / count) if count > 1 else np.arange(n)
        begin = np.flatnonzero(np.diff(index, prepend=-1))
        return Bins(begin, np.diff(begin, append=n))

    def merged(self, outer: "Bins") -> "Bins":
        """Bins of samples, of bins of these bins."""
        begin = self.begin[outer.begin]
        return Bins(begin, np.diff(begin, append=int(self.begin[-1] + self.count[-1])))

    def mean(self, values: Floats) -> Floats:
        """Mean over every bin of values (n,) or (n, k)."""
        sums = np.add.reduceat(values, self.begin, axis=0)
        return np.asarray(sums / (self.count if values.ndim == 1 else self.count[:, None]))

    def means(self) -> csr_array:
        """What takes the mean over every bin, as a matrix (b, n)."""
        n = int(self.begin[-1] + self.count[-1])
        return csr_array((np.repeat(1.0 / self.count, self.count), np.arange(n), np.append(self.begin, n)), shape=(len(self), n))

    def first(self, values: Ints) -> Ints:
        """The value in the middle of every bin, for labels."""
        return np.asarray(values[self.begin + self.count // 2])


def make_bins(t_s: Floats, phases: Phases, together: Bins, max_bins: int = MAX_BINS) -> Bins:
    """At most about `max_bins` bins of steps at `t_s`, each step `together` so many samples; one step each where there are few."""
    n = len(t_s)
    step_s = np.diff(t_s, append=2 * t_s[-1] - t_s[-2])
    rest_s = np.where(phases.moving, 0.0, np.minimum(phases.since_s, phases.until_s))[together.begin]

    def index(width_s: float) -> Ints:
        share = np.minimum(1.0, step_s / np.maximum(width_s, 0.15 * rest_s))
        return np.floor(np.cumsum(share) - share[0] + 1e-9).astype(np.intp)

    low, high = 0.0, float(t_s[-1] - t_s[0])
    if n > max_bins:
        for _ in range(30):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if index(middle)[-1] >= max_bins else (low, middle)
        begin = np.flatnonzero(np.diff(index(high), prepend=-1))
    else:
        begin = np.arange(n)
    return Bins(begin, np.diff(begin, append=n))
