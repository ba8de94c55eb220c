"""One style for every figure of the project: colours, fonts, grid and sizes, as SVG inside a page or as a file."""

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib import rc_context
from matplotlib.figure import Figure

from palpd.errors import BadInput
from palpd.file_kinds import PICTURE_MARKS
from palpd.files import writing
from palpd.tick import Floats

INK = "#1d2733"
"""Text, axes, and what was measured. In a page it is the page's own text colour, so that it reads in light and in dark."""
ORANGE, BLUE, RED, YELLOW, GREY = "#e07b00", "#0b82b5", "#d0453b", "#c9a200", "#8a94a3"
"""Colours of curves: mid tones, so that each reads on white and on the dark page."""
NOMINAL, ENRICHED = ORANGE, BLUE
"""The cell as its file states it, and the cell with the named effects."""
FLOOR: dict[str, Any] = {"color": GREY, "alpha": 0.3, "linewidth": 0.0}
"""The band of a noise floor: half transparent, so that the tint of a phase shows through."""

STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.labelsize": 9.0,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "legend.fontsize": 8.5,
    "legend.frameon": False,
    **dict.fromkeys(("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color", "grid.color"), INK),
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.alpha": 0.13,
    "grid.linewidth": 0.7,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "lines.linewidth": 1.3,
    "lines.solid_joinstyle": "round",
    "svg.fonttype": "none",
    "svg.hashsalt": "palpd",
}
"""Settings of matplotlib. Text stays text in SVG, and the fixed salt makes the same figure the same bytes."""
POINTS_PER_CURVE = 1400
"""Two for every pixel column of a narrow page; more points cannot be seen and make the page large."""
PNG_DOTS_PER_INCH = 110


class ShownFigure(Figure):
    """A figure that a notebook shows without `%matplotlib inline`."""

    def _repr_png_(self) -> bytes:
        stream = io.BytesIO()
        with rc_context(STYLE):
            self.savefig(stream, format="png", dpi=PNG_DOTS_PER_INCH, facecolor="white")
        return stream.getvalue()


@contextmanager
def styled_figure(width_in: float = 10.0, height_in: float = 3.0) -> Iterator[Figure]:
    """A figure in the style of the project; draw inside the `with` block.

    Args:
        width_in: width in inches; 10 fills the width of a page.
        height_in: height in inches.

    Returns:
        A context manager that gives the figure.
    """
    with rc_context(STYLE):
        yield ShownFigure(figsize=(width_in, height_in), layout="constrained")


def inline_svg(figure: Figure, name: str) -> Markup:
    """A figure as SVG for the body of a page: transparent, in the text colour of the page, without date and generator.

    Args:
        figure: a figure made in `styled_figure`.
        name: a word that is unique in the page, for the anchors inside the SVG.

    Returns:
        The SVG element.
    """
    stream = io.StringIO()
    with rc_context(STYLE | {"svg.hashsalt": name}):
        if (layout := figure.get_layout_engine()) is not None:
            layout.execute(figure)
            figure.set_layout_engine("none")  # else the figure is drawn twice, once to no purpose but its layout
        figure.savefig(stream, format="svg", transparent=True, metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    svg = stream.getvalue()
    svg = re.sub(r'<g id="[\w.]+"', "<g", svg[svg.index("<svg") :])  # groups are numbered alike in every figure of a page
    return Markup(svg.replace(INK, "currentColor"))


def refuse_format(path: Path) -> None:
    """Refuse a figure in a format that `save_figure` does not write. Raises BadInput."""
    if path.suffix[1:] not in ("", *PICTURE_MARKS):
        raise BadInput(f"{path} ends with {path.suffix!r}, expected {', '.join(f'.{kind}' for kind in PICTURE_MARKS)}; give such a name")


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure on white.

    Args:
        figure: a figure made in `styled_figure`.
        path: the file; its suffix is the format, without one PNG.

    Raises:
        BadInput: the file cannot be written.
    """
    kind = path.suffix[1:] or "png"
    with rc_context(STYLE), writing(path) as stream:
        figure.savefig(stream, format=kind, dpi=PNG_DOTS_PER_INCH, facecolor="white", metadata=PICTURE_MARKS.get(kind))


def thinned(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """At most `POINTS_PER_CURVE` points of a curve: the lowest and the highest of each stretch, so that no spike is lost.

    Args:
        x: abscissa, (n,).
        y: ordinate, (n,).

    Returns:
        Those points (k,) of x and y, in their order.
    """
    if len(x) <= POINTS_PER_CURVE:
        return x, y
    begins = np.linspace(0, len(x), POINTS_PER_CURVE // 2 + 1).astype(int)
    ends = [(a + int(np.argmin(y[a:b])), a + int(np.argmax(y[a:b]))) for a, b in pairwise(begins)]
    kept = np.unique(ends)
    return x[kept], y[kept]
