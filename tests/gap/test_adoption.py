"""A learned law joins the user's library, and the next diagnosis names it."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from palpd.blind.adoption import adopt_and_name
from palpd.cell.cell_file import nominal, save_cell
from palpd.cell.effects import EFFECTS
from palpd.cell.effects.learned import load_learned, save_learned
from palpd.cell.simulation import simulate
from palpd.cell.stages import WRENCH
from palpd.cli import app
from palpd.config import Config, Plan, PlanSite
from palpd.daemon.motion_job import Job
from palpd.daemon.simulated_run import run
from palpd.errors import BadInput
from palpd.gap import commands
from palpd.gap.adoption import adopt
from palpd.gap.commands import library, simulate_file
from palpd.gap.diagnosis import diagnose
from palpd.gap.enriched import with_laws_whole
from palpd.gap.fleet import by_cell, diagnose_folder
from palpd.recording.reader import Recording, export
from palpd.recording.samples import Samples, write_csv
from tests.cell.test_learned_effects import learned
from tests.gap.test_diagnosis import IN_TOLERANCE, recording
from tests.gap.test_law_search import rail_N

FOAM = "learned.stiff_foam"


def other_motion(seed: int = 8) -> Samples:
    """Slower strokes of other heights, and presses of other depths."""
    t_s = np.arange(0.0, 20.0, 0.008)
    z_cmd_m = 0.003 + 0.0085 * np.sin(2.0 * np.pi * t_s / 4.1) + 0.0015 * np.sin(2.0 * np.pi * t_s / 13.0)
    columns = simulate(nominal().with_estimated(IN_TOLERANCE), t_s, z_cmd_m=z_cmd_m, noise_seed=seed)
    return Samples(t_s, z_cmd_m, columns["z_m"], columns["vz_m_per_s"], np.column_stack([columns[name] for name in WRENCH]))


def with_rail(samples: Samples) -> Samples:
    wrench = samples.wrench.copy()
    wrench[:, 2] += rail_N(samples.z_m)
    return replace(samples, wrench=wrench)


@pytest.fixture
def quick_diagnosis(monkeypatch: pytest.MonkeyPatch) -> None:
    """Files are diagnosed in fewer bins."""
    monkeypatch.setattr(commands, "diagnose", lambda *a, **k: diagnose(*a, **k | {"max_bins": 700}))


def test_an_adopted_law_is_named_in_another_recording_of_the_cell() -> None:
    outcome = adopt_and_name(with_rail(recording(nominal(), {})), with_rail(other_motion()), nominal(), 900)
    assert outcome.law is not None
    assert not outcome.secondary
    assert outcome.named
    assert outcome.verdict == "effects"
    assert outcome.factor == pytest.approx(1.0, abs=0.25)
    assert outcome.again is None, "nothing of it is left to be found again"


def test_the_next_diagnosis_weighs_it_by_itself_and_says_so(tmp_path: Path, quick_diagnosis: None) -> None:
    law = learned(values=[0.0, 0.2, 0.6])
    truth, mine, fleet = nominal().model_copy(update={"learned": (law,)}), tmp_path / "mine", tmp_path / "fleet"
    save_learned(tmp_path / "out.learned.yaml", [law.model_copy(update={"confounds": {}})])
    adopt(tmp_path / "out.learned.yaml", mine, FOAM, nominal())
    fleet.mkdir()
    write_csv(fleet / "left-1.csv", recording(truth, {}))
    save_cell(fleet / "cell.yaml", nominal())
    (row,) = diagnose_folder(fleet, adopted=mine)
    assert list(row.effects) == [FOAM], row.sentence
    assert row.effects[FOAM]["strength"][0] == pytest.approx(1.0, abs=0.15)
    (cell,) = by_cell([replace(row, name=f"left-{k}") for k in range(4)])
    assert (cell.since, cell.trend.split()[-1]) == ("left-0", "steady"), "the table of a fleet follows it like a listed effect"
    content = json.loads((fleet / "left-1.json").read_text(encoding="utf-8"))
    assert any(str(mine) in note and FOAM in note for note in content["notes"])
    assert any("outside the range that it was learned in" in note for note in content["notes"]), "the presses are below its range"


def test_the_enriched_cell_of_a_named_law_needs_no_library(tmp_path: Path) -> None:
    """It holds the law whole, at the strength that was fitted, and simulate, export and the emulators take it."""
    law = learned(values=[0.0, 0.2, 0.6])
    known = EFFECTS | {law.id: law.effect()}
    named = nominal().with_effects({law.id: {"strength": 0.5}, "sensor.bias": {"offset_N": 0.1}})
    whole = with_laws_whole(named, known)
    assert set(whole.effects) == {"sensor.bias"}
    save_cell(tmp_path / "enriched.yaml", whole)
    t_s = np.arange(0.0, 6.0, 0.01)
    z_m = 0.004 + 0.008 * np.cos(2.0 * np.pi * t_s / 3.0)
    (tmp_path / "motion.csv").write_text(
        "t_s,z_m\n" + "".join(f"{t:.3f},{z:.7f}\n" for t, z in zip(t_s, z_m, strict=True)), encoding="utf-8"
    )
    simulated = simulate_file(tmp_path / "motion.csv", tmp_path / "enriched.yaml", tmp_path / "out.csv")
    expected = simulate(named, t_s, z_m=np.round(z_m, 7), library=known)
    np.testing.assert_allclose(simulated.wrench[:, 2], expected["fz_N"], atol=1e-9)


def test_a_run_in_an_emulated_cell_with_a_law_exports_it(tmp_path: Path) -> None:
    law = learned(driver={"quantity": "height"}, knots=[0.0, 0.02], values=[0.0, 1.0], sd=[], range=[0.0, 0.02])
    slopes_N_per_m = []
    for laws in ((), (law,)):
        plan = Plan(sites=(PlanSite(name="A"),), depths_m=(0.004,), mode="dynamic", repeats=1)
        done = run(Job("palpation", Config(), plan), nominal().model_copy(update={"learned": laws}), home_above_m=0.012)
        assert done.outcome.verdict == "done"
        samples = export(Recording(tmp_path, done.rows, done.header, {}, None), tmp_path / f"{len(laws)}.csv", "A")
        air = samples.z_m > 0.001
        slopes_N_per_m.append(np.polyfit(samples.z_m[air], samples.wrench[air, 2], 1)[0])
    assert slopes_N_per_m[1] - slopes_N_per_m[0] == pytest.approx(50.0, rel=0.1)


def test_no_library_is_weighed_unless_it_is_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_learned(tmp_path / "law.yaml", [learned().model_copy(update={"confounds": {}})])
    adopt(tmp_path / "law.yaml", tmp_path / "mine", None, nominal())
    monkeypatch.setenv("PALPD_EFFECTS_DIR", str(tmp_path / "mine"))
    assert set(library(None)) == set(EFFECTS)
    assert set(library(None, adopted=tmp_path / "mine")) == {*EFFECTS, "learned.test"}
    assert list(library(tmp_path / "law.yaml", adopted=tmp_path / "mine"))[-1] == "learned.test"


def test_the_commands_list_adopt_and_remove(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PALPD_EFFECTS_DIR", str(tmp_path / "mine"))
    monkeypatch.setenv("COLUMNS", "200")
    save_learned(tmp_path / "law.yaml", [learned().model_copy(update={"confounds": {"robot.compliance": 0.81}})])

    def printed(*arguments: str) -> str:
        done = CliRunner().invoke(app, ["effects", *arguments])
        assert done.exit_code == 0, done.output
        return " ".join(done.output.split())

    assert "robot.compliance (0.81)" in printed("--adopt", str(tmp_path / "law.yaml"), "--name", FOAM)
    listed = printed("--json", str(tmp_path / "all.json"))
    assert FOAM in listed
    assert "sensor.gain" in listed
    files = {one["id"]: one["adopted"] for one in json.loads((tmp_path / "all.json").read_text(encoding="utf-8"))["effects"]}
    assert files[FOAM] == str(tmp_path / "mine" / f"{FOAM}.yaml")
    assert files["sensor.gain"] is None
    assert FOAM not in printed("--no-adopted")
    assert "is removed" in printed("--remove", FOAM)
    assert FOAM not in printed()
    for arguments in (["--name", FOAM], ["--remove", FOAM, "--adopt", "x.yaml"]):
        assert isinstance(CliRunner().invoke(app, ["effects", *arguments]).exception, BadInput)


def test_a_law_without_measured_confounds_is_compared_when_it_is_adopted(tmp_path: Path) -> None:
    """A share of the contact force that grows from nil is what a gain makes of it."""
    law = learned(factor="force", driver={"quantity": "force"}, knots=[0.0, 30.0], values=[0.05, 0.05], sd=[], range=[0.0, 30.0])
    save_learned(tmp_path / "law.yaml", [law])
    done = adopt(tmp_path / "law.yaml", tmp_path / "mine", None, nominal())
    assert done.measured_here
    assert done.law.confounds
    assert max(done.law.confounds.values()) > 0.95
    assert load_learned(done.path) == (done.law,)


def test_a_law_of_implausible_size_is_adopted_only_where_that_is_accepted(tmp_path: Path) -> None:
    save_learned(tmp_path / "law.yaml", [learned(values=[0.0, 2e4, 2e4])])
    with pytest.raises(BadInput, match=r"the change of fz_N by learned\.test is 2e\+04 N, expected 0 to 1000 N .*--accept-implausible"):
        adopt(tmp_path / "law.yaml", tmp_path / "mine", None, nominal())
    assert not (tmp_path / "mine").exists()
    assert adopt(tmp_path / "law.yaml", tmp_path / "mine", None, nominal(), accept_implausible=True).path.exists()
