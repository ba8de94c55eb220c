"""What a report of a run begins with, in words: E of each site, whether Hertz fits, tare and guard."""

from datetime import datetime
from typing import Any

import numpy as np

from palpd.analysis.results import SiteResult
from palpd.history.facts import RunFacts
from palpd.quantities import number, quantity
from palpd.recording.reader import Recording
from palpd.recording.tick_rows import filled_slots
from palpd.tick import Phase

LIFTED = ("palpation", "injection", "free_motion", "stiffness")
"""Kinds of runs that go up first, to show that the probe is free."""
JUST_TAKEN_S, DAY_S = 60.0, 86400.0


def site_rows(facts: RunFacts) -> list[list[str]]:
    """Of each site: name, static and corrected dynamic modulus with intervals, whether Hertz fits, dynamic modulus, peak, cut short."""
    return [
        [
            str(site["name"]),
            _modulus(site["static_youngs_modulus_Pa"], site["static_ci95_Pa"]),
            _modulus(site["dynamic_corrected_Pa"], site["dynamic_corrected_ci95_Pa"]),
            _hertz(site),
            _modulus(site["dynamic_original_Pa"], None),
            "–" if site["peak_force_N"] is None else f"{site['peak_force_N']:.2f} N",
            ", ".join(f"{depth_m * 1e3:g} mm" for depth_m in site["cut_short_depths_m"]) or "none",
        ]
        for site in facts["sites"]
    ]


def _modulus(modulus_Pa: float | None, ci95_Pa: list[float] | None) -> str:
    return "–" if modulus_Pa is None else quantity(modulus_Pa, "Pa", None if ci95_Pa is None else (ci95_Pa[0], ci95_Pa[1]))


def _hertz(site: SiteResult) -> str:
    """Whether one modulus describes a site."""
    if misfit := site["hertz_misfit"]:
        return f"does not fit: E from {number(misfit['low_Pa'] / 1e3)} to {quantity(misfit['high_Pa'], 'Pa')} over depth"
    held = {each["commanded_m"] for each in site["depths"] if each["E_Pa"] is not None}
    count = max(len(held), len({each["commanded_m"] for each in site["presses"]}))
    return "fits" if count > 1 else "not known from one depth" if count else "not pressed"


def tare_and_guard(recording: Recording, facts: RunFacts) -> tuple[str, str]:
    """How far the zero and its reference can be believed, and how near the forces came to their limits.

    Returns:
        The sentences on the tare and on the guard.
    """
    header, rows, safety = recording.header, recording.rows, recording.header["config"]["safety"]
    tare, rest = [], np.flatnonzero(rows["phase"] == Phase.BASELINE)
    stretches = np.split(rest, np.flatnonzero(np.diff(rest) > 1) + 1)
    if len(stretches) > 1:
        first, last = rows[stretches[0]], rows[stretches[-1]]
        moved_N, minutes = _mean_fz_N(last) - _mean_fz_N(first), float(last["now_s"][0] - first["now_s"][0]) / 60.0
        tare.append("; ".join([f"The zero moved by {moved_N:+.3f} N in {minutes:.1f} min", *_zeros(facts)]) + ".")
    taken = header.get("reference_date")
    age_s = None if taken is None else facts["started_s"] - datetime.fromisoformat(taken).timestamp()
    age = "not recorded" if age_s is None else f"{age_s / DAY_S:.1f} days" if age_s > JUST_TAKEN_S else "that of this run"
    age = "not known, its date is later than the run, so the clock was set back" if (age_s or 0.0) < -JUST_TAKEN_S else age
    tare.append(f"Age of the reference tare: {age}.")
    if facts["kind"] in LIFTED and not facts["dry"]:
        lifted = header.get("lifts_first") and bool(np.isin(rows["phase"], (Phase.TRAVEL, Phase.SEARCH, Phase.FREE_MOTION)).any())
        no_check = "The way up of 5 mm was not made: nothing showed that the probe was free."
        tare.append("Before anything else the arm went 5 mm up, and the probe was free." if lifted else no_check)
    stepped = "; ".join(dict.fromkeys(str(trip["reason"]) for trip in facts["trips"]))
    guard = (
        f"Largest contact force {facts['peak_force_N']:.2f} N of {safety['contact_limit_N']:g} N allowed, largest force against the "
        f"reference tare {float(np.nanmax(rows['absolute_N'])):.2f} N of {safety['absolute_limit_N']:g} N. "
    )
    return " ".join(tare), guard + (f"The guard stepped in: {stepped}." if stepped else "The guard never stepped in.")


def _zeros(facts: RunFacts) -> list[str]:
    """From which zero the forces of a run count."""
    corrected = "corrected by the inertial model" if facts["model_card"] else "and nothing corrects it"
    held, pressed = (any(site[kind] for site in facts["sites"]) for kind in ("depths", "presses"))
    return ["a hold counts from the rest before it"] * held + [f"a dynamic press counts from the tare, {corrected}"] * pressed


def _mean_fz_N(rows: Any) -> float:
    filled = filled_slots(rows)
    return float(rows["tared"][filled][:, 2].mean())
