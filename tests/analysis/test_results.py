"""One site has one modulus, or a sentence says why two are shown."""

import pytest

from palpd.analysis.results import LoadingResult, analysed, sites
from palpd.cell.cell_file import PHANTOM
from palpd.cli.analysis import modulus_line
from palpd.config import Plan, PlanSite
from tests.simulated import ran

PLAN = Plan(sites=(PlanSite(name="A"), PlanSite(name="C", x_m=0.06)), depths_m=(0.004, 0.006, 0.008), hold_s=0.5, repeats=1)


@pytest.fixture(scope="module")
def results() -> tuple[dict[str, LoadingResult], dict[str, float | None]]:
    run = ran(PHANTOM, PLAN, safety={"contact_limit_N": 16.0, "absolute_limit_N": 40.0})
    static = {site["name"]: site["static_youngs_modulus_Pa"] for site in sites(run.rows, run.header)}
    return {site["name"]: site for site in analysed(run.rows, run.header)}, static


def test_a_modulus_that_differs_from_the_results_table_says_so_and_why(
    results: tuple[dict[str, LoadingResult], dict[str, float | None]],
) -> None:
    loading, static = results
    site = loading["C"]
    static_Pa = static["C"]
    assert static_Pa is not None
    assert site["static_youngs_modulus_Pa"] == static_Pa
    assert any(
        f"the results table of the run shows {static_Pa / 1e3:.3g} kPa. That is equation 1, the mean of 3 holds" in note
        for note in site["warnings"]
    )
    assert any("Hertz does not fit" in note for note in site["warnings"])


def test_a_half_space_has_one_modulus_and_no_misfit(results: tuple[dict[str, LoadingResult], dict[str, float | None]]) -> None:
    site = results[0]["A"]
    assert not any("Hertz does not fit" in note for note in site["warnings"])


def test_a_modulus_is_shown_in_kilopascals_with_three_digits_model_and_misfit(
    results: tuple[dict[str, LoadingResult], dict[str, float | None]],
) -> None:
    value_Pa = results[0]["A"]["youngs_modulus_Pa"]
    assert value_Pa is not None
    line = modulus_line(results[0]["A"])
    assert line.startswith(f"E = {value_Pa / 1e3:.3g} kPa (95 %: ")
    assert "by Hertz over the loading, " in line
    assert ", misfit 0." in line
