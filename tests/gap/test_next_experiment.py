"""What to record next: motions within the limits, what they are expected to say, and plans that the daemon can carry out."""

from dataclasses import replace
from functools import cache

import numpy as np

from palpd.cell.cell_file import nominal
from palpd.cell.simulation import equilibrium_force_N
from palpd.config import parse_plan
from palpd.gap.advise.motions import MotionLimits, TestMotion, blank_recording, motions
from palpd.gap.advise.next_experiment import advise, score, within_force
from palpd.gap.advise.rivals import open_rivals
from palpd.gap.diagnosis import Diagnosis, diagnose
from palpd.gap.infer.posterior import Attribution
from palpd.gap.model.problem import make_problem
from tests.gap.test_diagnosis import recording

LIMITS = MotionLimits(0.006, 9.0, 0.01, 0.02, 0.01, 0.05, 0.5)


@cache
def wrong_gain() -> Diagnosis:
    """A gain of 15 % too much, which pressing cannot tell from a modulus."""
    return diagnose([recording(nominal(), {"sensor.gain": {"error": 0.15}})], nominal(), max_bins=900, propose=False)


def gain_and_modulus() -> Attribution:
    """These two only."""
    whole = wrong_gain().attribution
    return replace(whole, hypotheses=[w for w in whole.hypotheses if w.fit.names in (("sensor.gain",), ("tissue.modulus",))])


def test_every_motion_keeps_to_its_limits_and_makes_a_plan_for_the_daemon() -> None:
    for motion in motions(LIMITS):
        t_s, z_m = motion.heights(0.002, 0.0, LIMITS.home_m, LIMITS.acceleration_m_per_s2)
        speed = np.gradient(z_m, t_s)
        assert z_m.min() >= -LIMITS.depth_m - 1e-9
        assert z_m.max() <= LIMITS.home_m + LIMITS.stroke_m + 1e-9
        assert np.abs(speed).max() <= LIMITS.free_speed_m_per_s * 1.001
        assert np.abs(speed[z_m < -1e-4]).max(initial=0.0) <= LIMITS.press_speed_m_per_s * 1.001
        assert np.abs(np.gradient(speed, t_s)).max() <= LIMITS.acceleration_m_per_s2 * 1.05
        plan = parse_plan({"sites": [{"name": "A"}]} | motion.plan(), "proposal")
        assert plan.depths_m == motion.depths_m
        assert (plan.free.strokes if plan.free else 0) == motion.strokes


def test_a_gain_that_pressing_cannot_tell_from_the_modulus_is_to_be_told_by_inertia_in_the_air() -> None:
    problem = wrong_gain().problem
    advice = advise(problem, wrong_gain().attribution, LIMITS)
    assert {"sensor.gain", "tissue.modulus"} <= set(advice.names)
    assert advice.proposal is not None
    assert advice.proposal.plan["free"]["strokes"] > 1
    rivals = open_rivals(gain_and_modulus())
    press = score(problem, rivals, TestMotion("press", (0.006,), 0.01, 0.2, 4, 0.004), LIMITS).apart(0, 1)
    air = score(problem, rivals, TestMotion("strokes", strokes=12, stroke_speed_m_per_s=0.05), LIMITS).apart(0, 1)
    assert air > 3.0 * press
    assert air > 2.0


def test_where_no_motion_within_the_limits_helps_that_is_said_with_the_figure() -> None:
    slow = replace(LIMITS, free_speed_m_per_s=0.005, acceleration_m_per_s2=0.05)
    advice = advise(wrong_gain().problem, gain_and_modulus(), slow)
    assert advice.proposal is None
    assert advice.most < 1.0
    assert f"{advice.most:.2g} nats" in advice.sentence
    assert advice.forever >= advice.most


def test_more_patience_never_makes_a_motion_say_less() -> None:
    rivals = open_rivals(gain_and_modulus())
    motion = TestMotion("strokes", strokes=6, stroke_speed_m_per_s=0.05)
    once, often = (score(wrong_gain().problem, rivals, motion, LIMITS, patience).apart(0, 1) for patience in (1.0, 10.0))
    assert often >= once


def test_nothing_is_advised_where_nothing_is_open() -> None:
    whole = wrong_gain().attribution
    advice = advise(wrong_gain().problem, replace(whole, hypotheses=whole.hypotheses[:1]))
    assert advice.proposal is None
    assert "Nothing is open" in advice.sentence
    assert open_rivals(whole)[0].fit is whole.best.fit


def test_no_proposal_needs_more_force_than_allowed() -> None:
    problem, rivals = wrong_gain().problem, open_rivals(wrong_gain().attribution)
    whole = within_force(problem, rivals, LIMITS)
    assert whole.depth_m == LIMITS.depth_m
    weak = within_force(problem, rivals, replace(LIMITS, force_N=2.0))
    assert 0.0 < weak.depth_m < LIMITS.depth_m
    assert equilibrium_force_N(nominal(), weak.depth_m) <= 2.0
    none = within_force(problem, rivals, replace(LIMITS, force_N=-1.0))
    assert none.depth_m == 0.0
    assert not any(motion.depths_m for motion in motions(none))


def test_a_press_that_is_nearly_all_hold_still_has_a_speed() -> None:
    rate_Hz = 100
    way_m = np.concatenate([np.full(100, 0.01), np.linspace(0.01, -0.003, 130), np.full(6000, -0.003), np.linspace(-0.003, 0.01, 130)])
    cell = nominal()
    samples = blank_recording(cell, np.arange(len(way_m)) / rate_Hz, way_m)
    limits = MotionLimits.of(make_problem([samples], cell))
    assert 0.005 < limits.press_speed_m_per_s < 0.02
    assert 0.005 < limits.free_speed_m_per_s < 0.02
