"""The paper's published numbers by themselves, and its section 4 on the emulated cell in small."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpd.analysis.enriched import enriched_modulus
from palpd.analysis.stiffness_map import Survey
from palpd.analysis.young import modulus_peak_Pa, ymbt
from palpd.cell.cell_file import TissueBlock
from palpd.cell.motion_profile import Move, commanded_heights
from palpd.cli import study as command
from palpd.config import Plan
from palpd.errors import BadInput, RecordingError
from palpd.recording.reader import Recording
from palpd.study import published as paper
from palpd.study.evaluation import (
    BIAS,
    BIAS_N,
    DEPTHS_M,
    ENRICHED,
    HYSTERESIS,
    LINE,
    NETWORK,
    NONE,
    RATE_RATIO,
    RATE_TAU_S,
    TRUTH,
    WINNER,
    ZERO_MISS_M,
    Data,
    Study,
    believed_cell,
    evaluate,
    palpated,
    recorded,
    study_cell,
    study_of,
    take_of,
)
from palpd.study.laboratory import STEP_S, Take, free_cell, setup, take
from palpd.study.methods import ConstantBias, LinearModelWithRunningZero, Method, NoCorrection
from palpd.study.report import away_from_truth, html, means
from palpd.tick import ROW, Mode
from tests.simulated import cell_file, ran


def test_the_static_forces_are_whole_counts_of_the_sensor() -> None:
    count, away_N = paper.count_N()
    assert count.value == pytest.approx(0.1244, abs=1e-4)
    assert away_N < 0.01 / np.sqrt(12.0)  # no more than printing to 0.01 N leaves; forces of any size would be 36 mN away


def test_the_static_moduli_are_of_depths_that_were_reached_and_not_of_the_nominal_ones() -> None:
    nominal, achieved = paper.table_1_misses()
    assert np.abs(nominal).max() > 0.005
    assert np.abs(achieved).max() < 5e-5
    steps = [np.round((paper.achieved_depths_m(name) - paper.static(name)[0]) * 1e5).tolist() for name in paper.SETUPS]
    assert {step for row in steps for step in row} <= {-2.0, -1.0, 1.0, 2.0, 3.0}


def test_tables_2_and_3_follow_from_the_ones_before() -> None:
    for name in paper.SETUPS:
        row = paper.averages(name)
        assert float(paper.static(name)[2].mean()) == pytest.approx(row.static_Pa, rel=1e-4)
        for modulus_Pa, printed in ((row.original_Pa, row.ymbt_original), (row.corrected_Pa, row.ymbt_corrected)):
            assert 100.0 * ymbt(modulus_Pa, row.static_Pa) == pytest.approx(100.0 * printed, abs=0.006)


def test_the_correction_is_one_force_that_inertia_cannot_be() -> None:
    taken, depth = paper.correction_Pa(), paper.depth_of_peaks_m()
    assert taken.low < 6740 < taken.high
    assert 0.0035 < depth.low < depth.value < depth.high < 0.004
    assert paper.largest_inertia_N() < paper.MEAN_FREE_N["with the probe"] / 100.0


def test_exponents_and_surfaces_have_intervals_that_tell_hertz_from_stiffening() -> None:
    assert paper.exponent("A").high < 1.5 < paper.exponent("C").low
    assert paper.exponent("D").low < 1.5 < paper.exponent("D").high
    assert paper.surface_offset_m("A").low > 0.0
    assert paper.surface_offset_m("C").high < 0.0


def test_at_the_same_depth_every_setup_is_stiffer_in_motion() -> None:
    excess = {name: paper.rate_excess(name) for name in paper.SETUPS}
    assert all(value.low > 0.0 for value in excess.values())
    assert excess["C"].value > 0.1  # where Table 3 has 0.65 %


@pytest.fixture(scope="module")
def small() -> Study:
    """One day on the emulated cell, with what the diagnosis would find put in, and methods that need no training of a network."""
    cycle = [Move(0.03, 0.02, 0.5), *[Move(0.03 + way, 0.02, 0.1) for _ in range(4) for way in (0.02, 0.0)]]
    free = [
        take(free_cell(setup("A"), {"sensor.bias": {"offset_N": BIAS_N}}), commanded_heights(0.03, cycle, STEP_S)[0], seed)
        for seed in (1, 2)
    ]
    enriched = {}
    for name in paper.SETUPS:
        known = study_cell(name)
        tissue = believed_cell(name).tissue
        assert tissue is not None
        effects = known.effects | {"tissue.surface": {"offset_m": ZERO_MISS_M[name]}}
        enriched[name] = known.model_copy(update={"tissue": tissue, "effects": effects})
    data = Data([], free, palpated(3, enriched), simulated=True)
    methods: dict[str, Method] = {NONE: NoCorrection(), BIAS: ConstantBias(), WINNER: LinearModelWithRunningZero()}
    methods |= {NETWORK: methods[BIAS], LINE: methods[BIAS]}
    for method in methods.values():
        method.fit(free)
    card = {"bias_N": BIAS_N, "mass_kg": 0.2, "mass_ci95_kg": [0.19, 0.21], "inertial_rms_N": 0.002, "rmse_N": 0.001}
    survey = Survey()
    for place_m, modulus_Pa in (((0.01, 0.01), 6e4), ((0.03, 0.03), 6.1e4), ((0.05, 0.02), 9e4)):
        survey.add(place_m, modulus_Pa)
    return Study(data, {NETWORK: card}, evaluate(data, methods), mapped=(survey, survey.map(), (0.05, 0.02, 0.005)))


def test_the_published_gap_is_neither_one_force_nor_one_share_of_the_contact() -> None:
    nothing, force, share = paper.explanations()
    assert nothing.misfit > 100.0
    assert force.value is not None
    assert force.value.value == pytest.approx(0.464, abs=0.005)
    assert force.misfit == pytest.approx(10.2, abs=0.1)
    assert share.misfit == pytest.approx(22.6, abs=0.1)
    assert share.p < force.p < 0.05
    assert list(force.needs.values()) == pytest.approx([0.52, 0.80, 0.55, 0.33], abs=0.01)
    assert [1e3 * depth for depth in paper.deeper_m().values()] == pytest.approx([0.57, 0.49, 0.44, 0.21], abs=0.01)
    away_N, differ = paper.alike_N()
    assert abs(away_N) < 0.06
    assert differ.low > 0.0, "the two gaps differ"


def test_a_gap_that_is_one_force_or_one_share_is_found_to_be_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def checked(force_N: float, share: float) -> None:
        rows = {s: paper._static_line(s) for s in paper.SETUPS}
        ratio = {s: (1.0 + force_N / row.force_N) * (1.0 + share) for s, row in rows.items()}
        new = {s: replace(paper.averages.__wrapped__(s), corrected_Pa=rows[s].modulus_Pa * ratio[s]) for s in paper.SETUPS}
        depth = paper.depth_of_peaks_m()
        monkeypatch.setattr(paper, "depth_of_peaks_m", lambda: depth)
        monkeypatch.setattr(paper, "averages", new.__getitem__)

    checked(0.3, 0.0)
    _, force, share = paper.explanations()
    assert force.misfit < 1e-6 < share.misfit
    assert force.value is not None
    assert force.value.value == pytest.approx(0.3, rel=1e-3)
    monkeypatch.undo()
    checked(0.0, 0.2)
    _, force, share = paper.explanations()
    assert share.misfit < 1e-6 < force.misfit


def test_the_cell_of_the_study_reads_what_the_paper_read(small: Study) -> None:
    for each in small.setups:
        published = paper.averages(each.palpated.name)
        assert each.static_Pa == pytest.approx(published.static_Pa, rel=0.02)
        assert each.ymbt[NONE] == pytest.approx(published.ymbt_original, abs=0.05)
        assert each.ymbt[BIAS] == pytest.approx(published.ymbt_corrected, abs=0.05)
        assert len(each.peaks) == 10


def test_no_correction_of_the_force_makes_ymbt_small_and_what_the_running_zero_leaves_is_hysteresis(small: Study) -> None:
    assert means(small)[TRUTH][0] > 0.1
    assert away_from_truth(small)[WINNER] < 0.5 * away_from_truth(small)[NONE]
    for each in small.setups:  # zeroed on the branch of unloading, read on that of loading
        left_N = float(np.mean([peak.force_N[WINNER] - peak.force_N[TRUTH] for peak in each.peaks[1:]]))
        assert left_N == pytest.approx(2.0 * HYSTERESIS["amplitude_N"], abs=0.025)


def test_an_inclusion_is_seen_where_the_phantom_stiffens_and_not_where_it_does_not(small: Study) -> None:
    seen = {each.palpated.name: each.inclusion for each in small.setups}
    for name, result in seen.items():
        assert result is not None
        assert (result.probability > 0.5) == (name in "BC"), name


def test_what_is_known_of_a_cell_no_longer_passes_for_stiffness(small: Study) -> None:
    for each in small.setups:
        assert each.ymbt[ENRICHED] < 0.03
    assert means(small)[ENRICHED][0] < 0.141 / 2.0 < means(small)[BIAS][0]


def test_the_page_holds_every_table_and_figure_and_says_what_is_simulated(small: Study) -> None:
    page = html(small)
    for number in (7, 8, 9, 10, *range(12, 16)):
        assert f"Figure {number}." in page
    assert "Figures 16 to 19." in page
    assert "Simulated: everything except" in page
    assert page.count("<svg") == 10 + (small.mapped is not None)
    assert "Is there an inclusion below?" in page
    assert not re.search(r'(src|href)="(?!data:|#)', page)  # nothing is fetched
    assert "nan" not in re.sub(r"base64,[^\"]+", "", page).lower()


def press(effects: dict[str, dict[str, float]], seed: int = 5) -> tuple[Take, float]:
    modulus_Pa = 8e4
    cell = setup("A").model_copy(update={"tissue": TissueBlock(youngs_modulus_Pa=modulus_Pa), "effects": effects})
    moves = [Move(0.01, 0.02, 0.5), Move(-0.005, 0.01, 1.0), Move(0.01, 0.02, 0.3), Move(-0.003, 0.02), Move(0.01, 0.02, 0.3)]
    return take(cell, commanded_heights(0.01, moves, STEP_S)[0], seed), modulus_Pa


def test_an_enriched_cell_gives_the_modulus_where_the_plain_one_does_not() -> None:
    effects = {
        "tissue.viscoelastic": {"ratio": RATE_RATIO["A"], "tau_s": RATE_TAU_S},
        "robot.compliance": {"stiffness_N_per_m": 1e4},
        "sensor.latency": {"delay_s": 0.03},
    }
    run, true_Pa = press(effects)
    plain = setup("A").model_copy(update={"tissue": TissueBlock(youngs_modulus_Pa=5e4), "effects": {}})
    before = enriched_modulus([run.samples()], plain)
    after = enriched_modulus([run.samples()], plain.model_copy(update={"effects": effects}))
    assert abs(before.youngs_modulus_Pa / true_Pa - 1.0) > 0.05
    assert after.youngs_modulus_Pa == pytest.approx(true_Pa, rel=0.02)
    assert after.ci95_Pa[0] < true_Pa < after.ci95_Pa[1]
    assert after.surface_z_m == pytest.approx(0.0, abs=3e-5)
    assert after.static_Pa(DEPTHS_M) == pytest.approx(true_Pa, rel=0.02)


def test_a_creep_that_settles_within_a_press_is_no_stiffness() -> None:
    run, true_Pa = press({})
    as_named = setup("A").model_copy(update={"effects": {"sensor.creep": {"ratio": 0.2, "tau_s": 0.01}}})
    result = enriched_modulus([run.samples()], as_named)
    assert result.youngs_modulus_Pa == pytest.approx(true_Pa, rel=0.02)
    assert result.static_Pa(DEPTHS_M) == pytest.approx(true_Pa, rel=0.02)


def test_a_recording_without_contact_has_no_modulus() -> None:
    cell = setup("A")
    run = take(cell, commanded_heights(0.01, [Move(0.02, 0.02, 0.5)], STEP_S)[0], 1)
    with pytest.raises(RecordingError, match="never goes below the surface"):
        enriched_modulus([run.samples()], cell)


def test_rows_of_a_recording_become_what_the_methods_take() -> None:
    rows = np.zeros(200, ROW)
    rows["robot_t_s"] = 5.0 + np.arange(200) * 0.008
    rows["frames"] = 8
    rows["frame_t_s"][:, :8] = rows["robot_t_s"][:, None] + np.arange(-7, 1) * 0.001
    rows["tared"][:, :8, 2] = 1.5
    run = take_of(rows, "run")
    assert len(run.t_s) == 1600
    assert run.t_s[0] == 0.0
    assert run.robot_t_s[0] == pytest.approx(0.007)
    assert run.fz_N.tolist() == [1.5] * 1600
    with pytest.raises(RecordingError, match="run holds 16 sensor samples and 2 robot states"):
        take_of(rows[:2], "run")


def test_the_same_study_runs_on_recordings_of_the_daemon(tmp_path: Path) -> None:
    cell = cell_file(effects={"sensor.bias": {"offset_N": BIAS_N}})
    moved = ran(cell, kind="free_motion")
    plan = Plan.model_validate({"depths_m": [0.004], "repeats": 2, "hold_s": 1.0})
    pressed = ran(cell, plan)
    free, palpation = (Recording(tmp_path / f"{n}.mcap", run.rows, run.header, {}, None) for n, run in (("f", moved), ("p", pressed)))
    result = study_of(recorded([], [free], palpation))
    (site,) = result.setups
    assert len(site.peaks) == 2
    assert site.static_Pa == pytest.approx(72000, rel=0.03)
    assert site.modulus_Pa[NONE] - site.modulus_Pa[WINNER] == pytest.approx(modulus_peak_Pa(BIAS_N, 0.004, 0.005, 0.5), rel=0.15)
    assert abs(site.modulus_Pa[WINNER] / 72000 - 1.0) < 0.05
    page = html(result)
    assert "Made from recordings of a cell" in page
    assert "On days that differ by" not in page, "the page of a real cell says nothing of the emulated one"
    assert "emulated cell has" not in page
    with pytest.raises(BadInput, match="site A holds 0 static presses"):
        recorded([], [free], Recording(tmp_path / "q.mcap", pressed.rows[pressed.rows["mode"] != Mode.STATIC], pressed.header, {}, None))


@pytest.mark.parametrize(
    ("options", "printed"),
    [
        ({"cell": ["A=enriched.yaml"]}, "needs both --free and --palpation"),
        ({"bare": [Path("bare.mcap")]}, "needs both --free and --palpation"),
    ],
)
def test_what_would_be_passed_over_is_refused(options: dict[str, Any], printed: str, tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=printed):
        command.study(out=tmp_path, **options)
    assert not list(tmp_path.iterdir())


def test_recordings_of_different_sensors_are_no_study(tmp_path: Path) -> None:
    rows = np.zeros(3, ROW)
    one, other = (Recording(tmp_path / f"{n}.mcap", rows, {"about": {"sensor_serial": n}}, {}, None) for n in ("HEX-1", "HEX-2"))
    with pytest.raises(BadInput, match=r"different sensors \(HEX-1\.mcap of HEX-1, HEX-2\.mcap of HEX-2\)"):
        recorded([], [one], other)
