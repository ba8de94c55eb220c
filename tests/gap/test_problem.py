"""Predictions of a problem, which do not depend on what was predicted before."""

from dataclasses import replace

import numpy as np

from palpd.gap.data.rounding import rounding_of
from palpd.gap.model.problem import SHARED, make_problem
from palpd.gap.model.workspace import Workspace
from palpd.testing.plain_cells import cell_of, recording


def test_a_fresh_workspace_gives_the_same_predictions() -> None:
    cell, recordings = cell_of("second order"), [recording("second order", 3), recording("second order", 4)]
    problem = make_problem(recordings, cell, max_bins=1200, rounding=rounding_of(0.4, cell, 0.02))
    slow, soft = (np.where(np.array(SHARED) == name, 1.0, 0.0) for name in ("servo_natural_frequency", "youngs_modulus"))
    states = [({}, slow), ({"robot.lag": {"bandwidth_ratio": 0.8}}, soft), ({"sensor.gain": {"error": 0.1}}, soft), ({}, slow)]
    states += [(effects, 0.5 * eta) for effects, eta in states]
    used = [problem.predict(effects, eta) for effects, eta in states]
    for (effects, eta), prediction in zip(reversed(states), reversed(used), strict=True):
        fresh = replace(problem, workspace=Workspace())
        np.testing.assert_array_equal(fresh.predict(effects, eta), prediction)
    assert np.ptp([prediction[3].sum() for prediction in used]) > 1.0
    fewer = problem.without(used[0])
    np.testing.assert_allclose(fewer.data, problem.data - used[0], atol=1e-9 * np.abs(used[0]).max())
