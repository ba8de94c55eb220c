"""A law that no listed effect is: found by what it is a function of, kept apart from events and noise, and put into the simulator."""

import json
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jsonschema
import numpy as np
import pytest
import yaml
from scipy.stats import multivariate_normal

from palpd.cell.cell_file import nominal
from palpd.cell.effects import load_effects
from palpd.cell.effects.drivers import WORDS, Driver
from palpd.cell.simulation import simulate
from palpd.gap.assumptions import ASSUMED
from palpd.gap.commands import simulate_file, write_answer
from palpd.gap.data.rounding import Rounding
from palpd.gap.decide import BeyondList, _beyond_list
from palpd.gap.diagnosis import Diagnosis
from palpd.gap.gaussian.evidence import group_evidence
from palpd.gap.gaussian.nuisance_space import NuisanceSpace
from palpd.gap.gaussian.nuisances import Columns
from palpd.gap.laws import learned
from palpd.gap.laws.bases import hats, powers
from palpd.gap.laws.evidence import LawEvidence, SoughtLaw, leading_leaves
from palpd.gap.laws.formulas import formulas_of
from palpd.gap.laws.held_out import held_out, spread_over_folds
from palpd.gap.laws.search import search
from palpd.gap.report.page import curves_of, page
from palpd.tick import Floats
from tests.gap.test_diagnosis import heights, quick, recording

SCHEMA: dict[str, Any] = json.loads(files("palpd.gap").joinpath("diagnosis.schema.json").read_text(encoding="utf-8"))
RAIL_N, RAIL_M, WIDTH_M = 0.15, 0.006, 0.0012


def rail_N(z_m: Floats) -> Floats:
    """A soft stop that pushes at one height of the rail."""
    return np.asarray(RAIL_N * np.exp(-0.5 * ((z_m - RAIL_M) / WIDTH_M) ** 2))


def with_force(change_N: Floats, seed: int = 3) -> Diagnosis:
    """The diagnosis of a healthy cell with a further force on fz."""
    samples = recording(nominal(), {}, seed)
    wrench = samples.wrench.copy()
    wrench[:, 2] += change_N
    return quick(replace(samples, wrench=wrench), nominal())


@pytest.fixture(scope="module")
def rail() -> Diagnosis:
    return with_force(rail_N(recording(nominal(), {}).z_m))


def test_a_law_outside_the_list_is_named_by_its_driver_and_formula(rail: Diagnosis) -> None:
    content = rail.to_json()
    assert content["verdict"] == "unknown"
    learned = content["learned"]
    assert learned["factor"] in ("one", "air")
    assert learned["driver"] in ("the height of the probe", "the distance from the surface")
    assert learned["formula"] is not None
    assert "exp(" in learned["formula"]
    assert learned["probability"] > 0.9
    assert learned["formula"] in rail.sentence
    assert content["events"] is None


def test_the_laws_that_fit_as_well_are_named_for_readers_and_for_programs_in_one_order(rail: Diagnosis) -> None:
    learned = rail.to_json()["learned"]
    assert learned["alike"]
    for words, law in zip(learned["alike"], learned["alike_laws"], strict=True):
        assert WORDS[law["quantity"]] in words
        assert law["factor"].replace("_", " × ") in words or law["factor"] == "one"


def test_its_curve_covers_the_true_law_and_closes_the_gap_on_another_motion(rail: Diagnosis) -> None:
    assert rail.decision.learned is not None
    (term,) = rail.decision.learned.terms
    z_m = np.array(term.knots)
    band = 3.0 * np.array(term.sd) + 0.1 * RAIL_N
    # A constant is a bias of the sensor, so only the shape counts.
    apart = np.array(term.values) - rail_N(z_m)
    assert np.all(np.abs(apart - np.median(apart)) < band)
    t_s = np.arange(1500) / 125.0
    other_m = 0.006 + 0.005 * np.sin(0.8 * t_s)
    change_N = simulate(rail.enriched_cell(), t_s, z_m=other_m)["fz_N"] - simulate(nominal(), t_s, z_m=other_m)["fz_N"]
    error_N = change_N - rail_N(other_m)
    assert np.std(error_N) < 0.2 * np.std(rail_N(other_m))


def test_out_json_the_file_and_the_report_hold_the_law(rail: Diagnosis, tmp_path: Path) -> None:
    write_answer(tmp_path / "out.json", rail)
    content = json.loads((tmp_path / "out.json").read_text(encoding="utf-8"))
    jsonschema.validate(content, SCHEMA)
    assert content["learned"]["file"] == "out.learned.yaml"
    assert content["learned"]["id"] in load_effects(tmp_path / "out.learned.yaml")
    html = page(content, curves_of(rail), rail.problem.library, "x")
    assert content["learned"]["formula"] in html
    assert 'id="law' in html or "law" in html
    assert "without the law" in html


def test_a_law_over_few_bins_shows_its_data_in_the_report(rail: Diagnosis, monkeypatch: pytest.MonkeyPatch) -> None:
    """A recording of 49 rows has no stretch of the driver with three bins."""
    monkeypatch.setattr(learned, "SHOWN_POINTS", 100_000)
    content = rail.to_json()
    assert content["learned"]["data"]["x"]
    assert "What it does" in page(content, curves_of(rail), rail.problem.library, "x")


def test_a_single_step_is_an_event_with_its_time_and_size() -> None:
    t_s, _ = heights()
    diagnosis = with_force(np.where(t_s > 7.0, 0.2, 0.0))
    content = diagnosis.to_json()
    jsonschema.validate(json.loads(json.dumps(content)), SCHEMA)
    assert content["learned"] is None
    assert content["verdict"] == "unknown"
    first = content["events"][0]
    assert (first["kind"], first["channel"]) == ("step", "fz_N")
    assert first["t_s"] == pytest.approx(7.0, abs=0.2)
    assert first["size"] == pytest.approx(0.2, rel=0.3)
    assert "single events" in page(content, curves_of(diagnosis), diagnosis.problem.library, "x")


def test_a_drift_that_begins_late_is_one_event_and_not_two_effects() -> None:
    """Creep and hysteresis together imitate it."""
    t_s, _ = heights()
    content = with_force(0.015 * np.clip(t_s - 11.0, 0.0, None)).to_json()
    jsonschema.validate(json.loads(json.dumps(content)), SCHEMA)
    assert content["verdict"] == "unknown"
    (event,) = content["events"]
    assert (event["kind"], event["channel"]) == ("change of drift", "fz_N")
    assert event["t_s"] == pytest.approx(11.0, abs=1.0)
    assert event["size"] == pytest.approx(0.015 * (t_s[-1] - 11.0), rel=0.2)
    assert "drifts from there on" in content["plain"]["events"][0]


def test_a_healthy_cell_and_a_listed_effect_have_neither_law_nor_events() -> None:
    for effects in ({}, {"tissue.viscoelastic": {"ratio": 0.2, "tau_s": 0.8}}):
        content = quick(recording(nominal(), effects), nominal()).to_json()
        assert content["learned"] is None
        assert content["events"] is None


# parts


def test_one_law_replaces_several_listed_effects_that_imitate_it_together_and_no_single_cause(rail: Diagnosis) -> None:
    law = rail.decision.law
    assert law is not None
    several: Any = SimpleNamespace(names=("a", "b"))
    nothing = SoughtLaw(replace(law.sought.law, terms=()), several)

    def beyond(leading_leaves: float, sought: SoughtLaw = law.sought) -> BeyondList:
        return _beyond_list(LawEvidence(several, on_top=nothing, alone=sought, leading_leaves=leading_leaves), is_cause=True)

    replacing = beyond(0.5).law
    assert replacing is not None
    assert replacing.replaces
    for leading in (0.0, 0.1):  # one effect, or one that explains most of the gap: a real cause never has quite its listed law
        kept = beyond(leading)
        assert kept.law is None
        assert kept.p_outside == 0.0
        assert kept.note is not None
        assert law.learned.what in kept.note
    two_terms = replace(law.sought, law=replace(law.sought.law, terms=law.sought.law.terms * 2))
    assert beyond(0.5, two_terms).law is None, "as many parts as the listed effects"


def test_columns_that_are_filtered_one_by_one_are_those_that_are_filtered_together(
    rail: Diagnosis, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert rail.decision.law is not None
    law = rail.decision.law.sought.law
    for channel in ("fz_N", "z_m"):
        candidate = replace(law.terms[0].candidate, channel=channel)
        together = law.scene.columns(candidate)
        assert together
        with monkeypatch.context() as little_memory:
            little_memory.setattr("palpd.gap.laws.scene.MOST_FILTERED", 1)
            one_by_one = law.scene.columns(candidate)
        assert all(one_by_one[row] == pytest.approx(values, rel=1e-9, abs=1e-12) for row, values in together.items())


def test_how_much_the_best_of_several_effects_leaves() -> None:
    def misfit(names: tuple[str, ...], misfit: float) -> Any:
        return SimpleNamespace(names=names, misfit=misfit)

    fits = {names: misfit(names, value) for names, value in (((), 100.0), (("a",), 40.0), (("b",), 70.0))}
    assert leading_leaves(fits, misfit(("a", "b"), 20.0)) == pytest.approx(0.25)
    assert leading_leaves(fits, misfit(("a",), 40.0)) == 0.0


def space_and_columns(seed: int = 0) -> tuple[NuisanceSpace, Floats]:
    """Noise in one channel of 60 bins with two nuisances, and three columns that the residual holds."""
    rng = np.random.default_rng(seed)
    nuisances = 3.0 * rng.standard_normal((2, 60))
    columns = rng.standard_normal((60, 3))
    residual = np.zeros((7, 60))
    residual[3] = rng.standard_normal(60) + columns @ [1.0, -2.0, 0.5] + nuisances[0]
    return NuisanceSpace(Columns.of([{3: values} for values in nuisances], (7, 60)), residual), columns


def test_the_evidence_of_a_group_is_the_ratio_of_two_gaussians() -> None:
    space, columns = space_and_columns()
    products = space.products({3: columns})
    prior = np.eye(3)
    (_, nuisances), residual = space.columns.of_channel(3), space.residual[3]
    without = np.eye(60) + nuisances.T @ nuisances
    logs = []
    for size in ASSUMED.laws.sizes_sd:
        square = size**2 / np.trace(products.gram)
        joint = multivariate_normal(cov=without + square * columns @ columns.T).logpdf(residual)
        logs.append(joint - multivariate_normal(cov=without).logpdf(residual))
    expected = np.logaddexp.reduce(logs) - np.log(len(ASSUMED.laws.sizes_sd))
    assert group_evidence(products, (prior,)).nats == pytest.approx(expected, rel=1e-9)


def test_a_group_that_tolerances_hide_is_no_law() -> None:
    space, columns = space_and_columns()
    hidden = 30.0 * space.columns.of_channel(3)[1].T
    widened = space.with_columns({3: 100.0 * hidden})
    assert group_evidence(widened.products({3: hidden}), (np.eye(2),)).nats == -np.inf
    assert group_evidence(space.products({3: columns}), (np.eye(3),)).nats > 10.0


def test_a_law_of_one_fold_alone_does_not_carry() -> None:
    space, columns = space_and_columns()
    fold = np.arange(60) % ASSUMED.laws.folds
    assert held_out(space, {3: columns}, np.eye(3), fold).carries(20.0)
    lonely = replace(space, residual=np.where(fold == 0, 5.0 * space.residual, 0.0))
    assert not held_out(lonely, {3: np.where(fold[:, None] == 0, columns, 0.0)}, np.eye(3), fold).carries(20.0)


def test_the_spread_of_a_law_is_that_of_noise_where_strokes_agree_and_larger_where_they_do_not() -> None:
    r, bins, folds = np.random.default_rng(4), 8000, ASSUMED.laws.folds
    fold, x, root = np.arange(bins) * folds // bins, r.standard_normal((bins, 2)), np.eye(2)
    ratios = []
    for strength in (np.ones(folds), 1.0 + 0.5 * (-1.0) ** np.arange(folds)):
        spreads = []
        for _ in range(40):
            residual = np.zeros((7, bins))
            residual[3] = strength[fold] * (x @ np.array([0.4, -0.2])) + r.standard_normal(bins)
            spreads.append(spread_over_folds(NuisanceSpace(Columns.of([], (7, bins)), residual), {3: x}, root, fold))
        ratios.append(float(np.trace(np.mean(spreads, axis=0)) * bins / 2.0))
    assert ratios[0] == pytest.approx(1.0, rel=0.35)
    assert ratios[1] > 20.0


def test_joining_rows_keeps_noise_white() -> None:
    rng = np.random.default_rng(1)
    space = NuisanceSpace(Columns.of([], (7, 3000)), rng.standard_normal((7, 3000)))
    assert np.var(space.coarse.residual) == pytest.approx(1.0, rel=0.1)


def test_hats_add_up_to_one_and_hold_their_ends() -> None:
    driver = Driver(quantity="gap", log_scale=1e-3)
    x = np.linspace(-0.005, 0.02, 200)
    basis = hats(driver, x)
    assert basis is not None
    far = np.array([-1.0, *x, 1.0])
    np.testing.assert_allclose(basis.columns(far).sum(axis=1), 1.0)
    assert hats(driver, np.zeros(10)) is None
    assert powers(driver, np.zeros(10)) is None


def test_every_formula_is_one_that_the_simulator_reads() -> None:
    x = np.linspace(-0.004, 0.01, 100)
    basis = hats(Driver(quantity="height"), x)
    assert basis is not None
    listed = list(formulas_of(basis, x, with_constant=True))
    assert len({formula.shapes for formula in listed}) == len(listed)
    for formula in listed:
        columns = formula.columns(x)
        assert np.isfinite(columns).all()
        assert np.abs(columns).max() <= 1.0 + 1e-9
        assert formula.text(np.ones(formula.size))


def test_simulate_says_how_many_rows_lie_outside_the_range_of_a_law(tmp_path: Path) -> None:
    term = {"channels": {"fz_N": 1.0}, "factor": "one", "driver": {"quantity": "height"}, "knots": [0.0, 0.01], "values": [0.0, 0.2]}
    content = {"learned": [{"id": "learned.ramp", "terms": [term | {"range": [0.0, 0.01]}]}]}
    (tmp_path / "cell.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    t_s = np.arange(400) / 100.0
    for name, top_m in (("inside", 0.009), ("outside", 0.03)):
        rows = "".join(f"{t:.3f},{top_m * t / 4.0:.6f}\n" for t in t_s)
        (tmp_path / f"{name}.csv").write_text("t_s,z_m\n" + rows, encoding="utf-8")
        sentences: list[str] = []
        simulate_file(tmp_path / f"{name}.csv", tmp_path / "cell.yaml", tmp_path / f"{name}.out.csv", say=sentences.append)
        if name == "inside":
            assert not sentences
        else:
            assert len(sentences) == 1
            assert "learned.ramp: 66." in sentences[0]


def test_readings_in_coarse_steps_have_no_law() -> None:
    """A converter that drops digits leaves an error that follows the force, which any law of the force would explain."""
    samples = recording(nominal(), {}, rate_Hz=250.0)
    wrench = samples.wrench.copy()
    wrench[:, 2] = np.trunc(wrench[:, 2] / 0.3) * 0.3
    diagnosis = quick(replace(samples, wrench=wrench), nominal())
    assert "sensor.quantization" in [effect.id for effect in diagnosis.effects]
    assert diagnosis.to_json()["learned"] is None


def test_a_law_smaller_than_the_rounding_of_its_channel_is_none(rail: Diagnosis) -> None:
    law = rail.decision.law
    assert law is not None
    scene, space = law.sought.law.scene, law.sought.law.space

    def found_beside(step_N: float) -> int:
        rounding = Rounding(step_N, 0.01 * step_N, coarse=False)
        return len(search(replace(scene, problem=replace(scene.problem, rounding=rounding)), space).terms)

    assert found_beside(0.01) == len(law.sought.law.terms)
    assert found_beside(5.0) == 0
