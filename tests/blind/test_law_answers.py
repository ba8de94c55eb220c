"""Learned laws against the sealed truth: right and wrong names, the band on the recording, and the lines of the table."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpd.blind.adoption import recorded
from palpd.blind.check import make_case
from palpd.blind.law_answers import LawOutcome, coverage, law_outcome, read_true_change, without_a_law
from palpd.blind.laws import NOVEL_LAWS
from palpd.blind.mujoco.unlisted import UNLISTED
from palpd.blind.plans import effects_of, plan, plan_unlisted
from palpd.blind.score import scores
from palpd.blind.truth import EVENT, SOURCES, CaseSpec, LawName, LawStatement, TrueChange, Truth, names
from palpd.cell.cell_file import nominal, save_cell
from palpd.cell.effects.learned import LearnedEffect, save_learned
from palpd.cell.simulation import simulate
from palpd.recording.samples import Samples
from tests.blind.test_check import outcome

PITCH_M = 0.0025


def cogging(**changes: Any) -> LearnedEffect:
    knots = np.linspace(0.0, PITCH_M, 21)
    term = {
        "channels": {"fz_N": 1.0},
        "factor": "one",
        "driver": {"quantity": "height", "period": PITCH_M},
        "knots": knots.tolist(),
        "values": (0.1 * np.sin(2.0 * np.pi * knots / PITCH_M)).tolist(),
        "sd": [0.01] * 21,
        "range": [0.0, PITCH_M],
    }
    return LearnedEffect.model_validate({"id": "learned.cogging", "what": "cogging", "terms": [term | changes]})


def truth(statement: LawStatement | None) -> Truth:
    effect = {"id": "x", "law": "novel", "parameters": {}, "snr": 30.0, "variance": False, "snr_per_row_sigma": 5.0}
    return {"effects": [effect | ({} if statement is None else {"statement": statement})]}  # type: ignore[typeddict-item]


def judged(folder: Path, statement: LawStatement, learned: LearnedEffect, alike: Sequence[LawName] = ()) -> LawOutcome:
    save_learned(folder / "learned.yaml", [learned])
    diagnosis = {"learned": {"what": learned.what, "replaces_listed": False, "alike_laws": list(alike)}, "events": None}
    return law_outcome(truth(statement), diagnosis, folder / "learned.yaml", folder / "none.yaml", folder / "none.npz")


def of_height(period: float | None) -> LawStatement:
    return {"kind": "law", "names": names("fz_N", ("one",), ("height",), period=period)}


def test_a_name_is_right_by_channel_factor_driver_and_period(tmp_path: Path) -> None:
    assert judged(tmp_path, of_height(PITCH_M), cogging())["right"]
    assert judged(tmp_path, of_height(1.08 * PITCH_M), cogging())["right"]
    assert not judged(tmp_path, of_height(0.5 * PITCH_M), cogging())["right"], "a harmonic is another law"
    assert not judged(tmp_path, of_height(None), cogging())["right"]
    assert not judged(tmp_path, of_height(PITCH_M), cogging(factor="force"))["right"]
    assert not judged(tmp_path, of_height(PITCH_M), cogging(channels={"fx_N": 1.0}))["right"]
    slow = cogging(driver={"quantity": "contact", "memory": "relaxed", "constant": 3.0})
    statement: LawStatement = {"kind": "law", "names": names("fz_N", ("one",), ("contact",), memory="relaxed", constant=2.0)}
    assert judged(tmp_path, statement, slow)["right"]
    assert not judged(tmp_path, statement, cogging(driver={"quantity": "contact"}))["right"]


def test_a_law_that_fits_as_well_is_right_by_channel_factor_quantity_and_memory(tmp_path: Path) -> None:
    statement: LawStatement = {"kind": "law", "names": names("fz_N", ("surface",), ("contact",), memory="relaxed", constant=2.0)}
    (right,) = names("fz_N", ("surface",), ("contact",), memory="relaxed", constant=9.0)
    assert judged(tmp_path, statement, cogging(), (right,))["right_alike"], "constants are not compared"
    for other in ({"memory": None}, {"factor": "one"}, {"channel": "lateral"}, {"quantity": "power"}, {"period": 1.0}):
        assert not judged(tmp_path, statement, cogging(), (right | other,))["right_alike"]  # type: ignore[typeddict-item]
    assert not judged(tmp_path, EVENT, cogging(), (right,))["right_alike"], "of an event every law is wrong"
    loop: LawStatement = {"kind": "law", "names": names("fz_N", ("one",), ("height",), memory="play")}
    assert judged(tmp_path, loop, cogging(), names("fz_N", ("one",), ("height",), memory="stop"))["right_alike"]


def test_every_effect_outside_the_list_states_what_it_is() -> None:
    kinds = {law.effect: law.states({**SHAPE}, 0.0)["kind"] for law in NOVEL_LAWS}
    assert {name for name, kind in kinds.items() if kind == "event"} == {"wander", "slip", "pulses", "jumping zero"}
    for effect in UNLISTED:
        values = dict.fromkeys(("tau_s", "pitch_m", "height_m", "frequency_Hz"), 1.0)
        statement = effect.states(values, nominal_stated())
        assert (statement["kind"] == "event") == (effect.nature == "event")
        assert bool(statement["names"]) == (statement["kind"] != "event")


SHAPE = dict.fromkeys(("frequency_Hz", "pitch_m", "speed_m_per_s", "step_m", "height_m", "tau_s"), 1.0)


def nominal_stated() -> Any:
    class Stated:
        surface_z_m = 0.0

    return Stated()


def test_the_band_of_a_law_is_judged_on_the_rows_of_the_recording(tmp_path: Path) -> None:
    t_s = np.arange(0.0, 12.0, 0.004)
    z_m = 0.005 + 0.007 * np.cos(0.8 * t_s)
    v = np.gradient(z_m, t_s)
    cell = nominal()
    plain = simulate(cell, t_s, z_cmd_m=z_m, z_m=z_m, vz_m_per_s=v)["fz_N"]

    def covered(true_N: float, learned: LearnedEffect) -> float | None:
        law = cogging(values=(true_N * np.sin(2.0 * np.pi * np.linspace(0.0, 1.0, 21))).tolist())
        fz_N = simulate(cell.model_copy(update={"learned": (law,)}), t_s, z_cmd_m=z_m, z_m=z_m, vz_m_per_s=v)["fz_N"] - plain
        change = np.zeros((len(t_s), 7))
        change[:, 3] = fz_N + 0.05  # a constant force is the tare's
        enriched = tmp_path / "enriched.yaml"
        save_cell(enriched, cell.model_copy(update={"learned": (learned,)}))
        save_learned(tmp_path / "learned.yaml", [learned])
        terms = [term.model_dump(exclude_none=True) for term in learned.terms]
        return coverage(TrueChange(Samples(t_s, z_m, z_m, v, np.zeros((len(t_s), 6))), change), terms, enriched)

    assert covered(0.1, cogging()) == 1.0
    half = covered(0.15, cogging())
    assert half is not None
    assert 0.1 < half < 0.5, "inside only near the zeros of the sine"


def test_a_drawn_law_seals_its_statement_and_what_it_changes(tmp_path: Path) -> None:
    spec = CaseSpec("drawn", 3, "novel", ("cogging",), "20-60", extra=True)
    recordings, sealed = tmp_path / "recordings", tmp_path / "sealed"
    recordings.mkdir()
    sealed.mkdir()
    digests = make_case(spec, 5, recordings, sealed)
    assert f"sealed/{spec.name}.npz" in digests
    true = read_true_change(sealed / f"{spec.name}.npz")
    assert np.abs(true.change[:, 3]).max() > 0.0
    assert true.change.shape == (len(true.motion), 7)


def test_the_lines_on_laws_count_what_they_say() -> None:
    def case(kind: str | None, of: str = "novel", **more: Any) -> Any:
        law = without_a_law(truth(None)) | {"kind": kind} | more
        return outcome(of, ["hum"] if of != "healthy" else [], [], snr=30.0, law=law, extra=of == "novel")

    outcomes = [
        case("law", accepted=True, right=True, right_alike=True, covered=0.95, named_again=True),
        case("law", accepted=True, right=False, right_alike=True, named_again=False),
        case("law"),
        case("near", accepted=True),
        case("event", accepted=True),
        case("event"),
        case(None, "healthy", accepted=True),
        case(None, "healthy"),
    ]
    replaced = case(None, "library", accepted=True, replaces=True) | {"sufficient": True}
    kept = case(None, "library", accepted=True) | {"sufficient": True, "named": ["hum"], "groups": [["hum"]]}
    by = {score.what: score for score in scores([*outcomes, replaced, kept])}
    right = by["law outside the list: factor and driver right and accepted, SNR 20-60"]
    assert (right.value, right.n) == (pytest.approx(1 / 3), 3)
    wrong = by["accepted law outside the list: factor or driver wrong, also of those that fit as well"]
    assert (wrong.value, wrong.n) == (pytest.approx(1 / 3), 3)
    assert by["events outside the list: accepted as a law"].value == 0.5
    assert by["healthy cell: a law accepted"].value == 0.5
    assert by["listed cause that is sufficient: replaced by a law or by events"].value == 0.5
    assert by["band of a right law covers its true change, mean share of rows"].value == 0.95
    again = by["accepted alone and adopted: named in another recording, itself or in a group"]
    assert (again.value, again.n) == (0.5, 2)


def test_a_recording_again_has_the_stated_noise_and_steps() -> None:
    cell = nominal()
    t_s = np.arange(4000) / 500.0
    rows = recorded(Samples(t_s, None, 0.0 * t_s, 0.0 * t_s, np.zeros((len(t_s), 6))), cell, 3)
    assert np.std(rows.z_m) == pytest.approx(cell.robot.position_noise_rms_m, rel=0.1)
    steps = rows.wrench[:, 2] / cell.sensor.resolution_fz_N
    assert np.allclose(steps, np.round(steps))
    assert np.std(rows.wrench[:, 0]) == pytest.approx(np.hypot(cell.sensor.noise_rms_N, cell.sensor.resolution_fxy_N / 12**0.5), rel=0.1)


def test_further_cases_outside_the_list_take_every_effect_in_turn_and_both_strata() -> None:
    for source in SOURCES:
        specs = plan_unlisted(source, 60, 1)
        assert plan_unlisted(source, 20, 1) == specs[:20]
        assert {spec.effects[0] for spec in specs} == set(effects_of(source)["novel"])
        assert all({s.stratum for s in specs if s.effects == spec.effects} == {"20-60", "10-20"} for spec in specs)
        assert not {spec.index for spec in specs} & {spec.index for spec in plan(source, 500, 1)}
