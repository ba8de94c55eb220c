"""The motion of a morning check, and the refusal of a palpation that lacks one."""

import math
from datetime import datetime

from palpd.config import Config, Plan, PlanSite, Search, Strokes
from palpd.control.plan_place import SITE_REACH_M, PlanPlace
from palpd.daemon.stored_state import LastCheck
from palpd.errors import Refused

PUCK = "puck"
"""Name of the site."""
STROKES, PRESSES, HOLD_S, ABOVE_M = 2, 4, 2.0, 0.004
"""Free strokes, dynamic presses, the hold, and the height between presses: with the plate about 70 s of motion."""


def check_plan(config: Config) -> Plan:
    """The palpation of a check: free strokes above the puck, one hold, and some presses without a hold."""
    check = config.check
    return Plan(
        sites=(PlanSite(name=PUCK, x_m=check.puck_m[0], y_m=check.puck_m[1]),),
        mode="both",
        depths_m=(check.depth_m,),
        repeats=PRESSES,
        hold_s=HOLD_S,
        safe_height_m=ABOVE_M,
        search=Search(max_travel_m=check.search_m),
        free=Strokes(strokes=STROKES),
    )


def still_on_the_check(place: PlanPlace, last: PlanPlace | None, plate: bool) -> str:
    """Question a palpation that presses what the last check has pressed, because the arm was not moved away from there.

    Args:
        place: Where its sites count from.
        last: Place of the palpation before.
        plate: Whether a rigid plate lies where a check begins.

    Returns:
        The sentence; empty where there is no question.
    """
    if last is None or [site[0] for site in last.sites] != [PUCK] or [site[0] for site in place.sites] == [PUCK]:
        return ""
    pressed = {"puck": (last.origin_m[0] + last.sites[0][1], last.origin_m[1] + last.sites[0][2])}
    pressed |= {"plate": last.start_m[:2]} if plate else {}
    for name, x_m, y_m in place.sites:
        for what, there_m in pressed.items():
            if math.dist((place.origin_m[0] + x_m, place.origin_m[1] + y_m), there_m) <= SITE_REACH_M:
                return f"site {name} is where the check before this run pressed its {what}; repeat the run if the arm was to be moved first"
    return ""


def refuse_unchecked(config: Config, plan: Plan, last: LastCheck | None, now: datetime) -> None:
    """Refuse a palpation where `check.require_check_h` asks for a check and the last one is too old or says no.

    The palpation of a check itself needs none.

    Args:
        plan: What is to be pressed.
        last: How the last check ended; None where there was none.
        now: Date and time with time zone.

    Raises:
        Refused: There is no such check.
    """
    most_h = config.check.require_check_h
    if most_h is None or plan.model_dump() == check_plan(config).model_dump():
        return
    if last is None:
        raise Refused(f"no check of this cell is kept, and check.require_check_h is {most_h:g}; run palpd check first")
    age_h = (now - datetime.fromisoformat(last.date).astimezone()).total_seconds() / 3600.0
    if age_h < 0.0:
        raise Refused(f"the last check is dated {last.date}, after now: the clock was set back, so its age is not known; run palpd check")
    if age_h > most_h:
        raise Refused(f"the last check is {age_h:.1f} h old, expected at most {most_h:g} h (check.require_check_h); run palpd check first")
    if last.level in ("stop", "open"):
        raise Refused(f"the last check says not to palpate. {last.sentence} Mend it and check again, or run palpd check --new-baseline")
