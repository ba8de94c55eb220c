"""Two runs side by side: how far their moduli differ, and what else differs between them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from palpd.analysis.results import SiteResult
from palpd.history.facts import RunFacts
from palpd.recording.header import RecordingHeader

KINDS = (
    ("static", "static_youngs_modulus_Pa", "static", "depths"),
    ("dynamic, corrected", "dynamic_corrected_Pa", "dynamic_corrected", "presses"),
)
MOVED = ("paths", "sensor.port")
"""Settings that say where things lie, and change nothing that is measured."""


@dataclass(frozen=True, slots=True)
class ModulusDifference:
    """A modulus in two runs, in Pa, and other minus one with its 95 % interval, where both runs give one."""

    site: str
    kind: str
    one_Pa: float
    other_Pa: float
    difference_Pa: float
    ci95_Pa: tuple[float, float] | None

    @property
    def beyond_noise(self) -> bool | None:
        """Whether the interval leaves out zero; None without an interval."""
        return None if self.ci95_Pa is None else self.ci95_Pa[0] > 0.0 or self.ci95_Pa[1] < 0.0


@dataclass(frozen=True, slots=True)
class DifferentSetting:
    """A setting that differs between two runs; a key that one of them has not is None there."""

    key: str
    one: Any
    other: Any


def modulus_differences(one: RunFacts, other: RunFacts) -> list[ModulusDifference]:
    """How far the moduli of two runs differ, at the sites that both have by name.

    The errors of both runs count as independent: an error that they share, such as that of the sensor's gain, is in neither interval. So
    is the range over depth where Hertz does not fit, if both pressed to the same depths.

    Args:
        other: Another run.

    Returns:
        One difference a site and kind of modulus.
    """
    others: Mapping[str, SiteResult] = {site["name"]: site for site in other["sites"]}
    differences = []
    for site in one["sites"]:
        for kind, value, name, pressed in KINDS:
            mine, theirs = dict(site), dict(others.get(site["name"], {}))
            interval = f"{name}_noise_ci95_Pa" if _depths(mine.get(pressed)) == _depths(theirs.get(pressed)) else f"{name}_ci95_Pa"
            one_Pa, other_Pa = mine.get(value), theirs.get(value)
            if isinstance(one_Pa, float) and isinstance(other_Pa, float):
                half_Pa = _half(mine.get(interval), theirs.get(interval))
                difference_Pa = other_Pa - one_Pa
                ci95_Pa = None if half_Pa is None else (difference_Pa - half_Pa, difference_Pa + half_Pa)
                differences.append(ModulusDifference(site["name"], kind, one_Pa, other_Pa, difference_Pa, ci95_Pa))
    return differences


def _depths(presses: Any) -> set[float]:
    return {press["commanded_m"] for press in presses or ()}


def _half(*intervals: Any) -> float | None:
    """Half-width of the difference of two independent values with these intervals."""
    return None if None in intervals else math.hypot(*((high - low) / 2.0 for low, high in intervals))


def different_settings(one: RecordingHeader, other: RecordingHeader) -> list[DifferentSetting]:
    """What differs between the conditions of two runs: configuration, plan, devices and versions.

    Args:
        other: Header of another.

    Returns:
        The settings by key, without paths.
    """
    mine, theirs = _settings(one), _settings(other)
    return [DifferentSetting(key, mine.get(key), theirs.get(key)) for key in sorted({**mine, **theirs}) if mine.get(key) != theirs.get(key)]


def _settings(header: RecordingHeader) -> dict[str, Any]:
    parts: dict[str, Any] = {name: header.get(name) for name in ("plan", "versions", "machine_stiffness_N_per_m")}
    about = header.get("about", {})
    parts["sensor serial"] = about.get("sensor_serial")
    parts["robot host"] = about.get("robot_host")
    parts["reference tare"] = header.get("reference")
    flat = dict(_flat("", {**header.get("config", {}), **parts}))
    return {key: value for key, value in flat.items() if not key.startswith(MOVED)}


def _flat(key: str, value: Any) -> list[tuple[str, Any]]:
    if isinstance(value, Mapping):
        return [each for name, inner in value.items() for each in _flat(f"{key}.{name}" if key else str(name), inner)]
    if isinstance(value, list) and value and all(isinstance(each, Mapping) for each in value):
        return [each for number, inner in enumerate(value) for each in _flat(f"{key}[{inner.get('name', number)}]", inner)]
    return [(key, value)]
