"""What is implausible is questioned, and counts where the operator accepts it."""

import math

import pytest

from palpd.cell.cell_file import cell_from, nominal
from palpd.cell.plausible import PLAUSIBLE, ask, doubts, doubts_of_cell
from palpd.errors import BadInput
from tests.paths import ROOT


@pytest.mark.parametrize("quantity", PLAUSIBLE)
def test_a_range_holds_its_bounds_and_nothing_that_is_not_finite(quantity: str) -> None:
    usual = PLAUSIBLE[quantity]
    assert doubts(quantity, usual.low, "it") == doubts(quantity, usual.high, "it") == []
    for value in (usual.low - 1e-3 * usual.high, 1.001 * usual.high, math.inf, math.nan):
        assert doubts(quantity, value, "it")[0].startswith(f"it is {value:.3g} {usual.unit}, expected {usual.low:g} to {usual.high:g}")


def test_the_page_has_every_range_with_its_reason() -> None:
    page = (ROOT / "docs" / "import.md").read_text(encoding="utf-8")
    for usual in PLAUSIBLE.values():
        assert f"| {usual.low:g} | {usual.high:g} | {usual.unit} | {usual.reason} |" in page


def test_the_emulated_cell_is_plausible_and_each_value_of_another_is_questioned() -> None:
    assert doubts_of_cell(nominal()) == []
    odd = {
        "probe": {"mass_kg": 106.0, "tip_radius_m": 0.6},
        "tissue": {"youngs_modulus_Pa": 45e6, "surface_z_m": -7.0},
        "sites": [{"name": "B", "tissue": {"youngs_modulus_Pa": 10.0, "surface_z_m": 0.0}}],
    }
    sentences = doubts_of_cell(cell_from(odd, "odd"))
    assert [sentence.split(" is ")[0] for sentence in sentences] == [
        "probe.mass_kg", "probe.tip_radius_m", "tissue.youngs_modulus_Pa", "tissue.surface_z_m", "site B: tissue.youngs_modulus_Pa",
    ]  # fmt: skip


def test_what_is_accepted_is_noted_and_what_is_not_is_refused_with_the_option() -> None:
    assert ask((), False, "check it") == ()
    assert ask(["it weighs 106 kg."], True, "check it") == ("Accepted although implausible: it weighs 106 kg.",)
    with pytest.raises(BadInput, match=r"^it weighs 106 kg; check it, or accept it with --accept-implausible$"):
        ask(["it weighs 106 kg."], False, "check it")
