"""The smallest size of an effect that a recording would have shown: what is stated is what a diagnosis then finds."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks import limits as benchmark
from palpd.cell.cell_file import CellFile, nominal, save_cell
from palpd.cell.effects import EFFECTS, Effect, Parameter
from palpd.cli import app
from palpd.errors import BadInput
from palpd.gap.commands import diagnose_files, limits_of_files
from palpd.gap.diagnosis import limits
from palpd.gap.infer.detectable import DetectableSize, detectable_sizes
from palpd.gap.infer.settle import settle
from palpd.gap.model.problem import make_problem
from palpd.gap.user_simulator import MotionColumns, SimulatorDoubt
from palpd.recording.samples import Samples, write_csv
from tests.gap.test_diagnosis import quick, recording
from tests.gap.test_user_simulator import own_simulator, palpds_own, record, smooth, stated


def shown(samples: Samples, cell: CellFile) -> dict[str, DetectableSize]:
    return {one.effect: one for one in limits([samples], cell).sizes}


@pytest.fixture(scope="module")
def of_a_healthy_cell() -> dict[str, DetectableSize]:
    return shown(recording(nominal(), {}), nominal())


@pytest.mark.parametrize("effect", ["probe.mass", "cable.friction", "sensor.gain", "tissue.preconditioning"])
def test_three_times_the_stated_size_is_named_and_a_third_of_it_is_not(of_a_healthy_cell: dict[str, DetectableSize], effect: str) -> None:
    stated = of_a_healthy_cell[effect]
    assert stated.smallest is not None
    for factor, named in ((3.0, True), (1.0 / 3.0, False)):
        values = {stated.parameter.name: factor * stated.smallest, **stated.others}
        answer = quick(recording(nominal(), {effect: values}, seed=8), nominal())
        assert (effect in [one.id for one in answer.effects]) is named


def test_an_effect_of_a_tolerance_must_exceed_it(of_a_healthy_cell: dict[str, DetectableSize]) -> None:
    of_a_tolerance = {name: one for name, one in of_a_healthy_cell.items() if one.specification is not None}
    assert {"sensor.gain", "sensor.bias", "probe.mass", "tissue.modulus"} <= set(of_a_tolerance)
    for one in of_a_tolerance.values():
        assert one.specification is not None
        assert one.of_typical is None or one.of_typical > one.specification


def test_what_an_effect_costs_beside_a_learned_simulator_counts() -> None:
    samples, library = recording(nominal(), {}), {name: EFFECTS[name] for name in ("sensor.gain", "cable.friction")}

    def sizes(price: float) -> dict[str, float | None]:
        def doubt(motion: MotionColumns) -> SimulatorDoubt:
            n = len(motion["t_s"])
            return SimulatorDoubt(np.zeros((0, 7, n)), np.ones(n, dtype=bool), np.zeros((7, n)), {"cable.friction": price})

        learned = replace(palpds_own(nominal()), doubt=doubt)
        settled = settle(make_problem([samples], nominal(), library, simulators=[learned]))
        return {one.effect: one.smallest for one in detectable_sizes(settled.problem, settled.fit.linearisation)}

    free, priced = sizes(0.0), sizes(40.0)
    assert free["cable.friction"] is not None
    assert priced["cable.friction"] is not None
    assert priced["cable.friction"] > 1.5 * free["cable.friction"]
    assert priced["sensor.gain"] == free["sensor.gain"]


def test_what_a_recording_cannot_show_says_what_would() -> None:
    whole = recording(nominal(), {})
    still = whole.z_m.max()
    resting = replace(whole, z_m=np.full_like(whole.z_m, still), vz_m_per_s=np.zeros_like(whole.z_m), z_cmd_m=None)
    resting = replace(resting, wrench=np.random.default_rng(1).normal(0.0, 0.01, whole.wrench.shape))
    sizes = shown(resting, nominal())
    assert sizes["robot.lag"].needs == "record the commanded height z_cmd_m"
    assert sizes["tissue.modulus"].needs == "press the tissue"
    assert sizes["probe.mass"].needs == "move freely in the air: nothing moves there"
    assert sizes["sensor.drift"].smallest is not None


def test_the_law_of_a_user_that_overflows_or_does_nothing_has_a_limit_or_none() -> None:
    def bursts(span: Any, values: Any, _memory: Any) -> None:
        span.fz_N = span.fz_N + np.exp(1e3 * values["x_N"]) - 1.0

    parameter = Parameter("x_N", "N", -5.0, 5.0, (1.0,))
    library = {
        "sensor.bursts": Effect("sensor.bursts", "sensor", "bursts", (parameter,), law=bursts),
        "sensor.idle": Effect("sensor.idle", "sensor", "does nothing", (parameter,), law=lambda span, values, memory: None),
    }
    with np.errstate(over="ignore", invalid="ignore"):
        sizes = {one.effect: one for one in limits([recording(nominal(), {})], nominal(), library).sizes}
    assert sizes["sensor.idle"].smallest is None
    assert sizes["sensor.idle"].needs is not None
    assert sizes["sensor.bursts"].smallest is None or 0.0 < sizes["sensor.bursts"].smallest <= 1.0


def test_every_answer_holds_the_limits_and_the_command_prints_them_alone(
    of_a_healthy_cell: dict[str, DetectableSize], tmp_path: Path
) -> None:
    samples = recording(nominal(), {})
    listed = {one["id"]: one for one in quick(samples, nominal()).to_json()["detectable"]}
    assert set(listed) == set(of_a_healthy_cell)
    write_csv(tmp_path / "a.csv", samples)
    save_cell(tmp_path / "cell.yaml", nominal())
    command = ["diagnose", str(tmp_path / "a.csv"), "--cell", str(tmp_path / "cell.yaml"), "--limits"]
    ran = CliRunner().invoke(app, command)
    assert ran.exit_code == 0
    assert set(re.findall(r"[a-z]+\.[a-z]+", ran.output)) >= set(listed)
    assert "Next:" not in ran.output
    for beside in (["--report", str(tmp_path / "a.html")], ["--jobs", "2"]):
        assert isinstance(CliRunner().invoke(app, [*command, *beside]).exception, BadInput)
    assert not (tmp_path / "a.html").exists()
    both = CliRunner().invoke(app, [*command, "--report", str(tmp_path / "a.html"), "--cell-out", str(tmp_path / "b.yaml")]).exception
    assert "--cell-out and --report belong to a diagnosis" in str(both)
    of_a_folder = CliRunner().invoke(app, ["diagnose", str(tmp_path), "--limits"]).exception
    assert isinstance(of_a_folder, BadInput)
    assert "--limits is for one recording" in str(of_a_folder)


def test_the_limits_beside_an_own_simulator_are_those_of_its_answer_and_say_what_it_does_not_let_be_judged(tmp_path: Path) -> None:
    samples = record(own_simulator)
    write_csv(tmp_path / "a.csv", samples)
    save_cell(tmp_path / "cell.yaml", stated())
    mine = smooth(samples)
    np.savetxt(tmp_path / "mine.csv", np.column_stack(list(mine.values())), delimiter=",", header=",".join(mine), comments="")
    command = ["diagnose", str(tmp_path / "a.csv"), "--cell", str(tmp_path / "cell.yaml"), "--simulated", str(tmp_path / "mine.csv")]
    assert CliRunner().invoke(app, [*command, "--json", str(tmp_path / "out.json")]).exit_code == 0
    answer = json.loads((tmp_path / "out.json").read_text())
    assert answer["simulated"]["not_judged"]
    shown = limits_of_files([tmp_path / "a.csv"], tmp_path / "cell.yaml", simulated=[tmp_path / "mine.csv"])
    assert [one.to_json() for one in shown.sizes] == answer["detectable"]
    assert shown.not_judged in answer["basis"]
    printed = CliRunner().invoke(app, [*command, "--limits"]).output
    assert {name for name in answer["simulated"]["not_judged"] if name not in printed} == set()


def test_the_limits_since_the_cell_was_healthy_are_those_of_its_answer(tmp_path: Path) -> None:
    for number, name in enumerate("abc"):
        write_csv(tmp_path / f"{name}.csv", record(own_simulator, seed=number, presses_m=(0.005,)))
    healthy, now = [tmp_path / f"{name}.csv" for name in "ab"], [tmp_path / "c.csv"]
    answer = diagnose_files(now, None, healthy=healthy, propose=False)
    assert [one.to_json() for one in limits_of_files(now, None, healthy=healthy).sizes] == answer.to_json()["detectable"]


@pytest.mark.parametrize(
    ("effect", "parameter", "smallest", "twice"),
    [
        ("probe.mass", "delta_kg", 0.02, 0.04),
        ("tissue.modulus", "ratio", 1.1, 1.21),
        ("sensor.saturation", "limit_N", 5.0, 2.5),
        ("sensor.filter", "cutoff_Hz", 10.0, 100.0 / 15.0),
    ],
)
def test_the_check_of_the_limits_doubles_a_size_as_its_parameter_means_it(
    effect: str, parameter: str, smallest: float, twice: float
) -> None:
    cell = nominal().model_copy(update={"sensor": nominal().sensor.model_copy(update={"filter_cutoff_Hz": 15.0})})
    stated = DetectableSize(effect, EFFECTS[effect].parameter(parameter), smallest, 1.0, None, {}, None)
    assert benchmark.at_factor(stated, 2.0, cell) == pytest.approx(twice)


def test_the_check_of_the_limits_counts_what_is_found_at_each_size() -> None:
    rows: list[dict[str, Any]] = [
        {"effect": "probe.mass", "smallest": 0.02, "found": {"0.5": False, "1.0": True, "2.0": True}},
        {"effect": "probe.mass", "smallest": 0.03, "found": {"0.5": False, "1.0": False, "2.0": True}},
        {"effect": "robot.lag", "smallest": None, "found": {}},
    ]
    lines = benchmark.table(rows)
    assert lines[2].startswith("| **all** | 3 | 1 | 0 of 2 (0 to 66 %) | 1 of 2 (9 to 91 %) | 2 of 2 (34 to 100 %) |")
    assert lines[-2:] == ["| `probe.mass` | 2 | 0 | 0 of 2 | 1 of 2 | 2 of 2 |", "| `robot.lag` | 1 | 1 | 0 of 0 | 0 of 0 | 0 of 0 |"]
