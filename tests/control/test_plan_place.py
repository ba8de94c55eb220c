"""Where sites count from: an unfinished run elsewhere is asked about, whoever starts and however."""

import pytest

from palpd.control.plan_place import ANSWERS, SAME_PLACE_M, Choice, PlanPlace, question, way_back

LAST = PlanPlace("yesterday", "run-7", (0.4, 0.1), (0.4, 0.1, 0.13), 0.135, (("A", 0.0, 0.0), ("B", 0.09, 0.0)))


def test_a_start_over_another_site_of_an_unfinished_run_is_asked_about() -> None:
    asked = question(LAST, 0.49, 0.1, None)
    assert asked is not None
    assert "run-7 of yesterday" in asked
    assert "90 mm from where it began, at its site B" in asked
    assert "--" not in asked, "the page and the terminal name the answers in their own words"
    assert "--return of run, start and inject" in ANSWERS, "map, resolve and check have no such option"
    assert "--here" in ANSWERS


@pytest.mark.parametrize("choice", ["here", "return"])
def test_an_answer_is_no_question(choice: Choice) -> None:
    assert question(LAST, 0.49, 0.1, choice) is None


def test_where_the_run_began_or_ended_as_it_should_nothing_is_asked() -> None:
    assert question(None, 0.49, 0.1, None) is None
    assert question(LAST, 0.4 + 0.99 * SAME_PLACE_M, 0.1, None) is None
    assert question(LAST, 0.4 + 1.01 * SAME_PLACE_M, 0.1, None) is not None
    returned = PlanPlace("yesterday", "run-7", (0.4, 0.1), (0.4, 0.1, 0.13), 0.135, LAST.sites, returned=True)
    assert question(returned, 0.49, 0.1, None) is None


def test_the_site_under_the_tip_is_the_nearest_within_a_tips_radius() -> None:
    assert LAST.site_under(0.4, 0.1) == "A"
    assert LAST.site_under(0.4949, 0.1) == "B"
    assert LAST.site_under(0.44, 0.1) is None


def test_a_way_back_says_which_run_began_there_and_how_far_it_is() -> None:
    away_m, sentence = way_back(LAST, LAST.start_m[0] + 0.04, LAST.start_m[1])
    assert away_m == pytest.approx(0.04)
    assert sentence.startswith(f"the arm goes 40 mm sideways, to ({LAST.start_m[0]:.3f}, ")
    assert sentence.endswith(f"where the run {LAST.run} of {LAST.date} began")
