"""The figures of a run. Each draws into a figure that it is given, so that a page and a printed sheet show the same."""

import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import NullLocator

from palpd.analysis.figure_style import BLUE, GREY, INK, ORANGE, RED, thinned
from palpd.analysis.results import SiteResult, Track, peak_width, track
from palpd.analysis.young import modulus_peak_Pa
from palpd.history.catalogue import SiteModuli
from palpd.history.stored import printable
from palpd.history.trend import SECONDS_A_DAY, ModulusPoint
from palpd.quantities import number
from palpd.recording.header import RecordedTrip
from palpd.recording.reader import Recording
from palpd.tick import Floats, Mode, Phase

Drawing = Figure | SubFigure
STATIC, DYNAMIC, OTHER = BLUE, ORANGE, GREY
"""Colours of holds, of presses that leave at once, and of the run beside."""
MOST_REPEATS = 3
"""Presses to one depth that are drawn: more lie on top of each other."""
POINTS_A_PRESS = 60
"""Points of a curve of force over depth: as many as its axes have millimetres on a page."""
TRENDS: tuple[tuple[Callable[[SiteModuli], float | None], Callable[[SiteModuli], tuple[float, float] | None], str, str], ...] = (
    (lambda of: of.static_Pa, lambda of: of.static_ci95_Pa, STATIC, "static"),
    (lambda of: of.corrected_Pa, lambda of: of.corrected_ci95_Pa, DYNAMIC, "dynamic, corrected"),
)
"""What a trend draws: value, interval, colour and name."""
ABOVE_M = 0.001
"""Height above the surface at which a curve begins."""
SITES_A_ROW = 4
MOST_LETTERS = 24
"""Longest name of a site in a figure."""
MOST_SITES = 12
"""Sites whose curves are drawn; the table has all."""
TINT_ALPHA = 0.1


@dataclass(frozen=True, slots=True)
class PressCurve:
    """Force over depth on the way down: arrays (n,), in N and m, smoothed as a peak is."""

    mode: Mode
    depth_m: Floats
    force_N: Floats


def press_curves(recording: Recording) -> list[list[PressCurve]]:
    """The presses of every site: the force is corrected by the inertial model and counted from the rest before the press.

    Args:
        recording: Recording of a palpation.

    Returns:
        The curves by site, in the order of the plan.
    """
    body = recording.header["body"]
    whole = track(recording.rows, body["delay_s"], body["machine_stiffness_N_per_m"] or math.inf)
    return [list(_curves(whole.where(whole.site == index))) for index in range(len(recording.header["sites"]))]


def _curves(of_site: Track) -> Iterator[PressCurve]:
    for mode in (Mode.STATIC, Mode.DYNAMIC):
        of_mode = of_site.where((of_site.mode == mode) & np.isfinite(of_site.depth_m))
        for depth_m in np.unique(of_mode.depth_m):
            of_depth = of_mode.where(of_mode.depth_m == depth_m)
            for repeat in np.unique(of_depth.repeat)[:MOST_REPEATS]:
                press = of_depth.where(of_depth.repeat == repeat)
                rest, way = press.where(press.phase == Phase.BASELINE), press.where(press.phase == Phase.PRESS)
                if len(rest.t_s) and len(way.t_s) > 2:
                    yield _curve(mode, way, float((rest.fz_N - rest.inertial_N).mean()))


def _curve(mode: Mode, way: Track, rest_N: float) -> PressCurve:
    width = peak_width(way.t_s)
    window = np.ones(width) / width
    depth_m, force_N = way.surface_z_m - way.tip_z_m, way.fz_N - way.inertial_N - rest_N
    if len(depth_m) > width:
        depth_m, force_N = np.convolve(depth_m, window, "valid"), np.convolve(force_N, window, "valid")
    deepest = int(np.argmax(depth_m)) + 1  # a hold creeps and settles at its depth: the curve ends where it is reached
    from_surface = np.flatnonzero(depth_m[:deepest] > -ABOVE_M)
    begin = int(from_surface[0]) if len(from_surface) else 0
    kept = np.unique(np.linspace(begin, deepest - 1, min(POINTS_A_PRESS, deepest - begin)).astype(int))
    return PressCurve(mode, depth_m[kept], force_N[kept])


@contextmanager
def any_text() -> Iterator[None]:
    """Names of sites come from files: a letter that the font has not is drawn as a box, without a warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        yield


def is_pressed(site: SiteResult) -> bool:
    """Whether anything was pressed at a site."""
    return bool(site["depths"] or site["presses"])


def draw_forces(figure: Drawing, recording: Recording, sites: Sequence[SiteResult], beside: Recording | None = None) -> None:
    """Force over depth, site by site: holds, presses, Hertz at the static modulus, and the same of a run beside.

    Args:
        figure: Where it is drawn.
        recording: Recording of a palpation.
        beside: Another recording; its presses are drawn at the sites with the same names. None: only the first.
    """
    curves, tip = press_curves(recording), recording.header["body"]
    others = {} if beside is None else dict(zip((site["name"] for site in beside.header["sites"]), press_curves(beside), strict=True))
    shown = [each for each in zip(sites, curves, strict=True) if is_pressed(each[0])][:MOST_SITES]
    grid = _grid(figure, [site["name"] for site, _ in shown], "depth (mm)", "force (N)", sharey=True)
    for axes, (site, presses) in zip(grid, shown, strict=True):
        for other in others.get(site["name"], []):
            axes.plot(other.depth_m * 1e3, other.force_N, color=OTHER, linewidth=1.0, alpha=0.8, label="run beside")
        for press in presses:
            static = press.mode == Mode.STATIC
            colour, label = (STATIC, "static") if static else (DYNAMIC, "dynamic, corrected")
            axes.plot(press.depth_m * 1e3, press.force_N, color=colour, linewidth=1.0, alpha=0.8, label=label)
        held = [(hold["achieved_m"], hold["force_N"]) for hold in site["depths"] if hold["force_N"] is not None and hold["achieved_m"]]
        if held:
            depths_m, forces_N = np.array(held, float).T
            axes.plot(depths_m * 1e3, forces_N, "o", color=INK, markersize=4, label="mean of a hold")
        if static_Pa := site["static_youngs_modulus_Pa"]:
            deepest_m = max([float(press.depth_m.max()) for press in presses] + [hold[0] for hold in held if hold[0]], default=0.0)
            depth_m = np.linspace(0.0, max(deepest_m, 1e-6), 40)[1:]
            per_N = np.array([modulus_peak_Pa(1.0, depth, tip["tip_radius_m"], tip["poisson_ratio"]) for depth in depth_m])
            axes.plot(depth_m * 1e3, static_Pa / per_N, "--", color=INK, linewidth=0.9, label="Hertz, static modulus")
    _legend(figure, grid)


def draw_map(figure: Drawing, places_m: Floats, sites: Sequence[SiteResult]) -> None:
    """Where the sites lie and how stiff each is: a stiffness map.

    Args:
        places_m: Their places (n, 2) along the base's axes.
        sites: Their results (n).
    """
    axes = figure.subplots()
    moduli_Pa = [each["static_youngs_modulus_Pa"] or each["dynamic_corrected_Pa"] for each in sites]
    known = [k for k, modulus_Pa in enumerate(moduli_Pa) if modulus_Pa is not None]
    x_mm, y_mm = 1e3 * places_m[known].T
    stiffness_kPa = np.array([moduli_Pa[k] for k in known], float) / 1e3
    dots = axes.scatter(x_mm, y_mm, c=stiffness_kPa, s=220, cmap="viridis", edgecolors=INK, linewidths=0.7)
    for k, x, y, stiffness in zip(known, x_mm, y_mm, stiffness_kPa, strict=True):
        words = f"{_label(sites[k]['name'])}\n{number(stiffness)}"
        axes.annotate(words, (x, y), (0, 11), textcoords="offset points", ha="center", va="bottom", fontsize=8.5)
    axes.set(xlabel="x (mm)", ylabel="y (mm)")
    axes.margins(0.2, 0.4)
    axes.set_aspect("equal", adjustable="datalim")
    figure.colorbar(dots, ax=axes, label="E (kPa)", fraction=0.05)


def _bars(values_kPa: Sequence[float], intervals_Pa: Sequence[Sequence[float] | None]) -> Floats:
    """Lengths (2, n) of the bars below and above values, zero where there is no interval."""
    ends = [(value, value) if ci is None else (ci[0] / 1e3, ci[1] / 1e3) for value, ci in zip(values_kPa, intervals_Pa, strict=True)]
    low, high = np.array(ends).reshape(-1, 2).T
    return np.maximum([values_kPa - low, high - values_kPa], 0.0)


def draw_course(figure: Drawing, recording: Recording, trips: Sequence[RecordedTrip]) -> None:
    """Contact force and height of the tip over the run, with the sites and the contact limit.

    Args:
        figure: Where it is drawn.
        trips: What stopped it.
    """
    rows = recording.rows
    t_s = rows["now_s"] - rows["now_s"][0]
    above, below = figure.subplots(2, 1, sharex=True)
    above.plot(*thinned(t_s, rows["force_N"]), color=INK, linewidth=0.9)
    limit_N = float(recording.header["config"]["safety"]["contact_limit_N"])
    if float(np.nanmax(rows["force_N"])) > 0.5 * limit_N:
        above.axhline(limit_N, color=RED, linewidth=0.9, linestyle="--", label="contact limit")
    height_m = rows["tcp_pose"][:, 2]
    below.plot(*thinned(t_s, height_m * 1e3), color=INK, linewidth=0.9)
    above.set(ylabel="force (N)", xlim=(0.0, max(float(t_s[-1]), 1e-3)))
    below.set(ylabel="height (mm)", xlabel="time (s)")
    for axes in (above, below):
        if trips:
            axes.axvline(float(t_s[-1]), color=RED, linewidth=1.2, label="stopped" if axes is above else None)
    edges = [0, *(np.flatnonzero(np.diff(rows["site"])) + 1).tolist(), len(rows)]
    for count, (begin, end) in enumerate(pairwise(edges)):
        site = int(rows["site"][begin])
        if site < 0:
            continue
        span = (float(t_s[begin]), float(t_s[min(end, len(t_s) - 1)]))
        for axes in (above, below):
            axes.axvspan(*span, color=(BLUE, ORANGE)[count % 2], alpha=TINT_ALPHA, linewidth=0)
        if len(edges) <= MOST_SITES + 3:
            above.annotate(
                _label(recording.site_name(site)), ((span[0] + span[1]) / 2, 1.0), xycoords=("data", "axes fraction"), xytext=(0, 3),
                textcoords="offset points", ha="center", fontsize=8.5, annotation_clip=False,
            )  # fmt: skip
    _legend(figure, [above])


def draw_loop(figure: Drawing, recording: Recording) -> None:
    """How the loop kept its time: how often a tick took how long, and the worst of every stretch of the run.

    Args:
        figure: Where it is drawn.
    """
    ticking = recording.rows["phase"] != Phase.IDLE
    now_s, planned_s, work_us, missed = (recording.rows[name][ticking] for name in ("now_s", "planned_s", "work_us", "missed"))
    left, right = figure.subplots(1, 2, width_ratios=(2, 3))
    if len(now_s) < 2:
        for axes in (left, right):
            axes.set_visible(False)
        return
    late_us, work_us = np.maximum((now_s - planned_s) * 1e6, 1.0), np.maximum(work_us[1:].astype(float), 1.0)
    highest = float(np.nanmax([late_us.max(), work_us.max(), 100.0]))
    highest = highest if math.isfinite(highest) else 1e6
    lowest = min(max(1.0, 0.8 * float(np.percentile(late_us, 1))), 0.5 * highest)
    bins = np.geomspace(lowest, highest, 60)
    for values, colour, label in ((work_us, BLUE, "work of a tick"), (late_us, ORANGE, "woke up late by")):
        left.hist(values, bins=bins.tolist(), color=colour, alpha=0.65, label=label, histtype="stepfilled")
    left.set(xscale="log", yscale="log", xlabel="time (µs)", ylabel="ticks", xlim=(lowest, highest))
    t_s = now_s - now_s[0]
    begins = np.unique(np.linspace(0, len(t_s) - 1, min(200, len(t_s))).astype(int))
    for values, colour in ((np.append(work_us, work_us[-1]), BLUE), (late_us, ORANGE)):
        right.plot(t_s[begins], np.maximum.reduceat(values, begins), color=colour, linewidth=1.0)
    after = missed > 0
    if after.any():
        right.plot(t_s[after], late_us[after], "v", color=RED, markersize=5, label="ticks missed before")
    right.set(yscale="log", xlabel="time (s)", ylabel="largest of a stretch (µs)")
    for axis in (left.xaxis, left.yaxis, right.yaxis):
        axis.set_major_formatter("{x:g}")  # powers of ten as formulas, and their minor ticks, took a third of the time that a page takes
        axis.set_minor_locator(NullLocator())
    _legend(figure, [left, right])


def draw_trend(figure: Drawing, points: Mapping[str, Sequence[ModulusPoint]], began_s: float) -> None:
    """Moduli of sites over the days, with their intervals.

    Args:
        figure: Where it is drawn.
        points: The points of each site, oldest first.
        began_s: When the run that the page is about began: its points are circled.
    """
    sites = dict(list(points.items())[:MOST_SITES])
    grid = _grid(figure, list(sites), "days since the first", "E (kPa)", sharey=False)
    day_0_s = min(point.run.started_s for of_site in sites.values() for point in of_site)
    for axes, of_site in zip(grid, sites.values(), strict=True):
        for value, interval, colour, label in TRENDS:
            known = [(point, modulus_Pa) for point in of_site if (modulus_Pa := value(point.moduli)) is not None]
            days = np.array([(point.run.started_s - day_0_s) / SECONDS_A_DAY for point, _ in known])
            values = np.array([modulus_Pa / 1e3 for _, modulus_Pa in known])
            bars = _bars(values.tolist(), [interval(point.moduli) for point, _ in known])
            axes.errorbar(days, values, bars, fmt="o-", color=colour, markersize=3.5, linewidth=0.8, capsize=2, label=label)
            mine = np.array([point.run.started_s == began_s for point, _ in known], bool)
            axes.plot(days[mine], values[mine], "o", markerfacecolor="none", markeredgecolor=INK, markersize=9)
    _legend(figure, grid)


def _grid(figure: Drawing, sites: Sequence[str], xlabel: str, ylabel: str, *, sharey: bool) -> list[Axes]:
    """Axes for each site, four in a row; the left ones are labelled, and the lowest of each column."""
    rows = -(-len(sites) // SITES_A_ROW)
    grid = figure.subplots(rows, min(SITES_A_ROW, len(sites)), sharex=True, sharey=sharey, squeeze=False)
    shown: list[Axes] = list(grid.flat[: len(sites)])
    for axes in grid.flat[len(sites) :]:
        axes.set_visible(False)
    for axes, site in zip(shown, sites, strict=True):
        axes.set_title(_label(site))
    for axes in grid[:, 0]:
        axes.set_ylabel(ylabel)
    for axes in shown[-grid.shape[1] :]:
        axes.set_xlabel(xlabel)
        axes.xaxis.set_tick_params(labelbottom=True)
    return shown


def _legend(figure: Drawing, all_axes: Iterable[Axes]) -> None:
    """One legend above the figure, each label once."""
    handles: dict[str, Artist] = {}
    for axes in all_axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    if handles:
        figure.legend(list(handles.values()), list(handles), loc="outside upper left", ncols=6)


def _label(name: object) -> str:
    """The name of a site as a text of a figure, in which a dollar would begin a formula."""
    text = printable(str(name)).replace("$", r"\$")
    return text if len(text) <= MOST_LETTERS else f"{text[:MOST_LETTERS]}…"
