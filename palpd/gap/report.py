"""A diagnosis as one self-contained page: the verdict first, then what it rests on; computes nothing but what is drawn."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from itertools import pairwise
from math import ceil, floor, log10
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import yaml
from markupsafe import Markup, escape
from scipy.signal import welch

from palpd.effects import Effect
from palpd.errors import BadInput
from palpd.gap.diagnosis import Diagnosis
from palpd.gap.noise import CHANNELS
from palpd.gap.phases import PHASES
from palpd.samples import Samples
from palpd.tick import Floats

MEASURED, NOMINAL, ENRICHED, FLOOR = "#2f3542", "#e07b00", "#0b7fab", "#dfe4ea"
PHASE_TINT = {"free_still": "#ffffff", "free_moving": "#f4f6f8", "loading": "#fdeedd", "holding": "#fdf8e3", "unloading": "#e6f3f8"}
PHASE_WORDS = {
    "free_still": "free, at rest",
    "free_moving": "free, moving",
    "loading": "pressing in",
    "holding": "holding",
    "unloading": "pulling out",
}
CHANNEL_WORDS = {
    "z_m": "height z",
    "fx_N": "force fx",
    "fy_N": "force fy",
    "fz_N": "force fz",
    "tx_Nm": "torque tx",
    "ty_Nm": "torque ty",
    "tz_Nm": "torque tz",
}
PREFIXES = ((1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n"))
MOST_POINTS = 700


@dataclass(frozen=True)
class Curves:
    """One recording against its simulations. `measured`, `nominal` (the cell file as it stands) and `enriched` are (n, 7) in the order of
    CHANNELS, `phase` and `cycle` (n,) as the diagnosis cut them; `judged` says which channels there are."""

    t_s: Floats
    z_m: Floats
    phase: Any
    cycle: Any
    measured: Floats
    nominal: Floats
    enriched: Floats
    judged: tuple[bool, ...]
    noise_rms: Floats
    recording: int = 0


@dataclass(frozen=True)
class Line:
    """A line of a plot: where, its colour, its width, and how it is called."""

    x: Floats
    y: Floats
    colour: str
    width: float = 1.6
    name: str = ""


def write(path: Path, found: Diagnosis, title: str) -> None:
    """Write the report of a diagnosis; `title` names the recording. Raises BadInput where the file cannot be written."""
    try:
        path.write_text(page(found.to_json(), curves_of(found), found.problem.library, title), encoding="utf-8")
    except OSError as error:
        raise BadInput(f"{path} could not be written ({error.strerror}); choose another place.") from None


def curves_of(found: Diagnosis) -> Curves:
    """The recording of a diagnosis with the largest gap, with what the nominal and the enriched cell say to its motion."""
    problem = found.problem
    channel = found.where["channel"] if found.where is not None else ""
    gaps = np.zeros(len(problem.runs))
    for t in found.trend:
        gaps[int(t["recording"])] += float(t["rms"]) ** 2 if t["channel"] == channel else 0.0
    shown = int(np.argmax(gaps))
    run = problem.runs[shown]
    samples: Samples = run.samples
    return Curves(
        recording=shown,
        t_s=samples.t_s - samples.t_s[0],
        z_m=samples.z_m,
        phase=run.phases.phase,
        cycle=run.phases.cycle,
        measured=np.column_stack([samples.z_m, samples.wrench]),
        nominal=problem.raw_prediction(run, problem.cell),
        enriched=problem.raw_prediction(run, found.enriched_cell()),
        judged=tuple(run.judged),
        noise_rms=np.asarray(run.noise_rms),
    )


def page(content: Mapping[str, Any], curves: Curves, library: Mapping[str, Effect], title: str) -> str:
    """The page as HTML from the content of out.json and the curves."""
    channel = _channel(content)
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined)
    template = environment.from_string(files("palpd.gap").joinpath("report.html.j2").read_text(encoding="utf-8"))
    proposed = content["next_experiment"]
    return template.render(
        title=title,
        d=content,
        tiles=_tiles(content),
        what={name: effect.what for name, effect in library.items()},
        channel_words=CHANNEL_WORDS[channel],
        place=_place(content["where"]),
        press=_press(curves, channel, content),
        by_phase=_by_phase(curves, channel, content),
        heat=_heat(content),
        bars=_bars(content),
        before_after=_before_after(content),
        spectrum=_spectrum(curves, channel),
        trend=_trend(content, channel, curves.recording),
        parameters=_parameters(content, library),
        motion=_motion(content),
        plan=yaml.safe_dump(proposed["plan"], sort_keys=False) if proposed else "",
        colours={"measured": MEASURED, "nominal": NOMINAL, "enriched": ENRICHED},
    )


# words


def _channel(content: Mapping[str, Any]) -> str:
    """The channel that is shown: where the gap is largest, else where it would shrink."""
    shown: str = content["where"]["channel"] if content["where"] else content["shrink"]["channel"]
    return shown


def _place(where: Mapping[str, str] | None) -> str:
    return f"{CHANNEL_WORDS[where['channel']]}, {PHASE_WORDS[where['phase']]}" if where else "nowhere"


def _number(value: float, digits: int = 3) -> str:
    if not np.isfinite(value):
        return "∞"
    if value != 0.0 and not 1e-3 <= abs(value) < 1e5:
        mantissa, power = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa}·10{str(int(power)).translate(str.maketrans('-0123456789', '⁻⁰¹²³⁴⁵⁶⁷⁸⁹'))}"
    return f"{value:.{digits}g}" if abs(value) < 1000 else f"{value:.0f}"


def _scaled(unit: str, size: float) -> tuple[float, str]:
    """Divide by the first, write the second: a unit in which a size reads well."""
    for scale, prefix in PREFIXES:
        if size >= scale * 0.1 or scale == 1e-9:
            return scale, prefix + unit
    return 1.0, unit


def _unit(channel: str) -> str:
    return channel.rsplit("_", 1)[1].replace("Nm", "N m")


def _quantity(value: float, channel: str) -> str:
    scale, unit = _scaled(_unit(channel), abs(value))
    return f"{_number(value / scale)} {unit}"


def _percent(p: float) -> str:
    if p > 0.995:
        return "> 99 %"
    return "< 1 %" if p < 0.005 else f"{100 * p:.0f} %"


def _tiles(content: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Heading, figure and small print of what is seen first."""
    shrink, left = content["shrink"], content["unexplained"]
    if content["verdict"] == "none":
        worst = max(content["gap"], key=lambda g: g["excess"], default=None)
        note = f"largest excess over the floor: {worst['excess']:.2f} ({_place(worst)})" if worst else ""
        return [("No gap", _percent(content["p_none"]), "probability that this cell is within its tolerances"), ("Where", "nowhere", note)]
    named = content["effects"]
    top = max((g["excess"] for g in content["gap"]), default=0.0)
    tiles = [("Where", _place(content["where"]), f"{top:.1f} times the noise floor")]
    if content["verdict"] == "unknown":
        near = f"nearest in the list: {', '.join(e['id'] for e in named)}" if named else "nothing in the list comes near"
        tiles.append(("Cause", "not in the list", f"probability {_percent(content['p_unknown'])}; {near}"))
    else:
        family = sorted({other for e in named for other in e["indistinguishable_from"]})
        small = " · ".join(_percent(e["probability"]) for e in named) + (f" · or {', '.join(family)}" if family else "")
        tiles.append(("Cause", " + ".join(e["id"] for e in named), small))
    if shrink["closed"] is not None:
        low, high = shrink["ci95"] or (shrink["closed"], shrink["closed"])
        small = f"95 %: {100 * low:.0f} to {100 * high:.0f} %, {CHANNEL_WORDS[shrink['channel']]}, {shrink['on']}"
        closing = "With the nearest laws it closes by" if content["verdict"] == "unknown" else "The gap closes by"
        tiles.append((closing, f"{100 * shrink['closed']:.0f} %", small))
    if left:
        small = _place(left)
        tiles.append(("Left unexplained", _quantity(left["rms"], left["channel"]), small))
    else:
        tiles.append(("Left unexplained", "nothing", "what is left looks like the stated noise"))
    return tiles


def _parameters(content: Mapping[str, Any], library: Mapping[str, Effect]) -> list[dict[str, Any]]:
    rows = []
    for effect in content["effects"]:
        units = {p.name: p.unit for p in library[effect["id"]].parameters} if effect["id"] in library else {}
        for name, p in effect["parameters"].items():
            low, high = p["ci95"]
            wide = abs(high - low) / max(abs(p["value"]), 1e-300)
            rows.append(
                {
                    "effect": effect["id"],
                    "name": name,
                    "value": _number(p["value"], 4),
                    "low": _number(low),
                    "high": _number(high),
                    "unit": "" if units.get(name) == "1" else units.get(name, ""),
                    "sure": "at its bound" if name in effect.get("at_bound", []) else "well known" if wide < 0.2 else
                    "roughly known" if wide < 1.0 else "hardly known",
                }
            )
    return rows


# drawings


def _ticks(low: float, high: float, about: int = 5) -> list[float]:
    if not high > low:
        return [low]
    step = 10.0 ** floor(log10((high - low) / about))
    step = next(step * k for k in (1, 2, 5, 10, 20) if (high - low) / (step * k) <= about)
    return [k * step for k in range(ceil(low / step - 1e-9), floor(high / step + 1e-9) + 1)]


def _thinned(line: Line) -> tuple[Floats, Floats]:
    """As many points as can be seen, each the mean of its neighbours."""
    n = len(line.x)
    if n <= MOST_POINTS:
        return line.x, line.y
    edges = np.linspace(0, n, MOST_POINTS + 1).astype(int)[:-1]
    count = np.diff(np.append(edges, n))
    return np.add.reduceat(line.x, edges) / count, np.add.reduceat(line.y, edges) / count


def plot(
    lines: Sequence[Line],
    size: tuple[int, int],
    *,
    x_label: str = "",
    y_label: str = "",
    band: float | tuple[float, float] | None = None,
    spans: Sequence[tuple[float, float, str]] = (),
    log: bool = False,
    title: str = "",
    y_range: tuple[float, float] | None = None,
    bare_x: bool = False,
) -> Markup:
    """Lines over one another as inline SVG; `band` is shaded between ±band (or low and high), `spans` are tinted stretches of x."""
    width, height = size
    left, right, top, bottom = 58, 10, 22 if title else 8, 18 if bare_x else 36
    drawn = [_thinned(line) for line in lines]
    x_low, x_high = min(float(x.min()) for x, _ in drawn), max(float(x.max()) for x, _ in drawn)
    if y_range is None:
        y_low, y_high = min(float(y.min()) for _, y in drawn), max(float(y.max()) for _, y in drawn)
        if band is not None:
            below, above = (-band, band) if isinstance(band, float) else band
            y_low, y_high = min(y_low, below), max(y_high, above)
        pad = 0.06 * (y_high - y_low) or abs(y_high) or 1.0
        y_low, y_high = (y_low / 1.6, y_high * 1.6) if log else (y_low - pad, y_high + pad)
    else:
        y_low, y_high = y_range

    def place(value: Any, low: float, high: float, begin: float, end: float) -> Any:
        if log:
            value, low, high = np.log10(value), log10(low), log10(high)
        return begin + (value - low) / ((high - low) or 1.0) * (end - begin)

    def px(x: Any) -> Any:
        return place(x, x_low, x_high, left, width - right)

    def py(y: Any) -> Any:
        return place(y, y_low, y_high, height - bottom, top)

    out = [f'<svg viewBox="0 0 {width} {height}" role="img">']
    for begin, end, tint in spans:
        a, b = float(px(max(begin, x_low))), float(px(min(end, x_high)))
        out.append(f'<rect x="{a:.1f}" y="{top}" width="{max(b - a, 0):.1f}" height="{height - top - bottom}" fill="{tint}"/>')
    if band is not None:
        below, above = (-band, band) if isinstance(band, float) else band
        a, b = float(py(min(above, y_high))), float(py(max(below, y_low)))
        out.append(f'<rect x="{left}" y="{a:.1f}" width="{width - left - right}" height="{b - a:.1f}" fill="{FLOOR}" opacity=".8"/>')
    decades = [10.0**k for k in range(ceil(log10(y_low)), floor(log10(y_high)) + 1)] if log else []
    if log and len(decades) < 2:
        decades = [m * 10.0**k for k in range(floor(log10(y_low)), ceil(log10(y_high))) for m in (1, 2, 5) if y_low < m * 10.0**k < y_high]
    for tick in decades if log else _ticks(y_low, y_high, max(4, height // 40)):
        y = float(py(tick))
        power = log10(tick) if log else 0.5
        whole = abs(power - round(power)) < 1e-9
        label = f"10{str(round(power)).translate(str.maketrans('-0123456789', '⁻⁰¹²³⁴⁵⁶⁷⁸⁹'))}" if whole else _number(tick, 1 if log else 4)
        out.append(f'<line x1="{left}" x2="{width - right}" y1="{y:.1f}" y2="{y:.1f}" class="grid"/>')
        out.append(f'<text x="{left - 6}" y="{y + 4:.1f}" class="tick" text-anchor="end">{label}</text>')
    powers = [10.0**k for k in range(ceil(log10(x_low)), floor(log10(x_high)) + 1)] if log else []
    ticks = powers or _ticks(x_low, x_high, max(5, width // 110))
    for tick in ticks if not bare_x else []:
        x_text = f'x="{float(px(tick)):.1f}" y="{height - bottom + 14}"'
        out.append(f'<text {x_text} class="tick" text-anchor="middle">{_number(tick, 4)}</text>')
    for line, (xs, ys) in zip(lines, drawn, strict=True):
        heights = np.clip(py(ys), top, height - bottom).tolist()
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(px(xs).tolist(), heights, strict=True))
        out.append(f'<polyline points="{points}" fill="none" stroke="{line.colour}" stroke-width="{line.width}" stroke-linejoin="round"/>')
    out.append(f'<text x="{(left + width - right) / 2}" y="{height - 4}" class="axis" text-anchor="middle">{escape(x_label)}</text>')
    middle = (top + height - bottom) / 2
    out.append(f'<text transform="translate(13 {middle}) rotate(-90)" class="axis" text-anchor="middle">{escape(y_label)}</text>')
    if title:
        out.append(f'<text x="{left}" y="14" class="title">{escape(title)}</text>')
    out.append("</svg>")
    return Markup("".join(out))


def _spans(t_s: Floats, phase: Any) -> list[tuple[float, float, str]]:
    edges = [0, *(np.flatnonzero(np.diff(phase)) + 1).tolist(), len(phase)]
    return [(float(t_s[a]), float(t_s[min(b, len(t_s) - 1)]), PHASE_TINT[PHASES[phase[a]]]) for a, b in pairwise(edges)]


def _shown_cycle(curves: Curves, channel: int, content: Mapping[str, Any]) -> Any:
    """The cycle with the largest gap that has the phase in question; a mask of samples, at most 15 s of it around that phase."""
    gap = curves.measured[:, channel] - curves.nominal[:, channel]
    wanted = PHASES.index(content["where"]["phase"]) if content["where"] else PHASES.index("holding")
    best, chosen = -1.0, np.ones(len(gap), dtype=bool)
    for k in range(int(curves.cycle.max()) + 1):
        mine = curves.cycle == k
        there = mine & (curves.phase == wanted)
        energy = float(np.sum(gap[there] ** 2))
        if there.any() and energy > best:
            best, chosen = energy, mine
    here = chosen & (curves.phase == wanted)
    centre = float(np.median(curves.t_s[here])) if here.any() else float(np.median(curves.t_s[chosen]))
    return chosen & (np.abs(curves.t_s - centre) < 7.5)


def _press(curves: Curves, channel: str, content: Mapping[str, Any]) -> Markup:
    """One cycle: what was measured, what both simulations say, and what each leaves."""
    c = CHANNELS.index(channel)
    mine = _shown_cycle(curves, c, content)
    t = curves.t_s[mine]
    measured, nominal, enriched = curves.measured[mine, c], curves.nominal[mine, c], curves.enriched[mine, c]
    scale, unit = _scaled(_unit(channel), float(np.ptp(measured)) + 1e-12)
    spans = _spans(t, curves.phase[mine])
    over = plot(
        [Line(t, measured / scale, MEASURED, 2.6), Line(t, nominal / scale, NOMINAL, 1.5), Line(t, enriched / scale, ENRICHED, 1.5)],
        (980, 250),
        y_label=f"{CHANNEL_WORDS[channel]} in {unit}",
        spans=spans,
        bare_x=True,
    )
    smooth = max(1, round(0.04 * len(t) / max(t[-1] - t[0], 1e-9)))
    before, after = _smoothed(measured - nominal, smooth), _smoothed(measured - enriched, smooth)
    scale, unit = _scaled(_unit(channel), float(np.abs(before).max()) + 1e-12)
    floor_ = max((g["noise_floor"] for g in content["gap"] if g["channel"] == channel), default=0.0)
    left = plot(
        [Line(t, before / scale, NOMINAL, 1.4), Line(t, after / scale, ENRICHED, 1.4)],
        (980, 190),
        x_label="time in s",
        y_label=f"measured - simulated, {unit}",
        spans=spans,
        band=float(floor_ / scale),
    )
    return Markup("") + over + left


def _smoothed(values: Floats, width: int) -> Floats:
    """Running mean over an odd number of samples."""
    half = width // 2
    kernel = np.ones(2 * half + 1) / (2 * half + 1)
    return np.asarray(np.convolve(np.pad(values, half, mode="edge"), kernel, mode="valid"))


def _by_phase(curves: Curves, channel: str, content: Mapping[str, Any]) -> list[Markup]:
    """The mean gap over the course of every phase, from its beginning to its end; free strokes up and down apart, which may cancel."""
    c, z = CHANNELS.index(channel), CHANNELS.index("z_m")
    shown: list[tuple[str, str, Floats, int]] = []
    for p, phase in enumerate(PHASES):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], (curves.phase == p).astype(int), [0]])))
        sums: dict[str, Floats] = {}
        runs: Counter[str] = Counter()
        for a, b in zip(edges[::2], edges[1::2], strict=True):
            if b - a < 25:
                continue
            way = (" up" if curves.measured[b - 1, z] > curves.measured[a, z] else " down") if phase == "free_moving" else ""
            at = np.linspace(a, b, 26).astype(int)[:-1]
            count = np.diff(np.append(at, b))
            mine = sums.setdefault(way, np.zeros((2, 25)))
            for row, simulated in enumerate((curves.nominal, curves.enriched)):
                mine[row] += np.add.reduceat((curves.measured[a:b, c] - simulated[a:b, c]), at - a) / count
            runs[way] += 1
        shown += [(phase, way, sums[way] / runs[way], runs[way]) for way in sorted(sums)]
    if not shown:
        return []
    largest = max(float(np.abs(values).max()) for _, _, values, _ in shown)
    floors = {g["phase"]: g["noise_floor"] for g in content["gap"] if g["channel"] == channel}
    largest = max(largest, *(floors.get(phase, 0.0) for phase, *_ in shown)) * 1.1 or 1.0
    scale, unit = _scaled(_unit(channel), largest)
    share = np.linspace(2.0, 98.0, 25)
    return [
        plot(
            [Line(share, values[0] / scale, NOMINAL, 2.0), Line(share, values[1] / scale, ENRICHED, 2.0)],
            (320, 190),
            title=f"{PHASE_WORDS[phase]}{way} (mean of {runs})",
            x_label="% of the phase",
            y_label=unit,
            band=float(floors.get(phase, 0.0) / scale),
            y_range=(-largest / scale, largest / scale),
        )
        for phase, way, values, runs in shown
    ]


def _heat(content: Mapping[str, Any]) -> Markup:
    """Excess over the floor by channel and phase."""
    cell_w, cell_h, left, top = 150, 34, 110, 30
    channels = [c for c in CHANNELS if any(g["channel"] == c for g in content["gap"])]
    width, height = left + cell_w * len(PHASES) + 6, top + cell_h * len(channels) + 6
    out = [f'<svg viewBox="0 0 {width} {height}" role="img">']
    for p, phase in enumerate(PHASES):
        out.append(f'<text x="{left + (p + 0.5) * cell_w}" y="18" class="axis" text-anchor="middle">{PHASE_WORDS[phase]}</text>')
    where = content["where"]
    frame = ""
    for row, channel in enumerate(channels):
        y = top + row * cell_h
        out.append(f'<text x="{left - 10}" y="{y + cell_h / 2 + 5}" class="axis" text-anchor="end">{CHANNEL_WORDS[channel]}</text>')
        for p, phase in enumerate(PHASES):
            x = left + p * cell_w
            here = [g for g in content["gap"] if g["channel"] == channel and g["phase"] == phase]
            if not here:
                out.append(f'<rect x="{x + 1}" y="{y + 1}" width="{cell_w - 2}" height="{cell_h - 2}" rx="4" fill="#f6f7f9"/>')
                continue
            excess, rms = here[0]["excess"], here[0]["rms"]
            heat = min(1.0, log10(1.0 + excess) / log10(31.0))
            fill = f"rgb({255 - int(26 * heat)},{250 - int(150 * heat)},{245 - int(230 * heat)})" if excess >= 0.3 else "#f1f5f3"
            colour = "#fff" if heat > 0.75 else "#1d2733"
            text = f"{excess:.0f}" if excess >= 10 else f"{excess:.1f}"
            tip = f"{channel}, {phase}: rms {_quantity(rms, channel)}, floor {_quantity(here[0]['noise_floor'], channel)}"
            out.append(
                f'<g><title>{tip}</title><rect x="{x + 1}" y="{y + 1}" width="{cell_w - 2}" height="{cell_h - 2}" rx="4" fill="{fill}"/>'
                f'<text x="{x + cell_w / 2}" y="{y + cell_h / 2 + 5}" text-anchor="middle" class="cell" fill="{colour}">{text}</text></g>'
            )
            if where and where["channel"] == channel and where["phase"] == phase:
                frame = (
                    f'<rect x="{x + 1}" y="{y + 1}" width="{cell_w - 2}" height="{cell_h - 2}" rx="4" fill="none" '
                    'stroke="#1d2733" stroke-width="2.5"/>'
                )
    return Markup("".join([*out, frame, "</svg>"]))


def _bars(content: Mapping[str, Any]) -> list[dict[str, Any]]:
    """What there is to believe, most probable first; the members of a named effect's group stand under it."""
    named = {e["id"]: e for e in content["effects"]}
    grouped = {other for e in content["effects"] for other in e["indistinguishable_from"]}
    bars = [
        {
            "name": c["id"],
            "p": c["probability"],
            "text": _percent(c["probability"]),
            "kind": "named" if c["id"] in named else "group" if c["id"] in grouped else "other",
            "group": named[c["id"]]["indistinguishable_from"] if c["id"] in named else [],
        }
        for c in content["candidates"][:7]
    ]
    for name, key in (("something not in the list", "p_unknown"), ("no gap at all", "p_none")):
        bars.append({"name": name, "p": content[key], "text": _percent(content[key]), "kind": key, "group": []})
    return sorted(bars, key=lambda bar: -bar["p"])


def _before_after(content: Mapping[str, Any]) -> list[dict[str, Any]]:
    s = content["shrink"]
    top = max(s["before_rms"], s["after_rms"], s["noise_floor"], 1e-300)
    rows = [("before", s["before_rms"], NOMINAL), ("after", s["after_rms"], ENRICHED), ("noise floor", s["noise_floor"], "#b6bfca")]
    if s["closed"] is None:
        rows = [("gap", s["before_rms"], NOMINAL), rows[2]]
    scale, unit = _scaled(_unit(s["channel"]), top)
    return [{"name": name, "share": rms / top, "text": f"{_number(rms / scale)} {unit}", "colour": colour} for name, rms, colour in rows]


def _spectrum(curves: Curves, channel: str) -> Markup:
    """Amplitude density of what both simulations leave, against that of the noise."""
    c = CHANNELS.index(channel)
    rate_Hz = 1.0 / float(np.median(np.diff(curves.t_s)))
    n = int(min(len(curves.t_s), max(64, 8.0 * rate_Hz)))
    lines = []
    for simulated, colour, width in ((curves.nominal, NOMINAL, 1.8), (curves.enriched, ENRICHED, 1.8)):
        f, power = welch(curves.measured[:, c] - simulated[:, c], rate_Hz, nperseg=n, detrend=False)
        edges = np.unique(np.geomspace(1, len(f), 160).astype(int))[:-1]
        count = np.diff(np.append(edges, len(f)))
        mean: Floats = np.add.reduceat(np.asarray(power, dtype=np.float64), edges) / count
        middle: Floats = np.add.reduceat(np.asarray(f, dtype=np.float64), edges) / count
        amplitude: Floats = np.sqrt(np.maximum(mean, 1e-40))
        lines.append(Line(middle, amplitude, colour, width))
    noise = float(curves.noise_rms[c]) / (rate_Hz / 2.0) ** 0.5
    lines.append(Line(lines[0].x[[0, -1]], np.array([noise, noise]), "#8a94a3", 1.2))
    unit = _unit(channel)
    return plot(lines, (480, 250), x_label="frequency in Hz", y_label=f"{unit} / √Hz", log=True)


def _trend(content: Mapping[str, Any], channel: str, recording: int) -> Markup:
    """Mean and rms of the gap from cycle to cycle: a drift shows here first."""
    rows = [t for t in content["trend"] if t["channel"] == channel and t["recording"] == recording]
    if len(rows) < 2:
        return Markup("")
    x = np.array([float(t["begin_s"]) for t in rows])
    rms, mean = np.array([float(t["rms"]) for t in rows]), np.array([float(t["mean"]) for t in rows])
    scale, unit = _scaled(_unit(channel), float(rms.max()))
    floors = [g["noise_floor"] for g in content["gap"] if g["channel"] == channel]
    return plot(
        [Line(x, rms / scale, NOMINAL, 2.2), Line(x, mean / scale, "#8a94a3", 1.6)],
        (480, 250),
        x_label="begin of the cycle in s",
        y_label=unit,
        band=(0.0, float(np.median(floors)) / scale) if floors else None,
    )


def _motion(content: Mapping[str, Any]) -> Markup:
    """The motion of the next experiment."""
    proposed = content["next_experiment"]
    if not proposed or "\n" not in proposed["motion_csv"]:
        return Markup("")
    table = np.array([[float(x) for x in row.split(",")] for row in proposed["motion_csv"].strip().split("\n")[1:]])
    return plot([Line(table[:, 0], table[:, 1] * 1e3, MEASURED, 1.6)], (480, 190), x_label="time in s", y_label="commanded height in mm")
