"""The sources of the blind check: what is planted into a recording is there and nothing else, and a small part of each is diagnosed."""

import json
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml

from palpd.blind import sources as sources_module
from palpd.blind.check import run
from palpd.blind.detectability import Detectability
from palpd.blind.drawn_cells import no_deviations
from palpd.blind.injected_cells import Host, changed, coarsened, declared_recordings, draw_injected, load_causes, load_hosts
from palpd.blind.laws import LIBRARY_LAWS, Planted
from palpd.blind.outcome import score_case
from palpd.blind.plans import COARSEST_OVER_NOISE, FIRST_COARSE, effects_of, plan, plan_coarse
from palpd.blind.recorded_cells import RecordedMotion, cell_of
from palpd.blind.sources import Hosts, draw, sources_named
from palpd.blind.stated_cell import CHANNELS
from palpd.blind.truth import SOURCES, CaseSpec, Source
from palpd.errors import BadInput
from palpd.recording.samples import Samples, write_csv

FZ = CHANNELS.index("fz_N")


@cache
def host() -> Host:
    """A healthy drawn cell, as if it were a recording of another rig."""
    spec = next(spec for spec in plan("drawn", 60, 3) if spec.kind == "healthy")
    case = draw(spec, 3, Hosts())
    return Host("rig", case.cell, case.samples, ())


def detectability(samples: Samples) -> Detectability:
    cell = cell_of(host().content, samples)
    motion = RecordedMotion(cell, samples)
    return Detectability(cell, no_deviations(motion.presses), motion, motion.t_s)


def planted(effect: str, **parameters: float) -> Planted:
    return next(law for law in LIBRARY_LAWS if law.effect == effect), parameters


def test_a_recording_is_its_own_simulation_within_its_noise() -> None:
    samples = host().samples
    here = detectability(samples)
    residual = np.column_stack([samples.z_m, samples.wrench]) - here.plain_rows
    assert np.all(residual.std(axis=0) < 1.5 * here.cell.sigmas)
    assert abs(float(residual[:, FZ].mean())) < 0.1 * here.cell.sigmas[FZ]


def test_nothing_planted_changes_nothing() -> None:
    same = changed(host().samples, detectability(host().samples), [], np.random.default_rng(0))
    assert np.array_equal(same.wrench, host().samples.wrench)
    assert np.array_equal(same.z_m, host().samples.z_m)


def test_a_planted_bias_is_that_bias_and_a_planted_spring_follows_the_recorded_height() -> None:
    samples, here = host().samples, detectability(host().samples)
    biased = changed(samples, here, [planted("sensor.bias", offset_N=0.7)], None)
    assert np.allclose(biased.wrench[:, 2] - samples.wrench[:, 2], 0.7)
    sprung = changed(samples, here, [planted("cable.spring", stiffness_N_per_m=50.0)], None)
    force_N = sprung.wrench[:, 2] - samples.wrench[:, 2]
    slow = np.polyfit(samples.z_m, force_N, 1)[0]
    assert slow == pytest.approx(-50.0, rel=0.05)


def test_a_gain_acts_on_the_force_that_was_recorded_and_not_on_the_nominal_one() -> None:
    samples = host().samples
    heavier = replace(samples, wrench=samples.wrench + np.array([0, 0, 2.0, 0, 0, 0]))
    change = changed(heavier, detectability(heavier), [planted("sensor.gain", error=0.1)], None).wrench[:, 2] - heavier.wrench[:, 2]
    free = samples.z_m > here_surface() + 1e-3
    assert float(np.median(change[free])) == pytest.approx(0.2, rel=0.1)


def here_surface() -> float:
    return float(host().content["tissue"]["surface_z_m"])


def test_a_lag_moves_the_reported_height_and_leaves_the_command() -> None:
    samples = host().samples
    lagging = changed(samples, detectability(samples), [planted("robot.lag", bandwidth_ratio=0.5)], None)
    assert lagging.z_cmd_m is samples.z_cmd_m
    assert float(np.abs(lagging.z_m - samples.z_m).max()) > 1e-4
    assert abs(float(lagging.z_m[0] - samples.z_m[0])) < 1e-9, "the recording begins at rest"


def test_a_cause_of_the_host_is_not_planted_again_and_naming_it_is_no_error(tmp_path: Path) -> None:
    sick = replace(host(), causes=("sensor.creep",))
    spec = CaseSpec("injected", 0, "foreign", ("sensor.creep",), "20-60")
    with pytest.raises(sources_module.CannotDraw):
        draw_injected(spec, 1, [sick])
    case = draw_injected(replace(spec, effects=("cable.friction",)), 1, [sick])
    assert case.truth["host_causes"] == ["sensor.creep"]
    assert case.second is None
    recordings, sealed = tmp_path / "recordings", tmp_path / "sealed"
    recordings.mkdir()
    sealed.mkdir()
    (sealed / f"{spec.name}.json").write_text(json.dumps(case.truth), encoding="utf-8")
    named = [{"id": name, "indistinguishable_from": [], "parameters": {}} for name in ("sensor.creep", "cable.friction")]
    answer = {
        "verdict": "effects", "effects": named, "where": None, "candidates": [{"id": e["id"], "probability": 0.9} for e in named],
        "p_none": 0.0, "p_unknown": 0.1, "notes": [], "learned": None, "events": None,
        "cost": {"cpu_s": 1.0, "wall_s": 1.0, "peak_MB": 1.0},
    }  # fmt: skip
    (recordings / f"{spec.name}.json").write_text(json.dumps(answer), encoding="utf-8")
    outcome = score_case(recordings, sealed, spec)
    assert outcome["named"] == outcome["planted"] == ["cable.friction"]
    assert list(outcome["p"]) == ["cable.friction"]


def test_an_effect_that_no_drawn_cell_shows_gives_its_place_to_the_next_of_its_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    library = effects_of("drawn")["library"]
    place = library.index("structure.resonance")
    asked: list[tuple[str, str]] = []

    def draw_case(seed: int, spec: CaseSpec) -> CaseSpec:
        asked.append((spec.effects[0], spec.stratum))
        if spec.effects == ("structure.resonance",):
            raise sources_module.CannotDraw("too stiff")
        return spec

    monkeypatch.setattr(sources_module, "draw_case", draw_case)
    draw(CaseSpec("drawn", 249, "library", ("structure.resonance",), "10-20"), 1, Hosts())
    following = library[(place + 1) % len(library)]
    assert asked == [("structure.resonance", "10-20"), ("structure.resonance", "6-10"), (following, "10-20")]


def test_hosts_need_declared_causes(tmp_path: Path) -> None:
    write_csv(tmp_path / "rig.csv", host().samples)
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(host().content), encoding="utf-8")
    causes = tmp_path / "causes.yaml"
    with pytest.raises(BadInput, match=r"causes\.yaml"):
        load_hosts(tmp_path, None)
    for text, words in (
        ("rig: {causes: [no.such]}", "which is not in the list"),
        ("rig: {}", "expected {causes:"),
        ("rig: {causes: [], more: 1}", "expected {causes:"),
        ("other: {causes: []}", "holds 0 recordings other.csv"),
        ("rig: {causes: [], unlisted: true}", "can be a host"),
    ):
        causes.write_text(text, encoding="utf-8")
        with pytest.raises(BadInput, match=words):
            load_hosts(tmp_path, None)
    causes.write_text("rig: {causes: [cable.friction]}", encoding="utf-8")
    (only,) = load_hosts(tmp_path, None)
    assert only.causes == ("cable.friction",)
    assert load_causes(causes)["rig"].unlisted is False
    assert declared_recordings(tmp_path, causes)[0][0] == tmp_path / "rig.csv"


def test_channels_that_a_recording_does_not_hold_show_nothing() -> None:
    samples = host().samples
    bare = replace(samples, z_cmd_m=None, wrench=samples.wrench * np.array([0, 0, 1, 0, 0, 0]))
    here = detectability(bare)
    assert np.isinf(here.cell.sigmas[[0, 1, 2, 4, 5, 6]]).all()
    assert here.snr(here.change([planted("contact.lateral", ratio=0.5, azimuth_rad=0.0)])) == 0.0
    lateral = changed(bare, here, [planted("contact.lateral", ratio=0.5, azimuth_rad=0.0)], None)
    assert not lateral.wrench[:, 0].any()


@pytest.mark.parametrize("source", SOURCES)
def test_every_source_plants_every_kind_in_turn(source: Source) -> None:
    specs = plan(source, 400, 1)
    assert plan(source, 100, 1) == specs[:100]
    for kind, effects in effects_of(source).items():
        assert {spec.effects[0] for spec in specs if spec.kind == kind} <= set(effects)
    assert sum(spec.kind == "healthy" for spec in specs) == 80
    assert [spec.kind for spec in plan(source, 100, 1, hosts=3)].count("healthy") == 3, "a real recording comes once as it is"


@pytest.mark.parametrize("source", SOURCES)
def test_coarse_steps_are_drawn_apart_from_what_acts(source: Source) -> None:
    specs = plan_coarse(source, 300, 1)
    assert plan_coarse(source, 90, 1) == specs[:90]
    assert [spec.kind for spec in specs[:90]].count("healthy") == 60
    assert all(spec.extra and spec.index >= FIRST_COARSE for spec in specs)
    steps = np.log([spec.steps_over_noise for spec in specs]) / np.log(COARSEST_OVER_NOISE)
    assert np.all((steps > 0.0) & (steps < 1.0))
    assert steps.mean(axis=0) == pytest.approx(0.5, abs=0.06)
    assert np.abs(np.corrcoef(steps.T) - np.eye(3)).max() < 0.2
    healthy = np.array([spec.kind == "healthy" for spec in specs])
    assert steps[healthy].mean(axis=0) == pytest.approx(steps[~healthy].mean(axis=0), abs=0.1)


@pytest.mark.parametrize("source", SOURCES)
def test_a_recording_with_coarse_steps_holds_the_steps_that_its_cell_file_states(source: Source) -> None:
    if source != "drawn":
        pytest.importorskip("mujoco", reason="MuJoCo is not installed; install the dev group to draw cells with its physics.")
    spec = replace(plan_coarse(source, 1, 5)[0], steps_over_noise=(7.0, 4.4, 1.5))
    case = draw(spec, 5, Hosts())
    assert case.truth["effects"] == []
    sensor = case.cell["sensor"]
    for key, noise, over_noise, axes in (
        ("resolution_fxy_N", "noise_rms_N", 7.0, (0, 1)), ("resolution_fz_N", "noise_rms_N", 4.4, (2,)),
        ("resolution_Nm", "noise_rms_Nm", 1.5, (3, 4, 5)),
    ):  # fmt: skip
        assert sensor[key] == pytest.approx(over_noise * sensor[noise], rel=1e-3)
        levels = case.samples.wrench[:, axes] / sensor[key]
        assert np.allclose(levels, np.round(levels), atol=1e-6)
    residual = case.samples.wrench[:, 5] / sensor["noise_rms_Nm"]
    assert float(residual.std()) == pytest.approx((1.0 + 1.5**2 / 12.0) ** 0.5, rel=0.25), "the noise before rounding is the stated one"


def test_a_recording_is_never_rounded_to_another_lattice_than_its_own() -> None:
    sensor = host().content["sensor"]
    own, noise = sensor["resolution_fz_N"], sensor["noise_rms_N"]
    coarse = coarsened(host(), (1.0, 8.0, 1.0)).content["sensor"]
    assert coarse["resolution_fz_N"] / own == pytest.approx(round(8.0 * noise / own), abs=1e-6)
    assert coarse["resolution_fz_N"] == pytest.approx(8.0 * noise, rel=0.5 * own / noise / 8.0)
    coarser = replace(host(), samples=replace(host().samples, wrench=np.round(host().samples.wrench / (20.0 * noise)) * 20.0 * noise))
    kept = coarsened(coarser, (1.0, 8.0, 1.0)).content["sensor"]
    assert kept["resolution_fz_N"] == pytest.approx(20.0 * noise), "a recording whose own step is coarser keeps it"
    unsaid = {**host().content, "sensor": {"rate_Hz": sensor["rate_Hz"]}}
    stated = coarsened(replace(host(), content=unsaid), (1.0, 8.0, 1.0)).content["sensor"]
    assert stated.keys() == {"rate_Hz", "resolution_fxy_N", "resolution_fz_N", "resolution_Nm"}, (
        "a noise that was not stated is not made up"
    )


def test_a_source_that_does_not_exist_or_needs_what_is_not_there_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    assert sources_named("all", Hosts()) == SOURCES
    assert sources_named("injected,drawn", Hosts()) == ("drawn", "injected")
    with pytest.raises(BadInput, match="expected one of drawn, mujoco, injected, all"):
        sources_named("drawn,real", Hosts())
    with pytest.raises(BadInput, match="leave one of them out"):
        sources_named("drawn", Hosts(Path("somewhere")))
    monkeypatch.setattr(sources_module, "find_spec", lambda name: None)
    assert sources_named("drawn", Hosts()) == ("drawn",)
    with pytest.raises(BadInput, match="needs MuJoCo, which is not installed"):
        sources_named("all", Hosts())
    with pytest.raises(BadInput, match="needs MuJoCo"):
        sources_named("injected", Hosts())
    assert sources_named("injected", Hosts(Path("somewhere"))) == ("injected",)


def test_drawn_cells_need_no_mujoco() -> None:
    line = "import sys; sys.modules['mujoco'] = None; from palpd.blind.check import run; print(len(run(1, 1, jobs=1)['outcomes']))"
    printed = subprocess.run([sys.executable, "-c", line], capture_output=True, text=True, check=False)
    assert printed.stdout.strip() == "1", printed.stderr


@pytest.mark.parametrize(("source", "cases", "seed"), [("mujoco", 3, 14), ("injected", 2, 16)])
def test_a_small_fixed_part_of_each_source_is_diagnosed(source: Source, cases: int, seed: int) -> None:
    pytest.importorskip("mujoco", reason="MuJoCo is not installed; install the dev group to draw cells with its physics.")
    result = run(cases, seed, sources=[source], jobs=1)
    assert list(result["tables"]) == [source]
    assert [outcome["failed"] for outcome in result["outcomes"]] == [None] * cases
    for outcome in result["outcomes"]:
        assert outcome["named"] == outcome["planted"], outcome
        assert outcome["verdict"] == ("effects" if outcome["planted"] else "none")
