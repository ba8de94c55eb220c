"""Where a run differs from its plan: sites that were not pressed, holds and presses that are missing, depths that were not met."""

from collections.abc import Iterator

import numpy as np
from numpy.lib.recfunctions import repack_fields
from numpy.typing import NDArray

from palpd.analysis.results import SiteResult
from palpd.config import Plan
from palpd.control.plan_place import SAME_PLACE_M
from palpd.recording.header import RecordedPlace
from palpd.tick import Mode, Phase

DEPTH_TOLERANCE_M = 5e-5
"""Distance of a depth from the commanded one that is no deviation: the accuracy that the sequence is built for."""
HOLD_TOLERANCE_S = 0.05
"""The same for the duration of a hold: some ticks of a loop at 125 Hz."""


FIELDS = ["now_s", "phase", "mode", "site", "depth_m"]
"""What of a tick tells whether the plan was kept; whole rows are large, and copying them takes most of the time."""


def deviations(rows: NDArray[np.void], plan: Plan, sites: list[SiteResult]) -> list[str]:
    """Compare what was recorded with what was planned. Presses that a limit cut short are left out: their sentences say why.

    Args:
        rows: Ticks of a palpation, with the fields of ROW of palpd.tick.

    Returns:
        One sentence a deviation, in the order of the plan.
    """
    ticks = repack_fields(rows[FIELDS])
    sentences = [each for index, site in enumerate(sites) for each in _of_site(ticks[ticks["site"] == index], plan, site)]
    paused = int((ticks["phase"] == Phase.PAUSED).sum())
    if paused:
        step_s = float(np.median(np.diff(ticks["now_s"]))) if len(rows) > 1 else 0.0
        sentences.append(f"the run was paused for {paused * step_s:.1f} s")
    return sentences


def place_sentences(place: RecordedPlace | None) -> list[str]:
    """Say where sites count from, after a run that was not finished.

    Args:
        place: Of the recording's header; None in recordings of earlier versions.

    Returns:
        One sentence, or none where the sites count from an ordinary start.
    """
    if place is None or place["unfinished"] is None or place["moved_m"] is None:
        return []
    if place["taken"] == "return":
        return [f"the run first went back to where the unfinished run {place['unfinished']} began"]
    if place["moved_m"] <= SAME_PLACE_M:
        return []
    return [
        f"sites count from ({place['x_m'] * 1e3:.1f}, {place['y_m'] * 1e3:.1f}) mm, {place['moved_m'] * 1e3:.0f} mm from those of the "
        f"unfinished run {place['unfinished']}: a name may stand for another place"
    ]


def _of_site(ticks: NDArray[np.void], plan: Plan, site: SiteResult) -> Iterator[str]:
    name = f"site {site['name']}"
    if not (ticks["phase"] == Phase.PRESS).any():
        if plan.depths_m:
            yield f"{name} was not pressed"
        return
    if plan.mode in ("static", "both"):
        yield from _statically(ticks, plan, site, name)
    if plan.mode in ("dynamic", "both"):
        yield from _dynamically(plan, site, name)


def _statically(ticks: NDArray[np.void], plan: Plan, site: SiteResult, name: str) -> Iterator[str]:
    held = {depth["commanded_m"]: depth for depth in site["depths"] if depth["E_Pa"] is not None or depth["cut_short"]}
    if missing := [depth_m for depth_m in plan.depths_m if depth_m not in held]:
        yield f"{name}, static {_millimetres(missing)}: not held"
    for depth_m, depth in held.items():
        what = f"{name}, static {depth_m * 1e3:g} mm"
        if not depth["cut_short"] and depth["achieved_m"] is not None:
            yield from _depth(what, depth_m, depth["achieved_m"])
            hold_s = ticks["now_s"][(ticks["mode"] == Mode.STATIC) & (ticks["phase"] == Phase.HOLD) & (ticks["depth_m"] == depth_m)]
            held_s = float(hold_s[-1] - hold_s[0]) if len(hold_s) else 0.0
            if held_s < plan.hold_s - HOLD_TOLERANCE_S:
                yield f"{what}: held for {held_s:.2f} s, planned {plan.hold_s:g} s"


def _dynamically(plan: Plan, site: SiteResult, name: str) -> Iterator[str]:
    if missing := [depth_m for depth_m in plan.depths_m if all(press["commanded_m"] != depth_m for press in site["presses"])]:
        yield f"{name}, dynamic {_millimetres(missing)}: not pressed"
    for depth_m in plan.depths_m:
        what, presses = f"{name}, dynamic {depth_m * 1e3:g} mm", [each for each in site["presses"] if each["commanded_m"] == depth_m]
        if 0 < len(presses) < plan.repeats:
            yield f"{what}: {len(presses)} of {plan.repeats} presses"
        away = [press["achieved_m"] for press in presses if not press["cut_short"]]
        if away:
            yield from _depth(what, depth_m, max(away, key=lambda achieved_m: abs(achieved_m - depth_m)))


def _millimetres(depths_m: list[float]) -> str:
    return ", ".join(f"{depth_m * 1e3:g}" for depth_m in depths_m) + " mm"


def _depth(what: str, commanded_m: float, achieved_m: float) -> Iterator[str]:
    beyond_m = achieved_m - commanded_m
    if not abs(beyond_m) <= DEPTH_TOLERANCE_M:
        side = "deeper" if beyond_m > 0 else "less deep"
        yield f"{what}: reached {achieved_m * 1e3:.3f} mm, {abs(beyond_m) * 1e3:.3f} mm {side} than planned"
