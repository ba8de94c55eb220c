"""The benchmark of rigs with simulators of their own: what counts as right, and a recording that its own simulator explains."""

from typing import Any

import numpy as np

from benchmarks.own_models import MODELS, healthy_residual
from benchmarks.own_simulators import AGAIN, again, alone, first, identical, recordings, silent


def answer(verdict: str, *groups: tuple[str, ...], effect: str | None = "sensor.gain", value: float = 0.1) -> dict[str, Any]:
    parameters = {"error": {"value": value, "ci95": [0.0, 0.2]}}
    effects = [{"id": ids[0], "indistinguishable_from": list(ids[1:]), "probability": 0.9, "parameters": parameters} for ids in groups]
    return {"verdict": verdict, "effect": effect, "effects": effects}


def test_an_answer_is_right_where_the_truth_or_one_of_its_group_comes_first_and_nothing_else() -> None:
    assert alone(answer("effects", ("sensor.gain",)))
    assert alone(answer("ambiguous", ("tissue.modulus", "sensor.gain")))
    both = answer("effects", ("sensor.gain",), ("cable.spring",))
    assert first(both)
    assert not alone(both)
    assert not first(answer("effects", ("cable.spring",), ("sensor.gain",)))
    assert not first(answer("unknown", ("sensor.gain",)))
    assert not first(answer("none"))
    assert silent(answer("none", effect=None))
    assert not silent(answer("unknown", effect=None))


def test_answers_are_identical_up_to_a_tenth_of_an_interval() -> None:
    one = answer("effects", ("sensor.gain",))
    assert identical(one, answer("effects", ("sensor.gain",), value=0.119))
    assert not identical(one, answer("effects", ("sensor.gain",), value=0.121))
    assert not identical(one, answer("effects", ("cable.spring",)))
    assert not identical(one, answer("unknown", ("sensor.gain",)))


def test_a_healthy_recording_is_what_the_simulator_of_its_rig_predicts_and_noise() -> None:
    assert len(MODELS) == 10
    assert len(recordings()) == 130
    assert len(again()) == AGAIN
    for name in ("foam", "mujoco tendon"):
        residuals = healthy_residual(MODELS[name], seed=3)
        assert 0.95 < residuals["fz_N"] < 1.05, (name, residuals)
        assert np.all(np.array([value for key, value in residuals.items() if "without noise" in key]) < 0.05)
