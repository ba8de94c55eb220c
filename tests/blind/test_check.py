"""The blind check: its cells owe nothing to the library, its truths are sealed, and its scores are what they say."""

import ast
import json
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from typer.testing import CliRunner

from palpd.blind.check import make_case, run
from palpd.blind.comparison import load_other_sources
from palpd.blind.detectability import Detectability, fit_strength, nearest_law, scales_of
from palpd.blind.drawn_cases import draw_case
from palpd.blind.drawn_cells import TOLERANCES, Deviations, draw_cell, draw_deviations, draw_motion, no_deviations
from palpd.blind.figures import write_page
from palpd.blind.law_answers import LawOutcome
from palpd.blind.laws import FOREIGN_LAWS, LIBRARY_LAWS, NOVEL_LAWS, CellScales, Law
from palpd.blind.outcome import CaseOutcome, score_case
from palpd.blind.plans import plan, plan_large
from palpd.blind.score import Score, answered, as_markdown, calibration_error, scores, table, tables_by_source
from palpd.blind.simulated_run import rows
from palpd.blind.stated_cell import CHANNELS
from palpd.blind.truth import CASE_KINDS, CaseKind, CaseSpec, SealedCase
from palpd.cell.cell_file import Estimated, cell_from
from palpd.cell.effects import EFFECTS
from palpd.cell.simulation import simulate as library_simulate
from palpd.cli import app
from palpd.cli.blind import FEW_CASES
from palpd.errors import BadInput
from palpd.quantities import wilson

MODULES = ("drawn_cases.py", "drawn_cells.py", "stated_cell.py", "detectability.py", "simulated_run.py", "laws.py")
MEANS = [law for law in LIBRARY_LAWS if not law.variance]


@cache
def nominal_cell() -> tuple[Detectability, CellScales]:
    """A cell of the emulated kind exactly on its numbers, at 500 Hz, and how large things are in it."""
    seed = 0
    while True:
        r = np.random.default_rng([99, seed])
        cell = draw_cell(r)
        motion = draw_motion(r, cell)
        if cell.stated and cell.surface_z_m == 0.0 and cell.rate_Hz == 500.0 and motion.duration_s < 35.0:
            break
        seed += 1
    t_s = np.arange(int(motion.duration_s * cell.rate_Hz)) / cell.rate_Hz
    detectability = Detectability(cell, no_deviations(motion.presses), motion, t_s)
    return detectability, scales_of(detectability)


@cache
def case(kind: CaseKind, *effects: str) -> SealedCase:
    return draw_case(3, CaseSpec("drawn", 8, kind, effects, "20-60"))


@pytest.mark.parametrize("name", MODULES)
def test_the_cells_are_drawn_without_the_library_that_is_judged(name: str) -> None:
    tree = ast.parse(files("palpd.blind").joinpath(name).read_text(encoding="utf-8"))
    imported = {node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    imported |= {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    ours = {module for module in imported if module.startswith("palpd")}
    assert ours <= {"palpd.recording.samples", "palpd.blind.truth", *(f"palpd.blind.{module.removesuffix('.py')}" for module in MODULES)}


def test_every_effect_of_the_library_has_its_own_law_and_another_one() -> None:
    assert {law.effect for law in LIBRARY_LAWS} == set(EFFECTS)
    assert {law.effect for law in FOREIGN_LAWS} == set(EFFECTS)
    assert not {law.effect for law in NOVEL_LAWS} & set(EFFECTS)


@pytest.mark.parametrize("law", [None, *MEANS], ids=lambda law: law.effect if law else "nominal")
def test_two_physics_written_apart_agree_within_what_could_be_known_at_best(law: Law | None) -> None:
    detectability, scales = nominal_cell()
    planted = [(law, law.at(law.draw(np.random.default_rng(1), scales), 1.0))] if law else []
    effects = (
        {law.effect: {p.name: planted[0][1][p.name] for p in EFFECTS[law.effect].parameters if p.name in planted[0][1]}} if law else {}
    )
    nominal = cell_from(detectability.cell.as_yaml(), "cell.yaml").with_effects(effects)
    theirs = library_simulate(nominal, detectability.t_s, z_cmd_m=detectability.motion.at(detectability.t_s))
    ours = rows(detectability.run(planted), detectability.t_s, planted)
    assert detectability.snr(ours - np.column_stack([theirs[name] for name in CHANNELS])) < 1.0


def test_in_tolerance_deviations_mean_the_same_to_both() -> None:
    detectability, _ = nominal_cell()
    drawn = draw_deviations(np.random.default_rng(4), detectability.motion)
    deviations = Deviations(drawn.of, 0.0 * drawn.surface, 0.0 * drawn.stiffness)
    moved = Detectability(detectability.cell, deviations, detectability.motion, detectability.t_s)
    off = {name: value * detectability.cell.tolerances[name] for name, value in deviations.of.items()}
    axes = tuple(off[f"crosstalk_{axis}"] for axis in ("fx", "fy", "tx", "ty"))
    estimated = Estimated(**{name: off[name] for name in TOLERANCES if not name.startswith("crosstalk")}, crosstalk=axes)
    nominal = cell_from(detectability.cell.as_yaml(), "cell.yaml").with_estimated(estimated)
    theirs = library_simulate(nominal, detectability.t_s, z_cmd_m=detectability.motion.at(detectability.t_s))
    change = moved.plain_rows - detectability.plain_rows
    residual = moved.plain_rows - np.column_stack([theirs[name] for name in CHANNELS])
    assert np.linalg.norm(detectability.means(residual)) < 0.03 * np.linalg.norm(detectability.means(change))


def test_what_a_tolerance_can_explain_is_worth_its_own_deviation_and_no_more() -> None:
    detectability, _ = nominal_cell()
    for tangent in detectability.tangents:
        assert detectability.snr(5.0 * tangent) < 5.01
        assert detectability.snr(-tangent) == pytest.approx(detectability.snr(tangent))


def test_the_snr_of_white_noise_sized_changes_is_the_norm_over_means() -> None:
    detectability, _ = nominal_cell()
    change = np.zeros((len(detectability.t_s), 7))
    change[:, CHANNELS.index("tz_Nm")] = 0.1 * detectability.cell.sigmas[-1]  # no tolerance reaches tz
    assert detectability.snr(change) == pytest.approx(0.1 * len(detectability.t_s) ** 0.5, rel=0.01)


def test_every_law_can_be_scaled_to_a_wanted_snr() -> None:
    detectability, scales = nominal_cell()
    missed = []
    for law in (*MEANS, *NOVEL_LAWS):
        fitted = fit_strength(detectability, law, law.draw(np.random.default_rng(2), scales), 12.0)
        if fitted is None or not 0.7 * 12.0 < fitted.snr < 1.3 * 12.0:
            missed.append(law.effect)
    # What this one cell cannot show at all is drawn in another cell.
    assert len(missed) <= 3


def test_a_case_is_the_same_each_time_and_sized_as_ordered() -> None:
    one, other = case("library", "cable.friction"), draw_case(3, CaseSpec("drawn", 8, "library", ("cable.friction",), "20-60"))
    assert np.array_equal(one.samples.wrench, other.samples.wrench)
    assert one.truth == other.truth
    (effect,) = one.truth["effects"]
    assert 20.0 <= effect["snr"] <= 63.0
    assert one.cell["effects"] == {}


def test_no_case_is_on_its_numbers_and_no_two_presses_are_alike() -> None:
    healthy = case("healthy")
    assert all(value != 0.0 for value in healthy.truth["about"]["deviations"].values())
    motion = draw_motion(np.random.default_rng(5), nominal_cell()[0].cell)
    depths = motion.to_m[motion.to_m < nominal_cell()[0].cell.surface_z_m]
    assert len(set(np.round(depths, 7))) == len(depths) == motion.presses


def test_a_case_hides_its_truth_and_is_sealed(tmp_path: Path) -> None:
    recordings, sealed = tmp_path / "recordings", tmp_path / "sealed"
    recordings.mkdir()
    sealed.mkdir()
    spec = next(o for o in plan("drawn", 60, 3) if o.kind == "removed")
    digests = make_case(spec, 3, recordings, sealed)
    assert len(digests) == 5
    shown = "".join(file.read_text(encoding="utf-8") for file in recordings.iterdir() if file.suffix != ".without")
    assert spec.effects[0] not in shown
    assert (recordings / f"{spec.name}.without").read_text(encoding="utf-8") == spec.effects[0]


def test_a_plan_holds_every_kind_in_its_share_and_a_short_one_begins_a_long_one() -> None:
    long = plan("drawn", 1000, 1)
    assert plan("drawn", 200, 1) == long[:200]
    count = {kind: sum(o.kind == kind for o in long) for kind in CASE_KINDS}
    assert count["healthy"] >= 200
    assert count["removed"] + count["novel"] >= 200
    assert {o.effects[0] for o in long if o.kind == "library"} == set(EFFECTS)


NO_LAW: LawOutcome = {
    "kind": None, "accepted": False, "replaces": False, "events": False, "terms": 0, "law": "", "right": False, "right_alike": False,
    "covered": None,
}  # fmt: skip


def outcome(kind: str, planted: list[str], named: list[str], **more: Any) -> CaseOutcome:
    base: CaseOutcome = {
        "source": "drawn",
        "extra": False,
        "steps_over_noise": None,
        "kind": kind,
        "planted": planted,
        "host_causes": [],
        "named": named,
        "groups": [[n] for n in named],
        "verdict": "effects" if named else "none",
        "p": dict.fromkeys(named, 0.9),
        "p_none": 0.05,
        "p_unknown": 0.05,
        "snr": 15.0 if planted else None,
        "snr_per_row_sigma": 5.0 if planted else None,
        "variance": False,
        "mimic": None,
        "failed": None,
        "rate_Hz": 500.0,
        "robot_rate_Hz": 500.0,
        "law": NO_LAW,
    }
    return base | more


@pytest.mark.parametrize(("cases", "table"), [(FEW_CASES - 1, False), (FEW_CASES, True)])
def test_few_cases_are_shown_one_by_one_and_rates_only_of_more(monkeypatch: pytest.MonkeyPatch, cases: int, table: bool) -> None:
    outcomes = [
        outcome("library", ["cable.friction"], ["robot.lag"], case="drawn-000000", closed=0.5, p={"cable.friction": 0.25}),
        *[outcome("healthy", [], [], p_none=0.97) for _ in range(cases - 1)],
    ]
    result = {"tables": {"drawn": []}, "outcomes": outcomes}
    monkeypatch.setattr("palpd.blind.check.run", lambda *_, **__: result)
    printed = CliRunner().invoke(app, ["blind", "--cases", str(cases)]).output
    assert ("| drawn-000000 | cable.friction | 15.0 | robot.lag | 0.25 | 50.0 % |" in printed) != table
    assert ("| drawn | nothing | – | none | 0.97 | – |" in printed) != table
    assert (f"{cases} cases cannot show rates" in printed) != table
    assert ("95 % interval" in printed) == table


def test_scores_count_what_they_say() -> None:
    outcomes = [
        outcome("library", ["cable.friction"], ["cable.friction"]),
        outcome("library", ["cable.friction"], ["cable.friction", "robot.lag"]),
        outcome("library", ["cable.friction"], ["robot.lag"]),
        outcome("library", ["sensor.gain"], ["tissue.modulus"], groups=[["sensor.gain", "tissue.modulus"]]),
        outcome("healthy", [], []),
        outcome("healthy", [], ["robot.lag"]),
        outcome("novel", ["hum"], [], verdict="unknown", mimic={"id": "", "parameters": {}, "snr_left": 30.0}),
        outcome("novel", ["hum"], ["sensor.creep"], mimic={"id": "", "parameters": {}, "snr_left": 5.0}),
        outcome("two", ["cable.friction", "robot.lag"], ["robot.lag", "cable.friction"]),
        outcome("removed", ["sensor.gain"], ["tissue.modulus"], mimic={"id": "", "parameters": {}, "snr_left": 1.0}, family=True),
    ]
    by = {f.what: f for f in scores(outcomes)}
    first = by["right cause first, library laws, SNR 10-20"]
    assert (first.value, first.n) == (pytest.approx(2 / 3), 3)
    assert by["right and nothing else named, library laws, SNR ≥ 10"].value == pytest.approx(1 / 3)
    assert by["truth within the group, all effects, library laws, SNR ≥ 10"].value == 0.75
    assert by["healthy cell kept silent"].value == 0.5
    stranger = by["outside the list, best mimic leaves SNR ≥ 10: called unknown"]
    assert (stranger.value, stranger.n) == (1.0, 1)
    assert by["two effects, both SNR ≥ 10: both named and nothing else"].value == 1.0
    assert by["left out, an indistinguishable effect listed: it is named with its family"].value == 1.0
    assert by["healthy cell kept silent"].met() is None, "two cells are too few for a verdict"


@pytest.mark.parametrize(
    ("right", "n", "target", "met", "word"),
    [
        (49, 49, "≥ 0.97", None, "n < 50"),
        (50, 50, "≥ 0.97", True, "met"),
        (194, 200, "≥ 0.97", True, "met"),
        (193, 200, "≥ 0.97", False, "missed"),
        (6, 200, "≤ 0.03", True, "met"),
        (7, 200, "≤ 0.03", False, "missed"),
        (190, 200, "in 0.93 to 0.97", True, "met"),
        (198, 200, "in 0.93 to 0.97", False, "missed"),
    ],
)
def test_a_target_is_met_if_the_estimate_reaches_it_and_there_are_enough_cases(
    right: int, n: int, target: str, met: bool | None, word: str
) -> None:
    score = Score("share", right / n, wilson(right, n), n, target)
    assert score.met() is met
    missed_by = score.shortfall()
    assert missed_by is not None
    assert (missed_by > 0.0) is (met is False)
    row = table([outcome("healthy", [], [])])[0] | {"value": right / n, "n": n, "target": target, "met": score.met()}
    assert word in as_markdown([row])


def test_the_worst_source_stands_first_and_all_together_last() -> None:
    good = [outcome("healthy", [], [])] * 200
    bad = [outcome("healthy", [], ["robot.lag"], source="mujoco")] * 200
    assert list(tables_by_source(good + bad)) == ["mujoco", "drawn", "all"]
    assert list(tables_by_source(good)) == ["drawn"]


def test_extra_cases_count_in_their_own_line_alone() -> None:
    extra = outcome("library", ["cable.friction"], ["robot.lag"], extra=True, snr=30.0, verdict="unknown")
    by = {score.what: score for score in scores([outcome("library", ["cable.friction"], ["cable.friction"], snr=30.0), extra])}
    assert (by["right cause first, library laws, SNR > 20"].value, by["right cause first, library laws, SNR > 20"].n) == (0.5, 2)
    assert by["known effect called unknown"].n == 1
    specs = plan_large(200, 1)
    assert all(spec.extra and spec.kind == "library" for spec in specs)
    assert not {spec.index for spec in specs} & {spec.index for spec in plan("drawn", 1000, 1)}


def test_cells_with_coarse_steps_count_in_their_own_lines_alone() -> None:
    steps = {"extra": True, "steps_over_noise": (1.0, 4.4, 2.0)}
    coarse = [
        outcome("healthy", [], [], **steps),
        outcome("healthy", [], ["sensor.bias"], **steps),
        outcome("library", ["sensor.bias"], ["sensor.bias", "robot.lag"], **steps),
        outcome("library", ["cable.friction"], ["cable.friction"], snr=30.0, **steps),
    ]
    plain = [outcome("library", ["cable.friction"], ["robot.lag"], snr=30.0), outcome("healthy", [], ["sensor.bias"])]
    by = {score.what: (score.value, score.n) for score in scores(coarse + plain)}
    assert by["coarse steps: healthy cell kept silent"] == (0.5, 2)
    assert by["  one effect of these: truth within the group"] == (1.0, 2)
    assert by["  one effect of these: right and nothing else named"] == (0.5, 2)
    assert by["  one effect of these: called unknown"] == (0.0, 2)
    assert by["healthy cell kept silent"] == (0.0, 1)
    assert by["right cause first, library laws, SNR > 20"] == (0.0, 1)
    assert "| coarse steps: healthy cell kept silent | 50.0 % |" in as_markdown(table(coarse))


def test_the_nearest_law_of_an_exact_change_is_that_law_with_its_parameters() -> None:
    detectability, scales = nominal_cell()
    law = next(law for law in LIBRARY_LAWS if law.effect == "sensor.creep")
    shape = law.at({"ratio": 0.1, "tau_s": 2.0}, 1.0)
    target = detectability.whitened(detectability.change([(law, shape)]))
    nearest = nearest_law(detectability, target, scales, 0, only="sensor.creep")
    assert nearest["id"] == "sensor.creep"
    assert nearest["parameters"] == pytest.approx({"ratio": 0.1, "tau_s": 2.0}, rel=0.05)
    assert nearest["snr_left"] < 0.1 * np.linalg.norm(target)


def test_the_nearest_law_has_the_form_of_the_planted_one() -> None:
    detectability, scales = nominal_cell()
    listed, other = (next(law for law in laws if law.effect == "sensor.asymmetry") for laws in (LIBRARY_LAWS, FOREIGN_LAWS))
    shape = {"ratio": 0.15, "at_N": 0.3 * scales.force_N, "side": -1.0, "width_N": 0.1 * scales.force_N}
    target = detectability.whitened(detectability.change([(other, shape)]))
    same = {name: shape[name] for name in ("ratio", "at_N", "side")}
    left = float(np.linalg.norm(target - detectability.whitened(detectability.change([(listed, same)]))))
    nearest = nearest_law(detectability, target, scales, 0, only="sensor.asymmetry", like=shape)
    assert nearest["parameters"]["side"] == -1.0
    assert nearest["snr_left"] <= left


def test_wilsons_interval_is_the_published_one() -> None:
    # Newcombe 1998, table I: 81 of 263 and 0 of 20.
    assert wilson(81, 263) == (pytest.approx(0.2553, abs=2e-4), pytest.approx(0.3662, abs=2e-4))
    assert wilson(0, 20) == (0.0, pytest.approx(0.1611, abs=2e-4))


def test_an_honest_forecaster_is_calibrated_and_a_boaster_is_not() -> None:
    random = np.random.default_rng(0)
    honest = [outcome("library", ["cable.friction"], ["cable.friction" if random.random() < 0.9 else "robot.lag"]) for _ in range(2000)]
    assert error_of(honest) < 0.03
    boaster = [o | {"p": dict.fromkeys(o["named"], 1.0)} for o in honest]
    assert error_of(boaster) == pytest.approx(0.1, abs=0.03)


def error_of(outcomes: list[CaseOutcome]) -> float:
    return calibration_error([pair for pair in map(answered, outcomes) if pair is not None])


def test_a_small_fixed_check_runs_end_to_end_in_another_process(tmp_path: Path) -> None:
    result = run(3, 76, keep=tmp_path / "kept", resume=tmp_path / "batches.jsonl", calibrated=False)
    again = run(3, 76, resume=tmp_path / "batches.jsonl", calibrated=False, progress=lambda done: None)
    assert json.dumps(again) == json.dumps(result), "what is scored is not run again"
    with pytest.raises(BadInput, match="name another file"):
        run(3, 77, resume=tmp_path / "batches.jsonl")
    assert [o["failed"] for o in result["outcomes"]] == [None] * 3
    by = {o["kind"]: o for o in result["outcomes"]}
    assert by["library"]["named"] == by["library"]["planted"] == ["sensor.saturation"]
    assert by["healthy"]["verdict"] == "none"
    schema = json.loads(files("palpd.gap").joinpath("diagnosis.schema.json").read_text(encoding="utf-8"))
    answers = sorted((tmp_path / "kept").glob("drawn-*/recordings/*.json"))
    assert len(answers) == 3
    for path in answers:
        jsonschema.validate(json.loads(path.read_text(encoding="utf-8")), schema)
    ablated = result | {"ablation": "fz only", "cases": 2, "outcomes": result["outcomes"][:2]}
    page = write_page(json.loads(json.dumps(result)), tmp_path / "docs", [ablated]).read_text(encoding="utf-8")
    assert result["sealed_sha256"] in page
    assert "The first 2 cells of each source once more" in page
    assert "| what | everything | fz only |" in page
    assert "| healthy cell kept silent |" in page
    assert (tmp_path / "docs" / "blind-confusion.png").stat().st_size > 10_000

    planted = result | {"sources": ["injected"], "cases": 2, "outcomes": [{**o, "source": "injected"} for o in result["outcomes"][:2]]}
    other = tmp_path / "injected.json"
    other.write_text(json.dumps(planted))
    others = load_other_sources([other], result["seed"], ["drawn"])
    page = write_page(result, tmp_path / "docs", others=others).read_text(encoding="utf-8")
    assert "- 3 drawn cells, seed" in page
    assert "- 2 injected cells, seed" in page
    with pytest.raises(BadInput, match="the source injected, which is on the page already"):
        load_other_sources([other, other], result["seed"], ["drawn"])
    with pytest.raises(BadInput, match="expected a check of the whole method with seed 8"):
        load_other_sources([other], 8, ["drawn"])


def test_a_case_that_was_not_answered_counts_as_wrong(tmp_path: Path) -> None:
    spec = next(o for o in plan("drawn", 60, 3) if o.kind == "healthy")
    recordings, sealed = tmp_path / "recordings", tmp_path / "sealed"
    recordings.mkdir()
    sealed.mkdir()
    make_case(spec, 3, recordings, sealed)
    outcome = score_case(recordings, sealed, spec)
    assert outcome["failed"] == "no answer"
    assert {score.what: score.value for score in scores([outcome])}["healthy cell kept silent"] == 0.0
