"""The study as one self-contained page: tables and figures of Guo, Xiao, Ren 2019 beside what this system makes of them."""

import base64
import io
import json
import math
from collections.abc import Callable
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2
import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from palpd import study_paper as paper
from palpd.compensate import features
from palpd.inclusion import Inclusion
from palpd.mapping import figure_of, raster
from palpd.study import ENRICHED, METHODS, NAMED, NETWORK, NONE, TRUTH, WINNER, Hold, Judged, Study, inclusion_below
from palpd.study_cell import Take
from palpd.tick import Floats
from palpd.young import student_t_95

matplotlib.use("Agg")
BLUE, BLACK, RED, GREY = "#2a6fbb", "#1a1a1a", "#c0392b", "#9aa5b1"
TITLES = {"A": "A: no inclusion", "B": "B: inclusion 5 mm", "C": "C: inclusion 8 mm", "D": "D: inclusion 10 mm"}
TEMPLATE = "study_report.html.j2"
PUBLISHED = float(np.mean([paper.averages(name).ymbt_corrected for name in paper.SETUPS]))
"""Mean over the setups of Table 3's corrected YMBT."""
SMOOTH_S, ZOOM_S = 0.5, 0.9
POINTS = 4000
"""Points of a drawn line; more cannot be seen."""


def write(study: Study, folder: Path) -> tuple[Path, Path]:
    """Write study.html and study.json into a folder; returns their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    page, numbers = folder / "study.html", folder / "study.json"
    page.write_text(html(study), encoding="utf-8")
    numbers.write_text(json.dumps(figures_of(study), indent=1) + "\n", encoding="utf-8")
    return page, numbers


def figures_of(study: Study) -> dict[str, Any]:
    """The numbers of the study."""
    return {
        "schema": "palpd.study/1",
        "simulated": study.data.simulated,
        "free_motion_mean_N": {
            "without the probe": _mean_force(study.data.bare),
            "with the probe": _mean_force(study.data.free),
        },
        "models": {name: {key: card[key] for key in ("bias_N", "mass_kg", "rmse_N")} for name, card in study.cards.items()},
        "setups": [
            {
                "name": each.palpated.name,
                "static_Pa": each.static_Pa,
                "modulus_Pa": each.modulus_Pa,
                "ymbt": each.ymbt,
                "holds": [{"depth_m": h.depth_m, "force_N": h.force_N, "E_Pa": h.youngs_modulus_Pa} for h in each.palpated.holds],
                "peaks": [{"t_s": p.t_s, "depth_m": p.depth_m, "force_N": p.force_N, "E_Pa": p.youngs_modulus_Pa} for p in each.peaks],
            }
            for each in study.setups
        ],
        "days": study.days,
        "ymbt_away_from_true_force": away_from_truth(study),
        "inclusions": [
            {"name": name, "published": asdict(published) if published else None, "here": asdict(here) if here else None}
            for name, published, here in _inclusions(study)
        ],
        "ymbt_mean": {name: {"mean": mean, "ci95_half": half, "n": n} for name, (mean, half, n) in means(study).items()},
    }


def away_from_truth(study: Study) -> dict[str, float]:
    """How far the YMBT of a method is from that of the true contact force, rms over setups and days, as a ratio like YMBT itself.

    That is the error of the compensation alone: nothing of the tissue, of depths or of the static mean is in it.
    """
    of_setups = [setup for day in _days(study) for setup in day.values() if TRUTH in setup]
    names = [name for name in METHODS if of_setups and all(name in setup for setup in of_setups)]
    return {name: float(np.sqrt(np.mean([(setup[name] - setup[TRUTH]) ** 2 for setup in of_setups]))) for name in names}


def _days(study: Study) -> list[dict[str, dict[str, float]]]:
    return [{each.palpated.name: each.ymbt for each in study.setups}, *study.days]


def means(study: Study) -> dict[str, tuple[float, float, int]]:
    """YMBT averaged over the setups of a day, then over days: mean, half of the 95 % interval, number of days."""
    days = _days(study)
    found = {}
    for name in (*METHODS, TRUTH, ENRICHED):
        values = np.array([np.mean([setup[name] for setup in day.values()]) for day in days if all(name in s for s in day.values())])
        if len(values):
            spread = float(np.std(values, ddof=1)) if len(values) > 1 else math.nan
            half = student_t_95(len(values) - 1) * spread / math.sqrt(len(values)) if len(values) > 1 else math.nan
            found[name] = (float(values.mean()), half, len(values))
    return found


def _mean_force(takes: list[Any]) -> float | None:
    return float(np.mean([run.fz_N.mean() for run in takes])) if takes else None


# figures


def _picture(draw: Callable[[Figure], None], width: float = 10.0, height: float = 3.0) -> str:
    figure = Figure(figsize=(width, height), layout="constrained", dpi=110)
    draw(figure)
    return _encoded(figure)


def _encoded(figure: Figure) -> str:
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return "data:image/png;base64," + base64.b64encode(stream.getvalue()).decode()


def _thin(*columns: Floats) -> list[Floats]:
    step = max(1, len(columns[0]) // POINTS)
    return [column[::step] for column in columns]


def _smooth(run: Take) -> Floats:
    """Moving mean of fz over `SMOOTH_S`."""
    width = max(1, round(SMOOTH_S / float(np.median(np.diff(run.t_s)))))
    summed = np.convolve(run.fz_N, np.ones(width), mode="same")
    return np.asarray(summed / np.convolve(np.ones(len(run.t_s)), np.ones(width), mode="same"))


def _legend_above(axes: Axes) -> None:
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), fontsize=8, ncols=3, frameon=False)


def _style(axes: Axes, x: str, y: str, title: str = "") -> None:
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.set_title(title, loc="left", fontsize=10)
    axes.grid(color="#e5e9ee", linewidth=0.7)
    axes.spines[["top", "right"]].set_visible(False)


def _free_forces(study: Study) -> str:
    """Figure 7."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for runs, colour, name in ((study.data.bare[:1], BLACK, "without the probe"), (study.data.free[:1], BLUE, "with the probe")):
            for run in runs:
                axes.plot(*_thin(run.t_s, run.fz_N), color=colour, linewidth=0.4, alpha=0.25)
                axes.plot(*_thin(run.t_s, _smooth(run)), color=colour, linewidth=1.2, label=f"{name}, mean {run.fz_N.mean():+.3f} N")
        axes.axhline(0.0, color=GREY, linewidth=0.7)
        _style(axes, "time (s)", "Fz (N)")
        _legend_above(axes)

    return _picture(draw)


def _ten(study: Study) -> str:
    """Figure 8."""

    def draw(figure: Figure) -> None:
        count = min(len(study.data.free), 10)
        grid = figure.subplots(2, math.ceil(count / 2), sharex=True, sharey=True, squeeze=False)
        for number, (axes, run) in enumerate(zip(grid.flat, study.data.free, strict=False), start=1):
            axes.plot(*_thin(run.t_s, run.fz_N), color=BLUE, linewidth=0.4)
            axes.axhline(0.0, color=BLACK, linewidth=0.6)
            _style(axes, "t (s)" if number > count / 2 else "", "Fz (N)" if number % 5 == 1 else "", f"run {number}")

    return _picture(draw, height=4.0)


def _average(study: Study) -> tuple[Floats, Floats]:
    """Time and mean force of the repeats."""
    shortest = min(study.data.free, key=lambda run: len(run.t_s))
    n = len(shortest.t_s)
    return shortest.t_s, np.asarray(np.mean([run.fz_N[:n] for run in study.data.free], axis=0))


def _averaged(study: Study) -> str:
    """Figure 9."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        t_s, force_N = _average(study)
        axes.plot(*_thin(t_s, force_N), color=BLUE, linewidth=0.6)
        axes.axhline(0.0, color=GREY, linewidth=0.7)
        _style(axes, "time (s)", "mean Fz (N)")

    return _picture(draw)


def _motion(study: Study) -> str:
    """Figure 10."""

    def draw(figure: Figure) -> None:
        top, bottom = figure.subplots(2, 1, sharex=True)
        run = study.data.free[0]
        shown = run.t_s < run.t_s[0] + 26.0
        seen = features(run.robot_t_s, run.robot_vz_m_per_s, run.t_s)[shown]
        t_s = run.t_s[shown]
        top.plot(*_thin(t_s, (run.z_m[shown] - run.z_m[0]) * 1e3), color=BLACK)
        _style(top, "", "distance (mm)")
        bottom.plot(*_thin(t_s, seen[:, 0] * 1e3), color=RED, label="speed (mm/s)")
        _style(bottom, "time (s), the first three cycles", "speed (mm/s)")
        other = bottom.twinx()
        other.plot(*_thin(t_s, seen[:, 1]), color=BLUE, linewidth=0.8)
        other.set_ylabel("acceleration (m/s²)", color=BLUE)

    return _picture(draw, height=4.0)


def _palpation(each: Judged, method: str) -> str:
    """Figures 12 to 15: the whole series, and its second press alone, where the correction can be seen."""

    def draw(figure: Figure) -> None:
        whole, one = figure.subplots(1, 2, width_ratios=(3, 1))
        run = each.palpated.dynamic
        at_s = [peak.t_s for peak in each.peaks]
        shown_s = at_s[min(1, len(at_s) - 1)]
        near = np.abs(run.t_s - shown_s) < ZOOM_S
        for axes, chosen in ((whole, np.ones(len(run.t_s), bool)), (one, near)):
            for name, colour, label in ((NONE, BLUE, "original"), (method, BLACK, f"corrected by {method}")):
                axes.plot(*_thin(run.t_s[chosen], each.corrected_N[name][chosen]), color=colour, linewidth=0.7, label=label)
                axes.plot(at_s, [peak.force_N[name] for peak in each.peaks], "o", mfc="none", color=RED, markersize=5)
            axes.axhline(0.0, color=GREY, linewidth=0.7)
        _style(whole, "time (s)", "Fz (N)", TITLES.get(each.palpated.name, each.palpated.name))
        _style(one, "time (s), one press", "")
        one.set_xlim(shown_s - ZOOM_S, shown_s + ZOOM_S)
        _legend_above(whole)

    return _picture(draw, height=2.7)


def _moduli(study: Study) -> str:
    """Figures 16 to 19."""

    def draw(figure: Figure) -> None:
        grid = figure.subplots(1, len(study.setups), squeeze=False)[0]
        for axes, each in zip(grid, study.setups, strict=True):
            count = range(1, len(each.peaks) + 1)
            for name, colour, label in ((NONE, BLUE, "original"), (NETWORK, BLACK, "network")):
                axes.plot(count, [p.youngs_modulus_Pa[name] / 1e3 for p in each.peaks], "o-", color=colour, markersize=3, label=label)
            axes.axhline(each.static_Pa / 1e3, color=GREY, linestyle="--", label="static")
            published = paper.averages(each.palpated.name) if each.palpated.name in paper.SETUPS else None
            if published is not None:
                axes.axhline(published.original_Pa / 1e3, color=BLUE, linewidth=0.7, linestyle=":", label="published means")
                axes.axhline(published.corrected_Pa / 1e3, color=BLACK, linewidth=0.7, linestyle=":")
            _style(axes, "palpation", "E (kPa)" if each is study.setups[0] else "", TITLES.get(each.palpated.name, each.palpated.name))
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        grid[0].legend(fontsize=7)

    return _picture(draw, height=3.2)


def _by_method(study: Study) -> str:
    """YMBT of every method, days as points."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        days = _days(study)
        found = means(study)
        colours = {ENRICHED: RED, TRUTH: BLACK}
        for row, (name, (mean, _, _)) in enumerate(found.items()):
            values = [100.0 * float(np.mean([setup[name] for setup in day.values()])) for day in days]
            axes.plot(values, np.full(len(values), row) + np.linspace(-0.2, 0.2, len(values)), ".", color=GREY)
            axes.plot([100.0 * mean], [row], "D", color=colours.get(name, BLUE))
            axes.annotate(f"{100.0 * mean:.1f} %", (100.0 * mean, row), xytext=(0, 9), textcoords="offset points", ha="center", fontsize=8)
        if study.data.simulated:
            axes.axvline(100.0 * PUBLISHED, color=BLACK, linestyle=":", linewidth=0.9)
            label = f"published, corrected: {100.0 * PUBLISHED:.1f} %"
            axes.annotate(label, (100.0 * PUBLISHED, -0.75), fontsize=8, ha="left", xytext=(4, 0), textcoords="offset points")
        axes.set_yticks(range(len(found)), [name.replace(" (", "\n(") for name in found])
        axes.set_ylim(len(found) - 0.4, -1.0)
        axes.set_xlim(left=-0.8)
        _style(axes, "YMBT, mean over the setups of a day (%)", "")

    return _picture(draw, height=3.9)


def _map(study: Study) -> str | None:
    """The map of a field."""
    return None if study.mapped is None else _encoded(figure_of(*study.mapped))


# page


def html(study: Study) -> str:
    """The page."""
    first = {each.palpated.name: each for each in study.setups}
    known = [name for name in first if name in paper.SETUPS]
    misses, achieved = paper.table_1_misses()
    count, away_N = paper.count_N()
    source = files("palpd").joinpath(TEMPLATE).read_text(encoding="utf-8")
    return (
        jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
        .from_string(source)
        .render(
            study=study,
            setups=study.setups,
            known=known,
            titles=TITLES,
            published={name: paper.averages(name) for name in known},
            table1={name: list(zip(*paper.static(name), strict=True)) for name in known},
            named=NAMED,
            methods=[name for name in (*METHODS, TRUTH, ENRICHED) if all(name in each.ymbt for each in study.setups)],
            means=means(study),
            away=away_from_truth(study),
            inclusions=_inclusions(study),
            raster=len(raster(study.mapped[0].field_)) if study.mapped is not None else 0,
            names={"none": NONE, "network": NETWORK, "winner": WINNER, "truth": TRUTH, "enriched": ENRICHED},
            mean_free={"bare": _mean_force(study.data.bare), "probe": _mean_force(study.data.free)},
            paper={
                "mean_free": paper.MEAN_FREE_N,
                "misses": (100.0 * misses.min(), 100.0 * misses.max(), 100.0 * np.abs(achieved).max()),
                "count_mN": 1e3 * count.value,
                "away_mN": 1e3 * away_N,
                "correction": paper.correction_Pa().text(1e-3, 2),
                "depth": paper.depth_of_peaks_m().text(1e3, 2),
                "inertia_mN": 1e3 * paper.largest_inertia_N(),
                "exponent": {name: paper.exponent(name).text() for name in paper.SETUPS},
                "offset": {name: paper.surface_offset_m(name).text(1e3, 2) for name in paper.SETUPS},
                "rate": {name: paper.rate_excess(name).text(100.0, 0) for name in paper.SETUPS},
            },
            figures={
                "7": _free_forces(study),
                "8": _ten(study),
                "9": _averaged(study),
                "10": _motion(study),
                "palpations": [_palpation(each, NETWORK) for each in study.setups],
                "moduli": _moduli(study),
                "methods": _by_method(study),
                "map": _map(study),
            },
        )
    )


def _inclusions(study: Study) -> list[tuple[str, Inclusion | None, Inclusion | None]]:
    """Of each setup what the published holds and those made here say of an inclusion."""
    rows = []
    for each in study.setups:
        name, published = each.palpated.name, None
        if name in paper.SETUPS:
            holds = [Hold(*row) for row in zip(*paper.static(name), strict=True)]
            published = inclusion_below(holds, force_sigma_N=paper.count_N()[0].value / math.sqrt(12.0))
        rows.append((name, published, each.inclusion))
    return rows
