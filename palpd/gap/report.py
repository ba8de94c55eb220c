"""A diagnosis as one self-contained page: the verdict first, then what it rests on."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from math import log10
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from markupsafe import Markup
from matplotlib.axes import Axes
from numpy.typing import NDArray
from scipy.signal import welch

from palpd.analysis.figure_style import BLUE, ENRICHED, FLOOR, GREY, INK, NOMINAL, ORANGE, YELLOW, inline_svg, styled_figure, thinned
from palpd.analysis.page import rendered_page
from palpd.cell.effects import Effect
from palpd.cell.effects.learned import formula_of
from palpd.files import write_text
from palpd.gap.diagnosis import Diagnosis
from palpd.gap.noise import CHANNELS
from palpd.gap.other_motion import MotionCheck
from palpd.gap.phases import PHASES
from palpd.recording.samples import Samples
from palpd.tick import Floats

PHASE_WORDS = {
    "free_still": "rests in free space",
    "free_moving": "free motion",
    "loading": "loading",
    "holding": "holds",
    "unloading": "unloading",
}
"""Each reads after "during"."""
PHASE_TINT = {"loading": ORANGE, "holding": YELLOW, "unloading": BLUE}
TINT_ALPHA = 0.13
CHANNEL_WORDS = {
    "z_m": "height z",
    "fx_N": "force fx",
    "fy_N": "force fy",
    "fz_N": "force fz",
    "tx_Nm": "torque tx",
    "ty_Nm": "torque ty",
    "tz_Nm": "torque tz",
}
PREFIXES = ((1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n"), (1e-12, "p"))
PHASE_STEPS = 25
"""Points of the mean course of a phase; a stretch with fewer samples is left out."""
SMOOTH_S = 0.04
"""Running mean of the residual curves: shorter than any phase, and long enough to see beneath the noise."""
SHOWN_S = 15.0
"""Longest stretch of a cycle in the figure of curves; in a longer one a press is too narrow to see."""
MOST_CANDIDATES = 7


@dataclass(frozen=True)
class Curves:
    """One recording against its simulations.

    `measured`, `nominal` (the cell file as it stands) and `enriched` are (n, 7) in the order of CHANNELS; `t_s`, `phase` and
    `cycle` are (n,), the phases and cycles as the diagnosis cut them; `noise_rms` is (7,).
    """

    t_s: Floats
    phase: NDArray[np.intp]
    cycle: NDArray[np.intp]
    measured: Floats
    nominal: Floats
    enriched: Floats
    noise_rms: Floats
    recording: int = 0

    def gaps(self, channel: int) -> tuple[Floats, Floats]:
        """Measured minus simulated (n,) of a channel: by the nominal cell, and by the enriched one."""
        measured = self.measured[:, channel]
        return measured - self.nominal[:, channel], measured - self.enriched[:, channel]


def write(path: Path, diagnosis: Diagnosis, title: str, check: MotionCheck | None = None) -> None:
    """Write the report of a diagnosis.

    Args:
        path: the HTML file.
        diagnosis: what to report.
        title: names the recordings.
        check: how the enriched cell does on another motion.

    Raises:
        BadInput: the file cannot be written.
    """
    write_text(path, page(diagnosis.to_json(), curves_of(diagnosis), diagnosis.problem.library, title, check))


def curves_of(diagnosis: Diagnosis) -> Curves:
    """The recording with the largest gap, and what the nominal and the enriched cell predict for its motion."""
    problem = diagnosis.problem
    channel = diagnosis.where["channel"] if diagnosis.where is not None else ""
    gaps = np.zeros(len(problem.recordings))
    for t in diagnosis.trend:
        gaps[int(t["recording"])] += float(t["rms"]) ** 2 if t["channel"] == channel else 0.0
    shown = int(np.argmax(gaps))
    run = problem.recordings[shown]
    samples: Samples = run.samples
    return Curves(
        recording=shown,
        t_s=samples.t_s - samples.t_s[0],
        phase=run.phases.phase,
        cycle=run.phases.cycle,
        measured=np.column_stack([samples.z_m, samples.wrench]),
        nominal=problem.raw_prediction(run, problem.cell),
        enriched=problem.raw_prediction(run, diagnosis.enriched_cell()),
        noise_rms=np.asarray(run.noise_rms),
    )


def page(content: Mapping[str, Any], curves: Curves, library: Mapping[str, Effect], title: str, check: MotionCheck | None = None) -> str:
    """The report as HTML.

    Args:
        content: the content of out.json.
        curves: the recording that is drawn.
        library: effects by id; their descriptions and units.
        title: names the recordings.
        check: how the enriched cell does on another motion.

    Returns:
        The page.
    """
    channel = (content["where"] or content["shrink"])["channel"]
    proposed = content["next_experiment"]
    return rendered_page(
        "palpd.gap",
        "report.html.j2",
        title=title,
        nominal=NOMINAL,
        enriched=ENRICHED,
        grey=GREY,
        d=content,
        tiles=_tiles(content, check),
        what={name: effect.what for name, effect in library.items()},
        channel_words=CHANNEL_WORDS[channel],
        phase_words=[PHASE_WORDS[phase] for phase in PHASES],
        candidates=_candidates(content),
        closing=_closing(content["shrink"]),
        parameters=_parameters(content, library),
        gap_rows=_gap_rows(content),
        plan=yaml.safe_dump(proposed["plan"], sort_keys=False) if proposed else "",
        check=_check_words(check, _added(content)),
        law_formulas=_law_formulas(content),
        figures={
            "press": _press_figure(curves, channel, content),
            "phases": _phase_figure(curves, channel, content),
            "spectrum": _spectrum_figure(curves, channel),
            "trend": _trend_figure(content, channel, curves.recording),
            "motion": _motion_figure(content),
            "law": _law_figure(content),
            "check": _check_figure(check, _added(content)),
        },
    )


# words


def _place(where: Mapping[str, Any]) -> str:
    return f"{CHANNEL_WORDS[where['channel']]} during {PHASE_WORDS[where['phase']]}"


def _number(value: float, digits: int = 3) -> str:
    if not np.isfinite(value):
        return "∞"
    if value != 0.0 and not 1e-3 <= abs(value) < 1e5:
        mantissa, power = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa}·10{str(int(power)).translate(str.maketrans('-0123456789', '⁻⁰¹²³⁴⁵⁶⁷⁸⁹'))}"
    return f"{value:.{digits}g}" if abs(value) < 10**digits else f"{value:.0f}"


def _unit(channel: str) -> str:
    return channel.rsplit("_", 1)[1].replace("Nm", "N m")


def _scaled(channel: str, size: float) -> tuple[float, str]:
    """The unit in which a size of a channel reads well, as (value in SI units, name)."""
    return next(((scale, prefix + _unit(channel)) for scale, prefix in PREFIXES if size >= 0.1 * scale), (1.0, _unit(channel)))


def _quantity(value: float, channel: str) -> str:
    scale, unit = _scaled(channel, abs(value))
    return f"{_number(value / scale)} {unit}"


def _percent(p: float) -> str:
    if p > 0.995:
        return "> 99 %"
    return "< 1 %" if p < 0.005 else f"{100 * p:.0f} %"


def _tiles(content: Mapping[str, Any], check: MotionCheck | None = None) -> list[tuple[str, str, str]]:
    """Heading, figure and small print of the summary."""
    shrink, residual, named = content["shrink"], content["unexplained"], content["effects"]
    if content["verdict"] == "none":
        tiles = [("Probability of no gap", _percent(content["p_none"]), "noise and tolerances explain the recording")]
        worst = max(content["gap"], key=lambda g: g["excess"], default=None)
        return [*tiles, ("Largest excess", f"{_number(worst['excess'], 2)} times its floor", _place(worst))] if worst else tiles
    tiles = [
        ("Largest gap", _place(g), f"excess {_number(g['excess'], 2)} times its floor")
        for g in content["gap"]
        if content["where"] == {"channel": g["channel"], "phase": g["phase"]}
    ]
    names = ", ".join(e["id"] for e in named)
    if content.get("learned") and content["verdict"] == "unknown":
        tiles.append(("Cause", "a law that is not in the library", f"probability {_percent(content['p_unknown'])}"))
    elif content.get("events"):
        tiles.append(("Cause", "single events", f"{len(content['events'])} in the recording; no law"))
    elif content["verdict"] == "unknown":
        similar = f"most similar effects: {names}" if named else "no effect of the library is similar"
        tiles.append(("Cause", "not in the library", f"probability {_percent(content['p_unknown'])}; {similar}"))
    else:
        others = sorted({other for e in named for other in e["indistinguishable_from"]})
        small = "probability " + ", ".join(_percent(e["probability"]) for e in named)
        tiles.append(("Cause", names.replace(", ", " + "), small + (f"; or {', '.join(others)}" if others else "")))
    if content.get("learned") and content["verdict"] == "unknown":
        return [*tiles, *_law_tiles(content["learned"], check)]
    if shrink["closed"] is not None:
        low, high = shrink["ci95"] or (shrink["closed"], shrink["closed"])
        by = "Closed by the most similar effects" if content["verdict"] == "unknown" else "Closed"
        small = f"of the gap that noise and tolerances do not explain (95 % interval {100 * low:.0f} to {100 * high:.0f} %)"
        tiles.append((by, f"{100 * shrink['closed']:.0f} %", small))
    if residual:
        return [*tiles, ("Residual", _quantity(residual["rms"], residual["channel"]), f"unexplained, {_place(residual)}")]
    return [*tiles, ("Residual", "noise", "the residual looks like the stated noise")]


def _law_tiles(learned: Mapping[str, Any], check: MotionCheck | None) -> list[tuple[str, str, str]]:
    """What the law closes: over its driver, and on another motion."""
    sd = np.array(learned["data"]["sd"])
    before, after = (float(np.sum((np.array(learned["data"][key]) / sd) ** 2)) for key in ("before", "after"))
    share = max(0.0, 1.0 - after / max(before, 1e-300))
    tiles = [("Explained by the law", f"{100 * share:.0f} %", "of the square of the data over its driver")]
    if check is None or check.closed is None:
        return tiles
    return [
        *tiles,
        ("Closed on another motion", f"{100 * check.closed:.0f} %", "of the gap beyond noise, on a motion that it has not seen"),
    ]


def _candidates(content: Mapping[str, Any]) -> list[dict[str, Any]]:
    """What may be the cause, most probable first; a named effect carries its indistinguishable effects."""
    named = {e["id"]: e["indistinguishable_from"] for e in content["effects"]}
    grouped = {other for others in named.values() for other in others}
    rows = [
        {
            "name": c["id"],
            "p": c["probability"],
            "kind": "named" if c["id"] in named else "group" if c["id"] in grouped else "other",
            "group": named.get(c["id"], []),
        }
        for c in content["candidates"][:MOST_CANDIDATES]
    ]
    rows.append({"name": "an effect that is not in the library", "p": content["p_unknown"], "kind": "unknown", "group": []})
    rows.append({"name": "no gap", "p": content["p_none"], "kind": "none", "group": []})
    return [row | {"text": _percent(row["p"])} for row in sorted(rows, key=lambda row: -row["p"])]


def _closing(shrink: Mapping[str, Any]) -> dict[str, Any]:
    """The gap before and after as rms, and the part beyond the noise floor, √(rms² - floor²), which alone can close."""
    floor = shrink["noise_floor"]
    rms_of = {"nominal cell": shrink["before_rms"]} | ({} if shrink["closed"] is None else {"enriched cell": shrink["after_rms"]})
    beyond = {name: max(rms**2 - floor**2, 0.0) ** 0.5 for name, rms in rms_of.items()}
    longest = max(*beyond.values(), 1e-300)
    largest = max(*rms_of.values(), floor)
    scale, unit = _scaled(shrink["channel"], largest)
    decimals = max(0, 2 - int(np.floor(np.log10(max(largest / scale, 1e-3)))))
    rows = [
        {
            "name": name,
            "kind": name.split()[0],
            "share": beyond[name] / longest,
            "beyond": f"{beyond[name] / scale:.{decimals}f}",
            "rms": f"{rms / scale:.{decimals}f}",
        }
        for name, rms in rms_of.items()
    ]
    return {"rows": rows, "floor": f"{floor / scale:.{decimals}f}", "unit": unit, "channel": CHANNEL_WORDS[shrink["channel"]]}


def _certainty(value: float, low: float, high: float) -> str:
    width = abs(high - low) / max(abs(value), 1e-300)
    return "well known" if width < 0.2 else "roughly known" if width < 1.0 else "hardly known"


def _parameters(content: Mapping[str, Any], library: Mapping[str, Effect]) -> list[dict[str, str]]:
    rows = []
    for effect in content["effects"]:
        units = {p.name: p.unit for p in library[effect["id"]].parameters} if effect["id"] in library else {}
        for name, p in effect["parameters"].items():
            low, high = p["ci95"]
            rows.append(
                {
                    "effect": effect["id"],
                    "name": name,
                    "value": _number(p["value"], 4),
                    "low": _number(low),
                    "high": _number(high),
                    "unit": "" if units.get(name) == "1" else units.get(name, ""),
                    "sure": "at its bound" if name in effect.get("at_bound", []) else _certainty(p["value"], low, high),
                }
            )
    return rows


def _gap_rows(content: Mapping[str, Any]) -> list[tuple[str, list[dict[str, Any] | None]]]:
    """The excess over the floor of each channel (row) in each phase (column); None where the phase does not occur."""
    gaps = {(g["channel"], g["phase"]): g for g in content["gap"]}

    def shown(channel: str, phase: str) -> dict[str, Any] | None:
        g = gaps.get((channel, phase))
        if g is None:
            return None
        return {
            "text": f"{g['excess']:.0f}" if g["excess"] >= 10 else f"{g['excess']:.1f}",
            "heat": f"{min(1.0, log10(1.0 + g['excess']) / log10(31.0)):.2f}" if g["excess"] >= 0.3 else "0",
            "tip": f"rms {_quantity(g['rms'], channel)}, floor {_quantity(g['noise_floor'], channel)}",
            "largest": content["where"] == {"channel": channel, "phase": phase},
        }

    judged = [channel for channel in CHANNELS if any(channel == c for c, _ in gaps)]
    return [(CHANNEL_WORDS[channel], [shown(channel, phase) for phase in PHASES]) for channel in judged]


# figures


def _floors(content: Mapping[str, Any], channel: str) -> dict[str, float]:
    """The noise floor of a channel by phase."""
    return {g["phase"]: g["noise_floor"] for g in content["gap"] if g["channel"] == channel}


def _stretches(phase: NDArray[np.intp]) -> list[tuple[int, int]]:
    """Begin and end of every stretch of samples in one phase."""
    return list(pairwise([0, *(np.flatnonzero(np.diff(phase)) + 1).tolist(), len(phase)]))


def _shown_cycle(curves: Curves, channel: int, phase: int) -> NDArray[np.bool_]:
    """The cycle with the largest gap in a phase, as a mask of samples (n,); at most SHOWN_S of it around that phase."""
    before, _ = curves.gaps(channel)
    there = curves.phase == phase
    energy = np.bincount(curves.cycle[there], before[there] ** 2) if there.any() else np.zeros(1)
    cycle = curves.cycle == int(np.argmax(energy)) if there.any() else np.ones(len(before), dtype=bool)
    centre_s = float(np.median(curves.t_s[cycle & there] if there.any() else curves.t_s[cycle]))
    return cycle & (np.abs(curves.t_s - centre_s) < 0.5 * SHOWN_S)


def _smoothed(values: Floats, samples: int) -> Floats:
    """Running mean over an odd number of samples."""
    half = samples // 2
    kernel = np.ones(2 * half + 1) / (2 * half + 1)
    return np.asarray(np.convolve(np.pad(values, half, mode="edge"), kernel, mode="valid"))


def _tint(axes: Axes, t_s: Floats, phase: NDArray[np.intp], *, named: bool) -> None:
    """Colour the phases of contact, and name each once in the legend."""
    unnamed = set(PHASE_TINT) if named else set()
    for begin, end in _stretches(phase):
        name = PHASES[phase[begin]]
        if name in PHASE_TINT:
            label = PHASE_WORDS[name] if name in unnamed else None
            axes.axvspan(t_s[begin], t_s[min(end, len(t_s) - 1)], color=PHASE_TINT[name], alpha=TINT_ALPHA, linewidth=0, label=label)
            unnamed.discard(name)


def _press_figure(curves: Curves, channel: str, content: Mapping[str, Any]) -> Markup:
    """One cycle: measured and simulated above, measured minus simulated below."""
    c = CHANNELS.index(channel)
    mine = _shown_cycle(curves, c, PHASES.index(content["where"]["phase"] if content["where"] else "holding"))
    t_s, phase = curves.t_s[mine], curves.phase[mine]
    samples = max(1, round(SMOOTH_S * len(t_s) / max(t_s[-1] - t_s[0], 1e-9)))
    before, after = (_smoothed(gap[mine], samples) for gap in curves.gaps(c))
    enriched = "enriched cell" if content["effects"] or content.get("learned") else "nominal cell, tolerances fitted"
    with styled_figure(10.0, 4.7) as figure:
        top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(4, 3))
        scale, unit = _scaled(channel, float(np.ptp(curves.measured[mine, c])))
        top.plot(*thinned(t_s, curves.measured[mine, c] / scale), color=INK, label="measured")
        top.plot(*thinned(t_s, curves.nominal[mine, c] / scale), color=NOMINAL, label="nominal cell")
        top.plot(*thinned(t_s, curves.enriched[mine, c] / scale), color=ENRICHED, label=enriched)
        top.set(ylabel=f"{CHANNEL_WORDS[channel]} ({unit})")
        scale, unit = _scaled(channel, float(np.abs(before).max()))
        floor = max(_floors(content, channel).values(), default=0.0) / scale
        bottom.axhspan(-floor, floor, **FLOOR, label="noise floor of one sample")
        bottom.plot(*thinned(t_s, before / scale), color=NOMINAL)
        bottom.plot(*thinned(t_s, after / scale), color=ENRICHED)
        bottom.set(xlabel="time (s)", ylabel=f"measured − simulated ({unit})", xlim=(t_s[0], t_s[-1]))
        for axes in (top, bottom):
            _tint(axes, t_s, phase, named=axes is top)
        figure.align_ylabels()
        figure.legend(loc="outside upper left", ncols=7)
    return inline_svg(figure, "press")


def _phase_means(curves: Curves, channel: int) -> dict[tuple[str, str], tuple[Floats, int]]:
    """The mean course of both gaps (2, PHASE_STEPS) over all stretches of a phase, and their number.

    Free motion up and down stand apart: their gaps may cancel.
    """
    gaps, height_m = np.stack(curves.gaps(channel)), curves.measured[:, CHANNELS.index("z_m")]
    courses: defaultdict[tuple[str, str], list[Floats]] = defaultdict(list)
    for begin, end in _stretches(curves.phase):
        if end - begin < PHASE_STEPS:
            continue
        phase = PHASES[curves.phase[begin]]
        direction = (" up" if height_m[end - 1] > height_m[begin] else " down") if phase == "free_moving" else ""
        edges = np.linspace(begin, end, PHASE_STEPS + 1).astype(int)
        courses[phase, direction].append(np.add.reduceat(gaps[:, begin:end], edges[:-1] - begin, axis=1) / np.diff(edges))
    ordered = sorted(courses, key=lambda key: (PHASES.index(key[0]), key[1]))
    return {key: (np.mean(courses[key], axis=0), len(courses[key])) for key in ordered}


def _phase_figure(curves: Curves, channel: str, content: Mapping[str, Any]) -> Markup:
    """The mean gap over the course of every phase, from its beginning to its end."""
    means = _phase_means(curves, CHANNELS.index(channel))
    if not means:
        return Markup("")
    floors = _floors(content, channel)
    scale, unit = _scaled(channel, max([*(float(np.abs(course).max()) for course, _ in means.values()), *floors.values()]))
    share_percent = 100.0 * (np.arange(PHASE_STEPS) + 0.5) / PHASE_STEPS
    with styled_figure(10.0, 2.3 * ((len(means) + 2) // 3) + 0.2) as figure:
        grid = figure.subplots((len(means) + 2) // 3, 3, sharex=True, sharey=True, squeeze=False)
        for axes, ((phase, direction), (course, number)) in zip(grid.flat, means.items(), strict=False):
            floor = floors.get(phase, 0.0) / scale
            axes.axhspan(-floor, floor, **FLOOR)
            axes.plot(share_percent, course[0] / scale, color=NOMINAL)
            axes.plot(share_percent, course[1] / scale, color=ENRICHED)
            axes.set(title=f"{PHASE_WORDS[phase]}{direction}, mean of {number}", xlim=(0.0, 100.0))
            axes.tick_params(labelbottom=True)
        for axes in grid.flat[len(means) :]:
            axes.set_visible(False)
        figure.supxlabel("share of the phase (%)", fontsize=9)
        figure.supylabel(f"measured − simulated ({unit})", fontsize=9)
    return inline_svg(figure, "phases")


def _spectrum_figure(curves: Curves, channel: str) -> Markup:
    """Amplitude density of measured minus simulated, against that of white noise as measured at rest."""
    c = CHANNELS.index(channel)
    rate_Hz = 1.0 / float(np.median(np.diff(curves.t_s)))
    samples = int(min(len(curves.t_s), max(64, 8.0 * rate_Hz)))
    with styled_figure(5.0, 2.7) as figure:
        axes = figure.subplots()
        for gap, colour in zip(curves.gaps(c), (NOMINAL, ENRICHED), strict=True):
            frequency_Hz, power = welch(gap, rate_Hz, nperseg=samples, detrend=False)
            edges = np.unique(np.geomspace(1, len(frequency_Hz), 160).astype(int))[:-1]
            count = np.diff(np.append(edges, len(frequency_Hz)))
            amplitude = np.sqrt(np.maximum(np.add.reduceat(power, edges) / count, 1e-40))
            axes.loglog(np.add.reduceat(frequency_Hz, edges) / count, amplitude, color=colour)
        axes.axhline(float(curves.noise_rms[c]) / (rate_Hz / 2.0) ** 0.5, color=GREY)
        axes.set(xlabel="frequency (Hz)", ylabel=f"amplitude density ({_unit(channel)}/√Hz)")
    return inline_svg(figure, "spectrum")


def _trend_figure(content: Mapping[str, Any], channel: str, recording: int) -> Markup:
    """Rms and mean of the gap from cycle to cycle: a drift shows here first."""
    rows = [t for t in content["trend"] if t["channel"] == channel and t["recording"] == recording]
    if len(rows) < 2:
        return Markup("")
    begin_s, rms, mean = (np.array([float(row[key]) for row in rows]) for key in ("begin_s", "rms", "mean"))
    scale, unit = _scaled(channel, float(rms.max()))
    with styled_figure(5.0, 2.7) as figure:
        axes = figure.subplots()
        if floors := list(_floors(content, channel).values()):
            axes.axhspan(0.0, float(np.median(floors)) / scale, **FLOOR, label="floor")
        axes.plot(begin_s, rms / scale, ".-", color=NOMINAL, label="rms")
        axes.plot(begin_s, mean / scale, ".-", color=GREY, label="mean")
        axes.set(xlabel="begin of the cycle (s)", ylabel=f"gap to the nominal cell ({unit})")
        figure.legend(loc="outside upper left", ncols=3)
    return inline_svg(figure, "trend")


def _motion_figure(content: Mapping[str, Any]) -> Markup:
    """The motion of the next experiment."""
    proposed = content["next_experiment"]
    if not proposed or "\n" not in proposed["motion_csv"]:
        return Markup("")
    table = np.array([[float(x) for x in row.split(",")] for row in proposed["motion_csv"].strip().split("\n")[1:]])
    with styled_figure(5.0, 2.1) as figure:
        axes = figure.subplots()
        axes.plot(*thinned(table[:, 0], table[:, 1] * 1e3), color=INK)
        axes.set(xlabel="time (s)", ylabel="commanded height (mm)")
    return inline_svg(figure, "motion")


def _law_terms(content: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The terms of a learned law; none without one."""
    learned = content.get("learned")
    return [learned, *learned["further_terms"]] if learned else []


def _law_figure(content: Mapping[str, Any]) -> Markup:
    """Every term of a learned law over its driver: curve and data, and what remains without it and with it."""
    terms = _law_terms(content)
    if not terms:
        return Markup("")
    with styled_figure(10.0, 3.4 * len(terms)) as figure:
        grid = figure.subplots(len(terms), 2, sharex="row", squeeze=False)
        for (left, right), term in zip(grid, terms, strict=True):
            data, curve = {k: np.array(v) for k, v in term["data"].items()}, {k: np.array(v) for k, v in term["curve"].items()}
            x_scale, x_unit = _in_unit(curve["x"], term["driver_unit"])
            y_scale, y_unit = _in_unit(np.concatenate([curve["value"], data["before"]]), _law_unit(term))
            x, sd = data["x"] / x_scale, 2.0 * data["sd"] / y_scale
            band = {"color": ENRICHED, "alpha": 0.25, "linewidth": 0}
            left.fill_between(curve["x"] / x_scale, curve["low"] / y_scale, curve["high"] / y_scale, **band, label="95 % band")
            at, value = curve["x"], curve["value"]
            if term["formula"]:  # its corners lie between the knots
                at = np.linspace(at[0], at[-1], LAW_POINTS)
                value = formula_of(term["formula"])(at)
            left.plot(at / x_scale, value / y_scale, color=ENRICHED, label="law")
            left.errorbar(x, data["before"] / y_scale, sd, fmt=".", color=INK, elinewidth=0.7, label="data")
            for key, colour, label in (("before", NOMINAL, "without the law"), ("after", ENRICHED, "with it")):
                right.errorbar(x, data[key] / y_scale, sd, fmt=".", color=colour, elinewidth=0.7, label=label)
            left.set(ylabel=f"{_law_words(term)} ({y_unit})".replace(" ()", ""), title="What it does")
            right.set(title="What remains")
            low, high = _shown_range(data, curve["value"])
            for axes in (left, right):
                axes.set_ylim(low / y_scale, high / y_scale)
            for axes in (left, right):
                axes.set(xlabel=_driver_words(term, f"{x_unit}"))
                axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, borderaxespad=0.1)
    return inline_svg(figure, "law")


def _shown_range(data: Mapping[str, Floats], curve: Floats) -> tuple[float, float]:
    """Range of a law's axis: points with wide bars, where the factor of the law is nearly zero, do not set it."""
    sharp = data["sd"] <= SHARP * float(np.median(data["sd"]))
    reach = 2.0 * data["sd"][sharp]
    ends = [curve, *(data[key][sharp] + sign * reach for key in ("before", "after") for sign in (-1.0, 1.0))]
    low, high = min(float(x.min()) for x in ends), max(float(x.max()) for x in ends)
    margin = 0.08 * max(high - low, 1e-300)
    return low - margin, high + margin


def _in_unit(values: Floats, unit: str) -> tuple[float, str]:
    """The unit in which values read well: a length has a prefix, another unit stands as it is."""
    largest = float(np.abs(values).max())
    if unit != "m":
        return 1.0, unit
    return next(((scale, prefix + unit) for scale, prefix in PREFIXES if largest >= 0.1 * scale), (1.0, unit))


SHARP = 3.0
"""Bars, as multiples of the usual one, up to which a point sets the range of the axis."""
LAW_POINTS = 400
"""Points at which a formula is drawn."""
LAW_AXES = {
    "one": "added {}",
    "air": "added {} in the air",
    "pushing": "added {} while moving down",
    "force": "share of the contact force",
    "surface": "height of the surface",
    "speed": "damping",
    "direction": "friction",
    "force_direction": "friction over contact force",
    "acceleration": "moving mass",
}
"""What the curve of a law is, by its factor; the braces take the channel."""
LAW_UNITS = {"force": "/N", "force_direction": "/N", "speed": " s/m", "acceleration": " s²/m"}
"""What a factor adds to the unit of the channel."""


def _law_channel(term: Mapping[str, Any]) -> str:
    names = list(term["channels"])
    return names[0] if len(names) == 1 else "fx_N"


def _law_words(term: Mapping[str, Any]) -> str:
    """What the curve of a law is, in words for an axis."""
    words = LAW_AXES[term["factor"]]
    if len(term["channels"]) > 1:
        return f"{words.format('force')} to the side"
    channel = CHANNEL_WORDS[_law_channel(term)]
    return words.format(channel) if "{}" in words or channel == CHANNEL_WORDS["fz_N"] else f"{channel}: {words}"


def _law_unit(term: Mapping[str, Any]) -> str:
    """The unit of the curve of a law; empty for a share."""
    if term["factor"] == "surface":
        return "m"
    unit = _unit(_law_channel(term)) + LAW_UNITS.get(term["factor"], "")
    return {"N/N": "", "N s²/m": "kg"}.get(unit, unit)


def _driver_words(term: Mapping[str, Any], unit: str) -> str:
    """The driver of a law, in words for an axis."""
    words, repeats, _ = term["driver"].partition(", repeating every ")
    words = f"{words}, within one period" if repeats else words
    return f"{words if len(words) <= 50 else words.replace(', ', f',{chr(10)}', 1)} ({unit})".replace(" (1)", "")


def _law_formulas(content: Mapping[str, Any]) -> list[str]:
    """The closed formulas of a law with the meaning and unit of x, one a term."""
    lines = []
    for term in _law_terms(content):
        if term["formula"]:
            unit, driver = _law_unit(term), term["driver"].partition(", repeating every ")[0]
            of = "" if term["driver_unit"] == "1" else f" in {term['driver_unit']}"
            side = ""
            if len(term["channels"]) > 1:
                azimuth_rad = np.arctan2(term["channels"].get("fy_N", 0.0), term["channels"].get("fx_N", 0.0))
                side = f"\nit points {np.degrees(azimuth_rad):.0f} degrees from x towards y"
            lines.append(f"{_law_words(term)}{f' in {unit}' if unit else ''} = {term['formula']}\nx is {driver}{of}{side}")
    return lines


def _added(content: Mapping[str, Any]) -> str:
    """What the enriched cell has and the nominal one has not, in words."""
    return "the law" if content.get("learned") else "the named effects"


def _check_words(check: MotionCheck | None, added: str) -> str:
    """How the enriched cell does on another motion, in a sentence; empty without one."""
    if check is None:
        return ""
    before, after, noise = (_quantity(value, check.channel) for value in (check.before_rms, check.after_rms, check.noise))
    closed = "" if check.closed is None else f" It closes {100 * check.closed:.0f} % of the gap there."
    return (
        f"{CHANNEL_WORDS[check.channel].capitalize()} on a motion of {check.t_s[-1]:.0f} s that the diagnosis has not seen: {before} rms "
        f"off without {added}, {after} with the enriched cell; noise alone makes {noise}.{closed}"
    )


def _check_figure(check: MotionCheck | None, added: str) -> Markup:
    """Measured and simulated on another motion."""
    if check is None:
        return Markup("")
    with styled_figure(10.0, 4.4) as figure:
        top, bottom = figure.subplots(2, 1, sharex=True)
        scale, unit = _scaled(check.channel, float(np.ptp(check.measured)))
        top.plot(*thinned(check.t_s, check.measured / scale), color=INK, label="measured")
        top.plot(*thinned(check.t_s, check.enriched / scale), color=ENRICHED, label=f"simulated with {added}")
        top.set(ylabel=f"{CHANNEL_WORDS[check.channel]} ({unit})", xlim=(check.t_s[0], check.t_s[-1]))
        gaps = check.measured - check.plain, check.measured - check.enriched
        scale, unit = _scaled(check.channel, float(np.abs(gaps[0]).max()))
        bottom.axhspan(-2.0 * check.noise / scale, 2.0 * check.noise / scale, **FLOOR, label="noise (two standard deviations)")
        for gap, colour, label in zip(gaps, (NOMINAL, ENRICHED), (f"without {added}", f"with {added}"), strict=True):
            bottom.plot(*thinned(check.t_s, gap / scale), color=colour, label=label)
        bottom.set(xlabel="time (s)", ylabel=f"measured − simulated ({unit})")
        for axes in (top, bottom):
            axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, borderaxespad=0.1)
        figure.align_ylabels()
    return inline_svg(figure, "check")
