"""Stated probabilities: a map that changes nothing changes nothing, a fitted one keeps the order and the sum, and a fit finds it again."""

import numpy as np
import pytest

from benchmarks.calibrate import CHECK_SEED, FIT_SEED, fit, log_loss, pairs_of, report
from palpd.blind.outcome import CaseOutcome
from palpd.blind.score import calibration_error, error_of_a_calibrated_forecaster
from palpd.cell.cell_file import Estimated
from palpd.errors import BadInput
from palpd.gap import diagnosis
from palpd.gap.assumptions import ASSUMED
from palpd.gap.calibration import ProbabilityMap, stored_map
from palpd.testing.plain_cells import cell_of, recording

DOUBTING = ProbabilityMap(power=0.4, doubt=0.1, power_none=3.0, cells=500, how="a test")


def test_the_stored_map_says_on_how_many_cells_it_was_fitted() -> None:
    stored = stored_map()
    assert 0.0 < stored.power <= 1.0
    assert 0.0 <= stored.doubt < 0.5
    assert stored.power_none > 0.0
    assert stored.cells == 0 or stored.cells >= 100
    assert (stored.cells == 0) == (stored == ProbabilityMap())


@pytest.mark.parametrize("p", [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (0.2, 0.3), (1e-200, 1e-12)])
def test_classes_still_add_up_to_one(p: tuple[float, float]) -> None:
    none, unknown = DOUBTING.of_classes(*p)
    assert 0.0 <= none <= 1.0
    assert 0.0 <= unknown <= 1.0
    assert none + unknown <= 1.0 + 1e-12
    assert ProbabilityMap().of_classes(*p) == pytest.approx(p)


def test_no_gap_is_stated_with_more_certainty_than_any_cause() -> None:
    assert DOUBTING.of_classes(0.8, 0.02)[0] == pytest.approx(576.0 / 577.0)
    assert DOUBTING.of_classes(0.0, 1.0)[1] < 0.93


def test_what_decides_stays_where_it_is() -> None:
    assert DOUBTING.of_classes(ASSUMED.naming.p_none_to_acquit, 0.0)[0] == pytest.approx(ASSUMED.naming.p_none_to_acquit)
    tempering = ProbabilityMap(power=0.4, doubt=0.0, power_none=3.0, cells=500, how="a test")
    assert tempering.of_effects({"cable.friction": ASSUMED.naming.p_to_name})["cable.friction"] == pytest.approx(ASSUMED.naming.p_to_name)
    assert tempering.of_classes(0.0, ASSUMED.naming.p_to_name)[1] == pytest.approx(ASSUMED.naming.p_to_name)


def test_a_map_keeps_the_order_of_the_effects_and_leaves_room_for_doubt() -> None:
    marginal = {"cable.friction": 1.0, "robot.lag": 0.7, "sensor.gain": 0.02, "probe.mass": 0.0}
    stated = DOUBTING.of_effects(marginal)
    assert sorted(stated, key=lambda name: -stated[name]) == list(marginal)
    assert 0.89 < stated["cable.friction"] < 0.95
    assert stated["probe.mass"] == 0.0
    assert ProbabilityMap().of_effects(marginal) == pytest.approx(marginal)


def boasting(n: int, right: float) -> list[CaseOutcome]:
    """Answers of probability 0.9999 that are right that often."""
    random = np.random.default_rng(0)
    base: CaseOutcome = {
        "source": "drawn", "extra": False, "kind": "library", "planted": ["cable.friction"], "host_causes": [], "variance": False,
        "snr": 15.0, "snr_per_row_sigma": 5.0, "mimic": None, "rate_Hz": 500.0, "robot_rate_Hz": 500.0, "failed": None,
        "verdict": "effects", "named": [], "groups": [], "p": {}, "p_none": 1e-4, "p_unknown": 0.0,
    }  # fmt: skip
    return [base | {"p": {"cable.friction" if random.random() < right else "robot.lag": 0.9999}} for _ in range(n)]


def test_a_boaster_is_taken_back_to_how_often_it_is_right() -> None:
    outcomes = boasting(1000, 0.85)
    fitted = fit(outcomes, "a test")
    stated = [p for p, _ in pairs_of(outcomes, fitted)]
    assert np.mean(stated) == pytest.approx(0.85, abs=0.03)
    assert log_loss(pairs_of(outcomes, fitted)) < log_loss(pairs_of(outcomes, ProbabilityMap()))
    assert fitted.cells == 1000


def test_three_numbers_are_not_fitted_on_a_handful_of_cells() -> None:
    with pytest.raises(BadInput, match="expected at least 100"):
        fit(boasting(99, 0.9), "a test")


def test_a_report_says_what_the_map_does_to_each_source_and_what_chance_does() -> None:
    text, helps = report(boasting(300, 0.85), DOUBTING)
    assert helps
    assert [line.split("|")[1].strip() for line in text.splitlines()[2:]] == ["drawn", "all"]
    assert not report(boasting(300, 1.0), DOUBTING)[1]


def test_even_a_calibrated_forecaster_has_a_calibration_error_on_few_cases() -> None:
    random = np.random.default_rng(3)
    p = random.uniform(0.3, 1.0, 5000)
    few = p[:20].tolist()
    errors = [calibration_error([(x, bool(random.random() < x)) for x in few]) for _ in range(200)]
    assert np.mean(errors) > 0.1
    assert error_of_a_calibrated_forecaster([(x, True) for x in few]) == pytest.approx(np.mean(errors), rel=0.1)
    assert error_of_a_calibrated_forecaster([(x, True) for x in p.tolist()]) < 0.03


def test_the_cells_to_report_are_others_than_those_to_fit_on() -> None:
    assert FIT_SEED != CHECK_SEED


def test_a_diagnosis_states_what_the_map_makes_of_the_engines_probabilities(monkeypatch: pytest.MonkeyPatch) -> None:
    cell, samples = cell_of("second order"), recording("second order", 5, Estimated(surface_z_m=4e-4))
    own = diagnosis.diagnose([samples], cell, max_bins=600, propose=False, calibrated=False)
    monkeypatch.setattr(diagnosis, "stored_map", lambda: DOUBTING)
    stated = diagnosis.diagnose([samples], cell, max_bins=600, propose=False)
    raw, mapped = own.decision, stated.decision
    assert mapped.candidates == pytest.approx(DOUBTING.of_effects(raw.candidates))
    assert (mapped.p_none, mapped.p_unknown) == pytest.approx(DOUBTING.of_classes(raw.p_none, raw.p_unknown))
    assert (stated.verdict, [e.id for e in stated.effects]) == (own.verdict, [e.id for e in own.effects]) == ("effects", ["tissue.surface"])
    assert [e.probability for e in stated.effects] == [mapped.candidates[e.id] for e in stated.effects]
