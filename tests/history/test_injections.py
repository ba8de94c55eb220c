"""What injections say of a cell: detection limits, calibration, altered files, and a mark that keeps a run out of all that learns."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpd.compensation.training_data import load_training_data
from palpd.config import Config
from palpd.errors import BadInput, RecordingError
from palpd.gap.commands import read_recording
from palpd.history.catalogue import Catalogue, RunFilter
from palpd.history.facts import load
from palpd.history.injections import (
    ENOUGH,
    Injection,
    detection_limits,
    injection_report,
    injection_sentence,
    keep_injection,
    kept_injections,
    limit_text,
)
from palpd.history.report import page, report_of
from palpd.history.trend import effect_trend
from palpd.recording.mcap_file import RecordingWriter
from palpd.recording.reader import Recording
from palpd.recording.second_channel import SealedAnswer, SecondChannel

NOTHING = SealedAnswer(salt="salt")


def injected(path: Path, source: Path, planted: SealedAnswer = NOTHING) -> Path:
    """The recording of another run, as palpd inject would have written it."""
    run = Recording.load(source)
    writer = RecordingWriter(path, {**run.header, "injection": planted.seal}, second=SecondChannel(planted))
    writer.write(run.rows)
    return writer.close(run.footer)


def of(planted: SealedAnswer, verdict: str = "", *named: str, p: float | None = None, date: str = "2026-11-26") -> Injection:
    return Injection(date, planted.seal, planted, verdict, named, p if p is not None or not verdict else 0.8)


def gain(error: float, named: bool) -> Injection:
    return of(SealedAnswer("sensor.gain", {"error": error}), *(("effects", "sensor.gain") if named else ("none",)))


def test_the_interval_of_a_limit_holds_the_true_one_as_often_as_it_says() -> None:
    rng, held, runs = np.random.default_rng(3), 0, 200
    for _ in range(runs):
        place, spread = rng.uniform(-2.0, -1.0), rng.choice([0.05, 0.1, 0.2, 0.4])
        sizes = rng.uniform(-2.5, -0.5, 12)
        named = rng.random(12) < 1.0 / (1.0 + np.exp((place - sizes) / spread))
        (limit,) = detection_limits([gain(float(10.0**size), bool(each)) for size, each in zip(sizes, named, strict=True)])
        held += (limit.low or 0.0) <= 10.0**place <= (limit.high or np.inf)
    assert 0.91 <= held / runs <= 0.99


def test_a_limit_is_the_size_between_those_that_are_missed_and_those_that_are_named_whatever_its_sign() -> None:
    runs = [gain(error, abs(error) > 0.05) for error in (-0.01, 0.02, 0.03, -0.08, 0.1, -0.3) for _ in range(5)]
    (limit,) = detection_limits([*runs, of(SealedAnswer("sensor.gain", {"error": 0.4})), of(NOTHING, "none")])
    assert (limit.effect, limit.injections, limit.named) == ("sensor.gain", 30, 15)
    assert limit.low is not None
    assert limit.high is not None
    assert 0.03 < limit.low < limit.limit < limit.high < 0.08
    assert limit_text(limit).endswith(") %")


@pytest.mark.parametrize(("named", "words"), [(True, "below "), (False, "above ")])
def test_where_none_is_missed_or_none_is_named_only_one_bound_is_known(named: bool, words: str) -> None:
    (limit,) = detection_limits([gain(error, named) for error in (0.1, 0.2)])
    assert (limit.low is None, limit.high is None) == (named, not named)
    assert limit_text(limit).startswith(words)


def test_of_a_filter_a_longer_period_is_more() -> None:
    slow, fast = (SealedAnswer("sensor.filter", {"cutoff_Hz": cutoff_Hz}) for cutoff_Hz in (1.0, 20.0))
    (limit,) = detection_limits([of(slow, "effects", "sensor.filter"), of(fast, "none")] * 5)
    assert 1.0 / 20.0 < limit.limit < 1.0


BIAS = SealedAnswer("sensor.bias", {"offset_N": -0.25}, "salt")


@pytest.mark.parametrize(
    ("injection", "is_named", "right", "sentence"),
    [
        (of(NOTHING, "none"), True, True, "Planted was nothing; the diagnosis says no gap (0.80): right."),
        (of(NOTHING, "unknown"), False, False, "Planted was nothing; the diagnosis says an unknown cause (0.80): wrong."),
        (of(BIAS, "effects", "sensor.bias"), True, True, "bias (offset of the zero 0.25 N); the diagnosis says sensor.bias (0.80): right."),
        (of(BIAS, "effects", "sensor.bias", "sensor.gain"), True, False, "says sensor.bias and sensor.gain (0.80): wrong."),
        (of(BIAS, "unknown", "sensor.bias"), True, False, "says sensor.bias and an unknown cause (0.80): wrong."),
        (of(BIAS, "effects", "sensor.gain"), False, False, "says sensor.gain (0.80): wrong."),
        (replace(of(BIAS), reason="the run ended stopped: a wall"), False, False, "it was not judged: the run ended stopped: a wall."),
    ],
)  # fmt: skip
def test_an_answer_is_right_where_it_names_what_was_planted_and_nothing_else(
    injection: Injection, is_named: bool, right: bool, sentence: str
) -> None:
    assert (injection.is_named, injection.right) == (is_named, right)
    assert injection_sentence(injection).endswith(sentence)


def test_the_report_counts_what_was_judged_and_puts_the_stated_probability_beside_it(tmp_path: Path) -> None:
    assert injection_report(tmp_path / "absent")["sentences"] == [
        f"Judged: 0 of the {ENOUGH} runs that limits and probabilities of this cell need."
    ]
    kept = [
        of(NOTHING, "none", p=0.9, date="2026-11-24"), of(replace(NOTHING, salt="b"), "unknown", p=0.7, date="2026-11-23"),
        of(BIAS, "effects", "sensor.bias", p=0.8, date="2026-11-22"),
        replace(of(replace(BIAS, salt="d"), date="2026-11-21"), reason="the run was stopped"),
    ]  # fmt: skip
    (tmp_path / "backup").mkdir()  # a copy is no further evidence
    for number, each in enumerate(kept):
        for folder in (tmp_path, tmp_path / "backup"):
            keep_injection(folder / f"{number}-injection.mcap", each)
    assert kept_injections(tmp_path) == kept[::-1]
    report = injection_report(tmp_path)
    assert (report["injections"], report["judged"], report["healthy"], report["silent"], report["right"]) == (4, 3, 2, 1, 2)
    assert report["stated"] == pytest.approx(0.8)
    assert report["right_ci95"][0] < 2 / 3 < report["right_ci95"][1]
    assert report["sentences"][1].startswith("Right in 2 of 3 runs (21 to 94 %); the mean stated probability is 80 %")
    assert [limit["effect"] for limit in report["limits"]] == ["sensor.bias"]
    assert "says no gap (0.90): right" in report["last"]


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("planted", {"effect": "sensor.bias", "parameters": {"offset_N": -0.3}, "salt": "salt"}, "another answer than the one that was"),
        ("seal", "0" * 64, "holds another answer than the one that was sealed"),
        ("probability", None, "holds a verdict or a probability without the other"),
        ("named", 3, "holds no injection"),
    ],
)  # fmt: skip
def test_a_kept_answer_that_was_altered_is_refused(tmp_path: Path, key: str, value: object, words: str) -> None:
    path = keep_injection(tmp_path / "a-injection.mcap", of(BIAS, "effects", "sensor.bias"))
    path.write_text(json.dumps({**json.loads(path.read_text()), key: value}))
    with pytest.raises(BadInput, match=words):
        injection_report(tmp_path)


def test_the_mark_keeps_a_run_out_of_trends_training_and_the_healthy_recordings(runs: Path) -> None:
    before = read_recording(runs / "day-0.mcap", "A")
    path = injected(runs / "day-3-injection.mcap", runs / "day-0.mcap", SealedAnswer("sensor.gain", {"error": 0.3}, "salt"))
    named = [{"id": "sensor.gain", "probability": 0.9, "parameters": {"error": {"value": 0.3, "ci95": [0.2, 0.4]}}}]
    for run in ("day-0", "day-3-injection"):
        (runs / f"{run}.A.diagnosis.json").write_text(json.dumps({"schema": "palpd.diagnosis/1", "verdict": "effects", "effects": named}))
    with Catalogue(runs) as catalogue:
        catalogue.refresh()
        (entry,) = catalogue.runs(RunFilter(kind="injection"))
        assert (entry.name, entry.sites) == ("day-3-injection", ())
        assert [point.run for points, _ in effect_trend(catalogue).values() for point in points] == ["day-0"]
    _, facts = load(path)
    assert (facts["kind"], facts["sites"], facts["verdict"]) == ("injection", [], "done")
    assert "Palpation of palpd inject (no moduli)" in page(report_of(path))
    with pytest.raises(RecordingError, match="from which nothing is learned"):
        load_training_data([path], Config())
    with pytest.raises(RecordingError, match="from which nothing is learned"):
        read_recording(path, "A", learns=True)
    assert (read_recording(path, "A").wrench == before.wrench).all()  # who looks at it sees what the sensor measured
