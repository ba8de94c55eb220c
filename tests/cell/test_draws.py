"""Cells that are drawn from what a diagnosis left open vary as it says."""

from math import pi

import numpy as np
import pytest

from palpd.cell.cell_file import CellFile, cell_from, nominal
from palpd.cell.draws import drawn_cells
from palpd.errors import BadInput, ConfigError

LAYER = {
    "probability": 0.7,
    "effects": {"tissue.thickness": {"thickness_m": 0.02}, "contact.lateral": {"ratio": 0.1, "azimuth_rad": 3.1}},
    "estimated": {"youngs_modulus": 0.1, "crosstalk": [0.0, 0.01, 0.0, 0.0]},
    "open": [
        {"name": "tissue.thickness.thickness_m", "scale": "log", "sd": 0.2, "lower": 0.0, "upper": 0.05},
        {"name": "estimated.youngs_modulus", "scale": "log1p", "sd": 0.1},
        {"name": "estimated.fy_per_fz", "sd": 0.002},
        {"name": "contact.lateral.azimuth_rad", "scale": "angle", "sd": 0.3},
    ],
    "correlation": [[1.0, 0.8, 0.0, 0.0], [0.8, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]],
}
INCLUSION = {"probability": 0.3, "effects": {"tissue.inclusion": {"contrast": 2.0, "depth_m": 0.01}}}


def cell() -> CellFile:
    return cell_from({"uncertainty": [LAYER, INCLUSION]}, "cell")


def test_hypotheses_are_drawn_by_their_probability_and_numbers_vary_together() -> None:
    draws = drawn_cells(cell(), 4000, 1)
    layers = [one for one in draws if "tissue.thickness" in one.effects]
    assert len(layers) / len(draws) == pytest.approx(0.7, abs=0.03)
    thickness = np.log([one.effects["tissue.thickness"]["thickness_m"] / 0.02 for one in layers])
    modulus = np.log([(1.0 + (one.estimated.youngs_modulus if one.estimated else 0.0)) / 1.1 for one in layers])
    leak = np.array([one.estimated.crosstalk[1] if one.estimated else 0.0 for one in layers])
    assert thickness.std() == pytest.approx(0.2, rel=0.05)
    assert modulus.std() == pytest.approx(0.1, rel=0.05)
    assert np.corrcoef(thickness, modulus)[0, 1] == pytest.approx(0.8, abs=0.03)
    assert (leak.mean(), leak.std()) == pytest.approx((0.01, 0.002), rel=0.06)
    azimuth = np.array([one.effects["contact.lateral"]["azimuth_rad"] for one in layers])
    assert (azimuth < 0.0).any()
    assert np.abs(azimuth).max() <= pi
    assert all(one.effects == INCLUSION["effects"] for one in draws if one not in layers)
    assert not any(one.uncertainty for one in draws)


def test_a_seed_gives_the_same_cells_again() -> None:
    assert drawn_cells(cell(), 5, 2) == drawn_cells(cell(), 5, 2) != drawn_cells(cell(), 5, 3)


def test_draws_that_cannot_be_made_are_refused_in_one_sentence() -> None:
    with pytest.raises(BadInput, match="0 cells were asked for, expected 1 to 10000"):
        drawn_cells(cell(), 0, 1)
    with pytest.raises(BadInput, match=r"no block `uncertainty`.*palpd diagnose --cell-out"):
        drawn_cells(nominal(), 1, 1)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"correlation": [[1.0]]}, "4 open numbers have a correlation of side 1"),
        ({"effects": {"tissue.thickness": {"thickness_m": 0.02}}}, "open number contact.lateral.azimuth_rad is none of this hypothesis"),
        ({"effects": {"tissue.layer": {}}, "open": [], "correlation": []}, "uncertainty.0.effects: there is no effect 'tissue.layer'"),
    ],
)
def test_an_uncertainty_that_does_not_fit_together_is_refused(change: dict[str, object], sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        cell_from({"uncertainty": [LAYER | change]}, "cell")
