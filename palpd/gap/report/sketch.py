"""A small picture of what an effect does, made by its own simulation on a standard press: it cannot show anything else."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from math import inf
from typing import Any

import numpy as np
from markupsafe import Markup

from palpd.analysis.figure_style import ENRICHED, GREY
from palpd.cell.cell_file import nominal
from palpd.cell.effects import Effect, Scale
from palpd.cell.effects.effect import LOAD
from palpd.cell.simulation import scale_of, simulate
from palpd.gap.similar_effects import standard_motion
from palpd.tick import Floats

WIDTH, HEIGHT, MARGIN = 120, 80, 10
SEEN = (0.12, 0.04)
"""Rms of a change, and of scatter, as a share of the range of its channel, from which on it is seen; smaller changes are drawn larger."""
GROWTH = 2.0 ** np.arange(11)
PRESS_HZ, AIR_HZ, POINTS = 100.0, 400.0, 160
"""Rates of the simulated presses and of the start in the air, and points of a curve: more than a picture of that width has dots."""
CLOSE_S = 0.8
"""Length of the motion in a sketch of noise or steps, and in a sketch of motion in the air."""
UPRIGHT = {"fz_N": "force", "z_m": "height", "fx_N": "side force", "fy_N": "side force", "tx_Nm": "torque", "ty_Nm": "torque"}
"""The channels that a sketch may show, and the label of its upright axis for each."""
NOISE = {"z_m": 2e-5, "tx_Nm": 0.01, "ty_Nm": 0.01}
"""Changes that count alike where the channel to draw is chosen; 0.1 N of a force."""


@np.errstate(all="ignore")  # a user's law may be driven to where it has no value
def sketch(effect: Effect, fitted: Mapping[str, float]) -> Markup:
    """Draw what an effect does to two presses: grey and dashed the cell as stated, solid the cell with the effect.

    An effect that is small compared with a press is drawn in the air, where the arm starts.

    Args:
        fitted: Its parameters as a diagnosis found them. The sketch keeps their direction, such as softer and not stiffer, but not their
            size.

    Returns:
        An SVG element; empty where the effect changes nothing there.
    """
    best, picture, pressed = 0.0, Markup(""), nominal()
    over_depth = effect.discrepancy_drivers == LOAD or effect.site == "tip"  # it follows the load, not the time
    motion, limits = standard_motion(pressed)
    presses = replace(motion, depths_m=(limits.depth_m, limits.depth_m), hold_s=0.2, repeats=1, strokes=0, mode="static")
    for cell, rows_Hz in ((pressed, PRESS_HZ), (pressed.model_copy(update={"tissue": None}), AIR_HZ)):
        t_s, z_cmd_m = presses.heights(1.0 / rows_Hz, 0.0, limits.home_m, limits.acceleration_m_per_s2)
        simulated = partial(simulate, t_s=t_s, z_cmd_m=z_cmd_m, noise_seed=1 if effect.scatter else None, library={effect.id: effect})
        stated = simulated(cell)
        scale = scale_of(pressed, t_s, stated["z_m"], stated["vz_m_per_s"], simulated(pressed)["fz_N"])
        shown = np.ones(len(t_s), dtype=bool)
        if effect.scatter or cell.tissue is None:
            begin_s = t_s[int(np.argmax(stated["z_m"] < (0.0 if effect.scatter else 0.999 * limits.home_m)))]
            shown = (t_s > begin_s - 0.1 * CLOSE_S) & (t_s < begin_s + CLOSE_S)
        for growth in GROWTH:
            other = simulated(cell.with_effects({effect.id: _values(effect, fitted, scale, float(growth))}))
            change = {name: float(np.sqrt(np.mean((other[name] - stated[name]) ** 2))) for name in UPRIGHT}
            channel = (
                "z_m" if effect.motion else "fz_N" if effect.scatter else max(change, key=lambda name: change[name] / NOISE.get(name, 0.1))
            )
            share = change[channel] / max(float(np.ptp(stated[channel])), NOISE.get(channel, 0.1))
            if share > best and np.isfinite(share):
                x, along = (-stated["z_m"], "depth") if over_depth else (t_s, "time")
                curves = stated[channel][shown], other[channel][shown]
                best, picture = share, _svg(x[shown], curves, UPRIGHT[channel], along, effect.what)
            if best >= SEEN[bool(effect.scatter)]:
                return picture
    return picture


def _values(effect: Effect, fitted: Mapping[str, float], scale: Scale, growth: float) -> dict[str, float]:
    """Typical values of the parameters; their distance from the value at which the effect is absent is multiplied by the growth."""
    values = {}
    for one in effect.named_parameters:
        absent, value = one.nominal_value(scale), one.starts(scale)[-1 if effect.scatter else 0]
        if one.choices:
            value = fitted.get(one.name, value)
        elif absent == inf:
            value /= growth
        elif absent is not None:
            side = -growth if (fitted.get(one.name, value) - absent) * (value - absent) < 0.0 else growth
            value = absent * (value / absent) ** side if one.log else absent + side * (value - absent)
            # Bounds that follow the size of a recording say where to search; others, such as a share of 1, are bounds of physics.
            if one.natural is None and not callable(one.upper):
                value = min(value, one.upper)
        if not one.optional or one.name in fitted:
            values[one.name] = value
    return values


def law_sketch(content: Mapping[str, Any]) -> dict[str, Markup]:
    """Draw the curve of the learned law of an out.json over its driver: an SVG element by the id of the law; empty without a law."""
    law = content.get("learned")
    if not law:
        return {}
    x, value = np.array(law["curve"]["x"]), np.array(law["curve"]["value"])
    along = law["driver"].removeprefix("the ").partition(" of ")[0].partition(",")[0]
    return {law["id"]: _svg(x, (np.zeros(len(x)), value), "height" if "z_m" in law["channels"] else "law", along, law["what"])}


def _svg(x: Floats, curves: Sequence[Floats], upright: str, along: str, words: str) -> Markup:
    kept = np.unique(np.linspace(0, len(x) - 1, POINTS).astype(int))
    low, high = min(float(y.min()) for y in curves), max(float(y.max()) for y in curves)
    across = MARGIN + (WIDTH - MARGIN - 2) * (x[kept] - x.min()) / max(float(np.ptp(x)), 1e-300)
    lines = Markup("")
    for y, style in zip(curves, (f'stroke="{GREY}" stroke-dasharray="3 2"', f'stroke="{ENRICHED}" stroke-width="1.6"'), strict=True):
        down = HEIGHT - MARGIN - 2 - (HEIGHT - 2 * MARGIN - 4) * (y[kept] - low) / max(high - low, 1e-300)
        lines += Markup(f'<polyline points="{" ".join(f"{a:.1f},{b:.1f}" for a, b in zip(across, down, strict=True))}" {style}/>')
    return Markup(
        f'<svg class="sketch" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{{words}}" fill="none">{{lines}}'
        f'<path d="M{MARGIN} {MARGIN}V{HEIGHT - MARGIN}H{WIDTH}" stroke="currentColor" stroke-width=".8"/><g fill="currentColor" '
        f'font-size="8"><text y="7">{{upright}}</text><text x="{WIDTH}" y="{HEIGHT - 2}" text-anchor="end">{{along}}</text></g></svg>'
    ).format(words=words, lines=lines, upright=upright, along=along)
