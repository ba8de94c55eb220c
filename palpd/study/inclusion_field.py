"""An emulated field to be mapped: plain tissue with one hard inclusion at an unknown place.

Pressed by the emulated cell with the paper's sensor (`press`, the fastest), or as a cell file that the daemon presses (`cell`).
"""

import math

import numpy as np

from palpd.analysis.stiffness_map import Field
from palpd.analysis.young import modulus_peak_Pa
from palpd.cell.cell_file import CellFile, CellSite, TissueBlock
from palpd.cell.motion_profile import Move, commanded_heights
from palpd.study.laboratory import STEP_S, setup, take

INCLUSION_DEPTH_M = 0.005
REST_M = 0.004
HOLD_S = 1.5
STIFFNESS_SIGMA, SURFACE_SIGMA_M = 0.01, 2e-5
"""From press to press, as a cell file's repeatability says."""
FELT = 0.002
"""Contrast below which a place is as good as plain."""
EFFECTS = {"tissue.viscoelastic": {"ratio": 0.2, "tau_s": 0.3}, "sensor.bias": {"offset_N": 0.19}}


class EmulatedField:
    """`inclusion` is the true centre (x, y) and radius in m, or None; `press` gives the modulus of equation 1 at a place.

    Over the middle the tissue stiffens as the cell's inclusion does; aside the contrast falls off like a bump whose width is half the
    inclusion and half the contact. Stiffness and surface scatter from press to press as a cell file's repeatability says.
    """

    def __init__(self, where: Field, seed: int, *, contrast: float | None = None) -> None:
        self._field, self._seed, self._presses = where, seed, 0
        rng = np.random.default_rng([seed, 3])
        self.youngs_modulus_Pa = float(rng.uniform(4e4, 1.2e5))
        margin_m = where.inclusion_m / 2.0
        centre = rng.uniform([margin_m, margin_m], [where.width_m - margin_m, where.height_m - margin_m])
        self.contrast = float(rng.uniform(1.0, 3.0)) if contrast is None else contrast
        self.inclusion = (float(centre[0]), float(centre[1]), where.inclusion_m / 2.0) if self.contrast > 0.0 else None

    def press(self, place_m: tuple[float, float]) -> float:
        """Rest, press, hold; force of the hold less that of the rest. Pa."""
        self._presses += 1
        rng = np.random.default_rng([self._seed, 4, self._presses])
        effects = EFFECTS | {"tissue.inclusion": {"contrast": self.contrast_at(place_m), "depth_m": INCLUSION_DEPTH_M}}
        modulus_Pa = self.youngs_modulus_Pa * (1.0 + rng.normal(0.0, STIFFNESS_SIGMA))
        cell = setup("A").model_copy(update={"tissue": TissueBlock(youngs_modulus_Pa=modulus_Pa), "effects": effects})
        depth_m = self._field.depth_m
        z_cmd_m, spans = commanded_heights(
            REST_M, [Move(REST_M, 0.02, 0.5), Move(rng.normal(0.0, SURFACE_SIGMA_M) - depth_m, 0.02, HOLD_S)], STEP_S
        )
        run = take(cell, z_cmd_m, int(rng.integers(2**31)))
        rest, held = slice(50, spans[0][1]), slice(len(run.t_s) - 250, len(run.t_s))
        force_N = float(run.fz_N[held].mean()) - float(run.fz_N[rest].mean())
        return modulus_peak_Pa(force_N, depth_m, self._field.tip_radius_m, 0.5)

    def contrast_at(self, place_m: tuple[float, float]) -> float:
        """How much stiffer a deep press is there; a bump around the inclusion."""
        if self.inclusion is None:
            return 0.0
        return self.contrast * math.exp(-0.5 * (math.dist(place_m, self.inclusion[:2]) / self._field.length_m) ** 2)

    def cell(self, press: int) -> CellFile:
        """The whole field as a cell: a site of its own at each place of the map's grid that feels the inclusion, plain tissue elsewhere.

        `press` draws the scatter from press to press.
        """
        rng = np.random.default_rng([self._seed, 4, press])
        tissue = TissueBlock(
            youngs_modulus_Pa=self.youngs_modulus_Pa * (1.0 + rng.normal(0.0, STIFFNESS_SIGMA)),
            surface_z_m=rng.normal(0.0, SURFACE_SIGMA_M),
        )
        places = [(0.0, 0.0), *(place for place in self._field.grid().tolist() if self.contrast_at(place) > FELT)]
        sites = tuple(
            CellSite(
                name=f"{number}",
                x_m=x_m,
                y_m=y_m,
                tissue=tissue,
                effects={"tissue.inclusion": {"contrast": self.contrast_at((x_m, y_m)), "depth_m": INCLUSION_DEPTH_M}},
            )
            for number, (x_m, y_m) in enumerate(places)
        )
        cell = CellFile.model_validate({"sensor": {"rate_Hz": 1000.0}})
        return cell.model_copy(update={"tissue": tissue, "effects": EFFECTS, "sites": sites})
