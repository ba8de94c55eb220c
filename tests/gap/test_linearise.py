"""The nuisances of a hypothesis: what its effects stand for is no nuisance, and everything else stays one."""

import numpy as np
import pytest

from palpd.cell.cell_file import CellFile, EffectValues, Estimated
from palpd.gap.diagnosis import diagnose
from palpd.gap.model.linearise import linearise
from palpd.gap.model.problem import NOMINAL_ETA, SHARED, Problem, make_problem
from palpd.recording.samples import Samples
from palpd.testing.plain_cells import cell_of, recording


@pytest.fixture(scope="module")
def problem() -> Problem:
    return make_problem([recording("second order", 3)], cell_of("second order"), max_bins=400)


@pytest.mark.parametrize(
    ("effects", "deviation"),
    [({"tissue.modulus": {"ratio": 1.15}}, "youngs_modulus"), ({"tissue.surface": {"offset_m": 1e-4}}, "surface_z_m")],
)
def test_an_effect_on_all_presses_keeps_their_scatter(problem: Problem, effects: EffectValues, deviation: str) -> None:
    nominal, there = linearise(problem, {}, NOMINAL_ETA), linearise(problem, effects, NOMINAL_ETA)
    assert not there.space.columns.dense()[SHARED.index(deviation)].any()
    assert [label for label in there.labels if label.scope == "press"] == [label for label in nominal.labels if label.scope == "press"]
    scatter, stated = (np.abs(one.space.columns.dense()[one.numbers("press")]).max(axis=(1, 2)) for one in (there, nominal))
    assert scatter == pytest.approx(stated, rel=0.3)


@pytest.fixture
def stiff() -> tuple[Samples, CellFile]:
    return recording("second order", 4, Estimated(gain=0.12)), cell_of("second order")


def test_a_wrong_gain_is_not_taken_for_a_wrong_modulus_with_certainty(stiff: tuple[Samples, CellFile]) -> None:
    samples, cell = stiff
    answer = diagnose([samples], cell, max_bins=900, propose=False)
    names = {name for effect in answer.effects for name in (effect.id, *effect.indistinguishable_from)}
    assert "sensor.gain" in names


def test_the_interval_of_an_effect_holds_the_tolerance_that_it_stands_for() -> None:
    cell = cell_of("second order")
    answer = diagnose([recording("second order", 5, Estimated(surface_z_m=4e-4))], cell, max_bins=900, propose=False)
    offset_m, low_m, high_m = answer.effects[0].parameters["offset_m"]
    assert answer.effects[0].id == "tissue.surface"
    assert low_m < 4e-4 < high_m
    assert min(offset_m - low_m, high_m - offset_m) >= 1.96 * cell.tolerances.surface_z_m
