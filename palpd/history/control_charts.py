"""Control charts of the morning check: pure functions from days to limits, and from limits to a verdict.

Each figure has a self-starting chart. A day is compared with all healthy days before it, and its distance is brought to a standard
normal value by Student's distribution, whatever their number (Q chart: C. P. Quesenberry, Journal of Quality Technology 23, 1991). What is
judged is the mean of the last two such values (moving average of span 2: S. W. Roberts, Technometrics 1, 1959). An EWMA finds a change
within two days more rarely (docs/how-to/morning-check.md). A change that is smaller than half of its tolerance is not named, however
significant it is.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.stats import norm
from scipy.stats import t as student

from palpd.config import CheckTolerances
from palpd.history.check_features import DayFeatures
from palpd.quantities import quantity

FEWEST_DAYS = 10
"""Healthy days before a chart judges: with fewer, Student's limits are wider than what a day may change by."""
LIMIT = 2.67
"""Standard normal distance of the mean of two days at which a chart warns: 0.75 of 100 healthy days are beyond it."""
LEAST_SHARE = 0.5
"""Share of the tolerance below which no change is named."""
GRAVE = 2.0
"""Number of tolerances from which nobody should palpate."""
LEAST_SPREAD_K = 1.0
"""Standard deviation of the temperatures from which a slope over them is fitted: on less, the slope is noise."""
SMALLEST = 1e-12
"""Share of a value that rounding changes: a figure that never differs has at least this scatter."""

Level = Literal["ok", "warn", "stop"]
Cause = Literal["zero", "noise", "drift", "friction", "gain", "puck", "delay", "machine", "play", "loop", "sensor link", "robot link"]
SENTENCES: Mapping[Cause, tuple[str, str]] = {
    "zero": ("The zero of the sensor has moved", "look at cable and mount, then run palpd calibrate with the probe free"),
    "noise": ("The sensor is noisier or quieter", "look at cable, filter and supply of the sensor"),
    "drift": ("The zero of the sensor drifts", "let the sensor warm up for half an hour, and check again"),
    "friction": ("Something rubs in free strokes", "look at cable and hose of the probe"),
    "gain": ("The scale of the sensor has changed", "check it with palpd doctor --weight-N, and the calibration in config.yaml"),
    "puck": ("The puck has changed", "look at its surface and temperature; if it is another one, palpd check --new-baseline"),
    "delay": ("The force comes later or earlier", "look at the filter of the sensor (palpd doctor) and its USB line"),
    "machine": ("Arm, mount or sensor give way more or less", "tighten the mount, and run palpd stiffness"),
    "play": ("The drive or the mount has play", "tighten the mount; if it stays, have the joints looked at"),
    "loop": ("The loop misses ticks", "run palpd doctor; end what else runs on this computer"),
    "sensor link": ("Samples of the sensor are lost", "look at its USB line, and run palpd doctor"),
    "robot link": ("States of the robot are missing", "look at the network cable, and run palpd doctor"),
}
"""What a cause means, and what to do about it."""


@dataclass(frozen=True, slots=True)
class WatchedFigure:
    """How a figure of a day is watched.

    Attributes:
        words: Its name for people.
        tolerance: Name of its tolerance in config.yaml.
        unit: Its SI unit.
        relative: Whether the tolerance is a share of its value on the first day.
        charted: Whether a chart is learned; the other figures have their tolerance only.
        by_temperature: Whether a slope over the temperature is taken out, where temperatures are given.
        cause: What a change of this figure alone means.
        least_share: Share of the tolerance below which the chart names no change.
    """

    words: str
    tolerance: str
    unit: str
    cause: Cause
    relative: bool = False
    charted: bool = True
    by_temperature: bool = False
    least_share: float = LEAST_SHARE


WATCHED: Mapping[str, WatchedFigure] = {
    "zero_N": WatchedFigure("the zero", "zero_N", "N", "zero", by_temperature=True, least_share=0.0),
    "noise_N": WatchedFigure("the noise", "noise", "N", "noise", relative=True),
    "drift_N_per_min": WatchedFigure("the drift", "drift_N_per_min", "N/min", "drift"),
    "friction_N": WatchedFigure("the friction", "friction_N", "N", "friction"),
    "puck_modulus_Pa": WatchedFigure("the puck's modulus", "gain", "Pa", "puck", relative=True, by_temperature=True),
    "delay_s": WatchedFigure("the delay", "delay_s", "s", "delay"),
    "plate_stiffness_N_per_m": WatchedFigure("the stiffness at the plate", "stiffness", "N/m", "machine", relative=True),
    "play_m": WatchedFigure("the play", "play_m", "m", "play"),
    "missed_ticks_percent": WatchedFigure("missed ticks", "lost_percent", "%", "loop", charted=False),
    "lost_frames_percent": WatchedFigure("lost samples", "lost_percent", "%", "sensor link", charted=False),
    "repeated_states_percent": WatchedFigure("missing states", "lost_percent", "%", "robot link", charted=False),
}
"""Every figure of a day."""


@dataclass(frozen=True, slots=True)
class CheckedDay:
    """What the charts need of one day; `temperature_C` is None where nobody said it."""

    date: str
    features: DayFeatures
    temperature_C: float | None = None


@dataclass(frozen=True, slots=True)
class ChartPoint:
    """One figure on one day, in its unit.

    Attributes:
        value: As measured.
        expected: As the healthy days before let expect; the first day's value while they are too few.
        sigma: Standard deviation of that; None while the healthy days are too few.
        shift: Change that the chart judges: the mean of two days, in which the day before an alarm does not count.
        tolerance: Change from which the figure is out of tolerance.
        distance: Standard normal distance of the day; None while the healthy days are too few.
        changed: Whether the change is one.
        since: Date of the first day on which it was, without interruption; None where it is not.
    """

    figure: str
    value: float
    expected: float
    sigma: float | None
    shift: float
    tolerance: float
    distance: float | None
    changed: bool
    since: str | None = None

    @property
    def deviation(self) -> float:
        """How far the value of the day is off."""
        return self.value - self.expected

    @property
    def limits(self) -> tuple[float, float]:
        """Values of a single day between which the figure counts as before."""
        half = self.tolerance
        if self.sigma is not None:
            half = max(LIMIT * self.sigma, WATCHED[self.figure].least_share * self.tolerance)
        return (self.expected - half if WATCHED[self.figure].charted else 0.0), self.expected + half

    @property
    def sentence(self) -> str:
        """The change for people."""
        watched = WATCHED[self.figure]
        if not watched.charted:
            return f"{self.value:.2g} % (tolerance {self.tolerance:.2g} %), since {(self.since or '')[:10]}"
        sign = "-" if self.deviation < 0.0 else "+"
        changes = [
            f"{100.0 * abs(size / self.expected):.2g} %" if watched.relative else quantity(abs(size), watched.unit)
            for size in (self.deviation, self.tolerance)
        ]
        return f"{watched.words} changed by {sign}{changes[0]} (tolerance {changes[1]}), since {(self.since or '')[:10]}"


@dataclass(frozen=True, slots=True)
class DayVerdict:
    """What the charts say of a day: `causes` in the order of their size in tolerances, and the points of all figures."""

    level: Level
    causes: tuple[Cause, ...]
    points: tuple[ChartPoint, ...]

    @property
    def changes(self) -> tuple[ChartPoint, ...]:
        """The points that have changed, the largest in tolerances first."""
        return tuple(sorted((point for point in self.points if point.changed), key=_size, reverse=True))

    @property
    def sentence(self) -> str:
        """The verdict for people."""
        if not self.causes:
            return "Nothing has changed."
        words, todo = SENTENCES[self.causes[0]]
        more = f" Also: {', '.join(SENTENCES[cause][0].lower() for cause in self.causes[1:])}." if self.causes[1:] else ""
        return f"{words}: {self.changes[0].sentence}; {todo}.{more}"


def judged(days: Sequence[CheckedDay], tolerances: CheckTolerances) -> list[DayVerdict]:
    """Judge every day by the healthy days before it.

    Args:
        days: The days since the baseline, oldest first; the first one that has a figure is its commissioning.

    Returns:
        One verdict a day. A day on which something changed teaches the charts nothing.
    """
    verdicts: list[DayVerdict] = []
    for day in days:
        healthy = [each for each, verdict in zip(days, verdicts, strict=False) if verdict.level == "ok"]
        before = verdicts[-1] if verdicts else None
        points = tuple(
            _since(_point(name, day, healthy, first, tolerances, before), before, day.date)
            for name in WATCHED
            if getattr(day.features, name) is not None
            for first in [next(each for each in days if getattr(each.features, name) is not None)]
        )
        changed = [point for point in points if point.changed]
        grave = any(_size(point) >= GRAVE for point in changed)
        verdicts.append(DayVerdict("stop" if grave else "warn" if changed else "ok", _causes(points), points))
    return verdicts


def _point(
    name: str, day: CheckedDay, healthy: Sequence[CheckedDay], first: CheckedDay, tolerances: CheckTolerances, before: DayVerdict | None
) -> ChartPoint:
    """One figure of a day against its healthy days, and against the first day."""
    watched, value = WATCHED[name], float(getattr(day.features, name))
    began = float(getattr(first.features, name)) if watched.charted else 0.0  # nothing is missed, lost or missing in a healthy cell
    tolerance = float(getattr(tolerances, watched.tolerance)) * (abs(began) if watched.relative else 1.0)
    known = [(x, each.temperature_C) for each in healthy if (x := getattr(each.features, name)) is not None]
    if not watched.charted or len(known) < FEWEST_DAYS:
        return ChartPoint(name, value, began, None, value - began, tolerance, None, abs(value - began) >= tolerance)
    expected, sigma, degrees = _predicted(known, day.temperature_C if watched.by_temperature else None)
    sigma = max(sigma, SMALLEST * max(abs(expected), tolerance))
    distance = float(np.clip(norm.ppf(student.cdf((value - expected) / sigma, degrees)), -8.0, 8.0))
    shift, mean = value - expected, distance
    last = next((point for point in before.points if point.figure == name), None) if before is not None else None
    if last is not None and last.distance is not None and not last.changed:
        shift, mean = 0.5 * (shift + last.value - last.expected), (distance + last.distance) / math.sqrt(2.0)
    by_chart = abs(mean) > LIMIT and abs(shift) >= watched.least_share * tolerance
    # The charts follow what creeps. So the first day judges too, by the whole tolerance, and without what the temperature explains.
    crept = expected - _predicted(known, first.temperature_C if watched.by_temperature and day.temperature_C is not None else None)[0]
    return ChartPoint(name, value, expected, sigma, shift, tolerance, distance, by_chart or abs(value - began - crept) >= tolerance)


def _predicted(known: Sequence[tuple[float, float | None]], temperature_C: float | None) -> tuple[float, float, int]:
    """Expected value, its standard deviation (that of one day included), and degrees of freedom; by temperature where it is given."""
    with_temperature = [(x, T) for x, T in known if T is not None]
    if (
        temperature_C is not None
        and len(with_temperature) >= FEWEST_DAYS
        and float(np.std([T for _, T in with_temperature])) >= LEAST_SPREAD_K
    ):
        values, temperatures = np.array(with_temperature, float).T
        columns, at = np.column_stack([np.ones(len(values)), temperatures]), np.array([1.0, temperature_C])
    else:
        values = np.array([x for x, _ in known])
        columns, at = np.ones((len(values), 1)), np.ones(1)
    weights = np.linalg.lstsq(columns, values, rcond=None)[0]
    degrees = len(values) - columns.shape[1]
    variance = float(np.sum((values - columns @ weights) ** 2)) / degrees
    leverage = float(at @ np.linalg.solve(columns.T @ columns, at))
    return float(at @ weights), math.sqrt(variance * (1.0 + leverage)), degrees


def _since(point: ChartPoint, before: DayVerdict | None, date: str) -> ChartPoint:
    if not point.changed:
        return point
    last = next((each for each in before.points if each.figure == point.figure and each.changed), None) if before is not None else None
    return replace(point, since=last.since if last is not None else date)


def _size(point: ChartPoint) -> float:
    """Size of a change in tolerances."""
    return abs(point.deviation) / point.tolerance


def _causes(points: Sequence[ChartPoint]) -> tuple[Cause, ...]:
    """What explains the changes: of puck and plate the pattern that leaves least, of the other figures their own cause each.

    The pattern is the mean of two days where the day before was off by at least half of what today is, else that of today: the day before
    may have been healthy.
    """
    changed = sorted((point for point in points if point.changed), key=_size, reverse=True)
    scales = [point for point in points if point.figure in ("puck_modulus_Pa", "plate_stiffness_N_per_m") and point.expected]
    largest = max(scales, key=_size, default=None)
    two_days = largest is not None and (2.0 * largest.shift - largest.deviation) * largest.deviation > 0.5 * largest.deviation**2
    shares = {
        point.figure: (
            (point.shift if two_days else point.deviation) / abs(point.expected),
            (point.sigma or point.tolerance / 3.0) / abs(point.expected),
        )
        for point in scales
    }
    causes = [WATCHED[point.figure].cause if point.figure not in shares else _scale_cause(shares) for point in changed]
    return tuple(dict.fromkeys(causes))


def _scale_cause(shares: Mapping[str, tuple[float, float]]) -> Cause:
    """Gain changes puck and plate by one share; otherwise it is the one of both that leaves the smaller misfit of the other.

    Args:
        shares: Relative change and its standard deviation of puck and plate, by figure.
    """
    puck, plate = shares.get("puck_modulus_Pa"), shares.get("plate_stiffness_N_per_m")
    if puck is None or plate is None:
        return "puck" if plate is None else "machine"
    misfits: dict[Cause, float] = {
        "gain": (puck[0] - plate[0]) ** 2 / (puck[1] ** 2 + plate[1] ** 2),
        "puck": (plate[0] / plate[1]) ** 2,
        "machine": (puck[0] / puck[1]) ** 2,
    }
    return min(misfits, key=lambda cause: misfits[cause])
