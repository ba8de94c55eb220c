"""Tissue: what a tip at some height feels, beyond an elastic half-space."""

from math import inf

import numpy as np

from palpd.cell.dynamics import Floats, Memory, lowpass
from palpd.cell.effects.effect import LOAD, SCALE_OF_FORCE, STIFFENING, Effect, Parameter, Values, of, relaxation_time
from palpd.cell.span import Constants, Span

TINY = float(np.finfo(float).tiny)


def _surface(c: Constants, p: Values) -> None:
    c.surface_z_m += p["offset_m"]


SURFACE = Effect(
    "tissue.surface",
    "tissue",
    "the surface lies higher or lower than stated: every press touches earlier or later",
    (Parameter("offset_m", "m", lambda s: -s.depth_m, lambda s: s.stroke_m, of("depth_m", 0.05, -0.05)),),
    setting=_surface,
    moves_surface=True,
    tolerance="surface_z_m",
    discrepancy_drivers=LOAD,
    formula="surface = surface_stated + offset",
)


def _modulus(c: Constants, p: Values) -> None:
    c.youngs_modulus_Pa *= p["ratio"]


MODULUS = Effect(
    "tissue.modulus",
    "tissue",
    "the tissue is stiffer or softer than stated: every press gives a larger or smaller force, by one factor",
    (Parameter("ratio", "1", 0.01, 100.0, (1.2, 0.8, 3.0, 0.3), nominal=1.0, log=True, words="stiffness over the stated stiffness"),),
    setting=_modulus,
    tolerance="youngs_modulus",
    family=SCALE_OF_FORCE,
    discrepancy_drivers=LOAD,
    formula="E = ratio · E_stated",
)


def _plasticity(s: Span, p: Values, memory: Memory) -> None:
    """A press is deeper than one hundredth of the tip's radius; the surface sinks when the tip leaves."""
    enough_m = 0.01 * s.constants.tip_radius_m
    presses, pressed, sunk_m = memory.get("presses", 0), memory.get("pressed", False), memory.get("sunk_m", 0.0)
    unpressed_m = np.broadcast_to(s.surface_m, s.tip_m.shape)
    below_m = unpressed_m - s.tip_m
    surface_m = np.empty_like(below_m)
    k = since = 0
    while (k := _first(below_m, k, sunk_m, pressed, enough_m)) < len(below_m):
        if pressed:
            surface_m[since:k] = unpressed_m[since:k] - sunk_m
            sunk_m += p["set_m"] * p["ratio"] ** presses
            presses, since = presses + 1, k
        pressed = not pressed
        k += 1
    memory.update(presses=presses, pressed=pressed, sunk_m=sunk_m)
    surface_m[since:] = unpressed_m[since:] - sunk_m
    s.touch(surface_m)


def _first(below_m: Floats, k: int, sunk_m: float, pressed: bool, enough_m: float) -> int:
    """The first sample from `k` on that ends a press, or begins one; sought in stretches that double, so that many presses cost no more."""
    length = 64
    while k < len(below_m):
        depth_m = below_m[k : k + length] - sunk_m
        changes = depth_m <= 0.0 if pressed else depth_m > enough_m
        at = int(changes.argmax())
        if changes[at]:
            return k + at
        k, length = k + length, 2 * length
    return len(below_m)


PLASTICITY = Effect(
    "tissue.plasticity",
    "tissue",
    "the tissue stays dented: its surface sinks after each press",
    (
        Parameter("set_m", "m", 0.0, lambda s: s.depth_m, of("depth_m", 0.02, 0.1), words="dent of the first press"),
        Parameter("ratio", "1", 0.0, 1.0, (0.7, 0.3), nominal=None, words="each dent over the one before"),
    ),
    law=_plasticity,
    moves_surface=True,
    starts_at_tare=True,
    formula="surface = surface_stated - Σ set · ratio^k over the presses k = 0, 1, … that are over",
)


def dimitriadis(chi: Floats) -> Floats:
    """How much stiffer a bonded layer is than a half-space, at ν = 0.5 (Dimitriadis et al. 2002, eq. 12).

    Args:
        chi: √(r d) over the thickness, (n,).

    Returns:
        Factor on the force (n,).
    """
    factor: Floats = 1.0 + chi * (1.133 + chi * (1.283 + chi * (0.769 + chi * 0.0975)))
    return factor


def _thickness(s: Span, p: Values, _memory: Memory) -> None:
    s.contact_N = s.contact_N * dimitriadis(np.sqrt(s.constants.tip_radius_m * s.depth_m) / p["thickness_m"])


THICKNESS = Effect(
    "tissue.thickness",
    "tissue",
    "the tissue is a layer on a hard base: the force grows faster with depth than in thick tissue",
    (
        Parameter(
            "thickness_m",
            "m",
            lambda s: 0.2 * s.contact_radius_m,
            lambda s: 1e3 * s.contact_radius_m,
            of("contact_radius_m", 5.0, 20.0, 1.5),
            nominal=inf,
            log=True,
        ),
    ),
    law=_thickness,
    family=STIFFENING,
    discrepancy_drivers=LOAD,
    formula="f · (1 + 1.133 χ + 1.283 χ² + 0.769 χ³ + 0.0975 χ⁴), with χ = √(r · d) / thickness",
)


def _inclusion(s: Span, p: Values, _memory: Memory) -> None:
    x2 = (s.depth_m / p["depth_m"]) ** 2
    s.contact_N = s.contact_N * (1.0 + p["contrast"] * x2 / (1.0 + x2))


INCLUSION = Effect(
    "tissue.inclusion",
    "tissue",
    "something hard lies below the surface: the tissue becomes stiffer with depth",
    (
        Parameter("contrast", "1", 0.0, 100.0, (0.5, 3.0), words="added stiffness of deep presses, as a share"),
        Parameter("depth_m", "m", lambda s: 0.05 * s.depth_m, lambda s: 20.0 * s.depth_m, of("depth_m", 1.0, 3.0), nominal=None, log=True),
    ),
    law=_inclusion,
    family=STIFFENING,
    discrepancy_drivers=LOAD,
    formula="f · (1 + contrast · x² / (1 + x²)), with x = d / depth",
)


def _preconditioning(s: Span, p: Values, memory: Memory) -> None:
    deepest_m = np.maximum(np.maximum.accumulate(s.depth_m), memory.get("deepest_m", 0.0))
    memory["deepest_m"] = deepest_m[-1]
    share = s.depth_m / np.maximum(deepest_m, TINY)
    s.contact_N = s.contact_N * (1.0 - p["softening"] * (1.0 - share**2))


PRECONDITIONING = Effect(
    "tissue.preconditioning",
    "tissue",
    "the tissue softens where it was pressed before: the force falls short until a press goes deeper than before",
    (Parameter("softening", "1", 0.0, 1.0, (0.1, 0.4), words="largest loss of force, as a share"),),
    law=_preconditioning,
    starts_at_tare=True,
    discrepancy_drivers=LOAD,
    formula="f · (1 - softening · (1 - (d / d_max)²)), with d_max the deepest d so far",
)


def _viscoelastic(s: Span, p: Values, memory: Memory) -> None:
    """The Maxwell arm carries what the elastic force changed by lately; tissue that is left behind cannot pull through it."""
    arm_N = s.contact_N - lowpass(s.contact_N, s.dt_s, -1.0 / p["tau_s"], memory)
    s.contact_N = np.maximum(s.contact_N + p["ratio"] * arm_N, 0.0)


VISCOELASTIC = Effect(
    "tissue.viscoelastic",
    "tissue",
    "the tissue relaxes: the force decays while the probe is held",
    (Parameter("ratio", "1", 0.0, 20.0, (0.2, 1.0), words="decaying force over lasting force"), relaxation_time(0.01, 0.05, 0.002)),
    law=_viscoelastic,
    shows_at_rest=True,
    formula="max(0, f + ratio · (f - low-pass of f with time constant tau))",
)


def _adhesion(s: Span, p: Values, memory: Memory) -> None:
    """Grows over one range as the tip comes back from its deepest point, and fades over one range above the surface.

    A real contact is pinned (Johnson, Kendall, Roberts 1971): while its edge stays where it is, the force falls along the tangent at the
    deepest point. It then fades with a power of the gap, a large one where it lets go at once.
    """
    reach_m, lowest_m = p["range_m"], memory.get("lowest_m", inf)
    gap_m = s.tip_m - s.surface_m
    lowest = np.full(len(gap_m), inf)
    within = np.diff(np.concatenate(([0], (gap_m < reach_m).astype(np.int8), [0])))
    for a, b in zip(np.flatnonzero(within == 1).tolist(), np.flatnonzero(within == -1).tolist(), strict=True):
        before_m = lowest_m if a == 0 else inf
        touching = gap_m[a:b] <= 0.0
        if before_m < inf or touching.any():
            first = a if before_m < inf else a + int(touching.argmax())
            lowest[first:b] = np.minimum(np.minimum.accumulate(s.tip_m[first:b]), before_m)
    memory["lowest_m"] = float(lowest[-1])
    back_m = np.maximum(s.tip_m - lowest, 0.0)
    left = 1.0 - np.clip(gap_m / reach_m, 0.0, 1.0) ** p.get("fading", 1.0)
    if "fading" not in p:
        s.contact_N = s.contact_N - p["force_N"] * np.minimum(back_m / reach_m, 1.0) * left
        return
    deepest_m = np.where(lowest < inf, np.maximum(s.surface_m - lowest, TINY), TINY)
    deepest_N = s.elastic_force_N(deepest_m)
    lacking_N = s.elastic_force_N(s.depth_m) - deepest_N + 1.5 * deepest_N / deepest_m * back_m
    s.contact_N = s.contact_N - np.where(lowest < inf, np.clip(lacking_N, 0.0, p["force_N"] * left), 0.0)


ADHESION = Effect(
    "tissue.adhesion",
    "tissue",
    "the tissue sticks to the probe: it pulls on the probe that leaves",
    (
        # where the range is long, the pull is a quarter of it at most: it still grows when it begins to fade
        Parameter("force_N", "N", 0.0, lambda s: 4.0 * s.range_N, of("force_N", 0.05, 0.2)),
        # over a shorter one, a tip that rises a little as the tissue relaxes would explain the relaxation
        Parameter("range_m", "m", lambda s: 0.03 * s.depth_m, lambda s: s.stroke_m, of("depth_m", 0.2, 0.05), nominal=None, log=True),
        Parameter("fading", "1", 0.5, 8.0, (3.0,), nominal=None, log=True, optional=True, nuisance=True),
    ),
    law=_adhesion,
    formula="f - force · min(up / range, 1) · (1 - gap / range), with up the way from the deepest point, gap the way from the surface",
)

EFFECTS = (SURFACE, MODULUS, PLASTICITY, THICKNESS, INCLUSION, PRECONDITIONING, VISCOELASTIC, ADHESION)
