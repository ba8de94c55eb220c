"""The search over sets of effects: each step makes a new state, and the record says what was fitted and when the search ended."""

from functools import cache

from palpd.cell.effects import EFFECTS
from palpd.gap.assumptions import ASSUMED
from palpd.gap.infer.search import SearchState, refine, search
from palpd.gap.infer.settle import NominalFit, settle
from palpd.gap.model.problem import make_problem
from tests.gap.test_rigs import rig

LIBRARY = {name: EFFECTS[name] for name in ("cable.friction", "cable.spring", "sensor.gain", "tissue.modulus")}


@cache
def settled(friction_N: float) -> NominalFit:
    samples, cell = rig(rate_Hz=50.0, friction_N=friction_N)
    return settle(make_problem([samples], cell, LIBRARY, max_bins=300))


@cache
def searched(friction_N: float) -> SearchState:
    return search(settled(friction_N))


def test_pairs_are_fitted_only_where_a_single_effect_beats_none() -> None:
    assert max(len(names) for names in searched(0.2).fits) >= 2
    healthy = searched(0.0)
    assert (
        max(fit.log_evidence for names, fit in healthy.fits.items() if names)
        < healthy.fits[()].log_evidence + ASSUMED.search.further_effect_nats[0]
    )
    assert {len(names) for names in healthy.fits} == {0, 1}


def test_a_step_leaves_the_state_before_it_as_it_was() -> None:
    before = searched(0.2)
    fits = dict(before.fits)
    after = refine(before, size=1, most=1)
    assert before.fits == fits
    assert after.fits.keys() == fits.keys()
