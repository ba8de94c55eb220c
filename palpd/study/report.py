"""The study as one self-contained page: tables and figures of Guo, Xiao, Ren 2019 beside those of this system."""

import math
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup
from matplotlib.ticker import MaxNLocator

from palpd.analysis.figure_style import BLUE, GREY, INK, ORANGE, RED, inline_svg, styled_figure, thinned
from palpd.analysis.inclusion import Inclusion
from palpd.analysis.intervals import mean_half_width_95
from palpd.analysis.stiffness_map import figure_of, raster
from palpd.files import write_json, write_text
from palpd.study import published as paper
from palpd.study.evaluation import ENRICHED, METHODS, NAMED, NETWORK, NONE, TRUTH, WINNER, Hold, Judged, Study, inclusion_below
from palpd.study.laboratory import Take
from palpd.study.methods import features
from palpd.tick import Floats

TITLES = {"A": "A: no inclusion", "B": "B: inclusion 5 mm", "C": "C: inclusion 8 mm", "D": "D: inclusion 10 mm"}
TEMPLATE = "report.html.j2"
PUBLISHED_YMBT = float(np.mean([paper.averages(name).ymbt_corrected for name in paper.SETUPS]))
"""Mean over the setups of Table 3's corrected YMBT."""
SMOOTH_S = 0.5
"""Moving mean over the force of free motion: longer than the noise, shorter than a stroke."""
ZOOM_S = 0.9
"""Half of the time shown around one press: a press and its approach."""
MOTION_S = 26.0
"""The first three cycles of free motion."""


def write(study: Study, folder: Path) -> tuple[Path, Path]:
    """Write study.html and study.json into a folder.

    Args:
        study: what was measured and judged.
        folder: where they go; it is created.

    Returns:
        The paths of both.
    """
    folder.mkdir(parents=True, exist_ok=True)
    page, numbers = folder / "study.html", folder / "study.json"
    write_text(page, html(study))
    write_json(numbers, figures_of(study))
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
    """Difference between the YMBT of each method and that of the true contact force, rms over setups and days.

    It is a ratio like YMBT itself. Only the error of the compensation enters: neither the tissue, nor depths, nor the static mean.
    """
    of_setups = [setup for day in _days(study) for setup in day.values() if TRUTH in setup]
    names = [name for name in METHODS if of_setups and all(name in setup for setup in of_setups)]
    return {name: float(np.sqrt(np.mean([(setup[name] - setup[TRUTH]) ** 2 for setup in of_setups]))) for name in names}


def _days(study: Study) -> list[dict[str, dict[str, float]]]:
    return [{each.palpated.name: each.ymbt for each in study.setups}, *study.days]


def means(study: Study) -> dict[str, tuple[float, float, int]]:
    """YMBT by method, averaged over the setups of a day and then over days: mean, half of the 95 % interval, number of days."""
    days = _days(study)
    averages = {}
    for name in (*METHODS, TRUTH, ENRICHED):
        values = np.array([np.mean([setup[name] for setup in day.values()]) for day in days if all(name in s for s in day.values())])
        if len(values):
            half = mean_half_width_95(values) if len(values) > 1 else math.nan
            averages[name] = (float(values.mean()), half, len(values))
    return averages


def _mean_force(takes: list[Any]) -> float | None:
    return float(np.mean([run.fz_N.mean() for run in takes])) if takes else None


# figures


def _smooth(run: Take) -> Floats:
    """Moving mean of fz over `SMOOTH_S`."""
    width = max(1, round(SMOOTH_S / float(np.median(np.diff(run.t_s)))))
    summed = np.convolve(run.fz_N, np.ones(width), mode="same")
    return np.asarray(summed / np.convolve(np.ones(len(run.t_s)), np.ones(width), mode="same"))


def _free_forces(study: Study) -> Markup:
    """Figure 7."""
    with styled_figure() as figure:
        axes = figure.subplots()
        for runs, colour, name in ((study.data.bare[:1], ORANGE, "without the probe"), (study.data.free[:1], BLUE, "with the probe")):
            for run in runs:
                axes.plot(*thinned(run.t_s, run.fz_N), color=colour, linewidth=0.4, alpha=0.3)
                axes.plot(*thinned(run.t_s, _smooth(run)), color=colour, label=f"{name}, mean {run.fz_N.mean():+.3f} N")
        axes.axhline(0.0, color=GREY, linewidth=0.7)
        axes.set(xlabel="time (s)", ylabel="fz (N)")
        figure.legend(loc="outside upper right", ncols=2)
    return inline_svg(figure, "free")


def _repeats(study: Study) -> Markup:
    """Figure 8."""
    count = min(len(study.data.free), 10)
    columns = math.ceil(count / 2)
    with styled_figure(10.0, 4.0) as figure:
        grid = figure.subplots(2, columns, sharex=True, sharey=True, squeeze=False)
        for number, (axes, run) in enumerate(zip(grid.flat, study.data.free, strict=False), start=1):
            axes.plot(*thinned(run.t_s, run.fz_N), color=BLUE, linewidth=0.4)
            axes.axhline(0.0, color=INK, linewidth=0.6)
            axes.set(
                title=f"run {number}", xlabel="time (s)" if number > columns else "", ylabel="fz (N)" if (number - 1) % columns == 0 else ""
            )
    return inline_svg(figure, "repeats")


def _averaged(study: Study) -> Markup:
    """Figure 9."""
    shortest = min(study.data.free, key=lambda run: len(run.t_s))
    mean_N = np.mean([run.fz_N[: len(shortest.t_s)] for run in study.data.free], axis=0)
    with styled_figure() as figure:
        axes = figure.subplots()
        axes.plot(*thinned(shortest.t_s, mean_N), color=BLUE, linewidth=0.6)
        axes.axhline(0.0, color=GREY, linewidth=0.7)
        axes.set(xlabel="time (s)", ylabel="mean fz (N)")
    return inline_svg(figure, "averaged")


def _motion(study: Study) -> Markup:
    """Figure 10."""
    run = study.data.free[0]
    shown = run.t_s < run.t_s[0] + MOTION_S
    t_s = run.t_s[shown]
    speed_m_per_s, acceleration_m_per_s2 = features(run.robot_t_s, run.robot_vz_m_per_s, run.t_s)[shown, :2].T
    with styled_figure(10.0, 4.6) as figure:
        panels = figure.subplots(3, 1, sharex=True)
        for axes, values, label, colour in (
            (panels[0], (run.z_m[shown] - run.z_m[0]) * 1e3, "distance (mm)", INK),
            (panels[1], speed_m_per_s * 1e3, "speed (mm/s)", ORANGE),
            (panels[2], acceleration_m_per_s2, "acceleration (m/s²)", BLUE),
        ):
            axes.plot(*thinned(t_s, values), color=colour)
            axes.set(ylabel=label)
        panels[2].set(xlabel="time (s), the first three cycles")
        figure.align_ylabels()
    return inline_svg(figure, "motion")


def _palpation(each: Judged, method: str) -> Markup:
    """Figures 12 to 15: the whole series, and its second press alone, where the correction can be seen."""
    run, name = each.palpated.dynamic, each.palpated.name
    peaks_s = [peak.t_s for peak in each.peaks]
    shown_s = peaks_s[min(1, len(peaks_s) - 1)]
    near = np.abs(run.t_s - shown_s) < ZOOM_S
    with styled_figure(10.0, 2.8) as figure:
        whole, one = figure.subplots(1, 2, width_ratios=(3, 1))
        for axes, chosen in ((whole, np.ones(len(run.t_s), bool)), (one, near)):
            for correction, colour, label in ((NONE, BLUE, "original"), (method, ORANGE, f"corrected by {method}")):
                label = label if axes is whole else "_"
                axes.plot(*thinned(run.t_s[chosen], each.corrected_N[correction][chosen]), color=colour, linewidth=0.8, label=label)
                axes.plot(peaks_s, [peak.force_N[correction] for peak in each.peaks], "o", mfc="none", color=RED, markersize=5)
            axes.axhline(0.0, color=GREY, linewidth=0.7)
        whole.set(xlabel="time (s)", ylabel="fz (N)", title=TITLES.get(name, name))
        one.set(xlabel="time (s), one press", xlim=(shown_s - ZOOM_S, shown_s + ZOOM_S))
        figure.legend(loc="outside upper right", ncols=2)
    return inline_svg(figure, f"palpation-{name}")


def _moduli(study: Study) -> Markup:
    """Figures 16 to 19."""
    with styled_figure(10.0, 3.4) as figure:
        grid = figure.subplots(1, len(study.setups), squeeze=False)[0]
        for axes, each in zip(grid, study.setups, strict=True):
            name, count = each.palpated.name, range(1, len(each.peaks) + 1)
            for correction, colour, label in ((NONE, BLUE, "original"), (NETWORK, ORANGE, "network")):
                axes.plot(count, [p.youngs_modulus_Pa[correction] / 1e3 for p in each.peaks], "o-", color=colour, markersize=3, label=label)
            axes.axhline(each.static_Pa / 1e3, color=GREY, linestyle="--", label="static")
            if name in paper.SETUPS:
                published = paper.averages(name)
                for mean_Pa, colour, label in ((published.original_Pa, BLUE, "original"), (published.corrected_Pa, ORANGE, "corrected")):
                    axes.axhline(mean_Pa / 1e3, color=colour, linewidth=0.8, linestyle=":", label=f"published mean, {label}")
            axes.set(xlabel="palpation", ylabel="E (kPa)" if each is study.setups[0] else "", title=TITLES.get(name, name))
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        figure.legend(*grid[0].get_legend_handles_labels(), loc="outside upper right", ncols=5)
    return inline_svg(figure, "moduli")


def _by_method(study: Study) -> Markup:
    """YMBT of every method, days as points."""
    days, average = _days(study), means(study)
    colours = {ENRICHED: RED, TRUTH: INK}
    with styled_figure(10.0, 3.9) as figure:
        axes = figure.subplots()
        for row, (name, (mean, _, _)) in enumerate(average.items()):
            values = [100.0 * float(np.mean([setup[name] for setup in day.values()])) for day in days]
            axes.plot(values, np.full(len(values), row) + np.linspace(-0.2, 0.2, len(values)), ".", color=GREY)
            axes.plot([100.0 * mean], [row], "D", color=colours.get(name, BLUE))
            axes.annotate(f"{100.0 * mean:.1f} %", (100.0 * mean, row), xytext=(0, 9), textcoords="offset points", ha="center")
        if study.data.simulated:
            axes.axvline(100.0 * PUBLISHED_YMBT, color=INK, linestyle=":", linewidth=0.9)
            label = f"published, corrected: {100.0 * PUBLISHED_YMBT:.1f} %"
            axes.annotate(label, (100.0 * PUBLISHED_YMBT, -0.75), xytext=(4, 0), textcoords="offset points")
        axes.set_yticks(range(len(average)), [name.replace(" (", "\n(") for name in average])
        axes.set(xlabel="YMBT, mean over the setups of a day (%)", ylim=(len(average) - 0.4, -1.0))
        axes.set_xlim(left=-0.8)
    return inline_svg(figure, "methods")


# page


def html(study: Study) -> str:
    """The page."""
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string(files("palpd.study").joinpath(TEMPLATE).read_text(encoding="utf-8"))
    known = [each.palpated.name for each in study.setups if each.palpated.name in paper.SETUPS]
    return template.render(
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
        paper=_published(),
        figures={
            "7": _free_forces(study),
            "8": _repeats(study),
            "9": _averaged(study),
            "10": _motion(study),
            "palpations": [_palpation(each, NETWORK) for each in study.setups],
            "moduli": _moduli(study),
            "methods": _by_method(study),
            "map": None if study.mapped is None else inline_svg(figure_of(*study.mapped), "map"),
        },
    )


def _published() -> dict[str, Any]:
    """What the published numbers say by themselves."""
    misses, achieved = paper.table_1_misses()
    count, away_N = paper.count_N()
    return {
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
    }


def _inclusions(study: Study) -> list[tuple[str, Inclusion | None, Inclusion | None]]:
    """Name of each setup, and the inclusion that its published holds and the holds made here show."""
    rows = []
    for each in study.setups:
        name, published = each.palpated.name, None
        if name in paper.SETUPS:
            holds = [Hold(*row) for row in zip(*paper.static(name), strict=True)]
            published = inclusion_below(holds, force_sigma_N=paper.count_N()[0].value / math.sqrt(12.0))
        rows.append((name, published, each.inclusion))
    return rows
