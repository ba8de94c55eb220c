"""One site has one modulus, or a sentence says why two are shown."""

import pytest

from palpd.analysis.hertz_misfit import star_note
from palpd.analysis.results import LoadingResult, SiteResult, analysed, sites
from palpd.cell.cell_file import PHANTOM
from palpd.cli.analysis import modulus_line
from palpd.cli.tables import site_tables
from palpd.config import Plan, PlanSite
from palpd.quantities import kilopascals
from tests.simulated import cell_file, ran

PLAN = Plan(sites=(PlanSite(name="A"), PlanSite(name="C", x_m=0.06)), depths_m=(0.004, 0.006, 0.008), hold_s=0.5, repeats=1)


Results = tuple[dict[str, LoadingResult], dict[str, SiteResult]]


@pytest.fixture(scope="module")
def results() -> Results:
    run = ran(PHANTOM, PLAN, safety={"contact_limit_N": 16.0, "absolute_limit_N": 40.0})
    held = {site["name"]: site for site in sites(run.rows, run.header)}
    return {site["name"]: site for site in analysed(run.rows, run.header)}, held


def test_a_modulus_that_differs_from_the_results_table_says_so_and_why(results: Results) -> None:
    site, static_Pa = results[0]["C"], results[1]["C"]["static_youngs_modulus_Pa"]
    assert static_Pa is not None
    assert site["static_youngs_modulus_Pa"] == static_Pa
    assert any(
        f"the results table of the run shows {kilopascals(static_Pa)} kPa. That is equation 1, the mean of 3 holds" in note
        for note in site["warnings"]
    )
    assert any("Hertz does not fit" in note for note in site["warnings"])


def test_where_hertz_does_not_fit_table_and_analysis_say_so_and_their_intervals_cover_the_moduli_over_depth(results: Results) -> None:
    loading, site = results[0]["C"], results[1]["C"]
    assert site["hertz_misfit"] is not None
    assert loading["hertz_misfit"] == site["hertz_misfit"]
    held = [depth["E_Pa"] for depth in site["depths"] if depth["E_Pa"] is not None]
    peaks = [press["corrected_Pa"] for press in site["presses"]]
    for interval, moduli in (
        (site["static_ci95_Pa"], held),
        (site["dynamic_corrected_ci95_Pa"], peaks),
        (loading["ci95_Pa"], [*held, loading["youngs_modulus_Pa"] or 0.0]),
    ):
        assert interval is not None
        assert interval[0] <= min(moduli) < max(moduli) <= interval[1]
    noise = site["static_noise_ci95_Pa"]
    assert noise is not None
    assert noise[1] - noise[0] < 0.1 * (max(held) - min(held)) + 0.05 * max(held)
    assert "Hertz does not fit" in star_note({"C": site["hertz_misfit"]})
    (stiff, _) = site_tables([results[1]["A"], site], None)
    assert str(stiff.caption).startswith("* Hertz does not fit: E changes with depth (C ")
    assert [cell.endswith(" *") for cell in stiff.columns[2].cells] == [False, True]
    assert "Hertz does not fit" in modulus_line(loading)


def test_the_interval_of_a_peak_that_no_model_corrected_holds_the_bias_of_its_force() -> None:
    biased = cell_file(tissue={"youngs_modulus_Pa": 62_500.0}, effects={"sensor.bias": {"offset_N": 0.19}})
    run = ran(biased, Plan(depths_m=(0.004, 0.006), mode="dynamic", repeats=1))
    (bare,) = sites(run.rows, run.header)
    (corrected,) = sites(run.rows, {**run.header, "model_card": {"rmse_N": 0.01}})
    low_Pa, high_Pa = bare["dynamic_corrected_ci95_Pa"] or (0.0, 0.0)
    assert low_Pa < 62_500.0 < high_Pa
    assert (corrected["dynamic_corrected_ci95_Pa"] or [0.0])[0] > 62_500.0  # with a model the running zero follows a bias
    assert bare["dynamic_corrected_noise_ci95_Pa"] == corrected["dynamic_corrected_noise_ci95_Pa"]


def test_a_half_space_has_one_modulus_and_no_misfit(results: Results) -> None:
    site = results[0]["A"]
    assert not any("Hertz does not fit" in note for note in site["warnings"])
    assert site["hertz_misfit"] is None
    held = results[1]["A"]
    assert held["hertz_misfit"] is None
    assert held["static_ci95_Pa"] == held["static_noise_ci95_Pa"] is not None


def test_a_modulus_is_shown_in_kilopascals_with_three_digits_model_and_misfit(
    results: Results,
) -> None:
    value_Pa = results[0]["A"]["youngs_modulus_Pa"]
    assert value_Pa is not None
    line = modulus_line(results[0]["A"])
    assert line.startswith(f"E = {value_Pa / 1e3:.3g} kPa (95 %: ")
    assert "by Hertz over the loading, " in line
    assert ", misfit 0." in line
