"""out.json holds to its schema, and the report says on one page, without a network, what out.json says."""

import copy
import json
import re
from dataclasses import replace
from html import unescape as html_text
from importlib.resources import files
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

from palpd.cell.cell_file import nominal
from palpd.cell.effects import EFFECTS
from palpd.errors import BadInput
from palpd.gap import report
from palpd.gap.diagnosis import Diagnosis
from palpd.gap.report import curves_of, page
from tests.gap.test_diagnosis import quick, recording

SCHEMA: dict[str, Any] = json.loads(files("palpd.gap").joinpath("diagnosis.schema.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def healthy() -> Diagnosis:
    return quick(recording(nominal(), {}), nominal())


@pytest.fixture(scope="module")
def rubbing() -> Diagnosis:
    return quick(recording(nominal(), {"cable.friction": {"force_N": 0.1}}), nominal())


@pytest.fixture(scope="module")
def rubbing_page(rubbing: Diagnosis) -> str:
    return page(rubbing.to_json(), curves_of(rubbing), EFFECTS, "<b>evil")


def plain(content: dict[str, Any]) -> dict[str, Any]:
    return dict(json.loads(json.dumps(content)))


def test_the_schema_is_one() -> None:
    jsonschema.Draft202012Validator.check_schema(SCHEMA)


def test_out_json_of_a_healthy_and_of_a_sick_cell_hold_to_the_schema(healthy: Diagnosis, rubbing: Diagnosis) -> None:
    for diagnosis in (healthy, rubbing):
        jsonschema.validate(plain(diagnosis.to_json()), SCHEMA)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda c: c.pop("unexplained"),
        lambda c: c["effects"][0].update(indistinguishable_from=["sensor.gain", "sensor.bias", "sensor.drift"]),
        lambda c: c.update(verdict="none"),
        lambda c: c.update(verdict="ambiguous"),
        lambda c: c.update(p_none=1.2),
        lambda c: c["gap"][0].update(phase="resting"),
    ],
)
def test_the_schema_refuses_what_contradicts_itself(rubbing: Diagnosis, spoil: Any) -> None:
    content = plain(rubbing.to_json())
    spoil(content)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(content, SCHEMA)


def test_the_report_begins_with_the_sentence_of_the_verdict(rubbing: Diagnosis, tmp_path: Path) -> None:
    report.write(tmp_path / "out.html", rubbing, "rubbing.csv")
    html = (tmp_path / "out.html").read_text(encoding="utf-8")
    headline = re.search(r"<h1>(.*?)</h1>", html)
    assert headline is not None
    assert html_text(headline[1]) == rubbing.sentence
    assert rubbing.modulus is not None
    assert rubbing.modulus.sentence in rubbing.sentence
    assert html.index("<h1>") < html.index("<svg")
    assert "Coulomb" in html or EFFECTS["cable.friction"].what in html
    for name, (value, _, _) in rubbing.effects[0].parameters.items():
        assert name in html
        assert f"{value:.4g}" in html


def test_the_report_needs_no_network_and_no_script(rubbing_page: str, healthy: Diagnosis) -> None:
    for html in (rubbing_page, page(healthy.to_json(), curves_of(healthy), EFFECTS, "x")):
        assert not re.search(r"(?:src|href)=\"(?!#)|url\((?!#)|<script|@import|https?://(?!www\.w3\.org)", html)


def test_a_healthy_cell_has_a_report_that_accuses_nobody(healthy: Diagnosis) -> None:
    html = page(healthy.to_json(), curves_of(healthy), EFFECTS, "x")
    assert 'class="none"' in html
    assert "cause found" not in html


def test_a_recording_of_one_phase_without_any_floor_has_a_report(healthy: Diagnosis) -> None:
    curves = curves_of(healthy)
    curves = replace(curves, phase=np.zeros_like(curves.phase))
    assert "mean of 1" in page(healthy.to_json() | {"gap": []}, curves, EFFECTS, "x")


def test_a_group_and_the_next_experiment_are_shown(rubbing: Diagnosis) -> None:
    content = copy.deepcopy(rubbing.to_json())
    content["verdict"] = "ambiguous"
    content["effects"][0]["indistinguishable_from"] = ["cable.viscous", "sensor.hysteresis", "sensor.creep"]
    rows = "\n".join(f"{k / 10},{0.004 if k % 20 < 10 else -0.002}" for k in range(60))
    content["next_experiment"] = {
        "sentence": "Press slowly.",
        "plan": {"hold_s": 20.0},
        "motion_csv": f"t_s,z_cmd_m\n{rows}\n",
        "expected_gain": 3.0,
    }
    html = page(content, curves_of(rubbing), EFFECTS, "x")
    assert "indistinguishable in this recording: cable.viscous, sensor.hysteresis, sensor.creep" in html
    assert "Press slowly." in html
    assert "hold_s: 20.0" in html
    assert "commanded height (mm)" in html


def test_what_a_file_calls_itself_cannot_become_markup(rubbing_page: str) -> None:
    assert "<b>evil" not in rubbing_page
    assert "&lt;b&gt;evil" in rubbing_page


def test_a_report_that_cannot_be_written_is_refused_in_one_sentence(rubbing: Diagnosis, tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="cannot be written"):
        report.write(tmp_path / "absent" / "out.html", rubbing, "x")


def test_every_figure_has_units_at_its_axes_and_the_key_of_its_phases(rubbing_page: str) -> None:
    for words in (
        "time (s)",
        "frequency (Hz)",
        "share of the phase (%)",
        "begin of the cycle (s)",
        "measured − simulated (",
        "loading",
        "holds",
    ):
        assert re.search(rf"<text[^>]*>{re.escape(words)}", rubbing_page), words


def test_the_same_diagnosis_gives_the_same_page(rubbing: Diagnosis, rubbing_page: str) -> None:
    assert page(rubbing.to_json(), curves_of(rubbing), EFFECTS, "<b>evil") == rubbing_page


def test_a_gap_near_the_noise_floor_is_closed_beyond_the_floor(rubbing: Diagnosis) -> None:
    content = copy.deepcopy(rubbing.to_json())
    content["shrink"] |= {"channel": "fz_N", "before_rms": 0.133, "after_rms": 0.130, "noise_floor": 0.131, "closed": 1.0}
    html = page(content, curves_of(rubbing), EFFECTS, "x")
    rows = re.findall(r"<td>(nominal|enriched) cell</td><td>([^<]*)</td><td>([^<]*)</td><td>([^<]*)</td>", html)
    assert rows == [("nominal", "0.133", "0.131", "0.023"), ("enriched", "0.130", "0.131", "0.000")]
    assert "of the gap that noise and tolerances do not explain" in html
