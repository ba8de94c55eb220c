"""The motion that would refute a law, and the one that would show a refused law again."""

from dataclasses import replace

import numpy as np
import pytest

from palpd.cell.cell_file import nominal
from palpd.config import parse_plan
from palpd.gap.advise.law_rivals import rivals_of_law
from palpd.gap.advise.motions import MotionLimits, same_again
from palpd.gap.advise.next_experiment import Advice, advise
from palpd.gap.advise.rivals import open_rivals
from palpd.gap.decide import BeyondList, RefusedLaw
from palpd.gap.diagnosis import Diagnosis
from palpd.gap.laws.evidence import _judged, _one_cycle
from palpd.gap.laws.held_out import HeldOut
from tests.gap.test_diagnosis import recording
from tests.gap.test_law_search import rail_N, with_force


@pytest.fixture(scope="module")
def rail() -> Diagnosis:
    return with_force(rail_N(recording(nominal(), {}).z_m))


def refused(rail: Diagnosis, reason: str, cycle: int = 0) -> Advice:
    """Advice where the law of the rail was refused for that reason."""
    assert rail.decision.law is not None
    law = RefusedLaw(rail.decision.law.sought.law, reason, 0, cycle)  # type: ignore[arg-type]
    return advise(rail.problem, rail.attribution, beyond=BeyondList(refused=law))


def test_a_law_is_to_be_refuted_by_what_spreads_it_and_those_alike(rail: Diagnosis) -> None:
    assert rail.decision.law is not None
    laws = rivals_of_law(rail.problem, rail.attribution, rail.decision.law)
    advice = advise(rail.problem, rail.attribution, beyond=rail.decision.beyond)
    assert advice.proposal is not None
    assert advice.pair is not None
    assert rail.decision.law.learned.id in (one.name for one in laws.alike)
    content = advice.proposal.to_json()
    assert set(content) == {"sentence", "plan", "motion_csv", "expected_gain"}
    assert content["expected_gain"] >= 1.0
    assert "diagnose both recordings jointly" in content["sentence"]
    assert "range of the law" in content["sentence"]
    assert any(words in content["sentence"] for words in laws.words.values())
    parse_plan({"sites": [{"name": "A"}]} | content["plan"], "proposal")


def test_a_law_that_two_recordings_have_shown_leaves_nothing_open_but_those_alike(rail: Diagnosis) -> None:
    law = rail.decision.law
    assert law is not None
    whole = law.sought.law
    alone = replace(law, sought=replace(law.sought, law=replace(whole, terms=(replace(whole.terms[0], alike=()),))))
    one = rivals_of_law(rail.problem, rail.attribution, alone)
    assert [len(one.alike), len(one.against_list)] == [1, 2], "the list is its rival as long as one recording alone shows it"
    again = advise(rail.problem, rail.attribution, beyond=replace(rail.decision.beyond, law=replace(alone, secondary=True)))
    assert list(again.names) == [one.name for one in open_rivals(rail.attribution)], (
        "a listed cause stands: the list decides what to record"
    )


def test_a_change_in_time_is_to_be_recorded_again(rail: Diagnosis) -> None:
    advice = refused(rail, "time")
    assert advice.proposal is not None
    assert "Record the same motion again" in advice.sentence
    samples = rail.problem.recordings[0].samples
    assert samples.z_cmd_m is not None
    np.testing.assert_array_equal(advice.proposal.z_cmd_m, samples.z_cmd_m)
    motion, _, _ = same_again(rail.problem, MotionLimits.of(rail.problem))
    assert motion.depths_m == pytest.approx((0.004, 0.0075, 0.007), rel=0.1)
    assert motion.mode == "both"
    assert max(motion.depths_m) <= MotionLimits.of(rail.problem).depth_m


@pytest.mark.parametrize(("cycle", "depth_m"), [(0, 0.004), (2, 0.007)])
def test_a_law_of_one_press_asks_for_that_press_again(rail: Diagnosis, cycle: int, depth_m: float) -> None:
    advice = refused(rail, "one cycle", cycle)
    assert advice.proposal is not None
    plan = parse_plan({"sites": [{"name": "A"}]} | advice.proposal.plan, "proposal")
    assert plan.depths_m[0] == pytest.approx(depth_m, rel=0.1)
    assert len(plan.depths_m) * plan.repeats == 6
    assert "repeat the press at" in advice.sentence.lower()
    assert "the height of the probe" in advice.sentence


def test_a_law_that_one_press_alone_shows_is_told_from_one_that_several_show(rail: Diagnosis) -> None:
    assert rail.decision.law is not None
    law = rail.decision.law.sought.law
    assert _one_cycle(law) is None
    mine = rail.problem.recordings[0].bin_cycle == 1
    term = replace(
        law.terms[0], columns={channel: np.where(mine[:, None], values, 0.0) for channel, values in law.terms[0].columns.items()}
    )
    assert _one_cycle(replace(law, terms=(term,))) == (0, 1)
    fails = replace(term, held_out=HeldOut(np.zeros(4)))
    assert _judged(rail.inference, replace(law, terms=(fails,)), law.space, rail.inference.nominal).one_cycle == (0, 1)
    unlikely = replace(law, terms=(replace(fails, nats=5.0),))
    assert _judged(rail.inference, unlikely, law.space, rail.inference.nominal).one_cycle is None
