"""Where the sites of a plan count from, over the runs: a start elsewhere than an unfinished run began is asked about, not assumed."""

import math
from dataclasses import dataclass
from typing import Literal

SAME_PLACE_M = 0.002
"""Distance sideways at which two starts are one place: what a hand misses by, a tenth of a usual distance of sites."""
SITE_REACH_M = 0.005
"""Distance sideways within which the tip stands over a site: a tip's radius."""

Choice = Literal["here", "return"]
"""What the operator answers: count from where the arm stands, or go back to where the unfinished run began."""
ANSWERS = "--here counts from where the arm stands, and --return of run, start and inject goes back first, straight up and then sideways"
"""What the terminal offers with the question."""


@dataclass(frozen=True, slots=True)
class PlanPlace:
    """Where the sites of the last palpation counted from, in base axes, and where it began.

    `start_m` (3,) is its start, `top_z_m` the greatest height that it has travelled at. `returned` says that it ended where it began.
    `sites` are name, x and y of each, from the origin.
    """

    date: str
    run: str
    origin_m: tuple[float, float]
    start_m: tuple[float, float, float]
    top_z_m: float
    sites: tuple[tuple[str, float, float], ...]
    returned: bool = False

    def site_under(self, x_m: float, y_m: float) -> str | None:
        """Find the site of the plan that a tip stands over.

        Args:
            x_m: Tip in base axes.
            y_m: Tip in base axes.

        Returns:
            Name of the nearest site within `SITE_REACH_M`, None where there is none.
        """
        distances = [(math.hypot(x_m - self.origin_m[0] - at_x, y_m - self.origin_m[1] - at_y), name) for name, at_x, at_y in self.sites]
        away_m, name = min(distances, default=(math.inf, ""))
        return name if away_m <= SITE_REACH_M else None


def question(last: PlanPlace | None, x_m: float, y_m: float, choice: Choice | None) -> str | None:
    """Why a run without a stated origin may not begin there before the operator has answered; None where it may.

    Args:
        last: Place of the last palpation.
        x_m: Tip in base axes.
        y_m: Tip in base axes.
        choice: What the operator has answered; None: nothing yet.

    Returns:
        The sentence, without the answers.
    """
    if choice is not None or last is None or last.returned:
        return None
    away_m = math.hypot(x_m - last.start_m[0], y_m - last.start_m[1])
    if away_m <= SAME_PLACE_M:
        return None
    site = last.site_under(x_m, y_m)
    stands = f", at its site {site}" if site is not None else ""
    return (
        f"the run {last.run} of {last.date} was not finished, and the arm stands {away_m * 1e3:.0f} mm from where it began{stands}: sites "
        "would count from another place"
    )


def way_back(last: PlanPlace, x_m: float, y_m: float) -> tuple[float, str]:
    """How far a run goes back to where an unfinished one began, and the sentence that says so before anything moves.

    Args:
        last: Place of the last palpation.
        x_m: Tip in base axes.
        y_m: Tip in base axes.

    Returns:
        The way sideways in m, and the sentence.
    """
    away_m = math.hypot(x_m - last.start_m[0], y_m - last.start_m[1])
    start = ", ".join(f"{at_m:.3f}" for at_m in last.start_m)
    return away_m, f"the arm goes {away_m * 1e3:.0f} mm sideways, to ({start}) m, where the run {last.run} of {last.date} began"
