"""The cells that are written from the contract (docs/reference/contract.md) alone: their physics, and the scores of their answers."""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import lsim

from benchmarks.foreign import RIGHT, ForeignAnswer, diagnose, judged, page
from benchmarks.foreign_cells import LISTED, OUTSIDE, ForeignCell, ListedEffect, plan_cases, write_case

TRUTH: dict[str, Any] = {
    "kind": "single",
    "effects": {"sensor.gain": {"error": 0.1}},
    "snr": {"sensor.gain": 20.0},
    "note": "controller: held",
    "coarse": False,
    "controller": "held",
    "controller_misfit": {"snr": 9.0},
    "z_cmd": True,
}


def answer(verdict: str, *named: str, group: tuple[str, ...] = ()) -> dict[str, Any]:
    """The part of out.json that is scored; the first effect has the group."""
    effects = [{"id": name, "probability": 0.9, "indistinguishable_from": [] if k else list(group)} for k, name in enumerate(named)]
    return {"verdict": verdict, "effects": effects}


@pytest.mark.parametrize("seed", [2, 3])  # with and without a filter
def test_a_cell_with_nothing_drawn_obeys_the_formulas_of_the_contract(seed: int) -> None:
    cell = ForeignCell(np.random.default_rng(seed), exact=True)
    probe, sensor, robot, tissue = (cell.file[part] for part in ("probe", "sensor", "robot", "tissue"))
    (z, v, _), wrench = cell.simulate(cell.deviations, {})
    w, damping = 2 * np.pi * robot["servo_natural_frequency_Hz"], robot["servo_damping_ratio"]
    system = ([[0, 1], [-w * w, -2 * damping * w]], [[0], [w * w]], np.eye(2), np.zeros((2, 1)))
    _, states, _ = lsim(system, cell.commanded_m, cell.t_s, X0=[cell.commanded_m[0], 0])
    assert np.abs(states - np.transpose([z, v])).max() < 1e-9
    depth_m = np.maximum(0, tissue["surface_z_m"] - states[:, 0])
    modulus_Pa = tissue["youngs_modulus_Pa"] / (1 - tissue["poisson_ratio"] ** 2)
    force_N = 4 / 3 * modulus_Pa * np.sqrt(probe["tip_radius_m"]) * depth_m**1.5
    force_N -= probe["mass_kg"] * (w * w * (cell.commanded_m - states[:, 0]) - 2 * damping * w * states[:, 1])
    if cutoff_Hz := sensor["filter_cutoff_Hz"]:
        p = 2 * np.pi * cutoff_Hz
        _, force_N, _ = lsim(([p], [1, p]), force_N, cell.t_s, X0=[force_N[0] / p])
    assert np.abs(force_N[cell.samples] - wrench[2]).max() < 1e-6
    assert not wrench[[0, 1, 3, 4, 5]].any()


def test_readings_are_the_noisy_forces_on_a_lattice(tmp_path: Path) -> None:
    cell = ForeignCell(np.random.default_rng(1))
    cell.record(np.random.default_rng(2), {}, tmp_path / "cell.csv")
    readings = np.genfromtxt(tmp_path / "cell.csv", delimiter=",", names=True)
    fz_N, step_N = readings["fz_N"], cell.step[2]
    assert np.abs((fz_N - fz_N[0]) / step_N - np.round((fz_N - fz_N[0]) / step_N)).max() < 0.02
    spread_N = np.std(fz_N - cell.simulate(cell.deviations, {})[1][2])
    assert spread_N == pytest.approx(np.hypot(cell.noise[2], step_N / np.sqrt(12)), rel=0.1)


def test_a_spring_acts_by_the_law_of_the_library() -> None:
    cell, rng = ForeignCell(np.random.default_rng(3), exact=True), np.random.default_rng(3)
    spring = ListedEffect(rng, "cable.spring", other_law=False)
    spring.size = 0.5
    z = cell.simulate(cell.deviations, {})[0][0][cell.samples]
    change = cell.simulate(cell.deviations, {"cable.spring": spring})[1] - cell.simulate(cell.deviations, {})[1]
    assert change[2] == pytest.approx(-0.5 * (z - z[0]), abs=1e-12)
    assert cell.snr({"cable.spring": spring}) < np.linalg.norm(cell.change({"cable.spring": spring}))


def test_the_same_seed_gives_the_same_bytes(tmp_path: Path) -> None:
    case = next(case for case in plan_cases(12, 7) if case.kind == "single")
    contents = []
    for folder in (tmp_path / "a", tmp_path / "b"):
        folder.mkdir()
        write_case(case, folder)
        contents.append({path.name: path.read_bytes() for path in folder.iterdir()})
    assert contents[0] == contents[1]
    assert sorted(contents[0]) == [f"{case.name}.{ending}" for ending in ("csv", "truth.json", "yaml")]
    assert set(json.loads(contents[0][f"{case.name}.truth.json"])["effects"]) == set(case.effects)


def test_the_mix_has_every_effect_and_every_law() -> None:
    cases = plan_cases(200, 1)
    kinds = [case.kind for case in cases]
    assert {kind: kinds.count(kind) for kind in RIGHT} == {"healthy": 60, "single": 80, "pair": 30, "outside": 30}
    assert {case.effects[0] for case in cases if case.kind == "single"} == set(LISTED)
    assert {case.effects[0] for case in cases if case.kind == "outside"} == set(OUTSIDE)


def test_a_right_answer_is_scored_right_and_a_wrong_one_wrong() -> None:
    right, silent = judged(TRUTH, answer("effects", "sensor.gain")), judged(TRUTH, answer("none"))
    assert (right["only"], right["first"], right["group"], right["all"]) == (True, True, True, True)
    assert (silent["only"], silent["first"], silent["group"], silent["silent"]) == (False, False, False, True)
    assert not judged(TRUTH, answer("unknown", "sensor.gain"))["only"]
    more = judged(TRUTH, answer("effects", "sensor.gain", "sensor.bias"))
    assert more["first"]
    assert not more["only"]
    other = judged(TRUTH, answer("effects", "tissue.modulus", group=("sensor.gain",)))
    assert (other["first"], other["only"], other["group"], other["all groups"]) == (False, False, True, True)
    both = TRUTH | {"effects": {"sensor.gain": {}, "sensor.bias": {}}}
    assert judged(both, answer("effects", "sensor.bias", "sensor.gain"))["only"]
    assert not judged(both, answer("effects", "sensor.gain"))["all"]
    assert not judged(TRUTH | {"effects": {}}, answer("effects", "sensor.gain"))["silent"]


def test_the_page_lists_wrong_answers_alone() -> None:
    cells = {"cell_0000": answer("effects", "sensor.gain"), "cell_0001": answer("effects", "tissue.modulus", group=("sensor.gain",))}
    text = page([ForeignAnswer(name, TRUTH, cell, judged(TRUTH, cell)) for name, cell in cells.items()], {}, "command")
    assert "| single, SNR from 10 | right effect and nothing else | 50% | 9% to 91% | 2 |" in text
    assert "| cell_0001 | `sensor.gain` (20) | fine | 9 | effects | `tissue.modulus` (0.90; or sensor.gain) | controller: held |" in text
    assert "cell_0000" not in text


def test_an_answer_is_kept_and_a_refusal_is_a_reason(tmp_path: Path) -> None:
    palpd = tmp_path / "palpd"
    palpd.write_text(f"#!{sys.executable}\nimport sys\nopen(sys.argv[-1], 'w').write('{{}}')\n")
    palpd.chmod(0o755)
    assert diagnose(palpd, tmp_path, "cell_0000") == ""
    palpd.write_text("#!/bin/sh\necho no column >&2\nexit 2\n")
    assert diagnose(palpd, tmp_path, "cell_0000") == ""
    assert diagnose(palpd, tmp_path, "cell_0001") == "exit 2: no column"
