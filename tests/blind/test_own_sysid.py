"""The benchmark beside `mujoco.sysid`: what an answer of sysid names, and that its parameters act like the effects of the rigs."""

from typing import Any

import numpy as np
import pytest

from benchmarks.own_models import MODELS

pytest.importorskip("absl", reason="mujoco.sysid needs mujoco[sysid]")
own_sysid = pytest.importorskip("benchmarks.own_sysid")
rollout = pytest.importorskip("benchmarks.own_sysid_rollout")
ALONE, JOINT = "alone, BIC", "joint"


def answer(way: str, *, effect: str | None = "sensor.gain", alike: tuple[tuple[str, str], ...] = (), **scores: float) -> dict[str, Any]:
    of_names = {name.replace("_", " "): score for name, score in scores.items()}
    return {"model": "mujoco soft ball", "effect": effect, way: of_names, "alike": alike}


def test_the_candidate_with_the_highest_score_is_named_from_the_threshold_on() -> None:
    row = answer(JOINT, sensor_gain=6.0, body_mass=4.0)
    assert own_sysid.group(row, JOINT, 5) == {"sensor.gain"}
    assert own_sysid.group(row, JOINT, 7) == set()
    assert own_sysid.is_right(row, JOINT, 5)
    assert not own_sysid.is_right(row, JOINT, 7)
    assert own_sysid.is_right(row | {"effect": None}, JOINT, 7)


def test_candidates_that_fit_as_well_share_the_first_place() -> None:
    alike = (("body mass", "sensor gain"), ("body mass", "joint damping"))
    assert own_sysid.group(answer(JOINT, alike=alike, sensor_gain=6.0, body_mass=4.0), JOINT, 5) == {"sensor.gain", "probe.mass"}
    near = answer(ALONE, stiffness_polynomial=900.0, sensor_gain=872.0, body_mass=860.0)
    assert own_sysid.group(near, ALONE, 10) == {"tissue.thickness", "tissue.inclusion", "sensor.gain"}


def test_the_threshold_is_the_best_one_for_sysid() -> None:
    rows = [answer(JOINT, sensor_gain=30.0), answer(JOINT, sensor_gain=12.0, effect=None), answer(JOINT, sensor_gain=15.0, effect=None)]
    assert own_sysid.best_threshold(rows, JOINT) == 20


def test_what_no_candidate_stands_for_cannot_be_expressed() -> None:
    assert own_sysid.expressible(answer(JOINT, effect="tissue.inclusion"))
    assert not own_sysid.expressible(answer(JOINT, effect="sensor.hysteresis"))


def test_a_fit_finds_a_planted_mass() -> None:
    model = MODELS["winkler bed"]
    columns = model.record(None, 3).columns
    simulator = rollout.Rollout(model.rig, rollout.palpd.tip_motion(columns, model.cell))
    columns["fz_N"] = columns["fz_N"] + (simulator.readings({"body mass": np.array([0.2])}) - simulator.readings({}))[:, 0]
    fitter = own_sysid.Fitter(model.rig, columns)
    fitted, _, residual = fitter.fit(fitter.parameters({"body mass": False, "tissue stiffness": False}))
    assert fitted["body mass"].value[0] == pytest.approx(0.2, abs=0.03)
    assert fitted["tissue stiffness"].value[0] == pytest.approx(0.0, abs=0.05)
    assert np.mean(residual**2) < 2
