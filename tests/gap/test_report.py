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
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from markupsafe import Markup

from palpd.cell.cell_file import nominal
from palpd.cell.effects import EFFECTS, Effect, Parameter
from palpd.cli.tables import diagnosis_lines
from palpd.errors import BadInput
from palpd.gap.diagnosis import Diagnosis
from palpd.gap.plain import plain_answer
from palpd.gap.report import figures
from palpd.gap.report.figures import Curves
from palpd.gap.report.page import curves_of, page, write
from palpd.gap.report.sketch import sketch
from palpd.quantities import quantity
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


def first_screen(html: str) -> str:
    """The text of a report above its first large figure."""
    return html_text(re.sub(r"<[^>]*>", "", html[html.index("<header>") : html.index("Measured and simulated")]))


def test_the_report_begins_with_the_answer_its_causes_in_plain_words_and_what_to_do_next(rubbing: Diagnosis, tmp_path: Path) -> None:
    write(tmp_path / "out.html", rubbing, "rubbing.csv")
    html = (tmp_path / "out.html").read_text(encoding="utf-8")
    assert "<h1>The gap has one cause: something rubs.</h1>" in html
    text = first_screen(html)
    assert rubbing.modulus is not None
    for words in (
        rubbing.modulus.sentence,
        "Something rubs: a force of constant size acts against the motion.",
        "90 of 100 such answers are right.",
        "vertical force (fz)",
        "fz is the vertical force",
        "With this cause the simulator agrees with cycles not used for the fit, to within the noise",
        "Do this next",
        "palpd analyse RECORDING --cell enriched.yaml",
    ):
        assert words in text, words
    ((name, (value, low, high)),) = rubbing.effects[0].parameters.items()
    assert f"Force {name}: {quantity(value, 'N', (low, high))}." in text
    assert "100 %" not in text
    assert html.index("Do this next") < html.index("Something rubs: a force")
    assert html.count('class="sketch"') == 1


def test_everything_but_the_answer_and_the_curves_is_folded_and_opens_on_paper(rubbing_page: str) -> None:
    folded = [html_text(title) for title in re.findall(r'<details class="fold"><summary><h2>(.*?)</h2>', rubbing_page)]
    assert "All candidate causes" in folded
    assert "Where the gap is" in folded
    assert re.findall(r"<section[^>]*><h2>(.*?)</h2>", rubbing_page) == ["Do this next", "Measured and simulated vertical force (fz)"]
    assert "<details open" not in rubbing_page
    assert re.search(r"@media print\{[^@]*::details-content\{content-visibility:visible", rubbing_page)


def test_the_report_needs_no_network_and_no_script(rubbing_page: str, healthy: Diagnosis) -> None:
    for html in (rubbing_page, page(healthy.to_json(), curves_of(healthy), EFFECTS, "x")):
        assert not re.search(r"(?:src|href)=\"(?!#)|url\((?!#)|<script|@import|https?://(?!www\.w3\.org)", html)


def test_a_healthy_cell_has_a_report_that_accuses_nobody(healthy: Diagnosis) -> None:
    html = page(healthy.to_json(), curves_of(healthy), EFFECTS, "x")
    assert 'class="none"' in html
    assert "cause found" not in html
    assert "Nothing: no gap was found." in first_screen(html)


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
    assert "Press slowly." in html
    text = first_screen(html)
    assert "This recording leaves open what causes the gap: something rubs or one of 3 others." in text
    assert (
        "This recording cannot distinguish it from: something drags (cable.viscous); the sensor has hysteresis (sensor.hysteresis)" in text
    )
    assert "Press slowly: that should decide." in text
    assert "hold_s: 20.0" in html
    assert "commanded height (mm)" in html


def test_what_a_file_calls_itself_cannot_become_markup(rubbing_page: str) -> None:
    assert "<b>evil" not in rubbing_page
    assert "&lt;b&gt;evil" in rubbing_page


def test_a_report_that_cannot_be_written_is_refused_in_one_sentence(rubbing: Diagnosis, tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="cannot be written"):
        write(tmp_path / "absent" / "out.html", rubbing, "x")


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


def test_a_gap_near_the_noise_floor_is_said_with_both_sizes_and_no_percentage(rubbing: Diagnosis) -> None:
    content = copy.deepcopy(rubbing.to_json())
    content["shrink"] |= {"channel": "fz_N", "before_rms": 0.133, "after_rms": 0.130, "noise_floor": 0.131, "closed": 1.0}
    text = first_screen(page(content, curves_of(rubbing), EFFECTS, "x"))
    assert "to within the noise: 0.13 N rms, 0.13 N without." in text
    assert "%" not in text.replace("95 %", "").replace(rubbing.modulus.sentence if rubbing.modulus else "", "")


@pytest.mark.parametrize(
    ("closed", "ci95", "after_N", "words"),
    [
        (1.0, [1.0, 1.0], 0.0501, "With this cause the simulator agrees with cycles, to within the noise: 0.05 N rms, 1 N without."),
        (
            0.56,
            [0.0, 0.67],
            0.7,
            "With this cause 56 % (0 to 67 %) of the gap closes on cycles: from 1 N to 0.7 N rms, with noise of 0.05 N. What remains is 14 "
            "times the noise: this is not the whole answer.",
        ),
        (0.9, None, 0.2, "With this cause 90 % of the gap closes on cycles: from 1 N to 0.2 N rms, with noise of 0.05 N."),
        (0.998, None, 0.07, "With this cause 99 % of the gap closes on cycles: from 1 N to 0.07 N rms, with noise of 0.05 N."),
        (-0.59, [-1.0, 0.1], 1.3, "With this cause the simulator comes no nearer to cycles."),
        (None, None, 1.0, ""),
    ],
)
def test_how_far_a_gap_closes_is_said_as_exactly_as_it_is_known(
    rubbing: Diagnosis, closed: float | None, ci95: list[float] | None, after_N: float, words: str
) -> None:
    shrink = {
        "channel": "fz_N",
        "before_rms": 1.0,
        "after_rms": after_N,
        "noise_floor": 0.05,
        "closed": closed,
        "ci95": ci95,
        "on": "cycles",
    }
    assert plain_answer(rubbing.to_json() | {"shrink": shrink}, EFFECTS)["closed"] == words


def test_what_makes_an_answer_doubtful_stands_above_it_and_first_of_what_to_do(rubbing: Diagnosis) -> None:
    content = rubbing.to_json() | {"decisive": ["fz_N is dead."], "notes": ["fz_N is dead."]}
    html = page(content, curves_of(rubbing), EFFECTS, "x")
    assert 0 < html.index("fz_N is dead.") < html.index("<h1>")
    assert "First clear up what stands above the answer" in plain_answer(content, EFFECTS)["steps"][0][0]
    assert html.count("fz_N is dead.") == 1


def test_every_effect_of_the_library_says_in_plain_words_what_it_is_and_how_it_shows() -> None:
    for effect in EFFECTS.values():
        cause, _, sign = effect.what.partition(": ")
        assert cause, effect.id
        assert len(sign.split()) > 3, effect.id
        assert len(effect.what.split()) <= 30, effect.id
        assert not re.search(r"[·=τ]|\bf[xyz]\b", effect.what), effect.id


def test_a_sketch_of_every_effect_shows_its_own_simulation_and_on_the_side_that_was_found() -> None:
    drawn = {name: sketch(effect, {}) for name, effect in EFFECTS.items()}
    assert all(svg.count("<polyline") == 2 for svg in drawn.values())
    assert len(set(drawn.values())) == len(drawn)

    def last_height(svg: str) -> float:
        return float(re.findall(r"[\d.]+,([\d.]+)", svg.split("<polyline")[2])[-1])

    gain = EFFECTS["sensor.bias"]
    assert last_height(sketch(gain, {"offset_N": 0.01})) < last_height(sketch(gain, {"offset_N": -0.01}))


def test_an_axis_that_alone_is_noisy_is_unknown_and_said_where_and_a_quiet_one_is_no_gap() -> None:
    samples = recording(nominal(), {})
    wrench = samples.wrench.copy()
    wrench[:, 3:5] *= 0.25
    wrench[:, 4] = np.rint(wrench[:, 4] / 1e-3) * 1e-3
    quiet = quick(replace(samples, wrench=wrench), nominal())
    assert quiet.verdict == "none", quiet.sentence
    wrench = samples.wrench.copy()
    wrench[:, 1] += 0.1 * np.random.default_rng(4).standard_normal(len(samples))
    noisy = quick(replace(samples, wrench=wrench), nominal())
    content = noisy.to_json()
    assert noisy.verdict == "unknown"
    assert (content["unexplained"]["channel"], content["where"]["channel"]) == ("fy_N", "fy_N")
    assert content["unexplained"]["rms"] == pytest.approx(0.1, rel=0.2)
    assert "force along y" in content["plain"]["where"]
    assert any("fy_N alone" in note for note in content["notes"])
    assert "force along y (fy)</h2>" in page(content, curves_of(noisy), EFFECTS, "x")


def test_a_user_effect_is_described_by_its_own_words_and_one_that_fails_costs_its_sketch_only(rubbing: Diagnosis) -> None:
    def fails(*_: object) -> None:
        raise RuntimeError

    mine = Effect("tissue.pulse", "tissue", "the force beats with a pulse", (Parameter("share", "1", 0.0, 1.0, (0.1,)),), law=fails)
    content = copy.deepcopy(rubbing.to_json())
    content["effects"] = [rubbing.effects[0].to_json() | {"id": mine.id, "parameters": {"share": {"value": 0.5, "ci95": [0.4, 0.6]}}}]
    html = page(content, curves_of(rubbing), EFFECTS | {mine.id: mine}, "x")
    assert "<h1>The gap has one cause: the force beats with a pulse.</h1>" in html
    assert "0.500 (0.400 to 0.600)" in first_screen(html)
    assert 'class="sketch"' not in html


LAW: dict[str, Any] = {
    "id": "learned.one_of_height", "what": "an added force that repeats every 4.98 mm of height", "site": "probe", "family": None,
    "channels": {"fz_N": 1.0}, "factor": "one", "driver": "the height of the probe, repeating every 4.98 mm", "driver_unit": "m",
    "formula": "0.1 * sin(2*pi*x/0.00498)", 
    "curve": {"x": [0.0, 0.002, 0.00498], "value": [0.0, 0.1, 0.0], "low": [-0.1] * 3, "high": [0.2] * 3},
    "range": [0.0, 0.00498], "held_out_nats": [3.0], "nats": 30.0,
    "data": {"x": [0.001, 0.003], "before": [0.1, -0.1], "after": [0.0, 0.0], "sd": [0.01, 0.02]},
    "probability": 0.9, "alike": ["curve of the time since the start"], "replaces_listed": False, "file": None, "confounds": {},
    "further_terms": [],
}  # fmt: skip
TABLE = LAW | {
    "formula": None,
    "factor": "force",
    "driver": "the depth of the press",
    "channels": {"fx_N": 0.6, "fy_N": 0.8, "tx_Nm": 0.06},
}
LAWS = [
    None,
    LAW,
    LAW | {"further_terms": [TABLE]},
    TABLE,
    LAW | {"factor": "surface"},
    LAW | {"channels": {"z_m": 1.0}, "driver_unit": "m/s"},
]
KINDS = (("fz_N", "step"), ("tx_Nm", "pulse"), ("fy_N", "burst"), ("fz_N", "fall of the contact force"), ("fz_N", "other"))
EVENTS = [None, [{"recording": 0, "t_s": 1.0, "channel": channel, "size": 0.3, "kind": kind} for channel, kind in KINDS]]
NAMES = [
    [], [("cable.friction", [])], [("tissue.viscoelastic", ["sensor.creep"]), ("clock.skew", [])],
    [("sensor.gain", ["tissue.modulus"] * 4)],
    [("user.unknown", ["user.other"])], [("sensor.noise", []), ("sensor.asymmetry", []), ("probe.tilt", ["contact.lateral"])],
]  # fmt: skip
PROPOSED = {
    "sentence": "Press slowly (8 s) and diagnose both recordings jointly. It decides.",
    "plan": {},
    "motion_csv": "out.next.csv",
    "expected_gain": 2.0,
}


def named(name: str, others: list[str]) -> dict[str, Any]:
    """An entry of `effects` with odd values of all parameters."""
    parameters = EFFECTS[name].named_parameters if name in EFFECTS else (Parameter("share", "1", 0.0, 1.0, (0.1,)),)
    odd = [(0.0, 0.0, 0.0), (1e-9, -1e300, float("inf")), (-3.0, -4.0, -2.0)]
    values = {p.name: dict(zip(("value", "ci95"), (odd[k % 3][0], list(odd[k % 3][1:])), strict=True)) for k, p in enumerate(parameters)}
    bound = [parameters[0].name]
    return {"id": name, "probability": 0.6, "parameters": values, "indistinguishable_from": others, "family": None, "at_bound": bound}


@pytest.mark.parametrize(("examples", "drawn"), [(60, False), (4, True)])
def test_whatever_an_answer_holds_it_has_a_report_and_lines_for_the_terminal(
    rubbing: Diagnosis, monkeypatch: pytest.MonkeyPatch, examples: int, drawn: bool
) -> None:
    if not drawn:  # to lay a figure out and write it takes nearly all of the time
        monkeypatch.setattr(figures, "inline_svg", lambda *_: Markup("<svg></svg>"))
    whole, curves = rubbing.to_json(), short_curves(rubbing)

    @settings(max_examples=examples, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
    @given(data=st.data())
    def holds(data: st.DataObject) -> None:
        content = copy.deepcopy(whole)
        channel, phase = (data.draw(st.sampled_from(values)) for values in (("fz_N", "z_m", "tx_Nm"), ("holding", "free_still")))
        shrink = content["shrink"] | {"channel": channel, "closed": data.draw(st.sampled_from([None, -1.0, 0.0, 0.5, 1.0]))}
        content |= {
            "verdict": data.draw(st.sampled_from(["effects", "none", "unknown", "ambiguous"])),
            "effects": [named(*each) for each in data.draw(st.sampled_from(NAMES))],
            "learned": data.draw(st.sampled_from(LAWS)),
            "events": data.draw(st.sampled_from(EVENTS)),
            "where": data.draw(st.sampled_from([None, {"channel": channel, "phase": phase}])),
            "unexplained": data.draw(st.sampled_from([None, {"channel": "ty_Nm", "phase": "loading", "rms": 0.001}])),
            "shrink": shrink | {"ci95": data.draw(st.sampled_from([None, [0.0, 1.0]]))},
            "modulus": data.draw(st.sampled_from([None, content["modulus"], content["modulus"] | {"far": True}])),
            "next_experiment": data.draw(st.sampled_from([None, PROPOSED])),
            "gap": data.draw(st.sampled_from([[], content["gap"]])),
            "trend": data.draw(st.sampled_from([[], content["trend"]])),
            "candidates": data.draw(st.sampled_from([[], content["candidates"]])),
            "decisive": data.draw(st.sampled_from([[], ["fz_N is dead."]])),
        }
        content["plain"] = plain_answer(content, EFFECTS)
        html = page(content, curves, EFFECTS, "x")
        assert html.endswith("</html>")
        assert html_text(re.findall(r"<h1>(.*?)</h1>", html)[0]) == content["plain"]["answer"]
        assert "Do this next" in html
        assert all(diagnosis_lines(content))
        assert not re.search(r"\b(nan|None|inf)\b", first_screen(html))

    holds()


def short_curves(diagnosis: Diagnosis) -> Curves:
    """The curves of a diagnosis, with so few samples that a figure is quick."""
    whole = curves_of(diagnosis)
    arrays = {name: getattr(whole, name)[::40] for name in ("t_s", "phase", "cycle", "measured", "nominal", "enriched")}
    return replace(whole, **arrays)
