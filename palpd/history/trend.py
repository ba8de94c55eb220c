"""How moduli and the parameters of named effects change over the days."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import numpy as np

from palpd.analysis.intervals import student_t_95
from palpd.errors import BadInput
from palpd.history.catalogue import Catalogue, EffectPoint, RunEntry, RunFilter, SiteModuli, as_json

SECONDS_A_DAY = 86400.0
FEWEST_POINTS = 3
"""Fewest points of a slope: two have no scatter, so nothing says how sure the slope is."""
SHORTEST_S = 60.0
"""Shortest span of a slope: a change per day from two runs in one minute says nothing of days."""
Quantity = Literal["static", "dynamic", "corrected"]
"""Which modulus: of the holds, of the dynamic peaks as measured, or of these corrected."""
MODULI: dict[Quantity, Callable[[SiteModuli], float | None]] = {
    "static": lambda site: site.static_Pa,
    "dynamic": lambda site: site.dynamic_Pa,
    "corrected": lambda site: site.corrected_Pa,
}
OTHER_CAUSES = {
    "config_sha256": "configuration",
    "model_sha256": "inertial model",
    "machine_stiffness_N_per_m": "stiffness of the machine",
    "sensor_serial": "sensor",
}
"""What of a run may change its moduli besides the tissue, and its name in a note."""


@dataclass(frozen=True, slots=True)
class Slope:
    """Straight line through values over time: change per day with its 95 % interval, in the unit of the values, and its mean."""

    per_day: float
    ci95_per_day: tuple[float, float]
    mean: float
    points: int
    days: float


class ModulusPoint(NamedTuple):
    """A run, and the moduli of a site in it."""

    run: RunEntry
    moduli: SiteModuli


def modulus_points(entries: Sequence[RunEntry], site: str) -> list[ModulusPoint]:
    """The moduli of a site in runs, oldest first.

    Args:
        entries: The runs, in any order.

    Returns:
        One point a run that has pressed it.
    """
    points = (ModulusPoint(run, moduli) for run in entries for moduli in run.sites if moduli.site == site)
    known = (point for point in points if any(value(point.moduli) for value in MODULI.values()))
    return sorted(known, key=lambda point: point.run.started_s)


def modulus_trend(catalogue: Catalogue, site: str, only: RunFilter) -> tuple[list[ModulusPoint], dict[Quantity, Slope]]:
    """How the moduli of a site change over the days.

    Args:
        catalogue: The runs.
        only: Which runs count.

    Returns:
        The points, oldest first, and the slopes of those moduli that have enough points.
    """
    points = modulus_points(catalogue.runs(only), site)
    slopes: dict[Quantity, Slope] = {}
    for quantity, value in MODULI.items():
        # a copy of a recording began when the recording did, and is no further evidence
        known = {point.run.started_s: modulus_Pa for point in points if (modulus_Pa := value(point.moduli)) is not None}
        if (slope := slope_of(list(known.items()))) is not None:
            slopes[quantity] = slope
    return points, slopes


def change_notes(points: Sequence[ModulusPoint]) -> list[str]:
    """Say between which runs something else changed than the tissue may have: a trend runs over a new tip as over a new day.

    Args:
        points: As `modulus_trend` gives them.

    Returns:
        One sentence each for configuration, inertial model, stiffness of the machine and sensor, where it changed.
    """
    notes = []
    for key, what in OTHER_CAUSES.items():
        changes = [(a.run.name, b.run.name) for a, b in pairwise(points) if getattr(a.run, key) != getattr(b.run, key)]
        if changes:
            before, after = changes[-1]
            notes.append(
                f"the {what} changed within this trend, last before {after} (changes: {len(changes)}), so the line may show that and not "
                f"the tissue; palpd report {after} --beside {before} says what differs"
            )
    return notes


def site_trend(
    catalogue: Catalogue, site: str, only: RunFilter
) -> tuple[list[ModulusPoint], dict[Quantity, Slope], dict[tuple[str, str], tuple[list[EffectPoint], Slope | None]]]:
    """All that is known of a site over the days.

    Args:
        catalogue: The runs.
        only: Which runs count for the moduli.

    Returns:
        Points and slopes as `modulus_trend` gives them, and effects as `effect_trend` does.

    Raises:
        BadInput: No run has a modulus of the site, and no diagnosis has named an effect there.
    """
    points, slopes = modulus_trend(catalogue, site, only)
    effects = effect_trend(catalogue, site)
    if not points and not effects:
        raise BadInput(f"no run in {catalogue.folder} has a modulus of a site {site!r}; palpd runs lists the sites")
    return points, slopes, effects


def effect_trend(catalogue: Catalogue, site: str = "") -> dict[tuple[str, str], tuple[list[EffectPoint], Slope | None]]:
    """How the parameters of effects that diagnoses have named change over the days.

    Args:
        catalogue: The runs.
        site: Only diagnoses of this site; empty for all.

    Returns:
        Points, oldest first, and slope by effect and parameter; no slope where there are too few points.
    """
    by_parameter: dict[tuple[str, str], list[EffectPoint]] = {}
    for point in catalogue.effects(site):
        by_parameter.setdefault((point.effect, point.parameter), []).append(point)
    trend = {}
    for key, points in sorted(by_parameter.items()):
        once = {(point.started_s, point.site): point for point in points}  # a copy of a recording is no further evidence
        trend[key] = points, slope_of([(point.started_s, point.value) for point in once.values()])
    return trend


def trend_as_json(
    site: str,
    points: list[ModulusPoint],
    slopes: dict[Quantity, Slope],
    effects: Mapping[tuple[str, str], tuple[list[EffectPoint], Slope | None]],
) -> dict[str, Any]:
    """A trend for `--json` and for a web page.

    Args:
        points: As `modulus_trend` gives them.
        slopes: As `modulus_trend` gives them.
        effects: As `effect_trend` gives them.

    Returns:
        Data of dictionaries, lists, texts and numbers; `notes` are those of `change_notes`.
    """
    return {
        "site": site,
        "notes": change_notes(points),
        "runs": [
            {"run": run.name, "started": run.started, "started_s": run.started_s, "moduli": as_json(moduli)}
            | {key: getattr(run, key) for key in OTHER_CAUSES}
            for run, moduli in points
        ],
        "slopes": as_json(slopes),
        "effects": [
            {"effect": effect, "parameter": parameter, "points": as_json(of), "slope": as_json(slope)}
            for (effect, parameter), (of, slope) in effects.items()
        ],
    }


def slope_of(points: Sequence[tuple[float, float]]) -> Slope | None:
    """Fit a straight line through values over time by least squares; its interval rests on the scatter about the line.

    Args:
        points: Unix time in s and value of each.

    Returns:
        The slope; None where the points are too few or too close in time.
    """
    if len(points) < FEWEST_POINTS:
        return None
    t_s, values = np.array(points, float).T
    if float(np.ptp(t_s)) < SHORTEST_S:
        return None
    days = (t_s - t_s.mean()) / SECONDS_A_DAY
    energy = float(days @ days)
    per_day = float(days @ values) / energy
    residual = values - values.mean() - per_day * days
    degrees = len(points) - 2
    half = student_t_95(degrees) * float(np.sqrt(residual @ residual / degrees / energy))
    return Slope(per_day, (per_day - half, per_day + half), float(values.mean()), len(points), float(np.ptp(days)))
