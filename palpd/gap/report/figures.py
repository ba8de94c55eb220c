"""The figures of a diagnosis: signals and residuals, the gap by phase, frequency and cycle, a learned law, another motion."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from numpy.typing import NDArray
from scipy.signal import welch

from palpd.analysis.figure_style import BLUE, ENRICHED, FLOOR, GREY, INK, NOMINAL, ORANGE, YELLOW, inline_svg, styled_figure, thinned
from palpd.cell.effects.learned import formula_of
from palpd.gap.data.noise import CHANNELS
from palpd.gap.data.phases import PHASES
from palpd.gap.other_motion import MotionCheck
from palpd.gap.plain import CHANNEL_WORDS, channel_name, own_unit, shown_place, unit_of
from palpd.quantities import quantity, scaled
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
PHASE_STEPS = 25
"""Number of points of the mean course of a phase; a stretch with fewer samples is left out."""
SMOOTH_S = 0.04
"""Length of the running mean of residual curves: shorter than any phase, and long enough to see beneath the noise."""
SHOWN_S = 15.0
"""Longest stretch of a cycle in the figure of curves; in a longer stretch a press is too narrow to see."""


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
        """Measured minus simulated (n,) of a channel: by the nominal cell, and by the enriched cell."""
        measured = self.measured[:, channel]
        return measured - self.nominal[:, channel], measured - self.enriched[:, channel]


def figures_of(content: Mapping[str, Any], curves: Curves, channel: str, check: MotionCheck | None) -> dict[str, Markup]:
    """Draw all figures of a page; a figure for which there is nothing to show is empty.

    Args:
        content: The content of out.json.
        curves: The recording that is drawn.
        channel: The channel in the figures of that recording.
        check: The enriched cell on another motion; None where no other motion was recorded.

    Returns:
        SVG elements by name.
    """
    return {
        "press": _press_figure(curves, channel, content),
        "phases": _phase_figure(curves, channel, content),
        "spectrum": _spectrum_figure(curves, channel, content),
        "trend": _trend_figure(content, channel, curves.recording),
        "motion": _motion_figure(content),
        "law": _law_figure(content),
        "check": _check_figure(check),
        "detectable": _detectable_figure(content),
    }


def _floors(content: Mapping[str, Any], channel: str) -> dict[str, float]:
    """The noise floor of a channel by phase."""
    return {g["phase"]: g["noise_floor"] for g in content["gap"] if g["channel"] == channel}


def _stretches(phase: NDArray[np.intp]) -> list[tuple[int, int]]:
    """Begin and end of every stretch of samples in the same phase."""
    return list(pairwise([0, *(np.flatnonzero(np.diff(phase)) + 1).tolist(), len(phase)]))


def _shown_cycle(curves: Curves, channel: int, phase: int) -> NDArray[np.bool_]:
    """The cycle with the largest gap in a phase, as a mask of samples (n,); at most SHOWN_S of it, with that phase in the middle."""
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
    place = shown_place(content)
    mine = _shown_cycle(curves, c, PHASES.index(place["phase"] if place is not None else "holding"))
    t_s, phase = curves.t_s[mine], curves.phase[mine]
    samples = max(1, round(SMOOTH_S * len(t_s) / max(t_s[-1] - t_s[0], 1e-9)))
    before, after = (_smoothed(gap[mine], samples) for gap in curves.gaps(c))
    enriched = "enriched cell" if content["effects"] or content.get("learned") else "nominal cell, tolerances fitted"
    with styled_figure(10.0, 4.7) as figure:
        top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(4, 3))
        scale, unit = scaled(float(np.ptp(curves.measured[mine, c])), unit_of(channel, content))
        top.plot(*thinned(t_s, curves.measured[mine, c] / scale), color=INK, label="measured")
        top.plot(*thinned(t_s, curves.nominal[mine, c] / scale), color=NOMINAL, label="nominal cell")
        top.plot(*thinned(t_s, curves.enriched[mine, c] / scale), color=ENRICHED, label=enriched)
        top.set(ylabel=f"{channel_name(channel, content)} ({unit})")
        scale, unit = scaled(float(np.abs(before).max()), unit_of(channel, content))
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

    Free motion up and free motion down have separate means: their gaps may cancel.
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
    scale, unit = scaled(max([*(float(np.abs(course).max()) for course, _ in means.values()), *floors.values()]), unit_of(channel, content))
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


def _spectrum_figure(curves: Curves, channel: str, content: Mapping[str, Any]) -> Markup:
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
        axes.set(xlabel="frequency (Hz)", ylabel=f"amplitude density ({unit_of(channel, content)}/√Hz)")
    return inline_svg(figure, "spectrum")


def _trend_figure(content: Mapping[str, Any], channel: str, recording: int) -> Markup:
    """Rms and mean of the gap from cycle to cycle: a drift shows here first."""
    rows = [t for t in content["trend"] if t["channel"] == channel and t["recording"] == recording]
    if len(rows) < 2:
        return Markup("")
    begin_s, rms, mean = (np.array([float(row[key]) for row in rows]) for key in ("begin_s", "rms", "mean"))
    scale, unit = scaled(float(rms.max()), unit_of(channel, content))
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


def _law_figure(content: Mapping[str, Any]) -> Markup:
    """Every term of a learned law over its driver: curve and data, and what remains without it and with it."""
    learned = content.get("learned")
    if not learned:
        return Markup("")
    terms, words = [learned, *learned["further_terms"]], learned["what"].split("; ")
    with styled_figure(10.0, 3.4 * len(terms)) as figure:
        grid = figure.subplots(len(terms), 2, sharex="row", squeeze=False)
        for (left, right), term, law in zip(grid, terms, [*words, *words], strict=False):
            data, curve = {k: np.array(v) for k, v in term["data"].items()}, {k: np.array(v) for k, v in term["curve"].items()}
            x_scale, x_unit = scaled(float(np.abs(curve["x"]).max()), term["driver_unit"])
            y_scale, y_unit = scaled(max(float(np.abs(y).max()) for y in (curve["value"], data["before"])), _law_unit(term))
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
            left.set(ylabel=f"{law.partition(' that ')[0]} ({y_unit})".replace(" ()", ""), title="What it does")
            right.set(title="What remains")
            low, high = _shown_range(data, curve["value"])
            for axes in (left, right):
                axes.set_ylim(low / y_scale, high / y_scale)
            for axes in (left, right):
                axes.set(xlabel=_driver_words(term, f"{x_unit}"))
                axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, borderaxespad=0.1)
    return inline_svg(figure, "law")


def _detectable_figure(content: Mapping[str, Any]) -> Markup:
    """A bar an effect: from the smallest size that the recordings would have shown on, beside its tolerance."""
    rows = sorted(content.get("detectable", ()), key=lambda one: (one["of_typical"] is None, one["of_typical"] or 0.0, one["id"]))
    if not rows:
        return Markup("")
    sizes = [one[key] for one in rows for key in ("of_typical", "specification") if one[key]]
    low, high = 0.4 * min(sizes, default=0.1), 4.0 * max([*sizes, 1.0])
    with styled_figure(10.0, 0.6 + 0.21 * len(rows)) as figure:
        axes = figure.subplots()
        for place, one in enumerate(rows):
            if one["of_typical"] is None:
                axes.text(low * 1.2, place, f"not at all: {one['needs']}", va="center", fontsize="small", color=GREY)
                continue
            axes.barh(place, high - one["of_typical"], left=one["of_typical"], height=0.62, color=ENRICHED, alpha=0.35)
            words = f"{one['parameter'].removesuffix('_' + one['unit'].replace('/', '_per_').replace(' ', '_')).replace('_', ' ')} "
            axes.text(
                one["of_typical"] * 1.08,
                place,
                words + quantity(one["smallest"], own_unit(one["unit"], content)),
                va="center",
                fontsize="small",
            )
        marked = [(one["specification"], place) for place, one in enumerate(rows) if one["specification"]]
        if marked:
            axes.plot(
                *zip(*marked, strict=True), "|", color=INK, markersize=9, markeredgewidth=1.6, label="its tolerance, one standard deviation"
            )
            axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.1)
        axes.set(xscale="log", xlim=(low, high), ylim=(len(rows) - 0.4, -0.6), xlabel="size, as a multiple of a typical one")
        axes.set_yticks(range(len(rows)), [one["id"] for one in rows], fontsize="small")
    return inline_svg(figure, "detectable")


def _shown_range(data: Mapping[str, Floats], curve: Floats) -> tuple[float, float]:
    """Range of a law's axis: points with wide bars, where the factor of the law is nearly zero, do not set it."""
    sharp = data["sd"] <= SHARP * float(np.median(data["sd"]))
    reach = 2.0 * data["sd"][sharp]
    ends = [curve, *(data[key][sharp] + sign * reach for key in ("before", "after") for sign in (-1.0, 1.0))]
    low, high = min(float(x.min()) for x in ends), max(float(x.max()) for x in ends)
    margin = 0.08 * max(high - low, 1e-300)
    return low - margin, high + margin


SHARP = 3.0
"""Longest error bar, as a multiple of the median one, with which a point sets the range of the axis."""
LAW_POINTS = 400
"""Number of points at which a formula is drawn."""
LAW_UNITS = {"force": "/N", "force_direction": "/N", "speed": " s/m", "acceleration": " s²/m"}
"""What a factor adds to the unit of the channel."""


def _law_unit(term: Mapping[str, Any]) -> str:
    """The SI unit of the curve of a law; "1" for a share."""
    if term["factor"] == "surface":
        return "m"
    names = list(term["channels"])
    unit = unit_of(names[0] if len(names) == 1 else "fx_N") + LAW_UNITS.get(term["factor"], "")
    return {"N/N": "1", "N s²/m": "kg"}.get(unit, unit)


def _driver_words(term: Mapping[str, Any], unit: str) -> str:
    """The driver of a law, in words for an axis."""
    words, repeats, _ = term["driver"].partition(", repeating every ")
    words = f"{words}, within one period" if repeats else words
    return f"{words if len(words) <= 50 else words.replace(', ', f',{chr(10)}', 1)} ({unit})".replace(" ()", "")


def _check_figure(check: MotionCheck | None) -> Markup:
    """Measured and simulated on another motion."""
    if check is None:
        return Markup("")
    with styled_figure(10.0, 4.4) as figure:
        top, bottom = figure.subplots(2, 1, sharex=True)
        scale, unit = scaled(float(np.ptp(check.measured)), unit_of(check.channel))
        top.plot(*thinned(check.t_s, check.measured / scale), color=INK, label="measured")
        top.plot(*thinned(check.t_s, check.enriched / scale), color=ENRICHED, label="simulated with what was found")
        top.set(ylabel=f"{CHANNEL_WORDS[check.channel]} ({unit})", xlim=(check.t_s[0], check.t_s[-1]))
        gaps = check.measured - check.plain, check.measured - check.enriched
        scale, unit = scaled(float(np.abs(gaps[0]).max()), unit_of(check.channel))
        bottom.axhspan(-2.0 * check.noise / scale, 2.0 * check.noise / scale, **FLOOR, label="noise (two standard deviations)")
        for gap, colour, label in zip(gaps, (NOMINAL, ENRICHED), ("without what was found", "with it"), strict=True):
            bottom.plot(*thinned(check.t_s, gap / scale), color=colour, label=label)
        bottom.set(xlabel="time (s)", ylabel=f"measured − simulated ({unit})")
        for axes in (top, bottom):
            axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, borderaxespad=0.1)
        figure.align_ylabels()
    return inline_svg(figure, "check")
