"""Every figure has one style, and an SVG of it reads on light and on dark pages."""

import subprocess
import sys
from pathlib import Path

import numpy as np
from matplotlib import rcParams
from matplotlib.figure import Figure

from palpd.analysis.figure_style import INK, POINTS_PER_CURVE, STYLE, inline_svg, save_figure, styled_figure, thinned


def drawn() -> Figure:
    with styled_figure(5.0, 3.0) as figure:
        axes = figure.subplots()
        axes.plot([0.0, 1.0], [0.0, 2.0], color=INK)
        axes.set(xlabel="time (s)", ylabel="force (N)")
    return figure


def test_an_svg_has_the_text_colour_of_its_page_and_no_background() -> None:
    svg = inline_svg(drawn(), "force")
    assert svg.startswith("<svg")
    assert "currentColor" in svg
    assert INK not in svg
    assert "#ffffff" not in svg
    assert ">force (N)</text>" in svg


def test_the_same_figure_gives_the_same_svg_and_another_name_other_anchors() -> None:
    assert inline_svg(drawn(), "force") == inline_svg(drawn(), "force")
    assert inline_svg(drawn(), "force") != inline_svg(drawn(), "torque")
    assert "metadata" not in inline_svg(drawn(), "force")


def test_a_png_is_written_on_white(tmp_path: Path) -> None:
    from matplotlib.image import imread

    save_figure(drawn(), tmp_path / "force.png")
    assert imread(tmp_path / "force.png")[0, 0].tolist() == [1.0, 1.0, 1.0, 1.0]


def test_the_style_does_not_leak_into_other_figures() -> None:
    before = [rcParams[name] for name in STYLE]
    inline_svg(drawn(), "force")
    assert [rcParams[name] for name in STYLE] == before
    assert before != list(STYLE.values())


def test_a_long_curve_keeps_its_ends_and_its_spikes() -> None:
    x = np.linspace(0.0, 10.0, 50_000)
    y = np.sin(x)
    y[31_234] = 5.0
    thin_x, thin_y = thinned(x, y)
    assert len(thin_x) == len(thin_y) <= POINTS_PER_CURVE
    assert thin_y.max() == 5.0
    assert np.all(np.diff(thin_x) > 0.0)
    assert thin_x[0] < 0.02
    assert thin_x[-1] > 9.98


def test_the_command_line_starts_without_matplotlib() -> None:
    subprocess.run([sys.executable, "-c", "import sys, palpd.cli; sys.exit('matplotlib' in sys.modules)"], check=True)
