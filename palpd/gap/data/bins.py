"""Samples gathered into bins: finely while the probe moves and just after it stops, coarsely (in log time) while it rests."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from palpd.gap.data.phases import Ints, Phases
from palpd.tick import Floats


@dataclass(frozen=True)
class Bins:
    """Stretches of neighbouring samples: `begin` (b,) is the first sample of each, `count` (b,) their number."""

    begin: Ints
    count: Ints

    def __len__(self) -> int:
        return len(self.begin)

    @staticmethod
    def of_equal_length(t_s: Floats, count: int) -> "Bins":
        """Bins that last as long as `count` samples usually do; the last may be shorter.

        Args:
            t_s: Times of the samples (n,).
        """
        n = len(t_s)
        step_s = np.diff(t_s)
        usual_s = float(np.median(step_s))
        width_s = count * float(np.mean(step_s[step_s < 1.5 * usual_s]))
        index = np.floor((t_s - t_s[0]) / width_s + 0.5 / count) if count > 1 else np.arange(n)
        begin = np.flatnonzero(np.diff(index, prepend=-1))
        return Bins(begin, np.diff(begin, append=n))

    def merged(self, outer: "Bins") -> "Bins":
        """Bins of samples, from bins of these bins."""
        begin = self.begin[outer.begin]
        return Bins(begin, np.diff(begin, append=int(self.begin[-1] + self.count[-1])))

    def joined_at(self, outer: "Bins") -> "Bins":
        """Bins of these bins that begin where bins of samples begin, or with the next of these bins."""
        begin = np.unique(np.minimum(np.searchsorted(self.begin, outer.begin), len(self) - 1))
        return Bins(begin, np.diff(begin, append=len(self)))

    def mean(self, values: Floats) -> Floats:
        """Mean over every bin.

        Args:
            values: A value or k values of every sample, (n,) or (n, k).

        Returns:
            Means (b,) or (b, k).
        """
        sums = np.add.reduceat(values, self.begin, axis=0)
        return np.asarray(sums / (self.count if values.ndim == 1 else self.count[:, None]))

    def means(self) -> csr_array:
        """The matrix (b, n) that takes the mean over every bin."""
        n = int(self.begin[-1] + self.count[-1])
        return csr_array((np.repeat(1.0 / self.count, self.count), np.arange(n), np.append(self.begin, n)), shape=(len(self), n))

    def label(self, values: Ints) -> Ints:
        """Labels (b,) of the bins: each takes that of its middle sample, of labels (n,) of the samples."""
        return np.asarray(values[self.begin + self.count // 2])


def make_bins(t_s: Floats, phases: Phases, samples_per_step: Bins, max_bins: int) -> Bins:
    """Bins of steps: narrow while the probe moves and just after it stops, wide (in log time) while it rests.

    Args:
        t_s: Times of the steps (n,).
        phases: Phases of the samples.
        samples_per_step: The samples of every step.
        max_bins: Largest number of bins, approximately; with fewer steps, every step is a bin.
    """
    n = len(t_s)
    step_s = np.diff(t_s, append=2 * t_s[-1] - t_s[-2])
    rest_s = np.where(phases.moving, 0.0, np.minimum(phases.since_s, phases.until_s))[samples_per_step.begin]

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
