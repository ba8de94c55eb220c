"""Trends: a straight line through moduli over days, with an interval from its scatter."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpd.errors import BadInput
from palpd.history.catalogue import Catalogue, RunFilter
from palpd.history.dates import day_begin_s, day_end_s
from palpd.history.trend import ModulusPoint, change_notes, effect_trend, modulus_trend, slope_of, trend_as_json

DAY_S = 86400.0


def test_a_slope_is_per_day_and_its_interval_holds_the_truth_as_often_as_it_says() -> None:
    rng = np.random.default_rng(1)
    held = 0
    for _ in range(400):
        t_s = np.sort(rng.uniform(0, 30 * DAY_S, 8))
        slope = slope_of(list(zip(t_s, 100.0 + 0.5 * t_s / DAY_S + rng.normal(0, 3.0, 8), strict=True)))
        assert slope is not None
        held += slope.ci95_per_day[0] <= 0.5 <= slope.ci95_per_day[1]
    assert 0.92 < held / 400 < 0.98


def test_an_exact_line_has_an_exact_slope() -> None:
    slope = slope_of([(day * DAY_S, 60.0 - 2.0 * day) for day in range(5)])
    assert slope is not None
    assert slope.per_day == pytest.approx(-2.0)
    assert slope.ci95_per_day == pytest.approx((-2.0, -2.0), abs=1e-6)
    assert (slope.points, slope.days, slope.mean) == (5, pytest.approx(4.0), pytest.approx(56.0))


@pytest.mark.parametrize("points", [[], [(0.0, 1.0)], [(0.0, 1.0), (DAY_S, 2.0)], [(0.0, 1.0), (1.0, 2.0), (2.0, 3.0)]])
def test_too_few_points_or_too_close_ones_have_no_slope(points: list[tuple[float, float]]) -> None:
    assert slope_of(points) is None


def test_the_trend_of_a_site_is_its_moduli_run_by_run(runs: Path) -> None:
    with Catalogue(runs) as catalogue:
        catalogue.refresh()
        points, slopes = modulus_trend(catalogue, "A", RunFilter())
        assert [point.run.name for point in points] == ["day-0", "day-1", "day-2"]
        assert set(slopes) == {"static"}, "the stopped run has no dynamic press"
        assert slopes["static"].points == 3
        assert modulus_trend(catalogue, "A", RunFilter(verdict="done"))[1] == {}
        assert modulus_trend(catalogue, "B", RunFilter()) == ([], {})
        assert effect_trend(catalogue) == {}
        content = trend_as_json("A", points, slopes, {})
        (run, moduli), first = points[0], content["runs"][0]
        assert (first["run"], first["started"], first["moduli"]["static_Pa"]) == ("day-0", run.started, moduli.static_Pa)


def test_a_copy_of_a_recording_is_no_further_evidence_of_a_trend(runs: Path) -> None:
    """Two copies beside two runs made a slope whose interval had no width."""
    for number in range(2):
        shutil.copy(runs / "day-0.mcap", runs / f"copy-{number}.mcap")
    named = {"id": "sensor.bias", "probability": 0.9, "parameters": {"offset_N": {"value": 0.2, "ci95": [0.1, 0.3]}}}
    for run in ("day-0", "day-1", "day-2", "copy-0", "copy-1"):
        (runs / f"{run}.A.diagnosis.json").write_text(json.dumps({"effects": [named]}))
    with Catalogue(runs) as catalogue:
        catalogue.refresh()
        points, slopes = modulus_trend(catalogue, "A", RunFilter())
        ((offsets, slope),) = effect_trend(catalogue, "A").values()
    assert slope is not None
    assert (len(points), slopes["static"].points, len(offsets), slope.points) == (5, 3, 5, 3)


def test_a_trend_over_another_tip_or_model_says_so(runs: Path) -> None:
    with Catalogue(runs) as catalogue:
        catalogue.refresh()
        points, _ = modulus_trend(catalogue, "A", RunFilter())

    def other(point: ModulusPoint, **changes: Any) -> ModulusPoint:
        return point._replace(run=point.run._replace(**changes))

    alike = [other(point, config_sha256="one", model_sha256=None) for point in points]
    assert change_notes(alike) == []
    (note,) = change_notes([*alike[:2], other(alike[2], config_sha256="another")])
    assert "the configuration changed within this trend, last before day-2 (changes: 1)" in note
    assert "palpd report day-2 --beside day-1" in note
    assert len(change_notes([other(alike[0], model_sha256="a model"), *alike[1:]])) == 1
    stiff = other(alike[2], machine_stiffness_N_per_m=48e3, sensor_serial="ISE222")
    assert [note.partition(" changed")[0] for note in change_notes([*alike[:2], stiff])] == ["the stiffness of the machine", "the sensor"]


def test_a_day_is_one_of_this_time_zone_and_what_is_none_is_refused() -> None:
    assert day_end_s("2026-11-22") - day_begin_s("2026-11-22") == pytest.approx(DAY_S)
    for day in ("yesterday", "2026-13-01", "", "22.11.2026", "9999-12-32"):
        with pytest.raises(BadInput, match="the day is"):
            day_begin_s(day)
    with pytest.raises(BadInput):
        day_end_s("9999-12-31")
