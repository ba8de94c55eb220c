"""A stiffness map of a field from few presses: where to press next, when to stop, what was found.

The logarithm of the stiffness is a Gaussian process over the field (scikit-learn): a constant background, which is the mean of what was
pressed weighed against being hard, plus bumps as wide as tip and inclusion make them. The next press goes where something harder is
likeliest, and where nothing is known that is everywhere equally; so the field is first covered as coarsely as an inclusion of the
stated size allows, and then followed up. It stops when a hard place is certain and located by presses around it, or when none is
likely anywhere.
"""

import csv
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import norm
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from palpd.errors import BadInput
from palpd.tick import Floats

BUMP_SIGMA = 0.3
"""One sigma of the logarithm of stiffness over a field before anything is pressed."""
NOISE_SIGMA = 0.02
"""Of a press, relative: scatter of stiffness, surface and force."""
HARD = math.log(1.2)
"""Log ratio to the background above which a place is hard."""
CERTAIN = 0.95
UNLIKELY = 0.21
"""Probability below which nowhere is worth a press; before anything is pressed it is 27 % everywhere."""
GRID_M = 0.002
SUSPICIOUS = 0.35
"""Probability above which a place is followed up before others are looked at; nothing known is 27 %."""
APART_M = 0.003
LOCATING_PRESSES = 4
"""More than so many presses around a hard place, and it is located."""
FIRST_PRESSES = 3


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
    """What is known after some presses: mean and sigma of the log stiffness against the background, (n,) over `grid` (n, 2); the
    background in Pa; where to press next; and whether to stop, with the sentence.
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
    """Presses made so far on a field, and what they say."""

    field_: Field = field(default_factory=Field)
    places_m: list[tuple[float, float]] = field(default_factory=list)
    moduli_Pa: list[float] = field(default_factory=list)

    def add(self, place_m: tuple[float, float], modulus_Pa: float) -> None:
        """A press was made there. Raises BadInput where it is outside or no modulus."""
        x_m, y_m = place_m
        if not (-1e-9 <= x_m <= self.field_.width_m + 1e-9 and -1e-9 <= y_m <= self.field_.height_m + 1e-9):
            raise BadInput(
                f"the press at ({x_m:g}, {y_m:g}) m lies outside the field of {self.field_.width_m:g} × {self.field_.height_m:g} m"
            )
        if not (math.isfinite(modulus_Pa) and modulus_Pa > 0.0):
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
        done, found, sentence = self._stop(grid, mean, hard, len(logs))
        next_m = self._next(grid, mean, sigma, hard, found)
        return Map(grid, mean, sigma, hard, math.exp(background), next_m, done, found, sentence)

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

    def _next(self, grid: Floats, mean: Floats, sigma: Floats, hard: Floats, found: tuple[float, float] | None) -> tuple[float, float]:
        """Around a hard place where it may be harder still; else where something hard is likeliest, of equals the nearest to the last.

        Never where a press was before: a second one there would tell only of its own scatter.
        """
        places = np.array(self.places_m)
        away_m = np.linalg.norm(grid[:, None] - places, axis=2)
        fresh = away_m.min(axis=1) >= APART_M
        if found is not None or float(hard.max()) >= SUSPICIOUS:
            centre = grid[int(np.argmax(hard if found is None else mean))]
            near = np.linalg.norm(grid - centre, axis=1) <= 2.0 * self.field_.length_m
            at = grid[int(np.argmax(np.where(near & fresh, mean + sigma, -np.inf)))]
        else:
            inside = np.all((grid >= 0.5 * self.field_.length_m) & (grid <= grid.max(axis=0) - 0.5 * self.field_.length_m), axis=1)
            score = np.where(fresh & (inside | (hard > hard[inside].max() + 0.02)), hard, -1.0)
            equal = np.flatnonzero(score >= score.max() - 0.005)
            at = grid[equal[int(np.argmin(away_m[equal, -1]))]]
        return float(at[0]), float(at[1])


def _background(logs: Floats) -> float:
    """Of the soft part: the median of what is not hard against the median."""
    median = float(np.median(logs))
    soft = logs[logs < median + HARD]
    return float(np.mean(soft)) if len(soft) else median


def search(
    press: Callable[[tuple[float, float]], float],
    where: Field,
    most: int = 200,
    survey: Survey | None = None,
    watch: Callable[[Survey, Map], None] = lambda survey, found: None,
) -> tuple[Survey, Map]:
    """Press where it pays most until the map says stop, or `most` presses are made; `press` gives the modulus at a place.

    `survey` holds presses that were made before, and all that were made where `press` raises; `watch` sees each new map.
    """
    survey = survey or Survey(where)
    found = survey.map()
    while not found.done and len(survey.places_m) < most:
        survey.add(found.next_m, press(found.next_m))
        found = survey.map()
        watch(survey, found)
    return survey, found


def raster(where: Field, step_m: float = 0.005) -> list[tuple[float, float]]:
    """Places of equal presses, row by row, to and fro."""
    x, y = (np.arange(0.0, size + step_m / 2, step_m) for size in (where.width_m, where.height_m))
    return [(float(a), float(b)) for row, b in enumerate(y) for a in (x if row % 2 == 0 else x[::-1])]


def read_presses(path: Path, where: Field) -> Survey:
    """Presses from a CSV file with the columns x_m, y_m and youngs_modulus_Pa. Raises BadInput."""
    survey = Survey(where)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            for number, row in enumerate(csv.DictReader(file), start=2):
                try:
                    place, modulus = (float(row["x_m"]), float(row["y_m"])), float(row["youngs_modulus_Pa"])
                except (KeyError, TypeError, ValueError):
                    raise BadInput(f"{path.name}, line {number}: expected numbers in the columns x_m, y_m, youngs_modulus_Pa") from None
                survey.add(place, modulus)
    except (OSError, UnicodeDecodeError):
        raise BadInput(f"{path} cannot be read; give a CSV file with the columns x_m, y_m, youngs_modulus_Pa") from None
    return survey


def write_presses(path: Path, survey: Survey) -> None:
    """A CSV file that `read_presses` reads. Raises BadInput."""
    rows = [f"{x_m:.4f},{y_m:.4f},{modulus_Pa:.1f}" for (x_m, y_m), modulus_Pa in zip(survey.places_m, survey.moduli_Pa, strict=True)]
    try:
        path.write_text("\n".join(["x_m,y_m,youngs_modulus_Pa", *rows, ""]), encoding="utf-8")
    except OSError as error:
        raise BadInput(f"{path} cannot be written ({error.strerror}); choose another place") from None


def draw(survey: Survey, found: Map, out: Path, truth: tuple[float, float, float] | None = None) -> None:
    """Write the map as a PNG."""
    figure_of(survey, found, truth).savefig(out)


def figure_of(survey: Survey, found: Map, truth: tuple[float, float, float] | None = None) -> Figure:
    """Stiffness, its uncertainty, and the probability of a hard place; `truth` is centre and radius of an emulated inclusion, in m."""
    figure = Figure(figsize=(13.5, 4.5), layout="constrained", dpi=110)
    where = survey.field_
    shape = (round(where.height_m / GRID_M) + 1, round(where.width_m / GRID_M) + 1)
    edges_mm = [1e3 * (edge + side) for size in (where.width_m, where.height_m) for edge, side in ((0.0, -GRID_M / 2), (size, GRID_M / 2))]
    panels = (
        (np.exp(found.mean) * found.background_Pa / 1e3, "viridis", f"Young's modulus {where.depth_m * 1e3:g} mm deep (kPa)", (None, None)),
        (100.0 * found.sigma, "cividis", "its uncertainty, one sigma (%)", (0.0, 100.0 * BUMP_SIGMA)),
        (found.hard_probability, "magma", f"probability of a place stiffer by {math.expm1(HARD):.0%}", (0.0, 1.0)),
    )
    places_mm = 1e3 * np.array(survey.places_m).reshape(-1, 2)
    for axes, (values, colours, title, (least, most)) in zip(figure.subplots(1, 3), panels, strict=True):
        grid = values.reshape(shape)
        image = axes.imshow(grid, origin="lower", extent=edges_mm, cmap=colours, interpolation="bilinear", vmin=least, vmax=most)
        figure.colorbar(image, ax=axes, shrink=0.8)
        axes.scatter(*places_mm.T, s=14, c="white", edgecolors="black", linewidths=0.6, label="presses")
        if truth is not None:
            turn = np.linspace(0.0, 2 * np.pi, 100)
            x, y, radius = (value * 1e3 for value in truth)
            axes.plot(x + radius * np.cos(turn), y + radius * np.sin(turn), "r--", linewidth=1.4, label="true inclusion, emulated")
        if not found.done:
            axes.plot(found.next_m[0] * 1e3, found.next_m[1] * 1e3, "r*", markersize=12, label="next press")
        axes.set(xlabel="x (mm)", ylabel="y (mm)", xlim=(0.0, where.width_m * 1e3), ylim=(0.0, where.height_m * 1e3))
        axes.set_title(title, fontsize=10)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=9, frameon=False)
    figure.suptitle(f"{len(survey.places_m)} presses: {found.sentence}", fontsize=11)
    return figure
