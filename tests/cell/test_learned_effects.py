"""A learned effect is data that a person can read and edit, and the simulator evaluates it like any effect of the library."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from palpd.cell.cell_file import load_cell, nominal, save_cell
from palpd.cell.effects import EFFECTS, load_effects
from palpd.cell.effects.drivers import UNITS, Driver, DriverState, driver_values
from palpd.cell.effects.learned import LearnedEffect, formula_of, load_learned, save_learned
from palpd.cell.physics import physics
from palpd.cell.simulation import share_outside, simulate
from palpd.cell.span import Span
from palpd.cell.stepped import SteppedCell
from palpd.errors import ConfigError
from palpd.tick import Floats


def learned(**changes: Any) -> LearnedEffect:
    """An added force that grows with height, with one change of the term."""
    term = {
        "channels": {"fz_N": 1.0},
        "factor": "one",
        "driver": {"quantity": "height"},
        "knots": [0.0, 0.005, 0.01],
        "values": [0.0, 0.1, 0.3],
        "sd": [0.01, 0.01, 0.01],
        "range": [0.0, 0.01],
    } | changes
    return LearnedEffect.model_validate({"id": "learned.test", "site": "robot" if "z_m" in term["channels"] else "probe", "terms": [term]})


def motion(n: int = 400) -> tuple[Floats, Floats]:
    """Down into the tissue and up again, three times."""
    t_s = np.arange(n) * 0.008
    return t_s, 0.004 + 0.008 * np.cos(2.0 * np.pi * t_s)


def span(n: int = 400) -> Span:
    t_s, z_m = motion(n)
    speed = np.gradient(z_m, t_s)
    s = Span(physics(nominal()).constants, t_s, 0.008, z_m, speed, np.gradient(speed, t_s))
    s.tip_m = s.z_m
    s.touch(0.0)
    s.fz_N = s.contact_N
    return s


def part(s: Span, rows: slice) -> Span:
    """Some of the samples."""
    out = Span(s.constants, s.t_s[rows], s.dt_s, s.z_m[rows], s.vz_m_per_s[rows], s.az_m_per_s2[rows])
    out.tip_m, out.fz_N = s.tip_m[rows], s.fz_N[rows]
    out.touch(0.0)
    return out


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, "an added force that depends on the height of the probe"),
        ({"driver": {"quantity": "height", "period": 0.00498}}, "an added force that repeats every 4.98 mm of height"),
        ({"driver": {"quantity": "time", "period": 2.0}, "factor": "force"}, "a share of the contact force that repeats every 2 s"),
        (
            {"driver": {"quantity": "depth", "memory": "play", "constant": 5e-4}, "channels": {"fx_N": 1.0}},
            "an added force on fx that depends on the depth of the press with a dead band of 0.5 mm",
        ),
    ],
)
def test_a_law_is_said_in_words_with_lengths_in_millimetres(changes: dict[str, Any], words: str) -> None:
    assert learned(**changes).terms[0].words == words


@pytest.mark.parametrize("quantity", list(UNITS))
@pytest.mark.parametrize("memory", [None, "relaxed", "play", "stop", "slew"])
def test_a_driver_over_blocks_of_samples_is_that_of_the_whole_recording(quantity: Any, memory: Any) -> None:
    constant = None if memory is None else {"relaxed": 0.3, "slew": 0.02}.get(memory, 0.002)
    driver, s = Driver(quantity=quantity, memory=memory, constant=constant), span()
    whole = driver_values(driver, DriverState.of_contact(s, 5e-4), {})
    memory_of_blocks: dict[str, Any] = {}
    blocks = [driver_values(driver, DriverState.of_contact(part(s, slice(k, k + 7)), 5e-4), memory_of_blocks) for k in range(0, 400, 7)]
    np.testing.assert_allclose(np.concatenate(blocks), whole, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"factor": "surface", "values": [0.0, 1e-5, 1e-4], "driver": {"quantity": "depth"}},
        {"factor": "force_direction", "driver": {"quantity": "depth", "memory": "relaxed", "constant": 0.2}},
        {"channels": {"z_m": 1.0}, "values": [0.0, 1e-5, 2e-5]},
        {"channels": {"z_m": 1.0}, "values": [0.0, 1e-5, 2e-5], "driver": {"quantity": "command", "period": 0.011}},
    ],
)
def test_a_law_over_blocks_of_samples_is_that_of_the_whole_recording(changes: dict[str, Any]) -> None:
    law, s, memory = learned(**changes), span(), {}
    whole = part(s, slice(None))
    law.act(whole, {"strength": 1.0}, {})
    for k in range(0, 400, 7):
        block = part(s, slice(k, k + 7))
        law.act(block, {"strength": 1.0}, memory)
        for name in ("fz_N", "z_m", "vz_m_per_s"):
            np.testing.assert_allclose(getattr(block, name), getattr(whole, name)[k : k + 7], rtol=1e-9, atol=1e-9)
    moved = np.abs(whole.z_m - s.z_m).max() + np.abs(whole.fz_N - s.fz_N).max()
    assert moved > 1e-5


def test_a_learned_effect_in_the_cell_file_acts_as_the_same_one_from_a_file_of_effects(tmp_path: Path) -> None:
    save_learned(tmp_path / "law.yaml", [learned()])
    assert load_learned(tmp_path / "law.yaml") == (learned(),)
    library = load_effects(tmp_path / "law.yaml")
    assert set(library) == {*EFFECTS, "learned.test"}
    t_s, z_m = motion()
    named = simulate(nominal().with_effects({"learned.test": {"strength": 1.0}}), t_s, z_m=z_m, library=library)
    save_cell(tmp_path / "cell.yaml", nominal().model_copy(update={"learned": (learned(),)}))
    held = simulate(load_cell(tmp_path / "cell.yaml"), t_s, z_m=z_m)
    without = simulate(nominal(), t_s, z_m=z_m)
    np.testing.assert_array_equal(named["fz_N"], held["fz_N"])
    change_N = held["fz_N"] - without["fz_N"]
    assert change_N.max() == pytest.approx(0.3, rel=0.02), "beyond its range the curve is held"


def test_an_emulated_cell_carries_a_learned_effect_from_the_tare_on() -> None:
    cell = nominal().model_copy(update={"learned": (learned(),)})
    target_m = np.tile([0.0, 0.0, 0.01], (200, 1))
    readings = []
    for begun in (False, True):
        emulated = SteppedCell(cell)
        if begun:
            emulated.begin()
        readings.append(emulated.step(target_m).wrench[100:, 2].mean())
    assert readings[1] - readings[0] == pytest.approx(0.3, abs=0.02)


def test_an_emulated_cell_counts_how_long_a_law_was_held_outside_its_range() -> None:
    emulated = SteppedCell(nominal().model_copy(update={"learned": (learned(),)}))
    emulated.begin()
    for height_m in (0.005, 0.02, 0.02, 0.02):
        emulated.step(np.tile([0.0, 0.0, height_m], (500, 1)))
    assert emulated.shares_held()["learned.test"] == pytest.approx(0.75, abs=0.05)
    inside = SteppedCell(nominal().model_copy(update={"learned": (learned(),)}))
    inside.begin()
    inside.step(np.tile([0.0, 0.0, 0.005], (500, 1)))
    assert inside.shares_held() == {"learned.test": 0.0}


@pytest.mark.parametrize("formula", [None, "0.2 * sin(2*pi*x/1.7)"])
def test_a_law_that_repeats_in_time_may_begin_anywhere(formula: str | None) -> None:
    knots = np.linspace(0.0, 1.7, 35)
    wave = {"knots": knots.tolist(), "values": (0.2 * np.sin(2.0 * np.pi * knots / 1.7)).tolist(), "sd": [], "range": [0.0, 60.0]}
    law = learned(driver={"quantity": "time", "period": 1.7}, formula=formula, **wave)
    assert [parameter.name for parameter in law.effect().parameters] == ["strength", "phase_rad"]
    values = {"strength": 0.5, "phase_rad": 1.2}
    s, whole = span(), span()
    before_N = s.fz_N + 0.0
    law.act(s, values, {})
    np.testing.assert_allclose(s.fz_N - before_N, 0.1 * np.sin(2.0 * np.pi * s.t_s / 1.7 + 1.2), atol=2e-3)
    law.at(values).act(whole, law.as_learned, {})
    np.testing.assert_allclose(whole.fz_N, s.fz_N, atol=2e-3)


def test_a_law_at_another_strength_is_a_law_with_another_curve() -> None:
    for law in (learned(), learned(formula="30 * x")):
        twice, s, other = law.at({"strength": 2.0}), span(), span()
        twice.act(s, {"strength": 1.0}, {})
        law.act(other, {"strength": 2.0}, {})
        np.testing.assert_allclose(s.fz_N, other.fz_N)


def test_a_law_stands_once_in_a_cell(tmp_path: Path) -> None:
    content = {"learned": [learned().model_dump(mode="json", exclude_none=True)] * 2}
    (tmp_path / "cell.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    with pytest.raises(ConfigError, match="stands twice"):
        load_cell(tmp_path / "cell.yaml")


def test_a_person_edits_a_value_or_puts_a_formula_in_its_place(tmp_path: Path) -> None:
    save_learned(tmp_path / "law.yaml", [learned()])
    text = (tmp_path / "law.yaml").read_text(encoding="utf-8")
    assert "values: [0.0, 0.1, 0.3]" in text
    (tmp_path / "law.yaml").write_text(text.replace("0.3]", "0.5]"), encoding="utf-8")
    (edited,) = load_learned(tmp_path / "law.yaml")
    assert edited.terms[0].curve(np.array([0.01, 0.02])) == pytest.approx([0.5, 0.5])
    formula = learned(formula="3 * abs(x)**1.5 - 0.1").terms[0]
    assert formula.curve(np.array([0.004])) == pytest.approx(3.0 * 0.004**1.5 - 0.1)


def test_rows_outside_the_range_are_counted() -> None:
    t_s, z_m = motion()
    cell = nominal().model_copy(update={"learned": (learned(),)})
    share = share_outside(cell, t_s, z_m=z_m)["learned.test"]
    assert share == pytest.approx(np.mean((z_m < 0.0) | (z_m > 0.01)), abs=0.02)


@pytest.mark.parametrize("text", ["x.real", "__import__('os')", "x if x else 1", "open('f')", "(x", "exp(x, x)", "y", "x" * 600, "tanh()"])
def test_a_formula_is_arithmetic_and_nothing_else(text: str) -> None:
    with pytest.raises(ValueError, match=r"expected|letters"):
        formula_of(text)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"values": [1.0]}, "3 knots, 1 values"),
        ({"knots": [0.0, 0.02, 0.01]}, "do not ascend"),
        ({"formula": "x.real"}, "expected numbers"),
        ({"formula": "1/(x-x)"}, r"the formula 1/\(x-x\) is inf at x = 0, expected a finite number"),
        ({"formula": "9**9**9**9"}, "is inf at x = 0, expected a finite number"),
        ({"formula": "log(x - 1)"}, "is nan at x = 0, expected a finite number"),
        ({"values": [0.0, 1e308, 0.3]}, r"values hold 1e\+308, expected numbers up to"),
        ({"factor": "magic"}, "factor"),
        ({"colour": "red"}, "there is no key"),
        ({"driver": {"quantity": "height", "memory": "play"}}, "belong together"),
        ({"channels": {"z_m": 1.0}}, "do not belong to site probe"),
    ],
)
def test_a_file_that_is_no_learned_effect_is_refused_in_one_sentence(tmp_path: Path, changes: dict[str, Any], words: str) -> None:
    content = {"learned": [learned().model_dump(mode="json", exclude_none=True)]}
    content["learned"][0]["terms"][0] |= changes
    (tmp_path / "law.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    with pytest.raises(ConfigError, match=words):
        load_learned(tmp_path / "law.yaml")
