"""Closed formulas with one or two coefficients in place of a curve."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import log

import numpy as np

from palpd.cell.effects.drivers import Driver
from palpd.cell.effects.learned import formula_of
from palpd.gap.assumptions import ASSUMED
from palpd.gap.laws.bases import KNOTS, Basis
from palpd.tick import Floats

PLACES = np.linspace(0.05, 0.95, 13)
"""Places of hinges, bumps and turns (tanh), as shares of the range of the driver."""

WIDTHS = (0.04, 0.1, 0.25)
"""Widths of bumps and turns, as shares of the range."""


POWERS = (0.5, 1.5, 2.0, 3.0)
SHOWN = 3 * KNOTS
"""Number of stretches between the values at which a formula is written down."""


@dataclass(frozen=True)
class FormulaShape:
    """A function of a driver x, without its coefficient.

    Attributes:
        pattern: A text in x, with the marks {less} for x - x0 and {w} for the width.
        x0: Place in the unit of the driver; None where the function has no place.
        w: Width in the unit of the driver; None where the function has no width.
    """

    pattern: str
    x0: float | None = None
    w: float | None = None

    @property
    def text(self) -> str:
        """The function as a text in x."""
        x0 = self.x0 or 0.0
        less = f"(x - {x0:.5g})" if x0 >= 0.0 else f"(x + {-x0:.5g})"
        return self.pattern.replace("{less}", less).replace("{w}", f"{self.w or 0.0:.4g}")


CONSTANT = FormulaShape("1")


@dataclass(frozen=True)
class Formula:
    """A closed formula: a sum of one or two functions of a driver, each with a coefficient w.

    Attributes:
        low: Value of the driver, in its unit, below which the formula is constant.
        high: Value of the driver, in its unit, above which the formula is constant.
        sizes: Largest absolute value of each function, by which its column is divided.
        price: Nats: log of the number of formulas of its kind, plus `laws.grid_nats` where there are several.
    """

    driver: Driver
    low: float
    high: float
    shapes: tuple[FormulaShape, ...]
    sizes: tuple[float, ...]
    price: float

    @property
    def priors(self) -> tuple[Floats, ...]:
        """The root L (m, m) of the prior covariance of the coefficients w: they are independent."""
        return (np.eye(len(self.shapes)),)

    @property
    def size(self) -> int:
        """Number m of coefficients."""
        return len(self.shapes)

    def columns(self, x: Floats) -> Floats:
        """The columns at values of the driver.

        Args:
            x: Values (n,) in the unit of the driver.

        Returns:
            Columns (n, m).
        """
        x = x if self.driver.period else np.clip(x, self.low, self.high)
        return np.stack([formula_of(shape.text)(x) / size for shape, size in zip(self.shapes, self.sizes, strict=True)], axis=-1)

    def shown_at(self) -> Floats:
        """Values of the driver (k,) at which the formula is written down, in its unit."""
        return np.linspace(0.0, self.driver.period, SHOWN + 1) if self.driver.period else np.linspace(self.low, self.high, SHOWN + 1)

    def text(self, coefficients: Floats) -> str:
        """The formula with its coefficients (m,), as a text in x."""
        terms = []
        for shape, size, value in zip(self.shapes, self.sizes, coefficients.tolist(), strict=True):
            terms.append(f"{value / size:.5g}" if shape == CONSTANT else f"{value / size:.5g} * {shape.text}")
        return " + ".join(terms).replace("+ -", "- ")


def formulas_of(basis: Basis, x: Floats, *, with_constant: bool) -> Iterator[Formula]:
    """The formulas that may replace a curve.

    Args:
        x: Values (b,) of its driver in the bins.
        with_constant: Whether formulas have a constant, too. With the factor `one` a constant is the bias, which is a nuisance.
    """
    driver, low, high = basis.driver, basis.low, basis.high
    if driver.period is not None:
        angle = f"2*pi*x/{driver.period:.7g}"
        kinds: list[list[tuple[FormulaShape, ...]]] = [[(FormulaShape(f"sin({angle})"), FormulaShape(f"cos({angle})"))]]
    else:
        kinds = [[(shape,) for shape in kind] for kind in _kinds(low, high)]
        if with_constant:
            shifted: list[list[tuple[FormulaShape, ...]]] = [[(CONSTANT, *shapes) for shapes in kind] for kind in kinds]
            kinds = [[(CONSTANT,)], *kinds, *shifted]
    for kind in kinds:
        for shapes in kind:
            price = log(len(kind)) + (ASSUMED.laws.grid_nats if len(kind) > 1 else 0.0)
            if (formula := _formula(driver, low, high, shapes, x, price)) is not None:
                yield formula


def _formula(driver: Driver, low: float, high: float, shapes: tuple[FormulaShape, ...], x: Floats, price: float) -> Formula | None:
    inside = np.clip(x, low, high) if driver.period is None else x
    sizes = tuple(float(np.abs(formula_of(shape.text)(inside)).max()) for shape in shapes)
    return Formula(driver, low, high, shapes, sizes, price) if all(1e-200 < size < 1e200 for size in sizes) else None


def neighbours(formula: Formula, x: Floats) -> list[Formula]:
    """The formula with its place and width a little off; the price of the grid has paid for that.

    Args:
        x: Values (b,) of its driver in the bins.

    Returns:
        Formulas of the same kind; empty where there is neither place nor width.
    """
    *before, shape = formula.shapes
    step = 0.2 * (PLACES[1] - PLACES[0]) * (formula.high - formula.low)
    shifts = (-2.0 * step, -step, 0.0, step, 2.0 * step) if shape.x0 is not None else (0.0,)
    stretches = (0.6, 0.8, 1.0, 1.25, 1.6) if shape.w is not None else (1.0,)
    out = []
    for shift in shifts:
        for stretch in stretches:
            moved = replace(shape, x0=None if shape.x0 is None else shape.x0 + shift, w=None if shape.w is None else shape.w * stretch)
            if moved != shape:
                out.append(_formula(formula.driver, formula.low, formula.high, (*before, moved), x, formula.price))
    return [one for one in out if one is not None]


def _kinds(low: float, high: float) -> Iterator[list[FormulaShape]]:
    """Kinds of formulas of a single coefficient, each with its grid of places and widths."""
    span = high - low
    places, widths = [low + share * span for share in PLACES], [share * span for share in WIDTHS]
    yield [FormulaShape("x")]
    even = [FormulaShape(f"abs(x)**{p:g}") for p in POWERS]
    odd = [FormulaShape(f"sign(x)*abs(x)**{p:g}") for p in POWERS]
    yield [*even, *odd, FormulaShape("abs(x)")] if low < 0.0 < high else even
    yield [FormulaShape(f"{side}({{less}}, 0)", x0) for x0 in places for side in ("maximum", "minimum")]
    yield [FormulaShape("exp(-0.5*({less}/{w})**2)", x0, w) for x0 in places for w in widths]
    turns = [FormulaShape("tanh({less}/{w})", x0, w) for x0 in places for w in widths]
    yield [*turns, *(FormulaShape("tanh(x/{w})", None, w) for w in widths)]
    yield [FormulaShape("exp(-{less}/{w})", low, w) for w in widths] + [FormulaShape("exp({less}/{w})", high, w) for w in widths]
