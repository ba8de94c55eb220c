"""A stiffness map of a field from few presses: where to press next, when to stop, where a hard place lies.

The logarithm of the stiffness is a Gaussian process over the field (scikit-learn). Its mean is a constant background, the mean of the
soft presses. Its bumps are as wide as tip and inclusion make them. The next press goes where a hard place is likeliest. Before any press
that is equal everywhere, so the field is first covered as coarsely as an inclusion of the stated size allows. The search stops when a
hard place is certain and located by presses around it, or when none is likely anywhere.
"""

import csv
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from scipy.stats import norm
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from palpd.analysis.figure_style import RED, save_figure, styled_figure
from palpd.analysis.young import modulus_hertz_Pa
from palpd.cell.cell_file import SensorBlock
from palpd.cell.plausible import ask
from palpd.errors import BadInput
from palpd.files import opened_text, write_text
from palpd.quantities import quantity
from palpd.recording.samples import LARGEST
from palpd.recording.tables import cells_of, is_comment, read_layout, with_points
from palpd.tick import Floats

BUMP_SIGMA = 0.3
"""One sigma of the logarithm of stiffness over a field before any press."""
NOISE_SIGMA = 0.02
"""One sigma of a press, relative: scatter of stiffness, surface and force."""
HARD = math.log(1.2)
"""Log ratio to the background above which a place is hard."""
CERTAIN = 0.95
"""Probability above which a place counts as hard."""
UNLIKELY = 0.21
"""Probability below which no place is worth a press; before any press it is 27 % everywhere."""
GRID_M = 0.002
"""Spacing of the map: a fifth of the smallest inclusion of the paper's phantom."""
RASTER_M = 0.005
"""Distance between neighbours of a raster, which a survey is compared with."""
MODULUS_COLUMNS = {"youngs_modulus_Pa": 1.0, "youngs_modulus_kPa": 1e3, "youngs_modulus_MPa": 1e6}
"""Names of the column of the modulus, and the factor of each unit to Pa."""
SUSPICIOUS = 0.35
"""Probability above which a place is followed up before others are visited; before any press it is 27 %."""
APART_M = 0.003
"""Least distance from earlier presses: a nearer press measures only the scatter of the first."""
LOCATING_PRESSES = 4
"""Number of presses around a hard place; one more and the place counts as located."""
FIRST_PRESSES = 3
"""Number of presses before the search may stop: two say nothing of the background."""


@dataclass(frozen=True)
class Field:
    """The rectangle to be searched, in m from its own corner, and the smallest inclusion that must not be missed."""

    width_m: float = 0.06
    height_m: float = 0.06
    inclusion_m: float = 0.010
    tip_radius_m: float = 0.005
    depth_m: float = 0.005

    @property
    def length_m(self) -> float:
        """Width (one sigma) of a bump: half the inclusion and half the contact's radius √(r d)."""
        return 0.5 * (0.5 * self.inclusion_m + math.sqrt(self.tip_radius_m * self.depth_m))

    def grid(self) -> Floats:
        """Places that a press may go to, (n, 2)."""
        x, y = (np.arange(0.0, size + GRID_M / 2, GRID_M) for size in (self.width_m, self.height_m))
        return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


@dataclass(frozen=True)
class Map:
    """The map after some presses, over the places `grid` (n, 2) of the field.

    Attributes:
        grid: Places (n, 2) in m.
        mean: Mean (n,) of the log stiffness relative to the background.
        sigma: One sigma (n,) of the same.
        hard_probability: Probability (n,) of a hard place.
        background_Pa: Modulus of the soft part.
        next_m: Where to press next.
        done: Whether to stop.
        found_m: Where a hard place is certain, or None.
        sentence: The state of the search in words.
    """

    grid: Floats
    mean: Floats
    sigma: Floats
    hard_probability: Floats
    background_Pa: float
    next_m: tuple[float, float]
    done: bool
    found_m: tuple[float, float] | None
    sentence: str


@dataclass
class Survey:
    """Presses made so far on a field, and the map that follows from them."""

    field_: Field = field(default_factory=Field)
    places_m: list[tuple[float, float]] = field(default_factory=list)
    moduli_Pa: list[float] = field(default_factory=list)

    def add(self, place_m: tuple[float, float], modulus_Pa: float) -> None:
        """Add a press.

        Args:
            place_m: Where it was, from the corner of the field.

        Raises:
            BadInput: The place is outside the field, or the modulus is not above zero.
        """
        x_m, y_m = place_m
        if not (-1e-9 <= x_m <= self.field_.width_m + 1e-9 and -1e-9 <= y_m <= self.field_.height_m + 1e-9):
            raise BadInput(
                f"the press at ({x_m:g}, {y_m:g}) m lies outside the field of {self.field_.width_m:g} × {self.field_.height_m:g} m"
            )
        if not 0.0 < modulus_Pa <= LARGEST:
            raise BadInput(f"the press at ({x_m:g}, {y_m:g}) m has a modulus of {modulus_Pa:g} Pa; leave out presses that failed")
        self.places_m.append((x_m, y_m))
        self.moduli_Pa.append(modulus_Pa)

    def map(self) -> Map:
        """The map after the presses so far."""
        grid = self.field_.grid()
        if not self.places_m:
            start = (self.field_.width_m / 6.0, self.field_.height_m / 6.0)
            flat = np.zeros(len(grid))
            unknown = flat + norm.sf(HARD / BUMP_SIGMA)
            return Map(grid, flat, flat + BUMP_SIGMA, unknown, math.nan, start, False, None, "nothing was pressed yet")
        places, logs = np.array(self.places_m), np.log(self.moduli_Pa)
        background = _background(logs)
        kernel = ConstantKernel(BUMP_SIGMA**2, "fixed") * RBF(self.field_.length_m, "fixed") + WhiteKernel(NOISE_SIGMA**2, "fixed")
        process = GaussianProcessRegressor(kernel, optimizer=None).fit(places, logs - background)
        mean, with_noise = process.predict(grid, return_std=True)
        sigma = np.sqrt(np.maximum(with_noise**2 - NOISE_SIGMA**2, 1e-12))
        hard = norm.sf((HARD - mean) / sigma)
        done, hard_m, sentence = self._stop(grid, mean, hard, len(logs))
        next_m = self._next(grid, mean, sigma, hard, hard_m)
        return Map(grid, mean, sigma, hard, math.exp(background), next_m, done, hard_m, sentence)

    def _stop(self, grid: Floats, mean: Floats, hard: Floats, presses: int) -> tuple[bool, tuple[float, float] | None, str]:
        places = np.array(self.places_m)
        peak = grid[int(np.argmax(mean))]
        if float(hard.max()) >= CERTAIN and presses >= FIRST_PRESSES:
            near = int(np.sum(np.linalg.norm(places - peak, axis=1) <= 2.5 * self.field_.length_m))
            place = (float(peak[0]), float(peak[1]))
            at = f"({place[0] * 1e3:.0f}, {place[1] * 1e3:.0f}) mm"
            if near > LOCATING_PRESSES:
                return True, place, f"a hard place at {at}, located by {near} presses"
            return False, place, f"a hard place near {at}; presses around it: {near}"
        if presses >= FIRST_PRESSES and float(hard.max()) < UNLIKELY:
            return True, None, f"no place is likelier than {UNLIKELY:.0%} to be hard"
        return False, None, f"the likeliest place is hard with {hard.max():.0%}"

    def _next(self, grid: Floats, mean: Floats, sigma: Floats, hard: Floats, hard_m: tuple[float, float] | None) -> tuple[float, float]:
        """Around a hard place where it may be harder still; else where something hard is likeliest, of equals the nearest to the last.

        Never where a press was before: a second one there would measure only its own scatter.
        """
        places = np.array(self.places_m)
        away_m = np.linalg.norm(grid[:, None] - places, axis=2)
        fresh = away_m.min(axis=1) >= APART_M
        if hard_m is not None or float(hard.max()) >= SUSPICIOUS:
            centre = grid[int(np.argmax(hard if hard_m is None else mean))]
            near = np.linalg.norm(grid - centre, axis=1) <= 2.0 * self.field_.length_m
            at = grid[int(np.argmax(np.where(near & fresh, mean + sigma, -np.inf)))]
        else:
            inside = np.all((grid >= 0.5 * self.field_.length_m) & (grid <= grid.max(axis=0) - 0.5 * self.field_.length_m), axis=1)
            score = np.where(fresh & (inside | (hard > hard[inside].max() + 0.02)), hard, -1.0)
            equal = np.flatnonzero(score >= score.max() - 0.005)
            at = grid[equal[int(np.argmin(away_m[equal, -1]))]]
        return float(at[0]), float(at[1])


def _background(logs: Floats) -> float:
    """Log stiffness of the soft part: the mean of the presses that are not hard against the median."""
    median = float(np.median(logs))
    soft = logs[logs < median + HARD]
    return float(np.mean(soft)) if len(soft) else median


def _unwatched(_survey: Survey, _map: Map) -> None:
    """Nobody watches the search."""


def search(
    press: Callable[[tuple[float, float]], float],
    where: Field,
    most: int = 200,
    survey: Survey | None = None,
    watch: Callable[[Survey, Map], None] = _unwatched,
) -> tuple[Survey, Map]:
    """Press where a hard place is likeliest until the map says stop.

    Args:
        press: Presses at a place (x, y) in m and gives the modulus in Pa.
        most: Largest number of presses.
        survey: Presses made before; it also keeps the new ones if `press` raises.
        watch: Is called with every new map.

    Returns:
        All presses, and the last map.
    """
    survey = survey or Survey(where)
    latest = survey.map()
    while not latest.done and len(survey.places_m) < most:
        survey.add(latest.next_m, press(latest.next_m))
        latest = survey.map()
        watch(survey, latest)
    return survey, latest


def raster(where: Field) -> list[tuple[float, float]]:
    """Places (x, y) in m of an even raster of `RASTER_M`, row by row, to and fro."""
    x, y = (np.arange(0.0, size + RASTER_M / 2, RASTER_M) for size in (where.width_m, where.height_m))
    return [(float(a), float(b)) for row, b in enumerate(y) for a in (x if row % 2 == 0 else x[::-1])]


def read_presses(path: Path, where: Field, accept_implausible: bool = False) -> Survey:
    """Read presses from a CSV file with the columns x_m, y_m and youngs_modulus_Pa; of that column, the name says the unit.

    Args:
        where: The field that they belong to.
        accept_implausible: Whether moduli count whose presses no sensor would feel.

    Raises:
        BadInput: The file cannot be read, a row is no press in the field, or the moduli look like those of another unit.
    """
    survey = Survey(where)
    try:
        with opened_text(path) as file:
            layout = read_layout(file, path.name, ("x_m", "y_m", *MODULUS_COLUMNS))
            column = next((name for name in MODULUS_COLUMNS if name in layout.header), "youngs_modulus_Pa")
            columns = ("x_m", "y_m", column)
            if missing := [name for name in columns if name not in layout.header]:
                raise BadInput(f"{path.name}: the header has no column {', '.join(missing)}; expected {', '.join(columns)}")
            if twice := [name for name in columns if layout.header.count(name) > 1]:
                raise BadInput(f"{path.name}: the header has the column {twice[0]} twice; leave one of them")
            for number, line in enumerate(file, start=layout.lines + 1):
                if is_comment(line):
                    continue
                row = dict(zip(layout.header, cells_of(with_points(line, layout), layout.delimiter), strict=False))
                try:
                    x_m, y_m, modulus = (float(row[name]) for name in columns)
                    place = (x_m, y_m)
                except (KeyError, ValueError):
                    raise BadInput(f"{path.name}, line {number}: expected numbers in the columns {', '.join(columns)}") from None
                survey.add(place, modulus * MODULUS_COLUMNS[column])
    except csv.Error as error:
        raise BadInput(f"{path} is no CSV ({error}); give one with the columns x_m, y_m, youngs_modulus_Pa") from None
    ask(_unfelt(survey, path.name), accept_implausible, f"name another unit in the column ({', '.join(MODULUS_COLUMNS)})")
    return survey


def _unfelt(survey: Survey, name: str) -> list[str]:
    """A sentence where the usual press would stay below the noise of a sensor: such moduli are those of another unit."""
    modulus_Pa, where, noise_N = float(np.median(survey.moduli_Pa or [math.inf])), survey.field_, SensorBlock().noise_rms_N
    force_N = modulus_Pa / modulus_hertz_Pa(1.0, where.depth_m, where.tip_radius_m, 0.5)
    if force_N >= noise_N:
        return []
    return [
        f"{name}: the moduli are about {quantity(modulus_Pa, 'Pa')}, so a press to {where.depth_m * 1e3:g} mm makes {force_N:.2g} N, "
        f"expected more than the noise of a sensor ({noise_N:g} N)"
    ]


def write_presses(path: Path, survey: Survey) -> None:
    """Write a CSV file that `read_presses` reads.

    Raises:
        BadInput: The file cannot be written.
    """
    rows = [f"{x_m:.4f},{y_m:.4f},{modulus_Pa:.1f}" for (x_m, y_m), modulus_Pa in zip(survey.places_m, survey.moduli_Pa, strict=True)]
    write_text(path, "\n".join(["x_m,y_m,youngs_modulus_Pa", *rows, ""]))


def draw(survey: Survey, stiffness: Map, out: Path, truth: tuple[float, float, float] | None = None) -> None:
    """Write the map as a figure.

    Args:
        stiffness: the map that follows from them.
        out: the file; its suffix is the format.
        truth: centre x, y and radius of an emulated inclusion in m, to be drawn too; None draws none.
    """
    save_figure(figure_of(survey, stiffness, truth), out)


def figure_of(survey: Survey, stiffness: Map, truth: tuple[float, float, float] | None = None) -> Figure:
    """Three maps: the stiffness, its uncertainty, and the probability of a hard place.

    Args:
        stiffness: the map that follows from them.
        truth: centre x, y and radius of an emulated inclusion in m, to be drawn too; None draws none.
    """
    modulus_kPa = np.exp(stiffness.mean) * stiffness.background_Pa / 1e3
    depth_mm = survey.field_.depth_m * 1e3
    panels = (
        (modulus_kPa, "viridis", f"Young's modulus {depth_mm:g} mm deep (kPa)", (None, None)),
        (100.0 * stiffness.sigma, "cividis", "its uncertainty, one sigma (%)", (0.0, 100.0 * BUMP_SIGMA)),
        (stiffness.hard_probability, "magma", f"probability of a place stiffer by {math.expm1(HARD):.0%}", (0.0, 1.0)),
    )
    with styled_figure(10.0, 3.8) as figure:
        for axes, (values, colours, title, limits) in zip(figure.subplots(1, 3), panels, strict=True):
            _image(axes, survey.field_, values, colours, limits)
            _places(axes, survey, stiffness, truth)
            axes.set_title(title, fontsize=8.5)
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)
        figure.suptitle(f"{len(survey.places_m)} presses: {stiffness.sentence}", fontsize=10)
    return figure


def _image(axes: Axes, where: Field, values: Floats, colours: str, limits: tuple[float | None, float | None]) -> None:
    """A map over a field as colours, with its bar."""
    width_mm, height_mm, half_mm = where.width_m * 1e3, where.height_m * 1e3, GRID_M * 1e3 / 2
    image = axes.imshow(
        values.reshape(round(where.height_m / GRID_M) + 1, round(where.width_m / GRID_M) + 1),
        origin="lower",
        extent=(-half_mm, width_mm + half_mm, -half_mm, height_mm + half_mm),
        cmap=colours,
        interpolation="bilinear",
        vmin=limits[0],
        vmax=limits[1],
    )
    axes.figure.colorbar(image, ax=axes, shrink=0.8)
    axes.grid(visible=False)
    axes.set(xlabel="x (mm)", ylabel="y (mm)", xlim=(0.0, width_mm), ylim=(0.0, height_mm))


def _places(axes: Axes, survey: Survey, stiffness: Map, truth: tuple[float, float, float] | None) -> None:
    """The presses, the true inclusion where it is known, and the next press."""
    x_mm, y_mm = 1e3 * np.array(survey.places_m).reshape(-1, 2).T
    axes.scatter(x_mm, y_mm, s=14, c="white", edgecolors="black", linewidths=0.6, label="presses")
    if truth is not None:
        centre_x_mm, centre_y_mm, radius_mm = (1e3 * value for value in truth)
        label = "true inclusion, emulated"
        axes.add_patch(Circle((centre_x_mm, centre_y_mm), radius_mm, fill=False, edgecolor=RED, linestyle="--", linewidth=1.4, label=label))
    if not stiffness.done:
        axes.plot(stiffness.next_m[0] * 1e3, stiffness.next_m[1] * 1e3, "*", color=RED, markersize=12, label="next press")
