"""When a robot reported, found in a recording where its reports were joined by straight lines to be had at every row."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.ndimage import maximum_filter1d, median_filter
from scipy.sparse import csr_array, eye_array
from scipy.sparse.linalg import splu

from palpd.cell.dynamics import Floats

LEAST_ROWS_EACH, MOST_ROWS_EACH = 1.4, 20.0
"""Range of sensor rows per robot report in which a slower robot is sought."""

STANDS_OUT = 30.0
"""Least power of a rhythm relative to neighbouring frequencies; the largest of 10^5 frequencies of pure noise reaches half of it."""

UNSEEN = 1.1
"""Ratio of corners by rhythm to corners seen above which the seen ones are taken: a tenth may be too flat to be seen."""

STRAIGHT = 0.01
"""Share of the rms of second differences below which a row counts as straight: interpolated rows are, to their last digits."""

EXACT = 0.15
"""Largest residual of lines between reports, as a share of the residual that as many lines at other places would leave of noise."""

WINDOW = 256
"""Rows over which the phase of the rhythm is taken: some ten reports of the slowest robot."""


@dataclass(frozen=True)
class Reports:
    """When a robot reported, and the interpolation to the rows of a recording.

    Attributes:
        t_s: Times (k,) of the reports, in s.
        joined: Interpolation matrix (n, k) from reports to rows.
    """

    t_s: Floats
    joined: csr_array

    @property
    def rows_each(self) -> float:
        """How many rows there are for every report."""
        return self.joined.shape[0] / len(self.t_s)

    def values(self, x: Floats) -> Floats:
        """The reported values behind the rows, by least squares.

        Args:
            x: Values (n,) in the rows.

        Returns:
            Values (k,) of the reports.
        """
        if self.rows_each == 1.0:
            return x
        squares = (self.joined.T @ self.joined + 1e-9 * eye_array(len(self.t_s))).tocsc()
        return np.asarray(splu(squares).solve(self.joined.T @ x))

    def join(self, x: Floats, t_s: Floats) -> Floats:
        """The rows that a true signal leaves when only its reports are interpolated.

        Args:
            x: True signal (n,).
            t_s: Times (n,) of the rows, in s.

        Returns:
            Values (n,) in the rows.
        """
        return x if self.rows_each == 1.0 else np.asarray(self.joined @ np.interp(self.t_s, t_s, x))


def straight_between(t_s: Floats, known_s: Floats) -> csr_array:
    """The matrix of linear interpolation.

    Args:
        t_s: Times (n,) to interpolate to, in s.
        known_s: Times (k,) of known values, in s, increasing.

    Returns:
        Sparse matrix (n, k).
    """
    n, k = len(t_s), len(known_s)
    left = np.clip(np.searchsorted(known_s, t_s, side="right") - 1, 0, k - 2)
    share = (t_s - known_s[left]) / (known_s[left + 1] - known_s[left])
    columns = np.column_stack([left, left + 1]).ravel()
    return csr_array((np.column_stack([1.0 - share, share]).ravel(), columns, np.arange(0, 2 * n + 1, 2)), shape=(n, k))


def find_reports(t_s: Floats, x: Floats) -> Reports:
    """Find the reports behind a signal: at every row, or at the corners of straight lines where the rows are interpolated.

    The size of the second differences of `x` has the rhythm of the corners, wherever they fall between the rows. How well lines between
    corners explain the second differences separates that rhythm from its multiples and aliases. Where reports have no even rhythm,
    corners are seen if the rows between them lie on a line.

    Args:
        t_s: Times (n,) of the rows in s, nearly even.
        x: Reported signal (n,).

    Returns:
        The times of the reports and how they were interpolated.
    """
    every = Reports(t_s, csr_array(eye_array(len(t_s))))
    if len(t_s) < 2 * WINDOW:
        return every
    rhythmic = (_best_s(t_s, x, _corners_s(t_s, x, per_row)) for per_row in _rhythms(x))
    corners_s = next((best_s for best_s in rhythmic if best_s is not None), None)
    seen_s = _best_s(t_s, x, [_seen_s(t_s, x)])
    if seen_s is not None and (corners_s is None or len(corners_s) > UNSEEN * len(seen_s)):
        corners_s = seen_s
    if corners_s is None:
        return every
    known_s = np.concatenate([t_s[:1], corners_s[(corners_s > t_s[0]) & (corners_s < t_s[-1])], t_s[-1:]])
    return Reports(known_s, straight_between(t_s, known_s))


def _best_s(t_s: Floats, x: Floats, choices: list[Floats]) -> Floats | None:
    """The corners, of several choices, that explain the second differences best, if they do explain them."""
    corners_s = min(choices, key=lambda at_s: _unexplained(t_s, x, at_s, (0.5,))) if len(choices) > 1 else choices[0]
    per_row = len(corners_s) / len(t_s)
    likely = 1.0 / MOST_ROWS_EACH < per_row < 1.0 / LEAST_ROWS_EACH
    return corners_s if likely and _unexplained(t_s, x, corners_s) < EXACT * (1.0 - per_row) ** 0.5 else None


def _seen_s(t_s: Floats, x: Floats) -> Floats:
    """Times of corners between straight stretches of rows; a corner between two rows shows at both, more at the nearer."""
    kink = np.diff(np.diff(x) / np.diff(t_s))
    cornered = np.abs(kink) > STRAIGHT * float(np.sqrt(np.mean(kink**2)))
    first = np.flatnonzero(np.diff(cornered.astype(np.int8), prepend=0) == 1)
    both = np.append(cornered, False)[first + 1]
    after = np.where(both, np.append(kink, 0.0)[first + 1], 0.0)
    share = np.clip(after / np.where(kink[first] + after == 0.0, 1.0, kink[first] + after), 0.0, 1.0)
    return np.asarray(t_s[first + 1] + share * (t_s[np.minimum(first + 2, len(t_s) - 1)] - t_s[first + 1]))


def _kinks(x: Floats) -> Floats:
    """Size of the second difference at every inner row, cut off where the motion itself makes it large."""
    size = np.abs(np.diff(x, 2))
    kinked = size[size > 1e-3 * np.sqrt(np.mean(size**2))]
    return np.asarray(np.minimum(size, 4.0 * float(np.median(kinked)) if len(kinked) else 0.0))


def _rhythms(x: Floats) -> list[float]:
    """Corners per row, below 1, that the rhythm of the second differences may stand for, the fewest first.

    These are the rhythm, its fractions and its aliases, where they stand out themselves.
    """
    size = _kinks(x)
    n = len(size)
    power = np.abs(np.fft.rfft((size - size.mean()) * np.hanning(n))) ** 2
    frequency = np.fft.rfftfreq(n)
    ratio = np.where(frequency > 1.0 / MOST_ROWS_EACH, power / np.maximum(median_filter(power, 101, mode="reflect"), 1e-300), 0.0)
    k = int(np.argmax(ratio))
    if ratio[k] < STANDS_OUT:
        return []
    tops = maximum_filter1d(ratio, 5)
    per_row_choices = []
    for multiple in range(1, int(MOST_ROWS_EACH / 2)):
        for whole, sign in product(range(multiple + 1), (-1, 1)):
            per_row = abs(whole + sign * float(frequency[k])) / multiple
            folded = min(per_row, 1.0 - per_row)
            if 1.0 / MOST_ROWS_EACH < per_row < 1.0 / LEAST_ROWS_EACH and tops[round(folded * 2.0 * (len(tops) - 1))] > 0.5 * STANDS_OUT:
                per_row_choices.append(per_row)
    return sorted(p for i, p in enumerate(per_row_choices) if all(abs(p - q) > 1.0 / n for q in per_row_choices[:i]))


def _corners_s(t_s: Floats, x: Floats, per_row: float) -> list[Floats]:
    """Times of the corners, given roughly how many there are per row.

    They are phases of the rhythm, window by window, on a straight line or followed where they wander. Where rows see every other
    corner only, several choices of each are returned.
    """
    size = _kinks(x)
    row = np.arange(1, len(x) - 1)
    turned = (size - size.mean()) * np.exp(-2j * np.pi * per_row * row)
    count = len(size) // WINDOW
    phases = turned[: count * WINDOW].reshape(count, WINDOW).sum(axis=1)
    middle = row[: count * WINDOW].reshape(count, WINDOW).mean(axis=1)
    # Neighbours agree to less than half a turn where the number is right; the largest sums say most.
    turns = np.unwrap(np.angle(phases)) / (2.0 * np.pi)
    slope, first = np.polyfit(middle, turns, 1, w=np.abs(phases))
    exact = per_row + slope
    out = []
    for late in np.arange(0.0, 1.0, 0.05) if abs(per_row - 0.5) < 2.0 / WINDOW else (0.0,):
        # A corner at row r has exact · r + first whole turns: second differences are largest there.
        for wandering in (0.0 * turns, turns - slope * middle - first):
            whole = exact * np.arange(len(x)) + first + late + np.interp(np.arange(len(x)), middle, wandering)
            number = np.arange(np.ceil(whole[0]), whole[-1])
            out.append(np.interp(np.interp(number, whole, np.arange(len(x))), np.arange(len(x)), t_s))
    return out


def _unexplained(t_s: Floats, x: Floats, corners_s: Floats, stretches: Sequence[float] = (0.2, 0.5, 0.8)) -> float:
    """Rms of the second differences that lines between corners do not explain, as a share, in the worst stretch of the recording."""
    worst = 0.0
    for middle in stretches:
        a = min(max(int(middle * len(x)) - WINDOW // 2, 0), len(x) - WINDOW)
        here = slice(a, a + WINDOW)
        known_s = corners_s[(corners_s > t_s[here][0]) & (corners_s < t_s[here][-1])]
        known_s = np.concatenate([t_s[here][:1], known_s, t_s[here][-1:]])
        joined = straight_between(t_s[here], known_s)
        reported = Reports(known_s, joined)
        kinks = np.diff(x[here], 2)
        residual = np.diff(x[here] - joined @ reported.values(x[here]), 2)
        worst = max(worst, float(np.sqrt(np.mean(residual**2) / max(np.mean(kinks**2), 1e-300))))
    return worst
