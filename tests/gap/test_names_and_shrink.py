"""What is named is probable, and the gap before is that of the best cell without the effects."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from palpd.cell.cell_file import CellFile
from palpd.gap.decide import _probable_groups
from palpd.gap.infer.shrink import _without_effects_at_its_modulus
from palpd.gap.model.problem import NOMINAL_ETA, SHARED, Problem, make_problem
from palpd.gap.model.workspace import Workspace
from palpd.testing.plain_cells import cell_of, recording


def groups(
    names: tuple[str, ...], marginal: dict[str, float], alternatives: dict[str, list[str]], sizes: dict[str, float] | None = None
) -> dict[str, list[str]]:
    best = SimpleNamespace(names=names, sizes=sizes or dict.fromkeys(names, 20.0))
    return _probable_groups(best, SimpleNamespace(marginal=marginal, groups=alternatives))


def test_an_improbable_member_of_the_best_set_is_not_named() -> None:
    marginal = {"a": 1.0, "b": 0.85, "c": 0.28}
    assert groups(("a", "b", "c"), marginal, {"a": [], "b": [], "c": []}) == {"a": [], "b": []}


def test_a_weak_effect_beside_a_larger_one_needs_more_to_be_named() -> None:
    marginal, alone = {"a": 1.0, "b": 0.62, "c": 0.05}, {"a": [], "b": ["c"]}
    assert groups(("a", "b"), marginal, alone, {"a": 30.0, "b": 5.0}) == {"a": []}
    assert groups(("a", "b"), marginal, alone, {"a": 30.0, "b": 12.0}) == {"a": [], "b": ["c"]}
    assert groups(("a", "b"), marginal | {"b": 0.85}, alone, {"a": 30.0, "b": 5.0}) == {"a": [], "b": ["c"]}
    assert groups(("b",), marginal, {"b": ["c"]}, {"b": 5.0}) == {"b": ["c"]}


def test_a_group_that_is_probable_together_is_named() -> None:
    marginal = {"a": 0.4, "b": 0.3}
    assert groups(("a",), marginal, {"a": ["b"]}) == {"a": ["b"]}


def test_where_nothing_is_probable_the_likeliest_stands_with_the_next_ones() -> None:
    marginal = {"a": 0.2, "b": 0.2, "c": 0.15, "d": 0.1}
    assert groups(("a",), marginal, {"a": []}) == {"a": ["b", "c"]}


def of_unknown_modulus() -> Problem:
    cell = cell_of("second order").model_dump(exclude_unset=True)
    unknown = CellFile.model_validate(cell | {"tolerances": {"youngs_modulus": 1.0}})
    return make_problem([recording("second order", 101)], unknown, max_bins=600)


def test_an_unknown_modulus_is_fitted_anew_for_the_gap_before() -> None:
    problem = of_unknown_modulus()
    eta = NOMINAL_ETA
    twice = eta + np.where(np.array(SHARED) == "youngs_modulus", np.log(2.0) / problem.shared_sd, 0.0)
    again = _without_effects_at_its_modulus(problem, problem.predict({}, twice), eta)
    assert again == pytest.approx(problem.predict({}, twice), abs=1e-3 * np.abs(again).max())


def test_a_fit_that_runs_away_does_not_raise_the_floor_above_the_readings() -> None:
    problem = of_unknown_modulus()
    calm = problem.with_model_error_floor(problem.data)
    wild = problem.with_model_error_floor(1e6 * problem.data)
    assert wild.noise.sigma[3].max() < 10.0 * calm.noise.sigma[3].max()


def test_the_error_of_the_simulator_counts_in_the_air_and_within_presses_apart() -> None:
    """Where nobody knows the modulus, the gap is the whole contact force: it hides less of a small effect in the air."""
    problem = of_unknown_modulus()
    in_air = problem.per_bin(lambda recording: recording.bin_press) < 0
    floored = problem.with_model_error_floor(np.where(in_air, 0.0, problem.data)).noise.sigma[3]
    added = np.sqrt(floored**2 - problem.noise.sigma[3] ** 2)
    assert 0 < in_air.sum() < len(in_air)
    np.testing.assert_allclose(added[in_air], 0.3 * added[~in_air][0], rtol=1e-6)
    np.testing.assert_allclose(added[~in_air], added[~in_air][0], rtol=1e-6)


def test_the_laws_of_known_effects_are_no_better_known_than_those_of_fitted_ones() -> None:
    problem = of_unknown_modulus()
    known = replace(problem, cell=problem.cell.with_effects({"cable.spring": {"stiffness_N_per_m": 200.0}}), workspace=Workspace())
    nothing = np.zeros_like(problem.data)
    np.testing.assert_array_equal(problem.with_model_error_floor(nothing).noise.sigma, problem.noise.sigma)
    change = known.predict({}, NOMINAL_ETA) - problem.predict({}, NOMINAL_ETA)
    first, second = problem.with_model_error_floor(change), known.with_model_error_floor(nothing)
    np.testing.assert_allclose(second.noise.sigma, first.noise.sigma, rtol=1e-9)
    assert second.noise.sigma[3].max() > 1.1 * problem.noise.sigma[3].max()
